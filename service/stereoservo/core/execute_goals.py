"""Stage 4 of a core step: does one slice of path planning, starts the next goal of the queue or blends into it, and
ends goals whose client's lease has expired or whose drives are not active.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.goals.accept import (
    accept,
    answer_waiting,
    enqueue,
    report_without_plan,
    require_motion_allowed,
)
from stereoservo.core.goals.execute import (
    begin,
    cancel_queue,
    end_followers,
    end_queue,
    end_source,
)
from stereoservo.core.goals.marker_body import BodyState, place_now
from stereoservo.core.goals.plan import (
    plan_again,
    plan_report,
    plan_slice,
    prepare,
    set_up,
    trusted_model,
)
from stereoservo.core.move import MOTION_SOURCES
from stereoservo.core.sources.law import awaits_plan
from stereoservo.core.sources.progress import error_of_run
from stereoservo.core.state import (
    AwaitingAcknowledgement,
    Holding,
    PlanJob,
    ServoGoal,
    Source,
)
from stereoservo.messages.goals import Goal, PlanReport
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle

AT_REST = 1e-3
"""Joint command below which the arm counts as at rest [rad/s or m/s]."""
MOVED_SINCE = 0.01
"""Joint motion [rad or m] since planning began, above which a path that is followed is planned again."""


def execute_goals(context: StepContext) -> Source:
    """Do one step's share of planning, and handle the next goal, leases and the lifecycle; returns the
    active source.
    """
    state = context.state
    if (
        state.planning is not None
        or state.queue
        or state.queued_until_ns
        or state.ahead is not None
        or state.waiting
        or MOTION_SOURCES[type(state.source)].waits(state.source, context)
    ):
        _advance(context)
        answer_waiting(context)
    if state.lifecycle != Lifecycle.ACTIVE:
        if not isinstance(state.source, Holding):
            _end_inactive(context)
    elif MOTION_SOURCES[type(state.source)].leased:
        _watch_lease(state.source, context)
    return state.source


def _end_inactive(context: StepContext) -> None:
    """End every goal, active or queued: no motion is allowed outside ACTIVE."""
    state = context.state
    reason = Reason("NOT_ACTIVE", "hold", hint=f"the cell became {state.lifecycle}")
    end_source(context, "goal_aborted", (reason, *state.fault), f"the cell became {state.lifecycle}")
    end_queue(context, (reason,), f"the cell became {state.lifecycle}")


def _watch_lease(source: Any, context: StepContext) -> None:
    """End a source whose client has not renewed its lease in time."""
    if source.lease_s is None or context.now_ns <= source.lease_until_ns:
        return
    hint = "the client did not renew its lease: is it alive?"
    reason = Reason("LEASE_EXPIRED", "hold", "", source.lease_s, source.lease_s, "s", hint)
    end_source(context, "goal_aborted", (reason,), reason.hint)


def _advance(context: StepContext) -> None:
    """Do one step's share of planning and act on its result: replies, the next goal, blending into it."""
    state = context.state
    if isinstance(state.source, AwaitingAcknowledgement) and context.now_ns > state.source.until_ns:
        _not_acknowledged(state.source, context)
    _watch_leases(context)
    if state.planning is not None:
        _plan_on(state.planning, context)
    if state.planning is None:
        _next_plan(context)
    _blend_into_next(context)


def _not_acknowledged(source: AwaitingAcknowledgement, context: StepContext) -> None:
    hint = f"goal {source.id} was reached and not acknowledged in {source.acknowledge_s:g} s: is its client alive?"
    reason = Reason("NOT_ACKNOWLEDGED", "hold", source.id, source.acknowledge_s, source.acknowledge_s, "s", hint)
    context.state.source = Holding()
    context.emit("warning", id=source.id, message=hint, reasons=(reason,))
    cancel_queue(context, (reason,), hint)


def _watch_leases(context: StepContext) -> None:
    """End queued goals whose lease has expired."""
    state = context.state
    expired = [i for i, until_ns in state.queued_until_ns.items() if context.now_ns > until_ns]
    for goal in [goal for goal in state.queue if goal.id in expired]:
        state.queue.remove(goal)
        del state.queued_until_ns[goal.id]
        hint = "the client did not renew its lease while the goal was queued: is it alive?"
        reason = Reason("LEASE_EXPIRED", "hold", goal.id, goal.lease_s, goal.lease_s, "s", hint)
        if state.ahead is not None and state.ahead.goal.id == goal.id:
            state.ahead = None
        context.emit("goal_aborted", id=goal.id, message=hint, reasons=(reason,))
        if goal.acknowledge_s is not None:
            end_followers(context, goal.id, (reason,))
            return


def _plan_on(job: PlanJob, context: StepContext) -> None:
    state = context.state
    if job.resolution is not None and job.goal.id in context.goals_read:
        return  # a large body: computing its markers' faces took this step's time
    try:
        trusted_model(context)
        if job.planning is None:
            if not set_up(job, context) or job.planning is not None:
                return
        elif not plan_slice(job):
            return
        report = _report_of(job, context)
    except RefusalError as refusal:
        state.planning = None
        _refused(job, refusal, context)
        return
    state.planning = None
    _end_job(job, report, context)


def _report_of(job: PlanJob, context: StepContext) -> PlanReport | None:
    """The plan of a resolved goal; for a goal that is not planned, the report without a plan. Raises RefusalError."""
    assert job.source is not None
    if job.planning is not None:
        return plan_report(job, context)
    return None if job.purpose == "enqueue" else report_without_plan(job.source, context)


def _end_job(job: PlanJob, report: PlanReport | None, context: StepContext) -> None:
    """Act on the result of a planning job according to its purpose."""
    state, source, goal = context.state, job.source, job.goal
    assert source is not None
    try:
        message = ""
        if job.purpose == "enqueue":
            message = enqueue(goal, context)
        elif job.purpose == "reply":
            _fresh(job, source, context)
            message, _ = accept(goal, source, report, context)
        elif job.purpose == "queue":
            begin(source, context)  # in hold, too: it waits for resume
        elif job.purpose == "ahead" and source.pose_known:
            state.ahead = source
        elif job.purpose == "ahead":
            state.not_ahead = goal.id
    except RefusalError as refusal:
        _refused(job, refusal, context)
        return
    if message:
        context.emit("reply", request=job.request, accepted=True, id=goal.id, message=message, plan=report)


def _fresh(job: PlanJob, source: ServoGoal, context: StepContext) -> None:
    """Discard a plan if the arm has moved since: a path that is followed must start where the arm rests, so it is
    planned again at rest.
    """
    if source.plan is not None and bool((np.abs(context.q - job.joints) > MOVED_SINCE).any()):
        source.plan = None


def _refused(job: PlanJob, refusal: RefusalError, context: StepContext) -> None:
    goal, state = job.goal, context.state
    if job.purpose in ("reply", "enqueue"):
        context.emit(
            "reply",
            request=job.request,
            accepted=False,
            id=goal.id,
            message=str(refusal),
            reasons=refusal.reasons,
            plan=refusal.plan,
        )
    elif job.purpose == "queue":
        _not_begun(goal, refusal, context)
    elif job.purpose == "again" and state.source is job.source:
        end_source(context, "goal_aborted", refusal.reasons, str(refusal))
    elif job.purpose == "ahead":
        state.not_ahead = goal.id  # planned again from where the arm comes to rest, and reported then


def _next_plan(context: StepContext) -> None:
    """Start the planning that needs no request: a path again, the next goal, the goal after the active one."""
    state = context.state
    source = state.source
    if state.reanchoring is not None:
        return
    if isinstance(source, ServoGoal) and awaits_plan(source, context):
        if bool((np.abs(state.block.command) < AT_REST).all()) and bool(
            (np.abs(state.block.velocities) < 10 * AT_REST).all()
        ):
            state.planning = plan_again(source, context)
        return
    if state.held:
        return
    if state.queue and isinstance(source, Holding):
        goal = state.queue.pop(0)
        state.queued_until_ns.pop(goal.id, None)
        try:
            require_motion_allowed(context)
            prepared = prepare(goal, context, "queue")
            if isinstance(prepared, PlanJob):
                state.planning = prepared
            else:
                report_without_plan(prepared, context)
                begin(prepared, context)
        except RefusalError as refusal:
            _not_begun(goal, refusal, context)
        return
    if state.queue and _blends(source) and state.ahead is None and state.not_ahead != state.queue[0].id:
        _plan_ahead(state.queue[0], source, context)


def _not_begun(goal: Goal, refusal: RefusalError, context: StepContext) -> None:
    """A queued goal cannot be executed from the arm's current position."""
    context.emit("goal_aborted", id=goal.id, message=str(refusal), reasons=refusal.reasons)
    if goal.acknowledge_s is not None:
        end_followers(context, goal.id, refusal.reasons)


def _blends(source: Source) -> bool:
    return (
        isinstance(source, ServoGoal)
        and source.goal.blend_px is not None
        and source.goal.acknowledge_s is None
        and source.pose_known
        and source.stream is None
    )


def _plan_ahead(goal: Goal, source: Source, context: StepContext) -> None:
    """Plan the next goal from where the active one ends, while the arm still moves there."""
    state = context.state
    assert isinstance(source, ServoGoal)
    if source.goal_joints is None:
        state.not_ahead = goal.id
        return
    now = place_now(context)
    place = BodyState(now.settings, now.arrays, source.target_points, now.operators, now.faces)
    try:
        prepared = prepare(goal, context, "ahead", place=place, joints=source.goal_joints)
    except RefusalError:
        state.not_ahead = goal.id  # reported when its turn comes
        return
    if isinstance(prepared, PlanJob):
        state.planning = prepared
    else:
        state.not_ahead = goal.id


def _blend_into_next(context: StepContext) -> None:
    """Leave a goal that blends into the next without a stop, once it is close enough and the next path is planned."""
    state = context.state
    source, following = state.source, state.ahead
    if following is None or not isinstance(source, ServoGoal) or source.goal.blend_px is None:
        return
    if not state.queue or state.queue[0].id != following.goal.id:
        state.ahead = None
        return
    error_px = error_of_run(state.block)
    if state.held or state.reanchoring is not None or error_px is None or error_px > source.goal.blend_px:
        return
    state.queue.pop(0)
    state.queued_until_ns.pop(following.goal.id, None)
    message = f"handed over to goal {following.goal.id} at {error_px:.2f} px"
    context.emit("goal_reached", id=source.goal.id, message=message, error_px=error_px)
    begin(following, context)
