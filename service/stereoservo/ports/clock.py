"""Clocks of drivers and loops: the monotonic clock of this host, and a virtual clock that simulations set."""

from __future__ import annotations

import time


class MonotonicClock:
    """``CLOCK_MONOTONIC`` of this host."""

    def now_ns(self) -> int:
        """Monotonic time [ns]."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Block for ``seconds``."""
        time.sleep(seconds)


class VirtualClock:
    """A clock that is set by its owner; it starts at one second, so that the stamp 0 ('never') is always old."""

    def __init__(self, start_ns: int = 1_000_000_000) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Virtual time [ns]."""
        return self._now_ns

    def advance_to(self, t_ns: int) -> None:
        """Set the time to ``t_ns``. Raises ValueError if that is in the past."""
        if t_ns < self._now_ns:
            raise ValueError(f"virtual time cannot run backwards: now {self._now_ns} ns, asked {t_ns} ns")
        self._now_ns = t_ns

    def sleep(self, seconds: float) -> None:
        """Advance by ``seconds``, at least by one nanosecond."""
        self._now_ns += max(1, round(seconds * 1e9))
