"""``bench page``: what pages of ``stereoservo web`` cost the servo loop, and how old the pictures are that they get.

The pages are programs that read all that a page is sent; a browser draws it as well, on its own computer.
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

import msgspec
import numpy as np

from stereoservo.messages.wire import PreviewInfo
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.benchmarks.live_loop.loop import SEGMENT_S, cycles_of, moving_cell
from stereoservo_sim.benchmarks.timing import stolen_share, stolen_ticks
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.progress import ProgressCall

RATE_HZ, PRIORITY = 250, 80
PAGES = 3
SETTLE_S = 1.5
"""After pages have opened or closed: for so long a camera still encodes what was asked for."""
RESAMPLES = 2000
INTERVAL = (2.5, 97.5)


def run_page(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``pages`` and ``none``: lateness of the loop [us], quantiles of all segments of a kind, in pairs of drawn order;
    ``ratio``: of pages to none, with intervals of 95 % from a bootstrap over pairs; ``first_picture_s``: from the start
    of ``stereoservo web`` to a page's first picture; ``picture_ms``: from the shutter to the page.

    Raises ExperimentError.
    """
    try:
        import websockets.sync.client as sockets
    except ModuleNotFoundError as error:
        raise ExperimentError("bench", "it needs websockets: pip install 'stereoservo[web]'") from error
    draws = np.random.default_rng(seed)
    late: dict[bool, list[IntArray]] = {True: [], False: []}
    ages: list[float] = []
    before = stolen_ticks()
    with tempfile.TemporaryDirectory(prefix="sspage") as scratch, ExitStack() as ending:
        cell = ending.enter_context(moving_cell(Path(scratch), RATE_HZ, PRIORITY, seed))
        began = time.monotonic()
        url = ending.enter_context(_served())
        with sockets.connect(url) as page:
            while not isinstance(page.recv(timeout=60.0), bytes):
                pass
        first = time.monotonic() - began
        for pair in range(repetitions):
            progress("page", pair, repetitions)
            for shown in (True, False) if draws.random() < 0.5 else (False, True):
                with _reading(sockets, url, PAGES if shown else 0, ages):
                    time.sleep(SETTLE_S)
                    begin_ns = time.monotonic_ns()
                    time.sleep(SEGMENT_S)
                    end_ns = time.monotonic_ns()
                rows = cycles_of(cell.cycles)
                late[shown].append(rows[(rows[:, 0] > begin_ns) & (rows[:, 0] < end_ns), 1])
        progress("page", repetitions, repetitions)
        interruptions = cell.motion.interruptions
    if not ages:
        raise ExperimentError("bench", "no picture came")
    return {
        "rate_hz": RATE_HZ,
        "scheduler": cell.scheduler,
        "segments": repetitions,
        **{name: quantiles(late[shown]) for name, shown in (("pages", True), ("none", False))},
        "ratio": ratios(late[True], late[False], draws),
        "first_picture_s": round(first, 2),
        "pictures": len(ages),
        "picture_ms": {
            "p50": round(float(np.median(ages)), 1),
            "p99": round(float(np.percentile(ages, 99)), 1),
        },
        "interruptions": interruptions,
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
    """Ratios of the quantiles with pages to those without, and their intervals: whole pairs are drawn again."""
    resampled = []
    for _ in range(RESAMPLES):
        chosen = draws.integers(len(pages), size=len(pages))
        resampled.append(_levels([pages[k] for k in chosen]) / _levels([none[k] for k in chosen]))
    low, high = np.percentile(np.array(resampled), INTERVAL, axis=0)
    ratio = _levels(pages) / _levels(none)
    return {
        name: {
            "ratio": round(float(ratio[k]), 3),
            "low": round(float(low[k]), 3),
            "high": round(float(high[k]), 3),
        }
        for k, name in enumerate(("p50", "p99"))
    }


@contextmanager
def _served() -> Iterator[str]:
    """``stereoservo web`` as a process; gives the address of its WebSocket."""
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
    """``count`` open pages; the ages [ms] at which their pictures come are added to ``ages``."""
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
