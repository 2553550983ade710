"""Tracking of dot faces in windows placed by a prior. Numba kernels; no state.

Three steps: :func:`expect` turns a prior into windows and expected shapes, :func:`measure_windows`
measures, :func:`judge` accepts. Arrays of dots are flat over the faces: dot ``i`` of face ``f`` is row ``f
n + i``.
"""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.compilation import kernel
from stereoservo_drivers.detectors.centroids import smaller_half_axis
from stereoservo_drivers.detectors.components import (
    AREA,
    BRIGHT,
    BXX,
    BYY,
    CONTRAST,
    CXX,
    CXY,
    CYY,
    EXX,
    EYY,
    LOPSIDED,
    LOPSIDED_NOISE,
    NOISE,
    OK,
    QXX,
    QXY,
    QYY,
)
from stereoservo_drivers.detectors.homographies import (
    fit_homography,
    image_of_circle,
    outlier_dot,
    reject_outliers,
)
from stereoservo_drivers.detectors.kernel_types import BOOL, FLOAT, INT, compile_for, given, written
from stereoservo_drivers.detectors.levels import UNEVEN_INSIDE
from stereoservo_drivers.detectors.lighting import flat_field

MIN_HALF_WINDOW = 14
MAX_HALF_WINDOW = 64
SHAPE_MARGIN = 6
"""Pixels between a dot's expected outline and the rim of its window, beside the prior's uncertainty."""
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
def _median(values, used):
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
def expect(
    every_id, patterns, radii, ids, pixels, velocities, covariances, dt_s,
    predicted, present, shapes, windows, least,
):  # fmt: skip
    """Windows for the dots of a prior of ``ids`` (k,), ``pixels``, ``velocities`` (k, 2), ``covariances``
    (k, 2, 2).

    ``every_id`` (f, n), ``patterns`` (f, n, 2), ``radii`` (f,) are the faces. Writes ``predicted`` (m, 2)
    [px] at ``dt_s`` [s] after the prior, ``present`` (m,), ``shapes`` (m, SHAPE), ``windows`` (m, 4),
    ``least`` (m,) pixels of a dot. Faces that the prior shows from behind, too thin, too uncertain or by
    fewer than four dots stay empty. Returns the number of windows.
    """
    faces, n = every_id.shape
    count = 0
    H = np.zeros((3, 3))
    spread = np.zeros(n)
    for f in range(faces):
        mine = present[f * n : (f + 1) * n]
        places = predicted[f * n : (f + 1) * n]
        for i in range(n):
            for k in range(ids.size):
                if ids[k] != every_id[f, i]:
                    continue
                du, dv = velocities[k, 0] * dt_s, velocities[k, 1] * dt_s
                u, v = pixels[k, 0] + du, pixels[k, 1] + dv
                xx, xy, yy = covariances[k, 0, 0], covariances[k, 0, 1], covariances[k, 1, 1]
                largest = 0.5 * (xx + yy) + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
                reach = 3.0 * np.sqrt(max(largest, 0.0)) + 0.25 * (abs(du) + abs(dv))
                # comparisons fail for NaN
                if abs(u) < 1e6 and abs(v) < 1e6 and reach < MAX_HALF_WINDOW:
                    places[i, 0] = u
                    places[i, 1] = v
                    spread[i] = reach
                    mine[i] = True
        good = fit_homography(patterns[f], places, mine, H)
        for i in range(n):
            shape = shapes[f * n + i]
            if good and not image_of_circle(H, patterns[f, i, 0], patterns[f, i, 1], radii[f], shape):
                good = False
            if (
                good
                and mine[i]
                and (shape[6] < THINNEST or shape[5] + spread[i] + SHAPE_MARGIN > MAX_HALF_WINDOW)
            ):
                good = False
        for i in range(n):
            if good and mine[i]:
                shape = shapes[f * n + i]
                half = max(int(np.ceil(shape[5] + spread[i])) + SHAPE_MARGIN, MIN_HALF_WINDOW)
                u, v = int(np.floor(places[i, 0] + 0.5)), int(np.floor(places[i, 1] + 0.5))
                window = windows[f * n + i]
                window[0], window[1], window[2], window[3] = u - half, v - half, u + half + 1, v + half + 1
                least[f * n + i] = max(5, int(0.4 * shape[4]))
                count += 1
        if not good:
            mine[:] = False
    return count


@kernel
def _gates(predicted, present, shapes, status, spread, limit, lopsided, dots, used):
    """Gates of each dot of a face, by itself and relative to its neighbours, into ``used`` (n,)."""
    n = used.size
    contrasts = np.zeros(n)
    scales = np.zeros(n)
    for i in range(n):
        used[i] = False
        if not present[i] or status[i] != OK:
            continue
        area, shape, dot = dots[i, AREA], shapes[i], dots[i]
        # blur inflates the area of thin dots
        most = np.pi * (shape[5] + 1.0) * (shape[6] + 1.0) * 1.4
        du, dv = dots[i, 0] - predicted[i, 0], dots[i, 1] - predicted[i, 1]
        noise = max(dot[NOISE], 0.08)
        xx, xy = spread[i, 0] + noise * dot[CXX], spread[i, 1] + noise * dot[CXY]
        yy = spread[i, 2] + noise * dot[CYY]
        off = yy * du * du - 2.0 * xy * du * dv + xx * dv * dv
        near = off <= limit * (xx * yy - xy * xy) or limit == np.inf
        contrasts[i] = dots[i, CONTRAST]
        scales[i] = area / shape[4]
        used[i] = area > 0.6 * shape[4] and area < most and near and whole(dot, lopsided)
    contrast = _median(contrasts, used)
    scale = _median(scales, used)
    for i in range(n):
        if used[i]:
            alike = contrasts[i] > 0.5 * contrast and contrasts[i] < 2.0 * contrast
            used[i] = alike and scales[i] > 0.8 * scale and scales[i] < 1.25 * scale


@kernel
def judge(
    patterns, radii, predicted, present, shapes, status, spread, limit, lopsided, tolerance, dots, used
):
    """Accept measured dots: complete, of the expected size, similar, nearest to their own prediction, consistent
    with the face.

    ``spread`` (m, 3): covariances (xx, xy, yy) of the prior [px²], and ``limit`` the largest squared distance from it
    with the measurement's covariance added, infinite for none;
    ``lopsided``, ``tolerance`` [px] as in the options. Moves ``dots`` (m, FIELDS) to the dots' centres,
    writes ``used`` (m,). Returns their number.
    """
    faces, n = patterns.shape[0], patterns.shape[1]
    total = 0
    for f in range(faces):
        a, b = f * n, (f + 1) * n
        mine = used[a:b]
        _gates(
            predicted[a:b],
            present[a:b],
            shapes[a:b],
            status[a:b],
            spread[a:b],
            limit,
            lopsided,
            dots[a:b],
            mine,
        )
        count = 0
        for i in range(a, b):
            if not used[i]:
                continue
            own = (dots[i, 0] - predicted[i, 0]) ** 2 + (dots[i, 1] - predicted[i, 1]) ** 2
            for k in range(faces * n):
                other = (dots[i, 0] - predicted[k, 0]) ** 2 + (dots[i, 1] - predicted[k, 1]) ** 2
                if present[k] and other < own:
                    used[i] = False
            count += 1 if used[i] else 0
        count = settle_face(patterns[f], radii[f], dots[a:b], mine, tolerance, 4) if count >= 4 else 0
        if count == 0 or (
            count <= 5 and not agree_with_prior(predicted[a:b], dots[a:b], mine, FEW_TOLERANCE)
        ):
            mine[:] = False
            count = 0
        total += count
    return total


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
def settle_face(pattern, radius, dots, used, tolerance, least):
    """Check a face's dots (n, FIELDS) against one homography and move them from the ellipses' centres to
    the dots' own.

    Uneven light is taken back. Rows of ``used`` that do not fit the others are cleared (of five or more; four are
    taken as they are); all are, where fewer than ``least`` remain. The picture of a circle's centre is not the centre
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
    dark = max(_median(dots[:, NOISE], used), 0.08)
    tolerance_inside = UNEVEN_INSIDE * _median(dots[:, CONTRAST], used)
    inside = max(_median(dots[:, BRIGHT], used), dark)
    bright = max(inside - tolerance_inside * tolerance_inside, dark)
    # slopes inside have that misfit, too
    flat_field(areas, used, dark, inside, dots, raw)
    variance = 0.0
    for i in range(n):
        if used[i]:
            own, light = dots[i, CXX] + dots[i, CYY], dots[i, BXX] + dots[i, BYY]
            variance += 0.5 * (dark * (own - light) + bright * light + dots[i, EXX] + dots[i, EYY])
            dots[i, 0] = raw[i, 0]
            dots[i, 1] = raw[i, 1]
    sigma = np.sqrt(max(variance, 0.0) / count)
    # twice: a first shift under the homography of the ellipses' centres, which hardly differs, then the
    # checked one
    for step in range(2):
        if step == 1 and count >= 5:
            if not reject_outliers(pattern, dots, used, tolerance, sigma, max(least, 5), H):
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


def compile_kernels() -> None:
    """Compile what the detector calls, or load it from the cache."""
    compile_for(
        expect, given(INT, 2), given(FLOAT, 3), given(FLOAT, 1), given(INT, 1), given(FLOAT, 2), given(FLOAT, 2),
        given(FLOAT, 3), FLOAT, written(FLOAT, 2), written(BOOL, 1), written(FLOAT, 2), written(INT, 2),
        written(INT, 1),
    )  # fmt: skip
    compile_for(
        judge, given(FLOAT, 3), given(FLOAT, 1), given(FLOAT, 2), given(BOOL, 1), given(FLOAT, 2), given(INT, 1),
        given(FLOAT, 2), FLOAT, FLOAT, FLOAT, written(FLOAT, 2), written(BOOL, 1),
    )  # fmt: skip
    compile_for(
        settle_face, given(FLOAT, 2), FLOAT, written(FLOAT, 2), written(BOOL, 1), FLOAT, INT
    )  # fmt: skip
    compile_for(whole, given(FLOAT, 1), FLOAT)
