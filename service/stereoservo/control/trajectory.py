"""Tracking of set-points that move along a planned way, in the images of all cameras that see (thesis 8, 9.3)."""

from __future__ import annotations

from math import inf

import numpy as np

from stereoservo.control.image import held_gain, image_velocity_step
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import displace, move_operators
from stereoservo.kinematics.kernels import project_points, transform_points

CORRECTIONS = 3
"""Newton steps at most; each makes what is left smaller by about the turn of a step [rad]."""


def trajectory(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = J⁺(ṡ* + gain (s* − s))``: feed-forward along the way, feedback on the deviation from it.

    The set-points are near, so the Jacobian is the present one whatever ``options`` say. One camera is enough. With a
    ``dt_s`` the velocity, held so long, displaces the pixels by ``dt (ṡ* + gain (s* − s))`` exactly, not to first order
    (8.5.2): with ``rates`` from here to where the set-points are then, the body keeps to its way at any loop rate.
    """
    first = image_velocity_step(scene, task, options, JacobianChoice.CURRENT, task.rates)
    if not options.dt_s > 0.0:
        return first
    step = _corrected(scene, task, options, first.velocity * options.dt_s)
    return first._replace(velocity=step / options.dt_s)


def _corrected(scene: Scene, task: Task, options: Options, step: FloatArray) -> FloatArray:
    """The joints' step (n,) whose finite motion displaces the pixels as meant, from one of first order on."""
    meant = options.dt_s * (task.rates + held_gain(options) * (task.set_points - scene.pixels))
    whole = options._replace(gain=1.0, dt_s=0.0)
    still = np.zeros_like(task.rates)
    weights = (scene.weights * task.wanted)[..., None]
    before, _ = project_points(scene.matrices, scene.points)
    best, least = step, inf
    for _ in range(CORRECTIONS + 1):
        points = transform_points(displace(scene.operators, scene.composition, step), scene.points)
        pixels, _ = project_points(scene.matrices, points)
        moved = pixels - before
        left = float(np.where(weights > 0.0, (weights * (meant - moved)) ** 2, 0.0).sum())
        if not left < least:
            break
        best, least = step, left
        ahead = scene._replace(
            operators=move_operators(scene.operators, scene.composition, step), points=points, pixels=moved
        )
        change = image_velocity_step(
            ahead, task._replace(set_points=meant), whole, JacobianChoice.CURRENT, still
        )
        step = step + change.velocity
    return best
