"""Times in orders."""

from __future__ import annotations

import re

from stereoservo_sim.emulation.errors import OrderError

_TIME_UNITS = {"us": 1e3, "ms": 1e6, "s": 1e9}
_NUMBER = re.compile(r"(\d+(?:\.\d*)?|\.\d+)(us|ms|s)")


def duration_ns(word: str) -> int:
    """A time such as ``6ms`` [ns]; 0 needs no unit. Raises OrderError."""
    if word == "0":
        return 0
    match = _NUMBER.fullmatch(word)
    if match is None:
        raise OrderError(f"time {word!r}; a number with us, ms or s is valid, e.g. 6ms")
    return round(float(match[1]) * _TIME_UNITS[match[2]])
