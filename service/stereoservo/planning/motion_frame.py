"""Frame in which the motions of an uncalibrated arm are Euclidean, computed from its joint operators and the plane at
infinity; and the pose at each parameter of a path in it.

The operators preserve the plane at infinity and, in it, one quadratic form: ``SᵀQ + QS = 0`` for their action ``S`` on
displacements (5.59). The square root of the form defines the frame. Its unit of length is chosen: the cameras are at
distance one from the centre. For an arm that rotates about one direction only, or not at all, the form is not unique;
any solution may be used, because the arm cannot make motions that distinguish them.

A path of a body is a hinge rotation, a planar one and a translation of its centre, each with a profile ``μ(σ)``,
monotone from 0 to 1 on [0, 1] (7.26, 7.4.3). Linear: constant rate. Exponential: as a feedback loop converges,
``(1 − e^{−kσ})/(1 − e^{−k})``, scaled to end at 1 (errata). First and last: the component moves in the first or in the
last seven tenths; in the middle the two overlap, which limits accelerations. Kernels, for the loop.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.kinematics.kernels import invert4, multiply4_into, symmetric_eigen4
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import cholesky_solve

OPERATOR_WEIGHT = 1e-3
"""Weight of the operators relative to the heights in the estimate of the plane at infinity: heights are exact by
convention, operators are measured.
"""
PRISMATIC = 1e-12
"""Squared rotation rate, relative to the operator block's squared norm, below which a joint counts as prismatic."""
AVERAGED = 5
"""Number of angles over which a form is averaged: it is of second degree in sine and cosine, so five are exact."""
INVERSE_ITERATIONS = 3
SHIFT = 1e-10
"""Relative shift of the inverse iteration."""

LINEAR, FIRST, LAST, EXPONENTIAL = 0.0, 1.0, 2.0, 3.0
"""Profile shapes of one component."""

DECAY = 4.0
"""Duration of an exponential motion in time constants: the remainder at its end, removed by linear scaling, is 2 %."""
HANDS_OVER, ENDS = 0.3, 0.7
"""Path parameters at which a component that moves first begins to slow down, and ends."""
NUMBERS = 17
"""Numbers of a path: hinge (4), planar rotation (4), translation (3), bend (3), profiles of the three (3)."""


@kernel
def plane_at_infinity(operators: FloatArray, points: FloatArray) -> FloatArray:
    """``a∞`` (4,) with ``a∞ᵀM = 1`` for ``points`` (k, 4) and ``a∞ᵀĤ_j = 0``; zeros if neither determines it."""
    N = np.zeros((4, 4))
    b = np.zeros(4)
    for p in range(points.shape[0]):
        for i in range(4):
            b[i] += points[p, i]
            for k in range(4):
                N[i, k] += points[p, i] * points[p, k]
    for j in range(operators.shape[0]):
        G = operators[j]
        size = 0.0
        for i in range(4):
            for k in range(4):
                size += G[i, k] * G[i, k]
        if not size > 0.0:
            continue
        weight = OPERATOR_WEIGHT * OPERATOR_WEIGHT / size
        for i in range(4):
            for k in range(4):
                for r in range(4):
                    N[i, k] += weight * G[i, r] * G[k, r]
    plane = np.zeros(4)
    cholesky_solve(N, b, plane)
    return plane


@kernel
def conjugated(A: FloatArray, G: FloatArray, B: FloatArray) -> FloatArray:
    """``A G B`` of (4, 4)."""
    first = np.empty((4, 4))
    out = np.empty((4, 4))
    multiply4_into(A, G, first)
    multiply4_into(first, B, out)
    return out


@kernel
def conjugate_all(A: FloatArray, G: FloatArray, B: FloatArray) -> FloatArray:
    """``A G_j B`` (k, 4, 4) of ``G`` (k, 4, 4)."""
    out = np.empty(G.shape)
    for j in range(G.shape[0]):
        out[j] = conjugated(A, G[j], B)
    return out


@kernel
def average_over_rotations(form: FloatArray, generator: FloatArray) -> None:
    """Average a quadratic ``form`` (k, k), in place, over the rotations by a ``generator`` (k, k) of eigenvalues 0,
    ±i.
    """
    size = form.shape[0]
    square, rotated = np.zeros((size, size)), np.empty((size, size))
    product, total = np.empty((size, size)), np.zeros((size, size))
    _multiply_into(generator, generator, square)
    weight = 1.0 / AVERAGED
    for sample in range(AVERAGED):
        angle = 2.0 * math.pi * sample / AVERAGED
        sine, versine = math.sin(angle), 1.0 - math.cos(angle)
        for i in range(size):
            for k in range(size):
                rotated[i, k] = sine * generator[i, k] + versine * square[i, k]
            rotated[i, i] += 1.0
        _multiply_into(form, rotated, product)
        for i in range(size):
            for k in range(size):
                for r in range(size):
                    total[i, k] += weight * rotated[r, i] * product[r, k]
    for i in range(size):
        for k in range(size):
            form[i, k] = total[i, k]


@kernel
def _multiply_into(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    for i in range(A.shape[0]):
        for k in range(B.shape[1]):
            total = 0.0
            for r in range(A.shape[1]):
                total += A[i, r] * B[r, k]
            out[i, k] = total


@kernel
def _averaged_form(blocks: FloatArray) -> FloatArray:
    """A positive form (3, 3), averaged over the rotations of each block (k, 3, 3) of eigenvalues 0, ±i in sequence."""
    Q = np.eye(3)
    for j in range(blocks.shape[0]):
        average_over_rotations(Q, blocks[j])
    return Q


@kernel
def _invariant_form(blocks: FloatArray, start: FloatArray) -> FloatArray:
    """The form (3, 3) of least ``Σ|SᵀQ + QS|²``, by inverse iteration from ``start``."""
    rows = np.array([0, 0, 0, 1, 1, 2])
    columns = np.array([0, 1, 2, 1, 2, 2])
    N = np.zeros((6, 6))
    change = np.zeros((6, 6))
    U = np.zeros((3, 3))
    for j in range(blocks.shape[0]):
        S = blocks[j]
        for nth in range(6):
            for i in range(3):
                for k in range(3):
                    U[i, k] = 0.0
            U[rows[nth], columns[nth]] = 1.0
            U[columns[nth], rows[nth]] = 1.0
            for entry in range(6):
                i, k = rows[entry], columns[entry]
                total = 0.0
                for r in range(3):
                    total += S[r, i] * U[r, k] + U[i, r] * S[r, k]
                change[entry, nth] = total
        for i in range(6):
            for k in range(6):
                for r in range(6):
                    N[i, k] += change[r, i] * change[r, k]
    trace = 0.0
    for i in range(6):
        trace += N[i, i]
    q = np.empty(6)
    for nth in range(6):
        q[nth] = start[rows[nth], columns[nth]]
    x = np.empty(6)
    for _ in range(INVERSE_ITERATIONS):
        shifted = N.copy()
        for i in range(6):
            shifted[i, i] += SHIFT * trace
        if cholesky_solve(shifted, q, x) == 0.0:
            break
        size = math.sqrt(x[0] * x[0] + x[3] * x[3] + x[5] * x[5] + 2.0 * (x[1] * x[1] + x[2] * x[2] + x[4] * x[4]))
        for i in range(6):
            q[i] = x[i] / size
    Q = np.empty((3, 3))
    for nth in range(6):
        Q[rows[nth], columns[nth]] = q[nth]
        Q[columns[nth], rows[nth]] = q[nth]
    return Q


@kernel
def _root(Q: FloatArray, L: FloatArray) -> bool:
    """Cholesky factor ``Q = L Lᵀ`` (3, 3), written into ``L``; False if ``Q`` is not positive definite."""
    for j in range(3):
        for i in range(j, 3):
            s = Q[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[j, j] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    return True


@kernel
def motion_frame(
    operators: FloatArray, plane: FloatArray, centre: FloatArray, camera_centres: FloatArray
) -> FloatArray:
    """The motion frame ``W`` (4, 4): ``W (x, y, z, 1)`` is a point of height 1, ``W (0, 0, 0, 1)`` the ``centre`` (4,).

    In its coordinates the ``operators`` (n, 4, 4) are Euclidean twists, and the mean distance of ``camera_centres``
    (c, 4) from the centre is 1. All NaN if ``plane`` (4,) is not a plane.
    """
    pivot = 0
    for i in range(1, 4):
        if abs(plane[i]) > abs(plane[pivot]):
            pivot = i
    W = np.zeros((4, 4))
    column = 0
    for i in range(4):
        if i == pivot:
            continue
        W[i, column] = 1.0
        W[pivot, column] = -plane[i] / plane[pivot]
        column += 1
    for i in range(4):
        W[i, 3] = centre[i]
    inverse = invert4(W)
    blocks = np.empty((operators.shape[0], 3, 3))
    revolute = 0
    for j in range(operators.shape[0]):
        S = conjugated(inverse, operators[j], W)
        square, size = 0.0, 0.0
        for i in range(3):
            for k in range(3):
                square -= 0.5 * S[i, k] * S[k, i]
                size += S[i, k] * S[i, k]
        whole = size + S[0, 3] * S[0, 3] + S[1, 3] * S[1, 3] + S[2, 3] * S[2, 3]
        if not square > PRISMATIC * whole:
            continue
        angle = math.sqrt(square)
        for i in range(3):
            for k in range(3):
                blocks[revolute, i, k] = S[i, k] / angle
        revolute += 1
    blocks = blocks[:revolute]
    averaged = _averaged_form(blocks)
    L = np.zeros((3, 3))
    if revolute == 0 or not _root(_invariant_form(blocks, averaged), L):
        _root(averaged, L)
    # the columns of the displacements, times the inverse of Lᵀ
    D = np.empty((4, 3))
    for r in range(4):
        for k in range(3):
            s = W[r, k]
            for i in range(k):
                s -= D[r, i] * L[k, i]
            D[r, k] = s / L[k, k]
    for r in range(4):
        for k in range(3):
            W[r, k] = D[r, k]
    inverse = invert4(W)
    if camera_centres.shape[0] == 0:
        return W
    distance = 0.0
    for c in range(camera_centres.shape[0]):
        square = 0.0
        for i in range(3):
            x = 0.0
            for k in range(4):
                x += inverse[i, k] * camera_centres[c, k]
            square += x * x
        distance += math.sqrt(square) / camera_centres.shape[0]
    for r in range(4):
        for k in range(3):
            W[r, k] *= distance
    return W


@kernel
def axis_rotation(axis: FloatArray, angle: float) -> FloatArray:
    """Rotation (3, 3) by ``angle`` [rad] about the unit vector ``axis`` (3,)."""
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    versine = 2.0 * half * half
    x, y, z = axis[0], axis[1], axis[2]
    R = np.empty((3, 3))
    R[0, 0] = 1.0 - versine * (y * y + z * z)
    R[1, 1] = 1.0 - versine * (x * x + z * z)
    R[2, 2] = 1.0 - versine * (x * x + y * y)
    R[0, 1], R[1, 0] = versine * x * y - sine * z, versine * x * y + sine * z
    R[0, 2], R[2, 0] = versine * x * z + sine * y, versine * x * z - sine * y
    R[1, 2], R[2, 1] = versine * y * z - sine * x, versine * y * z + sine * x
    return R


@kernel
def rotation_between(X: FloatArray, Y: FloatArray) -> FloatArray:
    """Axis and angle (4,) of the least-squares rotation from centred points ``X`` (m, 3) to ``Y`` (m, 3) (Horn).

    Angle in [0, π] [rad]; at 0 the axis is the third of the frame. At π its sign is arbitrary.
    """
    m = X.shape[0]
    mean_x, mean_y = np.zeros(3), np.zeros(3)
    for p in range(m):
        for i in range(3):
            mean_x[i] += X[p, i] / m
            mean_y[i] += Y[p, i] / m
    S = np.zeros((3, 3))
    for p in range(m):
        for i in range(3):
            for k in range(3):
                S[i, k] += (X[p, i] - mean_x[i]) * (Y[p, k] - mean_y[k])
    N = np.empty((4, 4))
    N[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
    N[0, 1] = S[1, 2] - S[2, 1]
    N[0, 2] = S[2, 0] - S[0, 2]
    N[0, 3] = S[0, 1] - S[1, 0]
    N[1, 1] = S[0, 0] - S[1, 1] - S[2, 2]
    N[2, 2] = -S[0, 0] + S[1, 1] - S[2, 2]
    N[3, 3] = -S[0, 0] - S[1, 1] + S[2, 2]
    N[1, 2] = S[0, 1] + S[1, 0]
    N[1, 3] = S[2, 0] + S[0, 2]
    N[2, 3] = S[1, 2] + S[2, 1]
    for i in range(4):
        for k in range(i):
            N[i, k] = N[k, i]
    _, vectors = symmetric_eigen4(N)
    w, x, y, z = vectors[0, 3], vectors[1, 3], vectors[2, 3], vectors[3, 3]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    out = np.zeros(4)
    out[2] = 1.0
    if sine > 0.0:
        out[0], out[1], out[2] = x / sine, y / sine, z / sine
    out[3] = 2.0 * math.atan2(sine, w)
    return out


@kernel
def _first(sigma: float) -> float:
    rate = 2.0 / (HANDS_OVER + ENDS)
    if sigma <= HANDS_OVER:
        return rate * sigma
    if sigma >= ENDS:
        return 1.0
    x = (sigma - HANDS_OVER) / (ENDS - HANDS_OVER)
    return rate * (HANDS_OVER + (ENDS - HANDS_OVER) * 0.5 * (x + math.sin(math.pi * x) / math.pi))


@kernel
def progress(shape: float, sigma: float) -> float:
    """Profile ``μ(σ)`` of one component."""
    sigma = min(1.0, max(0.0, sigma))
    if shape == FIRST:
        return _first(sigma)
    if shape == LAST:
        return 1.0 - _first(1.0 - sigma)
    if shape == EXPONENTIAL:
        return math.expm1(-DECAY * sigma) / math.expm1(-DECAY)
    return sigma


@kernel
def pose_on_path(path: FloatArray, path_parameter: float) -> FloatArray:
    """Displacement (4, 4) from the current pose, in the motion frame."""
    R_r = axis_rotation(path[0:3], path[3] * progress(path[15], path_parameter))
    R_p = axis_rotation(path[4:7], path[7] * progress(path[16], path_parameter))
    along, aside = progress(path[14], path_parameter), 4.0 * path_parameter * (1.0 - path_parameter)
    H = np.zeros((4, 4))
    H[3, 3] = 1.0
    for i in range(3):
        H[i, 3] = along * path[8 + i] + aside * path[11 + i]
        for k in range(3):
            H[i, k] = R_r[i, 0] * R_p[0, k] + R_r[i, 1] * R_p[1, k] + R_r[i, 2] * R_p[2, k]
    return H
