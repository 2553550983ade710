"""Alternative paths, cheapest first: other profiles, senses and kinds of turning, bent centre lines.

A bend takes the centre aside by ``4σ(1 − σ) b``, ``b`` a displacement (a point of the plane at infinity): away from the
cameras or towards them, to the right or left and down or up in the images.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.planning.motion_frame import turn
from stereoservo.planning.path import NUMBERS, shapes
from stereoservo.planning.plan import Profile

AWAY = (0.0, 0.12, 0.25, 0.45, 0.7, -0.12, -0.25)
"""Bends away from the cameras, as shares of their distance from the centre."""
ASIDE = (0.0, 0.07, -0.07, 0.15, -0.15, 0.25, -0.25)
"""Bends to the right and down, likewise."""
PROFILES: tuple[Profile, ...] = ("linear", "translation-first", "rotation-first", "planar-first")
PROFILE_COST = 0.06
TURN_COSTS = (0.0, 0.08, 0.2, 0.3, 0.4)
"""Of the kinds of turning, in the order of `turnings`, in the measure of the bends."""
NO_ANGLE = 1e-9
PARALLEL = 1e-7
"""Sine below which two normals are one."""


class Candidate(NamedTuple):
    """One path to try: ``turning`` of `turnings`, ``profile`` 0 the one asked for, ``bend`` away, right, down."""

    turning: int
    profile: int
    bend: tuple[float, float, float]


def _ordered() -> tuple[Candidate, ...]:
    listed: list[tuple[float, int, Candidate]] = []
    for away in AWAY:
        for right in ASIDE:
            for down in ASIDE:
                size = math.sqrt(away * away + right * right + down * down)
                for turning, cost in enumerate(TURN_COSTS):
                    for profile in range(len(PROFILES) + 1):
                        total = size + cost + (PROFILE_COST if profile else 0.0)
                        listed.append((total, len(listed), Candidate(turning, profile, (away, right, down))))
    return tuple(candidate for _, _, candidate in sorted(listed))


CANDIDATES = _ordered()
"""All paths, the straight one with the profile that was asked for first."""


def bend_directions(camera: FloatArray, camera_centres: FloatArray) -> FloatArray:
    """Unit displacements (3, 3): away from ``camera_centres`` (c, 3), right and down in ``camera`` (3, 4)."""
    P = camera[:, :3]
    right, down = _cross(P[1], P[2]), _cross(P[2], P[0])
    sign = 1.0 if float((P[0] * right).sum()) >= 0.0 else -1.0
    away = -camera_centres.sum(axis=0)
    rows = np.stack([away, sign * right, sign * down])
    lengths = np.sqrt((rows * rows).sum(axis=1))
    result: FloatArray = rows / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    return result


def turnings(rotation: FloatArray, normal: FloatArray | None) -> tuple[FloatArray, ...]:
    """Hinge axis and angle, planar axis and angle (8,) of each kind of turning, for a rotation ``(axis, angle)`` (4,).

    Hinge and planar rotation of the face of ``normal`` (3,), the shorter ones; one rotation about the centre; the hinge
    the other way round; the planar rotation the other way round; the one rotation the other way round (7.4.1, 7.4.2).
    """
    axis, angle = rotation[:3], float(rotation[3])
    whole = 2.0 * math.pi
    single = _turning(axis, angle, axis, 0.0)
    single_back = _turning(axis, angle - whole, axis, 0.0)
    if normal is None:
        return single, single, single_back, single, single_back
    hinge, theta_r, theta_p = _hinge_and_planar(rotation, normal)
    return (
        _turning(hinge, theta_r, normal, theta_p),
        single,
        _turning(hinge, theta_r - whole, normal, theta_p),
        _turning(hinge, theta_r, normal, theta_p - math.copysign(whole, theta_p)),
        single_back,
    )


def path_of(
    candidate: Candidate,
    profile: Profile,
    turning: FloatArray,
    displacement: FloatArray,
    directions: FloatArray,
) -> FloatArray:
    """The numbers (17,) of `pose_on_path` for one candidate."""
    path = np.zeros(NUMBERS)
    path[:8] = turning
    path[8:11] = displacement
    for amount, direction in zip(candidate.bend, directions, strict=True):
        path[11:14] += amount * direction
    amounts = (float(np.abs(displacement).max()), float(turning[3]), float(turning[7]))
    path[14:] = shapes(profile, amounts)
    return path


def other_profile(asked: Profile, nth: int) -> Profile | None:
    """The profile number ``nth`` of a candidate; None where it is the one asked for again."""
    if nth == 0:
        return asked
    profile = PROFILES[nth - 1]
    return None if profile == asked else profile


def name_of(candidate: Candidate, profile: Profile) -> str:
    """Description of a path for people."""
    kinds = ("", "one rotation", "the other way round", "planar rotation the other way round")
    kind = (*kinds, "one rotation the other way round")[candidate.turning]
    words = (("away from the cameras", "towards the cameras"), ("right", "left"), ("down", "up"))
    bends = [
        f"{positive if amount > 0.0 else negative} by {abs(amount):g}"
        for amount, (positive, negative) in zip(candidate.bend, words, strict=True)
        if amount != 0.0
    ]
    return ", ".join(part for part in (profile, kind, "bent " + " and ".join(bends) if bends else "") if part)


def _turning(hinge: FloatArray, theta_r: float, normal: FloatArray, theta_p: float) -> FloatArray:
    out = np.empty(8)
    out[:3], out[3], out[4:7], out[7] = hinge, theta_r, normal, theta_p
    return out


def _hinge_and_planar(rotation: FloatArray, normal: FloatArray) -> tuple[FloatArray, float, float]:
    R = turn(np.ascontiguousarray(rotation[:3]), float(rotation[3]))
    after = (R * normal[None, :]).sum(axis=1)
    axis = _cross(normal, after)
    sine = math.sqrt(float((axis * axis).sum()))
    cosine = float((normal * after).sum())
    if sine > PARALLEL:
        hinge = axis / sine
    else:
        # one plane, or back on face: half a turn about any line in it
        least = int(np.abs(normal).argmin())
        other = np.zeros(3)
        other[least] = 1.0
        hinge = _cross(normal, other)
        hinge /= math.sqrt(float((hinge * hinge).sum()))
    theta_r = math.atan2(sine, cosine) if sine > PARALLEL or cosine < 0.0 else 0.0
    back = turn(np.ascontiguousarray(hinge), -theta_r)
    # the planar rotation R_p = R_r⁻¹ R, read on a direction in the face
    inside = _cross(normal, hinge)
    turned = (back[:, :, None] * R[None, :, :]).sum(axis=1)
    image = (turned * hinge[None, :]).sum(axis=1)
    theta_p = math.atan2(float((image * inside).sum()), float((image * hinge).sum()))
    return hinge, theta_r, theta_p if abs(theta_p) > NO_ANGLE else 0.0


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
