"""The model with which a recording is examined: learnt from the part of it that fits best, since the rest may contain
a change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from stereoservo.calibration.calibration_result import CalibrationReport
from stereoservo.calibration.examination.recorded_views import (
    ALONE,
    AT_REST,
    LearningStops,
    RecordedViews,
    instants,
    learning_stops,
    single_joint_motions,
    stop_positions,
)
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import pixel_covariances
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray, IntArray

LARGEST_OFFSET_S, GRID_S = 0.2, 0.02
"""Largest offset that is tried in either direction, and the spacing of the offsets."""
LEAST_OFFSET_S = 2e-3
"""Smaller offsets are estimated by the examination, which uses the calibrated cameras."""
MARKERS = 4
"""Number of markers that are used, those seen most often."""
WEIGHED = 3
"""Rounds of recomputing the weights from the depths."""
SPARE = 2.0
"""Least number of rows per unknown."""


class OffsetEstimate(NamedTuple):
    """Result for some frames: ``offsets`` (c,) [s] of each camera's images after their stamps, and the remaining mean
    square [sigmas²] of the worst camera.
    """

    offsets: FloatArray
    misfit: float


def estimate_offsets(views: RecordedViews, frames: IntArray) -> OffsetEstimate:
    """The `OffsetEstimate` of ``frames`` (k,) of a recording with known displacements.

    A pixel is a ratio of linear forms in the entries of the body's displacement, for any camera and marker: fitted
    to each marker at the displacements of many offsets (direct linear transformation, depths as weights).
    """
    offsets, left = np.zeros(len(views.cameras)), 0.0
    grid = np.arange(-LARGEST_OFFSET_S, LARGEST_OFFSET_S + 0.5 * GRID_S, GRID_S) if views.timed else np.zeros(1)
    for c in range(len(views.cameras)):
        mine = frames[views.camera[frames] == c]
        costs = np.array([_misfit(views, mine, float(late)) for late in grid])
        if not np.isfinite(costs).all():
            continue
        k = int(np.argmin(costs))
        late, least = float(grid[k]), float(costs[k])
        if 0 < k < len(grid) - 1:
            bend = costs[k - 1] - 2.0 * costs[k] + costs[k + 1]
            finer = late + 0.5 * GRID_S * float(costs[k - 1] - costs[k + 1]) / max(float(bend), 1e-300)
            if (refined := _misfit(views, mine, finer)) <= least:
                late, least = finer, refined
            offsets[c] = late if abs(late) >= LEAST_OFFSET_S else 0.0
        left = max(left, least)
    return OffsetEstimate(offsets, left)


def _misfit(views: RecordedViews, mine: IntArray, late: float) -> float:
    """Mean squared residual [sigmas²] of frames ``mine`` at displacements ``late`` [s] after them;
    infinite for too few.
    """
    seen = views.seen[mine]
    forms = _forms(views, views.times[mine] + late)
    cost, freedom = 0.0, 0
    for marker in np.argsort(-seen.sum(axis=0), kind="stable")[:MARKERS].tolist():
        known = seen[:, marker]
        if 2 * known.sum() < SPARE * 3 * forms.shape[1]:
            continue
        pixels, sigmas = views.pixels[mine[known], marker], views.sigmas[mine[known], marker]
        residuals, unknowns = _fitted(forms[known], pixels)
        cost += float(((residuals / sigmas[:, None]) ** 2).sum())
        freedom += residuals.size - unknowns
    return cost / freedom if freedom > 0 else np.inf


def _forms(views: RecordedViews, times: FloatArray) -> FloatArray:
    """Varying entries (k, r) of the displacements, each centred and of unit deviation, and a column of ones."""
    assert views.generators is not None
    chain = ProjectiveChain(views.joint_kinds, views.generators, np.zeros(len(views.joint_kinds)))
    entries = chain.displacements(views.at(times))[:, :3].reshape(len(times), 12)
    spread = entries.std(axis=0)
    changing = spread > 1e-9
    centred = (entries - entries.mean(axis=0))[:, changing] / spread[changing]
    return np.asarray(np.hstack([centred, np.ones((len(times), 1))]))


def _fitted(forms: FloatArray, pixels: FloatArray) -> tuple[FloatArray, int]:
    """Residuals (k, 2) of pixels fitted by ratios of linear forms (k, r), and the number of unknowns."""
    centroid, size = pixels.mean(axis=0), max(float(pixels.std()), 1e-9)
    x = (pixels - centroid) / size
    r = forms.shape[1]
    depths = np.ones(len(forms))
    answer = np.zeros(3 * r - 1)
    for _ in range(WEIGHED):
        F, none = forms / depths[:, None], np.zeros_like(forms)
        design = np.vstack([np.hstack([F, none, -x[:, :1] * F[:, :-1]]), np.hstack([none, F, -x[:, 1:] * F[:, :-1]])])
        answer = np.linalg.lstsq(design, (x / depths[:, None]).T.ravel(), rcond=1e-10)[0]
        found = 1.0 + forms[:, :-1] @ answer[2 * r :]
        if not (np.abs(found) > 1e-6).all():
            break
        depths = found
    ideal = np.column_stack([forms @ answer[:r], forms @ answer[r : 2 * r]]) / depths[:, None]
    return np.asarray((ideal - x) * size), len(answer)


AS_GOOD = 1.1
"""Largest ratio of the whole recording's scatter to the best half's with which the whole is used."""
GOOD = 1.5
"""Ratio of a model's scatter to the noise above which a change is searched for in its own data."""
ORDERS = 2, 4, 6
"""Orders of the differences that estimate the noise of the pixels: high orders suppress a smooth motion."""
NOISE_BLOCK, LEAST_VALUES, LOW = 80, 100, 0.25
"""Frames in a block, least number of differences for a noise estimate, and quantile of the blocks that is used."""


@dataclass(frozen=True)
class ReferenceModel:
    """A ``model`` and its ``report`` from the ``stops`` of frames ``first`` to ``last``; without report and stops if
    it existed before the recording. ``noise``: of the pixels over the stated one, from differences between frames.
    """

    model: CellModel
    report: CalibrationReport | None
    stops: LearningStops | None
    first: int
    last: int
    noise: float
    offsets: FloatArray
    """Delays (c,) [s] of the images after their stamps, found before the model was learnt."""
    at_rest: bool = False
    """Whether its stops are rests, at which stamps have no effect."""
    of_first: bool = False
    """Whether it describes the first frames: later ones were corrected to learn from them."""

    def corrected(self, views: RecordedViews) -> RecordedViews:
        """The recording with the stamps with which the model was learnt."""
        return views.shifted(self.offsets[views.camera]) if self.offsets.any() else views

    @property
    def middle_frame(self) -> int:
        """A frame of the model's own data; -1 if it existed before the first one."""
        return -1 if self.of_first else (self.first + self.last) // 2

    @property
    def noise_factor(self) -> float:
        """Noise of the pixels over the stated one, at least 1: residuals may contain more than noise."""
        return self.noise if self.report is None else max(1.0, min(self.report.sigma_factor, self.noise))

    @property
    def fits(self) -> bool:
        """Whether the residuals of the learnt model are only noise of pixels and, within it, of joints."""
        if self.stops is None:
            return True
        return self.scatter_px <= GOOD * self.noise * float(np.median(self.stops.trials.sigmas))

    @cached_property
    def scatter_px(self) -> float:
        """Expected rms deviation [px] of a pixel at the model's stops, errors of the joints included."""
        if self.stops is None or self.report is None:
            return 0.0
        _, covariances = pixel_covariances(self.model, self.stops.trials.positions)
        own = (max(1.0, self.report.sigma_factor) * float(np.median(self.stops.trials.sigmas))) ** 2
        return float(np.sqrt(0.5 * np.trace(np.median(covariances, axis=(0, 1, 2))) + own))


class LearningError(Exception):
    """No part of a recording gives a model; ``stops``: those of the last attempt, ``error``: its failure."""

    def __init__(self, error: CalibrationError, stops: LearningStops) -> None:
        super().__init__(str(error))
        self.error, self.stops = error, stops


def learn_reference(views: RecordedViews) -> ReferenceModel:
    """The model of the best part. Raises LearningError if there is none, CalibrationError (``bad_data``,
    ``too_few_stops``).
    """
    if not len(views.camera):
        raise CalibrationError("too_few_stops", "the recording has no frame that shows a marker", stops=0)
    none = np.zeros(len(views.cameras))
    if views.generators is None:
        if views.model is not None and _never_alone(views):
            return ReferenceModel(views.model, None, None, -1, -1, frame_noise(views), none)
        return _attempt(views, *_single_joint_stretch(views), none)
    f = len(views.camera)
    stretches = (0, f - 1), (0, f // 2 - 1), (f // 2, f - 1)
    offset_estimates = [estimate_offsets(views, np.arange(first, last + 1)) for first, last in stretches]
    # A part that contains a change does not fit one course.
    whole, *halves = range(3)
    halves.sort(key=lambda k: offset_estimates[k].misfit)
    clean = offset_estimates[whole].misfit <= AS_GOOD**2 * max(1.0, offset_estimates[halves[0]].misfit)
    order = [whole, *halves] if clean else [*halves, whole]
    failed: LearningError | None = None
    for k in order:
        try:
            return _attempt(views, *stretches[k], offset_estimates[k].offsets)
        except LearningError as error:
            failed = failed or error
    assert failed is not None
    raise failed


def frame_noise(views: RecordedViews) -> float:
    """Noise of the pixels over the stated one, at least 1: the smallest estimate from differences of a marker's pixels
    between frames of a camera, of even order by blocks of frames, of first order at rest. An upper bound: it includes
    the remaining motion.
    """
    still = views.speeds(views.times) <= AT_REST
    by_order: dict[int, list[float]] = {order: [] for order in (1, *ORDERS)}
    for c in range(len(views.cameras)):
        mine = np.flatnonzero(views.camera == c)
        pixels = views.pixels[mine] / views.sigmas[mine][..., None]
        positions, resting = views.at(views.times[mine]), still[mine]
        same = resting[1:] & resting[:-1] & (np.abs(np.diff(positions, axis=0)).max(axis=1) <= ALONE)
        by_order[1].append(_noise(np.diff(pixels, axis=0)[same], 1))
        for order in ORDERS:
            differences = np.diff(pixels, n=order, axis=0)
            by_order[order] += [
                _noise(differences[begin : begin + NOISE_BLOCK], order)
                for begin in range(0, len(differences), NOISE_BLOCK)
            ]
    known = [[one for one in found if math.isfinite(one)] for found in by_order.values()]
    return max(1.0, min((float(np.quantile(found, LOW)) for found in known if found), default=1.0))


def _noise(differences: FloatArray, order: int) -> float:
    """Standard deviation of values from their ``differences`` of an ``order``, by the median; infinite for too few."""
    values = np.abs(differences[np.isfinite(differences)])
    if len(values) < LEAST_VALUES:
        return math.inf
    return 1.4826 * float(np.median(values)) / math.sqrt(math.comb(2 * order, order))


def _attempt(views: RecordedViews, first: int, last: int, offsets: FloatArray) -> ReferenceModel:
    right = views.shifted(offsets[views.camera]) if offsets.any() else views
    stretch = right.select(np.arange(first, last + 1))
    stops = learning_stops(stretch)
    stops = LearningStops(stops.trials, stops.frames + first)
    try:
        fit = fit_model(stops.trials, epoch=1)
    except CalibrationError as error:
        raise LearningError(error, stops) from error
    rest = bool((instants(stretch) < 0).any())
    return ReferenceModel(fit.model, fit.report, stops, first, last, frame_noise(views), offsets, rest)


def _never_alone(views: RecordedViews) -> list[str]:
    """Joints that never move alone."""
    alone = single_joint_motions(stop_positions(views, instants(views)))
    return [name for j, name in enumerate(views.joint_names) if not (alone == j).any()]


def _single_joint_stretch(views: RecordedViews) -> tuple[int, int]:
    """First and last frame of the motions of single joints. Raises CalibrationError (``too_few_stops``)."""
    instant = instants(views)
    alone = single_joint_motions(stop_positions(views, instant))
    missing = _never_alone(views)
    if missing:
        raise CalibrationError(
            "too_few_stops",
            f"joint {', '.join(missing)} never moves alone over four stops or more in this recording, and where an "
            "arm's axes are not known they are learnt from that. Move each joint by itself once, or give the hand's "
            "poses in place of joints",
            joints=missing,
        )
    stops = np.unique(instant[instant >= 0])
    moving: IntArray = stops[alone >= 0]
    frames = np.flatnonzero((instant >= moving[0]) & (instant <= moving[-1]))
    return int(frames[0]), int(frames[-1])
