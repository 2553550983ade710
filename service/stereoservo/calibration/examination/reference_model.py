"""The model that a recording is examined with: learnt from the stretch of it that fits best, since something may have
happened in the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.calibration.calibration_result import CalibrationReport
from stereoservo.calibration.examination.recorded_views import (
    LearningStops,
    RecordedViews,
    instants,
    learning_stops,
    single_joint_motions,
    stop_positions,
)
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import IntArray

AS_GOOD = 1.1
"""The whole is taken where it scatters no more than so many times the best half."""
GOOD = 1.5
"""A model that scatters more than so many times the noise is asked whether something happened while it was learnt."""
MENDS = 2
"""Times that something is taken back."""


@dataclass(frozen=True)
class ReferenceModel:
    """A ``model`` and its ``report`` from the ``stops`` of frames ``first`` to ``last``; without report and stops where
    it was there before the recording. ``noise``: of the pixels over what is stated, as they differ from frame to frame.
    """

    model: CellModel
    report: CalibrationReport | None
    stops: LearningStops | None
    first: int
    last: int
    noise: float

    @property
    def middle(self) -> int:
        """A frame that the model is of; -1 where it was there before the first."""
        return (self.first + self.last) // 2

    @property
    def noise_factor(self) -> float:
        """Noise of the pixels over what is stated, 1 at least: what they leave may be more than noise."""
        return self.noise if self.report is None else max(1.0, min(self.report.sigma_factor, self.noise))

    @property
    def fits(self) -> bool:
        """Whether nothing but noise, of pixels and within it of joints, was left where the model was learnt."""
        if self.stops is None:
            return True
        return self.scatter_px <= GOOD * self.noise * float(np.median(self.stops.trials.sigmas))

    @property
    def scatter_px(self) -> float:
        """rms deviation [px] that the model expects of a pixel at its stops, errors of the joints included."""
        if self.stops is None or self.report is None:
            return 0.0
        _, covariances = pixel_covariances(self.model, self.stops.trials.positions)
        own = (max(1.0, self.report.sigma_factor) * float(np.median(self.stops.trials.sigmas))) ** 2
        return float(np.sqrt(0.5 * np.trace(np.median(covariances, axis=(0, 1, 2))) + own))


class LearningError(Exception):
    """No stretch of a recording gives a model; ``stops``: those of the last attempt, ``error``: its refusal."""

    def __init__(self, error: CalibrationError, stops: LearningStops) -> None:
        super().__init__(str(error))
        self.error, self.stops = error, stops


def learn_reference(views: RecordedViews) -> ReferenceModel:
    """The model of the best stretch. Raises LearningError where there is none, CalibrationError (``bad_data``,
    ``too_few_stops``).
    """
    if not len(views.camera):
        raise CalibrationError("too_few_stops", "the recording has no frame that shows a marker", stops=0)
    if views.generators is None:
        if views.model is not None and _never_alone(views):
            return ReferenceModel(views.model, None, None, -1, -1, frame_noise(views))
        return _attempt(views, *_single_joint_stretch(views))
    f = len(views.camera)
    found: list[ReferenceModel] = []
    failed: LearningError | None = None
    for first, last in ((0, f - 1), (0, f // 2 - 1), (f // 2, f - 1)):
        try:
            found.append(_attempt(views, first, last))
        except LearningError as error:
            failed = failed or error
    if not found:
        assert failed is not None
        raise failed
    best = min(found, key=lambda one: one.scatter_px)
    whole = found[0]
    return whole if whole.scatter_px <= AS_GOOD * best.scatter_px else best


def frame_noise(views: RecordedViews) -> float:
    """Noise of the pixels over the stated one: median second difference of each marker from frame to frame of a camera,
    1 at least. An upper bound: too large by what most frames accelerate.
    """
    apart = []
    for c in range(len(views.cameras)):
        mine = views.camera == c
        pixels, sigmas = views.pixels[mine], views.sigmas[mine]
        apart.append(((pixels[2:] - 2.0 * pixels[1:-1] + pixels[:-2]) / sigmas[1:-1, :, None]).ravel())
    found = np.abs(np.concatenate(apart))
    found = found[np.isfinite(found)]
    return max(1.0, 1.4826 * float(np.median(found)) / np.sqrt(6.0)) if len(found) else 1.0


def _attempt(views: RecordedViews, first: int, last: int) -> ReferenceModel:
    stops = learning_stops(views.select(np.arange(first, last + 1)))
    stops = LearningStops(stops.trials, stops.frames + first)
    try:
        fit = fit_model(stops.trials, epoch=1)
        return ReferenceModel(fit.model, fit.report, stops, first, last, frame_noise(views))
    except CalibrationError as error:
        raise LearningError(error, stops) from error


def _never_alone(views: RecordedViews) -> list[str]:
    """Joints that never move alone."""
    alone = single_joint_motions(stop_positions(views, instants(views)))
    return [name for j, name in enumerate(views.joint_names) if not (alone == j).any()]


def _single_joint_stretch(views: RecordedViews) -> tuple[int, int]:
    """First and last frame of the motions of single joints. Raises CalibrationError (``too_few_stops``)."""
    instant = instants(views)
    alone = single_joint_motions(stop_positions(views, instant))
    missing = _never_alone(views)
    if missing:
        raise CalibrationError(
            "too_few_stops",
            f"joint {', '.join(missing)} never moves alone over four stops or more in this recording, and where an "
            "arm's axes are not known they are learnt from that. Move each joint by itself once, or give the hand's "
            "poses in place of joints",
            joints=missing,
        )
    stops = np.unique(instant[instant >= 0])
    moving: IntArray = stops[alone >= 0]
    frames = np.flatnonzero((instant >= moving[0]) & (instant <= moving[-1]))
    return int(frames[0]), int(frames[-1])
