"""Codec of ODrive's CANSimple (firmware 0.6): identifier = node id << 5 | command, little-endian float32 in turns and
turns/s.

Encoder estimates of all axes are requested by remote frames every cycle; errors and torques in turn, ``SHARE`` axes per
cycle, since six axes at 250 Hz on 1 Mbit/s leave no capacity for more. Axis states are in the drives' own heartbeats.

A stop is velocity zero in closed loop, ramped down and repeated every cycle: it keeps torque on the joint. Estop (0x02)
and the idle state disarm the motor, and a gravity axis without a brake falls: neither is ever sent to a moving arm. The
velocity ramps are computed here, at the joint's ``max_acceleration`` and ``quick_stop_deceleration``, since CANSimple
has no message that sets the drive's own (``vel_ramp_rate``).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from stereoservo.messages.decoding import decoding
from stereoservo.messages.text_files import complete, json_of
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import NOT_CYCLIC, AxisFault, Feedback, Link, listening, until
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.canopen.units import JointScale

VERSION, HEARTBEAT, GET_ERROR, RX_SDO, TX_SDO, ADDRESS, SET_AXIS_STATE = (0x00, 0x01, 0x03, 0x04, 0x05, 0x06, 0x07)
GET_ENCODER_ESTIMATES, SET_CONTROLLER_MODE, SET_INPUT_VEL = 0x09, 0x0B, 0x0D
SET_LIMITS, CLEAR_ERRORS, GET_TORQUES = 0x0F, 0x18, 0x1C
IDLE, CLOSED_LOOP_CONTROL = 1, 8
VELOCITY_CONTROL, PASSTHROUGH = 2, 1

SHARE = 2
"""Number of axes per cycle of which errors are requested, and likewise torques."""

RESOLUTION_TURNS = 2.0**-12
"""Assumed smallest step of a position, that of a coarse encoder: ODrive does not report counts."""

_U32X2 = struct.Struct("<II")
_F32X2 = struct.Struct("<ff")
_STATE = struct.Struct("<IB")
_DATA = 8

_STATES = {
    0: "undefined",
    1: "idle",
    2: "startup sequence",
    3: "full calibration",
    4: "motor calibration",
    6: "encoder index search",
    7: "encoder offset calibration",
    8: "closed loop control",
    9: "lock-in spin",
    10: "encoder direction search",
    11: "homing",
}
_ERRORS = {
    0x1: "initializing",
    0x2: "system level",
    0x4: "timing",
    0x8: "missing estimate",
    0x10: "bad config",
    0x20: "gate driver",
    0x40: "missing input",
    0x100: "bus over-voltage",
    0x200: "bus under-voltage",
    0x400: "bus over-current",
    0x800: "bus over-regeneration",
    0x1000: "current limit violated",
    0x2000: "motor too hot",
    0x4000: "inverter too hot",
    0x8000: "velocity limit violated",
    0x10000: "position limit violated",
    0x1000000: "watchdog expired",
    0x2000000: "estop requested",
    0x4000000: "spinout detected",
    0x8000000: "brake resistor disarmed",
    0x10000000: "thermistor disconnected",
    0x40000000: "calibration",
}


def frame_id(node_id: int, command: int) -> int:
    """CAN identifier of a command to, or a reply of, a node."""
    return node_id << 5 | command


def error_words(errors: int) -> str:
    """Text of ``errors`` (ODrive.Error bits)."""
    names = [name for bit, name in _ERRORS.items() if errors & bit]
    rest = errors & ~sum(_ERRORS)
    return ", ".join([*names, *([f"0x{rest:X}"] if rest else [])]) or "none"


def _refuse(joint: CanJoint, option: str, value: object, valid: str) -> None:
    raise DriverError(
        "option",
        f"joint {joint.name!r}: {option} = {value!r} does not fit protocol 'odrive': {valid}",
        joint=joint.name,
        option=option,
        value=value,
    )


def check_options(options: CanOptions) -> None:
    """Check options that CANSimple does not support. Raises DriverError (``option``)."""
    if "following_error" in options.feedback:
        raise DriverError(
            "option",
            "feedback: an ODrive has no following error in velocity control; valid: velocity, effort",
            feedback=options.feedback,
        )
    for joint in options.joint:
        if joint.node_id > 62:
            _refuse(joint, "node_id", joint.node_id, "1..62 (six bits of the identifier; 63 is nobody's yet)")
        if joint.counts_per_rev != 1:
            _refuse(joint, "counts_per_rev", joint.counts_per_rev, "1, since an ODrive speaks turns")
        if joint.velocity_units_per_rev_s not in (None, 1):
            _refuse(joint, "velocity_units_per_rev_s", joint.velocity_units_per_rev_s, "1 or left out")
        for name in ("vendor_id", "product_code", "revision"):
            if getattr(joint, name) is not None:
                _refuse(joint, name, getattr(joint, name), "left out; serial_number is what an ODrive tells")
        if joint.sdo:
            _refuse(joint, "sdo", dict(joint.sdo), "left out")


class Axis:
    """Last known state of one axis, in turns."""

    def __init__(self, index: int, joint: CanJoint, rate_hz: float) -> None:
        scale = JointScale.of(joint)
        self.index, self.joint, self.node_id = index, joint, joint.node_id
        self.turns_per_unit, self.offset = scale.counts_per_unit, scale.offset
        self.velocity_max = abs(joint.max_velocity * self.turns_per_unit)
        self.step = abs(joint.max_acceleration * self.turns_per_unit) / rate_hz
        self.stop_step = abs(joint.quick_stop_deceleration * self.turns_per_unit) / rate_hz
        self.state: int | None = None
        self.errors = 0
        self.sent = 0.0

    @property
    def name(self) -> str:
        return f"axis {self.joint.name!r} (node {self.node_id})"

    def error(self, code: str, message: str, *, retry: bool = False, **data: Any) -> DriverError:
        """An error of this axis, whose name precedes the ``message``."""
        return DriverError(code, f"{self.name}{message}", retry=retry, node_id=self.node_id, **data)

    def remote(self, command: int) -> CanFrame:
        return CanFrame(frame_id(self.node_id, command), remote=True, length=_DATA)

    def velocity(self, turns_s: float) -> CanFrame:
        self.sent = turns_s
        return CanFrame(frame_id(self.node_id, SET_INPUT_VEL), _F32X2.pack(turns_s, 0.0))

    def towards(self, turns_s: float, step: float) -> CanFrame:
        return self.velocity(self.sent + min(max(turns_s - self.sent, -step), step))

    def request(self, state: int) -> CanFrame:
        return CanFrame(frame_id(self.node_id, SET_AXIS_STATE), _U32X2.pack(state, 0))


class OdriveCodec:
    """Codec of ODrive axes. Raises DriverError (``option``) on options that do not fit."""

    def __init__(self, options: CanOptions) -> None:
        check_options(options)
        self.axes = tuple(Axis(k, joint, options.rate_hz) for k, joint in enumerate(options.joint))
        count = len(self.axes)
        self._efforts = np.full(count, np.nan) if "effort" in options.feedback else None
        self.feedback = Feedback(np.full(count, np.nan), np.full(count, np.nan), self._efforts)
        self.expected = (1 << count) - 1
        self.bit_axis = tuple(range(count))
        self.bit_name = tuple(f"encoder estimates of node {axis.node_id}" for axis in self.axes)
        self._estimates = [axis.remote(GET_ENCODER_ESTIMATES) for axis in self.axes]
        asked = [GET_ERROR] if self._efforts is None else [GET_ERROR, GET_TORQUES]
        self._rounds = [[axis.remote(command) for axis in self.axes] for command in asked]
        self._turn = 0
        self._events: list[AxisFault] = []
        self._takers = {
            frame_id(axis.node_id, command): (take, axis)
            for axis in self.axes
            for command, take in (
                (GET_ENCODER_ESTIMATES, self._take_estimates),
                (HEARTBEAT, self._take_heartbeat),
                (GET_ERROR, self._take_errors),
                (GET_TORQUES, self._take_torques),
            )
        }

    def poll(self) -> list[CanFrame]:
        """Remote frames: estimates of all, errors (and torques) of the next ``SHARE`` axes."""
        count = len(self.axes)
        turns = [(self._turn + k) % count for k in range(min(SHARE, count))]
        self._turn = (self._turn + len(turns)) % count
        return self._estimates + [asked[k] for asked in self._rounds for k in turns]

    def heartbeat(self) -> list[CanFrame]:
        """No frame: the drives' watchdogs are fed by the velocities of every cycle."""
        return []

    def receive(self, frame: CanFrame) -> int:
        """Decode a frame; NOT_CYCLIC for all but finite encoder estimates."""
        if frame.remote or frame.extended or frame.id not in self._takers:
            return NOT_CYCLIC
        take, axis = self._takers[frame.id]
        if len(frame.data) != _DATA:
            self._event(axis, "mapping", f"{len(frame.data)} bytes in frame 0x{frame.id:03X}, not 8", frame.id)
            return NOT_CYCLIC
        return take(axis, frame.data)

    def _event(self, axis: Axis, code: str, message: str, value: int | None = None) -> None:
        self._events.append(AxisFault(axis.index, code, f"{axis.name}: {message}", value))

    def _take_estimates(self, axis: Axis, data: bytes) -> int:
        position, velocity = _F32X2.unpack(data)
        if not (math.isfinite(position) and math.isfinite(velocity)):
            self._event(axis, "feedback", f"encoder estimates {position} turns, {velocity} turns/s")
            return NOT_CYCLIC
        self.feedback.positions[axis.index] = position / axis.turns_per_unit - axis.offset
        self.feedback.velocities[axis.index] = velocity / axis.turns_per_unit
        return axis.index

    def _take_heartbeat(self, axis: Axis, data: bytes) -> int:
        axis.errors, axis.state = _STATE.unpack_from(data)
        return NOT_CYCLIC

    def _take_errors(self, axis: Axis, data: bytes) -> int:
        active, disarm_reason = _U32X2.unpack(data)
        axis.errors = active | disarm_reason
        return NOT_CYCLIC

    def _take_torques(self, axis: Axis, data: bytes) -> int:
        """Torques [N m] at the motor, converted to the joint [N m], or [N] of a prismatic one, by the gear without
        losses.
        """
        _, torque = _F32X2.unpack(data)
        if not math.isfinite(torque):
            self._event(axis, "feedback", f"torque estimate {torque} N m")
        elif self._efforts is not None:
            self._efforts[axis.index] = torque * axis.turns_per_unit * 2.0 * math.pi
        return NOT_CYCLIC

    def faults(self) -> tuple[AxisFault, ...]:
        """Events since the last call, and every axis with errors."""
        events, self._events = self._events, []
        return (*events, *(self._drive_fault(axis) for axis in self.axes if axis.errors))

    def _drive_fault(self, axis: Axis) -> AxisFault:
        return AxisFault(
            axis.index,
            "drive_fault",
            f"{axis.name}: ODrive error {error_words(axis.errors)}",
            axis.errors,
            "remove the cause, then reset",
        )

    def enabled(self) -> bool:
        """Whether all axes are in closed loop, by their newest heartbeats since enabling was requested."""
        return all(axis.state == CLOSED_LOOP_CONTROL and not axis.errors for axis in self.axes)

    def at_rest_unpowered(self) -> bool:
        """Whether all axes are idle, by their newest heartbeats."""
        return all(axis.state == IDLE for axis in self.axes)

    def idle(self) -> list[CanFrame]:
        """Frames: velocity zero; the idle state for axes not known to be in it."""
        still = [axis.velocity(0.0) for axis in self.axes]
        return still + [axis.request(IDLE) for axis in self.axes if axis.state != IDLE]

    def enable(self) -> list[CanFrame]:
        """Frames: velocity zero; closed loop for idle axes without errors, whose state is unknown until the next
        heartbeat.
        """
        frames = [axis.velocity(0.0) for axis in self.axes]
        for axis in self.axes:
            if axis.state == IDLE and not axis.errors:
                frames.append(axis.request(CLOSED_LOOP_CONTROL))
                axis.state = None
        return frames

    def command(self, velocities: FloatArray) -> list[CanFrame]:
        """Frames: the next step of every axis's ramp towards ``velocities`` (n,)."""
        turns_s = (
            min(max(float(qd) * axis.turns_per_unit, -axis.velocity_max), axis.velocity_max)
            for axis, qd in zip(self.axes, velocities, strict=True)
        )
        return [axis.towards(goal, axis.step) for axis, goal in zip(self.axes, turns_s, strict=True)]

    def quick_stop(self) -> list[CanFrame]:
        """Frames: the next step of every axis's ramp to zero; torque remains on."""
        return [axis.towards(0.0, axis.stop_step) for axis in self.axes]

    def sendable(self, velocities: FloatArray) -> FloatArray:
        """Velocities within the joints' limits, as float32 turns/s."""
        turns = np.array([axis.turns_per_unit for axis in self.axes])
        limits = np.array([axis.velocity_max for axis in self.axes])
        wire = np.clip(velocities * turns, -limits, limits).astype(np.float32)
        return wire.astype(np.float64) / turns

    def status_words(self) -> tuple[str, ...]:
        """State and errors of every axis."""
        return tuple(
            f"{'no heartbeat yet' if a.state is None else _STATES.get(a.state, f'state {a.state}')}"
            f"{f'; errors: {error_words(a.errors)}' if a.errors else ''}"
            for a in self.axes
        )


# -- bring-up --------------------------------------------------------------------------------------------------


STEP_S = 0.01
HEARTBEAT_WAIT_S = 0.5
"""Time limit for heartbeats [s]: they come every 100 ms unless configured otherwise."""
ANSWER_WAIT_S = 0.05
QUIET_S = 0.05
"""Duration of the check for unrequested encoder estimates and for commands of another master [s]."""
PROTOCOL_VERSION = 2
ALL_NODES = tuple(range(63))

WATCHDOG, WATCHDOG_S = "axis0.config.enable_watchdog", "axis0.config.watchdog_timeout"
SPEED, RAMP = "axis0.controller.config.vel_limit", "axis0.controller.config.vel_ramp_rate"
CONTROL_MODE, INPUT_MODE = "axis0.controller.config.control_mode", "axis0.controller.config.input_mode"
CHECKED = (WATCHDOG, WATCHDOG_S, SPEED, RAMP, CONTROL_MODE, INPUT_MODE)
TYPES = {"bool": "?", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i", "float": "f"}
LEAST_CYCLES = 2.0
"""Least time-out of the watchdog [cycles]: a shorter one trips because of a single late cycle."""

Heard = dict[int, list[CanFrame]]
"""Data frames by node id."""


@contextmanager
def _listening(link: Link, nodes: tuple[int, ...], command: int) -> Iterator[Heard]:
    with listening(link, [frame_id(node, command) for node in nodes]) as received:
        yield {node: received[frame_id(node, command)] for node in nodes}


class DriveProperty(msgspec.Struct, frozen=True):
    """A property of a release: its number on the wire and its type."""

    id: int = 0
    type: str = ""


class Release(msgspec.Struct, frozen=True):
    """``flat_endpoints.json``: properties of one firmware for one hardware, by path."""

    fw_version: str
    hw_version: str
    endpoints: dict[str, DriveProperty]


def load_release(path: Path) -> Release:
    """Read a ``flat_endpoints.json``. Raises DriverError (``endpoints``)."""
    with decoding(lambda cause: DriverError("endpoints", f"endpoints: {path} {cause}", path=str(path))):
        release = msgspec.convert(complete(json_of(path.read_bytes())), Release)
    unfit = [name for name in CHECKED if _layout(release, name) is None]
    if unfit:
        raise DriverError(
            "endpoints",
            f"endpoints: {path} has no {', '.join(unfit)}, or not as a number; take flat_endpoints.json of the release",
            path=str(path),
        )
    return release


def _layout(release: Release, name: str) -> tuple[int, struct.Struct] | None:
    endpoint = release.endpoints.get(name)
    if endpoint is None or endpoint.type not in TYPES or not 0 < endpoint.id <= 0xFFFF:
        return None
    return endpoint.id, struct.Struct("<BHB" + TYPES[endpoint.type])


class OdriveBringup:
    """Bring-up of the axes of one bus. ``firmware``, ``safety``: by node id, once connected: version, and the known
    values of watchdog, limit and ramp, as text, with whether all of them are known.
    """

    def __init__(self, options: CanOptions, codec: OdriveCodec, cell_dir: Path) -> None:
        self.codec = codec
        self.firmware: dict[int, str] = {}
        self.safety: dict[int, tuple[bool, str]] = {}
        self._options = options
        self._hardware: dict[int, str] = {}
        self._releases = [load_release(cell_dir / name) for name in options.endpoints]
        self._axes = {axis.node_id: axis for axis in codec.axes}
        self._nodes = tuple(self._axes)

    def connect(self, link: Link) -> None:
        """Check every node, set velocity control and limits, leave it idle.

        Errors of drives are not cleared: the codec reports them. Raises DriverError: ``node_missing``, ``no_answer``,
        ``duplicate_node``, ``identity``, ``version``, ``cyclic_messages``, ``no_feedback``, ``not_idle``,
        ``second_master``, ``no_watch``, ``watchdog``, ``limit``, ``mode``.
        """
        self._check_alone(link)
        # Axes that a dead master has left moving: before anything that can fail, and long before the idle state.
        link.send([axis.velocity(0.0) for axis in self.codec.axes])
        self._await_heartbeats(link)
        self._check_identities(link)
        self._check_versions(link)
        self._check_estimates(link)
        self._set_up(link)
        self._check_settings(link)
        self._await_idle(link)

    def reset(self, link: Link) -> None:
        """Configure again (a drive may have rebooted), clear errors, read them. Enables nothing.

        Raises DriverError (``node_missing``, ``reset_refused``, ``no_answer``, ``not_idle``).
        """
        self._await_heartbeats(link)
        self._set_up(link)
        self._check_settings(link)
        link.send([CanFrame(frame_id(node, CLEAR_ERRORS), bytes(8)) for node in self._nodes])
        link.wait(STEP_S)
        for node, answers in self._ask(link, GET_ERROR).items():
            axis = self._axes[node]
            self.codec.receive(answers[-1])
            if axis.errors:
                words = error_words(axis.errors)
                raise axis.error(
                    "reset_refused",
                    f": {words} stays after Clear_Errors; remove the cause first",
                    retry=True,
                    errors=axis.errors,
                )
        self._await_idle(link)
        for fault in self.codec.faults():
            if fault.code == "drive_fault":
                raise DriverError("reset_refused", fault.message, retry=True, errors=fault.value)

    def release(self, link: Link) -> None:
        """Command velocity zero and power off."""
        link.send([axis.velocity(0.0) for axis in self.codec.axes])
        link.send([axis.request(IDLE) for axis in self.codec.axes])

    def _ask(self, link: Link, command: int) -> Heard:
        """All replies of all nodes to a remote frame within ``ANSWER_WAIT_S``; raises if one has none."""
        with _listening(link, self._nodes, command) as received:
            link.send([axis.remote(command) for axis in self.codec.axes])
            link.wait(ANSWER_WAIT_S)
        answers = {node: [f for f in frames if not f.remote] for node, frames in received.items()}
        for node, frames in answers.items():
            if not frames:
                raise self._axes[node].error(
                    "no_answer", f": no answer to command 0x{command:02X} in {ANSWER_WAIT_S} s", retry=True
                )
        return answers

    def _check_alone(self, link: Link) -> None:
        """Check that no other master sends velocities to these axes."""
        with _listening(link, self._nodes, SET_INPUT_VEL) as received:
            link.wait(QUIET_S)
        for node, frames in received.items():
            if frames:
                raise self._axes[node].error(
                    "second_master",
                    f": somebody else commands this axis, {len(frames)} velocities within "
                    f"{QUIET_S} s; end the other master (another daemon or doctor on this bus) first",
                    retry=True,
                    frames=len(frames),
                )

    def _await_heartbeats(self, link: Link) -> None:
        """Wait for every node's heartbeat, at most ``HEARTBEAT_WAIT_S``."""
        with _listening(link, ALL_NODES, HEARTBEAT) as received:
            until(link, lambda: all(received[node] for node in self._nodes), HEARTBEAT_WAIT_S, STEP_S)
        present = [node for node, frames in received.items() if frames]
        missing = [node for node in self._nodes if not received[node]]
        if missing:
            raise DriverError(
                "node_missing",
                f"no heartbeat of {', '.join(self._axes[node].name for node in missing)} within {HEARTBEAT_WAIT_S} s; "
                f"heard: {', '.join(f'node {node}' for node in present) or 'nobody'}. Check power, wiring, bitrate, "
                "axis0.config.can.node_id and heartbeat_msg_rate_ms",
                retry=True,
                missing=missing,
                heard=present,
            )

    def _check_identities(self, link: Link) -> None:
        for node, answers in self._ask(link, ADDRESS).items():
            axis = self._axes[node]
            serials = [int.from_bytes(frame.data[1:7], "little") for frame in answers]
            if len(answers) > 1:
                raise _duplicate(node, f"serial numbers {', '.join(f'0x{s:012X}' for s in serials)}")
            if axis.joint.serial_number not in (None, serials[0]):
                raise axis.error(
                    "identity",
                    f" has serial number {serials[0]}, the cell file says {axis.joint.serial_number}",
                    serial_number=serials[0],
                )

    def _check_versions(self, link: Link) -> None:
        for node, answers in self._ask(link, VERSION).items():
            if len(answers) > 1:
                raise _duplicate(node, "two versions")
            data = answers[0].data
            if len(data) != 8 or data[0] != PROTOCOL_VERSION:
                raise self._axes[node].error(
                    "version",
                    f" answers {data.hex(' ')} to Get_Version; protocol version "
                    f"{PROTOCOL_VERSION} (firmware 0.6) is needed",
                )
            self.firmware[node] = ".".join(str(number) for number in data[4:7])
            self._hardware[node] = ".".join(str(number) for number in data[1:4])

    def _check_estimates(self, link: Link) -> None:
        """Check that an estimate is only sent on request (in the cycle others would look like a second drive's)."""
        with _listening(link, self._nodes, GET_ENCODER_ESTIMATES) as unasked:
            link.wait(QUIET_S)
        for node, frames in unasked.items():
            if frames:
                raise self._axes[node].error(
                    "cyclic_messages",
                    f" sends encoder estimates unasked, {len(frames)} in {QUIET_S} s; set "
                    "axis0.config.can.encoder_msg_rate_ms = 0",
                )
        for node, answers in self._ask(link, GET_ENCODER_ESTIMATES).items():
            if len(answers) > 1:
                raise _duplicate(node, f"{len(answers)} encoder estimates")
            if self.codec.receive(answers[0]) < 0:
                raise self._axes[node].error(
                    "no_feedback",
                    f": encoder estimates {answers[0].data.hex(' ')} are not two finite float32; calibrate the encoder",
                )

    def _set_up(self, link: Link) -> None:
        mode = struct.pack("<II", VELOCITY_CONTROL, PASSTHROUGH)
        for node, axis in self._axes.items():
            link.send([axis.velocity(0.0), axis.request(IDLE)])
            link.send([CanFrame(frame_id(node, SET_CONTROLLER_MODE), mode)])
            if axis.joint.current_limit is not None:
                limits = struct.pack("<ff", axis.velocity_max, axis.joint.current_limit)
                link.send([CanFrame(frame_id(node, SET_LIMITS), limits)])

    def _check_settings(self, link: Link) -> None:
        """Read back each axis's protective settings, if its release is known. Raises DriverError if they are unsafe."""
        for node, axis in self._axes.items():
            firmware, hardware = self.firmware[node], self._hardware[node]
            known = [r for r in self._releases if (r.fw_version, r.hw_version) == (firmware, hardware)]
            told = f"watchdog, velocity limit and ramp are unknown (firmware {firmware}, hardware {hardware}): "
            if not known:
                told += "endpoints lists no flat_endpoints.json of this release"
                self.safety[node] = (False, told)
                continue
            values = {name: self._read(link, node, known[0], name) for name in CHECKED}
            silent = [name for name, value in values.items() if value is None]
            if silent:
                self.safety[node] = (False, f"{told}no answer on {', '.join(silent)}")
                continue
            found = {name: value for name, value in values.items() if value is not None}
            self.safety[node] = check_settings(axis, found, self._options)

    def _read(self, link: Link, node: int, release: Release, name: str) -> float | None:
        """One property by RxSdo; None if no answer arrives."""
        layout = _layout(release, name)
        assert layout is not None  # as checked by load_release
        number, answer = layout
        with _listening(link, (node,), TX_SDO) as received:
            request = struct.pack("<BHBI", 0, number, 0, 0)
            link.send([CanFrame(frame_id(node, RX_SDO), request)])
            until(link, lambda: bool(_answers(received[node], number, answer)), ANSWER_WAIT_S, STEP_S)
            answers = _answers(received[node], number, answer)
        return answers[-1] if answers else None

    def _await_idle(self, link: Link) -> None:
        """Wait for a new heartbeat of every axis that reports idle."""

        def all_idle() -> bool:
            return all(frames and frames[-1].data[4:5] == bytes([IDLE]) for frames in received.values())

        with _listening(link, self._nodes, HEARTBEAT) as received:
            idle = until(link, all_idle, HEARTBEAT_WAIT_S, STEP_S)
        for frames in received.values():
            for frame in frames[-1:]:
                self.codec.receive(frame)
        if not idle:
            words = "; ".join(
                f"{axis.name}: {said if received[axis.node_id] else 'silent'}"
                for axis, said in zip(self.codec.axes, self.codec.status_words(), strict=True)
            )
            raise DriverError(
                "not_idle", f"after {HEARTBEAT_WAIT_S} s not all axes say that they are idle: {words}", retry=True
            )


def _answers(frames: list[CanFrame], number: int, answer: struct.Struct) -> list[float]:
    unpacked = [answer.unpack_from(frame.data) for frame in frames if len(frame.data) >= answer.size]
    return [float(value) for _, endpoint, _, value in unpacked if endpoint == number]


def check_settings(axis: Axis, values: dict[str, float], options: CanOptions) -> tuple[bool, str]:
    """Check an axis's settings; returns whether all are valid, and the settings as text.

    Raises DriverError: ``no_watch``, ``watchdog`` (shorter than the cycle or longer than ``heartbeat_timeout_ms``),
    ``limit`` (below the joint's largest velocity), ``mode`` (not the one that was set).
    """
    data = {"node_id": axis.node_id, "joint": axis.joint.name}
    timeout_s = values[WATCHDOG_S]
    on = bool(values[WATCHDOG]) and timeout_s > 0.0
    if not on and "watch" not in axis.joint.accept_missing:
        raise DriverError(
            "no_watch",
            f"{axis.name}: its watchdog is off ({WATCHDOG} = {bool(values[WATCHDOG])}, {WATCHDOG_S} = {timeout_s:g} "
            "s): if this computer dies, it goes on with the last velocity. Set both over USB and save, or say that a "
            'safety relay cuts its power: accept_missing = ["watch"] of this joint',
            **data,
        )
    least, most = LEAST_CYCLES / options.rate_hz, options.heartbeat_timeout_ms * 1e-3
    if on and not least <= timeout_s <= most * (1.0 + 1e-6):
        raise DriverError(
            "watchdog",
            f"{axis.name}: {WATCHDOG_S} = {timeout_s:g} s; valid: {least:g} s, {LEAST_CYCLES:g} cycles at rate_hz, to "
            f"{most:g} s, heartbeat_timeout_ms. Set it over USB",
            value=timeout_s,
            **data,
        )
    speed, scale = values[SPEED], abs(axis.turns_per_unit)
    if not speed >= axis.velocity_max * (1.0 - 1e-5):
        raise DriverError(
            "limit",
            f"{axis.name}: {SPEED} = {speed:g} turns/s, {speed / scale:.3g} rad/s or m/s at the joint, is below "
            f"max_velocity {axis.joint.max_velocity:g}; lower max_velocity, or set current_limit here: "
            "the driver then sets both",
            value=speed,
            **data,
        )
    modes = int(values[CONTROL_MODE]), int(values[INPUT_MODE])
    if modes != (VELOCITY_CONTROL, PASSTHROUGH):
        raise DriverError(
            "mode",
            f"{axis.name}: control mode and input mode read {modes}, set were "
            f"{(VELOCITY_CONTROL, PASSTHROUGH)} (velocity, passthrough)",
            **data,
        )
    watchdog = f"watchdog {timeout_s:g} s" if on else "no watchdog, as accept_missing acknowledges"
    told = f"{watchdog}; velocity limit {speed:g} turns/s, {speed / scale:.3g} rad/s or m/s at the joint; ramps are "
    told += f"this driver's (its own, {values[RAMP]:g} turns/s², is not used in passthrough)"
    return on, told


def _duplicate(node: int, told: str) -> DriverError:
    return DriverError(
        "duplicate_node",
        f"more than one drive answers as node {node}: {told}; give each its own axis0.config.can.node_id",
        node_id=node,
    )
