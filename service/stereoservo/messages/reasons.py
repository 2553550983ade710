"""The struct `Reason`, an entry of a cell's status: why the arm is slow, held or in fault, as code, value, threshold,
unit and a hint as text.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Level = Literal["info", "slow", "hold", "fault"]


class Reason(msgspec.Struct, frozen=True):
    """One entry of the status set.

    ``code`` is stable and machine-readable, e.g. ``JOINT_LIMIT``; ``subject`` names the joint, camera or marker;
    ``value`` and ``threshold`` are in ``unit``; ``hint`` is a remedy for the operator.
    """

    code: str
    level: Level
    subject: str = ""
    value: float | None = None
    threshold: float | None = None
    unit: str = ""
    hint: str = ""
