"""When innovations are no noise: thresholds of likelihood ratios from a rate of false alarms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.moved_kernel import MAX_SIZE


@dataclass(frozen=True, eq=False)
class Thresholds:
    """``ratios`` (MAX_SIZE + 1,): what a hypothesis of so many parameters must take from chi-square, in the noise that
    the best one leaves; ``log_alpha``: logarithm of the chance below which a chi-square as a whole is no noise.
    ``least_px``: rms change of the pixels below which a cause is not told, however significant.
    """

    ratios: FloatArray
    log_alpha: float
    least_px: float


def alarm_thresholds(
    *,
    false_alarms_per_hour: float,
    decisions_per_hour: float,
    cameras: int,
    markers: int,
    joints: int,
    least_px: float = 0.0,
) -> Thresholds:
    """Thresholds at which white noise as stated raises at most ``false_alarms_per_hour``.

    Half of the chance goes to chi-square as a whole, half to the hypotheses, each its share (Bonferroni); a ratio is
    chi-square with as many degrees of freedom as parameters (Wilks), exactly where the hypothesis is linear.
    Raises ValueError for rates that are not positive.
    """
    if not (false_alarms_per_hour > 0.0 and decisions_per_hour > 0.0):
        raise ValueError(
            f"rates are {false_alarms_per_hour:g} false alarms and {decisions_per_hour:g} decisions an hour; "
            "positive ones are needed"
        )
    chance = min(false_alarms_per_hour / decisions_per_hour, 0.5)
    hypotheses = cameras + 2 + markers + joints
    ratios = [math.inf] + [chi2_quantile(0.5 * chance / hypotheses, size) for size in range(1, MAX_SIZE + 1)]
    return Thresholds(np.array(ratios), math.log(0.5 * chance), least_px)


def chi2_tail(x: float, freedom: int) -> float:
    """Chance that chi-square exceeds ``x``: the finite sums for even and odd degrees of freedom."""
    if x <= 0.0:
        return 1.0
    half = 0.5 * x
    tail = math.exp(-half) if freedom % 2 == 0 else math.erfc(math.sqrt(half))
    for k in range(2 if freedom % 2 == 0 else 1, freedom, 2):
        tail += math.exp(0.5 * k * math.log(half) - half - math.lgamma(0.5 * k + 1.0))
    return tail


def chi2_quantile(tail: float, freedom: int) -> float:
    """``x`` that chi-square exceeds with chance ``tail``, by bisection."""
    low, high = 0.0, 1.0
    while chi2_tail(high, freedom) > tail:
        high *= 2.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if chi2_tail(middle, freedom) > tail else (low, middle)
    return high
