"""Acquisition: search of a whole image for dot-like spots, and their assignment to faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import FloatArray, ImageArray, IntArray
from stereoservo.ports.devices import Prior
from stereoservo_drivers.detectors.centroids import measure_windows
from stereoservo_drivers.detectors.components import AREA, FIELDS, LOPSIDED, MAX_WINDOW, OK
from stereoservo_drivers.detectors.face_fit import whole
from stereoservo_drivers.detectors.face_options import Pattern
from stereoservo_drivers.detectors.patterns import find_face

SHRINK_FROM = 240
"""Least side of an image [px] that is searched, not measured, at half its size: a third of the time, half
the noise.
"""
GROW = 7
"""Pixels around a component's bounding box in the window that measures it."""
MIN_FILL = 0.3
"""Least part of its bounding box that a component covers (an ellipse of axes 1:4 on the diagonal: 0.37)."""
MAX_ASPECT = 6.0


def noise_level(image: npt.NDArray[np.uint8]) -> float:
    """Standard deviation of the noise [grey levels] of an image (h, w), from differences of neighbours on
    some thirty rows.
    """
    rows = image[:: max(1, image.shape[0] // 30)].astype(np.int16)
    differences = np.abs(rows[:, 1:] - rows[:, :-1])
    # the median of |difference| in whole levels, interpolated within its level
    counts = np.bincount(differences.ravel(), minlength=2)
    cumulated = np.cumsum(counts)
    half = 0.5 * cumulated[-1]
    level = int(np.searchsorted(cumulated, half))
    below = cumulated[level - 1] if level else 0
    width = 0.5 if level == 0 else 1.0
    start = 0.0 if level == 0 else level - 0.5
    median = start + width * (half - below) / counts[level]
    return float(median / (0.6745 * np.sqrt(2.0)))


def find_spots(
    image: npt.NDArray[np.uint8],
    dark: bool,
    min_contrast: int,
    lopsided: float,
    most: int,
    labels: npt.NDArray[np.int32],
    stack: npt.NDArray[np.int32],
) -> npt.NDArray[np.float64]:
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
    mask = cv2.compare(bright, cv2.add(mean, offset), cv2.CMP_GT)
    # labels of 16 bits take less than half the time; no more components than a quarter of the pixels
    labelled = cv2.CV_16U if mask.size <= 4 * 65535 else cv2.CV_32S
    _, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=labelled)
    left, top, width, height, area = stats[1:].T
    longer, shorter = np.maximum(width, height), np.minimum(width, height)
    keep = (
        (area >= 6 // shrink**2 + 1)
        & (shrink * longer <= MAX_WINDOW - 2 * GROW)
        & (longer <= MAX_ASPECT * shorter)
        & (area >= MIN_FILL * width * height)
    )
    left, top, right, bottom = (shrink * x[keep] for x in (left, top, left + width, top + height))
    windows = np.column_stack([left - GROW, top - GROW, right + GROW, bottom + GROW]).astype(np.int64)
    near = shrink * centres[1:][keep] + 0.5 * (shrink - 1)
    spots, status = np.zeros((len(windows), FIELDS)), np.zeros(len(windows), np.int64)
    least = np.full(len(windows), 5, np.int64)
    measure_windows(image, dark, windows, near, min_contrast, least, labels, stack, spots, status)
    spots = np.array([spot for spot in spots[status == OK] if whole(spot, lopsided)]).reshape(-1, FIELDS)
    spots = spots[np.argsort(spots[:, LOPSIDED], kind="stable")][: 2 * most]
    # one spot may be measured from two components
    distances = np.hypot(*(spots[:, None, :2] - spots[None, :, :2]).transpose(2, 0, 1))
    twins = np.triu(distances < 2.0, 1).any(axis=0)
    return spots[~twins][:most]


Region = tuple[int, int, int, int]
"""Left, top, right, bottom [px]; right and bottom are the first beyond."""

REACH_PX = 1.5
"""How far a dot may lie from the homography of four others."""
MOST_COPIES = 3
LOST_SPEED_PX_S = 200.0
"""Standard deviation of a speed that a prior did not know of."""
NEAR = 9.0
"""Mean squared distance [prior variances] within which a copy of a face may be the one expected (chi-square of two
degrees of freedom: 0.99)."""
FARTHER = 20.0
"""How much farther [prior variances] the other copies must be."""
MARGIN_PX = 48.0
"""Room about where dots are expected: their size, and background to judge them by."""
WORTH = 0.5
"""Part of a picture from which a region is not searched on its own first."""


@dataclass(frozen=True)
class Expectation:
    """Expected dots of a face: ``rows`` (k,) of its pattern, ``pixels`` (k, 2), ``covariances`` (k, 2, 2)."""

    rows: IntArray
    pixels: FloatArray
    covariances: FloatArray

    def squared_distance(self, places: FloatArray, found: npt.NDArray[np.bool_]) -> float:
        """Mean squared Mahalanobis distance of the dots ``found`` (7,) at ``places`` (7, 2); infinite without any."""
        common = found[self.rows]
        if not common.any():
            return np.inf
        off = places[self.rows[common]] - self.pixels[common]
        return float(
            np.mean(np.sum(off * np.linalg.solve(self.covariances[common], off[..., None])[..., 0], 1))
        )


def expectations(prior: Prior, t_ns: int, max_age_s: float, every_id: IntArray) -> list[Expectation | None]:
    """Expectation of each face of ``every_id`` (f, 7) at ``t_ns`` from a prior of any age; None where it is
    unusable.

    It is moved by its velocities for no longer than ``max_age_s``, and loosened by its whole age.
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
    """Region of an image (height, width) that must contain all of these; None where that is no smaller, or unknown."""
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


def copies_of(pattern: Pattern, spots: FloatArray, least: int, tolerance: float) -> list[IntArray]:
    """All occurrences of a face among ``spots`` (m, FIELDS): rows of the spots (7,), -1 for missing dots."""
    left = np.arange(len(spots))
    found: list[IntArray] = []
    while len(left) >= least and len(found) < MOST_COPIES:
        centres = np.ascontiguousarray(spots[left, :2])
        areas = np.ascontiguousarray(spots[left, AREA])
        owner = np.full(len(pattern.ids), -1, np.int64)
        for bases in (slice(0, 1), slice(1, None)):
            # the first basis is the corners, the others stand in where one is hidden
            if find_face(
                pattern.positions, pattern.radius, centres, areas, pattern.bases[bases],
                pattern.inverses[bases], least, REACH_PX, tolerance, owner,
            ):  # fmt: skip
                break
        if (owner < 0).all():
            break
        found.append(np.where(owner >= 0, left[owner], -1))
        left = np.setdiff1d(left, found[-1])
    return found


def choose(copies: Sequence[IntArray], spots: FloatArray, expected: Expectation | None) -> IntArray | None:
    """Of several occurrences of a face the expected one; None where there is none, or it is ambiguous.

    A single one is taken wherever it is: a prior does not decide against the picture.
    """
    if len(copies) < 2:
        return copies[0] if copies else None
    if expected is None:
        return None
    distances = np.array([expected.squared_distance(spots[owner, :2], owner >= 0) for owner in copies])
    first, second = np.argsort(distances)[:2]
    clear = distances[first] <= NEAR and distances[second] > distances[first] + FARTHER
    return copies[first] if clear else None


def without_conflicts(owners: IntArray) -> IntArray:
    """Faces (f, 7) without those that share a spot: the one with more dots stays; of equals, none."""
    kept = owners.copy()
    for f, owner in enumerate(owners):
        mine = owner[owner >= 0]
        for g, other in enumerate(owners):
            if f != g and np.isin(mine, other).any() and (other >= 0).sum() >= len(mine):
                kept[f] = -1
    return kept
