"""Examination of a CAN arm for ``stereoservo doctor``: the bus, the drives, their cycle, their units."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverError, ExaminationFinding, MayMove
from stereoservo_drivers.can.channel import Channel
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.bringup import listening
from stereoservo_drivers.canopen.bus_thread import BusThread
from stereoservo_drivers.canopen.cia402 import HEARTBEAT_ID, RPDO_IDS, SYNC_ID, Cia402Codec
from stereoservo_drivers.canopen.nodes import examine_nodes, other_bitrate, scan
from stereoservo_drivers.canopen.odrive_bringup import OdriveBringup
from stereoservo_drivers.canopen.option_checks import bus_load
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.canopen.unit_checks import (
    JOG,
    JogTrace,
    jog_finding,
    jog_velocity,
    noise_finding,
    position_finding,
    resolution_finding,
)

if TYPE_CHECKING:
    from stereoservo_drivers.canopen.driver import CanJointDriver

LISTEN_S = 0.3
WATCH_S = 1.0
SETTLE_S = 0.4
MISSED_SHARE = 0.01
LATE_SHARE = 0.5
HEARTBEAT_SHARE = 0.6


def examine(driver: CanJointDriver, cell_dir: Path, may_move: MayMove) -> Iterator[ExaminationFinding]:
    """Findings, in the order in which an integrator would check; ends early where no more can be determined."""
    options = driver.options
    yield load_finding(options)
    try:
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


def _examine_bus(driver: CanJointDriver, channel: Channel, cell_dir: Path) -> Iterator[ExaminationFinding]:
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
            "traffic", False, f"another master is on this bus: it sends {foreign}",
            "end it (another daemon, the drives' own tool, a PLC), or take the drives off its bus",
        )  # fmt: skip
    return ExaminationFinding(
        "traffic", True, f"{len(received)} frames in {LISTEN_S:g} s, none of another master"
    )


# -- in the cycle -----------------------------------------------------------------------------------------------


def _run(driver: CanJointDriver, may_move: MayMove) -> Iterator[ExaminationFinding]:
    """Configure, observe the cycle, jog. Raises DriverError."""
    driver.configure()
    yield ExaminationFinding(
        "configuration", True, "every drive took its settings, and gave them back as written"
    )
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
    """Findings on what is known of each axis's watchdog, limit and ramp."""
    for axis in bringup.codec.axes:
        well, told = bringup.safety[axis.node_id]
        remedy = (
            "" if well else "name flat_endpoints.json of its release in endpoints; or pull the cable once"
        )
        yield ExaminationFinding(f"{axis.name} settings", True if well else None, told, remedy)


def _watch(driver: CanJointDriver) -> Iterator[ExaminationFinding]:
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
        yield from heartbeat_findings(
            driver.options, [frame for frames in received.values() for frame in frames]
        )
    return np.array(positions)


def _sample(driver: CanJointDriver) -> FloatArray:
    """Current positions; with a latched fault, which is raised once, the sample after it."""
    try:
        return driver.read_state().positions
    except DriverError:
        return driver.read_state().positions


def cycles_finding(cycles: int, missed: int, skipped: int) -> ExaminationFinding:
    """Finding on cycles that lacked a reply, and slots that this computer missed itself."""
    message = f"{cycles} cycles, {missed} without all answers, {skipped} skipped by this computer"
    if missed == 0 and skipped <= MISSED_SHARE * cycles:
        return ExaminationFinding("cycle", True, message)
    if skipped > MISSED_SHARE * cycles:
        return ExaminationFinding(
            "cycle",
            None,
            message,
            "SCHED_FIFO for the daemon (limit rtprio), fewer other programs, lower rate_hz",
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
        (joint, count)
        for joint, count in zip(options.joint, counts, strict=True)
        if count < HEARTBEAT_SHARE * expected
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


def _jog_all(driver: CanJointDriver, usable: list[bool], may_move: MayMove) -> Iterator[ExaminationFinding]:
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
            name = f"{joint.name} way back"  # else joints that are tried again and again wander off
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


def _jog(driver: CanJointDriver, k: int, share: float) -> tuple[JogTrace, DriverError | None]:
    """Enable, move joint ``k`` by ``share`` of the usual jog, rest, switch off; returns what ended it early."""
    joint = driver.options.joint[k]
    cycle_s = 1.0 / driver.options.rate_hz
    trace = JogTrace(joint, float(driver.read_state().positions[k]), cycle_s)
    try:
        driver.activate()
        _hold(driver, trace, k, SETTLE_S)  # released brakes let an arm sink a little: that is not the jog
        trace = JogTrace(joint, float(driver.read_state().positions[k]), cycle_s)
        _move(driver, trace, k, share)
        if not trace.runs_away():
            _hold(driver, trace, k, SETTLE_S)
    except DriverError as error:
        return trace, error
    finally:
        driver.deactivate()
    return trace, None


def _move(driver: CanJointDriver, trace: JogTrace, k: int, share: float) -> None:
    start = now = time.monotonic()
    while not trace.runs_away():
        velocity = jog_velocity(trace.joint, now - start, share)
        if velocity is None:
            return
        now = _step(driver, trace, k, velocity, now)


def _hold(driver: CanJointDriver, trace: JogTrace, k: int, seconds: float) -> None:
    now = time.monotonic()
    end = now + seconds
    while now < end:
        now = _step(driver, trace, k, 0.0, now)


def _step(driver: CanJointDriver, trace: JogTrace, k: int, velocity: float, begun_s: float) -> float:
    """Command for one period, then read; returns when that was done, at which the next step has ``begun_s``."""
    command = np.zeros(len(driver.options.joint))
    command[k] = velocity
    driver.write_velocity(command)
    time.sleep(trace.cycle_s)
    state = driver.read_state()
    now = time.monotonic()
    trace.add(velocity, float(state.positions[k]), float(state.velocities[k]), now - begun_s)
    return now
