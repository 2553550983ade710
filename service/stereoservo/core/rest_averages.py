"""Averages of raw marker pixels over frames at rest, with covariances, for the core, the jobs and the gateway."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from stereoservo.core.cycle import Sample
from stereoservo.core.monitor_state import ObservationStatistics
from stereoservo.core.settings import CameraSettings, CoreSettings
from stereoservo.numerics.arrays import IntArray
from stereoservo.ports.devices import CameraObservation


def measurement_buffers(settings: CoreSettings) -> dict[str, Any]:
    """Empty sums of pixel observations for every camera and every marker id of the cell."""
    c, m = len(settings.cameras), len(settings.marker_ids)
    return {
        "counts": np.zeros((c, m)),
        "sums": np.zeros((c, m, 2)),
        "first": np.zeros((c, m, 2)),
        "deviation_sums": np.zeros((c, m, 2)),
        "square_sums": np.zeros((c, m)),
        "covariance_sums": np.zeros((c, m, 2, 2)),
        "frames": np.zeros(c, dtype=np.int64),
    }


@lru_cache(maxsize=4)
def _sorted_ids(cameras: tuple[CameraSettings, ...]) -> IntArray:
    """Every marker id that some of the ``cameras`` can report, ascending; read-only."""
    ids: IntArray = np.unique([i for camera in cameras for i in camera.marker_ids]).astype(np.int64)
    return ids


def marker_rows(settings: CoreSettings, ids: IntArray) -> IntArray:
    """Index (k,) of each marker in `CoreSettings.marker_ids`; -1 for others."""
    known = _sorted_ids(settings.cameras)
    rows = np.searchsorted(known, ids)
    return np.where(np.append(known, np.iinfo(np.int64).min)[rows] == ids, rows, -1)


def add_observation(
    sums: ObservationStatistics,
    settings: CoreSettings,
    observation: CameraObservation,
    frames_required: int,
    after_ns: int,
) -> bool:
    """Add one frame if it is stamped after ``after_ns`` and its camera needs more frames; returns
    whether it was used.
    """
    camera = next(i for i, c in enumerate(settings.cameras) if c.name == observation.camera)
    if observation.t_shutter_ns <= after_ns or sums.frames[camera] >= frames_required:
        return False
    sums.frames[camera] += 1
    found = marker_rows(settings, observation.ids)
    rows = np.flatnonzero(found >= 0)
    if not rows.size:
        return True
    seen = found[rows]
    pixels = observation.pixels[rows]
    known = sums.counts[camera, seen] > 0
    # The arm is never quite at rest: the common displacement of all markers is motion, the remainder is the detector's
    # noise.
    together = (pixels - sums.first[camera, seen])[known].mean(axis=0) if known.any() else np.zeros(2)
    sums.first[camera, seen[~known]] = pixels[~known] - together
    deviation = pixels - sums.first[camera, seen] - together
    sums.counts[camera, seen] += 1.0
    sums.sums[camera, seen] += pixels
    sums.deviation_sums[camera, seen] += deviation
    sums.square_sums[camera, seen] += (deviation * deviation).sum(axis=-1)
    sums.covariance_sums[camera, seen] += observation.covariances[rows]
    return True


def averages(sums: ObservationStatistics, settings: CoreSettings) -> tuple[Sample, ...]:
    """Mean pixels with the covariance of the mean, of markers seen in at least half of the frames.

    The systematic part of the detector's covariance does not decrease with the number of frames.
    """
    samples = []
    ids = _sorted_ids(settings.cameras)
    for camera, description in enumerate(settings.cameras):
        frames = int(sums.frames[camera])
        seen = (sums.counts[camera] * 2 >= max(frames, 1)) & (sums.counts[camera] > 0)
        n = sums.counts[camera, seen]
        mean = sums.sums[camera, seen] / n[:, None]
        systematic = (1.0 - 1.0 / n)[:, None, None] * description.systematic_px**2 * np.eye(2)
        scatter = sums.square_sums[camera, seen] - (sums.deviation_sums[camera, seen] ** 2).sum(axis=-1) / n
        together = float(seen.sum()) / max(
            float(seen.sum()) - 1.0, 1.0
        )  # the common motion uses one degree of freedom in so many
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
