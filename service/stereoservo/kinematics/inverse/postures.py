"""All postures of a calibrated arm that show given images: inverse kinematics of the triangulated set-points, each
solution refined on the images (thesis 6, 6.8).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereoservo.kinematics.inverse.recognition import Recognition, recognise
from stereoservo.kinematics.inverse.solutions import (
    InverseKinematicsError,
    InverseSolutions,
    distinct,
    nearest_turns,
    within_limits,
)
from stereoservo.kinematics.inverse.solver import inverse_kinematics
from stereoservo.kinematics.joint_angles import JointAngles, refined_joints
from stereoservo.kinematics.joint_reprojection import (
    JointAnglesError,
    ObservedChain,
    joint_problem,
    observed_chain,
    reconstruct_points,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

TOLERANCE = 0.05
"""Relative residual up to which measured points count as reached: solutions are then verified on the images."""
FEWEST = 3


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures that show a goal's images.

    ``recognition``: of the arm's structure; ``found``: solutions of the inverse kinematics of the triangulated points,
    with postures beyond the limits and the distance to an unreachable goal; ``images``: the solutions refined on the
    images, nearest to the zero first (up to whole turns): this order does not depend on the seed.
    """

    recognition: Recognition
    found: InverseSolutions
    images: ImageSolutions


def postures(
    model: CellModel,
    pixels: FloatArray,
    sigma: FloatArray | float,
    *,
    limits: FloatArray | None = None,
    seed: FloatArray | None = None,
    recognition: Recognition | None = None,
) -> Postures:
    """Postures of the arm of ``model`` in which its markers are at raw ``pixels`` (c, m, 2) [px] of standard deviation
    ``sigma``, NaN where a camera does not see one.

    ``limits`` (n, 2) [rad or m]; ``seed`` (n,), default the zero: whole turns are chosen nearest to it.
    ``recognition``: of this model, if known. Raises InverseKinematicsError for images that share fewer than three
    markers, or that no motion of this body explains; JointAnglesError.
    """
    seen = observed_chain(model)
    targets, _ = reconstruct_points(seen, seen.chain.zero, pixels, sigma)
    known = np.isfinite(targets).all(axis=1)
    if int(known.sum()) < FEWEST:
        raise InverseKinematicsError(
            "shape",
            f"{int(known.sum())} markers are shown to two cameras; {FEWEST} are needed: a posture is found from "
            "points in space",
        )
    structure = recognise(model) if recognition is None else recognition
    found = inverse_kinematics(
        seen.chain,
        points=model.marker_points[known],
        targets=targets[known],
        seed=seed,
        limits=limits,
        tolerance=TOLERANCE,
        recognition=structure,
    )
    images = refined_on_images(seen, found, model.marker_points, pixels, sigma, limits=limits)
    zero = seen.chain.zero

    def far(angles: JointAngles) -> float:
        return float(((nearest_turns(seen.chain.kinds, angles.q, zero) - zero) ** 2).sum())

    return Postures(structure, found, replace(images, solutions=tuple(sorted(images.solutions, key=far))))


# -- refined on the images -----------------------------------------------------------------------------------
# Joint angles from the images of a goal: each start from inverse kinematics is refined to the least reprojection error,
# with covariance (thesis 6.8).


MERGED = 1e-5
"""Largest difference of joints [rad or m] of two refinements that converged to the same minimum."""


@dataclass(frozen=True, eq=False)
class ImageSolutions:
    """Configurations of least image error, one for each successful start, least cost first.

    ``refused``: starts (t, n) whose descent does not explain the images, each with the reason.
    """

    solutions: tuple[JointAngles, ...]
    refused: tuple[tuple[FloatArray, str], ...]


def refined_on_images(
    seen: ObservedChain,
    found: InverseSolutions,
    points: FloatArray,
    pixels: FloatArray,
    sigma: FloatArray | float,
    *,
    limits: FloatArray | None = None,
) -> ImageSolutions:
    """Solutions ``found``, each refined to the least squares of (6.8), with covariance.

    ``points`` (m, 4) at the chain's zero, raw set-points ``pixels`` (c, m, 2) [px] of standard deviation ``sigma``, NaN
    where a camera does not see one. Raises JointAnglesError for wrong shapes and limits, and for fewer coordinates than
    joints.
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
