"""What an emulated node on the bus must offer the rack. No I/O and no clock of its own: time is given."""

from __future__ import annotations

from typing import Protocol

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.drives.axis import Axis

NEVER_NS = 2**63 - 1


class EmulatedNode(Protocol):
    """One drive. All times [ns] of the bus."""

    node_id: int
    axis: Axis

    def power_up(self, t_ns: int) -> None:
        """Boot: says so on the bus. A reboot likewise; the axis loses its power."""
        ...

    def hears(self, frame: CanFrame) -> bool:
        """Whether a frame can mean anything to it; others need not be given to ``receive``."""
        ...

    def receive(self, frame: CanFrame, t_ns: int) -> None:
        """A frame of somebody else has ended on the bus at ``t_ns``."""
        ...

    def advance(self, t_ns: int) -> None:
        """Do what timers ask for up to ``t_ns``: heartbeats, time-outs, ramps' ends, the axis's new state."""
        ...

    def due_ns(self) -> int:
        """When ``advance`` is next needed; NEVER_NS where nothing is pending."""
        ...

    def outgoing(self) -> list[CanFrame]:
        """Frames that the node wants to send since the last call, in its order."""
        ...

    def trip(self, code: int, t_ns: int) -> None:
        """An ordered fault of the drive, with its (CiA 402 or native) error code."""
        ...

    def state(self) -> str:
        """In words, for the console."""
        ...
