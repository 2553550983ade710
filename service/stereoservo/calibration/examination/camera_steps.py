"""From which frame on all pictures of one camera are displaced, told by that camera alone, before any arm is known.

While no more than one joint is away from where the others' motions pass, a marker's pixel is a ratio of linear forms of
1 and the sine and cosine of that joint (or its way); where no joint is away all joints' forms have one value in common.
A camera that moved adds, from one frame on, a displacement of the picture that is nearly a homography's and has the
same parameters for all markers: generalised likelihood ratio over onsets, the forms free at each.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from stereoservo.calibration.examination.frame_times import probable_onset
from stereoservo.calibration.examination.recorded_views import (
    ALONE,
    RecordedViews,
    instants,
    single_joint_motions,
    stop_positions,
)
from stereoservo.calibration.least_squares import DenseFit, Limits, minimise
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

COURSE = Limits(evaluations=30, tolerance=0.0, settled=1e-6)
"""Of a course's least squares."""
ROUNDS = 6
"""Times that the onset is estimated again."""
LASTING = 3
"""Frames that a step must last, and that must be before it."""
INVERTED, PARALLAX = 4, 0.1
"""Steps in which a displacement is inverted, and the share of it that depends on how far a marker is."""
LEAST_DEPTH = 0.1
"""Of a marker, over that where no joint is away."""
KNOWN = 1e-6
"""Share of a step's information that the forms must leave."""
SPARE = 1.5
"""Values for each unknown of a marker's courses below which nothing is told by it."""
CLEAR, ALONE_BY, NEAR = 100.0, 4.0, 8
"""Chi-square from which a step is one, how many times that of other cameras elsewhere a step of one alone has, and
frames of all cameras within which steps of several are one event."""


class Step(NamedTuple):
    """A step of a camera's pixels at frame ``onset`` (among all), the ``span`` of frames that are not excluded, its
    ``gain``: chi-square that it explains, in the noise that it leaves; and its parameters (q,).
    """

    onset: int
    span: tuple[int, int]
    gain: float
    x: FloatArray


def moved_camera(views: RecordedViews) -> int | None:
    """The camera that alone was moved, by its step in frames of stops, which late stamps do not displace; None where
    none stands out from the others, or another steps there too, as by a joint that drifted.
    """
    stops = instants(views) >= 0
    steps = [step_of_camera(views, c, stops) for c in range(len(views.cameras))]
    camera = int(np.argmax([0.0 if step is None else step.gain for step in steps]))
    mine = steps[camera]
    others = [step for c, step in enumerate(steps) if c != camera and step is not None and step.gain >= CLEAR]
    if mine is None or mine.gain < CLEAR:
        return None
    together = any(
        step.span[0] <= mine.span[1] + NEAR and mine.span[0] <= step.span[1] + NEAR for step in others
    )
    return None if together or any(mine.gain < ALONE_BY * step.gain for step in others) else camera


def step_of_camera(
    views: RecordedViews, camera: int, frames: BoolArray | None = None, marker: int | None = None
) -> Step | None:
    """The step that explains most of a camera's pixels in all or some ``frames`` (f,), of all markers, or one; None
    where too few of them show motions of single joints.
    """
    every = np.flatnonzero(views.camera == camera)
    forms, single = _forms(views)
    mine = every[(single if frames is None else frames & single)[every]]
    tracks = [
        track for i in (range(views.pixels.shape[1]) if marker is None else (marker,))
        if (track := _track(views, mine, i, forms, marker is None)) is not None
    ]  # fmt: skip
    if len(mine) < 2 * LASTING + 1 or not tracks:
        return None
    # A step between two of the frames may be at any of those between them.
    onsets = every[(every >= mine[LASTING]) & (every <= mine[-LASTING])]
    best, shifts = -1, [np.zeros_like(track.pixels) for track in tracks]
    for _ in range(ROUNDS):
        courses = [_course(track, track.pixels - shift) for track, shift in zip(tracks, shifts, strict=True)]
        gains, found, left, freedom = _profile(tracks, courses, onsets)
        level = max((left - float(gains.max())) / freedom, 1e-12)
        k, first, last = probable_onset(gains / level)
        span = int(onsets[first]), int(onsets[last])
        step = Step(int(onsets[k]), span, float(gains.max()) / level, found[k])
        if step.onset == best:
            break
        best = step.onset
        shifts = [
            np.where((track.frames >= best)[:, None], course.warps @ found[k], 0.0)
            for track, course in zip(tracks, courses, strict=True)
        ]
    return step


def without_step(views: RecordedViews, camera: int, step: Step) -> RecordedViews:
    """The recording with the later pixels of a camera where they would be without the step, and as uncertain as a share
    of it is: what a homography does not follow.
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
    (k, r) of the joints there; ``half`` of the picture's width [px], and whether a step may do more than shift it.
    """

    frames: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    forms: FloatArray
    half: float
    together: bool


class _Course(NamedTuple):
    """What forms of the joints predict of a track, (k, 2) [px], how a step's parameters displace that, ``warps``
    (k, 2, q), and an orthonormal basis (2 k, p) of what the forms' parameters change, to first order [sigmas].
    """

    predicted: FloatArray
    warps: FloatArray
    basis: FloatArray


def _forms(views: RecordedViews) -> tuple[FloatArray, BoolArray]:
    """Sine and cosine less 1, or way, of each joint (f, 2 n) from where it mostly is while others move alone, and in
    which frames (f,) no more than one joint is away from there.
    """
    stops = stop_positions(views, instants(views))
    alone = single_joint_motions(stops) >= 0
    middle = np.median(stops[alone], axis=0) if alone.any() else views.positions[0]
    apart = views.at(views.times) - middle
    away = np.abs(apart) > ALONE
    turns = np.array([kind == "revolute" for kind in views.joint_kinds])
    apart = np.where(away, apart, 0.0)
    forms = np.stack(
        [np.where(turns, np.sin(apart), apart), np.where(turns, np.cos(apart) - 1.0, 0.0)], axis=2
    )
    return forms.reshape(len(apart), -1), np.asarray(away.sum(axis=1) <= 1)


def _track(
    views: RecordedViews, frames: IntArray, marker: int, forms: FloatArray, together: bool
) -> _MarkerTrack | None:
    """The track of a marker, its steps those of all markers ``together`` or its own; None where seen too little."""
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


def _course(track: _MarkerTrack, pixels: FloatArray) -> _Course:
    """The course of a track whose pixels (k, 2) are as given: least squares (Levenberg, Marquardt), from forms without
    depth on.
    """
    middle, size = pixels.mean(axis=0), max(float(pixels.std()), 1e-9)
    seen, weight = (pixels - middle) / size, (size / track.sigmas)[:, None]
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

    x = minimise(DenseFit(errors, changes, np.add), x, COURSE).state
    slopes, predicted = changes(x)[:, 0], _predicted(terms, x)[0] * size + middle
    basis, values, _ = np.linalg.svd(slopes, full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]].reshape(2, k, -1).transpose(1, 0, 2).reshape(2 * k, -1)
    return _Course(predicted, _warps(predicted, track.half, track.together), basis)


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
    tracks: list[_MarkerTrack], courses: list[_Course], onsets: IntArray
) -> tuple[FloatArray, FloatArray, float, int]:
    """Reduction (b,) of chi-square by a step at each of ``onsets`` (b,), its parameters (b, q), chi-square without one,
    and the freedom beside one.
    """
    q = courses[0].warps.shape[2]
    moment, information = np.zeros((len(onsets), q)), np.zeros((len(onsets), q, q))
    whole, left, freedom = np.zeros((len(onsets), q)), 0.0, -q
    for track, course in zip(tracks, courses, strict=True):
        weight = np.repeat(1.0 / track.sigmas, 2)
        W = course.warps.reshape(-1, q) * weight[:, None]
        Q = course.basis
        apart = (track.pixels - course.predicted).ravel() * weight
        apart = apart - Q @ (Q.T @ apart)
        begin = 2 * np.searchsorted(track.frames, onsets)
        moment += sums_from(W * apart[:, None], begin)
        whole += sums_from(W * W, begin)
        information += sums_from(np.einsum("ki,kj->kij", W, W), begin)
        shared = sums_from(np.einsum("ki,kj->kij", Q, W), begin)
        information -= np.einsum("bki,bkj->bij", shared, shared)
        left += float(apart @ apart)
        freedom += len(apart) - Q.shape[1]
    # What the forms explain as well says nothing.
    scale = np.sqrt(whole.clip(min=1e-12))
    scaled = information / (scale[:, :, None] * scale[:, None, :]) + KNOWN * np.eye(q)
    y = np.linalg.solve(scaled, (moment / scale)[..., None])[..., 0]
    return (y * moment / scale).sum(axis=1), y / scale, left, max(freedom, 1)


def sums_from(rows: FloatArray, begin: IntArray) -> FloatArray:
    """Sums (b, ...) of ``rows`` (k, ...) from each of ``begin`` (b,) on."""
    none = np.zeros((1, *rows.shape[1:]))
    return np.asarray(np.concatenate([np.cumsum(rows[::-1], axis=0)[::-1], none])[begin])
