"""Which parts of one picture are which parts of another: SIFT keypoints, and planes that explain their matches.

Lowe, Distinctive image features from scale-invariant keypoints, 2004; views from afar by simulated tilts, Morel and
Yu, ASIFT, 2009.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
ImageArray = npt.NDArray[np.uint8]

RATIO = 0.8
"""Lowe's: a match's distance in descriptors over that of the second best."""
CONTRAST = 0.01
NEAR_PX = 3.0
"""Keypoints of one feature that tilted views give several times; a second best so near is the same."""
TWINS = 4
"""Second bests that are looked at for one elsewhere."""
CHUNK = 512
PLANE_PX = 3.0
"""How far a match may lie off the plane that it belongs to."""
MAX_PLANES = 8
MIN_PLANE = 7
"""Matches that make a plane: four fix it, three more confirm it."""
FEW_NEAR = 4
"""Matches about a pixel that a plane needs to speak for it."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """``pixels`` (n, 2) [px] and ``descriptors`` (n, 128)."""

    pixels: FloatArray
    descriptors: npt.NDArray[np.float32]


def find_keypoints(picture: ImageArray, most: int, tilts: int = 0) -> Keypoints:
    """SIFT keypoints of a picture (h, w), of up to ``most`` a view; ``tilts``: simulated views from aside as well."""
    finder: Any = cv2.SIFT_create(nfeatures=most, contrastThreshold=CONTRAST)
    if tilts:
        finder = cv2.AffineFeature_create(finder, tilts)
    points, descriptors = finder.detectAndCompute(picture, None)
    if descriptors is None or not len(points):
        return Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32))
    pixels = np.array([point.pt for point in points], dtype=np.float64).reshape(-1, 2)
    return Keypoints(pixels, np.ascontiguousarray(descriptors, np.float32))


def match_keypoints(first: Keypoints, second: Keypoints, ratio: float = RATIO) -> IntArray:
    """Matches (n, 2) by index: nearest in descriptors, mutually, and well before the second best elsewhere."""
    if len(first.pixels) < 2 or len(second.pixels) < 2:
        return np.empty((0, 2), np.int64)
    best, distance, other, back = _nearest(first.descriptors, second)
    rows = np.arange(len(best))
    # Where one feature has several keypoints, to come back to any of them is to come back.
    returned = np.linalg.norm(first.pixels[back[best]] - first.pixels, axis=1) <= NEAR_PX
    good = returned & (distance < ratio * other)
    return np.column_stack([rows[good], best[good]])


def _nearest(
    descriptors: npt.NDArray[np.float32], among: Keypoints
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """Index of the nearest ``among``, its distance, that of the nearest not within ``NEAR_PX`` of it, (n,) each; and
    which of ``descriptors`` is nearest to each ``among`` (k,).
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
            apart = np.linalg.norm(among.pixels[last] - among.pixels[nearest], axis=1) > NEAR_PX
            rival = np.where(np.isnan(rival) & apart, d2[rows, last], rival)
        other[at] = np.where(np.isnan(rival), d2[rows, last], rival)
    return best, np.sqrt(np.maximum(distance, 0.0)), np.sqrt(np.maximum(other, 0.0)), back


@dataclass(frozen=True, eq=False)
class Plane:
    """Matches that a homography ``H`` (3, 3), first to second picture, explains: ``first``, ``second`` (n, 2) [px]."""

    H: FloatArray
    first: FloatArray
    second: FloatArray


def find_planes(first: FloatArray, second: FloatArray) -> list[Plane]:
    """Planes, or parts of the scene that look like one, among matches (n, 2) [px], the largest first.

    A fixed seed: the same matches give the same planes.
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
    """How many different features there are among keypoints (n, 2): those of one cell of 3 px count once."""
    return len(np.unique(np.floor(pixels / NEAR_PX).astype(np.int64), axis=0))


def map_pixels(H: FloatArray, pixels: FloatArray) -> FloatArray:
    """Pixels (n, 2) through ``H`` (3, 3); infinite where they go there."""
    mapped = pixels @ H[:, :2].T + H[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        result: FloatArray = mapped[:, :2] / mapped[:, 2:]
    return result


def local_warps(H: FloatArray, pixels: FloatArray) -> FloatArray:
    """Linear parts (n, 2, 2) of ``H`` (3, 3) about ``pixels`` (n, 2)."""
    depth = pixels @ H[2, :2] + H[2, 2]
    mapped = map_pixels(H, pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        result: FloatArray = (H[None, :2, :2] - mapped[:, :, None] * H[None, None, 2, :2]) / depth[
            :, None, None
        ]
    return result


def starts_from_planes(
    planes: list[Plane], pixels: FloatArray, radius: float
) -> list[tuple[IntArray, FloatArray, FloatArray]]:
    """For each plane the ``pixels`` (n, 2) that it has matches about, within ``radius`` [px]: rows, warps, where to."""
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
    """Which warps (n, 2, 2) a patch may be seen through: no mirror, no size beyond 4, no stretch beyond 4."""
    good: BoolArray = np.isfinite(warps).all(axis=(1, 2))
    safe = np.where(good[:, None, None], warps, np.eye(2))
    singular = np.linalg.svd(safe, compute_uv=False)
    good &= np.linalg.det(safe) > 0.0
    good &= (singular[:, 1] >= least) & (singular[:, 0] <= 1.0 / least)
    good &= singular[:, 0] <= stretch * singular[:, 1]
    return good
