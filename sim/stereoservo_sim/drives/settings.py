"""How an emulated CiA 402 drive is made: what its firmware fixes, and where real ones differ."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class NodeSettings:
    """``brake_ms``: what the brake takes to open and to close. ``boot_ms``: from power on to the boot-up frame.

    ``tick_ns``: period of the drive's own control while its power stage is on. ``sync_timeout_factor``: periods of
    0x1006 without SYNC that make error 0x8700. ``following_window``: limit of the following error [rad or m] where
    the EDS has no 0x6065. ``identity``: of 0x1018 by sub-index, before what the joint's options ask for.
    ``pdos_by_default``: whether the EDS's PDOs exist after power on (they do in EPOS4: RPDO 3 and 4 then hear
    control words on 0x400 and 0x500 + node id); False switches all off. ``reset_needs_communication_reset``: after
    0x8130 and 0x8120 the drive refuses a fault reset until NMT reset communication (EPOS4).
    ``preoperational_aborts``: NMT pre-operational counts as a lost connection (0x6007); NMT stop and reset always do.
    """

    brake_ms: float = 50.0
    boot_ms: float = 0.0
    tick_ns: int = 1_000_000
    sync_timeout_factor: float = 5.0
    following_window: float = 0.5
    identity: dict[int, int] = field(default_factory=dict)
    pdos_by_default: bool = True
    reset_needs_communication_reset: bool = False
    preoperational_aborts: bool = True
