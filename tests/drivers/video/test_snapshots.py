"""Servers that answer with one picture at a time, as their cameras do: each picture comes once, however they answer."""

from __future__ import annotations

import hashlib
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereoservo.messages import addresses
from stereoservo.ports.clock import MonotonicClock
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.video.driver import VideoCameraDriver, probed
from stereoservo_drivers.video.mjpeg import MjpegSource
from stereoservo_drivers.video.options import decode_video_options

from .conftest import HEIGHT, WIDTH, jpeg, number_of, picture

COUNT = 12


def png(image: np.ndarray, level: int = 1) -> bytes:
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, level])[1].tobytes()


class SnapshotServer:
    """Answers requests on loopback by ``answer(server, request)``: the bytes, and whether the connection stays open."""

    def __init__(self, answer: Callable[[SnapshotServer, bytes], tuple[bytes, bool]]) -> None:
        self.number = self.requests = self.connections = 0
        self.authorizations: list[str] = []
        self._answer = answer
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}/shot.jpg"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                connection = self._listener.accept()[0]
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self.connections += 1
                threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection: socket.socket) -> None:
        with connection, suppress(OSError):
            stays = True
            while stays and (request := connection.recv(4096)):
                self.requests += 1
                found = re.search(rb"Authorization: (.*)\r\n", request)
                self.authorizations.append(found[1].decode() if found else "")
                data, stays = self._answer(self, request)
                for at in range(0, len(data), 700):
                    connection.sendall(data[at : at + 700])

    def next(self, encode: Callable[[np.ndarray], bytes] = jpeg) -> bytes:
        """The next picture, encoded."""
        self.number += 1
        return encode(picture(self.number))

    def close(self) -> None:
        self._listener.close()


def head(*lines: str, status: str = "200 OK", version: str = "1.1") -> bytes:
    return "\r\n".join([f"HTTP/{version} {status}", *lines, "", ""]).encode()


def sized(data: bytes, *lines: str, more: int = 0, kind: str = "image/jpeg") -> bytes:
    return head(f"Content-Type: {kind}", f"Content-Length: {len(data) + more}", *lines) + data


def in_chunks(data: bytes) -> bytes:
    return b"".join(b"%x\r\n%b\r\n" % (len(part), part) for part in (data[:900], data[900:])) + b"0\r\n\r\n"


def busy(server, _request):
    if server.requests % 3 == 2:
        return head("Content-Length: 4", status="503 Busy") + b"busy", True
    return sized(server.next()), True


def cut(server, _request):
    data = server.next()
    return (sized(data[:1500], more=400), False) if server.requests % 4 == 2 else (sized(data), True)


def moved(server, request):
    """Each picture is at a new address, which is valid once."""
    if request.startswith(b"GET /shot.jpg"):
        return head(f"Location: /once/{server.number + 1}", "Content-Length: 0", status="302 Found"), True
    data = server.next()
    assert request.startswith(b"GET /once/%d " % server.number)
    return sized(data), True


def part(data: bytes) -> bytes:
    return b"--edge\r\nContent-Type: image/jpeg\r\n\r\n" + data + b"\r\n--edge--\r\n"


MIXED = "multipart/x-mixed-replace; boundary=edge"
OPEN, CLOSED = True, False
ANSWERS = {
    "closes": lambda s, _: (sized(s.next(), "Connection: close"), CLOSED),
    "keeps the connection": lambda s, _: (sized(s.next()), OPEN),
    "closes a kept connection without saying so": lambda s, _: (sized(s.next(), "Connection: keep-alive"), CLOSED),
    "HTTP/1.0 without a length": lambda s, _: (head("Content-Type: image/jpeg", version="1.0") + s.next(), CLOSED),
    "chunked": lambda s, _: (head("Transfer-Encoding: chunked") + in_chunks(s.next()), OPEN),
    "chunked, closes": lambda s, _: (head("Transfer-Encoding: chunked") + in_chunks(s.next()), CLOSED),
    "says text/html": lambda s, _: (sized(s.next(), kind="text/html; charset=utf-8"), OPEN),
    "says nothing": lambda s, _: (head() + s.next(), CLOSED),
    "a byte order mark before": lambda s, _: (sized(b"\xef\xbb\xbf\r\n" + s.next()), OPEN),
    "padding behind": lambda s, _: (sized(s.next() + bytes(64)), OPEN),
    "length too long": lambda s, _: (sized(s.next(), more=99), s.requests > 1),
    "length too short": lambda s, _: (sized(s.next(), more=-99), s.requests > 1),
    "PNG": lambda s, _: (sized(s.next(png), kind="image/png"), OPEN),
    "PNG that says JPEG": lambda s, _: (sized(s.next(png)), OPEN),
    "PNG of 16 bits": lambda s, _: (sized(s.next(lambda image: png(image.astype(np.uint16) << 8))), OPEN),
    "PNG in colour": lambda s, _: (sized(s.next(lambda image: png(cv2.merge([image] * 3)))), OPEN),
    "JPEG in colour": lambda s, _: (sized(s.next(lambda image: jpeg(cv2.merge([image] * 3)))), OPEN),
    "a stream that ends after each picture": lambda s, _: (
        head(f"Content-Type: {MIXED}") + part(s.next()), CLOSED),
    "one part with a length": lambda s, _: (sized(part(s.next()), kind=MIXED), OPEN),
    "one part in chunks": lambda s, _: (
        head(f"Content-Type: {MIXED}", "Transfer-Encoding: chunked") + in_chunks(part(s.next())), OPEN),
    "busy at each third request": busy,
    "cut at each fourth request": cut,
    "sent on to a new address each time": moved,
    "each picture three times": lambda s, _: (
        sized(s.next() if s.requests % 3 == 1 else jpeg(picture(s.number))), OPEN),
    "each picture twice, coded anew": lambda s, _: (
        sized(s.next(png) if s.requests % 2 else png(picture(s.number), 0)), OPEN),
}  # fmt: skip


@contextmanager
def source_of(answer, **options) -> Iterator[tuple[SnapshotServer, MjpegSource]]:
    server = SnapshotServer(answer)
    url = server.url.replace("//", f"//{options.pop('login', '')}")
    given = {"source": url, "width": WIDTH, "height": HEIGHT, "rate_hz": 500.0, "read_timeout_s": 30.0, **options}
    source = MjpegSource(*reversed(decode_video_options(given, Path())), MonotonicClock())
    try:
        yield server, source
    finally:
        source.release()
        server.close()


def read(source: MjpegSource, count: int) -> list:
    pictures: list = []
    while len(pictures) < count:
        found = source.read()
        pictures += [] if found is None else [found]
    return pictures


@pytest.mark.parametrize("name", ANSWERS)
def test_every_snapshot_comes_once_and_in_order(name):
    with source_of(ANSWERS[name]) as (server, source):
        source.open()
        found = read(source, COUNT)
        images = [p.image if p.image.dtype == np.uint8 else (p.image >> 8).astype(np.uint8) for p in found]
        numbers = [number_of(image if image.ndim == 2 else image[:, :, 0]) for image in images]
        left_out = set(range(2, 99, 4)) if "cut" in name else set()
        assert numbers == [n for n in range(1, 99) if n not in left_out][:COUNT]
        stamps = [p.t_received_ns for p in found]
        assert stamps == sorted(set(stamps))
        if "keeps" in name:
            assert server.connections == 1
        assert 0.0 < source.settings["stamp_uncertainty_s"][1] < 30.0


def test_snapshots_are_requested_at_the_stated_rate_at_most_and_setup_measures_it():
    with source_of(ANSWERS["keeps the connection"]) as (server, _):
        width, height, rate_hz = probed({"source": server.url, "rate_hz": 50.0, "width": WIDTH, "height": HEIGHT})
        assert (width, height) == (WIDTH, HEIGHT)
        assert rate_hz <= 50.0  # a busy machine may be slower
        assert server.requests == 12


def test_a_snapshot_that_never_changes_is_told_with_its_cause():
    with source_of(lambda s, _: (sized(jpeg(picture(1))), OPEN), read_timeout_s=0.05) as (_, source):
        source.open()
        read(source, 1)
        with pytest.raises(DriverError, match=r"same picture for 0\.\d s \(read_timeout_s\)") as caught:
            source.read()
    assert (caught.value.code, caught.value.retry) == ("frozen", True)


def test_a_server_that_answers_no_more_pictures_is_told():
    answers = [sized(jpeg(picture(1))), *[head("Content-Length: 0", status="404 Not Found")] * 20]
    with source_of(lambda s, _: (answers[s.requests - 1], OPEN)) as (server, source):
        source.open()
        with pytest.raises(DriverError, match=r"answered 404 Not Found.*snapshot"):
            read(source, 2)
        assert server.requests == 11


def digest(text: str, algorithm: str) -> str:
    return hashlib.new(algorithm, text.encode()).hexdigest()


CHALLENGES = {
    "MD5 without quality": ("md5", ['Digest realm="cam", nonce="{n}"']),
    "both in one header": ("md5", ['Basic realm="a, b", Digest realm="cam", nonce="{n}", qop="auth,auth-int"']),
    "both, blanks in the list": ("md5", ['Digest realm="cam", qop="auth-int, auth", nonce="{n}"', 'Basic realm="x"']),
    "two digests, the stronger first": ("sha256", [
        'Digest realm="cam", nonce="{n}", algorithm=SHA-256, qop="auth"',
        'Digest realm="cam", nonce="{n}", algorithm=MD5, qop="auth"']),
    "one that is unknown before": ("md5", [
        'Digest realm="cam", nonce="{n}", algorithm=SHA-512-256, qop="auth"',
        'digest Realm="cam", Nonce="{n}", Algorithm="md5", Qop=auth']),
}  # fmt: skip


@pytest.mark.parametrize("name", CHALLENGES)
def test_a_login_is_kept_from_snapshot_to_snapshot(name):
    """RFC 7616, 3.4.1: a nonce is valid for five requests, each with the next count."""
    algorithm, headers = CHALLENGES[name]

    def answer(server, request):
        nonce = str(server.number // 5)
        told = dict(re.findall(r'(\w+)="?([^",\s]+)', server.authorizations[-1]))
        counted = 1 + server.number % 5
        if told.get("nonce") == nonce and ("nc" not in told or int(told["nc"], 16) == counted):
            secret, what = digest("me:cam:a#b", algorithm), digest(f"GET:{told['uri']}", algorithm)
            between = f"{told['nc']}:{told['cnonce']}:auth:" if "nc" in told else ""
            if told["response"] == digest(f"{secret}:{nonce}:{between}{what}", algorithm):
                return sized(server.next()), OPEN
        lines = [f"WWW-Authenticate: {text.format(n=nonce)}" for text in headers]
        return head(*lines, "Content-Length: 0", status="401 Unauthorized"), OPEN

    with source_of(answer, login="me:a#b@") as (server, source):
        source.open()
        assert [number_of(p.image) for p in read(source, COUNT)] == list(range(1, COUNT + 1))
        assert server.requests == COUNT + 3


@pytest.mark.parametrize(
    ("asked", "cause"),
    [
        ('Digest realm="c", nonce="1", algorithm=SHA-512-256', "Digest by SHA-512-256"),
        ('Digest realm="c", nonce="1", qop="auth-int"', "qop auth-int; valid: MD5"),
        ('Basic realm="c"', "did not accept the URL's user and password"),
        ("Digest realm, nonce, =,,", "did not accept the URL's user and password"),
    ],
)
def test_a_login_that_is_refused_is_told_with_its_cause(asked, cause):
    def answer(_server, _request):
        return head(f"WWW-Authenticate: {asked}", "Content-Length: 0", status="401 Unauthorized"), OPEN

    with source_of(answer, login="me:secret@") as (_, source), pytest.raises(DriverError) as caught:
        source.open()
    assert caught.value.code == "http_status"
    assert cause in str(caught.value)
    assert "secret" not in f"{caught.value} {vars(caught.value)}"


SECRET = "Tulpe"
ECHOES = {
    "reason": lambda target: head(status=f"404 no {target}"),
    "login": lambda target: head(f'WWW-Authenticate: Digest realm="{target}", nonce="1", algorithm=X', status="401 No"),
    "address": lambda target: head(f"Location: ftp://x{target}", status="302 Found"),
    "same address": lambda target: head(f"Location: {target}", status="302 Found"),
    "kind": lambda target: head(f"Content-Type: text/{target}"),
    "kind of a part": lambda target: head() + f"--x\r\nContent-Type: {target}\r\n\r\nhi".encode(),
    "chunk": lambda target: head("Transfer-Encoding: chunked") + f"{target}\r\n".encode(),
    "no HTTP": lambda target: f"SSH {target}\r\n".encode(),
}


@pytest.mark.parametrize(
    "planted",
    [
        "//me:{s}@#/shot", "//{s}@#/shot", "//:{s}@#/shot", "//me:{s}%40@#/shot", "//#/shot?token={s}",
        "//#/shot?a=1&access_token={s}&b=2", "//#/shot?pwd={s}%21", "//#/user=operator_password={s}_channel=1",
        "//#/shot;jsessionid={s}", "//me:other@#/shot?auth={s}",
    ],
)  # fmt: skip
def test_no_secret_of_an_address_is_told_though_the_server_repeats_it(planted, context, monkeypatch):
    monkeypatch.setattr(addresses, "_kept", {})
    for name, answer in ECHOES.items():
        server = SnapshotServer(lambda _, request, answer=answer: (answer(request.split()[1].decode()), CLOSED))
        url = "http:" + planted.format(s=SECRET).replace("#", server.url.split("/")[2])
        options = {"source": url, "width": WIDTH, "height": HEIGHT, "open_timeout_s": 30.0, "read_timeout_s": 5.0}
        driver = VideoCameraDriver(options, context)
        with pytest.raises(DriverError) as caught:
            driver.configure()
        driver.close()
        server.close()
        assert SECRET not in f"{caught.value} {caught.value!r} {vars(caught.value)!r}", name
