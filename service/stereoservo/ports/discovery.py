"""Discovery of the hardware of a computer by drivers, for `stereoservo setup`: records, and protocols of the drivers
that support it. Discovery uses each driver class that has the methods; the others are set up by their options only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import msgspec

from stereoservo.ports.devices import ExaminationFinding, JointKindName


class FoundCamera(msgspec.Struct, frozen=True):
    """A camera of a computer: its display name, the driver's options that select it, its image sizes with rates
    ``(width [px], height [px], rate [Hz])``, best first; empty if the camera must be opened to know them.
    """

    name: str
    options: dict[str, Any]
    modes: tuple[tuple[int, int, float], ...] = ()


class FoundBus(msgspec.Struct, frozen=True):
    """An adapter or serial port that may lead to a bus of drives: its display name, and the driver's options."""

    name: str
    options: dict[str, Any]


class FoundDrive(msgspec.Struct, frozen=True):
    """A drive on a bus. ``address``: its number on the bus. ``options``: the data that it reports (identity, counts),
    by the names of the driver's joint options. ``limits``: its position limits [counts]; None: it has none.
    ``position`` [counts]; None: not reported.
    """

    address: int
    name: str
    options: dict[str, Any]
    limits: tuple[int, int] | None = None
    position: int | None = None


class BusScan(msgspec.Struct, frozen=True):
    """Result of a scan: the bus options for which drives answered, the drives by address, and the faults."""

    options: dict[str, Any]
    drives: tuple[FoundDrive, ...]
    findings: tuple[ExaminationFinding, ...] = ()


class JointChoice(msgspec.Struct, frozen=True):
    """The operator's description of the joint that a drive moves, base first [rad, s; m for prismatic joints].

    ``counts_per_rev``: of the motor; ``gear_ratio``: motor turns per joint turn, or per metre;
    ``velocity_units_per_rev_s``: the drive's velocity at one motor turn a second, None: counts/s. ``low``, ``high``,
    ``velocity``: limits.
    """

    name: str
    drive: FoundDrive
    kind: JointKindName
    counts_per_rev: float
    gear_ratio: float
    velocity_units_per_rev_s: float | None
    low: float
    high: float
    velocity: float


@runtime_checkable
class CameraFinder(Protocol):
    """A camera driver class that finds the cameras of a computer."""

    @classmethod
    def find_cameras(cls) -> tuple[FoundCamera, ...]:
        """Cameras of this computer; network cameras are not searched for. Cameras are opened only briefly."""
        ...

    @classmethod
    def probe_camera(cls, options: Mapping[str, Any]) -> tuple[int, int, float]:
        """Open a source by ``options`` and measure its images: returns width, height [px] and rate [Hz].

        Raises DriverError.
        """
        ...


@runtime_checkable
class DriveFinder(Protocol):
    """A joint driver class that finds buses and the drives on them."""

    @classmethod
    def find_buses(cls) -> tuple[FoundBus, ...]:
        """Adapters and serial ports of this computer; nothing is sent."""
        ...

    @classmethod
    def scan_bus(cls, options: Mapping[str, Any]) -> BusScan:
        """Find the drives on a bus, whose ``options`` need not name any joint; nothing is written to a drive.

        Raises DriverError if the bus cannot be opened, or is lost.
        """
        ...

    @classmethod
    def options_of(cls, scan: BusScan, joints: Sequence[JointChoice]) -> dict[str, Any]:
        """The driver's options, ``[joints.options]`` of a cell file, for drives that a scan found."""
        ...
