"""The kernels of `control.mobility_kernel` in numpy: their readable reference."""

from __future__ import annotations

import numpy as np

from stereoservo.control.mobility_kernel import EQUAL, LOST
from stereoservo.numerics.arrays import BoolArray, FloatArray


def point_jacobian_reference(operators: FloatArray, points: FloatArray, form: FloatArray) -> FloatArray:
    """``form (Ĥ_j M)`` of points (m, 4), over the root of m: (3m, n)."""
    moved = np.einsum("rk,jki,pi->prj", form, operators, points)
    rows: FloatArray = moved.reshape(-1, len(operators)) / np.sqrt(len(points))
    return rows


def drivable_freedoms_reference(rows: FloatArray, unit: FloatArray) -> tuple[int, FloatArray, FloatArray]:
    """Rank, singular values (n,) and right singular vectors as columns (n, n) of ``rows`` times ``unit``."""
    n = len(unit)
    if not np.isfinite(rows).all():
        return 0, np.full(n, np.nan), np.full((n, n), np.nan)
    _, singular, vectors = np.linalg.svd(rows * unit)
    values = np.zeros(n)
    values[: len(singular)] = singular
    return int((values > LOST * values[0]).sum()), values, vectors.T


def joints_to_block_reference(rows: FloatArray, unit: FloatArray, capacity: int, least: float) -> BoolArray:
    """One joint after the other, that with the largest part in the weak motions of those that are left."""
    n = len(unit)
    free = list(range(n))
    while True:
        _, singular, vectors = np.linalg.svd((rows * unit)[:, free])
        strong = int((singular > least * singular[0]).sum())
        if strong == 0 or len(free) - strong <= max(n - capacity, 0):
            break
        parts = (vectors[strong:] ** 2).sum(axis=0)
        free.pop(int(np.flatnonzero(parts >= parts.max() - EQUAL)[0]))
    blocked = np.ones(n, dtype=np.bool_)
    blocked[free] = False
    return blocked


def self_motion_reference(
    rows: FloatArray, positions: FloatArray, lower: FloatArray, upper: FloatArray, rate: float
) -> FloatArray:
    """The cubic pull to the middle of each joint's range, on the motions that leave the body where it is."""
    limited = np.isfinite(upper - lower) & (upper > lower)
    half = np.where(limited, 0.5 * (upper - lower), 1.0)
    x = np.clip(np.where(limited, (positions - lower) / half - 1.0, 0.0), -1.0, 1.0)
    _, values, V = drivable_freedoms_reference(rows, half)
    if not np.isfinite(values).all():
        return np.zeros(len(positions))
    relative = values / (LOST * values[0]) if values[0] > 0.0 else np.zeros(len(values))
    fade = np.maximum(0.0, 1.0 - relative**2)
    motion = V @ (fade * (V.T @ -(x**3)))
    velocity: FloatArray = rate * half * motion / max(1.0, float(np.abs(motion).max()))
    return velocity
