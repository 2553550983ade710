"""Interest points matched between two cameras and tracked through pictures by the product's detector of natural
features: learnt in the first pictures, found by each camera by itself in the others.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereoservo.geometry.fundamental import fundamental_robust
from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, Frame
from stereoservo_drivers.detectors.corners import CornerDetector
from stereoservo_drivers.detectors.landmark_learning import LearningSettings, learn_landmarks
from stereoservo_drivers.detectors.landmarks import encode_landmarks

PERIOD_NS = 33_000_000


@dataclass(frozen=True, eq=False)
class LandmarkTracks:
    """Landmarks that both cameras found in all of s pictures: ``ids`` (m,), ``pixels`` (s, 2, m, 2), and ``sigmas``
    (s, 2, m) [px] an axis as the detector states them. ``learnt``: how many there were in the first pictures.
    """

    ids: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    learnt: int


def landmark_tracks(
    pictures: Mapping[str, Sequence[ImageArray]], settings: LearningSettings | None = None
) -> LandmarkTracks:
    """Landmarks of the first pictures of two cameras in all ``pictures``, of each camera as many.

    Raises DriverError where the first ones show too few.
    """
    landmarks, _ = learn_landmarks({name: images[:1] for name, images in pictures.items()}, None, settings)
    stops, m = len(next(iter(pictures.values()))), len(landmarks.ids)
    pixels, sigmas = np.full((stops, len(pictures), m, 2), np.nan), np.zeros((stops, len(pictures), m))
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder)
        (directory / "landmarks.npz").write_bytes(encode_landmarks(landmarks))
        for c, (name, images) in enumerate(pictures.items()):
            context = DriverContext(
                clock=MonotonicClock(),
                cell="pictures",
                runtime_dir=directory,
                cell_dir=directory,
                camera=name,
            )
            detector = CornerDetector({"landmarks": "landmarks.npz"}, context)
            for k, image in enumerate(images):
                t_ns = (k + 1) * PERIOD_NS
                seen = detector.detect(Frame(name, k + 1, t_ns, t_ns, image), None)
                rows = np.searchsorted(landmarks.ids, seen.ids)
                pixels[k, c, rows] = seen.pixels
                sigmas[k, c, rows] = np.sqrt(0.5 * np.trace(seen.covariances, axis1=1, axis2=2))
    everywhere = np.isfinite(pixels).all(axis=(0, 1, 3))
    return LandmarkTracks(landmarks.ids[everywhere], pixels[:, :, everywhere], sigmas[:, :, everywhere], m)


def epipolar_geometry(tracks: LandmarkTracks) -> FloatArray:
    """``F`` (3, 3) of the two cameras by all matches of all pictures. Raises GeometryError."""
    left, right = (tracks.pixels[:, c].reshape(-1, 2) for c in (0, 1))
    sigma = float(np.sqrt(np.mean(tracks.sigmas**2)))
    return fundamental_robust(left, right, sigma)[0]
