"""Requests to the core: each is accepted or refused, with reasons, in exactly one reply event."""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime import ending, goals, reanchoring
from stereoservo.runtime.check import start_check
from stereoservo.runtime.commands import (
    AcknowledgeGoal,
    Calibrate,
    CancelGoal,
    Command,
    Disable,
    Enable,
    Hold,
    Home,
    Jog,
    ReanchorRefused,
    RenewGoal,
    Request,
    Reset,
    Resume,
    RunGoal,
    Teach,
    UpdateGoal,
)
from stereoservo.runtime.cycle import Lifecycle
from stereoservo.runtime.incidences import joint_index
from stereoservo.runtime.joint_goals import joint_move_to
from stereoservo.runtime.motion import Present
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.state import Checking, Holding, Jogging, JointMove, Trials, Visiting
from stereoservo.runtime.teaching import start_teaching
from stereoservo.runtime.trials import start_trials

HOME_SPEED = 0.5


IN_ORDER = (RunGoal, Home, Calibrate, Teach)
"""Requests that wait while a goal is planned, so that they are answered in the order in which they came."""


def answer_all(requests: tuple[Request, ...], present: Present) -> None:
    """Answer a step's requests in order. Of several set-points for one goal the newest counts: each is work."""
    newest = {r.command.id: r.request for r in requests if isinstance(r.command, UpdateGoal)}
    for request in requests:
        command = request.command
        if isinstance(command, UpdateGoal) and newest[command.id] != request.request:
            message = "overtaken by newer set-points in the same cycle"
            present.emit("reply", request=request.request, accepted=True, id=command.id, message=message)
        else:
            answer(request, present)


def answer(request: Request, present: Present) -> None:
    """Carry out one request and emit its reply: at once, or once what it asks for is planned."""
    if not isinstance(request.command, IN_ORDER):
        _answer(request, present)
        return
    waiting = present.state.waiting
    if not waiting and _free(present):
        _answer(request, present)
    elif len(waiting) < goals.QUEUE_LENGTH:
        waiting.append(request)
    else:
        hint = f"{goals.QUEUE_LENGTH} requests wait while a goal is planned: send it again after a reply"
        limit = float(goals.QUEUE_LENGTH)
        refusal = RefusalError("BUSY", hint, value=float(len(waiting)), threshold=limit, unit="requests")
        _refuse(request, refusal, present)


def answer_waiting(present: Present) -> None:
    """Answer what has waited for a plan."""
    waiting = present.state.waiting
    while waiting and _free(present):
        _answer(waiting.pop(0), present)


def _free(present: Present) -> bool:
    """Whether the next request may be looked at: no goal is planned before it, and no other was read in this step."""
    return not goals.planning_comes_first(present) and not present.goals_read


def _answer(request: Request, present: Present) -> None:
    try:
        accepted = _carry_out(request, request.command, present)
    except RefusalError as refusal:
        _refuse(request, refusal, present)
        return
    if accepted is not None:
        message, plan = accepted
        present.emit(
            "reply",
            request=request.request,
            accepted=True,
            message=message,
            id=goals.id_of(request.command),
            plan=plan,
        )


def _refuse(request: Request, refusal: RefusalError, present: Present) -> None:
    present.emit(
        "reply", request=request.request, accepted=False, message=str(refusal), reasons=refusal.reasons,
        id=goals.id_of(request.command),
    )  # fmt: skip


def _carry_out(request: Request, command: Command, present: Present) -> goals.Accepted | None:
    if isinstance(command, RunGoal):
        present.goals_read.append(command.goal.id)
        return goals.run_goal(command.goal, request, present)
    return _do(request, command, present), None


def _do(request: Request, command: Command, present: Present) -> str:
    """Carry out a command that is done, or begun, within the step."""
    state = present.state
    if isinstance(command, Enable):
        return _enable(present)
    if isinstance(command, Disable):
        reason = Reason("DISABLED", "hold", hint="enable, then send the goal again")
        ending.end_source(present, "goal_aborted", (reason,), "disabled")
        ending.end_queue(present, (reason,), "disabled")
        goals.refuse_waiting((reason,), present)
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
        present.emit("held", message=f"held by {request.operator}", id=ending.goal_of(state.source))
        return "holding"
    if isinstance(command, Resume):
        state.held = state.stopped = False
        reanchoring.try_again(present)
        present.emit("resumed", message=f"resumed by {request.operator}", id=ending.goal_of(state.source))
        return "resumed from the measured state"
    if isinstance(command, RenewGoal):
        return goals.renew(command, present)
    if isinstance(command, UpdateGoal):
        return goals.move_goal(command, present)
    if isinstance(command, AcknowledgeGoal):
        return goals.acknowledge(command, present)
    if isinstance(command, CancelGoal):
        return goals.cancel(command, present)
    if isinstance(command, ReanchorRefused):
        return reanchoring.refused(command, present)
    if isinstance(command, Teach):
        return start_teaching(command, request, present)
    ending.may_move(present)
    if isinstance(command, Jog):
        return _jog(command, present)
    if isinstance(command, Home):
        return _home(command, present)
    assert isinstance(command, Calibrate)
    return _calibrate(command, present)


def _home(command: Home, present: Present) -> str:
    home = present.settings.home
    if home is None:
        raise RefusalError("NO_HOME", "the cell file states neither [joints] home nor [calibration] base")
    if isinstance(present.state.source, JointMove) and present.state.source.id == command.id:
        return "already accepted"  # a client's retry
    goals.new_id(command.id, present)
    goals.preempt(present, "home")
    speed = HOME_SPEED * command.speed_scale
    present.state.source = joint_move_to(command.id, home, speed, present, lease_s=command.lease_s)
    return "moving home"


def _calibrate(command: Calibrate, present: Present) -> str:
    state = present.state
    if present.settings.trials is None:
        raise RefusalError("NO_TRIALS", "the cell file has no [calibration] section")
    if command.reset_zeros and not command.check:
        raise RefusalError(
            "RESET_WITHOUT_CHECK", "joint zeros are reset by a check: give check as well as reset_zeros"
        )
    if isinstance(state.source, Visiting) and state.source.id == command.id:
        return "already accepted"  # a client's retry
    goals.new_id(command.id, present)
    visiting: Checking | Trials
    if not command.check:
        visiting, what = (
            start_trials(command.id, present.q, present.now_ns, present.settings),
            "trial motions begin",
        )
    elif state.model is None:
        raise RefusalError("NO_MODEL", "the cell has no model to check: calibrate first")
    else:
        visiting = start_check(command.id, present, state.model, command.reset_zeros)
        what = "check motion begins"
    goals.preempt(present, "calibrate")
    state.source = visiting
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


def _jog(command: Jog, present: Present) -> str:
    state = present.state
    if not isinstance(state.source, Holding | Jogging):
        active = ending.goal_of(state.source)
        waits = f"a goal is active ({active})" if active else "a reached goal waits to be acknowledged"
        raise RefusalError("BUSY", f"{waits}: cancel it before jogging", subject=active)
    if state.planning is not None and not state.planning.source.goal.check:
        planned = state.planning.source.goal.id
        raise RefusalError(
            "BUSY", f"goal {planned} is being planned: cancel it before jogging", subject=planned
        )
    velocity = np.zeros_like(present.q)
    for name, speed in command.velocities.items():
        if not math.isfinite(speed):
            raise RefusalError(
                "NON_FINITE", f"joint {name}: velocity {speed} is not a finite number", subject=name
            )
        velocity[joint_index(name, present)] = speed
    state.source = Jogging(velocity, present.now_ns + int(command.lease_s * 1e9))
    return f"jogging for {command.lease_s} s"
