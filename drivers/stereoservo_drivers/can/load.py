"""Bus load: length of CAN frames in bits, and the share of a bus that a cycle uses (ISO 11898-1, classical frames, with
the intermission of 3 bits after each).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import msgspec

from stereoservo_drivers.can.frames import CanFrame

CRC_POLYNOMIAL = 0x4599
"""x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1, without its highest term."""
TAIL = 13
"""CRC delimiter, acknowledge slot and delimiter, 7 bits end of frame, 3 bits intermission: none of them is stuffed."""
STANDARD_HEAD = 34
"""Stuffable bits besides the data: start, 11 bits id, remote, IDE, reserved, length, CRC."""
EXTENDED_HEAD = 54


def crc15(bits: int, count: int) -> int:
    """Checksum of the ``count`` lowest of ``bits``, the highest sent first."""
    table, crc = _crc_table(), 0
    # Leading zeros change nothing: the register starts with zero.
    for byte in bits.to_bytes((count + 7) // 8, "big"):
        crc = (crc << 8 & 0x7FFF) ^ table[crc >> 7 ^ byte]
    return crc


def stuffable_bits(frame: CanFrame) -> tuple[int, int]:
    """The bits of ``frame`` that are stuffed, from start of frame to CRC: (bits, count), the highest sent first."""
    length = frame.length if frame.remote else len(frame.data)
    if frame.extended:
        head = frame.id >> 18 << 27 | 0b11 << 25 | (frame.id & 0x3FFFF) << 7 | frame.remote << 6 | length
        count = 39
    else:
        head, count = frame.id << 7 | frame.remote << 6 | length, 19
    bits = head << 8 * len(frame.data) | int.from_bytes(frame.data, "big")
    count += 8 * len(frame.data)
    return bits << 15 | crc15(bits, count), count + 15


def frame_bits(frame: CanFrame) -> int:
    """Exact length of ``frame`` on the wire [bits], stuffing and intermission included."""
    bits, count = stuffable_bits(frame)
    tables = _stuffing_tables()
    whole = count // 8
    state, stuffed = _START, 0
    for k in range(count - 1, 8 * whole - 1, -1):
        inserted, state = _step(state, bits >> k & 1)
        stuffed += inserted
    for byte in (bits & (1 << 8 * whole) - 1).to_bytes(whole, "big"):
        inserted, state = tables[state][byte]
        stuffed += inserted
    return count + stuffed + TAIL


def worst_bits(length: int, *, extended: bool = False) -> int:
    """Maximum length of a frame with ``length`` data bytes [bits]: a stuff bit after the first five and then after
    every four. A remote frame has no data bytes.
    """
    stuffable = (EXTENDED_HEAD if extended else STANDARD_HEAD) + 8 * length
    return stuffable + (stuffable - 1) // 4 + TAIL


class BusLoad(msgspec.Struct, frozen=True):
    """Worst-case load of a bus. ``cycle_bits``: of all frames of one cycle; ``background``: other traffic [bits/s]."""

    cycle_bits: int
    rate_hz: float
    bitrate: int
    background: float = 0.0

    @property
    def share(self) -> float:
        """Load as a share of the bus's capacity; above 1 it is impossible."""
        return (self.cycle_bits * self.rate_hz + self.background) / self.bitrate

    def rate_at(self, share: float) -> float:
        """Cycle rate [Hz] at a load of ``share``; 0 if the background alone exceeds it."""
        return max(share * self.bitrate - self.background, 0.0) / self.cycle_bits

    @property
    def max_rate_hz(self) -> float:
        """Highest possible cycle rate [Hz]."""
        return self.rate_at(1.0)


def cycle_load(
    lengths: Sequence[int], rate_hz: float, bitrate: int, background: Sequence[tuple[int, float]] = ()
) -> BusLoad:
    """Worst-case load of cycles of standard frames.

    ``lengths``: data bytes of every frame of a cycle, SYNC (0) included. ``background``: (data bytes, frames/s) of
    heartbeats and the like.
    """
    beside = sum(worst_bits(length) * per_second for length, per_second in background)
    return BusLoad(sum(worst_bits(length) for length in lengths), rate_hz, bitrate, beside)


def refusal(load: BusLoad, max_share: float) -> str | None:
    """Text on why ``load`` exceeds ``max_share`` of the bus, and what would fit; None if it does not."""
    if load.share <= max_share:
        return None
    fitting = math.floor(load.rate_at(max_share))
    remedy = f"rate_hz up to {fitting} fits" if fitting >= 1 else "no cycle rate fits beside the heartbeats"
    return (
        f"worst-case bus load {load.share:.1%}, max_bus_load {max_share:.1%}: cycles of {load.cycle_bits} bits at "
        f"{load.rate_hz:g} Hz and {load.background:.0f} bit/s of heartbeats on {load.bitrate} bit/s (this bus carries "
        f"{load.max_rate_hz:.0f} Hz at most). {remedy}; less feedback per joint or a higher bitrate leave more room"
    )


@cache
def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = (crc << 1 & 0x7FFF) ^ (CRC_POLYNOMIAL if crc & 0x4000 else 0)
        table.append(crc)
    return tuple(table)


# State of the stuffing: 5 * last bit + number of equal bits at the end - 1 (so 0 to 4; never 5: the stuff bit is
# included), _START before the first bit.
_START = 10


def _step(state: int, bit: int) -> tuple[int, int]:
    """Stuff bits inserted after ``bit`` (0 or 1), and the new state."""
    run = state % 5 + 2 if state < _START and state // 5 == bit else 1
    if run < 5:
        return 0, 5 * bit + run - 1
    return 1, 5 * (1 - bit)


@cache
def _stuffing_tables() -> tuple[tuple[tuple[int, int], ...], ...]:
    """Table by state and next byte: inserted stuff bits, and the state after the byte."""
    return tuple(tuple(_eight_steps(state, byte) for byte in range(256)) for state in range(_START + 1))


def _eight_steps(state: int, byte: int) -> tuple[int, int]:
    stuffed = 0
    for k in range(7, -1, -1):
        inserted, state = _step(state, byte >> k & 1)
        stuffed += inserted
    return stuffed, state
