"""Benches of a live daemon, whose cell is like the demonstration's, in separate processes.

``bench loop``: wake-up lateness and work of the servo loop, beside an empty loop of the same period and priority in
interleaved segments of the same run. ``bench idle``: the processes' load on the computer when the cell is enabled and
idle. ``bench page``: effect of pages of ``stereoservo web`` on the servo loop, and age of the images that they receive.
The pages are programs that read all data sent to a page; a browser also draws it, on its own computer.
``bench watch``: CPU use of ``stereoservo watch`` for Foxglove and for Rerun, and its effect on the servo process.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from stereoservo.client import Client, ClientError
from stereoservo.daemon.pacing import CYCLE_BYTES, CYCLE_LOG_VARIABLE
from stereoservo.kinematics.model import encode_model
from stereoservo.messages.directories import CellDirectories, cell_directories, create_directories
from stereoservo.messages.wire import PreviewInfo
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.benchmarks.service_bench import directories_in, environment, processes_of, running_daemon
from stereoservo_sim.benchmarks.startup import wait_compiled
from stereoservo_sim.benchmarks.timing import resident_mb, stolen_share, stolen_ticks
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall, counted
from stereoservo_sim.world.exact_model import exact_simulated_model
from stereoservo_sim.world.simulated_cell import demo_cell

RATES_HZ = (250, 1000)
PRIORITIES = {"fifo": 80, "ordinary": 0}
LOADS = {"vision": (), "vision, zenoh flood, fit": ("flood", "fit")}
SEGMENT_S = 2.0
CYCLES = 1 << 20
"""Number of cycles that a log holds."""
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
"""Program of an empty loop, by the same code."""
FLOOD = """
import os, sys
from stereoservo.client import Client
os.nice(10)
with Client(sys.argv[1], operator="mallory") as client:
    while True:
        client.session.put(client.keys.command("jog", "mallory"), b"{")
"""
"""Program that sends requests, which the gateway has to refuse, as fast as possible."""
FIT = """
import os
os.nice(10)
from stereoservo_sim.benchmarks.calibration import run_calibration
run_calibration(100_000, 0, lambda stage, done, total: None)
"""
BESIDE = {"flood": FLOOD, "fit": FIT}


def run_loop(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``rows``: quantiles of lateness and work [us], cycles, overruns and lost slots, for each rate, scheduler and
    load.

    ``live`` is the servo loop of the demonstration's cell, which moves to a goal in the images and back; ``empty`` is a
    loop that does nothing, beside the daemon in every other segment. ``excess_overruns``: the share of cycles that
    overran, minus the empty loop's. ``scheduler``: the one that the daemon obtained, not the requested one.

    Raises ExperimentError if the daemon does not start.
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


def _of_daemon(folder: Path, rate_hz: int, priority: int, repetitions: int, seed: int) -> list[dict[str, Any]]:
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

    Raises ExperimentError if it does not start.
    """
    path = folder / "cell.toml"
    path.write_text(text, encoding="utf-8")
    with environment(directories_in(folder)):
        directories = cell_directories("demo")
        create_directories(directories)
        directories.models.mkdir(exist_ok=True)
        model = exact_simulated_model(demo_cell(), seed)
        (directories.models / f"model-{model.epoch:06d}.json").write_bytes(encode_model(model))
        with running_daemon(path, folder, environ=environ):
            with Client("demo") as client:
                wait_compiled(client)
            yield directories


@contextmanager
def moving_cell(folder: Path, rate_hz: int, priority: int, seed: int) -> Iterator[MovingCell]:
    """The demonstration's cell in separate processes, whose arm moves to a goal in the images and back.

    Raises ExperimentError if the daemon does not start.
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
    """Figures of both loops in alternating segments, and the share of the processors that the host took."""
    live, empty = [], []
    before = stolen_ticks()
    for _ in range(repetitions):
        begin_ns = time.monotonic_ns()
        time.sleep(SEGMENT_S)
        end_ns = time.monotonic_ns()
        rows = cycles_of(live_log)
        live.append(rows[(rows[:, 0] > begin_ns) & (rows[:, 0] < end_ns)])
        log = new_log(folder / "empty.cycles")
        program = [sys.executable, "-c", EMPTY, str(10**9 // rate_hz), str(priority), str(round(SEGMENT_S * rate_hz))]
        subprocess.run(program, env={**os.environ, CYCLE_LOG_VARIABLE: str(log)}, check=True)
        empty.append(cycles_of(log))
    figures = {"live": _figures(np.concatenate(live)), "empty": _figures(np.concatenate(empty))}
    excess = figures["live"]["overrun_share"] - figures["empty"]["overrun_share"]
    return {**figures, "excess_overruns": excess, "stolen_share": stolen_share(before, stolen_ticks())}


def new_log(path: Path) -> Path:
    """An empty log of cycles; real zeros, so that no cycle waits for the file system."""
    path.write_bytes(bytes((CYCLES + 1) * CYCLE_BYTES))
    return path


def cycles_of(path: Path) -> IntArray:
    """The cycles (k, 4) of a log: wake-up time, lateness, previous work [ns], slots skipped; without the first."""
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
    """A running cell: the log of its loop's cycles, the scheduler that it obtained, and its motion."""

    cycles: Path
    scheduler: str
    motion: _Motion


class _Motion:
    """An arm that moves to a goal in the images and back until it is told to end.

    ``interruptions``: goals that did not end normally, since the machine stalled.
    """

    def __init__(self) -> None:
        self.interruptions = 0
        self.ends = threading.Event()

    def run(self) -> None:
        """Move back and forth."""
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
    """Context manager: other load, in separate processes."""
    started = [
        subprocess.Popen([sys.executable, "-c", BESIDE[name], "demo"], stdout=subprocess.DEVNULL) for name in names
    ]
    if started:
        time.sleep(5.0)  # until they work
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


# -- at rest ---------------------------------------------------------------------------------------------------

IDLE_SEGMENT_S = 5.0
IDLE_SETTLE_S = 3.0
OF_RENDERED_CAMERAS = re.compile(r"^(detector|noise|blur|background) = .*\n", re.MULTILINE)


class Spent(NamedTuple):
    """All threads of a process since its start: CPU time [ns], and number of times one was scheduled."""

    processor_ns: int
    runs: int


def run_idle(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``processes``: ``core_percent``, ``runs_per_s`` and ``resident_mb`` of each process of the demonstration's cell,
    except its supervisor, with fake cameras, which render nothing; medians of segments. ``core_percent``: of all.

    Raises ExperimentError if the daemon does not start.
    """
    segments: list[dict[str, tuple[float, float]]] = []
    with tempfile.TemporaryDirectory(prefix="ssidle") as scratch:
        folder = Path(scratch)
        with running_cell(folder, _cell_text(), seed, {}) as directories:
            with Client("demo", operator="bench") as client:
                client.enable()
            processes = processes_of(directories.runtime)
            time.sleep(IDLE_SETTLE_S)
            for _ in counted(progress, "idle", repetitions):
                segments.append(_segment(processes))
            resident = {name: _resident_mib(number) for name, number in processes.items()}
    medians = {name: np.median([segment[name] for segment in segments], axis=0) for name in processes}
    return {
        "segment_s": IDLE_SEGMENT_S,
        "segments": repetitions,
        "processes": {
            name: {
                "core_percent": round(float(share), 2),
                "runs_per_s": round(float(runs)),
                "resident_mb": round(resident[name]),
            }
            for name, (share, runs) in medians.items()
        },
        "core_percent": round(float(sum(share for share, _ in medians.values())), 1),
    }


def _cell_text() -> str:
    """The demonstration's cell file with cameras that render nothing."""
    text = shipped_cell_path("demo").read_text(encoding="utf-8")
    joints, cameras = text.split("[[camera]]", 1)
    return joints + "[[camera]]" + OF_RENDERED_CAMERAS.sub("", cameras).replace('"pybullet"', '"fake"')


def _segment(processes: dict[str, int]) -> dict[str, tuple[float, float]]:
    """Per cent of a core and number of runs per second, by process."""
    began_s, before = time.monotonic(), {name: spent_by(number) for name, number in processes.items()}
    time.sleep(IDLE_SEGMENT_S)
    took_s, after = time.monotonic() - began_s, {name: spent_by(number) for name, number in processes.items()}
    return {
        name: (processor_share(before[name], after[name], took_s), (after[name].runs - before[name].runs) / took_s)
        for name in processes
    }


def processor_share(before: Spent, after: Spent, took_s: float) -> float:
    """Per cent of a core between two moments of a process."""
    return 1e-7 * (after.processor_ns - before.processor_ns) / took_s


def spent_by(process: int) -> Spent:
    """CPU time and number of runs of a process since its start."""
    threads = [path.read_text().split() for path in Path(f"/proc/{process}/task").glob("*/schedstat")]
    return Spent(sum(int(thread[0]) for thread in threads), sum(int(thread[2]) for thread in threads))


def _resident_mib(process: int) -> float:
    return resident_mb(process) * 1e6 / 2**20


# -- pages -----------------------------------------------------------------------------------------------------

RATE_HZ, PRIORITY = 250, 80
PAGES = 3
PAGE_SETTLE_S = 1.5
"""Settling time after pages have opened or closed, in which a camera still encodes the former requests."""
RESAMPLES = 2000
INTERVAL = (2.5, 97.5)


def run_page(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """Lateness of the loop with pages (``pages``) and without (``none``) [us]: quantiles of all segments of a kind, in
    pairs of random order.

    ``ratio``: of pages to none, with intervals of 95 % from a bootstrap over pairs; ``first_picture_s``: from the start
    of ``stereoservo web`` to a page's first image; ``picture_ms``: from the shutter to the page.

    Raises ExperimentError.
    """
    try:
        import websockets.sync.client as sockets
    except ModuleNotFoundError as error:
        raise ExperimentError("bench", "it needs websockets: pip install 'stereoservo[web]'") from error
    ages: list[float] = []

    @contextmanager
    def pages_open(pair: int, shown: bool) -> Iterator[None]:
        with _reading(sockets, url, PAGES if shown else 0, ages):
            time.sleep(PAGE_SETTLE_S)
            yield

    with tempfile.TemporaryDirectory(prefix="sspage") as scratch, ExitStack() as ending:
        cell = ending.enter_context(moving_cell(Path(scratch), RATE_HZ, PRIORITY, seed))
        began = time.monotonic()
        url = ending.enter_context(_served())
        with sockets.connect(url) as page:
            while not isinstance(page.recv(timeout=60.0), bytes):
                pass
        first = time.monotonic() - began
        found = _in_pairs(cell, ("pages", "none"), pages_open, repetitions, seed, progress)
    if not ages:
        raise ExperimentError("bench", "no picture came")
    p50, p99 = np.percentile(ages, (50.0, 99.0))
    return {
        **found,
        "first_picture_s": round(first, 2),
        "pictures": len(ages),
        "picture_ms": {"p50": round(float(p50), 1), "p99": round(float(p99), 1)},
    }


def _in_pairs(
    cell: MovingCell,
    names: tuple[str, str],
    beside: Callable[[int, bool], AbstractContextManager[None]],
    repetitions: int,
    seed: int,
    progress: ProgressCall,
) -> dict[str, Any]:
    """Lateness of the loop in segments with something ``beside(pair, there)`` it and without, by name, in pairs of
    random order.
    """
    draws = np.random.default_rng(seed)
    late: dict[bool, list[IntArray]] = {True: [], False: []}
    before = stolen_ticks()
    for pair in counted(progress, names[0], repetitions):
        for there in (True, False) if draws.random() < 0.5 else (False, True):
            with beside(pair, there):
                begin_ns = time.monotonic_ns()
                time.sleep(SEGMENT_S)
                end_ns = time.monotonic_ns()
            rows = cycles_of(cell.cycles)
            late[there].append(rows[(rows[:, 0] > begin_ns) & (rows[:, 0] < end_ns), 1])
    return {
        "rate_hz": RATE_HZ,
        "scheduler": cell.scheduler,
        "segments": repetitions,
        **{name: quantiles(late[there]) for name, there in zip(names, (True, False), strict=True)},
        "ratio": ratios(late[True], late[False], draws),
        "interruptions": cell.motion.interruptions,
        "segments_stolen_share": stolen_share(before, stolen_ticks()),
    }


def _levels(segments: list[IntArray]) -> FloatArray:
    """Median and p99 of all samples [us]."""
    found: FloatArray = np.percentile(np.concatenate(segments), (50.0, 99.0)) * 1e-3
    return found


def quantiles(segments: list[IntArray]) -> dict[str, float | int]:
    """Cycles, median and p99 [us] of all segments."""
    p50, p99 = _levels(segments).tolist()
    return {"cycles": sum(map(len, segments)), "p50_us": round(p50, 1), "p99_us": round(p99, 1)}


def ratios(pages: list[IntArray], none: list[IntArray], draws: np.random.Generator) -> dict[str, Any]:
    """Ratios of the quantiles with pages to those without, and their intervals: whole pairs are resampled."""
    resampled = []
    for _ in range(RESAMPLES):
        chosen = draws.integers(len(pages), size=len(pages))
        resampled.append(_levels([pages[k] for k in chosen]) / _levels([none[k] for k in chosen]))
    low, high = np.percentile(np.array(resampled), INTERVAL, axis=0)
    ratio = _levels(pages) / _levels(none)
    return {
        name: {"ratio": round(float(ratio[k]), 3), "low": round(float(low[k]), 3), "high": round(float(high[k]), 3)}
        for k, name in enumerate(("p50", "p99"))
    }


@contextmanager
def _served() -> Iterator[str]:
    """``stereoservo web`` as a process; yields the address of its WebSocket."""
    command = [sys.executable, "-m", "stereoservo.cli.main", "web", "demo", "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            if not line:
                raise ExperimentError("bench", f"`{' '.join(command)}` ended with code {process.wait()}")
            yield json.loads(line)["url"].replace("http", "ws") + "socket"
        finally:
            process.terminate()


@contextmanager
def _reading(sockets: Any, url: str, count: int, ages: list[float]) -> Iterator[None]:
    """``count`` open pages; the ages [ms] of their images on arrival are added to ``ages``."""
    with ExitStack() as ending:
        pages = [ending.enter_context(sockets.connect(url)) for _ in range(count)]
        threads = [threading.Thread(target=_read, args=(page, ages), daemon=True) for page in pages]
        for thread in threads:
            thread.start()
        yield
    for thread in threads:
        thread.join(10.0)


def _read(page: Any, ages: list[float]) -> None:
    for message in page:
        if isinstance(message, bytes):
            size = int.from_bytes(message[:4], "little")
            info = msgspec.json.decode(message[4 : 4 + size], type=PreviewInfo)
            ages.append(1e3 * (time.time() - info.t_wall))


# -- viewers ---------------------------------------------------------------------------------------------------

WATCH_SETTLE_S = 4.0
"""Settling time after a start, until its libraries are loaded and it shows the cell."""
PROTOCOL = "foxglove.sdk.v1"


def run_watch(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``watchers``: per cent of a core, medians of segments, of `watch` that prints a line a second, of
    `watch --foxglove` with a program connected that reads every topic, and of `watch --rerun --save`.

    ``servo_percent``: of the servo process, with all three beside it and without. ``watched``, ``none``: lateness of
    the loop; ``ratio``: as in `bench page`.

    Raises ExperimentError.
    """
    try:
        import rerun  # noqa: F401
        import websockets.sync.client as sockets
    except ModuleNotFoundError as error:
        raise ExperimentError("bench", "it needs pip install 'stereoservo[web,watch]'") from error
    servo: dict[bool, list[float]] = {True: [], False: []}
    shares: list[dict[str, float]] = []

    @contextmanager
    def watched(pair: int, there: bool) -> Iterator[None]:
        with _watchers(sockets, folder / f"{pair}.rrd", there) as processes:
            numbers = {**processes, "servo": number}
            began_s, first = time.monotonic(), {name: spent_by(one) for name, one in numbers.items()}
            yield
            took_s, last = time.monotonic() - began_s, {name: spent_by(one) for name, one in numbers.items()}
        found = {name: processor_share(first[name], last[name], took_s) for name in first}
        servo[there].append(found.pop("servo"))
        if there:
            shares.append(found)

    with tempfile.TemporaryDirectory(prefix="sswatch") as scratch:
        folder = Path(scratch)
        with moving_cell(folder, RATE_HZ, PRIORITY, seed) as cell:
            number = processes_of(cell_directories("demo").runtime)["servo"]
            found = _in_pairs(cell, ("watched", "none"), watched, repetitions, seed, progress)
    return {
        **found,
        "watchers": {name: _median([share[name] for share in shares]) for name in shares[0]},
        "servo_percent": {"watched": _median(servo[True]), "none": _median(servo[False])},
    }


def _median(values: list[float]) -> float:
    return round(float(np.median(values)), 2)


@contextmanager
def _watchers(sockets: Any, file: Path, watched: bool) -> Iterator[dict[str, int]]:
    """Process numbers by viewer, once all show the cell; none unless ``watched``."""
    if not watched:
        time.sleep(WATCH_SETTLE_S)
        yield {}
        return
    program = [sys.executable, "-m", "stereoservo.cli.main", "watch", "demo"]
    options = {"terminal": [], "foxglove": ["--foxglove", "--port", "0"], "rerun": ["--rerun", "--save", str(file)]}
    with ExitStack() as ending:
        processes = {}
        for name, chosen in options.items():
            process = subprocess.Popen(
                [*program, *chosen], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            ending.callback(_end_viewer, process)
            processes[name] = process
        assert processes["foxglove"].stderr is not None
        line = processes["foxglove"].stderr.readline()
        if "ws://" not in line:
            raise ExperimentError("bench", f"watch --foxglove: {line.strip()}")
        viewer = ending.enter_context(sockets.connect(line.split()[-1], subprotocols=[PROTOCOL]))
        threading.Thread(target=_read_all, args=(viewer,), daemon=True).start()
        time.sleep(WATCH_SETTLE_S)
        yield {name: process.pid for name, process in processes.items()}


def _end_viewer(process: subprocess.Popen[str]) -> None:
    process.terminate()
    process.communicate(timeout=60.0)


def _read_all(viewer: Any) -> None:
    """Subscribe to every offered topic, and read all messages, until the server ends."""
    from websockets.exceptions import ConnectionClosed

    while True:
        try:
            data = viewer.recv()
        except ConnectionClosed:
            return
        offered = json.loads(data).get("channels", ()) if isinstance(data, str) else ()
        if offered:
            asked = [{"id": channel["id"], "channelId": channel["id"]} for channel in offered]
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
