"""Acceptance of the measured dots of a face: completeness, agreement with the prior, homography. Numba kernels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo_drivers.detectors.centroids import smaller_half_axis
from stereoservo_drivers.detectors.components import (
    AREA,
    BACKGROUND,
    BRIGHT,
    BXX,
    BYY,
    CONTRAST,
    CXX,
    CYY,
    DARK,
    EXX,
    EXY,
    EYY,
    FLUX,
    FLUX_NOISE,
    LIT,
    LOPSIDED,
    LOPSIDED_NOISE,
    NOISE,
    PULL,
    QXX,
    QXY,
    QYY,
    SLOPE,
    SLOPE_XX,
    SLOPE_XY,
    SLOPE_YY,
    Matrix2,
    Symmetric2,
)
from stereoservo_drivers.detectors.homographies import (
    OutlierGates,
    fit_homography,
    image_of_circle,
    outlier_dot,
    reject_outliers,
)
from stereoservo_drivers.detectors.levels import EVEN, UNEVEN_INSIDE

THINNEST = 1.0
"""Half axis [px] below which a dot is too thin to measure."""
FEW_TOLERANCE = 0.7
"""Largest distance of four or five dots of a face from their predictions, up to a similarity [px]."""


SHAPE = 7
"""Columns of an expected dot, as :func:`~stereoservo_drivers.detectors.homographies.image_of_circle` writes
them.
"""


@kernel
def whole(dot, lopsided):
    """Whether a measurement (FIELDS,) is of a complete dot: not clipped, not merged with something else."""
    thin = smaller_half_axis(dot[QXX], dot[QXY], dot[QYY])
    # thin dots suffer from sampling: measured 0.04 at 2 px, 0.13 at 1.4 px
    limit = lopsided + np.exp(-1.4 * thin) + 2.5 * dot[LOPSIDED_NOISE] * np.sqrt(max(dot[NOISE], 0.08))
    return dot[LOPSIDED] < limit


@kernel
def median(values, used):
    """The median of ``values`` (n,) that are ``used`` (n,), the lower one of two; 0 if none is used."""
    chosen = np.empty(values.size)
    n = 0
    for i in range(values.size):
        if used[i]:
            k = n
            while k > 0 and chosen[k - 1] > values[i]:
                chosen[k] = chosen[k - 1]
                k -= 1
            chosen[k] = values[i]
            n += 1
    return chosen[(n - 1) // 2] if n else 0.0


@kernel
def agree_with_prior(predicted, dots, used, tolerance):
    """Whether dots (n, FIELDS) agree with their predictions (n, 2) up to a similarity, within ``tolerance`` [px].

    For faces with too few dots to check one another: a prior may be off, but smoothly.
    """
    n = 0
    mean = np.zeros(4)
    for i in range(used.size):
        if used[i]:
            n += 1
            mean[0] += predicted[i, 0]
            mean[1] += predicted[i, 1]
            mean[2] += dots[i, 0]
            mean[3] += dots[i, 1]
    mean /= n
    spread = a = b = 0.0
    for i in range(used.size):
        if used[i]:
            x, y = predicted[i, 0] - mean[0], predicted[i, 1] - mean[1]
            u, v = dots[i, 0] - mean[2], dots[i, 1] - mean[3]
            spread += x * x + y * y
            a += x * u + y * v
            b += x * v - y * u
    if spread <= 0.0:
        return False
    a /= spread
    b /= spread
    for i in range(used.size):
        if used[i]:
            x, y = predicted[i, 0] - mean[0], predicted[i, 1] - mean[1]
            u, v = dots[i, 0] - mean[2], dots[i, 1] - mean[3]
            if (a * x - b * y - u) ** 2 + (b * x + a * y - v) ** 2 > tolerance * tolerance:
                return False
    return True


@kernel
def _remove_shift(pattern, radius, raw, used, H, dots):
    """``dots`` = ``raw`` minus the offset of the ellipse's centre from the image of the dot's centre."""
    circle = np.zeros(7)
    for i in range(used.size):
        if used[i]:
            if image_of_circle(H, pattern[i, 0], pattern[i, 1], radius, circle):
                dots[i, 0] = raw[i, 0] - circle[2]
                dots[i, 1] = raw[i, 1] - circle[3]
            else:
                used[i] = False


@kernel
def _deviation(dots, used, dark, bright):
    """Standard deviation [px] of a dot that is ``used`` (n,), in the mean, for noise variances on black and white."""
    variance, count = 0.0, 0
    for i in range(used.size):
        if used[i]:
            own, light = dots[i, CXX] + dots[i, CYY], dots[i, BXX] + dots[i, BYY]
            variance += 0.5 * (dark * (own - light) + bright * light + dots[i, EXX] + dots[i, EYY])
            count += 1
    return np.sqrt(max(variance, 0.0) / max(count, 1))


@kernel
def settle_face(pattern, radius, dots, used, tolerance, least):
    """Check a face's dots (n, FIELDS) against one homography and move them from the ellipses' centres to the dots' own.

    Uneven light is compensated. A dot whose light differs from the others' so much that it may be displaced by more
    than ``tolerance`` [px], half hidden or touched by something, is left out: its fit could not be verified. Rows of
    ``used`` that do not fit the others are cleared (of five or more; four are accepted as they are); all are, if fewer
    than ``least`` remain besides the one left out. The image of a circle's centre is not the centre of its image; the
    face's homography determines the difference, without a camera model. Returns the number that remains.
    """
    n = pattern.shape[0]
    H = np.zeros((3, 3))
    raw = dots[:, :2].copy()
    count = 0
    for i in range(n):
        count += 1 if used[i] else 0
    if count < least or not fit_homography(pattern, dots, used, H):
        used[:] = False
        return 0
    clear = np.zeros(n, np.bool_)
    for i in range(n):
        clear[i] = used[i] and dots[i, EXX] == 0.0
    areas = np.ones(n)
    circle = np.zeros(SHAPE)
    for i in range(n):
        if used[i]:
            if not image_of_circle(H, pattern[i, 0], pattern[i, 1], radius, circle):
                used[:] = False
                return 0
            areas[i] = circle[4]
    dark = max(median(dots[:, NOISE], used), 0.08)
    tolerance_inside = UNEVEN_INSIDE * median(dots[:, CONTRAST], used)
    inside = max(median(dots[:, BRIGHT], used), dark)
    bright = max(inside - tolerance_inside * tolerance_inside, dark)
    # slopes inside have that misfit, too
    unlike = flat_field(areas, used, dark, inside, dots, raw)
    if unlike >= 0 and min(dots[unlike, EXX], dots[unlike, EYY]) > tolerance * tolerance:
        used[unlike] = False
        count -= 1
        least = min(least, count)
    for i in range(n):
        if used[i]:
            dots[i, 0] = raw[i, 0]
            dots[i, 1] = raw[i, 1]
    sigma = _deviation(dots, used, dark, bright)
    # twice: first with the homography of the ellipses' centres, which hardly differs, then with the checked one
    for step in range(2):
        if step == 1 and count >= 5:
            if not reject_outliers(pattern, dots, used, OutlierGates(tolerance, sigma, max(least, 5)), H):
                used[:] = False
                return 0
        elif not fit_homography(pattern, dots, used, H):
            used[:] = False
            return 0
        _remove_shift(pattern, radius, raw, used, H, dots)
    away = np.zeros((n, 3))
    odd = outlier_dot(pattern, dots, used, sigma, away)
    if odd >= 0:
        # it may be caused by the others' print: it is kept, with an uncertainty as large as its deviation
        dots[odd, EXX] += away[odd, 0] ** 2
        dots[odd, EYY] += away[odd, 0] ** 2
    # dots that touch others helped to find the face; they are reported only if they are needed
    count = 0
    for i in range(n):
        count += 1 if used[i] and clear[i] else 0
    if count >= 4:
        for i in range(n):
            used[i] = used[i] and clear[i]
        return count
    count = 0
    for i in range(n):
        count += 1 if used[i] else 0
    return count


# -- lighting ------------------------------------------------------------------------------------------------
# Correction of the dots' centres for uneven light (shading). Numba kernels; no state.
#
# The light on a dot has background b(x) and contrast g(x); to first order a slope of either shifts the centroid, by the
# columns DARK and LIT of its measurement. Both slopes are those of planes through the face's dots, whose predicted
# areas convert flux into contrast; a single dot that fits badly (cut, dirty) is ignored. The distance of the others
# from the plane measures the curvature of the light, and so the uncertainty of its slope at a dot; if that is large
# (bands of mains light, the edge of a shadow), the slope inside the dot itself has more weight, by their variances.


BEND = 0.24
"""Length over which light deviates from its plane as much as the dots do, in rms distances of a face's dots."""
PRINT_CONTRAST = 0.001
"""Prior relative standard deviation of the light of equal dots, before any is seen; also of predicted areas."""
PRINT_BACKGROUND = 0.03
"""The same of backgrounds [grey levels]."""
ODD_NOISE, ODD_REST = 25.0, 150.0
"""Numbers of variances beyond which a dot is an outlier: of noise, and of the others' differences (F of 1 and 3 degrees
of freedom, 0.999).
"""
SAMPLED_SLOPE = 0.018
"""Standard deviation of a slope seen inside a dot caused by the sampling of its edge, times the root of its area
(measured).
"""
BLURRED_SLOPE = 0.12
"""Relative change of a slope seen inside a dot that blur may have caused."""
PRIOR_WEIGHT = 2.0
"""Weight of either of these priors in degrees of freedom."""


class DotReadings(NamedTuple):
    """Measured values of the ``dots`` (n, FIELDS) of a face: ``values`` (n,), which count where ``used`` (n,)."""

    dots: FloatArray
    values: FloatArray
    used: BoolArray


@kernel
def _plane(readings, out):
    """Least-squares plane a + b·x of `DotReadings` over the dots.

    ``out``: centroid (2), a, slope (2), its covariance (3) and the squared sum of residuals, both for unit noise; rms
    distance from the centroid. Returns False if it is undetermined.
    """
    dots, values, used = readings
    n = 0
    out[:] = 0.0
    for i in range(used.size):
        if used[i]:
            n += 1
            out[0] += dots[i, 0]
            out[1] += dots[i, 1]
            out[2] += values[i]
    if n < 4:
        return False
    out[0] /= n
    out[1] /= n
    out[2] /= n
    xx = xy = yy = xi = yi = 0.0
    for i in range(used.size):
        if used[i]:
            x, y, value = dots[i, 0] - out[0], dots[i, 1] - out[1], values[i] - out[2]
            xx += x * x
            xy += x * y
            yy += y * y
            xi += x * value
            yi += y * value
    det = xx * yy - xy * xy
    if det < 1e-6 * (xx + yy) ** 2:
        return False
    out[3] = (yy * xi - xy * yi) / det
    out[4] = (xx * yi - xy * xi) / det
    out[5], out[6], out[7] = yy / det, -xy / det, xx / det
    out[9] = np.sqrt((xx + yy) / n)
    for i in range(used.size):
        if used[i]:
            out[8] += _residual(dots[i], values[i], out) ** 2
    return True


@kernel
def _residual(dot, value, plane):
    return value - plane[2] - plane[3] * (dot[0] - plane[0]) - plane[4] * (dot[1] - plane[1])


@kernel
def _outlier(readings, variance, plane):
    """The dot whose value contradicts the plane of the others, -1 for none; ``plane`` becomes that of the others."""
    dots, values, used = readings
    n = 0
    for i in range(used.size):
        n += 1 if used[i] else 0
    if n < 6:
        return -1
    worst, largest = -1, 1.0
    for i in range(used.size):
        if used[i]:
            x, y = dots[i, 0] - plane[0], dots[i, 1] - plane[1]
            leverage = 1.0 / n + plane[5] * x * x + 2.0 * plane[6] * x * y + plane[7] * y * y
            if leverage > 0.95:
                continue
            square = _residual(dots[i], values[i], plane) ** 2 / (1.0 - leverage)
            rest = max(plane[8] - square, 0.0) / (n - 4)
            limit = ODD_NOISE * variance + ODD_REST * max(rest - variance, 0.0)
            if square > largest * limit:
                largest = square / limit
                worst = i
    if worst >= 0:
        used[worst] = False
        if not _plane(readings, plane):
            used[worst] = True
            _plane(readings, plane)
            return -1
    return worst


@kernel
def _known(readings, variance, typical, plane, slope):
    """Write the slope (2) of `DotReadings` and its covariance (3) at any of the dots to ``slope``; returns the outlier
    dot, -1 for none.

    ``variance`` of a value by noise; ``typical``: further standard deviation. Returns -2 if there is no plane.
    """
    mine = readings.used.copy()
    own_readings = DotReadings(readings.dots, readings.values, mine)
    if not _plane(own_readings, plane):
        return -2
    outlier = _outlier(own_readings, variance + typical * typical, plane)
    n = 0
    for i in range(mine.size):
        n += 1 if mine[i] else 0
    own = max(plane[8] - (n - 3) * variance, 0.0) + PRIOR_WEIGHT * typical * typical
    bend = own / (n - 3 + PRIOR_WEIGHT)
    local = bend / (BEND * plane[9]) ** 2
    slope[0], slope[1] = plane[3], plane[4]
    slope[2] = local + (bend + variance) * plane[5]
    slope[3] = (bend + variance) * plane[6]
    slope[4] = local + (bend + variance) * plane[7]
    return outlier


@kernel
def _as_bright_as_its_light(dots, areas, used, i, away):
    """Whether the flux of dot ``i``, which differs by ``away`` (relative) from the others', is explained by its light
    and not its shape.
    """
    others = 0.0
    count = 0
    for k in range(used.size):
        if used[k] and k != i:
            others += dots[k, FLUX] / (areas[k] * dots[k, CONTRAST])
            count += 1
    shape = dots[i, FLUX] / (areas[i] * dots[i, CONTRAST]) * count / others - 1.0
    return abs(shape) < 0.4 * abs(away)


@kernel
def _bend_inside(dots, used, slope, noise):
    """Variance [1/px²] of the dots' own slopes about their face's; 0 if it may be noise (3 sigma) or sampling."""
    n = squares = variances = largest = sampled = 0.0
    for i in range(used.size):
        if used[i] and dots[i, SLOPE_XX] < 0.5 * EVEN:
            n += 2.0
            squares += (dots[i, SLOPE] - slope[0]) ** 2 + (dots[i, SLOPE + 1] - slope[1]) ** 2
            sampled += 2.0 * SAMPLED_SLOPE * SAMPLED_SLOPE / dots[i, AREA]
            variances += noise * (dots[i, SLOPE_XX] + dots[i, SLOPE_YY])
            largest = max(largest, noise * max(dots[i, SLOPE_XX], dots[i, SLOPE_YY]))
    if n < 6.0:
        return 0.0
    excess = squares - variances
    return excess / n if excess > 3.0 * max(np.sqrt(2.0 * variances * largest), sampled) else 0.0


@kernel
def _add_covariance(dot, M, P):
    """Add M P Mᵀ to a dot's covariance, of a `Matrix2` and a `Symmetric2`."""
    a, b, c, d = M
    p, q, r = P
    dot[EXX] += a * a * p + 2.0 * a * b * q + b * b * r
    dot[EXY] += a * c * p + (a * d + b * c) * q + b * d * r
    dot[EYY] += c * c * p + 2.0 * c * d * q + d * d * r


@kernel
def _follow(dot, slope, noise, ground, moved):
    """Remove the slope of the light at one dot; ``slope`` (5,) is that of its face, ``noise`` inside the dot,
    ``ground`` the part of the background that slopes with it.
    """
    p, q, r = slope[2], slope[3], slope[4]
    sampled = SAMPLED_SLOPE * SAMPLED_SLOPE / dot[AREA]
    sxx, sxy, syy = noise * dot[SLOPE_XX] + sampled, noise * dot[SLOPE_XY], noise * dot[SLOPE_YY] + sampled
    a, b, d = p + sxx, q + sxy, r + syy
    det = a * d - b * b
    s0, s1 = slope[0], slope[1]
    k00 = k01 = k10 = k11 = 0.0
    if dot[BRIGHT] >= 0.0 and sxx < 0.5 * EVEN and det > 0.0:
        # gain P (P + S)⁻¹ of the dot's own slope over its face's
        k00, k01 = (p * d - q * b) / det, (q * a - p * b) / det
        k10, k11 = (q * d - r * b) / det, (r * a - q * b) / det
        e0, e1 = dot[SLOPE] - s0, dot[SLOPE + 1] - s1
        s0 += k00 * e0 + k01 * e1
        s1 += k10 * e0 + k11 * e1
    ground *= dot[BACKGROUND]
    g00, g01 = dot[LIT] + ground * dot[DARK], dot[LIT + 1] + ground * dot[DARK + 1]
    g10, g11 = dot[LIT + 2] + ground * dot[DARK + 2], dot[LIT + 3] + ground * dot[DARK + 3]
    G = Matrix2(g00, g01, g10, g11)
    if ground > 0.0:
        t0, t1 = BLURRED_SLOPE * s0, BLURRED_SLOPE * s1
        _add_covariance(dot, G, Symmetric2(t0 * t0, t0 * t1, t1 * t1))
    # (1 - K) P
    _add_covariance(dot, G, Symmetric2(p - k00 * p - k01 * q, q - k00 * q - k01 * r, r - k10 * q - k11 * r))
    # the dot's own slope and its centre share noise: -(X Kᵀ Gᵀ + G K Xᵀ)
    m00, m01 = g00 * k00 + g01 * k10, g00 * k01 + g01 * k11
    m10, m11 = g10 * k00 + g11 * k10, g10 * k01 + g11 * k11
    x00, x01 = noise * dot[PULL], noise * dot[PULL + 1]
    x10, x11 = noise * dot[PULL + 2], noise * dot[PULL + 3]
    dot[EXX] -= 2.0 * (m00 * x00 + m01 * x01)
    dot[EXY] -= m00 * x10 + m01 * x11 + m10 * x00 + m11 * x01
    dot[EYY] -= 2.0 * (m10 * x10 + m11 * x11)
    moved[0] -= g00 * s0 + g01 * s1
    moved[1] -= g10 * s0 + g11 * s1


@kernel
def flat_field(areas, used, dark_noise, bright_noise, dots, moved):
    """Correct the centres ``moved`` (n, 2) of a face's ``dots`` (n, FIELDS) for uneven light.

    ``areas`` (n,) [px²] as predicted by the face's homography. Adds the remaining uncertainty to EXX .. EYY: the
    slopes, and for a dot whose light does not fit the others', the shift that the missing part of its rim would cause.
    Returns that dot's row, -1 if there is none.
    """
    n = used.size
    values = np.zeros(n)
    slope = np.zeros(5)
    plane = np.zeros(10)
    total = flux_noise = 0.0
    count = 0
    for i in range(n):
        if used[i]:
            values[i] = dots[i, FLUX] / areas[i]
            total += values[i]
            flux_noise += (dots[i, FLUX_NOISE] / dots[i, FLUX]) ** 2
            count += 1
    if count == 0 or total <= 0.0:
        return -1
    for i in range(n):
        values[i] *= count / total
    readings = DotReadings(dots, values, used)
    outlier = _known(readings, dark_noise * flux_noise / count, PRINT_CONTRAST, plane, slope)
    if outlier >= 0 and _as_bright_as_its_light(
        dots, areas, used, outlier, _residual(dots[outlier], values[outlier], plane)
    ):
        outlier = -1
    if outlier >= -1:
        bend = _bend_inside(dots, used, slope, bright_noise)
        slope[2] += bend
        slope[4] += bend
        for i in range(n):
            if used[i]:
                _follow(dots[i], slope, bright_noise, 1.0 if bend > 0.0 else 0.0, moved[i])
        if outlier >= 0:
            away = _residual(dots[outlier], values[outlier], plane) ** 2 * dots[outlier, AREA] / np.pi
            dots[outlier, EXX] += away
            dots[outlier, EYY] += away
        if bend > 0.0:
            # light that varies within a dot's size does so on black as well as on white
            return max(outlier, -1)
    for i in range(n):
        values[i] = dots[i, BACKGROUND]
    # the level of some sixty pixels
    if _known(readings, dark_noise / 60.0, PRINT_BACKGROUND, plane, slope) >= -1:
        for i in range(n):
            if used[i]:
                dot = dots[i]
                moved[i, 0] -= dot[DARK] * slope[0] + dot[DARK + 1] * slope[1]
                moved[i, 1] -= dot[DARK + 2] * slope[0] + dot[DARK + 3] * slope[1]
                shift = Matrix2(dot[DARK], dot[DARK + 1], dot[DARK + 2], dot[DARK + 3])
                _add_covariance(dot, shift, Symmetric2(slope[2], slope[3], slope[4]))
    return max(outlier, -1)
