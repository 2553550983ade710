"""Lens distortion against OpenCV, its own inverse and finite differences."""

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from stereoservo.geometry.distortion import (
    distort,
    distortion_jacobian,
    fold_radius,
    lens_jacobian,
    pinhole_lens,
    terms_jacobian,
    undistort,
)

WIDTH, HEIGHT = 640, 480


def grid(step=40):
    u, v = np.meshgrid(np.arange(0, WIDTH, step), np.arange(0, HEIGHT, step))
    return np.stack([u, v], axis=-1).astype(float)


def test_a_straight_lens_changes_nothing():
    lens = pinhole_lens(WIDTH, HEIGHT)
    np.testing.assert_array_equal(distort(lens, grid()), grid())
    np.testing.assert_array_equal(undistort(lens, grid()), grid())
    np.testing.assert_allclose(lens[1:3], [319.5, 239.5])


@pytest.mark.parametrize("k1", [-0.3, 0.2])
def test_it_is_the_model_of_opencv_with_k1_alone(k1):
    f, centre = 800.0, np.array([330.0, 236.0])
    K = np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]])
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)), np.ones(200)])
    raw, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array([k1, 0, 0, 0.0]))
    lens = np.array([k1 * (0.5 * WIDTH / f) ** 2, *centre, 0.5 * WIDTH])
    ideal = points[:, :2] * f + centre
    np.testing.assert_allclose(distort(lens, ideal), raw[:, 0], atol=1e-9)


def test_it_is_the_model_of_opencv_with_second_radial_and_tangential_terms():
    f, centre, terms = 420.0, np.array([330.0, 236.0]), np.array([-0.3, 0.12, 1e-3, -8e-4])
    K = np.array([[f, 0, centre[0]], [0, f, centre[1]], [0, 0, 1]])
    points = np.column_stack([np.random.default_rng(5).uniform(-0.7, 0.7, (200, 2)), np.ones(200)])
    raw, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, terms)
    k1, k2, p1, p2 = terms * (0.5 * WIDTH / f) ** np.array([2, 4, 1, 1])
    lens = np.array([k1, *centre, 0.5 * WIDTH, k2, p1, p2])
    ideal = points[:, :2] * f + centre
    np.testing.assert_allclose(distort(lens, ideal), raw[:, 0], atol=1e-9)
    np.testing.assert_allclose(undistort(lens, raw[:, 0]), ideal, atol=1e-8)


@given(
    k=st.floats(-0.3, 0.3),
    k2=st.floats(-0.1, 0.1),
    p1=st.floats(-3e-3, 3e-3),
    p2=st.floats(-3e-3, 3e-3),
)
def test_undistort_is_the_inverse_with_all_terms_within_the_fold(k, k2, p1, p2):
    lens = np.array([k, 330.0, 236.0, 320.0, k2, p1, p2])
    ideal = grid()
    inside = np.linalg.norm(ideal - lens[1:3], axis=-1) < 0.75 * fold_radius(lens)
    np.testing.assert_allclose(undistort(lens, distort(lens, ideal[inside])), ideal[inside], atol=1e-8)
    beyond = np.linalg.norm(ideal - lens[1:3], axis=-1) > fold_radius(lens)
    assert np.isnan(distort(lens, ideal[beyond])).all()


def test_the_fold_is_where_the_radial_function_ceases_to_grow():
    assert fold_radius(np.array([0.1, 0, 0, 320.0])) == np.inf
    assert fold_radius(np.array([-0.3, 0, 0, 320.0])) == pytest.approx(320.0 / np.sqrt(0.9))
    assert fold_radius(np.array([-0.1, 0, 0, 320.0, 0.05, 0, 0])) == np.inf
    for k, k2 in ((-0.3, 0.03), (0.1, -0.05), (-0.1, -0.01)):
        r = fold_radius(np.array([k, 0, 0, 1.0, k2, 0, 0]))
        radii = np.linspace(0, r, 1000)
        slope = 1 + 3 * k * radii**2 + 5 * k2 * radii**4
        assert slope[-1] == pytest.approx(0.0, abs=1e-12)
        assert (slope[:-1] > 0.0).all()


@given(k=st.floats(-0.06, 0.5), cu=st.floats(280, 360), cv=st.floats(200, 280))
@example(k=-2.2e-313, cu=280.0, cv=200.0)
def test_undistort_is_the_inverse(k, cu, cv):
    lens = np.array([k, cu, cv, 320.0])
    np.testing.assert_allclose(undistort(lens, distort(lens, grid())), grid(), atol=1e-9)
    np.testing.assert_allclose(distort(lens, undistort(lens, grid())), grid(), atol=1e-9)


def test_beyond_the_fold_there_is_nothing():
    lens = np.array([-0.3, 320.0, 240.0, 320.0])
    edge = 320.0 * np.sqrt(1 / 0.9)
    assert np.isfinite(distort(lens, np.array([320 + 0.99 * edge, 240]))).all()
    assert np.isnan(distort(lens, np.array([320 + 1.01 * edge, 240]))).all()
    raw_edge = edge * 2 / 3
    assert np.isfinite(undistort(lens, np.array([320 + 0.99 * raw_edge, 240]))).all()
    assert np.isnan(undistort(lens, np.array([320 + 1.01 * raw_edge, 240]))).all()


@pytest.mark.parametrize("k", [-0.1, 0.0, 0.3])
def test_jacobians_by_finite_differences(k):
    lens = np.array([k, 310.0, 250.0, 320.0])
    pixels = grid(97).reshape(-1, 2)
    for i in range(2):
        step = np.zeros(2)
        step[i] = 1e-4
        slope = (distort(lens, pixels + step) - distort(lens, pixels - step)) / 2e-4
        np.testing.assert_allclose(distortion_jacobian(lens, pixels)[..., i], slope, atol=1e-7)
    for i, size in enumerate((1e-6, 1e-4, 1e-4)):
        step = np.zeros(4)
        step[i] = size
        slope = (distort(lens + step, pixels) - distort(lens - step, pixels)) / (2 * size)
        np.testing.assert_allclose(lens_jacobian(lens, pixels)[..., i], slope, rtol=1e-6, atol=1e-6)


def test_jacobians_with_all_terms_by_finite_differences():
    lens = np.array([-0.1, 310.0, 250.0, 320.0, 0.03, 2e-3, -1e-3])
    pixels = grid(97).reshape(-1, 2)
    for i in range(2):
        step = np.zeros(2)
        step[i] = 1e-4
        slope = (distort(lens, pixels + step) - distort(lens, pixels - step)) / 2e-4
        np.testing.assert_allclose(distortion_jacobian(lens, pixels)[..., i], slope, atol=1e-7)
    both = np.concatenate([lens_jacobian(lens, pixels), terms_jacobian(lens, pixels)], axis=-1)
    for column, entry in enumerate((0, 1, 2, 4, 5, 6)):
        step = np.zeros(7)
        step[entry] = 1e-4 if entry in (1, 2) else 1e-6
        slope = (distort(lens + step, pixels) - distort(lens - step, pixels)) / (2 * step[entry])
        np.testing.assert_allclose(both[..., column], slope, rtol=1e-6, atol=1e-6)
