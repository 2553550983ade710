"""Runs the demonstration, with real processes or in lockstep, and collects its data."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from stereoservo.client import Client
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.kinematics.model import save_model
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.directories import RUNTIME_VARIABLE, STATE_VARIABLE, cell_directories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.wire import LoopInfo
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.demonstration.belt import Belt
from stereoservo_sim.demonstration.emulated import (
    ANY_PORT,
    ANY_SERVER,
    has_emulated_cameras,
    has_emulated_drives,
    move_to_channel,
    move_to_server,
)
from stereoservo_sim.demonstration.live_demonstrator import LiveDemonstrator
from stereoservo_sim.demonstration.lockstep_demonstrator import LockstepDemonstrator
from stereoservo_sim.demonstration.progress import DemoFailedError, DemonstrationProgress
from stereoservo_sim.demonstration.scenario import Calibrated, ShownGoal, perform, shown_goals
from stereoservo_sim.demonstration.truth import TruthLog, shown_positions, true_cell
from stereoservo_sim.emulators.emulator_process import EmulatorProcess
from stereoservo_sim.world.conveyor import Conveyor, conveyor_of
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import SimulatedCell


@dataclass(frozen=True)
class Demonstration:
    """Data of a demonstration for evaluation and report."""

    cell: CellFile
    joint_names: tuple[str, ...]
    calibrated: Calibrated
    outcomes: dict[str, str]
    truth_t: IntArray
    truth_q: FloatArray
    recording: Path
    out: Path
    loop: LoopInfo | None
    """None in lockstep: virtual time is never late."""
    seed: int
    truth: SimulatedCell
    goals: Sequence[ShownGoal]
    belt: Belt | None

    @property
    def lockstep(self) -> bool:
        """Whether it ran in virtual time, not as real processes."""
        return self.loop is None


def conduct_lockstep(
    cell_path: Path,
    out: Path,
    seed: int,
    stage: DemonstrationProgress,
    goals: Sequence[ShownGoal] | None = None,
) -> Demonstration:
    """Run in one process in virtual time; deterministic given the seed. ``goals``: by default those of the arm."""
    cell, truth, conveyor, goals, recording = _shown(cell_path, out, goals, stage)
    with tempfile.TemporaryDirectory(prefix="stereoservo-demo-") as scratch:
        history = TrueJointHistory.in_memory(len(truth.base), capacity=1 << 16)
        with LockstepCell(
            cell, cell_dir=cell_path.parent, runtime_dir=Path(scratch), seed=seed, recording=recording,
            services={"world": history},
        ) as lockstep:  # fmt: skip
            log = TruthLog(history)
            lockstep.on_step = _every(2000, log.take)
            belt = None if conveyor is None else Belt(conveyor, Path(scratch), lockstep.clock.now_ns)
            names = lockstep.settings.joint_names
            calibrated, outcomes = perform(
                LockstepDemonstrator(lockstep, seed, stage.progress),
                names,
                shown_positions(cell, truth),
                stage.tell,
                goals,
                belt,
            )
            times, positions = log.end()
    demonstration = Demonstration(
        cell, names, calibrated, outcomes, times, positions, recording, out, None, seed, truth, goals, belt,
    )  # fmt: skip
    return _kept(demonstration)


def _shown(
    cell_path: Path, out: Path, goals: Sequence[ShownGoal] | None, stage: DemonstrationProgress
) -> tuple[CellFile, SimulatedCell, Conveyor | None, Sequence[ShownGoal], Path]:
    """A cell with its truth, its conveyor, the goals that it is shown, and the place of a recording, which is free."""
    cell = load_cell_file(cell_path)
    truth, conveyor, recording = true_cell(cell, cell_path.parent), conveyor_of(cell), out / "flight.mcap"
    for text in truth.robot.notes:
        stage.tell(text)
    recording.unlink(missing_ok=True)  # of an earlier demonstration
    shown = shown_goals(truth, on_belt=conveyor is not None) if goals is None else goals
    return cell, truth, conveyor, shown, recording


def _kept(demonstration: Demonstration) -> Demonstration:
    """A demonstration with its model saved beside the recording."""
    save_model(demonstration.calibrated.model, demonstration.out / "model.json")
    return demonstration


def _every(steps: int, act: Callable[[], None]) -> Callable[[object, object], None]:
    count = 0

    def on_step(_inputs: object, _outputs: object) -> None:
        nonlocal count
        count += 1
        if count % steps == 0:
            act()

    return on_step


def conduct_live(
    cell_path: Path,
    out: Path,
    seed: int,
    stage: DemonstrationProgress,
    goals: Sequence[ShownGoal] | None = None,
) -> Demonstration:
    """Run with real processes: a daemon in directories of its own, and a client over zenoh. ``goals``: by default those
    of the arm.
    """
    cell, truth, conveyor, goals, recording = _shown(cell_path, out, goals, stage)
    configurations = shown_positions(cell, truth)
    with ExitStack() as ends:
        scratch = Path(ends.enter_context(tempfile.TemporaryDirectory(prefix="stereoservo-")))
        os.environ[RUNTIME_VARIABLE] = str(scratch / "run")
        os.environ[STATE_VARIABLE] = str(scratch / "state")
        if has_emulated_drives(cell):
            cell_path = _emulate_drives(ends, cell_path, scratch, out, stage)
        if has_emulated_cameras(cell):
            cell_path = _emulate_cameras(ends, cell_path, scratch, out, stage)
        stage.tell(
            "starting the daemon (the first start compiles the kernels: minutes, more on a busy computer; nothing is "
            "compiled twice)"
        )
        options = ("--seed", str(seed), "--record", str(recording))
        with DaemonProcess(cell_path, options=options, log=out / "daemon.log") as daemon:
            daemon.wait_ready(tell=stage.tell)
            stage.tell(f"look on: {RUNTIME_VARIABLE}={scratch / 'run'} stereoservo web {cell.cell.name}")
            runtime_dir = cell_directories(cell.cell.name).runtime
            log = TruthLog.of_directory(runtime_dir)
            belt = None if conveyor is None else Belt(conveyor, runtime_dir, time.monotonic_ns)
            log.follow()
            with Client(cell.cell.name) as client:
                names = tuple(joint.name for joint in client.info().joints)
                calibrated, outcomes = perform(
                    LiveDemonstrator(client, stage.progress, stage.tell),
                    names,
                    configurations,
                    stage.tell,
                    goals,
                    belt,
                )
                loop = client.status().loop
            times, positions = log.end()
            code = daemon.stop()
            if code != 0:
                raise DemoFailedError(f"the daemon ended with exit code {code}: {daemon.output()}")
    demonstration = Demonstration(
        cell, names, calibrated, outcomes, times, positions, recording, out, loop, seed, truth, goals, belt,
    )  # fmt: skip
    return _kept(demonstration)


def _emulate_drives(
    ends: ExitStack, cell_path: Path, scratch: Path, out: Path, stage: DemonstrationProgress
) -> Path:
    """Start the cell's emulated drives on a free port, until ``ends``; returns a cell file that uses them."""
    drives = EmulatorProcess(cell_path, options=("--channel", ANY_PORT), log=out / "drives.log")
    channel = ends.enter_context(drives).wait_ready()
    stage.tell(f"emulated drives on {channel}")
    return move_to_channel(cell_path, scratch, channel)


def _emulate_cameras(
    ends: ExitStack, cell_path: Path, scratch: Path, out: Path, stage: DemonstrationProgress
) -> Path:
    """Start the cell's emulated cameras, which read the arm's history in the runtime directory; otherwise as
    `_emulate_drives`.
    """
    cameras = EmulatorProcess(
        cell_path, what="cameras", options=("--channel", ANY_SERVER), log=out / "cameras.log"
    )
    channel = ends.enter_context(cameras).wait_ready()
    stage.tell(f"emulated cameras at {channel}")
    folder = scratch / "streams"
    folder.mkdir()
    return move_to_server(cell_path, folder, channel)
