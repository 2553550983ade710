"""Stage 7 of a core step: ends a finished motion, then assembles status, reasons, detector priors and events, with
model health and the estimated time offset of each camera.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np

from stereoservo.core.context import COMPILING, SourceOutput, StepContext
from stereoservo.core.cycle import Event, Status, StepOutputs
from stereoservo.core.estimate import masked_ids
from stereoservo.core.goals.execute import finish
from stereoservo.core.goals.plan import planning_reason
from stereoservo.core.limit import SafetyResult
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitor_state import CameraTiming, ModelDiagnosis
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.diagnosis import diagnosis_reason
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.prediction import FIRST_SIGHT_SIGMA_PX, TIMING_SIGMA_S, Prediction, propagate_covariance
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CameraEstimate, Contact, CoreState
from stereoservo.kinematics.kernels import distort_pixel, distortion_jacobian
from stereoservo.messages.reasons import Level, Reason
from stereoservo.messages.status import CameraHealth, Health, Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
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
        command=state.command.copy() if state.lifecycle == Lifecycle.ACTIVE else None,
        status=_status(context, motion, limited),
        priors=_priors(context),
        events=tuple(events),
        driver_request=state.driver_request,  # type: ignore[arg-type]
    )


def _status(context: StepContext, motion: SourceOutput, limited: SafetyResult) -> Status:
    state, settings = context.state, context.settings
    reasons = _reasons(context, motion, limited)
    source = MOTION_SOURCES[type(state.source)]
    done, left_s = (None, None) if source.progress is None else source.progress(state.source, context)
    innovation_px, visible = {}, {}
    for camera, estimate in zip(settings.cameras, state.cameras, strict=True):
        innovation_px[camera.name] = estimate.rms_px
        visible[camera.name] = estimate.last_visible
    return Status(
        t_ns=context.now_ns,
        step=state.step,
        lifecycle=str(state.lifecycle),
        model=str(state.readiness),
        model_epoch=0 if state.model is None else state.model.epoch,
        source=source.name,
        goal=source.subject(state.source),
        law=source.law(state.source),
        level=_level(reasons),
        reasons=reasons,
        positions=context.q,
        velocities=state.velocities.copy(),
        command_raw=motion.velocity,
        command=state.command.copy(),
        error_px=motion.error_px,
        task_error=motion.task_error,
        innovation_px=innovation_px,
        visible=visible,
        progress=done,
        seconds_left=left_s,
        health=health_status(state, settings, "" if state.reanchoring is None else state.reanchoring.phase),
        **_load_status(state.contact, context.derived.load_limits),
    )


def _reasons(context: StepContext, motion: SourceOutput, limited: SafetyResult) -> tuple[Reason, ...]:
    """Why the arm does not do what its source wants, or may not soon."""
    state = context.state
    found = [*state.fault, *limited.reasons, *motion.reasons, *_refused_inputs(state)]
    if state.reanchoring is not None:
        found.extend(camera_relocalization.reasons(state))
    if any(state.mobile):
        found.extend(moving_camera.reasons(state, context.settings))
    if state.reanchoring is None:
        diagnosis = shown_diagnosis(state)
        reason = None if diagnosis.kind == "ok" else diagnosis_reason(diagnosis)
        if reason is not None:
            found.append(reason)
    explain = MOTION_SOURCES[type(state.source)].progress_reasons
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


def _refused_inputs(state: CoreState) -> list[Reason]:
    """Why samples are refused, but for what already stands as the reason of a stop."""
    latched = state.stop_reason if state.stopped else None
    found = []
    for refused in (state.refused_joints, *state.refused_frames):
        reason = refused.reason
        if reason is None or (
            latched is not None and (reason.code, reason.subject) == (latched.code, latched.subject)
        ):
            continue
        found.append(reason)
    return found


def _priors(context: StepContext) -> tuple[Prior, ...]:
    """What the detectors are to expect, in steps that send it."""
    state, arrays, prediction = context.state, context.derived.arrays, context.prediction
    if prediction is None or arrays is None or state.step % context.derived.prior_every:
        return ()
    cameras = state.cameras
    unknown: tuple[str, ...] = ()
    if state.reanchoring is not None or any(state.mobile):
        arrays, prediction, cameras, unknown = moving_camera.to_look_from(arrays, context)
    return priors(arrays, context.settings, prediction, cameras, state.velocities, context.now_ns, unknown)


def _load_status(contact: Contact, limits: tuple[FloatArray, FloatArray] | None) -> dict[str, Any]:
    """Fields of the status."""
    effort_limits, following_limits = (None, None) if limits is None else limits
    return {
        "efforts": contact.efforts,
        "following_errors": contact.following_errors,
        "effort_limits": effort_limits,
        "following_limits": following_limits,
    }


def _level(reasons: tuple[Reason, ...]) -> str:
    """The worst level of the reasons; information is none."""
    worst = max([LEVELS.index(reason.level) for reason in reasons], default=0)
    return "ok" if worst == 0 else LEVELS[worst]


def shown_diagnosis(state: CoreState) -> ModelDiagnosis:
    """The verdict as it is shown: a marker that is left out remains one that has slipped."""
    verdict, masked = state.watching.verdict, masked_ids(state)
    if verdict.kind != "ok" or not masked:
        return verdict
    listed = tuple(str(marker) for marker in masked)
    text = f"marker {', '.join(listed)} has slipped and is not used; fix it where it was, or calibrate"
    return ModelDiagnosis("marker_slipped", listed, text=text)


def health_status(state: CoreState, settings: CoreSettings, reanchoring: str) -> Health:
    """What the status says of the model's health."""
    if state.model is None or state.readiness == ModelReadiness.NONE:
        return Health()
    watching, verdict = state.watching, shown_diagnosis(state)
    ids = (*state.model.marker_ids, *state.model.scene_ids)
    return Health(
        verdict=verdict.kind,
        subjects=verdict.subjects,
        size=verdict.size,
        deviation=verdict.deviation,
        unit=verdict.unit,
        text=verdict.text,
        cameras={
            camera.name: CameraHealth(
                sighting.chi2,
                sighting.rms_px,
                ids[sighting.worst] if sighting.worst >= 0 else -1,
                sighting.worst_px,
                "" if moves is None else moves.place,
                advice(sighting.timing),
            )
            for camera, sighting, moves in zip(
                settings.cameras, watching.sightings, state.mobile, strict=True
            )
        },
        masked=masked_ids(state),
        reanchoring=reanchoring,
    )


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
    arrays: ModelArrays, settings: CoreSettings, prediction: Prediction, cameras: list[CameraEstimate],
    velocities: FloatArray, now_ns: int, unknown: tuple[str, ...] = (),
) -> tuple[Prior, ...]:  # fmt: skip
    """One prior a camera for the detectors' windows, raw; covariance from model and motion, never fed back.

    None for cameras of whose place nothing is known: their detectors look in the whole image.
    """
    ids: IntArray = np.array(arrays.marker_ids, dtype=np.int64)
    found = []
    for camera, estimate in enumerate(cameras):
        if settings.cameras[camera].name in unknown:
            continue
        jacobian = prediction.jacobian[camera]
        pixels, speed, covariance = expected_sights(
            prediction.pixels[camera], jacobian, velocities, estimate.innovation, now_ns - estimate.seen_ns,
            estimate.seen_ns, _unseen_sigma(jacobian, arrays),
        )  # fmt: skip
        # The vision process asks for the stamps that the camera tells.
        stamp_ns = now_ns - estimate.offset_ns
        prior = Prior(settings.cameras[camera].name, stamp_ns, ids, pixels, speed, covariance)
        found.append(_raw_prior(prior, arrays.lenses[camera]))
    return tuple(found)


@kernel
def expected_sights(
    predicted: FloatArray, jacobian: FloatArray, velocities: FloatArray, innovation: FloatArray,
    age_ns: IntArray, seen_ns: IntArray, unseen_px: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Pixels (m, 2), their velocities (m, 2) and covariances (m, 2, 2) that a camera is expected to have.

    ``predicted`` (m, 2) with its ``jacobian`` (m, 2, n), plus the ``innovation`` (m, 2) of markers seen of late, at
    ``seen_ns`` (m,), ``age_ns`` (m,) ago; ``unseen_px`` (m,): deviation of the others.
    """
    m, n = jacobian.shape[0], jacobian.shape[2]
    pixels, speed, covariance = np.empty((m, 2)), np.empty((m, 2)), np.zeros((m, 2, 2))
    for i in range(m):
        fresh = age_ns[i] <= SEEN_LATELY_NS and seen_ns[i] > 0
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
    return pixels, speed, covariance


SEEN_LATELY_NS = 1_000_000_000
LARGEST_WINDOW_PX = 20.0
"""Deviation beyond which a detector does better to look in the whole image."""


def _unseen_sigma(jacobian: FloatArray, arrays: ModelArrays) -> FloatArray:
    """Deviations (m,) [px] of markers that were not seen of late, by their ``jacobian`` (m, 2, n)."""
    if arrays.joint_accuracy is None:
        return np.full(len(jacobian), FIRST_SIGHT_SIGMA_PX)
    by_joints: FloatArray = (jacobian**2 * arrays.joint_variances).sum(axis=-1).max(axis=-1)
    return np.asarray(np.minimum(np.sqrt(FIRST_SIGHT_SIGMA_PX**2 + by_joints), LARGEST_WINDOW_PX))


def _raw_prior(prior: Prior, lens: FloatArray) -> Prior:
    """A prior as the camera's lens shows it; markers beyond its fold are left out."""
    if len(lens) == 4 and lens[0] == 0.0:
        return prior
    pixels, velocities, covariances, seen = distort_expected(
        lens, prior.pixels, prior.velocities, prior.covariances
    )
    return msgspec.structs.replace(
        prior,
        ids=prior.ids[seen],
        pixels=pixels[seen],
        velocities=velocities[seen],
        covariances=covariances[seen],
    )


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
