"""Lens distortion about its own centre, radial and tangential: ideal (pinhole) pixels to raw pixels and back, with
derivatives; and the radial parameter from images of straight lines.

A ``lens`` is ``(k, cu, cv, r0)`` or ``(k, cu, cv, r0, k2, p1, p2)``: the raw pixel of an ideal one ``p`` is
``c + (p - c)(1 + k s + k2 s²) + r0 (2 p1 x y + p2 (s + 2 x²), p1 (s + 2 y²) + 2 p2 x y)`` with the centre ``c = (cu,
cv)`` [px], the reference radius ``r0`` [px], half the image width, ``(x, y) = (p - c) / r0`` and ``s = x² + y²``. With
square pixels and the centre at the principal point, ``k / r0²``, ``k2 / r0⁴``, ``p1 / r0``, ``p2 / r0`` are Brown's
(and OpenCV's) ``k1 / f²``, ``k2 / f⁴``, ``p1 / f``, ``p2 / f``. Projective geometry uses ideal pixels; raw ones
are those of the camera's images.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import FloatArray

ITERATIONS = 30
"""Most Newton steps of the inverse; five suffice inside the image from the start value below."""
CONVERGED = 1e-14
"""Step, relative to the radius, at which the inverse has converged."""
FARTHEST = 20.0
"""Ideal radius [r0] beyond which no inverse of a lens with several terms is computed."""
MET = 1e-10
"""Error [r0] of an inverse with tangential terms above which there is no inverse: the pixel lies beyond the fold."""


def pinhole_lens(width: int, height: int) -> FloatArray:
    """The lens (4,) of a pinhole: ``k`` = 0, centre in the middle of the image, integer = pixel centre."""
    return np.array([0.0, 0.5 * (width - 1), 0.5 * (height - 1), 0.5 * width])


def has_distortion(lens: FloatArray) -> bool:
    """Whether a lens has distortion."""
    return bool(lens[0] != 0.0 or (len(lens) > 4 and lens[4:].any()))


def fold_radius(lens: FloatArray) -> float:
    """Ideal radius [px] at which the radial function stops growing and the image folds back; infinite if it grows
    everywhere.
    """
    k, k2 = float(lens[0]), float(lens[4]) if len(lens) > 4 else 0.0
    # The least positive root s of 1 + 3 k s + 5 k2 s².
    under = 9.0 * k * k - 20.0 * k2
    below = math.sqrt(under) - 3.0 * k if under > 0.0 else 0.0
    return float(lens[3]) * math.sqrt(2.0 / below) if below > 0.0 else math.inf


def distort(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Raw pixels (..., 2) of ideal ones; NaN beyond the radius where the image folds back."""
    if len(lens) > 4:
        offset = (np.asarray(pixels, dtype=np.float64) - lens[1:3]) / lens[3]
        unfolded = (offset**2).sum(axis=-1, keepdims=True) < min(fold_radius(lens) / lens[3], FARTHEST) ** 2
        return np.where(unfolded, lens[1:3] + lens[3] * _distorted(lens, offset), np.nan)
    k, centre, r0 = lens[0], lens[1:3], lens[3]
    offset = np.asarray(pixels, dtype=np.float64) - centre
    squared = (offset**2).sum(axis=-1, keepdims=True) / r0**2
    unfolded = 1.0 + 3.0 * k * squared > 0.0
    return np.where(unfolded, centre + offset * (1.0 + k * squared), np.nan)


def undistort(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Ideal pixels (..., 2) of raw ones, the inverse of :func:`distort`; NaN if no ideal pixel has this image.

    Newton's method on the radius. With ``k < 0`` the image ends at a finite radius.
    """
    if len(lens) > 4:
        return _undistorted(lens, np.asarray(pixels, dtype=np.float64))
    k, centre, r0 = lens[0], lens[1:3], lens[3]
    offset = np.asarray(pixels, dtype=np.float64) - centre
    if k == 0.0:
        return centre + offset
    raw = np.sqrt((offset**2).sum(axis=-1)) / r0
    # Barrel: from below, r = raw, the function is concave and Newton climbs to the root; pincushion: from above.
    radius = raw.copy()
    inside = np.ones(raw.shape, dtype=bool)
    if k < 0.0:
        # The image ends at 2/3 of the fold's radius 1 / sqrt(-3 k).
        inside = -k * raw**2 < 4.0 / 27.0
        radius = np.where(inside, radius, 0.0)
    target = np.where(inside, raw, 0.0)
    for _ in range(ITERATIONS):
        step = (radius * (1.0 + k * radius**2) - target) / (1.0 + 3.0 * k * radius**2)
        radius = radius - step
        if float(np.max(np.abs(step), initial=0.0)) <= CONVERGED * float(np.max(radius, initial=1.0)):
            break
    scale = 1.0 / (1.0 + k * radius**2)
    return np.where(inside[..., None], centre + offset * scale[..., None], np.nan)


def _distorted(lens: FloatArray, offset: FloatArray) -> FloatArray:
    """Raw offsets (..., 2) [r0] from the centre of a lens (7,), of ideal ones."""
    k, k2, p1, p2 = lens[[0, 4, 5, 6]]
    x, y = offset[..., 0], offset[..., 1]
    s = x * x + y * y
    stretch = 1.0 + s * (k + s * k2)
    return np.stack(
        [
            x * stretch + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            y * stretch + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def _undistorted(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Ideal pixels (..., 2) of raw ones through a lens (7,): Newton's method within brackets on the radius, then on
    both coordinates; NaN also if tangential terms move a pixel beyond the radial image.
    """
    centre, r0 = lens[1:3], lens[3]
    k, k2 = lens[0], lens[4]
    target = (pixels - centre) / r0
    raw = np.sqrt((target**2).sum(axis=-1))
    fold = min(fold_radius(lens) / r0, FARTHEST)
    inside = raw < fold * (1.0 + fold**2 * (k + fold**2 * k2))
    goal = np.where(inside, raw, 0.0)
    low, high = np.zeros_like(goal), np.full_like(goal, fold)
    radius = np.minimum(goal, 0.9 * fold)
    for _ in range(2 * ITERATIONS):
        s = radius**2
        excess = radius * (1.0 + s * (k + s * k2)) - goal
        low, high = np.where(excess <= 0.0, radius, low), np.where(excess >= 0.0, radius, high)
        step = radius - excess / (1.0 + s * (3.0 * k + 5.0 * k2 * s))
        step = np.where((step >= low) & (step <= high), step, 0.5 * (low + high))
        moved = np.abs(step - radius)
        radius = step
        if float(np.max(moved, initial=0.0)) <= CONVERGED * float(np.max(radius, initial=1.0)):
            break
    goals = np.where(inside[..., None], target, 0.0)
    offset = goals * (radius / np.where(goal > 0.0, goal, 1.0))[..., None]
    for _ in range(ITERATIONS):
        slope = distortion_jacobian(lens, centre + r0 * offset)
        determinant = slope[..., 0, 0] * slope[..., 1, 1] - slope[..., 0, 1] * slope[..., 1, 0]
        error = _distorted(lens, offset) - goals
        step = (
            np.stack(
                [
                    slope[..., 1, 1] * error[..., 0] - slope[..., 0, 1] * error[..., 1],
                    slope[..., 0, 0] * error[..., 1] - slope[..., 1, 0] * error[..., 0],
                ],
                axis=-1,
            )
            / np.where(determinant > 0.0, determinant, np.inf)[..., None]
        )
        offset = offset - step
        if float(np.max(np.abs(step), initial=0.0)) <= CONVERGED * float(np.max(np.abs(offset), initial=1.0)):
            break
    met = np.abs(_distorted(lens, offset) - goals).max(axis=-1, initial=0.0) < MET
    return np.where((inside & met)[..., None], centre + r0 * offset, np.nan)


def distortion_jacobian(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """``∂raw/∂ideal`` (..., 2, 2) at ideal pixels (..., 2)."""
    k, centre, r0 = lens[0], lens[1:3], lens[3]
    offset = (np.asarray(pixels, dtype=np.float64) - centre) / r0
    if len(lens) > 4:
        k2, p1, p2 = lens[4:7]
        x, y = offset[..., 0], offset[..., 1]
        s = x * x + y * y
        even, slope = 1.0 + s * (k + s * k2), 2.0 * k + 4.0 * k2 * s
        across = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        return np.stack(
            [
                np.stack([even + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x, across], axis=-1),
                np.stack([across, even + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x], axis=-1),
            ],
            axis=-2,
        )
    squared = (offset**2).sum(axis=-1)[..., None, None]
    result: FloatArray = (1.0 + k * squared) * np.eye(2) + 2.0 * k * offset[..., :, None] * offset[..., None, :]
    return result


def lens_jacobian(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """``∂raw/∂(k, cu, cv)`` (..., 2, 3) at ideal pixels (..., 2)."""
    centre, r0 = lens[1:3], lens[3]
    offset = np.asarray(pixels, dtype=np.float64) - centre
    squared = (offset**2).sum(axis=-1, keepdims=True) / r0**2
    by_centre = np.eye(2) - distortion_jacobian(lens, pixels)
    return np.concatenate([(offset * squared)[..., None], by_centre], axis=-1)


def terms_jacobian(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """``∂raw/∂(k2, p1, p2)`` (..., 2, 3) at ideal pixels (..., 2), of a lens with or without these terms."""
    offset = (np.asarray(pixels, dtype=np.float64) - lens[1:3]) / lens[3]
    x, y = offset[..., 0], offset[..., 1]
    s = x * x + y * y
    columns = (
        np.stack([x * s * s, y * s * s], axis=-1),
        np.stack([2.0 * x * y, s + 2.0 * y * y], axis=-1),
        np.stack([s + 2.0 * x * x, 2.0 * x * y], axis=-1),
    )
    return np.asarray(lens[3] * np.stack(columns, axis=-1))


CENTRE_SHARE = 0.1
"""Prior standard deviation of the centre about the middle of the image [image widths]: a weak distortion does not
determine the centre."""
GRID = (-0.3, -0.2, -0.13, -0.08, -0.04, 0.0, 0.04, 0.08, 0.13)
"""Initial values of the radial parameter at half the image width."""
MOST_UNCERTAIN = 1.0
"""Standard deviation of the radial parameter above which the lines do not determine it."""
LINE_ITERATIONS = 60


class LensEstimate(NamedTuple):
    """``lens`` (4,), covariance (3, 3) of its (k, cu, cv), chi-square of the fit and its degrees of freedom."""

    lens: FloatArray
    covariance: FloatArray
    chi2: float
    degrees_of_freedom: int


def lens_from_lines(lines: Sequence[FloatArray], sigma: float, width: int, height: int) -> LensEstimate:
    """The lens of a camera from raw pixels (n_i, 2) along straight lines, noise ``sigma`` [px] per axis.

    A weak prior (``CENTRE_SHARE``) constrains the centre; the covariance includes it. The covariance is at the
    larger of the stated and the estimated noise. Raises GeometryError: ``shape``, ``too_few`` (each line needs three
    pixels), ``not_finite``, ``degenerate`` if the lines do not determine the distortion (such as when all pass
    through the centre), ``no_convergence``.
    """
    pixels, starts = _checked(lines, sigma)
    pinhole = pinhole_lens(width, height)
    weak = np.array([0.0, 1.0, 1.0]) / (CENTRE_SHARE * width)

    def errors_at(lens: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (n + 3,) in sigmas, the prior's last, and their Jacobian (n + 3, 3) by the lens parameters."""
        error, slope = _projected(lens, pixels, starts, sigma)
        return np.append(error, weak * (lens[:3] - pinhole[:3])), np.vstack([slope, np.diag(weak)])

    def cost_at(lens: FloatArray) -> float:
        error = errors_at(lens)[0]
        return float(error @ error) if np.isfinite(error).all() else np.inf

    lens = min((np.append(k, pinhole[1:]) for k in GRID), key=cost_at)
    damping, cost = 1e-4, cost_at(lens)
    for _ in range(LINE_ITERATIONS):
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
        raise GeometryError("no_convergence", f"the lens did not settle in {ITERATIONS} steps; cost {cost:.4g}")
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
    """All pixels (n, 2) and the index at which each line starts (l + 1,)."""
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
    """Distances (n,) of raw pixels from the images of their best-fitting lines [sigmas], and their derivatives (n, 3)
    by (k, cu, cv) with the lines eliminated.
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
            centroid = weights @ ideal[here] / weights.sum()
            offset = ideal[here] - centroid
            normal = np.linalg.eigh(offset.T @ (offset * weights[:, None]))[1][:, 0]
            scale = sigma * np.linalg.norm(normal @ to_ideal[here], axis=1)
        error[here] = offset @ normal / scale
        along = np.array([-normal[1], normal[0]])
        own, _ = np.linalg.qr(np.column_stack([offset @ along, np.ones(end - first)]) / scale[:, None])
        moved = (normal @ by_lens[here]) / scale[:, None]
        slope[here] = moved - own @ (own.T @ moved)
    return error, slope
