"""Threads that monitor time: one stops a device when commands cease, one detects when its own process was suspended.

The watchdog is for devices that continue with the last command indefinitely. It protects against a servo process that
hangs, but ends with that process: a device without a watchdog of its own then continues, which nothing in this computer
can prevent. Use positions within a lead (`position_output`) if the device has them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from stereoservo.ports.devices import DriverError, JointState

LOOKS = 5
"""Number of checks of the watchdog per time-out."""
SLEEP_S = 0.01
"""Interval between two checks of :class:`StallWatch` [s]."""


class CommandWatchdog:
    """Calls ``stop`` once if ``feed`` was not called for ``timeout_s``, from a separate thread.

    ``stop`` must not raise, and must be safe concurrently with the driver's own calls. ``expired``: commands have
    ceased; fed again, it restarts.
    """

    def __init__(self, timeout_s: float, stop: Callable[[], None]) -> None:
        self._timeout_s = timeout_s
        self._stop = stop
        self._fed_s = time.monotonic()
        self._ended = threading.Event()
        self.expired = True
        self._thread = threading.Thread(target=self._watch, name="command-watchdog", daemon=True)
        self._thread.start()

    def feed(self) -> None:
        """Record that a command was sent."""
        self._fed_s = time.monotonic()
        self.expired = False

    def close(self) -> None:
        """End the thread; ``stop`` is no longer called. Idempotent."""
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(self._timeout_s / LOOKS):
            if not self.expired and time.monotonic() - self._fed_s > self._timeout_s:
                self.expired = True
                self._stop()


class StallWatch:
    """A thread that only sleeps, and records its largest delay, ``longest_s`` [s]: then its process was not scheduled,
    or another thread held the interpreter. A context manager that ends it.
    """

    def __init__(self) -> None:
        self.longest_s = 0.0
        self._last_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="stall-watch", daemon=True)

    def _watch(self) -> None:
        while not self._ended.wait(SLEEP_S):
            self._note()
        self._note()

    def _note(self) -> None:
        now = time.monotonic()
        self.longest_s = max(self.longest_s, now - self._last_s - SLEEP_S)
        self._last_s = now

    def __enter__(self) -> Self:
        self._last_s = time.monotonic()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()


# -- freshness of samples --------------------------------------------------------------------------------------


class Freshness:
    """Stores the newest sample. If it is older than ``limit_s``, reading it is a fault."""

    def __init__(self, limit_s: float) -> None:
        self._limit_ns = round(limit_s * 1e9)
        self._newest: JointState | None = None

    def put(self, sample: JointState) -> JointState:
        """Store a new sample, and return it."""
        self._newest = sample
        return sample

    def newest(self, now_ns: int) -> JointState:
        """The newest sample. Raises DriverError: ``no_sample`` before the first, ``stale`` beyond the limit."""
        if self._newest is None:
            raise DriverError("no_sample", "the device has told no positions yet", retry=True)
        age_ns = now_ns - self._newest.t_ns
        if age_ns > self._limit_ns:
            raise DriverError(
                "stale",
                f"the newest positions are {age_ns * 1e-6:.0f} ms old, {self._limit_ns * 1e-6:.0f} ms are allowed; is "
                "the device powered and its cable whole?",
                retry=True,
                age_ms=age_ns * 1e-6,
            )
        return self._newest


# -- clocks of devices -----------------------------------------------------------------------------------------


class DeviceClock:
    """Converts times of a device's own clock to ``context.clock``, by the samples with the shortest delay.

    ``drift``: upper bound of the relative drift of the two clocks. The delay of the fastest sample remains in the
    stamps, which are late by it.
    """

    def __init__(self, drift: float = 2e-4) -> None:
        self._drift = drift
        self._offset_ns = self._device_ns = self._stamp_ns = 0

    def stamp(self, device_s: float, now_ns: int) -> int:
        """Time [ns] of the sample that the device measured at its own time ``device_s`` and that was received at
        ``now_ns``.

        It is never later than ``now_ns`` and never goes back. A device whose time goes back has restarted.
        """
        device_ns = round(device_s * 1e9)
        lateness_ns = now_ns - device_ns
        if not self._stamp_ns or device_ns < self._device_ns:
            self._offset_ns = lateness_ns
        else:
            widened_ns = self._offset_ns + round(self._drift * (device_ns - self._device_ns))
            self._offset_ns = min(widened_ns, lateness_ns)
        self._device_ns = device_ns
        self._stamp_ns = max(self._stamp_ns, device_ns + self._offset_ns)
        return self._stamp_ns
