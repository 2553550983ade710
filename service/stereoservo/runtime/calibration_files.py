"""What lies beside a model file: the trial data that it was made from, and its report."""

from __future__ import annotations

from pathlib import Path


def trials_file(model_path: Path, epoch: int) -> Path:
    """The trial data of the calibration with this epoch."""
    return model_path.with_name(f"trials-{epoch:06d}.npz")


def report_folder(model_path: Path) -> Path:
    """The folder of a model's report; its page is ``index.html``."""
    return model_path.with_name(f"{model_path.stem}-report")


def figures_file(model_path: Path) -> Path:
    """The figures of a model's fit, for programs."""
    return model_path.with_name(f"{model_path.stem}-report.json")
