"""Part files: a convex part without markers, as vertices with ids and faces, and where pictures show it at first."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.ports.devices import DriverError
from stereoservo_drivers.options import invalid

FLAT = 1e-3
"""Largest distance of a face's vertices from its plane, and of others beyond it, as a share of the part's size."""
LEAST_ANGLE = float(np.deg2rad(10.0))
"""Least angle of the two edges that cross most squarely in a vertex."""
LEAST_START = 4
"""Vertices that a start must name: their pixels then determine a pose."""


class PartVertex(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A vertex: its marker ``id`` and where it is on the part, in any unit of length."""

    id: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    at: tuple[float, float, float]


class PartFace(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A plane face: the ids of its vertices along its border, either way round."""

    vertices: Annotated[tuple[int, ...], Meta(min_length=3, max_length=64)]


class PartFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part file. ``start``: by camera, raw pixels of four vertices or more in a picture of the part at its start."""

    vertex: Annotated[tuple[PartVertex, ...], Meta(min_length=4, max_length=200)]
    face: Annotated[tuple[PartFace, ...], Meta(min_length=1, max_length=200)]
    start: dict[str, dict[int, tuple[float, float]]]
    schema: Annotated[int, Meta(ge=1, le=1)] = 1


@dataclass(frozen=True, eq=False)
class Part:
    """A part: ``ids`` (n,), ``points`` (n, 3) about their middle in units of their spread, ``normals`` (f, 3) outward
    and ``offsets`` (f,) of its faces, ``edges`` (e, 2) as rows of points, ``sides`` (e, f): which faces meet there.
    """

    ids: IntArray
    points: FloatArray
    normals: FloatArray
    offsets: FloatArray
    edges: IntArray
    sides: FloatArray


def load_part(path: Path, camera: str) -> tuple[Part, IntArray, FloatArray]:
    """The part of a file, and of the camera's start the rows (k,) of its vertices and their pixels (k, 2).

    Raises DriverError (``part``), which names the file, the key, the value and what would be valid.
    """

    def refuse(text: str) -> DriverError:
        return DriverError("part", f"{path}: {text}", path=str(path))

    try:
        tree: dict[str, Any] = tomllib.loads(path.read_text("utf-8"))
        file = msgspec.convert(tree, PartFile, strict=True, str_keys=True)
    except OSError as error:
        raise refuse(f"the part file cannot be read: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise refuse(f"no TOML: {error}") from error
    except msgspec.ValidationError as error:
        raise refuse(invalid(PartFile, tree, error)) from error
    part = make_part(file, refuse)
    return part, *_start_of(file, part, camera, refuse)


def make_part(file: PartFile, refuse: Any = ValueError) -> Part:
    """The part of decoded vertices and faces. Raises what ``refuse`` makes of a text."""
    ids = [vertex.id for vertex in file.vertex]
    if len(set(ids)) < len(ids):
        twice = next(marker for marker in ids if ids.count(marker) > 1)
        raise refuse(f"vertex {twice} is there twice; every vertex has an id of its own")
    points = np.array([vertex.at for vertex in file.vertex])
    if not np.isfinite(points).all():
        raise refuse("a vertex is not finite")
    points = points - points.mean(axis=0)
    size = float(np.sqrt((points**2).sum(axis=1).mean()))
    if not np.linalg.svd(points, compute_uv=False)[-1] > FLAT * size:
        raise refuse("all vertices lie in one plane; a solid part is needed")
    points = points / size
    normals, offsets, edges = [], [], dict[tuple[int, int], list[int]]()
    for k, face in enumerate(file.face):
        unknown = [marker for marker in face.vertices if marker not in ids]
        if unknown or len(set(face.vertices)) < len(face.vertices):
            raise refuse(
                f"face {k + 1} = {list(face.vertices)}: "
                + (f"no vertex {unknown[0]}" if unknown else "a vertex is there twice")
                + f"; vertices are {ids}"
            )
        rows = [ids.index(marker) for marker in face.vertices]
        normal, offset = _face_plane(points, rows, f"face {k + 1} = {list(face.vertices)}", ids, refuse)
        normals.append(normal)
        offsets.append(offset)
        for a, b in zip(rows, [*rows[1:], rows[0]], strict=True):
            edges.setdefault((min(a, b), max(a, b)), []).append(k)
    for (a, b), faces in edges.items():
        if len(faces) > 2:
            raise refuse(f"{len(faces)} faces meet in the edge of vertices {ids[a]} and {ids[b]}; two do")
    sides = np.zeros((len(edges), len(normals)))
    for row, faces in enumerate(edges.values()):
        sides[row, faces] = 1.0
    part = Part(
        np.array(ids, np.int64), points, np.array(normals), np.array(offsets), np.array(list(edges)), sides
    )
    _require_crossings(part, refuse)
    return part


def _face_plane(
    points: FloatArray, rows: list[int], name: str, ids: list[int], refuse: Any
) -> tuple[FloatArray, float]:
    """Outward unit normal and offset of a face's plane."""
    middle = points[rows].mean(axis=0)
    _, singular, axes = np.linalg.svd(points[rows] - middle)
    if not singular[1] > FLAT:
        raise refuse(f"{name}: its vertices lie on one line")
    normal = axes[2] if axes[2] @ middle > 0.0 else -axes[2]
    off = np.abs((points[rows] - middle) @ normal)
    if off.max() > FLAT:
        raise refuse(f"{name}: vertex {ids[rows[int(off.argmax())]]} is off the plane of the others")
    beyond = (points - middle) @ normal
    if beyond.max() > FLAT:
        raise refuse(
            f"{name}: vertex {ids[int(beyond.argmax())]} lies beyond it; only convex parts are supported: leave out "
            "what is behind, or describe a convex part of it"
        )
    return normal, float(middle @ normal)


def _require_crossings(part: Part, refuse: Any) -> None:
    """Refuse vertices in which no two edges cross at an angle."""
    for row, marker in enumerate(part.ids.tolist()):
        own = part.edges[(part.edges == row).any(axis=1)]
        if len(own) < 2:
            raise refuse(f"vertex {marker} is in {len(own)} edges; two that cross there are needed")
        along = part.points[own[:, 1]] - part.points[own[:, 0]]
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
        cosines = np.abs(along @ along.T)
        if not cosines.min() < np.cos(LEAST_ANGLE):
            raise refuse(
                f"vertex {marker}: its edges cross at {np.rad2deg(np.arccos(min(1.0, cosines.min()))):.1f} degrees at "
                f"most, {np.rad2deg(LEAST_ANGLE):.0f} are needed"
            )


def _start_of(file: PartFile, part: Part, camera: str, refuse: Any) -> tuple[IntArray, FloatArray]:
    if camera not in file.start:
        raise refuse(
            f"start.{camera} is missing: pixels of {LEAST_START} vertices or more in a picture of camera {camera!r}; "
            f"given: {', '.join(sorted(file.start)) or 'none'}"
        )
    start, ids = file.start[camera], part.ids.tolist()
    unknown = [marker for marker in start if marker not in ids]
    if unknown:
        raise refuse(f"start.{camera}: no vertex {unknown[0]}; vertices are {ids}")
    if len(start) < LEAST_START:
        raise refuse(f"start.{camera} names {len(start)} vertices; {LEAST_START} or more are needed")
    pixels = np.array(list(start.values()), dtype=np.float64)
    if not np.isfinite(pixels).all():
        raise refuse(f"start.{camera}: a pixel is not finite")
    return np.array([ids.index(marker) for marker in start]), pixels
