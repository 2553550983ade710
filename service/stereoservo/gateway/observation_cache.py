"""Cache of the newest observations of all markers by camera: averaged over frames for a static marker, interpolated to
a common time for a moving one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from stereoservo.messages.goals import Pixel
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation

FRAMES = 10
FRESH_S = 1.0
"""Maximum age of a frame [s]; older ones are not used."""
STILL_SIGMAS = 6.0
STILL_PX = 0.2
"""A marker is static within this many standard deviations plus this offset of its mean."""


class MarkerObservation(NamedTuple):
    """A marker in a camera: raw pixel, standard deviation [px], and whether it moves."""

    pixel: Pixel
    sigma: float
    moves: bool


MarkerObservations = Mapping[str, Mapping[int, MarkerObservation]]
"""camera -> marker -> observation."""


class ObservationCache:
    """The last frames of each camera. ``systematic_px`` by camera: error that averaging does not reduce."""

    def __init__(self, systematic_px: Mapping[str, float]) -> None:
        self._systematic = dict(systematic_px)
        self._frames: dict[str, deque[CameraObservation]] = {camera: deque(maxlen=FRAMES) for camera in systematic_px}

    def add(self, observation: CameraObservation) -> None:
        """Add a frame."""
        self._frames[observation.camera].append(observation)

    def now(self, now_ns: int) -> dict[str, dict[int, MarkerObservation]]:
        """Current observations by camera, from frames received within `FRESH_S`; only markers of the newest frame."""
        fresh = {
            camera: [o for o in frames if now_ns - o.t_received_ns <= FRESH_S * 1e9]
            for camera, frames in self._frames.items()
        }
        moment_ns = min((frames[-1].t_shutter_ns for frames in fresh.values() if frames), default=0)
        return {camera: self._camera_observations(camera, frames, moment_ns) for camera, frames in fresh.items()}

    def _camera_observations(
        self, camera: str, fresh: list[CameraObservation], moment_ns: int
    ) -> dict[int, MarkerObservation]:
        if not fresh:
            return {}
        tracks: dict[int, list[_TimedPixel]] = {}
        for observation in fresh:
            since_s = (observation.t_shutter_ns - moment_ns) * 1e-9
            for marker, pixel, covariance in zip(
                observation.ids, observation.pixels, observation.covariances, strict=True
            ):
                tracks.setdefault(int(marker), []).append(
                    _TimedPixel(since_s, pixel, 0.5 * float(np.trace(covariance)))
                )
        return {int(marker): _average(tracks[int(marker)], self._systematic[camera] ** 2) for marker in fresh[-1].ids}


class _TimedPixel(NamedTuple):
    """Where a marker was seen (2,) [px], with its variance [px²], at a time [s] relative to the reference time."""

    since_s: float
    pixel: FloatArray
    variance: float


def _average(track: list[_TimedPixel], systematic: float) -> MarkerObservation:
    """Mean pixel of a static marker; for a moving one, its pixel at the latest time that all cameras have observed."""
    pixels = np.array([observed.pixel for observed in track])
    variance = float(np.mean([observed.variance for observed in track]))
    mean = pixels.mean(axis=0)
    away = float(np.sqrt(((pixels - mean) ** 2).sum(axis=1)).max())
    if away > STILL_SIGMAS * np.sqrt(variance) + STILL_PX:
        times = np.array([observed.since_s for observed in track])
        order = np.argsort(times, kind="stable")
        u, v = (float(np.interp(0.0, times[order], pixels[order, axis])) for axis in range(2))
        return MarkerObservation((u, v), float(np.sqrt(track[-1].variance)), True)
    noise = max(variance - systematic, 0.0) / len(track) + min(systematic, variance)
    return MarkerObservation((float(mean[0]), float(mean[1])), float(np.sqrt(noise)), False)
