"""Detector of the straight edges of a part without markers: its vertices, as intersections of edges measured sub-pixel.

The expected edges follow from a prior, the previous frame, or the start in the part file; all are poses of the part, so
hidden edges are not searched. The reported positions are measured in every frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.messages.text_files import complete, toml_of
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import Fields, kernel, plain
from stereoservo.ports.devices import CameraObservation, DetectorDescription, DriverContext, DriverError, Frame, Prior
from stereoservo_drivers.detectors.kernel_types import FLOAT, compile_for, fields, given, written
from stereoservo_drivers.frame_images import sized_image
from stereoservo_drivers.options import decode_options, invalid

STEP = 0.5
"""Sampling interval of profiles [px]."""
SMOOTH = 1.0
REACH = 3.0
"""Half width of the smoothing filter [px]."""
MOST_SAMPLES = 120
"""Largest number of profiles per edge."""
LEAST_SAMPLES = 8
"""Least number of places on a line; with fewer it is not measured."""
LEAST_POINT_SHARE = 0.65
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
        if best[0] < LEAST_POINT_SHARE * own.sum():
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
        fit_line, fields(given(FLOAT, 1), given(FLOAT, 2), given(FLOAT, 2)), FLOAT, FLOAT, FLOAT, written(FLOAT, 1)
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


# -- detector ------------------------------------------------------------------------------------------


Positive = Annotated[float, Meta(gt=0)]
FINE_PX = 4.0
"""Half the width of the last search, and least distance of other edges [px]."""
NEAR_PX = 6.0
"""Least half width of a search around an expected edge [px]."""
SETTLED_PX = 0.3
"""Motion of the vertices [px] below which the last search counts as converged."""
PRIOR_PX = 4.0
"""Rms error [px] of a prior with respect to the part's shape, in addition to its own standard deviations."""
LEAST_EDGES = 6
"""Number of edges that must agree on a pose: they give twelve distances for its seven parameters."""
LEAST_SHARE, LEAST_OF_ALL = 0.6, 0.4
"""Least shares of the agreeing edges, among visible ones that are long and free enough to be searched: of those where
the image has steps, and of all.
"""
DISAGREE = 5.0
"""Number of standard deviations, per line, beyond which lines do not meet in one point."""


class EdgeOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[camera.detector_options]`` of the detector ``edges``."""

    part: str
    """Part file, relative to the cell file's directory."""
    search_px: Annotated[float, Meta(ge=4, le=60)] = 16.0
    """Largest distance of edges from their place in the start [px]."""
    min_slope: Positive = 2.5
    """Least steepness of an edge [grey levels/px]; a step of 10 levels in a sharp picture has 3."""
    max_residual_px: Positive = 1.0
    """Largest distance of an edge from the part's shape [px]: lens distortion, manufacturing tolerances."""
    max_sigma_px: Positive = 0.5
    """Vertices with a larger standard deviation are not reported: near-parallel or short edges."""
    max_gap_s: Positive = 0.5
    """Age above which a frame is not used as start for the next."""
    max_prior_age_s: Positive = 0.25
    floor_px: Annotated[float, Meta(ge=0)] = 0.02
    """Systematic standard deviation [px] of a line, part of every covariance."""


@dataclass(frozen=True, eq=False)
class _FoundPart:
    """A frame in which the part was found."""

    seq: int
    t_ns: int
    size: tuple[int, int]
    pose: PartPose
    vertices: FloatArray


@dataclass(frozen=True, eq=False)
class Vertices:
    """Vertices found: ``rows`` (k,) of the part, ``pixels`` (k, 2), ``covariances`` (k, 2, 2); and the reasons why
    other visible ones are not, by marker id.
    """

    rows: list[int]
    pixels: list[FloatArray]
    covariances: list[FloatArray]
    refused: dict[int, str]


class EdgeDetector:
    """Detects the vertices of one part by its edges in one camera. One thread at a time.

    It stores the part's pose in the last frame, and drops it if the sequence goes back or is interrupted: the same
    *series* of frames and priors yields the same observations. Nothing is reported unless most of the visible edges,
    and at least six, agree on a pose of the part. ``refused``: reasons why vertices are not reported in the newest
    frame.

    Raises DriverError: ``option``, ``part`` at construction; ``image_format``, ``image_size`` by :meth:`detect`.
    Content never raises.
    """

    def __init__(self, options: Mapping[str, Any], context: DriverContext) -> None:
        self.options = decode_options(EdgeOptions, options, f"detector of camera {context.camera!r}")
        self.camera = context.camera
        self._part, self._start_rows, self._start_pixels = load_part(
            context.cell_dir / self.options.part, context.camera
        )
        compile_kernels()
        self._place = {marker: k for k, marker in enumerate(self._part.ids.tolist())}
        self._seen: _FoundPart | None = None
        self.refused: dict[int, str] = {}

    def describe(self) -> DetectorDescription:
        """The ids of the part's vertices."""
        return DetectorDescription("edges", tuple(self._part.ids.tolist()), self.options.floor_px)

    def detect(self, frame: Frame, prior: Prior | None) -> CameraObservation:
        """Vertices in ``frame``. Raises DriverError (``image_format``, ``image_size``); never on content."""
        raw = sized_image(frame, self.camera, None)
        image, size = raw.astype(np.float32), (raw.shape[1], raw.shape[0])
        found: Vertices | None = None
        for pose, widths in self._expectations(frame, prior, size):
            registered = self._register(image, pose, widths)
            if registered is None:
                continue
            pose, lines = registered
            found = self._vertices(pose, lines, size)
            self._seen = _FoundPart(frame.seq, frame.t_shutter_ns, size, pose, pose.pixels(self._part.points))
            break
        if found is None:
            found = Vertices([], [], [], {-1: "no pose of the part explains enough edges"})
            self._seen = None
        self.refused = found.refused
        return self._observation(frame, found)

    # -- where the part is expected ----------------------------------------------------------------------------

    def _expectations(
        self, frame: Frame, prior: Prior | None, size: tuple[int, int]
    ) -> Iterator[tuple[PartPose, tuple[float, ...]]]:
        """Poses to try, each with half the widths [px] of its searches, the likeliest first."""
        seen = self._seen
        if seen is not None:
            gap_s = (frame.t_shutter_ns - seen.t_ns) * 1e-9
            if frame.seq <= seen.seq or seen.size != size or not 0.0 <= gap_s <= self.options.max_gap_s:
                seen = None
        known = None if seen is None else seen.pose
        expected = None if prior is None else self._by_prior(frame, prior, size, known)
        if expected is not None:
            yield expected
        if seen is not None:
            yield seen.pose, (self.options.search_px, NEAR_PX)
        start = pose_from_pixels(self._part.points[self._start_rows], self._start_pixels, size, None)
        if start is not None:
            yield start[0], (self.options.search_px, 0.5 * self.options.search_px, NEAR_PX)

    def _by_prior(
        self, frame: Frame, prior: Prior, size: tuple[int, int], known: PartPose | None
    ) -> tuple[PartPose, tuple[float, ...]] | None:
        dt_s = (frame.t_shutter_ns - prior.t_ns) * 1e-9
        if abs(dt_s) > self.options.max_prior_age_s:
            return None
        pixels = prior.pixels + dt_s * prior.velocities
        variances = 0.5 * np.trace(prior.covariances, axis1=1, axis2=2)
        good = [
            k
            for k, marker in enumerate(prior.ids.tolist())
            if marker in self._place and np.isfinite(pixels[k]).all() and variances[k] >= 0.0
        ]
        if len(good) < LEAST_START:
            return None
        rows = [self._place[marker] for marker in prior.ids[good].tolist()]
        fitted = pose_from_pixels(self._part.points[rows], pixels[good], size, known)
        sigma = float(np.sqrt(variances[good].mean()))
        if fitted is None or fitted[1] > PRIOR_PX + 2.0 * sigma:
            return None
        return fitted[0], (min(self.options.search_px, max(FINE_PX, 3.0 + 3.0 * sigma)),)

    # -- the part in the image ---------------------------------------------------------------------------------

    def _register(
        self, image: FloatArray, pose: PartPose, widths: tuple[float, ...]
    ) -> tuple[PartPose, dict[int, MeasuredLine]] | None:
        """The part's pose from its edges, and the edges that agree with it; None if there are too few."""
        for half in widths:
            lines, *_ = self._lines(image, pose, half, coarse=True)
            better = pose_from_lines(self._part, pose, lines, max(1.0, 0.2 * half)) if len(lines) > 2 else None
            if better is None:
                return None
            pose = better
        for _ in range(2):
            lines, tried, steep = self._lines(image, pose, FINE_PX, coarse=False)
            better = pose_from_lines(self._part, pose, lines, 0.5) if len(lines) >= LEAST_EDGES else None
            if better is None:
                return None
            moved = float(np.abs(better.pixels(self._part.points) - pose.pixels(self._part.points)).max())
            pose = better
            if moved < SETTLED_PX:
                break
        off = np.abs(line_distances(self._part, pose, lines)[0]).max(axis=1)
        kept = {
            number: line
            for (number, line), px in zip(lines.items(), off.tolist(), strict=True)
            if px <= self.options.max_residual_px
        }
        needed = max(LEAST_EDGES, LEAST_SHARE * steep, LEAST_OF_ALL * tried)
        return (pose, kept) if len(kept) >= needed else None

    def _lines(
        self, image: FloatArray, pose: PartPose, half: float, *, coarse: bool
    ) -> tuple[dict[int, MeasuredLine], int, int]:
        """Lines near the visible edges by number, the number of edges long and free enough to be searched, and the
        number of these where the image has steps: between two faces of equal brightness there is no step.
        """
        numbers, ends = segments_in_sight(self._part, pose)
        good = np.isfinite(ends).all(axis=(1, 2))
        numbers, ends = numbers[good], ends[good]
        profiles = take_profiles(image, ends, numbers, ends, half, FINE_PX)
        lines = measure_lines(profiles, ends, numbers, self.options.min_slope, coarse=coarse)
        steps = np.abs(profiles.slopes).max(axis=1, initial=0.0) >= self.options.min_slope
        steep = sum(bool(steps[profiles.edge == number].mean() > 0.5) for number in np.unique(profiles.edge))
        return lines, len(np.unique(profiles.edge)), steep

    def _vertices(self, pose: PartPose, lines: dict[int, MeasuredLine], size: tuple[int, int]) -> Vertices:
        found = Vertices([], [], [], {})
        expected = pose.pixels(self._part.points)
        seen = pose.in_sight(self._part)
        width, height = size
        for row, marker in enumerate(self._part.ids.tolist()):
            own = np.flatnonzero((self._part.edges == row).any(axis=1))
            if not seen[own].any():
                continue
            there = [lines[number] for number in own.tolist() if number in lines]
            if len(there) < 2:
                found.refused[marker] = f"{len(there)} of its {int(seen[own].sum())} edges in sight are found"
                continue
            point, covariance, squares = crossing(there, self.options.floor_px)
            sigma = float(np.sqrt(np.trace(covariance)))
            away = float(np.linalg.norm(point - expected[row]))
            if not sigma <= self.options.max_sigma_px:
                found.refused[marker] = (
                    f"its edges leave it uncertain by {sigma:.2f} px, {self.options.max_sigma_px:g} px is allowed: "
                    "they are near-parallel, short or far from it"
                )
            elif squares > DISAGREE**2 * (len(there) - 1):
                found.refused[marker] = f"its {len(there)} edges do not meet in one point"
            elif away > 1.5 * self.options.max_residual_px:
                found.refused[marker] = f"its edges meet {away:.1f} px from where the part's shape has it"
            elif not (0.0 <= point[0] <= width - 1.0 and 0.0 <= point[1] <= height - 1.0):
                found.refused[marker] = "it is outside of the image"
            else:
                found.rows.append(row)
                found.pixels.append(point)
                found.covariances.append(covariance)
        return found

    def _observation(self, frame: Frame, found: Vertices) -> CameraObservation:
        ids = self._part.ids[np.array(found.rows, dtype=np.int64)]
        order = np.argsort(ids)
        pixels = np.array(found.pixels).reshape(-1, 2)[order]
        covariances = np.array(found.covariances).reshape(-1, 2, 2)[order]
        return CameraObservation(
            self.camera,
            frame.seq,
            frame.t_shutter_ns,
            frame.t_received_ns,
            ids[order],
            np.ascontiguousarray(pixels),
            np.ascontiguousarray(0.5 * (covariances + covariances.transpose(0, 2, 1))),
        )


# -- pose of the part ----------------------------------------------------------------------------------------
# Pose of a part in front of a pinhole camera of unknown focal length, from pixels of its vertices or from measured
# lines.
#
# It only determines which edges are visible, and where approximately; the reported results are the measured lines. It
# assumes square pixels, a principal point at the image's centre, and a focal length near the image's width.


FOCAL_WIDTHS = 1.25
"""Initial focal length, in widths of the image."""
FOCAL_SIGMA = 0.4
"""Standard deviation of its logarithm."""
ITERATIONS = 12
CONVERGED = 1e-6


@dataclass(frozen=True, eq=False)
class PartPose:
    """``R`` (3, 3), ``t`` (3,) from the part to the camera, ``focal`` [px], ``centre`` (2,) [px] of the image."""

    R: FloatArray
    t: FloatArray
    focal: float
    centre: FloatArray

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (n, 2) of points (n, 3) of the part; NaN behind the camera."""
        X = points @ self.R.T + self.t
        depth = np.where(X[:, 2:] > 1e-6, X[:, 2:], np.nan)
        pixels: FloatArray = self.focal * X[:, :2] / depth + self.centre
        return pixels

    def in_sight(self, part: Part) -> BoolArray:
        """Which edges of the part (e,) border a face that is turned to the camera."""
        eye = -self.R.T @ self.t
        facing = (part.normals @ eye - part.offsets > 0.0).astype(np.float64)
        seen: BoolArray = part.sides @ facing > 0.0
        return seen

    def slopes(self, points: FloatArray) -> FloatArray:
        """Derivatives (n, 2, 7) of the pixels by a turn about the part's centroid, a shift, and the focal length's
        logarithm.
        """
        turned = points @ self.R.T
        X = turned + self.t
        z = X[:, 2]
        by_point = np.zeros((len(points), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = self.focal / z
        by_point[:, :, 2] = -self.focal * X[:, :2] / z[:, None] ** 2
        turn = np.zeros((len(points), 3, 3))
        turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
        turn -= turn.transpose(0, 2, 1)
        J = np.empty((len(points), 2, 7))
        J[:, :, :3], J[:, :, 3:6] = by_point @ turn, by_point
        J[:, :, 6] = self.focal * X[:, :2] / z[:, None]
        return J

    def stepped(self, step: FloatArray) -> PartPose:
        """The pose after a step (7,), with the parameters of `slopes`."""
        turn = np.asarray(cv2.Rodrigues(step[:3].reshape(3, 1))[0], dtype=np.float64)
        return replace(
            self, R=turn @ self.R, t=self.t + step[3:6], focal=self.focal * float(np.exp(np.clip(step[6], -1, 1)))
        )


def pose_from_pixels(
    points: FloatArray, pixels: FloatArray, size: tuple[int, int], start: PartPose | None
) -> tuple[PartPose, float] | None:
    """Pose that projects points (n, 3) to pixels (n, 2) of an image of ``size`` (width, height), n >= 4, and the
    remaining rms distance [px]; from ``start`` if given. None if no pose with all points in front of the camera is
    found.
    """
    width, height = size
    centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
    starts = [] if start is None else [start]
    focal = FOCAL_WIDTHS * width
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    try:
        found, turn, shift = cv2.solvePnP(
            points.reshape(-1, 1, 3), pixels.reshape(-1, 1, 2), K, None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        found = False
    if found:
        starts.append(PartPose(np.asarray(cv2.Rodrigues(turn)[0]), np.ravel(shift), focal, centre))
    best: tuple[PartPose, float] | None = None
    for pose in starts:
        fitted = _descend(pose, points, pixels)
        if fitted is not None and (best is None or fitted[1] < best[1]):
            best = fitted
    return best


def _descend(pose: PartPose, points: FloatArray, pixels: FloatArray) -> tuple[PartPose, float] | None:
    for _ in range(ITERATIONS):
        left = pixels - pose.pixels(points)
        if not np.isfinite(left).all():
            return None
        step = _solve(pose, pose.slopes(points).reshape(-1, 7), left.ravel(), np.ones(left.size), 1.0)
        pose = pose.stepped(step)
        if float(np.abs(step).max()) < CONVERGED:
            break
    left = pixels - pose.pixels(points)
    return (pose, float(np.sqrt((left**2).sum(axis=1).mean()))) if np.isfinite(left).all() else None


def _solve(pose: PartPose, J: FloatArray, left: FloatArray, weights: FloatArray, sigma: float) -> FloatArray:
    """Step (7,) of weighted least squares, with the prior of the focal length."""
    expected = np.log(FOCAL_WIDTHS * (2.0 * pose.centre[0] + 1.0) / pose.focal) / FOCAL_SIGMA * sigma
    A = np.concatenate([J * weights[:, None], np.eye(7)[6:] * sigma / FOCAL_SIGMA])
    step: FloatArray = np.linalg.lstsq(A, np.append(left * weights, expected), rcond=1e-9)[0]
    return step


def line_distances(part: Part, pose: PartPose, lines: dict[int, MeasuredLine]) -> tuple[FloatArray, FloatArray]:
    """Distances (n, 2) [px] of the ends of n measured lines from the part's edges in the pose, and their derivatives
    (n, 2, 7) by the pose, as in `PartPose.slopes`.
    """
    rows = np.array(list(lines), dtype=np.int64)
    a, b = part.points[part.edges[rows, 0]], part.points[part.edges[rows, 1]]
    u, v = pose.pixels(a), pose.pixels(b)
    Ju, Jv = pose.slopes(a), pose.slopes(b)
    along = v - u
    squared = np.maximum((along**2).sum(axis=1), 1e-12)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.sqrt(squared)[:, None]
    ends = np.array([[line.at(line.span[0]), line.at(line.span[1])] for line in lines.values()])
    s = ((ends - u[:, None]) * along[:, None]).sum(axis=2) / squared[:, None]
    distances = ((ends - u[:, None]) * normal[:, None]).sum(axis=2)
    by_pose = (1.0 - s)[..., None] * np.einsum("ni,nij->nj", normal, Ju)[:, None] + s[..., None] * np.einsum(
        "ni,nij->nj", normal, Jv
    )[:, None]
    return distances, by_pose


def pose_from_lines(part: Part, pose: PartPose, lines: dict[int, MeasuredLine], scale_px: float) -> PartPose | None:
    """Pose of least distance from measured lines, with little weight on distant ones (relative to ``scale_px``); None
    if the part would be behind the camera.
    """
    for _ in range(ITERATIONS):
        distances, J = line_distances(part, pose, lines)
        if not np.isfinite(distances).all():
            return None
        worst = np.abs(distances).max(axis=1, keepdims=True)
        weights = np.sqrt(1.0 / (1.0 + (worst / scale_px) ** 2)) * np.ones((1, 2))
        step = _solve(pose, J.reshape(-1, 7), distances.ravel(), weights.ravel(), scale_px)
        # A step beyond a quarter turn, or the part's distance, is not a refinement.
        step = step / max(1.0, float(np.abs(step[:3]).max()) / 0.3, float(np.abs(step[3:6]).max()) / (0.3 * pose.t[2]))
        pose = pose.stepped(step)
        if float(np.abs(step).max()) < CONVERGED:
            break
    return pose if np.isfinite(pose.pixels(part.points)).all() else None


def segments_in_sight(part: Part, pose: PartPose) -> tuple[IntArray, FloatArray]:
    """Numbers (k,) of the visible edges and their ends (k, 2, 2) [px]."""
    rows = np.flatnonzero(pose.in_sight(part))
    return rows, pose.pixels(part.points)[part.edges[rows]]


# -- files of parts ------------------------------------------------------------------------------------------
# Part files: a convex part without markers, as vertices with ids and faces, and its initial place in the pictures.


FLAT = 1e-3
"""Largest distance of a face's vertices from its plane, and of others beyond it, as a share of the part's size."""
LEAST_ANGLE = float(np.deg2rad(10.0))
"""Least angle, in a vertex, of the two edges with the largest angle."""
LEAST_START = 4
"""Number of vertices required in a start: their pixels then determine a pose."""


class PartVertex(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vertex: its marker ``id`` and its position on the part, in any unit of length."""

    id: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    at: tuple[float, float, float]


class PartFace(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A plane face: the ids of its vertices along its border, in either direction."""

    vertices: Annotated[tuple[int, ...], Meta(min_length=3, max_length=64)]


class PartFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part file. ``start``: by camera, raw pixels of four or more vertices in a picture of the part at its start."""

    vertex: Annotated[tuple[PartVertex, ...], Meta(min_length=4, max_length=200)]
    face: Annotated[tuple[PartFace, ...], Meta(min_length=1, max_length=200)]
    start: dict[str, dict[int, tuple[float, float]]]
    schema: Annotated[int, Meta(ge=1, le=1)] = 1


@dataclass(frozen=True, eq=False)
class Part:
    """A part: ``ids`` (n,), ``points`` (n, 3) about their centroid in units of their spread, ``normals`` (f, 3) outward
    and ``offsets`` (f,) of its faces, ``edges`` (e, 2) as rows of points, ``sides`` (e, f): which faces meet there.
    """

    ids: IntArray
    points: FloatArray
    normals: FloatArray
    offsets: FloatArray
    edges: IntArray
    sides: FloatArray


def load_part(path: Path, camera: str) -> tuple[Part, IntArray, FloatArray]:
    """The part of a file, and of the camera's start the rows (k,) of its vertices and their pixels (k, 2).

    Raises DriverError (``part``), which names the file, the key, the value and the valid ones.
    """

    def refuse(text: str) -> DriverError:
        return DriverError("part", f"{path}: {text}", path=str(path))

    try:
        tree: dict[str, Any] = complete(toml_of(path.read_bytes()))
        file = msgspec.convert(tree, PartFile, strict=True, str_keys=True)
    except OSError as error:
        raise refuse(f"the part file cannot be read: {error.strerror or error}") from error
    except msgspec.ValidationError as error:
        raise refuse(invalid(PartFile, tree, error)) from error
    except ValueError as error:
        raise refuse(f"no TOML: {error}") from error
    part = make_part(file, refuse)
    return part, *_start_of(file, part, camera, refuse)


def make_part(file: PartFile, refuse: Any = ValueError) -> Part:
    """The part of decoded vertices and faces. Raises the exception that ``refuse`` makes from a text."""
    ids = [vertex.id for vertex in file.vertex]
    if len(set(ids)) < len(ids):
        twice = next(marker for marker in ids if ids.count(marker) > 1)
        raise refuse(f"vertex {twice} is there twice; every vertex has an id of its own")
    points = np.array([vertex.at for vertex in file.vertex])
    if not np.isfinite(points).all():
        raise refuse("a vertex is not finite")
    points = points - points.mean(axis=0)
    size = float(np.sqrt((points**2).sum(axis=1).mean()))
    if not np.linalg.svd(points, compute_uv=False)[-1] > FLAT * size:
        raise refuse("all vertices lie in one plane; a solid part is needed")
    points = points / size
    normals, offsets, edges = [], [], dict[tuple[int, int], list[int]]()
    for k, face in enumerate(file.face):
        unknown = [marker for marker in face.vertices if marker not in ids]
        if unknown or len(set(face.vertices)) < len(face.vertices):
            raise refuse(
                f"face {k + 1} = {list(face.vertices)}: "
                + (f"no vertex {unknown[0]}" if unknown else "a vertex is there twice")
                + f"; vertices are {ids}"
            )
        rows = [ids.index(marker) for marker in face.vertices]
        normal, offset = _face_plane(points, rows, f"face {k + 1} = {list(face.vertices)}", ids, refuse)
        normals.append(normal)
        offsets.append(offset)
        for a, b in zip(rows, [*rows[1:], rows[0]], strict=True):
            edges.setdefault((min(a, b), max(a, b)), []).append(k)
    for (a, b), faces in edges.items():
        if len(faces) > 2:
            raise refuse(f"{len(faces)} faces meet in the edge of vertices {ids[a]} and {ids[b]}; two do")
    sides = np.zeros((len(edges), len(normals)))
    for row, faces in enumerate(edges.values()):
        sides[row, faces] = 1.0
    part = Part(np.array(ids, np.int64), points, np.array(normals), np.array(offsets), np.array(list(edges)), sides)
    _require_crossings(part, refuse)
    return part


def _face_plane(
    points: FloatArray, rows: list[int], name: str, ids: list[int], refuse: Any
) -> tuple[FloatArray, float]:
    """Outward unit normal and offset of a face's plane."""
    middle = points[rows].mean(axis=0)
    _, singular, axes = np.linalg.svd(points[rows] - middle)
    if not singular[1] > FLAT:
        raise refuse(f"{name}: its vertices lie on one line")
    normal = axes[2] if axes[2] @ middle > 0.0 else -axes[2]
    off = np.abs((points[rows] - middle) @ normal)
    if off.max() > FLAT:
        raise refuse(f"{name}: vertex {ids[rows[int(off.argmax())]]} is off the plane of the others")
    beyond = (points - middle) @ normal
    if beyond.max() > FLAT:
        raise refuse(
            f"{name}: vertex {ids[int(beyond.argmax())]} lies beyond it; only convex parts are supported: leave out "
            "what is behind, or describe a convex part of it"
        )
    return normal, float(middle @ normal)


def _require_crossings(part: Part, refuse: Any) -> None:
    """Refuse vertices in which no two edges cross at a sufficient angle."""
    for row, marker in enumerate(part.ids.tolist()):
        own = part.edges[(part.edges == row).any(axis=1)]
        if len(own) < 2:
            raise refuse(f"vertex {marker} is in {len(own)} edges; two that cross there are needed")
        along = part.points[own[:, 1]] - part.points[own[:, 0]]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        cosines = np.abs(along @ along.T)
        if not cosines.min() < np.cos(LEAST_ANGLE):
            raise refuse(
                f"vertex {marker}: its edges cross at {np.rad2deg(np.arccos(min(1.0, cosines.min()))):.1f} degrees at "
                f"most, {np.rad2deg(LEAST_ANGLE):.0f} are needed"
            )


def _start_of(file: PartFile, part: Part, camera: str, refuse: Any) -> tuple[IntArray, FloatArray]:
    if camera not in file.start:
        raise refuse(
            f"start.{camera} is missing: pixels of {LEAST_START} vertices or more in a picture of camera {camera!r}; "
            f"given: {', '.join(sorted(file.start)) or 'none'}"
        )
    start, ids = file.start[camera], part.ids.tolist()
    unknown = [marker for marker in start if marker not in ids]
    if unknown:
        raise refuse(f"start.{camera}: no vertex {unknown[0]}; vertices are {ids}")
    if len(start) < LEAST_START:
        raise refuse(f"start.{camera} names {len(start)} vertices; {LEAST_START} or more are needed")
    pixels = np.array(list(start.values()), dtype=np.float64)
    if not np.isfinite(pixels).all():
        raise refuse(f"start.{camera}: a pixel is not finite")
    return np.array([ids.index(marker) for marker in start]), pixels
