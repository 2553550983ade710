"""Inverse kinematics in metric coordinates: reference of the projective solver, vectorised over poses.

Axes are lines of Euclidean space, lengths and angles are measured; joints are eliminated in another order than
in `stereoservo.kinematics.inverse` if there is a choice. Solutions are (N, s, n) [rad or m], NaN for missing branches.
Six revolute joints without a closed form: Newton's method from many random starts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

CONSISTENT = 1e-7
"""Largest distance [m] of a branch's end from its goal."""


@dataclass(frozen=True, eq=False)
class EuclideanAxes:
    """Axes at joint angles zero: unit ``directions`` (n, 3), ``points`` (n, 3) on them [m]; ``revolute`` (n,)."""

    directions: FloatArray
    points: FloatArray
    revolute: npt.NDArray[np.bool_]

    def part(self, joints: slice) -> EuclideanAxes:
        """Axes of some of the joints."""
        return EuclideanAxes(self.directions[joints], self.points[joints], self.revolute[joints])

    def twists(self) -> FloatArray:
        """Generators (n, 4, 4)."""
        twists = np.zeros((len(self.directions), 4, 4))
        for T, w, c, turns in zip(twists, self.directions, self.points, self.revolute, strict=True):
            if turns:
                T[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
                T[:3, 3] = -np.cross(w, c)
            else:
                T[:3, 3] = w
        return twists

    def displacements(self, q: FloatArray) -> FloatArray:
        """Products (N, 4, 4) of the joints' motions at ``q`` (N, n), base first."""
        H = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        for j, (w, c) in enumerate(zip(self.directions, self.points, strict=True)):
            step = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
            if self.revolute[j]:
                for k in range(3):
                    step[:, :3, k] = turned(w, q[:, j], np.broadcast_to(np.eye(3)[k], (len(q), 3)))
                step[:, :3, 3] = c - step[:, :3, :3] @ c
            else:
                step[:, :3, 3] = q[:, j, None] * w
            H = H @ step
        return H


def turned(w: FloatArray, angle: FloatArray, v: FloatArray) -> FloatArray:
    """Vectors ``v`` (N, 3) rotated about unit ``w`` (3,) by ``angle`` (N,) (Rodrigues)."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.asarray(c * v + s * np.cross(w, v) + (1 - c) * (v @ w)[:, None] * w, dtype=np.float64)


def about(w: FloatArray, c: FloatArray, angle: FloatArray, p: FloatArray) -> FloatArray:
    """Points (N, 3) rotated about an axis."""
    return c + turned(w, angle, p - c)


def angle_between(w: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Angle (N,) about unit ``w`` from ``u`` (N, 3) to ``v`` (N, 3)."""
    across_u, across_v = u - (u @ w)[:, None] * w, v - (v @ w)[:, None] * w
    sine = (np.cross(across_u, across_v) @ w).astype(np.float64)
    return np.asarray(np.arctan2(sine, (across_u * across_v).sum(axis=1)), dtype=np.float64)


def harmonic_roots(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Both roots (N, 2) of ``a cosθ + b sinθ = c``; NaN if there are none."""
    size = np.hypot(a, b)
    with np.errstate(invalid="ignore", divide="ignore"):
        half = np.arccos(np.where(np.abs(c) <= size, c / size, np.nan))
    middle = np.arctan2(b, a)
    return np.stack([middle + half, middle - half], axis=1)


def projected_roots(
    w: FloatArray, p: FloatArray, centre: FloatArray, along: FloatArray, height: FloatArray
) -> FloatArray:
    """Angles (N, 2) about the axis (w, centre) at which points ``p`` (N, 3) have ``along·p = height`` (N,)."""
    arm = p - centre
    axial = (arm @ w)[:, None] * w
    across = arm - axial
    return harmonic_roots(across @ along, np.cross(w, across) @ along, height - (centre + axial) @ along)


def prismatic(axes: EuclideanAxes, p: FloatArray, goal: FloatArray) -> FloatArray:
    """Solutions (N, 1, n) of prismatic joints."""
    return np.asarray(((goal - p) @ np.linalg.pinv(axes.directions.T).T)[:, None], dtype=np.float64)


def revolute(axes: EuclideanAxes, p: FloatArray, goal: FloatArray) -> FloatArray:
    """Solutions (N, 1, 1) of one revolute joint."""
    w, c = axes.directions[0], axes.points[0]
    return angle_between(w, p - c, goal - c)[:, None, None]


def two_revolute(axes: EuclideanAxes, p: FloatArray, goal: FloatArray) -> FloatArray:
    """Solutions (N, 2, 2) of two joints: the second first, by the height along the first axis, checked by the radius
    about it.
    """
    (w1, w2), (c1, c2) = axes.directions, axes.points
    seconds = projected_roots(w2, p, c2, w1, goal @ w1)
    return _with_first(w1, c1, w2, c2, p, goal, seconds)


def two_parallel(axes: EuclideanAxes, p: FloatArray, goal: FloatArray) -> FloatArray:
    """Solutions (N, 2, 2) of two parallel joints: the second first, by the squared distance from the first axis."""
    (w1, w2), (c1, c2) = axes.directions, axes.points
    arm = p - c2
    arm = arm - (arm @ w2)[:, None] * w2
    between = (c2 - c1) - ((c2 - c1) @ w1) * w1
    wanted = (goal - c1) - ((goal - c1) @ w1)[:, None] * w1
    rest = (wanted**2).sum(axis=1) - (arm**2).sum(axis=1) - between @ between
    seconds = harmonic_roots(2.0 * arm @ between, 2.0 * np.cross(w2, arm) @ between, rest)
    return _with_first(w1, c1, w2, c2, p, goal, seconds)


def _with_first(
    w1: FloatArray,
    c1: FloatArray,
    w2: FloatArray,
    c2: FloatArray,
    p: FloatArray,
    goal: FloatArray,
    seconds: FloatArray,
) -> FloatArray:
    branches = []
    for second in seconds.T:
        moved = about(w2, c2, second, p)
        first = angle_between(w1, moved - c1, goal - c1)
        off = np.linalg.norm(about(w1, c1, first, moved) - goal, axis=1)
        both = np.stack([first, second], axis=1)
        both[~(off <= CONSISTENT)] = np.nan
        branches.append(both)
    return np.stack(branches, axis=1)


def arm(axes: EuclideanAxes, p: FloatArray, goal: FloatArray) -> FloatArray:
    """Solutions (N, 4, 3) of an arm's first three joints."""
    w1, c1, w2 = axes.directions[0], axes.points[0], axes.directions[1]
    found = []
    for first in projected_roots(-w1, goal, c1, w2, p @ w2).T:
        rest = two_parallel(axes.part(slice(1, 3)), p, about(-w1, c1, first, goal))
        found.append(np.concatenate([np.broadcast_to(first[:, None, None], (len(first), 2, 1)), rest], axis=2))
    return np.concatenate(found, axis=1)


def wrist(axes: EuclideanAxes, R: FloatArray) -> FloatArray:
    """Solutions (N, 2, 3) of rotation matrices (N, 3, 3): the middle joint first, by the angle between the outer
    axes.
    """
    w1, w2, w3 = axes.directions
    n = len(R)
    last, turned_last = np.broadcast_to(w3, (n, 3)), R @ w3
    other = np.broadcast_to(_square_to(w3), (n, 3))
    found = []
    for middle in projected_roots(w2, last, np.zeros(3), w1, turned_last @ w1).T:
        first = angle_between(w1, turned(w2, middle, last), turned_last)
        back = turned(-w2, middle, turned(-w1, first, R @ _square_to(w3)))
        found.append(np.stack([first, middle, angle_between(w3, other, back)], axis=1))
    return np.stack(found, axis=1)


def _square_to(w: FloatArray) -> FloatArray:
    v = np.cross(w, np.eye(3)[int(np.argmin(np.abs(w)))])
    return np.asarray(v / np.linalg.norm(v), dtype=np.float64)


def crossing(axes: EuclideanAxes, first: int, second: int) -> FloatArray:
    """The point (3,) nearest to two axes."""
    rows = [np.eye(3) - np.outer(axes.directions[j], axes.directions[j]) for j in (first, second)]
    side = [row @ axes.points[j] for row, j in zip(rows, (first, second), strict=True)]
    return np.asarray(np.linalg.lstsq(np.vstack(rows), np.concatenate(side))[0], dtype=np.float64)


def with_wrist(axes: EuclideanAxes, H: FloatArray) -> FloatArray:
    """Solutions (N, 8, 6) of an arm, (N, 2, 6) of a gantry: first three joints by the wrist's centre."""
    centre = crossing(axes, 3, 4)
    p = np.broadcast_to(centre, (len(H), 3))
    goal = H[:, :3, :3] @ centre + H[:, :3, 3]
    first, last = axes.part(slice(0, 3)), axes.part(slice(3, 6))
    place = arm(first, p, goal) if axes.revolute[0] else prismatic(first, p, goal)
    found = []
    for branch in np.moveaxis(place, 1, 0):
        rotations = first.displacements(branch)[:, :3, :3]
        turns = wrist(last, np.swapaxes(rotations, 1, 2) @ H[:, :3, :3])
        wide = np.broadcast_to(branch[:, None], (len(H), turns.shape[1], 3))
        found.append(np.concatenate([wide, turns], axis=2))
    return np.concatenate(found, axis=1)


def three_parallel(axes: EuclideanAxes, H: FloatArray) -> FloatArray:
    """Solutions (N, 8, 6) of an arm whose axes 2, 3, 4 are parallel and whose axes 5, 6 intersect: an offset wrist."""
    z, w = axes.directions[1], axes.directions
    R, n = H[:, :3, :3], len(H)
    centre = crossing(axes, 4, 5)
    goal = R @ centre + H[:, :3, 3]
    firsts = projected_roots(-w[0], goal, axes.points[0], z, np.full(n, centre @ z))
    found = []
    for first in firsts.T:
        towards = np.einsum("nji,nj->ni", R, turned(w[0], first, np.broadcast_to(z, (n, 3))))
        still = np.broadcast_to(z, (n, 3))
        for fifth in projected_roots(-w[4], still, np.zeros(3), w[5], towards @ w[5]).T:
            sixth = angle_between(w[5], towards, turned(-w[4], fifth, still))
            outer = np.stack([fifth, sixth], axis=1)
            before = EuclideanAxes(w[:1], axes.points[:1], axes.revolute[:1]).displacements(first[:, None])
            after = axes.part(slice(4, 6)).displacements(outer)
            middle = np.linalg.inv(before) @ H @ np.linalg.inv(after)
            p = np.broadcast_to(axes.points[3], (n, 3))
            lifted = (middle @ np.append(axes.points[3], 1.0))[:, :3]
            pair = two_parallel(axes.part(slice(1, 3)), p, lifted)
            for branch in np.moveaxis(pair, 1, 0):
                left = np.linalg.inv(axes.part(slice(1, 3)).displacements(branch)) @ middle
                u = _square_to(w[3])
                fourth = angle_between(w[3], np.broadcast_to(u, (n, 3)), left[:, :3, :3] @ u)
                found.append(np.column_stack([first, branch, fourth, outer]))
    return np.stack(found, axis=1)


# -- six revolute joints ---------------------------------------------------------------------------------------

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
    # The effect of the rotation about the origin on the current position is not part of the remaining translation.
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
