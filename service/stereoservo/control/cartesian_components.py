"""Kernels of the components of a Cartesian law: translation of the centre, hinge and planar turn of a face, each as the
joint screw that makes it and its operator (thesis 7.18 to 7.24; numpy reference: `planning.three_point_decomposition`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.primitives_kernel import (
    apply,
    apply_transposed,
    as_rotation,
    complement,
    dot,
    minors,
    norm,
    primitive,
    scale_primitive,
    set_plane_rows,
    set_point_rows,
    unit,
)
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.primitives import DEGENERATE_RATIO
from stereoservo.planning.three_point_decomposition import COINCIDENT, DONE, FLAT_FACE, MOVES, NOT_REACHABLE


@kernel
def _shifted(A: FloatArray, centre: FloatArray) -> FloatArray:
    """Points moved in parallel so that their middle is the centre."""
    out = np.empty((3, 4))
    for k in range(4):
        shift = centre[k] - (A[0, k] + A[1, k] + A[2, k]) / 3.0
        for i in range(3):
            out[i, k] = A[i, k] + shift
    return out


@kernel
def is_flat(A: FloatArray, face: FloatArray) -> bool:
    """Whether the points (3, 4), of plane (4,), are collinear or not finite."""
    first = norm(A[1] - A[0])
    second = norm(A[2] - A[0])
    return not norm(face) > FLAT_FACE * first * second * norm(A[0])


class FaceTask(NamedTuple):
    """Three ``points`` (3, 4) of one face now and at the goal, ``targets`` (3, 4); ``centre`` and ``centre_target``
    (4,): all of height ``a∞ᵀM = 1``.
    """

    points: FloatArray
    targets: FloatArray
    centre: FloatArray
    centre_target: FloatArray


class Components(NamedTuple):
    """Translation, hinge and planar turn (7.18 to 7.24): ``screws`` (3, n), ``generators`` (3, 4, 4), ``amount`` (3,),
    ``status`` (3,). Amounts are >= 0, angles in [0, π]. Screws and generators of components that are done or not
    reachable are zero.
    """

    screws: FloatArray
    generators: FloatArray
    amount: FloatArray
    status: IntArray


@kernel
def decompose(operators: FloatArray, basis: FloatArray, task: FaceTask) -> Components:
    """The components of a motion. ``basis`` (n, r) of the arm's freedoms."""
    points, targets, centre = task.points, task.targets, task.centre
    n = operators.shape[0]
    found = Components(np.zeros((3, n)), np.zeros((3, 4, 4)), np.zeros(3), np.full(3, DONE))
    system = np.zeros((8, n))
    unit_centre = unit(centre)
    _translation(operators, basis, task, unit_centre, system, found)
    A_c = _shifted(points, centre)
    A_r = _shifted(targets, centre)
    a = unit(minors(A_c[0], A_c[1], A_c[2]))
    a_t = unit(minors(A_r[0], A_r[1], A_r[2]))
    _hinge(operators, basis, centre, unit_centre, a, a_t, A_c, A_r, system, found)
    set_plane_rows(operators, a, system, 0)
    set_point_rows(operators, unit_centre, system, 4)
    found.status[2] = NOT_REACHABLE
    screw, H = np.zeros(n), np.zeros((4, 4))
    if primitive(operators, basis, system, screw, H) and as_rotation(screw, H):
        theta = _planar_angle(H, A_c, A_r)
        if theta < 0.0:
            scale_primitive(screw, H, -1.0)
            theta = -theta
        found.amount[2] = theta
        _keep(screw, H, 2, found)
    return found


@kernel
def _translation(
    operators: FloatArray, basis: FloatArray, task: FaceTask, unit_centre: FloatArray, system: FloatArray,
    found: Components,
) -> None:  # fmt: skip
    """The centre's translation into the first of the components; ``system`` (8, n): scratch."""
    centre, centre_target = task.centre, task.centre_target
    n = operators.shape[0]
    displacement = np.empty(4)
    for k in range(4):
        displacement[k] = centre_target[k] - centre[k]
    tau = norm(displacement)
    if tau > COINCIDENT * norm(centre):
        found.amount[0] = tau
        found.status[0] = NOT_REACHABLE
        direction = unit(displacement)
        a1, a2 = complement(unit_centre, direction)
        set_plane_rows(operators, a1, system, 0)
        set_plane_rows(operators, a2, system, 4)
        screw, H = np.zeros(n), np.zeros((4, 4))
        if primitive(operators, basis, system, screw, H):
            step = apply(H, centre)
            scale = math.copysign(norm(step), dot(step, direction))
            if abs(scale) > DEGENERATE_RATIO * norm(centre):
                scale_primitive(screw, H, 1.0 / scale)
                found.amount[0] = dot(displacement, apply(H, centre))
                _keep(screw, H, 0, found)


@kernel
def _hinge(
    operators: FloatArray, basis: FloatArray, centre: FloatArray, unit_centre: FloatArray, a: FloatArray,
    a_t: FloatArray, A_c: FloatArray, A_r: FloatArray, system: FloatArray, found: Components,
) -> None:  # fmt: skip
    """The hinge of the face's plane ``a`` (4,) to ``a_t`` into the second of the components.

    The face's points at the goal, ``A_r`` (3, 4), are turned back by it; ``A_c`` (3, 4): those now.
    """
    n = operators.shape[0]
    together = dot(a, a_t)
    difference = np.empty(4)
    for k in range(4):
        difference[k] = a_t[k] - together * a[k]
    hinged = True
    axis_point = np.empty(4)
    if norm(difference) > COINCIDENT:
        axis_point = minors(a, unit(difference), unit_centre)
    elif together > 0.0:
        hinged = False
    else:
        longest = -1.0
        for i in range(3):
            length = norm(A_c[i] - centre)
            if length > longest:
                longest = length
                for k in range(4):
                    axis_point[k] = A_c[i, k]
    if hinged:
        found.amount[1] = math.acos(min(1.0, max(-1.0, together)))
        found.status[1] = NOT_REACHABLE
        along = dot(axis_point, unit_centre)
        second_point = np.empty(4)
        for k in range(4):
            second_point[k] = axis_point[k] - along * unit_centre[k]
        set_point_rows(operators, unit_centre, system, 0)
        set_point_rows(operators, unit(second_point), system, 4)
        screw, H = np.zeros(n), np.zeros((4, 4))
        if primitive(operators, basis, system, screw, H) and as_rotation(screw, H):
            theta = _hinge_angle(H, a, a_t)
            if theta < 0.0:
                scale_primitive(screw, H, -1.0)
                theta = -theta
            found.amount[1] = theta
            _keep(screw, H, 1, found)
            sine, versine = math.sin(-theta), 2.0 * math.sin(0.5 * theta) ** 2
            for i in range(3):
                once = apply(H, A_r[i])
                twice = apply(H, once)
                for k in range(4):
                    A_r[i, k] += sine * once[k] + versine * twice[k]


@kernel
def _keep(screw: FloatArray, H: FloatArray, i: int, found: Components) -> None:
    found.status[i] = MOVES
    for j in range(screw.shape[0]):
        found.screws[i, j] = screw[j]
    for k in range(4):
        for m in range(4):
            found.generators[i, k, m] = H[k, m]


@kernel
def _hinge_angle(H: FloatArray, a: FloatArray, a_t: FloatArray) -> float:
    u = apply_transposed(H, a)
    v = apply_transposed(H, u)
    uu, vv, uv, ur, vr = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        right = a_t[k] - a[k] - v[k]
        uu += u[k] * u[k]
        vv += v[k] * v[k]
        uv -= u[k] * v[k]
        ur -= u[k] * right
        vr += v[k] * right
    return math.atan2(ur * vv - uv * vr, uv * ur - uu * vr)


@kernel
def _planar_angle(H: FloatArray, A: FloatArray, A_r: FloatArray) -> float:
    uu, vv, uv, ur, vr = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(A.shape[0]):
        u = apply(H, A[i])
        v = apply(H, u)
        for k in range(4):
            right = A_r[i, k] - A[i, k] - v[k]
            uu += u[k] * u[k]
            vv += v[k] * v[k]
            uv += u[k] * v[k]
            ur += u[k] * right
            vr += v[k] * right
    return math.atan2(ur * vv - uv * vr, uv * ur - uu * vr)
