"""Cameras in the files of OpenCV, ROS and Kalibr: exact there and back, as cv2.FileStorage and PyYAML read them, and
from files as those projects' documentation and samples have them.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from stereoservo.calibration.camera_rig.exchange import (
    load_cameras,
    load_kalibr,
    save_kalibr,
    save_opencv,
    save_ros,
)
from stereoservo.calibration.camera_rig.rig_calibration import RigCamera
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.cli import main as cli

KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [461.629, 460.152, 362.680, 246.049]
  distortion_model: radtan
  distortion_coeffs: [-0.27695497, 0.06712482, 0.00087538, 0.00011556]
  rostopic: /cam0/image_raw
  resolution: [752, 480]
cam1:
  camera_model: pinhole
  intrinsics: [459.1, 458.2, 373.850, 253.749]
  distortion_model: radtan
  distortion_coeffs: [-0.28, 0.07, 1e-05, 0.00057686]
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11003785]
  - [0.0, 0.0, -1.0, 0.0005]
  - [0.0, 1.0, 0.0, 0.0004]
  - [0.0, 0.0, 0.0, 1.0]
  rostopic: /cam1/image_raw
  resolution: [752, 480]
"""
ROS = """
image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [526.6908296825479, 0, 312.3333507245396, 0, 525.7542623070541, 246.2279496394374, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.01864117263397289, -0.0807953154457166, 0.0006701578887838996, -0.001800282263098739, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [516.2001953125, 0, 310.3634868958034, 0, 0, 514.0494995117188, 246.8852026000968, 0, 0, 0, 1, 0]
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3591573396163199e+02, 0., 3.4228315473308373e+02, 0.,
       5.3591573396163199e+02, 2.3557082909788173e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.6637260909660682e-01, -3.8588898922304653e-02,
       1.7831947042852964e-03, -2.8122100441115472e-04,
       2.3839153080878486e-01 ]
"""


def rig(count: int, seed: int = 1) -> tuple[RigCamera, ...]:
    """Cameras with numbers of all sizes."""
    rng = np.random.default_rng(seed)
    cameras = []
    for k in range(count):
        R = Rotation.from_rotvec(0.3 * rng.normal(size=3)).as_matrix() if k else np.eye(3)
        cameras.append(
            RigCamera(
                f"eye{k}", 640 + k, 480, tuple(rng.uniform(400, 900, 2).tolist()),
                tuple(rng.uniform(200, 300, 2).tolist()),
                tuple((rng.normal(size=4) * [0.3, 0.1, 1e-7, 1e-3]).tolist()), tuple(map(tuple, R.tolist())),
                tuple(rng.normal(size=3).tolist()) if k else (0.0, 0.0, 0.0),
            )
        )  # fmt: skip
    return tuple(cameras)


def assert_alike(there: RigCamera, camera: RigCamera) -> None:
    """The same intrinsics to the bit, and the same pose but for the rounding of products."""
    assert (there.focal, there.centre, there.distortion) == (camera.focal, camera.centre, camera.distortion)
    assert np.abs(there.motion - camera.motion).max() < 1e-14


@pytest.mark.parametrize("count", [1, 2, 4])
def test_opencv_and_kalibr_give_back_what_they_got(count: int, tmp_path: Path) -> None:
    cameras = rig(count)
    save_opencv(cameras, tmp_path / "cameras.yml")
    assert load_cameras(tmp_path / "cameras.yml") == cameras
    save_kalibr(cameras, tmp_path / "chain.yaml")
    found = load_cameras(tmp_path / "chain.yaml")
    assert found[:2] == cameras[:2]
    for there, camera in zip(found, cameras, strict=True):  # poses of a chain are products, but for the first
        assert_alike(there, camera)


def test_ros_gives_back_the_cameras_and_of_a_pair_the_pose(tmp_path: Path) -> None:
    cameras = rig(2)
    save_ros(cameras, tmp_path / "ros")
    found = load_cameras(tmp_path / "ros")
    for there, camera in zip(found, cameras, strict=True):
        assert (there.name, there.width, there.height) == (camera.name, camera.width, camera.height)
        assert_alike(there, camera)


def test_the_rectification_of_a_pair_puts_points_on_one_row(tmp_path: Path) -> None:
    cameras = rig(2)
    save_ros(cameras, tmp_path)
    trees = [yaml.safe_load((tmp_path / f"{camera.name}.yaml").read_text()) for camera in cameras]
    X = np.random.default_rng(2).normal(size=(20, 3)) + np.array([0.0, 0.0, 8.0])
    rows = []
    for tree, camera in zip(trees, cameras, strict=True):
        R, P = (
            np.array(tree[key]["data"]).reshape(shape)
            for key, shape in (("rectification_matrix", (3, 3)), ("projection_matrix", (3, 4)))
        )
        there = (X @ camera.motion[:3, :3].T + camera.motion[:3, 3]) @ R.T
        # CameraInfo.msg: P projects points of the rectified *first* camera's frame; its fourth column shifts them.
        pixel = there @ P[:, :3].T
        rows.append(pixel[:, 1] / pixel[:, 2])
        if camera is cameras[1]:
            R_first = np.array(trees[0]["rectification_matrix"]["data"]).reshape(3, 3)
            first = X @ R_first.T @ P[:, :3].T + P[:, 3]
            assert np.abs(first[:, :2] / first[:, 2:] - pixel[:, :2] / pixel[:, 2:]).max() < 1e-9
    assert np.abs(rows[0] - rows[1]).max() < 1e-9


def test_opencv_reads_the_matrices_as_they_are(tmp_path: Path) -> None:
    cameras = rig(2)
    save_opencv(cameras, tmp_path / "cameras.yml")
    storage = cv2.FileStorage(str(tmp_path / "cameras.yml"), cv2.FILE_STORAGE_READ)
    for k, camera in enumerate(cameras, start=1):
        assert (storage.getNode(f"M{k}").mat() == camera.matrix).all()
        assert storage.getNode(f"D{k}").mat().ravel().tolist() == list(camera.distortion)
        assert storage.getNode(f"camera_name{k}").string() == camera.name
    assert (storage.getNode("R").mat() == np.array(cameras[1].rotation)).all()
    assert storage.getNode("T").mat().ravel().tolist() == list(cameras[1].translation)


def test_files_of_the_projects_themselves_are_read(tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(KALIBR)
    left, right = load_cameras(tmp_path / "chain.yaml")
    assert left.focal == (461.629, 460.152)
    assert (left.width, left.height, left.name) == (752, 480, "cam0")
    assert right.distortion == (-0.28, 0.07, 1e-05, 0.00057686)
    assert right.translation == (-0.11003785, 0.0005, 0.0004)
    (tmp_path / "front.yaml").write_text(ROS)
    (front,) = load_cameras(tmp_path / "front.yaml")
    assert front.focal == (526.6908296825479, 525.7542623070541)
    assert front.distortion == (
        0.01864117263397289,
        -0.0807953154457166,
        0.0006701578887838996,
        -0.001800282263098739,
    )
    (tmp_path / "one.yml").write_text(OPENCV)
    (one,) = load_cameras(tmp_path / "one.yml")
    assert one.centre == (342.28315473308373, 235.57082909788173)
    assert len(one.distortion) == 5
    with pytest.raises(CalibrationError, match="third radial term"):
        save_kalibr([one], tmp_path / "no.yaml")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("radtan", "equidistant"), "pinhole-equidistant; pinhole-radtan"),
        (("[461.629, 460.152, 362.680, 246.049]", "[461.629, 460.152]"), "cam0"),
        (("- [0.0, 0.0, -1.0, 0.0005]", "- [0.0, 0.9, -1.0, 0.0005]"), "no rotation"),
        (("cam0:", "eye0:"), "camera_matrix"),
    ],
)
def test_what_cannot_be_read_is_reported(change: tuple[str, str], said: str, tmp_path: Path) -> None:
    (tmp_path / "chain.yaml").write_text(KALIBR.replace(*change))
    with pytest.raises(CalibrationError, match=said):
        load_cameras(tmp_path / "chain.yaml")


def test_the_command_goes_from_any_to_any(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cameras = rig(2)
    save_opencv(cameras, tmp_path / "cameras.yml")
    command = ["export", str(tmp_path / "cameras.yml"), "--kalibr", str(tmp_path / "chain.yaml"), "--json"]
    assert cli.invoke(command) == 0
    assert json.loads(capsys.readouterr().out)["cameras"] == ["eye0", "eye1"]
    assert load_kalibr(tmp_path / "chain.yaml") == cameras
    assert cli.invoke(["export", str(tmp_path / "none.yml"), "--opencv", str(tmp_path / "x.yml")]) != 0
    assert "none.yml" in capsys.readouterr().err
