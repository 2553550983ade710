"""LeRobot data sets as formats 2.0, 2.1 and 3.0 lay them out, written for tests, and such as LeRobot writes itself."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

FPS = 10
CAMERAS = ("up", "side")
UNITS = "deg,gripper.pos=none"
DETECTOR = 'detector = "aruco"\n[options]\ntags = [1, 2, 3]\ndictionary = "4x4_50"\n'


@dataclass(frozen=True)
class Episode:
    """Joints (f, n) [rad] of an episode and its pictures (c, f, h, w), with the tags' true corners (c, f, m, 2)."""

    joints: np.ndarray
    pictures: np.ndarray
    corners: np.ndarray


def info(version: str, episodes: list[Episode], kind: str) -> dict[str, Any]:
    """``meta/info.json`` as lerobot writes it, without what is not read."""
    names = [f"joint{k}.pos" for k in range(episodes[0].joints.shape[1])] + ["gripper.pos"]
    _, _, height, width = episodes[0].pictures.shape
    features: dict[str, Any] = {
        "action": {"dtype": "float32", "shape": [len(names)], "names": names},
        "observation.state": {"dtype": "float32", "shape": [len(names)], "names": names},
    }
    for camera in CAMERAS:
        features[f"observation.images.{camera}"] = {
            "dtype": kind,
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
        }
    for name, dtype in (("timestamp", "float32"), ("frame_index", "int64"), ("episode_index", "int64")):
        features[name] = {"dtype": dtype, "shape": [1], "names": None}
    v2 = version.startswith("v2")
    return {
        "codebase_version": version,
        "robot_type": "so101_follower",
        "total_episodes": len(episodes),
        "chunks_size": 1000,
        "fps": FPS,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        if v2
        else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        if v2
        else "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }


def rows(number: int, one: Episode, kind: str) -> dict[str, pa.Array]:
    count = len(one.joints)
    state = np.hstack([np.degrees(one.joints), np.full((count, 1), 37.5)])
    table = {
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32())),
        "timestamp": pa.array(np.arange(count) / FPS, pa.float32()),
        "frame_index": pa.array(np.arange(count)),
        "episode_index": pa.array(np.full(count, number)),
    }
    for c, camera in enumerate(CAMERAS if kind == "image" else ()):
        table[f"observation.images.{camera}"] = pa.array(
            [{"bytes": cv2.imencode(".png", image)[1].tobytes(), "path": None} for image in one.pictures[c]]
        )
    return table


def write_video(path: Path, pictures: np.ndarray, fps: float = FPS) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, (pictures.shape[2], pictures.shape[1]))
    for image in pictures:
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()


def write_in_av1(folder: Path, episodes: list[Episode]) -> None:
    """Videos of a data set of format 3.0 in lerobot's own codec, in place of those that are there.

    In a thread of its own: SVT-AV1 sets SCHED_FIFO 99 for the thread that calls it, where it may, and leaves it so.
    """
    with ThreadPoolExecutor(1) as thread:
        thread.submit(_encode_in_av1, folder, episodes).result()


def _encode_in_av1(folder: Path, episodes: list[Episode]) -> None:
    import av

    for c, camera in enumerate(CAMERAS):
        path = folder / f"videos/observation.images.{camera}/chunk-000/file-000.mp4"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libsvtav1", rate=FPS, options={"crf": "30", "g": "2"})
            stream.height, stream.width = episodes[0].pictures.shape[2:]
            stream.pix_fmt = "yuv420p"
            for image in np.concatenate([one.pictures[c] for one in episodes]):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray")))
            container.mux(stream.encode(None))


def write_table(path: Path, table: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pa.table(table), path)


def write(folder: Path, version: str, episodes: list[Episode], kind: str = "video") -> Path:
    """A data set as lerobot of that format lays it out: a file an episode, or files that hold several."""
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info(version, episodes, kind)))
    tables = [rows(number, one, kind) for number, one in enumerate(episodes)]
    if version == "v3.0":
        together = {name: pa.concat_arrays([table[name] for table in tables]) for name in tables[0]}
        write_table(folder / "data/chunk-000/file-000.parquet", together)
        begins = np.cumsum([0, *(len(one.joints) for one in episodes)])[:-1] / FPS
        about: dict[str, Any] = {"episode_index": np.arange(len(episodes))}
        for c, camera in enumerate(CAMERAS):
            key = f"observation.images.{camera}"
            about |= {f"videos/{key}/{part}_index": np.zeros(len(episodes), int) for part in ("chunk", "file")}
            about[f"videos/{key}/from_timestamp"] = begins
            pictures = np.concatenate([one.pictures[c] for one in episodes])
            if kind == "video":
                write_video(folder / f"videos/{key}/chunk-000/file-000.mp4", pictures)
        write_table(folder / "meta/episodes/chunk-000/file-000.parquet", about)
    else:
        for number, (one, table) in enumerate(zip(episodes, tables, strict=True)):
            write_table(folder / f"data/chunk-000/episode_{number:06d}.parquet", table)
            for c, camera in enumerate(CAMERAS if kind == "video" else ()):
                path = f"videos/chunk-000/observation.images.{camera}/episode_{number:06d}.mp4"
                write_video(folder / path, one.pictures[c])
    (folder / "detector.toml").write_text(DETECTOR)
    return folder


def rewritten(folder: Path, **changes: Any) -> None:
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def changed(folder: Path, part: str, name: str, values: list[Any]) -> None:
    """Another column in the first table of a part of a data set."""
    path = min((folder / part).glob("chunk-*/*.parquet"))
    table = parquet.read_table(path)
    columns = {column: table[column].combine_chunks() for column in table.column_names}
    write_table(path, columns | {name: pa.array(values)})


# -- by LeRobot itself ----------------------------------------------------------------------------------------


def _pythons() -> list[Any]:
    named = os.environ.get("STEREOSERVO_LEROBOT_PYTHON", "")
    if not named and importlib.util.find_spec("lerobot"):
        named = sys.executable
    if named:
        return named.split(os.pathsep)
    missing = "lerobot is not installed, nor named by $STEREOSERVO_LEROBOT_PYTHON"
    return [pytest.param("", marks=pytest.mark.skip(reason=missing))]


LEROBOT_PYTHONS = _pythons()
"""Interpreters that have LeRobot: those named in ``$STEREOSERVO_LEROBOT_PYTHON`` (``:`` between two), or this one."""


def _lerobot(python: str, scratch: Path, *arguments: str | Path) -> None:
    program = Path(__file__).with_name("lerobot_program.py")
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "HF_HOME": str(scratch / "hf"), "PYTHONPATH": ""}
    command = [python, program, *arguments]
    told = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    assert told.returncode == 0, told.stderr


def write_by_lerobot(
    python: str, folder: Path, episodes: list[Episode], kind: str = "video", fps: int = FPS, **more: Any
) -> Path:
    """A data set as LeRobot's own writer writes it: joints in degrees beside a gripper, pictures in three colours."""
    scratch = folder.parent
    states = [np.hstack([np.degrees(one.joints), np.full((len(one.joints), 1), 37.5)]) for one in episodes]
    pictures = {}
    for c, camera in enumerate(CAMERAS):
        gray = np.concatenate([one.pictures[c] for one in episodes])
        pictures[camera] = np.stack([gray, gray // 4 * 3, gray // 2], axis=-1)
    np.savez(scratch / "pictures.npz", state=np.concatenate(states), **pictures)
    lengths = [len(one.joints) for one in episodes]
    names = info("v3.0", episodes, kind)["features"]["observation.state"]["names"]
    order = {"cameras": CAMERAS, "names": names, "lengths": lengths, "videos": kind == "video", "fps": fps}
    (scratch / "order.json").write_text(json.dumps(order | more))
    _lerobot(python, scratch, "write", folder, scratch / "pictures.npz", scratch / "order.json")
    (folder / "detector.toml").write_text(DETECTOR)
    return folder


def read_by_lerobot(python: str, folder: Path) -> dict[str, np.ndarray]:
    """What LeRobot's own reader returns for each row: stamps, numbers, states, and pictures (r, 3, h, w) of 0 to 1."""
    answer = folder.parent / "answer.npz"
    _lerobot(python, folder.parent, "read", folder, answer)
    return dict(np.load(answer))
