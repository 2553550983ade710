"""Requests to the core: each is accepted or refused, with reasons, in exactly one reply event."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.check import start_check
from stereoservo.runtime.commands import (
    AcknowledgeGoal,
    Calibrate,
    CancelGoal,
    Command,
    Disable,
    DisplacementTarget,
    Enable,
    FeatureTarget,
    Goal,
    Hold,
    Home,
    IncidenceTarget,
    Jog,
    JointTarget,
    PointTarget,
    RenewGoal,
    Request,
    Reset,
    Resume,
    RunGoal,
    TaughtTarget,
    Teach,
    UpdateGoal,
)
from stereoservo.runtime.cycle import Lifecycle, ModelReadiness
from stereoservo.runtime.motion import Present, measurement_buffers
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.servoing import place_now, start_servoing
from stereoservo.runtime.state import Holding, Jogging, JointMove, Servoing, Source, Teaching, Visiting
from stereoservo.runtime.trials import start_trials

QUEUE_LENGTH = 16
HOME_SPEED = 0.5


def goal_of(source: Source) -> str:
    """Id of the goal that a source works on, or ''."""
    if isinstance(source, Servoing):
        return source.goal.id
    return source.id if isinstance(source, JointMove | Visiting) else ""


def end_source(
    present: Present,
    kind: Literal["goal_aborted", "goal_cancelled", "goal_preempted"],
    reasons: tuple[Reason, ...],
    message: str,
) -> None:
    """End the active source with its one terminal event; the arm then holds."""
    source = present.state.source
    present.state.source = Holding()
    if isinstance(source, Visiting):
        present.emit("calibration_aborted", id=source.id, message=message, reasons=reasons)
    elif goal_of(source):
        present.emit(kind, id=goal_of(source), message=message, reasons=reasons)


def end_queue(present: Present, reasons: tuple[Reason, ...], message: str) -> None:
    """Every queued goal ends with a terminal event too."""
    queued, present.state.queue = present.state.queue, []
    for goal in queued:
        present.emit("goal_cancelled", id=goal.id, message=message, reasons=reasons)


def answer(request: Request, present: Present) -> None:
    """Carry out one request and emit its reply."""
    try:
        message = _carry_out(request, request.command, present)
    except RefusalError as refusal:
        present.emit(
            "reply",
            request=request.request,
            accepted=False,
            message=str(refusal),
            reasons=refusal.reasons,
            id=_id(request.command),
        )
        return
    present.emit("reply", request=request.request, accepted=True, message=message, id=_id(request.command))


def _id(command: Command) -> str:
    if isinstance(command, RunGoal):
        return command.goal.id
    return command.id if isinstance(command, RenewGoal | CancelGoal | Home | Calibrate) else ""


def _carry_out(request: Request, command: Command, present: Present) -> str:
    state = present.state
    if isinstance(command, Enable):
        return _enable(present)
    if isinstance(command, Disable):
        end_source(
            present,
            "goal_aborted",
            (Reason("DISABLED", "hold", hint="enable, then send the goal again"),),
            "disabled",
        )
        end_queue(present, (), "disabled")
        state.driver_request = "deactivate"
        return "the arm is stopped and its drives go off"
    if isinstance(command, Reset):
        if state.lifecycle != Lifecycle.FAULT:
            raise RefusalError("NOT_IN_FAULT", f"the cell is {state.lifecycle}; there is nothing to reset")
        state.fault = []  # latched until here; a cause that is still there latches it again
        state.driver_request = "reset"
        return "resetting"
    if isinstance(command, Hold):
        state.held = True
        present.emit("held", message=f"held by {request.operator}", id=goal_of(state.source))
        return "holding"
    if isinstance(command, Resume):
        state.held = state.stopped = False
        present.emit("resumed", message=f"resumed by {request.operator}", id=goal_of(state.source))
        return "resumed from the measured state"
    if isinstance(command, RenewGoal):
        return _renew(command, present)
    if isinstance(command, CancelGoal):
        return _cancel(command, present)
    if isinstance(command, Teach):
        return _teach(command, request, present)
    if isinstance(command, RunGoal) and command.goal.check:
        _check_goal(command.goal, present)
        try:
            _may_move(present)
        except RefusalError as error:
            return f"the goal would be accepted, but now {error}"
        return "the goal would be accepted"
    _may_move(present)
    if isinstance(command, Jog):
        return _jog(command, present)
    if isinstance(command, RunGoal):
        return _run_goal(command.goal, present)
    _preempt(present, type(command).__name__.lower())
    if isinstance(command, Home):
        if present.settings.home is None:
            raise RefusalError("NO_HOME", "the cell file states neither [joints] home nor [calibration] base")
        speed = HOME_SPEED * command.speed_scale
        home = present.settings.home
        state.source = _move(command.id, home, speed, present, lease_s=command.lease_s)
        return "moving home"
    if isinstance(command, UpdateGoal | AcknowledgeGoal):
        raise RefusalError("NO_SUCH_GOAL", f"goal {command.id} is not active", subject=command.id)
    return _calibrate(command, present)


def _calibrate(command: Calibrate, present: Present) -> str:
    state = present.state
    if present.settings.trials is None:
        raise RefusalError("NO_TRIALS", "the cell file has no [calibration] section")
    if command.reset_zeros and not command.check:
        raise RefusalError(
            "RESET_WITHOUT_CHECK", "joint zeros are reset by a check: give check as well as reset_zeros"
        )
    if command.check and state.model is None:
        raise RefusalError("NO_MODEL", "the cell has no model to check: calibrate first")
    if command.check and state.model is not None:
        checking = start_check(command.id, present, state.model, command.reset_zeros)
        state.source, what = checking, "check motion begins"
    else:
        state.source = start_trials(command.id, present.q, present.now_ns, present.settings)
        what = "trial motions begin"
    state.source.lease_s = command.lease_s
    state.source.renew_lease(present.now_ns)
    present.emit("calibration_progress", id=command.id, progress=0.0, message=what)
    return "checking" if command.check else "calibrating"


def _enable(present: Present) -> str:
    state = present.state
    if state.lifecycle == Lifecycle.FAULT:
        raise RefusalError(
            "IN_FAULT",
            "the cell is in fault: "
            + "; ".join(r.hint for r in state.fault)
            + ". Clear the cause, then reset",
        )
    if state.lifecycle == Lifecycle.UNCONFIGURED:
        raise RefusalError("NOT_CONFIGURED", "the joint driver is not configured yet")
    state.held = state.stopped = False
    if state.lifecycle == Lifecycle.INACTIVE:
        state.driver_request = "activate"
        return "enabling"
    return "already enabled"


def _may_move(present: Present) -> None:
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


def _preempt(present: Present, by: str) -> None:
    end_source(
        present,
        "goal_preempted",
        (Reason("PREEMPTED", "info", hint=f"preempted by {by}"),),
        f"preempted by {by}",
    )


def _check_goal(goal: Goal, present: Present) -> Source:
    target = goal.target
    if isinstance(target, JointTarget):
        wanted = present.q.copy()
        for name, position in target.positions.items():
            wanted[_joint(name, present)] = position
        _inside_limits(wanted, present)
        return _move(goal.id, wanted, goal.speed_scale, present, goal.time_limit_s, goal.lease_s)
    if isinstance(target, TaughtTarget):
        raise RefusalError(
            "TAUGHT_UNRESOLVED", f"taught goal {target.name!r} was not looked up", subject=target.name
        )
    if isinstance(target, IncidenceTarget):
        raise RefusalError(
            "NO_SUCH_TARGET", "this cell's core does not drive incidences", subject="incidence"
        )
    return _law_goal(goal, target, present)


def _law_goal(
    goal: Goal, target: FeatureTarget | PointTarget | DisplacementTarget, present: Present
) -> Servoing:
    state = present.state
    if state.model is None or present.arrays is None or state.readiness == ModelReadiness.NONE:
        raise RefusalError("NO_MODEL", "the cell has no model yet: calibrate first")
    if state.readiness == ModelReadiness.SUSPECT:
        raise RefusalError(
            "MODEL_SUSPECT",
            "the model no longer explains the images: check the cameras and the markers, then calibrate",
        )
    return start_servoing(goal, target, present, place_now(present))


def _run_goal(goal: Goal, present: Present) -> str:
    state = present.state
    source = _check_goal(goal, present)
    if goal_of(state.source) == goal.id or any(queued.id == goal.id for queued in state.queue):
        return "already accepted"  # a client's retry
    if goal.mode == "queue" and goal_of(state.source):
        if len(state.queue) >= QUEUE_LENGTH:
            raise RefusalError(
                "QUEUE_FULL",
                f"{QUEUE_LENGTH} goals are queued",
                value=float(len(state.queue)),
                threshold=float(QUEUE_LENGTH),
            )
        state.queue.append(goal)
        return f"queued as number {len(state.queue)}"
    _preempt(present, f"goal {goal.id}")
    begin(source, present)
    return "accepted"


def begin(source: Source, present: Present) -> None:
    """Make ``source`` the active one."""
    present.state.source = source
    present.emit(
        "goal_started", id=goal_of(source), name=source.law if isinstance(source, Servoing) else "joints"
    )


def next_goal(present: Present) -> None:
    """Start the next queued goal, if any; one that no longer fits ends with its terminal event."""
    state = present.state
    while state.queue and isinstance(state.source, Holding):
        goal = state.queue.pop(0)
        try:
            begin(_check_goal(goal, present), present)
        except RefusalError as refusal:
            present.emit("goal_aborted", id=goal.id, message=str(refusal), reasons=(refusal.reason,))


def _renew(command: RenewGoal, present: Present) -> str:
    source = present.state.source
    if isinstance(source, Servoing | JointMove | Visiting) and goal_of(source) == command.id:
        source.renew_lease(present.now_ns)
        return "renewed"
    if goal_of(source) == command.id or any(goal.id == command.id for goal in present.state.queue):
        return "renewed"
    raise RefusalError(
        "NO_SUCH_GOAL",
        f"goal {command.id} is not active; active: {goal_of(source) or 'none'}",
        subject=command.id,
    )


def _cancel(command: CancelGoal, present: Present) -> str:
    state = present.state
    if goal_of(state.source) == command.id:
        end_source(present, "goal_cancelled", (), "cancelled by its client")
        return "cancelled"
    kept = [goal for goal in state.queue if goal.id != command.id]
    if len(kept) == len(state.queue):
        raise RefusalError(
            "NO_SUCH_GOAL",
            f"goal {command.id} is neither active nor queued; active: {goal_of(state.source) or 'none'}",
            subject=command.id,
        )
    state.queue = kept
    present.emit("goal_cancelled", id=command.id, message="cancelled while queued")
    return "cancelled"


def _teach(command: Teach, request: Request, present: Present) -> str:
    state = present.state
    if state.model is None:
        raise RefusalError(
            "NO_MODEL", "the cell has no model yet: calibrate first, so that the goal can carry its epoch"
        )
    if state.teaching is not None:
        raise RefusalError(
            "TEACHING", f"goal {state.teaching.name!r} is still being taught", subject=state.teaching.name
        )
    if bool((np.abs(state.command) > 1e-3).any()):
        raise RefusalError(
            "MOVING",
            "the arm moves; a goal is taught at rest",
            value=float(np.abs(state.command).max()),
            threshold=1e-3,
            unit="rad/s or m/s",
        )
    state.teaching = Teaching(
        command.name, request.request, command.frames, present.now_ns, **measurement_buffers(present.settings)
    )
    return f"teaching {command.name!r} from {command.frames} frames a camera"


def _joint(name: str, present: Present) -> int:
    names = present.settings.joint_names
    if name not in names:
        raise RefusalError("NO_SUCH_JOINT", f"no joint {name!r}; joints: {', '.join(names)}", subject=name)
    return names.index(name)


def _inside_limits(target: FloatArray, present: Present) -> None:
    limits = present.settings.limits
    for i, name in enumerate(present.settings.joint_names):
        low, high = (
            limits.position_min[i] + limits.position_margin,
            limits.position_max[i] - limits.position_margin,
        )
        if not low <= target[i] <= high and target[i] != present.q[i]:
            raise RefusalError(
                "JOINT_LIMIT",
                f"joint {name}: {target[i]:.4f} is outside {low:.4f} … {high:.4f} (limits less the margin)",
                subject=name, value=float(target[i]), threshold=float(high if target[i] > high else low),
                unit="rad or m",
            )  # fmt: skip


def _move(
    goal_id: str,
    target: FloatArray,
    speed_scale: float,
    present: Present,
    time_limit_s: float | None = None,
    lease_s: float | None = None,
) -> JointMove:
    move = JointMove(
        id=goal_id,
        target=np.array(target),
        speed_scale=speed_scale,
        started_ns=present.now_ns,
        time_limit_s=present.settings.time_limit_s if time_limit_s is None else time_limit_s,
        lease_s=lease_s,
        lease_until_ns=0,
    )
    move.renew_lease(present.now_ns)
    return move


def _jog(command: Jog, present: Present) -> str:
    state = present.state
    if not isinstance(state.source, Holding | Jogging):
        raise RefusalError(
            "BUSY",
            f"a goal is active ({goal_of(state.source)}): cancel it before jogging",
            subject=goal_of(state.source),
        )
    velocity = np.zeros_like(present.q)
    for name, speed in command.velocities.items():
        if not math.isfinite(speed):
            raise RefusalError(
                "NON_FINITE", f"joint {name}: velocity {speed} is not a finite number", subject=name
            )
        velocity[_joint(name, present)] = speed
    state.source = Jogging(velocity, present.now_ns + int(command.lease_s * 1e9))
    return f"jogging for {command.lease_s} s"
