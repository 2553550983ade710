"""Area coverage of ellipses and convex polygons, blended into a float image. Pixels: integer = pixel
centre.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from stereoservo.numerics.compilation import kernel

LINES = 16
"""Lines per pixel row, or per part of it that a shape covers, on which spans are exact; between them the midpoint
rule.
"""


@kernel
def _add_span(row: npt.NDArray[np.float64], first: int, u0: float, u1: float, weight: float) -> None:
    """Add ``weight`` times the overlap of [u0, u1] with each pixel to ``row``, whose item 0 is pixel
    ``first``.
    """
    last = first + row.shape[0] - 1
    u0, u1 = max(u0, first - 0.5), min(u1, last + 0.5)
    if u1 <= u0:
        return
    i0, i1 = min(math.floor(u0 + 0.5), last), min(math.floor(u1 + 0.5), last)
    if i0 == i1:
        row[i0 - first] += weight * (u1 - u0)
        return
    row[i0 - first] += weight * (i0 + 0.5 - u0)
    for i in range(i0 + 1, i1):
        row[i - first] += weight
    row[i1 - first] += weight * (u1 - (i1 - 0.5))


@kernel
def _blend(image: npt.NDArray[np.float32], v: int, first: int, row: npt.NDArray[np.float64], level: float) -> None:
    for i in range(row.shape[0]):
        if row[i] > 0.0:
            c = min(row[i], 1.0)
            image[v, first + i] = image[v, first + i] * (1.0 - c) + level * c
            row[i] = 0.0


@kernel
def blend_ellipse(image: npt.NDArray[np.float32], conic: npt.NDArray[np.float64], level: float) -> None:
    """Blend the inside of ``conic`` (3, 3) (where ``m' C m < 0``) at ``level`` into ``image``; no
    ellipse, no change.
    """
    a, b, c = conic[0, 0], conic[0, 1], conic[1, 1]
    d, e, f = conic[0, 2], conic[1, 2], conic[2, 2]
    det = a * c - b * b
    if not (a > 0.0 and det > 0.0):
        return
    uc, vc = (b * e - c * d) / det, (b * d - a * e) / det
    k = -(f + d * uc + e * vc)
    if not k > 0.0:
        return
    half_u, half_v = math.sqrt(k * c / det), math.sqrt(k * a / det)
    first = max(math.floor(uc - half_u), 0)
    last = min(math.ceil(uc + half_u), image.shape[1] - 1)
    top = max(math.floor(vc - half_v + 0.5), 0)
    bottom = min(math.floor(vc + half_v + 0.5), image.shape[0] - 1)
    if last < first:
        return
    row = np.zeros(last - first + 1)
    for v in range(top, bottom + 1):
        low, high = max(v - 0.5, vc - half_v), min(v + 0.5, vc + half_v)
        weight = (high - low) / LINES
        for line in range(LINES):
            dv = low + (line + 0.5) * weight - vc
            # a du^2 + 2 b du dv + c dv^2 = k
            inside = (b * dv) ** 2 - a * (c * dv * dv - k)
            if inside > 0.0:
                half = math.sqrt(inside) / a
                middle = uc - b * dv / a
                _add_span(row, first, middle - half, middle + half, weight)
        _blend(image, v, first, row, level)


@kernel
def blend_polygon(image: npt.NDArray[np.float32], corners: npt.NDArray[np.float64], level: float) -> None:
    """Blend a convex polygon, ``corners`` (k, 2) in order, at ``level`` into ``image``."""
    first = max(math.floor(corners[:, 0].min()), 0)
    last = min(math.ceil(corners[:, 0].max()), image.shape[1] - 1)
    lowest, highest = corners[:, 1].min(), corners[:, 1].max()
    top = max(math.floor(lowest + 0.5), 0)
    bottom = min(math.floor(highest + 0.5), image.shape[0] - 1)
    if last < first:
        return
    n = corners.shape[0]
    row = np.zeros(last - first + 1)
    for v in range(top, bottom + 1):
        start, end = max(v - 0.5, lowest), min(v + 0.5, highest)
        weight = (end - start) / LINES
        for line in range(LINES):
            y = start + (line + 0.5) * weight
            low, high = np.inf, -np.inf
            for i in range(n):
                u0, v0 = corners[i, 0], corners[i, 1]
                u1, v1 = corners[(i + 1) % n, 0], corners[(i + 1) % n, 1]
                if (v0 <= y) != (v1 <= y):
                    u = u0 + (y - v0) / (v1 - v0) * (u1 - u0)
                    low, high = min(low, u), max(high, u)
            if high > low:
                _add_span(row, first, low, high, weight)
        _blend(image, v, first, row, level)
