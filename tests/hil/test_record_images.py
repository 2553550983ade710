"""``record --images`` on a live daemon whose cameras play a recording: what they show is in the files, bit for bit."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stereoservo.client import Client
from stereoservo.messages.discovery import DaemonProcess
from stereoservo.ports.devices import Frame
from stereoservo.ports.image_files import ImageLimits, ImageReader, ImageWriter
from stereoservo.recording.replay import replay

from .conftest import CELL, eventually

pytestmark = pytest.mark.process

PICTURES = 7


def pictures(seed: int) -> list[np.ndarray]:
    """A few pictures that all differ."""
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 60, (96, 128)).astype(np.uint8) for _ in range(PICTURES)]


@pytest.fixture
def playing(cell_file: Path, tmp_path: Path) -> Path:
    """The cell with cameras that play a recording again and again."""
    cameras = []
    for seed, name in enumerate(("left", "right")):
        video = tmp_path / f"{name}.avi"
        with ImageWriter(video, name, (128, 96), 30.0, limits=ImageLimits(keep_free_bytes=0)) as writer:
            for k, picture in enumerate(pictures(seed)):
                t_ns = 10**9 + round(k * 1e9 / 30.0)
                writer.append(Frame(name, k, t_ns, t_ns, picture))
        cameras.append(
            f'[[camera]]\nname = "{name}"\ndriver = "video"\ndetector = "dots"\n'
            f'options = {{ source = "{video}", width = 128, height = 96, loop = true }}\n'
        )
    text = cell_file.read_text()
    head, _, rest = text.partition("[[camera]]")
    tail = re.search(r"^\[(?!\[?camera)", rest, re.MULTILINE)
    assert tail is not None
    path = tmp_path / "playing.toml"
    path.write_text(head + "\n".join(cameras) + "\n" + rest[tail.start() :])
    return path


def shown(path: Path, seed: int) -> int:
    """Check a recorded camera against what it played; the number of its frames."""
    known = [picture.tobytes() for picture in pictures(seed)]
    with ImageReader(path) as reader:
        frames = list(reader)
    assert reader.lost == 0
    assert reader.end is not None
    numbers = [known.index(frame.image.tobytes()) for frame in frames]
    assert len(set(numbers)) > 1
    stamps = np.array([frame.t_received_ns for frame in frames])
    assert (np.diff(stamps) > 0).all()
    return len(frames)


def test_what_cameras_show_is_recorded_beside_the_flight(playing: Path, start: Callable[..., DaemonProcess]) -> None:
    daemon = start(playing)
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "stereoservo.cli.main",
            "record",
            CELL,
            "--images",
            "--seconds",
            "1",
            "--json",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    result = json.loads(done.stdout)
    flight = Path(result["file"])
    images = flight.with_suffix(".images")
    assert result["images"]["directory"] == str(images)
    for seed, one in enumerate(result["images"]["cameras"]):
        assert one["file"] == str(images / f"{one['camera']}.avi")
        assert one["why"] == "ended"
        assert shown(images / f"{one['camera']}.avi", seed) == one["frames"]
    assert replay(flight).identical is True
    with Client(CELL) as client:  # a recording that the daemon's end cuts short ends whole
        client.record(images=True)
        eventually("it records", lambda: bool(client.info().recording))
        second = Path(client.info().recording).with_suffix(".images")
        eventually("pictures come", lambda: len(list(second.glob("*.jsonl"))) == 2)
        lines = second / "left.jsonl"
        eventually("several", lambda: lines.read_bytes().count(b"\n") > 5)
    assert daemon.stop() == 0
    for seed, name in enumerate(("left", "right")):
        assert shown(second / f"{name}.avi", seed) > 0
