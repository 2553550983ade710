"""Pan-tilt head of thesis 4.5 through rendered pictures: a textured mountain, its interest points matched between the
cameras by the product's learner of landmarks, and tracked from picture to picture by correlation.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.fundamental import fundamental_robust, sampson_distances
from stereoservo.numerics.arrays import BoolArray, FloatArray, ImageArray
from stereoservo_drivers.detectors.landmark_learning import LearningSettings, learn_landmarks
from stereoservo_sim.experiments.pictures.correlation import follow
from stereoservo_sim.experiments.pictures.textured import Face, TexturedBody, texture
from stereoservo_sim.experiments.rotations.thesis_head import (
    POINTS,
    SIGMA,
    SeenHead,
    Tracks,
    general_positions,
    head,
    trajectories,
)
from stereoservo_sim.world.camera_rig import PinholeCamera
from stereoservo_sim.world.synthetic import SyntheticCell

NOISE_GREY = 2.0
"""[grey levels]"""
ROWS, COLUMNS = 4, 3
"""Of rocks, one behind the other and higher, and side by side."""
SIDE, APART = 0.11, 0.115
"""[m] Of a rock, and between those side by side."""
DEEP, RISE = 0.10, 0.03
"""[m] From row to row."""
TEXELS, TEXTURE = 128, 6.0
"""Of a rock's texture along a side, and its finest structure [texels]: some 3 px."""
EPIPOLAR_PX = 3.0
"""Farther from its epipolar line no tracked point is kept: ten times the noise between consecutive images."""
ASSUMPTIONS = [
    "rendered: a mountain of twelve textured rocks, 2 grey levels of noise; interest points matched between cameras by "
    "the product's learner of landmarks, tracked by normalised correlation of 15 x 15 px from picture to picture, "
    "there and back, the peak by a paraboloid; F, and so which tracks are kept, estimated from them",
]
REACH_PX = {"pan": 10, "tilt": 10, "general": 24}
"""How far points may be from where the whole picture's shift leads, after a step and from position to position."""
NAMES = ("left", "right")


def mountain_body(cell: SyntheticCell, rng: np.random.Generator) -> TexturedBody:
    """Textured rocks that rise away from the head, each with a slope of its own."""
    to_camera = _camera(cell, 0, cell.home).centre - cell.body.mean(axis=0)
    away = -np.array([to_camera[0], to_camera[1], 0.0])
    away /= np.linalg.norm(away)
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(away, up)
    faces = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            turn, slope = np.radians(rng.uniform(-25.0, 25.0)), np.radians(rng.uniform(40.0, 80.0))
            across = SIDE * (np.cos(turn) * right + np.sin(turn) * away)
            rise = SIDE * (np.cos(slope) * away + np.sin(slope) * up)
            middle = (
                (column - 0.5 * (COLUMNS - 1)) * APART * right
                + (row - 0.5 * (ROWS - 1)) * DEEP * away
                + (0.04 + RISE * row) * up
            )
            faces.append(
                Face(texture(rng, TEXELS, TEXTURE), middle - 0.5 * across + 0.5 * rise, across, -rise)
            )
    return TexturedBody(faces)


def head_before_pictures(rng: np.random.Generator, positions: int) -> SeenHead:
    """A head before a rendered mountain, its trajectories and so many general ``positions`` tracked from the corner.

    Raises DriverError where too few interest points are matched.
    """
    cell = head(rng)
    body = mountain_body(cell, rng)
    pan, tilt = trajectories(cell)
    general = general_positions(cell, rng, positions)
    ways = {"pan": pan, "tilt": tilt, "general": np.vstack([pan[:1], general])}
    pictures = {
        way: [[_picture(cell, body, c, q, rng) for q in path] for c in range(2)] for way, path in ways.items()
    }
    first = {name: [pictures["pan"][c][0]] for c, name in enumerate(NAMES)}
    landmarks, _ = learn_landmarks(first, None, LearningSettings(tilts=1, most=POINTS))
    start = np.array([landmarks.camera(name).pixels for name in NAMES])
    tracked = {
        way: np.array(
            [follow([pictures["pan"][c][0], *shown[c][1:]], start[c], REACH_PX[way]) for c in range(2)]
        )
        for way, shown in pictures.items()
    }
    points = body.points(_camera(cell, 0, pan[0]), start[0], np.zeros(3))
    kept = np.isfinite(points).all(axis=1)
    for pixels in tracked.values():
        kept &= np.isfinite(pixels).all(axis=(0, 1, 3))
    kept[kept] = on_epipolar_lines(
        np.concatenate([pixels[:, :, kept] for pixels in tracked.values()], axis=1)
    )
    order = rng.permutation(np.flatnonzero(kept))
    seen = cell.with_body(points[order])
    tracks = Tracks(
        tracked["pan"][:, :, order], tracked["tilt"][:, :, order], seen.pixels(pan), seen.pixels(tilt), pan,
        tilt, "drifting",
    )  # fmt: skip
    return SeenHead(seen, tracks, general, tracked["general"][:, 1:, order], seen.pixels(general))


def on_epipolar_lines(pixels: FloatArray) -> BoolArray:
    """(m,): which of the points, tracked to ``pixels`` (2, s, m, 2), keep to the epipolar geometry that the others
    show, within ``EPIPOLAR_PX`` in all pictures. Raises GeometryError.
    """
    left, right = pixels.reshape(2, -1, 2)
    F, _ = fundamental_robust(left, right, SIGMA)
    off = np.abs(sampson_distances(F, left, right)).reshape(pixels.shape[1:3])
    return np.asarray((off < EPIPOLAR_PX).all(axis=0))


def _camera(cell: SyntheticCell, c: int, q: FloatArray) -> PinholeCamera:
    pose = cell.poses[c] @ np.linalg.inv(cell.flange(q))
    return PinholeCamera(NAMES[c], cell.intrinsics[c], pose, cell.width, cell.height)


def _picture(
    cell: SyntheticCell, body: TexturedBody, c: int, q: FloatArray, rng: np.random.Generator
) -> ImageArray:
    return body.picture(_camera(cell, c, q), np.zeros(3), rng, NOISE_GREY)
