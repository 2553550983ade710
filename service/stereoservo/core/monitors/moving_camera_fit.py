"""Robust fit of the rigid displacement of one camera to one of its frames, with outliers rejected; and a test whether
the innovations are those of a frame with a wrong time stamp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from stereoservo.calibration.change.change_detection_kernel import (
    ROUNDS,
    Displaced,
    DisplacementGroup,
    SightedPoints,
    fit_displacement,
)
from stereoservo.calibration.change.hypothesis_test import chi2_quantile
from stereoservo.core.monitor_state import LATE_S
from stereoservo.kinematics.kernels import project_points
from stereoservo.numerics.arrays import BoolArray, FloatArray

FREEDOMS = 6
FEWEST = 4
"""Known points that a frame must show."""
LEFT_OUT = 2
"""Sights of a frame that may be wrong."""
UNEXPLAINED_CHANCE = 1e-6


@lru_cache(maxsize=256)
def _unexplained(freedoms: int) -> float:
    """Chi-square from which a frame is not explained."""
    return chi2_quantile(UNEXPLAINED_CHANCE, freedoms)


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A displacement ``D`` (4, 4) of a camera, its ``twist`` (6,), and what it explains: ``weights`` (k,) [1/px] of
    the sights that agree, chi-square ``before`` it and with it.
    """

    D: FloatArray
    twist: FloatArray
    weights: FloatArray
    before: float
    chi2: float


def adjust(
    P: FloatArray, points: FloatArray, observed: FloatArray, weights: FloatArray, basis: FloatArray, gate: float
) -> Adjusted | None:  # fmt: skip
    """The displacement of camera ``P`` (3, 4) that explains what it sees; None where none does.

    One sight after the other, the worst first, may be left out where it is beyond the gate.
    """
    weights = weights.copy()
    matrices, targets = P[None].copy(), observed[None].copy()
    D, twist = np.empty((4, 4)), np.empty(FREEDOMS)
    side = _side(P, points, weights)
    for _ in range(LEFT_OUT + 1):
        count = int((weights > 0.0).sum())
        if count < FEWEST:
            return None
        seen = SightedPoints(matrices, points, targets, weights[None])
        chi2, _ = fit_displacement(
            seen, 0, DisplacementGroup(basis, 0, FREEDOMS), len(points), ROUNDS, Displaced(D, twist)
        )
        moved = moved_matrix(P, D)
        if not math.isfinite(chi2) or _side(moved, points, weights) != side:
            return None
        squares = weights**2 * ((observed - pixels_of(moved, points)) ** 2).sum(axis=-1)
        worst = int(squares.argmax())
        if squares[worst] <= gate and chi2 <= _unexplained(2 * count - FREEDOMS):
            before = weights**2 * ((observed - pixels_of(P, points)) ** 2).sum(axis=-1)
            return Adjusted(D.copy(), twist.copy(), weights, float(before.sum()), float(chi2))
        weights[worst] = 0.0
    return None


def late_alone(innovation: FloatArray, velocity: FloatArray, weights: FloatArray) -> bool:
    """Whether innovations (k, 2) of markers with ``velocity`` (k, 2) [px/s] are those of a frame that was taken a
    little earlier or later than stated.
    """
    square = float((weights[:, None] ** 2 * velocity**2).sum())
    if square <= 0.0:
        return False
    late_s = float((weights[:, None] ** 2 * velocity * innovation).sum()) / square
    rest = weights[:, None] * (innovation - late_s * velocity)
    freedoms = 2 * int((weights > 0.0).sum()) - 1
    return abs(late_s) <= LATE_S and float((rest**2).sum()) <= _unexplained(freedoms)


def moved_matrix(P: FloatArray, way: FloatArray) -> FloatArray:
    """``P way`` (3, 4), without BLAS."""
    product: FloatArray = (P[:, :, None] * way[None]).sum(axis=1)
    return product


def angle(displacement: FloatArray) -> float:
    """Angle [rad] of a displacement (4, 4) in any frame, by its trace 2 + 2 cos."""
    trace = float(np.trace(displacement))
    return math.acos(min(max(0.5 * trace - 1.0, -1.0), 1.0))


def pixels_of(P: FloatArray, points: FloatArray) -> FloatArray:
    """Ideal pixels (k, 2) of points (k, 4)."""
    pixels: FloatArray = project_points(P[None].copy(), points)[0][0]
    return pixels


def _side(P: FloatArray, points: FloatArray, weights: FloatArray) -> float:
    """Sign of the depths of what is seen: +1, -1, or between where they differ."""
    depths = project_points(P[None].copy(), points)[1][0]
    seen = weights > 0.0
    return float(np.sign(depths[seen]).sum()) / max(float(seen.sum()), 1.0)


def apart(P: FloatArray, Q: FloatArray, points: FloatArray, used: BoolArray) -> float:
    """Rms distance [px] between the images of the points ``used`` in two cameras."""
    squares = ((pixels_of(P, points) - pixels_of(Q, points)) ** 2).sum(axis=-1)
    return math.sqrt(float(squares[used].sum()) / max(float(used.sum()), 1.0))
