import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from oracles.optimal_triangulation import triangulate_linear
from stereoservo.geometry.cameras import (
    camera_centre,
    canonical_pair,
    pixel_normaliser,
    project,
    project_many,
    projection_jacobian,
    projection_jacobian_many,
    reprojection_residuals,
    resection,
    triangulate,
    triangulation_covariance,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.homography import homography_from_points

WIDTH, HEIGHT = 640, 480


def test_normaliser_puts_the_centre_at_the_origin_and_half_the_width_at_one():
    N = pixel_normaliser(640, 480)
    assert np.allclose(N @ [319.5, 239.5, 1], [0, 0, 1])
    assert np.allclose(N @ [639.5, 479.5, 1], [1, 0.75, 1])
    with pytest.raises(GeometryError, match="0x480"):
        pixel_normaliser(0, 480)


def test_camera_centre_is_projected_nowhere_and_oriented(rig):
    P = rig.Ps[1]
    centre = camera_centre(P)
    assert np.abs(P @ centre).max() < 1e-12 * np.abs(P).max() * np.abs(centre).max()
    assert np.allclose((centre / centre[3])[:3], -rig.R.T @ rig.t)
    X = np.random.default_rng(1).normal(size=4)
    assert np.isclose(centre @ X, np.linalg.det(np.vstack([P, X]).T))


rigs = st.fixed_dictionaries(
    {
        "focal": st.floats(400, 1500),
        "baseline": st.floats(0.05, 0.6),
        "vergence_deg": st.floats(8, 60),
        "roll_deg": st.floats(-10, 10),
    }
)


@given(rigs, st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=100)
def test_canonical_pair_reconstructs_up_to_a_good_projective_frame(make_rig, values, seed, with_matches):
    rig = make_rig(**values)
    rng = np.random.default_rng(seed)
    X = rig.points(rng, 30)
    pixels = rig.pixels(X)
    sign = rng.choice([-1.0, 1.0])
    matches = {"left": pixels[0], "right": pixels[1]} if with_matches else {}
    P_left, P_right = canonical_pair(sign * rng.uniform(0.1, 10) * rig.F, WIDTH, HEIGHT, **matches)
    assert np.array_equal(P_left, np.hstack([np.linalg.inv(pixel_normaliser(WIDTH, HEIGHT)), np.zeros((3, 1))]))
    Ps = np.stack([P_left, P_right])
    M = triangulate(Ps, pixels)
    assert np.abs(project_many(Ps, M) - pixels).max() < 1e-8
    assert np.allclose(M[:, 2], 1.0)
    assert (M @ P_right[2] > 0).all()  # in front of both
    H = homography_from_points(X, M)
    assert np.linalg.cond(H) < 500
    if with_matches:
        assert (M[:, 3] > 0).all()  # none beyond the frame's own infinity
        assert np.linalg.det(H) > 0


def test_canonical_pair_of_cameras_of_different_size(rig):
    double = np.diag([2.0, 2.0, 1.0])
    double[:2, 2] = 0.5  # integer pixel centres
    F = np.linalg.inv(double).T @ rig.F
    X = rig.points(np.random.default_rng(3), 20)
    pixels = rig.pixels(X)
    pixels[1] = pixels[1] * 2 + 0.5
    Ps = np.stack(canonical_pair(F, WIDTH, HEIGHT, right_size=(2 * WIDTH, 2 * HEIGHT)))
    M = triangulate(Ps, pixels)
    assert np.abs(reprojection_residuals(Ps, M, pixels)).max() < 1e-8
    assert (M[:, 3] > 0).all()


def test_canonical_pair_refuses_what_is_no_fundamental_matrix():
    N = pixel_normaliser(WIDTH, HEIGHT)
    for F in (N.T @ N, np.outer([1, 2, 3], [3, 2, 1.0])):
        with pytest.raises(GeometryError, match="rank two") as error:
            canonical_pair(F, WIDTH, HEIGHT)
        assert error.value.code == "degenerate"
    with pytest.raises(GeometryError, match=r"\(3, 3\)"):
        canonical_pair(np.full((3, 3), np.nan), WIDTH, HEIGHT)


@given(st.integers(0, 2**32 - 1))
def test_projection_jacobian_agrees_with_finite_differences(make_rig, seed):
    rng = np.random.default_rng(seed)
    Ps = make_rig().Ps
    M = make_rig().points(rng, 5) * rng.uniform(0.5, 2, (5, 1))
    J = projection_jacobian_many(Ps, M)
    h = 1e-6
    for k in range(4):
        step = h * np.eye(4)[k]
        difference = (project_many(Ps, M + step) - project_many(Ps, M - step)) / (2 * h)
        assert np.abs(difference - J[..., k]).max() < 1e-6 * np.abs(J).max()
    assert np.array_equal(projection_jacobian(Ps[1], M), J[1])
    assert np.abs(np.einsum("cnij,nj->cni", J, M)).max() < 1e-9  # pixels do not depend on the height


def test_projection_into_the_focal_plane_is_nan_not_a_warning(rig):
    assert np.isnan(project(rig.Ps[0], np.array([[1.0, 2.0, 0.0, 1.0]]))).all()


@given(st.integers(0, 2**32 - 1), st.integers(2, 4))
@settings(max_examples=50)
def test_triangulation_is_exact_without_noise(make_rig, seed, cameras):
    rng = np.random.default_rng(seed)
    rig = make_rig()
    X = rig.points(rng, 12)
    shifts = rng.normal(size=(cameras, 3, 4)) * 0.02
    shifts[0] = 0
    Ps = rig.Ps[np.arange(cameras) % 2] @ np.eye(4)
    Ps[2:] += rig.K @ shifts[2:]
    pixels = project_many(Ps, X)
    truth = X / X[:, 2:3]
    for M in (
        triangulate_linear(Ps, pixels),
        triangulate(Ps, pixels),
        triangulate(Ps, pixels, 0.1, iterations=0),
    ):
        assert np.allclose(M, truth, rtol=0, atol=1e-9)


def test_triangulation_in_a_frame_whose_first_camera_is_general(rig):
    rng = np.random.default_rng(5)
    X = rig.points(rng, 8)
    H = rng.normal(size=(4, 4))
    Ps = rig.Ps @ np.linalg.inv(H)
    M = triangulate(Ps, rig.pixels(X))
    assert np.allclose(M @ Ps[0, 2], 1.0)
    assert np.allclose(M, (X / X[:, 2:3]) @ H.T, atol=1e-8 * np.abs(H).max())


def test_triangulation_minimises_the_reprojection_error(rig):
    rng = np.random.default_rng(6)
    pixels = rig.pixels(rig.points(rng, 40)) + rng.normal(0, 2.0, (2, 40, 2))
    sigmas = rng.uniform(0.5, 3.0, (2, 40))
    M = triangulate(rig.Ps, pixels, sigmas, iterations=10)
    J = projection_jacobian_many(rig.Ps, M)
    r = reprojection_residuals(rig.Ps, M, pixels)
    gradient = np.einsum("cnij,cni,cn->nj", J, r, sigmas**-2.0)
    scale = np.einsum("cnij,cni,cn->nj", np.abs(J), np.abs(r), sigmas**-2.0)
    assert np.abs(gradient).max() < 1e-9 * scale.max()


def test_triangulation_covariance_is_that_of_the_noise(rig):
    rng = np.random.default_rng(7)
    X = rig.points(rng, 4)
    truth = X / X[:, 2:3]
    sigmas = np.array([[0.1, 0.2, 0.1, 0.3], [0.2, 0.1, 0.1, 0.1]])
    trials = 2000
    pixels = rig.pixels(X)[:, None] + rng.normal(size=(2, trials, 4, 2)) * sigmas[:, None, :, None]
    M = triangulate(rig.Ps, pixels.reshape(2, -1, 2), np.tile(sigmas, (1, trials))).reshape(trials, 4, 4)
    covariance = triangulation_covariance(rig.Ps, truth, sigmas)
    for i in range(4):
        assert np.abs(covariance[i, 2]).max() == pytest.approx(0.0, abs=1e-15)
        free = [0, 1, 3]
        information = np.linalg.inv(covariance[i][np.ix_(free, free)])
        error = (M[:, i] - truth[i])[:, free]
        pooled = np.einsum("ti,ij,tj->", error, information, error)
        low, high = chi2.interval(0.9999, 3 * trials)
        assert low < pooled < high


def test_missing_and_hopeless_pixels_give_nan_rows_and_leave_the_others(rig):
    X = rig.points(np.random.default_rng(8), 5)
    pixels = rig.pixels(X)
    whole = triangulate(rig.Ps, pixels)
    pixels[1, 2] = np.nan
    pixels[:, 3, 0] = np.nan
    for method in (triangulate, triangulate_linear):
        M = method(rig.Ps, pixels)
        assert np.isnan(M[[2, 3]]).all()
        assert np.allclose(M[[0, 1, 4]], whole[[0, 1, 4]])
    same = np.stack([rig.Ps[0], rig.Ps[0]])
    assert np.isnan(triangulate(same, rig.pixels(X)[[0, 0]])).all()  # no baseline, no depth
    weights = np.ones((2, 5))
    weights[0, 0] = 0.0
    assert np.isnan(triangulate_linear(rig.Ps, rig.pixels(X), weights)[0]).all()


def test_triangulation_refuses_shapes_that_do_not_fit(rig):
    with pytest.raises(GeometryError, match=r"\(3, 5, 2\)"):
        triangulate(rig.Ps, np.zeros((3, 5, 2)))
    with pytest.raises(GeometryError, match="weights"):
        triangulate_linear(rig.Ps, np.zeros((2, 5, 2)), np.full((2, 5), -1.0))


def test_resection_is_exact_and_unbiased_by_heights(rig):
    rng = np.random.default_rng(9)
    X = rig.points(rng, 12)
    M = X * rng.uniform(0.5, 2, (12, 1))
    for P in rig.Ps:
        pixels = project(P, X)
        pixels_with_gap = np.vstack([pixels, [[np.nan, 1.0]]])
        found = resection(np.vstack([M, rng.normal(size=(1, 4))]), pixels_with_gap)
        assert np.allclose(found, P / np.linalg.norm(P), atol=1e-9)
        assert (M @ found[2] > 0).all()


def test_resection_reaches_the_noise_floor(rig):
    rng = np.random.default_rng(10)
    trials, n, sigma = 60, 12, 0.2
    total = 0.0
    for _ in range(trials):
        X = rig.points(rng, n)
        pixels = project(rig.Ps[1], X) + rng.normal(0, sigma, (n, 2))
        total += (((project(resection(X, pixels), X) - pixels) / sigma) ** 2).sum()
    low, high = chi2.interval(0.9999, trials * (2 * n - 11))
    assert low < total < high


def test_resection_refuses_five_points_and_flat_points(rig):
    X = rig.points(np.random.default_rng(11), 12)
    with pytest.raises(GeometryError, match="5 points") as error:
        resection(X[:5], project(rig.Ps[0], X[:5]))
    assert error.value.code == "too_few"
    X[:, 2] = 1.0 + 0.1 * X[:, 0]
    with pytest.raises(GeometryError, match="coplanar"):
        resection(X, project(rig.Ps[0], X))
    with pytest.raises(GeometryError, match="one point"):
        resection(rig.points(np.random.default_rng(1), 8), np.full((8, 2), 3.0))
