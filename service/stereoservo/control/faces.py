"""Faces of a marker body: which markers are coplanar and which side of them is outward, from projective points and the
images; and which faces the cameras see along a path.

Nothing here is metric: markers are points of height ``a∞ᵀM = 1`` in the projective frame, and what "in one plane" means
is decided by the images. A marker is in the plane of three others when the determinant of the four is within a few of
its own standard deviations, those that pixels of a deviation ``sigma_px`` leave. Where the plates themselves are less
flat than the cameras are sharp, state a ``sigma_px`` that covers it.

A face has no other marker on one of its sides; that is where the body is, the other one is out, unless the cameras
that see its markers say otherwise (an inner corner). Planes are signed minors of three markers in outward order: with
camera centres O of height 1, ``aᵀO > 0`` where the front is seen (7.4.2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.primitives_kernel import dot, minors
from stereoservo.kinematics.kernels import exp_twist, invert4
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.motion_frame import average_over_turns

FLAT_PX = 0.05
"""A good ``sigma_px`` for the markers of a calibrated model on plates flat to some tenths of a millimetre.

Larger ones take in markers of the next face that stand near the common edge.
"""
IN_PLANE = 4.0
"""Standard deviations up to which a marker is in a plane."""
SPANS = 10.0
"""Altitude of a triangle, in standard deviations, from which on it tells a plane."""
AVERAGING_ROUNDS = 3
"""How often an arm's turns are averaged over, one joint after another."""


TRIAL_TURN = 0.3
"""How far [rad], and a third of it [m], joints are moved to and fro for the views that calibration had."""
NEAREST, FARTHEST = 0.5, 2.0
"""Depths, relative to those now, that a marker may have in such a view."""


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

    ``matrices`` (k, 3, 4): the views that fix the markers; cameras that saw the body in several poses are views
    ``P H_i``. Likewise ``camera_centres`` (c, 4), ``H_i⁻¹O``, with ``seen``: the more, the surer. ``sigma_px`` [px],
    ``limit`` deviations from a plane. ``operators`` (n, 4, 4) of an arm that moves the body, as it stands: the markers
    count as known from views a small motion of each joint away too, as calibration had them, and lengths become
    comparable that one view foreshortens.

    Regular bodies have coplanar markers that are no face: chamfers, diagonals. Groups of four and more come first,
    those that no camera sees in part before others, those of many markers before few, round before narrow, as long as
    they bring three new markers; then what is left takes part in planes with no marker on one side. Markers inside the
    body, on no such plane, belong to no face. Fewer than three markers, or all on one line, have none, nor
    have markers of which the views do not fix one. Raises ValueError for arrays that do not fit and for numbers that
    are not finite.
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
    views = trial_views(points, given, turns)
    # further views stand for other directions, not for more sights: what is systematic does not average out
    information = marker_information(
        points, views, sigma_px * float(np.sqrt(len(views) / max(1, len(given))))
    )
    covariances = marker_covariances(points, information)
    if m < 3 or not np.isfinite(covariances).all():
        return Faces(np.zeros((0, 3), np.int64), np.zeros((0, m)), np.zeros(0), points)
    form = turned_average(information, turns)
    triples = all_triples(m)
    altitudes = triangle_altitudes(points, form, triples)
    order = np.argsort(-altitudes, kind="stable")
    order = order[altitudes[order] >= SPANS]
    members, facts, roundness = coplanar_groups(
        points, covariances, triples[order], altitudes[order], marker_distances(points, form), seen, limit
    )
    rank = np.lexsort((-roundness, -facts[:, 3], -facts[:, 6]))
    members, facts = members[rank], facts[rank]
    chosen = covering_groups(members, facts)
    members, facts = members[chosen], facts[chosen]
    sides = np.array(
        [
            _side(group, fact, plane, centres, seen)
            for group, fact, plane in zip(members, facts, _planes(points, facts), strict=True)
        ],
        np.int64,
    )
    outward = facts[:, :3].copy()
    outward[sides < 0] = outward[sides < 0][:, [0, 2, 1]]
    return Faces(outward, members.astype(np.float64), np.abs(sides).astype(np.float64), points)


def _side(
    members: IntArray, facts: IntArray, plane: FloatArray, centres: FloatArray, seen: FloatArray
) -> int:
    """1 where the triple of a group in a ``plane`` (4,) is in outward order, -1 where it is not, 0 where it is open."""
    votes = 0
    for eye, row in zip(centres, seen, strict=True):
        if ((row > 0.0) & (members > 0)).sum() >= 3:
            votes += 1 if float((plane * eye).sum()) > 0.0 else -1
    # what cameras see outweighs where the rest of the body is
    return int(np.sign(votes)) if votes != 0 else int(facts[5] > 0) - int(facts[4] > 0)


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


def kept_faces(faces: Faces, points: FloatArray, targets: FloatArray, camera_centres: FloatArray) -> IntArray:
    """Outward triples (k, 3) of the faces that some camera has both now and at the goal: those that a plan must keep.

    Empty where the body turns so far that no face lasts: the way has to hand over (`sights_along`). Faces whose side is
    not known ask for nothing.
    """
    eye = np.eye(4)[None]
    now = faces_fronting(np.ascontiguousarray(points), faces.triples, faces.sided, eye, camera_centres)[0]
    then = faces_fronting(np.ascontiguousarray(targets), faces.triples, faces.sided, eye, camera_centres)[0]
    lasting = ((now > 0.0) & (then > 0.0)).any(axis=1) & (faces.sided > 0.0)
    return np.ascontiguousarray(faces.triples[lasting])


# -- kernels, without BLAS ------------------------------------------------------------------------------------


@kernel
def _turns(operator: FloatArray) -> bool:
    """Whether a joint's operator (4, 4), of eigenvalues ±i or none, is a revolute one's."""
    trace = 0.0
    for i in range(4):
        for k in range(4):
            trace += operator[i, k] * operator[k, i]
    return trace < -1.0


@kernel
def trial_views(points: FloatArray, matrices: FloatArray, operators: FloatArray) -> FloatArray:
    """``P exp(±s Ĥ_j)`` (k, 3, 4) besides the cameras ``P`` themselves, where all markers stay well before them."""
    cameras, n = matrices.shape[0], operators.shape[0]
    views = np.empty((cameras * (2 * n + 1), 3, 4))
    count = 0
    moved = np.empty((3, 4))
    for step in range(2 * n + 1):
        H = np.eye(4)
        if step > 0:
            j = (step - 1) // 2
            size = TRIAL_TURN if _turns(operators[j]) else TRIAL_TURN / 3.0
            H = exp_twist((size if step % 2 == 1 else -size) * operators[j])
        for c in range(cameras):
            for r in range(3):
                for k in range(4):
                    moved[r, k] = 0.0
                    for i in range(4):
                        moved[r, k] += matrices[c, r, i] * H[i, k]
            good = True
            for p in range(points.shape[0]):
                ratio = dot(moved[2], points[p]) / dot(matrices[c, 2], points[p])
                good = good and NEAREST < ratio < FARTHEST
            if good:
                for r in range(3):
                    for k in range(4):
                        views[count, r, k] = moved[r, k]
                count += 1
    return views[:count].copy()


@kernel
def marker_information(points: FloatArray, matrices: FloatArray, sigma_px: float) -> FloatArray:
    """``JᵀJ / σ²`` (m, 4, 4) of the markers' coordinates, ``J`` of their pixels in the views (k, 3, 4)."""
    markers, views = points.shape[0], matrices.shape[0]
    information = np.zeros((markers, 4, 4))
    row = np.empty(4)
    for p in range(markers):
        for c in range(views):
            P, M = matrices[c], points[p]
            depth = P[2, 0] * M[0] + P[2, 1] * M[1] + P[2, 2] * M[2] + P[2, 3] * M[3]
            for r in range(2):
                x = P[r, 0] * M[0] + P[r, 1] * M[1] + P[r, 2] * M[2] + P[r, 3] * M[3]
                for i in range(4):
                    row[i] = (P[r, i] - x / depth * P[2, i]) / (depth * sigma_px)
                for i in range(4):
                    for k in range(4):
                        information[p, i, k] += row[i] * row[k]
    return information


@kernel
def marker_covariances(points: FloatArray, information: FloatArray) -> FloatArray:
    """Covariances (m, 4, 4) for planes through the points; NaN where the views do not fix one.

    The information is blind along the point itself, its scale: so much of it is added there, which no plane sees that
    passes through the point.
    """
    covariances = np.empty(information.shape)
    filled = np.empty((4, 4))
    for p in range(points.shape[0]):
        trace = information[p, 0, 0] + information[p, 1, 1] + information[p, 2, 2] + information[p, 3, 3]
        square = 0.0
        for i in range(4):
            square += points[p, i] * points[p, i]
        for i in range(4):
            for k in range(4):
                filled[i, k] = (information[p, i, k] + trace * points[p, i] * points[p, k] / square) / trace
        inverse = invert4(filled)
        good = True
        for i in range(4):
            good = good and 0.0 < inverse[i, i] < 1e12
        for i in range(4):
            for k in range(4):
                covariances[p, i, k] = inverse[i, k] / trace if good else math.nan
    return covariances


@kernel
def turned_average(information: FloatArray, operators: FloatArray) -> FloatArray:
    """The markers' mean information, averaged over the turns that an arm's revolute ``operators`` (n, 4, 4) make.

    As a form on differences of points (height 0), which displacements only turn: with two axes or more that are not
    parallel it becomes the same in all directions, as no single view is. (4, 4).
    """
    mean = np.zeros((4, 4))
    for p in range(information.shape[0]):
        for i in range(4):
            for k in range(4):
                mean[i, k] += information[p, i, k] / information.shape[0]
    for _ in range(AVERAGING_ROUNDS):
        for j in range(operators.shape[0]):
            if _turns(operators[j]):
                average_over_turns(mean, operators[j])
    return mean


@kernel
def _form(a: FloatArray, S: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for i in range(4):
        for k in range(4):
            total += a[i] * S[i, k] * b[k]
    return total


@kernel
def off_plane(points: FloatArray, covariances: FloatArray, i: int, j: int, k: int) -> FloatArray:
    """``det[M_i M_j M_k M_l]`` in deviations of itself (m,), for every marker l; 0 for the three themselves."""
    markers = points.shape[0]
    out = np.zeros(markers)
    four = np.empty(4, np.int64)
    four[0], four[1], four[2] = i, j, k
    for other in range(markers):
        if other in (i, j, k):
            continue
        four[3] = other
        # the determinant is linear in each point: its derivative is the plane of the other three
        variance = 0.0
        determinant = 0.0
        for left_out in range(4):
            x, y, z = (
                four[0 if left_out > 0 else 1],
                four[1 if left_out > 1 else 2],
                four[2 if left_out > 2 else 3],
            )
            plane = minors(points[x], points[y], points[z])
            covariance = covariances[four[left_out]]
            for r in range(4):
                for c in range(4):
                    variance += plane[r] * covariance[r, c] * plane[c]
            determinant = dot(plane, points[four[left_out]])
        out[other] = determinant / math.sqrt(variance)
    return out


@kernel
def all_triples(markers: int) -> IntArray:
    """Every three of so many markers (t, 3), ascending."""
    out = np.empty((markers * (markers - 1) * (markers - 2) // 6, 3), np.int64)
    t = 0
    for i in range(markers):
        for j in range(i + 1, markers):
            for k in range(j + 1, markers):
                out[t, 0], out[t, 1], out[t, 2] = i, j, k
                t += 1
    return out


@kernel
def coplanar_groups(
    points: FloatArray,
    covariances: FloatArray,
    triples: IntArray,
    altitudes: FloatArray,
    distances: FloatArray,
    seen: FloatArray,
    limit: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Groups of markers in one plane, from the triples that tell their planes best on.

    Triples (t, 3) with ``altitudes`` (t,), the largest first; those inside a group of four that was found are passed
    over. Members (g, m) 1 or 0; facts (g, 7): the triple, markers in it, others above and below, and whether no camera
    of ``seen`` (c, m) sees only part; roundness (g,): altitude over the longest of ``distances`` (m, m) in it.
    """
    count, markers = triples.shape[0], points.shape[0]
    members = np.zeros((count, markers), np.int64)
    facts = np.zeros((count, 7), np.int64)
    roundness = np.zeros(count)
    larger = np.zeros(count, np.int64)  # groups of four and more
    inside = np.zeros(markers, np.int64)
    groups, many = 0, 0
    for t in range(count):
        i, j, k = triples[t]
        known = False
        for nth in range(many):
            g = larger[nth]
            if members[g, i] + members[g, j] + members[g, k] == 3:
                known = True
                break
        if known:
            continue
        deviations = off_plane(points, covariances, i, j, k)
        facts[groups, 0], facts[groups, 1], facts[groups, 2] = i, j, k
        for p in range(markers):
            if abs(deviations[p]) <= limit:
                members[groups, p] = 1
                inside[facts[groups, 3]] = p
                facts[groups, 3] += 1
            elif deviations[p] > 0.0:
                facts[groups, 4] += 1
            else:
                facts[groups, 5] += 1
        longest = 0.0
        for first in range(facts[groups, 3]):
            for second in range(facts[groups, 3]):
                longest = max(longest, distances[inside[first], inside[second]])
        facts[groups, 6] = 1
        for c in range(seen.shape[0]):
            sights = 0
            for nth in range(facts[groups, 3]):
                if seen[c, inside[nth]] > 0.0:
                    sights += 1
            if 0 < sights < facts[groups, 3]:
                facts[groups, 6] = 0
        roundness[groups] = altitudes[t] / longest
        if facts[groups, 3] > 3:
            larger[many] = groups
            many += 1
        groups += 1
    return members[:groups], facts[:groups], roundness[:groups]


@kernel
def covering_groups(members: IntArray, facts: IntArray) -> IntArray:
    """Which groups, in the order of their rank, are faces: they bring markers that none before has.

    First those of four and more with nothing on one side, then those of four and more at all, three new markers each;
    then any with nothing on one side, one new marker each.
    """
    groups, markers = members.shape
    left = np.ones(markers, np.int64)
    chosen = np.empty(groups, np.int64)
    found = 0
    for step in range(3):
        for g in range(groups):
            bounds = facts[g, 4] == 0 or facts[g, 5] == 0
            if (step == 0 and not bounds) or (step < 2 and facts[g, 3] < 4) or (step == 2 and not bounds):
                continue
            new = 0
            for p in range(markers):
                new += left[p] * members[g, p]
            if new >= (3 if step < 2 else 1):
                chosen[found] = g
                found += 1
                for p in range(markers):
                    left[p] *= 1 - members[g, p]
    return chosen[:found]


@kernel
def marker_distances(points: FloatArray, form: FloatArray) -> FloatArray:
    """Distances (m, m) of markers, heights 1, by a form (4, 4) on their differences."""
    markers = points.shape[0]
    out = np.zeros((markers, markers))
    way = np.empty(4)
    for i in range(markers):
        for k in range(markers):
            for x in range(4):
                way[x] = points[k, x] - points[i, x]
            out[i, k] = math.sqrt(max(0.0, _form(way, form, way)))
    return out


@kernel
def triangle_altitudes(points: FloatArray, form: FloatArray, triples: IntArray) -> FloatArray:
    """Least altitudes (t,) of triangles, by a form (4, 4) on differences of points."""
    out = np.empty(triples.shape[0])
    along, off = np.empty(4), np.empty(4)
    for t in range(triples.shape[0]):
        out[t] = math.inf
        for corner in range(3):
            i, j, k = triples[t, corner], triples[t, (corner + 1) % 3], triples[t, (corner + 2) % 3]
            for x in range(4):
                off[x] = points[j, x] - points[i, x]
                along[x] = points[k, x] - points[j, x]
            length = _form(along, form, along)
            mixed = _form(along, form, off)
            left = _form(off, form, off) - (mixed * mixed / length if length > 0.0 else 0.0)
            out[t] = min(out[t], math.sqrt(max(0.0, left)))
    return out


@kernel
def _planes(points: FloatArray, triples: IntArray) -> FloatArray:
    """The planes (k, 4) of three points each, by the first three columns of ``triples``."""
    planes = np.empty((triples.shape[0], 4))
    for k in range(triples.shape[0]):
        planes[k] = minors(points[triples[k, 0]], points[triples[k, 1]], points[triples[k, 2]])
    return planes


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
