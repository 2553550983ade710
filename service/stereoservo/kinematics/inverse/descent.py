"""Joints of least error between moved points and their targets, from many starts: Levenberg-Marquardt, compiled."""

from __future__ import annotations

import math

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.kernels import (
    KindArray,
    chain_forward,
    chain_forward_into,
    kernel,
    transform_points_into,
)

ITERATIONS = 60
LONGEST = 0.7
"""Largest change of a joint in one step [rad or m]."""
STALLED = 1e-10
"""Share of the error by which a step has to lower it for another one to follow."""
IDLE = 1e-20
"""Damping that is always there, as a share of what the operators could do to the points: what rounding alone seems to
move, a joint that the goal leaves free, stays where it is.
"""


@kernel
def _sum_of_squares(A: FloatArray) -> float:
    total = 0.0
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            total += A[i, k] * A[i, k]
    return total


@kernel
def _solve_damped(A: FloatArray, g: FloatArray, damping: float, L: FloatArray, x: FloatArray) -> bool:
    """``(A + damping·I) x = -g`` by Cholesky in ``L`` (n, n); False where it is not positive."""
    n = g.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            if i == j:
                total += damping
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    for i in range(n):
        total = -g[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]
    return True


@kernel
def _squared_error(moved: FloatArray, targets: FloatArray) -> float:
    total = 0.0
    for p in range(moved.shape[0]):
        for i in range(4):
            total += (moved[p, i] - targets[p, i]) ** 2
    return total


@kernel
def descend(
    generators: FloatArray,
    kinds: KindArray,
    zero: FloatArray,
    tip_first: bool,
    points: FloatArray,
    targets: FloatArray,
    starts: FloatArray,
    iterations: int,
    damping0: float,
) -> tuple[FloatArray, FloatArray]:
    """Ends (s, n) of descents from ``starts`` (s, n) on ``Σ |H(q)M - M*|²``, and that sum (s,).

    ``points``, ``targets`` (m, 4) of equal heights. ``damping0``: the first damping, as a share of the information's
    mean diagonal.
    """
    s, n = starts.shape
    m = points.shape[0]
    ends = starts.copy()
    errors = np.empty(s)
    H = np.empty((4, 4))
    operators = np.empty((n, 4, 4))
    moved = np.empty((m, 4))
    rows = np.empty((n, m, 4))
    A = np.empty((n, n))
    L = np.zeros((n, n))
    g = np.empty(n)
    step = np.empty(n)
    trial = np.empty(n)
    weight = _sum_of_squares(generators.reshape(n * 4, 4)) * _sum_of_squares(points) / n
    for a in range(s):
        q = ends[a]
        chain_forward_into(generators, kinds, zero, q, H, operators, tip_first)
        transform_points_into(H, points, moved)
        error = _squared_error(moved, targets)
        share = damping0
        for _ in range(iterations):
            if not error > 0.0:
                break
            for j in range(n):
                transform_points_into(operators[j], moved, rows[j])
            trace = 0.0
            for j in range(n):
                total = 0.0
                for p in range(m):
                    for i in range(4):
                        total += rows[j, p, i] * (moved[p, i] - targets[p, i])
                g[j] = total
                for k in range(j + 1):
                    total = 0.0
                    for p in range(m):
                        for i in range(4):
                            total += rows[j, p, i] * rows[k, p, i]
                    A[j, k] = total
                trace += A[j, j]
            won = False
            small = False
            while share < 1e8:
                if _solve_damped(A, g, share * trace / n + IDLE * weight, L, step):
                    longest = 0.0
                    for j in range(n):
                        longest = max(longest, abs(step[j]))
                    factor = 1.0 if longest <= LONGEST else LONGEST / longest
                    for j in range(n):
                        trial[j] = q[j] + factor * step[j]
                    chain_forward_into(generators, kinds, zero, trial, H, operators, tip_first)
                    transform_points_into(H, points, moved)
                    reached = _squared_error(moved, targets)
                    if reached < error:
                        won = True
                        small = longest < 1e-15 or error - reached < STALLED * error
                        error = reached
                        for j in range(n):
                            q[j] = trial[j]
                        break
                    if longest < 1e-14:
                        break
                share = max(1e-15, 8.0 * share)
            if not won or small:
                break
            share = max(1e-15, 0.1 * share)
        errors[a] = error
    return ends, errors


def descended(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    starts: FloatArray,
    *,
    iterations: int = ITERATIONS,
    damping: float = 1e-2,
) -> tuple[FloatArray, FloatArray]:
    """`descend` on ``chain``: ends (s, n) and their residuals (s,), ``|H(q)M - M*| / |M*|`` over all points."""
    ends, errors = descend(
        chain.generators,
        chain.kind_codes,
        chain.zero,
        chain.tip_first,
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(targets, dtype=np.float64),
        np.ascontiguousarray(starts, dtype=np.float64),
        iterations,
        damping,
    )
    return ends, np.asarray(np.sqrt(errors) / np.linalg.norm(targets), dtype=np.float64)


def linearised(
    chain: ProjectiveChain, points: FloatArray, q: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``points`` (m, 4) moved to ``q`` (n,), ``∂(H(q)M)/∂q`` (4m, n) (5.38), and the operators (n, 4, 4) there."""
    H, operators = chain_forward(
        chain.generators, chain.kind_codes, chain.zero, np.ascontiguousarray(q), chain.tip_first
    )
    moved: FloatArray = points @ H.T
    return moved, (moved @ operators.transpose(0, 2, 1)).reshape(len(operators), -1).T, operators
