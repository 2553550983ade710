"""Command ``stereoservo examine``: a recording of joints and pictures judged: cameras, joints, stamps, frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
import typer
from scipy.spatial.transform import Rotation

from stereoservo.calibration.examination.examination import RecordingReport, examine_views
from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.calibration.known_arm import KINDS, NAMES, free_arm
from stereoservo.calibration.trial_data import CalibrationError, TrialCamera
from stereoservo.cli.board_folder import BOARD, board_text, examine_board_folder, read_board
from stereoservo.cli.output import CommandError, JsonOption, emit, log, read_columns
from stereoservo.core.state_encoding import StateVersionError, decode_state
from stereoservo.kinematics.model import CellModel
from stereoservo.kinematics.parameterization import Kind
from stereoservo.messages.decoding import cause_of
from stereoservo.messages.text_files import complete, toml_of
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports import lerobot, plugins
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import CameraObservation, Detector, DriverContext, DriverError, Frame
from stereoservo.ports.lerobot import UNITS, is_data_set
from stereoservo.ports.pose_files import PoseFileError, board_poses, picture_sets, pose_paths, read_poses
from stereoservo.recording.recorded_motion import read_motion
from stereoservo.recording.replay import RecordingError, recorded_messages
from stereoservo.recording.step_layout import decode_step


def examine(
    dataset: Annotated[
        Path,
        typer.Argument(
            metavar="DATASET", help="A flight recording (*.mcap), a folder or a LeRobot data set: docs/recordings.md."
        ),
    ],
    units: Annotated[
        str | None, typer.Option(help="Of a LeRobot data set: in what its states are, such as deg,gripper.pos=none.")
    ] = None,
    cameras: Annotated[
        str | None, typer.Option(help="Of a LeRobot data set: the cameras to examine, such as top,side.")
    ] = None,
    detector: Annotated[
        Path | None,
        typer.Option(help="Of a LeRobot data set: the file that names the detector. Default: detector.toml in it."),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Of a folder of pictures: the file, or folder of files, with the hand's poses."
        ),
    ] = None,
    pose_format: Annotated[
        str,
        typer.Option(help="What is known of these poses, such as mm,wxyz or inverted. Default: found from the data."),
    ] = "",
    json: JsonOption = False,
) -> None:
    """Judge a recording of joints and pictures: bumped cameras, drifted zeros, late stamps, dropped frames.

    Cameras and arm are learnt from the motion in it. Each cause has its onset, size and deviation; where the recording
    does not tell two causes apart, both are named, and what would decide. Exits non-zero only where it cannot be read.
    """
    if dataset.is_dir() and is_data_set(dataset):
        views = read_data_set(dataset, units, cameras, detector)
    elif any(one is not None for one in (units, cameras, detector)):
        raise CommandError("dataset", f"--units, --cameras and --detector are for LeRobot data sets; {dataset} is none")
    elif (dataset / BOARD).is_file() and len(picture_sets(dataset)) == 1:
        found = examine_board_folder(dataset, poses, pose_format)
        emit(found, board_text(found), json)
        return
    elif dataset.is_dir():
        views = read_folder(dataset, poses, pose_format)
    elif dataset.is_file():
        views = read_flight(dataset)
    else:
        raise CommandError("dataset", f"{dataset} is no flight recording (*.mcap), folder or LeRobot data set")
    try:
        report = examine_views(views)
    except CalibrationError as error:
        raise CommandError(error.code, "; ".join((str(error), *views.notes)), notes=views.notes) from error
    emit(report, _text(report), json)


def _text(report: RecordingReport) -> str:
    lines = []
    if report.learnt_from is None and report.rms_px is not None:
        lines.append(
            f"residuals {report.rms_px:.3f} px rms ({report.before_px:.3f} px with what has happened), of the "
            f"{report.stratum} model that the recording holds: no joint motions to learn one from"
        )
    if report.learnt_from is not None:
        first, last, stops = report.learnt_from
        lines.append(
            f"residuals {report.rms_px:.3f} px rms ({report.before_px:.3f} px with what has happened); "
            f"{report.stratum} model learnt from {stops} stops in frames {first} to {last}, {report.outliers} pixels "
            "left out"
        )
    for name, one in report.cameras.items():
        rms = "" if one.rms_px is None else f", {one.rms_px:.3f} px rms"
        offset = (
            ""
            if one.offset_s is None
            else f", {1e3 * one.offset_s:+.1f} ± {1e3 * (one.offset_deviation_s or 0):.1g} ms"
        )
        lost = "drops cannot be told" if one.dropped is None else f"{one.dropped} dropped"
        lines.append(f"  camera {name}: {one.frames} frames, {lost}{rms}{offset}")
    if report.joints:
        lines.append("  by joint [px rms]: " + ", ".join(f"{name} {rms:.3f}" for name, rms in report.joints.items()))
    if len(report.episodes) > 1:
        lines += [_of_episode(report, name, rms) for name, rms in report.episodes.items()]
    lines += [f"* {cause.message}" for cause in report.causes] or ["nothing has happened"]
    lines += [f"  note: {one}" for one in report.notes]
    lines.append(
        f"(a recording to which nothing has happened is said to have a change once in {1 / report.false_alarm:.0f})"
    )
    return "\n".join(lines)


def _of_episode(report: RecordingReport, name: str, rms: float) -> str:
    """Line on an episode: its residuals, and the causes found in it."""
    held = [f"{one.kind} {one.subject}".strip() for one in report.causes if int(name) in one.episodes]
    return f"  episode {name}: {rms:.3f} px rms, {', '.join(held) or 'nothing has happened'}"


# -- flight recordings ---------------------------------------------------------------------------------------
# A flight recording as joints and marker pixels over time.


BODY_MOVES = (
    "the marker body of this cell moves by itself ([scene] moves = true): where it did, that is in the residuals and "
    "may be told as a cause, and is no fault; stamps are not examined, since such motion looks as if they were late"
)
MOST_FRAMES = 6000
"""Maximum number of frames that are examined; of longer recordings every second one, every third, …"""


def read_flight(path: Path) -> RecordedViews:
    """The recording in a flight (*.mcap): joints and cameras as the core received them. Raises RecordingError."""
    motion = read_motion(path)
    observations, model = _contents(path)
    settings = motion.settings
    cameras = [camera.name for camera in settings.cameras]
    seen = [one for one in observations if one.camera in cameras]
    every = max(1, -(-len(seen) // MOST_FRAMES))
    if every > 1:
        log(f"{len(seen)} frames: of each camera one in {every} is examined")
    ranks = dict.fromkeys(cameras, 0)
    kept: list[CameraObservation] = []
    for one in sorted(seen, key=lambda o: (o.t_shutter_ns, cameras.index(o.camera))):
        if ranks[one.camera] % every == 0:
            kept.append(one)
        ranks[one.camera] += 1
    ids = tuple(i for i in settings.marker_ids if i not in settings.scene_ids)
    column = {marker: k for k, marker in enumerate(ids)}
    pixels, sigmas = np.full((len(kept), len(ids), 2), np.nan), np.ones((len(kept), len(ids)))
    for k, one in enumerate(kept):
        mine = np.array([column.get(int(i), -1) for i in one.ids], dtype=np.int64)
        known = mine >= 0
        pixels[k, mine[known]] = one.pixels[known]
        sigmas[k, mine[known]] = np.sqrt(0.5 * np.trace(one.covariances, axis1=1, axis2=2))[known]
    begin = int(motion.joint_ns[0])
    known_offsets = {} if model is None else {one.camera: one.offset_s for one in model.shutter_offsets}
    stamps = [(one.t_shutter_ns - begin) * 1e-9 + known_offsets.get(one.camera, 0.0) for one in kept]
    # Sequence numbers count the camera's frames; if frames are left out, they would look like dropped ones.
    numbers = [one.seq if every == 1 else -1 for one in kept]
    return RecordedViews(
        settings.joint_names, settings.joint_kinds,
        tuple(TrialCamera(c.name, c.width, c.height, c.mount) for c in settings.cameras), ids,
        np.asarray((motion.joint_ns - begin) * 1e-9, dtype=np.float64), motion.positions,
        np.array([cameras.index(one.camera) for one in kept], dtype=np.int64),
        np.array(stamps), np.array(numbers, dtype=np.int64),
        np.zeros(len(kept), dtype=np.int64), pixels, sigmas, model=model,
        body_moves=settings.body_moves, notes=(BODY_MOVES,) if settings.body_moves else (),
    )  # fmt: skip


def _contents(path: Path) -> tuple[list[CameraObservation], CellModel | None]:
    """All observations, and the first model."""
    found: list[CameraObservation] = []
    model: CellModel | None = None
    for topic, data in recorded_messages(path):
        try:
            if topic == "checkpoint" and model is None:
                model = decode_state(msgspec.msgpack.decode(data)[1]).model
            elif topic == "step":
                inputs = decode_step(data).inputs
                found += inputs.observations
                if model is None and inputs.model_update is not None:
                    model = inputs.model_update.model
        except StateVersionError:
            continue  # a recording of another version is examined without its model
        except Exception as error:  # a decoder may raise anything
            raise RecordingError(path, 0, f"{topic} record is damaged ({cause_of(error)})") from error
    return found, model


# -- LeRobot data sets ---------------------------------------------------------------------------------------
# A LeRobot data set as a recording: docs/recordings.md lists the data that are read.


BETWEEN_S, HELD_S = 1.0, 0.4
"""Time between two episodes, and time for which the joints are extrapolated beyond both ends [s]."""
COMPRESSED_PX = 0.1
"""Least standard deviation of pixels in compressed pictures, whatever detectors state for others."""
COUNTED_S = 1e-3
"""Largest difference of stamps from a count of frames at which they are taken as that count."""


def read_data_set(
    folder: Path, units: str | None, cameras: str | None = None, detector: Path | None = None
) -> RecordedViews:
    """The recording in a data set, its joints in ``units`` (``deg,gripper.pos=none``), of some ``cameras`` or all.
    Raises CommandError naming what would be valid.
    """
    with _refused():
        return _views(folder, units, cameras, detector)


@contextmanager
def _refused() -> Iterator[None]:
    try:
        yield
    except lerobot.DataSetError as error:
        raise CommandError(error.code, str(error)) from error


def _views(folder: Path, units: str | None, cameras: str | None, detector: Path | None) -> RecordedViews:
    info = lerobot.read_info(folder)
    names, kinds, scales, columns = lerobot.joints_of(lerobot.state_names(info, folder), units)
    wanted = None if cameras is None else [name.strip() for name in cameras.split(",")]
    keys = lerobot.camera_features(info, folder, wanted)
    losses: list[lerobot.Loss] = []
    rows = lerobot.read_rows(folder, info, losses=losses)
    stamps, joint_times, states = _one_clock(rows)
    every = max(1, -(-len(rows.stamp) * len(keys) // MOST_FRAMES))
    if every > 1:
        log(f"{len(rows.stamp) * len(keys)} pictures: of each camera one in {every} is examined")
    frames, notes = GatheredFrames({}), []
    for name, key in keys.items():
        look = stated_detector(detector or folder / DETECTOR, name)
        least = COMPRESSED_PX if info.features[key].dtype == "video" else 0.0
        seen: dict[float, tuple[int, int, dict[int, tuple[float, float, float]]]] = {}
        size = None
        for row, decoded in lerobot.pictures(folder, info, key, rows, every, gray=True, losses=losses):
            try:
                image = decoded()
            except lerobot.DataSetError as error:
                losses.append(lerobot.Loss(str(error), name, int(rows.episode[row]), int(rows.frame[row])))
                continue
            size, before = (image.shape[1], image.shape[0]), size
            if before not in (None, size):
                raise CommandError("dataset", f"LeRobot data set {folder}: {key}: a picture of {size} after {before}")
            markers = {
                marker: (u, v, max(sigma, least)) for marker, (u, v, sigma) in detected(look, name, row, image).items()
            }
            seen[float(stamps[row])] = -1, int(rows.episode[row]), markers
        found = sum(bool(markers) for _, _, markers in seen.values())
        log(f"camera {name}: markers in {found} of {len(seen)} pictures")
        if found and size is not None:
            frames.sizes[name] = size
            frames.seen |= {(name, stamp): frame for stamp, frame in seen.items()}
        else:
            notes.append(f"camera {name} shows a marker in none of its {len(seen)} pictures, and is left out")
    if not frames.sizes:
        raise CommandError(
            "dataset",
            f"LeRobot data set {folder}: no camera shows a marker that the detector looks for; its cameras are "
            f"{', '.join(keys) or 'none'}" + "".join(f"; {text}" for text in lerobot.described_losses(losses)),
        )
    notes += lerobot.described_losses(losses)
    counted = bool(np.abs(rows.stamp - rows.frame / info.fps).max() < COUNTED_S)
    if counted:
        log("stamps are the count of frames over the rate: dropped frames cannot be told")
    positions = states[:, columns] * scales
    views = gathered_views(frames, joint_times, names, kinds, positions, None, True, counted)
    return replace(views, notes=tuple(notes))


def _one_clock(rows: lerobot.EpisodeRows) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Stamps (r,) [s] on one clock, episodes one after another, and times (j,) and states (j, n) of the joints. The
    joints are extrapolated before and after each episode, for pictures that are late relative to them.
    """
    stamps = rows.stamp.copy()
    times, states, end = [], [], 0.0
    for episode in np.unique(rows.episode).tolist():
        mine = np.flatnonzero(rows.episode == episode)
        stamps[mine] += end - stamps[mine[0]]
        own, state = stamps[mine], rows.state[mine]
        times.append(np.concatenate([[own[0] - HELD_S], own, [own[-1] + HELD_S]]))
        states += [_gone_on(own[1::-1], state[1::-1]), state, _gone_on(own[-2:], state[-2:])]
        end = float(own[-1]) + BETWEEN_S
    return stamps, np.concatenate(times), np.concatenate(states)


def _gone_on(times: FloatArray, states: FloatArray) -> FloatArray:
    """State (1, n) shortly after the last one of two at their ``times``, or before it if they are in reverse order."""
    elapsed = abs(float(times[-1] - times[0]))
    return states[-1:] + (states[-1:] - states[:1]) * (HELD_S / elapsed if elapsed > 0.0 else 0.0)


# -- folders -------------------------------------------------------------------------------------------------
# A folder of stamps, joint angles or poses of the hand, and pictures or pixels of markers, as a recording:
# docs/recordings.md has the format.


JOINTS, POSES, MARKERS, FRAMES, CAMERAS = ("joints.csv", "poses.csv", "markers.csv", "frames.csv", "cameras.csv")
DETECTOR = "detector.toml"
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
TIME, ORDER = "t", "index"
STATED_PX = 0.1
"""Standard deviation assumed for a pixel without a stated one; the actual scatter of the pixels is estimated."""
LARGEST = 10**9
"""Largest value of integers: markers, sizes, counts of frames."""
UNIT = 1e-2
"""Largest deviation of a quaternion's norm from 1."""

Rows = list[tuple[int, dict[str, str]]]
"""Rows of a table, each with its line."""


def read_folder(folder: Path, poses: Path | None = None, pose_format: str = "") -> RecordedViews:
    """The recording in a folder: tables, or pictures with a board and ``poses`` of any ``pose_format``. Raises
    CommandError naming file, row, value and what would be valid.
    """
    given = [name for name in (JOINTS, POSES) if (folder / name).is_file()]
    seen = [name for name in (MARKERS, FRAMES) if (folder / name).is_file()]
    if not seen and JOINTS not in given and (pictures := picture_sets(folder)):
        return _pictures_with_poses(folder, pictures, poses, pose_format)
    if len(given) != 1 or len(seen) != 1:
        raise CommandError(
            "dataset",
            f"{folder} has {', '.join(given + seen) or 'no table'}; one of {JOINTS} and {POSES}, and one of {MARKERS} "
            f"and {FRAMES} are needed, or pictures with {BOARD} and a file of poses",
        )
    motion = _table(folder / given[0])
    key = _time_column(folder / given[0], motion)
    stamps = np.array([_number(folder / given[0], line, row, key) for line, row in motion])
    order = np.argsort(stamps, kind="stable")
    names, kinds, positions, generators = (
        _joints(folder / JOINTS, motion, key, order) if given[0] == JOINTS else _poses(folder / POSES, motion, order)
    )
    table = _table(folder / seen[0])
    if _time_column(folder / seen[0], table) != key:
        raise CommandError("dataset", f"{folder / seen[0]} has no column {key!r}, which {given[0]} has")
    frames = _marker_frames(folder, table, key) if seen[0] == MARKERS else _pictures(folder, table, key)
    return gathered_views(frames, stamps[order], names, kinds, positions, generators, key == TIME)


class GatheredFrames:
    """Collected frames: by (camera, stamp) the number, episode, and pixels with their standard deviations by marker;
    ``sizes`` (width, height) of the cameras' pictures.
    """

    def __init__(self, sizes: dict[str, tuple[int, int]]) -> None:
        self.sizes = sizes
        self.seen: dict[tuple[str, float], tuple[int, int, dict[int, tuple[float, float, float]]]] = {}

    def of(self, path: Path, line: int, row: Mapping[str, str], key: str) -> dict[int, tuple[float, float, float]]:
        camera, stamp = row.get("camera", ""), _number(path, line, row, key)
        if camera not in self.sizes:
            raise _wrong(path, line, "camera", camera, f"one of {', '.join(self.sizes)}")
        number, episode = (
            _whole(path, line, row, name) if row.get(name) else none for name, none in (("number", -1), ("episode", 0))
        )
        return self.seen.setdefault((camera, stamp), (number, episode, {}))[2]


def gathered_views(
    frames: GatheredFrames, stamps: FloatArray, names: tuple[str, ...], kinds: tuple[Kind, ...], positions: FloatArray,
    generators: FloatArray | None, timed: bool, counted: bool = False,
) -> RecordedViews:  # fmt: skip
    """The recording of joints ``positions`` (j, n) at ``stamps`` (j,) in their order, and the frames between them."""
    cameras = list(frames.sizes)
    keys = sorted(frames.seen, key=lambda one: (one[1], cameras.index(one[0])))
    inside = [k for k in keys if stamps[0] <= k[1] <= stamps[-1] and (timed or k[1] in stamps)]
    if len(inside) < len(keys):
        log(f"{len(keys) - len(inside)} of {len(keys)} frames are left out: no joints or poses at their stamps")
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
    columns = [name for name in rows[0][1] if name not in (key, "episode")]
    names, kinds, scales = [], [], []
    for column in columns:
        name, _, unit = column.partition("[")
        unit = unit.removesuffix("]") or "rad"
        if unit not in UNITS:
            raise CommandError("dataset", f"{path}: column {column!r}; units are {', '.join(UNITS)}, elbow[deg]")
        names.append(name.strip())
        kinds.append(UNITS[unit][0])
        scales.append(UNITS[unit][1])
    if not names:
        raise CommandError("dataset", f"{path} has no column of a joint beside {key!r}")
    values = np.array([[_number(path, line, row, column) for column in columns] for line, row in rows])
    return tuple(names), tuple(kinds), values[order] * np.array(scales), None


def _poses(
    path: Path, rows: Rows, order: np.ndarray[Any, Any]
) -> tuple[tuple[str, ...], tuple[Kind, ...], FloatArray, FloatArray]:
    lacking = [name for name in POSE_COLUMNS if name not in rows[0][1]]
    if lacking:
        raise CommandError("dataset", f"{path} lacks columns {', '.join(lacking)}; {','.join(POSE_COLUMNS)} are needed")
    values = np.array([[_number(path, line, row, name) for name in POSE_COLUMNS] for line, row in rows])
    lengths = np.linalg.norm(values[:, 3:], axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1.0) > UNIT)
    if len(wrong):
        k = int(wrong[0])
        raise _wrong(path, rows[k][0], "qx..qw", f"length {lengths[k]:.4g}", "a unit quaternion, xyzw")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(values[:, 3:]).as_matrix()
    poses[:, :3, 3] = values[:, :3]
    return _arm_of_poses(poses[order])


def _arm_of_poses(poses: FloatArray) -> tuple[tuple[str, ...], tuple[Kind, ...], FloatArray, FloatArray]:
    """Names, kinds, positions (j, 6) and generators of the free arm that makes ``poses`` (j, 4, 4) [m]."""
    positions, generators, _ = free_arm(poses)
    # Unwrap turns beyond half a turn.
    return NAMES, KINDS, np.hstack([positions[:, :3], np.unwrap(positions[:, 3:], axis=0)]), generators


# -- pictures and pixels --------------------------------------------------------------------------------------


def _marker_frames(folder: Path, rows: Rows, key: str) -> GatheredFrames:
    path, listed = folder / MARKERS, folder / CAMERAS
    sizes = {
        row["camera"]: (_whole(listed, line, row, "width", 1), _whole(listed, line, row, "height", 1))
        for line, row in _table(listed, ("camera", "width", "height"))
    }
    _require(path, rows, ("camera", "marker", "u", "v"))
    frames = GatheredFrames(sizes)
    for line, row in rows:
        seen = frames.of(path, line, row, key)
        if not row["marker"]:
            continue  # a frame without detections
        sigma = _number(path, line, row, "sigma") if row.get("sigma") else STATED_PX
        if not sigma > 0.0:
            raise _wrong(path, line, "sigma", row["sigma"], "a positive number [px]")
        seen[_whole(path, line, row, "marker")] = (_number(path, line, row, "u"), _number(path, line, row, "v"), sigma)
    return frames


def _pictures(folder: Path, rows: Rows, key: str) -> GatheredFrames:
    path = folder / FRAMES
    _require(path, rows, ("camera", "file"))
    cameras = list(dict.fromkeys(row["camera"] for _, row in rows))
    detectors = {camera: stated_detector(folder / DETECTOR, camera) for camera in cameras}
    frames = GatheredFrames({})
    found = dict.fromkeys(cameras, 0)
    for line, row in rows:
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
        log(
            f"camera {camera}: markers in {found[camera]} of {sum(row['camera'] == camera for _, row in rows)} pictures"
        )
    return frames


def detected(
    detector: Detector, camera: str, number: int, image: np.ndarray[Any, Any]
) -> dict[int, tuple[float, float, float]]:
    """Pixels and their standard deviations [px] of each marker that a detector finds in a picture (h, w)."""
    shown = detector.detect(Frame(camera, number, 0, 0, image), None)
    spread = np.sqrt(0.5 * np.trace(shown.covariances, axis1=1, axis2=2))
    return {
        int(marker): (u, v, sigma)
        for marker, (u, v), sigma in zip(shown.ids.tolist(), shown.pixels.tolist(), spread.tolist(), strict=True)
    }


def stated_detector(path: Path, camera: str) -> Detector:
    """The detector of a camera, named in a file. Raises CommandError."""
    try:
        stated = complete(toml_of(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise CommandError(
            "dataset",
            f'{path}: {error}; with pictures, it names their detector: detector = "aruco", [options] tags = [9]',
        ) from error
    name, options = stated.get("detector"), stated.get("options", {})
    if not isinstance(name, str) or not isinstance(options, dict):
        raise CommandError(
            "dataset", f"{path}: detector = {name!r}, options = {options!r}; a name and a table are valid"
        )
    return _detector(path, name, options, camera)


def _detector(path: Path, name: str, options: dict[str, Any], camera: str) -> Detector:
    """A detector that a file names."""
    context = DriverContext(MonotonicClock(), "examine", path.parent, path.parent, camera=camera)
    try:
        made: Detector = plugins.load(plugins.DETECTORS, name)(options, context)
    except DriverError as error:
        raise CommandError("dataset", f"{path}: {error}") from error
    return made


# -- pictures with a board, and poses as people have them -------------------------------------------------------


def _pictures_with_poses(
    folder: Path, pictures: dict[str, list[Path]], stated: Path | None, pose_format: str
) -> RecordedViews:
    frames, notes = GatheredFrames({}), list[str]()
    board = read_board(folder) if (folder / BOARD).is_file() else None
    layout, first = (np.zeros((0, 3)), 0) if board is None else (board.layout, board.first_id)
    shown_to: tuple[FloatArray, tuple[int, int]] | None = None
    names = [path.name for path in next(iter(pictures.values()))]
    for camera, paths in pictures.items():
        detector = stated_detector(folder / DETECTOR, camera) if board is None else board.detector()
        pixels = np.full((len(paths), len(layout), 2), np.nan)
        found: dict[tuple[str, float], tuple[int, int, dict[int, tuple[float, float, float]]]] = {}
        for k, path in enumerate(paths):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            size = None if image is None else (image.shape[1], image.shape[0])
            if image is None or size is None or frames.sizes.setdefault(camera, size) != size:
                notes.append(f"{path}: no picture, or of another size than the others: left out")
                continue
            markers = detected(detector, camera, k, image)
            found[camera, float(k)] = k, 0, markers
            for marker, (u, v, _) in markers.items():
                if first <= marker < first + len(layout):
                    pixels[k, marker - first] = u, v
        shown = sum(bool(markers) for _, _, markers in found.values())
        log(f"camera {camera}: markers in {shown} of {len(paths)} pictures")
        if not shown:
            notes.append(f"camera {camera} shows the board in none of its {len(paths)} pictures, and is left out")
            frames.sizes.pop(camera, None)
            continue
        frames.seen |= found
        if board is not None and shown_to is None:
            shown_to = pixels, frames.sizes[camera]
    if not frames.sizes:
        raise CommandError("dataset", f"{folder}: {'; '.join(notes)}; is the board as {BOARD} or {DETECTOR} has it?")
    try:
        motion = None if shown_to is None else board_poses(shown_to[0], layout[:, :2], shown_to[1])
        read = read_poses(pose_paths(folder, stated), names, motion, pose_format)
    except PoseFileError as error:
        raise CommandError("dataset", str(error)) from error
    order = np.argsort(read.pictures)
    notes += [str(one) for one in read.findings]
    arm = _arm_of_poses(read.poses[order])
    return replace(gathered_views(frames, read.pictures[order].astype(float), *arm, False), notes=tuple(notes))


# -- tables ---------------------------------------------------------------------------------------------------


def _table(path: Path, needed: tuple[str, ...] = ()) -> Rows:
    return read_columns(path, needed, "dataset")


def _require(path: Path, rows: Rows, needed: tuple[str, ...]) -> None:
    lacking = [name for name in needed if name not in rows[0][1]]
    if lacking:
        raise CommandError("dataset", f"{path} lacks columns {', '.join(lacking)}; it has {', '.join(rows[0][1])}")


def _time_column(path: Path, rows: Rows) -> str:
    found = [name for name in (TIME, ORDER) if name in rows[0][1]]
    if len(found) != 1:
        raise CommandError(
            "dataset", f"{path} needs one of the columns {TIME!r} [s] and {ORDER!r}; it has {found or 'neither'}"
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
    return CommandError("dataset", f"{path}, line {line}, column {column}: {value!r}; needed: {valid}", line=line)
