"""Search for a feasible path among alternatives (time profiles, senses of rotation, bent paths, straight lines in joint
space): a state machine that evaluates a given number of samples per call.

The alternatives, cheapest first: other profiles, senses and kinds of rotation, bent centre lines. A bend displaces the
centre by ``4σ(1 − σ) b``, ``b`` a displacement (a point of the plane at infinity): away from the cameras or towards
them, to the right or left and down or up in the images.

``CLOSED_FORM``: a path in closed form, checked in the images alone. ``FOLLOW_PATH``: inverse kinematics along it. If
the arm cannot follow the requested path, ``UNCONSTRAINED_IK`` follows it again without limits, which gives the joints
at the goal, and ``STRAIGHT_IN_JOINTS`` tries the straight line in joint space to them. If all others fail,
``MULTISTART_IK`` finds other joints at the goal from many seeds, and ``STRAIGHT_IN_JOINTS`` tries these. If a request
has a ``posture``, it is the only seed.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import msgspec
import numpy as np

from stereoservo.kinematics.composition import Composition
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import Fields, kernel, plain
from stereoservo.planning.motion_frame import (
    EXPONENTIAL,
    FIRST,
    LAST,
    LINEAR,
    NUMBERS,
    conjugate_all,
    pose_on_path,
    rotation_between,
)
from stereoservo.planning.path_ik import (
    FULL_TURN,
    SEEDS,
    Arm,
    CandidatePath,
    FollowSettings,
    PathRecord,
    SampleRange,
    check_path,
    follow_joint_line,
    follow_path,
    joints_from_seed,
    move_arm,
    pixel_distance,
    seed_joints,
)
from stereoservo.planning.plan import ClosestApproach, Plan, PlanRequest, Profile
from stereoservo.planning.primitives import HINGE, PLANAR, RIGID_FREEDOMS, TRANSLATION
from stereoservo.planning.tracking import interpolate_into
from stereoservo.planning.visibility_constraints import (
    JOINT_LIMIT,
    KEEP_OUT,
    KINDS,
    NOT_REACHABLE,
    Constraints,
    check_joints,
    empty_table,
    moved,
    writable_copy,
)

SAMPLES = 65
"""Number of samples of a path: half a turn in steps of three degrees."""
TOLERANCE_PX = 2.0
"""Largest distance in the images between the path and the arm that follows it, and between its end and the goal."""
WORK_OF_ARM = 16
"""Work of one sample of the arm, in units of one sample in closed form."""
WORK_OF_PATH = 8
"""Work of setting up one path, in the same unit."""
WORK_OF_SEED = 20 * WORK_OF_ARM
"""Work of inverse kinematics at the goal from one seed, in the same unit."""
MOST_FOLLOWED = 120
"""Number of paths that the arm follows before the search ends."""
GOAL_MISSED = 30
"""Number of followed paths that a path counts for if it misses the goal because of missing degrees of freedom: others
will hardly do better.
"""
GOAL_BEYOND = 90
"""Number of followed paths to count if the goal itself is beyond a joint's limit, unless it is reachable with other
turns of the joints.
"""

POSTURE = 0.35
"""Largest distance of a joint [rad or m] at the goal from the requested posture."""
AT_GOAL = 1e-6
"""Distance of the joints from those at the goal [rad or m] up to which they are at the goal."""

MISSING_FREEDOMS = (TRANSLATION, HINGE, PLANAR)
"""Components to which the ``index`` of an approach NOT_REACHABLE refers."""

AWAY = (0.0, 0.12, 0.25, 0.45, 0.7, -0.12, -0.25)
"""Bends away from the cameras, as fractions of their distance from the centre."""
ASIDE = (0.0, 0.07, -0.07, 0.15, -0.15, 0.25, -0.25)
"""Bends to the right and down, likewise."""
PROFILES: tuple[Profile, ...] = ("linear", "translation-first", "rotation-first", "planar-first")
PROFILE_COST = 0.06
TURN_COSTS = (0.0, 0.08, 0.2, 0.3, 0.4)
"""Costs of the kinds of rotation, in the order of `planner.rotation_variants`, in units of the bends."""
SHAPES: dict[Profile, tuple[float, float, float]] = {
    "linear": (LINEAR, LINEAR, LINEAR),
    "exponential": (EXPONENTIAL, EXPONENTIAL, EXPONENTIAL),
    "translation-first": (FIRST, LAST, LAST),
    "rotation-first": (LAST, FIRST, FIRST),
    "planar-first": (LAST, LAST, FIRST),
}
"""Shapes of translation, hinge and planar rotation for each profile (`motion_frame`)."""


class Candidate(NamedTuple):
    """One path: ``turning`` of `planner.rotation_variants`, ``profile`` 0 is the requested one, ``bend`` away, right,
    down.
    """

    turning: int
    profile: int
    bend: tuple[float, float, float]


def _ordered() -> tuple[Candidate, ...]:
    listed: list[tuple[float, int, Candidate]] = []
    for away in AWAY:
        for right in ASIDE:
            for down in ASIDE:
                size = math.sqrt(away * away + right * right + down * down)
                for turning, cost in enumerate(TURN_COSTS):
                    for profile in range(len(PROFILES) + 1):
                        total = size + cost + (PROFILE_COST if profile else 0.0)
                        listed.append((total, len(listed), Candidate(turning, profile, (away, right, down))))
    return tuple(candidate for _, _, candidate in sorted(listed))


CANDIDATES = _ordered()
"""All candidate paths; the first is the straight one with the requested profile."""


class Stage(IntEnum):
    """Kind of the next samples."""

    CLOSED_FORM = 0
    FOLLOW_PATH = 1
    UNCONSTRAINED_IK = 2
    STRAIGHT_IN_JOINTS = 3
    MULTISTART_IK = 4


CLOSED_FORM, STRAIGHT_IN_JOINTS = int(Stage.CLOSED_FORM), int(Stage.STRAIGHT_IN_JOINTS)
"""The stages as integers, for kernels."""


class PlanningState(msgspec.Struct, eq=False):
    """State of planning between two slices. ``finished``: there is a ``plan``, or a ``failure``.

    ``failure``: the failures of the goal itself, if any, of the requested path, and of the alternative path that came
    farthest. ``frame`` (4, 4) and its ``inverse``: the motion frame; ``goal`` (m, 3) in it. ``operators``, ``joints``,
    ``displacement`` (4, 4): the arm at ``sample`` of the path number ``candidate``; ``table``: closest approaches so
    far.
    """

    request: PlanRequest
    frame: FloatArray
    inverse: FloatArray
    constraints: Constraints = msgspec.field(name="surroundings")
    goal: FloatArray
    residual: FloatArray = msgspec.field(name="rest")
    directions: FloatArray
    rotation_variants: FloatArray
    useful: tuple[bool, ...]
    centre_translation: FloatArray = msgspec.field(name="centre_way")
    start_operators: FloatArray
    rank: int
    path: FloatArray = msgspec.field(name="way")
    operators: FloatArray
    joints: FloatArray
    displacement: FloatArray
    bias: FloatArray
    all_joints: FloatArray
    all_displacements: FloatArray
    table: FloatArray
    joint_step: FloatArray
    revolute: FloatArray = msgspec.field(name="turns")
    candidate: int = -1
    stage: int = int(Stage.CLOSED_FORM)
    sample: int = 0
    followed: int = 0
    tried: int = 0
    end_joints_sought: bool = msgspec.field(name="looked", default=False)
    seeds: int = 0
    goal_failure: ClosestApproach | None = None
    requested_failure: ClosestApproach | None = msgspec.field(name="asked_failure", default=None)
    best_failure: ClosestApproach | None = None
    finished: bool = False
    plan: Plan | None = None
    failure: tuple[ClosestApproach, ...] = ()


def continue_planning(planning: PlanningState, samples: float) -> None:
    """Evaluate at most ``samples`` samples of paths, at least one (samples in closed form count a sixteenth)."""
    p = planning
    work = max(1, round(samples * WORK_OF_ARM))
    while work > 0 and not p.finished:
        if p.stage == Stage.MULTISTART_IK:
            _next_seed(p)
            work -= WORK_OF_SEED
            continue
        cost = 1 if p.stage == Stage.CLOSED_FORM else WORK_OF_ARM
        count = max(1, min(SAMPLES - p.sample, work // cost))
        broken, reached = _samples(p, p.sample + count)
        work -= cost * (reached - p.sample + 1)
        p.sample = reached
        if broken >= 0:
            _fail(p, broken)
        elif reached == SAMPLES:
            _finish_stage(p)
        if p.sample == 0:
            work -= WORK_OF_PATH


def next_candidate(planning: PlanningState) -> None:
    """Set up the next candidate path that differs from the previous ones; finish if there is none."""
    p = planning
    p.stage, p.sample = int(Stage.CLOSED_FORM), 0
    p.table = empty_table()
    while p.followed < MOST_FOLLOWED and p.candidate + 1 < len(CANDIDATES):
        p.candidate += 1
        candidate = CANDIDATES[p.candidate]
        if not p.useful[candidate.turning] or not (p.request.bend or _straight(candidate)):
            continue
        profile = other_profile(p.request.profile, candidate.profile)
        if profile is None:
            continue
        path = path_coefficients(
            candidate, profile, p.rotation_variants[candidate.turning], p.centre_translation, p.directions
        )
        if candidate.profile > 1 and float(np.abs(path[14:]).max()) == LINEAR:
            continue  # only one component: identical to the linear path
        p.path = path
        p.tried += 1
        return
    if p.request.bend and p.request.composition != Composition.SIMULTANEOUS:
        p.stage = int(Stage.MULTISTART_IK)
    else:
        _finish_without_plan(p)


def _finish_without_plan(p: PlanningState) -> None:
    p.finished = True
    p.failure = tuple(f for f in (p.goal_failure, p.requested_failure, p.best_failure) if f is not None)


def go_to_posture(planning: PlanningState) -> None:
    """Plan for the requested posture only."""
    planning.stage, planning.sample = int(Stage.MULTISTART_IK), 0


def _next_seed(p: PlanningState) -> None:
    """Find the joints at the goal from the next seed; if within the limits, the straight line to them is tried next."""
    if p.seeds >= SEEDS:
        _finish_without_plan(p)
        return
    if p.request.posture is not None:
        _from_posture(p, p.request.posture)
        return
    joints, arrived = _from_seed(p, p.seeds)
    p.seeds += 1
    if arrived and int(check_joints(joints, 1.0, p.constraints, empty_table())) < 0:
        _straight_to(p, joints)


def _from_posture(p: PlanningState, posture: FloatArray) -> None:
    """Find the joints at the goal from the ``posture`` (n,) alone, with the same number of full turns; a failure states
    the distance of the markers from the goal in that posture.
    """
    p.seeds = SEEDS
    joints, arrived = _from_joints(p, posture)
    joints -= FULL_TURN * np.round((joints - posture) / FULL_TURN) * p.revolute
    if arrived and float(np.abs(joints - posture).max()) <= POSTURE:
        table = empty_table()
        broken = int(check_joints(joints, 1.0, p.constraints, table))
        if broken < 0 and float(np.abs(joints - p.request.joints).max()) <= AT_GOAL:
            plan_without_motion(p)
        elif broken < 0:
            _straight_to(p, joints)
        else:
            p.table = table
            p.goal_failure = closest_approach(p, broken)
        return
    distance, marker = _distance_in_posture(posture, p.constraints, p.goal, _arm_at_start(p))
    clearance = TOLERANCE_PX - distance
    p.table[NOT_REACHABLE] = (clearance, clearance, distance, TOLERANCE_PX, -1.0, marker, 1.0)
    p.goal_failure = closest_approach(p, NOT_REACHABLE)


def plan_without_motion(planning: PlanningState) -> None:
    """Finish with a plan of zero duration: the goal is the current pose."""
    p = planning
    start_arm(p, Stage.STRAIGHT_IN_JOINTS)
    broken, _ = _samples(p, 1)
    if broken >= 0:
        p.failure = (closest_approach(p, broken),)
    else:
        p.plan = Plan(
            times=np.zeros(1),
            joints=p.all_joints[:1].copy(),
            displacements=np.eye(4)[None],
            path_parameters=np.ones(1),
            description="none: the goal is where the body is",
            approaches=_approaches(p),
        )
    p.finished = True


def start_arm(planning: PlanningState, stage: Stage) -> None:
    """Reset the arm to its current joints, for ``stage``."""
    p = planning
    p.stage, p.sample = int(stage), 0
    p.operators = p.start_operators.copy()
    p.joints = np.array(p.request.joints, dtype=np.float64)
    p.displacement = np.eye(4)
    p.bias = np.zeros(len(p.joints))
    p.table = empty_table()


def _samples(p: PlanningState, until: int) -> tuple[int, int]:
    """Evaluate samples of the current stage before ``until``; returns the kind of violated limit or −1, and the last
    sample.
    """
    unconstrained = p.stage == Stage.UNCONSTRAINED_IK
    # an arm with missing degrees of freedom leaves the path between its ends
    tolerance = TOLERANCE_PX if p.rank == RIGID_FREEDOMS and not unconstrained else math.inf
    constraints = _unlimited(p.constraints) if unconstrained else p.constraints
    broken, reached = _evaluate_samples(
        (int(p.stage), p.path, p.residual, p.joint_step),
        (p.sample, until),
        plain(constraints),
        (int(p.request.composition), p.operators, p.joints, p.displacement, p.bias),
        (len(p.joints) > p.rank, tolerance),
        (p.all_joints, p.all_displacements, p.table),
    )
    return int(broken), int(reached)


@kernel
def _evaluate_samples(
    candidate: Fields, some: Fields, constraints: Fields, arm: Fields, settings: Fields, record: Fields
) -> tuple[int, int]:
    """Evaluate samples of a candidate path (`path_ik`), given the fields of all records; returns the kind of the
    violated limit or −1, and the sample.
    """
    path, span = CandidatePath(*candidate), SampleRange(*some)
    bounds, samples = Constraints(*constraints), PathRecord(*record)
    if path.stage == CLOSED_FORM:
        return check_path(path, span, bounds, samples)
    if path.stage == STRAIGHT_IN_JOINTS:
        return follow_joint_line(path, span, bounds, Arm(*arm), samples)
    return follow_path(path, span, bounds, Arm(*arm), FollowSettings(*settings), samples)


def _unlimited(constraints: Constraints) -> Constraints:
    s = constraints
    return s._replace(
        must_stay_visible=np.zeros_like(s.must_stay_visible),
        sides=np.zeros_like(s.sides),
        lower=np.full_like(s.lower, -np.inf),
        upper=np.full_like(s.upper, np.inf),
        keep_outs=s.keep_outs[:0].copy(),
    )


def _fail(p: PlanningState, kind: int) -> None:
    if kind == NOT_REACHABLE:
        p.table[kind, 4] = _missing_freedom(p)
    failure = closest_approach(p, kind)
    if p.tried == 1 and p.requested_failure is None:
        p.requested_failure = failure
    elif p.best_failure is None or failure.path_parameter > p.best_failure.path_parameter:
        p.best_failure = failure
    if p.stage == Stage.FOLLOW_PATH and kind in (JOINT_LIMIT, KEEP_OUT, NOT_REACHABLE) and not p.end_joints_sought:
        p.end_joints_sought = True
        start_arm(p, Stage.UNCONSTRAINED_IK)
    elif p.seeds > 0:
        p.stage, p.sample = int(Stage.MULTISTART_IK), 0
    else:
        next_candidate(p)


def _finish_stage(p: PlanningState) -> None:
    """Continue after the last sample of a stage."""
    if p.stage == Stage.CLOSED_FORM:
        p.followed += 1
        start_arm(p, Stage.FOLLOW_PATH)
        return
    distance, marker = _distance_from_goal(p.displacement, p.constraints, p.goal)
    missed = not distance <= TOLERANCE_PX
    if p.stage == Stage.UNCONSTRAINED_IK:
        _continue_from_goal_joints(p, missed)
    elif missed:
        p.followed += GOAL_MISSED
        clearance = TOLERANCE_PX - distance
        p.table[NOT_REACHABLE] = (clearance, clearance, distance, TOLERANCE_PX, -1.0, marker, 1.0)
        _fail(p, NOT_REACHABLE)
    else:
        _accept_path(p)


@kernel
def _distance_from_goal(displacement: FloatArray, constraints: Constraints, goal: FloatArray) -> tuple[float, int]:
    """`pixel_distance` of the body after its ``displacement`` (4, 4) from the ``goal`` (m, 3)."""
    s = constraints
    return pixel_distance(s.cameras, s.must_stay_visible, moved(displacement, s.body), goal)


@kernel
def _distance_in_posture(
    posture: FloatArray, constraints: Constraints, goal: FloatArray, start: Arm
) -> tuple[float, int]:
    """`_distance_from_goal` with the arm of ``start`` in a ``posture`` (n,)."""
    displacement = np.eye(4)
    arm = Arm(start.composition, start.operators.copy(), start.joints.copy(), displacement, start.bias.copy())
    move_arm(arm, posture - start.joints)
    return _distance_from_goal(displacement, constraints, goal)


def _continue_from_goal_joints(p: PlanningState, missed: bool) -> None:
    """Continue with the nearer of the joints at the requested path's end and those of a direct step to the goal."""
    start, s = writable_copy(p.request.joints), p.constraints
    found, table = [], empty_table()
    if not missed:
        broken = int(check_joints(p.joints, 1.0, s, table))
        if broken < 0:
            found.append(p.joints)
        else:
            p.table = table
            p.goal_failure = closest_approach(p, broken)
            p.followed += GOAL_BEYOND
    if p.request.composition != Composition.SIMULTANEOUS and (p.request.bend or p.rank < RIGID_FREEDOMS):
        joints, arrived = _from_seed(p, 0)
        if arrived and int(check_joints(joints, 1.0, s, empty_table())) < 0:
            found.append(joints)
        if found:
            nearest = min(found, key=lambda q: float(np.abs(q - start).max()))
            _straight_to(p, nearest)
            return
    next_candidate(p)


def _from_seed(p: PlanningState, nth: int) -> tuple[FloatArray, bool]:
    s = p.constraints
    return _from_joints(p, seed_joints(nth, p.request.joints, s.lower, s.upper))


def _from_joints(p: PlanningState, seed: FloatArray) -> tuple[FloatArray, bool]:
    joints, arrived = joints_from_seed(writable_copy(seed), p.goal, p.constraints, p.revolute, _arm_at_start(p))
    return joints, bool(arrived)


def _arm_at_start(p: PlanningState) -> Arm:
    start = writable_copy(p.request.joints)
    return Arm(int(p.request.composition), p.start_operators, start, np.eye(4), np.zeros(len(start)))


def _straight_to(p: PlanningState, joints: FloatArray) -> None:
    p.goal_failure = None  # it belongs to another posture, not to the goal
    p.joint_step = (joints - p.request.joints) / (SAMPLES - 1.0)
    start_arm(p, Stage.STRAIGHT_IN_JOINTS)


def _accept_path(p: PlanningState) -> None:
    r = p.request
    velocity_max, acceleration_max = (
        r.speed_scale * r.limits.velocity_max,
        r.speed_scale * r.limits.acceleration_max,
    )
    pace = JointPace(velocity_max, acceleration_max, r.profile == "exponential")
    times, displacements = _in_time(p.all_joints, p.all_displacements, p.frame, p.inverse, pace)
    candidate = CANDIDATES[p.candidate]
    profile = other_profile(r.profile, candidate.profile) or r.profile
    p.plan = Plan(
        times=times,
        joints=p.all_joints.copy(),
        displacements=displacements,
        path_parameters=np.arange(SAMPLES) / (SAMPLES - 1.0),
        description="straight in the joints"
        if p.stage == Stage.STRAIGHT_IN_JOINTS
        else path_description(candidate, profile),
        approaches=_approaches(p),
    )
    p.finished = True


@kernel
def _in_time(
    joints: FloatArray, displacements: FloatArray, frame: FloatArray, inverse: FloatArray, pace: JointPace
) -> tuple[FloatArray, FloatArray]:
    """`sample_times` (K,) of ``joints`` (K, n), and their ``displacements`` (K, 4, 4) outside the motion ``frame``."""
    times = sample_times(joints, pace.velocity_max, pace.acceleration_max, pace.even)
    return times, conjugate_all(frame, displacements, inverse)


def _straight(candidate: Candidate) -> bool:
    return candidate.profile == 0 and candidate.bend == (0.0, 0.0, 0.0) and candidate.turning in (0, 2)


def _missing_freedom(p: PlanningState) -> float:
    """Index in `MISSING_FREEDOMS` of the largest component of the body's distance from its pose on the path."""
    body = p.constraints.body
    required = p.goal
    if p.stage != Stage.STRAIGHT_IN_JOINTS:
        required = moved(pose_on_path(p.path, float(p.table[NOT_REACHABLE, 6])), body)
    here = moved(p.displacement, body)
    rotation = rotation_between(here, required)
    offsets = body - body.sum(axis=0) / len(body)
    size = math.sqrt(float((offsets * offsets).sum(axis=1).max()))
    shift = (required - here).sum(axis=0) / len(body)
    if math.sqrt(float((shift * shift).sum())) / size >= float(rotation[3]):
        return 0.0
    normal = face_normal(here, p.constraints.faces)
    if normal is None:
        return 1.0
    return 2.0 if abs(float((normal * rotation[:3]).sum())) > math.sqrt(0.5) else 1.0


def _approaches(p: PlanningState) -> tuple[ClosestApproach, ...]:
    return tuple(closest_approach(p, kind) for kind in range(NOT_REACHABLE) if p.table[kind, 0] < math.inf)


def closest_approach(planning: PlanningState, kind: int) -> ClosestApproach:
    """Closest approach to one kind of limit, from its row of the table."""
    row = planning.table[kind]
    index = int(row[4])
    unit = ("", "", "px", "deg", "of its depth now", "px")[kind]
    if kind in (JOINT_LIMIT, KEEP_OUT):
        joint = index if kind == JOINT_LIMIT else 0
        unit = "rad" if planning.revolute[joint] > 0.0 else "m"
    return ClosestApproach(
        KINDS[kind], index, float(row[2]), float(row[3]), unit, float(row[1]), float(row[6]), int(row[5])
    )


def face_normal(points: FloatArray, faces: IntArray) -> FloatArray | None:
    """Unit normal (3,) of the first face of ``points`` (m, 3); None without faces."""
    if len(faces) == 0:
        return None
    a, b, c = (points[int(i)] for i in faces[0])
    u, v = b - a, c - a
    normal = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    unit: FloatArray = normal / math.sqrt(float((normal * normal).sum()))
    return unit


# -- alternative paths ----------------------------------------------------------------------------------------


def shapes(profile: Profile, amounts: tuple[float, float, float]) -> tuple[float, float, float]:
    """Profile shapes for components of ``amounts``; linear if all moving components have the same shape."""
    own = SHAPES[profile]
    at_work = {shape for shape, amount in zip(own, amounts, strict=True) if amount != 0.0}
    if profile == "exponential" or len(at_work) > 1:
        return own
    return SHAPES["linear"]


def path_coefficients(
    candidate: Candidate,
    profile: Profile,
    turning: FloatArray,
    displacement: FloatArray,
    directions: FloatArray,
) -> FloatArray:
    """The numbers (17,) of `pose_on_path` for one candidate."""
    path = np.zeros(NUMBERS)
    path[:8] = turning
    path[8:11] = displacement
    for amount, direction in zip(candidate.bend, directions, strict=True):
        path[11:14] += amount * direction
    amounts = (float(np.abs(displacement).max()), float(turning[3]), float(turning[7]))
    path[14:] = shapes(profile, amounts)
    return path


def other_profile(asked: Profile, nth: int) -> Profile | None:
    """Profile number ``nth`` of a candidate; None if it equals the requested one."""
    if nth == 0:
        return asked
    profile = PROFILES[nth - 1]
    return None if profile == asked else profile


def path_description(candidate: Candidate, profile: Profile) -> str:
    """Description of a path for the operator."""
    kinds = ("", "one rotation", "the other way round", "planar rotation the other way round")
    kind = (*kinds, "one rotation the other way round")[candidate.turning]
    words = (("away from the cameras", "towards the cameras"), ("right", "left"), ("down", "up"))
    bends = [
        f"{positive if amount > 0.0 else negative} by {abs(amount):g}"
        for amount, (positive, negative) in zip(candidate.bend, words, strict=True)
        if amount != 0.0
    ]
    return ", ".join(part for part in (profile, kind, "bent " + " and ".join(bends) if bends else "") if part)


# -- time scaling --------------------------------------------------------------------------------------------
# Time-optimal scaling of a path: the fastest times that keep the joints' velocity and acceleration limits.
#
# The pace ``x = ṡ²`` along the samples ``s`` is bounded by the velocities, its slope ``2s̈`` by the accelerations ``q'
# s̈ + q'' ṡ²``; both are linear in ``x``, so that a backward pass (from which pace can the arm still stop?) and a
# greedy forward pass give the fastest times (Pham and Pham, 2018). Starts and ends at rest.


FASTEST = 1e8
"""Largest pace [(samples/s)²]: if no joint moves, a sample lasts a ten-thousandth of a second."""
HALVINGS = 50
ROUNDS = 12
"""Largest number of times that the pace is reduced where rates between samples exceed those at the samples."""
CHECKS_PER_INTERVAL = 4
"""Number of points in an interval at which its rates are checked."""
VELOCITY_EXCESS, ACCELERATION_EXCESS = 1.01, 1.25
"""Largest velocity and mean acceleration in an interval of the cubics between samples, relative to the limits."""


@kernel
def _next_paces(
    slope: FloatArray, bow: FloatArray, limits: FloatArray, pace: float, ceiling: float
) -> tuple[float, float]:
    """Least and largest pace after an interval that begins with ``pace``; none if the first exceeds the second."""
    least, largest = 0.0, ceiling
    for j in range(slope.shape[0]):
        if not math.isfinite(limits[j]):
            continue
        # q' (x⁺ − x)/2 + q'' x within the limit at the start, likewise with x⁺ at the end
        for end in range(2):
            if end == 0:
                rate = slope[j] - 0.5 * bow[j]
                ahead, now = 0.5 * rate, (bow[j] - 0.5 * rate) * pace
            else:
                rate = slope[j] + 0.5 * bow[j]
                ahead, now = 0.5 * rate + bow[j], -0.5 * rate * pace
            if ahead > 0.0:
                largest = min(largest, (limits[j] - now) / ahead)
                least = max(least, (-limits[j] - now) / ahead)
            elif ahead < 0.0:
                largest = min(largest, (-limits[j] - now) / ahead)
                least = max(least, (limits[j] - now) / ahead)
            elif abs(now) > limits[j]:
                largest = -1.0
    return least, largest


@kernel
def _times_below(
    slopes: FloatArray, bows: FloatArray, highest: FloatArray, acceleration_max: FloatArray, even: bool
) -> tuple[FloatArray, FloatArray]:
    """Least times (K,) for which the paces at the samples do not exceed ``highest`` (K,); and these paces (K,)."""
    K = highest.shape[0]
    times, paces = np.zeros(K), np.zeros(K)
    ceilings = highest.copy()
    if even:
        lowest = FASTEST
        for k in range(K):
            lowest = min(lowest, ceilings[k])
        for k in range(K):
            ceilings[k] = lowest
    ceilings[0] = 0.0
    ceilings[K - 1] = 0.0
    for back in range(K - 1):
        k = K - 2 - back
        least, largest = _next_paces(slopes[k], bows[k], acceleration_max, ceilings[k], ceilings[k + 1])
        if least <= largest:
            continue
        low, high = 0.0, ceilings[k]
        for _ in range(HALVINGS):
            midpoint = 0.5 * (low + high)
            least, largest = _next_paces(slopes[k], bows[k], acceleration_max, midpoint, ceilings[k + 1])
            if least <= largest:
                low = midpoint
            else:
                high = midpoint
        ceilings[k] = low
    pace = 0.0
    for k in range(K - 1):
        least, largest = _next_paces(slopes[k], bows[k], acceleration_max, pace, ceilings[k + 1])
        after = max(0.0, largest)
        if k == K - 2:
            after = 0.0
        both = math.sqrt(pace) + math.sqrt(after)
        if both <= 0.0:
            # from rest to rest in one interval: half of it for each
            duration = 0.0
            for j in range(slopes.shape[1]):
                if math.isfinite(acceleration_max[j]):
                    duration = max(duration, 2.0 * math.sqrt(abs(slopes[k, j]) / acceleration_max[j]))
            times[k + 1] = times[k] + max(duration, 1.0 / math.sqrt(FASTEST))
        else:
            times[k + 1] = times[k] + 2.0 / both
        pace = after
        paces[k + 1] = pace
    return times, paces


@kernel
def _excess(
    times: FloatArray, joints: FloatArray, velocity_max: FloatArray, acceleration_max: FloatArray, k: int
) -> float:
    """Factor by which the pace in interval ``k`` must be reduced; 1 if it need not be."""
    n = joints.shape[1]
    q, rates, first = np.empty(n), np.empty(n), np.empty(n)
    duration = times[k + 1] - times[k]
    found = 1.0
    for check in range(CHECKS_PER_INTERVAL + 1):
        # the last point is the end, where the next interval begins with the same rates
        interpolate_into(times, joints, times[k] + duration * check / CHECKS_PER_INTERVAL, q, rates)
        for j in range(n):
            speed = abs(rates[j])
            if speed > VELOCITY_EXCESS * velocity_max[j] and velocity_max[j] > 0.0:
                found = max(found, (speed / velocity_max[j]) ** 2)
            if check == 0:
                first[j] = rates[j]
            elif check == CHECKS_PER_INTERVAL:
                change = abs(rates[j] - first[j]) / duration
                if change > ACCELERATION_EXCESS * acceleration_max[j] and acceleration_max[j] > 0.0:
                    found = max(found, change / acceleration_max[j])
    return found


class JointPace(NamedTuple):
    """Speed limits of the joints: ``velocity_max`` (n,) [rad/s or m/s], ``acceleration_max`` (n,) [rad/s² or m/s²], and
    whether the samples have an ``even`` (constant) pace.
    """

    velocity_max: FloatArray
    acceleration_max: FloatArray
    even: bool


@kernel
def sample_times(joints: FloatArray, velocity_max: FloatArray, acceleration_max: FloatArray, even: bool) -> FloatArray:
    """Times (K,) [s] from 0 of the samples ``joints`` (K, n), with limits (n,), infinite if there is none.

    ``even``: the samples have a constant pace, as far as the accelerations allow.
    """
    K, n = joints.shape
    times = np.zeros(K)
    if K < 2:
        return times
    slopes = np.empty((K - 1, n))
    for k in range(K - 1):
        for j in range(n):
            slopes[k, j] = joints[k + 1, j] - joints[k, j]
    bows = np.zeros((K - 1, n))
    for k in range(K - 1):
        for j in range(n):
            before = slopes[k, j] - slopes[k - 1, j] if k > 0 else slopes[min(k + 1, K - 2), j] - slopes[k, j]
            after = slopes[k + 1, j] - slopes[k, j] if k < K - 2 else before
            bows[k, j] = 0.5 * (before + after)
    ceilings = np.full(K, FASTEST)
    for k in range(K):
        for j in range(n):
            steepest = 0.0
            if k > 0:
                steepest = max(abs(slopes[k - 1, j]), abs(slopes[k - 1, j] + 0.5 * bows[k - 1, j]))
            if k < K - 1:
                steepest = max(steepest, abs(slopes[k, j]), abs(slopes[k, j] - 0.5 * bows[k, j]))
            if steepest > 0.0 and math.isfinite(velocity_max[j]):
                ceilings[k] = min(ceilings[k], (velocity_max[j] / steepest) ** 2)
    times, paces = _times_below(slopes, bows, ceilings, acceleration_max, even)
    for _ in range(ROUNDS):
        lowered = False
        factors = np.ones(K)
        for k in range(K - 1):
            excess = _excess(times, joints, velocity_max, acceleration_max, k)
            if excess > 1.0:
                lowered = True
                factors[k] = max(factors[k], excess)
                factors[k + 1] = max(factors[k + 1], excess)
        if not lowered:
            break
        for k in range(K):
            if factors[k] > 1.0:
                ceilings[k] = min(ceilings[k], paces[k]) / factors[k]
        times, paces = _times_below(slopes, bows, ceilings, acceleration_max, even)
    return times
