"""Closed-form Euclidean inverse kinematics of the synthetic RX 90, for ground truth only."""

from __future__ import annotations

from itertools import product

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.world.synthetic import RX90_ROWS, dh_link, rotation

UPPER, FOREARM, HAND = RX90_ROWS[1][0], RX90_ROWS[3][2], RX90_ROWS[5][2]
"""Lengths [m]: shoulder to elbow, elbow to wrist, wrist to flange."""
SHOULDER = RX90_ROWS[0][2]


def inverse_kinematics(flange: FloatArray, limits: FloatArray) -> FloatArray:
    """All configurations (k, 6) [rad] within ``limits`` (6, 2) that bring the flange to (4, 4) in the base's frame.

    k is 0 out of reach. Angles a whole turn apart are configurations of their own. At a singular wrist the fourth joint
    is left at zero; above the shoulder the first is.
    """
    wrist = flange[:3, 3] - HAND * flange[:3, 2]
    found = []
    for shoulder, elbow, flip in product((0, 1), repeat=3):
        first = np.arctan2(wrist[1], wrist[0]) + np.pi * shoulder
        along = np.cos(first) * wrist[0] + np.sin(first) * wrist[1]
        # In the plane of upper arm and forearm, x out and y down.
        x, y = along, SHOULDER - wrist[2]
        sine = (x * x + y * y - UPPER**2 - FOREARM**2) / (2.0 * UPPER * FOREARM)
        if abs(sine) > 1.0:
            continue
        third = np.pi - np.arcsin(sine) if elbow else np.arcsin(sine)
        own = np.arctan2(-FOREARM * np.cos(third), UPPER + FOREARM * np.sin(third))
        second = np.arctan2(y, x) - own
        base = np.eye(4)
        for angle, row in zip((first, second, third), RX90_ROWS, strict=False):
            base = base @ rotation("z", np.degrees(angle)) @ dh_link(*row)
        R = base[:3, :3].T @ flange[:3, :3]
        found.append((first, second, third, *_wrist(R, bool(flip))))
    return _within(np.array(found).reshape(-1, 6), limits)


def _wrist(R: FloatArray, flip: bool) -> tuple[float, float, float]:
    """Wrist angles of ``R = Rz Ry Rz``."""
    fifth = float(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))
    if np.sin(fifth) < 1e-9:
        turn = np.arctan2(R[1, 0], R[1, 1])
        return 0.0, fifth, float(turn)
    sign = -1.0 if flip else 1.0
    fourth = np.arctan2(sign * R[1, 2], sign * R[0, 2])
    return float(fourth), sign * fifth, float(np.arctan2(sign * R[2, 1], -sign * R[2, 0]))


def _within(angles: FloatArray, limits: FloatArray) -> FloatArray:
    """All solutions by whole turns that lie within the limits."""
    kept = []
    for row in angles:
        choices = []
        for angle, (low, high) in zip(row, limits, strict=True):
            first = angle + 2.0 * np.pi * np.ceil((low - angle) / (2.0 * np.pi))
            choices.append(np.arange(first, high + 1e-12, 2.0 * np.pi))
        kept.extend(product(*choices))
    return np.array(kept).reshape(-1, 6)
