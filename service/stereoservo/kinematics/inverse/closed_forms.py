"""Closed-form solutions of inverse kinematics subproblems: angles or positions of a few joints that move points to
targets (thesis 6), not yet checked against the whole chain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.displacements import exp_rotation, exp_translation
from stereoservo.numerics.arrays import BoolArray, FloatArray

FREE = 1e-9
"""Radius of a joint's circle, relative to its operator's largest motion, below which the joint does not move the
point.
"""


@dataclass(frozen=True, eq=False)
class Branches:
    """k candidate solutions of n joints, as displacements from the zero.

    ``steps`` (k, n) [rad or m]. ``excess`` (k, n): distance of a joint's equation from having a root, relative to its
    amplitude; 0 if it has one, infinite if the joint has no effect. The step is then that of the closest approach.
    ``free`` (k, n): the equation holds for every position of this joint, which stays at its seed.
    """

    steps: FloatArray
    excess: FloatArray
    free: BoolArray


def single(step: float, excess: float = 0.0, free: bool = False) -> Branches:
    """One candidate of one joint as branches."""
    return Branches(np.array([[step]]), np.array([[excess]]), np.array([[free]]))


def append_joints(first: Branches, second: Branches) -> Branches:
    """Branches with the joints of ``second`` appended to those of ``first``; a single candidate is combined with all
    others.
    """
    k = max(len(first.steps), len(second.steps))

    def wide(left: npt.NDArray, right: npt.NDArray) -> npt.NDArray:  # type: ignore[type-arg]
        parts = [part if len(part) == k else np.repeat(part, k, axis=0) for part in (left, right)]
        return np.concatenate(parts, axis=1)

    return Branches(wide(first.steps, second.steps), wide(first.excess, second.excess), wide(first.free, second.free))


def concatenate(several: list[Branches]) -> Branches:
    """Concatenation of the candidates of ``several``."""
    return Branches(
        np.concatenate([branches.steps for branches in several]),
        np.concatenate([branches.excess for branches in several]),
        np.concatenate([branches.free for branches in several]),
    )


def candidate(branches: Branches, i: int) -> Branches:
    """Candidate ``i`` as branches."""
    part = slice(i, i + 1)
    return Branches(branches.steps[part], branches.excess[part], branches.free[part])


INDEPENDENT = 1e-9
"""Smallest over largest singular value of the joints' directions from which on they are linearly independent."""


def prismatic_joints(operators: FloatArray, A: FloatArray, target: FloatArray) -> Branches:
    """Positions [m] of n joints of operators (n, 4, 4) that take points ``A`` (m, 4) to ``target`` (m, 4) (6.6).

    The moved point must lie in the planes through its target, the orthogonal complement (3, 4) of the target: no
    heights are needed. If the target is out of reach, the solution is the least squares over these planes; if
    directions are linearly dependent, it is the smallest motion, with these joints marked free.
    """
    rows, sides = [], []
    for point, goal in zip(A, target, strict=True):
        planes = np.linalg.svd(goal[None] / np.linalg.norm(goal))[2][1:]
        rows.append(planes @ (operators @ point).T)
        sides.append(-planes @ point)
    matrix, side = np.concatenate(rows), np.concatenate(sides)
    steps, _, _, singular = np.linalg.lstsq(matrix, side, rcond=INDEPENDENT)
    dependent = singular <= INDEPENDENT * max(float(singular[0]), 1e-300)
    free = np.zeros(len(operators), dtype=bool)
    if len(singular) < len(operators) or dependent.any():
        kernel = np.linalg.svd(matrix)[2][int((~dependent).sum()) :]
        free = np.abs(kernel).max(axis=0) > INDEPENDENT
    return Branches(steps[None], np.zeros((1, len(operators))), free[None])


@dataclass(frozen=True, eq=False)
class Crossing:
    """Angles (k,) [rad] at which a point on its circle lies in a plane: two; one at the closest approach if they do not
    intersect, or the seed if the whole circle lies in the plane. ``excess`` and ``free`` as in `Branches`.
    """

    angles: FloatArray
    excess: float
    free: bool


def circle_meets_plane(G: FloatArray, A: FloatArray, plane: FloatArray, seed: float = 0.0) -> Crossing:
    """Both roots of ``aᵀ exp(θĤ) A = 0`` (6.8): ``p₀ + p_s sinθ - p_c cosθ = 0`` (errata to 6.9, 6.10).

    ``G`` (4, 4) revolute, ``A`` (4,), ``plane`` (4,).
    """
    first, second = G @ A, G @ (G @ A)
    p_s, p_c = float(plane @ first), float(plane @ second)
    p_0 = float(plane @ A) + p_c
    amplitude = float(np.hypot(p_s, p_c))
    scale = float(np.linalg.norm(plane) * np.linalg.norm(A)) * max(1.0, float(np.linalg.norm(G)) ** 2)
    if amplitude <= FREE * scale:
        held = abs(p_0) <= FREE * scale
        return Crossing(np.array([seed]), 0.0 if held else np.inf, held)
    central = -np.arctan2(p_s, p_c)
    discriminant = (amplitude - p_0) * (amplitude + p_0)
    if discriminant <= 0.0:
        nearest = central if p_0 > 0.0 else central + np.pi
        return Crossing(np.array([nearest]), abs(p_0) / amplitude - 1.0, False)
    half = np.arctan2(np.sqrt(discriminant), p_0)
    return Crossing(np.array([central + half, central - half]), 0.0, False)


def turn_between(G: FloatArray, A: FloatArray, target: FloatArray, seed: float = 0.0) -> Branches:
    """Rotation angle [rad] about a revolute operator ``G`` (4, 4) that moves points ``A`` (..., 4) closest to
    ``target``.

    Points and targets of equal heights. The radial part of the target, ``-Ĥ²A*``, is resolved along the radial parts of
    the point and of its motion, ``-Ĥ²A`` and ``ĤA``: one linear step for the plane of (6.11) through axis and target,
    without the trivial second root and without a choice of plane. ``excess``: difference of the radii. Free if all of
    ``A`` lies on the axis.
    """
    points, goals = np.reshape(A, (-1, 4)), np.reshape(target, (-1, 4))
    square = G @ G
    radial, along, required = -points @ square.T, points @ G.T, -goals @ square.T
    size = float(np.linalg.norm(radial))
    if size <= FREE * float(np.linalg.norm(square) * np.linalg.norm(points)):
        return single(seed, free=True)
    basis = np.stack([radial.ravel(), along.ravel()])
    cosine, sine = np.linalg.solve(basis @ basis.T, basis @ required.ravel())
    return single(float(np.arctan2(sine, cosine)), abs(float(np.hypot(cosine, sine)) - 1.0))


def normal_plane(G: FloatArray, A: FloatArray) -> FloatArray:
    """Plane (4,) normal to the axis of ``G`` (4, 4) through ``A`` (4,): it belongs to the invariant pencil ``aᵀĤ = 0``.

    Also valid if A lies on the axis, where ``A``, ``ĤA`` and ``Ĥ²A`` span no circle.
    """
    pencil = np.linalg.svd(G)[0][:, 2:]
    scales = A @ pencil
    return np.asarray(pencil @ np.array([scales[1], -scales[0]]), dtype=np.float64)


def axis_points(G: FloatArray) -> FloatArray:
    """Two orthonormal points (2, 4) on the axis of ``G`` (4, 4), its kernel."""
    return np.asarray(np.linalg.svd(G)[2][2:], dtype=np.float64)


def common_point(operators: FloatArray) -> FloatArray:
    """Point (4,), of unit norm, nearest to all axes of revolute ``operators`` (k, 4, 4), each of unit norm."""
    unit = operators / np.linalg.norm(operators, axis=(1, 2), keepdims=True)
    return np.asarray(np.linalg.svd(unit.reshape(-1, 4))[2][3], dtype=np.float64)


def two_general(G: FloatArray, A: FloatArray, target: FloatArray, seed: FloatArray) -> Branches:
    """Angles of two joints ``G`` (2, 4, 4) that are not parallel, ``exp(θ₁Ĥ₁) exp(θ₂Ĥ₂) A = A*`` (6.12).

    The target, rotated back about joint 1, crosses the plane of the circle of ``A`` about joint 2 twice (6.16); each
    crossing determines one angle of joint 2. ``A``, ``target`` (4,) of equal heights; ``seed`` (2,).
    """
    if np.linalg.norm(G[1] @ A) <= FREE * np.linalg.norm(G[1]) * np.linalg.norm(A):
        return append_joints(turn_between(G[0], A, target, seed[0]), single(seed[1], free=True))
    crossing = circle_meets_plane(-G[0], target, normal_plane(G[1], A), seed[0])
    found = []
    for angle in crossing.angles:
        before = exp_rotation(G[0], -angle) @ target
        first = single(float(angle), crossing.excess, crossing.free)
        found.append(append_joints(first, turn_between(G[1], A, before, seed[1])))
    return concatenate(found)


def two_parallel(G: FloatArray, A: FloatArray, target: FloatArray, seed: FloatArray) -> Branches:
    """Angles of two joints ``G`` (2, 4, 4) with parallel axes, ``exp(θ₁Ĥ₁) exp(θ₂Ĥ₂) A = A*`` (6.17-6.22).

    The law of cosines needs lengths in the plane of motion up to one scale. They follow from joint 1: its operator acts
    as a quarter turn on the directions of that plane, its range, which can be treated as complex numbers. ``A``,
    ``target`` (4,) of equal heights, ``seed`` (2,). Axes of opposite sense count as parallel, too. Noisy input is
    projected onto the range of joint 1.
    """
    square = -G[0] @ G[0]
    range_basis = np.linalg.svd(square)[0]
    e = square @ range_basis[:, 0]
    frame = np.linalg.pinv(np.stack([e, G[0] @ e], axis=1))

    def direction(v: FloatArray) -> complex:
        x, y = frame @ v
        return complex(x, y)

    opposite = (direction(G[1] @ e) / direction(e)).imag < 0.0
    opposed = -G[1] if opposite else G[1]
    radial = -opposed @ (opposed @ A)
    arm, between = direction(radial), direction(square @ (A - radial))
    required = direction(square @ target)
    size = max(abs(arm), abs(between), abs(required))
    if abs(between) <= FREE * size:
        whole = float(np.angle(required / arm)) if abs(arm) > FREE * size else 0.0
        second = single(_signed(whole - seed[0], opposite), free=True)
        return append_joints(single(float(seed[0]), free=True), second)
    if abs(arm) <= FREE * size:
        return append_joints(single(float(np.angle(required / between))), single(float(seed[1]), free=True))
    cosine = (abs(required) ** 2 - abs(between) ** 2 - abs(arm) ** 2) / (2.0 * abs(between) * abs(arm))
    bend = np.arctan2(np.sqrt(max(0.0, (1.0 - cosine) * (1.0 + cosine))), cosine)
    central = np.angle(between / arm)
    excess = max(0.0, abs(cosine) - 1.0)
    found = []
    for turn in (central + bend, central - bend) if excess == 0.0 else (central + bend,):
        reach = between + np.exp(1j * turn) * arm
        second = single(_signed(float(turn), opposite), excess)
        if min(abs(reach), abs(required)) <= FREE * size:
            found.append(append_joints(single(float(seed[0]), free=abs(required) <= FREE * size), second))
        else:
            found.append(append_joints(single(float(np.angle(required / reach))), second))
    return concatenate(found)


def _signed(angle: float, opposite: bool) -> float:
    return -angle if opposite else angle


def arm(G: FloatArray, A: FloatArray, target: FloatArray, seed: FloatArray) -> Branches:
    """Angles of three joints ``G`` (3, 4, 4) that take ``A`` (4,) to ``target`` (4,), up to four (6.24-6.26).

    Joints 2 and 3 keep the point in the plane normal to their axes (6.23), which determines two angles of joint 1; for
    each, a problem of two parallel joints remains. Equal heights; ``seed`` (3,).
    """
    crossing = circle_meets_plane(-G[0], target, normal_plane(G[1], A), seed[0])
    found = []
    for angle in crossing.angles:
        before = exp_rotation(G[0], -angle) @ target
        first = single(float(angle), crossing.excess, crossing.free)
        found.append(append_joints(first, two_parallel(G[1:], A, before, seed[1:])))
    return concatenate(found)


def wrist(G: FloatArray, H: FloatArray, seed: FloatArray) -> Branches:
    """Angles of three joints ``G`` (3, 4, 4) whose product is the rotation ``H`` (4, 4), up to two (6.27, 6.28).

    A point of the last axis, away from the centre, determines the first two joints; the rest of the rotation determines
    the last. If the first and the last axis coincide, the first joint stays at its ``seed`` (3,) and is marked free.
    """
    centre = common_point(G)
    ends = axis_points(G[2])
    along_axis = ends @ centre
    A = np.array([along_axis[1], -along_axis[0]]) @ ends
    first_two = two_general(G[:2], A, H @ A, seed[:2])
    found = []
    for i, (first, second) in enumerate(first_two.steps):
        rest = exp_rotation(G[1], -second) @ exp_rotation(G[0], -first) @ H
        # The columns of the identity as points: rotated, they are the columns of the rotation.
        last = turn_between(G[2], np.eye(4), rest.T, seed[2])
        found.append(append_joints(candidate(first_two, i), last))
    return concatenate(found)


def arm_with_wrist(G: FloatArray, H: FloatArray, seed: FloatArray) -> Branches:
    """Angles of six revolute joints ``G`` (6, 4, 4) whose product is ``H`` (4, 4), up to eight (6.29, 6.30).

    Only the arm moves the wrist's centre: ``H W = H₁H₂H₃ W`` (errata to 6.29). The remainder of ``H`` is the wrist's
    rotation. ``seed`` (6,).
    """
    centre = common_point(G[3:])
    return _with_wrist(G, H, seed, arm(G[:3], centre, H @ centre, seed[:3]), exp_rotation)


def gantry_with_wrist(G: FloatArray, H: FloatArray, seed: FloatArray) -> Branches:
    """Joint values of three prismatic joints and a spherical wrist, ``G`` (6, 4, 4), whose product is ``H`` (4, 4), up
    to two.
    """
    centre = common_point(G[3:])
    place = prismatic_joints(G[:3], centre[None], (H @ centre)[None])
    return _with_wrist(G, H, seed, place, exp_translation)


def _with_wrist(
    G: FloatArray,
    H: FloatArray,
    seed: FloatArray,
    place: Branches,
    exponential: Callable[[FloatArray, FloatArray], FloatArray],
) -> Branches:
    found = []
    for i, steps in enumerate(place.steps):
        moves = exponential(G[:3], steps)
        rotation = np.linalg.solve(moves[0] @ moves[1] @ moves[2], H)
        found.append(append_joints(candidate(place, i), wrist(G[3:], rotation, seed[3:])))
    return concatenate(found)
