"""Statistics of a solved bundle: variance factor, chi-square, rank, covariances."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.kinematics.calibration.bundle import Measurements, Solution, jacobian

FloatArray = npt.NDArray[np.float64]

CHI2_TAIL = 0.0005
"""Probability of each tail outside the two-sided 99.9 % interval."""
RANK_TOLERANCE = 1e-9
"""Singular value of the column-normalised Jacobian, relative to the largest, below which a direction is
not known.
"""


def degrees_of_freedom(solution: Solution) -> int:
    """Measurements minus parameters net of gauge."""
    return len(solution.residuals) - solution.charts.size


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
    size = np.linalg.norm(solution.jacobian, axis=0)
    if solution.jacobian.shape[0] < solution.jacobian.shape[1] or not (size > 0).all():
        return int((size > 0).sum()) if solution.jacobian.shape[0] >= solution.jacobian.shape[1] else 0
    values = np.linalg.svd(np.linalg.qr(solution.jacobian / size, mode="r"), compute_uv=False)
    return int((values > RANK_TOLERANCE * values[0]).sum())


def covariance_root(solution: Solution) -> FloatArray:
    """``R⁻¹`` (p, p) with ``R⁻¹ R⁻ᵀ = (Jᵀ J)⁻¹``: the parameters' covariance at the stated sigmas, as a
    root.
    """
    size = np.linalg.norm(solution.jacobian, axis=0)
    triangle = np.linalg.qr(solution.jacobian / size, mode="r")
    root: FloatArray = np.linalg.inv(triangle) / size[:, None]
    return root


def prediction_deviations(solution: Solution, offsets: FloatArray) -> FloatArray:
    """Standard deviation (c, s, m) [px, rms of the two coordinates] of pixels predicted at ``offsets`` (s,
    n).

    ``J Cov Jᵀ`` with the larger of the stated and the estimated noise.
    """
    c, s, m = len(solution.rig.cameras), len(offsets), len(solution.rig.points)
    camera, stop, marker = (index.ravel() for index in np.indices((c, s, m)))
    k = len(camera)
    grid = Measurements(offsets, camera, stop, marker, np.zeros((k, 2)), np.ones(k))
    slopes = jacobian(solution.rig, solution.charts, np.zeros(solution.charts.size), grid) @ covariance_root(
        solution
    )
    variances = (slopes.reshape(k, 2, -1) ** 2).sum(axis=(1, 2)) / 2 * max(1.0, variance_factor(solution))
    result: FloatArray = np.sqrt(variances).reshape(c, s, m)
    return result


def generator_noise(solution: Solution) -> FloatArray:
    """Standard deviation (n,) of the entries of each generator, rms, from the bundle's covariance."""
    scale = np.linalg.norm(solution.jacobian, axis=0)
    scale[scale == 0] = 1.0
    information = solution.jacobian.T @ solution.jacobian / np.outer(scale, scale)
    # Directions that the data leave open get a large finite variance instead of none.
    covariance = np.linalg.inv(information + 1e-13 * np.eye(len(scale))) / np.outer(scale, scale)
    at, result = 0, []
    for generator, basis in zip(solution.rig.generators, solution.charts.generators, strict=True):
        p = len(basis)
        changes = (basis @ generator - generator @ basis).reshape(p, 16)
        result.append(np.einsum("pa,pq,qa->", changes, covariance[at : at + p, at : at + p], changes) / 16)
        at += p
    return np.sqrt(np.array(result) * max(1.0, variance_factor(solution)))
