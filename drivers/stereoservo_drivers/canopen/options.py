"""Options of the CAN joint driver: ``[joints.options]`` of a cell file, checked before anything is connected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from stereoservo.messages.goals import AuxiliarySpec
from stereoservo.messages.text_files import complete, toml_of
from stereoservo.ports.devices import DriverError, JointSpec
from stereoservo_drivers.options import decode_options
from stereoservo_drivers.position_output import LEAD_S, LOAD_OFFSET

Positive = Annotated[float, Meta(gt=0)]
NodeId = Annotated[int, Meta(ge=1, le=126)]
Feedback = Literal["velocity", "effort", "following_error", "switches"]
CommandMode = Literal["csv", "pv", "csp", "ip"]
Missing = Literal["watch"]
POSITION_MODES = ("csp", "ip")


class CanDrive(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of a joint's or gripper's drive [rad, s; m for prismatic joints].

    ``counts_per_rev``, ``velocity_units_per_rev_s``: of the motor (60: the drive uses rpm; default: counts/s).
    ``gear_ratio``: motor turns per joint turn; of a prismatic joint, motor turns per metre.
    ``offset_rad``: ``q = counts / k - offset``.
    ``position_min``, ``position_max``: the machine's limits.
    ``vendor_id``, ``product_code``, ``revision``, ``serial_number``: compared with the drive's identity if given.
    ``sdo``: further writes ``"index:subindex" = value``, verified by reading back.
    """

    name: str
    node_id: NodeId
    kind: Literal["revolute", "prismatic"] = "revolute"
    counts_per_rev: Positive
    gear_ratio: Positive = 1.0
    direction: Literal[1, -1] = 1
    offset_rad: float = 0.0
    velocity_units_per_rev_s: Positive | None = None
    quick_stop_deceleration: Positive
    position_min: float
    position_max: float
    vendor_id: int | None = None
    product_code: int | None = None
    revision: int | None = None
    serial_number: int | None = None
    sdo: dict[str, int] = {}


class CanJoint(CanDrive, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One ``[[joints.options.joint]]``: a joint and its drive, as of `CanDrive`.

    ``max_*``: sent to the drive, and limits of commands.
    ``rated_torque``: [N m or N at the joint] of 1000 permille; without it, efforts are shares of it.
    ``current_limit`` [A]: protocol ``odrive`` only; if given, it and ``max_velocity`` become the drive's limits.
    ``accept_missing``: names of objects that the drive may lack although the arm is less safe without them.
    ``position_lead`` [rad or m]: of position modes, largest distance of a position set-point ahead of the joint.
    ``load_offset_max``: of position modes, largest offset of the drive from its set-point under load.
    """

    max_velocity: Positive
    max_acceleration: Positive
    multi_turn: bool = False
    rated_torque: Positive | None = None
    current_limit: Positive | None = None
    accept_missing: tuple[Missing, ...] = ()
    position_lead: Positive | None = None
    load_offset_max: Annotated[float, Meta(ge=0)] | None = None

    @property
    def lead(self) -> float:
        """Largest distance of a position set-point ahead of the joint [rad or m]."""
        return self.position_lead or LEAD_S * self.max_velocity

    @property
    def largest_load_offset(self) -> float:
        """Largest offset of the drive from its position set-point under load [rad or m]."""
        return LOAD_OFFSET[self.kind] if self.load_offset_max is None else self.load_offset_max

    def spec(self) -> JointSpec:
        """The joint in the form of the joint driver port."""
        turn = 2.0 * math.pi if self.kind == "revolute" else 1.0
        return JointSpec(
            name=self.name,
            kind=self.kind,
            position_min=self.position_min,
            position_max=self.position_max,
            velocity_max=self.max_velocity,
            acceleration_max=self.max_acceleration,
            resolution=turn / (self.counts_per_rev * self.gear_ratio),
        )


class CanOutput(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One ``[[joints.options.output]]``: a digital output of a joint's drive.

    ``bit``: of 0x60FE:1; in CiA 402-2 bit 0 is the brake, and bits 16 to 31 are the manufacturer's.
    """

    name: str
    node_id: NodeId
    bit: Annotated[int, Meta(ge=1, le=31)]

    def spec(self) -> AuxiliarySpec:
        """The output in the form of the joint driver port."""
        return AuxiliarySpec(self.name, "digital")


class CanGripper(CanDrive, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One ``[[joints.options.gripper]]``: an auxiliary joint on its own CiA 402 drive, as of `CanDrive`.

    The drive moves to commanded positions by itself (profile position, mode 1) at ``velocity`` with ``acceleration``.
    ``torque_limit``: permille of the motor's rated torque (0x6072), with which it grips.
    ``quick_stop_option``, ``abort_option``: reaction to a stop by this computer and to its loss; by default the drive
    brakes and keeps its torque, so that it holds its part.
    ``eds``: of its drive, beside the cell file.
    ``profile``: a TOML file there with any of these keys, which are overridden by those in the cell file.
    """

    kind: Literal["revolute", "prismatic"] = "prismatic"
    velocity: Positive
    acceleration: Positive
    torque_limit: Annotated[int, Meta(ge=1, le=5000)] | None = None
    quick_stop_option: Literal[1, 2, 3, 4, 5, 6, 7, 8] = 6
    abort_option: Literal[1, 2, 3] = 3
    eds: str = ""
    profile: str = ""

    def spec(self) -> AuxiliarySpec:
        """The gripper in the form of the joint driver port."""
        return AuxiliarySpec(self.name, self.kind, self.position_min, self.position_max, self.velocity)

    def joint(self) -> CanJoint:
        """Its drive, scales and limits in the form of a joint's."""
        shared = {key: getattr(self, key) for key in CanDrive.__struct_fields__}
        return CanJoint(**shared, max_velocity=self.velocity, max_acceleration=self.acceleration)


class CanOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``[joints.options]`` of driver ``canopen``.

    ``interface``, ``channel``, ``bitrate``, ``interface_options``: as in python-can; ``stereoservo_slcan`` is the fast
    serial-line CAN of this package.
    ``feedback``: values that the drives send in addition to status word and position.
    ``mode``: cyclic or profile velocity, cyclic or interpolated position; ``auto``: for each drive the first one it
    has.
    ``rpdo_deadline_ms``: for drives with such a timer; 0 leaves it off.
    ``emcy_ignore``: emergency codes that do not trip.
    ``endpoints``: of protocol ``odrive``, ``flat_endpoints.json`` of the drives' releases, beside the cell file.
    ``output``: digital outputs of the drives.
    ``gripper``: auxiliary joints on their own drives.
    ``command_timeout_s``: without a command for this time the joints are brought to rest (they remain enabled).
    ``loop_timeout_ms``: without any call for this time, while enabled, the driver latches a fault.
    """

    protocol: Literal["cia402", "odrive"] = "cia402"
    interface: str
    channel: str | int
    bitrate: Annotated[int, Meta(ge=10_000, le=1_000_000)] = 1_000_000
    interface_options: dict[str, str | int | float | bool] = {}
    rate_hz: Annotated[float, Meta(ge=10, le=1000)] = 250.0
    max_bus_load: Annotated[float, Meta(gt=0, le=0.95)] = 0.70
    master_id: Annotated[int, Meta(ge=1, le=127)] = 127
    heartbeat_ms: Annotated[int, Meta(ge=2, le=1000)] = 20
    heartbeat_timeout_ms: Annotated[int, Meta(ge=10, le=5000)] = 100
    rpdo_deadline_ms: Annotated[int, Meta(ge=0, le=5000)] = 20
    max_missed_cycles: Annotated[int, Meta(ge=1, le=50)] = 3
    mode: Literal["auto", "csv", "pv", "csp", "ip"] = "auto"
    quick_stop_option: Literal[1, 2, 3, 4, 5, 6, 7, 8] = 2
    abort_option: Literal[1, 2, 3] = 3
    emcy_ignore: tuple[int, ...] = ()
    eds: str = ""
    endpoints: tuple[str, ...] = ()
    feedback: tuple[Feedback, ...] = ("velocity", "effort")
    command_timeout_s: Positive = 0.1
    loop_timeout_ms: Annotated[int, Meta(ge=20, le=5000)] = 100
    joint: tuple[CanJoint, ...]
    output: tuple[CanOutput, ...] = ()
    gripper: tuple[CanGripper, ...] = ()


def can_options(options: Mapping[str, Any], cell_dir: Path) -> CanOptions:
    """``[joints.options]`` with the grippers' profile files, which are in ``cell_dir``. Raises DriverError."""
    grippers = options.get("gripper")
    if isinstance(grippers, list | tuple):
        options = {**options, "gripper": [_with_profile(gripper, cell_dir) for gripper in grippers]}
    return decode_options(CanOptions, options, "canopen")


def _with_profile(gripper: Any, cell_dir: Path) -> Any:
    name = gripper.get("profile") if isinstance(gripper, Mapping) else None
    if not name or not isinstance(name, str):
        return gripper
    path = cell_dir / name
    try:
        profile = complete(toml_of(path.read_bytes()))
    except (OSError, ValueError) as error:
        raise DriverError(
            "option",
            f"driver 'canopen': gripper {gripper.get('name', '')!r}: profile = {name!r}: {error}; a TOML file beside "
            "the cell file with keys of [[joints.options.gripper]] is valid",
            option="profile",
            path=str(path),
        ) from error
    return {**profile, **gripper}
