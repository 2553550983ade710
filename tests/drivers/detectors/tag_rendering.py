"""Exact pictures of printed tags for tests: the print is looked up at many points of each pixel."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from .rendering import digitise, look, project

Array = npt.NDArray[np.float64]
FINE = 8
"""Points a pixel and axis, at which the print is looked up and the lens blurs it."""
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def printed(constant: int, tag: int) -> Array:
    """Brightness (n + 2, n + 2) of the print, one white cell of margin about it: 0 black, 1 white."""
    dictionary = cv2.aruco.getPredefinedDictionary(constant)
    cells = cv2.aruco.generateImageMarker(dictionary, tag, dictionary.markerSize + 2)
    return np.pad(np.asarray(cells) / 255.0, 1, constant_values=1.0)


@dataclass
class TagScene:
    """Prints (brightness, homography (3, 3) from the tag's unit square to pixels), far ones first."""

    tags: list[tuple[Array, Array]] = field(default_factory=list)
    size: tuple[int, int] = (640, 480)
    black: float = 30.0
    white: float = 215.0
    wall: float = 110.0
    lens_blur: float = 0.7
    """Gaussian blur [px] before pixels are sampled."""
    noise: float = 0.0
    gradient: float = 0.0
    """Illumination lost linearly from the left border to the right one, as a fraction."""

    def clean(self) -> Array:
        """The picture before noise and rounding (h, w)."""
        width, height = self.size
        image = np.full((height, width), self.wall)
        for brightness, H in self.tags:
            self._draw(image, brightness, H)
        return image * (1.0 - self.gradient * np.arange(width) / (width - 1))

    def _draw(self, image: Array, brightness: Array, H: Array) -> None:
        width, height = self.size
        n = len(brightness) - 2
        margin = 1.0 / n
        outline = project(H, CORNERS * (1 + 2 * margin) - margin)
        room = int(np.ceil(4 * self.lens_blur)) + 2
        u0, v0 = np.maximum(np.floor(outline.min(axis=0)).astype(int) - room, 0)
        u1, v1 = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + room + 1, [width, height])
        fine_u = u0 - 0.5 + (np.arange((u1 - u0) * FINE) + 0.5) / FINE
        fine_v = v0 - 0.5 + (np.arange((v1 - v0) * FINE) + 0.5) / FINE
        B = np.linalg.inv(H).astype(np.float32)
        U, V = fine_u[None].astype(np.float32), fine_v[:, None].astype(np.float32)
        w = B[2, 0] * U + B[2, 1] * V + B[2, 2]
        x = np.floor((B[0, 0] * U + B[0, 1] * V + B[0, 2]) / w * n).astype(int) + 1
        y = np.floor((B[1, 0] * U + B[1, 1] * V + B[1, 2]) / w * n).astype(int) + 1
        inside = (x >= 0) & (x < n + 2) & (y >= 0) & (y < n + 2)
        below = np.kron(image[v0:v1, u0:u1].astype(np.float32), np.ones((FINE, FINE), np.float32))
        levels = (self.black + (self.white - self.black) * brightness).astype(np.float32)
        below[inside] = levels[y[inside], x[inside]]
        if self.lens_blur:
            below = cv2.GaussianBlur(below, (0, 0), self.lens_blur * FINE, borderType=cv2.BORDER_REPLICATE)
        image[v0:v1, u0:u1] = below.reshape(v1 - v0, FINE, u1 - u0, FINE).mean(axis=(1, 3))

    def render(self, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
        """The picture as a camera delivers it (h, w) uint8."""
        return digitise(self.clean(), self.noise, rng)


def tag_view(side_px: float, tilt_deg: float, azimuth: float, roll: float, at: tuple[float, float]) -> Array:
    """Homography (3, 3) of the unit square of a tag whose middle is seen at pixel ``at``; angles [rad] but the tilt.

    It stands 1 m away from a camera of 1000 px focal length and is ``side_px`` [mm] wide.
    """
    H = look(np.radians(tilt_deg), azimuth, roll, 1.0, at)
    side = side_px / 1000.0
    return H @ np.array([[side, 0, -side / 2], [0, side, -side / 2], [0, 0, 1.0]])
