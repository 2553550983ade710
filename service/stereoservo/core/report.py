"""Stage 7 of a core step: ends a finished motion, then assembles status, reasons, detector priors and events, with
model health and the estimated time offset of each camera.
"""

from __future__ import annotations

import math
from operator import is_

import numpy as np

from stereoservo.core.camera_state import CameraEstimate, CameraTiming
from stereoservo.core.context import COMPILING, SourceOutput, StepContext
from stereoservo.core.cycle import Event, Status, StepOutputs
from stereoservo.core.estimate import masked_ids
from stereoservo.core.goals.execute import finish
from stereoservo.core.goals.plan import planning_reason
from stereoservo.core.limit import SafetyResult
from stereoservo.core.model_arrays import FIRST_SIGHT_SIGMA_PX, ModelArrays
from stereoservo.core.monitor_state import ModelDiagnosis
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.diagnosis import diagnosis_reason
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import TIMING_SIGMA_S, Prediction, propagate_covariance
from stereoservo.core.state import CoreState
from stereoservo.core.workspace import LENS_SIZE
from stereoservo.kinematics.kernels import distort_pixel, distortion_jacobian
from stereoservo.messages.reasons import Level, Reason
from stereoservo.messages.status import CameraHealth, Health, Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import Prior

LEVELS: tuple[Level, ...] = ("info", "slow", "hold", "fault")


def report(
    context: StepContext, motion: SourceOutput, limited: SafetyResult, events: list[Event]
) -> StepOutputs:
    """The outputs of the step: nothing is commanded outside ACTIVE."""
    state = context.state
    if motion.finished:
        finish(motion, context)
    state.step += 1
    return StepOutputs(
        state.block.command.copy() if state.lifecycle == Lifecycle.ACTIVE else None,
        _status(context, motion, limited),
        () if state.step % context.derived.prior_every else _priors(context),
        tuple(events),
        state.driver_request,  # type: ignore[arg-type]
    )


def _status(context: StepContext, motion: SourceOutput, limited: SafetyResult) -> Status:
    """The status, its fields in their order: an argument by name costs as much as an array."""
    state, derived, block = context.state, context.derived, context.state.block
    diagnosis, health = _model_health(context)
    source, kind = state.source, MOTION_SOURCES[type(state.source)]
    reasons = _reasons(context, motion, limited, diagnosis)
    done, left_s = (None, None) if kind.progress is None else kind.progress(source, context)
    seen = derived.seen
    if context.observations or seen is None or seen[0] is not state.cameras:
        seen = derived.seen = _seen(context)
    _, innovation_px, visible = seen
    numbers, (effort_limits, following_limits) = block.numbers, derived.load_limits or (None, None)
    model_epoch = 0 if state.model is None else state.model.epoch
    efforts = block.efforts.copy() if numbers.tells_efforts else None
    following_errors = block.following_errors.copy() if numbers.tells_following else None
    return Status(
        context.now_ns, state.step, str(state.lifecycle), str(state.readiness), model_epoch, kind.name,
        kind.subject(source), kind.law(source), _level(reasons), reasons, context.q, block.velocities.copy(),
        motion.velocity, block.command.copy(), motion.error_px, motion.task_error, innovation_px, visible, done, left_s,
        efforts, following_errors, effort_limits, following_limits, health,
    )  # fmt: skip


def _seen(context: StepContext) -> tuple[list[CameraEstimate], dict[str, float], dict[str, int]]:
    """The cameras' estimates, and of each camera, by name: the innovation [px], and the markers visible."""
    estimates, names = context.state.cameras, context.derived.cameras
    innovation_px = {name: estimates[c].rms_px for name, c in names.items()}
    return estimates, innovation_px, {name: estimates[c].last_visible for name, c in names.items()}


def _model_health(context: StepContext) -> tuple[ModelDiagnosis, Health]:
    """The diagnosis as it is shown, and what the status says of the model's health: those of the step before, where no
    frame has come and nothing else that they follow from is another.
    """
    state, derived, watching = context.state, context.derived, context.state.watching
    if context.plain and not context.observations and derived.model_health is not None:
        return derived.model_health[2]
    told = state.model, state.readiness, watching, watching.verdict
    marks, known = watching.masked.tobytes(), derived.model_health
    quiet = state.reanchoring is None and not any(state.mobile)
    if (
        known is not None
        and quiet
        and not context.observations
        and all(map(is_, told, known[0]))
        and marks == known[1]
    ):
        return known[2]
    masked = masked_ids(state)
    diagnosis = shown_diagnosis(watching.verdict, masked)
    found = diagnosis, _health(context, diagnosis, masked)
    derived.model_health = (told, marks, found) if quiet else None
    return found


def _reasons(
    context: StepContext, motion: SourceOutput, limited: SafetyResult, diagnosis: ModelDiagnosis
) -> tuple[Reason, ...]:
    """Why the arm does not do what its source wants, or may not soon."""
    state, explain = context.state, MOTION_SOURCES[type(context.state.source)].progress_reasons
    if context.plain:
        told = (*limited.reasons, *motion.reasons)
        return told if explain is None else told + explain(state.source, context, told)
    found = [*state.fault, *limited.reasons, *motion.reasons]
    for refused in (state.refused_joints, *state.refused_frames):
        if refused.reason is not None and not _latched(refused.reason, state):
            found.append(refused.reason)
    if state.reanchoring is not None:
        found.extend(camera_relocalization.reasons(state))
    if any(state.mobile):
        found.extend(moving_camera.reasons(state, context.settings))
    if state.reanchoring is None and diagnosis.kind != "ok":
        reason = diagnosis_reason(diagnosis)
        if reason is not None:
            found.append(reason)
    if explain is not None and not context.paused:
        found.extend(explain(state.source, context, tuple(found)))
    if state.planning is not None:
        found.append(planning_reason(state.planning))
    if context.inputs.compiling:
        found.append(Reason("COMPILING", "info", hint=COMPILING))
    if state.stopped:
        if state.stop_reason is not None:
            found.append(state.stop_reason)
        found.append(Reason("STOPPED", "hold", hint="resume to go on"))
    elif state.held:
        found.append(Reason("HELD", "hold", hint="resume to go on"))
    if state.readiness == ModelReadiness.SUSPECT:
        found.append(Reason("MODEL_SUSPECT", "hold", hint="calibrate again"))
    return tuple(found)


def _latched(reason: Reason, state: CoreState) -> bool:
    """Whether that is refused which already stands as the reason of a stop."""
    latched = state.stop_reason if state.stopped else None
    return latched is not None and (reason.code, reason.subject) == (latched.code, latched.subject)


def _priors(context: StepContext) -> tuple[Prior, ...]:
    """What the detectors are to expect, in steps that send it."""
    state, arrays, prediction = context.state, context.derived.arrays, context.prediction
    if prediction is None or arrays is None or state.step % context.derived.prior_every:
        return ()
    moving: list[int] = []
    unknown: tuple[str, ...] = ()
    if state.reanchoring is not None or any(state.mobile):
        prediction, moving, unknown = moving_camera.to_look_from(arrays, context)
    return priors(arrays, context, prediction, moving, unknown)


def _level(reasons: tuple[Reason, ...]) -> str:
    """The worst level of the reasons; information is none."""
    if not reasons:
        return "ok"
    worst = max([LEVELS.index(reason.level) for reason in reasons])
    return "ok" if worst == 0 else LEVELS[worst]


def shown_diagnosis(verdict: ModelDiagnosis, masked: tuple[int, ...]) -> ModelDiagnosis:
    """The verdict as it is shown: a marker that is left out remains one that has slipped."""
    if verdict.kind != "ok" or not masked:
        return verdict
    listed = tuple(str(marker) for marker in masked)
    text = f"marker {', '.join(listed)} has slipped and is not used; fix it where it was, or calibrate"
    return ModelDiagnosis("marker_slipped", listed, text=text)


NO_HEALTH = Health()


def _health(context: StepContext, diagnosis: ModelDiagnosis, masked: tuple[int, ...]) -> Health:
    """What the status says of the model's health: what it said before, where nothing of it has changed."""
    state, derived = context.state, context.derived
    model = state.model
    if model is None or state.readiness == ModelReadiness.NONE:
        return NO_HEALTH
    reanchoring = "" if state.reanchoring is None else state.reanchoring.phase
    facts = [
        (s.chi2, s.rms_px, s.worst, s.worst_px, s.timing.product, s.timing.square)
        for s in state.watching.sightings
    ]
    places = None if not any(state.mobile) else ["" if m is None else m.place for m in state.mobile]
    told = (model.epoch, diagnosis, masked, reanchoring, facts, places)
    if derived.health is None or derived.health[0] != told:
        derived.health = told, _health_now(context, diagnosis, masked, reanchoring)
    return derived.health[1]


def _health_now(
    context: StepContext, verdict: ModelDiagnosis, masked: tuple[int, ...], reanchoring: str
) -> Health:
    state = context.state
    assert state.model is not None
    ids = (*state.model.marker_ids, *state.model.scene_ids)
    told = zip(context.settings.cameras, state.watching.sightings, state.mobile, strict=True)
    cameras = {
        camera.name: CameraHealth(
            seen.chi2, seen.rms_px, ids[seen.worst] if seen.worst >= 0 else -1, seen.worst_px,
            "" if moves is None else moves.place, advice(seen.timing),
        )
        for camera, seen, moves in told
    }  # fmt: skip
    return Health(
        verdict.kind, verdict.subjects, verdict.size, verdict.deviation, verdict.unit, verdict.text, cameras, masked,
        reanchoring,
    )  # fmt: skip


KNOWN_S = 0.002
"""Standard deviation at which the offset is told."""
WRONG_S = 0.004
"""Offset that is worth a word: at 100 px/s it moves a marker by 0.4 px."""


def offset_s(timing: CameraTiming) -> tuple[float, float]:
    """How much later than stated the shutter opens [s], and its standard deviation; (0, inf) before any motion."""
    if timing.square <= 0.0:
        return 0.0, math.inf
    return timing.product / timing.square, 1.0 / math.sqrt(timing.square)


def advice(timing: CameraTiming) -> str:
    """What is to be said of it to people; empty where the stamps are right, or nothing is known yet."""
    late, deviation = offset_s(timing)
    if deviation > KNOWN_S or abs(late) < max(WRONG_S, 4.0 * deviation):
        return ""
    way = "less" if late > 0 else "more"
    return (
        f"its shutter opens {1e3 * abs(late):.1f} ms {'later' if late > 0 else 'earlier'} than stated "
        f"(± {1e3 * deviation:.1f}): {1e3 * abs(late):.0f} ms {way} latency_s would be right"
    )


# -- priors --------------------------------------------------------------------------------------------------


def priors(
    arrays: ModelArrays, context: StepContext, prediction: Prediction, moving: list[int], unknown: tuple[str, ...]
) -> tuple[Prior, ...]:  # fmt: skip
    """One prior a camera for the detectors' windows, raw; covariance from model and motion, never fed back.

    What cameras that are ``moving`` saw before is no matter. None for cameras of whose place nothing is known: their
    detectors look in the whole image.
    """
    state, room, now_ns = context.state, context.derived.room, context.now_ns
    shape = prediction.pixels.shape
    pixels, speed, covariance = np.empty(shape), np.empty(shape), np.empty((*shape, 2))
    if arrays.joint_accuracy is not None:
        room.unseen_px[:] = _unseen_sigma(prediction.jacobian, arrays)
    beyond = expect_sights(
        state.block.record, room.record, now_ns, prediction.pixels, prediction.jacobian,
        sum([1 << c for c in moving]), pixels, speed, covariance,
    )  # fmt: skip
    found = []
    for c, (camera, estimate) in enumerate(zip(context.settings.cameras, state.cameras, strict=True)):
        if camera.name in unknown:
            continue
        # The vision process asks for the stamps that the camera tells.
        shown = arrays.ids, pixels[c], speed[c], covariance[c]
        if beyond >> c & 1:
            within = np.isfinite(pixels[c]).all(axis=-1)
            shown = arrays.ids[within], pixels[c][within], speed[c][within], covariance[c][within]
        found.append(Prior(camera.name, now_ns - estimate.offset_ns, *shown))
    return tuple(found)


@kernel
def expect_sights(
    block: Record, room: Record, now_ns: int, predicted: FloatArray, jacobian: FloatArray, moving: int,
    pixels: FloatArray, speed: FloatArray, covariance: FloatArray,
) -> int:  # fmt: skip
    """Into the last three, (c, m, …): `expected_sights_into` of all cameras, as their lenses show them. As bits of a
    number, the cameras with markers beyond the folds of their lenses; pixels of these are no numbers.

    ``predicted`` (c, m, 2) with its ``jacobian`` (c, m, 2, n). Cameras whose bits are set in ``moving`` have seen
    nothing of late.
    """
    memory, work = block[0], room[0]
    m, lens_size = memory.markers, work.lens_size
    beyond = 0
    for c in range(memory.cameras):
        at, end = m * c, m * (c + 1)
        seen_ns = memory.seen_ns[at:end]
        if moving & (1 << c):
            seen_ns = np.zeros(m, np.int64)
        expected_sights_into(
            predicted[c], jacobian[c], memory.velocities[: memory.joints],
            memory.innovation[2 * at : 2 * end].reshape((m, 2)), now_ns, seen_ns, work.unseen_px[at:end], pixels[c],
            speed[c], covariance[c],
        )  # fmt: skip
        lens = work.lenses[LENS_SIZE * c : LENS_SIZE * c + lens_size]
        if lens_size == 4 and lens[0] == 0.0:
            continue
        pixels[c], speed[c], covariance[c], seen = distort_expected(lens, pixels[c], speed[c], covariance[c])
        if not seen.all():
            beyond |= 1 << c
    return beyond


@kernel
def expected_sights_into(
    predicted: FloatArray, jacobian: FloatArray, velocities: FloatArray, innovation: FloatArray, now_ns: int,
    seen_ns: IntArray, unseen_px: FloatArray, pixels: FloatArray, speed: FloatArray, covariance: FloatArray,
) -> None:  # fmt: skip
    """Pixels (m, 2), their velocities (m, 2) and covariances (m, 2, 2) that a camera is expected to have.

    ``predicted`` (m, 2) with its ``jacobian`` (m, 2, n), plus the ``innovation`` (m, 2) of markers seen of late, at
    ``seen_ns`` (m,); ``unseen_px`` (m,): deviation of the others.
    """
    m, n = jacobian.shape[0], jacobian.shape[2]
    for i in range(m):
        fresh = now_ns - seen_ns[i] <= SEEN_LATELY_NS and seen_ns[i] > 0
        fastest = 0.0
        for a in range(2):
            along = 0.0
            for j in range(n):
                along += jacobian[i, a, j] * velocities[j]
            speed[i, a] = along
            fastest = max(fastest, abs(along))
            pixels[i, a] = predicted[i, a] + (innovation[i, a] if fresh else 0.0)
        sigma = (1.0 if fresh else unseen_px[i]) + TIMING_SIGMA_S * fastest
        covariance[i, 0, 0] = covariance[i, 1, 1] = sigma * sigma
        covariance[i, 0, 1] = covariance[i, 1, 0] = 0.0


SEEN_LATELY_NS = 1_000_000_000
LARGEST_WINDOW_PX = 20.0
"""Deviation beyond which a detector does better to look in the whole image."""


def _unseen_sigma(jacobian: FloatArray, arrays: ModelArrays) -> FloatArray:
    """Deviations (c, m) [px] of markers that were not seen of late, by their ``jacobian`` (c, m, 2, n)."""
    by_joints: FloatArray = (jacobian**2 * arrays.joint_variances).sum(axis=-1).max(axis=-1)
    return np.asarray(np.minimum(np.sqrt(FIRST_SIGHT_SIGMA_PX**2 + by_joints), LARGEST_WINDOW_PX))


@kernel
def distort_expected(
    lens: FloatArray, pixels: FloatArray, velocities: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Raw pixels (k, 2), velocities (k, 2), covariances (k, 2, 2) of ideal ones, and which (k,) lie within the fold."""
    n = pixels.shape[0]
    raw = np.empty((n, 2))
    speed = np.empty((n, 2))
    spread = np.empty((n, 2, 2))
    seen = np.empty(n, dtype=np.bool_)
    for i in range(n):
        raw[i, 0], raw[i, 1] = distort_pixel(lens, pixels[i, 0], pixels[i, 1])
        a, b, d = distortion_jacobian(lens, pixels[i, 0], pixels[i, 1])
        speed[i, 0] = a * velocities[i, 0] + b * velocities[i, 1]
        speed[i, 1] = b * velocities[i, 0] + d * velocities[i, 1]
        propagate_covariance(a, b, d, covariances[i], spread[i])
        seen[i] = math.isfinite(raw[i, 0]) and math.isfinite(raw[i, 1])
    return raw, speed, spread, seen
