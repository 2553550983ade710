"""The adaptive gain: its formula, and that it is bounded, monotone and without a step."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereoservo.core.sources.law import GainCurve, adaptive_gain, gain_at

gains = st.floats(0.05, 50.0)
errors = st.floats(0.0, 3000.0)


@given(gains, gains, st.floats(0.01, 100.0), errors, errors)
def test_bounded_monotone_and_as_steep_as_stated(near, far, slope, e1, e2):
    curve = GainCurve(near, far, slope)
    low, high = sorted((e1, e2))
    a, b = gain_at(curve, low), gain_at(curve, high)
    assert min(near, far) <= min(a, b)
    assert max(a, b) <= max(near, far)
    assert (a - b) * (near - far) >= 0
    # |dλ/de| is largest at no error: slope per 100 px
    assert abs(a - b) <= slope * (high - low) / 100.0 + 1e-12
    assert gain_at(curve, 0.0) == pytest.approx(near)
    assert gain_at(curve, math.inf) == pytest.approx(far)


def test_the_stated_formula_and_slope():
    near, far, slope = 4.0, 0.5, 10.0
    curve = GainCurve(near, far, slope)
    for e in (0.0, 1.0, 35.0, 200.0):
        expected = (near - far) * math.exp(-slope * (e / 100) / (near - far)) + far
        assert gain_at(curve, e) == pytest.approx(expected, rel=1e-14)
    assert (gain_at(curve, 1e-4) - near) / 1e-6 == pytest.approx(-slope, rel=1e-3)
    rising = GainCurve(far, near, slope)
    assert (gain_at(rising, 1e-4) - far) / 1e-6 == pytest.approx(slope, rel=1e-3)
    assert gain_at(rising, 1e6) == near


def test_defined_at_the_edges():
    curve = GainCurve(4.0, 0.5, 10.0)
    assert gain_at(curve, None) == 0.5
    assert adaptive_gain(*curve, math.nan) == 0.5
    assert gain_at(GainCurve(0.5, 4.0, 10.0), None) == 0.5
    assert gain_at(curve, -1.0) == 4.0
    assert {gain_at(GainCurve(2.0, 2.0, 1.0), e) for e in (0.0, 1.0, math.inf, None)} == {2.0}
    steps = np.diff([gain_at(curve, e) for e in np.linspace(0, 500, 5001)])
    assert np.abs(steps).max() <= 10.0 * 0.1 / 100 * (1 + 1e-12)
    assert gain_at(GainCurve(1.0 + 1e-15, 1.0, 10.0), 50.0) == pytest.approx(1.0)
