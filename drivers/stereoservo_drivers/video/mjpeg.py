"""MJPEG over HTTP: the JPEG pictures of a stream, each with the arrival time of its first byte.

A custom reader, since it stamps a picture when its first byte arrives, reads the server's number of it, detects a
truncated JPEG (decoders behind `cv2.VideoCapture` report neither and invent times), and needs no valid headers.
"""

from __future__ import annotations

import base64
import hashlib
import http.client
import io
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
MOST_LINES = 100
_STATUS = re.compile(rb"(?:HTTP|ICY)[/0-9.]*\s+(\d{3})\b[^\S\r\n]*([^\r\n]*)", re.IGNORECASE)


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
        self._stream: io.BufferedReader | None = None
        self._told = ""
        self._parser: PictureParser | None = None
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
            self.release()
            if target.hostname == url.hostname and not target.username:  # the password belongs to that host
                target = target._replace(netloc=url.netloc.rpartition("@")[0] + "@" + target.netloc)
            url = target
        else:
            raise self._place.error("http", f"sent on more than {REDIRECTIONS} times; use the last address")
        if self._server_clock is not None and self._handshake_ns is not None:
            self._server_clock.round_trip(self._handshake_ns)
        self._check_status(response)
        self._told = response.getheader("Content-Type", "no Content-Type")
        self._parser = PictureParser()
        coding = response.getheader("Transfer-Encoding", "").lower()
        self._chunked = ChunkedDecoder() if "chunked" in coding else None
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
            self._stream = connection.sock.makefile("rb")
            response = http.client.HTTPResponse(_Head(self._stream))
            response.begin()
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
            self.release()
            return self._request(url, asked)
        return response

    def _check_status(self, response: http.client.HTTPResponse) -> None:
        if response.status // 100 != 2:
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

    def _no_mjpeg(self, what: str) -> DriverError:
        """Error for a body in which no picture was found. A page or a film is no stream, later either."""
        assert self._parser is not None
        part = self._parser.awaited().get("content-type")
        parts = f", its parts are {part!r}" if part else ""
        return self._place.error(
            "not_mjpeg",
            f"{what}; it sends {self._told!r}{parts}. Look up the path of the camera's MJPEG stream",
            retry=not self._told.lower().startswith(("text/", "video/", "audio/")),
            content_type=self._told,
        )

    def read(self) -> SourcePicture | None:
        """The newest whole image, waiting for one; None: it was damaged. Raises DriverError."""
        parts: list[PictureData] = []
        assert self._parser is not None
        for _ in range(MOST_READS):
            if parts and not self._readable():
                break
            if self._over:
                if not self._parser.begun:
                    raise self._no_mjpeg("its answer ended without a JPEG picture")
                one = " after one picture: is it the address of a snapshot?" if self._parser.begun == 1 else ""
                raise self._place.error("connection_lost", f"the server ended the stream{one}", retry=True)
            try:
                data = self._received()
            except TimeoutError as error:
                if not self._parser.begun and self._parser.searched:
                    raise self._no_mjpeg(
                        f"no JPEG picture came, and then nothing for {self._options.read_timeout_s:g} s"
                    ) from error
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
            except StreamError as error:
                if error.code == "not_mjpeg":
                    raise self._no_mjpeg(str(error)) from error
                raise self._place.error(error.code, str(error), retry=True) from error
            if self._over and parts:
                break
        whole = [part for part in parts if not part.cut] or parts[-1:]
        return self._decoded(whole[-1], len(whole) - 1) if whole else None

    def _received(self) -> bytes:
        """Bytes after the head as received from the connection, with at most one wait; none: its end."""
        assert self._stream is not None
        return self._stream.read1(CHUNK)

    def _readable(self) -> bool:
        connection = self._socket
        if connection is None or connection.fileno() < 0:
            return False
        if isinstance(connection, ssl.SSLSocket) and connection.pending():
            return True
        return bool(select.select([connection], [], [], 0)[0])

    def _decoded(self, part: PictureData, skipped: int) -> SourcePicture | None:
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
        if self._stream is not None:
            self._stream.close()
        if self._socket is not None:
            self._socket.close()


class _Head:
    """Head of an answer, as a socket for `http.client`: corrected where browsers accept what that refuses or misreads
    (another protocol's name, no version or reason, lines without a colon).
    """

    def __init__(self, stream: io.BufferedReader) -> None:
        first = stream.readline(LONGEST_LINE)
        status = _STATUS.match(first)
        self._head = b"HTTP/1.0 %b %b\r\n" % status.groups() if status else first
        for _ in range(MOST_LINES if status else 0):
            line = stream.readline(LONGEST_LINE)
            if not line.strip():
                break
            self._head += line if b":" in line or line[:1].isspace() else b""

    def makefile(self, _mode: str) -> io.BytesIO:
        """The head alone."""
        return io.BytesIO(self._head)


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
        """The payload in ``data``; nothing after the last chunk. Raises StreamError: ``http``."""
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
                raise StreamError("http", f"a chunk's head is above {LONGEST_LINE} bytes")
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
                raise StreamError("http", "a chunk does not end where its size says")
            return
        digits = line.partition(b";")[0].strip()
        if not digits or len(digits) > 16 or digits.strip(b"0123456789abcdefABCDEF"):
            raise StreamError("http", f"a chunk's size is {digits[:32]!r}; valid: hexadecimal digits")
        self._left = int(digits, 16)
        self.ended = not self._left


# -- pictures in a stream ------------------------------------------------------------------------------------
# Incremental parser: pictures by their JPEG markers (ITU-T T.81, B.1), and the text before each of them.


LARGEST_PICTURE = 50_000_000
LONGEST_HEADERS = 16384
LONGEST_SEARCH = 1 << 20
"""Bytes without a picture after which a stream counts as none."""
_BEGIN, _END = b"\xff\xd8\xff", b"\xff\xd9"
_MARKER = re.compile(rb"\xff[\xc0-\xcf\xd8-\xef\xfe]")
"""Markers with a segment, begin and end. Coded data contain none: a 0xFF in them is stuffed, or of a restart."""


class StreamError(Exception):
    """The stream is malformed: ``code`` as of DriverError."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass
class PictureData:
    """A picture: when its first byte arrived, headers of its part by name in lower case, data; ``cut``: incomplete."""

    t_ns: int
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""
    cut: bool = False


class PictureParser:
    """Parses bytes as they arrive into JPEG pictures; constant memory, and no wait beyond a picture's last byte.

    A picture ends at its end marker, outside its segments (which can contain a thumbnail); a stated length is used only
    if a picture ends there. Boundaries, headers and text parts between pictures need not be valid.
    """

    def __init__(self, largest: int = LARGEST_PICTURE) -> None:
        self.begun = self.searched = 0  # pictures, and bytes since the last one
        self._largest = largest
        self._buffer = bytearray()
        self._picture: PictureData | None = None
        self._delimiter = b""
        self._length: int | None = None
        self._at = 0  # the bytes before it need no second look
        self._before_ns = 0

    def awaited(self) -> dict[str, str]:
        """Headers of the part that is being received."""
        return self._picture.headers if self._picture is not None else headers_in(bytes(self._buffer))[0]

    def feed(self, data: bytes, t_ns: int) -> list[PictureData]:
        """Parse ``data`` received at ``t_ns``; returns the pictures that it completes, or shows to be cut.

        Raises StreamError: ``frame_too_large``, ``not_mjpeg``.
        """
        self._buffer += data
        found: list[PictureData] = []
        while True:
            if self._picture is None:
                if not self._find_picture(len(data), t_ns):
                    break
                continue
            end, cut = self._find_end()
            if end < 0:
                break
            self._picture.body, self._picture.cut = bytes(self._buffer[:end]), cut
            found.append(self._picture)
            self._drop(end)
            self._picture, self.searched = None, 0
        self._before_ns = t_ns
        return found

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        self._at = 0

    def _find_picture(self, fresh: int, t_ns: int) -> bool:
        """Skip text up to the next picture, and read its headers. ``fresh``: bytes at the end that arrived just now."""
        buffer = self._buffer
        begin = buffer.find(_BEGIN, self._at)
        if begin < 0:
            self.searched += len(buffer) - self._at
            if self.searched > LONGEST_SEARCH:
                raise StreamError("not_mjpeg", f"no JPEG picture in {self.searched} bytes")
            self._drop(max(0, len(buffer) - LONGEST_HEADERS))
            self._at = max(0, len(buffer) - len(_BEGIN) + 1)
            return False
        headers, self._delimiter = headers_in(bytes(buffer[max(0, begin - LONGEST_HEADERS) : begin]))
        self._length = number_in(headers.get("content-length"))
        self._picture = PictureData(t_ns if len(buffer) - begin <= fresh else self._before_ns, headers)
        self.begun += 1
        self._drop(begin)
        self._at = 2
        return True

    def _find_end(self) -> tuple[int, bool]:
        """Length of the picture at the beginning of the buffer, and whether it is cut; -1: more bytes are needed."""
        buffer, length = self._buffer, self._length
        if length is not None and self._at < length <= len(buffer) and buffer[length - 2 : length] == _END:
            return length, False
        while (found := _MARKER.search(buffer, self._at)) is not None:
            at, marker = found.start(), buffer[found.start() + 1]
            if marker == 0xD9:
                return at + 2, False
            if marker == 0xD8:
                cut = buffer.rfind(self._delimiter, 2, at) if self._delimiter else -1
                return max(cut, 0) or at, True
            self._at = at
            end = at + 2 + int.from_bytes(buffer[at + 2 : at + 4], "big")
            if self._delimiter and (cut := buffer.find(self._delimiter, at, end)) >= 0:
                return cut, True
            if len(buffer) < max(end, at + 4):
                break
            self._at = end
        else:
            self._at = max(self._at, len(buffer) - 1)
        if len(buffer) > self._largest:
            raise StreamError("frame_too_large", f"a picture above {self._largest} bytes without an end")
        return -1, False


def headers_in(text: bytes) -> tuple[dict[str, str], bytes]:
    """Headers by name in lower case in the text before a picture, from its last boundary on, and that boundary with the
    line end before it (none if there is none).
    """
    headers: dict[str, str] = {}
    delimiter = b""
    for line in text.splitlines():
        name, colon, value = line.decode("latin-1").partition(":")
        if line and (not colon or line.startswith(b"--")):
            headers, delimiter = {}, b"\n" + line if len(line) > 3 else b""
        elif colon:
            headers[name.strip().lower()] = value.strip()
    return headers, delimiter


def number_in(text: str | None) -> int | None:
    """The number in a header; None if there is none."""
    return int(text) if text is not None and text.isascii() and text.isdigit() and len(text) < 19 else None
