"""Model files with flipped, missing and foreign bytes: the model as it was, or a refusal with the file's name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from corrupted import corrupted_copies
from stereoservo.daemon.kernel_compilation import example_model
from stereoservo.kinematics.model import CellModel, ModelFileError, decode_model, encode_model, load_model

WHOLE = encode_model(example_model())
POSITIONS = [400, pytest.param(10_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])]
FILES = [300, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])]


def decoded(data: bytes) -> CellModel | ModelFileError:
    """The model in a file, or its refusal."""
    try:
        return decode_model(data, "model-000001.json")
    except ModelFileError as error:
        return error


def refused(data: bytes) -> bool:
    """Whether a file is refused; what is not must hold the model as it was."""
    found = decoded(data)
    if isinstance(found, ModelFileError):
        assert str(found).startswith("model-000001.json: ")
        return True
    assert encode_model(found) == WHOLE
    return False


@pytest.mark.parametrize("positions", POSITIONS)
def test_a_flipped_byte_is_noticed(positions: int) -> None:
    rng = np.random.default_rng(positions)
    taken = 0
    for k in rng.integers(0, len(WHOLE), positions):
        data = bytearray(WHOLE)
        data[int(k)] ^= int(rng.integers(1, 256))
        taken += not refused(bytes(data))
    assert taken <= 0.05 * positions  # within the checksum's own line alone


def test_every_cut_is_noticed() -> None:
    assert all(refused(WHOLE[:k]) for k in range(0, len(WHOLE.rstrip()), 23))


@pytest.mark.parametrize("count", FILES)
def test_no_file_raises_anything_else(count: int) -> None:
    for data in corrupted_copies(WHOLE, count, 19):
        found = decoded(data)
        assert isinstance(found, CellModel) or str(found).startswith("model-000001.json: ")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"schema": 2', b'"schema": 2, "created": "\xff"'),
        (b'"zero": [', b'"zero": [1' + b"0" * 400 + b","),
        (b'"zero": [', b'"zero": ' + b"[" * 60_000),
        (b'"epoch": ', b'"epoch": 9' + b"9" * 5000),
        (b'"zero": [', b'"zero": [true, {}, '),
        (b'"generators": [', b'"generators": [1e308, '),
    ],
    ids=["not UTF-8", "400 digits", "nested", "5000 digits", "mixed", "huge"],
)
def test_hostile_values_are_refused_by_name(tmp_path: Path, old: bytes, new: bytes) -> None:
    assert WHOLE.count(old) == 1
    path = tmp_path / "model-000001.json"
    path.write_bytes(WHOLE.replace(old, new))
    with pytest.raises(ModelFileError, match=r"model-000001\.json: "):
        load_model(path)


def test_a_file_without_a_checksum_is_read() -> None:
    head = WHOLE[: WHOLE.index(b',\n "crc32"')]
    assert encode_model(decode_model(head + b"\n}\n")) == WHOLE
