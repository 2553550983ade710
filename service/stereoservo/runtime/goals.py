"""The life of goals: accepted, queued, begun, handed over, acknowledged, ended. Each accepted one ends exactly once."""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.commands import (
    AcknowledgeGoal,
    CancelGoal,
    Goal,
    IncidenceTarget,
    JointTarget,
    PlanReport,
    RenewGoal,
    Request,
    TaughtTarget,
    UpdateGoal,
)
from stereoservo.runtime.cycle import Lifecycle, ModelReadiness
from stereoservo.runtime.incidences import start_incidence
from stereoservo.runtime.joint_goals import joint_goal, joint_report
from stereoservo.runtime.motion import Motion, Present
from stereoservo.runtime.planned import (
    NotPlanned,
    begin_plan,
    go_on_planning,
    plan_report,
    unplanned_report,
)
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.servoing import place_now, start_servoing
from stereoservo.runtime.state import (
    Awaiting,
    Holding,
    Incidence,
    JointMove,
    LawRun,
    PlanJob,
    Servoing,
    Source,
    Visiting,
)
from stereoservo.runtime.streaming import update
from stereoservo.runtime.targets import Place

QUEUE_LENGTH = 16
AT_REST = 1e-3
"""[rad/s or m/s]"""
MOVED_SINCE = 0.01
"""Joint motion [rad or m] since a plan was begun from which on a way that is followed is planned anew."""

Accepted = tuple[str, PlanReport | None]


def goal_of(source: Source) -> str:
    """Id of the goal that a source works on, or ''."""
    if isinstance(source, LawRun):
        return source.goal.id
    return source.id if isinstance(source, JointMove | Visiting) else ""


# -- ends -----------------------------------------------------------------------------------------------------


def end_source(
    present: Present,
    kind: Literal["goal_aborted", "goal_cancelled", "goal_preempted"],
    reasons: tuple[Reason, ...],
    message: str,
) -> None:
    """End the active source with its one terminal event; the arm then holds."""
    source = present.state.source
    present.state.source = Holding()
    present.state.ahead = None
    if isinstance(source, Visiting):
        present.emit("calibration_aborted", id=source.id, message=message, reasons=reasons)
    elif goal_of(source):
        present.emit(kind, id=goal_of(source), message=message, reasons=reasons)


def end_queue(present: Present, reasons: tuple[Reason, ...], message: str) -> None:
    """Every queued goal ends with a terminal event too, and what is being planned is not begun."""
    state = present.state
    job = state.planning
    if job is not None and not job.source.goal.check:
        drop_plan(present, reasons, message)
    queued, state.queue = state.queue, []
    for goal in queued:
        present.emit("goal_cancelled", id=goal.id, message=message, reasons=reasons)


def drop_plan(present: Present, reasons: tuple[Reason, ...], message: str) -> None:
    """Stop planning: who waits for the answer is refused, a goal that was accepted already ends."""
    state = present.state
    job, state.planning = state.planning, None
    if job is None:
        return
    goal = job.source.goal
    if job.purpose == "reply":
        hint = f"{message} while it was planned"
        told = reasons or (Reason("CANCELLED", "info", goal.id, hint=hint),)
        present.emit("reply", request=job.request, accepted=False, id=goal.id, message=hint, reasons=told)
    elif job.purpose == "queue":
        present.emit("goal_cancelled", id=goal.id, message=message, reasons=reasons)


def may_move(present: Present) -> None:
    """Raises RefusalError where the arm may not move now."""
    state = present.state
    if state.lifecycle != Lifecycle.ACTIVE:
        raise RefusalError(
            "NOT_ACTIVE",
            f"the cell is {state.lifecycle}; "
            f"{'reset, then ' if state.lifecycle == Lifecycle.FAULT else ''}enable it first",
        )
    if state.stopped:
        raise RefusalError("STOPPED", "the cell was stopped; resume it first")
    if state.held:
        raise RefusalError("HELD", "the cell is held; resume it first")


# -- requests -------------------------------------------------------------------------------------------------


def run_goal(goal: Goal, request: Request, present: Present) -> Accepted | None:
    """Accept or refuse a goal: at once, or (None) once it is planned. Raises RefusalError."""
    state = present.state
    if not goal.check:
        may_move(present)
        if _known(goal.id, present):
            return "already accepted", None  # a client's retry
        busy = goal_of(state.source) or isinstance(state.source, Awaiting) or state.queue
        if goal.mode == "queue" and busy:
            return _enqueue(goal, present), None
    source, place = prepare(goal, present)
    if isinstance(source, Servoing) and source.pose_known and place is not None:
        state.planning = begin_plan(source, present, place, present.q, "reply", request.request)
        return None
    report = joint_report(source, present) if isinstance(source, JointMove) else unplanned_report(source)
    return _accept(goal, source, report, present)


def somebody_waits(present: Present) -> bool:
    """Whether a client waits for the answer to a goal that is being planned."""
    job = present.state.planning
    return job is not None and job.purpose == "reply"


def _known(goal_id: str, present: Present) -> bool:
    state = present.state
    planned = state.planning is not None and state.planning.source.goal.id == goal_id
    return goal_of(state.source) == goal_id or planned or any(goal.id == goal_id for goal in state.queue)


def _enqueue(goal: Goal, present: Present) -> str:
    state = present.state
    if len(state.queue) >= QUEUE_LENGTH:
        raise RefusalError(
            "QUEUE_FULL",
            f"{QUEUE_LENGTH} goals are queued",
            value=float(len(state.queue)),
            threshold=float(QUEUE_LENGTH),
        )
    prepare(goal, present)  # what cannot be at all is refused now; its way is planned when its turn comes
    state.queue.append(goal)
    return f"queued as number {len(state.queue)}; it is planned when its turn comes"


def _accept(goal: Goal, source: Source, report: PlanReport | None, present: Present) -> Accepted:
    if goal.check:
        try:
            may_move(present)
        except RefusalError as error:
            return f"the goal would be accepted, but now {error}", report
        return "the goal would be accepted", report
    may_move(present)
    preempt(present, f"goal {goal.id}")
    begin(source, present)
    return "accepted", report


def prepare(
    goal: Goal, present: Present, place: Place | None = None
) -> tuple[JointMove | Servoing | Incidence, Place | None]:
    """The source that a goal comes to, and the place that it sets out from, where that counts.

    ``place``: of the body, None: where it is. Raises RefusalError.
    """
    target = goal.target
    if isinstance(target, JointTarget):
        return joint_goal(goal, target, present), None
    if isinstance(target, TaughtTarget):
        raise RefusalError(
            "TAUGHT_UNRESOLVED", f"taught goal {target.name!r} was not looked up", subject=target.name
        )
    trusted_model(present)
    if place is None:
        place = place_now(present)
    if isinstance(target, IncidenceTarget):
        return start_incidence(goal, target, present, place), place
    return start_servoing(goal, target, present, place), place


def trusted_model(present: Present) -> int:
    """Epoch of the model in use. Raises RefusalError where there is none, or none that holds."""
    state = present.state
    if state.model is None or present.arrays is None or state.readiness == ModelReadiness.NONE:
        raise RefusalError("NO_MODEL", "the cell has no model yet: calibrate first")
    if state.readiness == ModelReadiness.SUSPECT:
        raise RefusalError(
            "MODEL_SUSPECT",
            "the model no longer explains the images: check the cameras and the markers, then calibrate",
        )
    return state.model.epoch


def preempt(present: Present, by: str) -> None:
    """End the active source in favour of another."""
    reason = Reason("PREEMPTED", "info", hint=f"preempted by {by}")
    end_source(present, "goal_preempted", (reason,), f"preempted by {by}")


def renew(command: RenewGoal, present: Present) -> str:
    """Renew a goal's lease. Raises RefusalError."""
    source = present.state.source
    if isinstance(source, LawRun | JointMove | Visiting) and goal_of(source) == command.id:
        source.renew_lease(present.now_ns)
        return "renewed"
    if _known(command.id, present):
        return "renewed"
    raise RefusalError(
        "NO_SUCH_GOAL",
        f"goal {command.id} is not active; active: {goal_of(source) or 'none'}",
        subject=command.id,
    )


def move_goal(command: UpdateGoal, present: Present) -> str:
    """Move the set-points of the active goal. Raises RefusalError."""
    source = present.state.source
    if goal_of(source) != command.id:
        raise RefusalError(
            "NO_SUCH_GOAL",
            f"goal {command.id} is not active; active: {goal_of(source) or 'none'}",
            subject=command.id,
        )
    if not isinstance(source, Servoing):
        raise RefusalError(
            "TARGET_CANNOT_MOVE",
            "only goals in set-points, points or displacements may be moved",
            subject=command.id,
        )
    return update(command, source, present, place_now(present), trusted_model(present))


def cancel(command: CancelGoal, present: Present) -> str:
    """Cancel a goal, active, planned or queued. Raises RefusalError."""
    state = present.state
    if goal_of(state.source) == command.id:
        end_source(present, "goal_cancelled", (), "cancelled by its client")
        return "cancelled"
    if isinstance(state.source, Awaiting) and state.source.id == command.id:
        state.source = Holding()
        end_queue(present, (), f"goal {command.id} was cancelled before it was acknowledged")
        return "cancelled: it is not waited for any more, and the queue is empty"
    job = state.planning
    if job is not None and job.source.goal.id == command.id and job.purpose != "ahead":
        drop_plan(present, (), "cancelled by its client")
        return "cancelled while it was planned"
    kept = [goal for goal in state.queue if goal.id != command.id]
    if len(kept) == len(state.queue):
        raise RefusalError(
            "NO_SUCH_GOAL",
            f"goal {command.id} is neither active nor queued; active: {goal_of(state.source) or 'none'}",
            subject=command.id,
        )
    state.queue = kept
    if job is not None and job.source.goal.id == command.id:
        state.planning = None
    state.ahead = None
    present.emit("goal_cancelled", id=command.id, message="cancelled while queued")
    return "cancelled"


def acknowledge(command: AcknowledgeGoal, present: Present) -> str:
    """A client says that a reached goal may be left. Raises RefusalError."""
    source = present.state.source
    if not isinstance(source, Awaiting) or source.id != command.id:
        waited_for = source.id if isinstance(source, Awaiting) else "none"
        raise RefusalError(
            "NOT_AWAITED",
            f"goal {command.id} does not wait to be acknowledged; waiting: {waited_for}",
            subject=command.id,
        )
    present.state.source = Holding()
    present.emit("goal_acknowledged", id=command.id, message="acknowledged")
    return "acknowledged"


# -- every step -----------------------------------------------------------------------------------------------


def begin(source: Source, present: Present) -> None:
    """Make ``source`` the active one."""
    if isinstance(source, LawRun):
        source.started_ns = present.now_ns
        source.last_frames = sum(e.frames for e in present.state.cameras)
    if isinstance(source, LawRun | JointMove):
        source.renew_lease(present.now_ns)
    present.state.source = source
    present.state.ahead = None
    law = (
        source.law
        if isinstance(source, Servoing)
        else "incidence"
        if isinstance(source, Incidence)
        else "joints"
    )
    present.emit("goal_started", id=goal_of(source), name=law)


def finish(motion: Motion, present: Present) -> None:
    """A source has finished: the arm holds, or waits to be acknowledged."""
    source = present.state.source
    wait_s = None
    if isinstance(source, LawRun):
        wait_s = source.goal.acknowledge_s
    elif isinstance(source, JointMove):
        wait_s = source.acknowledge_s
    if motion.reached and wait_s is not None:
        until_ns = present.now_ns + int(wait_s * 1e9)
        present.state.source = Awaiting(goal_of(source), wait_s, until_ns)
    else:
        present.state.source = Holding()


def go_on(present: Present) -> None:
    """One step's share of planning, and what follows from it: replies, the next goal, a hand-over."""
    state = present.state
    if isinstance(state.source, Awaiting) and present.now_ns > state.source.until_ns:
        _not_acknowledged(state.source, present)
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
    end_queue(present, (reason,), hint)


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
            message, _ = _accept(goal, job.source, report, present)
            present.emit(
                "reply", request=job.request, accepted=True, id=goal.id, message=message, plan=report
            )
        elif job.purpose == "queue":
            may_move(present)
            begin(job.source, present)
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
        present.emit("goal_aborted", id=goal.id, message=str(refusal), reasons=refusal.reasons)
    elif job.purpose == "again" and state.source is job.source:
        end_source(present, "goal_aborted", refusal.reasons, str(refusal))
    elif job.purpose == "ahead":
        state.not_ahead = goal.id  # planned again from where the arm comes to rest, and told then


def _next_plan(present: Present) -> None:
    """Plan what is to be planned without being asked: a way anew, the next goal, the one after this."""
    state = present.state
    source = state.source
    if isinstance(source, Servoing) and source.law == "trajectory" and source.plan is None:
        if bool((np.abs(state.command) < AT_REST).all()) and bool(
            (np.abs(state.velocities) < 10 * AT_REST).all()
        ):
            state.planning = begin_plan(source, present, place_now(present), present.q, "again", -1)
        return
    while state.queue and isinstance(source, Holding):
        goal = state.queue.pop(0)
        try:
            may_move(present)
            prepared, place = prepare(goal, present)
            if isinstance(prepared, Servoing) and prepared.pose_known and place is not None:
                state.planning = begin_plan(prepared, present, place, present.q, "queue", -1)
            else:
                if isinstance(prepared, JointMove):
                    joint_report(prepared, present)
                begin(prepared, present)
            return
        except RefusalError as refusal:
            present.emit("goal_aborted", id=goal.id, message=str(refusal), reasons=refusal.reasons)
    if state.queue and _blends(source) and state.ahead is None and state.not_ahead != state.queue[0].id:
        _plan_ahead(state.queue[0], source, present)


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
    if state.held or source.error_px is None or source.error_px > source.goal.blend_px:
        return
    state.queue.pop(0)
    message = f"handed over to goal {following.goal.id} at {source.error_px:.2f} px"
    present.emit("goal_reached", id=source.goal.id, message=message, error_px=source.error_px)
    begin(following, present)
