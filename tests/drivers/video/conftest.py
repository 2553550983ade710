"""A small MJPEG server, recorded files, and cameras closed after the test."""

from __future__ import annotations

import hashlib
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2
import numpy as np
import pytest

from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverContext, DriverError
from stereoservo_drivers.video.driver import VideoCameraDriver

WIDTH, HEIGHT = 64, 48


def picture(number: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Noise of its own below; above, eight cells tell ``number`` (mod 256) as black or white, JPEG or not."""
    image = np.random.default_rng(number).integers(0, 256, (height, width), np.uint8)
    for bit in range(8):
        image[: height // 2, bit * 8 : bit * 8 + 8] = 255 if number >> bit & 1 else 0
    return image


def number_of(image: np.ndarray) -> int:
    """The number that ``picture`` drew."""
    return sum(int(image[8, bit * 8 + 4] > 127) << bit for bit in range(8))


def jpeg(image: np.ndarray) -> bytes:
    """As JPEG data."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


class MjpegServer:
    """Streams on 127.0.0.1. A stream is a function of the handler that writes until it returns."""

    boundary = "frame"

    def __init__(self, port: int = 0) -> None:
        self.rate_hz = 100.0
        self.number = 0
        self.requests: list[str] = []
        self.headers: list[dict[str, str]] = []
        self.stream: Callable[[Any], None] = self.pictures
        self.content_type = "multipart/x-mixed-replace; boundary=frame"
        self.status = 200
        self.reply: dict[str, str] = {}
        self.digest: tuple[str, str] | None = None
        self.ended = threading.Event()
        self._server: ThreadingHTTPServer | None = None
        self._thread: threading.Thread | None = None
        self.port = port
        self.open()

    def open(self) -> None:
        """Listen, again on the same port."""
        owner = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                owner.requests.append(self.path)
                owner.headers.append(dict(self.headers))
                if owner.digest is not None and not owner.authorised(self.headers.get("Authorization", "")):
                    self.send_response(401)
                    self.send_header("WWW-Authenticate", 'Digest realm="cam", nonce="n1", qop="auth"')
                    self.end_headers()
                    return
                self.send_response(owner.status)
                for name, value in owner.reply.items():
                    self.send_header(name, value)
                self.send_header("Content-Type", owner.content_type)
                self.end_headers()
                try:
                    if owner.status == 200:
                        owner.stream(self)
                except OSError:
                    return  # the reader went away

            def log_message(self, *_: Any) -> None:
                """Silent."""

        self.ended.clear()
        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        self._server.daemon_threads = False
        self._server.block_on_close = True
        self.port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/stream"

    def authorised(self, header: str) -> bool:
        """RFC 7616, 3.4.1, with MD5 and ``qop=auth``."""
        told = dict(re.findall(r'(\w+)="?([^",]+)', header.encode("latin-1").decode()))

        def md5(*texts: str) -> str:
            return hashlib.md5(":".join(texts).encode()).hexdigest()

        assert self.digest is not None
        user, password = self.digest
        if not header.startswith("Digest ") or told["username"] != user or told["nonce"] != "n1":
            return False
        secret, what = md5(user, "cam", password), md5("GET", "/stream")
        return told["response"] == md5(secret, "n1", told["nc"], told["cnonce"], "auth", what)

    def part(self, handler: Any, data: bytes, headers: str = "", length: int | None = None) -> None:
        """Write one part."""
        size = len(data) if length is None else length
        head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {size}\r\n{headers}\r\n"
        handler.wfile.write(head.encode() + data + b"\r\n")

    def pictures(self, handler: Any) -> None:
        """Pictures of growing number at ``rate_hz``."""
        while not self.ended.wait(1.0 / self.rate_hz):
            self.number += 1
            self.part(handler, jpeg(picture(self.number)))

    def close(self) -> None:
        """End streams, stop listening."""
        self.ended.set()
        if self._server is not None and self._thread is not None:
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()
            self._server = None


@pytest.fixture
def server() -> Iterator[MjpegServer]:
    made = MjpegServer()
    yield made
    made.close()


@pytest.fixture
def silent_port() -> Iterator[int]:
    """A port that takes connections and never says a word."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener.getsockname()[1]


@pytest.fixture
def context(tmp_path: Any) -> DriverContext:
    return DriverContext(MonotonicClock(), "t", tmp_path, tmp_path, "left", 1)


@pytest.fixture
def camera(context: DriverContext) -> Iterator[Callable[..., VideoCameraDriver]]:
    """Makes a driver of ``WIDTH`` by ``HEIGHT`` with options, closed after the test; patient unless the options say
    else, since a server in a thread is as late as its machine is busy.
    """
    patient = {"open_timeout_s": 60.0, "read_timeout_s": 30.0}
    made: list[VideoCameraDriver] = []

    def make(source: str | int, **options: Any) -> VideoCameraDriver:
        driver = VideoCameraDriver({"source": source, "width": WIDTH, "height": HEIGHT, **patient, **options}, context)
        made.append(driver)
        return driver

    yield make
    for driver in made:
        driver.close()


def connected(driver: VideoCameraDriver, limit_s: float = 60.0) -> VideoCameraDriver:
    """The driver, active once its source answers."""
    end = time.monotonic() + limit_s
    while True:
        try:
            driver.configure()
            driver.activate()
            return driver
        except DriverError as error:
            driver.close()
            if not error.retry or time.monotonic() > end:
                raise
            time.sleep(0.05)


def poll_until(driver: VideoCameraDriver, count: int, limit_s: float = 60.0) -> list[Any]:
    """``count`` frames. Fails the test when they do not come; what the driver raises goes through."""
    frames: list[Any] = []
    end = time.monotonic() + limit_s
    while len(frames) < count:
        frames += driver.poll()
        if time.monotonic() > end:
            pytest.fail(f"{len(frames)} of {count} frames within {limit_s} s")
        time.sleep(0.001)
    return frames
