"""Two revolute joints and one point: axes in general position (thesis 6.3), or parallel (6.4)."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.displacements import exp_rotation
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.inverse.branches import FREE, Branches, beside, single, together
from stereoservo.kinematics.inverse.revolute import circle_meets_plane, plane_across, turn_between


def two_general(G: FloatArray, A: FloatArray, target: FloatArray, seed: FloatArray) -> Branches:
    """Angles of two joints ``G`` (2, 4, 4) that are not parallel, ``exp(θ₁Ĥ₁) exp(θ₂Ĥ₂) A = A*`` (6.12).

    The target on its way back about joint 1 crosses the plane of the circle of ``A`` about joint 2 twice (6.16);
    each crossing leaves one turn about joint 2. ``A``, ``target`` (4,) of equal heights; ``seed`` (2,).
    """
    if np.linalg.norm(G[1] @ A) <= FREE * np.linalg.norm(G[1]) * np.linalg.norm(A):
        return beside(turn_between(G[0], A, target, seed[0]), single(seed[1], free=True))
    crossing = circle_meets_plane(-G[0], target, plane_across(G[1], A), seed[0])
    found = []
    for angle in crossing.angles:
        before = exp_rotation(G[0], -angle) @ target
        first = single(float(angle), crossing.excess, crossing.free)
        found.append(beside(first, turn_between(G[1], A, before, seed[1])))
    return together(found)


def two_parallel(G: FloatArray, A: FloatArray, target: FloatArray, seed: FloatArray) -> Branches:
    """Angles of two joints ``G`` (2, 4, 4) with parallel axes, ``exp(θ₁Ĥ₁) exp(θ₂Ĥ₂) A = A*`` (6.17-6.22).

    The law of cosines needs lengths in the plane of motion up to one scale. Joint 1 has them: its operator is a quarter
    turn of that plane's directions, which are its range, so that they are complex numbers. ``A``, ``target`` (4,) of
    equal heights, ``seed`` (2,). Axes of opposite sense are parallel, too. Corrupted input is projected onto the
    range of joint 1.
    """
    square = -G[0] @ G[0]
    range_basis = np.linalg.svd(square)[0]
    e = square @ range_basis[:, 0]
    frame = np.linalg.pinv(np.stack([e, G[0] @ e], axis=1))

    def direction(v: FloatArray) -> complex:
        x, y = frame @ v
        return complex(x, y)

    opposite = (direction(G[1] @ e) / direction(e)).imag < 0.0
    turning = -G[1] if opposite else G[1]
    radial = -turning @ (turning @ A)
    arm, between = direction(radial), direction(square @ (A - radial))
    wanted = direction(square @ target)
    size = max(abs(arm), abs(between), abs(wanted))
    if abs(between) <= FREE * size:
        whole = float(np.angle(wanted / arm)) if abs(arm) > FREE * size else 0.0
        second = single(_signed(whole - seed[0], opposite), free=True)
        return beside(single(float(seed[0]), free=True), second)
    if abs(arm) <= FREE * size:
        return beside(single(float(np.angle(wanted / between))), single(float(seed[1]), free=True))
    cosine = (abs(wanted) ** 2 - abs(between) ** 2 - abs(arm) ** 2) / (2.0 * abs(between) * abs(arm))
    bend = np.arctan2(np.sqrt(max(0.0, (1.0 - cosine) * (1.0 + cosine))), cosine)
    middle = np.angle(between / arm)
    excess = max(0.0, abs(cosine) - 1.0)
    found = []
    for turn in (middle + bend, middle - bend) if excess == 0.0 else (middle + bend,):
        reach = between + np.exp(1j * turn) * arm
        second = single(_signed(float(turn), opposite), excess)
        if min(abs(reach), abs(wanted)) <= FREE * size:
            found.append(beside(single(float(seed[0]), free=abs(wanted) <= FREE * size), second))
        else:
            found.append(beside(single(float(np.angle(wanted / reach))), second))
    return together(found)


def _signed(angle: float, opposite: bool) -> float:
    return -angle if opposite else angle
