"""Emulated CiA 402 servo drive on CAN: the CANopen device (CiA 301) with its power state machine, without I/O."""

from __future__ import annotations

import struct
from collections import deque
from enum import IntEnum
from functools import partial
from pathlib import Path

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_sim.emulators.nodes.communication import (
    DEADLINE,
    Abort,
    Dictionary,
    ProcessData,
    SdoError,
    SdoServer,
    Value,
)
from stereoservo_sim.emulators.nodes.drive_motion import (
    CYCLIC_VELOCITY,
    FOLLOWING_ERROR,
    PROFILE_POSITION,
    PROFILE_VELOCITY,
    Cia402State,
    DriveMotion,
    PowerMachine,
)
from stereoservo_sim.emulators.nodes.node import NEVER_NS, EmulatedAxis, NodeSettings
from stereoservo_sim.world.velocity_drives import REST_VELOCITY

COMMUNICATION, HEARTBEAT_LOST, SYNC_LOST, PASSIVE = 0x8100, 0x8130, 0x8700, 0x8120


class Nmt(IntEnum):
    """NMT states (CiA 301, 7.3.2), as in heartbeats; below 0: silent."""

    OFF = -2
    RESETTING = -1
    BOOTING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class Cia402Node:
    """Emulated CiA 402 node, see ``node.EmulatedNode``. ``sticky``: error codes of persistent causes, whose reset
    is refused.

    It identifies other nodes by ``frame.id`` alone; two nodes with the same number behave as two such drives do.
    """

    def __init__(
        self, node_id: int, axis: EmulatedAxis, joint: CanJoint, *, eds: Path, settings: NodeSettings | None = None
    ) -> None:
        self.node_id = node_id
        self.axis = axis
        self.settings = settings = settings or NodeSettings()
        self.sticky: set[int] = set()
        self.nmt = Nmt.OFF
        self.faults: list[int] = []
        asked = {1: joint.vendor_id, 2: joint.product_code, 3: joint.revision, 4: joint.serial_number}
        identity = {4: node_id} | {k: v for k, v in asked.items() if v is not None} | settings.identity
        self._t_ns = 0
        self._boot_ns = NEVER_NS
        self._due_ns: int | None = None
        self._words: str | None = None
        self._out: list[CanFrame] = []
        self._reset_refused = False
        self.dictionary = Dictionary(eds, node_id)
        self.machine = PowerMachine(self.dictionary.get, self._clear_faults)
        self.motion = DriveMotion(axis, joint, self.dictionary, self.machine, settings)
        self.emergencies = Emergencies(self.dictionary)
        self._sdo = SdoServer(self.dictionary)
        self._pdo = ProcessData(self.dictionary, self._pdo_error)
        self._consumer = HeartbeatConsumer(self.dictionary)
        self._guard = LifeGuard(self.dictionary)
        self._producer = HeartbeatProducer(self.dictionary)
        self._sync = SyncWatch(self.dictionary, settings.sync_timeout_factor)
        self._objects = DriveObjects(self.dictionary, self.machine, self.motion, identity, settings)

    # -- power and NMT -------------------------------------------------------------------------------------------

    def power_up(self, t_ns: int) -> None:
        """Power on, or reboot: only stored parameters remain; the axis loses its power, too."""
        self._t_ns = t_ns = max(t_ns, self._t_ns)
        self.nmt = Nmt.BOOTING
        self._boot_ns = t_ns + round(self.settings.boot_ms * 1e6)
        self._objects.power_on()
        self._reset_refused = False
        self.faults.clear()
        self.emergencies.power_on()
        self._producer.silence()
        self.machine.power_on()
        self.motion.power_lost(t_ns)
        self._set_up_communication()
        self.advance(t_ns)

    def _set_up_communication(self) -> None:
        self._sdo.reset()
        self._pdo.enter_operational(False)
        self._pdo.reload()
        self._consumer.reset()
        self._guard.reset()
        self._sync.reset()

    def _boot(self) -> None:
        self._boot_ns = NEVER_NS
        self._out.append(CanFrame(id=0x700 + self.node_id, data=b"\0"))
        self.nmt = Nmt.PRE_OPERATIONAL
        self._producer.restart(self._t_ns)
        self.machine.ready()
        for code in sorted(self.sticky):
            self._fault(code)

    def _command(self, command: int) -> None:
        if command == 0x01:
            self._go(Nmt.OPERATIONAL)
        elif command == 0x02:
            if self.nmt is not Nmt.STOPPED:
                self._connection_aborted(COMMUNICATION)
            self._go(Nmt.STOPPED)
        elif command == 0x80:
            if self.nmt is Nmt.OPERATIONAL and self.settings.preoperational_aborts:
                self._connection_aborted(COMMUNICATION)
            self._go(Nmt.PRE_OPERATIONAL)
        elif command == 0x81:
            self._reset_node()
        elif command == 0x82:
            self._reset_communication()

    def _go(self, nmt: Nmt) -> None:
        self._send_emergencies()
        self.nmt = nmt
        self._pdo.enter_operational(nmt is Nmt.OPERATIONAL)
        if nmt is not Nmt.OPERATIONAL:
            self._sync.reset()

    def _reset_node(self) -> None:
        """NMT reset node: the reaction of 0x6007 first (the drive comes to rest, silent), then a reboot."""
        moving = self.machine.powered and abs(self.axis.set_velocity) > REST_VELOCITY
        self._connection_aborted(COMMUNICATION)
        if moving and self.machine.powered and self.machine.ramp is not None:
            self._go(Nmt.RESETTING)
            self._sdo.reset()
            self._consumer.reset()
            self._guard.reset()
        else:
            self.power_up(self._t_ns)

    def _reset_communication(self) -> None:
        self._connection_aborted(COMMUNICATION)
        self._objects.reset_communication()
        self._reset_refused = False
        self._set_up_communication()
        self._boot()

    # -- errors --------------------------------------------------------------------------------------------------

    def trip(self, code: int, t_ns: int, *, sticky: bool = False) -> None:
        """Trip, see ``EmulatedNode``. ``sticky``: the cause stays until it is removed from ``self.sticky``."""
        if self.nmt < Nmt.BOOTING:
            return
        self._t_ns = max(t_ns, self._t_ns)
        if sticky:
            self.sticky.add(code & 0xFFFF)
        self._fault(code & 0xFFFF)
        self._settle()

    def _fault(self, code: int) -> None:
        self.emergencies.occurred(code)
        if code not in self.faults:
            self.faults.append(code)
        if code in (HEARTBEAT_LOST, PASSIVE):
            self._reset_refused = self.settings.reset_needs_communication_reset
        self.dictionary.set(0x603F, 0, code)
        self.machine.fault()

    def _clear_faults(self) -> bool:
        """Reset faults; returns whether every cause is gone, and the errors with them."""
        if self._reset_refused or self.sticky.intersection(self.faults):
            return False
        self.emergencies.gone(self.faults)
        self.faults.clear()
        self.dictionary.set(0x603F, 0, 0)
        return True

    def _warn(self, code: int) -> None:
        if code not in self.emergencies.active:
            self.emergencies.occurred(code)

    def _recovered(self, code: int) -> None:
        if code not in self.faults:
            self.emergencies.gone([code])

    def _pdo_error(self, code: int, there: bool) -> None:
        if there and code == DEADLINE:
            self._fault(code)
        elif there:
            self._warn(code)
        else:
            self._recovered(code)

    def _connection_aborted(self, code: int) -> None:
        """Reaction 0x6007 to a lost connection. An NMT command is a fault only of a powered drive, a lost heartbeat of
        every drive.
        """
        powered = self.machine.powered
        if self.machine.connection_aborted() and (powered or code == HEARTBEAT_LOST):
            self._fault(code)
        elif code == HEARTBEAT_LOST:
            self._warn(code)

    def _heartbeat_lost(self) -> None:
        self._connection_aborted(HEARTBEAT_LOST)
        reaction = self.dictionary.get(0x1029, 1)
        if reaction == 2:
            self._go(Nmt.STOPPED)
        elif reaction == 0 and self.nmt is Nmt.OPERATIONAL:
            self._go(Nmt.PRE_OPERATIONAL)

    # -- the bus -------------------------------------------------------------------------------------------------

    def accepts(self, frame: CanFrame) -> bool:
        """See ``EmulatedNode``."""
        can_id = frame.id
        return (
            self._pdo.listens(frame)
            or can_id in (0, 0x600 + self.node_id)
            or 0x700 < can_id < 0x780
            or can_id == self._sync.can_id
        )

    def receive(self, frame: CanFrame, t_ns: int) -> None:
        """See ``EmulatedNode``. The axis must be up to date at ``t_ns``: SYNC samples it."""
        if self.nmt <= Nmt.BOOTING or frame.extended:
            return
        can_id = frame.id
        if can_id == 0x600 + self.node_id:
            handle = self._receive_sdo
        elif can_id == 0:
            handle = self._receive_nmt
        elif self._pdo.listens(frame):
            handle = self._receive_pdo
        elif 0x700 < can_id < 0x780:
            handle = self._receive_heartbeat
        elif can_id == self._sync.can_id:
            handle = self._receive_sync
        else:
            return
        self._t_ns = t_ns = self._producer.now_ns = max(t_ns, self._t_ns)
        if t_ns >= self.due_ns():
            self.advance(t_ns)
        if self.nmt > Nmt.BOOTING and handle(frame):
            self._settle()

    # Each returns whether ``_settle`` must follow.

    def _receive_sdo(self, frame: CanFrame) -> bool:
        if frame.remote or self.nmt is Nmt.STOPPED:
            return False
        self._answer(self._sdo.request(frame.data, self._t_ns))
        return True

    def _answer(self, data: bytes | None) -> None:
        if data is not None and self.nmt in (Nmt.PRE_OPERATIONAL, Nmt.OPERATIONAL):
            self._out.append(CanFrame(id=0x580 + self.node_id, data=data))

    def _receive_nmt(self, frame: CanFrame) -> bool:
        if frame.remote or len(frame.data) != 2 or frame.data[1] not in (0, self.node_id):
            return False
        self._command(frame.data[0])
        return True

    def _receive_sync(self, frame: CanFrame) -> bool:
        if frame.remote or self.nmt is not Nmt.OPERATIONAL:
            return False
        self._sync.heard(self._t_ns)
        self._due_ns = min(self.due_ns(), self._sync.due_ns())
        takes_effect = self._pdo.waits_for_sync()
        self._out += self._pdo.sync(frame.data[0] if frame.data else None, self._t_ns)
        return takes_effect

    def _receive_heartbeat(self, frame: CanFrame) -> bool:
        if frame.remote and frame.id == 0x700 + self.node_id:
            answer = self._guard.asked(self.nmt, self._t_ns)
            if answer is not None:
                self._out.append(CanFrame(id=frame.id, data=answer))
                self._recovered(HEARTBEAT_LOST)
            return True
        if frame.remote or len(frame.data) != 1 or frame.data[0] == 0:
            return False  # a boot-up frame is not a heartbeat
        if not self._consumer.heard(frame.id - 0x700, self._t_ns):
            return False
        self._recovered(HEARTBEAT_LOST)
        return True

    def _receive_pdo(self, frame: CanFrame) -> bool:
        self._out += self._pdo.receive(frame, self._t_ns)
        return True

    # -- time ----------------------------------------------------------------------------------------------------

    def advance(self, t_ns: int) -> None:
        """See ``EmulatedNode``."""
        self._t_ns = t_ns = self._producer.now_ns = max(t_ns, self._t_ns)
        if self.nmt is Nmt.OFF:
            return
        if self.nmt is Nmt.BOOTING and t_ns >= self._boot_ns:
            self._boot()
        if self.nmt is Nmt.RESETTING and abs(self.axis.set_velocity) <= REST_VELOCITY:
            self.power_up(t_ns)
        self._answer(self._sdo.advance(t_ns))
        for _ in self._consumer.lost(t_ns):
            self._heartbeat_lost()
        if self._guard.lost(t_ns):
            self._heartbeat_lost()
        if self._sync.lost(t_ns):
            self._fault(SYNC_LOST)
        self._pdo.check_deadlines(t_ns)
        if self._producer.tick(t_ns) and self.nmt > Nmt.BOOTING:
            self._out.append(CanFrame(id=0x700 + self.node_id, data=bytes([self.nmt])))
        self._settle()

    def _settle(self) -> None:
        """Update motion, event-driven TPDOs and emergencies to the present."""
        t_ns = self._t_ns
        if self.motion.step(t_ns) and self.machine.state not in (Cia402State.FAULT_REACTION, Cia402State.FAULT):
            self._fault(FOLLOWING_ERROR)
            self.motion.step(t_ns)
        self.motion.warning = bool(self.emergencies.active)
        self._out += self._pdo.events(t_ns)
        self._send_emergencies()
        self._due_ns = self._words = None

    def _send_emergencies(self) -> None:
        if self.nmt in (Nmt.PRE_OPERATIONAL, Nmt.OPERATIONAL):
            self._out += self.emergencies.frames(self._t_ns)

    def due_ns(self) -> int:
        """See ``EmulatedNode``."""
        if self._due_ns is None:
            self._due_ns = self._next_due_ns()
        return self._due_ns

    def _next_due_ns(self) -> int:
        if self.nmt is Nmt.OFF:
            return NEVER_NS
        motion = self.motion.due_ns(self._t_ns)
        if self.nmt <= Nmt.BOOTING:
            return min(self._boot_ns, motion)
        emergencies = NEVER_NS if self.nmt is Nmt.STOPPED else self.emergencies.due_ns()
        return min(
            motion, emergencies, self._sdo.due_ns(), self._pdo.due_ns(), self._consumer.due_ns(),
            self._guard.due_ns(), self._producer.due_ns(), self._sync.due_ns(),
        )  # fmt: skip

    def outgoing(self) -> list[CanFrame]:
        """See ``EmulatedNode``."""
        out, self._out = self._out, []
        return out

    def state(self) -> str:
        """NMT state, power state and errors as text."""
        if self._words is None:
            self._words = self._in_words()
        return self._words

    def _in_words(self) -> str:
        words = [self.nmt.name.lower().replace("_", "-"), str(self.machine.state)]
        words += [f"error 0x{code:04X}" for code in self.emergencies.active]
        return ", ".join(words)


# -- objects -------------------------------------------------------------------------------------------------
# Objects of an emulated CiA 402 drive, bound to its motion: measured values, commands, refusals, stored parameters.


MODES = (PROFILE_POSITION, PROFILE_VELOCITY, CYCLIC_VELOCITY)
SUPPORTED_MODES = sum(1 << mode - 1 for mode in MODES)
SAVE, LOAD = 0x65766173, 0x64616F6C
"""Signatures of 0x1010 and 0x1011: "save", "load"."""
OPTION_CODES = {
    0x6007: range(4),
    0x605A: range(9),
    0x605B: range(2),
    0x605C: range(2),
    0x605D: range(1, 5),
    0x605E: range(5),
}
"""Option codes supported by this drive, and their values."""


class DriveObjects:
    """Binds a dictionary to the drive; keeps what 0x1010 has saved."""

    def __init__(
        self,
        dictionary: Dictionary,
        machine: PowerMachine,
        motion: DriveMotion,
        identity: dict[int, int],
        settings: NodeSettings,
    ) -> None:
        self._dictionary = dictionary
        self._identity = identity
        self._settings = settings
        self._stored: dict[tuple[int, int], Value] = {}
        for index, value in (
            (0x6041, motion.status),
            (0x6064, motion.position),
            (0x606B, motion.velocity_demand),
            (0x606C, motion.velocity),
            (0x6077, motion.torque),
            (0x6078, motion.torque),
            (0x60F4, motion.following_error),
            (0x60FD, motion.digital_inputs),
        ):
            dictionary.live(index, 0, value)
        dictionary.changed(0x6040, lambda sub, value: (machine.control(value), motion.take_set_point()))
        dictionary.guard(0x6060, self._check_mode)
        dictionary.changed(0x6060, lambda sub, value: dictionary.set(0x6061, 0, value))
        for index in OPTION_CODES:
            dictionary.guard(index, partial(self._check_option, index))
        dictionary.guard(0x1005, self._check_sync)
        dictionary.guard(0x1010, lambda sub, value: self._check_signature(sub, value, SAVE))
        dictionary.changed(0x1010, lambda sub, value: self._save())
        dictionary.guard(0x1011, lambda sub, value: self._check_signature(sub, value, LOAD))
        dictionary.changed(0x1011, lambda sub, value: self._forget())

    @staticmethod
    def _check_mode(sub: int, value: int) -> None:
        if value not in (0, *MODES):
            raise SdoError(Abort.INVALID_VALUE)

    @staticmethod
    def _check_option(index: int, sub: int, value: int) -> None:
        if value not in OPTION_CODES[index]:
            raise SdoError(Abort.INVALID_VALUE)

    @staticmethod
    def _check_sync(sub: int, value: int) -> None:
        if value >> 11:
            raise SdoError(Abort.INVALID_VALUE)  # it produces no SYNC, and supports 11-bit ids only

    @staticmethod
    def _check_signature(sub: int, value: int, signature: int) -> None:
        if not sub or value != signature:
            raise SdoError(Abort.NOT_STORABLE)

    def _save(self) -> None:
        self._dictionary.set(0x1010, 1, 1)
        self._stored = self._dictionary.storable()

    def _forget(self) -> None:
        self._dictionary.set(0x1011, 1, 1)
        self._stored = {}

    def power_on(self) -> None:
        """Set all objects to their values at power on."""
        self._dictionary.restore(0x0000, 0xFFFF, self._stored)
        self._dictionary.set(0x6502, 0, SUPPORTED_MODES)
        self._dictionary.set(0x6061, 0, self._dictionary.get(0x6060))
        self._fix()

    def reset_communication(self) -> None:
        """Set the communication profile's objects to their values at power on; errors and their history stay."""
        keys = [key for key in self._dictionary.entries if key[0] in (0x1001, 0x1003)]
        errors = {key: self._dictionary.get(*key) for key in keys}
        self._dictionary.restore(0x1000, 0x1FFF, self._stored)
        for key, value in errors.items():
            self._dictionary.set(*key, value)
        self._fix()

    def _fix(self) -> None:
        for sub, value in self._identity.items():
            self._dictionary.set(0x1018, sub, value)
        if not self._settings.pdos_by_default:
            for index in (*range(0x1400, 0x1404), *range(0x1800, 0x1804)):
                self._dictionary.set(index, 1, self._dictionary.get(index, 1) | 1 << 31)


# -- emergencies ---------------------------------------------------------------------------------------------
# Emergency producer of an emulated node: active errors, error register, history (CiA 301, 7.2.7).


REGISTER, HISTORY, COB_ID, INHIBIT = 0x1001, 0x1003, 0x1014, 0x1015
_QUEUED = 32


def register_bits(code: int) -> int:
    """Error register (0x1001) of an error code: generic, and the class given by the code's first digits."""
    top = code >> 12
    bits = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0xF: 0x80}.get(top, 0)
    if top == 0x8:
        bits = 0x10 if code >> 8 in (0x80, 0x81, 0x82) else 0x20
    return 0x01 | bits


class Emergencies:
    """Errors of one node. ``active``: codes whose cause is present or that a fault reset has not cleared."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self.active: list[int] = []
        self._queue: deque[bytes] = deque(maxlen=_QUEUED)
        self._free_ns = 0
        self._depth = max((sub for index, sub in dictionary.entries if index == HISTORY), default=0)
        dictionary.guard(HISTORY, self._check_clearing)
        dictionary.changed(HISTORY, lambda sub, value: self._forget())
        dictionary.reading(HISTORY, self._check_reading)

    def power_on(self) -> None:
        """Clear all errors."""
        self.active.clear()
        self._queue.clear()
        self._free_ns = 0

    def _check_clearing(self, sub: int, value: int) -> None:
        if value:
            raise SdoError(Abort.INVALID_VALUE)

    def _check_reading(self, sub: int) -> None:
        if sub > self._dictionary.get(HISTORY, 0):
            raise SdoError(Abort.NO_DATA)

    def _forget(self) -> None:
        for sub in range(1, self._depth + 1):
            self._dictionary.set(HISTORY, sub, 0)

    def occurred(self, code: int) -> None:
        """Add an error: register, history, and a frame."""
        if code not in self.active:
            self.active.append(code)
        count = self._dictionary.get(HISTORY, 0)
        for sub in range(min(count + 1, self._depth), 1, -1):
            self._dictionary.set(HISTORY, sub, self._dictionary.get(HISTORY, sub - 1))
        self._dictionary.set(HISTORY, 1, code)
        self._dictionary.set(HISTORY, 0, min(count + 1, self._depth))
        self._tell(code)

    def gone(self, codes: list[int]) -> None:
        """Remove errors: one frame with code 0 and the remaining register."""
        left = [code for code in self.active if code not in codes]
        if len(left) != len(self.active):
            self.active[:] = left
            self._tell(0)

    def _tell(self, code: int) -> None:
        register = 0
        for active in self.active:
            register |= register_bits(active)
        self._dictionary.set(REGISTER, 0, register)
        self._queue.append(struct.pack("<HB5x", code & 0xFFFF, register))

    def frames(self, t_ns: int) -> list[CanFrame]:
        """Frames to send now; the inhibit time (0x1015) delays the others."""
        cob_id = self._dictionary.get(COB_ID, 0, 1 << 31)
        if cob_id & 1 << 31:
            self._queue.clear()
            return []
        inhibit_ns = self._dictionary.get(INHIBIT) * 100_000
        frames = []
        while self._queue and t_ns >= self._free_ns:
            frames.append(CanFrame(id=cob_id & 0x7FF, data=self._queue.popleft()))
            self._free_ns = t_ns + inhibit_ns
        return frames

    def due_ns(self) -> int:
        """Time at which a delayed frame may be sent."""
        return self._free_ns if self._queue else NEVER_NS


# -- supervision ---------------------------------------------------------------------------------------------
# Monitoring by an emulated node: heartbeats of others and the SYNC period; its own heartbeat (CiA 301).


CONSUMER, PRODUCER, SYNC_ID, SYNC_PERIOD = 0x1016, 0x1017, 0x1005, 0x1006
GUARD_TIME, LIFE_FACTOR = 0x100C, 0x100D
TOGGLE = 0x80


class HeartbeatConsumer:
    """Monitors the nodes of 0x1016, each from its first heartbeat on, also after a loss (7.2.8.2.2)."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._subs = [sub for index, sub in dictionary.entries if index == CONSUMER and sub]
        self._deadlines: dict[int, int] = {}
        dictionary.guard(CONSUMER, self._check)
        dictionary.changed(CONSUMER, lambda sub, value: self.reset())

    def _check(self, sub: int, value: int) -> None:
        node, time = value >> 16, value & 0xFFFF
        if node > 0x7F:
            raise SdoError(Abort.INVALID_VALUE)
        if node and time and any(s != sub and self._entry(s)[0] == node for s in self._subs):
            raise SdoError(Abort.INCOMPATIBLE)

    def _entry(self, sub: int) -> tuple[int, int]:
        value = self._dictionary.get(CONSUMER, sub)
        node, time = value >> 16, value & 0xFFFF
        return (node, time) if node and time else (0, 0)

    def reset(self) -> None:
        """Wait for first heartbeats again."""
        self._deadlines.clear()

    def heard(self, node: int, t_ns: int) -> bool:
        """Process a heartbeat; returns whether its node is monitored."""
        for sub in self._subs:
            watched, time = self._entry(sub)
            if watched == node:
                self._deadlines[node] = t_ns + time * 1_000_000
                return True
        return False

    def lost(self, t_ns: int) -> list[int]:
        """Nodes whose heartbeat is overdue, each reported once."""
        nodes = [node for node, deadline in self._deadlines.items() if t_ns >= deadline]
        for node in nodes:
            del self._deadlines[node]
        return nodes

    def due_ns(self) -> int:
        """Time at which the next heartbeat is overdue."""
        return min(self._deadlines.values(), default=NEVER_NS)


class Deadline:
    """Time at which a message that is waited for is overdue; `NEVER_NS` while none is."""

    _deadline_ns = NEVER_NS

    def lost(self, t_ns: int) -> bool:
        """Whether the message is overdue; reported once."""
        if t_ns < self._deadline_ns:
            return False
        self._deadline_ns = NEVER_NS
        return True

    def due_ns(self) -> int:
        """Time at which the message is overdue."""
        return self._deadline_ns


class LifeGuard(Deadline):
    """Node guarding (CiA 301, 7.2.8.2.1): answers remote frames, and monitors that they arrive within 0x100C times
    0x100D, from the first one on. Inactive in a node that produces heartbeats.
    """

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._toggle = 0
        for index in (GUARD_TIME, LIFE_FACTOR):
            dictionary.changed(index, lambda sub, value: self.reset())

    def reset(self) -> None:
        """Wait for a first remote frame again."""
        self._toggle = 0
        self._deadline_ns = NEVER_NS

    def asked(self, state: int, t_ns: int) -> bytes | None:
        """Reply to a remote frame: the NMT state with a toggling bit; None if heartbeats are produced."""
        if self._dictionary.get(PRODUCER):
            return None
        life_ms = self._dictionary.get(GUARD_TIME) * self._dictionary.get(LIFE_FACTOR)
        self._deadline_ns = t_ns + life_ms * 1_000_000 if life_ms else NEVER_NS
        answer = bytes([state | self._toggle])
        self._toggle ^= TOGGLE
        return answer


class HeartbeatProducer:
    """Produces heartbeats with the period 0x1017 [ms]; 0: none."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._next_ns = NEVER_NS
        self.now_ns = 0
        dictionary.changed(PRODUCER, lambda sub, value: self.restart(self.now_ns))

    def restart(self, t_ns: int) -> None:
        """Restart; the first heartbeat is due after one period."""
        period = self._dictionary.get(PRODUCER)
        self._next_ns = t_ns + period * 1_000_000 if period else NEVER_NS

    def silence(self) -> None:
        """Stop until ``restart``."""
        self._next_ns = NEVER_NS

    def tick(self, t_ns: int) -> bool:
        """Whether a heartbeat is to be sent now; missed ones are not sent later."""
        if t_ns < self._next_ns:
            return False
        period_ns = self._dictionary.get(PRODUCER) * 1_000_000
        self._next_ns += (1 + (t_ns - self._next_ns) // period_ns) * period_ns
        return True

    def due_ns(self) -> int:
        """Time of the next heartbeat."""
        return self._next_ns


class SyncWatch(Deadline):
    """Monitors SYNC with the period 0x1006 [us]: a loss is reported once after ``factor`` periods, from the first
    SYNC on.

    ``can_id``: of SYNC, from 0x1005.
    """

    def __init__(self, dictionary: Dictionary, factor: float) -> None:
        self._dictionary = dictionary
        self._factor = factor
        self.reset()
        dictionary.changed(SYNC_PERIOD, lambda sub, value: self.reset())
        dictionary.changed(SYNC_ID, lambda sub, value: self._listen())

    def _listen(self) -> None:
        self.can_id = self._dictionary.get(SYNC_ID, 0, 0x80) & 0x7FF

    def reset(self) -> None:
        """Wait for a first SYNC again."""
        self._listen()
        self._deadline_ns = NEVER_NS

    def heard(self, t_ns: int) -> None:
        """Process a SYNC."""
        period_ns = self._dictionary.get(SYNC_PERIOD) * 1000
        self._deadline_ns = t_ns + round(self._factor * period_ns) if period_ns else NEVER_NS
