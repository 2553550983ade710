"""Intake of clients' goals and commands: decodes and validates them, forwards them to the servo process, and returns
its reply. Stop and enable have their own thread and session.

Nothing in the intake blocks: an unanswered request is stored with its deadline.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import zenoh
from zenoh.handlers import RingChannel

from stereoservo.client.goal_handle import TERMINAL
from stereoservo.client.session import close_session, open_session
from stereoservo.core.cycle import Event
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.seqlock import StopSlot
from stereoservo.gateway.boundary import Boundary, RateLimit
from stereoservo.gateway.point_alignment import TransferError
from stereoservo.gateway.publisher import EventLog, ReplyThread
from stereoservo.gateway.servo_connection import ServoConnection
from stereoservo.gateway.teaching import TaughtGoalRegistry
from stereoservo.gateway.validation import GoalContext, check_command, check_goal
from stereoservo.messages.goals import (
    AcknowledgeGoal,
    CancelGoal,
    Command,
    DisplacementTarget,
    FeatureTarget,
    Goal,
    IncidenceTarget,
    PlanReport,
    RenewGoal,
    Reset,
    RunGoal,
    StepTarget,
    Stop,
    TaughtTarget,
    Teach,
    UpdateGoal,
)
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.wire import Reply, RunningGoal, RunningGoals, decode, decode_command, encode

REPLY_TIMEOUT_S = 1.0
PLANNED_REPLY_TIMEOUT_S = 5.0
"""Time for the answer to a goal: it is planned first, one slice per cycle."""
RESET_REPLY_TIMEOUT_S = 10.0
"""A driver that reconnects and configures its drives does not reply in that time."""
PATIENCE_S: dict[type, float] = {RunGoal: PLANNED_REPLY_TIMEOUT_S, Reset: RESET_REPLY_TIMEOUT_S}
KNOWN_GOALS = 1000
REPORTED_AT_ONCE = 10
"""Goals sent as puts have no reply. Their refusals are events: this many at once, then one per second."""


@dataclass
class _Pending:
    query: Any
    command: Command
    operator: str
    deadline: float
    seconds: float
    note: str = ""


class _Answered(Exception):  # noqa: N818 - not an error: the way out with a reply
    def __init__(self, reply: Reply) -> None:
        super().__init__(reply.message)
        self.reply = reply


class Intake:
    """Handles goals and commands of all operators."""

    def __init__(
        self,
        keys: KeySpace,
        link: ServoConnection,
        replies: ReplyThread,
        log: EventLog,
        context: Callable[[], GoalContext],
        teaching: TaughtGoalRegistry,
        boot: str,
    ) -> None:
        self._keys = keys
        self._link = link
        self._replies = replies
        self._log = log
        self._context = context
        self._teaching = teaching
        self._boot = boot
        self.boundary = Boundary(boot)
        self._pending: dict[int, _Pending] = {}
        self._goals: OrderedDict[str, Reply] = OrderedDict()
        self._running: OrderedDict[str, RunningGoal] = OrderedDict()
        self._note = ""
        self._stream_limit = RateLimit(1)
        self._put_limit = RateLimit(REPORTED_AT_ONCE)

    # -- from zenoh -----------------------------------------------------------------------------------------

    def goal_query(self, query: Any) -> None:
        """Handle a goal sent as a query: the reply accepts or refuses it."""
        self._take(query, query, self._goal)

    def goal_sample(self, sample: Any) -> None:
        """Handle a goal, its renewal or update sent as a put: a refusal becomes an event."""
        self._take(None, sample, self._goal)

    def command_query(self, query: Any) -> None:
        """Handle a command sent as a query."""
        self._take(query, query, self._command)

    def _take(self, query: Any, message: Any, work: Callable[[str, bytes], tuple[str, Command]]) -> None:
        key = str(message.key_expr)
        if query is not None and "*" in key:
            query.drop()  # a wildcard query; goals and commands need exact keys
            return
        payload = payload_of(message)
        streamed = query is None and b'"update"' in payload
        self.boundary.take(
            key,
            lambda: self._forward(query, key, payload, work, streamed),
            lambda refusal: self._answer(query, refusal, key, streamed),
        )

    def _forward(
        self,
        query: Any,
        key: str,
        payload: bytes,
        work: Callable[[str, bytes], tuple[str, Command]],
        streamed: bool,
    ) -> None:
        operator, self._note = "", ""
        try:
            operator, command = work(key, payload)
            number = self._link.send_command(command, operator)
            if number is None:
                raise _Answered(self._refused("the servo process does not take requests; see `stereoservo status`"))
        except _Answered as answered:
            self._answer(query, answered.reply, operator or key, streamed)
        else:
            seconds = PATIENCE_S.get(type(command), REPLY_TIMEOUT_S)
            deadline = time.monotonic() + seconds
            self._pending[number] = _Pending(query, command, operator, deadline, seconds, self._note)
            if isinstance(command, Teach):
                self._teaching.expect(number, command.tool)

    def _goal(self, key: str, payload: bytes) -> tuple[str, Command]:
        operator = self._keys.operator_of_goal(key)
        if b'"command"' in payload:
            kinds: Any = RenewGoal | CancelGoal | UpdateGoal | AcknowledgeGoal
            command: Command = decode(payload, kinds)
            self._require(check_command(command, self._context()), "the command is not valid")
            return operator, command
        goal = decode(payload, Goal)
        known = None if goal.check else self._goals.get(goal.id)
        if known is not None and known.accepted:
            if goal.lease_s is not None:  # a goal that is put again is its renewal
                return operator, RenewGoal(goal.id)
            raise _Answered(known)
        self._require(check_goal(goal, self._context()), "the goal is not valid", goal.id)
        return operator, RunGoal(self._resolved(goal))

    def _resolved(self, goal: Goal) -> Goal:
        """The goal in the core's form: taught goals as set-points, static markers as their pixels."""
        try:
            ids = goal.follow_markers
            if isinstance(goal.target, IncidenceTarget):
                target, seen = self._teaching.resolve_incidence(goal.target, ids)
                return msgspec.structs.replace(goal, target=target, follow_seen=goal.follow_seen or seen)
            if isinstance(goal.target, StepTarget):
                step = self._teaching.resolve_step(goal.target, goal.centre)
                self._note = step.note
                return msgspec.structs.replace(goal, target=step.target)
            if not isinstance(goal.target, TaughtTarget):
                return goal
            resolved = self._teaching.resolve(goal.target)
            seen = self._teaching.seen_when_taught(goal.target, ids) if ids else {}
        except TransferError as error:
            raise _Answered(self._refused("the goal cannot be placed now", f"target: {error}", goal=goal.id)) from error
        self._note = resolved.note
        goal = msgspec.structs.replace(goal, target=resolved.target, follow_seen=goal.follow_seen or seen)
        self._require(check_goal(goal, self._context()), "the taught goal does not fit the cell any more", goal.id)
        return goal

    def _require(self, problems: list[str], message: str, goal: str = "") -> None:
        if problems:
            raise _Answered(self._refused(message, *problems, goal=goal))

    def _command(self, key: str, payload: bytes) -> tuple[str, Command]:
        verb, operator = self._keys.command_of(key)
        command = decode_command(verb, payload)
        self._require(check_command(command, self._context()), f"the {verb} command is not valid")
        return operator, command

    # -- from the core --------------------------------------------------------------------------------------

    def on_core_reply(self, event: Event) -> None:
        """Handle the core's reply to a request."""
        pending = self._pending.pop(event.request, None)
        if pending is None:
            return
        message = "; ".join(filter(None, (event.message, pending.note)))
        reply = Reply(
            accepted=bool(event.accepted),
            message=message,
            id=event.id,
            request=event.request,
            reasons=event.reasons,
            boot=self._boot,
            plan=event.plan,
        )
        if isinstance(pending.command, RunGoal):
            goal = pending.command.goal
            if not goal.check:
                self._goals[goal.id] = msgspec.structs.replace(reply, plan=None)
                while len(self._goals) > KNOWN_GOALS:
                    self._goals.popitem(last=False)
                if reply.accepted:
                    self._running[goal.id] = RunningGoal(_listed(goal, event.plan), pending.operator, event.plan)
                    while len(self._running) > KNOWN_GOALS:
                        self._running.popitem(last=False)
                    self._log.add_core(event, "goal_accepted", pending.operator)
        moved = pending.command
        if isinstance(moved, UpdateGoal) and reply.accepted and moved.id in self._running:
            before = self._running[moved.id]
            goal = msgspec.structs.replace(before.goal, target=moved.target)
            self._running[moved.id] = msgspec.structs.replace(before, goal=goal)
        streamed = pending.query is None and isinstance(moved, UpdateGoal)
        self._answer(pending.query, reply, pending.operator, streamed)

    def on_core_event(self, event: Event) -> None:
        """Handle an event of the core: a goal that ended is removed."""
        if event.kind in TERMINAL:
            self._running.pop(event.id, None)

    def running(self) -> RunningGoals:
        """Goals that were accepted through this gateway and have not ended."""
        return RunningGoals(tuple(self._running.values()))

    def expire(self) -> None:
        """Reply to requests that the core left unanswered."""
        now = time.monotonic()
        for number in [number for number, pending in self._pending.items() if now > pending.deadline]:
            pending = self._pending.pop(number)
            text = f"the servo process did not answer within {pending.seconds:g} s"
            self._answer(
                pending.query,
                self._refused(f"{text}; whether it took the request is unknown"),
                pending.operator,
            )

    # -- answers --------------------------------------------------------------------------------------------

    def _refused(self, message: str, *problems: str, goal: str = "") -> Reply:
        return Reply(accepted=False, message=message, id=goal, problems=problems, boot=self._boot)

    def _answer(self, query: Any, reply: Reply, operator: str, streamed: bool = False) -> None:
        if query is not None:
            self._replies.reply(query, encode(reply))
        elif not reply.accepted:
            limit = self._stream_limit if streamed else self._put_limit
            if not limit.passes():
                return
            text = "; ".join((reply.message, *reply.problems))
            if limit.held_back:
                text += f" ({limit.held_back} refusals before it are not reported)"
                limit.held_back = 0
            self._log.add(
                "goal_refused",
                message=text,
                id=reply.id,
                operator=operator,
                accepted=False,
                reasons=reply.reasons,
                origin="gateway",
            )


def _listed(goal: Goal, plan: PlanReport | None) -> Goal:
    """``goal`` as it is listed while it runs: a step as the set-points at the end of its plan, by which pages draw it
    and which clients of former versions can read.
    """
    if not isinstance(goal.target, DisplacementTarget) or goal.target.frame is None:
        return goal
    pixels = {} if plan is None else plan.pixels
    ends = {camera: {marker: path[-1] for marker, path in seen.items() if path} for camera, seen in pixels.items()}
    return msgspec.structs.replace(goal, target=FeatureTarget(ends, goal.target.model_epoch))


def payload_of(message: Any) -> bytes:
    """Payload bytes of a query or a sample; empty if it has none."""
    return b"" if message.payload is None else bytes(message.payload.to_bytes())


# -- stop and enable -----------------------------------------------------------------------------------------
# Thread of the gateway with its own zenoh session, which handles stop and enable commands, separate from all other
# traffic.


STOP_POLL_S = 0.002
ACKNOWLEDGE_S = 0.1


NAMELESS = "a client that gives no name"


def sender(message: Any) -> str:
    """Name of the operator who stops the arm, from the payload of a sample or query on ``command/stop``."""
    try:
        return msgspec.json.decode(payload_of(message), type=Stop).operator
    except Exception:  # the arm is stopped whatever the payload is
        return NAMELESS


class StopThread:
    """Handles stop and enable on a separate session, so that load on other keys does not delay them."""

    def __init__(self, config: dict[str, Any], keys: KeySpace, plan: RunPlan, boot: str) -> None:
        self._session = open_session(config)
        self._slot = StopSlot(plan.directories.stop_slot)
        self._boot = boot
        self._key = keys.stop
        self._stops = self._session.declare_queryable(keys.stop, RingChannel(16), complete=True)
        self._puts = self._session.declare_subscriber(keys.stop, RingChannel(16))
        self._enables = self._session.declare_queryable(keys.any_command("enable"), RingChannel(16), complete=True)
        self._replies = ReplyThread()
        self._boundary = Boundary(boot)
        self.enables: deque[Any] = deque(maxlen=16)
        self._asked: tuple[str, int] | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="stop", daemon=True)
        self._thread.start()

    def stopped_by(self, t_ns: int) -> str:
        """Sender of the stop that the core applied at ``t_ns``, returned once; '' if it did not arrive by zenoh."""
        asked, self._asked = self._asked, None
        return asked[0] if asked is not None and asked[1] <= t_ns else ""

    @property
    def refused(self) -> int:
        """Number of messages that could not be handled."""
        return self._boundary.refusals.count

    def _work(self) -> None:
        while not self._ending.is_set():
            try:
                # Only the exact key: a query with a wildcard must not stop the arm.
                while (sample := self._puts.try_recv()) is not None:
                    if str(sample.key_expr) == self._key:
                        self._raise_stop(sample)
                while (query := self._stops.try_recv()) is not None:
                    if str(query.key_expr) == self._key:
                        self._boundary.take(self._key, partial(self._stop, query), partial(self._reply, query))
                    else:
                        query.drop()
                while (query := self._enables.try_recv()) is not None:
                    self.enables.append(query)
            except zenoh.ZError:  # the session was closed by `close`
                return
            self._ending.wait(STOP_POLL_S)

    def _raise_stop(self, message: Any) -> int:
        """Raise the stop; ``message``: the sample or query that requests it."""
        self._asked = sender(message), time.monotonic_ns()  # before its event can arrive
        return self._slot.raise_stop()

    def _stop(self, query: Any) -> None:
        word = self._raise_stop(query)
        until = time.monotonic() + ACKNOWLEDGE_S
        while not self._slot.acknowledged(word) and time.monotonic() < until:
            time.sleep(0.001)
        seen = self._slot.acknowledged(word)
        text = (
            "the servo process has taken the stop"
            if seen
            else "the stop is raised; the servo process has not taken it yet"
        )
        self._reply(query, Reply(accepted=seen, message=text, boot=self._boot))

    def _reply(self, query: Any, reply: Reply) -> None:
        self._replies.reply(query, encode(reply))

    def close(self) -> None:
        """End the thread and close the session."""
        self._ending.set()
        self._thread.join(1.0)
        self._replies.close()
        close_session(self._session, [self._stops, self._puts, self._enables])
        self._slot.close()
