"""The safety stage in plain sentences, one joint and one rule at a time: what `safety_stage` computes in kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


class Expected(NamedTuple):
    """The command, whether the stage brakes, and reasons: code, level, subject, value, threshold, words of the hint."""

    limited: list[float]
    braking: bool
    reasons: list[tuple]


def finite(value):
    """The value, or None."""
    return value if math.isfinite(value) else None


def trusted(age, limit):
    """An age is a number that is neither of the future nor beyond its limit."""
    return math.isfinite(age) and age >= 0.0 and age <= limit


def stopping_speed(distance, acceleration, period):
    """The positive root of v²/(2a) + v·t − d."""
    if not distance > 0.0:
        return 0.0
    return float(max(np.roots([0.5 / acceleration, period, -distance]).real))


def box_sides(limits, box, joint):
    """Sides of a box at which a joint can stay outside: (+1, where it is below the box), (-1, above)."""
    low, high = limits.keep_outs[box, joint]
    sides = []
    if math.isfinite(low):
        sides.append((+1, low - limits.position_margin))
    if math.isfinite(high):
        sides.append((-1, high + limits.position_margin))
    return sides


def caps(inputs, limits, before, age):
    """For each joint the largest speed up and down, as ((speed, who), (speed, who)); None where unknown."""
    n = len(before)
    found = []
    extremes = []
    for j in range(n):
        q, a = inputs.positions[j], limits.acceleration_max[j]
        if not math.isfinite(q):
            extremes.append(None)
            found.append({+1: (math.inf, None), -1: (math.inf, None)})
            continue
        reach = {s: q + s * max(0.0, s * before[j] * age + 0.5 * a * age**2) for s in (+1, -1)}
        extremes.append(reach)
        bounds = {
            +1: limits.position_max[j] - limits.position_margin,
            -1: limits.position_min[j] + limits.position_margin,
        }
        found.append({s: (stopping_speed(s * (bounds[s] - reach[s]), a, inputs.dt_s), "limit") for s in (+1, -1)})
    for k in range(len(limits.keep_out_names)):
        ways = []
        for j in range(n):
            if extremes[j] is None:
                continue
            for s, bound in box_sides(limits, k, j):
                room = s * (bound - extremes[j][s])
                toward = max(0.0, s * before[j])
                braking = toward**2 / (2.0 * limits.acceleration_max[j])
                ways.append(((room - braking) / limits.velocity_max[j], j, s, room))
        if ways:
            _, j, s, room = max(ways, key=lambda way: way[0])
            speed = stopping_speed(room, limits.acceleration_max[j], inputs.dt_s)
            if speed < found[j][s][0]:
                found[j][s] = (speed, k)
    return found


def expected(inputs, limits):
    """What the stage must answer."""
    names, n = limits.joint_names, len(limits.joint_names)
    reasons = []
    brake = inputs.brake
    if not trusted(inputs.joint_age_s, limits.joint_timeout_s):
        brake = True
        reasons.append(("JOINTS_STALE", "hold", "", finite(inputs.joint_age_s), limits.joint_timeout_s, "bus"))
    if inputs.needs_features and not trusted(inputs.feature_age_s, limits.features_fresh_s):
        coasts = trusted(inputs.feature_age_s, limits.coast_s)
        brake = brake or not coasts
        told = ("COASTING", "info") if coasts else ("FEATURES_STALE", "hold")
        word = "prediction" if coasts else "clear the view"
        reasons.append((*told, "", finite(inputs.feature_age_s), limits.coast_s, word))
    for j in range(n):
        for what, value in (("command", inputs.raw[j]), ("measured position", inputs.positions[j])):
            if not math.isfinite(value):
                brake = True
                reasons.append(("NON_FINITE_COMMAND", "hold", names[j], None, None, f"{what} of joint {names[j]}"))

    before = [v if math.isfinite(v) else 0.0 for v in inputs.previous]
    over = max([1.0, *(abs(v) / m for v, m in zip(before, limits.velocity_max, strict=True))])
    before = [v / over for v in before]
    age = inputs.joint_age_s if trusted(inputs.joint_age_s, limits.joint_timeout_s) else limits.joint_timeout_s
    cap = caps(inputs, limits, before, age)

    def bounded(j, velocity):
        """A joint's velocity under its caps, and who set the cap that acts."""
        for s in (+1, -1):
            speed, who = cap[j][s]
            if s * velocity > speed:
                return s * speed, who
        return velocity, None

    factor = min(max(inputs.speed_scale, 0.0), 1.0) if math.isfinite(inputs.speed_scale) else 0.0
    wanted = [0.0] * n if brake else [float(v) for v in inputs.raw]
    scale, slowest = 1.0, None
    for j in range(n):
        top = limits.velocity_max[j] * factor
        toward = +1 if wanted[j] > 0.0 else -1
        if cap[j][toward][0] > top and abs(wanted[j]) * scale > top:
            scale, slowest = top / abs(wanted[j]), j
    actors = [None] * n
    for j in range(n):
        wanted[j], actors[j] = bounded(j, wanted[j] * scale)

    steps = [a * inputs.dt_s for a in limits.acceleration_max]
    shares = [steps[j] / abs(wanted[j] - before[j]) if wanted[j] != before[j] else math.inf for j in range(n)]
    share = min(1.0, *shares)
    limited = [w if share == 1.0 else b + share * (w - b) for w, b in zip(wanted, before, strict=True)]
    for j in range(n):
        for s in (+1, -1):
            speed, who = cap[j][s]
            if s * limited[j] > speed:
                limited[j] = s * min(s * limited[j], max(speed, s * before[j] - steps[j]))
                actors[j] = who
                break

    if brake:
        j = int(np.argmax(np.abs(limited)))
        reasons.append(
            ("BRAKING", "hold", names[j], abs(limited[j]), 0.0, "asked for" if inputs.brake else "beside it")
        )
    for j in range(n):
        who = actors[j]
        if who is None:
            continue
        drive = inputs.raw[j] if math.isfinite(inputs.raw[j]) and inputs.raw[j] != 0.0 else inputs.previous[j]
        up = drive > 0.0
        margin, way = limits.position_margin, f"jog {names[j]} {'down' if up else 'up'}"
        if who == "limit":
            bound = limits.position_max[j] - margin if up else limits.position_min[j] + margin
            reasons.append(("JOINT_LIMIT", "slow", names[j], inputs.positions[j], bound, way))
        else:
            low, high = limits.keep_outs[who, j]
            bound = low - margin if up else high + margin
            way = f"keep-out {limits.keep_out_names[who]!r}: {way}"
            reasons.append(("KEEP_OUT", "slow", names[j], inputs.positions[j], bound, way))
    if slowest is not None and scale < 1.0 - 1e-9:
        top = limits.velocity_max[slowest] * factor
        reasons.append(("VELOCITY_SCALED", "slow", names[slowest], abs(inputs.raw[slowest]), top, "slower"))
    if not brake and share < 1.0 - 1e-9:
        j = int(np.argmin(shares))
        a = limits.acceleration_max[j]
        reasons.append(("ACCELERATION_LIMITED", "info", names[j], a / share if share > 0.0 else None, a, "passes"))
    return Expected(limited, brake, reasons)
