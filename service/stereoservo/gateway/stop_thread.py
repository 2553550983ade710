"""Thread of the gateway with its own zenoh session, which handles stop and enable commands, separate from all other
traffic.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from functools import partial
from typing import Any

import msgspec
import zenoh
from zenoh.handlers import RingChannel

from stereoservo.client.session import close_session, open_session
from stereoservo.daemon.ipc_messages import RunPlan
from stereoservo.daemon.seqlock import StopSlot
from stereoservo.gateway.boundary import Boundary
from stereoservo.gateway.intake import payload_of
from stereoservo.gateway.publisher import ReplyThread
from stereoservo.messages.goals import Stop
from stereoservo.messages.keys import KeySpace
from stereoservo.messages.wire import Reply, encode

STOP_POLL_S = 0.002
ACKNOWLEDGE_S = 0.1


NAMELESS = "a client that gives no name"


def sender(message: Any) -> str:
    """Who stops the arm, by the payload of a sample or query on ``command/stop``."""
    try:
        return msgspec.json.decode(payload_of(message), type=Stop).operator
    except Exception:  # whatever the payload is, the arm is stopped
        return NAMELESS


class StopThread:
    """Handles stop and enable on a session of its own, so that no load on other keys delays them."""

    def __init__(self, config: dict[str, Any], keys: KeySpace, plan: RunPlan, boot: str) -> None:
        self._session = open_session(config)
        self._slot = StopSlot(plan.directories.stop_slot)
        self._boot = boot
        self._key = keys.stop
        self._stops = self._session.declare_queryable(keys.stop, RingChannel(16), complete=True)
        self._puts = self._session.declare_subscriber(keys.stop, RingChannel(16))
        self._enables = self._session.declare_queryable(
            keys.any_command("enable"), RingChannel(16), complete=True
        )
        self._replies = ReplyThread()
        self._boundary = Boundary(boot)
        self.enables: deque[Any] = deque(maxlen=16)
        self._asked: tuple[str, int] | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._work, name="stop", daemon=True)
        self._thread.start()

    def stopped_by(self, t_ns: int) -> str:
        """Who sent the stop that the core took at ``t_ns``, once; '' where it did not come over the wire."""
        asked, self._asked = self._asked, None
        return asked[0] if asked is not None and asked[1] <= t_ns else ""

    @property
    def refused(self) -> int:
        """Number of messages that could not be taken."""
        return self._boundary.refusals.count

    def _work(self) -> None:
        while not self._ending.is_set():
            try:
                # Only the exact key: looking around with a wildcard must not stop the arm.
                while (sample := self._puts.try_recv()) is not None:
                    if str(sample.key_expr) == self._key:
                        self._raise_stop(sample)
                while (query := self._stops.try_recv()) is not None:
                    if str(query.key_expr) == self._key:
                        self._boundary.take(
                            self._key, partial(self._stop, query), partial(self._reply, query)
                        )
                    else:
                        query.drop()
                while (query := self._enables.try_recv()) is not None:
                    self.enables.append(query)
            except zenoh.ZError:  # closed under our hands at the end
                return
            self._ending.wait(STOP_POLL_S)

    def _raise_stop(self, message: Any) -> int:
        """Raise the stop; ``message``: the sample or query that asks for it."""
        self._asked = sender(message), time.monotonic_ns()  # before its event can come
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
