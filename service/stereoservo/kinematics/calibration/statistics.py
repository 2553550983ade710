"""Statistics of a solved bundle: variance factor, chi-square, rank, covariances."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.kinematics.calibration.bundle import Measurements, Solution
from stereoservo.kinematics.calibration.normal_equations import leverages

FloatArray = npt.NDArray[np.float64]

CHI2_TAIL = 0.0005
"""Probability of each tail outside the two-sided 99.9 % interval."""
RANK_TOLERANCE = 1e-9
"""Singular value of the column-normalised Jacobian, relative to the largest, below which a direction is
not known.
"""


def degrees_of_freedom(solution: Solution) -> int:
    """Measurements, lens priors among them, minus parameters net of gauge."""
    return solution.rows - solution.charts.size


def variance_factor(solution: Solution) -> float:
    """Estimated over stated variance of the pixels."""
    return solution.cost / max(1, degrees_of_freedom(solution))


def chi2_within(chi2: float, freedom: int) -> bool:
    """Whether ``chi2`` lies inside the two-sided 99.9 % interval of ``freedom`` degrees of freedom."""
    low = float(chi2_distribution.ppf(CHI2_TAIL, freedom))
    high = float(chi2_distribution.isf(CHI2_TAIL, freedom))
    return bool(low <= chi2 <= high)


def rank_of(solution: Solution) -> int:
    """How many parameter directions the data determine."""
    values = np.linalg.svd(solution.triangle / solution.sizes, compute_uv=False)
    return int((values > RANK_TOLERANCE * values[0]).sum())


def covariance_root(solution: Solution) -> FloatArray:
    """``R⁻¹`` (p, p) with ``R⁻¹ R⁻ᵀ = (Jᵀ J)⁻¹``: the parameters' covariance at the stated sigmas, as a
    root.
    """
    return np.asarray(np.linalg.inv(solution.triangle / solution.sizes) / solution.sizes[:, None])


def prediction_deviations(solution: Solution, offsets: FloatArray) -> FloatArray:
    """Standard deviation (c, s, m) [px, rms of the two coordinates] of pixels predicted at ``offsets`` (s,
    n).

    ``J Cov Jᵀ`` with the larger of the stated and the estimated noise.
    """
    c, s, m = len(solution.rig.cameras), len(offsets), len(solution.rig.points)
    camera, stop, marker = (index.ravel() for index in np.indices((c, s, m)))
    k = len(camera)
    grid = Measurements(offsets, camera, stop, marker, np.zeros((k, 2)), np.ones(k))
    variances = leverages(solution.rig, solution.charts, grid, covariance_root(solution)) / 2
    return np.sqrt(variances * max(1.0, variance_factor(solution))).reshape(c, s, m)


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
