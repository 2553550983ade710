"""The sender's side of a channel between processes whose other end may die, hang or start anew: messages are numbered
and kept, the receiver says up to which number it has them (`ipc_messages.Received`), and what comes after is sent.

That a socket took a message says nothing: what its reader leaves unread is gone with it. So a new connection goes on
after what the receiver has, not after what was sent over the old one.
"""

from __future__ import annotations

from collections import deque

from stereoservo.daemon.channels.seqpacket import PacketChannel


class Outbox:
    """A sender's last ``capacity`` messages, encoded; their numbers ascend."""

    def __init__(self, capacity: int) -> None:
        self._kept: deque[tuple[int, bytes]] = deque(maxlen=capacity)
        self._sent = 0

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def full(self) -> bool:
        """Whether the next message takes the place of the oldest."""
        return len(self._kept) == self._kept.maxlen

    def add(self, number: int, data: bytes) -> None:
        """Keep a message; the oldest is dropped where there is no room."""
        self._kept.append((number, data))

    def resume(self, number: int) -> None:
        """Over a new connection: the receiver has the messages up to ``number``, those after it are sent (again)."""
        self._sent = number

    def release(self, number: int) -> None:
        """Keep no longer what the receiver has: the messages up to ``number``."""
        while self._kept and self._kept[0][0] <= number:
            self._kept.popleft()

    def flush(self, channel: PacketChannel) -> None:
        """Send what was not sent yet, as far as the channel takes it."""
        if not self._kept or self._kept[-1][0] <= self._sent:
            return
        for number, data in self._kept:
            if number > self._sent:
                if not channel.send(data):
                    return
                self._sent = number
