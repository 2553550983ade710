"""Kernels of the components of a Cartesian law: translation of the centre, hinge and planar turn of a face, each as the
joint screw that produces it and its operator (thesis 7.18 to 7.24; numpy reference:
`planning.three_point_decomposition`);
below them the primitive motions of an arm (translation, two kinds of revolution; reference: `planning.primitives`), and
the algebra of points and planes that they need.

Names, order and thresholds are those of the references; read these first. No BLAS, and only small allocations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import (
    left_null_direction,
    null_direction,
    orthonormal_rows,
    right_singular,
)
from stereoservo.planning.primitives import (
    DEGENERATE_RATIO,
    NOISE_RATIO,
    RANK_RATIO,
    REACH_RATIO,
    RIGID_FREEDOMS,
)
from stereoservo.planning.three_point_decomposition import COINCIDENT, DONE, FLAT_FACE, MOVES, NOT_REACHABLE


@kernel
def _shifted(A: FloatArray, centre: FloatArray) -> FloatArray:
    """Points translated so that their centroid is the centre."""
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
    """A face, translated so that its centroid is the ``centre`` (4,) of its body: current ``points`` (3, 4) and those
    at the goal, ``targets``, their unit planes ``now`` and ``then`` (4,); ``unit_centre`` (4,): the centre at length 1.
    """

    centre: FloatArray
    unit_centre: FloatArray
    now: FloatArray
    then: FloatArray
    points: FloatArray
    targets: FloatArray


@kernel
def decompose(freedoms: Freedoms, task: FaceTask) -> Components:
    """The components of a motion, for an arm with the given freedoms."""
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
    """Compute the translation of the centre as the first of the components; ``system`` (r, 8): scratch."""
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
            found.amount[0] = displacement[0] * x + displacement[1] * y + displacement[2] * z + displacement[3] * w
            found.status[0] = MOVES
            return
    drop_primitive(screw, H)


@kernel
def _hinge(freedoms: Freedoms, face: CentredFace, system: FloatArray, found: Components) -> None:
    """Compute the hinge from the face's plane to that at the goal as the second of the components.

    The face's points at the goal are rotated back by it; ``system`` (r, 8): scratch.
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


OUT = 0.1
"""Fraction of the distance from a face to a camera: about the size of the face, so that lengths along and across it are
similar.
"""
SPANS_NO_SPACE = 1e-26
"""Fraction of a coordinate's square that the others do not explain, below which points span no space."""


@kernel
def dot(x: FloatArray, y: FloatArray) -> float:
    """Scalar product of two 4-vectors."""
    total: float = x[0] * y[0] + x[1] * y[1] + x[2] * y[2] + x[3] * y[3]
    return total


@kernel
def norm(x: FloatArray) -> float:
    """Norm of a 4-vector."""
    return math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])


@kernel
def unit(x: FloatArray) -> FloatArray:
    """A 4-vector divided by its norm."""
    length = norm(x)
    y = np.empty(4)
    for i in range(4):
        y[i] = x[i] / length
    return y


@kernel
def product(H: FloatArray, x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    """``H (x, y, z, w)ᵀ``."""
    return (
        H[0, 0] * x + H[0, 1] * y + H[0, 2] * z + H[0, 3] * w,
        H[1, 0] * x + H[1, 1] * y + H[1, 2] * z + H[1, 3] * w,
        H[2, 0] * x + H[2, 1] * y + H[2, 2] * z + H[2, 3] * w,
        H[3, 0] * x + H[3, 1] * y + H[3, 2] * z + H[3, 3] * w,
    )


@kernel
def transposed_product(H: FloatArray, x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    """``Hᵀ (x, y, z, w)ᵀ``."""
    return (
        H[0, 0] * x + H[1, 0] * y + H[2, 0] * z + H[3, 0] * w,
        H[0, 1] * x + H[1, 1] * y + H[2, 1] * z + H[3, 1] * w,
        H[0, 2] * x + H[1, 2] * y + H[2, 2] * z + H[3, 2] * w,
        H[0, 3] * x + H[1, 3] * y + H[2, 3] * z + H[3, 3] * w,
    )


@kernel
def minors(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
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
def complement(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal pair, orthogonal to two unit vectors that are not parallel."""
    u = np.empty(4)
    along = dot(x, y)
    for i in range(4):
        u[i] = y[i] - along * x[i]
    u = unit(u)
    first = np.zeros(4)
    longest = -1.0
    for axis in range(4):
        share = 1.0 - x[axis] * x[axis] - u[axis] * u[axis]
        if share > longest:
            longest = share
            for i in range(4):
                first[i] = -x[axis] * x[i] - u[axis] * u[i]
            first[axis] += 1.0
    first = unit(first)
    return first, unit(minors(x, u, first))


class Freedoms(NamedTuple):
    """Motions that an arm can make now: orthonormal ``motions`` (r, 4, 4), and the joint screws ``basis`` (n, r) that
    produce them.
    """

    motions: FloatArray
    basis: FloatArray


@kernel
def primitive(freedoms: Freedoms, system: FloatArray, screw: FloatArray, H: FloatArray) -> bool:
    """The motion in the null space of an (r, 8) ``system``, one row a freedom: writes its joint screw (n,) and operator
    (4, 4). Returns False if it is not reachable.
    """
    motions, basis = freedoms
    n, rank = basis.shape
    if rank == 0:
        return False
    threshold = NOISE_RATIO if rank == RIGID_FREEDOMS else REACH_RATIO
    x = np.empty(rank)
    known = False
    if rank > 1:
        smallest, second, largest = left_null_direction(system.copy(), x)
        known = second > DEGENERATE_RATIO * largest and smallest <= threshold * second
    if not known:  # the bounds are not sufficient: use the singular values themselves
        x, smallest, second, largest = null_direction(np.ascontiguousarray(system.T))
        if rank == 1:
            second = 1.0
        if second <= DEGENERATE_RATIO * largest or smallest > threshold * second:
            return False
    drop_primitive(screw, H)
    for h in range(rank):
        for j in range(n):
            screw[j] += basis[j, h] * x[h]
        for i in range(4):
            for k in range(4):
                H[i, k] += x[h] * motions[h, i, k]
    return True


@kernel
def scale_primitive(screw: FloatArray, H: FloatArray, factor: float) -> None:
    """Multiply a screw (n,) and its operator (4, 4) by a factor."""
    for j in range(screw.shape[0]):
        screw[j] *= factor
    for i in range(4):
        for k in range(4):
            H[i, k] *= factor


@kernel
def drop_primitive(screw: FloatArray, H: FloatArray) -> None:
    """Set a screw (n,) and its operator (4, 4) to zero."""
    for j in range(screw.shape[0]):
        screw[j] = 0.0
    for i in range(4):
        for k in range(4):
            H[i, k] = 0.0


@kernel
def as_rotation(screw: FloatArray, H: FloatArray) -> bool:
    """Scale a rotation to eigenvalues ±i; returns False if it is no rotation."""
    trace, size = 0.0, 0.0
    for i in range(4):
        for k in range(4):
            trace += H[i, k] * H[k, i]
            size += H[i, k] * H[i, k]
    square = -0.5 * trace
    if not square > DEGENERATE_RATIO * size:
        return False
    scale_primitive(screw, H, 1.0 / math.sqrt(square))
    return True


@kernel
def set_point_columns(motions: FloatArray, A: FloatArray, system: FloatArray, column: int) -> None:
    """Write ``Ĥ_k A`` of the motions (r, 4, 4) to columns ``column`` to ``column + 3`` of the system (r, 8)."""
    for k in range(motions.shape[0]):
        H = motions[k]
        for i in range(4):
            system[k, column + i] = H[i, 0] * A[0] + H[i, 1] * A[1] + H[i, 2] * A[2] + H[i, 3] * A[3]


@kernel
def set_plane_columns(motions: FloatArray, a: FloatArray, system: FloatArray, column: int) -> None:
    """Write ``Ĥ_kᵀ a`` of the motions (r, 4, 4) to columns ``column`` to ``column + 3`` of the system (r, 8)."""
    for k in range(motions.shape[0]):
        H = motions[k]
        for i in range(4):
            system[k, column + i] = H[0, i] * a[0] + H[1, i] * a[1] + H[2, i] * a[2] + H[3, i] * a[3]


@kernel
def stacked_singular(operators: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Right singular vectors (n, n) and values (n,), descending, of the operators stacked as columns (16, n)."""
    n = operators.shape[0]
    stacked = np.empty((16, n))
    for j in range(n):
        for i in range(4):
            for k in range(4):
                stacked[4 * i + k, j] = operators[j, i, k]
    V, values = right_singular(stacked)
    return V, values


@kernel
def regular_freedoms(operators: FloatArray, least: float) -> tuple[Freedoms, bool]:
    """The freedoms of an arm of at most six joints, and whether its stacked operators (n, 4, 4) certainly have no
    singular value below ``least`` times the largest.
    """
    n = operators.shape[0]
    found = Freedoms(np.empty((n, 4, 4)), np.empty((n, n)))
    regular = n <= RIGID_FREEDOMS and (
        orthonormal_rows(operators.reshape(n, 16), found.motions.reshape(n, 16), found.basis) > least
    )
    return found, regular


@kernel
def singular_freedoms(operators: FloatArray, V: FloatArray, values: FloatArray) -> Freedoms:
    """`primitives.arm_freedoms`, from `stacked_singular`."""
    n = V.shape[0]
    rank = 0
    while rank < min(n, RIGID_FREEDOMS) and values[rank] > RANK_RATIO * values[0]:
        rank += 1
    basis, motions = np.empty((n, rank)), np.zeros((rank, 4, 4))
    for h in range(rank):
        for j in range(n):
            basis[j, h] = V[j, h] / values[h]
            for i in range(4):
                for k in range(4):
                    motions[h, i, k] += basis[j, h] * operators[j, i, k]
    return Freedoms(motions, basis)


@kernel
def normal_frame(points: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change of frame (4, 4), and its inverse, which normalises the second moment to the identity. The moment is that
    of ``points`` (k, 4) and of points at a small distance from their centroid towards each of ``centres`` (c, 4), all
    of one height. The identity if these span no space.

    Coordinates in the new frame are unique up to a rotation of 4-vectors, whatever projective frame the arguments are
    in. So norms, angles and singular values of conjugated matrices do not depend on it. By Gram-Schmidt
    orthogonalisation of the points' rows.
    """
    k, c = points.shape[0], centres.shape[0]
    rows = np.empty((k + c, 4))
    for p in range(k + c):
        for i in range(4):
            rows[p, i] = points[p % k, i] / math.sqrt(k)
    for p in range(c):
        for i in range(4):
            centroid = 0.0
            for h in range(k):
                centroid += points[h, i] / k
            rows[k + p, i] = (centroid + OUT * (centres[p, i] - centroid)) / math.sqrt(c)
    R = np.zeros((4, 4))
    good = True
    for i in range(4):
        before = 0.0
        for p in range(k + c):
            before += rows[p, i] ** 2
        for _ in range(2):  # twice, because the remainder of a column may be small
            for h in range(i):
                along = 0.0
                for p in range(k + c):
                    along += rows[p, h] * rows[p, i]
                R[h, i] += along
                for p in range(k + c):
                    rows[p, i] -= along * rows[p, h]
        square = 0.0
        for p in range(k + c):
            square += rows[p, i] ** 2
        good = good and square > SPANS_NO_SPACE * before and math.isfinite(square)
        if not good:
            break
        R[i, i] = math.sqrt(square)
        for p in range(k + c):
            rows[p, i] /= R[i, i]
    change, inverse = np.zeros((4, 4)), np.zeros((4, 4))
    for i in range(4):
        if not good:
            change[i, i] = inverse[i, i] = 1.0
            continue
        for h in range(4):
            inverse[i, h] = R[h, i]
    if good:  # the inverse of the lower triangle, column by column
        for h in range(4):
            for i in range(h, 4):
                total = 1.0 if i == h else 0.0
                for m in range(h, i):
                    total -= inverse[i, m] * change[m, h]
                change[i, h] = total / inverse[i, i]
    return change, inverse
