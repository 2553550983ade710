"""Threads that watch the time: one stops a device when commands cease, one notes where its own process stood still.

The watchdog is for devices that go on with the last command for ever. It serves a servo process that hangs, and ends
with it: a device without a watchdog of its own then goes on, which nothing in this computer can help. Take positions
within a lead (`position_output`) where the device has them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

LOOKS = 5
"""How often in a time-out the watchdog looks."""
SLEEP_S = 0.01
"""Between two looks at the time of :class:`StallWatch`."""


class CommandWatchdog:
    """Calls ``stop`` once where ``feed`` was not called for ``timeout_s``, from a thread of its own.

    ``stop`` must not raise, and must be safe beside the driver's own calls. ``expired``: commands have ceased; fed
    again, it begins anew.
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
        """A command was sent."""
        self._fed_s = time.monotonic()
        self.expired = False

    def close(self) -> None:
        """End the thread; ``stop`` is not called any more. Idempotent."""
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(self._timeout_s / LOOKS):
            if not self.expired and time.monotonic() - self._fed_s > self._timeout_s:
                self.expired = True
                self._stop()


class StallWatch:
    """A thread that only sleeps, and notes by how much it came late at most, ``longest_s`` [s]: then its process got no
    processor, or another thread kept the interpreter. A context manager that ends it.
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
