"""A cell under test: emulated drives and cameras in processes of their own, or, by ``--hil``, real ones."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from stereoservo.client import Client, ClientError
from stereoservo.messages.cell_file import load_cell_file
from stereoservo.messages.directories import CellDirectories, cell_directories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.demonstration.emulated import ANY_PORT, ANY_SERVER, move_to_channel, move_to_server
from stereoservo_sim.emulators.emulator_process import EmulatorProcess
from stereoservo_sim.world.history import FILE_NAME, TrueJointHistory

from .conftest import WAIT_S, at_rest, eventually

RESTS_S = 0.2
STANDS = 2e-4
"""[rad] Rigid bodies that hold their place move less in ``RESTS_S``."""
RANGE = 0.15
GRIPPER = """
[[joints.options.gripper]]
name = "claw"
node_id = 9
counts_per_rev = 1000
gear_ratio = 100.0
velocity = 0.1
acceleration = 0.5
quick_stop_deceleration = 1.0
position_min = 0.0
position_max = 0.08

"""
"""On a drive of its own; it begins open."""


def cell_text(name: str, *, joints: str = "", drives: str = "") -> str:
    """The shipped cell of CAN drives and MJPEG cameras as ``name``, before a plain background and with a quick
    calibration. ``joints``: another ``[joints]`` section instead of the CAN bus. ``drives``: of ``[emulate.drives]``.
    """
    text = shipped_cell_path("hil-video").read_text(encoding="utf-8")
    head, _, tail = text.partition("# Trial motions")
    base = tail[tail.index("base = {") :].partition("\n")[0]
    ranges = ", ".join(f"j{k} = {RANGE}" for k in range(1, 7))
    # On a busy machine pictures and samples of the joints come late: calibration waits for them.
    speed = f"stops = 4\nframes = 2\nsettle_s = 0.05\nwait_s = {WAIT_S}\n"
    calibration = f"[calibration]\n{base}\nrange = {{ {ranges} }}\n{speed}"
    head = head.replace('name = "hil-video"', f'name = "{name}"', 1)
    head = re.sub(r'(?m)^background = "pybullet"', 'background = "plain"', head)
    if drives:
        head = head.replace("[emulate.drives]\n", f"[emulate.drives]\n{drives}\n", 1)
    if not joints:
        head = head.replace("[emulate.drives]\n", f"{GRIPPER}[emulate.drives]\n", 1)
    else:
        front, cameras = head.index("[joints]"), head.index("[emulate.cameras]")
        head = f"{head[:front]}{joints}\n{head[cameras:]}"
    assert "joint_timeout_s = 0.1\n" in head
    head = head.replace("joint_timeout_s = 0.1\n", "joint_timeout_s = 0.4\n", 1)
    return f"{head}\n{calibration}"


@dataclass
class CanBench:
    """Daemon, drives and cameras, and what a test does with them.

    ``emulator``, ``cameras``: those of drives and cameras; None on hardware, or where the cell needs none.
    """

    cell: Path
    logs: Path
    emulator: EmulatorProcess | None
    cameras: EmulatorProcess | None = None
    daemon: DaemonProcess | None = None
    starts: int = 0
    name: str = field(init=False)

    def __post_init__(self) -> None:
        self.name = load_cell_file(self.cell).cell.name

    @classmethod
    def emulated(cls, folder: Path, *, joints: str = "", drives: str = "") -> CanBench:
        """Emulated drives and cameras on free ports, no daemon yet; the cell has the folder's name.

        ``joints``: another ``[joints]`` section instead of the CAN bus. ``drives``: lines of ``[emulate.drives]``.
        """
        shutil.rmtree(folder, ignore_errors=True)  # of a fixture that failed, and is tried again
        for made in (folder, folder / "bus", folder / "streams"):
            made.mkdir()
        path = folder / "cell.toml"
        path.write_text(cell_text(folder.name, joints=joints, drives=drives), encoding="utf-8")
        cameras = EmulatorProcess(path, what="cameras", options=("--channel", ANY_SERVER), log=folder / "cameras.log")
        emulator = None
        if not joints:
            emulator = EmulatorProcess(path, options=("--channel", ANY_PORT), log=folder / "drives-0.log")
            path = move_to_channel(path, folder / "bus", emulator.wait_ready())
        path = move_to_server(path, folder / "streams", cameras.wait_ready())
        return cls(path, folder, emulator, cameras)

    @property
    def directories(self) -> CellDirectories:
        """Where the cell lives."""
        return cell_directories(self.name)

    def start_daemon(self) -> DaemonProcess:
        """A daemon of the cell; the one before must have ended."""
        self.starts += 1
        self.daemon = DaemonProcess(self.cell, log=self.logs / f"daemon-{self.starts}.log")
        self.daemon.wait_ready()
        return self.daemon

    def restart_drives(self) -> None:
        """Emulated drives anew on the same channel, where the arm was left."""
        self.emulator = EmulatorProcess(self.cell, log=self.logs / f"drives-{self.starts}-again.log")
        self.emulator.wait_ready()

    def end(self) -> None:
        """End what was started."""
        if self.daemon is not None:
            self.daemon.stop()
        for process in (self.emulator, self.cameras):
            if process is not None:
                process.stop()

    def needs_emulated_drives(self, why: str) -> None:
        """Skip the test on hardware."""
        if self.emulator is None:
            pytest.skip(f"needs emulated drives: {why}")

    def order(self, text: str) -> str:
        """A fault of the emulated drives."""
        assert self.emulator is not None
        return self.emulator.order(text)

    # -- the truth ------------------------------------------------------------------------------------------

    def truth(self) -> tuple[int, np.ndarray]:
        """When and where the emulated arm was last recorded, (n,) [rad]."""
        history = TrueJointHistory.open(self.directories.runtime / FILE_NAME)
        try:
            newest = history.newest()
        finally:
            history.close()
        assert newest is not None
        return newest[0], newest[1]

    def stands(self) -> bool:
        """Whether the arm stands: by the truth where drives are emulated, else by its encoders."""
        before = self._where()
        time.sleep(RESTS_S)
        return bool(np.abs(self._where() - before).max() < STANDS)

    def _where(self) -> np.ndarray:
        if self.emulator is not None:
            return self.truth()[1]
        with Client(self.name) as client:
            return np.array(list(client.status().joints.values()))

    def told(self, kind: str, after_ns: int) -> bool:
        """Whether the emulator has told of ``kind`` after a time."""
        assert self.emulator is not None
        return any(event["event"] == kind and event["t_ns"] > after_ns for event in list(self.emulator.events))


def codes(client: Client) -> str:
    """What the cell's reasons say, in one text."""
    return "; ".join(f"{reason.code} {reason.hint}" for reason in client.status().reasons)


def lifecycle(client: Client, wanted: str) -> Callable[[], bool]:
    """Whether the cell is in that state."""
    return lambda: client.status().lifecycle == wanted


def moving(bench: CanBench, client: Client) -> None:
    """The arm on its way: its first and fourth joint through half a radian, or a twentieth on hardware."""
    joints = client.status().joints
    share = 1.0 if bench.emulator is not None else 0.1
    names = list(joints)
    first, fourth = names[0], names[min(3, len(names) - 1)]
    sign = -1.0 if joints[first] > 0.1 else 1.0
    ways = {fourth: 0.9, first: 0.6}
    client.goal({name: joints[name] + way * sign * share for name, way in ways.items()}).abandon()
    eventually("the arm moves", lambda: not at_rest(client))


def reset_is_refused(client: Client) -> None:
    """A reset is tried and the fault stays, as long as its cause does."""
    with pytest.raises(ClientError, match="the reset failed"):
        client.reset()
    for _ in range(10):
        assert client.status().lifecycle == "fault"
        time.sleep(0.1)
