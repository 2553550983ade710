"""Discrete-event model of the CAN wire: arbitration, frame times (ISO 11898-1), and injected disturbances."""

from __future__ import annotations

import heapq
from collections import deque

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.load import frame_bits
from stereoservo_sim.emulators.nodes.node import NEVER_NS

MASTER = 0
"""The sender that is not a node of the emulated bus; nodes are 1, 2, ... in their order."""
QUEUE_LIMIT = 2000
"""Frames that a sender may have waiting; further ones are lost, as from a full transmit buffer."""
SECOND_NS = 1_000_000_000
COB_IDS = {
    "emcy": 0x080, "tpdo1": 0x180, "tpdo2": 0x280, "tpdo3": 0x380, "tpdo4": 0x480, "sdo": 0x580, "heartbeat": 0x700,
}  # fmt: skip
"""Frames of a node by name: the base of their id in the predefined connection set (CiA 301, 7.3.5)."""
SYNC_ID = 0x080


def arbitration_key(frame: CanFrame) -> tuple[int, int, int, int, int]:
    """Bits of the arbitration field in the order of sending, dominant as 0: the smallest wins.

    A data frame so goes before the remote frame of its id, and a standard one before an extended one that begins alike.
    """
    if frame.extended:
        return frame.id >> 18, 1, 1, frame.id & 0x3FFFF, int(frame.remote)
    return frame.id, int(frame.remote), 0, 0, 0


class Wire:
    """The wire, one frame at a time. Each sender's frames keep their order; between senders, arbitration decides.

    ``bitrate`` [bit/s]; None: frames take no time. A frame occupies its stuffed bits and the intermission and arrives
    when those are over. Bit errors, and the collision of two frames with one id, are not modelled: both go out.
    """

    def __init__(self, bitrate: int | None) -> None:
        self.bitrate = bitrate
        self.frames = 0
        self.lost = 0
        self.busy_ns = 0
        self.end_ns = NEVER_NS
        """When the frame on the wire ends."""
        self._queues: dict[int, deque[CanFrame]] = {}
        self._heads: list[tuple[tuple[int, int, int, int, int], int]] = []
        """Every sender's first waiting frame, by its arbitration field: a heap."""
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
        """Frames of ``sender`` that are not on the wire yet."""
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
        assert self._sending is not None  # end_ns is NEVER_NS otherwise
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
        """Disturbances of a node, as text."""
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
