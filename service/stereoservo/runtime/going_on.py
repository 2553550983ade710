"""What happens to goals step by step: planned a slice at a time, begun, blended into the next, waited for, finished."""

from __future__ import annotations

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.commands import Goal
from stereoservo.runtime.ending import (
    cancel_queue,
    end_followers,
    end_source,
    forget_ahead,
    goal_of,
    may_move,
)
from stereoservo.runtime.goals import accept, begin, prepare, trusted_model
from stereoservo.runtime.joint_goals import joint_report
from stereoservo.runtime.motion import Motion, Present
from stereoservo.runtime.planned import NotPlanned, begin_plan, go_on_planning, plan_report
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.servoing import place_now
from stereoservo.runtime.state import Awaiting, Holding, JointMove, LawRun, PlanJob, Servoing, Source
from stereoservo.runtime.target_checks import Place

AT_REST = 1e-3
"""[rad/s or m/s]"""
MOVED_SINCE = 0.01
"""Joint motion [rad or m] since a plan was begun from which on a way that is followed is planned anew."""


def finish(motion: Motion, present: Present) -> None:
    """A source has finished: the arm holds, or waits to be acknowledged."""
    source = present.state.source
    wait_s = None
    if isinstance(source, LawRun):
        wait_s = source.goal.acknowledge_s
    elif isinstance(source, JointMove):
        wait_s = source.acknowledge_s
    forget_ahead(present)
    if motion.reached and wait_s is not None:
        until_ns = present.now_ns + int(wait_s * 1e9)
        present.state.source = Awaiting(goal_of(source), wait_s, until_ns)
        return
    present.state.source = Holding()
    if wait_s is not None:
        hint = f"goal {goal_of(source)} was not reached, nothing is there to acknowledge: send it and the queue again"
        end_followers(present, source, (Reason("NOT_REACHED", "hold", goal_of(source), hint=hint),))


def go_on(present: Present) -> None:
    """One step's share of planning, and what follows from it: replies, the next goal, a hand-over."""
    state = present.state
    if isinstance(state.source, Awaiting) and present.now_ns > state.source.until_ns:
        _not_acknowledged(state.source, present)
    _watch_leases(present)
    if state.planning is not None:
        _plan_on(state.planning, present)
    if state.planning is None:
        _next_plan(present)
    _hand_over(present)


def _not_acknowledged(source: Awaiting, present: Present) -> None:
    hint = f"goal {source.id} was reached and not acknowledged in {source.acknowledge_s:g} s: is its client alive?"
    reason = Reason(
        "NOT_ACKNOWLEDGED", "hold", source.id, source.acknowledge_s, source.acknowledge_s, "s", hint
    )
    present.state.source = Holding()
    present.emit("warning", id=source.id, message=hint, reasons=(reason,))
    cancel_queue(present, (reason,), hint)


def _watch_leases(present: Present) -> None:
    """A goal whose client dies while it is queued does not begin."""
    state = present.state
    expired = [i for i, until_ns in state.queued_until_ns.items() if present.now_ns > until_ns]
    for goal in [goal for goal in state.queue if goal.id in expired]:
        state.queue.remove(goal)
        del state.queued_until_ns[goal.id]
        hint = "the client did not renew its lease while the goal was queued: is it alive?"
        reason = Reason("LEASE_EXPIRED", "hold", goal.id, goal.lease_s, goal.lease_s, "s", hint)
        if state.ahead is not None and state.ahead.goal.id == goal.id:
            state.ahead = None
        present.emit("goal_aborted", id=goal.id, message=hint, reasons=(reason,))
        if goal.acknowledge_s is not None:
            end_followers(present, goal, (reason,))
            return


def _plan_on(job: PlanJob, present: Present) -> None:
    state = present.state
    if not go_on_planning(job):
        return
    state.planning = None
    goal = job.source.goal
    try:
        trusted_model(present)
        report = plan_report(job, present)
        if job.purpose == "reply":
            _fresh(job, present)
            message, _ = accept(goal, job.source, report, present)
            present.emit(
                "reply", request=job.request, accepted=True, id=goal.id, message=message, plan=report
            )
        elif job.purpose == "queue":
            begin(job.source, present)  # in hold, too: it waits to be resumed
        elif job.purpose == "ahead":
            state.ahead = job.source
    except RefusalError as refusal:
        _refused(job, refusal, present)


def _fresh(job: PlanJob, present: Present) -> None:
    """A way that is followed begins where the arm rests: one that has moved since plans anew when it rests."""
    if job.source.plan is not None and bool((np.abs(present.q - job.joints) > MOVED_SINCE).any()):
        job.source.plan = None


def _refused(job: PlanJob, refusal: RefusalError, present: Present) -> None:
    goal, state = job.source.goal, present.state
    if job.purpose == "reply":
        present.emit(
            "reply", request=job.request, accepted=False, id=goal.id, message=str(refusal), reasons=refusal.reasons,
            plan=refusal.plan if isinstance(refusal, NotPlanned) else None,
        )  # fmt: skip
    elif job.purpose == "queue":
        _not_begun(goal, refusal, present)
    elif job.purpose == "again" and state.source is job.source:
        end_source(present, "goal_aborted", refusal.reasons, str(refusal))
    elif job.purpose == "ahead":
        state.not_ahead = goal.id  # planned again from where the arm comes to rest, and told then


def _next_plan(present: Present) -> None:
    """Plan what is to be planned without being asked: a way anew, the next goal, the one after this."""
    state = present.state
    source = state.source
    if state.reanchoring is not None:
        return
    if isinstance(source, Servoing) and source.law == "trajectory" and source.plan is None:
        if bool((np.abs(state.command) < AT_REST).all()) and bool(
            (np.abs(state.velocities) < 10 * AT_REST).all()
        ):
            state.planning = begin_plan(source, present, place_now(present), present.q, "again", -1)
        return
    if state.held:
        return
    if state.queue and isinstance(source, Holding):
        goal = state.queue.pop(0)
        state.queued_until_ns.pop(goal.id, None)
        try:
            may_move(present)
            prepared, place = prepare(goal, present)
            if isinstance(prepared, Servoing) and prepared.pose_known and place is not None:
                state.planning = begin_plan(prepared, present, place, present.q, "queue", -1)
            else:
                if isinstance(prepared, JointMove):
                    joint_report(prepared, present)
                begin(prepared, present)
        except RefusalError as refusal:
            _not_begun(goal, refusal, present)
        return
    if state.queue and _blends(source) and state.ahead is None and state.not_ahead != state.queue[0].id:
        _plan_ahead(state.queue[0], source, present)


def _not_begun(goal: Goal, refusal: RefusalError, present: Present) -> None:
    """A queued goal cannot be driven from where the arm is now."""
    present.emit("goal_aborted", id=goal.id, message=str(refusal), reasons=refusal.reasons)
    if goal.acknowledge_s is not None:
        end_followers(present, goal, refusal.reasons)


def _blends(source: Source) -> bool:
    return (
        isinstance(source, Servoing)
        and source.goal.blend_px is not None
        and source.goal.acknowledge_s is None
        and source.pose_known
        and source.stream is None
    )


def _plan_ahead(goal: Goal, source: Source, present: Present) -> None:
    """Plan the next goal from where this one ends, while the arm is still on its way there."""
    state = present.state
    assert isinstance(source, Servoing)
    if source.goal_joints is None:
        state.not_ahead = goal.id
        return
    now = place_now(present)
    place = Place(now.settings, now.arrays, source.target_points, now.operators, now.faces)
    try:
        prepared, _ = prepare(goal, present, place)
    except RefusalError:
        state.not_ahead = goal.id  # told when its turn comes
        return
    if isinstance(prepared, Servoing) and prepared.pose_known:
        state.planning = begin_plan(prepared, present, place, source.goal_joints, "ahead", -1)
    else:
        state.not_ahead = goal.id


def _hand_over(present: Present) -> None:
    """Leave a goal that blends into the next, near enough and with its way planned, without a stop."""
    state = present.state
    source, following = state.source, state.ahead
    if following is None or not isinstance(source, Servoing) or source.goal.blend_px is None:
        return
    if not state.queue or state.queue[0].id != following.goal.id:
        state.ahead = None
        return
    if (
        state.held
        or state.reanchoring is not None
        or source.error_px is None
        or source.error_px > source.goal.blend_px
    ):
        return
    state.queue.pop(0)
    state.queued_until_ns.pop(following.goal.id, None)
    message = f"handed over to goal {following.goal.id} at {source.error_px:.2f} px"
    present.emit("goal_reached", id=source.goal.id, message=message, error_px=source.error_px)
    begin(following, present)
