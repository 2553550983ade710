"""Boundaries around decoders, and files: whatever is raised inside is one kind of refusal, nothing is ever deleted."""

import os
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import pytest

from stereoservo.messages.decoding import DamagedError, RecordBoundary, decoding
from stereoservo.messages.files import read_bounded, set_aside, verify_checksum, with_checksum


def raise_it(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (lambda: msgspec.json.decode(b"[" * 60_000), "nested too deeply"),
        (lambda: msgspec.json.decode(b"{"), "truncated"),
        (lambda: msgspec.json.decode(b'{"a": 1}', type=list), "Expected `array`"),
        (b"\xff".decode, "is not UTF-8: invalid start byte 0xff at byte 0"),
        (lambda: raise_it(MemoryError()), "does not fit into memory"),
        (lambda: raise_it(SyntaxError("bad token")), "SyntaxError: bad token"),
        (lambda: raise_it(KeyError("zero")), "KeyError: 'zero'"),
        (lambda: Path("/nowhere/x").read_bytes(), "cannot be read: No such file"),
    ],
)
def test_whatever_a_decoder_raises_is_one_kind_of_refusal(work: Callable[[], object], words: str) -> None:
    with pytest.raises(DamagedError, match=words) as caught, decoding(partial(DamagedError, "x.json")):
        work()
    assert caught.value.source == "x.json"
    assert str(caught.value).startswith("x.json: ")


def test_refusals_made_on_purpose_pass_as_they_are() -> None:
    given = DamagedError("inner", "cut")
    with pytest.raises(DamagedError) as caught, decoding(partial(DamagedError, "outer")):
        raise given
    assert caught.value is given
    with pytest.raises(LookupError, match="mine"), decoding(partial(DamagedError, "outer"), (LookupError,)):
        raise LookupError("mine")
    with pytest.raises(KeyboardInterrupt), decoding(partial(DamagedError, "outer")):
        raise KeyboardInterrupt


def test_records_that_raise_are_left_out_counted_and_logged_ever_more_seldom() -> None:
    logged: list[str] = []
    boundary = RecordBoundary("left.slot", logged.append)
    taken = []
    assert boundary.note == ""
    for k in range(1000):
        with boundary:
            if k % 2:
                raise ValueError(f"record {k}")
            taken.append(k)
    assert len(taken) == boundary.refused == 500
    assert boundary.note == "left.slot: 500 records left out; the last one: record 999"
    assert len(logged) == 3  # the first, the tenth, the hundredth
    with pytest.raises(KeyboardInterrupt), boundary:
        raise KeyboardInterrupt


def test_files_are_read_up_to_a_size_and_nothing_but_files(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bounded(path, 5) == b"12345"
    with pytest.raises(ValueError, match="has 5 bytes; at most 4 are read"):
        read_bounded(path, 4)
    with path.open("wb") as file:
        file.truncate(2**40)  # sparse: it is refused before anything is allocated
    with pytest.raises(ValueError, match=f"has {2**40} bytes"):
        read_bounded(path, 1 << 20)
    os.mkfifo(tmp_path / "fifo")
    for other in (tmp_path / "fifo", tmp_path, Path("/dev/zero")):
        with pytest.raises(ValueError, match="not a regular file"):
            read_bounded(other, 100)


def test_damaged_files_are_renamed_and_never_replace_each_other(tmp_path: Path) -> None:
    path = tmp_path / "taught.json"
    for k in (1, 2, 3):
        path.write_text(str(k))
        assert set_aside(path) == f"it is set aside as taught.json.damaged-{k}"
        assert not path.exists()
    assert [(tmp_path / f"taught.json.damaged-{k}").read_text() for k in (1, 2, 3)] == ["1", "2", "3"]
    assert set_aside(path) == "it stays where it is (No such file or directory)"


def test_a_checksum_finds_every_flipped_bit_of_the_content() -> None:
    data = with_checksum(msgspec.json.format(b'{"a": 1.25, "b": {"c": [1, 2]}}', indent=1))
    assert msgspec.json.decode(data)["a"] == 1.25
    verify_checksum(data)
    head = data.index(b',\n "crc32"')
    for k in range(head):
        flipped = bytearray(data)
        flipped[k] ^= 1
        with pytest.raises(ValueError, match="CRC"):
            verify_checksum(bytes(flipped))
    verify_checksum(b'{"a": 1}')  # of a version without checksums, or laid out anew
    assert b"%08x" % zlib.crc32(data[:head]) in data
