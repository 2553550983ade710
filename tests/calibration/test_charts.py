"""Charts: minimal, exact generators all along, derivatives by finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereoservo.kinematics.parameterization import (
    CHART_SIZE,
    algebra,
    camera_basis,
    conjugation,
    generator_basis,
    point_bases,
)

SEEDS = st.integers(0, 2**32 - 1)


def twist(kind, rng):
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    T = np.zeros((4, 4))
    if kind == "revolute":
        T[:3, :3] = np.cross(np.eye(3), axis)
        T[:3, :3] = [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]
        T[:3, 3] = -np.cross(axis, rng.normal(size=3))
    else:
        T[:3, 3] = rng.uniform(0.5, 2) * axis
    return T


def frame(stratum, rng):
    """A random change of frame of the stratum's group."""
    if stratum == "metric":
        return np.eye(4)
    while True:
        H = np.eye(4) + rng.normal(0, 0.4, (4, 4))
        if stratum == "affine":
            H[3] = 0, 0, 0, 1
        if np.linalg.cond(H) < 30:
            return H


@pytest.mark.parametrize(("stratum", "kind"), list(CHART_SIZE))
@given(seed=SEEDS)
@settings(max_examples=25, deadline=None)
def test_chart_is_minimal_and_complete(stratum, kind, seed):
    rng = np.random.default_rng(seed)
    H = frame(stratum, rng)
    generator = H @ twist(kind, rng) @ np.linalg.inv(H)
    basis = generator_basis(generator, kind, stratum)
    assert basis.shape == (CHART_SIZE[stratum, kind], 4, 4)
    changes = (basis @ generator - generator @ basis).reshape(len(basis), 16)
    directions = algebra(stratum, kind)
    every = (directions @ generator - generator @ directions).reshape(-1, 16)
    own = np.linalg.svd(changes, compute_uv=False)
    assert own[-1] > 1e-6 * own[0]  # no direction is wasted
    rest = every - every @ np.linalg.pinv(changes) @ changes
    assert np.abs(rest).max() < 1e-9 * np.abs(every).max()  # and none is missing


@pytest.mark.parametrize(("stratum", "kind"), list(CHART_SIZE))
@given(seed=SEEDS)
@settings(max_examples=25, deadline=None)
def test_moved_generator_keeps_its_law(stratum, kind, seed):
    rng = np.random.default_rng(seed)
    H = frame(stratum, rng)
    generator = H @ twist(kind, rng) @ np.linalg.inv(H)
    basis = generator_basis(generator, kind, stratum)
    T, _ = conjugation(basis, rng.normal(0, 0.1, len(basis)))
    G = T @ generator @ np.linalg.inv(T)
    defect = G @ G @ G + G if kind == "revolute" else G @ G
    scale = max(1.0, np.linalg.norm(G)) ** 3 * np.linalg.cond(T)
    assert np.abs(defect).max() < 1e-11 * scale
    assert np.abs(G - generator).max() > 1e-4  # it did move
    if stratum != "projective":
        assert np.abs(G[3]).max() < 1e-12 * scale
    if stratum == "metric":
        assert np.allclose(G[:3, :3], -G[:3, :3].T, atol=1e-12 * scale)


@given(seed=SEEDS, stratum=st.sampled_from(["projective", "affine", "metric"]))
@settings(max_examples=25, deadline=None)
def test_derivative_of_conjugation(seed, stratum):
    rng = np.random.default_rng(seed)
    basis = algebra(stratum, "prismatic")
    x = rng.normal(0, 0.1, len(basis))
    T, motions = conjugation(basis, x)
    for k in range(len(basis)):
        step = np.zeros(len(basis))
        step[k] = 1e-6
        numeric = (conjugation(basis, x + step)[0] - conjugation(basis, x - step)[0]) / 2e-6
        assert np.allclose(motions[k] @ T, numeric, atol=1e-8)


@pytest.mark.parametrize(("stratum", "gauge"), [("projective", 4), ("affine", 1), ("metric", 1)])
def test_right_camera_has_no_gauge(stratum, gauge):
    rng = np.random.default_rng(1)
    P = rng.normal(size=(3, 4))
    basis = camera_basis(P, "right", stratum)
    assert len(basis) == 12 - 1 - gauge
    # A change of frame that keeps the left camera [A | 0] changes P by p4 times a row.
    rows = np.eye(4) if stratum == "projective" else np.array([[0.0, 0.0, 0.0, 1.0]])
    for change in [P, *(np.outer(P[:, 3], row) for row in rows)]:
        assert np.abs(np.einsum("pij,ij->p", basis, change)).max() < 1e-12
    assert len(camera_basis(P, "other", stratum)) == 11


def test_point_basis_leaves_out_the_scale():
    M = np.array([0.3, -0.2, 1.0, 0.7])
    assert np.abs(point_bases(M[None], "projective")[0] @ M).max() < 1e-14
    assert np.array_equal(point_bases(M[None], "metric")[0], np.eye(4)[:3])
