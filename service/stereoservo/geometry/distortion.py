"""Radial lens distortion with one parameter and its own centre: between ideal pinhole pixels and raw pixels.

A ``lens`` is ``(k, cu, cv, r0)``: the raw pixel of an ideal one ``p`` is ``c + (p - c)(1 + k |p - c|² / r0²)``
with the centre ``c = (cu, cv)`` [px] and the reference radius ``r0`` [px], half the image width. With square
pixels and the centre at the principal point, ``k / r0²`` is Brown's (and OpenCV's) ``k1 / f²``. Everything
projective works on ideal pixels; raw ones are what cameras and people see.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

ITERATIONS = 30
"""Newton steps of the inverse at most; from the start below five suffice inside the image."""
CONVERGED = 1e-14
"""Step, relative to the radius, at which the inverse ends."""


def straight_lens(width: int, height: int) -> FloatArray:
    """The lens (4,) of a pinhole: ``k`` = 0, centre in the middle of the image, integer = pixel centre."""
    return np.array([0.0, 0.5 * (width - 1), 0.5 * (height - 1), 0.5 * width])


def distort(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Raw pixels (..., 2) of ideal ones; NaN beyond the radius where the image folds back."""
    k, centre, r0 = lens[0], lens[1:3], lens[3]
    offset = np.asarray(pixels, dtype=np.float64) - centre
    squared = (offset**2).sum(axis=-1, keepdims=True) / r0**2
    unfolded = 1.0 + 3.0 * k * squared > 0.0
    return np.where(unfolded, centre + offset * (1.0 + k * squared), np.nan)


def undistort(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Ideal pixels (..., 2) of raw ones, the inverse of :func:`distort`; NaN where no ideal pixel has this image.

    Newton's method on the radius. With ``k < 0`` the image ends at a radius: nothing lies beyond.
    """
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


def distortion_jacobian(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """``∂raw/∂ideal`` (..., 2, 2) at ideal pixels (..., 2)."""
    k, centre, r0 = lens[0], lens[1:3], lens[3]
    offset = (np.asarray(pixels, dtype=np.float64) - centre) / r0
    squared = (offset**2).sum(axis=-1)[..., None, None]
    result: FloatArray = (1.0 + k * squared) * np.eye(2) + 2.0 * k * offset[..., :, None] * offset[
        ..., None, :
    ]
    return result


def lens_jacobian(lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """``∂raw/∂(k, cu, cv)`` (..., 2, 3) at ideal pixels (..., 2)."""
    centre, r0 = lens[1:3], lens[3]
    offset = np.asarray(pixels, dtype=np.float64) - centre
    squared = (offset**2).sum(axis=-1, keepdims=True) / r0**2
    by_centre = np.eye(2) - distortion_jacobian(lens, pixels)
    return np.concatenate([(offset * squared)[..., None], by_centre], axis=-1)
