"""Handle of a goal that a cell has accepted: renews its lease from a thread, reports progress, cancels it, and waits
for its end.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from types import TracebackType
from typing import Any, Literal, Self

import msgspec
import zenoh

from stereoservo.client.connection import Connection
from stereoservo.client.errors import ClientError
from stereoservo.client.events import EventWatch
from stereoservo.messages.goals import Goal, StreamedTarget
from stereoservo.messages.reasons import Reason
from stereoservo.messages.wire import EventMessage, Reply

TERMINAL = {
    "goal_reached": "reached",
    "goal_aborted": "aborted",
    "goal_cancelled": "cancelled",
    "goal_preempted": "preempted",
}


class GoalResult(msgspec.Struct, frozen=True):
    """Outcome of a goal."""

    id: str
    outcome: Literal["reached", "aborted", "cancelled", "preempted"]
    message: str
    error_px: float | None
    reasons: tuple[Any, ...]
    seconds: float

    @property
    def why(self) -> str:
        """The message, with the fault if one ended the goal."""
        faults = [reason.hint for reason in self.reasons if reason.level == "fault"]
        return ": ".join([self.message, *faults])


class GoalProgress(msgspec.Struct, frozen=True):
    """Progress of a goal: path parameter ``progress`` [0, 1], ``seconds_left`` if known, ``reasons``.

    ``active``: False while it is queued and once it has ended.
    """

    active: bool
    progress: float | None
    seconds_left: float | None
    error_px: float | None
    reasons: tuple[Reason, ...]


class Lease:
    """Renews the lease of a motion from a thread, until :meth:`end`."""

    def __init__(self, connection: Connection, goal_id: str, lease_s: float | None) -> None:
        self._connection = connection
        self._id = goal_id
        self._ended = threading.Event()
        if lease_s is not None:
            threading.Thread(target=self._renew, args=(lease_s / 3.0,), name=f"lease {goal_id}", daemon=True).start()

    def _renew(self, every_s: float) -> None:
        while not self._ended.wait(every_s):
            try:
                self._connection.renew(self._id)
            except zenoh.ZError:  # the session is closed: the lease expires, as intended
                return

    def end(self) -> None:
        """Stop renewing. Idempotent."""
        self._ended.set()


class GoalHandle:
    """An accepted goal. As a context manager it cancels the goal on exit if it has not ended."""

    def __init__(self, connection: Connection, goal: Goal, watch: EventWatch, reply: Reply) -> None:
        self.id = goal.id
        self.plan = reply.plan
        self.message = reply.message
        self._connection = connection
        self._watch = watch
        self._started = time.monotonic()
        self._result: GoalResult | None = None
        self._ended = False
        self._lease = Lease(connection, goal.id, goal.lease_s)

    def wait(self, timeout_s: float = 600.0, progress: Callable[[EventMessage], None] | None = None) -> GoalResult:
        """Wait for its terminal event. ``progress`` is called with each of its events, for example when the arm is
        held.

        Raises TimedOutError (the goal continues), DaemonLostError.
        """

        def ends(event: EventMessage) -> bool:
            if event.id != self.id:
                return False
            if progress is not None:
                progress(event)
            return event.kind in TERMINAL

        if self._result is None:
            self._finish(self._watch.wait(ends, f"goal {self.id}", timeout_s))
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
        """Whether its terminal event was received, by :meth:`wait` or while streaming."""
        return self._result is not None

    def progress(self) -> GoalProgress:
        """Its progress, and the reasons why it is slow or held. Raises NoReplyError."""
        state = self._connection.status()
        if state.goal != self.id:
            return GoalProgress(False, None, None, None, ())
        return GoalProgress(True, state.progress, state.seconds_left, state.error_px, state.reasons)

    def update(self, target: StreamedTarget, stamp_s: float | None = None) -> None:
        """Move its set-points; see `Client.update`."""
        self._connection.update(self.id, target, stamp_s)

    def stream(self, set_points: Iterable[tuple[float | None, StreamedTarget]]) -> int:
        """Send pairs (stamp [s], target) until the iterable or the goal ends; returns the number sent.

        The iterable sets the pace. Raises DaemonLostError.
        """
        count = 0
        for stamp_s, target in set_points:
            self._poll_end()
            if self._result is not None:
                break
            self.update(target, stamp_s)
            count += 1
        return count

    def acknowledge(self) -> None:
        """Release the reached goal, so that the queue continues. Raises RefusedError."""
        self._connection.acknowledge(self.id)

    def _poll_end(self) -> None:
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
        """Cancel the goal."""
        self._connection.cancel(self.id)

    def abandon(self) -> None:
        """Stop renewing and watching; the goal continues until its lease or time limit ends."""
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
