"""Changes of few parameters fitted to the innovations of now: kernels of `kinematics.moved_kernel`.

`kinematics.moved` says what is computed; `kinematics.moved_reference` is the same in NumPy. Explicit loops in a fixed
order, no LAPACK.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import exp_twist, kernel, multiply4_into
from stereoservo.kinematics.linear_kernels import add_pixel_equations, damped_solve

SETTLED = 1e-4
"""Decrease of chi-square to first order at which Gauss and Newton's iteration ends."""
DAMPING = 1e-10


@kernel
def _equations(
    E: FloatArray, P: FloatArray, D: FloatArray, X: FloatArray, observed: FloatArray, weights: FloatArray,
    first: int, last: int, N: FloatArray, b: FloatArray, rows: FloatArray,
) -> float:  # fmt: skip
    """Equations of points ``first`` to ``last`` of one camera, moved by ``D``, into ``N``, ``b``; their chi-square.

    ``E`` (d, 3, 4) = P times the algebra; ``rows`` (2, d) scratch. Infinite where a point is not ahead.
    """
    chi2 = 0.0
    d = b.shape[0]
    for p in range(first, last):
        w = weights[p]
        if not w > 0.0:
            continue
        x0 = D[0, 0] * X[p, 0] + D[0, 1] * X[p, 1] + D[0, 2] * X[p, 2] + D[0, 3] * X[p, 3]
        x1 = D[1, 0] * X[p, 0] + D[1, 1] * X[p, 1] + D[1, 2] * X[p, 2] + D[1, 3] * X[p, 3]
        x2 = D[2, 0] * X[p, 0] + D[2, 1] * X[p, 1] + D[2, 2] * X[p, 2] + D[2, 3] * X[p, 3]
        x3 = D[3, 0] * X[p, 0] + D[3, 1] * X[p, 1] + D[3, 2] * X[p, 2] + D[3, 3] * X[p, 3]
        z = P[2, 0] * x0 + P[2, 1] * x1 + P[2, 2] * x2 + P[2, 3] * x3
        if z == 0.0:
            return math.inf
        scale = 1.0 / z
        u = (P[0, 0] * x0 + P[0, 1] * x1 + P[0, 2] * x2 + P[0, 3] * x3) * scale
        v = (P[1, 0] * x0 + P[1, 1] * x1 + P[1, 2] * x2 + P[1, 3] * x3) * scale
        for k in range(d):
            e2 = E[k, 2, 0] * x0 + E[k, 2, 1] * x1 + E[k, 2, 2] * x2 + E[k, 2, 3] * x3
            e0 = E[k, 0, 0] * x0 + E[k, 0, 1] * x1 + E[k, 0, 2] * x2 + E[k, 0, 3] * x3
            e1 = E[k, 1, 0] * x0 + E[k, 1, 1] * x1 + E[k, 1, 2] * x2 + E[k, 1, 3] * x3
            rows[0, k] = (e0 - u * e2) * scale
            rows[1, k] = (e1 - v * e2) * scale
        du, dv = observed[p, 0] - u, observed[p, 1] - v
        chi2 += w * w * (du * du + dv * dv)
        add_pixel_equations(rows, du, dv, w * w, N, b)
    return chi2


@kernel
def _times(P: FloatArray, algebra: FloatArray, first: int, last: int) -> FloatArray:
    """``P B_k`` (d, 3, 4) for k = first to last."""
    E = np.empty((last - first, 3, 4))
    for k in range(first, last):
        for i in range(3):
            for j in range(4):
                s = 0.0
                for h in range(4):
                    s += P[i, h] * algebra[k, h, j]
                E[k - first, i, j] = s
    return E


@kernel
def _solved(N: FloatArray, b: FloatArray, x: FloatArray) -> float:
    """``x`` of ``N x = b`` and the first-order gain ``b·x``; ``N`` is overwritten."""
    damped_solve(N, b, DAMPING, x)
    gain = 0.0
    for k in range(b.shape[0]):
        gain += b[k] * x[k]
    return gain


@kernel
def fit_displacement(
    Ps: FloatArray, camera: int, algebra: FloatArray, first: int, last: int, X: FloatArray, count: int,
    observed: FloatArray, weights: FloatArray, rounds: int, D: FloatArray, total: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Chi-square of the first ``count`` points in one camera, or all (-1), moved by the best element of a group.

    The group's algebra is rows ``first`` to ``last`` of ``algebra``; ``D`` (4, 4) is its element, ``total`` (d,) the
    sum of the steps. With ``rounds`` 0: chi-square of now. Second: the gain to first order of the first step.
    """
    d = last - first
    low, high = (0, Ps.shape[0]) if camera < 0 else (camera, camera + 1)
    E = np.empty((high - low, d, 3, 4))
    for c in range(low, high):
        E[c - low] = _times(Ps[c], algebra, first, last)
    N, b, x, rows = np.empty((d, d)), np.empty(d), np.empty(d), np.empty((2, d))
    here, product = np.zeros((4, 4)), np.empty((4, 4))
    tried = np.zeros(d)
    for i in range(4):
        for j in range(4):
            D[i, j] = here[i, j] = 1.0 if i == j else 0.0
    for k in range(d):
        total[k] = 0.0
    best, linear = math.inf, 0.0
    for turn in range(rounds + 1):
        N[:] = 0.0
        b[:] = 0.0
        chi2 = 0.0
        for c in range(low, high):
            chi2 += _equations(E[c - low], Ps[c], here, X, observed[c], weights[c], 0, count, N, b, rows)
        if not chi2 < math.inf or (turn > 0 and not chi2 <= best):
            break
        best = chi2
        for i in range(4):
            for j in range(4):
                D[i, j] = here[i, j]
        for k in range(d):
            total[k] = tried[k]
        gain = _solved(N, b, x)
        if turn == 0:
            linear = gain
        if turn == rounds or gain < SETTLED:
            break
        G = np.zeros((4, 4))
        for k in range(d):
            tried[k] += x[k]
            for i in range(4):
                for j in range(4):
                    G[i, j] += x[k] * algebra[first + k, i, j]
        multiply4_into(exp_twist(G), here, product)
        for i in range(4):
            for j in range(4):
                here[i, j] = product[i, j]
    return best, linear


@kernel
def fit_image_motion(
    pixels: FloatArray, observed: FloatArray, weights: FloatArray, size: int, rounds: int, moved: FloatArray
) -> tuple[float, float]:
    """Chi-square of ``pixels`` (q, 2) of one camera moved by the best homography (``size`` 8) or shift (2).

    ``moved`` (q, 2): where it puts them. Second: the gain to first order of the first step.
    """
    q = pixels.shape[0]
    seen, cu, cv, spread = 0.0, 0.0, 0.0, 0.0
    for p in range(q):
        if weights[p] > 0.0:
            seen += 1.0
            cu += pixels[p, 0]
            cv += pixels[p, 1]
    cu, cv = cu / max(seen, 1.0), cv / max(seen, 1.0)
    for p in range(q):
        if weights[p] > 0.0:
            spread += (pixels[p, 0] - cu) ** 2 + (pixels[p, 1] - cv) ** 2
    spread = math.sqrt(spread / max(seen, 1.0))
    if spread == 0.0:
        spread = 1.0
    here = np.empty((q, 2))
    for p in range(q):
        here[p, 0], here[p, 1] = (pixels[p, 0] - cu) / spread, (pixels[p, 1] - cv) / spread
    N, b, a, rows = np.empty((size, size)), np.empty(size), np.empty(size), np.zeros((2, size))
    best, linear = math.inf, 0.0
    for turn in range(rounds + 1):
        N[:] = 0.0
        b[:] = 0.0
        chi2 = 0.0
        for p in range(q):
            w = weights[p] * spread
            if not w > 0.0:
                continue
            x, y = here[p, 0], here[p, 1]
            du = (observed[p, 0] - cu) / spread - x
            dv = (observed[p, 1] - cv) / spread - y
            chi2 += w * w * (du * du + dv * dv)
            rows[0, 0] = rows[1, 1] = 1.0
            if size == 8:
                rows[0, 2], rows[0, 3], rows[0, 6], rows[0, 7] = x, y, x * x, x * y
                rows[1, 4], rows[1, 5], rows[1, 6], rows[1, 7] = x, y, x * y, y * y
            add_pixel_equations(rows, du, dv, w * w, N, b)
        if not chi2 < math.inf or (turn > 0 and not chi2 <= best):
            break
        best = chi2
        for p in range(q):
            moved[p, 0], moved[p, 1] = cu + spread * here[p, 0], cv + spread * here[p, 1]
        gain = _solved(N, b, a)
        if turn == 0:
            linear = gain
        if turn == rounds or gain < SETTLED:
            break
        for p in range(q):
            x, y = here[p, 0], here[p, 1]
            if size == 8:
                scale = 1.0 - a[6] * x - a[7] * y
                here[p, 0] = (x + a[0] + a[2] * x + a[3] * y) / scale
                here[p, 1] = (y + a[1] + a[4] * x + a[5] * y) / scale
            else:
                here[p, 0], here[p, 1] = x + a[0], y + a[1]
    return best, linear


@kernel
def fit_point(
    Ps: FloatArray,
    X: FloatArray,
    p: int,
    observed: FloatArray,
    weights: FloatArray,
    rounds: int,
    found: FloatArray,
) -> tuple[float, float]:
    """Chi-square of point ``p`` alone at its best place ``found`` (4,); second: gain to first order of the first step.

    Two views or more: three of its coordinates are free, all but the largest.
    """
    largest = 0
    for i in range(1, 4):
        if abs(X[p, i]) > abs(X[p, largest]):
            largest = i
    here = np.empty((1, 4))
    for i in range(4):
        here[0, i] = found[i] = X[p, i]
    N, b, x, rows = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((2, 3))
    best, linear = math.inf, 0.0
    for turn in range(rounds + 1):
        N[:] = 0.0
        b[:] = 0.0
        chi2 = 0.0
        for c in range(Ps.shape[0]):
            w = weights[c, p]
            if not w > 0.0:
                continue
            P = Ps[c]
            z = P[2, 0] * here[0, 0] + P[2, 1] * here[0, 1] + P[2, 2] * here[0, 2] + P[2, 3] * here[0, 3]
            if z == 0.0:
                chi2 = math.inf
                continue
            u = (
                P[0, 0] * here[0, 0] + P[0, 1] * here[0, 1] + P[0, 2] * here[0, 2] + P[0, 3] * here[0, 3]
            ) / z
            v = (
                P[1, 0] * here[0, 0] + P[1, 1] * here[0, 1] + P[1, 2] * here[0, 2] + P[1, 3] * here[0, 3]
            ) / z
            k = 0
            for i in range(4):
                if i != largest:
                    rows[0, k] = (P[0, i] - u * P[2, i]) / z
                    rows[1, k] = (P[1, i] - v * P[2, i]) / z
                    k += 1
            du, dv = observed[c, p, 0] - u, observed[c, p, 1] - v
            chi2 += w * w * (du * du + dv * dv)
            add_pixel_equations(rows, du, dv, w * w, N, b)
        if not chi2 < math.inf or (turn > 0 and not chi2 <= best):
            break
        best = chi2
        for i in range(4):
            found[i] = here[0, i]
        gain = _solved(N, b, x)
        if turn == 0:
            linear = gain
        if turn == rounds or gain < SETTLED:
            break
        k = 0
        for i in range(4):
            if i != largest:
                here[0, i] += x[k]
                k += 1
    return best, linear
