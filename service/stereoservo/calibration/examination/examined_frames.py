"""The frames of a recording as residuals of a learnt model, whitened by the errors of the joints and by the model's own
uncertainty, and what may have happened to them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal

import msgspec
import numpy as np

from stereoservo.calibration.change.model_changes import (
    LinearisedProblem,
    ModelChange,
    State,
    bounded,
    linearised_problem,
    possible_changes,
    unbounded,
)
from stereoservo.calibration.examination.recorded_views import RecordedViews, frames_apart
from stereoservo.calibration.joint_errors.joint_noise import joint_columns
from stereoservo.calibration.rig_model import displacements, predicted
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

HypothesisKind = Literal["camera", "cameras", "body", "marker", "joint", "stamps"]

LOOSE = 1e3
"""Deviations of its estimate within which a cause that was found is left free."""


@dataclass(frozen=True)
class Hypothesis:
    """What may have happened: a ``change`` of the model, or of the stamps of a camera (its ``subject``, "" for all)."""

    kind: HypothesisKind
    subject: str
    change: ModelChange


@dataclass(frozen=True)
class ExaminedFrames(LinearisedProblem):
    """Problem whose stops are frames, its rows in the order of these. ``root`` (2 k, p) of the covariance that the
    model's uncertainty adds to the residuals. ``joint_slopes`` (2 k, n): by the errors of the joints, in their standard
    deviations; residuals are whitened of what these have in common in a frame.
    """

    root: FloatArray
    joint_slopes: FloatArray

    @cached_property
    def _whiteners(self) -> tuple[IntArray, FloatArray]:
        """Of each row its place (2 k,) in a padded table of frames (f, w), and matrices (f, w, w) that whiten it."""
        frame = np.repeat(self.data.stop, 2)
        _, begin, which = np.unique(frame, return_index=True, return_inverse=True)
        place = np.arange(len(frame)) - begin[which]
        width = int(place.max(initial=0)) + 1
        slopes = np.zeros((len(begin), width, self.joint_slopes.shape[1]))
        slopes[which, place] = self.joint_slopes
        covariance = np.eye(width) + slopes @ slopes.transpose(0, 2, 1)
        return which * width + place, np.linalg.inv(np.linalg.cholesky(covariance))

    @cached_property
    def _undrifted(self) -> FloatArray:
        """Displacements (f, 4, 4) of the body where no joint has drifted."""
        return displacements(self.rig, self.data.offsets)

    def plain_residuals_at(self, state: State) -> FloatArray:
        """Weighted residuals (2 k,), errors of the joints included."""
        rig, drift = state
        if rig.generators is not self.rig.generators or drift.any():
            return super().residuals_at(state)
        apart = predicted(rig, self.data, self._undrifted) - self.data.pixels
        return np.asarray((apart / self.data.sigmas[:, None]).ravel())

    def residuals_at(self, state: State) -> FloatArray:
        return self.without_joint_errors(self.plain_residuals_at(state)[:, None])[:, 0]

    def without_joint_errors(self, rows: FloatArray) -> FloatArray:
        """Rows (2 k, q) whitened frame by frame."""
        if not self.joint_slopes.size:
            return rows
        place, whiteners = self._whiteners
        table = np.zeros((whiteners.shape[0] * whiteners.shape[1], rows.shape[1]))
        table[place] = rows
        white = whiteners @ table.reshape(*whiteners.shape[:2], -1)
        return np.asarray(white.reshape(len(table), -1)[place])

    def select(self, keep: BoolArray) -> ExaminedFrames:
        twice = np.repeat(keep, 2)
        slopes = self.joint_slopes[twice] if self.joint_slopes.size else self.joint_slopes
        root = self.root[twice]
        return replace(
            self, data=self.data.select(keep), root=root, uncertainty=bounded(root), joint_slopes=slopes
        )

    def explained(self, rows: BoolArray, effect: FloatArray, slopes: FloatArray) -> ExaminedFrames:
        """The problem where an ``effect`` (r, 2) [px] is removed from the pixels of ``rows`` (k,), along whose
        ``slopes`` (2 k, q), in deviations of the estimate, they then say nothing.
        """
        pixels = self.data.pixels.copy()
        pixels[rows] -= effect
        root = np.hstack([self.root, LOOSE * slopes])
        return replace(self, data=replace(self.data, pixels=pixels), root=root, uncertainty=bounded(root))


@dataclass(frozen=True)
class PartlyChanged(ExaminedFrames):
    """All frames, of which a changed state is that of some alone: those of the rows ``changed`` (k,)."""

    changed: BoolArray

    @cached_property
    def _unchanged(self) -> FloatArray:
        return super().residuals_at((self.rig, np.zeros(len(self.order))))

    def residuals_at(self, state: State) -> FloatArray:
        return np.where(np.repeat(self.changed, 2), super().residuals_at(state), self._unchanged)


def partly_changed(problem: ExaminedFrames, changed: BoolArray) -> PartlyChanged:
    """The problem in which a change is one of some rows (k,), whole frames."""
    parts = {field.name: getattr(problem, field.name) for field in fields(problem)}
    return PartlyChanged(**parts, changed=changed)


def examined_frames(model: CellModel, views: RecordedViews, noise_factor: float) -> ExaminedFrames:
    """The problem of all frames; ``noise_factor`` >= 1 multiplies every sigma. Raises CalibrationError."""
    exact = msgspec.structs.replace(model, joint_accuracy=None)
    plain = linearised_problem(exact, frames_apart(views), None, noise_factor)
    order = np.argsort(plain.data.stop, kind="stable")
    data = plain.data.select(order)
    root = unbounded(plain.uncertainty)[(2 * order[:, None] + np.arange(2)).ravel()]
    slopes = np.zeros((0, len(model.joint_names)))
    if model.joint_accuracy is not None:
        accuracy = model.joint_accuracy.in_order(np.array(plain.order))
        deviations = accuracy.deviations(data.offsets)[data.stop]
        slopes = joint_columns(plain.rig, data) * np.repeat(deviations, 2, axis=0)
    made = ExaminedFrames(plain.rig, data, root, plain.order, root, slopes)
    root = made.without_joint_errors(root)
    return replace(made, root=root, uncertainty=bounded(root))


def hypotheses(model: CellModel, views: RecordedViews, problem: ExaminedFrames) -> list[Hypothesis]:
    """All that may have happened: changes of the model, and where stamps are times, late ones.

    Of an arm whose displacements are given the joints have no zeros of their own; what moved is then the body or all
    cameras. Of a body that moves by itself stamps are not asked for.
    """
    found = [
        Hypothesis(change.kind, change.subject, change)
        for change in possible_changes(model, problem)
        if views.generators is None or change.kind != "joint"
    ]
    if views.timed and not views.body_moves:
        for c, camera in enumerate(model.cameras):
            found.append(_late(views, problem, camera.name, np.asarray(views.camera == c)))
        if len(model.cameras) > 1:
            found.append(_late(views, problem, "", np.ones(len(views.camera), dtype=bool)))
    return found


def _late(views: RecordedViews, problem: ExaminedFrames, subject: str, frames: BoolArray) -> Hypothesis:
    """Stamps of some frames (f,) that are early or late by one parameter [s] that is added to them."""
    order, there = list(problem.order), views.at(views.times)

    def apply(state: State, x: FloatArray) -> State:
        apart = np.where(frames[:, None], views.at(views.times + float(x[0])) - there, 0.0)
        return state[0], state[1] + apart[:, order]

    return Hypothesis(kind="stamps", subject=subject, change=ModelChange("joint", subject, 1, apply))


def corrected_views(
    views: RecordedViews, one: Hypothesis, frames: BoolArray, x: float
) -> RecordedViews | None:
    """The recording as it would be without a change ``x`` of a joint's zero, or of stamps, in ``frames`` (f,); None
    where it is a change of another kind.
    """
    if one.kind == "stamps":
        return views.shifted(np.where(frames, x, 0.0))
    if one.kind != "joint" or not frames.any():
        return None
    shown = views.times[frames]
    # Those included between which the joints of the first and the last of the frames are interpolated.
    begin = int(np.searchsorted(views.joint_times, shown[0], side="right")) - 1
    end = int(np.searchsorted(views.joint_times, shown[-1]))
    index = np.arange(len(views.joint_times))
    readings = (frames[0] | (index >= begin)) & (frames[-1] | (index <= end))
    positions = views.positions.copy()
    positions[readings, views.joint_names.index(one.subject)] += x
    return replace(views, positions=positions)


def frames_concerned(hypothesis: Hypothesis, views: RecordedViews) -> IntArray:
    """Indices of the frames that show the change: of one camera, or all."""
    names = [camera.name for camera in views.cameras]
    if hypothesis.kind in ("camera", "stamps") and hypothesis.subject:
        return np.flatnonzero(views.camera == names.index(hypothesis.subject))
    return np.arange(len(views.camera))
