"""Cartesian control in three components (thesis 8.42): translation, hinge, and turn of the face in its plane."""

from __future__ import annotations

from math import inf

import numpy as np

from stereoservo.control.cartesian import (
    COMPONENTS3,
    UNITS3,
    CartesianStep,
    cartesian_law,
    cartesian_reasons,
)
from stereoservo.control.cartesian_kernel import cartesian_step
from stereoservo.control.law import IntArray, LawStep, Options, Scene, Task
from stereoservo.control.reasons import Reason
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import Composition

COMPONENTS, UNITS = COMPONENTS3, UNITS3


def cartesian3(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = [q̂_t q̂_r q̂_p] Λ e``, ``e = (τ, θ_r, θ_p)`` the motion still to be made (8.42)."""
    return LawStep(
        *cartesian_step(
            scene.operators, scene.composition, scene.points[task.face], task.target_points[task.face], task.centre,
            task.centre_target, scene.camera_centres, np.full(3, options.gain), options.dt_s, options.rotation_rate,
            options.translation_rate, False,
        ),
        1.0,
    )  # fmt: skip


def cartesian3_law(
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    centre: FloatArray,
    centre_target: FloatArray,
    camera_centres: FloatArray,
    gains: FloatArray,
) -> CartesianStep:
    """The instantaneous law in three components: `cartesian.cartesian_law`, the reference of `cartesian3_step`."""
    return cartesian_law(
        operators, Composition.BASE_FIRST, points, targets, centre, centre_target, camera_centres, gains, 0.0, inf,
        inf, False,
    )  # fmt: skip


def cartesian3_reasons(task_error: FloatArray, allowed: FloatArray, status: IntArray) -> tuple[Reason, ...]:
    """What a step of the law has to tell: components that the arm cannot make, or that wait; empty when all move."""
    return cartesian_reasons(COMPONENTS, UNITS, task_error, allowed, status)
