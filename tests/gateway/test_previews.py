"""The gateway's `Previews`: who subscribes makes it ask, and what a camera's process has written is published."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from stereoservo.daemon.preview import (
    PICTURE_CAPACITY,
    PICTURE_LAYOUT,
    REQUEST_BYTES,
    REQUEST_LAYOUT,
    REQUEST_S,
    PreviewPicture,
)
from stereoservo.daemon.seqlock import SlotReader, SlotWriter, create_slot
from stereoservo.gateway.publisher import PREVIEW_ASK_S, Previews
from stereoservo.messages.directories import CellDirectories
from stereoservo.messages.wire import PreviewInfo


class Publisher:
    """Of one camera: whether somebody subscribes, and what is published."""

    def __init__(self) -> None:
        self.matching_status = SimpleNamespace(matching=False)
        self.put_: list[tuple[bytes, PreviewInfo]] = []

    def put(self, data: bytes, attachment: Any) -> None:
        self.put_.append((data, msgspec.json.decode(bytes(attachment), type=PreviewInfo)))


class Clock:
    """Stands in for the module ``time``: it moves only when it is told."""

    ns = 5_000_000_000

    def monotonic(self) -> float:
        return self.ns * 1e-9

    def monotonic_ns(self) -> int:
        return self.ns

    def time(self) -> float:
        return 1e9 + self.ns * 1e-9


def test_pictures_are_asked_for_and_published_only_where_somebody_subscribes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directories = CellDirectories("cell", tmp_path, tmp_path)
    for camera in ("left", "right"):
        create_slot(directories.preview_slot(camera), PICTURE_CAPACITY, PICTURE_LAYOUT)
        create_slot(directories.preview_request_slot(camera), REQUEST_BYTES, REQUEST_LAYOUT)
    slots = {
        camera: SlotWriter(directories.preview_slot(camera), PICTURE_CAPACITY, PICTURE_LAYOUT)
        for camera in ("left", "right")
    }
    wanted = {
        camera: SlotReader(directories.preview_request_slot(camera), REQUEST_LAYOUT) for camera in ("left", "right")
    }
    publishers = {"left": Publisher(), "right": Publisher()}
    clock = Clock()
    monkeypatch.setattr("stereoservo.gateway.publisher.time", clock)
    monkeypatch.setattr("stereoservo.daemon.preview.time", clock)
    previews = Previews(publishers, directories)

    def poll(seq: int, age_s: float = 0.1, later_s: float = PREVIEW_ASK_S + 0.01) -> None:
        clock.ns += int(later_s * 1e9)
        shutter = clock.ns - int(age_s * 1e9)
        for camera, slot in slots.items():
            slot.write(msgspec.msgpack.encode(PreviewPicture(camera, seq, shutter, 1280, 960, b"jpeg %d" % seq)))
        previews.poll()

    poll(1)
    assert publishers["left"].put_ == [], "nobody looks"
    assert wanted["left"].poll() is None, "no camera works for it"

    publishers["left"].matching_status.matching = True
    poll(2)
    (found,) = publishers["left"].put_
    assert found[0] == b"jpeg 2"
    shown = (found[1].camera, found[1].seq, found[1].width, found[1].height)
    assert shown == ("left", 2, 1280, 960)
    assert found[1].t_wall == pytest.approx(clock.time() - 0.1, abs=1e-6), "of the shutter"
    request = wanted["left"].poll()
    assert request is not None
    assert int.from_bytes(request, "little") == clock.ns + int(REQUEST_S * 1e9), "until when it holds"
    assert publishers["right"].put_ == []
    assert wanted["right"].poll() is None

    previews.poll()
    assert len(publishers["left"].put_) == 1, "each once"
    poll(3, age_s=REQUEST_S + 0.1)
    assert len(publishers["left"].put_) == 1, "what was left from the last time that somebody looked"
    assert wanted["left"].poll() is not None, "it is asked for again while somebody looks"
    poll(4, later_s=0.001)
    assert [data for data, _ in publishers["left"].put_] == [b"jpeg 2", b"jpeg 4"]
    assert wanted["left"].poll() is None, "not at every turn"

    publishers["left"].matching_status.matching = False
    poll(5)
    assert len(publishers["left"].put_) == 2
    assert wanted["left"].poll() is None
    previews.close()
    for slot in (*slots.values(), *wanted.values()):
        slot.close()
