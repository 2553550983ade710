"""Text files as editors, exporters and crashes leave them: read as a strict reader reads the text that was meant."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from corrupted import corrupted_copies
from stereoservo.messages.cell_file import CellFileError, load_cell_file
from stereoservo.messages.directories import directories_of
from stereoservo.messages.text_files import complete, decoded_text, json_of, table_of, toml_of

SHIPPED = Path(__file__).parents[2] / "deploy" / "cells" / "demo.toml"
MEANT = (
    'schema = 1\n[cell]\nname = "Zelle_Müller"\n[servo]\ngain = 1.5\nflag = true\n# ä\nrange = { a = 0.5, b = -2.25 }\n'
)


def lines(remarks: list) -> list[tuple[int, bool]]:
    return [(remark.line, remark.lost) for remark in remarks]


@pytest.mark.parametrize(
    ("raw", "odd"),
    [
        (MEANT.encode(), []),
        (MEANT.encode("utf-8-sig"), []),
        (MEANT.replace("\n", "\r\n").encode(), []),
        (MEANT.replace("\n", "\r").encode(), []),
        (MEANT.encode("utf-16"), [1]),
        (MEANT.encode("utf-16-be"), [1]),
        (MEANT.encode("cp1252"), [3]),
        (MEANT.encode() + bytes(100), [0]),
        (MEANT.replace('"', "”").encode(), [3]),
        (MEANT.replace('"Z', "„Z").replace('r"', "r“").encode(), [3]),
        (MEANT.replace("'", "‘").replace("gain = ", "gain\u00a0=\t").encode(), [5]),
        (MEANT.replace("1.5", "1,5").encode(), [5]),
        (MEANT.replace("1.5", "1,5  # decimal").encode(), [5]),
        (MEANT.replace("0.5", "0,5").replace("2.25", "2,25").encode(), [8]),
        (MEANT.replace("true", "True").encode(), [6]),
        (MEANT.replace("# ä", "; ä").encode(), [7]),
        (MEANT.replace("[servo]", "[servo").encode(), [4]),
        (MEANT.replace("=", "\t=\t").encode(), []),
    ],
)  # fmt: skip
def test_an_odd_toml_file_is_what_was_meant(raw: bytes, odd: list[int]) -> None:
    tree, remarks = toml_of(raw)
    assert tree == tomllib.loads(MEANT)
    assert lines(remarks) == [(line, False) for line in odd]


@pytest.mark.parametrize(
    ("old", "new", "line", "lost"),
    [
        ("gain = 1.5", "gain = 1.000,5", 5, {("servo", "gain")}),
        ("gain = 1.5", "gain 1.5", 5, {("servo", "gain")}),
        ("[servo]", "[ser vo]", 4, {("servo", "gain"), ("servo", "flag"), ("servo", "range")}),
        ("-2.25 }\n", "-2.2", 8, {("servo", "range")}),
        ("flag = true", "gain = 7", 6, {("servo", "flag")}),
    ],
)
def test_a_line_that_is_no_toml_is_left_out_alone(old: str, new: str, line: int, lost: set[tuple[str, str]]) -> None:
    assert old in MEANT
    tree, remarks = toml_of(MEANT.replace(old, new).encode())
    meant = tomllib.loads(MEANT)
    found = {(name, key) for name, of in tree.items() if isinstance(of, dict) for key in of}
    assert {("cell", "name"), *((name, key) for name in ("servo",) for key in meant[name])} - found == lost
    assert lines(remarks) == [(line, True)]
    with pytest.raises(ValueError, match=f"^line {line}: "):
        complete((tree, remarks))


def test_values_of_odd_lines_are_not_shown() -> None:
    for text in ('key = "hunter2', "key hunter2", 'x = ["hunter2"\n', '"""hunter2', "password = “hunter2”"):
        remarks = toml_of(text.encode())[1]
        assert remarks
        assert "hunter2" not in "".join(map(str, remarks))


def test_a_cell_file_that_windows_saved_is_the_shipped_one(tmp_path: Path) -> None:
    text = SHIPPED.read_text("utf-8")
    path = tmp_path / "cell.toml"
    head, gain, tail = text.partition("gain = 2.0")
    assert gain
    path.write_bytes(f"# für Müller\n{head}gain = 2,0{tail}".replace("\n", "\r\n").encode("cp1252", "replace"))
    odd: list = []
    assert load_cell_file(path, odd) == load_cell_file(SHIPPED)
    assert [remark.line for remark in odd] == [1, head.count("\n") + 2]
    assert directories_of(str(path)) == directories_of(str(SHIPPED))
    path.write_text(text.replace("\ngain = ", "\ngain = 1 + ", 1))
    line = text[: text.index("\ngain = ")].count("\n") + 2
    with pytest.raises(CellFileError, match=f"is not TOML: line {line}: 'gain'"):
        load_cell_file(path)


WHOLE = {"a": 1.5, "b": [1, 2, {"c": "x, ] // # y"}], "d": None, "e": True}
PLAIN = json.dumps(WHOLE, indent=1)


@pytest.mark.parametrize(
    ("text", "odd"),
    [
        (PLAIN, []),
        (PLAIN.replace("null", "NaN"), [10]),
        (PLAIN.replace("null", "-Infinity"), [10]),
        (PLAIN.replace("true", "True"), [11]),
        (PLAIN.replace("true", "true,"), [12]),
        (PLAIN.replace("2,", "2, // two, ]"), [5]),
        (PLAIN.replace("2,", "2, /* two\n ] */"), [5]),
        (f"# head\n{PLAIN}", [1]),
        (PLAIN.replace('"a"', "'a'"), [2]),
    ],
)
def test_an_odd_json_file_is_what_was_meant(text: str, odd: list[int]) -> None:
    for raw in (text.encode(), text.encode("utf-8-sig"), text.replace("\n", "\r\n").encode()):
        found, remarks = json_of(raw)
        assert found == WHOLE
        assert lines(remarks) == [(line, False) for line in odd]


def within(part: object, whole: object) -> bool:
    if isinstance(part, dict) and isinstance(whole, dict):
        return all(key in whole and within(value, whole[key]) for key, value in part.items())
    if isinstance(part, list) and isinstance(whole, list):
        return len(part) <= len(whole) and all(map(within, part, whole))
    return part == whole


def test_a_json_file_is_read_up_to_the_cut() -> None:
    kept = []
    for end in range(1, len(PLAIN) - 1):
        found, remarks = json_of(PLAIN[:end].encode())
        assert within(found, WHOLE), PLAIN[:end]
        assert remarks[-1].lost
        kept.append(len(json.dumps(found)))
    assert kept == sorted(kept)
    with pytest.raises(ValueError, match="line 2: "):
        json_of(b'{"a":\n 1 2}')


TABLE = [{"t": "0.5", "x": "-1.25", "name": "links"}, {"t": "1.0", "x": "3e-2", "name": "r"}]


@pytest.mark.parametrize(
    ("text", "numbers", "odd"),
    [
        ("t,x,name\n0.5,-1.25,links\n1.0,3e-2,r\n", [2, 3], []),
        ("t;x;name\n0,5;-1,25;links\n1,0;3e-2;r", [2, 3], [(2, False)]),
        ("sep=;\nt;x;name\n0.5;-1.25;links\n1.0;3e-2;r\n", [3, 4], [(1, False)]),
        ("t\tx\tname\n0.5\t-1.25\tlinks\n\n \n1.0\t3e-2\tr\n\n", [2, 5], []),
        ("# t x name\n0.5  -1.25 links\n1.0 3e-2 r\n", [2, 3], []),
        ("# of Monday\nt,x,name\n0.5,-1.25,links\n1.0,3e-2,r\n", [3, 4], [(1, False)]),
        ("t, x, name,\n0.5, -1.25, links,\n1.0, 3e-2, r,\n", [2, 3], []),
        ("t,x,name\n0.5,-1.25,links\n1.0,3e-2,r\n2.0,4", [2, 3], [(4, True)]),
        ("t,x,name\n0.5,-1.25,links\n1,2,3,4\n1.0,3e-2,r\n", [2, 4], [(3, True)]),
        ('"t","x","name"\n"0.5","-1.25","links"\n1.0,3e-2,"r"\n', [2, 3], []),
    ],
)
def test_an_odd_table_is_what_was_meant(text: str, numbers: list[int], odd: list[tuple[int, bool]]) -> None:
    for raw in (text.encode(), text.encode("utf-8-sig"), text.replace("\n", "\r\n").encode()):
        table = table_of(raw)
        assert [row for _, row in table.rows] == TABLE
        assert [line for line, _ in table.rows] == numbers
        assert lines(table.remarks) == odd


def test_bytes_that_are_no_utf8_are_those_of_code_page_1252() -> None:
    text, remarks = decoded_text("é\n€ü".encode() + "\nü€".encode("cp1252"))
    assert text == "é\n€ü\nü€"
    assert lines(remarks) == [(3, False)]
    text, remarks = decoded_text("abc\nü".encode()[:-1])
    assert text == "abc\n"
    assert lines(remarks) == [(2, True)]


@pytest.mark.parametrize("whole", [MEANT.encode(), PLAIN.encode(), b"t;x\n1,5;2\n3;4\n" * 20, MEANT.encode("utf-16")])
def test_of_corrupted_bytes_only_the_documented_refusal_escapes(whole: bytes) -> None:
    read = 0
    for data in corrupted_copies(whole, 150, 6):
        for reader in (toml_of, json_of, table_of):
            try:
                reader(data)
            except ValueError:
                continue
            read += 1
    assert read > 100


def test_deep_nesting_is_refused() -> None:
    for reader, nested in (
        (toml_of, b"a = " + b"[" * 50_000),
        (json_of, b"[" * 50_000),
        (json_of, b"//\n" + b"[" * 50_000),
    ):
        with pytest.raises(ValueError, match="is nested too deeply"):
            reader(nested)
