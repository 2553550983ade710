"""Damped least squares and null directions: the readable reference of `kinematics.linear_kernels`."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.linear_kernels import PIVOT_TOLERANCE


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


def null_direction_reference(A: FloatArray) -> tuple[FloatArray, float, float, float]:
    """Unit ``x`` (n,) of least ``|A x|``, ``A`` (r, n), and smallest, second-smallest and largest singular
    value.
    """
    n = A.shape[1]
    _, values, rows = np.linalg.svd(A, full_matrices=True)
    padded = np.zeros(n)
    padded[: values.size] = values
    return rows[n - 1].copy(), float(padded[n - 1]), float(padded[max(n - 2, 0)]), float(padded[0])
