"""Emulated CiA 402 servo drive on CAN: the CANopen device (CiA 301) with its power state machine, without I/O."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.options import CanJoint
from stereoservo_sim.emulators.nodes.dictionary import Dictionary
from stereoservo_sim.emulators.nodes.drive_motion import FOLLOWING_ERROR, DriveMotion
from stereoservo_sim.emulators.nodes.drive_objects import DriveObjects
from stereoservo_sim.emulators.nodes.emergency import Emergencies
from stereoservo_sim.emulators.nodes.node import NEVER_NS, EmulatedAxis, NodeSettings
from stereoservo_sim.emulators.nodes.pdo import DEADLINE, ProcessData
from stereoservo_sim.emulators.nodes.sdo_server import SdoServer
from stereoservo_sim.emulators.nodes.state_machine import Cia402State, PowerMachine
from stereoservo_sim.emulators.nodes.supervision import (
    HeartbeatConsumer,
    HeartbeatProducer,
    LifeGuard,
    SyncWatch,
)
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

    ``frame.id`` is all that it knows of other nodes; two of it with one number behave as two such drives do.
    """

    def __init__(
        self,
        node_id: int,
        axis: EmulatedAxis,
        joint: CanJoint,
        *,
        eds: Path,
        settings: NodeSettings | None = None,
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
        """Power on, or reboot: everything but stored parameters is lost, the axis's power too."""
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
        """Reaction 0x6007 to a lost connection. An NMT command is a fault only of a powered drive; a lost heartbeat
        of every one.
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

    def hears(self, frame: CanFrame) -> bool:
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

    # Each gives whether what it did is to be followed by ``_settle``.

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
            return False  # a boot-up frame is no heartbeat
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
        if self.motion.step(t_ns) and self.machine.state not in (
            Cia402State.FAULT_REACTION,
            Cia402State.FAULT,
        ):
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
