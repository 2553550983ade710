"""Bundle adjustment of joint generators, cameras, lenses and markers in any stratum (projective, affine, metric) by
Levenberg-Marquardt (thesis 5.53, 5.55 to 5.57), and statistics of its predictions.

The model and its residuals are in `rig_model`, its rows in `normal_equations`, the solver in `least_squares`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from stereoservo.calibration.joint_noise import (
    StopEquations,
    StopFactor,
    exact_fit_factor,
    expected_squares,
    joint_columns,
    orthogonal_factor,
    prediction_leverages,
    stop_equations,
)
from stereoservo.calibration.least_squares import (
    EstimationStatistics,
    Limits,
    NormalEquations,
    RobustLoss,
    column_root,
    minimise,
)
from stereoservo.calibration.normal_equations import (
    ArrowFactor,
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
    predicted,
    residuals,
    rig_at,
)
from stereoservo.kinematics.model import Stratum
from stereoservo.kinematics.parameterization import LensModel, conjugation
from stereoservo.numerics.arrays import FloatArray


@dataclass(frozen=True)
class Solution:
    """Result of a bundle adjustment of ``data``, with the minimal ``charts`` at its ``rig``.

    ``cost``: sum of squared weighted residuals, including lens priors and errors of joints; ``residuals``
    (2 k,) of the pixels alone. ``data`` includes the estimated joint errors, if the joints have noise.
    ``stated_factor``: factor of the parameters' covariance, if it is not that of the rows.
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
        """Orthogonal factor of the Jacobian with at least the radial parameters of the lenses free."""
        lenses: LensModel = "radial" if self.lenses == "none" else self.lenses
        free = full_charts(self.rig, self.stratum, cameras=False, points=False, lenses=lenses).lenses
        return orthogonal_factor(self.rig, replace(self.charts, lenses=free), self.data)

    @cached_property
    def factor(self) -> ArrowFactor | StopFactor:
        """Orthogonal factor of the Jacobian by the parameters, or the stated one."""
        if self.stated_factor is not None:
            return self.stated_factor
        fixed = len(self.rig.lenses) if self.lenses == "none" else 0
        return self.lens_factor.without(self.charts.start(2) + np.arange(fixed))

    @cached_property
    def statistics(self) -> EstimationStatistics:
        """Statistics of the fit: degrees of freedom, variance, rank and covariance of the parameters."""
        return EstimationStatistics(self.cost, self.rows, self.charts.size, lambda: self.factor.dense()[:-1, :-1])


def with_joint_error_covariance(solution: Solution, noise: JointNoise) -> Solution:
    """The solution (fitted with exact joint readings) with the covariance of its parameters under joint ``noise``."""
    data = solution.data.with_joint_noise(noise)
    factor = exact_fit_factor(solution.rig, solution.charts, data, solution.statistics.triangle)
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


class _State:
    """State of the fit: a rig, sorted measurements with the errors of their joints, the charts at the rig, and the
    charts from which the last step was made.
    """

    def __init__(self, bundle: _Bundle, rig: RigModel, data: Measurements, before: Charts) -> None:
        self.bundle, self.rig, self.data, self.before = bundle, rig, data, before

    @cached_property
    def charts(self) -> Charts:
        return self.bundle.charts_at(self.rig)


@dataclass(frozen=True)
class _Bundle:
    """The bundle as a `Fit`: its free parts and its loss."""

    stratum: Stratum
    generators: bool
    cameras: bool
    points: bool
    lenses: LensModel
    loss: RobustLoss | None

    def charts_at(self, rig: RigModel) -> Charts:
        return full_charts(
            rig, self.stratum, generators=self.generators, cameras=self.cameras, points=self.points, lenses=self.lenses
        )

    def cost(self, state: _State) -> float:
        squares = residuals(state.rig, state.data) ** 2
        pixels = float(squares.sum()) if self.loss is None else self.loss.cost(squares)
        prior = prior_rows(state.rig, state.before, state.data)[:, -1]
        return pixels + _cost_of_errors(state.data) + float(prior @ prior)

    def equations(self, state: _State) -> NormalEquations | StopEquations:
        weights = None if self.loss is None else self.loss.weights
        make = normal_equations if state.data.joint_noise is None else stop_equations
        return make(state.rig, state.charts, state.data, weights)

    def retract(self, state: _State, x: FloatArray) -> _State:
        """The parameters of the charts are followed by the shared errors of stops, and each stop's own."""
        p, data = state.charts.size, state.data
        if data.joint_noise is not None:
            own = p + data.joint_noise.common
            data = data.corrected(JointErrors(x[own:].reshape(data.offsets.shape), x[p:own]))
        return _State(self, rig_at(state.rig, state.charts, x[:p]), data, state.charts)


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

    Columns are scaled to unit length. ``loss``: None for plain least squares. ``tolerance``: relative decrease of the
    cost at which the fit has converged. Raises LinAlgError if the residuals at the start are not finite. Never raises
    on a bad fit: check ``converged`` and ``cost``. If the joints have noise, their errors are estimated with the
    parameters, starting from those in ``data``.
    """
    bundle = _Bundle(stratum, generators, cameras, points, lenses, loss)
    start = _State(bundle, rig, by_stop(data)[0], bundle.charts_at(rig))
    found = minimise(bundle, start, Limits(max_evaluations, tolerance))
    if not np.isfinite(found.cost):
        raise np.linalg.LinAlgError("points at infinity or in a focal plane at the start of a bundle")
    rig, charts = found.state.rig, found.state.charts
    data = data.corrected(found.state.data.joint_errors)
    error = residuals(rig, data)
    prior = prior_rows(rig, charts, data)[:, -1]
    cost = float(error @ error + prior @ prior) + _cost_of_errors(data)
    rows = len(error) + len(prior)
    return Solution(rig, data, charts, stratum, lenses, cost, error, rows, found.converged, found.evaluations)


def _cost_of_errors(data: Measurements) -> float:
    return 0.0 if data.joint_errors is None else data.joint_errors.cost


# -- predictions ------------------------------------------------------------------------------------------------


def prediction_variances(solution: Solution, offsets: FloatArray) -> FloatArray:
    """Variance (c, s, m) [px², sum of both coordinates] of pixels predicted at ``offsets`` (s, n), ``J Cov Jᵀ``
    at the stated sigmas; NaN where the lens has no image of the point.
    """
    c, s, m = len(solution.rig.cameras), len(offsets), len(solution.rig.points)
    grid = _grid(solution, offsets)
    variances = prediction_leverages(solution.rig, solution.charts, grid, solution.factor)
    seen = np.isfinite(predicted(solution.rig, grid)).all(axis=1)
    return np.where(seen, variances, np.nan).reshape(c, s, m)


def _grid(solution: Solution, offsets: FloatArray) -> Measurements:
    """Every marker in every camera at ``offsets`` (s, n), with sigmas of 1 px."""
    shape = len(solution.rig.cameras), len(offsets), len(solution.rig.points)
    camera, stop, marker = (index.ravel() for index in np.indices(shape))
    k = len(camera)
    return Measurements(offsets, camera, stop, marker, np.zeros((k, 2)), np.ones(k))


def joint_variances(solution: Solution, offsets: FloatArray) -> FloatArray:
    """Variance (c, s, m, n) [px², sum of both coordinates] of pixels predicted at ``offsets`` (s, n) for a unit
    variance of each joint's reading; NaN where the lens has no image of the point.
    """
    grid = _grid(solution, offsets)
    slopes = joint_columns(solution.rig, grid).reshape(len(grid.camera), 2, -1)
    c, m = len(solution.rig.cameras), len(solution.rig.points)
    seen = np.asarray(np.isfinite(predicted(solution.rig, grid)).all(axis=1))
    return np.where(seen[:, None], (slopes**2).sum(axis=1), np.nan).reshape(c, len(offsets), m, -1)


def residual_expectations(solution: Solution) -> FloatArray:
    """Expected squared residual (k,) of each measurement of a bundle with joint noise [sigmas², both coordinates]."""
    return expected_squares(solution.rig, solution.charts, solution.data)


class GroupRms(NamedTuple):
    """Residual rms [px] of some pixels, its expected value ``σ √(1 - trace(H_g)/n_g)`` at the stated sigmas, and the
    standard error of the rms about it.
    """

    rms_px: float
    expected_px: float
    standard_error_px: float


def group_rms(squares: FloatArray, sigmas: FloatArray, variances: FloatArray) -> GroupRms:
    """Residual statistics of a group of pixels (k,), from squared residuals of the two coordinates [px²], sigmas
    [px], and the variance of their prediction [px², both coordinates].
    """
    n = 2 * len(squares)
    if not n:
        return GroupRms(0.0, 0.0, 0.0)
    left = np.maximum(2.0 - variances / sigmas**2, 0.0)
    expected = float((sigmas**2 * left).sum()) / n
    # For Gaussian residuals r = (I - H) e: var(rᵀr) <= 2 σ⁴ trace(I - H_g).
    deviation = float(np.sqrt(2.0 * (sigmas**4 * left).sum())) / n
    error = 0.5 * deviation / np.sqrt(expected) if expected > 0.0 else 0.0
    return GroupRms(float(np.sqrt(squares.mean())), float(np.sqrt(expected)), float(error))


def generator_noise(solution: Solution) -> FloatArray:
    """Rms standard deviation (n,) of the entries of each generator, from the bundle's covariance."""
    root = column_root(solution.statistics.triangle, bounded=True)
    at, result = 0, []
    for generator, basis in zip(solution.rig.generators, solution.charts.generators, strict=True):
        changes = (basis @ generator - generator @ basis).reshape(len(basis), 16)
        result.append(((changes.T @ root[at : at + len(basis)]) ** 2).sum() / 16)
        at += len(basis)
    return np.sqrt(np.array(result) * max(1.0, solution.statistics.variance))
