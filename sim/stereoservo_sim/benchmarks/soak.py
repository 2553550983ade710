"""``bench soak``: virtual hours of goals, with random faults, on a cell in lockstep; growth of resources and losses.
Every goal must end in exactly one terminal event, the arm must rest after each fault and continue after an operator
acts, no command may exceed the velocity limits, and memory, descriptors and the residual of goals must not grow.

``bench kills`` and ``bench soak-live``: a daemon with emulated drives in real time, for long. ``kills``: any of its
processes is killed while the arm moves to a goal; measured is the share of the servo loop's steps until half a second
before that is in the flight ring, and whether all of it replays bit for bit. ``soak-live``: goals, some with a fault
that the daemon survives; growth of each process and of disk use, and lost events.
"""

from __future__ import annotations

import gc
import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from stereoservo.client import Client, RefusedError
from stereoservo.core.cycle import Event, StepInputs, StepOutputs
from stereoservo.core.monitors.following import FRICTION
from stereoservo.daemon.lockstep import LockstepCell, LockstepTimeoutError
from stereoservo.messages.cell_file import CellFile, check_cell
from stereoservo.messages.goals import Enable, FeatureTarget, Goal, JointTarget, Reset, Resume, RunGoal
from stereoservo.messages.status import Lifecycle
from stereoservo.messages.wire import EventMessage, decode
from stereoservo.numerics.arrays import FloatArray
from stereoservo.recording.replay import RecordingError, ReplayResult, recorded_messages, replay
from stereoservo.recording.step_layout import decode_step
from stereoservo_sim.benchmarks.service_bench import (
    CELL,
    END,
    RATE_HZ,
    ServiceBench,
    raise_stop_slot,
    running_bench,
    send,
)
from stereoservo_sim.benchmarks.timing import resident_mb
from stereoservo_sim.demonstration.lockstep_operator import TERMINAL, LockstepOperator
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.experiments.lockstep_cells import lockstep
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.history import TrueJointHistory
from stereoservo_sim.world.simulated_cell import demo_cell

CAMERAS = ("left", "right")
NEAR = 0.15
"""Range about the base in which postures of goals are drawn [rad]: the markers stay in view."""
GOALS = 12
LAWS = ("stereo", "image", "cartesian3", "joints")
LIMIT_S = 20.0
"""Virtual time limit of a goal."""
RESTS_S = 1.5
"""Time limit to rest: coasting, braking from full speed and the drives' time-out, with a margin."""
LOOKS_S = 3.0
"""Time at rest in which images and joints must agree again, after an encoder that had stuck."""
MOVING = 1e-3
"""True speed of any joint above which it counts as moving [rad/s]."""
CREEP = FRICTION["revolute"] + MOVING
"""True speed that is no failure with a stuck encoder [rad/s]: friction may hold a healthy joint that long."""
STUCK_TRAVEL = 0.17 + 0.5 / 4.0 + 0.06
"""Travel of an arm with stuck encoders [rad]: until detected at 1 rad/s, braking at 4 rad/s², the drives' time-out."""
QUIET = 0.4
"""Share of goals without a fault."""
TRUTH_SAMPLES = 4096
GOALS_PER_MEASURE = 10
"""Number of goals between readings of memory and descriptors."""
VIRTUAL_MINUTES = 2.0
"""Minutes per repetition."""

Act = Callable[[LockstepCell], None]


def _fault(name: str) -> Act:
    def inject(cell: LockstepCell) -> None:
        setattr(cell.joints.faults, name, 1)  # type: ignore[attr-defined]

    return inject


def _dark(cell: LockstepCell) -> None:
    for camera in cell.cameras:
        camera.blackout = True  # type: ignore[attr-defined]


def _stop(cell: LockstepCell) -> None:
    cell.raise_stop()


def _standstill(cell: LockstepCell) -> None:
    cell.clock.advance_to(cell.clock.now_ns() + 600_000_000)


def _silent_gateway(cell: LockstepCell) -> None:
    cell.links.gateway_alive = False  # type: ignore[attr-defined]


FAULTS: dict[str, Act] = {
    "write fails": _fault("fail_write"),
    "read fails": _fault("fail_read"),
    "no feedback": _fault("freeze_encoder_after"),
    "encoder stuck": _fault("stuck_encoder_after"),
    "commands lost": _fault("drop_writes_after"),
    "cameras dark": _dark,
    "stop": _stop,
    "loop stands still": _standstill,
    "gateway silent": _silent_gateway,
}


def run_soak(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``repetitions`` times two virtual minutes of goals and faults; memory, descriptors, events and residuals.

    Raises ExperimentError if an event is lost, a goal has no end or two, or the cell cannot be operated again.
    """
    rng = np.random.default_rng(seed)
    truth = TrueJointHistory.in_memory(len(demo_cell().robot.joints), TRUTH_SAMPLES)
    with lockstep(fake_cell(), seed, truth) as (cell, _):
        return _Soak(cell, truth, rng).run(repetitions * VIRTUAL_MINUTES * 60.0, progress)


def fake_cell() -> CellFile:
    """A cell of the fake arm and fake cameras, which render no images."""
    world = demo_cell()
    names = [joint.name for joint in world.robot.joints]
    limits = [
        {
            "joint": joint.name,
            "min": joint.position_min,
            "max": joint.position_max,
            "velocity": 1.0,
            "acceleration": 4.0,
        }
        for joint in world.robot.joints
    ]
    return check_cell(
        {
            "schema": 1,
            "cell": {"name": "soak"},
            "joints": {"driver": "fake"},
            "camera": [{"name": name, "driver": "fake"} for name in CAMERAS],
            "servo": {"tolerance_px": 0.2, "hold_frames": 5},
            "safety": {"limit": limits},
            "calibration": {
                "base": dict(zip(names, world.base.tolist(), strict=True)),
                "range": dict.fromkeys(names, 0.3),
                "stops": 7,
                "frames": 2,
                "settle_s": 0.05,
                "speed_scale": 1.0,
            },
        }
    )


class _Soak:
    """The cell, its commands, and their results."""

    def __init__(self, cell: LockstepCell, truth: TrueJointHistory, rng: np.random.Generator) -> None:
        self.cell = cell
        self.truth = truth
        self.rng = rng
        self.operator = LockstepOperator(cell)
        self.names = cell.settings.joint_names
        self.velocity_max = cell.settings.limits.velocity_max
        self.fastest = 0.0
        self.steps = 0
        self.outcomes: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.last_fault = ""
        self.residuals: list[tuple[float, float]] = []
        self.sizes: list[tuple[float, float, float]] = []
        self.events = 0
        cell.on_step = self._count
        cell.on_event.append(self._told)

    def _count(self, _inputs: StepInputs, outputs: StepOutputs) -> None:
        self.steps += 1
        if outputs.command is not None:
            self.fastest = max(self.fastest, float((np.abs(outputs.command) / self.velocity_max).max()))

    def _told(self, event: Event) -> None:
        self.events += 1
        if event.seq != self.events:
            raise ExperimentError("lost", f"events {self.events} to {event.seq - 1} were lost")

    def run(self, seconds: float, progress: ProgressCall) -> dict[str, Any]:
        """The figures after this virtual time."""
        self.cell.run_for(0.5)
        self.operator.enable()
        self.operator.calibrate()
        targets = [self._taught(f"g{k}") for k in range(GOALS)]
        start_s, started = self.cell.clock.now_ns() * 1e-9, time.monotonic()
        while (passed := self.cell.clock.now_ns() * 1e-9 - start_s) < seconds:
            progress("virtual seconds", int(passed), int(seconds))
            self._one_goal(targets[int(self.rng.integers(GOALS))], passed)
            self.cell.events.clear()
            if self.outcomes.total() % GOALS_PER_MEASURE == 1:
                self._measure(passed)
        self._measure(passed)
        return self._figures(passed / 3600.0, time.monotonic() - started)

    def _measure(self, passed_s: float) -> None:
        """Record memory and descriptors; collecting garbage for each goal would take a third of the run's time."""
        gc.collect()
        self.sizes.append((passed_s / 3600.0, resident_mb(), float(len(os.listdir("/proc/self/fd")))))

    def _taught(self, name: str) -> tuple[FeatureTarget, dict[str, float]]:
        """A random posture as seen by the cameras, and its joints."""
        base = demo_cell().base
        q: FloatArray = base + self.rng.uniform(-NEAR, NEAR, len(base))
        joints = dict(zip(self.names, q.tolist(), strict=True))
        self.operator.goal(JointTarget(joints))
        self.cell.run_for(0.3)
        self.operator.teach(name)
        return self.operator.taught[name], joints

    def _one_goal(self, target: tuple[FeatureTarget, dict[str, float]], passed_s: float) -> None:
        law = LAWS[int(self.rng.integers(len(LAWS)))]
        identity = f"{int(self.rng.integers(1 << 62)):016x}"
        goal = (
            Goal(identity, JointTarget(target[1]), time_limit_s=LIMIT_S)
            if law == "joints"
            else Goal(identity, target[0], law=law, time_limit_s=LIMIT_S)
        )
        reply = self.cell.submit(RunGoal(goal))
        if not reply.accepted:
            causes = "; ".join(f"{reason.code} {reason.hint}" for reason in self.cell.core.state.fault)
            raise ExperimentError(
                "refused",
                f"a goal of law {law} was refused after {passed_s:.1f} s (the last fault was {self.last_fault!r}): "
                f"{reply.message}; {causes}",
            )
        if self.rng.random() > QUIET:
            self.cell.run_for(float(self.rng.uniform(0.0, 1.0)))
            self._inject_fault(law)
        try:
            end = self.cell.wait_for(lambda e: e.id == identity and e.kind in TERMINAL, LIMIT_S + 5.0)
        except LockstepTimeoutError as error:
            status = self.cell.status
            hints = "; ".join(f"{reason.code} {reason.hint}" for reason in status.reasons) if status else ""
            told = ", ".join(event.kind for event in self.cell.events)
            raise ExperimentError(
                "no_end",
                f"a goal of law {law} has no end (the last fault was {self.last_fault!r}); {hints}; events: {told}",
            ) from error
        self.cell.run_for(0.3)
        ends = [event.kind for event in self.cell.events if event.id == identity and event.kind in TERMINAL]
        if len(ends) != 1:
            raise ExperimentError("ends", f"goal {identity} ended {len(ends)} times: {', '.join(ends)}")
        self.outcomes[end.kind] += 1
        if end.kind == "goal_reached" and end.error_px is not None:
            self.residuals.append((passed_s / 3600.0, end.error_px))

    def _inject_fault(self, law: str) -> None:
        """Inject a random fault; the arm rests, the cause is removed, and an operator continues."""
        name = list(FAULTS)[int(self.rng.integers(len(FAULTS)))]
        self.faults[name] += 1
        self.last_fault = name
        before, _ = self._true_motion()
        FAULTS[name](self.cell)
        self.cell.run_for(RESTS_S)
        _, fastest = self._true_motion()
        blind = name == "cameras dark" and law == "joints"  # which cameras do not affect
        if name == "encoder stuck":
            self._require_slow_creep(before, law)
        elif fastest > MOVING and not blind:
            raise ExperimentError(
                "moves", f"{name}: the arm moves at {fastest:.3g} rad/s {RESTS_S:g} s after the fault, law {law}"
            )
        self.cell.joints.faults = type(self.cell.joints.faults)()  # type: ignore[attr-defined]
        for camera in self.cell.cameras:
            camera.blackout = False  # type: ignore[attr-defined]
        self.cell.links.gateway_alive = True  # type: ignore[attr-defined]
        self.cell.run_for(0.2)
        self._operated(name)

    def _true_motion(self) -> tuple[FloatArray, float]:
        """True joint positions (n,) [rad], and the speed of the fastest [rad/s]."""
        newest = self.truth.newest()
        assert newest is not None
        return newest[1], float(np.abs(newest[2]).max())

    def _require_slow_creep(self, before: FloatArray, law: str) -> None:
        """A slow command with a stuck encoder is detected by travel, not by time. Raises ExperimentError."""
        for _ in range(round(LIMIT_S / 0.5)):
            at, fastest = self._true_motion()
            travel = float(np.abs(at - before).max())
            if travel > STUCK_TRAVEL:
                raise ExperimentError("moves", f"encoder stuck: the arm has gone {travel:.3f} rad, law {law}")
            if fastest <= CREEP:
                return
            self.cell.run_for(0.5)
        raise ExperimentError("moves", f"encoder stuck: the arm moves at {fastest:.3g} rad/s for ever, law {law}")

    def _operated(self, name: str) -> None:
        assert self.cell.status is not None
        if self.cell.status.lifecycle == Lifecycle.FAULT:
            self.cell.submit(Reset())
            self.cell.run_for(0.3)
        if self.cell.status.lifecycle != Lifecycle.ACTIVE:
            self.cell.submit(Enable())
            self.cell.run_for(0.3)
        if {"STOPPED", "HELD", "CAMERAS_OR_ARM"} & {reason.code for reason in self.cell.status.reasons}:
            self.cell.submit(Resume())
        if self.cell.status.lifecycle != Lifecycle.ACTIVE:
            reasons = msgspec.to_builtins(self.cell.status.reasons)
            raise ExperimentError("not_active", f"after {name} the cell is {self.cell.status.lifecycle}: {reasons}")
        self._await_agreement(name)

    def _await_agreement(self, name: str) -> None:
        """Wait until the images agree with the joints: before, no goal by images is accepted."""
        for _ in range(round(LOOKS_S / 0.1)):
            assert self.cell.status is not None
            doubts = [reason.hint for reason in self.cell.status.reasons if reason.code == "CAMERAS_OR_ARM"]
            if not doubts:
                return
            self.cell.run_for(0.1)
        raise ExperimentError("doubted", f"{LOOKS_S:g} s after {name} has passed: {doubts[0]}")

    def _figures(self, hours: float, seconds: float) -> dict[str, Any]:
        sizes = np.array(self.sizes[len(self.sizes) // 4 :])  # caches are warm after a quarter
        residuals = np.array(self.residuals)
        early, late = np.array_split(residuals[:, 1], 2)
        deviation = float(np.hypot(early.std() / np.sqrt(len(early)), late.std() / np.sqrt(len(late))))
        return {
            "virtual_hours": hours,
            "seconds": seconds,
            "steps": self.steps,
            "goals": sum(self.outcomes.values()),
            "outcomes": dict(self.outcomes),
            "faults": dict(self.faults),
            "events": self.events,
            "fastest_of_limit": self.fastest,
            "memory_mb": float(sizes[-1, 1]),
            "memory_slope_mb_per_virtual_hour": float(np.polyfit(sizes[:, 0], sizes[:, 1], 1)[0]),
            "descriptors": [int(sizes[:, 2].min()), int(sizes[:, 2].max())],
            "residual_px": {
                "first_half": float(early.mean()),
                "second_half": float(late.mean()),
                "difference_in_sigma": float((late.mean() - early.mean()) / deviation),
            },
        }


# -- a live daemon ---------------------------------------------------------------------------------------------

KILLS = 10
"""Kills per repetition."""
MINUTES = 2.0
"""Minutes of ``soak-live`` per repetition."""
SPEED_SCALE = 0.3
YOUNG_S = 0.5
"""Steps younger than this at a kill may be lost."""
BACK_S = 1.0
SETTLED_S = 5.0
"""A file of the ring that was not written for this time is complete."""
EDGE_PERIODS = 5
"""Number of steps by which the first and last step of a trial may lie inside its bounds without a missing one."""


LIVE_QUIET = 0.5
"""Share of goals without a fault."""
HELD_S = 0.3


class Trial(NamedTuple):
    """Times at which a goal began and a process was killed [ns]."""

    begin_ns: int
    killed_ns: int
    process: str


def run_kills(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``repetitions`` times ten random kills: share of steps in the ring, and replays, by the process that was killed.

    Raises ExperimentError if the drives or a daemon do not start.
    """
    rng = np.random.default_rng(seed)
    trials, present, missing = Counter[str](), Counter[str](), Counter[str]()
    replays: dict[str, str] = {}
    with running_bench() as bench:
        for k in range(repetitions * KILLS):
            progress("kills", k, repetitions * KILLS)
            trial = _killed(bench, rng)
            trials[trial.process] += 1
            there, absent = _recorded(bench, trial)
            present[trial.process] += there
            missing[trial.process] += absent
            _replay(bench, replays, SETTLED_S)
        bench.end_daemon()
        _replay(bench, replays, 0.0)
    total = present.total() + missing.total()
    differ = [f"{name}: {cause}" for name, cause in replays.items() if cause]
    return {
        "kills": trials.total(),
        "killed": dict(sorted(trials.items())),
        "steps": total,
        "share_recorded": present.total() / total if total else None,
        "missing": {name: missing[name] for name in sorted(trials)},
        "replays": len(replays),
        "replays_identical": len(replays) - len(differ),
        "differ": differ,
    }


def _killed(bench: ServiceBench, rng: np.random.Generator) -> Trial:
    """Run a goal, and kill a process while the arm moves."""

    def begin(client: Client) -> None:
        end = -END if client.status().joints["j1"] > 0.0 else END
        client.goal({"j1": end}, speed_scale=SPEED_SCALE, lease_s=None)

    bench.query_ready(begin)
    begin_ns = time.monotonic_ns()
    time.sleep(float(rng.uniform(YOUNG_S + 0.3, 3.0)))
    processes = bench.processes()
    name = sorted(processes)[int(rng.integers(len(processes)))]
    killed_ns = time.monotonic_ns()
    send(processes[name], signal.SIGKILL)
    if name in ("servo", "supervisor"):
        bench.daemon.process.wait()
    time.sleep(BACK_S)
    bench.ready()
    return Trial(begin_ns, killed_ns, name.partition("-")[0])


def _files(bench: ServiceBench) -> list[tuple[Path, float]]:
    """Recordings, each by a link that remains when the ring moves or drops it, and the time of its last write."""
    found = []
    links = bench.folder / "links"
    links.mkdir(exist_ok=True)
    for path in bench.directories.recordings.rglob("*.mcap"):
        with suppress(FileNotFoundError):  # just moved or dropped
            link = links / path.name
            if not link.exists():
                link.hardlink_to(path)
            found.append((link, link.stat().st_mtime))
    return found


def _recorded(bench: ServiceBench, trial: Trial) -> tuple[int, int]:
    """Number of a trial's old steps that are in the ring, and number of missing ones."""
    steps: dict[int, int] = {}
    begin_wall = time.time() - (time.monotonic_ns() - trial.begin_ns) * 1e-9
    for path, written in _files(bench):
        if written >= begin_wall:
            with suppress(RecordingError):  # a file being written, or cut; others are reported by the replay
                for topic, data in recorded_messages(path):
                    if topic == "step":
                        record = decode_step(data)
                        steps[record.step] = record.inputs.now_ns
    last_ns = trial.killed_ns - int(YOUNG_S * 1e9)
    numbers = np.array(sorted(step for step, now in steps.items() if trial.begin_ns <= now <= last_ns))
    period_ns = 1e9 / RATE_HZ
    if not numbers.size:
        return 0, round((last_ns - trial.begin_ns) / period_ns)
    edges = (steps[numbers[0]] - trial.begin_ns, last_ns - steps[numbers[-1]])
    absent = int(numbers[-1] - numbers[0] + 1) - numbers.size
    return numbers.size, absent + sum(max(0, round(edge / period_ns) - EDGE_PERIODS) for edge in edges)


def _replay(bench: ServiceBench, replays: dict[str, str], settled_s: float) -> None:
    """Replay the files, by name, that are not in ``replays`` and are complete; returns the differences."""
    for path, written in _files(bench):
        if path.name in replays or time.time() - written < settled_s:
            continue
        try:
            result: ReplayResult | None = replay(path)
        except RecordingError as error:
            result = error.result
            if not error.cut:
                replays[path.name] = str(error)
                continue
        differs = result is not None and not result.identical
        replays[path.name] = f"from step {result.first_difference}" if result is not None and differs else ""


def run_soak_live(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``repetitions`` times two minutes of goals in real time; memory, descriptors, disk, events.

    Raises ExperimentError if a goal has two ends, or the drives or the daemon do not start.
    """
    seconds = repetitions * MINUTES * 60.0
    with running_bench() as bench:
        bench.ready()
        with Client(CELL) as client:
            soak = _LiveSoak(bench, client, np.random.default_rng(seed))
            start = time.monotonic()
            while (passed := time.monotonic() - start) < seconds:
                progress("seconds", int(passed), int(seconds))
                soak.one_goal()
                soak.measure(passed / 3600.0)
            return soak.figures(passed / 3600.0)


class _LiveSoak:
    """A daemon's commands and events, and the sizes of its processes."""

    def __init__(self, bench: ServiceBench, client: Client, rng: np.random.Generator) -> None:
        self.bench, self.client, self.rng = bench, client, rng
        self.outcomes: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.without_end: list[str] = []
        self.sizes: dict[str, list[tuple[float, float, int]]] = {}
        self.disk_mb: list[float] = []
        self.told: list[EventMessage] = []
        client.session.declare_subscriber(
            client.keys.event, lambda sample: self.told.append(decode(sample.payload.to_bytes(), EventMessage))
        )
        self.acts: dict[str, Callable[[], object]] = {
            "stop slot": lambda: raise_stop_slot(bench),
            "stop": client.stop,
            "vision killed": lambda: self._vision(signal.SIGKILL),
            "vision hung": lambda: self._vision(signal.SIGSTOP),
            "preempted": lambda: self._goal(lease_s=None),
            "held": self._held,
        }

    def _goal(self, lease_s: float | None) -> str:
        end = float(self.rng.uniform(-END, END))
        return self.client.goal({"j1": end}, speed_scale=SPEED_SCALE, lease_s=lease_s, time_limit_s=LIMIT_S).id

    def _vision(self, how: signal.Signals) -> None:
        if (pid := self.bench.processes().get("vision-left")) is not None:
            send(pid, how)

    def _held(self) -> None:
        try:
            self.client.hold()
            time.sleep(HELD_S)
        finally:  # a hold may take effect even if its answer was late
            self.bench.query(lambda client: client.resume())

    def one_goal(self) -> None:
        """Send a goal, inject a fault into the daemon in half of the cases, and wait for its end. Raises
        ExperimentError.
        """
        self.bench.ready()
        try:
            goal = self._goal(lease_s=LIMIT_S)
        except RefusedError as refused:
            # A machine that stalls in between leaves the drives in a fault of their own.
            self.faults[f"refused: {refused}"] += 1
            return
        if self.rng.random() > LIVE_QUIET:
            time.sleep(float(self.rng.uniform(0.0, 1.0)))
            name = list(self.acts)[int(self.rng.integers(len(self.acts)))]
            self.faults[name] += 1
            with suppress(RefusedError):  # a goal that has already ended cannot be held
                self.acts[name]()
        until = time.monotonic() + 2 * LIMIT_S
        while not (ends := self._ends(goal)):
            if time.monotonic() > until:
                self.without_end.append(self._without_end(goal))
                return
            time.sleep(0.02)
        time.sleep(0.2)
        if len(ends := self._ends(goal)) != 1:
            raise ExperimentError("ends", f"goal {goal} ended {len(ends)} times: {', '.join(ends)}")
        self.outcomes[ends[0]] += 1

    def _without_end(self, goal: str) -> str:
        """Known facts on a goal without a received end."""
        asked = [event.kind for event in self.client.events(0).events if event.id == goal]
        status = self.client.status()
        return (
            f"no end of goal {goal} was heard, of it {[e.kind for e in self.told if e.id == goal]}; the daemon tells "
            f"{asked} when asked; the cell is {status.lifecycle}, goal {status.goal!r}; faults so far: "
            f"{dict(self.faults)}; daemon starts: {self.bench.starts}"
        )

    def _ends(self, goal: str) -> list[str]:
        return [event.kind for event in tuple(self.told) if event.id == goal and event.kind in TERMINAL]

    def measure(self, hours: float) -> None:
        """Record the sizes of the processes that were never replaced, and of the files on disk."""
        for name, pid in self.bench.processes().items():
            if name.startswith("vision-left"):
                continue
            size = (hours, resident_mb(pid), len(os.listdir(f"/proc/{pid}/fd")))
            self.sizes.setdefault(f"{name} {pid}", []).append(size)
        files = self.bench.directories.state.rglob("*")
        self.disk_mb.append(sum(path.stat().st_size for path in files if path.is_file()) / 1e6)

    def figures(self, hours: float) -> dict[str, Any]:
        """Slopes after a quarter of the time, in which caches warm up."""
        numbers: dict[str, set[int]] = {}
        for event in self.told:
            numbers.setdefault(event.boot, set()).add(event.seq)
        return {
            "hours": hours,
            "goals": self.outcomes.total(),
            "outcomes": dict(self.outcomes),
            "without_end": self.without_end,
            "faults": dict(self.faults),
            "daemon_starts": self.bench.starts,
            "events": len(self.told),
            "events_lost": sum(max(seen) - min(seen) + 1 - len(seen) for seen in numbers.values()),
            "disk_mb": max(self.disk_mb),
            "processes": {name: _slopes(np.array(sizes)) for name, sizes in sorted(self.sizes.items())},
        }


def _slopes(sizes: FloatArray) -> dict[str, Any]:
    """Slopes of one process from rows of hours, megabytes and descriptors."""
    warm = sizes[len(sizes) // 4 :]
    slope = float(np.polyfit(warm[:, 0], warm[:, 1], 1)[0]) if len(warm) > 1 else None
    return {
        "memory_mb": float(warm[-1, 1]),
        "memory_slope_mb_per_hour": slope,
        "descriptors": [int(warm[:, 2].min()), int(warm[:, 2].max())],
    }
