"""Frames of the default marker body with their truth, and the detector that looks at them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereoservo.ports.devices import CameraObservation, DriverContext, Frame, Prior
from stereoservo.ports.dot_plates import DEFAULT_BODY
from stereoservo_drivers.detectors.dots import DotDetector

from .rendering import Scene, circle, look, project

IDS = np.arange(14)


class Still:
    """A clock that stands."""

    def now_ns(self) -> int:
        return 0


def make_detector(**options) -> DotDetector:
    here = Path(".")
    return DotDetector(options, DriverContext(clock=Still(), cell="c", runtime_dir=here, cell_dir=here, camera="left"))


@dataclass
class Shot:
    """A frame, where its dots are (14, 2) [px], and the scene that it was rendered from."""

    frame: Frame
    truth: np.ndarray
    scene: Scene

    def prior(self, offset=(0.0, 0.0), sigma=1.0, **changes) -> Prior:
        values = {
            "camera": "left",
            "t_ns": self.frame.t_shutter_ns,
            "ids": IDS,
            "pixels": self.truth + np.asarray(offset),
            "velocities": np.zeros((14, 2)),
            "covariances": np.tile(np.eye(2) * sigma**2, (14, 1, 1)),
        }
        return Prior(**(values | changes))

    def errors(self, observation: CameraObservation) -> np.ndarray:
        """Reported minus true pixels (k, 2)."""
        return observation.pixels - self.truth[observation.ids]

    def with_image(self, image) -> Frame:
        return as_frame(image)


def as_frame(image, seq=0, t_ns=1_000_000_000) -> Frame:
    return Frame("left", seq, t_ns, t_ns + 4_000_000, image)


def random_shot(rng, *, tilt=60.0, distance=(0.8, 2.0), clutter=0, clear_of_dots=True, **settings) -> Shot:
    """Both faces somewhere in the image at tilts to ``tilt`` [deg], with ``clutter`` round dots about
    them.
    """
    faces, truth = [], []
    z = rng.uniform(*distance)
    for f, face in enumerate(DEFAULT_BODY):
        at = (180.0 + 280.0 * f + rng.uniform(-20, 20), 240.0 + rng.uniform(-60, 60))
        H = look(np.radians(rng.uniform(0, tilt)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi), z, at)
        faces.append((H, face.positions, face.radius, face.half_side))
        truth.append(project(H, face.positions))
    truth = np.concatenate(truth)
    scene = Scene(faces=faces, **settings)
    while len(scene.clutter) < clutter:
        centre = truth[rng.integers(14)] + rng.uniform(-90, 90, 2)
        radius = 8.0 / z * rng.uniform(0.6, 1.3)
        if clear_of_dots and np.hypot(*(truth - centre).T).min() < 8.0 / z + radius + 6.0:
            continue
        scene.clutter.append(circle(*centre, radius))
    return Shot(as_frame(scene.render(rng)), truth, scene)


def rms(errors) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def normalised(errors, covariances) -> np.ndarray:
    """Squared Mahalanobis distances (k,)."""
    return np.einsum("ki,ki->k", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
