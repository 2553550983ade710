"""Codec of Lawicel's serial-line CAN protocol: frames as text lines, lines from a byte stream. For host and
adapter.

A line ends with CR; a BEL alone means that the adapter refused. Frames: ``tIIILDD…`` (data, 11 bits), ``TIIIIIIIILDD…``
(29 bits), ``rIIIL``, ``RIIIIIIIIL`` (remote); an adapter may append a time stamp of four digits [ms].
Source: LAWICEL AB, CANUSB manual, "CANUSB ASCII commands". Other firmware ends its lines with CR LF or LF, and stamps
with eight digits [us]: both are read.
"""

from __future__ import annotations

from binascii import Error as HexError
from binascii import hexlify, unhexlify
from functools import cache

from stereoservo_drivers.can.frames import CanFrame

CR, LF = b"\r", b"\n"
BEL = b"\a"
LONGEST_LINE = 64
"""Maximum length of a line [bytes]; the longest valid one has 34. Longer data without an end is not a line."""

BITRATES = {
    10_000: "S0",
    20_000: "S1",
    50_000: "S2",
    100_000: "S3",
    125_000: "S4",
    250_000: "S5",
    500_000: "S6",
    800_000: "S7",
    1_000_000: "S8",
}
"""[bit/s] to command. S7 is 800 kbit/s in the manual; python-can's ``slcan`` calls it 750 kbit/s."""

FLAG_WORDS = (
    "receive buffer full",
    "transmit buffer full",
    "error warning",
    "data overrun",
    "",
    "error passive",
    "arbitration lost",
    "bus error",
)
"""Meaning of the bits of the answer to ``F``, from bit 0."""

_ID_DIGITS = {ord("t"): 3, ord("r"): 3, ord("T"): 8, ord("R"): 8}
_REMOTE = {ord("r"), ord("R")}
_STAMPS = (0, 4, 8)


class LineError(ValueError):
    """Malformed line. ``line``: as received, without its end; ``reason``: its error."""

    def __init__(self, line: bytes, reason: str) -> None:
        super().__init__(f"malformed serial-line CAN {line[:LONGEST_LINE]!r}: {reason}")
        self.line = line
        self.reason = reason


def encode_frame(frame: CanFrame) -> bytes:
    """Encode ``frame`` as a line with its end.

    Raises:
        ValueError: id, data or length is not valid in a classical frame.
    """
    if not (frame.remote or frame.extended):
        return _head(frame.id, len(frame.data)) + hexlify(frame.data).upper() + CR
    highest = 0x1FFFFFFF if frame.extended else 0x7FF
    if not 0 <= frame.id <= highest:
        raise ValueError(f"id 0x{frame.id:X} of a frame; valid here: 0 to 0x{highest:X}")
    length = frame.length if frame.remote else len(frame.data)
    if not 0 <= length <= 8:
        raise ValueError(f"{length} data bytes in a frame; at most 8")
    if frame.remote:
        if frame.data:
            raise ValueError(f"a remote frame with {len(frame.data)} data bytes; it has none")
        return (b"R%08X%d\r" if frame.extended else b"r%03X%d\r") % (frame.id, length)
    return b"T%08X%d%b\r" % (frame.id, length, hexlify(frame.data).upper())


@cache
def _head(can_id: int, length: int) -> bytes:
    """Line of a data frame with 11 bits up to its data."""
    if not 0 <= can_id <= 0x7FF:
        raise ValueError(f"id 0x{can_id:X} of a frame; valid here: 0 to 0x7FF")
    if length > 8:
        raise ValueError(f"{length} data bytes in a frame; at most 8")
    return b"t%03X%d" % (can_id, length)


def decode_frame(line: bytes) -> CanFrame:
    """Decode a frame from its ``line`` without the end, with or without a time stamp.

    Raises:
        LineError: the line is not a frame.
    """
    return _usual_frame(line) or _any_frame(line)


def _usual_frame(line: bytes) -> CanFrame | None:
    """Fast decoder of a data frame with 11 bits and without a stamp; None for any other line."""
    if not line.startswith(b"t"):
        return None
    try:
        octets = unhexlify(line[1:])  # three digits of id and one of length, then the data
    except HexError:
        return None
    if len(octets) < 2 or octets[0] > 0x7F or len(octets) > 10 or octets[1] & 0x0F != len(octets) - 2:
        return None
    return CanFrame(octets[0] << 4 | octets[1] >> 4, octets[2:])


def _any_frame(line: bytes) -> CanFrame:
    digits = _ID_DIGITS.get(line[0]) if line else None
    if digits is None:
        raise LineError(line, "a frame begins with t, T, r or R")
    extended, remote = digits == 8, line[0] in _REMOTE
    if len(line) < digits + 2:
        raise LineError(line, f"{len(line)} characters; a frame of this kind has at least {digits + 2}")
    length = line[digits + 1] - 48
    if not 0 <= length <= 8:
        raise LineError(line, f"data length {line[digits + 1 : digits + 2]!r}; valid: 0 to 8")
    end = digits + 2 + (0 if remote else 2 * length)
    if len(line) - end not in _STAMPS:
        valid = f"{end}, or {end + 4} or {end + 8} with a stamp"
        raise LineError(line, f"{len(line)} characters; with length {length}: {valid}")
    try:
        identifier = int.from_bytes(unhexlify(line[1:9] if extended else b"0" + line[1:4]), "big")
        data = unhexlify(line[digits + 2 :])
    except HexError:
        raise LineError(line, "a character that is no hexadecimal digit") from None
    if identifier > (0x1FFFFFFF if extended else 0x7FF):
        raise LineError(line, f"id 0x{identifier:X} is beyond {'29' if extended else '11'} bits")
    if remote:
        return CanFrame(identifier, b"", True, extended, length)
    return CanFrame(identifier, data[:length], False, extended)


def bitrate_command(bitrate: int) -> str:
    """Command ``S0`` … ``S8`` of a bit rate.

    Raises:
        ValueError: a bit rate without a command in this protocol; lists the valid ones.
    """
    if bitrate not in BITRATES:
        valid = ", ".join(f"{known}" for known in BITRATES)
        raise ValueError(f"bitrate {bitrate} bit/s has no serial-line CAN command; valid: {valid}")
    return BITRATES[bitrate]


def flags_in_words(flags: int) -> str:
    """The adapter's status answer to ``F`` as text."""
    words = [word for bit, word in enumerate(FLAG_WORDS) if word and flags >> bit & 1]
    return ", ".join(words) or "no error"


class LineSplitter:
    """Splits a byte stream that arrives in chunks into lines.

    Data longer than any line is returned as a line without waiting for its end, so that noise does not accumulate.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._after_cr = False

    def feed(self, chunk: bytes) -> list[bytes]:
        """Lines that ``chunk`` completes, without their ends: CR, LF or CR LF. A BEL ends the preceding line and is a
        line of its own.
        """
        if LF in chunk:
            after_cr, self._after_cr = self._after_cr, chunk.endswith(CR)
            chunk = chunk[after_cr and chunk.startswith(LF) :].replace(b"\r\n", CR).replace(LF, CR)
        elif chunk:
            self._after_cr = chunk.endswith(CR)
        if BEL in chunk:
            chunk = chunk.replace(BEL, b"\r\a\r")
            lines = (self._rest + chunk).split(CR)
            # The CRs inserted around BEL are not answers of the adapter.
            lines = [line for k, line in enumerate(lines) if line or not _beside_bell(lines, k)]
        else:
            lines = (self._rest + chunk).split(CR)
        self._rest = lines.pop()
        if len(self._rest) > LONGEST_LINE:
            lines.append(self._rest)
            self._rest = b""
        return lines


def _beside_bell(lines: list[bytes], k: int) -> bool:
    return k + 1 < len(lines) and lines[k + 1] == BEL
