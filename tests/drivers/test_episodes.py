"""Episodes of LeRobot data sets as cameras and joints: at one time in all, and refused where they are not whole."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_sets import CAMERAS, FPS, UNITS, Episode, changed, rewritten, write, write_in_av1
from stereoservo.daemon.cell_preparation import make_plan
from stereoservo.daemon.ipc_messages import PlanOptions
from stereoservo.ports.clock import VirtualClock
from stereoservo.ports.devices import CameraDriver, DriverContext, DriverError
from stereoservo_drivers.contracts import CameraDriverContract
from stereoservo_drivers.episodes import EpisodeJointDriver
from stereoservo_drivers.video.driver import VideoCameraDriver

WIDTH, HEIGHT, LEVELS = 64, 48, 18
UP = "observation.images.up"
LOOPED = {"source": "set", "episode": 1, "width": WIDTH, "height": HEIGHT, "rate_hz": FPS, "loop": True}
JOINTS = {"dataset": "set", "episode": 1, "units": UNITS}


@cache
def episodes() -> list[Episode]:
    """Two episodes of 9 and 12 frames, whose pictures have the level ``LEVELS`` times one more than their number."""
    found = []
    for number, count in enumerate((9, 12)):
        k = np.arange(count)
        joints = np.column_stack([np.sin(0.7 * k + number), 0.1 * k - number])
        levels = (LEVELS * (k + 1)).astype(np.uint8)[None, :, None, None]
        found.append(
            Episode(joints, np.broadcast_to(levels, (2, count, HEIGHT, WIDTH)).copy(), np.zeros((2, count, 0, 2)))
        )
    return found


def context(folder: Path, clock: VirtualClock, camera: str = "", arm: dict[str, Any] | None = None) -> DriverContext:
    return DriverContext(clock, "t", folder, folder, camera, arm=arm or {})


def begun(folder: Path, clock: VirtualClock, camera: str, **options: Any) -> VideoCameraDriver:
    driver = VideoCameraDriver(LOOPED | options, context(folder, clock, camera))
    driver.configure()
    driver.activate()
    return driver


def number_of(image: np.ndarray) -> int:
    return round(float(image.mean()) / LEVELS) - 1


class TestEpisode(CameraDriverContract):
    camera_name = "up"

    def make_driver(self, context: DriverContext) -> CameraDriver:
        if not (context.cell_dir / "set").exists():
            write(context.cell_dir / "set", "v3.0", episodes())
        return VideoCameraDriver(LOOPED, context)


@pytest.mark.parametrize(("version", "kind"), [("v2.1", "video"), ("v3.0", "video"), ("v3.0", "image")])
def test_cameras_and_joints_are_at_one_time_in_the_episode(version: str, kind: str, tmp_path: Path) -> None:
    write(tmp_path / "set", version, episodes(), kind)
    joints, count = episodes()[1].joints, len(episodes()[1].joints)
    period_s = float(np.float32((count - 1) / FPS)) + 1 / FPS  # stamps are float32
    clock = VirtualClock(5_430_000_000)  # within the fifth time that the episode of 1.2 s is played
    arm = EpisodeJointDriver(JOINTS, context(tmp_path, clock))
    arm.configure()
    cameras = {"up": begun(tmp_path, clock, "up"), "side": begun(tmp_path, clock, "left", feature="side")}
    seen: dict[str, list[int]] = {name: [] for name in cameras}
    for step in range(300):
        at = clock.now_ns() * 1e-9 % period_s * FPS
        state = arm.read_state()
        if at <= count - 1:
            truth = [np.interp(at, np.arange(count), column) for column in joints.T]
        else:
            truth = joints[-1]
        assert np.abs(state.positions - truth).max() < 1e-5
        for name, camera in cameras.items():
            for frame in camera.poll():
                seen[name].append(number_of(frame.image))
                assert abs(frame.t_shutter_ns * 1e-9 % period_s * FPS - seen[name][-1]) < 1e-5
                assert 0 <= clock.now_ns() - frame.t_received_ns < 10_000_000
        if step == 150:  # after a restart it is where the others are
            cameras["side"].close()
            cameras["side"] = begun(tmp_path, clock, "side")
        clock.sleep(0.01)
    begin = 7  # 5.43 s is 0.63 s after the begin at 4.8 s
    assert seen["up"] == [(begin + k) % count for k in range(30)]
    assert seen["side"] == seen["up"]
    assert cameras["up"].statistics().dropped == 0


def test_joints_take_no_commands(tmp_path: Path) -> None:
    write(tmp_path / "set", "v2.1", episodes())
    arm = EpisodeJointDriver(JOINTS, context(tmp_path, VirtualClock()))
    described = arm.describe()
    assert [joint.name for joint in described.joints] == ["joint0.pos", "joint1.pos"]
    for joint, column in zip(described.joints, episodes()[1].joints.T, strict=True):
        assert joint.position_min < column.min() < column.max() < joint.position_max
        assert joint.velocity_max >= FPS * np.abs(np.diff(column)).max() - 1e-5
    arm.configure()
    for call in (arm.activate, lambda: arm.write_velocity(np.zeros(2))):
        with pytest.raises(DriverError, match="take no commands"):
            call()
    arm.stop()
    arm.deactivate()
    arm.configure()
    arm.read_state()
    arm.close()
    with pytest.raises(DriverError, match="closed"):
        arm.read_state()


def test_an_episode_without_loop_ends(tmp_path: Path) -> None:
    write(tmp_path / "set", "v3.0", episodes())
    driver = begun(tmp_path, VirtualClock(), "up", episode=0, loop=False, pace="every")
    assert [number_of(frame.image) for _ in range(9) for frame in driver.poll()] == list(range(9))
    with pytest.raises(DriverError, match="the recording is over"):
        driver.poll()


@pytest.mark.parametrize("channel", ["gray", "red"])
def test_videos_in_lerobots_own_codec_are_played(channel: str, tmp_path: Path) -> None:
    pytest.importorskip("av")
    folder = write(tmp_path / "set", "v3.0", episodes())
    write_in_av1(folder, episodes())
    driver = begun(tmp_path, VirtualClock(), "up", pace="every", loop=False, channel=channel)
    assert [number_of(frame.image) for _ in range(12) for frame in driver.poll()] == list(range(12))
    driver.close()
    path = folder / f"videos/{UP}/chunk-000/file-000.mp4"
    whole = path.read_bytes()
    for kept in (len(whole) // 2, len(whole) - 400):  # no header; fewer pictures, or none
        path.write_bytes(whole[:kept])
        with pytest.raises(DriverError, match=r"file-000\.mp4"):
            play(begun(tmp_path, VirtualClock(), "up", pace="every", loop=False))


@pytest.mark.parametrize(
    ("options", "arm", "named"),
    [
        ({"episode": 7}, None, "no episode 7 in data; it has 0, 1"),
        ({"feature": "wrist"}, None, "no camera 'wrist'; the cameras are up, side"),
        ({"rate_hz": 30.0}, None, "rate_hz = 30.0; the data set has 10.0 frames a second"),
        ({"width": 640}, None, "its pictures are 64x48 px"),
        ({"source": "other"}, None, "there is no file meta/info.json"),
        ({"source": "rtsp://host/set"}, None, "episode = 1; is for the folder of a LeRobot data set"),
        ({"start": 3}, None, "start = 3; an episode is played from its beginning"),
        ({"episode": -1}, None, "episode = -1; valid: an integer"),
        ({"episode": None, "source": "a.avi", "feature": "up"}, None, "feature = \"up\"; is for LeRobot data sets"),
        ({"episode": None}, None, "with `episode`, the folder of a LeRobot data set"),
        ({"episode": 0}, JOINTS, "the joints are of episode 1 of set"),
        ({"loop": False}, JOINTS, "loop = true and pace = \"recorded\""),
        ({"pace": "every"}, JOINTS, "loop = true and pace = \"recorded\""),
    ],
)  # fmt: skip
def test_options_of_a_camera_that_name_nothing_are_refused(
    options: dict[str, Any], arm: dict[str, Any] | None, named: str, tmp_path: Path
) -> None:
    write(tmp_path / "set", "v2.1", episodes())
    with pytest.raises(DriverError, match=re.escape(named)):
        VideoCameraDriver(LOOPED | options, context(tmp_path, VirtualClock(), "up", arm)).configure()


TABLES, STATE = "data/chunk-000/episode_000001.parquet", "observation.state"


def pictures_alone(beside: dict[str, Any]) -> dict[str, Any]:
    """Features of a set with nothing but its pictures and what is ``beside`` them."""
    shape = {"dtype": "video", "shape": [HEIGHT, WIDTH, 3], "names": None}
    return {f"observation.images.{name}": shape for name in CAMERAS} | beside


def many(count: int) -> dict[str, Any]:
    """A feature of so many states."""
    return {"dtype": "float32", "shape": [count], "names": None}


@pytest.mark.parametrize(
    ("version", "damage", "named"),
    [
        ("v2.1", lambda f: (f / "meta/info.json").write_text("{"), "info.json"),
        ("v2.1", lambda f: rewritten(f, fps=1e-300), "can be played back"),
        ("v2.1", lambda f: rewritten(f, codebase_version="v1.6"), "v2.0, v2.1, v3.0 are read"),
        ("v2.1", lambda f: rewritten(f, features=pictures_alone({})), "no feature 'observation.state'"),
        ("v3.0", lambda f: rewritten(f, features=pictures_alone({STATE: many(10**12)})), "1 to 4096"),
        ("v2.1", lambda f: (f / TABLES).write_bytes(b"no table"), "episode_000001.parquet"),
        ("v2.1", lambda f: (f / TABLES).unlink(), "no episode 1 in data; it has 0"),
        ("v3.0", lambda f: changed(f, "data", "timestamp", [1e300] * 21), "stamps up to 1e+06 s"),
        ("v3.0", lambda f: changed(f, "data", "frame_index", [3] * 21), "is there twice"),
        ("v3.0", lambda f: changed(f, "data", "episode_index", ["x"] * 21), "parquet"),
    ],
)
def test_damaged_tables_are_refused_by_cameras_and_joints(
    version: str, damage: Any, named: str, tmp_path: Path
) -> None:
    damage(write(tmp_path / "set", version, episodes()))
    with pytest.raises(DriverError, match=re.escape(named)):
        begun(tmp_path, VirtualClock(), "up")
    with pytest.raises(DriverError, match=re.escape(named)):
        EpisodeJointDriver(JOINTS, context(tmp_path, VirtualClock()))


VIDEO = f"videos/chunk-000/{UP}/episode_000001.mp4"


def cut(folder: Path) -> None:
    """Leave half of a video."""
    path = folder / VIDEO
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


@pytest.mark.parametrize(
    ("version", "kind", "damage", "named"),
    [
        ("v2.1", "video", lambda f: (f / VIDEO).unlink(), "no such video"),
        ("v2.1", "video", cut, "episode_000001.mp4"),
        ("v2.1", "video", lambda f: rewritten(f, video_path="{x.y}"), "its parts may be video_key"),
        ("v3.0", "video", lambda f: changed(f, "meta/episodes", f"videos/{UP}/from_timestamp", [0, 9e5]), "no picture"),
        ("v3.0", "video", lambda f: changed(f, "meta/episodes", f"videos/{UP}/from_timestamp", [0, 9e9]), "are 0 to"),
        ("v3.0", "video", lambda f: changed(f, "meta/episodes", "episode_index", [0, 5]), "has no episode 1"),
        ("v3.0", "image", lambda f: changed(f, "data", UP, [{"bytes": b"no picture"}] * 21), "no picture that OpenCV"),
        ("v3.0", "image", lambda f: changed(f, "data", UP, ["up.png"] * 21), "no picture that OpenCV"),
    ],
)  # fmt: skip
def test_damaged_pictures_are_refused_by_name(version: str, kind: str, damage: Any, named: str, tmp_path: Path) -> None:
    damage(write(tmp_path / "set", version, episodes(), kind))
    with pytest.raises(DriverError, match=re.escape(named)):
        play(begun(tmp_path, VirtualClock(), "up", loop=False, pace="every"))


def play(driver: VideoCameraDriver) -> None:
    for _ in range(12):
        driver.poll()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"episode": 2}, "no episode 2 in data; it has 0, 1"),
        ({"dataset": "other"}, "there is no file meta/info.json"),
        ({"units": "turns"}, "joint0.pos is in 'turns'; valid are rad, deg, m, mm"),
        ({"units": "deg,hand=none"}, "the states are joint0.pos, joint1.pos, gripper.pos"),
        ({"episodes": 2}, "did you mean 'episode'?"),
    ],
)
def test_options_of_joints_that_name_nothing_are_refused(options: dict[str, Any], named: str, tmp_path: Path) -> None:
    write(tmp_path / "set", "v2.1", episodes())
    with pytest.raises(DriverError, match=re.escape(named)):
        EpisodeJointDriver(JOINTS | options, context(tmp_path, VirtualClock()))


def test_what_is_not_installed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "set", "v2.1", episodes())
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(DriverError, match=r"pip install 'stereoservo\[lerobot\]'") as caught:
        EpisodeJointDriver(JOINTS, context(tmp_path, VirtualClock()))
    assert caught.value.code == "not_installed"


CELL = """
schema = 1
[cell]
name = "played"
[joints]
driver = "lerobot"
options = {dataset = "set", episode = 1, units = "deg,gripper.pos=none"}
[safety]
"""


def test_a_cell_file_names_an_episode_for_its_joints_and_cameras(tmp_path: Path) -> None:
    write(tmp_path / "set", "v3.0", episodes())
    cameras = "".join(
        f'[[camera]]\nname = "{name}"\ndriver = "video"\ndetector = "aruco"\n[camera.options]\nsource = "set"\n'
        f"episode = 1\nwidth = {WIDTH}\nheight = {HEIGHT}\nrate_hz = {FPS}\nloop = true\n"
        '[camera.detector_options]\ntags = [1]\ndictionary = "4x4_50"\n'
        for name in CAMERAS
    )
    path = tmp_path / "cell.toml"
    path.write_text(CELL + cameras)
    plan = make_plan(path, tmp_path / "run", tmp_path / "state", PlanOptions(boot="b"))
    assert [joint.name for joint in plan.joints.joints] == ["joint0.pos", "joint1.pos"]
    assert [camera.name for camera in plan.cameras] == list(CAMERAS)
    path.write_text(CELL + cameras.replace("episode = 1", "episode = 0"))
    with pytest.raises(DriverError, match="the joints are of episode 1"):
        make_plan(path, tmp_path / "run", tmp_path / "state", PlanOptions(boot="b"))
