"""Faces in numba: what the loop runs of `control.faces`, without BLAS. Read that first."""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.law import IntArray
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import invert4, kernel, multiply4_into

LEAST_ALTITUDE = 10.0
"""Least altitude of a triangle in an image that counts as a face's sight, in deviations of its worst marker."""
CLEARLY_BETTER = 2.0
"""Ratio of image areas from which on another triangle takes over."""
LASTING = 8.0
"""How many times its area a triangle counts that shows its front at the goal too."""

AVERAGING_ROUNDS = 3
"""How often an arm's turns are averaged over, one joint after another."""


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
        covariances[p] = invert4(filled)
        for i in range(4):
            if not 0.0 < covariances[p, i, i] < 1e12:
                covariances[p] = math.nan
            for k in range(4):
                covariances[p, i, k] /= trace
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
    square, turn, product = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    for _ in range(AVERAGING_ROUNDS):
        for j in range(operators.shape[0]):
            multiply4_into(operators[j], operators[j], square)
            if not -(square[0, 0] + square[1, 1] + square[2, 2] + square[3, 3]) > 1.0:
                continue  # prismatic: no turn
            total = np.zeros((4, 4))
            # a form is of second degree in sine and cosine: five samples average it exactly
            for sample in range(5):
                angle = 2.0 * math.pi * sample / 5.0
                for i in range(4):
                    for k in range(4):
                        turn[i, k] = (
                            math.sin(angle) * operators[j, i, k] + (1.0 - math.cos(angle)) * square[i, k]
                        )
                    turn[i, i] += 1.0
                multiply4_into(mean, turn, product)
                for i in range(4):
                    for k in range(4):
                        for x in range(4):
                            total[i, k] += 0.2 * turn[x, i] * product[x, k]
            for i in range(4):
                for k in range(4):
                    mean[i, k] = total[i, k]
    return mean


@kernel
def plane_minors(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
    """``aᵀX = det[p q r X]`` (4,): the signed minors of `geometry.homogeneous.plane_of_points`."""
    xy, xz, xw = p[0] * q[1] - p[1] * q[0], p[0] * q[2] - p[2] * q[0], p[0] * q[3] - p[3] * q[0]
    yz, yw, zw = p[1] * q[2] - p[2] * q[1], p[1] * q[3] - p[3] * q[1], p[2] * q[3] - p[3] * q[2]
    a = np.empty(4)
    a[0] = -(r[1] * zw - r[2] * yw + r[3] * yz)
    a[1] = r[0] * zw - r[2] * xw + r[3] * xz
    a[2] = -(r[0] * yw - r[1] * xw + r[3] * xy)
    a[3] = r[0] * yz - r[1] * xz + r[2] * xy
    return a


@kernel
def _dot(a: FloatArray, b: FloatArray) -> float:
    total: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    return total


@kernel
def _form(a: FloatArray, S: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for i in range(4):
        for k in range(4):
            total += a[i] * S[i, k] * b[k]
    return total


@kernel
def off_plane(points: FloatArray, covariances: FloatArray, triples: IntArray) -> FloatArray:
    """``det[M_i M_j M_k M_l]`` in deviations of itself (t, m), for every triple and marker l; 0 for its own markers."""
    count, markers = triples.shape[0], points.shape[0]
    out = np.zeros((count, markers))
    for t in range(count):
        i, j, k = triples[t]
        plane = plane_minors(points[i], points[j], points[k])
        for other in range(markers):
            if other in (i, j, k):
                continue
            # the determinant is linear in each point: its derivative is the plane of the other three
            variance = (
                _own(covariances[other], plane)
                + _own(covariances[i], plane_minors(points[j], points[k], points[other]))
                + _own(covariances[j], plane_minors(points[i], points[k], points[other]))
                + _own(covariances[k], plane_minors(points[i], points[j], points[other]))
            )
            out[t, other] = _dot(plane, points[other]) / math.sqrt(variance)
    return out


@kernel
def _own(S: FloatArray, a: FloatArray) -> float:
    return _form(a, S, a)


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
                    moved[corner, i] = _dot(displacements[s, i], points[triples[f, corner]])
            plane = plane_minors(moved[0], moved[1], moved[2])
            for c in range(cameras):
                if not _dot(plane, camera_centres[c]) > 0.0:
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

    See `control.faces.choose_face`; the order of the markers is not yet outward.
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
def kept_cameras(side: float, now: FloatArray, then: FloatArray, camera_centres: FloatArray) -> FloatArray:
    """1 (c,) for cameras before whose eyes the plane of three points has its front both ``now`` and ``then`` (3, 4)."""
    out = np.zeros(camera_centres.shape[0])
    plane, plane_then = plane_minors(now[0], now[1], now[2]), plane_minors(then[0], then[1], then[2])
    for c in range(camera_centres.shape[0]):
        if side * _dot(plane, camera_centres[c]) > 0.0 and side * _dot(plane_then, camera_centres[c]) > 0.0:
            out[c] = 1.0
    return out
