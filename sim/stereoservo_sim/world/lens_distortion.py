"""Lens distortion of simulated images: outlines and whole images from ideal to raw pixels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from stereoservo.geometry.distortion import distort, undistort
from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo_sim.world.camera_rig import PinholeCamera

CIRCLE_POINTS = 40
"""Corners of the polygon that represents a dot: with its area, the centre of its image is right to 1e-4 px."""
PIECE_PX = 20.0
"""Length up to which a piece of an outline's edge stays straight."""
MOST_PIECES = 64
"""Of one edge, which may reach far out of the picture."""


def unit_circle() -> FloatArray:
    """Corners (CIRCLE_POINTS, 2) of a regular polygon about the origin with the unit circle's area."""
    angles = np.linspace(0.0, 2.0 * np.pi, CIRCLE_POINTS, endpoint=False)
    step = 2.0 * np.pi / CIRCLE_POINTS
    corners: FloatArray = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return corners * float(np.sqrt(step / np.sin(step)))


def bend_outline(camera: PinholeCamera, outline: FloatArray) -> FloatArray:
    """A polygon (k, 2) in ideal pixels, distorted by the lens of ``camera``, its edges finely divided.

    Corners beyond the lens's fold stay at the rim of what it images: outside of the picture, whose corners it reaches.
    """
    ways = np.roll(outline, -1, axis=0) - outline
    pieces = np.clip(np.ceil(np.linalg.norm(ways, axis=1) / PIECE_PX), 1, MOST_PIECES).astype(int)
    share = np.concatenate([np.arange(n) / n for n in pieces])[:, None]
    fine = np.repeat(outline, pieces, axis=0) + share * np.repeat(ways, pieces, axis=0)
    k, centre, r0 = camera.lens[0], camera.lens[1:3], camera.lens[3]
    offset = fine - centre
    if k < 0.0:
        rim = 0.999 * r0 * np.sqrt(-1.0 / (3.0 * k))
        reach = np.linalg.norm(offset, axis=1, keepdims=True)
        offset = offset * np.minimum(1.0, rim / np.maximum(reach, 1e-9))
    return distort(camera.lens, centre + offset)


class BentImage:
    """Distorts the image of ``pinhole``, a larger one without distortion at the same pose, into a camera's image."""

    def __init__(self, camera: PinholeCamera) -> None:
        """Raises ValueError where the lens's image ends inside the image."""
        if not camera.sees_whole_image:
            raise ValueError(f"camera {camera.name!r}: k1 = {camera.k1:g} leaves the image's corners dark")
        self.camera = camera
        self.bends = camera.k1 != 0.0
        self.origin = np.zeros(2)
        self.pinhole = camera
        self._source: ImageArray | None = None
        self._bent: ImageArray | None = None
        if not self.bends:
            return
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
        ideal = undistort(camera.lens, np.stack([u, v], axis=-1))
        self.origin = np.floor(ideal.min(axis=(0, 1)))
        size = np.ceil((ideal.max(axis=(0, 1)) - self.origin + 2.0) / 2.0).astype(int) * 2
        K = camera.K.copy()
        K[:2, 2] -= self.origin
        self.pinhole = replace(camera, K=K, width=int(size[0]), height=int(size[1]), k1=0.0)
        self._map = cv2.convertMaps((ideal - self.origin).astype(np.float32), None, cv2.CV_16SC2)

    def image(self, source: ImageArray) -> ImageArray:
        """Distort the pinhole's image; the last result is cached."""
        if not self.bends:
            return source
        if self._bent is None or source is not self._source:
            bent = cv2.remap(source, *self._map, interpolation=cv2.INTER_LINEAR)
            self._source, self._bent = source, np.asarray(bent, dtype=np.uint8)
        return self._bent

    def outline(self, corners: FloatArray) -> FloatArray:
        """Distort a polygon (k, 2) of the pinhole's image."""
        return bend_outline(self.camera, corners + self.origin) if self.bends else corners
