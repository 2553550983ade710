"""Copies of cell files for the demonstration: with emulated drives and cameras at other addresses, with mechanics."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from stereoservo.messages.cell_file import CellFile
from stereoservo_sim.world.presets import MechanicsPreset

HEADING = re.compile(r"^\[", re.MULTILINE)
SOURCE = re.compile(r"^(\s*source\s*=\s*)\"http://127\.0\.0\.1:\d+/", re.MULTILINE)
ANY_SERVER = "http://127.0.0.1:0"
"""Address for emulated cameras: any free port of this host, reported by the emulator."""
ANY_PORT = "socket://127.0.0.1:0"
"""Address for an emulator: any free port of this host, reported by it."""


def has_emulated_drives(cell: CellFile) -> bool:
    """Whether the cell file has a section of emulated drives."""
    return "drives" in cell.emulate


def has_emulated_cameras(cell: CellFile) -> bool:
    """Whether the cell file has a section of emulated cameras."""
    return "cameras" in cell.emulate


def move_to_server(cell_path: Path, folder: Path, channel: str) -> Path:
    """Copy of the cell file in ``folder`` whose cameras of driver ``video`` use the server ``channel``.

    ``channel``: ``http://127.0.0.1:PORT``. Raises ValueError if no camera's ``source`` is an address of this host.
    """
    text = cell_path.read_text(encoding="utf-8")
    changed, count = SOURCE.subn(lambda found: f'{found[1]}"{channel}/', text)
    if count == 0:
        raise ValueError(
            f'{cell_path}: needs cameras with source = "http://127.0.0.1:PORT/…", to be run with emulated cameras'
        )
    return _written(changed, cell_path, folder)


def move_to_channel(cell_path: Path, folder: Path, channel: str) -> Path:
    """Copy of the cell file in ``folder`` whose joint driver uses ``channel``; ``eds`` remains the same file.

    Raises ValueError if the file has no ``[joints.options]`` with a ``channel``.
    """
    text = cell_path.read_text(encoding="utf-8")
    text = _replaced(text, "channel", channel, cell_path)
    return _written(_with_its_files(text, cell_path), cell_path, folder)


def with_mechanics(cell_path: Path, folder: Path, preset: MechanicsPreset) -> Path:
    """Copy of the cell file in ``folder`` whose simulated arm, or emulated drives, have the mechanics ``preset``.

    Raises ValueError if the cell has neither, or its file states them in a form that cannot be replaced.
    """
    text = cell_path.read_text(encoding="utf-8")
    tree = tomllib.loads(text)
    emulated = "drives" in tree.get("emulate", {})
    driver = tree["joints"]["driver"]
    if not emulated and driver not in ("fake", "pybullet", "twist"):
        raise ValueError(f"{cell_path}: joints.driver is {driver!r}; only simulated arms have a choice of mechanics")
    section = "emulate.drives" if emulated else "joints.options"
    line = f'mechanics = "{preset}"'
    heading = re.search(rf"^\[{re.escape(section)}\][^\n]*\n", text, re.MULTILINE)
    if heading is None:
        text = f"{text.rstrip()}\n\n[{section}]\n{line}\n"
    else:
        end = HEADING.search(text, heading.end())
        body = text[heading.end() : end.start() if end else len(text)]
        body = re.sub(r"^\s*mechanics\s*=\s*[\"'][^\n]*\n", "", body, flags=re.MULTILINE)
        text = f"{text[: heading.end()]}{line}\n{body}{text[end.start() :] if end else ''}"
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(
            f"{cell_path}: mechanics cannot be put into [{section}] ({error}): state them as one line there"
        ) from error
    return _written(_with_its_files(text, cell_path), cell_path, folder)


def _with_its_files(text: str, cell_path: Path) -> str:
    """``text`` of a cell file with its relative paths (EDS, URDF) made absolute."""
    tree = tomllib.loads(text)
    eds = tree["joints"].get("options", {}).get("eds", "")
    if eds:
        text = _replaced(text, "eds", str(cell_path.parent.absolute() / eds), cell_path)
    drives = tree.get("emulate", {}).get("drives")
    section = "joints.options" if drives is None else "emulate.drives"
    urdf = (tree["joints"].get("options", {}) if drives is None else drives).get("urdf", "")
    own = cell_path.parent.absolute() / urdf
    return _replaced(text, "urdf", str(own), cell_path, section) if urdf and own.is_file() else text


def _written(text: str, cell_path: Path, folder: Path) -> Path:
    copy = folder / cell_path.name
    if copy.absolute() == cell_path.absolute():
        raise ValueError(f"{folder} is the cell file's own directory; another is needed for its copy")
    copy.write_text(text, encoding="utf-8")
    return copy


def _replaced(text: str, key: str, value: str, path: Path, name: str = "joints.options") -> str:
    """``text`` with ``key`` of the section ``name`` set to the string ``value``."""
    section = re.search(rf"^\[{re.escape(name)}\]\s*(?:#.*)?$", text, re.MULTILINE)
    if section is not None:
        end = HEADING.search(text, section.end())
        body = text[section.end() : end.start() if end else len(text)]
        changed, count = re.subn(
            rf"^{key}\s*=\s*(\"[^\"\n]*\"|'[^'\n]*'|\d+)",
            lambda _: f'{key} = "{value}"',
            body,
            flags=re.MULTILINE,
        )
        if count == 1:
            return text[: section.end()] + changed + (text[end.start() :] if end else "")
    raise ValueError(f"{path}: needs a line `{key} = …` under [{name}], to be run from a copy")
