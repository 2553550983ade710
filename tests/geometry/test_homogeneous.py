import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from oracles.projective_points import (
    affine_middle,
    collinearity_residual,
    coplanarity_residual,
    crossing_of_diagonals,
    incidence_residual,
)
from stereoservo.geometry.homogeneous import (
    GeometryError,
    from_homogeneous,
    line_of_planes,
    plane_of_points,
    planes_through_line,
    to_homogeneous,
)

vectors = arrays(np.float64, (4, 4), elements=st.floats(-10, 10, allow_nan=False, width=32))
seeds = st.integers(0, 2**32 - 1)


def frame(rng):
    """A random projective frame of condition below about ten."""
    U, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    V, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    return U @ np.diag(rng.uniform(0.5, 3.0, 4)) @ V


def test_homogeneous_and_back():
    points = np.random.default_rng(1).normal(size=(5, 3))
    assert np.array_equal(from_homogeneous(to_homogeneous(points)), points)
    assert np.isnan(from_homogeneous(np.array([[1.0, 2.0, 3.0, 0.0]]))).all()


@given(vectors)
def test_plane_times_point_is_the_determinant(X):
    plane = plane_of_points(X[0], X[1], X[2])
    scale = max(1.0, np.prod(np.linalg.norm(X, axis=1)))
    assert abs(plane @ X[3] - np.linalg.det(X.T)) <= 1e-13 * scale


def test_plane_faces_turn_with_the_order_and_survive_displacements():
    rng = np.random.default_rng(2)
    A, X = rng.normal(size=(3, 4)), rng.normal(size=(50, 4))
    plane = plane_of_points(*A)
    assert np.allclose(plane_of_points(A[1], A[0], A[2]), -plane)
    H = frame(rng)
    H /= abs(np.linalg.det(H)) ** 0.25
    moved = plane_of_points(*(A @ H.T))
    assert np.allclose(moved @ (H @ X.T), np.sign(np.linalg.det(H)) * plane @ X.T)


def test_plane_of_points_takes_stacks():
    A = np.random.default_rng(3).normal(size=(7, 3, 4))
    stacked = plane_of_points(A[:, 0], A[:, 1], A[:, 2])
    for a, plane in zip(A, stacked, strict=True):
        assert np.array_equal(plane_of_points(*a), plane)


@given(seeds)
def test_line_is_the_meet_of_the_planes_through_it(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 4))
    planes = planes_through_line(*A)
    assert np.allclose(planes @ planes.T, np.eye(2))
    assert np.abs(planes @ A.T).max() < 1e-12 * np.abs(A).max()
    points = line_of_planes(*planes)
    assert collinearity_residual(np.vstack([A, points])) < 1e-7 * np.linalg.cond(A)


def test_residuals_tell_incidence_from_general_position():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(3, 4))
    inside = rng.normal(size=(6, 3)) @ A
    assert np.abs(incidence_residual(plane_of_points(*A), inside)).max() < 1e-13
    assert coplanarity_residual(np.vstack([A, inside])) < 1e-13
    outside = rng.normal(size=(6, 4))
    assert np.abs(incidence_residual(plane_of_points(*A), outside)).min() > 1e-3
    assert coplanarity_residual(np.vstack([A, outside])) > 1e-2
    assert collinearity_residual(A) > 1e-2


@given(seeds)
def test_diagonals_cross_where_euclidean_ones_do(seed):
    rng = np.random.default_rng(seed)
    corners = np.array([[-1, -1, 0, 1], [1, -1, 0, 1], [1, 1, 0, 1], [-1, 1, 0, 1]], float)
    corners[:, :2] += rng.uniform(-0.3, 0.3, (4, 2))
    (x1, y1), (x2, y2), (x3, y3), (x4, y4) = corners[:, :2]
    s = np.linalg.solve([[x3 - x1, x2 - x4], [y3 - y1, y2 - y4]], [x2 - x1, y2 - y1])[0]
    truth = np.array([x1 + s * (x3 - x1), y1 + s * (y3 - y1), 0, 1])
    H = frame(rng)
    heights = rng.uniform(0.5, 2.0, 4)
    centre = crossing_of_diagonals(*(heights[:, None] * (corners @ H.T)))
    X = np.linalg.solve(H, centre)
    assert X[3] > 0
    assert np.allclose(X / X[3], truth, atol=1e-9)
    equal = np.linalg.solve(H, crossing_of_diagonals(*(corners @ H.T)))
    assert np.allclose(equal, truth, atol=1e-9)


def test_diagonals_of_collinear_or_parallel_corners_are_refused():
    line = np.array([[t, 2 * t, 0, 1] for t in range(4)], float)
    with pytest.raises(GeometryError) as error:
        crossing_of_diagonals(*line)
    assert error.value.code == "degenerate"
    zigzag = np.array([[0, 0, 0, 1], [0, 1, 0, 1], [1, 0, 0, 1], [1, 1, 0, 1]], float)
    with pytest.raises(GeometryError, match="cyclic order"):
        crossing_of_diagonals(*zigzag)


@given(seeds)
def test_affine_middle_is_the_euclidean_mean(seed):
    rng = np.random.default_rng(seed)
    X = to_homogeneous(rng.uniform(-1, 1, (5, 3)))
    H = frame(rng)
    plane = np.linalg.inv(H).T @ [0, 0, 0, 1]
    M = (X @ H.T) * rng.uniform(0.3, 3.0, (5, 1))
    middle = affine_middle(M, plane)
    assert np.isclose(plane @ middle, 1.0)
    assert np.allclose(np.linalg.solve(H, middle), X.mean(axis=0), atol=1e-10)


def test_affine_middle_refuses_points_at_infinity():
    points = np.array([[1.0, 0, 0, 1], [1.0, 2.0, 0, 0]])
    with pytest.raises(GeometryError, match=r"\[1\] lie at infinity") as error:
        affine_middle(points, np.array([0, 0, 0, 1.0]))
    assert error.value.data["points"] == [1]


@given(arrays(np.float64, 4, elements=st.floats(-1, 1, width=32)), st.floats(0.1, 10))
def test_one_point_twice_spans_no_line(A, factor):
    assume(np.linalg.norm(A) > 1e-3)
    with pytest.raises(GeometryError, match="two different points"):
        planes_through_line(A, factor * A)


def test_malformed_vectors_are_refused():
    with pytest.raises(GeometryError, match="zero"):
        planes_through_line(np.zeros(4), np.ones(4))
    with pytest.raises(GeometryError, match="finite"):
        line_of_planes(np.array([np.nan, 0, 0, 1]), np.ones(4))
