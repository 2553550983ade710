"""Simulated cameras: pinholes with radial lens distortion. Pixels: integer = pixel centre.

Ideal pixels are those of a pinhole (``K`` times rays); raw pixels are those of the distorted image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stereoservo.geometry.distortion import distort
from stereoservo.numerics.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A camera: ``K`` (3, 3) [px], ``world_to_camera`` (4, 4) [m], image size [px], Brown's ``k1`` about the
    principal point (0: a pinhole; with OpenCV ``distCoeffs = (k1, 0, 0, 0)``).
    """

    name: str
    K: FloatArray
    world_to_camera: FloatArray
    width: int
    height: int
    k1: float = 0.0

    @property
    def lens(self) -> FloatArray:
        """Lens parameters ``(k, cu, cv, r0)`` (4,) as in `stereoservo.geometry.distortion`, for square pixels."""
        r0 = 0.5 * self.width
        return np.array([self.k1 * r0**2 / (self.K[0, 0] * self.K[1, 1]), self.K[0, 2], self.K[1, 2], r0])

    @property
    def sees_whole_image(self) -> bool:
        """Whether the distorted image covers every corner; with a strong negative ``k1`` it ends before."""
        return self.k1 > self.least_k1

    @property
    def least_k1(self) -> float:
        """The least ``k1`` with which the distorted image just reaches the farthest corner: there 27/4 |k| s² = 1, with
        s the raw radius.
        """
        right, bottom = self.width - 0.5, self.height - 0.5
        corners = np.array([(-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)])
        farthest = ((corners - self.K[:2, 2]) ** 2).sum(axis=1).max() / (self.K[0, 0] * self.K[1, 1])
        return float(-4.0 / (27.0 * farthest))

    def image_of(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Raw pixels (n, 2) and depths (n,) [m] of points (n, 3) in the world; NaN beyond the distortion's fold."""
        ideal, depths = project(self.P, points)
        return (distort(self.lens, ideal) if self.k1 != 0.0 else ideal), depths

    def moved(self, pose: FloatArray) -> PinholeCamera:
        """This camera in the world, if it is mounted in a frame of ``pose`` (4, 4) in the world."""
        return replace(self, world_to_camera=self.world_to_camera @ inverse_pose(pose))

    def moved_by(self, displacement: FloatArray) -> PinholeCamera:
        """This camera after ``displacement`` (4, 4), in its own frame."""
        return replace(self, world_to_camera=inverse_pose(displacement) @ self.world_to_camera)

    def focused(self, factor: float) -> PinholeCamera:
        """This camera with its focal length multiplied by ``factor``."""
        if factor == 1.0:
            return self
        K = self.K.copy()
        K[:2, :2] *= factor
        return replace(self, K=K)

    @property
    def P(self) -> FloatArray:
        """Projection matrix from the world to ideal pixels, (3, 4)."""
        return self.K @ self.world_to_camera[:3]

    @property
    def centre(self) -> FloatArray:
        """Optical centre in the world, (3,) [m]."""
        R, t = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -R.T @ t


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Stereo rig: cameras, left first, and the rig's own frame (origin mid-baseline, x along it, z towards the scene).

    Poses are from the world, or from the flange that carries the rig.
    """

    cameras: tuple[PinholeCamera, ...]
    world_to_rig: FloatArray

    def camera(self, name: str) -> PinholeCamera:
        """The camera called ``name``. Raises KeyError."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise KeyError(f"no camera {name!r} in the simulated rig; cameras: {', '.join(c.name for c in self.cameras)}")


def inverse_pose(pose: FloatArray) -> FloatArray:
    """Inverse (4, 4) of a rigid pose."""
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse


def project(P: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ideal pixels (n, 2) and depths (n,) of ``points`` (n, 3) under ``P`` (3, 4)."""
    h = points @ P[:, :3].T + P[:, 3]
    return h[:, :2] / h[:, 2:], h[:, 2]


def look_at(eye: FloatArray, target: FloatArray, up: FloatArray) -> FloatArray:
    """World-to-camera pose (4, 4) of a camera at ``eye`` aimed at ``target``; image y points against ``up``."""
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
    """Rig of two equal cameras, each rotated inwards by half of ``vergence`` [rad], ``baseline`` [m] apart."""
    K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    cameras = []
    for name, side in zip(names, (-1.0, 1.0), strict=True):
        c, s = np.cos(vergence / 2), side * np.sin(vergence / 2)
        rig_to_camera = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
        rig_to_camera[:3, 3] = -rig_to_camera[:3, :3] @ np.array([side * baseline / 2, 0, 0])
        cameras.append(PinholeCamera(name, K, rig_to_camera @ world_to_rig, *size))
    return StereoRig(cameras=tuple(cameras), world_to_rig=world_to_rig)
