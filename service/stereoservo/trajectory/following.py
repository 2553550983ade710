"""The joints of an arm along a way of its body: damped Gauss-Newton steps on its points, sample by sample. Kernels.

The operators are those where the arm stands (Theorem 10), moved along with it; so any arm of `kinematics.composition`
follows, whatever its number of joints. The self-motion of a redundant arm keeps its joints away from their limits.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import displace, move_operators
from stereoservo.kinematics.kernels import kernel, multiply4_into
from stereoservo.kinematics.linear_kernels import add_equation, damped_solve, right_singular
from stereoservo.trajectory.rooms import Surroundings, check_joints, check_view, limit_pull, moved
from stereoservo.trajectory.ways import pose_on_way

ARRIVED = 1e-7
"""Distance of a point from its place, as a share of the cameras' distance: below a thousandth of a pixel."""
SETTLED = 1e-6
"""Largest joint step [rad or frame lengths] at which an arm that cannot follow is as near as it comes."""
ITERATIONS, LENIENT_ITERATIONS = 8, 3
"""At most, where the arm must arrive, and where it goes as near as it comes."""
STRIDE, STRIDE_PX = 0.1, 2.0
"""Joint step of a sample [rad or frame lengths] from which on what lies between is looked at; how far it may be off."""
DAMPING = 1e-9
"""Of the normal matrix, relative to its largest diagonal."""
LARGEST_STEP = 0.3
"""Of a joint in one iteration [rad or lengths]: larger ones lie beyond what a linear model says."""
SELF_MOTION = 0.08
"""Share of a joint's distance from the middle of its range that self-motion takes off in a sample, at the limit."""
FREEDOM_RATIO = 1e-3
"""Singular value of the operators, relative to the largest, below which a freedom is lost."""


@kernel
def freedoms(operators: FloatArray) -> int:
    """How many freedoms an arm with ``operators`` (n, 4, 4) in a motion frame has where it stands, at most 6."""
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
    operators: FloatArray, points: FloatArray, wanted: FloatArray, N: FloatArray, b: FloatArray
) -> float:
    """Of least ``Σ|Ĥ_j x Δq_j − (x* − x)|²``; the largest ``|x* − x|``."""
    n, m = operators.shape[0], points.shape[0]
    J = np.empty((3, n))
    worst = 0.0
    for i in range(n):
        b[i] = 0.0
        for k in range(n):
            N[i, k] = 0.0
    for p in range(m):
        length = 0.0
        for i in range(3):
            length += (wanted[p, i] - points[p, i]) ** 2
        worst = max(worst, length)
        for j in range(n):
            G = operators[j]
            for i in range(3):
                J[i, j] = G[i, 0] * points[p, 0] + G[i, 1] * points[p, 1] + G[i, 2] * points[p, 2] + G[i, 3]
        for i in range(3):
            add_equation(J[i], wanted[p, i] - points[p, i], 1.0, N, b)
    for i in range(n):
        for k in range(i):
            N[k, i] = N[i, k]
    return math.sqrt(worst)


@kernel
def move_arm(
    operators: FloatArray, composition: int, step: FloatArray, joints: FloatArray, displacement: FloatArray
) -> None:
    """Joints (n,), operators (n, 4, 4) and what has become of the body (4, 4) after ``step`` (n,), in place."""
    product = np.empty((4, 4))
    multiply4_into(displace(operators, composition, step), displacement, product)
    after = move_operators(operators, composition, step)
    for i in range(4):
        for k in range(4):
            displacement[i, k] = product[i, k]
    for j in range(joints.shape[0]):
        joints[j] += step[j]
        for i in range(4):
            for k in range(4):
                operators[j, i, k] = after[j, i, k]


@kernel
def reach(
    wanted: FloatArray,
    body: FloatArray,
    composition: int,
    redundant: bool,
    lower: FloatArray,
    upper: FloatArray,
    operators: FloatArray,
    joints: FloatArray,
    displacement: FloatArray,
    bias: FloatArray,
    iterations: int,
) -> float:
    """Move the arm, in place, until its ``body`` (m, 3) is at ``wanted`` (m, 3), or as near as it comes.

    ``bias`` (n,): what the first step was wrong by a sample ago; renewed. Returns the largest distance left.
    """
    n = joints.shape[0]
    N = np.empty((n, n))
    b = np.empty(n)
    x = np.empty(n)
    rest = np.zeros(n)
    worst = 0.0
    for iteration in range(iterations):
        points = moved(displacement, body)
        worst = _normal_equations(operators, points, wanted, N, b)
        if worst <= ARRIVED and (iteration > 0 or not redundant):
            break
        z = np.zeros(n)
        if redundant and iteration == 0:
            pull, half = limit_pull(joints, lower, upper)
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
        move_arm(operators, composition, x, joints, displacement)
        if size < SETTLED:
            worst = 0.0
            points = moved(displacement, body)
            for p in range(points.shape[0]):
                square = 0.0
                for i in range(3):
                    square += (wanted[p, i] - points[p, i]) ** 2
                worst = max(worst, math.sqrt(square))
            break
    for i in range(n):
        bias[i] = rest[i] if abs(rest[i]) < 0.1 * LARGEST_STEP else 0.0
    return worst


@kernel
def pixels_apart(cameras: FloatArray, kept: FloatArray, X: FloatArray, Y: FloatArray) -> tuple[float, int]:
    """Largest distance [px] between the images of points (m, 3) and (m, 3), and whose; infinite behind a camera."""
    worst, which = 0.0, 0
    for c in range(cameras.shape[0]):
        P = cameras[c]
        for p in range(X.shape[0]):
            if not kept[p] > 0.0:
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
def _places(way: FloatArray, share: float, body: FloatArray, rest: FloatArray) -> FloatArray:
    """Where the points (m, 3) of the body belong at ``share`` of the way, ``rest`` (m, 3) made up for on it."""
    points = moved(pose_on_way(way, share), body)
    for p in range(points.shape[0]):
        for i in range(3):
            points[p, i] += share * rest[p, i]
    return points


@kernel
def _astray_between(
    operators: FloatArray,
    composition: int,
    joints: FloatArray,
    displacement: FloatArray,
    joints_before: FloatArray,
    displacement_before: FloatArray,
    surroundings: Surroundings,
) -> tuple[float, int]:
    """How far [px] the body is off its way half-way between two samples, and which marker: near singularities joints
    run while the body hardly moves, and what lies between is not what was meant.
    """
    n = joints.shape[0]
    back = np.empty(n)
    stride = 0.0
    for j in range(n):
        back[j] = 0.5 * (joints_before[j] - joints[j])
        stride = max(stride, 2.0 * abs(back[j]))
    if not stride > STRIDE:
        return 0.0, 0
    half = np.empty((4, 4))
    multiply4_into(displace(operators, composition, back), displacement, half)
    middle = moved(displacement, surroundings.body)
    before = moved(displacement_before, surroundings.body)
    for p in range(middle.shape[0]):
        for i in range(3):
            middle[p, i] = 0.5 * (middle[p, i] + before[p, i])
    return pixels_apart(surroundings.cameras, surroundings.kept, moved(half, surroundings.body), middle)


@kernel
def _keep_sample(
    k: int,
    share: float,
    surroundings: Surroundings,
    joints: FloatArray,
    displacement: FloatArray,
    all_joints: FloatArray,
    all_displacements: FloatArray,
    table: FloatArray,
) -> int:
    """Sample ``k`` of the arm, kept and looked at: kind of limit broken or −1."""
    for j in range(joints.shape[0]):
        all_joints[k, j] = joints[j]
    for i in range(4):
        for r in range(4):
            all_displacements[k, i, r] = displacement[i, r]
    broken = check_joints(joints, share, surroundings, table)
    if broken < 0:
        broken = check_view(moved(displacement, surroundings.body), share, surroundings, table, True)
    return broken


@kernel
def check_way(
    way: FloatArray,
    first: int,
    last: int,
    samples: int,
    surroundings: Surroundings,
    rest: FloatArray,
    table: FloatArray,
) -> tuple[int, int]:
    """Samples ``first`` to before ``last`` of ``samples`` of the closed form: kind broken or −1, and where."""
    for k in range(first, last):
        share = k / (samples - 1.0)
        points = _places(way, share, surroundings.body, rest)
        broken = check_view(points, share, surroundings, table, True)
        if broken >= 0:
            return broken, k
    return -1, last


@kernel
def follow_way(
    way: FloatArray,
    first: int,
    last: int,
    samples: int,
    surroundings: Surroundings,
    rest: FloatArray,
    composition: int,
    redundant: bool,
    tolerance: float,
    operators: FloatArray,
    joints: FloatArray,
    displacement: FloatArray,
    bias: FloatArray,
    all_joints: FloatArray,
    all_displacements: FloatArray,
    table: FloatArray,
) -> tuple[int, int]:
    """The arm along samples ``first`` to before ``last``: kind of limit broken or −1, and where.

    ``rest`` (m, 3): what the end of the way leaves of each point's way to its goal, made up for on the way.
    ``operators``, ``joints``, ``displacement``, ``bias`` go along, in place; ``all_joints`` (samples, n) and
    ``all_displacements`` (samples, 4, 4) are filled. ``tolerance`` [px] between way and arm; beyond it the way is not
    reachable. It is infinite on the way, not at the end, for arms that lack freedoms.
    """
    s = surroundings
    for k in range(first, last):
        share = k / (samples - 1.0)
        if k > 0:
            wanted = _places(way, share, s.body, rest)
            firm = math.isfinite(tolerance) or k == samples - 1
            left = reach(
                wanted, s.body, composition, redundant, s.lower, s.upper, operators, joints, displacement, bias,
                ITERATIONS if firm else LENIENT_ITERATIONS,
            )  # fmt: skip
            apart, marker, limit = 0.0, 0, tolerance
            if left > ARRIVED:
                apart, marker = pixels_apart(s.cameras, s.kept, moved(displacement, s.body), wanted)
            if apart <= limit:
                limit = STRIDE_PX
                apart, marker = _astray_between(
                    operators,
                    composition,
                    joints,
                    displacement,
                    all_joints[k - 1],
                    all_displacements[k - 1],
                    s,
                )
            if not apart <= limit:
                table[5, 0], table[5, 1] = limit - apart, limit - apart
                table[5, 2], table[5, 3] = apart, limit
                table[5, 4], table[5, 5], table[5, 6] = -1.0, marker, share
                return 5, k
        broken = _keep_sample(k, share, s, joints, displacement, all_joints, all_displacements, table)
        if broken >= 0:
            return broken, k
    return -1, last


@kernel
def follow_joints(
    step: FloatArray,
    first: int,
    last: int,
    samples: int,
    surroundings: Surroundings,
    composition: int,
    operators: FloatArray,
    joints: FloatArray,
    displacement: FloatArray,
    all_joints: FloatArray,
    all_displacements: FloatArray,
    table: FloatArray,
) -> tuple[int, int]:
    """`follow_way` for a way that is straight in the joints, by ``step`` (n,) a sample."""
    for k in range(first, last):
        share = k / (samples - 1.0)
        if k > 0:
            move_arm(operators, composition, step, joints, displacement)
        broken = _keep_sample(
            k, share, surroundings, joints, displacement, all_joints, all_displacements, table
        )
        if broken >= 0:
            return broken, k
    return -1, last
