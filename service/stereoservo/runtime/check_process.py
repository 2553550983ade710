"""The check process: pixels of a check motion in, the model's verdict out; short-lived and niced like a fit.

``python -m stereoservo.runtime.check_process CHECK.npz MODEL.json HISTORY.jsonl --limit-px X`` prints one JSON object:
``{"check": …}`` with the report, or ``{"error": …}`` with exit code 1. The report is added to the history. With
``--reset-to NEW.json --epoch N`` a second object follows: ``{"reset": …}`` once the model with moved joint zeros is
saved, or ``{"error": …}`` that says why there is none.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from stereoservo.kinematics.calibration.check import Examination, examine, report_of
from stereoservo.kinematics.calibration.check_report import CheckReport, ZeroReset
from stereoservo.kinematics.calibration.check_trend import trend
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData, load_trials
from stereoservo.kinematics.calibration.zero_reset import reset_zeros
from stereoservo.kinematics.model import ModelFileError, load_model, save_model
from stereoservo.runtime.calibration_files import trials_file
from stereoservo.runtime.check_history import load_checks, save_checks
from stereoservo.runtime.fit import become_child, error_line, print_line


def check_and_remember(
    check: TrialData, model_path: Path, history_path: Path, limit_px: float
) -> tuple[Examination, CheckReport]:
    """Hold a model against a check, tell what grows, add the report to the history.

    Raises CalibrationError, ModelFileError, OSError.
    """
    model = load_model(model_path)
    made_from = trials_file(model_path, model.epoch)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    examined = examine(model, check, made_from=load_trials(made_from) if made_from.exists() else None)
    report = report_of(examined, limit_px=limit_px, created=created)
    history, lost = load_checks(history_path)
    grown = trend([*history, report])
    notes = [] if grown is None else [grown.message]
    if lost:
        notes.append(f"{lost} earlier checks in {history_path} could not be read")
    report = msgspec.structs.replace(report, trend="; ".join(notes))
    save_checks(history_path, [*history, report])
    return examined, report


def reset_and_save(examined: Examination, report: CheckReport, path: Path, epoch: int) -> ZeroReset:
    """Save the model with drifted joint zeros moved. Raises CalibrationError, ModelFileError, OSError."""
    model, reset = reset_zeros(examined, report, epoch=epoch, created=report.created)
    save_model(model, path)
    return msgspec.structs.replace(reset, model=str(path))


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.runtime.check_process", description=__doc__)
    parser.add_argument("check", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("history", type=Path)
    parser.add_argument("--limit-px", type=float, required=True)
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    parser.add_argument("--reset-to", type=Path, help="model file for the joint zeros reset")
    parser.add_argument("--epoch", type=int, default=0)
    arguments = parser.parse_args()
    become_child(arguments.parent)
    try:
        examined, report = check_and_remember(
            load_trials(arguments.check), arguments.model, arguments.history, arguments.limit_px
        )
        print_line({"check": msgspec.to_builtins(report)})
        if arguments.reset_to is not None:
            reset = reset_and_save(examined, report, arguments.reset_to, arguments.epoch)
            print_line({"reset": msgspec.to_builtins(reset)})
    except (CalibrationError, ModelFileError, OSError) as error:
        print_line(error_line(error))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
