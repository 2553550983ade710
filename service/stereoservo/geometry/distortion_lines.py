"""Lens distortion from images of straight lines (plumb lines): a pinhole images every straight line straight.

Each line gives the pixels along one edge, wire or row of dots. The lens that makes all of them straight is found by
least squares over the lens alone: given the lens, each line's own two parameters follow in closed form and are
projected out of the Jacobian. Distances are measured where the noise is, in raw pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.distortion import distortion_jacobian, lens_jacobian, straight_lens, undistort
from stereoservo.geometry.errors import GeometryError

FloatArray = npt.NDArray[np.float64]

CENTRE_SHARE = 0.1
"""Standard deviation of the centre about the middle of the image, beforehand [image widths]: a weak distortion does
not show it."""
GRID = (-0.3, -0.2, -0.13, -0.08, -0.04, 0.0, 0.04, 0.08, 0.13)
"""Radial parameters at half the image width that are tried as starts."""
MOST_UNCERTAIN = 1.0
"""Standard deviation of the radial parameter above which the lines do not tell it."""
ITERATIONS = 60


class LensEstimate(NamedTuple):
    """``lens`` (4,), the covariance (3, 3) of its (k, cu, cv), and the fit's chi-square with its freedoms."""

    lens: FloatArray
    covariance: FloatArray
    chi2: float
    degrees_of_freedom: int


def lens_from_lines(lines: Sequence[FloatArray], sigma: float, width: int, height: int) -> LensEstimate:
    """The lens of a camera from raw pixels (n_i, 2) along straight lines, noise ``sigma`` [px] an axis.

    The centre is held by a weak prior (``CENTRE_SHARE``), which the covariance includes. The covariance is at the
    larger of the stated and the estimated noise. Raises GeometryError: ``shape``, ``too_few`` (three pixels a line,
    at least), ``not_finite``, ``degenerate`` where the lines do not tell the distortion (all of them through the
    middle, say), ``no_convergence``.
    """
    pixels, starts = _checked(lines, sigma)
    middle = straight_lens(width, height)
    weak = np.array([0.0, 1.0, 1.0]) / (CENTRE_SHARE * width)

    def errors_at(lens: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n + 3,) in sigmas, those of the prior last, and their Jacobian (n + 3, 3) by the lens."""
        error, slope = _projected(lens, pixels, starts, sigma)
        return np.append(error, weak * (lens[:3] - middle[:3])), np.vstack([slope, np.diag(weak)])

    def cost_at(lens: FloatArray) -> float:
        error = errors_at(lens)[0]
        return float(error @ error) if np.isfinite(error).all() else np.inf

    lens = min((np.append(k, middle[1:]) for k in GRID), key=cost_at)
    damping, cost = 1e-4, cost_at(lens)
    for _ in range(ITERATIONS):
        error, slope = errors_at(lens)
        sizes = np.linalg.norm(slope, axis=0)
        unit = slope / sizes
        step = -np.linalg.solve(unit.T @ unit + damping * np.eye(3), unit.T @ error)
        trial = lens + np.append(step / sizes, 0.0)
        least = cost_at(trial)
        near = float(np.linalg.norm(step)) < 1e-5
        if least < cost:
            lens, cost, damping = trial, least, 0.1 * damping
        else:
            damping *= 10.0
        if near:
            break
    else:
        raise GeometryError(
            "no_convergence", f"the lens did not settle in {ITERATIONS} steps; cost {cost:.4g}"
        )
    _, slope = errors_at(lens)
    freedom = len(pixels) - 2 * (len(starts) - 1) - 1
    covariance: FloatArray = np.asarray(np.linalg.inv(slope.T @ slope)) * max(1.0, cost / max(1, freedom))
    deviation = float(np.sqrt(covariance[0, 0]))
    if not deviation < MOST_UNCERTAIN:
        raise GeometryError(
            "degenerate",
            f"the lines leave the radial parameter open (standard deviation {deviation:.3g}); lines away from the "
            "middle of the image are needed",
            deviation=deviation,
        )
    return LensEstimate(lens, covariance, cost, freedom)


def _checked(lines: Sequence[FloatArray], sigma: float) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """All pixels (n, 2) and where each line starts (l + 1,)."""
    if not sigma > 0.0:
        raise GeometryError("shape", f"sigma is {sigma} px; it must be positive", sigma=sigma)
    if not len(lines):
        raise GeometryError("too_few", "no lines; at least one is needed", lines=0)
    arrays = [np.asarray(line, dtype=np.float64) for line in lines]
    for i, line in enumerate(arrays):
        if line.ndim != 2 or line.shape[1] != 2:
            raise GeometryError("shape", f"line {i} has shape {line.shape}; (n, 2) is needed", line=i)
        if len(line) < 3:
            raise GeometryError("too_few", f"line {i} has {len(line)} pixels; at least 3 are needed", line=i)
        if not np.isfinite(line).all():
            raise GeometryError("not_finite", f"line {i} has pixels that are not finite", line=i)
    return np.concatenate(arrays), np.cumsum([0, *(len(line) for line in arrays)])


def _projected(
    lens: FloatArray, pixels: FloatArray, starts: npt.NDArray[np.int64], sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) of raw pixels from the images of their best lines [sigmas], and their derivatives (n, 3) by
    (k, cu, cv) with the lines free to follow.
    """
    ideal = undistort(lens, pixels)
    if not np.isfinite(ideal).all():
        return np.full(len(pixels), np.inf), np.zeros((len(pixels), 3))
    to_ideal = np.linalg.inv(distortion_jacobian(lens, ideal))
    by_lens = -to_ideal @ lens_jacobian(lens, ideal)
    error, slope = np.empty(len(pixels)), np.empty((len(pixels), 3))
    for first, end in pairwise(starts):
        here = slice(first, end)
        normal, scale = np.zeros(2), np.full(end - first, sigma)
        for _ in range(2):  # the weights depend on the direction, weakly
            weights = 1.0 / scale**2
            middle = weights @ ideal[here] / weights.sum()
            offset = ideal[here] - middle
            normal = np.linalg.eigh(offset.T @ (offset * weights[:, None]))[1][:, 0]
            scale = sigma * np.linalg.norm(normal @ to_ideal[here], axis=1)
        error[here] = offset @ normal / scale
        along = np.array([-normal[1], normal[0]])
        own, _ = np.linalg.qr(np.column_stack([offset @ along, np.ones(end - first)]) / scale[:, None])
        moved = (normal @ by_lens[here]) / scale[:, None]
        slope[here] = moved - own @ (own.T @ moved)
    return error, slope
