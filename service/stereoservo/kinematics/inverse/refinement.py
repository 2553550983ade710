"""Joint angles for the images of a goal: each start from inverse kinematics is refined to the least reprojection error,
with covariance (thesis 6.8).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereoservo.kinematics.inverse.solutions import InverseSolutions, distinct, within_limits
from stereoservo.kinematics.joint_angles import JointAngles, refined_joints
from stereoservo.kinematics.joint_reprojection import JointAnglesError, SeenChain, joint_problem
from stereoservo.numerics.arrays import FloatArray

MERGED = 1e-5
"""Largest difference of joints [rad or m] of two refinements that ended in one minimum."""


@dataclass(frozen=True, eq=False)
class ImageSolutions:
    """Configurations of least image error, one for each start that led to one, least cost first.

    ``refused``: starts (t, n) whose descent explains no image, with the reason of each.
    """

    solutions: tuple[JointAngles, ...]
    refused: tuple[tuple[FloatArray, str], ...]


def refined_on_images(
    seen: SeenChain,
    found: InverseSolutions,
    points: FloatArray,
    pixels: FloatArray,
    sigma: FloatArray | float,
    *,
    limits: FloatArray | None = None,
) -> ImageSolutions:
    """Solutions ``found``, each refined to the least squares of (6.8), with covariance.

    ``points`` (m, 4) at the chain's zero, raw set-points ``pixels`` (c, m, 2) [px] of standard deviation ``sigma``, NaN
    where a camera does not see one. Raises JointAnglesError for shapes and limits that do not fit, and for fewer
    coordinates than joints.
    """
    problem = joint_problem(seen, points, pixels, sigma)
    refined: list[JointAngles] = []
    refused: list[tuple[FloatArray, str]] = []
    ends = refined_joints(problem, found.joints, limits=limits)
    for q, best in zip(found.joints, ends, strict=True):
        if isinstance(best, JointAnglesError):
            refused.append((q, str(best)))
        else:
            refined.append(replace(best, q=within_limits(seen.chain.kinds, best.q, q, limits)[0]))
    refined.sort(key=lambda angles: angles.cost)
    if refined:
        kept = distinct(seen.chain.kinds, np.array([angles.q for angles in refined]), MERGED)
        refined = [refined[i] for i in kept]
    return ImageSolutions(tuple(refined), tuple(refused))
