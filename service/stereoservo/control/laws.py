"""The laws by their names: what the loop, the predictions and the campaigns run."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from stereoservo.control import cartesian2 as two
from stereoservo.control import cartesian3 as three
from stereoservo.control.image import ILL_CONDITIONED, image, image_reasons
from stereoservo.control.law import Law, LawStep, Options, Scene, Task
from stereoservo.control.points import points
from stereoservo.control.stereo import stereo, stereo_block
from stereoservo.control.trajectory import trajectory

__all__ = ["CLASSICAL", "ILL_CONDITIONED", "LAWS", "image_reasons"]


LAWS: Mapping[str, Law] = {
    "stereo": Law(stereo, needs_pose=False, reasons=image_reasons),
    "image": Law(image, needs_pose=False, reasons=image_reasons),
    "points": Law(points, needs_pose=True, reasons=image_reasons),
    "cartesian3": Law(
        three.cartesian3,
        needs_pose=True,
        components=three.COMPONENTS,
        units=three.UNITS,
        reasons=lambda step: three.cartesian3_reasons(step.error, step.allowed, step.status),
    ),
    "cartesian2": Law(
        two.cartesian2,
        needs_pose=True,
        components=two.COMPONENTS,
        units=two.UNITS,
        reasons=lambda step: two.cartesian2_reasons(step.error, step.allowed, step.status),
    ),
    "trajectory": Law(trajectory, needs_pose=False, reasons=image_reasons),
}

CLASSICAL: Mapping[str, Callable[[Scene, Task, Options], LawStep]] = {
    "stereo-block": stereo_block,
}
"""Further laws, for comparison and experiments. Two more need what this mapping has not: `points.euclidean_points` a
metric frame, `moved_cameras.image_of_moved_cameras` LAPACK.
"""
