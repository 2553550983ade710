"""What happened to joints and stamps while the model of a recording was learnt: found beside a model that is free to be
another, taken back from the recording, and the model learnt again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import msgspec
import numpy as np

from stereoservo.calibration.change.model_changes import (
    bounded,
    change_jacobian,
    estimate_changes,
    start_state,
)
from stereoservo.calibration.examination.camera_steps import (
    moved_camera,
    step_of_camera,
    sums_from,
    without_step,
)
from stereoservo.calibration.examination.change_points import LASTING, ChangePoint, change_effect, change_of
from stereoservo.calibration.examination.examined_frames import (
    ExaminedFrames,
    Hypothesis,
    corrected_views,
    examined_frames,
    frames_concerned,
    hypotheses,
)
from stereoservo.calibration.examination.frame_times import probable_onset
from stereoservo.calibration.examination.recorded_views import RecordedViews
from stereoservo.calibration.examination.reference_model import (
    AS_GOOD,
    LearningError,
    ReferenceModel,
    learn_reference,
)
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.model import CellModel

PUT_BACK = 2
"""Times that the pixels of a camera that moved are put back by a model, and it is learnt again."""
MENDS, TRIED = 2, 2
"""Times that something is taken back, and changes that are tried for each."""
FREE = 30.0
"""Deviations of the model that count as one: what a change of the model explains says nothing."""
ALIKE = 0.98
"""Share of what a change explains from which another one, from the same frames on, is not told apart from it."""
EXPLAINS = 0.05
"""Share of chi-square that a change must explain beside the model to be tried."""


class _Step(NamedTuple):
    """Change of one parameter from frame ``onset`` on, ``span`` not excluded; ``share`` of chi-square it explains,
    ``beside`` another hypothesis that explains nearly as much.
    """

    hypothesis: Hypothesis
    onset: int
    span: tuple[int, int]
    x: float
    deviation: float
    share: float
    beside: Hypothesis | None = None


def learnt_and_put_right(views: RecordedViews) -> tuple[RecordedViews, ReferenceModel, list[ChangePoint]]:
    """Recording, with stamps and joints put right, the model learnt from it, and what was taken back. Raises
    LearningError, CalibrationError (``bad_data``, ``too_few_stops``).
    """
    try:
        reference = learn_reference(views)
    except LearningError:
        moved = _learnt_beside_step(views)
        if moved is None:
            raise
        return views, moved, []
    moved = _learnt_beside_step(views)
    if moved is not None and moved.scatter_px * AS_GOOD < reference.scatter_px:
        return views, moved, []
    views = reference.put_right(views)
    found: list[_Step] = []
    while len(found) < MENDS and not reference.fits:
        better = _better(views, reference)
        if better is None:
            break
        views, reference, step = better
        found.append(step)
    return views, reference, [_change(views, reference, step) for step in found]


def _learnt_beside_step(views: RecordedViews) -> ReferenceModel | None:
    """The model of an arm and its cameras as they were first, where one of these moved while the arm is learnt, its
    later pixels put back; None where none did, or more than noise is left.

    First along a homography, then by the camera's motion as the model so learnt tells it.
    """
    camera = moved_camera(views) if views.generators is None else None
    if camera is None or (step := step_of_camera(views, camera)) is None:
        return None
    reference = _learnt(without_step(views, camera, step))
    for _ in range(PUT_BACK):
        if reference is None:
            return None
        reference = _learnt(_put_back(views, reference, camera, step.onset))
    return replace(reference, of_first=True) if reference is not None and reference.fits else None


def _put_back(views: RecordedViews, reference: ReferenceModel, camera: int, onset: int) -> RecordedViews:
    """The recording with a camera's pixels from a frame on as they would be had it not moved, by a model."""
    problem = examined_frames(reference.model, views, reference.noise_factor)
    name = views.cameras[camera].name
    one = next(
        h for h in hypotheses(reference.model, views, problem) if (h.kind, h.subject) == ("camera", name)
    )
    rows = (problem.data.camera == camera) & (problem.data.stop >= onset)
    part = problem.select(rows)
    estimate = estimate_changes(part, (one.change,))
    column = np.array([views.marker_ids.index(i) for i in reference.model.marker_ids])
    pixels = views.pixels.copy()
    pixels[part.data.stop, column[part.data.marker]] -= change_effect(part, (one.change,), estimate.x)
    return replace(views, pixels=pixels)


def _better(
    views: RecordedViews, reference: ReferenceModel
) -> tuple[RecordedViews, ReferenceModel, _Step] | None:
    """Recording and model without the change that explains most, None where the model is no better without."""
    model, problem = _freed(views, reference)
    # What is learnt at rest does not depend on stamps.
    kinds = ("joint",) if reference.at_rest else ("joint", "stamps")
    steps = [_step(problem, views, one) for one in hypotheses(model, views, problem) if one.kind in kinds]
    for step in sorted(steps, key=lambda one: -one.share)[:TRIED]:
        if step.share < EXPLAINS:
            break
        frames = np.zeros(len(views.camera), dtype=np.bool_)
        concerned = frames_concerned(step.hypothesis, views)
        frames[concerned[concerned >= step.onset]] = True
        mended = corrected_views(views, step.hypothesis, frames, step.x)
        again = None if mended is None else _learnt(mended)
        if mended is not None and again is not None and again.scatter_px * AS_GOOD < reference.scatter_px:
            offsets = reference.offsets + again.offsets
            alike = [
                other.hypothesis for other in steps
                if other is not step and other.share >= ALIKE * step.share
                and max(step.span[0], other.span[0]) <= min(step.span[1], other.span[1])
            ]  # fmt: skip
            step = step._replace(beside=alike[0] if alike else None)
            return again.put_right(mended), replace(again, offsets=offsets), step
    return None


def _learnt(views: RecordedViews) -> ReferenceModel | None:
    try:
        return learn_reference(views)
    except (LearningError, CalibrationError):
        return None


def _freed(views: RecordedViews, reference: ReferenceModel) -> tuple[CellModel, ExaminedFrames]:
    """The model without errors of its joints, and the problem of all frames with that model free to change."""
    exact = msgspec.structs.replace(reference.model, joint_accuracy=None)
    problem = examined_frames(exact, views, reference.noise_factor)
    root = FREE * problem.root
    return exact, replace(problem, root=root, uncertainty=bounded(root))


def _step(problem: ExaminedFrames, views: RecordedViews, one: Hypothesis, onset: int | None = None) -> _Step:
    """The onset of a hypothesis of one parameter that explains most, of every frame or as given (Rao's score test)."""
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
        one, int(onsets[best]), (int(onsets[first]), int(onsets[last])), float(-moment[best] / information[best]),
        float(np.sqrt(level / information[best])), float(gain[best]) / max(chi2, 1e-300),
    )  # fmt: skip


def _change(views: RecordedViews, reference: ReferenceModel, step: _Step) -> ChangePoint:
    """What was taken back as a change point of the recording as it now is; what is then still left of it, to first
    order, is part of its deviation.
    """
    problem = examined_frames(reference.model, views, reference.noise_factor)
    model, free = _freed(views, reference)
    named = {(one.kind, one.subject): one for one in hypotheses(model, views, free)}
    one = named[step.hypothesis.kind, step.hypothesis.subject]
    left = _step(free, views, one, step.onset)
    deviation = float(np.hypot(left.deviation, left.x)) if np.isfinite(left.deviation) else step.deviation
    report = reference.report
    for joint in () if report is None else report.joints:
        if (one.kind, one.subject) == ("joint", joint.name):
            # What its readings err by where it stands is not averaged out.
            deviation = float(np.hypot(deviation, np.hypot(joint.random, joint.repeatable)))
    found = change_of(problem, views, one, step.onset, step.span, step.x, deviation)
    return replace(found, runner_up=step.beside)
