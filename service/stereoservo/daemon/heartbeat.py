"""Heartbeats of the daemon's processes, each in its own slot, and the watchdog that detects a hanging process.

Each beat states the time limit of the next one, so a process can announce slow operations, such as opening a camera or
reconfiguring drives. A process is watched from its first beat on, which it writes once it is ready.
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
"""Shortest reported silence [s]: a process beats every 20 ms; a shorter silence may be a stall of the machine."""
SERVO_HANG_S = 2.0
"""Time limit of the servo process [s]. Without its commands the drives stop within 0.5 s, and the core recovers from
stalls of a shared machine of up to a second (LOOP_GAP). After a longer stall the process cannot be trusted.
"""
DRIVER_CALL_S = 15.0
"""Time limit while drives are reconnected, configured and enabled [s]: the gateway waits 10 s for it."""
PLANT_HANG_S = 2.0
"""Time limit of the plant [s]. Without samples the core brakes and holds; it recovers from a machine's stall."""
GATEWAY_HANG_S = 5.0
"""Time limit of the gateway [s]. It is not critical, because the arm is held after 0.5 s of silence; the gateway's
disks may be slow.
"""
SUPERVISOR_HANG_S = 0.8
"""Time limit of the supervisor [s]. A hanging supervisor is not ended, because the arm would stop unnecessarily; the
gateway reports it.
"""
REQUEST_S = 60.0
"""Time limit of a client's request [s]: it may compile kernels that no warm-up has compiled."""
VISION_HANG_S = 3.0
"""Time limit of a vision process [s]: the slowest detectors search a whole image for some tenths of a second; meanwhile
the law brakes, using the prediction.
"""
CAMERA_OPENS_S = 300.0
"""Time limit while a camera is opened [s]: libraries wait for it for up to a minute, several times; the detector is
compiled for the first image.
"""


class HeartbeatWriter:
    """Writer of the heartbeat of one process. Raises SlotError if another process writes it."""

    def __init__(self, path: Path) -> None:
        self._slot = SlotWriter(path, HEARTBEAT_BYTES, HEARTBEAT_LAYOUT)
        self._limit_s = 0.0
        self._due_ns = 0

    def beat(self, limit_s: float) -> None:
        """Report that the process is alive, and that the next beat follows within ``limit_s``. To be called often;
        redundant beats are not written.
        """
        now_ns = time.monotonic_ns()
        if limit_s != self._limit_s or now_ns >= self._due_ns:
            self._limit_s, self._due_ns = limit_s, now_ns + BEAT_EVERY_NS
            self._slot.write(_RECORD.pack(now_ns, limit_s))

    def close(self) -> None:
        """Release the slot. Idempotent."""
        self._slot.close()


class Beat(NamedTuple):
    """A heartbeat: its time, and the time limit of the next one."""

    t_ns: int
    limit_s: float

    def silent_s(self, usual_s: float) -> float:
        """Time since this beat [s], 0 if it is shorter than ``SILENT_S`` or than the time that the process has
        announced. ``usual_s``: its usual limit, without an announcement.
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
        """Whether the process that writes the heartbeat exists (it may hang); False before its start."""
        return self._slot.writer_lives()

    def close(self) -> None:
        """Release the slot. Idempotent."""
        self._slot.close()


class HangWatch:
    """Watchdog of one process.

    Time is measured from the time at which the watchdog read a beat, not from the beat itself, so that delays of the
    watchdog do not count as a hang.
    """

    def __init__(self, path: Path) -> None:
        self._reader = HeartbeatReader(path)
        self._limit_s: float | None = None
        self._since_s = 0.0

    def begin(self) -> None:
        """Start watching a new process: the beat in the slot is of its predecessor and is discarded."""
        self._reader.newest()
        self._limit_s = None

    def check(self, now_s: float, *, late: bool = False) -> str:
        """Description of how the process hangs, '' if it does not. ``late``: the watchdog itself was late, so the
        measurement starts again.
        """
        beat = self._reader.poll()
        if beat is not None:
            self._limit_s = beat.limit_s
        if beat is not None or late:
            self._since_s = now_s
        if self._limit_s is None or now_s - self._since_s <= self._limit_s:
            return ""
        return f"it gave no sign of life for {now_s - self._since_s:.1f} s (limit {self._limit_s:g} s)"
