"""Import and export of a rig's cameras in the files of other programs: OpenCV's FileStorage YAML, ROS ``camera_info``
YAML (of camera_calibration_parsers) and Kalibr's camera chain.

All of them have integer pixel coordinates at pixel centres and distortion as in OpenCV (``plumb_bob``, ``radtan``), so
that numbers are copied unchanged; floats are written with 17 digits, which restores them exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from stereoservo.calibration.camera_rig.rig_calibration import RigCamera
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.numerics.arrays import FloatArray

ROTATION = 1e-6
"""Largest deviation of ``Rᵀ R`` from the identity that is accepted for a rotation in a file."""


def save_opencv(cameras: Sequence[RigCamera], path: Path) -> None:
    """Write ``camera_name1``, ``image_width1``, ``image_height1``, ``M1``, ``D1`` and so on, and for each camera but
    the first ``R2``, ``T2`` from the first one's frame; for a pair these are ``R`` and ``T``, as by stereoCalibrate.

    Raises CalibrationError (``bad_file``).
    """
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_FORMAT_YAML)
    if not storage.isOpened():
        raise CalibrationError("bad_file", f"{path} cannot be written")
    for k, camera in enumerate(cameras, start=1):
        storage.write(f"camera_name{k}", camera.name)
        storage.write(f"image_width{k}", camera.width)
        storage.write(f"image_height{k}", camera.height)
        storage.write(f"M{k}", camera.matrix)
        storage.write(f"D{k}", np.array([camera.distortion]))
        if k > 1:
            suffix = "" if len(cameras) == 2 else str(k)
            storage.write(f"R{suffix}", np.array(camera.rotation))
            storage.write(f"T{suffix}", np.array(camera.translation).reshape(3, 1))
    storage.release()


def load_opencv(path: Path) -> tuple[RigCamera, ...]:
    """Cameras from a file of `save_opencv`, of OpenCV's stereo sample (M1, D1, …, R, T), or of its calibration sample
    (camera_matrix, distortion_coefficients). Raises CalibrationError (``bad_file``).
    """
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except cv2.error as error:
        raise _bad(path, f"OpenCV cannot read it: {error}") from error
    if not storage.isOpened():
        raise _bad(path, "OpenCV cannot open it")

    def matrix(*names: str) -> FloatArray | None:
        for name in names:
            node = storage.getNode(name)
            if not node.empty() and node.mat() is not None:
                return np.asarray(node.mat(), dtype=np.float64)
        return None

    def number(name: str, k: int) -> int:
        node = next((n for n in (storage.getNode(f"{name}{k}"), storage.getNode(name)) if not n.empty()), None)
        return 0 if node is None else int(node.real())

    if (single := matrix("camera_matrix")) is not None:
        size = number("image_width", 1), number("image_height", 1)
        return (_camera(path, "camera", size, single, matrix("distortion_coefficients"), None, None),)
    cameras: list[RigCamera] = []
    while (K := matrix(f"M{len(cameras) + 1}")) is not None:
        k = len(cameras) + 1
        name = storage.getNode(f"camera_name{k}")
        pair = ("R", "T") if k == 2 else ()
        R, t = (matrix(f"{one}{k}") if not pair or matrix(one) is None else matrix(one) for one in "RT")
        cameras.append(
            _camera(
                path,
                name.string() if not name.empty() else f"camera{k}",
                (number("image_width", k), number("image_height", k)),
                K,
                matrix(f"D{k}"),
                R if k > 1 else None,
                t if k > 1 else None,
            )
        )
    if not cameras:
        raise _bad(path, "it has neither camera_matrix nor M1")
    return tuple(cameras)


def save_ros(cameras: Sequence[RigCamera], folder: Path) -> list[Path]:
    """Write ``CAMERA.yaml`` for each camera, as camera_calibration_parsers does; for a pair with its rectification,
    which contains the relative pose. The format cannot represent the poses of more than two cameras.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rectified = (
        _rectified(cameras)
        if len(cameras) == 2
        else [(np.eye(3), np.hstack([camera.matrix, np.zeros((3, 1))])) for camera in cameras]
    )
    written = []
    for camera, (R, P) in zip(cameras, rectified, strict=True):
        tree = {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_name": camera.name,
            "camera_matrix": _ros_matrix(camera.matrix),
            "distortion_model": "plumb_bob",
            "distortion_coefficients": _ros_matrix(np.array([_padded(camera.distortion)])),
            "rectification_matrix": _ros_matrix(R),
            "projection_matrix": _ros_matrix(P),
        }
        path = folder / f"{camera.name}.yaml"
        path.write_text(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=100))
        written.append(path)
    return written


def load_ros(paths: Sequence[Path]) -> tuple[RigCamera, ...]:
    """Cameras from ``camera_info`` files, the first one the reference. Relative poses follow from the rectification,
    for pairs whose second projection states a baseline. Raises CalibrationError (``bad_file``).
    """
    cameras: list[RigCamera] = []
    first: FloatArray | None = None
    for path in paths:
        tree = _tree(path)
        if tree.get("distortion_model", "plumb_bob") != "plumb_bob":
            raise _bad(path, f"distortion model {tree['distortion_model']!r}; plumb_bob is valid")
        K, D, R1, P = (
            _numbers(path, tree, key)
            for key in (
                "camera_matrix",
                "distortion_coefficients",
                "rectification_matrix",
                "projection_matrix",
            )
        )
        R1, P = R1.reshape(3, 3), P.reshape(3, 4)
        R, t = None, None
        if first is None:
            first = R1
        elif P[0, 3] != 0.0:
            R = R1.T @ first
            t = R1.T @ np.array([P[0, 3] / P[0, 0], 0.0, 0.0])
        size = int(tree["image_width"]), int(tree["image_height"])
        cameras.append(_camera(path, str(tree["camera_name"]), size, K.reshape(3, 3), D, R, t))
    return tuple(cameras)


def save_kalibr(cameras: Sequence[RigCamera], path: Path) -> None:
    """Write a camera chain; each pose is relative to the previous camera. Raises CalibrationError (``bad_file``) for a
    third radial term, which ``radtan`` does not have.
    """
    tree = {}
    for k, camera in enumerate(cameras):
        if any(camera.distortion[4:]):
            raise CalibrationError(
                "bad_file",
                f"camera {camera.name!r} has a third radial term; Kalibr's radtan has k1, k2, p1, p2",
            )
        others = [n for n in range(len(cameras)) if n != k]
        one: dict[str, Any] = {
            "cam_overlaps": others,
            "camera_model": "pinhole",
            "distortion_coeffs": list(_padded(camera.distortion)[:4]),
            "distortion_model": "radtan",
            "intrinsics": [*camera.focal, *camera.centre],
            "resolution": [camera.width, camera.height],
            "rostopic": f"/{camera.name}/image_raw",
        }
        if k:
            before = cameras[k - 1].motion
            step = camera.motion if k == 1 else camera.motion @ np.linalg.inv(before)
            one = {"T_cn_cnm1": step.tolist(), **one}
        tree[f"cam{k}"] = one
    path.write_text(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=100))


def load_kalibr(path: Path) -> tuple[RigCamera, ...]:
    """Cameras from a chain. Raises CalibrationError (``bad_file``)."""
    cameras: list[RigCamera] = []
    tree, motion = _tree(path), np.eye(4)
    while (one := tree.get(f"cam{len(cameras)}")) is not None:
        k = len(cameras)
        kind = one.get("camera_model"), one.get("distortion_model")
        if kind not in (("pinhole", "radtan"), ("pinhole", "none")):
            raise _bad(path, f"cam{k} is {kind[0]}-{kind[1]}; pinhole-radtan and pinhole-none are valid")
        try:
            fx, fy, cx, cy = (float(value) for value in one["intrinsics"])
            size = int(one["resolution"][0]), int(one["resolution"][1])
            D = np.array([float(value) for value in one.get("distortion_coeffs", ())])
            if k:
                step = np.array(one["T_cn_cnm1"], dtype=np.float64).reshape(4, 4)
                motion = step if k == 1 else step @ motion
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise _bad(path, f"cam{k}: {error!r}") from error
        name = str(one.get("rostopic", f"/cam{k}")).strip("/").split("/")[0]
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        R, t = (motion[:3, :3], motion[:3, 3]) if k else (None, None)
        cameras.append(_camera(path, name, size, K, D, R, t))
    if not cameras:
        raise _bad(path, "it has no cam0")
    return tuple(cameras)


def load_cameras(path: Path) -> tuple[RigCamera, ...]:
    """Cameras from a file of any of these formats; for a folder, from its ``camera_info`` files, sorted by name.

    Raises CalibrationError (``bad_file``).
    """
    if path.is_dir():
        files = sorted([*path.glob("*.yaml"), *path.glob("*.yml")])
        if not files:
            raise _bad(path, "the folder has no *.yaml; one camera_info file a camera is needed")
        return load_ros(files)
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise _bad(path, str(error)) from error
    if "opencv-matrix" in text:
        return load_opencv(path)
    if "cam0" in _tree(path):
        return load_kalibr(path)
    return load_ros([path])


# -- parts --------------------------------------------------------------------------------------------------


def _rectified(cameras: Sequence[RigCamera]) -> list[tuple[FloatArray, FloatArray]]:
    """Rectifying rotations (3, 3) and projections (3, 4) of a pair: the common x axis along the baseline, z between
    the optical axes, one focal length.
    """
    first, second = cameras
    R, t = np.array(second.rotation), np.array(second.translation)
    baseline = -R.T @ t
    x = baseline / np.linalg.norm(baseline)
    x = x if x[0] >= 0 else -x
    mean_axis = np.array([0.0, 0.0, 1.0]) + R[2]
    y = np.cross(mean_axis, x)
    y /= np.linalg.norm(y)
    left = np.array([x, y, np.cross(x, y)])
    right = left @ R.T
    f = float(np.mean([*first.focal, *second.focal]))
    cx, cy = (first.width - 1) / 2, (first.height - 1) / 2
    P = np.array([[f, 0.0, cx, 0.0], [0.0, f, cy, 0.0], [0.0, 0.0, 1.0, 0.0]])
    shifted = P.copy()
    shifted[0, 3] = f * float((right @ t)[0])
    return [(left, P), (right, shifted)]


def _ros_matrix(matrix: FloatArray) -> dict[str, Any]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": matrix.ravel().tolist()}


def _padded(distortion: Sequence[float]) -> tuple[float, ...]:
    return (*distortion, *(0.0,) * (5 - len(distortion)))


def _tree(path: Path) -> dict[str, Any]:
    try:
        tree = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise _bad(path, str(error)) from error
    if not isinstance(tree, dict):
        raise _bad(path, "it holds no mapping")
    return tree


def _numbers(path: Path, tree: dict[str, Any], key: str) -> FloatArray:
    try:
        return np.array([float(value) for value in tree[key]["data"]])
    except (KeyError, TypeError, ValueError) as error:
        raise _bad(path, f"{key}: {error!r}") from error


def _camera(
    path: Path,
    name: str,
    size: tuple[int, int],
    K: FloatArray,
    D: FloatArray | None,
    R: FloatArray | None,
    t: FloatArray | None,
) -> RigCamera:
    distortion = [] if D is None else D.ravel().tolist()
    if len(distortion) > 5 and any(distortion[5:]):
        raise _bad(path, f"camera {name!r} has {len(distortion)} coefficients; k1, k2, p1, p2, k3 are valid")
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 1] != 0.0:
        raise _bad(path, f"camera {name!r}: a finite camera matrix (3, 3) without skew is needed, got {K.tolist()}")
    R = np.eye(3) if R is None else R
    if not np.abs(R.T @ R - np.eye(3)).max() < ROTATION or np.linalg.det(R) < 0:
        raise _bad(path, f"camera {name!r}: {R.tolist()} is no rotation")
    x, y, z = (0.0, 0.0, 0.0) if t is None else t.ravel().tolist()
    kept = distortion[:5] if len(distortion) >= 5 and distortion[4] != 0.0 else [*distortion, 0.0, 0.0, 0.0, 0.0][:4]
    return RigCamera(
        name,
        *size,
        (float(K[0, 0]), float(K[1, 1])),
        (float(K[0, 2]), float(K[1, 2])),
        tuple(kept),
        tuple(map(tuple, R.tolist())),
        (x, y, z),
    )


def _bad(path: Path, why: str) -> CalibrationError:
    return CalibrationError("bad_file", f"{path} is no file of cameras of OpenCV, ROS or Kalibr: {why}")
