"""What the loop calls: the laws and their solvers in numba, tested against `damped`, `stereo` and
`cartesian3`.

No BLAS, LAPACK or fastmath: the same input gives the same bits on one machine. Arrays are float64. The safety
stage has its arithmetic in `safety_kernel`.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.cartesian_kernel import cartesian3_step, cartesian_step
from stereoservo.control.linear_kernels import (
    cholesky_solve,
    damped_least_squares,
    null_direction,
    right_singular,
)
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel

__all__ = [
    "cartesian3_step",
    "cartesian_step",
    "damped_least_squares",
    "null_direction",
    "right_singular",
    "stereo_step",
]


@kernel
def stereo_step(
    jacobian: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    weights: FloatArray,
    gain: float,
    damping: float,
) -> tuple[FloatArray, float, float]:
    """`stereo.stereo_law` as a kernel: joint velocity (n,), largest pixel error [px], conditioning."""
    cameras, points, _, n = jacobian.shape
    N = np.zeros((n, n))
    b = np.zeros(n)
    x = np.zeros(n)
    worst = 0.0
    for c in range(cameras):
        for p in range(points):
            w = weights[c, p]
            if w == 0.0:
                continue
            w2 = w * w
            du = pixels[c, p, 0] - set_points[c, p, 0]
            dv = pixels[c, p, 1] - set_points[c, p, 1]
            worst = max(worst, math.sqrt(du * du + dv * dv))
            for i in range(n):
                wu = w2 * jacobian[c, p, 0, i]
                wv = w2 * jacobian[c, p, 1, i]
                b[i] += wu * du + wv * dv
                for k in range(i + 1):
                    N[i, k] += wu * jacobian[c, p, 0, k] + wv * jacobian[c, p, 1, k]
    largest = 0.0
    for i in range(n):
        largest = max(largest, N[i, i])
    for i in range(n):
        N[i, i] += damping * largest
    conditioning = cholesky_solve(N, b, x)
    for i in range(n):
        x[i] *= -gain
    return x, worst, conditioning
