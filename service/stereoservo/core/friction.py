"""Friction that a velocity drive does not overcome: small commands leave such a joint where it stands, and the law's
error with it.

A bounded integral action for each joint. While a joint that is sent more than its encoder's step does not move, the
velocity that its source wants is integrated on top; once it moves, the sum decays. So a joint that follows exactly has
none, play and sag wind nothing up (the encoder of a motor that turns through play does move), and lag does not either.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import FrictionCompensation
from stereoservo.numerics.arrays import FloatArray

RISE_S = 0.25
"""Time in which the wanted velocity adds itself once."""
DECAY_S = 1.5
"""Time constant of a joint that moves: it stops again where it had needed the sum, and gains it back."""
LAG_S = 0.06
"""By which a healthy drive may lag before its joint counts as standing."""
MOST = {"revolute": 0.015, "prismatic": 0.0015}
"""[rad/s, m/s] Half as much again as the friction of a healthy joint; see `monitor.FRICTION`."""
SMALL = 2.0
"""Times ``MOST``, from which on a command overcomes friction by itself."""
STANDS = {"revolute": 1e-4, "prismatic": 1e-5}
"""[rad, m] by which a reading may change while its joint stands, where its step is no coarser."""


@lru_cache(maxsize=8)
def _bounds(kinds: tuple[str, ...], resolution: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """The largest compensation (n,) [rad/s or m/s], and the change of a reading (n,) from which on its joint moves."""
    most, stands = (np.array([value[kind] for kind in kinds]) for value in (MOST, STANDS))
    if resolution:
        stands = np.maximum(stands, 1.5 * np.array(resolution))
    most.setflags(write=False)
    stands.setflags(write=False)
    return most, stands


def compensate_friction(output: SourceOutput, subject: str, context: StepContext) -> SourceOutput:
    """The output of the source that works on ``subject``, with what friction takes from each joint on top.

    It begins anew with another subject, is zero for a joint that is not to move, and rests while the features that the
    source needs are not fresh, and without a new joint sample.
    """
    state, settings = context.state, context.settings
    if not subject:
        state.friction = None
        return output
    known = state.friction
    if known is None or known.subject != subject:
        nothing = np.zeros_like(context.q)
        known = state.friction = FrictionCompensation(subject, nothing, context.q.copy(), nothing.copy())
    if context.ingested.joints is None:
        known.sent = known.sent + state.command * context.dt_s
    else:
        _account(known, output, context, settings)
    wanted = output.velocity
    if not known.velocity.any():
        return output
    return replace(output, velocity=np.where(wanted == 0.0, 0.0, wanted + known.velocity))


def _account(
    known: FrictionCompensation, output: SourceOutput, context: StepContext, settings: CoreSettings
) -> None:
    most, stands = _bounds(settings.joint_kinds, settings.resolution)
    command, wanted = context.state.command, output.velocity
    moved = np.abs(context.q - known.stood_at) > stands
    known.sent = np.where(moved, 0.0, known.sent + command * context.dt_s)
    known.stood_at = np.where(moved, context.q, known.stood_at)
    if not _fresh(output, context):
        return
    stuck = np.abs(known.sent) > 2.0 * stands + LAG_S * np.abs(command)
    rise = np.where(np.abs(wanted) < SMALL * most, wanted / RISE_S, 0.0)
    change = np.where(stuck, rise, -known.velocity / DECAY_S)
    known.velocity = np.clip(known.velocity + change * context.dt_s, -most, most)


def _fresh(output: SourceOutput, context: StepContext) -> bool:
    if not output.needs_features:
        return True
    newest_ns = max([estimate.accepted_ns for estimate in context.state.cameras], default=0)
    return (context.now_ns - newest_ns) * 1e-9 <= context.derived.features_fresh_s
