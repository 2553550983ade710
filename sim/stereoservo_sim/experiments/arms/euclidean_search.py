"""Reference solver of six revolute joints without a closed form: Newton's method in metric coordinates from many
random starts.
"""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo_sim.experiments.arms.euclidean_inverse import EuclideanAxes

STEPS = 40
SOLVED = 1e-11
APART = 1e-5


@kernel
def _forward(
    directions: FloatArray, points: FloatArray, q: FloatArray, R: FloatArray, t: FloatArray, J: FloatArray
) -> None:
    """Pose ``R`` (3, 3), ``t`` (3,) at ``q`` (n,) and the spatial Jacobian ``J`` (6, n), turns above."""
    turn, product = np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        t[i] = 0.0
        for k in range(3):
            R[i, k] = 1.0 if i == k else 0.0
    for j in range(q.shape[0]):
        d, p = directions[j], points[j]
        for i in range(3):
            J[i, j] = R[i, 0] * d[0] + R[i, 1] * d[1] + R[i, 2] * d[2]
        x = R[0, 0] * p[0] + R[0, 1] * p[1] + R[0, 2] * p[2] + t[0]
        y = R[1, 0] * p[0] + R[1, 1] * p[1] + R[1, 2] * p[2] + t[1]
        z = R[2, 0] * p[0] + R[2, 1] * p[1] + R[2, 2] * p[2] + t[2]
        J[3, j] = y * J[2, j] - z * J[1, j]
        J[4, j] = z * J[0, j] - x * J[2, j]
        J[5, j] = x * J[1, j] - y * J[0, j]
        c, s = np.cos(q[j]), np.sin(q[j])
        for i in range(3):
            for k in range(3):
                turn[i, k] = (1.0 - c) * d[i] * d[k] + (c if i == k else 0.0)
        turn[0, 1] -= s * d[2]
        turn[1, 0] += s * d[2]
        turn[0, 2] += s * d[1]
        turn[2, 0] -= s * d[1]
        turn[1, 2] -= s * d[0]
        turn[2, 1] += s * d[0]
        for i in range(3):
            for k in range(3):
                product[i, k] = R[i, 0] * turn[0, k] + R[i, 1] * turn[1, k] + R[i, 2] * turn[2, k]
        R[:] = product
        t[0] = x - R[0, 0] * p[0] - R[0, 1] * p[1] - R[0, 2] * p[2]
        t[1] = y - R[1, 0] * p[0] - R[1, 1] * p[1] - R[1, 2] * p[2]
        t[2] = z - R[2, 0] * p[0] - R[2, 1] * p[1] - R[2, 2] * p[2]


@kernel
def _error(goal: FloatArray, R: FloatArray, t: FloatArray, e: FloatArray) -> float:
    """Spatial twist (6,) to ``goal`` (4, 4), to first order in its rotation; its norm."""
    D = np.empty((3, 3))
    for i in range(3):
        for k in range(3):
            D[i, k] = goal[i, 0] * R[k, 0] + goal[i, 1] * R[k, 1] + goal[i, 2] * R[k, 2]
    e[0], e[1], e[2] = 0.5 * (D[2, 1] - D[1, 2]), 0.5 * (D[0, 2] - D[2, 0]), 0.5 * (D[1, 0] - D[0, 1])
    sine = np.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    angle = np.arctan2(sine, 0.5 * (D[0, 0] + D[1, 1] + D[2, 2] - 1.0))
    if sine > 1e-12:
        for i in range(3):
            e[i] *= angle / sine
    # What the turn about the origin does to the present place is no part of the translation still to make.
    e[3] = goal[0, 3] - t[0] - (e[1] * t[2] - e[2] * t[1])
    e[4] = goal[1, 3] - t[1] - (e[2] * t[0] - e[0] * t[2])
    e[5] = goal[2, 3] - t[2] - (e[0] * t[1] - e[1] * t[0])
    total = 0.0
    for i in range(6):
        total += e[i] * e[i]
    return float(np.sqrt(total))


@kernel
def _eliminate(A: FloatArray, b: FloatArray) -> None:
    """``A⁻¹ b`` into ``b`` (n,), ``A`` (n, n) positive definite, by Gauss."""
    n = b.shape[0]
    for k in range(n):
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            for j in range(k, n):
                A[i, j] -= factor * A[k, j]
            b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= A[k, j] * b[j]
        b[k] /= A[k, k]


@kernel
def _newton(
    directions: FloatArray, points: FloatArray, goal: FloatArray, starts: FloatArray, steps: int
) -> tuple[FloatArray, FloatArray]:
    """End configurations (s, n) and their residuals (s,), [m] and [rad] in one norm."""
    s, n = starts.shape
    q = starts.copy()
    left = np.full(s, np.inf)
    R, t, J, e = np.empty((3, 3)), np.empty(3), np.empty((6, n)), np.empty(6)
    A, b = np.empty((n, n)), np.empty(n)
    for a in range(s):
        for _ in range(steps):
            _forward(directions, points, q[a], R, t, J)
            left[a] = _error(goal, R, t, e)
            if left[a] < 1e-13:
                break
            for j in range(n):
                b[j] = 0.0
                for i in range(6):
                    b[j] += J[i, j] * e[i]
                for k in range(n):
                    A[j, k] = 0.0
                    for i in range(6):
                        A[j, k] += J[i, j] * J[i, k]
                A[j, j] += 1e-12 + 1e-3 * min(1.0, left[a]) ** 2
            _eliminate(A, b)
            longest = 0.0
            for j in range(n):
                longest = max(longest, abs(b[j]))
            for j in range(n):
                q[a, j] += b[j] * min(1.0, 0.6 / max(longest, 1e-300))
    return q, left


def all_solutions(axes: EuclideanAxes, goal: FloatArray, starts: int, rng: np.random.Generator) -> FloatArray:
    """Solutions (s, 6) [rad] in (-π, π] of one ``goal`` (4, 4)."""
    first = rng.uniform(-np.pi, np.pi, (starts, len(axes.directions)))
    ends, left = _newton(axes.directions, axes.points, np.ascontiguousarray(goal), first, STEPS)
    found: list[FloatArray] = []
    for q in np.mod(ends[left < SOLVED] + np.pi, 2.0 * np.pi) - np.pi:
        apart = [np.abs(np.mod(q - other + np.pi, 2.0 * np.pi) - np.pi).max() for other in found]
        if not apart or min(apart) > APART:
            found.append(q)
    return np.array(found).reshape(-1, len(axes.directions))
