"""Discrete-event emulation of drives on one bus, without I/O: identical in virtual and in real time."""

from __future__ import annotations

import copy
import heapq
import struct
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.load import frame_bits
from stereoservo_sim.emulators.bus.plant import AxisPlant
from stereoservo_sim.emulators.fault_engine import (
    Answer,
    FaultCommand,
    FaultCommandError,
    FaultEngine,
    FaultLanguage,
    Verb,
    Word,
    at_most,
    choice_word,
    time_word,
)
from stereoservo_sim.emulators.nodes.node import NEVER_NS, EmulatedNode

# -- the wire ------------------------------------------------------------------------------------------------
# Discrete-event model of the CAN wire: arbitration, frame times (ISO 11898-1), and injected disturbances.


MASTER = 0
"""Sender number of the master; the nodes of the emulated bus are 1, 2, ... in their order."""
QUEUE_LIMIT = 2000
"""Largest number of frames in a sender's queue; further ones are lost, as from a full transmit buffer."""
SECOND_NS = 1_000_000_000
COB_IDS = {
    "emcy": 0x080, "tpdo1": 0x180, "tpdo2": 0x280, "tpdo3": 0x380, "tpdo4": 0x480, "sdo": 0x580, "heartbeat": 0x700,
}  # fmt: skip
"""Frames of a node by name: base of their id in the predefined connection set (CiA 301, 7.3.5)."""
SYNC_ID = 0x080


def arbitration_key(frame: CanFrame) -> tuple[int, int, int, int, int]:
    """Bits of the arbitration field in the order of transmission, dominant as 0: the smallest wins.

    So a data frame wins against the remote frame of the same id, and a standard frame against an extended one that
    begins alike.
    """
    if frame.extended:
        return frame.id >> 18, 1, 1, frame.id & 0x3FFFF, int(frame.remote)
    return frame.id, int(frame.remote), 0, 0, 0


class Wire:
    """The wire, one frame at a time. Each sender's frames keep their order; between senders, arbitration decides.

    ``bitrate`` [bit/s]; None: frames take no time. A frame occupies its stuffed bits and the intermission and arrives
    at the end of these. Bit errors, and the collision of two frames with one id, are not modelled: both are sent.
    """

    def __init__(self, bitrate: int | None) -> None:
        self.bitrate = bitrate
        self.frames = 0
        self.lost = 0
        self.busy_ns = 0
        self.end_ns = NEVER_NS
        """Time at which the frame on the wire ends."""
        self._queues: dict[int, deque[CanFrame]] = {}
        self._heads: list[tuple[tuple[int, int, int, int, int], int]] = []
        """Every sender's first queued frame, by its arbitration field: a heap."""
        self._sending: tuple[int, CanFrame] | None = None

    def send(self, sender: int, frame: CanFrame) -> None:
        """Queue a frame of ``sender``."""
        queue = self._queues.setdefault(sender, deque())
        if len(queue) >= QUEUE_LIMIT:
            self.lost += 1
            return
        queue.append(frame)
        if len(queue) == 1:
            self._compete(sender, frame)

    def _compete(self, sender: int, frame: CanFrame) -> None:
        heapq.heappush(self._heads, (arbitration_key(frame), sender))

    def waiting(self, sender: int) -> int:
        """Number of queued frames of ``sender``, without the one on the wire."""
        return len(self._queues.get(sender, ()))

    def start(self, t_ns: int) -> None:
        """If the bus is idle at ``t_ns``, start the frame that wins the arbitration."""
        if self._sending is not None or not self._heads:
            return
        sender = heapq.heappop(self._heads)[1]
        queue = self._queues[sender]
        frame = queue.popleft()
        if queue:
            self._compete(sender, queue[0])
        self._sending = sender, frame
        duration = self.duration_ns(frame)
        self.busy_ns += duration
        self.end_ns = t_ns + duration

    def finish(self) -> tuple[int, CanFrame]:
        """End the frame on the wire; returns its sender and the frame."""
        assert self._sending is not None  # otherwise end_ns is NEVER_NS
        ended = self._sending
        self._sending = None
        self.end_ns = NEVER_NS
        self.frames += 1
        return ended

    def duration_ns(self, frame: CanFrame) -> int:
        """Duration of ``frame`` on the bus, intermission included."""
        if self.bitrate is None:
            return 0
        return frame_bits(frame) * SECOND_NS // self.bitrate


class Disturbances:
    """Active disturbances by node number, which determine whether each frame is delayed or lost."""

    def __init__(self) -> None:
        self.master_connected = True
        self.drop_sync = False
        self.cut: set[int] = set()
        self.silent: set[int] = set()
        self.late_ns: dict[int, int] = {}
        self.sticky: dict[int, int] = {}
        self.lose: dict[tuple[int, int], int] = {}
        """Frames still to be lost by node and id."""

    def fate_ns(self, node_id: int, frame: CanFrame) -> int | None:
        """Delay of a frame of ``node_id``; None: it is lost."""
        if node_id in self.silent or node_id in self.cut:
            return None
        left = self.lose.get((node_id, frame.id), 0)
        if left > 0 and not frame.extended:
            self.lose[node_id, frame.id] = left - 1
            return None
        return self.late_ns.get(node_id, 0)

    def master_passes(self, frame: CanFrame) -> bool:
        """Whether a frame of the master gets onto the bus."""
        if not self.master_connected:
            return False
        return not (self.drop_sync and frame.id == SYNC_ID and not frame.extended)

    def words(self, node_id: int) -> str:
        """Disturbances of a node as text."""
        parts = []
        if node_id in self.cut or not self.master_connected:
            parts.append("cable out")
        if node_id in self.silent:
            parts.append("silenced")
        if self.late_ns.get(node_id, 0):
            parts.append(f"late by {self.late_ns[node_id] * 1e-6:g} ms")
        if node_id in self.sticky:
            parts.append(f"fault {self.sticky[node_id]:#x} that stays")
        return f" [{', '.join(parts)}]" if parts else ""


BABBLE = 20_000
"""A babbling node sends its babble as this sender number plus its own."""
BABBLE_FRAME = CanFrame(0x17F, bytes(8))
EVENTS_KEPT = 100_000
STUCK = 10_000
"""Number of events at one instant at which the emulation stops: a node's due time stays past, or two nodes answer
each other endlessly.
"""


class BusEmulatorError(Exception):
    """The emulation cannot continue since a node is defective; the text names the node."""


class BusEvent(msgspec.Struct, frozen=True):
    """An event on the bus at ``t_ns``.

    ``kind``: ``order``, ``ended``, ``state``, ``power_on``, ``power_off``, ``moves``, ``rest``, ``all_rest``.
    ``node``: 0 means all.
    """

    t_ns: int
    kind: str
    node: int
    text: str = ""

    def place(self) -> dict[str, int]:
        """The node as data."""
        return {"node": self.node}

    def where(self) -> str:
        """The node as text."""
        return f"node {self.node}" if self.node else ""


class Slot:
    """A node on the bus with its state in the emulator."""

    def __init__(self, node: EmulatedNode, index: int, plant_index: int | None) -> None:
        self.node = node
        self.index = index
        self.sender = index + 1  # its number on the wire
        self.plant_index = plant_index
        self.due_ns = node.due_ns()
        self.state = node.state()
        self.powered = node.axis.powered
        self.moving = False


class BusEmulator:
    """Emulated nodes, wire and plant in bus time [ns].

    ``plant`` moves the nodes' axes, in their order. ``bitrate`` [bit/s]: of the wire; None: frames take no time.
    Events at the same instant are processed in a fixed order (the wire, delayed frames, nodes in their order, the
    plant), so that the same calls give the same frames. ``on_adapter`` is called when the adapter is unplugged (False)
    or plugged in again (True).
    """

    def __init__(self, nodes: Sequence[EmulatedNode], plant: AxisPlant, *, bitrate: int | None, t_ns: int) -> None:
        self.t_ns = t_ns
        self.start_ns = t_ns
        self.plant = plant
        self.wire = Wire(bitrate)
        self.events: deque[BusEvent] = deque(maxlen=EVENTS_KEPT)
        self._new_events: list[BusEvent] = []
        self.disturbances = Disturbances()
        self.on_adapter: Callable[[bool], None] = lambda plugged: None
        self._delivered: list[tuple[int, CanFrame]] = []
        self._held: list[tuple[int, int, int, CanFrame]] = []
        self.faults = FaultEngine(LANGUAGE, self, t_ns, check=self._check_node, log=self._log_fault)
        self.babble: dict[int, tuple[int, int]] = {}
        self._count = 0
        self.slots: list[Slot] = []
        for index, node in enumerate(nodes):
            node.power_up(t_ns)
            self.slots.append(Slot(node, index, index))
        for slot in self.slots:
            self.collect_output(slot)
        self._start_transmission()

    @property
    def nodes(self) -> tuple[EmulatedNode, ...]:
        """All nodes, duplicates last."""
        return tuple(slot.node for slot in self.slots)

    def inject(self, frame: CanFrame, t_ns: int) -> None:
        """Queue ``frame`` of the master at ``t_ns`` (not before the bus time already reached)."""
        self.run_until(t_ns)
        if not self.disturbances.master_passes(frame):
            return
        self.wire.send(MASTER, frame)
        self._start_transmission()

    def run_until(self, t_ns: int) -> None:
        """Process all events up to ``t_ns``, included. Raises BusEmulatorError."""
        instant, events = -1, 0
        while (due := self.due_ns()) <= t_ns:
            events = events + 1 if due <= instant else 0
            if events > STUCK:
                raise BusEmulatorError(f"no end of events at {due} ns: {self._stuck(due)}")
            instant = due
            self.t_ns = max(self.t_ns, due)
            self._process_next(self.t_ns)
        self.t_ns = max(self.t_ns, t_ns)

    def due_ns(self) -> int:
        """Time of the next event, if the master sends nothing."""
        due = min(self.wire.end_ns, self.plant.due_ns(self.t_ns))
        for slot in self.slots:
            due = min(due, slot.due_ns)
        if self._held:
            due = min(due, self._held[0][0])
        due = min(due, self.faults.due_ns())
        for when, _ in self.babble.values():
            due = min(due, when)
        return due

    def delivered(self) -> list[tuple[int, CanFrame]]:
        """Frames that reached the master since the last call, with their end times."""
        frames, self._delivered = self._delivered, []
        return frames

    def take_events(self) -> list[BusEvent]:
        """Events since the last call."""
        news, self._new_events = self._new_events, []
        return news

    def order(self, text: str, t_ns: int) -> str:
        """Execute the fault command ``text``, at ``t_ns`` or at its own time after the start; returns the reply.

        Raises FaultCommandError.
        """
        command = self.faults.parse(text)
        postponed = self.faults.postpone(command, t_ns)
        if postponed is not None:
            return postponed
        self.run_until(t_ns)
        answer = self.faults.do(command, self.t_ns)
        self._start_transmission()
        return answer

    def _check_node(self, command: BusCommand) -> None:
        if command.node:
            self.slot(command.node)

    def _log_fault(self, t_ns: int, kind: str, command: BusCommand, text: str) -> None:
        self.tell(kind, command.node, text)

    def slot(self, node_id: int) -> Slot:
        """Slot of a node. Raises FaultCommandError, which lists the nodes."""
        for slot in self.slots:
            if slot.node.node_id == node_id:
                return slot
        there = ", ".join(str(slot.node.node_id) for slot in self.slots)
        raise FaultCommandError(f"no node {node_id} on this bus; nodes: {there}")

    def add(self, node: EmulatedNode, *, boots: bool) -> None:
        """Add a node to the bus; its axis is not connected to the plant."""
        if boots:
            node.power_up(self.t_ns)
        slot = Slot(node, self._next_index(), None)
        self.slots.append(slot)
        self.collect_output(slot)

    def _next_index(self) -> int:
        return max(slot.index for slot in self.slots) + 1

    def at_rest(self) -> bool:
        """Whether all axes are at rest."""
        return self.plant.at_rest()

    def power_off(self, t_ns: int) -> None:
        """Switch off the supply of all drives: they stop sending, and brakes and friction stop the arm."""
        self.run_until(t_ns)
        self.disturbances.master_connected = False
        for slot in self.slots:
            slot.node.power_up(t_ns)  # a reboot: the axis loses its power
            self.collect_output(slot)

    def status(self) -> list[str]:
        """Status, one line a node."""
        return [
            f"node {slot.node.node_id} {slot.node.axis.joint.name}: {slot.node.state()}, "
            f"{'powered' if slot.node.axis.powered else 'off'}, at {slot.node.axis.position:.4f}, "
            f"velocity {slot.node.axis.velocity:.4f}{self.disturbances.words(slot.node.node_id)}"
            for slot in self.slots
        ]

    def close(self) -> None:
        """Release the plant."""
        self.plant.close()

    def _process_next(self, t_ns: int) -> None:
        if self.wire.end_ns <= t_ns:
            self._end_of_frame(t_ns)
        elif self._held and self._held[0][0] <= t_ns:
            _, _, sender, frame = heapq.heappop(self._held)
            self.wire.send(sender, frame)
        elif not self.faults.advance(t_ns):
            self._tick(t_ns)
        self._start_transmission()

    def _tick(self, t_ns: int) -> None:
        for slot in self.slots:
            if slot.due_ns <= t_ns:
                self.plant.observe(t_ns)
                slot.node.advance(t_ns)
                self.collect_output(slot)
        for node_id, (when, period) in self.babble.items():
            if when <= t_ns:
                self.babble[node_id] = when + period, period
                if self.wire.waiting(BABBLE + node_id) == 0 and node_id not in self.disturbances.cut:
                    self.wire.send(BABBLE + node_id, BABBLE_FRAME)
        if self.plant.due_ns(t_ns - 1) <= t_ns:
            self.plant.advance(t_ns)
            moved = any(slot.moving for slot in self.slots)
            for slot in self.slots:
                self._watch_motion(slot)
            if moved and self.plant.at_rest():
                self.tell("all_rest", 0)

    def _end_of_frame(self, t_ns: int) -> None:
        sender, frame = self.wire.finish()
        cut = self.disturbances.cut
        if not self.disturbances.master_connected:
            if sender == MASTER:
                return
        elif sender != MASTER:
            self._delivered.append((t_ns, frame))
        hearers = [slot for slot in self.slots if slot.sender != sender and slot.node.accepts(frame)]
        if hearers:
            self.plant.observe(t_ns)
        for slot in hearers:
            node = slot.node
            if node.node_id in cut or sender == BABBLE + node.node_id:
                continue
            node.receive(frame, t_ns)
            self.collect_output(slot)

    def remove(self, slots: list[Slot]) -> None:
        """Remove nodes that ``add`` added."""
        self.slots = [slot for slot in self.slots if slot not in slots]

    def collect_output(self, slot: Slot, keep: int = -1) -> list[CanFrame]:
        """Collect a node's frames to send, its next due time, and its state changes.

        Frames of id ``keep`` are returned instead of sent.
        """
        kept = []
        for frame in slot.node.outgoing():
            if frame.id == keep:
                kept.append(frame)
                continue
            delay = self.disturbances.fate_ns(slot.node.node_id, frame)
            if delay is None:
                continue
            if delay == 0:
                self.wire.send(slot.sender, frame)
            else:
                self._count += 1
                heapq.heappush(self._held, (self.t_ns + delay, self._count, slot.sender, frame))
        slot.due_ns = slot.node.due_ns()
        if slot.node.axis.powered is not slot.powered:
            slot.powered = slot.node.axis.powered
            self.tell("power_on" if slot.powered else "power_off", slot.node.node_id)
        state = slot.node.state()
        if state is not slot.state and state != slot.state:
            slot.state = state
            self.tell("state", slot.node.node_id, state)
            self._trip_again(slot)
        return kept

    def _trip_again(self, slot: Slot) -> None:
        """Trip the drive again, for a persistent cause, as soon as its fault has been reset."""
        code = self.disturbances.sticky.get(slot.node.node_id)
        if code is None or slot.plant_index is None or "fault" in slot.state or "error" in slot.state:
            return
        slot.node.trip(code, self.t_ns)
        self.collect_output(slot)

    def _watch_motion(self, slot: Slot) -> None:
        if slot.plant_index is None:
            return
        moving = not self.plant.at_rest(slot.plant_index)
        if moving is not slot.moving:
            slot.moving = moving
            self.tell("moves" if moving else "rest", slot.node.node_id)

    def _start_transmission(self) -> None:
        self.wire.start(self.t_ns)

    def tell(self, kind: str, node: int, text: str = "") -> None:
        event = BusEvent(self.t_ns, kind, node, text)
        self.events.append(event)
        if len(self._new_events) < EVENTS_KEPT:
            self._new_events.append(event)

    def _stuck(self, due: int) -> str:
        late = [f"node {slot.node.node_id} is due at {slot.due_ns} ns" for slot in self.slots if slot.due_ns <= due]
        return "; ".join(late) or "frames answer frames"


# -- fault commands ------------------------------------------------------------------------------------------
# Fault commands of the emulated bus: the verbs, their arguments, and their effects.


NMT = {"start": 1, "stop": 2, "preop": 128, "reset": 129, "reset-communication": 130}
FLOOD_HZ = 5000.0
FLOOD_HZ_MAX = 20_000.0
FOREIGN = 10_000
"""Sender of frames that neither the master nor an emulated node sends."""
GENERIC_ERROR = 0x01
"""Bit 0 of the error register (0x1001)."""
REMAPPING = ((0x1800, 1, None), (0x1A00, 0, 0), (0x1A00, 1, 0x60410010), (0x1A00, 0, 1), (0x1800, 1, None))
"""SDO writes that map only the status word to TPDO 1: off (None: the PDO's COB-ID), mapping, on."""


class BusCommand(FaultCommand, frozen=True):
    """One fault command. ``node``: 0 is the whole bus. ``number``: depends on the verb: an error code, a count, an NMT
    command.
    """

    node: int = 0
    number: int = 0
    duration_ns: int = 0
    rate_hz: float = 0.0
    what: str = ""


# -- words ------------------------------------------------------------------------------------------------------------


def _node(word: str) -> dict[str, Any]:
    if not word.isdecimal() or not 1 <= int(word) <= 126:
        raise FaultCommandError(f"node {word!r}; a number from 1 to 126 is valid")
    return {"node": int(word)}


def _code(word: str) -> dict[str, Any]:
    try:
        code = int(word, 0)
    except ValueError:
        raise FaultCommandError(f"error code {word!r}; a number such as 0x3210 is valid") from None
    if not 1 <= code <= 0xFFFFFFFF:
        raise FaultCommandError(f"error code {word!r}; 1 to 0xFFFFFFFF is valid")
    return {"number": code}


def _code_or_off(word: str) -> dict[str, Any]:
    return {"what": "off"} if word == "off" else _code(word)


def _count(word: str) -> dict[str, Any]:
    if not word.isdecimal() or not 1 <= int(word) <= 1_000_000:
        raise FaultCommandError(f"count {word!r}; 1 to 1000000 is valid")
    return {"number": int(word)}


def _frame(word: str) -> dict[str, Any]:
    if word.lower().startswith("0x"):
        try:
            return {"what": f"{int(word, 16):#x}"}
        except ValueError:
            raise FaultCommandError(f"id {word!r}; hexadecimal, e.g. 0x182") from None
    if word not in COB_IDS:
        raise FaultCommandError(f"{word!r}; valid: {', '.join(COB_IDS)}")
    return {"what": word}


def _rate(word: str) -> dict[str, Any]:
    try:
        rate = float(word)
    except ValueError:
        rate = -1.0
    if not 1.0 <= rate <= FLOOD_HZ_MAX:
        raise FaultCommandError(f"rate {word!r} Hz; 1 to {FLOOD_HZ_MAX:g} is valid")
    return {"rate_hz": rate}


def _without_node(words: list[str]) -> list[str]:
    return words[1:] if words[:1] == ["node"] else words


def _check_emergency(command: BusCommand) -> None:
    if command.number > 0xFFFF:
        raise FaultCommandError(f"emergency code {command.number:#x}; at most 0xFFFF is valid")


def _cable_words(words: list[str]) -> dict[str, Any]:
    """Parse arguments whose node may be omitted, before the required word."""
    fields = _node(words[0]) if words and words[0] not in IN_OR_OUT else {}
    rest = words[len(fields) :]
    at_most(rest, 1)
    end = choice_word(IN_OR_OUT)
    if not rest:
        raise FaultCommandError(str(end.missing))
    return fields | end.read(rest[0])


def _named(*names: str) -> dict[str, dict[str, Any]]:
    return {name: {"what": name} for name in names}


IN_OR_OUT = _named("in", "out")
NODE = Word(_node, "the node's number is missing")
NODE_OR_ALL = Word(_node)
CODE = Word(_code, "the error code is missing, e.g. 0x3210")
CODE_OR_OFF = Word(_code_or_off, "the error code is missing, e.g. 0x3210")
FRAME = Word(_frame, f"one of {', '.join(COB_IDS)} is missing")
COUNT = Word(_count, default={"number": 1})
RATE = Word(_rate, default={"rate_hz": FLOOD_HZ})
DELAY = time_word("duration_ns", "the delay is missing")
SIDE = choice_word({"+": {"number": 1}, "-": {"number": -1}, "off": {}})
NMT_WORD = choice_word({name: {"what": name, "number": number} for name, number in NMT.items()})


# -- actions ----------------------------------------------------------------------------------------------------------


def _fault(emulator: BusEmulator, command: BusCommand) -> str:
    slot = emulator.slot(command.node)
    slot.node.trip(command.number, emulator.t_ns)
    emulator.collect_output(slot)
    return f"node {command.node}: fault {command.number:#06x}; now {slot.node.state()}"


def _sticky(emulator: BusEmulator, command: BusCommand) -> str:
    causes: set[int] | None = getattr(emulator.slot(command.node).node, "sticky", None)
    if command.what == "off":
        emulator.disturbances.sticky.pop(command.node, None)
        if causes is not None:
            causes.clear()
        return f"node {command.node}: the cause is gone"
    if causes is None:  # a node without persistent causes: the emulator trips it again after each reset
        emulator.disturbances.sticky[command.node] = command.number
    else:
        causes.add(command.number)
    return f"{_fault(emulator, command)}; the cause stays"


def _emcy(emulator: BusEmulator, command: BusCommand) -> str:
    data = struct.pack("<HB5x", command.number, GENERIC_ERROR)
    emulator.wire.send(emulator.slot(command.node).sender, CanFrame(COB_IDS["emcy"] + command.node, data))
    return f"node {command.node}: emergency {command.number:#06x}"


def _silence(emulator: BusEmulator, command: BusCommand) -> Answer:
    emulator.disturbances.silent.add(command.node)
    return f"node {command.node}: silent", lambda: emulator.disturbances.silent.discard(command.node)


def _speak(emulator: BusEmulator, command: BusCommand) -> str:
    emulator.disturbances.silent.discard(command.node)
    return f"node {command.node}: speaks"


def _reboot(emulator: BusEmulator, command: BusCommand) -> str:
    slot = emulator.slot(command.node)
    slot.node.power_up(emulator.t_ns)
    emulator.collect_output(slot)
    return f"node {command.node}: reboots"


def _lose(emulator: BusEmulator, command: BusCommand) -> str:
    can_id = frame_id(command.node, command.what)
    emulator.disturbances.lose[command.node, can_id] = command.number
    return f"node {command.node}: {command.number} of its frames {can_id:#05x} will be lost"


def _late(emulator: BusEmulator, command: BusCommand) -> Answer:
    late_ns = emulator.disturbances.late_ns
    before = late_ns.get(command.node, 0)
    late_ns[command.node] = command.duration_ns

    def undo() -> None:
        late_ns[command.node] = before

    return f"node {command.node}: late by {command.duration_ns * 1e-6:g} ms", undo


def _duplicate(emulator: BusEmulator, command: BusCommand) -> str:
    doubles = [slot for slot in emulator.slots if slot.plant_index is None and slot.node.node_id == command.node]
    if command.what == "off":
        emulator.remove(doubles)
        return f"node {command.node}: {len(doubles)} doubles removed"
    # A copy starts with the state of its original; booting clears it.
    emulator.add(copy.deepcopy(emulator.slot(command.node).node), boots=command.what == "boots")
    return f"node {command.node}: a second one {'boots' if command.what == 'boots' else 'runs beside it'}"


def _remap(emulator: BusEmulator, command: BusCommand) -> str:
    slot = emulator.slot(command.node)
    can_id = COB_IDS["tpdo1"] + command.node
    for k, (index, subindex, value) in enumerate(REMAPPING):
        if value is None:
            value = can_id | (0x80000000 if k == 0 else 0)
        size = 1 if subindex == 0 else 4
        head = 0x23 | (4 - size) << 2  # expedited download with its size
        data = struct.pack("<BHBI", head, index, subindex, value)
        slot.node.receive(CanFrame(0x600 + command.node, data), emulator.t_ns)
        answers = emulator.collect_output(slot, keep=COB_IDS["sdo"] + command.node)
        if not answers:
            raise FaultCommandError(f"node {command.node} answers no SDO: its protocol has no mapping")
        if answers[0].data[0] != 0x60:
            code = int.from_bytes(answers[0].data[4:], "little")
            raise FaultCommandError(f"node {command.node} refuses {index:#06x}:{subindex} (SDO abort {code:#010x})")
    return f"node {command.node}: TPDO 1 carries the status word alone"


def _cable(emulator: BusEmulator, command: BusCommand) -> Answer:
    def connect(there: bool) -> None:
        if command.node == 0:
            emulator.disturbances.master_connected = there
        else:
            (emulator.disturbances.cut.discard if there else emulator.disturbances.cut.add)(command.node)

    connect(command.what == "in")
    where = f"node {command.node}: " if command.node else ""
    return f"{where}bus cable {command.what}", lambda: connect(command.what == "out")


def _adapter(emulator: BusEmulator, command: BusCommand) -> Answer:
    emulator.on_adapter(command.what == "in")
    return f"adapter {command.what}", lambda: emulator.on_adapter(command.what == "out")


def _drop_sync(emulator: BusEmulator, command: BusCommand) -> Answer:
    emulator.disturbances.drop_sync = True

    def undo() -> None:
        emulator.disturbances.drop_sync = False

    return "SYNC does not get through", undo


def _pass_sync(emulator: BusEmulator, command: BusCommand) -> str:
    emulator.disturbances.drop_sync = False
    return "SYNC gets through"


def _limit(emulator: BusEmulator, command: BusCommand) -> str:
    emulator.slot(command.node).node.axis.limit_switch = command.number
    _update_inputs(emulator, command)
    sides = {1: "positive limit switch active", -1: "negative limit switch active", 0: "limit switches free"}
    return f"node {command.node}: {sides[command.number]}"


def _invert(emulator: BusEmulator, command: BusCommand) -> str:
    emulator.slot(command.node).node.axis.inverted_encoder = command.what == "on"
    _update_inputs(emulator, command)
    return f"node {command.node}: encoder {'against' if command.what == 'on' else 'with'} the motion"


def _update_inputs(emulator: BusEmulator, command: BusCommand) -> None:
    """Let the drive read its inputs immediately."""
    slot = emulator.slot(command.node)
    emulator.plant.observe(emulator.t_ns)
    slot.node.advance(emulator.t_ns)
    emulator.collect_output(slot)


def _block(emulator: BusEmulator, command: BusCommand) -> Answer:
    axis = emulator.slot(command.node).node.axis
    axis.blocked = True

    def undo() -> None:
        axis.blocked = False

    return f"node {command.node}: blocked", undo


def _free(emulator: BusEmulator, command: BusCommand) -> str:
    emulator.slot(command.node).node.axis.blocked = False
    return f"node {command.node}: free"


def _nmt(emulator: BusEmulator, command: BusCommand) -> str:
    emulator.wire.send(FOREIGN, CanFrame(0x000, bytes((command.number, command.node))))
    return f"foreign NMT command {command.what} to {f'node {command.node}' if command.node else 'all nodes'}"


def _flood(emulator: BusEmulator, command: BusCommand) -> Answer:
    emulator.babble[command.node] = emulator.t_ns, round(1e9 / command.rate_hz)

    def undo() -> None:
        emulator.babble.pop(command.node, None)

    return f"node {command.node}: babbles at {command.rate_hz:g} Hz", undo


def _calm(emulator: BusEmulator, command: BusCommand) -> str:
    emulator.babble.pop(command.node, None)
    return f"node {command.node}: calm"


def frame_id(node_id: int, what: str) -> int:
    """CAN id of a node's frame: by its name in the predefined connection set, or itself as ``0x…``."""
    return int(what, 16) if what.startswith("0x") else COB_IDS[what] + node_id


LANGUAGE = FaultLanguage(
    BusCommand,
    {
        "fault": Verb(
            "fault [node] N CODE", "drive N trips with an error code, e.g. `fault node 3 0x3210`", _fault,
            (NODE, CODE), prepare=_without_node,
        ),
        "sticky": Verb(
            "sticky N CODE|off", "the same, and the cause stays: it trips again after each reset", _sticky,
            (NODE, CODE_OR_OFF), prepare=_without_node,
        ),
        "emcy": Verb(
            "emcy N CODE", "an emergency frame of node N without a fault", _emcy,
            (NODE, CODE), prepare=_without_node, check=_check_emergency,
        ),
        "silence": Verb("silence N", "node N hears but sends nothing", _silence, (NODE,), lasting=True),
        "speak": Verb("speak N", "ends `silence`", _speak, (NODE,)),
        "reboot": Verb("reboot N", "node N loses its power supply for a moment", _reboot, (NODE,)),
        "lose": Verb(
            "lose N FRAME|0xID [COUNT]", f"its next frames are lost; FRAME: {', '.join(COB_IDS)}", _lose,
            (NODE, FRAME, COUNT),
        ),
        "late": Verb(
            "late N TIME|0", "everything that node N sends comes later by so much, e.g. `late 2 6ms`", _late,
            (NODE, DELAY), lasting=True,
        ),
        "duplicate": Verb(
            "duplicate N [boots|running|off]", "a second drive numbered N: switched on now, or there already",
            _duplicate, (NODE, choice_word(_named("boots", "running", "off"), "boots")),
        ),
        "remap": Verb("remap N", "somebody changes the mapping of node N's TPDO 1", _remap, (NODE,)),
        "cable": Verb(
            "cable [N] out|in", "the bus cable at the master, or at node N", _cable, parse=_cable_words, lasting=True
        ),
        "adapter": Verb(
            "adapter out|in", "the adapter is unplugged: its connection closes", _adapter, (choice_word(IN_OR_OUT),),
            lasting=True,
        ),
        "drop-sync": Verb("drop-sync", "the master's SYNC does not get through", _drop_sync, lasting=True),
        "pass-sync": Verb("pass-sync", "ends `drop-sync`", _pass_sync),
        "limit": Verb("limit N +|-|off", "the limit switch of that side", _limit, (NODE, SIDE)),
        "nmt": Verb(
            "nmt COMMAND [N]", f"an NMT command of a foreign master, to all or to N: {', '.join(NMT)}", _nmt,
            (NMT_WORD, NODE_OR_ALL),
        ),
        "flood": Verb(
            "flood N [HZ]", f"node N babbles ({FLOOD_HZ:g} Hz, id 0x17F)", _flood, (NODE, RATE), lasting=True
        ),
        "calm": Verb("calm N", "ends `flood`", _calm, (NODE,)),
        "invert": Verb(
            "invert N [on|off]", "the encoder of node N counts against the motion", _invert,
            (NODE, choice_word(_named("on", "off"), "on")),
        ),
        "block": Verb("block N", "the joint of node N is in contact: it cannot move", _block, (NODE,), lasting=True),
        "free": Verb("free N", "ends `block`", _free, (NODE,)),
    },
    devices="drives",
    example="silence 4",
)  # fmt: skip
"""The console language of ``emulate drives``."""
