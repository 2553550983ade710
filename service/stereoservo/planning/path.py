"""Profiles of the components of a Cartesian path: ``μ(σ)``, monotone from 0 to 1 on [0, 1] (7.26, 7.4.3).

Linear: all together, at an even pace. Exponential: as a feedback loop does, ``(1 − e^{−kσ})/(1 − e^{−k})``, scaled to
end at 1 (errata). First and last: the component moves in the first or in the last seven tenths; in the middle one
hands over to the other, slowly enough for accelerations.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.motion_frame import turn
from stereoservo.planning.plan import Profile

LINEAR, FIRST, LAST, EXPONENTIAL = 0.0, 1.0, 2.0, 3.0
"""Shapes of one component."""

DECAY = 4.0
"""How many time constants an exponential motion lasts: what is left of it when linear scaling ends it is 2 %."""
HANDS_OVER, ENDS = 0.3, 0.7
"""Where a component that goes first begins to slow down, and has ended."""

SHAPES: dict[Profile, tuple[float, float, float]] = {
    "linear": (LINEAR, LINEAR, LINEAR),
    "exponential": (EXPONENTIAL, EXPONENTIAL, EXPONENTIAL),
    "translation-first": (FIRST, LAST, LAST),
    "rotation-first": (LAST, FIRST, FIRST),
    "planar-first": (LAST, LAST, FIRST),
}
"""Of translation, hinge and planar rotation."""


def shapes(profile: Profile, amounts: tuple[float, float, float]) -> tuple[float, float, float]:
    """Shapes for components of ``amounts``; where only one kind of shape has anything to do, nothing waits: linear."""
    own = SHAPES[profile]
    at_work = {shape for shape, amount in zip(own, amounts, strict=True) if amount != 0.0}
    if profile == "exponential" or len(at_work) > 1:
        return own
    return SHAPES["linear"]


@kernel
def _first(sigma: float) -> float:
    rate = 2.0 / (HANDS_OVER + ENDS)
    if sigma <= HANDS_OVER:
        return rate * sigma
    if sigma >= ENDS:
        return 1.0
    x = (sigma - HANDS_OVER) / (ENDS - HANDS_OVER)
    return rate * (HANDS_OVER + (ENDS - HANDS_OVER) * 0.5 * (x + math.sin(math.pi * x) / math.pi))


@kernel
def progress(shape: float, sigma: float) -> float:
    """``μ(σ)`` of one component."""
    sigma = min(1.0, max(0.0, sigma))
    if shape == FIRST:
        return _first(sigma)
    if shape == LAST:
        return 1.0 - _first(1.0 - sigma)
    if shape == EXPONENTIAL:
        return math.expm1(-DECAY * sigma) / math.expm1(-DECAY)
    return sigma


NUMBERS = 17


@kernel
def pose_on_path(path: FloatArray, path_parameter: float) -> FloatArray:
    """Displacement (4, 4) from the present pose, in the motion frame."""
    R_r = turn(path[0:3], path[3] * progress(path[15], path_parameter))
    R_p = turn(path[4:7], path[7] * progress(path[16], path_parameter))
    along, aside = progress(path[14], path_parameter), 4.0 * path_parameter * (1.0 - path_parameter)
    H = np.zeros((4, 4))
    H[3, 3] = 1.0
    for i in range(3):
        H[i, 3] = along * path[8 + i] + aside * path[11 + i]
        for k in range(3):
            H[i, k] = R_r[i, 0] * R_p[0, k] + R_r[i, 1] * R_p[1, k] + R_r[i, 2] * R_p[2, k]
    return H
