"""What frames tell by themselves, without a model: those that a camera dropped, by its numbers where it counts them,
else by gaps between stamps; and where its pixels jump beside what the joints do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.calibration.examination.recorded_views import ALONE, AT_REST, RecordedViews
from stereoservo.numerics.arrays import FloatArray, IntArray

GAP, JITTERS = 1.5, 6.0
"""A gap is longer than so many periods, and than a period by so many times the stamps' scatter."""
REGULAR, NEAR = 0.8, 0.25
"""Share of the intervals that must be within a share of the period for there to be one."""

STOPS_AROUND, NEAR_STOPS = 3, 6
"""Stops to either side that a step is told from, and in which it is looked for."""
CLEAR, ALONE_BY = 100.0, 4.0
"""Chi-square from which a step is one, and how many times that of any other a step that stands out has."""
LASTING = 3
"""Frames beside the terms of a course from which a step can be told from it."""
CREDIBLE = 9.2
"""Difference of chi-square within which another onset is not excluded: odds of 100 to 1."""


class Gap(NamedTuple):
    """Frames ``missing`` before the frame of index ``frame`` (among all)."""

    frame: int
    missing: int


class Step(NamedTuple):
    """A step of a camera's pixels at frame ``onset`` (among all), the ``span`` of frames that are not excluded, and its
    ``gain``: chi-square that it explains, in the noise that it leaves.
    """

    onset: int
    span: tuple[int, int]
    gain: float


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


def step_between(
    views: RecordedViews, camera: int, around: tuple[int, int], between: tuple[int, int]
) -> Step:
    """Frame after ``between[0]``, up to ``between[1]``, from which on a camera's pixels are best explained by a step
    beside cubics of the joints, by the frames ``around``; and the span of such frames that are not excluded.
    """
    first, last = (int(one) for one in between)
    mine = np.flatnonzero(views.camera == camera)
    mine = mine[(mine >= around[0]) & (mine <= around[1])]
    mine = mine[views.seen[mine].any(axis=1)]
    onsets = mine[(mine > first) & (mine <= last)]
    joints = views.at(views.times[mine])
    spread = np.ptp(joints, axis=0)
    moved = joints[:, spread > ALONE]
    moved = (moved - moved.mean(axis=0)) / np.maximum(np.ptp(moved, axis=0), 1e-12)
    terms = np.hstack([np.ones((len(mine), 1)), moved, moved**2, moved**3])
    if len(onsets) < 2 or len(mine) < terms.shape[1] + LASTING:
        return Step(last, (min(first + 1, last), last), 0.0)
    costs = []
    for onset in onsets.tolist():
        design = np.hstack([terms, (mine >= onset).astype(np.float64)[:, None]])
        costs.append(sum(_misfit(design, views, mine, marker) for marker in range(views.pixels.shape[1])))
    best = int(np.argmin(costs))
    # In the noise that the best onset leaves.
    rows = 2 * int(views.seen[mine].sum())
    level = max(float(costs[best]) / rows, 1e-12)
    near = onsets[np.array(costs) <= costs[best] + CREDIBLE * level]
    without = sum(_misfit(terms, views, mine, marker) for marker in range(views.pixels.shape[1]))
    return Step(int(onsets[best]), (int(near[0]), int(near[-1])), (without - float(costs[best])) / level)


def step_near(views: RecordedViews, camera: int, frames: IntArray, stop: int) -> Step:
    """The step of a camera's pixels before a ``stop`` of those that begin at ``frames`` (s,), or before one near it
    where that stands out.
    """
    stated = _step_before(views, camera, frames, stop)
    near = range(max(1, stop - NEAR_STOPS), min(stop + NEAR_STOPS, len(frames) - 1) + 1)
    steps = [_step_before(views, camera, frames, k) for k in near]
    clearest = max(steps, key=lambda one: one.gain, default=stated)
    return clearest if clearest.gain >= ALONE_BY * stated.gain else stated


def step_of_one_camera(views: RecordedViews, frames: IntArray) -> tuple[int, Step] | None:
    """The camera whose pixels alone step before one of the stops that begin at ``frames`` (s,), and the step; None
    where there is none that stands out, among all stops and cameras, and with the arm at rest too.
    """
    stops = range(1, len(frames))
    cameras = range(len(views.cameras))
    found = {(c, k): _step_before(views, c, frames, k) for c in cameras for k in stops}
    if not found:
        return None
    camera, stop = max(found, key=lambda one: found[one].gain)
    best = found[camera, stop]
    others = [one.gain for (c, k), one in found.items() if c != camera or abs(k - stop) > 1]
    resting = views.select(views.speeds(views.times) <= AT_REST)
    begin = np.searchsorted(resting.times, views.times[frames])
    still = _step_before(resting, camera, begin, stop)
    if best.gain < max(CLEAR, ALONE_BY * max(others, default=0.0)) or still.gain < CLEAR:
        return None
    return camera, best


def _step_before(views: RecordedViews, camera: int, frames: IntArray, stop: int) -> Step:
    """The step of a camera's pixels before a ``stop`` of those that begin at ``frames`` (s,)."""
    last = len(frames) - 1
    around = int(frames[max(0, stop - STOPS_AROUND)]), int(frames[min(stop + STOPS_AROUND, last)])
    return step_between(views, camera, around, (int(frames[max(0, stop - 1)]), int(frames[stop])))


def _misfit(design: FloatArray, views: RecordedViews, frames: IntArray, marker: int) -> float:
    """Squares [sigmas²] that a linear model leaves of a marker's pixels in some frames."""
    known = views.seen[frames, marker]
    if known.sum() <= design.shape[1]:
        return 0.0
    at = frames[known]
    pixels = views.pixels[at, marker] / views.sigmas[at, marker, None]
    answer = np.linalg.lstsq(design[known], pixels, rcond=None)[0]
    return float(((pixels - design[known] @ answer) ** 2).sum())
