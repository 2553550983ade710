"""A convex solid without markers as ground truth: vertices with ids, plane faces, and the light that shades them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo_sim.world.body import MarkerBody

FIRST_ID = 400
LIGHT = (-0.6, -0.6, 0.8)
"""Towards the lamp of the embedded cell, above and behind its cameras."""
AMBIENT, SKY, DIFFUSE = 25.0, 60.0, 130.0
"""Grey levels of a face in no light, what the sky adds to one that looks up, and the lamp to one that looks at it."""


@dataclass(frozen=True, eq=False)
class SolidBody(MarkerBody):
    """A convex solid in the flange's frame, in place of plates with dots: its markers are its vertices.

    ``vertices`` (n, 3) [m] with ids from ``first_id`` on; ``outlines``: rows of vertices along each face's border;
    ``light`` (3,): towards the lamp, in the world.
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
        """Mean unit normal of the faces that meet in each vertex, (n, 3)."""
        faces = self.face_normals
        touching = np.array(
            [[row in outline for outline in self.outlines] for row in range(len(self.vertices))]
        )
        normals = touching.astype(np.float64) @ faces
        mean: FloatArray = normals / np.linalg.norm(normals, axis=1, keepdims=True)
        return mean

    @property
    def marker_radii(self) -> FloatArray:
        """Vertices have no extent, (n,)."""
        return np.zeros(len(self.vertices))

    def shades(self, pose: FloatArray) -> FloatArray:
        """Grey levels (f,) of the faces with the body at ``pose`` (4, 4) in the world."""
        light = self.light / np.linalg.norm(self.light)
        normals = self.face_normals @ pose[:3, :3].T
        levels: FloatArray = (
            AMBIENT + 0.5 * SKY * (1.0 + normals[:, 2]) + DIFFUSE * np.maximum(0.0, normals @ light)
        )
        return levels


WEDGE_BASE = np.array([(-0.10, -0.08), (0.09, -0.09), (0.115, 0.05), (0.02, 0.10), (-0.09, 0.07)])
WEDGE_INSETS = (0.045, 0.032, 0.050, 0.036, 0.040)


def wedge(
    first_id: int = FIRST_ID, *, scale: float = 1.0, height: tuple[float, float] = (0.04, 0.11)
) -> SolidBody:
    """A skew five-sided frustum on the flange: ``height`` [m] of its base and of its smaller top along the axis."""
    along = np.roll(WEDGE_BASE, -1, axis=0) - WEDGE_BASE
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    offsets = (inward * WEDGE_BASE).sum(axis=1) + WEDGE_INSETS
    top = [
        np.linalg.solve(inward[[k - 1, k]], offsets[[k - 1, k]]) for k in range(len(WEDGE_BASE))
    ]  # sides stay plane: edges of the top are parallel to those of the base
    count = len(WEDGE_BASE)
    base = np.column_stack([scale * WEDGE_BASE, np.full(count, height[0])])
    upper = np.column_stack(
        [scale * np.array(top), np.full(count, height[0] + scale * (height[1] - height[0]))]
    )
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
