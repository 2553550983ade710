"""Object dictionary of an emulated node, from an EDS, with access rights, limits and SDO abort codes."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from pathlib import Path

import canopen
from canopen.objectdictionary import ODVariable

Value = int | float | bytes
Guard = Callable[[int, int], None]
"""Callback with (sub-index, value) before the bus stores it; raises SdoError if the node refuses it."""
Changed = Callable[[int, int], None]
"""Callback with (sub-index, value) after the bus has stored it."""


class Abort(IntEnum):
    """SDO abort codes (CiA 301, 7.2.4.3.17)."""

    TOGGLE = 0x05030000
    TIMED_OUT = 0x05040000
    COMMAND = 0x05040001
    OUT_OF_MEMORY = 0x05040005
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    MAPPING_TOO_LONG = 0x06040042
    INCOMPATIBLE = 0x06040043
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUB_INDEX = 0x06090011
    INVALID_VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    NOT_STORABLE = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoError(Exception):
    """The node refuses an access; ``code``: the abort code."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"SDO abort 0x{code:08X} ({code.name.lower().replace('_', ' ')})")
        self.code = code


_INTEGERS = {
    0x01: (1, False), 0x02: (1, True), 0x03: (2, True), 0x04: (4, True), 0x05: (1, False), 0x06: (2, False),
    0x07: (4, False), 0x10: (3, True), 0x12: (5, True), 0x13: (6, True), 0x14: (7, True), 0x15: (8, True),
    0x16: (3, False), 0x18: (5, False), 0x19: (6, False), 0x1A: (7, False), 0x1B: (8, False),
}  # fmt: skip
"""Data type (CiA 301, 7.4.7) -> bytes, signed."""
_REALS = {0x08: struct.Struct("<f"), 0x11: struct.Struct("<d")}
DUMMY_BITS = {index: 8 * size for index, (size, _) in _INTEGERS.items() if index <= 0x07}
"""Objects 0x0001 to 0x0007 fill gaps of an RPDO (CiA 301, 7.4.7.3)."""
LONGEST_STRING = 512


@dataclass(frozen=True)
class Entry:
    """One sub-object as described by the EDS. ``size`` [bytes]: 0 if it varies."""

    data_type: int
    access: str
    low: int | None
    high: int | None
    default: Value
    mappable: bool

    @property
    def size(self) -> int:
        """Length in bytes, 0 for strings and domains."""
        if self.data_type in _INTEGERS:
            return _INTEGERS[self.data_type][0]
        return _REALS[self.data_type].size if self.data_type in _REALS else 0

    @property
    def readable(self) -> bool:
        """Whether SDO may read it."""
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        """Whether SDO may write it."""
        return self.access in ("rw", "wo", "rwr", "rww")

    @property
    def receivable(self) -> bool:
        """Whether it may be mapped into an RPDO."""
        return self.mappable and self.access in ("rw", "rww", "wo")

    @property
    def transmittable(self) -> bool:
        """Whether it may be mapped into a TPDO."""
        return self.mappable and self.access in ("ro", "rw", "rwr")

    def encode(self, value: Value) -> bytes:
        """Little-endian bytes, as on the wire."""
        if isinstance(value, bytes):
            return value
        if self.data_type in _REALS:
            return _REALS[self.data_type].pack(value)
        size, signed = _INTEGERS[self.data_type]
        return int(value).to_bytes(size, "little", signed=signed)

    def decode(self, data: bytes) -> Value:
        """The value of ``data``. Raises SdoError for a wrong length."""
        if not self.size:
            if len(data) > LONGEST_STRING:
                raise SdoError(Abort.OUT_OF_MEMORY)
            return data
        if len(data) != self.size:
            raise SdoError(Abort.TOO_LONG if len(data) > self.size else Abort.TOO_SHORT)
        if self.data_type in _REALS:
            return float(_REALS[self.data_type].unpack(data)[0])
        return int.from_bytes(data, "little", signed=_INTEGERS[self.data_type][1])


def _entry(variable: ODVariable) -> Entry:
    default = variable.default
    if isinstance(default, str):
        default = default.encode("ascii")
    known = variable.data_type in _INTEGERS or variable.data_type in _REALS
    if default is None:
        default = 0 if known else b""
    access = variable.access_type
    return Entry(variable.data_type, access, variable.min, variable.max, default, bool(variable.pdo_mappable))


@lru_cache(maxsize=256)
def _parse(path: str, modified_ns: int, node_id: int) -> dict[tuple[int, int], Entry]:
    entries = {}
    for index, described in canopen.import_od(path, node_id).items():
        if index in DUMMY_BITS:
            continue
        members = [described] if isinstance(described, ODVariable) else described.subindices.values()
        for variable in members:
            entries[index, variable.subindex] = _entry(variable)
    return entries


class Dictionary:
    """Values of a node's objects. Raises OSError or configparser.Error for an unreadable EDS."""

    def __init__(self, eds: Path, node_id: int) -> None:
        self.entries = _parse(str(eds), eds.stat().st_mtime_ns, node_id)
        self._indices = {index for index, _ in self.entries}
        self._values = {key: entry.default for key, entry in self.entries.items()}
        self._guards: dict[int, Guard] = {}
        self._changed: dict[int, Changed] = {}
        self._live: dict[tuple[int, int], Callable[[], int]] = {}
        self._readings: dict[int, Callable[[int], None]] = {}

    def guard(self, index: int, check: Guard) -> None:
        """Call ``check`` before the bus changes the object."""
        self._guards[index] = check

    def changed(self, index: int, tell: Changed) -> None:
        """Call back after the bus has changed the object."""
        self._changed[index] = tell

    def live(self, index: int, sub: int, value: Callable[[], int]) -> None:
        """Compute the object's value when it is read. No effect if the EDS lacks it."""
        if (index, sub) in self.entries:
            self._live[index, sub] = value

    def reading(self, index: int, check: Callable[[int], None]) -> None:
        """Call ``check(sub)`` before the bus reads the object; it may raise SdoError."""
        self._readings[index] = check

    def get(self, index: int, sub: int = 0, default: int = 0) -> int:
        """The value of an integer object, for the firmware; ``default`` if the EDS lacks it."""
        live = self._live.get((index, sub))
        if live is not None:
            return live()
        return int(self._values.get((index, sub), default))

    def set(self, index: int, sub: int, value: Value) -> None:
        """Set a value from the firmware: without checks and callbacks. No effect if the EDS lacks it."""
        if (index, sub) in self.entries:
            self._values[index, sub] = value

    def find(self, index: int, sub: int) -> Entry:
        """Description of an object. Raises SdoError if it does not exist."""
        entry = self.entries.get((index, sub))
        if entry is None:
            raise SdoError(Abort.NO_SUB_INDEX if index in self._indices else Abort.NO_OBJECT)
        return entry

    def encoded(self, index: int, sub: int) -> bytes:
        """Value as on the wire, without a check of access rights (PDO)."""
        entry = self.entries[index, sub]
        live = self._live.get((index, sub))
        return entry.encode(self._values[index, sub] if live is None else live())

    def upload(self, index: int, sub: int) -> bytes:
        """Read by SDO. Raises SdoError."""
        if not self.find(index, sub).readable:
            raise SdoError(Abort.WRITE_ONLY)
        if index in self._readings:
            self._readings[index](sub)
        return self.encoded(index, sub)

    def writable(self, index: int, sub: int) -> Entry:
        """Description of an object that SDO may write. Raises SdoError."""
        entry = self.find(index, sub)
        if not entry.writable:
            raise SdoError(Abort.READ_ONLY)
        return entry

    def download(self, index: int, sub: int, data: bytes) -> None:
        """Write by SDO. Raises SdoError."""
        self.writable(index, sub)
        self.store(index, sub, data)

    def store(self, index: int, sub: int, data: bytes) -> None:
        """Store bytes from the bus after checks of length, limits and guard. Raises SdoError without a change."""
        entry = self.entries[index, sub]
        value = entry.decode(data)
        if not isinstance(value, bytes):
            if entry.high is not None and value > entry.high:
                raise SdoError(Abort.TOO_HIGH)
            if entry.low is not None and value < entry.low:
                raise SdoError(Abort.TOO_LOW)
        number = 0 if isinstance(value, bytes) else int(value)
        if index in self._guards:
            self._guards[index](sub, number)
        self._values[index, sub] = value
        if index in self._changed:
            self._changed[index](sub, number)

    def restore(self, first: int, last: int, stored: dict[tuple[int, int], Value] | None = None) -> None:
        """Restore objects ``first`` to ``last`` to their values at power on: ``stored``, else the EDS's defaults."""
        stored = stored or {}
        for key, entry in self.entries.items():
            if first <= key[0] <= last:
                self._values[key] = stored.get(key, entry.default)

    def storable(self) -> dict[tuple[int, int], Value]:
        """Objects that 0x1010 saves: all that the bus can write, except commands, modes and histories."""
        skipped = {0x1003, 0x1010, 0x1011, 0x6040, 0x6060, 0x607A, 0x60FF}
        return {k: self._values[k] for k, e in self.entries.items() if e.writable and k[0] not in skipped}
