"""Grey levels of a dot and of its surroundings: noise, slopes, background. Numba kernels; no state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.compilation import kernel, reassociating_kernel
from stereoservo_drivers.detectors.components import (
    BRIGHT,
    LEVEL,
    NOTHING,
    QXX,
    QXY,
    QYY,
    SLOPE,
    SLOPE_XX,
    SLOPE_XY,
    SLOPE_YY,
    VALID,
    F,
    Pixels,
    V,
    X,
    Y,
    half_sizes,
    lanes,
)
from stereoservo_drivers.detectors.homographies import lower_root

RING = 2
"""Width [px] of the surroundings outside the skirt used for background and noise."""
INNER = 0.6
"""Part of the ellipse's area used for slope and noise."""
MIN_INNER = 18
"""Least number of its pixels for an estimate."""
TERMS = 7
"""Number of terms of the levels inside, listed in :func:`inside`."""
UNEVEN_INSIDE = 0.005
"""Residual of a dot's own shape after these terms, as a share of its contrast: not noise."""
UNLIKE_EVEN = 0.09
"""The same as a share of the even terms: blur and motion that reach far into the dot (measured: 0.03 to 0.1)."""
EVEN = 1e6
"""Variance [1/px²] of an unknown slope."""


class Surface(NamedTuple):
    """Levels around a dot: a plane and the tail of its blur, and the ``variance`` about them; -1 if there are none.

    ``plane_level``: that of the plane under the centre if the tail is not fitted; ``count`` of pixels.
    """

    variance: float
    plane_level: float
    count: float
    level: float
    slope_x: float
    slope_y: float
    slope_t: float


NO_SURFACE = Surface(-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@kernel
def _fit_surface(sums):
    """Least squares by the moments ``sums`` (15): first the plane, then the tail from the plane's residuals."""
    n = sums[0]
    if n < 24.0:
        return NO_SURFACE
    si, sx, sy, st = sums[1], sums[2], sums[3], sums[10]
    sxx = sums[4] - sx * sx / n
    sxy = sums[5] - sx * sy / n
    syy = sums[6] - sy * sy / n
    sxi = sums[7] - sx * si / n
    syi = sums[8] - sy * si / n
    sii = sums[9] - si * si / n
    d = sxx * syy - sxy * sxy
    if d <= 0.0:
        return NO_SURFACE
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
    return Surface(max(left, 0.0) / (n - 4.0), plane_level, n, level, slope_x, slope_y, slope_t)


class Band(NamedTuple):
    """The levels within ``limit`` of a surface, as `Surface` has it."""

    level: float
    slope_x: float
    slope_y: float
    slope_t: float
    limit: float


@reassociating_kernel
def _ring_moments(pixels, valid, ellipse, box, band, sums):
    """Sums over the VALID pixels of a ``box`` (its centre and half size in x, then in y) outside an ellipse's skirt,
    with levels in a ``band``: 1, level, x, y, x², xy, y², x level, y level, level², tail, tail x, tail y, tail², tail
    level; into ``sums`` (15,).
    """
    level, xs, ys = pixels
    q11, q12, q22, cx, cy, skirt = ellipse
    width, inner = F(4.0) * skirt * skirt, skirt * skirt
    # the tail decreases like a Gaussian's: (1 - (δ² - skirt²) / ((skirt + RING)² - skirt²))³
    fall = F(1.0) / ((skirt + F(RING)) * (skirt + F(RING)) - inner)
    base, slope_x, slope_y, slope_t, limit = band
    si = sx = sy = sxx = sxy = syy = sxi = syi = sii = st = stx = sty = stt = sti = count = F(0.0)
    for k in range(level.size):
        x, y, i, one = xs[k] - cx, ys[k] - cy, level[k], valid[k]
        gx = q11 * x + q12 * y
        gy = q12 * x + q22 * y
        e = max(x * gx + y * gy - F(1.0), F(0.0))
        g2 = gx * gx + gy * gy + NOTHING
        e *= e
        tail = max(F(1.0) - (F(0.25) * e / g2 - inner) * fall, F(0.0))
        tail = tail * tail * tail
        away = abs(i - base - slope_x * x - slope_y * y - slope_t * tail)
        one = one if e >= width * g2 and abs(xs[k] - box[0]) <= box[1] else F(0.0)
        one = one if away <= limit and abs(ys[k] - box[2]) <= box[3] else F(0.0)
        mx, my, mt, mi = one * x, one * y, one * tail, one * i
        count += one
        si += mi
        sx += mx
        sy += my
        sxx += mx * x
        sxy += mx * y
        syy += my * y
        sxi += mx * i
        syi += my * i
        sii += mi * i
        st += mt
        stx += mt * x
        sty += mt * y
        stt += mt * tail
        sti += mt * i
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6] = count, si, sx, sy, sxx, sxy, syy
    sums[7], sums[8], sums[9], sums[10] = sxi, syi, sii, st
    sums[11], sums[12], sums[13], sums[14] = stx, sty, stt, sti


@kernel
def surroundings(patch, planes, box, ellipse, limit):
    """The surface around a dot's ``ellipse`` in a ``box`` of a patch; its variance [levels²] is -1 if too little is
    visible.

    Pixels that deviate by more than ``limit``, then by more than three standard deviations (a neighbour's skirt, the
    plate's edge), are excluded.
    """
    left, top, right, bottom = box
    a, b = lanes(patch, max(top, patch.top), min(bottom, patch.bottom))
    middle = (
        F(0.5 * (left + right) - patch.left),
        F(0.5 * (right - left)),
        F(0.5 * (top + bottom) - patch.top),
        F(0.5 * (bottom - top)),
    )
    pixels, valid = Pixels(planes[LEVEL, a:b], planes[X, a:b], planes[Y, a:b]), planes[VALID, a:b]
    fit, sums = Surface(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), np.empty(15)
    for _ in range(2):
        band = Band(F(fit.level), F(fit.slope_x), F(fit.slope_y), F(fit.slope_t), F(limit))
        _ring_moments(pixels, valid, ellipse, middle, band, sums)
        fit = _fit_surface(sums)
        if fit.variance < 0.0:
            return NO_SURFACE
        limit = 3.0 * np.sqrt(fit.variance) + 0.5
    # the part of a Gaussian within three standard deviations has 0.973 of its variance
    variance = fit.variance / 0.973 if fit.variance > 1.0 else fit.variance
    return Surface(variance, fit.plane_level, fit.count, fit.level, fit.slope_x, fit.slope_y, fit.slope_t)


@reassociating_kernel
def _inner_moments(pixels, ellipse, base, A, right):
    """Sums over the pixels with q = dᵀQd up to INNER: products of 1, x², xy, y², q², x, y with each other into the
    lower triangle of ``A`` (7, 7), with the level above ``base`` into ``right`` (7,). Returns the number of pixels and
    the sum of that level squared.
    """
    level, xs, ys = pixels
    q11, q12, q22, cx, cy, _ = ellipse
    n = p = r = s = t = u = v = pp = pr = rr = rs = ss = pt = rt = st = tt = F(0.0)
    tu = tv = pu = pv = su = sv = l1 = lp = lr = ls = lt = lu = lv = ll = F(0.0)
    for k in range(level.size):
        x, y = xs[k] - cx, ys[k] - cy
        q = x * (q11 * x + F(2.0) * q12 * y) + q22 * y * y
        one = F(1.0) if q <= F(INNER) else F(0.0)
        i = level[k] - base
        xx, xy, yy, qq = x * x, x * y, y * y, q * q
        mx, my, mi, mt = one * x, one * y, one * i, one * qq
        mxx, mxy, myy = one * xx, one * xy, one * yy
        n += one
        p += mxx
        r += mxy
        s += myy
        t += mt
        u += mx
        v += my
        pp += mxx * xx
        pr += mxx * xy
        rr += mxx * yy
        rs += mxy * yy
        ss += myy * yy
        pt += mt * xx
        rt += mt * xy
        st += mt * yy
        tt += mt * qq
        tu += mt * x
        tv += mt * y
        pu += mxx * x
        pv += mxx * y
        su += myy * x
        sv += myy * y
        l1 += mi
        lp += mi * xx
        lr += mi * xy
        ls += mi * yy
        lt += mi * qq
        lu += mi * x
        lv += mi * y
        ll += mi * i
    A[0, 0] = n
    A[1, 0], A[1, 1] = p, pp
    A[2, 0], A[2, 1], A[2, 2] = r, pr, rr
    A[3, 0], A[3, 1], A[3, 2], A[3, 3] = s, rr, rs, ss
    A[4, 0], A[4, 1], A[4, 2], A[4, 3], A[4, 4] = t, pt, rt, st, tt
    A[5, 0], A[5, 1], A[5, 2], A[5, 3], A[5, 4], A[5, 5] = u, pu, pv, su, tu, p
    A[6, 0], A[6, 1], A[6, 2], A[6, 3], A[6, 4], A[6, 5], A[6, 6] = v, pv, su, sv, tv, r, s
    right[0], right[1], right[2], right[3], right[4], right[5], right[6] = l1, lp, lr, ls, lt, lu, lv
    return n, ll


@kernel
def inside(patch, planes, ellipse, contrast, out):
    """Write to ``out`` the relative slope of the level inside a dot with its covariance under unit noise, and the noise
    there.

    Least squares of the levels on 1, x², xy, y², q², x, y with q = dᵀQd < INNER: the even terms absorb the effect of
    blur and motion on a small dot.
    """
    out[BRIGHT] = -1.0
    out[SLOPE], out[SLOPE + 1] = 0.0, 0.0
    out[SLOPE_XX], out[SLOPE_XY], out[SLOPE_YY] = EVEN, 0.0, EVEN
    _, half_v = half_sizes(out[QXX], out[QXY], out[QYY])
    half_v *= np.sqrt(INNER)
    a, b = lanes(patch, int(np.ceil(out[V] - half_v)), int(np.floor(out[V] + half_v)))
    A = np.empty((TERMS + 2, TERMS))
    right, z = A[TERMS], A[TERMS + 1]
    pixels = Pixels(planes[LEVEL, a:b], planes[X, a:b], planes[Y, a:b])
    count, squares = _inner_moments(pixels, ellipse, F(contrast), A, right)
    if count < MIN_INNER or not lower_root(A[:TERMS]):
        return
    square = np.float64(squares)
    for i in range(TERMS):
        z[i] = right[i]
        for j in range(i):
            z[i] -= A[i, j] * z[j]
        z[i] /= A[i, i]
        square -= z[i] * z[i]
    even = -right[0] * right[0] / count
    for i in range(TERMS - 1, -1, -1):
        for j in range(i + 1, TERMS):
            z[i] -= A[j, i] * z[j]
        z[i] /= A[i, i]
        if i < TERMS - 2:
            even += z[i] * right[i]
    square -= UNLIKE_EVEN * UNLIKE_EVEN * max(even, 0.0)
    out[BRIGHT] = max(square, 0.0) / (count - TERMS)
    mean = contrast + z[0]
    out[SLOPE], out[SLOPE + 1] = z[TERMS - 2] / mean, z[TERMS - 1] / mean
    p, q, r = A[TERMS - 2, TERMS - 2], A[TERMS - 1, TERMS - 2], A[TERMS - 1, TERMS - 1]
    f = 1.0 / (mean * mean * p * p * r * r)
    out[SLOPE_XX], out[SLOPE_XY], out[SLOPE_YY] = f * (q * q + r * r), -f * p * q, f * p * p
