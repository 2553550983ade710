"""Poses of a tool as positions of six virtual joints: three prismatic, three revolute.

An arm commanded by Cartesian velocities is, for everything above the driver, an arm of six joints whose product of
exponentials is exact: ``T = Tx(x) Ty(y) Tz(z) A Rx(c) Ry(b) Rz(a)``, base from tool, the tool's point at (x, y, z) in
the base frame, ``A`` an attitude, the zero of the angles. They are singular at b = ±90°; the tool's own z, about which
tools turn farthest, is the last axis and unlimited.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverError, JointSpec

NAMES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
STEEPEST = float(np.radians(80.0))
"""Largest tilt b [rad]: beyond it the axes of the other two turns are nearly parallel."""


class VirtualLimits(NamedTuple):
    """Limits of the virtual joints: the box of the tool's point ``low`` to ``high`` (3,) [m]; ``turns`` (3,) [rad] to
    either side of the attitude; ``velocities``, ``accelerations``: of slides [m/s, m/s²] and turns [rad/s, rad/s²].
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    turns: tuple[float, float, float]
    velocities: tuple[float, float]
    accelerations: tuple[float, float]

    def joints(self) -> tuple[JointSpec, ...]:
        """The six joints. Raises DriverError (``option``) for an empty box, or turns that reach the singularity."""
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise DriverError(
                "option", f"the tool's box {self.low} to {self.high} [m] is empty; low below high is valid"
            )
        if not self.turns[1] < STEEPEST:
            raise DriverError(
                "option",
                f"turn_y of {self.turns[1]:g} rad to either side; below {STEEPEST:.3f} is valid (80°: the angles are "
                "singular at 90°; set the attitude so that the tool's work lies around it)",
            )
        speed, acceleration = self.velocities, self.accelerations
        slides = zip(NAMES[:3], self.low, self.high, strict=True)
        turns = zip(NAMES[3:], self.turns, strict=True)
        return (
            *(JointSpec(name, "prismatic", low, high, speed[0], acceleration[0]) for name, low, high in slides),
            *(JointSpec(name, "revolute", -turn, turn, speed[1], acceleration[1]) for name, turn in turns),
        )


def turn(vector: FloatArray) -> FloatArray:
    """Rotation (3, 3) of a rotation vector (3,) [rad]: its axis times its angle."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = np.asarray(vector, dtype=np.float64) / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: FloatArray = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    return rotation


def positions_of(pose: FloatArray, attitude: FloatArray, near: FloatArray) -> FloatArray:
    """Virtual joints (6,) of a pose (4, 4); of turns that differ by full turns, those nearest to ``near`` (6,).

    ``attitude`` (3, 3): A. Raises DriverError (``attitude``) beyond `STEEPEST`.
    """
    R = attitude.T @ pose[:3, :3]
    b = float(np.arctan2(R[0, 2], np.hypot(R[1, 2], R[2, 2])))
    if abs(b) > STEEPEST:
        raise DriverError(
            "attitude",
            f"the tool is tilted by {np.degrees(b):.0f}° about its y from the attitude that is set, at most "
            f"{np.degrees(STEEPEST):.0f}° is allowed (its angles are singular at 90°): turn it back at the robot's own "
            "panel, or set the attitude to the middle of the tool's work",
            tilt_rad=b,
        )
    angles = np.array([np.arctan2(-R[1, 2], R[2, 2]), b, np.arctan2(-R[0, 1], R[0, 0])])
    turns = 2.0 * np.pi
    return np.concatenate([pose[:3, 3], angles + turns * np.round((near[3:] - angles) / turns)])


def turning_axes(positions: FloatArray, attitude: FloatArray) -> FloatArray:
    """Axes of the three turns at ``positions`` (6,), in the base frame, as columns (3, 3)."""
    sc, cc = np.sin(positions[3]), np.cos(positions[3])
    sb, cb = np.sin(positions[4]), np.cos(positions[4])
    axes: FloatArray = attitude @ np.array([[1.0, 0.0, sb], [0.0, cc, -sc * cb], [0.0, sc, cc * cb]])
    return axes


def twist_of(positions: FloatArray, velocities: FloatArray, attitude: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocity (3,) [m/s] of the tool's point and turn rate (3,) [rad/s], in the base frame, of virtual ``velocities``
    (6,).
    """
    return velocities[:3].copy(), turning_axes(positions, attitude) @ velocities[3:]


def velocities_of(positions: FloatArray, v: FloatArray, w: FloatArray, attitude: FloatArray) -> FloatArray:
    """Virtual velocities (6,) of a twist, the inverse of `twist_of`."""
    return np.concatenate([v, np.linalg.solve(turning_axes(positions, attitude), w)])
