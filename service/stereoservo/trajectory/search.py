"""The search for a feasible way as a machine of stages, each of which can stop after any sample.

``IMAGES``: a way in closed form, in the images alone. ``FOLLOWS``: the arm along it. Where the arm cannot follow the
way that was asked for, ``LOOKS`` takes it along once more without limits, to learn the joints at the goal, and
``JOINTS`` tries the way that is straight in these. When all else has failed, ``SEEKS`` finds other joints at the goal
(`seeking`), and ``JOINTS`` tries these.
"""

from __future__ import annotations

import math
from enum import IntEnum

import msgspec
import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import Composition
from stereoservo.trajectory.bending import CANDIDATES, Candidate, name_of, other_profile, way_of
from stereoservo.trajectory.following import check_way, follow_joints, follow_way, pixels_apart
from stereoservo.trajectory.motion_frame import conjugated, turn_between
from stereoservo.trajectory.plan import Approach, IntArray, Plan, PlanRequest
from stereoservo.trajectory.primitives import HINGE, PLANAR, RIGID_FREEDOMS, TRANSLATION
from stereoservo.trajectory.profiles import LINEAR
from stereoservo.trajectory.rooms import (
    JOINT_LIMIT,
    KEEP_OUT,
    KINDS,
    NOT_REACHABLE,
    Surroundings,
    check_joints,
    empty_table,
    moved,
)
from stereoservo.trajectory.seeking import SEEDS, joints_from_seed, seed_joints
from stereoservo.trajectory.sights import own
from stereoservo.trajectory.time_scaling import sample_times
from stereoservo.trajectory.ways import pose_on_way

SAMPLES = 65
"""Of a way: half a turn in steps of three degrees."""
TOLERANCE_PX = 2.0
"""Largest distance in the images between the way and the arm that follows it, and between its end and the goal."""
WORK_OF_ARM = 16
"""Work of one sample of the arm, in samples of the closed form in the images."""
WORK_OF_WAY = 8
"""Work of setting up one way, likewise."""
WORK_OF_SEED = 20 * WORK_OF_ARM
"""Work of seeking the goal from one seed, likewise."""
MOST_FOLLOWED = 120
"""Ways that the arm is taken along before the search ends."""
GOAL_MISSED = 30
"""What a way counts that ends beside the goal, for want of freedoms: few others will do better."""
GOAL_BEYOND = 90
"""What it counts that the goal itself is beyond a joint's limit, unless joints turn there another way."""

MISSING_FREEDOMS = (TRANSLATION, HINGE, PLANAR)
"""What the ``index`` of an approach NOT_REACHABLE names."""


class Stage(IntEnum):
    """What the next samples are of."""

    IMAGES = 0
    FOLLOWS = 1
    LOOKS = 2
    JOINTS = 3
    SEEKS = 4


class Planning(msgspec.Struct, eq=False):
    """Work on a plan, between two slices. ``finished``: there is a ``plan``, or a ``failure``.

    ``failure``: that of the goal itself, where it has one, that of the asked way, that of the other way that came
    farthest. ``frame`` (4, 4) and its ``inverse``: the motion frame; ``goal`` (m, 3) in it. ``operators``, ``joints``,
    ``displacement`` (4, 4): the arm at ``sample`` of the way number ``candidate``; ``table``: closest
    approaches so far.
    """

    request: PlanRequest
    frame: FloatArray
    inverse: FloatArray
    surroundings: Surroundings
    goal: FloatArray
    rest: FloatArray
    directions: FloatArray
    turnings: FloatArray
    useful: tuple[bool, ...]
    centre_way: FloatArray
    start_operators: FloatArray
    rank: int
    way: FloatArray
    operators: FloatArray
    joints: FloatArray
    displacement: FloatArray
    bias: FloatArray
    all_joints: FloatArray
    all_displacements: FloatArray
    table: FloatArray
    joint_step: FloatArray
    turns: FloatArray
    candidate: int = -1
    stage: int = int(Stage.IMAGES)
    sample: int = 0
    followed: int = 0
    tried: int = 0
    looked: bool = False
    seeds: int = 0
    goal_failure: Approach | None = None
    asked_failure: Approach | None = None
    best_failure: Approach | None = None
    finished: bool = False
    plan: Plan | None = None
    failure: tuple[Approach, ...] = ()


def plan_on(planning: Planning, samples: int) -> None:
    """Evaluate at most so many ``samples`` of ways (those in the images alone count a sixteenth)."""
    p = planning
    work = max(1, samples) * WORK_OF_ARM
    while work > 0 and not p.finished:
        if p.stage == Stage.SEEKS:
            _seek(p)
            work -= WORK_OF_SEED
            continue
        cost = 1 if p.stage == Stage.IMAGES else WORK_OF_ARM
        count = max(1, min(SAMPLES - p.sample, work // cost))
        broken, reached = _samples(p, p.sample + count)
        work -= cost * (reached - p.sample + 1)
        p.sample = reached
        if broken >= 0:
            _fail(p, broken)
        elif reached == SAMPLES:
            _end(p)
        if p.sample == 0:
            work -= WORK_OF_WAY


def next_way(planning: Planning) -> None:
    """Set up the next way that differs from those before it; or end, where there is none."""
    p = planning
    p.stage, p.sample = int(Stage.IMAGES), 0
    p.table = empty_table()
    while p.followed < MOST_FOLLOWED and p.candidate + 1 < len(CANDIDATES):
        p.candidate += 1
        candidate = CANDIDATES[p.candidate]
        if not p.useful[candidate.turning] or not (p.request.bend or _straight(candidate)):
            continue
        profile = other_profile(p.request.profile, candidate.profile)
        if profile is None:
            continue
        way = way_of(candidate, profile, p.turnings[candidate.turning], p.centre_way, p.directions)
        if candidate.profile > 1 and float(np.abs(way[14:]).max()) == LINEAR:
            continue  # one component alone: the linear way again
        p.way = way
        p.tried += 1
        return
    if p.request.bend and p.request.composition != Composition.SIMULTANEOUS:
        p.stage = int(Stage.SEEKS)
    else:
        _give_up(p)


def _give_up(p: Planning) -> None:
    p.finished = True
    p.failure = tuple(f for f in (p.goal_failure, p.asked_failure, p.best_failure) if f is not None)


def _seek(p: Planning) -> None:
    """The goal's joints from the next seed; where they keep the limits, the way that is straight in them is next."""
    if p.seeds >= SEEDS:
        _give_up(p)
        return
    joints, arrived = _from_seed(p, p.seeds)
    p.seeds += 1
    if arrived and int(check_joints(joints, 1.0, p.surroundings, empty_table())) < 0:
        _straight_to(p, joints)


def stay(planning: Planning) -> None:
    """The goal is the present pose: a plan of no duration."""
    p = planning
    start_arm(p, Stage.JOINTS)
    broken, _ = _samples(p, 1)
    if broken >= 0:
        p.failure = (approach(p, broken),)
    else:
        p.plan = Plan(
            times=np.zeros(1),
            joints=p.all_joints[:1].copy(),
            displacements=np.eye(4)[None],
            shares=np.ones(1),
            way="none: the goal is where the body is",
            approaches=_approaches(p),
        )
    p.finished = True


def start_arm(planning: Planning, stage: Stage) -> None:
    """The arm back where it stands, for ``stage``."""
    p = planning
    p.stage, p.sample = int(stage), 0
    p.operators = p.start_operators.copy()
    p.joints = np.array(p.request.joints, dtype=np.float64)
    p.displacement = np.eye(4)
    p.bias = np.zeros(len(p.joints))
    p.table = empty_table()


def _samples(p: Planning, until: int) -> tuple[int, int]:
    """Samples of the present stage: kind of limit broken or −1, and up to where."""
    composition = int(p.request.composition)
    if p.stage == Stage.IMAGES:
        broken, reached = check_way(p.way, p.sample, until, SAMPLES, p.surroundings, p.rest, p.table)
    elif p.stage == Stage.JOINTS:
        broken, reached = follow_joints(
            p.joint_step, p.sample, until, SAMPLES, p.surroundings, composition,
            p.operators, p.joints, p.displacement, p.all_joints, p.all_displacements, p.table,
        )  # fmt: skip
    else:
        looks = p.stage == Stage.LOOKS
        # an arm that lacks freedoms leaves the way between its ends
        tolerance = TOLERANCE_PX if p.rank == RIGID_FREEDOMS and not looks else math.inf
        broken, reached = follow_way(
            p.way, p.sample, until, SAMPLES, _unlimited(p.surroundings) if looks else p.surroundings, p.rest,
            composition, len(p.joints) > p.rank, tolerance,
            p.operators, p.joints, p.displacement, p.bias, p.all_joints, p.all_displacements, p.table,
        )  # fmt: skip
    return int(broken), int(reached)


def _unlimited(surroundings: Surroundings) -> Surroundings:
    s = surroundings
    return s._replace(
        kept=np.zeros_like(s.kept),
        sides=np.zeros_like(s.sides),
        lower=np.full_like(s.lower, -np.inf),
        upper=np.full_like(s.upper, np.inf),
        keep_outs=s.keep_outs[:0].copy(),
    )


def _fail(p: Planning, kind: int) -> None:
    if kind == NOT_REACHABLE:
        p.table[kind, 4] = _missing_freedom(p)
    failure = approach(p, kind)
    if p.tried == 1 and p.asked_failure is None:
        p.asked_failure = failure
    elif p.best_failure is None or failure.share > p.best_failure.share:
        p.best_failure = failure
    if p.stage == Stage.FOLLOWS and kind in (JOINT_LIMIT, KEEP_OUT, NOT_REACHABLE) and not p.looked:
        p.looked = True
        start_arm(p, Stage.LOOKS)
    elif p.seeds > 0:
        p.stage, p.sample = int(Stage.SEEKS), 0
    else:
        next_way(p)


def _end(p: Planning) -> None:
    """The last sample of a stage is done."""
    if p.stage == Stage.IMAGES:
        p.followed += 1
        start_arm(p, Stage.FOLLOWS)
        return
    s = p.surroundings
    apart, marker = pixels_apart(s.cameras, s.kept, moved(p.displacement, s.body), p.goal)
    missed = not apart <= TOLERANCE_PX
    if p.stage == Stage.LOOKS:
        _go_on_from_goal_joints(p, missed)
    elif missed:
        p.followed += GOAL_MISSED
        room = TOLERANCE_PX - apart
        p.table[NOT_REACHABLE] = (room, room, apart, TOLERANCE_PX, -1.0, marker, 1.0)
        _fail(p, NOT_REACHABLE)
    else:
        _finish(p)


def _go_on_from_goal_joints(p: Planning, missed: bool) -> None:
    """The asked way's joints at the goal are known, or it is missed: the nearer of these and of a direct step there."""
    start, s = own(p.request.joints), p.surroundings
    found, table = [], empty_table()
    if not missed:
        broken = int(check_joints(p.joints, 1.0, s, table))
        if broken < 0:
            found.append(p.joints)
        else:
            p.table = table
            p.goal_failure = approach(p, broken)
            p.followed += GOAL_BEYOND
    if p.request.composition != Composition.SIMULTANEOUS and (p.request.bend or p.rank < RIGID_FREEDOMS):
        joints, arrived = _from_seed(p, 0)
        if arrived and int(check_joints(joints, 1.0, s, empty_table())) < 0:
            found.append(joints)
        if found:
            nearest = min(found, key=lambda q: float(np.abs(q - start).max()))
            _straight_to(p, nearest)
            return
    next_way(p)


def _from_seed(p: Planning, nth: int) -> tuple[FloatArray, bool]:
    s, start = p.surroundings, own(p.request.joints)
    seed = seed_joints(nth, start, s.lower, s.upper)
    joints, arrived = joints_from_seed(
        seed, p.goal, s.body, int(p.request.composition), s.lower, s.upper, p.turns, p.start_operators, start
    )
    return joints, bool(arrived)


def _straight_to(p: Planning, joints: FloatArray) -> None:
    p.goal_failure = None  # of another posture, not of the goal
    p.joint_step = (joints - p.request.joints) / (SAMPLES - 1.0)
    start_arm(p, Stage.JOINTS)


def _finish(p: Planning) -> None:
    r = p.request
    times = sample_times(
        p.all_joints,
        own(r.speed_scale * r.limits.velocity_max),
        own(r.speed_scale * r.limits.acceleration_max),
        r.profile == "exponential",
    )
    candidate = CANDIDATES[p.candidate]
    profile = other_profile(r.profile, candidate.profile) or r.profile
    p.plan = Plan(
        times=times,
        joints=p.all_joints.copy(),
        displacements=np.stack([conjugated(p.frame, H, p.inverse) for H in p.all_displacements]),
        shares=np.arange(SAMPLES) / (SAMPLES - 1.0),
        way="straight in the joints" if p.stage == Stage.JOINTS else name_of(candidate, profile),
        approaches=_approaches(p),
    )
    p.finished = True


def _straight(candidate: Candidate) -> bool:
    return candidate.profile == 0 and candidate.bend == (0.0, 0.0, 0.0) and candidate.turning in (0, 2)


def _missing_freedom(p: Planning) -> float:
    """Which of `MISSING_FREEDOMS` is most of what is left between the arm's body and its place on the way."""
    body = p.surroundings.body
    wanted = p.goal
    if p.stage != Stage.JOINTS:
        wanted = moved(pose_on_way(p.way, float(p.table[NOT_REACHABLE, 6])), body)
    here = moved(p.displacement, body)
    rotation = turn_between(here, wanted)
    spread = body - body.sum(axis=0) / len(body)
    size = math.sqrt(float((spread * spread).sum(axis=1).max()))
    shift = (wanted - here).sum(axis=0) / len(body)
    if math.sqrt(float((shift * shift).sum())) / size >= float(rotation[3]):
        return 0.0
    normal = face_normal(here, p.surroundings.faces)
    if normal is None:
        return 1.0
    return 2.0 if abs(float((normal * rotation[:3]).sum())) > math.sqrt(0.5) else 1.0


def _approaches(p: Planning) -> tuple[Approach, ...]:
    return tuple(approach(p, kind) for kind in range(NOT_REACHABLE) if p.table[kind, 0] < math.inf)


def approach(planning: Planning, kind: int) -> Approach:
    """A row of the table as it is told."""
    row = planning.table[kind]
    index = int(row[4])
    unit = ("", "", "px", "deg", "of its depth now", "px")[kind]
    if kind in (JOINT_LIMIT, KEEP_OUT):
        joint = index if kind == JOINT_LIMIT else 0
        unit = "rad" if planning.turns[joint] > 0.0 else "m"
    return Approach(
        what=KINDS[kind],
        index=index,
        value=float(row[2]),
        limit=float(row[3]),
        unit=unit,
        room=float(row[1]),
        share=float(row[6]),
        marker=int(row[5]),
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
