"""Does every joint go where it is sent? Sums up what was commanded and not done."""

from __future__ import annotations

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.state import CoreState

MEMORY_S = 1.0  # after which a missing travel is forgotten: drives have gain errors of per cents
LAG_S = 0.15  # a healthy drive lags by less than this at full speed


def watch(state: CoreState, settings: CoreSettings, q: FloatArray, dt_s: float) -> Reason | None:
    """Account for one step; the reason where a joint (worst first) does not follow.

    ``state.command`` is still that of the last step. A joint's missing travel is its commanded minus its measured one,
    forgotten over ``MEMORY_S``; it may reach ``LAG_S`` at full speed. Without a new joint sample nothing is concluded:
    stale samples are the safety stage's affair.
    """
    state.untold_travel = state.untold_travel + state.command * dt_s
    if state.last_joints_ns == state.last_followed_ns:
        return None
    state.last_followed_ns = state.last_joints_ns
    last = q if state.last_positions is None else state.last_positions
    keep = max(0.0, 1.0 - dt_s / MEMORY_S)
    state.missing_travel = keep * (state.missing_travel + state.untold_travel - (q - last))
    state.untold_travel[:] = 0.0
    state.last_positions = q.copy()
    allowed = LAG_S * settings.limits.velocity_max
    joint = int((np.abs(state.missing_travel) / allowed).argmax())
    missing, limit = float(state.missing_travel[joint]), float(allowed[joint])
    if abs(missing) <= limit:
        return None
    name = settings.joint_names[joint]
    unit = "rad" if settings.joint_kinds[joint] == "revolute" else "m"
    state.missing_travel[:] = 0.0
    return Reason(
        "JOINT_NOT_FOLLOWING", "fault", name, abs(missing), limit, unit,
        f"joint {name} lacks {missing:+.3f} {unit} of the travel it was sent (up to {limit:.3f} is lag): "
        "check its encoder, brake and drive; then reset and enable",
    )  # fmt: skip
