"""Pictures of textured planes, every pixel of which is the image of a known point of a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray
from stereoservo_sim.world.camera_rig import PinholeCamera

LAYERS = ((30.0, 1.0), (22.0, 2.5), (14.0, 7.0))
"""Contrast [grey levels] and coarseness, relative to the finest, of what a texture is made of."""
MEAN_GREY, BACKGROUND = 125.0, 60.0


def texture(rng: np.random.Generator, side: int = 256, scale: float = 1.6) -> FloatArray:
    """Grey levels (side, side) without edges finer than ``scale`` texels, and with coarser things among them."""
    image = np.full((side, side), MEAN_GREY)
    for contrast, factor in LAYERS:
        field = gaussian_filter(rng.normal(size=(side, side)), scale * factor)
        image += contrast * field / field.std()
    return image


@dataclass(frozen=True, eq=False)
class Face:
    """A parallelogram with ``grey`` (s, s) on it, spanned by ``origin``, ``across``, ``down`` (3,) [m]."""

    grey: FloatArray
    origin: FloatArray
    across: FloatArray
    down: FloatArray

    def texels(self, P: FloatArray, shift: FloatArray) -> FloatArray:
        """Homography (3, 3) from texels to pixels of a camera ``P`` (3, 4), the face moved by ``shift`` (3,) [m]."""
        side = self.grey.shape[0]
        columns = np.column_stack([self.across / (side - 1), self.down / (side - 1), self.origin + shift])
        return np.asarray(P @ np.vstack([columns, [0.0, 0.0, 1.0]]))


@dataclass(frozen=True, eq=False)
class TexturedBody:
    """A body of ``faces``; nearer ones hide those behind, pixel by pixel."""

    faces: Sequence[Face]

    def picture(
        self, camera: PinholeCamera, shift: FloatArray, rng: np.random.Generator, noise_grey: float
    ) -> ImageArray:
        """Image (h, w) with the body moved by ``shift`` (3,) [m], all of it before the camera (ValueError)."""
        grey = self._layers(camera, shift)[0]
        grey = grey + rng.normal(0.0, noise_grey, grey.shape)
        return np.asarray(np.clip(np.rint(grey), 0, 255).astype(np.uint8))

    def points(self, camera: PinholeCamera, pixels: FloatArray, shift: FloatArray) -> FloatArray:
        """Points (m, 3) [m] of the body, moved by ``shift`` (3,), that are seen at ``pixels`` (m, 2), NaN where
        there is background.
        """
        _, owner = self._layers(camera, shift)
        u, v = np.rint(pixels).astype(int).T
        found = np.full((len(pixels), 3), np.nan)
        for k, face in enumerate(owner[v, u].tolist()):
            if face < 0:
                continue
            one = self.faces[face]
            x, y, w = np.linalg.solve(one.texels(camera.P, shift), np.append(pixels[k], 1.0))
            side = one.grey.shape[0] - 1
            found[k] = one.origin + shift + one.across * x / w / side + one.down * y / w / side
        return found

    def _layers(self, camera: PinholeCamera, shift: FloatArray) -> tuple[FloatArray, IntArray]:
        """Grey levels (h, w) and the face that is seen (h, w), -1 for none."""
        shape = camera.height, camera.width
        image, nearest = np.full(shape, BACKGROUND), np.full(shape, np.inf)
        owner = np.full(shape, -1, np.int64)
        for f, face in enumerate(self.faces):
            H, side = face.texels(camera.P, shift), face.grey.shape[0] - 1
            left, top, right, bottom = _box(H, side, camera)
            v, u = np.mgrid[top:bottom, left:right]
            texel = np.linalg.solve(H, np.stack([u.ravel(), v.ravel(), np.ones(u.size)]))
            # Of the scaled ray that is the depth of the camera, since K's last row is (0, 0, 1).
            depth = 1.0 / texel[2]
            x, y = texel[:2] / texel[2]
            window = slice(top, bottom), slice(left, right)
            seen = (x >= 0) & (y >= 0) & (x <= side) & (y <= side) & (depth < nearest[window].ravel())
            part = seen.reshape(u.shape)
            grey = map_coordinates(face.grey, [y[seen], x[seen]], order=3, mode="nearest")
            image[window][part], nearest[window][part], owner[window][part] = grey, depth[seen], f
        return image, owner


def _box(H: FloatArray, side: int, camera: PinholeCamera) -> tuple[int, int, int, int]:
    """Left, top, right, bottom [px] of the image of a face, right and bottom beyond; of one before the camera."""
    corners = np.array([[0, 0, 1], [side, 0, 1], [side, side, 1], [0, side, 1.0]]) @ H.T
    if corners[:, 2].min() <= 0.0:
        raise ValueError(
            "a face reaches behind the camera; all corners of a textured body must lie before it"
        )
    ends = corners[:, :2] / corners[:, 2:]
    size = [camera.width, camera.height]
    low = np.clip(np.floor(ends.min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil(ends.max(axis=0)) + 1, 0, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
