"""Where a goal puts the marker body: before the cameras, in their images, turned to them, one rigid body still."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from stereoservo.control.faces import Faces, sights_along
from stereoservo.core.context import RefusalError
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.settings import CoreSettings
from stereoservo.kinematics.kernels import distort_pixel
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

MIN_MARKERS = 3
RIGID_SHARE = 0.1
"""Of the body's extent that goals in points or matrices may differ by from a rigid displacement, for their noise."""
BODY_DEPTH = 0.02
"""Volume of four markers, relative to the cube of their extent, from which a mirror image can be told."""


@dataclass(frozen=True)
class BodyState:
    """From where a target counts: the body's ``points`` (m, 4) of height 1 and the arm's ``operators`` (n, 4, 4)."""

    settings: CoreSettings
    arrays: ModelArrays
    points: FloatArray
    operators: FloatArray
    faces: Faces
    """Of the body, where it is now."""


def in_view(place: BodyState, pixels: FloatArray) -> FloatArray:
    """(c, m) 1 where ideal ``pixels`` (c, m, 2) lie in the camera's image, 0 elsewhere."""
    found = np.zeros(pixels.shape[:2])
    for c, camera in enumerate(place.settings.cameras):
        for i in range(pixels.shape[1]):
            u, v = distort_pixel(place.arrays.lenses[c], pixels[c, i, 0], pixels[c, i, 1])
            found[c, i] = -0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5
    return found


def enough_in_view(place: BodyState, pixels: FloatArray, shown: FloatArray, known: BoolArray) -> None:
    """Raises RefusalError where no camera has ``shown`` (c, m) enough of the ``known`` markers at the goal."""
    best = int(shown.sum(axis=-1).argmax())
    count = int(shown[best].sum())
    if count >= MIN_MARKERS:
        return
    camera = place.settings.cameras[best]
    lost = int(np.flatnonzero(known & (shown[best] == 0.0))[0])
    u, v = (float(x) for x in pixels[best, lost])
    raise RefusalError(
        "FIELD_OF_VIEW",
        f"at the goal camera {camera.name!r} shows {count} of its markers, the others less; {MIN_MARKERS} are needed: "
        f"marker {place.arrays.marker_ids[lost]} would be at ({u:.0f}, {v:.0f}), its image is "
        f"{camera.width}x{camera.height}",
        subject=camera.name, value=float(count), threshold=float(MIN_MARKERS), unit="markers",
    )  # fmt: skip


def keeps_its_shape(body: FloatArray, targets: FloatArray, known: BoolArray) -> None:
    """Raises RefusalError for points or matrices that stretch or shear the body, along the cameras' rays too."""
    middle = body.sum(axis=0) / len(body)
    extent = float(np.sqrt(((body - middle) ** 2).sum(axis=-1).max()))
    apart = np.where(known, np.sqrt(((body - targets) ** 2).sum(axis=-1)), 0.0)
    share = float(apart.max()) / extent
    if not share <= RIGID_SHARE:
        raise RefusalError(
            "NOT_RIGID",
            f"the goal is no rigid displacement of the marker body: it differs from the nearest by {share:.2f} of the "
            f"body's extent; up to {RIGID_SHARE} is accepted",
            value=share, threshold=RIGID_SHARE, unit="of the body's extent",
        )  # fmt: skip


def turned_to(place: BodyState, displacement: FloatArray) -> FloatArray:
    """(c, m) 1 where a marker's face is turned to the camera after ``displacement``; 1 where no side of it is known."""
    faces = place.faces
    found = np.ones((len(place.arrays.camera_centres), len(place.points)))
    if not bool((faces.sided > 0.0).any()):
        return found
    fronts = sights_along(faces, place.points, displacement[None], place.arrays.camera_centres).fronts[0]
    told = faces.members[faces.sided > 0.0].max(axis=0) > 0.0
    for c in range(len(found)):
        turned = (faces.members * fronts[:, c : c + 1]).max(axis=0) > 0.0
        found[c] = np.where(told & ~turned, 0.0, 1.0)
    return found


def enough_shown(place: BodyState, shown: FloatArray) -> None:
    """Raises RefusalError where the body turns its back: too few markers are ``shown`` (c, m) from their front."""
    best = int(shown.sum(axis=-1).argmax())
    count = int(shown[best].sum())
    if count >= MIN_MARKERS:
        return
    camera = place.settings.cameras[best].name
    raise RefusalError(
        "FACE_HIDDEN",
        f"at the goal camera {camera!r} would see the front of {count} markers, the others of less; {MIN_MARKERS} are "
        "needed: the body turns its back",
        subject=camera, value=float(count), threshold=float(MIN_MARKERS), unit="markers",
    )  # fmt: skip


def in_front(place: BodyState, targets: FloatArray, known: BoolArray) -> None:
    """Raises RefusalError for a goal behind a camera that has the body before it now."""
    for c, P in enumerate(place.arrays.matrices):
        now = (place.points * P[2]).sum(axis=-1)
        side = 1.0 if float(np.sign(now).sum()) >= 0.0 else -1.0
        if not bool((side * now > 0.0).all()):
            continue  # the body is about this camera's plane already: it tells nothing
        then = side * (targets * P[2]).sum(axis=-1)
        behind = np.flatnonzero(known & ~(then > 0.0))
        if behind.size:
            i, camera = int(behind[0]), place.settings.cameras[c].name
            share = float(then[i] / (side * now[i]))
            raise RefusalError(
                "BEHIND_CAMERA",
                f"at the goal marker {place.arrays.marker_ids[i]} lies behind camera {camera!r} "
                f"(at {share:.2f} of its present depth; more than 0 is needed)",
                subject=camera, value=share, threshold=0.0, unit="of the present depth",
            )  # fmt: skip


def mirrored(points: FloatArray, targets: FloatArray, known: BoolArray) -> bool:
    """Whether four markers that span a wide volume have turned inside out. False for a flat body: not to be told."""
    four = _widest(points, np.flatnonzero(known))
    now, then = points[four], targets[four]
    extent = float(np.sqrt(((now[1:] - now[0]) ** 2).sum(axis=-1).max()))
    scale = extent**3 * float(np.sqrt((now[0] * now[0]).sum()))
    volume = determinant4(now) / scale if len(four) == 4 and scale > 0.0 else 0.0
    return abs(volume) > BODY_DEPTH and determinant4(then) * volume < 0.0


def _widest(points: FloatArray, candidates: IntArray) -> list[int]:
    """Up to four of the ``candidates``, each the farthest from what those before it span."""
    rest = points[candidates] - points[candidates].sum(axis=0) / max(len(candidates), 1)
    four: list[int] = []
    for _ in range(min(4, len(candidates))):
        squares = (rest * rest).sum(axis=-1)
        far = int(squares.argmax())
        four.append(int(candidates[far]))
        if len(four) == 1:
            rest = rest - rest[far]
        elif float(squares[far]) > 0.0:
            rest = rest - ((rest * rest[far]).sum(axis=-1) / squares[far])[:, None] * rest[far]
    return four


def determinant4(A: FloatArray) -> float:
    """Determinant of ``A`` (4, 4) by 2×2 minors."""
    a, b, c, d = A
    top = [a[i] * b[j] - a[j] * b[i] for i, j in combinations(range(4), 2)]
    low = [c[i] * d[j] - c[j] * d[i] for i, j in combinations(range(4), 2)]
    return float(
        top[0] * low[5]
        - top[1] * low[4]
        + top[2] * low[3]
        + top[3] * low[2]
        - top[4] * low[1]
        + top[5] * low[0]
    )
