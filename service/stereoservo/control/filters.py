"""Constant-velocity Kalman filter of each marker's pixels in each camera (thesis 9.3), for set-points streamed at any
rate; and the offset between a client's clock and the daemon's.

A pixel moves as ``ẍ = white noise`` of spectral density ``q`` [px²/s³] and is measured with a standard deviation
``sigma`` [px], both axes equally and independently: with ``F = [1 T; 0 1]`` and ``Q = q [T³/3 T²/2; T²/2 T]`` over a
step T.
These are additive over any division of time, so irregular stamps need no special treatment. At a regular T the gains
converge to ``(α, β/T)`` with

    β² / (1 − α) = q T³ / sigma²,        α² = (2 − α) β − β² / 6,

the fixed point of the covariance recursion written by its entries (Kalata 1984 has the same for noise that is constant
over a step; Bar-Shalom, Li, Kirubarajan 2001, ch. 6.5). For set-points that a client streams it gives their rates; for
measured features the velocity that damping needs (`control.pd`).

State is plain arrays, functions are pure.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import Fields, kernel


class TrackSettings(msgspec.Struct, frozen=True):
    """``sigma_px`` of one observation; ``density_px2_s3``: q, of the target's acceleration.

    A target whose acceleration is about A [px/s²] for about D [s] at a time has q = A² D; the default is of 400 px/s²
    for 0.25 s.
    ``rate_px_s``: standard deviation of an unknown velocity.
    ``jump_sigmas``: an innovation beyond so many of its standard deviations is a new target.
    ``gap_s``: after such a silence a marker is no longer tracked.
    """

    sigma_px: float = 0.2
    density_px2_s3: float = 40_000.0
    rate_px_s: float = 2_000.0
    jump_sigmas: float = 8.0
    gap_s: float = 0.25

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"track: {name} is {value}; a positive finite number is needed")


class TargetTrack(msgspec.Struct, frozen=True, eq=False):
    """Filtered pixels of c cameras and m markers.

    ``positions`` (c, m, 2) [px] and ``rates`` (c, m, 2) [px/s] at ``stamps_s`` (c, m), where ``tracked`` (c, m) is 1.
    ``covariance`` (c, m, 3): of an axis: position, position with rate, rate.
    ``stamp_s``: of the newest observation, -inf before the first.
    ``ignored``: number of observations that were duplicates or came too late; ``jumps``: number of new targets.
    """

    settings: TrackSettings
    positions: FloatArray
    rates: FloatArray
    covariance: FloatArray
    stamps_s: FloatArray
    tracked: FloatArray
    stamp_s: float = -math.inf
    ignored: int = 0
    jumps: int = 0


def empty_track(cameras: int, markers: int, settings: TrackSettings | None = None) -> TargetTrack:
    """A track without observations."""
    shape = (cameras, markers)
    return TargetTrack(
        settings=settings or TrackSettings(),
        positions=np.zeros((*shape, 2)),
        rates=np.zeros((*shape, 2)),
        covariance=np.zeros((*shape, 3)),
        stamps_s=np.zeros(shape),
        tracked=np.zeros(shape),
    )


def observe(track: TargetTrack, stamp_s: float, pixels: FloatArray, required: FloatArray) -> TargetTrack:
    """The track after one more observation: ``pixels`` (c, m, 2), if finite, where ``required`` (c, m) is not 0.

    An observation that is not newer than the newest is ignored. A marker missing in the observation continues at its
    rate until ``gap_s`` after its own last one. If any marker jumps, all markers of the observation restart at rest,
    because they are on one body. Raises ValueError for a stamp that is not finite, and for other shapes than the
    track's.
    """
    if not math.isfinite(stamp_s):
        raise ValueError(f"stamp_s is {stamp_s}; a finite time is needed")
    if pixels.shape != track.positions.shape or required.shape != track.tracked.shape:
        raise ValueError(
            f"pixels {pixels.shape} and wanted {required.shape} do not fit; this track takes {track.positions.shape} "
            f"and {track.tracked.shape}"
        )
    if stamp_s <= track.stamp_s:
        return msgspec.structs.replace(track, ignored=track.ignored + 1)
    s = track.settings
    positions, rates, covariance = track.positions.copy(), track.rates.copy(), track.covariance.copy()
    stamps, tracked = track.stamps_s.copy(), track.tracked.copy()
    jumped = update_track(
        (positions, rates, covariance, stamps, tracked),
        stamp_s,
        np.ascontiguousarray(pixels, dtype=np.float64),
        np.ascontiguousarray(required, dtype=np.float64),
        (s.sigma_px, s.density_px2_s3, s.rate_px_s, s.jump_sigmas, s.gap_s),
    )
    return TargetTrack(
        s, positions, rates, covariance, stamps, tracked, stamp_s, track.ignored, track.jumps + int(jumped)
    )


def predict(track: TargetTrack, t_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (c, m, 2), rates (c, m, 2) [px/s] and tracked (c, m) at ``t_s``, in the time of the stamps.

    Later than ``gap_s`` after its last observation a marker stays at its position at that time, with rate 0: a silent
    client moves nothing.
    """
    return predict_track(track.positions, track.rates, track.stamps_s, track.tracked, t_s, track.settings.gap_s)


@kernel
def update_track(track: Fields, stamp_s: float, pixels: FloatArray, required: FloatArray, constants: Fields) -> bool:
    """Add one observation to a track's arrays; returns whether a marker jumped. See `observe`.

    ``track``: the fields of `TargetTrack` from ``positions`` to ``tracked``; ``constants``: those of `TrackSettings`.
    """
    positions, rates, covariance, stamps, tracked = track
    sigma, density, rate, jump_sigmas, gap_s = constants
    cameras, markers = tracked.shape
    noise = sigma * sigma
    jumped = False
    for c in range(cameras):
        for p in range(markers):
            dt = stamp_s - stamps[c, p]
            if tracked[c, p] > 0.0 and dt > gap_s:
                tracked[c, p] = 0.0
            if not (tracked[c, p] > 0.0 and _given(pixels, required, c, p)):
                continue
            prior = _position_variance(covariance, c, p, dt, density)
            du = pixels[c, p, 0] - positions[c, p, 0] - dt * rates[c, p, 0]
            dv = pixels[c, p, 1] - positions[c, p, 1] - dt * rates[c, p, 1]
            if du * du + dv * dv > jump_sigmas * jump_sigmas * (prior + noise):
                jumped = True
    for c in range(cameras):
        for p in range(markers):
            if not _given(pixels, required, c, p):
                continue
            if jumped or not tracked[c, p] > 0.0:
                for r in range(2):
                    positions[c, p, r] = pixels[c, p, r]
                    rates[c, p, r] = 0.0
                covariance[c, p, 0] = noise
                covariance[c, p, 1] = 0.0
                covariance[c, p, 2] = rate * rate
            else:
                dt = stamp_s - stamps[c, p]
                prior = _position_variance(covariance, c, p, dt, density)
                mixed = covariance[c, p, 1] + dt * covariance[c, p, 2] + 0.5 * density * dt * dt
                speed = covariance[c, p, 2] + density * dt
                first, second = prior / (prior + noise), mixed / (prior + noise)
                for r in range(2):
                    ahead = positions[c, p, r] + dt * rates[c, p, r]
                    innovation = pixels[c, p, r] - ahead
                    positions[c, p, r] = ahead + first * innovation
                    rates[c, p, r] += second * innovation
                covariance[c, p, 0] = first * noise
                covariance[c, p, 1] = second * noise
                covariance[c, p, 2] = speed - second * mixed
            stamps[c, p] = stamp_s
            tracked[c, p] = 1.0
    return jumped


@kernel
def _given(pixels: FloatArray, required: FloatArray, c: int, p: int) -> bool:
    good: bool = required[c, p] > 0.0 and math.isfinite(pixels[c, p, 0]) and math.isfinite(pixels[c, p, 1])
    return good


@kernel
def _position_variance(covariance: FloatArray, c: int, p: int, dt: float, density: float) -> float:
    variance: float = (
        covariance[c, p, 0] + dt * (2.0 * covariance[c, p, 1] + dt * covariance[c, p, 2]) + density * dt * dt * dt / 3.0
    )
    return variance


@kernel
def predict_track(
    positions: FloatArray,
    rates: FloatArray,
    stamps: FloatArray,
    tracked: FloatArray,
    t_s: float,
    gap_s: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`predict` on a track's arrays."""
    cameras, markers = tracked.shape
    pixels, speeds = positions.copy(), np.zeros((cameras, markers, 2))
    for c in range(cameras):
        for p in range(markers):
            if not tracked[c, p] > 0.0:
                continue
            dt = t_s - stamps[c, p]
            held = max(-gap_s, min(gap_s, dt))
            for r in range(2):
                pixels[c, p, r] += held * rates[c, p, r]
                if dt == held:
                    speeds[c, p, r] = rates[c, p, r]
    return pixels, speeds, tracked.copy()


class ClientClock(msgspec.Struct, frozen=True):
    """Offset between a client's stamps and their times of arrival: ``offset_s`` = arrival minus stamp, of the fastest
    message.

    ``drift`` [s/s]: rate at which later, slower messages may increase it, so that drifting clocks are followed.
    """

    offset_s: float | None = None
    arrival_s: float = 0.0
    drift: float = 1e-3


def arrived(clock: ClientClock, stamp_s: float, arrival_s: float) -> ClientClock:
    """The clock after a message: ``predict(track, now_s − offset_s)`` is then evaluated in the client's time.

    The smallest transmission delay remains in the offset: it cannot be measured from one side.
    """
    offset = arrival_s - stamp_s
    if clock.offset_s is not None:
        risen = clock.offset_s + clock.drift * max(0.0, arrival_s - clock.arrival_s)
        offset = min(offset, risen)
    return msgspec.structs.replace(clock, offset_s=offset, arrival_s=arrival_s)
