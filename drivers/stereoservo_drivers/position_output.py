"""Positions to order from joint velocities, for drives that take positions only."""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray

LEAD_S = 0.1
"""Time at the largest velocity that an ordered position may be ahead, where the cell file says nothing."""
LOAD_OFFSET = {"revolute": 0.06, "prismatic": 0.005}
"""[rad, m] By which a drive may stand off its ordered position under load, where the cell file says nothing."""
LEARNS_S = 0.2
"""Time constant in which the offset under load follows what a standing joint shows."""
STANDS_SHARE = 0.02
"""Of the largest velocity: below it a joint counts as standing."""
LEARNT_SHARE = 0.1
"""Of the lead: an offset that is known so well counts as learnt."""
LETS_GO_SHARE = 0.25
"""Of the largest velocity: as fast an order goes back from what blocked its joint."""
GIVES_WAY_SHARE, GIVES_WAY_AFTER = 0.8, 0.3
"""Of the way of an order that goes back: a joint that goes along so far carries a load, and nothing blocks it; judged
after so much of the lead. What blocks a joint, be it soft, takes part of the way.
"""
_NEARLY = 1.0 - 1e-9


class PositionOutput:
    """Ordered positions of a group of joints (n,) [rad or m].

    An order is the integral of the commanded velocities, and is led no farther than ``lead`` (n,) ahead of where the
    joint stands, offset under load included: a joint whose orders end goes no further than this. The joint never drags
    its order along, so that one that gives way under load is held. The offset, by which a stiff drive stays behind its
    order under load, is learnt while the joint stands, up to ``largest_offset`` (n,). A joint whose order has reached
    the lead is taken for blocked once it stands or is commanded back: its order then goes back to where it stands, with
    the offset of before. One that gives way meanwhile carries more than was known: it is held, until its load is.
    ``largest_velocities`` (n,), ``period_s``: of the orders.
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
        """Orders of joints at ``positions`` (n,) that are commanded nowhere: they stand where they are; those that are
        ``held`` (n,) keep the order that they have.
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
        """Orders after one period at ``velocities`` (n,), of joints at ``positions`` (n,).

        ``low``, ``high`` (n,): limits; a joint beyond one is led no further outward.
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
        """Of joints that stand. What blocks one that ``pushes`` (n,) bears its load, too: its offset is then no farther
        than ``largest_offset`` from the one that it carried, so that it goes no farther than that when it is freed.
        """
        error = np.where(standing, self.orders - positions - self.offsets, 0.0)
        learnt = self.offsets + self._period_s / LEARNS_S * error
        self._carried = np.where(pushes, self._carried, self.offsets)
        low = np.maximum(self._carried, 0.0) - self._largest_offset
        high = np.minimum(self._carried, 0.0) + self._largest_offset
        self.offsets = np.where(pushes, np.clip(learnt, low, high), learnt)
        self.offsets = np.clip(self.offsets, -self._largest_offset, self._largest_offset)

    def _release(self, velocities: FloatArray, positions: FloatArray, standing: BoolArray, moves: BoolArray) -> None:
        """Let go of what blocks a joint: what a joint that presses stands off its order is no load.

        Not before its load is known: one that sinks under a new load would be let go, too.
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
        # A reading that flickers hides a standing joint in many a step.
        self._rested_s = np.where(rests, self._rested_s + self._period_s * standing, 0.0)
        rested = self._rested_s >= LEARNS_S
        self._heavy &= ~rested
        moves = moves & ~np.isnan(self._load)
        self._load = np.where(moves, self.offsets, np.where(rested, stands_off, self._load))

    def _let_go(self, positions: FloatArray) -> None:
        """One step back of the orders that let go: to where the joint stands, or until it is seen to carry a load."""
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
