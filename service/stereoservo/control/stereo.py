"""Image-based stereo servoing with the stacked pseudo-inverse (thesis 8.36): the readable reference.

The loop runs `control.kernels.stereo_step`, which is tested against this.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.control.damped import damped_least_squares_reference
from stereoservo.geometry.homogeneous import FloatArray

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
