"""Stage 2 of a core step: estimates the current markers by kinematics, corrected by the newest frame of each camera at
its own time stamp. At rest it puts a new model in use, with its readiness and collision thresholds.

The innovation of a marker is observed minus predicted pixel at the frame's shutter time, with the joints interpolated
from a short history; no trigger is needed. It is gated statistically, filtered, and extrapolated to the present by the
kinematics (`core.prediction`), so that control continues between frames and during the loss of a camera.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.core.block import HISTORY, SETTLED_FRAMES
from stereoservo.core.camera_state import CameraEstimate
from stereoservo.core.context import LENS_SIZE, StepContext, Workspace
from stereoservo.core.cycle import ModelUpdate
from stereoservo.core.ingest import ACCEPTED, newest_frames
from stereoservo.core.model_arrays import FIRST_SEEN_SIGMA_PX, model_arrays, require_fitting
from stereoservo.core.monitor_state import MOVED, ModelComparison
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.collision import collision_thresholds, stated_thresholds
from stereoservo.core.monitors.diagnosis import start_model_monitor
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import (
    HUBER,
    MODEL_SIGMA_PX,
    TIMING_SIGMA_S,
    Predicted,
    arm_of,
    camera_chi2,
    distance2,
    joint_step,
    positions_at,
    predict_into,
    present,
    rows_in_use,
    rows_of,
    undistort_observations,
    velocities_at,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState, share_observations
from stereoservo.core.target import track
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.cell_file import MAX_MARKERS
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import ModelReadiness
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray, Record
from stereoservo.numerics.compilation import kernel

AT_REST = 1e-3
"""Joint command below which the arm counts as at rest [rad/s or m/s]."""


@kernel
def estimate(block: Record, workspace: Record) -> None:
    """Stage 2: update the cameras' estimates by the accepted frames in the ``workspace``, except those that Python
    processes (`take_frames_in_python`); then predict the current markers.
    """
    memory, work = block[0], workspace[0]
    if work.frames_as_stops == 0:
        for c in range(memory.cameras):
            memory.sightings[c].fresh = False
        for k in range(work.frames):
            if work.arrived_found[k] == ACCEPTED:
                take_frame(block, workspace, k)
    if memory.history_count > 0:
        present(block, workspace)


@kernel
def note_frames(block: Record, workspace: Record) -> None:
    """Stage 2 of a cell without a model: store sequence number and number of markers of each accepted frame."""
    memory, work = block[0], workspace[0]
    for c in range(memory.cameras):
        memory.sightings[c].fresh = False
    for k in range(work.frames):
        if work.arrived_found[k] == ACCEPTED:
            note_frame(block, workspace, k)


@kernel
def note_frame(block: Record, workspace: Record, k: int) -> None:
    """Store frame ``k`` in the ``workspace`` as the newest one of its camera."""
    work = workspace[0]
    estimate = block[0].estimates[work.arrived_camera[k]]
    estimate.last_seq, estimate.last_visible = work.arrived_seq[k], work.arrived_count[k]


def take_frames_in_python(context: StepContext) -> None:
    """Process the frames of a cell with cameras that may move or with a target that is followed. Python processes them
    one by one; `estimate` then processes none.
    """
    state, workspace = context.state, context.derived.workspace
    for sighting in state.watching.sightings:
        sighting.fresh = False
    found = workspace.arrays["arrived_found"]
    for k, observation in enumerate(newest_frames(context.inputs)):
        if found[k] == ACCEPTED:
            camera = context.derived.cameras[observation.camera]
            if state.target is not None:
                track.take_frame(camera, observation, context)
            _take_frame_in_python(camera, k, observation.t_shutter_ns, context)
    if state.target is not None:
        context.moved_arrays = track.present_arrays(context)


def _take_frame_in_python(camera: int, k: int, t_ns: int, context: StepContext) -> None:
    """Process a frame like `take_frame`, and check whether the camera moves."""
    state, workspace = context.state, context.derived.workspace
    if context.derived.arrays is None:
        note_frame(state.block.record, workspace.record, k)
        return
    found = see_frame(state.block.record, workspace.record, k)
    if found & MEASURED:  # the arm's position is measured, not only predicted
        _detect_camera_motion(camera, t_ns, context)
    workspace.arrays["unknown"][camera] = pose_unknown(camera, state, context.settings)
    fold_frame(state.block.record, workspace.record, k, found)


# -- the model ----------------------------------------------------------------------------------------------


def take_model(context: StepContext) -> None:
    """Put a new model in use. It waits until the arm rests, no law runs, and the kernels that it needs are loaded; then
    every estimate starts again.
    """
    state, update = context.state, context.inputs.model_update
    if update is not None:
        try:
            require_fitting(update.model, context.settings)
        except ValueError as error:
            context.emit("warning", message=f"model refused: {error}")
        else:
            _await_model(update, context)
    if state.pending_model is None or context.inputs.compiling:
        return
    run = state.reanchoring
    if state.pending_reanchored:
        if run is None or run.phase != "take":
            return
        use_model(state.pending_model, context, masked=masked_ids(state))
        camera_relocalization.on_model_applied(run, state, context.now_ns)
    elif (
        MOTION_SOURCES[type(state.source)].runs_law
        or state.planning is not None
        or bool((np.abs(state.block.command) > AT_REST).any())
    ):
        return
    else:
        use_model(state.pending_model, context)
        state.reanchoring = None
        if state.pending_kept:
            state.readiness = ModelReadiness.UNCONFIRMED
            state.comparison = ModelComparison(context.now_ns, NOT_COMPARED)
    arrays, model = context.derived.arrays, state.model
    assert arrays is not None
    assert model is not None
    moving_camera.start(state, context.settings, arrays, state.pending_reanchored, context.emit)
    state.pending_model, state.pending_reanchored = None, ()
    readiness = str(state.readiness)
    context.emit("model", message=f"model epoch {model.epoch} is {readiness}", name=readiness)
    track.report_untrackable(context)


NOT_COMPARED = Reason(
    "MODEL_UNCONFIRMED",
    "hold",
    hint="the kept model is not confirmed: no camera has delivered a frame since it was loaded. Are the cameras "
    "connected? See the daemon's log",
)


def _await_model(update: ModelUpdate, context: StepContext) -> None:
    """Store a model until it may be used; a model of a relocalization must be the one that is expected."""
    state = context.state
    if update.reanchored:
        refusal = camera_relocalization.rejection_reason(state, update)
        if refusal:
            context.emit("warning", message=f"re-anchored model refused: {refusal}")
            return
    state.pending_model = moving_camera.with_adjusted(state, update.model, update.reanchored)
    state.pending_reanchored, state.pending_kept = update.reanchored, update.kept


def use_model(model: CellModel, context: StepContext, masked: tuple[int, ...] = ()) -> None:
    """Put a model in use. ``masked``: markers that have slipped and stay unused."""
    state, settings = context.state, context.settings
    arrays = model_arrays(model, settings)
    context.derived.use(arrays)
    start_model_monitor(state, arrays, settings, masked)
    state.model = model
    loads = context.derived.load_limits = load_limits(settings, model)
    context.derived.workspace.limit_loads(loads)
    state.readiness, state.comparison = fitted_readiness(model), None
    offsets = stated_offsets(model)
    state.cameras = [CameraEstimate(len(model.marker_ids), offsets.get(camera.name, 0)) for camera in settings.cameras]
    share_observations(state)
    state.block.numbers.round_due = 0
    for name in SETTLED_FRAMES:
        getattr(state.block, name)[:] = 0


def fitted_readiness(model: CellModel) -> ModelReadiness:
    """The readiness of a model before images have confirmed or contradicted it."""
    good = model.statistics is not None and model.statistics.chi2_ok
    return ModelReadiness.VALID if good else ModelReadiness.CANDIDATE


def load_limits(settings: CoreSettings, model: CellModel | None) -> tuple[FloatArray, FloatArray] | None:
    """Collision thresholds of efforts and following errors, (n,) each, from cell file and model; None: collisions are
    not monitored.
    """
    if not settings.watch_following:
        return None
    return collision_thresholds(settings, None if model is None else model.loads)


def workspace(settings: CoreSettings, model: CellModel | None) -> Workspace:
    """Workspace for the steps of a core, with the constants of the cell and the load limits of the ``model``."""
    return Workspace(settings, load_limits(settings, model), stated_thresholds(settings))


# -- frames -------------------------------------------------------------------------------------------------


def _detect_camera_motion(camera: int, t_ns: int, context: StepContext) -> None:
    """Check whether a mobile camera moves; while it does, its newest frame is not compared with the prediction."""
    state, workspace, arrays = context.state, context.derived.workspace, context.derived.arrays
    if state.mobile[camera] is None or arrays is None:
        return
    residuals = workspace.residuals(t_ns)
    residuals.seen[:] = moving_camera.see(
        state, context.settings, arrays, camera, residuals, workspace.of_frame, workspace.frame_q, context.emit
    ).seen


FOLLOWED_S = 0.02
"""Largest deviation [s] of a corrected offset of shutter stamps from the offset measured by the trial motions."""
FOLLOWED_DEVIATION_S = 0.001
"""Standard deviation [s] at which the offset is measured accurately enough to be corrected."""
NO_STAMPS = (*MOVED, "cameras_or_arm")
"""Diagnoses under which a camera's innovations contain no information about its stamps."""


def stated_offsets(model: CellModel) -> dict[str, int]:
    """Offsets of the shutter stamps [ns] by camera, as measured by the trial motions."""
    return {offset.camera: round(1e9 * offset.offset_s) for offset in model.shutter_offsets}


LEAVES, FOLLOWS_MOTION, AS_STATED = range(3)
"""Rules for the offset of a camera's stamps: leave it, correct it by the motion of the markers, or reset it to the
stated one.
"""


def offset_rules(state: CoreState, settings: CoreSettings) -> list[tuple[int, int]]:
    """The rule for the offset of each camera's stamps, and the stated offset [ns].

    The offset is corrected only if the trial motions have measured it and the model states no errors of joint readings:
    play of a joint looks like a late frame. A displaced camera looks like a late frame, too: its offset is the stated
    one from the diagnosis until its pose is known again. With any other diagnosis the offset does not change.
    """
    model, verdict = state.model, state.watching.verdict
    if model is None or model.joint_accuracy is not None or not model.shutter_offsets:
        return [(LEAVES, 0) for _ in settings.cameras]
    offsets = stated_offsets(model)
    rules = []
    for c, camera in enumerate(settings.cameras):
        doubtful = verdict.kind in NO_STAMPS and camera.name in verdict.subjects
        rule = FOLLOWS_MOTION if verdict.kind == "ok" else LEAVES
        if camera.name not in offsets:
            rule = LEAVES
        elif doubtful or pose_unknown(c, state, settings):
            rule = AS_STATED
        rules.append((rule, offsets.get(camera.name, 0)))
    return rules


@kernel
def _follow_offset(block: Record, workspace: Record, k: int) -> None:
    """Correct the offset of a camera's stamps by the motion of its markers, within a bound: see `offset_rules`. The
    corrected shutter time is not later than the arrival of frame ``k``.
    """
    memory, work = block[0], workspace[0]
    camera = work.arrived_camera[k]
    rule, stated = work.offset_rule[camera], work.stated_offset_ns[camera]
    estimate, timing = memory.estimates[camera], memory.sightings[camera].timing
    if rule == AS_STATED:
        estimate.offset_ns, timing.product, timing.square = stated, 0.0, 0.0
    if rule != FOLLOWS_MOTION or timing.square < FOLLOWED_DEVIATION_S**-2:
        return
    bound = np.int64(round(1e9 * FOLLOWED_S))
    latest = min(stated + bound, work.now_ns - work.arrived_ns[k])
    offset = estimate.offset_ns + np.int64(round(1e9 * timing.product / timing.square))
    estimate.offset_ns = min(max(offset, stated - bound), latest)
    timing.product = timing.square = 0.0


def pose_unknown(camera: int, state: CoreState, settings: CoreSettings) -> bool:
    """Whether the pose of a camera is unknown: it is being relocalized, or it moves."""
    mobile = state.mobile[camera]
    if mobile is not None and mobile.moving:
        return True
    if state.reanchoring is None:
        return False
    return settings.cameras[camera].name in camera_relocalization.unknown_cameras(state)


def masked_ids(state: CoreState) -> tuple[int, ...]:
    """Ids of the markers that are not used."""
    if state.model is None:
        return ()
    masked = state.watching.masked
    if not masked.any():
        return ()
    return tuple(state.model.marker_ids[int(i)] for i in np.flatnonzero(masked > 0.0))


# -- a frame at its shutter ---------------------------------------------------------------------------------

AGREEING_PX = 1.5


KNOWN, MEASURED = 1, 2
"""Bits of the result of `see_frame`: the joints are known at the shutter time; samples on both sides of it exist."""


@kernel
def take_frame(block: Record, workspace: Record, k: int) -> None:
    """Compare frame ``k`` in the ``workspace`` with the prediction at its shutter time, and update the estimate of
    its camera.
    """
    fold_frame(block, workspace, k, see_frame(block, workspace, k))


@kernel
def see_frame(block: Record, workspace: Record, k: int) -> int:
    """Compare frame ``k`` in the ``workspace`` with the prediction at its shutter time and write the residuals to
    the workspace. Returns bits: `KNOWN` if the joints are known at that time, `MEASURED` if there are samples on both
    sides of it.

    For a frame newer than the last joint sample, the current joint velocities are used. Observations that the camera's
    lens cannot produce are ignored.
    """
    note_frame(block, workspace, k)
    memory, work = block[0], workspace[0]
    camera, count = work.arrived_camera[k], work.arrived_count[k]
    n, m, rows, lens_size = memory.joints, memory.markers, memory.rows, work.lens_size
    shutter_ns = work.arrived_ns[k] + memory.estimates[camera].offset_ns
    stamps, positions = memory.history_ns, memory.history_positions[: HISTORY * n].reshape((HISTORY, n))
    known, then = positions_at(stamps, positions, memory.history_count, shutter_ns)
    q = work.frame_q[:n]
    q[:] = then
    interpolated, speed = velocities_at(stamps, positions, memory.history_count, shutter_ns)
    if not interpolated:
        speed = memory.velocities[:n]
    predicted, jacobian = (
        work.predicted[: 2 * m].reshape((1, m, 2)),
        work.jacobian[: 2 * m * n].reshape((1, m, 2, n)),
    )
    predict_into(
        arm_of(workspace),
        q,
        work.matrices[12 * camera : 12 * camera + 12].reshape((1, 3, 4)),
        Predicted(
            work.operators[: 16 * n].reshape((n, 4, 4)), work.points[: 4 * m].reshape((m, 4)), predicted, jacobian
        ),
    )
    at = MAX_MARKERS * k
    pixels = work.arrived_pixels[2 * at : 2 * (at + count)].reshape((count, 2))
    covariances = work.arrived_covariances[4 * at : 4 * (at + count)].reshape((count, 2, 2))
    row = rows_of(work.arrived_ids[at : at + count], work.row_ids[:rows], work.row_of[:rows])
    lens = work.lenses[LENS_SIZE * camera : LENS_SIZE * camera + lens_size]
    if not (lens.size == 4 and lens[0] == 0.0):
        pixels, covariances, possible = undistort_observations(lens, pixels, covariances)
        for i in range(row.size):
            if not possible[i]:
                row[i] = -1
    standing = 2 * rows * camera
    _compare(
        workspace,
        Observations(row, pixels, covariances),
        predicted[0],
        work.scene_pixels[standing : standing + 2 * (rows - m)].reshape((rows - m, 2)),
        jacobian[0],
        speed,
    )
    return (KNOWN if known else 0) | (MEASURED if known and interpolated else 0)


@kernel
def fold_frame(block: Record, workspace: Record, k: int, found: int) -> None:
    """Pass the residuals of frame ``k`` in the ``workspace`` on; ``found`` is the result of `see_frame`. The
    monitors receive them if the joints were sampled on both sides of the shutter time. The camera's estimate is updated
    if the camera's pose is known. Nothing happens if the joints are unknown.
    """
    work = workspace[0]
    if found & KNOWN == 0:
        return
    if found & MEASURED:
        fold_residuals(block, workspace, k)
        _follow_offset(block, workspace, k)
    if work.unknown[work.arrived_camera[k]] == 0:
        gate_frame(block, workspace, k)


@kernel
def fold_residuals(block: Record, workspace: Record, k: int) -> None:
    """Store the residuals of frame ``k`` in the ``workspace`` as the newest ones of its camera. A round becomes
    due if no round has examined the frame before it.
    """
    memory, work = block[0], workspace[0]
    n, rows, m = memory.joints, memory.rows, memory.markers
    camera, t_ns = work.arrived_camera[k], work.arrived_ns[k]
    frame = memory.sightings[camera]
    if not frame.looked:
        memory.round_due = 1
    frame.t_ns, frame.fresh, frame.looked = t_ns, True, False
    at, end = rows * camera, rows * (camera + 1)
    innovation = memory.frame_innovation[2 * at : 2 * end].reshape((rows, 2))
    covariance = memory.frame_spread[4 * at : 4 * end].reshape((rows, 2, 2))
    velocity, seen = memory.frame_velocity[2 * at : 2 * end].reshape((rows, 2)), memory.frame_seen[at:end]
    innovation[:] = work.frame_innovation[: 2 * rows].reshape((rows, 2))
    covariance[:] = work.frame_spread[: 4 * rows].reshape((rows, 2, 2))
    velocity[:] = work.frame_velocity[: 2 * rows].reshape((rows, 2))
    memory.frame_q[n * camera : n * (camera + 1)] = work.frame_q[:n]
    for i in range(rows):
        seen[i] = work.frame_seen[i]
    used = rows_in_use(seen, work.masked[:m])
    chi2, squares, worst, _, count = camera_chi2(innovation, covariance, used, MODEL_SIGMA_PX)
    frame.chi2 = chi2 / max(2.0 * count, 1.0)
    frame.rms_px = math.sqrt(squares / max(2.0 * count, 1.0))
    u, v = (0.0, 0.0) if worst < 0 else (innovation[worst, 0], innovation[worst, 1])
    frame.worst, frame.worst_px = worst, math.sqrt(u * u + v * v)
    timing, moved = frame.timing, Moved(innovation, velocity, work.frame_noise[:rows])
    sums = fold_timing(TimingSums(timing.product, timing.square, timing.seen_ns), t_ns, moved, used)
    timing.product, timing.square, timing.seen_ns = sums


FORGETTING_S = 30.0
"""Time constant [s] with which old frames are forgotten, in time during which motion is visible."""
MOVING_PX_S = 20.0
"""Mean pixel speed [px/s] below which a frame contains no information about timing."""


class Moved(NamedTuple):
    """Moving markers of a frame, one a row: ``innovations`` (k, 2) [px], ``velocities`` (k, 2) [px/s], and the variance
    ``noise`` (k,) [px²] of one coordinate.
    """

    innovations: FloatArray
    velocities: FloatArray
    noise: FloatArray


class TimingSums(NamedTuple):
    """The sums of a `CameraTiming`."""

    product: float
    square: float
    seen_ns: int


@kernel
def fold_timing(sums: TimingSums, t_ns: int, frame: Moved, used: FloatArray) -> TimingSums:
    """Add the rows of a frame with ``used`` (k,) > 0 to the ``sums``; returns the new sums.

    The markers of a frame share the model's error, so they count as one observation, not as k.
    """
    k, speed, along, squared = _timing_sums(frame, used)
    if k == 0 or speed < MOVING_PX_S * k:
        return sums
    elapsed_s = min((t_ns - sums.seen_ns) * 1e-9, 0.2) if sums.seen_ns != 0 else 0.0
    keep = math.exp(-elapsed_s / FORGETTING_S)
    return TimingSums(keep * sums.product + along / k, keep * sums.square + squared / k, t_ns)


@kernel
def _timing_sums(frame: Moved, used: FloatArray) -> tuple[int, float, float, float]:
    """Number of a frame's markers with ``used`` (k,) > 0, and sums over these: the pixel speeds, and the two sums
    (product, square) of the weighted fit of innovations to velocities.
    """
    innovations, velocities, variances = frame
    count, speed, product, square = 0, 0.0, 0.0, 0.0
    for i in range(variances.shape[0]):
        if not used[i] > 0.0:
            continue
        count += 1
        vu, vv = velocities[i, 0], velocities[i, 1]
        speed += math.sqrt(vu * vu + vv * vv)
        weight = 1.0 / (variances[i] + MODEL_SIGMA_PX * MODEL_SIGMA_PX)
        product += weight * (vu * innovations[i, 0] + vv * innovations[i, 1])
        square += weight * (vu * vu + vv * vv)
    return count, speed, product, square


@kernel
def gate_frame(block: Record, workspace: Record, k: int) -> None:
    """Gate frame ``k``, whose residuals are in the ``workspace``, and update the estimate of its camera. Masked
    markers are ignored.

    The gate is a chi-square test with two degrees of freedom on the deviation from the filtered innovation and its
    common change (see `_common_change`), with the covariances of detector, timing and model. An observation near the
    gate has a smaller weight in the filter, and a larger sigma in triangulation.
    """
    memory, work = block[0], workspace[0]
    m, camera = memory.markers, work.arrived_camera[k]
    used = np.empty(m, np.bool_)
    for i in range(m):
        used[i] = work.frame_seen[i] != 0 and work.masked[i] == 0.0
    common = np.zeros((m, 2))
    if work.erring:
        _common_change(block, workspace, camera, used, common)
    accepted, rejected, squares = _fold_in(block, workspace, k, used, common)
    estimate = memory.estimates[camera]
    estimate.last_visible = accepted
    estimate.frames += 1
    estimate.rms_px = math.sqrt(squares / (2 * accepted)) if accepted > 0 else 0.0
    agrees = accepted >= 3 and rejected == 0 and estimate.rms_px < AGREEING_PX
    estimate.agreeing_frames = estimate.agreeing_frames + 1 if agrees else 0
    estimate.rejected_frames = estimate.rejected_frames + 1 if rejected > accepted else 0
    if accepted >= 3:
        estimate.accepted_ns = work.arrived_ns[k]


COMMON_ROUNDS = 8
"""Iterations of reweighting, which reduce the weight of observations that the joints do not explain."""


@kernel
def _common_change(block: Record, workspace: Record, camera: int, used: BoolArray, common: FloatArray) -> None:
    """Write the common change of the innovations to ``common`` (m, 2) [px]: the change since the filtered ones that is
    explained by joints passing through their play or a step, within the errors of joint readings that the model states.
    Zeros if nothing changed.

    ``used`` (m,): markers to use. Huber's weights are iterated: a common change moves all markers, an outlier moves
    one.
    """
    memory, work = block[0], workspace[0]
    m, n, at = memory.markers, memory.joints, memory.markers * camera
    filtered, seen_ns = (
        memory.innovation[2 * at : 2 * (at + m)].reshape((m, 2)),
        memory.seen_ns[at : at + m],
    )
    innovation, covariance = (
        work.frame_innovation[: 2 * m].reshape((m, 2)),
        work.frame_spread[: 4 * m].reshape((m, 2, 2)),
    )
    jacobian, deviations = work.jacobian[: 2 * m * n].reshape((m, 2, n)), work.joint_deviations[:n]
    rows, variance = np.empty(m, np.int64), np.empty(m)
    change, left = np.empty((m, 2)), np.empty((m, 2))
    count, largest = 0, 0.0
    for i in range(m):
        if not (used[i] and seen_ns[i] > 0):
            continue
        rows[count] = i
        variance[count] = MODEL_SIGMA_PX**2 + 0.5 * (covariance[i, 0, 0] + covariance[i, 1, 1])
        for a in range(2):
            change[count, a] = left[count, a] = innovation[i, a] - filtered[i, a]
        d2 = (left[count, 0] ** 2 + left[count, 1] ** 2) / variance[count]
        largest = d2 if count == 0 or d2 > largest or math.isnan(d2) else largest
        count += 1
    if count < 3 or largest <= HUBER * HUBER:
        return
    equations, rhs = np.zeros((2 * count + n, n)), np.zeros(2 * count + n)
    weights, step = np.ones(2 * count + n), np.zeros(n)
    for r in range(count):
        for a in range(2):
            rhs[2 * r + a] = change[r, a]
            for j in range(n):
                equations[2 * r + a, j] = jacobian[rows[r], a, j] * deviations[j]
    for j in range(n):
        equations[2 * count + j, j] = 1.0
    for _ in range(COMMON_ROUNDS):
        for r in range(count):
            distance = math.sqrt((left[r, 0] ** 2 + left[r, 1] ** 2) / variance[r])
            weight = math.sqrt(min(1.0, HUBER / max(distance, 1e-9)) / variance[r])
            weights[2 * r] = weights[2 * r + 1] = weight
        step[:] = joint_step(equations, rhs, weights, 0.0)
        for r in range(count):
            for a in range(2):
                explained = 0.0
                for j in range(n):
                    explained += equations[2 * r + a, j] * step[j]
                left[r, a] = change[r, a] - explained
    for i in range(m):
        for a in range(2):
            for j in range(n):
                common[i, a] += jacobian[i, a, j] * (deviations[j] * step[j])


class Observations(NamedTuple):
    """k observations: their ``rows`` (k,) among the model's markers and static points (-1: none); ideal ``pixels`` (k,
    2) and ``covariances`` (k, 2, 2) [px²].
    """

    rows: IntArray
    pixels: FloatArray
    covariances: FloatArray


@kernel
def _compare(
    workspace: Record,
    observations: Observations,
    predicted: FloatArray,
    standing: FloatArray,
    jacobian: FloatArray,
    speed: FloatArray,
) -> None:
    """Write the fields of `FrameResiduals` to the ``workspace``: observed minus predicted pixels [px].

    ``predicted`` (m, 2), ``standing`` (s, 2): predicted pixels of markers and of static points.
    ``jacobian`` (m, 2, n), ``speed`` (n,): give the pixel velocities; a shutter stamp that is off by `TIMING_SIGMA_S`
    adds to the covariance by them.
    """
    work, markers, n = workspace[0], jacobian.shape[0], jacobian.shape[2]
    rows, pixels, covariances = observations
    count = markers + standing.shape[0]
    innovation, covariance = (
        work.frame_innovation[: 2 * count].reshape((count, 2)),
        work.frame_spread[: 4 * count].reshape((count, 2, 2)),
    )
    velocity = work.frame_velocity[: 2 * count].reshape((count, 2))
    innovation[:], covariance[:], velocity[:] = 0.0, 0.0, 0.0
    work.frame_seen[:count], work.frame_noise[:count] = 0, 1.0
    for k in range(rows.size):
        i = rows[k]
        if i < 0:
            continue
        work.frame_seen[i] = 1
        work.frame_noise[i] = 0.5 * (covariances[k, 0, 0] + covariances[k, 1, 1])
        for a in range(2):
            innovation[i, a] = pixels[k, a] - (predicted[i, a] if i < markers else standing[i - markers, a])
        u = v = 0.0
        for j in range(n):
            u += jacobian[i, 0, j] * speed[j] if i < markers else 0.0
            v += jacobian[i, 1, j] * speed[j] if i < markers else 0.0
        velocity[i, 0], velocity[i, 1] = u, v
        t = TIMING_SIGMA_S * TIMING_SIGMA_S
        covariance[i, 0, 0] = covariances[k, 0, 0] + t * u * u
        covariance[i, 0, 1] = covariances[k, 0, 1] + t * u * v
        covariance[i, 1, 0] = covariance[i, 0, 1]
        covariance[i, 1, 1] = covariances[k, 1, 1] + t * v * v


@kernel
def _fold_in(block: Record, workspace: Record, k: int, used: BoolArray, common: FloatArray) -> tuple[int, int, float]:
    """Update the filtered innovations by those of frame ``k``, each by its weight; rejected ones change nothing.
    Returns the numbers of accepted and rejected innovations, and the sum of squares of the accepted ones [px²].

    ``used`` (m,): markers to use.
    ``common`` (m, 2) [px]: the common change of all markers since the filtered innovations, which the gate subtracts.

    The model error in the gate has the standard deviation `MODEL_SIGMA_PX`, or `FIRST_SEEN_SIGMA_PX` for markers that
    were not seen recently.
    """
    memory, work = block[0], workspace[0]
    m, t_ns = memory.markers, work.arrived_ns[k]
    at, end = m * work.arrived_camera[k], m * (work.arrived_camera[k] + 1)
    innovation, covariance = (
        work.frame_innovation[: 2 * m].reshape((m, 2)),
        work.frame_spread[: 4 * m].reshape((m, 2, 2)),
    )
    filtered = memory.innovation[2 * at : 2 * end].reshape((m, 2))
    sigma, seen_ns, filter_s = memory.sigma[at:end], memory.seen_ns[at:end], work.filter_s
    accepted = refused = 0
    squares = 0.0
    for i in range(m):
        if not used[i]:
            continue
        age_s = (t_ns - seen_ns[i]) * 1e-9
        known = seen_ns[i] > 0 and age_s <= work.known_s
        x, y = innovation[i, 0], innovation[i, 1]
        if known:
            x -= filtered[i, 0]
            y -= filtered[i, 1]
        model = MODEL_SIGMA_PX if known else FIRST_SEEN_SIGMA_PX
        off = model * model
        a, b = (x - common[i, 0], y - common[i, 1]) if known else (x, y)
        d2 = distance2(a, b, covariance[i, 0, 0] + off, covariance[i, 0, 1], covariance[i, 1, 1] + off)
        if not d2 <= work.gate:
            refused += 1
            continue
        weight = 1.0 if d2 <= HUBER * HUBER else HUBER / math.sqrt(d2)
        if known and filter_s > 0.0:
            share = weight * age_s / (filter_s + age_s)
            filtered[i, 0] += share * x
            filtered[i, 1] += share * y
        else:
            filtered[i, 0] = innovation[i, 0]
            filtered[i, 1] = innovation[i, 1]
        sigma[i] = math.sqrt(work.frame_noise[i] / weight)
        seen_ns[i] = t_ns
        squares += innovation[i, 0] * innovation[i, 0] + innovation[i, 1] * innovation[i, 1]
        accepted += 1
    return accepted, refused, squares
