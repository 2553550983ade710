"""The loop's lens in numba: `geometry.distortion` for the few pixels of a frame, with covariances and velocities.

Explicit arithmetic in a fixed order, no BLAS, no fastmath: the same input gives the same bits on one machine.
``lens`` is ``(k, cu, cv, r0)`` as there. Pixels that the lens cannot have made, beyond the radius where its image
folds back, are marked unseen and hold NaN.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import BoolArray, kernel

ITERATIONS = 30
"""Newton steps of the inverse at most."""
CONVERGED = 1e-14
"""Step, relative to the radius, at which the inverse ends."""


@kernel
def distort_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Raw pixel of the ideal one ``(u, v)``; NaN beyond the fold. ``k = 0`` leaves it as it is, to the bit."""
    k, r0 = lens[0], lens[3]
    if k == 0.0:
        return u, v
    x, y = (u - lens[1]) / r0, (v - lens[2]) / r0
    bend = k * (x * x + y * y)
    if not 1.0 + 3.0 * bend > 0.0:
        return math.nan, math.nan
    return lens[1] + (u - lens[1]) * (1.0 + bend), lens[2] + (v - lens[2]) * (1.0 + bend)


@kernel
def undistort_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Ideal pixel of the raw one ``(u, v)`` by Newton's method on the radius; NaN where there is none.

    A lens of ``k = 0`` leaves it as it is, to the bit.
    """
    k, r0 = lens[0], lens[3]
    if k == 0.0:
        return u, v
    x, y = (u - lens[1]) / r0, (v - lens[2]) / r0
    raw = math.sqrt(x * x + y * y)
    if not math.isfinite(raw) or (k < 0.0 and not raw < 2.0 / 3.0 * math.sqrt(-1.0 / (3.0 * k))):
        return math.nan, math.nan
    radius = raw
    for _ in range(ITERATIONS):
        bend = k * radius * radius
        step = (radius * (1.0 + bend) - raw) / (1.0 + 3.0 * bend)
        radius -= step
        if abs(step) <= CONVERGED * max(radius, 1.0):
            break
    scale = 1.0 / (1.0 + k * radius * radius)
    return lens[1] + (u - lens[1]) * scale, lens[2] + (v - lens[2]) * scale


@kernel
def distortion_jacobian(lens: FloatArray, u: float, v: float) -> tuple[float, float, float]:
    """``∂raw/∂ideal`` at the ideal pixel ``(u, v)``, a symmetric matrix: its entries uu, uv, vv."""
    k, r0 = lens[0], lens[3]
    x, y = (u - lens[1]) / r0, (v - lens[2]) / r0
    even = 1.0 + k * (x * x + y * y)
    return even + 2.0 * k * x * x, 2.0 * k * x * y, even + 2.0 * k * y * y


@kernel
def _propagate(a: float, b: float, d: float, C: FloatArray, out: FloatArray) -> None:
    """``out = J C Jᵀ`` for the symmetric ``J = (a b; b d)`` and (2, 2) ``C``."""
    uu, uv = a * C[0, 0] + b * C[1, 0], a * C[0, 1] + b * C[1, 1]
    vu, vv = b * C[0, 0] + d * C[1, 0], b * C[0, 1] + d * C[1, 1]
    out[0, 0], out[0, 1] = uu * a + uv * b, uu * b + uv * d
    out[1, 0], out[1, 1] = vu * a + vv * b, vu * b + vv * d


@kernel
def undistort_sights(
    lens: FloatArray, pixels: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Ideal pixels (k, 2) with covariances (k, 2, 2) [px²] of raw ones, and which (k,) the lens can have made."""
    n = pixels.shape[0]
    ideal = np.empty((n, 2))
    spread = np.empty((n, 2, 2))
    seen = np.empty(n, dtype=np.bool_)
    for i in range(n):
        u, v = undistort_pixel(lens, pixels[i, 0], pixels[i, 1])
        ideal[i, 0], ideal[i, 1] = u, v
        a, b, d = distortion_jacobian(lens, u, v)
        determinant = a * d - b * b
        seen[i] = math.isfinite(u) and math.isfinite(v) and determinant > 0.0
        _propagate(d / determinant, -b / determinant, a / determinant, covariances[i], spread[i])
    return ideal, spread, seen


@kernel
def distort_expected(
    lens: FloatArray, pixels: FloatArray, velocities: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Raw pixels (k, 2), velocities (k, 2), covariances (k, 2, 2) of ideal ones, and which (k,) lie within the fold."""
    n = pixels.shape[0]
    raw = np.empty((n, 2))
    speed = np.empty((n, 2))
    spread = np.empty((n, 2, 2))
    seen = np.empty(n, dtype=np.bool_)
    for i in range(n):
        raw[i, 0], raw[i, 1] = distort_pixel(lens, pixels[i, 0], pixels[i, 1])
        a, b, d = distortion_jacobian(lens, pixels[i, 0], pixels[i, 1])
        speed[i, 0] = a * velocities[i, 0] + b * velocities[i, 1]
        speed[i, 1] = b * velocities[i, 0] + d * velocities[i, 1]
        _propagate(a, b, d, covariances[i], spread[i])
        seen[i] = math.isfinite(raw[i, 0]) and math.isfinite(raw[i, 1])
    return raw, speed, spread, seen
