"""Kernels of the components of a Cartesian law: translation of the centre, hinge and planar turn of a face, each as the
joint screw that makes it and its operator (thesis 7.18 to 7.24; numpy reference: `planning.three_point_decomposition`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.primitives_kernel import (
    Freedoms,
    as_rotation,
    complement,
    dot,
    drop_primitive,
    minors,
    norm,
    primitive,
    product,
    scale_primitive,
    set_plane_columns,
    set_point_columns,
    transposed_product,
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


class CentredFace(NamedTuple):
    """A face, moved in parallel so that its middle is the ``centre`` (4,) of its body: ``points`` (3, 4) now and at the
    goal, ``targets``, their unit planes ``now`` and ``then`` (4,); ``unit_centre`` (4,): the centre at length 1.
    """

    centre: FloatArray
    unit_centre: FloatArray
    now: FloatArray
    then: FloatArray
    points: FloatArray
    targets: FloatArray


@kernel
def decompose(freedoms: Freedoms, task: FaceTask) -> Components:
    """The components of a motion, of an arm of such freedoms."""
    points, targets, centre = task.points, task.targets, task.centre
    n, rank = freedoms.basis.shape
    found = Components(np.zeros((3, n)), np.zeros((3, 4, 4)), np.zeros(3), np.full(3, DONE))
    system = np.empty((rank, 8))
    unit_centre = unit(centre)
    _translation(freedoms, task, unit_centre, system, found)
    A_c = _shifted(points, centre)
    A_r = _shifted(targets, centre)
    a = unit(minors(A_c[0], A_c[1], A_c[2]))
    a_t = unit(minors(A_r[0], A_r[1], A_r[2]))
    _hinge(freedoms, CentredFace(centre, unit_centre, a, a_t, A_c, A_r), system, found)
    set_plane_columns(freedoms.motions, a, system, 0)
    set_point_columns(freedoms.motions, unit_centre, system, 4)
    found.status[2] = NOT_REACHABLE
    screw, H = found.screws[2], found.generators[2]
    if primitive(freedoms, system, screw, H) and as_rotation(screw, H):
        theta = _planar_angle(H, A_c, A_r)
        if theta < 0.0:
            scale_primitive(screw, H, -1.0)
            theta = -theta
        found.amount[2] = theta
        found.status[2] = MOVES
    else:
        drop_primitive(screw, H)
    return found


@kernel
def _translation(
    freedoms: Freedoms, task: FaceTask, unit_centre: FloatArray, system: FloatArray, found: Components
) -> None:
    """The centre's translation into the first of the components; ``system`` (r, 8): scratch."""
    centre, centre_target = task.centre, task.centre_target
    displacement = np.empty(4)
    for k in range(4):
        displacement[k] = centre_target[k] - centre[k]
    tau = norm(displacement)
    if not tau > COINCIDENT * norm(centre):
        return
    found.amount[0] = tau
    found.status[0] = NOT_REACHABLE
    direction = unit(displacement)
    a1, a2 = complement(unit_centre, direction)
    set_plane_columns(freedoms.motions, a1, system, 0)
    set_plane_columns(freedoms.motions, a2, system, 4)
    screw, H = found.screws[0], found.generators[0]
    if primitive(freedoms, system, screw, H):
        x, y, z, w = product(H, centre[0], centre[1], centre[2], centre[3])
        scale = math.copysign(
            math.sqrt(x * x + y * y + z * z + w * w),
            x * direction[0] + y * direction[1] + z * direction[2] + w * direction[3],
        )
        if abs(scale) > DEGENERATE_RATIO * norm(centre):
            scale_primitive(screw, H, 1.0 / scale)
            x, y, z, w = product(H, centre[0], centre[1], centre[2], centre[3])
            found.amount[0] = (
                displacement[0] * x + displacement[1] * y + displacement[2] * z + displacement[3] * w
            )
            found.status[0] = MOVES
            return
    drop_primitive(screw, H)


@kernel
def _hinge(freedoms: Freedoms, face: CentredFace, system: FloatArray, found: Components) -> None:
    """The hinge of the face's plane to that at the goal into the second of the components.

    The face's points at the goal are turned back by it; ``system`` (r, 8): scratch.
    """
    centre, unit_centre, a, a_t, A_c, A_r = face
    together = dot(a, a_t)
    difference = np.empty(4)
    for k in range(4):
        difference[k] = a_t[k] - together * a[k]
    axis_point = np.empty(4)
    if norm(difference) > COINCIDENT:
        axis_point = minors(a, unit(difference), unit_centre)
    elif together > 0.0:
        return
    else:
        longest = -1.0
        for i in range(3):
            length = norm(A_c[i] - centre)
            if length > longest:
                longest = length
                for k in range(4):
                    axis_point[k] = A_c[i, k]
    found.amount[1] = math.acos(min(1.0, max(-1.0, together)))
    found.status[1] = NOT_REACHABLE
    along = dot(axis_point, unit_centre)
    for k in range(4):
        axis_point[k] -= along * unit_centre[k]
    set_point_columns(freedoms.motions, unit_centre, system, 0)
    set_point_columns(freedoms.motions, unit(axis_point), system, 4)
    screw, H = found.screws[1], found.generators[1]
    if not (primitive(freedoms, system, screw, H) and as_rotation(screw, H)):
        drop_primitive(screw, H)
        return
    theta = _hinge_angle(H, a, a_t)
    if theta < 0.0:
        scale_primitive(screw, H, -1.0)
        theta = -theta
    found.amount[1] = theta
    found.status[1] = MOVES
    sine, versine = math.sin(-theta), 2.0 * math.sin(0.5 * theta) ** 2
    for i in range(3):
        x, y, z, w = product(H, A_r[i, 0], A_r[i, 1], A_r[i, 2], A_r[i, 3])
        xx, yy, zz, ww = product(H, x, y, z, w)
        A_r[i, 0] += sine * x + versine * xx
        A_r[i, 1] += sine * y + versine * yy
        A_r[i, 2] += sine * z + versine * zz
        A_r[i, 3] += sine * w + versine * ww


@kernel
def _hinge_angle(H: FloatArray, a: FloatArray, a_t: FloatArray) -> float:
    u = transposed_product(H, a[0], a[1], a[2], a[3])
    v = transposed_product(H, u[0], u[1], u[2], u[3])
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
        u = product(H, A[i, 0], A[i, 1], A[i, 2], A[i, 3])
        v = product(H, u[0], u[1], u[2], u[3])
        for k in range(4):
            right = A_r[i, k] - A[i, k] - v[k]
            uu += u[k] * u[k]
            vv += v[k] * v[k]
            uv += u[k] * v[k]
            ur += u[k] * right
            vr += v[k] * right
    return math.atan2(ur * vv - uv * vr, uv * ur - uu * vr)
