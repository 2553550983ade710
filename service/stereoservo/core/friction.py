"""What friction takes of the velocity of a source that works on a goal is added to it.

For each joint it is estimated from small commands and the travel that they have brought: an integral action for a joint
that stands, and none for one that follows. Play and sag wind nothing up, since the encoder of a motor that turns
through its play does move; for encoders behind the play see `friction_bounds`.
"""

from __future__ import annotations

import numpy as np

from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import kernel

RISE_S = 0.25
"""Time constant of the estimate; a joint that stands is sent its source's velocity once more in this time."""
LAG_S = 0.06
"""Of a healthy drive: its travel is compared over longer."""
MOST = {"revolute": 0.015, "prismatic": 0.0015}
"""[rad/s, m/s] Half as much again as the friction of a healthy joint; see `monitors.following.FRICTION`."""
SMALL = 2.0
"""Times ``MOST``, up to which a wanted velocity is small."""
LEAST_TRAVEL = {"revolute": 2e-4, "prismatic": 2e-5}
"""[rad, m] over which travel is compared, beside what lags, where encoders are fine."""
LEAST_STEPS = 5.0
"""Steps of the encoder likewise."""


def friction_bounds(
    kinds: tuple[str, ...], resolution: tuple[float, ...], inexact: bool
) -> tuple[FloatArray, FloatArray]:
    """The largest compensation (n,) [rad/s or m/s], and the least travel (n,) [rad or m] that is compared; not to be
    written to.

    Nothing is added to joints with coarse encoders where the model states errors of joint readings (``inexact``): play
    before the encoder looks like friction, and steps show too late that it is taken up; the joint would hunt.
    """
    most, travel = (np.array([value[kind] for kind in kinds]) for value in (MOST, LEAST_TRAVEL))
    if resolution:
        least = LEAST_STEPS * np.array(resolution)
        most = np.where((least > travel) & inexact, 0.0, most)
        travel = np.maximum(travel, least)
    return most, travel


@kernel
def begin_friction(block: Record, room: Record) -> None:
    """Nothing is known of friction; travel is compared from the joints as they are."""
    memory, n = block[0], block[0].joints
    memory.friction[:n] = memory.friction_sent[:n] = memory.friction_s[:n] = 0.0
    memory.friction_from[:n] = room[0].q[:n]


@kernel
def add_friction(block: Record, room: Record, looks: bool) -> bool:
    """Into ``raw`` (n,) of the ``room``, its motion's ``velocity`` (n,) with the friction on top, and whether there is
    any. Zero stays zero: nothing is added to a joint that is not to move.

    Where it ``looks``, the travel that was sent, as it arrives, once it is enough, is compared with what came of it,
    and begins again where it reverses.
    """
    memory, work = block[0], room[0]
    n, dt_s, q = memory.joints, work.dt_s, work.q[: memory.joints]
    wanted, velocity, most, travel = (
        work.velocity[:n],
        work.raw[:n],
        work.friction_most[:n],
        work.friction_travel[:n],
    )
    arrives = memory.delay_velocity[:n] if work.watches_following != 0 else memory.command[:n]
    friction, stood_at = memory.friction[:n], memory.friction_from[:n]
    sent, sent_s = memory.friction_sent[:n], memory.friction_s[:n]
    changed = False
    for j in range(wanted.size):
        velocity[j] = 0.0
        sent[j] += arrives[j] * dt_s
        sent_s[j] += dt_s
        if looks:
            valid = abs(wanted[j]) < SMALL * most[j] and wanted[j] * sent[j] >= 0.0
            enough = valid and abs(sent[j]) > travel[j] + LAG_S * abs(sent[j]) / sent_s[j]
            if enough:
                share = (q[j] - stood_at[j]) / sent[j]
                lost = max(0.0, min(1.0 - share, 1.0)) * sent[j] / sent_s[j]
                friction[j] += min(sent_s[j] / RISE_S, 1.0) * (lost - friction[j])
            if wanted[j] * friction[j] < 0.0:
                friction[j] *= 1.0 - min(dt_s / RISE_S, 1.0)
            friction[j] = max(-most[j], min(friction[j], most[j]))
            if enough or not valid:
                sent[j], sent_s[j], stood_at[j] = 0.0, 0.0, q[j]
        changed = changed or friction[j] != 0.0
        if wanted[j] != 0.0:
            velocity[j] = wanted[j] + friction[j]
    return changed
