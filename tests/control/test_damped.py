"""Own Cholesky and Jacobi against LAPACK."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from oracles.damped import null_direction_reference
from stereoservo.numerics.linear import (
    damped_least_squares,
    left_null_direction,
    null_direction,
    orthonormal_rows,
    right_singular,
)
from stereoservo_sim.benchmarks.cycle import damped_least_squares_reference


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("damping", [0.0, 1e-6, 1e-2])
def test_damped_least_squares_is_numpys(seed, damping):
    rng = np.random.default_rng(seed)
    rows, n = int(rng.integers(7, 30)), int(rng.integers(1, 8))
    J, e, w = rng.normal(size=(rows, n)), rng.normal(size=rows), rng.uniform(0.5, 3.0, rows)
    w[rng.random(rows) < 0.2] = 0.0
    w[:n] = 1.0
    mu = damping * ((w[:, None] * J) ** 2).sum(axis=0).max()
    stacked = np.vstack([w[:, None] * J, np.sqrt(mu) * np.eye(n)])
    truth = np.linalg.lstsq(stacked, np.concatenate([w * e, np.zeros(n)]), rcond=None)[0]
    x, conditioning = damped_least_squares(J, e, w, damping)
    reference, reference_conditioning = damped_least_squares_reference(J, e, w, damping)
    np.testing.assert_allclose(x, truth, atol=1e-10)
    np.testing.assert_allclose(reference, truth, atol=1e-10)
    assert 0 < conditioning <= 1
    assert conditioning == pytest.approx(reference_conditioning, rel=1e-10)


def test_rows_of_weight_zero_are_not_read():
    rng = np.random.default_rng(3)
    J, e, w = rng.normal(size=(12, 6)), rng.normal(size=12), np.ones(12)
    w[[2, 5]] = 0.0
    expected = damped_least_squares(J, e, w, 1e-3)[0]
    J[2], e[5] = np.nan, np.inf
    np.testing.assert_array_equal(damped_least_squares(J, e, w, 1e-3)[0], expected)
    np.testing.assert_allclose(damped_least_squares_reference(J, e, w, 1e-3)[0], expected, atol=1e-12)


@pytest.mark.parametrize("solve", [damped_least_squares, damped_least_squares_reference])
def test_a_singular_or_empty_system_gives_no_motion(solve):
    J = np.ones((8, 3))
    for matrix, weights in ((J, np.ones(8)), (np.zeros((8, 3)), np.ones(8)), (J, np.zeros(8))):
        x, conditioning = solve(matrix, np.ones(8), weights, 0.0)
        assert conditioning == 0.0
        np.testing.assert_array_equal(x, np.zeros(3))


def test_damping_makes_a_singular_system_solvable():
    x, conditioning = damped_least_squares(np.ones((8, 3)), np.ones(8), np.ones(8), 1e-6)
    np.testing.assert_allclose(x, np.full(3, 1 / 3), rtol=1e-5)
    assert 0 < conditioning < 1e-5


@settings(max_examples=150, deadline=None)
@given(
    rows=st.integers(1, 16),
    n=st.integers(1, 8),
    decades=st.integers(0, 12),
    rank_gap=st.booleans(),
    seed=st.integers(0, 10**6),
)
def test_jacobi_is_lapacks_svd(rows, n, decades, rank_gap, seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(rows, n)) * 10.0 ** rng.uniform(-decades, 0, n)
    if rank_gap and n > 1:
        A[:, -1] = A[:, :-1] @ rng.normal(size=n - 1)
    V, values = right_singular(A)
    truth = np.zeros(n)
    truth[: min(rows, n)] = np.linalg.svd(A, compute_uv=False)
    np.testing.assert_allclose(values, truth, atol=1e-13 * truth[0] + 1e-300)
    np.testing.assert_allclose(V.T @ V, np.eye(n), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(A @ V, axis=0), truth, atol=1e-13 * truth[0])


@pytest.mark.parametrize("seed", range(30))
def test_null_direction_is_lapacks(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(8, 6))
    A[:, 5] = A[:, :5] @ rng.normal(size=5) + 10.0 ** rng.uniform(-9, -1) * rng.normal(size=8)
    x, *values = null_direction(A)
    y, *truth = null_direction_reference(A)
    np.testing.assert_allclose(values, truth, atol=1e-10)
    np.testing.assert_allclose(x * np.sign(x @ y), y, atol=1e-10)
    assert np.linalg.norm(A @ x) == pytest.approx(values[0], abs=1e-12)


def test_one_column_and_fewer_rows_than_columns():
    x, smallest, second, largest = null_direction(np.array([[3.0], [4.0]]))
    assert abs(x[0]) == 1.0
    assert smallest == second == largest == pytest.approx(5.0)
    x, smallest, second, largest = null_direction(np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]))
    np.testing.assert_allclose(np.abs(x), [0, 0, 1])
    assert (smallest, second, largest) == pytest.approx((0.0, 1.0, 2.0))


@pytest.mark.parametrize("seed", range(30))
def test_rows_are_made_orthonormal_and_the_bound_is_one(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    A = rng.normal(size=(n, 16)) * 10.0 ** rng.uniform(-3, 0, n)[:, None]
    Q, W = np.empty((n, 16)), np.empty((n, n))
    bound = orthonormal_rows(A, Q, W)
    values = np.linalg.svd(A, compute_uv=False)
    assert values[-1] / values[0] / n <= bound * (1 + 1e-9)
    assert bound <= values[-1] / values[0] * (1 + 1e-9)
    np.testing.assert_allclose(Q @ Q.T, np.eye(n), atol=1e-15 / bound)
    np.testing.assert_allclose(W.T @ A, Q, atol=1e-15 / bound)
    A[0] = 0.0
    assert orthonormal_rows(A, Q, W) == 0.0


@pytest.mark.parametrize("seed", range(30))
def test_left_null_direction_is_lapacks_where_its_bounds_tell(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 8))
    A[5] = rng.normal(size=5) @ A[:5] + 10.0 ** rng.uniform(-17, -1) * rng.normal(size=8)
    A = np.ascontiguousarray(A[rng.permutation(6)])
    y, *truth = null_direction_reference(A.T)
    x = np.empty(6)
    smallest, second, largest = left_null_direction(A.copy(), x)
    assert truth[0] <= smallest + 1e-14
    assert largest >= truth[2] * (1 - 1e-12)
    assert 0.0 < second <= truth[1] * (1 + 1e-12)
    np.testing.assert_allclose(x * np.sign(x @ y), y, atol=1e-10)
    A[1] = 2.0 * A[0] - A[2]  # two directions are null, or nearly: not told
    A[4] = A[3]
    smallest, second, largest = left_null_direction(A, x)
    assert second <= 1e-14 * largest
