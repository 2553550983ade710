"""The grid of fig. 3.6 as two chessboards at a right angle: their pictures, and their corners as the product finds
them.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo_drivers.chessboard import find_corners
from stereoservo_sim.experiments.pictures.textured import Face, TexturedBody

SQUARES, SIDE = 8, 0.025
"""Squares along a board, and their side [m]."""
CORNERS = SQUARES - 1
EDGE, BORDER = 0.005, 0.0125
"""[m] Of bright border towards the other board, and around."""
TEXELS, SOFT = 560, 1.2
"""Along a board, and how soft its edges are [texels]."""
FINE = 32
"""Samples of a texel that an edge may cross."""
BRIGHT, DARK = 205.0, 45.0


def board_points(distance: float) -> FloatArray:
    """The inner corners (98, 3) [m] of both boards, row by row, the common edge ``distance`` [m] ahead."""
    across, up = np.meshgrid(EDGE + SIDE * np.arange(1, SQUARES), SIDE * (np.arange(CORNERS) - 3.0))
    half = np.sqrt(0.5)
    sides = [
        np.stack([turn * half * across, up, half * across], axis=-1)[:, ::turn].reshape(-1, 3)
        for turn in (-1, 1)
    ]
    return np.asarray(np.vstack(sides) + np.array([0.0, 0.0, distance]))


def boards(distance: float) -> TexturedBody:
    """Both boards, the common edge ``distance`` [m] ahead, towards the cameras."""
    length, half = EDGE + SQUARES * SIDE + BORDER, np.sqrt(0.5)
    high = 0.5 * SQUARES * SIDE + BORDER
    across, sign_across = _stripes(length, EDGE)
    along, sign_along = _stripes(2.0 * high, BORDER)
    dark = 0.5 * (np.outer(along, across) + np.outer(sign_along, sign_across))
    grey = gaussian_filter(BRIGHT + (DARK - BRIGHT) * dark, SOFT)
    edge = np.array([0.0, -high, distance])
    down = np.array([0.0, 2.0 * high, 0.0])
    return TexturedBody(
        [Face(grey, edge, length * np.array([side * half, 0.0, half]), down) for side in (-1.0, 1.0)]
    )


def _stripes(length: float, begin: float) -> tuple[FloatArray, FloatArray]:
    """Of each texel along ``length`` [m], of which the squares take a part from ``begin`` on: what share of it they
    cover, and with which sign, which changes from square to square.
    """
    step = length / (TEXELS - 1)
    fine = step * (np.arange(TEXELS)[:, None] + (np.arange(FINE) + 0.5) / FINE - 0.5)
    column = np.floor((fine - begin) / SIDE)
    inside = (column >= 0) & (column < SQUARES)
    return inside.mean(axis=1), (inside * (1.0 - 2.0 * (column % 2))).mean(axis=1)


def find_boards(image: ImageArray) -> FloatArray | None:
    """Inner corners (98, 2) [px] of both boards, the left one first, row by row; None where not both are found."""
    left_over, found = image.copy(), []
    for _ in range(2):
        pixels = find_corners(left_over, CORNERS, CORNERS)
        if pixels is None:
            return None
        grid = upright(pixels.reshape(CORNERS, CORNERS, 2))
        found.append(grid)
        # Corners, continued by a square on every side.
        ends = grid[[0, 0, -1, -1], [0, -1, -1, 0]]
        outline = ends + (ends - ends.mean(axis=0)) * (2.0 / (CORNERS - 1))
        cv2.fillConvexPoly(left_over, np.rint(outline).astype(np.int32), int(BRIGHT))
    found.sort(key=lambda grid: float(grid[..., 0].mean()))
    return np.concatenate([grid.reshape(-1, 2) for grid in found])


def upright(grid: FloatArray) -> FloatArray:
    """The corners (n, n, 2) [px] of a board that stands upright: rows downwards, columns to the right."""
    along = grid[0, -1] - grid[0, 0]
    if abs(along[1]) > abs(along[0]):
        grid = grid.transpose(1, 0, 2)
    if grid[0, -1, 0] < grid[0, 0, 0]:
        grid = grid[:, ::-1]
    return grid[::-1] if grid[-1, 0, 1] < grid[0, 0, 1] else grid
