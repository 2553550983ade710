"""Ctrl-C: a handler that raises KeyboardInterrupt and sets a flag for loops to poll, since an exception raised in a
destructor or a library's callback is lost; and one for servers, which raises nothing and ends within a bounded time.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

STDERR = 2
EXIT_FORCED = 130
_asked = False


def install() -> None:
    """Install the handler: an interrupt raises KeyboardInterrupt and sets the flag."""
    signal.signal(signal.SIGINT, _interrupt)


def check() -> None:
    """Raise KeyboardInterrupt if an interrupt is pending. For loops that wait while the arm moves."""
    if _asked:
        raise KeyboardInterrupt


def _interrupt(signum: int, frame: FrameType | None) -> None:
    global _asked  # noqa: PLW0603  a process has one
    _asked = True
    raise KeyboardInterrupt


class ShutdownRequest:
    """Whether a server was requested to end. ``wake``: called in the main thread when it is."""

    def __init__(self) -> None:
        self.asked = False
        self.wake: Callable[[], None] = lambda: None


@contextmanager
def graceful_shutdown(seconds: float) -> Iterator[ShutdownRequest]:
    """Context manager in which SIGINT and SIGTERM request the end and raise nothing. An exception at an arbitrary place
    breaks an event loop: a task may lose a step that is then waited for, and in a destructor the exception itself is
    lost.

    A process that has not ended ``seconds`` after the request is ended by force, and the stacks of its threads are
    printed. A second signal ends it at once.
    """
    found = ShutdownRequest()

    def ask(signum: int, frame: FrameType | None) -> None:
        if found.asked:
            os.write(STDERR, b"asked twice: ended at once\n")
            os._exit(EXIT_FORCED)
        found.asked = True
        faulthandler.dump_traceback_later(seconds, exit=True, file=STDERR)  # needs neither this thread nor the GIL
        found.wake()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield found
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def unfinished_threads(seconds: float) -> list[str]:
    """Names of the other threads that have not ended within ``seconds``: an exit waits for some of them, and interrupts
    others inside their libraries.
    """
    until = time.monotonic() + seconds
    others = [thread for thread in threading.enumerate() if thread is not threading.current_thread()]
    for thread in others:
        thread.join(max(0.0, until - time.monotonic()))
    return [thread.name for thread in others if thread.is_alive()]


def exit_now(code: int) -> None:
    """End the process without waiting for other threads."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
