"""One revolute joint (thesis 6.2): a circle met with a plane, a point brought to its target, planes across an axis.

Only incidences: the operator's own kernel is its axis, its left kernel the planes across it, and its range, on which it
is a quarter turn, holds the directions in which points move. No plane at infinity, no metric.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.inverse.branches import FREE, Branches, single


@dataclass(frozen=True, eq=False)
class Crossing:
    """Angles (k,) [rad] at which a point on its circle lies in a plane: two; one where it only comes near, or the seed
    where it lies there all the time. ``excess`` and ``free`` as in `Branches`.
    """

    angles: FloatArray
    excess: float
    free: bool


def circle_meets_plane(G: FloatArray, A: FloatArray, plane: FloatArray, seed: float = 0.0) -> Crossing:
    """Both roots of ``aᵀ exp(θĤ) A = 0`` (6.8): ``p₀ + p_s sinθ - p_c cosθ = 0`` (errata to 6.9, 6.10).

    ``G`` (4, 4) revolute, ``A`` (4,), ``plane`` (4,).
    """
    first, second = G @ A, G @ (G @ A)
    p_s, p_c = float(plane @ first), float(plane @ second)
    p_0 = float(plane @ A) + p_c
    amplitude = float(np.hypot(p_s, p_c))
    scale = float(np.linalg.norm(plane) * np.linalg.norm(A)) * max(1.0, float(np.linalg.norm(G)) ** 2)
    if amplitude <= FREE * scale:
        held = abs(p_0) <= FREE * scale
        return Crossing(np.array([seed]), 0.0 if held else np.inf, held)
    middle = -np.arctan2(p_s, p_c)
    room = (amplitude - p_0) * (amplitude + p_0)
    if room <= 0.0:
        nearest = middle if p_0 > 0.0 else middle + np.pi
        return Crossing(np.array([nearest]), abs(p_0) / amplitude - 1.0, False)
    half = np.arctan2(np.sqrt(room), p_0)
    return Crossing(np.array([middle + half, middle - half]), 0.0, False)


def turn_between(G: FloatArray, A: FloatArray, target: FloatArray, seed: float = 0.0) -> Branches:
    """The angle [rad] about a revolute operator ``G`` (4, 4) that takes points ``A`` (..., 4) nearest to ``target``.

    Points and targets of equal heights. The radial part of the target, ``-Ĥ²A*``, is resolved along those of the point
    and of its motion, ``-Ĥ²A`` and ``ĤA``: the plane of (6.11) through axis and target in one linear step, with
    neither the trivial second root nor a choice of plane. ``excess``: how far the radii differ. Free where all of
    ``A`` lies on the axis.
    """
    points, goals = np.reshape(A, (-1, 4)), np.reshape(target, (-1, 4))
    square = G @ G
    radial, along, wanted = -points @ square.T, points @ G.T, -goals @ square.T
    size = float(np.linalg.norm(radial))
    if size <= FREE * float(np.linalg.norm(square) * np.linalg.norm(points)):
        return single(seed, free=True)
    basis = np.stack([radial.ravel(), along.ravel()])
    cosine, sine = np.linalg.solve(basis @ basis.T, basis @ wanted.ravel())
    return single(float(np.arctan2(sine, cosine)), abs(float(np.hypot(cosine, sine)) - 1.0))


def plane_across(G: FloatArray, A: FloatArray) -> FloatArray:
    """The plane (4,) across the axis of ``G`` (4, 4) through ``A`` (4,): of the pencil ``aᵀĤ = 0`` that stays fixed.

    Also where A lies on the axis, and spans no circle with ``ĤA`` and ``Ĥ²A``.
    """
    pencil = np.linalg.svd(G)[0][:, 2:]
    heights = A @ pencil
    return np.asarray(pencil @ np.array([heights[1], -heights[0]]), dtype=np.float64)


def axis_points(G: FloatArray) -> FloatArray:
    """Two orthonormal points (2, 4) on the axis of ``G`` (4, 4), its kernel."""
    return np.asarray(np.linalg.svd(G)[2][2:], dtype=np.float64)


def common_point(operators: FloatArray) -> FloatArray:
    """The point (4,), at unit norm, nearest to all axes of revolute ``operators`` (k, 4, 4), each at unit norm."""
    unit = operators / np.linalg.norm(operators, axis=(1, 2), keepdims=True)
    return np.asarray(np.linalg.svd(unit.reshape(-1, 4))[2][3], dtype=np.float64)
