"""How far the processes of a cell that starts have got with compiling kernels: a small file of each in its runtime
directory, which `status`, `run` and who starts a daemon read.
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
    """Of the process ``part`` (``first``: what is needed before the cell is up; ``rest``: beside it; ``servo``) of the
    daemon ``daemon`` (its process id): the number of kernels that are compiled or loaded, of about ``total``; 0 where
    that is not known.
    """

    part: str
    daemon: int
    done: int
    total: int = 0

    @property
    def words(self) -> str:
        """As text."""
        return (
            f"{self.done} of about {max(self.total, self.done)} kernels"
            if self.total
            else f"{self.done} kernels"
        )


def progress_path(runtime: Path, part: str) -> Path:
    """The file of one process."""
    return runtime / PATTERN.replace("*", part)


def read_progress(runtime: Path, daemon: int = 0) -> tuple[CompilationProgress, ...]:
    """What the files in a runtime directory tell, of the daemon with this process id where one is given; what is not
    there, or cannot be read, is left out.
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


class PatientWait:
    """A time limit [s] that counts from the last news: what compiles, however slowly, is waited for."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._news: object = None
        self._until_s = time.monotonic() + limit_s

    def is_over(self, news: object) -> bool:
        """Whether ``news`` (anything comparable) has been the same for longer than the limit."""
        now_s = time.monotonic()
        if news != self._news:
            self._news, self._until_s = news, now_s + self._limit_s
        return now_s > self._until_s
