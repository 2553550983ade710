"""Compilation of the numba kernels of control laws, incidences, mobility and self-motion: each runs once on an example
arm, so that the servo loop compiles none.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.incidence import (
    image_task,
    incidence_freedoms,
    incidence_step,
    incidence_task,
    limits_task,
)
from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.mobility import mobility
from stereoservo.control.mobility_kernel import self_motion_from_limits
from stereoservo.geometry.screws import twist_matrix
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import project_points


def warm_up_laws(*, own: bool = True) -> None:
    """Compile, or load from numba's cache, the kernels of all laws, limited rates included; without ``own`` only those
    of other distributions.
    """
    operators = np.concatenate([twist_matrix(np.zeros(3), np.eye(3)), twist_matrix(np.eye(3), np.zeros(3))])
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    matrices = np.stack([K @ np.hstack([np.eye(3), np.array([[x], [0], [1.0]])]) for x in (0.1, -0.1)])
    eyes = np.array([[-0.1, 0, -1, 1], [0.1, 0, -1, 1.0]])
    points = np.array([[0, 0, 0, 1], [0.1, 0, 0, 1], [0, 0.1, 0, 1.0]])
    targets = points + np.array([0.01, 0.02, 0.03, 0.0])
    pixels, wanted = project_points(matrices, points)[0], project_points(matrices, targets)[0]
    ones = np.ones((2, 3))
    scene = Scene(operators, int(Composition.BASE_FIRST), matrices, eyes, points, pixels, ones)
    task = Task(
        wanted, ones, np.zeros_like(wanted), targets, np.ones(3), points.mean(axis=0), targets.mean(axis=0),
        np.arange(3),
    )  # fmt: skip
    for name, law in list(LAWS.items()):
        if not own and law.step.__module__.startswith("stereoservo."):
            continue
        try:
            law.step(scene, task, Options(1.0, 0.004, rotation_rate=1e-3, translation_rate=1e-3))
        except (
            Exception
        ) as error:  # a third party's law that cannot step: listed with its error, the others continue
            LAWS.disable(name, f"its step raised {type(error).__name__}: {error}")


def warm_up_incidences() -> None:
    """Compile, or load from numba's cache, the kernels of incidences, mobility and self-motion."""
    operators = np.concatenate([twist_matrix(np.zeros(3), np.eye(3)), twist_matrix(np.eye(3), np.zeros(3))])
    K = np.array([[800.0, 0, 320], [0, 800, 240], [0, 0, 1]])
    matrices = np.stack([K @ np.hstack([np.eye(3), np.array([[x], [0], [1.0]])]) for x in (0.1, -0.1)])
    points = np.array([[0, 0, 0, 1], [0.1, 0, 0, 1], [0, 0.1, 0, 1.0]])
    infinity = np.array([0, 0, 0, 1.0])
    pixels = np.einsum("cij,mj->cmi", matrices, points)
    pixels = pixels[..., :2] / pixels[..., 2:]
    eyes = np.array([[-0.1, 0, -1, 1], [0.1, 0, -1, 1.0]])
    scene = Scene(operators, int(Composition.BASE_FIRST), matrices, eyes, points, pixels, np.ones((2, 3)))
    task = incidence_task(
        ["plane-on-plane"],
        [[0, 1, 2]],
        [points + [0.0, 0.0, 0.01, 0.0] * np.array([[1], [2], [3]])],
        infinity,
        0.1,
    )
    positions = np.zeros(6)
    for second in (
        limits_task(positions, positions - 1.0, positions + 2.0, 0.5),
        image_task(operators, matrices, points, pixels, np.ones((2, 3)), 1.0),
    ):
        incidence_step(scene, task, Options(1.0, 0.004), second)
    slides = scene._replace(operators=operators[:3].copy())
    incidence_freedoms(slides, task, infinity, anywhere=True)
    mobility(slides.operators, matrices, points, infinity)
    self_motion_from_limits(np.zeros((12, 6)), positions, positions - 1.0, positions + 2.0, 0.5)
