"""Acceptance of the measured dots of a face: completeness, agreement with the prior, homography. Numba kernels."""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.compilation import kernel
from stereoservo_drivers.detectors.centroids import smaller_half_axis
from stereoservo_drivers.detectors.components import (
    BRIGHT,
    BXX,
    BYY,
    CONTRAST,
    CXX,
    CYY,
    EXX,
    EYY,
    LOPSIDED,
    LOPSIDED_NOISE,
    NOISE,
    QXX,
    QXY,
    QYY,
)
from stereoservo_drivers.detectors.homographies import (
    OutlierGates,
    fit_homography,
    image_of_circle,
    outlier_dot,
    reject_outliers,
)
from stereoservo_drivers.detectors.levels import UNEVEN_INSIDE
from stereoservo_drivers.detectors.lighting import flat_field

THINNEST = 1.0
"""Half axis [px] below which a dot is too thin to measure."""
FEW_TOLERANCE = 0.7
"""How far four or five dots of a face may lie from their predictions, up to a similarity [px]."""


SHAPE = 7
"""Columns of an expected dot, as :func:`~stereoservo_drivers.detectors.homographies.image_of_circle` writes
them.
"""


@kernel
def whole(dot, lopsided):
    """Whether a measurement (FIELDS,) is of a complete dot: not cut off, not merged with something else."""
    thin = smaller_half_axis(dot[QXX], dot[QXY], dot[QYY])
    # thin dots suffer from sampling: measured 0.04 at 2 px, 0.13 at 1.4 px
    limit = lopsided + np.exp(-1.4 * thin) + 2.5 * dot[LOPSIDED_NOISE] * np.sqrt(max(dot[NOISE], 0.08))
    return dot[LOPSIDED] < limit


@kernel
def median(values, used):
    """The median of ``values`` (n,) that are ``used`` (n,), the lower one of two; 0 where none is."""
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
    """Whether dots (n, FIELDS) lie on their predictions (n, 2) up to a similarity, within ``tolerance`` [px].

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
    """Check a face's dots (n, FIELDS) against one homography and move them from the ellipses' centres to
    the dots' own.

    Uneven light is taken back. A dot whose light differs from the others' by so much that it may be off by more than
    ``tolerance`` [px], half hidden or run into by something, is left out: nothing could tell whether it fits. Rows of
    ``used`` that do not fit the others are cleared (of five or more; four are taken as they are); all are, where fewer
    than ``least`` remain beside the one left out. The picture of a circle's centre is not the centre
    of its picture; the face's homography tells the difference, no camera needed. Returns the number that remains.
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
    # twice: a first shift under the homography of the ellipses' centres, which hardly differs, then the
    # checked one
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
        # it may be the others' print: it stays, as uncertain as it is odd
        dots[odd, EXX] += away[odd, 0] ** 2
        dots[odd, EYY] += away[odd, 0] ** 2
    # dots that touch others helped to find the face; they are worth reporting only where they are needed
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
