"""Files of trial data with flipped, missing and foreign bytes."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stereoservo.calibration.trial_data import (
    CalibrationError,
    TrialData,
    decode_trials,
    encode_trials,
    load_trials,
)
from stereoservo.numerics.archives import read_archive

FILES = [300, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])]


@pytest.fixture
def whole(arms: Any) -> bytes:
    return encode_trials(arms["mixed"]().trials(0.1, np.random.default_rng(1), stops=3))


def decoded(data: bytes) -> TrialData | CalibrationError:
    try:
        return decode_trials(data, "here.npz")
    except CalibrationError as error:
        return error


@pytest.mark.parametrize("count", FILES)
def test_no_file_raises_anything_else(whole: bytes, count: int) -> None:
    rng = np.random.default_rng(count)
    for k in range(count):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, 10))):
            at, length = int(rng.integers(len(data))), int(rng.integers(1, 40))
            match k % 4:
                case 0:
                    data[at] ^= int(rng.integers(1, 256))
                case 1:
                    data[at : at + length] = rng.bytes(length)
                case 2:
                    del data[at : at + length]
                case _:
                    del data[at:]
                    break
        found = decoded(bytes(data))
        assert isinstance(found, TrialData) or "here.npz" in str(found)


@pytest.mark.parametrize("size", [2**40, 2**62])
def test_sizes_that_lie_are_refused_before_anything_is_allocated(size: int) -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (size,)})
        archive.writestr("a.npy", header.getvalue() + b"\0" * 8)
    with pytest.raises(ValueError, match="is said to have shape"):
        read_archive(buffer.getvalue(), 1 << 30)
    data = bytearray(buffer.getvalue())
    entry = data.rindex(b"PK\x01\x02")
    struct.pack_into("<I", data, entry + 24, 2**31)  # the uncompressed size in the directory
    with pytest.raises(ValueError, match=f"it unpacks to {2**31} bytes; at most"):
        read_archive(bytes(data), 1 << 30)
    with pytest.raises(ValueError, match=f"is said to have {2**31} bytes"):
        read_archive(bytes(data), 1 << 40)


def test_objects_are_not_read() -> None:
    buffer = io.BytesIO()
    np.savez(buffer, a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="array of object"):
        read_archive(buffer.getvalue(), 1 << 20)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, a=np.asfortranarray(np.arange(6.0).reshape(2, 3)), b=np.array(2))
    found = read_archive(buffer.getvalue(), 1 << 20)
    assert found["a"].tolist() == [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    assert found["b"] == 2


def test_a_file_of_no_size_that_can_be_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trials.npz"
    with path.open("wb") as file:
        file.truncate(2**42)
    with pytest.raises(CalibrationError, match=f"has {2**42} bytes"):
        load_trials(path)
