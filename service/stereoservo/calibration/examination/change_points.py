"""Change-point test: whether, and from which frame on, a change of few parameters explains the residuals of a model.

Generalised likelihood ratio over hypotheses and onsets (Basseville, Nikiforov, 1993, 2.4), to first order by
cumulative sums; the best ones are then estimated in full by `estimate_changes`, and their onsets again. The threshold
is the chi-square quantile of the false-alarm probability over all hypotheses and onsets (Bonferroni), in units of the
residual noise, including its correlation from frame to frame.

Also the frame from which all images of one camera are displaced, by that camera alone, before any arm is known.

While at most one joint is displaced from its median during the others' motions, a marker's pixel is a ratio of linear
forms of 1 and the sine and cosine of that joint (or its displacement); the forms of all joints share their value at
zero displacement. A camera that moved adds, from one frame on, an image displacement that is nearly a homography's and
has the same parameters for all markers: generalised likelihood ratio over onsets, with the forms free at each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

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
from stereoservo.calibration.examination.recorded_views import (
    ALONE,
    ExaminedFrames,
    Hypothesis,
    RecordedViews,
    frames_concerned,
    instants,
    partly_changed,
    probable_onset,
    single_joint_motions,
    stop_positions,
)
from stereoservo.calibration.least_squares import DenseFit, Limits, minimise
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

TRACK_LIMITS = Limits(evaluations=30, tolerance=0.0, settled=1e-6)
"""Termination of the least-squares fit of a track."""
ROUNDS = 6
"""Most times that the onset is estimated again."""
INVERTED, PARALLAX = 4, 0.1
"""Iterations for inverting a displacement, and the share of it that depends on the depth of a marker."""
LEAST_DEPTH = 0.1
"""Least depth of a marker, relative to that at zero displacement of all joints."""
KNOWN = 1e-6
"""Share of a step's information that must be independent of the forms."""
SPARE = 1.5
"""Least number of pixel coordinates per unknown of a marker's track."""
CLEAR, ALONE_BY, NEAR = 100.0, 4.0, 8
"""Chi-square from which a step is significant, ratio to other cameras' steps at other onsets from which one camera's is
accepted, and number of frames (of all cameras) within which steps of several cameras are one event."""


class Step(NamedTuple):
    """A step of a camera's pixels at frame ``onset`` (among all), the ``span`` of frames that are not excluded, its
    ``gain``: explained chi-square in units of the remaining noise; and its parameters (q,).
    """

    onset: int
    span: tuple[int, int]
    gain: float
    x: FloatArray


def moved_camera(views: RecordedViews) -> int | None:
    """The only camera that was moved, by its step in frames of stops, which late stamps do not displace; None if
    none is distinct from the others, or another has a step there too, as with a joint that drifted.
    """
    stops = instants(views) >= 0
    steps = [step_of_camera(views, c, stops) for c in range(len(views.cameras))]
    camera = int(np.argmax([0.0 if step is None else step.gain for step in steps]))
    mine = steps[camera]
    others = [step for c, step in enumerate(steps) if c != camera and step is not None and step.gain >= CLEAR]
    if mine is None or mine.gain < CLEAR:
        return None
    together = any(step.span[0] <= mine.span[1] + NEAR and mine.span[0] <= step.span[1] + NEAR for step in others)
    return None if together or any(mine.gain < ALONE_BY * step.gain for step in others) else camera


def step_of_camera(
    views: RecordedViews, camera: int, frames: BoolArray | None = None, marker: int | None = None
) -> Step | None:
    """The step that explains most of a camera's pixels in all or some ``frames`` (f,), of all markers, or one; None
    if too few of them show motions of single joints.
    """
    every = np.flatnonzero(views.camera == camera)
    forms, single = _forms(views)
    mine = every[(single if frames is None else frames & single)[every]]
    tracks = [
        track
        for i in (range(views.pixels.shape[1]) if marker is None else (marker,))
        if (track := _track(views, mine, i, forms, marker is None)) is not None
    ]
    if len(mine) < 2 * LASTING + 1 or not tracks:
        return None
    # A step between two of these frames may be at any frame between them.
    onsets = every[(every >= mine[LASTING]) & (every <= mine[-LASTING])]
    best, shifts = -1, [np.zeros_like(track.pixels) for track in tracks]
    for _ in range(ROUNDS):
        fits = [_fit_track(track, track.pixels - shift) for track, shift in zip(tracks, shifts, strict=True)]
        gains, found, left, freedom = _profile(tracks, fits, onsets)
        level = max((left - float(gains.max())) / freedom, 1e-12)
        k, first, last = probable_onset(gains / level)
        span = int(onsets[first]), int(onsets[last])
        step = Step(int(onsets[k]), span, float(gains.max()) / level, found[k])
        if step.onset == best:
            break
        best = step.onset
        shifts = [
            np.where((track.frames >= best)[:, None], fit.warps @ found[k], 0.0)
            for track, fit in zip(tracks, fits, strict=True)
        ]
    return step


def without_step(views: RecordedViews, camera: int, step: Step) -> RecordedViews:
    """The recording with the step removed from the later pixels of a camera; their sigmas are increased by a share of
    the step, the part that a homography does not describe.
    """
    later = (views.camera == camera) & (np.arange(len(views.camera)) >= step.onset)
    half, shown = 0.5 * views.cameras[camera].width, views.pixels[later]
    moved = np.zeros_like(shown)
    for _ in range(INVERTED):
        moved = (_warps((shown - moved).reshape(-1, 2), half, len(step.x) > 2) @ step.x).reshape(shown.shape)
    pixels, sigmas = views.pixels.copy(), views.sigmas.copy()
    pixels[later] = shown - moved
    sigmas[later] = np.hypot(sigmas[later], PARALLAX * np.sqrt(np.nanmean(moved**2)))
    return replace(views, pixels=pixels, sigmas=sigmas)


class _MarkerTrack(NamedTuple):
    """``pixels`` (k, 2) and ``sigmas`` (k,) [px] of a marker in the ``frames`` (k,) that show it, with the ``forms``
    (k, r) of the joints there; ``half`` of the image width [px], and whether a step may be more than a shift
    (``together``).
    """

    frames: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    forms: FloatArray
    half: float
    together: bool


class _TrackFit(NamedTuple):
    """Prediction (k, 2) [px] of a track by forms of the joints, its displacements ``warps`` (k, 2, q) by a step's
    parameters, and an orthonormal basis (2 k, p) of its derivatives by the forms' parameters [sigmas].
    """

    predicted: FloatArray
    warps: FloatArray
    basis: FloatArray


def _forms(views: RecordedViews) -> tuple[FloatArray, BoolArray]:
    """Sine and cosine minus 1, or displacement, of each joint (f, 2 n) relative to its median while others move alone,
    and mask of the frames (f,) in which at most one joint is displaced.
    """
    stops = stop_positions(views, instants(views))
    alone = single_joint_motions(stops) >= 0
    median = np.median(stops[alone], axis=0) if alone.any() else views.positions[0]
    displaced = views.at(views.times) - median
    away = np.abs(displaced) > ALONE
    revolute = np.array([kind == "revolute" for kind in views.joint_kinds])
    displaced = np.where(away, displaced, 0.0)
    forms = np.stack(
        [np.where(revolute, np.sin(displaced), displaced), np.where(revolute, np.cos(displaced) - 1.0, 0.0)], axis=2
    )
    return forms.reshape(len(displaced), -1), np.asarray(away.sum(axis=1) <= 1)


def _track(
    views: RecordedViews, frames: IntArray, marker: int, forms: FloatArray, together: bool
) -> _MarkerTrack | None:
    """The track of a marker, with steps of all markers ``together`` or its own; None if seen in too few frames."""
    shown = frames[views.seen[frames, marker]]
    own = forms[shown]
    own = own[:, np.ptp(own, axis=0) > 0.0] if len(own) else own
    if 2 * len(shown) < SPARE * (2 + 3 * own.shape[1]) or not own.shape[1]:
        return None
    half = 0.5 * views.cameras[int(views.camera[shown[0]])].width
    return _MarkerTrack(shown, views.pixels[shown, marker], views.sigmas[shown, marker], own, half, together)


def _warps(pixels: FloatArray, half: float, together: bool) -> FloatArray:
    """Displacements (k, 2, q) of pixels (k, 2) by the parameters of a shift, or of a homography to first order."""
    x, y = ((pixels - half) / half).T
    one, none = np.ones_like(x), np.zeros_like(x)
    rows = [[one, none], [none, one]]
    if together:
        rows += [[x, none], [y, none], [none, x], [none, y], [x * x, x * y], [x * y, y * y]]
    return np.array(rows).transpose(2, 1, 0)


def _fit_track(track: _MarkerTrack, pixels: FloatArray) -> _TrackFit:
    """The course fitted to a track with given pixels (k, 2): least squares (Levenberg, Marquardt), starting from forms
    without depth.
    """
    centroid, size = pixels.mean(axis=0), max(float(pixels.std()), 1e-9)
    seen, weight = (pixels - centroid) / size, (size / track.sigmas)[:, None]
    k, r = track.forms.shape
    terms = np.hstack([np.ones((k, 1)), track.forms])
    none = np.zeros_like(terms)
    x = np.append(np.linalg.lstsq(weight * terms, weight * seen, rcond=None)[0].T.ravel(), np.zeros(r))
    weights = np.vstack([weight, weight])

    def errors(x: FloatArray) -> FloatArray:
        here, depths = _predicted(terms, x)
        return np.where(depths.min() > LEAST_DEPTH, (weight * (here - seen)).T.reshape(-1, 1), np.inf)

    def changes(x: FloatArray) -> FloatArray:
        return (weights * _slopes(terms, none, *_predicted(terms, x)))[:, None]

    x = minimise(DenseFit(errors, changes, np.add), x, TRACK_LIMITS).state
    slopes, predicted = changes(x)[:, 0], _predicted(terms, x)[0] * size + centroid
    basis, values, _ = np.linalg.svd(slopes, full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]].reshape(2, k, -1).transpose(1, 0, 2).reshape(2 * k, -1)
    return _TrackFit(predicted, _warps(predicted, track.half, track.together), basis)


def _predicted(terms: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ratios (k, 2) of forms with coefficients ``x``, and their depths (k, 1)."""
    r = terms.shape[1]
    depths = 1.0 + terms[:, 1:] @ x[2 * r :, None]
    return terms @ x[: 2 * r].reshape(2, r).T / depths, depths


def _slopes(terms: FloatArray, none: FloatArray, here: FloatArray, depths: FloatArray) -> FloatArray:
    """Derivative (2 k, p) of ratios ``here`` (k, 2) by the coefficients, all of one coordinate first."""
    linear, of_depth = terms / depths, terms[:, 1:] / depths
    return np.vstack(
        [
            np.hstack([linear, none, -here[:, :1] * of_depth]),
            np.hstack([none, linear, -here[:, 1:] * of_depth]),
        ]
    )


def _profile(
    tracks: list[_MarkerTrack], fits: list[_TrackFit], onsets: IntArray
) -> tuple[FloatArray, FloatArray, float, int]:
    """Reduction (b,) of chi-square by a step at each of ``onsets`` (b,), its parameters (b, q), chi-square without a
    step, and the degrees of freedom with one.
    """
    q = fits[0].warps.shape[2]
    moment, information = np.zeros((len(onsets), q)), np.zeros((len(onsets), q, q))
    whole, left, freedom = np.zeros((len(onsets), q)), 0.0, -q
    for track, fit in zip(tracks, fits, strict=True):
        weight = np.repeat(1.0 / track.sigmas, 2)
        W = fit.warps.reshape(-1, q) * weight[:, None]
        Q = fit.basis
        residuals = (track.pixels - fit.predicted).ravel() * weight
        residuals = residuals - Q @ (Q.T @ residuals)
        begin = 2 * np.searchsorted(track.frames, onsets)
        moment += sums_from(W * residuals[:, None], begin)
        whole += sums_from(W * W, begin)
        information += sums_from(np.einsum("ki,kj->kij", W, W), begin)
        shared = sums_from(np.einsum("ki,kj->kij", Q, W), begin)
        information -= np.einsum("bki,bkj->bij", shared, shared)
        left += float(residuals @ residuals)
        freedom += len(residuals) - Q.shape[1]
    # Directions that the forms explain as well carry no information.
    scale = np.sqrt(whole.clip(min=1e-12))
    scaled = information / (scale[:, :, None] * scale[:, None, :]) + KNOWN * np.eye(q)
    y = np.linalg.solve(scaled, (moment / scale)[..., None])[..., 0]
    return (y * moment / scale).sum(axis=1), y / scale, left, max(freedom, 1)


def sums_from(rows: FloatArray, begin: IntArray) -> FloatArray:
    """Sums (b, ...) of ``rows`` (k, ...) from each index ``begin`` (b,) to the end."""
    none = np.zeros((1, *rows.shape[1:]))
    return np.asarray(np.concatenate([np.cumsum(rows[::-1], axis=0)[::-1], none])[begin])


FALSE_ALARM = 0.001
"""Probability that any change is reported for an unchanged recording."""
LEAST_PX = 0.25
"""Rms change of the pixels [px] below which a change is not reported, however significant."""
BLOCKS = 150
"""Number of onsets that are tested to first order."""
LASTING = 3
"""Least number of frames after an onset, and before it."""
SETTLED = 3
"""Most times that the onset is estimated again."""


@dataclass(frozen=True)
class ChangePoint:
    """A detected change. ``frames`` (f,): mask of those that show it; ``after``: whether these are the later ones.
    ``onset``: first frame of the later ones, among all; ``span``: first and last frame not excluded as onset. ``x``
    (q,) with ``covariance`` (q, q); ``effect`` (r, 2) [px] on the affected ``rows`` (k,). ``runner_up``: a hypothesis
    that explains the data nearly as well.
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
        """Rms change of the pixels [px] over the frames that show it."""
        return float(np.sqrt((self.effect**2).sum(axis=1).mean()))

    @property
    def throughout(self) -> bool:
        """Whether all frames show it; for a change of stamps, all frames of its cameras."""
        stamps = self.hypothesis.kind == "stamps"
        return bool(self.frames.all()) or (stamps and self.after and self.onset == 0)


@dataclass(frozen=True)
class _Candidate:
    """A hypothesis with its best onset and the explained chi-square, to first order."""

    hypothesis: Hypothesis
    after: bool
    onset: int
    gain: float


def best_change(
    problem: ExaminedFrames, views: RecordedViews, tested: list[Hypothesis], model_frame: int
) -> ChangePoint | None:
    """The most probable significant change, or None; ``model_frame``: a frame of the model's own data."""
    here = problem.residuals_at(start_state(problem))
    found = _likely_changes(problem, views, tested, model_frame)
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
    best, second = two_best(chi2, Tested(left, sizes, effects, every), noise, math.log(count), limits.ratios, LEAST_PX)
    if best < 0:
        return None
    if second >= 0 and _score(left, sizes, second, noise, count) - _score(left, sizes, best, noise, count) < UNCLEAR:
        return replace(found[best], runner_up=found[second].hypothesis)
    return found[best]


def change_of(
    problem: ExaminedFrames,
    views: RecordedViews,
    one: Hypothesis,
    onset: int,
    span: tuple[int, int],
    x: float,
    deviation: float,
) -> ChangePoint:
    """A change of one known parameter, from ``onset`` on, with its effect on the pixels."""
    frames = _frames_of(_Candidate(one, True, onset, 0.0), views, onset)
    rows = frames[problem.data.stop]
    part = problem.select(rows)
    return ChangePoint(
        one, frames, True, onset, span, np.array([x]), np.array([[deviation**2]]), rows,
        change_effect(part, (one.change,), np.array([x])), 0.0,
    )  # fmt: skip


def _likely_changes(
    problem: ExaminedFrames, views: RecordedViews, tested: list[Hypothesis], model_frame: int
) -> list[ChangePoint]:
    """The changes of largest first-order gain, significant or not, estimated in full, the most likely first."""
    here = problem.residuals_at(start_state(problem))
    candidates = [_first_order(problem, views, one, here, model_frame) for one in tested]
    price = math.log(here.size)
    order = np.argsort([one.hypothesis.change.size * price - one.gain for one in candidates])[:REFINED]
    found = [_lasting(problem, views, _refined(problem, views, candidates[i]), price) for i in order.tolist()]
    return sorted(found, key=lambda one: one.hypothesis.change.size * price - one.ratio)


def _lasting(problem: ExaminedFrames, views: RecordedViews, one: ChangePoint, price: float) -> ChangePoint:
    """A change of stamps as one of all frames, unless an onset explains more than its ``price`` in addition:
    frames at rest carry no information on stamps.
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
    problem: ExaminedFrames, views: RecordedViews, one: Hypothesis, here: FloatArray, model_frame: int
) -> _Candidate:
    """The best onset of a hypothesis, to a block of frames: later frames are changed if it is after
    ``model_frame``, else earlier ones; for stamps either.
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
        # A model that was learnt at rest does not depend on stamps.
        for after in (True, False) if one.kind == "stamps" else (onset > model_frame,):
            gain = float(later[k + 1] if after else before[k])
            if gain > best.gain:
                best = _Candidate(one, after, onset, gain)
    return best


def _gains(moment: FloatArray, information: FloatArray, shared: FloatArray, *, across: FloatArray) -> FloatArray:
    """Reduction (b,) of chi-square by a change of some frames, beside the model's uncertainty. ``moment`` (b, q),
    ``information`` (b, q, q) and ``shared`` (b, q, p) are sums over these frames; ``across`` (p,): projection of the
    residuals on the uncertainty.
    """
    moment = moment - shared @ across
    information = information - shared @ shared.transpose(0, 2, 1)
    scale = np.maximum(np.sqrt(np.einsum("bii->bi", information).clip(min=0.0)), 1e-12)
    scaled = information / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(moment.shape[1])
    y = moment / scale
    found: FloatArray = np.einsum("bq,bq->b", y, np.linalg.solve(scaled, y[..., None])[..., 0])
    return found


def _frames_of(one: _Candidate, views: RecordedViews, onset: int) -> BoolArray:
    """Mask (f,) of the frames that show a change."""
    index = np.arange(len(views.camera))
    shown = index >= onset if one.after else index < onset
    mine = np.zeros(len(index), dtype=bool)
    mine[frames_concerned(one.hypothesis, views)] = True
    return np.asarray(shown & mine)


def _refined(problem: ExaminedFrames, views: RecordedViews, one: _Candidate) -> ChangePoint:
    """A candidate estimated in full, with its best onset after that."""
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
            break  # present throughout
        changed = problem.residuals_at(changed_state(problem, (change,), x))
        onset, span = _onset(problem, views, one, here**2 - changed**2, onset)
        if onset == last:
            break
    frames = _frames_of(one, views, onset)
    rows = frames[problem.data.stop]
    part = problem.select(rows)
    # With the model constrained by all frames: the changed ones alone determine it less well.
    whole = partly_changed(problem, rows)
    estimate = estimate_changes(whole, (change,), x)
    ratio = float(here @ problem.whitened(here)) - estimate.chi2
    return ChangePoint(
        one.hypothesis, frames, one.after, onset, span, estimate.x, estimate.covariance, rows,
        change_effect(part, estimate.changes, estimate.x), ratio,
    )  # fmt: skip


def change_effect(part: ExaminedFrames, changes: tuple[ModelChange, ...], x: FloatArray) -> FloatArray:
    """Change (r, 2) [px] of the pixels, observed minus predicted, by changes ``x`` (q,)."""
    plain = replace(part, joint_slopes=np.zeros((0, len(part.order))))
    changed = plain.residuals_at(changed_state(plain, changes, x))
    effect = (changed - plain.residuals_at(start_state(plain))).reshape(-1, 2)
    return np.asarray(effect * part.data.sigmas[:, None])


def _onset(
    problem: ExaminedFrames, views: RecordedViews, one: _Candidate, gains: FloatArray, last: int
) -> tuple[int, tuple[int, int]]:
    """The best onset of a change, from its gain in each row, and the span of onsets that are not excluded."""
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
    """Variance of the noise along a change, over that of independent frames, at least 1: correlation between frames.

    Joint errors that change with position cause it; estimated from sums over blocks of frames.
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
