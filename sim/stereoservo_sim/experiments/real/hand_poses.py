"""Reader of a hand-eye data set: images ``pose##_cam#.jpg`` and the arm's poses in ``ee_poses.csv``."""

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

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.experiment import ExperimentError

POSE_FILE = "ee_poses.csv"
COLUMNS = ("index", "x", "y", "z", "qx", "qy", "qz", "qw")
IMAGE_NAME = re.compile(r"pose(\d+)_cam(\d+)\.(jpg|jpeg|png)", re.IGNORECASE)
QUATERNION_TOLERANCE = 1e-2


@dataclass(frozen=True)
class HandEyeSet:
    """One set: ``poses`` maps a pose index to ``H_hand_to_base`` (4, 4) [m], ``images`` (pose, camera) to a
    file."""

    directory: Path
    poses: dict[int, FloatArray]
    images: dict[tuple[int, int], Path]

    @property
    def cameras(self) -> list[int]:
        """Camera numbers, ascending."""
        return sorted({camera for _, camera in self.images})


def load_hand_eye_set(directory: Path) -> HandEyeSet:
    """Read the poses and list the images of ``directory``; an image without a pose is an error, the reverse
    is not.

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
    """Pose index -> ``H_hand_to_base`` (4, 4) from a table with the columns of COLUMNS ([m], quaternion
    xyzw).

    Lines that are empty or start with ``#`` and a header line that starts with ``index`` are passed over.
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
        raise ExperimentError(
            "csv", f"{path} holds no pose; rows of {','.join(COLUMNS)} are needed", file=str(path)
        )
    return poses


def read_image(path: Path) -> npt.NDArray[np.uint8]:
    """Grey image ``(height, width)``. Raises ExperimentError ``image`` when the file does not decode."""
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
