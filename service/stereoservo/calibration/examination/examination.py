"""Examination of a recording of joints and images: a model learnt from it, and the changes of cameras, joints,
stamps and frames, each with its onset, size and standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from stereoservo.calibration.change.hypothesis_test import is_unexplained
from stereoservo.calibration.change.model_changes import (
    bounded,
    change_jacobian,
    estimate_changes,
    start_state,
)
from stereoservo.calibration.change.model_check import NOISE_MARGIN, SENTENCES, isolated_outliers
from stereoservo.calibration.examination.change_points import (
    CLEAR,
    FALSE_ALARM,
    LASTING,
    LEAST_PX,
    ChangePoint,
    best_change,
    change_effect,
    change_of,
    moved_camera,
    step_of_camera,
    sums_from,
    without_step,
)
from stereoservo.calibration.examination.recorded_views import (
    ExaminedFrames,
    Gap,
    Hypothesis,
    RecordedViews,
    corrected_views,
    examined_frames,
    frames_concerned,
    gaps,
    hypotheses,
    probable_onset,
)
from stereoservo.calibration.examination.reference_model import (
    AS_GOOD,
    LearningError,
    ReferenceModel,
    learn_reference,
)
from stereoservo.calibration.shutter_offset import LEAST_DEVIATION_S
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

CORRECTION_ROUNDS = 2
"""Rounds of removing a moved camera's displacement from its pixels by a model, and learning the model again."""
MOST_CORRECTIONS, TRIED = 2, 2
"""Most changes that are removed before learning, and number of candidates tried for each."""
FREE = 30.0
"""Factor on the model's standard deviations with which it counts as free: effects of a model error prove nothing."""
ALIKE = 0.98
"""Ratio of explained chi-square from which another hypothesis of the same onset is indistinguishable."""
EXPLAINS = 0.05
"""Least share of chi-square that a change must explain beside the model to be tried."""


class _Step(NamedTuple):
    """Change of one parameter from frame ``onset`` on, ``span`` not excluded; explained ``share`` of chi-square,
    ``beside``: another hypothesis that explains nearly as much.
    """

    hypothesis: Hypothesis
    onset: int
    span: tuple[int, int]
    x: float
    deviation: float
    share: float
    beside: Hypothesis | None = None


def learn_corrected(views: RecordedViews) -> tuple[RecordedViews, ReferenceModel, list[ChangePoint]]:
    """Recording with corrected stamps and joints, the model learnt from it, and the changes that were removed. Raises
    LearningError, CalibrationError (``bad_data``, ``too_few_stops``).
    """
    try:
        reference = learn_reference(views)
    except LearningError:
        moved = _learnt_despite_step(views)
        if moved is None:
            raise
        return views, moved, []
    moved = _learnt_despite_step(views)
    if moved is not None and moved.scatter_px * AS_GOOD < reference.scatter_px:
        return views, moved, []
    views = reference.corrected(views)
    found: list[_Step] = []
    while len(found) < MOST_CORRECTIONS and not reference.fits:
        better = _with_one_correction(views, reference)
        if better is None:
            break
        views, reference, step = better
        found.append(step)
    return views, reference, [_change(views, reference, step) for step in found]


def _learnt_despite_step(views: RecordedViews) -> ReferenceModel | None:
    """Model of an arm and its cameras in their initial state, if one camera moved while the arm is learnt, with that
    camera's later pixels corrected; None if none moved, or more than noise is left.

    The correction is first a homography, then the camera's motion estimated with the model so learnt.
    """
    camera = moved_camera(views) if views.generators is None else None
    if camera is None or (step := step_of_camera(views, camera)) is None:
        return None
    reference = _learnt_or_none(without_step(views, camera, step))
    for _ in range(CORRECTION_ROUNDS):
        if reference is None:
            return None
        reference = _learnt_or_none(_without_camera_motion(views, reference, camera, step.onset))
    return replace(reference, of_first=True) if reference is not None and reference.fits else None


def _without_camera_motion(views: RecordedViews, reference: ReferenceModel, camera: int, onset: int) -> RecordedViews:
    """The recording with a camera's motion, estimated by a model, removed from its pixels from frame ``onset`` on."""
    problem = examined_frames(reference.model, views, reference.noise_factor)
    name = views.cameras[camera].name
    one = next(h for h in hypotheses(reference.model, views, problem) if (h.kind, h.subject) == ("camera", name))
    rows = (problem.data.camera == camera) & (problem.data.stop >= onset)
    part = problem.select(rows)
    estimate = estimate_changes(part, (one.change,))
    column = np.array([views.marker_ids.index(i) for i in reference.model.marker_ids])
    pixels = views.pixels.copy()
    pixels[part.data.stop, column[part.data.marker]] -= change_effect(part, (one.change,), estimate.x)
    return replace(views, pixels=pixels)


def _with_one_correction(
    views: RecordedViews, reference: ReferenceModel
) -> tuple[RecordedViews, ReferenceModel, _Step] | None:
    """Recording and model without the change that explains most; None if the model is no better without it."""
    model, problem = _with_free_model(views, reference)
    # A model learnt at rest does not depend on stamps.
    kinds = ("joint",) if reference.at_rest else ("joint", "stamps")
    steps = [_step(problem, views, one) for one in hypotheses(model, views, problem) if one.kind in kinds]
    for step in sorted(steps, key=lambda one: -one.share)[:TRIED]:
        if step.share < EXPLAINS:
            break
        frames = np.zeros(len(views.camera), dtype=np.bool_)
        concerned = frames_concerned(step.hypothesis, views)
        frames[concerned[concerned >= step.onset]] = True
        corrected = corrected_views(views, step.hypothesis, frames, step.x)
        again = None if corrected is None else _learnt_or_none(corrected)
        if corrected is not None and again is not None and again.scatter_px * AS_GOOD < reference.scatter_px:
            offsets = reference.offsets + again.offsets
            alike = [
                other.hypothesis
                for other in steps
                if other is not step
                and other.share >= ALIKE * step.share
                and max(step.span[0], other.span[0]) <= min(step.span[1], other.span[1])
            ]
            step = step._replace(beside=alike[0] if alike else None)
            return again.corrected(corrected), replace(again, offsets=offsets), step
    return None


def _learnt_or_none(views: RecordedViews) -> ReferenceModel | None:
    try:
        return learn_reference(views)
    except (LearningError, CalibrationError):
        return None


def _with_free_model(views: RecordedViews, reference: ReferenceModel) -> tuple[CellModel, ExaminedFrames]:
    """The model without errors of its joints, and the problem of all frames with that model nearly free."""
    exact = msgspec.structs.replace(reference.model, joint_accuracy=None)
    problem = examined_frames(exact, views, reference.noise_factor)
    root = FREE * problem.root
    return exact, replace(problem, root=root, uncertainty=bounded(root))


def _step(problem: ExaminedFrames, views: RecordedViews, one: Hypothesis, onset: int | None = None) -> _Step:
    """Best onset of a hypothesis of one parameter, over all frames or as given (Rao's score test)."""
    here = problem.residuals_at(start_state(problem))
    slope = change_jacobian(problem, (one.change,), np.zeros(1), here)[:, 0]
    concerned = frames_concerned(one, views)
    onsets = concerned[LASTING : len(concerned) - LASTING + 1]
    if onset is not None:
        onsets = np.array([onset], dtype=np.int64)
    if not len(onsets):
        return _Step(one, 0, (0, 0), 0.0, np.inf, 0.0)
    B = problem.uncertainty
    begin = np.searchsorted(np.repeat(problem.data.stop, 2), onsets)
    shared = sums_from(slope[:, None] * B, begin)
    moment = sums_from((slope * here)[:, None], begin)[:, 0] - shared @ (B.T @ here)
    whole = sums_from((slope * slope)[:, None], begin)[:, 0]
    information = whole - (shared**2).sum(axis=1)
    known = information > 1e-9 * np.maximum(whole, 1e-300)
    gain = np.where(known, moment**2 / np.where(known, information, 1.0), 0.0)
    chi2 = float(here @ problem.whitened(here))
    level = max(1.0, (chi2 - float(gain.max())) / len(here))
    best, first, last = probable_onset(gain / level)
    if not known[best]:
        return _Step(one, 0, (0, 0), 0.0, np.inf, 0.0)
    return _Step(
        one,
        int(onsets[best]),
        (int(onsets[first]), int(onsets[last])),
        float(-moment[best] / information[best]),
        float(np.sqrt(level / information[best])),
        float(gain[best]) / max(chi2, 1e-300),
    )


def _change(views: RecordedViews, reference: ReferenceModel, step: _Step) -> ChangePoint:
    """A removed change as a change point of the corrected recording; its remaining part, to first order,
    is included in the deviation.
    """
    problem = examined_frames(reference.model, views, reference.noise_factor)
    model, free = _with_free_model(views, reference)
    named = {(one.kind, one.subject): one for one in hypotheses(model, views, free)}
    one = named[step.hypothesis.kind, step.hypothesis.subject]
    left = _step(free, views, one, step.onset)
    deviation = float(np.hypot(left.deviation, left.x)) if np.isfinite(left.deviation) else step.deviation
    report = reference.report
    for joint in () if report is None else report.joints:
        if (one.kind, one.subject) == ("joint", joint.name):
            # The reading error at its position does not average out.
            deviation = float(np.hypot(deviation, np.hypot(joint.random, joint.repeatable)))
    found = change_of(problem, views, one, step.onset, step.span, step.x, deviation)
    return replace(found, runner_up=step.beside)


MOST_CHANGES = 8
SAME_ONSET = 4
"""Number of frames within which two onsets count as equal."""
CANCEL, OPEN_S = 5.0, 1e-3
"""Standard deviations, or [s], up to which the sum of two changes of stamps counts as zero."""
AWAY = 0.2
"""Share of its largest distance from its median from which a joint counts as displaced."""
MOST_GAPS = 20
"""Most gaps of a camera's frames that are listed."""
UNLIKELY = 18.4
"""Chi-square of a pixel that noise exceeds once in 10 000."""
UNKNOWN_S = 0.05
"""Standard deviation [s] above which the offset of a camera's stamps counts as unknown."""

RecordingCauseKind = Literal[
    "camera_moved", "cameras_moved", "body_moved", "marker_slipped", "joint_zero", "late_stamps", "dropped_frames",
    "joint_errors", "unexplained", "not_learnt",
]  # fmt: skip
_KINDS: dict[str, RecordingCauseKind] = {
    "camera": "camera_moved",
    "cameras": "cameras_moved",
    "body": "body_moved",
    "marker": "marker_slipped",
    "joint": "joint_zero",
    "stamps": "late_stamps",
}

_REFUSALS: dict[str, RecordingCauseKind] = {
    "camera_moved": "camera_moved",
    "marker_slipped": "marker_slipped",
}
"""Failures of a fit that are causes by themselves."""

_Gaps = dict[str, list[Gap] | None]


class Onset(msgspec.Struct, frozen=True):
    """First frame affected by a change: ``frame`` counts those of ``camera`` from 0; ``earliest`` and ``latest``
    (likewise) are the limits that the data do not exclude. ``time_s``: its stamp; ``after_s``: stamp of the camera's
    last frame before it; both [s] as stamped. ``in_episode``: the frame counted from the first of its ``episode``.
    """

    camera: str
    frame: int
    time_s: float
    after_s: float | None
    earliest: int
    latest: int
    episode: int
    in_episode: int


class RecordingCause(msgspec.Struct, frozen=True):
    """A cause found in a recording. ``onset``: None if it is present throughout. ``episodes``: those whose frames
    differ from the model by it, before the onset if the model was learnt after it. ``value`` with ``deviation``
    [``unit``]; ``effect_px``: rms change of the pixels. ``or_else``: a cause that explains the data nearly as well, and
    ``tells_apart``: observations that would distinguish them.
    """

    kind: RecordingCauseKind
    subject: str
    message: str
    onset: Onset | None = None
    effect_px: float | None = None
    value: float | None = None
    deviation: float | None = None
    unit: str = ""
    or_else: str = ""
    tells_apart: str = ""
    episodes: tuple[int, ...] = ()
    gaps: tuple[tuple[int, int], ...] = ()


class CameraResiduals(msgspec.Struct, frozen=True):
    """Results for a camera: its ``frames``, residuals rms [px] with the causes removed, ``dropped`` frames (None if
    unknown), and the delay [s] of its images after their stamps, with its deviation; None if no motion shows it.
    """

    frames: int
    rms_px: float | None
    dropped: int | None
    offset_s: float | None = None
    offset_deviation_s: float | None = None


class RecordingReport(msgspec.Struct, frozen=True):
    """Result of an examination. Residuals rms [px] per axis with the causes found removed, ``before_px`` without.

    ``joints``: of the frames in which a joint is away from its median. ``learnt_from``: first and last frame (of all),
    number of stops.
    ``false_alarm``: probability that any change is reported for an unchanged recording.
    """

    rms_px: float | None
    before_px: float | None
    sigma_px: float | None
    stratum: str
    cameras: dict[str, CameraResiduals]
    joints: dict[str, float]
    episodes: dict[str, float]
    causes: tuple[RecordingCause, ...]
    notes: tuple[str, ...]
    learnt_from: tuple[int, int, int] | None
    outliers: int
    false_alarm: float = FALSE_ALARM


def examine_views(views: RecordedViews) -> RecordingReport:
    """The report on a recording. Raises CalibrationError (``bad_data``, ``too_few_stops``, ``too_few_cameras``) if
    nothing can be learnt from it.
    """
    lost = _dropped(views)
    dropped = {camera.name: gaps(views, c) for c, camera in enumerate(views.cameras)}
    try:
        views, reference, found = learn_corrected(views)
    except LearningError as failed:
        return _not_learnt(views, failed, lost, dropped)
    model = reference.model
    problem = examined_frames(model, views, reference.noise_factor)
    outliers = isolated_outliers(problem)
    problem = problem.select(~outliers)
    before = _residuals_px(problem)
    tested = hypotheses(model, views, problem)
    while len(found) < MOST_CHANGES:
        change = best_change(problem, views, tested, reference.middle_frame)
        if change is None:
            break
        found.append(change)
        problem = _without(problem, change)
    found = _merged([*found, *_offsets(problem, views, tested, reference.offsets)])
    causes = [_cause(model, views, change) for change in found] + lost
    causes += _joint_errors(reference) + _unexplained(model, views, problem)
    left = _residuals_px(problem)
    return RecordingReport(
        _rms(left),
        _rms(before),
        float(np.median(problem.data.sigmas)),
        model.stratum,
        _by_camera(views, problem, left, tested, found, dropped),
        _by_joint(views, problem, left),
        {str(e): _rms(left[views.episodes[problem.data.stop] == e]) for e in np.unique(views.episodes).tolist()},
        tuple(sorted(causes, key=_when)),
        (*views.notes, *(() if reference.report is None else reference.report.notes)),
        _learnt_from(reference),
        int(outliers.sum()),
    )


def _learnt_from(reference: ReferenceModel) -> tuple[int, int, int] | None:
    return None if reference.stops is None else (reference.first, reference.last, len(reference.stops.frames))


def _offsets(
    problem: ExaminedFrames, views: RecordedViews, tested: list[Hypothesis], offsets: FloatArray
) -> list[ChangePoint]:
    """Offsets (c,) [s] of stamps that were corrected before the model was learnt, as changes."""
    return [
        change_of(problem, views, one, 0, (0, 0), float(offsets[c]), LEAST_DEVIATION_S)
        for c, camera in enumerate(views.cameras)
        if offsets[c] != 0.0
        for one in tested
        if one.kind == "stamps" and one.subject == camera.name
    ]


def _merged(found: list[ChangePoint]) -> list[ChangePoint]:
    """Changes of one parameter, added up for the same subject and onset."""
    kept: list[ChangePoint] = []
    for one in found:
        same = [
            k
            for k, other in enumerate(kept)
            if len(one.x) == 1
            and one.hypothesis.kind == other.hypothesis.kind
            and one.hypothesis.subject == other.hypothesis.subject
            and one.after == other.after
            and abs(one.onset - other.onset) <= SAME_ONSET
        ]
        if same:
            other = kept[same[0]]
            x = other.x + one.x
            effect = other.effect * float(x[0] / other.x[0])
            kept[same[0]] = replace(other, x=x, effect=effect, covariance=one.covariance)
        else:
            kept.append(one)
    # An unnecessary correction is found again with the opposite sign.
    kept = [one for one in kept if one.hypothesis.kind != "stamps" or one.effect_px >= LEAST_PX]
    for early in [one for one in kept if one.hypothesis.kind == "stamps" and not one.after]:
        for k, one in enumerate(kept):
            if one.hypothesis == early.hypothesis and one.throughout and _cancel(one, early):
                kept[k] = replace(
                    one,
                    onset=early.onset,
                    span=early.span,
                    frames=one.frames & ~early.frames,
                    rows=one.rows & ~early.rows,
                    effect=one.effect[~early.rows[one.rows]],
                )
                kept = [other for other in kept if other is not early]
                break
    return kept


def _cancel(one: ChangePoint, other: ChangePoint) -> bool:
    """Whether two changes of stamps add up to zero."""
    spread = float(np.sqrt(one.covariance[0, 0] + other.covariance[0, 0]))
    return abs(float(one.x[0] + other.x[0])) <= max(CANCEL * spread, OPEN_S)


def _when(cause: RecordingCause) -> float:
    return -math.inf if cause.onset is None else cause.onset.time_s


def _residuals_px(problem: ExaminedFrames) -> FloatArray:
    """Residuals (k, 2) [px], predicted minus observed, errors of the joints included."""
    plain = problem.plain_residuals_at(start_state(problem)).reshape(-1, 2)
    return np.asarray(plain * problem.data.sigmas[:, None])


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt((errors**2).mean())) if len(errors) else 0.0


def _without(problem: ExaminedFrames, change: ChangePoint) -> ExaminedFrames:
    """The problem with the effect of a change removed, its parameters left free."""
    part = problem.select(change.rows)
    q = len(change.x)
    slopes = np.zeros((2 * len(problem.data.camera), q))
    here = part.residuals_at(start_state(part))
    values, vectors = np.linalg.eigh(change.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    slopes[np.repeat(change.rows, 2)] = change_jacobian(part, (change.hypothesis.change,), change.x, here) @ root
    return problem.explained(change.rows, change.effect, slopes)


# -- causes in words ------------------------------------------------------------------------------------------


def _onset(views: RecordedViews, frame: int, span: tuple[int, int], camera: int) -> Onset:
    """An onset at ``frame`` among all frames, counted in those of a camera."""
    mine = np.flatnonzero(views.camera == camera)
    k, first, last = (min(int(np.searchsorted(mine, one)), len(mine) - 1) for one in (frame, *span))
    before = float(views.stamped[mine[k - 1]]) if k > 0 else None
    return Onset(
        views.cameras[camera].name, k, float(views.stamped[mine[k]]), before, first, last, int(views.episodes[mine[k]]),
        k - int(np.flatnonzero(views.episodes[mine] == views.episodes[mine[k]])[0]),
    )  # fmt: skip


def _stamp(views: RecordedViews, onset: Onset) -> str:
    stamp = f"{onset.time_s:.3f} s" if views.timed else f"index {onset.time_s:g}"
    several = len(np.unique(views.episodes)) > 1
    return f"{stamp}; frame {onset.in_episode} of episode {onset.episode}" if several else stamp


def _episodes(views: RecordedViews, frames: BoolArray | IntArray) -> tuple[int, ...]:
    return tuple(np.unique(views.episodes[frames]).tolist())


def _amount(model: CellModel, change: ChangePoint) -> tuple[float | None, float | None, str]:
    """Size, deviation and unit of a change: for a rotation its angle, for earlier frames relative to later ones."""
    x, covariance = change.x, change.covariance
    one = change.hypothesis
    sign = 1.0 if change.after else -1.0
    if one.kind == "stamps":
        return sign * float(x[0]), max(float(np.sqrt(covariance[0, 0])), LEAST_DEVIATION_S), "s"
    if one.kind == "joint":
        kind = model.joint_kinds[model.joint_names.index(one.subject)]
        return sign * float(x[0]), float(np.sqrt(covariance[0, 0])), "rad" if kind == "revolute" else "m"
    if len(x) == 6:
        return float(np.linalg.norm(x[:3])), float(np.sqrt(np.trace(covariance[:3, :3]) / 3.0)), "rad"
    return None, None, ""


def _sentence(model: CellModel, one: Hypothesis, value: float | None, deviation: float | None) -> str:
    if one.kind == "joint" and value is None:
        return f"zero of joint {one.subject} drifted"
    if one.kind != "stamps":
        return SENTENCES[one.kind](model, one.subject, value, deviation)
    if value is None or deviation is None:
        return f"stamps of {'camera ' + one.subject if one.subject else 'all cameras, or of the joints,'} are wrong"
    of = f"pictures of camera {one.subject}" if one.subject else "the pictures of all cameras"
    by = f"{1e3 * abs(value):.1f} ± {1e3 * deviation:.1g} ms"
    return f"{of} are {by} {'later' if value > 0.0 else 'earlier'} than their stamps tell, against those of the joints"


def _cause(model: CellModel, views: RecordedViews, change: ChangePoint) -> RecordingCause:
    value, deviation, unit = _amount(model, change)
    one = change.hypothesis
    text = _sentence(model, one, value, deviation)
    onset = None
    if not change.throughout:
        names = [camera.name for camera in views.cameras]
        own = one.kind in ("camera", "stamps") and one.subject
        camera = names.index(one.subject) if own else int(views.camera[change.onset])
        onset = _onset(views, change.onset, change.span, camera)
        text += f", from frame {onset.frame} of camera {onset.camera} on ({_stamp(views, onset)})"
    or_else = tells = ""
    if change.runner_up is not None:
        or_else = _sentence(model, change.runner_up, None, None)
        tells = _distinguishing_data(one, change.runner_up)
        text += f"; or {or_else}: the recording does not tell. What would: {tells}"
    return RecordingCause(
        _KINDS[one.kind], one.subject, f"{text}; {change.effect_px:.3g} px rms", onset, change.effect_px,
        value, deviation, unit, or_else, tells, _episodes(views, change.frames),
    )  # fmt: skip


def _distinguishing_data(one: Hypothesis, other: Hypothesis) -> str:
    kinds = {one.kind, other.kind}
    if "stamps" in kinds:
        return "frames with the arm at rest, which a late stamp does not move"
    if "marker" in kinds:
        return "the other markers of the body in more of the frames"
    if "joint" in kinds and "body" not in kinds and "camera" not in kinds:
        return "a marker that stands still before the cameras, and motion of that joint over more of its range"
    if "camera" in kinds or "cameras" in kinds:
        return "a marker that stands still before the cameras"
    return "motion of the joints concerned over more of their ranges, with the others elsewhere"


def _dropped(views: RecordedViews) -> list[RecordingCause]:
    """Causes of frames that cameras dropped."""
    found = []
    for c, camera in enumerate(views.cameras):
        holes = gaps(views, c)
        if not holes:
            continue
        ranks = views.ranks
        total = sum(hole.missing for hole in holes)
        onset = _onset(views, holes[0].frame, (holes[0].frame, holes[0].frame), c)
        found.append(
            RecordingCause(
                "dropped_frames",
                camera.name,
                f"camera {camera.name} dropped {total} frames in {len(holes)} gaps, the first before its frame "
                f"{onset.frame} ({_stamp(views, onset)})",
                onset,
                value=float(total),
                deviation=0.0,
                unit="frames",
                episodes=_episodes(views, np.array([hole.frame for hole in holes])),
                gaps=tuple((int(ranks[hole.frame]), hole.missing) for hole in holes[:MOST_GAPS]),
            )
        )
    return found


def _joint_errors(reference: ReferenceModel) -> list[RecordingCause]:
    """Errors of the joints' readings, or of the poses, that the model found in its own data."""
    joints = () if reference.report is None else reference.report.joints
    errors = {one.name: float(np.linalg.norm([one.random, one.repeatable, one.posture])) for one in joints}
    if reference.fits or not errors:
        return []
    pixels = {one.name: one.pixels for one in joints}
    listed = ", ".join(f"{name} {error:.2g} ({pixels[name]:.2g} px)" for name, error in errors.items())
    worst = max(pixels, key=lambda name: pixels[name])
    return [
        RecordingCause(
            "joint_errors",
            worst,
            f"readings of the joints (or poses) are wrong by deviations of [rad or m] {listed}, so that pixels scatter "
            f"by {reference.scatter_px:.3g} px where the model was learnt: play, ripple, coarse encoders, or a zero "
            "that drifted meanwhile. What would tell: the same motions once more, which repeat ripple, and play by "
            "direction",
            effect_px=reference.scatter_px,
            value=errors[worst],
        )
    ]


def _unexplained(model: CellModel, views: RecordedViews, problem: ExaminedFrames) -> list[RecordingCause]:
    """Remaining residuals beside the causes, if they are not noise."""
    here = problem.residuals_at(start_state(problem))
    chi2 = float(here @ problem.whitened(here))
    if not is_unexplained(chi2, here.size, math.log(FALSE_ALARM), NOISE_MARGIN**2 * here.size):
        return []
    squares = (here.reshape(-1, 2) ** 2).mean(axis=1)
    by_camera = [float(np.sqrt(squares[problem.data.camera == c].mean())) for c in range(len(views.cameras))]
    worst = int(np.argmax(by_camera))
    frame = np.bincount(problem.data.stop, squares) / np.maximum(np.bincount(problem.data.stop), 1)
    one = int(np.argmax(frame))
    onset = _onset(views, one, (one, one), int(views.camera[one]))
    return [
        RecordingCause(
            "unexplained",
            views.cameras[worst].name,
            f"what is left is {_times(math.sqrt(chi2 / here.size))} times the expected noise and no single change "
            f"explains it: most in camera {views.cameras[worst].name} ({_times(by_camera[worst])} times), the largest "
            f"at frame {onset.frame} of camera {onset.camera} ({_times(math.sqrt(float(frame[one])))} times). "
            "Detections that are worse than stated, play or errors of the joints (or of the poses), stamps that "
            "scatter; a marker that stands still, and frames at rest, would tell pictures from joints",
            onset,
            _rms(_residuals_px(problem)),
            episodes=_episodes(views, problem.data.stop[(here**2).reshape(-1, 2).sum(axis=1) > UNLIKELY]),
        )
    ]


def _times(ratio: float) -> str:
    return f"{ratio:.3g}" if ratio < 100.0 else f"{ratio:.0f}"


def _not_learnt(
    views: RecordedViews, failed: LearningError, lost: list[RecordingCause], dropped: _Gaps
) -> RecordingReport:
    """The report if no model can be learnt: the cause is a camera that moved, else the failure of the fit, with the
    frame of its stop.
    """
    error = failed.error
    names = [camera.name for camera in views.cameras]
    alone = moved_camera(views) if views.generators is None else None
    kind, camera, message = _REFUSALS.get(error.code, "not_learnt"), error.data.get("camera"), error.message
    if alone is not None:
        kind, camera = "camera_moved", names[alone]
    onset = _refused_from(views, failed, names.index(camera) if camera in names else None)
    if kind == "camera_moved":
        # The stops named by the failure may be some near the step.
        message = f"camera {camera} moved: all markers jump in its pictures and stay off, in no other camera"
    if onset is not None:
        message += f"; from frame {onset.frame} of camera {onset.camera} on ({_stamp(views, onset)})"
    cause = RecordingCause(kind, str(camera or error.data.get("joint", "")), message, onset)
    cameras = {
        name: CameraResiduals(int((views.camera == c).sum()), None, _count(dropped[name]))
        for c, name in enumerate(names)
    }
    return RecordingReport(
        None, None, None, "", cameras, {}, {}, (cause, *lost),
        (*views.notes, f"no model could be learnt, so that nothing else was examined: {error.message}"), None, 0,
    )  # fmt: skip


def _refused_from(views: RecordedViews, failed: LearningError, camera: int | None) -> Onset | None:
    """Onset of the cause of a failed fit: of a camera, or a marker, from its pixels; else from the stop named."""
    error, frames = failed.error, failed.stops.frames
    marker, stop = error.data.get("marker"), error.data.get("stop")
    one = views.marker_ids.index(marker) if marker in views.marker_ids else None
    if views.generators is None and (camera is not None or one is not None):
        shown = camera or 0
        step = step_of_camera(views, shown, marker=one)
        if step is not None and step.gain >= CLEAR:
            return _onset(views, step.onset, step.span, shown)
    if not isinstance(stop, int) or not 0 <= stop < len(frames):
        return None
    first = int(frames[stop])
    span = (int(frames[stop - 1]) + 1 if stop else first, first)
    return _onset(views, first, span, int(views.camera[first]) if camera is None else camera)


# -- figures --------------------------------------------------------------------------------------------------


def _count(holes: list[Gap] | None) -> int | None:
    return None if holes is None else sum(hole.missing for hole in holes)


def _by_camera(
    views: RecordedViews,
    problem: ExaminedFrames,
    left: FloatArray,
    tested: list[Hypothesis],
    found: list[ChangePoint],
    dropped: _Gaps,
) -> dict[str, CameraResiduals]:
    """Residuals, offsets and dropped frames of each camera; an offset of all frames is added to its own."""
    late = {one.subject: one for one in tested if one.kind == "stamps"}
    answers = {}
    for c, camera in enumerate(views.cameras):
        mine = problem.data.camera == c
        offset: tuple[float | None, float | None] = (None, None)
        if camera.name in late and mine.any():
            estimate = estimate_changes(problem.select(mine), (late[camera.name].change,))
            deviation = 1.0 / math.sqrt(max(float(estimate.information[0, 0]), 1e-12))
            known = [
                one
                for one in found
                if one.hypothesis.kind == "stamps" and one.throughout and one.hypothesis.subject in ("", camera.name)
            ]
            if known:
                own = max(LEAST_DEVIATION_S, *(float(np.sqrt(one.covariance[0, 0])) for one in known))
                offset = sum(float(one.x[0]) for one in known), own
            elif deviation <= UNKNOWN_S:
                offset = float(estimate.x[0]), max(deviation, LEAST_DEVIATION_S)
        answers[camera.name] = CameraResiduals(
            int((views.camera == c).sum()), _rms(left[mine]), _count(dropped[camera.name]), *offset
        )
    return answers


def _by_joint(views: RecordedViews, problem: ExaminedFrames, left: FloatArray) -> dict[str, float]:
    """Residuals of the frames in which each joint is away from its median."""
    positions = views.at(views.times)
    displaced = np.abs(positions - np.median(positions, axis=0))
    away: BoolArray = displaced > AWAY * displaced.max(axis=0)
    return {name: _rms(left[away[problem.data.stop, j]]) for j, name in enumerate(views.joint_names)}
