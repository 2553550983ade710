"""Runs the demonstration, with real processes or in lockstep, and collects its data."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereoservo.client import Client, ClientError, FailedError, GoalHandle
from stereoservo.core.cycle import StepInputs, StepOutputs
from stereoservo.daemon.lockstep import LockstepCell
from stereoservo.daemon.servo import SILENCE
from stereoservo.kinematics.model import load_model, save_model
from stereoservo.messages.cell_file import CellFile, load_cell_file
from stereoservo.messages.directories import RUNTIME_VARIABLE, STATE_VARIABLE, cell_directories
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.messages.goals import JointTarget, LawName
from stereoservo.messages.learning import LearningState
from stereoservo.messages.wire import EventMessage, FeaturesMessage, LoopInfo
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
from stereoservo_sim.demonstration.lockstep_operator import LockstepOperator
from stereoservo_sim.demonstration.progress import DemoFailedError, DemonstrationProgress
from stereoservo_sim.demonstration.scenario import (
    SIGHT_S,
    Calibrated,
    MarkerSights,
    ShownGoal,
    SightCollection,
    VisualTarget,
    perform,
    shown_goals,
)
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
            cell,
            cell_dir=cell_path.parent,
            runtime_dir=Path(scratch),
            seed=seed,
            recording=recording,
            services={"world": history},
        ) as lockstep:
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
        cell, names, calibrated, outcomes, times, positions, recording, out, None, seed, truth, goals, belt
    )
    return _kept(demonstration)


def _shown(
    cell_path: Path, out: Path, goals: Sequence[ShownGoal] | None, stage: DemonstrationProgress
) -> tuple[CellFile, SimulatedCell, Conveyor | None, Sequence[ShownGoal], Path]:
    """A cell with its ground truth, its conveyor, the goals to be taught, and an unused path for the recording."""
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
    """Run with real processes: a daemon in directories of its own, and a zenoh client. ``goals``: by default those
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
                    LiveDemonstrator(client, stage.progress, stage.tell, stage.learning),
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
        cell, names, calibrated, outcomes, times, positions, recording, out, loop, seed, truth, goals, belt
    )
    return _kept(demonstration)


def _emulate_drives(ends: ExitStack, cell_path: Path, scratch: Path, out: Path, stage: DemonstrationProgress) -> Path:
    """Start the cell's emulated drives on a free port, until ``ends``; returns a cell file that uses them."""
    drives = EmulatorProcess(cell_path, options=("--channel", ANY_PORT), log=out / "drives.log")
    channel = ends.enter_context(drives).wait_ready()
    stage.tell(f"emulated drives on {channel}")
    return move_to_channel(cell_path, scratch, channel)


def _emulate_cameras(ends: ExitStack, cell_path: Path, scratch: Path, out: Path, stage: DemonstrationProgress) -> Path:
    """Start the cell's emulated cameras, which read the arm's history in the runtime directory; otherwise as
    `_emulate_drives`.
    """
    cameras = EmulatorProcess(cell_path, what="cameras", options=("--channel", ANY_SERVER), log=out / "cameras.log")
    channel = ends.enter_context(cameras).wait_ready()
    stage.tell(f"emulated cameras at {channel}")
    folder = scratch / "streams"
    folder.mkdir()
    return move_to_server(cell_path, folder, channel)


# -- the live demonstrator -----------------------------------------------------------------------------------
# The demonstration with real processes: a daemon, and a zenoh client.


LOOK_EVERY_S = 2.0
RECENT_EVENTS = 50
LOOKS = 3
"""Number of checks for the event that states why a cell is held: state and events arrive independently."""
MOST_HOLDS = 20
BUSY_COMPUTER = frozenset({"JOINT_STAMP", "LOOP_GAP"})
"""Codes of stops caused by a busy computer."""


class LiveDemonstrator:
    """``scenario.Operator`` as a goal client of a running daemon.

    As an operator would, it resumes an arm that was held or stopped since the computer was busy, at most ``MOST_HOLDS``
    times, reports it, and repeats what a stop has ended. Any other hold ends the current wait.
    """

    def __init__(
        self,
        client: Client,
        progress: Callable[[float], None],
        tell: Callable[[str], None] = lambda text: None,
        learning: Callable[[LearningState], None] | None = None,
    ) -> None:
        self._client = client
        self._progress = progress
        self._tell = tell
        self._learning = learning
        self._looked_s = time.monotonic()
        self._holds = self._looks = 0
        client.while_waiting = self._look

    def enable(self) -> None:
        """Enable the arm."""
        self._client.enable()

    def calibrate(self) -> Calibrated:
        """Calibrate; the model is read from the daemon's file."""
        while True:
            start = time.monotonic()
            try:
                result = self._client.calibrate(self._hear, learning=self._learning)
            except FailedError as error:
                if not self._goes_on(error.code in BUSY_COMPUTER, str(error)):
                    raise
            else:
                return Calibrated(load_model(Path(result.model)), time.monotonic() - start)

    def _hear(self, event: EventMessage) -> None:
        if event.progress is not None:
            self._progress(event.progress)

    def move(self, joints: dict[str, float]) -> None:
        """Execute a joint goal."""
        self._drive(lambda: self._client.goal(JointTarget(joints))).reached()

    def teach(self, name: str, frames: int) -> None:
        """Teach the current view."""
        self._client.teach(name, frames)

    def home(self) -> None:
        """Move home."""
        self._drive(self._client.home).reached()

    def joints(self) -> npt.NDArray[np.float64]:
        """Measured joint positions (n,)."""
        return np.array(list(self._client.joints().values()))

    def sights(self, frames: int) -> MarkerSights:
        """Observations of the cameras, the required number of frames of each."""
        found = SightCollection((camera.name for camera in self._client.info().cameras), frames)
        until_s = time.monotonic() + SIGHT_S
        for message in self._client.watch(features=True):
            if time.monotonic() > until_s:
                raise ClientError(found.missing)
            if isinstance(message, FeaturesMessage):
                found.add(message.camera, message.ids, message.pixels)
            if found.complete:
                break
        return found.sights

    def planned_s(self, target: VisualTarget, law: LawName) -> float:
        """Duration of the goal's plan [s]."""
        plan = self._client.check(self._client.make_goal(target, law=law)).plan
        assert plan is not None  # a goal in images is planned
        return plan.seconds

    def servo(self, target: VisualTarget, law: LawName, follow: tuple[int, ...] = ()) -> str:
        """Execute a goal to its end, with a lease."""
        result = self._drive(lambda: self._client.goal(target, law=law, lease_s=2.0, follow_markers=follow)).wait()
        return result.outcome if result.outcome == "reached" else f"{result.outcome}: {result.message}"

    def _look(self) -> None:
        """Check every ``LOOK_EVERY_S`` whether the cell is held. Raises ClientError if it will not be resumed."""
        if time.monotonic() - self._looked_s < LOOK_EVERY_S:
            return
        self._looked_s = time.monotonic()
        state = self._client.status()
        if not any(reason.code == "HELD" for reason in state.reasons):
            return
        told = [
            event
            for event in self._client.events(max(1, state.last_event - RECENT_EVENTS)).events
            if event.kind in ("held", "resumed")
        ]
        known = bool(told) and told[-1].kind == "held"
        self._looks += 1
        if not known and self._looks < LOOKS:
            return
        self._looks = 0
        cause = told[-1].message if known else "no event says why"
        if not self._goes_on(SILENCE in cause, cause):
            raise ClientError(f"the cell was held and nobody resumed it: {cause}")

    def _goes_on(self, was_busy: bool, cause: str) -> bool:
        """Whether the cell was resumed: if the computer ``was_busy``, and not too often yet."""
        self._holds += was_busy
        if not was_busy or self._holds > MOST_HOLDS:
            return False
        self._tell(f"{cause}: resumed")
        self._client.resume()
        return True

    def _drive(self, send: Callable[[], GoalHandle]) -> GoalHandle:
        """Run a goal, again if a busy computer ended it."""
        while True:
            handle = send()
            result = handle.wait()
            codes = {reason.code for reason in result.reasons}
            if result.outcome == "reached" or not self._goes_on(bool(codes & BUSY_COMPUTER), result.message):
                return handle

    def rest(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


# -- the demonstrator in lockstep ----------------------------------------------------------------------------
# The demonstration in one process on a virtual clock.


class LockstepDemonstrator:
    """``scenario.Operator`` of a cell in lockstep."""

    def __init__(self, cell: LockstepCell, seed: int, progress: Callable[[float], None]) -> None:
        self._cell = cell
        self._operator = LockstepOperator(cell, seed=seed)
        self._progress = progress

    def enable(self) -> None:
        """Wait for the first joint samples and frames, then enable."""
        self._cell.run_for(0.5)
        self._operator.enable()

    def calibrate(self) -> Calibrated:
        """Run trial motions and fit; ``seconds`` are virtual."""
        start_ns = self._cell.clock.now_ns()
        model = self._operator.calibrate(lambda _, fraction: self._progress(fraction))
        return Calibrated(model, (self._cell.clock.now_ns() - start_ns) * 1e-9)

    def move(self, joints: dict[str, float]) -> None:
        """Execute a joint goal."""
        event = self._operator.goal(JointTarget(joints))
        if event.kind != "goal_reached":
            raise RuntimeError(f"the arm did not reach the pose to be shown: {event.message}")

    def teach(self, name: str, frames: int) -> None:
        """Teach the current view."""
        self._operator.teach(name, frames)

    def home(self) -> None:
        """Move home."""
        self._operator.home()

    def joints(self) -> npt.NDArray[np.float64]:
        """Measured joint positions (n,), a step later."""
        return self._cell.step().status.positions

    def sights(self, frames: int) -> MarkerSights:
        """Observations of the cameras, the required number of frames of each; virtual time passes."""
        found = SightCollection((camera.name for camera in self._cell.settings.cameras), frames)
        before = self._cell.on_step

        def collect(inputs: StepInputs, outputs: StepOutputs) -> None:
            for seen in inputs.observations:
                found.add(seen.camera, seen.ids.tolist(), seen.pixels.tolist())
            if before is not None:
                before(inputs, outputs)

        self._cell.on_step = collect
        try:
            until_ns = self._cell.clock.now_ns() + round(SIGHT_S * 1e9)
            while not found.complete:
                if self._cell.clock.now_ns() > until_ns:
                    raise RuntimeError(found.missing)
                self._cell.step()
        finally:
            self._cell.on_step = before
        return found.sights

    def planned_s(self, target: VisualTarget, law: LawName) -> float:
        """Duration of the goal's plan [s]."""
        return self._operator.planned(target, law=law).seconds

    def servo(self, target: VisualTarget, law: LawName, follow: tuple[int, ...] = ()) -> str:
        """Execute a goal to its end."""
        event = self._operator.goal(target, law=law, follow_markers=follow)
        return "reached" if event.kind == "goal_reached" else f"{event.kind.removeprefix('goal_')}: {event.message}"

    def rest(self, seconds: float) -> None:
        """Let virtual time pass."""
        self._cell.run_for(seconds)
