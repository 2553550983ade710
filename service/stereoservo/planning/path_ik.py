"""Numba kernels of inverse kinematics along a path of the body, by damped Gauss-Newton steps sample by sample, with
checks of all limits; and for a goal pose from many start values.

The operators are those at the current joints (Theorem 10), updated as the arm moves; so any arm of
`kinematics.composition` can be used, with any number of joints. The self-motion of a redundant arm keeps its joints
away from their limits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.kinematics.composition import displace, move_operators
from stereoservo.kinematics.kernels import multiply4_into
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import add_equation, damped_solve, right_singular
from stereoservo.planning.motion_frame import pose_on_path
from stereoservo.planning.visibility_constraints import (
    Constraints,
    check_joints,
    check_view,
    limit_pull,
    moved,
)

ARRIVED = 1e-7
"""Distance of a point from its required position at which it has arrived, as a fraction of the cameras' distance: below
a thousandth of a pixel.
"""
SETTLED = 1e-6
"""Largest joint step [rad or frame lengths] at which an arm that cannot reach the target has converged."""
ITERATIONS, LENIENT_ITERATIONS = 8, 3
"""Largest number of iterations if the arm must arrive, and if it only needs to come as near as possible."""
STRIDE, STRIDE_PX = 0.1, 2.0
"""Joint step of a sample [rad or frame lengths] from which on the midpoint is checked too; tolerance there [px]."""
DAMPING = 1e-9
"""Damping of the normal matrix, relative to its largest diagonal element."""
BY_MOMENTS = 64
"""Number of markers above which the normal equations are formed from the body's moments."""
LARGEST_STEP = 0.3
"""Largest step of a joint in one iteration [rad or frame lengths]: the linear model does not hold for larger ones."""
SELF_MOTION = 0.08
"""Fraction by which self-motion reduces a joint's distance from the middle of its range in one sample, at the limit."""
FREEDOM_RATIO = 1e-3
"""Singular value of the operators, relative to the largest, below which a degree of freedom is lost."""


class Arm(NamedTuple):
    """State of an arm that moves along a path, in a motion frame; updated in place.

    ``composition`` as in `kinematics.composition`; current ``operators`` (n, 4, 4) and ``joints`` (n,),
    ``displacement`` (4, 4) of its body so far, ``bias`` (n,): error of the first step of the previous sample.
    """

    composition: int
    operators: FloatArray
    joints: FloatArray
    displacement: FloatArray
    bias: FloatArray


class PathRecord(NamedTuple):
    """Samples of an arm along a path: ``joints`` (K, n), ``displacements`` (K, 4, 4), and the closest approaches so
    far, ``table`` (6, 7).
    """

    joints: FloatArray
    displacements: FloatArray
    table: FloatArray


@kernel
def freedoms(operators: FloatArray) -> int:
    """Number of degrees of freedom, at most 6, of an arm with ``operators`` (n, 4, 4) in a motion frame."""
    n = operators.shape[0]
    stacked = np.empty((6, n))
    for j in range(n):
        stacked[0, j], stacked[1, j], stacked[2, j] = (
            operators[j, 2, 1],
            operators[j, 0, 2],
            operators[j, 1, 0],
        )
        for i in range(3):
            stacked[3 + i, j] = operators[j, i, 3]
    _, values = right_singular(stacked)
    rank = 0
    while rank < min(n, 6) and values[rank] > FREEDOM_RATIO * values[0]:
        rank += 1
    return rank


@kernel
def _normal_equations(
    operators: FloatArray, points: FloatArray, required: FloatArray, N: FloatArray, b: FloatArray
) -> float:
    """Form the normal equations ``N``, ``b`` of least ``Σ|Ĥ_j x Δq_j − (x* − x)|²``; returns the largest
    ``|x* − x|``.
    """
    n, m = operators.shape[0], points.shape[0]
    if m > BY_MOMENTS:
        return _normal_equations_by_moments(operators, points, required, N, b)
    J = np.empty((3, n))
    worst = 0.0
    for i in range(n):
        b[i] = 0.0
        for k in range(n):
            N[i, k] = 0.0
    for p in range(m):
        length = 0.0
        for i in range(3):
            length += (required[p, i] - points[p, i]) ** 2
        worst = max(worst, length)
        for j in range(n):
            G = operators[j]
            for i in range(3):
                J[i, j] = G[i, 0] * points[p, 0] + G[i, 1] * points[p, 1] + G[i, 2] * points[p, 2] + G[i, 3]
        for i in range(3):
            add_equation(J[i], required[p, i] - points[p, i], 1.0, N, b)
    for i in range(n):
        for k in range(i):
            N[k, i] = N[i, k]
    return math.sqrt(worst)


@kernel
def _normal_equations_by_moments(
    operators: FloatArray, points: FloatArray, required: FloatArray, N: FloatArray, b: FloatArray
) -> float:
    """As `_normal_equations`, from the moments ``S = Σ x xᵀ`` (4, 4) and ``C = Σ (x* − x) xᵀ`` (3, 4): one pass over
    the body.

    ``N_ik = tr(Ĥ_i S Ĥ_kᵀ)``, ``b_i = tr(Ĥ_i Cᵀ)``, of the upper three rows.
    """
    S, C = np.zeros((4, 4)), np.zeros((3, 4))
    x, rate = np.ones(4), np.empty(3)
    worst = 0.0
    for p in range(points.shape[0]):
        length = 0.0
        for i in range(3):
            x[i] = points[p, i]
            rate[i] = required[p, i] - points[p, i]
            length += rate[i] * rate[i]
        worst = max(worst, length)
        for i in range(4):
            for k in range(i + 1):
                S[i, k] += x[i] * x[k]
        for i in range(3):
            for k in range(4):
                C[i, k] += rate[i] * x[k]
    for i in range(4):
        for k in range(i):
            S[k, i] = S[i, k]
    moved_moments = np.empty((3, 4))
    for j in range(operators.shape[0]):
        b[j] = 0.0
        for r in range(3):
            for k in range(4):
                moved_moments[r, k] = 0.0
                for i in range(4):
                    moved_moments[r, k] += operators[j, r, i] * S[i, k]
                b[j] += operators[j, r, k] * C[r, k]
        for other in range(j + 1):
            total = 0.0
            for r in range(3):
                for k in range(4):
                    total += moved_moments[r, k] * operators[other, r, k]
            N[j, other] = N[other, j] = total
    return math.sqrt(worst)


@kernel
def move_arm(arm: Arm, step: FloatArray) -> None:
    """Move the arm by ``step`` (n,), in place."""
    product = np.empty((4, 4))
    multiply4_into(displace(arm.operators, arm.composition, step), arm.displacement, product)
    after = move_operators(arm.operators, arm.composition, step)
    for i in range(4):
        for k in range(4):
            arm.displacement[i, k] = product[i, k]
    for j in range(arm.joints.shape[0]):
        arm.joints[j] += step[j]
        for i in range(4):
            for k in range(4):
                arm.operators[j, i, k] = after[j, i, k]


@kernel
def reach(required: FloatArray, constraints: Constraints, arm: Arm, redundant: bool, iterations: int) -> float:
    """Move the arm in place so that its body is as near as possible to ``required`` (m, 3), in at most ``iterations``
    steps; returns the largest remaining distance of a point.

    ``redundant``: the arm has self-motion, which keeps its joints away from their limits.
    """
    body, bias = constraints.body, arm.bias
    n = arm.joints.shape[0]
    N = np.empty((n, n))
    b = np.empty(n)
    x = np.empty(n)
    rest = np.zeros(n)
    worst = 0.0
    for iteration in range(iterations):
        points = moved(arm.displacement, body)
        worst = _normal_equations(arm.operators, points, required, N, b)
        if worst <= ARRIVED and (iteration > 0 or not redundant):
            break
        z = np.zeros(n)
        if redundant and iteration == 0:
            pull, half = limit_pull(arm.joints, constraints.lower, constraints.upper)
            for i in range(n):
                z[i] = SELF_MOTION * half[i] * pull[i]
            for i in range(n):
                for k in range(n):
                    b[i] -= N[i, k] * z[k]
        damped_solve(N, b, DAMPING, x)
        size = 0.0
        for i in range(n):
            x[i] += z[i]
            if iteration == 0:
                x[i] += bias[i]
            size = max(size, abs(x[i]))
        if not math.isfinite(size):
            break
        if size > LARGEST_STEP:
            for i in range(n):
                x[i] *= LARGEST_STEP / size
        if iteration > 0:
            for i in range(n):
                rest[i] += x[i]
        else:
            for i in range(n):
                rest[i] = bias[i]
        move_arm(arm, x)
        if size < SETTLED:
            worst = 0.0
            points = moved(arm.displacement, body)
            for p in range(points.shape[0]):
                square = 0.0
                for i in range(3):
                    square += (required[p, i] - points[p, i]) ** 2
                worst = max(worst, math.sqrt(square))
            break
    for i in range(n):
        bias[i] = rest[i] if abs(rest[i]) < 0.1 * LARGEST_STEP else 0.0
    return worst


@kernel
def pixel_distance(
    cameras: FloatArray, must_stay_visible: FloatArray, X: FloatArray, Y: FloatArray
) -> tuple[float, int]:
    """Largest distance [px] between the images of points ``X`` (m, 3) and ``Y`` (m, 3), and the index of that point;
    infinite behind a camera.
    """
    worst, which = 0.0, 0
    for c in range(cameras.shape[0]):
        P = cameras[c]
        for p in range(X.shape[0]):
            if not must_stay_visible[p] > 0.0:
                continue
            d = P[2, 0] * X[p, 0] + P[2, 1] * X[p, 1] + P[2, 2] * X[p, 2] + P[2, 3]
            g = P[2, 0] * Y[p, 0] + P[2, 1] * Y[p, 1] + P[2, 2] * Y[p, 2] + P[2, 3]
            if not (d > 0.0 and g > 0.0):
                return math.inf, p
            square = 0.0
            for r in range(2):
                square += (
                    (P[r, 0] * X[p, 0] + P[r, 1] * X[p, 1] + P[r, 2] * X[p, 2] + P[r, 3]) / d
                    - (P[r, 0] * Y[p, 0] + P[r, 1] * Y[p, 1] + P[r, 2] * Y[p, 2] + P[r, 3]) / g
                ) ** 2
            if square > worst:
                worst, which = square, p
    return math.sqrt(worst), which


@kernel
def _points_on_path(path: FloatArray, path_parameter: float, body: FloatArray, residual: FloatArray) -> FloatArray:
    """Required points (m, 3) of the body on the path, with the proportional part of the ``residual`` (m, 3)."""
    points = moved(pose_on_path(path, path_parameter), body)
    for p in range(points.shape[0]):
        for i in range(3):
            points[p, i] += path_parameter * residual[p, i]
    return points


@kernel
def _deviation_between(
    arm: Arm, joints_before: FloatArray, displacement_before: FloatArray, constraints: Constraints
) -> tuple[float, int]:
    """Distance [px] of the body from its path half-way between two samples, and the index of the marker.

    Near singularities the joints move fast while the body hardly moves, and the body may leave the path between
    samples.
    """
    s = constraints
    n = arm.joints.shape[0]
    back = np.empty(n)
    stride = 0.0
    for j in range(n):
        back[j] = 0.5 * (joints_before[j] - arm.joints[j])
        stride = max(stride, 2.0 * abs(back[j]))
    if not stride > STRIDE:
        return 0.0, 0
    half = np.empty((4, 4))
    multiply4_into(displace(arm.operators, arm.composition, back), arm.displacement, half)
    midpoint = moved(arm.displacement, s.body)
    before = moved(displacement_before, s.body)
    for p in range(midpoint.shape[0]):
        for i in range(3):
            midpoint[p, i] = 0.5 * (midpoint[p, i] + before[p, i])
    return pixel_distance(s.cameras, s.must_stay_visible, moved(half, s.body), midpoint)


@kernel
def _record_sample(k: int, path_parameter: float, constraints: Constraints, arm: Arm, record: PathRecord) -> int:
    """Record sample ``k`` of the arm and check it; returns the kind of the violated limit or −1."""
    for j in range(arm.joints.shape[0]):
        record.joints[k, j] = arm.joints[j]
    for i in range(4):
        for r in range(4):
            record.displacements[k, i, r] = arm.displacement[i, r]
    broken = check_joints(arm.joints, path_parameter, constraints, record.table)
    if broken < 0:
        broken = check_view(moved(arm.displacement, constraints.body), path_parameter, constraints, record.table, True)
    return broken


class CandidatePath(NamedTuple):
    """Candidate path of a ``stage`` of `path_search`: a ``path`` of the body in closed form (`motion_frame`) with
    ``residual`` (m, 3), the distance of each point from its goal at the path's end, distributed over the path; or a
    straight line in joint space with ``joint_step`` (n,) per sample.
    """

    stage: int
    path: FloatArray
    residual: FloatArray
    joint_step: FloatArray


class SampleRange(NamedTuple):
    """Samples of a path, from ``first`` up to, but not including, ``last``."""

    first: int
    last: int


class FollowSettings(NamedTuple):
    """Settings of an arm that follows a path. ``redundant``: it has self-motion, which keeps its joints away from their
    limits; ``tolerance`` [px] between path and arm: beyond it the path is not reachable; infinite for arms with missing
    degrees of freedom, which leave the path between its ends.
    """

    redundant: bool
    tolerance: float


@kernel
def check_path(
    candidate: CandidatePath, some: SampleRange, constraints: Constraints, record: PathRecord
) -> tuple[int, int]:
    """Check ``some`` samples of a path in closed form; returns the kind of the violated limit or −1, and the sample.
    Updates the table of closest approaches in ``record``.
    """
    samples = record.joints.shape[0]
    for k in range(some.first, some.last):
        path_parameter = k / (samples - 1.0)
        points = _points_on_path(candidate.path, path_parameter, constraints.body, candidate.residual)
        broken = check_view(points, path_parameter, constraints, record.table, True)
        if broken >= 0:
            return broken, k
    return -1, some.last


@kernel
def follow_path(
    candidate: CandidatePath,
    some: SampleRange,
    constraints: Constraints,
    arm: Arm,
    settings: FollowSettings,
    record: PathRecord,
) -> tuple[int, int]:
    """Move the arm along ``some`` samples of a path; returns the kind of the violated limit or −1, and the sample.

    The arm is updated in place; ``record`` is filled.
    """
    s = constraints
    redundant, tolerance = settings
    samples = record.joints.shape[0]
    for k in range(some.first, some.last):
        path_parameter = k / (samples - 1.0)
        if k > 0:
            required = _points_on_path(candidate.path, path_parameter, s.body, candidate.residual)
            firm = math.isfinite(tolerance) or k == samples - 1
            left = reach(required, s, arm, redundant, ITERATIONS if firm else LENIENT_ITERATIONS)
            distance, marker, limit = 0.0, 0, tolerance
            if left > ARRIVED:
                distance, marker = pixel_distance(
                    s.cameras, s.must_stay_visible, moved(arm.displacement, s.body), required
                )
            if distance <= limit:
                limit = STRIDE_PX
                distance, marker = _deviation_between(arm, record.joints[k - 1], record.displacements[k - 1], s)
            if not distance <= limit:
                table = record.table
                table[5, 0], table[5, 1] = limit - distance, limit - distance
                table[5, 2], table[5, 3] = distance, limit
                table[5, 4], table[5, 5], table[5, 6] = -1.0, marker, path_parameter
                return 5, k
        broken = _record_sample(k, path_parameter, s, arm, record)
        if broken >= 0:
            return broken, k
    return -1, some.last


@kernel
def follow_joint_line(
    candidate: CandidatePath, some: SampleRange, constraints: Constraints, arm: Arm, record: PathRecord
) -> tuple[int, int]:
    """As `follow_path`, along a straight line in joint space."""
    samples = record.joints.shape[0]
    for k in range(some.first, some.last):
        if k > 0:
            move_arm(arm, candidate.joint_step)
        broken = _record_sample(k, k / (samples - 1.0), constraints, arm, record)
        if broken >= 0:
            return broken, k
    return -1, some.last


SEEDS = 32
ROUNDS = 5
"""Largest number of calls of `reach` from one seed."""
FULL_TURN = 2.0 * math.pi
_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53)


def seed_joints(nth: int, joints: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Element ``nth`` of a low-discrepancy sequence of joints (n,) over the joint ranges; element 0: the current
    joints.

    An unbounded range ends half a turn, or one length of the frame, beyond the current position.
    """
    if nth == 0:
        return joints.copy()
    low = np.where(np.isfinite(lower), np.maximum(lower, joints - FULL_TURN), joints - 0.5 * FULL_TURN)
    high = np.where(np.isfinite(upper), np.minimum(upper, joints + FULL_TURN), joints + 0.5 * FULL_TURN)
    shares = np.array([math.sqrt(_PRIMES[j % len(_PRIMES)]) * nth % 1.0 for j in range(len(joints))])
    seed: FloatArray = low + shares * (high - low)
    return seed


@kernel
def joints_from_seed(
    seed: FloatArray, goal: FloatArray, constraints: Constraints, revolute: FloatArray, start: Arm
) -> tuple[FloatArray, bool]:
    """Joints (n,) that bring the body to the ``goal`` (m, 3), found from ``seed`` (n,); and whether they were found.

    ``start``: the arm at the current pose, not modified. Revolute joints (``revolute`` (n,), 1 or 0) are changed by
    full turns into their limits, near their current positions.
    """
    joints, lower, upper = start.joints, constraints.lower, constraints.upper
    n = joints.shape[0]
    at = joints.copy()
    displacement = np.zeros((4, 4))
    for i in range(4):
        displacement[i, i] = 1.0
    arm = Arm(start.composition, start.operators.copy(), at, displacement, np.zeros(n))
    move_arm(arm, seed - joints)
    left = math.inf
    for _ in range(ROUNDS):
        arm.bias[:] = 0.0
        left = reach(goal, constraints, arm, False, ITERATIONS)
        if left <= ARRIVED:
            break
    for j in range(n):
        if revolute[j] > 0.0 and math.isfinite(at[j]):
            at[j] -= FULL_TURN * math.floor((at[j] - joints[j]) / FULL_TURN + 0.5)
            if at[j] > upper[j]:
                at[j] -= FULL_TURN
            elif at[j] < lower[j]:
                at[j] += FULL_TURN
    return at, left <= ARRIVED
