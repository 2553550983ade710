"""Errors of the joint readings, as part of a model: random, repeatable, and dependent on posture."""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray

POSTURE_LENGTH = 1.0
"""Correlation length of posture-dependent errors in joint space [rad, m]."""


class JointAccuracy(msgspec.Struct, frozen=True, eq=False):
    """Standard deviations (n,) of the errors of joint readings, true minus reported [rad or m], as estimated from the
    trials.

    ``random``: changes from stop to stop. ``repeatable``: the same at equal readings of the joint (gear ripple, play
    driven from one side). ``stated``: both together at a reading that is not in the trials; larger than their root sum
    of squares by the uncertainty of the estimates. ``posture``: errors that change slowly with the posture of the whole
    arm (sag, coupled joints).
    """

    random: FloatArray
    repeatable: FloatArray
    stated: FloatArray
    posture: FloatArray

    def in_order(self, order: IntArray) -> JointAccuracy:
        """The same errors with the joints in another order (n,)."""
        return JointAccuracy(self.random[order], self.repeatable[order], self.stated[order], self.posture[order])

    def deviations(self, offsets: FloatArray) -> FloatArray:
        """Standard deviations (s, n) of the readings at positions ``offsets`` (s, n) from the model's zero."""
        alike = posture_correlation(offsets, np.zeros((1, offsets.shape[1])))
        return np.asarray(np.sqrt(self.stated**2 + self.posture**2 * (1.0 - alike**2)))


def posture_correlation(one: FloatArray, other: FloatArray) -> FloatArray:
    """Correlation (s, t) of posture-dependent errors at positions (s, n) and (t, n): squared exponential (Rasmussen,
    Williams, 2006, 4.2).
    """
    squares = ((one[:, None] - other[None]) ** 2).sum(axis=2)
    return np.asarray(np.exp(-0.5 * squares / POSTURE_LENGTH**2))
