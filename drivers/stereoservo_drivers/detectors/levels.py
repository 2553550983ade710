"""Grey levels of a dot and of what surrounds it: noise, slopes, background. Numba kernels; no state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.compilation import inlined_kernel, kernel
from stereoservo_drivers.detectors.components import (
    BRIGHT,
    QXX,
    QXY,
    QYY,
    SLOPE,
    SLOPE_XX,
    SLOPE_XY,
    SLOPE_YY,
    U,
    V,
    aperture_of,
    half_sizes,
    median_level,
)

RING = 2
"""Width of the surroundings outside the skirt [px] that give background and noise."""
INNER = 0.6
"""Part of the ellipse's area whose level is looked at for slope and noise."""
MIN_INNER = 18
"""Pixels of it without which nothing is said."""
TERMS = 7
"""Of the levels inside, as :func:`inside` lists them."""
UNEVEN_INSIDE = 0.005
"""What these terms leave of a dot's own shape, as a part of its contrast: not noise."""
UNLIKE_EVEN = 0.09
"""And as a part of what the even terms explain: blur and motion that reach far into the dot (measured: 0.03 to 0.1)."""
EVEN = 1e6
"""Variance [1/px²] of a slope of which nothing is known."""


@kernel
def _add(sums, x, y, level, tail, times):
    """Moments of one pixel's place, level and tail into ``sums`` (15,)."""
    sums[0] += times
    sums[1] += times * level
    sums[2] += times * x
    sums[3] += times * y
    sums[4] += times * x * x
    sums[5] += times * x * y
    sums[6] += times * y * y
    sums[7] += times * x * level
    sums[8] += times * y * level
    sums[9] += times * level * level
    sums[10] += times * tail
    sums[11] += times * tail * x
    sums[12] += times * tail * y
    sums[13] += times * tail * tail
    sums[14] += times * tail * level


@inlined_kernel
def _ring_row(row, first, y, aperture, histogram, ring, sums):
    """Add the pixels of a ``row``, at x = ``first``, ... and ``y`` [px] from the centre, that are outside the skirt.

    Their |level| to ``histogram``, (x, y, level, tail) to ``ring`` (n, 4), their moments to ``sums`` (15,), which
    begins with the number of pixels.
    """
    q11, q12, q22, skirt, sign, zero = aperture
    width = 4.0 * skirt * skirt
    # the tail falls like a Gaussian's: (1 - (δ² - skirt²) / ((skirt + RING)² - skirt²))³
    fall = 1.0 / ((skirt + RING) ** 2 - skirt * skirt)
    before = count = int(sums[0])
    # sums along the row: their powers of y follow
    si = sx = sxx = sxi = sii = st = stx = stt = sti = 0.0
    for k in range(row.size):
        x = k + first
        gx = q11 * x + q12 * y
        gy = q12 * x + q22 * y
        e = x * gx + y * gy - 1.0
        g2 = gx * gx + gy * gy
        if e >= 0.0 and e * e >= width * g2:
            level = sign * row[k] + zero
            near = max(1.0 - (0.25 * e * e / g2 - skirt * skirt) * fall, 0.0)
            tail = near * near * near
            histogram[int(abs(level))] += 1
            ring[count, 0] = x
            ring[count, 1] = y
            ring[count, 2] = level
            ring[count, 3] = tail
            count += 1
            si += level
            sx += x
            sxx += x * x
            sxi += x * level
            sii += level * level
            st += tail
            stx += tail * x
            stt += tail * tail
            sti += tail * level
    n = float(count - before)
    sums[0] += n
    sums[1] += si
    sums[2] += sx
    sums[3] += n * y
    sums[4] += sxx
    sums[5] += sx * y
    sums[6] += n * y * y
    sums[7] += sxi
    sums[8] += si * y
    sums[9] += sii
    sums[10] += st
    sums[11] += stx
    sums[12] += st * y
    sums[13] += stt
    sums[14] += sti


class Surface(NamedTuple):
    """Levels about a dot: a plane and the tail of its blur, and the ``variance`` about them; -1 where there are none.

    ``plane_level``: that of the plane under the centre where the tail is not fitted.
    """

    variance: float
    plane_level: float
    level: float
    slope_x: float
    slope_y: float
    slope_t: float


@kernel
def _fit_surface(sums):
    """Least squares by the moments ``sums`` (15,): the plane first, then the tail in what the plane leaves."""
    n = sums[0]
    if n < 12.0:
        return Surface(-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    si, sx, sy, st = sums[1], sums[2], sums[3], sums[10]
    sxx = sums[4] - sx * sx / n
    sxy = sums[5] - sx * sy / n
    syy = sums[6] - sy * sy / n
    sxi = sums[7] - sx * si / n
    syi = sums[8] - sy * si / n
    sii = sums[9] - si * si / n
    d = sxx * syy - sxy * sxy
    if d <= 0.0:
        return Surface(-1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    slope_x = (syy * sxi - sxy * syi) / d
    slope_y = (sxx * syi - sxy * sxi) / d
    plane_level = level = (si - slope_x * sx - slope_y * sy) / n
    left = sii - slope_x * sxi - slope_y * syi
    stx, sty = sums[11] - st * sx / n, sums[12] - st * sy / n
    tail_x = (syy * stx - sxy * sty) / d
    tail_y = (sxx * sty - sxy * stx) / d
    own = sums[13] - st * st / n - tail_x * stx - tail_y * sty
    slope_t = 0.0
    if own > 1e-3:
        slope_t = (sums[14] - st * si / n - tail_x * sxi - tail_y * syi) / own
        left -= slope_t * slope_t * own
        level -= slope_t * (st - tail_x * sx - tail_y * sy) / n
        slope_x -= slope_t * tail_x
        slope_y -= slope_t * tail_y
    return Surface(max(left, 0.0) / (n - 4.0), plane_level, level, slope_x, slope_y, slope_t)


@kernel
def surroundings(image, dark, background, skirt, reach, out, plane):
    """Variance of the dot's surroundings about a plane and the tail of the dot's blur [grey levels squared]; -1 where
    there is too little to see. ``plane`` (2,) gets the plane's level under the centre above ``background``, and the
    number of pixels.

    Pixels off by more than four robust standard deviations (a neighbour's skirt, the plate's edge) do not
    count.
    """
    aperture = aperture_of(dark, background, skirt, out)
    cu, cv = out[U], out[V]
    half_u, half_v = half_sizes(out[QXX], out[QXY], out[QYY])
    half_u, half_v = half_u + (reach + RING), half_v + (reach + RING)
    rows, columns = image.shape
    lo_u, hi_u = max(int(cu - half_u), 0), min(int(cu + half_u) + 1, columns - 1)
    lo_v, hi_v = max(int(cv - half_v), 0), min(int(cv + half_v) + 1, rows - 1)
    histogram, sums = np.zeros(256, np.int32), np.zeros(15)
    ring = np.empty(((hi_u - lo_u + 1) * (hi_v - lo_v + 1), 4))
    plane[:] = 0.0
    for v in range(lo_v, hi_v + 1):
        _ring_row(image[v, lo_u : hi_u + 1], lo_u - cu, v - cv, aperture, histogram, ring, sums)
    count = int(sums[0])
    if count < 24:
        return -1.0
    limit = 4.0 * 1.4826 * median_level(histogram, count) + 2.0
    counted = np.ones(count, np.bool_)
    fit = Surface(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(2):
        for k in range(count):
            x, y, level, tail = ring[k, 0], ring[k, 1], ring[k, 2], ring[k, 3]
            near = abs(level - fit.level - fit.slope_x * x - fit.slope_y * y - fit.slope_t * tail) <= limit
            if near != counted[k]:
                # few change sides
                counted[k] = near
                _add(sums, x, y, level, tail, 1.0 if near else -1.0)
        fit = _fit_surface(sums)
        if fit.variance < 0.0:
            return -1.0
        plane[0], plane[1] = fit.plane_level, sums[0]
        limit = 3.0 * np.sqrt(fit.variance) + 0.5
    # what lies within three standard deviations of a Gaussian has 0.973 of its variance
    return fit.variance / 0.973 if fit.variance > 1.0 else fit.variance


@kernel
def inside(image, dark, background, contrast, out):
    """Relative slope of the level inside a dot with its covariance under unit noise, and the noise there, into ``out``.

    Least squares of the levels on 1, x, y, x², xy, y², q² with q = dᵀQd < INNER: the even terms take up what blur and
    motion do to a small dot.
    """
    q11, q12, q22 = out[QXX], out[QXY], out[QYY]
    det = q11 * q22 - q12 * q12
    cu, cv = out[U], out[V]
    half_u, half_v = np.sqrt(INNER * q22 / det), np.sqrt(INNER * q11 / det)
    A = np.zeros((TERMS, TERMS + 3))
    row = np.empty(TERMS)
    row[0] = 1.0
    count = 0
    square = 0.0
    for v in range(int(np.ceil(cv - half_v)), int(np.floor(cv + half_v)) + 1):
        y = v - cv
        for u in range(int(np.ceil(cu - half_u)), int(np.floor(cu + half_u)) + 1):
            x = u - cu
            q = x * (q11 * x + 2.0 * q12 * y) + q22 * y * y
            if q > INNER:
                continue
            level = float(image[v, u])
            if dark:
                level = 255.0 - level
            level -= background + contrast
            row[1], row[2], row[3], row[4], row[5], row[6] = x, y, x * x, x * y, y * y, q * q
            for i in range(TERMS):
                for j in range(i, TERMS):
                    A[i, j] += row[i] * row[j]
                A[i, TERMS] += row[i] * level
            square += level * level
            count += 1
    out[BRIGHT] = -1.0
    out[SLOPE], out[SLOPE + 1] = 0.0, 0.0
    out[SLOPE_XX], out[SLOPE_XY], out[SLOPE_YY] = EVEN, 0.0, EVEN
    if count < MIN_INNER:
        return
    A[1, TERMS + 1] = A[2, TERMS + 2] = 1.0
    right = A[:, TERMS].copy()
    for i in range(TERMS):
        for j in range(i):
            A[i, j] = A[j, i]
    for i in range(TERMS):
        # positive definite: no pivoting
        if A[i, i] < 1e-9:
            return
        f = 1.0 / A[i, i]
        for j in range(TERMS + 3):
            A[i, j] *= f
        for k in range(TERMS):
            if k != i and A[k, i] != 0.0:
                g = A[k, i]
                for j in range(TERMS + 3):
                    A[k, j] -= g * A[i, j]
    even = -right[0] * right[0] / count
    for i in range(TERMS):
        square -= A[i, TERMS] * right[i]
        if i not in (1, 2):
            even += A[i, TERMS] * right[i]
    square -= UNLIKE_EVEN * UNLIKE_EVEN * max(even, 0.0)
    out[BRIGHT] = max(square, 0.0) / (count - TERMS)
    level = contrast + A[0, TERMS]
    out[SLOPE], out[SLOPE + 1] = A[1, TERMS] / level, A[2, TERMS] / level
    f = 1.0 / (level * level)
    out[SLOPE_XX], out[SLOPE_XY], out[SLOPE_YY] = (
        f * A[1, TERMS + 1],
        f * A[1, TERMS + 2],
        f * A[2, TERMS + 2],
    )
