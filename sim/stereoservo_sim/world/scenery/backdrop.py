"""Background images behind the markers, redrawn rarely: a room, a uniform grey, or the arm by pybullet."""

from __future__ import annotations

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo_sim.world.camera_rig import PinholeCamera
from stereoservo_sim.world.simulated_cell import SimulatedCell

REFRESH_FRAMES = 15
REFRESH_MOVE = 0.05  # [rad] that some joint must have moved
PLAIN_LEVEL = 90


class Backdrop:
    """Background images that are too slow for every frame: cached until the arm has moved and time has passed."""

    def __init__(self) -> None:
        self._age = 0
        self._q: FloatArray | None = None
        self._image: ImageArray | None = None

    def draw(self, q: FloatArray) -> ImageArray:
        """The image (height, width) with the arm at ``q`` (n,) [rad]."""
        raise NotImplementedError

    def image(self, q: FloatArray) -> ImageArray:
        """Cached image (height, width) for the arm near ``q`` (n,) [rad]."""
        self._age += 1
        moved = self._q is None or float(np.abs(q - self._q).max()) > REFRESH_MOVE
        if self._image is None or (moved and self._age >= REFRESH_FRAMES):
            self._image, self._q, self._age = self.draw(q), q.copy(), 0
        return self._image


class RoomBackdrop(Backdrop):
    """A wall and a floor, dimmer than the dots and unevenly lit, as a pinhole ``camera`` of the rig sees them."""

    def __init__(self, cell: SimulatedCell, camera: PinholeCamera) -> None:
        super().__init__()
        self._cell = cell
        self._camera = camera

    def image(self, q: FloatArray) -> ImageArray:
        """Image of the room; drawn once for a static camera."""
        if self._image is not None and self._cell.stand is None:
            return self._image
        return super().image(q)

    def draw(self, q: FloatArray) -> ImageArray:
        """Image of the room from the camera's pose with the arm at ``q`` (n,) [rad]."""
        camera = self._cell.in_world(self._camera, q)
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
        wall = 100 + 18 * np.cos(u / camera.width * 2.2) - 12 * v / camera.height
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
        rays = rays @ camera.world_to_camera[:3, :3]
        with np.errstate(divide="ignore"):
            reach = np.where(rays[..., 2] < -1e-3, -camera.centre[2] / rays[..., 2], np.inf)
        ground = camera.centre[:2] + np.where(np.isfinite(reach), reach, 0)[..., None] * rays[..., :2]
        tiles = 82 + 9 * ((np.floor(ground[..., 0] / 0.4) + np.floor(ground[..., 1] / 0.4)) % 2)
        room = np.where(reach < 6.0, tiles, wall)
        return np.asarray(cv2.GaussianBlur(room.astype(np.float32), (0, 0), 1.0)).astype(np.uint8)


class PlainBackdrop(Backdrop):
    """Uniform grey background."""

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__()
        self._image = np.full((camera.height, camera.width), PLAIN_LEVEL, dtype=np.uint8)

    def image(self, q: FloatArray) -> ImageArray:
        """The uniform image, for any ``q``."""
        assert self._image is not None
        return self._image


SHRINK = 2  # rendered at half size and enlarged: a quarter of the cost, and the lens would blur it anyway
NEAR, FAR = 0.05, 8.0  # clipping planes [m]
BRIGHTNESS = 0.6  # of what pybullet's lamp gives


class PybulletBackdrop(Backdrop):
    """Background with the arm by pybullet's renderer, for a pinhole ``camera`` of the cell's rig."""

    def __init__(self, cell: SimulatedCell, camera: PinholeCamera) -> None:
        from stereoservo_sim.world.physics import PhysicsError, import_pybullet, load_robot

        super().__init__()
        self._bullet = import_pybullet()
        self._client = self._bullet.connect(self._bullet.DIRECT)
        if self._client < 0:
            raise PhysicsError("pybullet refuses another simulation in this process")
        self._cell = cell
        self._loaded = load_robot(self._bullet, self._client, cell.robot)
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
        """Image of the arm at ``q`` (n,) [rad]."""
        for joint, position in zip(self._loaded.joints, q.tolist(), strict=True):
            self._bullet.resetJointState(self._loaded.body, joint, position, physicsClientId=self._client)
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
