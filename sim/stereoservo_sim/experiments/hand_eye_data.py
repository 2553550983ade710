"""A hand-eye data set: images ``pose##_cam#.jpg`` and the arm's poses in ``ee_poses.csv``, and the ArUco tags in its
images, their corners registered on the whole printed pattern.

``CORNER_REFINE_SUBPIX`` uses a few pixels about each corner. On tags of 20 px, with cells of 3 px, it
pulls the corners inwards (2 % of the side), with errors of up to a pixel. Here it is only the start: the
tag's known black and white cells, imaged by a homography and blurred by a Gaussian, are fitted to the grey
values of the whole tag.
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stereoservo.geometry.homogeneous import from_homogeneous
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.detectors import tag_registration
from stereoservo_drivers.detectors.tag_registration import compile_kernels
from stereoservo_sim.experiments.experiment import ExperimentError

GreyImage = npt.NDArray[np.uint8]

DICTIONARY = cv2.aruco.DICT_4X4_50
DICTIONARY_NAME = "DICT_4X4_50"
TAG_IDS = 50
STANDING = 100
"""First marker id of corners of static tags, four per tag."""
UNREGISTERED_SIGMA = 0.5
"""Standard deviation [px] stated for corners that were not registered."""
CELLS = 6
"""Cells along a side: four of data and the black border at both ends."""


@dataclass(frozen=True)
class TagView:
    """One tag in one image: ``corners`` (4, 2) [px] in the dictionary's order, clockwise from the printed top left.

    ``sigmas`` (4,) [px]: of the corners, per axis, from the noise of the image. ``start``: the corners of cv2's
    subpixel refinement. ``registered``: whether the pattern fit was accepted; otherwise ``blur`` [px] and
    ``correlation`` of pattern and image are NaN.
    """

    corners: FloatArray
    sigmas: FloatArray
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
    """Corners ``(4, 2)`` [px] by tag id: cv2's detector with subpixel refinement. Of a repeated id the larger."""
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
    """The tag of ``cells`` (n, n) about ``start`` (4, 2) [px], as measured by the detector `aruco`.

    If the fit is not credible the start is kept and ``registered`` is False.
    """
    start = np.asarray(start, dtype=np.float64)
    compile_kernels()
    fit = tag_registration.register_tag(image, start, cells)
    if fit is None:
        return TagView(start, np.full(4, UNREGISTERED_SIGMA), start, False, float("nan"), float("nan"))
    sigmas = np.sqrt(np.trace(fit.covariances, axis1=1, axis2=2) / 2.0)
    return TagView(fit.corners, sigmas, start, True, fit.blur, fit.correlation)


def _area(quad: FloatArray) -> float:
    x, y = quad[:, 0], quad[:, 1]
    return float(abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2)


MEDIAN_OF = 25
"""Largest number of images in a median, from which the arm and most of the noise are removed."""


@dataclass(frozen=True)
class Flatness:
    """rms distance [mm] of ``points`` (n, 3) [m] from their best plane; None with the ``reason`` if there is none."""

    rms_mm: float | None
    reason: str | None
    tags: tuple[int, ...]
    points: FloatArray


def median_image(images: list[GreyImage]) -> GreyImage:
    """Per-pixel median of at most MEDIAN_OF evenly chosen images of one size."""
    chosen = np.unique(np.linspace(0, len(images) - 1, min(len(images), MEDIAN_OF)).round().astype(int))
    median: GreyImage = np.median(np.stack([images[i] for i in chosen]), axis=0).astype(np.uint8)
    return median


def find_standing_tags(image: GreyImage, tags: tuple[int, ...]) -> dict[int, FloatArray]:
    """Registered corners ``(4, 2)`` [px] of those of ``tags`` found in a median image."""
    found = find_tags(image)
    return {tag: register_tag(image, found[tag], tag_cells(tag)).corners for tag in tags if tag in found}


def flatness(model: CellModel, tags: tuple[int, ...]) -> Flatness:
    """Plane fitted to the model's static points that are corners of ``tags``."""
    nothing = np.zeros((0, 3))
    if not tags:
        return Flatness(None, "no table tags were asked for", (), nothing)
    shared = tuple(tag for tag in tags if any((i - STANDING) // 4 == tag for i in model.scene_ids))
    if not shared or model.projective_to_euclidean is None:
        return Flatness(
            None, f"no table tag of {list(tags)} is seen standing still by two cameras or more", (), nothing
        )
    points = from_homogeneous(model.scene_points @ model.projective_to_euclidean.T)
    if len(points) < 4:
        return Flatness(None, f"only {len(points)} corners of table tags could be triangulated", shared, points)
    smallest = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[2]
    return Flatness(float(smallest / np.sqrt(len(points)) * 1e3), None, shared, points)


# -- the files -------------------------------------------------------------------------------------------------

POSE_FILE = "ee_poses.csv"
COLUMNS = ("index", "x", "y", "z", "qx", "qy", "qz", "qw")
IMAGE_NAME = re.compile(r"pose(\d+)_cam(\d+)\.(jpg|jpeg|png)", re.IGNORECASE)
QUATERNION_TOLERANCE = 1e-2


@dataclass(frozen=True)
class HandEyeSet:
    """One set: ``poses`` maps a pose index to ``H_hand_to_base`` (4, 4) [m], ``images`` (pose, camera) to a file."""

    directory: Path
    poses: dict[int, FloatArray]
    images: dict[tuple[int, int], Path]

    @property
    def cameras(self) -> list[int]:
        """Camera numbers, ascending."""
        return sorted({camera for _, camera in self.images})


def load_hand_eye_set(directory: Path) -> HandEyeSet:
    """Read the poses and list the images of ``directory``; an image without a pose is an error, the reverse is not.

    Raises ExperimentError: ``data_missing``, ``no_images``, ``csv`` (with line and column), ``pose_missing``.
    """
    if not directory.is_dir():
        raise ExperimentError(
            "data_missing",
            f"{directory} is not a directory; a folder with {POSE_FILE} and images pose##_cam#.jpg is needed",
            directory=str(directory),
        )
    images = _list_images(directory)
    poses = read_poses(directory / POSE_FILE)
    for (pose, _), path in images.items():
        if pose not in poses:
            raise ExperimentError(
                "pose_missing",
                f"{path.name} has no row {pose} in {POSE_FILE}, which has {_ranges(sorted(poses))}",
                image=path.name,
                index=pose,
            )
    return HandEyeSet(directory, poses, images)


def read_poses(path: Path) -> dict[int, FloatArray]:
    """Pose index -> ``H_hand_to_base`` (4, 4) from a table with the columns of COLUMNS ([m], quaternion xyzw).

    Empty lines, lines that start with ``#`` and a header line that starts with ``index`` are ignored.
    Raises ExperimentError ``csv`` with line, column and value.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ExperimentError("data_missing", f"{path} does not exist", file=str(path)) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ExperimentError("csv", f"{path} cannot be read as text: {error}", file=str(path)) from error
    poses: dict[int, FloatArray] = {}
    for line, row in enumerate(csv.reader(text.splitlines()), start=1):
        cells = [cell.strip() for cell in row]
        if not any(cells) or cells[0].startswith("#") or cells[0].lower() == COLUMNS[0]:
            continue
        index, pose = _parse_row(path, line, cells)
        if index in poses:
            raise _csv_error(path, line, COLUMNS[0], cells[0], "an index that no earlier line has")
        poses[index] = pose
    if not poses:
        raise ExperimentError("csv", f"{path} holds no pose; rows of {','.join(COLUMNS)} are needed", file=str(path))
    return poses


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """Grey image ``(height, width)``. Raises ExperimentError ``image`` if the file cannot be decoded."""
    encoded = np.fromfile(path, dtype=np.uint8) if path.is_file() else np.zeros(0, dtype=np.uint8)
    image = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE) if encoded.size else None
    if image is None:
        raise ExperimentError(
            "image", f"{path} ({encoded.size} bytes) does not decode as a JPEG or PNG image", image=str(path)
        )
    return np.asarray(image, dtype=np.uint8)


def _list_images(directory: Path) -> dict[tuple[int, int], Path]:
    images: dict[tuple[int, int], Path] = {}
    for path in sorted(directory.iterdir()):
        match = IMAGE_NAME.fullmatch(path.name)
        if match is None:
            continue
        key = (int(match[1]), int(match[2]))
        if key in images:
            raise ExperimentError(
                "image_twice",
                f"{images[key].name} and {path.name} are both pose {key[0]} of camera {key[1]}",
                images=[images[key].name, path.name],
            )
        images[key] = path
    if not images:
        raise ExperimentError(
            "no_images",
            f"{directory} holds no image; names like pose00_cam0.jpg (or .png) are needed",
            directory=str(directory),
        )
    return images


def _parse_row(path: Path, line: int, cells: list[str]) -> tuple[int, FloatArray]:
    if len(cells) != len(COLUMNS):
        column = COLUMNS[len(cells)] if len(cells) < len(COLUMNS) else f"#{len(COLUMNS) + 1}"
        raise _csv_error(
            path,
            line,
            column,
            ",".join(cells),
            f"{len(COLUMNS)} columns {','.join(COLUMNS)}, not {len(cells)}",
        )
    try:
        index = int(cells[0])
    except ValueError:
        raise _csv_error(path, line, COLUMNS[0], cells[0], "a whole number") from None
    if index < 0:
        raise _csv_error(path, line, COLUMNS[0], cells[0], "a whole number, 0 or greater")
    values = []
    for column, cell in zip(COLUMNS[1:], cells[1:], strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise _csv_error(path, line, column, cell, "a finite number")
        values.append(value)
    norm = math.hypot(*values[3:])
    if abs(norm - 1.0) > QUATERNION_TOLERANCE:
        raise _csv_error(
            path, line, "qx..qw", ",".join(cells[4:]), f"a unit quaternion (xyzw); its length is {norm:.4g}"
        )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(values[3:]).as_matrix()
    pose[:3, 3] = values[:3]
    return index, pose


def _csv_error(path: Path, line: int, column: str, value: str, valid: str) -> ExperimentError:
    return ExperimentError(
        "csv",
        f"{path}, line {line}, column {column}: {value!r}; needed: {valid}",
        file=str(path),
        line=line,
        column=column,
        value=value,
    )


def _ranges(indices: list[int]) -> str:
    return f"{len(indices)} of {indices[0]}..{indices[-1]}"
