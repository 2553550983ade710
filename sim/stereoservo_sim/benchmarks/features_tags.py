"""``bench features``, its tags: processor time of the detector `aruco` on twelve tags, with and without a prior, beside
OpenCV's own detector, and how far its corners are off.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, Frame, Prior
from stereoservo_drivers.detectors.aruco import TagDetector
from stereoservo_drivers.detectors.tag_registration import dictionary, tag_cells
from stereoservo_sim.benchmarks.timing import summary, timed

DICTIONARY = "36h11"
COLUMNS, ROWS = 4, 3
SIDE_PX, TILT_DEG = 80.0, 50.0
FINE = 4
"""Points a pixel and axis at which a print is looked up."""
WALL, WHITE, BLACK, BLUR_PX, NOISE = 110.0, 215.0, 30.0, 0.7, 2.0
PRIOR_PX = 0.7
"""Standard deviation of the prior, and by how much it is off."""
IMAGES = 4


def _view(rng: np.random.Generator, at: FloatArray) -> FloatArray:
    """Homography from a tag's unit square to pixels: 1 m from a camera of 1000 px, tilted and turned at random."""
    tilt, azimuth, roll = np.radians(rng.uniform(0, TILT_DEG)), *rng.uniform(0, 2 * np.pi, 2)
    axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    R = cv2.Rodrigues(axis * tilt)[0] @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    side = SIDE_PX / 1000.0
    plane = np.column_stack([R[:, 0] * side, R[:, 1] * side, -(R[:, 0] + R[:, 1]) * side / 2 + [0, 0, 1]])
    return np.asarray(np.array([[1000.0, 0, at[0]], [0, 1000.0, at[1]], [0, 0, 1]]) @ plane)


def picture(rng: np.random.Generator) -> tuple[ImageArray, FloatArray]:
    """A picture of 640x480 of tags 0 to 11, and their corners (48, 2) [px]."""
    image, corners = scene(rng)
    image = image + rng.normal(0.0, NOISE, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), corners


def scene(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """The same before the sensor: grey levels (480, 640), and the corners."""
    fine = np.full((480 * FINE, 640 * FINE), WALL, np.float32)
    to_fine = np.array([[FINE, 0, (FINE - 1) / 2], [0, FINE, (FINE - 1) / 2], [0, 0, 1.0]])
    corners = []
    for k in range(COLUMNS * ROWS):
        at = np.array([90.0 + 153 * (k % COLUMNS), 85.0 + 155 * (k // COLUMNS)]) + rng.uniform(-8, 8, 2)
        H = _view(rng, at)
        cells = np.pad(1.0 - tag_cells(DICTIONARY, k), 1, constant_values=1.0)
        n, scale = len(cells) - 2, 16
        printed = np.kron(BLACK + (WHITE - BLACK) * cells, np.ones((scale, scale))).astype(np.float32)
        from_print = np.array([[1, 0, 0.5 - scale], [0, 1, 0.5 - scale], [0, 0, n * scale]]) / (n * scale)
        cv2.warpPerspective(
            printed,
            to_fine @ H @ from_print,
            fine.shape[::-1],
            fine,
            cv2.INTER_NEAREST,
            cv2.BORDER_TRANSPARENT,
        )
        square = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]) @ H.T
        corners.append(square[:, :2] / square[:, 2:])
    fine = cv2.GaussianBlur(fine, (0, 0), BLUR_PX * FINE)
    image = np.asarray(cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA), dtype=np.float64)
    return image, np.concatenate(corners)


def tags(repetitions: int, seed: int) -> dict[str, Any]:
    """CPU ms an image with a prior, without, and of OpenCV's detector; corners' rms error [px]; share found."""
    rng = np.random.default_rng(seed)
    here = Path(".")
    context = DriverContext(
        clock=MonotonicClock(), cell="bench", runtime_dir=here, cell_dir=here, camera="left"
    )
    ids = np.arange(4 * COLUMNS * ROWS)
    detector = TagDetector({"tags": list(range(COLUMNS * ROWS)), "dictionary": DICTIONARY}, context)
    peer = cv2.aruco.ArucoDetector(dictionary(DICTIONARY))
    frames, priors, errors = [], [], []
    for k in range(IMAGES):
        image, truth = picture(rng)
        frames.append(Frame("left", k, 1_000_000_000, 1_004_000_000, image))
        off = truth + rng.normal(0.0, PRIOR_PX, truth.shape)
        sigmas = np.tile(np.eye(2) * PRIOR_PX**2, (len(ids), 1, 1))
        priors.append(Prior("left", 1_000_000_000, ids, off, np.zeros_like(off), sigmas))
        for prior in (None, priors[-1]):
            seen = detector.detect(frames[-1], prior)
            errors.append(seen.pixels - truth[seen.ids])
    count = 10 * repetitions
    times = {
        "prior": timed(lambda k: detector.detect(frames[k % IMAGES], priors[k % IMAGES]), count)[1],
        "cold": timed(lambda k: detector.detect(frames[k % IMAGES], None), count)[1],
        "cv2_aruco": timed(lambda k: peer.detectMarkers(frames[k % IMAGES].image), count)[1],
    }
    return {
        "tags": COLUMNS * ROWS,
        "corners_found": len(np.concatenate(errors)) / (2 * IMAGES * len(ids)),
        "rms_px": float(np.sqrt(np.mean(np.concatenate(errors) ** 2))),
        "cpu_ms": {name: summary(samples, 1e3) for name, samples in times.items()},
    }
