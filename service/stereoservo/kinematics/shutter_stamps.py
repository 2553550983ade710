"""Offsets of the cameras' shutter stamps that a model states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec

LONGEST_OFFSET_S = 1.0
"""Largest offset of shutter stamps that a model may state."""


class ShutterOffset(msgspec.Struct, frozen=True):
    """By how much later than its stamps tell the shutter of ``camera`` opens [s], and its standard deviation [s]."""

    camera: str
    offset_s: float
    deviation_s: float


def offset_faults(offsets: Sequence[ShutterOffset], cameras: Sequence[str]) -> Iterator[tuple[str, str]]:
    """What is wrong with the offsets of a model's ``cameras``, by key: they are of these, once each, and bounded."""
    for k, offset in enumerate(offsets):
        key = f"shutter_offsets[{k}]"
        if offset.camera not in cameras or any(other.camera == offset.camera for other in offsets[:k]):
            yield key, f"is of camera {offset.camera!r}; once each of {', '.join(cameras)} is valid"
        if not (abs(offset.offset_s) <= LONGEST_OFFSET_S and 0.0 <= offset.deviation_s <= LONGEST_OFFSET_S):
            yield (
                key,
                f"is {offset.offset_s} s ± {offset.deviation_s} s; up to {LONGEST_OFFSET_S:g} s is taken",
            )
