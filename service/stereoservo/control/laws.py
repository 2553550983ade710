"""The laws by their names: what the loop, the predictions and the campaigns run."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from stereoservo.control import cartesian2 as two
from stereoservo.control import cartesian3 as three
from stereoservo.control.image import ILL_CONDITIONED, image, image_reasons
from stereoservo.control.kernels import cartesian3_step
from stereoservo.control.law import Law, LawStep, Options, Scene, Task
from stereoservo.control.points import points
from stereoservo.control.stereo import stereo, stereo_block
from stereoservo.control.trajectory import trajectory

__all__ = ["CLASSICAL", "ILL_CONDITIONED", "LAWS", "image_reasons"]


def cartesian3(scene: Scene, task: Task, options: Options) -> LawStep:
    """(8.42)."""
    velocity, error, allowed, status = cartesian3_step(
        scene.operators, scene.points[task.face], task.target_points[task.face], task.centre, task.centre_target,
        scene.camera_centres, np.full(3, options.gain),
    )  # fmt: skip
    return LawStep(velocity, error, allowed, status, 1.0)


LAWS: Mapping[str, Law] = {
    "stereo": Law(stereo, needs_pose=False, reasons=image_reasons),
    "image": Law(image, needs_pose=False, reasons=image_reasons),
    "points": Law(points, needs_pose=True, reasons=image_reasons),
    "cartesian3": Law(
        cartesian3,
        needs_pose=True,
        components=three.COMPONENTS,
        units=three.UNITS,
        reasons=lambda step: three.cartesian3_reasons(step.error, step.allowed, step.status),
    ),
    "cartesian2": Law(two.cartesian2, needs_pose=True, components=two.COMPONENTS, units=two.UNITS),
    "trajectory": Law(trajectory, needs_pose=False, reasons=image_reasons),
}

CLASSICAL: Mapping[str, Callable[[Scene, Task, Options], LawStep]] = {"stereo-block": stereo_block}
"""Further laws of the literature, for comparison. `points.euclidean_points` makes one more, for a calibrated rig."""
