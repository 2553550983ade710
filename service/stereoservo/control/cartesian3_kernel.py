"""`cartesian3.cartesian3_law` in numba: primitives, decomposition and law in one call, no BLAS, no allocation
of note.

Names, order and thresholds are those of `trajectory.primitives` and `trajectory.three_points`; read those
first.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.cartesian3 import IntArray
from stereoservo.control.linear_kernels import null_direction, right_singular
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel
from stereoservo.trajectory.primitives import (
    DEGENERATE_RATIO,
    NOISE_RATIO,
    RANK_RATIO,
    REACH_RATIO,
    RIGID_FREEDOMS,
)
from stereoservo.trajectory.three_points import COINCIDENT, FLAT_FACE, VISIBILITY_SHARE, ComponentStatus

MOVES = int(ComponentStatus.MOVES)
DONE = int(ComponentStatus.DONE)
NOT_REACHABLE = int(ComponentStatus.NOT_REACHABLE)
WAITS = int(ComponentStatus.WAITS)
NO_FACE = int(ComponentStatus.NO_FACE)


@kernel
def _dot(x: FloatArray, y: FloatArray) -> float:
    total: float = x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]
    return total


@kernel
def _norm(x: FloatArray) -> float:
    return math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])


@kernel
def _unit(x: FloatArray) -> FloatArray:
    length = _norm(x)
    y = np.empty(4)
    for i in range(4):
        y[i] = x[i] / length
    return y


@kernel
def _apply(H: FloatArray, x: FloatArray) -> FloatArray:
    y = np.empty(4)
    for i in range(4):
        y[i] = H[i, 0] * x[0] + H[i, 1] * x[1] + H[i, 2] * x[2] + H[i, 3] * x[3]
    return y


@kernel
def _apply_transposed(H: FloatArray, x: FloatArray) -> FloatArray:
    y = np.empty(4)
    for i in range(4):
        y[i] = H[0, i] * x[0] + H[1, i] * x[1] + H[2, i] * x[2] + H[3, i] * x[3]
    return y


@kernel
def _minors(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    """``aᵀX = det[p q r X]``: plane of three points, or point of three planes."""
    xy, xz, xw = p[0] * q[1] - p[1] * q[0], p[0] * q[2] - p[2] * q[0], p[0] * q[3] - p[3] * q[0]
    yz, yw, zw = p[1] * q[2] - p[2] * q[1], p[1] * q[3] - p[3] * q[1], p[2] * q[3] - p[3] * q[2]
    a = np.empty(4)
    a[0] = -(r[1] * zw - r[2] * yw + r[3] * yz)
    a[1] = r[0] * zw - r[2] * xw + r[3] * xz
    a[2] = -(r[0] * yw - r[1] * xw + r[3] * xy)
    a[3] = r[0] * yz - r[1] * xz + r[2] * xy
    return a


@kernel
def _complement(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal pair, orthogonal to two unit vectors that are not one."""
    u = np.empty(4)
    along = _dot(x, y)
    for i in range(4):
        u[i] = y[i] - along * x[i]
    u = _unit(u)
    first = np.zeros(4)
    longest = -1.0
    for axis in range(4):
        share = 1.0 - x[axis] * x[axis] - u[axis] * u[axis]
        if share > longest:
            longest = share
            for i in range(4):
                first[i] = -x[axis] * x[i] - u[axis] * u[i]
            first[axis] += 1.0
    first = _unit(first)
    return first, _unit(_minors(x, u, first))


@kernel
def _primitive(
    operators: FloatArray, basis: FloatArray, system: FloatArray, screw: FloatArray, H: FloatArray
) -> bool:
    """Kernel of an (8, n) system in the arm's freedoms (n, r): joint screw and operator; False: not
    reachable.
    """
    n, rank = basis.shape
    if rank == 0:
        return False
    reduced = np.zeros((8, rank))
    for i in range(8):
        for k in range(rank):
            s = 0.0
            for j in range(n):
                s += system[i, j] * basis[j, k]
            reduced[i, k] = s
    x, smallest, second, largest = null_direction(reduced)
    if rank == 1:
        second = 1.0
    threshold = NOISE_RATIO if rank == RIGID_FREEDOMS else REACH_RATIO
    if second <= DEGENERATE_RATIO * largest or smallest > threshold * second:
        return False
    for i in range(4):
        for k in range(4):
            H[i, k] = 0.0
    for j in range(n):
        s = 0.0
        for k in range(rank):
            s += basis[j, k] * x[k]
        screw[j] = s
        for i in range(4):
            for k in range(4):
                H[i, k] += s * operators[j, i, k]
    return True


@kernel
def _scale(screw: FloatArray, H: FloatArray, factor: float) -> None:
    for j in range(screw.shape[0]):
        screw[j] *= factor
    for i in range(4):
        for k in range(4):
            H[i, k] *= factor


@kernel
def _as_rotation(screw: FloatArray, H: FloatArray) -> bool:
    trace, size = 0.0, 0.0
    for i in range(4):
        for k in range(4):
            trace += H[i, k] * H[k, i]
            size += H[i, k] * H[i, k]
    square = -0.5 * trace
    if not square > DEGENERATE_RATIO * size:
        return False
    _scale(screw, H, 1.0 / math.sqrt(square))
    return True


@kernel
def _set_point_rows(operators: FloatArray, A: FloatArray, system: FloatArray, row: int) -> None:
    for j in range(operators.shape[0]):
        velocity = _apply(operators[j], A)
        for i in range(4):
            system[row + i, j] = velocity[i]


@kernel
def _set_plane_rows(operators: FloatArray, a: FloatArray, system: FloatArray, row: int) -> None:
    for j in range(operators.shape[0]):
        velocity = _apply_transposed(operators[j], a)
        for i in range(4):
            system[row + i, j] = velocity[i]


@kernel
def _freedoms(operators: FloatArray) -> FloatArray:
    n = operators.shape[0]
    stacked = np.empty((16, n))
    for j in range(n):
        for i in range(4):
            for k in range(4):
                stacked[4 * i + k, j] = operators[j, i, k]
    V, values = right_singular(stacked)
    rank = 0
    while rank < min(n, RIGID_FREEDOMS) and values[rank] > RANK_RATIO * values[0]:
        rank += 1
    basis = np.empty((n, rank))
    for j in range(n):
        for k in range(rank):
            basis[j, k] = V[j, k] / values[k]
    return basis


@kernel
def _front(H: FloatArray, a: FloatArray, eye: FloatArray) -> tuple[float, float, float]:
    once = _apply(H, eye)
    twice = _apply(H, once)
    u, v = _dot(a, once), _dot(a, twice)
    return _dot(a, eye) + v, math.sqrt(u * u + v * v), math.atan2(-u, -v)


@kernel
def _wrapped(angle: float) -> float:
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


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
def _flat(A: FloatArray, face: FloatArray) -> bool:
    first = _norm(A[1] - A[0])
    second = _norm(A[2] - A[0])
    return not _norm(face) > FLAT_FACE * first * second * _norm(A[0])


@kernel
def cartesian3_step(
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    centre: FloatArray,
    centre_target: FloatArray,
    camera_centres: FloatArray,
    gains: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Joint velocity (n,), task error (3,), allowed (3,), status (3,): see `cartesian3.cartesian3_law`
    (8.42).
    """
    n = operators.shape[0]
    cameras = camera_centres.shape[0]
    velocity = np.zeros(n)
    amount, allowed = np.zeros(3), np.zeros(3)
    status = np.full(3, DONE)
    face = _minors(points[0], points[1], points[2])
    face_star = _minors(targets[0], targets[1], targets[2])
    if _flat(points, face) or _flat(targets, face_star):
        for i in range(3):
            status[i] = NO_FACE
        return velocity, amount, allowed, status
    basis = _freedoms(operators)
    displacement = np.empty(4)
    for k in range(4):
        displacement[k] = centre_target[k] - centre[k]

    middle = np.zeros(4)
    for c in range(cameras):
        for k in range(4):
            middle[k] += camera_centres[c, k] / cameras
    side = 1.0 if _dot(face_star, middle) >= 0.0 else -1.0
    seeing = np.zeros(cameras)
    for c in range(cameras):
        if side * _dot(face, camera_centres[c]) > 0.0 and side * _dot(face_star, camera_centres[c]) > 0.0:
            seeing[c] = 1.0

    system = np.zeros((8, n))
    screw = np.zeros(n)
    H = np.zeros((4, 4))
    unit_centre = _unit(centre)

    tau = _norm(displacement)
    if tau > COINCIDENT * _norm(centre):
        amount[0] = tau
        status[0] = NOT_REACHABLE
        direction = _unit(displacement)
        a1, a2 = _complement(unit_centre, direction)
        _set_plane_rows(operators, a1, system, 0)
        _set_plane_rows(operators, a2, system, 4)
        if _primitive(operators, basis, system, screw, H):
            step = _apply(H, centre)
            scale = math.copysign(_norm(step), _dot(step, direction))
            if abs(scale) > DEGENERATE_RATIO * _norm(centre):
                _scale(screw, H, 1.0 / scale)
                amount[0] = _dot(displacement, _apply(H, centre))
                bound = math.inf
                for c in range(cameras):
                    if seeing[c] > 0.0:
                        rate = side * _dot(face, _apply(H, camera_centres[c]))
                        if rate > 0.0:
                            bound = min(bound, side * _dot(face, camera_centres[c]) / rate)
                _enter(velocity, screw, amount, allowed, status, 0, bound, gains[0])

    A_c = _shifted(points, centre)
    A_r = _shifted(targets, centre)
    a = _unit(_minors(A_c[0], A_c[1], A_c[2]))
    a_t = _unit(_minors(A_r[0], A_r[1], A_r[2]))
    together = _dot(a, a_t)
    difference = np.empty(4)
    for k in range(4):
        difference[k] = a_t[k] - together * a[k]
    hinged = True
    axis_point = np.empty(4)
    if _norm(difference) > COINCIDENT:
        axis_point = _minors(a, _unit(difference), unit_centre)
    elif together > 0.0:
        hinged = False
    else:
        longest = -1.0
        for i in range(3):
            length = _norm(A_c[i] - centre)
            if length > longest:
                longest = length
                for k in range(4):
                    axis_point[k] = A_c[i, k]
    if hinged:
        amount[1] = math.acos(min(1.0, max(-1.0, together)))
        status[1] = NOT_REACHABLE
        along = _dot(axis_point, unit_centre)
        second_point = np.empty(4)
        for k in range(4):
            second_point[k] = axis_point[k] - along * unit_centre[k]
        _set_point_rows(operators, unit_centre, system, 0)
        _set_point_rows(operators, _unit(second_point), system, 4)
        if _primitive(operators, basis, system, screw, H) and _as_rotation(screw, H):
            theta = _hinge_angle(H, a, a_t)
            theta = _visible_sense(H, a, side, theta, cameras, middle, displacement)
            if theta < 0.0:
                _scale(screw, H, -1.0)
                theta = -theta
            bound = math.inf
            for c in range(cameras):
                if seeing[c] > 0.0:
                    k0, R, phi = _front(H, face, camera_centres[c])
                    if side < 0.0:
                        k0, phi = -k0, _wrapped(phi + math.pi)
                    if k0 < R:
                        bound = min(bound, max(0.0, phi + math.acos(max(-1.0, -k0 / R))))
            amount[1] = theta
            _enter(velocity, screw, amount, allowed, status, 1, bound, gains[1])
            sine, versine = math.sin(-theta), 2.0 * math.sin(0.5 * theta) ** 2
            for i in range(3):
                once = _apply(H, A_r[i])
                twice = _apply(H, once)
                for k in range(4):
                    A_r[i, k] += sine * once[k] + versine * twice[k]

    _set_plane_rows(operators, a, system, 0)
    _set_point_rows(operators, unit_centre, system, 4)
    status[2] = NOT_REACHABLE
    if _primitive(operators, basis, system, screw, H) and _as_rotation(screw, H):
        theta = _planar_angle(H, A_c, A_r)
        if theta < 0.0:
            _scale(screw, H, -1.0)
            theta = -theta
        amount[2] = theta
        _enter(velocity, screw, amount, allowed, status, 2, math.inf, gains[2])
    return velocity, amount, allowed, status


@kernel
def _enter(
    velocity: FloatArray,
    screw: FloatArray,
    amount: FloatArray,
    allowed: FloatArray,
    status: IntArray,
    i: int,
    bound: float,
    gain: float,
) -> None:
    """Add a component to the velocity, as far as visibility lets it plan."""
    allowed[i] = min(amount[i], VISIBILITY_SHARE * bound)
    status[i] = MOVES if allowed[i] >= amount[i] else WAITS
    for j in range(screw.shape[0]):
        velocity[j] += gain * allowed[i] * screw[j]


@kernel
def _hinge_angle(H: FloatArray, a: FloatArray, a_t: FloatArray) -> float:
    u = _apply_transposed(H, a)
    v = _apply_transposed(H, u)
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
        u = _apply(H, A[i])
        v = _apply(H, u)
        for k in range(4):
            right = A_r[i, k] - A[i, k] - v[k]
            uu += u[k] * u[k]
            vv += v[k] * v[k]
            uv += u[k] * v[k]
            ur += u[k] * right
            vr += v[k] * right
    return math.atan2(ur * vv - uv * vr, uv * ur - uu * vr)


@kernel
def _visible_sense(
    H: FloatArray,
    a: FloatArray,
    side: float,
    theta: float,
    cameras: int,
    middle: FloatArray,
    displacement: FloatArray,
) -> float:
    if cameras == 0:
        return theta
    eye, eye_then = np.empty(4), np.empty(4)
    for k in range(4):
        eye[k] = side * middle[k]
        eye_then[k] = side * (middle[k] - displacement[k])
    _, size, now = _front(H, a, eye)
    _, size_then, then = _front(H, a, eye_then)
    if min(size, size_then) <= COINCIDENT * _norm(middle):
        return theta
    then = now + _wrapped(then - now)
    return then + _wrapped(theta - then)
