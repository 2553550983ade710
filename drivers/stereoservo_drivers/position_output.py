"""Position set-points from joint velocities, for drives that accept only positions."""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray

LEAD_S = 0.1
"""Time at the largest velocity by which a set-point may be ahead, if the cell file does not state it."""
LOAD_OFFSET = {"revolute": 0.06, "prismatic": 0.005}
"""[rad, m] Largest offset of a drive from its set-point under load, if the cell file does not state it."""
LEARNS_S = 0.2
"""Time constant of the estimate of the offset under load, from a joint at rest [s]."""
STANDS_SHARE = 0.02
"""Share of the largest velocity below which a joint counts as at rest."""
LEARNT_SHARE = 0.1
"""Share of the lead: an offset with a smaller uncertainty counts as learnt."""
LETS_GO_SHARE = 0.25
"""Share of the largest velocity at which a set-point returns from an obstacle that blocked its joint."""
GIVES_WAY_SHARE, GIVES_WAY_AFTER = 0.8, 0.3
"""Share of a returning set-point's travel, evaluated after a share of the lead: a joint that follows it this far
carries a load, and is not blocked. An obstacle, even a soft one, takes part of the travel.
"""
_NEARLY = 1.0 - 1e-9


class PositionOutput:
    """Position set-points, ``orders``, of a group of joints (n,) [rad or m].

    A set-point is the integral of the commanded velocities, at most ``lead`` (n,) ahead of the joint's position,
    including the offset under load: without new set-points a joint moves no further than this. The joint's motion never
    moves its set-point, so that a joint that gives way under load is held. The offset, by which a stiff drive deviates
    from its set-point under load, is estimated while the joint rests, up to ``largest_offset`` (n,). A joint whose
    set-point has reached the lead counts as blocked once it rests or is commanded back: its set-point then returns to
    the joint's position, with the previous offset. A joint that gives way meanwhile carries an unknown load: it is held
    until that is known. ``largest_velocities`` (n,), ``period_s``: of the set-points.
    """

    def __init__(
        self, lead: FloatArray, largest_offset: FloatArray, largest_velocities: FloatArray, period_s: float
    ) -> None:
        self._lead = lead
        self._largest_offset = largest_offset
        self._standing = STANDS_SHARE * largest_velocities
        self._period_s = period_s
        self.orders = np.full(len(lead), np.nan)
        self.offsets = np.zeros(len(lead))
        self._carried = np.zeros(len(lead))
        self._slow = np.full(len(lead), np.nan)
        self._last = np.full(len(lead), np.nan)
        self._load = np.full(len(lead), np.nan)
        self._pressed = np.zeros(len(lead))
        self._rested_s = np.zeros(len(lead))
        self._lets_go = np.zeros(len(lead))
        self._way_back = np.zeros(len(lead))
        self._stood_at = np.zeros(len(lead))
        self._heavy = np.zeros(len(lead), dtype=bool)
        self._back = LETS_GO_SHARE * largest_velocities * period_s

    def follow(self, positions: FloatArray, held: BoolArray) -> FloatArray:
        """Set-points of joints at ``positions`` (n,) without a commanded motion: their positions; joints that are
        ``held`` (n,) keep their set-points.
        """
        free = ~held | np.isnan(self.orders)
        self.orders = np.where(free, positions, self.orders)
        self.offsets = np.where(free, 0.0, self.offsets)
        self._slow = np.where(free, positions, self._slow)
        self._load = np.where(free, np.nan, self._load)
        self._pressed = np.where(free, 0.0, self._pressed)
        self._lets_go = np.where(free, 0.0, self._lets_go)
        self._heavy &= ~free
        self._last = positions.copy()
        return self.orders

    def step(self, velocities: FloatArray, positions: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
        """Set-points after one period at ``velocities`` (n,), of joints at ``positions`` (n,).

        ``low``, ``high`` (n,): limits; the set-point of a joint beyond one moves no further outward.
        """
        if np.isnan(self.orders).any():
            self.follow(positions, ~np.isnan(self.orders))
        moves = np.abs(positions - self._slow) >= self._standing * LEARNS_S
        standing = ~moves & (np.abs(positions - self._last) < self._standing * self._period_s)
        self._slow = self._slow + self._period_s / LEARNS_S * (positions - self._slow)
        self._last = positions.copy()
        pushes = (velocities != 0.0) | (self._pressed != 0.0) | (self._lets_go != 0.0)
        self._learn_offsets(positions, standing, pushes & ~moves)
        self._release(velocities, positions, standing, moves)
        level = positions + self.offsets
        ahead = np.where(velocities > 0.0, np.maximum(self.orders, level + self._lead), np.inf)
        behind = np.where(velocities < 0.0, np.minimum(self.orders, level - self._lead), -np.inf)
        ceiling = np.where(positions <= high, high + self.offsets, np.maximum(self.orders, high))
        floor = np.where(positions >= low, low + self.offsets, np.minimum(self.orders, low))
        wanted = self.orders + velocities * self._period_s
        self.orders = np.clip(wanted, np.maximum(behind, floor), np.minimum(ahead, ceiling))
        return self.orders

    def _learn_offsets(self, positions: FloatArray, standing: BoolArray, pushes: BoolArray) -> None:
        """Update the offsets of joints at rest. An obstacle that a joint ``pushes`` (n,) also bears its load: the
        offset is then limited to ``largest_offset`` from the previous one, and so is the joint's motion when it is
        freed.
        """
        error = np.where(standing, self.orders - positions - self.offsets, 0.0)
        learnt = self.offsets + self._period_s / LEARNS_S * error
        self._carried = np.where(pushes, self._carried, self.offsets)
        low = np.maximum(self._carried, 0.0) - self._largest_offset
        high = np.minimum(self._carried, 0.0) + self._largest_offset
        self.offsets = np.where(pushes, np.clip(learnt, low, high), learnt)
        self.offsets = np.clip(self.offsets, -self._largest_offset, self._largest_offset)

    def _release(self, velocities: FloatArray, positions: FloatArray, standing: BoolArray, moves: BoolArray) -> None:
        """Release obstacles: the offset of a pressing joint from its set-point is not a load.

        Not before its load is known: a joint that sinks under a new load would be released, too.
        """
        sign = np.sign(velocities)
        turned = self._pressed * sign < 0.0
        begins = (turned | ((self._pressed != 0.0) & (sign == 0.0) & standing)) & ~self._heavy
        self._lets_go = np.where(begins, self._pressed, self._lets_go * (self._lets_go * sign <= 0.0))
        self._way_back = np.where(begins, 0.0, self._way_back)
        self._stood_at = np.where(begins, positions, self._stood_at + velocities * self._period_s)
        self._let_go(positions)
        stands_off = self.orders - positions
        presses = (stands_off - self._load) * sign >= self._lead * _NEARLY
        self._pressed = np.where(sign == 0.0, self._pressed * ~begins, sign * presses)
        learnt = np.abs(stands_off - self.offsets) < LEARNT_SHARE * self._lead
        still = (sign == 0.0) & (self._pressed == 0.0) & (self._lets_go == 0.0)
        rests = ~moves & still & learnt
        # A fluctuating reading hides a joint at rest in many steps.
        self._rested_s = np.where(rests, self._rested_s + self._period_s * standing, 0.0)
        rested = self._rested_s >= LEARNS_S
        self._heavy &= ~rested
        moves = moves & ~np.isnan(self._load)
        self._load = np.where(moves, self.offsets, np.where(rested, stands_off, self._load))

    def _let_go(self, positions: FloatArray) -> None:
        """One step of the returning set-points: to the joint's position, or until it is found to carry a load."""
        left = (self.orders - positions - self._load) * self._lets_go
        step = np.where(self._lets_go != 0.0, np.clip(left, 0.0, self._back), 0.0)
        self.orders = self.orders - self._lets_go * step
        self._way_back = self._way_back + step
        along = (self._stood_at - positions) * self._lets_go
        judged = (self._lets_go != 0.0) & (self._way_back >= GIVES_WAY_AFTER * self._lead)
        self._heavy |= judged & (along >= GIVES_WAY_SHARE * self._way_back)
        ends = (self._lets_go != 0.0) & ~self._heavy & (left <= self._back)
        load = np.clip(self._load, -self._largest_offset, self._largest_offset)
        self.offsets = np.where(ends, load, self.offsets)
        self._lets_go = np.where(ends | self._heavy, 0.0, self._lets_go)
