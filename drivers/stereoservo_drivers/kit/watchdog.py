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
