"""Files of taught goals with flipped, missing and foreign bytes: read as they were written, or refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from corrupted import corrupted_copies
from stereoservo.core.cycle import Event, Sample
from stereoservo.daemon.kernel_compilation import example_model
from stereoservo.daemon.taught_goals import (
    TaughtFileError,
    TaughtGoal,
    load_taught,
    save_taught,
    taught_goal,
)

SLOW = [300, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])]


@pytest.fixture
def whole(tmp_path: Path) -> bytes:
    """A file with one goal."""
    sample = Sample(
        "left", np.array([2, 5]), np.array([[1.5, 2.5], [3.0, 4.0]]), np.tile(0.01 * np.eye(2), (2, 1, 1)), 20,
        np.full(2, 20.0), np.zeros(2),
    )  # fmt: skip
    event = Event(1, 1, "taught", name="pick", joints=np.arange(6.0), samples=(sample,))
    path = tmp_path / "whole.json"
    save_taught(path, {"pick": taught_goal(event, example_model(), "2026")})
    return path.read_bytes()


def load(path: Path, data: bytes) -> dict[str, TaughtGoal] | TaughtFileError:
    """The goals in a file, or its refusal."""
    path.write_bytes(data)
    try:
        return load_taught(path)
    except TaughtFileError as error:
        return error


def refused(path: Path, data: bytes, same: bytes) -> bool:
    """Whether a file is refused; what is not must hold the goals of ``same``."""
    found = load(path, data)
    if isinstance(found, TaughtFileError):
        assert str(path) in str(found)
        return True
    assert found == load(path, same)
    return False


def test_every_flipped_byte_is_noticed(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "taught.json"
    rng = np.random.default_rng(5)
    taken = 0
    for k in range(len(whole)):
        data = bytearray(whole)
        data[k] ^= int(rng.integers(1, 256))
        taken += not refused(path, bytes(data), whole)
    assert taken < 40  # within the checksum's own line alone


def test_every_cut_is_noticed(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "taught.json"
    assert all(refused(path, whole[:k], whole) for k in range(len(whole.rstrip())))


@pytest.mark.parametrize("count", SLOW)
def test_no_file_raises_anything_else(tmp_path: Path, whole: bytes, count: int) -> None:
    path = tmp_path / "taught.json"
    for data in corrupted_copies(whole, count, 19):
        found = load(path, data)
        assert isinstance(found, dict) or str(path) in str(found)


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\0" * 100, b"[" * 60_000, b'{"schema":2,"goals":' + b'{"a":' * 20_000, b"\xff\xfe", b"null",
        b'{"schema": 2, "goals": {"\xff": {}}}', b'{"schema": 2, "goals": {"a": {"target": "\\ud800"}}}',
        b'{"schema": ' + b"9" * 60_000 + b"}",
    ],
    ids=lambda data: ascii(data[:12]),
)  # fmt: skip
def test_foreign_bytes_are_refused_by_name(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "taught.json"
    path.write_bytes(data)
    with pytest.raises(TaughtFileError, match=r"taught\.json: "):
        load_taught(path)
