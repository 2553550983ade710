"""Examination of a CAN arm for ``stereoservo doctor``: the bus, the drives, their cycle, their units."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverError, ExaminationFinding, JointDriver, MayMove
from stereoservo_drivers.can.channel import Channel
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.bus_thread import BusThread
from stereoservo_drivers.canopen.cia402 import HEARTBEAT_ID, RPDO_IDS, SYNC_ID, Cia402Codec
from stereoservo_drivers.canopen.cia402_configuration import eds_path
from stereoservo_drivers.canopen.codec import Bringup, listening
from stereoservo_drivers.canopen.eds_files import read_eds
from stereoservo_drivers.canopen.gripper import Gripper
from stereoservo_drivers.canopen.master import Master
from stereoservo_drivers.canopen.nodes import examine_nodes, other_bitrate, scan
from stereoservo_drivers.canopen.odrive import OdriveBringup
from stereoservo_drivers.canopen.option_checks import bus_load
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.canopen.units import JointScale

LISTEN_S = 0.3
WATCH_S = 1.0
SETTLE_S = 0.4
MISSED_SHARE = 0.01
LATE_SHARE = 0.5
HEARTBEAT_SHARE = 0.6
SHOWN_LINES = 20
PDOS = {"RPDOs": 0x1400, "TPDOs": 0x1800}
"""First of the 512 objects that may each describe one."""
CIA402 = {0x6040: "control word", 0x6041: "status word", 0x6060: "mode of operation"}


class ExaminedDriver(JointDriver, Protocol):
    """A driver that is examined: its ``options``, ``master`` and ``bringup``; ``bus``: None unless configured."""

    options: CanOptions
    master: Master
    bringup: Bringup
    bus: BusThread | None


def examine(driver: ExaminedDriver, cell_dir: Path, may_move: MayMove) -> Iterator[ExaminationFinding]:
    """Findings, in the order in which an integrator would check; ends early if further ones cannot be determined."""
    options = driver.options
    yield load_finding(options)
    try:
        if isinstance(driver.master.codec, Cia402Codec):
            own = [eds_path(options, cell_dir), *(Gripper(options, each, cell_dir).eds for each in options.gripper)]
            for path in dict.fromkeys(own):
                yield from eds_findings(path)
        try:
            channel = Channel(options)
        except DriverError as error:
            yield ExaminationFinding("bus", False, str(error))
            return
        yield ExaminationFinding("bus", True, f"{channel.name} is open at {options.bitrate} bit/s")
        yield from _examine_bus(driver, channel, cell_dir)
        yield from _run(driver, may_move)
    except DriverError as error:
        yield ExaminationFinding("drives", False, str(error))
    finally:
        driver.close()


def load_finding(options: CanOptions) -> ExaminationFinding:
    """Finding on the bus load of the cell file's cycle, which the driver has accepted."""
    load = bus_load(options)
    return ExaminationFinding(
        "bus load",
        True,
        f"{load.share:.0%} in the worst case of bit stuffing, limit {options.max_bus_load:.0%} (max_bus_load); "
        f"{len(options.joint)} joints at {options.rate_hz:g} Hz; this bus carries {load.max_rate_hz:.0f} Hz",
    )


def examine_eds(path: Path) -> Iterator[ExaminationFinding]:
    """Findings on an EDS or DCF file: the drive, its objects, what is odd. Raises DriverError (``eds``)."""
    dictionary = read_eds(path)[0]
    of = dictionary.device_information
    names = [str(name) for name in (of.vendor_name, of.product_name) if name]
    vendor, product = (
        f"0x{number:x}" if number is not None else "none" for number in (of.vendor_number, of.product_number)
    )
    yield ExaminationFinding("drive", True, f"{' '.join(names) or 'unnamed'}: vendor {vendor}, product {product}")
    pdos = {what: sum(first <= index < first + 0x200 for index in dictionary) for what, first in PDOS.items()}
    counts = ", ".join(f"{count} {what}" for what, count in pdos.items())
    yield ExaminationFinding("objects", True, f"{len(dictionary)} objects, {counts}")
    if lacking := [f"0x{index:04X} ({what})" for index, what in CIA402.items() if index not in dictionary]:
        message = f"without {', '.join(lacking)}, which CiA 402 drives have"
        yield ExaminationFinding("CiA 402", None, message, "the drive is asked; is this the file of the drive itself?")
    yield from eds_findings(path)


def eds_findings(path: Path) -> Iterator[ExaminationFinding]:
    """What is odd in an EDS, line by line, at most ``SHOWN_LINES``. Raises DriverError (``eds``) if it is unusable."""
    by_line = [(line, list(them)) for line, them in groupby(read_eds(path)[1], lambda remark: remark.line)]
    for line, remarks in by_line[:SHOWN_LINES]:
        yield ExaminationFinding(f"{path.name}:{line}", None, "; ".join(map(str, remarks)))
    if len(by_line) > SHOWN_LINES:
        yield ExaminationFinding(path.name, None, f"{len(by_line) - SHOWN_LINES} more lines are odd")


def _examine_bus(driver: ExaminedDriver, channel: Channel, cell_dir: Path) -> Iterator[ExaminationFinding]:
    """Listen, then query the drives. Closes the channel."""
    try:
        received = _listen(channel)
        errors = [error.message for _, error in channel.take_errors()]
    except DriverError:
        channel.close()
        raise
    yield traffic_finding(driver.options, received)
    if errors:
        remedy = f"bit rate of every node ({driver.options.bitrate}), terminators, cable"
        yield ExaminationFinding("bus errors", False, "; ".join(dict.fromkeys(errors)), remedy)
    bus = BusThread(channel, driver.master)
    silent = False
    try:
        if isinstance(driver.master.codec, Cia402Codec):
            silent = not scan(bus)
            if not silent:
                yield from examine_nodes(bus, driver.options, driver.master.codec, cell_dir)
    finally:
        bus.end()
    if silent:
        elsewhere = other_bitrate(msgspec.structs.asdict(driver.options))
        if elsewhere is not None:
            yield elsewhere


def _listen(channel: Channel) -> list[CanFrame]:
    received: list[CanFrame] = []
    end = time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        received += [frame for _, frame in channel.receive(0.01)]
    return received


def traffic_finding(options: CanOptions, received: list[CanFrame]) -> ExaminationFinding:
    """Finding on other masters on this bus, by frames (received in ``LISTEN_S``) that only a master sends."""
    commands = {RPDO_IDS[0] + joint.node_id for joint in options.joint}
    of_a_master = {0, SYNC_ID, HEARTBEAT_ID + options.master_id, *commands}
    found = {frame.id for frame in received if not frame.extended} & of_a_master
    if options.protocol == "cia402" and found:
        foreign = ", ".join(f"0x{can_id:X}" for can_id in sorted(found))
        return ExaminationFinding(
            "traffic",
            False,
            f"another master is on this bus: it sends {foreign}",
            "end it (another daemon, the drives' own tool, a PLC), or take the drives off its bus",
        )
    return ExaminationFinding("traffic", True, f"{len(received)} frames in {LISTEN_S:g} s, none of another master")


# -- in the cycle -----------------------------------------------------------------------------------------------


def _run(driver: ExaminedDriver, may_move: MayMove) -> Iterator[ExaminationFinding]:
    """Configure, observe the cycle, jog. Raises DriverError."""
    driver.configure()
    yield ExaminationFinding("configuration", True, "every drive took its settings, and gave them back as written")
    if isinstance(driver.bringup, OdriveBringup):
        yield from odrive_findings(driver.bringup)
    positions = yield from _watch(driver)
    fault = driver.master.fault
    if fault is not None:
        yield ExaminationFinding("fault", False, fault.message, fault.hint)
    usable = []
    for k, joint in enumerate(driver.options.joint):
        yield resolution_finding(joint)
        place = position_finding(joint, float(positions[-1, k]))
        yield place
        yield noise_finding(joint, positions[:, k])
        usable.append(place.ok is True)
    if fault is None:
        yield from _jog_all(driver, usable, may_move)


def odrive_findings(bringup: OdriveBringup) -> Iterator[ExaminationFinding]:
    """Findings on the known watchdog, limit and ramp of each axis."""
    for axis in bringup.codec.axes:
        well, told = bringup.safety[axis.node_id]
        remedy = "" if well else "name flat_endpoints.json of its release in endpoints; or pull the cable once"
        yield ExaminationFinding(f"{axis.name} settings", True if well else None, told, remedy)


def _watch(driver: ExaminedDriver) -> Iterator[ExaminationFinding]:
    """Run a second of cycles with the arm off; returns positions (k, n)."""
    period_s = 1.0 / driver.options.rate_hz
    before, skipped = driver.master.statistics, driver.bus.statistics.skipped if driver.bus else 0
    first = (before.cycles, before.incomplete)
    cia402 = driver.options.protocol == "cia402"
    ids = [HEARTBEAT_ID + joint.node_id for joint in driver.options.joint] if cia402 else []
    positions, answered = [], []
    assert driver.bus is not None  # configured
    with listening(driver.bus, ids) as received:
        for _ in range(round(WATCH_S / period_s)):
            positions.append(_sample(driver))
            answered.append(driver.master.statistics.answered_ns)
            time.sleep(period_s)
    now = driver.master.statistics
    cycles, missed = now.cycles - first[0], now.incomplete - first[1]
    yield cycles_finding(cycles, missed, driver.bus.statistics.skipped - skipped)
    yield latency_finding(np.array(answered) * 1e-9, period_s)
    if cia402:
        yield from heartbeat_findings(driver.options, [frame for frames in received.values() for frame in frames])
    return np.array(positions)


def _sample(driver: ExaminedDriver) -> FloatArray:
    """Current positions; with a latched fault, which is raised once, those of the next sample."""
    try:
        return driver.read_state().positions
    except DriverError:
        return driver.read_state().positions


def cycles_finding(cycles: int, missed: int, skipped: int) -> ExaminationFinding:
    """Finding on cycles that lacked a reply, and slots that this computer itself missed."""
    message = f"{cycles} cycles, {missed} without all answers, {skipped} skipped by this computer"
    if missed == 0 and skipped <= MISSED_SHARE * cycles:
        return ExaminationFinding("cycle", True, message)
    if skipped > MISSED_SHARE * cycles:
        return ExaminationFinding(
            "cycle", None, message, "SCHED_FIFO for the daemon (limit rtprio), fewer other programs, lower rate_hz"
        )
    remedy = "cable, terminators, adapter; lower rate_hz; max_missed_cycles allows single ones"
    return ExaminationFinding("cycle", None if missed <= MISSED_SHARE * cycles else False, message, remedy)


def latency_finding(answered_s: FloatArray, period_s: float) -> ExaminationFinding:
    """Finding on the time from a poll to its last reply [s], (k,)."""
    median, largest = float(np.median(answered_s)), float(np.max(answered_s))
    message = (
        f"SYNC to last answer {median * 1e3:.2f} ms median, {largest * 1e3:.2f} ms largest, of a cycle of "
        f"{period_s * 1e3:g} ms"
    )
    if median <= LATE_SHARE * period_s:
        return ExaminationFinding("latency", True, message)
    return ExaminationFinding(
        "latency", None, message, "a faster adapter (USB ones need 1 ms a transfer), or lower rate_hz"
    )


def heartbeat_findings(options: CanOptions, received: list[CanFrame]) -> Iterator[ExaminationFinding]:
    """Findings on the heartbeats received in ``WATCH_S``, against the configured ones."""
    expected = WATCH_S * 1e3 / options.heartbeat_ms
    counts = [sum(frame.id == HEARTBEAT_ID + joint.node_id for frame in received) for joint in options.joint]
    rare = [
        (joint, count) for joint, count in zip(options.joint, counts, strict=True) if count < HEARTBEAT_SHARE * expected
    ]
    for joint, count in rare:
        yield ExaminationFinding(
            f"node {joint.node_id} ({joint.name}) heartbeat",
            False,
            f"{count} in {WATCH_S:g} s, {expected:.0f} were asked for",
            "does the drive keep 0x1017? Are frames lost (cable, terminators, adapter)?",
        )
    if not rare:
        message = f"from every drive, {min(counts)} to {max(counts)} in {WATCH_S:g} s"
        yield ExaminationFinding("heartbeats", True, message)


# -- jogs ---------------------------------------------------------------------------------------------------------


def _jog_all(driver: ExaminedDriver, usable: list[bool], may_move: MayMove) -> Iterator[ExaminationFinding]:
    for k, joint in enumerate(driver.options.joint):
        name = f"{joint.name} jog"
        if not usable[k]:
            yield ExaminationFinding(name, None, "not jogged: it stands outside its limits")
            continue
        middle = (joint.position_min + joint.position_max) / 2
        sign = 1.0 if float(driver.read_state().positions[k]) <= middle else -1.0
        share = min(float(may_move(_question(joint, sign))), 1.0)
        if share <= 0.0:
            yield ExaminationFinding(name, None, "not jogged: not allowed (--jog asks)")
            continue
        trace, error = _jog(driver, k, sign * share)
        if error is None:
            found = jog_finding(trace)
            yield msgspec.structs.replace(found, jogged=(joint.name, trace.travel))
            if found.ok is False:
                continue
            name = f"{joint.name} way back"  # otherwise repeatedly tested joints drift away
            trace, error = _jog(driver, k, -sign * share)
            if error is None:
                continue
        remedy = jog_finding(trace).remedy if trace.asked else ""
        yield ExaminationFinding(name, False, str(error), remedy)
        return


def _question(joint: CanJoint, sign: float) -> str:
    travel = (
        f"{math.degrees(sign * JOG['revolute']):+.0f}°"
        if joint.kind == "revolute"
        else f"{sign * JOG['prismatic'] * 1e3:+.0f} mm"
    )
    return (
        f"Joint {joint.name} (node {joint.node_id}) is going to be enabled and moved by {travel} and back, slowly. Is "
        "its surrounding clear and a hand on the emergency stop?"
    )


def _jog(driver: ExaminedDriver, k: int, share: float) -> tuple[JogTrace, DriverError | None]:
    """Enable, move joint ``k`` by ``share`` of the usual jog, rest, switch off; returns the reason of an early end."""
    joint = driver.options.joint[k]
    cycle_s = 1.0 / driver.options.rate_hz
    trace = JogTrace(joint, float(driver.read_state().positions[k]), cycle_s)
    try:
        driver.activate()
        _hold(driver, trace, k, SETTLE_S)  # released brakes let an arm sink a little, which is not the jog
        trace = JogTrace(joint, float(driver.read_state().positions[k]), cycle_s)
        _move(driver, trace, k, share)
        if not trace.runs_away():
            _hold(driver, trace, k, SETTLE_S)
    except DriverError as error:
        return trace, error
    finally:
        driver.deactivate()
    return trace, None


def _move(driver: ExaminedDriver, trace: JogTrace, k: int, share: float) -> None:
    start = now = time.monotonic()
    while not trace.runs_away():
        velocity = jog_velocity(trace.joint, now - start, share)
        if velocity is None:
            return
        now = _step(driver, trace, k, velocity, now)


def _hold(driver: ExaminedDriver, trace: JogTrace, k: int, seconds: float) -> None:
    now = time.monotonic()
    end = now + seconds
    while now < end:
        now = _step(driver, trace, k, 0.0, now)


def _step(driver: ExaminedDriver, trace: JogTrace, k: int, velocity: float, begun_s: float) -> float:
    """Command for one period, then read; returns the time of that, when the next step starts (``begun_s``)."""
    command = np.zeros(len(driver.options.joint))
    command[k] = velocity
    driver.write_velocity(command)
    time.sleep(trace.cycle_s)
    state = driver.read_state()
    now = time.monotonic()
    trace.add(velocity, float(state.positions[k]), float(state.velocities[k]), now - begun_s)
    return now


# -- units, limits, signs ------------------------------------------------------------------------------------
# Checks whether a joint's units, limits and signs in the cell file agree with the drive's behaviour.


NOISE_COUNTS = 8.0
NOISE = 1e-4
"""[rad or m] Largest fluctuation of an encoder at rest, or ``NOISE_COUNTS``."""
COARSE = 1e-4
"""[rad/s or m/s] A coarser velocity unit disturbs how a control law comes to rest."""
JOG = {"revolute": math.radians(1.0), "prismatic": 2e-3}
"""Travel of a jog [rad or m]."""
SLOWEST_SHARE = 5e-3
FASTEST = {"revolute": 0.04, "prismatic": 0.005}
"""[rad/s or m/s] Largest velocity of a jog."""
DOUBLING_S = 0.06
"""Time in which the jog's velocity doubles [s]: units wrong by a factor of a thousand show while it is still slow."""
RUNAWAY = 3.0
TOLERANCE = 0.15
LAG_S = 0.15
SURE = 1.3
"""A named unit within this factor of the fitting one is assumed to be meant."""
STOPPED_EARLY = 6.0
"""The same for a joint that was stopped before it had reached its speed."""
NAMED_UNITS = {1.0: "rev/s", 60.0: "rpm", 600.0: "rpm/10", 6000.0: "rpm/100", 60_000.0: "rpm/1000"}


def position_finding(joint: CanJoint, position: float) -> ExaminationFinding:
    """Finding on a joint's position [rad or m] against the machine's limits."""
    name, unit = f"{joint.name} position", _unit(joint)
    limits = f"{joint.position_min:g} to {joint.position_max:g} {unit}"
    if joint.position_min <= position <= joint.position_max:
        return ExaminationFinding(name, True, f"{position:+.4f} {unit}, within {limits}")
    outside = max(joint.position_min - position, position - joint.position_max)
    message = f"{position:+.4f} {unit} is {outside:.3g} {unit} outside {limits}"
    zero = joint.offset_rad + position
    remedy = f"if the joint stands at its zero now, offset_rad = {zero:.4f}"
    if joint.kind == "revolute" and abs(zero) > math.pi:
        remedy = (
            "so far outside, counts_per_rev (of the motor, after quadrature) or gear_ratio is wrong, limits are in "
            "degrees, or the encoder has lost its zero: home the drive"
        )
    return ExaminationFinding(name, False, message, remedy)


def noise_finding(joint: CanJoint, positions: FloatArray) -> ExaminationFinding:
    """Finding on positions (k,) of a joint that should be at rest."""
    name, unit = f"{joint.name} at rest", _unit(joint)
    counts = abs(JointScale.of(joint).counts_per_unit)
    range_seen = float(np.ptp(positions))
    drift = float(positions[-1] - positions[0])
    message = f"wavers by {range_seen:.2g} {unit} ({range_seen * counts:.0f} counts)"
    if range_seen <= max(NOISE, NOISE_COUNTS / counts):
        return ExaminationFinding(name, True, message)
    if abs(drift) > 0.8 * range_seen:
        return ExaminationFinding(
            name,
            False,
            f"moves by {drift:+.2g} {unit} while nobody drives it",
            "it sinks: see to its brake; or it was pushed: leave it alone and repeat",
        )
    return ExaminationFinding(
        name, False, message, "encoder cable, its screen, and the encoder's type set in the drive"
    )


def resolution_finding(joint: CanJoint) -> ExaminationFinding:
    """Finding on the joint velocity of one velocity unit."""
    unit = _unit(joint)
    step = 1.0 / abs(JointScale.of(joint).velocity_units_per_unit)
    message = f"one unit of velocity is {step:.2g} {unit}/s, one count {JointScale.of(joint).resolution:.2g} {unit}"
    if step <= COARSE:
        return ExaminationFinding(f"{joint.name} units", True, message)
    return ExaminationFinding(
        f"{joint.name} units",
        None,
        f"{message}: coarse; goals end in a slow hunt about rest",
        "set the drive's velocity unit finer (0x60A9, e.g. rpm/1000) and velocity_units_per_rev_s with it",
    )


def jog_velocity(joint: CanJoint, t_s: float, share: float) -> float | None:
    """Velocity [rad/s or m/s] of the jog at ``t_s`` after its start: slow, doubling, constant; None: finished.

    ``share``: signed travel as a share of ``JOG``.
    """
    sign = math.copysign(1.0, share)
    fastest = min(FASTEST[joint.kind], 0.2 * joint.max_velocity)
    slowest = max(SLOWEST_SHARE * fastest, 1.0 / abs(JointScale.of(joint).velocity_units_per_unit))
    slowest = min(slowest, fastest)
    growth = math.log(2.0) / DOUBLING_S
    rise_s = math.log(fastest / slowest) / growth
    risen = (fastest - slowest) / growth
    if t_s < rise_s:
        return sign * slowest * math.exp(growth * t_s)
    if t_s < rise_s + max(abs(share) * JOG[joint.kind] - risen, 0.0) / fastest:
        return sign * fastest
    return None


@dataclass
class JogTrace:
    """Record of a jog; call ``add`` every cycle. ``asked``: commanded travel so far [rad or m]; ``unsure``: uncertainty
    of it from cycles that took more than twice their ``cycle_s``: a drive without commands stops at some time, or
    continues.
    """

    joint: CanJoint
    start: float
    cycle_s: float
    asked: float = 0.0
    unsure: float = 0.0
    longest_s: float = 0.0
    commanded: float = 0.0
    longest_lag: float = 0.0
    reported: float = 0.0
    positions: list[float] = field(default_factory=list)

    @property
    def travel(self) -> float:
        """Travel by the joint's encoder."""
        return self.positions[-1] - self.start if self.positions else 0.0

    def add(self, commanded: float, position: float, velocity: float, dt_s: float) -> None:
        """Add one cycle: the velocity commanded in it, position and velocity as reported at its end."""
        fastest = max(abs(commanded), abs(self.commanded))
        self.asked += commanded * dt_s
        self.unsure += fastest * max(dt_s - 2.0 * self.cycle_s, 0.0)
        self.longest_s = max(self.longest_s, dt_s if fastest else 0.0)
        self.commanded = commanded
        self.positions.append(position)
        self.reported += velocity * dt_s
        self.longest_lag = max(self.longest_lag, abs(self.asked - self.travel))

    def runs_away(self) -> bool:
        """Whether the joint moves far more than commanded, and must be stopped."""
        margin = max(NOISE, NOISE_COUNTS / abs(JointScale.of(self.joint).counts_per_unit))
        return abs(self.travel) > RUNAWAY * abs(self.asked) + 3.0 * margin

    def in_doubt(self) -> bool:
        """Whether a drive with correct units may have moved like this, because cycles took too long."""
        asked, travel = abs(self.asked), math.copysign(1.0, self.asked) * self.travel
        low, high = (1.0 - TOLERANCE) * (asked - self.unsure), (1.0 + TOLERANCE) * (asked + self.unsure)
        apart = abs(self.reported - self.travel)
        return self.unsure > 0.0 and low <= travel <= high and apart <= 2 * TOLERANCE * abs(travel) + self.unsure


def jog_finding(trace: JogTrace) -> ExaminationFinding:
    """Finding on a finished jog: direction, travel, and the factor by which the units are wrong; None if this computer
    was suspended for so long that they cannot be determined.
    """
    found = _finding_of_units(trace)
    if found.ok is True or not trace.in_doubt():
        return found
    asked, travel = _travel_text(trace.joint, trace.asked), _travel_text(trace.joint, trace.travel)
    return ExaminationFinding(
        found.name,
        None,
        f"asked for {asked}, moved {travel} by its own encoder, but while it moved a cycle took "
        f"{trace.longest_s * 1e3:.0f} ms instead of {trace.cycle_s * 1e3:.0f}, in which drives may stop: not judged",
        "repeat it when this computer has less to do",
    )


def _finding_of_units(trace: JogTrace) -> ExaminationFinding:
    joint = trace.joint
    name = f"{joint.name} jog"
    asked, travel = _travel_text(joint, trace.asked), _travel_text(joint, trace.travel)
    ratio = trace.travel / trace.asked if trace.asked else math.inf
    if trace.runs_away():
        remedy = _units_remedy(joint, ratio, at_least=True)
        return ExaminationFinding(name, False, f"asked for {asked}, moved {travel} before it was stopped", remedy)
    if ratio > 1.0 + TOLERANCE:
        return ExaminationFinding(
            name, False, f"asked for {asked}, moved {travel}: {ratio:.3g} times", _units_remedy(joint, ratio)
        )
    if ratio < -0.05:
        return ExaminationFinding(
            name,
            False,
            f"asked for {asked}, its encoder moved {travel}: the wrong way",
            "motor and encoder count in opposite senses: polarity of the encoder in the drive (0x607E turns both)",
        )
    if ratio < 0.05:
        return ExaminationFinding(
            name,
            False,
            f"asked for {asked}, moved {travel}: it stands",
            f"brake, safe torque off, the drive's mode; or {_units_remedy(joint, ratio)}"
            if ratio > 1e-5
            else "brake, safe torque off, the drive's mode, its velocity limit",
        )
    if ratio < 1.0 - TOLERANCE:
        return ExaminationFinding(
            name, False, f"asked for {asked}, moved {travel}: {ratio:.3g} times", _units_remedy(joint, ratio)
        )
    share = trace.reported / trace.travel
    if not 1.0 - 2 * TOLERANCE < share < 1.0 + 2 * TOLERANCE:
        return ExaminationFinding(
            name,
            False,
            f"moved {travel}, but the velocity that the drive reports (0x606C) adds up to "
            f"{_travel_text(joint, trace.reported)}: {share:.3g} times",
            "actual and target velocity differ in units: see the drive's manual; or leave velocity out of feedback",
        )
    fastest = min(FASTEST[joint.kind], 0.2 * joint.max_velocity)
    lag_s = trace.longest_lag / fastest
    message = f"asked for {asked}, moved {travel} by its own encoder, at most {lag_s * 1e3:.0f} ms behind"
    if lag_s > LAG_S:
        return ExaminationFinding(name, None, message, "velocity loop of the drive: gains, or its acceleration limit")
    return ExaminationFinding(
        name,
        True,
        f"{message}; where your eye saw less or more, gear_ratio is wrong by that factor, where it saw the "
        "other way, direction",
    )


def _units_remedy(joint: CanJoint, ratio: float, *, at_least: bool = False) -> str:
    """Remedy for wrong units. ``at_least``: the joint was stopped while accelerating; the true ratio is larger."""
    configured = joint.velocity_units_per_rev_s or joint.counts_per_rev
    if not 0.0 < abs(ratio) < math.inf:
        return f"velocity_units_per_rev_s is {configured:g}, counts_per_rev {joint.counts_per_rev:g}: both right?"
    fits = configured / abs(ratio)
    low, high = (fits / STOPPED_EARLY, fits * SURE) if at_least else (fits / SURE, fits * SURE)
    named = {**NAMED_UNITS, joint.counts_per_rev: "counts/s"}
    near = [value for value in named if low <= value <= high and value != configured]
    if near:
        unit = max(near) if at_least else min(near, key=lambda value: abs(math.log(value / fits)))
        return f"velocity_units_per_rev_s = {unit:g} ({named[unit]})? it is {configured:g}"
    return (
        f"velocity_units_per_rev_s is {configured:g}; about {_rounded(fits)} would fit this travel, if counts_per_rev "
        f"({joint.counts_per_rev:g}) is right"
    )


def _rounded(value: float) -> str:
    return f"{value:.0f}" if 100.0 <= value < 1e9 else f"{value:.3g}"


def _unit(joint: CanJoint) -> str:
    return "rad" if joint.kind == "revolute" else "m"


def _travel_text(joint: CanJoint, travel: float) -> str:
    return f"{math.degrees(travel):+.3f}°" if joint.kind == "revolute" else f"{travel * 1e3:+.3f} mm"
