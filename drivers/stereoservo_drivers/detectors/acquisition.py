"""Acquisition: search of a whole image for dot-like spots, and their assignment to faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import BoolArray, FloatArray, ImageArray, IntArray
from stereoservo.numerics.compilation import kernel, plain
from stereoservo.ports.devices import Prior
from stereoservo_drivers.detectors.centroids import measure
from stereoservo_drivers.detectors.components import (
    AREA_PX,
    BEYOND,
    BOTTOM,
    FIELDS,
    FIRST,
    LEFT,
    LOPSIDED,
    MAX_WINDOW,
    OK,
    RIGHT,
    ROW,
    SUM_U,
    SUM_V,
    TOP,
    Picture,
    Scratch,
    Sought,
    join_runs,
)
from stereoservo_drivers.detectors.face_fit import whole
from stereoservo_drivers.detectors.kernel_types import (
    BOOL,
    BYTE,
    FLOAT,
    IMAGE,
    INT,
    SCRATCH,
    WORD,
    compile_for,
    fields,
    given,
)
from stereoservo_drivers.detectors.patterns import SearchedFaces, find_faces

SHRINK_FROM = 240
"""Least side of an image [px] that is searched, but not measured, at half its size: a third of the time, half the
noise.
"""
GROW = 7
"""Pixels around a component's bounding box in the window that measures it."""
MIN_FILL = 0.3
"""Least part of its bounding box that a component fills (an ellipse of axes 1:4 on the diagonal: 0.37)."""
MAX_ASPECT = 6.0


@kernel
def noise_level(image):
    """Standard deviation of the noise [grey levels] of an image (h, w), from differences of neighbours on
    some thirty rows.
    """
    counts = np.zeros(256, np.int64)
    rows, columns = image.shape
    for v in range(0, rows, max(1, rows // 30)):
        row = image[v]
        for u in range(columns - 1):
            counts[abs(np.int64(row[u + 1]) - np.int64(row[u]))] += 1
    # the median of |difference| in whole levels, interpolated within its level
    half = 0.5 * counts.sum()
    level = below = 0
    while below + counts[level] < half:
        below += counts[level]
        level += 1
    width, start = (0.5, 0.0) if level == 0 else (1.0, level - 0.5)
    median = start + width * (half - below) / counts[level]
    return median / (0.6745 * np.sqrt(2.0))


@kernel
def _mask_runs(bright, runs):
    """Runs (n, 4) of the pixels of a `Mask`; their number."""
    mask, words, columns, _ = bright
    count = 0
    within = False
    for start in range(0, mask.size, 8):
        if not within and start // 8 < words.size and words[start // 8] == 0:
            continue
        v, u = start // columns, start % columns
        for k in range(start, min(start + 8, mask.size)):
            lit = mask[k] != 0
            if within and (u == 0 or not lit):
                runs[count, BEYOND] = u if u > 0 else columns
                count += 1
                within = False
            if lit and not within:
                runs[count, ROW], runs[count, FIRST] = v, u
                within = True
            u += 1
            if u == columns:
                v, u = v + 1, 0
    if within:
        runs[count, BEYOND] = columns
        count += 1
    return count


class Mask(NamedTuple):
    """The bright ``pixels`` (n,) of an image, not 0, in rows of ``columns``, ``shrink`` times smaller than the image;
    ``words``: the same pixels, eight in each.
    """

    pixels: npt.NDArray[np.uint8]
    words: npt.NDArray[np.uint64]
    columns: int
    shrink: int


class SpotGates(NamedTuple):
    """Requirements for a spot: at least ``contrast`` [grey levels], at most ``lopsided``; and the largest number of
    spots (``most``).
    """

    contrast: int
    lopsided: float
    most: int


@kernel
def _spots(picture, mask, gates, scratch):
    """Measurements (m, FIELDS) of the whole spots of a `Picture` among the components of a `Mask`, at most as many as
    required, the roundest first. All four arguments are the fields of their records.
    """
    picture, mask, gates, scratch = Picture(*picture), Mask(*mask), SpotGates(*gates), Scratch(*scratch)
    size, columns, shrink = mask.pixels.size, mask.columns, mask.shrink
    own = np.empty((size // 2 + size // columns + 1, 4), np.int32)
    totals = join_runs(own, _mask_runs(mask, own), np.int64(1))
    found = np.empty((totals.shape[0], FIELDS))
    count = 0
    for c in range(totals.shape[0]):
        total = totals[c]
        left, top, area = total[LEFT], total[TOP], total[AREA_PX]
        width, height = total[RIGHT] + 1 - left, total[BOTTOM] + 1 - top
        longer, shorter = max(width, height), min(width, height)
        if area < 6 // shrink**2 + 1 or shrink * longer > MAX_WINDOW - 2 * GROW:
            continue
        if longer > MAX_ASPECT * shorter or area < MIN_FILL * width * height:
            continue
        window = (
            shrink * left - GROW,
            shrink * top - GROW,
            shrink * (left + width) + GROW,
            shrink * (top + height) + GROW,
        )
        sought = Sought(
            shrink * (total[SUM_U] / area) + 0.5 * (shrink - 1),
            shrink * (total[SUM_V] / area) + 0.5 * (shrink - 1),
            gates.contrast,
            np.int64(5),
        )
        status = measure(picture, window, sought, scratch, found[count])
        if status == OK and whole(found[count], gates.lopsided):
            count += 1
    return _roundest(found[:count], gates.most)


@kernel
def _roundest(found, most):
    """The first ``most`` rows of ``found`` (m, FIELDS) by their LOPSIDED, without duplicates."""
    n = found.shape[0]
    order = np.empty(n, np.int64)
    for i in range(n):
        k = i
        while k > 0 and found[order[k - 1], LOPSIDED] > found[i, LOPSIDED]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    spots = np.empty((min(n, most), FIELDS))
    count = 0
    for i in range(min(n, 2 * most)):
        spot = found[order[i]]
        # one spot may be measured from two components
        twin = count == most
        for k in range(i):
            other = found[order[k]]
            twin = twin or (spot[0] - other[0]) ** 2 + (spot[1] - other[1]) ** 2 < 4.0
        if not twin:
            for j in range(FIELDS):
                spots[count, j] = spot[j]
            count += 1
    return spots[:count]


def find_spots(
    image: ImageArray, dark: bool, min_contrast: int, lopsided: float, most: int, scratch: Scratch
) -> FloatArray:
    """Measurements (m, FIELDS) of the whole, elliptical spots of an image (h, w), at most ``most`` of them.

    A pixel is bright when it exceeds the mean of its surroundings (a tenth of the image's width, so that
    gradients do not matter) by half the least contrast or four times the noise.
    """
    bright = cv2.bitwise_not(image) if dark else image
    shrink = 2 if min(image.shape) >= SHRINK_FROM else 1
    if shrink == 2:
        even = bright[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
        bright = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    side = max(31 // shrink, bright.shape[1] // 10) | 1
    offset = max(0.4 * min_contrast, 4.0 * noise_level(bright))
    mean = cv2.blur(bright, (side, side), borderType=cv2.BORDER_REPLICATE)
    mask = cv2.compare(bright, cv2.add(mean, offset), cv2.CMP_GT).ravel()
    words = mask[: mask.size // 8 * 8].view(np.uint64)
    spots: FloatArray = _spots(
        (image, dark), (mask, words, bright.shape[1], shrink), (min_contrast, lopsided, most), plain(scratch)
    )
    return spots


def compile_kernels() -> None:
    """Compile the kernels that the detector calls, or load them from the cache."""
    compile_for(noise_level, IMAGE)
    compile_for(
        _spots, fields(IMAGE, BOOL), fields(given(BYTE, 1), given(WORD, 1), INT, INT), fields(INT, FLOAT, INT), SCRATCH
    )


Region = tuple[int, int, int, int]
"""Left, top, right, bottom [px]; right and bottom are the first beyond."""

REACH_PX = 1.5
"""Largest distance of a dot from the homography of four others [px]."""
MOST_COPIES = 3
LOST_SPEED_PX_S = 200.0
"""Standard deviation of a speed that is not in the prior [px/s]."""
NEAR = 9.0
"""Mean squared distance [prior variances] within which a copy of a face may be the expected one (chi-square of two
degrees of freedom: 0.99).
"""
FARTHER = 20.0
"""Least additional distance [prior variances] of the other copies."""
MARGIN_PX = 48.0
"""Margin around expected dots [px]: their size, and background for comparison."""
WORTH = 0.5
"""Share of a picture above which a region is not searched separately first."""


@dataclass(frozen=True)
class Expectation:
    """Expected dots of a face: ``rows`` (k,) of its pattern, ``pixels`` (k, 2), ``covariances`` (k, 2, 2)."""

    rows: IntArray
    pixels: FloatArray
    covariances: FloatArray

    def squared_distance(self, places: FloatArray, found: BoolArray) -> float:
        """Mean squared Mahalanobis distance of the dots ``found`` (7,) at ``places`` (7, 2); infinite without any."""
        common = found[self.rows]
        if not common.any():
            return np.inf
        off = places[self.rows[common]] - self.pixels[common]
        return float(np.mean(np.sum(off * np.linalg.solve(self.covariances[common], off[..., None])[..., 0], 1)))


def expectations(prior: Prior, t_ns: int, max_age_s: float, every_id: IntArray) -> list[Expectation | None]:
    """Expectation of each face of ``every_id`` (f, 7) at ``t_ns`` from a prior of any age; None if it is unusable.

    It is extrapolated by its velocities for at most ``max_age_s``, and its covariance grows with its whole age.
    """
    age_s = (t_ns - prior.t_ns) * 1e-9
    pixels = prior.pixels + prior.velocities * float(np.clip(age_s, -max_age_s, max_age_s))
    covariances = prior.covariances + ((LOST_SPEED_PX_S * age_s) ** 2 + 1.0) * np.eye(2)
    usable = np.isfinite(pixels).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    usable &= (np.abs(pixels) < 1e6).all(axis=1) & (covariances.trace(axis1=1, axis2=2) < 1e12)
    usable[usable] &= np.linalg.det(covariances[usable]) > 0.0
    found: list[Expectation | None] = []
    for ids in every_id:
        rows, places = np.nonzero((ids[:, None] == prior.ids[None]) & usable[None])
        found.append(Expectation(rows, pixels[places], covariances[places]) if len(rows) else None)
    return found


def region_of(expected: Sequence[Expectation | None], shape: tuple[int, ...]) -> Region | None:
    """Region of an image (height, width) that must contain all of these; None if it is no smaller, or unknown."""
    known = [one for one in expected if one is not None]
    if len(known) < len(expected) or not known:
        return None
    pixels = np.concatenate([one.pixels for one in known])
    sigma = np.sqrt(np.concatenate([one.covariances for one in known])[:, [0, 1], [0, 1]])
    low = np.floor((pixels - 3.0 * sigma).min(axis=0) - MARGIN_PX).astype(int)
    high = np.ceil((pixels + 3.0 * sigma).max(axis=0) + MARGIN_PX).astype(int)
    u0, v0, u1, v1 = max(low[0], 0), max(low[1], 0), min(high[0], shape[1]), min(high[1], shape[0])
    if u1 - u0 < 64 or v1 - v0 < 64 or (u1 - u0) * (v1 - v0) > WORTH * shape[0] * shape[1]:
        return None
    return int(u0), int(v0), int(u1), int(v1)


def crop(image: ImageArray, region: Region) -> ImageArray:
    """Region of an image, C order."""
    u0, v0, u1, v1 = region
    return np.ascontiguousarray(image[v0:v1, u0:u1])


def copies_of(
    faces: SearchedFaces, sought: BoolArray, spots: FloatArray, least: int, tolerance: float
) -> list[IntArray]:
    """All occurrences (k, 7) of each face of ``sought`` (f,) among ``spots`` (m, FIELDS): rows of the spots, -1 for
    missing dots.
    """
    owners, counts = (np.empty((len(faces.radii), MOST_COPIES, 7), np.int64), np.empty(len(faces.radii), np.int64))
    find_faces(plain(faces), sought, spots, (least, REACH_PX, tolerance), owners, counts)
    return [found[:count] for found, count in zip(owners, counts.tolist(), strict=True)]


def choose(copies: IntArray, spots: FloatArray, expected: Expectation | None) -> IntArray | None:
    """The expected one of several occurrences of a face; None if there is none, or it is ambiguous.

    A single one is accepted wherever it is: a prior does not overrule the picture.
    """
    if len(copies) < 2:
        return copies[0] if len(copies) else None
    if expected is None:
        return None
    distances = np.array([expected.squared_distance(spots[owner, :2], owner >= 0) for owner in copies])
    first, second = np.argsort(distances)[:2]
    clear = distances[first] <= NEAR and distances[second] > distances[first] + FARTHER
    return copies[int(first)] if clear else None
