"""What is wrong with the rack's bus: which frames are lost or late, which cables are out."""

from __future__ import annotations

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.drives.faults import COB_IDS

SYNC_ID = 0x080


class Disturbances:
    """Ordered disturbances in force, by node number. Decides what becomes of each frame."""

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
        """By how much a frame that ``node_id`` sends is held back; None: it is lost."""
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
        """What is wrong at a node, for people."""
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


def frame_id(node_id: int, what: str) -> int:
    """Id of a frame of a node: by its name in the predefined connection set, or itself as ``0x…``."""
    return int(what, 16) if what.startswith("0x") else COB_IDS[what] + node_id
