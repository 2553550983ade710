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

from typing import NamedTuple

import numpy as np

from stereoservo.control.faces_kernel import (
    all_triples,
    choose_face_step,
    coplanar_groups,
    covering_groups,
    faces_fronting,
    marker_covariances,
    marker_distances,
    marker_information,
    trial_views,
    triangle_altitudes,
    turned_average,
)
from stereoservo.control.law import Scene, Task
from stereoservo.control.primitives_kernel import minors
from stereoservo.numerics.arrays import FloatArray, IntArray

FLAT_PX = 0.05
"""A good ``sigma_px`` for the markers of a calibrated model on plates flat to some tenths of a millimetre.

Larger ones take in markers of the next face that stand near the common edge.
"""
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
        [_side(group, fact, points, centres, seen) for group, fact in zip(members, facts, strict=True)],
        np.int64,
    )
    outward = facts[:, :3].copy()
    outward[sides < 0] = outward[sides < 0][:, [0, 2, 1]]
    return Faces(outward, members.astype(np.float64), np.abs(sides).astype(np.float64), points)


def _side(
    members: IntArray, facts: IntArray, points: FloatArray, centres: FloatArray, seen: FloatArray
) -> int:
    """1 where a group's triple is in outward order, -1 where it is not, 0 where nothing tells."""
    plane = minors(points[facts[0]], points[facts[1]], points[facts[2]])
    votes = 0
    for eye, row in zip(centres, seen, strict=True):
        if ((row > 0.0) & (members > 0)).sum() >= 3:
            votes += 1 if float((plane * eye).sum()) > 0.0 else -1
    # what cameras see outweighs where the rest of the body is
    return int(np.sign(votes)) if votes != 0 else int(facts[5] > 0) - int(facts[4] > 0)


def choose_face(faces: Faces, scene: Scene, task: Task, before: FaceChoice = NOT_CHOSEN) -> FaceChoice:
    """The three markers on which a law shall work now.

    Of one face, seen in most cameras; among these, of largest image area in units of the noise, which prefers what is
    spread, near and frontal. A face whose front some camera has at the goal too counts for more. Only markers that have
    a point now (finite) and at the goal (``target_known``). The former choice stays until a marker of it is hidden,
    more cameras see another, or another is twice as large. Where no camera sees three markers of one face, any three
    do.
    """
    face, triple, cameras, kept = choose_face_step(
        *faces, scene.points, scene.pixels, scene.weights, task.target_points, task.target_known,
        scene.camera_centres, before.face, before.triple,
    )  # fmt: skip
    changed = before.cameras > 0 and (cameras == 0 or set(triple.tolist()) != set(before.triple.tolist()))
    return FaceChoice(face, triple, cameras, kept, changed)


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
