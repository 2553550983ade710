"""Who may do what through the page: host and origin of a request, the one-time token of an operator, the one page
that holds the arm, and the leases of what it has started. Everything is decided on the server, before a request goes
anywhere.
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
    """A request that is not allowed; the text says why, and what would be."""


def allowed_hosts(address: str, port: int, names: Sequence[str] = ()) -> frozenset[str]:
    """Values of the header ``Host`` that name this server, an address or name with its port.

    ``names``: more of them. One that listens beyond loopback has the computer's name, too.
    """
    if address in ("localhost", "127.0.0.1", "::1"):
        own = {*LOOPBACK, address}
    else:
        computer = socket.gethostname().lower()
        own = {address, computer, f"{computer.partition('.')[0]}.local"}
    return frozenset(value for name in own | {name.lower() for name in names} for value in _values(name, port))


def _values(name: str, port: int) -> tuple[str, ...]:
    """What browsers send as ``Host`` for a name or address; they leave out the ports of http and https."""
    written = f"[{name}]" if ":" in name and not name.startswith("[") else name
    return (f"{written}:{port}", written) if port in (80, 443) else (f"{written}:{port}",)


def check_host(host: str | None, allowed: frozenset[str], reached: str, port: int) -> None:
    """Raises RightsError unless ``host`` names this server: another page's name may resolve to it (DNS rebinding).

    ``reached``: the address of this computer at which the request came in, which is a name of it, too; a page of
    another origin has a name of its own.
    """
    if host is None or host.lower() not in {*allowed, *_values(reached, port)}:
        raise RightsError(
            f"Host {host!r} is not this server; {', '.join(sorted(allowed))} are, and --host NAME adds others"
        )


def check_origin(origin: str | None, host: str | None, secure: bool) -> None:
    """Raises RightsError where a browser says that another page opens the WebSocket.

    Programs send no ``Origin``; browsers always do.
    """
    if origin is None:
        return
    parts = urlsplit(origin)
    if parts.scheme != ("https" if secure else "http") or parts.netloc.lower() != (host or "").lower():
        raise RightsError(f"Origin {origin!r} is another page's; this server is {host!r}")


class ArmHolder:
    """Which page holds the arm: the one that has shown the token, until it is closed.

    ``operator``: the name given with ``--operate``; None: nobody may hold it. ``announce``: called with each new token;
    one is made at the start, and another as soon as one has been used, so that none works twice.
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
        """End ``page``'s hold; returns whether it had it."""
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
        """Whether a page holds the arm."""
        return self._holder is not None

    def require(self, page: object, what: str) -> None:
        """Raises RightsError unless ``page`` holds the arm."""
        if self._holder is not page:
            how = (
                "this page is read-only and may stop the arm, nothing else"
                if self.operator is None
                else "this page does not hold the arm: give the token that stands in the terminal; stop works without"
            )
            raise RightsError(f"{what}: {how}")


# -- leases --------------------------------------------------------------------------------------------------
# Leases of what the page that holds the arm has started: renewed as long as that page is there, over whatever session
# with the daemon is open.


LEASE_S = 2.0
"""A page that is closed, or loses its server, stops the arm after it."""
RENEW_EVERY_S = LEASE_S / 8.0
"""Seven renewals may be late or lost: a session that is opened anew, or a machine that stalls, costs no goal."""
ENDS = (*TERMINAL, "calibration_finished", "check_finished", "calibration_aborted", "calibration_failed")


class Renewing(Protocol):
    """What renews a lease: a `stereoservo.client.Client`."""

    def renew(self, goal_id: str) -> None:
        """Renew the lease of a motion."""


class Leases:
    """Renews leases from a thread; ``client``: the one of the present session, None while there is none."""

    def __init__(self, client: Callable[[], Renewing | None]) -> None:
        self._client = client
        self._accepted: dict[str, bool] = {}
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="page-leases", daemon=True)

    def start(self) -> None:
        """Begin to renew."""
        self._thread.start()

    def _work(self) -> None:
        while not self._closed.wait(RENEW_EVERY_S):
            self.renew()

    def renew(self) -> None:
        """Renew all that were accepted, where there is a session; one that is closed meanwhile is soon replaced."""
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
        """Renew the lease of ``motion`` once what is done within has returned: it asks for the motion.

        Not before: a lease of what is not accepted yet would be refused. Its end may be told before its acceptance is:
        then it is not renewed.
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

    def take_event(self, event: EventMessage) -> None:
        """Renew no longer what ``event`` ends, or what the daemon does not know any more (its end went unheard)."""
        unknown = event.kind == "goal_refused" and any(reason.code == "NO_SUCH_GOAL" for reason in event.reasons)
        if event.kind in ENDS or (unknown and event.id in self.renewed):
            self._drop(event.id)

    def _drop(self, motion: str) -> None:
        with self._lock:
            self._accepted.pop(motion, None)

    def end(self) -> None:
        """Renew none any more: what was started ends within `LEASE_S`."""
        with self._lock:
            self._accepted.clear()

    def close(self) -> None:
        """End all and the thread. Idempotent."""
        self.end()
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(RENEW_EVERY_S)
