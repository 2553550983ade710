"""Handles clients' requests on goals (run, check, queue, renew the lease, move set-points, cancel, acknowledge):
accepts each, or refuses it with a reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Any, cast

import numpy as np

from stereoservo.core.context import RefusalError, StepContext, no_model
from stereoservo.core.goals.execute import (
    begin,
    drop_lookahead_plan,
    drop_plan,
    end_queue,
    end_source,
    preempt,
)
from stereoservo.core.goals.marker_body import place_now
from stereoservo.core.goals.plan import prepare, trusted_model
from stereoservo.core.goals.resolve import joint_index
from stereoservo.core.monitors import camera_relocalization
from stereoservo.core.monitors.camera_relocalization import refuse_while_moved
from stereoservo.core.monitors.moving_camera import refuse_pixels
from stereoservo.core.move import MOTION_SOURCES, goal_of
from stereoservo.core.sources.calibration import start_trials
from stereoservo.core.sources.check import start_check
from stereoservo.core.sources.joint_move import joint_move_to
from stereoservo.core.sources.streaming import update
from stereoservo.core.sources.sweeps import start_sweeps
from stereoservo.core.sources.teaching import start_teaching
from stereoservo.core.state import (
    AwaitingAcknowledgement,
    CheckMotion,
    Holding,
    Jogging,
    JointMove,
    Leased,
    PlanJob,
    ServoGoal,
    Source,
    TrialMotion,
)
from stereoservo.messages.goals import (
    AcknowledgeGoal,
    Calibrate,
    CancelGoal,
    Command,
    Disable,
    Enable,
    ExtendLeases,
    Goal,
    Hold,
    Home,
    Jog,
    JointTarget,
    OrderAuxiliary,
    PlanReport,
    ReanchorRefused,
    RenewGoal,
    Request,
    Reset,
    Resume,
    RunGoal,
    Teach,
    UpdateGoal,
)
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import Lifecycle, ModelReadiness

QUEUE_LENGTH = 16

Accepted = tuple[str, PlanReport | None]
"""The message of an accepted request, and the report of its plan."""

_IDS: dict[type[Any], Callable[[Any], str]] = {
    RunGoal: attrgetter("goal.id"),
    **dict.fromkeys((RenewGoal, CancelGoal, UpdateGoal, AcknowledgeGoal, Home, Calibrate), attrgetter("id")),
}
"""How to read the id of the goal that a command is about."""


def run_goal(goal: Goal, request: Request, context: StepContext) -> Accepted | None:
    """Accept or refuse a goal: immediately, or (None) once it is planned. Raises RefusalError."""
    state = context.state
    if not goal.check:
        require_motion_allowed(context)
        if _known(goal.id, context):
            return "already accepted", None  # a client's retry
        if any(camera is not None for camera in state.mobile):
            refuse_pixels(goal.target, state, context.settings)
        busy = MOTION_SOURCES[type(state.source)].subject(state.source) or state.queue
        if goal.mode == "queue" and busy:
            return _enqueue(goal, request.request, context)
    prepared = prepare(goal, context, "reply", request.request)
    if isinstance(prepared, PlanJob):
        state.planning = prepared
        return None
    return accept(goal, prepared, report_without_plan(prepared, context), context)


def require_motion_allowed(context: StepContext) -> None:
    """Raises RefusalError if the arm may not move now."""
    _require_powered(context)
    if context.state.held:
        raise RefusalError("HELD", "the cell is held; resume it first")


def _require_powered(context: StepContext) -> None:
    """Raises RefusalError if the drives are off, or were stopped."""
    state = context.state
    if state.lifecycle != Lifecycle.ACTIVE:
        raise RefusalError(
            "NOT_ACTIVE",
            f"the cell is {state.lifecycle}; "
            f"{'reset, then ' if state.lifecycle == Lifecycle.FAULT else ''}enable it first",
        )
    if state.stopped:
        raise RefusalError("STOPPED", "the cell was stopped; resume it first")


def report_without_plan(source: Source, context: StepContext) -> PlanReport | None:
    """The report of a source for which no path is planned. Raises RefusalError if it meets a keep-out."""
    report = MOTION_SOURCES[type(source)].report
    return None if report is None else report(source, context)


def planning_pending(context: StepContext) -> bool:
    """Whether a goal is being planned that a client waits for, or that has been accepted already."""
    job = context.state.planning
    return job is not None and job.purpose != "ahead"


def _known(goal_id: str, context: StepContext) -> bool:
    state = context.state
    job, source = state.planning, state.source
    planned = job is not None and not job.goal.check and job.goal.id == goal_id
    active = MOTION_SOURCES[type(source)].subject(source) == goal_id
    return active or planned or any(goal.id == goal_id for goal in state.queue)


def new_id(goal_id: str, context: StepContext) -> None:
    """Raises RefusalError for an id that another goal has: each goal ends with an event of its own."""
    if _known(goal_id, context):
        raise RefusalError("ID_IN_USE", f"a goal {goal_id} is active or queued; give an id of its own", subject=goal_id)


def _enqueue(goal: Goal, request: int, context: StepContext) -> Accepted | None:
    """Queue a goal: immediately, or (None) once it is resolved."""
    state = context.state
    if len(state.queue) >= QUEUE_LENGTH:
        raise RefusalError(
            "QUEUE_FULL",
            f"{QUEUE_LENGTH} goals are queued: wait until one has ended, or cancel one",
            value=float(len(state.queue)),
            threshold=float(QUEUE_LENGTH),
            unit="goals",
        )
    # an impossible goal is refused now; its path is planned when its turn comes
    prepared = prepare(goal, context, "enqueue", request)
    if isinstance(prepared, PlanJob):
        state.planning = prepared
        return None
    return enqueue(goal, context), None


def enqueue(goal: Goal, context: StepContext) -> str:
    """Add a feasible goal to the queue."""
    state = context.state
    state.queue.append(goal)
    _renew_queued(goal, context)
    return f"queued as number {len(state.queue)}; it is planned when its turn comes"


def _renew_queued(goal: Goal, context: StepContext) -> None:
    if goal.lease_s is not None:
        context.state.queued_until_ns[goal.id] = context.now_ns + int(goal.lease_s * 1e9)


def accept(goal: Goal, source: Source, report: PlanReport | None, context: StepContext) -> Accepted:
    """Start a goal in place of the active one, or answer its check. Raises RefusalError if no motion is allowed."""
    if goal.check:
        try:
            require_motion_allowed(context)
        except RefusalError as error:
            return f"the goal would be accepted, but now {error}", report
        return "the goal would be accepted", report
    require_motion_allowed(context)
    preempt(context, f"goal {goal.id}")
    begin(source, context)
    return "accepted", report


def renew(command: RenewGoal, context: StepContext) -> str:
    """Renew a goal's lease. Raises RefusalError."""
    source = context.state.source
    if MOTION_SOURCES[type(source)].leased and goal_of(source) == command.id:
        cast(Leased, source).renew_lease(context.now_ns)
        return "renewed"
    for goal in context.state.queue:
        if goal.id == command.id:
            _renew_queued(goal, context)
    if _known(command.id, context) or any(id_of(r.command) == command.id for r in context.state.waiting):
        return "renewed"
    raise RefusalError(
        "NO_SUCH_GOAL",
        f"goal {command.id} is not active; active: {goal_of(source) or 'none'}",
        subject=command.id,
    )


def extend_leases(command: ExtendLeases, context: StepContext) -> None:
    """Extend clients' leases by the time in which their messages could not be received."""
    state, by_ns = context.state, round(command.seconds * 1e9)
    source = state.source
    if MOTION_SOURCES[type(source)].leased:
        cast(Leased, source).lease_until_ns += by_ns
    elif isinstance(source, AwaitingAcknowledgement):
        source.until_ns += by_ns
    state.queued_until_ns = {goal: until_ns + by_ns for goal, until_ns in state.queued_until_ns.items()}


def move_goal(command: UpdateGoal, context: StepContext) -> str:
    """Move the set-points of the active goal. Raises RefusalError."""
    source = context.state.source
    if goal_of(source) != command.id:
        raise RefusalError(
            "NO_SUCH_GOAL",
            f"goal {command.id} is not active; active: {goal_of(source) or 'none'}",
            subject=command.id,
        )
    if not isinstance(source, ServoGoal):
        raise RefusalError(
            "TARGET_CANNOT_MOVE",
            "only goals in set-points, points or displacements may be moved",
            subject=command.id,
        )
    refuse_while_moved(context.state)
    refuse_pixels(command.target, context.state, context.settings)
    return update(command, source, context, place_now(context), trusted_model(context))


def cancel(command: CancelGoal, context: StepContext) -> str:
    """Cancel a goal, active, planned or queued. Raises RefusalError."""
    state = context.state
    if goal_of(state.source) == command.id:
        end_source(context, "goal_cancelled", (), "cancelled by its client")
        return "cancelled"
    if isinstance(state.source, AwaitingAcknowledgement) and state.source.id == command.id:
        end_source(context, "goal_cancelled", (), "cancelled by its client")
        return "cancelled: it is not waited for any more, and the queue is empty"
    job = state.planning
    if job is not None and job.goal.id == command.id and job.purpose != "ahead":
        drop_plan(context, (), "cancelled by its client")
        return "cancelled while it was planned"
    if _cancel_waiting(command.id, context):
        return "cancelled while it waited to be looked at"
    kept = [goal for goal in state.queue if goal.id != command.id]
    if len(kept) == len(state.queue):
        raise RefusalError(
            "NO_SUCH_GOAL",
            f"goal {command.id} is neither active nor queued; active: {goal_of(state.source) or 'none'}",
            subject=command.id,
        )
    state.queue = kept
    state.queued_until_ns.pop(command.id, None)
    if (job is not None and job.goal.id == command.id) or (
        state.ahead is not None and state.ahead.goal.id == command.id
    ):
        drop_lookahead_plan(context)
    context.emit("goal_cancelled", id=command.id, message="cancelled while queued")
    return "cancelled"


def _cancel_waiting(goal_id: str, context: StepContext) -> bool:
    """Refuse the requests that wait behind a goal that is being planned; returns whether there were any."""
    state = context.state
    found = [r for r in state.waiting if id_of(r.command) == goal_id]
    state.waiting = [r for r in state.waiting if id_of(r.command) != goal_id]
    hint = "cancelled before it was looked at"
    refuse(found, (Reason("CANCELLED", "info", goal_id, hint=hint),), context)
    return bool(found)


def refuse(requests: list[Request], reasons: tuple[Reason, ...], context: StepContext) -> None:
    """Answer requests that will not be carried out."""
    for request in requests:
        context.emit(
            "reply",
            request=request.request,
            accepted=False,
            id=id_of(request.command),
            message=reasons[0].hint,
            reasons=reasons,
        )


def refuse_waiting(reasons: tuple[Reason, ...], context: StepContext) -> None:
    """Refuse the waiting requests that would move the arm: they were sent before motion was forbidden."""
    state = context.state
    moves = [
        r
        for r in state.waiting
        if isinstance(r.command, Home | Calibrate) or (isinstance(r.command, RunGoal) and not r.command.goal.check)
    ]
    state.waiting = [r for r in state.waiting if r not in moves]
    refuse(moves, reasons, context)


def id_of(command: Command) -> str:
    """Id of the goal that a command is about, or ''."""
    return _IDS[type(command)](command) if type(command) in _IDS else ""


def acknowledge(command: AcknowledgeGoal, context: StepContext) -> str:
    """Handle a client's confirmation that a reached goal may be left. Raises RefusalError."""
    source = context.state.source
    if not isinstance(source, AwaitingAcknowledgement) or source.id != command.id:
        waited_for = source.id if isinstance(source, AwaitingAcknowledgement) else "none"
        raise RefusalError(
            "NOT_AWAITED",
            f"goal {command.id} does not wait to be acknowledged; waiting: {waited_for}",
            subject=command.id,
        )
    context.state.source = Holding()
    context.emit("goal_acknowledged", id=command.id, message="acknowledged")
    return "acknowledged"


HOME_SPEED = 0.5


IN_ORDER = (RunGoal, Home, Calibrate, Teach)
"""Requests that wait while a goal is planned, so that they are answered in the order of their arrival."""


def answer_all(requests: tuple[Request, ...], context: StepContext) -> None:
    """Answer a step's requests in order. Of several set-points for one goal only the newest is used, to save time."""
    newest = {r.command.id: r.request for r in requests if isinstance(r.command, UpdateGoal)}
    for request in requests:
        command = request.command
        if isinstance(command, UpdateGoal) and newest[command.id] != request.request:
            message = "overtaken by newer set-points in the same cycle"
            context.emit("reply", request=request.request, accepted=True, id=command.id, message=message)
        else:
            answer(request, context)


def answer(request: Request, context: StepContext) -> None:
    """Carry out one request and emit its reply: immediately, or once its goal is planned."""
    if not isinstance(request.command, IN_ORDER):
        _answer(request, context)
        return
    waiting = context.state.waiting
    if not waiting and _free(request, context):
        _answer(request, context)
    elif len(waiting) < QUEUE_LENGTH:
        waiting.append(request)
    else:
        hint = f"{QUEUE_LENGTH} requests wait for a goal before them: send it again after a reply"
        limit = float(QUEUE_LENGTH)
        refusal = RefusalError("BUSY", hint, value=float(len(waiting)), threshold=limit, unit="requests")
        _reply_refused(request, refusal, context)


def answer_waiting(context: StepContext) -> None:
    """Answer the requests that have waited for a plan, or for a kept model to be confirmed."""
    waiting = context.state.waiting
    while waiting and _free(waiting[0], context):
        _answer(waiting.pop(0), context)
    comparison = context.state.comparison
    if comparison is not None and not waiting:
        comparison.wait_until_ns = 0


def _free(request: Request, context: StepContext) -> bool:
    """Whether the next ``request`` may be handled: no goal is planned before it, no other goal was handled in this
    step, and it does not wait for a kept model to be confirmed.
    """
    return not planning_pending(context) and not context.goals_read and not _awaits_model(request, context)


CONFIRMATION_S = 3.0
"""Longest time that goals wait for a kept model to be confirmed [s]."""


def _awaits_model(request: Request, context: StepContext) -> bool:
    """Whether a goal waits for frames that confirm a kept model; goals that are refused anyway do not."""
    state, command, comparison = context.state, request.command, context.state.comparison
    if comparison is None or state.readiness is not ModelReadiness.UNCONFIRMED or state.reanchoring is not None:
        return False
    forbidden = state.lifecycle is not Lifecycle.ACTIVE or state.stopped or state.held
    if not isinstance(command, RunGoal) or (forbidden and not command.goal.check):
        return False
    if isinstance(command.goal.target, JointTarget):
        return False
    if not comparison.wait_until_ns:
        comparison.wait_until_ns = context.now_ns + round(CONFIRMATION_S * 1e9)
    return context.now_ns < comparison.wait_until_ns


def _answer(request: Request, context: StepContext) -> None:
    command = request.command
    try:
        done = _HANDLERS[type(command)](command, request, context)
    except RefusalError as refusal:
        _reply_refused(request, refusal, context)
        return
    if done is not None:
        message, plan = (done, None) if isinstance(done, str) else done
        context.emit("reply", request=request.request, accepted=True, message=message, id=id_of(command), plan=plan)


def _reply_refused(request: Request, refusal: RefusalError, context: StepContext) -> None:
    context.emit(
        "reply",
        request=request.request,
        accepted=False,
        message=str(refusal),
        reasons=refusal.reasons,
        id=id_of(request.command),
    )


def _run(command: RunGoal, request: Request, context: StepContext) -> Accepted | None:
    context.goals_read.append(command.goal.id)
    return run_goal(command.goal, request, context)


def _disable(command: Disable, request: Request, context: StepContext) -> str:
    reason = Reason("DISABLED", "hold", hint="enable, then send the goal again")
    end_source(context, "goal_aborted", (reason,), "disabled")
    end_queue(context, (reason,), "disabled")
    refuse_waiting((reason,), context)
    context.state.driver_request = "deactivate"
    return "the arm is stopped and its drives go off"


def _reset(command: Reset, request: Request, context: StepContext) -> str:
    state = context.state
    if state.lifecycle != Lifecycle.FAULT:
        raise RefusalError("NOT_IN_FAULT", f"the cell is {state.lifecycle}; there is nothing to reset")
    state.fault = []  # latched until here; a persisting cause latches it again
    state.driver_request = "reset"
    return "resetting"


def _hold(command: Hold, request: Request, context: StepContext) -> str:
    context.state.held = True
    context.emit("held", message=f"held by {request.operator}", id=goal_of(context.state.source))
    return "holding"


def _resume(command: Resume, request: Request, context: StepContext) -> str:
    state = context.state
    state.held = state.stopped = False
    camera_relocalization.try_again(context)
    context.emit("resumed", message=f"resumed by {request.operator}", id=goal_of(state.source))
    return "resumed from the measured state"


def _home(command: Home, request: Request, context: StepContext) -> str:
    require_motion_allowed(context)
    home = context.settings.home
    if home is None:
        raise RefusalError("NO_HOME", "the cell file states neither [joints] home nor [calibration] base")
    if isinstance(context.state.source, JointMove) and goal_of(context.state.source) == command.id:
        return "already accepted"  # a client's retry
    new_id(command.id, context)
    preempt(context, "home")
    speed = HOME_SPEED * command.speed_scale
    context.state.source = joint_move_to(command.id, home, speed, context, lease_s=command.lease_s)
    return "moving home"


def _calibrate(command: Calibrate, request: Request, context: StepContext) -> str:
    require_motion_allowed(context)
    state = context.state
    if context.settings.trials is None:
        raise RefusalError("NO_TRIALS", "the cell file has no [calibration] section")
    if command.reset_zeros and not command.check:
        raise RefusalError("RESET_WITHOUT_CHECK", "joint zeros are reset by a check: give check as well as reset_zeros")
    if command.quick and not command.check:
        raise RefusalError("QUICK_WITHOUT_CHECK", "only a check can be quick: give check as well as quick")
    if MOTION_SOURCES[type(state.source)].measures and goal_of(state.source) == command.id:
        return "already accepted"  # a client's retry
    new_id(command.id, context)
    visiting: CheckMotion | TrialMotion
    if not command.check:
        begin = start_sweeps if context.settings.trials.sweeps else start_trials
        visiting, what = begin(command.id, context.q, context.now_ns, context.settings), "trial motions begin"
    elif state.model is None:
        raise no_model(context, "the cell has no model to check: calibrate first")
    else:
        visiting = start_check(command, context, state.model)
        what = "check motion begins"
    preempt(context, "calibrate")
    state.source = visiting
    state.source.lease_s = command.lease_s
    state.source.renew_lease(context.now_ns)
    context.emit("calibration_progress", id=command.id, progress=0.0, message=what)
    return "checking" if command.check else "calibrating"


def _enable(command: Enable, request: Request, context: StepContext) -> str:
    state = context.state
    if state.lifecycle == Lifecycle.FAULT:
        raise RefusalError(
            "IN_FAULT",
            "the cell is in fault: " + "; ".join(r.hint for r in state.fault) + ". Clear the cause, then reset",
        )
    if state.lifecycle == Lifecycle.UNCONFIGURED:
        raise RefusalError("NOT_CONFIGURED", "the joint driver is not configured yet")
    state.held = state.stopped = False
    if state.lifecycle == Lifecycle.INACTIVE:
        state.driver_request = "activate"
        return "enabling"
    return "already enabled"


def _jog(command: Jog, request: Request, context: StepContext) -> str:
    require_motion_allowed(context)
    state = context.state
    if not isinstance(state.source, Holding | Jogging):
        active = goal_of(state.source)
        waits = f"a goal is active ({active})" if active else "a reached goal waits to be acknowledged"
        raise RefusalError("BUSY", f"{waits}: cancel it before jogging", subject=active)
    if state.planning is not None and not state.planning.goal.check:
        planned = state.planning.goal.id
        raise RefusalError("BUSY", f"goal {planned} is being planned: cancel it before jogging", subject=planned)
    velocity = np.zeros_like(context.q)
    for name, speed in command.velocities.items():
        if not math.isfinite(speed):
            raise RefusalError("NON_FINITE", f"joint {name}: velocity {speed} is not a finite number", subject=name)
        velocity[joint_index(name, context.settings)] = speed
    state.source = Jogging(velocity, context.now_ns + int(command.lease_s * 1e9))
    return f"jogging for {command.lease_s} s"


def _order_auxiliary(command: OrderAuxiliary, request: Request, context: StepContext) -> str:
    """Accept an order; the servo process passes it to the driver. It is no motion of the model's joints."""
    _require_powered(context)
    return "ordered: " + ", ".join(f"{name} {value:g}" for name, value in command.values.items())


def _of_command(
    carry_out: Callable[[Any, StepContext], str | None],
) -> Callable[[Any, Request, StepContext], str | None]:
    """A handler that needs only the command of the request."""
    return lambda command, request, context: carry_out(command, context)


_HANDLERS: dict[type[Any], Callable[[Any, Request, StepContext], str | Accepted | None]] = {
    RunGoal: _run,
    Enable: _enable,
    Disable: _disable,
    Reset: _reset,
    Hold: _hold,
    Resume: _resume,
    RenewGoal: _of_command(renew),
    UpdateGoal: _of_command(move_goal),
    AcknowledgeGoal: _of_command(acknowledge),
    CancelGoal: _of_command(cancel),
    ReanchorRefused: _of_command(camera_relocalization.refused),
    ExtendLeases: _of_command(extend_leases),
    Teach: start_teaching,
    Jog: _jog,
    OrderAuxiliary: _order_auxiliary,
    Home: _home,
    Calibrate: _calibrate,
}
"""Handlers of requests, by their command. Each returns the message of an accepted request, with a plan, or None until
it is planned.

Each raises RefusalError.
"""
