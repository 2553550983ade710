"""Exact pictures of dots for tests; knows neither the detector nor the simulation.

A dot is a circle in its face's plane; its picture under a homography is a conic. Coverage of a pixel is
exact along u (a scan line meets a conic in a closed-form interval) and a midpoint rule of 32 lines a pixel
along v: centre errors < 2e-4 px.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

LINES = 32
FINE = 4

Array = npt.NDArray[np.float64]


def conic_of_circle(H: Array, centre: Array, radius: float) -> Array:
    """Conic (3, 3) with mᵀCm < 0 inside, of the circle about ``centre`` [plane units] under ``H`` (3, 3)."""
    x, y = centre
    circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius * radius]])
    inverse = np.linalg.inv(H)
    conic: Array = inverse.T @ circle @ inverse
    return conic * np.sign(np.linalg.det(conic[:2, :2]) * 1.0) * np.sign(conic[0, 0])


def project(H: Array, points: Array) -> Array:
    """Points (n, 2) of the plane to pixels (n, 2)."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ H.T
    pixels: Array = homogeneous[:, :2] / homogeneous[:, 2:]
    return pixels


def add_conic(coverage: Array, conic: Array) -> None:
    """Add the coverage of the inside of an ellipse to an image (h, w), 0 to 1."""
    height, width = coverage.shape
    a, b, c = conic[0, 0], conic[0, 1], conic[1, 1]
    d, e, f = conic[0, 2], conic[1, 2], conic[2, 2]
    det = a * c - b * b
    centre_v = (b * d - a * e) / det
    centre_u = (b * e - c * d) / det
    level = -(f + d * centre_u + e * centre_v)
    half_v = np.sqrt(level * a / det)
    first = max(int(np.floor(centre_v - half_v - 0.5)), 0)
    last = min(int(np.ceil(centre_v + half_v + 0.5)), height - 1)
    if last < first:
        return
    lines = (np.arange((last - first + 1) * LINES) + 0.5) / LINES + first - 0.5
    p = b * lines + d
    disc = p * p - a * (c * lines * lines + 2 * e * lines + f)
    hit = disc > 0
    root = np.sqrt(np.where(hit, disc, 0.0))
    left, right = (-p - root) / a, (-p + root) / a
    columns = np.arange(width)
    inside = np.clip(np.minimum(right[:, None], columns + 0.5) - np.maximum(left[:, None], columns - 0.5), 0, 1)
    inside[~hit] = 0
    coverage[first : last + 1] += inside.reshape(last - first + 1, LINES, width).mean(axis=1)


def add_blurred(coverage: Array, conic: Array, sigma: float) -> None:
    """As :func:`add_conic`, blurred by a Gaussian on a grid of FINE points a pixel before it is sampled."""
    height, width = coverage.shape
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    half = np.sqrt(np.diag(np.linalg.inv(conic[:2, :2])) * level) + 5 * sigma + 1
    u0, v0 = np.floor(centre - half).astype(int)
    u1, v1 = np.ceil(centre + half).astype(int) + 1
    # fine pixel i of the patch has its centre at u0 - 1/2 + (i + 1/2) / FINE
    to_pixels = np.array([[1 / FINE, 0, u0 - 0.5 + 0.5 / FINE], [0, 1 / FINE, v0 - 0.5 + 0.5 / FINE], [0, 0, 1]])
    fine = np.zeros(((v1 - v0) * FINE, (u1 - u0) * FINE))
    add_conic(fine, to_pixels.T @ conic @ to_pixels)
    fine = cv2.GaussianBlur(fine, (0, 0), sigma * FINE)
    patch = fine.reshape(v1 - v0, FINE, u1 - u0, FINE).mean(axis=(1, 3))
    a, b, c, d = max(u0, 0), min(u1, width), max(v0, 0), min(v1, height)
    if a < b and c < d:
        coverage[c:d, a:b] += patch[c - v0 : d - v0, a - u0 : b - u0]


@dataclass
class Scene:
    """What is drawn: faces as (homography, positions (n, 2), radius, half_side), then free ellipses
    (conics).
    """

    faces: list[tuple[Array, Array, float, float]] = field(default_factory=list)
    clutter: list[Array] = field(default_factory=list)
    size: tuple[int, int] = (640, 480)
    black: float = 30.0
    white: float = 220.0
    wall: float = 30.0
    blur: float = 0.0
    """Gaussian blur of the sampled picture [px], as a renderer does it: it keeps the aliasing of the
    pixels.
    """
    lens_blur: float = 0.7
    """Gaussian blur of the dots before they are sampled [px], as a lens does it."""
    noise: float = 0.0
    gradient: float = 0.0
    """Illumination lost linearly from the left border to the right one, as a fraction."""

    def clean(self) -> Array:
        """The picture before noise and rounding (h, w)."""
        width, height = self.size
        image = np.full((height, width), float(self.wall))
        for H, _, _, half in self.faces:
            corners = project(H, np.array([[-half, -half], [half, -half], [half, half], [-half, half]]))
            mask = np.zeros((height, width), np.uint8)
            cv2.fillConvexPoly(mask, np.round(corners * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
            image += (self.black - image) * (mask / 255.0)
        coverage = np.zeros((height, width))
        conics = [conic_of_circle(H, p, radius) for H, positions, radius, _ in self.faces for p in positions]
        for conic in conics + self.clutter:
            if self.lens_blur:
                add_blurred(coverage, conic, self.lens_blur)
            else:
                add_conic(coverage, conic)
        image += (self.white - image) * np.clip(coverage, 0, 1)
        if self.gradient:
            image *= 1.0 - self.gradient * np.arange(width) / (width - 1)
        if self.blur:
            image = cv2.GaussianBlur(image, (0, 0), self.blur, borderType=cv2.BORDER_REPLICATE)
        return image

    def render(self, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
        """The picture as a camera delivers it (h, w) uint8."""
        return digitise(self.clean(), self.noise, rng)


def digitise(clean: Array, noise: float, rng: np.random.Generator) -> npt.NDArray[np.uint8]:
    """Add white noise [grey levels] and round."""
    noisy = clean + noise * rng.standard_normal(clean.shape) if noise else clean
    image: npt.NDArray[np.uint8] = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    return image


def circle(u: float, v: float, radius: float) -> Array:
    """Conic of a circle [px]."""
    return conic_of_circle(np.eye(3), np.array([u, v]), radius)


def look(
    tilt: float, azimuth: float, roll: float, distance: float, at: tuple[float, float], focal: float = 1000.0,
    size: tuple[int, int] = (640, 480),
) -> Array:  # fmt: skip
    """Homography (3, 3) of a plane whose origin is seen at pixel ``at`` from ``distance`` [m]; angles [rad].

    At no tilt and roll the plane's x runs right, its y down, and it is seen from in front.
    """
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R = cv2.Rodrigues(axis * tilt)[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    ray = np.linalg.solve(K, np.array([at[0], at[1], 1.0]))
    H: Array = K @ np.column_stack([R[:, :2], distance * ray])
    return H
