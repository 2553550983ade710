"""GenICam cameras, against aravis' own GigE Vision camera on loopback (Debian's aravis-tools)."""

import ctypes
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest

from stereoservo.ports.devices import CameraDriver, DriverContext, DriverError
from stereoservo_drivers.contracts import CameraDriverContract
from stereoservo_drivers.video.driver import VideoCameraDriver
from stereoservo_drivers.video.options import decode_video_options
from stereoservo_drivers.video.sources import LIBRARY, FrameNumbers

from .conftest import connected, poll_until

CONTROL_PORT = 3956
FAKE = "arv-fake-gv-camera-0.8"
OPTIONS = {"width": 512, "height": 512, "rate_hz": 25.0, "exposure": 5000.0, "gain": 3.0}


def missing() -> str:
    if shutil.which(FAKE) is None:
        return f"{FAKE} is not installed (aravis-tools)"
    try:
        ctypes.CDLL(LIBRARY)
    except OSError:
        return f"{LIBRARY} is not installed"
    return ""


pytestmark = pytest.mark.process
with_aravis = pytest.mark.skipif(bool(missing()), reason=missing())


@contextmanager
def fake_camera(address: str, *options: str) -> Iterator[subprocess.Popen[bytes]]:
    """A camera on a loopback ``address``, once it listens."""
    process = subprocess.Popen([FAKE, "-i", address, *options])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def answers(address: str) -> bool:
    """Whether a camera's control port is taken on ``address``."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, CONTROL_PORT))
        except OSError:
            return True
    return False


def camera_at(address: str, context: Any) -> VideoCameraDriver:
    """A driver of the camera at ``address``, not connected."""
    return VideoCameraDriver({"source": f"genicam://{address}", **OPTIONS}, context)


@pytest.fixture
def address() -> str:
    """Of the loopback interface, the only one there that the fake camera takes; its port is the protocol's."""
    if answers("127.0.0.1"):
        pytest.skip(f"port {CONTROL_PORT} of GigE Vision is taken on 127.0.0.1")
    return "127.0.0.1"


@with_aravis
@pytest.mark.parametrize("lost", [(), ("-r", "2")], ids=["all packets", "2 of 1000 packets lost"])
def test_pictures_come_whole_and_those_that_do_not_are_counted(
    context: Any, address: str, lost: tuple[str, ...]
) -> None:
    with fake_camera(address, *lost):
        driver = connected(camera_at(address, context))
        try:
            frames = poll_until(driver, 50)
            statistics = driver.statistics()
        finally:
            driver.close()
    numbers = np.array([frame.seq for frame in frames])
    assert np.all(np.diff(numbers) > 0)
    assert all(frame.image.shape == (512, 512) and frame.image.any() for frame in frames)
    assert (statistics.dropped > 5) is bool(lost)
    assert statistics.settings["exposure"] == (5000.0, 5000.0)
    assert statistics.settings["auto_exposure"] == (0.0, None), "this camera has none, and it is told"


@with_aravis
def test_a_camera_that_goes_away_is_told_and_taken_again_when_it_is_back(context: Any, address: str) -> None:
    with fake_camera(address):
        driver = connected(camera_at(address, context))
        poll_until(driver, 3)
        other = camera_at(address, context)
        with pytest.raises(DriverError, match="another program controls this camera") as caught:
            other.configure()
        assert caught.value.retry
        poll_until(driver, 3)  # it was not disturbed
    with pytest.raises(DriverError, match=r"gave no picture for 1 s|no picture for 1") as caught:
        poll_until(driver, 1000)
    assert caught.value.retry
    driver.close()
    with pytest.raises(DriverError, match=r"no such camera answers.*arv-tool") as caught:
        driver.configure()
    assert caught.value.retry
    with fake_camera(address):
        end = time.monotonic() + 20.0
        while driver.statistics().reconnects < 1 and time.monotonic() < end:
            with suppress(DriverError):
                driver.configure()
        driver.activate()
        poll_until(driver, 3)
        driver.close()


@with_aravis
def test_a_network_that_loses_packets_of_every_picture_is_the_cause_that_is_told(context: Any, address: str) -> None:
    with fake_camera(address, "-r", "100"):
        driver = camera_at(address, context)
        end = time.monotonic() + 20.0
        code = ""
        while code in ("", "not_opened") and time.monotonic() < end:
            with pytest.raises(DriverError) as caught:
                driver.configure()
            code = caught.value.code
        assert code == "corrupt"
        assert "packets are lost" in str(caught.value)


def test_a_counter_of_16_bits_goes_on() -> None:
    numbers = FrameNumbers()
    told = [65533, 65534, 65535, 1, 2, 3]
    assert np.all(np.diff([numbers.whole(number) for number in told]) == 1)
    assert np.all(np.diff([numbers.whole(number) for number in (9, 10, 11)]) == 1)
    fresh = FrameNumbers()
    assert [fresh.whole(number) for number in (900, 1, 70000, 70001)] == [900, 1, 70000, 70001], "begun again"


@pytest.mark.parametrize(("option", "value"), [("channel", "red"), ("pixel_format", "MJPG"), ("focus", 3.0)])
def test_options_that_such_cameras_have_not_are_refused(context: Any, option: str, value: Any) -> None:
    with pytest.raises(DriverError, match=f"{option} = .*genicam://"):
        decode_video_options({"source": "genicam://192.168.1.7", **OPTIONS, option: value}, context.cell_dir)


@with_aravis
class TestGenicam(CameraDriverContract):
    real_time = True

    @pytest.fixture(autouse=True)
    def _camera(self, address: str) -> Iterator[None]:
        self.address = address
        with fake_camera(address):
            deadline = time.monotonic() + 20.0
            while not answers(address) and time.monotonic() < deadline:
                time.sleep(0.05)
            yield

    def make_driver(self, context: DriverContext) -> CameraDriver:
        return camera_at(self.address, context)
