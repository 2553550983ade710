"""Markers that stand still while the joints move: a workpiece's, say. They are not of the body that is calibrated."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.calibration.trials import StaticSights
from stereoservo.kinematics.model import FloatArray

NOISE = 5.0
"""A standing marker strays by no more than so many deviations of its noise ..."""
LEAST_PX = 0.3
"""... or than this [px], which a shaking table makes ..."""
SHARE = 0.1
"""... and by no more than this share of the way of the marker that moves most."""

STRAYING = 0.25
"""Share of a camera's stops at which a static marker may be off: behind the arm, say."""

STOPS = 4
"""Of a marker that one camera has seen at fewer stops nothing is said."""


def standing_markers(pixels: FloatArray, sigmas: FloatArray) -> npt.NDArray[np.bool_]:
    """``(m,)``: which markers stand still over all stops. ``pixels`` (c, s, m, 2), NaN where missing.

    ``sigmas`` (c, s, m) [px]. None where nothing moves: then it is not the markers that are wrong.
    """
    seen = np.asarray(np.isfinite(pixels).all(axis=-1))
    count = seen.sum(axis=1)
    known = np.where(seen[..., None], pixels, 0.0)
    middle = known.sum(axis=1) / np.maximum(count, 1)[..., None]
    squares = np.where(seen, ((known - middle[:, None]) ** 2).sum(axis=-1), 0.0).sum(axis=(0, 1))
    total = np.maximum(seen.sum(axis=(0, 1)), 1)
    strayed = np.sqrt(squares / total)
    noise = np.sqrt(2.0 * np.where(seen, sigmas**2, 0.0).sum(axis=(0, 1)) / total)
    still = (strayed <= np.maximum(NOISE * noise, LEAST_PX)) & (strayed <= SHARE * strayed.max(initial=0.0))
    return np.asarray(still & (count.max(axis=0) >= STOPS))


def static_sights(
    ids: tuple[int, ...], pixels: FloatArray, sigmas: FloatArray
) -> tuple[StaticSights | None, tuple[int, ...]]:
    """Where markers ``ids`` (k,) that are said to be static stand in the images, and which of them did move.

    ``pixels`` (c, s, k, 2) of all stops, NaN where missing, and ``sigmas`` (c, s, k) [px]. In each camera it is the
    median over the stops, so that a stop at which the arm covers half of a marker does no harm; its sigma is that of
    one stop, since what is systematic does not average. A marker that strays from its median at more than a quarter
    of the stops of a camera has moved, and is left out.
    """
    seen = np.asarray(np.isfinite(pixels).all(axis=-1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of a marker that a camera never sees: NaN it stays
        middle = np.nanmedian(pixels, axis=1)
        sigma = np.nanmedian(np.where(seen, sigmas, np.nan), axis=1)
    away = np.linalg.norm(pixels - middle[:, None], axis=-1)
    strays = seen & (away > np.maximum(NOISE * np.sqrt(2.0) * sigma, LEAST_PX)[:, None])
    moved = (strays.sum(axis=1) > STRAYING * np.maximum(seen.sum(axis=1), 1)).any(axis=0)
    kept = ~moved & seen.any(axis=(0, 1))
    named = tuple(marker for marker, one in zip(ids, moved, strict=True) if one)
    if not kept.any():
        return None, named
    left = tuple(marker for marker, one in zip(ids, kept, strict=True) if one)
    return StaticSights(left, middle[:, kept], sigma[:, kept]), named
