"""Times in orders."""

from __future__ import annotations

import re

from stereoservo_sim.emulation.errors import OrderError

LONGEST_S = 1_000_000
_TIME_UNITS = {"us": 1e3, "ms": 1e6, "s": 1e9}
_NUMBER = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(us|ms|s)")


def duration_ns(word: str) -> int:
    """A time such as ``6ms`` [ns]; 0 needs no unit. Raises OrderError."""
    if word == "0":
        return 0
    match = _NUMBER.fullmatch(word)
    if match is None:
        raise OrderError(f"time {word!r}; a number with us, ms or s is valid, e.g. 6ms")
    time_ns = float(match[1]) * _TIME_UNITS[match[2]]
    if time_ns > LONGEST_S * 1e9:
        raise OrderError(f"time {word!r}; up to {LONGEST_S} s is valid")
    return round(time_ns)
