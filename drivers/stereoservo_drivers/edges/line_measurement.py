"""Straight edges measured sub-pixel: profiles across an expected edge, the steepest place of each, and the line through
these with its covariance.

An edge is a step blurred by the lens. Its place in a profile is the maximum of the grey levels' derivative, smoothed by
a Gaussian of ``SMOOTH`` px. The noise of these places is estimated from their scatter about the line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import Fields, kernel, plain
from stereoservo_drivers.detectors.kernel_types import FLOAT, compile_for, fields, given, written

STEP = 0.5
"""Sampling interval of profiles [px]."""
SMOOTH = 1.0
REACH = 3.0
"""Half width of the smoothing filter [px]."""
MOST_SAMPLES = 120
"""Largest number of profiles per edge."""
LEAST_SAMPLES = 8
"""Least number of places on a line; with fewer it is not measured."""
LEAST_SHARE = 0.65
"""Least share of an edge's profiles with a place on its line."""
OFF_LINE = 3.0
"""Number of standard deviations beyond which a place is not on the line."""
LEAST_OFF_PX = 0.3
MOST_SCATTER_PX = 0.5
"""Largest rms distance of places from their line [px]."""
CANDIDATES = 4
INTERPOLATION = 2.2
"""Ratio of the variance of a mean of places to that of independent ones: neighbours share pixels."""


@dataclass(frozen=True, eq=False)
class Profiles:
    """Grey levels' derivatives across expected edges: ``edge`` (s,): edge of each profile, ``t`` (s,) [px] along it
    from its centre, ``slopes`` (s, k) [grey levels/px] at offsets ``at`` (k,) [px] along the edge's normal.
    """

    edge: IntArray
    t: FloatArray
    slopes: FloatArray
    at: FloatArray


@dataclass(frozen=True, eq=False)
class MeasuredLine:
    """A line: ``middle`` (2,), unit vector ``along`` (2,), ``normal`` (2,); at ``t`` px along it its offset along the
    normal is ``offset + tilt t`` px, with ``covariance`` (2, 2) of the two. ``span``: least and largest t measured.
    """

    middle: FloatArray
    along: FloatArray
    normal: FloatArray
    offset: float
    tilt: float
    covariance: FloatArray
    span: tuple[float, float]

    def at(self, t: float) -> FloatArray:
        """The point (2,) [px] of the line at ``t``."""
        point: FloatArray = self.middle + t * self.along + (self.offset + self.tilt * t) * self.normal
        return point

    def variance(self, point: FloatArray) -> float:
        """Variance [px²] of the line across itself at ``point`` (2,)."""
        t = float((point - self.middle) @ self.along)
        here = np.array([1.0, t])
        return float(here @ self.covariance @ here)

    def equation(self) -> tuple[FloatArray, float]:
        """Unit normal ``n`` (2,) and ``c`` with ``n x = c`` on the line."""
        n = self.normal - self.tilt * self.along
        n = n / np.linalg.norm(n)
        return n, float(n @ self.at(0.0))


def take_profiles(
    image: FloatArray, ends: FloatArray, edges: IntArray, others: FloatArray, half: float, clearance: float
) -> Profiles:
    """Profiles across segments ``ends`` (e, 2, 2) [px], numbered by ``edges`` (e,), up to ``half`` px to each side.

    Excluded: those nearer than ``clearance`` [px] to another of the segments ``others`` (m, 2, 2), of which the first e
    are ``ends``, and those that leave the ``image`` (height, width).
    """
    points, normals, where, t = [], [], [], []
    for number, (a, b) in zip(edges.tolist(), ends, strict=True):
        length = float(np.linalg.norm(b - a))
        if length < 2.0 * clearance:
            continue
        count = int(min(MOST_SAMPLES, length))
        along = (b - a) / length
        own = (np.arange(count) + 0.5) * (length / count) - 0.5 * length
        points.append(0.5 * (a + b) + own[:, None] * along)
        normals.append(np.tile([-along[1], along[0]], (count, 1)))
        where.append(np.full(count, number))
        t.append(own)
    at = np.arange(-half, half + 0.5 * STEP, STEP)
    if not points:
        return Profiles(np.empty(0, np.int64), np.empty(0), np.empty((0, len(at))), at)
    place, normal, edge = np.concatenate(points), np.concatenate(normals), np.concatenate(where)
    height, width = image.shape
    room = half + REACH + 1.0
    inside = ((place >= room) & (place <= np.array([width, height]) - 1.0 - room)).all(axis=1)
    distances = segment_distances(place, others)
    own_row = {number: k for k, number in enumerate(edges.tolist())}
    distances[np.arange(len(place)), [own_row[number] for number in edge.tolist()]] = np.inf
    keep = inside & (distances.min(axis=1) >= clearance)
    place, normal, edge, along_t = place[keep], normal[keep], edge[keep], np.concatenate(t)[keep]
    wide = np.arange(-half - REACH, half + REACH + 0.5 * STEP, STEP)
    samples = place[:, None] + wide[None, :, None] * normal[:, None]
    levels = (
        cv2.remap(image, samples[..., 0].astype(np.float32), samples[..., 1].astype(np.float32), cv2.INTER_LINEAR)
        if len(place)
        else np.empty((0, len(wide)))
    )
    taps = np.arange(-REACH, REACH + 0.5 * STEP, STEP)
    kernel = taps * np.exp(-0.5 * (taps / SMOOTH) ** 2)
    kernel /= (kernel * taps).sum()
    windows = np.lib.stride_tricks.sliding_window_view(levels, len(taps), axis=1)
    return Profiles(edge, along_t, (windows @ kernel).astype(np.float64), at)


def segment_distances(points: FloatArray, segments: FloatArray) -> FloatArray:
    """Distances (p, m) [px] of points (p, 2) to segments (m, 2, 2)."""
    a, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    squared = np.maximum((along**2).sum(axis=1), 1e-12)
    s = np.clip(((points[:, None] - a) * along).sum(axis=2) / squared, 0.0, 1.0)
    return np.linalg.norm(points[:, None] - a - s[..., None] * along, axis=2)


def _candidates(profiles: Profiles, least_slope: float) -> tuple[FloatArray, FloatArray]:
    """Offsets (s, CANDIDATES) [px] of the steepest places of each profile, NaN beyond the last, and their slopes."""
    size = np.abs(profiles.slopes)
    inner = size[:, 1:-1]
    peak = (inner > size[:, :-2]) & (inner >= size[:, 2:]) & (inner >= least_slope)
    order = np.argsort(np.where(peak, -inner, 0.0), axis=1)[:, :CANDIDATES]
    rows = np.arange(len(size))[:, None]
    there = peak[rows, order]
    left, here, right = size[rows, order], size[rows, order + 1], size[rows, order + 2]
    bend = left - 2.0 * here + right
    shift = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, -1.0), 0.0)
    offsets = profiles.at[order + 1] + STEP * np.clip(shift, -0.5, 0.5)
    slopes = profiles.slopes[rows, order + 1]
    return np.where(there, offsets, np.nan), np.where(there, slopes, 0.0)


def measure_lines(
    profiles: Profiles, ends: FloatArray, edges: IntArray, least_slope: float, *, coarse: bool
) -> dict[int, MeasuredLine]:
    """Lines through the steepest places of the ``profiles`` of segments ``ends`` (e, 2, 2), numbered by ``edges`` (e,).

    ``coarse``: the line with most places on it, anywhere in the profiles; else the one nearest to the expected one.
    Edges without a line of one polarity are excluded.
    """
    offsets, slopes = _candidates(profiles, least_slope)
    lines = {}
    for number, (a, b) in zip(edges.tolist(), ends, strict=True):
        own = profiles.edge == number
        if int(own.sum()) < LEAST_SAMPLES:
            continue
        half = 0.5 * float(np.linalg.norm(b - a))
        reach = float(profiles.at[-1]) if coarse else 0.0
        fits = np.zeros((2, 7))
        places = plain(EdgePlaces(profiles.t[own], offsets[own], slopes[own]))
        for row, sign in enumerate((-1.0, 1.0)):
            fit_line(places, sign, half, reach, fits[row])
        best = fits[int(fits[1, 0] > fits[0, 0])]
        if best[0] < LEAST_SHARE * own.sum():
            continue
        along = (b - a) / (2.0 * half)
        lines[number] = MeasuredLine(
            0.5 * (a + b),
            along,
            np.array([-along[1], along[0]]),
            float(best[1]),
            float(best[2]),
            best[[3, 4, 4, 5]].reshape(2, 2),
            (float(profiles.t[own].min()), float(profiles.t[own].max())),
        )
    return lines


class EdgePlaces(NamedTuple):
    """Steep places of n profiles across a segment, c of each: ``t`` (n,) [px] along it, ``offsets`` (n, c) [px] from
    it, NaN where there are fewer, and ``slopes`` (n, c) there.
    """

    t: FloatArray
    offsets: FloatArray
    slopes: FloatArray


@kernel
def fit_line(places: Fields, sign: float, half: float, reach: float, found: FloatArray) -> None:
    """Line through those of the ``places`` (the fields of `EdgePlaces`) whose slopes have ``sign``. Writes to ``found``
    (7,): number of profiles with a place on it (0: there is no line), offset, tilt, their covariance (1 1, 1 2, 2 2)
    [px²] and the places' rms distance from it.

    Places are weighted by their squared slopes. The search starts at the line with most places within ``reach``, or at
    0 if reach is 0; ``half``: half the segment's length.
    """
    t, offsets, slopes = places
    n, c = offsets.shape
    a, b, gate = 0.0, 0.0, 1.5
    found[:] = 0.0
    if reach > 0.0:
        gate, most = 2.0, -1.0
        count = int(reach)
        for i in range(-count, count + 1):
            for j in range(-(count // 2), count // 2 + 1):
                score = -1e-3 * abs(i)
                for k in range(n):
                    nearest = 1.5
                    for m in range(c):
                        if slopes[k, m] * sign > 0.0:
                            nearest = min(nearest, abs(offsets[k, m] - i - j * t[k] / half))
                    score += 1.5 - nearest
                if score > most:
                    most, a, b = score, float(i), j / half
    for _ in range(6):
        on, sw, st, stt, sy, sty, syy = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            away, weight = np.inf, 0.0
            for m in range(c):
                if slopes[k, m] * sign > 0.0 and abs(offsets[k, m] - a - b * t[k]) < abs(away):
                    away, weight = offsets[k, m] - a - b * t[k], slopes[k, m] ** 2
            if abs(away) <= gate:
                on += 1
                sw += weight
                st += weight * t[k]
                stt += weight * t[k] * t[k]
                sy += weight * away
                sty += weight * t[k] * away
                syy += weight * away * away
        determinant = sw * stt - st * st
        if on < LEAST_SAMPLES or determinant <= 0.0:
            found[0] = 0.0
            return
        da, db = (stt * sy - st * sty) / determinant, (sw * sty - st * sy) / determinant
        a, b = a + da, b + db
        unit = max(0.0, syy - da * sy - db * sty) / (on - 2)  # of a place with weight 1
        variance = unit * on / sw
        gate = min(gate, max(LEAST_OFF_PX, OFF_LINE * np.sqrt(variance)))
        found[0], found[1], found[2] = on, a, b
        found[3] = INTERPOLATION * unit * stt / determinant
        found[4] = -INTERPOLATION * unit * st / determinant
        found[5] = INTERPOLATION * unit * sw / determinant
        found[6] = np.sqrt(variance)
    if found[6] > MOST_SCATTER_PX:
        found[0] = 0.0


def compile_kernels() -> None:
    """Compile the kernels of the measurement, or load them from the cache."""
    compile_for(
        fit_line,
        fields(given(FLOAT, 1), given(FLOAT, 2), given(FLOAT, 2)),
        FLOAT,
        FLOAT,
        FLOAT,
        written(FLOAT, 1),
    )


def crossing(lines: list[MeasuredLine], floor_px: float) -> tuple[FloatArray, FloatArray, float]:
    """Point (2,) [px] that is nearest to two or more lines, its covariance (2, 2), and the lines' squared distances
    from it in their variances, with ``floor_px`` [px] of each. Parallel lines: a covariance without bound.
    """
    equations = [line.equation() for line in lines]
    normals, rhs = np.array([n for n, _ in equations]), np.array([c for _, c in equations])
    point = np.linalg.lstsq(normals, rhs, rcond=None)[0]
    for _ in range(2):
        variances = np.array([line.variance(point) + floor_px**2 for line in lines])
        information = (normals / variances[:, None]).T @ normals
        values, vectors = np.linalg.eigh(information)
        if not values[0] > 1e-12 * values[1]:
            return point, np.full((2, 2), np.inf), 0.0
        covariance: FloatArray = vectors / values @ vectors.T
        point = covariance @ ((normals / variances[:, None]).T @ rhs)
    left = normals @ point - rhs
    return point, covariance, float((left**2 / variances).sum())
