"""Numba kernels for the control loop: forward kinematics, projection, image Jacobian, triangulation, lens distortion.
The same as `chain` and `geometry.cameras`, without BLAS, LAPACK or fastmath.

Explicit loops in a fixed order: the same input gives bitwise the same result on one machine. All arrays are float64 and
C-contiguous; joint kinds are uint8, 0 revolute, 1 prismatic. The ``*_into`` functions write into arrays of the caller.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray, KindArray
from stereoservo.numerics.compilation import kernel

PIVOT_TOLERANCE = 1e-14
"""Relative Cholesky pivot below which a point's rays count as coincident."""


@kernel
def multiply4_into(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """``out = A B`` for (4, 4); ``out`` must not alias ``A`` or ``B``."""
    for i in range(4):
        for j in range(4):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j] + A[i, 3] * B[3, j]


class Chain(NamedTuple):
    """A kinematic chain for kernels: ``generators`` (n, 4, 4) at the ``zero`` (n,) [rad or m], ``kinds`` (n,) 0
    revolute or 1 prismatic, ``tip_first`` as in `chain.ProjectiveChain`.
    """

    generators: FloatArray
    kinds: KindArray
    zero: FloatArray
    tip_first: bool


@kernel
def chain_forward_into(chain: Chain, q: FloatArray, H: FloatArray, operators: FloatArray) -> None:
    """``H(q)`` into (4, 4) and ``Ĥ_j|_Q`` into (n, 4, 4) (5.18, 5.21) at ``q`` (n,)."""
    generators, kinds, zero, tip_first = chain
    n = q.shape[0]
    inverse = np.empty((4, 4))
    first = np.empty((4, 4))
    second = np.empty((4, 4))
    for i in range(4):
        for k in range(4):
            H[i, k] = 1.0 if i == k else 0.0
            inverse[i, k] = H[i, k]
    for nth in range(n):
        j = n - 1 - nth if tip_first else nth
        G = generators[j]
        # With O = H̄ Ĥ H̄⁻¹ known, exp(sĤ) moves to the left: H̄ exp(sĤ) = exp(sO) H̄ = H̄ + sin s H̄Ĥ + (1 −
        # cos s) H̄Ĥ².
        multiply4_into(H, G, first)
        multiply4_into(first, inverse, operators[j])
        step = q[j] - zero[j]
        if kinds[j] == 1:
            for i in range(4):
                for k in range(4):
                    H[i, k] += step * first[i, k]
            multiply4_into(G, inverse, first)
            for i in range(4):
                for k in range(4):
                    inverse[i, k] -= step * first[i, k]
        else:
            sine = math.sin(step)
            half = math.sin(0.5 * step)
            versine = 2.0 * half * half
            multiply4_into(first, G, second)
            for i in range(4):
                for k in range(4):
                    H[i, k] += sine * first[i, k] + versine * second[i, k]
            multiply4_into(G, inverse, first)
            multiply4_into(G, first, second)
            for i in range(4):
                for k in range(4):
                    inverse[i, k] += -sine * first[i, k] + versine * second[i, k]


@kernel
def chain_forward(
    generators: FloatArray, kinds: KindArray, zero: FloatArray, q: FloatArray, tip_first: bool = False
) -> tuple[FloatArray, FloatArray]:
    """``H(q)`` (4, 4) and the operators ``Ĥ_j|_Q`` (n, 4, 4) of a chain at ``q`` (n,) (5.18, 5.21)."""
    H = np.empty((4, 4))
    operators = np.empty((q.shape[0], 4, 4))
    chain_forward_into(Chain(generators, kinds, zero, tip_first), q, H, operators)
    return H, operators


@kernel
def transform_points_into(H: FloatArray, M: FloatArray, out: FloatArray) -> None:
    """``H M`` of points (m, 4) into ``out`` (m, 4), which must not be ``M``."""
    for p in range(M.shape[0]):
        for i in range(4):
            out[p, i] = H[i, 0] * M[p, 0] + H[i, 1] * M[p, 1] + H[i, 2] * M[p, 2] + H[i, 3] * M[p, 3]


@kernel
def transform_points(H: FloatArray, M: FloatArray) -> FloatArray:
    """Points (m, 4) moved by ``H`` (4, 4)."""
    out = np.empty((M.shape[0], 4))
    transform_points_into(H, M, out)
    return out


@kernel
def invert4(H: FloatArray) -> FloatArray:
    """Inverse (4, 4) by 2x2 minors; all NaN if the determinant is zero or not finite."""
    s0 = H[0, 0] * H[1, 1] - H[1, 0] * H[0, 1]
    s1 = H[0, 0] * H[1, 2] - H[1, 0] * H[0, 2]
    s2 = H[0, 0] * H[1, 3] - H[1, 0] * H[0, 3]
    s3 = H[0, 1] * H[1, 2] - H[1, 1] * H[0, 2]
    s4 = H[0, 1] * H[1, 3] - H[1, 1] * H[0, 3]
    s5 = H[0, 2] * H[1, 3] - H[1, 2] * H[0, 3]
    c5 = H[2, 2] * H[3, 3] - H[3, 2] * H[2, 3]
    c4 = H[2, 1] * H[3, 3] - H[3, 1] * H[2, 3]
    c3 = H[2, 1] * H[3, 2] - H[3, 1] * H[2, 2]
    c2 = H[2, 0] * H[3, 3] - H[3, 0] * H[2, 3]
    c1 = H[2, 0] * H[3, 2] - H[3, 0] * H[2, 2]
    c0 = H[2, 0] * H[3, 1] - H[3, 0] * H[2, 1]
    determinant = s0 * c5 - s1 * c4 + s2 * c3 + s3 * c2 - s4 * c1 + s5 * c0
    out = np.empty((4, 4))
    if determinant == 0.0 or not math.isfinite(determinant):
        for i in range(4):
            for j in range(4):
                out[i, j] = math.nan
        return out
    d = 1.0 / determinant
    out[0, 0] = (H[1, 1] * c5 - H[1, 2] * c4 + H[1, 3] * c3) * d
    out[0, 1] = (-H[0, 1] * c5 + H[0, 2] * c4 - H[0, 3] * c3) * d
    out[0, 2] = (H[3, 1] * s5 - H[3, 2] * s4 + H[3, 3] * s3) * d
    out[0, 3] = (-H[2, 1] * s5 + H[2, 2] * s4 - H[2, 3] * s3) * d
    out[1, 0] = (-H[1, 0] * c5 + H[1, 2] * c2 - H[1, 3] * c1) * d
    out[1, 1] = (H[0, 0] * c5 - H[0, 2] * c2 + H[0, 3] * c1) * d
    out[1, 2] = (-H[3, 0] * s5 + H[3, 2] * s2 - H[3, 3] * s1) * d
    out[1, 3] = (H[2, 0] * s5 - H[2, 2] * s2 + H[2, 3] * s1) * d
    out[2, 0] = (H[1, 0] * c4 - H[1, 1] * c2 + H[1, 3] * c0) * d
    out[2, 1] = (-H[0, 0] * c4 + H[0, 1] * c2 - H[0, 3] * c0) * d
    out[2, 2] = (H[3, 0] * s4 - H[3, 1] * s2 + H[3, 3] * s0) * d
    out[2, 3] = (-H[2, 0] * s4 + H[2, 1] * s2 - H[2, 3] * s0) * d
    out[3, 0] = (-H[1, 0] * c3 + H[1, 1] * c1 - H[1, 2] * c0) * d
    out[3, 1] = (H[0, 0] * c3 - H[0, 1] * c1 + H[0, 2] * c0) * d
    out[3, 2] = (-H[3, 0] * s3 + H[3, 1] * s1 - H[3, 2] * s0) * d
    out[3, 3] = (H[2, 0] * s3 - H[2, 1] * s1 + H[2, 2] * s0) * d
    return out


@kernel
def project_points(Ps: FloatArray, M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (c, m, 2) and depths (c, m) of points (m, 4) in cameras (c, 3, 4); NaN pixels if the depth is 0."""
    cameras, points = Ps.shape[0], M.shape[0]
    pixels = np.empty((cameras, points, 2))
    depths = np.empty((cameras, points))
    for c in range(cameras):
        P = Ps[c]
        for p in range(points):
            u = P[0, 0] * M[p, 0] + P[0, 1] * M[p, 1] + P[0, 2] * M[p, 2] + P[0, 3] * M[p, 3]
            v = P[1, 0] * M[p, 0] + P[1, 1] * M[p, 1] + P[1, 2] * M[p, 2] + P[1, 3] * M[p, 3]
            d = P[2, 0] * M[p, 0] + P[2, 1] * M[p, 1] + P[2, 2] * M[p, 2] + P[2, 3] * M[p, 3]
            depths[c, p] = d
            pixels[c, p, 0] = u / d if d != 0.0 else math.nan
            pixels[c, p, 1] = v / d if d != 0.0 else math.nan
    return pixels, depths


@kernel
def image_jacobian(operators: FloatArray, Ps: FloatArray, M: FloatArray) -> FloatArray:
    """``J_G P Ĥ_j|_Q M`` (c, m, 2, n) [px/rad or px/m] for operators (n, 4, 4), cameras (c, 3, 4), points (m, 4)
    (8.33).

    NaN if a point lies in a camera's focal plane.
    """
    n, cameras, points = operators.shape[0], Ps.shape[0], M.shape[0]
    out = np.empty((cameras, points, 2, n))
    velocity = np.empty((n, 4))
    for p in range(points):
        for j in range(n):
            G = operators[j]
            for i in range(4):
                velocity[j, i] = G[i, 0] * M[p, 0] + G[i, 1] * M[p, 1] + G[i, 2] * M[p, 2] + G[i, 3] * M[p, 3]
        for c in range(cameras):
            P = Ps[c]
            d = P[2, 0] * M[p, 0] + P[2, 1] * M[p, 1] + P[2, 2] * M[p, 2] + P[2, 3] * M[p, 3]
            scale = 1.0 / d if d != 0.0 else math.nan
            for r in range(2):
                x = P[r, 0] * M[p, 0] + P[r, 1] * M[p, 1] + P[r, 2] * M[p, 2] + P[r, 3] * M[p, 3]
                pixel = x * scale
                g0 = (P[r, 0] - pixel * P[2, 0]) * scale
                g1 = (P[r, 1] - pixel * P[2, 1]) * scale
                g2 = (P[r, 2] - pixel * P[2, 2]) * scale
                g3 = (P[r, 3] - pixel * P[2, 3]) * scale
                for j in range(n):
                    out[c, p, r, j] = (
                        g0 * velocity[j, 0] + g1 * velocity[j, 1] + g2 * velocity[j, 2] + g3 * velocity[j, 3]
                    )
    return out


@kernel
def symmetric_eigen4(A: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (4,), ascending, and eigenvectors as columns (4, 4) of a symmetric (4, 4), by cyclic
    Jacobi rotations.
    """
    D = np.empty((4, 4))
    V = np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            D[i, j] = A[i, j]
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(30):
        off = 0.0
        on = 0.0
        for i in range(4):
            on += D[i, i] * D[i, i]
            for j in range(i + 1, 4):
                off += D[i, j] * D[i, j]
        if not off > 1e-36 * on:
            break
        for p in range(3):
            for r in range(p + 1, 4):
                if D[p, r] == 0.0:
                    continue
                ratio = (D[r, r] - D[p, p]) / (2.0 * D[p, r])
                t = 1.0 / (abs(ratio) + math.sqrt(1.0 + ratio * ratio))
                if ratio < 0.0:
                    t = -t
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = t * c
                for k in range(4):
                    x, y = D[k, p], D[k, r]
                    D[k, p], D[k, r] = c * x - s * y, s * x + c * y
                for k in range(4):
                    x, y = D[p, k], D[r, k]
                    D[p, k], D[r, k] = c * x - s * y, s * x + c * y
                for k in range(4):
                    x, y = V[k, p], V[k, r]
                    V[k, p], V[k, r] = c * x - s * y, s * x + c * y
    values = np.empty(4)
    vectors = np.empty((4, 4))
    used = np.zeros(4, dtype=np.uint8)
    for i in range(4):
        best = -1
        for j in range(4):
            if used[j] == 0 and (best < 0 or D[j, j] < D[best, best]):
                best = j
        used[best] = 1
        values[i] = D[best, best]
        for k in range(4):
            vectors[k, i] = V[k, best]
    return values, vectors


@kernel
def _views(weights: FloatArray, p: int) -> int:
    """Number of cameras that see point ``p``: positive ``weights`` (c, n)."""
    views = 0
    for c in range(weights.shape[0]):
        if weights[c, p] > 0.0:
            views += 1
    return views


@kernel
def _eliminated_and_free(row: FloatArray) -> tuple[int, int, int, int]:
    """Index of the entry of ``row`` (4,) of largest magnitude, and the three others in order."""
    k = 0
    for i in range(1, 4):
        if abs(row[i]) > abs(row[k]):
            k = i
    return k, 1 if k == 0 else 0, 2 if k <= 1 else 1, 3 if k <= 2 else 2


class Views(NamedTuple):
    """Observations of m points by c cameras ``Ps`` (c, 3, 4): ``pixels`` (c, m, 2) [px], ``weights`` (c, m) = 1/sigma
    [1/px], 0 where missing.
    """

    Ps: FloatArray
    pixels: FloatArray
    weights: FloatArray


@kernel
def _triangulate_point(views: Views, p: int, iterations: int, M: FloatArray, work: FloatArray) -> bool:
    """Triangulate one point into ``M[p]``; ``work`` (3,) is scratch. False if its rays do not determine it."""
    Ps, pixels, weights = views
    cameras = Ps.shape[0]
    if _views(weights, p) < 2:
        return False
    # Depth 1 in camera 0: coordinate k, with the largest entry of its third row, is eliminated.
    k, i0, i1, i2 = _eliminated_and_free(Ps[0, 2])
    pivot = Ps[0, 2, k]
    f0, f1, f2 = -Ps[0, 2, i0] / pivot, -Ps[0, 2, i1] / pivot, -Ps[0, 2, i2] / pivot
    for i in range(4):
        M[p, i] = 0.0
    M[p, k] = 1.0 / pivot
    for round_ in range(iterations + 1):
        n00 = n01 = n02 = n11 = n12 = n22 = b0 = b1 = b2 = 0.0
        for c in range(cameras):
            w = weights[c, p]
            if not w > 0.0:
                continue
            P = Ps[c]
            d = P[2, 0] * M[p, 0] + P[2, 1] * M[p, 1] + P[2, 2] * M[p, 2] + P[2, 3] * M[p, 3]
            for r in range(2):
                x = P[r, 0] * M[p, 0] + P[r, 1] * M[p, 1] + P[r, 2] * M[p, 2] + P[r, 3] * M[p, 3]
                if round_ == 0:  # linear (2.71): measured pixel in the constraint
                    pixel = pixels[c, p, r]
                    scale = w
                    residual = (pixel * d - x) * w
                else:  # renormalised (2.73): predicted pixel, divided by the depth
                    if d == 0.0:
                        return False
                    pixel = x / d
                    scale = w / d
                    residual = (pixels[c, p, r] - pixel) * w
                gk = P[r, k] - pixel * P[2, k]
                a0 = (P[r, i0] - pixel * P[2, i0] + f0 * gk) * scale
                a1 = (P[r, i1] - pixel * P[2, i1] + f1 * gk) * scale
                a2 = (P[r, i2] - pixel * P[2, i2] + f2 * gk) * scale
                n00 += a0 * a0
                n01 += a0 * a1
                n02 += a0 * a2
                n11 += a1 * a1
                n12 += a1 * a2
                n22 += a2 * a2
                b0 += a0 * residual
                b1 += a1 * residual
                b2 += a2 * residual
        floor = PIVOT_TOLERANCE * (n00 + n11 + n22)
        if not n00 > floor:
            return False
        l10, l20 = n01 / n00, n02 / n00
        d1 = n11 - l10 * n01
        if not d1 > floor:
            return False
        e12 = n12 - l10 * n02
        l21 = e12 / d1
        d2 = n22 - l20 * n02 - l21 * e12
        if not d2 > floor:
            return False
        y1 = b1 - l10 * b0
        y2 = b2 - l20 * b0 - l21 * y1
        work[2] = y2 / d2
        work[1] = y1 / d1 - l21 * work[2]
        work[0] = b0 / n00 - l10 * work[1] - l20 * work[2]
        M[p, i0] += work[0]
        M[p, i1] += work[1]
        M[p, i2] += work[2]
        M[p, k] += f0 * work[0] + f1 * work[1] + f2 * work[2]
    # The sum is finite only if all entries are.
    return math.isfinite(abs(M[p, 0]) + abs(M[p, 1]) + abs(M[p, 2]) + abs(M[p, 3]))


@kernel
def triangulate_into(
    Ps: FloatArray, pixels: FloatArray, weights: FloatArray, iterations: int, M: FloatArray, ok: BoolArray
) -> None:
    """Points into (m, 4) and validity into (m,) bool; see `triangulate`."""
    work, views = np.empty(3), Views(Ps, pixels, weights)
    for p in range(pixels.shape[1]):
        good = _triangulate_point(views, p, iterations, M, work)
        ok[p] = good
        if not good:
            for i in range(4):
                M[p, i] = math.nan


@kernel
def triangulate(
    Ps: FloatArray, pixels: FloatArray, weights: FloatArray, iterations: int
) -> tuple[FloatArray, BoolArray]:
    """Points (m, 4) of least reprojection error at depth 1 in camera 0, and validity (m,) bool (2.71, 2.73).

    ``pixels`` (c, m, 2) [px], ``weights`` (c, m) = 1/sigma [1/px], 0 where missing (the pixel is then not read). A
    linear solution, then ``iterations`` renormalised ones. NaN rows if fewer than two cameras see a point or its rays
    do not determine it.
    """
    M = np.empty((pixels.shape[1], 4))
    ok = np.empty(pixels.shape[1], dtype=np.bool_)
    triangulate_into(Ps, pixels, weights, iterations, M, ok)
    return M, ok


EXP_HALVINGS = 8
EXP_TERMS = 10


@kernel
def exp_twist(G: FloatArray) -> FloatArray:
    """Exponential (4, 4) of any generator (4, 4), a general screw included: Taylor series with scaling and squaring."""
    term = np.zeros((4, 4))
    H = np.zeros((4, 4))
    product = np.empty((4, 4))
    scaled = np.empty((4, 4))
    scale = 1.0 / 2.0**EXP_HALVINGS
    for i in range(4):
        term[i, i] = 1.0
        H[i, i] = 1.0
        for k in range(4):
            scaled[i, k] = G[i, k] * scale
    for n in range(1, EXP_TERMS + 1):
        multiply4_into(term, scaled, product)
        for i in range(4):
            for k in range(4):
                term[i, k] = product[i, k] / n
                H[i, k] += term[i, k]
    for _ in range(EXP_HALVINGS):
        multiply4_into(H, H, product)
        for i in range(4):
            for k in range(4):
                H[i, k] = product[i, k]
    return H


ITERATIONS = 30
"""Largest number of Newton steps of the inverse."""
CONVERGED = 1e-14
"""Step, relative to the radius, at which the inverse has converged."""
FARTHEST = 20.0
"""Largest ideal radius [r0] of the field of view of a lens of several terms."""
MET = 1e-10
"""Error [r0] of the inverse with tangential terms above which it does not exist."""


@kernel
def _fold_square(lens: FloatArray) -> float:
    """Square of the ideal radius [r0] at which a lens (7,) folds back, `FARTHEST` at most."""
    k, k2 = lens[0], lens[4]
    under = 9.0 * k * k - 20.0 * k2
    below = math.sqrt(under) - 3.0 * k if under > 0.0 else 0.0
    return min(2.0 / below, FARTHEST * FARTHEST) if below > 0.0 else FARTHEST * FARTHEST


@kernel
def _distorted_offset(lens: FloatArray, x: float, y: float) -> tuple[float, float]:
    """Raw offset [r0] from the centre of a lens (7,) for an ideal offset ``(x, y)`` [r0]."""
    k, k2, p1, p2 = lens[0], lens[4], lens[5], lens[6]
    s = x * x + y * y
    stretch = 1.0 + s * (k + s * k2)
    return (
        x * stretch + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
        y * stretch + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@kernel
def distortion_jacobian(lens: FloatArray, u: float, v: float) -> tuple[float, float, float]:
    """``∂raw/∂ideal`` at the ideal pixel ``(u, v)``, a symmetric matrix: its entries uu, uv, vv."""
    k, r0 = lens[0], lens[3]
    x, y = (u - lens[1]) / r0, (v - lens[2]) / r0
    if len(lens) > 4:
        k2, p1, p2 = lens[4], lens[5], lens[6]
        s = x * x + y * y
        stretch, slope = 1.0 + s * (k + s * k2), 2.0 * k + 4.0 * k2 * s
        return (
            stretch + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
            slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
            stretch + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
        )
    even = 1.0 + k * (x * x + y * y)
    return even + 2.0 * k * x * x, 2.0 * k * x * y, even + 2.0 * k * y * y


@kernel
def _undistorted_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Ideal pixel of the raw one for a lens (7,): bracketed Newton's method on the radius, then on both coordinates;
    NaN if there is none.
    """
    k, r0, k2 = lens[0], lens[3], lens[4]
    goal_x, goal_y = (u - lens[1]) / r0, (v - lens[2]) / r0
    raw = math.sqrt(goal_x * goal_x + goal_y * goal_y)
    square = _fold_square(lens)
    fold = math.sqrt(square)
    if not raw < fold * (1.0 + square * (k + square * k2)):
        return math.nan, math.nan
    low, high, radius = 0.0, fold, min(raw, 0.9 * fold)
    for _ in range(2 * ITERATIONS):
        s = radius * radius
        excess = radius * (1.0 + s * (k + s * k2)) - raw
        if excess <= 0.0:
            low = radius
        if excess >= 0.0:
            high = radius
        ahead = radius - excess / (1.0 + s * (3.0 * k + 5.0 * k2 * s))
        if not low <= ahead <= high:
            ahead = 0.5 * (low + high)
        moved = abs(ahead - radius)
        radius = ahead
        if moved <= CONVERGED * max(radius, 1.0):
            break
    scale = radius / raw if raw > 0.0 else 1.0
    x, y = goal_x * scale, goal_y * scale
    left_x, left_y = 0.0, 0.0
    for _ in range(ITERATIONS):
        seen_x, seen_y = _distorted_offset(lens, x, y)
        left_x, left_y = seen_x - goal_x, seen_y - goal_y
        uu, uv, vv = distortion_jacobian(lens, lens[1] + r0 * x, lens[2] + r0 * y)
        determinant = uu * vv - uv * uv
        if not determinant > 0.0:
            return math.nan, math.nan
        step_x = (vv * left_x - uv * left_y) / determinant
        step_y = (uu * left_y - uv * left_x) / determinant
        x, y = x - step_x, y - step_y
        if max(abs(step_x), abs(step_y)) <= CONVERGED * max(abs(x), abs(y), 1.0):
            break
    if not max(abs(left_x), abs(left_y)) < MET:
        return math.nan, math.nan
    return lens[1] + r0 * x, lens[2] + r0 * y


@kernel
def distort_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Raw pixel of the ideal one ``(u, v)``; NaN beyond the fold. ``lens`` (4,) or (7,) as in `geometry.distortion`; a
    lens (4,) with ``k = 0`` returns it unchanged, bit for bit.
    """
    k, r0 = lens[0], lens[3]
    if len(lens) > 4:
        x, y = (u - lens[1]) / r0, (v - lens[2]) / r0
        if not x * x + y * y < _fold_square(lens):
            return math.nan, math.nan
        x, y = _distorted_offset(lens, x, y)
        return lens[1] + r0 * x, lens[2] + r0 * y
    if k == 0.0:
        return u, v
    x, y = (u - lens[1]) / r0, (v - lens[2]) / r0
    bend = k * (x * x + y * y)
    if not 1.0 + 3.0 * bend > 0.0:
        return math.nan, math.nan
    return lens[1] + (u - lens[1]) * (1.0 + bend), lens[2] + (v - lens[2]) * (1.0 + bend)


@kernel
def undistort_pixel(lens: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Ideal pixel of the raw one ``(u, v)`` by Newton's method on the radius; NaN if there is none.

    A lens (4,) with ``k = 0`` returns it unchanged, bit for bit.
    """
    k, r0 = lens[0], lens[3]
    if len(lens) > 4:
        return _undistorted_pixel(lens, u, v)
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
