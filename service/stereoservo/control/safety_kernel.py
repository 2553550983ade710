"""Arithmetic of the safety stage in numba: explicit loops, no BLAS. The reasons are told in `safety`."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel

IntArray = npt.NDArray[np.int64]


@kernel
def stoppable_speed(distance: float, acceleration: float, dt: float) -> float:
    """Largest speed to hold for ``dt`` and still brake within ``distance``: ``v·dt + v²/2a = d``; 0 for d <=
    0.

    The discrete braking ``v, v − a·dt, …`` needs no more than that, and each of its steps is stoppable again.
    """
    if not distance > 0.0:
        return 0.0
    step = acceleration * dt
    # the root of the quadratic in the form that does not cancel for small distances
    return 2.0 * acceleration * distance / (step + math.sqrt(step * step + 2.0 * acceleration * distance))


@kernel
def _position_caps(
    ahead: FloatArray,
    behind: FloatArray,
    previous: FloatArray,
    dt: float,
    position_min: FloatArray,
    position_max: FloatArray,
    velocity_max: FloatArray,
    acceleration_max: FloatArray,
    margin: float,
    keep_outs: FloatArray,
    low: FloatArray,
    high: FloatArray,
    low_by: IntArray,
    high_by: IntArray,
) -> None:
    """Velocity caps per joint and who set them: -1 the position limit, k >= 0 keep-out box k.

    ``ahead`` and ``behind`` (n,): the joint's extreme positions, given the age of its sample; NaN caps
    nothing.
    """
    n = previous.shape[0]
    for j in range(n):
        low_by[j] = -1
        high_by[j] = -1
        low[j] = -math.inf
        high[j] = math.inf
        if math.isnan(ahead[j]) or math.isnan(behind[j]):
            continue
        high[j] = stoppable_speed(position_max[j] - margin - ahead[j], acceleration_max[j], dt)
        low[j] = -stoppable_speed(behind[j] - (position_min[j] + margin), acceleration_max[j], dt)
    for k in range(keep_outs.shape[0]):
        # The joint that keeps the arm out of the box with the most time to spare answers for it: as long as
        # one joint can always stop outside, the box is never entered.
        best = -1
        best_above = False
        best_slack = -math.inf
        for j in range(n):
            if math.isnan(ahead[j]) or math.isnan(behind[j]):
                continue
            for above in (False, True):
                if above:
                    if math.isinf(keep_outs[k, j, 1]):
                        continue
                    room = behind[j] - (keep_outs[k, j, 1] + margin)
                    speed = max(0.0, -previous[j])
                else:
                    if math.isinf(keep_outs[k, j, 0]):
                        continue
                    room = keep_outs[k, j, 0] - margin - ahead[j]
                    speed = max(0.0, previous[j])
                slack = (room - 0.5 * speed * speed / acceleration_max[j]) / velocity_max[j]
                if slack > best_slack:
                    best, best_above, best_slack = j, above, slack
        if best < 0:
            continue
        if best_above:
            cap = -stoppable_speed(
                behind[best] - (keep_outs[k, best, 1] + margin), acceleration_max[best], dt
            )
            if cap > low[best]:
                low[best] = cap
                low_by[best] = k
        else:
            cap = stoppable_speed(keep_outs[k, best, 0] - margin - ahead[best], acceleration_max[best], dt)
            if cap < high[best]:
                high[best] = cap
                high_by[best] = k


@kernel
def limit_velocity(
    raw: FloatArray,
    positions: FloatArray,
    previous: FloatArray,
    brake: bool,
    dt: float,
    sample_age: float,
    speed_scale: float,
    position_min: FloatArray,
    position_max: FloatArray,
    velocity_max: FloatArray,
    acceleration_max: FloatArray,
    margin: float,
    keep_outs: FloatArray,
) -> tuple[FloatArray, IntArray, FloatArray]:
    """The stages that act on finite numbers: braking, positions and keep-outs, velocity, acceleration.

    ``raw`` must be finite unless ``brake``. Returns the limited velocity (n,), ``acted`` (n,): 0 free, 1
    position limit, 2 + k keep-out k; and ``scales`` (4,): velocity scale, its joint, acceleration share, its
    joint.
    """
    n = raw.shape[0]
    limited = np.zeros(n)
    acted = np.zeros(n, dtype=np.int64)
    scales = np.empty(4)
    before = np.zeros(n)
    shrink = 1.0
    for j in range(n):
        if math.isfinite(previous[j]):
            before[j] = previous[j]
            if abs(before[j]) > velocity_max[j]:
                shrink = min(shrink, velocity_max[j] / abs(before[j]))
    for j in range(n):
        # a previous command that was no output of this stage: nothing may continue from beyond the limits
        before[j] *= shrink
    low, high = np.empty(n), np.empty(n)
    low_by, high_by = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    ahead, behind = np.empty(n), np.empty(n)
    for j in range(n):
        # since the sample the joint may have been faster than now, by what it can have braked
        drift = before[j] * sample_age
        faster = 0.5 * acceleration_max[j] * sample_age * sample_age
        position = positions[j] if math.isfinite(positions[j]) else math.nan
        ahead[j] = position + max(0.0, drift + faster)
        behind[j] = position + min(0.0, drift - faster)
    _position_caps(
        ahead, behind, before, dt, position_min, position_max, velocity_max, acceleration_max, margin,
        keep_outs, low, high, low_by, high_by,
    )  # fmt: skip

    for j in range(n):
        v = 0.0 if brake else raw[j]
        if v > high[j]:
            v = high[j]
            acted[j] = high_by[j] + 2
        elif v < low[j]:
            v = low[j]
            acted[j] = low_by[j] + 2
        limited[j] = v

    scale, scaled_by = 1.0, -1
    for j in range(n):
        limit = velocity_max[j] * speed_scale
        if abs(limited[j]) * scale > limit:
            scale = limit / abs(limited[j])
            scaled_by = j
    for j in range(n):
        limited[j] *= scale

    share, shared_by = 1.0, -1
    for j in range(n):
        step = abs(limited[j] - before[j])
        limit = acceleration_max[j] * dt
        if step * share > limit:
            share = limit / step
            shared_by = j
    for j in range(n):
        if share < 1.0:
            limited[j] = before[j] + share * (limited[j] - before[j])
        # The share of another joint may leave this one above its cap: then it brakes with all it has.
        step = acceleration_max[j] * dt
        if limited[j] > high[j]:
            limited[j] = min(limited[j], max(high[j], before[j] - step))
            acted[j] = high_by[j] + 2
        elif limited[j] < low[j]:
            limited[j] = max(limited[j], min(low[j], before[j] + step))
            acted[j] = low_by[j] + 2
    scales[0] = scale
    scales[1] = scaled_by
    scales[2] = share
    scales[3] = shared_by
    return limited, acted, scales
