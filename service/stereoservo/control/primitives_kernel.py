"""Numba kernels of the primitive motions of an arm (translation, two kinds of revolution; numpy reference:
`planning.primitives`), and of the algebra of points and planes that they need.

Names, order and thresholds are those of the reference; read that first. No BLAS, no allocation of note.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import (
    left_null_direction,
    null_direction,
    orthonormal_rows,
    right_singular,
)
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
def product(H: FloatArray, x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    """``H (x, y, z, w)ᵀ``."""
    return (
        H[0, 0] * x + H[0, 1] * y + H[0, 2] * z + H[0, 3] * w,
        H[1, 0] * x + H[1, 1] * y + H[1, 2] * z + H[1, 3] * w,
        H[2, 0] * x + H[2, 1] * y + H[2, 2] * z + H[2, 3] * w,
        H[3, 0] * x + H[3, 1] * y + H[3, 2] * z + H[3, 3] * w,
    )


@kernel
def transposed_product(
    H: FloatArray, x: float, y: float, z: float, w: float
) -> tuple[float, float, float, float]:
    """``Hᵀ (x, y, z, w)ᵀ``."""
    return (
        H[0, 0] * x + H[1, 0] * y + H[2, 0] * z + H[3, 0] * w,
        H[0, 1] * x + H[1, 1] * y + H[2, 1] * z + H[3, 1] * w,
        H[0, 2] * x + H[1, 2] * y + H[2, 2] * z + H[3, 2] * w,
        H[0, 3] * x + H[1, 3] * y + H[2, 3] * z + H[3, 3] * w,
    )


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


class Freedoms(NamedTuple):
    """What an arm can make now: orthonormal ``motions`` (r, 4, 4), and the joint screws ``basis`` (n, r) that make
    them.
    """

    motions: FloatArray
    basis: FloatArray


@kernel
def primitive(freedoms: Freedoms, system: FloatArray, screw: FloatArray, H: FloatArray) -> bool:
    """The motion that an (r, 8) ``system`` leaves, a row a freedom: its joint screw (n,) and operator (4, 4); False:
    not reachable.
    """
    motions, basis = freedoms
    n, rank = basis.shape
    if rank == 0:
        return False
    threshold = NOISE_RATIO if rank == RIGID_FREEDOMS else REACH_RATIO
    x = np.empty(rank)
    known = False
    if rank > 1:
        smallest, second, largest = left_null_direction(system.copy(), x)
        known = second > DEGENERATE_RATIO * largest and smallest <= threshold * second
    if not known:  # the bounds do not tell: by the singular values themselves
        x, smallest, second, largest = null_direction(np.ascontiguousarray(system.T))
        if rank == 1:
            second = 1.0
        if second <= DEGENERATE_RATIO * largest or smallest > threshold * second:
            return False
    drop_primitive(screw, H)
    for h in range(rank):
        for j in range(n):
            screw[j] += basis[j, h] * x[h]
        for i in range(4):
            for k in range(4):
                H[i, k] += x[h] * motions[h, i, k]
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
def drop_primitive(screw: FloatArray, H: FloatArray) -> None:
    """No screw (n,), and no operator (4, 4)."""
    for j in range(screw.shape[0]):
        screw[j] = 0.0
    for i in range(4):
        for k in range(4):
            H[i, k] = 0.0


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
def set_point_columns(motions: FloatArray, A: FloatArray, system: FloatArray, column: int) -> None:
    """``Ĥ_k A`` of the motions (r, 4, 4) into columns ``column`` to ``column + 3`` of the system (r, 8)."""
    for k in range(motions.shape[0]):
        H = motions[k]
        for i in range(4):
            system[k, column + i] = H[i, 0] * A[0] + H[i, 1] * A[1] + H[i, 2] * A[2] + H[i, 3] * A[3]


@kernel
def set_plane_columns(motions: FloatArray, a: FloatArray, system: FloatArray, column: int) -> None:
    """``Ĥ_kᵀ a`` of the motions (r, 4, 4) into columns ``column`` to ``column + 3`` of the system (r, 8)."""
    for k in range(motions.shape[0]):
        H = motions[k]
        for i in range(4):
            system[k, column + i] = H[0, i] * a[0] + H[1, i] * a[1] + H[2, i] * a[2] + H[3, i] * a[3]


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
def regular_freedoms(operators: FloatArray, least: float) -> tuple[Freedoms, bool]:
    """The freedoms of an arm of six joints at most, if its stacked operators (n, 4, 4) surely have no singular value
    below ``least`` times the largest; whether they have none.
    """
    n = operators.shape[0]
    found = Freedoms(np.empty((n, 4, 4)), np.empty((n, n)))
    regular = n <= RIGID_FREEDOMS and (
        orthonormal_rows(operators.reshape(n, 16), found.motions.reshape(n, 16), found.basis) > least
    )
    return found, regular


@kernel
def singular_freedoms(operators: FloatArray, V: FloatArray, values: FloatArray) -> Freedoms:
    """`primitives.arm_freedoms`, from `stacked_singular`."""
    n = V.shape[0]
    rank = 0
    while rank < min(n, RIGID_FREEDOMS) and values[rank] > RANK_RATIO * values[0]:
        rank += 1
    basis, motions = np.empty((n, rank)), np.zeros((rank, 4, 4))
    for h in range(rank):
        for j in range(n):
            basis[j, h] = V[j, h] / values[h]
            for i in range(4):
                for k in range(4):
                    motions[h, i, k] += basis[j, h] * operators[j, i, k]
    return Freedoms(motions, basis)


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
