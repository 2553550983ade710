"""How a client follows what it asked for: events without gaps, goals to their ends."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import msgspec
import zenoh
from zenoh.handlers import RingChannel

from stereoservo.control.reasons import Reason
from stereoservo.gateway.errors import ClientError, DaemonLostError, NoReplyError, TimedOutError
from stereoservo.gateway.messages import EventMessage, Reply
from stereoservo.runtime.commands import Goal, StreamedTarget

if TYPE_CHECKING:
    from stereoservo.gateway.client import Client

POLL_S = 0.01
ALIVE_EVERY_S = 1.0
TERMINAL = {
    "goal_reached": "reached",
    "goal_aborted": "aborted",
    "goal_cancelled": "cancelled",
    "goal_preempted": "preempted",
}


class GoalResult(msgspec.Struct, frozen=True):
    """How a goal ended."""

    id: str
    outcome: Literal["reached", "aborted", "cancelled", "preempted"]
    message: str
    error_px: float | None
    reasons: tuple[Any, ...]
    seconds: float

    @property
    def why(self) -> str:
        """The message, and the fault where one ended the goal."""
        faults = [reason.hint for reason in self.reasons if reason.level == "fault"]
        return ": ".join([self.message, *faults])


class GoalProgress(msgspec.Struct, frozen=True):
    """How far a goal is: ``progress`` of its way [0, 1] and ``seconds_left`` where known, ``reasons`` in words.

    ``active``: False while it is queued and once it has ended.
    """

    active: bool
    progress: float | None
    seconds_left: float | None
    error_px: float | None
    reasons: tuple[Reason, ...]


class EventWatch:
    """Events from now on, in order and without gaps: what a subscription lost is asked for."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self._subscriber = client.session.declare_subscriber(client.keys.event, RingChannel(1024))
        state = client.status()
        self._boot = state.boot
        self._next = client.events(1 << 60).next
        self._alive = time.monotonic()

    def poll(self) -> list[EventMessage]:
        """What happened since the last poll. Raises DaemonLostError."""
        found: list[EventMessage] = []
        while (sample := self._subscriber.try_recv()) is not None:
            event = msgspec.json.decode(sample.payload.to_bytes(), type=EventMessage)
            if event.boot != self._boot:
                raise DaemonLostError(
                    f"the gateway of cell {self._client.cell!r} was started anew; ask for the state"
                )
            if event.seq > self._next:
                self._fill(found, event.seq)
            if event.seq == self._next:
                found.append(event)
                self._next += 1
        if found:
            self._alive = time.monotonic()
        elif time.monotonic() - self._alive > ALIVE_EVERY_S:
            self._check()
            self._fill(found, 1 << 60)
        return found

    def _fill(self, found: list[EventMessage], before: int) -> None:
        while self._next < before:
            page = self._client.events(self._next)
            if page.first > self._next:
                raise DaemonLostError(f"events {self._next} to {page.first - 1} are no longer kept")
            some = [event for event in page.events if event.seq < before]
            if not some:
                return
            found.extend(some)
            self._next = some[-1].seq + 1

    def _check(self) -> None:
        try:
            boot = self._client.status().boot
        except NoReplyError as error:
            raise DaemonLostError(f"the daemon of cell {self._client.cell!r} no longer answers") from error
        if boot != self._boot:
            raise DaemonLostError(
                f"the gateway of cell {self._client.cell!r} was started anew; ask for the state"
            )
        self._alive = time.monotonic()

    def wait(self, wanted: Callable[[EventMessage], bool], what: str, timeout_s: float) -> EventMessage:
        """Wait for an event. Raises TimedOutError, DaemonLostError."""
        until = time.monotonic() + timeout_s
        while True:
            for event in self.poll():
                if wanted(event):
                    return event
            self._client.while_waiting()
            if time.monotonic() > until:
                raise TimedOutError(f"{what}: nothing within {timeout_s:g} s")
            time.sleep(POLL_S)

    def close(self) -> None:
        """End the subscription. Idempotent."""
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Lease:
    """Renews the lease of something that moves the arm, from a thread of this client, until it is ended."""

    def __init__(self, client: Client, goal_id: str, lease_s: float | None) -> None:
        self._client = client
        self._id = goal_id
        self._ended = threading.Event()
        if lease_s is not None:
            threading.Thread(
                target=self._renew, args=(lease_s / 3.0,), name=f"lease {goal_id}", daemon=True
            ).start()

    def _renew(self, every_s: float) -> None:
        while not self._ended.wait(every_s):
            try:
                self._client.renew(self._id)
            except zenoh.ZError:  # the session is closed: the lease runs out, as it should
                return

    def end(self) -> None:
        """Renew no more. Idempotent."""
        self._ended.set()


class GoalHandle:
    """A goal that was accepted. As a context manager it cancels the goal when left before its end."""

    def __init__(self, client: Client, goal: Goal, watch: EventWatch, reply: Reply) -> None:
        self.id = goal.id
        self.plan = reply.plan
        self.message = reply.message
        self._client = client
        self._watch = watch
        self._started = time.monotonic()
        self._result: GoalResult | None = None
        self._ended = False
        self._lease = Lease(client, goal.id, goal.lease_s)

    def wait(self, timeout_s: float = 600.0) -> GoalResult:
        """Wait for its terminal event. Raises TimedOutError (the goal goes on), DaemonLostError."""
        if self._result is None:
            event = self._watch.wait(
                lambda e: e.id == self.id and e.kind in TERMINAL, f"goal {self.id}", timeout_s
            )
            self._finish(event)
        assert self._result is not None
        return self._result

    def reached(self, timeout_s: float = 600.0) -> GoalResult:
        """Like :meth:`wait`, and raises ClientError unless the goal was reached."""
        result = self.wait(timeout_s)
        if result.outcome != "reached":
            raise ClientError(f"goal {self.id} was {result.outcome}: {result.why}")
        return result

    @property
    def ended(self) -> bool:
        """Whether its terminal event was seen, by :meth:`wait` or while streaming."""
        return self._result is not None

    def progress(self) -> GoalProgress:
        """How far it is now, and in words why it is slow or stuck. Raises NoReplyError."""
        state = self._client.status()
        if state.goal != self.id:
            return GoalProgress(False, None, None, None, ())
        return GoalProgress(True, state.progress, state.seconds_left, state.error_px, state.reasons)

    def update(self, target: StreamedTarget, stamp_s: float | None = None) -> None:
        """Move its set-points; see `Client.update`."""
        self._client.update(self.id, target, stamp_s)

    def stream(self, set_points: Iterable[tuple[float | None, StreamedTarget]]) -> int:
        """Put (stamp [s], target) as they come, until they, or the goal, end; gives how many were put.

        The iterable sets the pace. Raises DaemonLostError.
        """
        count = 0
        for stamp_s, target in set_points:
            self._look()
            if self._result is not None:
                break
            self.update(target, stamp_s)
            count += 1
        return count

    def acknowledge(self) -> None:
        """Reached, it may be left: the queue goes on. Raises RefusedError."""
        self._client.acknowledge(self.id)

    def _look(self) -> None:
        for event in self._watch.poll():
            if event.id == self.id and event.kind in TERMINAL:
                self._finish(event)
                return

    def _finish(self, event: EventMessage) -> None:
        self._end()
        outcome: Any = TERMINAL[event.kind]
        seconds = time.monotonic() - self._started
        self._result = GoalResult(self.id, outcome, event.message, event.error_px, event.reasons, seconds)

    def cancel(self) -> None:
        """Cancel it."""
        self._client.cancel(self.id)

    def abandon(self) -> None:
        """Stop renewing and watching; the goal goes on until its lease or time limit ends."""
        self._end()

    def _end(self) -> None:
        self._ended = True
        self._lease.end()
        self._watch.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._result is None and not self._ended:
            self._end()
            self.cancel()
