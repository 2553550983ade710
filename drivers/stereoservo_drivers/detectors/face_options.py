"""Options of the faces that the dot detector searches, and their patterns for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Annotated

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import DriverError
from stereoservo.ports.dot_plates import CORNERS, DEFAULT_BODY, FACES, DotFace
from stereoservo_drivers.detectors.patterns import basis_inverse

Positive = Annotated[float, Meta(gt=0)]


class FaceOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A custom face: ids and positions of its dots [any unit], four corners clockwise first; radius in that unit."""

    name: str
    ids: tuple[int, ...]
    positions: tuple[tuple[float, float], ...]
    radius: Positive


@dataclass(frozen=True)
class Pattern:
    """A face in the kernels' form, in units of half the distance of its corners."""

    ids: npt.NDArray[np.int64]
    positions: FloatArray
    radius: float
    bases: npt.NDArray[np.int64]
    inverses: FloatArray


def patterns_of(
    faces: Sequence[FaceOptions | DotFace] | None, beside: Sequence[str | FaceOptions]
) -> tuple[Pattern, ...]:
    """Patterns of a body's ``faces`` (None: the default body's) and of those ``beside`` it. Raises DriverError."""
    if faces is not None and not faces:
        raise DriverError("option", "faces: is empty; give at least one face, or leave it out", faces=[])
    known = [_printed(face) if isinstance(face, str) else face for face in beside]
    patterns = tuple(
        _pattern(face.name, face.ids, np.array(face.positions, dtype=float), face.radius)
        for face in (*(DEFAULT_BODY if faces is None else faces), *known)
    )
    ids = [int(i) for pattern in patterns for i in pattern.ids]
    twice = sorted({i for i in ids if ids.count(i) > 1})
    if twice:
        raise DriverError("option", f"faces: marker ids {twice} are used twice; ids must differ", ids=twice)
    return patterns


def _printed(name: str) -> DotFace:
    if name not in FACES:
        raise DriverError(
            "option", f"beside: no face {name!r} is printed; there are {', '.join(FACES)}", face=name
        )
    return FACES[name]


def _pattern(name: str, ids: Sequence[int], positions: FloatArray, radius: float) -> Pattern:
    if len(ids) != 7 or positions.shape != (7, 2) or not np.isfinite(positions).all():
        raise DriverError(
            "option",
            f"face {name!r}: {len(ids)} ids and positions {positions.shape}; a face has 7 ids and 7 finite (x, y)",
            face=name,
        )
    corners = positions[list(CORNERS)]
    edges = np.roll(corners, -1, axis=0) - corners
    turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
    if not (turns > 0).all():
        raise DriverError(
            "option",
            f"face {name!r}: its first four dots are not convex and clockwise (x right, y down)",
            face=name,
        )
    unit = 0.5 * float(np.linalg.norm(edges, axis=1).mean())
    scaled = np.ascontiguousarray((positions - corners.mean(axis=0)) / unit)
    bases = np.array([CORNERS, *(_spare_basis(scaled, corner) for corner in CORNERS)], np.int64)
    return Pattern(
        ids=np.array(ids, np.int64),
        positions=scaled,
        radius=radius / unit,
        bases=bases,
        inverses=np.array([basis_inverse(scaled[basis]) for basis in bases]),
    )


def _spare_basis(positions: FloatArray, missing: int) -> tuple[int, int, int, int]:
    """Four dots without ``missing``, convex and clockwise where possible, with the largest smallest triangle."""
    points = [complex(x, y) for x, y in positions]

    def quality(rows: tuple[int, ...]) -> float:
        p = [points[i] for i in rows]
        triangles = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
        return min(((p[b] - p[a]).conjugate() * (p[c] - p[a])).imag for a, b, c in triangles)

    others = [i for i in range(len(positions)) if i != missing]
    best = max(permutations(others, 4), key=quality)
    return best[0], best[1], best[2], best[3]
