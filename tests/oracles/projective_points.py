"""Residuals of incidences, centres of faces, planes and cameras under a map of the points (thesis 2.5)."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import (
    RANK_TOLERANCE,
    GeometryError,
    unit_rows,
)
from stereoservo.numerics.arrays import FloatArray


def incidence_residual(plane: FloatArray, points: FloatArray) -> FloatArray:
    """Signed sine ``(n,)`` between plane ``(4,)`` and points ``(n, 4)`` as unit 4-vectors: 0 where they
    are incident.
    """
    residual: FloatArray = unit_rows(points) @ unit_rows(plane)
    return residual


def collinearity_residual(points: FloatArray) -> float:
    """Third singular value of unit-norm points ``(n, 4)``, n >= 3: 0 where they lie on one line."""
    return float(np.linalg.svd(unit_rows(points), compute_uv=False)[2])


def coplanarity_residual(points: FloatArray) -> float:
    """Fourth singular value of unit-norm points ``(n, 4)``, n >= 4: 0 where they lie on one plane."""
    return float(np.linalg.svd(unit_rows(points), compute_uv=False)[3])


def crossing_of_diagonals(A1: FloatArray, A2: FloatArray, A3: FloatArray, A4: FloatArray) -> FloatArray:
    """Crossing ``(4,)`` of the diagonals A1A3 and A2A4 of a planar quadrangle of points ``(4,)``.

    A centre that needs no plane at infinity. It moves with its points (H A_i gives H C), and points of one
    height give a centre of that height. Slightly non-planar (measured) points give the middle of the
    closest combinations. Raises GeometryError where three corners are collinear or the diagonals do not
    cross.
    """
    corners = np.stack([A1, A3, A2, A4]).astype(np.float64)
    norms = np.linalg.norm(unit_rows(corners) * np.linalg.norm(corners, axis=1, keepdims=True), axis=1)
    _, singular, rows = np.linalg.svd((corners / norms[:, None] * np.array([[1.0], [1.0], [-1.0], [-1.0]])).T)
    if not singular[2] > 1e-9 * singular[0]:
        raise GeometryError("degenerate", "the four corners are collinear; a quadrangle is needed", singular=singular)
    weights = rows[3] / norms
    first, second = weights[0] + weights[1], weights[2] + weights[3]
    scale = 0.5 * (first + second)
    if not min(abs(first), abs(second)) > 1e-9 * float(np.abs(weights).max()):
        raise GeometryError(
            "degenerate", "the diagonals are parallel in these heights; give convex corners in cyclic order"
        )
    centre: FloatArray = 0.5 * (weights @ corners) / scale
    return centre


def affine_middle(points: FloatArray, plane_at_infinity: FloatArray) -> FloatArray:
    """Affine middle ``(4,)`` of points ``(n, 4)``, scaled to ``a∞ᵀM = 1``. Raises GeometryError for one at
    infinity.
    """
    points = np.atleast_2d(np.asarray(points, dtype=np.float64))
    heights = points @ plane_at_infinity
    far = np.abs(incidence_residual(plane_at_infinity, points)) < RANK_TOLERANCE
    if far.any():
        raise GeometryError(
            "degenerate",
            f"point(s) {np.flatnonzero(far).tolist()} lie at infinity; a middle needs finite points",
            points=np.flatnonzero(far).tolist(),
        )
    middle: FloatArray = (points / heights[:, None]).mean(axis=0)
    return middle


def move_planes(H: FloatArray, a: FloatArray) -> FloatArray:
    """``H⁻ᵀ a`` (..., 4) of planes ``(..., 4)`` under the map ``H`` (4, 4) of the points (2.68)."""
    moved: FloatArray = np.asarray(a, dtype=np.float64) @ np.linalg.inv(H)
    return moved


def move_cameras(H: FloatArray, Ps: FloatArray) -> FloatArray:
    """``P H⁻¹`` (..., 3, 4) of cameras ``(..., 3, 4)`` under the map ``H`` (4, 4) of the points (2.14-2.16)."""
    moved: FloatArray = np.asarray(Ps, dtype=np.float64) @ np.linalg.inv(H)
    return moved
