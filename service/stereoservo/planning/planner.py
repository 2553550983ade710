"""Path planner: plans the path of a marker body and of the arm's joints before the arm moves, in slices of work short
enough for a control loop; checks the request and prepares the search.

`start_planning` checks a request, converts it into a motion frame and decides simple cases at once: a goal out of view,
or hidden, or equal to the current pose. `continue_planning` then tries one candidate path after the other
(`path_search`). The state between two slices is plain data; the result does not depend on the slicing, bit for bit.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import invert4
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.motion_frame import (
    NUMBERS,
    axis_rotation,
    conjugate_all,
    motion_frame,
    plane_at_infinity,
    pose_on_path,
    rotation_between,
)
from stereoservo.planning.path_ik import freedoms
from stereoservo.planning.path_search import (
    MISSING_FREEDOMS,
    SAMPLES,
    TOLERANCE_PX,
    PlanningState,
    continue_planning,
    face_normal,
    go_to_posture,
    next_candidate,
    plan_without_motion,
)
from stereoservo.planning.plan import PlanLimits, PlanRequest
from stereoservo.planning.visibility_constraints import (
    empty_table,
    in_frame,
    moved,
    read_constraints,
    writable_copy,
)

__all__ = [
    "MISSING_FREEDOMS",
    "SAMPLES",
    "TOLERANCE_PX",
    "PlanRequestError",
    "PlanningState",
    "continue_planning",
    "plan",
    "start_planning",
]

NO_MOTION = 1e-6
"""Distance of all points from their goals, relative to the cameras' distance, up to which no motion is needed."""
REVOLUTE_NORM = 1e-6
"""Norm of a joint's rotation block, in the motion frame, from which on it counts as revolute."""
COLLINEAR = 1e-6
"""Squared sine of the angles at the centroid below which all markers are collinear."""

NO_ANGLE = 1e-9
PARALLEL = 1e-7
"""Sine below which two normals are parallel."""


class PlanRequestError(ValueError):
    """An invalid plan request: numbers that are not finite, invalid limits, collinear markers or a collinear face."""


def plan(request: PlanRequest) -> PlanningState:
    """Plan a request completely, in one call. Raises PlanRequestError."""
    planning = start_planning(request)
    while not planning.finished:
        continue_planning(planning, 10 * SAMPLES)
    return planning


def start_planning(request: PlanRequest) -> PlanningState:
    """Planning state from which `continue_planning` continues, or a finished one if the request is decided at once.
    Raises PlanRequestError.
    """
    r = request
    _check(r)
    operators = writable_copy(r.operators)
    stacked = writable_copy(
        np.concatenate([r.points, r.targets, r.camera_centres, r.centre[None], r.centre_target[None]])
    )
    m, n = len(r.points), len(r.joints)
    frame, inverse, local = _into_frame(operators, stacked, 2 * m)
    if not np.isfinite(inverse).all():
        raise PlanRequestError(
            "operators and points leave no plane at infinity: points of height a∞ᵀM = 1, no three on a line, are needed"
        )
    body, goal, camera_centres = local[:m].copy(), local[m : 2 * m].copy(), local[2 * m : -2].copy()
    if not _spans_a_plane(body):
        raise PlanRequestError(f"{len(body)} markers on one line fix no pose: three that span a plane are needed")
    faces = np.array(r.faces, dtype=np.int64, order="C", copy=True).reshape(-1, 3)
    collinear_face = int(_face_on_a_line(body, faces))
    if collinear_face >= 0:
        raise PlanRequestError(f"the markers {faces[collinear_face].tolist()} of a face are on one line")
    centre_translation = local[-1].copy()
    rotation, residual, own_operators, rank = _whole_displacement(
        body, goal, centre_translation, frame, inverse, operators
    )
    constraints, violation = read_constraints(r, frame, camera_centres, body, goal)
    kinds = np.stack(rotation_variants(rotation, face_normal(body, constraints.faces)))
    planning = PlanningState(
        request=request,
        frame=frame,
        inverse=inverse,
        constraints=constraints,
        goal=goal,
        residual=residual,
        directions=bend_directions(constraints.cameras[0], constraints.camera_centres),
        rotation_variants=kinds,
        useful=_useful(kinds),
        centre_translation=centre_translation,
        start_operators=own_operators,
        rank=int(rank),
        path=np.zeros(NUMBERS),
        operators=own_operators.copy(),
        joints=np.array(r.joints, dtype=np.float64),
        displacement=np.eye(4),
        bias=np.zeros(n),
        all_joints=np.zeros((SAMPLES, n)),
        all_displacements=np.zeros((SAMPLES, 4, 4)),
        table=empty_table(),
        joint_step=np.zeros(n),
        revolute=(np.abs(own_operators[:, :3, :3]).max(axis=(1, 2)) > REVOLUTE_NORM).astype(np.float64),
    )
    if violation is not None:
        planning.finished, planning.failure = True, (violation,)
    elif r.posture is not None:
        go_to_posture(planning)
    elif float(np.abs(goal - body).max()) <= NO_MOTION:
        plan_without_motion(planning)
    else:
        next_candidate(planning)
    return planning


def _check(request: PlanRequest) -> None:
    for name in (
        "operators",
        "joints",
        "matrices",
        "camera_centres",
        "points",
        "targets",
        "must_stay_visible",
        "centre",
        "centre_target",
    ):
        values = getattr(request, name)
        if not np.isfinite(values).all():
            raise PlanRequestError(f"{name} of a plan's request must be finite, got {values.tolist()}")
    posture = request.posture
    if posture is not None and not (posture.shape == request.joints.shape and np.isfinite(posture).all()):
        raise PlanRequestError(f"posture {posture.tolist()}: {len(request.joints)} finite joints are needed")
    if posture is not None and request.composition == Composition.SIMULTANEOUS:
        raise PlanRequestError("joints that turn simultaneously from the present pose have no other posture")
    if not 0.0 < request.speed_scale <= 1.0:
        raise PlanRequestError(f"speed_scale is {request.speed_scale}; above 0, at most 1 is valid")
    if len(request.joints) == 0 or len(request.matrices) == 0:
        raise PlanRequestError("a plan needs a joint and a camera at least")
    faces = np.asarray(request.faces)
    if faces.size and not (int(faces.min()) >= 0 and int(faces.max()) < len(request.points)):
        raise PlanRequestError(f"faces name markers from 0 to {len(request.points) - 1}, got {faces.tolist()}")
    _check_limits(request.limits)


def _check_limits(limits: PlanLimits) -> None:
    """Raise PlanRequestError if limits are NaN, or not positive for a joint that must move."""
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


@kernel
def _into_frame(operators: FloatArray, points: FloatArray, first: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Motion frame and its inverse (4, 4), and ``points`` (k, 4) of height 1 as (k, 3) in it.

    In ``points``, the camera centres begin at ``first``; the last but one is the centre, the last the centre's target.
    """
    k = points.shape[0]
    frame = motion_frame(operators, plane_at_infinity(operators, points), points[k - 2], points[first : k - 2])
    inverse = invert4(frame)
    return frame, inverse, in_frame(inverse, points)


@kernel
def _whole_displacement(
    body: FloatArray,
    goal: FloatArray,
    translation: FloatArray,
    frame: FloatArray,
    inverse: FloatArray,
    operators: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Displacement from ``body`` (m, 3) to ``goal`` (m, 3): rotation as axis and angle (4,), and the residual (m, 3)
    after it and the ``translation`` (3,) of the centre; and the arm's ``operators`` (n, 4, 4) in the motion frame, and
    its number of degrees of freedom.
    """
    rotation = rotation_between(body, goal)
    whole = np.zeros(NUMBERS)
    for i in range(4):
        whole[i] = rotation[i]
    whole[6] = 1.0
    for i in range(3):
        whole[8 + i] = translation[i]
    own = conjugate_all(inverse, operators, frame)
    return rotation, goal - moved(pose_on_path(whole, 1.0), body), own, freedoms(own)


def _useful(kinds: FloatArray) -> tuple[bool, ...]:
    """For each kind of rotation (5, 8), whether it differs from the previous ones."""
    hinge, planar = float(kinds[0, 3]) != 0.0, float(kinds[0, 7]) != 0.0
    both = hinge and planar
    return True, both, hinge, planar, both


@kernel
def _spans_a_plane(body: FloatArray) -> bool:
    """Whether points (m, 3) are not all on one line."""
    m = body.shape[0]
    if m < 3:
        return False
    centroid = np.zeros(3)
    for p in range(m):
        for i in range(3):
            centroid[i] += body[p, i] / m
    edges, longest, far = np.empty((m, 3)), -1.0, 0
    for p in range(m):
        for i in range(3):
            edges[p, i] = body[p, i] - centroid[i]
        if _dot(edges[p], edges[p]) > longest:
            longest, far = _dot(edges[p], edges[p]), p
    across = 0.0
    for p in range(m):
        across = max(across, _dot(edges[p], edges[p]) * longest - _dot(edges[p], edges[far]) ** 2)
    return bool(across > COLLINEAR * longest**2)


@kernel
def _face_on_a_line(body: FloatArray, faces: IntArray) -> int:
    """The first of the ``faces`` (f, 3) of points (m, 3) whose markers are on one line, or -1."""
    for f in range(faces.shape[0]):
        if not _spans_a_plane(body[faces[f]]):
            return f
    return -1


@kernel
def bend_directions(camera: FloatArray, camera_centres: FloatArray) -> FloatArray:
    """Unit displacements (3, 3): away from ``camera_centres`` (c, 3), right and down in ``camera`` (3, 4)."""
    P = camera[:, :3].copy()
    rows = np.zeros((3, 3))
    rows[1], rows[2] = _cross(P[1], P[2]), _cross(P[2], P[0])
    sign = 1.0 if _dot(P[0], rows[1]) >= 0.0 else -1.0
    for i in range(3):
        for c in range(camera_centres.shape[0]):
            rows[0, i] += camera_centres[c, i]
        rows[0, i] *= -1.0
        rows[1, i] *= sign
        rows[2, i] *= sign
    for k in range(3):
        length = math.sqrt(_dot(rows[k], rows[k]))
        if length > 0.0:
            for i in range(3):
                rows[k, i] /= length
    return rows


def rotation_variants(rotation: FloatArray, normal: FloatArray | None) -> tuple[FloatArray, ...]:
    """Hinge axis and angle, planar axis and angle (8,) of each kind of rotation, for a rotation ``(axis, angle)`` (4,).

    The kinds: hinge and planar rotation of the face of ``normal`` (3,), both by the smaller angle; a single rotation
    about the centre; the hinge in the other sense; the planar rotation in the other sense; the single rotation in the
    other sense (7.4.1, 7.4.2).
    """
    axis, angle = rotation[:3], float(rotation[3])
    whole = 2.0 * math.pi
    single = _rotation_variant(axis, angle, axis, 0.0)
    single_back = _rotation_variant(axis, angle - whole, axis, 0.0)
    if normal is None:
        return single, single, single_back, single, single_back
    hinge, theta_r, theta_p = _hinge_and_planar(rotation, normal)
    return (
        _rotation_variant(hinge, theta_r, normal, theta_p),
        single,
        _rotation_variant(hinge, theta_r - whole, normal, theta_p),
        _rotation_variant(hinge, theta_r, normal, theta_p - math.copysign(whole, theta_p)),
        single_back,
    )


def _rotation_variant(hinge: FloatArray, theta_r: float, normal: FloatArray, theta_p: float) -> FloatArray:
    out = np.empty(8)
    out[:3], out[3], out[4:7], out[7] = hinge, theta_r, normal, theta_p
    return out


@kernel
def _hinge_and_planar(rotation: FloatArray, normal: FloatArray) -> tuple[FloatArray, float, float]:
    """Hinge axis (3,), hinge and planar angle of a rotation ``(axis, angle)`` (4,) of the face of ``normal`` (3,)."""
    R = axis_rotation(rotation[:3], rotation[3])
    after = np.empty(3)
    for i in range(3):
        after[i] = R[i, 0] * normal[0] + R[i, 1] * normal[1] + R[i, 2] * normal[2]
    axis = _cross(normal, after)
    sine = math.sqrt(_dot(axis, axis))
    cosine = _dot(normal, after)
    if sine > PARALLEL:
        hinge = axis / sine
    else:
        # parallel or opposite normals: half a turn about any line in the plane
        least = 0
        for i in range(1, 3):
            if abs(normal[i]) < abs(normal[least]):
                least = i
        other = np.zeros(3)
        other[least] = 1.0
        hinge = _cross(normal, other)
        hinge /= math.sqrt(_dot(hinge, hinge))
    theta_r = math.atan2(sine, cosine) if sine > PARALLEL or cosine < 0.0 else 0.0
    back = axis_rotation(hinge, -theta_r)
    # the planar rotation R_p = R_r⁻¹ R, measured on a direction in the face
    inside = _cross(normal, hinge)
    image = np.empty(3)
    turned = np.empty(3)
    for i in range(3):
        for k in range(3):
            turned[k] = back[i, 0] * R[0, k] + back[i, 1] * R[1, k] + back[i, 2] * R[2, k]
        image[i] = _dot(turned, hinge)
    theta_p = math.atan2(_dot(image, inside), _dot(image, hinge))
    return hinge, theta_r, theta_p if abs(theta_p) > NO_ANGLE else 0.0


@kernel
def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@kernel
def _dot(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
