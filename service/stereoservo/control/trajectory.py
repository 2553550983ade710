"""Tracking of set-points that move along a planned way, in the images of all cameras that see (thesis 8, 9.3)."""

from __future__ import annotations

from stereoservo.control.image import image_velocity_step
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task


def trajectory(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = J⁺(ṡ* + gain (s* − s))``: feed-forward along the way, feedback on the deviation from it.

    The set-points are near, so the Jacobian is the present one whatever ``options`` say. One camera is enough.
    """
    return image_velocity_step(scene, task, options, JacobianChoice.CURRENT, task.rates)
