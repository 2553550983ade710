"""Where all markers are now, the workpiece's too: the newest frames of each camera, averaged while nothing moves."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from stereoservo.runtime.commands import Pixel
from stereoservo.runtime.ports import CameraObservation

FRAMES = 10
FRESH_S = 1.0
"""A frame older than this says nothing of now."""
STILL_SIGMAS = 6.0
STILL_PX = 0.2
"""A marker that leaves its mean by no more than so many deviations, and this, stands still."""


class Sight(NamedTuple):
    """One marker in one camera: raw pixel, standard deviation [px], and whether it moves."""

    pixel: Pixel
    sigma: float
    moves: bool


Sights = Mapping[str, Mapping[int, Sight]]
"""camera -> marker -> sight."""


class NewestSights:
    """Keeps the last frames of each camera. ``systematic_px`` by camera: what does not average out."""

    def __init__(self, systematic_px: Mapping[str, float]) -> None:
        self._systematic = dict(systematic_px)
        self._frames: dict[str, deque[CameraObservation]] = {
            camera: deque(maxlen=FRAMES) for camera in systematic_px
        }

    def add(self, observation: CameraObservation) -> None:
        """Take a frame."""
        self._frames[observation.camera].append(observation)

    def now(self, now_ns: int) -> dict[str, dict[int, Sight]]:
        """What the cameras see, from frames received within `FRESH_S`; markers of the newest frame only."""
        return {camera: self._of(camera, now_ns) for camera in self._frames}

    def _of(self, camera: str, now_ns: int) -> dict[int, Sight]:
        fresh = [o for o in self._frames[camera] if now_ns - o.t_received_ns <= FRESH_S * 1e9]
        if not fresh:
            return {}
        tracks: dict[int, list[tuple[np.ndarray[tuple[int], np.dtype[np.float64]], float]]] = {}
        for observation in fresh:
            for marker, pixel, covariance in zip(
                observation.ids, observation.pixels, observation.covariances, strict=True
            ):
                tracks.setdefault(int(marker), []).append((pixel, 0.5 * float(np.trace(covariance))))
        return {
            int(marker): _sight(tracks[int(marker)], self._systematic[camera] ** 2)
            for marker in fresh[-1].ids
        }


def _sight(
    track: list[tuple[np.ndarray[tuple[int], np.dtype[np.float64]], float]], systematic: float
) -> Sight:
    """The mean of a marker that stands still, the newest pixel of one that moves."""
    pixels = np.array([pixel for pixel, _ in track])
    variance = float(np.mean([variance for _, variance in track]))
    mean = pixels.mean(axis=0)
    away = float(np.sqrt(((pixels - mean) ** 2).sum(axis=1)).max())
    if away > STILL_SIGMAS * np.sqrt(variance) + STILL_PX:
        return Sight((float(pixels[-1, 0]), float(pixels[-1, 1])), float(np.sqrt(track[-1][1])), True)
    noise = max(variance - systematic, 0.0) / len(track) + min(systematic, variance)
    return Sight((float(mean[0]), float(mean[1])), float(np.sqrt(noise)), False)
