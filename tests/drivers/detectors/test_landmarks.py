"""Landmarks: the file, what learning refuses, and real pictures."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from stereoservo.cli.main import invoke
from stereoservo.geometry.fundamental import fundamental_robust, sampson_distances
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.detectors.landmark_learning import LearningSettings, learn_landmarks
from stereoservo_drivers.detectors.landmarks import (
    CameraReference,
    Landmarks,
    decode_landmarks,
    encode_landmarks,
    load_landmarks,
)
from stereoservo_drivers.detectors.patch_alignment import ReferencePatches, build_pyramid

from .textured import texture

CELL = """
schema = 1
[cell]
name = "corners-test"
[joints]
driver = "fake"
[[camera]]
name = "left"
driver = "fake"
[[camera]]
name = "right"
driver = "fake"
[[safety.limit]]
joint = "j1"
min = -1.0
max = 1.0
velocity = 1.0
acceleration = 1.0
"""


def landmarks(m=9) -> Landmarks:
    rng = np.random.default_rng(1)
    picture = np.clip(texture(rng, 96), 0, 255).astype(np.uint8)
    cameras = tuple(CameraReference(name, picture, 2, rng.uniform(15, 80, (m, 2)), np.full(m, 0.02)) for name in "ab")
    return Landmarks(np.arange(5, 5 + m), np.arange(m) % 3, cameras)


def test_a_file_keeps_every_bit(tmp_path):
    given = landmarks()
    given.cameras[1].pixels[3] = np.nan
    path = tmp_path / "marks.npz"
    path.write_bytes(encode_landmarks(given))
    read = load_landmarks(path)
    assert np.array_equal(read.ids, given.ids)
    assert np.array_equal(read.kinds, given.kinds)
    for ours, theirs in zip(given.cameras, read.cameras, strict=True):
        assert (ours.name, ours.averaged) == (theirs.name, theirs.averaged)
        assert np.array_equal(ours.picture, theirs.picture)
        assert np.array_equal(ours.pixels, theirs.pixels, equal_nan=True)
        assert np.array_equal(ours.sigmas, theirs.sigmas)
    assert read.of_kind("static").tolist() == [6, 9, 12]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda data: b"", "no .npz"),
        (lambda data: b"not an archive", "no .npz"),
        (lambda data: data[: len(data) // 2], "not a file of landmarks"),
        (lambda data: data[:400] + bytes([data[400] ^ 255]) + data[401:], "landmarks"),
    ],
)
def test_a_damaged_file_is_refused(change, word):
    with pytest.raises(DriverError, match=word) as caught:
        decode_landmarks(change(encode_landmarks(landmarks())))
    assert caught.value.code == "landmarks"


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"ids": np.zeros(9, np.int64)}, "ascend"),
        ({"kinds": np.full(9, 7)}, "kinds"),
        ({"ids": np.arange(3)}, "kinds"),
        ({"cameras": ()}, "at least one"),
    ],
)
def test_what_contradicts_itself_is_not_written(changed, word):
    with pytest.raises(DriverError, match=word):
        encode_landmarks(msgspec.structs.replace(landmarks(), **changed))


def test_patches_are_found_to_hundredths_of_a_pixel_with_honest_covariances():
    rng = np.random.default_rng(2)
    shift, noise = np.array([0.37, -0.61]), 3.0
    fine = texture(rng, 300, 2.0)
    v, u = np.mgrid[20:260, 20:260].astype(np.float64)
    moved = map_coordinates(fine, [v + shift[1], u + shift[0]], order=5)
    first, second = (
        np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)
        for image in (fine[20:260, 20:260], moved)
    )
    at = np.stack(np.meshgrid(np.arange(25, 215, 22.0), np.arange(25, 215, 22.0)), axis=-1).reshape(-1, 2)
    n = len(at)
    found = ReferencePatches(first, at, 10).align(
        build_pyramid(second, 4), np.arange(n), np.tile(np.eye(2), (n, 1, 1)), at, 1
    )
    assert found.found.mean() > 0.95
    errors = (found.pixels - (at - shift))[found.found]
    squares = np.einsum("ki,ki->k", errors, np.linalg.solve(found.covariances[found.found], errors[..., None])[..., 0])
    # The mean of n squares of two degrees of freedom has a deviation of 2/sqrt(n); the model is good to a fifth.
    assert abs(squares.mean() / 2 - 1.0) <= 0.25 + 4 / np.sqrt(len(squares))
    assert np.sqrt(np.mean(errors**2)) < 0.05


def test_too_little_in_common_is_told_with_its_numbers():
    pictures = [np.clip(texture(np.random.default_rng(k), 160), 0, 255).astype(np.uint8) for k in (1, 2)]
    settings = LearningSettings(tilts=0)
    with pytest.raises(DriverError, match="at least 8 are needed") as caught:
        learn_landmarks({"a": [pictures[0]], "b": [pictures[1]]}, None, settings)
    assert caught.value.code == "too_few_matches"
    assert caught.value.data["agreeing"] < 8
    for images in (
        {"a": [pictures[0]]},
        {"a": [pictures[0]], "b": []},
        {"a": [pictures[0]], "b": [pictures[0], pictures[0][:100]]},
        {"a": [np.zeros((100, 100), np.uint8)], "b": [pictures[0]]},
    ):
        with pytest.raises(DriverError) as caught:
            learn_landmarks(images, None, settings)
        assert caught.value.code == "images"


def real_set():
    """The recorded set, where it lies beside the repository or below ``$STEREOSERVO_DATA``."""
    roots = [Path(__file__).resolve().parents[3] / ".." / "shared" / "data"]
    if "STEREOSERVO_DATA" in os.environ:
        roots.insert(0, Path(os.environ["STEREOSERVO_DATA"]))
    for root in roots:
        if (root / "fairo_franka" / "set_a").is_dir():
            return root / "fairo_franka" / "set_a"
    return None


needs_real_set = pytest.mark.skipif(
    real_set() is None, reason="no fairo_franka/set_a in ../shared/data or $STEREOSERVO_DATA"
)


def run(capsys, *arguments):
    code = invoke(["learn-corners", *map(str, arguments), "--json"])
    return code, json.loads(capsys.readouterr().out)


@pytest.fixture
def cell(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(CELL)
    return path


@needs_real_set
@pytest.mark.slow
def test_real_cameras_far_apart_share_landmarks_that_keep_their_epipolar_lines(cell, tmp_path, capsys):
    images = real_set()
    pair = [images / f"pose00_cam{c}.jpg" for c in (0, 2)]
    moved = [images / f"pose07_cam{c}.jpg" for c in (0, 2)]
    code, answer = run(
        capsys, cell, tmp_path / "l.npz", "--pair", *pair, "--moved", *moved, "--picture", tmp_path / "l.png"
    )
    assert code == 0
    assert answer["landmarks"] > 30
    assert answer["static"] >= 25
    assert answer["tool"] >= 1
    assert answer["pairs"][0]["epipolar_rms_px"] < 0.5
    assert cv2.imread(str(tmp_path / "l.png")).shape == (480, 1280, 3)
    learnt = load_landmarks(tmp_path / "l.npz")
    left, right = (camera.pixels for camera in learnt.cameras)
    F, inliers = fundamental_robust(left, right, 0.5, refuse_plane=False)
    assert inliers.mean() > 0.9
    assert np.sqrt(np.mean(sampson_distances(F, left, right)[inliers] ** 2)) < 0.5


@needs_real_set
def test_static_features_of_real_pictures_repeat_to_a_few_hundredths_of_a_pixel():
    pictures = [cv2.imread(str(real_set() / f"pose{k:02d}_cam2.jpg"), 0) for k in (0, 7)]
    corners = cv2.goodFeaturesToTrack(pictures[0][215:420, 260:580], 60, 0.02, 10)[:, 0] + [260, 215]
    n = len(corners)
    found = ReferencePatches(pictures[0], corners, 10).align(
        build_pyramid(pictures[1], 4), np.arange(n), np.tile(np.eye(2), (n, 1, 1)), corners, 0
    )
    good = found.found & (found.correlations > 0.9)
    assert good.sum() >= 0.6 * n
    errors = (found.pixels - corners)[good]
    assert np.sqrt(np.mean(errors**2)) < 0.15  # tags: 0.07 to 0.19 px


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--pair", "none.png", "none.png"], "images"),
        (["--images", "none"], "images"),
        (["--images", ".", "--pair", "a.png", "b.png"], "argument"),
        (["--pair", "CELL", "CELL"], "images"),
        (["--ask-to-move", "--pair", "a.png", "b.png"], "argument"),
        (["--picture", "l.txt", "--pair", "a.png", "b.png"], "argument"),
    ],
)
def test_what_cannot_be_learnt_from_is_told(cell, tmp_path, capsys, arguments, code):
    given = [str(cell) if argument == "CELL" else argument for argument in arguments]
    status, answer = run(capsys, cell, tmp_path / "l.npz", *given)
    assert (status, answer["error"]["code"]) == (1, code)
    assert not (tmp_path / "l.npz").exists()


def test_a_file_that_exists_is_left_alone(cell, tmp_path, capsys):
    (tmp_path / "l.npz").write_bytes(b"mine")
    status, answer = run(capsys, cell, tmp_path / "l.npz", "--images", tmp_path)
    assert (status, answer["error"]["code"]) == (1, "exists")
    assert (tmp_path / "l.npz").read_bytes() == b"mine"


def test_a_pipe_is_no_file_of_landmarks_and_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npz")
    for path in (tmp_path / "pipe.npz", Path("/dev/zero")):
        with pytest.raises(DriverError, match="no regular file"):
            load_landmarks(path)


def test_learning_reads_no_huge_picture_and_writes_over_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cell, huge = tmp_path / "cell.toml", tmp_path / "huge.png"
    cell.write_text(CELL)
    with huge.open("wb") as file:
        file.truncate(10 << 30)
    drawn = tmp_path / "drawn.png"
    drawn.write_bytes(b"mine")
    pair = ["--pair", str(huge), str(huge), "--json"]
    for more, out, told in (
        ([], "out.npz", "10737418240 bytes"),
        (["--picture", str(drawn)], "out.npz", "drawn.png exists"),
        ([], "nowhere/out.npz", "there is no folder"),
    ):
        assert invoke(["learn-corners", str(cell), str(tmp_path / out), *pair, *more]) == 1
        assert told in json.loads(capsys.readouterr().out)["error"]["message"]
    assert drawn.read_bytes() == b"mine"
