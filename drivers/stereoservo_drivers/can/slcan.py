"""Serial-line CAN as a python-can interface, ``stereoservo_slcan``: for adapters on serial lines, pty, and over TCP.

python-can's own ``slcan`` reads byte by byte (python-can #2027), leaves Nagle's algorithm on over TCP and sleeps two
seconds when it opens; cycles of hundreds of hertz need whole reads and one write a cycle.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

import can
import serial

from stereoservo.messages.addresses import Address
from stereoservo_drivers.can.frames import CanFrame, from_message, to_message
from stereoservo_drivers.can.slcan_lines import (
    BEL,
    LineError,
    LineSplitter,
    bitrate_command,
    decode_frame,
    encode_frame,
)

GARBLED_LINES = 32
"""Number of consecutive malformed lines that are not line noise: the other side uses another protocol."""
_FRAMES = frozenset(b"tTrR")
_SENT = frozenset((b"", b"z", b"Z"))


class SlcanLostError(can.CanOperationError):
    """The adapter is unplugged, or the peer has closed the connection."""


class SlcanRefusedError(can.CanOperationError):
    """The adapter answered BEL: it refused a frame or command."""


class SlcanGarbledError(can.CanOperationError):
    """Only malformed lines arrive."""


class SlcanBus(can.BusABC):
    """A CAN bus behind a Lawicel-style adapter.

    ``channel``: a serial device (``/dev/ttyACM0``, ``/dev/ttyUSB0@1000000``), a pty, or ``socket://HOST:PORT``.
    ``bitrate``: set on the adapter (None: unchanged). ``send_timeout_s``: time limit of a send on a full line.
    ``reply_timeout_s``: time limit of answers to commands; adapters without answers need it three times at opening.
    One thread may receive while others send. A malformed line is skipped and counted (``malformed``, the last one
    in ``last_malformed``).

    Raises:
        ValueError: channel or bitrate; states what is valid.
        can.CanInitializationError: device, peer or adapter refuse.
    """

    def __init__(
        self,
        channel: str,
        bitrate: int | None = None,
        *,
        tty_baudrate: int = 115_200,
        rtscts: bool = False,
        listen_only: bool = False,
        connect_timeout_s: float = 2.0,
        send_timeout_s: float = 0.1,
        reply_timeout_s: float = 0.1,
        can_filters: Any = None,
    ) -> None:
        set_up = [bitrate_command(bitrate)] if bitrate is not None else []
        self._send_timeout_s = send_timeout_s
        self._reply_timeout_s = reply_timeout_s
        self._splitter = LineSplitter()
        self._frames: deque[CanFrame] = deque()
        self._answers: deque[bytes] = deque(maxlen=64)
        self._write_lock = threading.Lock()
        self._refusal_lock = threading.Lock()
        self._unsent = b""
        self._refusals = 0
        self._garbled = 0
        self.malformed = 0
        self.last_malformed: LineError | None = None
        try:
            self._port = open_port(str(channel), tty_baudrate, rtscts=rtscts, connect_timeout_s=connect_timeout_s)
        except OSError as error:
            raise can.CanInitializationError(f"cannot open {Address(str(channel))}: {error}") from error
        self.channel_info = f"serial-line CAN on {Address(str(channel))}"
        try:
            self._begin([*set_up, "L" if listen_only else "O"])
        except can.CanOperationError as error:
            self._port.close()
            raise can.CanInitializationError(f"no serial-line CAN on {Address(str(channel))}: {error}") from error
        super().__init__(channel, can_filters)

    def _begin(self, commands: list[str]) -> None:
        """Close an open channel, flush the line, then send ``commands``, none of which may be refused."""
        self._write(b"\r\r\rC\r")
        deadline = time.monotonic() + self._reply_timeout_s
        self._await_answer(deadline)
        while self._fill(0.01) and time.monotonic() < deadline:
            pass
        self._frames.clear()
        self._answers.clear()
        self._forget_refusals()
        self._garbled = self.malformed = 0
        for command in commands:
            self._write(command.encode() + b"\r")
            if self._await_answer(time.monotonic() + self._reply_timeout_s) == BEL:
                raise SlcanRefusedError(f"the adapter refused command {command!r}")

    def _await_answer(self, deadline: float) -> bytes | None:
        """The next answer other than a frame; None if there is none before ``deadline`` of the monotonic clock [s]."""
        while not self._answers:
            left = deadline - time.monotonic()
            if left <= 0 or not self._fill(left):
                return None
        return self._answers.popleft()

    def _forget_refusals(self) -> int:
        with self._refusal_lock:
            refusals, self._refusals = self._refusals, 0
        return refusals

    def _write(self, lines: bytes, timeout_s: float | None = None) -> None:
        limit = self._send_timeout_s if timeout_s is None else timeout_s
        with self._write_lock:
            try:
                # Send the rest of a line that a time-out cut off first, so that no line is broken.
                self._unsent = self._port.write(self._unsent + lines, limit)
            except PortLostError as error:
                raise SlcanLostError(f"{self._port.name}: {error.strerror}", error.errno) from error
            except (OSError, ValueError) as error:
                raise can.CanOperationError(f"{self._port.name}: {error}") from error
            if self._unsent:
                message = (
                    f"{self._port.name} took no more for {limit} s; {len(self._unsent)} bytes wait and go first "
                    "with the next send"
                )
                raise can.CanTimeoutError(message)

    def _fill(self, timeout_s: float | None) -> bool:
        """Read once and sort the received lines; returns False on time-out."""
        try:
            chunk = self._port.read(timeout_s)
        except PortLostError as error:
            raise SlcanLostError(f"{self._port.name}: {error.strerror}", error.errno) from error
        except (OSError, ValueError) as error:
            raise can.CanOperationError(f"{self._port.name}: {error}") from error
        for line in self._splitter.feed(chunk):
            if line and line[0] in _FRAMES:
                self._take_frame(line)
            elif line in _SENT:
                self._answers.append(line)
            elif line == BEL:
                with self._refusal_lock:
                    self._refusals += 1
                self._answers.append(line)
            elif line[0] in b"VNF":
                self._answers.append(line)
            else:
                self._skip(LineError(line, "neither a frame nor an answer"))
        return bool(chunk)

    def _take_frame(self, line: bytes) -> None:
        try:
            self._frames.append(decode_frame(line))
        except LineError as error:
            self._skip(error)
        else:
            self._garbled = 0

    def _skip(self, error: LineError) -> None:
        self.malformed += 1
        self._garbled += 1
        self.last_malformed = error

    def _check(self) -> None:
        """Raise the errors that the adapter reported since the last call."""
        if self._refusals:
            refusals = self._forget_refusals()
            raise SlcanRefusedError(f"{self._port.name}: the adapter refused {refusals} frames or commands (BEL)")
        if self._garbled >= GARBLED_LINES:
            garbled, self._garbled = self._garbled, 0
            raise SlcanGarbledError(
                f"{self._port.name}: {garbled} lines one after the other were no frames; the last: "
                f"{self.last_malformed}"
            )

    def send_many(self, frames: Sequence[CanFrame], timeout: float | None = None) -> None:
        """Send ``frames`` in one write. ``timeout`` [s] replaces ``send_timeout_s``.

        Raises:
            can.CanTimeoutError: the line accepts no more data.
            can.CanOperationError: the connection is lost (``SlcanLostError``), or an earlier frame was refused
                (``SlcanRefusedError``); in the latter case these are sent nevertheless.
        """
        self._write(b"".join([encode_frame(frame) for frame in frames]), timeout)
        self._check()

    def receive_many(self, timeout: float | None) -> list[CanFrame]:
        """All waiting frames, unfiltered; waits up to ``timeout`` [s] for the first. Raises as ``recv``."""
        self._await_frame(timeout)
        frames = list(self._frames)
        self._frames.clear()
        return frames

    def _await_frame(self, timeout: float | None) -> None:
        """Read until a frame arrives, at most for ``timeout`` [s]."""
        self._check()
        deadline = None if timeout is None else time.monotonic() + timeout
        while not self._frames:
            left = None if deadline is None else deadline - time.monotonic()
            if not self._fill(left if left is None or left > 0.0 else 0.0):
                return
            self._check()
            if left is not None and left <= 0.0:
                return

    def status_flags(self) -> int | None:
        """The adapter's status by command ``F``, see ``flags_in_words``; None if it does not report it."""
        self._answers.clear()
        self._write(b"F\r")
        deadline = time.monotonic() + self._reply_timeout_s
        while (answer := self._await_answer(deadline)) is not None:
            if answer[:1] == b"F" and len(answer) == 3:
                return int(answer[1:], 16)
            if answer == BEL:
                self._forget_refusals()
                return None
        return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one message; see ``send_many``.

        Raises:
            ValueError: an error frame or a CAN FD frame.
        """
        self.send_many([from_message(msg)], timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not self._frames:
            self._await_frame(timeout)
        if not self._frames:
            return None, False
        message = to_message(self._frames.popleft())
        message.timestamp = time.time()
        return message, False

    def fileno(self) -> int:
        """Descriptor of the port. It is not readable for frames that were already read: receive until there is none."""
        return self._port.fileno()

    def shutdown(self) -> None:
        """Close the adapter's channel and the port; errors are ignored if they are already closed."""
        if self._is_shutdown:
            return
        super().shutdown()
        # Unplugged, or the line is full: only the port can be closed.
        with contextlib.suppress(can.CanError):
            self._write(b"C\r", 0.05)
        self._port.close()


# -- serial ports --------------------------------------------------------------------------------------------
# Byte ports of serial-line CAN: a serial device, a pseudo terminal, or a TCP connection, each a file descriptor.


CHUNK = 8192
DISCONNECTED = (errno.EIO, errno.ENODEV, errno.ENXIO, errno.EBADF, errno.EPIPE, errno.ECONNRESET)
_URL = re.compile(r"socket://(?P<host>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):(?P<port>[0-9]{1,5})")


class PortLostError(OSError):
    """The connection is lost: adapter unplugged, or closed by the peer."""


class _Descriptor(Protocol):
    def fileno(self) -> int: ...

    def close(self) -> None: ...


class SlcanPort:
    """Non-blocking reads and writes on one open descriptor, with time limits."""

    def __init__(self, descriptor: _Descriptor, name: str) -> None:
        self.name = name
        self._descriptor = descriptor
        self._fd = [descriptor.fileno()]
        # An empty read of a terminal may also mean that no data arrived: it was checked before.
        self._tells_its_end = isinstance(descriptor, socket.socket)

    def fileno(self) -> int:
        """Descriptor for ``select``."""
        return self._fd[0]

    def read(self, timeout_s: float | None) -> bytes:
        """Waiting bytes, at most ``CHUNK``; blocks up to the time limit (None: for ever). Empty on time-out.

        Raises:
            PortLostError: the other side is gone.
            OSError: any other system error.
        """
        if not (timeout_s == 0 and self._tells_its_end) and not select.select(self._fd, (), (), timeout_s)[0]:
            return b""
        try:
            chunk = os.read(self._fd[0], CHUNK)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise _sorted(error) from error
        if not chunk:
            raise PortLostError(errno.ENODEV, "end of the stream: the other side has closed or is unplugged")
        return chunk

    def write(self, content: bytes, timeout_s: float) -> bytes:
        """Write ``content``; returns what could not be written within ``timeout_s``.

        Raises:
            PortLostError: the other side is gone.
            OSError: any other system error.
        """
        deadline = None
        while content:
            try:
                content = content[os.write(self._fd[0], content) :]
                continue
            except BlockingIOError:
                pass
            except OSError as error:
                raise _sorted(error) from error
            now = time.monotonic()
            deadline = now + timeout_s if deadline is None else deadline
            if now >= deadline or not select.select((), self._fd, (), deadline - now)[1]:
                return content
        return b""

    def close(self) -> None:
        """Close the descriptor."""
        self._descriptor.close()


def open_port(channel: str, baud: int, *, rtscts: bool = False, connect_timeout_s: float = 2.0) -> SlcanPort:
    """Open ``channel``: ``socket://HOST:PORT``, or a serial device with its speed after an ``@`` or else ``baud``.

    A serial device is locked against other processes.

    Raises:
        ValueError: the channel's text; states what would be valid.
        OSError: the system refuses (``serial.SerialException`` is one).
    """
    if "://" in channel:
        return _connect(channel, connect_timeout_s)
    device, at, speed = channel.rpartition("@")
    if at and speed.isdecimal():
        channel, baud = device, int(speed)
    if not channel:
        raise ValueError("an empty channel; valid: /dev/ttyACM0, /dev/ttyUSB0@1000000, socket://127.0.0.1:5400")
    line = serial.Serial(channel, baudrate=baud, timeout=0, rtscts=rtscts, exclusive=True)
    os.set_blocking(line.fileno(), False)
    return SlcanPort(line, channel)


def _connect(channel: str, timeout_s: float) -> SlcanPort:
    match = _URL.fullmatch(channel)
    if match is None or not 0 < int(match["port"]) < 65536:
        raise ValueError(
            f"channel {Address(channel)!r} is no address; valid: socket://HOST:PORT, for instance socket://127.0.0.1:5400"
        )
    connection = socket.create_connection((match["host"].strip("[]"), int(match["port"])), timeout_s)
    connection.setblocking(False)
    # Without it, Nagle's algorithm and delayed acknowledgement delay small writes by 40 ms.
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return SlcanPort(connection, channel)


def _sorted(error: OSError) -> OSError:
    if error.errno in DISCONNECTED:
        return PortLostError(error.errno, error.strerror)
    return error
