"""Hearing frames by their identifiers, and waiting: what is the same for every ``bringup.Link``."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from stereoservo_drivers.can.frames import CanFrame

if TYPE_CHECKING:
    from stereoservo_drivers.canopen.bringup import Link

STEP_S = 0.001


class Subscriptions:
    """Who hears which identifier. One thread may deliver while another subscribes."""

    def __init__(self) -> None:
        self._subscribers: defaultdict[int, list[list[CanFrame]]] = defaultdict(list)

    def subscribe(self, can_id: int, heard: list[CanFrame]) -> None:
        """Append frames of ``can_id`` to ``heard`` from now on."""
        self._subscribers[can_id] = [*self._subscribers[can_id], heard]

    def unsubscribe(self, can_id: int, heard: list[CanFrame]) -> None:
        """End it."""
        self._subscribers[can_id] = [other for other in self._subscribers[can_id] if other is not heard]

    def tell(self, frame: CanFrame) -> None:
        """A frame has arrived."""
        for heard in self._subscribers.get(frame.id, ()):
            heard.append(frame)


@contextmanager
def listening(link: Link, ids: list[int]) -> Iterator[dict[int, list[CanFrame]]]:
    """What arrives meanwhile, by identifier."""
    heard: dict[int, list[CanFrame]] = {can_id: [] for can_id in ids}
    for can_id, frames in heard.items():
        link.subscribe(can_id, frames)
    try:
        yield heard
    finally:
        for can_id, frames in heard.items():
            link.unsubscribe(can_id, frames)


def until(link: Link, done: Callable[[], bool], limit_s: float, step_s: float = STEP_S) -> bool:
    """Wait for ``done``; gives whether it came within ``limit_s``."""
    deadline_ns = link.now_ns() + round(limit_s * 1e9)
    while not done():
        if link.now_ns() >= deadline_ns:
            return False
        link.wait(step_s)
    return True
