"""``bench watch``: what ``stereoservo watch`` takes of a core for Foxglove and for Rerun, and whether the servo process
notices it.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from stereoservo.messages.directories import cell_directories
from stereoservo.numerics.arrays import IntArray
from stereoservo_sim.benchmarks.live_loop.idle import processor_share, spent_by
from stereoservo_sim.benchmarks.live_loop.loop import SEGMENT_S, cycles_of, moving_cell
from stereoservo_sim.benchmarks.live_loop.page import PRIORITY, RATE_HZ, quantiles, ratios
from stereoservo_sim.benchmarks.service_bench import processes_of
from stereoservo_sim.benchmarks.timing import stolen_share, stolen_ticks
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall

SETTLE_S = 4.0
"""After a start: until its libraries are loaded and it shows the cell."""
PROTOCOL = "foxglove.sdk.v1"


def run_watch(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``watchers``: `watch` that prints a line a second, `watch --foxglove` with a program connected that reads every
    topic, and `watch --rerun --save`: per cent of a core, medians of segments. ``servo_percent``: of the servo process,
    with all three beside it and without.
    ``watched``, ``none``: lateness of the loop; ``ratio``: as `bench page` has it.

    Raises ExperimentError.
    """
    try:
        import rerun  # noqa: F401
        import websockets.sync.client as sockets
    except ModuleNotFoundError as error:
        raise ExperimentError("bench", "it needs pip install 'stereoservo[web,watch]'") from error
    draws = np.random.default_rng(seed)
    late: dict[bool, list[IntArray]] = {True: [], False: []}
    servo: dict[bool, list[float]] = {True: [], False: []}
    shares: list[dict[str, float]] = []
    before = stolen_ticks()
    with tempfile.TemporaryDirectory(prefix="sswatch") as scratch, ExitStack() as ending:
        folder = Path(scratch)
        cell = ending.enter_context(moving_cell(folder, RATE_HZ, PRIORITY, seed))
        number = processes_of(cell_directories("demo").runtime)["servo"]
        for pair in range(repetitions):
            progress("watch", pair, repetitions)
            for watched in (True, False) if draws.random() < 0.5 else (False, True):
                with _watchers(sockets, folder / f"{pair}.rrd", watched) as processes:
                    began_s, begin_ns = time.monotonic(), time.monotonic_ns()
                    first = {name: spent_by(one) for name, one in {**processes, "servo": number}.items()}
                    time.sleep(SEGMENT_S)
                    end_ns, took_s = time.monotonic_ns(), time.monotonic() - began_s
                    last = {name: spent_by(one) for name, one in {**processes, "servo": number}.items()}
                rows = cycles_of(cell.cycles)
                late[watched].append(rows[(rows[:, 0] > begin_ns) & (rows[:, 0] < end_ns), 1])
                found = {name: processor_share(first[name], last[name], took_s) for name in first}
                servo[watched].append(found.pop("servo"))
                if watched:
                    shares.append(found)
        progress("watch", repetitions, repetitions)
        interruptions = cell.motion.interruptions
    return {
        "rate_hz": RATE_HZ,
        "scheduler": cell.scheduler,
        "segments": repetitions,
        "watchers": {name: _median([share[name] for share in shares]) for name in shares[0]},
        "servo_percent": {"watched": _median(servo[True]), "none": _median(servo[False])},
        **{name: quantiles(late[watched]) for name, watched in (("watched", True), ("none", False))},
        "ratio": ratios(late[True], late[False], draws),
        "interruptions": interruptions,
        "segments_stolen_share": stolen_share(before, stolen_ticks()),
    }


def _median(values: list[float]) -> float:
    return round(float(np.median(values)), 2)


@contextmanager
def _watchers(sockets: Any, file: Path, watched: bool) -> Iterator[dict[str, int]]:
    """Process numbers by viewer, once all show the cell; none unless ``watched``."""
    if not watched:
        time.sleep(SETTLE_S)
        yield {}
        return
    program = [sys.executable, "-m", "stereoservo.cli.main", "watch", "demo"]
    options = {
        "terminal": [],
        "foxglove": ["--foxglove", "--port", "0"],
        "rerun": ["--rerun", "--save", str(file)],
    }
    with ExitStack() as ending:
        processes = {}
        for name, chosen in options.items():
            process = subprocess.Popen(
                [*program, *chosen], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            ending.callback(_end, process)
            processes[name] = process
        assert processes["foxglove"].stderr is not None
        line = processes["foxglove"].stderr.readline()
        if "ws://" not in line:
            raise ExperimentError("bench", f"watch --foxglove: {line.strip()}")
        viewer = ending.enter_context(sockets.connect(line.split()[-1], subprotocols=[PROTOCOL]))
        threading.Thread(target=_read_all, args=(viewer,), daemon=True).start()
        time.sleep(SETTLE_S)
        yield {name: process.pid for name, process in processes.items()}


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    process.communicate(timeout=60.0)


def _read_all(viewer: Any) -> None:
    """Subscribe to every topic that is offered, and read what comes, until the server ends."""
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
