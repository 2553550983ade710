"""Gain that rises towards the goal: slow where the error is large, fast where it is small, without a step between.

``λ(e) = far + (near − far) exp(−slope·e / |near − far|)``: ``near`` at no error, ``far`` at a large one, falling (or,
where ``near < far``, rising) from ``near`` at the rate ``slope``. Continuous, monotone, between ``near`` and ``far``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from stereoservo.kinematics.kernels import kernel

SLOPE_UNIT_PX = 100.0
"""Slopes are stated in 1/s per so many pixels."""


class GainCurve(NamedTuple):
    """``near`` and ``far`` [1/s], ``slope`` > 0 [1/s per 100 px]: how fast the gain leaves ``near``."""

    near: float
    far: float
    slope: float


def constant_gain(gain: float) -> GainCurve:
    """The curve of one gain [1/s] at every error."""
    return gain_curve(gain, gain, 1.0)


def gain_curve(near: float, far: float, slope: float) -> GainCurve:
    """A checked curve. Raises ValueError naming what is not positive and finite."""
    for name, value in (("near", near), ("far", far), ("slope", slope)):
        if not 0.0 < value < math.inf:
            raise ValueError(f"gain: {name} is {value}; a positive finite number is needed")
    return GainCurve(float(near), float(far), float(slope))


def gain_at(curve: GainCurve, error_px: float | None) -> float:
    """The gain [1/s] at an error [px], the largest distance over markers and cameras; None: not measured.

    What is not known, or no number, takes the smaller of the two gains.
    """
    return adaptive_gain(curve.near, curve.far, curve.slope, math.nan if error_px is None else error_px)


@kernel
def adaptive_gain(near: float, far: float, slope: float, error_px: float) -> float:
    """`gain_at` as a kernel; NaN: not measured. Equal gains are constant, a negative error counts as none."""
    if math.isnan(error_px):
        return min(near, far)
    span = abs(near - far)
    if span == 0.0 or error_px <= 0.0:
        return near
    gain = far + (near - far) * math.exp(-slope * (error_px / SLOPE_UNIT_PX) / span)
    return max(min(near, far), min(max(near, far), gain))
