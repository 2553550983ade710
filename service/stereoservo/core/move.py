"""Stage 5 of a core step: the joint velocity of the active motion source (hold, jog, joint move, control law,
calibration motion, …), and the table of all motion sources.

A motion source is a kind of state (`core.state.Source`) with what the stages must know of it, a `MotionSource`, found
by the type of the state in `MOTION_SOURCES`. To add one: a state of its own, a step, and a line in the table.

What friction takes of the velocity of a source that works on a goal is added to it. For each joint it is estimated from
small commands and the travel that they have brought: an integral action for a joint that stands, and none for one that
follows. Play and sag wind nothing up, since the encoder of a motor that turns through its play does move; for encoders
behind the play see `_bounds`.

A drive may answer commands a while later, and nobody may have said so. The delay of each joint is measured where it
sets out from rest: from when it was sent a small travel until its reading shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from stereoservo.core.block import LONGEST_DELAY_S
from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.goals.servoing import unplanned_report
from stereoservo.core.sources.calibration import trials_step
from stereoservo.core.sources.check import check_step
from stereoservo.core.sources.incidence import incidence_motion, incidence_report
from stereoservo.core.sources.joint_move import joint_move_progress, joint_move_step, joint_report
from stereoservo.core.sources.law import (
    Progress,
    activate_run,
    awaits_plan,
    progress_reasons,
    run_progress,
    servo_progress,
    servo_progress_reasons,
    servo_step,
)
from stereoservo.core.state import (
    AwaitingAcknowledgement,
    CalibrationMotion,
    CheckMotion,
    CoreState,
    Holding,
    IncidenceGoal,
    Jogging,
    JointMove,
    ServoGoal,
    Source,
)
from stereoservo.messages.goals import PlanReport
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel


def _rest(source: Source, context: StepContext) -> SourceOutput:
    """No motion."""
    return SourceOutput(np.zeros_like(context.q))


def _jog(source: Jogging, context: StepContext) -> SourceOutput:
    """The velocity that is asked for, until the dead man's lease runs out."""
    if context.now_ns >= source.until_ns:
        context.state.source = Holding()
        return SourceOutput(np.zeros_like(context.q))
    return SourceOutput(source.velocity)


def _nothing(source: Source) -> str:
    return ""


def _none(source: Source) -> None:
    return None


def _never(source: Source, context: StepContext) -> bool:
    return False


def _always(source: Source, context: StepContext) -> bool:
    return True


def _activate_joint_move(source: JointMove, context: StepContext) -> None:
    source.renew_lease(context.now_ns)


@dataclass(frozen=True)
class MotionSource:
    """What a kind of motion does, and what the stages of the core must know of it.

    ``name``: in the status. ``step``: its joint velocity. ``goal``: id of the goal it works on, '' where there is none;
    ``subject``: id that the status shows. ``label``: what ``goal_started`` names it, where it has no ``law``.
    ``leased``: it ends when its client does not renew the lease in time. ``by_images``: it works by the images, so that
    a frame with an impossible stamp stops the arm. ``runs_law``: its set-points rest on the model: it pauses while
    cameras are found again, ends with a model that is suspect, and no new model is taken meanwhile. ``measures``: it
    measures at poses, and ends with the event ``calibration_aborted``. ``acknowledge_s``: time in which a client has to
    acknowledge that its goal is reached, None: nobody has to. ``activate``: as it begins.
    ``waits``: for its plan, or for its client, so that `execute_goals` has to look after it. ``report``: of a goal that
    has no plan. ``progress``: share that is done and seconds left. ``progress_reasons``: why
    it is slow or stuck, beside the reasons of this step.
    """

    name: str
    step: Callable[[Any, StepContext], SourceOutput]
    goal: Callable[[Any], str] = _nothing
    subject: Callable[[Any], str] = _nothing
    law: Callable[[Any], str] = _nothing
    label: str = ""
    leased: bool = False
    by_images: bool = False
    runs_law: bool = False
    measures: bool = False
    acknowledge_s: Callable[[Any], float | None] = _none
    activate: Callable[[Any, StepContext], None] | None = None
    waits: Callable[[Any, StepContext], bool] = _never
    report: Callable[[Any, StepContext], PlanReport] | None = None
    progress: Callable[[Any, StepContext], Progress] | None = None
    progress_reasons: Callable[[Any, StepContext, tuple[Reason, ...]], tuple[Reason, ...]] | None = None


_id, _goal_id = attrgetter("id"), attrgetter("goal.id")

MOTION_SOURCES: dict[type[Any], MotionSource] = {
    Holding: MotionSource("hold", _rest),
    AwaitingAcknowledgement: MotionSource(
        "acknowledge", _rest, subject=_id, acknowledge_s=attrgetter("acknowledge_s"), waits=_always
    ),
    Jogging: MotionSource("jog", _jog),
    JointMove: MotionSource(
        "joints", joint_move_step, goal=_id, subject=_id, label="joints", leased=True,
        acknowledge_s=attrgetter("acknowledge_s"), activate=_activate_joint_move, report=joint_report,
        progress=joint_move_progress,
    ),
    ServoGoal: MotionSource(
        "law", servo_step, goal=_goal_id, subject=_goal_id, law=attrgetter("law"), leased=True, by_images=True,
        runs_law=True, acknowledge_s=attrgetter("goal.acknowledge_s"), activate=activate_run,
        waits=awaits_plan, report=unplanned_report, progress=servo_progress, progress_reasons=servo_progress_reasons,
    ),
    IncidenceGoal: MotionSource(
        "law", incidence_motion, goal=_goal_id, subject=_goal_id, label="incidence", leased=True, by_images=True,
        runs_law=True, acknowledge_s=attrgetter("goal.acknowledge_s"), activate=activate_run, report=incidence_report,
        progress=run_progress, progress_reasons=progress_reasons,
    ),
    CalibrationMotion: MotionSource(
        "calibrate", trials_step, goal=_id, subject=_id, leased=True, by_images=True, measures=True
    ),
    CheckMotion: MotionSource(
        "check", check_step, goal=_id, subject=_id, leased=True, by_images=True, measures=True
    ),
}  # fmt: skip


def goal_of(source: Source) -> str:
    """Id of the goal that a source works on, or ''."""
    return MOTION_SOURCES[type(source)].goal(source)


def paused(state: CoreState) -> bool:
    """Whether the active source must wait: in hold, after a stop, and a law while cameras are found again."""
    return (
        state.held
        or state.stopped
        or (state.reanchoring is not None and MOTION_SOURCES[type(state.source)].runs_law)
    )


def move(context: StepContext) -> SourceOutput:
    """The active source's output; no motion while it is paused, and outside ACTIVE, where `execute_goals` ends it."""
    state, newest_ns = context.state, 0
    for estimate in state.cameras:
        newest_ns = max(newest_ns, estimate.accepted_ns)
    context.features_ns, context.paused = newest_ns, paused(state)
    if context.paused or state.lifecycle != Lifecycle.ACTIVE:
        state.friction_of = ""
        return _foreseen(SourceOutput(np.zeros_like(context.q)), context)
    kind = MOTION_SOURCES[type(state.source)]
    goal = kind.goal(state.source)
    return _foreseen(compensate_friction(kind.step(state.source, context), goal, context), context)


def _foreseen(output: SourceOutput, context: StepContext) -> SourceOutput:
    """The output; the safety stage is told where late drives will have their joints before they obey it."""
    positions = np.empty(context.q.size)
    foresee(context.state.block.record, output.velocity, context.q, positions)
    context.outermost = positions
    return output


@kernel
def foresee(block: Record, velocity: FloatArray, q: FloatArray, positions: FloatArray) -> None:
    """Into ``positions`` (n,), where joints at ``q`` (n,) are, or will be before they obey ``velocity`` (n,), farthest
    towards where they go.
    """
    memory = block[0]
    for j in range(q.size):
        positions[j] = q[j]
        if memory.delay_s[j] == 0.0:
            continue
        ahead = q[j] + memory.delay_under_way[j]
        towards = velocity[j] if velocity[j] != 0.0 else memory.command[j]
        positions[j] = max(q[j], ahead) if towards > 0.0 else min(q[j], ahead)


# -- friction ---------------------------------------------------------------------------------------------------

RISE_S = 0.25
"""Time constant of the estimate; a joint that stands is sent its source's velocity once more in this time."""
LAG_S = 0.06
"""Of a healthy drive: its travel is compared over longer."""
MOST = {"revolute": 0.015, "prismatic": 0.0015}
"""[rad/s, m/s] Half as much again as the friction of a healthy joint; see `monitors.following.FRICTION`."""
SMALL = 2.0
"""Times ``MOST``, up to which a wanted velocity is small."""
LEAST_TRAVEL = {"revolute": 2e-4, "prismatic": 2e-5}
"""[rad, m] over which travel is compared, beside what lags, where encoders are fine."""
LEAST_STEPS = 5.0
"""Steps of the encoder likewise."""


def _bounds(
    kinds: tuple[str, ...], resolution: tuple[float, ...], inexact: bool
) -> tuple[FloatArray, FloatArray]:
    """The largest compensation (n,) [rad/s or m/s], and the least travel (n,) [rad or m] that is compared; not to be
    written to.

    Nothing is added to joints with coarse encoders where the model states errors of joint readings (``inexact``): play
    before the encoder looks like friction, and steps show too late that it is taken up; the joint would hunt.
    """
    most, travel = (np.array([value[kind] for kind in kinds]) for value in (MOST, LEAST_TRAVEL))
    if resolution:
        least = LEAST_STEPS * np.array(resolution)
        most = np.where((least > travel) & inexact, 0.0, most)
        travel = np.maximum(travel, least)
    return most, travel


def compensate_friction(output: SourceOutput, subject: str, context: StepContext) -> SourceOutput:
    """The output of the source that works on ``subject``, with what friction takes from each joint on top.

    It begins anew with another subject, is zero for a joint that is not to move, and rests while the features that the
    source needs are not fresh, and without a new joint sample.
    """
    state, settings = context.state, context.settings
    if not subject:
        state.friction_of = ""
        return output
    if state.friction_of != subject:
        state.friction_of, block = subject, state.block
        block.friction[:] = block.friction_sent[:] = block.friction_s[:] = 0.0
        block.friction_from[:] = context.q
    most, travel = friction_bounds(context)
    looks = context.ingested.joints is not None and (
        not output.needs_features
        or (context.now_ns - context.features_ns) * 1e-9 <= context.derived.features_fresh_s
    )
    velocity = np.empty(context.q.size)
    if not add_friction(
        state.block.record, output.velocity, context.q, most, travel, context.dt_s, looks, settings.watch_following,
        velocity,
    ):  # fmt: skip
        return output
    return at_velocity(output, velocity)


def at_velocity(output: SourceOutput, velocity: FloatArray) -> SourceOutput:
    """An output with another ``velocity`` (n,)."""
    return SourceOutput(
        velocity, output.needs_features, output.speed_scale, output.finished, output.reached, output.error_px,
        output.task_error, output.reasons,
    )  # fmt: skip


def friction_bounds(context: StepContext) -> tuple[FloatArray, FloatArray]:
    """`_bounds` by the settings and the model in use."""
    model, settings, known = context.state.model, context.settings, context.derived.friction_bounds
    if known is None or known[0] is not model:
        inexact = model is not None and model.joint_accuracy is not None
        found = _bounds(settings.joint_kinds, settings.resolution, inexact)
        known = context.derived.friction_bounds = model, *found
    return known[1], known[2]


@kernel
def add_friction(
    block: Record, wanted: FloatArray, q: FloatArray, most: FloatArray, travel: FloatArray, dt_s: float, looks: bool,
    late: bool, velocity: FloatArray,
) -> bool:  # fmt: skip
    """`_compensated` with what the drives obey now: the last command, or, where drives may be ``late``, another."""
    memory, n = block[0], q.size
    arrives = memory.delay_velocity[:n] if late else memory.command[:n]
    return _compensated(
        wanted, arrives, q, memory.friction[:n], memory.friction_from[:n], memory.friction_sent[:n],
        memory.friction_s[:n], most, travel, dt_s, looks, velocity,
    )  # fmt: skip


@kernel
def _compensated(
    wanted: FloatArray, arrives: FloatArray, q: FloatArray, friction: FloatArray, stood_at: FloatArray,
    sent: FloatArray, sent_s: FloatArray, most: FloatArray, travel: FloatArray, dt_s: float, looks: bool,
    velocity: FloatArray,
) -> bool:  # fmt: skip
    """The ``velocity`` (n,) ``wanted`` with the ``friction`` (n,) on top, and whether there is any.

    ``arrives`` (n,): the command that the drives obey now. ``friction``, ``stood_at``, ``sent`` and ``sent_s`` are
    brought up to date in place: where it ``looks``, the travel that was sent, once it is enough, is compared with what
    came of it, and begins again where it reverses. ``most``, ``travel``: of `_bounds`.
    """
    changed = False
    for j in range(wanted.size):
        velocity[j] = 0.0
        sent[j] += arrives[j] * dt_s
        sent_s[j] += dt_s
        if looks:
            valid = abs(wanted[j]) < SMALL * most[j] and wanted[j] * sent[j] >= 0.0
            enough = valid and abs(sent[j]) > travel[j] + LAG_S * abs(sent[j]) / sent_s[j]
            if enough:
                share = (q[j] - stood_at[j]) / sent[j]
                lost = max(0.0, min(1.0 - share, 1.0)) * sent[j] / sent_s[j]
                friction[j] += min(sent_s[j] / RISE_S, 1.0) * (lost - friction[j])
            if wanted[j] * friction[j] < 0.0:
                friction[j] *= 1.0 - min(dt_s / RISE_S, 1.0)
            friction[j] = max(-most[j], min(friction[j], most[j]))
            if enough or not valid:
                sent[j], sent_s[j], stood_at[j] = 0.0, 0.0, q[j]
        changed = changed or friction[j] != 0.0
        if wanted[j] != 0.0:
            velocity[j] = wanted[j] + friction[j]
    return changed


# -- late drives ------------------------------------------------------------------------------------------------

LEAST_S = 0.04
"""Friction and play look like less."""
ONSET_S = 0.1
"""In which a joint that sets out must be sent the travel that is timed; friction and play would count at less speed."""
ONSET_TRAVEL = 2.0
"""The travel that is timed, times that by which a reading answers."""
WAITS, RESTS, SETS_OUT = 0.0, 1.0, 2.0
"""Phases of a measurement."""
STEADY = 0.1
"""Share of a joint's command from which the one that arrives may differ in a motion that tells of the delay."""
PHASE, RESTED_S, STOOD_AT, SENT_BEFORE, SINCE_S, PASSED_S, TOWARDS = range(7)
"""Rows of `DriveDelays.onset`."""


@kernel
def measure_delays(
    command: FloatArray, q: FloatArray, answers: FloatArray, dt_s: float, sent: FloatArray, onset: FloatArray,
    samples: FloatArray, delay_s: FloatArray,
) -> None:  # fmt: skip
    """Account for ``dt_s`` [s] at the velocities ``command`` (n,), into the arrays of `DriveDelays`.

    ``answers`` (n,): by which the readings ``q`` (n,) answer.
    """
    for j in range(q.shape[0]):
        sent[j] += command[j] * dt_s
        travel = ONSET_TRAVEL * answers[j]
        onset[RESTED_S, j] = onset[RESTED_S, j] + dt_s if command[j] == 0.0 else 0.0
        if onset[PHASE, j] == WAITS and onset[RESTED_S, j] >= LONGEST_DELAY_S:
            onset[PHASE, j] = RESTS
        if onset[PHASE, j] == RESTS:
            if command[j] == 0.0:
                onset[STOOD_AT, j], onset[SENT_BEFORE, j] = q[j], sent[j]
                continue
            onset[PHASE, j], onset[SINCE_S, j], onset[PASSED_S, j] = SETS_OUT, 0.0, -1.0
            if command[j] * onset[TOWARDS, j] < 0.0 and math.isfinite(samples[-1, j]):
                onset[PHASE, j], onset[TOWARDS, j] = WAITS, command[j]  # through its play first
        if onset[PHASE, j] != SETS_OUT:
            continue
        onset[SINCE_S, j] += dt_s
        was_sent, made = sent[j] - onset[SENT_BEFORE, j], q[j] - onset[STOOD_AT, j]
        if onset[PASSED_S, j] >= 0.0:
            onset[PASSED_S, j] += dt_s
        elif abs(was_sent) >= travel:
            onset[PASSED_S, j] = 0.0
        late = onset[PASSED_S, j] > LONGEST_DELAY_S or (
            onset[PASSED_S, j] < 0.0 and onset[SINCE_S, j] > ONSET_S
        )
        if abs(made) >= travel or late:
            onset[PHASE, j], onset[TOWARDS, j] = WAITS, was_sent
            if not late and onset[PASSED_S, j] >= 0.0 and made * was_sent > 0.0:
                _push(samples[:, j], onset[PASSED_S, j])
                median_s = _median(samples[:, j])
                delay_s[j] = median_s if median_s >= LEAST_S else 0.0


@kernel
def _push(samples: FloatArray, newest: float) -> None:
    for k in range(samples.shape[0] - 1):
        samples[k] = samples[k + 1]
    samples[-1] = newest


@kernel
def _median(samples: FloatArray) -> float:
    """Of those that are numbers: the middle one, of two the greater."""
    known = np.sort(samples[np.isfinite(samples)])
    return float(known[known.size // 2])


@kernel
def account_travel(
    command: FloatArray, moved: FloatArray, told: bool, keep: float, dt_s: float, period_s: float, step: int,
    answers: FloatArray, delays: tuple[FloatArray, ...], samples: FloatArray, untold: FloatArray, missing: FloatArray,
) -> None:  # fmt: skip
    """Account for ``dt_s`` [s] of travel, sent as of now in ``untold`` and ``missing`` (n,), as of the delays in
    ``delays``: `DriveDelays`' ``delay_s``, ``sent``, ``past``, ``velocity``, ``under_way``, ``accounted``, ``missing``.

    ``moved`` (n,): of the readings since they were last ``told``; ``keep``: share of what is missing that is kept. A
    joint that makes, in steady motion, what has not arrived yet by its delay is less late: what it is goes into the
    ``samples``.
    """
    delay_s, sent, past, velocity, under_way, accounted, missing_late = delays
    rows = past.shape[0]
    for j in range(command.shape[0]):
        untold[j] += command[j] * dt_s
        past[step % rows, j] = sent[j]
        back = min(round(delay_s[j] / period_s), rows - 2)
        arrived = past[(step - back) % rows, j]
        under_way[j] = sent[j] - arrived
        if back == 0:
            velocity[j] = command[j]
        elif dt_s > 0.0:
            velocity[j] = (arrived - past[(step - back - 1) % rows, j]) / dt_s
        if not told:
            missing[j] *= keep
            missing_late[j] *= keep
            continue
        missing[j] = keep * (missing[j] + untold[j] - moved[j])
        missing_late[j] = keep * (missing_late[j] + arrived - accounted[j] - moved[j])
        untold[j], accounted[j] = 0.0, arrived
        speed, travel = abs(velocity[j]), ONSET_TRAVEL * answers[j]
        ahead = -math.copysign(missing_late[j], missing_late[j] * velocity[j])
        steady = abs(velocity[j] - command[j]) <= STEADY * speed and speed * ONSET_S >= travel
        if back > 0 and steady and ahead > LEAST_S * speed + travel:  # it was play that took so long
            _push(samples[:, j], max(delay_s[j] - ahead / speed, 0.0))
            delay_s[j] = samples[-1, j] if samples[-1, j] >= LEAST_S else 0.0
