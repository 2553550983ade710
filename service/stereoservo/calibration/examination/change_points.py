"""Change-point test: whether, and from which frame on, a change of few parameters explains the residuals of a model.

Generalised likelihood ratio over hypotheses and onsets (Basseville, Nikiforov, 1993, 2.4), to first order by
cumulative sums; the best are then estimated in full by `estimate_changes`, and their onsets again. The threshold is the
chi-square quantile of the false-alarm probability over all hypotheses and onsets (Bonferroni), in units of the noise
that is left, its correlation from frame to frame included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from stereoservo.calibration.change.hypothesis_test import (
    REFINED,
    UNCLEAR,
    Tested,
    check_thresholds,
    noise_level,
    penalised_chi2,
    two_best,
)
from stereoservo.calibration.change.model_changes import (
    ModelChange,
    change_jacobian,
    changed_state,
    estimate_changes,
    start_state,
)
from stereoservo.calibration.examination.examined_frames import (
    ExaminedFrames,
    Hypothesis,
    frames_concerned,
    partly_changed,
)
from stereoservo.calibration.examination.frame_times import probable_onset
from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

FALSE_ALARM = 0.001
"""Probability that a recording to which nothing has happened is said to have any change."""
LEAST_PX = 0.25
"""rms change of the pixels below which a change is not told, however significant."""
BLOCKS = 150
"""Onsets that are tried to first order."""
LASTING = 3
"""Frames that a change must last."""
SETTLED = 3
"""Times that the onset is estimated again."""


@dataclass(frozen=True)
class ChangePoint:
    """A change found. ``frames`` (f,): which show it; ``after``: whether these are the later ones. ``onset``: first
    frame of the later ones, among all; ``span``: the first and last frame that the onset may be. ``x`` (q,) with
    ``covariance`` (q, q); ``effect`` (r, 2) [px] on the ``rows`` (k,) concerned. ``runner_up``: a hypothesis that
    explains the data nearly as well.
    """

    hypothesis: Hypothesis
    frames: BoolArray
    after: bool
    onset: int
    span: tuple[int, int]
    x: FloatArray
    covariance: FloatArray
    rows: BoolArray
    effect: FloatArray
    ratio: float
    runner_up: Hypothesis | None = None

    @property
    def effect_px(self) -> float:
        """rms change of the pixels [px] over the frames that show it."""
        return float(np.sqrt((self.effect**2).sum(axis=1).mean()))

    @property
    def throughout(self) -> bool:
        """Whether it is there from the first frame to the last, of stamps: of the cameras that it is of."""
        stamps = self.hypothesis.kind == "stamps"
        return bool(self.frames.all()) or (stamps and self.after and self.onset == 0)


@dataclass(frozen=True)
class _Candidate:
    """A hypothesis with the onset that explains most, and how much of chi-square, to first order."""

    hypothesis: Hypothesis
    after: bool
    onset: int
    gain: float


def best_change(
    problem: ExaminedFrames, views: RecordedViews, tested: list[Hypothesis], middle: int
) -> ChangePoint | None:
    """The most probable significant change, None where there is none; ``middle``: a frame that the model is of."""
    here = problem.residuals_at(start_state(problem))
    found = _likely_changes(problem, views, tested, middle)
    count = here.size
    limits = check_thresholds(FALSE_ALARM, len(tested) * len(views.camera), count)
    chi2 = float(here @ problem.whitened(here))
    left = np.array([chi2 - one.ratio for one in found])
    sizes = np.array([one.hypothesis.change.size for one in found], dtype=np.int64)
    every = np.ones(len(found), dtype=np.bool_)
    noise = noise_level(left, sizes, every, count)
    scores = [_score(left, sizes, k, noise, count) for k in range(len(found))]
    noise *= _correlation(problem, views, found[int(np.argmin(scores))])
    effects = np.array([one.effect_px for one in found])
    best, second = two_best(
        chi2, Tested(left, sizes, effects, every), noise, math.log(count), limits.ratios, LEAST_PX
    )
    if best < 0:
        return None
    if (
        second >= 0
        and _score(left, sizes, second, noise, count) - _score(left, sizes, best, noise, count) < UNCLEAR
    ):
        return replace(found[best], runner_up=found[second].hypothesis)
    return found[best]


def change_of(
    problem: ExaminedFrames, views: RecordedViews, one: Hypothesis, onset: int, span: tuple[int, int], x: float,
    deviation: float,
) -> ChangePoint:  # fmt: skip
    """A change of one known parameter, from ``onset`` on: what it does to the pixels."""
    frames = _frames_of(_Candidate(one, True, onset, 0.0), views, onset)
    rows = frames[problem.data.stop]
    part = problem.select(rows)
    return ChangePoint(
        one, frames, True, onset, span, np.array([x]), np.array([[deviation**2]]), rows,
        change_effect(part, (one.change,), np.array([x])), 0.0,
    )  # fmt: skip


def _likely_changes(
    problem: ExaminedFrames, views: RecordedViews, tested: list[Hypothesis], middle: int
) -> list[ChangePoint]:
    """The changes of the largest gain to first order, significant or not, estimated in full, the likeliest first."""
    here = problem.residuals_at(start_state(problem))
    candidates = [_first_order(problem, views, one, here, middle) for one in tested]
    price = math.log(here.size)
    order = np.argsort([one.hypothesis.change.size * price - one.gain for one in candidates])[:REFINED]
    found = [_lasting(problem, views, _refined(problem, views, candidates[i]), price) for i in order.tolist()]
    return sorted(found, key=lambda one: one.hypothesis.change.size * price - one.ratio)


def _lasting(problem: ExaminedFrames, views: RecordedViews, one: ChangePoint, price: float) -> ChangePoint:
    """A change of stamps as one that is there throughout, where an onset explains less beside that than its ``price``:
    frames of a rest say nothing of stamps.
    """
    if one.hypothesis.kind != "stamps" or one.throughout:
        return one
    whole = _refined(problem, views, _Candidate(one.hypothesis, True, 0, 0.0))
    return whole if whole.ratio >= one.ratio - price else one


def _score(left: FloatArray, sizes: IntArray, k: int, noise: float, count: int) -> float:
    return penalised_chi2(float(left[k]), int(sizes[k]), noise, math.log(count))


def _by_frame(problem: ExaminedFrames, frames: int, rows: FloatArray) -> FloatArray:
    """Sums (f,) of ``rows`` (2 k,) by frame."""
    sums: FloatArray = np.bincount(np.repeat(problem.data.stop, 2), rows, minlength=frames).astype(np.float64)
    return sums


def _first_order(
    problem: ExaminedFrames, views: RecordedViews, one: Hypothesis, here: FloatArray, middle: int
) -> _Candidate:
    """The onset, to a block of frames, at which a hypothesis explains most: later frames changed where it is after
    ``middle``, else earlier ones; of stamps either.
    """
    concerned = frames_concerned(one, views)
    slopes = change_jacobian(problem, (one.change,), np.zeros(one.change.size), here)
    onsets = concerned[LASTING : len(concerned) - LASTING + 1 : max(1, len(concerned) // BLOCKS)]
    best = _Candidate(one, True, 0, -math.inf)
    if not len(onsets):
        return best
    rows = np.searchsorted(problem.data.stop, [0, *onsets.tolist(), len(views.camera)]) * 2
    B, q = problem.uncertainty, one.change.size
    moment, information = np.zeros((len(rows) - 1, q)), np.zeros((len(rows) - 1, q, q))
    shared = np.zeros((len(rows) - 1, q, B.shape[1]))
    for k, (begin, end) in enumerate(pairwise(rows.tolist())):
        J = slopes[begin:end].T
        moment[k], information[k] = J @ here[begin:end], J @ J.T
        shared[k] = J @ B[begin:end]
    across = B.T @ here
    parts = moment, information, shared
    later = _gains(*(np.cumsum(part[::-1], axis=0)[::-1] for part in parts), across=across)
    before = _gains(*(np.cumsum(part, axis=0) for part in parts), across=across)
    if one.kind == "stamps":
        best = _Candidate(one, True, 0, float(later[0]))
    for k, onset in enumerate(onsets.tolist()):
        # A model that is learnt at rest is of no stamps.
        for after in (True, False) if one.kind == "stamps" else (onset > middle,):
            gain = float(later[k + 1] if after else before[k])
            if gain > best.gain:
                best = _Candidate(one, after, onset, gain)
    return best


def _gains(
    moment: FloatArray, information: FloatArray, shared: FloatArray, *, across: FloatArray
) -> FloatArray:
    """Reduction (b,) of chi-square by a change of the frames that ``moment`` (b, q), ``information`` (b, q, q) and
    ``shared`` (b, q, p) are sums of, beside the model's uncertainty, which ``across`` (p,) is the residuals' share in.
    """
    moment = moment - shared @ across
    information = information - shared @ shared.transpose(0, 2, 1)
    scale = np.maximum(np.sqrt(np.einsum("bii->bi", information).clip(min=0.0)), 1e-12)
    scaled = information / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(moment.shape[1])
    y = moment / scale
    found: FloatArray = np.einsum("bq,bq->b", y, np.linalg.solve(scaled, y[..., None])[..., 0])
    return found


def _frames_of(one: _Candidate, views: RecordedViews, onset: int) -> BoolArray:
    """Which frames (f,) show a change."""
    index = np.arange(len(views.camera))
    shown = index >= onset if one.after else index < onset
    mine = np.zeros(len(index), dtype=bool)
    mine[frames_concerned(one.hypothesis, views)] = True
    return np.asarray(shown & mine)


def _refined(problem: ExaminedFrames, views: RecordedViews, one: _Candidate) -> ChangePoint:
    """A candidate estimated in full, with the onset at which it then explains most."""
    here = problem.residuals_at(start_state(problem))
    change, onset, x = one.hypothesis.change, one.onset, None
    span = (onset, onset)
    for _ in range(SETTLED):
        frames = _frames_of(one, views, onset)
        rows = frames[problem.data.stop]
        part = problem.select(rows)
        estimate = estimate_changes(part, (change,), x)
        x, last = estimate.x, onset
        if one.after and one.onset == 0 and onset == 0:
            break  # there throughout
        changed = problem.residuals_at(changed_state(problem, (change,), x))
        onset, span = _onset(problem, views, one, here**2 - changed**2, onset)
        if onset == last:
            break
    frames = _frames_of(one, views, onset)
    rows = frames[problem.data.stop]
    part = problem.select(rows)
    # Beside what all frames tell of the model: those that are changed leave more of it open.
    whole = partly_changed(problem, rows)
    estimate = estimate_changes(whole, (change,), x)
    ratio = float(here @ problem.whitened(here)) - estimate.chi2
    covariance: FloatArray = np.linalg.pinv(estimate.information).astype(np.float64)
    return ChangePoint(
        one.hypothesis, frames, one.after, onset, span, estimate.x, covariance, rows,
        change_effect(part, estimate.changes, estimate.x), ratio,
    )  # fmt: skip


def change_effect(part: ExaminedFrames, changes: tuple[ModelChange, ...], x: FloatArray) -> FloatArray:
    """Change (r, 2) [px] of the pixels, observed less predicted, by changes ``x`` (q,)."""
    plain = replace(part, joint_slopes=np.zeros((0, len(part.order))))
    changed = plain.residuals_at(changed_state(plain, changes, x))
    apart = (changed - plain.residuals_at(start_state(plain))).reshape(-1, 2)
    return np.asarray(apart * part.data.sigmas[:, None])


def _onset(
    problem: ExaminedFrames, views: RecordedViews, one: _Candidate, gains: FloatArray, last: int
) -> tuple[int, tuple[int, int]]:
    """The onset at which a change explains most, by what it gains in each row, and the span of those not excluded."""
    frames = len(views.camera)
    gain = _by_frame(problem, frames, gains)
    concerned = frames_concerned(one.hypothesis, views)
    mine = gain[concerned]
    total = np.cumsum(mine[::-1])[::-1] if one.after else np.concatenate([[0.0], np.cumsum(mine)[:-1]])
    allowed = slice(LASTING, len(concerned) - LASTING + 1)
    if not len(total[allowed]):
        return last, (last, last)
    best, first, end = (int(concerned[LASTING + k]) for k in probable_onset(total[allowed]))
    return best, (first, end)


def _correlation(problem: ExaminedFrames, views: RecordedViews, found: ChangePoint) -> float:
    """How much the noise along a change adds up from frame to frame, over what independent frames would: 1 at least.

    Errors of the joints that change with their positions do; by sums over blocks of frames.
    """
    state = changed_state(problem, (found.hypothesis.change,), found.x)
    here = problem.residuals_at(start_state(problem))
    rows = np.repeat(found.rows, 2)
    left = np.where(rows, problem.residuals_at(state), here)
    left = problem.whitened(left)
    slopes = change_jacobian(problem, (found.hypothesis.change,), np.zeros(found.x.size), here) @ found.x
    frames = len(views.camera)
    concerned = frames_concerned(found.hypothesis, views)
    score = _by_frame(problem, frames, slopes * left)[concerned]
    size = _by_frame(problem, frames, slopes * slopes)[concerned]
    blocks = max(1, int(math.sqrt(len(concerned))))
    edges = np.linspace(0, len(concerned), blocks + 1).astype(int)[:-1]
    sums, sizes = np.add.reduceat(score, edges), np.add.reduceat(size, edges)
    return max(1.0, float((sums**2).sum() / max(float(sizes.sum()), 1e-300)))
