import numpy as np
import pytest
from scipy.stats import chi2

from stereoservo.geometry.fundamental import (
    epipolar_distances,
    fundamental_linear,
    fundamental_refine,
    fundamental_robust,
    sampson_distances,
)
from stereoservo.geometry.homogeneous import GeometryError


def same(F, G):
    F, G = F / np.linalg.norm(F), G / np.linalg.norm(G)
    return min(np.abs(F - G).max(), np.abs(F + G).max())


def noisy(rig, seed, n, sigma):
    rng = np.random.default_rng(seed)
    pixels = rig.pixels(rig.points(rng, n))
    return pixels + rng.normal(0, sigma, pixels.shape)


@pytest.mark.parametrize("n", [8, 9, 40])
def test_linear_is_exact_without_noise_in_opencvs_convention(rig, n):
    left, right = noisy(rig, n, n, 0.0)
    F = fundamental_linear(left, right)
    assert same(F, rig.F) < 1e-9
    assert abs(np.linalg.det(F)) < 1e-18
    residual = np.einsum("ni,ij,nj->n", np.c_[right, np.ones(n)], F, np.c_[left, np.ones(n)])
    assert np.abs(residual).max() < 1e-10


def test_refined_reaches_the_noise_floor_and_beats_the_linear_one(rig):
    trials, n, sigma = 40, 60, 0.3
    total, linear_error, refined_error = 0.0, 0.0, 0.0
    clean = rig.pixels(rig.points(np.random.default_rng(99), 200))
    for seed in range(trials):
        left, right = noisy(rig, seed, n, sigma)
        linear = fundamental_linear(left, right)
        F = fundamental_refine(linear, left, right, sigma)
        total += (sampson_distances(F, left, right) ** 2).sum() / sigma**2
        linear_error += (sampson_distances(linear, *clean) ** 2).mean()
        refined_error += (sampson_distances(F, *clean) ** 2).mean()
        assert np.linalg.svd(F, compute_uv=False)[2] < 1e-15
    low, high = chi2.interval(0.9999, trials * (n - 7))
    assert low < total < high
    assert refined_error < linear_error


def test_refinement_finds_its_minimum_from_afar_and_weighs_by_sigma(rig):
    rng = np.random.default_rng(3)
    left, right = noisy(rig, 3, 60, 0.1)
    sigma = np.full(60, 0.1)
    left[:10] += rng.normal(0, 5.0, (10, 2))
    sigma[:10] = 5.0
    start = fundamental_linear(left, right)
    near = fundamental_refine(start, left, right, sigma)
    from_truth = fundamental_refine(rig.F, left, right, sigma)
    assert same(near, from_truth) < 1e-6
    clean = rig.pixels(rig.points(np.random.default_rng(98), 100))
    assert np.abs(sampson_distances(near, *clean)).max() < 0.3
    assert np.abs(sampson_distances(start, *clean)).max() > 1.0


def test_refinement_is_stationary_by_finite_differences(rig):
    left, right = noisy(rig, 5, 30, 0.5)
    F = fundamental_refine(fundamental_linear(left, right), left, right)

    def cost(G):
        return (sampson_distances(G, left, right) ** 2).sum()

    U, s, Vt = np.linalg.svd(F)
    rng = np.random.default_rng(6)
    for _ in range(10):  # tangents of the rank-two matrices: UAVᵀ with no third-third entry
        A = rng.normal(size=(3, 3)) * s[1]
        A[2, 2] = 0.0
        D = U @ A @ Vt
        h = 1e-4

        def on_manifold(t, D=D):
            u, w, v = np.linalg.svd(F + t * D)
            return (u[:, :2] * w[:2]) @ v[:2]

        slope = (cost(on_manifold(h)) - cost(on_manifold(-h))) / (2 * h)
        curvature = (cost(on_manifold(h)) + cost(on_manifold(-h)) - 2 * cost(F)) / h**2
        assert curvature > 0
        assert abs(slope) < 1e-4 * curvature


@pytest.mark.parametrize("seed", range(10))
def test_robust_finds_the_inliers_among_a_third_of_outliers_and_repeats_itself(rig, seed):
    sigma, n, outliers = 0.3, 120, 36
    left, right = noisy(rig, seed, n, sigma)
    rng = np.random.default_rng(1000 + seed)
    bad = rng.choice(n, outliers, replace=False)
    right[bad] = np.stack([rng.uniform(0, 640, outliers), rng.uniform(0, 480, outliers)], axis=1)
    F, inliers = fundamental_robust(left, right, sigma)
    truly_bad = np.zeros(n, bool)
    truly_bad[bad] = True
    far = truly_bad & (np.abs(sampson_distances(rig.F, left, right)) > 5.0)
    assert not inliers[far].any()
    assert inliers[~truly_bad].mean() > 0.97
    clean = rig.pixels(rig.points(np.random.default_rng(97), 200))
    assert np.sqrt((sampson_distances(F, *clean) ** 2).mean()) < 0.3
    again, inliers_again = fundamental_robust(left, right, sigma)
    assert np.array_equal(F, again)
    assert np.array_equal(inliers, inliers_again)


def test_epipolar_distance_is_the_distance_to_the_line(rig):
    left, right = noisy(rig, 7, 20, 0.0)
    x = np.c_[left, np.ones(20)]
    lines = x @ rig.F.T
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    moved = right + 3.0 * normals
    distances = epipolar_distances(rig.F, left, moved)
    assert np.allclose(distances[:, 1], 3.0)
    assert (distances[:, 0] > 0.5).all()
    sampson = np.abs(sampson_distances(rig.F, left, moved))
    assert (sampson < distances.min(axis=1) + 1e-9).all()
    moved[3] = np.nan
    assert np.isnan(sampson_distances(rig.F, left, moved)[3])


def test_degenerate_matches_are_refused_with_their_reason(rig):
    left, right = noisy(rig, 8, 20, 0.0)
    for estimate in (fundamental_linear, lambda a, b: fundamental_robust(a, b, 0.3)):
        with pytest.raises(GeometryError, match="7 matches") as error:
            estimate(left[:7], right[:7])
        assert error.value.code == "too_few"
        assert error.value.data["matches"] == 7
        with pytest.raises(GeometryError, match="one point"):
            estimate(np.full((20, 2), 5.0), right)
        broken = left.copy()
        broken[4, 1] = np.nan
        with pytest.raises(GeometryError, match=r"\[4\]"):
            estimate(broken, right)
        with pytest.raises(GeometryError, match="shapes"):
            estimate(left, right[:-1])
    with pytest.raises(GeometryError, match="sigma_px is 0"):
        fundamental_robust(left, right, 0.0)
    with pytest.raises(GeometryError, match="rank two"):
        fundamental_refine(np.outer([1, 2, 3.0], [1, 0, 0]), left, right)


def test_points_of_one_plane_are_refused(rig):
    rng = np.random.default_rng(9)
    X = rig.points(rng, 60)
    X[:, 2] = 0.5 + 0.3 * X[:, 0] - 0.2 * X[:, 1]
    exact = rig.pixels(X)
    with pytest.raises(GeometryError, match="plane"):
        fundamental_linear(*exact)
    with pytest.raises(GeometryError, match="plane"):
        fundamental_robust(*(exact + rng.normal(0, 0.3, exact.shape)), 0.3)


def test_pure_noise_has_no_fundamental_matrix():
    rng = np.random.default_rng(10)
    with pytest.raises(GeometryError) as error:
        fundamental_robust(rng.uniform(0, 480, (9, 2)), rng.uniform(0, 480, (9, 2)), 0.01)
    assert error.value.code in {"no_model", "too_few"}
