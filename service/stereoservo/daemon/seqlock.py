"""Shared-memory slots with a sequence lock, which pass only the newest record between processes; and the stop slot, a
word that any process may set to stop the arm.

Python has no memory fences (aarch64 may reorder stores), so the sequence lock is only the fast path: every record has a
CRC-32 over its sequence number and bytes, and a reader relies on it alone. Files are created once, by the supervisor or
the first writer, and keep their inode during the cell's life, so that a restarted process finds its slot again.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import time
import zlib
from pathlib import Path
from types import TracebackType
from typing import Self

_MAGIC = 0x53_53_4C_4F_54_31  # "SSLOT1"
_HEADER_BYTES = 64
_MAGIC_WORD, _LAYOUT_WORD, _CAPACITY_WORD, _PID_WORD, _EPOCH_WORD, _SEQUENCE_WORD, _LENGTH_WORD, _CRC_WORD = range(8)

_STATE = struct.Struct("@3Q")  # native: whole words, as the memory views write them
"""Sequence number, length and CRC of a record, stored consecutively from `_STATE_AT` on."""
_STATE_AT = 8 * _SEQUENCE_WORD

_STOP_MAGIC = 0x53_53_54_4F_50_31  # "SSTOP1"
_STOP_BYTES = 32
_LARGEST_WORD = (1 << 64) - 1
_STOP_MAGIC_WORD, _RAISED_WORD, _ACKNOWLEDGED_WORD, _COUNT_WORD = range(4)


class SlotError(Exception):
    """A slot cannot be used: the message names the file, its content and the expected content.

    Attributes:
        path: the slot's file.
        code: ``"missing"``, ``"layout"``, ``"busy"`` or ``"too_large"``.
    """

    def __init__(self, path: Path, code: str, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = path
        self.code = code


def layout_hash(layout: str) -> int:
    """64-bit hash of a record layout's name, e.g. ``"CameraObservation.1"``."""
    data = layout.encode()
    return zlib.crc32(data) << 32 | zlib.crc32(data[::-1] + b"stereoservo")


def create_slot(path: Path, capacity: int, layout: str) -> bool:
    """Create the file of a slot for records of up to ``capacity`` bytes; returns whether anything had to be written.

    An existing file of that layout is not changed. A file of another layout is overwritten in place: processes may have
    it mapped, and if it became shorter, their next access would kill them. Raises OSError, also if there is not enough
    memory for the whole file.
    """
    size = _HEADER_BYTES + capacity
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        header = os.pread(fd, 24, 0)
        expected = struct.pack("=QQQ", _MAGIC, layout_hash(layout), capacity)
        found = os.fstat(fd).st_size
        if header == expected and found == size:
            return False
        os.ftruncate(fd, size)
        os.posix_fallocate(fd, 0, size)  # with full memory, a write into a hole would kill the writing process
        if found != size:
            os.pwrite(fd, bytes(size), 0)  # the bytes in between belong to another layout
        os.pwrite(fd, expected, 0)
        return True
    finally:
        os.close(fd)


class Mapping:
    """A file mapped as 64-bit words and bytes."""

    def __init__(self, path: Path, minimum: int) -> None:
        self.path = path
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except FileNotFoundError as error:
            raise SlotError(path, "missing", "no such slot; is the cell's daemon running?") from error
        size = os.fstat(self._fd).st_size
        if size < minimum:
            os.close(self._fd)
            raise SlotError(path, "layout", f"holds {size} bytes; a slot has at least {minimum}")
        self._map = mmap.mmap(self._fd, size)
        self._bytes = memoryview(self._map)
        self.words = self._bytes[: size - size % 8].cast("Q")

    @property
    def fd(self) -> int:
        return self._fd

    @property
    def bytes(self) -> memoryview:
        return self._bytes

    def close(self) -> None:
        if self._fd >= 0:
            self.words.release()
            self._bytes.release()
            self._map.close()
            os.close(self._fd)
            self._fd = -1


def map_slot(path: Path, layout: str) -> tuple[Mapping, int]:
    """The mapped file of a slot or ring, and its capacity. Raises SlotError."""
    mapping = Mapping(path, _HEADER_BYTES)
    magic, found, capacity = (
        mapping.words[_MAGIC_WORD],
        mapping.words[_LAYOUT_WORD],
        mapping.words[_CAPACITY_WORD],
    )
    if magic != _MAGIC or found != layout_hash(layout) or len(mapping.bytes) != _HEADER_BYTES + capacity:
        mapping.close()
        raise SlotError(
            path,
            "layout",
            f"is not a slot of layout {layout!r} (hash {found:#x}, expected {layout_hash(layout):#x})",
        )
    return mapping, capacity


class SlotWriter:
    """The single writer of a slot, enforced by a file lock that is released when its process dies.

    Raises SlotError: another live writer, another layout.
    """

    def __init__(self, path: Path, capacity: int, layout: str) -> None:
        create_slot(path, capacity, layout)
        self._mapping, self._capacity = map_slot(path, layout)
        self._words, self._bytes = self._mapping.words, self._mapping.bytes
        self._path = path
        try:
            fcntl.flock(self._mapping.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            pid = self._mapping.words[_PID_WORD]
            self._mapping.close()
            raise SlotError(path, "busy", f"already written by process {pid}; a slot has one writer") from error
        words = self._mapping.words
        sequence = words[_SEQUENCE_WORD] + (words[_SEQUENCE_WORD] & 1)  # a crash may have left it odd
        self._sequence = sequence if sequence < _LARGEST_WORD // 2 else 0  # else damaged: it must be able to grow
        words[_PID_WORD] = os.getpid()
        words[_EPOCH_WORD] = (words[_EPOCH_WORD] + 1) & _LARGEST_WORD

    def write(self, record: bytes) -> None:
        """Replace the record. Raises SlotError if it is longer than the capacity."""
        length = len(record)
        if length > self._capacity:
            raise SlotError(self._path, "too_large", f"record of {length} bytes; the slot holds up to {self._capacity}")
        self._sequence = sequence = self._sequence + 2
        self._words[_SEQUENCE_WORD] = sequence - 1
        self._bytes[_HEADER_BYTES : _HEADER_BYTES + length] = record
        _STATE.pack_into(self._bytes, _STATE_AT, sequence, length, zlib.crc32(record, sequence & 0xFFFFFFFF))

    def close(self) -> None:
        """Release the mapping; the file stays. Idempotent."""
        self._words = self._bytes = memoryview(b"")
        self._mapping.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SlotReader:
    """A reader of a slot, one of any number.

    ``torn`` counts reads that collided with a write and were retried; ``missed`` counts polls that gave up after
    ``retries`` retries (the record is then read at the next poll).
    """

    def __init__(self, path: Path, layout: str, *, retries: int = 8) -> None:
        self._mapping, self._capacity = map_slot(path, layout)
        self._words, self._bytes = self._mapping.words, self._mapping.bytes
        self._retries = retries
        self._seen = 0
        self.torn = 0
        self.missed = 0

    @property
    def epoch(self) -> int:
        """Number of writers that this slot has had."""
        return int(self._mapping.words[_EPOCH_WORD])

    @property
    def writer_pid(self) -> int:
        """The process of its newest writer; 0 before the first."""
        return int(self._mapping.words[_PID_WORD])

    def writer_lives(self) -> bool:
        """Whether the process of its newest writer lives."""
        pid = self.writer_pid
        if pid == 0:
            return False
        try:
            os.kill(pid, 0)
        except (ProcessLookupError, PermissionError):  # the process id may now belong to another user
            return False
        return True

    def poll(self) -> bytes | None:
        """The newest record unless it was read before, else None."""
        return self._read(skip=self._seen)

    def newest(self) -> bytes | None:
        """The newest record, even if it was read before; None if there is none yet."""
        return self._read(skip=0)

    def _read(self, skip: int) -> bytes | None:
        words = self._words
        for _ in range(self._retries):
            if words[_SEQUENCE_WORD] in (skip, 0):
                return None
            sequence, length, crc = _STATE.unpack_from(self._bytes, _STATE_AT)
            # an interrupted writer has left zeros, whose CRC is zero, too
            if sequence and not sequence & 1 and length <= self._capacity:
                record = self._bytes[_HEADER_BYTES : _HEADER_BYTES + length].tobytes()
                # A concurrent writer has changed the number, or left bytes with a wrong CRC.
                if zlib.crc32(record, sequence & 0xFFFFFFFF) == crc and words[_SEQUENCE_WORD] == sequence:
                    self._seen = sequence
                    return record
            self.torn += 1
        self.missed += 1
        return None

    def close(self) -> None:
        """Release the mapping. Idempotent."""
        self._words = self._bytes = memoryview(b"")
        self._mapping.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def create_stop_slot(path: Path) -> None:
    """Create the file of a stop slot, with no stop raised."""
    path.write_bytes(struct.pack("=QQQQ", _STOP_MAGIC, 0, 0, 0))
    path.chmod(0o600)


def repair_stop_slot(path: Path) -> bool:
    """Restore the magic number of a damaged stop slot, its other words unchanged; returns whether that was needed."""
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        mark = struct.pack("=Q", _STOP_MAGIC)
        if os.pread(fd, 8, 0) == mark and os.fstat(fd).st_size == _STOP_BYTES:
            return False
        os.ftruncate(fd, _STOP_BYTES)
        os.pwrite(fd, mark, 0)
        return True
    finally:
        os.close(fd)


class StopSlot:
    """A word in shared memory by which any process can raise a stop; the servo process reads and acknowledges it each
    cycle.

    If two processes raise it simultaneously, both write a new word; whichever is written last, the reader detects a
    change. The count is informative only and may miss one of two simultaneous raises.
    """

    def __init__(self, path: Path) -> None:
        self._mapping = Mapping(path, _STOP_BYTES)
        if self._mapping.words[_STOP_MAGIC_WORD] != _STOP_MAGIC:
            self._mapping.close()
            raise SlotError(path, "layout", "is not a stop slot")
        self._seen = self._mapping.words[_ACKNOWLEDGED_WORD]

    def raise_stop(self) -> int:
        """Request a stop; returns the word to pass to :meth:`acknowledged`."""
        words = self._mapping.words
        now = time.monotonic_ns()
        word = max(now, words[_RAISED_WORD] + 1)
        if word > _LARGEST_WORD:  # damaged: any changed word stops the arm
            word = now
        words[_RAISED_WORD] = word
        words[_COUNT_WORD] = (words[_COUNT_WORD] + 1) & _LARGEST_WORD
        return word

    def acknowledged(self, word: int) -> bool:
        """Whether the servo process has read the stop ``word`` or a later one."""
        return bool(self._mapping.words[_ACKNOWLEDGED_WORD] >= word)

    @property
    def count(self) -> int:
        """Number of stops raised since the cell was started."""
        return int(self._mapping.words[_COUNT_WORD])

    def poll(self) -> bool:
        """Whether a stop was raised since the last poll; acknowledges it. For the servo process only."""
        raised = self._mapping.words[_RAISED_WORD]
        if raised == self._seen:
            return False
        self._seen = raised
        self._mapping.words[_ACKNOWLEDGED_WORD] = raised
        return True

    def close(self) -> None:
        """Release the mapping. Idempotent."""
        self._mapping.close()
