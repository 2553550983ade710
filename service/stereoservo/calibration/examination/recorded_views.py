"""The frames of a recording as residuals of a learnt model, whitened by the errors of the joints and by the model's own
uncertainty, and the hypotheses of changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal, NamedTuple

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
from stereoservo.calibration.joint_noise import joint_columns
from stereoservo.calibration.rig_model import displacements, predicted
from stereoservo.calibration.trial_data import TrialCamera, TrialData
from stereoservo.kinematics.model import CellModel
from stereoservo.kinematics.parameterization import Kind
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

AT_REST = 0.01
"""Joint speed [rad/s or m/s] up to which the arm counts as at rest."""
SAME_INSTANT_S = 1e-3
"""Largest difference of stamps of frames at the same instant."""
SPEED_OVER_S = 0.02
"""Half of the interval over which joint speeds are computed."""
MOVED = 3.0
"""Ratio to the noise of the squared difference between frames of a rest, above which one shows a different position."""
LEAST_RESTS = 12
"""Number of rests from which a model is learnt from these alone: late stamps have no effect there."""
LEAST_RUN = 4
"""Least number of stops in a single joint's motion."""
ALONE = 1e-3
"""Largest motion [rad or m] of the other joints during it."""
MOST_OF_RUN, MOST_FREE = 15, 40
"""Most stops of each single joint's motion, and of all joints, that a model is learnt from."""


@dataclass(frozen=True)
class RecordedViews:
    """A recording, frames in the order of their stamps.

    Joint samples at ``joint_times`` (j,) [s], ``positions`` (j, n) [rad or m]. Frames: ``camera`` (f,) index,
    ``times`` (f,) [s], ``numbers`` (f,) as counted by the camera, -1 if not counted, ``episodes`` (f,),
    ``pixels`` (f, m, 2) raw [px], NaN if a marker was not seen, ``sigmas`` (f, m) [px]. ``generators`` (n, 4, 4):
    of a known arm, such as that of poses. ``timed``: false if stamps are only an order, not times.
    ``counted``: whether stamps are a count of frames over their rate, which shows no drops.
    ``model``: one contained in the recording, used if none can be learnt. ``added`` (f,) [s]: correction of stamps
    that were found wrong. ``body_moves``: whether the markers are also moved by something other than the arm; that
    motion has the effect of late stamps. ``notes``: remarks on the recording for the reader of the report.
    """

    joint_names: tuple[str, ...]
    joint_kinds: tuple[Kind, ...]
    cameras: tuple[TrialCamera, ...]
    marker_ids: tuple[int, ...]
    joint_times: FloatArray
    positions: FloatArray
    camera: IntArray
    times: FloatArray
    numbers: IntArray
    episodes: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    generators: FloatArray | None = None
    timed: bool = True
    model: CellModel | None = None
    added: FloatArray | None = None
    counted: bool = False
    body_moves: bool = False
    notes: tuple[str, ...] = ()

    @property
    def stamped(self) -> FloatArray:
        """Stamps (f,) [s] as recorded."""
        return self.times if self.added is None else self.times - self.added

    @property
    def seen(self) -> BoolArray:
        """Mask (f, m) of the markers seen in each frame."""
        return np.asarray(np.isfinite(self.pixels).all(axis=-1))

    @property
    def ranks(self) -> IntArray:
        """Index (f,) of each frame among those of its camera, from 0."""
        found = np.zeros(len(self.camera), dtype=np.int64)
        for c in range(len(self.cameras)):
            mine = self.camera == c
            found[mine] = np.arange(int(mine.sum()))
        return found

    def at(self, times: FloatArray) -> FloatArray:
        """Positions (k, n) at ``times`` (k,) [s], interpolated; constant beyond the ends."""
        return np.array([np.interp(times, self.joint_times, q) for q in self.positions.T]).T

    def speeds(self, times: FloatArray) -> FloatArray:
        """Speed (k,) [rad/s or m/s] of the fastest joint about ``times`` (k,)."""
        travel = np.abs(self.at(times + SPEED_OVER_S) - self.at(times - SPEED_OVER_S))
        return np.asarray(travel.max(axis=1) / (2.0 * SPEED_OVER_S))

    def select(self, frames: BoolArray | IntArray) -> RecordedViews:
        """The recording with some of its frames."""
        fields = ("camera", "times", "numbers", "episodes", "pixels", "sigmas")
        added = None if self.added is None else self.added[frames]
        return replace(self, added=added, **{name: getattr(self, name)[frames] for name in fields})

    def shifted(self, late: FloatArray) -> RecordedViews:
        """The recording with ``late`` (f,) [s] added to its stamps, frames sorted again."""
        added = late if self.added is None else self.added + late
        times = self.times + late
        return replace(self, times=times, added=added).select(np.argsort(times, kind="stable"))


def frames_as_stops(views: RecordedViews) -> TrialData:
    """Trial data with every frame as a separate stop, at its own stamp."""
    f, m = views.sigmas.shape
    shape = (len(views.cameras), f, m)
    pixels, sigmas = np.full((*shape, 2), np.nan), np.ones(shape)
    at = views.camera, np.arange(f)
    pixels[at], sigmas[at] = views.pixels, views.sigmas
    return _trials(views, views.at(views.times), np.full(f, -1), pixels, sigmas)


@dataclass(frozen=True)
class LearningStops:
    """Trial data of some stops of a recording, and the first frame (s,) of each."""

    trials: TrialData
    frames: IntArray


def learning_stops(views: RecordedViews) -> LearningStops:
    """Stops from which a model can be learnt: rests, if there are enough of them, else instants at which several
    cameras took a frame; for each, the joint that moved alone.
    """
    instant = instants(views)
    stops = np.unique(instant[instant >= 0])
    positions = stop_positions(views, instant)
    alone = single_joint_motions(positions)
    keep = _thinned(alone)
    shape = (len(views.cameras), len(keep), len(views.marker_ids))
    pixels, sigmas = np.full((*shape, 2), np.nan), np.ones(shape)
    first = np.zeros(len(keep), dtype=np.int64)
    for k, stop in enumerate(stops[keep].tolist()):
        of_stop = np.flatnonzero(instant == stop)
        first[k] = of_stop[0]
        for c in np.unique(views.camera[of_stop]).tolist():
            _average(views, of_stop[views.camera[of_stop] == c], pixels[c, k], sigmas[c, k])
    return LearningStops(_trials(views, positions[keep], alone[keep], pixels, sigmas), first)


def stop_positions(views: RecordedViews, instant: IntArray) -> FloatArray:
    """Mean positions (s, n) of the frames of each ``instant`` (f,), without those of -1."""
    of_stop = np.flatnonzero(instant >= 0)
    stops, which = np.unique(instant[of_stop], return_inverse=True)
    found = np.zeros((len(stops), len(views.joint_names)))
    np.add.at(found, which, views.at(views.times[of_stop]))
    return np.asarray(found / np.bincount(which, minlength=len(stops))[:, None])


def _average(views: RecordedViews, frames: IntArray, pixels: FloatArray, sigmas: FloatArray) -> None:
    """Write the mean of some frames of a camera into ``pixels`` (m, 2), and its deviation into ``sigmas`` (m,)."""
    known = views.seen[frames]
    count = known.sum(axis=0)
    some = count > 0
    shown = np.where(known[..., None], views.pixels[frames], 0.0).sum(axis=0)
    pixels[some] = shown[some] / count[some, None]
    squares = np.where(known, views.sigmas[frames], 0.0) ** 2
    sigmas[some] = np.sqrt(squares.sum(axis=0)[some]) / count[some]


def _trials(
    views: RecordedViews, positions: FloatArray, alone: IntArray, pixels: FloatArray, sigmas: FloatArray
) -> TrialData:
    return TrialData(
        joint_names=views.joint_names,
        joint_kinds=views.joint_kinds,
        cameras=views.cameras,
        marker_ids=views.marker_ids,
        positions=positions,
        trials=alone,
        pixels=pixels,
        sigmas=sigmas,
        images=len(views.camera),
        generators=views.generators,
    )


def instants(views: RecordedViews) -> IntArray:
    """Number (f,) of each frame's instant: of its rest, if there are enough, with -1 in motion."""
    if views.timed and len(views.times) > 1:
        still = views.speeds(views.times) <= AT_REST
        began = still & ~np.concatenate([[False], still[:-1]])
        # Between two rests the arm may have moved between two frames.
        positions = views.at(views.times)
        jumped = np.abs(np.diff(positions, axis=0)).max(axis=1) > ALONE
        began |= still & np.concatenate([[False], jumped])
        rests = np.where(still, np.cumsum(began) - 1, -1)
        if int(rests.max(initial=-1)) + 1 >= LEAST_RESTS:
            return _static_frames(rests, views)
    separate = np.diff(views.times, prepend=views.times[:1]) > (SAME_INSTANT_S if views.timed else 0.0)
    return np.asarray(np.cumsum(separate))


def _static_frames(rests: IntArray, views: RecordedViews) -> IntArray:
    """Rests (f,) without the frames whose markers differ from those nearest to the middle of the rest, by
    camera: with wrong stamps, the first or the last ones show motion.
    """
    kept = rests.copy()
    for rest in range(int(rests.max()) + 1):
        for camera in range(len(views.cameras)):
            mine = np.flatnonzero((rests == rest) & (views.camera == camera))
            if not len(mine):
                continue
            times = views.times[mine]
            reference = mine[np.abs(times - 0.5 * (times[0] + times[-1])).argmin()]
            distances = np.linalg.norm(views.pixels[mine] - views.pixels[reference], axis=2)
            sigmas = np.sqrt(views.sigmas[mine] ** 2 + views.sigmas[reference] ** 2)
            both = np.isfinite(distances) & np.isfinite(sigmas)
            squares = (np.where(both, distances / sigmas, 0.0) ** 2).sum(axis=1)
            kept[mine[squares > MOVED * 2.0 * both.sum(axis=1)]] = -1
    return kept


def single_joint_motions(positions: FloatArray) -> IntArray:
    """Joint (s,) that moved alone about each of the stops at ``positions`` (s, n), -1 if several did or none."""
    alone = np.full(len(positions), -1)
    for begin, end in _runs(positions):
        moved = np.ptp(positions[begin:end], axis=0)
        if end - begin >= LEAST_RUN and (moved > ALONE).sum() == 1:
            alone[begin:end] = int(moved.argmax())
    return alone


def _runs(positions: FloatArray) -> Iterator[tuple[int, int]]:
    """Runs of stops over which at most one joint moves."""
    begin = 0
    for k in range(1, len(positions) + 1):
        if k == len(positions) or (np.ptp(positions[begin : k + 1], axis=0) > ALONE).sum() > 1:
            yield begin, k
            begin = k


def _thinned(alone: IntArray) -> IntArray:
    """Indices of the stops to learn from: some of each joint's motion, some of all others."""
    kept = []
    for joint in np.unique(alone).tolist():
        mine = np.flatnonzero(alone == joint)
        most = MOST_OF_RUN if joint >= 0 else MOST_FREE
        # For poses and known arms all stops are free.
        most = most if (alone >= 0).any() else 3 * MOST_FREE
        kept.append(mine[np.unique(np.linspace(0, len(mine) - 1, min(most, len(mine))).round().astype(int))])
    return np.sort(np.concatenate(kept)) if kept else np.zeros(0, dtype=np.int64)


GAP, JITTERS = 1.5, 6.0
"""Least length of a gap, in periods, and its excess over a period, in multiples of the stamps' scatter."""
REGULAR, NEAR = 0.8, 0.25
"""Share of the intervals that must be near the period for it to exist, and their largest relative distance from it."""
CREDIBLE = 9.2
"""Difference of chi-square up to which another onset is not excluded: odds of 100 to 1."""


class Gap(NamedTuple):
    """Frames ``missing`` before the frame of index ``frame`` (among all)."""

    frame: int
    missing: int


def probable_onset(gains: FloatArray) -> tuple[int, int, int]:
    """Median onset, and the first and last that are not excluded, from the chi-square ``gains`` (b,) of all onsets,
    which are equally likely a priori.
    """
    likely = np.cumsum(np.exp(0.5 * (gains - gains.max())))
    near = np.flatnonzero(gains >= gains.max() - CREDIBLE)
    return int(np.searchsorted(likely, 0.5 * likely[-1])), int(near[0]), int(near[-1])


def gaps(views: RecordedViews, camera: int) -> list[Gap] | None:
    """Gaps in a camera's frames; None if these have neither numbers nor a period."""
    mine = np.flatnonzero(views.camera == camera)
    same = np.diff(views.episodes[mine]) == 0
    numbers = views.numbers[mine]
    if (numbers >= 0).all() and len(mine) > 1:
        counted = np.diff(numbers)
        # A stream of every second frame, or fourth, has no drops.
        every = max(1, int(np.median(counted[same]))) if same.any() else 1
        missing = np.round(counted / every).astype(np.int64) - 1
    else:
        by_stamps = _missing(np.diff(views.times[mine]), same) if views.timed and not views.counted else None
        if by_stamps is None:
            return None
        missing = by_stamps
    return [Gap(int(mine[k + 1]), int(missing[k])) for k in np.flatnonzero(same & (missing > 0)).tolist()]


def _missing(intervals: FloatArray, same: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> IntArray | None:
    """Frames missing in each interval (k,); None if there is no period."""
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


HypothesisKind = Literal["camera", "cameras", "body", "marker", "joint", "stamps"]

LOOSE = 1e3
"""Standard deviations by which a detected cause is left free."""


@dataclass(frozen=True)
class Hypothesis:
    """A hypothetical ``change`` of the model, or of the stamps of a camera (its ``subject``, "" for all)."""

    kind: HypothesisKind
    subject: str
    change: ModelChange


@dataclass(frozen=True)
class ExaminedFrames(LinearisedProblem):
    """Problem whose stops are frames, with rows sorted by frame. ``root`` (2 k, p) of the covariance that the
    model's uncertainty adds to the residuals. ``joint_slopes`` (2 k, n): derivatives by the errors of the joints, in
    their standard deviations; residuals are whitened of these common errors of a frame.
    """

    root: FloatArray
    joint_slopes: FloatArray

    @cached_property
    def _whiteners(self) -> tuple[IntArray, FloatArray]:
        """Index (2 k,) of each row in a padded table of frames (f, w), and whitening matrices (f, w, w)."""
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
        """Displacements (f, 4, 4) of the body without drift of the joints."""
        return displacements(self.rig, self.data.offsets)

    def plain_residuals_at(self, state: State) -> FloatArray:
        """Weighted residuals (2 k,), errors of the joints included."""
        rig, drift = state
        if rig.generators is not self.rig.generators or drift.any():
            return super().residuals_at(state)
        residuals = predicted(rig, self.data, self._undrifted) - self.data.pixels
        return np.asarray((residuals / self.data.sigmas[:, None]).ravel())

    def residuals_at(self, state: State) -> FloatArray:
        return self.without_joint_errors(self.plain_residuals_at(state)[:, None])[:, 0]

    def without_joint_errors(self, rows: FloatArray) -> FloatArray:
        """Rows (2 k, q) whitened of joint errors frame by frame."""
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
        return replace(self, data=self.data.select(keep), root=root, uncertainty=bounded(root), joint_slopes=slopes)

    def explained(self, rows: BoolArray, effect: FloatArray, slopes: FloatArray) -> ExaminedFrames:
        """The problem with an ``effect`` (r, 2) [px] removed from the pixels of ``rows`` (k,), which then carry no
        information along its ``slopes`` (2 k, q), in deviations of the estimate.
        """
        pixels = self.data.pixels.copy()
        pixels[rows] -= effect
        root = np.hstack([self.root, LOOSE * slopes])
        return replace(self, data=replace(self.data, pixels=pixels), root=root, uncertainty=bounded(root))


@dataclass(frozen=True)
class PartlyChanged(ExaminedFrames):
    """All frames, where a changed state applies only to some: those of the rows ``changed`` (k,)."""

    changed: BoolArray

    @cached_property
    def _unchanged(self) -> FloatArray:
        return super().residuals_at((self.rig, np.zeros(len(self.order))))

    def residuals_at(self, state: State) -> FloatArray:
        return np.where(np.repeat(self.changed, 2), super().residuals_at(state), self._unchanged)


def partly_changed(problem: ExaminedFrames, changed: BoolArray) -> PartlyChanged:
    """The problem in which a change applies to some rows (k,) only, whole frames."""
    parts = {field.name: getattr(problem, field.name) for field in fields(problem)}
    return PartlyChanged(**parts, changed=changed)


def examined_frames(model: CellModel, views: RecordedViews, noise_factor: float) -> ExaminedFrames:
    """The problem of all frames; ``noise_factor`` >= 1 multiplies every sigma. Raises CalibrationError."""
    exact = msgspec.structs.replace(model, joint_accuracy=None)
    plain = linearised_problem(exact, frames_as_stops(views), None, noise_factor)
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
    """All hypotheses: changes of the model, and late stamps if stamps are times.

    An arm given by its displacements has no joint zeros of its own: the body or all cameras may have moved instead. For
    a body that moves by itself late stamps are not tested.
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
    """Hypothesis that the stamps of some frames (f,) are early or late by one parameter [s], which is added to them."""
    order, positions = list(problem.order), views.at(views.times)

    def apply(state: State, x: FloatArray) -> State:
        shift = np.where(frames[:, None], views.at(views.times + float(x[0])) - positions, 0.0)
        return state[0], state[1] + shift[:, order]

    return Hypothesis(kind="stamps", subject=subject, change=ModelChange("joint", subject, 1, apply))


def corrected_views(views: RecordedViews, one: Hypothesis, frames: BoolArray, x: float) -> RecordedViews | None:
    """The recording without a change ``x`` of a joint's zero, or of stamps, in ``frames`` (f,); None
    for a change of another kind.
    """
    if one.kind == "stamps":
        return views.shifted(np.where(frames, x, 0.0))
    if one.kind != "joint" or not frames.any():
        return None
    shown = views.times[frames]
    # Including the samples between which the joints of the first and the last frame are interpolated.
    begin = int(np.searchsorted(views.joint_times, shown[0], side="right")) - 1
    end = int(np.searchsorted(views.joint_times, shown[-1]))
    index = np.arange(len(views.joint_times))
    readings = (frames[0] | (index >= begin)) & (frames[-1] | (index <= end))
    positions = views.positions.copy()
    positions[readings, views.joint_names.index(one.subject)] += x
    return replace(views, positions=positions)


def frames_concerned(hypothesis: Hypothesis, views: RecordedViews) -> IntArray:
    """Indices of the frames that the change may affect: of one camera, or all."""
    names = [camera.name for camera in views.cameras]
    if hypothesis.kind in ("camera", "stamps") and hypothesis.subject:
        return np.flatnonzero(views.camera == names.index(hypothesis.subject))
    return np.arange(len(views.camera))
