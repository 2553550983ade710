"""Recognition of chains with closed-form inverse kinematics by chi-square tests: parallel axes, axes through a common
point, prismatic joints (thesis 6.3 to 6.7).

A calibrated chain fulfils such conditions only within its covariance. Each condition is a set of vanishing incidences,
which are tested by chi-square against the covariance propagated to them. A small deviation that the calibration cannot
distinguish from zero is harmless: the closed form is then the start of a refinement on the actual chain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import propagate_covariance
from stereoservo.kinematics.inverse.solutions import Case
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

TAIL = 1e-4
"""Probability that a valid condition fails the test by chance."""
EXACT = 1e-6
"""Largest accepted deviation of a chain, or of a model without a covariance."""
COARSEST = 0.05
"""Largest deviation that may be explained by the calibration's noise."""
PARALLEL_FREEDOM = 2
"""Number of conditions for two equal directions, if both lie in the plane that all joints leave invariant."""

Condition = Literal["parallel", "common_point", "independent"]
Test = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Evidence:
    """Test result of a condition on joints (counted from the base).

    ``deviation``: sine, in the model's frame, of the deviation from the exact condition. ``chi2`` of ``freedom``
    conditions, at most ``threshold`` if the condition holds. None without a covariance, where ``deviation`` is compared
    with `EXACT`, and above `COARSEST`.
    """

    condition: Condition
    joints: tuple[int, ...]
    holds: bool
    deviation: float
    chi2: float | None = None
    freedom: int | None = None
    threshold: float | None = None


@dataclass(frozen=True)
class Recognition:
    """Structure ``case`` of a chain. ``inverted``: the structure of its factors in reverse order, that is, for the
    inverse displacement.
    """

    case: Case
    inverted: bool
    evidence: tuple[Evidence, ...]


def parallel_incidence(first: FloatArray, second: FloatArray) -> Test:
    """Test function (4,) of a pair of operators (2, 4, 4), linearised at ``first``, ``second`` (4, 4).

    Zero if both move points in the same directions: the projection onto the first's axis maps the range of the second
    to zero.
    """
    along = np.linalg.svd(first)[2][2:]
    across = np.linalg.svd(second)[0][:, :2]

    def values(operators: FloatArray) -> FloatArray:
        G, other = operators
        onto_axis = np.eye(4) + G @ G
        return np.asarray((along @ onto_axis @ (other @ other) @ across).ravel(), dtype=np.float64)

    return values


def common_point_incidence(operators: FloatArray) -> Test:
    """Test function of operators (k, 4, 4), linearised at those given: zero if one point lies on all axes.

    Uses the least singular vector of the stacked operators: the part of its motion that no change of the point
    compensates.
    """
    sizes = np.linalg.norm(operators, axis=(1, 2), keepdims=True)
    U, _, rows = np.linalg.svd((operators / sizes).reshape(-1, 4))
    point, left = rows[3], U[:, 3:]

    def values(moved: FloatArray) -> FloatArray:
        return np.asarray(left.T @ ((moved / sizes).reshape(-1, 4) @ point), dtype=np.float64)

    return values


class _ConditionTest:
    """Tests conditions on one chain, with cached results."""

    def __init__(self, chain: ProjectiveChain, model: CellModel | None) -> None:
        self.chain = chain
        self.model = model if model is not None and model.covariance is not None else None
        self.evidence: dict[tuple[str, tuple[int, ...]], Evidence] = {}

    def parallel(self, *joints: int) -> bool:
        first, second = self.chain.generators[list(joints)]
        return self._holds("parallel", joints, parallel_incidence(first, second), PARALLEL_FREEDOM)

    def common_point(self, *joints: int) -> bool:
        test = common_point_incidence(self.chain.generators[list(joints)])
        # Two conditions for each axis through a point, minus the three coordinates of the point.
        return self._holds("common_point", joints, test, 2 * len(joints) - 3)

    def spherical(self, *joints: int) -> bool:
        # Parallel axes intersect, too, in the invariant plane.
        meet = self.common_point(*joints)
        return meet and not (self.parallel(*joints[:2]) or self.parallel(*joints[1:]))

    def independent(self, *joints: int) -> bool:
        unit = [G.ravel() / np.linalg.norm(G) for G in self.chain.generators[list(joints)]]
        least = float(np.linalg.svd(np.array(unit), compute_uv=False)[-1])
        self.evidence["independent", joints] = Evidence("independent", joints, least > EXACT, least)
        return least > EXACT

    def _holds(self, condition: Condition, joints: tuple[int, ...], test: Test, freedom: int) -> bool:
        known = self.evidence.get((condition, joints))
        if known is None:
            known = self._tested(condition, joints, test, freedom)
            self.evidence[condition, joints] = known
        return known.holds

    def _tested(self, condition: Condition, joints: tuple[int, ...], test: Test, freedom: int) -> Evidence:
        chosen = list(joints)
        deviation = float(np.linalg.norm(test(self.chain.generators[chosen])))
        if self.model is None or deviation > COARSEST:
            return Evidence(condition, joints, deviation <= EXACT, deviation)
        values, covariance = propagate_covariance(self.model, lambda model: test(model.generators[chosen]))
        # More incidences than conditions: the additional ones vary only in second order.
        variances, vectors = np.linalg.eigh(covariance)
        variances, vectors = variances[-freedom:], vectors[:, -freedom:]
        statistic = float(((vectors.T @ values) ** 2 / variances).sum())
        threshold = float(chi2_distribution.isf(TAIL, freedom))
        return Evidence(condition, joints, statistic <= threshold, deviation, statistic, freedom, threshold)


def recognise(arm: ProjectiveChain | CellModel) -> Recognition:
    """Structure of a chain, or of a calibrated model, whose covariance then sets the tolerance of each condition.

    Conditions are incidences of operators, in any stratum. ``numerical`` if no closed form applies.
    """
    model = arm if isinstance(arm, CellModel) else None
    chain = chain_of(arm)
    judge = _ConditionTest(chain, model)
    order = chain.order
    for inverted, joints in ((False, order), (True, order[::-1])):
        case = _case(judge, chain.kinds, joints)
        # Single points do not determine the inverse displacement; short chains are the same in both orders.
        if case is not None and not (inverted and case in ("two_revolute", "two_parallel", "wrist")):
            return Recognition(case, inverted, tuple(judge.evidence.values()))
    return Recognition("numerical", False, tuple(judge.evidence.values()))


def check_condition(arm: ProjectiveChain | CellModel, condition: Condition, joints: tuple[int, ...]) -> Evidence:
    """One condition on revolute ``joints``: two ``parallel``, two or more with a ``common_point``, or prismatic ones
    that are ``independent``.
    """
    judge = _ConditionTest(chain_of(arm), arm if isinstance(arm, CellModel) else None)
    {"parallel": judge.parallel, "common_point": judge.common_point, "independent": judge.independent}[condition](
        *joints
    )
    return judge.evidence[condition, joints]


def structure(arm: ProjectiveChain | CellModel) -> tuple[Evidence, ...]:
    """Conditions that hold for adjacent revolute axes, from the base on: two that are parallel or intersect, three that
    intersect in one point, which replace the pairs that they contain.
    """
    chain = chain_of(arm)
    revolute = [j for j in chain.order if chain.kinds[j] == "revolute"]
    pairs = list(pairwise(revolute))
    parallel = [check_condition(arm, "parallel", pair) for pair in pairs]
    alike = {tested.joints for tested in parallel if tested.holds}
    triples = [
        three for three in zip(revolute, revolute[1:], revolute[2:], strict=False) if not {three[:2], three[1:]} & alike
    ]
    through = [tested for three in triples if (tested := check_condition(arm, "common_point", three)).holds]
    tested_pairs = {pair for tested in through for pair in pairwise(tested.joints)}
    met = [check_condition(arm, "common_point", pair) for pair in pairs if pair not in alike | tested_pairs]
    return tuple(tested for tested in (*parallel, *through, *met) if tested.holds)


def chain_of(arm: ProjectiveChain | CellModel) -> ProjectiveChain:
    """The chain of a model."""
    if isinstance(arm, ProjectiveChain):
        return arm
    return ProjectiveChain(arm.joint_kinds, arm.generators, arm.zero, arm.tip_first)


def _case(judge: _ConditionTest, kinds: tuple[str, ...], joints: tuple[int, ...]) -> Case | None:
    letters = "".join(kinds[j][0] for j in joints)
    if letters in ("p", "pp", "ppp"):
        return "prismatic" if judge.independent(*joints) else None
    if letters == "r":
        return "revolute"
    if letters == "rr":
        return "two_parallel" if judge.parallel(*joints) else "two_revolute"
    if letters == "rrr":
        if _is_arm(judge, joints):
            return "arm"
        return "wrist" if judge.spherical(*joints) else None
    if letters == "rrrrrr" and _is_arm(judge, joints[:3]) and judge.spherical(*joints[3:]):
        return "arm_with_wrist"
    if letters == "ppprrr" and judge.independent(*joints[:3]) and judge.spherical(*joints[3:]):
        return "gantry_with_wrist"
    return None


def _is_arm(judge: _ConditionTest, joints: tuple[int, ...]) -> bool:
    """Whether the second and third axis are parallel and the first is normal to them."""
    return judge.parallel(*joints[1:]) and not judge.parallel(*joints[:2])
