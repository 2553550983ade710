"""Incremental parser of a ``multipart/x-mixed-replace`` stream (RFC 2046)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from stereoservo_drivers.video.pictures import jpeg_size

LARGEST_PART = 50_000_000
LONGEST_HEADERS = 16384
_JPEG_END = b"\xff\xd9"
_HEADERS_END = re.compile(rb"\A\r?\n|\r?\n\r?\n")
"""An empty line; the first, where a part has no headers."""


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

    A JPEG picture without a stated length is complete with its end marker: the boundary behind it may be sent with the
    next picture only.
    """

    def __init__(self, boundary: str, largest: int = LARGEST_PART) -> None:
        # Half of the servers write the boundary's leading "--" into the header already: both end in this.
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
        if (
            length is None
            and self._buffer.endswith((_JPEG_END, _JPEG_END + b"\r\n"))
            and jpeg_size(self._buffer)
        ):
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
    """The number in a header; None where there is none."""
    return int(text) if text is not None and text.isascii() and text.isdigit() and len(text) < 19 else None
