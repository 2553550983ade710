"""The checks of a cell, one JSON object a line, oldest first; bounded, and written whole or not at all."""

from __future__ import annotations

from pathlib import Path

import msgspec

from stereoservo.kinematics.calibration.check_report import CheckReport
from stereoservo.kinematics.model import write_atomically

KEPT = 200


def load_checks(path: Path) -> tuple[list[CheckReport], int]:
    """The checks kept in ``path`` (none where there is no file), and how many lines could not be read. Raises
    OSError.
    """
    try:
        lines = path.read_bytes().splitlines()
    except FileNotFoundError:
        return [], 0
    found, lost = [], 0
    for line in lines:
        try:
            found.append(msgspec.json.decode(line, type=CheckReport))
        except msgspec.MsgspecError:
            lost += 1
    return found, lost


def save_checks(path: Path, checks: list[CheckReport]) -> None:
    """Write the newest ``KEPT`` checks. Raises OSError."""
    write_atomically(path, b"".join(msgspec.json.encode(check) + b"\n" for check in checks[-KEPT:]))
