"""``examine`` of LeRobot data sets: pictures rendered of tags that an arm carries, written as formats 2.1 and 3.0 lay
them out, read back and judged.
"""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pyarrow import parquet

from lerobot_sets import (
    CAMERAS,
    FPS,
    LEROBOT_PYTHONS,
    UNITS,
    Episode,
    changed,
    rewritten,
    write,
    write_by_lerobot,
    write_in_av1,
    write_video,
)
from stereoservo.cli.examine import read_data_set
from stereoservo.cli.main import invoke
from stereoservo.cli.output import CommandError
from stereoservo.ports.lerobot import DataSetError, Feature, Info, camera_features
from stereoservo_sim.world.random_cells import random_case
from stereoservo_sim.world.synthetic import rotation

SEED, CELLS_PX = 5, 24
TAGS = (1, 2, 3)
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
BUMPED_FROM = 20
"""Frame of the second episode from which the camera ``side`` is turned."""


def tagged_cell():
    """A random cell whose body is three tags on tilted planes that face the cameras."""
    cell = random_case(SEED).cell
    flange = cell.frames(cell.home)[-1]
    centres = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in cell.poses])
    middle = flange[:3, :3].T @ (centres.mean(axis=0) - flange[:3, 3])
    z = middle / np.linalg.norm(middle)
    x = np.cross([0.3, 0.9, 0.2], z)
    x /= np.linalg.norm(x)
    facing = np.column_stack([x, np.cross(z, x), z])
    side = 70.0 * np.linalg.norm(middle) / float(cell.intrinsics[0, 0, 0])
    square = 0.5 * side * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    body = []
    for k, turn in enumerate((rotation("x", 12.0), rotation("y", 12.0), rotation("y", -12.0))):
        at = 1.2 * side * np.array([np.cos(2.1 * k), np.sin(2.1 * k), 0.3 * k])
        body.append((square @ turn[:3, :3].T + at) @ facing.T)
    return cell.with_body(np.vstack(body))


def picture(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A picture (h, w) of tags at their corners (m, 2), drawn at twice the size."""
    width, height = size
    image = np.full((2 * height, 2 * width), 170, dtype=np.uint8)
    for k, tag in enumerate(TAGS):
        drawn = cv2.aruco.generateImageMarker(DICTIONARY, tag, 6 * CELLS_PX)
        paper = cv2.copyMakeBorder(drawn, *(4 * [CELLS_PX]), cv2.BORDER_CONSTANT, value=255)
        begin, end = CELLS_PX - 0.5, 7 * CELLS_PX - 0.5
        source = np.array([[begin, begin], [end, begin], [end, end], [begin, end]], dtype=np.float32)
        target = (2.0 * corners[4 * k : 4 * k + 4] + 0.5).astype(np.float32)
        H = cv2.getPerspectiveTransform(source, target)
        cv2.warpPerspective(paper, H, image.shape[::-1], image, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    return cv2.resize(cv2.GaussianBlur(image, (3, 3), 0.6), size, interpolation=cv2.INTER_AREA)


def episode(cell, joints: np.ndarray, bumped_from: int | None = None) -> Episode:
    corners = cell.pixels(joints)
    if bumped_from is not None:
        poses = cell.poses.copy()
        poses[1] = rotation("y", 0.5) @ rotation("x", 0.3) @ poses[1]
        corners[1, bumped_from:] = replace(cell, poses=poses).pixels(joints[bumped_from:])[1]
    size = cell.width, cell.height
    return Episode(joints, np.array([[picture(one, size) for one in camera] for camera in corners]), corners)


@cache
def short() -> list[Episode]:
    cell = tagged_cell()
    rng = np.random.default_rng(7)
    return [episode(cell, cell.held_out(rng, count, 0.3)) for count in (4, 3)]


def work(cell, t: np.ndarray) -> np.ndarray:
    """Joints at times, in motion from the first one on."""
    phases = t[:, None] * np.linspace(0.6, 1.5, len(cell.home)) + np.arange(len(cell.home))
    return cell.home + 0.5 * cell.ranges * np.sin(phases)


def whole() -> list[Episode]:
    """Motions of single joints, then work, in which a camera is moved."""
    cell = tagged_cell()
    return [episode(cell, cell.stops(9)[0]), episode(cell, work(cell, np.arange(60) / FPS), BUMPED_FROM)]


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    code = invoke(["examine", *arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(("version", "kind"), [("v2.1", "video"), ("v3.0", "video"), ("v3.0", "image")])
def test_joints_and_pictures_of_every_episode_are_read(version: str, kind: str, tmp_path: Path) -> None:
    episodes = short()
    views = read_data_set(write(tmp_path / "set", version, episodes, kind), UNITS)
    assert views.joint_names == tuple(f"joint{k}.pos" for k in range(views.positions.shape[1]))
    assert [camera.name for camera in views.cameras] == list(CAMERAS)
    assert views.counted
    for number, one in enumerate(episodes):
        for c in range(2):
            mine = (views.episodes == number) & (views.camera == c)
            assert np.abs(views.at(views.times[mine]) - one.joints).max() < 1e-6
            assert views.seen[mine].mean() > 0.7  # tags that are aslant are not found
            assert np.nanmax(np.abs(views.pixels[mine] - one.corners[c])) < 0.3
    # Between two episodes the arm goes on as one ends, then comes as the next one begins: a frame's time each.
    last, first = views.times[views.episodes == 0].max(), views.times[views.episodes == 1].min()
    gone_on = 2.0 * episodes[0].joints[-1] - episodes[0].joints[-2]
    came = 2.0 * episodes[1].joints[0] - episodes[1].joints[1]
    assert np.abs(views.at(np.array([last + 0.1, first - 0.1])) - [gone_on, came]).max() < 1e-6


def test_a_data_set_is_judged_by_episode(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write(tmp_path / "set", "v3.0", whole())
    code, report = told(capsys, str(folder), "--units", UNITS)
    assert code == 0
    (cause,) = report["causes"]
    assert (cause["kind"], cause["subject"], cause["episodes"]) == ("camera_moved", "side", [1])
    assert cause["onset"]["episode"] == 1
    assert abs(cause["onset"]["in_episode"] - BUMPED_FROM) <= 2
    assert report["cameras"]["up"]["dropped"] is None  # stamps that are counted tell of no drops
    assert report["rms_px"] < 0.3
    assert invoke(["examine", str(folder), "--units", UNITS]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("  episode 0: ") and "nothing has happened" in line for line in lines)
    assert any(line.startswith("  episode 1: ") and "camera_moved side" in line for line in lines)


@pytest.mark.parametrize("python", LEROBOT_PYTHONS)
def test_a_data_set_that_lerobot_wrote_is_judged(
    python: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_by_lerobot(python, tmp_path / "set", whole())
    code, report = told(capsys, str(folder), "--units", UNITS)
    assert code == 0
    (cause,) = report["causes"]
    assert (cause["kind"], cause["subject"], cause["episodes"]) == ("camera_moved", "side", [1])
    assert abs(cause["onset"]["in_episode"] - BUMPED_FROM) <= 2
    assert report["rms_px"] < 0.05  # in AV1; 0.02 px of pictures in tables


def test_late_pictures_are_told_where_an_episode_begins_in_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Joints that stood before an episode made its first late picture a second cause, ``unexplained``."""
    cell, t, late_s = tagged_cell(), np.arange(30) / FPS, 0.06
    learning, now = episode(cell, cell.stops(9)[0]), episode(cell, work(cell, t))
    now.pictures[1] = episode(cell, work(cell, t - late_s)).pictures[1]
    folder = write(tmp_path / "set", "v3.0", [learning, now])
    code, report = told(capsys, str(folder), "--units", UNITS)
    assert code == 0
    (cause,) = report["causes"]
    assert (cause["kind"], cause["subject"], cause["episodes"]) == ("late_stamps", "side", [1])
    assert abs(abs(cause["value"]) - late_s) < 2e-3


def test_pictures_in_lerobots_own_codec_are_read(tmp_path: Path) -> None:
    """AV1, as lerobot encodes by default."""
    pytest.importorskip("av")
    folder = write(tmp_path / "set", "v3.0", short())
    write_in_av1(folder, short())
    views = read_data_set(folder, UNITS)
    for c in range(2):
        truth = np.concatenate([one.corners[c] for one in short()])
        assert np.nanmax(np.abs(views.pixels[views.camera == c] - truth)) < 0.5


@pytest.mark.parametrize(
    ("arguments", "damage", "named"),
    [
        ([], None, "does not say in what its states are (joint0.pos,"),
        (["--units", "turns"], None, "joint0.pos is in 'turns'; valid are rad, deg, m, mm"),
        (["--units", "deg*zero"], None, "joint0.pos is in 'deg*zero'"),
        (["--units", "deg,hand=none"], None, "'hand=none': the states are joint0.pos"),
        (["--units", "none"], None, "no state is left"),
        (["--units", UNITS, "--cameras", "wrist"], None, "the cameras are up, side"),
        (["--units", UNITS], lambda f: rewritten(f, codebase_version="v1.6"), "v2.0, v2.1, v3.0 are read"),
        (["--units", UNITS], lambda f: rewritten(f, fps=0), "fps = 0"),
        (["--units", UNITS], lambda f: rewritten(f, chunks_size=0), "chunks_size = 0"),
        (["--units", UNITS], lambda f: rewritten(f, video_path="{where}.mp4"), "its parts may be video_key, episode_"),
        (["--units", UNITS], lambda f: rewritten(f, features={}), "no feature 'observation.state'"),
        (["--units", UNITS], lambda f: (f / "meta/info.json").write_text("{"), "info.json"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_with_what_would_be_right(
    arguments: list[str], damage: Any, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "set", "v2.1", short())
    if damage is not None:
        damage(folder)
    code, answer = told(capsys, str(folder), *arguments)
    assert code == 1
    assert answer["error"]["code"] in ("dataset", "units")
    assert named in answer["error"]["message"]


def without_rows(folder: Path) -> None:
    for path in (folder / "data").glob("chunk-*/*.parquet"):
        parquet.write_table(parquet.read_table(path).slice(0, 0), path)


UP = "observation.images.up"


@pytest.mark.parametrize(
    ("kind", "damage", "named"),
    [
        ("video", lambda f: (f / "meta/info.json").write_text('{"features":' + "[" * 100_000), "info.json"),
        ("video", lambda f: (f / "meta/info.json").write_bytes(b'{"codebase_version":"\xff"}'), "required field"),
        ("video", lambda f: rewritten(f, video_path="{video_key.x}"), "its parts may be video_key"),
        ("video", lambda f: rewritten(f, video_path="{chunk_index[0]}"), "its parts may be video_key"),
        ("video", lambda f: rewritten(f, video_path="a" * 5000), "no such video"),
        ("video", without_rows, "parquet with rows"),
        ("video", lambda f: changed(f, "data", "timestamp", [{"s": 1}] * 7), "timestamp"),
        ("video", lambda f: changed(f, "data", "frame_index", [None] * 7), "frame_index"),
        ("video", lambda f: changed(f, "data", "frame_index", [0] * 7), "is there twice"),
        ("video", lambda f: changed(f, "data", "timestamp", [0.1 * k for k in range(7, 0, -1)]), "stamped before"),
        ("video", lambda f: changed(f, "meta/episodes", f"videos/{UP}/chunk_index", [None, 0]), "episode 0"),
        ("video", lambda f: changed(f, "meta/episodes", f"videos/{UP}/from_timestamp", [0.0, np.nan]), "episode 1"),
        ("video", lambda f: changed(f, "meta/episodes", "episode_index", [0, None]), "episode None"),
        ("image", lambda f: changed(f, "data", "frame_index", [[k % 4] for k in range(7)]), "file-000.parquet"),
    ],
)  # fmt: skip
def test_tables_that_lie_are_refused_by_name(kind: str, damage: Any, named: str, tmp_path: Path) -> None:
    folder = write(tmp_path / "set", "v3.0", short(), kind)
    damage(folder)
    with pytest.raises(CommandError, match=re.escape(named)):
        read_data_set(folder, UNITS)


def cut(path: Path, share: float) -> None:
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


VIDEO_UP = "videos/chunk-000/observation.images.up/episode_000000.mp4"


@pytest.mark.parametrize(
    ("version", "kind", "damage", "frames", "noted"),
    [
        ("v2.1", "video", lambda f: write_video(f / VIDEO_UP, short()[0].pictures[0, :3]), (6, 7),
         "lost: episode 0, frame 3, camera up: .*no picture at 0.300 s"),
        ("v2.1", "video", lambda f: (f / VIDEO_UP).unlink(), (3, 7),
         "lost: episode 0, frames 0 to 3, camera up: .*no such video"),
        ("v2.0", "video", lambda f: (f / VIDEO_UP).write_bytes(b"no video"), (3, 7),
         "lost: episode 0, frames 0 to 3, camera up: .*Invalid data found"),
        ("v2.1", "video", lambda f: cut(f / VIDEO_UP, 0.5), (3, 7), "lost: episode 0, frames 0 to 3, camera up: "),
        ("v2.1", "video", lambda f: cut(f / "data/chunk-000/episode_000001.parquet", 0.7), (4, 4),
         "episode_000001.parquet: .*no rows of 1 of 2 episodes: 1"),
        ("v2.1", "image", lambda f: (f / "data/chunk-000/episode_000000.parquet").unlink(), (3, 3),
         "no rows of 1 of 2 episodes: 0"),
        ("v3.0", "video", lambda f: changed(f, "meta/episodes", "episode_index", [5, 1]), (3, 3),
         "lost: episode 0, frames 0 to 3, camera up: .*meta/episodes has no episode 0"),
        ("v3.0", "image", lambda f: changed(f, "data", UP, [{"bytes": b""}, *6 * [None]]), (0, 7),
         "lost: episode 0, frames 0 to 3, camera up: .*no picture that OpenCV reads at frame 0"),
        ("v3.0", "image", lambda f: changed(f, "data", "timestamp", [0.0, np.nan, 0.2, 0.3, 0.0, 0.1, 0.2]), (6, 6),
         "1 of 7 rows cannot be used, the first one row 1"),
    ],
)  # fmt: skip
def test_what_is_lost_is_noted_and_the_rest_is_read(
    version: str, kind: str, damage: Any, frames: tuple[int, int], noted: str, tmp_path: Path
) -> None:
    folder = write(tmp_path / "set", version, short(), kind)
    damage(folder)
    views = read_data_set(folder, UNITS)
    by_name = {camera.name: int((views.camera == c).sum()) for c, camera in enumerate(views.cameras)}
    assert (by_name.get("up", 0), by_name["side"]) == frames
    assert re.search(noted, " ".join(views.notes))


def test_what_is_lost_is_told_where_nothing_can_be_learnt(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write(tmp_path / "set", "v2.1", short())
    write_video(folder / VIDEO_UP, short()[0].pictures[0, :3])
    code, answer = told(capsys, str(folder), "--units", UNITS)
    assert (code, answer["error"]["code"]) == (1, "too_few_stops")
    assert answer["error"]["notes"][0].startswith("lost: episode 0, frame 3, camera up: ")


def test_a_camera_that_sees_no_marker_is_left_out(tmp_path: Path) -> None:
    """A third camera without markers left the other two without a model, and nothing was examined."""
    folder = write(tmp_path / "set", "v3.0", short(), "image")
    info = json.loads((folder / "meta/info.json").read_text())
    rewritten(folder, features=info["features"] | {"front": info["features"][UP]})
    _, count, height, width = np.concatenate([one.pictures for one in short()], axis=1).shape
    blank = cv2.imencode(".png", np.full((height, width), 90, np.uint8))[1].tobytes()
    changed(folder, "data", "front", [{"bytes": blank, "path": None}] * count)
    views = read_data_set(folder, UNITS)
    assert [camera.name for camera in views.cameras] == list(CAMERAS)
    assert "camera front shows a marker in none of its 7 pictures" in views.notes[0]
    with pytest.raises(CommandError, match="no camera shows a marker"):
        read_data_set(folder, UNITS, "front")


def test_units_of_a_data_set_are_refused_for_other_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, answer = told(capsys, str(tmp_path), "--units", "deg")
    assert code == 1
    assert "are for LeRobot data sets" in answer["error"]["message"]


def test_two_features_of_one_name_are_two_cameras() -> None:
    """``observation.image.up`` and ``observation.images.up`` of one set were one."""
    picture = Feature("video", [48, 64, 3])
    keys = ["observation.image.up", "observation.images.up", "observation.images.side", "observation.image"]
    info = Info("v2.1", 10.0, dict.fromkeys(keys, picture))
    names = {keys[0]: keys[0], keys[1]: keys[1], "side": keys[2], "image": keys[3]}
    assert camera_features(info, Path("set")) == names
    assert camera_features(info, Path("set"), ["side", keys[1]]) == {"side": keys[2], keys[1]: keys[1]}
    with pytest.raises(DataSetError, match=r"no camera 'up'; the cameras are observation\.image\.up, observation"):
        camera_features(info, Path("set"), ["up"])
