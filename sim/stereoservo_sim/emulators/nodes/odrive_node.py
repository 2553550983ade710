"""Emulated ODrive (CANSimple, firmware 0.6); the protocol is implemented independently of the driver."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_sim.emulators.nodes.node import NEVER_NS, EmulatedAxis

MS = 1_000_000

MSG_VERSION, MSG_HEARTBEAT, MSG_ESTOP, MSG_ERROR, MSG_ADDRESS = 0, 1, 2, 3, 6
MSG_AXIS_STATE, MSG_ESTIMATES, MSG_CONTROLLER_MODE, MSG_INPUT_VEL = 7, 9, 11, 13
MSG_LIMITS, MSG_IQ, MSG_REBOOT, MSG_CLEAR_ERRORS, MSG_TORQUES = 15, 20, 22, 24, 28

AXIS_IDLE, AXIS_CLOSED_LOOP = 1, 8
CONTROL_VELOCITY, CONTROL_POSITION = 2, 3
INPUT_PASSTHROUGH, INPUT_VEL_RAMP = 1, 2
SUCCESS, DISARMED, INVALID_REQUEST = 0, 3, 10

POSITION_LIMIT_VIOLATION = 1 << 16
WATCHDOG_TIMER_EXPIRED = 1 << 24
ESTOP_REQUESTED = 1 << 25

STATE_NAMES = {AXIS_IDLE: "idle", AXIS_CLOSED_LOOP: "closed loop control"}


@dataclass(frozen=True)
class OdriveSettings:
    """Settings made over USB, and limits of the hardware. Ramps [turns/s²] of the motor, ``current_limit`` [A].

    ``watchdog_ns``: an armed axis that receives no velocity for this time disarms; 0: never.
    ``torque_acceleration``: the motor torque's limit on the acceleration if the input is not ramped.
    """

    heartbeat_ns: int = 100 * MS
    watchdog_ns: int = 100 * MS
    boot_ns: int = 300 * MS
    vel_ramp_rate: float = 50.0
    torque_acceleration: float = 2000.0
    vel_limit: float = 100.0
    current_limit: float = 20.0
    torque_constant: float = 0.08
    serial_number: int | None = None
    firmware: tuple[int, int, int] = (0, 6, 10)


class OdriveNode:
    """One ODrive axis of the bus. Silent until ``power_up`` and while it boots."""

    def __init__(
        self, node_id: int, axis: EmulatedAxis, joint: CanJoint, *, settings: OdriveSettings | None = None
    ) -> None:
        self.node_id = node_id
        self.axis = axis
        self.settings = settings or OdriveSettings()
        per_unit = joint.gear_ratio if joint.kind == "prismatic" else joint.gear_ratio / (2.0 * math.pi)
        self._turns_per_unit = joint.direction * per_unit
        self._turns = (axis.position + joint.offset_rad) * self._turns_per_unit
        self._read_position = axis.position
        self._motor_torque = (joint.rated_torque or 1.0) / (2.0 * math.pi * self._turns_per_unit)
        self._boot_end_ns = NEVER_NS
        self._queue: list[CanFrame] = []
        self._start_from_configuration()

    def _start_from_configuration(self) -> None:
        self.vel_limit, self.current_limit = self.settings.vel_limit, self.settings.current_limit
        self.control_mode, self.input_mode = CONTROL_POSITION, INPUT_PASSTHROUGH
        self.active_errors = 0
        self.disarm_reason = 0
        self.procedure_result = SUCCESS
        self.input_vel = 0.0
        self._heartbeat_due_ns = NEVER_NS
        self._watchdog_due_ns = NEVER_NS
        self._idle()

    @property
    def booted(self) -> bool:
        """Whether it has booted and takes part in the bus."""
        return self._heartbeat_due_ns != NEVER_NS

    def power_up(self, t_ns: int) -> None:
        """Boot: silent for ``boot_ns``, then heartbeats. Settings made over the bus are lost."""
        self._start_from_configuration()
        self._queue.clear()
        self._boot_end_ns = t_ns + self.settings.boot_ns

    def accepts(self, frame: CanFrame) -> bool:
        """Whether a frame is relevant: every frame, since each updates the encoder."""
        return True

    def receive(self, frame: CanFrame, t_ns: int) -> None:
        """Answer a remote frame, or execute a command."""
        self.advance(t_ns)
        if not self.booted or frame.extended or frame.id >> 5 != self.node_id:
            return
        command = frame.id & 0x1F
        if frame.remote:
            self._answer(command)
        elif command in _COMMANDS:
            take, length = _COMMANDS[command]
            if len(frame.data) >= length:
                take(self, frame.data, t_ns)

    def advance(self, t_ns: int) -> None:
        """Run timers up to ``t_ns``: boot, heartbeats, the watchdog, end stops; the encoder."""
        self._follow_encoder()
        if self._boot_end_ns <= t_ns:
            self._heartbeat_due_ns = self._boot_end_ns
            self._boot_end_ns = NEVER_NS
        if self._watchdog_due_ns <= t_ns:
            self._disarm(WATCHDOG_TIMER_EXPIRED)
        switch = self.axis.limit_switch
        if self.axis.powered and switch and switch * self.axis.target > 0.0:
            self._disarm(POSITION_LIMIT_VIOLATION)
        while self._heartbeat_due_ns <= t_ns:
            self._say(MSG_HEARTBEAT, self._heartbeat())
            self._heartbeat_due_ns += self.settings.heartbeat_ns

    def due_ns(self) -> int:
        """Time of the earliest timer."""
        return min(self._boot_end_ns, self._heartbeat_due_ns, self._watchdog_due_ns)

    def outgoing(self) -> list[CanFrame]:
        """Answers and heartbeats."""
        frames, self._queue = self._queue, []
        return frames

    def trip(self, code: int, t_ns: int) -> None:
        """Set error bits, and disarm."""
        self.advance(t_ns)
        self._disarm(code)

    def state(self) -> str:
        """State and error bits as text."""
        if not self.booted:
            return "off" if self._boot_end_ns == NEVER_NS else "booting"
        name = STATE_NAMES[self.axis_state]
        errors = self.active_errors | self.disarm_reason
        return f"{name}, errors 0x{errors:X}" if errors else name

    def _follow_encoder(self) -> None:
        turn = (self.axis.position - self._read_position) * self._turns_per_unit
        self._turns += -turn if self.axis.inverted_encoder else turn
        self._read_position = self.axis.position

    def _say(self, command: int, data: bytes) -> None:
        self._queue.append(CanFrame(self.node_id << 5 | command, data))

    def _heartbeat(self) -> bytes:
        errors = self.active_errors | self.disarm_reason
        return struct.pack("<IBBBx", errors, self.axis_state, self.procedure_result, 0)

    def _answer(self, command: int) -> None:
        if command == MSG_VERSION:
            self._say(command, struct.pack("<8B", 2, 4, 4, 58, *self.settings.firmware, 0))
        elif command == MSG_HEARTBEAT:
            self._say(command, self._heartbeat())
        elif command == MSG_ERROR:
            self._say(command, struct.pack("<II", self.active_errors, self.disarm_reason))
        elif command == MSG_ADDRESS:
            serial = self.settings.serial_number
            serial = 0x33_6000_0000 + self.node_id if serial is None else serial
            self._say(command, bytes([self.node_id]) + serial.to_bytes(6, "little") + b"\x00")
        elif command == MSG_ESTIMATES:
            velocity = self.axis.velocity * self._turns_per_unit
            velocity = -velocity if self.axis.inverted_encoder else velocity
            self._say(command, struct.pack("<ff", self._turns, velocity))
        elif command in (MSG_TORQUES, MSG_IQ):
            torque = self.axis.effort * self._motor_torque
            scale = 1.0 if command == MSG_TORQUES else 1.0 / self.settings.torque_constant
            self._say(command, struct.pack("<ff", torque * scale, torque * scale))

    def _disarm(self, reason: int) -> None:
        """Power off; the reason remains until it is cleared."""
        self.disarm_reason |= reason
        self.procedure_result = DISARMED
        self._idle()

    def _idle(self) -> None:
        self.axis_state = AXIS_IDLE
        self._watchdog_due_ns = NEVER_NS
        self.axis.powered = False
        self.axis.brake_closed = True
        self.axis.target = 0.0

    def _feed(self, t_ns: int) -> None:
        if self.axis_state == AXIS_CLOSED_LOOP and self.settings.watchdog_ns:
            self._watchdog_due_ns = t_ns + self.settings.watchdog_ns

    def _set_target(self) -> None:
        """Set the target of the velocity loop; position control holds its position, since no command here sets
        positions.
        """
        if self.axis_state != AXIS_CLOSED_LOOP:
            return
        turns_s = self.input_vel if self.control_mode == CONTROL_VELOCITY else 0.0
        turns_s = min(max(turns_s, -self.vel_limit), self.vel_limit)
        ramped = self.input_mode == INPUT_VEL_RAMP
        rate = self.settings.vel_ramp_rate if ramped else self.settings.torque_acceleration
        self.axis.target = turns_s / self._turns_per_unit
        self.axis.acceleration = rate / abs(self._turns_per_unit)

    def _take_state(self, data: bytes, t_ns: int) -> None:
        (requested,) = struct.unpack_from("<I", data)
        if requested == AXIS_IDLE:
            self._idle()
            self.procedure_result = SUCCESS
        elif requested != AXIS_CLOSED_LOOP or self.active_errors or self.disarm_reason:
            self.procedure_result = INVALID_REQUEST
        elif self.axis_state != AXIS_CLOSED_LOOP:
            self.axis_state = AXIS_CLOSED_LOOP
            self.procedure_result = SUCCESS
            self.axis.powered = True
            self.axis.brake_closed = False
            self.input_vel = 0.0
            self._feed(t_ns)
            self._set_target()

    def _take_mode(self, data: bytes, t_ns: int) -> None:
        control, ramp = struct.unpack_from("<II", data)
        if control in (CONTROL_VELOCITY, CONTROL_POSITION) and ramp in (INPUT_PASSTHROUGH, INPUT_VEL_RAMP):
            self.control_mode, self.input_mode = control, ramp
            self._set_target()

    def _take_input_vel(self, data: bytes, t_ns: int) -> None:
        velocity, torque = struct.unpack_from("<ff", data)
        if math.isfinite(velocity) and math.isfinite(torque):
            self.input_vel = velocity
            self._feed(t_ns)
            self._set_target()

    def _take_limits(self, data: bytes, t_ns: int) -> None:
        velocity, current = struct.unpack_from("<ff", data)
        if velocity >= 0.0 and current >= 0.0:
            self.vel_limit, self.current_limit = velocity, current
            self._set_target()

    def _take_clear_errors(self, data: bytes, t_ns: int) -> None:
        self.active_errors = self.disarm_reason = 0
        self.procedure_result = SUCCESS

    def _take_estop(self, data: bytes, t_ns: int) -> None:
        self._disarm(ESTOP_REQUESTED)

    def _take_reboot(self, data: bytes, t_ns: int) -> None:
        self.power_up(t_ns)


_COMMANDS = {
    MSG_ESTOP: (OdriveNode._take_estop, 0),
    MSG_AXIS_STATE: (OdriveNode._take_state, 4),
    MSG_CONTROLLER_MODE: (OdriveNode._take_mode, 8),
    MSG_INPUT_VEL: (OdriveNode._take_input_vel, 8),
    MSG_LIMITS: (OdriveNode._take_limits, 8),
    MSG_REBOOT: (OdriveNode._take_reboot, 0),
    MSG_CLEAR_ERRORS: (OdriveNode._take_clear_errors, 0),
}
"""By command: its handler, and the least number of data bytes."""
