"""Findings from pictures of printed faces before any calibration: the angle by which the plate was turned between two
sets of pictures, and on which side of each other two cameras are.

Pure functions from pixels to findings. The size of a face's pattern is not needed, and neither are camera parameters:
the focal length is the one with the least misfit of flat faces, and small rotations hardly depend on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stereoservo.cli.doctor.camera_findings import CameraRecord, mean_observations
from stereoservo.numerics.arrays import FloatArray
from stereoservo.ports.devices import ExaminationFinding
from stereoservo.ports.dot_plates import FACES

LEAST_DOTS = 5
"""Least number of dots that determine a face's pose."""
FOCAL_LENGTHS = np.geomspace(0.6, 3.0, 25)
"""[widths of a picture] of lenses that are tried."""
USUAL_FOCAL, FOCAL_SPREAD = 1.1, 0.5
"""Prior of the focal length: [widths], and standard deviation of its natural logarithm."""
LEAST_SIGMA_PX = 0.01
AGREES = 0.15
"""Relative tolerance between pictures and encoder: perspective of an unknown lens, play, a shaken table."""
SIGMAS = 3.5
UNSEEN = 0.5
"""Relative standard deviation of a motion above which its pictures are not significant."""
SIDES = ("left", "right")

View = tuple[FloatArray, FloatArray, float]
"""One face in one picture: its pattern (k, 3), its pixels (k, 2) and their standard deviation [px]."""


@dataclass(frozen=True)
class Turn:
    """A rotation seen in pictures: ``angle`` [rad] with its standard deviation, and the shift of the markers (2,) [px]
    in the camera that shows it best.
    """

    angle: float
    sigma: float
    camera: str
    shift: FloatArray


def faces_in(record: CameraRecord) -> dict[str, tuple[list[int], FloatArray, FloatArray, float]]:
    """Faces seen by a camera: by name ids, pattern (k, 3), mean pixels (k, 2) and their standard deviation [px]."""
    ids, pixels, sigmas = mean_observations(record)
    place = {int(marker): k for k, marker in enumerate(ids)}
    found = {}
    for name, face in FACES.items():
        rows = [row for row, marker in enumerate(face.ids) if marker in place]
        if len(rows) < LEAST_DOTS:
            continue
        seen = [place[face.ids[row]] for row in rows]
        pattern = np.column_stack([face.positions[rows], np.zeros(len(rows))])
        averaged = float(np.median(sigmas[seen])) / math.sqrt(max(len(record.seen), 1))
        found[name] = ([face.ids[row] for row in rows], pattern, pixels[seen], max(averaged, LEAST_SIGMA_PX))
    return found


def intrinsics(width: int, height: int, focal: float) -> FloatArray:
    """Matrix (3, 3) of a camera of focal length ``focal`` [widths] with its principal point at the centre of its
    picture.
    """
    f = focal * width
    return np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])


def poses(pattern: FloatArray, pixels: FloatArray, K: FloatArray) -> list[tuple[float, FloatArray, FloatArray]]:
    """Poses of a planar pattern (k, 3) from its pixels (k, 2), best first: rms [px], rotation vector (3,), translation
    (3,). Two if the plane is too distant to distinguish them, or none.
    """
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            pattern, np.ascontiguousarray(pixels), K, None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # degenerate: a face seen along its edge
        return []
    found = []
    for r, t in zip(rotations, translations, strict=True):
        refined = refined_pose(pattern, pixels, K, r, t)
        if refined is not None:
            found.append(refined)
    return sorted(found, key=lambda pose: pose[0])


def refined_pose(
    pattern: FloatArray, pixels: FloatArray, K: FloatArray, r: FloatArray, t: FloatArray
) -> tuple[float, FloatArray, FloatArray] | None:
    """The least-squares pose, refined from an initial one: rms [px], rotation vector (3,), translation (3,); None if it
    is behind the camera.
    """
    try:
        r, t = cv2.solvePnPRefineLM(pattern, np.ascontiguousarray(pixels), K, None, r.copy(), t.copy())
    except cv2.error:
        return None
    if t[2, 0] <= 0.0:
        return None
    shown = cv2.projectPoints(pattern, r, t, K, None)[0].reshape(-1, 2)
    return float(np.sqrt(np.mean((shown - pixels) ** 2))), r.reshape(3), t.reshape(3)


def focal_length(width: int, height: int, views: Sequence[View]) -> float:
    """The focal length [widths] with the least misfit of flat faces, one view each."""

    def cost(focal: float) -> float:
        K = intrinsics(width, height, focal)
        total = (math.log(focal / USUAL_FOCAL) / FOCAL_SPREAD) ** 2
        for pattern, pixels, sigma in views:
            found = poses(pattern, pixels, K)
            total += (found[0][0] / sigma) ** 2 * pixels.size if found else 1e9
        return total

    return float(min(FOCAL_LENGTHS, key=cost))


def _rotation_between(K: FloatArray, before: View, after: View) -> tuple[FloatArray, FloatArray] | None:
    """Rotation vector (3,) of a face between two pictures in the camera's frame, and its information matrix (3, 3)."""
    first = poses(before[0], before[1], K)
    if not first:
        return None
    _, r0, t0 = first[0]
    second = refined_pose(after[0], after[1], K, r0.reshape(3, 1), t0.reshape(3, 1))
    if second is None:
        return None
    r1 = second[1]
    R0, R1 = cv2.Rodrigues(r0)[0], cv2.Rodrigues(r1)[0]
    turned = cv2.Rodrigues(R1 @ R0.T)[0].reshape(3)
    # In the camera's frame: a small turn w after the pose changes X by w x (X - t).
    X = before[0] @ R0.T + t0
    f = K[0, 0]
    rows = []
    for x, y, z in X:
        J = np.array([[f / z, 0.0, -f * x / z**2], [0.0, f / z, -f * y / z**2]])
        arm = np.array([x, y, z]) - t0
        cross = np.array([[0.0, arm[2], -arm[1]], [-arm[2], 0.0, arm[0]], [arm[1], -arm[0], 0.0]])
        rows.append(np.hstack([J @ cross, J]))
    A = np.vstack(rows)
    N = A.T @ A / (before[2] ** 2 + after[2] ** 2)
    information = N[:3, :3] - N[:3, 3:] @ np.linalg.solve(N[3:, 3:], N[3:, :3])
    return turned, information


def turn_between(before: Sequence[CameraRecord], after: Sequence[CameraRecord]) -> Turn | None:
    """Rotation of the faces between two sets of pictures of the same cameras; None if no camera sees a face in both.

    The rotation of a body is the same about any point, and its angle is the same for all cameras.
    """
    weights, angles, shown = [], [], []
    for first, second in zip(before, after, strict=True):
        old, new = faces_in(first), faces_in(second)
        common = [name for name in old if name in new and old[name][0] == new[name][0]]
        if not common:
            continue
        views = [(old[name][1:], new[name][1:]) for name in common]
        size = first.description.width, first.description.height
        K = intrinsics(*size, focal_length(*size, [view for view, _ in views]))
        turns = [turn for one, other in views if (turn := _rotation_between(K, one, other)) is not None]
        if not turns:
            continue
        total = sum((information for _, information in turns), np.zeros((3, 3)))
        vector = np.linalg.solve(total, sum((info @ w for w, info in turns), np.zeros(3)))
        C = np.linalg.inv(total)
        angle = math.sqrt(max(float(vector @ vector) - float(np.trace(C)), 0.0))
        along = vector / max(float(np.linalg.norm(vector)), 1e-12)
        variance = float(along @ C @ along)
        weights.append(1.0 / variance)
        angles.append(angle)
        moved = np.mean([new[name][2] - old[name][2] for name in common], axis=(0, 1))
        shown.append((variance, first.name, moved))
    if not weights:
        return None
    _, camera, shift = min(shown, key=lambda one: one[0])
    return Turn(float(np.average(angles, weights=weights)), 1.0 / math.sqrt(sum(weights)), camera, np.asarray(shift))


def judge_turn(joint: str, travel: float, turn: Turn | None) -> ExaminationFinding:
    """Finding on a revolute joint's ``travel`` [rad] by its encoder, compared with the rotation in the pictures."""
    name = f"{joint} pictures"
    told = f"{math.degrees(abs(travel)):.3f}°"
    if turn is None:
        return ExaminationFinding(
            name, None, "no face of dots was seen before and after: whether the encoder's travel is true is not known"
        )
    seen = f"{math.degrees(turn.angle):.3f}° (± {math.degrees(turn.sigma):.3f}°)"
    shift = f"the dots went {_direction(turn.shift)} in {turn.camera!r}"
    tolerance = AGREES * abs(travel) + SIGMAS * turn.sigma
    if SIGMAS * turn.sigma > UNSEEN * abs(travel):
        return ExaminationFinding(
            name,
            None,
            f"the encoder told {told}; the pictures saw {seen}: too small to judge; {shift}",
            "a larger or nearer plate, sharper pictures",
        )
    if abs(turn.angle - abs(travel)) <= tolerance:
        return ExaminationFinding(name, True, f"the encoder told {told}, the pictures saw {seen}; {shift}")
    factor = turn.angle / abs(travel)
    if factor < AGREES:
        return ExaminationFinding(
            name,
            False,
            f"the encoder told {told}, the pictures saw {seen}: the plate stands still",
            "is the plate on the arm, behind this joint; does the coupling between motor and joint hold?",
        )
    return ExaminationFinding(
        name,
        False,
        f"the encoder told {told}, the pictures saw {seen}: {factor:.2f} times; {shift}",
        f"gear_ratio of {joint!r} divided by {factor:.2f} (or counts_per_rev)",
    )


def _direction(shift: FloatArray) -> str:
    u, v = float(shift[0]), float(shift[1])
    across = f"{abs(u):.1f} px to the {'right' if u > 0 else 'left'}"
    along = f"{abs(v):.1f} px {'down' if v > 0 else 'up'}"
    return f"{across} and {along}"


# -- where cameras stand -------------------------------------------------------------------------------------------


def examine_sides(records: Sequence[CameraRecord]) -> ExaminationFinding | None:
    """Finding on two cameras that are named after their sides; None if they are not, or no face is seen by both.

    Of a face's two poses that a distant camera cannot distinguish, all that explain the pictures must agree.
    """
    named = {side: record for side in SIDES for record in records if side in record.name.lower()}
    if len(named) < 2 or named["left"] is named["right"]:
        return None
    left, right = named["left"], named["right"]
    offsets = side_offsets(left, right)
    if not offsets:
        return None
    name = f"sides {left.name}-{right.name}"
    if min(offsets) < 0.0 < max(offsets):
        return ExaminationFinding(name, None, "which camera stands on which side is not told by these pictures")
    if min(offsets) > 0.0:
        return ExaminationFinding(name, True, f"{right.name!r} stands to the right of {left.name!r}")
    return ExaminationFinding(
        name,
        False,
        f"{left.name!r} looks from the right of {right.name!r}: they are swapped",
        "exchange their sources (or their names, or cables)",
    )


def side_offsets(left: CameraRecord, right: CameraRecord) -> list[float]:
    """Displacement of the right camera to the right of the left one, relative to the plate's distance, for each face
    and each pair of poses that explains it; empty if none is seen by both.
    """
    offsets = []
    views = [faces_in(record) for record in (left, right)]
    sizes = [(record.description.width, record.description.height) for record in (left, right)]
    for name in set(views[0]) & set(views[1]):
        explained = []
        for (width, height), faces in zip(sizes, views, strict=True):
            _, pattern, pixels, sigma = faces[name]
            own = [face[1:] for face in faces.values()]
            found = poses(pattern, pixels, intrinsics(width, height, focal_length(width, height, own)))
            explained.append([pose for pose in found if pose[0] <= max(2.0 * found[0][0], 3.0 * sigma)])
        for _, r0, t0 in explained[0]:
            for _, r1, t1 in explained[1]:
                R0, R1 = cv2.Rodrigues(r0)[0], cv2.Rodrigues(r1)[0]
                centre = R0 @ (-R1.T @ t1) + t0
                offsets.append(float(centre[0] / np.linalg.norm(t0)))
    return offsets
