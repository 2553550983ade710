"""Places at which a body that is waved by hand was held still, from the observations of all cameras over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from stereoservo.calibration.camera_rig.views import LEAST_MARKERS, RigViews
from stereoservo.calibration.trial_data import TrialCamera
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation

STILL_PX = 0.5
"""Median change of the markers from one frame to the next up to which a body is still [px]."""
GAP_S = 0.25
"""Frames farther apart in time are no neighbours."""
HELD_S = 0.3
"""How long the body must be still before all cameras that see it."""
ELSEWHERE_PX = 8.0
"""Median distance of the markers, in some camera, from the place before that makes another place."""


@dataclass(frozen=True)
class _Still:
    """An interval [ns] in which one camera saw the body still, or (``empty``) did not see it."""

    began: int
    ended: int
    empty: bool


def still_places(cameras: Sequence[TrialCamera], seen: Mapping[str, Sequence[CameraObservation]]) -> RigViews:
    """The views of a body at the places at which it was held still for ``HELD_S`` before all cameras that saw it; each
    camera's pixels are the means over that time, with the detector's standard deviations.
    """
    ids = tuple(sorted({int(i) for one in seen.values() for o in one for i in o.ids}))
    times = [_intervals(seen[camera.name]) for camera in cameras]
    common = [(still.began, still.ended) for still in times[0]] if times else []
    for one in times[1:]:
        common = [
            (max(a, still.began), min(b, still.ended)) for a, b in common for still in one
            if min(b, still.ended) - max(a, still.began) >= HELD_S * 1e9
        ]  # fmt: skip
    pixels: list[FloatArray] = []
    sigmas: list[FloatArray] = []
    names: list[str] = []
    start = min((one[0].t_shutter_ns for one in seen.values() if len(one)), default=0)
    for began, ended in common:
        if ended - began < HELD_S * 1e9:
            continue
        views = [_mean(seen[camera.name], began, ended, ids) for camera in cameras]
        place = np.array([pixel for pixel, _ in views])
        if not (np.isfinite(place).all(axis=2).sum(axis=1) >= LEAST_MARKERS).any():
            continue
        if pixels and not _elsewhere(place, pixels[-1]):
            continue
        pixels.append(place)
        sigmas.append(np.array([sigma for _, sigma in views]))
        names.append(f"{(began - start) * 1e-9:.1f} s")
    shape = (0, len(cameras), len(ids))
    stacked = np.array(pixels).reshape(-1, *shape[1:], 2).transpose(1, 0, 2, 3)
    return RigViews(
        tuple(cameras),
        ids,
        tuple(names),
        stacked,
        np.array(sigmas).reshape(-1, *shape[1:]).transpose(1, 0, 2),
    )


def _intervals(observations: Sequence[CameraObservation]) -> list[_Still]:
    """When the body was still before one camera, or not seen by it."""
    found: list[_Still] = []
    for before, after in pairwise(observations):
        if after.t_shutter_ns - before.t_shutter_ns > GAP_S * 1e9:
            continue
        few = max(len(before.ids), len(after.ids)) < LEAST_MARKERS
        if not few:
            common, a, b = np.intersect1d(before.ids, after.ids, return_indices=True)
            if len(common) < LEAST_MARKERS:
                continue
            if float(np.median(np.linalg.norm(after.pixels[b] - before.pixels[a], axis=1))) > STILL_PX:
                continue
        last = found[-1] if found else None
        if last is not None and last.ended == before.t_shutter_ns and last.empty == few:
            found[-1] = _Still(last.began, after.t_shutter_ns, few)
        else:
            found.append(_Still(before.t_shutter_ns, after.t_shutter_ns, few))
    return found


def _mean(
    observations: Sequence[CameraObservation], began: int, ended: int, ids: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Mean pixels (m, 2), NaN where a marker was in less than half of the frames, and the detector's sigmas (m,)."""
    inside = [o for o in observations if began <= o.t_shutter_ns <= ended]
    column = {marker: k for k, marker in enumerate(ids)}
    total, squares, count = np.zeros((len(ids), 2)), np.zeros(len(ids)), np.zeros(len(ids))
    for one in inside:
        at = [column[int(i)] for i in one.ids]
        total[at] += one.pixels
        squares[at] += 0.5 * np.trace(one.covariances, axis1=1, axis2=2)
        count[at] += 1
    often = count >= max(1.0, 0.5 * len(inside))
    safe = np.maximum(count, 1.0)
    pixels = np.where(often[:, None], total / safe[:, None], np.nan)
    return pixels, np.where(often, np.sqrt(np.maximum(squares / safe, 1e-12)), 1.0)


def _elsewhere(place: FloatArray, before: FloatArray) -> bool:
    """Whether the body (c, m, 2) is away from where it was."""
    for here, there in zip(place, before, strict=True):
        common = np.isfinite(here).all(axis=1) & np.isfinite(there).all(axis=1)
        if common.any() and float(np.median(np.linalg.norm((here - there)[common], axis=1))) > ELSEWHERE_PX:
            return True
    seen = [np.asarray(np.isfinite(one).all(axis=2)).any(axis=1) for one in (place, before)]
    return bool((seen[0] != seen[1]).any())
