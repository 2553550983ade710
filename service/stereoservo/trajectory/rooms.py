"""How much room a pose leaves to every limit: images, faces, depth, joints, keep-outs. Kernels, for the loop.

All in the coordinates of a `motion_frame`. The closest approach to each kind of limit is a row of a table (6, 7):
relative room, room, value, limit, index, marker, share; rows in the order of ``KINDS``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel
from stereoservo.kinematics.lens_kernel import distort_pixel
from stereoservo.trajectory.plan import IntArray, Limit

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
"""Least depth of a marker, as a share of the depth that the centre has now."""
ROUNDING = 1e-9


class Surroundings(NamedTuple):
    """What stays while a body moves; c cameras, m markers, f faces, n joints, k keep-outs, in a motion frame.

    ``body`` (m, 3), ``kept`` (m,). ``cameras`` (c, 3, 4), ``eyes`` (c, 3), ``sizes`` (c, 2) [px], ``lenses`` (c, 4),
    ``margins`` (c,) [px], ``depths`` (c,) of the centre now. ``faces`` (f, 3), ``sides`` (f, c): the sign of the face's
    plane at the camera where its sight is kept, else 0; ``grazing`` (f, c): least elevation [rad]. ``lower``, ``upper``
    (n,), ``keep_outs`` (k, n, 2).
    """

    body: FloatArray
    kept: FloatArray
    cameras: FloatArray
    eyes: FloatArray
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
    room: float,
    index: int,
    marker: int,
    share: float,
) -> bool:
    """Keep what is nearest; True where the limit is broken."""
    if room / scale < table[kind, 0]:
        table[kind, 0] = room / scale
        table[kind, 1] = room
        table[kind, 2] = value
        table[kind, 3] = limit
        table[kind, 4] = index
        table[kind, 5] = marker
        table[kind, 6] = share
    return room < -ROUNDING * scale


@kernel
def moved(H: FloatArray, points: FloatArray) -> FloatArray:
    """Points (m, 3) displaced by ``H`` (4, 4)."""
    out = np.empty(points.shape)
    for p in range(points.shape[0]):
        for i in range(3):
            out[p, i] = H[i, 0] * points[p, 0] + H[i, 1] * points[p, 1] + H[i, 2] * points[p, 2] + H[i, 3]
    return out


@kernel
def border_room(
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
    room = min(u + 0.5, size[0] - 0.5 - u, v + 0.5, size[1] - 0.5 - v)
    if not math.isfinite(room) or room < -size[0]:
        return -size[0], d
    return room, d


@kernel
def elevation(points: FloatArray, faces: IntArray, f: int, side: float, eye: FloatArray) -> float:
    """Angle [rad] at which ``eye`` (3,) stands over face ``f`` of ``points`` (m, 3), on the side ``side`` ±1 of it."""
    i0, i1, i2 = faces[f, 0], faces[f, 1], faces[f, 2]
    ax = points[i1, 0] - points[i0, 0]
    ay = points[i1, 1] - points[i0, 1]
    az = points[i1, 2] - points[i0, 2]
    bx = points[i2, 0] - points[i0, 0]
    by = points[i2, 1] - points[i0, 1]
    bz = points[i2, 2] - points[i0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    wx = eye[0] - (points[i0, 0] + points[i1, 0] + points[i2, 0]) / 3.0
    wy = eye[1] - (points[i0, 1] + points[i1, 1] + points[i2, 1]) / 3.0
    wz = eye[2] - (points[i0, 2] + points[i1, 2] + points[i2, 2]) / 3.0
    sine = (nx * wx + ny * wy + nz * wz) / math.sqrt(
        (nx * nx + ny * ny + nz * nz) * (wx * wx + wy * wy + wz * wz)
    )
    return side * math.asin(min(1.0, max(-1.0, sine)))


@kernel
def check_view(
    points: FloatArray, share: float, surroundings: Surroundings, table: FloatArray, bounded: bool
) -> int:
    """Enter the room of ``points`` (m, 3) at ``share`` into the table (6, 7); the first kind of limit broken, or −1.

    ``bounded``: with the margins; else those of the images and faces themselves.
    """
    s = surroundings
    broken = -1
    for c in range(s.cameras.shape[0]):
        for p in range(points.shape[0]):
            if not s.kept[p] > 0.0:
                continue
            room, depth = border_room(
                s.cameras[c], s.lenses[c], s.sizes[c], points[p, 0], points[p, 1], points[p, 2]
            )
            share_of_depth = depth / s.depths[c]
            if (
                _enter(
                    table, 4, 1.0, share_of_depth, NEAREST_DEPTH, share_of_depth - NEAREST_DEPTH, c, p, share
                )
                and broken < 0
            ):
                broken = 4
            margin = s.margins[c] if bounded else 0.0
            if (
                _enter(table, 2, s.sizes[c, 0], room, margin, room - margin, c, p, share)
                and broken < 0
                and depth > 0.0
            ):
                broken = 2
        for f in range(s.faces.shape[0]):
            if s.sides[f, c] != 0.0:
                angle = elevation(points, s.faces, f, s.sides[f, c], s.eyes[c])
                limit = s.grazing[f, c] if bounded else 0.0
                if (
                    _enter(
                        table, 3, 1.0, math.degrees(angle), math.degrees(limit), math.degrees(angle - limit),
                        c, s.faces[f, 0], share,
                    )
                    and broken < 0
                ):  # fmt: skip
                    broken = 3
    return broken


@kernel
def check_joints(joints: FloatArray, share: float, surroundings: Surroundings, table: FloatArray) -> int:
    """Enter the room of ``joints`` (n,) at ``share`` into the table (6, 7); the first kind of limit broken, or −1."""
    s = surroundings
    n = joints.shape[0]
    broken = -1
    for j in range(n):
        if math.isfinite(s.upper[j]):
            room = s.upper[j] - joints[j]
            if _enter(table, 0, 1.0, joints[j], s.upper[j], room, j, -1, share) and broken < 0:
                broken = 0
        if math.isfinite(s.lower[j]):
            room = joints[j] - s.lower[j]
            if _enter(table, 0, 1.0, joints[j], s.lower[j], room, j, -1, share) and broken < 0:
                broken = 0
    for k in range(s.keep_outs.shape[0]):
        outside = -math.inf
        for j in range(n):
            outside = max(outside, s.keep_outs[k, j, 0] - joints[j], joints[j] - s.keep_outs[k, j, 1])
        if (
            math.isfinite(outside)
            and _enter(table, 1, 1.0, outside, 0.0, outside, k, -1, share)
            and broken < 0
        ):
            broken = 1
    return broken


@kernel
def limit_pull(positions: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pull (n,) in [-1, 1] to the middle of each joint's range, the cube of the way from it, and half ranges (n,).

    No pull and a half range of 1 where ``lower`` and ``upper`` (n,) are infinite, or leave no range.
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
