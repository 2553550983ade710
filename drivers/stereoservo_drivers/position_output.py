"""Positions to order from joint velocities, for drives that take positions only."""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray

LEARNS_S = 0.2
"""Time constant in which the offset under load follows what a standing joint shows."""
STANDS_SHARE = 0.02
"""Of the largest velocity: below it a joint counts as standing."""


class PositionOutput:
    """Ordered positions of a group of joints (n,) [rad or m].

    An order is the integral of the commanded velocities, and is led no farther than ``lead`` (n,) ahead of where the
    joint stands, offset under load included: a joint whose orders end goes no further than this. The joint never drags
    its order along, so that one that gives way under load is held. The offset, by which a stiff drive stays behind its
    order under load, is learnt while the joint stands, up to ``largest_offset`` (n,). ``largest_velocities`` (n,),
    ``period_s``: of the orders.
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
        self._slow = np.full(len(lead), np.nan)
        self._last = np.full(len(lead), np.nan)

    def follow(self, positions: FloatArray, held: BoolArray) -> FloatArray:
        """Orders of joints at ``positions`` (n,) that are commanded nowhere: they stand where they are; those that are
        ``held`` (n,) keep the order that they have.
        """
        free = ~held | np.isnan(self.orders)
        self.orders = np.where(free, positions, self.orders)
        self.offsets = np.where(free, 0.0, self.offsets)
        self._slow = np.where(free, positions, self._slow)
        self._last = positions.copy()
        return self.orders

    def step(
        self, velocities: FloatArray, positions: FloatArray, low: FloatArray, high: FloatArray
    ) -> FloatArray:
        """Orders after one period at ``velocities`` (n,), of joints at ``positions`` (n,).

        ``low``, ``high`` (n,): limits; a joint beyond one is led no further outward.
        """
        if np.isnan(self.orders).any():
            self.follow(positions, ~np.isnan(self.orders))
        self._learn_offsets(positions)
        level = positions + self.offsets
        ahead = np.where(velocities > 0.0, np.maximum(self.orders, level + self._lead), np.inf)
        behind = np.where(velocities < 0.0, np.minimum(self.orders, level - self._lead), -np.inf)
        ceiling = np.where(positions <= high, high + self.offsets, np.maximum(self.orders, high))
        floor = np.where(positions >= low, low + self.offsets, np.minimum(self.orders, low))
        wanted = self.orders + velocities * self._period_s
        self.orders = np.clip(wanted, np.maximum(behind, floor), np.minimum(ahead, ceiling))
        return self.orders

    def _learn_offsets(self, positions: FloatArray) -> None:
        share = self._period_s / LEARNS_S
        fastest = np.maximum(
            np.abs(positions - self._last) / self._period_s, np.abs(positions - self._slow) / LEARNS_S
        )
        self._last = positions.copy()
        self._slow = self._slow + share * (positions - self._slow)
        error = np.where(fastest < self._standing, self.orders - positions - self.offsets, 0.0)
        self.offsets = np.clip(self.offsets + share * error, -self._largest_offset, self._largest_offset)
