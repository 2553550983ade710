"""Connected components of a window, and the level around one. Numba kernels; no state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.numerics.compilation import kernel

MAX_WINDOW = 160
"""Largest side of a window [px]."""


def scratch() -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Label image and stack for :func:`measure`, to be reused between calls of one thread."""
    return np.zeros((MAX_WINDOW, MAX_WINDOW), np.int32), np.zeros(MAX_WINDOW * MAX_WINDOW, np.int32)


@kernel
def median_level(histogram, count):
    half = (count + 1) // 2
    total = 0
    for level in range(256):
        total += histogram[level]
        if total >= half:
            return float(level)
    return 255.0


@kernel
def extremes(image, dark, box, brightest):
    """Lowest and highest level of a window; ``brightest`` (rows,) gets that of each row, of inverted levels where
    ``dark``.
    """
    u0, v0, u1, v1 = box
    low, high = 255, 0
    for v in range(v0, v1):
        row = image[v, u0:u1]
        lowest, highest = np.uint8(255), np.uint8(0)
        for u in range(row.size):
            level = row[u]
            lowest = min(lowest, level)
            highest = max(highest, level)
        brightest[v - v0] = 255 - int(lowest) if dark else int(highest)
        low = min(low, int(lowest))
        high = max(high, int(highest))
    return low, high


@kernel
def nearest_component(image, dark, box, brightest, threshold, pu, pv, min_area, labels, stack, found):
    """Label the bright components of a window; the label of the one nearest to (pu, pv), 0 if there is none.

    ``brightest`` level of each row (rows,). ``found``: count, sum u, sum v, u_min, u_max, v_min, v_max, level sum of
    its inner pixels, their count; last, the number of all components. Those that touch the window's rim are something
    larger than a dot and are not looked for.
    """
    u0, v0, u1, v1 = box
    labels[: v1 - v0, : u1 - u0] = 0
    best = 0
    best_distance = 1e30
    label = 0
    for sv in range(v0, v1):
        if brightest[sv - v0] < threshold:
            continue
        row, marks = image[sv, u0:u1], labels[sv - v0]
        for su in range(row.size):
            level = int(row[su])
            if dark:
                level = 255 - level
            if level < threshold or marks[su] != 0:
                continue
            label += 1
            marks[su] = label
            stack[0] = (sv - v0) * MAX_WINDOW + su
            top = 1
            count = 0
            sum_u = sum_v = 0
            u_min, u_max, v_min, v_max = su + u0, su + u0, sv, sv
            inner_sum = inner = 0
            while top > 0:
                top -= 1
                v = stack[top] // MAX_WINDOW + v0
                u = stack[top] % MAX_WINDOW + u0
                count += 1
                sum_u += u
                sum_v += v
                u_min = min(u_min, u)
                u_max = max(u_max, u)
                v_min = min(v_min, v)
                v_max = max(v_max, v)
                neighbours = 0
                for k in range(4):
                    nu = u + (1 if k == 0 else -1 if k == 1 else 0)
                    nv = v + (1 if k == 2 else -1 if k == 3 else 0)
                    if nu < u0 or nu >= u1 or nv < v0 or nv >= v1:
                        continue
                    other = int(image[nv, nu])
                    if dark:
                        other = 255 - other
                    if other < threshold:
                        continue
                    neighbours += 1
                    if labels[nv - v0, nu - u0] == 0:
                        labels[nv - v0, nu - u0] = label
                        stack[top] = (nv - v0) * MAX_WINDOW + (nu - u0)
                        top += 1
                if neighbours == 4:
                    here = int(image[v, u])
                    inner_sum += 255 - here if dark else here
                    inner += 1
            if count < min_area or u_min == u0 or v_min == v0 or u_max == u1 - 1 or v_max == v1 - 1:
                continue
            du = sum_u / count - pu
            dv = sum_v / count - pv
            if du * du + dv * dv < best_distance:
                best_distance = du * du + dv * dv
                best = label
                found[0] = count
                found[1] = sum_u
                found[2] = sum_v
                found[3] = u_min
                found[4] = u_max
                found[5] = v_min
                found[6] = v_max
                found[7] = inner_sum
                found[8] = inner
    found[9] = label
    return best


@kernel
def ring_level(image, dark, u_min, u_max, v_min, v_max):
    """Median level of the rectangular ring 3 to 4 px outside a bounding box (all inside the image)."""
    histogram = np.zeros(256, np.int32)
    count = 0
    for grow in (3, 4):
        for u in range(u_min - grow, u_max + grow + 1):
            for v in (v_min - grow, v_max + grow):
                level = int(image[v, u])
                histogram[255 - level if dark else level] += 1
                count += 1
        for v in range(v_min - grow + 1, v_max + grow):
            for u in (u_min - grow, u_max + grow):
                level = int(image[v, u])
                histogram[255 - level if dark else level] += 1
                count += 1
    return median_level(histogram, count)


@kernel
def half_sizes(q11, q12, q22):
    """Half width and half height [px] of the ellipse dᵀQd = 1."""
    det = q11 * q22 - q12 * q12
    return np.sqrt(q22 / det), np.sqrt(q11 / det)


class Aperture(NamedTuple):
    """An ellipse dᵀQd = 1 with a ``skirt`` [px], and what makes levels of an image ones above the background:
    ``sign`` times level plus ``zero``.
    """

    q11: float
    q12: float
    q22: float
    skirt: float
    sign: float
    zero: float


@kernel
def aperture_of(dark, background, skirt, out):
    """The aperture about a dot's ellipse in ``out``."""
    sign, zero = (-1.0, 255.0 - background) if dark else (1.0, -background)
    return Aperture(out[QXX], out[QXY], out[QYY], skirt, sign, zero)


@kernel
def crowded(labels, box, label, near, reach, out):
    """Whether more than specks (noise on the dot's own edge) of other components come within ``near`` [px], to first
    order, of the ellipse of ``out``; ``reach`` [px] how far that is at most."""
    specks = 3
    q11, q12, q22 = out[QXX], out[QXY], out[QYY]
    wide, high = half_sizes(q11, q12, q22)
    half_u, half_v = int(wide + reach), int(high + reach)
    u0, v0, u1, v1 = box
    lo_u, hi_u = max(u0, int(out[U]) - half_u), min(u1, int(out[U]) + half_u + 2)
    far = 4.0 * near * near
    for v in range(max(v0, int(out[V]) - half_v), min(v1, int(out[V]) + half_v + 2)):
        row = labels[v - v0, lo_u - u0 : hi_u - u0]
        for k in range(row.size):
            if row[k] not in (0, label):
                x, y = k + lo_u - out[U], v - out[V]
                gx = q11 * x + q12 * y
                gy = q12 * x + q22 * y
                e = x * gx + y * gy - 1.0
                if e <= 0.0 or e * e < far * (gx * gx + gy * gy):
                    specks -= 1
                    if specks < 0:
                        return True
    return False


U, V, CXX, CXY, CYY, AREA, QXX, QXY, QYY, CONTRAST, NOISE, LOPSIDED, LOPSIDED_NOISE = range(13)
BXX, BXY, BYY, BRIGHT, BACKGROUND, FLUX, FLUX_NOISE = range(13, 20)
LIT, DARK, SLOPE, SLOPE_XX, SLOPE_XY, SLOPE_YY, PULL, EXX, EXY, EYY = 20, 24, 28, 30, 31, 32, 33, 37, 38, 39
FIELDS = 40

OK, NO_CONTRAST, NO_COMPONENT, BORDER, SHAPE, DIVERGED = range(6)
