"""Finding faces in numba, without BLAS: the steps of `control.faces.find_faces`. Read that first."""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.primitives_kernel import dot, minors
from stereoservo.kinematics.kernels import exp_twist, invert4
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.motion_frame import average_over_turns

AVERAGING_ROUNDS = 3
"""How often an arm's turns are averaged over, one joint after another."""


TRIAL_TURN = 0.3
"""How far [rad], and a third of it [m], joints are moved to and fro for the views that calibration had."""
NEAREST, FARTHEST = 0.5, 2.0
"""Depths, relative to those now, that a marker may have in such a view."""


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


LEAST_ALTITUDE = 10.0
"""Least altitude of a triangle in an image that counts as a face's sight, in deviations of its worst marker."""
CLEARLY_BETTER = 2.0
"""Ratio of image areas from which on another triangle takes over."""
LASTING = 8.0
"""How many times its area a triangle counts that shows its front at the goal too."""


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


@kernel
def triangle_sight(i: int, j: int, k: int, pixels: FloatArray, weights: FloatArray) -> tuple[int, float]:
    """Cameras that see a triangle well, and its areas there, in squared deviations of its worst marker, summed."""
    count, area = 0, 0.0
    for c in range(weights.shape[0]):
        weight = min(weights[c, i], weights[c, j], weights[c, k])
        if not weight > 0.0:
            continue
        ux, uy = pixels[c, j, 0] - pixels[c, i, 0], pixels[c, j, 1] - pixels[c, i, 1]
        vx, vy = pixels[c, k, 0] - pixels[c, i, 0], pixels[c, k, 1] - pixels[c, i, 1]
        wx, wy = vx - ux, vy - uy
        double = abs(ux * vy - uy * vx)
        longest = math.sqrt(max(ux * ux + uy * uy, vx * vx + vy * vy, wx * wx + wy * wy))
        if double * weight >= LEAST_ALTITUDE * longest and longest > 0.0:
            count += 1
            area += 0.5 * double * weight * weight
    return count, area


@kernel
def choose_triangle(
    members: FloatArray,
    lasting: FloatArray,
    usable: FloatArray,
    pixels: FloatArray,
    weights: FloatArray,
    face_now: int,
    triple_now: IntArray,
) -> tuple[int, IntArray, int]:
    """Face (-1: across faces), its three markers and the cameras that see them (0: there are none).

    See `control.faces.choose_face`; the order of the markers is not yet outward. ``lasting`` (f,), ``usable`` (m,).
    """
    faces, markers = members.shape
    best = np.zeros(3, np.int64)
    best_face, best_count, best_area = -1, 0, 0.0
    # faces first; across faces only where none is seen
    for f in range(faces + 1):
        if f == faces and best_count > 0:
            break
        for i in range(markers):
            if not (usable[i] > 0.0 and (f == faces or members[f, i] > 0.0)):
                continue
            for j in range(i + 1, markers):
                if not (usable[j] > 0.0 and (f == faces or members[f, j] > 0.0)):
                    continue
                for k in range(j + 1, markers):
                    if not (usable[k] > 0.0 and (f == faces or members[f, k] > 0.0)):
                        continue
                    count, area = triangle_sight(i, j, k, pixels, weights)
                    if f < faces and lasting[f] > 0.0:
                        area *= LASTING
                    if count > best_count or (count == best_count and area > best_area):
                        best_face, best_count, best_area = (f if f < faces else -1), count, area
                        best[0], best[1], best[2] = i, j, k
    if face_now >= -1 and (face_now >= 0 or best_face < 0):
        good = True
        for corner in range(3):
            good = good and usable[triple_now[corner]] > 0.0
        if good:
            count, area = triangle_sight(triple_now[0], triple_now[1], triple_now[2], pixels, weights)
            if face_now >= 0 and lasting[face_now] > 0.0:
                area *= LASTING
            if count > 0 and count >= best_count and best_area <= CLEARLY_BETTER * area:
                return face_now, triple_now.copy(), count
    return best_face, best, best_count


@kernel
def choose_face_step(
    triples: IntArray,
    members: FloatArray,
    sided: FloatArray,
    body: FloatArray,
    points: FloatArray,
    pixels: FloatArray,
    weights: FloatArray,
    targets: FloatArray,
    target_known: FloatArray,
    camera_centres: FloatArray,
    face_now: int,
    triple_now: IntArray,
) -> tuple[int, IntArray, int, FloatArray]:
    """`control.faces.choose_face` on arrays: face, outward triple (3,), cameras and kept (c,)."""
    faces, markers = members.shape
    cameras = camera_centres.shape[0]
    usable = np.zeros(markers)
    for p in range(markers):
        height = points[p, 0] + points[p, 1] + points[p, 2] + points[p, 3]
        if target_known[p] > 0.0 and math.isfinite(height):
            usable[p] = 1.0
    lasting = np.zeros(faces)
    for f in range(faces):
        plane = minors(targets[triples[f, 0]], targets[triples[f, 1]], targets[triples[f, 2]])
        for c in range(cameras):
            if sided[f] > 0.0 and dot(plane, camera_centres[c]) > 0.0:
                lasting[f] = 1.0
    face, triple, count = choose_triangle(members, lasting, usable, pixels, weights, face_now, triple_now)
    kept = np.zeros(cameras)
    if count == 0:
        return -2, triple_now.copy(), 0, kept
    i, j, k = triple
    side = 0.0
    if face >= 0 and sided[face] > 0.0:
        outward = minors(body[triples[face, 0]], body[triples[face, 1]], body[triples[face, 2]])
        side = dot(outward, minors(body[i], body[j], body[k]))
    else:  # the side that most cameras see
        plane = minors(points[i], points[j], points[k])
        for c in range(cameras):
            if weights[c, i] > 0.0 and weights[c, j] > 0.0 and weights[c, k] > 0.0:
                side += 1.0 if dot(plane, camera_centres[c]) > 0.0 else -1.0
    if side < 0.0:
        triple[1], triple[2] = k, j
    now = minors(points[triple[0]], points[triple[1]], points[triple[2]])
    then = minors(targets[triple[0]], targets[triple[1]], targets[triple[2]])
    for c in range(cameras):
        if dot(now, camera_centres[c]) > 0.0 and dot(then, camera_centres[c]) > 0.0:
            kept[c] = 1.0
    return face, triple, count, kept
