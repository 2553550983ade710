"""Three revolute joints in arm configuration (thesis 6.5): the axes of the second and third are parallel."""

from __future__ import annotations

from stereoservo.geometry.displacements import exp_rotation
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.inverse.branches import Branches, beside, single, together
from stereoservo.kinematics.inverse.revolute import circle_meets_plane, plane_across
from stereoservo.kinematics.inverse.two_revolute import two_parallel


def arm(G: FloatArray, A: FloatArray, target: FloatArray, seed: FloatArray) -> Branches:
    """Angles of three joints ``G`` (3, 4, 4) that take ``A`` (4,) to ``target`` (4,), up to four (6.24-6.26).

    Joints 2 and 3 keep the point in the plane across their axes (6.23), which leaves two angles of joint 1; each leaves
    a problem of two parallel joints. Equal heights; ``seed`` (3,).
    """
    crossing = circle_meets_plane(-G[0], target, plane_across(G[1], A), seed[0])
    found = []
    for angle in crossing.angles:
        before = exp_rotation(G[0], -angle) @ target
        first = single(float(angle), crossing.excess, crossing.free)
        found.append(beside(first, two_parallel(G[1:], A, before, seed[1:])))
    return together(found)
