"""Numba kernels of small dense linear algebra without BLAS, LAPACK or fastmath: Cholesky, normal equations, damped
least squares, orthonormal rows, null directions, singular vectors.

Explicit loops in a fixed order: the same input gives bitwise the same result on one machine. Arrays are float64.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

PIVOT_TOLERANCE = 1e-14
"""Cholesky pivot, relative to the largest diagonal, below which the normal equations count as singular."""

SWEEPS = 40
ORTHOGONAL = 1e-15
NEGLIGIBLE = 1e-17
"""One-sided Jacobi: columns are orthogonal below this cosine; columns below this fraction of the matrix are
rounding.
"""


class NormalSystem(NamedTuple):
    """``N x = b``: ``N`` (n, n) symmetric, possibly with only the lower triangle filled, and ``b`` (n,)."""

    N: FloatArray
    b: FloatArray


@kernel
def cholesky_solve(N: FloatArray, b: FloatArray, x: FloatArray) -> float:
    """Solve ``N x = b`` for symmetric positive ``N`` (n, n), which is overwritten by its Cholesky factor.

    Returns the smallest pivot divided by the largest diagonal element; 0 (and ``x = 0``) if ``N`` is singular or not
    finite.
    """
    n = b.shape[0]
    largest = 0.0
    for i in range(n):
        largest = max(largest, N[i, i])
    smallest = math.inf
    good = largest > 0.0 and largest < math.inf
    for j in range(n):
        if not good:
            break
        pivot = N[j, j]
        for k in range(j):
            pivot -= N[j, k] * N[j, k]
        if not pivot > PIVOT_TOLERANCE * largest:
            good = False
            break
        smallest = min(smallest, pivot)
        root = math.sqrt(pivot)
        N[j, j] = root
        for i in range(j + 1, n):
            s = N[i, j]
            for k in range(j):
                s -= N[i, k] * N[j, k]
            N[i, j] = s / root
    if not good:
        for i in range(n):
            x[i] = 0.0
        return 0.0
    factor_solve(N, b, x)
    return smallest / largest


@kernel
def factor_solve(L: FloatArray, b: FloatArray, x: FloatArray) -> None:
    """Solve ``L Lᵀ x = b`` for the Cholesky factor ``L`` (n, n) of `cholesky_solve`."""
    n = b.shape[0]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for back in range(n):
        i = n - 1 - back
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@kernel
def add_equation(row: FloatArray, error: float, weight: float, N: FloatArray, b: FloatArray) -> None:
    """Add one equation ``row·x = error`` of squared weight ``weight`` to the normal equations ``N x = b``.

    ``row`` (n,); only the lower triangle of ``N`` (n, n) is updated.
    """
    for i in range(b.shape[0]):
        weighted = weight * row[i]
        b[i] += weighted * error
        for k in range(i + 1):
            N[i, k] += weighted * row[k]


@kernel
def add_pixel_equations(rows: FloatArray, u: float, v: float, weight: float, N: FloatArray, b: FloatArray) -> None:
    """Add the two equations of a pixel: `add_equation` for ``rows`` (2, n) and errors ``u``, ``v``."""
    for i in range(b.shape[0]):
        weighted_u, weighted_v = weight * rows[0, i], weight * rows[1, i]
        b[i] += weighted_u * u + weighted_v * v
        for k in range(i + 1):
            N[i, k] += weighted_u * rows[0, k] + weighted_v * rows[1, k]


@kernel
def damped_solve(N: FloatArray, b: FloatArray, damping: float, x: FloatArray) -> float:
    """`cholesky_solve` with ``damping`` times the largest diagonal of ``N`` (n, n) added to its diagonal."""
    largest = 0.0
    for i in range(b.shape[0]):
        largest = max(largest, N[i, i])
    for i in range(b.shape[0]):
        N[i, i] += damping * largest
    return cholesky_solve(N, b, x)


@kernel
def damped_least_squares(J: FloatArray, e: FloatArray, weights: FloatArray, damping: float) -> tuple[FloatArray, float]:
    """``x`` (n,) of least ``Σ w²(Jx − e)² + damping·d·|x|²``, ``d`` the largest diagonal of ``JᵀW²J``.

    ``J`` (r, n), ``e`` (r,), ``weights`` (r,) = 1/sigma, 0 where missing (the row is then not read). Returns ``x`` and
    the conditioning: the smallest Cholesky pivot of the damped normal matrix divided by its largest diagonal element, 0
    (with ``x = 0``) if it is singular.
    """
    rows, n = J.shape
    N = np.zeros((n, n))
    b = np.zeros(n)
    x = np.zeros(n)
    for r in range(rows):
        w = weights[r]
        if w == 0.0:
            continue
        add_equation(J[r], e[r], w * w, N, b)
    conditioning = damped_solve(N, b, damping, x)
    return x, conditioning


@kernel
def right_singular(A: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right singular vectors as columns (n, n) and singular values (n,), descending, of ``A`` (r, n), for any r.

    One-sided Jacobi: small values are relatively accurate, too; no LAPACK. Vectors are unique up to sign.
    """
    rows, n = A.shape
    U = A.copy()
    V = np.zeros((n, n))
    for i in range(n):
        V[i, i] = 1.0
    total = 0.0
    for r in range(rows):
        for i in range(n):
            total += U[r, i] * U[r, i]
    floor = NEGLIGIBLE * math.sqrt(total)
    for _ in range(SWEEPS):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                alpha, beta, gamma = 0.0, 0.0, 0.0
                for r in range(rows):
                    alpha += U[r, p] * U[r, p]
                    beta += U[r, q] * U[r, q]
                    gamma += U[r, p] * U[r, q]
                size = abs(gamma)
                if not (size > floor * math.sqrt(max(alpha, beta)) and size > ORTHOGONAL * math.sqrt(alpha * beta)):
                    continue
                rotated = True
                zeta = (beta - alpha) / (2.0 * gamma)
                t = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
                c = 1.0 / math.sqrt(1.0 + t * t)
                s = c * t
                for r in range(rows):
                    u = U[r, p]
                    U[r, p] = c * u - s * U[r, q]
                    U[r, q] = s * u + c * U[r, q]
                for r in range(n):
                    v = V[r, p]
                    V[r, p] = c * v - s * V[r, q]
                    V[r, q] = s * v + c * V[r, q]
        if not rotated:
            break
    values = np.zeros(n)
    for i in range(n):
        s2 = 0.0
        for r in range(rows):
            s2 += U[r, i] * U[r, i]
        values[i] = math.sqrt(s2)
    for i in range(n - 1):
        best = i
        for k in range(i + 1, n):
            if values[k] > values[best]:
                best = k
        if best != i:
            values[i], values[best] = values[best], values[i]
            for r in range(n):
                v = V[r, i]
                V[r, i] = V[r, best]
                V[r, best] = v
    return V, values


@kernel
def null_direction(A: FloatArray) -> tuple[FloatArray, float, float, float]:
    """Unit ``x`` (n,) of least ``|A x|`` for ``A`` (r, n), and the smallest, second-smallest, largest singular value.

    With one column the three values are equal.
    """
    V, values = right_singular(A)
    n = values.shape[0]
    x = np.empty(n)
    for i in range(n):
        x[i] = V[i, n - 1]
    return x, values[n - 1], values[max(n - 2, 0)], values[0]


# -- by orthogonalisation, where bounds on the singular values are enough ---------------------------------------

INVERSE_ITERATIONS = 8
SETTLED = 1e-16
"""Change of a null direction in one more iteration below which inverse iteration has converged."""


@kernel
def dot_of_rows(A: FloatArray, i: int, B: FloatArray, k: int) -> float:
    """``A[i]·B[k]`` of rows whose length is a multiple of four, as four partial sums."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for c in range(0, A.shape[1], 4):
        s0 += A[i, c] * B[k, c]
        s1 += A[i, c + 1] * B[k, c + 1]
        s2 += A[i, c + 2] * B[k, c + 2]
        s3 += A[i, c + 3] * B[k, c + 3]
    return (s0 + s1) + (s2 + s3)


@kernel
def invert_upper(R: FloatArray, n: int, W: FloatArray) -> float:
    """Inverse of the leading (n, n) of an upper triangular ``R`` into ``W``, zeros below; returns its squared Frobenius
    norm, infinite if ``R`` has no inverse.
    """
    size = 0.0
    for k in range(n):
        for i in range(k + 1, n):
            W[i, k] = 0.0
        if R[k, k] == 0.0:
            return math.inf
        W[k, k] = 1.0 / R[k, k]
        size += W[k, k] * W[k, k]
        for back in range(k):
            i = k - 1 - back
            s = 0.0
            for h in range(i + 1, k + 1):
                s += R[i, h] * W[h, k]
            W[i, k] = -s / R[i, i]
            size += W[i, k] * W[i, k]
    return size


@kernel
def orthonormal_rows(A: FloatArray, Q: FloatArray, W: FloatArray) -> float:
    """Orthonormal ``Q = Wᵀ A`` (n, m) of the rows of ``A`` (n, m), ``W`` (n, n) upper triangular, by Gram-Schmidt;
    returns a lower bound, within a factor n, of the smallest over the largest singular value of ``A``: 0 if the rows
    are linearly dependent.

    ``m`` is a multiple of four. ``Q`` is orthonormal up to rounding divided by the bound.
    """
    n, m = A.shape
    R = np.zeros((n, n))
    size = 0.0
    for i in range(n):
        for c in range(m):
            Q[i, c] = A[i, c]
        for h in range(i):
            along = dot_of_rows(Q, h, Q, i)
            R[h, i] = along
            size += along * along
            for c in range(m):
                Q[i, c] -= along * Q[h, c]
        square = dot_of_rows(Q, i, Q, i)
        if not (square > 0.0 and math.isfinite(square)):
            return 0.0
        length = math.sqrt(square)
        R[i, i] = length
        size += square
        for c in range(m):
            Q[i, c] /= length
    return 1.0 / math.sqrt(size * invert_upper(R, n, W))


@kernel
def left_null_direction(A: FloatArray, x: FloatArray) -> tuple[float, float, float]:
    """Unit ``x`` (n,) of least ``|xᵀ A|`` for ``A`` (n, m), n >= 2, which is overwritten; bounds of its singular
    values: the smallest is at most the first, the second-smallest at least the second, the largest at most the third.

    Gram-Schmidt with pivoting, then inverse iteration. The second bound is 0, and ``x`` undefined, if the direction is
    not determined: several directions are null, or nearly. ``m`` is a multiple of four.
    """
    n, m = A.shape
    R, W = np.zeros((n, n)), np.empty((n, n))
    order = np.arange(n)
    size = 0.0
    for i in range(n):
        best, longest = i, -1.0
        for k in range(i, n):
            square = dot_of_rows(A, k, A, k)
            if square > longest:
                best, longest = k, square
        if best != i:
            order[i], order[best] = order[best], order[i]
            for c in range(m):
                A[i, c], A[best, c] = A[best, c], A[i, c]
            for h in range(i):
                R[h, i], R[h, best] = R[h, best], R[h, i]
        if not math.isfinite(longest):
            return 0.0, 0.0, 0.0
        R[i, i] = math.sqrt(max(longest, 0.0))
        size += longest
        if i == n - 1 or not longest > 0.0:
            break
        for c in range(m):
            A[i, c] /= R[i, i]
        for k in range(i + 1, n):
            along = dot_of_rows(A, i, A, k)
            R[i, k] = along
            size += along * along
            for c in range(m):
                A[k, c] -= along * A[i, c]
    last = n - 1
    second = 1.0 / math.sqrt(invert_upper(R, last, W))
    if not second > 0.0:
        return 0.0, 0.0, 0.0
    y = W[last]
    square = 1.0
    y[last] = 1.0
    for i in range(last):
        s = 0.0
        for k in range(i, last):
            s -= W[i, k] * R[k, last]
        y[i] = s
        square += s * s
    smallest = R[last, last] / math.sqrt(square)
    for i in range(n):
        y[i] /= math.sqrt(square)
    if not _by_inverse_iteration(R, y, smallest / second):
        return smallest, 0.0, math.sqrt(size)
    for i in range(n):
        x[order[i]] = y[i]
    return smallest, second, math.sqrt(size)


@kernel
def _by_inverse_iteration(R: FloatArray, y: FloatArray, ratio: float) -> bool:
    """Refine the unit ``y`` (n,) of least ``|R y|``; ``ratio``: a bound of the smallest singular value divided by the
    second. False if it does not converge in time.
    """
    n = y.shape[0]
    if ratio <= SETTLED:
        return True
    z = np.empty(n)
    for _ in range(INVERSE_ITERATIONS):
        for i in range(n):
            s = y[i]
            for k in range(i):
                s -= R[k, i] * z[k]
            z[i] = s / R[i, i]
        square = 0.0
        for back in range(n):
            i = n - 1 - back
            s = z[i]
            for k in range(i + 1, n):
                s -= R[i, k] * z[k]
            z[i] = s / R[i, i]
            square += z[i] * z[i]
        change, length = 0.0, math.sqrt(square)
        for i in range(n):
            change = max(change, abs(z[i] / length - y[i]))
            y[i] = z[i] / length
        if change * ratio * ratio <= SETTLED:
            return True
    return False
