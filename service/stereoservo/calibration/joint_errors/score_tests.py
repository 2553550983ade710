"""Score tests of the joints' variance components at a bundle with exact readings: errors that are likely although the
likelihood does not prove them (Lin, Variance component testing in generalised linear models, Biometrika 84, 1997).

A score is a quadratic form of the residuals. Exact readings give it the distribution of a weighted sum of chi-squares,
whose tail is taken from its saddlepoint (Kuonen, Biometrika 86, 1999).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import brentq
from scipy.stats import norm

from stereoservo.calibration.joint_errors.variance_components import (
    ReducedRows,
    VarianceComponents,
    estimate_components,
    exact_readings,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray

LIKELY = 0.02
"""Probability with which exact joint readings are said to have likely errors."""
ONE_JOINT = 0.2
"""Share of it that is spent on errors of one joint alone; the rest is on those of all joints alike."""
SHOWN = 3.0
"""Standard deviations by which a test's statistic shows the variance that it is made for."""
LEAST_CHANCE = 1e-12
"""Probability that is stated where it is none to the accuracy of numbers."""
NEGLIGIBLE = 1e-10
"""Weight of a chi-square over the largest below which it is left out."""


class ScoreTests(NamedTuple):
    """Probabilities with which exact readings show as much of errors that are random, repeatable or by posture: of
    ``single`` joints (3, n), and of all joints ``alike`` (3,); 1 where the stops tell nothing of it.
    """

    single: FloatArray
    alike: FloatArray

    @property
    def chance(self) -> float:
        """Probability, at most, with which exact readings show as much in any of the tests (Bonferroni)."""
        one = float(self.single.min()) * self.single.size / ONE_JOINT
        all_joints = float(self.alike.min()) * self.alike.size / (1.0 - ONE_JOINT)
        return min(one, all_joints, 1.0)


def likely_errors(reduced: ReducedRows) -> tuple[VarianceComponents | None, float]:
    """Variance components of joint readings that are likely to have errors, and the probability, at most, with which
    exact ones show as much, by the `reduced_rows` of a bundle with exact ones; None and 0 where no errors are likely.
    """
    tests = score_tests(reduced)
    if tests is None or tests.chance > LIKELY:
        return None, 0.0
    components = estimate_components(reduced, scales=False, screened=False)
    return components, 0.0 if components is None else max(tests.chance, LEAST_CHANCE)


def score_tests(reduced: ReducedRows) -> ScoreTests | None:
    """Score tests by the `reduced_rows` of a bundle; None where its parameters leave no freedom."""
    exact = exact_readings(reduced, reduced.X)
    if exact is None:
        return None
    n = reduced.joints
    columns, component = reduced.columns()
    columns = solve_triangular(exact.root, columns, lower=True)
    columns -= exact.basis @ (exact.basis.T @ columns)
    scores = (exact.left @ columns) / np.sqrt(exact.pixels)
    products = columns.T @ columns

    def probability(members: BoolArray) -> float:
        here = np.flatnonzero(members)
        if not len(here):
            return 1.0
        sizes, axes = np.linalg.eigh(products[np.ix_(here, here)])
        kept = sizes > NEGLIGIBLE * max(float(sizes[-1]), 0.0)
        squares = (scores[here] @ axes[:, kept]) ** 2 / sizes[kept]
        weights = point_optimal_weights(sizes[kept])
        return weighted_chi2_tail(float(weights @ squares), weights)

    kinds = np.arange(3)
    single = [[probability(component == kind * n + joint) for joint in range(n)] for kind in kinds]
    return ScoreTests(np.array(single), np.array([probability(component // n == kind) for kind in kinds]))


def point_optimal_weights(sizes: FloatArray) -> FloatArray:
    """Weights (k,) of squared normal variates whose variances are ``1 + v sizes`` (k,), by which their sum tells best a
    variance ``v`` that it barely shows: by ``SHOWN`` of the sum's standard deviations at ``v`` = 0.
    """
    if not len(sizes):
        return sizes

    def shown(log_v: float) -> float:
        v = float(np.exp(log_v))
        weights = v * sizes / (1.0 + v * sizes)
        return float(v * (weights @ sizes)) - SHOWN * float(np.sqrt(2.0 * (weights @ weights)))

    about = -float(np.log(sizes.mean()))
    v = float(np.exp(brentq(shown, about - 20.0, about + 20.0, xtol=1e-3)))
    return np.asarray(v * sizes / (1.0 + v * sizes))


def weighted_chi2_tail(value: float, weights: FloatArray) -> float:
    """Probability that a sum of independent chi-squares of one freedom, of ``weights`` (k,), exceeds ``value``; 1 where
    no weight is above zero.
    """
    largest = float(weights.max(initial=0.0))
    if largest <= 0.0:
        return 1.0
    w = weights[weights > NEGLIGIBLE * largest] / largest
    q = value / largest
    if q <= 0.0:
        return 1.0

    def excess(z: float) -> float:
        return float((w / (1.0 - 2.0 * z * w)).sum()) - q

    # The slope of the cumulant function grows from 0 to infinity up to 1/2.
    z = float(brentq(excess, -0.5 * len(w) / q - 1.0, 0.5 * (1.0 - 1.0 / (2.0 * q + 2.0 * len(w)))))
    cumulant = -0.5 * float(np.log1p(-2.0 * z * w).sum())
    curvature = float((2.0 * (w / (1.0 - 2.0 * z * w)) ** 2).sum())
    if abs(z) * np.sqrt(curvature) < 1e-4:
        # At the mean the tail's formula is 0 over 0; its limit has the skewness.
        third = float((8.0 * w**3).sum())
        return float(0.5 - third / (6.0 * np.sqrt(2.0 * np.pi) * curvature**1.5))
    root = np.sign(z) * np.sqrt(2.0 * (z * q - cumulant))
    return float(norm.sf(root + np.log(z * np.sqrt(curvature) / root) / root))
