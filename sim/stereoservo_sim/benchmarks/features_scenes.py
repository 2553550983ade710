"""Synthetic images of the default faces with known dot centres, with light, lens and sensor effects.

A dot is an ellipse drawn by area coverage on a grid of FINE points a pixel, blurred there as a lens does it (before the
pixels sample it), lit, and only then given noise and whole grey levels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_sim.world.coverage import blend_ellipse, blend_polygon

FINE = 4
WIDTH, HEIGHT, FOCAL = 640, 480, 1000.0
BLACK, WHITE = 30.0, 220.0
CLEAR_PX = 6.0
"""Least gap between clutter and a face's dots; what touches them hides them, which is another test."""


@dataclass(frozen=True)
class Conditions:
    """``tilt`` up to it [deg], ``distance`` [m] between two bounds, ``blur`` [px], ``noise`` [grey levels],
    ``gradient`` of the light lost from the left border to the right, ``clutter`` dots, ``banding`` amplitude over
    ``band_rows`` rows, ``shot`` variance a grey level [levels], ``gain`` of the light between two bounds (255 is
    white), ``cut``: depth to which a dark edge covers one dot of each face [px], ``jpeg`` quality (0: none),
    ``motion`` [px]. ``drawn``: blur, noise, gradient and clutter of each picture are uniform between none and these.
    """

    tilt: float = 50.0
    distance: tuple[float, float] = (1.6, 1.6)
    blur: float = 0.7
    noise: float = 2.0
    gradient: float = 0.0
    clutter: int = 0
    banding: float = 0.0
    band_rows: float = 144.0
    shot: float = 0.0
    gain: tuple[float, float] = (1.0, 1.0)
    cut: float = 0.0
    jpeg: int = 0
    motion: float = 0.0
    drawn: bool = False

    def of_a_picture(self, rng: np.random.Generator) -> Conditions:
        """The conditions of one picture."""
        if not self.drawn:
            return self
        blur, noise, gradient = rng.uniform(0.0, 1.0, 3) * (self.blur, self.noise, self.gradient)
        return replace(
            self, blur=blur, noise=noise, gradient=gradient, clutter=int(rng.integers(self.clutter + 1))
        )


def look(tilt: float, azimuth: float, roll: float, distance: float, at: FloatArray) -> FloatArray:
    """Homography (3, 3) of a plane [m] whose origin is imaged at pixel ``at`` from ``distance`` [m]; angles [rad]."""
    K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R = cv2.Rodrigues(axis * tilt)[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    H: FloatArray = K @ np.column_stack([R[:, :2], distance * np.linalg.solve(K, np.append(at, 1.0))])
    return H


def project(H: FloatArray, points: FloatArray) -> FloatArray:
    """Project points (n, 2) of the plane to pixels (n, 2)."""
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ H.T
    pixels: FloatArray = homogeneous[:, :2] / homogeneous[:, 2:]
    return pixels


def circle_conic(H: FloatArray, centre: FloatArray, radius: float) -> FloatArray:
    """Conic (3, 3), negative inside, of a circle of the plane under ``H``."""
    x, y = centre
    inverse = np.linalg.inv(H)
    conic: FloatArray = (
        inverse.T @ np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius * radius]]) @ inverse
    )
    return conic * np.sign(conic[0, 0])


def random_picture(conditions: Conditions, rng: np.random.Generator) -> tuple[ImageArray, FloatArray]:
    """A picture (HEIGHT, WIDTH) with both faces side by side and its dots' centres (14, 2) [px]."""
    conditions = conditions.of_a_picture(rng)
    z = rng.uniform(*conditions.distance)
    image = np.full((HEIGHT, WIDTH), BLACK, np.float32)
    truth, conics = [], []
    for f, face in enumerate(DEFAULT_BODY):
        at = np.array([180.0 + 280.0 * f, 240.0]) + rng.uniform(-1.0, 1.0, 2) * (20.0, 60.0)
        tilt = np.radians(rng.uniform(0.0, conditions.tilt))
        azimuth, roll = rng.uniform(0.0, 2.0 * np.pi, 2)
        H = look(tilt, azimuth, roll, z, at)
        half = face.half_side
        corners = project(H, np.array([[-half, -half], [half, -half], [half, half], [-half, half]]))
        blend_polygon(image, corners, BLACK - 10.0)
        truth.append(project(H, face.positions))
        conics += [circle_conic(H, position, face.radius) for position in face.positions]
    pixels = np.concatenate(truth)
    conics += _clutter(conditions.clutter, 8.0 / z, pixels, rng)
    coverage = np.zeros((HEIGHT, WIDTH), np.float32)
    for conic in conics:
        add_ellipse(coverage, conic, conditions.blur)
    image += (WHITE - image) * np.minimum(coverage, 1.0)
    if conditions.cut:
        for f in range(len(DEFAULT_BODY)):
            _cover(image, conics[7 * f + int(rng.integers(7))], conditions, rng)
    return _as_taken(image, conditions, rng), pixels


def _clutter(count: int, radius: float, pixels: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
    """Conics of round dots of about ``radius`` [px] near those of the faces."""
    conics: list[FloatArray] = []
    while len(conics) < count:
        centre = pixels[rng.integers(len(pixels))] + rng.uniform(-90.0, 90.0, 2)
        own = radius * rng.uniform(0.6, 1.3)
        if np.hypot(*(pixels - centre).T).min() >= radius + own + CLEAR_PX:
            conics.append(circle_conic(np.eye(3), centre, own))
    return conics


def add_ellipse(coverage: npt.NDArray[np.float32], conic: FloatArray, blur: float) -> None:
    """Add an ellipse's coverage, blurred before it is sampled."""
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    half = np.sqrt(np.diag(np.linalg.inv(conic[:2, :2])) * level) + 5.0 * blur + 1.0
    u0, v0 = np.floor(centre - half).astype(int)
    u1, v1 = np.ceil(centre + half).astype(int) + 1
    # fine point i of the patch stands at u0 - 1/2 + (i + 1/2) / FINE
    start = 0.5 / FINE - 0.5
    to_pixels = np.array([[1 / FINE, 0, u0 + start], [0, 1 / FINE, v0 + start], [0, 0, 1]])
    fine = np.zeros(((v1 - v0) * FINE, (u1 - u0) * FINE), np.float32)
    blend_ellipse(fine, to_pixels.T @ conic @ to_pixels, 1.0)
    if blur:
        fine = cv2.GaussianBlur(fine, (0, 0), blur * FINE).astype(np.float32)
    patch = fine.reshape(v1 - v0, FINE, u1 - u0, FINE).mean(axis=(1, 3))
    a, b, c, d = max(u0, 0), min(u1, WIDTH), max(v0, 0), min(v1, HEIGHT)
    if a < b and c < d:
        coverage[c:d, a:b] += patch[c - v0 : d - v0, a - u0 : b - u0]


def _cover(
    image: npt.NDArray[np.float32], conic: FloatArray, conditions: Conditions, rng: np.random.Generator
) -> None:
    """Cover an ellipse from one side, to the depth of the cut, by something dark with an edge as blurred as the
    dots'.
    """
    centre = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = -(conic[2, 2] + conic[:2, 2] @ centre)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    n = np.array([np.cos(angle), np.sin(angle)])
    half = float(np.sqrt(n @ np.linalg.solve(conic[:2, :2], n) * level))
    u0, v0 = np.maximum(np.floor(centre - half - 20).astype(int), 0)
    v, u = np.mgrid[v0 : v0 + int(2 * half) + 41, u0 : u0 + int(2 * half) + 41]
    beyond = (u - centre[0]) * n[0] + (v - centre[1]) * n[1] - half + conditions.cut
    aside = (v - centre[1]) * n[0] - (u - centre[0]) * n[1]
    across = float(np.sqrt(n[::-1] * (-1, 1) @ np.linalg.solve(conic[:2, :2], n[::-1] * (-1, 1)) * level))
    # only about this dot
    near = (np.abs(beyond) < conditions.cut + 3.0 + 3.0 * conditions.blur) & (np.abs(aside) < across + 3.0)
    share = ndtr(beyond / np.hypot(conditions.blur, 0.29)) * near
    patch = image[v0 : v0 + share.shape[0], u0 : u0 + share.shape[1]]
    patch += (BLACK - 10.0 - patch) * share[: patch.shape[0], : patch.shape[1]]


def _as_taken(image: npt.NDArray[np.float32], conditions: Conditions, rng: np.random.Generator) -> ImageArray:
    """Apply light, motion blur, noise, quantisation and compression."""
    if conditions.gradient:
        image *= 1.0 - conditions.gradient * np.arange(WIDTH, dtype=np.float32) / (WIDTH - 1)
    if conditions.banding:
        phase = 2.0 * np.pi * (np.arange(HEIGHT) / conditions.band_rows + rng.uniform())
        image *= (1.0 + conditions.banding * np.sin(phase)).astype(np.float32)[:, None]
    image *= np.float32(rng.uniform(*conditions.gain))
    if conditions.motion:
        image = _moved(image, conditions.motion, rng.uniform(0.0, np.pi))
    variance = conditions.noise**2 + conditions.shot * image
    noisy = image + np.sqrt(variance) * rng.standard_normal(image.shape, np.float32)
    taken: ImageArray = np.clip(np.round(noisy), 0, 255).astype(np.uint8)
    if conditions.jpeg:
        packed = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, conditions.jpeg])[1]
        taken = cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE).astype(np.uint8)
    return taken


def _moved(image: npt.NDArray[np.float32], length: float, angle: float) -> npt.NDArray[np.float32]:
    """The image with motion blur along a line, about its centre."""
    u, v = np.meshgrid(np.fft.rfftfreq(WIDTH), np.fft.fftfreq(HEIGHT))
    smear = np.sinc(length * (u * np.cos(angle) + v * np.sin(angle)))
    moved: npt.NDArray[np.float32] = np.fft.irfft2(np.fft.rfft2(image) * smear, image.shape).astype(
        np.float32
    )
    return moved
