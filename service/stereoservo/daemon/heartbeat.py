"""Heartbeats of the daemon's processes, each in a slot of its own, and the watch that finds a process that hangs.

A beat states how long the next one may take at most, so that a process announces what takes long by its nature: a
camera that is opened, drives that are configured anew. No beat, no watch: a process is watched from its first beat on,
which it gives once it is ready.
"""

from __future__ import annotations

import struct
import time
from pathlib import Path
from typing import NamedTuple

from stereoservo.daemon.seqlock import SlotReader, SlotWriter

HEARTBEAT_LAYOUT = "Heartbeat.1"
_RECORD = struct.Struct("=qd")
HEARTBEAT_BYTES = _RECORD.size
BEAT_EVERY_NS = 20_000_000

SILENT_S = 0.5
"""A process beats each 20 ms; what is shorter than this may be a stall of the machine."""
SERVO_HANG_S = 2.0
"""Without its commands the drives stop by themselves within 0.5 s, and from a stall of a shared machine, of up to a
second, the core recovers (LOOP_GAP): what stands for longer cannot be trusted any more."""
DRIVER_CALL_S = 15.0
"""Drives that are connected, configured and enabled anew: the gateway waits 10 s for it."""
PLANT_HANG_S = 2.0
"""Without samples the core brakes and holds; from a stall of a shared machine it recovers."""
GATEWAY_HANG_S = 5.0
"""The arm is held after 0.5 s of its silence, so nothing hurries; its files are on disks that may be slow."""
SUPERVISOR_HANG_S = 0.8
"""Nobody ends a supervisor that hangs, for the arm would stop without need: the gateway tells it."""
REQUEST_S = 60.0
"""A client's request may have kernels compiled, where no warm-up did."""
VISION_HANG_S = 3.0
"""The slowest detectors search a whole image for some tenths of a second; the law brakes on prediction meanwhile."""
CAMERA_OPENS_S = 300.0
"""Libraries wait for a camera for up to a minute, several times over; the first image has a detector compiled."""


class HeartbeatWriter:
    """The heartbeat of one process. Raises SlotError where another one writes it."""

    def __init__(self, path: Path) -> None:
        self._slot = SlotWriter(path, HEARTBEAT_BYTES, HEARTBEAT_LAYOUT)
        self._limit_s = 0.0
        self._due_ns = 0

    def beat(self, limit_s: float) -> None:
        """Say that all is well, and that the next beat comes within ``limit_s``. To be called often: what says nothing
        new is not written.
        """
        now_ns = time.monotonic_ns()
        if limit_s != self._limit_s or now_ns >= self._due_ns:
            self._limit_s, self._due_ns = limit_s, now_ns + BEAT_EVERY_NS
            self._slot.write(_RECORD.pack(now_ns, limit_s))

    def close(self) -> None:
        """Release the slot. Idempotent."""
        self._slot.close()


class Beat(NamedTuple):
    """A heartbeat: its time, and how long the next one may take."""

    t_ns: int
    limit_s: float

    def silent_s(self, usual_s: float) -> float:
        """For how long the process has been silent, 0 where that is nothing to speak of (``SILENT_S``) or less than
        it has announced. ``usual_s``: its limit where it announces nothing.
        """
        age_s = (time.monotonic_ns() - self.t_ns) * 1e-9
        return age_s if age_s > (self.limit_s if self.limit_s > usual_s else SILENT_S) else 0.0


class HeartbeatReader:
    """A reader of a heartbeat. Raises SlotError."""

    def __init__(self, path: Path) -> None:
        self._slot = SlotReader(path, HEARTBEAT_LAYOUT)

    def poll(self) -> Beat | None:
        """The newest beat unless it was read before, else None."""
        record = self._slot.poll()
        return None if record is None else Beat(*_RECORD.unpack(record))

    def newest(self) -> Beat | None:
        """The newest beat, None before the first."""
        record = self._slot.newest()
        return None if record is None else Beat(*_RECORD.unpack(record))

    def process_lives(self) -> bool:
        """Whether the process that beats, or may hang, is there at all; False before its start."""
        return self._slot.writer_lives()

    def close(self) -> None:
        """Release the slot. Idempotent."""
        self._slot.close()


class HangWatch:
    """The watch over one process.

    Time counts from when the watch saw a beat, not from the beat: of what a watch did not see, it accuses nobody.
    """

    def __init__(self, path: Path) -> None:
        self._reader = HeartbeatReader(path)
        self._limit_s: float | None = None
        self._since_s = 0.0

    def begin(self) -> None:
        """A process starts: what is in the slot is its predecessor's."""
        self._reader.newest()
        self._limit_s = None

    def look(self, now_s: float, *, late: bool = False) -> str:
        """Words on how the process hangs, '' where it does not. ``late``: nobody looked in time, so that the
        measurement begins anew.
        """
        beat = self._reader.poll()
        if beat is not None:
            self._limit_s = beat.limit_s
        if beat is not None or late:
            self._since_s = now_s
        if self._limit_s is None or now_s - self._since_s <= self._limit_s:
            return ""
        return f"it gave no sign of life for {now_s - self._since_s:.1f} s (limit {self._limit_s:g} s)"
