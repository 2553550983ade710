"""Corners of a tag from its whole printed pattern: the known cells, seen through a homography and blurred by a
Gaussian, are fitted to the grey values of the tag.

A search for each corner by itself looks at a few pixels, and is pulled inwards by blur: both legs of an L bend.
The pattern's edges, all of them, say where the corners are ten times better, and how well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.numerics.compilation import inlined_kernel, kernel
from stereoservo_drivers.detectors.kernel_types import FLOAT, compile_for, given, written

PARAMETERS = 13
"""Homography from pixels to the tag (8), log of the blur, white level, its two slopes, black as a part of white: light
that falls off does so on both.
"""
QUIET_CELLS = 0.5
"""Fitted part of the white margin [cells]; a printed tag has one cell at least."""
MOST_PIXELS = 1500
"""Of larger tags every n-th pixel is taken."""
LEAST_BLUR, MOST_BLUR = 0.2, 4.0
"""Bounds of the blur's sigma [px]: a pixel's own square has 0.29."""
REACH = 2.8
"""Distance [sigmas, times the root of 2] from an edge beyond which it is not felt: erfc(2.8) = 7.5e-5."""
HUBER = 2.5
"""Residuals beyond so many standard deviations count linearly: shadows, scratches, ringing of JPEG."""
PASSES = 14
SETTLED_PX = 2e-3
QUANTISATION = 1.0 / 12.0
"""Least noise variance [grey levels squared]: rounding to whole levels."""
MIN_CORRELATION = 0.9
MAX_SHIFT_CELLS = 1.0
"""A fit that correlates less with the image, or moved a corner further from its start, is not believed."""
MAX_CELL_ERROR = 0.45
"""A cell whose grey is off by so much of the contrast is not what the code says: it was read wrong, or is covered."""


@dataclass(frozen=True)
class Registered:
    """A tag found in its place: ``corners`` (4, 2) [px] and their ``covariances`` (4, 2, 2) [px²], those of the noise.

    ``noise_variance`` [levels²] of the fit's residuals, ``contrast`` [levels] between white and black at the middle,
    ``blur`` [px], ``correlation`` of pattern and image.
    """

    corners: FloatArray
    covariances: FloatArray
    noise_variance: float
    contrast: float
    blur: float
    correlation: float


@kernel
def _weigh(t, sigma, n, out):
    """Weights of the cells that are felt at coordinate ``t``, and their derivatives in t and in log sigma, into ``out``
    (3, n + 1) from its first column on.

    Returns the first cell and one past the last.
    """
    reach = REACH * math.sqrt(2.0) * sigma
    low = max(math.floor((t - reach) * n), 0)
    high = min(math.floor((t + reach) * n), n - 1)
    step, step_t, step_s = 0.0, 0.0, 0.0
    for i in range(low, high + 2):
        z = (t - i / n) / (math.sqrt(2.0) * sigma)
        before, before_t, before_s = step, step_t, step_s
        if z > REACH:
            step, step_t, step_s = 1.0, 0.0, 0.0
        elif z < -REACH:
            step, step_t, step_s = 0.0, 0.0, 0.0
        else:
            bell = math.exp(-z * z) / math.sqrt(math.pi)
            step = 0.5 * (1.0 + math.erf(z))
            step_t = bell / (math.sqrt(2.0) * sigma)
            step_s = -bell * z
        if i > low:
            out[0, i - low - 1] = before - step
            out[1, i - low - 1] = before_t - step_t
            out[2, i - low - 1] = before_s - step_s
    return low, max(high + 1, low)


@inlined_kernel
def _on_tag(p, u, v):
    """Of a pixel: the denominator ``w`` of the homography, the place (x, y) on the tag, |grad x| and |grad y|."""
    w = p[6] * u + p[7] * v + 1.0
    x = (p[0] * u + p[1] * v + p[2]) / w
    y = (p[3] * u + p[4] * v + p[5]) / w
    slope_x = math.hypot(p[0] - x * p[6], p[1] - x * p[7]) / w
    slope_y = math.hypot(p[3] - y * p[6], p[4] - y * p[7]) / w
    return w, x, y, slope_x, slope_y


@inlined_kernel
def _darkness(cells, columns, across, rows, down, first_order, second_order):
    """Darkness, 0 white to 1 black, at a pixel that feels these ``columns`` and ``rows`` of cells with weights
    ``across`` and ``down``; its derivatives in x, y and log sigma.

    A blur that is round in the image is none along two axes that are askew: at a corner, the bivariate normal
    distribution in powers of their correlation (Pearson's tetrachoric series), two terms of it.
    """
    (i0, i_last), (j0, j_last) = columns, rows
    dark, dark_x, dark_y, dark_s = 0.0, 0.0, 0.0, 0.0
    for j in range(j0, j_last):
        row, row_x, row_s = 0.0, 0.0, 0.0
        for i in range(i0, i_last):
            if cells[j, i] != 0.0:
                row += across[0, i - i0]
                row_x += across[1, i - i0]
                row_s += across[2, i - i0]
        weight, by_t, by_s = down[0, j - j0], down[1, j - j0], down[2, j - j0]
        dark += weight * row
        dark_x += weight * row_x
        dark_y += by_t * row
        dark_s += weight * row_s + by_s * row
        dark += first_order * by_t * row_x + second_order * by_s * row_s
    return dark, dark_x, dark_y, dark_s


@inlined_kernel
def _predict(u, v, cells, p, sigma, across, down, J):
    """Whether the model shows the tag at pixel (u, v), and its grey level there; derivatives into ``J`` (13,)."""
    w, x, y, slope_x, slope_y = _on_tag(p, u, v)
    if w <= 1e-3 or slope_x < 1e-9 or slope_y < 1e-9:
        return False, 0.0
    columns = _weigh(x, sigma * slope_x, cells.shape[0], across)
    rows = _weigh(y, sigma * slope_y, cells.shape[0], down)
    askew = ((p[0] - x * p[6]) * (p[3] - y * p[6]) + (p[1] - x * p[7]) * (p[4] - y * p[7])) / (w * w)
    first_order = sigma * sigma * askew
    second_order = 0.5 * (askew / (slope_x * slope_y)) ** 2
    dark, dark_x, dark_y, dark_s = _darkness(cells, columns, across, rows, down, first_order, second_order)
    lit = p[9] + p[10] * (x - 0.5) + p[11] * (y - 0.5)
    fall = -lit * (1.0 - p[12])
    shade = 1.0 - dark * (1.0 - p[12])
    along_x = p[10] * shade + fall * dark_x
    along_y = p[11] * shade + fall * dark_y
    J[0] = along_x * u / w
    J[1] = along_x * v / w
    J[2] = along_x / w
    J[3] = along_y * u / w
    J[4] = along_y * v / w
    J[5] = along_y / w
    J[6] = -(along_x * x + along_y * y) * u / w
    J[7] = -(along_x * x + along_y * y) * v / w
    J[8] = fall * dark_s
    J[9] = shade
    J[10] = shade * (x - 0.5)
    J[11] = shade * (y - 0.5)
    J[12] = lit * dark
    return True, lit * shade


@kernel
def accumulate(grey, points, cells, p, huber, A, b, totals):
    """Normal equations ``A`` (13, 13), ``b`` (13,) of the fit at parameters ``p`` (13,).

    ``grey`` (m,) [levels] at ``points`` (m, 2). Residuals beyond ``huber`` [levels] count linearly. ``totals`` (7,)
    gets Huber's cost, the sums of squares of the clipped residuals, of pixels that are not clipped, of |residual|, and
    of model, model squared, model times grey (the last three for the correlation). False where the homography does
    not show the tag.
    """
    n = cells.shape[0]
    A[:] = 0.0
    b[:] = 0.0
    totals[:] = 0.0
    across, down = np.zeros((3, n + 1)), np.zeros((3, n + 1))
    J = np.zeros(13)
    sigma = math.exp(p[8])
    for k in range(grey.size):
        shown, value = _predict(points[k, 0], points[k, 1], cells, p, sigma, across, down, J)
        if not shown:
            return False
        residual = grey[k] - value
        size = abs(residual)
        weight = 1.0
        if size > huber:
            weight = huber / size
            totals[0] += huber * (size - 0.5 * huber)
            totals[1] += huber * huber
        else:
            totals[0] += 0.5 * size * size
            totals[1] += size * size
            totals[2] += 1.0
        totals[3] += size
        totals[4] += value
        totals[5] += value * value
        totals[6] += value * grey[k]
        for a in range(13):
            factor = weight * J[a]
            if factor != 0.0:
                for c in range(a + 1):
                    A[a, c] += factor * J[c]
                b[a] += factor * residual
    for a in range(13):
        for c in range(a):
            A[c, a] = A[a, c]
    return True


@kernel
def cell_errors(grey, points, cells, p, out):
    """How far each cell (n, n) is off the grey that the code gives it, in parts of the contrast, into ``out``.

    By least squares, so that a neighbour's blur is no error; 0 where a cell has no pixel.
    """
    n = cells.shape[0]
    across, down = np.zeros((3, n + 1)), np.zeros((3, n + 1))
    wx, wy = across[0], down[0]
    squares = np.zeros((n, n))
    out[:] = 0.0
    sigma = math.exp(p[8])
    for k in range(grey.size):
        _, x, y, slope_x, slope_y = _on_tag(p, points[k, 0], points[k, 1])
        i_first, i_last = _weigh(x, sigma * slope_x, n, across)
        j_first, j_last = _weigh(y, sigma * slope_y, n, down)
        dark = 0.0
        for j in range(j_first, j_last):
            for i in range(i_first, i_last):
                dark += cells[j, i] * wy[j - j_first] * wx[i - i_first]
        lit = p[9] + p[10] * (x - 0.5) + p[11] * (y - 0.5)
        residual = grey[k] - lit * (1.0 - dark * (1.0 - p[12]))
        for j in range(j_first, j_last):
            for i in range(i_first, i_last):
                share = lit * (1.0 - p[12]) * wy[j - j_first] * wx[i - i_first]
                out[j, i] += share * residual
                squares[j, i] += share * share
    for j in range(n):
        for i in range(n):
            if squares[j, i] > 0.0:
                out[j, i] = abs(out[j, i]) / squares[j, i]


def register_tag(image: ImageArray, start: FloatArray, cells: FloatArray) -> Registered | None:
    """Fit the blurred pattern of ``cells`` (n, n) to an image (h, w) about ``start`` (4, 2) [px].

    None where the fit cannot be believed: the grey values do not follow the pattern, a cell is not what the code
    says, a corner moved by more than a cell.
    """
    start = np.asarray(start, dtype=np.float64)
    area = _area(start)
    if not area > 1.0:
        return None
    centre, side = start.mean(axis=0), float(np.sqrt(area))
    try:
        h = homography_from_quad((start - centre) / side)
    except np.linalg.LinAlgError:
        return None
    grey, points = _pixels(image, h, centre, side, len(cells))
    if len(grey) < 4 * PARAMETERS:
        return None
    fitted = _fit(grey, points, cells, _first_guess(grey, h, side), side)
    if fitted is None:
        return None
    p, A, totals = fitted
    return _judged(grey, points, cells, p, A, totals, start, centre, side)


def _first_guess(grey: FloatArray, h: FloatArray, side: float) -> FloatArray:
    black, white = np.percentile(grey, [10, 90])
    return np.concatenate([h.ravel()[:8], [np.log(1.0 / side), white, 0.0, 0.0, black / max(white, 1.0)]])


def _fit(
    grey: FloatArray, points: FloatArray, cells: FloatArray, p: FloatArray, side: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Levenberg-Marquardt with Huber's loss: parameters, normal matrix and totals at the end."""
    A, b, totals = np.zeros((13, 13)), np.zeros(13), np.zeros(7)
    A_new, b_new, totals_new = np.zeros((13, 13)), np.zeros(13), np.zeros(7)
    low, high = np.log(LEAST_BLUR / side), np.log(MOST_BLUR / side)
    huber, damping = 1e6, 1e-3
    if not accumulate(grey, points, cells, p, huber, A, b, totals):
        return None
    for _ in range(PASSES):
        try:
            step = np.linalg.solve(A + damping * np.diag(np.diag(A) + 1e-9), b)
        except np.linalg.LinAlgError:
            return None
        trial = p + step
        trial[8] = min(max(trial[8], low), high)
        ok = accumulate(grey, points, cells, trial, huber, A_new, b_new, totals_new)
        if not ok or not totals_new[0] <= totals[0]:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        damping = max(damping * 0.1, 1e-9)
        p, moved = trial, side * float(np.abs(step[:8]).max())
        A, A_new, b, b_new, totals, totals_new = A_new, A, b_new, b, totals_new, totals
        settled = HUBER * 1.2533 * totals[3] / len(grey)
        if moved < SETTLED_PX and huber < 1.2 * settled:
            break
        if huber > 1.2 * settled:
            huber = max(settled, 1.0)
            accumulate(grey, points, cells, p, huber, A, b, totals)
    return p, A, totals


def _judged(
    grey: FloatArray,
    points: FloatArray,
    cells: FloatArray,
    p: FloatArray,
    A: FloatArray,
    totals: FloatArray,
    start: FloatArray,
    centre: FloatArray,
    side: float,
) -> Registered | None:
    m = len(grey)
    if not np.isfinite(p).all() or totals[2] < 2 * PARAMETERS:
        return None
    model_variance = totals[5] / m - (totals[4] / m) ** 2
    spread = model_variance * float(grey.var())
    if not spread > 0.0:
        return None
    correlation = (totals[6] / m - totals[4] / m * float(grey.mean())) / float(np.sqrt(spread))
    errors = np.zeros(cells.shape)
    cell_errors(grey, points, cells, p, errors)
    if not (correlation >= MIN_CORRELATION and errors.max() <= MAX_CELL_ERROR):
        return None
    # Huber's estimator: E[psi²] / E[psi']², over the matrix of all pixels, whose sum A nearly is
    variance = max(totals[1] / (m - PARAMETERS) * (m / totals[2]), QUANTISATION)
    try:
        inverse = np.linalg.inv(A)
        corners, covariances = _corners(p[:8], inverse[:8, :8] * variance)
    except np.linalg.LinAlgError:
        return None
    corners = corners * side + centre
    longest = float(np.linalg.norm(start - np.roll(start, 1, axis=0), axis=1).max())
    shift = float(np.linalg.norm(corners - start, axis=1).max())
    if not (np.isfinite(covariances).all() and shift <= MAX_SHIFT_CELLS * longest / len(cells)):
        return None
    return Registered(
        corners,
        covariances * side**2,
        variance,
        float(p[9] * (1.0 - p[12])),
        float(np.exp(p[8]) * side),
        correlation,
    )


def _corners(h: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Images (4, 2) of the tag's corners and their covariances (4, 2, 2), from those (8, 8) of the homography."""
    H = np.append(h, 1.0).reshape(3, 3)
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    m = np.column_stack([square, np.ones(4)]) @ np.linalg.inv(H).T
    places = m[:, :2] / m[:, 2:]
    covariances = np.zeros((4, 2, 2))
    for k, (u, v) in enumerate(places):
        w = H[2] @ [u, v, 1.0]
        x, y = square[k]
        row = np.array([u, v, 1.0]) / w
        by_h = np.zeros((2, 8))
        by_h[0, :3], by_h[1, 3:6] = row, row
        by_h[:, 6], by_h[:, 7] = -square[k] * row[0], -square[k] * row[1]
        by_place = (H[:2, :2] - np.outer([x, y], H[2, :2])) / w
        back = np.linalg.solve(by_place, by_h)
        covariances[k] = back @ covariance @ back.T
    return places, 0.5 * (covariances + covariances.transpose(0, 2, 1))


def homography_from_quad(quad: FloatArray) -> FloatArray:
    """``h`` (3, 3), last entry 1, from the plane of ``quad`` (4, 2) to the unit square with its corners in order.

    Raises LinAlgError.
    """
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    (X, Y), (u, v), one, zero = square.T, quad.T, np.ones(4), np.zeros(4)
    rows = np.concatenate(
        [
            np.column_stack([u, v, one, zero, zero, zero, -X * u, -X * v]),
            np.column_stack([zero, zero, zero, u, v, one, -Y * u, -Y * v]),
        ]
    )
    return np.append(np.linalg.solve(rows, np.concatenate([X, Y])), 1.0).reshape(3, 3)


def _pixels(
    image: ImageArray, h: FloatArray, centre: FloatArray, side: float, n: int
) -> tuple[FloatArray, FloatArray]:
    """Grey levels (m,) and local places (m, 2) of the pixels within the tag and its quiet margin."""
    nothing = np.zeros(0), np.zeros((0, 2))
    low, high = -QUIET_CELLS / n, 1.0 + QUIET_CELLS / n
    outline = np.array([[low, low, 1], [high, low, 1], [high, high, 1], [low, high, 1]]) @ np.linalg.inv(h).T
    if not (outline[:, 2] > 0.0).all():
        return nothing
    outline = outline[:, :2] / outline[:, 2:] * side + centre
    height, width = image.shape
    first = np.maximum(np.floor(outline.min(axis=0)), 0).astype(np.int64)
    last = np.minimum(np.ceil(outline.max(axis=0)), [width - 1, height - 1]).astype(np.int64)
    if (last <= first).any():
        return nothing
    u = (np.arange(first[0], last[0] + 1) - centre[0]) / side
    v = (np.arange(first[1], last[1] + 1) - centre[1])[:, None] / side
    w = h[2, 0] * u + h[2, 1] * v + 1.0
    x, y = (h[0, 0] * u + h[0, 1] * v + h[0, 2]) / w, (h[1, 0] * u + h[1, 1] * v + h[1, 2]) / w
    rows, columns = np.nonzero((w > 0) & (x >= low) & (x <= high) & (y >= low) & (y <= high))
    stride = max(1, -(-len(rows) // MOST_PIXELS))
    rows, columns = rows[::stride], columns[::stride]
    grey = image[rows + first[1], columns + first[0]].astype(np.float64)
    return grey, np.column_stack([u[columns], v[rows, 0]])


def _area(quad: FloatArray) -> float:
    """Positive where the corners run clockwise as seen (v down)."""
    x, y = quad[:, 0], quad[:, 1]
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def compile_kernels() -> None:
    """Compile what the detector calls, or load it from the cache."""
    compile_for(
        accumulate, given(FLOAT, 1), given(FLOAT, 2), given(FLOAT, 2), given(FLOAT, 1), FLOAT, written(FLOAT, 2),
        written(FLOAT, 1), written(FLOAT, 1),
    )  # fmt: skip
    compile_for(
        cell_errors,
        given(FLOAT, 1),
        given(FLOAT, 2),
        given(FLOAT, 2),
        given(FLOAT, 1),
        written(FLOAT, 2),
    )


DictionaryName = Literal[
    "36h11", "36h10", "25h9", "16h5", "original", "mip_36h12",
    "4x4_50", "4x4_100", "4x4_250", "4x4_1000", "5x5_50", "5x5_100", "5x5_250", "5x5_1000",
    "6x6_50", "6x6_100", "6x6_250", "6x6_1000", "7x7_50", "7x7_100", "7x7_250", "7x7_1000",
]  # fmt: skip

_CONSTANTS = {
    "36h11": "DICT_APRILTAG_36h11",
    "36h10": "DICT_APRILTAG_36h10",
    "25h9": "DICT_APRILTAG_25h9",
    "16h5": "DICT_APRILTAG_16h5",
    "original": "DICT_ARUCO_ORIGINAL",
    "mip_36h12": "DICT_ARUCO_MIP_36h12",
    **{f"{n}x{n}_{size}": f"DICT_{n}X{n}_{size}" for n in (4, 5, 6, 7) for size in (50, 100, 250, 1000)},
}
DICTIONARIES: tuple[str, ...] = tuple(_CONSTANTS)
"""Every dictionary there is, by the name that a cell file gives it."""


@cache
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of that name. Raises KeyError."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _CONSTANTS[name]))


def size_of(name: str) -> int:
    """How many tags the dictionary has: ids 0 .. n - 1. Raises KeyError."""
    return int(dictionary(name).bytesList.shape[0])


def cells_along(name: str) -> int:
    """Cells along a side, the black border included. Raises KeyError."""
    return int(dictionary(name).markerSize) + 2


def tag_cells(name: str, tag: int) -> npt.NDArray[np.float64]:
    """Darkness (n, n) of a tag's cells, its black border included: 1 black, 0 white; rows downwards.

    Raises KeyError, IndexError.
    """
    if not 0 <= tag < size_of(name):
        raise IndexError(f"tag {tag} is not in {name}: 0..{size_of(name) - 1}")
    image = cv2.aruco.generateImageMarker(dictionary(name), tag, cells_along(name))
    return np.where(np.asarray(image) > 127, 0.0, 1.0)
