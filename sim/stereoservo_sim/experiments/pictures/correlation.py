"""A tracker of interest points like the thesis's (4.5.1): normalised correlation of small windows from picture to
picture, the peak to a part of a pixel by a paraboloid; its errors add up from picture to picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray

HALF, BACK_REACH = 7, 4
"""[px] Of a window's side, and how far around where it came from a match is sought back."""
LEAST_CORRELATION = 0.8
BACK_PX = 0.5
"""A point whose match leads back to a place this far off is lost."""


def follow(pictures: Sequence[ImageArray], first: FloatArray, reach: int) -> FloatArray:
    """Pixels (s, m, 2) of points at ``first`` (m, 2) in the first of s pictures, NaN from where a point is lost: where
    nothing correlates within ``reach`` [px] of the whole picture's shift, or what does leads back to another place.
    """
    found = np.full((len(pictures), *first.shape), np.nan)
    found[0] = first
    for k in range(1, len(pictures)):
        before, after = pictures[k - 1], pictures[k]
        alive = np.flatnonzero(np.isfinite(found[k - 1]).all(axis=1))
        if len(alive) == 0:
            break
        way = _shift(before, after, found[k - 1, alive])
        for i in alive:
            there = _displacement(before, after, found[k - 1, i], way, reach)
            if np.isnan(there).any():
                continue
            back = _displacement(
                after, before, found[k - 1, i] + there, -np.rint(there).astype(int), BACK_REACH
            )
            if np.hypot(*(there + back)) < BACK_PX:
                found[k, i] = found[k - 1, i] + there
    return found


def _shift(before: ImageArray, after: ImageArray, points: FloatArray) -> IntArray:
    """Shift (2,) [px] of the part of a picture that holds the ``points`` (m, 2)."""
    left, top = np.maximum(np.floor(points.min(axis=0)).astype(int) - HALF, 0)
    right, bottom = np.ceil(points.max(axis=0)).astype(int) + HALF + 1
    score = cv2.matchTemplate(after, before[top:bottom, left:right], cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    return np.array([column - left, row - top])


def _displacement(
    before: ImageArray, after: ImageArray, point: FloatArray, way: IntArray, reach: int
) -> FloatArray:
    """Displacement (2,) [px] of the window around a ``point`` (2,), near ``way`` (2,); NaN where none is found."""
    u, v = (int(x) for x in np.rint(point))
    x, y = u + int(way[0]), v + int(way[1])
    height, width = before.shape
    far = HALF + reach
    inside = HALF <= u < width - HALF and HALF <= v < height - HALF
    if not (inside and far <= x < width - far and far <= y < height - far):
        return np.full(2, np.nan)
    window = before[v - HALF : v + HALF + 1, u - HALF : u + HALF + 1]
    region = after[y - far : y + far + 1, x - far : x + far + 1]
    score = cv2.matchTemplate(region, window, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(score)
    if best < LEAST_CORRELATION or not (0 < row < 2 * reach and 0 < column < 2 * reach):
        return np.full(2, np.nan)
    summit = _summit(score[row - 1 : row + 2, column - 1 : column + 2].astype(np.float64))
    return np.asarray(way + np.array([column, row]) - reach + summit)


def _summit(peak: FloatArray) -> FloatArray:
    """Summit (2,) [px] (u, v) of the paraboloid of least squares through 3 x 3 values, from their middle."""
    a, b, c, d, e = PARABOLOID @ peak.ravel()
    offset = np.array([d * b - 2.0 * e * a, d * a - 2.0 * c * b]) / (4.0 * c * e - d * d)
    return np.clip(offset, -1.0, 1.0)


def _paraboloid() -> FloatArray:
    """(5, 9): coefficients of u, v, u², uv, v² of the paraboloid of least squares through 3 x 3 values."""
    v, u = np.mgrid[-1:2, -1:2].reshape(2, -1)
    return np.asarray(np.linalg.pinv(np.column_stack([np.ones(9), u, v, u * u, u * v, v * v]))[1:])


PARABOLOID = _paraboloid()
