"""Statistical test of which of several hypothetical changes of a model explains its residuals: chi-square thresholds,
candidates, Schwarz's criterion, significance.

Used on-line, for one set of innovations (`change_detection_kernel`), and off-line, for the pixels of a check
motion (`model_check`). Each hypothesis is a change of ``size`` parameters. Those of the largest first-order gain are
estimated in full. A hypothesis is significant if its likelihood ratio, at the noise that the best one leaves, exceeds
the chi-square quantile of the false-alarm rate (Wilks, Bonferroni); of these the least ``chi2 + size ln N`` is selected
(Schwarz). Kernels are explicit loops in a fixed order: their results are part of recordings.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import kernel

MAX_SIZE = 16
"""Number of parameters of the largest hypothesis: all joints."""
REFINED = 5
"""Number of hypotheses, the best to first order, that are estimated in full."""
UNCLEAR = 9.2
"""Difference of the penalised chi-squares of two hypotheses below which neither is excluded: odds of 100 to 1."""


# -- thresholds from false-alarm rates ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Thresholds:
    """Limits of the decision.

    ``ratios`` (MAX_SIZE + 1,): reduction of chi-square that a hypothesis of so many parameters must exceed, at the
    noise that the best one leaves; ``log_alpha``: logarithm of the probability below which the total chi-square is
    not noise; ``least_px``: rms change of the pixels below which no change is reported, however significant.
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
    """Thresholds at which white noise of the stated size raises at most ``false_alarms_per_hour``.

    Half of the probability is assigned to the total chi-square, half to the hypotheses in equal shares.
    Raises ValueError for rates that are not positive.
    """
    if not (false_alarms_per_hour > 0.0 and decisions_per_hour > 0.0):
        raise ValueError(
            f"rates are {false_alarms_per_hour:g} false alarms and {decisions_per_hour:g} decisions an hour; "
            "positive ones are needed"
        )
    chance = min(false_alarms_per_hour / decisions_per_hour, 0.5)
    hypotheses = cameras + 2 + markers + joints
    return Thresholds(_ratios(0.5 * chance / hypotheses), math.log(0.5 * chance), least_px)


def check_thresholds(alpha: float, hypotheses: int, measurements: int) -> Thresholds:
    """Thresholds of a single decision of false-alarm probability ``alpha``, which also require that a hypothesis gains
    more than the penalty ``size ln N`` of its parameters, ``N`` the number of ``measurements``.
    """
    penalties = np.arange(MAX_SIZE + 1) * math.log(measurements)
    return Thresholds(np.maximum(_ratios(alpha / hypotheses), penalties), math.log(alpha), 0.0)


def _ratios(alpha: float) -> FloatArray:
    """Chi-square quantiles (MAX_SIZE + 1,) by degrees of freedom: the distribution of a ratio by Wilks's theorem, exact
    if the hypothesis is linear.
    """
    return np.array([math.inf] + [chi2_quantile(alpha, size) for size in range(1, MAX_SIZE + 1)])


def chi2_tail(x: float, freedom: int) -> float:
    """Probability that chi-square exceeds ``x``: the finite sums for even and odd degrees of freedom."""
    if x <= 0.0:
        return 1.0
    half = 0.5 * x
    tail = math.exp(-half) if freedom % 2 == 0 else math.erfc(math.sqrt(half))
    for k in range(2 if freedom % 2 == 0 else 1, freedom, 2):
        tail += math.exp(0.5 * k * math.log(half) - half - math.lgamma(0.5 * k + 1.0))
    return tail


def chi2_quantile(tail: float, freedom: int) -> float:
    """Value that chi-square exceeds with probability ``tail``, by bisection."""
    low, high = 0.0, 1.0
    while chi2_tail(high, freedom) > tail:
        high *= 2.0
    for _ in range(80):
        midpoint = 0.5 * (low + high)
        low, high = (midpoint, high) if chi2_tail(midpoint, freedom) > tail else (low, midpoint)
    return high


# -- the decision ---------------------------------------------------------------------------------------------


@kernel
def log_tail(chi2: float, freedom: int) -> float:
    """Logarithm of the probability that chi-square of ``freedom``, rounded up to even, exceeds ``chi2``; a finite
    sum.
    """
    half = 0.5 * chi2
    terms = (freedom + 1) // 2
    if half <= 0.0 or terms <= 0:
        return 0.0
    largest = -math.inf
    for i in range(terms):
        largest = max(largest, i * math.log(half) - math.lgamma(i + 1.0))
    total = 0.0
    for i in range(terms):
        total += math.exp(i * math.log(half) - math.lgamma(i + 1.0) - largest)
    return min(0.0, -half + largest + math.log(total))


@kernel
def is_unexplained(chi2: float, freedom: int, log_alpha: float, tolerated: float) -> bool:
    """Whether a chi-square is neither noise at level ``log_alpha`` nor within the ``tolerated`` part due to errors of
    the model.
    """
    return log_tail(chi2, freedom) < log_alpha and not chi2 <= tolerated


@kernel
def select_candidates(gains: FloatArray, sizes: IntArray, candidates: BoolArray) -> None:
    """Mark in ``candidates`` (h,) the `REFINED` testable hypotheses with the largest penalised first-order ``gains``
    (h,); ``sizes`` (h,) is 0 if a hypothesis cannot be tested.
    """
    candidates[:] = False
    for _ in range(REFINED):
        best = -1
        for h in range(gains.shape[0]):
            if sizes[h] > 0 and not candidates[h] and (best < 0 or gains[h] > gains[best]):
                best = h
        if best < 0:
            return
        candidates[best] = True


@kernel
def noise_level(chi2: FloatArray, sizes: IntArray, candidates: BoolArray, measurements: int) -> float:
    """Least reduced chi-square of the candidates, at least 1: the variance of the noise over the stated one."""
    noise = math.inf
    for h in range(chi2.shape[0]):
        if candidates[h]:
            noise = min(noise, chi2[h] / max(measurements - sizes[h], 1))
    return max(noise, 1.0)


@kernel
def penalised_chi2(chi2: float, size: int, noise: float, penalty: float) -> float:
    """Schwarz's criterion: chi-square in units of the ``noise``, plus ``penalty`` = ln N for each parameter."""
    return chi2 / noise + size * penalty


class Tested(NamedTuple):
    """Tested hypotheses: remaining ``chi2`` (h,), ``sizes`` (h,) in parameters, ``effects`` (h,)
    [px], and mask of the ``candidates`` (h,).
    """

    chi2: FloatArray
    sizes: IntArray
    effects: FloatArray
    candidates: BoolArray


@kernel
def two_best(
    before: float, tested: Tested, noise: float, penalty: float, ratios: FloatArray, least_px: float
) -> tuple[int, int]:
    """Indices of the significant candidates of least and second least penalised chi-square, -1 for none.

    ``before``: chi-square without a change; ``noise`` and ``penalty`` as in `penalised_chi2`; ``ratios`` and
    ``least_px`` as in `Thresholds`.
    """
    chi2, sizes, effects, candidates = tested
    first, second = -1, -1
    for h in range(chi2.shape[0]):
        significant = candidates[h] and (before - chi2[h]) / noise > ratios[sizes[h]]
        if not significant or not effects[h] >= least_px:
            continue
        score = penalised_chi2(chi2[h], sizes[h], noise, penalty)
        if first < 0 or score < penalised_chi2(chi2[first], sizes[first], noise, penalty):
            first, second = h, first
        elif second < 0 or score < penalised_chi2(chi2[second], sizes[second], noise, penalty):
            second = h
    return first, second
