"""Numpy reference of the stereo law (8.36), the baseline of the kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.linear import PIVOT_TOLERANCE

DAMPING = 1e-6
"""Default damping, relative to the largest diagonal of the normal matrix."""


class StereoStep(NamedTuple):
    """Result of a step: joint velocity (n,) [rad/s or m/s], largest pixel error over seen markers [px],
    conditioning (0: singular).
    """

    velocity: FloatArray
    error_px: float
    conditioning: float


def stereo_law(
    jacobian: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    weights: FloatArray,
    gain: float,
    damping: float = DAMPING,
) -> StereoStep:
    """``q̇ = −gain·J⁺(s − s*)`` over all cameras stacked (8.36).

    ``jacobian`` (c, m, 2, n) [px/rad or px/m], ``pixels`` and ``set_points`` (c, m, 2) [px], ``weights`` (c,
    m) = 1/sigma [1/px], 0 for a missing marker (its rows are then not read and may be NaN).
    ``gain`` [1/s].
    """
    n = jacobian.shape[-1]
    error = np.where(weights[..., None] != 0.0, pixels - set_points, 0.0)
    step, conditioning = damped_least_squares_reference(
        jacobian.reshape(-1, n), error.reshape(-1), np.repeat(weights.reshape(-1), 2), damping
    )
    worst = float(np.sqrt((error**2).sum(axis=-1)).max(initial=0.0))
    return StereoStep(-gain * step, worst, conditioning)


def damped_least_squares_reference(
    J: FloatArray, e: FloatArray, weights: FloatArray, damping: float
) -> tuple[FloatArray, float]:
    """``x`` (n,) of least ``Σ w²(Jx − e)² + damping·d·|x|²``, ``d`` the largest diagonal of ``JᵀW²J``.

    ``J`` (r, n), ``e`` (r,), ``weights`` (r,) = 1/sigma, 0 where missing. ``damping`` >= 0, relative. Returns
    ``x`` and the conditioning: smallest Cholesky pivot of the damped normal matrix over its largest diagonal;
    0, with ``x = 0``, where that is singular.
    """
    n = J.shape[1]
    seen = weights != 0.0
    JW = J[seen] * weights[seen, None]
    N = JW.T @ JW
    N += damping * np.diag(N).max(initial=0.0) * np.eye(n)
    largest = float(np.diag(N).max(initial=0.0))
    if not (largest > 0.0 and np.isfinite(N).all()):
        return np.zeros(n), 0.0
    try:
        factor = np.linalg.cholesky(N)
    except np.linalg.LinAlgError:  # not positive definite: the answer of a singular system, as documented
        return np.zeros(n), 0.0
    conditioning = float((np.diag(factor) ** 2).min() / largest)
    if conditioning <= PIVOT_TOLERANCE:
        return np.zeros(n), 0.0
    x: FloatArray = np.linalg.solve(N, JW.T @ (e[seen] * weights[seen]))
    return x, conditioning
