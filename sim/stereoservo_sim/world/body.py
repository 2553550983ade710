"""The marker body on the flange, as ground truth: planar faces with dots, joined like a shallow roof; or a convex
solid without markers, whose vertices have ids.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports.dot_plates import DEFAULT_BODY, DotFace


@dataclass(frozen=True, eq=False)
class MarkerBody:
    """Faces and their poses in the flange's frame.

    ``flange_to_face`` (f, 4, 4): maps face coordinates (x right, y down, z into the plate as seen from in
    front) to the flange's frame [m]; the outward normal of a face is its -z axis.
    """

    faces: tuple[DotFace, ...]
    flange_to_face: FloatArray

    @property
    def ids(self) -> IntArray:
        """All marker ids, face by face, (m,)."""
        return np.array([i for face in self.faces for i in face.ids], dtype=np.int64)

    @property
    def marker_points(self) -> FloatArray:
        """Dot centres in the flange's frame, (m, 3) [m], rows in the order of ``ids``."""
        return np.concatenate(
            [
                face.positions @ pose[:3, :2].T + pose[:3, 3]
                for face, pose in zip(self.faces, self.flange_to_face, strict=True)
            ]
        )

    @property
    def marker_radii(self) -> FloatArray:
        """Radius of each marker, (m,) [m]."""
        return np.concatenate([np.full(len(face.ids), face.radius) for face in self.faces])

    @property
    def marker_normals(self) -> FloatArray:
        """Outward unit normal at each marker in the flange's frame, (m, 3)."""
        return np.concatenate(
            [
                np.tile(-pose[:3, 2], (len(face.ids), 1))
                for face, pose in zip(self.faces, self.flange_to_face, strict=True)
            ]
        )


def roof_body(
    faces: tuple[DotFace, DotFace] = (DEFAULT_BODY[0], DEFAULT_BODY[1]),
    *,
    tilt: float = float(np.deg2rad(18.0)),
    stand_off: float = 0.06,
    shift: tuple[float, float] = (0.02, 0.01),
    roll: float = 0.0,
) -> MarkerBody:
    """Body of two faces side by side, ridge towards the viewer, each inclined by ``tilt`` [rad].

    Args:
        faces: left and right face as seen from in front.
        tilt: inclination of each face about the ridge [rad].
        stand_off: distance of the ridge from the flange along its z axis [m].
        shift: offset of the ridge across the flange's axis [m].
        roll: rotation of the body about the flange's z axis [rad].
    """
    c, s = np.cos(roll), np.sin(roll)
    # Seen from in front (looking along -z of the flange): right and down are across, into the body is -z.
    viewer = np.array([[c, s, 0, 0], [s, -c, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1.0]])
    viewer[:3, 3] = (*shift, stand_off)
    poses = []
    for face, side in zip(faces, (-1.0, 1.0), strict=True):
        ct, st = np.cos(tilt), np.sin(tilt)
        # The plate slopes away from the viewer (towards +z of the face frame) with distance from the ridge.
        turn = np.array([[ct, 0, -side * st, 0], [0, 1, 0, 0], [side * st, 0, ct, 0], [0, 0, 0, 1.0]])
        turn[:3, 3] = turn[:3, 0] * side * face.half_side
        poses.append(viewer @ turn)
    return MarkerBody(faces=tuple(faces), flange_to_face=np.stack(poses))


FIRST_ID = 400
LIGHT = (-0.6, -0.6, 0.8)
"""Direction to the lamp of the embedded cell, above and behind its cameras."""
AMBIENT, SKY, DIFFUSE = 25.0, 60.0, 130.0
"""Grey levels: of an unlit face, added by the sky to a face turned up, and added by the lamp to one that faces it."""


@dataclass(frozen=True, eq=False)
class SolidBody(MarkerBody):
    """A convex solid in the flange's frame, used instead of plates with dots; its vertices are the markers.

    ``vertices`` (n, 3) [m] with ids from ``first_id`` on; ``outlines``: vertex indices along each face's border;
    ``light`` (3,): direction to the lamp, in the world.
    """

    vertices: FloatArray
    outlines: tuple[tuple[int, ...], ...]
    light: FloatArray = field(default_factory=lambda: np.array(LIGHT))
    first_id: int = FIRST_ID

    @property
    def ids(self) -> IntArray:
        """The vertices' ids, (n,)."""
        return np.arange(self.first_id, self.first_id + len(self.vertices))

    @property
    def marker_points(self) -> FloatArray:
        """The vertices in the flange's frame, (n, 3) [m]."""
        return self.vertices

    @property
    def face_normals(self) -> FloatArray:
        """Outward unit normals of the faces, (f, 3)."""
        normals = []
        for outline in self.outlines:
            a, b, c = self.vertices[list(outline[:3])]
            normal = np.cross(b - a, c - b)
            normal /= np.linalg.norm(normal)
            normals.append(normal if normal @ (a - self.vertices.mean(axis=0)) > 0 else -normal)
        return np.array(normals)

    @property
    def marker_normals(self) -> FloatArray:
        """Mean unit normal at each vertex of the faces that meet there, (n, 3)."""
        faces = self.face_normals
        touching = np.array([[row in outline for outline in self.outlines] for row in range(len(self.vertices))])
        normals = touching.astype(np.float64) @ faces
        mean: FloatArray = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return mean

    @property
    def marker_radii(self) -> FloatArray:
        """Radii (n,): zero, since vertices have no extent."""
        return np.zeros(len(self.vertices))

    def shades(self, pose: FloatArray) -> FloatArray:
        """Grey levels (f,) of the faces with the body at ``pose`` (4, 4) in the world."""
        light = self.light / np.linalg.norm(self.light)
        normals = self.face_normals @ pose[:3, :3].T
        levels: FloatArray = AMBIENT + 0.5 * SKY * (1.0 + normals[:, 2]) + DIFFUSE * np.maximum(0.0, normals @ light)
        return levels


WEDGE_BASE = np.array([(-0.10, -0.08), (0.09, -0.09), (0.115, 0.05), (0.02, 0.10), (-0.09, 0.07)])
WEDGE_INSETS = (0.045, 0.032, 0.050, 0.036, 0.040)


def wedge(first_id: int = FIRST_ID, *, scale: float = 1.0, height: tuple[float, float] = (0.04, 0.11)) -> SolidBody:
    """A skew five-sided frustum on the flange: ``height`` [m] of its base and of its smaller top along the axis."""
    along = np.roll(WEDGE_BASE, -1, axis=0) - WEDGE_BASE
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    offsets = (inward * WEDGE_BASE).sum(axis=1) + WEDGE_INSETS
    top = [
        np.linalg.solve(inward[[k - 1, k]], offsets[[k - 1, k]]) for k in range(len(WEDGE_BASE))
    ]  # sides stay planar: edges of the top are parallel to those of the base
    count = len(WEDGE_BASE)
    base = np.column_stack([scale * WEDGE_BASE, np.full(count, height[0])])
    upper = np.column_stack([scale * np.array(top), np.full(count, height[0] + scale * (height[1] - height[0]))])
    sides = tuple((k, (k + 1) % count, (k + 1) % count + count, k + count) for k in range(count))
    outlines = (tuple(range(count)), tuple(range(count, 2 * count)), *sides)
    return SolidBody((), np.zeros((0, 4, 4)), np.concatenate([base, upper]), outlines, first_id=first_id)


def part_text(body: SolidBody, start: Mapping[str, Mapping[int, tuple[float, float]]]) -> str:
    """The part file of a solid for the detector ``edges``; ``start``: by camera, pixels of its vertices by id."""
    lines = ["schema = 1"]
    for marker, point in zip(body.ids.tolist(), body.vertices.tolist(), strict=True):
        lines.append(f"[[vertex]]\nid = {marker}\nat = [{', '.join(f'{x:.6f}' for x in point)}]")
    lines += [f"[[face]]\nvertices = {[int(body.ids[row]) for row in outline]}" for outline in body.outlines]
    for camera, pixels in start.items():
        lines.append(f"[start.{camera}]")
        lines += [f"{marker} = [{u:.1f}, {v:.1f}]" for marker, (u, v) in pixels.items()]
    return "\n".join(lines) + "\n"
