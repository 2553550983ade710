"""Recordings and arrays with flipped, missing and foreign bytes; recordings on a full disk."""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zstandard

from corrupted import corrupted_copies
from oracles.former_recording import FormerRecorder
from stereoservo.cli import main as cli
from stereoservo.core.cycle import decode_array, encode
from stereoservo.core.state_encoding import encode_state
from stereoservo.recording import flight_recorder
from stereoservo.recording.compression import COUNT, ZERO, Checkpoints, StepBlocks
from stereoservo.recording.flight_recorder import FlightRecorder
from stereoservo.recording.recorded_motion import read_motion
from stereoservo.recording.replay import RecordingError, recorded_messages, replay
from stereoservo.recording.step_layout import encode_step
from stereoservo.recording.step_records import fingerprint

FILES = [300, pytest.param(100_000, marks=[pytest.mark.slow, pytest.mark.timeout(7200)])]


def record(bench: Any, path: Path, steps: int) -> FlightRecorder:
    """Record so many steps of an arm at rest, with a checkpoint each hundred."""
    bench.ready()
    with FlightRecorder(path, bench.settings, fingerprint()) as recorder:
        for k in range(steps):
            if k % 100 == 0:
                recorder.checkpoint(bench.core.state.step + 1, encode_state(bench.core.state), bench.now_ns)
            outputs = bench.step()
            inputs = bench.log[-1][0]
            recorder.step(encode_step(inputs, outputs), inputs.now_ns)
    return recorder


@pytest.fixture
def small(benches: Any, tmp_path: Path) -> Path:
    path = tmp_path / "flight.mcap"
    record(benches(3), path, 3)
    return path


def read(path: Path, data: bytes) -> list[tuple[str, bytes]] | RecordingError:
    """All messages of a file, or its refusal."""
    path.write_bytes(data)
    try:
        return list(recorded_messages(path))
    except RecordingError as error:
        return error


def test_every_cut_is_told_as_one(small: Path) -> None:
    whole = small.read_bytes()
    for k in range(0, len(whole), 10):
        found = read(small, whole[:k])
        assert isinstance(found, RecordingError)
        assert found.cut
        assert str(small) in str(found)


def test_a_flipped_byte_is_refused_or_changes_no_message(small: Path) -> None:
    whole = small.read_bytes()
    messages = read(small, whole)
    rng = np.random.default_rng(3)
    for k in range(0, len(whole), max(1, len(whole) // 500)):
        data = bytearray(whole)
        data[k] ^= int(rng.integers(1, 256))
        found = read(small, bytes(data))
        if isinstance(found, RecordingError):
            assert str(small) in str(found)
        else:
            assert found == messages


def test_a_record_of_another_kind_or_length_is_refused_or_changes_no_message(small: Path) -> None:
    whole = small.read_bytes()
    messages = read(small, whole)
    begins, at = [], 8
    while at < len(whole) - 8:
        begins.append(at)
        at += 9 + int(struct.unpack_from("<Q", whole, at + 1)[0])
    assert at == len(whole) - 8
    for at in begins:
        for where, values in ((at, range(1, 256)), (at + 1, range(1, 256, 7)), (at + 2, (1, 2, 64))):
            for value in values:
                data = bytearray(whole)
                data[where] ^= value
                found = read(small, bytes(data))
                assert isinstance(found, RecordingError) or found == messages, (where - at, whole[at], value)


@pytest.mark.parametrize("count", FILES)
def test_no_file_raises_anything_else(small: Path, count: int) -> None:
    whole = small.read_bytes()
    for data in corrupted_copies(whole, count, 9):
        read(small, data)


@pytest.mark.parametrize("length", [2**40, 2**63, 2**64 - 1, 2**31])
def test_a_length_that_lies_is_refused_before_anything_is_allocated(small: Path, length: int) -> None:
    whole = small.read_bytes()
    chunk = whole.index(b"\x06", 8 + 9 + 30)
    for at in (9, chunk + 1, chunk + 1 + 8 + 16):  # of the header record, the chunk, its uncompressed size
        data = bytearray(whole)
        struct.pack_into("<Q", data, at, length)
        found = read(small, bytes(data))
        assert isinstance(found, RecordingError)
    frame = struct.pack("<IBQ", 0xFD2FB528, 0xE0, length)  # of zstandard: it states its own size
    for restore in (StepBlocks().restore, Checkpoints().restore):
        with pytest.raises((ValueError, zstandard.ZstdError)):
            restore(frame)


def hostile_block(forms: list[int], kinds: list[int], tail: bytes) -> bytes:
    """A block that states records of these ``kinds``, of forms of so many bytes."""
    head = COUNT.pack(len(kinds), len(forms)) + np.array([[n, 0] for n in forms], "<u4").tobytes()
    return zstandard.ZstdCompressor().compress(head + np.array(kinds, "<u2").tobytes() + tail)


def test_a_block_of_few_bytes_does_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    zero = bytes([ZERO])
    assert StepBlocks().restore(hostile_block([16], [0], 2 * zero)) == [bytes(16)]
    for forms, kinds in (([16, 8 * 10**6], [0]), ([16], [0, 1]), ([16] * 65536, [0])):
        with pytest.raises(ValueError, match="forms that no record has, or records of no form"):
            StepBlocks().restore(hostile_block(forms, kinds, 10**6 * zero))
    monkeypatch.setattr("stereoservo.recording.compression.MOST_KEPT", 10**5)
    blocks = StepBlocks()
    assert blocks.restore(hostile_block([48_000], [0], 6000 * zero))
    with pytest.raises(ValueError, match="more forms"):
        blocks.restore(hostile_block([56_000], [0], 7000 * zero))


@pytest.mark.parametrize("length", [2**40, 2**63, 2**64 - 1, 2**31])
def test_a_length_that_lies_in_a_recording_of_format_1_is_refused(bench: Any, tmp_path: Path, length: int) -> None:
    path = tmp_path / "former.mcap"
    with FormerRecorder(path, bench.settings, fingerprint()) as recorder:
        recorder.checkpoint(1, encode_state(bench.core.state), 1)
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, data.index(b"\x04\x22\x4d\x18") + 6, length)  # an LZ4 frame states its own size
    found = read(path, bytes(data))
    assert isinstance(found, RecordingError)
    assert f"whose data state {length}" in str(found)


def test_a_cut_recording_is_replayed_up_to_the_cut(
    benches: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flight_recorder, "CHUNK_BYTES", 8 * 1024)
    path = tmp_path / "flight.mcap"
    recorder = record(benches(3, noise_px=0.1), path, 300)
    whole = path.read_bytes()
    steps = []
    for share in (0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(RecordingError, match="truncated") as caught:
            replay(path)
        assert caught.value.cut
        result = caught.value.result
        assert result is not None
        assert result.identical is True
        assert 0 < result.steps < recorder.steps
        steps.append(result.steps)
    assert steps == sorted(steps)


def test_the_command_gives_a_verdict_on_a_cut_recording(
    benches: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(flight_recorder, "CHUNK_BYTES", 16 * 1024)
    path = tmp_path / "flight.mcap"
    record(benches(3, noise_px=0.1), path, 300)
    whole = path.read_bytes()

    def run() -> tuple[int, dict[str, Any]]:
        code = cli.invoke(["replay", str(path), "--json"])
        return code, msgspec.json.decode(capfd.readouterr().out)

    code, result = run()
    assert (code, result["identical"], result["complete"], result["steps"]) == (0, True, True, 300)
    path.write_bytes(whole[: len(whole) // 2])
    code, result = run()
    assert (code, result["identical"], result["complete"]) == (0, True, False)
    assert 0 < result["steps"] < 300
    assert "ends inside a record" in result["incomplete"]
    assert cli.invoke(["replay", str(path)]) == 0
    assert "identical up to step" in capfd.readouterr().out
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF  # in the middle, and the rest of the file is there: not what a crash leaves
    path.write_bytes(bytes(damaged))
    code, result = run()
    assert code == 1
    assert result["error"]["identical"] is True
    assert 0 < result["error"]["steps"] < 300
    path.write_bytes(whole[:100])  # nothing to compare
    code, result = run()
    assert code == 1
    assert "truncated" in result["error"]["message"]


def test_a_message_that_lies_is_a_refusal_with_what_comes_before(bench: Any, tmp_path: Path) -> None:
    lies: dict[str, Callable[[FlightRecorder], None]] = {
        "step": lambda recorder: recorder.step(b"\x91" * 50_000, 1),
        "checkpoint": lambda recorder: recorder.checkpoint(1, b"\xff" * 40, 1),
        "header": lambda recorder: recorder._add("header", b"\xc1", 1),
    }
    for topic, lie in lies.items():
        path = tmp_path / f"{topic}.mcap"
        bench.ready()
        with FlightRecorder(path, bench.settings, fingerprint()) as recorder:
            recorder.checkpoint(bench.core.state.step + 1, encode_state(bench.core.state), bench.now_ns)
            for _ in range(5):
                outputs = bench.step()
                inputs = bench.log[-1][0]
                recorder.step(encode_step(inputs, outputs), inputs.now_ns)
            recorder._flush()
            lie(recorder)
        with pytest.raises(RecordingError, match=f"{topic} record is damaged") as caught:
            replay(path)
        assert caught.value.result is not None
        assert caught.value.result.steps == 5
        if topic != "checkpoint":
            with pytest.raises(RecordingError, match="damaged"):
                read_motion(path)


# -- arrays -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.zeros((0, 4)),
        np.array(1.5),
        np.array([True, False]),
        np.arange(3),
        np.zeros(2, np.uint8),
    ],
)
def test_arrays_come_back_bit_for_bit(array: Any) -> None:
    found: Any = decode_array(np.ndarray, msgspec.msgpack.decode(encode(array)))
    assert found.dtype == array.dtype
    assert found.shape == array.shape
    assert found.tobytes() == array.tobytes()


@pytest.mark.parametrize(
    ("name", "shape", "data"),
    [
        ("O", [1], b"12345678"),
        ("f8," * 10_000, [1], b"12345678"),
        ("(" * 1000, [1], b""),
        ("V2147483647", [0], b""),
        ("datetime64[s]", [1], b"12345678"),
        (["<f8"], [1], b"12345678"),
        (None, [1], b"12345678"),
        ("<f8", [2**40], b"12345678"),
        ("<f8", [2**62, 0], b""),
        ("<f8", [-1], b"12345678"),
        ("<f8", [2], b"12345678"),
        ("<f8", ["1"], b"12345678"),
        ("<f8", [1.0], b"12345678"),
        ("<f8", 1, b"12345678"),
        ("<f8", [1], "12345678"),
        ("<f8", [1], 8),
        ("<f8", [1] * 100, b"12345678"),
    ],
    ids=lambda value: repr(value)[:20],
)
def test_arrays_that_lie_are_refused(name: Any, shape: Any, data: Any) -> None:
    with pytest.raises((ValueError, TypeError)):
        decode_array(np.ndarray, (name, shape, data))


# -- full disks ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", [0, 300, 3_000, 9_000, 20_000])
def test_a_recording_on_a_full_disk_is_good_up_to_its_end(
    benches: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, space: int
) -> None:
    left = [space]

    class Full(flight_recorder.FileIO):
        def write(self, data: Any) -> int:
            if left[0] <= 0:
                raise OSError(errno.ENOSPC, "No space left on device")
            written = super().write(bytes(data)[: left[0]])
            left[0] -= written
            return written

    monkeypatch.setattr(flight_recorder, "FileIO", Full)
    monkeypatch.setattr(flight_recorder, "CHUNK_BYTES", 16 * 1024)
    path = tmp_path / "flight.mcap"
    bench = benches(3, noise_px=0.1)
    if space < 100:
        with pytest.raises(OSError, match="No space left"):
            record(bench, path, 300)
        return
    recorder = record(bench, path, 300)
    assert recorder.failure == "No space left on device"
    assert recorder.steps + recorder.dropped == 300
    assert recorder.dropped > 0
    with pytest.raises(RecordingError) as caught:
        replay(path)
    assert caught.value.steps == recorder.steps
    assert caught.value.cut
    if recorder.steps:
        assert caught.value.result is not None
        assert caught.value.result.identical is True
        assert caught.value.result.steps == recorder.steps
