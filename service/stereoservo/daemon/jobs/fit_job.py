"""Fit job (own process, low priority): fits a model to trial data, prints progress, and writes the model file and its
report.

``python -m stereoservo.daemon.jobs.fit_job TRIALS.npz MODEL.json --epoch N`` prints one JSON object a line:
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

from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.fit_assessment import Acceptance, assess_failure, assess_fit, depth_deviation
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError, TrialData, figures_file, load_trials, report_folder
from stereoservo.control.marker_groups import with_groups
from stereoservo.daemon.process_control import die_with_parent
from stereoservo.geometry.distortion import LensEstimate
from stereoservo.kinematics.model import ModelFileError, save_model
from stereoservo.messages.files import write_atomically

NICENESS = 10


def print_line(line: dict[str, Any]) -> None:
    """Print one JSON object to stdout."""
    sys.stdout.write(msgspec.json.encode(line, enc_hook=_plain).decode() + "\n")
    sys.stdout.flush()


def error_line(error: Exception) -> dict[str, Any]:
    """An error as a JSON line: its code, its text and its data."""
    if isinstance(error, CalibrationError):
        return {"error": {"code": error.code, "message": str(error), "data": error.data}}
    return {"error": {"code": type(error).__name__, "message": str(error), "data": {}}}


def child_arguments(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parse the arguments of this process, lower its priority, and make it die with its ``--parent``, if given."""
    parser.add_argument("--parent", type=int, default=0, help="end with this process")
    arguments = parser.parse_args()
    if arguments.parent:
        die_with_parent(arguments.parent, signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICENESS)
    return arguments


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
) -> tuple[CalibrationFit, Acceptance]:
    """Fit trial data, save the model and the fit's figures; returns the fit and its assessment.

    Raises CalibrationError, ModelFileError, OSError.
    """
    created = datetime.now(UTC).isoformat(timespec="seconds")
    result = fit_model(trials, epoch=epoch, created=created, progress=progress, lens_priors=lens_priors)
    figures = msgspec.json.format(msgspec.json.encode(result.report), indent=1) + b"\n"
    write_atomically(figures_file(model_path), figures)
    # Last: an existing model file is used from the next start on, even if the fit then fails because of a full disk.
    save_model(with_groups(result.model), model_path)
    return result, assess_fit(result.model, result.report, depth_deviation(result.model, trials))


def report_fit(
    trials: TrialData,
    trials_path: Path,
    model_path: Path,
    result: CalibrationFit | None,
    assessment: Acceptance,
    known_length: str = "",
) -> Path:
    """Write the report of a fit, or of a failure (``result`` None), beside the model. Raises OSError."""
    # matplotlib is slow to import; the model must not wait for it.
    from stereoservo.daemon.jobs.calibration_report import write_report

    return write_report(
        report_folder(model_path),
        trials,
        assessment,
        trials_path=trials_path,
        model=None if result is None else result.model,
        report=None if result is None else result.report,
        known_length=known_length,
    )


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.daemon.jobs.fit_job", description=__doc__)
    parser.add_argument("trials", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("--epoch", type=int, required=True)
    parser.add_argument("--known-length", default="", help="WHAT:OF=METRES, for the report")
    arguments = child_arguments(parser)
    result: CalibrationFit | None = None
    try:
        trials = load_trials(arguments.trials)
    except CalibrationError as error:
        print_line(error_line(error))
        return 1
    try:
        result, assessment = fit_trials(trials, arguments.model, arguments.epoch, progress=_progress)
        print_line(
            {
                "model": str(arguments.model),
                "epoch": arguments.epoch,
                "verdict": msgspec.to_builtins(assessment),
            }
        )
    except CalibrationError as error:
        print_line(error_line(error))
        assessment = assess_failure(error.code, error.message)
    except (ModelFileError, OSError) as error:
        print_line(error_line(error))
        return 1
    try:
        page = report_fit(trials, arguments.trials, arguments.model, result, assessment, arguments.known_length)
        print_line({"report": str(page)})
    except OSError as error:
        print_line({"report_error": str(error)})
    return 0 if result is not None else 1


if __name__ == "__main__":
    sys.exit(main())
