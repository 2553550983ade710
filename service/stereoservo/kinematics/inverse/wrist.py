"""Three revolute joints whose axes meet in one point (thesis 6.6)."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.displacements import exp_rotation
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.inverse.branches import Branches, beside, one_of, together
from stereoservo.kinematics.inverse.revolute import axis_points, common_point, turn_between
from stereoservo.kinematics.inverse.two_revolute import two_general


def wrist(G: FloatArray, H: FloatArray, seed: FloatArray) -> Branches:
    """Angles of three joints ``G`` (3, 4, 4) whose product is the rotation ``H`` (4, 4), up to two (6.27, 6.28).

    A point of the last axis, away from the centre, tells the first two; the rest of the rotation tells the last.
    Where the first and the last axis fall together, the first joint stays at its ``seed`` (3,) and is marked free.
    """
    centre = common_point(G)
    ends = axis_points(G[2])
    share = ends @ centre
    A = np.array([share[1], -share[0]]) @ ends
    first_two = two_general(G[:2], A, H @ A, seed[:2])
    found = []
    for i, (first, second) in enumerate(first_two.steps):
        rest = exp_rotation(G[1], -second) @ exp_rotation(G[0], -first) @ H
        # The columns of the identity as points: turned, they are the columns of the rotation itself.
        last = turn_between(G[2], np.eye(4), rest.T, seed[2])
        found.append(beside(one_of(first_two, i), last))
    return together(found)
