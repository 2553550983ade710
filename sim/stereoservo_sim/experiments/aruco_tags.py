"""ArUco tags in grey images, their corners registered on the whole printed pattern.

``CORNER_REFINE_SUBPIX`` looks at a few pixels about each corner; on tags of 20 px, with cells of 3 px, it
pulls the corners inwards (2 % of the side) and is unsure by up to a pixel. Here it is only the start: the
tag's known black and white cells, seen through a homography and blurred by a Gaussian, are fitted to the grey
values of the whole tag.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.special import erf

FloatArray = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]

DICTIONARY = cv2.aruco.DICT_4X4_50
DICTIONARY_NAME = "DICT_4X4_50"
TAG_IDS = 50
CELLS = 6
"""Cells along a side: four of data and the black border on both ends."""

QUIET = 0.08
"""Fitted part of the white margin [tag sides]: half a cell, which any printed tag has."""

GREY_SCALE = 5.0
"""Residual [grey levels] beyond which the fit's loss grows linearly: shadows, tape, JPEG ringing."""

LEAST_BLUR = 0.2
MOST_BLUR = 4.0
"""Bounds of the blur's sigma [px]: a pixel's own square has 0.29; more than a cell leaves no pattern."""

MIN_CORRELATION = 0.9
MAX_SHIFT_CELLS = 1.0
"""A fit that correlates less with the image, or moved a corner further from its start, is not believed."""


@dataclass(frozen=True)
class TagView:
    """One tag in one image: ``corners`` (4, 2) [px] in the dictionary's order, clockwise from the printed top
    left.

    ``start``: the corners of cv2's subpixel refinement. ``registered``: whether the pattern fit was taken.
    ``blur`` [px] and ``correlation`` of pattern and image are NaN where it was not.
    """

    corners: FloatArray
    start: FloatArray
    registered: bool
    blur: float
    correlation: float


def tag_cells(tag: int) -> FloatArray:
    """Darkness (6, 6) of the cells of ``tag``: 1 black, 0 white; rows downwards."""
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    image = cv2.aruco.generateImageMarker(dictionary, tag, CELLS)
    return np.where(np.asarray(image) > 127, 0.0, 1.0)


def find_tags(image: GreyImage) -> dict[int, FloatArray]:
    """Corners ``(4, 2)`` [px] by tag id: cv2's detector with subpixel refinement. Of a repeated id the
    larger."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY), parameters)
    corners, ids, _ = detector.detectMarkers(image)
    tags: dict[int, FloatArray] = {}
    for quad, tag in zip(corners, [] if ids is None else np.ravel(ids), strict=True):
        found = np.asarray(quad, dtype=np.float64).reshape(4, 2)
        if int(tag) not in tags or _area(found) > _area(tags[int(tag)]):
            tags[int(tag)] = found
    return tags


def register_tag(image: GreyImage, start: FloatArray, cells: FloatArray) -> TagView:
    """Fit the blurred pattern of ``cells`` (n, n) to the image about ``start`` (4, 2) [px].

    Thirteen parameters: homography (8), blur, white level with its two slopes, black level; soft-L1 loss.
    Where the fit cannot be believed the start is kept and ``registered`` is False.
    """
    start = np.asarray(start, dtype=np.float64)
    kept = TagView(start, start, False, float("nan"), float("nan"))
    pixels = _pixels_of_tag(image, start)
    if len(pixels) < 2 * 13:
        return kept
    grey = image[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    centre, side = start.mean(axis=0), float(np.sqrt(_area(start)))
    local = (pixels - centre) / side
    parameters = np.concatenate(
        [
            homography_from_quad((start - centre) / side).ravel()[:8],
            [np.log(0.6 / side), np.percentile(grey, 90), 0.0, 0.0, np.percentile(grey, 10)],
        ]
    )

    def residuals(p: FloatArray) -> FloatArray:
        return (pattern_image(p, local, cells)[0] - grey) / GREY_SCALE

    def jacobian(p: FloatArray) -> FloatArray:
        return pattern_image(p, local, cells)[1] / GREY_SCALE

    low, high = np.full(13, -np.inf), np.full(13, np.inf)
    low[8], high[8] = np.log(LEAST_BLUR / side), np.log(MOST_BLUR / side)
    fit = least_squares(
        residuals,
        parameters,
        jac=jacobian,
        bounds=(low, high),
        loss="soft_l1",
        x_scale=np.concatenate([np.full(8, 1.0 / side), [0.3], np.full(4, 30.0)]),
        max_nfev=60,
        xtol=1e-6,
        ftol=1e-6,
    )
    corners = _quad_from_homography(fit.x[:8]) * side + centre
    blur = float(np.exp(fit.x[8]) * side)
    predicted = pattern_image(fit.x, local, cells)[0]
    if not np.isfinite(predicted).all() or np.ptp(predicted) == 0.0 or np.ptp(grey) == 0.0:
        return kept
    correlation = float(np.corrcoef(predicted, grey)[0, 1])
    shift = float(np.linalg.norm(corners - start, axis=1).max())
    longest = float(np.linalg.norm(start - np.roll(start, 1, axis=0), axis=1).max())
    if not (correlation >= MIN_CORRELATION and shift <= MAX_SHIFT_CELLS * longest / len(cells)):
        return kept
    return TagView(corners, start, True, blur, correlation)


def pattern_image(
    parameters: FloatArray, points: FloatArray, cells: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Grey values ``(n,)`` at ``points`` (n, 2) of a blurred pattern, and their derivative ``(n, 13)``.

    ``parameters``: the first eight entries of the homography from points to the tag's unit square; log of the
    blur's sigma [unit of points]; white level at the middle, its slopes along the tag's axes; black level.
    Each edge is an error function of the distance over the blur, which is exact for straight edges and near
    enough at corners.
    """
    n = len(cells)
    h = np.append(parameters[:8], 1.0).reshape(3, 3)
    log_sigma, white, slope_x, slope_y, black = parameters[8:]
    u = np.column_stack([points, np.ones(len(points))])
    denominator = u @ h[2]
    u_scaled = u / denominator[:, None]
    axes = [_axis(h[i], h[2], u_scaled, denominator, log_sigma, n) for i in (0, 1)]
    (x, wx, wx_t, wx_s, grad_x), (y, wy, wy_t, wy_s, grad_y) = axes

    dark = np.einsum("pi,ij,pj->p", wy, cells, wx)
    dark_x, dark_y = np.einsum("pi,ij,pj->p", wy, cells, wx_t), np.einsum("pi,ij,pj->p", wy_t, cells, wx)
    dark_sx, dark_sy = np.einsum("pi,ij,pj->p", wy, cells, wx_s), np.einsum("pi,ij,pj->p", wy_s, cells, wx)
    lit = white + slope_x * (x - 0.5) + slope_y * (y - 0.5)
    values = lit - (lit - black) * dark

    J = np.empty((len(points), 13))
    fall = (black - lit)[:, None]
    bright = (1.0 - dark)[:, None]
    # Derivatives of the tag coordinates and of the log blur of each axis, in the rows of h.
    own_x, own_y = u_scaled, u_scaled
    J[:, 0:3] = (slope_x * bright + fall * dark_x[:, None]) * own_x + fall * dark_sx[:, None] * grad_x[:, 0:3]
    J[:, 3:6] = (slope_y * bright + fall * dark_y[:, None]) * own_y + fall * dark_sy[:, None] * grad_y[:, 0:3]
    third = -(x[:, None] * (slope_x * bright + fall * dark_x[:, None]))
    third -= y[:, None] * (slope_y * bright + fall * dark_y[:, None])
    blurred = fall * (dark_sx[:, None] * grad_x[:, 3:6] + dark_sy[:, None] * grad_y[:, 3:6])
    J[:, 6:8] = (third * u_scaled + blurred)[:, :2]
    J[:, 8] = fall[:, 0] * (dark_sx + dark_sy)
    J[:, 9] = bright[:, 0]
    J[:, 10] = bright[:, 0] * (x - 0.5)
    J[:, 11] = bright[:, 0] * (y - 0.5)
    J[:, 12] = dark
    return values, J


def _axis(
    row: FloatArray, last: FloatArray, u: FloatArray, denominator: FloatArray, log_sigma: float, n: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """One tag axis: coordinate t (p,), weights of the n cells (p, n), their derivatives in t and in the log
    blur, and the derivative (p, 6) of the log blur [tag sides] in the homography's ``row`` and ``last``."""
    t = u @ row
    gradient = (row[None, :2] - t[:, None] * last[None, :2]) / denominator[:, None]
    square = (gradient**2).sum(axis=1)
    sigma = np.exp(log_sigma) * np.sqrt(square)
    edges = np.arange(n + 1) / n
    z = (t[:, None] - edges) / (np.sqrt(2.0) * sigma[:, None])
    step = 0.5 * (1.0 + erf(z))
    bell = np.exp(-(z**2)) / np.sqrt(np.pi)
    step_t = bell / (np.sqrt(2.0) * sigma[:, None])
    step_s = -bell * z
    weights, weights_t, weights_s = (a[:, :-1] - a[:, 1:] for a in (step, step_t, step_s))

    unit = np.zeros((len(t), 2, 3))
    unit[:, 0, 0] = unit[:, 1, 1] = 1.0
    by_row = (unit - last[None, :2, None] * u[:, None, :]) / denominator[:, None, None]
    by_last = -t[:, None, None] * by_row - gradient[:, :, None] * u[:, None, :]
    by_rows = np.concatenate([by_row, by_last], axis=2)
    log_blur = np.einsum("pa,pak->pk", gradient, by_rows) / square[:, None]
    return t, weights, weights_t, weights_s, log_blur


def homography_from_quad(quad: FloatArray) -> FloatArray:
    """``h`` (3, 3), last entry 1, from the plane of ``quad`` (4, 2) to the unit square with its corners in
    order."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows, right = [], []
    for (X, Y), (u, v) in zip(square, quad, strict=True):
        rows += [[u, v, 1, 0, 0, 0, -X * u, -X * v], [0, 0, 0, u, v, 1, -Y * u, -Y * v]]
        right += [X, Y]
    return np.append(np.linalg.solve(np.array(rows), np.array(right)), 1.0).reshape(3, 3)


def _quad_from_homography(entries: FloatArray) -> FloatArray:
    inverse = np.linalg.inv(np.append(entries, 1.0).reshape(3, 3))
    square = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 1.0, 1.0]])
    q = square @ inverse.T
    corners: FloatArray = q[:, :2] / q[:, 2:]
    return corners


def _pixels_of_tag(image: GreyImage, quad: FloatArray) -> npt.NDArray[np.int64]:
    """Pixels ``(n, 2)`` (u, v) within the tag and its quiet margin."""
    centre = quad.mean(axis=0)  # where h has its last entry positive
    h = homography_from_quad(quad - centre)
    inverse = np.linalg.inv(h)
    low, high = -QUIET, 1.0 + QUIET
    outline = np.array([[low, low, 1], [high, low, 1], [high, high, 1], [low, high, 1]]) @ inverse.T
    if (outline[:, 2] <= 0).any():
        return np.zeros((0, 2), dtype=np.int64)
    outline = outline[:, :2] / outline[:, 2:] + centre
    height, width = image.shape
    first = np.maximum(np.floor(outline.min(axis=0)), 0).astype(int)
    last = np.minimum(np.ceil(outline.max(axis=0)), [width - 1, height - 1]).astype(int)
    grid = np.stack(np.meshgrid(np.arange(first[0], last[0] + 1), np.arange(first[1], last[1] + 1)), axis=-1)
    pixels = grid.reshape(-1, 2)
    q = np.column_stack([pixels - centre, np.ones(len(pixels))]) @ h.T
    tag = q[:, :2] / q[:, 2:]
    inside = (q[:, 2] > 0) & (tag >= low).all(axis=1) & (tag <= high).all(axis=1)
    chosen: npt.NDArray[np.int64] = pixels[inside].astype(np.int64)
    return chosen


def _area(quad: FloatArray) -> float:
    x, y = quad[:, 0], quad[:, 1]
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2)
