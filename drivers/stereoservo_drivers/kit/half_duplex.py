"""A half-duplex serial bus of servos: one line, one request at a time, one answer of each addressed servo."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from stereoservo.messages.addresses import Address
from stereoservo.ports.devices import DriverError

TAKE_BYTES = 4096
LOOK_S = 0.00005


class ByteStream(Protocol):
    """Protocol of a serial line: pyserial's ``Serial`` with ``timeout=0``, or a simulated one."""

    def write(self, data: bytes, /) -> int | None:
        """Send bytes."""
        ...

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes that have arrived; empty if there are none."""
        ...

    def close(self) -> None:
        """Release the line."""
        ...


def open_serial(url: str, baudrate: int) -> ByteStream:
    """A serial port by its name or pyserial URL. Raises DriverError (``connection``)."""
    import serial  # only needed for a real port

    try:
        stream: ByteStream = serial.serial_for_url(url, baudrate=baudrate, timeout=0, write_timeout=0.1, exclusive=True)
    except (OSError, ValueError) as error:
        shown = Address(url)
        raise DriverError(
            "connection",
            f"serial port {shown!r}: {shown.hidden_in(str(error))}; is the adapter plugged in "
            "(`ls -l /dev/serial/by-id`), is this user in group dialout, does nobody else have it?",
            retry=True,
            port=str(shown),
        ) from error
    return stream


class HalfDuplexBus:
    """A bus on ``stream``; ``split`` finds one packet in the received data.

    ``split(data)`` returns the first whole packet and the number of bytes to drop, with the packet or before it; None
    if there is none yet. Adapters that echo sent data are supported.
    ``answer_s``: time limit of each servo: from the request to the first answer, and from each answer to the next.
    ``lost_after``: number of consecutive requests without all answers after which the connection counts as lost.
    """

    def __init__(
        self,
        stream: ByteStream,
        split: Callable[[bytes], tuple[bytes | None, int]],
        *,
        answer_s: float = 0.005,
        lost_after: int = 5,
    ) -> None:
        self._stream = stream
        self._split = split
        self._answer_s = answer_s
        self._lost_after = lost_after
        self.missed = 0
        """Consecutive requests without all answers."""

    def send(self, packet: bytes) -> None:
        """Send a packet without an answer. Raises DriverError (``connection_lost``)."""
        try:
            self._stream.write(packet)
        except Exception as error:  # pyserial, sockets and simulated lines raise different exceptions
            raise self._lost(f"sending: {error}") from error

    def ask(self, packet: bytes, answers: int = 1) -> list[bytes]:
        """The answers to a request, at most ``answers``; fewer if some do not arrive in time.

        Raises DriverError (``connection_lost``): the line fails, or ``lost_after`` consecutive requests had too few.
        """
        self._receive()  # late data belong to an earlier request
        self.send(packet)
        found: list[bytes] = []
        data = b""
        end = time.monotonic() + self._answer_s
        while len(found) < answers:
            arrived = self._receive()
            data += arrived
            while data:
                answer, used = self._split(data)
                if not used:
                    break
                data = data[used:]
                if answer is not None and answer != packet:  # otherwise it is the adapter's echo
                    found.append(answer)
                    end = time.monotonic() + self._answer_s
            if not arrived:
                if time.monotonic() > end:
                    break
                time.sleep(LOOK_S)
        self.missed = 0 if len(found) >= answers else self.missed + 1
        if self.missed >= self._lost_after:
            raise self._lost(
                f"{self.missed} questions in a row without all {answers} answers, the last had {len(found)}"
            )
        return found

    def close(self) -> None:
        """Release the line. Errors of a lost line are ignored."""
        with suppress(OSError):
            self._stream.close()

    def _receive(self) -> bytes:
        try:
            return self._stream.read(TAKE_BYTES)
        except Exception as error:
            raise self._lost(f"receiving: {error}") from error

    @staticmethod
    def _lost(what: str) -> DriverError:
        return DriverError(
            "connection_lost", f"servo bus: {what}; check the cable, the servos' supply and their ids", retry=True
        )
