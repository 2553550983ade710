"""How goals end before they are reached, and what keeps the arm from moving."""

from __future__ import annotations

from typing import Literal

from stereoservo.control.reasons import Reason
from stereoservo.runtime.commands import Goal
from stereoservo.runtime.cycle import Lifecycle
from stereoservo.runtime.motion import Present
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.state import Awaiting, Holding, JointMove, LawRun, Source, Visiting


def goal_of(source: Source) -> str:
    """Id of the goal that a source works on, or ''."""
    if isinstance(source, LawRun):
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
    forget_ahead(present)
    if isinstance(source, Visiting):
        present.emit("calibration_aborted", id=source.id, message=message, reasons=reasons)
    elif goal_of(source):
        present.emit(kind, id=goal_of(source), message=message, reasons=reasons)
    if awaits_client(source):
        end_followers(present, source, reasons)


def awaits_client(source: Source) -> bool:
    """Whether what is queued behind ``source`` may begin only once a client has acknowledged it."""
    if isinstance(source, LawRun):
        return source.goal.acknowledge_s is not None
    return isinstance(source, Awaiting) or (
        isinstance(source, JointMove) and source.acknowledge_s is not None
    )


def end_followers(present: Present, ended: Source | Goal, reasons: tuple[Reason, ...]) -> None:
    """The queue behind a goal that a client was to acknowledge ends with it: what was to happen there has not."""
    id_ = ended.id if isinstance(ended, Goal | Awaiting) else goal_of(ended)
    cancel_queue(present, reasons, f"goal {id_} ended before it was acknowledged")


def forget_ahead(present: Present) -> None:
    """What is planned for the active source, or from where it ends, goes with it."""
    state = present.state
    state.ahead = None
    if state.planning is not None and state.planning.purpose in ("ahead", "again"):
        state.planning = None


def end_queue(present: Present, reasons: tuple[Reason, ...], message: str) -> None:
    """Every queued goal ends with a terminal event too, and what is being planned is not begun."""
    job = present.state.planning
    if job is not None and not job.source.goal.check:
        drop_plan(present, reasons, message)
    cancel_queue(present, reasons, message)


def cancel_queue(present: Present, reasons: tuple[Reason, ...], message: str) -> None:
    """Every queued goal ends, also the one whose way is being planned; who waits for an answer is not concerned."""
    state = present.state
    if state.planning is not None and state.planning.purpose == "queue":
        drop_plan(present, reasons, message)
    queued, state.queue = state.queue, []
    state.queued_until_ns = {}
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
