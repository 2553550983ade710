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

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.codec import NOT_CYCLIC, AxisFault, Feedback
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
