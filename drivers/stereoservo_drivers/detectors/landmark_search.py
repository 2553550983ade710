"""Search for the landmarks of one camera's reference in an image, and consistency of the found ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereoservo.numerics.arrays import BoolArray, FloatArray, ImageArray, IntArray
from stereoservo_drivers.detectors.patch_alignment import Alignment, ReferencePatches

NEIGHBOURS = 6
"""Number of neighbours that predict the place of a landmark."""
LOOKED_AT = 24
FEW = 4
AGREEING = 3
"""Number of neighbours that must agree on a landmark's place."""
BENT = 0.2
"""Largest deviation of neighbours from a landmark's own warp, as a share of their distance: surfaces are not planes."""
LOOSE_PX = 1.5
START_COARSE = 2
"""Pyramid levels at which the search for an only roughly known landmark starts."""


class Surroundings:
    """Neighbourhoods of one reference's landmarks at ``pixels`` (m, 2) [px], each of its kind among ``kinds`` (m,)."""

    def __init__(self, pixels: FloatArray, kinds: IntArray) -> None:
        self.pixels = pixels
        self.kinds = kinds
        distances = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
        distances[~np.isfinite(distances) | (kinds[:, None] != kinds[None])] = np.inf
        np.fill_diagonal(distances, np.inf)
        self.near: IntArray = np.argsort(distances, axis=1, kind="stable")[:, :LOOKED_AT].astype(np.int64)
        self._there: BoolArray = np.isfinite(np.take_along_axis(distances, self.near, axis=1))

    def local_maps(self, found: FloatArray, use: BoolArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Each landmark as predicted by its neighbours in ``use`` (m,), at ``found`` (m, 2) [px]: warps, pixels,
        known.
        """
        m = len(self.pixels)
        counted = use[self.near] & self._there
        counted &= np.cumsum(counted, axis=1) <= NEIGHBOURS
        x = np.nan_to_num(self.pixels[self.near] - self.pixels[:, None])
        y = np.where(counted[:, :, None], found[self.near], 0.0)
        X = np.dstack([x, np.ones(x.shape[:2])]) * counted[:, :, None]
        N = np.einsum("mki,mkj->mij", X, X)
        moment = N[:, :2, :2] - N[:, :2, 2:] * N[:, 2:, :2] / np.maximum(N[:, 2:, 2:], 1.0)
        trace = moment[:, 0, 0] + moment[:, 1, 1]
        with np.errstate(invalid="ignore"):
            flat = np.linalg.det(moment) < 0.01 * trace**2
        known = (counted.sum(axis=1) >= FEW) & ~flat
        N[~known] = np.eye(3)
        B = np.linalg.solve(N, np.einsum("mki,mkj->mij", X, y))
        warps = np.where(known[:, None, None], B[:, :2].transpose(0, 2, 1), np.eye(2))
        known &= plausible(warps)
        return warps, np.where(known[:, None], B[:, 2], np.zeros((m, 2))), known

    def agreeing(self, A: FloatArray, found: FloatArray, use: BoolArray) -> BoolArray:
        """Pairs (m, LOOKED_AT) of a landmark and its neighbours, both in ``use``, that its warp predicts correctly."""
        counted = use[self.near] & self._there & use[:, None]
        counted &= np.cumsum(counted, axis=1) <= 2 * NEIGHBOURS
        x = np.nan_to_num(self.pixels[self.near] - self.pixels[:, None])
        predicted = found[:, None] + np.einsum("mij,mkj->mki", A, x)
        misses = np.linalg.norm(predicted - found[self.near], axis=2)
        allowed = LOOSE_PX + BENT * np.linalg.norm(predicted - found[:, None], axis=2)
        agreed: BoolArray = counted & (misses <= allowed)
        return agreed

    def coherent(self, A: FloatArray, found: FloatArray, use: BoolArray, least: int, *, one: bool) -> BoolArray:
        """Mask (m,) of landmarks of ``use`` that ``AGREEING`` neighbours confirm, in connected groups of ``least``.

        ``one``: only the largest group of each kind: a rigid body is in one place.
        """
        use = use.copy()
        while True:
            confirmed = use & (self.agreeing(A, found, use).sum(axis=1) >= AGREEING)
            if np.array_equal(confirmed, use):
                break
            use = confirmed
        label = np.where(use, np.arange(len(use)), -1)
        pairs = self.agreeing(A, found, use)
        rows, columns = np.nonzero(pairs)
        ends = self.near[rows, columns]
        while True:  # the least index of a group spreads over it
            again = label.copy()
            np.minimum.at(again, rows, label[ends])
            np.minimum.at(again, ends, label[rows])
            if np.array_equal(again, label):
                break
            label = again
        kept = np.zeros(len(use), np.bool_)
        for kind in np.unique(self.kinds):
            groups, counts = np.unique(label[use & (self.kinds == kind)], return_counts=True)
            if len(groups) and one:
                groups, counts = groups[[counts.argmax()]], counts[[counts.argmax()]]
            kept |= np.isin(label, groups[counts >= least]) & use
        return kept


def nothing(m: int) -> Alignment:
    """An empty result for m landmarks."""
    return Alignment(
        np.tile(np.eye(2), (m, 1, 1)), np.zeros((m, 2)), np.zeros((m, 2, 2)), np.zeros(m), np.zeros(m, np.bool_)
    )


def take_better(into: Alignment, rows: IntArray, other: Alignment, good: BoolArray) -> None:
    """Copy results of ``other`` for ``rows`` that are ``good`` into ``into``, where they correlate better."""
    better = good & (other.correlations > np.where(into.found[rows], into.correlations[rows], -1.0))
    at = rows[better]
    into.A[at], into.pixels[at] = other.A[better], other.pixels[better]
    into.covariances[at], into.correlations[at] = other.covariances[better], other.correlations[better]
    into.found[at] = True


def seek(
    patches: ReferencePatches,
    pyramid: list[ImageArray],
    rows: IntArray,
    warps: FloatArray,
    pixels: FloatArray,
    least_correlation: float,
    coarse: int = START_COARSE,
) -> tuple[Alignment, BoolArray]:
    """Align ``rows`` (k,) from start values; returns which are found, with sufficient correlation and a plausible
    warp.
    """
    result = patches.align(pyramid, rows, warps, pixels, coarse)
    good = result.found & (result.correlations >= least_correlation) & plausible(result.A)
    return result, good


def search_by_keypoints(
    patches: ReferencePatches,
    reference: Keypoints,
    seen: Keypoints,
    pyramid: list[ImageArray],
    least_correlation: float,
    radius: float,
    *,
    shifted_px: float = 0.0,
) -> Alignment:
    """Search for all landmarks of a reference anywhere in an image, by planes of matched keypoints.

    ``shifted_px``: use only keypoints that moved at least this far. ``radius`` [px] around a landmark of the keypoints
    that are used for it.
    """
    found = nothing(len(patches.pixels))
    matches = match_keypoints(reference, seen)
    first, second = reference.pixels[matches[:, 0]], seen.pixels[matches[:, 1]]
    away = np.linalg.norm(second - first, axis=1) >= shifted_px
    for rows, warps, where in starts_from_planes(find_planes(first[away], second[away]), patches.pixels, radius):
        if len(rows):
            result, good = seek(patches, pyramid, rows, warps, where, least_correlation)
            take_better(found, rows, result, good)
    return found


RATIO = 0.8
"""Lowe's ratio: a match's distance in descriptors relative to that of the second best."""
CONTRAST = 0.01
NEAR_PX = 3.0
"""Distance of keypoints of one feature, found several times in tilted views; a second best this near is the same."""
TWINS = 4
"""Number of second bests searched for one at another place."""
CHUNK = 512
PLANE_PX = 3.0
"""Largest distance of a match from its plane."""
MAX_PLANES = 8
MIN_PLANE = 7
"""Number of matches that determine a plane: four fix it, three more confirm it."""
FEW_NEAR = 4
"""Number of matches of a plane near a pixel that are needed to predict it."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints: ``pixels`` (n, 2) [px] and ``descriptors`` (n, 128)."""

    pixels: FloatArray
    descriptors: npt.NDArray[np.float32]


def find_keypoints(picture: ImageArray, most: int, tilts: int = 0) -> Keypoints:
    """SIFT keypoints of an image (h, w), of up to ``most`` a view; ``tilts``: also of simulated oblique views."""
    finder: Any = cv2.SIFT.create(nfeatures=most, contrastThreshold=CONTRAST)
    if tilts:
        finder = cv2.AffineFeature.create(finder, tilts)
    points, descriptors = finder.detectAndCompute(picture, None)
    if descriptors is None or not len(points):
        return Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32))
    pixels = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2)
    return Keypoints(pixels, np.ascontiguousarray(descriptors, np.float32))


def match_keypoints(first: Keypoints, second: Keypoints, ratio: float = RATIO) -> IntArray:
    """Matches (n, 2) by index: mutual nearest neighbours in descriptors that pass the ratio test."""
    if len(first.pixels) < 2 or len(second.pixels) < 2:
        return np.empty((0, 2), np.int64)
    best, distance, other, back = _nearest(first.descriptors, second)
    rows = np.arange(len(best))
    # If one feature has several keypoints, returning to any of them counts as returning.
    returned = np.linalg.norm(first.pixels[back[best]] - first.pixels, axis=1) <= NEAR_PX
    good = returned & (distance < ratio * other)
    return np.column_stack([rows[good], best[good]])


def _nearest(
    descriptors: npt.NDArray[np.float32], among: Keypoints
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Nearest neighbours: index of the nearest ``among``, its distance, that of the nearest one farther than
    ``NEAR_PX`` from it, (n,) each; and which of ``descriptors`` is nearest to each ``among`` (k,).
    """
    n, k = len(descriptors), len(among.pixels)
    best, distance, other = np.zeros(n, np.int64), np.zeros(n), np.zeros(n)
    back, back_distance = np.zeros(k, np.int64), np.full(k, np.inf, np.float32)
    squares = np.einsum("ij,ij->i", among.descriptors, among.descriptors)
    for start in range(0, n, CHUNK):
        some = descriptors[start : start + CHUNK]
        rows, at = np.arange(len(some)), slice(start, start + len(some))
        d2 = some @ (-2.0 * among.descriptors.T)
        d2 += squares
        d2 += np.einsum("ij,ij->i", some, some)[:, None]
        nearest_back = d2.argmin(axis=0)
        closer = d2[nearest_back, np.arange(k)] < back_distance
        back[closer] = start + nearest_back[closer]
        back_distance[closer] = d2[nearest_back, np.arange(k)][closer]
        nearest = d2.argmin(axis=1)
        best[at], distance[at] = nearest, d2[rows, nearest]
        rival, last = np.full(len(some), np.nan), nearest
        for _ in range(TWINS):
            d2[rows, last] = np.inf
            last = d2.argmin(axis=1)
            distinct = np.linalg.norm(among.pixels[last] - among.pixels[nearest], axis=1) > NEAR_PX
            rival = np.where(np.isnan(rival) & distinct, d2[rows, last], rival)
        other[at] = np.where(np.isnan(rival), d2[rows, last], rival)
    return best, np.sqrt(np.maximum(distance, 0.0)), np.sqrt(np.maximum(other, 0.0)), back


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane of matches: homography ``H`` (3, 3), first to second image, and its inliers ``first``, ``second`` (n,
    2) [px].
    """

    H: FloatArray
    first: FloatArray
    second: FloatArray


def find_planes(first: FloatArray, second: FloatArray) -> list[Plane]:
    """Planes, or approximately planar parts of the scene, among matches (n, 2) [px], the largest first.

    The seed is fixed: the same matches yield the same planes.
    """
    planes: list[Plane] = []
    while len(planes) < MAX_PLANES and len(first) >= MIN_PLANE:
        found = _homography(first, second)
        if found is None:
            break
        H, inside = found
        if _distinct(first[inside]) < MIN_PLANE or _distinct(second[inside]) < MIN_PLANE:
            break
        planes.append(Plane(H, first[inside], second[inside]))
        first, second = first[~inside], second[~inside]
    return planes


def _homography(first: FloatArray, second: FloatArray) -> tuple[FloatArray, BoolArray] | None:
    parameters = cv2.UsacParams()
    parameters.confidence = 0.999
    parameters.isParallel = False
    parameters.maxIterations = 3000
    parameters.randomGeneratorState = 20010701
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.threshold = PLANE_PX
    try:
        H, _ = cv2.findHomography(first, second, parameters)
    except cv2.error:  # OpenCV's search asserts on some degenerate inputs
        return None
    if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        return None
    H = np.asarray(H, dtype=np.float64)
    distances = np.linalg.norm(map_pixels(H, first) - second, axis=1)
    return H, np.asarray(distances <= PLANE_PX)


def _distinct(pixels: FloatArray) -> int:
    """Number of distinct features among keypoints (n, 2): those of one cell of 3 px count once."""
    return len(np.unique(np.floor(pixels / NEAR_PX).astype(np.int64), axis=0))


def map_pixels(H: FloatArray, pixels: FloatArray) -> FloatArray:
    """Pixels (n, 2) mapped by ``H`` (3, 3); infinite where they are mapped to infinity."""
    mapped = pixels @ H[:, :2].T + H[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        result: FloatArray = mapped[:, :2] / mapped[:, 2:]
    return result


def local_warps(H: FloatArray, pixels: FloatArray) -> FloatArray:
    """Local linear parts (n, 2, 2) of ``H`` (3, 3) at ``pixels`` (n, 2)."""
    depth = pixels @ H[2, :2] + H[2, 2]
    mapped = map_pixels(H, pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        result: FloatArray = (H[None, :2, :2] - mapped[:, :, None] * H[None, None, 2, :2]) / depth[:, None, None]
    return result


def starts_from_planes(
    planes: list[Plane], pixels: FloatArray, radius: float
) -> list[tuple[IntArray, FloatArray, FloatArray]]:
    """Start values from each plane for the ``pixels`` (n, 2) that have matches within ``radius`` [px]: rows, warps,
    targets.
    """
    starts = []
    for plane in planes:
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(pixels[:, None] - plane.first[None], axis=2) <= radius
        rows = np.flatnonzero(near.sum(axis=1) >= FEW_NEAR)
        warps, where = local_warps(plane.H, pixels[rows]), map_pixels(plane.H, pixels[rows])
        good = np.isfinite(where).all(axis=1) & plausible(warps)
        starts.append((rows[good], warps[good], where[good]))
    return starts


def plausible(warps: FloatArray, *, least: float = 0.25, stretch: float = 4.0) -> BoolArray:
    """Mask of plausible warps (n, 2, 2) of a visible patch: not mirrored, scale and stretch at most 4."""
    good: BoolArray = np.isfinite(warps).all(axis=(1, 2))
    safe = np.where(good[:, None, None], warps, np.eye(2))
    singular = np.linalg.svd(safe, compute_uv=False)
    good &= np.linalg.det(safe) > 0.0
    good &= (singular[:, 1] >= least) & (singular[:, 0] <= 1.0 / least)
    good &= singular[:, 0] <= stretch * singular[:, 1]
    return good
