"""MJPEG over HTTP: the parts of a ``multipart/x-mixed-replace`` stream, each with the arrival time of its first byte.

A custom reader, since it stamps a picture when its first byte arrives, reads the server's number of it, and detects a
truncated JPEG: decoders behind `cv2.VideoCapture` report neither and invent times.
"""

from __future__ import annotations

import base64
import hashlib
import http.client
import re
import select
import socket
import ssl
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import SplitResult, unquote_to_bytes, urljoin, urlunsplit

import cv2
import numpy as np

from stereoservo.messages.addresses import Address
from stereoservo.ports.devices import Clock, DriverError
from stereoservo_drivers.video.options import Place, VideoOptions, place_of
from stereoservo_drivers.video.pictures import check_size, jpeg_flag, jpeg_size
from stereoservo_drivers.video.server_clock import ServerClock, seconds_in
from stereoservo_drivers.video.sources import Settings, SourcePicture

CHUNK = 1 << 18
MOST_READS = 64
SPOILED_IN_A_ROW = 10
REDIRECTIONS = 3


class MjpegSource:
    """One MJPEG stream over HTTP or HTTPS (:class:`~stereoservo_drivers.video.sources.LiveSource`)."""

    def __init__(
        self, place: Place, options: VideoOptions, clock: Clock, server_clock: ServerClock | None = None
    ) -> None:
        self.settings: Settings = {}
        self._place = place
        self._options = options
        self._clock = clock
        self._server_clock = server_clock
        self._socket: socket.socket | None = None
        self._response: http.client.HTTPResponse | None = None
        self._parser: MultipartParser | None = None
        self._chunked: ChunkedDecoder | None = None
        self._interrupted = False
        self._over = False
        self._spoiled = 0
        self._handshake_ns: int | None = None  # of TCP, with the last server: one round trip

    def open(self) -> None:
        """Connect and read the response's head. Raises DriverError."""
        url = self._place.url
        for _ in range(REDIRECTIONS + 1):
            response = self._request(url)
            if response.status not in (301, 302, 303, 307, 308):
                break
            target = self._sent_on(url, response.getheader("Location", ""))
            response.close()
            if target.hostname == url.hostname and not target.username:  # the password belongs to that host
                target = target._replace(netloc=url.netloc.rpartition("@")[0] + "@" + target.netloc)
            url = target
        else:
            raise self._place.error("http", f"sent on more than {REDIRECTIONS} times; use the last address")
        if self._server_clock is not None and self._handshake_ns is not None:
            self._server_clock.round_trip(self._handshake_ns)
        self._response = response
        self._parser = MultipartParser(self._boundary(response))
        self._chunked = ChunkedDecoder() if self._is_chunked(response) else None
        if self._socket is not None:
            self._socket.settimeout(self._options.read_timeout_s)

    def _sent_on(self, url: SplitResult, location: str) -> SplitResult:
        shown = Address(location)
        try:
            target = place_of(urljoin(url.geturl(), location), Path())
        except (DriverError, ValueError) as error:
            raise self._place.error("http", f"sent on to {shown!r}, which is no address") from error
        if target.kind != "http":
            raise self._place.error("http", f"sent on to {shown!r}, which is no address of HTTP")
        return target.url

    def _request(self, url: SplitResult, challenge: str = "") -> http.client.HTTPResponse:
        secure = url.scheme == "https"
        kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        connection = kind(url.hostname or "", url.port, timeout=self._options.open_timeout_s)
        headers = {"Accept": "multipart/x-mixed-replace, */*", "Connection": "close"}
        if url.username or url.password:
            headers["Authorization"] = authorization(url, challenge)
        try:
            begun_ns = self._clock.now_ns()
            connection.connect()
            self._handshake_ns = None if secure else self._clock.now_ns() - begun_ns
            self._socket = connection.sock
            if self._interrupted:
                raise self._place.error("closed", "the driver was closed while it connected", retry=True)
            connection.request("GET", _target(url), headers=headers)
            response = connection.getresponse()
        except (OSError, http.client.HTTPException, UnicodeError) as error:
            connection.close()
            raise _unreached(self._place, error, self._options.open_timeout_s) from error
        except DriverError:
            connection.close()
            raise
        asked = response.getheader("WWW-Authenticate", "")
        if (
            response.status == 401
            and "Authorization" in headers
            and not challenge
            and asked.lower().startswith("digest ")
        ):
            response.close()
            return self._request(url, asked)
        return response

    def _boundary(self, response: http.client.HTTPResponse) -> str:
        if response.status != 200:
            remedy = {
                401: "Put user and password into the URL: http://user:password@host/... (a '/' in them is written "
                "%2F, an '@' %40, a '%' %25)",
                403: "Look at the rights of the camera's user",
                404: "Look up the path of its MJPEG stream",
            }.get(response.status, "Look at the camera's own page")
            raise self._place.error(
                "http_status",
                f"answered {response.status} {response.reason}. {remedy}",
                retry=response.status >= 500,
                status=response.status,
            )
        told = response.headers.get_content_type()
        boundary = response.headers.get_param("boundary")
        if told != "multipart/x-mixed-replace" or not isinstance(boundary, str) or not boundary.strip("-"):
            raise self._place.error(
                "not_mjpeg",
                f"sends {response.getheader('Content-Type', 'no Content-Type')!r}; an MJPEG stream is "
                "'multipart/x-mixed-replace; boundary=...'. Look up the path of the camera's MJPEG stream",
                content_type=told,
            )
        return boundary

    def _is_chunked(self, response: http.client.HTTPResponse) -> bool:
        coding = response.getheader("Transfer-Encoding", "identity").strip().lower()
        if coding not in ("identity", "chunked"):
            raise self._place.error("http", f"sends Transfer-Encoding {coding!r}; chunked is read, and none")
        return coding == "chunked"

    def read(self) -> SourcePicture | None:
        """The newest whole image, waiting for one; None: it was damaged. Raises DriverError."""
        parts: list[MultipartPart] = []
        assert self._parser is not None
        for _ in range(MOST_READS):
            if parts and not self._readable():
                break
            if self._over:
                raise self._place.error("connection_lost", "the server ended the stream", retry=True)
            try:
                data = self._received()
            except TimeoutError as error:
                raise self._place.error(
                    "silent", f"nothing came for {self._options.read_timeout_s:g} s", retry=True
                ) from error
            except (OSError, ValueError, http.client.HTTPException) as error:
                raise self._place.error("connection_lost", f"the connection broke ({error})", retry=True) from error
            t_ns = self._clock.now_ns()
            self._over = not data
            try:
                if self._chunked is not None:
                    data = self._chunked.feed(data)
                    self._over = self._over or self._chunked.ended
                parts += self._parser.feed(data, t_ns)
            except MultipartError as error:
                raise self._place.error(error.code, str(error)) from error
            if self._over and parts:
                break
        return self._decoded(parts[-1], len(parts) - 1) if parts else None

    def _received(self) -> bytes:
        """Bytes after the head as received from the connection, with at most one wait; none: its end. Data that
        `http.client` read with the head come first.
        """
        assert self._response is not None
        return self._response.fp.read1(CHUNK)

    def _readable(self) -> bool:
        connection = self._socket
        if connection is None or connection.fileno() < 0:
            return False
        if isinstance(connection, ssl.SSLSocket) and connection.pending():
            return True
        return bool(select.select([connection], [], [], 0)[0])

    def _decoded(self, part: MultipartPart, skipped: int) -> SourcePicture | None:
        told = part.headers.get("content-type", "image/jpeg").partition(";")[0].strip().lower()
        if told not in ("image/jpeg", "image/jpg"):
            raise self._place.error("not_mjpeg", f"its parts are {told!r}; image/jpeg is read", content_type=told)
        size = None if part.cut else jpeg_size(part.body)
        image = None
        if size is not None:
            check_size(self._place, self._options, *size)
            image = cv2.imdecode(np.frombuffer(part.body, np.uint8), jpeg_flag(self._options.channel))
        if image is None:
            self._spoiled += 1
            if self._spoiled >= SPOILED_IN_A_ROW:
                raise self._place.error(
                    "corrupt",
                    f"{self._spoiled} pictures in a row are cut off or are no JPEG (the last of {len(part.body)} "
                    "bytes). Look at the camera's load and at the network",
                    retry=True,
                )
            return None
        self._spoiled = 0
        number = number_in(part.headers.get("x-sequence"))
        sent_ns = seconds_in(part.headers.get("x-timestamp"))
        shutter_ns = None
        if self._server_clock is not None and sent_ns is not None:
            shutter_ns = self._server_clock.stamp(sent_ns, part.t_ns)
        return SourcePicture(image, part.t_ns, number, skipped, shutter_ns)

    def interrupt(self) -> None:
        """Wake the thread that waits in :meth:`open` or :meth:`read`."""
        self._interrupted = True
        connection = self._socket
        if connection is not None:
            with suppress(OSError):  # closed by the other side, or by the thread: nothing is waiting any more
                connection.shutdown(socket.SHUT_RDWR)

    def release(self) -> None:
        """Close the connection."""
        if self._response is not None:
            self._response.close()
        if self._socket is not None:
            self._socket.close()


def _target(url: SplitResult) -> str:
    return (url.path or "/") + (f"?{url.query}" if url.query else "")


def authorization(url: SplitResult, challenge: str = "") -> str:
    """Authorization header for the user in ``url``: Basic, or Digest if the server's ``challenge`` requires it (RFC
    7617, 7616), letters beyond ASCII as UTF-8.
    """
    user, password = unquote_to_bytes(url.username or ""), unquote_to_bytes(url.password or "")
    if not challenge:
        return "Basic " + base64.b64encode(user + b":" + password).decode()
    plain = urlunsplit(url._replace(netloc=url.netloc.rpartition("@")[2]))
    known = urllib.request.HTTPPasswordMgrWithDefaultRealm()
    known.add_password(None, plain, user.decode("latin-1"), password.decode("latin-1"))  # its bytes, see _Digest
    told = urllib.request.parse_keqv_list(urllib.request.parse_http_list(challenge.partition(" ")[2]))
    request = urllib.request.Request(plain)
    return f"Digest {_Digest(known).get_authorization(request, told)}"


class _Digest(urllib.request.AbstractDigestAuthHandler):
    """Python's class, with user and password as bytes in the form of Latin-1: it accepts only ASCII."""

    def get_algorithm_impls(self, algorithm: str) -> tuple[Callable[[str], str], Callable[[str, str], str]]:
        digest = {"MD5": hashlib.md5, "SHA": hashlib.sha1}.get(algorithm.upper())
        if digest is None:
            raise ValueError(f"it asks for a digest by {algorithm!r}; MD5 and SHA are known")

        def hashed(text: str) -> str:
            return digest(text.encode("latin-1")).hexdigest()

        return hashed, lambda secret, data: hashed(f"{secret}:{data}")


def _unreached(place: Place, error: Exception, timeout_s: float) -> DriverError:
    if isinstance(error, TimeoutError):
        return place.error("open_timeout", f"did not answer within {timeout_s:g} s (open_timeout_s)", retry=True)
    if isinstance(error, ConnectionRefusedError):
        return place.error("refused", "nobody listens there. Start the camera's server, or mend the port", retry=True)
    if isinstance(error, socket.gaierror | UnicodeError):
        return place.error("unknown_host", f"its host has no address ({error})", retry=True)
    if isinstance(error, ssl.SSLError):
        return place.error(
            "tls", f"no trusted TLS connection ({error.reason or error}); http:// on a network of its own needs none"
        )
    if isinstance(error, http.client.HTTPException):
        return place.error("http", f"does not speak HTTP ({type(error).__name__})")
    return place.error("unreachable", f"cannot be reached ({error})", retry=True)


# -- chunked bodies ------------------------------------------------------------------------------------------
# Incremental decoder of HTTP's chunked transfer coding (RFC 9112, 7.1).
#
# A custom decoder, since that of `http.client`, after the line end behind a chunk, waits for the size of the next one:
# a complete picture would be delayed until the following one starts.


LONGEST_LINE = 4096
"""Bytes of a chunk's size with its extensions, or of one line of the trailer."""


class ChunkedDecoder:
    """Decodes the bytes of a chunked body as they arrive. ``ended``: its last chunk has arrived."""

    def __init__(self) -> None:
        self.ended = False
        self._line = bytearray()
        self._left = 0
        self._after_chunk = False

    def feed(self, data: bytes) -> bytes:
        """The payload in ``data``; nothing after the last chunk. Raises MultipartError: ``http``."""
        payload = bytearray()
        at = 0
        while at < len(data) and not self.ended:
            if self._left:
                taken = data[at : at + self._left]
                payload += taken
                at += len(taken)
                self._left -= len(taken)
                self._after_chunk = not self._left
                continue
            end = data.find(b"\n", at)
            self._line += data[at:] if end < 0 else data[at:end]
            if len(self._line) > LONGEST_LINE:
                raise MultipartError("http", f"a chunk's head is above {LONGEST_LINE} bytes")
            if end < 0:
                break
            at = end + 1
            self._take_line(bytes(self._line).strip())
            self._line.clear()
        return bytes(payload)

    def _take_line(self, line: bytes) -> None:
        if self._after_chunk:
            self._after_chunk = False
            if line:
                raise MultipartError("http", "a chunk does not end where its size says")
            return
        digits = line.partition(b";")[0].strip()
        if not digits or len(digits) > 16 or digits.strip(b"0123456789abcdefABCDEF"):
            raise MultipartError("http", f"a chunk's size is {digits[:32]!r}; valid: hexadecimal digits")
        self._left = int(digits, 16)
        self.ended = not self._left


# -- multipart streams ---------------------------------------------------------------------------------------
# Incremental parser of a ``multipart/x-mixed-replace`` stream (RFC 2046).


LARGEST_PART = 50_000_000
LONGEST_HEADERS = 16384
_JPEG_END = b"\xff\xd9"
_HEADERS_END = re.compile(rb"\A\r?\n|\r?\n\r?\n")
"""An empty line; the first one if a part has no headers."""


class MultipartError(Exception):
    """The stream is malformed: ``code`` as of DriverError."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass
class MultipartPart:
    """One part: when its first byte arrived, its headers by name in lower case, its body; ``cut``: incomplete."""

    t_ns: int
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""
    cut: bool = False


class MultipartParser:
    """Parses bytes as they arrive into whole parts. Resynchronises after a part of wrong length.

    A JPEG picture without a stated length is complete with its end marker: the boundary after it may be sent only with
    the next picture.
    """

    def __init__(self, boundary: str, largest: int = LARGEST_PART) -> None:
        # Half of the servers include the boundary's leading "--" in the header: both forms give this.
        self._delimiter = b"--" + boundary.encode("latin-1").lstrip(b"-")
        self._largest = largest
        self._buffer = bytearray()
        self._part: MultipartPart | None = None
        self._length: int | None = None
        self._in_body = False
        self._scanned = 0

    def feed(self, data: bytes, t_ns: int) -> list[MultipartPart]:
        """Parse ``data`` received at ``t_ns``; returns the parts that it completes.

        Raises MultipartError: ``frame_too_large``, ``not_mjpeg``.
        """
        self._buffer += data
        parts: list[MultipartPart] = []
        while True:
            if self._part is None:
                if not self._find_part():
                    return parts
                self._part = MultipartPart(t_ns)
            if not self._in_body and not self._read_headers(self._part):
                return parts
            if not self._read_body(self._part):
                return parts
            parts.append(self._part)
            self._part = None

    def _find_part(self) -> bool:
        """Skip to after the next boundary's line, and check that something follows."""
        at = self._buffer.find(self._delimiter, self._scanned)
        if at < 0:
            keep = len(self._delimiter) - 1
            if len(self._buffer) > self._largest:
                raise MultipartError("not_mjpeg", "its boundary does not come")
            self._scanned = max(0, len(self._buffer) - keep)
            return False
        end = self._buffer.find(b"\n", at)
        if end < 0 or end + 1 == len(self._buffer):
            self._scanned = at
            self._bound_headers(len(self._buffer) - at)
            return False
        del self._buffer[: end + 1]
        self._scanned = 0
        return True

    def _read_headers(self, part: MultipartPart) -> bool:
        found = _HEADERS_END.search(self._buffer, 0, LONGEST_HEADERS + 4)
        end, width = (found.start(), len(found[0])) if found else (-1, 0)
        self._bound_headers(len(self._buffer) if end < 0 else end)
        if end < 0:
            return False
        for line in bytes(self._buffer[:end]).splitlines():
            name, colon, value = line.decode("latin-1").partition(":")
            if colon:
                part.headers[name.strip().lower()] = value.strip()
        del self._buffer[: end + width]
        self._length = number_in(part.headers.get("content-length"))
        if self._length is not None and self._length > self._largest:
            raise MultipartError(
                "frame_too_large", f"a picture of {self._length} bytes; at most {self._largest} are taken"
            )
        self._in_body = True
        self._scanned = 0
        return True

    def _bound_headers(self, length: int) -> None:
        if length > LONGEST_HEADERS:
            raise MultipartError("not_mjpeg", f"headers of a part above {LONGEST_HEADERS} bytes")

    def _read_body(self, part: MultipartPart) -> bool:
        length = self._length
        boundary = self._buffer.find(b"\n" + self._delimiter, self._scanned)
        if length is not None and (boundary < 0 or boundary + 1 >= length):
            if len(self._buffer) < length:
                self._rescan_from_tail()
                return False
            return self._complete(part, length, cut=False)
        if boundary >= 0:
            boundary -= self._buffer[:boundary].endswith(b"\r")
            return self._complete(part, boundary, cut=length is not None)
        if length is None and self._buffer.endswith((_JPEG_END, _JPEG_END + b"\r\n")) and jpeg_size(self._buffer):
            return self._complete(part, self._buffer.rindex(_JPEG_END) + 2, cut=False)
        if len(self._buffer) > self._largest:
            raise MultipartError("frame_too_large", f"a picture above {self._largest} bytes without an end")
        self._rescan_from_tail()
        return False

    def _rescan_from_tail(self) -> None:
        self._scanned = max(0, len(self._buffer) - len(self._delimiter) - 1)

    def _complete(self, part: MultipartPart, length: int, *, cut: bool) -> bool:
        part.body = bytes(self._buffer[:length])
        part.cut = cut
        del self._buffer[:length]
        self._in_body = False
        self._scanned = 0
        return True


def number_in(text: str | None) -> int | None:
    """The number in a header; None if there is none."""
    return int(text) if text is not None and text.isascii() and text.isdigit() and len(text) < 19 else None
