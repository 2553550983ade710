"""Repeated timing of calls, with the machine's properties and load."""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

STAT = Path("/proc/stat")
STOLEN = 7
"""Index of the stolen time among the numbers of /proc/stat's first line, in ticks."""


def timed(call: Callable[[int], object], repetitions: int, warm_up: int = 1) -> tuple[list[float], list[float]]:
    """Wall and CPU seconds of ``call(k)`` for k = 0, 1, …, after ``warm_up`` uncounted calls."""
    for k in range(warm_up):
        call(k)
    wall, cpu = [], []
    for k in range(repetitions):
        at, work = time.perf_counter(), time.process_time()
        call(k)
        cpu.append(time.process_time() - work)
        wall.append(time.perf_counter() - at)
    return wall, cpu


def summary(samples: list[float], scale: float = 1.0, digits: int = 4) -> dict[str, float | int]:
    """Median, p99 (from 100 samples on) and max of ``samples`` times ``scale``, to ``digits`` significant ones."""

    def rounded(value: float) -> float:
        return float(f"{value * scale:.{digits}g}")

    result: dict[str, float | int] = {
        "repetitions": len(samples),
        "median": rounded(float(np.median(samples))),
        "max": rounded(max(samples)),
    }
    if len(samples) >= 100:
        result["p99"] = rounded(float(np.percentile(samples, 99)))
    return result


def machine() -> dict[str, Any]:
    """Properties of the machine and its software, reported with a figure."""
    import numba

    return {
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "processor": _processor(),
        "system": platform.system(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "load": list(os.getloadavg()) if hasattr(os, "getloadavg") else None,
        "threads_of_openblas": os.environ.get("OPENBLAS_NUM_THREADS"),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def stolen_ticks() -> tuple[int, int] | None:
    """Stolen and total ticks of all processors since boot; None if the system does not report them."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        numbers = [int(word) for word in STAT.read_text().split("\n", 1)[0].split()[1:9]]
    except (OSError, ValueError):
        return None
    return (numbers[STOLEN], sum(numbers)) if len(numbers) > STOLEN else None


def stolen_share(before: tuple[int, int] | None, after: tuple[int, int] | None) -> float | None:
    """Share of all processors' time that the host took between two readings."""
    if before is None or after is None or after[1] <= before[1]:
        return None
    return (after[0] - before[0]) / (after[1] - before[1])


def resident_mb(process: int | str = "self") -> float:
    """Resident memory of a process [MB]."""
    pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
