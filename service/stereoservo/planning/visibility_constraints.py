"""Constraints of a path (image borders, visible faces, depth, joint limits, keep-outs) and the clearance of one pose to
each of them; also the pull of joints away from their limits.

Margins apply along the path. If the current pose or the goal itself has less clearance, they are reduced to it, so that
every allowed pose can be left and reached.

The closest approach to each kind of limit is a row of a table (6, 7): relative clearance, clearance, value, limit,
index, marker, path parameter; rows in the order of ``KINDS``. Kernels, for the loop.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.kernels import distort_pixel, transform_points
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.plan import ClosestApproach, Limit, PlanRequest

KINDS: tuple[Limit, ...] = (
    "JOINT_LIMIT",
    "KEEP_OUT",
    "FIELD_OF_VIEW",
    "FACE_HIDDEN",
    "BEHIND_CAMERA",
    "NOT_REACHABLE",
)
JOINT_LIMIT, KEEP_OUT, FIELD_OF_VIEW, FACE_HIDDEN, BEHIND_CAMERA, NOT_REACHABLE = range(6)

NEAREST_DEPTH = 0.05
"""Least depth of a marker, as a fraction of the current depth of the centre."""
ROUNDING = 1e-9

GRAZING = math.radians(3.0)
"""Least elevation of a camera over a face that must stay visible, unless the ends of the path have less."""
THICK = 0.05
"""Distance of a body's centroid from a face, relative to the body's size, that determines the outside of the face."""
YIELD_PX, YIELD_ANGLE = 0.02, 1e-4
"""Amount by which reduced margins are below the clearance at the ends [px], [rad]: more than the arm's error there."""


class Constraints(NamedTuple):
    """Constraints of a path, constant while a body moves, in a motion frame.

    With c cameras, m markers, f faces, n joints, k keep-outs: ``body`` (m, 3), ``must_stay_visible`` (m,), 1 or 0.
    ``cameras`` (c, 3, 4), ``camera_centres`` (c, 3), ``sizes`` (c, 2) [px], ``lenses`` (c, 4), ``margins`` (c,) [px],
    ``depths`` (c,): current depths of the centre. ``faces`` (f, 3), ``sides`` (f, c): the sign of the face's plane at
    the camera if it must stay visible, else 0; ``grazing`` (f, c): least elevation [rad]. ``lower``, ``upper`` (n,),
    ``keep_outs`` (k, n, 2).
    """

    body: FloatArray
    must_stay_visible: FloatArray
    cameras: FloatArray
    camera_centres: FloatArray
    sizes: FloatArray
    lenses: FloatArray
    margins: FloatArray
    depths: FloatArray
    faces: IntArray
    sides: FloatArray
    grazing: FloatArray
    lower: FloatArray
    upper: FloatArray
    keep_outs: FloatArray


def empty_table() -> FloatArray:
    """A table of closest approaches without any pose: all clearances are infinite."""
    table = np.zeros((len(KINDS), 7))
    table[:, :2] = np.inf
    table[:, 5] = -1.0
    return table


class Margin(NamedTuple):
    """Distance of a pose from one limit: the limited ``value``, the ``limit`` and the ``clearance``, all in the limit's
    unit; ``whose``: index of the joint, camera or keep-out; ``marker``: index of the marker, -1 for none; the
    ``path_parameter`` in [0, 1].
    """

    value: float
    limit: float
    clearance: float
    whose: int
    marker: int
    path_parameter: float


@kernel
def _enter(table: FloatArray, kind: int, scale: float, margin: Margin) -> bool:
    """Whether a limit of a ``kind`` is violated; the table holds the closest approach, relative to ``scale``."""
    if margin.clearance / scale < table[kind, 0]:
        table[kind, 0] = margin.clearance / scale
        table[kind, 1] = margin.clearance
        table[kind, 2] = margin.value
        table[kind, 3] = margin.limit
        table[kind, 4] = margin.whose
        table[kind, 5] = margin.marker
        table[kind, 6] = margin.path_parameter
    return margin.clearance < -ROUNDING * scale


@kernel
def moved(H: FloatArray, points: FloatArray) -> FloatArray:
    """Points (m, 3) displaced by ``H`` (4, 4)."""
    out = np.empty(points.shape)
    for p in range(points.shape[0]):
        for i in range(3):
            out[p, i] = H[i, 0] * points[p, 0] + H[i, 1] * points[p, 1] + H[i, 2] * points[p, 2] + H[i, 3]
    return out


@kernel
def border_clearance(
    camera: FloatArray, lens: FloatArray, size: FloatArray, x: float, y: float, z: float
) -> tuple[float, float]:
    """Distance of a point's raw pixel from the image's border [px], negative outside; and its depth.

    Beyond the lens's fold, or behind the camera, the distance is minus the image width.
    """
    d = camera[2, 0] * x + camera[2, 1] * y + camera[2, 2] * z + camera[2, 3]
    if not d > 0.0:
        return -size[0], d
    u = (camera[0, 0] * x + camera[0, 1] * y + camera[0, 2] * z + camera[0, 3]) / d
    v = (camera[1, 0] * x + camera[1, 1] * y + camera[1, 2] * z + camera[1, 3]) / d
    u, v = distort_pixel(lens, u, v)
    clearance = min(u + 0.5, size[0] - 0.5 - u, v + 0.5, size[1] - 0.5 - v)
    if not math.isfinite(clearance) or clearance < -size[0]:
        return -size[0], d
    return clearance, d


@kernel
def elevation(points: FloatArray, faces: IntArray, f: int, side: float, camera_centre: FloatArray) -> float:
    """Angle [rad] of ``camera_centre`` (3,) above face ``f`` of ``points`` (m, 3), on the side ``side`` ±1 of it."""
    i0, i1, i2 = faces[f, 0], faces[f, 1], faces[f, 2]
    ax = points[i1, 0] - points[i0, 0]
    ay = points[i1, 1] - points[i0, 1]
    az = points[i1, 2] - points[i0, 2]
    bx = points[i2, 0] - points[i0, 0]
    by = points[i2, 1] - points[i0, 1]
    bz = points[i2, 2] - points[i0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    wx = camera_centre[0] - (points[i0, 0] + points[i1, 0] + points[i2, 0]) / 3.0
    wy = camera_centre[1] - (points[i0, 1] + points[i1, 1] + points[i2, 1]) / 3.0
    wz = camera_centre[2] - (points[i0, 2] + points[i1, 2] + points[i2, 2]) / 3.0
    sine = (nx * wx + ny * wy + nz * wz) / math.sqrt((nx * nx + ny * ny + nz * nz) * (wx * wx + wy * wy + wz * wz))
    return side * math.asin(min(1.0, max(-1.0, sine)))


@kernel
def check_view(
    points: FloatArray, path_parameter: float, constraints: Constraints, table: FloatArray, bounded: bool
) -> int:
    """The first kind of limit that ``points`` (m, 3) violate, or −1; their clearance is entered into the table (6, 7).

    ``bounded``: with the margins; else the limits of the images and faces themselves.
    """
    s = constraints
    broken = -1
    for c in range(s.cameras.shape[0]):
        margin, width = s.margins[c] if bounded else 0.0, s.sizes[c, 0]
        nearest, nearest_depth, nearest_marker = math.inf, 0.0, -1
        outermost, outermost_px, outermost_marker = math.inf, 0.0, -1
        for p in range(points.shape[0]):
            if not s.must_stay_visible[p] > 0.0:
                continue
            clearance, depth = border_clearance(
                s.cameras[c], s.lenses[c], s.sizes[c], points[p, 0], points[p, 1], points[p, 2]
            )
            relative_depth = depth / s.depths[c]
            if relative_depth - NEAREST_DEPTH < nearest:
                nearest, nearest_depth, nearest_marker = relative_depth - NEAREST_DEPTH, relative_depth, p
            if (clearance - margin) / width < outermost:
                outermost, outermost_px, outermost_marker = (clearance - margin) / width, clearance, p
            if broken < 0 and relative_depth - NEAREST_DEPTH < -ROUNDING:
                broken = 4
            if broken < 0 and clearance - margin < -ROUNDING * width and depth > 0.0:
                broken = 2
        # only the closest marker of each camera can be the closest of all
        depth_margin = Margin(nearest_depth, NEAREST_DEPTH, nearest, c, nearest_marker, path_parameter)
        _enter(table, 4, 1.0, depth_margin)
        left_px = outermost_px - margin if outermost_marker >= 0 else math.inf
        _enter(table, 2, width, Margin(outermost_px, margin, left_px, c, outermost_marker, path_parameter))
        for f in range(s.faces.shape[0]):
            if s.sides[f, c] != 0.0:
                angle = elevation(points, s.faces, f, s.sides[f, c], s.camera_centres[c])
                limit = s.grazing[f, c] if bounded else 0.0
                above = Margin(
                    math.degrees(angle),
                    math.degrees(limit),
                    math.degrees(angle - limit),
                    c,
                    s.faces[f, 0],
                    path_parameter,
                )
                if _enter(table, 3, 1.0, above) and broken < 0:
                    broken = 3
    return broken


@kernel
def check_joints(joints: FloatArray, path_parameter: float, constraints: Constraints, table: FloatArray) -> int:
    """The first kind of limit that ``joints`` (n,) violate, or −1; their clearance is entered into the table (6, 7)."""
    s = constraints
    n = joints.shape[0]
    broken = -1
    for j in range(n):
        if math.isfinite(s.upper[j]):
            below = Margin(joints[j], s.upper[j], s.upper[j] - joints[j], j, -1, path_parameter)
            if _enter(table, 0, 1.0, below) and broken < 0:
                broken = 0
        if math.isfinite(s.lower[j]):
            above = Margin(joints[j], s.lower[j], joints[j] - s.lower[j], j, -1, path_parameter)
            if _enter(table, 0, 1.0, above) and broken < 0:
                broken = 0
    for k in range(s.keep_outs.shape[0]):
        outside = -math.inf
        for j in range(n):
            outside = max(outside, s.keep_outs[k, j, 0] - joints[j], joints[j] - s.keep_outs[k, j, 1])
        beside = Margin(outside, 0.0, outside, k, -1, path_parameter)
        if math.isfinite(outside) and _enter(table, 1, 1.0, beside) and broken < 0:
            broken = 1
    return broken


@kernel
def limit_pull(positions: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pull (n,) in [-1, 1] to the middle of each joint's range, and half ranges (n,).

    The cube of the relative distance from the middle; no pull and a half range of 1 if ``lower`` and ``upper`` (n,) are
    infinite, or their range is empty.
    """
    n = positions.shape[0]
    half = np.ones(n)
    pull = np.zeros(n)
    for j in range(n):
        width = upper[j] - lower[j]
        if width > 0.0 and math.isfinite(width):
            half[j] = 0.5 * width
            x = max(-1.0, min(1.0, (positions[j] - lower[j]) / half[j] - 1.0))
            pull[j] = -x * x * x
    return pull, half


# -- constraints of a request ---------------------------------------------------------------------------------


def writable_copy(values: npt.ArrayLike) -> FloatArray:
    """A writable, contiguous copy: kernels are also specialised for these properties, and the loop must not wait for
    compilation.
    """
    return np.array(values, dtype=np.float64, order="C", copy=True)


@kernel
def in_frame(inverse: FloatArray, points: FloatArray) -> FloatArray:
    """Points (m, 4) of height 1 as (m, 3) in the motion frame of ``inverse`` (4, 4)."""
    moved_points = transform_points(inverse, points)
    out = np.empty((points.shape[0], 3))
    for p in range(points.shape[0]):
        for i in range(3):
            out[p, i] = moved_points[p, i]
    return out


def read_constraints(
    request: PlanRequest, frame: FloatArray, camera_centres: FloatArray, body: FloatArray, goal: FloatArray
) -> tuple[Constraints, ClosestApproach | None]:
    """Constraints of a path in the motion ``frame``; and the violation if an end of the path is out of view, or hidden.

    In the frame: ``camera_centres`` (c, 3), the ``body`` (m, 3) now, the ``goal`` (m, 3).
    """
    r, limits = request, request.limits
    cameras = np.stack([_moved_camera(P, frame) for P in r.matrices])
    faces = np.array(r.faces, dtype=np.int64, order="C", copy=True).reshape(-1, 3)
    sides, grazing = _required_visibility(body, goal, faces, camera_centres)
    constraints = Constraints(
        body=body,
        must_stay_visible=writable_copy(r.must_stay_visible),
        cameras=cameras,
        camera_centres=camera_centres,
        sizes=writable_copy(limits.sizes),
        lenses=writable_copy(limits.lenses),
        margins=np.full(len(cameras), float(limits.view_margin_px)),
        depths=cameras[:, 2, 3].copy(),
        faces=faces,
        sides=sides,
        grazing=grazing,
        # a joint beyond its limit may return
        lower=writable_copy(np.minimum(limits.position_min, r.joints)),
        upper=writable_copy(np.maximum(limits.position_max, r.joints)),
        keep_outs=writable_copy(limits.keep_outs).reshape(-1, len(r.joints), 2),
    )
    refusal = _violation(constraints, body, goal)
    if refusal is None:
        for points in (body, goal):
            clearance = _image_clearances(constraints, points) - YIELD_PX
            constraints.margins[:] = np.minimum(constraints.margins, np.maximum(clearance, 0.0))
    return constraints, refusal


def _moved_camera(P: FloatArray, frame: FloatArray) -> FloatArray:
    return writable_copy((P[:, :, None] * frame[None, :, :]).sum(axis=1))


@kernel
def _image_clearances(constraints: Constraints, points: FloatArray) -> FloatArray:
    """Least `border_clearance` in each camera (c,) of the ``points`` (m, 3) that must stay visible."""
    s = constraints
    clearances = np.full(s.cameras.shape[0], math.inf)
    for c in range(s.cameras.shape[0]):
        for p in range(points.shape[0]):
            if s.must_stay_visible[p] > 0.0:
                clearance, _ = border_clearance(
                    s.cameras[c], s.lenses[c], s.sizes[c], points[p, 0], points[p, 1], points[p, 2]
                )
                clearances[c] = min(clearances[c], clearance)
    return clearances


@kernel
def _elevations(points: FloatArray, faces: IntArray, camera_centres: FloatArray) -> FloatArray:
    """`elevation` (f, c) of every camera over every face, on side 1."""
    out = np.empty((faces.shape[0], camera_centres.shape[0]))
    for f in range(faces.shape[0]):
        for c in range(camera_centres.shape[0]):
            out[f, c] = elevation(points, faces, f, 1.0, camera_centres[c])
    return out


@kernel
def _required_visibility(
    body: FloatArray, goal: FloatArray, faces: IntArray, camera_centres: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Sides (f, c) of the faces, least elevations (f, c) [rad]; side 0 if a camera does not see the face at both
    ends.
    """
    cameras = camera_centres.shape[0]
    sides, grazing = np.zeros((faces.shape[0], cameras)), np.zeros((faces.shape[0], cameras))
    now, then = _elevations(body, faces, camera_centres), _elevations(goal, faces, camera_centres)
    centroid, size = _extent(body)
    for f in range(faces.shape[0]):
        side = _outside(body, faces[f], centroid, size)
        if side == 0.0:
            both = 0.0
            for c in range(cameras):
                both += now[f, c] + then[f, c]
            side = 1.0 if both >= 0.0 else -1.0
        for c in range(cameras):
            if side * now[f, c] > 0.0 and side * then[f, c] > 0.0:
                sides[f, c] = side
            least = min(side * now[f, c], side * then[f, c]) - YIELD_ANGLE
            grazing[f, c] = min(max(least, 0.0), GRAZING)
    return sides, grazing


@kernel
def _extent(body: FloatArray) -> tuple[FloatArray, float]:
    """Centroid (3,) of the ``body`` (m, 3), and the largest distance of a point from it."""
    centroid, largest = np.zeros(3), 0.0
    for p in range(body.shape[0]):
        for i in range(3):
            centroid[i] += body[p, i]
    for i in range(3):
        centroid[i] /= body.shape[0]
    for p in range(body.shape[0]):
        square = 0.0
        for i in range(3):
            square += (body[p, i] - centroid[i]) ** 2
        largest = max(largest, square)
    return centroid, math.sqrt(largest)


@kernel
def _outside(body: FloatArray, face: IntArray, centroid: FloatArray, size: float) -> float:
    """Sign of a face's plane outside a body of given ``centroid`` (3,) and ``size``; 0 if all markers lie in it."""
    a = body[face[0]]
    u, v = body[face[1]] - a, body[face[2]] - a
    normal = np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])
    along, square = 0.0, 0.0
    for i in range(3):
        along += normal[i] * (centroid[i] - a[i])
        square += normal[i] * normal[i]
    distance = along / math.sqrt(square)
    if abs(distance) < THICK * size:
        return 0.0
    return -1.0 if distance > 0.0 else 1.0


def _violation(constraints: Constraints, body: FloatArray, goal: FloatArray) -> ClosestApproach | None:
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
