"""A daemon whose files are damaged comes up, says so, and can be asked, enabled and stopped; a gateway that dies finds
its files damaged and goes on.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from stereoservo.client import Client
from stereoservo.client.errors import ClientError
from stereoservo.client.session import SessionError
from stereoservo.kinematics.model import load_model
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import DaemonProcess, NotRunningError

from .conftest import CELL, at_rest, eventually, processes

pytestmark = pytest.mark.process

Start = Callable[..., DaemonProcess]


def damage(path: Path) -> bytes:
    """Flip a byte in the middle of a file; returns what is there then."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))
    return bytes(data)


def newest_model(directories: CellDirectories) -> Path:
    return max(directories.models.glob("model-??????.json"))


def test_a_cell_with_damaged_files_starts_and_says_so(
    kept_state: None, calibrated: Path, start: Start, directories: CellDirectories
) -> None:
    good = newest_model(directories)
    model = load_model(good)
    later = good.with_name(f"model-{model.epoch + 1:06d}.json")
    later.write_bytes(good.read_bytes())
    damaged = damage(later)
    taught = directories.taught.read_bytes()[:-20]
    directories.taught.write_bytes(taught)
    start(calibrated)
    with Client(CELL) as client:
        eventually("the model", lambda: client.status().model_epoch == model.epoch)
        notes = client.status().notes
        assert len(notes) == 2
        assert any(later.name in note and "is used instead" in note for note in notes)
        assert any("taught.json" in note and "set aside" in note for note in notes)
        warnings = [event.message for event in client.events().events if event.kind == "warning"]
        assert sorted(warnings) == sorted(notes)
        assert client.info().taught == ()
        client.enable()
        assert client.goal({"j1": client.status().joints["j1"] + 0.02}).reached(60.0).outcome == "reached"
        client.teach("park", frames=2)
        assert [goal.name for goal in client.info().taught] == ["park"]
        assert client.stop().accepted
    assert later.with_name(f"{later.name}.damaged-1").read_bytes() == damaged
    assert directories.taught.with_name("taught.json.damaged-1").read_bytes() == taught


def test_a_cell_without_a_good_model_starts_uncalibrated(
    kept_state: None, calibrated: Path, start: Start, directories: CellDirectories
) -> None:
    for path in directories.models.glob("model-??????.json"):
        path.write_bytes(b"")
    start(calibrated)
    with Client(CELL) as client:
        eventually("notes", lambda: client.status().notes)
        assert client.status().model == "none"
        client.enable()
        assert client.goal({"j1": client.status().joints["j1"] + 0.02}).reached(60.0).outcome == "reached"
        assert client.stop().accepted


def test_a_gateway_that_dies_and_finds_its_files_damaged_goes_on(
    kept_state: None, calibrated: Path, start: Start, directories: CellDirectories
) -> None:
    start(calibrated)
    with Client(CELL) as client:
        client.enable()
        client.teach("here", frames=2)
        boot = client.status().boot
    handled = directories.runtime / "handled.slot"
    assert handled.exists()
    plan = directories.runtime / "plan.msgpack"
    slot = directories.observation_slot("left")
    gateway = processes(directories)["gateway"]
    os.kill(gateway, signal.SIGSTOP)
    with handled.open("r+b") as file:
        file.write(b"\xff" * handled.stat().st_size)
    plan.write_bytes(b"\xff" * 10)
    with slot.open("r+b") as file:
        file.write(b"\xff" * 24)
    os.kill(gateway, signal.SIGKILL)

    def back() -> bool:
        try:
            with Client(CELL) as client:
                state = client.status()
                return state.boot != boot and bool(state.notes)
        except (ClientError, NotRunningError, SessionError):
            return False

    eventually("the gateway is back", back, 60.0)
    with Client(CELL) as client:
        assert any("handled.slot: was damaged and is started empty" in note for note in client.status().notes)

        def told(words: str) -> bool:
            return any(words in event.message for event in client.events().events if event.kind == "warning")

        # The supervisor tells these as soon as the new gateway listens to it.
        for words in ("run plan was damaged", "observation-left.slot"):
            eventually(words, partial(told, words))
        assert [goal.name for goal in client.info().taught] == ["here", "park"]
        eventually("features", lambda: sum(client.status().visible.values()) > 0)
        assert at_rest(client)
        assert client.stop().accepted


def test_a_disk_that_is_full_refuses_to_teach_and_ends_nothing(
    kept_state: None, calibrated: Path, start: Start, directories: CellDirectories
) -> None:
    """A folder in the place of each file that is written: no user can write there, not even root."""
    start(calibrated)
    before = processes(directories)
    with Client(CELL) as client:
        client.enable()
        directories.taught.rename(directories.taught.with_name("aside"))
        directories.taught.mkdir()
        with pytest.raises(ClientError, match=r"not saved: .*Is a directory"):
            client.teach("here", frames=2)
        assert [goal.name for goal in client.info().taught] == ["park"]
        directories.recordings.rename(directories.recordings.with_name("old recordings"))
        directories.recordings.write_text("no folder")
        client.record()
        eventually("a note", lambda: any("no recording" in note for note in client.status().notes))
        directories.recordings.unlink()
        client.record(on=False)
        client.record()
        eventually("a recording", lambda: client.info().recording)
        assert not any("no recording" in note for note in client.status().notes)
        client.record(on=False)
        assert client.stop().accepted
    assert processes(directories) == before
