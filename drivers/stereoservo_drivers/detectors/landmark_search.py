"""Landmarks of one camera's reference found again in a picture, and whether what was found hangs together."""

from __future__ import annotations

import numpy as np

from stereoservo_drivers.detectors.keypoint_matches import (
    Keypoints,
    find_planes,
    match_keypoints,
    plausible,
    starts_from_planes,
)
from stereoservo_drivers.detectors.patch_alignment import (
    Alignment,
    BoolArray,
    FloatArray,
    ImageArray,
    IntArray,
    ReferencePatches,
)

NEIGHBOURS = 6
"""Landmarks about one that tell where it is, where they are found."""
LOOKED_AT = 24
FEW = 4
AGREEING = 3
"""Neighbours that must agree on where a landmark is."""
BENT = 0.2
"""How far neighbours may be off a landmark's own warp, as a share of their distance: surfaces are no planes."""
LOOSE_PX = 1.5
START_COARSE = 2
"""Pyramid levels from which a landmark is sought where it is only known roughly."""


class Surroundings:
    """Which landmarks of one reference, at ``pixels`` (m, 2) [px], of ``kinds`` (m,), are near which of their kind."""

    def __init__(self, pixels: FloatArray, kinds: IntArray) -> None:
        self.pixels = pixels
        self.kinds = kinds
        distances = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
        distances[~np.isfinite(distances) | (kinds[:, None] != kinds[None])] = np.inf
        np.fill_diagonal(distances, np.inf)
        self.near: IntArray = np.argsort(distances, axis=1, kind="stable")[:, :LOOKED_AT].astype(np.int64)
        self._there: BoolArray = np.isfinite(np.take_along_axis(distances, self.near, axis=1))

    def local_maps(self, found: FloatArray, use: BoolArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Where each landmark is by its neighbours in ``use`` (m,), at ``found`` (m, 2) [px]: warps, pixels, known."""
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
        """Pairs (m, LOOKED_AT) of a landmark and its neighbours, both in ``use``, that its warp puts where they are."""
        counted = use[self.near] & self._there & use[:, None]
        counted &= np.cumsum(counted, axis=1) <= 2 * NEIGHBOURS
        x = np.nan_to_num(self.pixels[self.near] - self.pixels[:, None])
        told = found[:, None] + np.einsum("mij,mkj->mki", A, x)
        misses = np.linalg.norm(told - found[self.near], axis=2)
        allowed = LOOSE_PX + BENT * np.linalg.norm(told - found[:, None], axis=2)
        agreed: BoolArray = counted & (misses <= allowed)
        return agreed

    def coherent(
        self, A: FloatArray, found: FloatArray, use: BoolArray, least: int, *, one: bool
    ) -> BoolArray:
        """Landmarks (m,) of ``use`` that ``AGREEING`` neighbours confirm, in groups of ``least`` that hang together.

        ``one``: of each kind the largest group only: a rigid body is in one place.
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
    """No landmark of m found."""
    return Alignment(
        np.tile(np.eye(2), (m, 1, 1)),
        np.zeros((m, 2)),
        np.zeros((m, 2, 2)),
        np.zeros(m),
        np.zeros(m, np.bool_),
    )


def take_better(into: Alignment, rows: IntArray, other: Alignment, good: BoolArray) -> None:
    """Write what ``other`` found of ``rows`` and is ``good`` into ``into``, where it correlates better."""
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
    """Align ``rows`` (k,) from starts; which of them are found, alike enough and through a plausible warp."""
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
    """All landmarks of a reference in a picture, wherever they are: from planes of matched keypoints.

    ``shifted_px``: only by keypoints that are so far from where they were. ``radius`` [px] about a landmark in which
    keypoints speak for it.
    """
    found = nothing(len(patches.pixels))
    matches = match_keypoints(reference, seen)
    first, second = reference.pixels[matches[:, 0]], seen.pixels[matches[:, 1]]
    away = np.linalg.norm(second - first, axis=1) >= shifted_px
    for rows, warps, where in starts_from_planes(
        find_planes(first[away], second[away]), patches.pixels, radius
    ):
        if len(rows):
            result, good = seek(patches, pyramid, rows, warps, where, least_correlation)
            take_better(found, rows, result, good)
    return found
