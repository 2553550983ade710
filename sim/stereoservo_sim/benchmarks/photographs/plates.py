"""Dots: no photograph of the product's faces is to be had, so faces are drawn into photographs, and lit and blurred as
these are; beside ``cv2.findCirclesGrid`` on a grid of as large dots in the same places.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_sim.benchmarks import features_scenes as scenes
from stereoservo_sim.benchmarks.photographs.pictures import Photographs, Row, context, look, over, read

FACE = DEFAULT_BODY[0]
SIZE = (scenes.WIDTH, scenes.HEIGHT)
GRID = 4
"""Dots along a side of the peer's grid."""
BLUR_PX, NOISE = 0.7, 2.0
LIGHT_PX = 40.0
"""How smooth the photograph's light is that falls on the plate [px]."""
DARKEST = 0.35
"""The least light on a plate, of the full one."""
DISTANCE, TILT_DEG = (0.8, 1.4), 50.0
WRONG_PX = 2.0


def _grid() -> FloatArray:
    at = np.linspace(-0.7, 0.7, GRID) * FACE.half_side
    return np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)


def drawn(
    photograph: ImageArray, dots: FloatArray, rng: np.random.Generator
) -> tuple[ImageArray, FloatArray]:
    """A photograph with a plate of ``dots`` (n, 2) [m] in it, and their centres (n, 2) [px]."""
    image = cv2.resize(photograph, SIZE, interpolation=cv2.INTER_AREA).astype(np.float32)
    light = cv2.GaussianBlur(image, (0, 0), LIGHT_PX)
    light = np.maximum(light / light.max(), DARKEST)
    middle = np.array(SIZE) / 2 + rng.uniform(-120.0, 120.0, 2) * (1.0, 0.6)
    tilt = np.radians(rng.uniform(0.0, TILT_DEG))
    azimuth, roll = rng.uniform(0.0, 2.0 * np.pi, 2)
    H = scenes.look(tilt, azimuth, roll, rng.uniform(*DISTANCE), middle)
    s = FACE.half_side
    corners = scenes.project(H, np.array([[-s, -s], [s, -s], [s, s], [-s, s]]))
    plate = np.zeros_like(image)
    scenes.blend_polygon(plate, corners, 1.0)
    plate = cv2.GaussianBlur(plate, (0, 0), BLUR_PX)
    white = np.zeros_like(image)
    for dot in dots:
        scenes.add_ellipse(white, scenes.circle_conic(H, dot, FACE.radius), BLUR_PX)
    lit = light * (scenes.BLACK + (scenes.WHITE - scenes.BLACK) * np.minimum(white, 1.0))
    image = image * (1.0 - plate) + lit * plate + rng.normal(0.0, NOISE, image.shape) * plate
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), scenes.project(H, dots)


def dot_rows(paths: Sequence[Path], repetitions: int, seed: int) -> list[Row]:
    """Plates drawn into photographs, and the same photographs without one (``no plate``)."""
    photographs = [read(path) for path in paths]
    plain = [cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA).astype(np.uint8) for image in photographs]
    detector = DotDetector({}, context())
    blobs = cv2.SimpleBlobDetector.Params()
    blobs.filterByColor, blobs.blobColor, blobs.minArea, blobs.maxArea = True, 255, 20.0, 3000.0
    finder = cv2.SimpleBlobDetector.create(blobs)

    def ours(image: ImageArray) -> FloatArray:
        seen = look(detector, image)
        places = np.full((len(FACE.ids), 2), np.nan)
        mine = np.isin(seen.ids, FACE.ids)
        places[np.searchsorted(FACE.ids, seen.ids[mine])] = seen.pixels[mine]
        return places

    def grid(image: ImageArray) -> FloatArray:
        flags = cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
        found, centres = cv2.findCirclesGrid(image, (GRID, GRID), flags=flags, blobDetector=finder)
        return (
            np.asarray(centres, dtype=np.float64).reshape(-1, 2) if found else np.full((GRID**2, 2), np.nan)
        )

    rows = []
    for name, find, dots in (
        ("dots (stereoservo)", ours, FACE.positions),
        ("cv2.findCirclesGrid", grid, _grid()),
    ):
        rng = np.random.default_rng(seed)
        made = [drawn(photograph, dots, rng) for photograph in photographs]
        seen, ms = over([image for image, _ in made], find, repetitions)
        errors = [_errors(places, truth, name) for places, (_, truth) in zip(seen, made, strict=True)]
        far = np.concatenate([np.hypot(*error.T) for error in errors])
        good = np.concatenate(errors)[far < WRONG_PX]
        rows.append(
            Row("a plate drawn into photographs: dots", len(made), name, far.size, int((far < WRONG_PX).sum()),
                int((far >= WRONG_PX).sum()), float(np.sqrt(np.mean(good**2))) if good.size else None,
                "drawn centres", ms)
        )  # fmt: skip
        nothing, ms = over(plain, find, repetitions)
        false = sum(int(np.isfinite(places[:, 0]).sum()) for places in nothing)
        rows.append(Row("no plate: dots", len(plain), name, 0, 0, false, None, "", ms))
    return rows


def _errors(places: FloatArray, truth: FloatArray, name: str) -> FloatArray:
    """Errors (n, 2) [px], NaN where nothing was found; a grid may be counted from any of its corners."""
    if name.startswith("dots"):
        return places - truth
    turned = truth.reshape(GRID, GRID, 2)
    each = [np.rot90(one, k).reshape(-1, 2) for one in (turned, turned.transpose(1, 0, 2)) for k in range(4)]
    return min((places - one for one in each), key=lambda e: float(np.nan_to_num(np.abs(e), nan=1e3).sum()))


def plate_rows(shown: Photographs, repetitions: int, seed: int) -> list[Row]:
    """All rows of dots."""
    paths = shown.others + shown.franka[::2]
    return sorted(dot_rows(paths, repetitions, seed), key=lambda row: row.shown == 0) if paths else []
