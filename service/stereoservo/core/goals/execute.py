"""Start and end of goals: activates a goal's motion source, ends it with exactly one terminal event, and cancels
queued goals and pending plans.
"""

from __future__ import annotations

from typing import Literal

from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.move import MOTION_SOURCES, goal_of
from stereoservo.core.state import (
    AwaitingAcknowledgement,
    Holding,
    Source,
)
from stereoservo.messages.reasons import Reason


def begin(source: Source, context: StepContext) -> None:
    """Make ``source`` the active one."""
    kind = MOTION_SOURCES[type(source)]
    if kind.activate is not None:
        kind.activate(source, context)
    drop_lookahead_plan(context)
    context.state.source = source
    context.emit("goal_started", id=kind.goal(source), name=kind.law(source) or kind.label)


def finish(motion: SourceOutput, context: StepContext) -> None:
    """End a source that has finished: the arm holds, or waits for the acknowledgement."""
    source = context.state.source
    wait_s = MOTION_SOURCES[type(source)].acknowledge_s(source)
    drop_lookahead_plan(context)
    if motion.reached and wait_s is not None:
        until_ns = context.now_ns + int(wait_s * 1e9)
        context.state.source = AwaitingAcknowledgement(goal_of(source), wait_s, until_ns)
        return
    context.state.source = Holding()
    if wait_s is not None:
        hint = f"goal {goal_of(source)} was not reached, nothing is there to acknowledge: send it and the queue again"
        end_followers(context, goal_of(source), (Reason("NOT_REACHED", "hold", goal_of(source), hint=hint),))


def preempt(context: StepContext, by: str) -> None:
    """End the active source in favour of another."""
    reason = Reason("PREEMPTED", "info", hint=f"preempted by {by}")
    end_source(context, "goal_preempted", (reason,), f"preempted by {by}")


def end_source(
    context: StepContext,
    kind: Literal["goal_aborted", "goal_cancelled", "goal_preempted"],
    reasons: tuple[Reason, ...],
    message: str,
) -> None:
    """End the active source with its one terminal event; the arm then holds."""
    source = context.state.source
    context.state.source = Holding()
    drop_lookahead_plan(context)
    if MOTION_SOURCES[type(source)].measures:
        context.emit("calibration_aborted", id=goal_of(source), message=message, reasons=reasons)
    elif goal_of(source):
        context.emit(kind, id=goal_of(source), message=message, reasons=reasons)
    if awaits_client(source):
        end_followers(context, MOTION_SOURCES[type(source)].subject(source), reasons)


def awaits_client(source: Source) -> bool:
    """Whether the goals queued behind ``source`` may start only once a client has acknowledged it."""
    return MOTION_SOURCES[type(source)].acknowledge_s(source) is not None


def end_followers(context: StepContext, ended: str, reasons: tuple[Reason, ...]) -> None:
    """End the queue behind goal ``ended``, which a client was to acknowledge."""
    cancel_queue(context, reasons, f"goal {ended} ended before it was acknowledged")


def drop_lookahead_plan(context: StepContext) -> None:
    """Discard plans made for the active source, or from where it ends."""
    state = context.state
    state.ahead = None
    if state.planning is not None and state.planning.purpose in ("ahead", "again"):
        state.planning = None


def end_queue(context: StepContext, reasons: tuple[Reason, ...], message: str) -> None:
    """End every queued goal with a terminal event, too; a goal that is being planned is not started."""
    job = context.state.planning
    if job is not None and not job.goal.check:
        drop_plan(context, reasons, message)
    cancel_queue(context, reasons, message)


def cancel_queue(context: StepContext, reasons: tuple[Reason, ...], message: str) -> None:
    """End every queued goal, also the one that is being planned; clients that wait for an answer are not affected."""
    state = context.state
    if state.planning is not None and state.planning.purpose == "queue":
        drop_plan(context, reasons, message)
    queued, state.queue = state.queue, []
    state.queued_until_ns = {}
    for goal in queued:
        context.emit("goal_cancelled", id=goal.id, message=message, reasons=reasons)


def drop_plan(context: StepContext, reasons: tuple[Reason, ...], message: str) -> None:
    """Stop planning: a client that waits for the answer is refused; a goal that was accepted already ends."""
    state = context.state
    job, state.planning = state.planning, None
    if job is None:
        return
    goal = job.goal
    if job.purpose in ("reply", "enqueue"):
        hint = f"{message} while it was planned"
        given = reasons or (Reason("CANCELLED", "info", goal.id, hint=hint),)
        context.emit("reply", request=job.request, accepted=False, id=goal.id, message=hint, reasons=given)
    elif job.purpose == "queue":
        context.emit("goal_cancelled", id=goal.id, message=message, reasons=reasons)
