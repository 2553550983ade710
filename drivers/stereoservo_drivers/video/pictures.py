"""Image operations (size check, one channel, rotation, complete JPEG data), and the monitor of an image stream."""

from __future__ import annotations

import cv2
import numpy as np

from stereoservo.numerics.arrays import ImageArray
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.video.options import Channel, Flip, Place, VideoOptions

_CHANNELS = {"blue": 0, "green": 1, "red": 2}
_FLIPS = {"horizontal": 1, "vertical": 0, "rotate180": -1}
_SIZE_MARKERS = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
_BARE_MARKERS = frozenset({0x01, *range(0xD0, 0xD9)})


JPEG, PNG = b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"
"""First bytes of every such picture."""
PICTURE_FLAG = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
"""Decoder flag for picture files: gray ones unchanged, others in colour, which :func:`one_channel` rounds properly; of
any depth, see :meth:`StreamMonitor.eight_bits`.
"""


def picture_flag(data: bytes, channel: Channel) -> int:
    """Decoder flag for ``data`` of a stream: the luma of JPEG is coded separately, and faster to decode alone."""
    if data.startswith(PNG):
        return PICTURE_FLAG
    expected = cv2.IMREAD_GRAYSCALE if channel == "gray" else cv2.IMREAD_COLOR
    return expected | cv2.IMREAD_IGNORE_ORIENTATION


def one_channel(image: ImageArray, channel: Channel, flip: Flip) -> ImageArray:
    """One channel ``(height, width)`` of ``image`` ``(height, width[, 3])``, blue first; contiguous. Any channel of a
    gray image is the image.
    """
    if image.ndim == 3:
        if channel == "gray":
            image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        else:
            image = image[:, :, _CHANNELS[channel]]
    if flip != "none":
        image = cv2.flip(np.ascontiguousarray(image), _FLIPS[flip])
    return np.ascontiguousarray(image)


def check_size(place: Place, options: VideoOptions, width: int, height: int) -> None:
    """Check the image size against the cell file. Raises DriverError (``image_size``)."""
    if (width, height) != (options.width, options.height):
        raise size_error(place, options, width, height)


def size_error(place: Place, options: VideoOptions, width: int, height: int) -> DriverError:
    """Error for images of another size than in the cell file."""
    return place.error(
        "image_size",
        f"its pictures are {width}x{height} px; the cell file says {options.width}x{options.height}. Set width = "
        f"{width} and height = {height} there, or the camera's own size",
        got=(width, height),
        asked=(options.width, options.height),
    )


def picture_size(data: bytes | bytearray) -> tuple[int, int] | None:
    """Width and height of complete JPEG data (begin marker, frame header, end marker after it) or PNG data, or None.

    Decoders silently fill in missing data. Cameras may pad after the end; within coded data there is no end marker, and
    that of a thumbnail is before the frame header. ITU-T T.81, B.1.
    """
    if data.startswith(PNG):
        whole = data[12:16] == b"IHDR" and data.rfind(b"IEND") > 0
        return (int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")) if whole else None
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
        elif marker in _BARE_MARKERS:
            at += 2
        elif marker in _SIZE_MARKERS:
            if data.rfind(b"\xff\xd9", at) < 0:
                return None
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


# -- monitor of a stream ---------------------------------------------------------------------------------------


DEPTHS = (8, 10, 12, 14, 16)


class StreamMonitor:
    """Numbers the frames of one camera, counts missing ones, withholds repeated images. Persists over reconnections.

    ``row``: number of consecutive pictures equal to the last one delivered. ``bits``: depth of the pictures, the
    smallest of 8, 10, 12, 14 and 16 that held them all.
    """

    def __init__(self, rate_hz: float) -> None:
        self.frames = 0
        self.dropped = 0
        self.frozen = 0
        self.row = 0
        self.number = -1
        self.bits = 8
        self._rate_hz = rate_hz
        self._last: ImageArray | None = None
        self._last_seq: int | None = None
        self._last_ns: int | None = None
        self._late = 0

    def begin(self) -> None:
        """Handle the reopening of the source: numbering and grid restart, the last image is kept."""
        self.row = 0
        self._last_seq = None
        self._last_ns = None
        self._late = 0

    def eight_bits(self, image: ImageArray) -> ImageArray:
        """``image`` in 8 bits: of deeper ones the upper 8 of :attr:`bits`, since cameras of 10 or 12 bits leave the
        upper ones of 16 empty.
        """
        if image.dtype == np.uint8:
            return image
        self.bits = max(self.bits, next(bits for bits in DEPTHS if int(image.max()) >> bits == 0))
        return (image >> (self.bits - 8)).astype(np.uint8)

    def see(self, image: ImageArray, t_received_ns: int, seq: int | None, skipped: int, *, look: bool) -> bool:
        """Count an image and set its :attr:`number`; False: it must be withheld.

        ``seq``: the source's number, None if it has none: missing frames are then determined by the time since the
        last.
        ``skipped``: pictures received before it that were not processed. ``look``: whether equal ones are frozen.
        """
        if seq is not None and seq == self._last_seq:
            self.frozen += 1
            self.row += 1
            return False
        missing = self._missing(t_received_ns, seq, skipped)
        self.frames += 1 + skipped
        self.dropped += missing
        self.number += 1 + skipped + max(0, missing)
        self._last_seq, self._last_ns = seq, t_received_ns
        if not look:
            return True
        if self._last is not None and _equal(image, self._last):
            self.frozen += 1
            self.row += 1
            return False
        self._last = image
        self.row = 0
        return True

    def _missing(self, t_received_ns: int, seq: int | None, skipped: int) -> int:
        """Number of frames missing just before this one; -1: one that was counted as missing was only late."""
        if seq is not None and self._last_seq is not None:
            return max(0, seq - self._last_seq - 1 - skipped)  # a lower number: the source has restarted
        if seq is not None or self._last_ns is None:
            return 0
        missing = round((t_received_ns - self._last_ns) * 1e-9 * self._rate_hz) - 1 - skipped
        if missing < 0:
            missing = -1 if self._late else 0
        self._late = max(0, self._late + missing) if missing else 0
        return missing


def _equal(one: ImageArray, other: ImageArray) -> bool:
    return one.shape == other.shape and cv2.norm(one, other, cv2.NORM_INF) == 0.0
