"""Faces of a marker body: which of the coplanar groups of its markers are faces, and which side of them is outward, as
observed by cameras; which faces the cameras see along a path; and the choice of the three markers that a control law
uses: of one face, seen in most cameras, largest in the images.

A face has no other marker on one of its sides; that side is outward, and the body is on the other one, unless the
cameras that see its markers show the opposite (an inner corner). Planes are signed minors of three markers in outward
order:
with camera centres O of height 1, ``aᵀO > 0`` where the front is seen (7.4.2).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.cartesian_components import dot, minors
from stereoservo.control.law import Scene, Task
from stereoservo.control.marker_groups import IN_PLANE, MarkerGroups, find_groups
from stereoservo.kinematics.kernels import project_points
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import Fields, kernel, plain

LEAST_ALTITUDE = 10.0
"""Least altitude of a triangle in an image for its face to count as seen, in standard deviations of its
worst marker.
"""
CLEARLY_BETTER = 2.0
"""Ratio of image areas above which another triangle is chosen instead."""
MOST_TRIED = 24
"""Number of markers of a face of which all triples are tried; if there are more, as many that are spread out in the
images.
"""
LEAST_TRIED = 6
MAX_EVALUATIONS = 32_768
"""Largest number of triangles times cameras in one choice: for a body with many large faces fewer markers of each are
tried, but at least `LEAST_TRIED`.
"""
LASTING = 8.0
"""Factor on the area of a triangle that shows its front at the goal too."""
SEEN_TO_PX = 0.1
"""Standard deviation of markers [px] assumed when the face of a law is determined in advance."""


class Faces(NamedTuple):
    """f faces of a body of m markers.

    ``triples`` (f, 3): three of the markers, in outward order.
    ``members`` (f, m): 1 where a marker belongs to the face; some markers belong to several.
    ``sided`` (f,): 0 where the outward side is unknown.
    ``body`` (m, 4): the markers when the faces were found, which defines the order.
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

    ``matrices``, ``sigma_px``, ``operators``, ``limit``: see `find_groups`.
    ``camera_centres`` (c, 4), with ``seen``: may include cameras that saw the body in several poses, ``H_i⁻¹O``; more
    of them give more reliable faces.

    Raises ValueError for arrays of wrong shapes and for numbers that are not finite.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    seen = np.ascontiguousarray(seen, dtype=np.float64)
    centres = np.ascontiguousarray(camera_centres, dtype=np.float64)
    m = len(points)
    if points.shape != (m, 4) or seen.shape != (len(centres), m):
        raise ValueError(f"points {points.shape} and seen {seen.shape}; (m, 4) and ({len(centres)}, m) are needed")
    if not np.isfinite(points).all():
        raise ValueError("points must be finite; give the markers of the model, all of them")
    if not 0.0 < sigma_px < np.inf:
        raise ValueError(f"sigma_px is {sigma_px}; a positive finite number of pixels is needed")
    turns = np.zeros((0, 4, 4)) if operators is None else np.ascontiguousarray(operators, dtype=np.float64)
    given = np.ascontiguousarray(matrices, dtype=np.float64)
    return select_faces(find_groups(points, given, sigma_px, turns, limit), points, centres, seen)


def select_faces(groups: MarkerGroups, points: FloatArray, camera_centres: FloatArray, seen: FloatArray) -> Faces:
    """The faces among the coplanar ``groups`` of a body at ``points`` (m, 4), of which the cameras see ``seen`` (c, m).

    Regular bodies have coplanar markers that are no face: chamfers, diagonals. Groups of four and more come first,
    those that no camera sees in part before others, those of many markers before few, round before narrow, as long as
    they add three new markers; then the remaining markers are assigned to planes with no marker on one side. Markers
    inside the body, on no such plane, belong to no face.
    """
    counts = np.diff(groups.starts)
    whole = seen_whole(groups.starts, groups.members, seen)
    rank = np.lexsort((-groups.roundness, -counts, -whole))
    triples, members, sided = outward_faces(groups, rank, points, camera_centres, seen)
    return Faces(triples, members, sided, points)


class FaceVisibility(NamedTuple):
    """Visible faces along a path of K samples: ``fronts`` (K, f, c) 1 where a camera sees a face's front.

    ``lead`` (K,): the face seen by most cameras; the previous one is kept as long as it is equally good; -1 where no
    face is seen.
    ``cameras`` (K,): the number of cameras that see it.
    """

    fronts: FloatArray
    lead: IntArray
    cameras: IntArray


def visibility_along(
    faces: Faces, points: FloatArray, displacements: FloatArray, camera_centres: FloatArray
) -> FaceVisibility:
    """Which faces of the body at ``points`` (m, 4) the cameras see along its ``displacements`` (K, 4, 4).

    Samples without a lead, or with fewer cameras than a law needs, are sections that are controlled by kinematics
    alone.
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
    return FaceVisibility(fronts, lead, cameras)


class FaceChoice(NamedTuple):
    """The markers that a law uses now.

    ``face``: its index, -1 if the three markers are of several faces.
    ``triple`` (3,): their indices, in outward order.
    ``cameras``: number of cameras that see them; 0: none does, and no law can work.
    ``kept`` (c,): 1 for the cameras that see the face's front now and at the goal, and must keep it visible.
    ``changed``: other markers than before.
    """

    face: int
    triple: IntArray
    cameras: int
    kept: FloatArray
    changed: bool


NOT_CHOSEN = FaceChoice(-2, np.zeros(3, np.int64), 0, np.zeros(0), False)
"""The value before the first choice."""


def choose_face(faces: Faces, scene: Scene, task: Task, before: FaceChoice = NOT_CHOSEN) -> FaceChoice:
    """The three markers that a law uses now.

    They belong to one face, seen in most cameras. Among such triples the one with the largest image area in units of
    the noise is chosen, which prefers spread, near and frontal markers. A face whose front some camera sees at the goal
    too has a larger weight. Only markers with a current point (finite) and one at the goal (``target_known``) are used.
    The previous choice is kept until one of its markers is hidden, more cameras see another triple, or another is twice
    as large. If no camera sees three markers of one face, any three are used.
    """
    shown, goal = (scene.points, scene.pixels, scene.weights), (task.target_points, task.target_known)
    face, triple, cameras, kept = _choose_face(
        plain(faces), shown, goal, scene.camera_centres, (before.face, before.triple)
    )
    changed = before.cameras > 0 and (cameras == 0 or set(triple.tolist()) != set(before.triple.tolist()))
    return FaceChoice(face, triple, cameras, kept, changed)


def law_scene(scene: Scene, choice: FaceChoice) -> Scene:
    """The scene for a law that keeps its face visible: without the cameras that do not see it now or at the goal.

    The path cannot depend on these cameras; their observations of the markers are kept.
    """
    if all(choice.kept.tolist()):
        return scene
    operators, composition, matrices, centres, points, pixels, weights = scene
    return Scene(operators, composition, matrices, _kept_rows(centres, choice.kept), points, pixels, weights)


# -- kernels, without BLAS ------------------------------------------------------------------------------------


class ShownBody(NamedTuple):
    """The current markers of a body: ``points`` (m, 4), and in c cameras ``pixels`` (c, m, 2) and ``weights`` (c, m), 0
    where a marker is not seen.
    """

    points: FloatArray
    pixels: FloatArray
    weights: FloatArray


class BodyGoal(NamedTuple):
    """The markers of a body at the goal: ``points`` (m, 4) where ``known`` (m,) is 1."""

    points: FloatArray
    known: FloatArray


class Triangle(NamedTuple):
    """Three markers, ``triple`` (3,), and their ``face``: -1 if they are of several, -2 before the first
    choice.
    """

    face: int
    triple: IntArray


@kernel
def seen_whole(starts: IntArray, members: IntArray, seen: FloatArray) -> IntArray:
    """(g,) 1 where no camera of ``seen`` (c, m) sees only a part of a group, else 0. See `MarkerGroups`."""
    groups = starts.shape[0] - 1
    whole = np.ones(groups, np.int64)
    for g in range(groups):
        for c in range(seen.shape[0]):
            views = 0
            for nth in range(starts[g], starts[g + 1]):
                if seen[c, members[nth]] > 0.0:
                    views += 1
            if 0 < views < starts[g + 1] - starts[g]:
                whole[g] = 0
    return whole


@kernel
def covering_groups(starts: IntArray, members: IntArray, sides: IntArray, rank: IntArray, markers: int) -> IntArray:
    """Which groups, in the order of their ``rank`` (g,), are faces: those that add markers not in a previous one.

    First those of four and more with no marker on one side, then all others of four and more, if they add three new
    markers each; then any with no marker on one side, if they add one new marker each.
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
    groups: MarkerGroups, rank: IntArray, points: FloatArray, camera_centres: FloatArray, seen: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Triples (f, 3) in outward order, members (f, m) and whether the outward side is known (f,) of the `Faces`.

    Observations of cameras take precedence over the position of the rest of the body.
    """
    triples, starts, members, sides, _ = groups
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
            views = 0
            for nth in range(starts[g], starts[g + 1]):
                if seen[c, members[nth]] > 0.0:
                    views += 1
            if views >= 3:
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
    """(K, f, c) 1 where a face of the body, moved by ``displacements`` (K, 4, 4), shows its front; else 0.

    ``points`` (m, 4): current ones, of height 1 like ``camera_centres`` (c, 4).
    ``triples`` (f, 3): in outward order.
    ``sided`` (f,): 0 for a face with unknown outward side, which counts as seen from both.
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
def kept_faces(
    faces: Faces, points: FloatArray, targets: FloatArray, matrices: FloatArray, camera_centres: FloatArray
) -> IntArray:
    """Outward triples (k, 3) of the faces that some camera sees both now and at the goal: a plan must keep these
    visible.

    The face that a law will use comes first, because it determines the path; the order of two equivalent faces in the
    model is arbitrary. Empty if the body rotates so far that no face remains visible: then the path has to change faces
    (`visibility_along`). Faces with unknown side impose no constraint.

    ``points``, ``targets`` (m, 4), ``matrices`` (c, 3, 4), ``camera_centres`` (c, 4): contiguous arrays.
    """
    triples, sided = faces.triples, faces.sided
    identity = np.eye(4).reshape((1, 4, 4))
    now = faces_fronting(points, triples, sided, identity, camera_centres)
    then = faces_fronting(targets, triples, sided, identity, camera_centres)
    lasting = np.zeros(triples.shape[0])
    for f in range(triples.shape[0]):
        for c in range(camera_centres.shape[0]):
            if sided[f] > 0.0 and now[0, f, c] > 0.0 and then[0, f, c] > 0.0:
                lasting[f] = 1.0
    kept = np.zeros((int(lasting.sum()), 3), np.int64)
    count = 0
    if len(kept) > 1:
        pixels = project_points(matrices, points)[0]
        weights, known = np.full(pixels.shape[:2], 1.0 / SEEN_TO_PX), np.ones(len(points))
        face = choose_face_step(
            faces,
            ShownBody(points, pixels, weights),
            BodyGoal(targets, known),
            camera_centres,
            Triangle(-2, np.zeros(3, np.int64)),
        )[0]
        if face >= 0 and lasting[face] > 0.0:
            kept[0], lasting[face], count = triples[face], 0.0, 1
    for f in range(triples.shape[0]):
        if lasting[f] > 0.0:
            kept[count] = triples[f]
            count += 1
    return kept


@kernel
def _kept_rows(rows: FloatArray, kept: FloatArray) -> FloatArray:
    """Those of ``rows`` (c, 4) where ``kept`` (c,) > 0."""
    found = np.empty(rows.shape)
    count = 0
    for c in range(rows.shape[0]):
        if kept[c] > 0.0:
            found[count] = rows[c]
            count += 1
    return found[:count]


@kernel
def triangle_view(i: int, j: int, k: int, pixels: FloatArray, weights: FloatArray) -> tuple[int, float]:
    """Number of cameras that see a triangle well, and the sum of its areas there, in squared standard deviations of its
    worst marker.
    """
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
def spaced_in_images(
    candidates: IntArray, pixels: FloatArray, weights: FloatArray, count: int = MOST_TRIED
) -> IntArray:
    """At most ``count`` of the ``candidates`` (k,), ascending, each the farthest in the images from those before it.

    ``pixels`` (c, m, 2): distances are taken in the cameras that see both markers, ``weights`` (c, m) above 0.
    """
    k = candidates.shape[0]
    if k <= count:
        return candidates.copy()
    chosen = np.zeros(k, np.bool_)
    nearest = np.empty(k)
    latest = 0
    for nth in range(count + 1):  # the first one only serves to find the farthest from it
        far = -1
        for a in range(k):
            i, j = candidates[latest], candidates[a]
            distance2 = 0.0
            for c in range(weights.shape[0]):
                if weights[c, i] > 0.0 and weights[c, j] > 0.0:
                    u, v = pixels[c, j, 0] - pixels[c, i, 0], pixels[c, j, 1] - pixels[c, i, 1]
                    distance2 += u * u + v * v
            nearest[a] = distance2 if nth < 2 else min(nearest[a], distance2)
            if not chosen[a] and (far < 0 or nearest[a] > nearest[far]):
                far = a
        if nth < count:
            chosen[far] = True
            latest = far
    return candidates[chosen]


@kernel
def markers_tried(members: FloatArray, usable: FloatArray, cameras: int) -> int:
    """Number of ``usable`` (m,) markers of each face of which all triples are tried: `MOST_TRIED`, or fewer according
    to `MAX_EVALUATIONS`.

    ``members`` (f, m).
    """
    sizes = np.zeros(members.shape[0], np.int64)
    for f in range(members.shape[0]):
        for i in range(members.shape[1]):
            if usable[i] > 0.0 and members[f, i] > 0.0:
                sizes[f] += 1
    most = MOST_TRIED
    while most > LEAST_TRIED:
        evaluated = 0
        for f in range(sizes.shape[0]):
            k = min(sizes[f], most)
            evaluated += cameras * (k * (k - 1) * (k - 2) // 6)
        if evaluated <= MAX_EVALUATIONS:
            break
        most -= 1
    return most


@kernel
def choose_triangle(
    members: FloatArray,
    lasting: FloatArray,
    usable: FloatArray,
    pixels: FloatArray,
    weights: FloatArray,
    before: Triangle,
) -> tuple[int, IntArray, int]:
    """Face (-1: across faces), its three markers and the number of cameras that see them (0: there are none).

    See `choose_face`; the order of the markers is not yet outward. ``lasting`` (f,), ``usable`` (m,).
    """
    face_now, triple_now = before
    faces, markers = members.shape
    best = np.zeros(3, np.int64)
    best_face, best_count, best_area = -1, 0, 0.0
    candidates = np.empty(markers, np.int64)
    most = markers_tried(members, usable, weights.shape[0])
    # faces first; across faces only if none is seen
    for f in range(faces + 1):
        if f == faces and best_count > 0:
            break
        found = 0
        for i in range(markers):
            if usable[i] > 0.0 and (f == faces or members[f, i] > 0.0):
                candidates[found] = i
                found += 1
        tried = spaced_in_images(candidates[:found], pixels, weights, most if f < faces else MOST_TRIED)
        for a in range(tried.shape[0]):
            for b in range(a + 1, tried.shape[0]):
                for c in range(b + 1, tried.shape[0]):
                    i, j, k = tried[a], tried[b], tried[c]
                    count, area = triangle_view(i, j, k, pixels, weights)
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
            count, area = triangle_view(triple_now[0], triple_now[1], triple_now[2], pixels, weights)
            if face_now >= 0 and lasting[face_now] > 0.0:
                area *= LASTING
            if count > 0 and count >= best_count and best_area <= CLEARLY_BETTER * area:
                return face_now, triple_now.copy(), count
    return best_face, best, best_count


@kernel
def choose_face_step(
    known_faces: Faces, shown: ShownBody, goal: BodyGoal, camera_centres: FloatArray, before: Triangle
) -> tuple[int, IntArray, int, FloatArray]:
    """`choose_face` on arrays: face, outward triple (3,), cameras and kept (c,)."""
    triples, members, sided, body = known_faces
    points, pixels, weights = shown
    targets, target_known = goal
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
    face, triple, count = choose_triangle(members, lasting, usable, pixels, weights, before)
    kept = np.zeros(cameras)
    if count == 0:
        return -2, before.triple.copy(), 0, kept
    i, j, k = triple
    side = 0.0
    if face >= 0 and sided[face] > 0.0:
        outward = minors(body[triples[face, 0]], body[triples[face, 1]], body[triples[face, 2]])
        side = dot(outward, minors(body[i], body[j], body[k]))
    else:  # the side seen by most cameras
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


@kernel
def _choose_face(
    known_faces: Fields, shown: Fields, goal: Fields, camera_centres: FloatArray, before: Fields
) -> tuple[int, IntArray, int, FloatArray]:
    """`choose_face_step` for Python, with the fields of all records."""
    return choose_face_step(Faces(*known_faces), ShownBody(*shown), BodyGoal(*goal), camera_centres, Triangle(*before))
