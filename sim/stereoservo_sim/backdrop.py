"""What stands behind the markers, drawn seldom: a room, or an even grey; `pybullet_backdrop` has one with the arm."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo_sim.rig import PinholeCamera
from stereoservo_sim.world import SimulatedCell

FloatArray = npt.NDArray[np.float64]
ImageArray = npt.NDArray[np.uint8]

REFRESH_FRAMES = 15
REFRESH_MOVE = 0.05  # [rad] that some joint must have moved
PLAIN_LEVEL = 90


class Backdrop:
    """Grey images that cost too much for every frame: kept until the arm has moved and time has passed."""

    def __init__(self) -> None:
        self._age = 0
        self._q: FloatArray | None = None
        self._image: ImageArray | None = None

    def draw(self, q: FloatArray) -> ImageArray:
        """The image (height, width) with the arm at ``q`` (n,) [rad]."""
        raise NotImplementedError

    def image(self, q: FloatArray) -> ImageArray:
        """The image (height, width) with the arm about at ``q`` (n,) [rad]: not older than it must be."""
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
        """The room; drawn once for a camera that stands."""
        if self._image is not None and self._cell.stand is None:
            return self._image
        return super().image(q)

    def draw(self, q: FloatArray) -> ImageArray:
        """The room from where the camera is with the arm at ``q`` (n,) [rad]."""
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
    """An even grey."""

    def __init__(self, camera: PinholeCamera) -> None:
        super().__init__()
        self._image = np.full((camera.height, camera.width), PLAIN_LEVEL, dtype=np.uint8)

    def image(self, q: FloatArray) -> ImageArray:
        """The same for any ``q``."""
        assert self._image is not None
        return self._image
