"""Constraints of a plan's request in the motion frame: faces and markers that must stay visible, and their margins.

Margins hold along the path. Where the present pose or the goal itself has less, they are lowered to that: a pose that
is allowed may be left and reached.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.kernels import transform_points
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.planning.constraint_margins import (
    FACE_HIDDEN,
    KINDS,
    Constraints,
    border_clearance,
    check_view,
    elevation,
    empty_table,
)
from stereoservo.planning.plan import ClosestApproach, PlanRequest

GRAZING = math.radians(3.0)
"""Least elevation of a camera over a face that must stay visible, unless the ends of the path have less."""
THICK = 0.05
"""Distance of a body's centroid from a face, relative to the body's size, from which on it tells the face's outside."""
YIELD_PX, YIELD_ANGLE = 0.02, 1e-4
"""What margins leave below what the ends have [px], [rad]: more than the arm may be off there."""


def writable_copy(values: npt.ArrayLike) -> FloatArray:
    """A writable, contiguous copy: kernels are compiled by these properties too, and no loop may wait for that."""
    return np.array(values, dtype=np.float64, order="C", copy=True)


def read_constraints(
    request: PlanRequest, frame: FloatArray, inverse: FloatArray, body: FloatArray, goal: FloatArray
) -> tuple[Constraints, ClosestApproach | None]:
    """Constraints of a path in the motion frame; and why there can be none: an end of it out of view, or hidden.

    ``body`` (m, 3) now, ``goal`` (m, 3).
    """
    r, limits = request, request.limits
    cameras = np.stack([_moved_camera(P, frame) for P in r.matrices])
    camera_centres = writable_copy(transform_points(inverse, writable_copy(r.camera_centres))[:, :3])
    faces = np.array(r.faces, dtype=np.int64, order="C", copy=True).reshape(-1, 3)
    sides, grazing = _required_visibility(body, goal, faces, camera_centres)
    constraints = Constraints(
        body=body,
        must_stay_visible=writable_copy(r.kept),
        cameras=cameras,
        camera_centres=camera_centres,
        sizes=writable_copy(limits.sizes),
        lenses=writable_copy(limits.lenses),
        margins=np.full(len(cameras), float(limits.view_margin_px)),
        depths=cameras[:, 2, 3].copy(),
        faces=faces,
        sides=sides,
        grazing=grazing,
        # a joint beyond its limit may come back
        lower=writable_copy(np.minimum(limits.position_min, r.joints)),
        upper=writable_copy(np.maximum(limits.position_max, r.joints)),
        keep_outs=writable_copy(limits.keep_outs).reshape(-1, len(r.joints), 2),
    )
    refusal = _refusal(constraints, body, goal)
    if refusal is None:
        for points in (body, goal):
            clearance = _image_clearances(constraints, points) - YIELD_PX
            constraints.margins[:] = np.minimum(constraints.margins, np.maximum(clearance, 0.0))
    return constraints, refusal


def _moved_camera(P: FloatArray, frame: FloatArray) -> FloatArray:
    return writable_copy((P[:, :, None] * frame[None, :, :]).sum(axis=1))


def _image_clearances(constraints: Constraints, points: FloatArray) -> FloatArray:
    s = constraints
    clearances = np.full(len(s.cameras), math.inf)
    for c in range(len(s.cameras)):
        for p in np.flatnonzero(s.must_stay_visible > 0.0):
            x, y, z = (float(value) for value in points[p])
            clearance, _ = border_clearance(s.cameras[c], s.lenses[c], s.sizes[c], x, y, z)
            clearances[c] = min(clearances[c], clearance)
    return clearances


def _required_visibility(
    body: FloatArray, goal: FloatArray, faces: IntArray, camera_centres: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Sides (f, c) of the faces and least elevations (f, c) [rad]; side 0 where a camera has no sight at both ends."""
    sides, grazing = np.zeros((len(faces), len(camera_centres))), np.zeros((len(faces), len(camera_centres)))
    for f in range(len(faces)):
        now = np.array([elevation(body, faces, f, 1.0, camera_centre) for camera_centre in camera_centres])
        then = np.array([elevation(goal, faces, f, 1.0, camera_centre) for camera_centre in camera_centres])
        side = _outside(body, faces[f])
        if side == 0.0:
            side = 1.0 if float((now + then).sum()) >= 0.0 else -1.0
        both = (side * now > 0.0) & (side * then > 0.0)
        sides[f] = np.where(both, side, 0.0)
        grazing[f] = np.clip(np.minimum(side * now, side * then) - YIELD_ANGLE, 0.0, GRAZING)
    return sides, grazing


def _outside(body: FloatArray, face: IntArray) -> float:
    """Sign of a face's plane outside the body; 0 where all markers lie in it."""
    a, b, c = (body[int(i)] for i in face)
    u, v = b - a, c - a
    normal = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    centroid = body.sum(axis=0) / len(body)
    size = math.sqrt(float(((body - centroid) ** 2).sum(axis=1).max()))
    distance = float((normal * (centroid - a)).sum()) / math.sqrt(float((normal * normal).sum()))
    if abs(distance) < THICK * size:
        return 0.0
    return -1.0 if distance > 0.0 else 1.0


def _refusal(constraints: Constraints, body: FloatArray, goal: FloatArray) -> ClosestApproach | None:
    for path_parameter, points in ((0.0, body), (1.0, goal)):
        table = empty_table()
        broken = int(check_view(points, path_parameter, constraints, table, False))
        if broken >= 0:
            unit = "px" if KINDS[broken] == "FIELD_OF_VIEW" else "of its depth now"
            row = table[broken]
            return ClosestApproach(
                KINDS[broken],
                int(row[4]),
                float(row[2]),
                float(row[3]),
                unit,
                float(row[1]),
                path_parameter,
                int(row[5]),
            )
    s = constraints
    if len(s.faces) == 0 or len(s.camera_centres) == 0 or bool((s.sides != 0.0).any()):
        return None
    side = 1.0 if float(elevation(body, s.faces, 0, 1.0, s.camera_centres[0])) >= 0.0 else -1.0
    value = math.degrees(float(elevation(goal, s.faces, 0, side, s.camera_centres[0])))
    return ClosestApproach(KINDS[FACE_HIDDEN], 0, value, 0.0, "deg", value, 1.0, int(s.faces[0, 0]))
