"""Byte ports of serial-line CAN: a serial device, a pseudo terminal, or a TCP connection, each a file descriptor."""

from __future__ import annotations

import errno
import os
import re
import select
import socket
import time
from typing import Protocol

import serial

from stereoservo.messages.addresses import Address

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
        # A terminal's read may be as empty because nothing has come: it is asked before.
        self._tells_its_end = isinstance(descriptor, socket.socket)

    def fileno(self) -> int:
        """Descriptor for ``select``."""
        return self._fd[0]

    def read(self, timeout_s: float | None) -> bytes:
        """Waiting bytes, at most ``CHUNK``; blocks up to the time limit (None: for ever). Empty on time-out.

        Raises:
            PortLostError: the other side is gone.
            OSError: anything else that the system says.
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
            OSError: anything else that the system says.
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
        raise ValueError(
            "an empty channel; valid: /dev/ttyACM0, /dev/ttyUSB0@1000000, socket://127.0.0.1:5400"
        )
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
    # Without it, Nagle's algorithm and delayed acknowledgement hold small writes back for 40 ms.
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return SlcanPort(connection, channel)


def _sorted(error: OSError) -> OSError:
    if error.errno in DISCONNECTED:
        return PortLostError(error.errno, error.strerror)
    return error
