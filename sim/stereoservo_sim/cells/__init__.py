"""Cell files of the simulated cell, shipped with the package."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

DEMO = "demo.toml"


def demo_cell_text() -> str:
    """The demo's cell file as text."""
    return files(__package__).joinpath(DEMO).read_text(encoding="utf-8")


def demo_cell_path() -> Path:
    """Path of the demo's cell file in the installed package."""
    with as_file(files(__package__).joinpath(DEMO)) as path:
        return path
