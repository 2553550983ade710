"""A folder of stamps, joint angles or poses of the hand, and pictures or pixels of markers, as a recording:
docs/recordings.md has the format.
"""

from __future__ import annotations

import csv
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.calibration.known_arm import KINDS, NAMES, free_arm
from stereoservo.calibration.trial_data import TrialCamera
from stereoservo.cli.output import CommandError, note
from stereoservo.kinematics.parameterization import Kind
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import Detector, DriverContext, Frame
from stereoservo.ports.lerobot import UNITS

JOINTS, POSES, MARKERS, FRAMES, CAMERAS = (
    "joints.csv",
    "poses.csv",
    "markers.csv",
    "frames.csv",
    "cameras.csv",
)
DETECTOR = "detector.toml"
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
TIME, ORDER = "t", "index"
STATED_PX = 0.1
"""Deviation that is stated of a pixel without one; what the pixels scatter is estimated."""
LARGEST = 10**9
"""Of whole numbers: markers, sizes, counts of frames."""
UNIT = 1e-2
"""How far from 1 the length of a quaternion may be."""

Rows = list[dict[str, str]]


def read_folder(folder: Path) -> RecordedViews:
    """The recording in a folder. Raises CommandError naming file, row, value and what would be valid."""
    given = [name for name in (JOINTS, POSES) if (folder / name).is_file()]
    seen = [name for name in (MARKERS, FRAMES) if (folder / name).is_file()]
    if len(given) != 1 or len(seen) != 1:
        raise CommandError(
            "dataset",
            f"{folder} has {', '.join(given + seen) or 'no table'}; one of {JOINTS} and {POSES}, and one of {MARKERS} "
            f"and {FRAMES} are needed",
        )
    motion = _table(folder / given[0])
    key = _time_column(folder / given[0], motion)
    stamps = np.array([_number(folder / given[0], k, row, key) for k, row in enumerate(motion, 2)])
    order = np.argsort(stamps, kind="stable")
    names, kinds, positions, generators = (
        _joints(folder / JOINTS, motion, key, order) if given[0] == JOINTS else _poses(folder / POSES, motion, order)
    )  # fmt: skip
    table = _table(folder / seen[0])
    if _time_column(folder / seen[0], table) != key:
        raise CommandError("dataset", f"{folder / seen[0]} has no column {key!r}, which {given[0]} has")
    frames = _marker_frames(folder, table, key) if seen[0] == MARKERS else _pictures(folder, table, key)
    return gathered_views(frames, stamps[order], names, kinds, positions, generators, key == TIME)


class GatheredFrames:
    """Frames gathered: by (camera, stamp) its number, episode, and pixels with their deviations by marker; ``sizes``
    (width, height) of the cameras' pictures.
    """

    def __init__(self, sizes: dict[str, tuple[int, int]]) -> None:
        self.sizes = sizes
        self.seen: dict[tuple[str, float], tuple[int, int, dict[int, tuple[float, float, float]]]] = {}

    def of(
        self, path: Path, line: int, row: Mapping[str, str], key: str
    ) -> dict[int, tuple[float, float, float]]:
        camera, stamp = row.get("camera", ""), _number(path, line, row, key)
        if camera not in self.sizes:
            raise _wrong(path, line, "camera", camera, f"one of {', '.join(self.sizes)}")
        number, episode = (
            _whole(path, line, row, name) if row.get(name) else none
            for name, none in (("number", -1), ("episode", 0))
        )
        return self.seen.setdefault((camera, stamp), (number, episode, {}))[2]


def gathered_views(
    frames: GatheredFrames, stamps: FloatArray, names: tuple[str, ...], kinds: tuple[Kind, ...], positions: FloatArray,
    generators: FloatArray | None, timed: bool, counted: bool = False,
) -> RecordedViews:  # fmt: skip
    """The recording of joints ``positions`` (j, n) at ``stamps`` (j,) in their order, and of the frames within."""
    cameras = list(frames.sizes)
    keys = sorted(frames.seen, key=lambda one: (one[1], cameras.index(one[0])))
    inside = [k for k in keys if stamps[0] <= k[1] <= stamps[-1] and (timed or k[1] in stamps)]
    if len(inside) < len(keys):
        note(
            f"{len(keys) - len(inside)} of {len(keys)} frames are left out: no joints or poses at their stamps"
        )
    ids = tuple(sorted({i for key in inside for i in frames.seen[key][2]}))
    column = {marker: k for k, marker in enumerate(ids)}
    pixels, sigmas = np.full((len(inside), len(ids), 2), np.nan), np.ones((len(inside), len(ids)))
    for k, key in enumerate(inside):
        for marker, (u, v, sigma) in frames.seen[key][2].items():
            pixels[k, column[marker]], sigmas[k, column[marker]] = (u, v), sigma
    return RecordedViews(
        names, kinds, tuple(TrialCamera(name, *frames.sizes[name]) for name in cameras), ids, stamps, positions,
        np.array([cameras.index(key[0]) for key in inside], dtype=np.int64), np.array([key[1] for key in inside]),
        np.array([frames.seen[key][0] for key in inside], dtype=np.int64),
        np.array([frames.seen[key][1] for key in inside], dtype=np.int64), pixels, sigmas, generators, timed,
        counted=counted,
    )  # fmt: skip


# -- joints and poses -----------------------------------------------------------------------------------------


def _joints(
    path: Path, rows: Rows, key: str, order: np.ndarray[Any, Any]
) -> tuple[tuple[str, ...], tuple[Kind, ...], FloatArray, None]:
    columns = [name for name in rows[0] if name not in (key, "episode")]
    names, kinds, scales = [], [], []
    for column in columns:
        name, _, unit = column.partition("[")
        unit = unit.removesuffix("]") or "rad"
        if unit not in UNITS:
            raise CommandError(
                "dataset", f"{path}: column {column!r}; units are {', '.join(UNITS)}, elbow[deg]"
            )
        names.append(name.strip())
        kinds.append(UNITS[unit][0])
        scales.append(UNITS[unit][1])
    if not names:
        raise CommandError("dataset", f"{path} has no column of a joint beside {key!r}")
    values = np.array(
        [[_number(path, k, row, column) for column in columns] for k, row in enumerate(rows, 2)]
    )
    return tuple(names), tuple(kinds), values[order] * np.array(scales), None


def _poses(
    path: Path, rows: Rows, order: np.ndarray[Any, Any]
) -> tuple[tuple[str, ...], tuple[Kind, ...], FloatArray, FloatArray]:
    lacking = [name for name in POSE_COLUMNS if name not in rows[0]]
    if lacking:
        raise CommandError(
            "dataset", f"{path} lacks columns {', '.join(lacking)}; {','.join(POSE_COLUMNS)} are needed"
        )
    values = np.array(
        [[_number(path, k, row, name) for name in POSE_COLUMNS] for k, row in enumerate(rows, 2)]
    )
    lengths = np.linalg.norm(values[:, 3:], axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > UNIT)
    if len(wrong):
        k = int(wrong[0])
        raise _wrong(path, k + 2, "qx..qw", f"length {lengths[k]:.4g}", "a unit quaternion, xyzw")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    poses[:, :3, 3] = values[:, :3]
    positions, generators, _ = free_arm(poses[order])
    # A turn goes on beyond half a turn.
    return NAMES, KINDS, np.hstack([positions[:, :3], np.unwrap(positions[:, 3:], axis=0)]), generators


# -- pictures and pixels --------------------------------------------------------------------------------------


def _marker_frames(folder: Path, rows: Rows, key: str) -> GatheredFrames:
    path, listed = folder / MARKERS, folder / CAMERAS
    sizes = {
        row["camera"]: (_whole(listed, k, row, "width", 1), _whole(listed, k, row, "height", 1))
        for k, row in enumerate(_table(listed, ("camera", "width", "height")), 2)
    }  # fmt: skip
    _require(path, rows, ("camera", "marker", "u", "v"))
    frames = GatheredFrames(sizes)
    for line, row in enumerate(rows, 2):
        seen = frames.of(path, line, row, key)
        if not row["marker"]:
            continue  # a frame in which nothing was seen
        sigma = _number(path, line, row, "sigma") if row.get("sigma") else STATED_PX
        if not sigma > 0.0:
            raise _wrong(path, line, "sigma", row["sigma"], "a positive number [px]")
        seen[_whole(path, line, row, "marker")] = (
            _number(path, line, row, "u"),
            _number(path, line, row, "v"),
            sigma,
        )
    return frames


def _pictures(folder: Path, rows: Rows, key: str) -> GatheredFrames:
    path = folder / FRAMES
    _require(path, rows, ("camera", "file"))
    cameras = list(dict.fromkeys(row["camera"] for row in rows))
    detectors = {camera: stated_detector(folder / DETECTOR, camera) for camera in cameras}
    frames = GatheredFrames({})
    found = dict.fromkeys(cameras, 0)
    for line, row in enumerate(rows, 2):
        image = cv2.imread(str(folder / row["file"]), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise _wrong(path, line, "file", row["file"], "a picture in the folder that OpenCV reads")
        camera, size = row["camera"], (image.shape[1], image.shape[0])
        if frames.sizes.setdefault(camera, size) != size:
            raise _wrong(path, line, "file", row["file"], f"a picture of {frames.sizes[camera]}, not {size}")
        seen = frames.of(path, line, row, key)
        seen.update(detected(detectors[camera], camera, line, image))
        found[camera] += bool(seen)
    for camera in cameras:
        note(
            f"camera {camera}: markers in {found[camera]} of {sum(row['camera'] == camera for row in rows)} pictures"
        )
    return frames


def detected(
    detector: Detector, camera: str, number: int, image: np.ndarray[Any, Any]
) -> dict[int, tuple[float, float, float]]:
    """Pixels and their deviation [px] of each marker that a detector finds in a picture (h, w)."""
    shown = detector.detect(Frame(camera, number, 0, 0, image), None)
    spread = np.sqrt(0.5 * np.trace(shown.covariances, axis1=1, axis2=2))
    return {
        int(marker): (u, v, sigma)
        for marker, (u, v), sigma in zip(
            shown.ids.tolist(), shown.pixels.tolist(), spread.tolist(), strict=True
        )
    }


def stated_detector(path: Path, camera: str) -> Detector:
    """The detector of a camera that a file names. Raises CommandError."""
    try:
        stated = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise CommandError(
            "dataset",
            f'{path}: {error}; with pictures, it names their detector: detector = "aruco", [options] tags = [9]',
        ) from error
    name, options = stated.get("detector"), stated.get("options", {})
    if not isinstance(name, str) or not isinstance(options, dict):
        raise CommandError(
            "dataset", f"{path}: detector = {name!r}, options = {options!r}; a name and a table are valid"
        )
    context = DriverContext(MonotonicClock(), "examine", path.parent, path.parent, camera=camera)
    made: Detector = plugins.load(plugins.DETECTORS, name)(options, context)
    return made


# -- tables ---------------------------------------------------------------------------------------------------


def _table(path: Path, needed: tuple[str, ...] = ()) -> Rows:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows: Rows = [dict(row) for row in csv.DictReader(file, skipinitialspace=True)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CommandError("dataset", f"{path} cannot be read: {error}") from error
    if not rows:
        raise CommandError("dataset", f"{path} holds no row below its header")
    names = [name for name in rows[0] if name is not None]
    for line, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise CommandError("dataset", f"{path}, line {line}: {len(names)} cells are needed", line=line)
    _require(path, rows, needed)
    return rows


def _require(path: Path, rows: Rows, needed: tuple[str, ...]) -> None:
    lacking = [name for name in needed if name not in rows[0]]
    if lacking:
        raise CommandError(
            "dataset", f"{path} lacks columns {', '.join(lacking)}; it has {', '.join(map(str, rows[0]))}"
        )


def _time_column(path: Path, rows: Rows) -> str:
    found = [name for name in (TIME, ORDER) if name in rows[0]]
    if len(found) != 1:
        raise CommandError(
            "dataset",
            f"{path} needs one of the columns {TIME!r} [s] and {ORDER!r}; it has {found or 'neither'}",
        )
    return found[0]


def _number(path: Path, line: int, row: Mapping[str, str], column: str) -> float:
    text = row.get(column)
    try:
        value = float(text or "")
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise _wrong(path, line, column, str(text), "a finite number")
    return value


def _whole(path: Path, line: int, row: Mapping[str, str], column: str, least: int = 0) -> int:
    value = _number(path, line, row, column)
    if not (least <= value <= LARGEST and value == int(value)):
        raise _wrong(path, line, column, str(row[column]), f"a whole number from {least} to {LARGEST}")
    return int(value)


def _wrong(path: Path, line: int, column: str, value: str, valid: str) -> CommandError:
    return CommandError(
        "dataset", f"{path}, line {line}, column {column}: {value!r}; needed: {valid}", line=line
    )
