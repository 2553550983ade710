"""Statistics of a solved bundle adjustment: variance factor, chi-square, rank, covariances of parameters and
predictions, residual rms of groups of pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.bundle_adjustment import Solution
from stereoservo.calibration.joint_errors.joint_noise import (
    expected_squares,
    joint_columns,
    prediction_leverages,
)
from stereoservo.calibration.rig_model import Measurements, predicted
from stereoservo.numerics.arrays import FloatArray

CHI2_TAIL = 0.0005
"""Probability of each tail outside the two-sided 99.9 % interval."""
OVERSTATED = 1.1
"""Sigmas that are stated so many times too large are no misfit: deviations are too large by as much, at most."""
RANK_TOLERANCE = 1e-9
"""Singular value of the column-normalised Jacobian, relative to the largest, below which a direction is
not known.
"""


def degrees_of_freedom(solution: Solution) -> int:
    """Measurements, lens priors among them, minus parameters net of gauge."""
    return solution.rows - solution.charts.size


def variance_factor(solution: Solution) -> float:
    """Variance factor of the fit: estimated over stated variance of the pixels."""
    return solution.cost / max(1, degrees_of_freedom(solution))


def chi2_within(chi2: float, freedom: int) -> bool:
    """Whether ``chi2`` lies inside the two-sided 99.9 % interval of ``freedom`` degrees of freedom, for sigmas that are
    as stated or up to `OVERSTATED` times smaller.
    """
    low = float(chi2_distribution.ppf(CHI2_TAIL, freedom)) / OVERSTATED**2
    high = float(chi2_distribution.isf(CHI2_TAIL, freedom))
    return bool(low <= chi2 <= high)


def rank_of(solution: Solution) -> int:
    """Number of parameter directions that the data determine."""
    values = np.linalg.svd(solution.triangle / solution.sizes, compute_uv=False)
    return int((values > RANK_TOLERANCE * values[0]).sum())


def covariance_root(solution: Solution) -> FloatArray:
    """``R⁻¹`` (p, p) with ``R⁻¹ R⁻ᵀ = (Jᵀ J)⁻¹``: the parameters' covariance at the stated sigmas, as a
    root.
    """
    return np.asarray(np.linalg.inv(solution.triangle / solution.sizes) / solution.sizes[:, None])


def noise_factor(solution: Solution) -> float:
    """Factor on variances: the variance factor where residuals significantly exceed the stated sigmas, else 1."""
    factor = variance_factor(solution)
    return factor if factor > 1.0 and not chi2_within(solution.cost, degrees_of_freedom(solution)) else 1.0


def parameter_covariance(solution: Solution) -> FloatArray:
    """Covariance (p, p) of the chart coordinates at the larger of the stated and the estimated noise."""
    root = covariance_root(solution)
    return np.asarray(root @ root.T * noise_factor(solution))


def prediction_variances(solution: Solution, offsets: FloatArray) -> FloatArray:
    """Variance (c, s, m) [px², of both coordinates together] of pixels predicted at ``offsets`` (s, n), ``J Cov Jᵀ``
    at the stated sigmas; NaN where the lens images nothing.
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
    """Variance (c, s, m, n) [px², of both coordinates together] that a unit variance of each joint's reading gives
    pixels predicted at ``offsets`` (s, n); NaN where the lens images nothing.
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
    """Residual rms [px] of some pixels, its expected value ``σ √(1 - trace(H_g)/n_g)`` at the stated sigmas, and its
    standard error about that.
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
    # Of Gaussian residuals r = (I - H) e: var(rᵀr) <= 2 σ⁴ trace(I - H_g).
    deviation = float(np.sqrt(2.0 * (sigmas**4 * left).sum())) / n
    error = 0.5 * deviation / np.sqrt(expected) if expected > 0.0 else 0.0
    return GroupRms(float(np.sqrt(squares.mean())), float(np.sqrt(expected)), float(error))


def generator_noise(solution: Solution) -> FloatArray:
    """Standard deviation (n,) of the entries of each generator, rms, from the bundle's covariance."""
    p = solution.charts.size
    # Directions that the data leave open get a large finite variance instead of none.
    unit = solution.triangle / solution.sizes
    bounded = np.linalg.qr(np.vstack([unit, np.sqrt(1e-13) * np.eye(p)]), mode="r")
    root = np.linalg.inv(bounded) / solution.sizes[:, None]
    at, result = 0, []
    for generator, basis in zip(solution.rig.generators, solution.charts.generators, strict=True):
        changes = (basis @ generator - generator @ basis).reshape(len(basis), 16)
        result.append(((changes.T @ root[at : at + len(basis)]) ** 2).sum() / 16)
        at += len(basis)
    return np.sqrt(np.array(result) * max(1.0, variance_factor(solution)))
