"""Devices and streams that OpenCV reads, and threads that hang in it."""

from __future__ import annotations

import threading
import time
from urllib.parse import urlsplit

import cv2
import pytest

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.video import sources
from stereoservo_drivers.video.options import Place, VideoOptions
from stereoservo_drivers.video.reader import Reader
from stereoservo_drivers.video.sources import CaptureSource, SourcePicture
from stereoservo_drivers.video.stream_monitor import Watch

from .conftest import HEIGHT, WIDTH, number_of, picture


def options(**more):
    return VideoOptions(source=0, width=WIDTH, height=HEIGHT, **more)


def failing(reader, limit_s=20.0):
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        try:
            reader.take()
        except DriverError as error:
            return error
        time.sleep(0.001)
    pytest.fail(f"no error within {limit_s} s")


def test_a_stream_through_opencv_gives_pictures_until_it_breaks(server):
    """What RTSP goes through, on a protocol that can be served here."""
    place = Place("rtsp", server.url, url=urlsplit(server.url))
    wanted = options(read_timeout_s=5.0, rate_hz=100.0)
    reader = Reader(CaptureSource(place, wanted, MonotonicClock()), place, wanted, "left", Watch(100.0))
    try:
        reader.open()
        numbers = []
        end = time.monotonic() + 20.0
        while len(numbers) < 10 and time.monotonic() < end:
            frame = reader.take()
            if frame is not None:
                numbers.append(number_of(frame.image))
            time.sleep(0.001)
        assert len(numbers) == 10
        assert numbers == sorted(set(numbers))
        server.close()
        error = failing(reader)
        assert (error.code, error.retry) == ("connection_lost", True)
    finally:
        reader.close()


@pytest.mark.parametrize("wanted", ["refused", "silent"])
def test_rtsp_that_does_not_answer(camera, silent_port, server, wanted):
    server.close()
    port = silent_port if wanted == "silent" else server.port
    driver = camera(f"rtsp://me:secret@127.0.0.1:{port}/live", open_timeout_s=0.3)
    with pytest.raises(DriverError) as caught:
        driver.configure()
    assert caught.value.code in ("not_opened", "open_timeout")
    assert caught.value.retry
    assert f"127.0.0.1:{port}/live" in str(caught.value)
    assert "secret" not in str(caught.value)


def test_a_device_that_is_not_there(camera):
    with pytest.raises(DriverError) as caught:
        camera(63).configure()
    assert (caught.value.code, caught.value.retry) == ("missing", True)
    assert "/dev/video63" in str(caught.value)


def test_a_device_that_is_no_camera(camera):
    with pytest.raises(DriverError) as caught:
        camera("/dev/null").configure()
    assert (caught.value.code, caught.value.retry) == ("not_opened", True)


class Device:
    """Stands for `cv2.VideoCapture` of a camera that knows exposure in steps of 5, and no gain."""

    def __init__(self, *_):
        self.values = {cv2.CAP_PROP_FPS: 30.0}
        self.order = []
        self.number = 0
        self.left = 40

    def isOpened(self):
        return True

    def set(self, what, value):
        self.order.append(what)
        if what == cv2.CAP_PROP_GAIN:
            return False
        self.values[what] = value // 5 * 5 if what == cv2.CAP_PROP_EXPOSURE else value
        return True

    def get(self, what):
        return self.values.get(what, -1.0)

    def grab(self):
        time.sleep(0.001)
        self.number += 1
        return self.number < self.left

    def retrieve(self):
        return True, cv2.merge([picture(self.number)] * 3)

    def release(self):
        self.left = 0


@pytest.fixture
def device(monkeypatch, tmp_path):
    made = Device()
    monkeypatch.setattr(sources.cv2, "VideoCapture", lambda *_: made)
    monkeypatch.setattr(CaptureSource, "_check_device", lambda self: None)
    return made


def test_what_a_device_is_asked_for_and_what_it_took(camera, device):
    driver = camera(0, exposure=123.0, gain=7.0, pixel_format="MJPG", rate_hz=60.0)
    driver.configure()
    settings = driver.statistics().settings
    assert settings["exposure"] == (123.0, 120.0)
    assert settings["gain"] == (7.0, None)
    assert settings["width"] == (WIDTH, WIDTH)
    assert settings["rate_hz"] == (60.0, 60.0)
    assert device.order[0] == cv2.CAP_PROP_FOURCC  # the format decides on the sizes that can be had
    assert device.order.index(cv2.CAP_PROP_AUTO_EXPOSURE) < device.order.index(cv2.CAP_PROP_EXPOSURE)
    driver.close()
    assert driver.statistics().settings == settings


def test_a_device_is_left_alone_where_nothing_is_asked(camera, device):
    driver = camera(0)
    driver.configure()
    assert not {cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_GAIN, cv2.CAP_PROP_AUTO_EXPOSURE} & set(device.order)
    assert set(driver.statistics().settings) == {"width", "height", "rate_hz"}


def test_an_unplugged_device_is_lost(camera, device):
    driver = camera(0)
    driver.configure()
    driver.activate()
    error = failing(driver._feed)
    assert (error.code, error.retry) == ("connection_lost", True)


class Hanging:
    """A source that gives one picture and then hangs until it is let go; it cannot be interrupted."""

    def __init__(self, hang_in_open=False):
        self.settings = {}
        self.let_go = threading.Event()
        self.released = threading.Event()
        self.number = 0
        self.hang_in_open = hang_in_open

    def open(self):
        if self.hang_in_open:
            self.let_go.wait(30.0)

    def read(self):
        self.number += 1
        if self.number > 1:
            self.let_go.wait(30.0)
        return SourcePicture(picture(self.number), time.monotonic_ns())

    def interrupt(self):
        """Cannot."""

    def release(self):
        self.released.set()


@pytest.mark.parametrize("hang_in_open", [False, True])
def test_a_thread_that_hangs_is_abandoned_and_what_it_gets_late_is_not_delivered(hang_in_open, monkeypatch):
    monkeypatch.setattr("stereoservo_drivers.video.reader.JOIN_S", 0.05)
    source, watch = Hanging(hang_in_open), Watch(30.0)
    place = Place("device", "/dev/video0", device=0)
    reader = Reader(source, place, options(open_timeout_s=0.05), "left", watch)
    if hang_in_open:
        with pytest.raises(DriverError) as caught:
            reader.open()
        assert caught.value.code == "open_timeout"
    else:
        reader.open()
    counted = watch.frames
    reader.close()
    assert reader.abandoned
    assert not source.released.is_set()
    source.let_go.set()
    assert source.released.wait(20.0)
    reader.close()
    assert not reader.abandoned
    assert watch.frames == counted
    assert reader._newest is None


def test_pictures_of_one_time_stay_in_order():
    source = Hanging()
    step = threading.Semaphore(0)
    reads = iter(
        [SourcePicture(picture(1), 500), SourcePicture(picture(2), 500), SourcePicture(picture(3), 499)]
    )

    def read():
        step.acquire(timeout=10.0)
        return next(reads, None)

    source.read, source.interrupt = read, step.release
    place = Place("device", "/dev/video0", device=0)
    reader = Reader(source, place, options(read_timeout_s=30.0), "left", Watch(30.0))
    step.release()
    reader.open()
    frames = [reader.take()]
    for _ in range(2):
        step.release()
        while (frame := reader.take()) is None:
            time.sleep(0.001)
        frames.append(frame)
    assert [frame.t_received_ns for frame in frames] == [500, 501, 502]
    reader.close()
    assert not reader.abandoned


def test_a_bug_in_a_source_is_told_and_not_silent(monkeypatch):
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    source = Hanging()
    source.read = lambda: 1 // 0
    place = Place("device", "/dev/video0", device=0)
    reader = Reader(source, place, options(), "left", Watch(30.0))
    with pytest.raises(DriverError) as caught:
        reader.open()
    assert caught.value.code == "reader"
    assert "ZeroDivisionError" in str(caught.value)
    reader.close()
    assert source.released.is_set()
