"""Laws in the images of the cameras that see (8.26): one camera is enough.

The Jacobian is developed around points that the kinematics carry along (8.29, 8.30), so that control goes on where
a camera drops out; `control.moved_cameras` estimates the cameras anew from the body that they see (8.27, 8.28).
``image_velocity`` is the readable reference; the loop runs `control.image_kernel.image_step`, tested against it.
"""

from __future__ import annotations

from math import expm1, inf

import numpy as np

from stereoservo.control.damped import damped_least_squares_reference
from stereoservo.control.image_kernel import image_step, limit_into
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.reasons import Reason
from stereoservo.geometry.homogeneous import FloatArray

ILL_CONDITIONED = 1e-5
NO_COMPONENTS = np.zeros(0)
NO_STATUS = np.zeros(0, dtype=np.int64)


def held_gain(options: Options) -> float:
    """The gain [1/s] of a velocity held for ``dt_s``: an error decays by ``exp(−gain dt_s)`` all the same."""
    dt = options.dt_s
    return -expm1(-options.gain * dt) / dt if dt > 0.0 else options.gain


def image(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(s* − s)`` over the markers that are seen and wanted, in any number of cameras (8.26)."""
    return image_velocity_step(scene, task, options, options.jacobian, np.zeros_like(task.rates))


def image_velocity_step(
    scene: Scene, task: Task, options: Options, jacobian: int, rates: FloatArray
) -> LawStep:
    """The kernel's step for a choice of the Jacobian and a feed-forward (c, m, 2) [px/s]."""
    velocity, conditioning = image_step(
        scene.operators, scene.matrices, scene.camera_centres, scene.points, task.target_points, task.target_known,
        scene.pixels, task.set_points, rates, scene.weights, task.wanted, held_gain(options), int(jacobian),
        options.damping,
    )  # fmt: skip
    return limited(scene, task, options, velocity, conditioning)


def limited(scene: Scene, task: Task, options: Options, velocity: FloatArray, conditioning: float) -> LawStep:
    """The step of a law without components, its velocity scaled to the rates of ``options`` (in place)."""
    if options.rotation_rate < inf or options.translation_rate < inf:
        centre = task.centre if task.centre.any() else scene.points.mean(axis=0)
        limit_into(scene.operators, centre, options.rotation_rate, options.translation_rate, velocity)
    return LawStep(velocity, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, conditioning)


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
    return damped_least_squares_reference(
        J.reshape(-1, J.shape[-1]), residual.reshape(-1), rows, options.damping
    )


def image_reasons(step: LawStep) -> tuple[Reason, ...]:
    """What a law in the images has to tell of its step."""
    if step.conditioning >= ILL_CONDITIONED:
        return ()
    hint = "the arm is near a singularity, or the markers do not fix its pose: jog away, or use cartesian3"
    return (Reason("JACOBIAN_ILL_CONDITIONED", "slow", "", step.conditioning, ILL_CONDITIONED, "", hint),)
