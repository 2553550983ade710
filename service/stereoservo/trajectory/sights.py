"""Reading a plan's request into the motion frame: which faces and images are to be kept, with how much margin.

Margins hold on the way. Where the present pose or the goal itself is nearer to a border than they ask, they yield to
it: who is allowed to stand there may also leave and arrive.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import transform_points
from stereoservo.trajectory.plan import Approach, IntArray, PlanRequest
from stereoservo.trajectory.rooms import (
    FACE_HIDDEN,
    KINDS,
    Surroundings,
    border_room,
    check_view,
    elevation,
    empty_table,
)

GRAZING = math.radians(3.0)
"""Elevation of a camera over a face that a way keeps, unless its ends have less."""
THICK = 0.05
"""Distance of a body's middle from a face, relative to the body's size, from which on it tells the face's outside."""
YIELD_PX, YIELD_ANGLE = 0.02, 1e-4
"""What margins leave below what the ends have [px], [rad]: more than the arm may be off there."""


def own(values: npt.ArrayLike) -> FloatArray:
    """A writable, contiguous copy: kernels are compiled by these properties too, and no loop may wait for that."""
    return np.array(values, dtype=np.float64, order="C", copy=True)


def read_surroundings(
    request: PlanRequest, frame: FloatArray, inverse: FloatArray, body: FloatArray, goal: FloatArray
) -> tuple[Surroundings, Approach | None]:
    """What a way has to respect, in the motion frame; and why there can be none: an end of it out of view, or hidden.

    ``body`` (m, 3) now, ``goal`` (m, 3).
    """
    r, limits = request, request.limits
    cameras = np.stack([_moved_camera(P, frame) for P in r.matrices])
    eyes = own(transform_points(inverse, own(r.camera_centres))[:, :3])
    faces = np.array(r.faces, dtype=np.int64, order="C", copy=True).reshape(-1, 3)
    sides, grazing = _kept_sights(body, goal, faces, eyes)
    surroundings = Surroundings(
        body=body,
        kept=own(r.kept),
        cameras=cameras,
        eyes=eyes,
        sizes=own(limits.sizes),
        lenses=own(limits.lenses),
        margins=np.full(len(cameras), float(limits.view_margin_px)),
        depths=cameras[:, 2, 3].copy(),
        faces=faces,
        sides=sides,
        grazing=grazing,
        # a joint beyond its limit may come back
        lower=own(np.minimum(limits.position_min, r.joints)),
        upper=own(np.maximum(limits.position_max, r.joints)),
        keep_outs=own(limits.keep_outs).reshape(-1, len(r.joints), 2),
    )
    refusal = _refusal(surroundings, body, goal)
    if refusal is None:
        for points in (body, goal):
            room = _image_rooms(surroundings, points) - YIELD_PX
            surroundings.margins[:] = np.minimum(surroundings.margins, np.maximum(room, 0.0))
    return surroundings, refusal


def _moved_camera(P: FloatArray, frame: FloatArray) -> FloatArray:
    return own((P[:, :, None] * frame[None, :, :]).sum(axis=1))


def _image_rooms(surroundings: Surroundings, points: FloatArray) -> FloatArray:
    s = surroundings
    rooms = np.full(len(s.cameras), math.inf)
    for c in range(len(s.cameras)):
        for p in np.flatnonzero(s.kept > 0.0):
            x, y, z = (float(value) for value in points[p])
            room, _ = border_room(s.cameras[c], s.lenses[c], s.sizes[c], x, y, z)
            rooms[c] = min(rooms[c], room)
    return rooms


def _kept_sights(
    body: FloatArray, goal: FloatArray, faces: IntArray, eyes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Sides (f, c) of the faces and least elevations (f, c) [rad]; side 0 where a camera has no sight at both ends."""
    sides, grazing = np.zeros((len(faces), len(eyes))), np.zeros((len(faces), len(eyes)))
    for f in range(len(faces)):
        now = np.array([elevation(body, faces, f, 1.0, eye) for eye in eyes])
        then = np.array([elevation(goal, faces, f, 1.0, eye) for eye in eyes])
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
    middle = body.sum(axis=0) / len(body)
    size = math.sqrt(float(((body - middle) ** 2).sum(axis=1).max()))
    height = float((normal * (middle - a)).sum()) / math.sqrt(float((normal * normal).sum()))
    if abs(height) < THICK * size:
        return 0.0
    return -1.0 if height > 0.0 else 1.0


def _refusal(surroundings: Surroundings, body: FloatArray, goal: FloatArray) -> Approach | None:
    for share, points in ((0.0, body), (1.0, goal)):
        table = empty_table()
        broken = int(check_view(points, share, surroundings, table, False))
        if broken >= 0:
            unit = "px" if KINDS[broken] == "FIELD_OF_VIEW" else "of its depth now"
            row = table[broken]
            return Approach(
                KINDS[broken],
                int(row[4]),
                float(row[2]),
                float(row[3]),
                unit,
                float(row[1]),
                share,
                int(row[5]),
            )
    s = surroundings
    if len(s.faces) == 0 or len(s.eyes) == 0 or bool((s.sides != 0.0).any()):
        return None
    side = 1.0 if float(elevation(body, s.faces, 0, 1.0, s.eyes[0])) >= 0.0 else -1.0
    value = math.degrees(float(elevation(goal, s.faces, 0, side, s.eyes[0])))
    return Approach(KINDS[FACE_HIDDEN], 0, value, 0.0, "deg", value, 1.0, int(s.faces[0, 0]))
