"""Newest-only slots and the stop slot: nothing torn is ever believed, a crash leaves nothing stuck."""

import errno
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

from stereoservo.daemon.seqlock import (
    SlotError,
    SlotReader,
    SlotWriter,
    StopSlot,
    create_slot,
    create_stop_slot,
    repair_stop_slot,
)

LAYOUT = "Test.1"


def test_a_reader_gets_each_record_once_and_the_newest_on_demand(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer, SlotReader(path, LAYOUT) as reader:
        assert reader.poll() is None
        writer.write(b"one")
        writer.write(b"two")
        assert reader.poll() == b"two"
        assert reader.poll() is None
        assert reader.newest() == b"two"
        writer.write(b"")
        assert reader.poll() == b""


def test_two_readers_do_not_take_records_from_each_other(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with (
        SlotWriter(path, 100, LAYOUT) as writer,
        SlotReader(path, LAYOUT) as a,
        SlotReader(path, LAYOUT) as b,
    ):
        writer.write(b"x")
        assert (a.poll(), b.poll()) == (b"x", b"x")


def test_a_record_that_changed_under_the_reader_is_refused_by_its_crc(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer, SlotReader(path, LAYOUT) as reader:
        writer.write(b"good record")
        data = bytearray(path.read_bytes())
        data[64] ^= 1  # a byte of the payload, as a torn read would see it; the sequence says "complete"
        path.write_bytes(data)
        assert reader.poll() is None
        assert reader.missed == 1
        assert reader.torn == 8
        writer.write(b"next")
        assert reader.poll() == b"next"


def test_a_half_written_record_of_a_crashed_writer_is_not_read_and_the_next_writer_goes_on(
    tmp_path: Path,
) -> None:
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer:
        writer.write(b"whole")
    data = bytearray(path.read_bytes())
    (sequence,) = struct.unpack_from("=Q", data, 40)
    struct.pack_into("=Q", data, 40, sequence + 1)  # odd: died while writing
    path.write_bytes(data)
    with SlotReader(path, LAYOUT) as reader:
        assert reader.poll() is None
        with SlotWriter(path, 100, LAYOUT) as writer:
            writer.write(b"again")
            assert reader.poll() == b"again"
            assert reader.epoch == 2


def test_zeros_of_a_writer_that_was_interrupted_are_no_empty_record(tmp_path: Path) -> None:
    """`struct.pack_into` clears what it writes to; the CRC of no bytes under number 0 is 0."""
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer, SlotReader(path, LAYOUT) as reader:
        writer.write(b"whole")
        held = reader._words
        sequence = held[5]
        cleared = bytearray(path.read_bytes())
        cleared[40:64] = bytes(24)
        path.write_bytes(cleared)  # between the look at the number and the reading
        numbers = iter([sequence])
        reader._words = type("Words", (), {"__getitem__": lambda self, k: next(numbers, held[k])})()  # type: ignore[assignment]
        assert reader.poll() is None
        reader._words = held
        writer.write(b"next")
        assert reader.poll() == b"next"


def test_the_same_bytes_under_another_sequence_number_are_not_the_same_record(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer, SlotReader(path, LAYOUT) as reader:
        writer.write(b"data")
        data = bytearray(path.read_bytes())
        struct.pack_into("=Q", data, 56, zlib.crc32(b"data"))  # a CRC of the bytes alone
        path.write_bytes(data)
        assert reader.newest() is None


def test_a_second_writer_is_refused_and_told_who_writes(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with (
        SlotWriter(path, 100, LAYOUT),
        pytest.raises(SlotError, match="already written by process") as caught,
    ):
        SlotWriter(path, 100, LAYOUT)
    assert caught.value.code == "busy"
    SlotWriter(path, 100, LAYOUT).close()


def test_layout_capacity_and_existence_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with pytest.raises(SlotError, match="no such slot"):
        SlotReader(path, LAYOUT)
    create_slot(path, 10, LAYOUT)
    with pytest.raises(SlotError, match=r"not a slot of layout 'Other\.1'"):
        SlotReader(path, "Other.1")
    with (
        SlotWriter(path, 10, LAYOUT) as writer,
        pytest.raises(SlotError, match="11 bytes; the slot holds up to 10"),
    ):
        writer.write(b"x" * 11)
    path.write_bytes(b"short")
    with pytest.raises(SlotError, match="5 bytes"):
        SlotReader(path, LAYOUT)


def test_creating_again_keeps_the_file_and_its_record(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer:
        writer.write(b"kept")
    inode = path.stat().st_ino
    create_slot(path, 100, LAYOUT)
    assert path.stat().st_ino == inode
    with SlotReader(path, LAYOUT) as reader:
        assert reader.poll() == b"kept"


def test_a_slot_has_all_of_its_memory_however_little_an_earlier_attempt_got(tmp_path: Path) -> None:
    """A hole in a file of shared memory that is full kills whoever writes there."""
    path = tmp_path / "a.slot"
    size = 64 + 100_000
    path.touch()
    os.truncate(path, size)
    assert path.stat().st_blocks == 0
    assert create_slot(path, 100_000, LAYOUT)
    assert path.stat().st_size == size
    assert path.stat().st_blocks * 512 >= size


def test_a_slot_for_which_there_is_no_memory_is_an_error_and_no_slot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "a.slot"
    with monkeypatch.context() as patch:
        patch.setattr(os, "posix_fallocate", full)
        for _ in range(2):
            with pytest.raises(OSError, match="No space left"):
                create_slot(path, 100, LAYOUT)
    with pytest.raises(SlotError):
        SlotReader(path, LAYOUT)
    assert create_slot(path, 100, LAYOUT)


WRITER = """
import pathlib, sys
from stereoservo.daemon.seqlock import SlotWriter
enough = pathlib.Path(sys.argv[3])
with SlotWriter(pathlib.Path(sys.argv[1]), 4096, sys.argv[2]) as writer:
    k = 0
    while k % 64 or not enough.exists():
        k += 1
        writer.write(bytes([k % 251]) * (1 + k % 4096))
"""


def test_no_torn_record_is_ever_returned_while_another_process_writes(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    create_slot(path, 4096, LAYOUT)
    enough = tmp_path / "enough"
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(path), LAYOUT, str(enough)])
    reads = 0
    try:
        with SlotReader(path, LAYOUT) as reader:
            while reads < 2000:
                record = reader.poll()
                if record is not None:
                    reads += 1
                    assert record == record[:1] * len(record)
                assert process.poll() is None
    finally:
        enough.touch()
        process.wait()
    assert process.returncode == 0


def test_a_stop_is_seen_once_and_acknowledged(tmp_path: Path) -> None:
    path = tmp_path / "stop"
    create_stop_slot(path)
    servo, other = StopSlot(path), StopSlot(path)
    assert not servo.poll()
    word = other.raise_stop()
    assert not other.acknowledged(word)
    assert servo.poll()
    assert other.acknowledged(word)
    assert not servo.poll()
    assert other.count == 1


def test_stops_of_two_processes_are_one_stop_and_both_are_acknowledged(tmp_path: Path) -> None:
    path = tmp_path / "stop"
    create_stop_slot(path)
    servo, a, b = StopSlot(path), StopSlot(path), StopSlot(path)
    first, second = a.raise_stop(), b.raise_stop()
    assert second > first
    assert servo.poll()
    assert a.acknowledged(first)
    assert b.acknowledged(second)
    assert not servo.poll()


def test_a_stop_slot_is_not_made_of_just_any_file(tmp_path: Path) -> None:
    path = tmp_path / "stop"
    path.write_bytes(bytes(32))
    with pytest.raises(SlotError, match="not a stop slot"):
        StopSlot(path)


def test_a_slot_that_lost_its_header_is_repaired_under_those_who_have_it_mapped(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer:
        writer.write(b"one")
        for damage in (
            lambda data: b"\0" * 24 + data[24:],
            lambda data: data[:7],
            lambda data: data + b"more",
        ):
            with path.open("r+b") as file:
                data = damage(path.read_bytes())
                file.truncate(len(data))
                file.write(data)
            with pytest.raises(SlotError):
                SlotReader(path, LAYOUT)
            assert create_slot(path, 100, LAYOUT)
            assert not create_slot(path, 100, LAYOUT)
            with SlotReader(path, LAYOUT) as reader:
                writer.write(b"two")
                assert reader.poll() == b"two"


def test_every_flipped_byte_of_a_slot_is_a_record_less_and_raises_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.slot"
    with SlotWriter(path, 100, LAYOUT) as writer:
        writer.write(bytes(range(100)))
    whole = path.read_bytes()
    for k in range(24, len(whole)):
        for mask in (1, 0x80, 0xFF):
            data = bytearray(whole)
            data[k] ^= mask
            path.write_bytes(bytes(data))
            with SlotReader(path, LAYOUT) as reader:
                assert reader.poll() in (None, bytes(range(100)))
            with SlotWriter(path, 100, LAYOUT) as writer, SlotReader(path, LAYOUT) as reader:
                writer.write(b"next")
                assert reader.poll() == b"next"


@pytest.mark.parametrize("word", range(4))
def test_a_damaged_stop_slot_still_stops(tmp_path: Path, word: int) -> None:
    path = tmp_path / "stop"
    create_stop_slot(path)
    data = bytearray(path.read_bytes())
    data[8 * word : 8 * word + 8] = b"\xff" * 8
    path.write_bytes(bytes(data))
    assert repair_stop_slot(path) is (word == 0)
    servo, other = StopSlot(path), StopSlot(path)
    for _ in range(3):
        other.raise_stop()
        assert servo.poll()
        assert not servo.poll()
    path.write_bytes(b"")
    assert repair_stop_slot(path)
    assert StopSlot(path).raise_stop()
