"""Recorded cameras: lossless, checked, bounded, and readable as far as they go."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tracemalloc
import zlib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stereoservo.ports.devices import Frame
from stereoservo.ports.image_files import (
    ImageEnd,
    ImageFileError,
    ImageLimits,
    ImageReader,
    ImageWriter,
    crc_of,
    sidecar_of,
)

NO_LIMITS = ImageLimits(keep_free_bytes=0)
STEP_NS = 33_333_333


def frames_of(count: int, width: int, height: int, seed: int = 0) -> list[Frame]:
    """Noisy pictures at a steady rate, with gaps in the sequence."""
    rng = np.random.default_rng(seed)
    return [
        Frame(
            "left",
            k + k // 3,
            10**12 + k * STEP_NS,
            10**12 + k * STEP_NS + 5_000_000,
            rng.integers(90, 120, (height, width)).astype(np.uint8),
        )
        for k in range(count)
    ]


def append_all(writer: ImageWriter, frames: list[Frame]) -> None:
    """Append until one is refused."""
    for frame in frames:
        writer.append(frame)


def record(path: Path, frames: list[Frame]) -> Path:
    """A closed recording of ``frames``."""
    height, width = frames[0].image.shape
    with ImageWriter(path, "left", (width, height), 30.0, driver="test", limits=NO_LIMITS) as writer:
        append_all(writer, frames)
    return path


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, list[Frame]]:
    """A recording of 12 frames of 64x48 px."""
    frames = frames_of(12, 64, 48)
    return record(tmp_path / "left.avi", frames), frames


def read_all(path: Path) -> tuple[list[Frame], ImageReader]:
    """All frames, and the reader, closed."""
    with ImageReader(path) as reader:
        return list(reader), reader


def whole(reader: ImageReader) -> bool:
    """Whether all that was recorded was read, seen at its end."""
    return reader.lost == 0 and reader.end is not None


def same(one: Frame, other: Frame) -> bool:
    """Whether two frames are the same in every bit."""
    return (
        (one.camera, one.seq, one.t_shutter_ns, one.t_received_ns)
        == (other.camera, other.seq, other.t_shutter_ns, other.t_received_ns)
        and one.image.shape == other.image.shape
        and bool((one.image == other.image).all())
    )


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    width=st.integers(16, 75),
    height=st.integers(16, 75),
    count=st.integers(1, 5),
    seed=st.integers(0, 2**16),
)
def test_what_is_read_is_what_was_written(
    tmp_path_factory: pytest.TempPathFactory, width: int, height: int, count: int, seed: int
) -> None:
    """Bit for bit, also where the codec wants even sizes and the picture has odd ones."""
    rng = np.random.default_rng(seed)
    frames = [
        Frame("left", k, 1000 + k, 2000 + k, rng.integers(0, 256, (height, width)).astype(np.uint8))
        for k in range(count)
    ]
    path = record(tmp_path_factory.mktemp("images") / "left.avi", frames)
    found, reader = read_all(path)
    assert len(found) == count
    assert all(same(one, other) for one, other in zip(found, frames, strict=True))
    assert whole(reader)
    assert reader.header.width == width
    assert reader.header.height == height


def test_flipped_bytes_never_pass_for_pixels(recorded: tuple[Path, list[Frame]]) -> None:
    """Wherever a byte is changed: an error that says which frame, or a loss that is told, or the same pixels."""
    path, frames = recorded
    data = path.read_bytes()
    rng = np.random.default_rng(5)
    told: list[tuple[str, int | None, int, bool]] = []
    for offset in rng.integers(0, len(data), 250):
        damaged = bytearray(data)
        damaged[offset] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        good = 0
        try:
            with ImageReader(path) as reader:
                for frame in reader:
                    assert same(frame, frames[good])
                    good += 1
                assert good + reader.lost == len(frames)
        except ImageFileError as error:
            told.append((error.code, error.frame, good, str(path) in str(error)))
    assert all(frame == (good if code == "crc" else None) and named for code, frame, good, named in told)
    assert {code for code, *_ in told} <= {"crc", "video", "size"}
    assert sum(code == "crc" for code, *_ in told) > 100, "most bytes are pixels: the CRC must catch most flips"


def test_a_video_cut_anywhere_gives_the_frames_before_the_cut(recorded: tuple[Path, list[Frame]]) -> None:
    path, frames = recorded
    data = path.read_bytes()
    counts = []
    codes: set[str] = set()
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        path.write_bytes(data[:length])
        good: list[Frame] = []
        try:
            with ImageReader(path) as reader:
                good.extend(reader)
                assert len(good) + reader.lost == len(frames)
                assert whole(reader) == (len(good) == len(frames))
        except ImageFileError as error:
            codes.add(error.code)
        assert all(same(one, other) for one, other in zip(good, frames, strict=False))
        counts.append(len(good))
    assert counts == sorted(counts)
    assert codes <= {"video", "crc"}
    assert counts[-1] >= len(frames) - 1


def test_a_sidecar_cut_anywhere_gives_the_frames_it_tells_of(recorded: tuple[Path, list[Frame]]) -> None:
    path, frames = recorded
    sidecar = sidecar_of(path)
    data = sidecar.read_bytes()
    header = data.index(b"\n") + 1
    for length in range(0, len(data), 23):
        sidecar.write_bytes(data[:length])
        if length < header - 1:
            with pytest.raises(ImageFileError, match="no header") as caught:
                ImageReader(path)
            assert caught.value.code == "foreign_sidecar"
            continue
        good, reader = read_all(path)
        assert all(same(one, other) for one, other in zip(good, frames, strict=False))
        assert len(good) + reader.lost == len(frames)
        assert data[:length].count(b"\n") - 1 <= len(good) <= data[:length].count(b"\n")
        assert reader.end is None
        assert not whole(reader)


def test_a_killed_recorder_leaves_what_it_wrote(tmp_path: Path) -> None:
    """Killed without any farewell: all but what the container's writer held, 256 KiB, is read back."""
    path = tmp_path / "left.avi"
    script = f"""
import os
import numpy as np
from pathlib import Path
from stereoservo.ports.image_files import ImageLimits, ImageWriter
from stereoservo.ports.devices import Frame
rng = np.random.default_rng(0)
writer = ImageWriter(Path({str(path)!r}), "left", (640, 480), 30.0, limits=ImageLimits(keep_free_bytes=0))
for k in range(12):
    writer.append(Frame("left", k, 1000 + k, 2000 + k, rng.integers(0, 256, (480, 640)).astype(np.uint8)))
os._exit(9)
"""
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 9
    rng = np.random.default_rng(0)
    good, reader = read_all(path)
    assert all((frame.image == rng.integers(0, 256, (480, 640))).all() for frame in good)
    assert len(good) + reader.lost == 12
    assert 1 <= reader.lost <= 2, "a picture of noise takes 300 KiB"
    assert reader.end is None


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"", "no header"),
        (b'{"frames": [1, 2]}\n', "no header"),
        (b"\x00\xff\xfe" * 50 + b"\n", "no header"),
        (b'{"line":"frame","frame":0,"seq":1,"t_shutter_ns":1,"t_received_ns":1,"crc":1}\n', "no header"),
        (b'{"line":"header","schema":"x-9","camera":"left","width":64,"height":48,"rate_hz":30}\n', "x-9"),
        (
            b'{"line":"header","schema":"stereoservo-images-1","camera":"a","width":0,"height":4,"rate_hz":3}\n',
            "0x4 px",
        ),
    ],
)
def test_a_foreign_sidecar_is_refused(recorded: tuple[Path, list[Frame]], content: bytes, cause: str) -> None:
    sidecar_of(recorded[0]).write_bytes(content)
    with pytest.raises(ImageFileError, match=cause) as caught:
        ImageReader(recorded[0])
    assert caught.value.code == "foreign_sidecar"


def test_what_does_not_belong_together_is_refused(recorded: tuple[Path, list[Frame]], tmp_path: Path) -> None:
    path, _ = recorded
    other = record(tmp_path / "other.avi", frames_of(12, 80, 48))
    same_size = record(tmp_path / "same.avi", frames_of(12, 64, 48, seed=9))
    for wrong, code in ((other, "size"), (same_size, "crc")):
        sidecar_of(path).write_bytes(sidecar_of(wrong).read_bytes())
        with pytest.raises(ImageFileError) as caught:
            read_all(path)
        assert caught.value.code == code
    with pytest.raises(ImageFileError, match="camera 'left', not of 'right'") as caught:
        ImageReader(other, camera="right")
    assert caught.value.code == "camera"


def test_files_that_are_missing_or_no_video_are_refused(recorded: tuple[Path, list[Frame]], tmp_path: Path) -> None:
    path, _ = recorded
    with pytest.raises(ImageFileError) as caught:
        ImageReader(tmp_path / "none.avi")
    assert caught.value.code == "missing"
    path.write_text("no video\n")
    with pytest.raises(ImageFileError) as caught:
        ImageReader(path)
    assert caught.value.code == "video"
    sidecar_of(path).unlink()
    with pytest.raises(ImageFileError, match="Copy both files") as caught:
        ImageReader(path)
    assert caught.value.code == "no_sidecar"


@pytest.mark.parametrize(
    ("old", "new", "cause"),
    [
        (b'"frame":5', b'"frame":6', "another frame's"),
        (b'{"line":"frame","frame":5', b'{"line":"frame","frame":x', "not valid"),
        (b'{"line":"frame","frame":5', b"x" * 5000, "not valid"),
        (b'"frames":12', b'"frames":13', "lines are missing"),
    ],
)
def test_a_damaged_sidecar_stops_the_reading_where_it_is_damaged(
    recorded: tuple[Path, list[Frame]], old: bytes, new: bytes, cause: str
) -> None:
    path, frames = recorded
    data = sidecar_of(path).read_bytes()
    assert data.count(old) == 1
    sidecar_of(path).write_bytes(data.replace(old, new))
    good: list[Frame] = []
    with ImageReader(path) as reader, pytest.raises(ImageFileError, match=cause) as caught:
        good.extend(frame for frame in reader)
    assert caught.value.code == "sidecar"
    assert caught.value.frame in (5, len(frames))


def test_swapped_lines_are_found(recorded: tuple[Path, list[Frame]]) -> None:
    path, _ = recorded
    lines = sidecar_of(path).read_bytes().splitlines(keepends=True)
    lines[3], lines[4] = lines[4], lines[3]
    sidecar_of(path).write_bytes(b"".join(lines))
    with pytest.raises(ImageFileError, match="out of order"):
        read_all(path)


def test_a_writer_refuses_what_it_cannot_record_and_goes_on(tmp_path: Path) -> None:
    frames = frames_of(4, 64, 48)
    path = tmp_path / "left.avi"
    with ImageWriter(path, "left", (64, 48), 30.0, limits=NO_LIMITS) as writer:
        writer.append(frames[1])
        for wrong, code in (
            (frames[0], "order"),
            (frames[1], "order"),
            (msgspec.structs.replace(frames[2], image=np.zeros((48, 63), np.uint8)), "frame"),
            (msgspec.structs.replace(frames[2], image=np.zeros((48, 64))), "frame"),
        ):
            with pytest.raises(ImageFileError) as caught:
                writer.append(wrong)
            assert caught.value.code == code
        writer.append(frames[3], left_out=1)
    with pytest.raises(ImageFileError, match="closed"):
        writer.append(frames[3])
    with pytest.raises(ImageFileError, match="never writes over another"):
        ImageWriter(path, "left", (64, 48), 30.0, limits=NO_LIMITS)
    good, reader = read_all(path)
    assert [frame.seq for frame in good] == [frames[1].seq, frames[3].seq]
    assert reader.end == ImageEnd(2, 1, "ended")


def test_a_recording_ends_at_its_limits(tmp_path: Path) -> None:
    frames = frames_of(40, 640, 480)
    free = shutil.disk_usage(tmp_path).free
    for name, limits, code in (
        ("size", ImageLimits(max_bytes=1 << 20, keep_free_bytes=0), "limit"),
        ("time", ImageLimits(max_seconds=0.25, keep_free_bytes=0), "limit"),
    ):
        path = tmp_path / f"{name}.avi"
        with ImageWriter(path, "left", (640, 480), 30.0, limits=limits) as writer:
            with pytest.raises(ImageFileError, match="Begin another") as caught:
                append_all(writer, frames)
            assert caught.value.code == code
        good, reader = read_all(path)
        assert 0 < len(good) == writer.frames < len(frames)
        assert whole(reader)
        assert writer.frames == 8 or name == "size"
        assert path.stat().st_size < 2 << 20
    with pytest.raises(ImageFileError, match="Make room") as caught:
        ImageWriter(tmp_path / "disk.avi", "left", (640, 480), 30.0, limits=ImageLimits(keep_free_bytes=2 * free))
    assert caught.value.code == "disk"
    assert not (tmp_path / "disk.avi").exists()


def test_a_disk_that_fills_up_is_told_and_what_was_written_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = frames_of(5, 64, 48)
    path = tmp_path / "left.avi"
    writer = ImageWriter(path, "left", (64, 48), 30.0, limits=ImageLimits(keep_free_bytes=1000))
    for frame in frames[:3]:
        writer.append(frame)
    full = os.statvfs_result((4096, 4096, 10**6, 0, 0, 10**6, 0, 0, 0, 255))
    monkeypatch.setattr(os, "statvfs", lambda path: full)
    with pytest.raises(ImageFileError, match="0 bytes are free") as caught:
        writer.append(frames[3])
    assert caught.value.code == "disk"
    writer.close(str(caught.value))
    good, reader = read_all(path)
    assert len(good) == 3
    assert reader.end is not None
    assert "bytes are free" in reader.end.why


def test_reading_takes_the_memory_of_a_frame_whatever_the_length(tmp_path: Path) -> None:
    """Peak of Python's memory over 400 frames against that over 20: no more, though 19 times the pictures pass."""
    peaks = []
    for count in (20, 400):
        path = record(tmp_path / f"{count}.avi", frames_of(count, 160, 120))
        tracemalloc.start()
        with ImageReader(path) as reader:
            assert sum(1 for _ in reader) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 160 * 120


def test_the_crc_is_that_of_the_rows_whatever_the_memory_layout() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30)).astype(np.uint8)
    assert crc_of(np.asfortranarray(image)) == crc_of(image) == zlib.crc32(image.tobytes())
