"""Six axes that end in a spherical wrist (thesis 6.7): on an arm, the PUMA's geometry, or on a gantry."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stereoservo.geometry.displacements import exp_rotation, exp_translation
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.inverse.arm import arm
from stereoservo.kinematics.inverse.branches import Branches, beside, one_of, together
from stereoservo.kinematics.inverse.prismatic import prismatic_joints
from stereoservo.kinematics.inverse.revolute import common_point
from stereoservo.kinematics.inverse.wrist import wrist


def arm_with_wrist(G: FloatArray, H: FloatArray, seed: FloatArray) -> Branches:
    """Angles of six revolute joints ``G`` (6, 4, 4) whose product is ``H`` (4, 4), up to eight (6.29, 6.30).

    The wrist's centre is moved by the arm alone: ``H W = H₁H₂H₃ W`` (errata to 6.29). What is left of ``H`` is the
    wrist's rotation. ``seed`` (6,).
    """
    centre = common_point(G[3:])
    return _with_wrist(G, H, seed, arm(G[:3], centre, H @ centre, seed[:3]), exp_rotation)


def gantry_with_wrist(G: FloatArray, H: FloatArray, seed: FloatArray) -> Branches:
    """Three prismatic joints under a spherical wrist, ``G`` (6, 4, 4): up to two ways to ``H`` (4, 4)."""
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
        found.append(beside(one_of(place, i), wrist(G[3:], rotation, seed[3:])))
    return together(found)
