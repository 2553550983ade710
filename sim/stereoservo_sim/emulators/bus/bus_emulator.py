"""Discrete-event emulation of drives on one bus, without I/O: identical in virtual and in real time."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Sequence

import msgspec

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.emulators.bus.can_wire import MASTER, Disturbances, Wire
from stereoservo_sim.emulators.bus.fault_commands import LANGUAGE, BusCommand
from stereoservo_sim.emulators.bus.plant import AxisPlant
from stereoservo_sim.emulators.fault_engine import FaultCommandError, FaultEngine
from stereoservo_sim.emulators.nodes.node import EmulatedNode

BABBLE = 20_000
"""Sender of a babbling node's babble is this plus its number."""
BABBLE_FRAME = CanFrame(0x17F, bytes(8))
EVENTS_KEPT = 100_000
STUCK = 10_000
"""Events at one instant without end: a node that asks for time that is past, or two that answer each other."""


class BusEmulatorError(Exception):
    """The emulation cannot continue: a node is defective, which the text names."""


class BusEvent(msgspec.Struct, frozen=True):
    """Something that happened on the bus at ``t_ns``.

    ``kind``: ``order``, ``ended``, ``state``, ``power_on``, ``power_off``, ``moves``, ``rest``, ``all_rest``.
    ``node``: 0 is all.
    """

    t_ns: int
    kind: str
    node: int
    text: str = ""

    def place(self) -> dict[str, int]:
        """The node, as data."""
        return {"node": self.node}

    def where(self) -> str:
        """The node, as text."""
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

    ``plant`` moves the nodes' axes, in their order. ``bitrate`` [bit/s]: frames take their time; None: none.
    What happens at one instant happens in a fixed order (the wire, held-back frames, nodes by their place, the plant),
    so that the same calls give the same frames. ``on_adapter`` is told when the adapter is unplugged (False) or back.
    """

    def __init__(
        self,
        nodes: Sequence[EmulatedNode],
        plant: AxisPlant,
        *,
        bitrate: int | None,
        t_ns: int,
    ) -> None:
        self.t_ns = t_ns
        self.start_ns = t_ns
        self.plant = plant
        self.wire = Wire(bitrate)
        self.events: deque[BusEvent] = deque(maxlen=EVENTS_KEPT)
        self._news: list[BusEvent] = []
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
            self.look(slot)
        self._launch()

    @property
    def nodes(self) -> tuple[EmulatedNode, ...]:
        """All nodes, duplicates last."""
        return tuple(slot.node for slot in self.slots)

    def inject(self, frame: CanFrame, t_ns: int) -> None:
        """Queue ``frame`` of the master at ``t_ns`` (not before the time already run)."""
        self.run_until(t_ns)
        if not self.disturbances.master_passes(frame):
            return
        self.wire.send(MASTER, frame)
        self._launch()

    def run_until(self, t_ns: int) -> None:
        """Process all events up to ``t_ns``, included. Raises BusEmulatorError."""
        instant, events = -1, 0
        while (due := self.due_ns()) <= t_ns:
            events = events + 1 if due <= instant else 0
            if events > STUCK:
                raise BusEmulatorError(f"no end of events at {due} ns: {self._stuck(due)}")
            instant = due
            self.t_ns = max(self.t_ns, due)
            self._happen(self.t_ns)
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
        """Frames that reached the master since the last call, with the times of their ends."""
        frames, self._delivered = self._delivered, []
        return frames

    def take_news(self) -> list[BusEvent]:
        """Events since the last call."""
        news, self._news = self._news, []
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
        self._launch()
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
        """Add a node to the bus, whose axis moves nothing."""
        if boots:
            node.power_up(self.t_ns)
        slot = Slot(node, self._next_index(), None)
        self.slots.append(slot)
        self.look(slot)

    def _next_index(self) -> int:
        return max(slot.index for slot in self.slots) + 1

    def at_rest(self) -> bool:
        """Whether all axes are at rest."""
        return self.plant.at_rest()

    def power_off(self, t_ns: int) -> None:
        """Switch off the supply of all drives: they are silent, and brakes and friction stop the arm."""
        self.run_until(t_ns)
        self.disturbances.master_connected = False
        for slot in self.slots:
            slot.node.power_up(t_ns)  # a reboot: the axis loses its power
            self.look(slot)

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

    def _happen(self, t_ns: int) -> None:
        if self.wire.end_ns <= t_ns:
            self._end_of_frame(t_ns)
        elif self._held and self._held[0][0] <= t_ns:
            _, _, sender, frame = heapq.heappop(self._held)
            self.wire.send(sender, frame)
        elif not self.faults.advance(t_ns):
            self._tick(t_ns)
        self._launch()

    def _tick(self, t_ns: int) -> None:
        for slot in self.slots:
            if slot.due_ns <= t_ns:
                self.plant.observe(t_ns)
                slot.node.advance(t_ns)
                self.look(slot)
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
        hearers = [slot for slot in self.slots if slot.sender != sender and slot.node.hears(frame)]
        if hearers:
            self.plant.observe(t_ns)
        for slot in hearers:
            node = slot.node
            if node.node_id in cut or sender == BABBLE + node.node_id:
                continue
            node.receive(frame, t_ns)
            self.look(slot)

    def remove(self, slots: list[Slot]) -> None:
        """Remove nodes that ``add`` added."""
        self.slots = [slot for slot in self.slots if slot not in slots]

    def look(self, slot: Slot, keep: int = -1) -> list[CanFrame]:
        """Collect a node's frames to send, its next due time, and its state changes.

        Frames of id ``keep`` are given back instead of sent.
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
            self._stick(slot)
        return kept

    def _stick(self, slot: Slot) -> None:
        """Trip the drive again, for a persistent cause, as soon as its fault has been reset."""
        code = self.disturbances.sticky.get(slot.node.node_id)
        if code is None or slot.plant_index is None or "fault" in slot.state or "error" in slot.state:
            return
        slot.node.trip(code, self.t_ns)
        self.look(slot)

    def _watch_motion(self, slot: Slot) -> None:
        if slot.plant_index is None:
            return
        moving = not self.plant.at_rest(slot.plant_index)
        if moving is not slot.moving:
            slot.moving = moving
            self.tell("moves" if moving else "rest", slot.node.node_id)

    def _launch(self) -> None:
        self.wire.start(self.t_ns)

    def tell(self, kind: str, node: int, text: str = "") -> None:
        event = BusEvent(self.t_ns, kind, node, text)
        self.events.append(event)
        if len(self._news) < EVENTS_KEPT:
            self._news.append(event)

    def _stuck(self, due: int) -> str:
        late = [
            f"node {slot.node.node_id} is due at {slot.due_ns} ns"
            for slot in self.slots
            if slot.due_ns <= due
        ]
        return "; ".join(late) or "frames answer frames"
