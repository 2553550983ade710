"""Averages of what the cameras see while the arm rests: for calibration stops and for taught goals.

Pixels here are raw: no model is needed, and what is kept stays true when the lens becomes better known.
"""

from __future__ import annotations

import numpy as np

from stereoservo.runtime.cycle import Sample
from stereoservo.runtime.ports import CameraObservation
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.sums import Sums


def add_observation(
    sums: Sums, settings: CoreSettings, observation: CameraObservation, frames_wanted: int, after_ns: int
) -> bool:
    """Add one frame, when its shutter opened after ``after_ns`` and its camera still lacks frames; whether it was."""
    camera = next(i for i, c in enumerate(settings.cameras) if c.name == observation.camera)
    if observation.t_shutter_ns <= after_ns or sums.frames[camera] >= frames_wanted:
        return False
    sums.frames[camera] += 1
    index = {marker: i for i, marker in enumerate(settings.marker_ids)}
    rows = [k for k in range(observation.ids.size) if int(observation.ids[k]) in index]
    if not rows:
        return True
    seen = np.array([index[int(observation.ids[k])] for k in rows])
    pixels = observation.pixels[rows]
    known = sums.counts[camera, seen] > 0
    # The arm is never quite at rest: what all markers do together is motion, the remainder is the detector's noise.
    together = (pixels - sums.first[camera, seen])[known].mean(axis=0) if known.any() else np.zeros(2)
    sums.first[camera, seen[~known]] = pixels[~known] - together
    deviation = pixels - sums.first[camera, seen] - together
    sums.counts[camera, seen] += 1.0
    sums.sums[camera, seen] += pixels
    sums.deviation_sums[camera, seen] += deviation
    sums.square_sums[camera, seen] += (deviation * deviation).sum(axis=-1)
    sums.covariance_sums[camera, seen] += observation.covariances[rows]
    return True


def averages(sums: Sums, settings: CoreSettings) -> tuple[Sample, ...]:
    """Mean pixels with the covariance of the mean, of markers seen in at least half of the frames.

    Of the detector's covariance the systematic part does not shrink with the number of frames.
    """
    samples = []
    ids = np.array(settings.marker_ids, dtype=np.int64)
    for camera, description in enumerate(settings.cameras):
        frames = int(sums.frames[camera])
        seen = (sums.counts[camera] * 2 >= max(frames, 1)) & (sums.counts[camera] > 0)
        n = sums.counts[camera, seen]
        mean = sums.sums[camera, seen] / n[:, None]
        systematic = (1.0 - 1.0 / n)[:, None, None] * description.systematic_px**2 * np.eye(2)
        scatter = sums.square_sums[camera, seen] - (sums.deviation_sums[camera, seen] ** 2).sum(axis=-1) / n
        together = float(seen.sum()) / max(
            float(seen.sum()) - 1.0, 1.0
        )  # one freedom in so many went with the motion
        samples.append(
            Sample(
                description.name,
                ids[seen],
                mean,
                sums.covariance_sums[camera, seen] / (n * n)[:, None, None] + systematic,
                frames,
                n,
                together * np.maximum(scatter, 0.0) / (2.0 * np.maximum(n - 1.0, 1.0)),
            )
        )
    return tuple(samples)
