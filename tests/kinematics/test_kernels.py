from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from stereoservo.geometry import cameras
from stereoservo.kinematics import kernels
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.numerics import compilation

pytestmark = pytest.mark.filterwarnings("error")

KINDS = ("revolute", "prismatic")
seeds = st.integers(0, 2**32 - 1)
kinds_of_arms = st.lists(st.sampled_from(KINDS), min_size=1, max_size=8).map(tuple)


def random_chain(seed, kinds):
    rng = np.random.default_rng(seed)
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    H = U @ np.diag(rng.uniform(0.5, 2.0, 4))
    generators = np.zeros((len(kinds), 4, 4))
    for j, kind in enumerate(kinds):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        if kind == "revolute":
            generators[j, :3, :3] = np.cross(np.eye(3), -axis)
            generators[j, :3, 3] = np.cross(rng.uniform(-0.5, 0.5, 3), axis)
        else:
            generators[j, :3, 3] = axis
    return rng, H, ProjectiveChain(kinds, H @ generators @ np.linalg.inv(H), rng.uniform(-1, 1, len(kinds)))


def random_scene(seed, c=2, m=6):
    """Cameras (c, 3, 4) about a cloud at four metres, and its points (m, 4), in a random projective
    frame.
    """
    rng = np.random.default_rng(seed)
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    H = U @ np.diag(rng.uniform(0.5, 2.0, 4))
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    Ps = []
    for i in range(c):
        R = Rotation.from_euler("yx", [-0.3 * i, 0.1 * rng.uniform(-1, 1)]).as_matrix()
        Ps.append(K @ np.hstack([R, -R @ [[-1.2 * i], [0.0], [0.0]]]) @ np.linalg.inv(H))
    X = np.ones((m, 4))
    X[:, :3] = rng.uniform(-0.5, 0.5, (m, 3)) + np.array([0, 0, 4.0])
    return rng, np.ascontiguousarray(np.stack(Ps)), X @ H.T


@given(seeds, kinds_of_arms)
@settings(max_examples=150)
def test_forward_kinematics_is_the_references(seed, kinds):
    rng, _, chain = random_chain(seed, kinds)
    q = rng.uniform(-3, 3, len(kinds))
    H, operators = kernels.chain_forward(chain.generators, chain.kind_codes, chain.zero, q)
    assert np.abs(H - chain.displacement(q)).max() < 1e-10
    assert np.abs(operators - chain.operators_at(q)).max() < 1e-10
    again, operators_again = np.full((4, 4), np.nan), np.full(operators.shape, np.nan)
    record = kernels.Chain(chain.generators, chain.kind_codes, chain.zero, False)
    kernels.chain_forward_into(record, q, again, operators_again)
    assert again.tobytes() == H.tobytes()
    assert operators_again.tobytes() == operators.tobytes()
    turned = ProjectiveChain(chain.kinds, chain.generators, chain.zero, tip_first=True)
    H, operators = kernels.chain_forward(chain.generators, chain.kind_codes, chain.zero, q, True)
    assert np.abs(H - turned.displacement(q)).max() < 1e-10
    assert np.abs(operators - turned.operators_at(q)).max() < 1e-10


@given(seeds, st.integers(1, 3), st.integers(0, 9))
def test_transform_and_projection_are_the_references(seed, c, m):
    rng, Ps, M = random_scene(seed, c, m)
    M = np.ascontiguousarray(M)
    pixels, depths = kernels.project_points(Ps, M)
    assert pixels.shape == (c, m, 2)
    assert np.allclose(pixels, cameras.project_many(Ps, M), rtol=0, atol=1e-10 * 1e3)
    assert np.allclose(depths, np.einsum("cj,mj->cm", Ps[:, 2], M), rtol=0, atol=1e-10)
    H = rng.normal(size=(4, 4))
    assert np.allclose(kernels.transform_points(H, M), M @ H.T, rtol=0, atol=1e-10)


@given(seeds, kinds_of_arms, st.integers(1, 3))
def test_image_jacobian_is_the_references(seed, kinds, c):
    _, Ps, M = random_scene(seed, c)
    M = np.ascontiguousarray(M)
    rng, _, chain = random_chain(seed + 1, kinds)
    q = rng.uniform(-3, 3, len(kinds))
    J = kernels.image_jacobian(np.ascontiguousarray(chain.operators_at(q)), Ps, M)
    reference = chain.image_jacobian(Ps, q, M)
    assert np.abs(J - reference).max() < 1e-10 * max(1.0, np.abs(reference).max())


def test_points_in_a_focal_plane_give_nan():
    Ps = np.eye(3, 4)[None]
    M = np.array([[1.0, 2.0, 0.0, 1.0], [1.0, 2.0, 4.0, 1.0]])
    pixels, depths = kernels.project_points(Ps, M)
    assert np.isnan(pixels[0, 0]).all()
    assert pixels[0, 1].tolist() == [0.25, 0.5]
    assert depths[0].tolist() == [0.0, 4.0]
    J = kernels.image_jacobian(np.ones((1, 4, 4)), Ps, M)
    assert np.isnan(J[0, 0]).all()
    assert np.isfinite(J[0, 1]).all()


@given(arrays(np.float64, (4, 4), elements=st.floats(-10, 10, width=32)))
def test_inverse_is_lapacks(H):
    found = kernels.invert4(H)
    condition = np.linalg.cond(H)
    if condition < 1e6:
        truth = np.linalg.inv(H)
        assert np.abs(found - truth).max() <= 1e-14 * condition**2 * np.abs(truth).max()


def test_inverse_of_a_singular_matrix_is_nan():
    assert np.isnan(kernels.invert4(np.ones((4, 4)))).all()
    assert np.isnan(kernels.invert4(np.full((4, 4), np.nan))).all()


@given(arrays(np.float64, (4, 4), elements=st.floats(-10, 10, width=32)))
def test_eigenvectors_of_a_symmetric_matrix(A):
    S = A + A.T
    values, vectors = kernels.symmetric_eigen4(S)
    size = max(1.0, np.abs(S).max())
    assert np.abs(values - np.linalg.eigvalsh(S)).max() < 1e-12 * size
    assert np.abs(vectors.T @ vectors - np.eye(4)).max() < 1e-13
    assert np.abs(S @ vectors - vectors * values).max() < 1e-12 * size
    assert (np.diff(values) >= 0).all()


@given(seeds, st.integers(2, 4), st.integers(0, 8), st.integers(0, 5))
def test_triangulation_is_the_references(seed, c, m, iterations):
    rng, Ps, X = random_scene(seed, c, m)
    pixels = cameras.project_many(Ps, X) + rng.normal(0, 0.5, (c, m, 2))
    sigmas = rng.uniform(0.1, 1.0, (c, m))
    missing = rng.uniform(size=(c, m)) < 0.2
    pixels[missing] = np.nan
    weights = np.where(missing, 0.0, 1.0 / sigmas)
    M, ok = kernels.triangulate(Ps, pixels, weights, iterations)
    reference = cameras.triangulate(Ps, pixels, sigmas, iterations)
    assert ok.dtype == np.bool_
    assert np.array_equal(ok, (~missing).sum(axis=0) >= 2)
    assert np.array_equal(ok, np.isfinite(reference).all(axis=1))
    assert np.isnan(M[~ok]).all()
    if ok.any():
        assert np.abs(M[ok] - reference[ok]).max() < 1e-10 * max(1.0, np.abs(reference[ok]).max())
        assert np.allclose(M[ok] @ Ps[0, 2], 1.0)


@given(seeds, st.integers(2, 4))
def test_triangulation_is_exact_without_noise(seed, c):
    _, Ps, X = random_scene(seed, c)
    M, ok = kernels.triangulate(Ps, cameras.project_many(Ps, X), np.ones((c, len(X))), 2)
    assert ok.all()
    assert np.abs(M - X / (X @ Ps[0, 2])[:, None]).max() < 1e-9


def test_rays_that_determine_nothing_are_reported():
    _, Ps, X = random_scene(1)
    pixels = cameras.project_many(Ps, X)
    same = np.ascontiguousarray(Ps[[0, 0]])
    M, ok = kernels.triangulate(same, np.ascontiguousarray(pixels[[0, 0]]), np.ones(pixels.shape[:2]), 3)
    assert not ok.any()
    assert np.isnan(M).all()


def test_kernels_repeat_themselves_to_the_bit():
    rng, _, chain = random_chain(2, ("revolute",) * 6)
    _, Ps, X = random_scene(3)
    pixels = cameras.project_many(Ps, X) + rng.normal(0, 0.3, (2, 6, 2))
    q = rng.uniform(-2, 2, 6)

    def run():
        H, operators = kernels.chain_forward(chain.generators, chain.kind_codes, chain.zero, q)
        M, _ = kernels.triangulate(Ps, pixels, np.ones((2, 6)), 3)
        J = kernels.image_jacobian(operators, Ps, kernels.transform_points(H, M))
        return H.tobytes() + operators.tobytes() + M.tobytes() + J.tobytes()

    first = run()
    assert all(run() == first for _ in range(20))


def test_pixels_that_are_not_numbers_spoil_their_own_point_only():
    _, Ps, X = random_scene(4)
    pixels = cameras.project_many(Ps, X)
    truth, _ = kernels.triangulate(Ps, pixels, np.ones((2, 6)), 3)
    pixels[0, 2, 1] = np.nan
    pixels[1, 4, 0] = np.inf
    M, ok = kernels.triangulate(Ps, pixels, np.ones((2, 6)), 3)
    assert ok.tolist() == [True, True, False, True, False, True]
    assert np.isnan(M[~ok]).all()
    assert np.array_equal(M[ok], truth[ok])


def test_kernels_compile_where_no_cache_directory_is_writable(monkeypatch):
    def without_cache(function):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(compilation, "KernelCache", without_cache)

    def double(x):
        return 2.0 * x

    with pytest.warns(RuntimeWarning, match="no locator available; compiling at every start"):
        compiled = compilation.kernel(double)
    assert compiled(3.0) == 6.0
    assert compiled.signatures


def test_kernels_are_cached_on_disk():
    rng, _, chain = random_chain(5, ("revolute", "prismatic"))
    kernels.chain_forward(chain.generators, chain.kind_codes, chain.zero, rng.uniform(-1, 1, 2))
    assert Path(kernels.chain_forward.stats.cache_path).is_dir()
    assert list(Path(kernels.chain_forward.stats.cache_path).glob("kernels.chain_forward-*.nbi"))
