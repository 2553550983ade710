"""The first six stages of a step in which nothing but the ordinary happens, as a few kernel calls around the law's own:
the arm rests, or a law with a kernel drives it. Each image is one call more.

The kernels call those of the stages, in their order, so that a step has the same bits by either way. Where one of them
finds anything that is to be told or decided, the block is put back as it was, and the stages do the step.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.core import monitor
from stereoservo.core.block import HISTORY, head_of
from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.estimate import fold_frame
from stereoservo.core.goals.marker_body import MIN_MARKERS
from stereoservo.core.ingest import new_sample, observations_of, take_sample, takes
from stereoservo.core.limit import FRESH, SafetyLimits, SafetyResult, limit, limit_velocity
from stereoservo.core.monitor import FOLLOWS, NOISE, QUIET, account_following, account_loads, judge_round
from stereoservo.core.move import add_friction, at_velocity, foresee, friction_bounds
from stereoservo.core.prediction import SUSPECT_FRAMES, present, round_complete
from stereoservo.core.sources.law import adaptive_gain, aim_at, measure_goal, output_of, show_face
from stereoservo.core.sources.progress import GOES_ON, account_run, error_of_run
from stereoservo.core.state import Holding, ServoGoal
from stereoservo.messages.status import Lifecycle, ModelReadiness
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import CameraObservation

Frames = tuple[tuple[int, CameraObservation], ...]
READY = (ModelReadiness.VALID, ModelReadiness.CANDIDATE)


def fast_path(context: StepContext, limits: SafetyLimits) -> tuple[SourceOutput, SafetyResult] | None:
    """What the stages up to `limit` come to in a step without requests, or None, and nothing has happened."""
    source, rounds = context.state.source, context.state.watching.rounds
    goal = source if isinstance(source, ServoGoal) else None
    if not (
        (type(source) is Holding if goal is None else _by_kernel(goal, context))
        and context.state.friction_of == ("" if goal is None else goal.goal.id)
        and _plain_state(context)
        and _plain_inputs(context)
    ):
        return None
    motion = None
    if _look(context, goal is not None):
        motion = _drive(goal, context) if goal is not None else SourceOutput(np.zeros(context.q.size))
    if motion is None:
        _put_back(context, rounds)
        return None
    context.plain = True
    return _command(motion, context, limits, goal is not None)


def _put_back(context: StepContext, rounds: int) -> None:
    """The state is as before `_look`."""
    state = context.state
    if context.looked:
        _copy(context.derived.room.spare, state.block.record, bool(context.observations))
    state.watching.rounds, state.watching.due, context.observations = rounds, False, ()


def _copy(record: Record, into: Record, frames: bool) -> None:
    """Copy what a step changes of a block's ``record`` (1,), with ``frames`` or without."""
    head_of(into)[:] = head_of(record)
    copy_large(record, into, frames)


def _plain_inputs(context: StepContext) -> bool:
    """Whether the inputs ask for nothing, and come in time."""
    inputs, last_ns = context.inputs, context.state.block.numbers.last_step_ns
    return not (
        inputs.stop
        or inputs.compiling
        or inputs.sent is not None
        or inputs.model_update is not None
        or inputs.driver_fault is not None
        or not inputs.driver_configured
        or not 0 <= (context.now_ns - last_ns) * 1e-9 <= context.derived.longest_gap_s
        or context.state.lifecycle is not (Lifecycle.ACTIVE if inputs.driver_active else Lifecycle.INACTIVE)
    )


def _plain_state(context: StepContext) -> bool:
    """Whether there is nothing that a stage would have to look after in this step."""
    state, derived = context.state, context.derived
    told, watching = derived.model_health, state.watching
    monitors = derived.monitors
    if monitors is None or monitors[0] is not monitor.MONITORS:
        known = all(entry.in_fast_path for entry in monitor.MONITORS)
        monitors = derived.monitors = monitor.MONITORS, known
    return (
        monitors[1]
        and derived.arrays is not None
        and told is not None
        and told[2][0].kind == "ok"
        and watching.verdict.kind == "ok"
        and state.readiness in READY
        and not (
            watching.due
            or state.held
            or state.stopped
            or state.queue
            or state.waiting
            or state.queued_until_ns
            or state.fault
        )
        and state.pending_model is None
        and state.ahead is None
        and state.teaching is None
        and state.reanchoring is None
        and state.target is None
        and state.refused_joints.reason is None
        and not any(state.mobile)
        and state.block.numbers.history_count > 0
        and not any(refused.reason for refused in state.refused_frames)
    )


def _by_kernel(goal: ServoGoal, context: StepContext) -> bool:
    """Whether a law with a kernel works on a ``goal`` that stands, which is in the workspace then."""
    if (
        context.derived.laws[goal.law].kernel is None
        or goal.stream is not None
        or goal.followed is not None
        or goal.points != "predicted"
        or context.state.lifecycle is not Lifecycle.ACTIVE
        or (goal.lease_s is not None and context.now_ns > goal.lease_until_ns)
    ):
        return False
    aim_at(context.derived.room, goal)
    return True


def _drive(goal: ServoGoal, context: StepContext) -> SourceOutput | None:
    """What the law makes of a ``goal``; None: it raises."""
    state, room, law = context.state, context.derived.room, context.derived.laws[goal.law]
    assert law.kernel is not None
    if law.components:
        show_face(goal, context)
    try:
        law.kernel(room.record, room.numbers.gain, context.dt_s, goal.jacobian)
    except Exception:  # the stages end its goal, with what it raises again
        return None
    return output_of(goal, context, law, error_of_run(state.block))


def _look(context: StepContext, aims: bool) -> bool:
    """Whether the stages before the motion find nothing; then the ``context`` has what they know."""
    state, room, sample = context.state, context.derived.room, new_sample(context)
    block, settings, watching, told = state.block, context.settings, state.watching, sample is not None
    t_ns, seq, efforts, following = (0, 0, False, False)
    if sample is not None:
        if not takes(sample, context):
            return False
        t_ns, seq = sample.t_ns, sample.seq
        efforts, following = sample.efforts is not None, sample.following_errors is not None
    frames = _plain_frames(context) if context.inputs.observations else ()
    if frames is None:
        return False
    context.observations, active = tuple([seen for _, seen in frames]), state.lifecycle is Lifecycle.ACTIVE
    _copy(block.record, room.spare, bool(frames))
    context.looked = True
    if not begin_step(block.record, room.record, told, t_ns, seq, active, bool(frames), context.q):
        return False
    for camera, seen in frames:
        fold_frame(camera, seen, context)
    found = end_step(
        block.record, room.record, told, t_ns, efforts, following, context.now_ns, context.dt_s, active,
        settings.watch_following, room.watches_loads, aims, bool(frames), watching.masked, watching.due, context.q,
    )  # fmt: skip
    if found == UNUSUAL:
        return False
    if found == WITH_ROUND:
        watching.due = False
        watching.rounds += 1
    context.arrays, context.prediction = context.derived.arrays, room.prediction
    context.weights, context.pixels, context.features_ns = room.weights, room.pixels, room.numbers.features_ns
    return True


def _plain_frames(context: StepContext) -> Frames | None:
    """The frames of a step, where all pass and no more is to be done with them than `fold_frame` and a round."""
    state, arrays, watching = context.state, context.derived.arrays, context.state.watching
    if (
        arrays is None
        or arrays.joint_accuracy is not None
        or state.model is None
        or state.model.shutter_offsets
        or watching.last != QUIET
        or watching.verdict != NOISE
    ):
        return None
    passed, refused = observations_of(context)
    return None if refused else passed


def _command(
    motion: SourceOutput, context: StepContext, limits: SafetyLimits, compensates: bool
) -> tuple[SourceOutput, SafetyResult]:
    """The motion with its friction, and the command within all limits."""
    state, settings, n = context.state, context.settings, context.q.size
    most, travel = friction_bounds(context)
    velocity, positions, limited = np.empty(n), np.empty(n), np.empty(n)
    added, quiet = command_within(
        state.block.record, context.derived.room.record, motion.velocity, context.q, compensates, most, travel,
        context.dt_s, settings.watch_following, context.now_ns, motion.needs_features,
        motion.speed_scale * settings.limits.speed_scale, limits.table, limits.bounds, limits.keep_outs,
        state.lifecycle is Lifecycle.ACTIVE, velocity, positions, limited, limits.found,
    )  # fmt: skip
    if added:
        motion = at_velocity(motion, velocity)
    if quiet:
        return motion, SafetyResult(motion.velocity, limited)
    context.outermost = positions
    return motion, limit(context, motion, limits)


@kernel
def begin_step(
    block: Record, room: Record, told: bool, t_ns: int, seq: int, active: bool, frames: bool, q: FloatArray
) -> bool:
    """Take the joint sample in the ``room``, where one is ``told``, before ``frames`` where there are any; False: there
    is something for the stages to do.
    """
    memory = block[0]
    if not frames and round_complete(block):
        return False
    if not take_sample(block, room, told, t_ns, seq, active, q):
        return False
    for c in range(memory.cameras):
        memory.sightings[c].fresh = False
    return True


UNUSUAL, WITHOUT_ROUND, WITH_ROUND = range(3)
"""What `end_step` has come to."""


@kernel
def end_step(
    block: Record, room: Record, told: bool, t_ns: int, efforts: bool, following: bool, now_ns: int, dt_s: float,
    active: bool, watches_following: bool, watches_loads: bool, aims: bool, frames: bool, masked: FloatArray, due: bool,
    q: FloatArray,
) -> int:  # fmt: skip
    """The other stages before the motion, for a goal in the ``room`` where a law ``aims`` at one; `UNUSUAL`: there is
    something for the stages to do; otherwise whether there was a round of frames.
    """
    memory, work = block[0], room[0]
    elapsed_s = (now_ns - memory.last_step_ns) * 1e-9
    present(block, room, q, now_ns)
    if told and t_ns > memory.loads_ns:
        _, beyond = account_loads(block, room, t_ns, efforts, following, active, False, False)
        if beyond and watches_loads:
            return UNUSUAL
    if watches_following:
        if account_following(block, room, q, elapsed_s) != FOLLOWS:
            return UNUSUAL
        if not active:
            memory.silence_known = 0
    found = WITHOUT_ROUND
    if frames and (due or round_complete(block)):
        looked_at, odd, any_masked = judge_round(block, room, now_ns, masked, 0)
        if odd or any_masked:
            return UNUSUAL
        found = WITH_ROUND if looked_at else found
    newest_ns = 0
    for c in range(memory.cameras):
        newest_ns = max(newest_ns, memory.estimates[c].accepted_ns)
        if memory.estimates[c].rejected_frames >= SUSPECT_FRAMES:
            return UNUSUAL
    memory.last_step_ns, work.features_ns, work.told = now_ns, newest_ns, told
    if not aims:
        return found
    seen = measure_goal(block, room, q)
    measured, error_px = work.measured != 0, work.error_px
    if (
        seen < MIN_MARKERS
        or account_run(
            block, measured, error_px, True, dt_s, work.tolerance_px, work.hold_frames, work.time_limit_s
        )
        != GOES_ON
    ):
        return UNUSUAL
    work.gain = adaptive_gain(
        work.gain_near, work.gain_far, work.gain_slope, error_px if measured else math.nan
    )
    return found


@kernel
def command_within(
    block: Record, room: Record, wanted: FloatArray, q: FloatArray, compensates: bool, most: FloatArray,
    travel: FloatArray, dt_s: float, late: bool, now_ns: int, needs_features: bool, speed_scale: float,
    table: FloatArray, bounds: FloatArray, keep_outs: FloatArray, active: bool, velocity: FloatArray,
    positions: FloatArray, limited: FloatArray, found: FloatArray,
) -> tuple[bool, bool]:  # fmt: skip
    """`add_friction` where it ``compensates``, `foresee`, `limit_velocity`; whether friction was added, and whether
    nothing is to be told: then ``limited`` is the command.
    """
    memory, work = block[0], room[0]
    feature_age_s = (now_ns - work.features_ns) * 1e-9
    added = False
    if compensates:
        looks = work.told != 0 and (not needs_features or feature_age_s <= bounds[FRESH])
        added = add_friction(block, wanted, q, most, travel, dt_s, looks, late, velocity)
    if not added:
        velocity[:] = wanted
    foresee(block, velocity, q, positions)
    command, joint_age_s = memory.command[: q.size], (now_ns - memory.last_joints_ns) * 1e-9
    if limit_velocity(
        velocity, positions, command, False, dt_s, joint_age_s, feature_age_s, needs_features, speed_scale, table,
        bounds, keep_outs, limited, found,
    ):  # fmt: skip
        return added, False
    for j in range(q.size):
        command[j] = limited[j] if active else 0.0
    return added, True


@kernel
def copy_large(block: Record, into: Record, frames: bool) -> None:
    """Copy the large arrays that a step changes of a ``block``, with ``frames`` or without."""
    memory, other = block[0], into[0]
    n, window, past = memory.joints, memory.window * memory.joints, memory.past * memory.joints
    other.history_ns[:] = memory.history_ns
    other.history_positions[: HISTORY * n] = memory.history_positions[: HISTORY * n]
    other.delay_past[:past] = memory.delay_past[:past]
    other.effort_excess[:window] = memory.effort_excess[:window]
    other.following_excess[:window] = memory.following_excess[:window]
    if not frames:
        return
    c = memory.cameras
    sights, rows = c * memory.markers, c * memory.rows
    other.innovation[: 2 * sights] = memory.innovation[: 2 * sights]
    other.sigma[:sights] = memory.sigma[:sights]
    other.seen_ns[:sights] = memory.seen_ns[:sights]
    other.frame_q[: c * n] = memory.frame_q[: c * n]
    other.frame_innovation[: 2 * rows] = memory.frame_innovation[: 2 * rows]
    other.frame_spread[: 4 * rows] = memory.frame_spread[: 4 * rows]
    other.frame_seen[:rows] = memory.frame_seen[:rows]
    other.frame_velocity[: 2 * rows] = memory.frame_velocity[: 2 * rows]
    other.settled_innovation[: 2 * sights] = memory.settled_innovation[: 2 * sights]
    other.settled_variance[:sights] = memory.settled_variance[:sights]
    other.settled_count[:sights] = memory.settled_count[:sights]
    other.settled_ns[:c] = memory.settled_ns[:c]
