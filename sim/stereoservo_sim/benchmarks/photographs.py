"""``bench detectors``: detection rate, accuracy and speed of detectors on photographs, beside OpenCV's and
pupil-apriltags.

The photographs are on this computer: the Franka set, OpenCV's samples, tags rendered by another program. There is no
photograph of the product's faces of dots, so they are drawn into photographs, with the light and blur of these; beside
``cv2.findCirclesGrid`` on a grid of equally large dots in the same places.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.devices import CameraObservation, Detector, Frame
from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_drivers.chessboard import find_corners
from stereoservo_drivers.detectors.aruco import TagDetector
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.detectors.patch_alignment import ReferencePatches, build_pyramid
from stereoservo_drivers.detectors.tag_registration import DictionaryName, dictionary, size_of, tag_cells
from stereoservo_sim.benchmarks import features as scenes
from stereoservo_sim.experiments.experiment import ExperimentError
from stereoservo_sim.experiments.textured import context_of
from stereoservo_sim.progress import ProgressCall

DEBIAN = Path("/usr/share/doc/opencv-doc")
"""Directory of the files of Debian's package opencv-doc."""
T = TypeVar("T")
BOARDS = "[lr][ei][fg]*t[0-9][0-9].jpg"
"""OpenCV's chessboard pairs, among its samples."""
LEAST = 200
"""Least number of rows and columns of a photograph: smaller ones are icons."""


@dataclass(frozen=True)
class Photographs:
    """Paths of images by their content; empty if they are not available, with the reason in ``missing``.

    ``franka``: ``pose##_cam#.jpg``; ``boards``: chessboards of 9x6 inner corners; ``sheet``: six tags of 6x6_250 on one
    sheet; ``webots``: tags of 36h11 rendered by Webots; ``others``: no tag, no chessboard, no plate.
    """

    franka: tuple[Path, ...]
    boards: tuple[Path, ...]
    sheet: tuple[Path, ...]
    webots: tuple[Path, ...]
    others: tuple[Path, ...]
    missing: tuple[str, ...]


def photographs(root: Path | None = None) -> Photographs:
    """Photographs below ``root`` (default: ``$STEREOSERVO_DATA``, else ``../shared/data``) and of Debian's opencv-doc.

    Below ``root``: ``fairo_franka/set_a``, ``opencv-doc`` (as in the package), ``april_vision`` (``test_data`` of
    the source distribution).
    """
    root = Path(os.environ.get("STEREOSERVO_DATA", "../shared/data")) if root is None else root
    doc = next((place for place in (root / "opencv-doc", DEBIAN) if place.is_dir()), DEBIAN)
    samples = sorted((doc / "examples" / "data").glob("*.[jp][pn]g"))
    boards = [path for path in samples if path.match(BOARDS)]
    others = [path for path in samples if path not in boards and path.name != "chessboard.png" and _large(path)]
    found = {
        "franka": sorted((root / "fairo_franka" / "set_a").glob("pose*_cam*.jpg")),
        "boards": boards,
        "sheet": sorted((doc / "opencv4" / "html").glob("singlemarkersoriginal.jpg")),
        "webots": sorted((root / "april_vision").glob("*.png")),
        "others": others,
    }
    where = {
        "franka": f"no fairo_franka/set_a in {root}; $STEREOSERVO_DATA names the folder",
        "boards": f"no left01.jpg in {doc}: Debian's package opencv-doc has it",
        "sheet": f"no singlemarkersoriginal.jpg in {doc}: Debian's package opencv-doc has it",
        "webots": f"no april_vision in {root}: test_data of the source distribution of april-vision",
        "others": f"no samples in {doc}: Debian's package opencv-doc has them",
    }
    missing = tuple(why for name, why in where.items() if not found[name])
    return Photographs(**{name: tuple(paths) for name, paths in found.items()}, missing=missing)


def _large(path: Path) -> bool:
    return min(read(path).shape) >= LEAST


def read(path: Path) -> ImageArray:
    """An image in grey. Raises OSError if it cannot be decoded."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise OSError(f"{path} is no picture that OpenCV decodes")
    return np.asarray(image, dtype=np.uint8)


@dataclass
class Row:
    """Result of ``detector`` ``on`` a number of ``pictures``.

    ``found``: correct ones of ``shown``; ``false``: false ones; ``rms_px``: error, by the measure that ``accuracy``
    names; and the CPU time per image.
    """

    on: str
    pictures: int
    detector: str
    shown: int
    found: int
    false: int
    rms_px: float | None
    accuracy: str
    cpu_ms: float

    def report(self) -> dict[str, Any]:
        """As JSON."""
        return {**vars(self), "recall": self.found / self.shown if self.shown else None}


def look(detector: Detector, image: ImageArray) -> CameraObservation:
    """Observation of ``detector`` in ``image`` without a prior."""
    return detector.detect(Frame("photograph", 0, 1_000_000_000, 1_000_000_000, image), None)


def over(images: Sequence[ImageArray], call: Callable[[ImageArray], T], repetitions: int) -> tuple[list[T], float]:
    """``call`` of each image, and the median of its CPU time [ms] over ``repetitions`` of each."""
    found, times = [], []
    call(images[0])
    for image in images:
        for _ in range(repetitions):
            at = time.process_time()
            answer = call(image)
            times.append(1e3 * (time.process_time() - at))
        found.append(answer)
    return found, float(f"{np.median(times):.3g}")


# -- chessboards and corners -----------------------------------------------------------------------------------

COLUMNS, ROWS = 9, 6
FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
Board = FloatArray | None
BOARD_WRONG_PX = 3.0
"""A chessboard is false if a corner is farther than this from its position by most detectors."""
CORNERS, APART_PX = 150, 12
CLOSE_PX, FALSE_PX = 1.0, 1.5
"""A corner of table or wall is found within the first distance of its position; beyond the second it is false."""
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
    """Chessboards; accuracy: residual per axis of a camera with k1, k2, p1, p2, calibrated with the same corners, on
    boards that all detectors found.
    """
    images = [read(path) for path in paths]
    timed = {name: over(images, find, repetitions) for name, find in METHODS.items()}
    by_picture = [_in_order({name: each[k] for name, (each, _) in timed.items()}) for k in range(len(images))]
    found = {name: [boards[name] for boards in by_picture] for name in METHODS}
    good: dict[str, list[bool]] = {name: [] for name in METHODS}
    for k in range(len(images)):
        boards = [board for board in by_picture[k].values() if board is not None]
        for name, each in found.items():
            board = each[k]
            near = board is not None and np.abs(board - np.median(boards, axis=0)).max() < BOARD_WRONG_PX
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
    """Boards (54, 2) of one image counted from the same end: that of the first that was found."""
    first = next((board for board in boards.values() if board is not None), None)
    return {
        name: board
        if board is None or first is None
        else min((board, board[::-1]), key=lambda one: float(np.abs(one - first).sum()))
        for name, board in boards.items()
    }


def calibrated_rms(boards: Sequence[tuple[str, Board]], shape: tuple[int, ...]) -> float:
    """Rms residual [px] per axis of ``cv2.calibrateCamera`` on ``boards``, each of a camera."""
    layout = np.zeros((COLUMNS * ROWS, 3), np.float32)
    layout[:, :2] = np.stack(np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)), axis=-1).reshape(-1, 2)
    squares, count = 0.0, 0
    for camera in sorted({name for name, _ in boards}):
        pixels = [
            corners.astype(np.float32)[:, None] for name, corners in boards if name == camera and corners is not None
        ]
        rms = cv2.calibrateCamera(
            [layout] * len(pixels), pixels, (shape[1], shape[0]), None, None, flags=cv2.CALIB_FIX_K3
        )[0]
        squares, count = squares + rms**2 * len(pixels), count + len(pixels)
    return float(np.sqrt(squares / count / 2.0))


def boardless_rows(paths: Sequence[Path], repetitions: int) -> list[Row]:
    """Photographs without a chessboard."""
    images = [read(path) for path in paths]
    rows = []
    for name, find in METHODS.items():
        found, ms = over(images, find, repetitions)
        rows.append(Row("no chessboard", len(images), name, 0, 0, sum(one is not None for one in found), None, "", ms))
    return rows


def corner_rows(paths: Sequence[Path], repetitions: int) -> list[Row]:
    """Natural corners of the Franka's room, which are static while the arm, its shadow and the exposure change.

    They are tracked from each camera's median image to each of its images. Found: within ``CLOSE_PX`` of their
    position.
    """
    shown, seen = 0, {name: [0, 0, 0.0, 0] for name in ("corners (stereoservo)", "cv2.calcOpticalFlowPyrLK")}
    times: dict[str, list[float]] = {name: [] for name in seen}
    for camera in sorted({path.stem[-1] for path in paths}):
        images = [read(path) for path in paths if path.stem[-1] == camera]
        median = np.median(images, axis=0).astype(np.uint8)
        places = cv2.goodFeaturesToTrack(median, CORNERS, 0.02, APART_PX)[:, 0].astype(np.float64)
        inside = ((places > 2 * PATCH) & (places < np.array(median.shape[::-1]) - 2 * PATCH)).all(axis=1)
        places = places[inside]
        answers = [over(images, call, repetitions) for call in (_patches(median, places), _flow(median, places))]
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
            median, image, start, start.copy(), winSize=(2 * PATCH + 1,) * 2, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
        )
        return np.asarray(pixels, dtype=np.float64)[:, 0], status[:, 0] > 0

    return find


def all_rows(shown: Photographs, repetitions: int) -> list[Row]:
    """All rows of chessboards and corners."""
    rows = board_rows(shown.boards, repetitions) if shown.boards else []
    if shown.others or shown.franka:
        rows += boardless_rows(shown.others + shown.franka[::3], 1)
    return rows + (corner_rows(shown.franka, repetitions) if shown.franka else [])


# -- dots ------------------------------------------------------------------------------------------------------

FACE = DEFAULT_BODY[0]
SIZE = (scenes.WIDTH, scenes.HEIGHT)
GRID = 4
"""Dots along a side of the peer's grid."""
BLUR_PX, NOISE = 0.7, 2.0
LIGHT_PX = 40.0
"""Smoothness of the photograph's light on the plate [px]."""
DARKEST = 0.35
"""Least light on a plate, as a share of the full light."""
DISTANCE, TILT_DEG = (0.8, 1.4), 50.0
WRONG_PX = 2.0


def _grid() -> FloatArray:
    at = np.linspace(-0.7, 0.7, GRID) * FACE.half_side
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def drawn(photograph: ImageArray, dots: FloatArray, rng: np.random.Generator) -> tuple[ImageArray, FloatArray]:
    """A photograph with a plate of ``dots`` (n, 2) [m] drawn into it, and their centres (n, 2) [px]."""
    image = cv2.resize(photograph, SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    light = cv2.GaussianBlur(image, (0, 0), LIGHT_PX)
    light = np.maximum(light / light.max(), DARKEST)
    middle = np.array(SIZE) / 2 + rng.uniform(-120.0, 120.0, 2) * (1.0, 0.6)
    tilt = np.radians(rng.uniform(0.0, TILT_DEG))
    azimuth, roll = rng.uniform(0.0, 2.0 * np.pi, 2)
    H = scenes.look(tilt, azimuth, roll, rng.uniform(*DISTANCE), middle)
    s = FACE.half_side
    corners = scenes.project(H, np.array([[-s, -s], [s, -s], [s, s], [-s, s]]))
    plate = np.zeros_like(image)
    scenes.blend_polygon(plate, corners, 1.0)
    plate = cv2.GaussianBlur(plate, (0, 0), BLUR_PX)
    white = np.zeros_like(image)
    for dot in dots:
        scenes.add_ellipse(white, scenes.circle_conic(H, dot, FACE.radius), BLUR_PX)
    lit = light * (scenes.BLACK + (scenes.WHITE - scenes.BLACK) * np.minimum(white, 1.0))
    image = image * (1.0 - plate) + lit * plate + rng.normal(0.0, NOISE, image.shape) * plate
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), scenes.project(H, dots)


def dot_rows(paths: Sequence[Path], repetitions: int, seed: int) -> list[Row]:
    """Plates drawn into photographs, and the same photographs without one (``no plate``)."""
    photographs = [read(path) for path in paths]
    plain = [cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA).astype(np.uint8) for image in photographs]
    detector = DotDetector({}, context_of("photograph"))
    blobs = cv2.SimpleBlobDetector.Params()
    blobs.filterByColor, blobs.blobColor, blobs.minArea, blobs.maxArea = True, 255, 20.0, 3000.0
    finder = cv2.SimpleBlobDetector.create(blobs)

    def ours(image: ImageArray) -> FloatArray:
        seen = look(detector, image)
        places = np.full((len(FACE.ids), 2), np.nan)
        mine = np.isin(seen.ids, FACE.ids)
        places[np.searchsorted(FACE.ids, seen.ids[mine])] = seen.pixels[mine]
        return places

    def grid(image: ImageArray) -> FloatArray:
        flags = cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
        found, centres = cv2.findCirclesGrid(image, (GRID, GRID), flags=flags, blobDetector=finder)
        return np.asarray(centres, dtype=np.float64).reshape(-1, 2) if found else np.full((GRID**2, 2), np.nan)

    rows = []
    for name, find, dots in (("dots (stereoservo)", ours, FACE.positions), ("cv2.findCirclesGrid", grid, _grid())):
        rng = np.random.default_rng(seed)
        made = [drawn(photograph, dots, rng) for photograph in photographs]
        seen, ms = over([image for image, _ in made], find, repetitions)
        errors = [_errors(places, truth, name) for places, (_, truth) in zip(seen, made, strict=True)]
        far = np.concatenate([np.hypot(*error.T) for error in errors])
        good = np.concatenate(errors)[far < WRONG_PX]
        rows.append(
            Row("a plate drawn into photographs: dots", len(made), name, far.size, int((far < WRONG_PX).sum()),
                int((far >= WRONG_PX).sum()), float(np.sqrt(np.mean(good**2))) if good.size else None,
                "drawn centres", ms)
        )  # fmt: skip
        nothing, ms = over(plain, find, repetitions)
        false = sum(int(np.isfinite(places[:, 0]).sum()) for places in nothing)
        rows.append(Row("no plate: dots", len(plain), name, 0, 0, false, None, "", ms))
    return rows


def _errors(places: FloatArray, truth: FloatArray, name: str) -> FloatArray:
    """Errors (n, 2) [px], NaN if nothing was found; a grid may be counted from any of its corners."""
    if name.startswith("dots"):
        return places - truth
    turned = truth.reshape(GRID, GRID, 2)
    each = [np.rot90(one, k).reshape(-1, 2) for one in (turned, turned.transpose(1, 0, 2)) for k in range(4)]
    return min((places - one for one in each), key=lambda e: float(np.nan_to_num(np.abs(e), nan=1e3).sum()))


def plate_rows(shown: Photographs, repetitions: int, seed: int) -> list[Row]:
    """All rows of dots."""
    paths = shown.others + shown.franka[::2]
    return sorted(dot_rows(paths, repetitions, seed), key=lambda row: row.shown == 0) if paths else []


# -- tags ------------------------------------------------------------------------------------------------------

Find = tuple[int, FloatArray]
"""A tag's id and its corners (4, 2) [px], clockwise."""
Finder = Callable[[ImageArray], list[Find]]
FRANKA: dict[int, frozenset[int]] = {0: frozenset((0, 2, 3)), 1: frozenset((0, 2)), 2: frozenset((0, 2, 3))}
"""Tags on the Franka's table that are entirely in the image, by camera; the hand has tag 9."""
HAND = 9
SHEET = frozenset((23, 40, 62, 98, 124, 203))
"""Tags on OpenCV's sheet, according to its documentation."""
WEBOTS = 14
"""The tag in all of april-vision's test pictures."""
WRONG_BITS = 1
"""Number of cells that may be misread by the plain threshold that judges a find."""
AT_PX = 3.0
"""Largest distance of a static tag from its position."""
PUPIL_OFFSET = 0.5
"""Offset of pupil-apriltags' coordinates, whose pixel centres are at halves."""


def finders(name: DictionaryName) -> tuple[dict[str, Finder], list[str]]:
    """Detectors of a dictionary's tags, and the reason why one is omitted."""
    options = {"tags": list(range(size_of(name))), "dictionary": name}
    of_size: dict[tuple[int, ...], TagDetector] = {}

    def ours(image: ImageArray) -> list[Find]:
        if image.shape not in of_size:
            of_size[image.shape] = TagDetector(options, context_of("photograph"))
        seen = look(of_size[image.shape], image)
        return [
            (int(seen.ids[k]) // 4, seen.pixels[k : k + 4])
            for k in range(len(seen.ids) - 3)
            if seen.ids[k] % 4 == 0 and seen.ids[k + 3] == seen.ids[k] + 3
        ]

    found: dict[str, Finder] = {
        "aruco (stereoservo)": ours,
        "cv2.aruco": _opencv(name, cv2.aruco.CORNER_REFINE_NONE),
        "cv2.aruco, subpixel": _opencv(name, cv2.aruco.CORNER_REFINE_SUBPIX),
        "cv2.aruco, apriltag": _opencv(name, cv2.aruco.CORNER_REFINE_APRILTAG),
    }
    if find_spec("pupil_apriltags") is None:
        return found, ["pupil-apriltags is not installed: pip install pupil-apriltags"]
    if name not in ("36h11", "25h9", "16h5"):
        return found, [f"pupil-apriltags does not read {name}"]
    found["pupil-apriltags"] = _pupil(name)
    return found, []


def _opencv(name: DictionaryName, refinement: int) -> Finder:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = refinement
    detector = cv2.aruco.ArucoDetector(dictionary(name), parameters)
    offset = 0.5 if refinement == cv2.aruco.CORNER_REFINE_APRILTAG else 0.0

    def find(image: ImageArray) -> list[Find]:
        corners, ids, _ = detector.detectMarkers(image)
        each = [] if ids is None else np.ravel(ids).tolist()
        return [
            (tag, np.asarray(quad, dtype=np.float64).reshape(4, 2) - offset)
            for quad, tag in zip(corners, each, strict=True)
        ]

    return find


def _pupil(name: DictionaryName) -> Finder:
    module = import_module("pupil_apriltags")  # only if it is installed
    detector = module.Detector(f"tag{name}", nthreads=1, quad_decimate=1.0)

    def find(image: ImageArray) -> list[Find]:
        return [
            (int(one.tag_id), np.asarray(one.corners, dtype=np.float64)[::-1] - PUPIL_OFFSET)
            for one in detector.detect(np.ascontiguousarray(image))
        ]

    return find


def reads(image: ImageArray, corners: FloatArray, cells: FloatArray) -> bool:
    """Whether a plain threshold at the middle of each cell of ``cells`` (n, n) reads them, in any of the four
    rotations.
    """
    n = len(cells)
    square = np.array([[0, 0], [n, 0], [n, n], [0, n]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), square)
    scale = np.diag([8.0, 8.0, 1.0])
    patch = cv2.warpPerspective(image, scale @ H, (8 * n, 8 * n)).astype(np.float64)
    levels = patch.reshape(n, 8, n, 8)[:, 2:6, :, 2:6].mean(axis=(1, 3))
    middle = 0.5 * (levels[cells > 0.5].mean() + levels[cells < 0.5].mean())
    seen = levels < middle
    return any(int((np.rot90(seen, k) != (cells > 0.5)).sum()) <= WRONG_BITS for k in range(4))


def judged(
    images: Sequence[ImageArray],
    finds: dict[str, list[list[Find]]],
    name: DictionaryName,
    allowed: Sequence[frozenset[int]],
    places: Sequence[dict[int, FloatArray]],
) -> tuple[dict[str, list[dict[int, FloatArray]]], dict[str, int], int]:
    """The correct finds of each detector and image, the number of its false ones, and the number of shown tags: those
    that any detector found correctly.

    A find is correct if its id is one of those ``allowed`` in the image, its cells read as its code, and it is near
    its position, if ``places`` has one.
    """
    right: dict[str, list[dict[int, FloatArray]]] = {detector: [] for detector in finds}
    false = dict.fromkeys(finds, 0)
    shown = 0
    for k, image in enumerate(images):
        present: set[int] = set()
        for detector, each in finds.items():
            good: dict[int, FloatArray] = {}
            for tag, corners in each[k]:
                place = places[k].get(tag)
                near = place is None or _apart(corners, place) < AT_PX
                awaited = tag in allowed[k] and tag not in good and near
                if awaited and reads(image, corners, tag_cells(name, tag)):
                    good[tag] = corners
                else:
                    false[detector] += 1
            right[detector].append(good)
            present |= set(good)
        shown += len(present)
    return right, false, shown


def _apart(one: FloatArray, other: FloatArray) -> float:
    """Largest distance [px] of two quadrilaterals' corners, for the rotation that minimises it."""
    return min(float(np.hypot(*(np.roll(one, k, axis=0) - other).T).max()) for k in range(4))


def franka_rows(paths: Sequence[Path], repetitions: int) -> tuple[list[Row], list[str]]:
    """Tags on the Franka photographs. Accuracy: corners of the table's tags transferred from one camera to another by
    the best homography.
    """
    images = [read(path) for path in paths]
    cameras = [int(path.stem[-1]) for path in paths]
    poses = [path.stem[:6] for path in paths]
    methods, why = finders("4x4_50")
    timed = {name: over(images, find, repetitions) for name, find in methods.items()}
    finds = {name: each for name, (each, _) in timed.items()}
    standing = {camera: _standing(finds, cameras, camera) for camera in set(cameras)}
    right, false, shown = judged(
        images, finds, "4x4_50", [FRANKA[c] | {HAND} for c in cameras], [standing[c] for c in cameras]
    )
    rows = []
    for name, each in right.items():
        squares, freedoms = 0.0, 0
        for one, other in combinations(range(len(paths)), 2):
            if poses[one] == poses[other]:
                add, count = _transfer(each[one], each[other])
                squares, freedoms = squares + add, freedoms + count
        found = sum(len(one) for one in each)
        rms = float(np.sqrt(squares / freedoms)) if freedoms else None
        rows.append(
            Row("Franka, 4x4_50", len(images), name, shown, found, false[name], rms,
                "table's homography between cameras", timed[name][1])
        )  # fmt: skip
    return rows, why


def _standing(finds: dict[str, list[list[Find]]], cameras: Sequence[int], camera: int) -> dict[int, FloatArray]:
    """Median corners of each of the table's tags in a camera, of all detectors and images."""
    seen: dict[int, list[FloatArray]] = {}
    for each in finds.values():
        for k, of in enumerate(cameras):
            for tag, corners in each[k] if of == camera else []:
                if tag in FRANKA[camera]:
                    seen.setdefault(tag, []).append(corners)
    return {tag: np.median(corners, axis=0) for tag, corners in seen.items()}


def _transfer(one: dict[int, FloatArray], other: dict[int, FloatArray]) -> tuple[float, int]:
    """Squared residuals [px²] of a homography of the table's corners in two images, and its degrees of freedom."""
    tags = sorted((set(one) & set(other)) - {HAND})
    if len(tags) < 2:
        return 0.0, 0
    a, b = (np.concatenate([each[tag] for tag in tags]) for each in (one, other))
    H, _ = cv2.findHomography(a, b, 0)
    carried = cv2.perspectiveTransform(a[None], H)[0]
    return float(((carried - b) ** 2).sum()), 2 * len(a) - 8


def sheet_rows(paths: Sequence[Path], name: DictionaryName, on: str, repetitions: int) -> tuple[list[Row], list[str]]:
    """Tags on a sheet (whose ids are known) or, if ``name`` is 36h11, those of Webots; accuracy of the latter is not
    known.
    """
    images = [read(path) for path in paths]
    methods, why = finders(name)
    timed = {detector: over(images, find, repetitions) for detector, find in methods.items()}
    finds = {detector: each for detector, (each, _) in timed.items()}
    allowed = SHEET if name == "6x6_250" else frozenset({WEBOTS})
    right, false, shown = judged(images, finds, name, [allowed] * len(images), [{}] * len(images))
    return [
        Row(on, len(images), detector, shown, found, false[detector], None, "", timed[detector][1])
        for detector, found in ((detector, sum(map(len, each))) for detector, each in right.items())
    ], why


def tagless_rows(paths: Sequence[Path], repetitions: int) -> tuple[list[Row], list[str]]:
    """Photographs without tags, searched for tags of two dictionaries."""
    images = [read(path) for path in paths]
    rows, reasons = [], []
    for name in ("4x4_50", "36h11"):
        methods, why = finders(name)  # type: ignore[arg-type]
        reasons += why
        for detector, find in methods.items():
            found, ms = over(images, find, repetitions)
            false = sum(len(one) for one in found)
            rows.append(Row(f"no tags, {name}", len(images), detector, 0, 0, false, None, "", ms))
    return rows, reasons


def tag_rows(shown: Photographs, repetitions: int) -> tuple[list[Row], list[str]]:
    """All rows of tags."""
    parts: list[tuple[list[Row], list[str]]] = []
    if shown.franka:
        parts.append(franka_rows(shown.franka, repetitions))
    if shown.sheet:
        parts.append(sheet_rows(shown.sheet, "6x6_250", "sheet of tags, 6x6_250", repetitions))
    if shown.webots:
        parts.append(sheet_rows(shown.webots, "36h11", "rendered by Webots, 36h11", repetitions))
    if shown.others or shown.boards:
        parts.append(tagless_rows(shown.others + shown.boards, repetitions))
    return [row for rows, _ in parts for row in rows], [one for _, why in parts for one in why]


# -- the bench -------------------------------------------------------------------------------------------------


def run_detectors(repetitions: int, seed: int, progress: ProgressCall) -> dict[str, Any]:
    """A row for each detector and kind of images, and the omitted ones.

    ``shown``: found correctly by any of the detectors; ``false``: not present, or with a wrong id. Raises
    ExperimentError ``data_missing`` if there are no photographs at all.
    """
    shown = photographs()
    if not (shown.franka or shown.boards or shown.others or shown.sheet or shown.webots):
        raise ExperimentError("data_missing", "no photographs: " + "; ".join(shown.missing), missing=shown.missing)
    progress("tags", 0, 3)
    rows, left_out = tag_rows(shown, repetitions)
    progress("chessboards and corners", 1, 3)
    rows += all_rows(shown, repetitions)
    progress("dots", 2, 3)
    rows += plate_rows(shown, repetitions, seed)
    progress("dots", 3, 3)
    reasons = sorted(set(shown.missing) | set(left_out))
    return {"rows": [row.report() for row in rows], "left_out": reasons}


def show_detectors(answer: dict[str, Any], console: Console) -> dict[str, Any]:
    """Print the table, and below it the omitted rows; returns the rest of the answer."""
    table = Table("pictures", "n", "detector", "found", "of", "false", "rms [px]", "measured by", "CPU [ms]")
    last = ""
    for row in answer["rows"]:
        rms = "" if row["rms_px"] is None else f"{row['rms_px']:.3f}"
        if row["on"] != last:
            table.add_section()
        table.add_row(
            row["on"] if row["on"] != last else "", str(row["pictures"]), row["detector"],
            str(row["found"]) if row["shown"] else "", str(row["shown"] or ""), str(row["false"]), rms,
            row["accuracy"], f"{row['cpu_ms']:.3g}",
        )  # fmt: skip
        last = row["on"]
    console.print(table)
    for reason in answer["left_out"]:
        console.print(f"left out: {reason}", soft_wrap=True)
    return {key: value for key, value in answer.items() if key not in ("rows", "left_out")}
