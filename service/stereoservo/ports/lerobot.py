"""Reader of LeRobot data sets (formats 2.0, 2.1 and 3.0: parquet tables, and videos or images in them);
docs/recordings.md lists the data that are read. Besides DataSetError, functions raise only ModuleNotFoundError, if the
extra ``lerobot`` is not installed.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np

from stereoservo.messages.decoding import decoding
from stereoservo.messages.text_files import complete, json_of
from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray
from stereoservo.ports.devices import JointKindName

INFO = Path("meta") / "info.json"
VERSIONS = ("v2.0", "v2.1", "v3.0")
STATE = "observation.state"
IMAGES = ("observation.image", "observation.image.", "observation.images.")
LEFT_OUT = "none"
"""Unit of a state that is not a joint of the arm, such as a gripper's."""
UNITS: dict[str, tuple[JointKindName, float]] = {
    "rad": ("revolute", 1.0),
    "deg": ("revolute", math.pi / 180.0),
    "m": ("prismatic", 1.0),
    "mm": ("prismatic", 1e-3),
}
"""Units of joints: joint kind, and size of the unit [rad or m]."""
MOST_COUNTED = 2**40
"""Largest number of a frame or an episode."""
MOST_STATES = 4096
MOST_EPISODES = 100_000
LARGEST_STAMP_S = 1e6
MOST_NAMED = 20
"""Largest number of episodes that an error message lists."""

CELLS = 16
"""Number of images of a table that are read at a time, within a row group (in LeRobot: an episode)."""
NEAR = 0.25
"""Largest deviation of an image from its time, in periods of the data set. LeRobot's own reader allows 0.1 ms."""
MOST_REORDERED = 16
"""Largest number of frames by which decoding order may differ from display order, for all codecs."""

Picture = Callable[[], ImageArray]
"""Function that decodes an image ``(height, width[, 3])``, BGR; must be called before the next image is requested.
Raises DataSetError.
"""


Lose = Callable[[int, "DataSetError"], None]
"""Function that is called with a row whose image is missing, and why; may raise that error."""


class DataSetError(Exception):
    """A data set, or a request for its data, cannot be used. ``code``: ``dataset`` or ``units``."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class Loss(NamedTuple):
    """What of a data set cannot be read, and its ``cause``: a ``frame`` of a ``camera`` in an ``episode``, or, without
    these, something else.
    """

    cause: str
    camera: str = ""
    episode: int = -1
    frame: int = -1


def described_losses(losses: Sequence[Loss]) -> list[str]:
    """Texts on what is lost, frames of a camera that follow each other together; at most ``MOST_NAMED``."""
    found = [loss.cause for loss in losses if not loss.camera]
    runs: list[list[Loss]] = []
    for loss in (loss for loss in losses if loss.camera):
        if runs and runs[-1][-1][1:] == (loss.camera, loss.episode, loss.frame - 1):
            runs[-1].append(loss)
        else:
            runs.append([loss])
    for (first, *_), last in ((run, run[-1]) for run in runs):
        which = f"frame {first.frame}" if first is last else f"frames {first.frame} to {last.frame}"
        found.append(f"lost: episode {first.episode}, {which}, camera {first.camera}: {first.cause}")
    more = [f"{len(found) - MOST_NAMED} more losses"] if len(found) > MOST_NAMED else []
    return found[:MOST_NAMED] + more


class Feature(msgspec.Struct):
    """An entry of ``features``: its ``dtype``, ``shape`` and the ``names`` of its components, in the data set's format,
    and the properties of a video, in ``info`` or, in older sets, ``video_info``.
    """

    dtype: str
    shape: list[int]
    names: Any = None
    info: dict[str, Any] | None = None
    video_info: dict[str, Any] | None = None


class Info(msgspec.Struct):
    """The fields of ``meta/info.json`` that are read."""

    codebase_version: str
    fps: float
    features: dict[str, Feature]
    chunks_size: int = 1000
    total_episodes: int | None = None
    video_path: str | None = None


class EpisodeRows(NamedTuple):
    """Rows of episodes in order: ``episode`` (r,), ``frame`` (r,) in it, ``stamp`` (r,) [s], ``state`` (r, n)."""

    episode: IntArray
    frame: IntArray
    stamp: FloatArray
    state: FloatArray


class _Wanted(NamedTuple):
    """An image of a video: its time in the file, and its ``row``."""

    at_s: float
    row: int


def is_data_set(folder: Path) -> bool:
    """Whether a folder is a LeRobot data set."""
    return (folder / INFO).is_file()


# -- contents of the data set ---------------------------------------------------------------------------------


def _reading(what: Path | str) -> AbstractContextManager[None]:
    """Context manager around a decoder of ``what``: converts its exceptions to DataSetError."""
    return decoding(lambda cause: DataSetError("dataset", f"{what}: {cause}"), (DataSetError,))


def read_info(folder: Path) -> Info:
    """The content of ``meta/info.json``. Raises DataSetError."""
    path = folder / INFO
    if not is_data_set(folder):
        raise _wrong(folder, f"there is no file {INFO}; a LeRobot data set has one")
    with _reading(path):
        info = msgspec.convert(complete(json_of(path.read_bytes())), Info)
    if info.codebase_version not in VERSIONS:
        raise _wrong(
            folder,
            f"format {info.codebase_version!r}; {', '.join(VERSIONS)} are read: lerobot has converters",
        )
    if not (math.isfinite(info.fps) and info.fps > 0.0 and info.chunks_size > 0):
        raise _wrong(folder, f"fps = {info.fps}, chunks_size = {info.chunks_size}; positive numbers are needed")
    return info


def state_names(info: Info, folder: Path) -> list[str]:
    """Names of the parts of ``observation.state``; ``state0`` and so on if it has none, or if names are not unique.
    Raises DataSetError.
    """
    feature = info.features.get(STATE)
    if feature is None or len(feature.shape) != 1:
        raise _wrong(folder, f"no feature {STATE!r} of one row a frame; it has {', '.join(info.features)}")
    if not 1 <= feature.shape[0] <= MOST_STATES:
        raise _wrong(folder, f"{STATE!r} has {feature.shape[0]} parts in info.json; 1 to {MOST_STATES} are valid")
    stated = _flat(feature.names)
    if len(stated) != feature.shape[0]:
        stated = [""] * feature.shape[0]
    count = Counter(stated)
    return [name if name and count[name] == 1 else f"state{k}" for k, name in enumerate(stated)]


def _flat(names: Any, deep: int = 3) -> list[str]:
    """Names in their order: a list, lists in one, by group (``{"motors": [...]}``), or by name (``{"x": 0}``)."""
    if isinstance(names, dict) and all(type(value) is int for value in names.values()):
        return sorted(names, key=lambda name: int(names[name]))
    if isinstance(names, dict):
        names = list(names.values())
    if isinstance(names, list) and deep:
        return [name for one in names for name in _flat(one, deep - 1)]
    return [names] if isinstance(names, str) else []


def joints_of(
    states: Sequence[str], units: str | None
) -> tuple[tuple[str, ...], tuple[JointKindName, ...], FloatArray, list[int]]:
    """Names, kinds and scales (n,) of the states that are joints by ``units``, and their columns. Raises
    DataSetError.
    """
    valid = f"{', '.join(UNITS)}, with a factor (deg*0.9 of what counts from -100 to 100), or {LEFT_OUT}"
    if units is None:
        raise DataSetError(
            "units",
            f"a LeRobot data set does not say in what its states are ({', '.join(states)}): units are to be stated, "
            f"such as deg,gripper.pos=none; valid are {valid}. Those from -100 to 100 are parts of the range in the "
            "arm's calibration file",
        )
    default, by_name = "", {}
    for part in units.split(","):
        name, given, unit = part.strip().rpartition("=")
        if given and name not in states:
            raise DataSetError("units", f"units {part!r}: the states are {', '.join(states)}")
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
            raise DataSetError("units", f"units: {state} is in {unit!r}; valid are {valid}")
        names.append(state)
        kinds.append(UNITS[known][0])
        scales.append(UNITS[known][1] * float(factor or "1"))
        columns.append(column)
    if not names:
        raise DataSetError("units", f"units {units}: no state is left that is a joint")
    return tuple(names), tuple(kinds), np.array(scales), columns


def _positive(text: str) -> bool:
    try:
        return math.isfinite(float(text)) and float(text) > 0.0
    except ValueError:
        return False


def camera_features(info: Info, folder: Path, wanted: Sequence[str] | None = None) -> dict[str, str]:
    """Features of all cameras by name, or of those ``wanted`` by name or feature. The name of a camera is the part
    after ``observation.images.``; for other features, and if two of these names are equal, it is the whole feature.
    Raises DataSetError.
    """
    keys = [
        key for key, feature in info.features.items() if feature.dtype in ("video", "image") and not _of_depth(feature)
    ]
    short = [_short(key) for key in keys]
    count = Counter([*short, *keys])
    found = {name if count[name] == 1 else key: key for name, key in zip(short, keys, strict=True)}
    if wanted is None:
        return found
    chosen = {}
    for one in wanted:
        name = next((name for name, key in found.items() if one in (name, key)), None)
        if name is None:
            raise _wrong(folder, f"no camera {one!r}; the cameras are {', '.join(found) or 'none'}")
        chosen[name] = found[name]
    return chosen


def _short(key: str) -> str:
    return "image" if key == IMAGES[0] else key.removeprefix(IMAGES[1]).removeprefix(IMAGES[2])


def _of_depth(feature: Feature) -> bool:
    info = {**(feature.video_info or {}), **(feature.info or {})}
    return bool(info.get("video.is_depth_map") or info.get("is_depth_map"))


# -- tables ---------------------------------------------------------------------------------------------------


def _tables(
    folder: Path, part: str, columns: list[str], episode: int | None = None, losses: list[Loss] | None = None
) -> dict[Path, Mapping[str, Any]]:
    """Columns of all parquet files of a part of a data set, or only the rows of one ``episode``, as lists by name.
    Raises DataSetError; with ``losses``, which receives the files that cannot be read, only if none can.
    """
    from pyarrow import compute  # of a separate extra: see missing_extra

    found, episodes = {}, set()
    for path in sorted((folder / part).glob("chunk-*/*.parquet")):
        try:
            with _reading(path):
                file = _table(folder, path, columns)
                if episode is not None:
                    index = file.read(columns=["episode_index"])["episode_index"]
                    episodes |= {int(number) for number in index.unique().to_pylist() if number is not None}
                    mine = compute.equal(index, episode)
                    if compute.any(mine).as_py():
                        found[path] = file.read(columns=columns).filter(mine).to_pydict()
                elif file.metadata.num_rows:
                    found[path] = file.read(columns=columns).to_pydict()
        except DataSetError as error:
            if losses is None:
                raise
            losses.append(Loss(str(error)))
    if not found and episodes:
        raise _wrong(folder, f"no episode {episode} in {part}; it has {_listed(sorted(episodes))}")
    if not found:
        raise _wrong(
            folder, f"no {part}/chunk-*/*.parquet with rows" + "".join(f"; {loss.cause}" for loss in losses or [])[:500]
        )
    return found


def _table(folder: Path, path: Path, columns: list[str]) -> Any:
    """A parquet file that has these ``columns``, read in pieces. Raises DataSetError."""
    from pyarrow import parquet

    if not path.is_file():
        raise _wrong(folder, f"{path} is no file")
    file = parquet.ParquetFile(path)
    there = file.schema_arrow.names
    lacking = [name for name in columns if name not in there]
    if lacking:
        raise _wrong(folder, f"{path} lacks {', '.join(lacking)}; it has {', '.join(there)}")
    return file


def _listed(numbers: Sequence[int]) -> str:
    if len(numbers) <= MOST_NAMED:
        return ", ".join(map(str, numbers))
    return f"{len(numbers)} from {numbers[0]} to {numbers[-1]}"


def read_rows(folder: Path, info: Info, only: int | None = None, losses: list[Loss] | None = None) -> EpisodeRows:
    """Rows of all episodes, or of the episode ``only``. Raises DataSetError; with ``losses``, which receives what
    cannot be read, only if nothing can.
    """
    states = len(state_names(info, folder))
    needed = [STATE, "timestamp", "frame_index", "episode_index"]
    tables = _tables(folder, "data", needed, only, losses).values()
    with _reading(f"LeRobot data set {folder}: {', '.join(needed)} are to be numbers, as many in each row"):
        state, stamp, frame, episode = (
            np.concatenate([np.array(table[name], dtype=np.float64) for table in tables]) for name in needed
        )
        state = state.reshape(len(stamp), -1)
        stamp, frame, episode = (values.reshape(len(state)) for values in (stamp, frame, episode))
    if state.shape[1] != states:
        raise _wrong(folder, f"{len(stamp)} rows of {state.shape[1]} states; info.json has {states}")
    counts = np.column_stack([frame, episode])
    counted = ((counts >= 0.0) & (counts <= MOST_COUNTED) & (counts == np.floor(counts))).all(axis=1)
    good = counted & np.isfinite(state).all(axis=1) & (np.abs(stamp) <= LARGEST_STAMP_S)
    if not good.all():
        lost = (
            f"{len(good) - good.sum()} of {len(good)} rows cannot be used, the first one row {int(good.argmin())}: "
            f"finite states, stamps up to {LARGEST_STAMP_S:g} s, and whole numbers up to {MOST_COUNTED} of frame_index "
            "and episode_index are needed"
        )
        if losses is None or not good.any():
            raise _wrong(folder, lost)
        losses.append(Loss(lost))
        state, stamp, frame, episode = state[good], stamp[good], frame[good], episode[good]
    if losses is not None and only is None and info.total_episodes is not None:
        absent = sorted(set(range(min(info.total_episodes, MOST_EPISODES))) - set(episode.tolist()))
        losses += (
            [Loss(f"no rows of {len(absent)} of {info.total_episodes} episodes: {_listed(absent)}")] if absent else []
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
    return EpisodeRows(episode, frame, stamp, state[order])


# -- images ---------------------------------------------------------------------------------------------------


def pictures(
    folder: Path,
    info: Info,
    key: str,
    rows: EpisodeRows,
    every: int = 1,
    *,
    gray: bool = False,
    losses: list[Loss] | None = None,
    stamps_only: bool = False,
) -> Generator[tuple[int, Picture], None, None]:
    """Every ``every``-th row and its image of one camera, in ``gray`` if requested. Raises DataSetError; with
    ``losses``, which receives the images that are missing, only if none can be found. ``stamps_only``: those of videos
    are looked for without decoding them, and their functions must not be called.
    """
    kept = range(0, len(rows.stamp), every)

    def lose(row: int, error: DataSetError) -> None:
        if losses is None:
            raise error
        losses.append(Loss(str(error), _short(key), int(rows.episode[row]), int(rows.frame[row])))

    if info.features[key].dtype == "image":
        yield from _stored_pictures(folder, key, rows, kept, lose, gray=gray)
        return
    files: dict[Path, list[_Wanted]] = {}
    place = _video_places(folder, info, key, losses)
    for row in kept:
        try:
            path, begin_s = place(int(rows.episode[row]))
        except DataSetError as error:
            lose(row, error)
            continue
        files.setdefault(path, []).append(_Wanted(begin_s + int(rows.frame[row]) / info.fps, row))
    for path, wanted in files.items():
        period_s, wanted = 1.0 / info.fps, sorted(wanted)
        frames = _stamps(path) if stamps_only else _frames(path, wanted[0].at_s - MOST_REORDERED * period_s)
        yield from _decoded(path, wanted, rows, period_s, frames, lose, gray=gray)


def _video_places(folder: Path, info: Info, key: str, losses: list[Loss] | None) -> Callable[[int], tuple[Path, float]]:
    """Function from an episode to the video file that holds it and the time [s] at which it begins there."""
    if info.video_path is None:
        raise _wrong(folder, "info.json has no video_path")
    template = info.video_path

    def file_of(**numbers: int) -> Path:
        names = ", ".join(("video_key", *numbers))
        with _reading(f"LeRobot data set {folder}: video_path = {template[:200]!r}; its parts may be {names}"):
            return folder / template.format(video_key=key, **numbers)

    if info.codebase_version != VERSIONS[-1]:

        def own_file(episode: int) -> tuple[Path, float]:
            return file_of(episode_chunk=episode // info.chunks_size, episode_index=episode), 0.0

        return own_file
    needed = [f"videos/{key}/{part}" for part in ("chunk_index", "file_index", "from_timestamp")]
    places = {}
    for table in _tables(folder, "meta/episodes", ["episode_index", *needed], losses=losses).values():
        for episode, chunk, file, begin in zip(*(table[name] for name in ("episode_index", *needed)), strict=True):
            with _reading(f"LeRobot data set {folder}: meta/episodes, episode {episode}, {', '.join(needed)}"):
                places[int(episode)] = file_of(chunk_index=int(chunk), file_index=int(file)), float(begin)
            if not 0.0 <= float(begin) <= LARGEST_STAMP_S:
                raise _wrong(
                    folder,
                    f"meta/episodes, episode {episode}: {needed[-1]} = {begin}; valid are 0 to {LARGEST_STAMP_S:g} s",
                )

    def shared_file(episode: int) -> tuple[Path, float]:
        if episode not in places:
            raise _wrong(folder, f"meta/episodes has no episode {episode}")
        return places[episode]

    return shared_file


def _decoded(
    path: Path,
    wanted: list[_Wanted],
    rows: EpisodeRows,
    period_s: float,
    frames: Iterator[tuple[float, Any]],
    lose: Lose,
    *,
    gray: bool,
) -> Iterator[tuple[int, Picture]]:
    """Images among a video's ``frames`` at their times; ``lose`` is called for those that are missing or damaged."""
    last_s, now_s, frame = -math.inf, -math.inf, None
    broken: DataSetError | None = None
    for one in wanted:
        try:
            while now_s < one.at_s - NEAR * period_s:
                last_s, (now_s, frame) = now_s, next(frames, (math.inf, None))
        except DataSetError as error:
            broken, now_s = error, math.inf
        if now_s > one.at_s + NEAR * period_s:
            near = [f"{at_s:.3f} s" for at_s in (last_s, now_s) if math.isfinite(at_s)]
            missing = DataSetError(
                "dataset",
                f"{path}: no picture at {one.at_s:.3f} s (frame {rows.frame[one.row]} of episode "
                f"{rows.episode[one.row]}); the nearest ones: {' and '.join(near) or 'none'}. Has it been copied as a "
                "whole, and has it the data set's fps?",
            )
            lose(one.row, broken or missing)
            continue

        def take(frame: Any = frame) -> ImageArray:
            with _reading(path):
                image: ImageArray = frame.to_ndarray(format="gray" if gray else "bgr24")
                return image

        yield one.row, take


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A video's container, in which there is a video. Raises DataSetError, also for errors inside."""
    import av  # of the extra that also brings pyarrow: see missing_extra

    if not os.path.isfile(path):  # also for a name that the system does not accept
        raise DataSetError("dataset", f"{path}: no such video")
    with _reading(path), av.open(str(path)) as container:
        if not container.streams.video:
            raise DataSetError("dataset", f"{path}: holds no video")
        yield container


def _stamps(path: Path) -> Iterator[tuple[float, None]]:
    """Times [s] of a video's frames, without decoding them."""
    with _opened(path) as container:
        stream = container.streams.video[0]
        stamps = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
        yield from ((float(stamp * stream.time_base), None) for stamp in sorted(stamps))


def _frames(path: Path, from_s: float) -> Generator[tuple[float, Any], None, None]:
    """Times [s] and frames of a video, starting at the key frame at or before ``from_s``."""
    with _opened(path) as container:
        stream = container.streams.video[0]
        if from_s > 0.0:
            container.seek(math.floor(from_s / stream.time_base), stream=stream)
        for frame in container.decode(stream):
            if frame.time is None:
                raise DataSetError("dataset", f"{path}: pictures without times")
            yield frame.time, frame


def _stored_pictures(
    folder: Path, key: str, rows: EpisodeRows, kept: Sequence[int], lose: Lose, *, gray: bool
) -> Iterator[tuple[int, Picture]]:
    """Images that are stored in the tables, with at most one row group in memory."""
    places: dict[tuple[int, int], tuple[Path, int]] = {}
    for path, table in _tables(folder, "data", ["episode_index", "frame_index"], losses=[]).items():  # as of the rows
        with _reading(path):
            numbered = enumerate(zip(table["episode_index"], table["frame_index"], strict=True))
            places |= {(int(episode), int(frame)): (path, k) for k, (episode, frame) in numbered}
    numbers = list(zip(rows.episode.tolist(), rows.frame.tolist(), strict=True))
    cells: Iterator[Any] = iter(())
    current, following = Path(), 0
    for row in kept:
        path, position = places[numbers[row]]
        episode, frame = numbers[row]
        at = f"{key}: no picture that OpenCV reads at frame {frame} of episode {episode}"
        try:
            if path != current or position < following:
                cells, following = _cells(folder, path, key, position)
                current = path
            stored = next(islice(cells, position - following, None), None)
            following = position + 1
        except DataSetError as error:
            lose(row, error)
            current = Path()
            continue

        def take(picture: Any = stored, at: str = at) -> ImageArray:
            image = None
            with _reading(f"LeRobot data set {folder}: {at}"):
                data = np.frombuffer((picture or {}).get("bytes") or b"", dtype=np.uint8)
                image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR)
            if image is None:
                raise _wrong(folder, at)
            return np.asarray(image)

        yield row, take


def _cells(folder: Path, path: Path, key: str, position: int) -> tuple[Iterator[Any], int]:
    """Cells of a column from the row group that contains the row ``position`` on, and the position of the first
    cell.
    """
    with _reading(path):
        file = _table(folder, path, [key])
        first = begin = 0
        while begin + file.metadata.row_group(first).num_rows <= position:
            begin += file.metadata.row_group(first).num_rows
            first += 1

    def cells() -> Iterator[Any]:
        with _reading(path):
            for group in range(first, file.num_row_groups):  # if read together, all would stay in memory to the end
                for batch in file.iter_batches(CELLS, row_groups=[group], columns=[key]):
                    yield from batch.column(0).to_pylist()

    return cells(), begin


def _wrong(folder: Path, what: str) -> DataSetError:
    return DataSetError("dataset", f"LeRobot data set {folder}: {what}")
