"""Check job (own process): tests the model on a check motion, reports, and can save a model with zeros reset. Keeps
the history of checks.

``python -m stereoservo.daemon.jobs.check_job CHECK.npz MODEL.json HISTORY.jsonl --limit-px X`` prints one JSON object:
``{"check": …}`` with the report, or ``{"error": …}`` with exit code 1. The report is added to the history. With
``--reset-to NEW.json --epoch N`` a second object follows: ``{"reset": …}`` once the model with moved joint zeros is
saved, or ``{"error": …}`` with the reason why there is none.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from stereoservo.calibration.change.model_check import (
    ModelExamination,
    examine_model,
    find_trend,
    make_check_report,
    reset_zeros,
)
from stereoservo.calibration.trial_data import CalibrationError, TrialData, load_trials, trials_file
from stereoservo.daemon.jobs.fit_job import child_arguments, error_line, print_line
from stereoservo.kinematics.model import ModelFileError, load_model, save_model
from stereoservo.messages.check_report import CheckReport, ZeroReset
from stereoservo.messages.decoding import RecordBoundary
from stereoservo.messages.files import read_bounded, set_aside, write_atomically


def check_and_remember(
    check: TrialData, model_path: Path, history_path: Path, limit_px: float, body_moves: bool = False
) -> tuple[ModelExamination, CheckReport]:
    """Examine a model, find trends over earlier checks, append the report to the history. ``body_moves``: as of
    `make_check_report`.

    A damaged history is renamed, one that cannot be written is not changed; the report states this. Raises
    ModelFileError, CalibrationError.
    """
    model = load_model(model_path)
    made_from = trials_file(model_path, model.epoch)
    created = datetime.now(UTC).isoformat(timespec="seconds")
    notes, trials = [], None
    try:
        trials = load_trials(made_from) if made_from.exists() else None
    except CalibrationError as error:
        notes.append(f"checked without the model's own trial data: {error}")
    examined = examine_model(model, check, made_from=trials)
    report = make_check_report(examined, limit_px=limit_px, created=created, body_moves=body_moves)
    history, lost = load_checks(history_path)
    grown = find_trend([*history, report])
    notes += [] if grown is None else [grown.message]
    if lost:
        notes.append(f"{lost} earlier checks in {history_path} could not be read: {set_aside(history_path)}")
    report = msgspec.structs.replace(report, trend="; ".join(notes))
    try:
        save_checks(history_path, [*history, report])
    except OSError as error:  # the result of the check is valid nevertheless
        report = msgspec.structs.replace(
            report, trend="; ".join([*notes, f"the check is not stored: {error.strerror}"])
        )
    return examined, report


def reset_and_save(examined: ModelExamination, report: CheckReport, path: Path, epoch: int) -> ZeroReset:
    """Save the model with corrected joint zeros. Raises CalibrationError, ModelFileError, OSError."""
    model, reset = reset_zeros(examined, report, epoch=epoch, created=report.created)
    save_model(model, path)
    return msgspec.structs.replace(reset, model=str(path))


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.daemon.jobs.check_job", description=__doc__)
    parser.add_argument("check", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("history", type=Path)
    parser.add_argument("--limit-px", type=float, required=True)
    parser.add_argument("--body-moves", action="store_true", help="the marker body may stand elsewhere")
    parser.add_argument("--reset-to", type=Path, help="model file for the joint zeros reset")
    parser.add_argument("--epoch", type=int, default=0)
    arguments = child_arguments(parser)
    try:
        examined, report = check_and_remember(
            load_trials(arguments.check), arguments.model, arguments.history, arguments.limit_px, arguments.body_moves
        )
        print_line({"check": msgspec.to_builtins(report)})
        if arguments.reset_to is not None:
            reset = reset_and_save(examined, report, arguments.reset_to, arguments.epoch)
            print_line({"reset": msgspec.to_builtins(reset)})
    except (CalibrationError, ModelFileError, OSError) as error:
        print_line(error_line(error))
        return 1
    return 0


KEPT_CHECKS = 200
MAX_HISTORY_BYTES = 1 << 26


def load_checks(path: Path) -> tuple[list[CheckReport], int]:
    """Reports of the checks stored in ``path`` (empty if there is no file), and the number of unreadable lines."""
    boundary = RecordBoundary(str(path))
    found: list[CheckReport] = []
    lines: list[bytes] = []
    with boundary:
        lines = read_bounded(path, MAX_HISTORY_BYTES).splitlines() if path.exists() else []
    for line in lines:
        with boundary:
            found.append(_decode_check(line))
    return found, boundary.refused


def _decode_check(line: bytes) -> CheckReport:
    """A stored check with numbers that are valid for `find_trend`. May raise any exception."""
    check = msgspec.json.decode(line, type=CheckReport)
    if check.created:
        datetime.fromisoformat(check.created)
    for drift in check.drifts:
        q = len(drift.x)
        if len(drift.information) != q * (q + 1) // 2:
            raise ValueError(f"{len(drift.information)} entries of information for {q} parameters")
    return check


def save_checks(path: Path, checks: list[CheckReport]) -> None:
    """Write the newest ``KEPT_CHECKS`` checks. Raises OSError."""
    write_atomically(path, b"".join(msgspec.json.encode(check) + b"\n" for check in checks[-KEPT_CHECKS:]))


if __name__ == "__main__":
    sys.exit(main())
