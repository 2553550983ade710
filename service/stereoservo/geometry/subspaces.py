"""Linear subspaces of projective space as spans of points or meets of hyperplanes: basis, dual, dimension, incidence,
relative position (thesis 2.5.3, 2.6.2).

A k-dimensional subspace of ``P^n`` (N = n + 1) is either the span of K = k + 1 points, a multi-column, or the
meet of L = n - k hyperplanes, a multi-row. Both are stored one vector a row: ``(K, N)`` and ``(L, N)``. The
empty subspace has no point, the whole space no hyperplane: ``(0, N)``. Results are orthonormal rows.

Ranks are numerical. A sine in R^N counts as zero below ``tolerance``: between rounding (1e-16) and geometry for
exact input. Noisy input needs the noise's own size, in a frame where coordinates are of order one
(`stereoservo.geometry.homogeneous.whitener`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError, unit_rows
from stereoservo.numerics.arrays import FloatArray

TOLERANCE = 1e-9
"""Sine below which a vector counts as lying in a subspace, unless the caller states another."""

Position = Literal["disjoint", "intersecting", "first_in_second", "second_in_first", "coincident"]


def _vectors(vectors: FloatArray) -> FloatArray:
    vectors = np.atleast_2d(np.asarray(vectors, dtype=np.float64))
    if vectors.ndim != 2 or vectors.shape[1] < 2:
        raise GeometryError(
            "shape",
            f"a multi-column or multi-row has shape {vectors.shape}; (count, N) with N >= 2 is needed",
            shape=vectors.shape,
        )
    return unit_rows(vectors) if len(vectors) else vectors


def basis(vectors: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
    """Orthonormal rows ``(rank, N)`` that span what the vectors ``(m, N)`` span (2.62).

    The rank counts singular values of the unit vectors above ``tolerance`` times the largest. Of points, the
    join; of hyperplanes, the multi-row of their meet. Raises GeometryError for vectors that are zero or not
    finite.
    """
    unit = _vectors(vectors)
    if not len(unit):
        return unit
    _, singular, rows = np.linalg.svd(unit, full_matrices=False)
    return np.ascontiguousarray(rows[singular > tolerance * singular[0]])


def dual(vectors: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
    """Multi-row ``(N - rank, N)`` of a multi-column ``(m, N)``, and the reverse: the complement (2.65-2.67)."""
    unit = _vectors(vectors)
    if not len(unit):
        return np.eye(unit.shape[1])
    _, singular, rows = np.linalg.svd(unit, full_matrices=len(unit) < unit.shape[1])
    return np.ascontiguousarray(rows[int((singular > tolerance * singular[0]).sum()) :])


def dimension(points: FloatArray, tolerance: float = TOLERANCE) -> int:
    """Dimension k of the span of points ``(m, N)``: 0 a point, 1 a line, 2 a plane; -1 the empty subspace."""
    return len(basis(points, tolerance)) - 1


def _same_space(*subspaces: FloatArray) -> None:
    sizes = [np.atleast_2d(points).shape[-1] for points in subspaces]
    if len(set(sizes)) != 1:
        raise GeometryError(
            "shape", f"vectors have {sizes} coordinates; subspaces of one space are needed", sizes=sizes
        )


def incidence_matrix(planes: FloatArray, points: FloatArray) -> FloatArray:
    """``C = [[a]] [[A]]`` (L, K) of a multi-row ``(L, N)`` and a multi-column ``(K, N)`` (2.74).

    Zero where the points' span lies in the meet of the planes (2.77). Its kernel gives the intersection (2.75).
    Vectors are taken as they are; for sines give orthonormal ones (`basis`).
    """
    _same_space(planes, points)
    C: FloatArray = np.atleast_2d(planes) @ np.atleast_2d(points).T
    return C


@dataclass(frozen=True)
class Relation:
    """Relative position of two subspaces.

    ``position``; ``dimension`` d of their intersection, -1 if disjoint; ``intersection`` a multi-column
    (d + 1, N); ``sines`` (min(K, L)) of the principal angles between the first and the second, ascending.
    """

    position: Position
    dimension: int
    intersection: FloatArray
    sines: FloatArray


def relation(first: FloatArray, second: FloatArray, tolerance: float = TOLERANCE) -> Relation:
    """Relation of the spans of points ``first`` (m, N) and ``second`` (m', N) (2.74-2.77, fig. 2.15).

    The incidence matrix of the second's multi-row and the first's multi-column has as singular values the sines
    of principal angles, since both are orthonormal. With their rank, ``d = K - rank - 1``, and the subspaces are
    disjoint iff ``rank = K`` (errata; the thesis's ``L`` is wrong). Intersections of two lines in the plane and
    of a line with a plane in space always exist; two lines in space meet only where a sine vanishes.
    """
    _same_space(first, second)
    A, B = basis(first, tolerance), basis(second, tolerance)
    if not len(A) or not len(B):
        raise GeometryError("shape", "a subspace is empty; at least one point each is needed")
    C = incidence_matrix(dual(B), A)
    _, singular, kernel = np.linalg.svd(C, full_matrices=True)
    rank = int((singular > tolerance).sum())
    d = len(A) - rank - 1
    intersection = np.ascontiguousarray(kernel[rank:] @ A)
    position: Position
    if d < 0:
        position = "disjoint"
    elif d + 1 == len(A) == len(B):
        position = "coincident"
    elif d + 1 == len(A):
        position = "first_in_second"
    elif d + 1 == len(B):
        position = "second_in_first"
    else:
        position = "intersecting"
    return Relation(position, d, intersection, singular[::-1].copy())


def coincident(first: FloatArray, second: FloatArray, tolerance: float = TOLERANCE) -> bool:
    """Whether two spans coincide (2.77): equal dimensions and a vanishing incidence matrix."""
    return relation(first, second, tolerance).position == "coincident"
