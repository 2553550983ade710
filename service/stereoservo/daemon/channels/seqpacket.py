"""Unix SEQPACKET sockets between processes: non-blocking, whole messages of bounded size, a server for many peers.

A :class:`ChannelServer` accepts any number of peers or, with ``single=True``, keeps only the newest (a restarted
gateway replaces the one that died). No call blocks; a full socket is reported to the caller, which decides what to
drop.
"""

from __future__ import annotations

import os
import select
import socket
from collections import deque
from pathlib import Path
from types import TracebackType
from typing import Self

from stereoservo.messages.directories import check_socket_path

MAX_MESSAGE_BYTES = 1 << 20


class ChannelError(Exception):
    """A channel cannot be used. ``code``: ``"unreachable"``, ``"too_large"`` or ``"closed"``."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


class PacketChannel:
    """One end of a connected message channel."""

    def __init__(self, connection: socket.socket, name: str) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * MAX_MESSAGE_BYTES)
        self._socket = connection
        self._name = name
        self._open = True
        self._waiting = _readable(connection)

    @classmethod
    def connect(cls, path: Path) -> Self:
        """Connect to a server. Raises ChannelError if nobody listens."""
        check_socket_path(path)
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        connection.setblocking(False)
        try:
            connection.connect(str(path))
        except BlockingIOError as error:  # its queue is full: a blocking call would wait as long as the server hangs
            connection.close()
            raise ChannelError("unreachable", f"{path}: its process accepts no connection (it hangs?)") from error
        except OSError as error:
            connection.close()
            raise ChannelError("unreachable", f"{path}: nobody listens ({os.strerror(error.errno or 0)})") from error
        return cls(connection, str(path))

    def fileno(self) -> int:
        """Descriptor of the socket; -1 once it is closed."""
        return self._socket.fileno()

    @property
    def is_open(self) -> bool:
        """False once either side has closed."""
        return self._open

    def send(self, message: bytes) -> bool:
        """Send a whole message or nothing; False if the peer does not read its socket or has closed it.

        Raises ChannelError for messages over ``MAX_MESSAGE_BYTES``.
        """
        if len(message) > MAX_MESSAGE_BYTES:
            raise ChannelError(
                "too_large", f"{self._name}: message of {len(message)} bytes; at most {MAX_MESSAGE_BYTES}"
            )
        if not self._open:
            return False
        try:
            self._socket.send(message, socket.MSG_NOSIGNAL)
        except OSError:
            return False  # a closed peer may have left messages: `receive` detects the end
        return True

    def receive(self, limit: int = 64) -> list[bytes]:
        """Up to ``limit`` waiting messages, oldest first; marks the channel as closed if the peer has closed it."""
        messages: list[bytes] = []
        while self._open and len(messages) < limit and self._waiting.poll(0):
            try:
                message = self._socket.recv(MAX_MESSAGE_BYTES)
            except BlockingIOError:
                break
            except ConnectionResetError:
                continue  # raised once, if the peer left messages unread; the messages that it sent can still be read
            except OSError:
                self.close()
                break
            if not message:
                self.close()
                break
            messages.append(message)
        return messages

    def close(self) -> None:
        """Close this end. Idempotent."""
        self._open = False
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class ChannelServer:
    """Listens on a unix socket file; `accept` must be polled."""

    def __init__(self, path: Path, *, single: bool = False, max_peers: int = 32) -> None:
        check_socket_path(path)
        path.unlink(missing_ok=True)
        self._path = path
        self._single = single
        self._max_peers = max_peers
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setblocking(False)
        self._socket.bind(str(path))
        path.chmod(0o600)
        self._socket.listen(8)
        self._waiting = _readable(self._socket)
        self.peers: list[PacketChannel] = []

    def fileno(self) -> int:
        """Descriptor of the listening socket, readable while a peer waits to be accepted."""
        return self._socket.fileno()

    def accept(self) -> list[PacketChannel]:
        """Accept waiting peers, drop closed ones; returns the new ones."""
        self.peers = [peer for peer in self.peers if peer.is_open]
        fresh: list[PacketChannel] = []
        while self._waiting.poll(0):
            try:
                connection, _ = self._socket.accept()
            except OSError:  # nobody waits (or gave up while waiting)
                break
            if self._single:
                for peer in self.peers:
                    peer.close()
                self.peers.clear()
                fresh.clear()
            elif len(self.peers) >= self._max_peers:
                connection.close()
                continue
            channel = PacketChannel(connection, str(self._path))
            self.peers.append(channel)
            fresh.append(channel)
        return fresh

    def close(self) -> None:
        """Close all peers and remove the socket file. Idempotent."""
        for peer in self.peers:
            peer.close()
        self.peers.clear()
        self._socket.close()
        self._path.unlink(missing_ok=True)


def _readable(one: socket.socket) -> select.poll:
    """Poll object that reports in half a microsecond whether a call would succeed; a failing call takes up to fifty."""
    waiting = select.poll()
    waiting.register(one, select.POLLIN)
    return waiting


# -- the sender's side ---------------------------------------------------------------------------------------
# The sender's side of a channel to a process that may die, hang or be restarted: messages are numbered and
# kept, the receiver acknowledges them up to a number (`ipc_messages.Received`), and later ones are sent.
#
# Acceptance by the socket is not enough: messages that its reader leaves unread are lost. So a new connection continues
# after the acknowledged messages, not after those sent over the old connection.


class Outbox:
    """A sender's last ``capacity`` messages, encoded; their numbers ascend."""

    def __init__(self, capacity: int) -> None:
        self._kept: deque[tuple[int, bytes]] = deque(maxlen=capacity)
        self._sent = 0

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def full(self) -> bool:
        """Whether the next message replaces the oldest."""
        return len(self._kept) == self._kept.maxlen

    def add(self, number: int, data: bytes) -> None:
        """Store a message; the oldest is dropped if the outbox is full."""
        self._kept.append((number, data))

    def resume(self, number: int) -> None:
        """Continue over a new connection: the receiver has the messages up to ``number``, later ones are sent."""
        self._sent = number

    def release(self, number: int) -> None:
        """Delete the acknowledged messages, up to ``number``."""
        while self._kept and self._kept[0][0] <= number:
            self._kept.popleft()

    def flush(self, channel: PacketChannel) -> None:
        """Send the unsent messages, as far as the channel accepts them."""
        if not self._kept or self._kept[-1][0] <= self._sent:
            return
        for number, data in self._kept:
            if number > self._sent:
                if not channel.send(data):
                    return
                self._sent = number
