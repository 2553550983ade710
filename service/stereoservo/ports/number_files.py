"""Numbers in files of any kind (text, CSV, JSON, YAML, XML, NumPy) as tables of records, whatever separates or names
them. A file may be understood as several tables; damaged records are NaN, so that the others keep their order.
"""

from __future__ import annotations

import csv
import io
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree
from zipfile import BadZipFile

import numpy as np
import yaml

from stereoservo.messages.text_files import Remark, decoded_text, json_of
from stereoservo.numerics.arrays import FloatArray

LARGEST_FILE = 50_000_000
FREQUENT = 0.4
"""Share of the records from which a column is one of the table."""
DEEPEST = 5
"""Levels of a JSON, YAML or XML file down to which records are searched."""
SHORT = 20
"""Most numbers of a text that may be one record."""
MOST_REMARKS = 20


class NumberFileError(Exception):
    """A file cannot be read: the message names it and the cause."""


class Table(NamedTuple):
    """Records as columns: ``fields`` by name (n, k), NaN where a record lacks one; ``labels`` and ``lines``
    (or numbers, from 1) of the records; what is odd.
    """

    fields: dict[str, FloatArray]
    labels: list[str]
    lines: list[int]
    remarks: list[Remark]


class _Record(NamedTuple):
    line: int
    label: str
    fields: dict[str, list[float]]


_Records = tuple[list[_Record], list[Remark]]
_NUMBER = re.compile(r"[-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eEdD][-+]?\d+)?|[-+]?(?:nan|inf)", re.IGNORECASE)
_CALL = re.compile(
    r"(?:\b[A-Za-z_][\w.]*\s*[:=]\s*)?(?:\b[A-Za-z_][\w.]*\s*)?(?=[\[({]\s*[-+.\d\[({])|\bdtype\s*=\s*[\w.]+"
)
"""What stands before a bracket in a program's text: ``T1 = np.array([…], dtype=float)``."""
_NAMED = re.compile(r"(?:\b[A-Za-z_]\w*\s*[=:]\s*|(?<![\w.])[A-Za-z][xyzXYZ]?\s+)(?=[-+.\d])")
_COMMENT = re.compile(r"(?:#|%|//)+\s*")


def read_tables(paths: Sequence[Path]) -> Iterator[Table]:
    """The tables that a file may be, or the one of several files with one record each. Raises NumberFileError."""
    if len(paths) == 1:
        yield from (_table(*records) for records in _record_lists(paths[0]))
        return
    records, remarks = [], []
    for k, path in enumerate(paths):
        fields: dict[str, list[float]] = {}
        for found, odd in _record_lists(path):
            if len(found) == 1:
                fields = found[0].fields | fields
                remarks += [one._replace(value=f"{path.name} {one.value}") for one in odd if k == 0 or one.lost]
        records.append(_Record(0, path.name, fields))
    yield _table(records, list(dict.fromkeys(remarks)))


def _table(records: list[_Record], remarks: list[Remark]) -> Table:
    count = Counter((name, len(values)) for one in records for name, values in one.fields.items())
    fields = {}
    for name, size in (key for key, times in count.items() if times > FREQUENT * len(records)):
        rows = [one.fields.get(name, []) for one in records]
        fields[name] = np.array([row if len(row) == size else [np.nan] * size for row in rows], dtype=np.float64)
    return Table(fields, [one.label for one in records], [one.line for one in records], remarks[:MOST_REMARKS])


def _record_lists(path: Path) -> Iterator[_Records]:
    trees, text, remarks = _content(path)
    for tree, odd in trees:
        for items in _lists(tree):
            yield [_record(k, label, item) for k, (label, item) in enumerate(items, 1)], odd
    for records, odd in _text_records(text):
        yield records, [*remarks, *odd]


def read_tree(path: Path) -> Any:
    """Content of a JSON, YAML or XML file as dicts, lists, strings and numbers. Raises NumberFileError."""
    trees, _, _ = _content(path)
    if not trees:
        raise NumberFileError(f"{path} is neither JSON nor YAML nor XML")
    return trees[0][0]


def _content(path: Path) -> tuple[list[tuple[Any, list[Remark]]], str, list[Remark]]:
    """Trees that a file may be, its text, and what is odd in it."""
    try:
        with path.open("rb") as file:
            raw = file.read(LARGEST_FILE + 1)
        if len(raw) > LARGEST_FILE:
            raise ValueError(f"it has more than {LARGEST_FILE} bytes")
        if raw[:6] == b"\x93NUMPY" or raw[:4] == b"PK\3\4":
            return [(_arrays(raw), [])], "", []
        text, remarks = decoded_text(raw)
        return list(_trees(text, remarks)), text, remarks
    except (OSError, ValueError, EOFError, RecursionError, BadZipFile, zlib.error, NotImplementedError) as error:
        raise NumberFileError(f"{path} cannot be read: {error}") from error


# -- JSON, YAML, XML and NumPy ---------------------------------------------------------------------------------


def _arrays(raw: bytes) -> Any:
    loaded = np.load(io.BytesIO(raw), allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return _stacked(loaded)
    return {name: _stacked(loaded[name]) for name in loaded.files}


def _stacked(array: np.ndarray[Any, Any]) -> Any:
    """An array as lists; of matrices (3 or 4, 4, n) with the last axis first."""
    last = array.ndim == 3 and array.shape[1] == 4 and array.shape[0] in (3, 4) and array.shape[2] != 4
    return (np.moveaxis(array, -1, 0) if last else array).tolist()


def _trees(text: str, remarks: list[Remark]) -> Iterator[tuple[Any, list[Remark]]]:
    begin = text.lstrip()[:1]
    if begin == "<":
        yield from _xml(text, remarks)
    elif begin not in ("[", "{") and re.search(r"^\s*(?:- |[\w\"'][^:\n,;]*:(?:\s|$))", text, re.MULTILINE):
        yield from _yaml(text, remarks)
    elif "[" in text or begin == "{":
        bare = _CALL.sub("", text).translate(_SQUARE)
        for parts in ([text], [line for line in text.split("\n") if line], [bare]):
            try:
                made = [json_of(part.encode()) for part in parts]
            except ValueError:
                continue
            trees = [_plain(tree) for tree, _ in made]
            yield trees[0] if len(trees) == 1 else trees, [*remarks, *(odd for _, one in made for odd in one)]
            return
        yield from _yaml(re.sub(r"^(?=\[)", "- ", bare, flags=re.MULTILINE), remarks)


_SQUARE = str.maketrans("()", "[]")


def _yaml(text: str, remarks: list[Remark]) -> Iterator[tuple[Any, list[Remark]]]:
    text = re.sub(r"^%YAML.*\n", "", text)
    if re.search(r"(?:^|[\s\[,:-])\*\w", text):
        return  # aliases of aliases grow without bound
    for _ in range(2):
        try:
            documents = [_plain(one) for one in yaml.load_all(text, _Yaml)]
        except yaml.MarkedYAMLError as error:
            mark = error.context_mark or error.problem_mark
            begin = max((one.start() for one in re.finditer(r"^\S", text[: mark.index], re.MULTILINE)), default=0)
            odd = "YAML is damaged from here on: left out"
            remarks = [*remarks, Remark(text.count("\n", 0, begin) + 1, text[begin:][:40], odd, True)]
            text = text[:begin]
        except (yaml.YAMLError, ValueError):
            return
        else:
            yield documents[0] if len(documents) == 1 else documents, remarks
            return


class _Yaml(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML whose own types, such as OpenCV's matrices, are mappings, sequences and texts."""


def _untyped(loader: Any, _suffix: str, node: Any) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else node.value


_Yaml.add_multi_constructor("tag:", _untyped)
_Yaml.add_multi_constructor("!", _untyped)
_Yaml.add_constructor("tag:yaml.org,2002:timestamp", lambda _, node: node.value)


def _xml(text: str, remarks: list[Remark]) -> Iterator[tuple[Any, list[Remark]]]:
    parser: Any = ElementTree.XMLPullParser(("start",))
    try:
        parser.feed(re.sub(r"^\s*<\?xml.*?\?>", lambda one: "\n" * one[0].count("\n"), text, flags=re.DOTALL))
        parser.close()
    except ElementTree.ParseError as error:
        remarks = [*remarks, Remark(error.position[0], "", f"XML is damaged ({error}): read up to here", True)]
    root = next((element for _, element in parser.read_events()), None)
    if root is not None:
        yield _plain(_of_element(root)), remarks


def _of_element(element: Any) -> Any:
    children: dict[str, Any] = {}
    for child in element:
        children.setdefault(child.tag, []).append(_of_element(child))
    found = {**element.attrib, **{tag: of[0] if len(of) == 1 else of for tag, of in children.items()}}
    text = (element.text or "").strip()
    return text if not found else {**found, "text": text} if text else found


def _plain(node: Any) -> Any:
    """The tree with OpenCV's matrices (rows, cols, data) as lists of rows, and names as texts."""
    if isinstance(node, list):
        return [_plain(value) for value in node]
    if not isinstance(node, dict):
        return node
    rows, columns, data = (_numbers(node.get(name)) for name in ("rows", "cols", "data"))
    if rows and columns and data and len(data) == rows[0] * columns[0]:
        return np.reshape(data, (int(rows[0]), int(columns[0]))).tolist()
    return {str(name): _plain(value) for name, value in node.items()}


def _numbers(node: Any) -> list[float] | None:
    """All numbers of a node that holds nothing else."""
    if isinstance(node, (int, float)) and not isinstance(node, bool):
        return [float(node)]
    if isinstance(node, str):
        parts = re.split(r"[\s,;]+", node.strip(" \n\t[]()"))
        return [_float(part) for part in parts] if all(map(_NUMBER.fullmatch, parts)) else None
    found = [_numbers(one) for one in node] if isinstance(node, list) else []
    return [value for one in found for value in one or []] if found and None not in found else None


def _lists(node: Any, level: int = 0) -> Iterator[list[tuple[str, Any]]]:
    """The lists of records that a tree may be, with their names: itself, its items, or its arrays side by side."""
    yield [("", node)]
    if isinstance(node, list) and level < DEEPEST:
        yield [("", one) for one in node]
        if len(node) == 1:
            yield from _lists(node[0], level + 1)
    elif isinstance(node, dict) and level < DEEPEST:
        inner = {name: value for name, value in node.items() if isinstance(value, (list, dict))}
        if len(inner) > 1:
            yield list(inner.items())
        for size in {len(value) for value in inner.values() if isinstance(value, list)} - {1}:
            same = {name: value for name, value in inner.items() if isinstance(value, list) and len(value) == size}
            yield [("", {name: value[k] for name, value in same.items()}) for k in range(size)]
        for value in inner.values():
            yield from _lists(value, level + 1)


def _record(line: int, label: str, item: Any) -> _Record:
    fields, files = {}, [label] if label else []
    for name, leaf in _leaves(item, "", 0):
        if isinstance(leaf, str):
            files += [leaf] if re.search(r"\d", leaf) and Path(leaf).suffix else []
        else:
            fields[name] = leaf
    return _Record(line, files[0] if files else "", fields)


def _leaves(node: Any, name: str, level: int) -> Iterator[tuple[str, Any]]:
    """Numbers and texts of a tree with their names."""
    values = _numbers(node)
    if values is not None or isinstance(node, str):
        yield name, node if values is None else values
    elif isinstance(node, (dict, list)) and level < DEEPEST:
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            yield from _leaves(value, f"{name}.{key}" if name else str(key), level + 1)


# -- text ------------------------------------------------------------------------------------------------------


class _Line(NamedTuple):
    """Cells of a line, and their ``values``, NaN for those that are no number."""

    number: int
    cells: list[str]
    values: list[float]

    @property
    def known(self) -> int:
        return int(np.isfinite(self.values).sum())


def _float(text: str) -> float:
    return float(re.sub("[dD]", "e", text.replace(",", ".")))


def _text_records(text: str) -> Iterator[_Records]:
    """The rows of a text, its blocks of rows that are matrices, and all of it."""
    lines = _lines(text)
    rows = [line for line in lines if line.known]
    if not rows:
        return
    yield _row_records(lines)
    yield _matrices(lines)
    values = [value for row in rows for value in row.values if np.isfinite(value)]
    if len(values) <= SHORT:
        yield [_Record(rows[0].number, "", {"": values})], []


def _lines(text: str) -> list[_Line]:
    bare = [_NAMED.sub(" ", _CALL.sub("", line)).translate(_BLANK).strip().rstrip(",") for line in text.split("\n")]
    content = [line for line in bare if line and not _COMMENT.match(line)]
    separator = next((mark for mark in ";\t|" if 2 * sum(mark in line for line in content) > len(content)), None)
    words = [cell for line in content[1:] for cell in line.split()]
    plain = len(words) >= 2 * len(content[1:]) > 0 and all(map(_NUMBER.fullmatch, words))
    if separator is None and plain and not re.search(r"\d\.\d", "\n".join(content)):
        separator = " "  # numbers may have decimal commas
    found = []
    for number, line in enumerate(bare, 1):
        comment = _COMMENT.match(line)
        cells = _cells(line[comment.end() :] if comment else re.split(r"\s(?:#|%|//)", line)[0], separator)
        values = [_float(cell) if _NUMBER.fullmatch(cell) and not comment else np.nan for cell in cells]
        found.append(_Line(number, cells, values))
    return found


_BLANK = str.maketrans("[](){}", "      ")


def _cells(line: str, separator: str | None) -> list[str]:
    if separator == " ":
        return line.split()
    if separator or '"' in line:
        cells = next(csv.reader([line], delimiter=separator or ",", skipinitialspace=True), [])
    else:
        cells = re.split(r"\s*,\s*" if re.search("[A-Za-z],|,.*[A-Za-z]", line) else r"[,\s]+", line)
    return [cell.strip(" '") for cell in cells] if any(cells) else []


def _row_records(lines: list[_Line]) -> _Records:
    """One record a row: the numbers of rows as wide as most, nothing of those that are damaged."""
    data = [line for line in lines if 2 * line.known >= max(1, len(line.cells))] or [
        line for line in lines if line.known
    ]
    width = Counter(len(line.cells) for line in data).most_common(1)[0][0]
    of_width = [line for line in lines if len(line.cells) == width]
    known = np.isfinite([line.values for line in of_width if line.known])
    columns, labels = (np.flatnonzero((known.mean(axis=0) > FREQUENT) == numeric) for numeric in (True, False))
    header = next((line for line in reversed(of_width) if not line.known and line.number < data[0].number), None)
    names = ["" if header is None else header.cells[k] for k in columns]
    records, remarks = [], []
    for line in lines:
        values = [line.values[k] for k in columns] if len(line.cells) == width else []
        if values and line.known:
            label = next((line.cells[k] for k in labels if re.search(r"\d", line.cells[k])), "")
            fields = {"": values} if header is None else {n: [v] for n, v in zip(names, values, strict=True)}
            records.append(_Record(line.number, label, fields))
        elif 2 * line.known >= width:
            records.append(_Record(line.number, "", {}))
        elif line.known:
            remarks.append(Remark(line.number, " ".join(line.cells)[:40], f"not {width} cells: left out", True))
    return records, remarks


def _matrices(lines: list[_Line]) -> _Records:
    """One record a run of rows of three or four numbers that ends with a row whose last number is 1, or after three."""
    counts = Counter(len(line.values) for line in lines if line.known == len(line.values))
    width = 4 if counts[4] >= counts[3] else 3
    closed = any(line.values[3:] == [1.0] for line in lines)
    most = 4 if closed or width == 3 else 3
    blocks: list[list[_Line]] = [[]]
    titles = [""]
    for line in lines:
        inside = line.known == len(line.values) == width
        last = blocks[-1][-1:]
        if last and (not inside or last[0].values[3:] == [1.0] or (not closed and len(blocks[-1]) == most)):
            blocks.append([])
            titles.append("")
        if inside:
            blocks[-1].append(line)
        elif line.cells:
            titles[-1] = " ".join(line.cells)
    found = [(title, block) for title, block in zip(titles, blocks, strict=True) if block]
    size = Counter(len(block) for _, block in found).most_common(1)[0][0] if found else 0
    return [
        _Record(block[0].number, title, {"": [v for row in block for v in row.values]} if len(block) == size else {})
        for title, block in found
    ], []
