"""What a protocol of drives must offer the cyclic master. Pure: frames in, frames out, no clock, no I/O.

Fixed in the master and not in a codec: the rate, freshness of frames, which fault latches, the explicit reset, that a
stop is repeated every cycle.
"""

from __future__ import annotations

from typing import Protocol

import msgspec

from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.can.frames import CanFrame

NOT_CYCLIC = -1
"""What ``Codec.receive`` gives for a frame that is not part of the cycle."""


class AxisFault(msgspec.Struct, frozen=True):
    """Something an axis said or showed that must end motion.

    ``axis``: index of the joint, -1 for the bus. ``code``: stable, e.g. ``drive_fault``, ``emergency``, ``rebooted``,
    ``mapping``, ``limit_switch``. ``value``: the number on the wire, where there is one. ``hint``: what to do.
    """

    axis: int
    code: str
    message: str
    value: int | None = None
    hint: str = ""


class Feedback(msgspec.Struct, eq=False):
    """Newest of every joint, in joint units, written in place by the codec. NaN before the first frame.

    ``positions`` [rad or m] are unwrapped; ``efforts`` [N m or N where the rated torque is configured, else shares
    of it]; ``following_errors`` [rad or m]; the last two None where the drives do not send them.
    """

    positions: FloatArray
    velocities: FloatArray
    efforts: FloatArray | None = None
    following_errors: FloatArray | None = None


class Codec(Protocol):
    """One bus of drives, one axis a joint, in joint order.

    ``expected``: bit mask of the cyclic frames that every poll must bring; bit ``b`` belongs to axis ``bit_axis[b]``
    and is called ``bit_name[b]`` ("TPDO1 of node 3").
    """

    feedback: Feedback
    expected: int
    bit_axis: tuple[int, ...]
    bit_name: tuple[str, ...]

    def poll(self) -> list[CanFrame]:
        """What asks all drives for their state: SYNC, or remote frames."""
        ...

    def heartbeat(self) -> list[CanFrame]:
        """What tells the drives that the master lives; empty where the protocol has none."""
        ...

    def receive(self, frame: CanFrame) -> int:
        """Take a frame: decoded into ``feedback``; the bit it sets, or NOT_CYCLIC. Faults are kept for ``faults``."""
        ...

    def faults(self) -> tuple[AxisFault, ...]:
        """What is wrong by the frames received since the last call (events) and by the newest states (levels)."""
        ...

    def enabled(self) -> bool:
        """Whether every axis says that it follows velocity commands."""
        ...

    def at_rest_unpowered(self) -> bool:
        """Whether every axis says that its power stage is off."""
        ...

    def idle(self) -> list[CanFrame]:
        """What a cycle sends while the arm is off: power off, target zero. Does not clear any fault."""
        ...

    def enable(self) -> list[CanFrame]:
        """One step towards enabled for every axis from the state that it is in, target zero. Never clears a fault."""
        ...

    def command(self, velocities: FloatArray) -> list[CanFrame]:
        """Velocities (n,) [rad/s or m/s] to enabled drives."""
        ...

    def quick_stop(self) -> list[CanFrame]:
        """Target zero and quick stop, to every axis."""
        ...

    def sendable(self, velocities: FloatArray) -> FloatArray:
        """``velocities`` (n,) as the wire's resolution and range let them arrive."""
        ...

    def status_words(self) -> tuple[str, ...]:
        """The state of every axis in words, for people."""
        ...
