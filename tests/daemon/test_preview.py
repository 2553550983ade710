"""Preview pictures: encoded only while they are wanted, and passed through a slot."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoservo.daemon.preview import (
    EVERY_NS,
    PICTURE_CAPACITY,
    PICTURE_LAYOUT,
    REQUEST_BYTES,
    REQUEST_LAYOUT,
    REQUEST_S,
    PreviewEncoder,
    PreviewPicture,
    PreviewRequest,
    encode_jpeg,
)
from stereoservo.daemon.seqlock import create_slot
from stereoservo.messages.directories import CellDirectories
from stereoservo.ports.devices import Frame


@pytest.fixture
def directories(tmp_path: Path) -> CellDirectories:
    found = CellDirectories("cell", tmp_path, tmp_path)
    create_slot(found.preview_slot("left"), PICTURE_CAPACITY, PICTURE_LAYOUT)
    create_slot(found.preview_request_slot("left"), REQUEST_BYTES, REQUEST_LAYOUT)
    return found


def frame(seq: int) -> Frame:
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    now = time.monotonic_ns()
    return Frame("left", seq, now, now, (128 + 100 * np.sin(u / 40) * np.cos(v / 30)).astype(np.uint8))


def picture_of(request: PreviewRequest) -> PreviewPicture:
    until = time.monotonic() + 20.0
    while (found := request.poll()) is None:
        assert time.monotonic() < until, "no picture came"
        time.sleep(0.002)
    return found


def test_pictures_come_only_while_they_are_wanted(directories: CellDirectories) -> None:
    request, encoder = PreviewRequest(directories, "left"), PreviewEncoder(directories, "left")
    now = time.monotonic_ns()
    encoder.offer(frame(1), now)
    assert encoder._thread is None, "no thread before somebody looks"
    request.ask()
    sent = frame(2)
    encoder.offer(sent, now)
    found = picture_of(request)
    assert (found.seq, found.width, found.height, found.t_shutter_ns) == (2, 320, 240, sent.t_shutter_ns)
    shown = cv2.imdecode(np.frombuffer(found.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(shown.astype(float) - sent.image).mean() < 2.0
    encoder.offer(frame(3), now + EVERY_NS - 1)  # too soon
    encoder.offer(frame(4), now + EVERY_NS)
    assert picture_of(request).seq == 4
    encoder.offer(frame(5), time.monotonic_ns() + int(REQUEST_S * 1e9) + 1)  # nobody renewed
    encoder.close()
    assert request.poll() is None
    request.close()


def test_large_and_noisy_pictures_fit_the_slot() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (1944, 2592), dtype=np.uint8)
    data = encode_jpeg(noise)
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert len(data) < PICTURE_CAPACITY - 1024
    assert shown.shape == (1944 // 5, 2592 // 5)
    assert len(encode_jpeg(noise[:480, :640])) < PICTURE_CAPACITY - 1024
