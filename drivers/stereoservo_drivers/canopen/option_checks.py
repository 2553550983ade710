"""Checks of the CAN options beyond their types: consistency with each other, the wire format and the bus."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

from stereoservo.messages.addresses import without_secrets
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.load import BusLoad, cycle_load, refusal
from stereoservo_drivers.canopen.odrive import SHARE
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.canopen.pdo_plan import TARGETS, planned
from stereoservo_drivers.canopen.units import INT32_MAX, UINT32_MAX, JointScale

LONGEST_TURN = 2.0 * math.pi
"""[rad] A joint that moves further from zero turns more than once, which needs ``multi_turn``."""
FASTEST_TURN = 4.0 * math.pi
"""[rad/s] No joint of an arm is faster; a larger number is in degrees."""
SDO_KEY = re.compile(r"0[xX][0-9A-Fa-f]{1,4}:([0-9]{1,3}|0[xX][0-9A-Fa-f]{1,2})")
ODRIVE_HEARTBEATS_S = 10.0
GRIPPER_HZ = 50.0
"""Rate at which a gripper's drive sends its state."""
LAST_SYNCHRONOUS = 240
"""Largest transmission type that counts SYNCs (CiA 301)."""


def parse_sdo_key(key: str) -> tuple[int, int]:
    """Parse ``"0x60C2:1"`` as (index, sub-index). Raises ValueError, which states what is valid."""
    if SDO_KEY.fullmatch(key):
        index, subindex = (int(part, 0) for part in key.split(":"))
        if index and subindex <= 0xFF:
            return index, subindex
    raise ValueError('index and sub-index such as "0x60C2:1"')


def check_options(options: CanOptions) -> None:
    """Check the options. Raises DriverError (``option``): names the joint, the value, and what would be valid."""
    if not options.joint:
        raise _refusal("joint", "[]", "at least one [[joints.options.joint]] with its name and node_id")
    _check_bus(options)
    _check_protocol(options)
    drives = (*options.joint, *(gripper.joint() for gripper in options.gripper))
    _check_unique(drives, "node_id", lambda joint: joint.node_id)
    _check_unique(drives, "name", lambda joint: joint.name)
    for joint in drives:
        if joint.node_id == options.master_id:
            valid = f"an id that is not master_id ({options.master_id}), which is this computer's"
            raise _refusal("node_id", joint.node_id, valid, joint)
        _check_identity(options, joint)
        _check_geometry(joint)
        _check_limits(joint)
        if options.protocol == "cia402":
            _check_range(joint)
        for key, value in joint.sdo.items():
            _check_sdo(joint, key, value)
    if options.heartbeat_timeout_ms < 2 * options.heartbeat_ms:
        valid = f"at least {2 * options.heartbeat_ms}, twice heartbeat_ms: one that is late must not stop the arm"
        raise _refusal("heartbeat_timeout_ms", options.heartbeat_timeout_ms, valid)
    if 0 < options.rpdo_deadline_ms < 2000.0 / options.rate_hz:
        valid = f"0 (no such timer) or at least {math.ceil(2000.0 / options.rate_hz)}, two cycles at rate_hz"
        raise _refusal("rpdo_deadline_ms", options.rpdo_deadline_ms, valid)
    check_load(options)


def check_load(options: CanOptions, guarded: int = 0, frames: list[int] | None = None) -> None:
    """Check the bus's load; arguments as of `bus_load`. Raises DriverError (``option``)."""
    load = bus_load(options, guarded, frames)
    why = refusal(load, options.max_bus_load)
    if why is not None:
        raise DriverError(
            "option", f"driver 'canopen': {why}", option="rate_hz", value=options.rate_hz, load=load.share
        )


def _check_bus(options: CanOptions) -> None:
    for k, joint in enumerate(options.joint):
        if not joint.name.strip():
            raise _refusal(f"joint[{k}] (node_id {joint.node_id}): name", repr(joint.name), "a name")
    for what in options.feedback:
        if options.feedback.count(what) > 1:
            raise _refusal("feedback", list(options.feedback), f"each once; {what!r} is there twice")
    for code in options.emcy_ignore:
        if not 1 <= code <= 0xFFFF:
            raise _refusal("emcy_ignore", f"{code:#x}", "codes of 16 bits, 0x1 to 0xffff, e.g. 0x4210")


def _check_protocol(options: CanOptions) -> None:
    if options.endpoints and options.protocol != "odrive":
        raise _refusal("endpoints", list(options.endpoints), "left out: they are an ODrive's")
    if options.output and options.protocol != "cia402":
        raise _refusal("output", [output.name for output in options.output], "left out: they are a CiA 402 drive's")
    if options.gripper and options.protocol != "cia402":
        raise _refusal("gripper", [gripper.name for gripper in options.gripper], "left out: only CiA 402 drives are")
    nodes = [joint.node_id for joint in options.joint]
    for k, output in enumerate(options.output):
        who, before = f"output {output.name!r}", options.output[:k]
        if output.node_id not in nodes:
            raise _refusal(f"{who}: node_id", output.node_id, f"that of a joint: {', '.join(map(str, nodes))}")
        if output.name in (*(b.name for b in before), *(gripper.name for gripper in options.gripper)):
            raise _refusal("output name", output.name, "one that no other output or gripper has")
        if any((other.node_id, other.bit) == (output.node_id, output.bit) for other in before):
            raise _refusal(f"{who}: bit", output.bit, "one that no other output of this drive has")


def syncs_of_gripper(rate_hz: float) -> int:
    """Number of cycles per status of a gripper's drive."""
    return min(max(round(rate_hz / GRIPPER_HZ), 1), LAST_SYNCHRONOUS)


def bus_load(options: CanOptions, guarded: int = 0, frames: list[int] | None = None) -> BusLoad:
    """Worst-case load of the cycle and of the heartbeats. ``guarded``: number of drives that are guarded by remote
    frames; ``frames``: lengths [bytes] of the joints' frames in a cycle, by default as of drives without restrictions.
    """
    n = len(options.joint)
    if options.protocol == "odrive":
        asked_in_turn = (2 if "effort" in options.feedback else 1) * min(SHARE, n)
        # Estimates are requested by a remote frame, answered, and followed by a velocity; errors and torques in turn.
        lengths = [0, 8, 8] * n + [0, 8] * asked_in_turn
        return cycle_load(lengths, options.rate_hz, options.bitrate, [(8, n * ODRIVE_HEARTBEATS_S)])
    if frames is None:
        plan = planned(TARGETS["csv"], options.feedback)
        frames = [] if plan is None else plan.lengths * n
    per_second = 1000.0 / options.heartbeat_ms
    grippers = len(options.gripper)
    beside = [(1, (n + grippers + 1) * per_second), (0, guarded * per_second)]
    beside.append((6, grippers * options.rate_hz / syncs_of_gripper(options.rate_hz)))
    return cycle_load([0, *frames], options.rate_hz, options.bitrate, beside)


def _check_unique(drives: Sequence[CanJoint], option: str, of: Callable[[CanJoint], Any]) -> None:
    seen: dict[Any, CanJoint] = {}
    for joint in drives:
        other = seen.setdefault(of(joint), joint)
        if other is not joint:
            who = f"joint {other.name!r} (node {other.node_id})"
            raise _refusal(option, of(joint), f"one that {who} does not have already", joint)


def _check_identity(options: CanOptions, joint: CanJoint) -> None:
    largest = _largest_identity(options)
    for option in ("vendor_id", "product_code", "revision", "serial_number"):
        value = getattr(joint, option)
        if value is not None and not 0 <= value <= largest:
            raise _refusal(option, value, f"0 to {largest:#x}; `stereoservo doctor` shows the drive's", joint)
    if joint.current_limit is not None and options.protocol == "cia402":
        valid = "left out: it is an ODrive's; a CiA 402 drive's is set with the maker's tool, or by sdo"
        raise _refusal("current_limit", joint.current_limit, valid, joint)


def _largest_identity(options: CanOptions) -> int:
    """Largest identity number: 32 bits in 0x1018 (CiA 301, 7.5.2.19), 48 in ODrive's serial numbers."""
    return UINT32_MAX if options.protocol == "cia402" else 2**48 - 1


def _check_geometry(joint: CanJoint) -> None:
    if joint.kind == "revolute" and not abs(joint.offset_rad) <= math.pi:
        degrees = f"; {_in_radians(joint.offset_rad)}" if abs(joint.offset_rad) <= 360.0 else ""
        raise _refusal("offset_rad", joint.offset_rad, f"-pi to pi [rad]{degrees}", joint)
    if not joint.position_min < joint.position_max:
        valid = f"less than position_max = {joint.position_max:g}"
        raise _refusal("position_min", joint.position_min, valid, joint)
    for option in ("position_min", "position_max", "offset_rad", "max_velocity", "max_acceleration"):
        if not math.isfinite(getattr(joint, option)):
            raise _refusal(option, getattr(joint, option), "a finite number", joint)


def _check_limits(joint: CanJoint) -> None:
    if joint.kind != "revolute":
        return
    for option in ("position_min", "position_max"):
        value = getattr(joint, option)
        if abs(value) > LONGEST_TURN and not joint.multi_turn:
            valid = f"radians, -2 pi to 2 pi; {_in_radians(value)}. A joint that turns further: multi_turn = true"
            raise _refusal(option, value, valid, joint)
    if joint.max_velocity > FASTEST_TURN:
        valid = f"rad/s, up to 4 pi; {_in_radians(joint.max_velocity)}"
        raise _refusal("max_velocity", joint.max_velocity, valid, joint)


def _in_radians(degrees: float) -> str:
    return f"are these degrees? {degrees:g} deg = {math.radians(degrees):.4g} rad"


def _check_range(joint: CanJoint) -> None:
    """Check the range of the drive's objects: 0x60FF is INTEGER32, 0x6083 to 0x6085 are UNSIGNED32."""
    scale = JointScale.of(joint)
    units = abs(scale.velocity_units_per_unit)
    remedy = "check counts_per_rev, gear_ratio and velocity_units_per_rev_s"
    for option, largest in (
        ("max_velocity", INT32_MAX),
        ("max_acceleration", UINT32_MAX),
        ("quick_stop_deceleration", UINT32_MAX),
    ):
        value = getattr(joint, option)
        if not value * units <= largest:
            what = f"{value * units:.4g} drive units; valid: up to {largest / units:.4g}, which is {largest}; {remedy}"
            raise _refusal(option, f"{value:g} is {what}", "", joint)
        if value * units < 0.5:
            what = f"{value * units:.3g} drive units, which is nothing; valid: at least {0.5 / units:.4g}; {remedy}"
            raise _refusal(option, f"{value:g} is {what}", "", joint)
    if joint.multi_turn:
        return  # the counter may wrap within its range
    farthest = max(abs(joint.position_min + joint.offset_rad), abs(joint.position_max + joint.offset_rad))
    if farthest * abs(scale.counts_per_unit) > INT32_MAX:
        valid = (
            f"within {INT32_MAX / abs(scale.counts_per_unit):.4g} of the encoder's zero, beyond which its 32-bit "
            "counter wraps, or multi_turn = true (the position is then known only while the driver runs)"
        )
        raise _refusal("position_min, position_max", (joint.position_min, joint.position_max), valid, joint)


BY_OPTION = {
    (0x6007, 0): "abort_option",
    (0x605A, 0): "quick_stop_option",
    (0x6060, 0): "mode",
    (0x6085, 0): "quick_stop_deceleration",
}
"""Objects by which a drive stops, which are checked as options."""
FAULT_REACTION = (0x605E, 0)


def _check_sdo(joint: CanJoint, key: str, value: int) -> None:
    try:
        name = parse_sdo_key(key)
    except ValueError as error:
        raise _refusal("sdo", key, str(error), joint) from error
    if not -(2**31) <= value <= UINT32_MAX:
        raise _refusal(f"sdo {key}", value, "an integer of at most 32 bits", joint)
    if name in BY_OPTION:
        raise _refusal(f"sdo {key}", value, f"this object is set by option {BY_OPTION[name]}", joint)
    if name == FAULT_REACTION and value == 0:
        valid = "another value: with 0 the drive lets its axis run out at a fault, where it is to stop"
        raise _refusal(f"sdo {key}", value, valid, joint)


def _refusal(option: str, value: object, valid: str, joint: CanJoint | None = None) -> DriverError:
    where = f"joint {joint.name!r}: " if joint is not None else ""
    value = without_secrets(value)
    text = f"{value}" if isinstance(value, str) else f"{value!r}"
    return DriverError(
        "option",
        f"driver 'canopen': {where}{option} = {text}" + (f"; valid: {valid}" if valid else ""),
        option=option,
        value=value,
        joint=joint.name if joint is not None else "",
    )
