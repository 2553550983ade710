import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from oracles.optimal_triangulation import fundamental_of_cameras, optimal_pixels, triangulate_optimal
from oracles.projective_points import move_cameras
from stereoservo.geometry.cameras import project_many, triangulate
from stereoservo.geometry.homogeneous import GeometryError

seeds = st.integers(0, 2**32 - 1)


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


def constraint(F, pixels):
    m, m_right = (np.hstack([p, np.ones((len(p), 1))]) for p in pixels)
    lines = m @ F.T
    return (m_right * lines).sum(axis=1) / np.linalg.norm(lines[:, :2], axis=1)


def cost(found, pixels, sigmas=1.0):
    return (((found - pixels) / np.broadcast_to(sigmas, pixels.shape[:2])[..., None]) ** 2).sum(axis=(0, 2))


@given(seeds)
def test_fundamental_matrix_of_cameras_is_that_of_the_rig_in_any_frame(rig, seed):
    rng = np.random.default_rng(seed)
    Ps = move_cameras(frame(rng), rig.Ps) * rng.uniform(0.5, 2.0, (2, 1, 1))
    F = fundamental_of_cameras(*Ps)
    assert np.allclose(F * np.sign((F * rig.F).sum()), rig.F, atol=1e-9)


@settings(max_examples=30)
@given(seed=seeds, noise=st.floats(0.0, 5.0))
def test_optimal_pixels_agree_with_opencv(rig, seed, noise):
    rng = np.random.default_rng(seed)
    pixels = rig.pixels(rig.points(rng, 20)) + rng.normal(0, noise, (2, 20, 2))
    found = optimal_pixels(rig.F, pixels)
    other = np.stack(cv2.correctMatches(rig.F, pixels[0][None], pixels[1][None]))[:, 0]
    assert np.abs(constraint(rig.F, found)).max() < 1e-7
    assert (cost(found, pixels) <= cost(other, pixels) + 1e-6).all()
    assert np.abs(found - other).max() < 1e-3


@settings(max_examples=30)
@given(seed=seeds, noise=st.floats(0.05, 3.0))
def test_triangulate_reaches_the_same_minimum(rig, seed, noise):
    rng = np.random.default_rng(seed)
    Ps = move_cameras(frame(rng), rig.Ps)
    pixels = rig.pixels(rig.points(rng, 20)) + rng.normal(0, noise, (2, 20, 2))
    optimal, descended = triangulate_optimal(Ps, pixels), triangulate(Ps, pixels, iterations=6)
    least = cost(project_many(Ps, optimal), pixels)
    assert np.allclose(cost(optimal_pixels(fundamental_of_cameras(*Ps), pixels), pixels), least, rtol=1e-6, atol=1e-9)
    reached = cost(project_many(Ps, descended), pixels)
    assert (reached >= least * (1 - 1e-6) - 1e-9).all()
    assert np.allclose(reached, least, rtol=1e-5, atol=1e-9)
    assert np.allclose(optimal, descended, rtol=1e-4, atol=1e-6 * np.abs(descended).max())


def test_no_epipolar_line_of_a_fine_scan_is_nearer_even_for_wild_pixels(rig):
    """Pixels far from the epipolar constraint, where descents may end in a local minimum."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform(0, 480, (2, 30, 2))
    sigmas = rng.uniform(0.5, 2.0, (2, 30))
    least = cost(optimal_pixels(rig.F, pixels, sigmas), pixels, sigmas)
    angle = np.linspace(0, np.pi, 200001)
    epipole = np.linalg.svd(rig.F)[2][2]
    for k in range(30):
        # All lines through the left epipole: directions from it; their right partners by F.
        other = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
        left = np.cross(epipole, other)
        right = other @ rig.F.T
        total = 0.0
        for line, pixel, sigma in zip((left, right), pixels[:, k], sigmas[:, k], strict=True):
            total = total + ((line[:, :2] @ pixel + line[:, 2]) / np.linalg.norm(line[:, :2], axis=1) / sigma) ** 2
        assert least[k] <= total.min() * (1 + 1e-9)
        assert least[k] >= total.min() * (1 - 1e-3)


def test_each_camera_has_its_own_noise(rig):
    rng = np.random.default_rng(2)
    pixels = rig.pixels(rig.points(rng, 10)) + rng.normal(0, 1.0, (2, 10, 2))
    exact_right = optimal_pixels(rig.F, pixels, np.array([1.0, 1e-6]))
    assert np.abs(exact_right[1] - pixels[1]).max() < 1e-6
    assert np.abs(constraint(rig.F, exact_right)).max() < 1e-7
    sigmas = np.array([1.0, 0.3])
    weighted = triangulate_optimal(rig.Ps, pixels, sigmas)
    descended = triangulate(rig.Ps, pixels, np.broadcast_to(sigmas[:, None], (2, 10)), iterations=6)
    assert np.allclose(weighted, descended, rtol=1e-5, atol=1e-8)


def test_parallel_cameras_have_their_epipoles_at_infinity():
    P = np.array([[800.0, 0, 320, 0], [0, 800, 240, 0], [0, 0, 1, 0]])
    right = P.copy()
    right[0, 3] = -80.0
    pixels = np.array([[[300.0, 200.0]], [[250.0, 203.0]]])
    found = optimal_pixels(fundamental_of_cameras(P, right), pixels)
    assert np.allclose(found, [[[300.0, 201.5]], [[250.0, 201.5]]])  # rows meet in the middle


def test_missing_pixels_and_epipoles_are_nan_and_leave_the_others(rig):
    rng = np.random.default_rng(3)
    pixels = rig.pixels(rig.points(rng, 4))
    pixels[1, 1] = np.nan
    epipole = np.linalg.svd(rig.F)[2][2]
    pixels[0, 2] = epipole[:2] / epipole[2]
    found = triangulate_optimal(rig.Ps, pixels)
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[[0, 3]]).all()
    assert np.isnan(optimal_pixels(rig.F, np.full((2, 3, 2), np.nan))).all()


def test_cameras_and_shapes_that_do_not_fit_are_refused(rig):
    with pytest.raises(GeometryError, match="one centre"):
        fundamental_of_cameras(rig.Ps[0], 2.0 * rig.Ps[0])
    with pytest.raises(GeometryError, match="two are needed"):
        triangulate_optimal(np.concatenate([rig.Ps, rig.Ps[:1]]), np.zeros((3, 1, 2)))
    with pytest.raises(GeometryError, match="do not fit"):
        optimal_pixels(rig.F, np.zeros((3, 1, 2)))
    with pytest.raises(GeometryError, match="positive"):
        optimal_pixels(rig.F, np.zeros((2, 1, 2)), 0.0)
