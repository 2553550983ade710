"""What clients ask of goals: run, check, queue, renew, move, cancel, acknowledge."""

from __future__ import annotations

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
from stereoservo.runtime.cycle import ModelReadiness
from stereoservo.runtime.ending import drop_plan, end_queue, end_source, goal_of, may_move
from stereoservo.runtime.incidences import start_incidence
from stereoservo.runtime.joint_goals import joint_goal, joint_report
from stereoservo.runtime.motion import Present
from stereoservo.runtime.planned import (
    begin_plan,
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
        busy = goal_of(state.source) or isinstance(state.source, Awaiting) or state.queue
        if goal.mode == "queue" and busy:
            return _enqueue(goal, present), None
    source, place = prepare(goal, present)
    if isinstance(source, Servoing) and source.pose_known and place is not None:
        state.planning = begin_plan(source, present, place, present.q, "reply", request.request)
        return None
    report = joint_report(source, present) if isinstance(source, JointMove) else unplanned_report(source)
    return accept(goal, source, report, present)


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
