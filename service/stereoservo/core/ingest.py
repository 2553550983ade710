"""Stage 1 of a core step: accepts or rejects joint samples and camera frames by time stamp, sequence number and values,
keeps the history of the joints, and follows the lifecycle of the joint driver. Also the time-outs of these inputs.

Stamps and ``now_ns`` are of one clock, and the servo process takes ``now_ns`` after it has read everything: a sample
of the future is wrong, however little. What is refused is not stored, so that one wrong sample spoils no later one.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.core.block import HISTORY, VELOCITY_FILTER_S
from stereoservo.core.context import Ingested, StepContext
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.settings import CameraSettings, CoreSettings
from stereoservo.core.state import LEAST_APART_NS, CoreState, Refused
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray, IntArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import CameraObservation, JointState

LONGEST_GAP_S = 0.5
"""Without a step for so long the arm stops, however patient its drives are: it moves unwatched meanwhile."""
LEAST_GAP_PERIODS = 2
"""A step that comes one period late is no gap, however impatient the drives are."""
FASTEST = 2.0
"""Times its ``velocity_max`` a joint cannot move."""
STAMP_JITTER_S = 0.05
"""By which the stamps of two joint samples may be off, on top of which a jump counts as one."""
FARTHEST = 1e6
"""[rad or m] No joint is so far from its zero."""
MAX_MARKERS = 256
"""Of one frame, at most."""
LARGEST_SIGMA_PX = 1e4
FRESH_S = 0.15
FRESH_FRAMES = 2.5  # without a frame for so many periods a law is said to coast


def ingest(context: StepContext) -> Ingested:
    """Pass what is new and stamped within [now - time-out, now]; keep the joints and follow the driver's state.

    Of what is refused nothing is kept but the count and the reason. After a gap the drives were left alone, and the
    last command is not what they do: commands begin from rest.
    """
    state, inputs, numbers = context.state, context.inputs, context.state.block.numbers
    if inputs.now_ns < numbers.last_step_ns:
        _forget_stamps(state)
    last_ns = numbers.last_step_ns
    elapsed_s = (inputs.now_ns - last_ns if last_ns else context.derived.nominal_period_ns) * 1e-9
    gap = _gap(elapsed_s, context)
    observations, refused_frames = observations_of(context) if inputs.observations else ((), ())
    joints, refused_joints = _take_joints(context)
    numbers.last_step_ns = context.now_ns
    stops: tuple[Reason, ...] = ()
    if gap is not None or refused_joints is not None or refused_frames:
        stops = tuple(reason for reason in (gap, refused_joints) if reason is not None)
        if MOTION_SOURCES[type(state.source)].by_images:
            stops += tuple(reason for _, reason in refused_frames if reason.level == "hold")
    context.ingested = Ingested(joints, observations, elapsed_s, refused_joints, refused_frames, gap, stops)
    if joints is not None:
        state.refused_joints.reason = None
    if observations or refused_joints is not None or refused_frames:
        _count_refused(context.ingested, state)
    if gap is not None:
        state.block.command[:] = 0.0
        forget_travel(state)
    _follow_driver(context)
    return context.ingested


def _count_refused(ingested: Ingested, state: CoreState) -> None:
    """Keep of each source what was refused since its last good sample."""
    if ingested.refused_joints is not None:
        _count(state.refused_joints, ingested.refused_joints)
    for camera, _ in ingested.observations:
        state.refused_frames[camera].reason = None
    for camera, reason in ingested.refused_frames:
        _count(state.refused_frames[camera], reason)


def _forget_stamps(state: CoreState) -> None:
    """The clock went back: what was stamped before is of a time to come, and would refuse all that is new."""
    block = state.block
    block.numbers.history_count, block.numbers.last_joints_ns, block.numbers.last_joints_seq = 0, 0, -1
    for estimate in state.cameras:
        estimate.last_seq, estimate.accepted_ns = -1, 0
        estimate.seen_ns[:] = 0


@kernel
def remember_joints(stamps: IntArray, kept: FloatArray, count: int, t_ns: int, positions: FloatArray) -> int:
    """Append joint ``positions`` (n,) at ``t_ns`` to a ring of ``stamps`` (k,) and positions ``kept`` (k, n), to which
    ``count`` were ever written; the new count. They take the place of the last ones where these are close to the ones
    before.
    """
    size = stamps.size
    if count > 1 and 0 <= stamps[(count - 1) % size] - stamps[(count - 2) % size] < LEAST_APART_NS:
        count -= 1
    slot = count % size
    stamps[slot] = t_ns
    for j in range(positions.size):
        kept[slot, j] = positions[j]
    return count + 1


@kernel
def take_sample(
    block: Record, room: Record, told: bool, t_ns: int, seq: int, active: bool, q: FloatArray
) -> bool:
    """Whether a joint sample, of which the ``room`` holds the values, may be right; then it is the newest one of the
    ``block``, and the filtered velocities are those since the last one. Into ``q`` (n,): the newest positions,
    zero before the first. Without a sample (``told``): nothing is wrong.

    The history begins again where an arm that is not driven stands elsewhere at once: an encoder was set.
    """
    memory, work = block[0], room[0]
    n = memory.joints
    kept = memory.history_positions[: HISTORY * n].reshape((HISTORY, n))
    sound = True
    if told:
        values, elapsed_s = (
            work.sample[: 4 * n].reshape((4, n)),
            (t_ns - memory.last_joints_ns) * 1e-9,
        )
        sound = _sound(values, kept, memory.history_count, elapsed_s, work.velocity_max[:n], active)
        if sound:
            memory.history_count = _append_sample(
                memory.history_ns, kept, memory.history_count, t_ns, values[0], memory.last_joints_ns,
                work.velocity_max[:n], memory.velocities[:n],
            )  # fmt: skip
            memory.last_joints_seq, memory.last_joints_ns = seq, t_ns
    for j in range(n):
        q[j] = kept[(memory.history_count - 1) % HISTORY, j] if memory.history_count > 0 else 0.0
    return sound


@kernel
def _append_sample(
    stamps: IntArray, kept: FloatArray, count: int, t_ns: int, positions: FloatArray, last_ns: int,
    velocity_max: FloatArray, velocities: FloatArray,
) -> int:  # fmt: skip
    """`remember_joints`, and the filtered joint ``velocities`` (n,) since the last sample at ``last_ns``, in place."""
    if count > 0:
        elapsed_s = (t_ns - last_ns) * 1e-9
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
    """Whether a joint cannot have come from its ``previous`` position (n,) to this one within ``elapsed_s``."""
    for j in range(positions.size):
        possible = velocity_max[j] * (FASTEST * elapsed_s + STAMP_JITTER_S)
        if not abs(positions[j] - previous[j]) <= possible:
            return True
    return False


@kernel
def _sound(
    values: FloatArray, kept: FloatArray, count: int, elapsed_s: float, velocity_max: FloatArray, active: bool
) -> bool:
    """Whether positions, and velocities, efforts and following errors, the rows of ``values`` (4, n), may be right,
    and, while the drives are ``active``, the positions are no jump from the newest ones ``kept`` (k, n).
    """
    for j in range(values.shape[1]):
        if not (
            abs(values[0, j]) <= FARTHEST
            and math.isfinite(values[1, j])
            and math.isfinite(values[2, j])
            and math.isfinite(values[3, j])
        ):
            return False
    return not (
        active
        and count > 0
        and _jumped(values[0], kept[(count - 1) % kept.shape[0]], velocity_max, elapsed_s)
    )


def _follow_driver(context: StepContext) -> None:
    """The lifecycle follows what the servo process did with the driver; a fault is latched."""
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
    """The period that the loop is to keep [ns]."""
    return round(1e9 / settings.rate_hz)


def longest_gap_s(settings: CoreSettings) -> float:
    """Time between two steps [s] after which the arm's motion is no longer the core's.

    Drives come to rest by themselves after their ``command_timeout_s``: they no longer do what they were last sent.
    """
    patience_s = min(LONGEST_GAP_S, settings.limits.command_timeout_s)
    return max(patience_s, LEAST_GAP_PERIODS * nominal_period_ns(settings) * 1e-9)


def features_fresh_s(settings: CoreSettings) -> float:
    """Age of features [s] up to which a law does not coast at all: a frame or two of the slowest camera."""
    return max(FRESH_S, FRESH_FRAMES / min((c.rate_hz for c in settings.cameras), default=30.0))


def frame_timeout_s(settings: CoreSettings) -> float:
    """Age of a frame [s] from which on no law may move by it."""
    return max(settings.limits.coast_s, features_fresh_s(settings))


def _count(refused: Refused, reason: Reason) -> None:
    refused.count += 1
    refused.reason = reason


def _gap(gap_s: float, context: StepContext) -> Reason | None:
    """The reason where the loop stood still while the drives were on."""
    state, limit_s = context.state, context.derived.longest_gap_s
    if not state.block.numbers.last_step_ns or state.lifecycle != Lifecycle.ACTIVE or 0.0 <= gap_s <= limit_s:
        return None
    return Reason(
        "LOOP_GAP", "hold", "", gap_s, limit_s, "s",
        f"the servo loop did not run for {gap_s:.3f} s, {limit_s:.3f} s is allowed, and the drives were left alone: "
        "resume, then send the goal again; if it comes again, take load off this computer or give the loop priority "
        "(servo.priority)",
    )  # fmt: skip


def _take_joints(context: StepContext) -> tuple[JointState | None, Reason | None]:
    """The joint sample, which is in the history now, or why it is refused; neither where there is none or it was here
    before.
    """
    block, room, sample, q = context.state.block, context.derived.room, new_sample(context), context.q
    if sample is None:
        take_sample(block.record, room.record, False, 0, 0, False, q)
        return None, None
    told, active = takes(sample, context), context.state.lifecycle == Lifecycle.ACTIVE
    if take_sample(block.record, room.record, told, sample.t_ns, sample.seq, active, q) and told:
        return sample, None
    return None, _wrong(sample, context) if _in_time(sample, context) else _late(sample, context)


def new_sample(context: StepContext) -> JointState | None:
    """The joint sample of the step; None where there is none, or it was here before."""
    sample, numbers = context.inputs.joints, context.state.block.numbers
    if sample is None or sample.seq == numbers.last_joints_seq or sample.t_ns <= numbers.last_joints_ns:
        return None
    return sample


def takes(sample: JointState, context: StepContext) -> bool:
    """Whether a sample is in time, and tells of every joint; then its values are in the workspace."""
    return _in_time(sample, context) and fill_sample(sample, context.derived.room.sample)


def _in_time(sample: JointState, context: StepContext) -> bool:
    return 0.0 <= (context.now_ns - sample.t_ns) * 1e-9 <= context.settings.limits.joint_timeout_s


def fill_sample(sample: JointState, values: FloatArray) -> bool:
    """Whether all that a sample tells is of every joint; into ``values`` (4, n), what it does not tell being zero."""
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


def _late(sample: JointState, context: StepContext) -> Reason:
    age_s, timeout_s = (context.now_ns - sample.t_ns) * 1e-9, context.settings.limits.joint_timeout_s
    what = (
        f"{age_s:.3f} s old, {timeout_s:g} s is allowed (safety.joint_timeout_s): the computer was busy (`uptime`), or "
        "the joint driver's clock or its bus is late"
        if age_s > 0.0
        else f"{-age_s:.6g} s in the future: check the joint driver's clock"
    )
    return Reason(
        "JOINT_STAMP", "hold", "", age_s, timeout_s if age_s > 0.0 else 0.0, "s",
        f"the stamp of joint sample {sample.seq} is {what}; then resume",
    )  # fmt: skip


def _wrong(sample: JointState, context: StepContext) -> Reason:
    wrong = _wrong_values(sample, context.settings.joint_names)
    if not wrong:
        return _jump(sample, context)
    return Reason(
        "JOINT_VALUE", "hold", "", None, None, "",
        f"joint sample {sample.seq} is refused: {wrong}: check the drive, its encoder and the joint driver; then "
        "resume",
    )  # fmt: skip


def _wrong_values(sample: JointState, names: tuple[str, ...]) -> str:
    """What cannot be in the values of a joint sample; empty where they may be right."""
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
    """That a joint cannot have come from its last position to this one in the time between."""
    block, settings = context.state.block, context.settings
    elapsed_s = (sample.t_ns - block.numbers.last_joints_ns) * 1e-9
    travel = np.abs(sample.positions - block.history_positions[(block.numbers.history_count - 1) % HISTORY])
    possible = settings.limits.velocity_max * (FASTEST * elapsed_s + STAMP_JITTER_S)
    j = int((travel / possible).argmax())
    name, value, limit = settings.joint_names[j], float(travel[j]), float(possible[j])
    return Reason(
        "JOINT_JUMP", "hold", name, value, limit, "",
        f"the position of joint {name} changed by {value:.4g} within {elapsed_s * 1e3:.3g} ms, {limit:.4g} is "
        "possible: check its encoder, cable and coupling; then resume",
    )  # fmt: skip


def observations_of(
    context: StepContext,
) -> tuple[tuple[tuple[int, CameraObservation], ...], tuple[tuple[int, Reason], ...]]:
    """New observations with the index of their camera, and the reasons of refused ones.

    A frame that is too old stops nothing: the law coasts as if it had been lost, and brakes in time. A camera that
    counts its frames anew is known by their stamps, which are checked; numbers alone are not trusted.
    """
    inputs = context.inputs
    cameras = context.derived.cameras
    newest: dict[int, tuple[int, int]] = {}  # of cameras with more than one frame
    timeout_s = context.derived.frame_timeout_s
    passed: list[tuple[int, CameraObservation]] = []
    refused: list[tuple[int, Reason]] = []
    for observation in inputs.observations:
        camera = cameras.get(observation.camera)
        if camera is None:
            continue
        estimate = context.state.cameras[camera]
        last_seq, accepted_ns = newest.get(camera) or (estimate.last_seq, estimate.accepted_ns)
        if observation.seq == last_seq:
            continue
        if observation.seq < last_seq and observation.t_shutter_ns <= accepted_ns:
            continue
        age_s = (inputs.now_ns - observation.t_shutter_ns) * 1e-9
        if not 0.0 <= age_s <= timeout_s:
            refused.append((camera, _refused_frame(observation, age_s, timeout_s)))
            continue
        wrong = _wrong_sights(observation, context.settings.cameras[camera])
        if wrong:
            refused.append((camera, _impossible_frame(observation, wrong)))
            continue
        newest[camera] = observation.seq, max(accepted_ns, observation.t_shutter_ns)
        passed.append((camera, observation))
    return tuple(passed), tuple(refused)


def _wrong_sights(observation: CameraObservation, camera: CameraSettings) -> str:
    """What cannot be in the markers of a frame; empty where they may be right."""
    count = len(observation.ids)
    if count > MAX_MARKERS:
        return f"it has {count} markers, {MAX_MARKERS} are allowed"
    pixels, covariances = observation.pixels, observation.covariances
    if pixels.shape != (count, 2) or covariances.shape != (count, 2, 2):
        return f"{count} markers have pixels {pixels.shape} and covariances {covariances.shape}"
    outside, vague = _first_wrong(
        np.ascontiguousarray(pixels, dtype=np.float64), np.ascontiguousarray(covariances, dtype=np.float64),
        float(camera.width), float(camera.height),
    )  # fmt: skip
    if outside >= 0:
        marker, at = observation.ids[outside], pixels[outside].tolist()
        return f"marker {marker} is at {at} in an image of {camera.width}x{camera.height}"
    if vague >= 0:
        return f"marker {observation.ids[vague]} has the covariance {covariances[vague].tolist()}"
    return ""


@kernel
def _first_wrong(pixels: FloatArray, covariances: FloatArray, width: float, height: float) -> tuple[int, int]:
    """The first of ``pixels`` (k, 2) farther from the image than its own size, and the first of ``covariances``
    (k, 2, 2) that is none; -1 where there is none such.
    """
    outside, vague = -1, -1
    for k in range(pixels.shape[0]):
        u, v = pixels[k, 0] / width - 0.5, pixels[k, 1] / height - 0.5
        if outside < 0 and not (abs(u) <= 1.5 and abs(v) <= 1.5):
            outside = k
        C = covariances[k]
        largest = max(abs(C[0, 0]), abs(C[0, 1]), abs(C[1, 0]), abs(C[1, 1]))
        numbers = math.isfinite(C[0, 0] + C[0, 1] + C[1, 0] + C[1, 1])
        known = numbers and largest <= LARGEST_SIGMA_PX * LARGEST_SIGMA_PX
        if vague < 0 and not (known and C[0, 0] > 0.0 and C[0, 0] * C[1, 1] - C[0, 1] * C[1, 0] > 0.0):
            vague = k
    return outside, vague


def _impossible_frame(observation: CameraObservation, wrong: str) -> Reason:
    return Reason(
        "CAMERA_VALUE", "hold", observation.camera, None, None, "",
        f"frame {observation.seq} of camera {observation.camera} is refused: {wrong}: check its detector and driver; "
        "then resume",
    )  # fmt: skip


def _refused_frame(observation: CameraObservation, age_s: float, timeout_s: float) -> Reason:
    name = observation.camera
    if age_s < 0.0:
        return Reason(
            "CAMERA_STAMP", "hold", name, age_s, 0.0, "s",
            f"the stamp of frame {observation.seq} of camera {name} is {-age_s:.6g} s in the future: check the "
            "camera's clock and its latency_s; then resume",
        )  # fmt: skip
    return Reason(
        "CAMERA_LATE", "info", name, age_s, timeout_s, "s",
        f"frame {observation.seq} of camera {name} came {age_s:.3f} s after its shutter, {timeout_s:g} s is allowed: "
        "not used; check the camera's connection and this computer's load; a camera that is always so late needs a "
        "larger safety.coast_s",
    )  # fmt: skip


def forget_travel(state: CoreState) -> None:
    """Begin anew: what the drives did of late was not what they were sent."""
    block = state.block
    block.missing_travel[:] = 0.0
    block.untold_travel[:] = 0.0
    block.numbers.followed = block.numbers.silence_known = 0
