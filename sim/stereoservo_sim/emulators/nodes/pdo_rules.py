"""Rules for changes of PDO parameters by SDO (CiA 301, 7.5.2.35 to 7.5.2.38), and their decoding."""

from __future__ import annotations

from dataclasses import dataclass

from stereoservo_sim.emulators.nodes.dictionary import DUMMY_BITS, Abort, Dictionary, SdoError

INVALID = 1 << 31
NO_REMOTE = 1 << 30
EXTENDED = 1 << 29
COUNT = 4
"""PDOs of each direction."""
RPDO_COMMUNICATION, RPDO_MAPPING = 0x1400, 0x1600
TPDO_COMMUNICATION, TPDO_MAPPING = 0x1800, 0x1A00
LONGEST_BITS = 64
EVENT_TYPES = (254, 255)
LAST_SYNCHRONOUS = 240

_RESTRICTED = (
    (0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x7FF),
)  # fmt: skip
"""CAN ids that no PDO may have (CiA 301, table 40)."""


@dataclass(frozen=True)
class Mapped:
    """One object in a PDO; ``dummy``: a gap."""

    index: int
    sub: int
    size: int
    dummy: bool = False


def mapped(dictionary: Dictionary, index: int) -> tuple[Mapped, ...]:
    """Objects listed in the mapping object ``index``."""
    objects = []
    for k in range(1, dictionary.get(index, 0) + 1):
        word = dictionary.get(index, k)
        which = word >> 16
        objects.append(Mapped(which, word >> 8 & 0xFF, (word & 0xFF) // 8, which in DUMMY_BITS))
    return tuple(objects)


def check_communication(dictionary: Dictionary, index: int, sub: int, value: int) -> None:
    """Check a write to 0x1400 or 0x1800 onwards. Raises SdoError."""
    before = dictionary.get(index, 1)
    exists = not before & INVALID
    transmit = index >= TPDO_COMMUNICATION
    if sub == 1:
        _check_cob_id(dictionary, index, before, value)
    elif sub == 2:
        if LAST_SYNCHRONOUS < value < EVENT_TYPES[0]:
            raise SdoError(Abort.INVALID_VALUE)  # reserved; remote requests are not offered
    elif exists and transmit and sub in (3, 6):
        raise SdoError(Abort.DEVICE_STATE)  # inhibit time and SYNC start value: not while the PDO exists


def _check_cob_id(dictionary: Dictionary, index: int, before: int, value: int) -> None:
    if value & EXTENDED or value & 0x1FFF_F800:
        raise SdoError(Abort.INVALID_VALUE)
    if value & INVALID:
        return
    can_id = value & 0x7FF
    if any(low <= can_id <= high for low, high in _RESTRICTED):
        raise SdoError(Abort.INVALID_VALUE)
    if not before & INVALID and can_id != before & 0x7FF:
        raise SdoError(Abort.DEVICE_STATE)


def check_mapping(dictionary: Dictionary, index: int, sub: int, value: int) -> None:
    """Check a write to 0x1600 or 0x1A00 onwards: PDO switched off, count 0, objects, count. Raises SdoError."""
    transmit = index >= TPDO_MAPPING
    if not dictionary.get(index - 0x200, 1) & INVALID:
        raise SdoError(Abort.DEVICE_STATE)
    if sub:
        if dictionary.get(index, 0):
            raise SdoError(Abort.DEVICE_STATE)
        if value:
            _check_object(dictionary, value, transmit=transmit)
        return
    bits = 0
    for k in range(1, value + 1):
        word = dictionary.get(index, k)
        if not word:
            raise SdoError(Abort.NOT_MAPPABLE)
        bits += word & 0xFF
    if bits > LONGEST_BITS:
        raise SdoError(Abort.MAPPING_TOO_LONG)


def _check_object(dictionary: Dictionary, word: int, *, transmit: bool) -> None:
    index, sub, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
    if index in DUMMY_BITS:
        if transmit or sub or bits != DUMMY_BITS[index]:
            raise SdoError(Abort.NOT_MAPPABLE)
        return
    entry = dictionary.find(index, sub)
    if not (entry.transmittable if transmit else entry.receivable) or bits != 8 * entry.size:
        raise SdoError(Abort.NOT_MAPPABLE)
