"""Time-optimal scaling of a path: the fastest times that keep the joints' velocity and acceleration limits.

The pace ``x = ṡ²`` along the samples ``s`` is bounded by the velocities, its slope ``2s̈`` by the accelerations
``q' s̈ + q'' ṡ²``; both are linear in ``x``, so that a pass backwards (from which pace can the arm still stop?) and a
greedy pass forwards give the fastest (Pham and Pham, 2018). Starts and ends at rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.tracking import interpolate_into

FASTEST = 1e8
"""Largest pace [(samples/s)²]: where no joint moves, the way is over in a ten-thousandth of a second a sample."""
HALVINGS = 50
ROUNDS = 12
"""Times at most that the pace is lowered where the way between samples is faster than at them."""
LOOKS = 4
"""Places in an interval at which its rates are looked at."""
VELOCITY_EXCESS, ACCELERATION_EXCESS = 1.01, 1.25
"""Of the limits, what the cubics between samples may have; accelerations as means over an interval."""


@kernel
def _next_paces(
    slope: FloatArray, bow: FloatArray, limits: FloatArray, pace: float, ceiling: float
) -> tuple[float, float]:
    """Least and largest pace after an interval that begins with ``pace``; empty where the first is above the second."""
    least, largest = 0.0, ceiling
    for j in range(slope.shape[0]):
        if not math.isfinite(limits[j]):
            continue
        # q' (x⁺ − x)/2 + q'' x within the limit at the begin, likewise with x⁺ at the end
        for end in range(2):
            if end == 0:
                rate = slope[j] - 0.5 * bow[j]
                ahead, now = 0.5 * rate, (bow[j] - 0.5 * rate) * pace
            else:
                rate = slope[j] + 0.5 * bow[j]
                ahead, now = 0.5 * rate + bow[j], -0.5 * rate * pace
            if ahead > 0.0:
                largest = min(largest, (limits[j] - now) / ahead)
                least = max(least, (-limits[j] - now) / ahead)
            elif ahead < 0.0:
                largest = min(largest, (-limits[j] - now) / ahead)
                least = max(least, (limits[j] - now) / ahead)
            elif abs(now) > limits[j]:
                largest = -1.0
    return least, largest


@kernel
def _times_below(
    slopes: FloatArray, bows: FloatArray, highest: FloatArray, acceleration_max: FloatArray, even: bool
) -> tuple[FloatArray, FloatArray]:
    """The least times (K,) with paces at the samples not above ``highest`` (K,); and these paces (K,)."""
    K = highest.shape[0]
    times, paces = np.zeros(K), np.zeros(K)
    ceilings = highest.copy()
    if even:
        lowest = FASTEST
        for k in range(K):
            lowest = min(lowest, ceilings[k])
        for k in range(K):
            ceilings[k] = lowest
    ceilings[0] = 0.0
    ceilings[K - 1] = 0.0
    for back in range(K - 1):
        k = K - 2 - back
        least, largest = _next_paces(slopes[k], bows[k], acceleration_max, ceilings[k], ceilings[k + 1])
        if least <= largest:
            continue
        low, high = 0.0, ceilings[k]
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            least, largest = _next_paces(slopes[k], bows[k], acceleration_max, middle, ceilings[k + 1])
            if least <= largest:
                low = middle
            else:
                high = middle
        ceilings[k] = low
    pace = 0.0
    for k in range(K - 1):
        least, largest = _next_paces(slopes[k], bows[k], acceleration_max, pace, ceilings[k + 1])
        after = max(0.0, largest)
        if k == K - 2:
            after = 0.0
        both = math.sqrt(pace) + math.sqrt(after)
        if both <= 0.0:
            # from rest to rest in one interval: half the way each
            duration = 0.0
            for j in range(slopes.shape[1]):
                if math.isfinite(acceleration_max[j]):
                    duration = max(duration, 2.0 * math.sqrt(abs(slopes[k, j]) / acceleration_max[j]))
            times[k + 1] = times[k] + max(duration, 1.0 / math.sqrt(FASTEST))
        else:
            times[k + 1] = times[k] + 2.0 / both
        pace = after
        paces[k + 1] = pace
    return times, paces


@kernel
def _excess(
    times: FloatArray, joints: FloatArray, velocity_max: FloatArray, acceleration_max: FloatArray, k: int
) -> float:
    """By how much the pace in interval ``k`` has to come down; at most 1 where it need not."""
    n = joints.shape[1]
    q, rates, first = np.empty(n), np.empty(n), np.empty(n)
    duration = times[k + 1] - times[k]
    found = 1.0
    for look in range(LOOKS + 1):
        # the last look is at the end, where the next interval's first one sees the same rates
        interpolate_into(times, joints, times[k] + duration * look / LOOKS, q, rates)
        for j in range(n):
            speed = abs(rates[j])
            if speed > VELOCITY_EXCESS * velocity_max[j] and velocity_max[j] > 0.0:
                found = max(found, (speed / velocity_max[j]) ** 2)
            if look == 0:
                first[j] = rates[j]
            elif look == LOOKS:
                change = abs(rates[j] - first[j]) / duration
                if change > ACCELERATION_EXCESS * acceleration_max[j] and acceleration_max[j] > 0.0:
                    found = max(found, change / acceleration_max[j])
    return found


class JointPace(NamedTuple):
    """How fast joints may go: ``velocity_max`` (n,) [rad/s or m/s], ``acceleration_max`` (n,) [rad/s² or m/s²], and
    whether samples follow each other at an ``even`` pace.
    """

    velocity_max: FloatArray
    acceleration_max: FloatArray
    even: bool


@kernel
def sample_times(
    joints: FloatArray, velocity_max: FloatArray, acceleration_max: FloatArray, even: bool
) -> FloatArray:
    """Times (K,) [s] from 0 of the samples ``joints`` (K, n), with limits (n,), infinite where there is none.

    ``even``: the samples follow each other at one pace, as far as accelerations let them.
    """
    K, n = joints.shape
    times = np.zeros(K)
    if K < 2:
        return times
    slopes = np.empty((K - 1, n))
    for k in range(K - 1):
        for j in range(n):
            slopes[k, j] = joints[k + 1, j] - joints[k, j]
    bows = np.zeros((K - 1, n))
    for k in range(K - 1):
        for j in range(n):
            before = slopes[k, j] - slopes[k - 1, j] if k > 0 else slopes[min(k + 1, K - 2), j] - slopes[k, j]
            after = slopes[k + 1, j] - slopes[k, j] if k < K - 2 else before
            bows[k, j] = 0.5 * (before + after)
    ceilings = np.full(K, FASTEST)
    for k in range(K):
        for j in range(n):
            steepest = 0.0
            if k > 0:
                steepest = max(abs(slopes[k - 1, j]), abs(slopes[k - 1, j] + 0.5 * bows[k - 1, j]))
            if k < K - 1:
                steepest = max(steepest, abs(slopes[k, j]), abs(slopes[k, j] - 0.5 * bows[k, j]))
            if steepest > 0.0 and math.isfinite(velocity_max[j]):
                ceilings[k] = min(ceilings[k], (velocity_max[j] / steepest) ** 2)
    times, paces = _times_below(slopes, bows, ceilings, acceleration_max, even)
    for _ in range(ROUNDS):
        lowered = False
        factors = np.ones(K)
        for k in range(K - 1):
            excess = _excess(times, joints, velocity_max, acceleration_max, k)
            if excess > 1.0:
                lowered = True
                factors[k] = max(factors[k], excess)
                factors[k + 1] = max(factors[k + 1], excess)
        if not lowered:
            break
        for k in range(K):
            if factors[k] > 1.0:
                ceilings[k] = min(ceilings[k], paces[k]) / factors[k]
        times, paces = _times_below(slopes, bows, ceilings, acceleration_max, even)
    return times
