"""Stream servers of others, and senders that write as cameras do, fed with pictures that carry a stamp."""

from __future__ import annotations

import importlib.util
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT, CELL = 320, 240, 20
BITS = 80
SERVERS = Path(__file__).parent / "servers"
Sink = Callable[[np.ndarray], None]


def stamped(number: int, t_ns: int) -> np.ndarray:
    """Cells of black and white that tell ``t_ns`` (64 bits) and ``number`` (16), above a ramp."""
    image = np.tile(np.linspace(40, 200, WIDTH).astype(np.uint8), (HEIGHT, 1))
    bits = t_ns << 16 | number & 0xFFFF
    cells = np.array([bits >> k & 1 for k in range(BITS)], np.uint8).reshape(-1, WIDTH // CELL)
    image[: len(cells) * CELL] = np.kron(cells * 255, np.ones((CELL, CELL), np.uint8))
    return image


def stamp_of(image: np.ndarray) -> tuple[int, int]:
    """Number and stamp [ns] that :func:`stamped` drew."""
    rows = BITS * CELL // WIDTH
    cells = image[CELL // 2 : rows * CELL : CELL, CELL // 2 :: CELL] > 127
    bits = sum(int(bit) << k for k, bit in enumerate(cells.ravel()))
    return bits & 0xFFFF, bits >> 16


def jpeg(image: np.ndarray) -> bytes:
    """As JPEG data."""
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


class Feeder:
    """Gives ``sink`` numbered pictures at ``rate_hz``, but for the numbers in ``left_out``, until it is closed."""

    def __init__(self, sink: Sink, rate_hz: float) -> None:
        self.number = 0
        self.left_out: frozenset[int] = frozenset()
        self._sink = sink
        self._rate_hz = rate_hz
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        start_s = time.monotonic()
        with suppress(OSError):  # the server, or its client, has gone
            while not self._ended.wait(max(0.0, start_s + self.number / self._rate_hz - time.monotonic())):
                self.number += 1
                if self.number not in self.left_out:
                    self._sink(stamped(self.number, time.monotonic_ns()))

    def close(self) -> None:
        """End it."""
        self._ended.set()
        self._thread.join()


def free_port() -> int:
    """A port that was free just now."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@contextmanager
def process(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A program with a pipe to its stdin, ended after use."""
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, bufsize=0) as running:
        try:
            yield running
        finally:
            running.kill()


def _written(running: subprocess.Popen[bytes], data: bytes) -> None:
    assert running.stdin is not None
    view = memoryview(data)
    while view:
        view = view[running.stdin.write(view) :]


@contextmanager
def ffmpeg_mpjpeg(rate_hz: float) -> Iterator[tuple[str, Sink]]:
    """``ffmpeg -f mpjpeg`` that listens: chunked."""
    if shutil.which("ffmpeg") is None:
        pytest.skip("ffmpeg is not installed")
    url = f"http://127.0.0.1:{free_port()}/stream"
    command = (
        f"ffmpeg -v error -f rawvideo -pix_fmt gray -s {WIDTH}x{HEIGHT} -r {rate_hz:g} -i - -c:v mjpeg -threads 1 "
        f"-pix_fmt yuvj420p -q:v 3 -f mpjpeg -content_type multipart/x-mixed-replace;boundary=ffmpeg -listen 1 {url}"
    )
    with process(command.split()) as running:
        yield url, lambda image: _written(running, image.tobytes())


@contextmanager
def aiohttp_chunked(_rate_hz: float) -> Iterator[tuple[str, Sink]]:
    """aiohttp's multipart writer over its chunked coding, by this Python or ``$STEREOSERVO_AIOHTTP_PYTHON``."""
    python = os.environ.get("STEREOSERVO_AIOHTTP_PYTHON", sys.executable)
    if python == sys.executable and importlib.util.find_spec("aiohttp") is None:
        pytest.skip("aiohttp is not installed, nor named by $STEREOSERVO_AIOHTTP_PYTHON")
    port = free_port()

    def sink(image: np.ndarray) -> None:
        data = jpeg(image)
        _written(running, struct.pack(">I", len(data)) + data)

    with process([python, str(SERVERS / "aiohttp_mjpeg.py"), str(port)]) as running:
        yield f"http://127.0.0.1:{port}/stream", sink


@contextmanager
def gstreamer_rtsp(rate_hz: float) -> Iterator[tuple[str, Sink]]:
    """gst-rtsp-server with x264, by the system's Python and its GObject bindings."""
    needs = (
        "import gi; gi.require_version('Gst', '1.0'); gi.require_version('GstRtspServer', '1.0'); "
        "from gi.repository import Gst, GstRtspServer; Gst.init(None); assert Gst.ElementFactory.find('x264enc')"
    )
    python = "/usr/bin/python3"
    if not Path(python).exists() or subprocess.call([python, "-c", needs], stderr=subprocess.DEVNULL):
        pytest.skip("gst-rtsp-server's Python bindings or x264enc are not installed")
    port = free_port()
    command = [python, str(SERVERS / "gstreamer_rtsp.py"), *map(str, (port, WIDTH, HEIGHT, round(rate_hz)))]
    with process(command) as running:
        yield f"rtsp://127.0.0.1:{port}/stream", lambda image: _written(running, image.tobytes())


class Socketed:
    """A server of one client that writes as its ``dialect`` says: ``head``, and for each picture some writes."""

    def __init__(self, head: bytes, writes: Callable[[bytes], list[bytes]]) -> None:
        self._writes = writes
        self._head = head
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/stream"
        self._client: socket.socket | None = None
        self._accepting = threading.Thread(target=self._accept, daemon=True)
        self._accepting.start()

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.recv(65536)
        client.sendall(self._head)
        self._client = client

    def send(self, image: np.ndarray) -> None:
        """One picture; nothing before somebody listens."""
        if self._client is not None:
            for data in self._writes(jpeg(image)):
                self._client.sendall(data)

    def close(self) -> None:
        """Close both sockets."""
        if self._client is not None:
            self._client.close()
        self._listener.close()


def _head(boundary: str, *more: str) -> bytes:
    lines = ["HTTP/1.1 200 OK", f"Content-Type: multipart/x-mixed-replace;boundary={boundary}", *more]
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


def _chunk(data: bytes, extension: bytes = b"") -> bytes:
    return b"%X%b\r\n%b\r\n" % (len(data), extension, data)


_ESP32 = "123456789000000000000987654321"


def _httpd_chunk(data: bytes) -> list[bytes]:
    """A chunk as ESP-IDF's ``httpd_resp_send_chunk`` sends it: in three calls."""
    return [b"%x\r\n" % len(data), data, b"\r\n"]


def _esp32(data: bytes) -> list[bytes]:
    head = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\nX-Timestamp: 1.5\r\n\r\n" % len(data)
    return [*_httpd_chunk(f"\r\n--{_ESP32}\r\n".encode()), *_httpd_chunk(head), *_httpd_chunk(data)]


def _esp32_before(data: bytes) -> list[bytes]:
    head = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data)
    return [*_httpd_chunk(head), *_httpd_chunk(data), *_httpd_chunk(f"\r\n--{_ESP32}\r\n".encode())]


def _proxied(data: bytes) -> list[bytes]:
    whole = b"--frame\r\nContent-Type: image/jpeg\r\n\r\n" + data + b"\r\n"
    return [_chunk(whole[k : k + 1460], b';name="a;b"') for k in range(0, len(whole), 1460)]


def _mjpg_streamer(data: bytes) -> list[bytes]:
    head = b"Content-Type: image/jpeg\r\nContent-Length: %d\r\nX-Timestamp: 1.000000\r\n\r\n" % len(data)
    return [head, data, b"\r\n--boundarydonotcross\r\n"]


def _axis(data: bytes) -> list[bytes]:
    return [b"--myboundary\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % len(data) + data + b"\r\n"]


def _no_length(data: bytes) -> list[bytes]:
    return [b"--video boundary--\r\nContent-type: image/jpeg\r\n\r\n" + data + b"\r\n"]


_CHUNKED = "Transfer-Encoding: chunked"
DIALECTS: dict[str, tuple[bytes, Callable[[bytes], list[bytes]]]] = {
    "ESP32-CAM": (_head(_ESP32, _CHUNKED, "X-Framerate: 60"), _esp32),
    "ESP32-CAM of 2019": (_head(_ESP32, _CHUNKED) + _chunk(f"\r\n--{_ESP32}\r\n".encode()), _esp32_before),
    "proxy: small chunks with extensions, no lengths": (_head("frame", _CHUNKED), _proxied),
    "mjpg-streamer": (_head("boundarydonotcross") + b"--boundarydonotcross\r\n", _mjpg_streamer),
    "Axis": (_head("myboundary"), _axis),
    "no lengths, dashes twice": (_head('"--video boundary--"'), _no_length),
}
"""What these cameras write on the wire, by their sources or makers' documents: head, and writes of each picture."""


@contextmanager
def dialect(name: str) -> Iterator[tuple[str, Sink]]:
    """A sender of our own that writes like the camera ``name``."""
    server = Socketed(*DIALECTS[name])
    try:
        yield server.url, server.send
    finally:
        server.close()
