"""Profiles: monotone from 0 to 1, with the rates that they say, one component after the other where asked."""

import numpy as np
import pytest

from oracles.displacement_path import progress_rate
from stereoservo.planning.motion_frame import progress
from stereoservo.planning.path_search import SHAPES, shapes


@pytest.mark.parametrize("shape", sorted({s for three in SHAPES.values() for s in three}))
def test_monotone_from_0_to_1_and_rates_are_derivatives(shape):
    sigma = np.linspace(0, 1, 2001)
    mu = np.array([progress(shape, s) for s in sigma])
    assert mu[0] == 0.0
    assert mu[-1] == pytest.approx(1.0, abs=1e-15)
    assert (np.diff(mu) >= 0).all()
    rates = np.array([progress_rate(shape, s) for s in sigma])
    # central differences of a C1 function with bounded second derivative
    np.testing.assert_allclose((mu[2:] - mu[:-2]) / (sigma[2:] - sigma[:-2]), rates[1:-1], atol=0.03)


def test_outside_of_the_path_it_rests():
    for shape in {s for three in SHAPES.values() for s in three}:
        assert progress(shape, -0.5) == 0.0
        assert progress(shape, 1.5) == pytest.approx(1.0, abs=1e-15)


def test_exponential_decays_by_a_constant_share():
    left = np.array([1.0 - progress(3.0, s) for s in np.linspace(0, 0.8, 9)]) + np.exp(-4) / (1 - np.exp(-4))
    np.testing.assert_allclose(left[1:] / left[:-1], np.exp(-0.4), rtol=1e-12)


@pytest.mark.parametrize(
    ("profile", "early", "late"),
    [("translation-first", 0, 1), ("rotation-first", 1, 0), ("planar-first", 2, 1)],
)
def test_first_has_ended_when_last_has_hardly_begun(profile, early, late):
    own = shapes(profile, (1.0, 1.0, 1.0))
    assert progress(own[early], 0.7) == 1.0
    assert progress(own[late], 0.3) == 0.0
    assert progress(own[early], 0.5) > 0.9
    assert progress(own[late], 0.5) < 0.1


def test_a_component_alone_waits_for_nothing():
    assert shapes("translation-first", (0.0, 1.0, 0.5)) == (0.0, 0.0, 0.0)
    assert shapes("translation-first", (0.3, 0.0, 0.0)) == (0.0, 0.0, 0.0)
