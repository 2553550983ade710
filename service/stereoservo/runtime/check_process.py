"""The check process: pixels of a check motion in, the model's verdict out; short-lived and niced like a fit.

``python -m stereoservo.runtime.check_process CHECK.npz MODEL.json HISTORY.jsonl --limit-px X`` prints one JSON object:
``{"check": …}`` with the report, or ``{"error": …}`` with exit code 1. The report is added to the history.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from stereoservo.kinematics.calibration.check import check_model_holds
from stereoservo.kinematics.calibration.check_report import CheckReport
from stereoservo.kinematics.calibration.check_trend import trend
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData, load_trials
from stereoservo.kinematics.model import ModelFileError, load_model
from stereoservo.runtime.calibration_files import trials_file
from stereoservo.runtime.check_history import load_checks, save_checks
from stereoservo.runtime.fit import become_child, error_line, print_line


def check_and_remember(
    check: TrialData, model_path: Path, history_path: Path, limit_px: float
) -> CheckReport:
    """Hold a model against a check, tell what grows, add the report to the history.

    Raises CalibrationError, ModelFileError, OSError.
    """
    model = load_model(model_path)
    made_from = trials_file(model_path, model.epoch)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    report = check_model_holds(
        model, check, made_from=load_trials(made_from) if made_from.exists() else None, limit_px=limit_px,
        created=created,
    )  # fmt: skip
    history, lost = load_checks(history_path)
    grown = trend([*history, report])
    notes = [] if grown is None else [grown.message]
    if lost:
        notes.append(f"{lost} earlier checks in {history_path} could not be read")
    report = msgspec.structs.replace(report, trend="; ".join(notes))
    save_checks(history_path, [*history, report])
    return report


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.runtime.check_process", description=__doc__)
    parser.add_argument("check", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("history", type=Path)
    parser.add_argument("--limit-px", type=float, required=True)
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    arguments = parser.parse_args()
    become_child(arguments.parent)
    try:
        report = check_and_remember(
            load_trials(arguments.check), arguments.model, arguments.history, arguments.limit_px
        )
    except (CalibrationError, ModelFileError, OSError) as error:
        print_line(error_line(error))
        return 1
    print_line({"check": msgspec.to_builtins(report)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
