"""Stamps of a device's own clock against a simulated one that runs apart and whose samples come late."""

from __future__ import annotations

import numpy as np
import pytest

from stereoservo_drivers.kit.timing import DeviceClock

PERIOD_S, FASTEST_S, LATEST_S = 0.008, 0.0003, 0.009


@pytest.mark.parametrize("drift", [-1e-4, 0.0, 1e-4])
@pytest.mark.parametrize("seed", range(3))
def test_stamps_are_late_by_the_fastest_way_and_never_of_the_future(seed, drift):
    rng = np.random.default_rng(seed)
    true_s = 40.0 + PERIOD_S * np.arange(5000)
    device_s = 4711.0 + (true_s - true_s[0]) * (1.0 + drift)
    arrived_ns = np.round((true_s + rng.uniform(FASTEST_S, LATEST_S, len(true_s))) * 1e9).astype(int)
    arrived_ns = np.maximum.accumulate(arrived_ns)
    clock = DeviceClock()
    stamps = np.array([clock.stamp(d, int(n)) for d, n in zip(device_s, arrived_ns, strict=True)])
    assert (stamps <= arrived_ns).all()
    assert (np.diff(stamps) >= 0).all()
    late_s = (stamps * 1e-9 - true_s)[250:]
    assert late_s.min() >= FASTEST_S - 1e-6
    # a sample within 0.7 ms of the fastest is among the last 250 in all but e^-20 of cases; both drifts widen meanwhile
    assert late_s.max() <= FASTEST_S + 0.7e-3 + (2e-4 + 1e-4) * 250 * PERIOD_S


def test_a_device_that_starts_anew_is_followed():
    clock = DeviceClock()
    assert clock.stamp(4711.0, 10_000_000_000) == 10_000_000_000
    assert clock.stamp(4711.008, 10_009_000_000) == pytest.approx(10_008_000_000, abs=2_000)
    assert clock.stamp(0.5, 12_000_000_000) == 12_000_000_000
    assert clock.stamp(0.508, 12_008_000_000) == 12_008_000_000
