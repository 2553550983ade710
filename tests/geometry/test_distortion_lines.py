"""Plumb lines: the lens to its covariance, refusals."""

import numpy as np
import pytest

from stereoservo.geometry.distortion import distort, lens_from_lines
from stereoservo.geometry.homogeneous import GeometryError


def edges(lens, rng, sigma, count=12, points=25):
    ends = rng.uniform([15, 15], [625, 465], (count, 2, 2))
    along = np.linspace(0, 1, points)[:, None]
    return [distort(lens, a + (b - a) * along) + rng.normal(0, sigma, (points, 2)) for a, b in ends]


def test_lens_to_its_covariance():
    """Normalised squared errors over seeds: chi-square with 3 freedoms each, residuals with theirs."""
    squares, chi2, freedom = [], 0.0, 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        true = np.array([rng.uniform(-0.15, 0.06), *(np.array([319.5, 239.5]) + rng.normal(0, 8, 2)), 320.0])
        found = lens_from_lines(edges(true, rng, 0.1), 0.1, 640, 480)
        error = found.lens[:3] - true[:3]
        squares.append(error @ np.linalg.solve(found.covariance, error))
        chi2 += found.chi2
        freedom += found.degrees_of_freedom
    # The prior allows centres 64 px off; 60 x 3 freedoms: 1.0 with a deviation of 0.105.
    assert np.mean(squares) / 3 == pytest.approx(1.0, abs=0.35)
    assert chi2 / freedom == pytest.approx(1.0, abs=4 * np.sqrt(2 / freedom))


@pytest.mark.parametrize("k", [-0.25, -0.1, 0.1])
def test_exact_lines_give_the_exact_lens(k):
    true = np.array([k, 330.0, 232.0, 320.0])
    found = lens_from_lines(edges(true, np.random.default_rng(1), 0.0), 1e-4, 640, 480)
    assert np.abs(found.lens - true).max() < 1e-3


def test_understated_noise_widens_the_covariance():
    lines = edges(np.array([-0.1, 320.0, 240.0, 320.0]), np.random.default_rng(2), 0.2)
    wide, narrow = lens_from_lines(lines, 0.2, 640, 480), lens_from_lines(lines, 0.05, 640, 480)
    assert narrow.covariance[0, 0] == pytest.approx(wide.covariance[0, 0], rel=0.15)


def test_lines_through_the_middle_tell_nothing():
    middle = np.array([319.5, 239.5])
    ways = [(np.cos(a), np.sin(a)) for a in np.linspace(0, 3, 6)]
    lines = [middle + np.linspace(-200, 200, 21)[:, None] * np.array(way) for way in ways]
    with pytest.raises(GeometryError, match="away from the middle") as caught:
        lens_from_lines(lines, 0.5, 640, 480)
    assert caught.value.code == "degenerate"


@pytest.mark.parametrize(
    ("lines", "sigma", "code"),
    [
        ([], 0.1, "too_few"),
        ([np.zeros((2, 2))], 0.1, "too_few"),
        ([np.zeros((5, 3))], 0.1, "shape"),
        ([np.full((5, 2), np.nan)], 0.1, "not_finite"),
        ([np.zeros((5, 2))], 0.0, "shape"),
    ],
)
def test_malformed_lines_are_refused(lines, sigma, code):
    with pytest.raises(GeometryError) as caught:
        lens_from_lines(lines, sigma, 640, 480)
    assert caught.value.code == code
