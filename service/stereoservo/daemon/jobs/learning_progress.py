"""Learning job (own process, low priority): predicts the accuracy of the joints learnt so far while others move.

``python -m stereoservo.daemon.jobs.learning_progress RUNTIME EVENTS`` reads the calibration's events, which the gateway
appends to the file EVENTS, and fits a model to the arm of the joints whose own motions are done; the others have not
moved and count as part of its base. Prints ``{"learning": LearntAccuracy}`` on one line after each fit.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import msgspec
import numpy as np

from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.single_joint_fit import LOCKED_RANGE
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.core.cycle import Event
from stereoservo.core.settings import CoreSettings
from stereoservo.core.sources.calibration import combined_offsets
from stereoservo.daemon.ipc_messages import load_plan, stored_events
from stereoservo.daemon.jobs.fit_job import child_arguments, print_line
from stereoservo.daemon.jobs.trial_collection import TrialCollector
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.learning import LearntAccuracy
from stereoservo.numerics.arrays import FloatArray

POLL_S = 0.05
GROWTH = 1.3
"""Growth of the data, after the last joint's own motion, from which a model is fitted again."""
ALONE, TOGETHER = 5, 16
"""Number of configurations with one joint moved, and with all, at which pixels are predicted."""
CELLS = 8
"""Number of cells, along each side of an image, of which those with markers count as covered."""


class Learner:
    """Collects the events of one calibration, and predicts its accuracy when another joint's motion is done."""

    def __init__(self, settings: CoreSettings) -> None:
        self._collector = TrialCollector(settings)
        self._joints = len(settings.joint_names)
        self._current = -1
        self._stops_of: set[int] = set()
        self._fitted: tuple[int, int] = (0, 0)

    def add(self, event: Event) -> None:
        """Add an event of the core."""
        self._collector.add(event)
        if event.kind in ("calibration_sample", "calibration_frames"):
            self._current = event.trial
            self._stops_of.add(event.trial)

    def due(self) -> int:
        """Number of joints, counted from the base, to fit now; 0: there are no new data for a fit."""
        n = self._joints
        done = self._current if self._current >= 0 else n if n - 1 in self._stops_of else 0
        before, size = self._fitted
        grown = done == n and self._size >= GROWTH * size
        return done if done > before or (done and grown) else 0

    @property
    def _size(self) -> int:
        return self._collector.stops + self._collector.frames

    def predict(self, count: int) -> LearntAccuracy:
        """Accuracy of the first ``count`` joints, by a fit to the data collected so far."""
        self._fitted = (count, self._size)
        try:
            return learnt_accuracy(self._collector.trials(), count)
        except CalibrationError as error:
            return LearntAccuracy(note=error.message)


def learnt_accuracy(trials: TrialData, count: int) -> LearntAccuracy:
    """Accuracy of the first ``count`` joints of an arm whose other joints stood in their ``trials`` or are left out."""
    part = first_joints(trials, count)
    coverage = {camera.name: _coverage(trials, c) for c, camera in enumerate(trials.cameras)}
    try:
        model = fit_model(part, epoch=0).model
    except CalibrationError as error:
        return LearntAccuracy(coverage=coverage, note=error.message)
    except (GeometryError, np.linalg.LinAlgError) as error:
        return LearntAccuracy(coverage=coverage, note=f"the fit of the data so far broke down: {error}")
    joints = {name: predicted_rms(model, trials, moved_alone(part, j)) for j, name in enumerate(part.joint_names)}
    predicted = predicted_rms(model, trials, moved_together(part))
    return LearntAccuracy(predicted, {name: px for name, px in joints.items() if px is not None}, coverage)


def first_joints(trials: TrialData, count: int) -> TrialData:
    """The trials of the first ``count`` joints, at the stops where the others are where they were at the first stop."""
    rest = np.abs(trials.positions - trials.positions[0])[:, count:]
    stood = (rest <= LOCKED_RANGE).all(axis=1) & (trials.trials < count)
    return msgspec.structs.replace(
        trials,
        joint_names=trials.joint_names[:count],
        joint_kinds=trials.joint_kinds[:count],
        positions=trials.positions[stood, :count],
        trials=trials.trials[stood],
        pixels=trials.pixels[:, stood],
        sigmas=trials.sigmas[:, stood],
        loads=None,
        way=None,
    )


def moved_alone(trials: TrialData, joint: int) -> FloatArray:
    """Configurations (s, n) with ``joint`` moved over its range in the trials, the others as at the first stop."""
    positions = np.tile(trials.positions[0], (ALONE, 1))
    reached = trials.positions[:, joint]
    positions[:, joint] = np.linspace(reached.min(), reached.max(), ALONE)
    return positions


def moved_together(trials: TrialData) -> FloatArray:
    """Configurations (s, n) with all joints moved at once, inside their ranges in the trials."""
    base, low, high = trials.positions[0], trials.positions.min(axis=0), trials.positions.max(axis=0)
    return np.array([base + combined_offsets(k, low - base, high - base) for k in range(TOGETHER)])


def predicted_rms(model: CellModel, trials: TrialData, positions: FloatArray) -> float | None:
    """Rms deviation [px an axis] of the pixels that ``model`` predicts at ``positions`` (s, n), over those inside the
    images; None if there are none.
    """
    pixels, covariances = pixel_covariances(model, positions)
    sizes = np.array([(camera.width, camera.height) for camera in trials.cameras])[:, None, None]
    inside = ((pixels >= -0.5) & (pixels <= sizes - 0.5)).all(axis=-1)
    variances = 0.5 * np.trace(covariances, axis1=3, axis2=4)[inside]
    return float(np.sqrt(variances.mean())) if variances.size and np.isfinite(variances).all() else None


def _coverage(trials: TrialData, camera: int) -> float:
    """Fraction of the cells of a camera's image in which markers were seen."""
    pixels = trials.pixels[camera][trials.visible[camera]]
    size = np.array([trials.cameras[camera].width, trials.cameras[camera].height])
    cells = np.clip(pixels * CELLS // size, 0, CELLS - 1).astype(np.int64)
    return len(np.unique(cells, axis=0)) / CELLS**2


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.daemon.jobs.learning_progress", description=__doc__)
    parser.add_argument("runtime", type=Path)
    parser.add_argument("events", type=Path)
    arguments = child_arguments(parser)
    learner = Learner(load_plan(arguments.runtime).settings())
    with arguments.events.open("rb") as file:
        while True:  # the gateway ends this process
            for event in stored_events(file):
                learner.add(event)
            if count := learner.due():
                print_line({"learning": msgspec.to_builtins(learner.predict(count))})
            else:
                time.sleep(POLL_S)


if __name__ == "__main__":
    sys.exit(main())
