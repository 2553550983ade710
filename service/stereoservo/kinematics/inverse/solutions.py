"""Results of inverse kinematics (all solutions, a continuum of them, or the distance to an unreachable goal), and the
choice of whole joint turns near a seed and within limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from stereoservo.numerics.arrays import FloatArray

Case = Literal[
    "prismatic",
    "revolute",
    "two_revolute",
    "two_parallel",
    "arm",
    "wrist",
    "arm_with_wrist",
    "gantry_with_wrist",
    "numerical",
]
Outcome = Literal["isolated", "continuum", "beyond_limits", "unreachable"]


class InverseKinematicsError(ValueError):
    """Invalid goal, seed or limits of inverse kinematics; the message states the valid values.

    Attributes:
        code: ``shape``, ``not_finite``, ``mirrored`` (no rigid motion maps the points to the targets), ``not_rigid``,
            ``degenerate`` (a goal or point on the fixed plane), ``limits``.
        data: the values in the message.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.data = data


@dataclass(frozen=True, eq=False)
class Shortfall:
    """Closest approach of an arm to an unreachable goal.

    ``joints`` (n,) of least residual among the approaches tried, ``residual`` as in `InverseSolutions`. ``joint``: the
    joint whose equation has no root, in closed form; ``excess``: the distance from a root relative to its amplitude
    (1.0: twice as far as it reaches; infinite: it has no effect). None if no single joint is the cause.
    """

    joints: FloatArray
    residual: float
    joint: int | None
    excess: float | None


@dataclass(frozen=True, eq=False)
class InverseSolutions:
    """All configurations found, nearest to the seed first.

    ``joints`` (s, n) [rad or m], each checked by forward kinematics: ``residuals`` (s,), the norm of ``H(q)M - M*``
    over that of ``M*``, points at equal heights (for a displacement the columns of H). Revolute angles are those
    nearest to the seed, by whole turns, inside the limits.

    ``outcome``: ``isolated`` solutions; ``continuum``, if the goal does not determine all joints (singular, or more
    joints than degrees of freedom), each row one representative; ``beyond_limits``: all are outside; ``unreachable``.
    ``self_motions``: for each row unit directions (k, n) along which the arm moves and the goal stays reached.
    ``beyond_limits`` (t, n): solutions outside the limits. ``shortfall`` if unreachable.
    """

    case: Case
    outcome: Outcome
    joints: FloatArray
    residuals: FloatArray
    self_motions: tuple[FloatArray, ...]
    beyond_limits: FloatArray
    shortfall: Shortfall | None = None

    @property
    def reached(self) -> bool:
        """Whether there is a solution inside the limits."""
        return len(self.joints) > 0

    @property
    def free_joints(self) -> tuple[tuple[int, ...], ...]:
        """For each solution the joints that its self-motions move."""
        return tuple(
            tuple(int(j) for j in np.flatnonzero(np.abs(motions).max(axis=0, initial=0.0) > MOVING))
            for motions in self.self_motions
        )


MOVING = 1e-4
"""Component of a self-motion's direction from which on a joint counts as moving."""
SAME = 1e-6
"""Largest difference of joints [rad or m] of two solutions that count as equal."""


def nearest_turns(kinds: tuple[str, ...], joints: FloatArray, seed: FloatArray) -> FloatArray:
    """Joints (..., n) with revolute ones within half a turn of ``seed`` (n,)."""
    revolute = np.array([kind == "revolute" for kind in kinds])
    wrapped = seed + np.mod(joints - seed + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(np.where(revolute, wrapped, joints), dtype=np.float64)


def within_limits(
    kinds: tuple[str, ...], joints: FloatArray, seed: FloatArray, limits: FloatArray | None
) -> tuple[FloatArray, bool]:
    """Joints (n,) by whole turns inside ``limits`` (n, 2), nearest to ``seed`` (n,); whether all of them are.

    A joint that cannot be inside is as near to its limits as whole turns allow.
    """
    near = nearest_turns(kinds, joints, seed)
    if limits is None:
        return near, True
    inside = True
    for j, kind in enumerate(kinds):
        low, high = limits[j] + np.array([-SAME, SAME])
        if low <= near[j] <= high:
            continue
        if kind == "revolute":
            bound = low if near[j] < low else high
            turns = (bound - near[j]) / (2.0 * np.pi)
            moved = near[j] + 2.0 * np.pi * (np.ceil(turns) if near[j] < low else np.floor(turns))
            # Past the other limit by less than the distance here: this is the nearest.
            if low <= moved <= high:
                near[j] = moved
                continue
            other = moved - 2.0 * np.pi * np.sign(moved - near[j])
            near[j] = min((moved, other), key=lambda q: max(low - q, q - high))
        inside = False
    return near, inside


def distinct(kinds: tuple[str, ...], joints: FloatArray, tolerance: float = SAME) -> list[int]:
    """Indices of the rows (s, n) that do not equal an earlier one, up to whole turns."""
    kept: list[int] = []
    for i, row in enumerate(joints):
        difference = nearest_turns(kinds, joints[kept] - row, np.zeros(len(row)))
        if not len(kept) or np.abs(difference).max(axis=1).min() > tolerance:
            kept.append(i)
    return kept
