"""Decoding of a CAN controller's error frames into text."""

from __future__ import annotations

import can
import msgspec

BUS_OFF = "bus_off"

_CLASSES: tuple[tuple[int, str, str], ...] = (
    (0x040, BUS_OFF, "the controller has left the bus (bus-off)"),
    (0x020, "no_acknowledge", "no node acknowledges: cable, terminators, bit rate, is any drive powered?"),
    (0x008, "protocol", "a frame breaks the protocol: bit rate, terminators, cable, two nodes with one id?"),
    (0x010, "transceiver", "the transceiver reports a fault: wires short-circuited or torn?"),
    (0x001, "transmit_timeout", "the controller could not send in time"),
    (0x100, "restarted", "the controller was restarted after bus-off"),
    (0x002, "arbitration_lost", "arbitration lost"),
    (0x080, "bus_error", "bus error"),
)
"""Bits of the id of an error frame: Linux, include/uapi/linux/can/error.h."""

_CONTROLLER = 0x004
_CONTROLLER_WORDS: tuple[tuple[int, str, str], ...] = (
    (0x01, "overflow", "receive buffer overflow: frames are lost"),
    (0x02, "overflow", "transmit buffer overflow"),
    (0x10, "error_passive", "receive errors: the controller is error-passive"),
    (0x20, "error_passive", "transmit errors: the controller is error-passive"),
    (0x04, "error_warning", "receive errors have reached the warning level"),
    (0x08, "error_warning", "transmit errors have reached the warning level"),
    (0x40, "error_active", "the controller is error-active again"),
)
"""Bits of data byte 1."""


class BusError(msgspec.Struct, frozen=True):
    """An error reported by the controller or the line. ``code``: stable; ``message``: for people."""

    code: str
    message: str


def bus_error(message: can.Message) -> BusError:
    """Decode an error frame; the most severe error where it reports several."""
    number, data = message.arbitration_id, bytes(message.data)
    for bit, code, words in _CLASSES[:1]:
        if number & bit:
            return BusError(code, words)
    if number & _CONTROLLER and len(data) > 1:
        for bit, code, words in _CONTROLLER_WORDS:
            if data[1] & bit:
                return BusError(code, words + _counters(data))
    for bit, code, words in _CLASSES[1:]:
        if number & bit:
            return BusError(code, words + _counters(data))
    return BusError("bus_error", f"error frame 0x{number:X} [{data.hex(' ')}]")


def _counters(data: bytes) -> str:
    if len(data) < 8 or not (data[6] or data[7]):
        return ""
    return f" (error counters: {data[6]} transmit, {data[7]} receive)"
