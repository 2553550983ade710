"""Control laws for comparison only: camera by camera (8.37), and on metric points of a calibrated rig (8.17)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.laws.image import image
from stereoservo.control.laws.points import step_by_points
from stereoservo.control.laws.stereo import NO_COMPONENTS, NO_STATUS, held_gain, limited
from stereoservo.numerics.arrays import FloatArray


def stereo_block(scene: Scene, task: Task, options: Options) -> LawStep:
    """The mean of the laws of the single cameras that see (8.37, halved for two: errata)."""
    velocity, conditioning, seeing = np.zeros(scene.operators.shape[0]), 1.0, 0
    for camera in range(scene.matrices.shape[0]):
        alone = np.zeros_like(task.wanted)
        alone[camera] = task.wanted[camera]
        if not (scene.weights * alone > 0.0).any():
            continue
        step = image(scene, task._replace(wanted=alone), options)
        velocity, conditioning, seeing = (
            velocity + step.velocity,
            min(conditioning, step.conditioning),
            seeing + 1,
        )
    if seeing == 0:
        return LawStep(velocity, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, 0.0)
    return LawStep(velocity / seeing, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, conditioning)


def euclidean_points(
    H_projective_to_euclidean: FloatArray,
) -> Callable[[Scene, Task, Options], LawStep]:
    """The law on points in metric coordinates (8.17), for a calibrated rig: what others do, for comparison.

    ``H_projective_to_euclidean`` (4, 4) maps the frame's points to the metric frame of that rig.
    """
    H = np.ascontiguousarray(H_projective_to_euclidean, dtype=np.float64)

    def step(scene: Scene, task: Task, options: Options) -> LawStep:
        X, X_star = scene.points @ H.T, task.target_points @ H.T
        known = task.target_known > 0.0
        X = X / X[:, 3:]
        X_star = np.where(known[:, None], X_star / np.where(known, X_star[:, 3], 1.0)[:, None], 0.0)
        metres = np.tile(np.eye(3, 4), (X.shape[0], 1, 1))
        operators = np.ascontiguousarray(H @ scene.operators @ np.linalg.inv(H))
        jacobian = (
            JacobianChoice.CURRENT if options.jacobian == JacobianChoice.FIXED_DEPTH else options.jacobian
        )
        seen = (_seen(scene, task) > 0.0).astype(np.float64)
        velocity, conditioning = step_by_points(
            operators, (X, X_star, seen, metres), (held_gain(options), int(jacobian), options.damping)
        )
        return limited(scene, task, options, velocity, conditioning)

    return step


def _seen(scene: Scene, task: Task) -> FloatArray:
    """Weights (m,) of the markers: of the camera that sees each best, 0 where the goal's point is unknown."""
    found: FloatArray = scene.weights.max(axis=0, initial=0.0) * (task.target_known > 0.0)
    return found


CLASSICAL: Mapping[str, Callable[[Scene, Task, Options], LawStep]] = {
    "stereo-block": stereo_block,
}
"""By name. `euclidean_points` needs a metric frame besides."""
