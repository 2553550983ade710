"""Stage 5 of a core step: the joint velocity of the active motion source (hold, jog, joint move, control law,
calibration motion, …), and the table of all motion sources.

A motion source is a kind of state (`core.state.Source`) with a description for the stages, a `MotionSource`, registered
by the type of the state in `MOTION_SOURCES`. To add one: a state of its own, a step, and a line in the table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from stereoservo.core.context import Motion, SourceOutput, StepContext
from stereoservo.core.goals.servoing import unplanned_report
from stereoservo.core.sources.calibration import trials_step
from stereoservo.core.sources.check import check_step
from stereoservo.core.sources.incidence import incidence_motion, incidence_report
from stereoservo.core.sources.joint_move import joint_move_progress, joint_move_step, joint_report
from stereoservo.core.sources.law import (
    Progress,
    activate_run,
    awaits_plan,
    drive,
    examine_run,
    examine_servo,
    run_progress,
    servo_progress,
    servo_step,
)
from stereoservo.core.sources.sweeps import sweeps_step
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
    SweepMotion,
)
from stereoservo.messages.goals import PlanReport
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import Record
from stereoservo.numerics.compilation import kernel


def _rest(source: Source, context: StepContext) -> None:
    """No motion: the velocity in the workspace is zero."""


def _jog(source: Jogging, context: StepContext) -> SourceOutput:
    """The requested velocity, until the lease of the dead man's switch expires."""
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
    """A kind of motion, as the stages of the core need to know it.

    ``name``: name in the status.
    ``step``: its joint velocity; None if the velocity is in the workspace (laws with a kernel) or there is no motion.
    ``goal``: id of the goal it works on, '' if there is none.
    ``subject``: id shown in the status.
    ``label``: name used in the event `goal_started` if the goal has no ``law``.
    ``leased``: it ends if its client does not renew the lease in time.
    ``by_images``: it is controlled by images, so a frame with an impossible stamp stops the arm.
    ``runs_law``: its set-points depend on the model. It pauses while cameras are relocalized, and ends if the model
    becomes suspect; no new model is put in use meanwhile.
    ``measures``: it measures at poses, and ends with the event ``calibration_aborted``.
    ``acknowledge_s``: time limit [s] for the client's acknowledgement of a reached goal; None if no acknowledgement is
    needed.
    ``activate``: called when it starts.
    ``waits``: whether it waits for its plan or its client, so that `execute_goals` has to examine it.
    ``report``: of a goal without a plan.
    ``progress``: completed fraction and remaining seconds.
    ``examine``: why it is slow or stuck, in addition to the reasons of this step; called a few times a second.
    """

    name: str
    step: Callable[[Any, StepContext], SourceOutput | None]
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
    examine: Callable[[Any, StepContext, tuple[Reason, ...]], list[Reason]] | None = None


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
        waits=awaits_plan, report=unplanned_report, progress=servo_progress, examine=examine_servo,
    ),
    IncidenceGoal: MotionSource(
        "law", incidence_motion, goal=_goal_id, subject=_goal_id, label="incidence", leased=True, by_images=True,
        runs_law=True, acknowledge_s=attrgetter("goal.acknowledge_s"), activate=activate_run, report=incidence_report,
        progress=run_progress, examine=examine_run,
    ),
    CalibrationMotion: MotionSource(
        "calibrate", trials_step, goal=_id, subject=_id, leased=True, by_images=True, measures=True
    ),
    SweepMotion: MotionSource(
        "calibrate", sweeps_step, goal=_id, subject=_id, leased=True, by_images=True, measures=True
    ),
    CheckMotion: MotionSource(
        "check", check_step, goal=_id, subject=_id, leased=True, by_images=True, measures=True
    ),
}  # fmt: skip


AT_REST: Motion = (_rest, "")
"""Of a source that does not move the arm."""


def goal_of(source: Source) -> str:
    """Id of the goal that a source works on, or ''."""
    return MOTION_SOURCES[type(source)].goal(source)


def paused(state: CoreState) -> bool:
    """Whether the active source must wait: in hold, after a stop, and for a law while cameras are relocalized."""
    return (
        state.held or state.stopped or (state.reanchoring is not None and MOTION_SOURCES[type(state.source)].runs_law)
    )


def arrange_motion(context: StepContext) -> None:
    """Write into the workspace what is constant until the active source changes: whether and how it moves the arm, but
    not its velocity. It does not move while it is paused, nor outside ACTIVE, where `execute_goals` ends it.
    """
    state, derived = context.state, context.derived
    work, source, scale = derived.workspace.numbers, state.source, context.settings.limits.speed_scale
    kind = MOTION_SOURCES[type(source)]
    moves = bool(work.active) and not work.paused
    by_law = moves and kind.runs_law
    derived.motion = (kind.step, kind.goal(source)) if moves else AT_REST
    work.rests, work.needs_features = not by_law, by_law
    work.speed_scale = source.goal.speed_scale * scale if by_law else scale  # type: ignore[union-attr]
    work.runs = moves and kind.examine is not None
    if work.runs:
        work.tolerance_px = source.tolerance_px  # type: ignore[union-attr]
    work.compensates = derived.motion[1] != ""


def move(context: StepContext) -> None:
    """Stage 5: write the velocity of the active source into the workspace."""
    state, derived = context.state, context.derived
    step, goal = derived.motion
    source: Any = state.source
    output = drive(source, context) if context.stays_active else step(source, context)
    if output is not None:
        _put_output(output, context)
    if state.friction_of != goal:
        state.friction_of = goal
        if goal:
            begin_friction(state.block.record, derived.workspace.record)


def _put_output(output: SourceOutput, context: StepContext) -> None:
    """Write the output of a motion source in Python into the workspace."""
    context.output, workspace = output, context.derived.workspace
    work = workspace.numbers
    workspace.velocity[:] = output.velocity
    work.rests, work.needs_features = False, output.needs_features
    work.speed_scale = output.speed_scale * context.settings.limits.speed_scale
    work.runs = work.runs and not output.finished


@kernel
def begin_friction(block: Record, workspace: Record) -> None:
    """Reset the friction estimates; travel is compared from the current joint positions."""
    memory, n = block[0], block[0].joints
    memory.friction[:n] = memory.friction_sent[:n] = memory.friction_s[:n] = 0.0
    memory.friction_from[:n] = workspace[0].q[:n]
