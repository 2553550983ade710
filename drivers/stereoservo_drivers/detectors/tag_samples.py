"""Pixels of a tag, by its homography: their grey values and places, for the fit of its pattern. Numba kernels; no
state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

QUIET_CELLS = 0.5
"""Fitted part of the white margin [cells]; a printed tag has one cell at least."""


class Samples(NamedTuple):
    """Levels ``grey`` (m,) of pixels at local places ``us``, ``vs`` (m,)."""

    grey: FloatArray
    us: FloatArray
    vs: FloatArray


class TagPlace(NamedTuple):
    """Where a tag is: homography ``h`` (9,) from local places to the tag, and its inverse ``g`` (9,); (``u0``, ``v0``)
    and ``side`` [px]: origin and unit of local places.
    """

    h: FloatArray
    g: FloatArray
    u0: float
    v0: float
    side: float


@kernel
def sample_tag(image, place, n, most, samples):
    """Number of the pixels within the tag of ``n`` cells a side and its quiet margin, about ``most`` of them on a
    lattice: into the first rows of ``samples``, of which no more are written than there is room.
    """
    h, g, u0, v0, side = place
    grey, us, vs = samples
    height, width = image.shape
    low, high = -QUIET_CELLS / n, 1.0 + QUIET_CELLS / n
    u_low, u_high, v_low, v_high = math.inf, -math.inf, math.inf, -math.inf
    area, u_last, v_last = 0.0, 0.0, 0.0
    for k in range(5):
        x, y = (high if k in (1, 2) else low), (high if k in (2, 3) else low)
        w = g[6] * x + g[7] * y + 1.0
        if not w > 1e-6:
            return 0
        u, v = (g[0] * x + g[1] * y + g[2]) / w * side + u0, (g[3] * x + g[4] * y + g[5]) / w * side + v0
        u_low, u_high, v_low, v_high = min(u_low, u), max(u_high, u), min(v_low, v), max(v_high, v)
        if k:
            area += 0.5 * (u_last * v - u * v_last)
        u_last, v_last = u, v
    if not (u_high > 0.0 and v_high > 0.0 and u_low < width - 1.0 and v_low < height - 1.0):
        return 0
    first_u, last_u = int(max(math.floor(u_low), 0)), int(min(math.ceil(u_high), width - 1))
    first_v, last_v = int(max(math.floor(v_low), 0)), int(min(math.ceil(v_high), height - 1))
    stride = max(1, math.ceil(abs(area) / most))
    slant = round(0.618 * stride)
    count = 0
    for row in range(first_v, last_v + 1):
        v = (row - v0) / side
        for column in range(first_u + (-first_u - slant * row) % stride, last_u + 1, stride):
            u = (column - u0) / side
            w = h[6] * u + h[7] * v + 1.0
            x, y = h[0] * u + h[1] * v + h[2], h[3] * u + h[4] * v + h[5]
            if w > 0.0 and low * w <= x <= high * w and low * w <= y <= high * w and count < grey.size:
                grey[count] = image[row, column]
                us[count], vs[count] = u, v
                count += 1
    return count


@kernel
def percentiles(grey):
    """Grey levels that a tenth and nine tenths of ``grey`` (m,), whole levels, do not exceed."""
    counts = np.zeros(256, np.int64)
    for k in range(grey.size):
        counts[int(grey[k])] += 1
    black, white, total = -1, -1, 0
    for level in range(256):
        total += counts[level]
        if black < 0 and total * 10 >= grey.size:
            black = level
        if white < 0 and total * 10 >= grey.size * 9:
            white = level
    return float(black), float(white)
