import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oracles.subspace_algebra import included, join, meet
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.incidences import basis, coincident, dimension, dual, incidence_matrix, relation

seeds = st.integers(0, 2**32 - 1)
spaces = st.integers(2, 6)


def frame(rng, size):
    U, _ = np.linalg.qr(rng.normal(size=(size, size)))
    V, _ = np.linalg.qr(rng.normal(size=(size, size)))
    return U @ np.diag(rng.uniform(0.5, 2.0, size)) @ V


def spanning(rng, rows):
    """As many combinations of the rows as rows, well conditioned, at random scales and signs."""
    mixed = frame(rng, len(rows)) @ rows
    return mixed * rng.uniform(0.1, 10.0, (len(rows), 1)) * rng.choice([-1.0, 1.0], (len(rows), 1))


@given(seeds, spaces, st.data())
def test_coordinate_subspaces_meet_and_join_as_sets(seed, size, data):
    """Spans of basis vectors are sets of indices: intersection, union, inclusion are those of the sets."""
    rng = np.random.default_rng(seed)
    indices = st.sets(st.integers(0, size - 1), min_size=1, max_size=size)
    first, second = data.draw(indices), data.draw(indices)
    H = frame(rng, size)
    columns = H.T
    A, B = spanning(rng, columns[sorted(first)]), spanning(rng, columns[sorted(second)])
    common, union = sorted(first & second), sorted(first | second)

    found = relation(A, B)
    assert found.dimension == len(common) - 1
    expected = (
        "disjoint"
        if not common
        else "coincident"
        if first == second
        else "first_in_second"
        if first < second
        else "second_in_first"
        if second < first
        else "intersecting"
    )
    assert found.position == expected
    assert coincident(A, B) == (first == second)
    assert included(A, B) == (first <= second)

    both = meet(A, B)
    assert both.shape == found.intersection.shape == (len(common), size)
    if common:
        assert coincident(both, columns[common])
        assert coincident(found.intersection, columns[common])
    together = join(A, B)
    assert together.shape == (len(union), size)
    assert coincident(together, columns[union])


@given(seeds, spaces, st.integers(1, 6))
def test_duals_are_complements_and_move_with_the_inverse_transpose(seed, size, count):
    rng = np.random.default_rng(seed)
    count = min(count, size)
    A = spanning(rng, frame(rng, size)[:count])
    a = dual(A)
    assert a.shape == (size - count, size)
    assert np.abs(incidence_matrix(a, A)).max(initial=0.0) < 1e-12 * np.abs(A).max()
    assert np.allclose(a @ a.T, np.eye(size - count))
    assert dual(a).shape == (count, size)
    H = frame(rng, size)
    moved = incidence_matrix(a @ np.linalg.inv(H), A @ H.T)
    assert np.abs(moved).max(initial=0.0) < 1e-11 * np.abs(A).max()


@given(seeds)
def test_sines_are_those_of_the_principal_angles(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(2, 5)), rng.normal(size=(3, 5))
    from scipy.linalg import subspace_angles

    expected = np.sort(np.sin(subspace_angles(A.T, B.T)))
    assert np.allclose(relation(A, B).sines, expected, atol=1e-12)


def test_lines_in_space_meet_only_where_their_determinant_vanishes():
    rng = np.random.default_rng(1)
    A, B = rng.normal(size=(2, 4)), rng.normal(size=(2, 4))
    assert abs(np.linalg.det(np.vstack([A, B]))) > 1e-2
    assert relation(A, B).position == "disjoint"
    B[0] = 2.0 * A[0] - 3.0 * A[1]
    meeting = relation(A, B)
    assert (meeting.position, meeting.dimension) == ("intersecting", 0)
    assert coincident(meeting.intersection, B[:1])


def test_the_corrected_dimension_holds_where_the_printed_one_fails():
    """A plane (K = 3) and a line (L = 2 planes) in space that cross: rank 2, d = K - rank - 1 = 0, not -1."""
    rng = np.random.default_rng(2)
    plane, line = rng.normal(size=(3, 4)), rng.normal(size=(2, 4))
    C = incidence_matrix(dual(line), plane)
    assert C.shape == (2, 3)
    assert np.linalg.matrix_rank(C) == 2
    crossing = relation(plane, line)
    assert (crossing.position, crossing.dimension) == ("intersecting", 0)
    x = np.linalg.svd(C)[2][2]
    assert coincident(crossing.intersection, x @ plane)


def test_the_stated_tolerance_decides():
    A = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    B = np.array([[1.0, 0, 1e-4, 0], [0, 1.0, 0, 0]])
    assert relation(A, B).position == "intersecting"
    assert relation(A, B, tolerance=1e-3).position == "coincident"
    assert np.isclose(relation(A, B).sines[-1], 1e-4, rtol=1e-6)
    assert dimension(np.vstack([A, B])) == 2
    assert dimension(np.vstack([A, B]), tolerance=1e-3) == 1


def test_empty_and_whole_subspaces_are_duals():
    assert dual(np.zeros((0, 4))).shape == (4, 4)
    assert dual(np.eye(4)).shape == (0, 4)
    assert dimension(np.zeros((0, 4))) == -1
    assert meet(np.eye(4)[:2], np.eye(4)[2:]).shape == (0, 4)


def test_malformed_subspaces_are_refused():
    with pytest.raises(GeometryError, match=r"\[4, 3\] coordinates"):
        join(np.eye(4), np.eye(3))
    with pytest.raises(GeometryError, match="zero"):
        basis(np.zeros((2, 4)))
    with pytest.raises(GeometryError, match="empty"):
        relation(np.zeros((0, 4)), np.eye(4))
    with pytest.raises(GeometryError, match="N >= 2"):
        basis(np.ones((2, 1)))
