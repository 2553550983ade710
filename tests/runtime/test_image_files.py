"""Recorded cameras: lossless, checked, bounded, and readable as far as they go."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stereoservo.runtime.image_files import (
    ImageLimits,
    ImageReader,
    ImageWriter,
)
from stereoservo.runtime.ports import Frame

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


def record(path: Path, frames: list[Frame]) -> Path:
    """A closed recording of ``frames``."""
    height, width = frames[0].image.shape
    with ImageWriter(path, "left", (width, height), 30.0, driver="test", limits=NO_LIMITS) as writer:
        for frame in frames:
            writer.append(frame)
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
    assert reader.whole
    assert reader.header.width == width
    assert reader.header.height == height
