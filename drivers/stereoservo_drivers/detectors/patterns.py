"""Faces among dots: the search for a planar pattern in a picture's spots. Numba kernels; no state.

Pattern coordinates are those of :mod:`~stereoservo_drivers.detectors.homographies`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo_drivers.detectors.homographies import fit_homography, image_of_circle, misfits
from stereoservo_drivers.detectors.kernel_types import FLOAT, INT, compile_for, given, written

CLEAR = 1.6
"""Least ratio of misfits between the second-best and the best explanation of the same dots."""
MOST_RIVALS = 32
"""Explanations of as many dots beyond which nothing is clear."""


@kernel
def _turn(a, b, c):
    """Twice the signed area of a triangle; positive when clockwise as seen (v down)."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def basis_inverse(positions: FloatArray) -> FloatArray:
    """Inverse (3, 3) of the matrix that maps the standard projective basis to four points (4, 2), scales
    included.
    """
    M = np.column_stack([positions, np.ones(4)]).T
    scaled: FloatArray = M[:, :3] * np.linalg.solve(M[:, :3], M[:, 3])
    return np.linalg.inv(scaled)


@kernel
def _hypothesis(p, q, r, s, inverse, H):
    """Homography of four pattern points (by ``inverse``) to four pixels, H[2, 2] > 0."""
    whole = _turn(p, q, r)
    a, b, c = _turn(s, q, r) / whole, _turn(p, s, r) / whole, _turn(p, q, s) / whole
    for j in range(3):
        H[0, j] = a * p[0] * inverse[0, j] + b * q[0] * inverse[1, j] + c * r[0] * inverse[2, j]
        H[1, j] = a * p[1] * inverse[0, j] + b * q[1] * inverse[1, j] + c * r[1] * inverse[2, j]
        H[2, j] = a * inverse[0, j] + b * inverse[1, j] + c * inverse[2, j]
    scale = H[2, 2]
    if abs(scale) < 1e-12:
        return False
    for i in range(3):
        for j in range(3):
            H[i, j] /= scale
    return True


@kernel
def _promising(pattern, pixels, basis, least, reach, H):
    """Whether enough dots outside the basis have something near their place."""
    missing = pattern.shape[0] - least
    for i in range(pattern.shape[0]):
        if i == basis[0] or i == basis[1] or i == basis[2] or i == basis[3]:
            continue
        w = H[2, 0] * pattern[i, 0] + H[2, 1] * pattern[i, 1] + H[2, 2]
        if w <= 0.0:
            return False
        u = (H[0, 0] * pattern[i, 0] + H[0, 1] * pattern[i, 1] + H[0, 2]) / w
        v = (H[1, 0] * pattern[i, 0] + H[1, 1] * pattern[i, 1] + H[1, 2]) / w
        near = False
        for k in range(pixels.shape[0]):
            if abs(pixels[k, 0] - u) < reach and abs(pixels[k, 1] - v) < reach:
                near = True
                break
        if not near:
            missing -= 1
            if missing < 0:
                return False
    return True


@kernel
def _assign(pattern, radius, pixels, areas, reach, H, owner, circle):
    """Dots nearest to the projected pattern into ``owner`` (n,), -1 where none has the right place and size.

    Returns their number; 0 where the homography does not show the pattern from in front.
    """
    n = pattern.shape[0]
    count = 0
    for i in range(n):
        owner[i] = -1
        if not image_of_circle(H, pattern[i, 0], pattern[i, 1], radius, circle):
            return 0
        u, v = circle[0] + circle[2], circle[1] + circle[3]
        # blur inflates the area of thin dots
        most = np.pi * (circle[5] + 0.7) * (circle[6] + 0.7) * 1.25
        least = 0.75 * circle[4]
        nearest = reach * reach
        for k in range(pixels.shape[0]):
            du = pixels[k, 0] - u
            dv = pixels[k, 1] - v
            if du * du + dv * dv < nearest and least < areas[k] < most:
                nearest = du * du + dv * dv
                owner[i] = k
        if owner[i] >= 0:
            count += 1
            for j in range(i):
                if owner[j] == owner[i]:
                    return 0
    return count


class Dots(NamedTuple):
    """What a face is searched among: ``pixels`` (m, 2) and ``areas`` (m,) [px²]."""

    pixels: FloatArray
    areas: FloatArray


class Gates(NamedTuple):
    """The ``least`` dots of a face; distances [px] from the quadruple's homography and from the fitted one."""

    least: int
    reach: float
    tolerance: float


class Rivals(NamedTuple):
    """Explanations by equally many dots: ``owners`` (MOST_RIVALS, n), dots' rows or -1, and misfits ``fits`` [px]."""

    owners: IntArray
    fits: FloatArray


class Scratch(NamedTuple):
    """Memory of one search: a homography, a circle's image, two assignments (n,), and dots to fit to."""

    H: FloatArray
    circle: FloatArray
    trial: IntArray
    again: IntArray
    used: BoolArray
    matched: FloatArray
    distances: FloatArray


@kernel
def _explain(pattern, radius, dots, gates, rivals, best_count, known, scratch):
    """Number of dots that the homography in ``scratch`` explains, 0 if refused, and their misfit [px] from the better
    homography that is fitted to all of them. Fewer than ``best_count``, or what is known as a rival, are refused.
    """
    H, circle, trial, again, used, matched, distances = scratch
    count = _assign(pattern, radius, dots.pixels, dots.areas, gates.reach, H, trial, circle)
    if count < gates.least or count < best_count:
        return 0, 0.0
    if count == best_count:
        for c in range(known):
            if (rivals.owners[c] == trial).all():
                return 0, 0.0
    for d in range(pattern.shape[0]):
        used[d] = trial[d] >= 0
        if used[d]:
            matched[d, 0] = dots.pixels[trial[d], 0]
            matched[d, 1] = dots.pixels[trial[d], 1]
    if not fit_homography(pattern, matched, used, H):
        return 0, 0.0
    misfit = misfits(pattern, matched, used, H, distances)
    if misfit > gates.tolerance:
        return 0, 0.0
    # sizes once more, under the better homography
    if _assign(pattern, radius, dots.pixels, dots.areas, gates.reach, H, again, circle) < count:
        return 0, 0.0
    return count, misfit


@kernel
def _clearly_best(rivals, known, tolerance):
    """Row of the best of ``known`` explanations; -1 if another one of some of the same dots is nearly as good."""
    owners, fits = rivals
    n = owners.shape[1]
    best = int(np.argmin(fits[:known]))
    for c in range(known):
        if c != best and (fits[c] < CLEAR * fits[best] or fits[c] < 0.5 * tolerance):
            for d in range(n):
                for e in range(n):
                    if owners[best, d] >= 0 and owners[c, e] == owners[best, d]:
                        return -1
    return best


@kernel
def _inverse_turns(pattern, basis):
    """One over twice the signed areas of the triangles 012, 013, 023, 123 of a ``basis`` (4,)."""
    a, b, c, d = pattern[basis[0]], pattern[basis[1]], pattern[basis[2]], pattern[basis[3]]
    return 1.0 / _turn(a, b, c), 1.0 / _turn(a, b, d), 1.0 / _turn(a, c, d), 1.0 / _turn(b, c, d)


@kernel
def find_face(pattern, radius, pixels, areas, bases, inverses, least, reach, tolerance, owner):
    """Search a pattern (n, 2) with dots of ``radius`` [pattern units] among dots (m, 2) [px] of ``areas``
    (m,) [px²].

    Every ordered quadruple of dots is held against every row of ``bases`` (b, 4) with its ``inverses``
    (b, 3, 3), pruned by the signs and sizes of its triangles, which the dots' areas foretell. A hypothesis
    counts when ``least`` dots or more lie within ``tolerance`` [px] of the homography fitted to all of them
    and are of the right size; ``reach`` [px] is how far a dot may lie from the homography of the quadruple.
    ``owner`` (n,) gets the dots' rows, -1 for missing ones. Returns the number found; 0 if none, or if
    another assignment of some of the same dots explains as many nearly as well. (One of quite other dots is a second
    copy of the pattern, which is found when these are taken away.)
    """
    n, m = pattern.shape[0], pixels.shape[0]
    unit = np.pi * radius * radius
    dots, gates = Dots(pixels, areas), Gates(least, reach, tolerance)
    rivals = Rivals(np.zeros((MOST_RIVALS, n), np.int64), np.zeros(MOST_RIVALS))
    scratch = Scratch(
        np.zeros((3, 3)), np.zeros(7), np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.bool_),
        np.zeros((n, 2)), np.zeros(n),
    )  # fmt: skip
    best_count = known = 0
    owner[:] = -1
    for row in range(bases.shape[0]):
        basis, inverse = bases[row], inverses[row]
        s012, s013, s023, s123 = _inverse_turns(pattern, basis)
        for i in range(m):
            for j in range(m):
                if j == i or areas[j] > 3.0 * areas[i] or areas[i] > 3.0 * areas[j]:
                    continue
                ju, jv = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
                for k in range(m):
                    ku, kv = pixels[k, 0] - pixels[i, 0], pixels[k, 1] - pixels[i, 1]
                    # twice the triangle's signed area; 0 for k in (i, j)
                    turn = ju * kv - jv * ku
                    foretold = (areas[i] + areas[j] + areas[k]) / (3.0 * unit)
                    if turn * s012 < 0.4 * foretold or turn * s012 > 2.0 * foretold:
                        continue
                    for l in range(m):  # noqa: E741
                        lu, lv = pixels[l, 0] - pixels[i, 0], pixels[l, 1] - pixels[i, 1]
                        ijl, ikl = ju * lv - jv * lu, ku * lv - kv * lu
                        # that of j, k, l is what is left of the whole
                        if (
                            ijl * s013 < 0.3 * foretold
                            or ikl * s023 < 0.3 * foretold
                            or (turn - ijl + ikl) * s123 < 0.3 * foretold
                        ):
                            continue
                        if not _hypothesis(pixels[i], pixels[j], pixels[k], pixels[l], inverse, scratch.H):
                            continue
                        wanted = max(least, best_count)
                        if not _promising(pattern, pixels, basis, wanted, reach + 0.5, scratch.H):
                            continue
                        count, misfit = _explain(
                            pattern, radius, dots, gates, rivals, best_count, known, scratch
                        )
                        if count == 0:
                            continue
                        if count > best_count:
                            best_count, known = count, 0
                        if known == MOST_RIVALS:
                            return 0
                        rivals.owners[known] = scratch.trial
                        rivals.fits[known] = misfit
                        known += 1
    best = _clearly_best(rivals, known, tolerance) if known else -1
    if best < 0:
        return 0
    owner[:] = rivals.owners[best]
    return best_count


def compile_kernels() -> None:
    """Compile what the detector calls, or load it from the cache."""
    compile_for(
        find_face, given(FLOAT, 2), FLOAT, given(FLOAT, 2), given(FLOAT, 1), given(INT, 2), given(FLOAT, 3),
        INT, FLOAT, FLOAT, written(INT, 1),
    )  # fmt: skip
