"""Clearance of a pose to every limit: images, faces, depth, joints, keep-outs. Kernels, for the loop.

All in the coordinates of a `motion_frame`. The closest approach to each kind of limit is a row of a table (6, 7):
relative clearance, clearance, value, limit, index, marker, path parameter; rows in the order of ``KINDS``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.kinematics.kernels import distort_pixel
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.plan import Limit

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
"""Least depth of a marker, as a path_parameter of the depth that the centre has now."""
ROUNDING = 1e-9


class Constraints(NamedTuple):
    """What a path has to respect, constant while a body moves, in a motion frame.

    With c cameras, m markers, f faces, n joints, k keep-outs: ``body`` (m, 3), ``must_stay_visible`` (m,), 1 or 0.
    ``cameras`` (c, 3, 4), ``camera_centres`` (c, 3), ``sizes`` (c, 2) [px], ``lenses`` (c, 4), ``margins`` (c,) [px],
    ``depths`` (c,) of the centre now. ``faces`` (f, 3), ``sides`` (f, c): the sign of the face's plane at the camera
    where it must stay visible, else 0; ``grazing`` (f, c): least elevation [rad]. ``lower``, ``upper`` (n,),
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
    """A table of closest approaches before any pose: nothing near."""
    table = np.zeros((len(KINDS), 7))
    table[:, :2] = np.inf
    table[:, 5] = -1.0
    return table


@kernel
def _enter(
    table: FloatArray,
    kind: int,
    scale: float,
    value: float,
    limit: float,
    clearance: float,
    index: int,
    marker: int,
    path_parameter: float,
) -> bool:
    """Whether a limit is broken; the table keeps the closest approach."""
    if clearance / scale < table[kind, 0]:
        table[kind, 0] = clearance / scale
        table[kind, 1] = clearance
        table[kind, 2] = value
        table[kind, 3] = limit
        table[kind, 4] = index
        table[kind, 5] = marker
        table[kind, 6] = path_parameter
    return clearance < -ROUNDING * scale


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

    Beyond the lens's fold, or not before the camera, it is as far outside as the image is wide.
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
    sine = (nx * wx + ny * wy + nz * wz) / math.sqrt(
        (nx * nx + ny * ny + nz * nz) * (wx * wx + wy * wy + wz * wz)
    )
    return side * math.asin(min(1.0, max(-1.0, sine)))


@kernel
def check_view(
    points: FloatArray, path_parameter: float, constraints: Constraints, table: FloatArray, bounded: bool
) -> int:
    """The first kind of limit that ``points`` (m, 3) break, or −1; their clearance is entered into the table (6, 7).

    ``bounded``: with the margins; else those of the images and faces themselves.
    """
    s = constraints
    broken = -1
    for c in range(s.cameras.shape[0]):
        for p in range(points.shape[0]):
            if not s.must_stay_visible[p] > 0.0:
                continue
            clearance, depth = border_clearance(
                s.cameras[c], s.lenses[c], s.sizes[c], points[p, 0], points[p, 1], points[p, 2]
            )
            relative_depth = depth / s.depths[c]
            if (
                _enter(
                    table,
                    4,
                    1.0,
                    relative_depth,
                    NEAREST_DEPTH,
                    relative_depth - NEAREST_DEPTH,
                    c,
                    p,
                    path_parameter,
                )
                and broken < 0
            ):
                broken = 4
            margin = s.margins[c] if bounded else 0.0
            if (
                _enter(table, 2, s.sizes[c, 0], clearance, margin, clearance - margin, c, p, path_parameter)
                and broken < 0
                and depth > 0.0
            ):
                broken = 2
        for f in range(s.faces.shape[0]):
            if s.sides[f, c] != 0.0:
                angle = elevation(points, s.faces, f, s.sides[f, c], s.camera_centres[c])
                limit = s.grazing[f, c] if bounded else 0.0
                if (
                    _enter(
                        table, 3, 1.0, math.degrees(angle), math.degrees(limit), math.degrees(angle - limit),
                        c, s.faces[f, 0], path_parameter,
                    )
                    and broken < 0
                ):  # fmt: skip
                    broken = 3
    return broken


@kernel
def check_joints(
    joints: FloatArray, path_parameter: float, constraints: Constraints, table: FloatArray
) -> int:
    """The first kind of limit that ``joints`` (n,) break, or −1; their clearance is entered into the table (6, 7)."""
    s = constraints
    n = joints.shape[0]
    broken = -1
    for j in range(n):
        if math.isfinite(s.upper[j]):
            clearance = s.upper[j] - joints[j]
            if _enter(table, 0, 1.0, joints[j], s.upper[j], clearance, j, -1, path_parameter) and broken < 0:
                broken = 0
        if math.isfinite(s.lower[j]):
            clearance = joints[j] - s.lower[j]
            if _enter(table, 0, 1.0, joints[j], s.lower[j], clearance, j, -1, path_parameter) and broken < 0:
                broken = 0
    for k in range(s.keep_outs.shape[0]):
        outside = -math.inf
        for j in range(n):
            outside = max(outside, s.keep_outs[k, j, 0] - joints[j], joints[j] - s.keep_outs[k, j, 1])
        if (
            math.isfinite(outside)
            and _enter(table, 1, 1.0, outside, 0.0, outside, k, -1, path_parameter)
            and broken < 0
        ):
            broken = 1
    return broken


@kernel
def limit_pull(positions: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pull (n,) in [-1, 1] to the middle of each joint's range, and half ranges (n,).

    The cube of the relative distance from the middle; no pull and a half range of 1 where ``lower`` and ``upper`` (n,)
    are infinite, or leave no range.
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
