"""Goals of drives that lag, with and without damping: the overshoot is that of the linear loop."""

from __future__ import annotations

import math

import pytest

from stereoservo_sim.experiments.late_drives import LAW, damped_goal


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_overshoot_of_drives_that_lag_is_that_of_their_damping_ratio(damping: float) -> None:
    """``T p² + (1 + κ) p + λ``; the core's filters and its steps of 10 ms add some hundredths."""
    gain, lag_s = 8.0, 0.1
    flown = damped_goal(1, "lag 0.1 s", gain, damping)
    assert flown is not None
    end, overshoot = flown
    ratio = (1.0 + damping) / (2.0 * math.sqrt(gain * lag_s))
    print(f"law {LAW}: {overshoot:.4f} after {end.seconds:.2f} s")
    assert end.kind == "goal_reached"
    assert overshoot == pytest.approx(math.exp(-math.pi * ratio / math.sqrt(1.0 - ratio**2)), abs=0.03)
