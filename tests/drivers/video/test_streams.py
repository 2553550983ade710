"""MJPEG over HTTP: newest frames, stamps, counts; and servers that break, stall, lie, or come back."""

from __future__ import annotations

import base64
import gc
import os
import socket
import threading
import time

import numpy as np
import pytest

from stereoservo.daemon.lockstep import MemoryVisionLinks
from stereoservo.daemon.vision import CameraPipeline, camera_loop, run_camera
from stereoservo.ports.devices import CameraObservation, CountingCameraDriver, DriverError
from stereoservo_drivers.video.driver import VideoCameraDriver
from stereoservo_drivers.video.server_clock import ServerClock

from .conftest import HEIGHT, WIDTH, MjpegServer, jpeg, number_of, picture, poll_until


def start(driver):
    driver.configure()
    driver.activate()
    return driver


def failure(driver, limit_s=60.0):
    """What polling raises in the end."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        try:
            driver.poll()
        except DriverError as error:
            return error
        time.sleep(0.001)
    pytest.fail(f"no error within {limit_s} s")


def wait_for(condition, limit_s=60.0):
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, f"not within {limit_s} s"
        time.sleep(0.001)


def refused(driver):
    with pytest.raises(DriverError) as caught:
        driver.configure()
    return caught.value


def threads_of(name="video-left"):
    return [thread for thread in threading.enumerate() if thread.name == name]


def once(*writes):
    """A stream of these writes by ``(handler) -> None``, kept open until the server ends."""

    def stream(server):
        def run(handler):
            for write in writes:
                write(handler)
            server.ended.wait()

        return run

    return stream


def test_it_tells_its_counts(camera, server):
    assert isinstance(camera(server.url), CountingCameraDriver)


def test_pictures_with_stamps_between_sending_and_polling(camera, server, context):
    sent = {}

    def stream(handler):
        for number in range(200):
            if server.ended.wait(0.005):
                return
            sent[number] = time.monotonic_ns()
            server.part(handler, jpeg(picture(number)), f"X-Sequence: {number}\r\n")

    server.stream = stream
    driver = start(camera(server.url, latency_s=0.02, rate_hz=200.0))
    for frame in poll_until(driver, 20):
        assert sent[number_of(frame.image)] <= frame.t_received_ns <= context.clock.now_ns()
        assert frame.t_received_ns - frame.t_shutter_ns == 20_000_000
        assert frame.camera == "left"


def test_a_slow_consumer_gets_the_newest_picture_once(camera, server):
    go_on = threading.Event()

    def stream(handler):
        for number in range(1, 31):
            server.part(handler, jpeg(picture(number)), f"X-Sequence: {number}\r\n")
            if number % 10 == 1:
                go_on.wait(60.0)
                go_on.clear()
        server.ended.wait()

    server.stream = stream
    driver = start(camera(server.url, read_timeout_s=30.0))
    for last in (11, 21, 30):
        go_on.set()
        wait_for(lambda last=last: driver.statistics().frames == last)
        (frame,) = driver.poll()
        assert (frame.seq, number_of(frame.image)) == (last - 1, last)
        assert driver.poll() == []


def test_gaps_of_the_servers_numbers_are_counted_as_dropped(camera, server):
    numbers = [3, 4, 7, 8, 20]
    go_on = threading.Event()

    def stream(handler):
        for number in numbers:
            go_on.wait(60.0)
            go_on.clear()
            server.part(handler, jpeg(picture(number)), f"X-Sequence: {number}\r\n")
        server.ended.wait()

    server.stream = stream
    driver = camera(server.url, read_timeout_s=30.0)
    go_on.set()
    start(driver)
    frames = []
    for _ in numbers[1:]:
        go_on.set()
        frames += poll_until(driver, 1)
    assert [frame.seq for frame in frames] == [1, 4, 5, 17]
    statistics = driver.statistics()
    assert (statistics.frames, statistics.dropped) == (5, 13)


def test_pictures_without_lengths(camera, server):
    def stream(handler):
        for number in range(10_000):
            if server.ended.wait(0.005):
                return
            handler.wfile.write(b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + jpeg(picture(number)) + b"\r\n")

    server.stream = stream
    frames = poll_until(start(camera(server.url)), 5)
    numbers = [number_of(frame.image) for frame in frames]
    assert numbers == sorted(set(numbers))


def test_red_of_a_colour_stream_turned(camera, server):
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[:, : WIDTH // 2, 2] = 200
    server.stream = once(lambda handler: server.part(handler, jpeg(image)))(server)
    driver = camera(server.url, channel="red", flip="horizontal", read_timeout_s=30.0)
    driver.configure()
    frames = driver._feed.take()  # before activate() lets go of what came earlier
    assert frames.image.shape == (HEIGHT, WIDTH)
    assert frames.image[:, : WIDTH // 2 - 8].max() < 20
    assert frames.image[:, WIDTH // 2 + 8 :].min() > 180


def test_cut_pictures_are_withheld_and_whole_ones_go_on(camera, server):
    whole = [jpeg(picture(number)) for number in range(60)]

    def stream(handler):
        for number, data in enumerate(whole):
            if server.ended.wait(0.005):
                return
            cut = number % 3 == 1
            headers = f"X-Sequence: {number}\r\n"
            server.part(handler, data[: len(data) // 2] if cut else data, headers, len(data) if number % 2 else None)
        server.ended.wait()

    server.stream = stream
    driver = start(camera(server.url, read_timeout_s=30.0))
    seen = {number_of(frame.image) for frame in poll_until(driver, 15)}
    assert not seen & set(range(1, 60, 3))
    assert driver.statistics().dropped >= 4


@pytest.mark.parametrize("data", [b"\xff\xd8\xff no jpeg \xff\xd9", jpeg(picture(1))[:-30]])
def test_a_stream_of_nothing_but_damaged_pictures_is_told(camera, server, data):
    def stream(handler):
        while not server.ended.wait(0.002):
            server.part(handler, data)

    server.stream = stream
    error = refused(camera(server.url))
    assert error.code == "corrupt"
    assert error.retry


def test_the_first_picture_is_checked_against_the_cell_file(camera, server):
    error = refused(camera(server.url, width=320, height=240))
    assert error.code == "image_size"
    assert "64x48" in str(error)
    assert "320x240" in str(error)


def test_a_size_that_changes_is_told(camera, server):
    def stream(handler):
        for number in range(1000):
            if server.ended.wait(0.005):
                return
            server.part(handler, jpeg(picture(number) if number < 20 else picture(number, 96, 64)))

    server.stream = stream
    assert failure(start(camera(server.url))).code == "image_size"


@pytest.mark.parametrize(
    ("status", "part"), [(404, "path of its MJPEG stream"), (401, "user:password@host"), (503, "503")]
)
def test_a_server_that_refuses_is_told_with_its_status(camera, server, status, part):
    server.status = status
    error = refused(camera(server.url))
    assert (error.code, error.data["status"]) == ("http_status", status)
    assert part in str(error)
    assert error.retry == (status >= 500)


@pytest.mark.parametrize("told", ["text/html", "image/jpeg", "multipart/x-mixed-replace", "video/mp4"])
def test_a_body_of_pictures_is_read_whatever_the_head_says(camera, server, told):
    server.content_type = told
    assert len(poll_until(start(camera(server.url)), 3)) == 3


@pytest.mark.parametrize(
    ("told", "retry"), [("text/html", False), ("video/mp4", False), ("application/octet-stream", True)]
)
def test_what_is_no_mjpeg_is_told(camera, server, told, retry):
    server.content_type = told
    server.stream = lambda handler: handler.wfile.write(b"<html><h1>Camera</h1></html>")
    error = refused(camera(server.url))
    assert (error.code, error.retry) == ("not_mjpeg", retry)
    assert told in str(error)
    assert "path of the camera's MJPEG stream" in str(error)


def test_a_stream_without_an_end_and_without_pictures_is_told(camera, server):
    server.stream = lambda handler: [handler.wfile.write(bytes(65536)) for _ in range(64)]
    error = refused(camera(server.url))
    assert (error.code, error.retry) == ("not_mjpeg", True)


def test_parts_that_are_no_jpeg_are_told(camera, server):
    def stream(handler):
        handler.wfile.write(b"--frame\r\nContent-Type: text/plain\r\nContent-Length: 2\r\n\r\nhi\r\n")
        server.ended.wait()

    server.stream = stream
    error = refused(camera(server.url, read_timeout_s=0.1))
    assert (error.code, error.retry) == ("not_mjpeg", True)
    assert "multipart/x-mixed-replace" in str(error)


def test_a_redirection_is_followed_and_a_circle_of_them_is_not(camera, server):
    other = MjpegServer()
    try:
        other.status, other.reply = 302, {"Location": server.url}
        assert len(poll_until(start(camera(other.url)), 2)) >= 2
        other.reply = {"Location": other.url}
        assert refused(camera(other.url)).code == "http"
        for location in ("file:///etc/passwd", "http://[", "http://x:port/", "ftp://x/", ""):
            other.reply = {"Location": location}
            assert refused(camera(other.url)).code == "http"
    finally:
        other.close()


def test_the_server_that_sends_on_says_nothing_of_the_clock_of_the_one_that_sends(camera, server, monkeypatch):
    taken = []
    monkeypatch.setattr(ServerClock, "round_trip", lambda self, duration_ns: taken.append(duration_ns))
    near = MjpegServer()
    try:
        near.status, near.reply = 302, {"Location": server.url}
        poll_until(start(camera(near.url, server_clock_s=0.005)), 1)
    finally:
        near.close()
    assert len(taken) == 1


def test_user_and_password_are_sent_and_not_told(camera, server):
    driver = start(camera(server.url.replace("//", "//me:sec%20ret@")))
    poll_until(driver, 1)
    assert server.headers[0]["Authorization"] == "Basic " + base64.b64encode(b"me:sec ret").decode()
    server.close()
    assert "sec" not in str(failure(driver))


def test_a_camera_that_asks_for_a_digest_gets_it(camera, server):
    server.digest = ("me", "sec ret")
    poll_until(start(camera(server.url.replace("//", "//me:sec%20ret@"))), 2)
    error = refused(camera(server.url.replace("//", "//me:wrong@")))
    assert (error.code, error.data["status"]) == ("http_status", 401)


@pytest.mark.parametrize("password", ["a#b", "a@b", "a:b", "50%", "Tür pe", "日本", 'a"b', "[a"])
def test_a_password_as_people_write_it_is_sent(camera, server, password):
    """In user and password, raw, with an accent in the path; by both schemes."""
    url = server.url.replace("//", f"//mé:{password}@").replace("stream", "straße")
    poll_until(start(camera(url)), 1)
    told = base64.b64decode(server.headers[0]["Authorization"].removeprefix("Basic ")).decode()
    assert told == f"mé:{password}"
    assert server.requests[0] == "/stra%C3%9Fe"
    server.digest = ("mé", password)
    poll_until(start(camera(server.url.replace("//", f"//mé:{password}@"))), 1)
    server.status = 404
    assert password not in (text := str(refused(camera(url))))
    assert "***@127.0.0.1" in text


def test_an_address_that_a_server_sends_on_to_is_told_without_secrets(camera, server):
    for location in ("ftp://me:secret@x/", "http://x:port/?token=secret", "http://x/?pwd=secret"):
        server.status, server.reply = 302, {"Location": location}
        error = refused(camera(server.url))
        assert "secret" not in str(error) + repr(error.data)


def test_a_password_stays_with_its_host(camera, server):
    server.status, server.reply = 302, {"Location": server.url.replace("127.0.0.1", "localhost")}
    refused(camera(server.url.replace("//", "//me:secret@")))
    assert "Authorization" in server.headers[0]
    assert all("Authorization" not in headers for headers in server.headers[1:])


def test_nobody_listens(camera, server):
    server.close()
    error = refused(camera(server.url))
    assert (error.code, error.retry) == ("refused", True)
    assert server.url in str(error)


def test_a_server_without_tls_is_told(camera, server):
    error = refused(camera(server.url.replace("http:", "https:")))
    assert error.code == "tls"
    assert "http://" in str(error)


def test_a_host_that_cannot_have_an_address(camera):
    assert refused(camera(f"http://{'a' * 70}/stream")).code == "unknown_host"


@pytest.mark.parametrize("answer", [b"SSH-2.0-x\r\n", b"\x00" * 99 + b"\r\n", b""])
def test_a_server_that_does_not_speak_http(camera, answer):
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def speak():
            with listener.accept()[0] as connection:
                connection.recv(4096)
                connection.sendall(answer)

        thread = threading.Thread(target=speak)
        thread.start()
        error = refused(camera(f"http://127.0.0.1:{listener.getsockname()[1]}/"))
        thread.join()
    assert error.code in ("http", "unreachable")


def test_a_url_that_never_answers(camera, silent_port):
    error = refused(camera(f"http://127.0.0.1:{silent_port}/", open_timeout_s=0.1))
    assert (error.code, error.retry) == ("open_timeout", True)
    assert "0.1 s" in str(error)
    assert not threads_of()


def test_a_server_that_answers_and_sends_no_picture(camera, server):
    server.stream = once()(server)
    assert refused(camera(server.url, open_timeout_s=0.1)).code in ("open_timeout", "silent")
    assert not threads_of()


def test_a_server_that_drips_bytes_without_a_picture_is_silent(camera, server):
    def stream(handler):
        server.part(handler, jpeg(picture(1)))
        handler.wfile.write(b"--frame\r\nContent-Length: 40000\r\n\r\n")
        while not server.ended.wait(0.01):
            handler.wfile.write(b"x")

    server.stream = stream
    error = failure(start(camera(server.url, read_timeout_s=0.15)))
    assert (error.code, error.retry) == ("silent", True)


def test_a_stalled_stream_is_silent_and_polls_keep_saying_so(camera, server):
    server.stream = once(lambda handler: server.part(handler, jpeg(picture(1))))(server)
    driver = start(camera(server.url, read_timeout_s=0.1))
    for _ in range(3):
        error = failure(driver)
        assert (error.code, error.retry) == ("silent", True)
    driver.close()
    assert not threads_of()


def test_a_closed_connection_is_lost_and_opening_anew_goes_on(camera, server):
    driver = start(camera(server.url))
    before = poll_until(driver, 3)
    server.close()
    error = failure(driver)
    assert (error.code, error.retry) == ("connection_lost", True)
    driver.close()
    assert refused(driver).code == "refused"
    server.open()
    after = poll_until(start(driver), 3)
    numbers = [frame.seq for frame in before + after]
    assert numbers == sorted(set(numbers))
    assert driver.statistics().reconnects == 1
    assert driver.statistics().frames >= 6


def test_a_frozen_camera_is_withheld_told_and_known_after_reconnecting(camera, server):
    frozen_from = 30

    def stream(handler):
        while not server.ended.wait(0.003):
            server.number += 1
            server.part(handler, jpeg(picture(min(server.number, frozen_from))))

    server.stream = stream
    driver = start(camera(server.url, frozen_frames=5, rate_hz=300.0))
    frames = []
    with pytest.raises(DriverError) as caught:
        frames += poll_until(driver, 10_000)
    assert (caught.value.code, caught.value.retry, caught.value.data["pictures"]) == ("frozen", True, 5)
    seen = driver.statistics().frozen
    assert seen == 5
    driver.close()
    assert failure(start(driver)).code == "frozen"  # nothing delivered in between: poll() gave only []
    assert driver.statistics().frozen == 10
    frozen_from = 10_000
    driver.close()
    assert len(poll_until(start(driver), 2)) >= 2


def test_two_cameras_do_not_touch_each_other(camera, server):
    other = MjpegServer()
    try:
        first, second = start(camera(server.url)), start(camera(other.url))
        other.close()
        assert failure(second).code in ("connection_lost", "refused")
        assert len(poll_until(first, 5)) == 5
    finally:
        other.close()


def test_nothing_that_came_before_activate_is_delivered(camera, server, context):
    driver = camera(server.url)
    driver.configure()
    time.sleep(0.05)
    activated_ns = context.clock.now_ns()
    driver.activate()
    (frame,) = poll_until(driver, 1)
    assert frame.t_received_ns > activated_ns


def test_a_hundred_cameras_leave_nothing_behind(context, server):
    options = {"source": server.url, "width": WIDTH, "height": HEIGHT}
    server.rate_hz = 1000.0

    def use(times):
        for _ in range(times):
            driver = VideoCameraDriver(options, context)
            start(driver)
            driver.close()

    def held():
        return len(os.listdir("/proc/self/fd")), threading.active_count()

    threads = threading.active_count()
    use(3)
    wait_for(lambda: threading.active_count() <= threads)  # the server's own end when they next write
    gc.collect()
    before = held()
    use(100)
    wait_for(lambda: all(now <= then for now, then in zip(held(), before, strict=True)))
    assert not threads_of()


class Seen:
    """A detector that sees nothing, and keeps the frames it was shown."""

    def __init__(self):
        self.frames = []

    def describe(self):
        raise NotImplementedError

    def detect(self, frame, prior):
        self.frames.append(frame)
        empty = np.zeros((0, 2)), np.zeros((0, 2, 2))
        return CameraObservation(
            frame.camera, frame.seq, frame.t_shutter_ns, frame.t_received_ns, np.zeros(0, np.int64), *empty
        )


def test_the_vision_process_loses_a_camera_and_gets_it_back(camera, server, context):
    driver = camera(server.url)
    detector = Seen()
    reports = []

    def report(kind, message):
        reports.append((kind, message))
        if kind == "camera_lost":
            server.open()

    def flush():
        if len(detector.frames) == 5 and not reports:
            server.close()

    end = time.monotonic() + 60.0
    run_camera(
        camera_loop(
            CameraPipeline(driver, detector, MemoryVisionLinks(), context.clock),
            report,
            time.monotonic_ns,
            camera="left",
            poll_s=0.001,
        ),
        lambda: len(detector.frames) >= 10 or time.monotonic() > end,
        sleep=time.sleep,
        between=flush,
    )
    assert [kind for kind, _ in reports] == ["camera_lost", "camera_back"]
    assert server.url in reports[0][1]
    numbers = [frame.seq for frame in detector.frames]
    assert numbers == sorted(set(numbers))
    assert not threads_of()
