"""Error boundary for untrusted messages of clients: an exception becomes a refusal, counted and logged at a limited
rate, and never ends the process.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

from stereoservo.daemon.process_control import write_log
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.messages.keys import InvalidKeyError
from stereoservo.messages.wire import MessageError, Reply

LOG_INTERVAL_S = 1.0
MAX_TEXT_CHARS = 2000
"""Maximum length of a refusal or a log line: both may quote a message of 64 KiB, and the last 2 000 events are stored.
"""
EXPECTED_ERRORS = (MessageError, InvalidKeyError, TransferError)
"""Exceptions raised by the gateway's own checks; their texts are written for clients."""


class RateLimit:
    """Rate limit of actions that clients can cause: a ``burst`` at once, then one per second.

    ``held_back``: number of rejected occurrences since the last accepted one.
    """

    def __init__(self, burst: int) -> None:
        self._burst = burst
        self._left = float(burst)
        self._filled_s = time.monotonic()
        self.held_back = 0

    def passes(self) -> bool:
        """Count an occurrence; returns whether it is within the limit. The caller resets ``held_back``."""
        now = time.monotonic()
        self._left = min(self._burst, self._left + max(0.0, now - self._filled_s) / LOG_INTERVAL_S)
        self._filled_s = now
        if self._left >= 1.0:
            self._left -= 1.0
            return True
        self.held_back += 1
        return False


class LimitedLog:
    """Log of occurrences that clients can cause, at most one line per second; ``count``: all occurrences."""

    def __init__(self) -> None:
        self.count = 0
        self._limit = RateLimit(1)

    def add(self, text: str) -> None:
        """Count an occurrence, and log it unless another line was logged within the last second."""
        self.count += 1
        if self._limit.passes():
            printable = "".join(character if character.isprintable() else " " for character in _cut(text))
            write_log("gateway", f"{printable} ({self.count} of this kind since the start)")


class Boundary:
    """Error boundary of one thread. ``refusals`` counts and logs messages whose handling raised an exception."""

    def __init__(self, boot: str) -> None:
        self.refusals = LimitedLog()
        self._boot = boot

    def take(self, key: str, work: Callable[[], None], refuse: Callable[[Reply], None]) -> None:
        """Do ``work`` for a message received on ``key``; if it raises, call ``refuse`` with the refusal."""
        try:
            work()
        except Exception as error:
            problem = str(error) if isinstance(error, EXPECTED_ERRORS) else f"{type(error).__name__}: {error}"
            self.refusals.add(f"refused a message on {key!r}: {problem}{_origin(error)}")
            refuse(Reply(accepted=False, message=_message(error), problems=(_cut(problem),), boot=self._boot))


def _message(error: Exception) -> str:
    """First sentence of a refusal."""
    if isinstance(error, TransferError):
        return "no goal could be made"
    if isinstance(error, EXPECTED_ERRORS):
        return "the message is not valid"
    return "the message could not be taken; the daemon's log says where it failed"


def _origin(error: Exception) -> str:
    """The code line that raised an unforeseen error; empty for the others."""
    if isinstance(error, EXPECTED_ERRORS):
        return ""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f" ({frame.name}, {frame.filename}:{frame.lineno})"


def _cut(text: str) -> str:
    rest = len(text) - MAX_TEXT_CHARS
    return text if rest <= 0 else f"{text[:MAX_TEXT_CHARS]}… ({rest} characters more)"
