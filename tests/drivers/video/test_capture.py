"""Devices and streams that OpenCV reads, and threads that hang in it."""

from __future__ import annotations

import ctypes
import errno
import shutil
import subprocess
import threading
import time
from contextlib import nullcontext
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import pytest

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.video import sources
from stereoservo_drivers.video.driver import Reader
from stereoservo_drivers.video.options import Place, VideoOptions
from stereoservo_drivers.video.pictures import StreamMonitor
from stereoservo_drivers.video.sources import CaptureSource, SourcePicture

from .conftest import HEIGHT, WIDTH, number_of, picture, poll_until


def options(**more):
    return VideoOptions(source=0, width=WIDTH, height=HEIGHT, **more)


def failing(reader, limit_s=60.0):
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
    reader = Reader(CaptureSource(place, wanted, MonotonicClock()), place, wanted, "left", StreamMonitor(100.0))
    try:
        reader.open()
        numbers = []
        end = time.monotonic() + 60.0
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
    """Stands for `cv2.VideoCapture` of a camera."""

    def __init__(self, *_):
        self.values = {cv2.CAP_PROP_FPS: 30.0}
        self.order = []
        self.number = 0
        self.left = 40

    def isOpened(self):
        return True

    def set(self, what, value):
        self.order.append(what)
        self.values[what] = value
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


class Kernel:
    """Stands for the ioctls of a UVC camera: controls with range and step, as videodev2.h has them; no gain."""

    def __init__(self):
        base, camera = 0x980900, 0x9A0900
        self.ranges = {
            camera + 1: (0, 3, 1), camera + 2: (3, 2047, 5), camera + 3: (0, 1, 1), camera + 12: (0, 1, 1),
            camera + 10: (0, 250, 5), base + 12: (0, 1, 1), base + 26: (2800, 6500, 10), base + 24: (0, 2, 1),
        }  # fmt: skip
        self.values = {}
        self.order = []

    def __call__(self, request, structure):
        if request == sources.QUERY_CONTROL:
            if structure.id not in self.ranges:
                raise OSError(errno.EINVAL, "no such control")
            structure.minimum, structure.maximum, structure.step = self.ranges[structure.id]
        elif request == sources.SET_CONTROL:
            if structure.id == 0x9A0901 and structure.value in (0, 2):
                raise OSError(errno.EINVAL, "no such entry of the menu")
            least, _, step = self.ranges[structure.id]
            self.values[structure.id] = least + (structure.value - least) // step * step
            self.order.append(structure.id)
        elif request == sources.GET_CONTROL:
            structure.value = self.values[structure.id]
        else:
            self.enumerate(request, structure)

    def enumerate(self, request, structure):
        modes = {"YUYV": {(640, 480): (30, 15)}, "MJPG": {(640, 480): (60,), (1280, 720): (30,)}}
        if request == sources.ENUM_FORMAT:
            names = list(modes)
            if structure.index >= len(names):
                raise OSError(errno.EINVAL, "the end")
            structure.pixelformat = int.from_bytes(names[structure.index].encode(), "little")
            return
        sizes = modes[int(structure.pixel_format).to_bytes(4, "little").decode()]
        entries = list(sizes) if request == sources.ENUM_SIZES else sizes[structure.width, structure.height]
        if structure.index >= len(entries):
            raise OSError(errno.EINVAL, "the end")
        structure.type = 1
        if request == sources.ENUM_SIZES:
            structure.sizes[0], structure.sizes[1] = entries[structure.index]
        else:
            structure.intervals[0], structure.intervals[1] = 1, entries[structure.index]


@pytest.fixture
def device(monkeypatch):
    made = Device()
    made.kernel = Kernel()
    monkeypatch.setattr(sources.cv2, "VideoCapture", lambda *_: made)
    monkeypatch.setattr(CaptureSource, "_check_device", lambda self: None)
    monkeypatch.setattr(sources, "opened", lambda _path: nullcontext(made.kernel))
    return made


def test_what_a_device_is_asked_for_and_what_it_took(camera, device):
    driver = camera(
        0, exposure=124.0, gain=7.0, pixel_format="MJPG", rate_hz=60.0, focus=30, white_balance=4000,
        power_line_hz=50, rate_priority=True,
    )  # fmt: skip
    driver.configure()
    settings = driver.statistics().settings
    assert settings["width"] == (WIDTH, WIDTH)
    assert settings["rate_hz"] == (60.0, 60.0)
    assert device.order[0] == cv2.CAP_PROP_FOURCC  # the format decides on the sizes that can be had
    controls = {name: settings[name] for name in settings if name in sources.CONTROLS}
    assert controls == {
        "auto_exposure": (1.0, 1.0), "exposure": (124.0, 123.0), "gain": (7.0, None), "autofocus": (0.0, 0.0),
        "focus": (30.0, 30.0), "auto_white_balance": (0.0, 0.0), "white_balance": (4000.0, 4000.0),
        "power_line": (1.0, 1.0), "exposure_changes_rate": (0.0, 0.0),
    }  # fmt: skip
    order = device.kernel.order
    for lock, value in (
        ("auto_exposure", "exposure"),
        ("autofocus", "focus"),
        ("auto_white_balance", "white_balance"),
    ):
        assert order.index(sources.CONTROLS[lock]) < order.index(sources.CONTROLS[value])
    driver.close()
    assert driver.statistics().settings == settings


def test_a_device_chooses_itself_where_that_is_asked(camera, device):
    driver = camera(0, exposure="auto", focus="auto", white_balance="auto", rate_priority=False)
    driver.configure()
    settings = driver.statistics().settings
    assert settings["auto_exposure"] == (3.0, 3.0)  # aperture priority: what UVC cameras call automatic
    assert settings["autofocus"] == settings["auto_white_balance"] == settings["exposure_changes_rate"] == (1.0, 1.0)
    assert not {"exposure", "focus", "white_balance"} & set(settings)


def test_a_device_is_left_alone_where_nothing_is_asked(camera, device):
    driver = camera(0)
    driver.configure()
    assert device.kernel.order == []
    assert set(driver.statistics().settings) == {"width", "height", "rate_hz"}


def test_a_value_out_of_range_is_told_with_the_range(camera, device):
    with pytest.raises(DriverError) as caught:
        camera(0, focus=500).configure()
    assert caught.value.code == "setting"
    assert "focus = 500; this device takes 0 to 250 in steps of 5" in str(caught.value)


def test_a_size_that_a_device_has_not_is_told_with_its_modes(camera, device, monkeypatch):
    monkeypatch.setattr(device, "get", lambda what: 640.0 if what == cv2.CAP_PROP_FRAME_WIDTH else device.values[what])
    with pytest.raises(DriverError) as caught:
        camera(0).configure()
    assert caught.value.code == "image_size"
    assert "YUYV 640x480 at 30, 15 Hz; MJPG 640x480 at 60 Hz; MJPG 1280x720 at 30 Hz" in str(caught.value)


@pytest.mark.skipif(
    shutil.which("gcc") is None or not Path("/usr/include/linux/videodev2.h").exists(),
    reason="needs gcc and the kernel's headers",
)
def test_structures_requests_and_controls_are_those_of_the_kernels_header(tmp_path):
    structures = {
        "v4l2_queryctrl": sources.QueryControl, "v4l2_control": sources.Control,
        "v4l2_fmtdesc": sources.FormatDescription, "v4l2_frmsizeenum": sources.FrameSize,
        "v4l2_frmivalenum": sources.FrameInterval,
    }  # fmt: skip
    renamed = {("v4l2_frmsizeenum", "sizes"): "discrete", ("v4l2_frmivalenum", "intervals"): "discrete"}
    expected = {}
    for name, structure in structures.items():
        expected[f"sizeof(struct {name})"] = ctypes.sizeof(structure)
        for field, _ in structure._fields_:
            theirs = renamed.get((name, field), field)
            expected[f"offsetof(struct {name}, {theirs})"] = getattr(structure, field).offset
    expected |= {
        "VIDIOC_QUERYCTRL": sources.QUERY_CONTROL, "VIDIOC_G_CTRL": sources.GET_CONTROL,
        "VIDIOC_S_CTRL": sources.SET_CONTROL, "VIDIOC_ENUM_FMT": sources.ENUM_FORMAT,
        "VIDIOC_ENUM_FRAMESIZES": sources.ENUM_SIZES,
        "VIDIOC_ENUM_FRAMEINTERVALS": sources.ENUM_INTERVALS, "V4L2_CTRL_FLAG_DISABLED": sources.DISABLED,
        "V4L2_BUF_TYPE_VIDEO_CAPTURE": sources.CAPTURE, "V4L2_FRMSIZE_TYPE_DISCRETE": sources.DISCRETE,
        "V4L2_FRMIVAL_TYPE_DISCRETE": sources.DISCRETE, "V4L2_EXPOSURE_AUTO": sources.EXPOSURE_AUTO,
        "V4L2_EXPOSURE_MANUAL": sources.EXPOSURE_MANUAL,
        "V4L2_EXPOSURE_APERTURE_PRIORITY": sources.EXPOSURE_APERTURE_PRIORITY,
        "V4L2_CID_POWER_LINE_FREQUENCY_DISABLED": sources.POWER_LINE[0],
        "V4L2_CID_POWER_LINE_FREQUENCY_50HZ": sources.POWER_LINE[50],
        "V4L2_CID_POWER_LINE_FREQUENCY_60HZ": sources.POWER_LINE[60],
    }  # fmt: skip
    theirs = {
        "auto_exposure": "EXPOSURE_AUTO", "exposure": "EXPOSURE_ABSOLUTE",
        "exposure_changes_rate": "EXPOSURE_AUTO_PRIORITY", "autofocus": "FOCUS_AUTO",
        "focus": "FOCUS_ABSOLUTE", "auto_white_balance": "AUTO_WHITE_BALANCE",
        "white_balance": "WHITE_BALANCE_TEMPERATURE", "gain": "GAIN", "power_line": "POWER_LINE_FREQUENCY",
    }  # fmt: skip
    expected |= {f"V4L2_CID_{theirs[name]}": number for name, number in sources.CONTROLS.items()}
    lines = [f'printf("%lu\\n", (unsigned long)({what}));' for what in expected]
    source = tmp_path / "header.c"
    source.write_text(
        "#include <stdio.h>\n#include <stddef.h>\n#include <linux/videodev2.h>\nint main(void) {\n"
        + "\n".join(lines) + "\nreturn 0; }\n"
    )  # fmt: skip
    subprocess.run(["gcc", "-o", str(tmp_path / "header"), str(source)], check=True)
    printed = subprocess.run([str(tmp_path / "header")], check=True, capture_output=True, text=True).stdout.split()
    assert dict(zip(expected, map(int, printed), strict=True)) == expected


@pytest.mark.parametrize(("told", "believed"), [("ago", True), ("never", False), ("future", False), ("old", False)])
def test_a_picture_has_the_time_at_which_the_kernel_took_it(camera, device, monkeypatch, told, believed):
    """One that waited in the queue of a busy computer is as old as it is."""
    stamps = []

    def get(what):
        if what != cv2.CAP_PROP_POS_MSEC:
            return device.values.get(what, -1.0)
        now_ms = time.monotonic_ns() * 1e-6
        stamps.append({"ago": now_ms - 40.0, "never": -1.0, "future": now_ms + 2e3, "old": now_ms - 2e3}[told])
        return stamps[-1]

    monkeypatch.setattr(device, "get", get)
    device.values |= {cv2.CAP_PROP_FRAME_WIDTH: WIDTH, cv2.CAP_PROP_FRAME_HEIGHT: HEIGHT}
    driver = camera(0)
    driver.configure()
    driver.activate()
    (frame,) = poll_until(driver, 1)
    received_ms = frame.t_received_ns * 1e-6
    assert any(abs(received_ms - stamp) < 1e-3 for stamp in stamps) is believed


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
            self.let_go.wait(60.0)

    def read(self):
        self.number += 1
        if self.number > 1:
            self.let_go.wait(60.0)
        return SourcePicture(picture(self.number), time.monotonic_ns())

    def interrupt(self):
        """Cannot."""

    def release(self):
        self.released.set()


@pytest.mark.parametrize("hang_in_open", [False, True])
def test_a_thread_that_hangs_is_abandoned_and_what_it_gets_late_is_not_delivered(hang_in_open, monkeypatch):
    monkeypatch.setattr("stereoservo_drivers.video.driver.JOIN_S", 0.05)
    source, watch = Hanging(hang_in_open), StreamMonitor(30.0)
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
    assert source.released.wait(60.0)
    reader.close()
    assert not reader.abandoned
    assert watch.frames == counted
    assert reader._newest is None


def test_pictures_of_one_time_stay_in_order():
    source = Hanging()
    step = threading.Semaphore(0)
    reads = iter([SourcePicture(picture(1), 500), SourcePicture(picture(2), 500), SourcePicture(picture(3), 499)])

    def read():
        step.acquire(timeout=60.0)
        return next(reads, None)

    source.read, source.interrupt = read, step.release
    place = Place("device", "/dev/video0", device=0)
    reader = Reader(source, place, options(read_timeout_s=30.0), "left", StreamMonitor(30.0))
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
    reader = Reader(source, place, options(), "left", StreamMonitor(30.0))
    with pytest.raises(DriverError) as caught:
        reader.open()
    assert caught.value.code == "reader"
    assert "ZeroDivisionError" in str(caught.value)
    reader.close()
    assert source.released.is_set()
