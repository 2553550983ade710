"""Path planner: the path of a body and of the joints, before anything moves, in slices of work that a loop can afford.

`start_planning` checks a request, converts it into a motion frame and decides what can be decided at once: a goal out
of view, or hidden, or the present pose itself. `plan_on` then tries one candidate path after the other (`detours`,
`path_search`). The state between two slices is plain data; how the work is sliced changes no bit of the result.
"""

from __future__ import annotations

import numpy as np

from stereoservo.kinematics.kernels import invert4, transform_points
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.constraint_margins import empty_table, moved
from stereoservo.planning.detours import bend_directions, turnings
from stereoservo.planning.motion_frame import conjugated, motion_frame, plane_at_infinity, turn_between
from stereoservo.planning.path import NUMBERS, pose_on_path
from stereoservo.planning.path_ik import freedoms
from stereoservo.planning.path_search import (
    MISSING_FREEDOMS,
    SAMPLES,
    TOLERANCE_PX,
    Planning,
    face_normal,
    next_candidate,
    plan_on,
    stay,
)
from stereoservo.planning.plan import PlanLimits, PlanRequest
from stereoservo.planning.visibility_constraints import read_constraints, writable_copy

__all__ = [
    "MISSING_FREEDOMS",
    "SAMPLES",
    "TOLERANCE_PX",
    "PlanRequestError",
    "Planning",
    "plan",
    "plan_on",
    "start_planning",
]

PRESENT = 1e-6
"""Distance of all points from their goals, relative to the cameras' distance, at which there is nothing to do."""
TURNS = 1e-6
"""Size of a joint's rotation block, in the motion frame, from which on it turns."""
COLLINEAR = 1e-6
"""Square of the sine, seen from the middle, below which all markers are on one line."""


class PlanRequestError(ValueError):
    """A request that no plan can answer: numbers that are not finite, no limits, markers or a face on one line."""


def plan(request: PlanRequest) -> Planning:
    """Finished planning of a request, in one go. Raises PlanRequestError."""
    planning = start_planning(request)
    while not planning.finished:
        plan_on(planning, 10 * SAMPLES)
    return planning


def start_planning(request: PlanRequest) -> Planning:
    """State from which `plan_on` continues, or finished where all is decided at once. Raises PlanRequestError."""
    r = request
    _check(r)
    operators, centre, camera_centres = (
        writable_copy(r.operators),
        writable_copy(r.centre),
        writable_copy(r.camera_centres),
    )
    stacked = writable_copy(
        np.concatenate([r.points, r.targets, r.camera_centres, r.centre[None], r.centre_target[None]])
    )
    frame = motion_frame(operators, plane_at_infinity(operators, stacked), centre, camera_centres)
    inverse = invert4(frame)
    if not np.isfinite(inverse).all():
        raise PlanRequestError(
            "operators and points leave no plane at infinity: points of height a∞ᵀM = 1, no three on a line, are needed"
        )
    body, goal = _in_frame(inverse, r.points), _in_frame(inverse, r.targets)
    if not _spans_a_plane(body):
        raise PlanRequestError(
            f"{len(body)} markers on one line fix no pose: three that span a plane are needed"
        )
    for face in np.asarray(r.faces).reshape(-1, 3):
        if not _spans_a_plane(body[face]):
            raise PlanRequestError(f"the markers {face.tolist()} of a face are on one line")
    centre_translation = _in_frame(inverse, r.centre_target[None])[0]
    rotation = turn_between(body, goal)
    whole = np.zeros(NUMBERS)
    whole[:3], whole[3], whole[6], whole[8:11] = rotation[:3], rotation[3], 1.0, centre_translation
    at_goal = pose_on_path(whole, 1.0)
    constraints, refusal = read_constraints(r, frame, inverse, body, goal)
    kinds = np.stack(turnings(rotation, face_normal(body, constraints.faces)))
    local = np.stack([conjugated(inverse, G, frame) for G in operators])
    n = len(r.joints)
    planning = Planning(
        request=request,
        frame=frame,
        inverse=inverse,
        constraints=constraints,
        goal=goal,
        residual=goal - moved(at_goal, body),
        directions=bend_directions(constraints.cameras[0], constraints.camera_centres),
        turnings=kinds,
        useful=_useful(kinds),
        centre_translation=centre_translation,
        start_operators=local,
        rank=int(freedoms(local)),
        path=np.zeros(NUMBERS),
        operators=local.copy(),
        joints=np.array(r.joints, dtype=np.float64),
        displacement=np.eye(4),
        bias=np.zeros(n),
        all_joints=np.zeros((SAMPLES, n)),
        all_displacements=np.zeros((SAMPLES, 4, 4)),
        table=empty_table(),
        joint_step=np.zeros(n),
        turns=(np.abs(local[:, :3, :3]).max(axis=(1, 2)) > TURNS).astype(np.float64),
    )
    if refusal is not None:
        planning.finished, planning.failure = True, (refusal,)
    elif float(np.abs(goal - body).max()) <= PRESENT:
        stay(planning)
    else:
        next_candidate(planning)
    return planning


def _check(request: PlanRequest) -> None:
    for name in (
        "operators", "joints", "matrices", "camera_centres", "points", "targets", "kept", "centre", "centre_target"
    ):  # fmt: skip
        values = getattr(request, name)
        if not np.isfinite(values).all():
            raise PlanRequestError(f"{name} of a plan's request must be finite, got {values.tolist()}")
    if not 0.0 < request.speed_scale <= 1.0:
        raise PlanRequestError(f"speed_scale is {request.speed_scale}; above 0, at most 1 is valid")
    if len(request.joints) == 0 or len(request.matrices) == 0:
        raise PlanRequestError("a plan needs a joint and a camera at least")
    faces = np.asarray(request.faces)
    if faces.size and not (int(faces.min()) >= 0 and int(faces.max()) < len(request.points)):
        raise PlanRequestError(
            f"faces name markers from 0 to {len(request.points) - 1}, got {faces.tolist()}"
        )
    _check_limits(request.limits)


def _check_limits(limits: PlanLimits) -> None:
    """Limits that are no numbers, or not above zero where a joint has to move, would be none."""
    for name in ("velocity_max", "acceleration_max", "sizes"):
        values = getattr(limits, name)
        if not (np.asarray(values) > 0.0).all():
            raise PlanRequestError(f"{name} of a plan's limits must be above 0, got {values.tolist()}")
    for name in ("position_min", "position_max", "keep_outs"):
        values = getattr(limits, name)
        if np.isnan(values).any():
            raise PlanRequestError(f"{name} of a plan's limits must be numbers, got {values.tolist()}")
    if not (np.isfinite(limits.lenses).all() and np.isfinite(limits.view_margin_px)):
        raise PlanRequestError("lenses and view_margin_px of a plan's limits must be finite")


def _in_frame(inverse: FloatArray, points: FloatArray) -> FloatArray:
    return writable_copy(transform_points(inverse, writable_copy(points))[:, :3])


def _useful(kinds: FloatArray) -> tuple[bool, ...]:
    """Which kinds of turning (5, 8) differ from those before them."""
    hinge, planar = float(kinds[0, 3]) != 0.0, float(kinds[0, 7]) != 0.0
    both = hinge and planar
    return True, both, hinge, planar, both


def _spans_a_plane(body: FloatArray) -> bool:
    """Whether points (m, 3) are not all on one line."""
    if len(body) < 3:
        return False
    edges = body - body.sum(axis=0) / len(body)
    squares = (edges * edges).sum(axis=1)
    along = edges[int(squares.argmax())]
    across = squares * float(squares.max()) - (edges * along[None, :]).sum(axis=1) ** 2
    return bool(float(across.max()) > COLLINEAR * float(squares.max()) ** 2)
