"""What goes into the master and comes out of it: settings, modes, faults, statistics."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import msgspec

from stereoservo_drivers.canopen.odrive import RESOLUTION_TURNS
from stereoservo_drivers.canopen.options import CanJoint, CanOptions


class Mode(StrEnum):
    """What the master does with the axes."""

    OFF = "off"
    ENABLING = "enabling"
    RUNNING = "running"
    STOPPING = "stopping"
    LATCHED = "latched"


class MasterFault(msgspec.Struct, frozen=True):
    """What ended motion. ``axis``: the joint's name, empty for the bus. ``value``, ``limit``: where there are some."""

    code: str
    message: str
    axis: str = ""
    value: float | None = None
    limit: float | None = None
    hint: str = ""
    t_ns: int = 0

    def text(self) -> str:
        """All of it as one sentence for people."""
        return self.message + (f": {self.hint}" if self.hint else "")


class MasterSettings(msgspec.Struct, frozen=True):
    """What the master needs of the cell file's options. ``resolution_counts``: smallest step of a position."""

    joints: tuple[CanJoint, ...]
    rate_hz: float
    bitrate: int
    heartbeat_ms: int
    max_missed_cycles: int
    command_timeout_s: float
    loop_timeout_ms: int
    resolution_counts: float = 1.0

    @classmethod
    def of(cls, options: CanOptions) -> MasterSettings:
        """The settings in ``options``."""
        return cls(
            joints=options.joint,
            rate_hz=options.rate_hz,
            bitrate=options.bitrate,
            heartbeat_ms=options.heartbeat_ms,
            max_missed_cycles=options.max_missed_cycles,
            command_timeout_s=options.command_timeout_s,
            loop_timeout_ms=options.loop_timeout_ms,
            resolution_counts=RESOLUTION_TURNS if options.protocol == "odrive" else 1.0,
        )


@dataclass
class MasterStatistics:
    """Since the start. ``incomplete``: cycles that missed a frame. ``longest_cycle_ns``: between two ticks.

    ``answered_ns``: from the newest complete cycle's poll to its last frame; ``answered_max_ns``: the largest.
    """

    cycles: int = 0
    complete: int = 0
    incomplete: int = 0
    lost: int = 0
    doubled: int = 0
    foreign: int = 0
    heartbeats: int = 0
    longest_cycle_ns: int = 0
    answered_ns: int = 0
    answered_max_ns: int = 0
