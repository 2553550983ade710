"""Endpoints by which a master connects to an emulated bus: serial-line CAN on TCP or a pty, or any python-can
interface.
"""

from __future__ import annotations

import contextlib
import os
import pty
import select
import socket
import tty
from typing import Any, Protocol

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_drivers.can.messages import from_message, to_message
from stereoservo_drivers.can.slcan_adapter import SlcanAdapter

READ_SIZE = 65_536
BACKLOG_LIMIT = 1 << 20
"""Bytes that a client may leave unread; what comes then is lost, as in an adapter whose buffer is full."""
DATA_OVERRUN = 0x08
WRONG_BITRATE = 0x80 | 0x20 | 0x04
"""Bus error, error passive, error warning: what an adapter at another bit rate than the bus ends in."""


class EndpointError(Exception):
    """A channel cannot be served; the text names it and the cause."""


class Endpoint(Protocol):
    """Protocol of the master's side of the bus.

    ``channel``: how a master reaches it. ``descriptors``: what to wait for; empty where it has to be asked.
    """

    channel: str

    def descriptors(self) -> list[int]:
        """File descriptors that become readable when data arrive."""
        ...

    def take(self) -> list[CanFrame]:
        """Frames that the master sent; never waits."""
        ...

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Frames for the master with their bus times [ns]; never waits."""
        ...

    def plug(self, plugged: bool) -> None:
        """Unplug the adapter (False), or plug it in again."""
        ...

    def close(self) -> None:
        """Release it."""
        ...


class _SerialClient:
    """One serial-line client, with an emulated adapter between bytes and frames."""

    def __init__(self, descriptor: int, bus_bitrate: int) -> None:
        self.descriptor = descriptor
        self.adapter = SlcanAdapter()
        self._bitrate = bus_bitrate
        self._unsent = b""

    @property
    def deaf(self) -> bool:
        """Whether the host set another bit rate than the bus has."""
        rate = self.adapter.bitrate
        return self.adapter.registers is not None or (rate is not None and rate != self._bitrate)

    def take(self) -> list[CanFrame]:
        """Frames of the host. Raises OSError where it is gone."""
        try:
            chunk = os.read(self.descriptor, READ_SIZE)
        except BlockingIOError:
            return []
        if not chunk:
            raise ConnectionResetError("the client has closed the connection")
        was_open = self.adapter.is_open
        frames, answer = self.adapter.feed(chunk)
        if was_open and not self.adapter.is_open:
            self._unsent = b""  # frames of a channel that is closed
        if frames and self.deaf:
            self.adapter.flags |= WRONG_BITRATE
            frames = []
        self.write(answer)
        return frames

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Frames for the host. Raises OSError where it is gone."""
        if not self.adapter.is_open:
            return
        if self.deaf:
            self.adapter.flags |= WRONG_BITRATE
            return
        self.write(self.adapter.deliver([frame for _, frame in frames], frames[-1][0]))

    def write(self, data: bytes) -> None:
        """Write as much as the host takes now."""
        self._unsent += data
        if not self._unsent:
            return
        with contextlib.suppress(BlockingIOError):
            self._unsent = self._unsent[os.write(self.descriptor, self._unsent) :]
        if len(self._unsent) > BACKLOG_LIMIT:
            self._unsent = b""
            self.adapter.flags |= DATA_OVERRUN


class SlcanTcp:
    """Serial-line CAN on 127.0.0.1, one client at a time; a second one is refused. Port 0: a free one."""

    def __init__(self, port: int, bus_bitrate: int) -> None:
        self._bitrate = bus_bitrate
        self._client: socket.socket | None = None
        self._line: _SerialClient | None = None
        self._listener: socket.socket | None = None
        self._port = port
        self._listen()
        self.channel = f"socket://127.0.0.1:{self._port}"

    def _listen(self) -> None:
        listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind(("127.0.0.1", self._port))
            listener.listen(4)
        except OSError as error:
            listener.close()
            raise EndpointError(
                f"cannot listen on 127.0.0.1:{self._port}: {error.strerror}; end what listens there, or take another "
                "port (0: a free one)"
            ) from error
        listener.setblocking(False)
        self._port = listener.getsockname()[1]
        self._listener = listener

    def descriptors(self) -> list[int]:
        """The listener's and the client's."""
        return [end.fileno() for end in (self._listener, self._client) if end is not None]

    def take(self) -> list[CanFrame]:
        """Frames of the client, if there is one."""
        frames = self._read()
        self._accept(frames)
        return frames

    def _read(self) -> list[CanFrame]:
        if self._line is None:
            return []
        try:
            return self._line.take()
        except OSError:
            self._drop()
            return []

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Frames for the client, if there is one; they are lost otherwise."""
        if self._line is None:
            return
        try:
            self._line.give(frames)
        except OSError:
            self._drop()

    def plug(self, plugged: bool) -> None:
        """Plug or unplug: unplugged, the connection is closed and the port does not listen."""
        if plugged and self._listener is None:
            self._listen()
        elif not plugged:
            self._drop()
            if self._listener is not None:
                self._listener.close()
                self._listener = None

    def close(self) -> None:
        """Close the connection; nobody listens any more."""
        self.plug(False)

    def _accept(self, frames: list[CanFrame]) -> None:
        if self._listener is None:
            return
        try:
            client, _ = self._listener.accept()
        except BlockingIOError:
            return
        # Whoever closes a connection may open the next at once: what the old one still says comes first.
        while self._client is not None and select.select([self._client], [], [], 0)[0]:
            frames += self._read()
        if self._client is not None:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        self._line = _SerialClient(client.fileno(), self._bitrate)

    def _drop(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = self._line = None


class SlcanPty:
    """Serial-line CAN on a pseudo terminal, for masters that open a device by its path."""

    def __init__(self, bus_bitrate: int) -> None:
        self._bitrate = bus_bitrate
        self._open()

    def _open(self) -> None:
        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._line = _SerialClient(self._ours, self._bitrate)
        self.channel = os.ttyname(self._theirs)

    def descriptors(self) -> list[int]:
        """Descriptor of our end."""
        return [self._ours] if self._ours >= 0 else []

    def take(self) -> list[CanFrame]:
        """What was written to the terminal. Our own open end keeps it alive between masters."""
        return self._line.take() if self._ours >= 0 else []

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Frames for whoever reads the terminal."""
        if self._ours >= 0:
            self._line.give(frames)

    def plug(self, plugged: bool) -> None:
        """Plug or unplug: unplugged, the terminal does not exist; plugged in again it may have another path."""
        if plugged and self._ours < 0:
            self._open()
        elif not plugged and self._ours >= 0:
            os.close(self._theirs)
            os.close(self._ours)
            self._ours = -1

    def close(self) -> None:
        """Remove the terminal."""
        self.plug(False)


class PythonCanEndpoint:
    """Any python-can interface: ``virtual`` for a master in the same process, ``socketcan`` for a kernel's bus."""

    def __init__(self, interface: str, channel: str | int, **options: Any) -> None:
        import can

        self.channel = f"{interface}:{channel}"
        self._error = can.CanError
        try:
            self._bus = can.Bus(interface=interface, channel=channel, **options)
        except Exception as error:  # interfaces without their maker's library raise anything
            what = str(error) or type(error).__name__
            raise EndpointError(f"python-can cannot open {self.channel}: {what}") from error
        self._plugged = True
        self.lost = 0

    def descriptors(self) -> list[int]:
        """Descriptor of the bus, where it has one."""
        try:
            descriptor = self._bus.fileno()
        except NotImplementedError:
            return []
        return [descriptor] if descriptor >= 0 else []

    def take(self) -> list[CanFrame]:
        """Frames on the bus."""
        frames = []
        while (message := self._bus.recv(timeout=0)) is not None:
            if not message.is_error_frame:
                frames.append(from_message(message))
        return frames if self._plugged else []

    def give(self, frames: list[tuple[int, CanFrame]]) -> None:
        """Send to the bus; frames that its transmit buffer does not accept are lost and counted in ``lost``."""
        if not self._plugged:
            return
        for _, frame in frames:
            try:
                self._bus.send(to_message(frame))
            except self._error:
                self.lost += 1

    def plug(self, plugged: bool) -> None:
        """Plug or unplug: unplugged, no frame passes (a python-can bus cannot be removed from its master)."""
        self._plugged = plugged

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()
