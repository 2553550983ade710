"""The arm before its background as pybullet renders it: slow, so refreshed seldom; the markers are drawn over it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo_sim.physics import PhysicsError, import_pybullet, load_robot
from stereoservo_sim.rig import PinholeCamera
from stereoservo_sim.robots import Robot

FloatArray = npt.NDArray[np.float64]
ImageArray = npt.NDArray[np.uint8]

SHRINK = 2  # rendered at half size and enlarged: a quarter of the cost, and the lens would blur it anyway
NEAR, FAR = 0.05, 8.0  # clipping planes [m]
REFRESH_FRAMES = 15
REFRESH_MOVE = 0.05  # [rad] that some joint must have moved
BRIGHTNESS = 0.6  # of what pybullet's lamp gives


class PybulletBackdrop:
    """Grey images of the arm by pybullet's own renderer, kept until the arm has moved and time has passed."""

    def __init__(self, robot: Robot, camera: PinholeCamera) -> None:
        self._bullet = import_pybullet()
        self._client = self._bullet.connect(self._bullet.DIRECT)
        if self._client < 0:
            raise PhysicsError("pybullet refuses another simulation in this process")
        self._robot = robot
        self._arm = load_robot(self._bullet, self._client, robot)
        floor = self._bullet.createVisualShape(
            self._bullet.GEOM_BOX,
            halfExtents=[3, 3, 0.01],
            rgbaColor=[0.35, 0.35, 0.38, 1],
            physicsClientId=self._client,
        )
        self._bullet.createMultiBody(
            baseVisualShapeIndex=floor, basePosition=[0, 0, -0.01], physicsClientId=self._client
        )
        self._camera = camera
        self._view = (np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.world_to_camera).T.ravel().tolist()
        self._projection = projection_matrix(camera).T.ravel().tolist()
        self._age = 0
        self._q: FloatArray | None = None
        self._image: ImageArray | None = None

    def image(self, q: FloatArray) -> ImageArray:
        """The backdrop (height, width) with the arm about at ``q`` (n,) [rad]: not older than it must be."""
        self._age += 1
        moved = self._q is None or float(np.abs(q - self._q).max()) > REFRESH_MOVE
        if self._image is None or (moved and self._age >= REFRESH_FRAMES):
            self._image, self._q, self._age = self._render(q), q.copy(), 0
        return self._image

    def _render(self, q: FloatArray) -> ImageArray:
        for joint, position in enumerate(q.tolist()):
            self._bullet.resetJointState(self._arm, joint, position, physicsClientId=self._client)
        camera = self._camera
        _, _, rgba, _, _ = self._bullet.getCameraImage(
            camera.width // SHRINK, camera.height // SHRINK, viewMatrix=self._view, projectionMatrix=self._projection,
            shadow=0, renderer=self._bullet.ER_TINY_RENDERER, physicsClientId=self._client,
        )  # fmt: skip
        grey = (
            np.reshape(rgba, (camera.height // SHRINK, camera.width // SHRINK, 4))[..., :3].mean(axis=-1)
            * BRIGHTNESS
        )
        enlarged = cv2.resize(
            grey.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_LINEAR
        )
        return np.asarray(np.clip(enlarged, 0, 255), dtype=np.uint8)


def projection_matrix(camera: PinholeCamera) -> FloatArray:
    """OpenGL projection (4, 4) of a pinhole whose pixels are centred on integers."""
    (fx, _, cx), (_, fy, cy) = camera.K[0], camera.K[1]
    return np.array(
        [
            [2 * fx / camera.width, 0, 1 - 2 * (cx + 0.5) / camera.width, 0],
            [0, 2 * fy / camera.height, 2 * (cy + 0.5) / camera.height - 1, 0],
            [0, 0, -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)],
            [0, 0, -1, 0],
        ]
    )
