"""The arm as pybullet renders it, before its background: slow, so drawn seldom; the markers are drawn over it."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo_sim.backdrop import Backdrop
from stereoservo_sim.physics import PhysicsError, import_pybullet, load_robot
from stereoservo_sim.rig import PinholeCamera
from stereoservo_sim.world import SimulatedCell

FloatArray = npt.NDArray[np.float64]
ImageArray = npt.NDArray[np.uint8]

SHRINK = 2  # rendered at half size and enlarged: a quarter of the cost, and the lens would blur it anyway
NEAR, FAR = 0.05, 8.0  # clipping planes [m]
BRIGHTNESS = 0.6  # of what pybullet's lamp gives


class PybulletBackdrop(Backdrop):
    """The arm by pybullet's own renderer, as a pinhole ``camera`` of the cell's rig sees it."""

    def __init__(self, cell: SimulatedCell, camera: PinholeCamera) -> None:
        super().__init__()
        self._bullet = import_pybullet()
        self._client = self._bullet.connect(self._bullet.DIRECT)
        if self._client < 0:
            raise PhysicsError("pybullet refuses another simulation in this process")
        self._cell = cell
        self._arm = load_robot(self._bullet, self._client, cell.robot)
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
        self._projection = projection_matrix(camera).T.ravel().tolist()

    def draw(self, q: FloatArray) -> ImageArray:
        """The arm at ``q`` (n,) [rad]."""
        for joint, position in enumerate(q.tolist()):
            self._bullet.resetJointState(self._arm, joint, position, physicsClientId=self._client)
        camera = self._cell.in_world(self._camera, q)
        view = (np.diag([1.0, -1.0, -1.0, 1.0]) @ camera.world_to_camera).T.ravel().tolist()
        _, _, rgba, _, _ = self._bullet.getCameraImage(
            camera.width // SHRINK, camera.height // SHRINK, viewMatrix=view, projectionMatrix=self._projection,
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
