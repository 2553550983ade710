"""Table of the CAN arm's fault cases: fault command, detecting side, time bound, fault code."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

Host = Literal["runs", "killed", "cycle_hangs", "loop_hangs", "adapter_gone"]
Stage = Literal["running", "standing", "start", "reset"]


class FaultCase(msgspec.Struct, frozen=True, kw_only=True):
    """One fault case of the table.

    ``stage``: when the fault occurs: running; when the arm is enabled and about to move (standing; times count from its
    first command); before bring-up (start); or a fault whose reset is then tried (reset). ``orders``: commands for the
    emulated bus at that moment. ``host``: what happens to the master's computer then. ``codes``: what the master may
    latch first, or bring-up may refuse with, one or several by the fault's phase; empty: nothing latches, motion
    continues. ``bound_ms``: from the fault to all axes at rest. ``by``: the side that ends motion. ``afterwards``:
    ordered once the axes rest: it removes the cause, and nothing may move again by itself. ``options``: changes of the
    cell's options. ``warm_s``: motion before the fault. ``towards``: the node that has to move in its positive
    direction; 0: none.
    """

    name: str
    orders: tuple[str, ...] = ()
    host: Host = "runs"
    codes: tuple[str, ...] = ()
    bound_ms: float | None = None
    by: Literal["master", "drives", "bring-up", "nobody"] = "master"
    stage: Stage = "running"
    afterwards: tuple[str, ...] = ()
    options: dict[str, Any] = {}
    warm_s: float = 0.1
    towards: int = 0


AFTER_A_HANG = ("emergency", "left_operational", "drive_fault", "disabled", "bus_silent")
"""Codes that a thread may find first when it continues after the drives have stopped by themselves."""
NO_DEADLINE = {"rpdo_deadline_ms": 0}
"""The drives' deadline for commands is off: their heartbeat monitor (0x1016) of the master acts alone."""

EITHER_PROTOCOL = (
    FaultCase(name="node silent", orders=("silence 4",), codes=("silent",), bound_ms=60, afterwards=("speak 4",)),
    FaultCase(
        name="duplicate node id running",
        orders=("duplicate 2 running",),
        codes=("duplicate",),
        bound_ms=60,
        afterwards=("duplicate 2 off",),
    ),
    FaultCase(
        name="limit switch active before motion",
        options={"feedback": ("velocity", "switches")},
        orders=("limit 3 +",),
        towards=3,
        stage="standing",
        codes=("limit_switch", "emergency", "drive_fault"),
        bound_ms=40,
        afterwards=("limit 3 off",),
    ),
    FaultCase(
        name="encoder against the command from the start",
        orders=("invert 3",),
        stage="standing",
        codes=("encoder_reversed",),
        bound_ms=200,
        afterwards=("invert 3 off",),
    ),
    FaultCase(
        name="duplicate node id at start",
        orders=("duplicate 2 running",),
        codes=("duplicate_node",),
        by="bring-up",
        stage="start",
    ),
    FaultCase(
        name="node missing at start", orders=("silence 4",), codes=("node_missing",), by="bring-up", stage="start"
    ),
    FaultCase(name="servo loop hangs", host="loop_hangs", codes=("loop_hung",), bound_ms=150),
)
"""Cases that are the same for drives of both protocols."""

CIA402_CASES = (
    *EITHER_PROTOCOL,
    FaultCase(
        name="drive fault with emergency", orders=("fault 3 0x3210",), codes=("emergency", "drive_fault"), bound_ms=40
    ),
    FaultCase(name="emergency alone", orders=("emcy 5 0x4210",), codes=("emergency",), bound_ms=40),
    FaultCase(
        name="node's cable out", orders=("cable 4 out",), codes=("silent",), bound_ms=60, afterwards=("cable 4 in",)
    ),
    FaultCase(name="node reboots", orders=("reboot 5",), codes=("rebooted", "silent"), bound_ms=60),
    FaultCase(name="one TPDO lost", orders=("lose 2 tpdo1",), by="nobody"),
    FaultCase(name="three TPDOs lost", orders=("lose 2 tpdo1 3",), by="nobody"),
    FaultCase(
        name="TPDOs late by 6 ms",
        orders=("late 2 6ms",),
        codes=("late", "silent"),
        bound_ms=150,
        warm_s=0.5,
        afterwards=("late 2 0",),
    ),
    FaultCase(
        name="duplicate node id boots",
        orders=("duplicate 2 boots",),
        codes=("rebooted", "duplicate", "left_operational"),
        bound_ms=60,
        afterwards=("duplicate 2 off",),
    ),
    FaultCase(name="mapping changed", orders=("remap 3",), codes=("mapping", "silent"), bound_ms=40),
    FaultCase(
        name="bus cable out",
        orders=("cable out",),
        codes=("bus_silent",),
        bound_ms=150,
        by="drives",
        options=NO_DEADLINE,
        afterwards=("cable in",),
    ),
    FaultCase(
        name="bus cable out, RPDO deadline",
        orders=("cable out",),
        codes=("bus_silent",),
        bound_ms=60,
        by="drives",
        afterwards=("cable in",),
    ),
    FaultCase(name="master killed", host="killed", bound_ms=150, by="drives", options=NO_DEADLINE),
    FaultCase(name="master killed, RPDO deadline", host="killed", bound_ms=60, by="drives"),
    FaultCase(
        name="cycle thread hangs",
        host="cycle_hangs",
        codes=AFTER_A_HANG,
        bound_ms=150,
        by="drives",
        options=NO_DEADLINE,
    ),
    FaultCase(
        name="cycle thread hangs, RPDO deadline", host="cycle_hangs", codes=AFTER_A_HANG, bound_ms=60, by="drives"
    ),
    FaultCase(
        name="adapter gone",
        orders=("adapter out",),
        host="adapter_gone",
        codes=("connection_lost",),
        bound_ms=150,
        by="drives",
        options=NO_DEADLINE,
        afterwards=("adapter in",),
    ),
    FaultCase(name="SYNC lost", orders=("drop-sync",), codes=("bus_silent",), bound_ms=60, afterwards=("pass-sync",)),
    FaultCase(
        name="limit switch",
        options={"feedback": ("velocity", "switches")},
        orders=("limit 3 +",),
        towards=3,
        codes=("limit_switch", "emergency"),
        bound_ms=40,
        afterwards=("limit 3 off",),
    ),
    FaultCase(
        name="limit switch, switches not sent",
        orders=("limit 3 +",),
        towards=3,
        codes=("limit_switch", "emergency"),
        bound_ms=140,
        afterwards=("limit 3 off",),
    ),
    FaultCase(
        name="NMT stop by a stranger",
        orders=("nmt stop",),
        codes=("left_operational", "emergency", "disabled", "drive_fault", "bus_silent"),
        bound_ms=60,
        afterwards=("nmt start",),
    ),
    FaultCase(
        name="NMT reset of one node",
        orders=("nmt reset 6",),
        codes=("rebooted", "silent", "left_operational"),
        bound_ms=60,
    ),
    FaultCase(name="babbling node", orders=("flood 1",), codes=("bus_flood",), bound_ms=60, afterwards=("calm 1",)),
    FaultCase(
        name="encoder runs against the command",
        orders=("invert 3",),
        codes=("encoder_reversed",),
        bound_ms=200,
        afterwards=("invert 3 off",),
    ),
    FaultCase(
        name="drive in fault at start", orders=("fault 3 0x3210",), codes=("drive_fault", "emergency"), stage="start"
    ),
    FaultCase(
        name="cause that stays: reset refused",
        orders=("sticky 3 0x4310",),
        codes=("emergency", "drive_fault"),
        bound_ms=40,
        stage="reset",
    ),
)
"""Cases of six CiA 402 drives at 250 Hz with ramps of 12.5 ms."""

ODRIVE_CASES = (
    *EITHER_PROTOCOL,
    FaultCase(name="drive error", orders=("fault 3 0x20",), codes=("drive_fault",), bound_ms=40),
    FaultCase(name="node reboots", orders=("reboot 5",), codes=("silent",), bound_ms=60),
    FaultCase(name="one answer lost", orders=("lose 2 0x049",), by="nobody"),
    FaultCase(
        name="answers late by 6 ms",
        orders=("late 2 6ms",),
        codes=("late", "silent"),
        bound_ms=150,
        warm_s=0.5,
        afterwards=("late 2 0",),
    ),
    FaultCase(
        name="bus cable out",
        orders=("cable out",),
        codes=("bus_silent",),
        bound_ms=150,
        by="drives",
        afterwards=("cable in",),
    ),
    FaultCase(name="master killed", host="killed", bound_ms=150, by="drives"),
    FaultCase(name="cycle thread hangs", host="cycle_hangs", codes=AFTER_A_HANG, bound_ms=150, by="drives"),
    FaultCase(
        name="end stop",
        orders=("limit 3 +",),
        towards=3,
        codes=("drive_fault",),
        bound_ms=40,
        afterwards=("limit 3 off",),
    ),
    FaultCase(name="drive in error at start", orders=("fault 3 0x20",), codes=("drive_fault",), stage="start"),
    FaultCase(
        name="cause that stays: reset refused",
        orders=("sticky 3 0x2000",),
        codes=("drive_fault",),
        bound_ms=40,
        stage="reset",
    ),
)
"""Cases of six ODrives whose watchdogs are set to 100 ms."""

CASES: dict[str, tuple[FaultCase, ...]] = {"cia402": CIA402_CASES, "odrive": ODRIVE_CASES}
"""Cases by protocol."""
