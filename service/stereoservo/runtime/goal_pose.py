"""The pose of the marker body at a goal, from all of its set-points: the law run on paper, then least squares.

Three triangulated points would do for (7.21)-(7.24), but every marker of the goal says something. The displacement from
the present to the goal is found by integrating the Cartesian law itself, which converges from anywhere, and refined on
the reprojection error of all set-points. What comes out is one rigid displacement of the calibrated structure, so also
markers that the goal does not show have their place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.control.kernels import cartesian3_step, damped_least_squares
from stereoservo.kinematics.kernels import exp_twist, image_jacobian, project_points, transform_points
from stereoservo.runtime.estimate import ModelArrays
from stereoservo.runtime.ports import FloatArray, IntArray

LAW_STEPS = 80
LAW_GAIN = 0.3  # of the way still to be made, a step
REFINEMENTS = 12
REFINE_DAMPING = 1e-12


@dataclass(frozen=True)
class GoalPose:
    """Marker points at the goal (m, 4) of height a∞ᵀM = 1, and how well they explain the set-points [px]."""

    points: FloatArray
    rms_px: float
    worst_px: float
    worst_marker: int


def goal_pose(
    arrays: ModelArrays,
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    known: FloatArray,
    face: IntArray,
    set_points: FloatArray,
    wanted: FloatArray,
) -> GoalPose:
    """Fit one rigid displacement of ``points`` (m, 4) to the set-points.

    ``targets`` (m, 4): triangulated goal points where ``known`` (m,); ``face`` (3,) spans a face. ``operators``
    (n, 4, 4): the arm's at present, a basis of displacements where the model knows no metric one.
    """
    basis = operators if arrays.metric_basis is None else arrays.metric_basis
    moved = points
    gains = np.full(3, LAW_GAIN)
    centre_target = targets[known].sum(axis=0) / float(known.sum())
    for _ in range(LAW_STEPS):
        centre = moved[known].sum(axis=0) / float(known.sum())
        twist, _, _, _ = cartesian3_step(
            basis, moved[face], targets[face], centre, centre_target, arrays.camera_centres, gains
        )
        moved = _displaced(basis, twist, moved)
    weights = np.repeat(wanted.reshape(-1), 2)
    for _ in range(REFINEMENTS):
        pixels, _ = project_points(arrays.matrices, moved)
        jacobian = image_jacobian(basis, arrays.matrices, moved).reshape(-1, basis.shape[0])
        step, _ = damped_least_squares(jacobian, (set_points - pixels).reshape(-1), weights, REFINE_DAMPING)
        moved = _displaced(basis, step, moved)
    pixels, _ = project_points(arrays.matrices, moved)
    distance = np.where(wanted > 0.0, np.sqrt(((pixels - set_points) ** 2).sum(axis=-1)), 0.0)
    worst = int(distance.max(axis=0).argmax())
    return GoalPose(
        moved,
        float(np.sqrt((distance * distance).sum() / max(float(wanted.sum()), 1.0))),
        float(distance.max()),
        arrays.marker_ids[worst],
    )


def _displaced(basis: FloatArray, twist: FloatArray, points: FloatArray) -> FloatArray:
    moved: FloatArray = transform_points(exp_twist((twist[:, None, None] * basis).sum(axis=0)), points)
    return moved
