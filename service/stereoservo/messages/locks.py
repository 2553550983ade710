"""Locks, which the kernel releases when the holder dies, and the process that holds one: files (``flock``) for a cell's
daemon, and for a hardware channel a file and a name that is unique on the whole host.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import re
import socket
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from stereoservo.messages.addresses import Address

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
    """An exclusive lock on ``path``, held until :meth:`release` or death. Raises AlreadyRunningError.

    On a full or read-only disk the holder's process id cannot be written, so others cannot read it.
    """

    def __init__(self, path: Path, what: str) -> None:
        self._fd = _opened(path)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            pid = _read_pid(self._fd)
            os.close(self._fd)
            self._fd = -1
            raise AlreadyRunningError(what, pid, path) from error
        with suppress(OSError):
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, b"%d\n" % os.getpid(), 0)

    def release(self) -> None:
        """Release the lock. The file stays: unlinking it would race with the next holder. Idempotent."""
        if self._fd >= 0:
            with suppress(OSError):
                os.ftruncate(self._fd, 0)
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()


def _opened(path: Path) -> int:
    """Open a lock file, creating it if possible; an existing read-only one is sufficient."""
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        if error.errno != errno.EROFS:
            raise
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC)


class ChannelLock(FileLock):
    """An exclusive lock on the hardware channel of `hardware_lock_path`, for all users: in addition to the file
    ``path`` it takes the file's name among the abstract unix sockets, which all users of this host share, whatever
    their runtime directories are. Raises AlreadyRunningError.

    Containers: the name is unique within one network namespace; the file works if the runtime directory is shared.
    """

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(path, what)
        self._name = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        address = _abstract_address(path.name)
        try:
            self._name.bind(address)
            self._name.listen(1)  # the kernel reports the process of a socket to others only if it listens
        except OSError as error:
            self._name.close()
            self.release()
            if error.errno != errno.EADDRINUSE:
                raise
            raise AlreadyRunningError(what, _listener(address), Path(f"@{address[1:].decode()}")) from error

    def release(self) -> None:
        """Release the lock. Idempotent."""
        self._name.close()
        super().release()


def _abstract_address(name: str) -> bytes:
    """Address of an abstract socket: a zero and up to 107 bytes."""
    digest = hashlib.sha256(name.encode()).hexdigest()[:16]
    return b"\0" + f"stereoservo/{name[:70]}/{digest}".encode()


def _listener(address: bytes) -> int:
    """The process that listens at an abstract address; 0 if it has ended or is not in this host's process table."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(address)
        except OSError:
            return 0
        credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        return int(struct.unpack("3i", credentials)[0])


def holder(path: Path) -> int | None:
    """The process that holds the lock ``path`` (0: unknown), or None if nobody does."""
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
    """The lock file of the hardware channel that ``options`` name, None if they name none (a simulation, or an episode
    of a data set, which any number of cameras may read). A device has one file, whichever of its links is used to name
    it.
    """
    episode = options.get("episode") is not None
    for key in CHANNEL_OPTIONS:
        value = options.get(key)
        if isinstance(value, str | int) and value != "" and not (episode and key == "source"):
            if key == "device" and isinstance(value, int):  # OpenCV's number of a camera
                value = f"/dev/video{value}"
            if isinstance(value, str) and value.startswith("/dev/"):
                value = os.path.realpath(value)
            elif isinstance(value, str) and (shown := Address(value)) != value:
                value = f"{shown}-{shown.digest()}"  # the name is visible to others, also in messages
            safe = re.sub(r"[^A-Za-z0-9]+", "-", f"{driver}-{value}").strip("-")
            return root / f"channel-{safe}.lock"
    return None


def _read_pid(fd: int) -> int:
    """The holder, by its number in the lock file; 0 if there is none, or if a full disk has left an older one."""
    text = os.pread(fd, 32, 0).decode("ascii", "replace").strip()
    return int(text) if text.isdigit() and _may_hold(int(text), fd) else 0


def _may_hold(pid: int, fd: int) -> bool:
    """Whether this process may be the holder: the kernel names no other process as holder of the lock."""
    inode = f":{os.fstat(fd).st_ino}"
    try:
        lines = [line.split() for line in Path("/proc/locks").read_text(encoding="ascii").splitlines()]
    except OSError:
        return True
    pids = {fields[4] for fields in lines if len(fields) > 5 and fields[1] == "FLOCK" and fields[5].endswith(inode)}
    return not pids or str(pid) in pids
