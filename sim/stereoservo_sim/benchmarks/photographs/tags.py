"""Tags on photographs: the detector `aruco` beside OpenCV's and, where it is installed, pupil-apriltags."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo_drivers.detectors.aruco import TagDetector
from stereoservo_drivers.detectors.tag_registration import DictionaryName, dictionary, size_of, tag_cells
from stereoservo_sim.benchmarks.photographs.pictures import Photographs, Row, context, look, over, read

Find = tuple[int, FloatArray]
"""A tag's id and its corners (4, 2) [px], clockwise."""
Finder = Callable[[ImageArray], list[Find]]
FRANKA: dict[int, frozenset[int]] = {0: frozenset((0, 2, 3)), 1: frozenset((0, 2)), 2: frozenset((0, 2, 3))}
"""Tags that lie on the Franka's table, in each camera whole; the hand has tag 9."""
HAND = 9
SHEET = frozenset((23, 40, 62, 98, 124, 203))
"""Tags on OpenCV's sheet, as its documentation tells."""
WEBOTS = 14
"""The tag in all of april-vision's test pictures."""
WRONG_BITS = 1
"""Cells that may read wrongly by the plain threshold that judges a find."""
AT_PX = 3.0
"""How far from its place a tag that stands still may be found."""
PUPIL_OFFSET = 0.5
"""What pupil-apriltags adds to each coordinate: the centres of its pixels lie at halves."""


def finders(name: DictionaryName) -> tuple[dict[str, Finder], list[str]]:
    """Detectors of a dictionary's tags, and why one is left out."""
    options = {"tags": list(range(size_of(name))), "dictionary": name}
    of_size: dict[tuple[int, ...], TagDetector] = {}

    def ours(image: ImageArray) -> list[Find]:
        if image.shape not in of_size:
            of_size[image.shape] = TagDetector(options, context())
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
    module = import_module("pupil_apriltags")  # only where it is installed
    detector = module.Detector(f"tag{name}", nthreads=1, quad_decimate=1.0)

    def find(image: ImageArray) -> list[Find]:
        return [
            (int(one.tag_id), np.asarray(one.corners, dtype=np.float64)[::-1] - PUPIL_OFFSET)
            for one in detector.detect(np.ascontiguousarray(image))
        ]

    return find


def reads(image: ImageArray, corners: FloatArray, cells: FloatArray) -> bool:
    """Whether a plain threshold at the middle of each cell of ``cells`` (n, n) reads them, in any of the four turns."""
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
    """The right finds of each detector and picture, the number of its false ones, and how many tags are shown: those
    that any detector found rightly.

    A find is right where its id is one of those ``allowed`` in the picture, its cells read as its code, and it is near
    its place, where ``places`` has one.
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
    """Distance [px] of two quadrilaterals' corners, the largest, by the turn that makes it least."""
    return min(float(np.hypot(*(np.roll(one, k, axis=0) - other).T).max()) for k in range(4))


def franka_rows(paths: Sequence[Path], repetitions: int) -> tuple[list[Row], list[str]]:
    """Tags on the Franka photographs. Accuracy: corners of the table's tags in one camera carried to another by the
    best homography."""
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


def _standing(
    finds: dict[str, list[list[Find]]], cameras: Sequence[int], camera: int
) -> dict[int, FloatArray]:
    """Median corners of each of the table's tags in a camera, of all detectors and pictures."""
    seen: dict[int, list[FloatArray]] = {}
    for each in finds.values():
        for k, of in enumerate(cameras):
            for tag, corners in each[k] if of == camera else []:
                if tag in FRANKA[camera]:
                    seen.setdefault(tag, []).append(corners)
    return {tag: np.median(corners, axis=0) for tag, corners in seen.items()}


def _transfer(one: dict[int, FloatArray], other: dict[int, FloatArray]) -> tuple[float, int]:
    """Squares [px²] of what a homography leaves of the table's corners in two pictures, and its freedoms."""
    tags = sorted((set(one) & set(other)) - {HAND})
    if len(tags) < 2:
        return 0.0, 0
    a, b = (np.concatenate([each[tag] for tag in tags]) for each in (one, other))
    H, _ = cv2.findHomography(a, b, 0)
    carried = cv2.perspectiveTransform(a[None], H)[0]
    return float(((carried - b) ** 2).sum()), 2 * len(a) - 8


def sheet_rows(
    paths: Sequence[Path], name: DictionaryName, on: str, repetitions: int
) -> tuple[list[Row], list[str]]:
    """Tags on a sheet (of which it is known which) or, where ``name`` is 36h11, those of Webots; accuracy of the latter
    is not known."""
    images = [read(path) for path in paths]
    methods, why = finders(name)
    timed = {detector: over(images, find, repetitions) for detector, find in methods.items()}
    finds = {detector: each for detector, (each, _) in timed.items()}
    allowed = SHEET if name == "6x6_250" else frozenset({WEBOTS})
    right, false, shown = judged(images, finds, name, [allowed] * len(images), [{}] * len(images))
    return [
        Row(
            on,
            len(images),
            detector,
            shown,
            sum(len(one) for one in each),
            false[detector],
            None,
            "",
            timed[detector][1],
        )
        for detector, each in right.items()
    ], why


def without_rows(paths: Sequence[Path], repetitions: int) -> tuple[list[Row], list[str]]:
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
        parts.append(without_rows(shown.others + shown.boards, repetitions))
    return [row for rows, _ in parts for row in rows], [one for _, why in parts for one in why]
