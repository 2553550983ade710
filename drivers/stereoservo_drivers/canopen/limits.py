"""The last clamp before the wire: the drives' velocity limits and the machine's position limits."""

from __future__ import annotations

import numpy as np

from stereoservo.runtime.ports import FloatArray


def limit_command(
    velocities: FloatArray,
    max_velocities: FloatArray,
    positions: FloatArray,
    position_min: FloatArray,
    position_max: FloatArray,
) -> tuple[FloatArray, tuple[str, ...]]:
    """Velocities (n,) that may be sent, and why they differ (``drive_velocity_limit``, ``position_limit``).

    Beyond a velocity limit all joints are scaled alike, so that the direction of motion is kept. A joint at or
    beyond a position limit may only move inward; the others go on. Joints whose position is not known
    (NaN) do not move.
    """
    reasons: tuple[str, ...] = ()
    excess = float((np.abs(velocities) / max_velocities).max())
    if excess > 1.0:
        velocities = velocities / excess
        reasons = ("drive_velocity_limit",)
    above, below = positions > position_min, positions < position_max
    if (above & below).all():
        return velocities, reasons
    allowed = (above | (velocities >= 0.0)) & (below | (velocities <= 0.0)) & np.isfinite(positions)
    if (~allowed & (velocities != 0.0)).any():
        reasons = (*reasons, "position_limit")
    return np.where(allowed, velocities, 0.0), reasons
