"""Coplanar groups of a body's markers, from projective points and the views that determine them: the candidates for its
faces.

Nothing here is metric, and nothing depends on the current visibility: the groups belong to a model. A marker is in the
plane of three others if the determinant of the four is within a few of its own standard deviations, for pixels with a
standard deviation ``sigma_px``. If the plates themselves are less flat than the cameras are accurate, state a
``sigma_px`` that covers it.

All triples of up to `EXHAUSTIVE` markers are tried. If there are more, only triples of neighbouring markers are tried,
each replaced by the triple that spans its plane best: of the order of m², not m⁴. This is computed when a model is
made, not in a control step.
"""

from __future__ import annotations

import math
from itertools import chain
from typing import NamedTuple

import msgspec
import numpy as np

from stereoservo.control.cartesian_components import dot, minors
from stereoservo.kinematics.kernels import exp_twist, invert4
from stereoservo.kinematics.model import CellModel, MarkerGroup
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.motion_frame import average_over_rotations

FLAT_PX = 0.05
"""A good ``sigma_px`` for the markers of a calibrated model on plates flat to some tenths of a millimetre.

Larger values include markers of the next face that are near the common edge.
"""
IN_PLANE = 4.0
"""Standard deviations up to which a marker is in a plane."""
SPANS = 10.0
"""Least altitude of a triangle, in standard deviations, that determines a plane."""
AVERAGING_ROUNDS = 3
"""Number of averages over an arm's rotations, one joint after another."""
EXHAUSTIVE = 32
"""Number of markers of which all triples are tried."""
NEAR = 8
"""Number of nearest markers of each that form planes with it, if there are more."""
LOCAL = 24
"""Number of nearest markers among which the plane of three neighbours is widened first."""
WIDEST = 16
"""Number of markers of a plane among which its widest triple is searched; if there are more, as many that are spread
out.
"""
MOST_GROUPS = 1024
"""Number of groups that are kept if not all triples are tried: those of most markers, the roundest of these."""

TRIAL_TURN = 0.3
"""Motion of joints to and fro [rad], and a third of it [m], for views like those of calibration."""
NEAREST, FARTHEST = 0.5, 2.0
"""Range of the depth of a marker in such a view, relative to its current depth."""


class MarkerGroups(NamedTuple):
    """g groups of coplanar markers that may be faces: of four and more, or with no marker on one side.

    ``triples`` (g, 3): three that determine the plane best.
    ``starts`` (g + 1,): start of each group's members in ``members`` (k,), ascending.
    ``sides`` (g, 2): numbers of other markers above and below.
    ``roundness`` (g,): altitude of the triple over the group's extent.

    In the order in which they were found: the most accurate planes first.
    """

    triples: IntArray
    starts: IntArray
    members: IntArray
    sides: IntArray
    roundness: FloatArray


def no_groups() -> MarkerGroups:
    """No groups: the markers span no plane."""
    none = np.zeros((0, 3), np.int64), np.zeros(1, np.int64), np.zeros(0, np.int64)
    return MarkerGroups(*none, np.zeros((0, 2), np.int64), np.zeros(0))


def find_groups(
    points: FloatArray,
    matrices: FloatArray,
    sigma_px: float,
    operators: FloatArray,
    limit: float = IN_PLANE,
    exhaustive: int = EXHAUSTIVE,
) -> MarkerGroups:
    """Coplanar groups of ``points`` (m, 4) of height 1.

    ``matrices`` (k, 3, 4): the views that determine the markers; cameras that saw the body in several poses are views
    ``P H_i``.
    ``sigma_px`` [px]: standard deviation of pixels.
    ``limit``: largest distance from a plane in standard deviations.
    ``operators`` (n, 4, 4): of the arm that moves the body, at its current posture. The markers are assumed to be known
    also from views after a small motion of each joint, as in calibration;
    this makes lengths comparable that one view foreshortens.

    There are no groups for fewer than three markers, for collinear markers, and for markers that the views do not
    determine.
    """
    views = trial_views(points, matrices, operators)
    # further views add directions, not observations: systematic errors do not average out
    sigma = sigma_px * float(np.sqrt(len(views) / max(1, len(matrices))))
    information = marker_information(points, views, sigma)
    covariances = marker_covariances(points, information)
    m = len(points)
    if m < 3 or not np.isfinite(covariances).all():
        return no_groups()
    form = turned_average(information, operators)
    distances = marker_distances(points, form)
    if m <= exhaustive:
        triples = all_triples(m)
    else:
        triples = near_triples(points, covariances, form, distances, limit)
    altitudes = triangle_altitudes(points, form, triples)
    order = np.argsort(-altitudes, kind="stable")
    order = order[altitudes[order] >= SPANS]
    members, facts, roundness = coplanar_groups(points, covariances, triples[order], altitudes[order], distances, limit)
    eligible = np.flatnonzero((facts[:, 3] > 3) | (facts[:, 4:].min(axis=1, initial=m) == 0))
    if m > exhaustive:
        rank = np.lexsort((-roundness[eligible], -facts[eligible, 3]))
        eligible = np.sort(eligible[rank[:MOST_GROUPS]])
    facts = facts[eligible]
    return MarkerGroups(
        np.ascontiguousarray(facts[:, :3]),
        np.concatenate([np.zeros(1, np.int64), np.cumsum(facts[:, 3])]),
        np.ascontiguousarray(np.nonzero(members[eligible])[1]),
        np.ascontiguousarray(facts[:, 4:]),
        roundness[eligible],
    )


# -- with a model ---------------------------------------------------------------------------------------------


def with_groups(model: CellModel) -> CellModel:
    """``model`` with the coplanar groups of its markers, unless it has them."""
    if model.marker_groups is not None:
        return model
    groups = find_groups(
        np.ascontiguousarray(model.marker_points, dtype=np.float64),
        np.ascontiguousarray([camera.matrix for camera in model.cameras], dtype=np.float64),
        FLAT_PX,
        np.ascontiguousarray(model.generators, dtype=np.float64),
    )
    found = tuple(
        MarkerGroup(
            (int(triple[0]), int(triple[1]), int(triple[2])),
            tuple(groups.members[first:last].tolist()),
            int(sides[0]),
            int(sides[1]),
            float(roundness),
        )
        for triple, first, last, sides, roundness in zip(
            groups.triples, groups.starts[:-1], groups.starts[1:], groups.sides, groups.roundness, strict=True
        )
    )
    return msgspec.structs.replace(model, marker_groups=found)


def groups_of(model: CellModel) -> MarkerGroups | None:
    """The coplanar groups of a model's markers as arrays; None if it states none."""
    given = model.marker_groups
    if not given:
        return None if given is None else no_groups()
    members = [group.members for group in given]
    triples = np.fromiter(chain.from_iterable(group.triple for group in given), np.int64, 3 * len(given))
    sides = np.fromiter(chain.from_iterable((g.above, g.below) for g in given), np.int64, 2 * len(given))
    return MarkerGroups(
        triples.reshape(-1, 3),
        np.cumsum([0, *map(len, members)], dtype=np.int64),
        np.fromiter(chain.from_iterable(members), np.int64),
        sides.reshape(-1, 2),
        np.fromiter((group.roundness for group in given), np.float64, len(given)),
    )


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
    """``P exp(±s Ĥ_j)`` (k, 3, 4) in addition to the cameras ``P`` themselves, if all markers stay well in front of
    them.
    """
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
    """Covariances (m, 4, 4) for planes through the points; NaN where the views do not determine one.

    The information has no component along the point itself, its scale. It is regularised in that direction, which has
    no effect on planes that pass through the point.
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
    """The markers' mean information (4, 4), averaged over the rotations of an arm's revolute ``operators`` (n, 4, 4).

    It is used as a form on differences of points (height 0), which displacements only rotate: with two or more axes
    that are not parallel it becomes isotropic, unlike that of a single view.
    """
    mean = np.zeros((4, 4))
    for p in range(information.shape[0]):
        for i in range(4):
            for k in range(4):
                mean[i, k] += information[p, i, k] / information.shape[0]
    for _ in range(AVERAGING_ROUNDS):
        for j in range(operators.shape[0]):
            if _turns(operators[j]):
                average_over_rotations(mean, operators[j])
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
    """``det[M_i M_j M_k M_l]`` in its own standard deviations (m,), for every marker l; 0 for the three themselves."""
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
    """All triples of so many markers (t, 3), ascending."""
    out = np.empty((markers * (markers - 1) * (markers - 2) // 6, 3), np.int64)
    t = 0
    for i in range(markers):
        for j in range(i + 1, markers):
            for k in range(j + 1, markers):
                out[t, 0], out[t, 1], out[t, 2] = i, j, k
                t += 1
    return out


@kernel
def marker_distances(points: FloatArray, form: FloatArray) -> FloatArray:
    """Distances (m, m) of markers, heights 1, by a form (4, 4) on their differences."""
    markers = points.shape[0]
    out = np.zeros((markers, markers))
    edge = np.empty(4)
    for i in range(markers):
        for k in range(markers):
            for x in range(4):
                edge[x] = points[k, x] - points[i, x]
            out[i, k] = math.sqrt(max(0.0, _form(edge, form, edge)))
    return out


@kernel
def altitude(points: FloatArray, form: FloatArray, i: int, j: int, k: int) -> float:
    """Least altitude of the triangle of three points, by a form (4, 4) on differences of points."""
    least = math.inf
    along, off = np.empty(4), np.empty(4)
    corners = np.array([i, j, k])
    for corner in range(3):
        a, b, c = corners[corner], corners[(corner + 1) % 3], corners[(corner + 2) % 3]
        for x in range(4):
            off[x] = points[b, x] - points[a, x]
            along[x] = points[c, x] - points[b, x]
        length = _form(along, form, along)
        mixed = _form(along, form, off)
        left = _form(off, form, off) - (mixed * mixed / length if length > 0.0 else 0.0)
        least = min(least, math.sqrt(max(0.0, left)))
    return least


@kernel
def triangle_altitudes(points: FloatArray, form: FloatArray, triples: IntArray) -> FloatArray:
    """Least altitudes (t,) of triangles, by a form (4, 4) on differences of points."""
    out = np.empty(triples.shape[0])
    for t in range(triples.shape[0]):
        out[t] = altitude(points, form, triples[t, 0], triples[t, 1], triples[t, 2])
    return out


@kernel
def coplanar_groups(
    points: FloatArray,
    covariances: FloatArray,
    triples: IntArray,
    altitudes: FloatArray,
    distances: FloatArray,
    limit: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Groups of markers in one plane, starting with the triples that determine their planes best.

    ``triples`` (t, 3), ``altitudes`` (t,): the largest first; triples inside a group of four that was found are
    skipped.

    Returns members (g, m) 1 or 0; facts (g, 6): the triple, markers in it, others above and below; roundness (g,):
    altitude over the longest of ``distances`` (m, m) in it.
    """
    count, markers = triples.shape[0], points.shape[0]
    members = np.zeros((count, markers), np.int64)
    facts = np.zeros((count, 6), np.int64)
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
        roundness[groups] = altitudes[t] / longest
        if facts[groups, 3] > 3:
            larger[many] = groups
            many += 1
        groups += 1
    return members[:groups], facts[:groups], roundness[:groups]


@kernel
def spaced(distances: FloatArray, candidates: IntArray, count: int) -> IntArray:
    """At most ``count`` of the ``candidates`` (k,), ascending, each the farthest from those before it.

    ``distances`` (m, m); the first is the farthest from the first candidate.
    """
    k = candidates.shape[0]
    if k <= count:
        return candidates.copy()
    chosen = np.zeros(k, np.bool_)
    nearest = np.empty(k)
    for a in range(k):
        nearest[a] = distances[candidates[0], candidates[a]]
    for nth in range(count):
        far = -1
        for a in range(k):
            if not chosen[a] and (far < 0 or nearest[a] > nearest[far]):
                far = a
        chosen[far] = True
        for a in range(k):
            away = distances[candidates[far], candidates[a]]
            nearest[a] = away if nth == 0 else min(nearest[a], away)
    return candidates[chosen]


@kernel
def _widest(points: FloatArray, form: FloatArray, distances: FloatArray, candidates: IntArray) -> IntArray:
    """The three of the ``candidates`` (k,), ascending, with the largest altitude; of many, only spread
    ones are tried.
    """
    few = spaced(distances, candidates, WIDEST)
    best = np.zeros(3, np.int64)
    largest = -1.0
    for i in range(few.shape[0]):
        for j in range(i + 1, few.shape[0]):
            for k in range(j + 1, few.shape[0]):
                here = altitude(points, form, few[i], few[j], few[k])
                if here > largest:
                    largest = here
                    best[0], best[1], best[2] = few[i], few[j], few[k]
    return best


@kernel
def near_triples(
    points: FloatArray, covariances: FloatArray, form: FloatArray, distances: FloatArray, limit: float
) -> IntArray:
    """Triples (t, 3), ascending, that determine the planes of neighbouring markers: each plane's widest ones.

    From each marker and two of its nearest: the widest triple of their plane among the markers around, then among all,
    as long as the initial three are in its plane.
    """
    markers = points.shape[0]
    near, local = min(NEAR, markers - 1), min(LOCAL, markers - 1)
    out = np.empty((markers * near * (near - 1), 3), np.int64)
    known = np.zeros((markers * near * (near - 1) // 2, markers), np.bool_)  # planes of four and more
    count, planes = 0, 0
    around = np.empty(local + 1, np.int64)
    seed = np.empty(3, np.int64)
    for i in range(markers):
        nearest = np.argsort(distances[i], kind="mergesort")
        for a in range(local + 1):
            around[a] = nearest[a]
        for a in range(1, near + 1):
            for b in range(a + 1, near + 1):
                seed[0], seed[1], seed[2] = i, nearest[a], nearest[b]
                found = altitude(points, form, seed[0], seed[1], seed[2]) < SPANS
                for nth in range(planes):
                    found = found or (known[nth, seed[0]] and known[nth, seed[1]] and known[nth, seed[2]])
                if found:
                    continue
                inside = np.abs(off_plane(points, covariances, seed[0], seed[1], seed[2])) <= limit
                triple = _widest(points, form, distances, np.sort(around[inside[around]]))
                out[count] = triple
                count += 1
                inside = np.abs(off_plane(points, covariances, triple[0], triple[1], triple[2])) <= limit
                wider = _widest(points, form, distances, np.nonzero(inside)[0])
                within = np.abs(off_plane(points, covariances, wider[0], wider[1], wider[2])) <= limit
                if within[seed[0]] and within[seed[1]] and within[seed[2]]:
                    out[count] = wider
                    count += 1
                    if within.sum() > 3:
                        known[planes] = within
                        planes += 1
    return out[:count].copy()
