"""CiA 402 codec for the cyclic master: SYNC, process data, heartbeats and emergencies of velocity-controlled
drives.

RPDO1: control word (0x6040) and target velocity (0x60FF), type 255, so that a stop needs no SYNC. TPDO1: status word
(0x6041) and position (0x6064); TPDO2, TPDO3: the further feedback; all with every SYNC. COB-IDs of the predefined
connection set (CiA 301).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402_words import (
    ENABLE_STEPS,
    FAULTY,
    INTERNAL_LIMIT_BIT,
    POWER_OFF,
    WARNING_BIT,
    ControlWord,
    DriveState,
    NmtState,
    drive_state,
    error_hint,
    error_words,
    nmt_words,
)
from stereoservo_drivers.canopen.codec import NOT_CYCLIC, AxisFault, Feedback
from stereoservo_drivers.canopen.options import CanJoint, CanOptions
from stereoservo_drivers.canopen.units import JointScale, Unwrapper

SYNC_ID = 0x080
EMCY_ID = 0x080
HEARTBEAT_ID = 0x700
RPDO_IDS = (0x200, 0x300, 0x400, 0x500)
TPDO_IDS = (0x180, 0x280, 0x380, 0x480)

FEEDBACK_OBJECTS: dict[str, tuple[int, str]] = {
    "velocity": (0x606C0020, "i"),
    "effort": (0x60770010, "h"),
    "following_error": (0x60F40020, "i"),
}
"""Feedback -> (mapping entry: index, sub-index, bits; struct format)."""

STATUS_AND_POSITION = (0x60410010, 0x60640020)
COMMAND = (0x60400010, 0x60FF0020)
_COMMAND = struct.Struct("<Hi")
_STATUS_AND_POSITION = struct.Struct("<Hi")
_ENABLE_OPERATION = int(ControlWord.ENABLE_OPERATION)
_PDO_BYTES = 8
_CODES_KEPT = 4
_PERMILLE = 1e-3


def tpdo_feedback(feedback: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Content of TPDO2, TPDO3, …: ``feedback`` in its order, as many as fit into 8 bytes each."""
    pdos: list[tuple[str, ...]] = []
    free = 0
    for what in feedback:
        size = struct.calcsize("<" + FEEDBACK_OBJECTS[what][1])
        if size > free:
            pdos.append(())
            free = _PDO_BYTES
        pdos[-1] = (*pdos[-1], what)
        free -= size
    return tuple(pdos)


def tpdo_mappings(feedback: tuple[str, ...]) -> tuple[tuple[int, ...], ...]:
    """Mapping entries of TPDO1, TPDO2, …"""
    further = (tuple(FEEDBACK_OBJECTS[what][0] for what in pdo) for pdo in tpdo_feedback(feedback))
    return (STATUS_AND_POSITION, *further)


class DriveAxis:
    """State of one drive. ``codes``: its emergencies since the last error reset, newest last.

    ``enabled``, ``faulty``: by ``state``. ``heard_poll``: number of the poll before its last heartbeat.
    ``limit_side``: 1 or -1 where the drive's internal limit is known to lie on that side of the joint, else 0.
    """

    def __init__(self, index: int, joint: CanJoint) -> None:
        self.index = index
        self.joint = joint
        self.node_id = joint.node_id
        self.name = f"node {joint.node_id} ({joint.name})"
        self.command_id = RPDO_IDS[0] + joint.node_id
        self.scale = JointScale.of(joint)
        self.counts = Unwrapper()
        self.effort_unit = joint.direction * _PERMILLE * (joint.rated_torque or 1.0)
        self.status_word: int | None = None
        self.state = DriveState.UNKNOWN
        self.enabled = False
        self.faulty = False
        self.codes: list[int] = []
        self.heard_poll = 0
        self.limit_side = 0
        self.commanded = 0.0

    @property
    def at_limit(self) -> bool:
        """Whether the drive limits the motion by itself (bit 11 of the status word)."""
        return bool((self.status_word or 0) & INTERNAL_LIMIT_BIT)

    def take_status(self, status_word: int) -> None:
        """Store the newest status word."""
        self.status_word = status_word
        self.state = drive_state(status_word)
        self.enabled = self.state is DriveState.OPERATION_ENABLED
        self.faulty = self.state in FAULTY
        if not self.at_limit:
            self.limit_side = 0

    def take_code(self, code: int) -> None:
        """Store an emergency's error code; 0 is the drive's error reset."""
        if code == 0:
            self.codes = []
        elif code not in self.codes:
            self.codes = [*self.codes, code][-_CODES_KEPT:]

    def words(self) -> str:
        """The state as text."""
        if self.status_word is None:
            return "no status word yet"
        said = self.state.value if self.state is not DriveState.UNKNOWN else self._unknown()
        if self.codes:
            said += f" {', '.join(error_words(code) for code in self.codes)}"
        if self.status_word & WARNING_BIT:
            said += "; warning"
        if self.at_limit:
            said += "; internal limit active"
        return said

    def _unknown(self) -> str:
        return f"status word 0x{self.status_word:04X}: {self.state.value}"


class Cia402Codec:
    """Codec of CiA 402 drives.

    Boot-ups, NMT states, heartbeats and emergencies count as faults from ``watch`` to ``ignore``: bring-up itself makes
    drives boot and complain. States that the newest status words show always count.
    """

    def __init__(self, options: CanOptions) -> None:
        self.axes = tuple(DriveAxis(index, joint) for index, joint in enumerate(options.joint))
        count = len(self.axes)
        self.feedback = Feedback(
            positions=np.full(count, np.nan),
            velocities=np.full(count, np.nan),
            efforts=np.full(count, np.nan) if "effort" in options.feedback else None,
            following_errors=np.full(count, np.nan) if "following_error" in options.feedback else None,
        )
        self._ignored = frozenset(options.emcy_ignore)
        self._heartbeat_polls = math.ceil(options.heartbeat_timeout_ms * 1e-3 * options.rate_hz)
        self._heartbeat_timeout_ms = options.heartbeat_timeout_ms
        self._watching = False
        self._commanding = False
        self._polls = 0
        self._events: list[AxisFault] = []
        self._sync = [CanFrame(SYNC_ID)]
        self._heartbeat = [CanFrame(HEARTBEAT_ID + options.master_id, bytes([NmtState.OPERATIONAL]))]
        self._idle = [self._rpdo(axis, ControlWord.DISABLE_VOLTAGE) for axis in self.axes]
        self._quick_stop = [self._rpdo(axis, ControlWord.QUICK_STOP) for axis in self.axes]
        self._at_rest = {
            word: [self._rpdo(axis, word) for axis in self.axes]
            for word in {*ENABLE_STEPS.values(), ControlWord.DISABLE_VOLTAGE}
        }
        self._takers: dict[int, Callable[[bytes], int]] = {}
        bits: list[tuple[int, str]] = []
        for axis in self.axes:
            self._register(axis, tpdo_feedback(options.feedback), bits)
        self.expected = (1 << len(bits)) - 1
        self.bit_axis = tuple(index for index, _ in bits)
        self.bit_name = tuple(name for _, name in bits)

    @staticmethod
    def _rpdo(axis: DriveAxis, word: ControlWord) -> CanFrame:
        return CanFrame(axis.command_id, _COMMAND.pack(word, 0))

    # -- receiving ------------------------------------------------------------------------------------------

    def _register(
        self, axis: DriveAxis, further: tuple[tuple[str, ...], ...], bits: list[tuple[int, str]]
    ) -> None:
        node = axis.node_id
        decoders = [self._status_and_position(axis, len(bits))]
        decoders += [self._further(axis, pdo, k + 2, len(bits) + 1 + k) for k, pdo in enumerate(further)]
        for number, decoder in enumerate(decoders):
            self._takers[TPDO_IDS[number] + node] = decoder
            bits.append((axis.index, f"TPDO{number + 1} of node {node}"))
        self._takers[EMCY_ID + node] = lambda data: self._take_emergency(axis, data)
        self._takers[HEARTBEAT_ID + node] = lambda data: self._take_heartbeat(axis, data)

    def _status_and_position(self, axis: DriveAxis, bit: int) -> Callable[[bytes], int]:
        positions, k = self.feedback.positions, axis.index
        unpack, size = _STATUS_AND_POSITION.unpack, _STATUS_AND_POSITION.size
        position, unwrapped = axis.scale.position, axis.counts.update

        def take(data: bytes) -> int:
            if len(data) != size:
                return self._wrong_length(axis, "TPDO1", len(data), size)
            word, counts = unpack(data)
            if word != axis.status_word:
                self._take_status(axis, word)
            positions[k] = position(unwrapped(counts))
            return bit

        return take

    def _further(
        self, axis: DriveAxis, pdo: tuple[str, ...], number: int, bit: int
    ) -> Callable[[bytes], int]:
        layout = struct.Struct("<" + "".join(FEEDBACK_OBJECTS[what][1] for what in pdo))
        scale, feedback, k = axis.scale, self.feedback, axis.index
        kinds: dict[str, tuple[FloatArray | None, Callable[[int], float]]] = {
            "velocity": (feedback.velocities, scale.velocity),
            "effort": (feedback.efforts, lambda permille: permille * axis.effort_unit),
            "following_error": (feedback.following_errors, scale.difference),
        }
        targets = [(array, convert) for array, convert in (kinds[what] for what in pdo) if array is not None]
        unpack, size = layout.unpack, layout.size

        def take(data: bytes) -> int:
            if len(data) != size:
                return self._wrong_length(axis, f"TPDO{number}", len(data), size)
            for raw, (array, convert) in zip(unpack(data), targets, strict=True):
                array[k] = convert(raw)
            return bit

        return take

    def receive(self, frame: CanFrame) -> int:
        """Decode a frame: returns a TPDO's bit, NOT_CYCLIC for everything else."""
        take = self._takers.get(frame.id)
        if take is None or frame.remote or frame.extended:
            return NOT_CYCLIC
        return take(frame.data)

    def _event(self, axis: DriveAxis, code: str, message: str, value: int, hint: str) -> None:
        self._events.append(AxisFault(axis.index, code, f"node {axis.node_id}: {message}", value, hint))

    def _wrong_length(self, axis: DriveAxis, pdo: str, got: int, mapped: int) -> int:
        self._event(
            axis,
            "mapping",
            f"{pdo} has {got} bytes, {mapped} are mapped",
            got,
            "the drive's PDO mapping was changed, or another node has its id: reset configures it anew",
        )
        return NOT_CYCLIC

    def _take_status(self, axis: DriveAxis, word: int) -> None:
        limited_before = axis.at_limit
        axis.take_status(word)
        if axis.at_limit and not limited_before and axis.state is DriveState.OPERATION_ENABLED:
            axis.limit_side = int(np.sign(axis.commanded))
            self._event(
                axis,
                "limit_switch",
                "internal limit active: a limit switch, or the drive's own position, velocity or current limit",
                word,
                "see the limit switches (0x60FD); reset, enable and move the joint inward",
            )

    def _take_emergency(self, axis: DriveAxis, data: bytes) -> int:
        if len(data) < 2:  # no error code, and not the error reset that zeros would be
            return NOT_CYCLIC
        code = int.from_bytes(data[:2], "little")
        axis.take_code(code)
        if code and code not in self._ignored and self._watching:
            self._event(axis, "emergency", f"emergency {error_words(code)}", code, error_hint(code))
        return NOT_CYCLIC

    def _take_heartbeat(self, axis: DriveAxis, data: bytes) -> int:
        if len(data) != 1:
            return NOT_CYCLIC
        axis.heard_poll = self._polls
        state = data[0] & 0x7F
        if state == NmtState.BOOT_UP and (self._watching or not axis.joint.multi_turn):
            # What it counts from now on goes on from nothing; but bring-up makes drives boot that count on.
            axis.counts.reset()
        if not self._watching or state == NmtState.OPERATIONAL:
            return NOT_CYCLIC
        if state == NmtState.BOOT_UP:
            message = "booted while in use"
            hint = "its supply broke down, it was reset, or another node has its id; reset configures it anew"
            self._event(axis, "rebooted", message, state, hint)
        else:
            self._event(
                axis,
                "left_operational",
                f"left operational, is now {nmt_words(state)}",
                state,
                "another master is on the bus, or the drive reacts to an error (0x1029); reset configures it anew",
            )
        return NOT_CYCLIC

    # -- verdicts -------------------------------------------------------------------------------------------

    def watch(self) -> None:
        """Start monitoring: the drives are configured and operational, and unrequested changes are faults."""
        self._events = []
        for axis in self.axes:
            axis.heard_poll = self._polls
        self._watching = True

    def ignore(self) -> None:
        """Stop monitoring: bring-up begins, or the drives are released."""
        self._watching = False
        self._commanding = False

    def faults(self) -> tuple[AxisFault, ...]:
        """Faults since the last call: drives in fault, switched off unrequested, silent, or commanded against a
        limit.
        """
        events, self._events = self._events, []
        for axis in self.axes:
            if (
                axis.faulty
                or (self._commanding and not (axis.enabled and axis.limit_side == 0))
                or (self._watching and self._polls - axis.heard_poll > self._heartbeat_polls)
            ):
                events += self._levels(axis)
        return tuple(events)

    def _levels(self, axis: DriveAxis) -> list[AxisFault]:
        who, found = f"node {axis.node_id}", []
        if axis.faulty:
            hint = error_hint(axis.codes[-1]) if axis.codes else "remove the cause, then reset"
            found.append(
                AxisFault(axis.index, "drive_fault", f"{who}: {axis.words()}", axis.status_word, hint)
            )
        elif self._commanding and not axis.enabled:
            message = f"{who} left operation enabled unasked: {axis.words()}"
            hint = "look at the drive's enable input, its supply and the emergency stop's circuit"
            found.append(AxisFault(axis.index, "disabled", message, axis.status_word, hint))
        if self._commanding and axis.at_limit and axis.commanded * axis.limit_side > 0.0:
            side = "upper" if axis.limit_side > 0 else "lower"
            message = f"{who}: commanded further into its internal limit at the {side} side"
            found.append(
                AxisFault(axis.index, "limit_switch", message, axis.status_word, "move the joint inward")
            )
        if self._watching and self._polls - axis.heard_poll > self._heartbeat_polls:
            message = f"{who}: no heartbeat for {self._heartbeat_timeout_ms} ms"
            found.append(
                AxisFault(axis.index, "heartbeat_lost", message, None, "check its supply and the bus cable")
            )
        return found

    def enabled(self) -> bool:
        """Whether every axis is in operation enabled."""
        return all(axis.enabled for axis in self.axes)

    def at_rest_unpowered(self) -> bool:
        """Whether every axis is in a state without torque."""
        return all(axis.state in POWER_OFF for axis in self.axes)

    def status_words(self) -> tuple[str, ...]:
        """States with emergencies, e.g. ``fault 0x3210 DC link over-voltage``."""
        return tuple(axis.words() for axis in self.axes)

    # -- sending --------------------------------------------------------------------------------------------

    def poll(self) -> list[CanFrame]:
        """The SYNC frame."""
        self._polls += 1
        return self._sync

    def heartbeat(self) -> list[CanFrame]:
        """The master's heartbeat, operational."""
        return self._heartbeat

    def _stand(self) -> None:
        self._commanding = False
        for axis in self.axes:
            axis.commanded = 0.0

    def idle(self) -> list[CanFrame]:
        """Frames: disable voltage, target zero.

        0x00 and not 0x06 (shutdown): it leads from every state to switch on disabled, from which only the whole
        enable sequence leads to power. No fault is reset by it. A moving axis would coast: stop it first.
        """
        self._stand()
        return self._idle

    def enable(self) -> list[CanFrame]:
        """Frames: for every axis the next transition towards enabled from its newest status word."""
        self._stand()
        return [
            self._at_rest[ENABLE_STEPS.get(axis.state, ControlWord.DISABLE_VOLTAGE)][axis.index]
            for axis in self.axes
        ]

    def command(self, velocities: FloatArray) -> list[CanFrame]:
        """Frames: enable operation (halt bit clear) with target velocities (n,) [rad/s or m/s]."""
        self._commanding = True
        return [
            self._velocity(axis, velocity)
            for axis, velocity in zip(self.axes, velocities.tolist(), strict=True)
        ]

    @staticmethod
    def _velocity(axis: DriveAxis, velocity: float) -> CanFrame:
        axis.commanded = velocity
        units = axis.scale.velocity_units(velocity)
        return CanFrame(axis.command_id, _COMMAND.pack(_ENABLE_OPERATION, units))

    def quick_stop(self) -> list[CanFrame]:
        """Frames: quick stop, target zero, in place of the stored cyclic control word."""
        self._stand()
        return self._quick_stop

    def sendable(self, velocities: FloatArray) -> FloatArray:
        """Velocities rounded to the drives' units, within 32 bits."""
        pairs = zip(self.axes, velocities.tolist(), strict=True)
        return np.array(
            [axis.scale.velocity(axis.scale.velocity_units(velocity)) for axis, velocity in pairs]
        )
