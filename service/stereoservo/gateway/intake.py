"""Goals and commands from zenoh: decoded strictly, checked statically, forwarded to the core, answered
when it has.

Nothing here waits: an unanswered request is kept with its deadline.
"""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from stereoservo.gateway.keys import InvalidKeyError, KeySpace
from stereoservo.gateway.messages import MessageError, Reply, decode, decode_command, encode
from stereoservo.gateway.publisher import EventLog, ReplyThread
from stereoservo.gateway.servolink import ServoLink
from stereoservo.gateway.stores import TaughtStore
from stereoservo.gateway.validation import GoalContext, check_command, check_goal
from stereoservo.runtime.commands import CancelGoal, Command, Goal, RenewGoal, RunGoal, TaughtTarget
from stereoservo.runtime.cycle import Event

REPLY_TIMEOUT_S = 1.0
KNOWN_GOALS = 1000


@dataclass
class _Pending:
    query: Any
    command: Command
    operator: str
    deadline: float


class _Answered(Exception):  # noqa: N818 - not an error: the way out with a reply
    def __init__(self, reply: Reply) -> None:
        super().__init__(reply.message)
        self.reply = reply


class Intake:
    """Takes goals and commands of all operators."""

    def __init__(
        self,
        keys: KeySpace,
        link: ServoLink,
        replies: ReplyThread,
        log: EventLog,
        context: Callable[[], GoalContext],
        taught: TaughtStore,
        boot: str,
    ) -> None:
        self._keys = keys
        self._link = link
        self._replies = replies
        self._log = log
        self._context = context
        self._taught = taught
        self._boot = boot
        self._pending: dict[int, _Pending] = {}
        self._goals: OrderedDict[str, Reply] = OrderedDict()

    # -- from zenoh -----------------------------------------------------------------------------------------

    def goal_query(self, query: Any) -> None:
        """A goal by ``get``: the reply says accepted or refused."""
        self._take(query, str(query.key_expr), _payload(query), self._goal)

    def goal_sample(self, sample: Any) -> None:
        """A goal, or a renewal, by ``put``: nobody hears a reply, so a refusal becomes an event."""
        self._take(None, str(sample.key_expr), sample.payload.to_bytes(), self._goal)

    def command_query(self, query: Any) -> None:
        """A command by ``get``."""
        self._take(query, str(query.key_expr), _payload(query), self._command)

    def _take(
        self, query: Any, key: str, payload: bytes, work: Callable[[str, bytes], tuple[str, Command]]
    ) -> None:
        if query is not None and "*" in key:
            query.drop()  # somebody looks around; goals and commands are addressed
            return
        operator = ""
        try:
            operator, command = work(key, payload)
            number = self._link.ask(command, operator)
            if number is None:
                raise _Answered(
                    self._refused("the servo process does not take requests; see `stereoservo status`")
                )
        except (MessageError, InvalidKeyError) as error:
            self._answer(query, self._refused("the message is not valid", str(error)), operator or key)
        except _Answered as answered:
            self._answer(query, answered.reply, operator or key)
        else:
            self._pending[number] = _Pending(query, command, operator, time.monotonic() + REPLY_TIMEOUT_S)

    def _goal(self, key: str, payload: bytes) -> tuple[str, Command]:
        operator = self._keys.operator_of_goal(key)
        if b'"command"' in payload:
            return operator, decode(payload, RenewGoal | CancelGoal)  # type: ignore[arg-type]
        goal = decode(payload, Goal)
        known = None if goal.check else self._goals.get(goal.id)
        if known is not None and known.accepted:
            if goal.lease_s is not None:  # the goal put again is its renewal
                return operator, RenewGoal(goal.id)
            raise _Answered(known)
        problems = check_goal(goal, self._context())
        if problems:
            raise _Answered(self._refused("the goal is not valid", *problems, goal=goal.id))
        if isinstance(goal.target, TaughtTarget):
            goal = msgspec.structs.replace(goal, target=self._taught.target(goal.target.name))
            problems = check_goal(goal, self._context())
            if problems:
                raise _Answered(
                    self._refused("the taught goal does not fit the cell any more", *problems, goal=goal.id)
                )
        return operator, RunGoal(goal)

    def _command(self, key: str, payload: bytes) -> tuple[str, Command]:
        verb, operator = self._keys.command_of(key)
        command = decode_command(verb, payload)
        problems = check_command(command, self._context().settings)
        if problems:
            raise _Answered(self._refused(f"the {verb} command is not valid", *problems))
        return operator, command

    # -- from the core --------------------------------------------------------------------------------------

    def core_reply(self, event: Event) -> None:
        """The core's answer to a request."""
        pending = self._pending.pop(event.request, None)
        if pending is None:
            return
        reply = Reply(
            accepted=bool(event.accepted), message=event.message, id=event.id, request=event.request,
            reasons=event.reasons, boot=self._boot,
        )  # fmt: skip
        if isinstance(pending.command, RunGoal):
            goal = pending.command.goal
            if not goal.check:
                self._goals[goal.id] = reply
                while len(self._goals) > KNOWN_GOALS:
                    self._goals.popitem(last=False)
                if reply.accepted:
                    self._log.add_core(event, "goal_accepted", pending.operator)
        self._answer(pending.query, reply, pending.operator)

    def operator_of(self, request: int) -> str:
        """Who made a request that still waits; empty when unknown."""
        pending = self._pending.get(request)
        return "" if pending is None else pending.operator

    def expire(self) -> None:
        """Answer what the core left unanswered."""
        now = time.monotonic()
        for number in [number for number, pending in self._pending.items() if now > pending.deadline]:
            pending = self._pending.pop(number)
            text = f"the servo process did not answer within {REPLY_TIMEOUT_S:g} s"
            self._answer(
                pending.query,
                self._refused(f"{text}; whether it took the request is unknown"),
                pending.operator,
            )

    # -- answers --------------------------------------------------------------------------------------------

    def _refused(self, message: str, *problems: str, goal: str = "") -> Reply:
        return Reply(accepted=False, message=message, id=goal, problems=problems, boot=self._boot)

    def _answer(self, query: Any, reply: Reply, operator: str) -> None:
        if query is not None:
            self._replies.reply(query, encode(reply))
        elif not reply.accepted:
            text = "; ".join((reply.message, *reply.problems))
            self._log.add(
                "goal_refused",
                message=text,
                id=reply.id,
                operator=operator,
                accepted=False,
                reasons=reply.reasons,
                origin="gateway",
            )


def _payload(query: Any) -> bytes:
    return b"" if query.payload is None else bytes(query.payload.to_bytes())
