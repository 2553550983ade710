"""One emulated axis: what drive firmware and plant say to each other, in joint units."""

from __future__ import annotations

import math
from dataclasses import dataclass

from stereoservo.runtime.ports import JointSpec


@dataclass
class Axis:
    """The firmware of a drive writes the first group, the plant the second, ordered faults the third.

    [rad, rad/s, rad/s² or m]. ``effort``: share of the rated torque, signed. ``set_position`` and ``set_velocity`` are
    the drive's own ramp, which the plant follows.
    """

    joint: JointSpec
    position: float

    powered: bool = False
    brake_closed: bool = True
    target: float = 0.0
    acceleration: float = math.inf

    velocity: float = 0.0
    effort: float = 0.0
    set_position: float = 0.0
    set_velocity: float = 0.0

    blocked: bool = False
    inverted_encoder: bool = False
    limit_switch: int = 0
    """-1, 0 or 1: the limit switch of that side is active."""

    @property
    def following_error(self) -> float:
        """Set less actual position."""
        return self.set_position - self.position
