"""Corrupted copies of a file's bytes, at random."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np


def corrupted_copies(whole: bytes, count: int, most: int) -> Iterator[bytes]:
    """``count`` copies with up to ``most`` places overwritten, cut out or repeated from elsewhere; ``count`` is the
    seed.
    """
    rng = np.random.default_rng(count)
    for k in range(count):
        data = bytearray(whole)
        for _ in range(int(rng.integers(1, most + 1))):
            at, length = int(rng.integers(len(data))), int(rng.integers(1, 40))
            match k % 3:
                case 0:
                    data[at : at + length] = rng.bytes(length)
                case 1:
                    del data[at : at + length]
                case _:
                    data[at:at] = data[int(rng.integers(len(data))) :][:length]
        yield bytes(data)
