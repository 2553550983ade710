"""Image-based stereo servoing: stacked (thesis 8.36) and block by block (8.37).

``stereo_law`` is the readable reference of the bare step, `control.kernels.stereo_step`; the law runs
`control.image_kernel.image_step`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.control.damped import damped_least_squares_reference
from stereoservo.control.image import NO_COMPONENTS, NO_STATUS, image
from stereoservo.control.law import LawStep, Options, Scene, Task
from stereoservo.geometry.homogeneous import FloatArray

DAMPING = 1e-6
"""Default damping, relative to the largest diagonal of the normal matrix."""


class StereoStep(NamedTuple):
    """Joint velocity (n,) [rad/s or m/s], largest pixel error over seen markers [px], conditioning (0:
    singular).
    """

    velocity: FloatArray
    error_px: float
    conditioning: float


def stereo_law(
    jacobian: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    weights: FloatArray,
    gain: float,
    damping: float = DAMPING,
) -> StereoStep:
    """``q̇ = −gain·J⁺(s − s*)`` over all cameras stacked (8.36).

    ``jacobian`` (c, m, 2, n) [px/rad or px/m], ``pixels`` and ``set_points`` (c, m, 2) [px], ``weights`` (c,
    m) = 1/sigma [1/px], 0 where a marker is missing (its rows are then not read, NaN is allowed there).
    ``gain`` [1/s].
    """
    n = jacobian.shape[-1]
    error = np.where(weights[..., None] != 0.0, pixels - set_points, 0.0)
    step, conditioning = damped_least_squares_reference(
        jacobian.reshape(-1, n), error.reshape(-1), np.repeat(weights.reshape(-1), 2), damping
    )
    worst = float(np.sqrt((error**2).sum(axis=-1)).max(initial=0.0))
    return StereoStep(-gain * step, worst, conditioning)


def stereo(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(s* − s)``, all cameras stacked (8.36): with one camera left it is the law `image`."""
    return image(scene, task, options)


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
