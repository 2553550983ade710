"""Averages of what the cameras see while the arm rests: for calibration stops and for taught goals."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from stereoservo.runtime.cycle import Sample
from stereoservo.runtime.ports import CameraObservation, FloatArray, IntArray
from stereoservo.runtime.settings import CoreSettings


class Sums(Protocol):
    """Where sights are summed: ``Trials`` and ``Teaching``."""

    counts: FloatArray
    sums: FloatArray
    covariance_sums: FloatArray
    frames: IntArray


def add_observation(
    sums: Sums, settings: CoreSettings, observation: CameraObservation, frames_wanted: int, after_ns: int
) -> None:
    """Add one frame, when its shutter opened after ``after_ns`` and its camera still lacks frames."""
    camera = next(i for i, c in enumerate(settings.cameras) if c.name == observation.camera)
    if observation.t_shutter_ns <= after_ns or sums.frames[camera] >= frames_wanted:
        return
    index = {marker: i for i, marker in enumerate(settings.marker_ids)}
    sums.frames[camera] += 1
    for k in range(observation.ids.size):
        i = index.get(int(observation.ids[k]))
        if i is None:
            continue
        sums.counts[camera, i] += 1.0
        sums.sums[camera, i] += observation.pixels[k]
        sums.covariance_sums[camera, i] += observation.covariances[k]


def averages(sums: Sums, settings: CoreSettings) -> tuple[Sample, ...]:
    """Mean pixels with the covariance of the mean, of markers seen in at least half of the frames."""
    samples = []
    ids = np.array(settings.marker_ids, dtype=np.int64)
    for camera, description in enumerate(settings.cameras):
        frames = int(sums.frames[camera])
        seen = (sums.counts[camera] * 2 >= max(frames, 1)) & (sums.counts[camera] > 0)
        n = sums.counts[camera, seen]
        samples.append(
            Sample(
                description.name,
                ids[seen],
                sums.sums[camera, seen] / n[:, None],
                sums.covariance_sums[camera, seen] / (n * n)[:, None, None],
                frames,
            )
        )
    return tuple(samples)
