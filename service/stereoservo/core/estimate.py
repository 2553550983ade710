"""Stage 2 of a core step: estimates the current markers by kinematics, corrected by the newest frame of each camera at
its own time stamp. At rest it puts a new model in use, with its readiness and collision thresholds.

The innovation of a marker is observed minus predicted pixel at the frame's shutter time, with the joints interpolated
from a short history; no trigger is needed. It is gated statistically, filtered, and carried to the present by the
kinematics (`core.prediction`), so that control goes on between frames and through a lost camera.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.core.block import HISTORY
from stereoservo.core.camera_state import CameraEstimate
from stereoservo.core.context import StepContext
from stereoservo.core.cycle import ModelUpdate
from stereoservo.core.model_arrays import FIRST_SIGHT_SIGMA_PX, ModelArrays, model_arrays, require_fitting
from stereoservo.core.monitor_state import MOVED
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.collision import collision_thresholds, stated_thresholds
from stereoservo.core.monitors.diagnosis import start_model_monitor
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import (
    HUBER,
    MODEL_SIGMA_PX,
    TIMING_SIGMA_S,
    FrameResiduals,
    camera_chi2,
    distance2,
    joint_step,
    positions_at,
    predict_into,
    present,
    rows_in_use,
    rows_of,
    undistort_sights,
    velocities_at,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState, share_sights
from stereoservo.core.target import track
from stereoservo.core.workspace import LENS_SIZE, Workspace
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.status import ModelReadiness
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray, KindArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import CameraObservation

AT_REST = 1e-3
"""[rad/s or m/s]"""


def estimate(context: StepContext) -> StepContext:
    """The context with the present in it: model, prediction, weights and pixels of the markers."""
    if context.inputs.model_update is not None or context.state.pending_model is not None:
        _take_model(context)
    for sighting in context.state.watching.sightings:
        sighting.fresh = False
    for camera, observation in context.ingested.observations:
        if context.state.target is not None:
            track.take_frame(camera, observation, context)
        fold_frame(camera, observation, context)
    context.observations = tuple([observation for _, observation in context.ingested.observations])
    state = context.state
    arrays = context.derived.arrays if state.target is None else track.present_arrays(context)
    if arrays is None or state.block.numbers.history_count == 0:
        return context
    context.arrays, room = arrays, context.derived.room
    present(state.block.record, room.record, context.q, context.now_ns)
    context.prediction, context.weights, context.pixels = room.prediction, room.weights, room.pixels
    if any(state.mobile):
        context = moving_camera.step(context)
        if context.arrays is not arrays:
            assert context.arrays is not None
            context.derived.use(context.arrays)
    return context


# -- the model ----------------------------------------------------------------------------------------------


def _take_model(context: StepContext) -> None:
    """A new model waits until the arm rests and no law runs, and until the kernels that it needs are loaded; then every
    estimate starts again.
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
        camera_relocalization.taken(run, state, context.now_ns)
    elif (
        MOTION_SOURCES[type(state.source)].runs_law
        or state.planning is not None
        or bool((np.abs(state.block.command) > AT_REST).any())
    ):
        return
    else:
        use_model(state.pending_model, context)
        state.reanchoring = None
    arrays, model = context.derived.arrays, state.model
    assert arrays is not None
    assert model is not None
    moving_camera.start(state, context.settings, arrays, state.pending_reanchored, context.emit)
    state.pending_model, state.pending_reanchored = None, ()
    readiness = str(state.readiness)
    context.emit("model", message=f"model epoch {model.epoch} is {readiness}", name=readiness)
    track.tell_untrackable(context)


def _await_model(update: ModelUpdate, context: StepContext) -> None:
    """Keep a model until it may be used; a re-anchored one must be the one that is waited for."""
    state = context.state
    if update.reanchored:
        refusal = camera_relocalization.misfit(state, update)
        if refusal:
            context.emit("warning", message=f"re-anchored model refused: {refusal}")
            return
    state.pending_model = moving_camera.with_adjusted(state, update.model, update.reanchored)
    state.pending_reanchored = update.reanchored


def use_model(model: CellModel, context: StepContext, masked: tuple[int, ...] = ()) -> None:
    """Put a model in use. ``masked``: markers that have slipped and stay unused."""
    state, settings = context.state, context.settings
    arrays = model_arrays(model, settings)
    context.derived.use(arrays)
    start_model_monitor(state, arrays, settings, masked)
    state.model = model
    loads = context.derived.load_limits = load_limits(settings, model)
    context.derived.room.limit_loads(loads)
    state.readiness = fitted_readiness(model)
    offsets = stated_offsets(model)
    state.cameras = [
        CameraEstimate(len(model.marker_ids), offsets.get(camera.name, 0)) for camera in settings.cameras
    ]
    share_sights(state)


def fitted_readiness(model: CellModel) -> ModelReadiness:
    """The readiness of a model before the images have confirmed or contradicted it."""
    good = model.statistics is not None and model.statistics.chi2_ok
    return ModelReadiness.VALID if good else ModelReadiness.CANDIDATE


def load_limits(settings: CoreSettings, model: CellModel | None) -> tuple[FloatArray, FloatArray] | None:
    """Collision thresholds (n,), (n,) by cell file and model; None: collisions are not monitored."""
    if not settings.watch_following:
        return None
    return collision_thresholds(settings, None if model is None else model.loads)


def workspace(settings: CoreSettings, model: CellModel | None) -> Workspace:
    """Room for the steps of a core, with the constants of the cell, and the limits of what ``model`` says of loads."""
    return Workspace(settings, load_limits(settings, model), stated_thresholds(settings))


# -- frames -------------------------------------------------------------------------------------------------


def fold_frame(camera: int, observation: CameraObservation, context: StepContext) -> None:
    """Compare a frame with the prediction at its shutter, and fold it into its camera's estimate."""
    state, arrays, room = context.state, context.derived.arrays, context.derived.room
    estimate, watching, t_ns = state.cameras[camera], state.watching, observation.t_shutter_ns
    estimate.last_seq = observation.seq
    estimate.last_visible = observation.ids.size
    if arrays is None:
        return
    # Of a camera that moves, and with joints that may be elsewhere than they tell, more is asked in between.
    alone = state.mobile[camera] is None and arrays.joint_accuracy is None
    found = take_frame(
        state.block.record, room.record, camera, t_ns, observation.ids.astype(np.int64),
        np.array(observation.pixels, np.float64, order="C"), np.array(observation.covariances, np.float64, order="C"),
        watching.masked, alone, alone and not _unknown(camera, state, context.settings),
    )  # fmt: skip
    if found & TOLD and not alone:  # where the arm was is known, and not only expected
        _look_for_motion(camera, t_ns, context)
        found |= fold_residuals(state.block.record, room.record, camera, t_ns, watching.masked)
    if found & WAITED:
        watching.due = True
    if found & TOLD and state.model is not None and state.model.shutter_offsets:
        _follow_offset(camera, observation, context)
    if found and not alone and not _unknown(camera, state, context.settings):
        used, jacobian = watching.masked == 0.0, room.of_frame.jacobian[0]
        common = common_change(estimate, room.residuals(t_ns), used, jacobian, arrays)
        accept_sights(state.block.record, room.record, camera, t_ns, watching.masked, common)


def _look_for_motion(camera: int, t_ns: int, context: StepContext) -> None:
    """Of a mobile camera: whether it moves; while it does, its newest frame is compared with nothing."""
    state, room, arrays = context.state, context.derived.room, context.derived.arrays
    if state.mobile[camera] is None or arrays is None:
        return
    sights = room.residuals(t_ns)
    sights.seen[:] = moving_camera.see(
        state, context.settings, arrays, camera, sights, room.of_frame, room.frame_q, context.emit
    ).seen


FOLLOWED_S = 0.02
"""How far the offset of shutter stamps may be followed from what the trial motions have shown."""
FOLLOWED_DEVIATION_S = 0.001
"""Standard deviation at which motion has shown an offset well enough to follow it."""
NO_STAMPS = (*MOVED, "cameras_or_arm")
"""Verdicts on cameras whose innovations say nothing of their stamps."""


def stated_offsets(model: CellModel) -> dict[str, int]:
    """Offsets [ns] of the shutter stamps by camera, as the trial motions have shown them."""
    return {offset.camera: round(1e9 * offset.offset_s) for offset in model.shutter_offsets}


def _follow_offset(camera: int, observation: CameraObservation, context: StepContext) -> None:
    """Correct the offset of a camera's stamps by what its markers have shown in motion, within a bound.

    Only where the trial motions have shown it, and none of the joints: play of a joint looks like a late picture. A
    camera that was moved looks like one, too: its offset is the stated one from the verdict until it is known again,
    and with any other verdict the offset stays. No shutter opens after its frame has come.
    """
    state, model = context.state, context.state.model
    if model is None or model.joint_accuracy is not None:
        return
    name = context.settings.cameras[camera].name
    stated = stated_offsets(model).get(name)
    if stated is None:
        return
    estimate, timing, verdict = (
        state.cameras[camera],
        state.watching.sightings[camera].timing,
        state.watching.verdict,
    )
    if _unknown(camera, state, context.settings) or (verdict.kind in NO_STAMPS and name in verdict.subjects):
        estimate.offset_ns, timing.product, timing.square = stated, 0.0, 0.0
        return
    if timing.square < FOLLOWED_DEVIATION_S**-2 or verdict.kind != "ok":
        return
    bound = round(1e9 * FOLLOWED_S)
    latest = min(stated + bound, context.now_ns - observation.t_shutter_ns)
    offset = estimate.offset_ns + round(1e9 * timing.product / timing.square)
    estimate.offset_ns = min(max(offset, stated - bound), latest)
    timing.product = timing.square = 0.0


def _unknown(camera: int, state: CoreState, settings: CoreSettings) -> bool:
    """Whether the place of a camera is not known: it is being found again, or it moves now."""
    mobile = state.mobile[camera]
    if mobile is not None and mobile.moving:
        return True
    if state.reanchoring is None:
        return False
    return settings.cameras[camera].name in camera_relocalization.unknown_cameras(state)


def masked_ids(state: CoreState) -> tuple[int, ...]:
    """Ids of markers that are not used."""
    if state.model is None:
        return ()
    masked = state.watching.masked
    if not masked.any():
        return ()
    return tuple(state.model.marker_ids[int(i)] for i in np.flatnonzero(masked > 0.0))


# -- a frame at its shutter ---------------------------------------------------------------------------------

AGREEING_PX = 1.5


KNOWN, TOLD, WAITED = 1, 2, 4
"""What `take_frame` has found, added up: the joints are known at the shutter, and by samples on both sides of it; the
camera's frame before has not been looked at yet.
"""


@kernel
def take_frame(
    block: Record, room: Record, camera: int, t_ns: int, ids: IntArray, pixels: FloatArray, covariances: FloatArray,
    masked: FloatArray, watched: bool, used: bool,
) -> int:  # fmt: skip
    """Take a frame of ``camera``, stamped ``t_ns``: ``ids`` (k,) at raw ``pixels`` (k, 2) with ``covariances``
    (k, 2, 2). What was found; nothing else happens where the joints then are not known.

    Where it is ``watched`` and the joints are told it goes to the monitors, where it is ``used`` into the estimate;
    both without the markers that are ``masked`` (m,) > 0.
    """
    memory = block[0]
    shutter_ns = t_ns + memory.estimates[camera].offset_ns
    known, told = see_frame(block, room, camera, shutter_ns, ids, pixels, covariances)
    if not known:
        return 0
    found = KNOWN
    if told:
        found |= TOLD
    if told and watched:
        found |= fold_residuals(block, room, camera, t_ns, masked)
    if used:
        accept_sights(block, room, camera, t_ns, masked, np.zeros((masked.size, 2)))
    return found


@kernel
def see_frame(
    block: Record, room: Record, camera: int, shutter_ns: int, ids: IntArray, pixels: FloatArray,
    covariances: FloatArray,
) -> tuple[bool, bool]:  # fmt: skip
    """Compare a frame of ``camera``, taken at ``shutter_ns``, with the prediction; into the ``room``, what it holds of
    the frame that was looked at last. Whether the joints are known then, and told by samples on both sides.

    The velocities of the joints at present are those of a frame that is newer than their last sample. Sights that the
    camera's lens cannot have made are left out.
    """
    memory, work = block[0], room[0]
    n, m, rows, lens = memory.joints, memory.markers, memory.rows, work.lens_size
    standing = 2 * rows * camera
    return _seen_frame(
        memory.history_ns, memory.history_positions[: HISTORY * n].reshape((HISTORY, n)), memory.history_count,
        shutter_ns, memory.velocities[:n], work.generators[: 16 * n].reshape((n, 4, 4)), work.kinds[:n], work.zero[:n],
        work.tip_first != 0, work.marker_points[: 4 * m].reshape((m, 4)),
        work.matrices[12 * camera : 12 * camera + 12].reshape((1, 3, 4)),
        work.lenses[LENS_SIZE * camera : LENS_SIZE * camera + lens], ids, pixels, covariances, work.row_ids[:rows],
        work.row_of[:rows], work.scene_pixels[standing : standing + 2 * (rows - m)].reshape((rows - m, 2)),
        work.frame_q[:n], work.operators[: 16 * n].reshape((n, 4, 4)), work.points[: 4 * m].reshape((m, 4)),
        work.predicted[: 2 * m].reshape((1, m, 2)), work.jacobian[: 2 * m * n].reshape((1, m, 2, n)),
        work.frame_innovation[: 2 * rows].reshape((rows, 2)), work.frame_spread[: 4 * rows].reshape((rows, 2, 2)),
        work.frame_noise[:rows], work.frame_seen[:rows], work.frame_velocity[: 2 * rows].reshape((rows, 2)),
    )  # fmt: skip


@kernel
def _seen_frame(
    stamps: IntArray, positions: FloatArray, count: int, t_ns: int, velocities: FloatArray, generators: FloatArray,
    kinds: KindArray, zero: FloatArray, tip_first: bool, marker_points: FloatArray, matrix: FloatArray,
    lens: FloatArray, ids: IntArray, pixels: FloatArray, covariances: FloatArray, row_ids: IntArray, row_of: IntArray,
    standing: FloatArray, q: FloatArray, operators: FloatArray, points: FloatArray, predicted: FloatArray,
    jacobian: FloatArray, innovation: FloatArray, spread: FloatArray, noise: FloatArray, seen: KindArray,
    velocity: FloatArray,
) -> tuple[bool, bool]:  # fmt: skip
    """Whether the joints are known then, and told by samples on both sides; into the last nine arguments: ``q`` (n,),
    the fields of a `Prediction` of one camera, and those of `FrameResiduals`.
    """
    known, then = positions_at(stamps, positions, count, t_ns)
    q[:] = then
    told, speed = velocities_at(stamps, positions, count, t_ns)
    if not told:
        speed = velocities
    predict_into(
        generators, kinds, zero, q, tip_first, marker_points, matrix, operators, points, predicted, jacobian
    )
    rows = rows_of(ids, row_ids, row_of)
    if not (lens.size == 4 and lens[0] == 0.0):
        pixels, covariances, possible = undistort_sights(lens, pixels, covariances)
        for k in range(rows.size):
            if not possible[k]:
                rows[k] = -1
    _innovations_into(
        rows, pixels, covariances, predicted[0], standing, jacobian[0], speed, TIMING_SIGMA_S, innovation, spread,
        noise, seen, velocity,
    )  # fmt: skip
    return known, told


@kernel
def fold_residuals(block: Record, room: Record, camera: int, t_ns: int, masked: FloatArray) -> int:
    """What the ``room`` holds of a frame is the newest one of ``camera``; `WAITED` where no round has looked at the one
    before.
    """
    memory, work = block[0], room[0]
    n, rows = memory.joints, memory.rows
    frame = memory.sightings[camera]
    found = 0 if frame.looked else WAITED
    frame.t_ns, frame.fresh, frame.looked = t_ns, True, False
    at, end = rows * camera, rows * (camera + 1)
    innovation = memory.frame_innovation[2 * at : 2 * end].reshape((rows, 2))
    spread = memory.frame_spread[4 * at : 4 * end].reshape((rows, 2, 2))
    velocity, seen = memory.frame_velocity[2 * at : 2 * end].reshape((rows, 2)), memory.frame_seen[at:end]
    innovation[:] = work.frame_innovation[: 2 * rows].reshape((rows, 2))
    spread[:] = work.frame_spread[: 4 * rows].reshape((rows, 2, 2))
    velocity[:] = work.frame_velocity[: 2 * rows].reshape((rows, 2))
    memory.frame_q[n * camera : n * (camera + 1)] = work.frame_q[:n]
    for i in range(rows):
        seen[i] = work.frame_seen[i]
    used = rows_in_use(seen, masked)
    chi2, squares, worst, _, count = camera_chi2(innovation, spread, used, MODEL_SIGMA_PX)
    frame.chi2 = chi2 / max(2.0 * count, 1.0)
    frame.rms_px = math.sqrt(squares / max(2.0 * count, 1.0))
    u, v = (0.0, 0.0) if worst < 0 else (innovation[worst, 0], innovation[worst, 1])
    frame.worst, frame.worst_px = worst, math.sqrt(u * u + v * v)
    timing, noise = frame.timing, work.frame_noise[:rows]
    timing.product, timing.square, timing.seen_ns = fold_timing(
        timing.product, timing.square, timing.seen_ns, t_ns, innovation, velocity, noise, used
    )
    return found


FORGETTING_S = 30.0
"""Time constant, in seconds of seen motion, with which old frames are forgotten."""
MOVING_PX_S = 20.0
"""Mean pixel speed below which a frame says nothing of time."""


@kernel
def fold_timing(
    product: float, square: float, seen_ns: int, t_ns: int, innovations: FloatArray, velocities: FloatArray,
    noise: FloatArray, used: FloatArray,
) -> tuple[float, float, int]:  # fmt: skip
    """The sums of a `CameraTiming` with the rows of a frame that are ``used`` (k,) > 0.

    The markers of a frame share what the model is off by: they count as one sight, not as k.
    """
    k, speed, along, squared = _timing_sums(innovations, velocities, noise, used)
    if k == 0 or speed < MOVING_PX_S * k:
        return product, square, seen_ns
    elapsed_s = min((t_ns - seen_ns) * 1e-9, 0.2) if seen_ns != 0 else 0.0
    keep = math.exp(-elapsed_s / FORGETTING_S)
    return keep * product + along / k, keep * square + squared / k, t_ns


@kernel
def _timing_sums(
    innovations: FloatArray, velocities: FloatArray, variances: FloatArray, used: FloatArray
) -> tuple[int, float, float, float]:
    """How many markers of a frame are ``used`` (k,) > 0, and sums over these: pixel speeds, and of the weighted fit of
    innovations to velocities.
    """
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
def accept_sights(
    block: Record, room: Record, camera: int, t_ns: int, masked: FloatArray, common: FloatArray
) -> None:
    """Gate the frame that the ``room`` holds and fold it into the camera's estimate; markers that are ``masked``
    (m,) > 0 are left out.

    The gate is chi-square with two freedoms on the deviation from the filtered innovation and its ``common`` change
    (m, 2) [px], with the covariances of detector, timing and model. Near the gate a sight counts less: in the filter,
    and in triangulation by its sigma.
    """
    memory, work = block[0], room[0]
    m = memory.markers
    at, end = m * camera, m * (camera + 1)
    seen = np.empty(m, np.bool_)
    for i in range(m):
        seen[i] = work.frame_seen[i] != 0 and masked[i] == 0.0
    accepted, rejected, squares = fold_in(
        work.frame_innovation[: 2 * m].reshape((m, 2)), work.frame_spread[: 4 * m].reshape((m, 2, 2)), seen,
        work.frame_noise[:m], common, t_ns, memory.innovation[2 * at : 2 * end].reshape((m, 2)), memory.sigma[at:end],
        memory.seen_ns[at:end], work.known_s, work.filter_s, work.gate, MODEL_SIGMA_PX, FIRST_SIGHT_SIGMA_PX,
    )  # fmt: skip
    estimate = memory.estimates[camera]
    estimate.last_visible = accepted
    estimate.frames += 1
    estimate.rms_px = math.sqrt(squares / (2 * accepted)) if accepted > 0 else 0.0
    agrees = accepted >= 3 and rejected == 0 and estimate.rms_px < AGREEING_PX
    estimate.agreeing_frames = estimate.agreeing_frames + 1 if agrees else 0
    estimate.rejected_frames = estimate.rejected_frames + 1 if rejected > accepted else 0
    if accepted >= 3:
        estimate.accepted_ns = t_ns


COMMON_ROUNDS = 8
"""Of reweighting, in which sights that the joints do not explain lose their weight."""


def common_change(
    estimate: CameraEstimate, sights: FrameResiduals, used: BoolArray, jacobian: FloatArray,
    arrays: ModelArrays,
) -> FloatArray:  # fmt: skip
    """Change of the innovations (m, 2) [px] since the filtered ones that joints explain which pass through their play
    or step, within the errors that the model states of them; zeros where it states none, or where nothing changed.

    ``jacobian`` (m, 2, n). By iterated weights of Huber: what is common moves all markers, an outlier one.
    """
    m, n = used.size, jacobian.shape[2]
    none = np.zeros((m, 2))
    if arrays.joint_accuracy is None:
        return none
    rows = sights.seen[:m] & used & (estimate.seen_ns > 0)
    if int(rows.sum()) < 3:
        return none
    change = (sights.innovation[:m] - estimate.innovation)[rows]
    variance = MODEL_SIGMA_PX**2 + 0.5 * (sights.spread[:m][rows, 0, 0] + sights.spread[:m][rows, 1, 1])
    deviations = np.sqrt(arrays.joint_variances)
    J = jacobian[rows] * deviations
    equations = np.concatenate([J.reshape(-1, n), np.eye(n)])
    wanted = np.concatenate([change.reshape(-1), np.zeros(n)])
    left = change
    if float(((left**2).sum(axis=-1) / variance).max()) <= HUBER * HUBER:
        return none
    step = np.zeros(n)
    for _ in range(COMMON_ROUNDS):
        distance = np.sqrt((left**2).sum(axis=-1) / variance)
        weights = np.sqrt(np.minimum(1.0, HUBER / np.maximum(distance, 1e-9)) / variance)
        step = joint_step(equations, wanted, np.concatenate([np.repeat(weights, 2), np.ones(n)]), 0.0)
        left = change - (J * step).sum(axis=-1)
    common: FloatArray = (jacobian * (deviations * step)).sum(axis=-1)
    return common


@kernel
def _innovations_into(
    rows: IntArray, pixels: FloatArray, covariances: FloatArray, predicted: FloatArray, standing: FloatArray,
    jacobian: FloatArray, speed: FloatArray, timing_s: float, innovation: FloatArray, spread: FloatArray,
    noise: FloatArray, seen: KindArray, velocity: FloatArray,
) -> None:  # fmt: skip
    """Into the last five, the fields of `FrameResiduals`, k rows: observed less ``predicted`` (m, 2) or ``standing``
    (s, 2) [px].

    ``rows``: the row of each sight, or -1. ``jacobian`` (m, 2, n), ``speed`` (n,): what a shutter stamp that is off by
    ``timing_s`` [s] moves.
    """
    markers, n = jacobian.shape[0], jacobian.shape[2]
    innovation[:], spread[:], velocity[:] = 0.0, 0.0, 0.0
    seen[:], noise[:] = 0, 1.0
    for k in range(rows.size):
        i = rows[k]
        if i < 0:
            continue
        seen[i] = 1
        noise[i] = 0.5 * (covariances[k, 0, 0] + covariances[k, 1, 1])
        for a in range(2):
            innovation[i, a] = pixels[k, a] - (predicted[i, a] if i < markers else standing[i - markers, a])
        u = v = 0.0
        for j in range(n):
            u += jacobian[i, 0, j] * speed[j] if i < markers else 0.0
            v += jacobian[i, 1, j] * speed[j] if i < markers else 0.0
        velocity[i, 0], velocity[i, 1] = u, v
        t = timing_s * timing_s
        spread[i, 0, 0] = covariances[k, 0, 0] + t * u * u
        spread[i, 0, 1] = covariances[k, 0, 1] + t * u * v
        spread[i, 1, 0] = spread[i, 0, 1]
        spread[i, 1, 1] = covariances[k, 1, 1] + t * v * v


@kernel
def fold_in(
    innovation: FloatArray, spread: FloatArray, seen: BoolArray, noise: FloatArray, common: FloatArray,
    t_ns: int, filtered: FloatArray, sigma: FloatArray, seen_ns: IntArray,
    known_s: float, filter_s: float, gate: float, model_px: float, first_px: float,
) -> tuple[int, int, float]:  # fmt: skip
    """Fold a frame's innovations (m, 2) into the ``filtered`` ones, each by its weight; those refused leave it alone.

    ``noise`` (m,): variance of a coordinate by the detector alone; ``gate``: squared distance; ``model_px``,
    ``first_px``: what a prediction may be off by, for markers last seen within ``known_s`` and for others; ``common``
    (m, 2) [px]: change of all of them together since the filtered ones, which the gate leaves out. Gives how
    many were accepted and refused, and the sum of squares of the accepted innovations [px²].
    """
    accepted = refused = 0
    squares = 0.0
    for i in range(seen.size):
        if not seen[i]:
            continue
        age_s = (t_ns - seen_ns[i]) * 1e-9
        known = seen_ns[i] > 0 and age_s <= known_s
        x, y = innovation[i, 0], innovation[i, 1]
        if known:
            x -= filtered[i, 0]
            y -= filtered[i, 1]
        model = model_px if known else first_px
        off = model * model
        a, b = (x - common[i, 0], y - common[i, 1]) if known else (x, y)
        d2 = distance2(a, b, spread[i, 0, 0] + off, spread[i, 0, 1], spread[i, 1, 1] + off)
        if not d2 <= gate:
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
        sigma[i] = math.sqrt(noise[i] / weight)
        seen_ns[i] = t_ns
        squares += innovation[i, 0] * innovation[i, 0] + innovation[i, 1] * innovation[i, 1]
        accepted += 1
    return accepted, refused, squares
