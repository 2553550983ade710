"""Numerical inverse kinematics of chains without a closed form: descent from many start configurations to all isolated
solutions, or to some solutions of a continuum.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError, distinct, nearest_turns
from stereoservo.kinematics.kernels import Chain, chain_forward, chain_forward_into, transform_points_into
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

BATCH = 64
FEWEST = 128
MOST = 4096
"""Number of starts of a search: per batch, at least, at most."""
HITS = 8
"""Number of starts that must converge to each solution before a search ends, so that few solutions are missed."""
TWINS = np.array([0.05, 0.2, 0.6])
"""Steps [rad] from a solution along its weakest direction, where the other solution of a close pair lies."""
POLISH = 1e-9
"""Damping of the refinement of a candidate: almost none."""
REFINEMENTS = 8
VALLEY = 1e-5
"""Residual up to which the end point of a descent without a solution counts as lying in a valley."""
VALLEY_ROUNDS, VALLEY_STEPS, UNDAMPED = 4, 500, 1e-15
CLOSE = 1e-5
"""Largest difference of joints [rad or m] of two descents that converged to the same solution."""


def even_starts(chain: ProjectiveChain, limits: FloatArray | None, count: int, skip: int = 0) -> FloatArray:
    """Start configurations (count, n) distributed evenly over the joints: a full turn, or limits (n, 2) for prismatic
    ones.

    Additive recurrence with powers of the root of ``x^(n+1) = x + 1``. Raises InverseKinematicsError, ``limits``, if a
    prismatic joint has none.
    """
    n = chain.joints
    ranges = np.array([[z - np.pi, z + np.pi] for z in chain.zero])
    slides = [j for j, kind in enumerate(chain.kinds) if kind == "prismatic"]
    if slides and (limits is None or not np.isfinite(limits[slides]).all()):
        raise InverseKinematicsError(
            "limits",
            f"prismatic joints {slides} need finite limits: a chain without a closed form is searched",
            joints=slides,
        )
    if limits is not None:
        ranges[slides] = limits[slides]
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (n + 1))
    steps = root ** -np.arange(1.0, n + 1)
    unit = np.mod(0.5 + np.arange(skip + 1, skip + count + 1)[:, None] * steps, 1.0)
    return np.asarray(ranges[:, 0] + unit * (ranges[:, 1] - ranges[:, 0]), dtype=np.float64)


def all_solutions(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    *,
    limits: FloatArray | None,
    tolerance: float,
    seed: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Isolated solutions (s, n) of ``H(q)M = M*`` with residuals (s,), and the closest approach (n,).

    The search ends when ``HITS`` starts have converged to every solution; the other solution of a close pair is
    searched for from the first one. It is likely, but not certain, that all are found.
    """
    known = _Known(chain, points, targets, tolerance)
    best, least = seed, np.inf
    tried = 0
    while tried < MOST:
        starts = even_starts(chain, limits, BATCH, tried)
        if tried == 0:
            starts[0] = seed
        ends, left = _along_valleys(chain, points, targets, starts, tolerance)
        tried += BATCH
        if left.min() < least:
            best, least = ends[int(np.argmin(left))], float(left.min())
        for i in known.add(ends, left, 1):
            twins = _twins(chain, points, known.joints[i])
            known.add(*run_descent(chain, points, targets, twins, damping=1e-6), 0)
        if tried >= FEWEST and min(known.hits, default=HITS) >= HITS:
            break
    return np.array(known.joints).reshape(-1, chain.joints), np.array(known.residuals), best


def _along_valleys(
    chain: ProjectiveChain, points: FloatArray, targets: FloatArray, starts: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray]:
    """End points (s, n) and residuals (s,) of descents; those that ended in a valley are continued to its minimum. Near
    a singular configuration the residual is almost zero along a curve of joint positions, and steps along it are short.
    """
    ends, left = run_descent(chain, points, targets, starts)
    slow = (left > tolerance) & (left <= VALLEY)
    for _ in range(VALLEY_ROUNDS):
        if not slow.any():
            break
        before = ends[slow]
        ends[slow], left[slow] = run_descent(chain, points, targets, before, iterations=VALLEY_STEPS, damping=UNDAMPED)
        slow[slow] = (left[slow] > tolerance) & (np.abs(ends[slow] - before).max(axis=1) > CLOSE)
    return ends, left


class _Known:
    """Solutions found so far, and the number of starts that converged to each."""

    def __init__(self, chain: ProjectiveChain, points: FloatArray, targets: FloatArray, tolerance: float) -> None:
        self.chain, self.points, self.targets, self.tolerance = chain, points, targets, tolerance
        self.joints: list[FloatArray] = []
        self.residuals: list[float] = []
        self.hits: list[int] = []

    def add(self, ends: FloatArray, left: FloatArray, count: int) -> list[int]:
        """Add those of ``ends`` (s, n) that solve the problem, each with ``count`` hits; returns the new ones'
        indices.
        """
        fresh = []
        solved = left <= self.tolerance
        ends, left = ends[solved], left[solved]
        while len(ends):
            # All descents that ended where the best of the remaining ones did; two solutions are farther apart.
            best = int(np.argmin(left))
            here = self._near(ends, ends[best])
            q, residual = ends[best], float(left[best])
            i = self._index(q)
            if i is None:
                q, residual, stays = self._refined(q)
                i = self._index(q)
                if i is None and (stays or not self.joints):
                    fresh.append(len(self.joints))
                    self.joints.append(q)
                    self.residuals.append(residual)
                    self.hits.append(count * int(here.sum()))
            if i is not None:
                self.hits[i] += count * int(here.sum())
                if residual < self.residuals[i]:
                    self.joints[i], self.residuals[i] = q, residual
            ends, left = ends[~here], left[~here]
        return fresh

    def _refined(self, q: FloatArray) -> tuple[FloatArray, float, bool]:
        """The end point ``q`` (n,) of a descent refined to convergence, its residual, and whether it converged. Near an
        almost double solution the damped steps are so small that a descent may end before it.
        """
        stays = False
        for _ in range(REFINEMENTS):
            before = q
            ends, left = run_descent(self.chain, self.points, self.targets, q[None], damping=POLISH)
            q = ends[0]
            stays = bool(np.abs(q - before).max() <= 0.1 * CLOSE)
            if stays:
                break
        return q, float(left[0]), stays

    def _index(self, q: FloatArray) -> int | None:
        known = self._near(np.array(self.joints).reshape(-1, len(q)), q)
        return int(np.argmax(known)) if known.any() else None

    def _near(self, rows: FloatArray, q: FloatArray) -> npt.NDArray[np.bool_]:
        difference = nearest_turns(self.chain.kinds, rows - q, np.zeros(len(q)))
        return np.asarray(np.abs(difference).max(axis=1, initial=0.0) <= CLOSE, dtype=bool)


def _twins(chain: ProjectiveChain, points: FloatArray, q: FloatArray) -> FloatArray:
    J = linearised(chain, points, q)[1]
    weakest = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])[2][-1]
    steps = np.concatenate([TWINS, -TWINS])
    return np.asarray(q + steps[:, None] * weakest, dtype=np.float64)


def one_solution(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    *,
    limits: FloatArray | None,
    tolerance: float,
    seed: FloatArray,
    count: int = BATCH,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solutions of a goal that does not determine all joints, from the ``seed`` (n,) first, then from ``count`` other
    starts.

    As `all_solutions`: (s, n), residuals (s,), closest approach (n,); without duplicates.
    """
    starts = np.concatenate([seed[None], even_starts(chain, limits, count - 1)])
    ends, left = run_descent(chain, points, targets, starts)
    best = ends[int(np.argmin(left))]
    solved = left <= tolerance
    kept = distinct(chain.kinds, ends[solved], CLOSE)
    return ends[solved][kept], left[solved][kept], best


ITERATIONS = 60
LONGEST = 0.7
"""Largest change of a joint in one step [rad or m]."""
STALLED = 1e-10
"""Relative decrease of the error below which a descent ends."""
IDLE = 1e-20
"""Minimum damping, relative to the largest possible motion of the points by the operators: a joint that the goal does
not determine stays at its position and is not moved by rounding errors.
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
    """Solve ``(A + damping·I) x = -g`` by Cholesky in ``L`` (n, n); False if the matrix is not positive definite."""
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
def _normal_equations_into(
    rows: FloatArray, moved: FloatArray, targets: FloatArray, A: FloatArray, g: FloatArray
) -> float:
    """Fill ``A = JᵀJ`` (n, n) (lower triangle) and ``g = Jᵀ(x − x*)`` (n,) from ``rows`` J (n, m, 4); returns the trace
    of ``A``.
    """
    n, m = rows.shape[0], rows.shape[1]
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
    return trace


@kernel
def descend(
    chain: Chain,
    points: FloatArray,
    targets: FloatArray,
    starts: FloatArray,
    iterations: int,
    damping0: float,
) -> tuple[FloatArray, FloatArray]:
    """End points (s, n) of descents from ``starts`` (s, n) on ``Σ |H(q)M - M*|²``, and that sum (s,).

    ``points``, ``targets`` (m, 4) of equal heights. ``damping0``: the first damping, relative to the mean diagonal of
    the information matrix.
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
    weight = _sum_of_squares(chain.generators.reshape(n * 4, 4)) * _sum_of_squares(points) / n
    for a in range(s):
        q = ends[a]
        chain_forward_into(chain, q, H, operators)
        transform_points_into(H, points, moved)
        error = _squared_error(moved, targets)
        damping = damping0
        for _ in range(iterations):
            if not error > 0.0:
                break
            for j in range(n):
                transform_points_into(operators[j], moved, rows[j])
            trace = _normal_equations_into(rows, moved, targets, A, g)
            won = False
            small = False
            while damping < 1e8:
                if _solve_damped(A, g, damping * trace / n + IDLE * weight, L, step):
                    longest = 0.0
                    for j in range(n):
                        longest = max(longest, abs(step[j]))
                    factor = 1.0 if longest <= LONGEST else LONGEST / longest
                    for j in range(n):
                        trial[j] = q[j] + factor * step[j]
                    chain_forward_into(chain, trial, H, operators)
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
                damping = max(1e-15, 8.0 * damping)
            if not won or small:
                break
            damping = max(1e-15, 0.1 * damping)
        errors[a] = error
    return ends, errors


def run_descent(
    chain: ProjectiveChain,
    points: FloatArray,
    targets: FloatArray,
    starts: FloatArray,
    *,
    iterations: int = ITERATIONS,
    damping: float = 1e-2,
) -> tuple[FloatArray, FloatArray]:
    """Run `descend` on ``chain``: end points (s, n) and residuals (s,), ``|H(q)M - M*| / |M*|`` over all points."""
    ends, errors = descend(
        Chain(chain.generators, chain.kind_codes, chain.zero, chain.tip_first),
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(targets, dtype=np.float64),
        np.ascontiguousarray(starts, dtype=np.float64),
        iterations,
        damping,
    )
    return ends, np.asarray(np.sqrt(errors) / np.linalg.norm(targets), dtype=np.float64)


def equivalent_points(points: FloatArray, targets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Four points and their targets (4, 4) for ``points`` and ``targets`` (m, 4): for every 4x4 H the sum of squares
    ``Σ |H M - M*|²`` is the same up to the constant that no H explains, and its derivatives are the same.
    """
    Q, R = np.linalg.qr(points)
    return np.ascontiguousarray(R), np.ascontiguousarray(Q.T @ targets)


def linearised(chain: ProjectiveChain, points: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``points`` (m, 4) moved to ``q`` (n,), ``∂(H(q)M)/∂q`` (4m, n) (5.38), and the operators (n, 4, 4) there."""
    H, operators = chain_forward(
        chain.generators, chain.kind_codes, chain.zero, np.ascontiguousarray(q), chain.tip_first
    )
    moved: FloatArray = points @ H.T
    return moved, (moved @ operators.transpose(0, 2, 1)).reshape(len(operators), -1).T, operators
