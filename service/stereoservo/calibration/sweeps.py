"""Trial data from sweeps: frames taken while joints move are reduced to means at a few positions along each sweep.

On a leg, a straight line in joint space, a marker's track in an image is a smooth function of the joint position at the
shutter. A polynomial describes its curvature; the frames of an interval are averaged about the polynomial, so that a
mean has the noise of as many frames at rest. All cameras are reduced at the same positions, whatever their stamps.

The delay of a camera's stamps against the joints' follows from the same tracks without a model: with a delay, markers
are displaced in proportion to the joint's velocity; with play, by a constant that changes its sign with the direction.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from stereoservo.calibration.trial_data import finite_rows
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

FEWEST_TERMS, MOST_TERMS, MORE_TERMS = 3, 24, 2
"""Range of the number of a track's polynomial terms that the data show, and how many more are used: what is left out
would be an error that all markers share.
"""
LEAST_FREEDOM = 3
"""Least degrees of freedom that are left beside them."""
FEWEST_FRAMES = 12
"""Least number of a camera's frames on a leg that is reduced, and of those of a joint from which delays are estimated.
"""
FAR_SIGMAS = 6.0
"""Residual of an observation, in robust deviations of its track, above which it is a wrong detection."""
LINE = 0.5, 0.95
"""Fractions of a leg's time at which it is on its line: it begins before the one before has ended."""
LEAST_MOTION = 2e-3
"""Motion of a joint [rad or m] on a leg from which its play is taken up."""
STRAIGHT = 1e-3
"""Largest deviation of a joint from a leg's line, as a fraction of half the leg, in a frame that is used."""
ROUNDS = 12
LONGEST_DELAY_S = 0.3
CONVERGED = 1e-6
SIGNIFICANT = 6.0
"""Play, in its standard deviations, from which it is taken into account."""
STILL, MOST_OTHERS = 1e-6, 3
"""Motion of other joints [rad or m, rms] that is taken into account, and most directions of it."""
DELAY_TERMS = 10
"""Most polynomial terms of a joint's tracks, there and back, beside the delay."""


class Leg(msgspec.Struct, frozen=True, eq=False):
    """Observations on one leg, from ``start_s`` to ``end_s``. ``trial``: the joint that moves alone, -1 if several do.

    Joint samples, before and after the leg as well: ``joint_times`` (j,) [s], ``positions`` (j, n), read in steps of
    ``resolution`` (n,). Frames of each camera: ``times`` (f,) [s] as stamped, raw ``pixels`` (f, m, 2), NaN where a
    marker is not seen, and ``variances`` (f, m) [px²] of a coordinate, as stated.
    """

    trial: int
    start_s: float
    end_s: float
    joint_times: FloatArray
    positions: FloatArray
    times: tuple[FloatArray, ...]
    pixels: tuple[FloatArray, ...]
    variances: tuple[FloatArray, ...]
    resolution: FloatArray

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Joint positions (f, n) at ``times`` (f,) [s], by linear interpolation."""
        return np.array([np.interp(times, self.joint_times, q) for q in self.positions.T]).T

    @property
    def ends(self) -> FloatArray:
        """Joint positions (2, n) at its start and its end."""
        return self.positions_at(np.array([self.start_s, self.end_s]))


class LegMeans(NamedTuple):
    """Means at k positions of a leg: ``positions`` (k, n), ``pixels`` (c, k, m, 2), NaN where there are none; each of
    ``counts`` (c, k, m) observations, of which one has the variance ``single`` (c, k, m) [px²], as stated.

    ``frames`` (c,): how many there were. ``scatter`` (c, m) [px²]: variance of a coordinate about the track, with
    ``freedom`` (c, m).
    """

    positions: FloatArray
    pixels: FloatArray
    counts: FloatArray
    single: FloatArray
    frames: IntArray
    scatter: FloatArray
    freedom: FloatArray


def leg_means(leg: Leg, delays: FloatArray, frames_each: int) -> LegMeans | None:
    """Means of a leg over intervals of ``frames_each`` frames, with the cameras' shutters ``delays`` (c,) [s] after
    their stamps; None if the leg has too few frames or no motion.
    """
    shown = [leg.positions_at(times + delay) for times, delay in zip(leg.times, delays.tolist(), strict=True)]
    middle, end = leg.positions_at(leg.start_s + np.array(LINE) * (leg.end_s - leg.start_s))
    line = end - middle
    if not line.any():
        return None
    along = [(q - middle) @ line / (line @ line) for q in shown]
    straight = [_near_line(q - middle, a, line, leg.resolution) for q, a in zip(shown, along, strict=True)]
    most = max((a[near] for a, near in zip(along, straight, strict=True)), key=len)
    if len(most) < max(frames_each, FEWEST_FRAMES):
        return None
    edges = np.quantile(most, np.linspace(0.0, 1.0, len(most) // frames_each + 1))
    inner = edges[1:-1]
    intervals = [np.where(near, np.searchsorted(inner, a), -1) for a, near in zip(along, straight, strict=True)]
    every, of_interval, q_all = np.concatenate(along), np.concatenate(intervals), np.concatenate(shown)
    used = np.unique(of_interval[of_interval >= 0])
    nodes = np.array([every[of_interval == k].mean() for k in used])
    positions = np.array([q_all[of_interval == k].mean(axis=0) for k in used])
    c, m = len(leg.times), leg.pixels[0].shape[1]
    pixels, single = np.full((c, len(used), m, 2), np.nan), np.full((c, len(used), m), np.nan)
    counts, scatter, freedom = np.zeros((c, len(used), m)), np.zeros((c, m)), np.zeros((c, m))
    for camera in range(c):
        seen = finite_rows(leg.pixels[camera]) & straight[camera][:, None]
        terms = MORE_TERMS + _terms(along[camera], leg.pixels[camera], seen)
        for marker in np.flatnonzero(seen.sum(axis=0) >= frames_each):
            track = _track(along[camera], leg.pixels[camera][:, marker], seen[:, marker], terms)
            scatter[camera, marker], freedom[camera, marker] = track.scatter, track.freedom
            for row, (k, node) in enumerate(zip(used.tolist(), nodes.tolist(), strict=True)):
                mine = track.used & (intervals[camera] == k)
                if not mine.any() or 2 * int(mine.sum()) < int((intervals[camera] == k).sum()):
                    continue
                if not track.low <= node <= track.high:
                    continue  # polynomials do not extrapolate
                weights = track.weights(along[camera], mine, node)
                pixels[camera, row, marker] = weights @ leg.pixels[camera][track.used, marker]
                single[camera, row, marker] = leg.variances[camera][mine, marker].mean()
                counts[camera, row, marker] = 1.0 / float(weights @ weights)
    frames = np.array([int(near.sum()) for near in straight], dtype=np.int64)
    return LegMeans(positions, pixels, counts, single, frames, scatter, freedom)


def links_displaced(legs: list[Leg], play: FloatArray) -> list[FloatArray]:
    """For each leg, by how much (n,) the links are displaced from their readings by ``play`` (n,): half of it, against
    the direction in which each joint has moved last.
    """
    side, found = np.zeros_like(play), []
    for leg in legs:
        moved = np.diff(leg.ends, axis=0)[0]
        side = np.where(np.abs(moved) > np.maximum(play, LEAST_MOTION), np.sign(moved), side)
        found.append(-0.5 * play * side)
    return found


def _near_line(offsets: FloatArray, along: FloatArray, line: FloatArray, resolution: FloatArray) -> BoolArray:
    """Mask (f,) of joint positions near a leg's line."""
    aside = np.abs(offsets - along[:, None] * line)
    return np.asarray((aside <= STRAIGHT * np.abs(line).max() + resolution).all(axis=1))


class _Track(NamedTuple):
    """Polynomial of a marker's track, in ``terms`` over [low, high]: its ``used`` observations (f,), the
    ``inverse`` (terms, k) of their columns, their ``scatter`` about it [px²] and its degrees of ``freedom``, of one
    coordinate.
    """

    terms: int
    low: float
    high: float
    used: BoolArray
    inverse: FloatArray
    scatter: float
    freedom: float

    def weights(self, along: FloatArray, mine: BoolArray, node: float) -> FloatArray:
        """Weights (k,) of the used observations in their mean over ``mine`` (f,), moved along the polynomial to
        ``node``.
        """
        columns = _columns(np.append(along[mine], node), self.low, self.high, self.terms)
        weights: FloatArray = (columns[-1] - columns[:-1].mean(axis=0)) @ self.inverse
        weights[mine[self.used]] += 1.0 / mine.sum()
        return weights


def _columns(along: FloatArray, low: float, high: float, count: int) -> FloatArray:
    """Chebyshev polynomials (k, count) over [low, high]."""
    scaled = 2.0 * (along - low) / max(high - low, 1e-12) - 1.0
    return np.asarray(np.polynomial.chebyshev.chebvander(scaled, max(count - 1, 0))[:, :count], dtype=np.float64)


def _terms(along: FloatArray, pixels: FloatArray, seen: BoolArray) -> int:
    """Number of polynomial terms for the tracks (f, m, 2) of a camera's markers: the one with the least of Akaike's
    criterion, corrected for few observations, among those that leave freedom.
    """
    masks, of_mask = np.unique(seen, axis=1, return_inverse=True)
    best, chosen = np.inf, FEWEST_TERMS
    for terms in range(FEWEST_TERMS, MOST_TERMS + 1):
        cost = 0.0
        for k, mask in enumerate(masks.T):
            count = int(mask.sum())
            if count < FEWEST_TERMS + LEAST_FREEDOM:
                continue
            if count < terms + LEAST_FREEDOM:
                return chosen
            basis, _ = np.linalg.qr(_columns(along[mask], float(along[mask].min()), float(along[mask].max()), terms))
            tracks = pixels[mask][:, of_mask.ravel() == k].reshape(count, -1)
            squares = ((tracks - basis @ (basis.T @ tracks)) ** 2).sum()
            cost += tracks.shape[1] * (
                count * np.log(max(float(squares), 1e-300)) + 2.0 * terms * count / (count - terms - 1.0)
            )
        if cost < best:
            best, chosen = cost, terms
    return chosen


def _track(along: FloatArray, pixels: FloatArray, seen: BoolArray, terms: int) -> _Track:
    """Fit of one marker's track (f, 2) by a polynomial, without wrong detections."""
    used = seen.copy()
    while True:
        low, high = float(along[used].min()), float(along[used].max())
        count = max(1, min(terms, int(used.sum()) - LEAST_FREEDOM))
        columns = _columns(along[used], low, high, count)
        inverse = np.asarray(np.linalg.pinv(columns), dtype=np.float64)
        squares = ((pixels[used] - columns @ (inverse @ pixels[used])) ** 2).sum(axis=1)
        freedom = float(len(columns) - count)
        limit = FAR_SIGMAS**2 * max(float(np.median(squares)) / np.log(2.0), 1e-12)  # chi² of two coordinates
        wrong = squares > limit
        if not wrong.any() or freedom <= LEAST_FREEDOM:
            scatter = float(squares.sum()) / (2.0 * freedom) if freedom else 0.0
            return _Track(count, low, high, used, inverse, scatter, freedom)
        used[np.flatnonzero(used)[wrong]] = False


class SweepTiming(NamedTuple):
    """Delays (c,) [s] of the cameras' shutters after their stamps, and play (n,) [rad or m] of the joints, by which
    links follow their readings, with their standard ``deviations`` (c + n,); 0 and infinite where sweeps do not
    determine them.
    """

    delays: FloatArray
    play: FloatArray
    deviations: FloatArray


def sweep_timing(legs: list[Leg], cameras: int) -> SweepTiming:
    """Delays and play from the legs on which a joint sweeps alone, there and back. Play that is not significant is 0:
    beside it the delays are known less.
    """
    joints = legs[0].positions.shape[1] if legs else 0
    alone = [[leg for leg in legs if leg.trial == joint] for joint in range(joints)]
    free = np.arange(cameras + joints) < cameras
    values, deviations = np.zeros(cameras + joints), np.full(cameras + joints, np.inf)
    for plays in (False, True, False):
        if plays:
            free[:] = True
        values, deviations = _solved_timing(alone, cameras, np.where(free, values, 0.0), free)
        free = (np.arange(len(values)) < cameras) | (np.abs(values) > SIGNIFICANT * deviations)
    return SweepTiming(values[:cameras], values[cameras:], deviations)


def _solved_timing(
    alone: list[list[Leg]], cameras: int, values: FloatArray, free: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Delays and play, of which those that are not ``free`` keep their ``values``, and their deviations."""
    for _ in range(ROUNDS):
        square, across = np.zeros((len(values), len(values))), np.zeros(len(values))
        squares = freedom = 0.0
        for joint, legs in enumerate(alone):
            for camera in range(cameras):
                at = np.array([camera, cameras + joint])
                one = _timing_equation(legs, camera, float(values[camera]), float(values[cameras + joint]))
                square[np.ix_(at, at)] += one.square
                across[at] += one.across
                squares, freedom = squares + one.squares, freedom + one.freedom
        known = free & (np.diag(square) > 0.0)
        deviations = np.full(len(values), np.inf)
        if not known.any() or freedom <= 1.0:
            return np.zeros(len(values)), deviations
        covariance = np.linalg.pinv(square[np.ix_(known, known)])
        step = covariance @ across[known]
        left = max(squares - float(across[known] @ step), 0.0)
        deviations[known] = np.sqrt(np.diag(covariance) * left / freedom)
        values = values.copy()
        values[known] += step
        values = np.clip(values, -LONGEST_DELAY_S, LONGEST_DELAY_S)
        if np.abs(step).max() < CONVERGED:
            break
    return values, deviations


class _Equation(NamedTuple):
    """Normal equation of a delay and a play: ``square`` (2, 2), right side ``across`` (2,), the sum of ``squares`` that
    they leave as they are, and its degrees of ``freedom``.
    """

    square: FloatArray
    across: FloatArray
    squares: float
    freedom: float


def _timing_equation(legs: list[Leg], camera: int, delay: float, play: float) -> _Equation:
    """Equation of changes of ``delay`` and ``play`` by the legs of one joint: a camera's tracks are polynomials of the
    link's position.
    """
    nothing = _Equation(np.zeros((2, 2)), np.zeros(2), 0.0, 0.0)
    times = [leg.times[camera] + delay for leg in legs]
    if sum(len(t) for t in times) < FEWEST_FRAMES:
        return nothing
    joint = legs[0].trial
    readings = [leg.positions_at(t) for leg, t in zip(legs, times, strict=True)]
    begin = np.concatenate([np.full(len(t), leg.ends[0, joint]) for leg, t in zip(legs, times, strict=True)])
    ahead = np.concatenate(
        [np.full(len(t), np.sign(np.diff(leg.ends[:, joint]))) for leg, t in zip(legs, times, strict=True)]
    )
    speed = np.concatenate([np.interp(t, *_speeds(leg, joint)) for leg, t in zip(legs, times, strict=True)])
    positions, pixels = np.concatenate(readings), np.concatenate([leg.pixels[camera] for leg in legs])
    links, aside = positions[:, joint] - 0.5 * play * ahead, _others(np.delete(positions, joint, axis=1))
    taken_up = np.abs(positions[:, joint] - begin) >= abs(play)
    low, high = float(links.min()), float(links.max())
    square, across, squares, freedom = nothing
    seen = finite_rows(pixels) & taken_up[:, None]
    for mask in np.unique(seen, axis=1).T:
        terms = min(DELAY_TERMS, int(mask.sum()) // 3)
        if mask.sum() < FEWEST_FRAMES:
            continue
        mine = (seen == mask[:, None]).all(axis=0)
        columns = np.column_stack([_columns(links[mask], low, high, terms), aside[mask]])
        basis, _ = np.linalg.qr(columns)
        tracks = pixels[mask][:, mine].reshape(int(mask.sum()), -1)
        coefficients, *_ = np.linalg.lstsq(columns, tracks, rcond=None)
        left = tracks - basis @ (basis.T @ tracks)
        slopes = np.polynomial.chebyshev.chebder(np.eye(terms)) @ coefficients[:terms]
        slopes = _columns(links[mask], low, high, terms - 1) @ slopes * (2.0 / max(high - low, 1e-12))
        effects = np.array([slopes * speed[mask, None], slopes * (-0.5 * ahead[mask, None])])
        effects -= basis @ (basis.T @ effects)
        square = square + np.einsum("ifk,jfk->ij", effects, effects)
        across = across + np.einsum("ifk,fk->i", effects, left)
        squares += float((left * left).sum())
        freedom += float(left.size - columns.shape[1] * left.shape[1])
    return _Equation(square, across, squares, freedom)


def _others(positions: FloatArray) -> FloatArray:
    """Motion (f, k) of the other joints, ``positions`` (f, n - 1), in its principal directions: one that has just swept
    is still arriving.
    """
    offsets = positions - np.median(positions, axis=0)
    basis, sizes, _ = np.linalg.svd(offsets, full_matrices=False)
    return np.asarray(basis[:, sizes > STILL * np.sqrt(len(offsets))][:, :MOST_OTHERS])


def _speeds(leg: Leg, joint: int) -> tuple[FloatArray, FloatArray]:
    """Times between the joint samples, and the joint's speeds there."""
    times, q = leg.joint_times, leg.positions[:, joint]
    steps = np.maximum(np.diff(times), 1e-9)
    return 0.5 * (times[1:] + times[:-1]), np.diff(q) / steps
