"""``bench kills`` and ``bench soak-live``: a daemon with emulated drives in real time, for long.

``kills``: any of its processes is killed while the arm moves to a goal; of what the servo loop did until half a second
before, how much is in the flight ring, and whether all of it replays bit for bit. ``soak-live``: goals, in some of them
a fault that the daemon survives; what grows in each process and on disk, and whether events are lost.
"""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stereoservo.client import Client, RefusedError
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
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall

KILLS = 10
"""For each repetition that is asked for."""
MINUTES = 2.0
"""Of ``soak-live``, for each repetition that is asked for."""
SPEED_SCALE = 0.3
YOUNG_S = 0.5
"""Steps that are younger when a process is killed may be lost."""
BACK_S = 1.0
SETTLED_S = 5.0
"""A file of the ring that was not written to for so long is not written to any more."""
EDGE_PERIODS = 5
"""Steps by which the first and last step of a trial may lie inside its bounds without one being missed."""
TERMINAL = ("goal_reached", "goal_aborted", "goal_cancelled", "goal_preempted")
QUIET = 0.5
"""Share of goals without a fault."""
HELD_S = 0.3
LIMIT_S = 20.0
"""For a goal."""


class Trial(NamedTuple):
    """When a goal began and a process was killed [ns]."""

    begin_ns: int
    killed_ns: int
    process: str


def run_kills(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``repetitions`` times ten random kills: share of steps in the ring, and replays, by the process that was killed.

    Raises ExperimentError where the drives or a daemon do not come up.
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
    """A goal, and the end of a process while the arm moves."""

    def begin(client: Client) -> None:
        end = -END if client.status().joints["j1"] > 0.0 else END
        client.goal({"j1": end}, speed_scale=SPEED_SCALE, lease_s=None)

    bench.asked_ready(begin)
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
    """Recordings, each by a link that stays where the ring moves or drops it, and the time of day of its last write."""
    found = []
    links = bench.folder / "links"
    links.mkdir(exist_ok=True)
    for path in bench.directories.recordings.rglob("*.mcap"):
        with suppress(FileNotFoundError):  # moved aside or dropped just now
            link = links / path.name
            if not link.exists():
                link.hardlink_to(path)
            found.append((link, link.stat().st_mtime))
    return found


def _recorded(bench: ServiceBench, trial: Trial) -> tuple[int, int]:
    """How many of a trial's old steps are in the ring, and how many are not."""
    steps: dict[int, int] = {}
    begin_wall = time.time() - (time.monotonic_ns() - trial.begin_ns) * 1e-9
    for path, written in _files(bench):
        if written >= begin_wall:
            with suppress(
                RecordingError
            ):  # a file that is being written, or was cut; others are told by the replay
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
    """Replay the files, by name, that are not in ``replays`` and were not written to for so long; what differs."""
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

    Raises ExperimentError where a goal has two ends, or the drives or the daemon do not come up.
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
    """What a daemon was sent, what it told, and the sizes of its processes."""

    def __init__(self, bench: ServiceBench, client: Client, rng: np.random.Generator) -> None:
        self.bench, self.client, self.rng = bench, client, rng
        self.outcomes: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.without_end: list[str] = []
        self.sizes: dict[str, list[tuple[float, float, int]]] = {}
        self.disk_mb: list[float] = []
        self.told: list[EventMessage] = []
        client.session.declare_subscriber(
            client.keys.event,
            lambda sample: self.told.append(decode(sample.payload.to_bytes(), EventMessage)),
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
        return self.client.goal(
            {"j1": end}, speed_scale=SPEED_SCALE, lease_s=lease_s, time_limit_s=LIMIT_S
        ).id

    def _vision(self, how: signal.Signals) -> None:
        if (pid := self.bench.processes().get("vision-left")) is not None:
            send(pid, how)

    def _held(self) -> None:
        try:
            self.client.hold()
            time.sleep(HELD_S)
        finally:  # a hold whose answer did not come in time may hold all the same
            self.bench.asked(lambda client: client.resume())

    def one_goal(self) -> None:
        """Send a goal, do something to the daemon in half of them, and wait for its end. Raises ExperimentError."""
        self.bench.ready()
        try:
            goal = self._goal(lease_s=LIMIT_S)
        except RefusedError as refused:
            # A machine that stalls between the two leaves the drives in a fault of their own.
            self.faults[f"refused: {refused}"] += 1
            return
        if self.rng.random() > QUIET:
            time.sleep(float(self.rng.uniform(0.0, 1.0)))
            name = list(self.acts)[int(self.rng.integers(len(self.acts)))]
            self.faults[name] += 1
            with suppress(RefusedError):  # a goal that has ended already is not held
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
        """What is known of a goal of which no end was heard."""
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
        """Note the sizes of the processes that were never replaced, and of what is on the disk."""
        for name, pid in self.bench.processes().items():
            if name.startswith("vision-left"):
                continue
            pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
            size = (hours, pages * os.sysconf("SC_PAGE_SIZE") / 1e6, len(os.listdir(f"/proc/{pid}/fd")))
            self.sizes.setdefault(f"{name} {pid}", []).append(size)
        files = self.bench.directories.state.rglob("*")
        self.disk_mb.append(sum(path.stat().st_size for path in files if path.is_file()) / 1e6)

    def figures(self, hours: float) -> dict[str, Any]:
        """Slopes after a quarter of the time, in which caches become warm."""
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
    """Of one process: rows of hours, megabytes and descriptors."""
    warm = sizes[len(sizes) // 4 :]
    slope = float(np.polyfit(warm[:, 0], warm[:, 1], 1)[0]) if len(warm) > 1 else None
    return {
        "memory_mb": float(warm[-1, 1]),
        "memory_slope_mb_per_hour": slope,
        "descriptors": [int(warm[:, 2].min()), int(warm[:, 2].max())],
    }
