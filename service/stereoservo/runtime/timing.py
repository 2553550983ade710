"""How far a camera's stated shutter times are from the true ones, seen while the arm moves.

A picture taken ``δ`` [s] after its stamp shows the markers where they are then: the innovation is ``v δ`` with the
pixel velocity ``v = J q̇`` (plus what the model is off by, which motion to and fro averages out). Weighted least squares
over the frames gives ``δ`` and its standard deviation. Explicit loops: this is in the core.
"""

from __future__ import annotations

import math

import msgspec

from stereoservo.runtime.ports import FloatArray

FORGETTING_S = 30.0
"""Time constant, in seconds of seen motion, with which old frames are forgotten."""
MOVING_PX_S = 20.0
"""Mean pixel speed below which a frame says nothing of time."""
KNOWN_S = 0.002
"""Standard deviation at which the offset is told."""
WRONG_S = 0.004
"""Offset that is worth a word: at 100 px/s it moves a marker by 0.4 px."""
MODEL_PX = 0.3
"""What the model may be off by, beside the noise [px]."""


class CameraTiming(msgspec.Struct, eq=False):
    """Sums over frames of one camera: ``product`` of velocities and innovations, ``square`` of velocities, weighted."""

    product: float = 0.0
    square: float = 0.0
    seen_ns: int = 0


def fold_timing(
    timing: CameraTiming, innovations: FloatArray, velocities: FloatArray, variances: FloatArray, t_ns: int
) -> None:
    """Take in a frame: ``innovations`` [px] and ``velocities`` [px/s] (k, 2), ``variances`` (k,) [px²] a coordinate.

    The markers of a frame share what the model is off by: they count as one sight, not as k.
    """
    k = variances.shape[0]
    speed = product = square = 0.0
    for i in range(k):
        vu, vv = float(velocities[i, 0]), float(velocities[i, 1])
        speed += math.sqrt(vu * vu + vv * vv)
        weight = 1.0 / (float(variances[i]) + MODEL_PX * MODEL_PX)
        product += weight * (vu * float(innovations[i, 0]) + vv * float(innovations[i, 1]))
        square += weight * (vu * vu + vv * vv)
    if k == 0 or speed < MOVING_PX_S * k:
        return
    elapsed_s = min((t_ns - timing.seen_ns) * 1e-9, 0.2) if timing.seen_ns else 0.0
    keep = math.exp(-elapsed_s / FORGETTING_S)
    timing.product = keep * timing.product + product / k
    timing.square = keep * timing.square + square / k
    timing.seen_ns = t_ns


def offset_s(timing: CameraTiming) -> tuple[float, float]:
    """How much later than stated the shutter opens [s], and its standard deviation; (0, inf) before any motion."""
    if timing.square <= 0.0:
        return 0.0, math.inf
    return timing.product / timing.square, 1.0 / math.sqrt(timing.square)


def advice(timing: CameraTiming) -> str:
    """What is to be said of it to people; empty where the stamps are right, or nothing is known yet."""
    late, deviation = offset_s(timing)
    if deviation > KNOWN_S or abs(late) < max(WRONG_S, 4.0 * deviation):
        return ""
    way = "less" if late > 0 else "more"
    return (
        f"its shutter opens {1e3 * abs(late):.1f} ms {'later' if late > 0 else 'earlier'} than stated "
        f"(± {1e3 * deviation:.1f}): {1e3 * abs(late):.0f} ms {way} latency_s would be right"
    )
