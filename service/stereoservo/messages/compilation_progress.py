"""Progress of the processes of a starting cell in compiling kernels: a small file of each process in its runtime
directory, read by `status`, `run` and any program that starts a daemon.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import msgspec

from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.files import read_bounded

PATTERN = "compiling-*.json"
MAX_BYTES = 1 << 12


class CompilationProgress(msgspec.Struct, frozen=True):
    """Progress of the process ``part`` (``first``: kernels needed before the cell is up; ``rest``: compiled in
    parallel; ``servo``) of the daemon ``daemon`` (its process id): the number of kernels that are compiled or loaded,
    of about ``total``; 0 if unknown.
    """

    part: str
    daemon: int
    done: int
    total: int = 0

    @property
    def text(self) -> str:
        """As text."""
        return f"{self.done} of about {max(self.total, self.done)} kernels" if self.total else f"{self.done} kernels"


def progress_path(runtime: Path, part: str) -> Path:
    """The file of one process."""
    return runtime / PATTERN.replace("*", part)


def read_progress(runtime: Path, daemon: int = 0) -> tuple[CompilationProgress, ...]:
    """The progress records in a runtime directory, only those of the daemon with this process id if it is given;
    missing and unreadable files are skipped.
    """
    found = []
    for path in sorted(runtime.glob(PATTERN)):
        try:
            with decoding(partial(DamagedError, path)):
                one = msgspec.json.decode(read_bounded(path, MAX_BYTES), type=CompilationProgress)
        except DamagedError:  # or removed meanwhile
            continue
        if daemon in (0, one.daemon):
            found.append(one)
    return tuple(found)


class ProgressTimeout:
    """A time limit [s] that restarts with every change, so that slow compilation does not time out."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._news: object = None
        self._until_s = time.monotonic() + limit_s

    def is_over(self, news: object) -> bool:
        """Whether ``news`` (any comparable value) has not changed for longer than the limit."""
        now_s = time.monotonic()
        if news != self._news:
            self._news, self._until_s = news, now_s + self._limit_s
        return now_s > self._until_s
