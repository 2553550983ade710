"""Faces of a marker body: which markers lie in one plane, which side is out, and on which three a law works now.

A law needs three markers that are seen; a body that turns far shows others then. Nothing here is metric: markers are
points of height ``a∞ᵀM = 1`` in the projective frame, and what "in one plane" means is told by the images. A marker is
in the plane of three others when the determinant of the four is within a few of its own standard deviations, those that
pixels of a deviation ``sigma_px`` leave. Where the plates themselves are less flat than the cameras are sharp, state a
``sigma_px`` that covers it.

A face has no other marker on one of its sides; that is where the body is, the other one is out, unless the cameras
that see its markers say otherwise (an inner corner). Planes are signed minors of three markers in outward order: with
camera centres O of height 1, ``aᵀO > 0`` where the front is seen (7.4.2).
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from stereoservo.control.faces_kernel import (
    choose_triangle,
    faces_fronting,
    kept_cameras,
    marker_covariances,
    marker_distances,
    marker_information,
    off_plane,
    plane_minors,
    triangle_altitudes,
    turned_average,
)
from stereoservo.control.law import IntArray, Scene, Task
from stereoservo.geometry.homogeneous import FloatArray

IN_PLANE = 4.0
"""Standard deviations up to which a marker is in a plane."""
SPANS = 10.0
"""Altitude of a triangle, in standard deviations, from which on it tells a plane."""


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


class FaceChoice(NamedTuple):
    """On what a law shall work now.

    ``face``: its index, -1 where the three markers are of several; ``triple`` (3,): their indices, in outward order.
    ``cameras``: how many see them, 0: none does, and no law can work. ``kept`` (c,): 1 for the cameras that have the
    face's front now and at the goal, whose sight of it is kept. ``changed``: other markers than before.
    """

    face: int
    triple: IntArray
    cameras: int
    kept: FloatArray
    changed: bool


NOT_CHOSEN = FaceChoice(-2, np.zeros(3, np.int64), 0, np.zeros(0), False)
"""What stands in for the choice before the first."""


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
    ``limit`` deviations from a plane. ``operators`` (n, 4, 4) of an arm that turns the body, at any configuration: they
    make lengths comparable that one view foreshortens.

    Regular bodies have coplanar markers that are no face: chamfers, diagonals. Groups of four and more come first,
    those that no camera sees in part before others, those of many markers before few, round before narrow, as long as
    they bring three new markers; then what is left takes part in planes with no marker on one side. Markers inside the
    body, on no such plane, belong to no face. Fewer than three markers, or all on one line, have none. Raises
    ValueError for arrays that do not fit, for numbers that are not finite and where the views do not fix a marker.
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
    triples = np.array(list(combinations(range(m), 3)), dtype=np.int64).reshape(-1, 3)
    if m < 3:
        return Faces(np.zeros((0, 3), np.int64), np.zeros((0, m)), np.zeros(0), points)
    information = marker_information(points, np.ascontiguousarray(matrices, dtype=np.float64), sigma_px)
    covariances = marker_covariances(points, information)
    if not np.isfinite(covariances).all():
        lost = np.flatnonzero(~np.isfinite(covariances).all(axis=(1, 2))).tolist()
        raise ValueError(
            f"the views do not fix markers {lost}: give two cameras, or views of one in several poses (P H)"
        )
    turns = np.zeros((0, 4, 4)) if operators is None else np.ascontiguousarray(operators, dtype=np.float64)
    form = turned_average(information, turns)
    altitudes = triangle_altitudes(points, form, triples)
    order = np.argsort(-altitudes, kind="stable")
    order = order[altitudes[order] >= SPANS]
    groups = _groups(
        triples[order],
        altitudes[order],
        off_plane(points, covariances, triples[order]),
        marker_distances(points, form),
        seen,
        limit,
    )
    chosen = _cover(groups, m)
    oriented = [_outward(group, points, centres, seen) for group in chosen]
    members = np.zeros((len(chosen), m))
    for f, group in enumerate(chosen):
        members[f, list(group.markers)] = 1.0
    return Faces(
        np.array([triple for triple, _ in oriented], dtype=np.int64).reshape(-1, 3),
        members,
        np.array([float(known) for _, known in oriented]),
        points,
    )


class _Group(NamedTuple):
    """Markers in one plane: ``above`` and ``below`` of it lie so many others; ``whole``: no camera sees only part.

    ``roundness``: the altitude of its widest triangle over the longest way in it.
    """

    markers: frozenset[int]
    triple: tuple[int, int, int]
    roundness: float
    above: int
    below: int
    whole: bool

    @property
    def bounds(self) -> bool:
        """Whether it has no marker on one of its sides."""
        return self.above == 0 or self.below == 0


def _groups(
    triples: IntArray,
    altitudes: FloatArray,
    deviations: FloatArray,
    distances: FloatArray,
    seen: FloatArray,
    limit: float,
) -> list[_Group]:
    """Coplanar groups, from the triples that tell their planes best on."""
    groups: list[_Group] = []
    for triple, altitude, deviation in zip(triples.tolist(), altitudes, deviations, strict=True):
        if any(len(group.markers) > 3 and group.markers.issuperset(triple) for group in groups):
            continue
        inside = np.abs(deviation) <= limit
        shares = (seen[:, inside] > 0.0).mean(axis=1)
        groups.append(
            _Group(
                frozenset(np.flatnonzero(inside).tolist()),
                (triple[0], triple[1], triple[2]),
                float(altitude) / float(distances[np.ix_(inside, inside)].max()),
                int((deviation > limit).sum()),
                int((deviation < -limit).sum()),
                bool(((shares == 0.0) | (shares == 1.0)).all()),
            )
        )
    return groups


def _cover(groups: list[_Group], m: int) -> list[_Group]:
    """Groups that are faces: each brings markers that no better one has."""

    def rank(group: _Group) -> tuple[bool, int, float]:
        return group.whole, len(group.markers), group.roundness

    flat = sorted((g for g in groups if len(g.markers) > 3), key=rank, reverse=True)
    passes = (
        ([g for g in flat if g.bounds], 3),
        ([g for g in flat if not g.bounds], 3),
        (sorted((g for g in groups if g.bounds), key=rank, reverse=True), 1),
    )
    chosen: list[_Group] = []
    left = set(range(m))
    for candidates, least in passes:
        for group in candidates:
            if len(left & group.markers) >= least:
                chosen.append(group)
                left -= group.markers
    return chosen


def _outward(
    group: _Group, points: FloatArray, centres: FloatArray, seen: FloatArray
) -> tuple[tuple[int, int, int], bool]:
    """The group's three markers in outward order, and whether anything tells it."""
    i, j, k = group.triple
    plane = plane_minors(points[i], points[j], points[k])
    inside = sorted(group.markers)
    votes = 0
    for eye, row in zip(centres, seen, strict=True):
        if (row[inside] > 0.0).sum() >= 3:
            votes += 1 if float((plane * eye).sum()) > 0.0 else -1
    # what cameras see outweighs where the rest of the body is
    side = votes if votes != 0 else (group.below > 0) - (group.above > 0)
    return ((i, j, k) if side >= 0 else (i, k, j)), side != 0


def choose_face(faces: Faces, scene: Scene, task: Task, before: FaceChoice = NOT_CHOSEN) -> FaceChoice:
    """The three markers on which a law shall work now.

    Of one face, seen in most cameras; among these, of largest image area in units of the noise, which prefers what is
    spread, near and frontal. A face whose front some camera has at the goal too counts for more. Only markers that have
    a point now (finite) and at the goal (``target_known``). The former choice stays until a marker of it is hidden,
    more cameras see another, or another is twice as large. Where no camera sees three markers of one face, any three
    do.
    """
    usable = (task.target_known > 0.0) & np.isfinite(scene.points).all(axis=1)
    goal = faces_fronting(
        task.target_points, faces.triples, faces.sided, np.eye(4)[None], scene.camera_centres
    )[0]
    lasting = np.where(faces.sided > 0.0, goal.max(axis=1, initial=0.0), 0.0)
    face, found, cameras = choose_triangle(
        faces.members,
        lasting,
        usable.astype(np.float64),
        scene.pixels,
        scene.weights,
        before.face,
        before.triple,
    )
    if cameras == 0:
        return FaceChoice(-2, before.triple, 0, np.zeros(len(scene.camera_centres)), before.cameras > 0)
    triple = _ordered(faces, face, found, scene)
    kept = kept_cameras(1.0, scene.points[triple], task.target_points[triple], scene.camera_centres)
    changed = before.cameras > 0 and set(triple.tolist()) != set(before.triple.tolist())
    return FaceChoice(int(face), triple, int(cameras), kept, changed)


def _ordered(faces: Faces, face: int, triple: IntArray, scene: Scene) -> IntArray:
    """``triple`` in outward order; where the face has no known side, the side that most cameras see is its front."""
    i, j, k = (int(x) for x in triple)
    if face >= 0 and faces.sided[face] > 0.0:
        first = plane_minors(*faces.body[faces.triples[face]])
        side = float((first * plane_minors(faces.body[i], faces.body[j], faces.body[k])).sum())
    else:
        plane = plane_minors(scene.points[i], scene.points[j], scene.points[k])
        sees = (scene.weights[:, [i, j, k]] > 0.0).all(axis=1)
        side = float(np.where(sees, np.sign((scene.camera_centres * plane).sum(axis=1)), 0.0).sum())
    return np.array((i, j, k) if side >= 0.0 else (i, k, j), dtype=np.int64)


def law_scene(scene: Scene, choice: FaceChoice) -> Scene:
    """The scene for a law that keeps sight of its face: without the cameras that lose it at the goal or have it not.

    Their way cannot be the face's front; what they see of the markers stays.
    """
    return scene._replace(camera_centres=np.ascontiguousarray(scene.camera_centres[choice.kept > 0.0]))


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
