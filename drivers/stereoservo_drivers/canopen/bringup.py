"""What a protocol does before and beside the cycle: find, check and configure the drives, clear their faults.

These calls block (tens of milliseconds). While they run, somebody pumps the bus: the driver's receive thread, or a
simulation in virtual time.
"""

from __future__ import annotations

from typing import Protocol

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import Codec


class Link(Protocol):
    """A pumped bus."""

    def send(self, frames: list[CanFrame]) -> None:
        """Send in order. Raises DriverError (``connection_lost``)."""
        ...

    def subscribe(self, can_id: int, heard: list[CanFrame]) -> None:
        """Append every frame of ``can_id`` that arrives from now on to ``heard``, until ``unsubscribe``."""
        ...

    def unsubscribe(self, can_id: int, heard: list[CanFrame]) -> None:
        """End it."""
        ...

    def wait(self, seconds: float) -> None:
        """Let the bus go on for so long."""
        ...

    def now_ns(self) -> int:
        """The link's time."""
        ...


class Bringup(Protocol):
    """Bring-up of one protocol."""

    @property
    def codec(self) -> Codec:
        """The codec of the same drives."""
        ...

    def connect(self, link: Link) -> None:
        """Find every drive, check it, configure it, start its cyclic frames. Raises DriverError. Nothing moves."""
        ...

    def reset(self, link: Link) -> None:
        """Clear latched faults of all drives; check that they are gone. Raises DriverError where one stays."""
        ...

    def release(self, link: Link) -> None:
        """Leave the drives quiet. Raises DriverError."""
        ...
