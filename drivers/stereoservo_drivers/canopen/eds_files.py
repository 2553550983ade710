"""EDS and DCF files (CiA 306) as makers' tools, editors and crashes leave them: bytes to text, text to sections, each
object taken or skipped by itself. What was repaired, assumed or skipped is listed with its line.

The package ``canopen`` gets a clean text of the objects that were taken: it refuses a file as a whole.
"""

from __future__ import annotations

import io
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from stereoservo.messages.text_files import Remark, decoded_text
from stereoservo.ports.devices import DriverError

if TYPE_CHECKING:
    import canopen

MOST_BYTES = 1_000_000
"""Largest file that is read [bytes]; the largest of the makers' files with which it is tested has 140 000."""
MOST_REMARKS = 200
"""Remarks that are listed of one file, the first ones."""


def read_eds(path: Path, node_id: int | None = None) -> tuple[canopen.ObjectDictionary, list[Remark]]:
    """Object dictionary of an EDS or DCF file, and what is odd in the file, by line. ``node_id``: for values relative
    to it; None: the file's own, if it has one.

    Raises:
        DriverError: ``eds``: the file cannot be read, is larger than ``MOST_BYTES``, or holds no usable object.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MOST_BYTES + 1)
    except OSError as error:
        raise DriverError("eds", f"{path} cannot be read: {error.strerror}", path=str(path)) from error
    if len(raw) > MOST_BYTES:
        raise DriverError("eds", f"{path} is larger than {MOST_BYTES} bytes: no EDS file", path=str(path))
    text, remarks = clean_eds(raw)
    if not text:
        first = next((str(remark) for remark in remarks if remark.line), f"it begins with {raw[:40]!r}")
        raise DriverError(
            "eds",
            f"{path} holds no object of CiA 306 (a section such as [1000] with ParameterName and DataType): {first}; "
            "give the drive's EDS, or leave eds out for the shipped one",
            path=str(path),
        )
    from canopen import import_od  # slow import: only for access to drives

    source = io.StringIO(text)
    source.name = ".eds"  # type: ignore[attr-defined]  # by which canopen knows the format
    return import_od(source, node_id), remarks


def clean_eds(raw: bytes) -> tuple[str, list[Remark]]:
    """Text of the usable objects of a file's bytes, as strict readers take it (empty: there are none), and what is odd,
    by line.
    """
    reader = _EdsReader(raw)
    objects = reader.objects()
    text = "".join((*reader.device(), *objects)) if objects else ""
    return text, sorted(reader.remarks, key=lambda remark: remark.line)


_WHOLE = ""
"""Place of an object's own section among those of its members, by sub-index, and of their names (``name``)."""
VAR, DOMAIN, ARRAY, RECORD = 7, 2, 8, 9
_NOT_READ = (0, 5, 6)
"""Object types without a value: NULL, and definitions of types."""
_BYTES, _LAST_TYPE = 0x0F, 0x1B
_NO_INTEGERS = frozenset((8, 9, 10, 11, 12, 13, _BYTES, 17))
"""Data types of reals, texts, bytes and times."""
_ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
_DEVICE_TEXTS = ("VendorName", "ProductName", "OrderCode")
_DEVICE_NUMBERS = ("VendorNumber", "ProductNumber", "RevisionNumber")
_DUMMIES = tuple(f"Dummy{k:04d}" for k in range(1, 8))
_VALUES = ("LowLimit", "HighLimit", "DefaultValue", "ParameterValue")
_BESIDE = ("StorageLocation", "Factor", "Description", "Unit")
_OTHERS = [
    "ParameterName",
    "ObjectType",
    "DataType",
    "AccessType",
    "PDOMapping",
    "CompactSubObj",
    "NrOfEntries",
    "NodeID",
]
_KEYS = {key.lower(): key for key in (*_OTHERS, *_VALUES, *_BESIDE, *_DEVICE_TEXTS, *_DEVICE_NUMBERS, *_DUMMIES)}
"""Keys that are read, as strict readers spell them."""
_LISTS = ("mandatoryobjects", "optionalobjects", "manufacturerobjects")

_COMMENT = re.compile(r"^\s*[;#].*|\s;.*")
_HEADER = re.compile(r"\[([^\]]*)(\]?)(.*)")
_OBJECT = re.compile(r"(?:0x)?([0-9a-f]{4})(?:sub(?:0x)?0*([0-9a-f]{1,2})|(name))?")
_TYPE_DEFINITION = re.compile(r"[0-9a-f]{1,3}(sub[0-9a-f]+)?")
_PLAIN_NUMBER = re.compile(r"-?(?:0x[0-9a-f]{1,16}|0{1,20}|[1-9][0-9]{0,19})", re.IGNORECASE)
_ODD_NUMBER = re.compile(
    r"\+?(-?)(?:(?:0x|\$|16#)([0-9a-f]{1,16})|([0-9][0-9a-f]{0,15})h|([0-9]{1,20})(?:\.0*)?|([0-9a-f]{1,16}))u?l{0,2}"
)
_SWITCHES = {"true": 1, "yes": 1, "on": 1, "false": 0, "no": 0, "off": 0}


def number_in(text: str) -> int | None:
    """Integer that a value of an EDS means: decimal also with leading zeros, hexadecimal as ``0x1F``, ``1Fh``, ``$1F``
    or with letters alone; without quotation marks, remarks and suffixes of C. None if it is none.
    """
    text = re.split(r"[;/(]|(?<!16)#", "".join(text.split()).strip("\"'").lower())[0]
    match = _ODD_NUMBER.fullmatch(text)
    if match is None:
        return _SWITCHES.get(text)
    sign, prefixed, suffixed, decimal, bare = match.groups()
    if bare and (len(bare) % 2 or bare.isalpha()):
        return None
    return int(sign + (decimal or prefixed or suffixed or bare), 10 if decimal else 16)


@dataclass(slots=True)
class _Section:
    """A section: ``name`` in small letters without blanks, first ``line``, and ``entries``: key -> value and line."""

    name: str
    line: int
    entries: dict[str, tuple[str, int]] = field(default_factory=dict)

    def get(self, key: str) -> str:
        return self.entries.get(key, ("",))[0]


class _EdsReader:
    """Reads one file; ``remarks`` collects what is odd."""

    def __init__(self, raw: bytes) -> None:
        text, self.remarks = decoded_text(raw)
        self._sections = self._split(text)
        self._named = {section.name: section for section in reversed(self._sections)}

    def _odd(self, line: int, value: str, assumed: str) -> None:
        if len(self.remarks) < MOST_REMARKS:
            self.remarks.append(Remark(line, value[:60], assumed))

    def _split(self, text: str) -> list[_Section]:
        """Sections of the text in order; of a key that occurs twice the first value."""
        found = [_Section("", 0)]
        for number, raw in enumerate(text.split("\n"), 1):
            line = _COMMENT.sub("", raw).strip()
            if line.endswith("]") and "=" not in line and not line.startswith("["):
                self._odd(number, line, "a header without '[': taken as one")
                line = f"[{line}"
            header = _HEADER.match(line)
            if header is not None:
                if not header[2]:
                    self._odd(number, line, "a header without ']': taken as one")
                found.append(_Section("".join(header[1].split()).lower(), number))
                line = header[3].strip()
            if line:
                self._add(found, line, number)
        return found[1:]

    def _add(self, found: list[_Section], line: str, number: int) -> None:
        """Add a line to the last section; start a nameless one where a header is missing."""
        section = found[-1]
        match = re.match("([^=:]*)[=:](.*)", line)
        if match is None or len(found) == 1:
            where = "neither a header nor KEY=VALUE" if match is None else "stands before any section"
            self._odd(number, line, f"{where}: skipped")
            return
        key, value = "".join(match[1].split()), match[2].strip()
        key = _KEYS.get(key.lower(), key)
        if key == "ParameterName" and len(section.entries) > 1 and section.get(key) not in ("", value):
            self._odd(number, line, "the header of this object is missing: skipped up to the next header")
            section = _Section("", number)
            found.append(section)
        if section.entries.setdefault(key, (value, number))[0] != value and section.name:
            self._odd(number, line, f"{key} of [{section.name}] again: the first, {section.get(key)[:60]!r}, is used")

    def _number(self, section: _Section, key: str) -> str | None:
        """A key's number as strict readers take it; None if it is missing, empty or not readable."""
        value, line = section.entries.get(key, ("", 0))
        if not value or _PLAIN_NUMBER.fullmatch(value):
            return value or None
        number = number_in(value)
        octal = int(value, 8) if number is not None and re.fullmatch("0[0-7]+", value) else number
        assumed = "not a number: left out" if number is None else f"read as {number}"
        self._odd(line, f"{key}={value}", assumed + f" (octal, as CiA 306 has it: {octal})" * (octal != number))
        return None if number is None else str(number)

    # -- objects -------------------------------------------------------------------------------------

    def objects(self) -> list[str]:
        """Texts of the usable objects in order, each with its members; empty if none has a value."""
        grouped: dict[int, dict[int | str, list[_Section]]] = defaultdict(lambda: defaultdict(list))
        for section in self._sections:
            match = _OBJECT.fullmatch(section.name)
            if match is not None:
                sub = int(match[2], 16) if match[2] else match[3] or _WHOLE
                grouped[int(match[1], 16)][sub].append(section)
            elif section.get("ParameterName") and section.name and not _TYPE_DEFINITION.fullmatch(section.name):
                self._odd(section.line, f"[{section.name}]", "not the header of an object: skipped")
        self._restore(grouped)
        texts = [self._object(index, parts) for index, parts in grouped.items() if _WHOLE in parts]
        return [text for text in texts if text] if any("\nDataType=" in text for text in texts) else []

    def _restore(self, grouped: dict[int, dict[int | str, list[_Section]]]) -> None:
        """Add records for members whose own object is missing, where the file's lists name it."""
        lists = [section.entries.items() for section in self._sections if section.name in _LISTS]
        told = {number_in(value) for entries in lists for key, (value, _) in entries if key.isdecimal()}
        listed = {index for index in told if index is not None}
        described = {index for index, parts in grouped.items() if _WHOLE in parts}
        if lost := sorted(listed - described):
            self._odd(0, "", f"{len(lost)} of {len(listed)} listed objects are missing, the first 0x{lost[0]:04X}")
        if listed and (beside := sorted(described - listed)):
            among = f"{len(beside)} of {len(described)} objects are in none of the file's lists"
            self._odd(0, "", f"{among}, the first 0x{beside[0]:04X}: taken all the same")
        for index in grouped.keys() - described:
            section = next(iter(grouped[index].values()))[0]
            if index in lost and described <= listed:  # otherwise a damaged header may stand for it
                grouped[index][_WHOLE] = [_Section("", section.line, {"ObjectType": ("9", section.line)})]
            assumed = "taken for a record" if _WHOLE in grouped[index] else "skipped"
            self._odd(section.line, f"[{section.name}]", f"[{index:04X}] is missing: {assumed}")

    def _object(self, index: int, parts: dict[int | str, list[_Section]]) -> str:
        """Text of an object with its members; empty if it is not usable."""
        subs = [sub for sub in parts if isinstance(sub, int)]
        kind, text = self._first_usable(parts[_WHOLE], f"{index:04X}", RECORD if subs else VAR)
        if kind in (VAR, DOMAIN) and subs:
            self._odd(parts[_WHOLE][0].line, f"[{index:04X}]", "neither an array nor a record: without its members")
        if kind not in (ARRAY, RECORD):
            return text
        members = {sub: self._first_usable(parts[sub], f"{index:04X}sub{sub:X}", 0)[1] for sub in subs}
        text += "".join(members.values())
        if "name" in parts and kind == ARRAY and ("\nCompactSubObj=" in text or members.get(1)):
            section = parts["name"][0]
            count = min(int(self._number(section, "NrOfEntries") or "0", 0), 0xFE)
            names = [f"{sub}={section.get(str(sub)) or sub}\n" for sub in range(1, count + 1)]
            text += "".join((f"[{index:04X}Name]\nNrOfEntries={count}\n", *names))
        if "\nDataType=" in text or parts[_WHOLE][0].get("ParameterName"):
            return text
        self._odd(parts[_WHOLE][0].line, f"[{index:04X}]", "neither a name nor members: skipped")
        return ""

    def _first_usable(self, sections: list[_Section], header: str, kind: int) -> tuple[int, str]:
        """Object type and text of the first usable one of an object's sections; (0, "") if there is none."""
        for section in sections[1:]:
            self._odd(section.line, f"[{header}]", f"as in line {sections[0].line}: the first good one is used")
        return next((taken for section in sections if (taken := self._taken(section, header, kind))[1]), (0, ""))

    def _taken(self, section: _Section, header: str, kind: int) -> tuple[int, str]:
        """Object type and text of a section; no text if it has no value or its data type is missing. ``kind``: object
        type where none is told; 0 for a member.
        """
        stated = int((self._number(section, "ObjectType") if kind else None) or str(kind or VAR), 0)
        if stated in _NOT_READ:
            return 0, ""
        if stated not in (VAR, DOMAIN, ARRAY, RECORD):
            self._odd(section.entries["ObjectType"][1], f"ObjectType={stated}", f"unknown: taken for {kind}")
            stated = kind
        name = section.get("ParameterName")
        if not name:
            self._odd(section.line, f"[{header}]", "without ParameterName: named by its number")
        lines = [f"[{header}]", f"ParameterName={name or header}", f"ObjectType={stated}"]
        lines += [f"{key}={section.get(key)}" for key in _BESIDE if key in section.entries]
        compact = stated == ARRAY and "CompactSubObj" in section.entries
        if compact or stated in (VAR, DOMAIN):
            data_type = self._data_type(section, stated)
            if not data_type:
                self._odd(section.line, f"[{header}]", "without a data type: skipped")
                return 0, ""
            lines += ["CompactSubObj=1"] * compact + [f"DataType={data_type}", *self._values(section, data_type)]
        return stated, "\n".join((*lines, ""))

    def _data_type(self, section: _Section, kind: int) -> int:
        """Number of the data type; that of bytes for one that neither standard nor file define; 0 if it is missing."""
        told = max(int(self._number(section, "DataType") or "0", 0), 0) or _BYTES * (kind == DOMAIN)
        if told <= _LAST_TYPE:
            return told
        meant = number_in(self._named.get(f"{told:x}sub1", _Section("", 0)).get("DefaultValue"))
        if meant is not None and 0 < meant <= _LAST_TYPE:
            return meant
        self._odd(section.entries["DataType"][1], f"DataType={told}", "not of the standard: taken for bytes")
        return _BYTES

    def _values(self, section: _Section, data_type: int) -> Iterator[str]:
        """Lines of a value's access and numbers; those of an object that is no integer as they stand."""
        told, line = section.entries.get("AccessType", ("", section.line))
        access = re.sub("[^a-z]", "", told.lower())
        if access not in _ACCESS:
            self._odd(line, f"AccessType={told}", f"not one of {', '.join(_ACCESS)}: taken for rw")
        yield f"AccessType={access if access in _ACCESS else 'rw'}"
        for key in ("PDOMapping", *_VALUES):
            value: str | None = section.get(key)
            if value and (key == "PDOMapping" or not (data_type in _NO_INTEGERS or "$" in value)):
                value = self._number(section, key)
            if value or (key in _VALUES and key in section.entries and value is not None):
                yield f"{key}={value}"

    # -- the device ----------------------------------------------------------------------------------

    def device(self) -> Iterator[str]:
        """Lines of the sections on the device as a whole."""
        info, dummies, own = (self._named.get(name) for name in ("deviceinfo", "dummyusage", "devicecomissioning"))
        yield "[DeviceInfo]\n"
        if info is None:
            self._odd(0, "", "no [DeviceInfo]: vendor and product are not compared with the drive's")
        else:
            yield from (f"{key}={info.get(key)}\n" for key in _DEVICE_TEXTS if key in info.entries)
            yield from (f"{key}={value}\n" for key in _DEVICE_NUMBERS if (value := self._number(info, key)))
        if dummies is not None:
            yield "[DummyUsage]\n"
            yield from (f"{key}={int(number_in(dummies.get(key)) == 1)}\n" for key in _DUMMIES)
        node = int(self._number(own, "NodeID") or "0", 0) if own is not None else 0
        if 0 < node < 128:
            yield f"[DeviceComissioning]\nNodeID={node}\n"
