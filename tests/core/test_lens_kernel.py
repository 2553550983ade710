"""The loop's lens against the readable one, and against finite differences of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo.core import prediction, report
from stereoservo.geometry import distortion
from stereoservo.kinematics import kernels

LENSES = [(0.0, 319.5, 239.5, 320.0), (-0.048, 330.0, 236.0, 320.0), (-0.09, 300.0, 250.0, 320.0),
          (0.12, 322.0, 240.0, 320.0), (-0.09, 300.0, 250.0, 320.0, 0.02, 1e-3, -2e-3),
          (0.0, 322.0, 240.0, 320.0, 0.0, 1e-3, 2e-3), (-0.1, 322.0, 240.0, 320.0, 0.01, 0.0, 0.0),
          (0.1, 330.0, 236.0, 320.0, -0.05, 1e-3, 0.0)]  # fmt: skip


def scattered(seed: int, n: int = 40) -> np.ndarray:
    """Pixels in and around a 640x480 image."""
    return np.random.default_rng(seed).uniform((-100, -100), (740, 580), (n, 2))


def spread(seed: int, n: int = 40) -> np.ndarray:
    """Covariances (n, 2, 2) of any direction."""
    half = np.random.default_rng(seed + 1).normal(0, 0.1, (n, 2, 2))
    return half @ half.transpose(0, 2, 1) + 1e-6 * np.eye(2)


@given(st.sampled_from(LENSES), st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_pixels_and_jacobians_are_those_of_the_reference(lens: tuple[float, ...], seed: int) -> None:
    lens_array, pixels = np.array(lens), scattered(seed)
    raw = np.array([kernels.distort_pixel(lens_array, u, v) for u, v in pixels])
    ideal = np.array([kernels.undistort_pixel(lens_array, u, v) for u, v in pixels])
    jacobians = np.array([kernels.distortion_jacobian(lens_array, u, v) for u, v in pixels])
    np.testing.assert_allclose(raw, distortion.distort(lens_array, pixels), atol=1e-10, rtol=0)
    np.testing.assert_allclose(ideal, distortion.undistort(lens_array, pixels), atol=1e-10, rtol=0)
    expected = distortion.distortion_jacobian(lens_array, pixels)
    np.testing.assert_allclose(jacobians, expected[:, [0, 0, 1], [0, 1, 1]], atol=1e-10, rtol=0)


@pytest.mark.parametrize("lens", LENSES)
def test_sights_carry_their_covariance_through_the_inverse(lens: tuple[float, ...]) -> None:
    """Against central differences of the reference's inverse."""
    lens_array, pixels, covariances = np.array(lens), scattered(3), spread(3)
    ideal, found, seen = prediction.undistort_observations(lens_array, pixels, covariances)
    np.testing.assert_array_equal(seen, np.isfinite(distortion.undistort(lens_array, pixels)).all(axis=1))
    assert seen.sum() > 20
    h = 1e-4
    steps = [distortion.undistort(lens_array, pixels + h * e) - distortion.undistort(lens_array, pixels - h * e)
             for e in np.eye(2)]  # fmt: skip
    J = np.stack(steps, axis=-1) / (2 * h)
    expected = J @ covariances @ J.transpose(0, 2, 1)
    np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(distortion.distort(lens_array, ideal[seen]), pixels[seen], atol=1e-9)


@pytest.mark.parametrize("lens", LENSES)
def test_expected_pixels_carry_velocity_and_covariance(lens: tuple[float, ...]) -> None:
    """Moving for a moment and then distorting is distorting and then moving."""
    lens_array, pixels, covariances = np.array(lens), scattered(4), spread(4)
    velocities = np.random.default_rng(5).normal(0, 300, (40, 2))
    raw, speed, found, seen = report.distort_expected(lens_array, pixels, velocities, covariances)
    assert seen.all()
    dt = 1e-6
    ahead = distortion.distort(lens_array, pixels + dt * velocities)
    behind = distortion.distort(lens_array, pixels - dt * velocities)
    np.testing.assert_allclose(speed, (ahead - behind) / (2 * dt), rtol=1e-5, atol=1e-3)
    J = distortion.distortion_jacobian(lens_array, pixels)
    np.testing.assert_allclose(found, J @ covariances @ J.transpose(0, 2, 1), rtol=1e-12)
    np.testing.assert_allclose(raw, distortion.distort(lens_array, pixels), atol=1e-10)


def test_beyond_the_fold_there_is_nothing() -> None:
    lens = np.array([-0.3, 319.5, 239.5, 320.0])  # folds at 337 px ideal, 225 px raw
    far = np.array([[319.5 + 230.0, 239.5], [np.nan, 1.0], [319.5, 239.5]])
    assert prediction.undistort_observations(lens, far, spread(0, 3))[2].tolist() == [False, False, True]
    far = np.array([[319.5 + 340.0, 239.5], [np.nan, 1.0], [319.5, 239.5]])
    assert report.distort_expected(lens, far, far, spread(0, 3))[3].tolist() == [False, False, True]
