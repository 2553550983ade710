"""Text files as editors, other programs and crashes leave them: bytes to text, and TOML, JSON and tables from it. What
is good is used; what was repaired, assumed or left out is listed with its line.
"""

from __future__ import annotations

import codecs
import csv
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, NoReturn, TypeVar

MOST_ODD = 200
"""Odd lines of a file after which the rest is no TOML; and lost lines of a table that are listed."""
MOST_NAMED = 5
"""Lost lines that an error message lists."""


class Remark(NamedTuple):
    """What is odd in a line: its number (from 1; 0: the whole file), the text there, and what was assumed. ``lost``:
    whether content of the file is missing from what was read.
    """

    line: int
    value: str
    assumed: str
    lost: bool = False

    def __str__(self) -> str:
        where = f"line {self.line}: " if self.line else ""
        return f"{where}{self.value!r}: {self.assumed}" if self.value else f"{where}{self.assumed}"


def listed(remarks: Iterable[Remark]) -> str:
    """The first of the remarks as one text, with the number of the others."""
    texts = [str(remark) for remark in remarks]
    more = [f"{len(texts) - MOST_NAMED} more"] if len(texts) > MOST_NAMED else []
    return "; ".join(texts[:MOST_NAMED] + more)


_Content = TypeVar("_Content")


def complete(read: tuple[_Content, list[Remark]]) -> _Content:
    """The content of a file of which nothing may be missing. Raises ValueError that lists what was left out."""
    content, remarks = read
    if lost := [remark for remark in remarks if remark.lost]:
        raise ValueError(listed(lost))
    return content


# -- bytes to text --------------------------------------------------------------------------------------------


def decoded_text(raw: bytes) -> tuple[str, list[Remark]]:
    r"""Text of a file's bytes, its lines ending in ``\n``, and what is odd. By its byte order mark or its zeros it is
    UTF-16, else UTF-8, in which bytes that are none are in code page 1252.
    """
    remarks = []
    zeros = [raw[k:2000:2].count(0) * 5 > len(raw[:2000]) for k in (0, 1)]
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or any(zeros) != all(zeros):
        encoding = "utf-16-le" if raw.startswith(codecs.BOM_UTF16_LE) or zeros[1] else "utf-16-be"
        remarks.append(Remark(1, "", f"the file is in {encoding.upper()}"))
        text = raw.decode(encoding, "replace")
    else:
        try:
            text = raw.decode()
        except UnicodeDecodeError as error:
            line, cut = len(_LINE_ENDS.findall(raw[: error.start])) + 1, error.reason == "unexpected end of data"
            found = f"byte 0x{raw[error.start]:02x} is not UTF-8: such bytes are read in code page 1252"
            remarks.append(Remark(line, "", "the file ends inside a character" if cut else found, cut))
            text = raw[: error.start].decode() if cut else raw.decode(errors=_IN_1252)
    if "\0" in text:
        remarks.append(Remark(0, "", f"{text.count(chr(0))} zero bytes, as a crash leaves them: left out"))
    return re.sub(r"\r\n?", "\n", text.replace("\0", "").replace("\ufeff", "")), remarks


def _in_1252(error: UnicodeError) -> tuple[str, int]:
    """Replacement of bytes that are not UTF-8, and the position from which decoding continues."""
    assert isinstance(error, UnicodeDecodeError)
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


_IN_1252 = "stereoservo.cp1252"
codecs.register_error(_IN_1252, _in_1252)
_LINE_ENDS = re.compile(rb"\r\n|\r|\n")


# -- TOML -----------------------------------------------------------------------------------------------------


class _Repair(NamedTuple):
    """What replaces a ``pattern`` in a line that is no TOML, and ``what`` it is."""

    pattern: re.Pattern[str]
    by: str
    what: str


_REPAIRS = (
    _Repair(re.compile("[\u201c\u201d\u201e\u201f\u00ab\u00bb]"), '"', 'typographic quotation marks: read as "'),
    _Repair(re.compile("[\u2018\u2019\u201a]"), "'", "typographic quotation marks: read as '"),
    _Repair(re.compile("[\u00a0\u2000-\u200b\u202f\u3000]"), " ", "blanks of another kind: read as blanks"),
    _Repair(re.compile(r"^(\s*)(;|//)"), r"\1#", "read as a remark, which in TOML begins with #"),
    _Repair(re.compile(r"(=\s*[-+]?[0-9]+),([0-9]+)(?=\s*(?:[,}#]|$))"), r"\1.\2", "a decimal comma: read as a point"),
    _Repair(re.compile(r"(=\s*)(True|TRUE|yes|Yes|on)(?=\s*(?:[,}#]|$))"), r"\1true", "read as true"),
    _Repair(re.compile(r"(=\s*)(False|FALSE|no|No|off)(?=\s*(?:[,}#]|$))"), r"\1false", "read as false"),
    _Repair(re.compile(r"\"([^\"']*\\[^\"']*)\""), r"'\1'", "a backslash: taken as it is"),
    _Repair(re.compile(r"^(\s*\[[^\[\]#]*[^\[\]#\s])\s*$"), r"\1]", "a header without ']': taken as one"),
)
_KEY = re.compile(r"""\s*(?:[\w."'-]{1,60}\s*=|\[[\w.\s\[\]-]{1,60})""")
"""What of a line is no value."""
_PLACE = re.compile(r" \(at (?:line ([0-9]+), column [0-9]+|end of document)\)")


def toml_of(raw: bytes) -> tuple[dict[str, Any], list[Remark]]:
    """Content of a TOML file, and what is odd in it. Remarks show of a line only its key: values may be secrets.

    A line that cannot be repaired is left out, a header with all below it. Raises ValueError for anything but TOML.
    """
    text, remarks = decoded_text(raw)
    lines = text.split("\n")
    repaired: dict[int, str] = {}
    for _ in range(MOST_ODD):
        try:
            return tomllib.loads("\n".join(lines)), sorted(remarks)
        except tomllib.TOMLDecodeError as error:
            place = _PLACE.search(str(error))
            last = max((k for k, line in enumerate(lines) if line.strip()), default=0)
            at = min(int(place[1]) - 1, last) if place is not None and place[1] else last
            cause = str(error)[: place.start()] if place is not None else str(error)
        except RecursionError as error:
            raise ValueError("is nested too deeply") from error
        line = lines[at]
        shown = _KEY.match(line)
        key = repaired[at] if at in repaired else shown[0].strip(" \t=") if shown is not None else ""
        for repair in _REPAIRS if at not in repaired else ():
            lines[at], count = repair.pattern.subn(repair.by, lines[at])
            if count:
                remarks.append(Remark(at + 1, key, repair.what))
        if lines[at] == line:
            _leave_out(lines, at)
            remarks = [remark for remark in remarks if remark.line != at + 1 or remark.lost]
            remarks.append(Remark(at + 1, key, f"{cause[:1].lower()}{cause[1:]}: left out", lost=True))
        repaired[at] = key
    raise ValueError(f"has more than {MOST_ODD} odd lines, the first ones: {listed(sorted(remarks))}")


def _leave_out(lines: list[str], at: int) -> None:
    """Empty a line, and if it is a header, all below it up to the next one."""
    end = at + 1
    if lines[at].lstrip().startswith("["):
        end = next((k for k in range(end, len(lines)) if lines[k].lstrip().startswith("[")), len(lines))
    lines[at:end] = [""] * (end - at)


# -- JSON -----------------------------------------------------------------------------------------------------


_JSON_TOKEN = re.compile(
    r"""(?P<string>"(?:[^"\\\n]|\\.)*")|(?P<unended>"(?:[^"\\\n]|\\.)*\Z)|(?P<quoted>'(?:[^'"\\\n]|\\.)*')|(?P<remark>//[^\n]*|\#[^\n]*|/\*.*?\*/)"""
    r"""|(?P<open>[\[{])|(?P<close>[\]}])|(?P<comma>,)|(?P<word>[-+]?[A-Za-z_]+\b)|(?P<space>\s+)|(?P<other>[^\s,\[\]{}"'/#]+|.)""",
    re.DOTALL,
)
_HALF = re.compile(r"\\u[dD][89a-fA-F]")
_WORDS = {"True": "true", "False": "false", "None": "null", "nan": "null", "inf": "null"}
_WORDS |= dict.fromkeys(("NaN", "Infinity", "-Infinity", "+Infinity", "-inf", "+inf", "-nan", "undefined"), "null")


def json_of(raw: bytes) -> tuple[Any, list[Remark]]:
    """Content of a JSON file, and what is odd in it: remarks and commas before a bracket are left out, numbers that are
    not finite are None, and a file that is cut is read up to the cut. Raises ValueError with the line.
    """
    text, remarks = decoded_text(raw)
    try:
        return _strict_json(text), remarks
    except ValueError:
        clean, odd = _clean_json(text)
    except RecursionError as error:
        raise ValueError("is nested too deeply") from error
    try:
        return _strict_json(clean), sorted([*remarks, *odd])
    except RecursionError as error:
        raise ValueError("is nested too deeply") from error


def _strict_json(text: str) -> Any:
    """Value of a text in JSON, without NaN, Infinity and half characters. Raises ValueError."""
    import json  # here: servo processes import this module, and read none

    try:
        value = json.loads(text, parse_constant=_no_number)
    except json.JSONDecodeError as error:
        raise ValueError(f"line {error.lineno}: {error.msg}") from error
    if _HALF.search(text):
        json.dumps(value, ensure_ascii=False).encode()
    return value


def _no_number(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number of JSON")


def _clean_json(text: str) -> tuple[str, list[Remark]]:
    """The text as strict readers take it, with its lines, and what was odd; cut behind the last complete value."""
    parts: list[str] = []
    remarks: list[Remark] = []
    complete, line, comma, depth = 0, 1, -1, 0
    for token in _JSON_TOKEN.finditer(text):
        kind, value = token.lastgroup, token[0]
        if kind == "unended":
            break
        if kind == "remark":
            remarks.append(Remark(line, value[:60], "a remark: left out"))
            value = "\n" * value.count("\n")
        elif kind == "quoted":
            remarks.append(Remark(line, "", "quoted by ': read as by \""))
            value = f'"{value[1:-1]}"'
        elif kind == "word" and value in _WORDS:
            remarks.append(Remark(line, value, f"read as {_WORDS[value]}"))
            value = _WORDS[value]
        elif kind == "close" and comma >= 0:
            remarks.append(Remark(line, f",{value}", "a comma before a bracket: left out"))
            parts[comma] = ""
        depth += (kind == "open") - (kind == "close")
        if kind == "comma":
            complete = len(parts)
        parts.append(value)
        if kind in ("open", "close"):
            complete = len(parts)
        if kind not in ("space", "remark"):
            comma = len(parts) - 1 if kind == "comma" else -1
        line += token[0].count("\n")
    if depth <= 0:
        return "".join(parts), remarks
    del parts[complete:]
    ends: list[str] = []
    for part in parts:
        if part in ("[", "{"):
            ends.append("]" if part == "[" else "}")
        elif part in ("]", "}") and ends:
            ends.pop()
    line = "".join(parts).count("\n") + 1
    remarks.append(Remark(line, "", "the file ends inside of what begins here: left out", lost=True))
    return "".join((*parts, *reversed(ends))), remarks


# -- tables ---------------------------------------------------------------------------------------------------


class Table(NamedTuple):
    """Named ``columns``, ``rows`` with the line of each, by column, and ``remarks`` on what is odd."""

    columns: tuple[str, ...]
    rows: list[tuple[int, dict[str, str]]]
    remarks: list[Remark]


_DECIMAL_COMMA = re.compile(r"\s*[-+]?[0-9]+,[0-9]+(?:[eE][-+]?[0-9]+)?\s*")


def table_of(raw: bytes) -> Table:
    """A table with a header, of cells separated by commas, semicolons, tabs or blanks, and what is odd in it.

    Where something else separates the cells, numbers may have decimal commas. Rows of another number of cells than the
    header, such as a cut last one, are left out. Raises ValueError if there is no header.
    """
    text, remarks = decoded_text(raw)
    lines = [(number, line.strip(" \n")) for number, line in enumerate(text.split("\n"), 1) if line.strip(" ;,\t")]
    if lines and (stated := re.fullmatch("sep=(.)", lines[0][1], re.IGNORECASE)) is not None:
        remarks.append(Remark(*lines.pop(0), f"cells are separated by {stated[1]!r}"))
    if not lines:
        raise ValueError("holds no header and no row")
    heads = next((k for k, (_, line) in enumerate(lines) if not line.startswith("#")), len(lines))
    if heads and (heads == len(lines) or re.match("[-+.0-9]", lines[heads][1])):
        heads -= 1  # the last remark is the header
    remarks += [Remark(number, line[:60], "a remark: left out") for number, line in lines[:heads]]
    lines[: heads + 1] = [(lines[heads][0], lines[heads][1].removeprefix("#").strip())]
    count = Counter(lines[0][1])
    separator = next((mark for mark in ";\t,|" if count[mark] and count[mark] >= count[","]), " ")
    (_, header), *cells = _cells(lines, separator)
    columns = [name.strip() for name in header]
    width = len(columns) - (columns[-1] == "")
    rows = []
    commas: list[Remark] = []
    for number, row in cells:
        found = row[:width] if len(row) == width + 1 and not row[-1].strip() else row
        if len(found) != width or columns[:width] == [cell.strip() for cell in found]:
            shown = separator.join(row)[:60]
            remarks.append(Remark(number, shown, f"{len(found)} cells, {width} are needed: left out", lost=True))
            continue
        if separator != "," and any(map(_DECIMAL_COMMA.fullmatch, found)):
            commas.append(Remark(number, separator.join(row)[:60], "decimal commas: read as points"))
            found = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in found]
        rows.append((number, dict(zip(columns, (cell.strip() for cell in found), strict=False))))
    return Table(tuple(columns[:width]), rows, sorted([*remarks[:MOST_ODD], *commas[:1]]))


def _cells(lines: list[tuple[int, str]], separator: str) -> Iterator[tuple[int, list[str]]]:
    for number, line in lines:
        if separator == " ":
            yield number, line.split()
        else:
            yield number, next(csv.reader([line], delimiter=separator, skipinitialspace=True))
