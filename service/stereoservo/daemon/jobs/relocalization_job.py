"""Relocalization job (own process, low priority): computes a model with new matrices of moved cameras from
observations at rest; and the collection of these observations for it.

``python -m stereoservo.daemon.jobs.relocalization_job SIGHTS.msgpack MODEL.json NEW.json --epoch N`` prints one JSON
object: ``{"reanchored": …}`` once the new model is saved, or ``{"error": …}`` with exit code 1.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import msgspec

from stereoservo.calibration.relocalized_model import (
    RelocalizedModel,
    RestObservations,
    RestPose,
    relocalize,
)
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.core.cycle import Event, decode_array, encode
from stereoservo.daemon.jobs.fit_job import child_arguments, error_line, print_line
from stereoservo.kinematics.model import CellModel, load_model, save_model
from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.files import read_bounded, write_atomically

MAX_EVENTS_BYTES = 1 << 26


class RelocalizationReport(msgspec.Struct, frozen=True):
    """Result of a relocalization. ``cameras``: names and descriptions of the motions; ``predicted_px``: largest
    standard deviation of a predicted pixel over the range of the joints.
    """

    epoch: int
    model: str
    cameras: dict[str, str]
    chi2: float
    degrees_of_freedom: int
    predicted_px: float
    notes: tuple[str, ...] = ()

    @property
    def message(self) -> str:
        """The result as text."""
        described = "; ".join([*self.cameras.values(), *self.notes])
        return f"model epoch {self.epoch}: {described}; predictions are good to {self.predicted_px:.2g} px"


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.daemon.jobs.relocalization_job", description=__doc__)
    parser.add_argument("sights", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--epoch", type=int, required=True)
    arguments = child_arguments(parser)
    try:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        events = load_events(arguments.sights)
        found = relocalize_from_events(events, load_model(arguments.model), arguments.epoch, created)
        save_model(found.model, arguments.new)
    except (CalibrationError, DamagedError, OSError) as error:
        print_line(error_line(error))
        return 1
    report = RelocalizationReport(
        arguments.epoch,
        str(arguments.new),
        {name: camera.text for name, camera in found.cameras.items()},
        found.chi2,
        found.degrees_of_freedom,
        found.predicted_px,
        found.notes,
    )
    print_line({"reanchored": msgspec.to_builtins(report)})
    return 0


MOST_POSES = 12
"""Number of poses that are used: the newest ones."""


class RelocalizationPoses:
    """Observations at rest poses since the cameras last moved; an event with ``trial`` 0 starts a new set."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def add(self, event: Event) -> None:
        """Add an event ``reanchor``."""
        if event.trial <= 0:
            self.events.clear()
        self.events = [*self.events, event][-MOST_POSES:]


def relocalize_from_events(events: list[Event], model: CellModel, epoch: int, created: str = "") -> RelocalizedModel:
    """Relocalized model of ``epoch``; the newest of ``events`` names the cameras that moved.

    Raises CalibrationError.
    """
    newest = events[-1]
    poses = tuple(RestPose(event.joints, event.samples) for event in events if event.joints is not None)
    return relocalize(
        model, RestObservations(poses), newest.cameras, rigid_rig=newest.rigid, epoch=epoch, created=created
    )


def save_events(path: Path, events: list[Event]) -> None:
    """Save events for the process that fits. Raises OSError."""
    write_atomically(path, encode(events))


def load_events(path: Path) -> list[Event]:
    """Inverse of :func:`save_events`. Raises DamagedError."""
    with decoding(partial(DamagedError, path)):
        data = read_bounded(path, MAX_EVENTS_BYTES)
        return msgspec.msgpack.decode(data, type=list[Event], dec_hook=decode_array)


if __name__ == "__main__":
    sys.exit(main())
