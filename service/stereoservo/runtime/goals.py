"""What clients ask of goals: run, check, queue, renew, move, cancel, acknowledge."""

from __future__ import annotations

from stereoservo.control.reasons import Reason
from stereoservo.runtime.commands import (
    AcknowledgeGoal,
    Calibrate,
    CancelGoal,
    Command,
    Goal,
    Home,
    IncidenceTarget,
    JointTarget,
    PlanReport,
    RenewGoal,
    Request,
    RunGoal,
    TaughtTarget,
    UpdateGoal,
)
from stereoservo.runtime.cycle import ModelReadiness
from stereoservo.runtime.ending import drop_plan, end_source, forget_ahead, goal_of, may_move
from stereoservo.runtime.incidences import start_incidence
from stereoservo.runtime.joint_goals import joint_goal, joint_report
from stereoservo.runtime.mobile import refuse_pixels
from stereoservo.runtime.motion import Present
from stereoservo.runtime.planned import (
    begin_plan,
    unplanned_report,
)
from stereoservo.runtime.reanchoring import refuse_while_moved
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.servoing import place_now, start_servoing
from stereoservo.runtime.state import (
    Awaiting,
    Holding,
    Incidence,
    JointMove,
    LawRun,
    Servoing,
    Source,
    Visiting,
)
from stereoservo.runtime.streaming import update
from stereoservo.runtime.target_checks import Place

QUEUE_LENGTH = 16

Accepted = tuple[str, PlanReport | None]


def run_goal(goal: Goal, request: Request, present: Present) -> Accepted | None:
    """Accept or refuse a goal: at once, or (None) once it is planned. Raises RefusalError."""
    state = present.state
    if not goal.check:
        may_move(present)
        if _known(goal.id, present):
            return "already accepted", None  # a client's retry
        refuse_pixels(goal.target, state, present.settings)
        busy = goal_of(state.source) or isinstance(state.source, Awaiting) or state.queue
        if goal.mode == "queue" and busy:
            return _enqueue(goal, present), None
    source, place = prepare(goal, present)
    if isinstance(source, Servoing) and source.pose_known and place is not None:
        state.planning = begin_plan(source, present, place, present.q, "reply", request.request)
        return None
    report = joint_report(source, present) if isinstance(source, JointMove) else unplanned_report(source)
    return accept(goal, source, report, present)


def planning_comes_first(present: Present) -> bool:
    """Whether a goal is being planned that a client waits for, or that has been accepted already."""
    job = present.state.planning
    return job is not None and job.purpose != "ahead"


def _known(goal_id: str, present: Present) -> bool:
    state = present.state
    job, source = state.planning, state.source
    planned = job is not None and not job.source.goal.check and job.source.goal.id == goal_id
    active = goal_of(source) == goal_id or (isinstance(source, Awaiting) and source.id == goal_id)
    return active or planned or any(goal.id == goal_id for goal in state.queue)


def new_id(goal_id: str, present: Present) -> None:
    """Raises RefusalError for an id that another goal has: each ends in one event of its own."""
    if _known(goal_id, present):
        raise RefusalError(
            "ID_IN_USE", f"a goal {goal_id} is active or queued; give an id of its own", subject=goal_id
        )


def _enqueue(goal: Goal, present: Present) -> str:
    state = present.state
    if len(state.queue) >= QUEUE_LENGTH:
        raise RefusalError(
            "QUEUE_FULL",
            f"{QUEUE_LENGTH} goals are queued: wait until one has ended, or cancel one",
            value=float(len(state.queue)),
            threshold=float(QUEUE_LENGTH),
            unit="goals",
        )
    prepare(goal, present)  # what cannot be at all is refused now; its way is planned when its turn comes
    state.queue.append(goal)
    _renew_queued(goal, present)
    return f"queued as number {len(state.queue)}; it is planned when its turn comes"


def _renew_queued(goal: Goal, present: Present) -> None:
    if goal.lease_s is not None:
        present.state.queued_until_ns[goal.id] = present.now_ns + int(goal.lease_s * 1e9)


def accept(goal: Goal, source: Source, report: PlanReport | None, present: Present) -> Accepted:
    """Begin a goal in place of the active one, or answer its check. Raises RefusalError where none may move."""
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
    refuse_while_moved(present.state)
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
    for goal in present.state.queue:
        if goal.id == command.id:
            _renew_queued(goal, present)
    if _known(command.id, present) or any(id_of(r.command) == command.id for r in present.state.waiting):
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
    refuse_while_moved(present.state)
    refuse_pixels(command.target, present.state, present.settings)
    return update(command, source, present, place_now(present), trusted_model(present))


def cancel(command: CancelGoal, present: Present) -> str:
    """Cancel a goal, active, planned or queued. Raises RefusalError."""
    state = present.state
    if goal_of(state.source) == command.id:
        end_source(present, "goal_cancelled", (), "cancelled by its client")
        return "cancelled"
    if isinstance(state.source, Awaiting) and state.source.id == command.id:
        end_source(present, "goal_cancelled", (), "cancelled by its client")
        return "cancelled: it is not waited for any more, and the queue is empty"
    job = state.planning
    if job is not None and job.source.goal.id == command.id and job.purpose != "ahead":
        drop_plan(present, (), "cancelled by its client")
        return "cancelled while it was planned"
    if _cancel_waiting(command.id, present):
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
    if (job is not None and job.source.goal.id == command.id) or (
        state.ahead is not None and state.ahead.goal.id == command.id
    ):
        forget_ahead(present)
    present.emit("goal_cancelled", id=command.id, message="cancelled while queued")
    return "cancelled"


def _cancel_waiting(goal_id: str, present: Present) -> bool:
    """Refuse what waits behind a goal that is being planned; whether there was such a request."""
    state = present.state
    found = [r for r in state.waiting if id_of(r.command) == goal_id]
    state.waiting = [r for r in state.waiting if id_of(r.command) != goal_id]
    hint = "cancelled before it was looked at"
    refuse(found, (Reason("CANCELLED", "info", goal_id, hint=hint),), present)
    return bool(found)


def refuse(requests: list[Request], reasons: tuple[Reason, ...], present: Present) -> None:
    """Answer requests that are not carried out any more."""
    for request in requests:
        present.emit(
            "reply", request=request.request, accepted=False, id=id_of(request.command), message=reasons[0].hint,
            reasons=reasons,
        )  # fmt: skip


def refuse_waiting(reasons: tuple[Reason, ...], present: Present) -> None:
    """What waits to move the arm was asked for before it was told not to."""
    state = present.state
    moves = [
        r for r in state.waiting
        if isinstance(r.command, Home | Calibrate) or (isinstance(r.command, RunGoal) and not r.command.goal.check)
    ]  # fmt: skip
    state.waiting = [r for r in state.waiting if r not in moves]
    refuse(moves, reasons, present)


def id_of(command: Command) -> str:
    """Id of the goal that a command is about, or ''."""
    if isinstance(command, RunGoal):
        return command.goal.id
    with_id = RenewGoal | CancelGoal | UpdateGoal | AcknowledgeGoal | Home | Calibrate
    return command.id if isinstance(command, with_id) else ""


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


def begin(source: Source, present: Present) -> None:
    """Make ``source`` the active one."""
    if isinstance(source, LawRun):
        source.started_ns = present.now_ns
        source.last_frames = sum(e.frames for e in present.state.cameras)
    if isinstance(source, LawRun | JointMove):
        source.renew_lease(present.now_ns)
    forget_ahead(present)
    present.state.source = source
    law = (
        source.law
        if isinstance(source, Servoing)
        else "incidence"
        if isinstance(source, Incidence)
        else "joints"
    )
    present.emit("goal_started", id=goal_of(source), name=law)
