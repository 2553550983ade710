"""CAN frames, independent of any interface library."""

from __future__ import annotations

import msgspec


class CanFrame(msgspec.Struct, frozen=True, gc=False):
    """A classical CAN data or remote frame. ``id``: 11 bits, or 29 if ``extended``; ``data`` at most 8 bytes.

    ``length``: data length code that a remote frame requests; 0 for data frames, whose length is ``len(data)``.
    """

    id: int
    data: bytes = b""
    remote: bool = False
    extended: bool = False
    length: int = 0
