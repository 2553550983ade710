"""``bench idle``: what the processes of a cell take of the computer that is enabled and has nothing to do."""

from __future__ import annotations

import re
import resource
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stereoservo.client import Client
from stereoservo_sim.benchmarks.live_loop.loop import running_cell
from stereoservo_sim.benchmarks.service_bench import processes_of
from stereoservo_sim.cells import shipped_cell_path
from stereoservo_sim.progress import ProgressCall

SEGMENT_S = 5.0
SETTLE_S = 3.0
OF_RENDERED_CAMERAS = re.compile(r"^(detector|noise|blur|background) = .*\n", re.MULTILINE)


class Spent(NamedTuple):
    """Of all threads of a process since its start: time on a processor [ns], and how often one was given to it."""

    processor_ns: int
    runs: int


def run_idle(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """``processes``: of each process of the demonstration's cell with fake cameras, which render nothing, but its
    supervisor, ``core_percent``, ``runs_per_s`` and ``resident_mb``, medians of segments; ``core_percent`` of all.

    Raises ExperimentError where the daemon does not come up.
    """
    segments: list[dict[str, tuple[float, float]]] = []
    with tempfile.TemporaryDirectory(prefix="ssidle") as scratch:
        folder = Path(scratch)
        with running_cell(folder, _cell_text(), seed, {}) as directories:
            with Client("demo", operator="bench") as client:
                client.enable()
            processes = processes_of(directories.runtime)
            time.sleep(SETTLE_S)
            for segment in range(repetitions):
                progress("idle", segment, repetitions)
                segments.append(_segment(processes))
            progress("idle", repetitions, repetitions)
            resident = {name: _resident_mb(number) for name, number in processes.items()}
    medians = {name: np.median([segment[name] for segment in segments], axis=0) for name in processes}
    return {
        "segment_s": SEGMENT_S,
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
    """Per cent of a core and runs a second, by process."""
    began_s, before = time.monotonic(), {name: spent_by(number) for name, number in processes.items()}
    time.sleep(SEGMENT_S)
    took_s, after = time.monotonic() - began_s, {name: spent_by(number) for name, number in processes.items()}
    return {
        name: (
            processor_share(before[name], after[name], took_s),
            (after[name].runs - before[name].runs) / took_s,
        )
        for name in processes
    }


def processor_share(before: Spent, after: Spent, took_s: float) -> float:
    """Per cent of a core between two moments of a process."""
    return 1e-7 * (after.processor_ns - before.processor_ns) / took_s


def spent_by(process: int) -> Spent:
    """What a process has taken since its start."""
    threads = [path.read_text().split() for path in Path(f"/proc/{process}/task").glob("*/schedstat")]
    return Spent(sum(int(thread[0]) for thread in threads), sum(int(thread[2]) for thread in threads))


def _resident_mb(process: int) -> float:
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20
