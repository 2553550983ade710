"""Stage 7 of a core step: ends a finished motion, then assembles status, reasons, detector priors and events, with
model health and the estimated time offset of each camera.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.core.camera_state import CameraTiming
from stereoservo.core.command import SafetyLimits, SafetyResult, limited_command
from stereoservo.core.context import COMPILING, LENS_SIZE, SourceOutput, StepContext
from stereoservo.core.cycle import NOT_MEASURED, Status
from stereoservo.core.estimate import masked_ids
from stereoservo.core.goals.execute import finish
from stereoservo.core.goals.plan import planning_reason
from stereoservo.core.model_arrays import FIRST_SEEN_SIGMA_PX, ModelArrays
from stereoservo.core.monitor_state import ModelDiagnosis
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.diagnosis import diagnosis_reason
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import TIMING_SIGMA_S, Prediction, propagate_covariance
from stereoservo.core.sources.law import found_by_kernel
from stereoservo.core.state import CoreState, LawRun, ServoGoal
from stereoservo.kinematics.kernels import distort_pixel, distortion_jacobian
from stereoservo.messages.reasons import Level, Reason
from stereoservo.messages.status import CameraHealth, Health, ModelReadiness
from stereoservo.numerics.arrays import BoolArray, FloatArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import Prior

LEVELS: tuple[Level, ...] = ("info", "slow", "hold", "fault")


def finish_step(context: StepContext, limits: SafetyLimits) -> None:
    """Stage 7, in every step: end a motion that has finished, and a few times a second examine the progress of a law's
    run.
    """
    state, output = context.state, context.output
    if output is not None:
        context.derived.workspace.result[0] = NOT_MEASURED if output.error_px is None else output.error_px
        if output.finished:
            finish(output, context)
    state.step += 1
    if state.step % context.derived.check_every or not context.derived.workspace.numbers.runs:
        return
    source = state.source
    examine = MOTION_SOURCES[type(source)].examine
    if examine is not None:
        earlier = tuple(_reasons_before(context, limited_command(context, limits)))
        source.reasons = examine(source, context, earlier)  # type: ignore[union-attr]


def status_of(context: StepContext, limits: SafetyLimits) -> Status:
    """The status after the step. The fields are passed by position: a keyword argument costs as much
    time as an array.
    """
    state, derived, block = context.state, context.derived, context.state.block
    masked = masked_ids(state)
    diagnosis = shown_diagnosis(state.watching.verdict, masked)
    motion, limited = motion_of(context), limited_command(context, limits)
    source, kind = state.source, MOTION_SOURCES[type(state.source)]
    reasons = _reasons(context, _reasons_before(context, limited))
    done, left_s = (None, None) if kind.progress is None else kind.progress(source, context)
    numbers, (effort_limits, following_limits) = block.numbers, derived.load_limits or (None, None)
    model_epoch = 0 if state.model is None else state.model.epoch
    estimates, names = state.cameras, derived.cameras
    return Status(
        context.now_ns, state.step, str(state.lifecycle), str(state.readiness), model_epoch, kind.name,
        kind.subject(source), kind.law(source), _level(reasons), reasons, context.q, block.velocities.copy(),
        limited.raw, block.command.copy(), motion.error_px, motion.task_error,
        {name: estimates[c].rms_px for name, c in names.items()},
        {name: estimates[c].last_visible for name, c in names.items()}, done, left_s,
        block.efforts.copy() if numbers.tells_efforts else None,
        block.following_errors.copy() if numbers.tells_following else None, effort_limits, following_limits,
        _health(context, diagnosis, masked),
    )  # fmt: skip


NO_MOTION = SourceOutput(np.zeros(0))


def motion_of(context: StepContext) -> SourceOutput:
    """The active source's output in this step, also if it is a law's kernel."""
    if context.output is not None:
        return context.output
    source = context.state.source
    if isinstance(source, ServoGoal) and not context.derived.workspace.numbers.rests:
        return found_by_kernel(source, context)
    return NO_MOTION


def _reasons_before(context: StepContext, limited: SafetyResult) -> list[Reason]:
    """The reasons why the arm does not execute its source's velocity, without those of a law's progress over time."""
    state = context.state
    found = [*state.fault, *limited.reasons, *motion_of(context).reasons]
    for refused in (state.refused_joints, *state.refused_frames):
        if refused.reason is not None and not _latched(refused.reason, state):
            found.append(refused.reason)
    if state.reanchoring is not None:
        found.extend(camera_relocalization.reasons(state))
    if any(state.mobile):
        found.extend(moving_camera.reasons(state, context.settings))
    diagnosis = shown_diagnosis(state.watching.verdict, masked_ids(state))
    if state.reanchoring is None and diagnosis.kind != "ok":
        reason = diagnosis_reason(diagnosis)
        if reason is not None:
            found.append(reason)
    return found


def _reasons(context: StepContext, found: list[Reason]) -> tuple[Reason, ...]:
    """All reasons: those ``found`` before, and those of the last examination of a law's run."""
    state = context.state
    if context.derived.workspace.numbers.runs and isinstance(state.source, LawRun):
        codes = {reason.code for reason in found}
        found.extend([reason for reason in state.source.reasons if reason.code not in codes])
    if state.planning is not None:
        found.append(planning_reason(state.planning))
    if context.inputs.compiling:
        found.append(Reason("COMPILING", "info", hint=COMPILING))
    if state.readiness == ModelReadiness.UNCONFIRMED and state.comparison is not None:
        found.append(state.comparison.reason)
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
    """Whether the refusal repeats a reason that is already shown for a stop."""
    latched = state.stop_reason if state.stopped else None
    return latched is not None and (reason.code, reason.subject) == (latched.code, latched.subject)


def priors_of(context: StepContext) -> tuple[Prior, ...]:
    """The detectors' priors, in steps that send them."""
    state, arrays, prediction = context.state, context.derived.arrays, context.prediction
    if prediction is None or arrays is None or state.step % context.derived.prior_every:
        return ()
    moving: list[int] = []
    unknown: tuple[str, ...] = ()
    if state.reanchoring is not None or any(state.mobile):
        prediction, moving, unknown = moving_camera.prediction_for_priors(arrays, context)
    return priors(arrays, context, prediction, moving, unknown)


def _level(reasons: tuple[Reason, ...]) -> str:
    """The worst level of the reasons; information has no level."""
    if not reasons:
        return "ok"
    worst = max([LEVELS.index(reason.level) for reason in reasons])
    return "ok" if worst == 0 else LEVELS[worst]


def shown_diagnosis(verdict: ModelDiagnosis, masked: tuple[int, ...]) -> ModelDiagnosis:
    """The diagnosis as it is shown: a masked marker continues to be reported as slipped."""
    if verdict.kind != "ok" or not masked:
        return verdict
    listed = tuple(str(marker) for marker in masked)
    text = f"marker {', '.join(listed)} has slipped and is not used; fix it where it was, or calibrate"
    return ModelDiagnosis("marker_slipped", listed, text=text)


NO_HEALTH = Health()


def _health(context: StepContext, diagnosis: ModelDiagnosis, masked: tuple[int, ...]) -> Health:
    """The model's health for the status: the previous record if nothing has changed."""
    state, derived = context.state, context.derived
    model = state.model
    if model is None or state.readiness == ModelReadiness.NONE:
        return NO_HEALTH
    reanchoring = "" if state.reanchoring is None else state.reanchoring.phase
    facts = [
        (s.chi2, s.rms_px, s.worst, s.worst_px, s.timing.product, s.timing.square) for s in state.watching.sightings
    ]
    places = None if not any(state.mobile) else ["" if m is None else m.place for m in state.mobile]
    facts_now = (model.epoch, diagnosis, masked, reanchoring, facts, places)
    if derived.health is None or derived.health[0] != facts_now:
        derived.health = facts_now, _health_now(context, diagnosis, masked, reanchoring)
    return derived.health[1]


def _health_now(context: StepContext, verdict: ModelDiagnosis, masked: tuple[int, ...], reanchoring: str) -> Health:
    state = context.state
    assert state.model is not None
    ids = (*state.model.marker_ids, *state.model.scene_ids)
    monitored = zip(context.settings.cameras, state.watching.sightings, state.mobile, strict=True)
    cameras = {
        camera.name: CameraHealth(
            seen.chi2,
            seen.rms_px,
            ids[seen.worst] if seen.worst >= 0 else -1,
            seen.worst_px,
            "" if moves is None else moves.place,
            advice(seen.timing),
        )
        for camera, seen, moves in monitored
    }
    return Health(
        verdict.kind, verdict.subjects, verdict.size, verdict.deviation, verdict.unit, verdict.text, cameras, masked,
        reanchoring,
    )  # fmt: skip


KNOWN_S = 0.002
"""Standard deviation [s] at which the offset is reported."""
WRONG_S = 0.004
"""Offset [s] that is worth reporting: at 100 px/s it moves a marker by 0.4 px."""


def offset_s(timing: CameraTiming) -> tuple[float, float]:
    """Delay of the shutter relative to its stated time [s], and its standard deviation; (0, inf) before any motion."""
    if timing.square <= 0.0:
        return 0.0, math.inf
    return timing.product / timing.square, 1.0 / math.sqrt(timing.square)


def advice(timing: CameraTiming) -> str:
    """Advice to the user about the offset; empty if the stamps are correct, or nothing is known yet."""
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
) -> tuple[Prior, ...]:
    """One prior a camera for the detectors' windows, in raw pixels. The covariance is that of model and motion; it is
    never fed back.

    Earlier observations of cameras that are ``moving`` are not used. Cameras whose pose is ``unknown`` have no prior:
    their detectors search the whole image.
    """
    state, room, now_ns = context.state, context.derived.workspace, context.now_ns
    shape = prediction.pixels.shape
    expected = Expected(np.empty(shape), np.empty(shape), np.empty((*shape, 2)))
    pixels, speed, covariance = expected
    if arrays.joint_accuracy is not None:
        room.unseen_px[:] = _unseen_sigma(prediction.jacobian, arrays)
    beyond = expect_sights(
        state.block.record, room.record, prediction.pixels, prediction.jacobian, sum([1 << c for c in moving]), expected
    )
    found = []
    for c, (camera, estimate) in enumerate(zip(context.settings.cameras, state.cameras, strict=True)):
        if camera.name in unknown:
            continue
        # The vision process expects the stamps that the camera reports.
        shown = arrays.ids, pixels[c], speed[c], covariance[c]
        if beyond >> c & 1:
            within = np.isfinite(pixels[c]).all(axis=-1)
            shown = arrays.ids[within], pixels[c][within], speed[c][within], covariance[c][within]
        found.append(Prior(camera.name, now_ns - estimate.offset_ns, *shown))
    return tuple(found)


SEEN_LATELY_NS = 1_000_000_000
LARGEST_WINDOW_PX = 20.0
"""Standard deviation [px] above which a search of the whole image is better."""


class Expected(NamedTuple):
    """Expected observations of the cameras: ``pixels`` (c, m, 2), their ``velocities`` (c, m, 2) and ``covariances``
    (c, m, 2, 2).
    """

    pixels: FloatArray
    velocities: FloatArray
    covariances: FloatArray


@kernel
def expect_sights(
    block: Record, room: Record, predicted: FloatArray, jacobian: FloatArray, moving: int, expected: Expected
) -> int:
    """Write the expected observations of all cameras to ``expected``, distorted by their lenses: ``predicted`` (c, m,
    2) pixels with their ``jacobian`` (c, m, 2, n), plus the innovations of recently seen markers. Returns a bit mask of
    the cameras with markers outside the invertible range of their lenses (beyond the fold); the pixels of such markers
    are not finite.

    Cameras whose bits are set in ``moving`` have no recent observations.
    """
    memory, work = block[0], room[0]
    n, m, lens_size = memory.joints, memory.markers, work.lens_size
    beyond = 0
    for c in range(memory.cameras):
        pixels, speed, covariance = expected.pixels[c], expected.velocities[c], expected.covariances[c]
        for i in range(m):
            at = m * c + i
            fresh = work.now_ns - memory.seen_ns[at] <= SEEN_LATELY_NS and memory.seen_ns[at] > 0
            fresh = fresh and moving & (1 << c) == 0
            fastest = 0.0
            for a in range(2):
                along = 0.0
                for j in range(n):
                    along += jacobian[c, i, a, j] * memory.velocities[j]
                speed[i, a] = along
                fastest = max(fastest, abs(along))
                pixels[i, a] = predicted[c, i, a] + (memory.innovation[2 * at + a] if fresh else 0.0)
            sigma = (1.0 if fresh else work.unseen_px[at]) + TIMING_SIGMA_S * fastest
            covariance[i, 0, 0] = covariance[i, 1, 1] = sigma * sigma
            covariance[i, 0, 1] = covariance[i, 1, 0] = 0.0
        lens = work.lenses[LENS_SIZE * c : LENS_SIZE * c + lens_size]
        if lens_size == 4 and lens[0] == 0.0:
            continue
        pixels[:], speed[:], covariance[:], within = distort_expected(lens, pixels, speed, covariance)
        if not within.all():
            beyond |= 1 << c
    return beyond


def _unseen_sigma(jacobian: FloatArray, arrays: ModelArrays) -> FloatArray:
    """Standard deviations (c, m) [px] of markers that were not seen recently, from their ``jacobian`` (c, m, 2, n)."""
    by_joints: FloatArray = (jacobian**2 * arrays.joint_variances).sum(axis=-1).max(axis=-1)
    return np.asarray(np.minimum(np.sqrt(FIRST_SEEN_SIGMA_PX**2 + by_joints), LARGEST_WINDOW_PX))


@kernel
def distort_expected(
    lens: FloatArray, pixels: FloatArray, velocities: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Distort ideal pixels: raw pixels (k, 2), velocities (k, 2), covariances (k, 2, 2), and which (k,) lie within the
    fold.
    """
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
