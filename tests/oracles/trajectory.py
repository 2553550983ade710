"""Tracking of a plan in numpy: the readable reference of the kernel in `control.laws.trajectory`."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from oracles.image import image_jacobian_at
from oracles.step_correction import step_operators
from stereoservo.control.law import JacobianChoice, Options, Scene, Task
from stereoservo.control.laws.stereo import held_gain
from stereoservo.control.laws.trajectory import JOINT_SHARE
from stereoservo.control.step_correction import CONVERGED, ITERATIONS, SLACK
from stereoservo.geometry.cameras import project_many
from stereoservo.kinematics.composition import Composition, displacement
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.benchmarks.cycle import damped_least_squares_reference


def trajectory_velocity(scene: Scene, task: Task, options: Options) -> tuple[FloatArray, float]:
    """Velocity (n,) and conditioning: to first order, and for ``dt_s`` > 0 refined by Newton's method on the images."""
    weights = scene.weights * task.wanted
    seen = (weights > 0.0)[..., None]
    held, n = held_gain(options), len(scene.operators)
    residual = np.where(seen, held * (task.set_points - scene.pixels) + task.rates, 0.0)
    J = _rows(scene, task, seen)
    pull, meant, damping = np.zeros(n), np.zeros(n), options.damping
    if len(task.joint_rates) == n:
        diagonal = ((np.repeat(weights.reshape(-1), 2)[:, None] * J) ** 2).sum(axis=0)
        pull = damping * diagonal.max() + task.joint_weight * JOINT_SHARE * diagonal
        meant = task.joint_rates + task.joint_weight * held * task.joint_error
        damping = 0.0
    if not np.isfinite(pull * meant).all():
        return np.zeros(n), 0.0
    velocity, conditioning = _solved(J, residual, weights, pull, meant, damping)
    dt, composition = options.dt_s, Composition(scene.composition)
    if not dt > 0.0 or conditioning == 0.0:
        return velocity, conditioning
    goal = project_many(scene.matrices, scene.points) + dt * residual
    found = best = dt * velocity
    before = np.inf
    for _ in range(ITERATIONS):
        turned = step_operators(scene.operators, composition, found)
        moved = scene.points @ displacement(scene.operators, composition, found).T
        residual = np.where(seen, goal - project_many(scene.matrices, moved), 0.0)
        left = dt * meant - found
        error = float((weights[..., None] ** 2 * residual**2).sum() + (pull * left**2).sum())
        if not error <= SLACK * before:
            break
        best, before = found, error
        J = _rows(scene._replace(operators=turned, points=moved), task, seen)
        change, _ = _solved(J, residual, weights, pull, left, damping)
        found = found + change
        if float(np.abs(change).max()) < CONVERGED:
            break
    return best / dt, conditioning


def _rows(scene: Scene, task: Task, seen: npt.NDArray[np.bool_]) -> FloatArray:
    """The image Jacobian (r, n) around the present points, zero where nothing is seen."""
    J = image_jacobian_at(scene, task, JacobianChoice.CURRENT)
    rows: FloatArray = np.where(seen[..., None], J, 0.0).reshape(-1, J.shape[-1])
    return rows


def _solved(
    J: FloatArray,
    residual: FloatArray,
    weights: FloatArray,
    pull: FloatArray,
    meant: FloatArray,
    damping: float,
) -> tuple[FloatArray, float]:
    """``x`` (n,) of least ``Σ w²|Jx − residual|² + Σ pull (x − meant)²``, damped, and the conditioning."""
    return damped_least_squares_reference(
        np.vstack([J, np.eye(len(pull))]),
        np.concatenate([residual.reshape(-1), meant]),
        np.concatenate([np.repeat(weights.reshape(-1), 2), np.sqrt(pull)]),
        damping,
    )
