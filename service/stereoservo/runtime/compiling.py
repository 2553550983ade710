"""Fills numba's cache by several processes at once, where it is empty: a first start compiles for minutes.

A process a rehearsal; what two of them need is compiled twice, which costs less than the waiting. What they leave,
or fail at, the `warmup.warm_up` that follows compiles, or raises, in its own process.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from stereoservo.control.cartesian_kernel import cartesian_step
from stereoservo.control.incidence_rehearsal import rehearse_incidences
from stereoservo.control.laws_rehearsal import rehearse_laws
from stereoservo.runtime.lifeline import die_with_parent
from stereoservo.trajectory.rehearsal import rehearse_planning

REHEARSALS: Mapping[str, Callable[[], None]] = {
    "laws": rehearse_laws,
    "planning": rehearse_planning,
    "incidences": rehearse_incidences,
}
"""The longest first."""


def compile_ahead() -> None:
    """Compile the kernels of every rehearsal in processes beside each other, unless the largest is compiled."""
    if _compiled() or len(os.sched_getaffinity(0)) < 2:
        return
    command = [sys.executable, "-m", "stereoservo.runtime.compiling", str(os.getpid())]
    children = [subprocess.Popen([*command, name]) for name in REHEARSALS]
    for child in children:
        child.wait()


def _compiled() -> bool:
    name = cartesian_step.__name__
    cache = Path(cartesian_step.stats.cache_path)  # type: ignore[attr-defined]
    return any(cache.glob(f"*.{name}-*.nbc"))


def main() -> int:
    """Entry of a process: the parent's id and the rehearsal's name."""
    die_with_parent(int(sys.argv[1]), signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    REHEARSALS[sys.argv[2]]()
    return 0


if __name__ == "__main__":
    sys.exit(main())
