"""The pose of the marker body at a goal, from all of its set-points: the law run on paper, then least squares.

Three triangulated points would do for (7.21)-(7.24), but every marker of the goal says something. The displacement from
the present to the goal is found by integrating the Cartesian law itself, which converges from anywhere, and refined on
the reprojection error of all set-points. What comes out is one rigid displacement of the calibrated structure, so also
markers that the goal does not show have their place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.control.cartesian_kernel import cartesian3_step
from stereoservo.kinematics.kernels import (
    BoolArray,
    exp_twist,
    image_jacobian,
    multiply4_into,
    project_points,
    transform_points,
)
from stereoservo.kinematics.linear_kernels import damped_least_squares
from stereoservo.runtime.estimate import ModelArrays
from stereoservo.runtime.ports import FloatArray, IntArray

LAW_STEPS = 80
NEAR = 1e-5  # of a step in the basis: least squares goes on from there
LAW_GAIN = 0.3  # of the way still to be made, a step
REFINEMENTS = 12
REFINE_DAMPING = 1e-12
CONVERGED = 1e-13  # of a refinement's step in the basis


@dataclass(frozen=True)
class GoalPose:
    """Marker points at the goal (m, 4) of height a∞ᵀM = 1, and how well they explain the set-points [px].

    ``displacement`` (4, 4) takes the body there from where it was.
    """

    points: FloatArray
    displacement: FloatArray
    rms_px: float
    worst_px: float
    worst_marker: int


def goal_pose(
    arrays: ModelArrays,
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    known: BoolArray,
    face: IntArray,
    set_points: FloatArray,
    wanted: FloatArray,
) -> GoalPose:
    """Fit one rigid displacement of ``points`` (m, 4) to the set-points.

    ``targets`` (m, 4): triangulated goal points where ``known`` (m,); ``face`` (3,) spans a face. ``operators``
    (n, 4, 4): the arm's at present, a basis of displacements where the model knows no metric one.
    """
    basis = operators if arrays.metric_basis is None else arrays.metric_basis
    D = np.zeros((4, 4))
    for i in range(4):
        D[i, i] = 1.0
    moved = points
    nobody = np.zeros((0, 4))  # on paper no camera has to keep sight of the face
    gains = np.full(3, LAW_GAIN)
    centre_target = targets[known].sum(axis=0) / float(known.sum())
    for _ in range(LAW_STEPS):
        centre = moved[known].sum(axis=0) / float(known.sum())
        twist, _, _, _ = cartesian3_step(
            basis, moved[face], targets[face], centre, centre_target, nobody, gains
        )
        D = _onwards(basis, twist, D)
        moved = transform_points(D, points)
        if float(np.abs(twist).max()) < NEAR:
            break
    return refined_pose(arrays, basis, points, D, set_points, wanted)


def refined_pose(
    arrays: ModelArrays, basis: FloatArray, points: FloatArray, displacement: FloatArray, set_points: FloatArray,
    wanted: FloatArray, refinements: int = REFINEMENTS,
) -> GoalPose:  # fmt: skip
    """Least squares on all set-points, from a ``displacement`` (4, 4) near by; ``basis`` (k, 4, 4) of displacements."""
    D = displacement
    moved = transform_points(D, points)
    weights = np.repeat(wanted.reshape(-1), 2)
    for _ in range(refinements):
        pixels, _ = project_points(arrays.matrices, moved)
        jacobian = image_jacobian(basis, arrays.matrices, moved).reshape(-1, basis.shape[0])
        step, _ = damped_least_squares(jacobian, (set_points - pixels).reshape(-1), weights, REFINE_DAMPING)
        D = _onwards(basis, step, D)
        moved = transform_points(D, points)
        if float(np.abs(step).max()) < CONVERGED:
            break
    pixels, _ = project_points(arrays.matrices, moved)
    distance = np.where(wanted > 0.0, np.sqrt(((pixels - set_points) ** 2).sum(axis=-1)), 0.0)
    worst = int(distance.max(axis=0).argmax())
    return GoalPose(
        moved,
        D,
        float(np.sqrt((distance * distance).sum() / max(float(wanted.sum()), 1.0))),
        float(distance.max()),
        arrays.marker_ids[worst],
    )


def _onwards(basis: FloatArray, twist: FloatArray, D: FloatArray) -> FloatArray:
    onwards = np.empty((4, 4))
    multiply4_into(exp_twist((twist[:, None, None] * basis).sum(axis=0)), D, onwards)
    return onwards
