"""SDO server of an emulated node: expedited and segmented transfers (CiA 301, 7.2.4.3). Block transfer is refused."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

from stereoservo_sim.emulators.nodes.dictionary import LONGEST_STRING, Abort, Dictionary, SdoError
from stereoservo_sim.emulators.nodes.node import NEVER_NS

TIMEOUT_NS = 1_000_000_000
_TOGGLE = 0x10


@dataclass
class _Transfer:
    """A segmented transfer in progress. ``size`` announced by the client of a download, 0 where it was not."""

    index: int
    sub: int
    upload: bool
    size: int = 0
    data: bytearray = field(default_factory=bytearray)
    toggle: int = 0
    deadline_ns: int = 0


class SdoServer:
    """One server channel: a request's 8 bytes in, a reply's 8 bytes or None out."""

    def __init__(self, dictionary: Dictionary, *, timeout_ns: int = TIMEOUT_NS) -> None:
        self._dictionary = dictionary
        self._timeout_ns = timeout_ns
        self._transfer: _Transfer | None = None
        self._last = (0, 0)

    def reset(self) -> None:
        """Abandon a transfer in progress."""
        self._transfer = None

    def due_ns(self) -> int:
        """Time at which an incomplete transfer times out."""
        return NEVER_NS if self._transfer is None else self._transfer.deadline_ns

    def advance(self, t_ns: int) -> bytes | None:
        """Abort frame of a transfer that has timed out."""
        if t_ns < self.due_ns():
            return None
        return self._abort(Abort.TIMED_OUT)

    def request(self, data: bytes, t_ns: int) -> bytes | None:
        """Reply to a client's frame; None to an abort and to a frame that is no SDO request."""
        if len(data) != 8:
            return None
        command = data[0] >> 5
        if command in (1, 2):
            self._transfer = None
            self._last = struct.unpack_from("<HB", data, 1)
        if command == 4:
            self._transfer = None
            return None
        try:
            if command == 0:
                return self._download_segment(data, t_ns)
            if command == 1:
                return self._download(data, t_ns)
            if command == 2:
                return self._upload(t_ns)
            if command == 3:
                return self._upload_segment(data, t_ns)
            if command in (5, 6):
                self._last = struct.unpack_from("<HB", data, 1)
            raise SdoError(Abort.COMMAND)
        except SdoError as refused:
            return self._abort(refused.code)

    def _abort(self, code: Abort) -> bytes:
        self._transfer = None
        return struct.pack("<BHBL", 0x80, *self._last, code)

    def _download(self, data: bytes, t_ns: int) -> bytes:
        index, sub = self._last
        entry = self._dictionary.writable(index, sub)
        if data[0] & 0x02:
            size = 4 - (data[0] >> 2 & 3) if data[0] & 0x01 else min(entry.size or 4, 4)
            self._dictionary.download(index, sub, data[4 : 4 + size])
        else:
            size = int.from_bytes(data[4:8], "little") if data[0] & 0x01 else 0
            if size and entry.size and size != entry.size:
                raise SdoError(Abort.TOO_LONG if size > entry.size else Abort.TOO_SHORT)
            if size > LONGEST_STRING:
                raise SdoError(Abort.OUT_OF_MEMORY)
            self._begin(_Transfer(index, sub, upload=False, size=size), t_ns)
        return struct.pack("<BHBL", 0x60, index, sub, 0)

    def _upload(self, t_ns: int) -> bytes:
        index, sub = self._last
        value = self._dictionary.upload(index, sub)
        if 1 <= len(value) <= 4:
            return struct.pack("<BHB4s", 0x43 | (4 - len(value)) << 2, index, sub, value)
        self._begin(_Transfer(index, sub, upload=True, data=bytearray(value)), t_ns)
        return struct.pack("<BHBL", 0x41, index, sub, len(value))

    def _begin(self, transfer: _Transfer, t_ns: int) -> None:
        transfer.deadline_ns = t_ns + self._timeout_ns
        self._transfer = transfer

    def _going_on(self, data: bytes, t_ns: int, *, upload: bool) -> _Transfer:
        transfer = self._transfer
        if transfer is None or transfer.upload != upload:
            raise SdoError(Abort.COMMAND)
        if data[0] & _TOGGLE != transfer.toggle:
            raise SdoError(Abort.TOGGLE)
        transfer.toggle ^= _TOGGLE
        transfer.deadline_ns = t_ns + self._timeout_ns
        return transfer

    def _download_segment(self, data: bytes, t_ns: int) -> bytes:
        transfer = self._going_on(data, t_ns, upload=False)
        transfer.data += data[1 : 8 - (data[0] >> 1 & 7)]
        most = transfer.size or LONGEST_STRING
        if len(transfer.data) > most:
            raise SdoError(Abort.TOO_LONG if transfer.size else Abort.OUT_OF_MEMORY)
        if data[0] & 0x01:
            if transfer.size and len(transfer.data) < transfer.size:
                raise SdoError(Abort.TOO_SHORT)
            self._dictionary.download(transfer.index, transfer.sub, bytes(transfer.data))
            self._transfer = None
        return bytes([0x20 | data[0] & _TOGGLE]) + bytes(7)

    def _upload_segment(self, data: bytes, t_ns: int) -> bytes:
        transfer = self._going_on(data, t_ns, upload=True)
        segment = bytes(transfer.data[:7])
        del transfer.data[:7]
        last = not transfer.data
        if last:
            self._transfer = None
        return bytes([data[0] & _TOGGLE | (7 - len(segment)) << 1 | last]) + segment.ljust(7, b"\0")
