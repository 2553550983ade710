"""Interface of an emulated axis: variables shared by drive firmware and plant, in joint units; protocol of a node."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

from stereoservo.ports.devices import JointSpec
from stereoservo_drivers.can.frames import CanFrame


@dataclass
class EmulatedAxis:
    """Shared state of an axis: the firmware writes the first group, the plant the second, injected faults the third.

    [rad, rad/s, rad/s² or m]. ``effort``: share of the rated torque, signed. ``set_position`` and ``set_velocity`` are
    the drive's own ramp, which the plant follows.
    """

    joint: JointSpec
    position: float

    powered: bool = False
    brake_closed: bool = True
    target: float = 0.0
    acceleration: float = math.inf

    velocity: float = 0.0
    effort: float = 0.0
    set_position: float = 0.0
    set_velocity: float = 0.0

    blocked: bool = False
    inverted_encoder: bool = False
    limit_switch: int = 0
    """-1, 0 or 1: the limit switch of that side is active; 0: none."""

    @property
    def following_error(self) -> float:
        """Set-point minus actual position."""
        return self.set_position - self.position


@dataclass(frozen=True)
class NodeSettings:
    """Times of a node. ``brake_ms``: to open and to close the brake. ``boot_ms``: from power on to the boot-up
    frame.

    ``tick_ns``: period of the drive's own control while its power stage is on. ``sync_timeout_factor``: periods of
    0x1006 without SYNC that cause error 0x8700. ``following_window``: limit of the following error [rad or m] if the
    EDS has no 0x6065. ``identity``: of 0x1018 by sub-index, overrides the joint's options.
    ``pdos_by_default``: whether the EDS's PDOs exist after power on (they do in EPOS4: RPDO 3 and 4 then receive
    control words on 0x400 and 0x500 + node id); False switches all off. ``reset_needs_communication_reset``: after
    0x8130 and 0x8120 the drive refuses a fault reset until NMT reset communication (EPOS4).
    ``preoperational_aborts``: NMT pre-operational counts as a lost connection (0x6007); NMT stop and reset always do.
    """

    brake_ms: float = 50.0
    boot_ms: float = 0.0
    tick_ns: int = 1_000_000
    sync_timeout_factor: float = 5.0
    following_window: float = 0.5
    identity: dict[int, int] = field(default_factory=dict)
    pdos_by_default: bool = True
    reset_needs_communication_reset: bool = False
    preoperational_aborts: bool = True


NEVER_NS = 2**63 - 1


class EmulatedNode(Protocol):
    """Protocol of one emulated drive. All times [ns] of the bus."""

    node_id: int
    axis: EmulatedAxis

    def power_up(self, t_ns: int) -> None:
        """Boot or reboot, with a boot-up frame; the axis loses its power."""
        ...

    def accepts(self, frame: CanFrame) -> bool:
        """Whether a frame is relevant to it; others need not be given to ``receive``."""
        ...

    def receive(self, frame: CanFrame, t_ns: int) -> None:
        """Process a frame of another sender that has ended on the bus at ``t_ns``."""
        ...

    def advance(self, t_ns: int) -> None:
        """Run timers up to ``t_ns``: heartbeats, time-outs, ends of ramps, the axis's new state."""
        ...

    def due_ns(self) -> int:
        """Time at which ``advance`` is next needed; NEVER_NS if nothing is pending."""
        ...

    def outgoing(self) -> list[CanFrame]:
        """Frames to send since the last call, in order."""
        ...

    def trip(self, code: int, t_ns: int) -> None:
        """Inject a fault of the drive, with its (CiA 402 or native) error code."""
        ...

    def state(self) -> str:
        """State as text, for the console."""
        ...
