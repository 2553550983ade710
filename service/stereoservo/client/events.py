"""Event subscription of a client: a cell's events in order and without gaps."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Self

from zenoh.handlers import RingChannel

from stereoservo.client.connection import NEXT_EVENT, Connection, read_message
from stereoservo.client.errors import DaemonLostError, InvalidReplyError, NoReplyError, TimedOutError
from stereoservo.messages.wire import EventMessage, MessageError

POLL_S = 0.01
ALIVE_EVERY_S = 1.0


class EventWatch:
    """Events since construction, in order and without gaps: events that the subscription lost are queried."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._subscriber = connection.session.declare_subscriber(connection.keys.event, RingChannel(1024))
        state = connection.status()
        self._boot = state.boot
        self._next = connection.events(NEXT_EVENT).next
        self._alive = time.monotonic()
        self._left: deque[EventMessage] = deque()
        """Events that arrived in the same poll after an awaited one."""

    def poll(self) -> list[EventMessage]:
        """Events since the last poll. Raises DaemonLostError, InvalidReplyError."""
        found = list(self._left)
        self._left.clear()
        while (sample := self._subscriber.try_recv()) is not None:
            event = read_message(str(sample.key_expr), sample.payload.to_bytes(), EventMessage)
            if event.boot != self._boot:
                raise DaemonLostError(f"the gateway of cell {self._connection.cell!r} was restarted; ask for the state")
            if event.seq > self._next:
                self._fill(found, event.seq)
            if event.seq == self._next:
                found.append(event)
                self._next += 1
        if found:
            self._alive = time.monotonic()
        elif time.monotonic() - self._alive > ALIVE_EVERY_S:
            self._check()
            self._fill(found, NEXT_EVENT)
        return found

    def _fill(self, found: list[EventMessage], before: int) -> None:
        while self._next < before:
            page = self._connection.events(self._next)
            if page.first > self._next:
                raise DaemonLostError(f"events {self._next} to {page.first - 1} are no longer kept")
            some = [event for event in page.events if event.seq < before]
            if not some:
                return
            numbers = [event.seq for event in some]
            if numbers != list(range(self._next, self._next + len(some))):
                raise InvalidReplyError(
                    self._connection.keys.event,
                    MessageError(f"events {numbers[:5]} in reply to a query from {self._next} on"),
                )
            found.extend(some)
            self._next = some[-1].seq + 1

    def _check(self) -> None:
        try:
            boot = self._connection.status().boot
        except NoReplyError as error:
            raise DaemonLostError(f"the daemon of cell {self._connection.cell!r} no longer answers") from error
        if boot != self._boot:
            raise DaemonLostError(f"the gateway of cell {self._connection.cell!r} was restarted; ask for the state")
        self._alive = time.monotonic()

    def wait(self, wanted: Callable[[EventMessage], bool], what: str, timeout_s: float) -> EventMessage:
        """Wait for a later event for which ``wanted`` returns True. Raises TimedOutError, DaemonLostError."""
        until = time.monotonic() + timeout_s
        while True:
            self._left.extend(self.poll())
            while self._left:
                event = self._left.popleft()
                if wanted(event):
                    return event
            self._connection.while_waiting()
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


class HeardEvents:
    """Events of one subject, received by a watch. A wait also finds events that arrived before it, because events of
    several processes arrive in any order.

    ``concerns``: whether an event belongs to the subject; ``hear``: called with each of these, once, in order.
    """

    def __init__(
        self,
        watch: EventWatch,
        concerns: Callable[[EventMessage], bool],
        hear: Callable[[EventMessage], None],
    ) -> None:
        self._watch = watch
        self._concerns = concerns
        self._hear = hear
        self._first: dict[str, EventMessage] = {}

    def poll(self) -> None:
        """Process the events that have arrived. Raises DaemonLostError, InvalidReplyError."""
        for event in self._watch.poll():
            self._take(event)

    def _take(self, event: EventMessage) -> bool:
        if not self._concerns(event):
            return False
        self._first.setdefault(event.kind, event)
        self._hear(event)
        return True

    def wait(self, kinds: tuple[str, ...], what: str, timeout_s: float) -> EventMessage:
        """The first event of one of ``kinds``, received already or awaited. Raises TimedOutError, DaemonLostError."""
        heard = [self._first[kind] for kind in kinds if kind in self._first]
        if heard:
            return min(heard, key=lambda event: event.seq)
        return self._watch.wait(lambda event: self._take(event) and event.kind in kinds, what, timeout_s)
