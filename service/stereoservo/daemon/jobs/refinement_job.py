"""Refinement job (own process, low priority): refines a calibrated model by rest poses.

``python -m stereoservo.daemon.jobs.refinement_job POSES.npz BASE.json USED.json NEW.json`` prints one JSON object:
``{"refined": …}`` once the new model, of epoch 0, is saved, or ``{"error": …}`` with exit code 1.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from stereoservo.calibration.change.refinement import refine_model
from stereoservo.calibration.trial_data import CalibrationError, load_trials
from stereoservo.daemon.jobs.fit_job import child_arguments, error_line, print_line
from stereoservo.kinematics.model import ModelFileError, load_model, save_model


def main() -> int:
    """Entry of the process."""
    parser = argparse.ArgumentParser(prog="python -m stereoservo.daemon.jobs.refinement_job", description=__doc__)
    parser.add_argument("poses", type=Path)
    parser.add_argument("base", type=Path)
    parser.add_argument("used", type=Path)
    parser.add_argument("new", type=Path)
    arguments = child_arguments(parser)
    try:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        model, report = refine_model(
            load_model(arguments.base), load_trials(arguments.poses), used=load_model(arguments.used), created=created
        )
        save_model(model, arguments.new)
    except (CalibrationError, ModelFileError, OSError) as error:
        print_line(error_line(error))
        return 1
    print_line({"refined": msgspec.to_builtins(report)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
