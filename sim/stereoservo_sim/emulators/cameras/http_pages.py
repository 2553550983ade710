"""HTTP requests and responses of the server of emulated cameras."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

from stereoservo_sim.emulators.cameras.emulated_camera import StreamPicture

BOUNDARY = "picture"
REQUEST_LIMIT = 8192


class BadRequestError(Exception):
    """An invalid request, or one of an unknown resource."""

    def __init__(self, status: str, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class HttpRequest:
    """A parsed request; ``head``: without the content."""

    path: str
    head: bool = False


def parse_request(data: bytes) -> HttpRequest | None:
    """The request at the start of ``data``; None while it is incomplete. Raises BadRequestError."""
    if b"\r\n\r\n" not in data and b"\n\n" not in data:
        if len(data) > REQUEST_LIMIT:
            raise BadRequestError("431 Request Header Fields Too Large", f"more than {REQUEST_LIMIT} bytes")
        return None
    line = data.splitlines()[0].decode("latin-1") if data.strip() else ""
    words = line.split()
    if len(words) != 3 or not words[2].startswith("HTTP/"):
        raise BadRequestError("400 Bad Request", f"{line[:80]!r} is no request")
    if words[0] not in ("GET", "HEAD"):
        raise BadRequestError(
            "405 Method Not Allowed", f"{words[0][:20]} is not understood; GET and HEAD are"
        )
    return HttpRequest(words[1].partition("?")[0], words[0] == "HEAD")


def answer(status: str, kind: str, body: bytes, *, head: bool = False) -> bytes:
    """A complete response."""
    lines = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\n"
        "Cache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    return lines.encode() + (b"" if head else body)


def failure(error: BadRequestError, streams: Sequence[str]) -> bytes:
    """Error response, which lists the streams."""
    text = f"{error}\nstreams: {', '.join(streams)}\n"
    return answer(error.status, "text/plain; charset=utf-8", text.encode())


def still(picture: StreamPicture) -> bytes:
    """Response with one image, ``/NAME.jpg``."""
    return answer("200 OK", "image/jpeg", picture.data)


def stream_head() -> bytes:
    """Head of a stream's response, and its first boundary."""
    return (
        "HTTP/1.1 200 OK\r\n"
        f"Content-Type: multipart/x-mixed-replace; boundary={BOUNDARY}\r\n"
        "Cache-Control: no-store\r\nConnection: close\r\n\r\n"
        f"--{BOUNDARY}\r\n"
    ).encode()


def part(picture: StreamPicture) -> bytes:
    """One image of a stream, which ends with the next boundary, so that nobody waits for it."""
    head = (
        f"Content-Type: image/jpeg\r\nContent-Length: {len(picture.data)}\r\nX-Sequence: {picture.seq}\r\n"
        f"X-Timestamp: {picture.t_shutter_ns // 10**9}.{picture.t_shutter_ns % 10**9:09d}\r\n\r\n"
    )
    return head.encode() + picture.data + f"\r\n--{BOUNDARY}\r\n".encode()


def index(cell: str, streams: Sequence[str]) -> bytes:
    """HTML index page of the streams."""
    title = f"Emulated cameras of {html.escape(cell)}"
    figures = "".join(
        f'<figure><img src="{html.escape(s)}" alt="{html.escape(s)}"><figcaption><a href="{html.escape(s)}">'
        f'{html.escape(s)}</a> <a href="{html.escape(still_path(s))}">one picture</a></figcaption></figure>'
        for s in streams
    )
    style = "body{font-family:sans-serif}figure{display:inline-block;margin:.5em}img{max-width:45vw}"
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>{style}</style>"
        f"<h1>{title}</h1>{figures}"
    )
    return answer("200 OK", "text/html; charset=utf-8", page.encode())


def still_path(stream: str) -> str:
    """Path of the single image of a stream."""
    return f"{stream.removesuffix('.mjpg')}.jpg"
