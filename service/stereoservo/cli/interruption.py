"""Handler of Ctrl-C that raises KeyboardInterrupt and sets a flag for loops to poll, since an exception raised in a
destructor or a library's callback is lost.
"""

from __future__ import annotations

import signal
from types import FrameType

_asked = False


def install() -> None:
    """Install the handler: an interrupt raises KeyboardInterrupt and sets the flag."""
    signal.signal(signal.SIGINT, _interrupt)


def check() -> None:
    """Raise KeyboardInterrupt where an interrupt is pending. For loops that wait while the arm moves."""
    if _asked:
        raise KeyboardInterrupt


def _interrupt(signum: int, frame: FrameType | None) -> None:
    global _asked  # noqa: PLW0603  a process has one
    _asked = True
    raise KeyboardInterrupt
