"""Faces of a marker body: which of the coplanar groups of its markers are faces, and which side of them is outward,
from what cameras see; and which faces the cameras see along a path.

A face has no other marker on one of its sides; that is where the body is, the other one is out, unless the cameras
that see its markers say otherwise (an inner corner). Planes are signed minors of three markers in outward order: with
camera centres O of height 1, ``aᵀO > 0`` where the front is seen (7.4.2).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereoservo.control.marker_groups import IN_PLANE, MarkerGroups, find_groups
from stereoservo.control.primitives_kernel import dot, minors
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel


class Faces(NamedTuple):
    """f faces of a body of m markers.

    ``triples`` (f, 3): three of the markers, in outward order; ``members`` (f, m) 1 where a marker belongs to it, in
    some cases to several. ``sided`` (f,) 0 where nothing tells which side is out. ``body`` (m, 4): the markers when the
    faces were found, which fixes the order.
    """

    triples: IntArray
    members: FloatArray
    sided: FloatArray
    body: FloatArray

    def markers(self) -> list[tuple[int, ...]]:
        """Indices of the markers of each face."""
        return [tuple(int(i) for i in np.flatnonzero(row)) for row in self.members]


def find_faces(
    points: FloatArray,
    matrices: FloatArray,
    sigma_px: float,
    camera_centres: FloatArray,
    seen: FloatArray,
    operators: FloatArray | None = None,
    limit: float = IN_PLANE,
) -> Faces:
    """The faces of a body of markers ``points`` (m, 4), heights 1, of which the cameras see ``seen`` (c, m) there.

    ``matrices``, ``sigma_px``, ``operators``, ``limit``: see `find_groups`. Likewise ``camera_centres`` (c, 4), with
    ``seen``: of cameras that saw the body in several poses, ``H_i⁻¹O``; the more, the surer. Raises ValueError for
    arrays that do not fit and for numbers that are not finite.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    seen = np.ascontiguousarray(seen, dtype=np.float64)
    centres = np.ascontiguousarray(camera_centres, dtype=np.float64)
    m = len(points)
    if points.shape != (m, 4) or seen.shape != (len(centres), m):
        raise ValueError(
            f"points {points.shape} and seen {seen.shape}; (m, 4) and ({len(centres)}, m) are needed"
        )
    if not np.isfinite(points).all():
        raise ValueError("points must be finite; give the markers of the model, all of them")
    if not 0.0 < sigma_px < np.inf:
        raise ValueError(f"sigma_px is {sigma_px}; a positive finite number of pixels is needed")
    turns = np.zeros((0, 4, 4)) if operators is None else np.ascontiguousarray(operators, dtype=np.float64)
    given = np.ascontiguousarray(matrices, dtype=np.float64)
    return select_faces(find_groups(points, given, sigma_px, turns, limit), points, centres, seen)


def select_faces(
    groups: MarkerGroups, points: FloatArray, camera_centres: FloatArray, seen: FloatArray
) -> Faces:
    """The faces among the coplanar ``groups`` of a body at ``points`` (m, 4), of which the cameras see ``seen`` (c, m).

    Regular bodies have coplanar markers that are no face: chamfers, diagonals. Groups of four and more come first,
    those that no camera sees in part before others, those of many markers before few, round before narrow, as long as
    they bring three new markers; then what is left takes part in planes with no marker on one side. Markers inside the
    body, on no such plane, belong to no face.
    """
    counts = np.diff(groups.starts)
    whole = seen_whole(groups.starts, groups.members, seen)
    rank = np.lexsort((-groups.roundness, -counts, -whole))
    triples, members, sided = outward_faces(
        groups.triples, groups.starts, groups.members, groups.sides, rank, points, camera_centres, seen
    )
    return Faces(triples, members, sided, points)


class Sights(NamedTuple):
    """What shows along a way of K samples: ``fronts`` (K, f, c) 1 where a camera has a face's front.

    ``lead`` (K,): the face that most cameras have, the former as long as it is as good, -1 where none has any;
    ``cameras`` (K,): how many have it.
    """

    fronts: FloatArray
    lead: IntArray
    cameras: IntArray


def sights_along(
    faces: Faces, points: FloatArray, displacements: FloatArray, camera_centres: FloatArray
) -> Sights:
    """Which faces of the body at ``points`` (m, 4) the cameras have along ``displacements`` (K, 4, 4) of it.

    Samples without a lead, or with fewer cameras than a law needs, are stretches that only the kinematics carry.
    """
    fronts = faces_fronting(
        np.ascontiguousarray(points),
        faces.triples,
        faces.sided,
        np.ascontiguousarray(displacements),
        camera_centres,
    )
    counts = fronts.sum(axis=2).astype(np.int64)
    lead, cameras = np.full(len(fronts), -1, np.int64), np.zeros(len(fronts), np.int64)
    held = -1
    for s, count in enumerate(counts):
        if count.size and int(count.max()) > 0:
            if held < 0 or count[held] < count.max():
                held = int(count.argmax())
            lead[s], cameras[s] = held, count[held]
        else:
            held = -1
    return Sights(fronts, lead, cameras)


# -- kernels, without BLAS ------------------------------------------------------------------------------------


@kernel
def seen_whole(starts: IntArray, members: IntArray, seen: FloatArray) -> IntArray:
    """1 (g,) where no camera of ``seen`` (c, m) sees only a part of a group, else 0. See `MarkerGroups`."""
    groups = starts.shape[0] - 1
    whole = np.ones(groups, np.int64)
    for g in range(groups):
        for c in range(seen.shape[0]):
            sights = 0
            for nth in range(starts[g], starts[g + 1]):
                if seen[c, members[nth]] > 0.0:
                    sights += 1
            if 0 < sights < starts[g + 1] - starts[g]:
                whole[g] = 0
    return whole


@kernel
def covering_groups(
    starts: IntArray, members: IntArray, sides: IntArray, rank: IntArray, markers: int
) -> IntArray:
    """Which groups, in the order of their ``rank`` (g,), are faces: they bring markers that none before has.

    First those of four and more with nothing on one side, then those of four and more at all, three new markers each;
    then any with nothing on one side, one new marker each.
    """
    groups = rank.shape[0]
    left = np.ones(markers, np.int64)
    chosen = np.empty(groups, np.int64)
    found = 0
    for step in range(3):
        for nth in range(groups):
            g = rank[nth]
            bounds = sides[g, 0] == 0 or sides[g, 1] == 0
            size = starts[g + 1] - starts[g]
            if (step == 0 and not bounds) or (step < 2 and size < 4) or (step == 2 and not bounds):
                continue
            new = 0
            for i in range(starts[g], starts[g + 1]):
                new += left[members[i]]
            if new >= (3 if step < 2 else 1):
                chosen[found] = g
                found += 1
                for i in range(starts[g], starts[g + 1]):
                    left[members[i]] = 0
    return chosen[:found]


@kernel
def outward_faces(
    triples: IntArray,
    starts: IntArray,
    members: IntArray,
    sides: IntArray,
    rank: IntArray,
    points: FloatArray,
    camera_centres: FloatArray,
    seen: FloatArray,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Triples (f, 3) in outward order, members (f, m) and whether the outward side is known (f,) of the `Faces`.

    What cameras see outweighs where the rest of the body is.
    """
    chosen = covering_groups(starts, members, sides, rank, points.shape[0])
    faces = chosen.shape[0]
    outward = np.empty((faces, 3), np.int64)
    belongs, sided = np.zeros((faces, points.shape[0])), np.zeros(faces)
    for f in range(faces):
        g = chosen[f]
        i, j, k = triples[g, 0], triples[g, 1], triples[g, 2]
        plane = minors(points[i], points[j], points[k])
        votes = 0
        for c in range(seen.shape[0]):
            sights = 0
            for nth in range(starts[g], starts[g + 1]):
                if seen[c, members[nth]] > 0.0:
                    sights += 1
            if sights >= 3:
                votes += 1 if dot(plane, camera_centres[c]) > 0.0 else -1
        if votes == 0:
            votes = (1 if sides[g, 1] > 0 else 0) - (1 if sides[g, 0] > 0 else 0)
        outward[f, 0] = i
        outward[f, 1], outward[f, 2] = (k, j) if votes < 0 else (j, k)
        sided[f] = 0.0 if votes == 0 else 1.0
        for nth in range(starts[g], starts[g + 1]):
            belongs[f, members[nth]] = 1.0
    return outward, belongs, sided


@kernel
def faces_fronting(
    points: FloatArray,
    triples: IntArray,
    sided: FloatArray,
    displacements: FloatArray,
    camera_centres: FloatArray,
) -> FloatArray:
    """1 (K, f, c) where a face of the body, moved by ``displacements`` (K, 4, 4), shows its front; else 0.

    ``points`` (m, 4) now, of height 1 like ``camera_centres`` (c, 4); ``triples`` (f, 3) in outward order; a face whose
    outward side is not known, ``sided`` (f,) 0, counts as seen from both.
    """
    samples, faces, cameras = displacements.shape[0], triples.shape[0], camera_centres.shape[0]
    out = np.ones((samples, faces, cameras))
    moved = np.empty((3, 4))
    for s in range(samples):
        for f in range(faces):
            if not sided[f] > 0.0:
                continue
            for corner in range(3):
                for i in range(4):
                    moved[corner, i] = dot(displacements[s, i], points[triples[f, corner]])
            plane = minors(moved[0], moved[1], moved[2])
            for c in range(cameras):
                if not dot(plane, camera_centres[c]) > 0.0:
                    out[s, f, c] = 0.0
    return out
