"""Corners of a tag from its whole printed pattern: the known cells, projected by a homography and blurred by a
Gaussian, are fitted to the grey values of the tag.

An independent search for each corner uses only a few pixels, and is biased inwards by blur: both legs of an L bend. All
edges of the pattern together determine the corners ten times better, with their accuracy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.numerics.compilation import kernel, reassociating_kernel
from stereoservo.numerics.linear import cholesky_solve, factor_solve
from stereoservo_drivers.detectors.homographies import inverse_of, square_to_quad
from stereoservo_drivers.detectors.kernel_types import FLOAT, IMAGE, compile_for, fields, given, written

FIRST_BLUR_PX = 1.0
"""Blur at which a fit starts by default [px]; a larger one converges from further away."""


@dataclass(frozen=True)
class Registered:
    """A registered tag: ``corners`` (4, 2) [px] and their ``covariances`` (4, 2, 2) [px²], those of the noise.

    ``noise_variance`` [levels²] of the fit's residuals, ``contrast`` [levels] between white and black at the centre,
    ``blur`` [px], ``correlation`` of pattern and image; ``misfit`` [px²]: part of the covariances from residuals that
    are correlated within a cell.
    """

    corners: FloatArray
    covariances: FloatArray
    noise_variance: float
    contrast: float
    blur: float
    correlation: float
    misfit: float


def register_tag(
    image: ImageArray, start: FloatArray, cells: FloatArray, blur_px: float = FIRST_BLUR_PX
) -> Registered | None:
    """Fit the blurred pattern of ``cells`` (n, n) to an image (h, w) around ``start`` (4, 2) [px].

    Returns None if the fit is not credible: the grey values do not follow the pattern, a cell contradicts the code, a
    corner moved by more than a cell.
    """
    corners, covariances, told = np.empty((4, 2)), np.empty((4, 2, 2)), np.empty(5)
    start = np.ascontiguousarray(start, dtype=np.float64)
    if not fit_tag(np.ascontiguousarray(image), start, cells, blur_px, (corners, covariances, told)):
        return None
    return Registered(corners, 0.5 * (covariances + covariances.transpose(0, 2, 1)), *told.tolist())


def compile_kernels() -> None:
    """Compile the kernels that the detector calls, or load them from the cache."""
    compile_for(
        fit_tag,
        IMAGE,
        given(FLOAT, 2),
        given(FLOAT, 2),
        FLOAT,
        fields(written(FLOAT, 2), written(FLOAT, 3), written(FLOAT, 1)),
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
"""Names of all dictionaries, as used in cell files."""


@cache
def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of that name. Raises KeyError."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, _CONSTANTS[name]))


def size_of(name: str) -> int:
    """Number of tags in the dictionary: ids 0 .. n - 1. Raises KeyError."""
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


# -- fit of a tag --------------------------------------------------------------------------------------------
# Compiled least-squares fit of a tag's printed pattern to grey values: first to few pixels, from any start, then to
# many.
#
# Parameters (13): homography from local pixels to the tag (8, last entry 1), log of the blur, white level, its two
# slopes, black as a share of white: a gradient of the light affects both.


PARAMETERS = 13
FEW_PIXELS, MOST_PIXELS = 250, 1500
"""Numbers of pixels, at first and at last: of larger tags every n-th pixel is used, on a lattice."""
LEAST_BLUR, MOST_BLUR = 0.2, 4.0
"""Bounds of the blur's sigma [px]: a pixel's own square has 0.29."""
REACH = 2.8
"""Distance [sigmas, times the root of 2] from an edge beyond which it has no effect: erfc(2.8) = 7.5e-5."""
HUBER = 2.5
"""Number of standard deviations beyond which residuals count linearly: shadows, scratches, ringing of JPEG."""
SIGMA_OF_MEAN = 1.2533
"""Standard deviation over mean absolute deviation of a normal distribution."""
FIRST_PASSES, LAST_PASSES = 14, 6
NEAR_PX, SETTLED_PX = 0.1, 0.02
"""Step below which the first and the last passes end, which converge quadratically [px]."""
HOPELESS = 0.3
"""Least correlation of pattern and image at the start: below it there is nothing like the tag."""
QUANTISATION = 1.0 / 12.0
"""Least noise variance [grey levels squared]: rounding to whole levels."""
MIN_CORRELATION = 0.9
MAX_SHIFT_CELLS = 1.0
"""Limits of a credible fit: least correlation with the image, and largest displacement of a corner from its start."""
MAX_CELL_ERROR = 0.45
"""Share of the contrast by which a cell's grey may deviate from the code: beyond it, it was misread, or is covered."""
SATURATED = 254.5
"""Grey level from which on a pixel may be saturated."""
TOTALS = 8
BLOCK = 128
"""Number of pixels whose derivatives are stored at a time."""
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

_FINE = 512
_Z = np.arange(int(REACH * _FINE) + 3) / _FINE
_HALF_ERF = np.array([0.5 * math.erf(z) for z in _Z])
_BELL = np.exp(-_Z * _Z) / math.sqrt(math.pi)
"""Tables for linear interpolation, with errors of 5e-7."""


@kernel
def _edge(z):
    """Blurred step (1 + erf z) / 2 and its derivative; beyond REACH a step."""
    at = abs(z) * _FINE
    if at >= REACH * _FINE:
        return (1.0 if z > 0.0 else 0.0), 0.0
    k = int(at)
    part = at - k
    half = _HALF_ERF[k] + part * (_HALF_ERF[k + 1] - _HALF_ERF[k])
    bell = _BELL[k] + part * (_BELL[k + 1] - _BELL[k])
    return (0.5 + half if z > 0.0 else 0.5 - half), bell


@kernel
def _weigh(t, scale, n, out):
    """Write to ``out`` (3, n), from its first column on, the weights of the cells with an effect at coordinate ``t``
    [cells], and their derivatives in t and in log sigma; ``scale`` is 1 / (root 2 sigma) [1/cells].

    Returns the first cell and one past the last.
    """
    reach = REACH / scale
    low, high = math.floor(t - reach), math.floor(t + reach)
    first, last = max(low, 0), min(high, n - 1)
    if first > last:
        return 0, 0
    step, step_t, step_s = 1.0, 0.0, 0.0
    if first > low:
        z = (t - first) * scale
        step, bell = _edge(z)
        step_t, step_s = bell * scale, -bell * z
    for i in range(first, last + 1):
        before, before_t, before_s = step, step_t, step_s
        step, step_t, step_s = 0.0, 0.0, 0.0
        if i < high:
            z = (t - (i + 1)) * scale
            step, bell = _edge(z)
            step_t, step_s = bell * scale, -bell * z
        out[0, i - first] = before - step
        out[1, i - first] = before_t - step_t
        out[2, i - first] = before_s - step_s
    return first, last + 1


@reassociating_kernel
def _place(us, vs, p, n, work):
    """Write for pixels at ``us``, ``vs`` (m,) to columns of ``work``: 1 / w of the homography, place (x, y) [cells],
    the scales of `_weigh` along x and y, and the two terms of `_darken` for skewed axes.
    """
    sigma = math.exp(p[8])
    for k in range(us.size):
        u, v = us[k], vs[k]
        inverse = 1.0 / (p[6] * u + p[7] * v + 1.0)
        x = (p[0] * u + p[1] * v + p[2]) * inverse
        y = (p[3] * u + p[4] * v + p[5]) * inverse
        x_u, x_v = (p[0] - x * p[6]) * inverse, (p[1] - x * p[7]) * inverse
        y_u, y_v = (p[3] - y * p[6]) * inverse, (p[4] - y * p[7]) * inverse
        along_x, along_y = x_u * x_u + x_v * x_v, y_u * y_u + y_v * y_v
        askew = x_u * y_u + x_v * y_v
        work[0, k] = inverse
        work[1, k] = x * n
        work[2, k] = y * n
        work[3, k] = math.sqrt(0.5 / along_x) / (sigma * n)
        work[4, k] = math.sqrt(0.5 / along_y) / (sigma * n)
        work[5, k] = sigma * sigma * askew * n * n
        work[6, k] = 0.5 * askew * askew / (along_x * along_y)


@kernel
def _darken(cells, work, size, across, down):
    """Write the darkness, 0 white to 1 black, at each of ``size`` pixels of `_place` to ``work``, and its derivatives
    in x and y [1/cells] and in log sigma.

    A blur that is round in the image is not separable along two skewed axes: at a corner, the bivariate normal
    distribution is used in powers of their correlation (Pearson's tetrachoric series), with two terms.
    """
    n = cells.shape[0]
    for k in range(size):
        i0, i_last = _weigh(work[1, k], work[3, k], n, across)
        j0, j_last = _weigh(work[2, k], work[4, k], n, down)
        first_order, second_order = work[5, k], work[6, k]
        dark, dark_x, dark_y, dark_s = 0.0, 0.0, 0.0, 0.0
        for j in range(j0, j_last):
            row, row_x, row_s = 0.0, 0.0, 0.0
            for i in range(i0, i_last):
                if cells[j, i] != 0.0:
                    row += across[0, i - i0]
                    row_x += across[1, i - i0]
                    row_s += across[2, i - i0]
            weight, by_t, by_s = down[0, j - j0], down[1, j - j0], down[2, j - j0]
            dark += weight * row + first_order * by_t * row_x + second_order * by_s * row_s
            dark_x += weight * row_x
            dark_y += by_t * row
            dark_s += weight * row_s + by_s * row
        work[7, k], work[8, k], work[9, k], work[10, k] = dark, dark_x, dark_y, dark_s


class Sums(NamedTuple):
    """Sums of a fit: the normal equations, the lower triangle of ``A`` (14, 14), with the right side and the sum of
    squares in the last row; ``totals`` (8,): Huber's cost, the sums of squares of the clipped residuals, of pixels that
    are not clipped, of |residual|, of model, model squared, model times grey (the three for the correlation), and of
    pixels without information.
    """

    A: FloatArray
    totals: FloatArray


@reassociating_kernel
def _differentiate(samples, p, n, work, J):
    """Residuals of the pixels of `_darken` into the last row of ``J`` (14, ...), derivatives of the model into the
    others; the model into the first row of ``work``.
    """
    grey, us, vs = samples
    for k in range(grey.size):
        u, v, inverse = us[k], vs[k], work[0, k]
        x, y, dark = work[1, k] / n, work[2, k] / n, work[7, k]
        lit = p[9] + p[10] * (x - 0.5) + p[11] * (y - 0.5)
        fall = -lit * (1.0 - p[12])
        shade = 1.0 - dark * (1.0 - p[12])
        along_x = (p[10] * shade + fall * work[8, k] * n) * inverse
        along_y = (p[11] * shade + fall * work[9, k] * n) * inverse
        along = -(along_x * x + along_y * y)
        J[0, k] = along_x * u
        J[1, k] = along_x * v
        J[2, k] = along_x
        J[3, k] = along_y * u
        J[4, k] = along_y * v
        J[5, k] = along_y
        J[6, k] = along * u
        J[7, k] = along * v
        J[8, k] = fall * work[10, k]
        J[9, k] = shade
        J[10, k] = shade * (x - 0.5)
        J[11, k] = shade * (y - 0.5)
        J[12, k] = lit * dark
        J[13, k] = grey[k] - lit * shade
        work[0, k] = lit * shade


@kernel
def _shown(p, us, vs):
    """Whether every pixel is in front of the plane of the tag."""
    least = math.inf
    for k in range(us.size):
        least = min(least, p[6] * us[k] + p[7] * vs[k] + 1.0)
    return least > 1e-3


@reassociating_kernel
def accumulate(samples, cells, p, huber, sums):
    """`Sums` of the fit at parameters ``p`` (13,), into ``sums``.

    Residuals beyond ``huber`` [levels] count linearly; a pixel at the sensor's limit with a brighter model has no
    information. Returns False if the homography does not show the tag.
    """
    grey, us, vs = samples
    A, totals = sums
    n = cells.shape[0]
    A[:] = 0.0
    totals[:] = 0.0
    if not _shown(p, us, vs):
        return False
    across, down = np.zeros((3, n)), np.zeros((3, n))
    J, work = np.empty((PARAMETERS + 1, BLOCK)), np.empty((11, BLOCK))
    for first in range(0, grey.size, BLOCK):
        size = min(BLOCK, grey.size - first)
        u, v = us[first : first + size], vs[first : first + size]
        _place(u, v, p, n, work)
        _darken(cells, work, size, across, down)
        _differentiate(Samples(grey[first : first + size], u, v), p, n, work, J)
        for k in range(size):
            value = work[0, k]
            if grey[first + k] >= SATURATED and value > grey[first + k]:
                value = grey[first + k]
                J[:, k] = 0.0
                totals[2] -= 1.0  # counted below as any other
                totals[7] += 1.0
            off = abs(J[PARAMETERS, k])
            totals[3] += off
            totals[4] += value
            totals[5] += value * value
            totals[6] += value * grey[first + k]
            if off > huber:
                root = math.sqrt(huber / off)
                for a in range(PARAMETERS + 1):
                    J[a, k] *= root
                totals[0] += huber * (off - 0.5 * huber)
                totals[1] += huber * huber
            else:
                totals[0] += 0.5 * off * off
                totals[1] += off * off
                totals[2] += 1.0
        for a in range(PARAMETERS + 1):
            for c in range(a + 1):
                total = 0.0
                for k in range(size):
                    total += J[a, k] * J[c, k]
                A[a, c] += total
    return True


@kernel
def cell_errors(samples, cells, p, out):
    """Write to ``out`` the deviation of each cell (n, n) from the grey of its code, as a share of the contrast.

    By least squares, so that a neighbour's blur is not an error; 0 for a cell without pixels.
    """
    grey, us, vs = samples
    n = cells.shape[0]
    across, down = np.zeros((3, n)), np.zeros((3, n))
    wx, wy = across[0], down[0]
    squares = np.zeros((n, n))
    out[:] = 0.0
    work = np.empty((11, grey.size))
    _place(us, vs, p, n, work)
    for k in range(grey.size):
        i_first, i_last = _weigh(work[1, k], work[3, k], n, across)
        j_first, j_last = _weigh(work[2, k], work[4, k], n, down)
        dark = 0.0
        for j in range(j_first, j_last):
            for i in range(i_first, i_last):
                dark += cells[j, i] * wy[j - j_first] * wx[i - i_first]
        lit = p[9] + p[10] * (work[1, k] / n - 0.5) + p[11] * (work[2, k] / n - 0.5)
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


@kernel
def _step(A, damping, step):
    """Solve the normal equations of `accumulate` with ``damping`` times their diagonal, into ``step`` (13,); False:
    singular.
    """
    N, b, scale = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS), np.empty(PARAMETERS)
    for a in range(PARAMETERS):
        scale[a] = math.sqrt(A[a, a] + 1e-9)
        b[a] = A[PARAMETERS, a] / scale[a]
        for c in range(a + 1):
            N[a, c] = A[a, c] / (scale[a] * scale[c])
        N[a, a] += damping
    good = cholesky_solve(N, b, step) > 0.0
    for a in range(PARAMETERS):
        step[a] /= scale[a]
    return good


@kernel
def _moved(step, side):
    """Approximate displacement of a corner by a step of the homography [px]."""
    most = 0.0
    for a in range(8):
        most = max(most, abs(step[a]))
    return most * side


@kernel
def _correlation(grey, totals):
    """Correlation of pattern and image; -1 if one of them is flat."""
    m = grey.size
    mean, square = 0.0, 0.0
    for k in range(m):
        mean += grey[k] / m
        square += grey[k] * grey[k] / m
    model = totals[4] / m
    spread = (square - mean * mean) * (totals[5] / m - model * model)
    return (totals[6] / m - model * mean) / math.sqrt(spread) if spread > 1e-9 else -1.0


@kernel
def _approach(samples, cells, p, side, sums):
    """Levenberg-Marquardt with Huber's loss from a start that may be off by some pixels, until a step is shorter than
    NEAR_PX; ``p`` and ``sums`` are those of its end. Returns False if there is nothing like the tag.
    """
    grey, (A, totals) = samples.grey, sums
    low, high = math.log(LEAST_BLUR / side), math.log(MOST_BLUR / side)
    A_new, totals_new = np.zeros_like(A), np.zeros_like(totals)
    tried = Sums(A_new, totals_new)
    step, trial = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    huber, damping = 1e6, 1e-3
    if not accumulate(samples, cells, p, huber, sums) or _correlation(grey, totals) < HOPELESS:
        return False
    for _ in range(FIRST_PASSES):
        if not _step(A, damping, step):
            return False
        trial[:] = p + step
        trial[8] = min(max(trial[8], low), high)
        if not accumulate(samples, cells, trial, huber, tried) or not totals_new[0] <= totals[0]:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        damping = max(damping * 0.1, 1e-9)
        p[:], A[:], totals[:] = trial, A_new, totals_new
        if _moved(step, side) < NEAR_PX:
            break
        huber = min(huber, max(HUBER * SIGMA_OF_MEAN * totals[3] / grey.size, 1.0))
    return True


@kernel
def _refine(samples, cells, p, side, huber, sums):
    """Gauss-Newton from a near start with Huber's loss, until a step is shorter than SETTLED_PX."""
    grey, (A, totals) = samples.grey, sums
    low, high = math.log(LEAST_BLUR / side), math.log(MOST_BLUR / side)
    step = np.zeros(PARAMETERS)
    for _ in range(LAST_PASSES):
        if not accumulate(samples, cells, p, huber, sums) or not _step(A, 1e-9, step):
            return False
        p[:PARAMETERS] += step
        p[8] = min(max(p[8], low), high)
        settled = max(HUBER * SIGMA_OF_MEAN * totals[3] / grey.size, 1.0)
        if _moved(step, side) < SETTLED_PX and huber < 1.2 * settled:
            break
        huber = min(huber, settled)
    return True


@kernel
def _clustered(samples, cells, p, huber, B):
    """Covariance ``B`` (13, 13) of the fit's gradient from the residuals, cell by cell: light that is not a plane, such
    as a shadow's edge, leaves residuals that are correlated within a cell, and do not average out as noise does.
    """
    grey, us, vs = samples
    n = cells.shape[0]
    across, down = np.zeros((3, n)), np.zeros((3, n))
    J, work = np.empty((PARAMETERS + 1, BLOCK)), np.empty((11, BLOCK))
    sums = np.zeros((n + 2, n + 2, PARAMETERS))
    for first in range(0, grey.size, BLOCK):
        size = min(BLOCK, grey.size - first)
        some = Samples(grey[first : first + size], us[first : first + size], vs[first : first + size])
        _place(some.us, some.vs, p, n, work)
        _darken(cells, work, size, across, down)
        i, j = np.floor(work[1, :size]), np.floor(work[2, :size])
        _differentiate(some, p, n, work, J)
        for k in range(size):
            off = J[PARAMETERS, k]
            if grey[first + k] >= SATURATED and off < 0.0:
                continue
            off = min(max(off, -huber), huber)
            row = sums[min(max(int(j[k]), -1), n) + 1, min(max(int(i[k]), -1), n) + 1]
            for a in range(PARAMETERS):
                row[a] += J[a, k] * off
    B[:] = 0.0
    for j in range(n + 2):
        for i in range(n + 2):
            for a in range(PARAMETERS):
                for c in range(PARAMETERS):
                    B[a, c] += sums[j, i, a] * sums[j, i, c]


@kernel
def _corners(place, A, B, variance, corners, covariances):
    """Images (4, 2) [px] of the tag's corners and their covariances (4, 2, 2) [px²] for this noise variance, larger if
    the gradient's covariance ``B`` (13, 13) exceeds that of such noise. Returns the variance [px²] that this adds, in
    the mean over the coordinates; -1 if the normal equations are singular.
    """
    h, g, u0, v0, side = place
    scale, e, column = np.empty(PARAMETERS), np.zeros(PARAMETERS), np.empty(PARAMETERS)
    N, C = np.empty((PARAMETERS, PARAMETERS)), np.empty((PARAMETERS, PARAMETERS))
    for a in range(PARAMETERS):
        scale[a] = math.sqrt(A[a, a] + 1e-9)
        for c in range(a + 1):
            N[a, c] = A[a, c] / (scale[a] * scale[c])
    for a in range(PARAMETERS):
        e[:] = 0.0
        e[a] = 1.0
        if a == 0:
            if not cholesky_solve(N, e, column) > 0.0:
                return -1.0
        else:
            factor_solve(N, e, column)
        for c in range(PARAMETERS):
            C[c, a] = column[c] / (scale[a] * scale[c])
    M, half = np.zeros((8, 8)), np.zeros((8, PARAMETERS))
    for a in range(8):
        for c in range(PARAMETERS):
            for k in range(PARAMETERS):
                half[a, c] += C[a, k] * B[k, c]
    for a in range(8):
        for c in range(8):
            for k in range(PARAMETERS):
                M[a, c] += half[a, k] * C[k, c]
    seen, mean = 0.0, 0.0
    back = np.zeros((2, 8))
    for k in range(4):
        x, y = SQUARE[k, 0], SQUARE[k, 1]
        w = g[6] * x + g[7] * y + 1.0
        u, v = (g[0] * x + g[1] * y + g[2]) / w, (g[3] * x + g[4] * y + g[5]) / w
        corners[k, 0], corners[k, 1] = u * side + u0, v * side + v0
        # the place where the tag's coordinates are (x, y) moves by -(d(x, y)/d(u, v))^-1 d(x, y)/dh; signs cancel
        a, b, c, d = h[0] - x * h[6], h[1] - x * h[7], h[3] - y * h[6], h[4] - y * h[7]
        determinant = a * d - b * c
        if not abs(determinant) > 1e-12:
            return -1.0
        for i in range(3):
            local = u if i == 0 else (v if i == 1 else 1.0)
            back[0, i], back[1, i] = d * local / determinant, -c * local / determinant
            back[0, 3 + i], back[1, 3 + i] = -b * local / determinant, a * local / determinant
            if i < 2:
                back[0, 6 + i] = -(d * x - b * y) * local / determinant
                back[1, 6 + i] = -(a * y - c * x) * local / determinant
        for i in range(2):
            for j in range(2):
                total, real = 0.0, 0.0
                for s in range(8):
                    for t in range(8):
                        total += back[i, s] * C[s, t] * back[j, t]
                        real += back[i, s] * M[s, t] * back[j, t]
                covariances[k, i, j] = total * variance * side * side
                if i == j:
                    mean += 0.125 * covariances[k, i, j]
                    seen += 0.125 * real / max(total * variance, 1e-30)
    more = max(seen - 1.0, 0.0)
    covariances *= 1.0 + more
    return more * mean


@kernel
def fit_tag(image, start, cells, blur_px, found):
    """Fit the pattern of ``cells`` (n, n) to an image (h, w) around ``start`` (4, 2) [px], with an initial blur of
    ``blur_px``. Writes to ``found``: corners (4, 2), covariances (4, 2, 2), and (5,) noise variance, contrast, blur,
    correlation, and the part of the covariances [px²] that is misfit.

    Returns False if the fit is not credible.
    """
    corners, covariances, told = found
    n = cells.shape[0]
    u0, v0 = start[:, 0].mean(), start[:, 1].mean()
    area, longest = 0.0, 0.0
    for k in range(4):
        j = (k + 1) % 4
        area += 0.5 * (start[k, 0] * start[j, 1] - start[j, 0] * start[k, 1])
        longest = max(longest, math.hypot(start[k, 0] - start[j, 0], start[k, 1] - start[j, 1]))
    if not 1.0 < area < math.inf:
        return False
    side = math.sqrt(area)
    quad = np.empty((4, 2))
    for k in range(4):
        quad[k, 0], quad[k, 1] = (start[k, 0] - u0) / side, (start[k, 1] - v0) / side
    p, h, g = np.zeros(PARAMETERS), np.empty(9), np.empty(9)
    if not square_to_quad(quad, g) or not inverse_of(g, h):
        return False
    grey, us, vs = np.empty(2 * MOST_PIXELS), np.empty(2 * MOST_PIXELS), np.empty(2 * MOST_PIXELS)
    place, room = TagPlace(h, g, u0, v0, side), Samples(grey, us, vs)
    few = sample_tag(image, place, n, FEW_PIXELS, room)
    if few < 4 * PARAMETERS:
        return False
    black, white = percentiles(grey[:few])
    p[:8] = h[:8]
    p[8], p[9], p[12] = math.log(blur_px / side), white, black / max(white, 1.0)
    A, totals = np.zeros((PARAMETERS + 1, PARAMETERS + 1)), np.zeros(TOTALS)
    if not _approach(Samples(grey[:few], us[:few], vs[:few]), cells, p, side, Sums(A, totals)):
        return False
    huber = max(HUBER * SIGMA_OF_MEAN * totals[3] / few, 1.0)
    h[:8] = p[:8]
    if not inverse_of(h, g):
        return False
    m = sample_tag(image, place, n, MOST_PIXELS, room)
    samples = Samples(grey[:m], us[:m], vs[:m])
    if m < 4 * PARAMETERS or not _refine(samples, cells, p, side, huber, Sums(A, totals)):
        return False
    correlation = _correlation(samples.grey, totals)
    if not correlation >= MIN_CORRELATION or totals[2] < 2 * PARAMETERS:
        return False
    errors = np.zeros((n, n))
    cell_errors(samples, cells, p, errors)
    if not errors.max() <= MAX_CELL_ERROR:
        return False
    # Huber's estimator: E[psi²] / E[psi']², over the matrix of all pixels, the sum of which A nearly is
    told_by = m - totals[7]
    variance = max(totals[1] / (told_by - PARAMETERS) * (told_by / totals[2]), QUANTISATION)
    B = np.empty((PARAMETERS, PARAMETERS))
    _clustered(samples, cells, p, huber, B)
    h[:8] = p[:8]
    if not inverse_of(h, g):
        return False
    told[4] = _corners(place, A, B, variance, corners, covariances)
    if not told[4] >= 0.0:
        return False
    shift = 0.0
    for k in range(4):
        shift = max(shift, math.hypot(corners[k, 0] - start[k, 0], corners[k, 1] - start[k, 1]))
    told[0], told[1], told[2], told[3] = variance, p[9] * (1.0 - p[12]), math.exp(p[8]) * side, correlation
    return np.isfinite(covariances).all() and shift <= MAX_SHIFT_CELLS * longest / n


# -- samples of tags -----------------------------------------------------------------------------------------
# Pixels of a tag, by its homography: their grey values and places, for the fit of its pattern. Numba kernels; no
# state.


QUIET_CELLS = 0.5
"""Fitted part of the white margin [cells]; a printed tag has at least one cell."""


class Samples(NamedTuple):
    """Levels ``grey`` (m,) of pixels at local places ``us``, ``vs`` (m,)."""

    grey: FloatArray
    us: FloatArray
    vs: FloatArray


class TagPlace(NamedTuple):
    """Location of a tag: homography ``h`` (9,) from local places to the tag, and its inverse ``g`` (9,); (``u0``,
    ``v0``) and ``side`` [px]: origin and unit of local places.
    """

    h: FloatArray
    g: FloatArray
    u0: float
    v0: float
    side: float


@kernel
def sample_tag(image, place, n, most, samples):
    """Write to ``samples`` the pixels within the tag of ``n`` cells per side and its quiet margin, about ``most`` of
    them on a lattice, in the first rows and at most as many as fit; returns their number.
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
