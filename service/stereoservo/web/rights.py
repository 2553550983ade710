"""Access rights of pages: host and origin of a request, the one-time token of an operator, the one page that holds the
arm, and the leases of the motions that it has started. The server checks everything before it forwards a request.
"""

from __future__ import annotations

import hmac
import secrets
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Protocol
from urllib.parse import urlsplit

from zenoh import ZError

from stereoservo.client.goal_handle import TERMINAL
from stereoservo.messages.wire import EventMessage

LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


class RightsError(Exception):
    """A request that is not allowed; the text has the reason, and what would be allowed."""


def allowed_hosts(address: str, port: int, names: Sequence[str] = ()) -> frozenset[str]:
    """Valid values of the header ``Host``: names or addresses of this server, with its port.

    ``names``: further names. A server that listens beyond loopback accepts the computer's name, too.
    """
    if address in ("localhost", "127.0.0.1", "::1"):
        own = {*LOOPBACK, address}
    else:
        computer = socket.gethostname().lower()
        own = {address, computer, f"{computer.partition('.')[0]}.local"}
    return frozenset(value for name in own | {name.lower() for name in names} for value in _values(name, port))


def _values(name: str, port: int) -> tuple[str, ...]:
    """Values that browsers send as ``Host`` for a name or address; they omit the ports of http and https."""
    written = f"[{name}]" if ":" in name and not name.startswith("[") else name
    return (f"{written}:{port}", written) if port in (80, 443) else (f"{written}:{port}",)


def check_host(host: str | None, allowed: frozenset[str], reached: str, port: int) -> None:
    """Raise RightsError unless ``host`` names this server: another page's name may resolve to it (DNS rebinding).

    ``reached``: the address of this computer at which the request arrived, which is a valid name, too; a page of
    another origin has a name of its own.
    """
    if host is None or host.lower() not in {*allowed, *_values(reached, port)}:
        raise RightsError(
            f"Host {host!r} is not this server; {', '.join(sorted(allowed))} are, and --host NAME adds others"
        )


def check_origin(origin: str | None, host: str | None, secure: bool) -> None:
    """Raise RightsError if a browser reports that another page opens the WebSocket.

    Programs send no ``Origin``; browsers always do.
    """
    if origin is None:
        return
    parts = urlsplit(origin)
    if parts.scheme != ("https" if secure else "http") or parts.netloc.lower() != (host or "").lower():
        raise RightsError(f"Origin {origin!r} is another page's; this server is {host!r}")


class ArmHolder:
    """Record of the page that holds the arm: the one that presented the token, until it is closed.

    ``operator``: the name given with ``--operate``; None: no page may hold the arm. ``announce``: called with each new
    token; one is made at the start, and another as soon as one has been used, so that each is valid once.
    """

    def __init__(self, operator: str | None, announce: Callable[[str], None]) -> None:
        self.operator = operator
        self._announce = announce
        self._lock = threading.Lock()
        self._token = ""
        self._holder: object | None = None
        if operator is not None:
            self._renew()

    def _renew(self) -> None:
        self._token = secrets.token_urlsafe(12)
        self._announce(self._token)

    def take(self, page: object, token: str) -> None:
        """Let ``page`` hold the arm. Raises RightsError: read-only, a wrong or used token, or another page holds it."""
        with self._lock:
            if self.operator is None:
                raise RightsError("this page is read-only; `stereoservo web CELL --operate NAME` lets one command")
            if self._holder is page:
                return
            if self._holder is not None:
                raise RightsError(f"another page holds the arm as {self.operator}; close it, or release it there")
            if not hmac.compare_digest(self._token.encode(), token.encode()):
                raise RightsError(
                    "this token is wrong, or was used before; the newest stands in the terminal of `stereoservo web`"
                )
            self._holder = page
            self._renew()

    def release(self, page: object) -> bool:
        """Release the arm if ``page`` holds it; returns whether it did."""
        with self._lock:
            had = self._holder is page
            if had:
                self._holder = None
            return had

    def holds(self, page: object) -> bool:
        """Whether ``page`` holds the arm."""
        return self._holder is page

    @property
    def taken(self) -> bool:
        """Whether any page holds the arm."""
        return self._holder is not None

    def require(self, page: object, what: str) -> None:
        """Raise RightsError unless ``page`` holds the arm."""
        if self._holder is not page:
            how = (
                "this page is read-only and may stop the arm, nothing else"
                if self.operator is None
                else "this page does not hold the arm: give the token that stands in the terminal; stop works without"
            )
            raise RightsError(f"{what}: {how}")


# -- leases --------------------------------------------------------------------------------------------------
# Leases of motions started by the page that holds the arm: renewed as long as that page is open, over whatever session
# with the daemon is open.


LEASE_S = 2.0
"""Time [s] after which the arm stops if its page was closed, or lost its server."""
RENEW_EVERY_S = LEASE_S / 8.0
"""Interval of renewals [s]. Seven may be late or lost: a reconnected session or a stalled machine ends no goal."""
ENDS = (*TERMINAL, "calibration_finished", "check_finished", "calibration_aborted", "calibration_failed")


class Renewing(Protocol):
    """Interface that renews a lease: a `stereoservo.client.Client`."""

    def renew(self, goal_id: str) -> None:
        """Renew the lease of a motion."""


class Leases:
    """Renews leases from a thread; ``client`` returns the current session's, None while there is none."""

    def __init__(self, client: Callable[[], Renewing | None]) -> None:
        self._client = client
        self._accepted: dict[str, bool] = {}
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="page-leases", daemon=True)

    def start(self) -> None:
        """Start renewing."""
        self._thread.start()

    def _work(self) -> None:
        while not self._closed.wait(RENEW_EVERY_S):
            self.renew()

    def renew(self) -> None:
        """Renew all accepted motions, if there is a session; one that is closed meanwhile is soon replaced."""
        client = self._client()
        if client is not None:
            for motion in self.renewed:
                with suppress(ZError):
                    client.renew(motion)

    @property
    def renewed(self) -> tuple[str, ...]:
        """Motions whose leases are renewed."""
        with self._lock:
            return tuple(motion for motion, accepted in self._accepted.items() if accepted)

    @contextmanager
    def held(self, motion: str) -> Iterator[None]:
        """Context manager around the request for ``motion``: once it has returned, renew the motion's lease.

        Not earlier: a renewal would be refused before the motion is accepted. If its end is reported before its
        acceptance, it is not renewed.
        """
        with self._lock:
            self._accepted[motion] = False
        try:
            yield
        except BaseException:
            self._drop(motion)
            raise
        with self._lock:
            if motion in self._accepted:
                self._accepted[motion] = True

    def on_event(self, event: EventMessage) -> None:
        """Stop renewing a motion that ``event`` ends, or that the daemon no longer has (its end was not received)."""
        unknown = event.kind == "goal_refused" and any(reason.code == "NO_SUCH_GOAL" for reason in event.reasons)
        if event.kind in ENDS or (unknown and event.id in self.renewed):
            self._drop(event.id)

    def _drop(self, motion: str) -> None:
        with self._lock:
            self._accepted.pop(motion, None)

    def end(self) -> None:
        """Stop renewing all leases: the motions end within `LEASE_S`."""
        with self._lock:
            self._accepted.clear()

    def close(self) -> None:
        """End all leases and the thread. Idempotent."""
        self.end()
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(RENEW_EVERY_S)
