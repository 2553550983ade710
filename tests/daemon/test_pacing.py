"""The loop clock in virtual time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo.daemon.pacing import ClockPacing, Histogram

PERIOD = 4_000_000


class Time:
    """Virtual time with late wake-ups: each sleep overshoots by the next of ``overshoots``."""

    def __init__(self, overshoots: list[int] | None = None) -> None:
        self.now_ns = 1_000_000_000
        self.overshoots = overshoots or []

    def now(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9) + (self.overshoots.pop(0) if self.overshoots else 0)


def test_oversleeping_does_not_shift_the_grid() -> None:
    time = Time([300_000, 0, 900_000, 0, 100_000])
    loop = ClockPacing(PERIOD, now=time.now, sleep=time.sleep)
    woke = [loop.wait() - 1_000_000_000 for _ in range(5)]
    assert woke == [PERIOD + 300_000, 2 * PERIOD, 3 * PERIOD + 900_000, 4 * PERIOD, 5 * PERIOD + 100_000]
    assert (loop.cycles, loop.overruns, loop.skipped) == (5, 0, 0)
    assert loop.statistics().max_us == 900.0


@given(st.lists(st.integers(0, 5 * PERIOD), min_size=1, max_size=40))
def test_every_wake_lies_on_the_grid_and_every_missed_slot_is_counted(work: list[int]) -> None:
    time = Time()
    loop = ClockPacing(PERIOD, now=time.now, sleep=time.sleep)
    for amount in work:
        time.now_ns += amount
        woke = loop.wait()
        assert (woke - 1_000_000_000) % PERIOD == 0
    slots = (time.now_ns - 1_000_000_000) // PERIOD
    assert loop.cycles + loop.skipped == slots
    assert loop.overruns == sum(amount >= PERIOD for amount in work)


def test_work_beyond_the_period_skips_slots_and_never_bursts() -> None:
    time = Time()
    loop = ClockPacing(PERIOD, now=time.now, sleep=time.sleep)
    loop.wait()
    time.now_ns += 3 * PERIOD + 1
    assert loop.wait() - 1_000_000_000 == 5 * PERIOD
    assert (loop.overruns, loop.skipped) == (1, 3)
    assert loop.statistics().work_max_us == (3 * PERIOD + 1) // 1000
    assert loop.wait() - 1_000_000_000 == 6 * PERIOD


def test_a_sleep_that_returns_early_is_slept_again() -> None:
    time = Time([-1_000_000, -500_000])
    loop = ClockPacing(PERIOD, now=time.now, sleep=time.sleep)
    assert loop.wait() == 1_000_000_000 + PERIOD


def test_a_period_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        ClockPacing(0)


@given(st.lists(st.integers(0, 10**9), min_size=1, max_size=300), st.sampled_from([0.5, 0.9, 0.99, 1.0]))
def test_quantiles_are_within_a_bin_of_the_exact_ones(values: list[int], fraction: float) -> None:
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    exact = float(np.quantile(values, fraction, method="inverted_cdf"))
    found = histogram.quantile(fraction)
    assert exact <= found <= exact * (1 + 1 / 16) + 1
    assert histogram.maximum == max(values)


def test_an_empty_histogram_is_zero_and_small_values_are_exact() -> None:
    histogram = Histogram()
    assert histogram.quantile(0.5) == 0.0
    for value in range(32):
        histogram.add(value)
    assert [histogram.quantile((k + 1) / 32) for k in range(32)] == list(range(32))
