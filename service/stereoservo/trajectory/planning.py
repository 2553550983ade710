"""Plans: the way of a body and of the joints, before anything moves, in slices that a loop can afford.

`start_planning` reads the request into a motion frame and decides what can be decided at once: a goal out of view, or
hidden, or the present pose itself. `plan_on` then tries one way after the other (`bending`): first the closed form in
the images, which is cheap, then the arm along it, sample by sample. The state between two slices is plain data; how the
work is sliced changes no bit of the result.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import invert4, transform_points
from stereoservo.trajectory.bending import (
    CANDIDATES,
    Candidate,
    bend_directions,
    name_of,
    other_profile,
    turnings,
    way_of,
)
from stereoservo.trajectory.following import check_way, follow_way, freedoms, pixels_apart
from stereoservo.trajectory.motion_frame import conjugated, motion_frame, plane_at_infinity, turn_between
from stereoservo.trajectory.plan import Approach, Plan, PlanRequest
from stereoservo.trajectory.primitives import HINGE, PLANAR, TRANSLATION
from stereoservo.trajectory.profiles import LINEAR
from stereoservo.trajectory.rooms import (
    KINDS,
    NOT_REACHABLE,
    Surroundings,
    empty_table,
    moved,
)
from stereoservo.trajectory.sights import read_surroundings
from stereoservo.trajectory.time_scaling import sample_times
from stereoservo.trajectory.ways import NUMBERS, pose_on_way

SAMPLES = 65
"""Of a way: half a turn in steps of three degrees."""
TOLERANCE_PX = 2.0
"""Largest distance in the images between the way and the arm that follows it, and between its end and the goal."""
PRESENT = 1e-6
"""Distance of all points from their goals, relative to the cameras' distance, at which there is nothing to do."""
WORK_OF_ARM = 16
"""Work of one sample of the arm, in samples of the closed form in the images."""
WORK_OF_WAY = 8
"""Work of setting up one way, likewise."""
MOST_FOLLOWED = 120
"""Ways that the arm is taken along before the search ends."""

MISSING_FREEDOMS = (TRANSLATION, HINGE, PLANAR)
"""What the ``index`` of an approach NOT_REACHABLE names."""


class PlanRequestError(ValueError):
    """A request that no plan can answer: numbers that are not finite, points that span no body."""


class Planning(msgspec.Struct, eq=False):
    """Work on a plan, between two slices. ``finished``: there is a ``plan``, or a ``failure``, the asked way's first.

    ``frame`` (4, 4) and its ``inverse``: the motion frame. ``operators``, ``joints``, ``displacement`` (4, 4): the arm
    at ``sample`` of the way number ``candidate``; ``table``: closest approaches so far.
    """

    request: PlanRequest
    frame: FloatArray
    inverse: FloatArray
    surroundings: Surroundings
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
    candidate: int = -1
    following: bool = False
    sample: int = 0
    followed: int = 0
    tried: int = 0
    asked_failure: Approach | None = None
    best_failure: Approach | None = None
    finished: bool = False
    plan: Plan | None = None
    failure: tuple[Approach, ...] = ()


def plan(request: PlanRequest) -> Planning:
    """A plan, to its end. Raises PlanRequestError."""
    planning = start_planning(request)
    while not planning.finished:
        plan_on(planning, 10 * SAMPLES)
    return planning


def start_planning(request: PlanRequest) -> Planning:
    """What can be decided at once, and the state from which `plan_on` goes on. Raises PlanRequestError."""
    r = request
    for name in ("operators", "joints", "matrices", "points", "targets", "centre", "centre_target"):
        if not np.isfinite(getattr(r, name)).all():
            raise PlanRequestError(
                f"{name} of a plan's request must be finite, got {getattr(r, name).tolist()}"
            )
    operators = np.ascontiguousarray(r.operators)
    heights = np.concatenate([r.points, r.targets, r.camera_centres, r.centre[None], r.centre_target[None]])
    frame = motion_frame(operators, plane_at_infinity(operators, heights), r.centre, r.camera_centres)
    inverse = invert4(frame)
    if not np.isfinite(inverse).all():
        raise PlanRequestError(
            "operators and heights of the points leave no plane at infinity; are heights 1?"
        )
    body = np.ascontiguousarray(transform_points(inverse, np.ascontiguousarray(r.points))[:, :3])
    goal = np.ascontiguousarray(transform_points(inverse, np.ascontiguousarray(r.targets))[:, :3])
    centre_way = transform_points(inverse, r.centre_target[None])[0, :3].copy()
    if not _spans_a_plane(body):
        raise PlanRequestError(
            "the markers of the body lie on one line or are fewer than three: no pose to plan"
        )
    rotation = turn_between(body, goal)
    local = np.stack([conjugated(inverse, np.ascontiguousarray(G), frame) for G in operators])
    whole = np.zeros(NUMBERS)
    whole[:3], whole[3], whole[6], whole[8:11] = rotation[:3], rotation[3], 1.0, centre_way
    at_goal = pose_on_way(whole, 1.0)
    surroundings, refusal = read_surroundings(r, frame, inverse, body, at_goal)
    kinds = turnings(rotation, _normal(surroundings))
    n = len(r.joints)
    planning = Planning(
        request=request,
        frame=frame,
        inverse=inverse,
        surroundings=surroundings,
        directions=bend_directions(surroundings.cameras[0], surroundings.eyes),
        turnings=np.stack(kinds),
        useful=_useful(np.stack(kinds), centre_way, request.bend),
        centre_way=centre_way,
        start_operators=local,
        rank=freedoms(local),
        way=np.zeros(NUMBERS),
        operators=local.copy(),
        joints=np.array(r.joints, dtype=np.float64),
        displacement=np.eye(4),
        bias=np.zeros(n),
        all_joints=np.zeros((SAMPLES, n)),
        all_displacements=np.zeros((SAMPLES, 4, 4)),
        table=empty_table(),
    )
    if refusal is not None:
        planning.finished, planning.failure = True, (refusal,)
    elif float(np.abs(moved(at_goal, body) - body).max()) <= PRESENT:
        _stay(planning)
    else:
        _next_way(planning)
    return planning


def plan_on(planning: Planning, samples: int) -> None:
    """Evaluate at most so many ``samples`` of ways (those in the images alone count a sixteenth)."""
    work = max(1, samples) * WORK_OF_ARM
    while work > 0 and not planning.finished:
        cost = WORK_OF_ARM if planning.following else 1
        count = max(1, min(SAMPLES - planning.sample, work // cost))
        broken, reached = _samples(planning, count)
        work -= cost * (reached - planning.sample + 1)
        planning.sample = reached
        if broken >= 0:
            _note_failure(planning, broken)
            _next_way(planning)
            work -= WORK_OF_WAY
        elif reached == SAMPLES:
            if planning.following:
                _arrive(planning)
            else:
                planning.following, planning.sample = True, 0
                _reset_arm(planning)


def _samples(planning: Planning, count: int) -> tuple[int, int]:
    """The next ``count`` samples of the present way: kind of limit broken or −1, and up to where."""
    p = planning
    until = p.sample + count
    if not p.following:
        broken, reached = check_way(p.way, p.sample, until, SAMPLES, p.surroundings, p.table)
    else:
        broken, reached = follow_way(
            p.way, p.sample, until, SAMPLES, p.surroundings, int(p.request.composition),
            len(p.joints) > p.rank, TOLERANCE_PX if p.rank == 6 else math.inf,
            p.operators, p.joints, p.displacement, p.bias, p.all_joints, p.all_displacements, p.table,
        )  # fmt: skip
    return int(broken), int(reached)


def _next_way(planning: Planning) -> None:
    """Set up the next way that differs from those before it; or end, where there is none."""
    p = planning
    p.following, p.sample = False, 0
    p.table = empty_table()
    while True:
        p.candidate += 1
        if p.candidate >= len(CANDIDATES) or p.followed >= MOST_FOLLOWED:
            _give_up(p)
            return
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


def _straight(candidate: Candidate) -> bool:
    return candidate.profile == 0 and candidate.bend == (0.0, 0.0, 0.0) and candidate.turning in (0, 2)


def _useful(kinds: FloatArray, centre_way: FloatArray, bend: bool) -> tuple[bool, ...]:
    """Which kinds of turning (k, 8) differ from those before them."""
    hinge, planar = float(kinds[0, 3]) != 0.0, float(kinds[0, 7]) != 0.0
    return True, hinge and planar, hinge, planar, hinge and planar


def _reset_arm(planning: Planning) -> None:
    p = planning
    p.operators = p.start_operators.copy()
    p.joints = np.array(p.request.joints, dtype=np.float64)
    p.displacement = np.eye(4)
    p.bias = np.zeros(len(p.joints))
    p.table = empty_table()
    p.followed += 1


def _arrive(planning: Planning) -> None:
    """The arm has followed to the end: is it at the goal?"""
    p = planning
    body = p.surroundings.body
    wanted = moved(pose_on_way(p.way, 1.0), body)
    apart, marker = pixels_apart(
        p.surroundings.cameras, p.surroundings.kept, moved(p.displacement, body), wanted
    )
    if not apart <= TOLERANCE_PX:
        p.table[NOT_REACHABLE] = (
            TOLERANCE_PX - apart,
            TOLERANCE_PX - apart,
            apart,
            TOLERANCE_PX,
            -1.0,
            marker,
            1.0,
        )
        _note_failure(p, NOT_REACHABLE)
        _next_way(p)
        return
    r = p.request
    limits = r.limits
    times = sample_times(
        p.all_joints,
        r.speed_scale * limits.velocity_max,
        r.speed_scale * limits.acceleration_max,
        r.profile == "exponential",
    )
    candidate = CANDIDATES[p.candidate]
    profile = other_profile(r.profile, candidate.profile)
    assert profile is not None
    p.plan = Plan(
        times=times,
        joints=p.all_joints.copy(),
        displacements=np.stack([conjugated(p.frame, H, p.inverse) for H in p.all_displacements]),
        shares=np.arange(SAMPLES) / (SAMPLES - 1.0),
        way=name_of(candidate, profile),
        approaches=tuple(_approach(p, kind) for kind in range(NOT_REACHABLE) if p.table[kind, 0] < math.inf),
    )
    p.finished = True


def _stay(planning: Planning) -> None:
    """The goal is the present pose."""
    p = planning
    p.way = np.zeros(NUMBERS)
    p.way[2] = p.way[6] = 1.0
    p.operators = p.start_operators.copy()
    follow_way(
        p.way, 0, 1, SAMPLES, p.surroundings, int(p.request.composition), False, math.inf,
        p.operators, p.joints, p.displacement, p.bias, p.all_joints, p.all_displacements, p.table,
    )  # fmt: skip
    p.plan = Plan(
        times=np.zeros(1),
        joints=p.all_joints[:1].copy(),
        displacements=np.eye(4)[None],
        shares=np.ones(1),
        way="none: the goal is where the body is",
        approaches=tuple(_approach(p, kind) for kind in range(NOT_REACHABLE) if p.table[kind, 0] < math.inf),
    )
    p.finished = True


def _note_failure(planning: Planning, kind: int) -> None:
    p = planning
    if kind == NOT_REACHABLE:
        p.table[kind, 4] = _missing_freedom(p)
    failure = _approach(p, kind)
    if p.tried == 1:
        p.asked_failure = failure
    elif p.best_failure is None or failure.share > p.best_failure.share:
        p.best_failure = failure


def _give_up(planning: Planning) -> None:
    p = planning
    p.finished = True
    p.failure = tuple(failure for failure in (p.asked_failure, p.best_failure) if failure is not None)


def _missing_freedom(planning: Planning) -> float:
    """Which of `MISSING_FREEDOMS` is most of what is left between the arm's body and its place on the way."""
    p = planning
    share = float(p.table[NOT_REACHABLE, 6])
    wanted, body = pose_on_way(p.way, share), p.surroundings.body
    here, there = moved(p.displacement, body), moved(wanted, body)
    rotation = turn_between(here, there)
    size = math.sqrt(float(((body - body.sum(axis=0) / len(body)) ** 2).sum(axis=1).max()))
    away = math.sqrt(float(((wanted[:3, 3] - p.displacement[:3, 3]) ** 2).sum())) / size
    if away >= float(rotation[3]):
        return 0.0
    normal = _normal(p.surroundings)
    if normal is None:
        return 1.0
    turned = (wanted[:3, :3] * normal[None, :]).sum(axis=1)
    return 2.0 if abs(float((turned * rotation[:3]).sum())) > math.sqrt(0.5) else 1.0


def _approach(planning: Planning, kind: int) -> Approach:
    row = planning.table[kind]
    index = int(row[4])
    unit = ("", "", "px", "deg", "of its depth now", "px")[kind]
    if kind <= 1:
        joint = index if kind == 0 else 0
        unit = "rad" if float(np.abs(planning.start_operators[joint, :3, :3]).max()) > PRESENT else "m"
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


def _normal(surroundings: Surroundings) -> FloatArray | None:
    """Unit normal (3,) of the first face; None without faces."""
    if len(surroundings.faces) == 0:
        return None
    a, b, c = (surroundings.body[int(i)] for i in surroundings.faces[0])
    u, v = b - a, c - a
    normal = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    unit: FloatArray = normal / math.sqrt(float((normal * normal).sum()))
    return unit


def _spans_a_plane(body: FloatArray) -> bool:
    """Whether points (m, 3) are not all on one line, by the two larger of their moments."""
    if len(body) < 3:
        return False
    edges = body - body.sum(axis=0) / len(body)
    squares = (edges * edges).sum(axis=1)
    along = edges[int(squares.argmax())]
    across = squares * float(squares.max()) - (edges * along[None, :]).sum(axis=1) ** 2
    return bool(float(across.max()) > 1e-6 * float(squares.max()) ** 2)
