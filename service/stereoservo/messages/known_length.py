"""A measured length of arm, markers or cameras: it determines the scale of a metric model."""

from __future__ import annotations

import math
from typing import Literal, get_args

import msgspec

What = Literal["a", "d", "prismatic", "markers", "baseline"]
FORMS = (
    "markers:10,11=0.05 (two ids), baseline:left,right=0.2 (two cameras), prismatic:j1=1, a:j2=0.4, d:j3=0.1 (a joint)"
)


class KnownLength(msgspec.Struct, frozen=True):
    """The known length that determines the scale of a metric model: ``metres`` of a quantity named by ``what`` and
    ``of``.

    ``a`` or ``d`` of a joint's row after Denavit and Hartenberg, ``prismatic`` (one unit of that joint), ``markers``
    (two ids), ``baseline`` (two cameras' names).
    """

    what: What
    of: tuple[str | int, ...]
    metres: float


def known_length_of(text: str) -> KnownLength:
    """The known length stated by ``text`` as ``WHAT:OF=METRES``. Raises ValueError with the valid forms."""
    what, _, rest = text.partition(":")
    of, _, number = rest.rpartition("=")
    names = of.split(",")
    try:
        metres = float(number)
    except ValueError:
        metres = math.nan
    count = 2 if what in ("markers", "baseline") else 1
    if (
        what not in get_args(What)
        or not 0.0 < metres < math.inf
        or len(set(names)) != count
        or len(names) != count
        or not all(names)
        or (what == "markers" and not all(name.isdecimal() for name in names))
    ):
        raise ValueError(f"{text!r} is no known length; WHAT:OF=METRES is valid: {FORMS}")
    return KnownLength(what, tuple(int(n) for n in names) if what == "markers" else tuple(names), metres)  # type: ignore[arg-type]
