"""CiA 402 drives on a bus before anything is configured. For `stereoservo setup`: adapters of this computer, the bit
rate of a bus, the drives on it, their reported properties. For ``doctor``: presence, identity, state and limits of a
cell's drives. Nothing is written to a drive.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import can
from serial.tools import list_ports

from stereoservo.ports.devices import DriverError, ExaminationFinding
from stereoservo.ports.discovery import BusScan, FoundBus, FoundDrive, JointChoice
from stereoservo_drivers.can.channel import Channel, ChannelSettings, read_state
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402 import Cia402Codec, DriveAxis
from stereoservo_drivers.canopen.cia402_configuration import (
    GUARD_TIME,
    HEARTBEAT_CONSUMER,
    MODES,
    SHIPPED_EDS,
    capabilities,
    compose,
    eds_path,
    lead_words,
    load_eds,
)
from stereoservo_drivers.canopen.cia402_presence import ALL_NODES, CIA_402, IDENTITY, read_from_nodes
from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive
from stereoservo_drivers.canopen.cia402_words import FAULTY, drive_state, error_hint, error_words
from stereoservo_drivers.canopen.codec import Link, Subscriptions
from stereoservo_drivers.canopen.gripper import Gripper
from stereoservo_drivers.canopen.option_checks import bus_load
from stereoservo_drivers.canopen.options import POSITION_MODES, CanJoint, CanOptions
from stereoservo_drivers.canopen.units import JointScale
from stereoservo_drivers.options import decode_options

BITRATES = (1_000_000, 500_000, 250_000, 125_000, 800_000, 100_000, 50_000, 20_000)
"""Bit rates of CiA 301 [bit/s], the commonest first."""
NOT_HARDWARE = ("virtual", "udp_multicast", "slcan", "serial", "seeedstudio")
"""Interfaces that need no adapter, or accept any serial port as theirs."""
UNLIMITED_COUNTS = 2**31 - 2**16
"""[counts] Limits at least as wide as the counter limit nothing."""
ENCODER, TURNS = (0x608F, 1), (0x608F, 2)
POSITION_LIMITS = ((0x607D, 1), (0x607D, 2))
POSITION = (0x6064, 0)
SLCAN, SLCAN_SOCKET = "stereoservo_slcan", "socket://"


class SerialPort(Protocol):
    """Properties of a serial port reported by pyserial."""

    device: str
    description: str
    vid: int | None


def found_buses(
    detect: Callable[[], Sequence[Mapping[str, Any]]] = can.detect_available_configs,
    ports: Callable[[], Iterable[SerialPort]] = list_ports.comports,
) -> tuple[FoundBus, ...]:
    """CAN adapters detected by python-can, then USB serial ports, to which a serial-line adapter may be connected."""
    found: list[FoundBus] = []
    for config in _quietly(detect):
        interface, channel = str(config["interface"]), config["channel"]
        if interface in NOT_HARDWARE:
            continue
        found.append(FoundBus(f"{interface} {channel}", {"interface": interface, "channel": channel}))
    for port in ports():
        if port.vid is not None:
            found.append(
                FoundBus(
                    f"serial port {port.device} ({port.description})", {"interface": SLCAN, "channel": port.device}
                )
            )
    return tuple(found)


def _quietly(detect: Callable[[], Sequence[Mapping[str, Any]]]) -> Sequence[Mapping[str, Any]]:
    """python-can's detection without its warnings about missing vendor libraries."""
    log = logging.getLogger("can")
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        return detect()
    finally:
        log.setLevel(before)


class ScanLink(Subscriptions):
    """A bus that is served while it is waited on; no cycle, no heartbeat, no thread."""

    def __init__(self, channel: Channel) -> None:
        super().__init__()
        self._channel = channel

    def send(self, frames: list[CanFrame]) -> None:
        """Send frames in order. Raises DriverError."""
        self._channel.send(frames)

    def wait(self, seconds: float) -> None:
        """Receive for some time. Raises DriverError once the bus is lost."""
        end = time.monotonic() + seconds
        while True:
            left = end - time.monotonic()
            for _, frame in self._channel.receive(max(left, 0.0)):
                if not frame.extended:
                    self.tell(frame)
            if left <= 0:
                return

    def now_ns(self) -> int:
        """Monotonic time."""
        return time.monotonic_ns()


def scan_bus(options: Mapping[str, Any], bitrates: Sequence[int] = BITRATES) -> BusScan:
    """Drives on the bus of ``options`` (interface, channel, bitrate, interface_options).

    If no node answers at the stated bit rate, the others are tried; one at which drives answer is reported as a
    finding. Raises DriverError.
    """
    stated = int(options.get("bitrate", _kernels_bitrate(options) or BITRATES[0]))
    rates = [stated, *(rate for rate in bitrates if rate != stated)]
    if options["interface"] == "socketcan":  # its bit rate is set by the kernel, and checked when it is opened
        rates = [stated]
    for rate in rates:
        settings = ChannelSettings(
            options["interface"], options["channel"], rate, dict(options.get("interface_options", {}))
        )
        drives, findings = _scan_at(settings)
        if not drives and not findings:
            continue
        if rate != stated and "bitrate" in options:
            findings.insert(0, wrong_bitrate([drive.address for drive in drives], rate, stated))
        return BusScan({**options, "bitrate": rate}, tuple(drives), tuple(findings))
    tried = ", ".join(map(str, rates))
    nobody = ExaminationFinding(
        "nodes",
        False,
        f"nobody answers on {options['interface']} {options['channel']}, at {tried} bit/s",
        "power of the drives, cable, 120 ohm at both ends, the adapter's other channel",
    )
    return BusScan(dict(options), (), (nobody,))


def _kernels_bitrate(options: Mapping[str, Any]) -> int | None:
    """Bit rate of a socketcan interface in the kernel; None for other interfaces, or if the kernel reports none."""
    state = read_state(str(options["channel"])) if options["interface"] == "socketcan" else None
    return None if state is None else state.bitrate


def wrong_bitrate(nodes: Sequence[int], rate: int, stated: int) -> ExaminationFinding:
    """Finding on nodes that answer at another bit rate than the stated one [bit/s]."""
    return ExaminationFinding(
        "bit rate",
        False,
        f"nobody answers at {stated} bit/s; nodes {', '.join(map(str, nodes))} answer at {rate}",
        f"bitrate = {rate} in [joints.options]",
    )


def other_bitrate(options: Mapping[str, Any]) -> ExaminationFinding | None:
    """Finding on a bus on which nodes answer only at another bit rate than the stated one; None otherwise."""
    if options["interface"] == "socketcan":
        return None
    stated = int(options["bitrate"])
    for rate in BITRATES:
        settings = ChannelSettings(options["interface"], options["channel"], rate, options["interface_options"])
        nodes = [] if rate == stated else answering(settings)
        if nodes:
            return wrong_bitrate(nodes, rate, stated)
    return None


def answering(settings: ChannelSettings) -> list[int]:
    """Numbers of the nodes that answer at a bit rate. Raises DriverError."""
    channel = Channel(settings)
    try:
        return list(scan(ScanLink(channel)))
    except DriverError as error:
        if error.code in ("bus_off", "send_timeout", "send_refused"):  # the usual effect of a wrong bit rate
            return []
        raise
    finally:
        channel.close()


def _scan_at(settings: ChannelSettings) -> tuple[list[FoundDrive], list[ExaminationFinding]]:
    channel = Channel(settings)
    try:
        link = ScanLink(channel)
        drives, findings = [], []
        for node, count in scan(link).items():
            if count > 1:
                findings.append(_duplicate(f"node {node}", node, count))
                continue
            try:
                found = _asked(link, node)
            except DriverError as error:
                if error.code not in ("sdo_abort", "sdo_timeout"):
                    raise
                found = ExaminationFinding(f"node {node}", False, str(error))
            if isinstance(found, FoundDrive):
                drives.append(found)
            else:
                findings.append(found)
        return drives, findings
    except DriverError as error:
        if error.code in ("bus_off", "send_timeout", "send_refused"):
            return [], []
        raise
    finally:
        channel.close()


def _duplicate(name: str, node: int, count: int) -> ExaminationFinding:
    return ExaminationFinding(
        name,
        False,
        f"{count} drives answer as node {node}",
        "give each drive a node id of its own (switches on the drive, or its vendor's tool, one drive at a time)",
    )


def _asked(link: ScanLink, node: int) -> FoundDrive | ExaminationFinding:
    """Properties reported by a node; a finding if it is not a drive."""
    anything = CanJoint(
        name="?", node_id=node, counts_per_rev=1.0, max_velocity=1.0, max_acceleration=1.0,
        quick_stop_deceleration=1.0, position_min=-1.0, position_max=1.0,
    )  # fmt: skip
    with RemoteDrive(link, DriveAxis(0, anything), load_eds(SHIPPED_EDS)) as drive:
        device = drive.read(0x1000)
        if device & 0xFFFF != CIA_402:
            return ExaminationFinding(f"node {node}", None, f"device profile {device & 0xFFFF}: no drive, left alone")
        told: dict[str, Any] = {
            key: value
            for k, key in enumerate(IDENTITY)
            if (value := drive.read_if_there(0x1018, k + 1)) not in (None, 0)
        }
        counts, turns = drive.read_if_there(*ENCODER), drive.read_if_there(*TURNS)
        if counts and turns:
            told["counts_per_rev"] = counts / turns
        watched = any(drive.read_if_there(*key) is not None for key in (HEARTBEAT_CONSUMER, GUARD_TIME))
        low, high = (drive.read_if_there(*key) for key in POSITION_LIMITS)
        serial = f", serial number {told['serial_number']}" if "serial_number" in told else ""
        return FoundDrive(
            node,
            f"node {node}: CiA 402 drive of vendor {told.get('vendor_id', 0):#x}{serial}"
            + ("" if watched else "; it watches nothing of this computer"),
            told,
            stated_limits(low, high),
            drive.read_if_there(*POSITION),
        )


def stated_limits(low: int | None, high: int | None) -> tuple[int, int] | None:
    """Software position limits [counts] in 0x607D; None if they limit nothing."""
    if low is None or high is None or low >= high or (low <= -UNLIMITED_COUNTS and high >= UNLIMITED_COUNTS):
        return None
    return low, high


RAMP_S, QUICK_STOP_S = 0.3, 0.1
"""Time from the largest speed to rest at the proposed acceleration, and in a quick stop."""
RATES = (250.0, 200.0, 150.0, 125.0, 100.0, 75.0, 50.0, 25.0, 10.0)


def proposed_options(scan: BusScan, joints: Sequence[JointChoice]) -> dict[str, Any]:
    """Options of the driver for the drives of a scan, at the fastest usual rate that the bus allows."""
    tables = []
    for choice in joints:
        known = {key: value for key, value in choice.drive.options.items() if key in IDENTITY}
        units = choice.velocity_units_per_rev_s
        tables.append(
            {
                "name": choice.name,
                "node_id": choice.drive.address,
                **({"kind": "prismatic"} if choice.kind == "prismatic" else {}),
                **known,
                "counts_per_rev": choice.counts_per_rev,
                "gear_ratio": choice.gear_ratio,
                **({} if units is None else {"velocity_units_per_rev_s": units}),
                "direction": 1,
                "offset_rad": 0.0,
                "max_velocity": choice.velocity,
                "max_acceleration": round(choice.velocity / RAMP_S, 4),
                "quick_stop_deceleration": round(choice.velocity / QUICK_STOP_S, 4),
                "position_min": choice.low,
                "position_max": choice.high,
            }
        )
    options = {**scan.options, "rate_hz": RATES[0], "joint": tables}
    for rate in RATES:
        options["rate_hz"] = rate
        decoded = decode_options(CanOptions, options, "canopen")
        if bus_load(decoded).share <= decoded.max_bus_load:
            break
    return options


# -- the drives of a cell file -----------------------------------------------------------------------------------

MODE_NAMES = {1: "profile position", 3: "profile velocity", 4: "torque", 6: "homing", 7: "interpolated position",
              8: "cyclic position", 9: "cyclic velocity", 10: "cyclic torque"}  # fmt: skip
_WIRING = "is it powered, is its cable in, are its bit rate and its node id those of the cell file?"


def examine_nodes(link: Link, options: CanOptions, codec: Cia402Codec, cell_dir: Path) -> Iterator[ExaminationFinding]:
    """Findings on every node; nothing is written to any drive. Raises DriverError if the bus is lost."""
    answers = scan(link)
    grippers = {each.node_id: Gripper(options, each, cell_dir) for each in options.gripper}
    known = [*codec.axes, *(gripper.axis for gripper in grippers.values())]
    unknown_nodes = [node for node in answers if node not in {axis.node_id for axis in known}]
    dictionary = load_eds(eds_path(options, cell_dir))
    for axis in known:
        count, gripper = answers.get(axis.node_id, 0), grippers.get(axis.node_id)
        if count != 1:
            yield _not_one(axis, count, unknown_nodes)
            continue
        with RemoteDrive(link, axis, dictionary if gripper is None else load_eds(gripper.eds)) as drive:
            try:
                yield _identity(drive, axis.joint)
                yield _state(drive)
                if gripper is not None:
                    yield _gripper(drive, gripper)
                    continue
                yield _modes(drive, options)
                yield from limits_findings(axis.joint, drive.read_if_there(0x607D, 1), drive.read_if_there(0x607D, 2))
            except DriverError as error:
                yield ExaminationFinding(axis.name, False, str(error))
    if unknown_nodes:
        words = ", ".join(str(node) for node in unknown_nodes)
        yield ExaminationFinding("other nodes", None, f"{words} answer too, and no joint of the cell file has them")


def _gripper(drive: RemoteDrive, gripper: Gripper) -> ExaminationFinding:
    """Finding on a gripper's mode and on its reaction to the loss of this computer. Raises DriverError."""
    setup = gripper.compose(drive, capabilities(drive))
    return ExaminationFinding(
        f"{drive.name} mode", None if setup.losses else True, f"profile position (1); {setup.safety()}"
    )


def scan(link: Link) -> dict[int, int]:
    """Query every node id for its device type; returns the number of replies from each that replied."""
    answers = read_from_nodes(link, list(ALL_NODES), 0x1000, 0)
    return {node: len(frames) for node, frames in answers.items() if frames}


def _not_one(axis: DriveAxis, count: int, unknown_nodes: list[int]) -> ExaminationFinding:
    if count > 1:
        return _duplicate(axis.name, axis.node_id, count)
    remedy = _WIRING
    if unknown_nodes:
        remedy += f" Nodes {', '.join(map(str, unknown_nodes))} answer, which no joint has: is it one of them?"
    return ExaminationFinding(axis.name, False, "no answer", remedy)


def _identity(drive: RemoteDrive, joint: CanJoint) -> ExaminationFinding:
    name = drive.axis.name
    device = drive.read(0x1000)
    values = {what: drive.read_if_there(0x1018, k + 1) for k, what in enumerate(IDENTITY)}
    reported = ", ".join(f"{what} {value:#x}" if value is not None else f"no {what}" for what, value in values.items())
    message = f"answers once; device type {device:#010x}, {reported}"
    if device & 0xFFFF != CIA_402:
        return ExaminationFinding(
            name,
            False,
            f"{message}: device profile {device & 0xFFFF} is not CiA 402",
            "another device has this node id; or protocol of the cell file",
        )
    wrong = [
        (what, value)
        for what, value in values.items()
        if getattr(joint, what) is not None and getattr(joint, what) != value
    ]
    if wrong:
        asked = ", ".join(f"{what} is {getattr(joint, what):#x} in the cell file" for what, _ in wrong)
        mended = ", ".join(f"{what} = {value:#x}" for what, value in wrong if value is not None)
        return ExaminationFinding(name, False, f"{message}; but {asked}", f"if this drive belongs here: {mended}")
    return ExaminationFinding(name, True, message)


def limits_findings(joint: CanJoint, low: int | None, high: int | None) -> Iterator[ExaminationFinding]:
    """Finding on the cell file's position limits against the drive's own (0x607D) [counts]; none if it has none."""
    limits = stated_limits(low, high)
    if limits is None:
        return
    scale = JointScale.of(joint)
    own_low, own_high = sorted(scale.position(counts) for counts in limits)
    unit = "rad" if joint.kind == "revolute" else "m"
    own = f"the drive's own (0x607D) are {own_low:.4g} to {own_high:.4g} {unit}"
    step = scale.resolution
    if own_low - step <= joint.position_min and joint.position_max <= own_high + step:
        yield ExaminationFinding(f"{joint.name} limits", True, f"within the drive's: {own}")
        return
    yield ExaminationFinding(
        f"{joint.name} limits",
        False,
        f"{joint.position_min:.4g} to {joint.position_max:.4g} {unit} reach beyond the drive: {own}",
        f"position_min and position_max of {joint.name!r} and its [[safety.limit]] within these; or the drive's 0x607D",
    )


def _state(drive: RemoteDrive) -> ExaminationFinding:
    name = f"{drive.axis.name} state"
    state = drive_state(drive.read(0x6041))
    register = drive.read(0x1001)
    past = _past_errors(drive)
    texts = [state.value]
    volts = drive.read_if_there(0x6079)
    if volts is not None:
        texts.append(f"supply {volts * 1e-3:.1f} V")
    switches = drive.read_if_there(0x60FD) or 0
    texts += [f"{what} limit switch active" for bit, what in enumerate(("negative", "positive")) if switches >> bit & 1]
    texts.append(f"error register {register:#04x}" if register else "no error")
    if past:
        texts.append(f"history {', '.join(error_words(code) for code in past)}")
    message = "; ".join(texts)
    if state in FAULTY or register:
        code = drive.read_if_there(0x603F) or (past[0] if past else 0)
        words = f" ({error_words(code)})" if code else ""
        remedy = error_hint(code) if code else "look its error up in the drive's manual"
        return ExaminationFinding(name, False, f"{message}{words}", f"{remedy}; then `stereoservo reset` clears it")
    return ExaminationFinding(name, None if switches & 3 else True, message)


def _past_errors(drive: RemoteDrive) -> list[int]:
    """Error history 0x1003, newest first."""
    count = drive.read_if_there(0x1003, 0) or 0
    read = (drive.read_if_there(0x1003, k) for k in range(1, min(count, 4) + 1))
    return [value & 0xFFFF for value in read if value]


def _modes(drive: RemoteDrive, options: CanOptions) -> ExaminationFinding:
    """Modes, monitoring and restrictions, as the drive would be configured; raises DriverError as that does."""
    name = f"{drive.axis.name} modes"
    supported = drive.read_if_there(0x6502)
    if supported is None:
        message = "0x6502 is not there"
    else:
        modes = [mode for mode in range(1, 33) if supported >> (mode - 1) & 1]
        message = ", ".join(f"{mode} {MODE_NAMES.get(mode, '')}".strip() for mode in modes) or "none"
    try:
        setup = compose(drive, options, capabilities(drive))
    except DriverError as error:
        return ExaminationFinding(name, False, f"{message}; {error}")
    chosen = setup.modes[0]
    message += f"; used: {MODES[chosen]} ({chosen}); {setup.safety()}"
    if chosen in POSITION_MODES:
        message += f"; {lead_words(drive.axis.joint)}"
    return ExaminationFinding(name, None if setup.losses else True, message)
