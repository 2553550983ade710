"""Markers that stand still while the joints move: a workpiece's, say. They are not of the body that is calibrated."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.model import FloatArray

NOISE = 5.0
"""A standing marker strays by no more than so many deviations of its noise ..."""
LEAST_PX = 0.3
"""... or than this [px], which a shaking table makes ..."""
SHARE = 0.1
"""... and by no more than this share of the way of the marker that moves most."""

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
