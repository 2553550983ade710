"""Conducts the demonstration, as real processes or in lockstep, and gathers what is to be judged and reported."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereoservo.gateway.client import Client
from stereoservo.gateway.messages import LoopInfo
from stereoservo.kinematics.model import save_model
from stereoservo.runtime.cellfile import CellFile, load_cell_file
from stereoservo.runtime.daemon import DaemonProcess
from stereoservo.runtime.directories import RUNTIME_VARIABLE, STATE_VARIABLE, cell_directories
from stereoservo.runtime.lockstep import LockstepCell
from stereoservo_sim.demonstration.emulated import (
    ANY_PORT,
    ANY_SERVER,
    has_emulated_cameras,
    has_emulated_drives,
    move_to_channel,
    move_to_server,
)
from stereoservo_sim.demonstration.live import LiveDemonstrator
from stereoservo_sim.demonstration.lockstep import LockstepDemonstrator
from stereoservo_sim.demonstration.scenario import Calibrated, perform
from stereoservo_sim.demonstration.truth import TruthLog
from stereoservo_sim.emulation.process import EmulatorProcess
from stereoservo_sim.history import JointHistory
from stereoservo_sim.world import goals_of

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class DemoFailedError(Exception):
    """The demonstration did not do what it promises."""


@dataclass(frozen=True)
class Stage:
    """Where the demonstration tells how it goes: lines of text, and a fraction of the work in hand."""

    tell: Callable[[str], None]
    progress: Callable[[float], None]


@dataclass(frozen=True)
class Demonstration:
    """Everything that judgement and report need."""

    cell: CellFile
    joint_names: tuple[str, ...]
    calibrated: Calibrated
    outcomes: dict[str, str]
    truth_t: IntArray
    truth_q: FloatArray
    recording: Path
    out: Path
    loop: LoopInfo | None
    seed: int
    lockstep: bool


def conduct_lockstep(cell_path: Path, out: Path, seed: int, stage: Stage) -> Demonstration:
    """One process, virtual time, deterministic given the seed."""
    cell = load_cell_file(cell_path)
    recording = out / "flight.mcap"
    recording.unlink(missing_ok=True)  # of an earlier demonstration
    with tempfile.TemporaryDirectory(prefix="stereoservo-demo-") as scratch:
        history = JointHistory.in_memory(len(cell.safety.limit), capacity=1 << 16)
        with LockstepCell(
            cell, cell_dir=cell_path.parent, runtime_dir=Path(scratch), seed=seed, recording=recording,
            services={"world": history},
        ) as lockstep:  # fmt: skip
            log = TruthLog(history)
            lockstep.on_step = _every(2000, log.take)
            names = lockstep.settings.joint_names
            calibrated, outcomes = perform(
                LockstepDemonstrator(lockstep, seed, stage.progress), names, _configurations(cell), stage.tell
            )
            times, positions = log.end()
    save_model(calibrated.model, out / "model.json")
    return Demonstration(
        cell, names, calibrated, outcomes, times, positions, recording, out, None, seed, True
    )


def _configurations(cell: CellFile) -> dict[str, FloatArray]:
    return goals_of(cell.camera[0].mount)


def _every(steps: int, act: Callable[[], None]) -> Callable[[object, object], None]:
    count = 0

    def on_step(_inputs: object, _outputs: object) -> None:
        nonlocal count
        count += 1
        if count % steps == 0:
            act()

    return on_step


def conduct_live(cell_path: Path, out: Path, seed: int, stage: Stage) -> Demonstration:
    """Real processes: a daemon in directories of its own, and a client over zenoh."""
    cell = load_cell_file(cell_path)
    recording = out / "flight.mcap"
    recording.unlink(missing_ok=True)  # of an earlier demonstration
    with ExitStack() as ends:
        scratch = Path(ends.enter_context(tempfile.TemporaryDirectory(prefix="stereoservo-")))
        os.environ[RUNTIME_VARIABLE] = str(scratch / "run")
        os.environ[STATE_VARIABLE] = str(scratch / "state")
        if has_emulated_drives(cell):
            cell_path = _emulate_drives(ends, cell_path, scratch, out, stage)
        if has_emulated_cameras(cell):
            cell_path = _emulate_cameras(ends, cell_path, scratch, out, stage)
        stage.tell("starting the daemon (the first start compiles the kernels)")
        options = ("--seed", str(seed), "--record", str(recording))
        with DaemonProcess(cell_path, options=options, log=out / "daemon.log") as daemon:
            daemon.wait_ready()
            log = TruthLog.of_directory(cell_directories(cell.cell.name).runtime)
            log.follow()
            with Client(cell.cell.name) as client:
                names = tuple(joint.name for joint in client.info().joints)
                calibrated, outcomes = perform(
                    LiveDemonstrator(client, stage.progress), names, _configurations(cell), stage.tell
                )
                loop = client.status().loop
            times, positions = log.end()
            code = daemon.stop()
            if code != 0:
                raise DemoFailedError(f"the daemon ended with exit code {code}: {daemon.output()}")
    save_model(calibrated.model, out / "model.json")
    return Demonstration(
        cell, names, calibrated, outcomes, times, positions, recording, out, loop, seed, False
    )


def _emulate_drives(ends: ExitStack, cell_path: Path, scratch: Path, out: Path, stage: Stage) -> Path:
    """Start the cell's emulated drives on a free port, to end with ``ends``; the cell file that speaks to them."""
    drives = EmulatorProcess(cell_path, options=("--channel", ANY_PORT), log=out / "drives.log")
    channel = ends.enter_context(drives).wait_ready()
    stage.tell(f"emulated drives on {channel}")
    return move_to_channel(cell_path, scratch, channel)


def _emulate_cameras(ends: ExitStack, cell_path: Path, scratch: Path, out: Path, stage: Stage) -> Path:
    """The same with the cell's cameras: they look at the arm through its history in the runtime directory."""
    cameras = EmulatorProcess(
        cell_path, what="cameras", options=("--channel", ANY_SERVER), log=out / "cameras.log"
    )
    channel = ends.enter_context(cameras).wait_ready()
    stage.tell(f"emulated cameras at {channel}")
    folder = scratch / "streams"
    folder.mkdir()
    return move_to_server(cell_path, folder, channel)
