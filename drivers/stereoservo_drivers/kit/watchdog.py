"""A watchdog for devices that go on with the last command for ever: a thread that stops them when commands cease.

It serves a servo process that hangs. It ends with that process: a device without a watchdog of its own then goes on,
which nothing in this computer can help. Take positions within a lead (`position_output`) where the device has them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

LOOKS = 5
"""How often in a time-out the watchdog looks."""


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
