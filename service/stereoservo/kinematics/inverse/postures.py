"""All postures in which a learnt arm shows given images: inverse kinematics of the triangulated set-points, each answer
refined on the images (thesis 6, 6.8).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereoservo.kinematics.inverse.recognition import Recognition, recognise
from stereoservo.kinematics.inverse.refinement import ImageSolutions, refined_on_images
from stereoservo.kinematics.inverse.solutions import InverseKinematicsError, InverseSolutions, nearest_turns
from stereoservo.kinematics.inverse.solver import inverse_kinematics
from stereoservo.kinematics.joint_angles import JointAngles
from stereoservo.kinematics.joint_reprojection import points_seen, seen_chain
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

TOLERANCE = 0.05
"""Residual, as a share, up to which measured points count as reached: the images judge what comes of them."""
FEWEST = 3


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures that show a goal's images.

    ``recognition``: of the arm's structure; ``found``: what inverse kinematics of the triangulated points answers,
    postures beyond the limits and how far an unreachable goal is with it; ``images``: the answers refined on the
    images, nearest to the zero first (but for whole turns): an order that does not depend on the seed.
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
    """Postures of the arm of ``model`` in which its markers are at raw ``pixels`` (c, m, 2) [px] of deviation
    ``sigma``, NaN where a camera does not see one.

    ``limits`` (n, 2) [rad or m]; ``seed`` (n,), default the zero: turns are counted to be nearest to it.
    ``recognition``: of this model, where it is known. Raises InverseKinematicsError for images that share fewer than
    three markers, or that are of no motion of this body; JointAnglesError.
    """
    seen = seen_chain(model)
    targets, _ = points_seen(seen, seen.chain.zero, pixels, sigma)
    known = np.isfinite(targets).all(axis=1)
    if int(known.sum()) < FEWEST:
        raise InverseKinematicsError(
            "shape",
            f"{int(known.sum())} markers are shown to two cameras; {FEWEST} are needed: a posture is told from "
            "points in space",
        )
    structure = recognise(model) if recognition is None else recognition
    found = inverse_kinematics(
        seen.chain, points=model.marker_points[known], targets=targets[known], seed=seed, limits=limits,
        tolerance=TOLERANCE, recognition=structure,
    )  # fmt: skip
    images = refined_on_images(seen, found, model.marker_points, pixels, sigma, limits=limits)
    zero = seen.chain.zero

    def far(angles: JointAngles) -> float:
        return float(((nearest_turns(seen.chain.kinds, angles.q, zero) - zero) ** 2).sum())

    return Postures(structure, found, replace(images, solutions=tuple(sorted(images.solutions, key=far))))
