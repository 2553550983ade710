"""The laws in the images in numpy: the readable reference of `control.laws.stereo`."""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import JacobianChoice, Options, Scene, Task
from stereoservo.control.laws.stereo import held_gain
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.benchmarks.cycle import damped_least_squares_reference


def image_jacobian_at(scene: Scene, task: Task, jacobian: int) -> FloatArray:
    """``J_G P Ĥ_j M`` (c, m, 2, n) around what ``jacobian`` names (8.1.1); present points where no target is known."""
    now = _jacobian(scene, np.broadcast_to(scene.points, (*scene.weights.shape, 4)))
    if jacobian == JacobianChoice.CURRENT:
        return now
    if jacobian == JacobianChoice.FIXED_DEPTH:
        centres = scene.camera_centres[:, None]
        depth = np.einsum("ci,mi->cm", scene.matrices[:, 2], scene.points)
        wanted_depth = np.einsum("ci,mi->cm", scene.matrices[:, 2], task.target_points)
        found = _jacobian(scene, centres + (wanted_depth / depth)[..., None] * (scene.points - centres))
    else:
        found = _jacobian(scene, np.broadcast_to(task.target_points, (*scene.weights.shape, 4)))
        if jacobian == JacobianChoice.MEAN:
            found = 0.5 * (now + found)
    return np.where((task.target_known > 0.0)[:, None, None], found, now)


def _jacobian(scene: Scene, M: FloatArray) -> FloatArray:
    """(c, m, 2, n) for points (c, m, 4), one for each camera."""
    m = np.einsum("cij,cmj->cmi", scene.matrices, M)
    v = np.einsum("cij,njk,cmk->cmin", scene.matrices, scene.operators, M)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = m[..., :2] / m[..., 2:]
        found: FloatArray = (v[..., :2, :] - pixels[..., None] * v[..., 2:, :]) / m[..., 2, None, None]
    return found


def image_velocity(
    scene: Scene, task: Task, options: Options, jacobian: int, rates: FloatArray
) -> tuple[FloatArray, float]:
    """Velocity (n,) of least ``Σ w²|J q̇ − gain (s* − s) − ṡ*|²``, damped, and the conditioning: the reference."""
    weights = scene.weights * task.wanted
    seen = (weights > 0.0)[..., None]
    residual = np.where(seen, held_gain(options) * (task.set_points - scene.pixels) + rates, 0.0)
    J = np.where(seen[..., None], image_jacobian_at(scene, task, jacobian), 0.0)
    rows = np.repeat(weights.reshape(-1), 2)
    return damped_least_squares_reference(J.reshape(-1, J.shape[-1]), residual.reshape(-1), rows, options.damping)
