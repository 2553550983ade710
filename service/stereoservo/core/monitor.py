"""Stage 3 of a core step: answers requests; detects collision, following error and a wrong model; stops the arm or ends
its goal.

The detection of every step is one kernel, `detect`, which writes its results into the workspace. If it detects
anything, or the state needs attention (`attends`), each monitor of `MONITORS` is called with the context, in the order
of the table, and returns its findings. The stage acts on each finding immediately, so later monitors see its effect. To
add a monitor: a function, and a line in the table.

Requests are answered here, after the stop and before all other monitors, because hold, resume, enable, teach and jog
change what is monitored in the same step. If a goal is accepted in a step with a finding that ends goals, it ends in
that step with an event of its own.

This module contains the detection that runs in every step: collision, following error, and whether the unfiltered
innovations still look like noise. A round is one frame of every camera that delivers. Its chi-square, with the
covariances of detector, timing and model, is cheap to compute. Only if it is improbable does `monitors.fault_isolation`
test which single change explains it: a displaced camera, all cameras displaced together, a slipped marker, a drifted
joint zero. A diagnosis needs two of the last three rounds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from stereoservo.core.camera_state import CameraMonitor
from stereoservo.core.context import Finding, StepContext, Workspace
from stereoservo.core.estimate import fitted_readiness
from stereoservo.core.goals.accept import answer_all, refuse_waiting
from stereoservo.core.goals.execute import end_queue, end_source
from stereoservo.core.ingest import ACCEPTED, VALUES
from stereoservo.core.monitor_state import LATE_S, MOVED, STALE_PERIODS, ModelDiagnosis, ModelMonitor
from stereoservo.core.monitors import camera_relocalization, moving_camera
from stereoservo.core.monitors.collision import learn_loads, worst_contact
from stereoservo.core.monitors.diagnosis import (
    camera_moved_findings,
    emit_diagnosis,
    mask_marker,
    unmask_returned,
)
from stereoservo.core.monitors.fault_isolation import (
    LinearisedProblem,
    diagnosed_beside_joint_errors,
    present_problem,
    without_joint_errors,
)
from stereoservo.core.monitors.following import (
    LAG_S,
    SILENCE_S,
    account_silence,
    account_travel,
    delays_of,
    measure_delays,
    not_following,
    silent,
    worst_follower,
)
from stereoservo.core.move import MOTION_SOURCES
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
from stereoservo.core.state import CoreState, Holding, TrialMotion
from stereoservo.core.target.track import beside_target
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel

Findings = Iterable[Finding]


class Monitor(NamedTuple):
    """A monitor: ``watch`` processes one step and returns its findings. ``attends`` returns whether it must be called
    in a step in which `detect` has detected nothing; by default a monitor is called in every step. ``attends`` is
    evaluated only after steps in which Python has changed the state: it must not depend on measured values.
    """

    name: str
    watch: Callable[[StepContext], Findings]
    attends: Callable[[CoreState], bool] = lambda state: True


def monitor(context: StepContext) -> tuple[Finding, ...]:
    """Call the monitors and act on their findings; returns all findings of this step."""
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
    """Stop the arm if the stop was raised."""
    if not context.inputs.stop:
        return ()
    reason = Reason("STOPPED", "hold", hint="resume, then send the goal again")
    return (Finding("stop", reason, "stopped", "stop: the arm brakes and holds", latched=False),)


def _answer_requests(context: StepContext) -> Findings:
    """Answer the clients' requests; returns no findings."""
    if context.inputs.requests:
        answer_all(context.inputs.requests, context)
    return ()


def _monitor_inputs(context: StepContext) -> Findings:
    """Stop an arm that may move if inputs are impossible or the loop was interrupted."""
    stops = context.ingested.stops
    if not stops or context.state.lifecycle != Lifecycle.ACTIVE or context.state.stopped:
        return ()
    reason = stops[0]
    return (Finding("stop", reason, reason.hint, f"stop: {reason.hint}"),)


MEAN_S = 0.25
"""Time constant of the moving mean in motion [s]: longer than a full brake ramp, short compared with changes of gravity
load.
"""
REST_S = 0.05
"""Time constant at rest [s], where brakes open and people may lean on the arm; nothing is monitored."""
LEAVE_S = 1.0
"""Duration of motion after a collision [s] in which the collision's loads may decrease again, so that a retreat is not
a new collision.
"""
MOVING = 1e-3  # [rad/s or m/s] of commanded velocity
GAP_S = 0.5  # without a sample for so long, the means are outdated


CONTACT, NOT_FOLLOWING, ROUND, CONTRADICTED = 2, 4, 8, 16
"""Bits of `detect`: a joint beyond a load limit; a joint that does not follow; a round of frames that needs an
explanation; a camera that contradicts the model.
"""


@kernel
def detect(block: Record, workspace: Record) -> int:
    """Stage 3, in every step: update loads, travel and frames; returns the detections as bits."""
    memory, work = block[0], workspace[0]
    halted = work.stopped != 0 or work.stop != 0 or (work.active != 0 and stops_arm(workspace))
    found = 0
    work.contact = work.contact_watched = work.looked_at = work.inconsistent = work.any_masked = 0
    if work.joints_found == ACCEPTED and work.joints_ns > memory.loads_ns:
        moving, beyond = account_loads(block, workspace, halted)
        work.contact_watched, work.contact = int(moving), int(beyond)
        if (beyond and work.watches_loads != 0) or (moving and work.learning != 0):
            found |= CONTACT
    work.following = FOLLOWS
    if work.watches_following != 0 and memory.history_count > 0:
        work.following = account_following(block, workspace)
        if work.active == 0:
            memory.silence_known = 0  # what was sent before does not apply to later commands
            work.following = FOLLOWS  # an arm whose drives are off may be moved by hand
    if work.following != FOLLOWS:
        return found | NOT_FOLLOWING
    if work.modelled == 0:
        return found
    if work.rounds_in_python == 0 and memory.history_count > 0 and work.faulty == 0 and round_is_due(block):
        looked_at, inconsistent, masked = judge_round(block, workspace, 0)
        work.looked_at, work.inconsistent, work.any_masked = looked_at, inconsistent, int(masked)
        if looked_at != 0 and (inconsistent != 0 or masked or work.quiet == 0):
            found |= ROUND
    for c in range(memory.cameras):
        if memory.estimates[c].rejected_frames >= SUSPECT_FRAMES:
            found |= CONTRADICTED
    return found


@kernel
def stops_arm(workspace: Record) -> bool:
    """Whether inputs rejected by `ingest` stop an arm that may move."""
    work = workspace[0]
    if work.gap != 0 or work.joints_found > ACCEPTED:
        return True
    stops = False
    for k in range(work.frames):
        wrong = work.arrived_found[k] == VALUES or work.arrived_ns[k] > work.now_ns
        stops = stops or (work.by_images != 0 and work.arrived_found[k] > ACCEPTED and wrong)
    return stops


@kernel
def round_is_due(block: Record) -> bool:
    """Whether the newest frames are due to be examined together; resets the due flag."""
    memory = block[0]
    if memory.round_due == 0 and not round_complete(block):
        return False
    memory.round_due = 0
    return True


def explain_contact(state: CoreState, settings: CoreSettings, workspace: Workspace) -> Reason | None:
    """The reason for the joint in collision (the worst one), from the result of `account_loads` in this step; None if
    there is no collision.
    """
    block, work = state.block, workspace.numbers
    learning = isinstance(state.source, TrialMotion)
    efforts, following = workspace.sample[2], workspace.sample[3]
    if learning and work.contact_watched:
        learn_loads(state.source.id, state, np.abs(block.command), efforts, following)  # type: ignore[union-attr]
    if not (work.contact and work.watches_loads):
        return None
    limits = workspace.stated_load_limits if learning else workspace.load_limits
    reason = worst_contact(block, settings, *limits, learning)
    if reason is not None:
        block.contact_low[:] = np.minimum(block.mean_efforts, efforts), np.minimum(following, 0.0)
        block.contact_high[:] = np.maximum(block.mean_efforts, efforts), np.maximum(following, 0.0)
        block.numbers.leave_s = LEAVE_S
        block.effort_excess[:], block.following_excess[:] = 0.0, 0.0
    return reason


class Loads(NamedTuple):
    """Loads of the joints, (n,) each: ``efforts`` and ``following`` errors of a sample, or their limits."""

    efforts: FloatArray
    following: FloatArray


class LoadHistory(NamedTuple):
    """Load history in the block: the moving ``mean`` (n,) of efforts; the excess of recent samples over the expected
    value, ``effort`` and ``following`` (samples, n); the range of loads during the last collision, ``low`` and ``high``
    (2, n).
    """

    mean: FloatArray
    effort: FloatArray
    following: FloatArray
    low: FloatArray
    high: FloatArray


class Situation(NamedTuple):
    """Conditions of a sample: the time since the previous one, whether the history is reset, whether the arm moves and
    is monitored, and whether it is leaving a collision.
    """

    elapsed_s: float
    forgets: bool
    moving: bool
    leaving: bool


@kernel
def account_loads(block: Record, workspace: Record, halted: bool) -> tuple[bool, bool]:
    """Update the load history of the ``block`` by the sample in the ``workspace``. Returns whether the arm moves
    (is not ``halted``) and is monitored, and whether a joint is beyond a limit then: see `_account_loads`.

    Values that are missing or not finite are replaced by the expected ones, in the workspace, too. The block's command
    is still that of the last step.
    """
    memory, work = block[0], workspace[0]
    n, window = memory.joints, memory.window
    efforts, following = work.sample[2 * n : 3 * n], work.sample[3 * n : 4 * n]
    mean = memory.mean_efforts[:n]
    elapsed_s = (work.joints_ns - memory.loads_ns) * 1e-9 if memory.loads_ns > 0 else math.inf
    memory.loads_ns = work.joints_ns
    memory.tells_efforts, memory.tells_following = work.tells_efforts, work.tells_following
    for j in range(n):
        if work.tells_efforts != 0:
            memory.efforts[j] = efforts[j]
        else:
            efforts[j] = mean[j]
        if work.tells_following != 0:
            memory.following_errors[j] = following[j]
    forgets = elapsed_s > GAP_S or work.active == 0
    if forgets:
        memory.leave_s = 0.0
    moving = not (forgets or halted) and _moves(memory.command[:n])
    if moving:
        memory.leave_s = max(0.0, memory.leave_s - elapsed_s)
    limits = Loads(work.effort_limits[:n], work.following_limits[:n])
    if work.learning != 0:
        limits = Loads(work.stated_effort_limits[:n], work.stated_following_limits[:n])
    history = LoadHistory(
        mean,
        memory.effort_excess[: window * n].reshape((window, n)),
        memory.following_excess[: window * n].reshape((window, n)),
        memory.contact_low[: 2 * n].reshape((2, n)),
        memory.contact_high[: 2 * n].reshape((2, n)),
    )
    situation = Situation(elapsed_s, forgets, moving, memory.leave_s > 0.0)
    beyond = _account_loads(Loads(efforts, following), history, situation, limits)
    return moving, beyond and moving


@kernel
def _moves(command: FloatArray) -> bool:
    moving = False
    for j in range(command.size):
        moving = moving or abs(command[j]) > MOVING
    return moving


@kernel
def _account_loads(sample: Loads, history: LoadHistory, situation: Situation, limits: Loads) -> bool:
    """Update the ``history`` by a ``sample``; returns whether all samples of a window are beyond a limit on the same
    side, or a limit is not a number.

    Readings that are not finite are replaced by the expected ones. The mean restarts after a reset (the drives were
    off, or no sample came for long). At rest while the arm is leaving a collision, readings extend the collision's
    range. In motion a reading is compared with the mean and zero, or with the range of a recent collision.
    """
    efforts, following = sample
    mean, effort_excess, following_excess, low, high = history
    elapsed_s, forgets, moving, leaving = situation
    effort_limits, following_limits = limits
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
            if not abs(excess) > effort_limits[j]:  # a collision does not change the mean
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
        mean[j] = efforts[j] if forgets else mean[j] + elapsed_s / (elapsed_s + REST_S) * (efforts[j] - mean[j])
    return beyond


@kernel
def _push(window: FloatArray, newest: float) -> float:
    """Append to a window (samples,) and drop its oldest value; returns how far all of it exceeds zero on one side."""
    least, most = newest, newest
    for k in range(window.size - 1):
        window[k] = window[k + 1]
        least, most = min(least, window[k]), max(most, window[k])
    window[window.size - 1] = newest
    return max(least, -most, 0.0)


FOLLOWS, LACKS, SILENT = range(3)
"""Results of `account_following`."""


def explain_following(state: CoreState, settings: CoreSettings, workspace: Workspace) -> Reason | None:
    """The reason for the joint that does not follow (the worst one), from the result of `account_following` in this
    step; None if all joints follow.
    """
    block, work = state.block, workspace.numbers
    if work.following == FOLLOWS:
        return None
    joint = work.worst
    if work.following == LACKS:
        lag, delay_s = LAG_S * settings.limits.velocity_max, block.delay_s
        return not_following(joint, work.missing, float(lag[joint]), float(delay_s[joint]), settings)
    return silent(joint, float(block.silent_travel[joint]), float(block.silent_s[joint]), settings)


@kernel
def account_following(block: Record, workspace: Record) -> int:
    """Compare the travel since the last step with the last command, or with the velocity that the driver has sent in
    its place. Returns `FOLLOWS`, `LACKS` or `SILENT`; the joint and its missing travel are written to the workspace
    ``workspace``.

    A joint's missing travel is its commanded minus its measured travel, with exponential forgetting over ``MEMORY_S``.
    Its limit is the travel in ``LAG_S`` at full speed, plus the travel explained by the drive's delay. Travel commanded
    to a joint whose reading does not change is not forgotten, so a slow command to a stuck encoder is detected, too.
    Without a new sample there is no decision.
    """
    memory, work = block[0], workspace[0]
    n, dt_s = memory.joints, work.elapsed_s
    q, command, answers = work.q[:n], memory.command[:n], work.answers[:n]
    if work.has_sent != 0:
        command = work.sent[:n]
    last, missing_late = memory.last_positions[:n], memory.delay_missing[:n]
    silent_travel, silent_s = memory.silent_travel[:n], memory.silent_s[:n]
    missing = memory.missing_travel[:n]
    if memory.silence_known == 0:
        memory.silent_from[:n], silent_travel[:], silent_s[:] = q, 0.0, 0.0
        memory.silence_known = 1
    delays = delays_of(block)
    measure_delays(command, q, answers, dt_s, delays)
    if memory.followed == 0:
        last[:], missing_late[:], delays.accounted[:] = q, 0.0, delays.sent
    fresh = memory.last_joints_ns != memory.last_followed_ns
    account_travel(block, workspace, command, fresh, delays)
    memory.delay_steps += 1
    account_silence(block, workspace)
    if not fresh:
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
    """Collision: the arm stops with its drives on, as for a stop by a person."""
    reason = explain_contact(context.state, context.settings, context.derived.workspace)
    if reason is None:
        return ()
    return (Finding("stop", reason, reason.hint, f"contact: {reason.hint}"),)


def monitor_following(context: StepContext) -> tuple[Finding, ...]:
    """A joint does not follow its command: its encoder, brake or drive is faulty, so the cell goes to fault."""
    reason = explain_following(context.state, context.settings, context.derived.workspace)
    if reason is None:
        return ()
    return (Finding("fault", reason, reason.hint, reason.hint),)


def _monitor_teaching(context: StepContext) -> Findings:
    """Motion ends the teaching of a goal."""
    if context.state.teaching is not None:
        teach_step(context)
    return ()


def _monitor_innovations(context: StepContext) -> Iterator[Finding]:
    """If the explanation of the images has changed: an event, and its consequences."""
    state = context.state
    run = state.reanchoring
    if run is not None and run.phase != "verify":
        if run.phase == "collect":
            finish_round(context)  # for `camera_relocalization`: have the cameras moved?
        return  # at rest, static cameras are checked by `camera_relocalization`
    verdict = finish_round(context)
    if any(state.mobile) and moving_camera.takes(context):
        return
    if state.reanchoring is None and state.watching.verdict.kind in (*MOVED, "cameras_or_arm"):
        yield from camera_moved_findings(state.watching.verdict, context, fresh=verdict is not None)
    if verdict is None or (state.reanchoring is not None and state.reanchoring.phase == "verify"):
        return
    emit_diagnosis(verdict, context)
    if verdict.kind == "joint_zero":
        for estimate in state.cameras:  # from here on images control the arm: they are trusted
            estimate.seen_ns[:] = 0
    if verdict.kind == "marker_slipped" and mask_marker(verdict, context):
        subject = ", ".join(verdict.subjects)
        context.emit("warning", message=f"marker {subject} is not used any more", name=subject)


AGREE, OF = 2, 3
"""Number of the last rounds that must agree, and number of rounds considered."""
LATEST_S = 0.15
"""Largest delay [s] of a late frame, if only noise remains once it is corrected."""
LATEST_MODEL_PX = 0.1
"""Model error [px] allowed in addition in the test for late frames."""


NOISE = ModelDiagnosis()
"""Diagnosis of a round that needs no explanation."""
QUIET = [NOISE] * OF
"""Diagnoses of the last rounds if none needed an explanation."""


def finish_round(context: StepContext) -> ModelDiagnosis | None:
    """Evaluate a round if one is complete; returns the new diagnosis if it has changed."""
    state, arrays, work = context.state, context.arrays, context.derived.workspace.numbers
    watching = state.watching
    if arrays is None:
        return None
    if work.rounds_in_python:
        _judge_round_in_python(context)
    looked_at, inconsistent, masked = work.looked_at, work.inconsistent, work.any_masked
    if not looked_at:
        return None
    if not inconsistent and not masked and watching.last == QUIET and watching.verdict == NOISE:
        return None
    verdict = NOISE
    if inconsistent and not _all_late(_cameras(inconsistent), watching, context.settings):
        problem = present_problem(state, _cameras(looked_at), arrays, context.settings)
        found = diagnosed_beside_joint_errors(problem, proven=state.reanchoring is not None)
        verdict = beside_target(found, state)
    watching.last = [*watching.last[1 - OF :], verdict]
    if masked:
        unmask_returned(watching, _cameras(looked_at), context)
    return _changed(watching)


def _judge_round_in_python(context: StepContext) -> None:
    """Run `judge_round` if a round is due, without the cameras that move. Readings from a faulty drive must not be used
    to judge cameras.
    """
    state, workspace = context.state, context.derived.workspace
    faulty = state.lifecycle is Lifecycle.FAULT or state.lifecycle is Lifecycle.UNCONFIGURED
    if faulty or not round_is_due(state.block.record):
        return
    moving = moving_camera.moving_bits(state) if any(state.mobile) else 0
    work = workspace.numbers
    work.looked_at, work.inconsistent, work.any_masked = judge_round(state.block.record, workspace.record, moving)


def _cameras(bits: int) -> list[int]:
    """Numbers of the cameras whose ``bits`` are set."""
    return [c for c in range(bits.bit_length()) if bits >> c & 1]


@kernel
def judge_round(block: Record, workspace: Record, moving: int) -> tuple[int, int, bool]:
    """Examine the newest frame of each camera. Returns the cameras with a recent frame; those of them whose innovations
    do not look like noise, of all markers together and of each; and whether any marker is masked.

    Sets of cameras are bit masks. Cameras in ``moving`` are ignored.
    """
    memory, work = block[0], workspace[0]
    rows, masked, now_ns = memory.rows, work.masked[: memory.markers], work.now_ns
    known = inconsistent = 0
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
            rows_in_use(memory.frame_seen[at:end], masked),
            MODEL_SIGMA_PX,
        )
        if not (chi2 <= work.noise_chi2[count] and largest <= work.gate):
            inconsistent |= bit
    return known, inconsistent, bool((masked > 0.0).any())


def _all_late(cameras: list[int], watching: ModelMonitor, settings: CoreSettings) -> bool:
    """Whether the newest frame of each of these ``cameras`` is late (`_late`)."""
    frames = [watching.sightings[c] for c in cameras]
    return all(_late(frame, used_rows(watching, frame), settings) for frame in frames)


def _late(sighting: CameraMonitor, used: FloatArray, settings: CoreSettings) -> bool:
    """Whether a shutter time slightly earlier or later than stated explains a frame's innovations.

    Frames are late if a computer is busy. A displaced camera shows innovations at rest, too.
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
    """The part of a diagnosis in which two rounds must agree."""
    return (verdict.kind, *verdict.subjects)


def _changed(watching: ModelMonitor) -> ModelDiagnosis | None:
    """The diagnosis on which two of the last three rounds agree, if it differs from the previous one."""
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
    """Images that contradict the model for many frames make it SUSPECT; images that agree with it clear it."""
    state = context.state
    if state.reanchoring is not None:
        return
    if state.readiness == ModelReadiness.SUSPECT and state.model is not None:
        if min(estimate.agreeing_frames for estimate in state.cameras) >= TRUSTED_FRAMES:
            state.readiness, state.comparison = fitted_readiness(state.model), None
            context.emit("model", message="the images agree with the model again", name=str(state.readiness))
        return
    if state.readiness in (ModelReadiness.NONE, ModelReadiness.SUSPECT):
        return
    for camera, estimate in zip(context.settings.cameras, state.cameras, strict=True):
        if estimate.rejected_frames < SUSPECT_FRAMES:
            continue
        state.readiness = ModelReadiness.SUSPECT
        reason = Reason(
            "MODEL_SUSPECT",
            "hold",
            camera.name,
            float(estimate.rejected_frames),
            float(SUSPECT_FRAMES),
            "frames",
            state.watching.verdict.text
            or f"camera {camera.name} contradicts the model: was it moved, has a marker slipped? Run calibrate --check "
            "--quick, or calibrate again",
        )
        context.emit("model", message=reason.hint, name=str(state.readiness), reasons=(reason,))
        if MOTION_SOURCES[type(state.source)].runs_law:
            yield Finding("abort", reason, reason.hint)
        return


COMPARED_ROUNDS = 5
"""Number of consecutive rounds of frames at rest that confirm a kept model, or after which it is reported as wrong."""
FEWEST_COMPARED = 3
"""Number of markers and static points that each camera must show for the comparison."""
SILENT_S = 3.0
"""Time [s] after which a camera that delivers no frames is left out of the comparison."""


NOT_AT_REST = Reason("MODEL_UNCONFIRMED", "hold", hint="the kept model is compared while the arm rests without a goal")


def _compare_kept_model(context: StepContext) -> Findings:
    """Compare a kept model with the images at rest, by the test of the model monitor; the model is used once
    `COMPARED_ROUNDS` rounds in succession agree.
    """
    state, looked_at = context.state, context.derived.workspace.numbers.looked_at
    comparison, arrays = state.comparison, context.arrays
    if comparison is None or state.readiness is not ModelReadiness.UNCONFIRMED or not looked_at or arrays is None:
        return ()
    if state.reanchoring is not None or not isinstance(state.source, Holding) or bool(state.block.command.any()):
        comparison.rounds, comparison.reason = 0, NOT_AT_REST
        return ()
    problem = present_problem(state, _cameras(looked_at), arrays, context.settings)
    lacking = _lacking(problem, comparison.since_ns, context)
    if lacking is not None:
        comparison.rounds, comparison.reason = 0, lacking
        return ()
    fitted = without_joint_errors(problem, problem.weights)
    cleared = problem if fitted is None else problem.with_innovation(fitted[0])
    value, limit, row = cleared.worst_test(problem.weights)
    verdict, camera = state.watching.last[-1], context.settings.cameras[problem.known[row]].name
    agrees = verdict.kind == "ok" or 0.0 < verdict.moved_px <= context.settings.tolerance_px
    comparison.rounds = max(comparison.rounds, 0) + 1 if agrees else min(comparison.rounds, 0) - 1
    confirmed = comparison.rounds >= COMPARED_ROUNDS
    found = f"camera {camera} {'agrees' if agrees else 'disagrees'}: chi-square {value:.4g}, limit {limit:.4g}"
    hint = f"the kept model is {'' if confirmed else 'not '}confirmed: {'; '.join(filter(None, (found, verdict.text)))}"
    hint += "" if agrees else ". Run calibrate --check --quick, or calibrate"
    comparison.reason = Reason("MODEL_UNCONFIRMED", "hold", camera, value, limit, "chi-square", hint)
    if confirmed and state.model is not None:
        state.readiness, state.comparison = fitted_readiness(state.model), None
    if abs(comparison.rounds) == COMPARED_ROUNDS:
        result = Reason("MODEL_COMPARED", "info", camera, value, limit, "chi-square", hint)
        context.emit("model_compared", accepted=confirmed, message=hint, reasons=(result,), name=str(state.readiness))
    return ()


def _lacking(problem: LinearisedProblem, since_ns: int, context: StepContext) -> Reason | None:
    """What a round lacks for the comparison with a kept model, loaded at ``since_ns``: frames or markers of a camera.
    Cameras that move are left out.
    """
    seen = dict(zip(problem.known, (problem.weights > 0.0).sum(axis=1).tolist(), strict=True))
    least = min(FEWEST_COMPARED, problem.weights.shape[1])
    waits = (context.now_ns - since_ns) * 1e-9 <= SILENT_S
    for c, (camera, mobile) in enumerate(zip(context.settings.cameras, context.state.mobile, strict=True)):
        count = seen.get(c, 0 if waits else least)
        if count >= least or (mobile is not None and mobile.moving):
            continue
        shows = "delivers no frames: is it connected? See the daemon's log"
        if c in seen:
            shows = f"shows {count} of its markers, {least} are needed: jog the arm into view, or run calibrate --check"
        hint = f"the kept model is not confirmed: camera {camera.name} {shows}"
        return Reason("MODEL_UNCONFIRMED", "hold", camera.name, float(count), float(least), "markers", hint)
    return None


def _monitor_relocalization(context: StepContext) -> Findings:
    """Cameras that are being relocalized; laws wait meanwhile."""
    if context.state.reanchoring is not None:
        camera_relocalization.step(context)
    return ()


def _never(state: CoreState) -> bool:
    """For monitors that act only on detections of `detect` or on requests."""
    return False


def _refuses(state: CoreState) -> bool:
    """Whether the newest sample of some source was rejected: the next one may be good."""
    return state.refused_joints.reason is not None or any(
        refused.reason is not None for refused in state.refused_frames
    )


def rounds_in_python(state: CoreState) -> bool:
    """Whether Python examines the rounds of frames: some cameras may move or are being relocalized."""
    return state.reanchoring is not None or any(state.mobile)


MONITORS: tuple[Monitor, ...] = (
    Monitor("stop", _monitor_stop, _never),
    Monitor("requests", _answer_requests, _never),
    Monitor("inputs", _monitor_inputs, _refuses),
    Monitor("collision", monitor_collision, _never),
    Monitor("following error", monitor_following, _never),
    Monitor("teaching", _monitor_teaching, lambda state: state.teaching is not None),
    Monitor(
        "innovations",
        _monitor_innovations,
        lambda state: state.watching.verdict.kind != "ok" or rounds_in_python(state),
    ),
    Monitor("comparison", _compare_kept_model, lambda state: state.readiness is ModelReadiness.UNCONFIRMED),
    Monitor("model", _monitor_model, lambda state: state.readiness is ModelReadiness.SUSPECT),
    Monitor("relocalization", _monitor_relocalization, lambda state: state.reanchoring is not None),
)


def monitors_attend(state: CoreState) -> bool:
    """Whether a monitor is to be called in every step, as the ``state`` is."""
    return any(entry.attends(state) for entry in MONITORS)
