"""Recognition of faces among dots: the search for a planar pattern in a picture's spots. Numba kernels; no state.

Pattern coordinates are those of :mod:`~stereoservo_drivers.detectors.homographies`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo_drivers.detectors.components import AREA
from stereoservo_drivers.detectors.homographies import fit_homography, image_of_circle, misfits
from stereoservo_drivers.detectors.kernel_types import BOOL, FLOAT, INT, compile_for, fields, given, written

CLEAR = 1.6
"""Least ratio of misfits between the second-best and the best explanation of the same dots."""
ROUNDNESS = 4.25
"""Sum of the half axes over the root of their product, for an ellipse of axes 1:16: no spot is thinner."""
MOST_RIVALS = 32
"""Number of explanations by equally many dots above which the result is ambiguous."""


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
    """Whether enough dots outside the basis have a spot near their place."""
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
def _assign(face, dots, reach, H, owner, circle):
    """Assign the nearest dots to the projected pattern of a face in ``owner`` (n,), -1 if none has the right place and
    size.

    Returns their number; 0 if the homography does not show the pattern from the front.
    """
    pattern, radius = face.pattern, face.radius
    pixels, areas = dots
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


@kernel
def _least_areas(areas):
    """Least area of a dot's image (m,) for its measured ``areas`` (m,): blur enlarges thin dots."""
    # the inverse of area <= 1.25 pi (a + 0.7) (b + 0.7)
    slope = 0.7 * ROUNDNESS * np.sqrt(np.pi)
    least = np.empty(areas.size)
    for i in range(areas.size):
        root = np.sqrt(max(slope * slope + 4.0 * (areas[i] / 1.25 - 0.5 * np.pi), 0.0)) - slope
        least[i] = 0.25 * max(root, 0.0) ** 2
    return least


@kernel
def _sizes_agree(foretold, depths, least, areas, quadruple, missing):
    """Whether all but ``missing`` of the dots of a ``quadruple`` have areas roughly as predicted by their homography.

    ``foretold``: the fourth's area; ``depths`` (3): those of the first three over the fourth's: areas are proportional
    to 1 / depth³. ``least`` (m,) and ``areas`` (m,): of the dots.
    """
    for i in range(4):
        cubed = 1.0 if i == 3 else depths[i] ** 3
        k = quadruple[i]
        if least[k] * cubed > foretold or areas[k] * cubed < 0.74 * foretold:
            missing -= 1
            if missing < 0:
                return False
    return True


class SearchedFaces(NamedTuple):
    """f faces of n dots to search for: ``patterns`` (f, n, 2) with dots of ``radii`` (f,) [pattern units]; for each b
    quadruples of its dots, ``bases`` (f, b, 4), and the :func:`basis_inverse` of each, ``inverses`` (f, b, 3, 3).
    """

    patterns: FloatArray
    radii: FloatArray
    bases: IntArray
    inverses: FloatArray


class SearchedFace(NamedTuple):
    """One of `SearchedFaces`."""

    pattern: FloatArray
    radius: float
    bases: IntArray
    inverses: FloatArray


class Dots(NamedTuple):
    """Dots among which a face is searched: ``pixels`` (m, 2) and ``areas`` (m,) [px²]."""

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


class Best(NamedTuple):
    """Number of ``dots`` of the best explanation so far, and number of ``rivals`` with as many."""

    dots: int
    rivals: int


class Scratch(NamedTuple):
    """Memory of one search: a homography, a circle's image, two assignments (n,), and dots to fit."""

    H: FloatArray
    circle: FloatArray
    trial: IntArray
    again: IntArray
    used: BoolArray
    matched: FloatArray
    distances: FloatArray


@kernel
def _explain(face, dots, gates, rivals, best, scratch):
    """Number of dots that the homography in ``scratch`` explains, 0 if refused, and their misfit [px] from the better
    homography fitted to all of them. Refused: fewer dots than the ``best`` has, or an explanation known as a rival.
    """
    H, circle, trial, again, used, matched, distances = scratch
    pattern = face.pattern
    count = _assign(face, dots, gates.reach, H, trial, circle)
    if count < gates.least or count < best.dots:
        return 0, 0.0
    if count == best.dots:
        for c in range(best.rivals):
            same = True
            for d in range(trial.size):
                same = same and rivals.owners[c, d] == trial[d]
            if same:
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
    # check sizes again, with the better homography
    if _assign(face, dots, gates.reach, H, again, circle) < count:
        return 0, 0.0
    return count, misfit


@kernel
def _clearly_best(rivals, known, tolerance):
    """Row of the best of ``known`` explanations; -1 if another one of some of the same dots is nearly as good."""
    owners, fits = rivals
    n = owners.shape[1]
    best = 0
    for c in range(known):
        best = c if fits[c] < fits[best] else best
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
def _fourths(us, vs, three, turns, limit, out):
    """Write to ``out`` (m,) the dots at (us, vs) (m,) that make triangles of the right sign with any two of ``three``,
    at least ``limit`` times the pattern's; returns their number. ``turns`` as returned by :func:`_inverse_turns`.
    """
    i, j, k = three
    _, s013, s023, s123 = turns
    ju, jv, ku, kv = us[j] - us[i], vs[j] - vs[i], us[k] - us[i], vs[k] - vs[i]
    turn = ju * kv - jv * ku
    count = 0
    for l in range(us.size):  # noqa: E741
        lu, lv = us[l] - us[i], vs[l] - vs[i]
        ijl, ikl = ju * lv - jv * lu, ku * lv - kv * lu
        # the triangle of j, k, l is the remainder of the whole
        right = (ijl * s013 >= limit) & (ikl * s023 >= limit) & ((turn - ijl + ikl) * s123 >= limit)
        # no branch: one in seven is right
        out[count] = l
        count += 1 if right else 0
    return count


@kernel
def find_face(face, dots, gates, owner):
    """Search a `SearchedFace` among `Dots`.

    Every ordered quadruple of dots is compared with every row of the face's bases, pruned by the signs and sizes of its
    triangles, which are predicted from the dots' areas. A hypothesis counts if as many dots as the `Gates` require are
    within their tolerance of the homography fitted to all of them and are of the right size. Writes the dots' rows to
    ``owner`` (n,), -1 for missing ones. Returns the number found; 0 if none, or if another assignment of some of the
    same dots explains as many nearly as well. (One of entirely other dots is a second copy of the pattern, which is
    found when these dots are removed.)
    """
    pattern, radius, bases, inverses = face
    pixels, areas = dots
    least, reach, tolerance = gates
    n, m = pattern.shape[0], pixels.shape[0]
    unit = np.pi * radius * radius
    third = 1.0 / (3.0 * unit)
    smallest, fourths = _least_areas(areas), np.empty(m, np.int64)
    us, vs = pixels[:, 0].copy(), pixels[:, 1].copy()
    rivals = Rivals(np.zeros((MOST_RIVALS, n), np.int64), np.zeros(MOST_RIVALS))
    scratch = Scratch(
        np.zeros((3, 3)),
        np.zeros(7),
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
        np.zeros(n, np.bool_),
        np.zeros((n, 2)),
        np.zeros(n),
    )
    best_count = known = np.int64(0)
    owner[:] = -1
    for row in range(bases.shape[0]):
        basis, inverse = bases[row], inverses[row]
        turns = s012, s013, s023, s123 = _inverse_turns(pattern, basis)
        for i in range(m):
            for j in range(m):
                if j == i or areas[j] > 3.0 * areas[i] or areas[i] > 3.0 * areas[j]:
                    continue
                ju, jv = us[j] - us[i], vs[j] - vs[i]
                for k in range(m):
                    ku, kv = us[k] - us[i], vs[k] - vs[i]
                    # twice the triangle's signed area; 0 for k in (i, j)
                    turn = ju * kv - jv * ku
                    foretold = (areas[i] + areas[j] + areas[k]) * third
                    if turn * s012 < 0.4 * foretold or turn * s012 > 2.0 * foretold:
                        continue
                    some = _fourths(us, vs, (i, j, k), turns, 0.3 * foretold, fourths)
                    for l in fourths[:some]:  # noqa: E741
                        lu, lv = us[l] - us[i], vs[l] - vs[i]
                        ijl, ikl = ju * lv - jv * lu, ku * lv - kv * lu
                        scale, wanted = 1.0 / (turn * s012), max(least, best_count)
                        depths = (turn - ijl + ikl) * s123 * scale, ikl * s023 * scale, ijl * s013 * scale
                        expected = unit * depths[0] * depths[1] * depths[2] / scale
                        if not _sizes_agree(expected, depths, smallest, areas, (i, j, k, l), n - wanted):
                            continue
                        if not _hypothesis(pixels[i], pixels[j], pixels[k], pixels[l], inverse, scratch.H):
                            continue
                        if not _promising(pattern, pixels, basis, wanted, reach + 0.5, scratch.H):
                            continue
                        count, misfit = _explain(face, dots, gates, rivals, Best(best_count, known), scratch)
                        if count == 0:
                            continue
                        if count > best_count:
                            best_count, known = count, 0
                        if known == MOST_RIVALS:
                            return 0
                        for d in range(n):
                            rivals.owners[known, d] = scratch.trial[d]
                        rivals.fits[known] = misfit
                        known += 1
    best = _clearly_best(rivals, known, tolerance) if known else -1
    if best < 0:
        return 0
    for d in range(n):
        owner[d] = rivals.owners[best, d]
    return best_count


@kernel
def find_copies(face, dots, gates, owners):
    """All occurrences of a face among dots, as :func:`find_face` finds one, into ``owners`` (k, n); their number."""
    pattern, radius, bases, inverses = face
    centres, areas = dots
    m, n = areas.size, pattern.shape[0]
    left = np.arange(m)
    pixels, sizes, owner = np.empty((m, 2)), np.empty(m), np.empty(n, np.int64)
    count = 0
    while m >= gates.least and count < owners.shape[0]:
        for k in range(m):
            pixels[k, 0], pixels[k, 1], sizes[k] = centres[left[k], 0], centres[left[k], 1], areas[left[k]]
        # the first basis is the corners; the others replace it if one is hidden
        first = 0
        found = 0
        while first < bases.shape[0] and found == 0:
            end = 1 if first == 0 else bases.shape[0]
            some = SearchedFace(pattern, radius, bases[first:end], inverses[first:end])
            found = find_face(some, Dots(pixels[:m], sizes[:m]), gates, owner)
            first = end
        if found == 0:
            break
        for d in range(n):
            owners[count, d] = left[owner[d]] if owner[d] >= 0 else -1
            if owner[d] >= 0:
                left[owner[d]] = -1
        count += 1
        kept = 0
        for k in range(m):
            if left[k] >= 0:
                left[kept] = left[k]
                kept += 1
        m = kept
    return count


@kernel
def find_faces(faces, sought, spots, gates, owners, counts):
    """Write the occurrences of the `SearchedFaces` that are ``sought`` (f,) among ``spots`` (m, FIELDS) to ``owners``
    (f, k, n), their numbers to ``counts`` (f,). Faces and `Gates` are the fields of their records.
    """
    patterns, radii, bases, inverses = faces
    dots = Dots(spots[:, :2].copy(), spots[:, AREA].copy())
    for f in range(radii.size):
        counts[f] = 0
        if sought[f]:
            face = SearchedFace(patterns[f], radii[f], bases[f], inverses[f])
            counts[f] = find_copies(face, dots, Gates(*gates), owners[f])


def compile_kernels() -> None:
    """Compile the kernels that the detector calls, or load them from the cache."""
    compile_for(
        find_faces,
        fields(given(FLOAT, 3), given(FLOAT, 1), given(INT, 3), given(FLOAT, 4)),
        given(BOOL, 1),
        written(FLOAT, 2),
        fields(INT, FLOAT, FLOAT),
        written(INT, 3),
        written(INT, 1),
    )
