"""Stage 2 of a core step: estimates the current markers by kinematics, corrected by the newest frame of each camera at
its own time stamp. At rest it puts a new model in use, with its readiness and collision thresholds.

What each camera shows is compared with the prediction at its shutter; what is left is filtered and carried to the
present by the kinematics (`core.prediction`), so that control goes on between frames and through a lost camera.
"""

from __future__ import annotations

import numpy as np

from stereoservo.core.context import StepContext
from stereoservo.core.cycle import ModelUpdate
from stereoservo.core.model_arrays import model_arrays, require_fitting
from stereoservo.core.monitor_state import MOVED
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.collision import collision_thresholds
from stereoservo.core.monitors.diagnosis import start_model_monitor
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import (
    accept_sights,
    common_change,
    fold_residuals,
    frame_sights,
    ideal_observation,
    joint_correction,
    joints_at,
    marker_weights,
    motion_at,
    pixels_now,
    predict,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState, camera_estimate
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.status import ModelReadiness
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import CameraObservation

AT_REST = 1e-3
"""[rad/s or m/s]"""


def estimate(context: StepContext) -> StepContext:
    """The context with the present in it: model, prediction, weights and pixels of the markers."""
    _take_model(context)
    for camera, observation in _new_frames(context):
        _fold_frame(camera, observation, context)
    arrays, state = context.derived.arrays, context.state
    if arrays is None or state.history.count == 0:
        return context
    context.arrays = arrays
    context.prediction = predict(arrays, context.q)
    context.weights = marker_weights(state.cameras, context.now_ns, context.settings.limits.coast_s)
    state.correction = joint_correction(arrays, context.q, context.prediction, state.cameras, context.weights)
    context.pixels = pixels_now(context.prediction, state.cameras)
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
    at_shutter = joints_at(state.history, shutter_ns)
    if arrays is None or at_shutter is None:
        return
    prediction = predict(arrays, at_shutter, camera)
    motion = motion_at(state.history, shutter_ns)
    speed = state.velocities if motion is None else motion
    sights = frame_sights(arrays, camera, ideal_observation(arrays, camera, observation), prediction, speed)
    if motion is not None:  # where the arm was is known, and not only expected
        if state.mobile[camera] is not None:
            sights = moving_camera.see(
                state, settings, arrays, camera, sights, prediction, at_shutter, context.emit
            )
        fold_residuals(state.watching, camera, sights, at_shutter)
        _follow_offset(camera, observation, context)
    if not _unknown(camera, state, settings):
        used = state.watching.masked == 0.0
        common = common_change(estimate, sights, used, prediction.jacobian[0], arrays)
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
    return tuple(state.model.marker_ids[int(i)] for i in np.flatnonzero(state.watching.masked > 0.0))
