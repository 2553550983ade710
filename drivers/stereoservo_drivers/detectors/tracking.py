"""Tracking: one face's dots in windows placed by a prior. Numba kernels; no state."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import njit

from stereoservo_drivers.detectors.centroids import (
    AREA,
    CONTRAST,
    CXX,
    CYY,
    LOPSIDED,
    LOPSIDED_NOISE,
    NOISE,
    OK,
    QXX,
    QXY,
    QYY,
    measure,
    smaller_half_axis,
)
from stereoservo_drivers.detectors.patterns import drop_strangers, fit_homography, image_of_circle

MIN_HALF_WINDOW = 14
MAX_HALF_WINDOW = 64
SHAPE_MARGIN = 6
"""Pixels between a dot's expected outline and the rim of its window, beside the prior's uncertainty."""
THINNEST = 1.0
"""Half axis [px] below which a dot is too thin to measure."""

FEW_TOLERANCE = 0.7
"""How far four or five dots of a face may lie from their predictions, up to a similarity [px]."""

Measurements = npt.NDArray[np.float64]


@njit(cache=True)
def measure_windows(image, dark, windows, near, min_contrast, min_area, labels, stack, out):  # type: ignore[no-untyped-def]
    """:func:`measure` over windows (k, 4) about points (k, 2); returns the statuses (k,)."""
    status = np.zeros(windows.shape[0], np.int64)
    for k in range(windows.shape[0]):
        u0, v0, u1, v1 = windows[k, 0], windows[k, 1], windows[k, 2], windows[k, 3]
        status[k] = measure(
            image, dark, u0, v0, u1, v1, near[k, 0], near[k, 1], min_contrast, min_area, labels, stack, out[k]
        )
    return status


@njit(cache=True)
def _is_whole(dot, lopsided):  # type: ignore[no-untyped-def]
    thin = smaller_half_axis(dot[QXX], dot[QXY], dot[QYY])
    # thin dots suffer from sampling: measured 0.04 at 2 px, 0.13 at 1.4 px
    limit = lopsided + np.exp(-1.4 * thin) + 2.5 * dot[LOPSIDED_NOISE] * np.sqrt(max(dot[NOISE], 0.08))
    return dot[LOPSIDED] < limit


@njit(cache=True)
def whole(dots, lopsided):  # type: ignore[no-untyped-def]
    """Which measurements (k, FIELDS) are of whole dots: not cut, not merged with something else."""
    result = np.zeros(dots.shape[0], np.bool_)
    for k in range(dots.shape[0]):
        result[k] = _is_whole(dots[k], lopsided)
    return result


@njit(cache=True)
def _median(values, used):  # type: ignore[no-untyped-def]
    chosen = np.sort(values[used])
    return chosen[(chosen.size - 1) // 2] if chosen.size else 0.0


@njit(cache=True)
def track_face(image, dark, pattern, radius, predicted, spread, present, others, min_contrast, lopsided, labels, stack, out, used):  # type: ignore[no-untyped-def]  # fmt: skip
    """Measure the dots of one face near ``predicted`` (n, 2) [px] where ``present`` (n,), into ``out`` (n,
    FIELDS).

    ``spread`` (n,) [px]: how far a dot may be from its prediction. ``others`` (k, 2): predictions of all
    dots of the prior; a dot must lie nearer to its own than to any other. ``used`` (n,) gets what passed
    the gates. Returns the number.
    """
    n = pattern.shape[0]
    used[:] = False
    H = np.zeros((3, 3))
    if not fit_homography(pattern, predicted, present, H):
        return 0
    circles = np.zeros((n, 7))
    for i in range(n):
        if not image_of_circle(H, pattern[i, 0], pattern[i, 1], radius, circles[i]):
            return 0
        if present[i] and circles[i, 6] < THINNEST:
            return 0
    for i in range(n):
        if not present[i]:
            continue
        half = int(np.ceil(circles[i, 5] + spread[i])) + SHAPE_MARGIN
        if half > MAX_HALF_WINDOW:
            return 0
        half = max(half, MIN_HALF_WINDOW)
        pu, pv = predicted[i, 0], predicted[i, 1]
        if not (-1e6 < pu < 1e6 and -1e6 < pv < 1e6):
            continue
        u, v = int(np.floor(pu + 0.5)), int(np.floor(pv + 0.5))
        dot = out[i]
        least = max(5, int(0.4 * circles[i, 4]))
        if (
            measure(
                image,
                dark,
                u - half,
                v - half,
                u + half + 1,
                v + half + 1,
                pu,
                pv,
                min_contrast,
                least,
                labels,
                stack,
                dot,
            )
            != OK
        ):
            continue
        most = np.pi * (circles[i, 5] + 1.0) * (circles[i, 6] + 1.0) * 1.4
        if dot[AREA] < 0.6 * circles[i, 4] or dot[AREA] > most or not _is_whole(dot, lopsided):
            continue
        own = (dot[0] - pu) ** 2 + (dot[1] - pv) ** 2
        nearest = True
        for k in range(others.shape[0]):
            d = (dot[0] - others[k, 0]) ** 2 + (dot[1] - others[k, 1]) ** 2
            if d < own and (others[k, 0] != pu or others[k, 1] != pv):
                nearest = False
        if nearest:
            used[i] = True
    # against the neighbours: contrast, and area in units of the expected one
    contrasts = np.zeros(n)
    scales = np.zeros(n)
    for i in range(n):
        contrasts[i] = out[i, CONTRAST]
        scales[i] = out[i, AREA] / circles[i, 4]
    contrast = _median(contrasts, used)
    scale = _median(scales, used)
    count = 0
    for i in range(n):
        if used[i]:
            used[i] = (
                0.5 * contrast < contrasts[i] < 2.0 * contrast and 0.8 * scale < scales[i] < 1.25 * scale
            )
            count += 1 if used[i] else 0
    return count


@njit(cache=True)
def agree_with_prior(predicted, dots, used, tolerance):  # type: ignore[no-untyped-def]
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


@njit(cache=True)
def _remove_shift(pattern, radius, raw, used, H, dots):  # type: ignore[no-untyped-def]
    """``dots`` = ``raw`` minus the way from a dot's image to the centre of its ellipse."""
    circle = np.zeros(7)
    for i in range(used.size):
        if used[i]:
            if image_of_circle(H, pattern[i, 0], pattern[i, 1], radius, circle):
                dots[i, 0] = raw[i, 0] - circle[2]
                dots[i, 1] = raw[i, 1] - circle[3]
            else:
                used[i] = False


@njit(cache=True)
def settle_face(pattern, radius, dots, used, tolerance, least):  # type: ignore[no-untyped-def]
    """Check a face's dots (n, FIELDS) against one homography and move them from the ellipses' centres to
    the dots' own.

    Rows of ``used`` that do not fit the others are cleared (of five or more; four are taken as they are);
    all are, where fewer than ``least`` remain. The picture of a circle's centre is not the centre of its
    picture; the face's homography tells the difference, no camera needed. Returns the number that remains.
    """
    n = pattern.shape[0]
    H = np.zeros((3, 3))
    raw = dots[:, :2].copy()
    count = 0
    unit = 0.0
    for i in range(n):
        if used[i]:
            count += 1
            unit += 0.5 * (dots[i, CXX] + dots[i, CYY])
    if count < least:
        used[:] = False
        return 0
    sigma = np.sqrt(unit / count * max(_median(dots[:, NOISE], used), 0.08))
    # twice: a first shift under the homography of the ellipses' centres, which hardly differs, then the
    # checked one
    for step in range(2):
        if step == 1 and count >= 5:
            if not drop_strangers(pattern, dots, used, tolerance, sigma, max(least, 5), H):
                used[:] = False
                return 0
        elif not fit_homography(pattern, dots, used, H):
            used[:] = False
            return 0
        _remove_shift(pattern, radius, raw, used, H, dots)
    count = 0
    for i in range(n):
        count += 1 if used[i] else 0
    return count


@njit(cache=True)
def track(image, dark, patterns, radii, predicted, spreads, present, gates, min_contrast, lopsided, tolerance, labels, stack, dots, used):  # type: ignore[no-untyped-def]  # fmt: skip
    """All faces: ``patterns`` (f, n, 2), ``radii`` (f,), ``predicted`` (f, n, 2) [px], ``spreads`` (f, n)
    [px], ``present`` (f, n), ``gates`` (f, n, 3) inverse covariances (xx, xy, yy) divided by the squared
    gate, 0 for none. Writes ``dots`` (f, n, FIELDS) and ``used`` (f, n). Returns the number of dots.
    """
    faces, n = present.shape
    others = np.zeros((faces * n, 2))
    k = 0
    for f in range(faces):
        for i in range(n):
            if present[f, i]:
                others[k] = predicted[f, i]
                k += 1
    others = others[:k]
    total = 0
    for f in range(faces):
        count = track_face(
            image, dark, patterns[f], radii[f], predicted[f], spreads[f], present[f], others, min_contrast, lopsided,
            labels, stack, dots[f], used[f],
        )  # fmt: skip
        for i in range(n):
            if used[f, i]:
                du = dots[f, i, 0] - predicted[f, i, 0]
                dv = dots[f, i, 1] - predicted[f, i, 1]
                gate = gates[f, i]
                if gate[0] * du * du + 2.0 * gate[1] * du * dv + gate[2] * dv * dv > 1.0:
                    used[f, i] = False
                    count -= 1
        count = settle_face(patterns[f], radii[f], dots[f], used[f], tolerance, 4) if count >= 4 else 0
        if count == 0 or (count <= 5 and not agree_with_prior(predicted[f], dots[f], used[f], FEW_TOLERANCE)):
            used[f] = False
            continue
        total += count
    return total
