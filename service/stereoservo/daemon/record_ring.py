"""Ring of records in shared memory, from the servo loop to the gateway: one writer, which never waits and makes no
system calls, and one reader.

A record that does not fit is not written, which is reported to the writer. Each record has a CRC-32 over its position
and bytes, and the reader relies on it alone, because Python has no memory fences. The reader announces by its own word
that it has begun to read; the writer restarts its stream for each new word.
"""

from __future__ import annotations

import struct
import time
import zlib
from pathlib import Path

from stereoservo.daemon.seqlock import SlotError, create_slot, map_slot

LAYOUT = "Records.1"
CAPACITY = 4 << 20
"""Capacity [bytes]: some seconds of steps."""
_HEADER_BYTES = 64
_WRITTEN_WORD, _READ_WORD, _READER_WORD = 5, 6, 7  # the previous words are those of a slot
_RECORD = struct.Struct("<II")
_SKIP = 0xFFFFFFFF
"""Value of a length if the next record is at the beginning of the ring."""
TRIES = 5
"""Number of polls to wait for a record with a wrong checksum: it may not be completely visible yet."""


class RingWriter:
    """The writer's end; creates the file if it is missing. Raises SlotError, OSError."""

    def __init__(self, path: Path) -> None:
        create_slot(path, CAPACITY, LAYOUT)
        self._mapping, self._capacity = map_slot(path, LAYOUT)
        self._words, self._bytes = self._mapping.words, self._mapping.bytes
        written, read = self._words[_WRITTEN_WORD], self._words[_READ_WORD]
        if written % 8 or not 0 <= written - read <= self._capacity:  # damaged
            written = 0
            self._words[_READ_WORD] = 0
        self._written = self._words[_WRITTEN_WORD] = written

    @property
    def reader(self) -> int:
        """The word of the current reader; 0: none."""
        return int(self._words[_READER_WORD])

    def write(self, record: bytes) -> bool:
        """Append a record; False if there is no free space for it."""
        written, capacity = self._written, self._capacity
        size = 8 + len(record) + -len(record) % 8
        at = written % capacity
        skipped = capacity - at if at + size > capacity else 0
        used = written - self._words[_READ_WORD]
        if not 0 <= used <= capacity:  # damaged: pending records are discarded
            self._words[_WRITTEN_WORD] = self._words[_READ_WORD] = written
            return False
        if used + skipped + size > capacity:
            return False
        if skipped:
            _RECORD.pack_into(self._bytes, _HEADER_BYTES + at, _SKIP, 0)
            written, at = written + skipped, 0
        at += _HEADER_BYTES
        _RECORD.pack_into(self._bytes, at, len(record), zlib.crc32(record, written & 0xFFFFFFFF))
        self._bytes[at + 8 : at + 8 + len(record)] = record
        self._words[_WRITTEN_WORD] = self._written = written + size
        return True

    def close(self) -> None:
        """Release the mapping; the file stays. Idempotent."""
        self._mapping.close()


class RingReader:
    """The reader's end. Raises SlotError if the ring does not exist (yet)."""

    def __init__(self, path: Path) -> None:
        self._mapping, self._capacity = map_slot(path, LAYOUT)
        self._words, self._bytes = self._mapping.words, self._mapping.bytes
        self._path = path
        self._tries = 0
        self.reading = False
        self.detach()

    def attach(self) -> None:
        """Start reading at the current write position, and make the writer restart its stream."""
        self._words[_READ_WORD] = self._words[_WRITTEN_WORD]
        self._words[_READER_WORD] = time.monotonic_ns()
        self._tries, self.reading = 0, True

    def detach(self) -> None:
        """Stop reading: nothing more is written for this reader."""
        self._words[_READER_WORD] = 0
        self.reading = False

    def read(self, limit: int) -> list[bytes]:
        """Up to ``limit`` records, oldest first. Raises SlotError if the ring is damaged; reading then restarts at the
        current write position.
        """
        found: list[bytes] = []
        at, end = self._words[_READ_WORD], self._words[_WRITTEN_WORD]
        while self.reading and at != end and len(found) < limit:
            record, after = self._record(at, end)
            if after < 0:
                self._tries += 1
                if self._tries >= TRIES:
                    self.attach()
                    raise SlotError(self._path, "damaged", "a record is damaged; those that waited are lost")
                break
            self._tries, at = 0, after
            if record is not None:
                found.append(record)
            self._words[_READ_WORD] = at
        return found

    def _record(self, at: int, end: int) -> tuple[bytes | None, int]:
        """The record at position ``at`` (None for a jump to the beginning), and the next position; -1 if it is
        invalid.
        """
        place = at % self._capacity
        if at % 8 or not 0 < end - at <= self._capacity:
            return None, -1
        length, crc = _RECORD.unpack_from(self._bytes, _HEADER_BYTES + place)
        if length == _SKIP:
            return None, at + self._capacity - place
        after = at + 8 + length + -length % 8
        if after > end or place + 8 + length > self._capacity:
            return None, -1
        begin = _HEADER_BYTES + place + 8
        record = bytes(self._bytes[begin : begin + length])
        return (record, after) if zlib.crc32(record, at & 0xFFFFFFFF) == crc else (None, -1)

    def close(self) -> None:
        """Stop reading, and release the mapping. Idempotent."""
        if self._mapping.fd >= 0:
            self.detach()
            self._words = self._bytes = memoryview(b"")
        self._mapping.close()
