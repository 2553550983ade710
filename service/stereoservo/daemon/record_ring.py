"""Ring of records in shared memory, from the servo loop to the gateway: one writer, which never waits and never calls
the system, and one reader.

A record that does not fit is not written, and the writer knows. Each record carries a CRC-32 over its place and bytes,
and the reader believes nothing else: Python cannot fence memory. The reader says by a word of its own that it has
begun to read; the writer begins its stream anew for each such word.
"""

from __future__ import annotations

import struct
import time
import zlib
from pathlib import Path

from stereoservo.daemon.seqlock import SlotError, create_slot, map_slot

LAYOUT = "Records.1"
CAPACITY = 4 << 20
"""Bytes: some seconds of steps."""
_HEADER_BYTES = 64
_WRITTEN_WORD, _READ_WORD, _READER_WORD = 5, 6, 7  # the words before are those of a slot
_RECORD = struct.Struct("<II")
_SKIP = 0xFFFFFFFF
"""In place of a length: the next record is at the beginning of the ring."""
TRIES = 5
"""Polls for which a record whose bytes do not fit its checksum is waited for: it may be on its way."""


class RingWriter:
    """The writer's end; creates the file where it is missing. Raises SlotError, OSError."""

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
        """The word of the reader that has begun to read; 0: there is none."""
        return int(self._words[_READER_WORD])

    def write(self, record: bytes) -> bool:
        """Append a record; False where there is no room for it now."""
        written, capacity = self._written, self._capacity
        size = 8 + len(record) + -len(record) % 8
        at = written % capacity
        skipped = capacity - at if at + size > capacity else 0
        used = written - self._words[_READ_WORD]
        if not 0 <= used <= capacity:  # damaged: what waits is given up
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
    """The reader's end. Raises SlotError where there is no such ring (yet)."""

    def __init__(self, path: Path) -> None:
        self._mapping, self._capacity = map_slot(path, LAYOUT)
        self._words, self._bytes = self._mapping.words, self._mapping.bytes
        self._path = path
        self._tries = 0
        self.reading = False
        self.detach()

    def attach(self) -> None:
        """Begin to read what is written from now on, and have the writer begin its stream anew."""
        self._words[_READ_WORD] = self._words[_WRITTEN_WORD]
        self._words[_READER_WORD] = time.monotonic_ns()
        self._tries, self.reading = 0, True

    def detach(self) -> None:
        """Read no more: nothing is written for this reader."""
        self._words[_READER_WORD] = 0
        self.reading = False

    def read(self, limit: int) -> list[bytes]:
        """Up to ``limit`` records, oldest first. Raises SlotError where the ring is damaged; then it is read anew,
        from what is written from now on.
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
        """The record at a place, None for one that leads to the beginning, and where the next one is; -1 where its
        bytes do not fit.
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
        """Read no more, and release the mapping. Idempotent."""
        if self._mapping.fd >= 0:
            self.detach()
            self._words = self._bytes = memoryview(b"")
        self._mapping.close()
