"""Points and planes of projective space: homogeneous coordinates, joins and meets, oriented planes, normalising maps;
and the error of degenerate geometric input.

Points are rows ``(n, 4)``; a plane is a 4-vector ``a`` used as ``aᵀM`` (thesis 2.5). Points that enter one
construction keep their orbital heights: no function here renormalises a vector whose sign or scale is a result.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.numerics.arrays import FloatArray

RANK_TOLERANCE = 1e-12
"""Relative singular value below which two vectors count as equal: some thousand rounding errors."""


def to_homogeneous(points: FloatArray) -> FloatArray:
    """Append a coordinate of one: ``(n, d)`` -> ``(n, d + 1)``."""
    points = np.asarray(points, dtype=np.float64)
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def from_homogeneous(points: FloatArray) -> FloatArray:
    """Divide by the last coordinate: ``(n, d + 1)`` -> ``(n, d)``; NaN for points at infinity."""
    points = np.asarray(points, dtype=np.float64)
    last = points[..., -1:]
    return points[..., :-1] / np.where(last == 0.0, np.nan, last)


def plane_of_points(A1: FloatArray, A2: FloatArray, A3: FloatArray) -> FloatArray:
    """Oriented plane ``(..., 4)`` through three points ``(..., 4)``: ``aᵀX = det[A1 A2 A3 X]`` (2.61).

    The signed 3x3 minors: the side of a point is the sign of ``aᵀX``, and swapping two points reverses the
    plane's orientation. Zero if the three points are collinear. By duality, three planes give their common
    point.
    """
    A1, A2, A3 = np.broadcast_arrays(A1, A2, A3)
    a, b, c, d = A1[..., 0], A1[..., 1], A1[..., 2], A1[..., 3]
    x, y, z, w = A2[..., 0], A2[..., 1], A2[..., 2], A2[..., 3]
    r, s, t, u = A3[..., 0], A3[..., 1], A3[..., 2], A3[..., 3]
    xy, xz, xw = a * y - b * x, a * z - c * x, a * w - d * x
    yz, yw, zw = b * z - c * y, b * w - d * y, c * w - d * z
    plane: FloatArray = np.stack(
        [
            -(s * zw - t * yw + u * yz),
            r * zw - t * xw + u * xz,
            -(r * yw - s * xw + u * xy),
            r * yz - s * xz + t * xy,
        ],
        axis=-1,
    )
    return plane


def planes_through_line(A1: FloatArray, A2: FloatArray) -> FloatArray:
    """Two orthonormal planes ``(2, 4)`` that meet in the line through two points ``(4,)`` (2.59, 2.60).

    Raises GeometryError if the two points coincide.
    """
    return _complement(A1, A2, "points")


def line_of_planes(a1: FloatArray, a2: FloatArray) -> FloatArray:
    """Two orthonormal points ``(2, 4)`` on the line in which two planes ``(4,)`` meet (2.60).

    Raises GeometryError if the two planes coincide.
    """
    return _complement(a1, a2, "planes")


def _complement(x: FloatArray, y: FloatArray, what: str) -> FloatArray:
    pair = unit_rows(np.stack([x, y]))
    _, singular, rows = np.linalg.svd(pair)
    if not singular[1] > RANK_TOLERANCE:
        raise GeometryError(
            "degenerate",
            f"the two {what} are one ({np.asarray(x)} and {np.asarray(y)}); two different {what} span a line",
            ratio=float(singular[1] / singular[0]),
        )
    return np.ascontiguousarray(rows[2:])


def unit_rows(rows: FloatArray) -> FloatArray:
    rows = np.asarray(rows, dtype=np.float64)
    if not np.isfinite(rows).all():
        raise GeometryError("not_finite", f"homogeneous vectors must be finite, got {rows.tolist()}")
    norms = np.linalg.norm(rows, axis=-1, keepdims=True)
    if not (norms > 0).all():
        raise GeometryError("degenerate", "a homogeneous vector is zero; at least one coordinate must not be")
    unit: FloatArray = rows / norms
    return unit


def whitener(points: FloatArray) -> FloatArray:
    """Map ``W`` (4, 4) that gives the normalised points ``W M / |M|`` of ``(n, 4)`` unit second moments: conditions
    linear fits.

    Raises GeometryError if the points are coplanar.
    """
    unit = unit_rows(points)
    values, vectors = np.linalg.eigh(unit.T @ unit / len(unit))
    if not values[0] > 1e-14 * values[3]:
        raise GeometryError(
            "degenerate", f"the {len(unit)} points are coplanar; spatial ones are needed", moments=values
        )
    W: FloatArray = (vectors / np.sqrt(values)).T
    return W


def move_points(H: FloatArray, M: FloatArray) -> FloatArray:
    """``H M`` (..., 4) of points ``(..., 4)`` under a map ``H`` (4, 4), without normalising the scale."""
    moved: FloatArray = np.asarray(M, dtype=np.float64) @ H.T
    return moved


class GeometryError(ValueError):
    """Degenerate or malformed geometric input. The text states the cause, the value, and what would be valid.

    Attributes: code: short machine-readable cause: ``"shape"``, ``"not_finite"``, ``"too_few"``,
    ``"degenerate"``, ``"orientation"``, ``"half_turn"``, ``"no_model"``. data: the values in the message.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data
