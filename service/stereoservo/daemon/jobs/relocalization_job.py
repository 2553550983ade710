"""Relocalization job (own process, low priority): computes a model with new matrices of moved cameras from
observations at rest.

``python -m stereoservo.daemon.jobs.relocalization_job SIGHTS.msgpack MODEL.json NEW.json --epoch N`` prints one JSON
object: ``{"reanchored": …}`` once the new model is saved, or ``{"error": …}`` with exit code 1.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from stereoservo.calibration.relocalized_model import RelocalizedModel, RestObservations, RestPose, relocalize
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.core.cycle import Event
from stereoservo.daemon.jobs.fit_job import child_arguments, error_line, print_line
from stereoservo.daemon.jobs.rest_poses import load_events
from stereoservo.kinematics.model import CellModel, load_model, save_model
from stereoservo.messages.check_report import RelocalizationReport
from stereoservo.messages.decoding import DamagedError


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


def relocalize_from_events(events: list[Event], model: CellModel, epoch: int, created: str = "") -> RelocalizedModel:
    """Relocalized model of ``epoch``; the newest of ``events`` names the cameras that moved.

    Raises CalibrationError.
    """
    newest = events[-1]
    poses = tuple(RestPose(event.joints, event.samples) for event in events if event.joints is not None)
    return relocalize(
        model, RestObservations(poses), newest.cameras, rigid_rig=newest.rigid, epoch=epoch, created=created
    )


if __name__ == "__main__":
    sys.exit(main())
