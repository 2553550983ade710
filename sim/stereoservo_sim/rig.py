"""Simulated cameras: pinholes in the world. Pixels: integer = pixel centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A pinhole: ``K`` (3, 3) [px], ``world_to_camera`` (4, 4) [m], image size [px]."""

    name: str
    K: FloatArray
    world_to_camera: FloatArray
    width: int
    height: int

    @property
    def P(self) -> FloatArray:
        """Projection matrix from the world, (3, 4)."""
        return self.K @ self.world_to_camera[:3]

    @property
    def centre(self) -> FloatArray:
        """Optical centre in the world, (3,) [m]."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -R.T @ t


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Cameras left first, and the rig's own frame: origin mid-baseline, x along it, z towards the scene."""

    cameras: tuple[PinholeCamera, ...]
    world_to_rig: FloatArray

    def camera(self, name: str) -> PinholeCamera:
        """The camera called ``name``. Raises KeyError."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise KeyError(
            f"no camera {name!r} in the simulated rig; cameras: {', '.join(c.name for c in self.cameras)}"
        )


def project(P: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) and depths (n,) of ``points`` (n, 3) under ``P`` (3, 4)."""
    h = points @ P[:, :3].T + P[:, 3]
    return h[:, :2] / h[:, 2:], h[:, 2]


def look_at(eye: FloatArray, target: FloatArray, up: FloatArray) -> FloatArray:
    """World-to-camera pose (4, 4) of a camera at ``eye`` that looks at ``target``; image y points against
    ``up``.
    """
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def stereo_rig(
    world_to_rig: FloatArray,
    *,
    baseline: float = 0.20,
    vergence: float = float(np.deg2rad(20.0)),
    focal: float = 800.0,
    centre: tuple[float, float] = (320.0, 240.0),
    size: tuple[int, int] = (640, 480),
    names: tuple[str, str] = ("left", "right"),
) -> StereoRig:
    """Two equal cameras turned inwards by half of ``vergence`` [rad] each, ``baseline`` [m] apart."""
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    cameras = []
    for name, side in zip(names, (-1.0, 1.0), strict=True):
        c, s = np.cos(vergence / 2), side * np.sin(vergence / 2)
        rig_to_camera = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
        rig_to_camera[:3, 3] = -rig_to_camera[:3, :3] @ np.array([side * baseline / 2, 0, 0])
        cameras.append(PinholeCamera(name, K, rig_to_camera @ world_to_rig, *size))
    return StereoRig(cameras=tuple(cameras), world_to_rig=world_to_rig)
