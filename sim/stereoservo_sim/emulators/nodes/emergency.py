"""Emergency producer of an emulated node: active errors, error register, history (CiA 301, 7.2.7)."""

from __future__ import annotations

import struct
from collections import deque

from stereoservo_drivers.can.frames import CanFrame
from stereoservo_sim.emulators.nodes.dictionary import Abort, Dictionary, SdoError
from stereoservo_sim.emulators.nodes.node import NEVER_NS

REGISTER, HISTORY, COB_ID, INHIBIT = 0x1001, 0x1003, 0x1014, 0x1015
_QUEUED = 32


def register_bits(code: int) -> int:
    """Error register (0x1001) of an error code: generic, and the class given by the code's first digits."""
    top = code >> 12
    bits = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0xF: 0x80}.get(top, 0)
    if top == 0x8:
        bits = 0x10 if code >> 8 in (0x80, 0x81, 0x82) else 0x20
    return 0x01 | bits


class Emergencies:
    """Errors of one node. ``active``: codes whose cause is present or that a fault reset has not cleared."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self.active: list[int] = []
        self._queue: deque[bytes] = deque(maxlen=_QUEUED)
        self._free_ns = 0
        self._depth = max((sub for index, sub in dictionary.entries if index == HISTORY), default=0)
        dictionary.guard(HISTORY, self._check_clearing)
        dictionary.changed(HISTORY, lambda sub, value: self._forget())
        dictionary.reading(HISTORY, self._check_reading)

    def power_on(self) -> None:
        """Clear all errors."""
        self.active.clear()
        self._queue.clear()
        self._free_ns = 0

    def _check_clearing(self, sub: int, value: int) -> None:
        if value:
            raise SdoError(Abort.INVALID_VALUE)

    def _check_reading(self, sub: int) -> None:
        if sub > self._dictionary.get(HISTORY, 0):
            raise SdoError(Abort.NO_DATA)

    def _forget(self) -> None:
        for sub in range(1, self._depth + 1):
            self._dictionary.set(HISTORY, sub, 0)

    def occurred(self, code: int) -> None:
        """Add an error: register, history, and a frame."""
        if code not in self.active:
            self.active.append(code)
        count = self._dictionary.get(HISTORY, 0)
        for sub in range(min(count + 1, self._depth), 1, -1):
            self._dictionary.set(HISTORY, sub, self._dictionary.get(HISTORY, sub - 1))
        self._dictionary.set(HISTORY, 1, code)
        self._dictionary.set(HISTORY, 0, min(count + 1, self._depth))
        self._tell(code)

    def gone(self, codes: list[int]) -> None:
        """Remove errors: one frame with code 0 and the remaining register."""
        left = [code for code in self.active if code not in codes]
        if len(left) != len(self.active):
            self.active[:] = left
            self._tell(0)

    def _tell(self, code: int) -> None:
        register = 0
        for active in self.active:
            register |= register_bits(active)
        self._dictionary.set(REGISTER, 0, register)
        self._queue.append(struct.pack("<HB5x", code & 0xFFFF, register))

    def frames(self, t_ns: int) -> list[CanFrame]:
        """Frames to send now; the inhibit time (0x1015) delays the others."""
        cob_id = self._dictionary.get(COB_ID, 0, 1 << 31)
        if cob_id & 1 << 31:
            self._queue.clear()
            return []
        inhibit_ns = self._dictionary.get(INHIBIT) * 100_000
        frames = []
        while self._queue and t_ns >= self._free_ns:
            frames.append(CanFrame(id=cob_id & 0x7FF, data=self._queue.popleft()))
            self._free_ns = t_ns + inhibit_ns
        return frames

    def due_ns(self) -> int:
        """Time at which a delayed frame may be sent."""
        return self._free_ns if self._queue else NEVER_NS
