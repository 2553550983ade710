"""Conversion between drive units and joint units: counts, velocity units, and counts that wrap at 32 bits."""

from __future__ import annotations

import math
from dataclasses import dataclass

from stereoservo_drivers.canopen.options import CanJoint

INT32_MIN = -(2**31)
INT32_MAX = 2**31 - 1
UINT32_MAX = 2**32 - 1


def clamp_int32(value: float) -> int:
    """``value`` rounded, within the range of a signed 32-bit integer."""
    if INT32_MIN <= value <= INT32_MAX:
        return round(value)
    return round(min(max(value, INT32_MIN), INT32_MAX))  # NaN passes this, and round refuses it


def wrap_int32(counts: int) -> int:
    """``counts`` as a signed 32-bit counter represents them."""
    return (counts - INT32_MIN & UINT32_MAX) + INT32_MIN


@dataclass(frozen=True)
class JointScale:
    """Scales of one joint: ``counts = counts_per_unit * (q + offset)``; ``velocity units = velocity_units_per_unit
    * qd``.

    ``counts_per_unit`` [counts per rad or m at the joint] and ``velocity_units_per_unit`` carry the direction's sign;
    ``offset`` [rad or m]. Accelerations are in velocity units per second (CiA 402-2, 0x6083 with the same
    notation as 0x60FF).
    """

    counts_per_unit: float
    velocity_units_per_unit: float
    offset: float = 0.0

    @classmethod
    def of(cls, joint: CanJoint) -> JointScale:
        """Scales of a joint of the cell file."""
        motor_revolutions = joint.direction * joint.gear_ratio
        if joint.kind == "revolute":
            motor_revolutions /= 2.0 * math.pi
        per_revolution = joint.velocity_units_per_rev_s or joint.counts_per_rev
        return cls(
            counts_per_unit=motor_revolutions * joint.counts_per_rev,
            velocity_units_per_unit=motor_revolutions * per_revolution,
            offset=joint.offset_rad,
        )

    @property
    def resolution(self) -> float:
        """Joint displacement of one count [rad or m]."""
        return 1.0 / abs(self.counts_per_unit)

    def position(self, counts: int) -> float:
        """Joint position [rad or m] of unwrapped ``counts``."""
        return counts / self.counts_per_unit - self.offset

    def difference(self, counts: int) -> float:
        """Joint displacement [rad or m] of a difference of counts (a following error)."""
        return counts / self.counts_per_unit

    def counts(self, position: float) -> int:
        """Nearest count of a joint position [rad or m], not wrapped."""
        return round((position + self.offset) * self.counts_per_unit)

    def velocity(self, units: int) -> float:
        """Joint velocity [rad/s or m/s] of the drive's velocity units."""
        return units / self.velocity_units_per_unit

    def velocity_units(self, velocity: float) -> int:
        """Velocity in the drive's units, clamped to 32 bits. Raises ValueError on NaN."""
        return clamp_int32(velocity * self.velocity_units_per_unit)

    def rate_units(self, rate: float) -> int:
        """A limit (largest velocity or an acceleration) as the drive's unsigned units, at least 1."""
        return min(max(round(abs(rate * self.velocity_units_per_unit)), 1), UINT32_MAX)


class Unwrapper:
    """Unwraps signed 32-bit counts of an encoder. The first sample defines the turn."""

    def __init__(self) -> None:
        self._counts: int | None = None

    def update(self, raw: int) -> int:
        """Unwrapped counts of ``raw`` (signed 32 bits): the value nearest to the last one."""
        if self._counts is None:
            self._counts = raw
        else:
            self._counts += ((raw - self._counts + 2**31) & UINT32_MAX) - 2**31
        return self._counts

    def reset(self) -> None:
        """Reset: the next sample defines the turn."""
        self._counts = None
