"""By how much the shutters of each camera open later than stamped, from markers that move: a latency that nobody stated
shows along the velocities of the markers, in proportion to them.

It is estimated against the joints' stamps in every frame that moves, taken into account as soon as it is known, and
followed from then on; `monitor_state.CameraTiming` holds the sums.
"""

from __future__ import annotations

import math

from stereoservo.core.monitor_state import CameraTiming
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel

TIMING_SIGMA_S = 0.003
"""Uncertainty of a shutter stamp against the joint stamps."""
UNKNOWN_TIMING_S = 0.1
"""Before motion has shown it: what a camera's latency may be off by."""
MODEL_SIGMA_PX = 0.3  # what a good model may be off by at any pose
FORGETTING_S = 30.0
"""Time constant, in seconds of seen motion, with which old frames are forgotten."""
MOVING_PX_S = 20.0
"""Mean pixel speed below which a frame says nothing of time."""
PLAY_PX = 2.0
"""Standard deviation of what may lag behind the motion whatever its speed: play shows so, and is no latency."""
KNOWN_S = 0.002
"""Standard deviation at which an offset is known."""
LEAST_OFFSET_S = 0.001
"""That is taken into account."""
MOST_OFFSET_S = 0.25


def fold_timing(
    timing: CameraTiming, innovations: FloatArray, velocities: FloatArray, variances: FloatArray, t_ns: int
) -> None:
    """Take in a frame: ``innovations`` [px] and ``velocities`` [px/s] (k, 2), ``variances`` (k,) [px²] a coordinate.

    The markers of a frame share what the model is off by: they count as one sight, not as k. An offset that is known
    and worth it is moved to ``late_ns``.
    """
    k = variances.shape[0]
    sums = _timing_sums(innovations, velocities, variances)
    if k == 0 or sums[0] < MOVING_PX_S * k:
        return
    elapsed_s = min((t_ns - timing.seen_ns) * 1e-9, 0.2) if timing.seen_ns else 0.0
    keep = math.exp(-elapsed_s / FORGETTING_S)
    timing.product = keep * timing.product + sums[1] / k
    timing.square = keep * timing.square + sums[2] / k
    timing.lag = keep * timing.lag + sums[3] / k
    timing.speed = keep * timing.speed + sums[4] / k
    timing.frames = keep * timing.frames + sums[5] / k
    timing.seen_ns = t_ns
    late, deviation = offset_s(timing)
    if deviation < KNOWN_S and abs(late) > max(LEAST_OFFSET_S, 4.0 * deviation):
        _take_offset(timing, late)


def offset_s(timing: CameraTiming) -> tuple[float, float]:
    """How much later than by ``late_ns`` the shutter opens [s], and its standard deviation; (0, inf) before any motion.

    From two regressors, time and a lag of constant size, which only motion of various speeds can tell apart.
    """
    frames = timing.frames + 1.0 / (PLAY_PX * PLAY_PX)
    information = timing.square - timing.speed * timing.speed / frames
    if not information > 0.0:
        return 0.0, math.inf
    return (timing.product - timing.speed * timing.lag / frames) / information, 1.0 / math.sqrt(information)


def _take_offset(timing: CameraTiming, late_s: float) -> None:
    """Count the sums from an offset that is later by ``late_s``, within ``MOST_OFFSET_S``."""
    most = round(1e9 * MOST_OFFSET_S)
    late_ns = min(max(timing.late_ns + round(1e9 * late_s), -most), most)
    taken_s = 1e-9 * (late_ns - timing.late_ns)
    timing.product -= taken_s * timing.square
    timing.lag -= taken_s * timing.speed
    timing.late_ns = late_ns


def timing_sigma_s(timing: CameraTiming) -> float:
    """Standard deviation of a shutter stamp against the joints' stamps, as far as motion has shown it."""
    return TIMING_SIGMA_S if offset_s(timing)[1] < KNOWN_S else UNKNOWN_TIMING_S


@kernel
def _timing_sums(
    innovations: FloatArray, velocities: FloatArray, variances: FloatArray
) -> tuple[float, float, float, float, float, float]:
    """Sums over a frame's markers: pixel speeds; weighted products of velocity with innovation and itself, of its
    direction with innovation, velocity and itself.
    """
    speed, product, square, lag, across, frames = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(variances.shape[0]):
        vu, vv = velocities[i, 0], velocities[i, 1]
        v = math.sqrt(vu * vu + vv * vv)
        speed += v
        if v == 0.0:
            continue
        weight = 1.0 / (variances[i] + MODEL_SIGMA_PX * MODEL_SIGMA_PX)
        along = vu * innovations[i, 0] + vv * innovations[i, 1]
        product += weight * along
        square += weight * v * v
        lag += weight * along / v
        across += weight * v
        frames += weight
    return speed, product, square, lag, across, frames
