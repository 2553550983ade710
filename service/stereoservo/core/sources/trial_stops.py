"""Where the stops of trials are: of single joints, unevenly apart, and of all joints at once, which show what single
ones cannot: sag that depends on several of them, joints that turn with others, their order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from stereoservo.numerics.arrays import FloatArray

GOLDEN = 0.6180339887498949
UNEVEN_STEP = 0.5
"""Share of a step by which stops of a single joint stand nearer at most."""
SHARE, UNEVEN = 0.55, 0.25
"""Of half the way that a joint was driven, how far it stands from the middle of that way at most; share of that by
which stops differ, so that a gear's ripple does not repeat."""
SHRUNK = (1.0, 0.75, 0.5)
"""Shares of a stop that are tried one after the other until the markers stay in view."""


def stop_offset(side: int, k: int, count: int, step: float) -> float:
    """Offset from the base [rad or m] of stop ``k`` of the ``count`` on a ``side``, 1 or -1; at its end, ``count``
    steps.

    Stops before the end stand up to half a step nearer, by the multiples of the golden ratio: where all were equally
    far apart, a gear's ripple whose period divides that distance would show at none of them.
    """
    if k == 0 or k == count:
        return side * k * step
    return side * step * (k - UNEVEN_STEP * ((k * GOLDEN + 0.25 * (1 - side)) % 1.0))


def combined_offsets(k: int, low: FloatArray, high: FloatArray) -> FloatArray:
    """Offsets (n,) from the base of stop ``k`` of all joints, which single ones were driven from ``low`` to ``high``
    (n,).

    Signs are those of the columns of a Hadamard matrix of order 8: every pair of seven joints meets equally often on
    either side.
    """
    joint = np.arange(len(low))
    signs = np.array([1.0 - 2.0 * (((k % 8) & (1 + j % 7)).bit_count() % 2) for j in joint.tolist()])
    shares = SHARE * (1.0 - UNEVEN * ((GOLDEN * (k + 1) * (joint + 1)) % 1.0))
    return np.asarray(0.5 * (low + high) + signs * shares * 0.5 * (high - low))


def in_view_at(offsets: FloatArray, in_view: Callable[[FloatArray], bool]) -> FloatArray | None:
    """``offsets`` (n,), or the largest share of them, that ``in_view`` allows; None where it allows none."""
    for share in SHRUNK:
        if in_view(share * offsets):
            return share * offsets
    return None
