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
def freedoms_of(operators: FloatArray) -> FloatArray:
    """`primitives.arm_freedoms`: the basis (n, r)."""
    n = operators.shape[0]
    stacked = np.empty((16, n))
    for j in range(n):
        for i in range(4):
            for k in range(4):
                stacked[4 * i + k, j] = operators[j, i, k]
    V, values = right_singular(stacked)
    rank = 0
    while rank < min(n, RIGID_FREEDOMS) and values[rank] > RANK_RATIO * values[0]:
        rank += 1
    basis = np.empty((n, rank))
    for j in range(n):
        for k in range(rank):
            basis[j, k] = V[j, k] / values[k]
    return basis
