"""Images of textured planes and of chessboards, in which every pixel is the image of a known point, and methods that
find points in them: the product's chessboard finder and its detector of natural features, and a tracker like the
thesis's (4.5.1).
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from stereoservo.geometry.fundamental import fundamental_robust
from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, Frame, Prior
from stereoservo_drivers.chessboard import find_corners
from stereoservo_drivers.detectors.corners import CornerDetector
from stereoservo_drivers.detectors.landmark_learning import LearningSettings, learn_landmarks
from stereoservo_drivers.detectors.landmarks import encode_landmarks
from stereoservo_sim.world.camera_rig import PinholeCamera

LAYERS = ((30.0, 1.0), (22.0, 2.5), (14.0, 7.0))
"""Contrast [grey levels] and coarseness, relative to the finest, of the layers of a texture."""
MEAN_GREY, BACKGROUND = 125.0, 60.0


def texture(rng: np.random.Generator, side: int = 256, scale: float = 1.6) -> FloatArray:
    """Grey levels (side, side) without structures finer than ``scale`` texels, and with coarser ones."""
    image = np.full((side, side), MEAN_GREY)
    for contrast, factor in LAYERS:
        field = gaussian_filter(rng.normal(size=(side, side)), scale * factor)
        image += contrast * field / field.std()
    return image


@dataclass(frozen=True, eq=False)
class Face:
    """A parallelogram with ``grey`` (s, s) on it, spanned by ``origin``, ``across``, ``down`` (3,) [m]."""

    grey: FloatArray
    origin: FloatArray
    across: FloatArray
    down: FloatArray

    def texels(self, P: FloatArray, shift: FloatArray) -> FloatArray:
        """Homography (3, 3) from texels to pixels of a camera ``P`` (3, 4), the face moved by ``shift`` (3,) [m]."""
        side = self.grey.shape[0]
        columns = np.column_stack([self.across / (side - 1), self.down / (side - 1), self.origin + shift])
        return np.asarray(P @ np.vstack([columns, [0.0, 0.0, 1.0]]))


@dataclass(frozen=True, eq=False)
class TexturedBody:
    """A body of ``faces``; nearer ones occlude those behind, pixel by pixel."""

    faces: Sequence[Face]

    def picture(
        self, camera: PinholeCamera, shift: FloatArray, rng: np.random.Generator, noise_grey: float
    ) -> ImageArray:
        """Image (h, w) with the body moved by ``shift`` (3,) [m]. Raises ValueError unless all of it is before the
        camera.
        """
        grey = self._layers(camera, shift)[0]
        grey = grey + rng.normal(0.0, noise_grey, grey.shape)
        return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))

    def points(self, camera: PinholeCamera, pixels: FloatArray, shift: FloatArray) -> FloatArray:
        """Points (m, 3) [m] of the body, moved by ``shift`` (3,), that are seen at ``pixels`` (m, 2); NaN for
        background.
        """
        _, owner = self._layers(camera, shift)
        u, v = np.rint(pixels).astype(int).T
        found = np.full((len(pixels), 3), np.nan)
        for k, face in enumerate(owner[v, u].tolist()):
            if face < 0:
                continue
            one = self.faces[face]
            x, y, w = np.linalg.solve(one.texels(camera.P, shift), np.append(pixels[k], 1.0))
            side = one.grey.shape[0] - 1
            found[k] = one.origin + shift + one.across * x / w / side + one.down * y / w / side
        return found

    def _layers(self, camera: PinholeCamera, shift: FloatArray) -> tuple[FloatArray, IntArray]:
        """Grey levels (h, w) and the visible face (h, w), -1 for none."""
        shape = camera.height, camera.width
        image, nearest = np.full(shape, BACKGROUND), np.full(shape, np.inf)
        owner = np.full(shape, -1, np.int64)
        for f, face in enumerate(self.faces):
            H, side = face.texels(camera.P, shift), face.grey.shape[0] - 1
            left, top, right, bottom = _box(H, side, camera)
            v, u = np.mgrid[top:bottom, left:right]
            texel = np.linalg.solve(H, np.stack([u.ravel(), v.ravel(), np.ones(u.size)]))
            # For the scaled ray this is the depth in the camera, since K's last row is (0, 0, 1).
            depth = 1.0 / texel[2]
            x, y = texel[:2] / texel[2]
            window = slice(top, bottom), slice(left, right)
            seen = (x >= 0) & (y >= 0) & (x <= side) & (y <= side) & (depth < nearest[window].ravel())
            part = seen.reshape(u.shape)
            grey = map_coordinates(face.grey, [y[seen], x[seen]], order=3, mode="nearest")
            image[window][part], nearest[window][part], owner[window][part] = grey, depth[seen], f
        return image, owner


def _box(H: FloatArray, side: int, camera: PinholeCamera) -> tuple[int, int, int, int]:
    """Left, top, right, bottom [px] of the image of a face before the camera, right and bottom exclusive."""
    corners = np.array([[0, 0, 1], [side, 0, 1], [side, side, 1], [0, side, 1.0]]) @ H.T
    if corners[:, 2].min() <= 0.0:
        raise ValueError("a face reaches behind the camera; all corners of a textured body must lie before it")
    ends = corners[:, :2] / corners[:, 2:]
    size = [camera.width, camera.height]
    low = np.clip(np.floor(ends.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(ends.max(axis=0)) + 1, 0, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


# -- chessboards -----------------------------------------------------------------------------------------------

SQUARES, SIDE = 8, 0.025
"""Number of squares along a board, and their side [m]."""
CORNERS = SQUARES - 1
EDGE, BORDER = 0.005, 0.0125
"""Width of the bright border towards the other board, and around [m]."""
TEXELS, SOFT = 560, 1.2
"""Texels along a board, and softness of its edges [texels]."""
FINE = 32
"""Samples per texel that contains an edge."""
BRIGHT, DARK = 205.0, 45.0


def board_points(distance: float) -> FloatArray:
    """The inner corners (98, 3) [m] of both boards, row by row, the common edge ``distance`` [m] ahead."""
    across, up = np.meshgrid(EDGE + SIDE * np.arange(1, SQUARES), SIDE * (np.arange(CORNERS) - 3.0))
    half = np.sqrt(0.5)
    sides = [np.stack([turn * half * across, up, half * across], axis=-1)[:, ::turn].reshape(-1, 3) for turn in (-1, 1)]
    return np.asarray(np.vstack(sides) + np.array([0.0, 0.0, distance]))


def boards(distance: float) -> TexturedBody:
    """Both boards, the common edge ``distance`` [m] ahead, nearest to the cameras."""
    length, half = EDGE + SQUARES * SIDE + BORDER, np.sqrt(0.5)
    high = 0.5 * SQUARES * SIDE + BORDER
    across, sign_across = _stripes(length, EDGE)
    along, sign_along = _stripes(2.0 * high, BORDER)
    dark = 0.5 * (np.outer(along, across) + np.outer(sign_along, sign_across))
    grey = gaussian_filter(BRIGHT + (DARK - BRIGHT) * dark, SOFT)
    edge = np.array([0.0, -high, distance])
    down = np.array([0.0, 2.0 * high, 0.0])
    return TexturedBody([Face(grey, edge, length * np.array([side * half, 0.0, half]), down) for side in (-1.0, 1.0)])


def _stripes(length: float, begin: float) -> tuple[FloatArray, FloatArray]:
    """For each texel along ``length`` [m], with squares from ``begin`` on: the share that they cover, and the sign,
    which alternates from square to square.
    """
    step = length / (TEXELS - 1)
    fine = step * (np.arange(TEXELS)[:, None] + (np.arange(FINE) + 0.5) / FINE - 0.5)
    column = np.floor((fine - begin) / SIDE)
    inside = (column >= 0) & (column < SQUARES)
    return inside.mean(axis=1), (inside * (1.0 - 2.0 * (column % 2))).mean(axis=1)


def find_boards(image: ImageArray) -> FloatArray | None:
    """Inner corners (98, 2) [px] of both boards, the left one first, row by row; None unless both are found."""
    left_over, found = image.copy(), []
    for _ in range(2):
        pixels = find_corners(left_over, CORNERS, CORNERS)
        if pixels is None:
            return None
        grid = upright(pixels.reshape(CORNERS, CORNERS, 2))
        found.append(grid)
        # Corners, extrapolated by a square on every side.
        ends = grid[[0, 0, -1, -1], [0, -1, -1, 0]]
        outline = ends + (ends - ends.mean(axis=0)) * (2.0 / (CORNERS - 1))
        cv2.fillConvexPoly(left_over, np.rint(outline).astype(np.int32), int(BRIGHT))
    found.sort(key=lambda grid: float(grid[..., 0].mean()))
    return np.concatenate([grid.reshape(-1, 2) for grid in found])


def upright(grid: FloatArray) -> FloatArray:
    """The corners (n, n, 2) [px] of an upright board: rows downwards, columns to the right."""
    along = grid[0, -1] - grid[0, 0]
    if abs(along[1]) > abs(along[0]):
        grid = grid.transpose(1, 0, 2)
    if grid[0, -1, 0] < grid[0, 0, 0]:
        grid = grid[:, ::-1]
    return grid[::-1] if grid[-1, 0, 1] < grid[0, 0, 1] else grid


# -- a tracker like the thesis's -------------------------------------------------------------------------------

HALF, BACK_REACH = 7, 4
"""Half the side of a window, and search radius of the reverse match [px]."""
LEAST_CORRELATION = 0.8
BACK_PX = 0.5
"""A point whose reverse match is this far from its origin is lost."""


def follow(pictures: Sequence[ImageArray], first: FloatArray, reach: int) -> FloatArray:
    """Pixels (s, m, 2) of points at ``first`` (m, 2) in the first of s images, NaN from the image in which a point is
    lost: nothing correlates within ``reach`` [px] of the whole image's shift, or the reverse match leads elsewhere.
    """
    found = np.full((len(pictures), *first.shape), np.nan)
    found[0] = first
    for k in range(1, len(pictures)):
        before, after = pictures[k - 1], pictures[k]
        alive = np.flatnonzero(np.isfinite(found[k - 1]).all(axis=1))
        if len(alive) == 0:
            break
        way = _shift(before, after, found[k - 1, alive])
        for i in alive:
            there = _displacement(before, after, found[k - 1, i], way, reach)
            if np.isnan(there).any():
                continue
            back = _displacement(after, before, found[k - 1, i] + there, -np.rint(there).astype(int), BACK_REACH)
            if np.hypot(*(there + back)) < BACK_PX:
                found[k, i] = found[k - 1, i] + there
    return found


def _shift(before: ImageArray, after: ImageArray, points: FloatArray) -> IntArray:
    """Shift (2,) [px] of the part of an image that holds the ``points`` (m, 2)."""
    left, top = np.maximum(np.floor(points.min(axis=0)).astype(int) - HALF, 0)
    right, bottom = np.ceil(points.max(axis=0)).astype(int) + HALF + 1
    score = cv2.matchTemplate(after, before[top:bottom, left:right], cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    return np.array([column - left, row - top])


def _displacement(before: ImageArray, after: ImageArray, point: FloatArray, way: IntArray, reach: int) -> FloatArray:
    """Displacement (2,) [px] of the window around a ``point`` (2,), near ``way`` (2,); NaN if none is found."""
    u, v = (int(x) for x in np.rint(point))
    x, y = u + int(way[0]), v + int(way[1])
    height, width = before.shape
    far = HALF + reach
    inside = HALF <= u < width - HALF and HALF <= v < height - HALF
    if not (inside and far <= x < width - far and far <= y < height - far):
        return np.full(2, np.nan)
    window = before[v - HALF : v + HALF + 1, u - HALF : u + HALF + 1]
    region = after[y - far : y + far + 1, x - far : x + far + 1]
    score = cv2.matchTemplate(region, window, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(score)
    if best < LEAST_CORRELATION or not (0 < row < 2 * reach and 0 < column < 2 * reach):
        return np.full(2, np.nan)
    summit = _summit(score[row - 1 : row + 2, column - 1 : column + 2].astype(np.float64))
    return np.asarray(way + np.array([column, row]) - reach + summit)


def _summit(peak: FloatArray) -> FloatArray:
    """Maximum (2,) [px] (u, v) of the least-squares paraboloid through 3 x 3 values, from their centre."""
    a, b, c, d, e = PARABOLOID @ peak.ravel()
    offset = np.array([d * b - 2.0 * e * a, d * a - 2.0 * c * b]) / (4.0 * c * e - d * d)
    return np.clip(offset, -1.0, 1.0)


def _paraboloid() -> FloatArray:
    """Matrix (5, 9) of the coefficients of u, v, u², uv, v² of the least-squares paraboloid through 3 x 3 values."""
    v, u = np.mgrid[-1:2, -1:2].reshape(2, -1)
    return np.asarray(np.linalg.pinv(np.column_stack([np.ones(9), u, v, u * u, u * v, v * v]))[1:])


PARABOLOID = _paraboloid()


# -- the product's detectors -----------------------------------------------------------------------------------

PERIOD_NS = 33_000_000


def context_of(camera: str, folder: Path = Path()) -> DriverContext:
    """Cell data for a detector used alone."""
    return DriverContext(MonotonicClock(), "pictures", folder, folder, camera)


def prior_at(camera: str, t_ns: int, ids: IntArray, pixels: FloatArray, variance: float) -> Prior:
    """Prior of markers ``ids`` (n,) at ``pixels`` (n, 2), with a ``variance`` [px²] per axis."""
    covariances = np.tile(variance * np.eye(2), (len(pixels), 1, 1))
    return Prior(camera, t_ns, np.asarray(ids, dtype=np.int64), pixels, np.zeros_like(pixels), covariances)


@dataclass(frozen=True, eq=False)
class LandmarkTracks:
    """Landmarks that both cameras found in all of s images: ``ids`` (m,), ``pixels`` (s, 2, m, 2), and ``sigmas``
    (s, 2, m) [px] per axis as stated by the detector. ``learnt``: number in the first images.
    """

    ids: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    learnt: int


def landmark_tracks(
    pictures: Mapping[str, Sequence[ImageArray]], settings: LearningSettings | None = None
) -> LandmarkTracks:
    """Landmarks of the first images of two cameras in all ``pictures``, which are equally many for each camera.

    Raises DriverError if the first ones show too few.
    """
    landmarks, _ = learn_landmarks({name: images[:1] for name, images in pictures.items()}, None, settings)
    stops, m = len(next(iter(pictures.values()))), len(landmarks.ids)
    pixels, sigmas = np.full((stops, len(pictures), m, 2), np.nan), np.zeros((stops, len(pictures), m))
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder)
        (directory / "landmarks.npz").write_bytes(encode_landmarks(landmarks))
        for c, (name, images) in enumerate(pictures.items()):
            detector = CornerDetector({"landmarks": "landmarks.npz"}, context_of(name, directory))
            for k, image in enumerate(images):
                t_ns = (k + 1) * PERIOD_NS
                seen = detector.detect(Frame(name, k + 1, t_ns, t_ns, image), None)
                rows = np.searchsorted(landmarks.ids, seen.ids)
                pixels[k, c, rows] = seen.pixels
                sigmas[k, c, rows] = np.sqrt(0.5 * np.trace(seen.covariances, axis1=1, axis2=2))
    everywhere = np.isfinite(pixels).all(axis=(0, 1, 3))
    return LandmarkTracks(landmarks.ids[everywhere], pixels[:, :, everywhere], sigmas[:, :, everywhere], m)


def epipolar_geometry(tracks: LandmarkTracks) -> FloatArray:
    """``F`` (3, 3) of the two cameras by all matches of all images. Raises GeometryError."""
    left, right = (tracks.pixels[:, c].reshape(-1, 2) for c in (0, 1))
    sigma = float(np.sqrt(np.mean(tracks.sigmas**2)))
    return fundamental_robust(left, right, sigma)[0]
