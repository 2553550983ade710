"""Stage 3 of a core step: answers requests; detects collision, following error and a wrong model; stops the arm or
ends its goal.

Each monitor of `MONITORS` is called with the context, in the order of the table, and gives its findings, on which the
stage acts at once: what one monitor stops, the next ones see stopped. To add one: a function, and a line in the table.

Requests are answered here, after the stop and before all other monitors: hold, resume, enable, teach and jog change
what is monitored in this very step, and a goal that is accepted in a step in which something is found ends in that step
with an event of its own.

The detection that runs in every step is in this module: contact, joints that do not follow, and whether innovations,
unfiltered, still look like noise. A round is one frame of every camera that delivers. Its chi-square, with the
covariances of detector, timing and model, is cheap; only where it is improbable does `monitors.fault_isolation` ask
which single change explains it: a moved camera, cameras moved as one, a slipped marker, a drifted joint zero. A
diagnosis needs two rounds of the last three.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from stereoservo.core.context import Finding, StepContext
from stereoservo.core.estimate import fitted_readiness
from stereoservo.core.goals.accept import answer_all, refuse_waiting
from stereoservo.core.goals.execute import end_queue, end_source
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitor_state import (
    LATE_S,
    MOVED,
    STALE_PERIODS,
    CameraMonitor,
    ModelDiagnosis,
    ModelMonitor,
)
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.collision import learn_loads, stated_thresholds, worst_contact
from stereoservo.core.monitors.diagnosis import (
    camera_moved_findings,
    emit_diagnosis,
    mask_marker,
    unmask_returned,
)
from stereoservo.core.monitors.fault_isolation import (
    bench_now,
    diagnosed_beside_joint_errors,
)
from stereoservo.core.monitors.following import (
    LAG_S,
    MEMORY_S,
    SILENCE_S,
    not_following,
    of_kinds,
    silent,
)
from stereoservo.core.move import MOTION_SOURCES, account_travel, measure_delays
from stereoservo.core.prediction import (
    MODEL_SIGMA_PX,
    SUSPECT_FRAMES,
    TRUSTED_FRAMES,
    camera_chi2,
    gate_threshold,
    improbable,
    used_rows,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.sources.teaching import teach_step
from stereoservo.core.state import CalibrationMotion, CoreState
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import JointState

Findings = Iterable[Finding]


class Monitor(NamedTuple):
    """A monitor: ``watch`` accounts for one step and gives what it has found."""

    name: str
    watch: Callable[[StepContext], Findings]


def monitor(context: StepContext) -> tuple[Finding, ...]:
    """What the monitors have found in this step, all of it acted on."""
    found: list[Finding] = []
    for entry in MONITORS:
        for finding in entry.watch(context):
            _act(finding, context)
            found.append(finding)
    return tuple(found)


def _act(finding: Finding, context: StepContext) -> None:
    """Stop the arm, latch the fault, or end the active goal."""
    state, reason = context.state, finding.reason
    end_source(context, "goal_aborted", (reason,), finding.ended)
    if finding.effect == "abort":
        return
    end_queue(context, (reason,), finding.ended)
    if finding.effect == "fault":
        state.fault = [reason]
        state.lifecycle = Lifecycle.FAULT
        state.driver_request = "deactivate"
        context.emit("fault", message=finding.message, reasons=(reason,))
        return
    refuse_waiting((reason,), context)
    state.stopped = True
    state.stop_reason = reason if finding.latched else None
    context.emit("stopped", message=finding.message, reasons=(reason,))


# -- monitors -----------------------------------------------------------------------------------------------


def _monitor_stop(context: StepContext) -> Findings:
    """Somebody has raised the stop."""
    if not context.inputs.stop:
        return ()
    reason = Reason("STOPPED", "hold", hint="resume, then send the goal again")
    return (Finding("stop", reason, "stopped", "stop: the arm brakes and holds", latched=False),)


def _answer_requests(context: StepContext) -> Findings:
    """Requests of clients; none is a finding."""
    if context.inputs.requests:
        answer_all(context.inputs.requests, context)
    return ()


def _monitor_inputs(context: StepContext) -> Findings:
    """Inputs that cannot be right, or a loop that stood still, stop an arm that may move."""
    stops = context.ingested.stops
    if not stops or context.state.lifecycle != Lifecycle.ACTIVE or context.state.stopped:
        return ()
    reason = stops[0]
    return (Finding("stop", reason, reason.hint, f"stop: {reason.hint}"),)


MEAN_S = 0.25
"""Time constant of the moving mean in motion: a full brake ramp is done in it, gravity hardly changes."""
REST_S = 0.05
"""And at rest, where brakes open and people lean on the arm: nothing is watched."""
LEAVE_S = 1.0
"""Of motion after a contact, in which what it brought may go again: a retreat is no contact."""
MOVING = 1e-3  # [rad/s or m/s] of commanded velocity
GAP_S = 0.5  # without a sample for so long, means are of another time


def detect_collision(
    state: CoreState,
    settings: CoreSettings,
    limits: tuple[FloatArray, FloatArray] | None,
    sample: JointState | None,
) -> Reason | None:
    """Account for one step; the reason where a joint (worst first) is in contact.

    ``state.command`` is still that of the last step. ``limits``: thresholds (n,), (n,) of efforts and following errors.
    """
    block = state.block
    if sample is None or sample.t_ns <= block.loads_ns:
        return None
    elapsed_s = (sample.t_ns - block.loads_ns) * 1e-9 if block.loads_ns else np.inf
    block.loads_ns = sample.t_ns
    block.tells_efforts, block.tells_following = (
        sample.efforts is not None,
        sample.following_errors is not None,
    )
    if sample.efforts is not None:
        block.efforts[:] = sample.efforts
    if sample.following_errors is not None:
        block.following_errors[:] = sample.following_errors
    efforts = np.array(block.mean_efforts if sample.efforts is None else sample.efforts, np.float64)
    following = np.zeros(efforts.shape)
    if sample.following_errors is not None:
        following[:] = sample.following_errors
    forgets = elapsed_s > GAP_S or state.lifecycle != Lifecycle.ACTIVE
    if forgets:
        block.leave_s = 0.0
    moving = not (forgets or state.stopped) and bool(_moves(state.command))
    if moving:
        block.leave_s = max(0.0, block.leave_s - elapsed_s)
    learning = isinstance(state.source, CalibrationMotion)
    thresholds = (stated_thresholds(settings) if moving else None) if learning else limits
    if thresholds is None:
        unlimited = _unlimited(efforts.size)
        thresholds = unlimited, unlimited
    beyond = _account_loads(
        efforts, following, block.mean_efforts, block.effort_excess, block.following_excess, block.contact_low,
        block.contact_high, elapsed_s, forgets, moving, block.leave_s > 0.0, *thresholds,
    )  # fmt: skip
    if not moving:
        return None
    if learning:
        learn_loads(state.source.id, state, np.abs(state.command), efforts, following)  # type: ignore[union-attr]
    if limits is None or not beyond:
        return None
    reason = worst_contact(block, settings, *thresholds, learning)
    if reason is not None:
        block.contact_low[:] = np.minimum(block.mean_efforts, efforts), np.minimum(following, 0.0)
        block.contact_high[:] = np.maximum(block.mean_efforts, efforts), np.maximum(following, 0.0)
        block.leave_s = LEAVE_S
        block.effort_excess[:], block.following_excess[:] = 0.0, 0.0
    return reason


@lru_cache(maxsize=8)
def _unlimited(n: int) -> FloatArray:
    """Thresholds (n,) that nothing reaches; not to be written to."""
    return np.full(n, np.inf)


@kernel
def _moves(command: FloatArray) -> bool:
    moving = False
    for j in range(command.size):
        moving = moving or abs(command[j]) > MOVING
    return moving


@kernel
def _account_loads(
    efforts: FloatArray, following: FloatArray, mean: FloatArray, effort_excess: FloatArray,
    following_excess: FloatArray, low: FloatArray, high: FloatArray, elapsed_s: float, forgets: bool, moving: bool,
    leaving: bool, effort_limits: FloatArray, following_limits: FloatArray,
) -> bool:  # fmt: skip
    """Take a sample's ``efforts`` and ``following`` errors (n,) into the arrays of the block; whether all samples of
    a window are beyond a limit on one side, or a limit is none.

    Readings that are no numbers become what is expected. The mean begins anew where it ``forgets`` (the drives were
    off, or nothing was heard for long); at rest what comes while the arm is ``leaving`` a contact belongs to it. In
    motion a reading is compared with the mean and zero, or with anything that a contact brought of late.
    """
    beyond = False
    for j in range(efforts.size):
        if not math.isfinite(efforts[j]):
            efforts[j] = mean[j]
        if not math.isfinite(following[j]):
            following[j] = 0.0
        if moving:
            excess, lag = efforts[j] - mean[j], following[j]
            if leaving:
                excess = efforts[j] - min(max(efforts[j], min(mean[j], low[0, j])), max(mean[j], high[0, j]))
                lag -= min(max(lag, min(low[1, j], 0.0)), max(high[1, j], 0.0))
            if not abs(excess) > effort_limits[j]:  # a contact is no new mean
                mean[j] += elapsed_s / (elapsed_s + MEAN_S) * (efforts[j] - mean[j])
            lasting = _push(effort_excess[:, j], excess) / effort_limits[j]
            lasting_lag = _push(following_excess[:, j], lag) / following_limits[j]
            beyond = beyond or not (lasting <= 1.0 and lasting_lag <= 1.0)
            continue
        if not forgets and leaving:
            low[0, j], low[1, j] = min(low[0, j], efforts[j]), min(low[1, j], following[j])
            high[0, j], high[1, j] = max(high[0, j], efforts[j]), max(high[1, j], following[j])
        effort_excess[:, j] = 0.0
        following_excess[:, j] = 0.0
        mean[j] = (
            efforts[j] if forgets else mean[j] + elapsed_s / (elapsed_s + REST_S) * (efforts[j] - mean[j])
        )
    return beyond


@kernel
def _push(window: FloatArray, newest: float) -> float:
    """Append to a window (samples,), the oldest one going; how far all of it is beyond zero on one side."""
    least, most = newest, newest
    for k in range(window.size - 1):
        window[k] = window[k + 1]
        least, most = min(least, window[k]), max(most, window[k])
    window[window.size - 1] = newest
    return max(least, -most, 0.0)


def detect_following_error(
    state: CoreState, settings: CoreSettings, q: FloatArray, dt_s: float
) -> Reason | None:
    """Account for ``dt_s`` since the last step; the reason where a joint (worst first) does not follow.

    ``state.command`` is still that of the last step. A joint's missing travel is its commanded minus its measured one,
    forgotten over ``MEMORY_S``; it may reach ``LAG_S`` at full speed, beside what its drive's delay explains. What is
    sent to a joint whose reading does not change at all is not forgotten, so that a slow command to a stuck encoder
    ends, too. Without a new joint sample nothing is concluded: stale samples are the safety stage's affair.
    """
    block, delays = state.block, state.delays
    if not block.silence_known:
        block.silence_known = 1
        block.silent_from[:], block.silent_travel[:], block.silent_s[:] = q, 0.0, 0.0
    play, answers, friction = of_kinds(settings.joint_kinds, settings.resolution)
    measure_delays(state.command, q, answers, dt_s, delays.sent, delays.onset, delays.samples, delays.delay_s)
    last = block.last_positions if block.followed else q
    if not block.followed:
        delays.missing[:] = 0.0
        delays.accounted[:] = delays.sent
    told = block.last_joints_ns != block.last_followed_ns
    account_travel(
        state.command, q - last, told, max(0.0, 1.0 - dt_s / MEMORY_S), dt_s, 1.0 / settings.rate_hz, block.delay_steps,
        answers,
        (delays.delay_s, delays.sent, delays.past, delays.velocity, delays.under_way, delays.accounted, delays.missing),
        delays.samples, block.untold_travel, block.missing_travel,
    )  # fmt: skip
    block.delay_steps += 1
    account_silence(
        q, delays.velocity, answers, friction, dt_s, block.silent_from, block.silent_travel, block.silent_s
    )
    if not told:
        return None
    block.last_followed_ns, block.followed = block.last_joints_ns, 1
    block.last_positions[:] = q
    allowed = LAG_S * settings.limits.velocity_max
    joint, missing = worst_follower(allowed, block.missing_travel, delays.missing)
    if joint >= 0:
        block.missing_travel[:] = 0.0
        delays.missing[:] = 0.0
        return not_following(joint, missing, float(allowed[joint]), float(delays.delay_s[joint]), settings)
    share = np.abs(block.silent_travel) / play * (block.silent_s > SILENCE_S)
    joint = int(share.argmax())
    if share[joint] <= 1.0:
        return None
    block.silence_known = 0
    return silent(joint, float(block.silent_travel[joint]), float(block.silent_s[joint]), settings)


@kernel
def worst_follower(allowed: FloatArray, now: FloatArray, late: FloatArray) -> tuple[int, float]:
    """The joint that lacks most of its travel, over what is ``allowed`` (n,), and how much, with its sign; -1: none.

    What it was sent as of ``now`` and as of its delay (``late``, (n,) each) bounds where it should be.
    """
    worst, most = -1, 1.0
    missing = 0.0
    for j in range(allowed.shape[0]):
        beyond = min(abs(now[j]), abs(late[j])) if now[j] * late[j] > 0.0 else 0.0
        if beyond > most * allowed[j]:
            worst, most, missing = j, beyond / allowed[j], math.copysign(beyond, now[j])
    return worst, missing


@kernel
def account_silence(
    q: FloatArray, velocity: FloatArray, answers: FloatArray, friction: FloatArray, dt_s: float,
    silent_from: FloatArray, silent_travel: FloatArray, silent_s: FloatArray,
) -> None:  # fmt: skip
    """Add up what each joint was sent (``velocity`` (n,), as it arrives), and for how long, since its reading changed.

    ``friction`` (n,) may hold the rest back.
    """
    for j in range(q.shape[0]):
        if abs(q[j] - silent_from[j]) > answers[j]:
            silent_from[j], silent_travel[j], silent_s[j] = q[j], 0.0, 0.0
            continue
        felt = velocity[j] - min(max(velocity[j], -friction[j]), friction[j])
        silent_travel[j] += felt * dt_s
        if felt != 0.0:
            silent_s[j] += dt_s


def monitor_collision(context: StepContext) -> tuple[Finding, ...]:
    """The arm has met something: it stops with its drives on, as if a person had stopped it."""
    reason = detect_collision(
        context.state, context.settings, context.derived.load_limits, context.ingested.joints
    )
    if reason is None:
        return ()
    return (Finding("stop", reason, reason.hint, f"contact: {reason.hint}"),)


def monitor_following(context: StepContext) -> tuple[Finding, ...]:
    """A joint that does not go where it is sent: its encoder, brake or drive is at fault, and so is the cell."""
    state = context.state
    if not context.settings.watch_following or state.block.history_count == 0:
        return ()
    reason = detect_following_error(state, context.settings, context.q, context.ingested.elapsed_s)
    if state.lifecycle != Lifecycle.ACTIVE:
        state.block.silence_known = 0  # what was sent before is no matter of what is sent next
        return ()  # an arm that is off may be moved by hand
    if reason is None:
        return ()
    return (Finding("fault", reason, reason.hint, reason.hint),)


def _monitor_teaching(context: StepContext) -> Findings:
    """A goal that is being taught, which motion ends."""
    if context.state.teaching is not None:
        teach_step(context)
    return ()


def _monitor_innovations(context: StepContext) -> Iterator[Finding]:
    """What explains the images, where that has changed: an event, and what follows from it."""
    state = context.state
    run = state.reanchoring
    if run is not None and run.phase != "verify":
        if run.phase == "collect":
            finish_round(context)  # for `camera_relocalization`: have they moved at all?
        return  # at rest, what stands is watched by `camera_relocalization`
    verdict = finish_round(context)
    if any(state.mobile) and moving_camera.takes(context):
        return
    if state.reanchoring is None and state.watching.verdict.kind in (*MOVED, "cameras_or_arm"):
        yield from camera_moved_findings(state.watching.verdict, context, fresh=verdict is not None)
    if verdict is None or (state.reanchoring is not None and state.reanchoring.phase == "verify"):
        return
    emit_diagnosis(verdict, context)
    if verdict.kind == "joint_zero":
        for estimate in state.cameras:  # images decide where the arm goes: they are believed from here on
            estimate.seen_ns[:] = 0
    if verdict.kind == "marker_slipped" and mask_marker(verdict, context):
        subject = ", ".join(verdict.subjects)
        context.emit("warning", message=f"marker {subject} is not used any more", name=subject)


AGREE, OF = 2, 3
"""Rounds of the last ones that must say the same."""
LATEST_S = 0.15
"""By which at most, where nothing but noise is left then."""
LATEST_MODEL_PX = 0.1
"""What the model may be off by besides, at the latest."""


def finish_round(context: StepContext) -> ModelDiagnosis | None:
    """Finish a round where one is complete; the new verdict where it has changed."""
    watching, arrays = context.state.watching, context.arrays
    if arrays is None or not (watching.due or all(not s.looked for s in watching.sightings)):
        return None
    if context.state.lifecycle in (Lifecycle.FAULT, Lifecycle.UNCONFIGURED):
        return None  # joints that a faulty drive tells are no measure of cameras
    watching.due = False
    known = []
    for c, (camera, sighting) in enumerate(zip(context.settings.cameras, watching.sightings, strict=True)):
        age_s = (context.now_ns - sighting.t_ns) * 1e-9
        recent = not sighting.looked or age_s * camera.rate_hz <= STALE_PERIODS
        mobile = context.state.mobile[c]
        if recent and sighting.t_ns > 0 and not (mobile is not None and mobile.moving):
            known.append(c)
        sighting.looked = True
    if not known:
        return None
    watching.rounds += 1
    proven = context.state.reanchoring is not None
    watching.last = [
        *watching.last[1 - OF :],
        _judged(watching, known, arrays, context.settings, proven=proven),
    ]
    if watching.masked.any():
        unmask_returned(watching, known, context)
    return _changed(watching)


def _judged(
    watching: ModelMonitor, known: list[int], arrays: ModelArrays, settings: CoreSettings, *, proven: bool
) -> ModelDiagnosis:
    """What one round says, of the cameras ``known``. ``proven``: that a camera has moved."""
    suspicious = False
    for c in known:
        sighting = watching.sightings[c]
        used = used_rows(watching, sighting)
        likely = _likely(sighting.innovation, sighting.spread, used, settings)
        suspicious |= not (likely or _late(sighting, used, settings))
    if not suspicious:
        return ModelDiagnosis()
    return diagnosed_beside_joint_errors(bench_now(watching, known, arrays, settings), proven=proven)


def _likely(
    innovation: FloatArray, spread: FloatArray, used: FloatArray, settings: CoreSettings,
    model_px: float = MODEL_SIGMA_PX,
) -> bool:  # fmt: skip
    """Whether innovations (k, 2) look like noise, all together and each of them."""
    chi2, _, _, largest, count = camera_chi2(innovation, spread, used, model_px)
    return chi2 <= improbable(2.0 * count) and largest <= gate_threshold(settings.gate_sigma)


def _late(sighting: CameraMonitor, used: FloatArray, settings: CoreSettings) -> bool:
    """Whether a frame that was taken a little earlier or later than stated explains its innovations.

    Pictures are late where a computer is busy; a camera that was moved shows it at rest, too.
    """
    moved = sighting.velocity * used[:, None]
    square = float((moved * moved).sum())
    if square <= 0.0:
        return False
    late_s = float((moved * sighting.innovation).sum()) / square
    if abs(late_s) > LATEST_S:
        return False
    rest = sighting.innovation - late_s * sighting.velocity
    model_px = MODEL_SIGMA_PX if abs(late_s) <= LATE_S else LATEST_MODEL_PX
    return _likely(rest, sighting.spread, used, settings, model_px)


def _key(verdict: ModelDiagnosis) -> tuple[str, ...]:
    """What two rounds must agree in."""
    return (verdict.kind, *verdict.subjects)


def _changed(watching: ModelMonitor) -> ModelDiagnosis | None:
    """The verdict that two of the last three rounds agree in, where it is another than before."""
    keys = [_key(verdict) for verdict in watching.last]
    for verdict in reversed(watching.last):
        if keys.count(_key(verdict)) < (OF if verdict.kind == "ok" else AGREE):
            continue
        if _key(verdict) == _key(watching.verdict):
            watching.verdict = verdict
            return None
        watching.verdict = verdict
        return verdict
    return None


def _monitor_model(context: StepContext) -> Iterator[Finding]:
    """Images that contradict the model for many frames make it SUSPECT; ones that agree with it clear it."""
    state = context.state
    if state.reanchoring is not None:
        return
    if state.readiness == ModelReadiness.SUSPECT and state.model is not None:
        if min(estimate.agreeing_frames for estimate in state.cameras) >= TRUSTED_FRAMES:
            state.readiness = fitted_readiness(state.model)
            context.emit("model", message="the images agree with the model again", name=str(state.readiness))
        return
    if state.readiness not in (ModelReadiness.VALID, ModelReadiness.CANDIDATE):
        return
    for camera, estimate in zip(context.settings.cameras, state.cameras, strict=True):
        if estimate.rejected_frames < SUSPECT_FRAMES:
            continue
        state.readiness = ModelReadiness.SUSPECT
        reason = Reason(
            "MODEL_SUSPECT", "hold", camera.name, float(estimate.rejected_frames), float(SUSPECT_FRAMES), "frames",
            state.watching.verdict.text
            or f"camera {camera.name} contradicts the model: was it moved, has a marker slipped? Calibrate again",
        )  # fmt: skip
        context.emit("model", message=reason.hint, name=str(state.readiness), reasons=(reason,))
        if MOTION_SOURCES[type(state.source)].runs_law:
            yield Finding("abort", reason, reason.hint)
        return


def _monitor_relocalization(context: StepContext) -> Findings:
    """Cameras that are being found again; laws wait meanwhile."""
    if context.state.reanchoring is not None:
        camera_relocalization.step(context)
    return ()


MONITORS: tuple[Monitor, ...] = (
    Monitor("stop", _monitor_stop),
    Monitor("requests", _answer_requests),
    Monitor("inputs", _monitor_inputs),
    Monitor("collision", monitor_collision),
    Monitor("following error", monitor_following),
    Monitor("teaching", _monitor_teaching),
    Monitor("innovations", _monitor_innovations),
    Monitor("model", _monitor_model),
    Monitor("relocalization", _monitor_relocalization),
)
