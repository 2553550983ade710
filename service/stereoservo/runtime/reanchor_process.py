"""The process that finds moved cameras anew: sights at rest in, a model out; short-lived and niced like a fit.

``python -m stereoservo.runtime.reanchor_process SIGHTS.msgpack MODEL.json NEW.json --epoch N`` prints one JSON object:
``{"reanchored": …}`` once the new model is saved, or ``{"error": …}`` with exit code 1.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from stereoservo.kinematics.calibration.trials import CalibrationError
from stereoservo.kinematics.model import ModelFileError, load_model, save_model
from stereoservo.runtime.fit import become_child, error_line, print_line
from stereoservo.runtime.reanchor_job import find_anew, load_events


class ReanchorReport(msgspec.Struct, frozen=True):
    """What came of it. ``cameras``: names and, in words, how each moved; ``predicted_px``: largest standard deviation
    of a predicted pixel over the range of the joints.
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
        """In words."""
        said = "; ".join([*self.cameras.values(), *self.notes])
        return f"model epoch {self.epoch}: {said}; predictions are good to {self.predicted_px:.2g} px"


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(
        prog="python -m stereoservo.runtime.reanchor_process", description=__doc__
    )
    parser.add_argument("sights", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--epoch", type=int, required=True)
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    arguments = parser.parse_args()
    become_child(arguments.parent)
    try:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        events = load_events(arguments.sights)
        found = find_anew(events, load_model(arguments.model), arguments.epoch, created)
        save_model(found.model, arguments.new)
    except (CalibrationError, ModelFileError, OSError, msgspec.MsgspecError) as error:
        print_line(error_line(error))
        return 1
    report = ReanchorReport(
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


if __name__ == "__main__":
    sys.exit(main())
