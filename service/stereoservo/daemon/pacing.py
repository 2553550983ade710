"""Pacing of the servo loop by a clock: absolute deadlines on a fixed grid, timing statistics, real-time scheduling.

Slot k is always at ``start + k * period``, so a late wake-up does not shift later slots. After a cycle longer than its
slot, the missed slots are skipped; there is no burst to catch up.
"""

from __future__ import annotations

import ctypes
import gc
import mmap
import os
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from stereoservo.messages.servo_state import LoopStatistics

_SUB_BITS = 4  # 16 bins per octave: quantiles accurate to 6 %
_BINS = 48 << _SUB_BITS


class Histogram:
    """Histogram of non-negative integers in bins of constant relative width (1/16); exact below 32."""

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self.count = 0
        self.maximum = 0

    def add(self, value: int) -> None:
        """Count ``value``; a negative one counts as 0."""
        value = max(value, 0)
        self._bins[_bin(value)] += 1
        self.count += 1
        self.maximum = max(self.maximum, value)

    def quantile(self, fraction: float) -> float:
        """Value that ``fraction`` of the counted values do not exceed (upper edge of its bin, at most the maximum)."""
        if not self.count:
            return 0.0
        rank = fraction * self.count
        seen = 0
        for index, count in enumerate(self._bins):
            seen += count
            if count and seen >= rank:
                return float(min(_upper_edge(index), self.maximum))
        return float(self.maximum)


def _bin(value: int) -> int:
    octave = max(value.bit_length() - _SUB_BITS - 1, 0)
    return min((octave << _SUB_BITS) + (value >> octave), _BINS - 1)


def _upper_edge(index: int) -> int:
    octave = max((index >> _SUB_BITS) - 1, 0)
    return ((index - (octave << _SUB_BITS) + 1) << octave) - 1


class ClockPacing:
    """Pacing of cycles at ``start + k * period``. ``now`` and ``sleep`` are injected for virtual time.

    Time spent stopped in a debugger or a suspended machine shows as skipped slots, never as a burst of
    cycles.
    """

    def __init__(
        self,
        period_ns: int,
        *,
        now: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        if period_ns <= 0:
            raise ValueError(f"period {period_ns} ns; it must be positive")
        self.period_ns = period_ns
        self._now = now
        self._sleep = sleep
        self._deadline = now()
        self._woke = self._deadline
        self.cycles = 0
        self.overruns = 0
        self.skipped = 0
        self._lateness = Histogram()
        self._work = Histogram()

    def wait(self) -> int:
        """Sleep until the next slot; returns the time of waking [ns]."""
        before = self._now()
        if self.cycles:
            self._work.add((before - self._woke) // 1000)
        target = self._deadline + self.period_ns
        if before >= target:
            behind = (before - target) // self.period_ns + 1
            self.overruns += 1
            self.skipped += behind
            target += behind * self.period_ns
        now = before
        while now < target:
            self._sleep((target - now) * 1e-9)
            now = self._now()
        self._deadline = target
        self._woke = now
        self._lateness.add((now - target) // 1000)
        self.cycles += 1
        return now

    def statistics(self) -> LoopStatistics:
        """Counts and quantiles since the start."""
        return LoopStatistics(
            rate_hz=1e9 / self.period_ns,
            cycles=self.cycles,
            overruns=self.overruns,
            skipped=self.skipped,
            p50_us=self._lateness.quantile(0.5),
            p99_us=self._lateness.quantile(0.99),
            max_us=float(self._lateness.maximum),
            work_p50_us=self._work.quantile(0.5),
            work_p99_us=self._work.quantile(0.99),
            work_max_us=float(self._work.maximum),
        )


CYCLE_LOG_VARIABLE = "STEREOSERVO_CYCLE_LOG"
"""Environment variable: file of zeros in which the loop logs its cycles: their number, then four 64-bit words each."""
_CYCLE = struct.Struct("=4q")
CYCLE_BYTES = _CYCLE.size


class LoggedPacing(ClockPacing):
    """`ClockPacing` that logs every cycle in a mapped file: time of waking, delay [ns], duration of the previous
    cycle's work [ns], number of slots that this one skipped. Cycles beyond the end of the file are not logged.
    """

    def __init__(self, period_ns: int, path: Path) -> None:
        super().__init__(period_ns)
        with path.open("r+b") as file:
            self._log = mmap.mmap(file.fileno(), 0)
        self._capacity = len(self._log) // CYCLE_BYTES - 1

    def wait(self) -> int:
        """Sleep until the next slot, and log it; returns the time of waking [ns]."""
        work, skipped = self._now() - self._woke, self.skipped
        woke = super().wait()
        if self.cycles <= self._capacity:
            row = (woke, woke - self._deadline, work, self.skipped - skipped)
            _CYCLE.pack_into(self._log, self.cycles * CYCLE_BYTES, *row)
            self._log[:8] = self.cycles.to_bytes(8, sys.byteorder)
        return woke


def clock_pacing(period_ns: int) -> ClockPacing:
    """The pacing of a loop; a `LoggedPacing` if ``STEREOSERVO_CYCLE_LOG`` names its file."""
    log = os.environ.get(CYCLE_LOG_VARIABLE)
    return LoggedPacing(period_ns, Path(log)) if log else ClockPacing(period_ns)


def release_memory() -> None:
    """Return memory that is unused after loading to the system, and have the garbage collector skip what is loaded."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # glibc only; other libraries keep less freed memory
        trim(0)
    gc.freeze()


def prepare_realtime(priority: int) -> list[str]:
    """Release memory that is unused after loading, freeze the garbage collector's generations and request SCHED_FIFO
    (``priority`` 0: do not change the scheduler).

    Returns warnings, each with its remedy; the loop also runs without real-time priority, but may wake late under load.
    """
    release_memory()
    if priority == 0:
        return []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return [
            f"no permission for SCHED_FIFO priority {priority}: the loop may wake late under load. Cure: "
            f"`ulimit -r {priority}` before the start, or LimitRTPRIO={priority} in the systemd unit, "
            "or servo.priority = 0 in the cell file to stop asking"
        ]
    return []


@contextmanager
def realtime_for_a_while(priority: int) -> Iterator[list[str]]:
    """Context manager: `prepare_realtime`, undone at its end. Yields the warnings."""
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield prepare_realtime(priority)
    finally:
        # Without privileges the flag can be set, but not cleared.
        os.sched_setscheduler(0, before | os.SCHED_RESET_ON_FORK, parameters)
        gc.unfreeze()


@contextmanager
def ordinary_for_a_while() -> Iterator[None]:
    """Context manager: this thread without real-time priority, for work that must not delay others."""
    before, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    try:
        yield
    finally:
        os.sched_setscheduler(0, before | os.SCHED_RESET_ON_FORK, parameters)
