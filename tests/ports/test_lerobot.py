"""What is read of LeRobot data sets: names, cameras, and each row's own picture, whatever lies before it."""

from __future__ import annotations

import re
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from lerobot_sets import (
    FPS,
    LEROBOT_PYTHONS,
    Episode,
    read_by_lerobot,
    write,
    write_by_lerobot,
    write_in_av1,
    write_video,
)
from stereoservo.ports import lerobot
from stereoservo.ports.lerobot import DataSetError, EpisodeRows, Feature, Info

UP = "observation.images.up"
WIDTH, HEIGHT, LEVELS = 64, 48, 3
"""Size of pictures, and the step of their gray level from one to the next."""


def numbered(*counts: int) -> list[Episode]:
    """Episodes of so many frames, counted through: each picture's level tells its number, as its joints do."""
    episodes, begin = [], 0
    for count in counts:
        k = np.arange(begin, begin + count)
        levels = (LEVELS * (k + 1)).astype(np.uint8)[None, :, None, None]
        pictures = np.broadcast_to(levels, (2, count, HEIGHT, WIDTH)).copy()
        episodes.append(Episode(np.column_stack([0.01 * k, -0.02 * k]), pictures, np.zeros((2, count, 0, 2))))
        begin += count
    return episodes


def numbers(folder: Path, only: int | None = None, key: str = UP) -> list[int]:
    """Numbers that the pictures show, in the order in which they come."""
    info = lerobot.read_info(folder)
    rows = lerobot.read_rows(folder, info, only)
    return [
        round(float(take().mean()) / LEVELS) - 1 for _, take in lerobot.pictures(folder, info, key, rows, gray=True)
    ]


@pytest.mark.parametrize(
    ("names", "read"),
    [
        (["a", "b", "c"], ["a", "b", "c"]),
        ({"motors": ["a", "b", "c"]}, ["a", "b", "c"]),
        ([["a", "b", "c"]], ["a", "b", "c"]),  # unitree_lerobot's and openpi's converters
        ({"arm": ["a", "b"], "hand": ["c"]}, ["a", "b", "c"]),
        ({"b": 1, "a": 0, "c": 2}, ["a", "b", "c"]),  # as lerobot names the parts of an end effector's action
        (
            ["x", "grip", "grip"],
            ["x", "state1", "state2"],
        ),  # two joints of one name were two columns of one joint
        (["dim"], ["state0", "state1", "state2"]),
        (None, ["state0", "state1", "state2"]),
        (["a", None, "c"], ["state0", "state1", "state2"]),
    ],
)
def test_names_of_states_are_read_as_converters_write_them(names: Any, read: list[str]) -> None:
    info = Info("v3.0", 30.0, {"observation.state": Feature("float32", [3], names)})
    assert lerobot.state_names(info, Path("set")) == read


def test_each_feature_of_pictures_is_a_camera_but_maps_of_depth() -> None:
    """lerobot calls every feature of dtype ``video`` or ``image`` a camera, and looks for depth in three places."""
    picture = Feature("video", [48, 64, 3])
    info = Info(
        "v2.1",
        10.0,
        {
            "exterior_image_1_left": picture,
            "observation.images.top": picture,
            "observation.image": Feature("image", [48, 64, 3]),
            "observation.images.a": Feature("video", [48, 64, 1], info={"is_depth_map": True}),
            "observation.images.b": Feature("video", [48, 64, 1], info={"video.is_depth_map": True}),
            "observation.images.c": Feature("video", [48, 64, 1], video_info={"video.is_depth_map": True}),
            "observation.state": Feature("float32", [3]),
        },
    )
    names = {
        "exterior_image_1_left": "exterior_image_1_left",
        "top": "observation.images.top",
        "image": "observation.image",
    }
    assert lerobot.camera_features(info, Path("set")) == names


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_picture_is_found_by_its_time_in_the_video(version: str, tmp_path: Path) -> None:
    """A video of twice the data set's rate gave every row of the later half another row's picture."""
    episodes = numbered(7, 6)
    folder = write(tmp_path / "set", version, episodes)
    for path in sorted((folder / "videos").glob("**/*.mp4")):
        one = [np.concatenate([e.pictures[0] for e in episodes])] if version == "v3.0" else []
        one = one or [e.pictures[0] for k, e in enumerate(episodes) if path.stem == f"episode_{k:06d}"]
        between = np.zeros_like(one[0])
        write_video(path, np.stack([one[0], between], axis=1).reshape(-1, HEIGHT, WIDTH), 2.0 * FPS)
    assert numbers(folder) == list(range(13))
    assert numbers(folder, 1) == list(range(7, 13))


def test_a_video_of_another_rate_is_refused(tmp_path: Path) -> None:
    """Frame by frame it would have been read as if it were the data set's."""
    folder = write(tmp_path / "set", "v2.1", numbered(9))
    path = folder / f"videos/chunk-000/{UP}/episode_000000.mp4"
    write_video(path, numbered(9)[0].pictures[0], 0.8 * FPS)
    said = "no picture at 0.200 s (frame 2 of episode 0); the nearest ones: 0.125 s and 0.250 s"
    with pytest.raises(DataSetError, match=re.escape(said)):
        numbers(folder)


def test_an_episode_is_found_without_decoding_those_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Format 3.0 has up to 200 MB of episodes in one video: the last one began after minutes, at each repetition."""
    folder = write(tmp_path / "set", "v3.0", numbered(60, 5))
    write_in_av1(folder, numbered(60, 5))
    decoded: list[float] = []
    frames = lerobot._frames

    def counted(path: Path, from_s: float) -> Iterator[tuple[float, Any]]:
        for at_s, frame in frames(path, from_s):
            decoded.append(at_s)
            yield at_s, frame

    monkeypatch.setattr(lerobot, "_frames", counted)
    assert numbers(folder, 1) == list(range(60, 65))
    assert len(decoded) <= lerobot.MOST_REORDERED + 2 + 5  # from a key frame on; each second one is one
    assert numbers(folder, 0) == list(range(60))


def noise(count: int) -> tuple[list[Episode], int]:
    """An episode of pictures that do not compress, and their size in memory."""
    rng = np.random.default_rng(11)
    pictures = rng.integers(0, 256, (2, count, 120, 160), dtype=np.uint8)
    return [Episode(np.zeros((count, 2)), pictures, np.zeros((2, count, 0, 2)))], pictures[0].nbytes


def test_pictures_in_tables_are_read_by_groups_of_rows(tmp_path: Path) -> None:
    """All of a data set's were in memory before the first one was looked at; lerobot writes an episode as a group."""
    count = 300
    episodes, size = noise(count)
    folder = write(tmp_path / "set", "v3.0", episodes, "image")
    path = folder / "data/chunk-000/file-000.parquet"
    parquet.write_table(parquet.read_table(path), path, row_group_size=10)
    info = lerobot.read_info(folder)
    rows = lerobot.read_rows(folder, info)
    tracemalloc.start()
    try:
        before, held = pa.total_allocated_bytes(), []
        for row, take in lerobot.pictures(folder, info, UP, rows, gray=True):
            assert np.array_equal(take(), episodes[0].pictures[0, row])
            held.append(tracemalloc.get_traced_memory()[0] + pa.total_allocated_bytes() - before)
    finally:
        tracemalloc.stop()
    assert len(held) == count
    assert max(held) < size / 3


@pytest.mark.parametrize("group", [4, 1000])
def test_rows_of_a_table_may_be_in_any_order(group: int, tmp_path: Path) -> None:
    folder = write(tmp_path / "set", "v3.0", numbered(7, 6), "image")
    path = folder / "data/chunk-000/file-000.parquet"
    shuffled = np.random.default_rng(2).permutation(13)
    parquet.write_table(parquet.read_table(path).take(shuffled), path, row_group_size=group)
    assert numbers(folder) == list(range(13))
    assert numbers(folder, 1) == list(range(7, 13))


# -- by LeRobot's own writer, beside its own reader -----------------------------------------------------------


def equal_to_lerobots(folder: Path, rows: EpisodeRows, theirs: dict[str, np.ndarray]) -> None:
    """Each row's stamp, numbers, state and pictures are those that LeRobot returns for it."""
    mine = np.flatnonzero(np.isin(theirs["episode_index"].ravel(), rows.episode))
    for name, ours in (
        ("timestamp", rows.stamp),
        ("frame_index", rows.frame),
        ("episode_index", rows.episode),
    ):
        assert np.array_equal(theirs[name].ravel()[mine], ours)
    assert np.array_equal(theirs["observation.state"][mine], rows.state)
    info = lerobot.read_info(folder)
    for key in lerobot.camera_features(info, folder).values():
        seen = 0
        for row, take in lerobot.pictures(folder, info, key, rows):
            assert np.abs(np.moveaxis(theirs[key][mine[row]], 0, -1) - take()[..., ::-1] / 255.0).max() < 1e-6
            seen += 1
        assert seen == len(mine)


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        ("video", {}),
        ("video", {"files_mb": 0.01, "options": {"streaming_encoding": True}}),  # several chunks and files
        ("video", {"options": {"vcodec": "h264"}}),
        ("image", {"files_mb": 0.01}),
    ],
)
@pytest.mark.parametrize("python", LEROBOT_PYTHONS)
def test_rows_are_those_that_lerobots_reader_returns(
    python: str, kind: str, more: dict[str, Any], tmp_path: Path
) -> None:
    episodes = numbered(33, 2, 25, 20)
    folder = write_by_lerobot(python, tmp_path / "set", episodes, kind, 30, **more)
    theirs = read_by_lerobot(python, folder)
    info = lerobot.read_info(folder)
    equal_to_lerobots(folder, lerobot.read_rows(folder, info), theirs)
    for number in range(4):
        equal_to_lerobots(folder, lerobot.read_rows(folder, info, number), theirs)
