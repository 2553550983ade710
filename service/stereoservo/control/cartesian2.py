"""Cartesian control in two components (thesis 8.55): translation of the centre, and one rotation about it."""

from __future__ import annotations

import numpy as np

from stereoservo.control.cartesian import COMPONENTS2, UNITS2, cartesian_reasons
from stereoservo.control.cartesian_kernel import cartesian_step
from stereoservo.control.law import IntArray, LawStep, Options, Scene, Task
from stereoservo.control.reasons import Reason
from stereoservo.geometry.homogeneous import FloatArray

COMPONENTS, UNITS = COMPONENTS2, UNITS2


def cartesian2(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = [q̂_t q̂_s] Λ e``, ``e = (τ, θ_s)`` the motion still to be made (8.55).

    The rotation takes the short way round, or the long one where only that keeps the face in sight; where neither
    does, the hinge of the law in three components goes first, and the status says WAITS.
    """
    return LawStep(
        *cartesian_step(
            scene.operators, scene.composition, scene.points[task.face], task.target_points[task.face], task.centre,
            task.centre_target, scene.camera_centres, np.full(2, options.gain), options.dt_s, options.rotation_rate,
            options.translation_rate, True,
        ),
        1.0,
    )  # fmt: skip


def cartesian2_reasons(task_error: FloatArray, allowed: FloatArray, status: IntArray) -> tuple[Reason, ...]:
    """What a step of the law has to tell: components that the arm cannot make, or that wait; empty when all move."""
    return cartesian_reasons(COMPONENTS, UNITS, task_error, allowed, status)
