"""Cartesian control in numpy: the readable reference of `control.laws.cartesian3.cartesian_step`."""

from __future__ import annotations

import math
from math import inf
from typing import NamedTuple

import numpy as np

from oracles.face_visibility import Way, visible_rotation
from oracles.step_correction import corrected_step
from stereoservo.control.laws.cartesian3 import APPROACH, LONGEST_STEP, STEP_OF_BOUND
from stereoservo.geometry.homogeneous import plane_of_points
from stereoservo.geometry.screws import exp_twist
from stereoservo.kinematics.composition import Composition
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.planning.primitives import REACH_RATIO, arm_freedoms
from stereoservo.planning.three_point_decomposition import (
    DONE,
    MOVES,
    NO_FACE,
    NOT_REACHABLE,
    WAITS,
    Decomposition,
    DegenerateFaceError,
    decompose,
)


class CartesianStep(NamedTuple):
    """``velocity`` (n,) [rad/s or m/s]; ``task_error`` (k,): τ and angles [rad] still to be made, all >= 0.

    τ in lengths of the centre's displacement in the frame's coordinates: along one line proportional to metres.
    ``allowed`` (k,): what of it visibility lets the components plan for; ``status`` (k,): `ComponentStatus` of each.
    """

    velocity: FloatArray
    task_error: FloatArray
    allowed: FloatArray
    status: IntArray


class Part(NamedTuple):
    """A component: joint screw (n,), generator (4, 4), amount >= 0, `ComponentStatus`."""

    screw: FloatArray
    generator: FloatArray
    amount: float
    status: int


def cartesian_law(
    operators: FloatArray,
    composition: Composition,
    points: FloatArray,
    targets: FloatArray,
    centre: FloatArray,
    centre_target: FloatArray,
    camera_centres: FloatArray,
    gains: FloatArray,
    dt_s: float,
    rotation_rate: float,
    translation_rate: float,
    single: bool,
) -> CartesianStep:
    """``q̇ = [q̂_t q̂_r q̂_p] Λ e`` (8.42), or ``[q̂_t q̂_s] Λ e`` (8.55) where ``single``; ``e``: motion still to be made.

    ``operators`` (n, 4, 4) at the current configuration (5.21), ``points`` and ``targets`` (3, 4) of one face,
    ``centre`` and ``centre_target`` (4,), ``camera_centres`` (c, 4): all of height ``a∞ᵀM = 1``. ``gains`` (k,)
    [1/s], k = 3 or 2. ``dt_s`` [s] and the rates as in `control.law.Options`. A component that the arm cannot make,
    or that visibility holds back, does not hold up the others.
    """
    n, k = operators.shape[0], 2 if single else 3
    try:
        if not np.isfinite([centre, centre_target]).all():
            raise DegenerateFaceError("the centre is not known")
        parts = decompose(operators, points, targets, centre, centre_target, np.zeros((0, 4)))
    except DegenerateFaceError:
        status = np.full(k, NO_FACE, dtype=np.int64)
        return CartesianStep(np.zeros(n), np.zeros(k), np.zeros(k), status)
    translation, hinge, planar = (_part(parts, name) for name in ("translation", "hinge", "planar"))
    face = plane_of_points(points[0], points[1], points[2])
    target_face = plane_of_points(targets[0], targets[1], targets[2])
    eyes = camera_centres
    if len(eyes):
        eyes = eyes if float(target_face @ eyes.mean(axis=0)) >= 0.0 else -eyes
    moves = translation.status == MOVES
    displacement = centre_target - centre if moves else np.zeros(4)

    error = None
    if single:
        whole = one_rotation(operators, hinge, planar)
        rotations = [whole]
        way = _way(face, whole, displacement, eyes)
        if not way.clear and hinge.status == MOVES:
            # Neither sense of the one rotation keeps the face in sight: the hinge, which turns its normal straight
            # towards the goal's, goes first.
            other = _way(face, hinge, displacement, eyes)
            if other.clear:
                rotations, way, error = [hinge], other, whole.amount
    else:
        rotations = [hinge, planar]
        way = _way(face, hinge, displacement, eyes)
    rotations[0] = _turned(rotations[0], way.angle)
    chosen = [translation, *rotations]
    turns = rotations[0].status == MOVES
    amounts = np.array([part.amount for part in chosen])
    status = np.array([part.status for part in chosen], dtype=np.int64)
    allowed = np.where([bool(part.screw.any()) for part in chosen], amounts, 0.0)
    limits = np.full(k, math.inf)
    if moves:
        allowed[0] = amounts[0] * min(1.0, APPROACH * way.translation)
        if way.translation < 1.0:
            limits[0] = STEP_OF_BOUND * way.translation * amounts[0]
    if turns:
        allowed[1] = min(amounts[1], APPROACH * way.turn)
        if way.turn < amounts[1]:
            limits[1] = STEP_OF_BOUND * way.turn
    waits = (allowed < amounts) & (status == MOVES)
    status[waits] = WAITS
    rates = np.array([translation_rate] + (k - 1) * [rotation_rate])
    velocity = _velocity(
        operators, composition, np.vstack([points, centre[None]]), chosen, gains, allowed, limits, rates, dt_s
    )
    if error is not None:
        amounts[1] = error
        status[1] = WAITS
    return CartesianStep(velocity, amounts, allowed, status)


def one_rotation(operators: FloatArray, hinge: Part, planar: Part) -> Part:
    """``Ĥ_s`` (eigenvalues ±i), its joint screw and θ_s in [0, π] of ``exp(θ_rĤ_r)exp(θ_pĤ_p)`` (8.50 to 8.52, errata).

    A turn that the arm cannot make is left out of it; the status then says NOT_REACHABLE.
    """
    status = MOVES
    for part in (hinge, planar):
        if part.status == NOT_REACHABLE:
            status = NOT_REACHABLE
    H_r, H_p = hinge.generator, planar.generator
    s_r, c_r = math.sin(hinge.amount / 2), math.cos(hinge.amount / 2)
    s_p, c_p = math.sin(planar.amount / 2), math.cos(planar.amount / 2)
    if not H_r.any():
        s_r, c_r = 0.0, 1.0
    cosine = c_r * c_p + s_r * s_p * float(np.trace(H_r @ H_p)) / 2
    V = s_r * c_p * H_r + c_r * s_p * H_p + s_r * s_p * (H_r @ H_p - H_p @ H_r)
    sine = math.sqrt(max(0.0, -0.5 * float(np.trace(V @ V))))
    if cosine < 0.0:
        V, cosine = -V, -cosine
    if not sine > 0.0:
        done = DONE if status == MOVES else status
        return Part(np.zeros(len(operators)), np.zeros((4, 4)), 0.0, done)
    V = V / sine
    basis = arm_freedoms(operators).joints  # (8.56) in it
    screw = basis @ (basis.T @ operators.reshape(len(operators), 16) @ V.reshape(16))
    left = np.tensordot(screw, operators, axes=1) - V
    if float((left**2).sum()) > REACH_RATIO**2 * float((V**2).sum()):
        status = NOT_REACHABLE
    return Part(screw, V, 2.0 * math.atan2(sine, cosine), status)


def _part(parts: Decomposition, name: str) -> Part:
    component = getattr(parts, name)
    status = component.status
    if status == WAITS:
        status = MOVES
    return Part(component.screw, component.operator, component.amount, int(status))


def _way(face: FloatArray, rotation: Part, displacement: FloatArray, eyes: FloatArray) -> Way:
    angle = rotation.amount if rotation.screw.any() else 0.0
    return visible_rotation(face, rotation.generator, displacement, eyes, angle)


def _turned(part: Part, angle: float) -> Part:
    """The component in the sense of ``angle``."""
    if not part.screw.any() or angle >= 0.0:
        return part
    return Part(-part.screw, -part.generator, -angle, part.status)


def _velocity(
    operators: FloatArray,
    composition: Composition,
    points: FloatArray,
    parts: list[Part],
    gains: FloatArray,
    allowed: FloatArray,
    limits: FloatArray,
    rates: FloatArray,
    dt_s: float,
) -> FloatArray:
    screws = np.array([part.screw for part in parts])
    if not dt_s > 0.0:
        velocity: FloatArray = np.minimum(gains * allowed, rates) @ screws
        return velocity
    amounts = np.minimum(np.minimum(-np.expm1(-gains * dt_s) * allowed, rates * dt_s), limits)
    amounts = amounts / max(1.0, float(np.abs(amounts @ screws).max()) / LONGEST_STEP)
    wanted = points
    for part, amount in zip(reversed(parts), amounts[::-1], strict=True):
        wanted = wanted @ exp_twist(amount * part.generator).T
    return corrected_step(operators, composition, points, wanted, amounts @ screws) / dt_s


def cartesian3_law(
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    centre: FloatArray,
    centre_target: FloatArray,
    camera_centres: FloatArray,
    gains: FloatArray,
) -> CartesianStep:
    """The instantaneous law in three components: `cartesian.cartesian_law`, the reference of `cartesian3_step`."""
    return cartesian_law(
        operators, Composition.BASE_FIRST, points, targets, centre, centre_target, camera_centres, gains, 0.0, inf,
        inf, False,
    )  # fmt: skip
