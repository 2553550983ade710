"""Evaluation of tasks: Euclidean ground truth on noise-free projections."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo_sim.tasks.setting import (
    HEIGHT,
    HOMOGENEOUS_MARKERS,
    MIN_DEPTH,
    WIDTH,
    camera_matrices,
    camera_poses,
    cartesian_twists,
)

MATRICES = camera_matrices()
EYES = camera_poses()[:, :3, 3].copy()


class PlateView(NamedTuple):
    """True images of the plate: ``pixels`` (c, m, 2), and the worst measures over markers and cameras used.

    ``margin_px``: to the nearest border, negative out of view; ``depth_m``; ``facing``: cosine between a camera's line
    of sight and the plate's normal, negative if it sees the back.
    """

    pixels: FloatArray
    margin_px: float
    depth_m: float
    facing: float

    @property
    def in_view(self) -> bool:
        """Whether all markers are in all images."""
        return self.margin_px >= 0.0 and self.depth_m > MIN_DEPTH


def sight(pose: FloatArray, cameras: int = len(MATRICES)) -> PlateView:
    """View of the plate at ``pose`` (4, 4) in all images; measures are those of the first ``cameras``."""
    return PlateView(*_sight(MATRICES, EYES, HOMOGENEOUS_MARKERS, pose, cameras))


def in_images(pixels: FloatArray) -> npt.NDArray[np.bool_]:
    """Mask (c, m) of the pixels (c, m, 2) inside their image."""
    inside = (pixels >= 0.0) & (pixels < np.array([WIDTH, HEIGHT]))
    return np.asarray(inside.all(axis=-1))


@kernel
def _sight(
    matrices: FloatArray, camera_centres: FloatArray, markers: FloatArray, pose: FloatArray, used: int
) -> tuple[FloatArray, float, float, float]:
    cameras, count = matrices.shape[0], markers.shape[0]
    pixels = np.empty((cameras, count, 2))
    margin, nearest, facing = math.inf, math.inf, math.inf
    for p in range(count):
        X = np.zeros(4)
        for i in range(4):
            for k in range(4):
                X[i] += pose[i, k] * markers[p, k]
        for c in range(cameras):
            x = np.zeros(3)
            for i in range(3):
                for k in range(4):
                    x[i] += matrices[c, i, k] * X[k]
            u, v = x[0] / x[2], x[1] / x[2]
            pixels[c, p, 0], pixels[c, p, 1] = u, v
            if c >= used:
                continue
            nearest = min(nearest, x[2])
            # The last visible pixel coordinate is just below the image's size.
            margin = min(margin, u, v, np.nextafter(WIDTH, 0.0) - u, np.nextafter(HEIGHT, 0.0) - v)
    for c in range(used):
        along, length = 0.0, 0.0
        for i in range(3):
            offset = camera_centres[c, i] - pose[i, 3]
            along -= pose[i, 2] * offset
            length += offset * offset
        facing = min(facing, along / math.sqrt(length))
    return pixels, margin, nearest, facing


def error_px(pixels: FloatArray, set_points: FloatArray, cameras: int) -> float:
    """Largest distance over the markers in the first ``cameras`` images [px]."""
    difference = pixels[:cameras] - set_points[:cameras]
    return float(np.sqrt((difference * difference).sum(axis=-1).max()))


def line_deviations(poses: FloatArray, start: FloatArray, goal: FloatArray) -> FloatArray:
    """Distances (k,) [m] of the plate's centre in ``poses`` (k, 4, 4) from the line segment from ``start`` to ``goal``.

    Distances are to the segment, so that overshoot counts.
    """
    a, b = start[:3, 3], goal[:3, 3]
    offset = b - a
    length = float(offset @ offset)
    from_a = poses[:, :3, 3] - a
    share = np.clip(from_a @ offset / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(poses))
    return np.asarray(np.linalg.norm(from_a - share[:, None] * offset, axis=1))


def noise_floor_px(goal: FloatArray, noise_px: float, gain: float, dt_s: float, cameras: int) -> float:
    """Expected largest error over markers [px], due to image noise, of a loop at rest.

    The least-squares pose of each single frame has the covariance ``σ²(JᵀJ)⁻¹``. A loop in which an error decays by
    ``exp(-gain·dt)`` a step passes the share ``λ/(2 - λ)``, ``λ = 1 - exp(-gain·dt)``, of it. The mean over its
    directions is taken from 4096 fixed draws.
    """
    if noise_px == 0.0:
        return 0.0
    twists = cartesian_twists(goal[:3, 3])
    markers = HOMOGENEOUS_MARKERS @ goal.T
    x = np.einsum("cik,mk->cmi", MATRICES[:cameras], markers)
    velocity = np.einsum("cik,jkl,ml->cmij", MATRICES[:cameras], twists, markers)
    pixels = x[..., :2] / x[..., 2:]
    J = (velocity[..., :2, :] - pixels[..., None] * velocity[..., 2:, :]) / x[..., 2, None, None]
    flat = J.reshape(-1, 6)
    Q = np.linalg.qr(flat)[0]
    draws = np.random.default_rng(0).normal(size=(4096, 6)) @ Q.T
    worst = np.sqrt((draws.reshape(4096, -1, 2) ** 2).sum(axis=-1)).max(axis=1)
    share = -math.expm1(-gain * dt_s)
    return float(noise_px * np.sqrt(share / (2.0 - share)) * worst.mean())
