"""What each order does to a rack."""

from __future__ import annotations

import copy
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.drives.disturbances import frame_id
from stereoservo_sim.drives.faults import COB_IDS, Order, help_lines
from stereoservo_sim.emulation.errors import OrderError

if TYPE_CHECKING:
    from stereoservo_sim.drives.rack import Rack

FOREIGN = 10_000
"""Sender of frames that neither the master nor a node of the rack sends."""
GENERIC_ERROR = 0x01
"""Bit 0 of the error register (0x1001)."""
REMAPPING = ((0x1800, 1, None), (0x1A00, 0, 0), (0x1A00, 1, 0x60410010), (0x1A00, 0, 1), (0x1800, 1, None))
"""SDO writes that leave the status word alone in TPDO 1: off (None: the PDO's COB-ID), mapping, on."""


def check(rack: Rack, order: Order) -> None:
    """Raise OrderError where the order speaks of a node that is not there."""
    if order.node:
        rack.slot(order.node)


def obey(rack: Rack, order: Order) -> str:
    """Do it at the rack's present time; the answer. Raises OrderError."""
    check(rack, order)
    return _ACTS[order.verb](rack, order)


def _fault(rack: Rack, order: Order) -> str:
    slot = rack.slot(order.node)
    slot.node.trip(order.number, rack.t_ns)
    rack.look(slot)
    return f"node {order.node}: fault {order.number:#06x}; now {slot.node.state()}"


def _sticky(rack: Rack, order: Order) -> str:
    causes: set[int] | None = getattr(rack.slot(order.node).node, "sticky", None)
    if order.what == "off":
        rack.disturbances.sticky.pop(order.node, None)
        if causes is not None:
            causes.clear()
        return f"node {order.node}: the cause is gone"
    if causes is None:  # a node that knows no causes: the rack trips it again after each reset
        rack.disturbances.sticky[order.node] = order.number
    else:
        causes.add(order.number)
    return f"{_fault(rack, order)}; the cause stays"


def _emcy(rack: Rack, order: Order) -> str:
    data = struct.pack("<HB5x", order.number, GENERIC_ERROR)
    rack.wire.send(rack.slot(order.node).sender, CanFrame(COB_IDS["emcy"] + order.node, data))
    return f"node {order.node}: emergency {order.number:#06x}"


def _silence(rack: Rack, order: Order) -> str:
    rack.disturbances.silent.add(order.node)
    return f"node {order.node}: silent"


def _speak(rack: Rack, order: Order) -> str:
    rack.disturbances.silent.discard(order.node)
    return f"node {order.node}: speaks"


def _reboot(rack: Rack, order: Order) -> str:
    slot = rack.slot(order.node)
    slot.node.power_up(rack.t_ns)
    rack.look(slot)
    return f"node {order.node}: reboots"


def _lose(rack: Rack, order: Order) -> str:
    can_id = frame_id(order.node, order.what)
    rack.disturbances.lose[order.node, can_id] = order.number
    return f"node {order.node}: {order.number} of its frames {can_id:#05x} will be lost"


def _late(rack: Rack, order: Order) -> str:
    rack.disturbances.late_ns[order.node] = order.duration_ns
    return f"node {order.node}: late by {order.duration_ns * 1e-6:g} ms"


def _duplicate(rack: Rack, order: Order) -> str:
    doubles = [slot for slot in rack.slots if slot.plant_index is None and slot.node.node_id == order.node]
    if order.what == "off":
        rack.remove(doubles)
        return f"node {order.node}: {len(doubles)} doubles removed"
    # A copy has the state of its original; one that boots forgets it.
    rack.add(copy.deepcopy(rack.slot(order.node).node), boots=order.what == "boots")
    return f"node {order.node}: a second one {'boots' if order.what == 'boots' else 'runs beside it'}"


def _remap(rack: Rack, order: Order) -> str:
    slot = rack.slot(order.node)
    can_id = COB_IDS["tpdo1"] + order.node
    for k, (index, subindex, value) in enumerate(REMAPPING):
        if value is None:
            value = can_id | (0x80000000 if k == 0 else 0)
        size = 1 if subindex == 0 else 4
        head = 0x23 | (4 - size) << 2  # expedited download with its size
        data = struct.pack("<BHBI", head, index, subindex, value)
        slot.node.receive(CanFrame(0x600 + order.node, data), rack.t_ns)
        answers = rack.look(slot, keep=COB_IDS["sdo"] + order.node)
        if not answers:
            raise OrderError(f"node {order.node} answers no SDO: its protocol has no mapping")
        if answers[0].data[0] != 0x60:
            code = int.from_bytes(answers[0].data[4:], "little")
            raise OrderError(f"node {order.node} refuses {index:#06x}:{subindex} (SDO abort {code:#010x})")
    return f"node {order.node}: TPDO 1 carries the status word alone"


def _cable(rack: Rack, order: Order) -> str:
    out = order.what == "out"
    if order.node == 0:
        rack.disturbances.master_connected = not out
        return f"bus cable {order.what}"
    (rack.disturbances.cut.add if out else rack.disturbances.cut.discard)(order.node)
    return f"node {order.node}: bus cable {order.what}"


def _adapter(rack: Rack, order: Order) -> str:
    rack.on_adapter(order.what == "in")
    return f"adapter {order.what}"


def _drop_sync(rack: Rack, order: Order) -> str:
    rack.disturbances.drop_sync = True
    return "SYNC does not get through"


def _pass_sync(rack: Rack, order: Order) -> str:
    rack.disturbances.drop_sync = False
    return "SYNC gets through"


def _limit(rack: Rack, order: Order) -> str:
    slot = rack.slot(order.node)
    slot.node.axis.limit_switch = order.number
    _wake(rack, order)
    sides = {1: "positive limit switch active", -1: "negative limit switch active", 0: "limit switches free"}
    return f"node {order.node}: {sides[order.number]}"


def _invert(rack: Rack, order: Order) -> str:
    rack.slot(order.node).node.axis.inverted_encoder = order.what == "on"
    _wake(rack, order)
    return f"node {order.node}: encoder {'against' if order.what == 'on' else 'with'} the motion"


def _block(rack: Rack, order: Order) -> str:
    rack.slot(order.node).node.axis.blocked = order.verb == "block"
    return f"node {order.node}: {'blocked' if order.verb == 'block' else 'free'}"


def _wake(rack: Rack, order: Order) -> None:
    """Let the drive see at once what has changed at its inputs."""
    slot = rack.slot(order.node)
    rack.plant.observe(rack.t_ns)
    slot.node.advance(rack.t_ns)
    rack.look(slot)


def _nmt(rack: Rack, order: Order) -> str:
    rack.wire.send(FOREIGN, CanFrame(0x000, bytes((order.number, order.node))))
    return f"foreign NMT command {order.what} to {f'node {order.node}' if order.node else 'all nodes'}"


def _flood(rack: Rack, order: Order) -> str:
    rack.babble[order.node] = rack.t_ns, round(1e9 / order.rate_hz)
    return f"node {order.node}: babbles at {order.rate_hz:g} Hz"


def _calm(rack: Rack, order: Order) -> str:
    rack.babble.pop(order.node, None)
    return f"node {order.node}: calm"


def _status(rack: Rack, order: Order) -> str:
    return "\n".join(rack.status())


def _help(rack: Rack, order: Order) -> str:
    return "\n".join(help_lines())


_ACTS: dict[str, Callable[[Rack, Order], str]] = {
    "fault": _fault, "sticky": _sticky, "emcy": _emcy, "silence": _silence, "speak": _speak, "reboot": _reboot,
    "lose": _lose, "late": _late, "duplicate": _duplicate, "remap": _remap, "cable": _cable, "adapter": _adapter,
    "drop-sync": _drop_sync, "pass-sync": _pass_sync, "limit": _limit, "nmt": _nmt, "flood": _flood, "calm": _calm,
    "invert": _invert, "block": _block, "free": _block, "status": _status, "help": _help,
}  # fmt: skip
