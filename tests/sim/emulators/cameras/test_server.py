"""Emulated cameras over HTTP: streams, single pictures, bad requests, clients that are slow, many or gone."""

from __future__ import annotations

import http.client
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import pairwise

import cv2
import numpy as np
import pytest

from stereoservo.ports.clock import MonotonicClock
from stereoservo_sim.emulators.cameras.camera_emulator import CameraEmulator
from stereoservo_sim.emulators.cameras.emulated_camera import EmulatedCamera
from stereoservo_sim.emulators.cameras.stream_server import REQUEST_LIMIT, CameraServer
from stereoservo_sim.emulators.cameras.stream_settings import CamerasSettings, StreamSettings
from stereoservo_sim.emulators.fault_engine import EmulationError

TIMEOUT_S = 60.0


class Served:
    """A server in a thread; ``do`` calls in its loop."""

    def __init__(self, tmp_path, **options) -> None:
        streams = (
            StreamSettings(name="left", latency_ms=100.0),
            StreamSettings(name="right", latency_ms=100.0),
        )
        settings = CamerasSettings(camera=streams, background="plain", noise=20.0)
        clock = MonotonicClock()
        self.emulator = CameraEmulator(
            [EmulatedCamera(one, settings, clock=clock, runtime_dir=tmp_path) for one in streams],
            clock.now_ns(),
        )
        self.server = CameraServer(self.emulator, cell="t", **options)
        self.events: list[tuple[str, str]] = []
        self.server.on_event = lambda event: self.events.append((event.kind, event.camera))
        self.emulator.open()
        self.end = threading.Event()
        self.asked: list[tuple[str, list[str], threading.Event]] = []
        self.thread = threading.Thread(target=self.server.run, args=(self._over,))
        self.thread.start()

    def _over(self) -> bool:
        while self.asked:
            text, answers, done = self.asked.pop(0)
            answers.append(self.server.obey(text))
            done.set()
        return self.end.is_set()

    def order(self, text: str) -> str:
        answers: list[str] = []
        done = threading.Event()
        self.asked.append((text, answers, done))
        assert done.wait(TIMEOUT_S)
        return answers[0]

    def stop(self) -> None:
        self.end.set()
        self.thread.join()


@pytest.fixture
def serve(tmp_path) -> Iterator[Callable[..., Served]]:
    """Servers that end with the test."""
    started: list[Served] = []

    def start(**options) -> Served:
        started.append(Served(tmp_path, **options))
        return started[-1]

    yield start
    for one in started:
        one.stop()


class Stream:
    """A client of a stream that reads part by part."""

    def __init__(self, served: Served, path: str) -> None:
        self.response = urllib.request.urlopen(served.server.url + path, timeout=TIMEOUT_S)
        assert self.response.headers.get_content_type() == "multipart/x-mixed-replace"
        self.boundary = self.response.headers.get_param("boundary")
        assert self.response.readline().strip().decode() == f"--{self.boundary}"

    def part(self) -> tuple[dict[str, str], bytes]:
        headers = {}
        while line := self.response.readline().decode().strip():
            name, _, value = line.partition(": ")
            headers[name] = value
        data = self.response.read(int(headers["Content-Length"]))
        assert self.response.readline() == b"\r\n"
        assert self.response.readline().strip().decode() == f"--{self.boundary}"
        return headers, data

    def close(self) -> None:
        self.response.close()


def test_a_stream_has_whole_pictures_with_numbers_and_stamps(serve):
    served = serve()
    with closing(Stream(served, "/left.mjpg")) as stream:
        parts = [stream.part() for _ in range(5)]
    numbers = [int(headers["X-Sequence"]) for headers, _ in parts]
    stamps = [float(headers["X-Timestamp"]) for headers, _ in parts]
    assert numbers == sorted(set(numbers))
    assert stamps == pytest.approx([number / 30 for number in numbers], abs=1e-6)
    for headers, data in parts:
        assert headers["Content-Type"] == "image/jpeg"
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (480, 640)


def test_one_picture_and_the_page_for_people(serve):
    served = serve()
    with urllib.request.urlopen(f"{served.server.url}/right.jpg", timeout=TIMEOUT_S) as answer:
        data = answer.read()
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (480, 640)
    with urllib.request.urlopen(f"{served.server.url}/?a=b", timeout=TIMEOUT_S) as answer:
        page = answer.read().decode()
    assert 'src="/left.mjpg"' in page
    assert 'href="/right.jpg"' in page


@pytest.mark.parametrize(
    ("request_text", "status", "told"),
    [
        ("GET /nowhere HTTP/1.1\r\n\r\n", 404, "/left.mjpg, /right.mjpg"),
        ("GET /../etc/passwd HTTP/1.1\r\n\r\n", 404, "/left.mjpg"),
        ("POST /left.mjpg HTTP/1.1\r\n\r\n", 405, "GET and HEAD"),
        ("hello\r\n\r\n", 400, "no request"),
        ("\r\n\r\n", 400, "no request"),
        ("GET / HTTP/1.1\r\nX: " + "x" * REQUEST_LIMIT, 431, str(REQUEST_LIMIT)),
    ],
)
def test_bad_requests_are_answered_with_what_there_is(serve, request_text, status, told):
    served = serve()
    port = int(served.server.url.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT_S) as link:
        link.sendall(request_text.encode())
        answer = http.client.HTTPResponse(link)
        answer.begin()
        assert answer.status == status
        assert told in answer.read().decode()


def test_a_client_that_does_not_read_holds_nobody_and_gets_the_newest_then(serve):
    served = serve()
    with closing(Stream(served, "/left.mjpg")) as slow, closing(Stream(served, "/left.mjpg")) as quick:
        slow.part()
        for _ in range(50):
            quick.part()
        late = [int(slow.part()[0]["X-Sequence"]) for _ in range(30)]
    assert max(b - a for a, b in pairwise(late)) > 5  # what did not fit was left out


def test_no_more_connections_than_allowed(serve):
    served = serve(connections=2)
    with closing(Stream(served, "/left.mjpg")), closing(Stream(served, "/right.mjpg")):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(f"{served.server.url}/left.mjpg", timeout=TIMEOUT_S)
        assert refused.value.code == 503
        assert "2 connections" in refused.value.read().decode()


def test_disconnect_refuse_stall_and_cut(serve):
    served = serve()
    with closing(Stream(served, "/left.mjpg")) as stream:
        stream.part()
        assert served.order("disconnect left") == "left: connections closed"
        while stream.response.read(65536):
            pass
    served.order("refuse left")
    with pytest.raises(urllib.error.HTTPError) as refused:
        Stream(served, "/left.mjpg")
    assert refused.value.code == 503
    served.order("clear left")
    with closing(Stream(served, "/left.mjpg")) as stream:
        stream.part()
        served.order("stall left for 300ms")
        before = int(stream.part()[0]["X-Sequence"])
        numbers = [int(stream.part()[0]["X-Sequence"]) for _ in range(3)]
        assert max(numbers) - before >= 5
        served.order("cut left")
        rest = stream.response.read()
        assert rest.count(b"\xff\xd8\xff") == rest.count(b"\xff\xd9\r\n") + 1  # the last has no end
    assert ("connected", "left") in served.events
    assert ("gone", "left") in served.events


def test_a_port_that_is_taken_is_told(serve):
    served = serve()
    with pytest.raises(EmulationError, match="cannot listen on"):
        CameraServer(served.emulator, port=int(served.server.url.rpartition(":")[2]))
