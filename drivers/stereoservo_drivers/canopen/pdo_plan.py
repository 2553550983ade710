"""Layout of a drive's process data: which objects are sent in which PDO, within what the drive permits.

CiA 301 leaves the number of PDOs, of their mapping entries, and whether a mapping can be changed to the drive. A drive
shows it by what it refuses (`restricted`); the plan is then solved again.
"""

from __future__ import annotations

import functools
import struct
from itertools import product
from typing import NamedTuple

from stereoservo_drivers.canopen.options import CommandMode

PDOS = 4
"""Number of PDOs in each direction with COB-IDs of the predefined connection set (CiA 301)."""
PDO_BITS = 64
MOST_ENTRIES = 8

STATUS_WORD, POSITION = 0x60410010, 0x60640020
CONTROL_WORD = 0x60400010
TARGETS: dict[CommandMode, int] = {"csv": 0x60FF0020, "pv": 0x60FF0020, "csp": 0x607A0020, "ip": 0x60C10120}
"""Mapping entry of the set-point of each mode."""
STATUS_AND_POSITION = (STATUS_WORD, POSITION)
FEEDBACK_OBJECTS: dict[str, int] = {
    "velocity": 0x606C0020,
    "effort": 0x60770010,
    "following_error": 0x60F40020,
    "switches": 0x60FD0020,
}
"""Feedback -> its mapping entry: index, sub-index, bits."""
UNSIGNED = (STATUS_WORD, FEEDBACK_OBJECTS["switches"])

RPDO_IDS = (0x200, 0x300, 0x400, 0x500)
TPDO_IDS = (0x180, 0x280, 0x380, 0x480)


class Slot(NamedTuple):
    """What a PDO of a drive can hold: at most ``entries``, none of the ``excluded`` ones; or its ``fixed`` mapping."""

    entries: int = MOST_ENTRIES
    excluded: frozenset[int] = frozenset()
    fixed: tuple[int, ...] | None = None

    def takes(self, entry: int) -> bool:
        """Whether it can hold an entry."""
        return entry in self.fixed if self.fixed is not None else self.entries > 0 and entry not in self.excluded


Slots = tuple[Slot, ...]
UNRESTRICTED: Slots = (Slot(),) * PDOS


class Pdo(NamedTuple):
    """Mapping entries of the PDO of this ``number``, 0 for the first."""

    number: int
    mapping: tuple[int, ...]

    @property
    def size(self) -> int:
        """Its length [bytes]."""
        return sum(entry & 0xFF for entry in self.mapping) // 8


class PdoPlan(NamedTuple):
    """The PDOs of one drive: ``commands`` are received by it, in the order in which they are sent; ``reports`` are sent
    with every SYNC.
    """

    commands: tuple[Pdo, ...]
    reports: tuple[Pdo, ...]

    def sends(self, what: str) -> bool:
        """Whether a feedback is sent."""
        return any(FEEDBACK_OBJECTS[what] in pdo.mapping for pdo in self.reports)

    @property
    def lengths(self) -> list[int]:
        """Lengths [bytes] of all its frames of a cycle."""
        return [pdo.size for pdo in (*self.commands, *self.reports)]


@functools.cache
def solved(slots: Slots, required: tuple[int, ...], optional: tuple[int, ...] = ()) -> tuple[Pdo, ...] | None:
    """PDOs that hold all ``required`` entries, and of the ``optional`` ones as many as possible, the first ones rather
    than the last; None if the required ones have no place.

    Among these, optional entries are kept out of the PDOs of required ones, and as few PDOs as possible are used.
    """
    entries = required + optional
    nowhere = len(slots)
    choices = [
        [number for number, slot in enumerate(slots) if slot.takes(entry)] + [nowhere] * (entry in optional)
        for entry in entries
    ]

    def cost(places: tuple[int, ...]) -> tuple[int, tuple[bool, ...], int, int, tuple[int, ...]]:
        first, others = set(places[: len(required)]), places[len(required) :]
        dropped = tuple(place == nowhere for place in others)
        shared = sum(place in first for place in others)
        return sum(dropped), dropped, shared, len(set(places) - {nowhere}), places

    fitting = [places for places in product(*choices) if _fit(slots, entries, places)]
    if not fitting:
        return None
    places = min(fitting, key=cost)
    found = []
    for number in sorted(set(places) - {nowhere}):
        mine = tuple(entry for entry, place in zip(entries, places, strict=True) if place == number)
        found.append(Pdo(number, slots[number].fixed or mine))
    return tuple(found)


def _fit(slots: Slots, entries: tuple[int, ...], places: tuple[int, ...]) -> bool:
    """Whether the PDOs can hold the ``entries`` at these ``places``."""
    for number, slot in enumerate(slots):
        mine = [entry & 0xFF for entry, place in zip(entries, places, strict=True) if place == number]
        if slot.fixed is None and (len(mine) > slot.entries or sum(mine) > PDO_BITS):
            return False
    return True


def planned(
    target: int, feedback: tuple[str, ...], commands: Slots = UNRESTRICTED, reports: Slots = UNRESTRICTED
) -> PdoPlan | None:
    """Plan for set-points to the entry ``target`` and for ``feedback`` besides status word and position, in the order
    of its importance; None if the drive cannot be commanded or read with these PDOs.

    A PDO with the set-point comes before one with the control word: a drive may act as soon as it has the word.
    """
    command = solved(commands, (CONTROL_WORD, target))
    report = solved(reports, STATUS_AND_POSITION, tuple(FEEDBACK_OBJECTS[what] for what in feedback))
    if command is None or report is None:
        return None
    return PdoPlan(tuple(sorted(command, key=lambda pdo: target not in pdo.mapping)), report)


def restricted(slots: Slots, number: int, slot: Slot) -> Slots:
    """``slots`` with ``slot`` as the PDO of a ``number``."""
    return (*slots[:number], slot, *slots[number + 1 :])


def data_layout(pdo: Pdo, known: tuple[int, ...]) -> struct.Struct:
    """Layout of a PDO's data: the values of ``known`` entries, and what lies between them as padding."""
    text = "<"
    for entry in pdo.mapping:
        size = (entry & 0xFF) // 8
        code = {1: "b", 2: "h", 4: "i"}.get(size, "")
        text += (code.upper() if entry in UNSIGNED else code) if entry in known and code else f"{size}x"
    return struct.Struct(text)
