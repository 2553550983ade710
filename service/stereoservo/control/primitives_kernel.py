"""Numba kernels of the primitive motions of an arm (translation, two kinds of revolution; numpy reference:
`planning.primitives`), and of the algebra of points and planes that they need.

Names, order and thresholds are those of the reference; read that first. No BLAS, no allocation of note.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import null_direction, right_singular
from stereoservo.planning.primitives import (
    DEGENERATE_RATIO,
    NOISE_RATIO,
    RANK_RATIO,
    REACH_RATIO,
    RIGID_FREEDOMS,
)

OUT = 0.1
"""Of the way from a face to a camera: about the size of the face, so that lengths along and across it are alike."""
SPANS_NO_SPACE = 1e-26
"""Share of a coordinate's square that others do not explain, below which points span no space."""


@kernel
def dot(x: FloatArray, y: FloatArray) -> float:
    """Of two 4-vectors."""
    total: float = x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]
    return total


@kernel
def norm(x: FloatArray) -> float:
    """Of a 4-vector."""
    return math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])


@kernel
def unit(x: FloatArray) -> FloatArray:
    """A 4-vector over its norm."""
    length = norm(x)
    y = np.empty(4)
    for i in range(4):
        y[i] = x[i] / length
    return y


@kernel
def apply(H: FloatArray, x: FloatArray) -> FloatArray:
    """``H x`` (4,)."""
    y = np.empty(4)
    for i in range(4):
        y[i] = H[i, 0] * x[0] + H[i, 1] * x[1] + H[i, 2] * x[2] + H[i, 3] * x[3]
    return y


@kernel
def apply_transposed(H: FloatArray, x: FloatArray) -> FloatArray:
    """``Hᵀ x`` (4,)."""
    y = np.empty(4)
    for i in range(4):
        y[i] = H[0, i] * x[0] + H[1, i] * x[1] + H[2, i] * x[2] + H[3, i] * x[3]
    return y


@kernel
def minors(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    """``aᵀX = det[p q r X]``: plane of three points, or point of three planes."""
    xy, xz, xw = p[0] * q[1] - p[1] * q[0], p[0] * q[2] - p[2] * q[0], p[0] * q[3] - p[3] * q[0]
    yz, yw, zw = p[1] * q[2] - p[2] * q[1], p[1] * q[3] - p[3] * q[1], p[2] * q[3] - p[3] * q[2]
    a = np.empty(4)
    a[0] = -(r[1] * zw - r[2] * yw + r[3] * yz)
    a[1] = r[0] * zw - r[2] * xw + r[3] * xz
    a[2] = -(r[0] * yw - r[1] * xw + r[3] * xy)
    a[3] = r[0] * yz - r[1] * xz + r[2] * xy
    return a


@kernel
def complement(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal pair, orthogonal to two unit vectors that are not one."""
    u = np.empty(4)
    along = dot(x, y)
    for i in range(4):
        u[i] = y[i] - along * x[i]
    u = unit(u)
    first = np.zeros(4)
    longest = -1.0
    for axis in range(4):
        share = 1.0 - x[axis] * x[axis] - u[axis] * u[axis]
        if share > longest:
            longest = share
            for i in range(4):
                first[i] = -x[axis] * x[i] - u[axis] * u[i]
            first[axis] += 1.0
    first = unit(first)
    return first, unit(minors(x, u, first))


@kernel
def primitive(
    operators: FloatArray, basis: FloatArray, system: FloatArray, screw: FloatArray, H: FloatArray
) -> bool:
    """Kernel of an (8, n) system in the arm's freedoms (n, r): joint screw and operator; False: not
    reachable.
    """
    n, rank = basis.shape
    if rank == 0:
        return False
    reduced = np.zeros((8, rank))
    for i in range(8):
        for k in range(rank):
            s = 0.0
            for j in range(n):
                s += system[i, j] * basis[j, k]
            reduced[i, k] = s
    x, smallest, second, largest = null_direction(reduced)
    if rank == 1:
        second = 1.0
    threshold = NOISE_RATIO if rank == RIGID_FREEDOMS else REACH_RATIO
    if second <= DEGENERATE_RATIO * largest or smallest > threshold * second:
        return False
    for i in range(4):
        for k in range(4):
            H[i, k] = 0.0
    for j in range(n):
        s = 0.0
        for k in range(rank):
            s += basis[j, k] * x[k]
        screw[j] = s
        for i in range(4):
            for k in range(4):
                H[i, k] += s * operators[j, i, k]
    return True


@kernel
def scale_primitive(screw: FloatArray, H: FloatArray, factor: float) -> None:
    """A screw (n,) and its operator (4, 4) times a factor."""
    for j in range(screw.shape[0]):
        screw[j] *= factor
    for i in range(4):
        for k in range(4):
            H[i, k] *= factor


@kernel
def as_rotation(screw: FloatArray, H: FloatArray) -> bool:
    """Scale to eigenvalues ±i; False: no rotation."""
    trace, size = 0.0, 0.0
    for i in range(4):
        for k in range(4):
            trace += H[i, k] * H[k, i]
            size += H[i, k] * H[i, k]
    square = -0.5 * trace
    if not square > DEGENERATE_RATIO * size:
        return False
    scale_primitive(screw, H, 1.0 / math.sqrt(square))
    return True


@kernel
def set_point_rows(operators: FloatArray, A: FloatArray, system: FloatArray, row: int) -> None:
    """``Ĥ_j A`` into rows ``row`` to ``row + 3``."""
    for j in range(operators.shape[0]):
        velocity = apply(operators[j], A)
        for i in range(4):
            system[row + i, j] = velocity[i]


@kernel
def set_plane_rows(operators: FloatArray, a: FloatArray, system: FloatArray, row: int) -> None:
    """``Ĥ_jᵀ a`` into rows ``row`` to ``row + 3``."""
    for j in range(operators.shape[0]):
        velocity = apply_transposed(operators[j], a)
        for i in range(4):
            system[row + i, j] = velocity[i]


@kernel
def stacked_singular(operators: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right singular vectors (n, n) and values (n,), descending, of the operators stacked as columns (16, n)."""
    n = operators.shape[0]
    stacked = np.empty((16, n))
    for j in range(n):
        for i in range(4):
            for k in range(4):
                stacked[4 * i + k, j] = operators[j, i, k]
    V, values = right_singular(stacked)
    return V, values


@kernel
def freedoms_of(V: FloatArray, values: FloatArray) -> FloatArray:
    """`primitives.arm_freedoms`: the basis (n, r), from `stacked_singular`."""
    n = V.shape[0]
    rank = 0
    while rank < min(n, RIGID_FREEDOMS) and values[rank] > RANK_RATIO * values[0]:
        rank += 1
    basis = np.empty((n, rank))
    for j in range(n):
        for k in range(rank):
            basis[j, k] = V[j, k] / values[k]
    return basis


@kernel
def normal_frame(points: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change of frame (4, 4), and its inverse, in which ``points`` (k, 4) and places a little way from their middle to
    each of ``centres`` (c, 4), all of one height, have the identity as their second moment; the identity where they
    span no space.

    Coordinates there are the same up to a rotation of 4-vectors, whatever projective frame the arguments come from: so
    are norms, angles and singular values of what is conjugated with it. By Gram and Schmidt from the points' rows.
    """
    k, c = points.shape[0], centres.shape[0]
    rows = np.empty((k + c, 4))
    for p in range(k + c):
        for i in range(4):
            rows[p, i] = points[p % k, i] / math.sqrt(k)
    for p in range(c):
        for i in range(4):
            middle = 0.0
            for h in range(k):
                middle += points[h, i] / k
            rows[k + p, i] = (middle + OUT * (centres[p, i] - middle)) / math.sqrt(c)
    R = np.zeros((4, 4))
    good = True
    for i in range(4):
        before = 0.0
        for p in range(k + c):
            before += rows[p, i] ** 2
        for _ in range(2):  # once more: what is left of a column may be small
            for h in range(i):
                along = 0.0
                for p in range(k + c):
                    along += rows[p, h] * rows[p, i]
                R[h, i] += along
                for p in range(k + c):
                    rows[p, i] -= along * rows[p, h]
        square = 0.0
        for p in range(k + c):
            square += rows[p, i] ** 2
        good = good and square > SPANS_NO_SPACE * before and math.isfinite(square)
        if not good:
            break
        R[i, i] = math.sqrt(square)
        for p in range(k + c):
            rows[p, i] /= R[i, i]
    change, inverse = np.zeros((4, 4)), np.zeros((4, 4))
    for i in range(4):
        if not good:
            change[i, i] = inverse[i, i] = 1.0
            continue
        for h in range(4):
            inverse[i, h] = R[h, i]
    if good:  # the inverse of the lower triangle, column by column
        for h in range(4):
            for i in range(h, 4):
                total = 1.0 if i == h else 0.0
                for m in range(h, i):
                    total -= inverse[i, m] * change[m, h]
                change[i, h] = total / inverse[i, i]
    return change, inverse
