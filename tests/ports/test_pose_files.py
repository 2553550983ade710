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
    """Poses (n, 4, 4) of a hand that points down within 50 degrees, and of the board in the camera, with noise."""
    turns = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (views, 3))) * Rotation.from_rotvec([np.pi, 0.0, 0.0])
    poses = rigid(
        turns * Rotation.from_rotvec([0, 0, rng.uniform(-3, 3)]),
        rng.uniform([0.3, -0.2, 0.3], [0.7, 0.2, 0.7], (views, 3)),
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


def read_or_asked(file: Path) -> Any:
    try:
        return read_poses([file], PICTURES).poses
    except PoseFileError as error:
        if error.code != "ambiguous":
            raise
        return error.code


@pytest.mark.parametrize("number", range(len(LAYOUTS)))
def test_random_poses_in_every_layout_are_read_as_they_were_or_asked_for(number: int, tmp_path: Path) -> None:
    """Each in one format and unit, in N with STEREOSERVO_POSES=N: read right with a board, never wrong without."""
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
        blind = read_or_asked(file)
        assert isinstance(blind, str) or difference(blind, poses) < 2e-6, (name, layout, unit)


# -- which pose belongs to which picture, and what is damaged -------------------------------------------------


def euler_file(folder: Path, poses: np.ndarray, name: str = "poses.txt") -> Path:
    path = folder / name
    path.write_text(texts(LAYOUTS["XYZ deg"](poses, 1000.0), " "))
    return path


def test_poses_are_paired_with_pictures_by_their_motion_where_counts_and_numbers_do_not(tmp_path: Path) -> None:
    poses, board = scene(np.random.default_rng(1), views=20)
    pictures = [f"view{k}.png" for k in range(1, 21)]
    missing = euler_file(tmp_path, np.delete(poses, 7, axis=0))
    found = read_poses([missing], pictures, board)
    assert difference(found.poses, np.delete(poses, 7, axis=0)) < 2e-6
    assert found.pictures.tolist() == [k for k in range(20) if k != 7]
    assert any("pictures without partner: 7" in str(one) for one in found.findings)
    with pytest.raises(PoseFileError, match="19 poses and 20 pictures") as refused:
        read_poses([missing], pictures)
    assert refused.value.code == "count"
    shifted = read_poses([euler_file(tmp_path, poses)], pictures, np.roll(board, 1, axis=0))
    assert shifted.pictures.tolist() == list(range(1, 20))
    assert any("shifted by one" in str(one) for one in shifted.findings)


def test_one_file_a_picture_is_paired_by_number_and_a_damaged_one_is_left_out_by_name(tmp_path: Path) -> None:
    poses, _ = scene(np.random.default_rng(2), views=12)
    paths = [tmp_path / f"T{k}.txt" for k in range(12)]
    for path, pose in zip(paths, poses, strict=True):
        path.write_text(texts(pose, " "))
    paths[4].write_bytes(paths[4].read_bytes()[:60])
    found = read_poses(paths[:9] + paths[10:], [f"pic{k:03}.jpg" for k in range(12)])
    assert found.pictures.tolist() == [0, 1, 2, 3, 5, 6, 7, 8, 10, 11]
    assert difference(found.poses, poses[found.pictures]) < 2e-6
    listed = [str(one) for one in found.findings]
    assert any("T4.txt" in one and "left out" in one for one in listed)
    assert any("pictures without partner: 9" in one for one in listed)


def test_inverted_poses_are_found_by_their_levers_or_stated(tmp_path: Path) -> None:
    poses, board = scene(np.random.default_rng(3))
    path = euler_file(tmp_path, np.linalg.inv(poses))
    found = read_poses([path], PICTURES, board)
    assert difference(found.poses, poses) < 2e-6
    assert any("camera is on the hand" in str(one) for one in found.findings)
    direct = read_poses([path], PICTURES, board, "direct")
    assert difference(direct.poses, np.linalg.inv(poses)) < 2e-6


def test_a_convention_that_nothing_decides_is_asked_for_and_taken_as_stated(tmp_path: Path) -> None:
    poses, _ = scene(np.random.default_rng(4))
    path = tmp_path / "poses.txt"
    path.write_text(texts(LAYOUTS["wxyz"](poses, 1.0), " "))
    with pytest.raises(PoseFileError, match="'xyzw' or 'wxyz'"):
        read_poses([path], PICTURES)
    assert difference(read_poses([path], PICTURES, stated="wxyz").poses, poses) < 2e-6
    with pytest.raises(PoseFileError, match=r"words of those that the numbers allow are .*wxyz"):
        read_poses([path], PICTURES, stated="zyxw")
    named = tmp_path / "named.csv"
    named.write_text(
        "x_mm;y_mm;z_mm;roll_deg;pitch_deg;yaw_deg\n" + texts(LAYOUTS["XYZ deg"](0.1 * poses, 1000.0), ";")
    )
    assert read_poses([named], PICTURES).words == ("RzRyRx", "deg", "position-first", "mm")


def test_joints_are_not_taken_for_poses(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    path = tmp_path / "joints.txt"
    path.write_text(texts(rng.uniform(-2.0, 2.0, (VIEWS, 6)), ","))
    with pytest.raises(PoseFileError) as refused:
        read_poses([path], PICTURES, scene(rng)[1])
    assert refused.value.code == "no_fit"


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_of_damaged_files_what_is_read_is_true(name: str, tmp_path: Path) -> None:
    """Cut, and with bytes replaced: poses of the file or a refusal, and nothing else escapes."""
    rng = np.random.default_rng(len(name))
    poses, _ = scene(rng)
    raw = WRITERS[name](LAYOUTS["rows"](poses, 1.0))
    read = 0
    for k in range(6):
        damaged = bytearray(raw[: len(raw) * (k + 5) // 10])
        if k == 5:
            damaged[int(rng.integers(len(raw)))] = 0x21
        (tmp_path / name).write_bytes(bytes(damaged))
        try:
            found = read_poses([tmp_path / name], PICTURES[: len(poses)] if k == 5 else ())
        except PoseFileError:
            continue
        nearest = np.abs(found.poses[:, None] - poses[None]).max(axis=(2, 3)).min(axis=1)
        read += (nearest < 2e-6).sum() >= len(nearest) - 1  # a digit may be another
    assert read >= (0 if name.startswith("a.np") else 4)


# -- recordings of real arms -----------------------------------------------------------------------------------


REAL = Path(os.environ.get("STEREOSERVO_DATA", Path(__file__).parents[3] / "shared" / "data")) / "hand_eye"


@pytest.mark.skipif(not REAL.is_dir(), reason="no hand_eye in ../shared/data or $STEREOSERVO_DATA")
@pytest.mark.parametrize("name", sorted(path.name for path in REAL.glob("*/")) or [""])
def test_files_of_real_arms_are_read_as_they_were_converted(name: str) -> None:
    folder = REAL / name
    table = np.genfromtxt(folder / "poses.csv", delimiter=",", skip_header=1)
    truth = rigid(Rotation.from_quat(table[:, 4:]), table[:, 1:4])
    paths = sorted(folder.glob("original*/*")) or sorted(folder.glob("original*"))
    pictures = [f"{k:03}.png" for k in range(len(truth))]
    board = None
    if name == "mycobot630_tag_a":
        seen = [one["aruco_markers"][0] for one in json.loads(paths[0].read_text())]
        turns = Rotation.from_rotvec([one["rotation_vector"] for one in seen])
        board = rigid(turns, 1e-3 * np.array([one["translation_mm"] for one in seen]))
    if name == "ur_l515_board":
        grid = np.array([(k % 9, k // 9) for k in range(54)], dtype=np.float64)
        pixels = np.full((len(truth), 54, 2), np.nan)
        for k in range(0, len(truth), 3):  # enough of them to decide
            image = cv2.imread(str(folder / "images" / f"{k:03}.jpg"), cv2.IMREAD_GRAYSCALE)
            found, corners = cv2.findChessboardCorners(image, (9, 6))
            if found:
                pixels[k] = np.reshape(corners, (-1, 2))
        board = board_poses(pixels, 0.0218 * grid, (960, 540))
    read = read_poses(paths, pictures, board)
    assert difference(read.poses, truth) < 1e-6
    assert read.pictures.tolist() == list(range(len(truth)))
