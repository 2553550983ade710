"""A LeRobot data set (formats 2.0, 2.1 and 3.0: parquet tables, and videos or pictures in them) as a recording:
docs/recordings.md has what is read of it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.cli.examine.folder import (
    DETECTOR,
    UNITS,
    GatheredFrames,
    detected,
    gathered_views,
    stated_detector,
)
from stereoservo.cli.output import CommandError, note
from stereoservo.kinematics.parameterization import Kind
from stereoservo.messages.decoding import decoding
from stereoservo.numerics.arrays import FloatArray, IntArray

INFO = Path("meta") / "info.json"
VERSIONS = ("v2.0", "v2.1", "v3.0")
STATE, IMAGES = "observation.state", "observation.image"
LEFT_OUT = "none"
"""Unit of a state that is no joint of the arm, such as a gripper's."""
BETWEEN_S, HELD_S = 1.0, 0.4
"""Time put between two episodes, and for which the joints then stand as at their ends."""
MOST_FRAMES = 6000
"""Frames that are examined; of longer data sets every second one, every third, …"""
COMPRESSED_PX = 0.1
"""Deviation of pixels in compressed pictures at least, whatever detectors state for others."""
MOST_COUNTED = 2**40
"""Number of a frame or an episode at most."""
COUNTED_S = 1e-3
"""Difference of stamps from the count of frames at which they are that count."""


AV1 = tuple(cv2.VideoWriter.fourcc(*name) for name in ("av01", "AV01"))

Picture = np.ndarray[Any, Any]


class Feature(msgspec.Struct):
    """An entry of ``features``: its ``dtype``, ``shape`` and the ``names`` of its parts, as data sets have them."""

    dtype: str
    shape: list[int]
    names: Any = None
    info: dict[str, Any] | None = None


class Info(msgspec.Struct):
    """What is read of ``meta/info.json``."""

    codebase_version: str
    fps: float
    features: dict[str, Feature]
    chunks_size: int = 1000
    video_path: str | None = None


class _Rows(NamedTuple):
    """Rows of all episodes in order: ``episode`` (r,), ``frame`` (r,) in it, ``stamp`` (r,) [s], ``state`` (r, n)."""

    episode: IntArray
    frame: IntArray
    stamp: FloatArray
    state: FloatArray


class _Wanted(NamedTuple):
    """A picture: number ``at`` in the file of its ``episode``, and the ``row`` that it is of."""

    at: int
    row: int
    episode: int


def is_data_set(folder: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (folder / INFO).is_file()


def read_data_set(
    folder: Path, units: str | None, cameras: str | None = None, detector: Path | None = None
) -> RecordedViews:
    """The recording in a data set, its joints in ``units`` (``deg,gripper.pos=none``), of some ``cameras`` or all.
    Raises CommandError naming what would be valid.
    """
    info = _info(folder)
    names, kinds, scales, columns = joints_of(state_names(info, folder), units)
    keys = _cameras(info, folder, cameras)
    rows = _rows(folder, info)
    stamps, joint_times, source = _one_clock(rows)
    every = max(1, -(-len(rows.stamp) * len(keys) // MOST_FRAMES))
    if every > 1:
        note(f"{len(rows.stamp) * len(keys)} pictures: of each camera one in {every} is examined")
    frames = GatheredFrames({})
    for name, key in keys.items():
        look = stated_detector(detector or folder / DETECTOR, name)
        least = COMPRESSED_PX if info.features[key].dtype == "video" else 0.0
        found = total = 0
        for row, image in _pictures(folder, info, key, rows, every):
            size = (image.shape[1], image.shape[0])
            if frames.sizes.setdefault(name, size) != size:
                raise _wrong(folder, f"{key}: a picture of {size} after {frames.sizes[name]}")
            seen = {
                marker: (u, v, max(sigma, least))
                for marker, (u, v, sigma) in detected(look, name, row, image).items()
            }
            frames.seen[name, float(stamps[row])] = (-1, int(rows.episode[row]), seen)
            total, found = total + 1, found + bool(seen)
        note(f"camera {name}: markers in {found} of {total} pictures")
    counted = bool(np.abs(rows.stamp - rows.frame / info.fps).max() < COUNTED_S)
    if counted:
        note("stamps are the count of frames over the rate: dropped frames cannot be told")
    positions = rows.state[source][:, columns] * scales
    return gathered_views(frames, joint_times, names, kinds, positions, None, True, counted)


# -- what the data set is of ----------------------------------------------------------------------------------


def _reading(what: Path | str) -> AbstractContextManager[None]:
    """Boundary around a decoder of ``what``: what it raises becomes a CommandError."""
    return decoding(lambda cause: CommandError("dataset", f"{what}: {cause}"), (CommandError,))


def _info(folder: Path) -> Info:
    path = folder / INFO
    with _reading(path):
        info = msgspec.json.decode(path.read_bytes(), type=Info)
    if info.codebase_version not in VERSIONS:
        raise _wrong(
            folder,
            f"format {info.codebase_version!r}; {', '.join(VERSIONS)} are read: lerobot has converters",
        )
    if not (math.isfinite(info.fps) and info.fps > 0.0 and info.chunks_size > 0):
        raise _wrong(
            folder, f"fps = {info.fps}, chunks_size = {info.chunks_size}; positive numbers are needed"
        )
    return info


def state_names(info: Info, folder: Path) -> list[str]:
    """Names of the parts of ``observation.state``; ``state0`` and so on where it has none. Raises CommandError."""
    feature = info.features.get(STATE)
    if feature is None or len(feature.shape) != 1:
        raise _wrong(folder, f"no feature {STATE!r} of one row a frame; it has {', '.join(info.features)}")
    stated = feature.names
    if isinstance(stated, dict) and len(stated) == 1:
        (stated,) = stated.values()
    if isinstance(stated, list) and len(stated) == feature.shape[0]:
        return [str(name) for name in stated]
    return [f"state{k}" for k in range(feature.shape[0])]


def joints_of(
    states: Sequence[str], units: str | None
) -> tuple[tuple[str, ...], tuple[Kind, ...], FloatArray, list[int]]:
    """Names, kinds and scales (n,) of those states that are joints, and their columns, as ``units`` say. Raises
    CommandError.
    """
    valid = f"{', '.join(UNITS)}, with a factor (deg*0.9 of what counts from -100 to 100), or {LEFT_OUT}"
    if units is None:
        raise CommandError(
            "units",
            f"a LeRobot data set does not say in what its states are ({', '.join(states)}): --units "
            f"deg,gripper.pos=none; valid are {valid}. Those from -100 to 100 are parts of the range in the arm's "
            "calibration file",
        )
    default, by_name = "", {}
    for part in units.split(","):
        name, given, unit = part.strip().rpartition("=")
        if given and name not in states:
            raise CommandError("units", f"--units {part!r}: the states are {', '.join(states)}")
        if given:
            by_name[name] = unit
        else:
            default = unit
    names, kinds, scales, columns = [], [], [], []
    for column, state in enumerate(states):
        unit = by_name.get(state, default)
        if unit == LEFT_OUT:
            continue
        known, _, factor = unit.partition("*")
        if known not in UNITS or not _positive(factor or "1"):
            raise CommandError("units", f"--units: {state} is in {unit!r}; valid are {valid}")
        names.append(state)
        kinds.append(UNITS[known][0])
        scales.append(UNITS[known][1] * float(factor or "1"))
        columns.append(column)
    if not names:
        raise CommandError("units", f"--units {units}: no state is left that is a joint")
    return tuple(names), tuple(kinds), np.array(scales), columns


def _positive(text: str) -> bool:
    try:
        return math.isfinite(float(text)) and float(text) > 0.0
    except ValueError:
        return False


def _cameras(info: Info, folder: Path, wanted: str | None) -> dict[str, str]:
    """By name the features of the cameras that are examined."""
    found = {
        key.removeprefix(IMAGES).removeprefix("s").removeprefix(".") or "image": key
        for key, feature in info.features.items()
        if key.startswith(IMAGES) and feature.dtype in ("video", "image") and not _of_depth(feature)
    }
    if wanted is None:
        return found
    names = [name.strip() for name in wanted.split(",")]
    if not set(names) <= set(found):
        raise _wrong(folder, f"--cameras {wanted}: the cameras are {', '.join(found) or 'none'}")
    return {name: found[name] for name in names}


def _of_depth(feature: Feature) -> bool:
    info = feature.info or {}
    return bool(info.get("video.is_depth_map") or info.get("is_depth_map"))


# -- tables ---------------------------------------------------------------------------------------------------


def _tables(folder: Path, part: str, columns: list[str]) -> list[Mapping[str, Any]]:
    """Columns of all parquet files of a part of a data set, as lists by name. Raises CommandError."""
    from pyarrow import parquet  # an extra of its own: see missing_extra

    found = []
    for path in sorted((folder / part).glob("chunk-*/*.parquet")):
        with _reading(path):
            file = parquet.ParquetFile(path)
            there = file.schema_arrow.names
            lacking = [name for name in columns if name not in there]
            if lacking:
                raise _wrong(
                    folder, f"tables of {part} lack {', '.join(lacking)}; they have {', '.join(there)}"
                )
            if file.metadata.num_rows:
                found.append(file.read(columns=columns).to_pydict())
    if not found:
        raise _wrong(folder, f"no {part}/chunk-*/*.parquet with rows")
    return found


def _rows(folder: Path, info: Info) -> _Rows:
    needed = [STATE, "timestamp", "frame_index", "episode_index"]
    tables = _tables(folder, "data", needed)
    with _reading(f"LeRobot data set {folder}: {', '.join(needed)} are to be numbers, as many in each row"):
        state, stamp, frame, episode = (
            np.concatenate([np.array(table[name], dtype=np.float64) for table in tables]) for name in needed
        )
        state = state.reshape(len(stamp), -1)
        stamp, frame, episode = (values.reshape(len(state)) for values in (stamp, frame, episode))
    if state.shape[1] != info.features[STATE].shape[0]:
        raise _wrong(
            folder,
            f"{len(stamp)} rows of {state.shape[1]} states; info.json has {info.features[STATE].shape}",
        )
    if not (np.isfinite(state).all() and np.isfinite(stamp).all()):
        raise _wrong(folder, "states or stamps that are not finite")
    counts = np.concatenate([frame, episode])
    if not ((counts >= 0.0) & (counts <= MOST_COUNTED) & (counts == np.floor(counts))).all():
        raise _wrong(
            folder, f"frame_index and episode_index are to be whole numbers from 0 to {MOST_COUNTED}"
        )
    order = np.lexsort((frame, episode))
    episode, frame, stamp = episode[order].astype(np.int64), frame[order].astype(np.int64), stamp[order]
    together = np.diff(episode) == 0
    for wrong, what in (
        (np.diff(frame) == 0, "is there twice"),
        (np.diff(stamp) < 0.0, "is stamped before the one before it"),
    ):
        found = np.flatnonzero(together & wrong)
        if len(found):
            row = int(found[0]) + 1
            raise _wrong(folder, f"frame {frame[row]} of episode {episode[row]} {what}")
    return _Rows(episode, frame, stamp, state[order])


def _one_clock(rows: _Rows) -> tuple[FloatArray, FloatArray, IntArray]:
    """Stamps (r,) [s] of one clock, episodes one after another, and times (j,) of the joints with the rows (j,) that
    they are of; joints stand for a moment before and after each episode.
    """
    stamps = rows.stamp.copy()
    times, source, end = [], [], 0.0
    for episode in np.unique(rows.episode).tolist():
        mine = np.flatnonzero(rows.episode == episode)
        stamps[mine] += end - stamps[mine[0]]
        own = stamps[mine]
        times.append(np.concatenate([[own[0] - HELD_S], own, [own[-1] + HELD_S]]))
        source.append(np.concatenate([mine[:1], mine, mine[-1:]]))
        end = float(own[-1]) + BETWEEN_S
    return stamps, np.concatenate(times), np.concatenate(source)


# -- pictures -------------------------------------------------------------------------------------------------


def _pictures(folder: Path, info: Info, key: str, rows: _Rows, every: int) -> Iterator[tuple[int, Picture]]:
    """Rows and their pictures (h, w) of one camera."""
    kept = [row for row in range(len(rows.stamp)) if row % every == 0]
    if info.features[key].dtype == "image":
        yield from _stored_pictures(folder, key, rows, set(kept))
        return
    files: dict[Path, list[_Wanted]] = {}
    place = _video_places(folder, info, key)
    for row in kept:
        episode = int(rows.episode[row])
        path, begin = place(episode)
        files.setdefault(path, []).append(_Wanted(begin + int(rows.frame[row]), row, episode))
    for path, wanted in files.items():
        yield from _decoded(path, sorted(wanted))


def _video_places(folder: Path, info: Info, key: str) -> Callable[[int], tuple[Path, int]]:
    """Function from an episode to the video file that holds it and the number of its first frame there."""
    if info.video_path is None:
        raise _wrong(folder, "info.json has no video_path")
    template = info.video_path

    def file_of(**numbers: int) -> Path:
        names = ", ".join(("video_key", *numbers))
        with _reading(
            f"LeRobot data set {folder}: video_path = {template[:200]!r}; its parts may be {names}"
        ):
            return folder / template.format(video_key=key, **numbers)

    if info.codebase_version != VERSIONS[-1]:

        def own_file(episode: int) -> tuple[Path, int]:
            return file_of(episode_chunk=episode // info.chunks_size, episode_index=episode), 0

        return own_file
    needed = [f"videos/{key}/{part}" for part in ("chunk_index", "file_index", "from_timestamp")]
    places = {}
    for table in _tables(folder, "meta/episodes", ["episode_index", *needed]):
        for episode, chunk, file, begin in zip(
            *(table[name] for name in ("episode_index", *needed)), strict=True
        ):
            with _reading(
                f"LeRobot data set {folder}: meta/episodes, episode {episode}, {', '.join(needed)}"
            ):
                places[int(episode)] = (
                    file_of(chunk_index=int(chunk), file_index=int(file)), round(float(begin) * info.fps)
                )  # fmt: skip

    def shared_file(episode: int) -> tuple[Path, int]:
        if episode not in places:
            raise _wrong(folder, f"meta/episodes has no episode {episode}")
        return places[episode]

    return shared_file


def _decoded(path: Path, wanted: list[_Wanted]) -> Iterator[tuple[int, Picture]]:
    """Pictures of a video in their order. Raises CommandError where it cannot be decoded, or ends before."""
    if not os.path.isfile(path):  # also of a name that the system does not take
        raise CommandError("dataset", f"{path}: no such video")
    pictures, number = _all_pictures(path), -1
    for one in wanted:
        take: Callable[[], Picture] | None = None
        while number < one.at and (take := next(pictures, None)) is not None:
            number += 1
        if take is None:
            raise CommandError(
                "dataset",
                f"{path}: no picture {one.at} (episode {one.episode}); {number + 1} could be decoded. Has it been "
                "copied as a whole?",
            )
        yield one.row, take()


def _all_pictures(path: Path) -> Iterator[Callable[[], Picture]]:
    """Functions that return the pictures (h, w) of a video, one after another."""
    video = cv2.VideoCapture(str(path))
    try:
        if int(video.get(cv2.CAP_PROP_FOURCC)) in AV1:
            # LeRobot's own codec, which the FFmpeg in OpenCV's wheels does not decode.
            yield from _by_pyav(path)
            return
        while video.grab():
            yield lambda: cv2.cvtColor(video.retrieve()[1], cv2.COLOR_BGR2GRAY)
    finally:
        video.release()


def _by_pyav(path: Path) -> Iterator[Callable[[], Picture]]:
    import av  # of the extra that also brings pyarrow: see missing_extra

    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                yield partial(frame.to_ndarray, format="gray")
    except av.FFmpegError as error:
        raise CommandError("dataset", f"{path}: {error}") from error


def _stored_pictures(folder: Path, key: str, rows: _Rows, kept: set[int]) -> Iterator[tuple[int, Picture]]:
    """Pictures that the tables hold themselves."""
    row_of = {
        one: row for row, one in enumerate(zip(rows.episode.tolist(), rows.frame.tolist(), strict=True))
    }
    names = [key, "episode_index", "frame_index"]
    for table in _tables(folder, "data", names):
        for picture, episode, frame in zip(*(table[name] for name in names), strict=True):
            row = row_of[int(episode), int(frame)]
            if row not in kept:
                continue
            at = f"{key}: no picture that OpenCV reads at frame {frame} of episode {episode}"
            image = None
            with _reading(f"LeRobot data set {folder}: {at}"):
                data = np.frombuffer((picture or {}).get("bytes") or b"", dtype=np.uint8)
                image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
            if image is None:
                raise _wrong(folder, at)
            yield row, image


def _wrong(folder: Path, what: str) -> CommandError:
    return CommandError("dataset", f"LeRobot data set {folder}: {what}")
