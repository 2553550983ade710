"""The demonstration on a CAN cell: what is refused, and the copy of the cell file that speaks to emulated drives."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.emulated import move_to_channel

CELL = shipped_cell_path("hil-can")


def refused(*options: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "stereoservo.cli.main", "demo", *options],
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode == 2
    return " ".join(done.stderr.replace("│", " ").split())


def test_lockstep_is_refused_for_a_bus_in_real_time(tmp_path: Path) -> None:
    message = refused("--cell", "hil-can", "--lockstep", "--out", str(tmp_path / "out"))
    assert "runs in real time" in message
    assert "leave --lockstep out" in message
    assert not (tmp_path / "out").exists()


def test_a_cell_of_real_drives_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "real.toml"
    text = CELL.read_text()
    assert text.count("[emulate.drives]\n") == 1
    path.write_text(text.replace("[emulate.drives]\n", "[emulate.nothing]\n"))
    assert "needs emulated drives" in refused("--cell", str(path), "--out", str(tmp_path / "out"))


def test_only_the_channel_differs_in_the_copy(tmp_path: Path) -> None:
    copy = move_to_channel(CELL, tmp_path, "socket://127.0.0.1:7001")
    before, after = tomllib.loads(CELL.read_text()), tomllib.loads(copy.read_text())
    assert after["joints"]["options"].pop("channel") == "socket://127.0.0.1:7001"
    assert before["joints"]["options"].pop("channel") == "socket://127.0.0.1:5400"
    assert after == before


def test_an_eds_file_beside_the_cell_file_is_still_found(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    text = CELL.read_text()
    assert "[joints.options]\n" in text
    path.write_text(text.replace("[joints.options]\n", '[joints.options]\neds = "my.eds"\n'))
    (tmp_path / "copy").mkdir()
    copy = move_to_channel(path, tmp_path / "copy", "socket://127.0.0.1:7001")
    assert tomllib.loads(copy.read_text())["joints"]["options"]["eds"] == str(tmp_path / "my.eds")
    with pytest.raises(ValueError, match="another is needed"):
        move_to_channel(path, tmp_path, "x")
    path.write_text(text.replace("channel = ", "canal = "))
    with pytest.raises(ValueError, match=r"needs a line `channel = …` under \[joints\.options\]"):
        move_to_channel(path, tmp_path / "copy", "x")
