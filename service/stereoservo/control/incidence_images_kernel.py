"""What an incidence is in the images, in numba: the points that span it, directions of a feature there, distances.

Read `incidence_kernel` first, which says how residuals are measured.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.image_kernel import pixel_gradients
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel

METRIC_FLOOR = 0.01
"""Least metric of a joint, relative to the largest: a joint that moves nothing in the images is not free of charge."""

DROPPED = 1e-9
"""Length [px, relative to the direction's share before it] below which a direction is no further one."""


@kernel
def moving_count(kind: int) -> int:
    """How many points span the moving feature."""
    return 3 if kind == 5 else (2 if kind >= 3 else 1)


@kernel
def fixed_dimension(kind: int) -> int:
    """Dimension of the fixed feature: 0 a point, 1 a line, 2 a plane."""
    return 0 if kind == 0 else (1 if kind == 1 or kind == 3 else 2)


@kernel
def joint_metric(operators: FloatArray, matrices: FloatArray, points: FloatArray) -> FloatArray:
    """`incidence.joint_metric_reference` as a kernel: (n,) [px/rad or px/m]."""
    n, m, cameras = operators.shape[0], points.shape[0], matrices.shape[0]
    metric = np.zeros(n)
    for p in range(m):
        A = pixel_gradients(matrices, points[p])
        for j in range(n):
            for r in range(2 * cameras):
                s = 0.0
                for i in range(4):
                    moved = 0.0
                    for k in range(4):
                        moved += operators[j, i, k] * points[p, k]
                    s += A[r, i] * moved
                metric[j] += s * s
    largest = 0.0
    for j in range(n):
        metric[j] = math.sqrt(metric[j] / (cameras * m))
        largest = max(largest, metric[j])
    for j in range(n):
        if not metric[j] > METRIC_FLOOR * largest:
            metric[j] = METRIC_FLOOR * largest
        if not metric[j] > 0.0:
            metric[j] = 1.0
    return metric


@kernel
def product(A: FloatArray, x: FloatArray, r: int) -> float:
    """Row ``r`` of ``A`` (k, 4) times ``x`` (4,)."""
    return float(A[r, 0] * x[0] + A[r, 1] * x[1] + A[r, 2] * x[2] + A[r, 3] * x[3])


@kernel
def feature_tangents(A: FloatArray, fixed: FloatArray, dimension: int) -> tuple[FloatArray, FloatArray]:
    """Orthonormal ``T`` (2, 2c) and directions ``D`` (2, 4) with ``A D_k = T_k``; zero rows where there are fewer."""
    rows = A.shape[0]
    T = np.zeros((2, rows))
    D = np.zeros((2, 4))
    for k in range(dimension):
        before = 0.0
        for r in range(rows):
            T[k, r] = product(A, fixed[1 + k], r)
            before += T[k, r] * T[k, r]
        for i in range(4):
            D[k, i] = fixed[1 + k, i]
        for _ in range(2):  # twice: orthogonal to rounding
            for j in range(k):
                s = 0.0
                for r in range(rows):
                    s += T[j, r] * T[k, r]
                for r in range(rows):
                    T[k, r] -= s * T[j, r]
                for i in range(4):
                    D[k, i] -= s * D[j, i]
        after = 0.0
        for r in range(rows):
            after += T[k, r] * T[k, r]
        size = math.sqrt(after) if after > DROPPED * DROPPED * before else 0.0
        for r in range(rows):
            T[k, r] = T[k, r] / size if size > 0.0 else 0.0
        for i in range(4):
            D[k, i] = D[k, i] / size if size > 0.0 else 0.0
    return T, D


@kernel
def project_out(T: FloatArray, x: FloatArray) -> None:
    """Remove from ``x`` (2c,) what the orthonormal rows of ``T`` (2, 2c) take up."""
    for k in range(2):
        s = 0.0
        for r in range(x.shape[0]):
            s += T[k, r] * x[r]
        for r in range(x.shape[0]):
            x[r] -= s * T[k, r]


@kernel
def image_distance(
    matrices: FloatArray, A: FloatArray, T: FloatArray, D: FloatArray, X: FloatArray, base: FloatArray
) -> float:
    """Largest distance [px] over the cameras between the images of ``X`` (4,) and of its nearest point of the feature.

    To first order where that point does not lie before a camera as X does.
    """
    rows = A.shape[0]
    Y = base.copy()
    first = np.empty(rows)
    for r in range(rows):
        first[r] = product(A, X, r) - product(A, base, r)
    for k in range(2):
        s = 0.0
        for r in range(rows):
            s += T[k, r] * first[r]
        for i in range(4):
            Y[i] += s * D[k, i]
    project_out(T, first)
    worst = 0.0
    for c in range(rows // 2):
        P = matrices[c]
        here = product(P, X, 2)
        there = product(P, Y, 2)
        if here * there > 0.0:
            du = product(P, X, 0) / here - product(P, Y, 0) / there
            dv = product(P, X, 1) / here - product(P, Y, 1) / there
        else:
            du, dv = first[2 * c], first[2 * c + 1]
        size = math.sqrt(du * du + dv * dv)
        if not size <= worst:
            worst = size
    return worst
