"""Bundle adjustment of joint generators, cameras, lenses and markers in any stratum (projective, affine, metric) by
Levenberg-Marquardt (thesis 5.53, 5.55 to 5.57).

The model and its residuals are in `rig_model`, its normal equations in `normal_equations`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from stereoservo.calibration.joint_errors.joint_noise import (
    StopEquations,
    StopFactor,
    exact_fit_factor,
    orthogonal_factor,
    stop_equations,
)
from stereoservo.calibration.normal_equations import (
    ArrowFactor,
    NormalEquations,
    Weights,
    by_stop,
    chunks,
    normal_equations,
    prior_rows,
)
from stereoservo.calibration.rig_model import (
    Charts,
    JointErrors,
    JointNoise,
    Measurements,
    RigModel,
    full_charts,
    residuals,
    rig_at,
)
from stereoservo.kinematics.model import Stratum
from stereoservo.kinematics.parameterization import LensModel, conjugation
from stereoservo.numerics.arrays import FloatArray

GRADIENT = 1e-6
"""Largest entry of the gradient on unit columns at which a bundle has converged: it moves no parameter by a notable
part of its deviation."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-14, 1e10
"""Levenberg-Marquardt: added to the diagonal of ones."""
FREE_DAMPING = 1e-2
"""Damping up to which a step's predicted decrease estimates the distance to the minimum."""


class RobustLoss(NamedTuple):
    """Loss by iteratively re-weighted least squares, in which residuals beyond ``scale`` [sigmas] count less."""

    kind: Literal["soft_l1", "cauchy"]
    scale: float = 1.0


@dataclass(frozen=True)
class Solution:
    """Result of a bundle adjustment of ``data``, with the minimal ``charts`` at its ``rig``.

    ``cost``: sum of squared weighted residuals, those of lens priors and errors of joints included; ``residuals``
    (2 k,) of the pixels alone. ``data`` includes the estimated errors of the joints, where these have noise.
    ``stated_factor``: of the parameters' covariance, where it is not that of the rows.
    """

    rig: RigModel
    data: Measurements
    charts: Charts
    stratum: Stratum
    lenses: LensModel
    cost: float
    residuals: FloatArray
    rows: int
    converged: bool
    evaluations: int
    stated_factor: StopFactor | None = None

    @cached_property
    def lens_factor(self) -> ArrowFactor | StopFactor:
        """Orthogonal factor of the Jacobian in which at least the radial parameters of the lenses are free."""
        lenses: LensModel = "radial" if self.lenses == "none" else self.lenses
        free = full_charts(self.rig, self.stratum, cameras=False, points=False, lenses=lenses).lenses
        return orthogonal_factor(self.rig, replace(self.charts, lenses=free), self.data)

    @cached_property
    def factor(self) -> ArrowFactor | StopFactor:
        """Orthogonal factor of the Jacobian by the parameters, or the one stated."""
        if self.stated_factor is not None:
            return self.stated_factor
        fixed = len(self.rig.lenses) if self.lenses == "none" else 0
        return self.lens_factor.without(self.charts.start(2) + np.arange(fixed))

    @cached_property
    def triangle(self) -> FloatArray:
        """Root (p, p) of the normal matrix, ``triangleᵀ triangle = Jᵀ J``, to the accuracy of QR; triangular where
        markers come first.
        """
        return self.factor.dense()[:-1, :-1]

    @cached_property
    def sizes(self) -> FloatArray:
        """Lengths (p,) of the Jacobian's columns; 1 where a column is zero."""
        sizes = np.linalg.norm(self.triangle, axis=0)
        return np.where(sizes > 0.0, sizes, 1.0)


def with_joint_errors_stated(solution: Solution, noise: JointNoise) -> Solution:
    """The solution, of exact joint readings, with the covariance that its parameters have where the readings have this
    ``noise``.
    """
    data = solution.data.with_joint_noise(noise)
    factor = exact_fit_factor(solution.rig, solution.charts, data, solution.triangle)
    return replace(solution, stated_factor=factor)


def jacobian(rig: RigModel, charts: Charts, x: FloatArray, data: Measurements) -> FloatArray:
    """Derivative (2 k, p) of ``residuals(moved(rig, charts, x), data)`` by ``x``, dense, all at once."""
    motions, at = [], 0
    for basis in charts.generators:
        motions.append(conjugation(basis, x[at : at + len(basis)])[1])
        at += len(basis)
    here = replace(charts, generators=tuple(motions))
    ordered, order = by_stop(data)
    out = np.empty((len(order), 2, charts.size))
    for part, rows in chunks(rig_at(rig, charts, x), here, ordered):
        out[order[part]] = rows.dense(len(rig.points))[:, :-1].reshape(-1, 2, charts.size)
    return out.reshape(2 * len(order), charts.size)


def solve(
    rig: RigModel,
    data: Measurements,
    stratum: Stratum,
    *,
    generators: bool = True,
    cameras: bool = True,
    points: bool = True,
    lenses: LensModel = "none",
    loss: RobustLoss | None = None,
    max_evaluations: int = 100,
    tolerance: float = 1e-10,
) -> Solution:
    """Least-squares bundle over the minimal charts of ``stratum`` by Levenberg-Marquardt, re-linearised at every
    step.

    Columns are scaled to unit length. ``loss``: None for plain least squares. ``tolerance``: decrease, relative to the
    cost, below which nothing is left to gain. Raises LinAlgError where the start has no finite residuals. Never raises
    on a bad fit: look at ``converged`` and ``cost``. Where the joints have noise, their errors are estimated with the
    parameters, from ``data``'s on.
    """
    ordered, _ = by_stop(data)
    weights = _weights(loss)

    def charts_at(rig: RigModel) -> Charts:
        return full_charts(rig, stratum, generators=generators, cameras=cameras, points=points, lenses=lenses)

    def cost_at(rig: RigModel, charts: Charts, here: Measurements) -> float:
        pixels = _loss(residuals(rig, here), loss) + _cost_of_errors(here)
        return pixels + float((prior_rows(rig, charts, data)[:, -1] ** 2).sum())

    charts = charts_at(rig)
    cost = cost_at(rig, charts, ordered)
    if not np.isfinite(cost):
        raise np.linalg.LinAlgError("points at infinity or in a focal plane at the start of a bundle")
    damping, evaluations, converged, exhausted = FIRST_DAMPING, 1, False, False
    while not (converged or exhausted):
        equations = _equations(rig, charts, ordered, weights)
        if float(np.abs(equations.gradient).max(initial=0.0)) <= GRADIENT:
            converged = True
            break
        while True:
            if evaluations >= max_evaluations or damping > MOST_DAMPING:
                exhausted = True
                break
            try:
                x, expected = equations.step(damping)
            except np.linalg.LinAlgError:
                damping = max(10.0 * damping, 1e-12)
                continue
            trial, there = rig_at(rig, charts, x), ordered.corrected(_errors(equations, x))
            evaluations += 1
            least = cost_at(trial, charts, there)
            gain = (cost - least) / expected if expected > 0.0 else 0.0
            converged = damping <= FREE_DAMPING and expected <= tolerance * cost
            if gain > 1e-3:
                rig, cost, ordered = trial, least, there
                charts = charts_at(rig)
                damping = max(damping * (0.03 if gain > 0.75 else 0.3 if gain > 0.25 else 2.0), LEAST_DAMPING)
                break
            if converged:
                break
            damping = 10.0 * max(damping, 1e-12)
    data = data.corrected(ordered.joint_errors)
    error = residuals(rig, data)
    prior = prior_rows(rig, charts, data)[:, -1]
    return Solution(
        rig,
        data,
        charts,
        stratum,
        lenses,
        float(error @ error + prior @ prior) + _cost_of_errors(data),
        error,
        len(error) + len(prior),
        converged,
        evaluations,
    )


def _equations(
    rig: RigModel, charts: Charts, data: Measurements, weights: Weights | None
) -> NormalEquations | StopEquations:
    if data.joint_noise is None:
        return normal_equations(rig, charts, data, weights)
    return stop_equations(rig, charts, data, weights)


def _errors(equations: NormalEquations | StopEquations, x: FloatArray) -> JointErrors | None:
    return equations.errors(x) if isinstance(equations, StopEquations) else None


def _cost_of_errors(data: Measurements) -> float:
    return 0.0 if data.joint_errors is None else data.joint_errors.cost


def _loss(error: FloatArray, loss: RobustLoss | None) -> float:
    """``Σ s² ρ(e²/s²)`` of residuals (2 k,)."""
    if loss is None:
        return float(error @ error)
    kind, scale = loss
    square = (error / scale) ** 2
    if kind == "soft_l1":
        return float(2.0 * scale**2 * (np.sqrt(1.0 + square) - 1.0).sum())
    return float(scale**2 * np.log1p(square).sum())


def _weights(loss: RobustLoss | None) -> Weights | None:
    """IRLS weights ``ρ'(e²/s²)`` of squared residuals; None for plain least squares."""
    if loss is None:
        return None
    kind, scale = loss
    if kind == "soft_l1":
        return lambda square: np.asarray(1.0 / np.sqrt(1.0 + square / scale**2))
    return lambda square: np.asarray(1.0 / (1.0 + square / scale**2))
