"""Homographies of faces: fit, conics, leave-one-out check."""

import numpy as np
import pytest

from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_drivers.detectors.homographies import (
    OutlierGates,
    fit_homography,
    image_of_circle,
    reject_outliers,
)

from .rendering import conic_of_circle, look, project

FACE = DEFAULT_BODY[0]
PATTERN = FACE.positions / 0.042
RADIUS = FACE.radius / 0.042
ALL = np.ones(7, bool)


def random_view(rng):
    """A homography of the scaled pattern."""
    H = look(
        np.radians(rng.uniform(0, 65)),
        *rng.uniform(0, 2 * np.pi, 2),
        rng.uniform(0.6, 2),
        tuple(rng.uniform(100, 400, 2)),
    )
    return H @ np.diag([0.042, 0.042, 1.0])


@pytest.mark.parametrize("seed", range(20))
def test_fit_recovers_a_homography(seed):
    rng = np.random.default_rng(seed)
    truth = random_view(rng)
    used = ALL.copy()
    used[rng.choice(7, seed % 3, replace=False)] = False
    H = np.zeros((3, 3))
    assert fit_homography(PATTERN, project(truth, PATTERN), used, H)
    np.testing.assert_allclose(H, truth / truth[2, 2], rtol=1e-6, atol=1e-6)


def test_fit_is_the_least_squares_one():
    """No other homography nearby has a smaller sum of squared pixel residuals (to second order of the
    noise).
    """
    rng = np.random.default_rng(1)
    for _ in range(10):
        pixels = project(random_view(rng), PATTERN) + rng.normal(0, 0.05, (7, 2))
        H = np.zeros((3, 3))
        assert fit_homography(PATTERN, pixels, ALL, H)
        best = np.sum((project(H, PATTERN) - pixels) ** 2)
        for _ in range(50):
            other = H * (1 + rng.normal(0, 1e-4, (3, 3)))
            assert np.sum((project(other, PATTERN) - pixels) ** 2) > best * (1 - 1e-3)


def test_fit_refuses_degenerate_dots():
    H = np.zeros((3, 3))
    line = np.column_stack([np.arange(7.0) * 20, np.arange(7.0) * 11])
    assert not fit_homography(PATTERN, line, ALL, H)
    assert not fit_homography(PATTERN, np.zeros((7, 2)), ALL, H)
    three = ALL.copy()
    three[3:] = False
    assert not fit_homography(PATTERN, project(random_view(np.random.default_rng(2)), PATTERN), three, H)


@pytest.mark.parametrize("seed", range(10))
def test_picture_of_a_circle(seed):
    """Centre, shift, area and axes against the conic itself."""
    rng = np.random.default_rng(seed)
    H = random_view(rng)
    for position in PATTERN:
        out = np.zeros(7)
        assert image_of_circle(H, *position, RADIUS, out)
        C = conic_of_circle(H, position, RADIUS)
        centre = -np.linalg.solve(C[:2, :2], C[:2, 2])
        axes = np.sqrt(-(C[2, 2] + C[:2, 2] @ centre) / np.linalg.eigvalsh(C[:2, :2]))
        np.testing.assert_allclose(out[:2], project(H, position[None])[0], atol=1e-9)
        np.testing.assert_allclose(out[:2] + out[2:4], centre, atol=1e-8)
        # area and axes are those of the affine approximation at the centre
        np.testing.assert_allclose(out[4], np.pi * axes[0] * axes[1], rtol=2e-2)
        np.testing.assert_allclose(out[5:], axes, rtol=2e-2)


def test_a_mirrored_face_has_no_picture():
    H = random_view(np.random.default_rng(3)) @ np.diag([-1.0, 1.0, 1.0])
    assert not image_of_circle(H, 0.0, 0.0, RADIUS, np.zeros(7))


@pytest.mark.parametrize("seed", range(30))
def test_one_stranger_is_dropped_and_it_is_the_right_one(seed):
    rng = np.random.default_rng(seed)
    pixels = project(random_view(rng), PATTERN) + rng.normal(0, 0.01, (7, 2))
    bad = seed % 7
    angle = rng.uniform(0, 2 * np.pi)
    pixels[bad] += rng.uniform(0.8, 6.0) * np.array([np.cos(angle), np.sin(angle)])
    used = ALL.copy()
    assert reject_outliers(PATTERN, pixels, used, OutlierGates(0.3, 0.01, 5), np.zeros((3, 3)))
    assert np.flatnonzero(~used).tolist() == [bad]


@pytest.mark.parametrize("seed", range(30))
def test_no_dot_of_seven_hides_far_from_where_the_others_put_it(seed):
    """Whatever one error is, what remains lies within the tolerance of the homography of the rest."""
    rng = np.random.default_rng(100 + seed)
    truth = random_view(rng)
    pixels = project(truth, PATTERN)
    error = rng.uniform(0, 2)
    pixels[seed % 7] += error * np.array([0.6, 0.8])
    used = ALL.copy()
    assert reject_outliers(PATTERN, pixels, used, OutlierGates(0.3, 0.0, 5), np.zeros((3, 3)))
    if used.all():
        assert error < 0.33
    else:
        assert error > 0.27
        assert np.flatnonzero(~used).tolist() == [seed % 7]


def test_noise_alone_drops_nobody():
    rng = np.random.default_rng(5)
    for _ in range(200):
        pixels = project(random_view(rng), PATTERN) + rng.normal(0, 0.05, (7, 2))
        used = ALL.copy()
        assert reject_outliers(PATTERN, pixels, used, OutlierGates(0.05, 0.05, 5), np.zeros((3, 3)))
        assert used.all()
