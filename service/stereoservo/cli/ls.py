"""Command ``stereoservo ls``: lists the cells of this user whose daemons run on this host."""

from __future__ import annotations

from stereoservo.cli.output import JsonOption, emit
from stereoservo.messages.discovery import live_cells


def ls(json: JsonOption = False) -> None:
    """List the live cells of this user on this host."""
    cells = live_cells()
    text = "\n".join(f"{info.cell:24} process {info.pid:<8} {info.endpoint}  {info.cell_path}" for info in cells)
    emit({"cells": cells}, text or "no live cell", json)
