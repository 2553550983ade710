"""The fit process: trial data in, model file out, then a report; short-lived and niced: the loop does not feel it.

``python -m stereoservo.runtime.fit TRIALS.npz MODEL.json --epoch N`` prints one JSON object a line:
``{"progress": …, "message": …}``, then ``{"model": …, "verdict": …}`` or ``{"error": …}``, and last ``{"report": …}``
or ``{"report_error": …}``. Exit code 1 where there is no model.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.geometry.distortion_lines import LensEstimate
from stereoservo.kinematics.calibration.fit import fit_model
from stereoservo.kinematics.calibration.report import CalibrationResult
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData, load_trials
from stereoservo.kinematics.calibration.verdict import Verdict, depth_spread, failed, verdict
from stereoservo.kinematics.model import ModelFileError, save_model, write_atomically
from stereoservo.runtime.calibration_files import figures_file, report_folder
from stereoservo.runtime.lifeline import die_with_parent

NICENESS = 10


def print_line(line: dict[str, Any]) -> None:
    """One JSON object on stdout."""
    sys.stdout.write(msgspec.json.encode(line, enc_hook=_plain).decode() + "\n")
    sys.stdout.flush()


def error_line(error: Exception) -> dict[str, Any]:
    """An error as a line: its code, its text and the values that it speaks of."""
    if isinstance(error, CalibrationError):
        return {"error": {"code": error.code, "message": str(error), "data": error.data}}
    return {"error": {"code": type(error).__name__, "message": str(error), "data": {}}}


def become_child(parent: int) -> None:
    """Nice, and gone with ``parent`` where there is one."""
    if parent:
        die_with_parent(parent, signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)


def _plain(value: object) -> object:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return str(value)


def _progress(stage: str, fraction: float) -> None:
    print_line({"progress": fraction, "message": stage})


def fit_trials(
    trials: TrialData,
    model_path: Path,
    epoch: int,
    *,
    progress: Callable[[str, float], None] | None = None,
    lens_priors: Mapping[str, LensEstimate] | None = None,
) -> tuple[CalibrationResult, Verdict]:
    """Fit trial data and save the model and the fit's figures; what is to be said of it.

    Raises CalibrationError, ModelFileError, OSError.
    """
    created = datetime.now(UTC).isoformat(timespec="seconds")
    result = fit_model(trials, epoch=epoch, created=created, progress=progress, lens_priors=lens_priors)
    save_model(result.model, model_path)
    figures = msgspec.json.format(msgspec.json.encode(result.report), indent=1) + b"\n"
    write_atomically(figures_file(model_path), figures)
    return result, verdict(result.model, result.report, depth_spread(result.model, trials))


def report_fit(
    trials: TrialData, trials_path: Path, model_path: Path, result: CalibrationResult | None, said: Verdict
) -> Path:
    """Write the report of a fit, or of a failure (``result`` None), beside the model. Raises OSError."""
    # matplotlib is slow to import; the model must not wait for it.
    from stereoservo.runtime.calibration_report import write_report

    return write_report(
        report_folder(model_path), trials, said, trials_path=trials_path,
        model=None if result is None else result.model, report=None if result is None else result.report,
    )  # fmt: skip


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.runtime.fit", description=__doc__)
    parser.add_argument("trials", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("--epoch", type=int, required=True)
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    arguments = parser.parse_args()
    become_child(arguments.parent)
    result: CalibrationResult | None = None
    try:
        trials = load_trials(arguments.trials)
    except CalibrationError as error:
        print_line(error_line(error))
        return 1
    try:
        result, said = fit_trials(trials, arguments.model, arguments.epoch, progress=_progress)
        print_line(
            {"model": str(arguments.model), "epoch": arguments.epoch, "verdict": msgspec.to_builtins(said)}
        )
    except CalibrationError as error:
        print_line(error_line(error))
        said = failed(error.code, error.message)
    except (ModelFileError, OSError) as error:
        print_line(error_line(error))
        return 1
    try:
        print_line({"report": str(report_fit(trials, arguments.trials, arguments.model, result, said))})
    except OSError as error:
        print_line({"report_error": str(error)})
    return 0 if result is not None else 1


if __name__ == "__main__":
    sys.exit(main())
