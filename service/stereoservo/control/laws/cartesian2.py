"""Control law ``cartesian2``: Cartesian servoing in two components (thesis 8.55), straight translation of the body's
centre and one rotation about it.
"""

from __future__ import annotations

from stereoservo.control.law import Law, LawProperties, LawStep, Options, Scene, Task
from stereoservo.control.laws.cartesian3 import (
    ROTATION,
    cartesian_reasons,
    fill_step,
    velocity_step,
)
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import Record
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.primitives import TRANSLATION

COMPONENTS, UNITS = (TRANSLATION, ROTATION), ("", "rad")


@kernel
def cartesian2_kernel(workspace: Record) -> None:
    """The law's ``kernel``."""
    fill_step(workspace, 2)


def cartesian2(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = [q̂_t q̂_s] Λ e``, ``e = (τ, θ_s)`` the remaining motion (8.55).

    The rotation takes the shorter direction, or the longer one if only that keeps the face visible. If neither does,
    the hinge of the law in three components is made first, and the status is WAITS.
    """
    return velocity_step(scene, task, options, 2)


def cartesian2_reasons(step: LawStep) -> tuple[Reason, ...]:
    """Reasons for components that the arm cannot make, or that wait; empty if all move."""
    return cartesian_reasons(COMPONENTS, UNITS, step.error, step.allowed, step.status)


LAW = Law(
    cartesian2,
    "straight line; one rotation about the centre, the face kept in view",
    needs_pose=True,
    path="straight",
    options=("centre",),
    components=COMPONENTS,
    units=UNITS,
    reasons=cartesian2_reasons,
    kernel=cartesian2_kernel,
    properties=LawProperties(
        centre="straight",
        face="kept likewise",
        works_on="pose; translation, one rotation about the centre",
        noise_at_rest="low",
        one_camera="goes on",
        fails_when="the same; its markers swing less or more than those of `cartesian3`: check both",
    ),
    colour="#e69f00",
    rank=50,
)
