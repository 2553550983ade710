"""Leases of what the page that holds the arm has started: renewed as long as that page is there, over whatever session
with the daemon is open.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

from zenoh import ZError

from stereoservo.client.goal_handle import TERMINAL
from stereoservo.messages.wire import EventMessage

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
        unknown = event.kind == "goal_refused" and any(
            reason.code == "NO_SUCH_GOAL" for reason in event.reasons
        )
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
