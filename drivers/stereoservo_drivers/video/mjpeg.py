"""Pictures over HTTP: an MJPEG stream, or a snapshot that is requested again and again; each with the arrival time of
its first byte.

A custom reader, since it stamps a picture when its first byte arrives, reads the server's number of it, detects a
truncated picture (decoders behind `cv2.VideoCapture` report neither and invent times), and needs no valid headers.
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
import threading
import urllib.request
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import SplitResult, unquote_to_bytes, urljoin

import cv2
import numpy as np

from stereoservo.messages.addresses import Address
from stereoservo.ports.devices import Clock, DriverError
from stereoservo_drivers.video.options import Place, VideoOptions, place_of
from stereoservo_drivers.video.pictures import JPEG, PNG, check_size, picture_flag, picture_size
from stereoservo_drivers.video.server_clock import ServerClock, seconds_in
from stereoservo_drivers.video.sources import Settings, SourcePicture

CHUNK = 1 << 18
MOST_READS = 64
SPOILED_IN_A_ROW = 10
REDIRECTIONS = 3
MOST_LINES = 100
_HASHES = {"MD5": hashlib.md5, "SHA": hashlib.sha1, "SHA-256": hashlib.sha256}
_CHALLENGE = re.compile(r"(?:^|,)\s*([A-Za-z]+)\s+(.*?)(?=,\s*[A-Za-z]+\s+[A-Za-z]+\s*=|$)")
_PARAMETER = re.compile(r'([\w-]+)\s*=\s*(?:"((?:[^"\\]|\\.)*)"|([^\s,"]+))')
_STATUS = re.compile(rb"(?:HTTP|ICY)[/0-9.]*\s+(\d{3})\b[^\S\r\n]*([^\r\n]*)", re.IGNORECASE)


class MjpegSource:
    """One stream over HTTP or HTTPS (:class:`~stereoservo_drivers.video.sources.LiveSource`).

    An answer that ends after one picture is a snapshot: the next one is requested ``rate_hz`` times a second at most,
    on the same connection if the server keeps it open, and delivered if it differs from the last one.
    """

    def __init__(
        self, place: Place, options: VideoOptions, clock: Clock, server_clock: ServerClock | None = None
    ) -> None:
        self.settings: Settings = {}
        self._place = place
        self._options = options
        self._clock = clock
        self._server_clock = server_clock
        self._login: Login | None = None
        self._socket: socket.socket | None = None
        self._server = ("", "")  # scheme and host of the open connection
        self._stream: io.BufferedReader | None = None
        self._content_type = ""
        self._parser = PictureParser()
        self._chunked: ChunkedDecoder | None = None
        self._left = 0  # bytes of the answer still to come, if its head states their number
        self._reusable = False
        self._ending = threading.Event()
        self._over = False
        self._spoiled = 0
        self._handshake_ns: int | None = None  # of TCP, with the last server: one round trip
        self._asked_ns = 0
        self._last: SourcePicture | None = None  # the newest snapshot

    def open(self) -> None:
        """Connect and read the response's head. Raises DriverError."""
        self._asked_ns = self._clock.now_ns()
        url = self._place.url
        for _ in range(REDIRECTIONS + 1):
            response = self._request(url)
            if response.status not in (301, 302, 303, 307, 308):
                break
            target = self._sent_on(url, response.getheader("Location", ""))
            if target.hostname == url.hostname and not target.username:  # the password belongs to that host
                target = target._replace(netloc=url.netloc.rpartition("@")[0] + "@" + target.netloc)
            url = target
        else:
            raise self._place.error("http", f"sent on more than {REDIRECTIONS} times; use the last address")
        if self._server_clock is not None and self._handshake_ns is not None:
            self._server_clock.round_trip(self._handshake_ns)
        self._check_status(response)
        self._content_type = response.getheader("Content-Type", "no Content-Type")
        self._parser, self._over = PictureParser(), False
        coding = response.getheader("Transfer-Encoding", "").lower()
        self._chunked = ChunkedDecoder() if "chunked" in coding else None
        self._left = number_in(response.getheader("Content-Length")) or 0
        self._reusable = "close" not in response.getheader("Connection", "").lower()
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

    def _request(self, url: SplitResult, *, again: bool = False) -> http.client.HTTPResponse:
        """The head of the answer of ``url``. ``again``: not to try once more."""
        kept = self._reusable and self._over and self._server == (url.scheme, url.netloc) and not self._readable()
        if not kept:
            self.release()
        self._reusable = False
        secure = url.scheme == "https"
        kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        connection = kind(url.hostname or "", url.port, timeout=self._options.open_timeout_s)
        headers = {"Accept": "multipart/x-mixed-replace, */*", "Connection": "keep-alive" if self._over else "close"}
        login, _, host = url.netloc.rpartition("@")
        if login:
            self._login = self._login if self._login is not None and self._login.userinfo == login else Login(url)
            headers["Authorization"] = self._login.header(url._replace(netloc=host))
        try:
            if kept:
                connection.sock = self._socket
            else:
                begun_ns = self._clock.now_ns()
                connection.connect()
                self._handshake_ns = None if secure else self._clock.now_ns() - begun_ns
                self._socket, self._server = connection.sock, (url.scheme, url.netloc)
                self._stream = connection.sock.makefile("rb")
            if self._ending.is_set():
                raise self._place.error("closed", "the driver was closed while it connected", retry=True)
            connection.request("GET", _target(url), headers=headers)
            assert self._stream is not None
            response = http.client.HTTPResponse(_Head(self._stream))
            response.begin()
        except (OSError, http.client.HTTPException, UnicodeError) as error:
            connection.close()
            if kept:  # the server closed it meanwhile
                return self._request(url)
            raise _unreached(self._place, error, self._options.open_timeout_s) from error
        except DriverError:
            connection.close()
            raise
        asked = response.headers.get_all("WWW-Authenticate", []) if response.status == 401 else []
        if asked and login and self._login is not None and not again and self._login.challenged(asked):
            return self._request(url, again=True)
        return response

    def _check_status(self, response: http.client.HTTPResponse) -> None:
        if response.status // 100 != 2:
            remedy = {
                401: "Put user and password into the URL: http://user:password@host/... (a '/' in them is written "
                "%2F, an '@' %40, a '%' %25)"
                if self._login is None
                else f"It did not accept the URL's user and password{self._login.refused}",
                403: "Look at the rights of the camera's user",
                404: "Look up the path of its MJPEG stream or of its snapshot",
            }.get(response.status, "Look at the camera's own page")
            raise self._place.error(
                "http_status",
                f"answered {response.status} {response.reason}. {remedy}",
                retry=response.status >= 500,
                status=response.status,
            )

    def _no_mjpeg(self, what: str) -> DriverError:
        """Error for a body in which no picture was found. A page or a film is no stream, later either."""
        part = self._parser.awaited().get("content-type")
        parts = f", its parts are {part!r}" if part else ""
        return self._place.error(
            "not_mjpeg",
            f"{what}; it sends {self._content_type!r}{parts}. Look up the path of the camera's MJPEG stream or of its "
            "snapshot (JPEG or PNG)",
            retry=not self._content_type.lower().startswith(("text/", "video/", "audio/")),
            content_type=self._content_type,
        )

    def read(self) -> SourcePicture | None:
        """The newest whole image, waiting for one; None: it was damaged. Raises DriverError."""
        while True:
            if self._over and self._parser.begun == 1:
                try:
                    self._ask_again()
                except DriverError as error:
                    if error.code != "http_status":
                        raise
                    return self._damaged(error)
            parts = self._awaited()
            whole = [part for part in parts if not part.cut] or parts[-1:]
            if not whole and not self._over:
                return None
            if whole:
                picture = self._decoded(whole[-1], len(whole) - 1)
                if picture is None or self._parser.begun != 1 or self._differs(picture):
                    return picture

    def _ask_again(self) -> None:
        """Request the next snapshot, one period after the last request."""
        before_ns = self._asked_ns
        until_ns = before_ns + round(1e9 / self._options.rate_hz)
        self._ending.wait(max(0, until_ns - self._clock.now_ns()) * 1e-9)
        self.open()
        # It was not there yet at the last request, if the server answers with its newest picture.
        self.settings["stamp_uncertainty_s"] = 0.0, (self._clock.now_ns() - before_ns) * 1e-9

    def _differs(self, picture: SourcePicture) -> bool:
        """Whether a snapshot is new. Raises DriverError: the next one would come after ``read_timeout_s``."""
        last = self._last
        if last is None or not np.array_equal(last.image, picture.image):
            self._last = picture
            return True
        same_s = (picture.t_received_ns - last.t_received_ns) * 1e-9
        if same_s + 1.0 / self._options.rate_hz > self._options.read_timeout_s:
            raise self._place.error(
                "frozen",
                f"answered with the same picture for {same_s:.1f} s (read_timeout_s). Restart the camera; if it takes "
                "pictures less often, lower rate_hz and raise read_timeout_s",
                retry=True,
            )
        return False

    def _awaited(self) -> list[PictureData]:
        """The pictures that have arrived, waiting for one; none: the answer ended after its only picture."""
        parts: list[PictureData] = []
        for _ in range(MOST_READS):
            if parts and (self._over or not self._readable()):
                break
            if self._over:
                if not self._parser.begun:
                    raise self._no_mjpeg("its answer ended without a picture")
                if self._parser.begun > 1:
                    raise self._place.error("connection_lost", "the server ended the stream", retry=True)
                return [PictureData(0, cut=True)] if self._parser.unfinished else []
            try:
                data = self._received()
            except TimeoutError as error:
                if not self._parser.begun and self._parser.searched:
                    raise self._no_mjpeg(
                        f"no picture came, and then nothing for {self._options.read_timeout_s:g} s"
                    ) from error
                raise self._place.error(
                    "silent", f"nothing came for {self._options.read_timeout_s:g} s", retry=True
                ) from error
            except (OSError, ValueError, http.client.HTTPException) as error:
                raise self._place.error("connection_lost", f"the connection broke ({error})", retry=True) from error
            parts += self._parsed(data)
        return parts

    def _parsed(self, data: bytes) -> list[PictureData]:
        """The pictures that ``data``, just received, completes; none of it: the connection has ended."""
        t_ns = self._clock.now_ns()
        self._over = not data
        self._reusable = self._reusable and bool(data)
        self._left -= len(data)
        try:
            if self._chunked is not None:
                data = self._chunked.feed(data)
                self._over = self._over or self._chunked.ended
            parts = self._parser.feed(data, t_ns)
        except StreamError as error:
            if error.code == "not_mjpeg":
                raise self._no_mjpeg(str(error)) from error
            raise self._place.error(error.code, str(error), retry=True) from error
        if parts and self._chunked is None and self._parser.begun == 1:
            self._over = self._over or self._left == 0
            if self._last is not None and not self._content_type.lower().startswith("multipart/"):
                self._reusable = self._reusable and self._over  # its length is wrong: connect again
                self._over = True
        return parts

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
        size = None if part.cut else picture_size(part.body)
        image = None
        if size is not None:
            check_size(self._place, self._options, *size)
            image = cv2.imdecode(np.frombuffer(part.body, np.uint8), picture_flag(part.body, self._options.channel))
        if image is None:
            return self._damaged(
                self._place.error(
                    "corrupt",
                    f"{SPOILED_IN_A_ROW} pictures in a row are cut off or are neither JPEG nor PNG (the last of "
                    f"{len(part.body)} bytes). Look at the camera's load and at the network",
                    retry=True,
                )
            )
        self._spoiled = 0
        number = number_in(part.headers.get("x-sequence"))
        sent_ns = seconds_in(part.headers.get("x-timestamp"))
        shutter_ns = None
        if self._server_clock is not None and sent_ns is not None:
            shutter_ns = self._server_clock.stamp(sent_ns, part.t_ns)
        return SourcePicture(image, part.t_ns, number, skipped, shutter_ns)

    def _damaged(self, error: DriverError) -> None:
        """Count a damaged picture or refused snapshot; raise ``error`` if too many followed each other."""
        self._spoiled += 1
        if self._spoiled >= SPOILED_IN_A_ROW:
            raise error

    def interrupt(self) -> None:
        """Wake the thread that waits in :meth:`open` or :meth:`read`."""
        self._ending.set()
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


class Login:
    """User and password of a URL, sent as Basic, or as Digest once a server requires it (RFC 7617, 7616), letters
    beyond ASCII as UTF-8. ``refused``: text on the login that the server required, if that is unknown here.
    """

    def __init__(self, url: SplitResult) -> None:
        self.userinfo = url.netloc.rpartition("@")[0]
        self.refused = ""
        self._user, self._password = unquote_to_bytes(url.username or ""), unquote_to_bytes(url.password or "")
        self._known = urllib.request.HTTPPasswordMgrWithDefaultRealm()
        self._digest = _Digest(self._known)
        self._challenge: dict[str, str] = {}

    def header(self, url: SplitResult) -> str:
        """The header Authorization of a request of ``url``, which holds no user."""
        if not self._challenge:
            return "Basic " + base64.b64encode(self._user + b":" + self._password).decode()
        request = urllib.request.Request(url.geturl())
        self._known.add_password(
            None, urljoin(request.full_url, "/"), self._user.decode("latin-1"), self._password.decode("latin-1")
        )
        return f"Digest {self._digest.get_authorization(request, self._challenge)}"

    def challenged(self, headers: Iterable[str]) -> bool:
        """Whether one of the headers WWW-Authenticate requires a Digest that is known; it is then used."""
        self._challenge, self.refused = {}, ""
        for scheme, parameters in [found for text in headers for found in _CHALLENGE.findall(text)]:
            challenge = {key.lower(): quoted or plain for key, quoted, plain in _PARAMETER.findall(parameters)}
            algorithm = challenge.setdefault("algorithm", "MD5").upper()
            quality = [each.strip() for each in challenge.get("qop", "auth").split(",")]
            if scheme.lower() != "digest" or not {"realm", "nonce"} <= challenge.keys():
                continue
            if algorithm in _HASHES and "auth" in quality:
                self._challenge = challenge | ({"qop": "auth"} if "qop" in challenge else {})
                return True
            self.refused = (
                f"; it requires a Digest by {algorithm} with qop {', '.join(quality)}; valid: {', '.join(_HASHES)}, "
                "with qop auth"
            )
        return False


class _Digest(urllib.request.AbstractDigestAuthHandler):
    """Python's class, which accepts only ASCII: with more hashes, and user and password as bytes in Latin-1's form."""

    def get_algorithm_impls(self, algorithm: str) -> tuple[Callable[[str], str], Callable[[str, str], str]]:
        digest = _HASHES[algorithm.upper()]

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
            raise StreamError("http", "a chunk's size is no number in hexadecimal digits")
        self._left = int(digits, 16)
        self.ended = not self._left


# -- pictures in a stream ------------------------------------------------------------------------------------
# Incremental parser: pictures by their JPEG markers (ITU-T T.81, B.1) or PNG chunks (ISO/IEC 15948, 5), and the text
# before each of them.


LARGEST_PICTURE = 50_000_000
LONGEST_HEADERS = 16384
LONGEST_SEARCH = 1 << 20
"""Bytes without a picture after which a stream counts as none."""
_BEGIN, _END = re.compile(re.escape(JPEG) + b"|" + re.escape(PNG)), b"\xff\xd9"
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
    """Parses bytes as they arrive into JPEG and PNG pictures; constant memory, no wait beyond a picture's last byte.

    A JPEG ends at its end marker, outside its segments (which can contain a thumbnail), a PNG at its chunk IEND; a
    stated length is used only if a picture ends there. Boundaries, headers and text parts between pictures need not be
    valid.
    """

    def __init__(self, largest: int = LARGEST_PICTURE) -> None:
        self.begun = self.searched = 0  # pictures, and bytes since the last one
        self._largest = largest
        self._buffer = bytearray()
        self._picture: PictureData | None = None
        self._delimiter = b""
        self._length: int | None = None
        self._at = self._searched = 0  # the bytes before need no second look, or none for the boundary
        self._before_ns = 0

    @property
    def unfinished(self) -> bool:
        """Whether a picture has begun and not ended."""
        return self._picture is not None

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
            end, cut = self._find_png_end() if self._buffer.startswith(PNG) else self._find_end()
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
        self._at = self._searched = 0

    def _find_picture(self, fresh: int, t_ns: int) -> bool:
        """Skip text up to the next picture, and read its headers. ``fresh``: bytes at the end that arrived just now."""
        buffer = self._buffer
        match = _BEGIN.search(buffer, self._at)
        if match is None:
            self.searched += len(buffer) - self._at
            if self.searched > LONGEST_SEARCH:
                raise StreamError("not_mjpeg", f"no picture in {self.searched} bytes")
            self._drop(max(0, len(buffer) - LONGEST_HEADERS))
            self._at = max(0, len(buffer) - len(PNG) + 1)
            return False
        begin = match.start()
        headers, self._delimiter = headers_in(bytes(buffer[max(0, begin - LONGEST_HEADERS) : begin]))
        self._length = number_in(headers.get("content-length"))
        self._picture = PictureData(t_ns if len(buffer) - begin <= fresh else self._before_ns, headers)
        self.begun += 1
        self._drop(begin)
        self._at = len(PNG) if buffer.startswith(PNG) else 2
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
        return self._no_end()

    def _find_png_end(self) -> tuple[int, bool]:
        """As :meth:`_find_end`: a boundary, a wrong checksum or a length beyond all bounds ends the picture as cut."""
        buffer = self._buffer
        edge = self._delimiter if len(self._delimiter) > 5 else PNG  # shorter ones may be data
        while len(buffer) >= self._at + 8:
            at = self._at
            end = at + 12 + int.from_bytes(buffer[at : at + 4], "big")
            whole = len(buffer) >= end
            if whole and zlib.crc32(buffer[at + 4 : end - 4]).to_bytes(4, "big") == buffer[end - 4 : end]:
                self._at = end
                if buffer[at + 4 : at + 8] == b"IEND":
                    return end, False
                continue
            cut = buffer.find(edge, max(at, self._searched))
            self._searched = len(buffer) - len(edge) + 1
            if cut >= 0 or whole or end > self._largest:
                return cut if cut >= 0 else len(buffer), True
            break
        return self._no_end()

    def _no_end(self) -> tuple[int, bool]:
        if len(self._buffer) > self._largest:
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
