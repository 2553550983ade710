import contextlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from oracles.frame_change import homography_from_basis, homography_refine
from stereoservo.geometry.cameras import project_many, triangulate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.homography import COPLANAR_TAIL, homography_from_points

seeds = st.integers(0, 2**32 - 1)


def frame(rng):
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 2.0, 4)) @ V


def spread_points(rng, n):
    """A simplex and points around its middle: no four coplanar among the first five."""
    corners = np.array([[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1], [1, 1, 1, 1]], float)
    more = np.hstack([rng.uniform(-0.5, 1.5, (max(n - 5, 0), 3)), np.ones((max(n - 5, 0), 1))])
    points = np.vstack([corners, more])[:n]
    points[:, :3] += rng.uniform(-0.1, 0.1, (n, 3))
    return points


def as_unit(H):
    return H / abs(np.linalg.det(H)) ** 0.25


@given(seeds)
def test_basis_homography_maps_the_basis(seed):
    rng = np.random.default_rng(seed)
    A, H = spread_points(rng, 5), frame(rng)
    B = (A @ H.T) * rng.uniform(0.3, 3.0, (5, 1)) * rng.choice([-1.0, 1.0], (5, 1))
    found = homography_from_basis(A, B)
    assert np.allclose(found @ A[4], B[4])
    assert np.allclose(found / found[0, 0], H / H[0, 0], atol=1e-8 * np.abs(H / H[0, 0]).max())
    to_standard = homography_from_basis(np.vstack([np.eye(4), np.ones(4)]), A)  # (2.19), (2.20)
    assert np.allclose(to_standard, A[:4].T @ np.diag(np.linalg.solve(A[:4].T, A[4])))


@given(seeds, st.integers(5, 30))
def test_linear_homography_is_exact_and_keeps_heights(seed, n):
    rng = np.random.default_rng(seed)
    A, H = spread_points(rng, n), frame(rng)
    B = (A @ H.T) * rng.uniform(0.3, 3.0, (n, 1))
    found = homography_from_points(A * rng.uniform(0.3, 3.0, (n, 1)), B)
    assert np.allclose(found, as_unit(H), atol=1e-8 * np.linalg.cond(H))
    assert (((A @ found.T) * B).sum(axis=1) > 0).all()


def test_points_that_were_not_seen_are_left_out():
    rng = np.random.default_rng(1)
    A, H = spread_points(rng, 9), frame(rng)
    B = A @ H.T
    B[3] = np.nan
    assert np.allclose(homography_from_points(A, B), as_unit(H))


def test_refinement_reaches_the_noise_floor(rig):
    rng = np.random.default_rng(2)
    trials, n, sigma = 40, 12, 0.2
    total = start_total = 0.0
    for _ in range(trials):
        X = rig.points(rng, n)
        M0 = X @ frame(rng).T  # the same points in another projective frame
        pixels = project_many(rig.Ps, X) + rng.normal(0, sigma, (2, n, 2))
        pixels[1, 3] = np.nan
        seen = np.delete(np.arange(n), 3)
        start = homography_from_points(M0[seen], X[seen] * (1 + 1e-3 * rng.normal(size=(n - 1, 4))))
        H = homography_refine(start, rig.Ps, M0, pixels, sigma)
        assert abs(abs(np.linalg.det(H)) - 1) < 1e-9
        total += np.nansum(((project_many(rig.Ps, M0 @ H.T) - pixels) / sigma) ** 2)
        start_total += np.nansum(((project_many(rig.Ps, M0 @ start.T) - pixels) / sigma) ** 2)
    low, high = chi2.interval(0.9999, trials * (4 * n - 2 - 15))
    assert low < total < high
    assert start_total > 2 * total


def test_degenerate_point_sets_are_refused():
    rng = np.random.default_rng(3)
    A = spread_points(rng, 12)
    with pytest.raises(GeometryError, match="4 points") as error:
        homography_from_points(A[:4], A[:4])
    assert error.value.code == "too_few"
    flat = A.copy()
    flat[:, 2] = 0.5 * flat[:, 0]
    with pytest.raises(GeometryError, match="coplanar"):
        homography_from_points(flat, flat)
    with pytest.raises(GeometryError, match="coplanar"):
        homography_from_points(A, flat)
    with pytest.raises(GeometryError, match="shapes"):
        homography_from_points(A, A[:5])
    nearly_flat = flat.copy()
    nearly_flat[0] = A[0]  # all but one on a plane: a homology remains free
    with pytest.raises(GeometryError, match="determine"):
        homography_from_points(nearly_flat, nearly_flat)


def turned_views(rig, rng, n, thickness, sigma):
    """Points (n, 4) triangulated before and after a motion, noise ``sigma`` [px]; a plate of relative ``thickness``."""
    X = rig.points(rng, n)
    middle = X[:, :3].mean(axis=0)
    turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    X[:, :3] = (X[:, :3] - middle) @ turn * [1.0, 1.0, thickness] @ turn.T + middle
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)).as_matrix()
    T[:3, 3] = middle - T[:3, :3] @ middle
    seen = [rig.pixels(M) + rng.normal(0, sigma, (2, n, 2)) for M in (X, X @ T.T)]
    return [triangulate(rig.Ps, pixels) for pixels in seen]


@pytest.mark.parametrize(("n", "most"), [(6, 6), (8, 2), (14, 1), (40, 1)])
def test_coplanar_points_are_refused_within_their_noise(rig, n, most):
    """Of 400 noisy plates at most what the stated tail allows is taken for spatial; of bodies none is refused."""
    rng = np.random.default_rng(n)
    accepted = refused = 0
    for _ in range(400):
        with contextlib.suppress(GeometryError):
            homography_from_points(*turned_views(rig, rng, n, 0.0, 0.1))
            accepted += 1
    for _ in range(100):
        try:
            homography_from_points(*turned_views(rig, rng, n, 1.0, 0.1))
        except GeometryError:
            refused += 1
    assert accepted <= most
    with pytest.raises(GeometryError, match="coplanar within their noise") as error:
        homography_from_points(*turned_views(rig, rng, n, 0.0, 0.1))
    assert error.value.code == "degenerate"
    assert error.value.data["probability"] > error.value.data["limit"] == COPLANAR_TAIL
    # Six points show their noise by three freedoms: some that are near a plane cannot be told from one.
    assert refused <= (8 if n == 6 else 0)


def test_degenerate_bases_are_refused():
    A = spread_points(np.random.default_rng(4), 5)
    flat = A.copy()
    flat[3] = flat[0] + flat[1] - flat[2]
    with pytest.raises(GeometryError, match="second basis are coplanar"):
        homography_from_basis(A, flat)
    fifth = A.copy()
    fifth[4] = A[0] + A[1] + A[2]
    with pytest.raises(GeometryError, match="point 5 of the first basis"):
        homography_from_basis(fifth, A)
    with pytest.raises(GeometryError, match=r"\(4, 4\)"):
        homography_from_basis(A[:4], A)


def test_refinement_refuses_too_few_pixels(rig):
    M = rig.points(np.random.default_rng(5), 8)
    pixels = np.full((2, 8, 2), np.nan)
    pixels[:, :3] = project_many(rig.Ps, M[:3])
    with pytest.raises(GeometryError, match="12 pixel coordinates") as error:
        homography_refine(np.eye(4), rig.Ps, M, pixels)
    assert error.value.data["measured"] == 12
