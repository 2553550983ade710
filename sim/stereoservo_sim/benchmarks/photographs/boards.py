"""Chessboards and natural corners on photographs: the product's beside OpenCV's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo_drivers.chessboard import find_corners
from stereoservo_drivers.detectors.patch_alignment import ReferencePatches, build_pyramid
from stereoservo_sim.benchmarks.photographs.pictures import Photographs, Row, over, read

COLUMNS, ROWS = 9, 6
FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
Board = FloatArray | None
WRONG_PX = 3.0
"""A chessboard of which a corner is farther than this from where most detectors have it is a false one."""
CORNERS, APART_PX = 150, 12
CLOSE_PX, FALSE_PX = 1.0, 1.5
"""A corner of table or wall is found within the first of its place; beyond the second it is false."""
PATCH = 10
"""Half the side of a corner's patch and of OpenCV's window [px]."""


def _raw(image: ImageArray) -> Board:
    found, corners = cv2.findChessboardCorners(image, (COLUMNS, ROWS), flags=FLAGS)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None


def _sectors(image: ImageArray) -> Board:
    found, corners = cv2.findChessboardCornersSB(image, (COLUMNS, ROWS), flags=cv2.CALIB_CB_ACCURACY)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None


def _ours(image: ImageArray) -> Board:
    return find_corners(image, COLUMNS, ROWS)


METHODS: dict[str, Callable[[ImageArray], Board]] = {
    "chessboard (stereoservo)": _ours,
    "cv2.findChessboardCorners": _raw,
    "cv2.findChessboardCornersSB": _sectors,
}


def board_rows(paths: Sequence[Path], repetitions: int) -> list[Row]:
    """Chessboards; accuracy: what a camera with k1, k2, p1, p2, calibrated with the same corners, leaves, an axis. Only
    boards that all detectors found enter it."""
    images = [read(path) for path in paths]
    timed = {name: over(images, find, repetitions) for name, find in METHODS.items()}
    by_picture = [_in_order({name: each[k] for name, (each, _) in timed.items()}) for k in range(len(images))]
    found = {name: [boards[name] for boards in by_picture] for name in METHODS}
    good: dict[str, list[bool]] = {name: [] for name in METHODS}
    for k in range(len(images)):
        boards = [board for board in by_picture[k].values() if board is not None]
        for name, each in found.items():
            board = each[k]
            near = board is not None and np.abs(board - np.median(boards, axis=0)).max() < WRONG_PX
            good[name].append(bool(near))
    common = np.all(list(good.values()), axis=0)
    shown = int(np.any(list(good.values()), axis=0).sum())
    rows = []
    for name, each in found.items():
        false = sum(board is not None for board in each) - sum(good[name])
        views = [(path.stem[:-2], each[k]) for k, path in enumerate(paths) if common[k]]
        rows.append(
            Row("chessboards 9x6", len(images), name, shown, sum(good[name]), false,
                calibrated_rms(views, images[0].shape), "camera calibrated with them", timed[name][1])
        )  # fmt: skip
    return rows


def _in_order(boards: dict[str, Board]) -> dict[str, Board]:
    """Boards (54, 2) of one picture counted from the same end: that of the first that was found."""
    first = next((board for board in boards.values() if board is not None), None)
    return {
        name: board if board is None or first is None else min(
            (board, board[::-1]), key=lambda one: float(np.abs(one - first).sum())
        )
        for name, board in boards.items()
    }  # fmt: skip


def calibrated_rms(boards: Sequence[tuple[str, Board]], shape: tuple[int, ...]) -> float:
    """Rms [px], an axis, that ``cv2.calibrateCamera`` leaves of ``boards``, each of a camera."""
    layout = np.zeros((COLUMNS * ROWS, 3), np.float32)
    layout[:, :2] = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
    squares, count = 0.0, 0
    for camera in sorted({name for name, _ in boards}):
        pixels = [
            corners.astype(np.float32)[:, None]
            for name, corners in boards
            if name == camera and corners is not None
        ]
        rms = cv2.calibrateCamera(
            [layout] * len(pixels), pixels, (shape[1], shape[0]), None, None, flags=cv2.CALIB_FIX_K3
        )[0]
        squares, count = squares + rms**2 * len(pixels), count + len(pixels)
    return float(np.sqrt(squares / count / 2.0))


def without_rows(paths: Sequence[Path], repetitions: int) -> list[Row]:
    """Photographs without a chessboard."""
    images = [read(path) for path in paths]
    rows = []
    for name, find in METHODS.items():
        found, ms = over(images, find, repetitions)
        rows.append(
            Row("no chessboard", len(images), name, 0, 0, sum(one is not None for one in found), None, "", ms)
        )
    return rows


def corner_rows(paths: Sequence[Path], repetitions: int) -> list[Row]:
    """Natural corners of the Franka's room, which stand still while the arm, its shadow and the exposure change: from
    each camera's median picture to each of its pictures. Found: within ``CLOSE_PX`` of where it stands."""
    shown, seen = 0, {name: [0, 0, 0.0, 0] for name in ("corners (stereoservo)", "cv2.calcOpticalFlowPyrLK")}
    times: dict[str, list[float]] = {name: [] for name in seen}
    for camera in sorted({path.stem[-1] for path in paths}):
        images = [read(path) for path in paths if path.stem[-1] == camera]
        median = np.median(images, axis=0).astype(np.uint8)
        places = cv2.goodFeaturesToTrack(median, CORNERS, 0.02, APART_PX)[:, 0].astype(np.float64)
        inside = ((places > 2 * PATCH) & (places < np.array(median.shape[::-1]) - 2 * PATCH)).all(axis=1)
        places = places[inside]
        answers = [
            over(images, call, repetitions) for call in (_patches(median, places), _flow(median, places))
        ]
        near = []
        for name, (each, ms) in zip(seen, answers, strict=True):
            times[name].append(ms)
            errors = [np.where(good[:, None], pixels - places, np.nan) for pixels, good in each]
            far = [np.hypot(*error.T) for error in errors]
            near.append(np.array([distance < CLOSE_PX for distance in far]))
            kept = np.concatenate(errors)[near[-1].ravel()]
            seen[name][0] += int(near[-1].sum())
            seen[name][1] += int(sum((distance > FALSE_PX).sum() for distance in far))
            seen[name][2] += float((kept**2).sum())
            seen[name][3] += kept.size
        shown += int((near[0] | near[1]).sum())
    return [
        Row("Franka, corners that stand still", len(paths), name, shown, int(found), int(false),
            float(np.sqrt(squares / size)), "repeated", float(np.median(times[name])))
        for name, (found, false, squares, size) in seen.items()
    ]  # fmt: skip


Found = tuple[FloatArray, np.ndarray]


def _patches(median: ImageArray, places: FloatArray) -> Callable[[ImageArray], Found]:
    reference = ReferencePatches(median, places, PATCH)
    rows, shapes = np.arange(len(places)), np.tile(np.eye(2), (len(places), 1, 1))

    def find(image: ImageArray) -> Found:
        seen = reference.align(build_pyramid(image, 4), rows, shapes, places, 0)
        return seen.pixels, seen.found & (seen.correlations > 0.8)

    return find


def _flow(median: ImageArray, places: FloatArray) -> Callable[[ImageArray], Found]:
    start = places.astype(np.float32)[:, None]

    def find(image: ImageArray) -> Found:
        pixels, status, _ = cv2.calcOpticalFlowPyrLK(
            median,
            image,
            start,
            start.copy(),
            winSize=(2 * PATCH + 1,) * 2,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return np.asarray(pixels, dtype=np.float64)[:, 0], status[:, 0] > 0

    return find


def all_rows(shown: Photographs, repetitions: int) -> list[Row]:
    """All rows of chessboards and corners."""
    rows = board_rows(shown.boards, repetitions) if shown.boards else []
    if shown.others or shown.franka:
        rows += without_rows(shown.others + shown.franka[::3], 1)
    return rows + (corner_rows(shown.franka, repetitions) if shown.franka else [])
