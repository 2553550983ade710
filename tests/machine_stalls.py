"""Whether the machine itself stood still: a process of highest priority that does nothing but sleep and notes when a
sleep took too long. Shared virtual machines are taken off their cores for up to a second, idle or not; then no loop on
them meets a deadline, and a test of real processes that fails says nothing about the processes.

``python tests/machine_stalls.py FILE`` appends a line ``end_ns gap_ns`` (CLOCK_MONOTONIC) for each stall until its
standard input is closed.
"""

from __future__ import annotations

import os
import select
import sys
import time
from pathlib import Path

SLEEP_S = 0.01
STALL_S = 0.05
"""[s] A process of highest priority that wakes so much too late did not get a core: the machine stalled."""


def watch(path: Path) -> None:
    """Note stalls in a file until standard input ends."""
    if os.geteuid() == 0:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
    last = time.monotonic_ns()
    with path.open("a", encoding="ascii", buffering=1) as file:
        while not select.select([sys.stdin], [], [], SLEEP_S)[0]:
            now = time.monotonic_ns()
            if now - last > (SLEEP_S + STALL_S) * 1e9:
                file.write(f"{now} {now - last}\n")
            last = now


def longest_stall(path: Path, since_ns: int) -> float:
    """The longest stall that ended after a time [s]; 0 without one."""
    return max((gap for end, gap in stalls(path) if end > since_ns), default=0) * 1e-9


def summary(path: Path) -> tuple[int, float, float]:
    """How many stalls there were, the longest [s] and their sum [s]."""
    gaps = [gap * 1e-9 for _, gap in stalls(path)]
    return len(gaps), max(gaps, default=0.0), sum(gaps)


def stalls(path: Path) -> list[tuple[int, int]]:
    """End [ns, CLOCK_MONOTONIC] and length [ns] of each stall that was noted."""
    if not path.exists():
        return []
    lines = (line.split() for line in path.read_text(encoding="ascii").splitlines())
    return [(int(end), int(gap)) for end, gap in lines]


if __name__ == "__main__":
    watch(Path(sys.argv[1]))
