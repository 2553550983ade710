"""Monitor of a camera's image stream: numbers frames, counts missing and repeated ones."""

from __future__ import annotations

import cv2

from stereoservo.numerics.arrays import ImageArray


class Watch:
    """Numbers the frames of one camera, counts missing ones, withholds repeated images. Persists over reconnections.

    ``row``: number of consecutive pictures equal to the last one delivered.
    """

    def __init__(self, rate_hz: float) -> None:
        self.frames = 0
        self.dropped = 0
        self.frozen = 0
        self.row = 0
        self.number = -1
        self._rate_hz = rate_hz
        self._last: ImageArray | None = None
        self._last_seq: int | None = None
        self._last_ns: int | None = None
        self._late = 0

    def begin(self) -> None:
        """Handle the reopening of the source: numbering and grid restart, the last image is kept."""
        self.row = 0
        self._last_seq = None
        self._last_ns = None
        self._late = 0

    def see(self, image: ImageArray, t_received_ns: int, seq: int | None, skipped: int, *, look: bool) -> bool:
        """Count an image and set its :attr:`number`; False: it must be withheld.

        ``seq``: the source's number, None if it has none: missing frames are then determined by the time since the
        last.
        ``skipped``: pictures received before it that were not processed. ``look``: whether equal ones are frozen.
        """
        if seq is not None and seq == self._last_seq:
            self.frozen += 1
            self.row += 1
            return False
        missing = self._missing(t_received_ns, seq, skipped)
        self.frames += 1 + skipped
        self.dropped += missing
        self.number += 1 + skipped + max(0, missing)
        self._last_seq, self._last_ns = seq, t_received_ns
        if not look:
            return True
        if self._last is not None and _equal(image, self._last):
            self.frozen += 1
            self.row += 1
            return False
        self._last = image
        self.row = 0
        return True

    def _missing(self, t_received_ns: int, seq: int | None, skipped: int) -> int:
        """Number of frames missing just before this one; -1: one that was counted as missing was only late."""
        if seq is not None and self._last_seq is not None:
            return max(0, seq - self._last_seq - 1 - skipped)  # a lower number: the source has restarted
        if seq is not None or self._last_ns is None:
            return 0
        missing = round((t_received_ns - self._last_ns) * 1e-9 * self._rate_hz) - 1 - skipped
        if missing < 0:
            missing = -1 if self._late else 0
        self._late = max(0, self._late + missing) if missing else 0
        return missing


def _equal(one: ImageArray, other: ImageArray) -> bool:
    return one.shape == other.shape and cv2.norm(one, other, cv2.NORM_INF) == 0.0
