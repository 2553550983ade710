"""Cell files of the simulated cell, shipped with the package."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

ARMS = ("panda", "iiwa", "xarm", "scara", "gantry", "pan_tilt", "rx90", "twist")
"""Names of cells of other arms, each with a URDF file and a searched layout; ``twist``: with Cartesian velocities."""
CELLS = ("demo", "wide", "eye_in_hand", "workpiece", "conveyor", "edges", "hil-can", "hil-video", *ARMS)
"""Names of shipped cells: the embedded cell; with lens distortion; with the cameras on the arm; with a workpiece beside
the body; with the cameras on the arm before a conveyor; with a part without markers, by its edges; the embedded cell on
a CAN bus; the same with cameras that are HTTP streams; those of other arms.
"""


def shipped_cell_path(name: str) -> Path:
    """Path of a shipped cell file in the installed package. Raises ValueError if there is none of that name."""
    if name not in CELLS:
        raise ValueError(f"no cell {name!r} is shipped; there are {', '.join(CELLS)} (or give a .toml file)")
    with as_file(files(__package__).joinpath(f"{name}.toml")) as path:
        return path


def demo_cell_path() -> Path:
    """Path of the demo's cell file in the installed package."""
    return shipped_cell_path("demo")
