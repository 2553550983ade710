"""Tracking of set-points that move along a planned way, in the images of all cameras that see (thesis 8, 9.3).

``trajectory_velocity`` is the readable reference; the loop runs `control.trajectory_kernel.trajectory_step`, tested
against it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo.control.damped import damped_least_squares_reference
from stereoservo.control.image import held_gain, image_jacobian_at, limited
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.step_correction import CONVERGED, ITERATIONS, SLACK, step_operators
from stereoservo.control.trajectory_kernel import JOINT_SHARE, trajectory_step
from stereoservo.geometry.cameras import project_many
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import Composition, displacement


def trajectory(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = J⁺(ṡ* + gain (s* − s))``: feed-forward along the way, feedback on the deviation from it.

    Where the images say little (near singular postures, self-motions) the joints go as they are planned, if they are:
    ``Σ p_j |q̇_j − (q̇*_j + gain (q*_j − q_j))|²`` is added to what is least, with `JOINT_SHARE` of the images' weight.

    The set-points are near, so the Jacobian is the present one whatever ``options`` say. One camera is enough. With
    ``dt_s`` the velocity, held so long, moves the images as meant to all orders; ``task.rates`` are then best the mean
    rates of the set-points over the step that begins. Rests, with conditioning 0, where the planned joints are not
    finite. Raises ValueError for planned joints of another arm.
    """
    n = len(scene.operators)
    if len(task.joint_rates) not in (0, n) or len(task.joint_error) != len(task.joint_rates):
        raise ValueError(
            f"an arm of {n} joints takes {n} planned rates and errors, or none of both; got "
            f"{len(task.joint_rates)} and {len(task.joint_error)}"
        )
    velocity, conditioning = trajectory_step(
        scene.operators, scene.composition, scene.matrices, scene.camera_centres, scene.points, scene.pixels,
        task.set_points, task.rates, scene.weights, task.wanted, options.gain, options.dt_s, options.damping,
        task.joint_rates, task.joint_error, task.joint_weight,
    )  # fmt: skip
    return limited(scene, task, options, velocity, conditioning)


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
