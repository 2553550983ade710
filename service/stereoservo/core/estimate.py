"""Stage 2 of a core step: estimates the current markers by kinematics, corrected by the newest frame of each camera at
its own time stamp. At rest it puts a new model in use, with its readiness and collision thresholds.

The innovation of a marker is observed minus predicted pixel at the frame's shutter time, with the joints interpolated
from a short history; no trigger is needed. It is gated statistically, filtered, and carried to the present by the
kinematics (`core.prediction`), so that control goes on between frames and through a lost camera.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.core.context import StepContext
from stereoservo.core.cycle import ModelUpdate
from stereoservo.core.model_arrays import FIRST_SIGHT_SIGMA_PX, ModelArrays, model_arrays, require_fitting
from stereoservo.core.monitor_state import MOVED, CameraTiming, ModelMonitor
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.collision import collision_thresholds
from stereoservo.core.monitors.diagnosis import start_model_monitor
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import (
    HUBER,
    MODEL_SIGMA_PX,
    TIMING_SIGMA_S,
    FrameResiduals,
    Prediction,
    camera_chi2,
    distance2,
    gate_threshold,
    joint_step,
    positions_at,
    predict_into,
    present,
    room,
    rows_of,
    undistort_sights,
    used_rows,
    velocities_at,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CameraEstimate, CoreState, JointHistory, camera_estimate, share_sights
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.status import ModelReadiness
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray, KindArray
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import CameraObservation

AT_REST = 1e-3
"""[rad/s or m/s]"""


def estimate(context: StepContext) -> StepContext:
    """The context with the present in it: model, prediction, weights and pixels of the markers."""
    _take_model(context)
    for camera, observation in _new_frames(context):
        _fold_frame(camera, observation, context)
    arrays, state = context.derived.arrays, context.state
    if arrays is None or state.block.history_count == 0:
        return context
    context.arrays = arrays
    context.prediction, context.weights, context.pixels = present(
        arrays, context.q, state.block, context.now_ns, context.settings.limits.coast_s
    )
    if any(state.mobile):
        context = moving_camera.step(context)
        context.derived.arrays = context.arrays
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
        or bool((np.abs(state.command) > AT_REST).any())
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
    context.emit(
        "model", message=f"model epoch {model.epoch} is {state.readiness}", name=str(state.readiness)
    )


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
    arrays = context.derived.arrays = model_arrays(model, settings)
    start_model_monitor(state, arrays, settings, masked)
    state.model = model
    context.derived.load_limits = load_limits(settings, model)
    state.readiness = fitted_readiness(model)
    offsets = stated_offsets(model)
    state.cameras = [
        camera_estimate(len(model.marker_ids), offsets.get(camera.name, 0)) for camera in settings.cameras
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


# -- frames -------------------------------------------------------------------------------------------------


def _new_frames(context: StepContext) -> tuple[tuple[int, CameraObservation], ...]:
    """The frames of this step; the model monitor's cameras await them."""
    for sighting in context.state.watching.sightings:
        sighting.fresh = False
    found = context.ingested.observations
    context.observations = tuple(observation for _, observation in found)
    return found


def _fold_frame(camera: int, observation: CameraObservation, context: StepContext) -> None:
    """Compare a frame with the prediction at its shutter, and fold it into its camera's estimate."""
    state, settings, arrays = context.state, context.settings, context.derived.arrays
    estimate = state.cameras[camera]
    estimate.last_seq = observation.seq
    estimate.last_visible = int(observation.ids.size)
    shutter_ns = observation.t_shutter_ns + estimate.offset_ns
    if arrays is None:
        return
    frame = seen_frame(arrays, camera, observation, state.history, shutter_ns, state.velocities)
    if frame is None:
        return
    sights = frame.sights
    if frame.told:  # where the arm was is known, and not only expected
        if state.mobile[camera] is not None:
            sights = moving_camera.see(
                state, settings, arrays, camera, sights, frame.prediction, frame.q, context.emit
            )
        fold_residuals(state.watching, camera, sights, frame.q)
        _follow_offset(camera, observation, context)
    if not _unknown(camera, state, settings):
        used = state.watching.masked == 0.0
        common = common_change(estimate, sights, used, frame.prediction.jacobian[0], arrays)
        accept_sights(estimate, sights, used, settings, common)


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


class SeenFrame(NamedTuple):
    """A frame at its shutter: joints ``q`` (n,) then, whether they are ``told`` by samples on both sides, the
    ``prediction`` of its camera alone, and the residuals ``sights``.
    """

    q: FloatArray
    told: bool
    prediction: Prediction
    sights: FrameResiduals


def seen_frame(
    arrays: ModelArrays, camera: int, observation: CameraObservation, history: JointHistory, shutter_ns: int,
    velocities: FloatArray,
) -> SeenFrame | None:  # fmt: skip
    """An observation of ``camera``, in raw pixels, taken at ``shutter_ns``; None where the joints then are not known.

    ``velocities`` (n,): of the joints at present, for a frame that is newer than their last sample. Sights that the
    camera's lens cannot have made are left out.
    """
    n, markers = arrays.zero.size, len(arrays.marker_points)
    rows = markers + len(arrays.scene_points)
    q, prediction = np.empty(n), room(n, 1, markers)
    sights = FrameResiduals(
        observation.t_shutter_ns, np.empty((rows, 2)), np.empty((rows, 2, 2)), np.empty(rows), np.empty(rows, np.bool_),
        np.empty((rows, 2)),
    )  # fmt: skip
    known, told = _seen_frame(
        history.t_ns, history.positions, history.count, shutter_ns, velocities, arrays.generators, arrays.kinds,
        arrays.zero, arrays.tip_first, arrays.marker_points, arrays.matrices[camera : camera + 1],
        arrays.lenses[camera], observation.ids.astype(np.int64), np.array(observation.pixels, np.float64),
        np.array(observation.covariances, np.float64), arrays.row_ids, arrays.row_of, arrays.scene_pixels[camera],
        q, prediction.operators, prediction.points, prediction.pixels, prediction.jacobian, sights.innovation,
        sights.spread, sights.noise, sights.seen, sights.velocity,
    )  # fmt: skip
    return SeenFrame(q, told, prediction, sights) if known else None


@kernel
def _seen_frame(
    stamps: IntArray, positions: FloatArray, count: int, t_ns: int, velocities: FloatArray, generators: FloatArray,
    kinds: KindArray, zero: FloatArray, tip_first: bool, marker_points: FloatArray, matrix: FloatArray,
    lens: FloatArray, ids: IntArray, pixels: FloatArray, covariances: FloatArray, row_ids: IntArray, row_of: IntArray,
    standing: FloatArray, q: FloatArray, operators: FloatArray, points: FloatArray, predicted: FloatArray,
    jacobian: FloatArray, innovation: FloatArray, spread: FloatArray, noise: FloatArray, seen: BoolArray,
    velocity: FloatArray,
) -> tuple[bool, bool]:  # fmt: skip
    """Whether the joints are known then, and told by samples on both sides; into the last arguments, the arrays of
    `SeenFrame`.
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


def fold_residuals(watching: ModelMonitor, camera: int, sights: FrameResiduals, q: FloatArray) -> None:
    """A new frame of one camera, with the arm at ``q`` (n,) then."""
    sighting = watching.sightings[camera]
    watching.due = watching.due or not sighting.looked
    sighting.innovation = sights.innovation
    sighting.spread = sights.spread
    sighting.seen = sights.seen.astype(np.float64)
    sighting.velocity = sights.velocity
    sighting.q = q
    sighting.t_ns = sights.t_shutter_ns
    sighting.fresh, sighting.looked = True, False
    used = used_rows(watching, sighting)
    chi2, squares, worst, _, count = camera_chi2(sighting.innovation, sighting.spread, used, MODEL_SIGMA_PX)
    sighting.chi2 = chi2 / max(2.0 * count, 1.0)
    sighting.rms_px = math.sqrt(squares / max(2.0 * count, 1.0))
    sighting.worst = worst
    u, v = (0.0, 0.0) if worst < 0 else sighting.innovation[worst].tolist()
    sighting.worst_px = math.sqrt(u * u + v * v)
    fold_timing(sighting.timing, sights, used)


FORGETTING_S = 30.0
"""Time constant, in seconds of seen motion, with which old frames are forgotten."""
MOVING_PX_S = 20.0
"""Mean pixel speed below which a frame says nothing of time."""


def fold_timing(timing: CameraTiming, sights: FrameResiduals, used: FloatArray) -> None:
    """Take in the rows of a frame that are ``used`` (k,) > 0.

    The markers of a frame share what the model is off by: they count as one sight, not as k.
    """
    t_ns = sights.t_shutter_ns
    k, speed, product, square = _timing_sums(sights.innovation, sights.velocity, sights.noise, used)
    if k == 0 or speed < MOVING_PX_S * k:
        return
    elapsed_s = min((t_ns - timing.seen_ns) * 1e-9, 0.2) if timing.seen_ns else 0.0
    keep = math.exp(-elapsed_s / FORGETTING_S)
    timing.product = keep * timing.product + product / k
    timing.square = keep * timing.square + square / k
    timing.seen_ns = t_ns


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


def accept_sights(
    estimate: CameraEstimate, sights: FrameResiduals, used: BoolArray, settings: CoreSettings,
    common: FloatArray,
) -> None:  # fmt: skip
    """Gate one frame and fold it into the camera's estimate; markers that are not ``used`` (m,) are left out.

    The gate is chi-square with two freedoms on the deviation from the filtered innovation and its ``common`` change
    (m, 2) [px], with the covariances of detector, timing and model. Near the gate a sight counts less: in the filter,
    and in triangulation by its sigma.
    """
    m = used.size
    accepted, rejected, squares = fold_in(
        sights.innovation[:m], sights.spread[:m], sights.seen[:m] & used, sights.noise[:m], common,
        sights.t_shutter_ns, estimate.innovation, estimate.sigma, estimate.seen_ns,
        settings.limits.coast_s + 1.0, settings.filter_s, gate_threshold(settings.gate_sigma), MODEL_SIGMA_PX,
        FIRST_SIGHT_SIGMA_PX,
    )  # fmt: skip
    estimate.last_visible = accepted
    estimate.frames += 1
    estimate.rms_px = math.sqrt(squares / (2 * accepted)) if accepted else 0.0
    agrees = accepted >= 3 and rejected == 0 and estimate.rms_px < AGREEING_PX
    estimate.agreeing_frames = estimate.agreeing_frames + 1 if agrees else 0
    estimate.rejected_frames = estimate.rejected_frames + 1 if rejected > accepted else 0
    if accepted >= 3:
        estimate.accepted_ns = sights.t_shutter_ns


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
    noise: FloatArray, seen: BoolArray, velocity: FloatArray,
) -> None:  # fmt: skip
    """Into the last five, the fields of `FrameResiduals`, k rows: observed less ``predicted`` (m, 2) or ``standing``
    (s, 2) [px].

    ``rows``: the row of each sight, or -1. ``jacobian`` (m, 2, n), ``speed`` (n,): what a shutter stamp that is off by
    ``timing_s`` [s] moves.
    """
    markers, n = jacobian.shape[0], jacobian.shape[2]
    innovation[:], spread[:], velocity[:] = 0.0, 0.0, 0.0
    seen[:], noise[:] = False, 1.0
    for k in range(rows.size):
        i = rows[k]
        if i < 0:
            continue
        seen[i] = True
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
