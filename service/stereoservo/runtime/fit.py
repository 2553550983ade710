"""The fit process: trial data in, model file out; short-lived and niced, so that the loop does not feel
it.

``python -m stereoservo.runtime.fit TRIALS.npz MODEL.json --epoch N`` prints one JSON object a line:
``{"progress": …, "message": …}``, and at the end ``{"model": …}`` with the statistics or ``{"error": …}``
with exit code 1.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.kinematics.calibration.fit import fit_model
from stereoservo.kinematics.calibration.trials import CalibrationError, load_trials
from stereoservo.kinematics.model import ModelFileError, save_model, write_atomically
from stereoservo.runtime.lifeline import die_with_parent

NICENESS = 10


def _print(line: dict[str, Any]) -> None:
    sys.stdout.write(msgspec.json.encode(line, enc_hook=_plain).decode() + "\n")
    sys.stdout.flush()


def _plain(value: object) -> object:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value)


def _progress(stage: str, fraction: float) -> None:
    _print({"progress": fraction, "message": stage})


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.runtime.fit", description=__doc__)
    parser.add_argument("trials", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("--epoch", type=int, required=True)
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    arguments = parser.parse_args()
    if arguments.parent:
        die_with_parent(arguments.parent, signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    try:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        result = fit_model(
            load_trials(arguments.trials), epoch=arguments.epoch, created=created, progress=_progress
        )
        save_model(result.model, arguments.model)
        report = arguments.model.with_name(arguments.model.stem + "-report.json")
        write_atomically(report, msgspec.json.format(msgspec.json.encode(result.report), indent=1) + b"\n")
    except CalibrationError as error:
        _print({"error": {"code": error.code, "message": str(error), "data": error.data}})
        return 1
    except (ModelFileError, OSError) as error:
        _print({"error": {"code": type(error).__name__, "message": str(error), "data": {}}})
        return 1
    _print({"model": str(arguments.model), "epoch": result.model.epoch, "report": str(report)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
