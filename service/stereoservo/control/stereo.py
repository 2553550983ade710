"""Image-based stereo servoing: stacked (thesis 8.36) and block by block (8.37).

``stereo_law`` is the readable reference of the bare step, `control.stereo_kernel.stereo_step`; the law runs
`control.image_kernel.image_step`. `StereoCycle` makes a whole step from joints and pixels in one kernel call.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.control.damped import damped_least_squares_reference
from stereoservo.control.image import NO_COMPONENTS, NO_STATUS, image
from stereoservo.control.law import LawStep, Options, Scene, Task
from stereoservo.control.stereo_kernel import stereo_cycle
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import KindArray

DAMPING = 1e-6
"""Default damping, relative to the largest diagonal of the normal matrix."""


class StereoStep(NamedTuple):
    """Joint velocity (n,) [rad/s or m/s], largest pixel error over seen markers [px], conditioning (0:
    singular).
    """

    velocity: FloatArray
    error_px: float
    conditioning: float


def stereo_law(
    jacobian: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    weights: FloatArray,
    gain: float,
    damping: float = DAMPING,
) -> StereoStep:
    """``q̇ = −gain·J⁺(s − s*)`` over all cameras stacked (8.36).

    ``jacobian`` (c, m, 2, n) [px/rad or px/m], ``pixels`` and ``set_points`` (c, m, 2) [px], ``weights`` (c,
    m) = 1/sigma [1/px], 0 where a marker is missing (its rows are then not read, NaN is allowed there).
    ``gain`` [1/s].
    """
    n = jacobian.shape[-1]
    error = np.where(weights[..., None] != 0.0, pixels - set_points, 0.0)
    step, conditioning = damped_least_squares_reference(
        jacobian.reshape(-1, n), error.reshape(-1), np.repeat(weights.reshape(-1), 2), damping
    )
    worst = float(np.sqrt((error**2).sum(axis=-1)).max(initial=0.0))
    return StereoStep(-gain * step, worst, conditioning)


class StereoCycle:
    """Joints and pixels to joint velocities in one call: kinematics (5.21), points, Jacobian, damped solve (8.36).

    ``generators`` (n, 4, 4) with ``zero`` (n,), ``kinds`` (n,) 0 revolute or 1 prismatic, ``tip_first`` as in
    `ProjectiveChain`; ``matrices`` (c, 3, 4); ``marker_points`` (m, 4) at the zero. Fixed for the life of the object.
    """

    def __init__(
        self,
        generators: FloatArray,
        kinds: KindArray,
        zero: FloatArray,
        matrices: FloatArray,
        marker_points: FloatArray,
        tip_first: bool = False,
    ) -> None:
        self._chain = np.ascontiguousarray(np.stack([generators, generators @ generators]))
        self._kinds, self._zero, self._tip_first = kinds, zero, tip_first
        self._matrices, self._points = np.ascontiguousarray(matrices), np.ascontiguousarray(marker_points)

    def step(
        self,
        q: FloatArray,
        pixels: FloatArray,
        set_points: FloatArray,
        weights: FloatArray,
        gain: float,
        damping: float = DAMPING,
        *,
        target_points: FloatArray | None = None,
        triangulations: int = -1,
    ) -> tuple[FloatArray, float]:
        """Velocity (n,) [rad/s or m/s] and conditioning at joints ``q`` (n,); the rest as in `stereo_law`.

        Points are those of the joints (8.35), or, with ``triangulations`` >= 0 renormalised iterations, triangulated
        (8.34) where two cameras see them. With ``target_points`` (m, 4) the Jacobian is the mean of here and there.
        """
        velocity = np.empty(self._zero.shape[0])
        mean = target_points is not None
        conditioning = stereo_cycle(
            self._chain, self._kinds, self._zero, q, self._tip_first, self._matrices, self._points,
            target_points if target_points is not None else self._points, pixels, set_points, weights, gain, damping,
            mean, triangulations, velocity,
        )  # fmt: skip
        return velocity, conditioning


def stereo(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(s* − s)``, all cameras stacked (8.36): with one camera left it is the law `image`."""
    return image(scene, task, options)


def stereo_block(scene: Scene, task: Task, options: Options) -> LawStep:
    """The mean of the laws of the single cameras that see (8.37, halved for two: errata)."""
    velocity, conditioning, seeing = np.zeros(scene.operators.shape[0]), 1.0, 0
    for camera in range(scene.matrices.shape[0]):
        alone = np.zeros_like(task.wanted)
        alone[camera] = task.wanted[camera]
        if not (scene.weights * alone > 0.0).any():
            continue
        step = image(scene, task._replace(wanted=alone), options)
        velocity, conditioning, seeing = (
            velocity + step.velocity,
            min(conditioning, step.conditioning),
            seeing + 1,
        )
    if seeing == 0:
        return LawStep(velocity, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, 0.0)
    return LawStep(velocity / seeing, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, conditioning)
