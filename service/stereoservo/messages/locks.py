"""File locks (``flock``), one for each cell's daemon and one for each hardware channel, which the kernel releases when
the holder dies; and the process that holds one.
"""

from __future__ import annotations

import fcntl
import os
import re
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

CHANNEL_OPTIONS = ("channel", "device", "port", "source", "address")


class AlreadyRunningError(Exception):
    """Another process holds the lock.

    Attributes:
        what: what the lock protects.
        pid: its holder, 0 where unknown.
        path: the lock file.
    """

    def __init__(self, what: str, pid: int, path: Path) -> None:
        who = f"process {pid}" if pid else "another process"
        stop = f"; end it with `kill {pid}`" if pid else ""
        super().__init__(f"{what} is already in use by {who} (lock {path}){stop}")
        self.what = what
        self.pid = pid
        self.path = path


class FileLock:
    """An exclusive lock on ``path``, held until :meth:`release` or death. Raises AlreadyRunningError."""

    def __init__(self, path: Path, what: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            pid = _read_pid(self._fd)
            os.close(self._fd)
            self._fd = -1
            raise AlreadyRunningError(what, pid, path) from error
        os.ftruncate(self._fd, 0)
        os.pwrite(self._fd, b"%d\n" % os.getpid(), 0)

    def release(self) -> None:
        """Release the lock. The file stays: unlinking it would race with the next holder. Idempotent."""
        if self._fd >= 0:
            os.ftruncate(self._fd, 0)
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def holder(path: Path) -> int | None:
    """The process that holds the lock ``path`` (0: unknown), or None where nobody does."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return _read_pid(fd)
    else:
        return None
    finally:
        os.close(fd)


def hardware_lock_path(root: Path, driver: str, options: Mapping[str, Any]) -> Path | None:
    """The lock file of the hardware channel that ``options`` name, None where they name none (a
    simulation).
    """
    for key in CHANNEL_OPTIONS:
        value = options.get(key)
        if isinstance(value, str | int) and value != "":
            safe = re.sub(r"[^A-Za-z0-9]+", "-", f"{driver}-{value}").strip("-")
            return root / f"channel-{safe}.lock"
    return None


def _read_pid(fd: int) -> int:
    text = os.pread(fd, 32, 0).decode("ascii", "replace").strip()
    return int(text) if text.isdigit() else 0
