"""A real daemon on the fake cell: separate processes, zenoh on a unix socket, real time."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from stereoservo.cli import main as cli
from stereoservo.client import Client
from stereoservo.kinematics.model import CellModel, save_model
from stereoservo.messages.directories import CellDirectories, cell_directories, create_directories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo_sim.benchmarks.service_bench import processes_of
from stereoservo_sim.cells import shipped_cell_path

AUXILIARY = (
    '[{ name = "gripper", kind = "prismatic", low = 0.0, high = 0.08, velocity = 0.1 }, '
    '{ name = "light", kind = "digital" }]'
)
CELL = "hil"
ROOM = 1 << 29
"""Of a file system in memory, to be used [bytes]."""
WAIT_S = 20.0
"""For pictures at a stop of a calibration: cameras of a busy machine may be late."""
QUICK_CALIBRATION = f"""
[calibration]
stops = 5
frames = 2
settle_s = 0.05
wait_s = {WAIT_S}
"""
PATIENCE_S = 60.0
"""For what a busy machine does late; how long it takes is not judged."""


def eventually(what: str, wanted: Callable[[], object], timeout_s: float = PATIENCE_S) -> None:
    """Wait until ``wanted`` is true; how long it takes is not judged, only that it happens."""
    until = time.monotonic() + timeout_s
    while not wanted():
        if time.monotonic() > until:
            raise AssertionError(f"never happened: {what}")
        time.sleep(0.05)


def processes(directories: CellDirectories) -> dict[str, int]:
    """Live processes of a cell by what they are."""
    return processes_of(directories.runtime)


@pytest.fixture(scope="session")
def roots(request: pytest.FixtureRequest) -> Iterator[Path]:
    """Short directories of their own (a socket's path is limited) for everything that these tests start.

    On hardware (``--hil``) the runtime directory is the user's: its locks keep two daemons off one arm. Else it is in
    memory, as that of a service is, where there is room: processes that share pages of it do not wait for a disk.
    """
    root = Path(tempfile.mkdtemp(prefix="sshil", dir="/tmp"))
    memory = Path("/dev/shm")
    roomy = os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > ROOM
    runtime = Path(tempfile.mkdtemp(prefix="sshil", dir=memory if roomy else root))
    before = {key: os.environ.get(key) for key in ("STEREOSERVO_RUNTIME_DIR", "STEREOSERVO_STATE_DIR")}
    if request.config.getoption("--hil") is None:
        os.environ["STEREOSERVO_RUNTIME_DIR"] = str(runtime)
    os.environ["STEREOSERVO_STATE_DIR"] = str(root / "s")
    yield root
    for key, value in before.items():
        if value is None:
            os.environ.pop(key, None)
        else:
            os.environ[key] = value
    shutil.rmtree(runtime)
    shutil.rmtree(root)


@pytest.fixture(scope="session", autouse=True)
def compiled_kernels() -> None:
    """A first start refuses goals in the images until all is compiled; these tests begin with the second."""
    assert cli.invoke(["warmup"]) == 0


@pytest.fixture(scope="session")
def cell_file(roots: Path) -> Path:
    """The fake cell, with a quick calibration around the simulated cell's base."""
    from stereoservo_sim.world.simulated_cell import demo_cell

    path = roots / f"{CELL}.toml"
    assert cli.invoke(["init", str(path)]) == 0
    head = path.read_text().partition("# Trial motions")[0]
    # On a shared machine a loop may stand for more than the 0.1 s that drives wait by default.
    head, found, rest = head.partition("# [joints.options]")
    assert found
    head += f"[joints.options]\ncommand_timeout_s = 0.4\nauxiliary = {AUXILIARY}\n{found}{rest}"
    world = demo_cell()
    names = [joint.name for joint in world.robot.joints]
    base = "\n".join(f"{name} = {float(q)!r}" for name, q in zip(names, world.base, strict=True))
    ranges = "\n".join(f"{name} = 0.15" for name in names)
    path.write_text(f"{head}{QUICK_CALIBRATION}\n[calibration.base]\n{base}\n\n[calibration.range]\n{ranges}\n")
    return path


@pytest.fixture(scope="session")
def directories(cell_file: Path) -> CellDirectories:
    """Where the cell lives."""
    return cell_directories(CELL)


@pytest.fixture(scope="session")
def calibrated(cell_file: Path, roots: Path) -> Path:
    """The cell file of a cell that has calibrated itself and knows a goal, ``park``, shown at its base."""
    with DaemonProcess(cell_file, log=roots / "calibrate.log") as daemon:
        daemon.wait_ready()
        with Client(CELL) as client:
            client.enable(timeout_s=PATIENCE_S)
            result = client.calibrate(timeout_s=300.0)
            assert result.covariance_ok
            client.teach("park", frames=5)
    return cell_file


@contextmanager
def as_before(directories: CellDirectories, aside: Path) -> Iterator[None]:
    """Put the cell's state back, as it was before, when the body ends."""
    saved = shutil.copytree(directories.state, aside / "state")
    yield
    shutil.rmtree(directories.state)
    shutil.copytree(saved, directories.state)


@pytest.fixture
def kept_state(calibrated: Path, directories: CellDirectories, tmp_path: Path) -> Iterator[None]:
    """Puts the calibrated cell's state back after a test that changes its model. To be the first argument."""
    with as_before(directories, tmp_path):
        yield


@pytest.fixture
def start(cell_file: Path, directories: CellDirectories, roots: Path) -> Iterator[Callable[..., DaemonProcess]]:
    """Starts daemons; whatever a test does, they end with it and leave no process behind."""
    started: list[DaemonProcess] = []

    def start_it(path: Path = cell_file, *options: str, ready: bool = True) -> DaemonProcess:
        daemon = DaemonProcess(path, options=options, log=roots / f"run-{len(started)}.log")
        started.append(daemon)
        if ready:
            daemon.wait_ready()
        return daemon

    yield start_it
    for daemon in started:
        daemon.stop()
    eventually("no process is left", lambda: not processes(directories))


@pytest.fixture(scope="module")
def shared(
    calibrated: Path, directories: CellDirectories, roots: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[DaemonProcess]:
    """A daemon of the calibrated cell for all tests of a module that leave it alive; what they taught goes with it."""
    with as_before(directories, tmp_path_factory.mktemp("shared")):
        with DaemonProcess(calibrated, log=roots / "shared.log") as daemon:
            daemon.wait_ready()
            yield daemon
        eventually("no process is left", lambda: not processes(directories))


@pytest.fixture
def client(shared: DaemonProcess) -> Iterator[Client]:
    """A client of it, with the arm enabled, at rest and without a goal."""
    with Client(CELL) as client:
        yield _ready(client)


@pytest.fixture
def live(calibrated: Path, start: Callable[..., DaemonProcess]) -> DaemonProcess:
    """A running daemon of the calibrated cell that a test may end."""
    return start(calibrated)


@pytest.fixture
def own(live: DaemonProcess) -> Iterator[Client]:
    """A client of it."""
    with Client(CELL) as client:
        yield _ready(client)


def recover(client: Client) -> None:
    """Reset where there is a fault, enable, resume where the arm is held: acts of an operator, one by one."""
    if client.status().lifecycle == "fault":
        client.reset(timeout_s=PATIENCE_S)
        eventually("the reset", lambda: client.status().lifecycle == "inactive")
    if client.status().lifecycle != "active":
        client.enable(timeout_s=PATIENCE_S)
    if {reason.code for reason in client.status().reasons} & {"HELD", "STOPPED"}:
        client.resume()


def _ready(client: Client) -> Client:
    recover(client)
    goal = client.status().goal
    if goal:
        client.cancel(goal)
    eventually("the arm rests", lambda: at_rest(client))
    return client


def at_rest(client: Client) -> bool:
    """Whether the commanded velocity is zero."""
    return not any(client.status().command.values())


def moved_away(client: Client) -> None:
    """Put the arm somewhere that is not ``park``."""
    start = client.status().joints
    away = {name: value + 0.12 for name, value in start.items() if name in ("j1", "j4")}
    client.goal(away).reached(60.0)


@contextmanager
def serving(*arguments: str) -> Iterator[dict[str, Any]]:
    """``stereoservo web`` as a process: what it prints as JSON. It ends by Ctrl-C."""
    command = [sys.executable, "-m", "stereoservo.cli.main", "web", "--port", "0", "--json", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.send_signal(signal.SIGINT)
            try:
                assert process.wait(60) == 0
            finally:
                process.kill()


def cell_of_fakes(folder: Path, shipped: str, name: str, noise_px: float, model: CellModel) -> Path:
    """A shipped cell under another name, with fakes for arm and cameras, and a ``model`` already learnt."""
    text = shipped_cell_path(shipped).read_text(encoding="utf-8")
    text = text.replace('driver = "pybullet"', 'driver = "fake"')
    text = text.replace(f'name = "{shipped}"', f'name = "{name}"')
    text = re.sub(r"^(detector|blur|background) = .*\n", "", text, flags=re.MULTILINE)
    text = re.sub(r"^noise = .*$", f"noise_px = {noise_px}", text, flags=re.MULTILINE)
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    directories = cell_directories(name)
    create_directories(directories)
    save_model(model, directories.models / f"model-{model.epoch:06d}.json")
    return path
