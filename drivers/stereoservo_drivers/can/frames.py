"""CAN frames, and their conversion from and to python-can's messages."""

from __future__ import annotations

import can
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


# -- messages --------------------------------------------------------------------------------------------------


def to_message(frame: CanFrame) -> can.Message:
    """Convert ``frame`` to a python-can message."""
    return can.Message(
        arbitration_id=frame.id,
        data=frame.data,
        dlc=frame.length if frame.remote else len(frame.data),
        is_remote_frame=frame.remote,
        is_extended_id=frame.extended,
    )


def from_message(message: can.Message) -> CanFrame:
    """Convert a received ``message`` to a frame.

    Raises:
        ValueError: an error frame or a CAN FD frame, which are not a ``CanFrame``.
    """
    if message.is_error_frame or message.is_fd:
        kind = "an error frame" if message.is_error_frame else "a CAN FD frame"
        raise ValueError(f"{kind}, id 0x{message.arbitration_id:X}, is no classical data or remote frame")
    if message.is_remote_frame:
        return CanFrame(message.arbitration_id, b"", True, message.is_extended_id, message.dlc)
    return CanFrame(message.arbitration_id, bytes(message.data), False, message.is_extended_id)
