"""Detector of the inner corners of a chessboard, for cameras that are calibrated with one: OpenCV's search, refined to
the saddle points.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.devices import CameraObservation, DetectorDescription, DriverContext, DriverError, Frame, Prior
from stereoservo_drivers.detectors.tag_registration import DictionaryName, dictionary
from stereoservo_drivers.frame_images import gray_image
from stereoservo_drivers.options import decode_options

SIGMA_PX = 0.1
"""Standard deviation of a corner per axis [px], for sharp pictures; a calibration estimates its own."""
WINDOW_SHARE = 0.3
"""Half the side of the refinement window, as a share of the least distance of two corners: with 0.4, structures beside
a slanted board have shifted a corner by 4 px.
"""
LARGEST_WINDOW = 11
LEAST_CHARUCO = 6
"""Least number of corners beside a ChArUco board's tags."""
ITERATIONS, CONVERGED = 60, 1e-4


class ChessboardOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera.detector_options]`` of the detector ``chessboard``: numbers of inner corners."""

    columns: Annotated[int, Meta(ge=3, le=64)]
    rows: Annotated[int, Meta(ge=3, le=64)]
    thorough: bool = False
    """Search by OpenCV's sector-based method first: slower where there is no board, better in blurred and infrared
    pictures. Boards that look alike after half a turn are accepted: which of both orders it is, is left to the reader.
    """
    dictionary: DictionaryName | None = None
    """Of a ChArUco board; both of its patterns are tried. Its tags are found where the corners are not all visible."""
    marker_share: Annotated[float, Meta(gt=0, lt=1)] = 0.75
    """Side of its tags relative to the squares."""


class ChessboardDetector:
    """Detects all inner corners of one board, or none; ids row by row, from the corner whose inner and outer squares
    are dark.

    One count must be odd and the other even; otherwise the board looks the same after half a turn. Raises DriverError:
    ``option`` at construction, ``image_format`` by :meth:`detect`; content never raises.
    """

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self.options = decode_options(ChessboardOptions, options, f"detector of camera {context.camera!r}")
        self.camera = context.camera
        if (self.options.columns + self.options.rows) % 2 == 0 and not self.options.thorough:
            raise DriverError(
                "option",
                f"a board of {self.options.columns}x{self.options.rows} inner corners looks alike after half a turn; "
                "an odd and an even count are valid, such as 9x6",
            )

    def describe(self) -> DetectorDescription:
        """The ids of all corners."""
        return DetectorDescription("chessboard", tuple(range(self.options.columns * self.options.rows)), SIGMA_PX)

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """The corners in ``frame``; a prior is not used."""
        options, image = self.options, gray_image(frame, self.camera)
        pixels = find_corners(image, options.columns, options.rows, options.thorough)
        ids = np.arange(0 if pixels is None else len(pixels))
        if options.dictionary is not None:
            ids, pixels = _with_tags(image, options, pixels)
        count = len(ids)
        return CameraObservation(
            self.camera,
            frame.seq,
            frame.t_shutter_ns,
            frame.t_received_ns,
            ids,
            np.zeros((0, 2)) if pixels is None else pixels,
            np.tile(SIGMA_PX**2 * np.eye(2), (count, 1, 1)),
        )


def _with_tags(
    image: ImageArray, options: ChessboardOptions, pixels: FloatArray | None
) -> tuple[npt.NDArray[np.int64], FloatArray | None]:
    """Ids (k,) and pixels (k, 2) of a ChArUco board: all corners, turned as the tags say, or those beside its tags."""
    best: tuple[npt.NDArray[np.int64], FloatArray] = np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    for legacy in (False, True):
        board = cv2.aruco.CharucoBoard(
            (options.columns + 1, options.rows + 1), 1.0, options.marker_share, dictionary(options.dictionary)
        )
        board.setLegacyPattern(legacy)
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        if ids is not None and len(ids) > len(best[0]):
            best = np.ravel(ids).astype(np.int64), np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    if pixels is None:
        return best if len(best[0]) >= LEAST_CHARUCO else (np.zeros(0, dtype=np.int64), None)
    distances = [np.linalg.norm(order[best[0]] - best[1], axis=1).sum() for order in (pixels, pixels[::-1])]
    return np.arange(len(pixels)), pixels if distances[0] <= distances[1] else pixels[::-1]


def find_corners(image: ImageArray, columns: int, rows: int, thorough: bool = False) -> FloatArray | None:
    """Inner corners (rows * columns, 2) [px] of the board in ``image``, row by row; None if it is not completely
    visible.
    """
    if thorough:
        found, corners = cv2.findChessboardCornersSB(
            image, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        )
        if found:
            return _in_order(image, np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2))
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(image, (columns, rows), flags=flags)
    if not found:
        return None
    grid = np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2)
    nearest = min(float(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min()) for axis in (0, 1))
    half = int(np.clip(WINDOW_SHARE * nearest, 2, LARGEST_WINDOW))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, CONVERGED)
    refined = cv2.cornerSubPix(image, grid.reshape(-1, 1, 2).astype(np.float32), (half, half), (-1, -1), criteria)
    return _in_order(image, np.asarray(refined, dtype=np.float64).reshape(rows, columns, 2))


def _in_order(image: ImageArray, grid: FloatArray) -> FloatArray:
    """Corners (rows * columns, 2) of a grid (rows, columns, 2), seen from the front, from the dark corner on."""
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0.0:
        grid = grid[::-1]  # counted counter-clockwise: the board is seen from its front
    if _first_is_bright(image, grid):
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid.reshape(-1, 2))


def _first_is_bright(image: ImageArray, grid: FloatArray) -> bool:
    """Whether the square inside the first corner is a bright one, judged from all squares, since one may have glare."""
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    smooth = cv2.blur(image, (3, 3))
    u, v = np.clip(np.round(middles), 0, np.array(image.shape[::-1]) - 1).astype(int).transpose(2, 0, 1)
    levels = smooth[v, u].astype(np.float64)
    signs = 1.0 - 2.0 * (np.add(*np.indices(levels.shape)) % 2)
    return bool((signs * levels).sum() > 0.0)
