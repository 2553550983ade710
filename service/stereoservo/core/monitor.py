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
from typing import NamedTuple

import numpy as np

from stereoservo.core.block import DELAY_SAMPLES
from stereoservo.core.camera_state import CameraMonitor
from stereoservo.core.context import Finding, StepContext
from stereoservo.core.estimate import fitted_readiness
from stereoservo.core.goals.accept import answer_all, refuse_waiting
from stereoservo.core.goals.execute import end_queue, end_source
from stereoservo.core.monitor_state import LATE_S, MOVED, STALE_PERIODS, ModelDiagnosis, ModelMonitor
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.collision import learn_loads, worst_contact
from stereoservo.core.monitors.diagnosis import (
    camera_moved_findings,
    emit_diagnosis,
    mask_marker,
    unmask_returned,
)
from stereoservo.core.monitors.fault_isolation import bench_now, diagnosed_beside_joint_errors
from stereoservo.core.monitors.following import (
    LAG_S,
    MEMORY_S,
    SILENCE_S,
    account_silence,
    not_following,
    silent,
    worst_follower,
)
from stereoservo.core.move import MOTION_SOURCES, account_travel, measure_delays
from stereoservo.core.prediction import (
    MODEL_SIGMA_PX,
    SUSPECT_FRAMES,
    TRUSTED_FRAMES,
    camera_chi2,
    gate_threshold,
    improbable,
    round_complete,
    rows_in_use,
    used_rows,
)
from stereoservo.core.settings import CoreSettings
from stereoservo.core.sources.teaching import teach_step
from stereoservo.core.state import CalibrationMotion, CoreState
from stereoservo.core.target.track import beside_target
from stereoservo.core.workspace import Workspace
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import JointState

Findings = Iterable[Finding]


class Monitor(NamedTuple):
    """A monitor: ``watch`` accounts for one step and gives what it has found. ``in_fast_path``: whether
    `core.fast_path` leaves each step in which it would find anything to the stages; where it is of one monitor not
    known to, every step goes by the stages.
    """

    name: str
    watch: Callable[[StepContext], Findings]
    in_fast_path: bool = False


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
    state: CoreState, settings: CoreSettings, room: Workspace, sample: JointState | None
) -> Reason | None:
    """Account for one step, with the sample's values in the ``room``; the reason where a joint (worst first) is in
    contact.

    The block's command is still that of the last step.
    """
    block = state.block
    if sample is None or sample.t_ns <= block.numbers.loads_ns:
        return None
    learning = isinstance(state.source, CalibrationMotion)
    moving, beyond = account_loads(
        block.record, room.record, sample.t_ns, sample.efforts is not None, sample.following_errors is not None,
        state.lifecycle == Lifecycle.ACTIVE, state.stopped, learning,
    )  # fmt: skip
    efforts, following = room.sample[2], room.sample[3]
    if learning and moving:
        learn_loads(state.source.id, state, np.abs(block.command), efforts, following)  # type: ignore[union-attr]
    if not (beyond and room.watches_loads):
        return None
    reason = worst_contact(block, settings, *(room.stated_limits if learning else room.limits), learning)
    if reason is not None:
        block.contact_low[:] = np.minimum(block.mean_efforts, efforts), np.minimum(following, 0.0)
        block.contact_high[:] = np.maximum(block.mean_efforts, efforts), np.maximum(following, 0.0)
        block.numbers.leave_s = LEAVE_S
        block.effort_excess[:], block.following_excess[:] = 0.0, 0.0
    return reason


@kernel
def account_loads(
    block: Record, room: Record, t_ns: int, tells_efforts: bool, tells_following: bool, active: bool, stopped: bool,
    learning: bool,
) -> tuple[bool, bool]:  # fmt: skip
    """Take the efforts and following errors of a sample at ``t_ns``, in the ``room``, into the ``block``; whether the
    arm moves and is watched, and whether a joint is beyond a limit then: see `_account_loads`.

    What a sample does not tell, or what is no number, becomes what is expected, in the ``room``, too.
    """
    memory, work = block[0], room[0]
    n, window = memory.joints, memory.window
    efforts, following = work.sample[2 * n : 3 * n], work.sample[3 * n : 4 * n]
    mean = memory.mean_efforts[:n]
    elapsed_s = (t_ns - memory.loads_ns) * 1e-9 if memory.loads_ns > 0 else math.inf
    memory.loads_ns, memory.tells_efforts, memory.tells_following = (
        t_ns,
        int(tells_efforts),
        int(tells_following),
    )
    for j in range(n):
        if tells_efforts:
            memory.efforts[j] = efforts[j]
        else:
            efforts[j] = mean[j]
        if tells_following:
            memory.following_errors[j] = following[j]
    forgets = elapsed_s > GAP_S or not active
    if forgets:
        memory.leave_s = 0.0
    moving = not (forgets or stopped) and _moves(memory.command[:n])
    if moving:
        memory.leave_s = max(0.0, memory.leave_s - elapsed_s)
    effort_limits, following_limits = work.effort_limits[:n], work.following_limits[:n]
    if learning:
        effort_limits, following_limits = work.stated_effort_limits[:n], work.stated_following_limits[:n]
    beyond = _account_loads(
        efforts, following, mean, memory.effort_excess[: window * n].reshape((window, n)),
        memory.following_excess[: window * n].reshape((window, n)), memory.contact_low[: 2 * n].reshape((2, n)),
        memory.contact_high[: 2 * n].reshape((2, n)), elapsed_s, forgets, moving, memory.leave_s > 0.0, effort_limits,
        following_limits,
    )  # fmt: skip
    return moving, beyond and moving


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


FOLLOWS, LACKS, SILENT = range(3)
"""What `account_following` has found."""


def detect_following_error(
    state: CoreState, settings: CoreSettings, room: Workspace, q: FloatArray, dt_s: float,
    sent: FloatArray | None = None,
) -> Reason | None:  # fmt: skip
    """Account for ``dt_s`` since the last step; the reason where a joint (worst first) does not follow.

    The block's command is still that of the last step; ``sent`` (n,), if any: what the driver made of it, which counts.
    A joint's missing travel is its commanded minus its measured one, forgotten over ``MEMORY_S``; it may reach
    ``LAG_S`` at full speed, beside what its drive's delay explains. What is sent to a joint whose reading stands still
    is not forgotten, so that a slow command to a stuck encoder ends, too. Without a new sample nothing is concluded.
    """
    block, numbers, commanded = state.block, room.numbers, state.block.command
    if sent is not None and sent.shape == q.shape and np.isfinite(sent).all():
        commanded, block.command[:] = commanded.copy(), sent
    found = account_following(block.record, room.record, q, dt_s)
    block.command[:] = commanded
    if found == FOLLOWS:
        return None
    joint = numbers.worst
    if found == LACKS:
        lag, delay_s = LAG_S * settings.limits.velocity_max, block.delay_s
        return not_following(joint, numbers.missing, float(lag[joint]), float(delay_s[joint]), settings)
    return silent(joint, float(block.silent_travel[joint]), float(block.silent_s[joint]), settings)


@kernel
def account_following(block: Record, room: Record, q: FloatArray, dt_s: float) -> int:
    """Account for ``dt_s`` of the last command with the joints at ``q`` (n,), in the ``block``; what was found, of
    which joint and how much is missing being in the ``room``.
    """
    memory, work = block[0], room[0]
    n, past = memory.joints, memory.past
    command, answers = memory.command[:n], work.answers[:n]
    last, delay_s, sent = memory.last_positions[:n], memory.delay_s[:n], memory.delay_sent[:n]
    samples = memory.delay_samples[: DELAY_SAMPLES * n].reshape((DELAY_SAMPLES, n))
    accounted, missing_late = memory.delay_accounted[:n], memory.delay_missing[:n]
    silent_from, silent_travel, silent_s = (
        memory.silent_from[:n],
        memory.silent_travel[:n],
        memory.silent_s[:n],
    )
    untold, missing, velocity = memory.untold_travel[:n], memory.missing_travel[:n], memory.delay_velocity[:n]
    if memory.silence_known == 0:
        silent_from[:], silent_travel[:], silent_s[:] = q, 0.0, 0.0
        memory.silence_known = 1
    onset = memory.delay_onset[: 7 * n].reshape((7, n))
    measure_delays(command, q, answers, dt_s, sent, onset, samples, delay_s)
    if memory.followed == 0:
        last[:], missing_late[:], accounted[:] = q, 0.0, sent
    told = memory.last_joints_ns != memory.last_followed_ns
    account_travel(
        command, q - last, told, max(0.0, 1.0 - dt_s / MEMORY_S), dt_s, work.period_s, memory.delay_steps, answers,
        (
            delay_s, sent, memory.delay_past[: past * n].reshape((past, n)), velocity, memory.delay_under_way[:n],
            accounted, missing_late,
        ),
        samples, untold, missing,
    )  # fmt: skip
    memory.delay_steps += 1
    account_silence(q, velocity, answers, work.friction[:n], dt_s, silent_from, silent_travel, silent_s)
    if not told:
        return FOLLOWS
    memory.last_followed_ns, memory.followed = memory.last_joints_ns, 1
    last[:] = q
    work.worst, work.missing = worst_follower(work.lag[:n], missing, missing_late)
    if work.worst >= 0:
        missing[:], missing_late[:] = 0.0, 0.0
        return LACKS
    most = 1.0
    for j in range(n):
        share = abs(silent_travel[j]) / work.play[j]
        if silent_s[j] > SILENCE_S and share > most:
            work.worst, most = j, share
    if most > 1.0:
        memory.silence_known = 0
        return SILENT
    return FOLLOWS


def monitor_collision(context: StepContext) -> tuple[Finding, ...]:
    """The arm has met something: it stops with its drives on, as if a person had stopped it."""
    reason = detect_collision(context.state, context.settings, context.derived.room, context.ingested.joints)
    if reason is None:
        return ()
    return (Finding("stop", reason, reason.hint, f"contact: {reason.hint}"),)


def monitor_following(context: StepContext) -> tuple[Finding, ...]:
    """A joint that does not go where it is sent: its encoder, brake or drive is at fault, and so is the cell."""
    state = context.state
    if not context.settings.watch_following or state.block.numbers.history_count == 0:
        return ()
    room, elapsed_s = context.derived.room, context.ingested.elapsed_s
    reason = detect_following_error(state, context.settings, room, context.q, elapsed_s, context.inputs.sent)
    if state.lifecycle != Lifecycle.ACTIVE:
        state.block.numbers.silence_known = 0  # what was sent before is no matter of what is sent next
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


NOISE = ModelDiagnosis()
"""Of a round that needs no explanation."""
QUIET = [NOISE] * OF
"""Verdicts of the last rounds, where none needed one."""


def finish_round(context: StepContext) -> ModelDiagnosis | None:
    """Finish a round where one is complete; the new verdict where it has changed."""
    state, arrays = context.state, context.arrays
    watching = state.watching
    if arrays is None:
        return None
    if not (watching.due or round_complete(state.block.record)):
        return None
    if state.lifecycle is Lifecycle.FAULT or state.lifecycle is Lifecycle.UNCONFIGURED:
        return None  # joints that a faulty drive tells are no measure of cameras
    watching.due = False
    moving = moving_camera.moving_bits(state) if any(state.mobile) else 0
    looked_at, odd, masked = judge_round(
        state.block.record, context.derived.room.record, context.now_ns, watching.masked, moving
    )
    if not looked_at:
        return None
    watching.rounds += 1
    if not odd and not masked and watching.last == QUIET and watching.verdict == NOISE:
        return None
    verdict = NOISE
    if odd and not _all_late(_cameras(odd), watching, context.settings):
        bench = bench_now(state, _cameras(looked_at), arrays, context.settings)
        found = diagnosed_beside_joint_errors(bench, proven=state.reanchoring is not None)
        verdict = beside_target(found, state)
    watching.last = [*watching.last[1 - OF :], verdict]
    if masked:
        unmask_returned(watching, _cameras(looked_at), context)
    return _changed(watching)


def _cameras(bits: int) -> list[int]:
    """Numbers of the cameras that ``bits`` stands for."""
    return [c for c in range(bits.bit_length()) if bits >> c & 1]


@kernel
def judge_round(
    block: Record, room: Record, now_ns: int, masked: FloatArray, moving: int
) -> tuple[int, int, bool]:
    """Look at the newest frame of each camera: those that are recent, and of them those whose innovations do not look
    like noise, all together and each of them; and whether any marker is ``masked`` (m,) > 0.

    Cameras are bits of a number, as are those that are ``moving``, which are left out.
    """
    memory, work = block[0], room[0]
    rows = memory.rows
    known = odd = 0
    for c in range(memory.cameras):
        frame, bit = memory.sightings[c], 1 << c
        age_s = (now_ns - frame.t_ns) * 1e-9
        recent = not frame.looked or age_s * work.camera_rates[c] <= STALE_PERIODS
        frame.looked = True
        if not recent or frame.t_ns <= 0 or moving & bit:
            continue
        known |= bit
        at, end = rows * c, rows * (c + 1)
        chi2, _, _, largest, count = camera_chi2(
            memory.frame_innovation[2 * at : 2 * end].reshape((rows, 2)),
            memory.frame_spread[4 * at : 4 * end].reshape((rows, 2, 2)),
            rows_in_use(memory.frame_seen[at:end], masked), MODEL_SIGMA_PX,
        )  # fmt: skip
        if not (chi2 <= work.noise_chi2[count] and largest <= work.gate):
            odd |= bit
    return known, odd, bool((masked > 0.0).any())


def _all_late(cameras: list[int], watching: ModelMonitor, settings: CoreSettings) -> bool:
    """Whether the newest frame of each of these ``cameras`` is `_late`."""
    frames = [watching.sightings[c] for c in cameras]
    return all(_late(frame, used_rows(watching, frame), settings) for frame in frames)


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
    chi2, _, _, largest, count = camera_chi2(rest, sighting.spread, used, model_px)
    return bool(chi2 <= improbable(2.0 * count) and largest <= gate_threshold(settings.gate_sigma))


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
    Monitor("stop", _monitor_stop, in_fast_path=True),
    Monitor("requests", _answer_requests, in_fast_path=True),
    Monitor("inputs", _monitor_inputs, in_fast_path=True),
    Monitor("collision", monitor_collision, in_fast_path=True),
    Monitor("following error", monitor_following, in_fast_path=True),
    Monitor("teaching", _monitor_teaching, in_fast_path=True),
    Monitor("innovations", _monitor_innovations, in_fast_path=True),
    Monitor("model", _monitor_model, in_fast_path=True),
    Monitor("relocalization", _monitor_relocalization, in_fast_path=True),
)
