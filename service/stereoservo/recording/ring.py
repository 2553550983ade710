"""Flight ring: the servo loop's last minutes in segments on disk, each of which can be replayed alone; bounded in time,
in bytes and by the free space of the disk; kept separately at a fault.

A segment is an ordinary recording that starts with a checkpoint of the state. The oldest ones are deleted completely.
Segments of a gateway that was killed remain, and its successor continues in a new segment.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import msgspec

from stereoservo.recording.flight_recorder import CHUNK_BYTES, FlightRecorder
from stereoservo.recording.step_messages import RecordedCheckpoint, RecordedStep, RecordingStart, StepMessage

SEGMENT_S = 60.0
SEGMENTS = 16
"""Largest size of a segment, as the ring's size divided by this number."""
AFTER_FAULT_S = 5.0
"""Time [s] after a fault that is kept with it."""
WAITING_BYTES = 16 << 20
CLOSING_S = 3.0
GATHERING_S = 0.04
"""Interval [s] between two batches that are written: waking a thread for each message costs more time
than writing it.
"""

Report = Callable[[str, str], None]
"""Called with the kind of an event, ``ring_kept`` or ``warning``, and its message."""


class RingLimits(NamedTuple):
    """``seconds`` and ``bytes`` of the ring; ``reserve_bytes`` of the disk remain free; ``kept``: number of faults
    whose ring is kept separately, each of at most ``bytes``.
    """

    seconds: float
    bytes: int
    reserve_bytes: int
    kept: int


class FlightRing:
    """The ring in a ``directory``: segments in ``ring/``, those of faults in ``kept/``.

    Never raises on errors of the disk: an error is reported once, and writing is tried again at later checkpoints;
    ``trouble`` contains it until a segment grows again. ``wall``: seconds of the wall clock; ``free``: bytes left on
    the disk of a path.
    """

    def __init__(
        self,
        directory: Path,
        limits: RingLimits,
        report: Report,
        wall: Callable[[], float] = time.time,
        free: Callable[[Path], int] = lambda path: shutil.disk_usage(path).free,
    ) -> None:
        self.segments, self.kept = directory / "ring", directory / "kept"
        self._limits, self._report, self._wall, self._free = limits, report, wall, free
        self._start: RecordingStart | None = None
        self._segment: FlightRecorder | None = None
        self._begun_ns = 0
        self._keep_ns: int | None = None
        self._begun_size = 0
        self.trouble = ""

    def take(self, message: StepMessage) -> None:
        """Write a message of the servo process; nothing is written before the first checkpoint of a stream."""
        try:
            if isinstance(message, RecordingStart):
                self._end()
                self._start = message
            elif isinstance(message, RecordedCheckpoint):
                self._checkpoint(message)
            elif self._segment is not None:
                self._write(message)
                if self._segment.size > self._begun_size:  # a chunk of it is on the disk
                    self.trouble = ""
                if self._segment.size > self._limits.bytes // SEGMENTS - CHUNK_BYTES:
                    self._end()
        except OSError as error:
            self._abandon(f"{error.strerror or error}")

    def keep(self, t_ns: int) -> None:
        """Keep the ring separately, with the steps after the fault at ``t_ns``."""
        if self._keep_ns is None:
            self._keep_ns = t_ns + int(AFTER_FAULT_S * 1e9)

    def close(self) -> None:
        """End the segment. Idempotent."""
        try:
            self._end()
            if self._keep_ns is not None:
                self._move_aside()
        except OSError as error:
            self._abandon(f"{error.strerror or error}")

    def _checkpoint(self, message: RecordedCheckpoint) -> None:
        """Start a segment if one is due and the disk has space for it; write the checkpoint."""
        if self._keep_ns is not None and message.t_ns >= self._keep_ns:
            self._end()
            self._move_aside()
        if self._segment is not None and not 0 <= message.t_ns - self._begun_ns < SEGMENT_S * 1e9:
            self._end()
        if not self._has_space():
            return
        if self._segment is None:
            self._begin(message.t_ns)
            message = msgspec.structs.replace(message, lost=0)  # a segment starts where a gap has ended
        self._write(message)

    def _write(self, message: RecordedStep | RecordedCheckpoint) -> None:
        """Append to the segment, if there is one. Raises OSError."""
        if self._segment is not None:
            self._segment.write(message)
            if self._segment.failure:
                raise OSError(self._segment.failure)

    def _begin(self, t_ns: int) -> None:
        if self._start is None:
            return
        self.segments.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._prune()
        stamp = datetime.fromtimestamp(self._wall(), UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        path = self.segments / f"{stamp}.mcap"
        self._segment = FlightRecorder(path, self._start.settings, self._start.fingerprint, durable=False)
        self._begun_ns, self._begun_size = t_ns, self._segment.size

    def _end(self) -> None:
        segment, self._segment = self._segment, None
        if segment is not None:
            segment.close()
            if segment.failure:
                raise OSError(segment.failure)

    def _abandon(self, trouble: str) -> None:
        """Report once why nothing is written, and leave the segment as it is."""
        if self._segment is not None:
            self._segment.abandon()
        self._segment = None
        before, self.trouble = self.trouble, trouble
        if trouble != before:
            self._report("warning", f"the flight ring in {self.segments} is not written: {trouble}")

    def _has_space(self) -> bool:
        place = self.segments
        while not place.exists():
            place = place.parent
        if self._free(place) < self._limits.reserve_bytes:
            self._end()
            self._abandon(f"less than {self._limits.reserve_bytes >> 20} MiB are free, which stay free")
            return False
        return True

    def _prune(self) -> None:
        """Delete the oldest segments until the others, and a new one, are within the limits."""
        found = sorted((path, path.stat()) for path in self.segments.glob("*.mcap"))
        total = sum(stat.st_size for _, stat in found) + self._limits.bytes // SEGMENTS
        oldest = self._wall() - self._limits.seconds
        for path, stat in found:
            if total <= self._limits.bytes and stat.st_mtime >= oldest:
                break
            path.unlink(missing_ok=True)
            total -= stat.st_size

    def _move_aside(self) -> None:
        """Move all segments to a directory of their own; delete the oldest of these directories."""
        self._keep_ns = None
        found = sorted(self.segments.glob("*.mcap"))
        if not found or self._limits.kept == 0:
            return
        stamp = datetime.fromtimestamp(self._wall(), UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        place = self.kept / stamp
        place.mkdir(mode=0o700, parents=True)
        for path in found:
            path.rename(place / path.name)
        for path in sorted(self.kept.iterdir())[: -self._limits.kept]:
            shutil.rmtree(path, ignore_errors=True)
        self._report("ring_kept", f"the minutes before the fault are kept in {place}")


class RingThread:
    """A `FlightRing` written by a thread: a disk that hangs causes a loss of steps in the ring, but does not block the
    gateway.

    ``said``: its reports, kind and message, for the gateway.
    """

    def __init__(self, directory: Path, limits: RingLimits) -> None:
        self.reports: deque[tuple[str, str]] = deque(maxlen=64)
        self._ring = FlightRing(directory, limits, lambda kind, message: self.reports.append((kind, message)))
        self._waiting: deque[StepMessage | int] = deque()
        self._bytes = self._lost = 0
        self._idle = False
        self._ending = threading.Event()
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="flight-ring", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """Why nothing is written; empty if writing works."""
        return self._ring.trouble

    def take(self, message: StepMessage) -> None:
        """Queue a message; if the queue was full, no message is queued before the next checkpoint."""
        size = _size(message)
        with self._changed:
            full = self._bytes + size > WAITING_BYTES
            if full or (self._lost and isinstance(message, RecordedStep)):
                self._lost += 1
                return
            if self._lost and isinstance(message, RecordedCheckpoint):
                message, self._lost = msgspec.structs.replace(message, lost=message.lost + self._lost), 0
            self._bytes += size
            self._put(message)

    def keep(self, t_ns: int) -> None:
        """Keep the ring separately, with the steps after the fault at ``t_ns``."""
        with self._changed:
            self._put(t_ns)

    def _put(self, item: StepMessage | int) -> None:
        self._waiting.append(item)
        if self._idle:
            self._idle = False
            self._changed.notify()

    def close(self) -> None:
        """Write the queued messages and end the segment, within ``CLOSING_S``. Idempotent."""
        self._ending.set()
        with self._changed:
            self._changed.notify()
        self._thread.join(CLOSING_S)

    def _run(self) -> None:
        while items := self._batch():
            for item in items:
                if isinstance(item, int):
                    self._ring.keep(item)
                else:
                    self._ring.take(item)
            with self._changed:
                self._bytes -= sum(_size(item) for item in items if not isinstance(item, int))
        self._ring.close()

    def _batch(self) -> list[StepMessage | int]:
        """All queued messages, once there are some; empty at the end."""
        self._ending.wait(GATHERING_S)
        with self._changed:
            while not self._waiting and not self._ending.is_set():
                self._idle = True
                self._changed.wait()
            self._idle = False
            items = list(self._waiting)
            self._waiting.clear()
            return items


def _size(message: StepMessage) -> int:
    """Number of bytes in a message."""
    if isinstance(message, RecordedStep):
        return len(message.data)
    return len(message.state) if isinstance(message, RecordedCheckpoint) else 0
