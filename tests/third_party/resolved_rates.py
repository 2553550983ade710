"""Resolved rates: the pixel errors of all cameras by least squares, in numpy. A law as a third party writes it."""

import numpy as np

from stereoservo.control.law import Law, LawStep, Options, Scene, Task


def resolved_rates(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(s* − s)`` around the present points, over the markers that are seen."""
    flat = np.einsum("cij,mj->cmi", scene.matrices, scene.points)
    moved = np.einsum("cij,njk,mk->cmin", scene.matrices, scene.operators, scene.points)
    pixels = flat[..., :2] / flat[..., 2:]
    jacobian = (moved[..., :2, :] - pixels[..., None] * moved[..., 2:, :]) / flat[..., 2, None, None]
    weights = np.sqrt(scene.weights * task.wanted)
    error = np.where(weights[..., None] > 0.0, task.set_points - scene.pixels, 0.0)
    rows = (weights[..., None, None] * jacobian).reshape(-1, jacobian.shape[-1])
    rates = np.linalg.lstsq(rows, (weights[..., None] * error).reshape(-1), rcond=1e-8)[0]
    velocity = options.gain * rates
    twist = np.tensordot(velocity, scene.operators, axes=1)
    turn = np.sqrt(max(1e-30, -0.5 * np.trace(twist @ twist)))
    speed = max(1e-15, float(np.linalg.norm(twist @ task.centre)))
    factor = min(1.0, options.rotation_rate / turn, options.translation_rate / speed)
    none = np.zeros(0)
    return LawStep(factor * velocity, none, none, np.zeros(0, dtype=np.int64), 1.0)


LAW = Law(resolved_rates, "pixel errors by least squares, in numpy", one_camera="suffices", colour="#888800")
