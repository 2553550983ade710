"""Runs every law once, on a made-up arm, so that nothing is left to compile in a loop."""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import Options, Scene, Task
from stereoservo.control.laws import LAWS
from stereoservo.geometry.velocities import twist_matrix
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import project_points


def rehearse_laws() -> None:
    """Compile, or load from numba's cache, the kernels of all laws, limited rates included."""
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
    for law in LAWS.values():
        law.step(scene, task, Options(1.0, 0.004, rotation_rate=1e-3, translation_rate=1e-3))
