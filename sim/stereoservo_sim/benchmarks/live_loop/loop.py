"""``bench loop``: when the servo loop of a live daemon wakes and how long it works, beside an empty loop of the same
period and priority in interleaved segments of the same run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stereoservo.client import Client, ClientError
from stereoservo.daemon.pacing import CYCLE_BYTES, CYCLE_LOG_VARIABLE
from stereoservo.kinematics.model import encode_model
from stereoservo.messages.directories import (
    RUNTIME_VARIABLE,
    STATE_VARIABLE,
    CellDirectories,
    cell_directories,
    create_directories,
)
from stereoservo.messages.discovery import DaemonError, DaemonProcess
from stereoservo.numerics.arrays import IntArray
from stereoservo_sim.benchmarks.service_bench import processes_of
from stereoservo_sim.benchmarks.startup import environment, wait_compiled
from stereoservo_sim.benchmarks.timing import stolen_share, stolen_ticks
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.simulated_cell import demo_cell

RATES_HZ = (250, 1000)
PRIORITIES = {"fifo": 80, "ordinary": 0}
LOADS = {"vision": (), "vision, zenoh flood, fit": ("flood", "fit")}
SEGMENT_S = 2.0
CYCLES = 1 << 20
"""For which a log has room."""
PARK = "park"
EMPTY = """
import sys
from stereoservo.daemon.pacing import clock_pacing, prepare_realtime
period_ns, priority, cycles = map(int, sys.argv[1:])
prepare_realtime(priority)
pacing = clock_pacing(period_ns)
for _ in range(cycles):
    pacing.wait()
"""
"""A loop that does nothing, by the same code."""
FLOOD = """
import os, sys
from stereoservo.client import Client
os.nice(10)
with Client(sys.argv[1], operator="mallory") as client:
    while True:
        client.session.put(client.keys.command("jog", "mallory"), b"{")
"""
"""Requests that the gateway has to refuse, as fast as they go."""
FIT = """
import os
os.nice(10)
from stereoservo_sim.benchmarks.calibration import run_calibration
run_calibration(100_000, 0, lambda stage, done, total: None)
"""
BESIDE = {"flood": FLOOD, "fit": FIT}


def run_loop(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``rows``: for each rate, scheduler and load, ``live`` (the servo loop of the demonstration's cell, which goes to
    a goal in the images and away from it) and ``empty`` (a loop that does nothing, beside the daemon in every other
    segment): quantiles of lateness and work [us], cycles, overruns and lost slots; ``excess_overruns``, the share of
    cycles that overran, less the empty loop's. ``scheduler``: what the daemon got, not what it asked for.

    Raises ExperimentError where the daemon does not come up.
    """
    rows: list[dict[str, Any]] = []
    total = len(RATES_HZ) * len(PRIORITIES)
    for rate_hz in RATES_HZ:
        for priority in PRIORITIES.values():
            progress("loop", len(rows) // len(LOADS), total)
            with tempfile.TemporaryDirectory(prefix="ssloop") as scratch:
                rows += _of_daemon(Path(scratch), rate_hz, priority, repetitions, seed)
    progress("loop", total, total)
    return {"segment_s": SEGMENT_S, "segments": repetitions, "rows": rows}


def _of_daemon(
    folder: Path, rate_hz: int, priority: int, repetitions: int, seed: int
) -> list[dict[str, Any]]:
    """The rows of one daemon: all loads."""
    with moving_cell(folder, rate_hz, priority, seed) as cell:
        rows = []
        for load, beside in LOADS.items():
            with _running(beside):
                row = _measured(folder, cell.cycles, rate_hz, priority, repetitions)
            rows.append({"rate_hz": rate_hz, "scheduler": cell.scheduler, "load": load, **row})
        for row in rows:
            row["interruptions"] = cell.motion.interruptions
        return rows


@contextmanager
def running_cell(folder: Path, text: str, seed: int, environ: dict[str, str]) -> Iterator[CellDirectories]:
    """The daemon of a cell file like the demonstration's, with an exact model and all kernels; ``environ``: for its
    processes.

    Raises ExperimentError where it does not come up.
    """
    path, log = folder / "cell.toml", folder / "daemon.log"
    path.write_text(text, encoding="utf-8")
    variables = {RUNTIME_VARIABLE: str(folder / "r"), STATE_VARIABLE: str(folder / "s")}
    try:
        with environment(variables):
            directories = cell_directories("demo")
            create_directories(directories)
            directories.models.mkdir(exist_ok=True)
            model = exact_simulated_model(demo_cell(), seed)
            (directories.models / f"model-{model.epoch:06d}.json").write_bytes(encode_model(model))
            with DaemonProcess(path, log=log, environment=environ) as daemon:
                info = daemon.wait_ready()
                with Client(info.cell) as client:
                    wait_compiled(client)
                yield directories
    except (ClientError, DaemonError) as error:
        raise ExperimentError("daemon", f"{error}; {log.read_text()[-2000:]}") from error


@contextmanager
def moving_cell(folder: Path, rate_hz: int, priority: int, seed: int) -> Iterator[MovingCell]:
    """The demonstration's cell as processes, whose arm goes to a goal in the images and away from it.

    Raises ExperimentError where the daemon does not come up.
    """
    text = shipped_cell_path("demo").read_text(encoding="utf-8")
    text = text.replace("rate_hz = 250.0", f"rate_hz = {rate_hz}.0\npriority = {priority}")
    text = text.replace("[joints.options]", f"[joints.options]\nrate_hz = {rate_hz}.0")
    cycles = new_log(folder / "live.cycles")
    with running_cell(folder, text, seed, {CYCLE_LOG_VARIABLE: str(cycles)}) as directories:
        servo = processes_of(directories.runtime)["servo"]
        scheduler = "fifo" if os.sched_getscheduler(servo) & os.SCHED_FIFO else "ordinary"
        with _moving() as motion:
            yield MovingCell(cycles, scheduler, motion)


def _measured(folder: Path, live_log: Path, rate_hz: int, priority: int, repetitions: int) -> dict[str, Any]:
    """Figures of both loops in segments that alternate, and the share of the processors that the host took."""
    live, empty = [], []
    before = stolen_ticks()
    for _ in range(repetitions):
        begin_ns = time.monotonic_ns()
        time.sleep(SEGMENT_S)
        end_ns = time.monotonic_ns()
        rows = cycles_of(live_log)
        live.append(rows[(rows[:, 0] > begin_ns) & (rows[:, 0] < end_ns)])
        log = new_log(folder / "empty.cycles")
        program = [
            sys.executable,
            "-c",
            EMPTY,
            str(10**9 // rate_hz),
            str(priority),
            str(round(SEGMENT_S * rate_hz)),
        ]
        subprocess.run(program, env={**os.environ, CYCLE_LOG_VARIABLE: str(log)}, check=True)
        empty.append(cycles_of(log))
    figures = {"live": _figures(np.concatenate(live)), "empty": _figures(np.concatenate(empty))}
    excess = figures["live"]["overrun_share"] - figures["empty"]["overrun_share"]
    return {**figures, "excess_overruns": excess, "stolen_share": stolen_share(before, stolen_ticks())}


def new_log(path: Path) -> Path:
    """A log of cycles without any; real zeros, so that no cycle waits for the file system."""
    path.write_bytes(bytes((CYCLES + 1) * CYCLE_BYTES))
    return path


def cycles_of(path: Path) -> IntArray:
    """The cycles (k, 4) of a log: when they woke, how late, the work before [ns], slots skipped; not the first one."""
    rows = np.fromfile(path, dtype=np.int64).reshape(-1, CYCLE_BYTES // 8)
    return np.array(rows[2 : rows[0, 0] + 1])


def _figures(cycles: IntArray) -> dict[str, Any]:
    overruns = int(np.count_nonzero(cycles[:, 3]))
    return {
        "cycles": len(cycles),
        "overruns": overruns,
        "lost_slots": int(cycles[:, 3].sum()),
        "overrun_share": overruns / len(cycles),
        "lateness_us": _quantiles(cycles[:, 1]),
        "work_us": _quantiles(cycles[:, 2]),
    }


def _quantiles(samples: IntArray) -> dict[str, float]:
    p50, p99, p999 = np.percentile(samples, (50.0, 99.0, 99.9)) * 1e-3
    found = {"p50": p50, "p99": p99, "p99.9": p999, "max": samples.max() * 1e-3}
    return {name: round(float(value), 1) for name, value in found.items()}


class MovingCell(NamedTuple):
    """A running cell: the log of its loop's cycles, the scheduler that it got, and its motion."""

    cycles: Path
    scheduler: str
    motion: _Motion


class _Motion:
    """An arm that goes to a goal in the images and away from it until it is told to end.

    ``interruptions``: goals that did not end as they should, since the machine stalled.
    """

    def __init__(self) -> None:
        self.interruptions = 0
        self.ends = threading.Event()

    def run(self) -> None:
        """Go to and fro."""
        with Client("demo", operator="bench") as client:
            start = client.status().joints
            away = {name: value + 0.12 for name, value in start.items() if name in ("j1", "j4")}
            while not self.ends.is_set():
                try:
                    if client.status().lifecycle != "active":
                        client.enable()
                    client.goal(away).reached(30.0)
                    client.goal(PARK, tolerance_px=0.5).reached(30.0)
                except ClientError:
                    self.interruptions += 1
                    client.resume()


@contextmanager
def _moving() -> Iterator[_Motion]:
    motion = _Motion()
    with Client("demo", operator="bench") as client:
        client.enable()
        client.teach(PARK, frames=5)
    thread = threading.Thread(target=motion.run, daemon=True)
    thread.start()
    try:
        yield motion
    finally:
        motion.ends.set()
        thread.join(60.0)


@contextmanager
def _running(names: tuple[str, ...]) -> Iterator[None]:
    """Other work, in processes of its own."""
    started = [
        subprocess.Popen([sys.executable, "-c", BESIDE[name], "demo"], stdout=subprocess.DEVNULL)
        for name in names
    ]
    if started:
        time.sleep(5.0)  # until they work
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()
