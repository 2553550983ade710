"""Views of a board or a marker body that is waved before cameras: good ones, and degenerate ones that determine no
cameras. Projected by Brown's model as OpenCV states it, written apart from the product's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from stereoservo.calibration.camera_rig.views import RigViews
from stereoservo.calibration.trial_data import TrialCamera
from stereoservo.numerics.arrays import FloatArray

SIZE = (640, 480)
BOARD = (9, 6)
PITCH = 0.025
DEGENERATE = (
    "board_parallel",
    "board_almost_parallel",
    "board_at_rest",
    "board_slid_on_a_table",
    "few_places",
    "rod",
    "cameras_apart",
    "body_only_shifted",
    "body_flat",
    "one_camera_unknown_body",
)
"""Kinds of views that leave the cameras open."""


@dataclass(frozen=True)
class WavedRig:
    """The true cameras: ``K`` (c, 3, 3), ``distortion`` (c, 4), motions (c, 4, 4) from the first one's frame; the
    views; ``body`` (m, 3) [m].
    """

    K: FloatArray
    distortion: FloatArray
    motions: FloatArray
    body: FloatArray
    views: RigViews


def project(X: FloatArray, K: FloatArray, d: FloatArray) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in a camera's frame, distorted by (k1, k2, p1, p2)."""
    x, y = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2]
    r2 = x * x + y * y
    radial = 1.0 + d[0] * r2 + d[1] * r2 * r2
    u = x * radial + 2.0 * d[2] * x * y + d[3] * (r2 + 2.0 * x * x)
    v = y * radial + d[2] * (r2 + 2.0 * y * y) + 2.0 * d[3] * x * y
    return np.column_stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]])


def board() -> FloatArray:
    """Inner corners (54, 3) of the board [m]."""
    grid = np.array([[c, r, 0.0] for r in range(BOARD[1]) for c in range(BOARD[0])])
    return grid * PITCH


def random_cameras(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Intrinsics, distortion and motions of cameras beside one another that look at one place."""
    K, d, T = np.zeros((count, 3, 3)), np.zeros((count, 4)), np.tile(np.eye(4), (count, 1, 1))
    for c in range(count):
        f = rng.uniform(450.0, 800.0)
        K[c] = [[f, 0.0, 319.5 + 12.0 * rng.normal()], [0.0, f, 239.5 + 12.0 * rng.normal()], [0.0, 0.0, 1.0]]
        d[c] = rng.uniform(-0.3, 0.1), rng.uniform(-0.05, 0.05), *(1e-3 * rng.normal(size=2))
        if c:
            turn = [0.05 * rng.normal(), rng.uniform(0.05, 0.3) * c, 0.05 * rng.normal()]
            T[c, :3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
            T[c, :3, 3] = -0.12 * c, 0.01 * rng.normal(), 0.03 * c + 0.01 * rng.normal()
    return K, d, T


def waved(seed: int, *, cameras: int = 2, places: int = 15, sigma: float = 0.2, known: bool = True) -> WavedRig:
    """Good views: a board of known layout, or a body in space of unknown one, tilted to 35° about both axes."""
    rng = np.random.default_rng(seed)
    body = board() if known else rng.uniform(-0.1, 0.1, (14, 3))
    return _views(rng, cameras, places, sigma, body, known, lambda: _turn(rng, 35.0, 30.0), lambda: _place(rng))


def degenerate(kind: str, seed: int, sigma: float) -> WavedRig:
    """Views of one of the kinds of ``DEGENERATE``."""
    rng = np.random.default_rng(seed)
    flat = kind in ("board_parallel", "board_slid_on_a_table", "board_almost_parallel", "board_at_rest")
    tilt = _turn(rng, 30.0, 0.0)
    turn, place = (lambda: _turn(rng, 35.0, 30.0)), (lambda: _place(rng))
    body, known, cameras, places = board(), True, 2, int(rng.integers(8, 25))
    if flat:
        wobble = 1.5 if kind == "board_almost_parallel" else 0.0
        inside = 0.0 if kind == "board_parallel" else 40.0
        turn = lambda: tilt @ _turn(rng, wobble, inside)  # noqa: E731
    if kind == "board_slid_on_a_table":
        axis, origin = tilt[:, :2], np.array([0.0, 0.0, rng.uniform(0.45, 0.6)])
        place = lambda: origin + axis @ rng.uniform(-0.08, 0.08, 2)  # noqa: E731
    if kind == "board_at_rest":
        fixed_turn, fixed_place = turn(), np.array([0.0, 0.0, rng.uniform(0.4, 0.6)])
        turn, place = (lambda: fixed_turn), (lambda: fixed_place)
    if kind == "few_places":
        places = int(rng.integers(1, 3))
    if kind == "rod":
        body, known = np.linspace(0.0, 0.3, 8)[:, None] * np.array([[0.8, 0.6, 0.0]]), bool(rng.integers(2))
    if kind == "body_only_shifted":
        fixed = _turn(rng, 35.0, 30.0)
        body, known, turn = rng.uniform(-0.1, 0.1, (14, 3)), False, (lambda: fixed)
    if kind == "body_flat":
        body, known = np.hstack([rng.uniform(-0.1, 0.1, (14, 2)), np.zeros((14, 1))]), False
    if kind == "one_camera_unknown_body":
        body, known, cameras = rng.uniform(-0.1, 0.1, (14, 3)), False, 1
    found = _views(rng, cameras, places, sigma, body, known, turn, place)
    if kind == "cameras_apart":
        found.views.pixels[0, ::2] = np.nan
        found.views.pixels[1, 1::2] = np.nan
    return found


def _turn(rng: np.random.Generator, tilt: float, inside: float) -> FloatArray:
    """Rotation (3, 3): up to ``tilt`` about the picture's axes and ``inside`` its plane [°]."""
    angles = np.radians([rng.uniform(-inside, inside), *rng.uniform(-tilt, tilt, 2)])
    turn: FloatArray = Rotation.from_euler("ZYX", angles).as_matrix()
    return turn


def _place(rng: np.random.Generator) -> FloatArray:
    return np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.1, 0.1), rng.uniform(0.35, 0.8)])


def _views(rng, cameras, places, sigma, body, known, turn, place) -> WavedRig:  # type: ignore[no-untyped-def]
    K, d, T = random_cameras(rng, cameras)
    middle = body.mean(axis=0)
    pixels = np.full((cameras, places, len(body), 2), np.nan)
    for s in range(places):
        for _ in range(400):
            X = (body - middle) @ turn().T + place()
            for c in range(cameras):
                Y = X @ T[c, :3, :3].T + T[c, :3, 3]
                seen = project(Y, K[c], d[c])
                inside = ((seen > 5.0) & (seen < np.array(SIZE) - 6.0)).all(axis=1) & (Y[:, 2] > 0.1)
                pixels[c, s] = np.where(inside[:, None], seen, np.nan)
            if (np.isfinite(pixels[:, s]).all(axis=2).mean(axis=1) > 0.7).all():
                break
    pixels += sigma * rng.normal(size=pixels.shape)
    views = RigViews(
        tuple(TrialCamera(f"camera{c}", *SIZE) for c in range(cameras)), tuple(range(len(body))),
        tuple(f"{s}" for s in range(places)), pixels, np.full(pixels.shape[:3], sigma), body if known else None,
    )  # fmt: skip
    return WavedRig(K, d, T, body, views)


def rendered_pictures(seed: int, folder: Path, *, places: int = 12, noise: float = 2.0) -> WavedRig:
    """Write pictures of a board that is waved before two cameras, ``folder``/left/00.png and so on; the truth.

    Pixels are means of 2x2 samples of the board's squares, with ``noise`` [grey levels].
    """
    rig = waved(seed, places=places, sigma=0.0)
    rng = np.random.default_rng(seed)
    for c, name in enumerate(("left", "right")):
        (folder / name).mkdir(parents=True, exist_ok=True)
        ideal = _ideal_samples(rig.K[c], rig.distortion[c])
        for s in range(places):
            plane = _plane_of(rig, c, s)
            levels = _squares(ideal @ np.linalg.inv(plane).T).reshape(SIZE[1], 2, SIZE[0], 2).mean(axis=(1, 3))
            image = np.clip(np.round(levels + noise * rng.normal(size=levels.shape)), 0, 255).astype(np.uint8)
            cv2.imwrite(str(folder / name / f"{s:02d}.png"), image)
    return rig


def _ideal_samples(K: FloatArray, d: FloatArray) -> FloatArray:
    """Normalised rays (n, 3) of 2x2 samples a pixel, row by row."""
    half = np.array([-0.25, 0.25])
    u = (np.arange(SIZE[0])[:, None] + half).ravel()
    v = (np.arange(SIZE[1])[:, None] + half).ravel()
    return _rays(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2), K, d)


def _rays(pixels: FloatArray, K: FloatArray, d: FloatArray) -> FloatArray:
    """Normalised rays (n, 3) of distorted pixels (n, 2): `project` inverted by fixed-point iteration."""
    seen = np.column_stack([(pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[1, 1]])
    found = seen.copy()
    for _ in range(40):
        there = project(np.column_stack([found, np.ones(len(found))]), np.eye(3), d)
        found = found + (seen - there)
    return np.column_stack([found, np.ones(len(found))])


def _plane_of(rig: WavedRig, c: int, s: int) -> FloatArray:
    """Homography (3, 3) from the board's coordinates [pitches] to normalised rays, of its corners as they were seen."""
    seen = np.isfinite(rig.views.pixels[c, s]).all(axis=1)
    rays = _rays(rig.views.pixels[c, s, seen], rig.K[c], rig.distortion[c])
    H, _ = cv2.findHomography(rig.body[seen, :2] / PITCH, rays[:, :2])
    return np.asarray(H)


def _squares(points: FloatArray) -> FloatArray:
    """Grey levels (n,) of homogeneous points of the board's plane [pitches]: white paper with 10x7 squares."""
    front = points[:, 2] > 0.0
    x, y = (points[:, :2] / np.where(front, points[:, 2], 1.0)[:, None]).T
    on_squares = (x > -1.0) & (x < BOARD[0]) & (y > -1.0) & (y < BOARD[1])
    on_paper = (x > -2.0) & (x < BOARD[0] + 1.0) & (y > -2.0) & (y < BOARD[1] + 1.0) & front
    dark = (np.floor(x).astype(np.int64) + np.floor(y).astype(np.int64)) % 2 == 0
    return np.where(on_paper, np.where(on_squares & dark, 35.0, 215.0), 120.0)
