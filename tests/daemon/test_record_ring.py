"""The ring of records: whole records in order or none, a full ring refuses and waits for nobody, damage is told."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from stereoservo.daemon import record_ring
from stereoservo.daemon.record_ring import RingReader, RingWriter
from stereoservo.daemon.seqlock import SlotError, create_slot


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(record_ring, "CAPACITY", 4096)
    return tmp_path / "ring"


def test_records_pass_in_order_whole_or_not_at_all(path: Path) -> None:
    """Against a list, over many rounds of the ring, with records of any length."""
    writer, reader = RingWriter(path), RingReader(path)
    reader.attach()
    rng = np.random.default_rng(1)
    waiting: list[bytes] = []
    refused = passed = 0
    for _ in range(3000):
        if rng.random() < 0.6:
            record = rng.bytes(int(rng.integers(0, 900)))
            if writer.write(record):
                waiting.append(record)
            else:
                refused += 1
                assert sum(len(one) + 16 for one in waiting) + len(record) + 16 > 4096 - 916
        else:
            count = int(rng.integers(1, 6))
            found = reader.read(count)
            assert found == waiting[:count]
            del waiting[: len(found)]
            passed += len(found)
    assert refused > 50
    assert passed > 1000
    assert not writer.write(bytes(4096)), "longer than the ring"


def test_a_reader_is_known_by_its_word_and_begins_with_what_comes_then(path: Path) -> None:
    writer = RingWriter(path)
    reader = RingReader(path)
    assert writer.reader == 0
    writer.write(b"before")
    reader.attach()
    first = writer.reader
    assert first != 0
    writer.write(b"after")
    assert reader.read(10) == [b"after"]
    reader.attach()
    assert writer.reader not in (0, first)
    reader.close()
    reader.close()
    assert writer.reader == 0


def test_a_writer_that_begins_again_goes_on_where_the_last_one_was(path: Path) -> None:
    writer, reader = RingWriter(path), RingReader(path)
    reader.attach()
    writer.write(b"one")
    writer.close()
    again = RingWriter(path)
    again.write(b"two")
    assert reader.read(10) == [b"one", b"two"]


def test_a_damaged_ring_is_told_and_read_anew(path: Path) -> None:
    """Every byte of the file spoilt: the writer goes on, and later records pass once the reader begins anew."""
    writer, reader = RingWriter(path), RingReader(path)
    rng = np.random.default_rng(2)
    size = path.stat().st_size
    told = 0
    for at in [*range(24, 64), *(int(k) for k in rng.integers(64, size, 60))]:
        reader.attach()
        for _ in range(3):
            writer.write(b"x" * 50)
        with path.open("r+b") as file:
            file.seek(at)
            byte = file.read(1)
            file.seek(at)
            file.write(bytes((byte[0] ^ int(rng.integers(1, 256)),)))
        for _ in range(2 * record_ring.TRIES):
            found: list[bytes] = []
            try:
                found = reader.read(10)
            except SlotError:
                told += 1
            assert set(found) <= {b"x" * 50}
        found = []
        for _ in range(3 * record_ring.TRIES):
            writer.write(b"good")
            with suppress(SlotError):
                found += reader.read(1000)
        assert b"good" in found
    assert told > 10


def test_another_layout_is_refused(path: Path) -> None:
    create_slot(path, 4096, "Another.1")
    with pytest.raises(SlotError) as caught:
        RingReader(path)
    assert caught.value.code == "layout"
    with pytest.raises(SlotError) as caught:
        RingReader(path.with_name("nothing"))
    assert caught.value.code == "missing"
