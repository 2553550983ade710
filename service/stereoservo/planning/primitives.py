"""Primitive motions of an arm from its projective joint operators: joint velocities of a translation, a revolution
about an axis, and a revolution of a plane in itself (thesis 7.3).

Each is the kernel of an (8, n) system in the operators ``Ĥ_j|_Q`` (n, 4, 4) at the current configuration. The systems
are solved not in joint velocities but in an orthonormal basis of the operators that the arm can make at its
configuration (`arm_freedoms`): the basis contains no self-motions of a redundant arm, and singular values measure
geometry, not the distance from a singularity. The operators are estimates, so the smallest singular value is never
zero: the criterion is its ratio to the second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError, line_of_planes, planes_through_line
from stereoservo.numerics.arrays import FloatArray

RANK_RATIO = 1e-4
"""Singular value of the stacked operators, relative to the largest, below which a degree of freedom is lost."""

REACH_RATIO = 0.03
"""Smallest to second singular value above which an arm of fewer than six degrees of freedom cannot make the motion."""

NOISE_RATIO = 0.5
"""The same for an arm of six degrees of freedom, which can make any motion: its residual is error of the operators."""

DEGENERATE_RATIO = 1e-9
"""Second to largest singular value below which a system does not define a unique motion."""

RIGID_FREEDOMS = 6

TRANSLATION = "translation of the centre along its line"
HINGE = "revolution of the face about the hinge"
PLANAR = "revolution of the face in its plane"


class NotReachableError(Exception):
    """The arm cannot make a primitive motion at its configuration.

    ``freedom``: name of the motion; ``ratio`` of smallest to second singular value; ``threshold``: largest valid ratio.
    """

    def __init__(self, freedom: str, ratio: float, threshold: float) -> None:
        super().__init__(
            f"not reachable by this arm: {freedom} (the best joint motion violates it by {ratio:.3g} of the "
            f"next one; at most {threshold:.3g} is noise)"
        )
        self.freedom = freedom
        self.ratio = ratio
        self.threshold = threshold


class DegenerateStepError(Exception):
    """The points or planes do not define a unique motion: centre on target, coplanar faces. ``what``: the cause."""

    def __init__(self, what: str) -> None:
        super().__init__(what)
        self.what = what


@dataclass(frozen=True, eq=False)
class Freedoms:
    """Instantaneous motions of an arm: ``joints`` (n, r), velocities whose operators are orthonormal as 16-vectors.

    ``values``: singular values of the stacked operators (16, n), descending; r <= 6 of them count.
    """

    joints: FloatArray
    values: FloatArray


@dataclass(frozen=True, eq=False)
class Primitive:
    """A primitive motion: joint screw ``screw`` (n,) and its operator ``Σ q̂_j Ĥ_j`` (4, 4).

    Rotations: eigenvalues ±i, so that amplitudes are [rad]. ``smallest``, ``second``, ``largest``: singular
    values of the system.
    """

    screw: FloatArray
    operator: FloatArray
    smallest: float
    second: float
    largest: float


def arm_freedoms(operators: FloatArray) -> Freedoms:
    """Orthonormal basis of the rigid motions of an arm with operators (n, 4, 4), without its self-motions."""
    n = operators.shape[0]
    _, values, rows = np.linalg.svd(operators.reshape(n, 16).T, full_matrices=False)
    rank = min(int((values > RANK_RATIO * values[0]).sum()), RIGID_FREEDOMS)
    return Freedoms(np.ascontiguousarray(rows[:rank].T / values[:rank]), values)


def translation_along_axis(
    operators: FloatArray, A1: FloatArray, A2: FloatArray, freedoms: Freedoms | None = None
) -> Primitive:
    """Translation along the line of two points ``(4,)`` of equal height: the pencil of its planes is fixed (7.18).

    Scaled so that it displaces ``A1`` by a 4-vector of length 1, towards ``A2``. Raises NotReachableError, and
    DegenerateStepError if the points coincide.
    """
    try:
        planes = planes_through_line(A1, A2)
    except GeometryError as error:
        raise DegenerateStepError("the centre is on target: no line to translate along") from error
    system = np.concatenate([-plane_velocities(operators, plane) for plane in planes])
    primitive = _kernel(operators, system, freedoms, TRANSLATION)
    step = primitive.operator @ A1
    scale = np.linalg.norm(step) * np.sign(step @ (A2 - A1))
    if not abs(scale) > DEGENERATE_RATIO * float(np.linalg.norm(A1)):
        raise NotReachableError(TRANSLATION, 1.0, REACH_RATIO)
    return _scaled(primitive, 1.0 / float(scale))


def revolution_around_axis(
    operators: FloatArray, A1: FloatArray, A2: FloatArray, freedoms: Freedoms | None = None
) -> Primitive:
    """Rotation about the axis through two points ``(4,)``, which are fixed (7.19); eigenvalues ±i, either sense.

    Raises NotReachableError, and DegenerateStepError if the points coincide.
    """
    try:
        points = line_of_planes(*planes_through_line(A1, A2))
    except GeometryError as error:
        raise DegenerateStepError("the two points of the axis are one") from error
    system = np.concatenate([point_velocities(operators, point) for point in points])
    return _as_rotation(_kernel(operators, system, freedoms, HINGE), HINGE)


def revolution_in_plane(
    operators: FloatArray, a: FloatArray, A: FloatArray, freedoms: Freedoms | None = None
) -> Primitive:
    """Rotation of a plane ``a`` (4,) in itself about its point ``A`` (4,) (7.20); eigenvalues ±i, either sense.

    Raises NotReachableError, and DegenerateStepError if they define no axis.
    """
    system = np.concatenate(
        [
            -plane_velocities(operators, a / np.linalg.norm(a)),
            point_velocities(operators, A / np.linalg.norm(A)),
        ]
    )
    return _as_rotation(_kernel(operators, system, freedoms, PLANAR), PLANAR)


def point_velocities(operators: FloatArray, A: FloatArray) -> FloatArray:
    """``Ĥ_j A`` as columns (4, n)."""
    return np.ascontiguousarray((operators @ A).T)


def plane_velocities(operators: FloatArray, a: FloatArray) -> FloatArray:
    """``−Ĥ_jᵀ a`` as columns (4, n) (2.70)."""
    return np.ascontiguousarray(-(operators.transpose(0, 2, 1) @ a).T)


def _kernel(operators: FloatArray, system: FloatArray, freedoms: Freedoms | None, freedom: str) -> Primitive:
    basis = (freedoms or arm_freedoms(operators)).joints
    rank = basis.shape[1]
    if rank == 0:
        raise NotReachableError(freedom, 1.0, REACH_RATIO)
    _, values, rows = np.linalg.svd(system @ basis)
    smallest, largest = float(values[rank - 1]), float(values[0])
    # An arm of one degree of freedom has no second value; unit planes, points and operators give about 1.
    second = float(values[rank - 2]) if rank > 1 else 1.0
    if second <= DEGENERATE_RATIO * largest:
        raise DegenerateStepError(f"{freedom}: more than one motion fits (second singular value {second:.3g})")
    threshold = NOISE_RATIO if rank == RIGID_FREEDOMS else REACH_RATIO
    if smallest > threshold * second:
        raise NotReachableError(freedom, smallest / second, threshold)
    screw = basis @ rows[rank - 1]
    return Primitive(screw, np.tensordot(screw, operators, axes=1), smallest, second, largest)


def _as_rotation(primitive: Primitive, freedom: str) -> Primitive:
    H = primitive.operator
    square = -0.5 * float(np.trace(H @ H))
    if not square > DEGENERATE_RATIO * float((H**2).sum()):
        raise NotReachableError(freedom, 1.0, REACH_RATIO)
    return _scaled(primitive, 1.0 / float(np.sqrt(square)))


def _scaled(primitive: Primitive, factor: float) -> Primitive:
    return Primitive(
        factor * primitive.screw,
        factor * primitive.operator,
        primitive.smallest,
        primitive.second,
        primitive.largest,
    )
