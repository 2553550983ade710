"""Decomposition of the displacement of three points of a body into a translation, a hinge rotation that aligns their
plane, and a rotation in that plane, each with the arm's joint velocity (thesis 7.4.1, 7.4.2).

The three can be executed together: none disturbs the alignment by the others. All points, including the camera centres,
have orbital height ``a∞ᵀM = 1``; then their differences are displacements, and a translated target is the target minus
the displacement of the centre, which needs no operator (7.22).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from stereoservo.geometry.displacements import exp_rotation
from stereoservo.geometry.homogeneous import plane_of_points
from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.primitives import (
    DegenerateStepError,
    NotReachableError,
    Primitive,
    arm_freedoms,
    revolution_around_axis,
    revolution_in_plane,
    translation_along_axis,
)

COINCIDENT = 1e-12
"""Relative length below which two points, or two unit planes, coincide: rounding."""

FLAT_FACE = 1e-9
"""Sine between two edges of the face, in the frame's coordinates, below which its points are collinear."""

VISIBILITY_SHARE = 0.9
"""Fraction of the amount at which a camera would lose sight of the face that a component may use."""


class ComponentStatus(IntEnum):
    """Status of a component: it moves, is done, cannot be made by the arm, waits for visibility, or has no face."""

    MOVES = 0
    DONE = 1
    NOT_REACHABLE = 2
    WAITS = 3
    NO_FACE = 4


MOVES, DONE, NOT_REACHABLE, WAITS, NO_FACE = (int(status) for status in ComponentStatus)
"""The statuses as integers, for kernels and the loop: comparing numpy integers with an enumeration takes longer than
the control law.
"""


class DegenerateFaceError(ValueError):
    """The three points are collinear and span no face."""


@dataclass(frozen=True, eq=False)
class Component:
    """One remaining primitive motion of a task.

    ``amount`` >= 0: τ [length of the centre's displacement in the frame's coordinates] or an angle [rad]. ``allowed``
    in [0, amount]: the part of it that currently keeps the face visible. ``screw`` (n,), ``operator`` (4, 4): zero if
    the component is done or cannot be made; ``detail``: the cause.
    """

    amount: float
    allowed: float
    screw: FloatArray
    operator: FloatArray
    status: ComponentStatus
    detail: str = ""


@dataclass(frozen=True, eq=False)
class Decomposition:
    """``translation`` τ, ``hinge`` θ_r, ``planar`` θ_p: the target is ``H_t(τ) H_r(θ_r) H_p(θ_p)`` applied to
    the points.
    """

    translation: Component
    hinge: Component
    planar: Component


def decompose(
    operators: FloatArray,
    A: FloatArray,
    A_star: FloatArray,
    centre: FloatArray,
    centre_star: FloatArray,
    camera_centres: FloatArray,
) -> Decomposition:
    """Components of the displacement from points ``A`` (3, 4) to ``A_star`` (3, 4), with the centre from ``centre``
    (4,) to ``centre_star`` (4,).

    ``operators`` (n, 4, 4) at the current configuration. ``camera_centres`` (c, 4), c may be 0: cameras to which the
    face must stay visible. All heights 1. Raises DegenerateFaceError. Equations (7.18)–(7.24).
    """
    face, face_star = _face(A), _face(A_star)
    freedoms = arm_freedoms(operators)
    displacement = centre_star - centre
    side, seeing_cameras = _visible_side(face, face_star, camera_centres)

    translation = _nothing(operators, 0.0, ComponentStatus.DONE)
    tau = float(np.linalg.norm(displacement))
    if tau > COINCIDENT * float(np.linalg.norm(centre)):
        try:
            primitive = translation_along_axis(operators, centre, centre + displacement / tau, freedoms)
            # (7.21) with the plane through the target whose normal is the motion of the centre
            tau = float(displacement @ (primitive.operator @ centre))
            bound = _translation_bound(face, primitive.operator, centre, seeing_cameras)
            translation = _component(primitive, tau, bound)
        except (NotReachableError, DegenerateStepError) as error:
            translation = _nothing(operators, tau, ComponentStatus.NOT_REACHABLE, str(error))

    # Planes through the centre, parallel to the face: the hinge must contain the centre.
    A_c = A + (centre - A.mean(axis=0))
    A_t = A_star - displacement  # (7.22)
    A_tc = A_t + (centre - A_t.mean(axis=0))
    a, a_t = _unit(plane_of_points(*A_c)), _unit(plane_of_points(*A_tc))
    hinge = _nothing(operators, 0.0, ComponentStatus.DONE)
    axis_point = _hinge_point(a, a_t, centre, A_c)
    A_r = A_tc
    if axis_point is not None:
        try:
            primitive = revolution_around_axis(operators, centre, axis_point, freedoms)
            theta = _hinge_angle(primitive.operator, a, a_t)
            theta = _visible_sense(primitive.operator, a, side, theta, camera_centres, displacement)
            primitive, theta = _positive(primitive, theta)
            bound = _rotation_bound(face, primitive.operator, seeing_cameras)
            hinge = _component(primitive, theta, bound)
            A_r = A_tc @ exp_rotation(primitive.operator, -theta).T  # (7.24)
        except (NotReachableError, DegenerateStepError) as error:
            # without an operator the angle is not known: the angle of the planes' coordinates shows that it is not zero
            angle = math.acos(min(1.0, max(-1.0, float(a @ a_t))))
            hinge = _nothing(operators, angle, ComponentStatus.NOT_REACHABLE, str(error))

    try:
        primitive = revolution_in_plane(operators, a, centre, freedoms)
        primitive, theta = _positive(primitive, _planar_angle(primitive.operator, A_c, A_r))
        planar = _component(primitive, theta, math.inf)
    except (NotReachableError, DegenerateStepError) as error:
        planar = _nothing(operators, 0.0, ComponentStatus.NOT_REACHABLE, str(error))
    return Decomposition(translation, hinge, planar)


def _face(A: FloatArray) -> FloatArray:
    plane = plane_of_points(A[0], A[1], A[2])
    edges = float(np.linalg.norm(A[1] - A[0]) * np.linalg.norm(A[2] - A[0])) * float(np.linalg.norm(A[0]))
    if not float(np.linalg.norm(plane)) > FLAT_FACE * edges:
        raise DegenerateFaceError(f"the three points {A.tolist()} are collinear; three that span a face are needed")
    return plane


def _unit(plane: FloatArray) -> FloatArray:
    unit: FloatArray = plane / np.linalg.norm(plane)
    return unit


def _nothing(operators: FloatArray, amount: float, status: ComponentStatus, detail: str = "") -> Component:
    return Component(amount, 0.0, np.zeros(operators.shape[0]), np.zeros((4, 4)), status, detail)


def _component(primitive: Primitive, amount: float, bound: float) -> Component:
    allowed = min(amount, VISIBILITY_SHARE * bound)
    status = ComponentStatus.MOVES if allowed >= amount else ComponentStatus.WAITS
    return Component(amount, allowed, primitive.screw, primitive.operator, status)


def _positive(primitive: Primitive, theta: float) -> tuple[Primitive, float]:
    """The primitive with the sense of its axis chosen so that the angle is not negative, and that angle."""
    if theta >= 0.0:
        return primitive, theta
    flipped = Primitive(-primitive.screw, -primitive.operator, primitive.smallest, primitive.second, primitive.largest)
    return flipped, -theta


def _visible_side(face: FloatArray, face_star: FloatArray, camera_centres: FloatArray) -> tuple[float, FloatArray]:
    """The sign of the face's visible side, and the centres of the cameras that see it now and at the target, times that
    sign.

    The printed side is the one that the cameras see at the target.
    """
    if camera_centres.shape[0] == 0:
        return 1.0, camera_centres
    side = 1.0 if float(face_star @ camera_centres.mean(axis=0)) >= 0.0 else -1.0
    both = (side * (camera_centres @ face) > 0.0) & (side * (camera_centres @ face_star) > 0.0)
    return side, side * camera_centres[both]


def _translation_bound(face: FloatArray, H_t: FloatArray, centre: FloatArray, camera_centres: FloatArray) -> float:
    """Smallest τ₀ > 0 at which the translated face passes a camera: ``τ₀ = aᵀO/(aᵀĤ_tO)`` (7.21, the plane
    moves).
    """
    bound = math.inf
    for camera_centre in camera_centres:
        rate = float(face @ (H_t @ camera_centre))
        if rate > 0.0:
            bound = min(bound, float(face @ camera_centre) / rate)
    return bound


def _hinge_point(a: FloatArray, a_t: FloatArray, centre: FloatArray, A_c: FloatArray) -> FloatArray | None:
    """A second point of the line in which the two faces meet at the centre; None if they coincide.

    Opposite faces turn by half a turn about any line in them: the line to the point farthest from the centre is used.
    """
    difference = a_t - (a @ a_t) * a
    length = float(np.linalg.norm(difference))
    if length > COINCIDENT:
        return plane_of_points(a, difference / length, _unit(centre))
    if float(a @ a_t) > 0.0:
        return None
    edges = A_c - centre
    farthest: FloatArray = A_c[int((edges**2).sum(axis=1).argmax())]
    return farthest


def _hinge_angle(H_r: FloatArray, a: FloatArray, a_t: FloatArray) -> float:
    """θ in (−π, π] that turns the oriented plane ``a`` into ``a_t``: ``a(θ) = cos θ a − sin θ Ĥ_rᵀa`` (7.23).

    With oriented planes only one of the two solutions remains: the other one turns the back of the face to the front.
    """
    u = -H_r.T @ a
    v = H_r.T @ (H_r.T @ a)
    return _angle(u[None], v[None], (a_t - a - v)[None])


def _planar_angle(H_p: FloatArray, A: FloatArray, A_r: FloatArray) -> float:
    """θ that turns the points ``A`` (k, 4) towards ``A_r`` (k, 4), by least squares."""
    u = A @ H_p.T
    v = u @ H_p.T
    return _angle(u, v, A_r - A - v)


def _angle(u: FloatArray, v: FloatArray, right: FloatArray) -> float:
    """``atan2`` of the least-squares solution ``sin θ, cos θ`` of ``sin θ u − cos θ v = right``."""
    uu, vv, uv = float((u * u).sum()), float((v * v).sum()), float((u * v).sum())
    ur, vr = float((u * right).sum()), float((v * right).sum())
    sine = ur * vv - uv * vr
    cosine = uv * ur - uu * vr
    # both divided by the determinant uu·vv − uv² > 0
    return math.atan2(sine, cosine)


def _facing_curve(H: FloatArray, a: FloatArray, camera_centre: FloatArray) -> tuple[float, float, float]:
    """``k, R, φ`` of ``a(θ)ᵀO = k + R cos(θ − φ)``: the face turned by θ, seen from the static ``camera_centre``."""
    once = H @ camera_centre
    u, v = float(a @ once), float(a @ (H @ once))
    return float(a @ camera_centre) + v, math.hypot(u, v), math.atan2(-u, -v)


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


def _visible_sense(
    H_r: FloatArray,
    a: FloatArray,
    side: float,
    theta: float,
    camera_centres: FloatArray,
    displacement: FloatArray,
) -> float:
    """Choose θ or θ ∓ 2π so that the face shows its front during the whole motion, translation included (7.4.2).

    ``φ``: the angle at which the face would point to the centroid of the cameras. In the frame of the face, it changes
    by the smaller angle while the centre moves; the target angle is the one within a quarter turn of its final value.
    """
    if camera_centres.shape[0] == 0:
        return theta
    mean_centre = side * camera_centres.mean(axis=0)
    _, size, now = _facing_curve(H_r, a, mean_centre)
    _, size_then, then = _facing_curve(H_r, a, mean_centre - side * displacement)
    if min(size, size_then) <= COINCIDENT * float(np.linalg.norm(mean_centre)):
        return theta  # the cameras are on the axis: both senses are equivalent
    then = now + _wrapped(then - now)
    return then + _wrapped(theta - then)


def _rotation_bound(face: FloatArray, H_r: FloatArray, camera_centres: FloatArray) -> float:
    """Smallest θ₀ > 0 at which the turned face passes a camera (7.23 applied to the camera centre)."""
    bound = math.inf
    for camera_centre in camera_centres:
        k, R, phi = _facing_curve(H_r, face, camera_centre)
        if k < R:
            bound = min(bound, max(0.0, phi + math.acos(max(-1.0, -k / R))))
    return bound
