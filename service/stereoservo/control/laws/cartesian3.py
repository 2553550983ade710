"""Cartesian control in three components (thesis 8.42): translation, hinge, and turn of the face in its plane."""

from __future__ import annotations

import numpy as np

from stereoservo.control.cartesian import cartesian_reasons, cartesian_step
from stereoservo.control.law import Law, LawProperties, LawStep, Options, Scene, Task
from stereoservo.messages.reasons import Reason
from stereoservo.planning.primitives import HINGE, PLANAR, TRANSLATION

COMPONENTS, UNITS = (TRANSLATION, HINGE, PLANAR), ("", "rad", "rad")

COMPONENTS, UNITS = (TRANSLATION, HINGE, PLANAR), ("", "rad", "rad")


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


def cartesian3_reasons(step: LawStep) -> tuple[Reason, ...]:
    """Components that the arm cannot make, or that wait; empty when all move."""
    return cartesian_reasons(COMPONENTS, UNITS, step.error, step.allowed, step.status)


LAW = Law(
    cartesian3,
    "straight line; hinge and turn of the face, kept in view",
    needs_pose=True,
    path="straight",
    options=("centre",),
    components=COMPONENTS,
    units=UNITS,
    reasons=cartesian3_reasons,
    properties=LawProperties(
        centre="straight",
        face="kept: a component waits for the other",
        works_on="pose; translation, hinge, turn in the plane",
        noise_at_rest="low",
        one_camera="goes on by prediction",
        fails_when="the straight way leaves image or joint limits: refused before",
    ),
    colour="#d55e00",
    rank=40,
)
