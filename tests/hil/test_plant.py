"""The simulated drives as a process of their own: what the servo process maps, and the death of the plant."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from stereoservo.cli.status import describe
from stereoservo.client import Client, ClientError
from stereoservo.daemon.plant_driver import PLANT_STATE_LAYOUT
from stereoservo.daemon.seqlock import SlotReader
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.servo_state import STALE_S
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory

from .conftest import CELL, eventually, processes

pytestmark = pytest.mark.process


def test_a_killed_plant_is_a_fault_that_is_named_and_comes_back_where_it_was(
    cell_file: Path, start: Callable[..., DaemonProcess], directories: CellDirectories
) -> None:
    path = cell_file.with_name("physical.toml")
    path.write_text(cell_file.read_text().replace('driver = "fake"\n[joints', 'driver = "pybullet"\n[joints', 1))
    daemon = start(path)
    found = processes(directories)
    assert "pybullet" in Path(f"/proc/{found['plant']}/maps").read_text()
    assert "pybullet" not in Path(f"/proc/{found['servo']}/maps").read_text()
    with Client(CELL) as client:
        client.enable()
        at = client.status().joints["j1"]
        client.goal({"j1": at + 0.5}, speed_scale=0.3).abandon()
        eventually("the arm moves", lambda: client.status().joints["j1"] > at + 0.02)
        os.kill(found["plant"], signal.SIGKILL)

        def told(kind: str, text: str) -> bool:
            return any(event.kind == kind and text in event.message for event in client.events(1).events)

        eventually("the fault", lambda: told("fault", "the process of the simulated drives ended"))
        eventually("the report", lambda: told("process_ended", "plant ended by signal SIGKILL"))
        assert client.status().lifecycle == "fault"
        assert any(reason.level == "fault" for reason in client.status().reasons)
        eventually("its joints are unknown", lambda: not client.status().joints)
        state = client.status()
        assert state.velocities == {}, "and no speed is shown"
        assert state.joints_age_s is not None
        assert state.joints_age_s > STALE_S
        assert "joints  unknown: no sample for" in describe(state)
        with pytest.raises(ClientError, match="where the joints are is unknown"):
            client.joints()
        with SlotReader(directories.plant_state_slot, PLANT_STATE_LAYOUT) as slot:
            eventually("a new plant", lambda: slot.writer_pid != found["plant"], 60.0)
        assert processes(directories)["plant"] != found["plant"]
        assert processes(directories)["servo"] == found["servo"]
        stopped = TrueJointHistory.open(directories.runtime / FILE_NAME).newest()
        assert stopped is not None
        client.reset()
        eventually("the reset", lambda: client.status().lifecycle == "inactive")
        assert client.status().joints["j1"] == pytest.approx(stopped[1][0], abs=1e-3)
        client.enable()
        client.resume()
        client.goal({"j1": at}).reached(60.0)
    assert daemon.stop() == 0
