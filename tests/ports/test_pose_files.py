"""Poses as people store them: random poses written in many conventions are read as they were, or the convention is
asked for; damaged files; recordings of real arms.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereoservo.ports.pose_files import PoseFileError, board_poses, read_poses

NOISE_RAD, NOISE_M = 0.004, 0.001
VIEWS = 16


def rigid(rotations: Rotation, places: Any) -> np.ndarray:
    found = np.tile(np.eye(4), (len(places), 1, 1))
    found[:, :3, :3], found[:, :3, 3] = rotations.as_matrix(), places
    return found


def scene(rng: np.random.Generator, on_hand: bool = True, views: int = VIEWS) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 4, 4) of a hand that points down within 50 degrees, and those of the board in the camera, with noise."""
    turns = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (views, 3))) * Rotation.from_rotvec([np.pi, 0.0, 0.0])
    poses = rigid(
        turns * Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]), [0.5, 0, 0.5] + rng.uniform(-0.2, 0.2, (views, 3))
    )
    hand, base = rigid(Rotation.random(2, rng=rng), [rng.uniform(-0.1, 0.1, 3), rng.uniform(0.5, 0.9, 3)])
    board = np.linalg.inv(poses @ hand) @ base if on_hand else np.linalg.inv(base) @ poses @ hand
    noise = rigid(Rotation.from_rotvec(rng.normal(0, NOISE_RAD, (views, 3))), rng.normal(0, NOISE_M, (views, 3)))
    return poses, board @ noise


def euler(axes: str, columns: str = "xyz") -> Callable[[Rotation], np.ndarray]:
    order = [axes.lower().index(one) for one in columns] if len(set(axes)) == 3 else [0, 1, 2]
    return lambda turn: turn.as_euler(axes)[:, order]


LAYOUTS: dict[str, Callable[[np.ndarray, float], np.ndarray]] = {
    "rows": lambda T, scale: scaled(T, scale).reshape(-1, 16),
    "columns": lambda T, scale: scaled(T, scale).transpose(0, 2, 1).reshape(-1, 16),
    "3x4": lambda T, scale: scaled(T, scale)[:, :3].reshape(-1, 12),
    "3x3 and t": lambda T, scale: np.hstack([T[:, :3, :3].reshape(-1, 9), scale * T[:, :3, 3]]),
    "t and 3x3 by columns": lambda T, scale: np.hstack(
        [scale * T[:, :3, 3], T[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)]
    ),
    "xyzw": lambda T, scale: with_place(T, scale, Rotation.as_quat),
    "wxyz": lambda T, scale: with_place(T, scale, lambda one: one.as_quat(scalar_first=True)),
    "wxyz first": lambda T, scale: np.roll(
        with_place(T, scale, lambda one: one.as_quat(scalar_first=True)), -3, axis=1
    ),
    "vector": lambda T, scale: with_place(T, scale, Rotation.as_rotvec),
    "vector deg": lambda T, scale: with_place(T, scale, lambda one: np.degrees(one.as_rotvec())),
    "vector first": lambda T, scale: np.roll(with_place(T, scale, Rotation.as_rotvec), 3, axis=1),
}
for axes in ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "ZYZ", "ZXZ"):
    for unit in ("", " deg"):
        LAYOUTS[f"{axes}{unit}"] = lambda T, scale, axes=axes, unit=unit: with_place(
            T, scale, lambda one: (np.degrees if unit else np.asarray)(euler(axes)(one))
        )
LAYOUTS["KUKA"] = lambda T, scale: with_place(T, scale, lambda one: np.degrees(euler("ZYX", "zyx")(one)))


def scaled(T: np.ndarray, scale: float) -> np.ndarray:
    found = T.copy()
    found[:, :3, 3] *= scale
    return found


def with_place(T: np.ndarray, scale: float, turn: Callable[[Rotation], np.ndarray]) -> np.ndarray:
    return np.hstack([scale * T[:, :3, 3], turn(Rotation.from_matrix(T[:, :3, :3]))])


def texts(values: np.ndarray, separator: str, comma: bool = False) -> str:
    rows = [separator.join(f"{value:.9f}" for value in row) for row in values]
    return "\n".join(row.replace(".", ",") if comma else row for row in rows) + "\n"


def with_header(values: np.ndarray) -> str:
    names = ["frame", *(f"c{k}" for k in range(values.shape[1]))]
    return "\n".join([",".join(names), *(f"{k},{row}" for k, row in enumerate(texts(values, ",").split("\n")[:-1]))])


def opencv(values: np.ndarray, name: str) -> bytes:
    size = (4, 4) if values.shape[1] == 16 else (1, values.shape[1])
    store = cv2.FileStorage(name, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for k, row in enumerate(values):
        store.write(f"pose_{k}", row.reshape(size))
    return store.releaseAndGetString().encode()


def numpy_bytes(values: np.ndarray, name: str = "") -> bytes:
    file = io.BytesIO()
    if name:
        np.savez(file, **{name: values, "camera_matrix": np.eye(3)})
    else:
        np.save(file, values)
    return file.getvalue()


WRITERS: dict[str, Callable[[np.ndarray], bytes]] = {
    "a.csv": lambda v: texts(v, ",").encode(),
    "header.csv": lambda v: with_header(v).encode("utf-8-sig"),
    "german.csv": lambda v: texts(v, ";", True).encode("utf-16"),
    "comma.txt": lambda v: texts(v, "  ", True).encode(),
    "tabs.tsv": lambda v: texts(v, "\t").replace("\n", "\r\n").encode("utf-16"),
    "comment.txt": lambda v: ("# Größen in unserem Büro\n\n" + texts(v, " ")).encode("cp1252"),
    "files.txt": lambda v: "".join(
        f"pic_{k}.png, {row}\n" for k, row in enumerate(texts(v, ", ").split("\n")[:-1])
    ).encode(),
    "list.py": lambda v: f"poses = np.array({v.tolist()})\n".encode(),
    "list.json": lambda v: json.dumps(v.tolist()).encode(),
    "dict.json": lambda v: json.dumps(
        {
            "camera": {"matrix": np.eye(3).tolist()},
            "poses": [{"id": k, "value": row} for k, row in enumerate(v.tolist())],
        },
        indent=1,
    ).encode(),
    "lines.jsonl": lambda v: "\n".join(json.dumps({"pose": row}) for row in v.tolist()).encode(),
    "map.yaml": lambda v: "".join(f"frame_{k:02}:\n  pose: {row}\n" for k, row in enumerate(v.tolist())).encode(),
    "cv.yml": lambda v: opencv(v, ".yml"),
    "cv.xml": lambda v: opencv(v, ".xml"),
    "tags.xml": lambda v: (
        "<?xml version='1.0' encoding='utf-8'?><poses>"
        + "".join(f"<pose n='{k}'>{row}</pose>" for k, row in enumerate(texts(v, " ").split("\n")[:-1]))
        + "</poses>"
    ).encode(),
    "a.npy": numpy_bytes,
    "a.npz": lambda v: numpy_bytes(v, "poses"),
}
PICTURES = [f"pic_{k}.png" for k in range(VIEWS)]


def difference(found: np.ndarray, poses: np.ndarray) -> float:
    return float(np.abs(found - poses).max()) if found.shape == poses.shape else np.inf


@pytest.mark.parametrize("number", range(len(LAYOUTS)))
def test_random_poses_in_every_layout_are_read_as_they_were_or_asked_for(number: int, tmp_path: Path) -> None:
    """Each layout in one format and unit, more with STEREOSERVO_POSES=N: read right with a board, never wrong without."""
    layout = list(LAYOUTS)[number]
    rng = np.random.default_rng(100 + number)
    for k in range(int(os.environ.get("STEREOSERVO_POSES", "1"))):
        name, write = list(WRITERS.items())[(number + 7 * k) % len(WRITERS)]
        poses, board = scene(rng, on_hand=bool(rng.integers(2)))
        unit, scale = [("m", 1.0), ("mm", 1000.0), ("cm", 100.0)][rng.integers(3)]
        file = tmp_path / name
        file.write_bytes(write(LAYOUTS[layout](poses, scale)))
        found = read_poses([file], PICTURES, board)
        assert difference(found.poses, poses) < 2e-6, (name, layout, unit, found.words)
        try:
            blind = read_poses([file], PICTURES)
        except PoseFileError as error:
            assert error.code == "ambiguous"
        else:
            assert difference(blind.poses, poses) < 2e-6, (name, layout, unit, blind.words)
