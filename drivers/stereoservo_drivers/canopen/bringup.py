"""Bring-up protocol of drives: find, check and configure them, clear their faults; routing of received frames.

These calls block (tens of milliseconds). While they run, the bus must be served: the driver's receive thread, or a
simulation in virtual time.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import Codec


class Link(Protocol):
    """Protocol of a bus that is being served, for use outside of the cycle."""

    def send(self, frames: list[CanFrame]) -> None:
        """Send frames in order. Raises DriverError (``connection_lost``)."""
        ...

    def subscribe(self, can_id: int, received: list[CanFrame]) -> None:
        """Append every frame of ``can_id`` that arrives from now on to ``heard``, until ``unsubscribe``."""
        ...

    def unsubscribe(self, can_id: int, received: list[CanFrame]) -> None:
        """End a subscription."""
        ...

    def wait(self, seconds: float) -> None:
        """Let the bus run for some time."""
        ...

    def now_ns(self) -> int:
        """Time of the link."""
        ...


class Bringup(Protocol):
    """Protocol: bring-up of one type of drives."""

    @property
    def codec(self) -> Codec:
        """Codec of the same drives."""
        ...

    def connect(self, link: Link) -> None:
        """Find every drive, check it, configure it, start its cyclic frames. Raises DriverError. Nothing moves."""
        ...

    def reset(self, link: Link) -> None:
        """Clear latched faults of all drives; check that they are gone. Raises DriverError where one stays."""
        ...

    def release(self, link: Link) -> None:
        """Leave the drives passive. Raises DriverError."""
        ...


STEP_S = 0.001


class Subscriptions:
    """Subscriptions by CAN identifier. One thread may deliver while another subscribes."""

    def __init__(self) -> None:
        self._subscribers: defaultdict[int, list[list[CanFrame]]] = defaultdict(list)

    def subscribe(self, can_id: int, received: list[CanFrame]) -> None:
        """Append frames of ``can_id`` to ``heard`` from now on."""
        self._subscribers[can_id] = [*self._subscribers[can_id], received]

    def unsubscribe(self, can_id: int, received: list[CanFrame]) -> None:
        """End a subscription."""
        self._subscribers[can_id] = [other for other in self._subscribers[can_id] if other is not received]

    def tell(self, frame: CanFrame) -> None:
        """Deliver a frame that has arrived."""
        for received in self._subscribers.get(frame.id, ()):
            received.append(frame)


@contextmanager
def listening(link: Link, ids: list[int]) -> Iterator[dict[int, list[CanFrame]]]:
    """Context manager: frames that arrive meanwhile, by identifier."""
    received: dict[int, list[CanFrame]] = {can_id: [] for can_id in ids}
    for can_id, frames in received.items():
        link.subscribe(can_id, frames)
    try:
        yield received
    finally:
        for can_id, frames in received.items():
            link.unsubscribe(can_id, frames)


def until(link: Link, done: Callable[[], bool], limit_s: float, step_s: float = STEP_S) -> bool:
    """Wait for ``done``; returns whether it became true within ``limit_s``."""
    deadline_ns = link.now_ns() + round(limit_s * 1e9)
    while not done():
        if link.now_ns() >= deadline_ns:
            return False
        link.wait(step_s)
    return True
