"""Process control of the daemon: death with the parent, termination signals, environment of children, log lines."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from contextlib import suppress
from types import FrameType

from stereoservo.messages.addresses import redacted

_PR_SET_PDEATHSIG = 1


def die_with_parent(parent: int, how: signal.Signals) -> None:
    """Make the kernel send ``how`` when the parent dies; exits at once if ``parent`` has already died.

    The kernel watches the parent's *thread*, so the spawning thread must live as long as the process is needed.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, int(how), 0, 0, 0) != 0:
        code = ctypes.get_errno()
        raise OSError(code, f"prctl(PR_SET_PDEATHSIG): {os.strerror(code)}")
    if os.getppid() != parent:
        sys.exit(1)


class Termination:
    """Flag set by SIGTERM, SIGINT and hang-up of the terminal (SIGHUP, unless ignored: nohup). After the first signal
    the process has ``grace_s`` to end; then SIGALRM kills it.
    """

    def __init__(self, grace_s: float = 5.0) -> None:
        self.signals = 0
        self.first: int = 0
        self._grace_s = grace_s
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
            signal.signal(signal.SIGHUP, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.signals += 1
        if self.signals == 1:
            self.first = number
            if self._grace_s > 0:
                signal.setitimer(signal.ITIMER_REAL, self._grace_s)

    @property
    def asked(self) -> bool:
        """Whether termination was requested."""
        return self.signals > 0


def write_log(process: str, message: str) -> None:
    """Write one line to stderr; the journal adds the time. With a full disk or a closed pipe only the line is lost."""
    with suppress(OSError, ValueError):
        print(f"stereoservo {process}: {redacted(message)}", file=sys.stderr, flush=True)


def child_environment() -> dict[str, str]:
    """Environment of every child: one thread for BLAS, so that it does not compete with the loop."""
    return {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
    }
