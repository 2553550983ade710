"""Interfaces of a drive protocol: a codec for the cyclic master (frames in, frames out, without clock or I/O) and a
bring-up.

The master, and not a codec, determines the rate, freshness of frames, which fault latches, the explicit reset, and that
a stop is repeated every cycle.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import msgspec

from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.can.frames import CanFrame

NOT_CYCLIC = -1
"""Result of ``Codec.receive`` for a frame that is not part of the cycle."""


class AxisFault(msgspec.Struct, frozen=True):
    """A fault reported by an axis, or evident from it, which must end motion.

    ``axis``: index of the joint, -1 for the bus. ``code``: stable, e.g. ``drive_fault``, ``emergency``, ``rebooted``,
    ``mapping``, ``limit_switch``. ``value``: the number on the wire, if there is one. ``hint``: remedy.
    """

    axis: int
    code: str
    message: str
    value: int | None = None
    hint: str = ""


class Feedback(msgspec.Struct, eq=False):
    """Newest feedback of every joint, in joint units, written in place by the codec. NaN before the first frame.

    ``positions`` [rad or m] are unwrapped; ``efforts`` [N m or N if the rated torque is configured, else shares of it];
    ``following_errors`` [rad or m]; the last two are None if the drives do not send them.
    """

    positions: FloatArray
    velocities: FloatArray
    efforts: FloatArray | None = None
    following_errors: FloatArray | None = None


class Codec(Protocol):
    """Protocol: codec of one bus of drives, one axis per joint, in joint order.

    ``expected``: bit mask of the cyclic frames that every poll must bring; bit ``b`` belongs to axis ``bit_axis[b]``
    and is called ``bit_name[b]`` ("TPDO1 of node 3").
    """

    feedback: Feedback
    expected: int
    bit_axis: tuple[int, ...]
    bit_name: tuple[str, ...]

    def poll(self) -> list[CanFrame]:
        """Frames that request the drives' state: SYNC, or remote frames."""
        ...

    def heartbeat(self) -> list[CanFrame]:
        """Heartbeat frame of the master; empty if the protocol has none."""
        ...

    def receive(self, frame: CanFrame) -> int:
        """Decode a frame into ``feedback``; returns the bit it sets, or NOT_CYCLIC. Stores faults for ``faults``."""
        ...

    def faults(self) -> tuple[AxisFault, ...]:
        """Faults by the frames received since the last call (events) and by the newest states (levels)."""
        ...

    def enabled(self) -> bool:
        """Whether every axis reports that it follows velocity commands."""
        ...

    def at_rest_unpowered(self) -> bool:
        """Whether every axis reports that its power stage is off."""
        ...

    def idle(self) -> list[CanFrame]:
        """Frames of a cycle while the arm is off: power off, target zero. Does not clear any fault."""
        ...

    def enable(self) -> list[CanFrame]:
        """Frames: the next transition of every axis towards enabled, target zero. Never clears a fault."""
        ...

    def command(self, velocities: FloatArray) -> list[CanFrame]:
        """Frames: velocities (n,) [rad/s or m/s] to enabled drives."""
        ...

    def quick_stop(self) -> list[CanFrame]:
        """Frames: target zero and quick stop, to every axis."""
        ...

    def sendable(self, velocities: FloatArray) -> FloatArray:
        """``velocities`` (n,) after rounding and clipping by the wire format."""
        ...

    def status_words(self) -> tuple[str, ...]:
        """State of every axis as text."""
        ...


# -- bring-up ------------------------------------------------------------------------------------------------
# Bring-up protocol of drives: find, check and configure them, clear their faults; routing of received frames.
#
# These calls block (tens of milliseconds). While they run, the bus must be served: by the driver's receive thread, or
# by a simulation in virtual time.


class Link(Protocol):
    """Interface of a bus that is being served, for use outside of the cycle."""

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
        """Current time of the link."""
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
        """Clear latched faults of all drives; check that they are cleared. Raises DriverError if one remains."""
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
    """Context manager that collects the frames arriving meanwhile, by identifier."""
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
