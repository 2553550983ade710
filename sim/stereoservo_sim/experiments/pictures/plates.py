"""The tasks' plate through rendered pictures of both cameras: its markers as the product's detector of dots finds them,
in the whole image or where they are expected.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, ImageArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, Frame, Prior
from stereoservo.ports.dot_plates import CORNERS, seven_dots
from stereoservo_drivers.detectors.dots import DotDetector
from stereoservo_drivers.detectors.homographies import fit_homography
from stereoservo_sim.tasks.ground_truth import sight
from stereoservo_sim.tasks.setting import HEIGHT, MARKERS, WIDTH, camera_poses, intrinsics
from stereoservo_sim.world.body import MarkerBody
from stereoservo_sim.world.camera_rig import PinholeCamera
from stereoservo_sim.world.rendering import draw_faces

FACE = seven_dots("plate", 0, 0.66, ((0.25, 0.40), (0.66, 0.49)), side=float(np.ptp(MARKERS[:, 0])))
"""Its corner dots are the tasks' markers; the three others tell which is which."""
BACKGROUND, BLUR_PX, NOISE_GREY = 60.0, 0.7, 2.0
"""[grey levels], [px], [grey levels]"""
NOISE_MARGIN = 64
"""A frame's noise is a part of one field, shifted by less than this [px]."""
PRIOR_PX = 1.0
"""Standard deviation that the detector is told of what is expected."""
PERIOD_NS = 40_000_000


class PlatePictures:
    """Sight of the plate (`stereoservo_sim.tasks.closed_loop.PlateSight`) through rendered pictures.

    ``predicts``: the detector is given what the controller expects, and the loop goes on where it finds nothing. Else
    it searches the whole images, and has to find all four markers in both.

    Attributes:
        found: how many markers were found in both images, frame by frame.
        off: how far each of them was off its true image [px].
        ahead: how far every marker was off where it was expected [px].
    """

    def __init__(self, predicts: bool) -> None:
        self._predicts = predicts
        self.cameras = [
            PinholeCamera(name, intrinsics(), np.linalg.inv(pose), WIDTH, HEIGHT)
            for name, pose in zip(("left", "right"), camera_poses(), strict=True)
        ]
        self._body = MarkerBody((FACE,), np.eye(4)[None])
        self._detectors = [_detector(camera.name) for camera in self.cameras]
        shape = HEIGHT + NOISE_MARGIN, WIDTH + NOISE_MARGIN
        self._noise = NOISE_GREY * np.random.default_rng(20).standard_normal(shape, np.float32)
        self.found: list[int] = []
        self.off: list[float] = []
        self.ahead: list[float] = []

    def look(
        self, pose: FloatArray, time_s: float, expected: FloatArray | None, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray] | None:
        """As `PlateSight` has it."""
        if expected is not None:
            self.ahead += np.linalg.norm(expected - sight(pose).pixels, axis=-1).ravel().tolist()
        pixels, seen = self.extracted(pose, expected if self._predicts else None, rng)
        return (pixels, seen) if self._predicts or seen.all() else None

    def extracted(
        self, pose: FloatArray, expected: FloatArray | None, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (c, m, 2) of the markers, and 1 or 0 (c, m) for what was found of them."""
        truth = sight(pose).pixels
        pixels, seen = np.zeros(truth.shape), np.zeros(truth.shape[:2])
        seq = len(self.found) + 1
        t_ns = seq * PERIOD_NS
        for c, (camera, detector) in enumerate(zip(self.cameras, self._detectors, strict=True)):
            image = self.picture(camera, pose, rng)
            prior = None if expected is None else _prior(camera.name, t_ns, expected[c])
            found = detector.detect(Frame(camera.name, seq, t_ns, t_ns, image), prior)
            rows = found.ids[found.ids < len(MARKERS)]
            pixels[c, rows], seen[c, rows] = found.pixels[: len(rows)], 1.0
            self.off += np.linalg.norm(pixels[c, rows] - truth[c, rows], axis=1).tolist()
        self.found.append(int(seen.sum()))
        return pixels, seen

    def picture(self, camera: PinholeCamera, pose: FloatArray, rng: np.random.Generator) -> ImageArray:
        """Image (h, w) of the plate at ``pose`` (4, 4)."""
        image = np.full((camera.height, camera.width), BACKGROUND, np.float32)
        region = draw_faces(image, self._body, pose, camera)
        if region is not None:
            left, top, right, bottom = region
            part = image[top:bottom, left:right]
            part[...] = cv2.GaussianBlur(part, (0, 0), BLUR_PX, borderType=cv2.BORDER_REPLICATE)
        down, right = rng.integers(0, NOISE_MARGIN, 2)
        noise = self._noise[down : down + camera.height, right : right + camera.width]
        return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)


def _detector(camera: str) -> DotDetector:
    face = {"name": FACE.name, "ids": FACE.ids, "positions": FACE.positions.tolist(), "radius": FACE.radius}
    here = Path()
    return DotDetector(
        {"faces": [face]}, DriverContext(MonotonicClock(), "pictures", here, here, camera=camera)
    )


def _prior(camera: str, t_ns: int, expected: FloatArray) -> Prior:
    """The dots of the face where the four corners are ``expected`` (4, 2) [px]."""
    n = len(FACE.ids)
    corners, H = np.arange(n) < len(CORNERS), np.zeros((3, 3))
    dots = np.zeros((n, 2))
    dots[: len(CORNERS)] = expected
    if not fit_homography(FACE.positions, dots, corners, H):
        n, H = 0, np.eye(3)
    x = np.column_stack([FACE.positions, np.ones(len(FACE.ids))]) @ H.T
    pixels = x[:n, :2] / x[:n, 2:]
    ids = np.array(FACE.ids[:n])
    return Prior(camera, t_ns, ids, pixels, np.zeros((n, 2)), np.tile(PRIOR_PX**2 * np.eye(2), (n, 1, 1)))
