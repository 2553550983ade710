"""Emulated serial-line CAN adapter, without I/O or clock: parses commands, produces answers."""

from __future__ import annotations

from binascii import Error as HexError
from binascii import unhexlify

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.slcan_lines import BEL, BITRATES, CR, LineError, LineSplitter, decode_frame, encode_frame

_BITRATE_OF = {command.encode(): bitrate for bitrate, command in BITRATES.items()}
_SHORT, _LONG = b"z\r", b"Z\r"


class SlcanAdapter:
    """State of one adapter: closed, open, or open for listening; invalid commands are refused with BEL.

    ``bitrate``: set by the host [bit/s]; None before, or if it was set by registers (``registers``, BTR0 and BTR1). The
    owner of the bus compares it with the bus. ``flags``: the status that ``F`` reports and clears.
    """

    def __init__(self, *, version: bytes = b"V1013", serial: bytes = b"NSERV") -> None:
        self.is_open = False
        self.listen_only = False
        self.bitrate: int | None = None
        self.registers: tuple[int, int] | None = None
        self.flags = 0
        self.malformed = 0
        self._stamped = False
        self._version = version
        self._serial = serial
        self._splitter = LineSplitter()

    def feed(self, chunk: bytes) -> tuple[list[CanFrame], bytes]:
        """Process bytes from the host; returns the frames to send on the bus, and the answer to write back."""
        frames: list[CanFrame] = []
        answers: list[bytes] = []
        for line in self._splitter.feed(chunk):
            if line[:1] in (b"t", b"T", b"r", b"R"):
                answers.append(self._transmit(line, frames))
            else:
                answers.append(self._command(line))
        return frames, b"".join(answers)

    def deliver(self, frames: list[CanFrame], t_ns: int = 0) -> bytes:
        """Lines for the host of ``frames`` that were on the bus at ``t_ns``; empty while closed."""
        if not self.is_open:
            return b""
        if not self._stamped:
            return b"".join([encode_frame(frame) for frame in frames])
        stamp = b"%04X\r" % (t_ns // 1_000_000 % 60_000)
        return b"".join([encode_frame(frame)[:-1] + stamp for frame in frames])

    def _transmit(self, line: bytes, frames: list[CanFrame]) -> bytes:
        try:
            frame = decode_frame(line)
        except LineError:
            self.malformed += 1
            return BEL
        if not self.is_open or self.listen_only:
            return BEL
        frames.append(frame)
        return _LONG if frame.extended else _SHORT

    def _command(self, line: bytes) -> bytes:
        """Answer to a command line. An empty line only ends preceding noise."""
        if line == b"":
            return CR
        if line in (b"O", b"L"):
            if self.is_open:
                return BEL
            self.is_open, self.listen_only = True, line == b"L"
            return CR
        if line == b"C":
            was_open, self.is_open = self.is_open, False
            return CR if was_open else BEL
        if line == b"V":
            return self._version + CR
        if line == b"N":
            return self._serial + CR
        if line == b"F" and self.is_open:
            flags, self.flags = self.flags, 0
            return b"F%02X\r" % flags
        if not self.is_open and self._set_up(line):
            return CR
        return BEL

    def _set_up(self, line: bytes) -> bool:
        """Handle a command that a closed channel accepts: bit rate, registers, time stamps, automatic polling."""
        if line in _BITRATE_OF:
            self.bitrate, self.registers = _BITRATE_OF[line], None
            return True
        if line[:1] == b"s" and len(line) == 5:
            try:
                first, second = unhexlify(line[1:])
            except HexError:
                return False
            self.bitrate, self.registers = None, (first, second)
            return True
        if line in (b"Z0", b"Z1"):
            self._stamped = line == b"Z1"
            return True
        return line in (b"X0", b"X1")
