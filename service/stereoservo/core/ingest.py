"""Stage 1 of a core step: accepts or rejects joint samples and camera frames by time stamp, sequence number and values,
keeps the history of the joints, and follows the lifecycle of the joint driver. It also defines the time-outs of these
inputs.

Stamps and ``now_ns`` are of one clock. The servo process reads ``now_ns`` after all inputs, so a sample from the future
is wrong, however small the difference. Rejected inputs are not stored, so one wrong sample cannot invalidate later
ones.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.core.block import HISTORY, VELOCITY_FILTER_S
from stereoservo.core.context import MAX_FRAMES, Ingested, StepContext
from stereoservo.core.cycle import StepInputs
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import LEAST_SEPARATION_NS, Refused
from stereoservo.messages.cell_file import MAX_MARKERS
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray, IntArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import CameraObservation, JointState

LONGEST_GAP_S = 0.5
"""Longest time without a step before the arm stops [s], however long the drives' own time-out is: the arm is not
monitored meanwhile.
"""
LEAST_GAP_PERIODS = 2
"""A step that is one period late is no gap, however short the drives' time-out is."""
FASTEST = 2.0
"""Factor on ``velocity_max``: no joint can move faster than that."""
STAMP_JITTER_S = 0.05
"""Possible error of the time between two joint samples [s]; a larger displacement counts as a jump."""
FARTHEST = 1e6
"""Largest plausible joint position [rad or m]."""
FARTHEST_INTEGER = 1 << 62
LARGEST_SIGMA_PX = 1e4
FRESH_S = 0.15
FRESH_FRAMES = 2.5  # without a frame for so many periods, a law counts as coasting


STAMP, VALUES = 2, 3
"""Results for a joint sample or a frame: `STAMP` and `VALUES` are reasons of rejection, `NO_NEWS` was received
before.
"""
NO_NEWS, ACCEPTED = 0, 1
REFUSED = 1
"""Bit of the stages' detections: an impossible input, or a loop that was interrupted."""


@kernel
def ingest(block: Record, workspace: Record) -> int:
    """Accept inputs that are new and stamped within [now - time-out, now], and store the joints. Returns `REFUSED` if
    any input is rejected; the reasons are written to the ``workspace``.

    Rejected inputs are not stored. After a gap the drives have stopped by their own time-out and no longer execute the
    last command, so commands start from rest. If the clock went back, all earlier stamps lie in the future and would
    cause the rejection of every new input: they are reset.
    """
    memory, work = block[0], workspace[0]
    work.followed = 0
    if work.now_ns < memory.last_step_ns:
        _forget_stamps(block)
    last_ns = memory.last_step_ns
    work.elapsed_s = (work.now_ns - last_ns) * 1e-9 if last_ns != 0 else work.nominal_s
    within = 0.0 <= work.elapsed_s <= work.longest_gap_s
    work.gap = int(last_ns != 0 and work.active_before != 0 and not within)
    pass_frames(block, workspace)
    work.joints_found = _take_joints(block, workspace)
    memory.last_step_ns = work.now_ns
    if work.gap != 0:
        memory.command[: memory.joints] = 0.0
        forget_travel(block)
    return REFUSED if work.gap != 0 or work.joints_found > ACCEPTED or work.frames_refused != 0 else 0


@kernel
def forget_travel(block: Record) -> None:
    """Reset the comparison of travel, because the drives did not execute the recent commands."""
    memory = block[0]
    memory.missing_travel[: memory.joints] = 0.0
    memory.untold_travel[: memory.joints] = 0.0
    memory.followed = memory.silence_known = 0


@kernel
def _forget_stamps(block: Record) -> None:
    """Reset all time stamps, but keep the estimates."""
    memory = block[0]
    memory.history_count, memory.last_joints_ns, memory.last_joints_seq = 0, 0, -1
    for c in range(memory.cameras):
        memory.estimates[c].last_seq, memory.estimates[c].accepted_ns = -1, 0
    memory.seen_ns[: memory.cameras * memory.markers] = 0


@kernel
def _take_joints(block: Record, workspace: Record) -> int:
    """Store the joint sample in the ``workspace`` if it is new and in time; returns `NO_NEWS`, `ACCEPTED`, `STAMP` or
    `VALUES`.
    """
    memory, work = block[0], workspace[0]
    fresh = work.joints_seq != memory.last_joints_seq and work.joints_ns > memory.last_joints_ns
    if work.joints_given == 0 or not fresh:
        take_sample(block, workspace, False)
        return NO_NEWS
    if not 0.0 <= (work.now_ns - work.joints_ns) * 1e-9 <= work.joint_timeout_s:
        take_sample(block, workspace, False)
        return STAMP
    if take_sample(block, workspace, work.joints_whole != 0) and work.joints_whole != 0:
        return ACCEPTED
    return VALUES


@kernel
def remember_joints(stamps: IntArray, kept: FloatArray, count: int, t_ns: int, positions: FloatArray) -> int:
    """Append joint positions to a ring buffer; returns the new count. They replace the last entry if that is close to
    the one before it in time.

    ``stamps`` (k,) [ns] and ``kept`` (k, n): the ring's stamps and positions.
    ``count``: number of entries ever written.
    ``t_ns``, ``positions`` (n,): the new entry.
    """
    size = stamps.size
    if count > 1 and 0 <= stamps[(count - 1) % size] - stamps[(count - 2) % size] < LEAST_SEPARATION_NS:
        count -= 1
    slot = count % size
    stamps[slot] = t_ns
    for j in range(positions.size):
        kept[slot, j] = positions[j]
    return count + 1


@kernel
def take_sample(block: Record, workspace: Record, complete: bool) -> bool:
    """Store the joint sample in the ``workspace`` as the newest one of the ``block`` if it is plausible, and
    filter the velocities since the last one; returns whether it is plausible. Returns True if there is no sample
    (``complete`` is False).

    ``q`` (n,) of the workspace is set to the newest positions, zero before the first sample. The history restarts if
    the positions of an arm that is not driven jump: an encoder was set.
    """
    memory, work = block[0], workspace[0]
    n, q = memory.joints, work.q
    kept = memory.history_positions[: HISTORY * n].reshape((HISTORY, n))
    sound = True
    if complete:
        values, elapsed_s = (
            work.sample[: 4 * n].reshape((4, n)),
            (work.joints_ns - memory.last_joints_ns) * 1e-9,
        )
        sound = _sound(values, kept, memory.history_count, elapsed_s, work.velocity_max[:n], work.active_before != 0)
        if sound:
            memory.history_count = _append_sample(
                Samples(memory.history_ns, kept),
                memory.history_count,
                work.joints_ns,
                values[0],
                work.velocity_max[:n],
                Velocities(memory.last_joints_ns, memory.velocities[:n]),
            )
            memory.last_joints_seq, memory.last_joints_ns = work.joints_seq, work.joints_ns
    for j in range(n):
        q[j] = kept[(memory.history_count - 1) % HISTORY, j] if memory.history_count > 0 else 0.0
    return sound


class Samples(NamedTuple):
    """A ring buffer of joint samples: ``stamps`` (k,) [ns] and ``positions`` (k, n)."""

    stamps: IntArray
    positions: FloatArray


class Velocities(NamedTuple):
    """Filtered joint velocities (n,) at the sample at ``last_ns``."""

    last_ns: int
    values: FloatArray


@kernel
def _append_sample(
    ring: Samples,
    count: int,
    t_ns: int,
    positions: FloatArray,
    velocity_max: FloatArray,
    filtered: Velocities,
) -> int:
    """Append a sample as `remember_joints` does, and update the ``filtered`` velocities in place; returns the new
    count.
    """
    stamps, kept, velocities = ring.stamps, ring.positions, filtered.values
    if count > 0:
        elapsed_s = (t_ns - filtered.last_ns) * 1e-9
        previous = kept[(count - 1) % stamps.size]
        if _jumped(positions, previous, velocity_max, elapsed_s):
            count = 0
            velocities[:] = 0.0
        else:
            share = elapsed_s / (elapsed_s + VELOCITY_FILTER_S)
            for j in range(positions.size):
                velocity = (positions[j] - previous[j]) / elapsed_s
                velocities[j] = velocities[j] + share * (velocity - velocities[j])
    return remember_joints(stamps, kept, count, t_ns, positions)


@kernel
def _jumped(positions: FloatArray, previous: FloatArray, velocity_max: FloatArray, elapsed_s: float) -> bool:
    """Whether a joint cannot have moved from its ``previous`` position (n,) to this one within ``elapsed_s``."""
    for j in range(positions.size):
        possible = velocity_max[j] * (FASTEST * elapsed_s + STAMP_JITTER_S)
        if not abs(positions[j] - previous[j]) <= possible:
            return True
    return False


@kernel
def _sound(
    values: FloatArray, kept: FloatArray, count: int, elapsed_s: float, velocity_max: FloatArray, active: bool
) -> bool:
    """Whether a joint sample is plausible: all values are finite, and while the drives are ``active``, the positions do
    not jump from the newest ones in ``kept`` (k, n).

    ``values`` (4, n): rows of positions, velocities, efforts and following errors.
    """
    for j in range(values.shape[1]):
        if not (
            abs(values[0, j]) <= FARTHEST
            and math.isfinite(values[1, j])
            and math.isfinite(values[2, j])
            and math.isfinite(values[3, j])
        ):
            return False
    return not (active and count > 0 and _jumped(values[0], kept[(count - 1) % kept.shape[0]], velocity_max, elapsed_s))


# -- the driver -------------------------------------------------------------------------------------------------


def follow_driver(context: StepContext) -> None:
    """Update the lifecycle by what the servo process did with the driver; a fault is latched."""
    state, inputs = context.state, context.inputs
    before = state.lifecycle
    if inputs.driver_fault is not None and (before != Lifecycle.FAULT or not state.fault):
        reason = Reason(
            "DRIVER_FAULT",
            "fault",
            hint=f"{inputs.driver_fault.code}: {inputs.driver_fault.message}; clear the cause, then reset",
        )
        state.fault = [reason]
        state.lifecycle = Lifecycle.FAULT
        state.driver_request = "deactivate"
        context.emit("fault", message=reason.hint, reasons=(reason,))
    elif before == Lifecycle.FAULT:
        if inputs.driver_fault is None and not state.fault:
            state.lifecycle = Lifecycle.INACTIVE
    elif not inputs.driver_configured:
        state.lifecycle = Lifecycle.UNCONFIGURED
    else:
        state.lifecycle = Lifecycle.ACTIVE if inputs.driver_active else Lifecycle.INACTIVE
    if state.lifecycle != before:
        context.emit("lifecycle", message=f"{before} -> {state.lifecycle}", name=str(state.lifecycle))


def nominal_period_ns(settings: CoreSettings) -> int:
    """The nominal period of the loop [ns]."""
    return round(1e9 / settings.rate_hz)


def longest_gap_s(settings: CoreSettings) -> float:
    """Longest time between two steps [s] before the arm no longer executes the core's commands.

    Drives stop after their own ``command_timeout_s``.
    """
    patience_s = min(LONGEST_GAP_S, settings.limits.command_timeout_s)
    return max(patience_s, LEAST_GAP_PERIODS * nominal_period_ns(settings) * 1e-9)


def features_fresh_s(settings: CoreSettings) -> float:
    """Age of features [s] up to which a law does not coast: one or two frames of the slowest camera."""
    return max(FRESH_S, FRESH_FRAMES / min((c.rate_hz for c in settings.cameras), default=30.0))


def frame_timeout_s(settings: CoreSettings) -> float:
    """Age of a frame [s] beyond which no law may use it."""
    return max(settings.limits.coast_s, features_fresh_s(settings))


# -- inputs ------------------------------------------------------------------------------------------------------


def put_inputs(context: StepContext) -> None:
    """Write the step's inputs into the workspace."""
    inputs, workspace, sent = context.inputs, context.derived.workspace, context.inputs.sent
    has_sent = sent is not None and sent.shape == workspace.sent.shape and bool(np.isfinite(sent).all())
    if has_sent:
        workspace.sent[:] = sent
    frames = newest_frames(inputs) if inputs.observations else ()
    for k, frame in enumerate(frames):
        camera = context.derived.cameras.get(frame.camera, -1)
        stamp = _within_bounds(frame.seq), _within_bounds(frame.t_shutter_ns)
        workspace.put_frame(k, camera, stamp, (frame.ids, frame.pixels, frame.covariances))
    sample, now_ns, count = inputs.joints, inputs.now_ns, len(frames)
    if sample is None:
        workspace.put_numbers(now_ns, context.dt_s, inputs.stop, count, has_sent, False, 0, 0, False, False, False)
        return
    whole, t_ns, seq = fill_sample(sample, workspace.sample), sample.t_ns, sample.seq
    if not -FARTHEST_INTEGER < t_ns < FARTHEST_INTEGER or not -FARTHEST_INTEGER < seq < FARTHEST_INTEGER:
        t_ns, seq = _within_bounds(t_ns), _within_bounds(seq)
    workspace.put_numbers(
        now_ns, context.dt_s, inputs.stop, count, has_sent, True, t_ns, seq, whole, sample.efforts is not None,
        sample.following_errors is not None,
    )  # fmt: skip


def _within_bounds(number: int) -> int:
    """The number, limited to what a record can hold: a stamp out of range remains too far away to be accepted."""
    return max(-FARTHEST_INTEGER, min(number, FARTHEST_INTEGER))


def newest_frames(inputs: StepInputs) -> tuple[CameraObservation, ...]:
    """The newest frames of a step, at most `MAX_FRAMES`."""
    return inputs.observations[-MAX_FRAMES:]


def fill_sample(sample: JointState, values: FloatArray) -> bool:
    """Whether every field of a sample has a value for each joint. Writes the fields to ``values`` (4, n), missing ones
    as zero.
    """
    shape, efforts, following = values.shape[1:], sample.efforts, sample.following_errors
    if (
        sample.positions.shape != shape
        or sample.velocities.shape != shape
        or (efforts is not None and efforts.shape != shape)
        or (following is not None and following.shape != shape)
    ):
        return False
    values[0], values[1] = sample.positions, sample.velocities
    values[2], values[3] = 0.0 if efforts is None else efforts, 0.0 if following is None else following
    return True


@kernel
def pass_frames(block: Record, workspace: Record) -> None:
    """Decide for each frame in the ``workspace``: `ACCEPTED`, `STAMP`, `VALUES`, or `NO_NEWS`.

    A frame that is too old does not stop the arm: the law coasts as if the frame had been lost, and brakes in time. If
    a camera restarts its sequence numbers, its frames are recognised by their stamps, which are checked; sequence
    numbers alone are not trusted.
    """
    memory, work = block[0], workspace[0]
    last_seq, accepted_ns = np.empty(memory.cameras, np.int64), np.empty(memory.cameras, np.int64)
    for c in range(memory.cameras):
        last_seq[c], accepted_ns[c] = memory.estimates[c].last_seq, memory.estimates[c].accepted_ns
    work.frames_passed = work.frames_refused = 0
    for k in range(work.frames):
        c, seq, t_ns = work.arrived_camera[k], work.arrived_seq[k], work.arrived_ns[k]
        found = NO_NEWS
        if c >= 0 and seq != last_seq[c] and not (seq < last_seq[c] and t_ns <= accepted_ns[c]):
            found = _judged(workspace, k)
        if found == ACCEPTED:
            last_seq[c], accepted_ns[c] = seq, max(accepted_ns[c], t_ns)
            work.frames_passed += 1
        elif found != NO_NEWS:
            work.frames_refused += 1
        work.arrived_found[k] = found


@kernel
def _judged(workspace: Record, k: int) -> int:
    """Result for the new frame ``k`` of the ``workspace``: `ACCEPTED`, or the reason of rejection."""
    work = workspace[0]
    if not 0.0 <= (work.now_ns - work.arrived_ns[k]) * 1e-9 <= work.frame_timeout_s:
        return STAMP
    outside, vague = first_wrong(workspace, k)
    return VALUES if work.arrived_count[k] < 0 or outside >= 0 or vague >= 0 else ACCEPTED


@kernel
def first_wrong(workspace: Record, k: int) -> tuple[int, int]:
    """The first marker of frame ``k`` of the ``workspace`` that is farther outside the image than the image's own
    size, and the first one whose covariance is invalid; -1 if there is none.
    """
    work = workspace[0]
    c, count = work.arrived_camera[k], work.arrived_count[k]
    at = MAX_MARKERS * k
    width, height = work.image_sizes[2 * c], work.image_sizes[2 * c + 1]
    outside, vague = -1, -1
    for i in range(count):
        u = work.arrived_pixels[2 * (at + i)] / width - 0.5
        v = work.arrived_pixels[2 * (at + i) + 1] / height - 0.5
        if outside < 0 and not (abs(u) <= 1.5 and abs(v) <= 1.5):
            outside = i
        C = work.arrived_covariances[4 * (at + i) : 4 * (at + i) + 4].reshape((2, 2))
        largest = max(abs(C[0, 0]), abs(C[0, 1]), abs(C[1, 0]), abs(C[1, 1]))
        numbers = math.isfinite(C[0, 0] + C[0, 1] + C[1, 0] + C[1, 1])
        known = numbers and largest <= LARGEST_SIGMA_PX * LARGEST_SIGMA_PX
        if vague < 0 and not (known and C[0, 0] > 0.0 and C[0, 0] * C[1, 1] - C[0, 1] * C[1, 0] > 0.0):
            vague = i
    return outside, vague


# -- reasons of rejection ----------------------------------------------------------------------------------------


def passed_frames(context: StepContext) -> tuple[tuple[int, CameraObservation], ...]:
    """The accepted frames, each with the index of its camera."""
    found, cameras = context.derived.workspace.arrays["arrived_found"], context.derived.cameras
    frames = newest_frames(context.inputs)
    return tuple([(cameras[frame.camera], frame) for k, frame in enumerate(frames) if found[k] == ACCEPTED])


def account_inputs(context: StepContext) -> Ingested:
    """The results of `ingest` in this step, with reasons. Rejected inputs of each source are counted since its last
    accepted one.
    """
    state, work = context.state, context.derived.workspace.numbers
    joints, sample = work.joints_found, context.inputs.joints
    accepted = sample if joints == ACCEPTED else None
    refused_joints = None
    if sample is not None and joints > ACCEPTED:
        refused_joints = _late(sample, context) if joints == STAMP else _wrong(sample, context)
    passed = passed_frames(context) if work.frames_passed else ()
    refused_frames = _refused_frames(context) if work.frames_refused else ()
    gap = _gap(work.elapsed_s, context) if work.gap else None
    stops = tuple(reason for reason in (gap, refused_joints) if reason is not None)
    if MOTION_SOURCES[type(state.source)].by_images:
        stops += tuple(reason for _, reason in refused_frames if reason.level == "hold")
    if accepted is not None:
        state.refused_joints.reason = None
    if refused_joints is not None:
        _count(state.refused_joints, refused_joints)
    for camera, _ in passed:
        state.refused_frames[camera].reason = None
    for camera, reason in refused_frames:
        _count(state.refused_frames[camera], reason)
    return Ingested(accepted, passed, work.elapsed_s, refused_joints, refused_frames, gap, stops)


def _count(refused: Refused, reason: Reason) -> None:
    refused.count += 1
    refused.reason = reason


def _gap(gap_s: float, context: StepContext) -> Reason:
    """Reason: the loop was interrupted while the drives were on."""
    limit_s = context.derived.longest_gap_s
    return Reason(
        "LOOP_GAP",
        "hold",
        "",
        gap_s,
        limit_s,
        "s",
        f"the servo loop did not run for {gap_s:.3f} s, {limit_s:.3f} s is allowed, and the drives were left alone: "
        "resume, then send the goal again; if it comes again, take load off this computer or give the loop priority "
        "(servo.priority)",
    )


def _late(sample: JointState, context: StepContext) -> Reason:
    age_s, timeout_s = (context.now_ns - sample.t_ns) * 1e-9, context.settings.limits.joint_timeout_s
    what = (
        f"{age_s:.3f} s old, {timeout_s:g} s is allowed (safety.joint_timeout_s): the computer was busy (`uptime`), or "
        "the joint driver's clock or its bus is late"
        if age_s > 0.0
        else f"{-age_s:.6g} s in the future: check the joint driver's clock"
    )
    return Reason(
        "JOINT_STAMP",
        "hold",
        "",
        age_s,
        timeout_s if age_s > 0.0 else 0.0,
        "s",
        f"the stamp of joint sample {sample.seq} is {what}; then resume",
    )


def _wrong(sample: JointState, context: StepContext) -> Reason:
    wrong = _wrong_values(sample, context.settings.joint_names)
    if not wrong:
        return _jump(sample, context)
    return Reason(
        "JOINT_VALUE",
        "hold",
        "",
        None,
        None,
        "",
        f"joint sample {sample.seq} is refused: {wrong}: check the drive, its encoder and the joint driver; then "
        "resume",
    )


def _wrong_values(sample: JointState, names: tuple[str, ...]) -> str:
    """What is impossible in the values of a joint sample; empty if they are plausible."""
    for what, values in (
        ("position", sample.positions),
        ("velocity", sample.velocities),
        ("effort", sample.efforts),
        ("following error", sample.following_errors),
    ):
        if values is None:
            continue
        if values.shape != (len(names),):
            return f"it has {what} values of shape {values.shape}, the cell has {len(names)} joints"
        possible = np.abs(values) <= FARTHEST if what == "position" else np.isfinite(values)
        if not possible.all():
            j = int(np.flatnonzero(~possible)[0])
            return f"the {what} of joint {names[j]} is {values[j]:g}"
    return ""


def _jump(sample: JointState, context: StepContext) -> Reason:
    """Reason: a joint cannot have moved from its last position to this one in the time between."""
    block, settings = context.state.block, context.settings
    elapsed_s = (sample.t_ns - block.numbers.last_joints_ns) * 1e-9
    travel = np.abs(sample.positions - block.history_positions[(block.numbers.history_count - 1) % HISTORY])
    possible = settings.limits.velocity_max * (FASTEST * elapsed_s + STAMP_JITTER_S)
    j = int((travel / possible).argmax())
    name, value, limit = settings.joint_names[j], float(travel[j]), float(possible[j])
    return Reason(
        "JOINT_JUMP",
        "hold",
        name,
        value,
        limit,
        "",
        f"the position of joint {name} changed by {value:.4g} within {elapsed_s * 1e3:.3g} ms, {limit:.4g} is "
        "possible: check its encoder, cable and coupling; then resume",
    )


def _refused_frames(context: StepContext) -> tuple[tuple[int, Reason], ...]:
    """The reasons of rejected frames, each with the index of its camera."""
    workspace, cameras = context.derived.workspace, context.derived.cameras
    found = workspace.arrays["arrived_found"]
    refused: list[tuple[int, Reason]] = []
    for k, frame in enumerate(newest_frames(context.inputs)):
        if found[k] == STAMP:
            age_s = (context.now_ns - frame.t_shutter_ns) * 1e-9
            reason = _refused_frame(frame, age_s, context.derived.frame_timeout_s)
            refused.append((cameras[frame.camera], reason))
        elif found[k] == VALUES:
            camera = cameras[frame.camera]
            refused.append((camera, _impossible_frame(frame, _wrong_observations(frame, k, context))))
    return tuple(refused)


def _wrong_observations(frame: CameraObservation, k: int, context: StepContext) -> str:
    """What is impossible in the markers of frame ``k``."""
    count = len(frame.ids)
    if count > MAX_MARKERS:
        return f"it has {count} markers, {MAX_MARKERS} are allowed"
    pixels, covariances = frame.pixels, frame.covariances
    if pixels.shape != (count, 2) or covariances.shape != (count, 2, 2):
        return f"{count} markers have pixels {pixels.shape} and covariances {covariances.shape}"
    outside, vague = first_wrong(context.derived.workspace.record, k)
    if outside >= 0:
        camera = context.settings.cameras[context.derived.cameras[frame.camera]]
        marker, at = frame.ids[outside], pixels[outside].tolist()
        return f"marker {marker} is at {at} in an image of {camera.width}x{camera.height}"
    return f"marker {frame.ids[vague]} has the covariance {covariances[vague].tolist()}"


def _impossible_frame(observation: CameraObservation, wrong: str) -> Reason:
    return Reason(
        "CAMERA_VALUE",
        "hold",
        observation.camera,
        None,
        None,
        "",
        f"frame {observation.seq} of camera {observation.camera} is refused: {wrong}: check its detector and driver; "
        "then resume",
    )


def _refused_frame(observation: CameraObservation, age_s: float, timeout_s: float) -> Reason:
    name = observation.camera
    if age_s < 0.0:
        return Reason(
            "CAMERA_STAMP",
            "hold",
            name,
            age_s,
            0.0,
            "s",
            f"the stamp of frame {observation.seq} of camera {name} is {-age_s:.6g} s in the future: check the "
            "camera's clock and its latency_s; then resume",
        )
    return Reason(
        "CAMERA_LATE",
        "info",
        name,
        age_s,
        timeout_s,
        "s",
        f"frame {observation.seq} of camera {name} came {age_s:.3f} s after its shutter, {timeout_s:g} s is allowed: "
        "not used; check the camera's connection and this computer's load; a camera that is always so late needs a "
        "larger safety.coast_s",
    )
