"""Tracking of a planned path: reference pose, joints and their rates at a given time, and the advance of the plan's
time, which is slower while the body lags behind.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.plan import Plan

FOLLOWS = 0.5
"""Lag, relative to the largest tolerated one, up to which the plan advances at full pace."""


FADE_S = 0.5
"""Time before a plan's end [s] over which the weight of its joints fades out, so that only the images count at rest."""


class PlanSample(NamedTuple):
    """``displacement`` (4, 4) of the body from its pose when the plan began, its rate (4, 4) [1/s]; ``joints`` (n,) and
    their rates (n,) [rad/s or m/s].
    """

    displacement: FloatArray
    displacement_rate: FloatArray
    joints: FloatArray
    joint_rates: FloatArray


class PlannedJoints(NamedTuple):
    """Planned motion of the joints in a step: mean ``rates`` (n,) [rad/s or m/s] over it, ``error`` (n,): planned minus
    current joints at its start, and ``weight`` [0, 1].
    """

    rates: FloatArray
    error: FloatArray
    weight: float


@kernel
def _pace_at(times: FloatArray, k: int) -> float:
    """Samples per second at sample ``k``: the mean of two adjacent ones is the inverse of the time between
    (`sample_times`).
    """
    before = 0.0
    for i in range(k):
        between = 1.0 / (times[i + 1] - times[i])
        before = min(2.0 * between, max(0.0, 2.0 * between - before))
    if k < times.shape[0] - 1:
        before = min(before, 2.0 / (times[k + 1] - times[k]))
    return before


@kernel
def _rate(pace: float, values: FloatArray, k: int, i: int) -> float:
    """Rate at sample ``k`` at ``pace`` samples per second; 0 at the ends, where the plan is at rest."""
    if k == 0 or k == values.shape[0] - 1:
        return 0.0
    rate: float = 0.5 * (values[k + 1, i] - values[k - 1, i]) * pace
    return rate


@kernel
def interpolate_into(times: FloatArray, values: FloatArray, t_s: float, out: FloatArray, rates: FloatArray) -> None:
    """Values (w,) and rates (w,) at ``t_s`` of samples (K, w): cubic, with continuous rates; at rest outside."""
    K, width = values.shape
    if K == 1 or not t_s > times[0]:
        for i in range(width):
            out[i], rates[i] = values[0, i], 0.0
        return
    if t_s >= times[K - 1]:
        for i in range(width):
            out[i], rates[i] = values[K - 1, i], 0.0
        return
    low, high = 0, K - 1
    while high - low > 1:
        midpoint = (low + high) // 2
        if times[midpoint] <= t_s:
            low = midpoint
        else:
            high = midpoint
    h = times[high] - times[low]
    pace_low, pace_high = _pace_at(times, low), _pace_at(times, high)
    x = (t_s - times[low]) / h
    for i in range(width):
        a, b = values[low, i], values[high, i]
        u, v = h * _rate(pace_low, values, low, i), h * _rate(pace_high, values, high, i)
        rise = b - a
        c2, c3 = 3.0 * rise - 2.0 * u - v, u + v - 2.0 * rise
        out[i] = a + x * (u + x * (c2 + x * c3))
        rates[i] = (u + x * (2.0 * c2 + 3.0 * x * c3)) / h


def sample_plan(plan: Plan, t_s: float) -> PlanSample:
    """The plan at ``t_s`` [s]; at rest before its start and after its end. NaN counts as the start."""
    H, H_rate = np.empty(16), np.empty(16)
    n = plan.joints.shape[1]
    joints, joint_rates = np.empty(n), np.empty(n)
    interpolate_into(plan.times, plan.displacements.reshape(-1, 16), t_s, H, H_rate)
    interpolate_into(plan.times, plan.joints, t_s, joints, joint_rates)
    return PlanSample(H.reshape(4, 4), H_rate.reshape(4, 4), joints, joint_rates)


def planned_joints(plan: Plan, begin_s: float, end_s: float, dt_s: float, joints: FloatArray) -> PlannedJoints:
    """Planned joint motion of a step of ``dt_s`` in which the plan's time advances from ``begin_s`` to ``end_s``, for
    an arm at ``joints`` (n,).

    Empty, with weight 0, at the end of the plan.
    """
    left_s = float(plan.times[-1]) - begin_s
    if not left_s > 0.0:
        return PlannedJoints(np.zeros(0), np.zeros(0), 0.0)
    start, end = sample_plan(plan, begin_s).joints, sample_plan(plan, end_s).joints
    return PlannedJoints((end - start) / dt_s, start - joints, min(1.0, left_s / FADE_S))


def pace(lag: float) -> float:
    """Fraction [0, 1] of full pace at ``lag``, the lag of the body relative to the largest tolerated one.

    1 up to ``FOLLOWS``, then falling smoothly to 0 at 1; 0 for NaN.
    """
    if not lag < 1.0:
        return 0.0
    x = min(1.0, (1.0 - lag) / (1.0 - FOLLOWS))
    return x * x * (3.0 - 2.0 * x)


def advance(plan: Plan, t_s: float, dt_s: float, lag: float) -> float:
    """The plan's time ``dt_s`` later [s]: it waits for a body that lags, so that the feedforward does not run ahead of
    it.

    The rates of `sample_plan` must be scaled by the same `pace`.
    """
    end = float(plan.times[-1])
    start = t_s if math.isfinite(t_s) else 0.0
    return min(end, max(0.0, start) + max(0.0, dt_s) * pace(lag))
