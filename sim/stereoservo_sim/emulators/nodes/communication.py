"""Communication of an emulated node: process data by four RPDOs and four TPDOs with their parameters (CiA 301, 7.2.2,
7.5.2.35), service data by its SDO server.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache, partial
from pathlib import Path

from canopen.objectdictionary import ODVariable

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.canopen.eds_files import read_eds
from stereoservo_sim.emulators.nodes.node import NEVER_NS

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
        default = default.encode("ascii", "replace")
    known = variable.data_type in _INTEGERS or variable.data_type in _REALS
    if default is None:
        default = 0 if known else b""
    access = variable.access_type
    return Entry(variable.data_type, access, variable.min, variable.max, default, bool(variable.pdo_mappable))


@lru_cache(maxsize=256)
def _parse(path: str, modified_ns: int, node_id: int) -> dict[tuple[int, int], Entry]:
    entries = {}
    for index, described in read_eds(Path(path), node_id)[0].items():
        if index in DUMMY_BITS:
            continue
        members = [described] if isinstance(described, ODVariable) else described.subindices.values()
        for variable in members:
            entries[index, variable.subindex] = _entry(variable)
    return entries


class Dictionary:
    """Values of a node's objects. Raises DriverError (``eds``) for an unreadable EDS, OSError if it is not there."""

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


# -- communication ------------------------------------------------------------------------------------------


TOO_SHORT, TOO_LONG, DEADLINE = 0x8210, 0x8220, 0x8250
"""Emergency codes: PDO not processed, length exceeded, RPDO time-out (CiA 301, table 26)."""

Report = Callable[[int, bool], None]
"""Callback with (emergency code, whether the error is present or gone)."""


@dataclass
class _Rpdo:
    can_id: int | None
    kind: int
    timeout_ns: int
    objects: tuple[Mapped, ...]
    length: int
    pending: bytes | None = None
    deadline_ns: int = NEVER_NS


@dataclass
class _Tpdo:
    can_id: int | None
    remote: bool
    kind: int
    inhibit_ns: int
    event_ns: int
    start: int
    objects: tuple[Mapped, ...]
    syncs: int = 0
    sent: bytes | None = None
    free_ns: int = 0
    event_due_ns: int = NEVER_NS
    wanted: bool = False


class ProcessData:
    """PDOs of one node. ``operational`` is set by the node; PDOs are received and sent only then."""

    def __init__(self, dictionary: Dictionary, report: Report) -> None:
        self._dictionary = dictionary
        self._report = report
        self.operational = False
        self._errors: set[int] = set()
        for k in range(COUNT):
            for index in (RPDO_COMMUNICATION + k, TPDO_COMMUNICATION + k):
                dictionary.guard(index, partial(check_communication, dictionary, index))
            for index in (RPDO_MAPPING + k, TPDO_MAPPING + k):
                dictionary.guard(index, partial(check_mapping, dictionary, index))
            for index in (RPDO_COMMUNICATION + k, RPDO_MAPPING + k):
                dictionary.changed(index, partial(self._rpdo_changed, k))
            for index in (TPDO_COMMUNICATION + k, TPDO_MAPPING + k):
                dictionary.changed(index, partial(self._tpdo_changed, k))
        self.reload()

    def _rpdo_changed(self, k: int, sub: int, value: int) -> None:
        self._rpdos[k] = self._rpdo(k)
        self._index()

    def _tpdo_changed(self, k: int, sub: int, value: int) -> None:
        self._tpdos[k] = self._tpdo(k)
        self._index()

    def _index(self) -> None:
        self._received = {p.can_id for p in self._rpdos if p.can_id is not None}
        self._requested = {p.can_id for p in self._tpdos if p.can_id is not None and p.remote}
        self._synchronous = [p for p in self._tpdos if p.can_id is not None and p.kind <= LAST_SYNCHRONOUS]
        self._event_driven = [p for p in self._tpdos if p.can_id is not None and p.kind in EVENT_TYPES]

    def reload(self) -> None:
        """Read all parameters from the dictionary; counts and deadlines restart."""
        self._rpdos = [self._rpdo(k) for k in range(COUNT)]
        self._tpdos = [self._tpdo(k) for k in range(COUNT)]
        self._index()

    def _rpdo(self, k: int) -> _Rpdo:
        index, get = RPDO_COMMUNICATION + k, self._dictionary.get
        cob_id = get(index, 1, INVALID)
        objects = mapped(self._dictionary, RPDO_MAPPING + k)
        used = not cob_id & INVALID and bool(objects)
        return _Rpdo(
            can_id=cob_id & 0x7FF if used else None,
            kind=get(index, 2),
            timeout_ns=get(index, 5) * 1_000_000,
            objects=objects,
            length=sum(o.size for o in objects),
        )

    def _tpdo(self, k: int) -> _Tpdo:
        index, get = TPDO_COMMUNICATION + k, self._dictionary.get
        cob_id = get(index, 1, INVALID)
        objects = mapped(self._dictionary, TPDO_MAPPING + k)
        used = not cob_id & INVALID and bool(objects)
        return _Tpdo(
            can_id=cob_id & 0x7FF if used else None,
            remote=not cob_id & NO_REMOTE,
            kind=get(index, 2),
            inhibit_ns=get(index, 3) * 100_000,
            event_ns=get(index, 5) * 1_000_000,
            start=get(index, 6),
            objects=objects,
        )

    def enter_operational(self, operational: bool) -> None:
        """Enter the NMT state operational: event-driven TPDOs are sent once; deadlines start with the first RPDO."""
        if operational == self.operational:
            return
        self.operational = operational
        self.reload()
        for tpdo in self._tpdos:
            tpdo.wanted = operational and tpdo.kind in EVENT_TYPES
        if not operational:
            for code in tuple(self._errors):
                self._error(code, there=False)

    def _error(self, code: int, *, there: bool) -> None:
        if there and code not in self._errors:
            self._errors.add(code)
            self._report(code, True)
        elif not there and code in self._errors:
            self._errors.remove(code)
            self._report(code, False)

    def listens(self, frame: CanFrame) -> bool:
        """Whether the frame belongs to one of these PDOs."""
        if not self.operational:
            return False
        return frame.id in (self._requested if frame.remote else self._received)

    def receive(self, frame: CanFrame, t_ns: int) -> list[CanFrame]:
        """Process an RPDO, or a remote request of a TPDO; returns the frames to send at once."""
        if frame.remote:
            asked = [p for p in self._tpdos if p.can_id == frame.id and p.remote]
            return [self._transmit(p, t_ns) for p in asked]
        for rpdo in self._rpdos:
            if rpdo.can_id == frame.id:
                self._take(rpdo, frame.data, t_ns)
        return []

    def _take(self, rpdo: _Rpdo, data: bytes, t_ns: int) -> None:
        self._error(TOO_SHORT, there=len(data) < rpdo.length)
        self._error(TOO_LONG, there=len(data) > rpdo.length)
        if len(data) < rpdo.length:
            return
        self._error(DEADLINE, there=False)
        rpdo.deadline_ns = t_ns + rpdo.timeout_ns if rpdo.timeout_ns else NEVER_NS
        if rpdo.kind <= LAST_SYNCHRONOUS:
            rpdo.pending = data
        else:
            self._apply(rpdo, data)

    def _apply(self, rpdo: _Rpdo, data: bytes) -> None:
        at = 0
        for o in rpdo.objects:
            if not o.dummy:
                with suppress(SdoError):  # cannot be reported: the object keeps its value, as in real drives
                    self._dictionary.store(o.index, o.sub, data[at : at + o.size])
            at += o.size

    def waits_for_sync(self) -> bool:
        """Whether a received RPDO takes effect at the next SYNC."""
        return any(rpdo.pending is not None for rpdo in self._rpdos)

    def sync(self, counter: int | None, t_ns: int) -> list[CanFrame]:
        """Process SYNC: synchronous TPDOs with current values, then synchronous RPDOs take effect."""
        if not self.operational:
            return []
        frames = [self._transmit(p, t_ns) for p in self._synchronous if self._due_at_sync(p, counter)]
        for rpdo in self._rpdos:
            if rpdo.pending is not None:
                data, rpdo.pending = rpdo.pending, None
                self._apply(rpdo, data)
        return frames

    def _due_at_sync(self, tpdo: _Tpdo, counter: int | None) -> bool:
        if tpdo.kind == 0:
            return self._content(tpdo) != tpdo.sent
        if tpdo.start and counter is not None and tpdo.sent is None and tpdo.syncs == 0:
            if counter != tpdo.start:
                return False
            tpdo.syncs = tpdo.kind - 1
        tpdo.syncs += 1
        if tpdo.syncs < tpdo.kind:
            return False
        tpdo.syncs = 0
        return True

    def _content(self, tpdo: _Tpdo) -> bytes:
        return b"".join([self._dictionary.encoded(o.index, o.sub) for o in tpdo.objects])

    def _transmit(self, tpdo: _Tpdo, t_ns: int) -> CanFrame:
        tpdo.sent = self._content(tpdo)
        tpdo.wanted = False
        tpdo.free_ns = t_ns + tpdo.inhibit_ns
        if tpdo.kind in EVENT_TYPES and tpdo.event_ns:
            tpdo.event_due_ns = t_ns + tpdo.event_ns
        assert tpdo.can_id is not None
        return CanFrame(id=tpdo.can_id, data=tpdo.sent)

    def check_deadlines(self, t_ns: int) -> None:
        """Report RPDOs that missed their deadline."""
        if not self.operational:
            return
        for rpdo in self._rpdos:
            if t_ns >= rpdo.deadline_ns:
                rpdo.deadline_ns = NEVER_NS
                self._error(DEADLINE, there=True)

    def events(self, t_ns: int) -> list[CanFrame]:
        """Event-driven TPDOs whose content has changed or whose timer has expired, subject to the inhibit time."""
        if not self.operational:
            return []
        frames = []
        for tpdo in self._event_driven:
            if tpdo.wanted or t_ns >= tpdo.event_due_ns or self._content(tpdo) != tpdo.sent:
                tpdo.wanted = True
                if t_ns >= tpdo.free_ns:
                    frames.append(self._transmit(tpdo, t_ns))
        return frames

    def due_ns(self) -> int:
        """Time at which ``check_deadlines`` or ``events`` is next needed."""
        if not self.operational:
            return NEVER_NS
        due = min([rpdo.deadline_ns for rpdo in self._rpdos])
        for tpdo in self._event_driven:
            due = min(due, tpdo.free_ns if tpdo.wanted else tpdo.event_due_ns)
        return due


# -- rules ---------------------------------------------------------------------------------------------------
# Rules for changes of PDO parameters by SDO (CiA 301, 7.5.2.35 to 7.5.2.38), and their decoding.


INVALID = 1 << 31
NO_REMOTE = 1 << 30
EXTENDED = 1 << 29
COUNT = 4
"""Number of PDOs in each direction."""
RPDO_COMMUNICATION, RPDO_MAPPING = 0x1400, 0x1600
TPDO_COMMUNICATION, TPDO_MAPPING = 0x1800, 0x1A00
LONGEST_BITS = 64
EVENT_TYPES = (254, 255)
LAST_SYNCHRONOUS = 240

_RESTRICTED = ((0x000, 0x07F), (0x101, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x6FF), (0x701, 0x7FF))
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
            raise SdoError(Abort.INVALID_VALUE)  # reserved; remote requests are not supported
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


# -- the SDO server ------------------------------------------------------------------------------------------
# SDO server of an emulated node: expedited and segmented transfers (CiA 301, 7.2.4.3). Block transfer is refused.


TIMEOUT_NS = 1_000_000_000
_TOGGLE = 0x10


@dataclass
class _Transfer:
    """A segmented transfer in progress. ``size`` announced by the client of a download, 0 if not announced."""

    index: int
    sub: int
    upload: bool
    size: int = 0
    data: bytearray = field(default_factory=bytearray)
    toggle: int = 0
    deadline_ns: int = 0


class SdoServer:
    """One server channel: a request's 8 bytes in, a reply's 8 bytes or None out."""

    def __init__(self, dictionary: Dictionary, *, timeout_ns: int = TIMEOUT_NS) -> None:
        self._dictionary = dictionary
        self._timeout_ns = timeout_ns
        self._transfer: _Transfer | None = None
        self._last = (0, 0)

    def reset(self) -> None:
        """Abandon a transfer in progress."""
        self._transfer = None

    def due_ns(self) -> int:
        """Time at which an incomplete transfer times out."""
        return NEVER_NS if self._transfer is None else self._transfer.deadline_ns

    def advance(self, t_ns: int) -> bytes | None:
        """Abort frame of a transfer that has timed out."""
        if t_ns < self.due_ns():
            return None
        return self._abort(Abort.TIMED_OUT)

    def request(self, data: bytes, t_ns: int) -> bytes | None:
        """Reply to a client's frame; None to an abort and to a frame that is no SDO request."""
        if len(data) != 8:
            return None
        command = data[0] >> 5
        if command in (1, 2):
            self._transfer = None
            self._last = struct.unpack_from("<HB", data, 1)
        if command == 4:
            self._transfer = None
            return None
        try:
            if command == 0:
                return self._download_segment(data, t_ns)
            if command == 1:
                return self._download(data, t_ns)
            if command == 2:
                return self._upload(t_ns)
            if command == 3:
                return self._upload_segment(data, t_ns)
            if command in (5, 6):
                self._last = struct.unpack_from("<HB", data, 1)
            raise SdoError(Abort.COMMAND)
        except SdoError as refused:
            return self._abort(refused.code)

    def _abort(self, code: Abort) -> bytes:
        self._transfer = None
        return struct.pack("<BHBL", 0x80, *self._last, code)

    def _download(self, data: bytes, t_ns: int) -> bytes:
        index, sub = self._last
        entry = self._dictionary.writable(index, sub)
        if data[0] & 0x02:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 0x01 else min(entry.size or 4, 4)
            self._dictionary.download(index, sub, data[4 : 4 + size])
        else:
            size = int.from_bytes(data[4:8], "little") if data[0] & 0x01 else 0
            if size and entry.size and size != entry.size:
                raise SdoError(Abort.TOO_LONG if size > entry.size else Abort.TOO_SHORT)
            if size > LONGEST_STRING:
                raise SdoError(Abort.OUT_OF_MEMORY)
            self._begin(_Transfer(index, sub, upload=False, size=size), t_ns)
        return struct.pack("<BHBL", 0x60, index, sub, 0)

    def _upload(self, t_ns: int) -> bytes:
        index, sub = self._last
        value = self._dictionary.upload(index, sub)
        if 1 <= len(value) <= 4:
            return struct.pack("<BHB4s", 0x43 | (4 - len(value)) << 2, index, sub, value)
        self._begin(_Transfer(index, sub, upload=True, data=bytearray(value)), t_ns)
        return struct.pack("<BHBL", 0x41, index, sub, len(value))

    def _begin(self, transfer: _Transfer, t_ns: int) -> None:
        transfer.deadline_ns = t_ns + self._timeout_ns
        self._transfer = transfer

    def _going_on(self, data: bytes, t_ns: int, *, upload: bool) -> _Transfer:
        transfer = self._transfer
        if transfer is None or transfer.upload != upload:
            raise SdoError(Abort.COMMAND)
        if data[0] & _TOGGLE != transfer.toggle:
            raise SdoError(Abort.TOGGLE)
        transfer.toggle ^= _TOGGLE
        transfer.deadline_ns = t_ns + self._timeout_ns
        return transfer

    def _download_segment(self, data: bytes, t_ns: int) -> bytes:
        transfer = self._going_on(data, t_ns, upload=False)
        transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
        most = transfer.size or LONGEST_STRING
        if len(transfer.data) > most:
            raise SdoError(Abort.TOO_LONG if transfer.size else Abort.OUT_OF_MEMORY)
        if data[0] & 0x01:
            if transfer.size and len(transfer.data) < transfer.size:
                raise SdoError(Abort.TOO_SHORT)
            self._dictionary.download(transfer.index, transfer.sub, bytes(transfer.data))
            self._transfer = None
        return bytes([0x20 | data[0] & _TOGGLE]) + bytes(7)

    def _upload_segment(self, data: bytes, t_ns: int) -> bytes:
        transfer = self._going_on(data, t_ns, upload=True)
        segment = bytes(transfer.data[:7])
        del transfer.data[:7]
        last = not transfer.data
        if last:
            self._transfer = None
        return bytes([data[0] & _TOGGLE | (7 - len(segment)) << 1 | last]) + segment.ljust(7, b"\0")
