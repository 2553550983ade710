"""Discovery on CAN: adapters of this computer, the bit rate of a bus, and the CiA 402 drives on it with what they tell
of themselves. Nothing is written to a drive.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import can
from serial.tools import list_ports

from stereoservo.ports.devices import DriverError, ExaminationFinding
from stereoservo.ports.discovery import BusScan, FoundBus, FoundDrive, JointChoice
from stereoservo_drivers.can.channel import Channel, ChannelSettings
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.bringup import Subscriptions
from stereoservo_drivers.canopen.cia402 import DriveAxis
from stereoservo_drivers.canopen.cia402_configuration import (
    DEADLINE,
    HEARTBEAT_CONSUMER,
    SHIPPED_EDS,
    load_eds,
)
from stereoservo_drivers.canopen.cia402_presence import ALL_NODES, CIA_402, IDENTITY, ask
from stereoservo_drivers.canopen.cia402_sdo import RemoteDrive
from stereoservo_drivers.canopen.option_checks import bus_load
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.options import decode_options

BITRATES = (1_000_000, 500_000, 250_000, 125_000, 800_000, 100_000, 50_000, 20_000)
"""Bit rates of CiA 301 [bit/s], the commonest first."""
NOT_HARDWARE = ("virtual", "udp_multicast", "slcan", "serial", "seeedstudio")
"""Interfaces that need no adapter, or take any serial port for theirs."""
HARDLY_LIMITS = 2**31 - 2**16
"""[counts] Limits that are as wide as the counter are none."""
ENCODER, TURNS = (0x608F, 1), (0x608F, 2)
POSITION_LIMITS = ((0x607D, 1), (0x607D, 2))
MOTOR_SPEED, POSITION = (0x6080, 0), (0x6064, 0)
SLCAN, SLCAN_SOCKET = "stereoservo_slcan", "socket://"


class SerialPort(Protocol):
    """What pyserial tells of a serial port."""

    device: str
    description: str
    vid: int | None


def found_buses(
    detect: Callable[[], Sequence[Mapping[str, Any]]] = can.detect_available_configs,
    ports: Callable[[], Iterable[SerialPort]] = list_ports.comports,
) -> tuple[FoundBus, ...]:
    """CAN adapters that python-can detects, then USB serial ports, behind which a serial-line adapter may be."""
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
                    f"serial port {port.device} ({port.description})",
                    {"interface": SLCAN, "channel": port.device},
                )
            )
    return tuple(found)


def _quietly(detect: Callable[[], Sequence[Mapping[str, Any]]]) -> Sequence[Mapping[str, Any]]:
    """python-can's detection without its warnings of every maker's library that is not there."""
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

    Where nothing answers at the stated bit rate, the others are tried, and one at which drives answer is a finding.
    Raises DriverError.
    """
    stated = int(options.get("bitrate", BITRATES[0]))
    rates = [stated, *(rate for rate in bitrates if rate != stated)]
    if options["interface"] == "socketcan":  # its bit rate is the kernel's, and checked when it is opened
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
        "nodes", False, f"nobody answers on {options['interface']} {options['channel']}, at {tried} bit/s",
        "power of the drives, cable, 120 ohm at both ends, the adapter's other channel",
    )  # fmt: skip
    return BusScan(dict(options), (), (nobody,))


def wrong_bitrate(nodes: Sequence[int], rate: int, stated: int) -> ExaminationFinding:
    """Finding on nodes that answer at another bit rate than the stated one [bit/s]."""
    return ExaminationFinding(
        "bit rate", False,
        f"nobody answers at {stated} bit/s; nodes {', '.join(map(str, nodes))} answer at {rate}",
        f"bitrate = {rate} in [joints.options]",
    )  # fmt: skip


def other_bitrate(options: Mapping[str, Any]) -> ExaminationFinding | None:
    """Finding on a bus where nobody answers at the stated bit rate and somebody does at another; None otherwise."""
    if options["interface"] == "socketcan":
        return None
    stated = int(options["bitrate"])
    for rate in BITRATES:
        settings = ChannelSettings(
            options["interface"], options["channel"], rate, options["interface_options"]
        )
        nodes = [] if rate == stated else answering(settings)
        if nodes:
            return wrong_bitrate(nodes, rate, stated)
    return None


def answering(settings: ChannelSettings) -> list[int]:
    """Numbers of the nodes that answer, each as often as it does. Raises DriverError."""
    channel = Channel(settings)
    try:
        return _answering(ScanLink(channel))
    except DriverError as error:
        if error.code in ("bus_off", "send_timeout", "send_refused"):  # as a wrong bit rate ends
            return []
        raise
    finally:
        channel.close()


def _answering(link: ScanLink) -> list[int]:
    answers = ask(link, list(ALL_NODES), 0x1000, 0)
    return [node for node, frames in answers.items() for _ in frames]


def _scan_at(settings: ChannelSettings) -> tuple[list[FoundDrive], list[ExaminationFinding]]:
    channel = Channel(settings)
    try:
        link = ScanLink(channel)
        nodes = _answering(link)
        drives, findings = [], []
        for node in dict.fromkeys(nodes):
            if nodes.count(node) > 1:
                findings.append(duplicate(node, nodes.count(node)))
                continue
            found = _asked(link, node)
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


def duplicate(node: int, count: int) -> ExaminationFinding:
    """Finding on several drives of one number."""
    return ExaminationFinding(
        f"node {node}", False, f"{count} drives answer as node {node}",
        "give each drive a node id of its own (switches on the drive, or its vendor's tool, one drive at a time)",
    )  # fmt: skip


def _asked(link: ScanLink, node: int) -> FoundDrive | ExaminationFinding:
    """What a node tells of itself; a finding where it is no drive."""
    anything = CanJoint(
        name="?", node_id=node, counts_per_rev=1.0, max_velocity=1.0, max_acceleration=1.0,
        quick_stop_deceleration=1.0, position_min=-1.0, position_max=1.0,
    )  # fmt: skip
    with RemoteDrive(link, DriveAxis(0, anything), load_eds(SHIPPED_EDS)) as drive:
        device = drive.read(0x1000)
        if device & 0xFFFF != CIA_402:
            return ExaminationFinding(
                f"node {node}", None, f"device profile {device & 0xFFFF}: no drive, left alone"
            )
        told: dict[str, Any] = {
            key: value
            for k, key in enumerate(IDENTITY)
            if (value := drive.read_if_there(0x1018, k + 1)) not in (None, 0)
        }
        counts, turns = drive.read_if_there(*ENCODER), drive.read_if_there(*TURNS)
        if counts and turns:
            told["counts_per_rev"] = counts / turns
        watched = any(drive.read_if_there(*key) is not None for key in (HEARTBEAT_CONSUMER, DEADLINE))
        low, high = (drive.read_if_there(*key) for key in POSITION_LIMITS)
        serial = f", serial number {told['serial_number']}" if "serial_number" in told else ""
        return FoundDrive(
            node,
            f"node {node}: CiA 402 drive of vendor {told.get('vendor_id', 0):#x}{serial}"
            + ("" if watched else "; it watches nothing of this computer"),
            told,
            stated_limits(low, high),
            drive.read_if_there(*POSITION),
            drive.read_if_there(*MOTOR_SPEED),
        )


def stated_limits(low: int | None, high: int | None) -> tuple[int, int] | None:
    """Software position limits [counts] as 0x607D has them; None where they limit nothing."""
    if low is None or high is None or low >= high or (low <= -HARDLY_LIMITS and high >= HARDLY_LIMITS):
        return None
    return low, high


RAMP_S, QUICK_STOP_S = 0.3, 0.1
"""Time from the largest speed to rest at the proposed acceleration, and in a quick stop."""
RATES = (250.0, 200.0, 150.0, 125.0, 100.0, 75.0, 50.0, 25.0, 10.0)


def proposed_options(scan: BusScan, joints: Sequence[JointChoice]) -> dict[str, Any]:
    """Options of the driver for the drives of a scan, at the fastest usual rate that the bus carries."""
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
