"""Incremental decoder of HTTP's chunked transfer coding (RFC 9112, 7.1).

A decoder of our own, since that of `http.client` waits, once it has taken the line end behind a chunk, for the size of
the next one: a picture that is there would be held back until the following one begins.
"""

from __future__ import annotations

from stereoservo_drivers.video.multipart import MultipartError

LONGEST_LINE = 4096
"""Bytes of a chunk's size with its extensions, or of one line of the trailer."""


class ChunkedDecoder:
    """Takes the bytes of a chunked body as they arrive. ``ended``: its last chunk has come."""

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
