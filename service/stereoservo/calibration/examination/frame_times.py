"""What frames tell by themselves, without a model: those that a camera dropped, by its numbers where it counts them,
else by gaps between stamps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.numerics.arrays import FloatArray, IntArray

GAP, JITTERS = 1.5, 6.0
"""A gap is longer than so many periods, and than a period by so many times the stamps' scatter."""
REGULAR, NEAR = 0.8, 0.25
"""Share of the intervals that must be within a share of the period for there to be one."""
CREDIBLE = 9.2
"""Difference of chi-square within which another onset is not excluded: odds of 100 to 1."""


class Gap(NamedTuple):
    """Frames ``missing`` before the frame of index ``frame`` (among all)."""

    frame: int
    missing: int


def probable_onset(gains: FloatArray) -> tuple[int, int, int]:
    """Median onset, and the first and last that are not excluded, of those (b,) that explain ``gains`` of chi-square:
    all are equally likely beforehand.
    """
    likely = np.cumsum(np.exp(0.5 * (gains - gains.max())))
    near = np.flatnonzero(gains >= gains.max() - CREDIBLE)
    return int(np.searchsorted(likely, 0.5 * likely[-1])), int(near[0]), int(near[-1])


def gaps(views: RecordedViews, camera: int) -> list[Gap] | None:
    """Gaps in a camera's frames; None where these have neither numbers nor a period."""
    mine = np.flatnonzero(views.camera == camera)
    same = np.diff(views.episodes[mine]) == 0
    numbers = views.numbers[mine]
    if (numbers >= 0).all() and len(mine) > 1:
        counted = np.diff(numbers)
        # A stream of every second frame, or fourth, has dropped none.
        every = max(1, int(np.median(counted[same]))) if same.any() else 1
        missing = np.round(counted / every).astype(np.int64) - 1
    else:
        by_stamps = _missing(np.diff(views.times[mine]), same) if views.timed and not views.counted else None
        if by_stamps is None:
            return None
        missing = by_stamps
    return [Gap(int(mine[k + 1]), int(missing[k])) for k in np.flatnonzero(same & (missing > 0)).tolist()]


def _missing(intervals: FloatArray, same: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> IntArray | None:
    """Frames missing in each interval (k,); None where there is no period."""
    if same.sum() < 3:
        return None
    period = float(np.median(intervals[same]))
    away = np.abs(intervals[same] - period)
    if not period > 0.0 or float((away <= NEAR * period).mean()) < REGULAR:
        return None
    jitter = 1.4826 * float(np.median(away))
    long = intervals > max(GAP * period, period + JITTERS * jitter)
    found: IntArray = np.where(long, np.round(intervals / period).astype(np.int64) - 1, 0)
    return found
