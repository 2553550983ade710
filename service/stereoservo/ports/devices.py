"""Interfaces to hardware: protocols of joint drivers, camera drivers and detectors, with their descriptions, samples
(joint states, frames, marker observations) and errors.

All stamps are ``CLOCK_MONOTONIC`` nanoseconds of this host (in lockstep: the virtual clock), taken from
``DriverContext.clock``. Every sample carries a stamp and a sequence number. Joint quantities are [rad], [rad/s] for
revolute and [m], [m/s] for prismatic joints. Pixels are raw image pixels; integer = pixel centre.

Calls are non-blocking within ``call_budget_us`` of the description. ``describe()`` works without a connection.
Lifecycle: ``configure`` -> ``activate`` -> ``deactivate`` -> ``close``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import msgspec

from stereoservo.messages.addresses import redacted
from stereoservo.messages.cell_file import Mount
from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray

JointKindName = Literal["revolute", "prismatic"]
Pacing = Literal["clock", "driver", "lockstep"]


class DriverError(Exception):
    """A driver cannot execute a request. The message states the cause, the value and the valid values; secrets of the
    cell file are not in it, also if the driver quotes them.

    Attributes:
        code: short machine-readable cause, e.g. ``"not_configured"``, ``"option"``, ``"connection_lost"``.
        data: the values in the message.
        retry: whether the same call may succeed later without a change of configuration.
    """

    def __init__(self, code: str, message: str, *, retry: bool = False, **data: Any) -> None:
        super().__init__(redacted(message))
        self.code = code
        self.data: dict[str, Any] = {
            key: redacted(value) if isinstance(value, str) else value for key, value in data.items()
        }
        self.retry = retry


class JointSpec(msgspec.Struct, frozen=True):
    """A joint's name, kind and the machine's limits; the limits of the cell can only be tighter.

    ``resolution``: step of its encoder at the joint [rad or m], 0 if it is negligible. Array scalars are converted to
    plain floats. Raises ValueError if the resolution is negative or not finite.
    """

    name: str
    kind: JointKindName
    position_min: float
    position_max: float
    velocity_max: float
    acceleration_max: float
    resolution: float = 0.0

    def __post_init__(self) -> None:
        for name in ("position_min", "position_max", "velocity_max", "acceleration_max", "resolution"):
            msgspec.structs.force_setattr(self, name, float(getattr(self, name)))
        if not 0.0 <= self.resolution < math.inf:
            raise ValueError(f"joint {self.name!r}: encoder resolution {self.resolution:g}; at least 0 is needed")


class JointDriverDescription(msgspec.Struct, frozen=True):
    """The joints, rate and pacing of a joint driver, readable before it is connected.

    ``home``: a plausible configuration of the arm (in joint order; empty: unknown). ``effort_units``: of
    ``JointState.efforts``, in joint order; empty: N m of revolute joints, N of prismatic ones. ``simulated``: no real
    machine moves; a cell file may then omit limits and base, and uses these and ``home``. ``lacks``: which of
    ``efforts`` and ``following_errors`` are missing in its samples, as far as known in advance. ``auxiliary``:
    additional joints and outputs, of an :class:`AuxiliaryDriver`. ``notes``: interpretations of the driver that may be
    unexpected, such as omitted joints of a file; reported when a cell is checked or run.
    """

    driver: str
    joints: tuple[JointSpec, ...]
    rate_hz: float
    pacing: Pacing
    command_timeout_s: float
    call_budget_us: float
    home: tuple[float, ...] = ()
    effort_units: tuple[str, ...] = ()
    lacks: tuple[Literal["efforts", "following_errors"], ...] = ()
    auxiliary: tuple[AuxiliarySpec, ...] = ()
    simulated: bool = False
    notes: tuple[str, ...] = ()


class CameraDescription(msgspec.Struct, frozen=True):
    """Image size and rate of a camera; ``delivers``: ``frames`` (a detector follows) or ``observations`` (markers)."""

    driver: str
    name: str
    width: int
    height: int
    rate_hz: float
    delivers: Literal["frames", "observations"]
    call_budget_us: float
    marker_ids: tuple[int, ...] = ()
    systematic_px: float = 0.0


class DetectorDescription(msgspec.Struct, frozen=True):
    """The marker ids that a detector can report.

    ``systematic_px``: standard deviation [px] of its errors that do not average out over frames of a static scene
    (sampling, rounding to grey levels); included in the covariances that it reports.
    """

    detector: str
    marker_ids: tuple[int, ...]
    systematic_px: float = 0.0


class JointState(msgspec.Struct, frozen=True, eq=False):
    """One joint sample: ``positions`` (n,), ``velocities`` (n,), and, if the drives report them, (n,) each: ``efforts``
    [N m or N; fractions of the rated torque if the driver does not know that] and ``following_errors``, set minus
    actual position [rad or m].
    """

    seq: int
    t_ns: int
    positions: FloatArray
    velocities: FloatArray
    efforts: FloatArray | None = None
    following_errors: FloatArray | None = None


class CommandReport(msgspec.Struct, frozen=True, eq=False):
    """Joint velocities (n,) that were commanded (``asked``) and sent, with reasons for the difference."""

    seq: int
    t_ns: int
    asked: FloatArray
    sent: FloatArray
    reasons: tuple[str, ...] = ()


class Frame(msgspec.Struct, frozen=True, eq=False):
    """One image ``(height, width)`` uint8 with its stamps."""

    camera: str
    seq: int
    t_shutter_ns: int
    t_received_ns: int
    image: ImageArray


class CameraObservation(msgspec.Struct, frozen=True, eq=False):
    """Markers seen in one frame: ``ids`` (k,), ``pixels`` (k, 2) [px], ``covariances`` (k, 2, 2) [px²]."""

    camera: str
    seq: int
    t_shutter_ns: int
    t_received_ns: int
    ids: IntArray
    pixels: FloatArray
    covariances: FloatArray


class Prior(msgspec.Struct, frozen=True, eq=False):
    """Predicted markers of one camera at ``t_ns``; a detector extrapolates them to its frame's stamp.

    ``ids`` (k,), ``pixels`` (k, 2) [px], ``velocities`` (k, 2) [px/s], ``covariances`` (k, 2, 2) [px²].
    Never fed back as a measurement.
    """

    camera: str
    t_ns: int
    ids: IntArray
    pixels: FloatArray
    velocities: FloatArray
    covariances: FloatArray


@runtime_checkable
class Clock(Protocol):
    """Source of time of the drivers and the loop."""

    def now_ns(self) -> int:
        """Monotonic time [ns]."""
        ...


@dataclass(frozen=True)
class DriverContext:
    """Context of a driver, passed to its constructor with the driver's options.

    ``camera``: name of the camera of a camera driver or detector, as in the cell file. ``mount``: of the cell's
    cameras. ``arm``: description of a simulated arm in the cell file (`messages.cell_file.CellFile.arm_options`), for
    the cameras that see it.
    """

    clock: Clock
    cell: str
    runtime_dir: Path
    cell_dir: Path
    camera: str = ""
    seed: int = 0
    services: dict[str, Any] = field(default_factory=dict)
    """In-process objects shared between drivers of one process (lockstep: the simulated world)."""
    mount: Mount = "eye_to_hand"
    arm: Mapping[str, Any] = field(default_factory=dict)


@runtime_checkable
class JointDriver(Protocol):
    """Protocol of an arm. Constructed as ``Driver(options, context)``; the constructor does not connect."""

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None: ...

    def describe(self) -> JointDriverDescription:
        """Joints, limits, rate, pacing; works unconnected."""
        ...

    def configure(self) -> None:
        """Connect and check the machine; if already connected (after deactivate), check it again and reset the faults
        that can be reset. Raises DriverError. Nothing moves.
        """
        ...

    def activate(self) -> None:
        """Power circuits on, brakes released, velocity zero. Raises DriverError."""
        ...

    def read_state(self) -> JointState:
        """Newest joint sample; valid once configured. Raises DriverError."""
        ...

    def write_velocity(self, qd: FloatArray) -> CommandReport:
        """Command joint velocities (n,). Raises DriverError unless active. Feeds the drive's watchdog."""
        ...

    def stop(self) -> None:
        """Bring the arm to rest. Any state, idempotent, never raises."""
        ...

    def deactivate(self) -> None:
        """Stop, then power off, except for an arm without brakes that would fall: its motors continue to hold it. Later
        commands are refused. Idempotent.
        """
        ...

    def close(self) -> None:
        """Release everything. Idempotent; never raises."""
        ...


@runtime_checkable
class AuxiliaryDriver(Protocol):
    """A joint driver with auxiliary joints (a gripper) or digital outputs; ``stop`` stops these joints, too."""

    def write_auxiliary(self, values: Mapping[str, float]) -> None:
        """Command positions of auxiliary joints [rad or m] and digital outputs (0 or 1) by name. Does not block; the
        driver moves each joint at its own velocity. Raises DriverError unless active.
        """
        ...

    def read_auxiliary(self) -> dict[str, float]:
        """The newest known values by name; any state, never raises."""
        ...

    def stop_auxiliary(self) -> None:
        """Hold auxiliary joints at their current positions; outputs keep their state. Any state, never raises."""
        ...


class ExaminationFinding(msgspec.Struct, frozen=True):
    """One result of an examination of a cell. ``ok``: passed, failed, or None for a remark without a result.

    ``remedy``: the setting or action that removes the cause; ``cure`` in JSON. ``jogged``: the joint that was moved,
    and its travel by its encoder [rad or m].
    """

    name: str
    ok: bool | None
    message: str
    remedy: str = msgspec.field(default="", name="cure")
    jogged: tuple[str, float] | None = None


MayMove = Callable[[str], float]
"""Function called with a question for the operator before a joint is moved; returns the allowed fraction of the usual
jog (one degree, 2 mm), up to 1; 0 or False: no motion.
"""


@runtime_checkable
class ExaminableJointDriver(Protocol):
    """A joint driver that can examine its machine for `stereoservo doctor`; the driver is not configured then."""

    def examine(self, may_move: MayMove) -> Iterator[ExaminationFinding]:
        """Findings on the machine: connect, examine, release. ``may_move`` is called before any joint is moved.

        Never raises for faults of the machine: a failure is a finding.
        """
        ...


@runtime_checkable
class CameraDriver(Protocol):
    """Protocol of a camera. Constructed as ``Driver(options, context)`` with ``context.camera`` its name in the
    cell.
    """

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None: ...

    def describe(self) -> CameraDescription:
        """Size, rate, kind of data; works unconnected."""
        ...

    def configure(self) -> None:
        """Open the source. Raises DriverError."""
        ...

    def activate(self) -> None:
        """Start delivery. Raises DriverError."""
        ...

    def poll(self) -> list[Frame] | list[CameraObservation]:
        """Frames or observations since the last poll, newest last; may skip old ones. Raises DriverError."""
        ...

    def deactivate(self) -> None:
        """Stop delivery. Idempotent."""
        ...

    def close(self) -> None:
        """Release everything. Idempotent; never raises."""
        ...


class CameraStatistics(msgspec.Struct, frozen=True):
    """Counts of a camera driver since ``activate``: ``frames`` received, ``dropped`` ones that never arrived (gaps of
    its sequence numbers or its time grid), ``frozen`` ones discarded because they repeat the previous one,
    ``reconnects``.

    ``settings``: requested and reported settings of the source by name, e.g. ``{"exposure": (10.0, 12.0)}``.
    ``server_clock``: whether the clock of a server on another host is known, with details or the reason; None if its
    stamps are not used.
    """

    frames: int = 0
    dropped: int = 0
    frozen: int = 0
    reconnects: int = 0
    settings: dict[str, tuple[float | None, float | None]] = {}
    server_clock: tuple[bool, str] | None = None


@runtime_checkable
class CountingCameraDriver(Protocol):
    """A camera driver that counts its frames."""

    def statistics(self) -> CameraStatistics:
        """Counts since ``activate``; any state."""
        ...


@runtime_checkable
class Detector(Protocol):
    """Protocol of a detector of markers in one camera's images. Constructed as ``Detector(options, context)``."""

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None: ...

    def describe(self) -> DetectorDescription:
        """The marker ids that it can report."""
        ...

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """Markers in ``frame``; without a (fresh) prior, acquisition in the whole image. Never raises on content."""
        ...


@runtime_checkable
class ExplainingDetector(Protocol):
    """A detector that reports, for the newest frame, why markers are not detected, by id; -1: why none is."""

    refused: dict[int, str]
