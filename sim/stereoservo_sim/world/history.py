"""History of the true joint positions, written by the simulated arm, read by simulated cameras and for evaluation.

A ring of samples in a memory-mapped file. A camera in another process can show the arm exactly at its shutter time,
and a demonstration can be evaluated against the arm's true motion. One writer, any number of readers. Python has no
memory fences, so each sample carries a checksum: a reader ignores a sample whose checksum does not match.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from pathlib import Path

import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray

FILE_NAME = "simulated-arm.truth"
CAPACITY = 65_536  # 4.4 minutes at 250 Hz
_MAGIC = b"SSTRUTH1"
_HEADER = struct.Struct("<8sIIQ")
_HEADER_SIZE = 64
_COUNT_AT = 16


class HistoryError(Exception):
    """A history file cannot be used; the text names the file and the cause."""


class TrueJointHistory:
    """Ring buffer of (t_ns, positions, velocities); times strictly increasing.

    Create one with :meth:`create`, :meth:`open` or :meth:`in_memory`.
    """

    def __init__(
        self, buffer: mmap.mmap | bytearray, joints: int, capacity: int, path: Path | None = None, inode: int = 0
    ) -> None:
        self.joints = joints
        self.capacity = capacity
        self.path = path
        self._inode = inode
        self._buffer = buffer
        self._body = struct.Struct(f"<Qq{2 * joints}d")
        self._stride = _stride(joints)
        self._last_ns = -1
        newest = self.newest()
        if newest is not None:
            self._last_ns = newest[0]

    @classmethod
    def in_memory(cls, joints: int, capacity: int = 4096) -> TrueJointHistory:
        """A history inside this process."""
        buffer = bytearray(_HEADER_SIZE + capacity * _stride(joints))
        _HEADER.pack_into(buffer, 0, _MAGIC, joints, capacity, 0)
        return cls(buffer, joints, capacity)

    @classmethod
    def create(cls, path: Path, joints: int, *, now_ns: int, capacity: int = CAPACITY) -> TrueJointHistory:
        """Open for writing. Continues an existing file of this layout unless its samples are from the future.

        Raises:
            HistoryError: the file cannot be created.
        """
        try:
            existing = cls.open(path)
        except HistoryError:
            existing = None
        if existing is not None:
            newest = existing.newest()
            fits = existing.joints == joints and existing.capacity == capacity
            if fits and (newest is None or newest[0] <= now_ns):
                return existing
            existing.close()
        size = _HEADER_SIZE + capacity * _stride(joints)
        fresh = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            with fresh.open("wb") as file:
                # Real zeros, not a hole: the first write to a page must not wait for the file system.
                file.write(bytes(size))
                file.seek(0)
                file.write(_HEADER.pack(_MAGIC, joints, capacity, 0))
            fresh.rename(path)
        except OSError as error:
            raise HistoryError(f"{path}: cannot create the simulated arm's history: {error}") from error
        return cls.open(path)

    @classmethod
    def open(cls, path: Path) -> TrueJointHistory:
        """Open for reading (or for the writer, if the file exists). Raises HistoryError if the file is missing or
        invalid.
        """
        try:
            with path.open("r+b") as file:
                status = os.fstat(file.fileno())
                size = status.st_size
                if size < _HEADER_SIZE:
                    raise HistoryError(f"{path}: {size} bytes; not the history of a simulated arm")
                buffer = mmap.mmap(file.fileno(), size)
        except OSError as error:
            raise HistoryError(f"{path}: {error}") from error
        magic, joints, capacity, _ = _HEADER.unpack_from(buffer, 0)
        if magic != _MAGIC or size != _HEADER_SIZE + capacity * _stride(joints):
            buffer.close()
            raise HistoryError(f"{path}: not the history of a simulated arm (magic {magic!r}, {size} bytes)")
        return cls(buffer, joints, capacity, path, status.st_ino)

    @property
    def count(self) -> int:
        """Number of samples ever written; the newest has index ``count - 1``."""
        return int(struct.unpack_from("<Q", self._buffer, _COUNT_AT)[0])

    @property
    def newest_ns(self) -> int:
        """Time of the newest sample as stored by its writer; -1 before the first."""
        return self._last_ns

    def append(self, t_ns: int, positions: FloatArray, velocities: FloatArray) -> None:
        """Write one sample of positions (n,) and velocities (n,); ignored if it is not newer than the last."""
        if t_ns <= self._last_ns:
            return
        index = self.count
        at = self._at(index)
        self._body.pack_into(self._buffer, at, index + 1, t_ns, *positions.tolist(), *velocities.tolist())
        check = zlib.crc32(self._buffer[at : at + self._body.size])
        struct.pack_into("<I", self._buffer, at + self._body.size, check)
        struct.pack_into("<Q", self._buffer, _COUNT_AT, index + 1)
        self._last_ns = t_ns

    def sample(self, index: int) -> tuple[int, FloatArray, FloatArray] | None:
        """Sample ``index`` as (t_ns, positions, velocities); None if it is overwritten or being written."""
        at = self._at(index)
        data = bytes(self._buffer[at : at + self._body.size + 4])
        fields = self._body.unpack_from(data, 0)
        if fields[0] != index + 1 or zlib.crc32(data[:-4]) != struct.unpack_from("<I", data, self._body.size)[0]:
            return None
        n = self.joints
        return fields[1], np.array(fields[2 : 2 + n]), np.array(fields[2 + n :])

    def newest(self) -> tuple[int, FloatArray, FloatArray] | None:
        """The newest sample, or None before the first."""
        for back in range(1, 4):
            if self.count >= back and (sample := self.sample(self.count - back)) is not None:
                return sample
        return None

    def at(self, t_ns: int) -> FloatArray | None:
        """Positions (n,) at ``t_ns``, by cubic interpolation; before the first sample: its positions; after the newest:
        None.
        """
        count = self.count
        if count == 0 or t_ns > self._time(count - 1):
            return None
        low, high = max(0, count - self.capacity + 1), count - 1
        while low < high:
            middle = (low + high) // 2
            if self._time(middle) < t_ns:
                low = middle + 1
            else:
                high = middle
        after = self.sample(low)
        before = self.sample(low - 1) if low > 0 else None
        if after is None:
            return None
        if before is None or after[0] == t_ns:
            return after[1]
        return _hermite(before, after, t_ns)

    def since(self, index: int) -> tuple[int, IntArray, FloatArray]:
        """Samples from ``index`` on that are still stored: (next index, times (k,) [ns], positions (k, n))."""
        count = self.count
        first = max(index, count - self.capacity + 1, 0)
        samples = [s for i in range(first, count) if (s := self.sample(i)) is not None]
        times = np.array([s[0] for s in samples], dtype=np.int64)
        return count, times, np.array([s[1] for s in samples]).reshape(-1, self.joints)

    def replaced(self) -> bool:
        """Whether the file was removed or replaced since it was opened (a reader then opens it again)."""
        if self.path is None:
            return False
        try:
            return self.path.stat().st_ino != self._inode
        except OSError:
            return True

    def close(self) -> None:
        """Release the mapping. Idempotent."""
        if isinstance(self._buffer, mmap.mmap):
            self._buffer.close()

    def _at(self, index: int) -> int:
        return _HEADER_SIZE + (index % self.capacity) * self._stride

    def _time(self, index: int) -> int:
        return int(struct.unpack_from("<q", self._buffer, self._at(index) + 8)[0])


def _stride(joints: int) -> int:
    return -(-(16 + 16 * joints + 4) // 64) * 64


def _hermite(
    before: tuple[int, FloatArray, FloatArray], after: tuple[int, FloatArray, FloatArray], t_ns: int
) -> FloatArray:
    h = (after[0] - before[0]) * 1e-9
    s = (t_ns - before[0]) / (after[0] - before[0])
    way = s * s * (3 - 2 * s) * (after[1] - before[1])  # exactly zero for an arm at rest
    return before[1] + way + s * (1 - s) * h * ((1 - s) * before[2] - s * after[2])
