"""Zenoh connection to the daemon of a cell: queries with decoded replies, and the puts that renew a goal's lease."""

from __future__ import annotations

import getpass
import os
import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from stereoservo.client.errors import InvalidReplyError, NoReplyError, RefusedError
from stereoservo.client.session import client_config, close_session, open_session
from stereoservo.messages.discovery import find_daemon
from stereoservo.messages.goals import (
    AcknowledgeGoal,
    CancelGoal,
    Command,
    RenewGoal,
    StreamedTarget,
    UpdateGoal,
)
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.wire import (
    ENCODING,
    EventList,
    MessageError,
    Reply,
    StateMessage,
    encode,
    read,
)

TLS_VARIABLE = "STEREOSERVO_TLS_DIR"
READ_TRIES = 2
"""Number of attempts to query state, events and other data: on a busy computer a reply may take longer than the
time-out, or be lost with a connection that is being reopened. Together they take less time than the hang limit of the
gateway.
"""
READ_PAUSE_S = 0.1
"""Pause before the next attempt [s] if a query ended at once because nobody was there to answer."""
NEXT_EVENT = 2**53
"""Larger than every event number: a query from this number on returns no event, only the number of the next one."""

_T = TypeVar("_T")


class Connection:
    """A zenoh session with the daemon of one cell.

    ``cell``: name, or the path of a cell file. ``endpoint``: a zenoh endpoint; default: the daemon of this host.
    ``tls``: directory with ``ca.pem``, ``cert.pem``, ``key.pem`` (default: ``$STEREOSERVO_TLS_DIR``).
    ``while_waiting``: called repeatedly during waits for an event; an exception that it raises ends the wait.

    Raises NotRunningError, SessionError.
    """

    def __init__(
        self,
        cell: str,
        *,
        endpoint: str | None = None,
        operator: str | None = None,
        timeout_s: float = 2.0,
        tls: Path | None = None,
        while_waiting: Callable[[], None] = lambda: None,
    ) -> None:
        if endpoint is None:
            info = find_daemon(cell)
            cell, endpoint = info.cell, info.endpoint
        self.cell = cell
        self.operator = _default_operator() if operator is None else operator
        self.keys = KeySpace(cell)
        self.goal_key = self.keys.goal(self.operator)
        self.while_waiting = while_waiting
        self._timeout_s = timeout_s
        self._session = open_session(client_config(endpoint, _tls_directory() if tls is None else tls))
        self._closed = False

    @property
    def session(self) -> Any:
        """The underlying zenoh session."""
        return self._session

    def query(self, key: str, payload: bytes = b"", timeout_s: float | None = None) -> bytes:
        """The payload of the first reply on ``key``. Raises NoReplyError."""
        timeout = self._timeout_s if timeout_s is None else timeout_s
        for reply in self._session.get(key, payload=payload, encoding=ENCODING, timeout=timeout):
            if reply.ok is not None:
                return bytes(reply.ok.payload.to_bytes())
        raise NoReplyError(key, timeout)

    def request(self, what: str, key: str, payload: bytes, timeout_s: float | None = None) -> Reply:
        """The accepting reply to a goal or command; ``what`` names it in messages. Raises RefusedError,
        NoReplyError.
        """
        reply = read_message(key, self.query(key, payload, timeout_s), Reply)
        if not reply.accepted:
            raise RefusedError(what, reply)
        return reply

    def fetch(self, key: str, kind: type[_T]) -> _T:
        """Query a message of type ``kind`` on ``key``; repeated up to ``READ_TRIES`` times without a reply, because
        reading has no side effects.

        Raises RefusedError, NoReplyError, InvalidReplyError.
        """
        data = self._read(key)
        try:
            return read_message(key, data, kind)
        except InvalidReplyError as error:
            reply = _refusal(data)
            if reply is None:
                raise
            raise RefusedError(key.rpartition("/")[2], reply) from error

    def _read(self, key: str) -> bytes:
        """The payload of the first reply of up to ``READ_TRIES`` queries. Raises NoReplyError."""
        for _ in range(READ_TRIES - 1):
            asked_s = time.monotonic()
            with suppress(NoReplyError):
                return self.query(key)
            time.sleep(max(0.0, READ_PAUSE_S - (time.monotonic() - asked_s)))
        try:
            return self.query(key)
        except NoReplyError as error:
            raise NoReplyError(key, error.timeout_s, READ_TRIES) from error

    def command(self, verb: str, command: Command) -> Reply:
        """Send a command and return the accepting reply. Raises RefusedError, NoReplyError."""
        return self.request(verb, self.keys.command(verb, self.operator), encode(command))

    def status(self) -> StateMessage:
        """The newest state."""
        return self.fetch(self.keys.state, StateMessage)

    def events(self, first: int = 1) -> EventList:
        """Events from number ``first`` on, one page."""
        return self.fetch(f"{self.keys.event}?from={first}", EventList)

    def cancel(self, goal_id: str) -> Reply:
        """Cancel a goal."""
        return self.command("cancel", CancelGoal(goal_id))

    def update(
        self, goal_id: str, target: StreamedTarget, stamp_s: float | None = None, *, answered: bool = False
    ) -> None:
        """Move the set-points of the active goal, which also renews its lease. ``stamp_s``: their time on this client's
        clock.

        A put, for streams of 30 to 200 Hz: refusals are reported by ``goal_refused`` events, at most one per second.
        ``answered``: a query instead; raises RefusedError.
        """
        command = UpdateGoal(goal_id, target, stamp_s)
        if answered:
            self.command("update", command)
        else:
            self._session.put(self.goal_key, encode(command), encoding=ENCODING)

    def acknowledge(self, goal_id: str) -> Reply:
        """Release a reached goal with ``acknowledge_s``, so that the queue continues. Raises RefusedError."""
        return self.command("acknowledge", AcknowledgeGoal(goal_id))

    def renew(self, goal_id: str) -> None:
        """Renew the lease of a goal (a put: no reply)."""
        self._session.put(self.goal_key, encode(RenewGoal(goal_id)), encoding=ENCODING)

    def close(self) -> None:
        """Close the session. Idempotent."""
        if not self._closed:
            self._closed = True
            close_session(self._session, [])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_message(key: str, data: bytes, kind: type[_T]) -> _T:
    """Decode a message received on ``key``. Raises InvalidReplyError if it is not a ``kind``."""
    try:
        return read(data, kind)
    except MessageError as error:
        raise InvalidReplyError(key, error) from error


def _refusal(data: bytes) -> Reply | None:
    """The reply if ``data`` is a refusal, else None."""
    try:
        reply = read(data, Reply)
    except MessageError:
        return None
    return None if reply.accepted else reply


def _tls_directory() -> Path | None:
    given = os.environ.get(TLS_VARIABLE)
    return Path(given) if given else None


def _default_operator() -> str:
    name = re.sub(r"[^A-Za-z0-9_-]", "", getpass.getuser())[:40] or "user"
    return f"{name}-{os.getpid()}"
