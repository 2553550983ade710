"""CiA 402 codec for the cyclic master: SYNC, process data, heartbeats and emergencies of servo drives.

RPDO1: control word (0x6040) and set-point, a velocity (0x60FF) or a position (0x607A, 0x60C1), type 255, so that a stop
needs no SYNC. TPDO1: status word (0x6041) and position (0x6064); TPDO2, TPDO3: the other feedback; all with every SYNC.
Drives with smaller PDOs spread this over several (`pdo_plan`). COB-IDs of the predefined connection set (CiA 301).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.cia402_words import (
    ENABLE_STEPS,
    FAULTY,
    FOLLOWS_BIT,
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
from stereoservo_drivers.canopen.options import POSITION_MODES, CanJoint, CanOptions, CommandMode
from stereoservo_drivers.canopen.pdo_plan import (
    CONTROL_WORD,
    FEEDBACK_OBJECTS,
    POSITION,
    RPDO_IDS,
    STATUS_WORD,
    TARGETS,
    TPDO_IDS,
    Pdo,
    PdoPlan,
    data_layout,
    planned,
)
from stereoservo_drivers.canopen.units import JointScale, Unwrapper, wrap_int32
from stereoservo_drivers.position_output import PositionOutput

SYNC_ID = 0x080
EMCY_ID = 0x080
HEARTBEAT_ID = 0x700
SDO_REQUEST_ID, SDO_RESPONSE_ID = 0x600, 0x580

INTERPOLATE = 0x0010
"""Control word bit with which a drive in interpolated position mode follows its set-points."""
BIT_S = 0.1
"""Minimum duration [s] of a status bit that reports why a drive does not follow: limits act while it accelerates."""
FOLLOWED_SHARE = 0.5
"""Share of the commanded travel: a joint that moves further while its drive reports a limit is not at that limit."""
LEAST_TRAVEL = 8.0
"""[counts] Least commanded travel that is compared with the joint's travel."""
ENABLING = frozenset(ENABLE_STEPS.values())
_CODES_KEPT = 4
_NOTHING: Mapping[int, bytes] = {}
_PERMILLE = 1e-3


class CommandPdo:
    """An RPDO with control word, set-point, or both; ``held``: its other bytes, which do not change."""

    def __init__(self, pdo: Pdo, node_id: int, target: int, held: bytes) -> None:
        self._id = RPDO_IDS[pdo.number] + node_id
        self._held = held.ljust(pdo.size, b"\0")
        ends = np.cumsum([(entry & 0xFF) // 8 for entry in pdo.mapping]).tolist()
        spans = {entry: slice(end - (entry & 0xFF) // 8, end) for entry, end in zip(pdo.mapping, ends, strict=True)}
        self._word, self._target = spans.get(CONTROL_WORD), spans.get(target)

    def frame(self, word: int, target: int) -> CanFrame:
        """The frame with a control word and a set-point."""
        data = bytearray(self._held)
        if self._word is not None:
            data[self._word] = word.to_bytes(2, "little")
        if self._target is not None:
            data[self._target] = target.to_bytes(4, "little", signed=True)
        return CanFrame(self._id, bytes(data))


class DriveAxis:
    """State of one drive. ``codes``: its emergencies since the last error reset, newest last.

    ``enabled``, ``faulty``: from ``state``. ``heard_poll``: number of the poll before its last heartbeat.
    ``limit_side``: 1 or -1 if the drive's internal limit is known to be on that side of the joint, else 0.
    ``switches``: 0x60FD, if it is sent. ``mode``, ``guarded``, ``commands``: as configured.
    """

    def __init__(self, index: int, joint: CanJoint) -> None:
        self.index = index
        self.joint = joint
        self.node_id = joint.node_id
        self.name = f"node {joint.node_id} ({joint.name})"
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
        self.switches: int | None = None
        self.mode: CommandMode = "csv"
        self.guarded = False
        self.commands: list[CommandPdo] = []
        self._limited_s, self._limited_from, self._asked = 0.0, 0.0, 0.0
        self._followed, self._ignored_s = False, 0.0

    @property
    def at_limit(self) -> bool:
        """Whether the drive limits the motion by itself (bit 11 of the status word)."""
        return bool((self.status_word or 0) & INTERNAL_LIMIT_BIT)

    @property
    def by_position(self) -> bool:
        """Whether its set-points are positions."""
        return self.mode in POSITION_MODES

    @property
    def switch_side(self) -> int:
        """Side of the joint (1, -1) with an active limit switch; 0: none, both, or unknown."""
        switches = self.switches or 0
        return self.joint.direction * ((switches >> 1 & 1) - (switches & 1))

    def frames(self, word: int, target: int) -> list[CanFrame]:
        """Frames with a control word and a set-point."""
        return [pdo.frame(word, target) for pdo in self.commands]

    def held_at_limit(self, position: float, period_s: float) -> bool:
        """Whether the drive has limited its motion long enough, and either a limit switch is possible or the joint
        rests.

        Call it once per cycle while commanding. Limits of current, ramp and velocity are reported by the same bit, also
        for a healthy drive that accelerates. Only limit switches that are sent distinguish them: without these, a joint
        that continues may be beyond its switch, if its drive leaves the braking to its master.
        """
        if not self.enabled or self.commanded * self._asked < 0.0:
            self._limited_s = self._asked = 0.0
            return False
        if not self.at_limit:  # the bit may flicker
            self._limited_s = max(self._limited_s - period_s, 0.0)
            self._asked *= self._limited_s > 0.0
            return False
        if self._limited_s == 0.0:
            self._limited_from = position
        self._limited_s += period_s
        self._asked += self.commanded * period_s
        asked = abs(self._asked)
        if self._limited_s < BIT_S or asked <= LEAST_TRAVEL * self.scale.resolution:
            return False
        moved = (position - self._limited_from) * math.copysign(1.0, self._asked)
        self._limited_s = self._asked = 0.0
        return self.switches is None or moved < FOLLOWED_SHARE * asked

    def ignores_set_points(self, period_s: float) -> bool:
        """Whether the drive, which has followed its set-points since it was enabled, has long reported that it does
        not.

        Call it once per cycle while commanding. In profile velocity mode bit 12 has another meaning.
        """
        follows = bool((self.status_word or 0) & FOLLOWS_BIT)
        if not self.enabled or self.mode == "pv":
            return False
        self._followed |= follows
        self._ignored_s = 0.0 if follows or not self._followed else self._ignored_s + period_s
        return self._ignored_s >= BIT_S

    def take_status_word(self, status_word: int) -> None:
        """Store a status word that was sent."""
        if status_word != self.status_word:
            self.set_status_word(status_word)

    def take_switches(self, switches: int) -> None:
        """Store 0x60FD that was sent."""
        self.switches = switches

    def set_status_word(self, status_word: int) -> None:
        """Store the newest status word."""
        self.status_word = status_word
        self.state = drive_state(status_word)
        self.enabled = self.state is DriveState.OPERATION_ENABLED
        self.faulty = self.state in FAULTY
        if not self.at_limit:
            self.limit_side = 0
        if not self.enabled:  # its previous behaviour does not predict the next time
            self._limited_s = self._asked = self._ignored_s = 0.0
            self._followed = False

    def add_error_code(self, code: int) -> None:
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


def _put(array: FloatArray | None, index: int, value: float) -> None:
    if array is not None:
        array[index] = value


class Cia402Codec:
    """Codec of CiA 402 drives.

    Boot-ups, NMT states, heartbeats and emergencies count as faults from ``watch`` to ``ignore``: bring-up itself
    causes boots and emergencies. The states in the newest status words always count.
    """

    def __init__(self, options: CanOptions) -> None:
        self.axes = tuple(DriveAxis(index, joint) for index, joint in enumerate(options.joint))
        self._ignored = frozenset(options.emcy_ignore)
        self._heartbeat_polls = math.ceil(options.heartbeat_timeout_ms * 1e-3 * options.rate_hz)
        self._heartbeat_timeout_ms = options.heartbeat_timeout_ms
        self._watching = False
        self._commanding = False
        self._polls = 0
        self._events: list[AxisFault] = []
        self._sync = [CanFrame(SYNC_ID)]
        self._heartbeat = [CanFrame(HEARTBEAT_ID + options.master_id, bytes([NmtState.OPERATIONAL]))]
        self._period_s = 1.0 / options.rate_hz
        joints = options.joint
        self._low = np.array([joint.position_min for joint in joints])
        self._high = np.array([joint.position_max for joint in joints])
        self._output = PositionOutput(
            np.array([joint.lead for joint in joints]),
            np.array([joint.largest_load_offset for joint in joints]),
            np.array([joint.max_velocity for joint in joints]),
            self._period_s,
        )
        plan = planned(TARGETS["csv"], options.feedback)
        assert plan is not None  # by PDOs without restrictions
        for axis in self.axes:
            self.configured(axis, "csv", False, plan)
        self.arrange([plan] * len(self.axes))

    def arrange(self, plans: list[PdoPlan]) -> None:
        """Expect what the drives send by ``plans``; efforts and following errors are known if all send them."""
        count = len(self.axes)

        def sent_by_all(what: str) -> bool:
            return all(plan.sends(what) for plan in plans)

        self.feedback = Feedback(
            positions=np.full(count, np.nan),
            velocities=np.full(count, np.nan),
            efforts=np.full(count, np.nan) if sent_by_all("effort") else None,
            following_errors=np.full(count, np.nan) if sent_by_all("following_error") else None,
        )
        self._takers: dict[int, Callable[[bytes], int]] = {}
        bits: list[tuple[int, str]] = []
        for axis, plan in zip(self.axes, plans, strict=True):
            axis.switches = None
            for pdo in plan.reports:
                self._takers[TPDO_IDS[pdo.number] + axis.node_id] = self._report(axis, pdo, len(bits))
                bits.append((axis.index, f"TPDO{pdo.number + 1} of node {axis.node_id}"))
            self._takers[EMCY_ID + axis.node_id] = partial(self._take_emergency, axis)
            self._takers[HEARTBEAT_ID + axis.node_id] = partial(self._take_heartbeat, axis)
        self.expected = (1 << len(bits)) - 1
        self.bit_axis = tuple(index for index, _ in bits)
        self.bit_name = tuple(name for _, name in bits)

    def configured(
        self, axis: DriveAxis, mode: CommandMode, guarded: bool, plan: PdoPlan, held: Mapping[int, bytes] = _NOTHING
    ) -> None:
        """Store how a drive was configured. ``held``: by number of an RPDO, the bytes that do not change."""
        axis.mode = mode
        axis.guarded = guarded
        axis.commands = [
            CommandPdo(pdo, axis.node_id, TARGETS[mode], held.get(pdo.number, b"")) for pdo in plan.commands
        ]
        remote = [CanFrame(HEARTBEAT_ID + a.node_id, remote=True, length=1) for a in self.axes if a.guarded]
        self._heartbeat = [self._heartbeat[0], *remote]

    # -- receiving ------------------------------------------------------------------------------------------

    def _report(self, axis: DriveAxis, pdo: Pdo, bit: int) -> Callable[[bytes], int]:
        """Decoder of a TPDO, which returns its ``bit``."""
        scale, feedback, k = axis.scale, self.feedback, axis.index
        unwrapped, effort_unit = axis.counts.update, axis.effort_unit
        takers: dict[int, Callable[[int], None]] = {
            STATUS_WORD: axis.take_status_word,
            POSITION: lambda counts: _put(feedback.positions, k, scale.position(unwrapped(counts))),
            FEEDBACK_OBJECTS["velocity"]: lambda units: _put(feedback.velocities, k, scale.velocity(units)),
            FEEDBACK_OBJECTS["effort"]: lambda permille: _put(feedback.efforts, k, permille * effort_unit),
            FEEDBACK_OBJECTS["following_error"]: lambda counts: _put(
                feedback.following_errors, k, scale.difference(counts)
            ),
            FEEDBACK_OBJECTS["switches"]: axis.take_switches,
        }
        layout = data_layout(pdo, tuple(takers))
        unpack, size, setters = layout.unpack, layout.size, [takers[e] for e in pdo.mapping if e in takers]

        def take(data: bytes) -> int:
            if len(data) != size:
                return self._wrong_length(axis, f"TPDO{pdo.number + 1}", len(data), size)
            for value, put in zip(unpack(data), setters, strict=True):
                put(value)
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

    def _take_emergency(self, axis: DriveAxis, data: bytes) -> int:
        if len(data) < 2:  # neither an error code nor the error reset that zeros would be
            return NOT_CYCLIC
        code = int.from_bytes(data[:2], "little")
        axis.add_error_code(code)
        if code and code not in self._ignored and self._watching:
            self._event(axis, "emergency", f"emergency {error_words(code)}", code, error_hint(code))
        return NOT_CYCLIC

    def _take_heartbeat(self, axis: DriveAxis, data: bytes) -> int:
        if len(data) != 1:
            return NOT_CYCLIC
        axis.heard_poll = self._polls
        state = data[0] & 0x7F
        if state == NmtState.BOOT_UP and (self._watching or not axis.joint.multi_turn):
            # Its new counts start from zero; but drives that bring-up boots continue to count.
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
        """Stop monitoring: bring-up starts, or the drives are released."""
        self._watching = False
        self._commanding = False

    def faults(self) -> tuple[AxisFault, ...]:
        """Faults since the last call: drives in fault, switched off unrequested, silent, or driven against a limit."""
        if self._commanding:
            for axis in self.axes:
                self._check_following(axis)
        events, self._events = self._events, []
        for axis in self.axes:
            if (
                axis.faulty
                or (self._commanding and not (axis.enabled and axis.limit_side == 0))
                or (self._watching and self._polls - axis.heard_poll > self._heartbeat_polls)
            ):
                events += self._levels(axis)
        return tuple(events)

    def _check_following(self, axis: DriveAxis) -> None:
        """Record an event if a drive limits its joint's motion, or ignores its set-points."""
        position = float(self.feedback.positions[axis.index])
        at_switch = axis.commanded * axis.switch_side > 0.0
        if axis.limit_side == 0 and (axis.held_at_limit(position, self._period_s) or at_switch):
            axis.limit_side = int(np.sign(axis.commanded))
            if at_switch:
                message, what = "limit switch active (0x60FD)", "reset, enable and move the joint inward"
            elif axis.switches is None:
                message = f"internal limit active for {BIT_S * 1e3:.0f} ms: a limit switch, or the drive's own "
                message += "position, velocity or current limit"
                what = 'reset, enable and move the joint inward; "switches" in feedback tells them apart (0x60FD)'
            else:
                message = "internal limit active and the joint stands, with no limit switch active: the drive's own "
                message += "position, velocity or current limit"
                what = "is the joint blocked or overloaded? Compare the drive's limits with the cell file"
            self._event(axis, "limit_switch", message, axis.status_word or 0, what)
        if axis.ignores_set_points(self._period_s):
            self._event(
                axis,
                "target_ignored",
                f"enabled, but ignores its set-points for {BIT_S * 1e3:.0f} ms (bit 12 of the status word)",
                axis.status_word or 0,
                "does an input or another tool hold it (halt, local mode)? See the drive's manual; then reset",
            )

    def _levels(self, axis: DriveAxis) -> list[AxisFault]:
        who, found = f"node {axis.node_id}", []
        if axis.faulty:
            hint = error_hint(axis.codes[-1]) if axis.codes else "remove the cause, then reset"
            found.append(AxisFault(axis.index, "drive_fault", f"{who}: {axis.words()}", axis.status_word, hint))
        elif self._commanding and not axis.enabled:
            message = f"{who} left operation enabled unasked: {axis.words()}"
            hint = "look at the drive's enable input, its supply and the emergency stop's circuit"
            found.append(AxisFault(axis.index, "disabled", message, axis.status_word, hint))
        if self._commanding and axis.at_limit and axis.commanded * axis.limit_side > 0.0:
            side = "upper" if axis.limit_side > 0 else "lower"
            message = f"{who}: commanded further into its internal limit at the {side} side"
            found.append(AxisFault(axis.index, "limit_switch", message, axis.status_word, "move the joint inward"))
        if self._watching and self._polls - axis.heard_poll > self._heartbeat_polls:
            message = f"{who}: no heartbeat for {self._heartbeat_timeout_ms} ms"
            found.append(AxisFault(axis.index, "heartbeat_lost", message, None, "check its supply and the bus cable"))
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

    def _rest_frames(self, words: list[ControlWord]) -> list[CanFrame]:
        """Frames for axes without a commanded motion; enabled ones keep their last position set-point."""
        self._commanding = False
        held = np.array([axis.enabled and word in ENABLING for axis, word in zip(self.axes, words, strict=True)])
        orders = self._output.follow(self.feedback.positions, held)
        frames = []
        for axis, word in zip(self.axes, words, strict=True):
            axis.commanded = 0.0
            if axis.by_position:
                frames += self._position(axis, word, float(orders[axis.index]))
            else:
                frames += axis.frames(word, 0)
        return frames

    def idle(self) -> list[CanFrame]:
        """Frames: disable voltage, target zero.

        0x00 and not 0x06 (shutdown): from every state it leads to switch on disabled, and from there only the whole
        enable sequence leads to power. It resets no fault. A moving axis would coast: stop it first.
        """
        return self._rest_frames([ControlWord.DISABLE_VOLTAGE] * len(self.axes))

    def enable(self) -> list[CanFrame]:
        """Frames: for every axis the next transition towards enabled from its newest status word."""
        return self._rest_frames([ENABLE_STEPS.get(axis.state, ControlWord.DISABLE_VOLTAGE) for axis in self.axes])

    def command(self, velocities: FloatArray) -> list[CanFrame]:
        """Frames: enable operation (halt bit clear) with set-points for velocities (n,) [rad/s or m/s]."""
        self._commanding = True
        positions = self.feedback.positions
        led = any(axis.by_position for axis in self.axes)
        orders = self._output.step(velocities, positions, self._low, self._high) if led else velocities
        frames = []
        for axis, velocity, order in zip(self.axes, velocities.tolist(), orders.tolist(), strict=True):
            axis.commanded = velocity
            if axis.by_position:
                frames += self._position(axis, ControlWord.ENABLE_OPERATION, order, axis.mode == "ip")
            else:
                frames += axis.frames(ControlWord.ENABLE_OPERATION, axis.scale.velocity_units(velocity))
        return frames

    @staticmethod
    def _position(axis: DriveAxis, word: ControlWord, order: float, interpolate: bool = False) -> list[CanFrame]:
        """Frames with a position as set-point; without a known position the drive must not be enabled."""
        if math.isnan(order):
            return axis.frames(min(word, ControlWord.QUICK_STOP), 0)
        return axis.frames(word | INTERPOLATE * interpolate, wrap_int32(axis.scale.counts(order)))

    def quick_stop(self) -> list[CanFrame]:
        """Frames: quick stop, target zero, in place of the stored cyclic control word."""
        return self._rest_frames([ControlWord.QUICK_STOP] * len(self.axes))

    def sendable(self, velocities: FloatArray) -> FloatArray:
        """Velocities rounded to the drives' units, within 32 bits; unchanged for position set-points."""
        pairs = zip(self.axes, velocities.tolist(), strict=True)
        return np.array(
            [
                velocity if axis.by_position else axis.scale.velocity(axis.scale.velocity_units(velocity))
                for axis, velocity in pairs
            ]
        )
