"""Other joints at the same goal: another posture of the arm, another winding of a joint. Kernels.

From seeds spread over the joints' ranges the arm is taken to the goal by `following.reach`; no closed form is needed,
and no posture is missed that a seed lies near.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel
from stereoservo.trajectory.following import ARRIVED, ITERATIONS, move_arm, reach

SEEDS = 32
ROUNDS = 5
"""Calls of `reach` from one seed at most."""
TURN = 2.0 * math.pi
_PRIMES = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53)


def seed_joints(nth: int, joints: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Joints (n,) number ``nth`` of a sequence that fills the ranges evenly; number 0: where the arm stands.

    A range without an end goes half a turn, or one length of the frame, beyond the present position.
    """
    if nth == 0:
        return joints.copy()
    low = np.where(np.isfinite(lower), np.maximum(lower, joints - TURN), joints - 0.5 * TURN)
    high = np.where(np.isfinite(upper), np.minimum(upper, joints + TURN), joints + 0.5 * TURN)
    shares = np.array([math.sqrt(_PRIMES[j % len(_PRIMES)]) * nth % 1.0 for j in range(len(joints))])
    seed: FloatArray = low + shares * (high - low)
    return seed


@kernel
def joints_from_seed(
    seed: FloatArray,
    goal: FloatArray,
    body: FloatArray,
    composition: int,
    lower: FloatArray,
    upper: FloatArray,
    turns: FloatArray,
    operators: FloatArray,
    joints: FloatArray,
) -> tuple[FloatArray, bool]:
    """Joints (n,) that bring the ``body`` (m, 3) to the ``goal`` (m, 3), sought from ``seed`` (n,); whether they do.

    ``operators`` (n, 4, 4) at ``joints`` (n,), where the body is now. Joints that turn (``turns`` (n,), 1 or 0) are
    wound into their limits, near to where they are now.
    """
    n = joints.shape[0]
    at = joints.copy()
    now = operators.copy()
    displacement = np.zeros((4, 4))
    for i in range(4):
        displacement[i, i] = 1.0
    move_arm(now, composition, seed - joints, at, displacement)
    left = math.inf
    for _ in range(ROUNDS):
        left = reach(
            goal, body, composition, False, lower, upper, now, at, displacement, np.zeros(n), ITERATIONS
        )
        if left <= ARRIVED:
            break
    for j in range(n):
        if turns[j] > 0.0 and math.isfinite(at[j]):
            at[j] -= TURN * math.floor((at[j] - joints[j]) / TURN + 0.5)
            if at[j] > upper[j]:
                at[j] -= TURN
            elif at[j] < lower[j]:
                at[j] += TURN
    return at, left <= ARRIVED
