"""The laws by their names: what the loop, the predictions and the campaigns run."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from stereoservo.control.cartesian3 import COMPONENTS, UNITS, cartesian3_reasons
from stereoservo.control.kernels import cartesian3_step, stereo_step
from stereoservo.control.law import JacobianChoice, Law, LawStep, Options, Scene, Task
from stereoservo.control.reasons import Reason
from stereoservo.kinematics.kernels import image_jacobian

ILL_CONDITIONED = 1e-5
_NONE = np.zeros(0)
_NO_STATUS = np.zeros(0, dtype=np.int64)


def stereo(scene: Scene, task: Task, options: Options) -> LawStep:
    """(8.36) with the chosen Jacobian (8.1.1)."""
    jacobian = image_jacobian(scene.operators, scene.matrices, scene.points)
    if options.jacobian == JacobianChoice.MEAN and bool((task.target_known > 0.0).all()):
        jacobian = 0.5 * (jacobian + image_jacobian(scene.operators, scene.matrices, task.target_points))
    velocity, _, conditioning = stereo_step(
        jacobian, scene.pixels, task.set_points, scene.weights * task.wanted, options.gain, options.damping
    )
    return LawStep(velocity, _NONE, _NONE, _NO_STATUS, conditioning)


def cartesian3(scene: Scene, task: Task, options: Options) -> LawStep:
    """(8.42)."""
    velocity, error, allowed, status = cartesian3_step(
        scene.operators, scene.points[task.face], task.target_points[task.face], task.centre, task.centre_target,
        scene.camera_centres, np.full(3, options.gain),
    )  # fmt: skip
    return LawStep(velocity, error, allowed, status, 1.0)


def image_reasons(step: LawStep) -> tuple[Reason, ...]:
    """What a law in the images has to tell of its step."""
    if step.conditioning >= ILL_CONDITIONED:
        return ()
    hint = "the arm is near a singularity, or the markers do not fix its pose: jog away, or use cartesian3"
    return (Reason("JACOBIAN_ILL_CONDITIONED", "slow", "", step.conditioning, ILL_CONDITIONED, "", hint),)


LAWS: Mapping[str, Law] = {
    "stereo": Law(stereo, needs_pose=False, reasons=image_reasons),
    "cartesian3": Law(
        cartesian3,
        needs_pose=True,
        components=COMPONENTS,
        units=UNITS,
        reasons=lambda step: cartesian3_reasons(step.error, step.allowed, step.status),
    ),
}
