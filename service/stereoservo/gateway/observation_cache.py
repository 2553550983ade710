"""Cache of the newest observations of all markers by camera, averaged over frames while a marker is static."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from stereoservo.messages.goals import Pixel
from stereoservo.ports.devices import CameraObservation

FRAMES = 10
FRESH_S = 1.0
"""An older frame is not used."""
STILL_SIGMAS = 6.0
STILL_PX = 0.2
"""A marker within so many deviations plus this of its mean is static."""


class MarkerObservation(NamedTuple):
    """A marker in a camera: raw pixel, standard deviation [px], and whether it moves."""

    pixel: Pixel
    sigma: float
    moves: bool


MarkerObservations = Mapping[str, Mapping[int, MarkerObservation]]
"""camera -> marker -> observation."""


class ObservationCache:
    """The last frames of each camera. ``systematic_px`` by camera: error that does not average out."""

    def __init__(self, systematic_px: Mapping[str, float]) -> None:
        self._systematic = dict(systematic_px)
        self._frames: dict[str, deque[CameraObservation]] = {
            camera: deque(maxlen=FRAMES) for camera in systematic_px
        }

    def add(self, observation: CameraObservation) -> None:
        """Add a frame."""
        self._frames[observation.camera].append(observation)

    def now(self, now_ns: int) -> dict[str, dict[int, MarkerObservation]]:
        """Current observations by camera, from frames received within `FRESH_S`; only markers of the newest frame."""
        return {camera: self._camera_observations(camera, now_ns) for camera in self._frames}

    def _camera_observations(self, camera: str, now_ns: int) -> dict[int, MarkerObservation]:
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
            int(marker): _average(tracks[int(marker)], self._systematic[camera] ** 2)
            for marker in fresh[-1].ids
        }


def _average(
    track: list[tuple[np.ndarray[tuple[int], np.dtype[np.float64]], float]], systematic: float
) -> MarkerObservation:
    """Mean pixel of a static marker, newest pixel of a moving one."""
    pixels = np.array([pixel for pixel, _ in track])
    variance = float(np.mean([variance for _, variance in track]))
    mean = pixels.mean(axis=0)
    away = float(np.sqrt(((pixels - mean) ** 2).sum(axis=1)).max())
    if away > STILL_SIGMAS * np.sqrt(variance) + STILL_PX:
        return MarkerObservation(
            (float(pixels[-1, 0]), float(pixels[-1, 1])), float(np.sqrt(track[-1][1])), True
        )
    noise = max(variance - systematic, 0.0) / len(track) + min(systematic, variance)
    return MarkerObservation((float(mean[0]), float(mean[1])), float(np.sqrt(noise)), False)
