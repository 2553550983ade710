"""Trial data from sweeps: frames taken while joints move are reduced to means at a few positions along each sweep.

On a leg, a straight line in joint space, a marker's track in an image is a smooth function of the joint position at the
shutter. A polynomial describes its curvature; the frames of an interval are averaged about the polynomial, so that a
mean has the noise of as many frames at rest. All cameras are reduced at the same positions, whatever their stamps.

The timing of a camera against the joints follows from the same tracks without a model: with a delay of its stamps,
markers are displaced in proportion to the joint's velocity; with a rolling shutter, by the row as well; with play, by a
constant that changes its sign with the direction. Errors of single stamps displace all markers of a frame along their
velocities.
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
SMOOTHING = 3.5
"""Span [s] of the quadratic that smooths readings of 1 rad, sampled once a second."""
ROUNDS = 12
LONGEST_DELAY_S = 0.3
CONVERGED = 1e-6
SIGNIFICANT = 6.0
"""Play, in its standard deviations, from which it is taken into account."""
STILL, MOST_OTHERS = 1e-6, 3
"""Motion of other joints [rad or m, rms] that is taken into account, and most directions of it."""
DELAY_TERMS = 10
"""Most polynomial terms of a joint's tracks, there and back, beside the delay."""
PLAY_TRAVELS = 0.0, 2e-3, 5e-3, 1e-2, 2e-2
"""Travels of a joint [rad or m] after which its play may be taken up; frames before that are left out of the timing."""
NO_BETTER = 1.02
"""Ratio of residual variances below which the shorter travel is used."""
MEDIAN = 0.4549
"""Median of chi-square with one degree of freedom."""
FEWEST_JUDGED, LEAST_SHARE = 5, 0.2
"""Least number of frames of a leg from which errors of stamps are estimated, and the speed from which they are used, as
a fraction of the leg's largest.
"""
DELAYS_S = np.arange(-0.06, 0.121, 0.005)
"""Delays of a camera's shutters that are tried to compare its frames with the joint."""


class Leg(msgspec.Struct, frozen=True, eq=False):
    """Observations on one leg, from ``start_s`` to ``end_s``. ``trial``: the joint that moves alone, -1 if several do.

    Joint samples, before and after the leg as well: ``joint_times`` (j,) [s], ``positions`` (j, n), read in steps of
    ``resolution`` (n,). Frames of each camera: ``times`` (f,) [s] as stamped, raw ``pixels`` (f, m, 2), NaN where a
    marker is not seen, and ``variances`` (f, m) [px²] of a coordinate, as stated. ``heights`` (c,) [px] of the images.
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
    heights: tuple[int, ...]

    def positions_at(self, times: FloatArray) -> FloatArray:
        """Joint positions (f, n) at ``times`` (f,) [s], by the cubic through four samples; before the first and after
        the last sample, where it was.
        """
        knots = self.joint_times
        if len(knots) < 4:
            return np.array([np.interp(times, knots, q) for q in self.positions.T]).T
        inside = np.clip(times, knots[0], knots[-1])
        first = np.clip(np.searchsorted(knots, inside, side="right") - 2, 0, len(knots) - 4)
        around = first[:, None] + np.arange(4)
        differences = inside[:, None] - knots[around]
        found = np.zeros((len(times), self.positions.shape[1]))
        for k in range(4):
            others = [o for o in range(4) if o != k]
            weight = np.prod(differences[:, others] / (knots[around[:, [k]]] - knots[around[:, others]]), axis=1)
            found += weight[:, None] * self.positions[around[:, k]]
        return found

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


def leg_means(leg: Leg, timing: SweepTiming, frames_each: int) -> LegMeans | None:
    """Means of a leg over intervals of ``frames_each`` frames, at the cameras' own ``timing``; None if the leg has too
    few frames or no motion.
    """
    shutters = [times + delay for times, delay in zip(leg.times, timing.delays.tolist(), strict=True)]
    shown = [leg.positions_at(times) for times in shutters]
    midpoint, end = leg.positions_at(leg.start_s + np.array(LINE) * (leg.end_s - leg.start_s))
    line = end - midpoint
    if not line.any():
        return None
    along = [(q - midpoint) @ line / (line @ line) for q in shown]
    straight = [_near_line(q - midpoint, a, line, leg.resolution) for q, a in zip(shown, along, strict=True)]
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
    speeds = [_rates(leg, times) @ line / (line @ line) for times in shutters]
    tracks = [
        _at_one_time(*one) for one in zip(leg.pixels, along, speeds, timing.rows.tolist(), leg.heights, strict=True)
    ]
    c, m = len(leg.times), leg.pixels[0].shape[1]
    pixels, single = np.full((c, len(used), m, 2), np.nan), np.full((c, len(used), m), np.nan)
    counts, scatter, freedom = np.zeros((c, len(used), m)), np.zeros((c, m)), np.zeros((c, m))
    for camera in range(c):
        seen = finite_rows(tracks[camera]) & straight[camera][:, None]
        terms = MORE_TERMS + _terms(along[camera], tracks[camera], seen)
        left, slopes = np.full(tracks[camera].shape, np.nan), np.zeros(tracks[camera].shape)
        for marker in np.flatnonzero(seen.sum(axis=0) >= frames_each):
            track = _track(along[camera], tracks[camera][:, marker], seen[:, marker], terms)
            left[track.used, marker], slopes[track.used, marker] = track.left, track.slopes
            freedom[camera, marker] = track.freedom
            for row, (k, node) in enumerate(zip(used.tolist(), nodes.tolist(), strict=True)):
                mine = track.used & (intervals[camera] == k)
                if not mine.any() or 2 * int(mine.sum()) < int((intervals[camera] == k).sum()):
                    continue
                if not track.low <= node <= track.high:
                    continue  # polynomials do not extrapolate
                weights = track.weights(along[camera], mine, node)
                pixels[camera, row, marker] = weights @ tracks[camera][track.used, marker]
                single[camera, row, marker] = leg.variances[camera][mine, marker].mean()
                counts[camera, row, marker] = 1.0 / float(weights @ weights)
        scatter[camera], freedom[camera] = _own_scatter(left, slopes, freedom[camera])
    frames = np.array([int(near.sum()) for near in straight], dtype=np.int64)
    return LegMeans(positions, pixels, counts, single, frames, scatter, freedom)


def _own_scatter(left: FloatArray, slopes: FloatArray, freedom: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variance (m,) of a marker's coordinate from its residuals ``left`` (f, m, 2), NaN where there are none, with
    ``freedom`` (m,), and what remains of that, without what moves all markers of a frame along their ``slopes``
    (f, m, 2): errors of its joint positions or of its stamp.
    """
    sizes = (np.where(np.isfinite(left), slopes, 0.0) ** 2).sum(axis=-1)
    whole = np.maximum(sizes.sum(axis=1), 1e-300)
    several = np.isfinite(left[..., 0]).sum(axis=1) > 1
    common = np.where(several, np.nansum(slopes * left, axis=(1, 2)) / whole, 0.0)
    own = np.nansum((left - slopes * common[:, None, None]) ** 2, axis=(0, 2))
    remaining = np.maximum(freedom - 0.5 * (sizes / whole[:, None])[several].sum(axis=0), 0.0)
    return own / np.maximum(2.0 * remaining, 1e-300), remaining


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


def smoothed_readings(
    times: FloatArray, positions: FloatArray, resolution: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Joint samples at even times, those of joints read in coarse steps of ``resolution`` (n,) smoothed by a quadratic:
    a joint that passes many steps is known far better than to one of them.

    Its span balances quantization, ``0.4 resolution √(period / span)``, against what the quadratic errs where an
    acceleration of some rad/s² begins, ``0.01 span²``; the latter is rare.
    """
    period = max(float(np.median(np.diff(times))), 1e-4)
    halves = (0.5 * SMOOTHING * (resolution * np.sqrt(period)) ** 0.4 / period).astype(np.int64)
    if halves.max() < 2:
        return times, positions
    even = np.linspace(times[0], times[-1], len(times))
    found = np.array([np.interp(even, times, q) for q in positions.T]).T
    for joint in np.flatnonzero(halves >= 2):
        half = int(halves[joint])
        weights = np.linalg.pinv(np.vander(np.linspace(-1.0, 1.0, 2 * half + 1), 3, increasing=True))[0]
        around = np.pad(found[:, joint], half, mode="edge")
        found[:, joint] = np.convolve(around, weights, mode="valid")
    return even, found


def _near_line(offsets: FloatArray, along: FloatArray, line: FloatArray, resolution: FloatArray) -> BoolArray:
    """Mask (f,) of joint positions near a leg's line."""
    aside = np.abs(offsets - along[:, None] * line)
    return np.asarray((aside <= STRAIGHT * np.abs(line).max() + resolution).all(axis=1))


class _Track(NamedTuple):
    """Polynomial of a marker's track, in ``terms`` over [low, high]: its ``used`` observations (f,), the
    ``inverse`` (terms, k) of their columns, what is ``left`` (k, 2) of them and their ``slopes`` (k, 2) along it, and
    its degrees of ``freedom``, of one coordinate.
    """

    terms: int
    low: float
    high: float
    used: BoolArray
    inverse: FloatArray
    left: FloatArray
    slopes: FloatArray
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
        left = pixels[used] - columns @ (inverse @ pixels[used])
        squares = (left**2).sum(axis=1)
        freedom = float(len(columns) - count)
        limit = FAR_SIGMAS**2 * max(float(np.median(squares)) / np.log(2.0), 1e-12)  # chi² of two coordinates
        wrong = squares > limit
        if not wrong.any() or freedom <= LEAST_FREEDOM:
            slopes = _slopes((inverse @ pixels[used])[:count], along[used], low, high)
            return _Track(count, low, high, used, inverse, left, slopes, freedom)
        used[np.flatnonzero(used)[wrong]] = False


class SweepTiming(NamedTuple):
    """Delays (c,) [s] of the cameras' shutters after their stamps, at the middle row; time ``rows`` (c,) [s/px] from
    one row to the next of a rolling shutter; and play (n,) [rad or m] of the joints, by which links follow their
    readings; with their standard ``deviations`` (2 c + n,). 0 and infinite where sweeps do not determine them.
    """

    delays: FloatArray
    rows: FloatArray
    play: FloatArray
    deviations: FloatArray


def sweep_timing(legs: list[Leg], cameras: int) -> SweepTiming:
    """Timing from the legs on which a joint sweeps alone, there and back. Rolling shutters and play that are not
    significant are 0: beside them the delays are known less.

    Until a joint has taken up its play, its link rests: frames of the first travel are left out, of as much of it as
    lowers the residuals.
    """
    joints = legs[0].positions.shape[1] if legs else 0
    alone = [[leg for leg in legs if leg.trial == joint] for joint in range(joints)]
    found = [_timing(alone, cameras, travel) for travel in PLAY_TRAVELS]
    least = min(variance for _, _, variance in found)
    values, deviations, _ = next(one for one in found if one[2] <= NO_BETTER * least)
    return SweepTiming(values[:cameras], values[cameras : 2 * cameras], values[2 * cameras :], deviations)


def _timing(alone: list[list[Leg]], cameras: int, travel: float) -> tuple[FloatArray, FloatArray, float]:
    """Delays, times of rows and play (2 c + n,), their deviations, and the variance of the residuals [px²], by frames
    after ``travel``.
    """
    size = 2 * cameras + len(alone)
    delays = np.arange(size) < cameras
    values, deviations, variance, free = np.zeros(size), np.full(size, np.inf), 0.0, delays
    for everything in (False, True, False):
        free = np.ones(size, dtype=bool) if everything else free
        values, deviations, variance = _solved_timing(alone, cameras, np.where(free, values, 0.0), free, travel)
        free = delays | (np.abs(values) > SIGNIFICANT * deviations)
    return values, deviations, variance


def _solved_timing(
    alone: list[list[Leg]], cameras: int, values: FloatArray, free: BoolArray, travel: float
) -> tuple[FloatArray, FloatArray, float]:
    """Timing of which what is not ``free`` keeps its ``values``, deviations, and the variance of the residuals."""
    deviations, variance = np.full(len(values), np.inf), 0.0
    for _ in range(ROUNDS):
        square, across = np.zeros((len(values), len(values))), np.zeros(len(values))
        squares = freedom = 0.0
        for joint, legs in enumerate(alone):
            for camera in range(cameras):
                at = np.array([camera, cameras + camera, 2 * cameras + joint])
                one = _timing_equation(legs, camera, values[at], travel)
                square[np.ix_(at, at)] += one.square
                across[at] += one.across
                squares, freedom = squares + one.squares, freedom + one.freedom
        known = free & (np.diag(square) > 0.0)
        deviations = np.full(len(values), np.inf)
        if not known.any() or freedom <= 1.0:
            return np.zeros(len(values)), deviations, variance
        covariance = np.linalg.pinv(square[np.ix_(known, known)])
        step = covariance @ across[known]
        variance = max(squares - float(across[known] @ step), 0.0) / freedom
        variances = np.diag(covariance) * variance
        deviations[known] = np.sqrt(np.where(variances >= 0.0, variances, np.inf))  # of what is not determined
        values = values.copy()
        values[known] += step
        values = np.clip(values, -LONGEST_DELAY_S, LONGEST_DELAY_S)
        if np.abs(step).max() < CONVERGED:
            break
    return values, deviations, variance


class _Equation(NamedTuple):
    """Normal equation of a delay, a time of rows and a play: ``square`` (3, 3), right side ``across`` (3,), the sum of
    ``squares`` that they leave as they are, and its degrees of ``freedom``.
    """

    square: FloatArray
    across: FloatArray
    squares: float
    freedom: float


def _timing_equation(legs: list[Leg], camera: int, values: FloatArray, travel: float) -> _Equation:
    """Equation of changes of the delay, time of rows and play ``values`` (3,) by the legs of one joint: a camera's
    tracks are polynomials of the link's position.
    """
    nothing = _Equation(np.zeros((3, 3)), np.zeros(3), 0.0, 0.0)
    delay, row_s, play = values.tolist()
    times = [leg.times[camera] + delay for leg in legs]
    if sum(len(t) for t in times) < FEWEST_FRAMES:
        return nothing
    joint = legs[0].trial
    readings = [leg.positions_at(t) for leg, t in zip(legs, times, strict=True)]
    starts, ends = np.repeat([leg.ends[:, joint] for leg in legs], [len(t) for t in times], axis=0).T
    ahead = np.sign(ends - starts)
    speed = np.concatenate([_rates(leg, t)[:, joint] for leg, t in zip(legs, times, strict=True)])
    positions, pixels = np.concatenate(readings), np.concatenate([leg.pixels[camera] for leg in legs])
    links, aside = positions[:, joint] - 0.5 * play * ahead, _others(np.delete(positions, joint, axis=1))
    past_play = np.abs(positions[:, joint] - starts) >= max(travel, abs(play))
    low, high = float(links.min()), float(links.max())
    square, across, squares, freedom = nothing
    seen = finite_rows(pixels) & past_play[:, None]
    for mask in np.unique(seen, axis=1).T:
        terms = min(DELAY_TERMS, int(mask.sum()) // 3)
        if mask.sum() < FEWEST_FRAMES:
            continue
        mine = (seen == mask[:, None]).all(axis=0)
        columns = np.column_stack([_columns(links[mask], low, high, terms), aside[mask]])
        inverse = np.linalg.pinv(columns)
        rows = np.repeat(pixels[mask][:, mine, 1] - 0.5 * legs[0].heights[camera], 2, axis=1)
        tracks = pixels[mask][:, mine].reshape(int(mask.sum()), -1)
        slopes = _slopes((inverse @ tracks)[:terms], links[mask], low, high) * speed[mask, None]
        tracks -= slopes * rows * row_s
        coefficients = inverse @ tracks
        left = tracks - columns @ coefficients
        by_link = _slopes(coefficients[:terms], links[mask], low, high)
        slopes = by_link * speed[mask, None]
        effects = np.array([slopes, slopes * rows, by_link * (-0.5 * ahead[mask, None])])
        effects -= columns @ (inverse @ effects)
        square = square + np.einsum("ifk,jfk->ij", effects, effects)
        across = across + np.einsum("ifk,fk->i", effects, left)
        squares += float((left * left).sum())
        freedom += float(left.size - columns.shape[1] * left.shape[1])
    return _Equation(square, across, squares, freedom)


def _slopes(coefficients: FloatArray, links: FloatArray, low: float, high: float) -> FloatArray:
    """Derivatives (f, k) of polynomials of ``coefficients`` (terms, k), by the position ``links`` (f,)."""
    derivative = np.polynomial.chebyshev.chebder(coefficients)
    return np.asarray(_columns(links, low, high, len(derivative)) @ derivative * (2.0 / max(high - low, 1e-12)))


def _at_one_time(pixels: FloatArray, along: FloatArray, speed: FloatArray, row_s: float, height: int) -> FloatArray:
    """Pixels (f, m, 2) of a camera with a rolling shutter, moved to where they were when the middle row was exposed;
    the frames are ``along`` (f,) a leg at ``speed`` (f,) [1/s].
    """
    if row_s == 0.0:
        return pixels
    found = pixels.copy()
    for marker in range(pixels.shape[1]):
        seen = finite_rows(pixels[:, marker])
        if seen.sum() < FEWEST_FRAMES:
            found[:, marker] = np.nan
            continue
        low, high = float(along[seen].min()), float(along[seen].max())
        terms = min(DELAY_TERMS, int(seen.sum()) // 3)
        coefficients = np.linalg.pinv(_columns(along[seen], low, high, terms)) @ pixels[seen, marker]
        slopes = _slopes(coefficients, along[seen], low, high)
        late = row_s * (pixels[seen, marker, 1] - 0.5 * height)
        found[seen, marker] -= slopes * (speed[seen] * late)[:, None]
    return found


def _others(positions: FloatArray) -> FloatArray:
    """Motion (f, k) of the other joints, ``positions`` (f, n - 1), in its principal directions: one that has just swept
    is still arriving.
    """
    offsets = positions - np.median(positions, axis=0)
    basis, sizes, _ = np.linalg.svd(offsets, full_matrices=False)
    return np.asarray(basis[:, sizes > STILL * np.sqrt(len(offsets))][:, :MOST_OTHERS])


def _rates(leg: Leg, times: FloatArray) -> FloatArray:
    """Velocities (f, n) of the joints at ``times`` (f,)."""
    midpoints = 0.5 * (leg.joint_times[1:] + leg.joint_times[:-1])
    rates = np.diff(leg.positions, axis=0) / np.maximum(np.diff(leg.joint_times), 1e-9)[:, None]
    return np.array([np.interp(times, midpoints, rate) for rate in rates.T]).T


def stamp_scatter(
    times: FloatArray, pixels: FloatArray, joint_times: FloatArray, positions: FloatArray, resolution: float = 0.0
) -> tuple[float, int]:
    """Mean square of the displacement that errors of a camera's stamps give to all markers of a frame, along their
    velocities, as a fraction of the variance of a coordinate; and the number of frames that showed it, 0 if too few.

    What a joint read in steps of ``resolution`` errs at a stop is no fault of stamps, and left out.

    One joint moves: its ``positions`` (j,) at ``joint_times`` (j,) [s]; ``times`` (f,) [s] as stamped, increasing,
    ``pixels`` (f, m, 2), NaN where not seen. A frame is compared with the cubic through its four neighbours, less what
    the joint deviates from its own cubic, at the delay of `DELAYS_S` that explains the frames best. The variances are
    medians: a few frames may deviate for other reasons.
    """
    midpoint = np.arange(2, len(times) - 2)
    around = midpoint[:, None] + np.array([-2, -1, 1, 2])
    if not len(midpoint):
        return 0.0, 0
    powers = np.vander(
        ((times[around] - times[midpoint, None]) / (times[midpoint + 2] - times[midpoint - 2])[:, None]).ravel(),
        4,
        increasing=True,
    )
    inverse = np.linalg.inv(powers.reshape(len(midpoint), 4, 4))
    value, rate = inverse[:, 0], inverse[:, 1] / (times[midpoint + 2] - times[midpoint - 2])[:, None]
    seen = finite_rows(pixels)[np.column_stack([around, midpoint])].all(axis=1)[..., None]
    left = np.where(seen, pixels[midpoint] - np.einsum("kw,kwmx->kmx", value, pixels[around]), 0.0)
    velocity = np.where(seen, np.einsum("kw,kwmx->kmx", rate, pixels[around]), 0.0)
    speed, counts = np.sqrt((velocity**2).sum(axis=(1, 2))), seen.sum(axis=(1, 2))
    readings = np.interp(times + DELAYS_S[:, None], joint_times, positions)
    moves = np.einsum("kw,dkw->dk", rate, readings[:, around])
    used = (counts >= 2) & (speed > 0.0) & (np.abs(moves).min(axis=0) > LEAST_SHARE * np.abs(moves).max())
    if used.sum() < FEWEST_JUDGED:
        return 0.0, 0
    deviating = readings[:, midpoint] - np.einsum("kw,dkw->dk", value, readings[:, around])
    variance = 1.0 + (value**2).sum(axis=1)
    along = (velocity * left).sum(axis=(1, 2))[used] / speed[used]
    late = deviating[:, used] / moves[:, used]
    common = float(np.median((along - speed[used] * late) ** 2 / variance[used], axis=1).min())
    beside = ((left**2).sum(axis=(1, 2))[used] - along**2) / variance[used] / (2.0 * counts[used] - 1.0)
    noise = float(np.median(beside))
    by_readings = float(np.median(speed[used] / np.abs(moves[:, used]).max(axis=0))) ** 2 * resolution**2 / 12.0
    excess = (common / MEDIAN - by_readings) / noise - 1.0 if noise > 0.0 else 0.0
    return max(excess, 0.0) / float(counts[used].mean()), int(used.sum())
