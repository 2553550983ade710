"""Tracking of set-points that move along a planned way, in the images of all cameras that see (thesis 8, 9.3).

``trajectory_velocity`` is the readable reference; the loop runs `control.trajectory_kernel.trajectory_step`, tested
against it.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.damped import damped_least_squares_reference
from stereoservo.control.image import held_gain, image_jacobian_at, image_velocity, limited
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.step_correction import CONVERGED, ITERATIONS, SLACK, step_operators
from stereoservo.control.trajectory_kernel import trajectory_step
from stereoservo.geometry.cameras import project_many
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import Composition, displacement


def trajectory(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = J⁺(ṡ* + gain (s* − s))``: feed-forward along the way, feedback on the deviation from it.

    The set-points are near, so the Jacobian is the present one whatever ``options`` say. One camera is enough. With
    ``dt_s`` the velocity, held so long, moves the images as meant to all orders; ``task.rates`` are then best the mean
    rates of the set-points over the step that begins.
    """
    velocity, conditioning = trajectory_step(
        scene.operators, scene.composition, scene.matrices, scene.camera_centres, scene.points, scene.pixels,
        task.set_points, task.rates, scene.weights, task.wanted, options.gain, options.dt_s, options.damping,
    )  # fmt: skip
    return limited(scene, task, options, velocity, conditioning)


def trajectory_velocity(scene: Scene, task: Task, options: Options) -> tuple[FloatArray, float]:
    """Velocity (n,) and conditioning: to first order, and for ``dt_s`` > 0 refined by Newton's method on the images."""
    velocity, conditioning = image_velocity(scene, task, options, JacobianChoice.CURRENT, task.rates)
    dt, composition = options.dt_s, Composition(scene.composition)
    if not dt > 0.0 or conditioning == 0.0:
        return velocity, conditioning
    weights = scene.weights * task.wanted
    seen = (weights > 0.0)[..., None]
    goal = project_many(scene.matrices, scene.points) + np.where(
        seen, dt * (task.rates + held_gain(options) * (task.set_points - scene.pixels)), 0.0
    )
    found = best = dt * velocity
    before = np.inf
    for _ in range(ITERATIONS):
        turned = step_operators(scene.operators, composition, found)
        moved = scene.points @ displacement(scene.operators, composition, found).T
        residual = np.where(seen, goal - project_many(scene.matrices, moved), 0.0)
        error = float((weights[..., None] ** 2 * residual**2).sum())
        if not error <= SLACK * before:
            break
        best, before = found, error
        J = image_jacobian_at(scene._replace(operators=turned, points=moved), task, JacobianChoice.CURRENT)
        change, _ = damped_least_squares_reference(
            np.where(seen[..., None], J, 0.0).reshape(-1, J.shape[-1]), residual.reshape(-1),
            np.repeat(weights.reshape(-1), 2), options.damping,
        )  # fmt: skip
        found = found + change
        if float(np.abs(change).max()) < CONVERGED:
            break
    return best / dt, conditioning
