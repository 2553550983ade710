"""Connected components of a window, the level around one, and its pixels as a patch. Numba kernels; no state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.numerics.compilation import kernel

F = np.float32
NOTHING = F(1e-12)
"""Keeps quotients finite at the centre of an ellipse."""
MAX_WINDOW = 160
"""Largest side of a window [px]."""
ROW, FIRST, BEYOND, COMPONENT = range(4)
"""Columns of a run: its row, its first pixel, one past its last, the number of its component."""
AREA_PX, SUM_U, SUM_V, LEFT, RIGHT, TOP, BOTTOM = range(7)
"""Columns of a component's totals; the last row and column are inclusive."""
LEVEL, VALID, X, Y = range(4)
"""Planes of a patch: level above the background, 1 for a pixel inside the image, column, row."""
LANES = 32
"""Patches are padded to a multiple of this number of pixels, for the loops over them."""
FAR = 10
"""Distance [px] of the bounding boxes of components above which one does not affect a dot in the other: twice the
required free distance, plus the excess of its ellipse over its box.
"""
PATCH = (MAX_WINDOW + 96) ** 2
"""Pixels of the largest patch, padding included."""


class Picture(NamedTuple):
    """An ``image`` (h, w) uint8, and whether its dots are ``dark`` on a lighter plate."""

    image: npt.NDArray[np.uint8]
    dark: bool


class Sought(NamedTuple):
    """The dot to find: the one nearest to (``u``, ``v``) [px], of at least ``contrast`` [grey levels] and ``area``
    [pixels].
    """

    u: float
    v: float
    contrast: int
    area: int


class Pixels(NamedTuple):
    """Pixels of a patch (n,): ``level`` above the background, column ``x`` and row ``y`` [px] from its origin."""

    level: npt.NDArray[np.float32]
    x: npt.NDArray[np.float32]
    y: npt.NDArray[np.float32]


class Matrix2(NamedTuple):
    """[[``a``, ``b``], [``c``, ``d``]]."""

    a: float
    b: float
    c: float
    d: float


class Symmetric2(NamedTuple):
    """[[``xx``, ``xy``], [``xy``, ``yy``]]."""

    xx: float
    xy: float
    yy: float


class Scratch(NamedTuple):
    """Memory of :func:`~stereoservo_drivers.detectors.centroids.measure`, reused between calls of one thread."""

    labels: npt.NDArray[np.int32]
    runs: npt.NDArray[np.int32]
    patch: npt.NDArray[np.float32]


def scratch() -> Scratch:
    """New memory for measuring."""
    return Scratch(
        np.zeros((MAX_WINDOW, MAX_WINDOW), np.int32),
        np.zeros((MAX_WINDOW * (MAX_WINDOW // 2 + 1), 4), np.int32),
        np.zeros((4, PATCH), np.float32),
    )


@kernel
def extremes(picture, box, brightest):
    """Lowest and highest level of a window. Writes the highest of each row to ``brightest`` (rows,); levels are
    inverted if dots are dark.
    """
    image, dark = picture
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
def join_runs(runs, count, reach):
    """Number the components of ``count`` runs (n, 4) in the order of their rows; returns their totals (components, 7).

    Runs of neighbouring rows belong to one component if they overlap, or, with a ``reach`` of 1, touch by a corner.
    """
    components = count
    above = 0
    for k in range(count):
        row, first, beyond = runs[k, ROW], runs[k, FIRST] - reach, runs[k, BEYOND] + reach
        runs[k, COMPONENT] = root = k
        while above < k and (
            runs[above, ROW] < row - 1 or (runs[above, ROW] == row - 1 and runs[above, BEYOND] <= first)
        ):
            above += 1
        i = above
        while i < k and runs[i, ROW] == row - 1 and runs[i, FIRST] < beyond:
            other = i
            while runs[other, COMPONENT] != other:
                other = runs[other, COMPONENT]
            if other != root:
                components -= 1
                runs[max(root, other), COMPONENT] = root = min(root, other)
            i += 1
    totals = np.zeros((components, 7), np.int64)
    components = 0
    for k in range(count):
        row, first, beyond = runs[k, ROW], runs[k, FIRST], runs[k, BEYOND]
        if runs[k, COMPONENT] == k:
            mine = components
            components += 1
            total = totals[mine]
            total[LEFT], total[RIGHT], total[TOP] = first, beyond - 1, row
        else:
            # an earlier run, which already has its number
            mine = runs[runs[k, COMPONENT], COMPONENT]
            total = totals[mine]
        runs[k, COMPONENT] = mine
        n = beyond - first
        total[AREA_PX] += n
        total[SUM_U] += n * (first + beyond - 1) // 2
        total[SUM_V] += n * row
        total[LEFT] = min(total[LEFT], first)
        total[RIGHT] = max(total[RIGHT], beyond - 1)
        total[BOTTOM] = row
    return totals


class Threshold(NamedTuple):
    """The ``level`` from which on a pixel is bright, and the ``brightest`` level of each row (rows,) of a window."""

    level: int
    brightest: npt.NDArray[np.int64]


@kernel
def _bright_runs(picture, box, threshold, runs):
    """Runs (n, 4) of pixels at or above the threshold in a window; returns their number."""
    image, dark = picture
    level, brightest = threshold
    u0, v0, u1, v1 = box
    flip = 255 if dark else 0
    count = 0
    for v in range(v0, v1):
        if brightest[v - v0] < level:
            continue
        row = image[v, u0:u1]
        within = False
        for k in range(row.size):
            bright = (np.int64(row[k]) ^ flip) >= level
            if bright != within:
                within = bright
                if bright:
                    runs[count, ROW] = v
                    runs[count, FIRST] = k + u0
                else:
                    runs[count, BEYOND] = k + u0
                    count += 1
        if within:
            runs[count, BEYOND] = u1
            count += 1
    return count


class Component(NamedTuple):
    """A component of a window: its ``label`` (0: none), the ``gap`` [px] to the next one's bounding box, its own
    bounding box, and sum of levels and number of its inner pixels.
    """

    label: int
    gap: int
    left: int
    right: int
    top: int
    bottom: int
    level_sum: int
    inner: int


@kernel
def _gap(totals, which):
    """Distance [px] between the bounding boxes of a component and the nearest other one; FAR if none is nearer."""
    own = totals[which]
    gap = FAR
    for c in range(totals.shape[0]):
        if c != which:
            other = totals[c]
            along = max(other[LEFT] - own[RIGHT], own[LEFT] - other[RIGHT])
            gap = min(gap, max(along, other[TOP] - own[BOTTOM], own[TOP] - other[BOTTOM]))
    return gap


@kernel
def nearest_component(picture, box, threshold, sought, scratch):
    """The bright component that is ``sought``, by place and area.

    Components that touch the window's border are larger than a dot and are ignored. Labels are written if another
    component is near.
    """
    image, dark = picture
    u0, v0, u1, v1 = box
    labels, runs, _ = scratch
    count = _bright_runs(picture, box, threshold, runs)
    totals = join_runs(runs, count, np.int64(0))
    best, nearest = -1, 1e30
    for c in range(totals.shape[0]):
        total = totals[c]
        if total[AREA_PX] < sought.area or total[LEFT] == u0 or total[TOP] == v0:
            continue
        if total[RIGHT] == u1 - 1 or total[BOTTOM] == v1 - 1:
            continue
        du, dv = total[SUM_U] / total[AREA_PX] - sought.u, total[SUM_V] / total[AREA_PX] - sought.v
        if du * du + dv * dv < nearest:
            nearest = du * du + dv * dv
            best = c
    if best < 0:
        return Component(0, FAR, 0, 0, 0, 0, 0, 0)
    gap = _gap(totals, best)
    if gap < FAR:
        labels[: v1 - v0, : u1 - u0] = 0
    flip = 255 if dark else 0
    level_sum = inner = 0
    for k in range(count):
        row, first, beyond, mine = runs[k, ROW], runs[k, FIRST], runs[k, BEYOND], runs[k, COMPONENT]
        if gap < FAR:
            for u in range(first, beyond):
                labels[row - v0, u - u0] = mine + 1
        if mine == best:
            for u in range(first + 1, beyond - 1):
                over, under = np.int64(image[row - 1, u]) ^ flip, np.int64(image[row + 1, u]) ^ flip
                if over >= threshold.level and under >= threshold.level:
                    level_sum += np.int64(image[row, u]) ^ flip
                    inner += 1
    total = totals[best]
    return Component(best + 1, gap, total[LEFT], total[RIGHT], total[TOP], total[BOTTOM], level_sum, inner)


@kernel
def ring_level(picture, component):
    """Median level of the rectangular ring 3 to 4 px outside a component's bounding box (all inside the image), and the
    median distance from it.
    """
    image, dark = picture
    u_min, u_max, v_min, v_max = component.left, component.right, component.top, component.bottom
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
    half = (count + 1) // 2
    total = middle = 0
    while total + histogram[middle] < half:
        total += histogram[middle]
        middle += 1
    total, away = histogram[middle], 0
    while total < half:
        away += 1
        total += histogram[middle - away] if middle >= away else 0
        total += histogram[middle + away] if middle + away <= 255 else 0
    return float(middle), float(away)


@kernel
def half_sizes(q11, q12, q22):
    """Half width and half height [px] of the ellipse dᵀQd = 1."""
    det = q11 * q22 - q12 * q12
    return np.sqrt(q22 / det), np.sqrt(q11 / det)


@kernel
def patch_size(box):
    """Number of pixels of a rectangle in the planes, including its padding."""
    return ((box[2] - box[0]) // 8 * 8 + 8) * (box[3] - box[1] + 1) + 2 * LANES


class Patch(NamedTuple):
    """Source of the pixels of a patch: first and last columns and rows [px]; its ``width``, a multiple of 8."""

    left: int
    top: int
    right: int
    bottom: int
    width: int


@kernel
def fill_patch(picture, background, box, planes):
    """Write the pixels of a rectangle, including its last row and column, into ``planes`` (4, n), row by row.

    A pixel outside of the image, or padding a row, has the level 0 and is not VALID; padding at the end is far away.
    """
    image, dark = picture
    u0, v0, u1, v1 = box
    rows, columns = image.shape
    width = (u1 - u0) // 8 * 8 + 8
    sign, zero = np.float32(1.0), np.float32(-background)
    if dark:
        sign, zero = np.float32(-1.0), np.float32(255.0 - background)
    n = (v1 - v0 + 1) * width
    padded = (n + LANES - 1) // LANES * LANES + LANES
    planes[LEVEL, :padded] = 0.0
    planes[VALID, :padded] = 0.0
    planes[X, n:padded] = 1e3
    planes[Y, n:padded] = 1e3
    first, beyond = max(u0, 0), min(u1 + 1, columns)
    for v in range(v0, v1 + 1):
        start = (v - v0) * width
        x, y = planes[X, start : start + width], planes[Y, start : start + width]
        for k in range(width):
            x[k] = k
            y[k] = v - v0
        if v < 0 or v >= rows:
            continue
        row = image[v, first:beyond]
        start += first - u0
        level, valid = planes[LEVEL, start : start + row.size], planes[VALID, start : start + row.size]
        for k in range(row.size):
            level[k] = sign * np.float32(row[k]) + zero
            valid[k] = 1.0
    return Patch(u0, v0, u1, v1, width)


@kernel
def blank_others(box, label, patch, scratch):
    """Set the pixels of components other than ``label`` in a window to the background's level in their patch."""
    labels, _, planes = scratch
    u0, v0, u1, v1 = box
    for v in range(max(patch.top, v0), min(patch.bottom + 1, v1)):
        for u in range(max(patch.left, u0), min(patch.right + 1, u1)):
            if labels[v - v0, u - u0] not in (0, label):
                planes[LEVEL, (v - patch.top) * patch.width + u - patch.left] = 0.0


@kernel
def lanes(patch, first, last):
    """First index and end in the planes of the rows ``first`` to ``last`` [px] of a patch, multiples of LANES apart."""
    start = (first - patch.top) * patch.width
    n = (last - first + 1) * patch.width
    return start, start + (n + LANES - 1) // LANES * LANES


@kernel
def crowded(labels, box, label, near, reach, out):
    """Whether more than specks (noise on the dot's own edge) of other components come within ``near`` [px], to first
    order, of the ellipse of ``out``; ``reach`` [px]: largest extent of that.
    """
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
