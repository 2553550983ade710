"""Resolves a goal's target in the model's frame into set-points and the body's pose at the goal, for a large body in
parts, one a step. Refuses invalid targets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from itertools import chain
from math import isfinite
from typing import Any

import numpy as np

from stereoservo.control.faces import spaced_in_images
from stereoservo.core.context import RefusalError
from stereoservo.core.goals.marker_body import (
    LAW_STEPS,
    MAX_GOAL_RESIDUAL_PX,
    REFINEMENTS,
    BodyState,
    GoalPose,
    determinant4,
    displacement_basis,
    displacement_by_law,
    displacement_in,
    enough_in_view,
    enough_shown,
    in_front,
    keeps_its_shape,
    mirrored,
    one_body,
    product4,
    reached_pose,
    refined_pose,
    turned_to,
    view_of,
)
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.prediction import chain_at
from stereoservo.core.settings import FEWEST_MARKERS, MIN_MARKERS, CameraSettings, CoreSettings
from stereoservo.core.state import GoalResolution
from stereoservo.kinematics.kernels import (
    invert4,
    transform_points,
    triangulate,
    undistort_pixel,
)
from stereoservo.messages.goals import DisplacementTarget, FeatureTarget, Pixel, PointTarget
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import kernel

Resolvable = FeatureTarget | PointTarget | DisplacementTarget

NOTHING = np.zeros(0)
ROUNDS_OF_PIXELS = 4096
"""Largest number of marker pixels in the least-squares iterations of one step."""
AT_ONCE = 128
"""Number of marker pixels up to which a goal is resolved, and its plan set up, in one step."""
STEPS = 8
"""Steps of the law that computes the initial value of least squares, in one control step, for larger bodies."""
MIN_FACE_AREA_PX2 = 100.0
SINGULAR = 1e-9
"""Determinant, relative to the fourth power of its largest entry, below which a matrix is no displacement."""
COPLANAR = 1e-3
"""Affine coordinate of a basis marker in the other four below which four of the five count as coplanar."""
FINITE_HEIGHT = 1e-9
"""Height ``|a∞ᵀM|`` relative to ``|a∞||M|`` below which a point is at infinity."""


def resolve(target: Resolvable, place: BodyState, needs_pose: bool, epoch: int) -> GoalResolution:
    """The resolution of ``target``. ``needs_pose``: of the law; ``epoch``: of the model in use. Raises RefusalError."""
    of_this_model(target.model_epoch, epoch)
    goal = begin_resolution(place, np.zeros(0), needs_pose)
    while not resolve_part(goal, target, place):
        pass
    return goal


def begin_resolution(place: BodyState, joints: FloatArray, needs_pose: bool) -> GoalResolution:
    """A resolution before its first part, for a body at ``place`` with the arm at ``joints`` (n,)."""
    return GoalResolution(
        joints=joints, start=place.points, operators=place.operators, faces=place.faces, needs_pose=needs_pose,
        part=0, rounds=0, set_points=NOTHING, wanted=NOTHING, targets=NOTHING, known=np.zeros(0, np.bool_),
        pose_known=False, face=np.zeros(3, np.int64), displacement=np.zeros((4, 4)), points=NOTHING,
    )  # fmt: skip


def resolve_part(goal: GoalResolution, target: Resolvable, place: BodyState) -> bool:
    """Do the next part of the resolution; returns whether it was the last. Raises RefusalError if the target is
    impossible.
    """
    if _PARTS[goal.part](goal, target, place):
        goal.part += 1
    return goal.part == len(_PARTS)


def of_this_model(model_epoch: int | None, epoch: int) -> None:
    """Raises RefusalError if a goal was stated with another model than that of ``epoch``."""
    if model_epoch is not None and model_epoch != epoch:
        raise RefusalError(
            "OTHER_MODEL",
            f"the goal was taught with model epoch {model_epoch}; the cell has epoch {epoch}: teach it again",
            value=float(model_epoch),
            threshold=float(epoch),
        )


# -- set-points in images -------------------------------------------------------------------------------------


def _features(goal: GoalResolution, target: FeatureTarget, place: BodyState) -> None:
    goal.set_points, goal.wanted = raw_set_points(target, place)


def _triangulated(goal: GoalResolution, place: BodyState) -> None:
    """Triangulate the markers at the goal from set-points. Raises RefusalError if too few are shown."""
    arrays = place.arrays
    goal.targets, goal.known = _intersected(arrays.matrices, goal.set_points, goal.wanted, arrays.plane_at_infinity)
    shown = int((goal.wanted.sum(axis=0) > 0).sum())
    needed = FEWEST_MARKERS[len(place.operators)]
    if shown < needed:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"the goal shows {shown} markers; at least {needed} are needed to fix a pose",
            value=float(shown),
            threshold=float(needed),
            unit="markers",
        )
    goal.points = goal.targets
    goal.pose_known = goal.needs_pose or int(goal.known.sum()) >= MIN_MARKERS


def raw_set_points(target: FeatureTarget, place: BodyState) -> tuple[FloatArray, FloatArray]:
    """Set-points (c, m, 2) as ideal pixels and required ones (c, m), of a target in raw pixels.

    Raises RefusalError for an impossible camera, marker or pixel.
    """
    arrays, cameras = place.arrays, place.settings.cameras
    set_points, required = (
        np.zeros((len(cameras), len(arrays.marker_ids), 2)),
        np.zeros((len(cameras), len(arrays.marker_ids))),
    )
    for name, markers in target.set_points.items():
        camera = camera_index(name, place.settings)
        shape = cameras[camera]
        given = _numbers(markers.values(), 2)
        ideal = ideal_pixels(arrays.lenses[camera], given)
        rows = marker_indices(markers, arrays)
        set_points[camera, rows], required[camera, rows] = ideal, 1.0
        inside = (given >= -0.5) & (given <= np.array((shape.width, shape.height)) - 0.5) & np.isfinite(ideal)
        for k in np.flatnonzero(~inside.all(axis=1)):
            marker = tuple(markers)[k]
            require_imaged(shape, f"marker {marker}", markers[marker], ideal[k])
    return set_points, required


@kernel
def ideal_pixels(lens: FloatArray, raw: FloatArray) -> FloatArray:
    """Ideal pixels (k, 2) of ``raw`` (k, 2); NaN where the lens images nothing."""
    ideal = np.empty(raw.shape)
    for i in range(raw.shape[0]):
        ideal[i, 0], ideal[i, 1] = undistort_pixel(lens, raw[i, 0], raw[i, 1])
    return ideal


def require_imaged(camera: CameraSettings, what: str, raw: Pixel, ideal: FloatArray) -> None:
    """Raises RefusalError if the ``raw`` pixel of ``what`` is outside the image, or ``ideal`` (2,) is NaN."""
    u, v = raw
    if not (-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
        raise RefusalError(
            "OUTSIDE_IMAGE",
            f"camera {camera.name!r}, {what}: ({u}, {v}) lies outside its {camera.width}x{camera.height} image",
            subject=camera.name,
        )
    if not isfinite(float(ideal[0] + ideal[1])):
        raise RefusalError(
            "OUTSIDE_IMAGE",
            f"camera {camera.name!r}, {what}: ({u}, {v}) lies where the camera's lens images nothing",
            subject=camera.name,
        )


@kernel
def _intersected(
    matrices: FloatArray, set_points: FloatArray, required: FloatArray, plane: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (m, 4) of height 1 that two or more cameras show, else zeros; and which are known (m,).

    ``plane`` (4,): at infinity.
    """
    points, known = triangulate(matrices, set_points, required, 5)
    for i in range(points.shape[0]):
        views = 0.0
        for c in range(matrices.shape[0]):
            views += required[c, i]
        known[i] = known[i] and views >= 2.0
        height = 0.0
        for k in range(4):
            height += points[i, k] * plane[k]
        for k in range(4):
            points[i, k] = points[i, k] / (1.0 if height == 0.0 else height) if known[i] else 0.0
    return points, known


def camera_index(name: str, settings: CoreSettings) -> int:
    """Index of a camera. Raises RefusalError."""
    names = [camera.name for camera in settings.cameras]
    if name not in names:
        raise RefusalError("NO_SUCH_CAMERA", f"no camera {name!r}; cameras: {', '.join(names)}", subject=name)
    return names.index(name)


def joint_index(name: str, settings: CoreSettings) -> int:
    """Index of a joint. Raises RefusalError."""
    names = settings.joint_names
    if name not in names:
        raise RefusalError("NO_SUCH_JOINT", f"no joint {name!r}; joints: {', '.join(names)}", subject=name)
    return names.index(name)


def marker_index(marker: int, arrays: ModelArrays) -> int:
    """Index of a marker of the model. Raises RefusalError."""
    found = arrays.index.get(marker)
    if found is None:
        known = ", ".join(str(k) for k in arrays.marker_ids)
        raise RefusalError(
            "NO_SUCH_MARKER",
            f"marker {marker} is not in the model; its markers: {known}",
            subject=str(marker),
        )
    return found


def marker_indices(markers: Iterable[int], arrays: ModelArrays) -> list[int]:
    """`marker_index` of each of the ``markers``. Raises RefusalError."""
    found = list(map(arrays.index.get, markers))
    return [marker_index(marker, arrays) if row is None else row for marker, row in zip(markers, found, strict=True)]


def _numbers(rows: Iterable[Iterable[float]], width: int) -> FloatArray:
    """The ``rows`` of so many numbers each as (k, width)."""
    return np.fromiter(chain.from_iterable(rows), np.float64).reshape(-1, width)


# -- points and displacements ---------------------------------------------------------------------------------


def _points(goal: GoalResolution, target: PointTarget, place: BodyState) -> None:
    arrays = place.arrays
    needed = FEWEST_MARKERS[len(place.operators)]
    if len(target.points) < needed:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"the goal gives {len(target.points)} points; at least {needed} that are not on one line are needed",
            value=float(len(target.points)),
            threshold=float(needed),
            unit="markers",
        )
    targets, known = given_points(target, arrays)
    _projected(goal, place, targets, known)


def given_points(target: PointTarget, arrays: ModelArrays) -> tuple[FloatArray, BoolArray]:
    """Points (m, 4) of height 1 stated by ``target``, zeros elsewhere; and which these are (m,).

    Raises RefusalError.
    """
    points = np.zeros((len(arrays.marker_ids), 4))
    given = np.zeros(len(points), dtype=bool)
    rows = marker_indices(target.points, arrays)
    scaled, at_infinity = _unit_heights(_numbers(target.points.values(), 4), arrays.plane_at_infinity)
    if at_infinity >= 0:
        marker, coordinates = list(target.points.items())[at_infinity]
        normalize_scale(np.array(coordinates), arrays, f"the point of marker {marker}", str(marker))
    points[rows], given[rows] = scaled, True
    return points, given


@kernel
def _unit_heights(points: FloatArray, plane: FloatArray) -> tuple[FloatArray, int]:
    """`normalize_scale` of ``points`` (k, 4), and the index of the first that is invalid, or -1."""
    scaled = np.empty(points.shape)
    size = 0.0
    for i in range(4):
        size += plane[i] * plane[i]
    refused = -1
    for k in range(points.shape[0]):
        height, square = 0.0, 0.0
        for i in range(4):
            height += points[k, i] * plane[i]
            square += points[k, i] * points[k, i]
        extent = math.sqrt(square * size)
        if refused < 0 and not (math.isfinite(extent) and abs(height) > FINITE_HEIGHT * extent):
            refused = k
        for i in range(4):
            scaled[k, i] = points[k, i] / height
    return scaled, refused


def normalize_scale(point: FloatArray, arrays: ModelArrays, what: str, subject: str = "") -> FloatArray:
    """``point`` (4,) scaled to height 1. Raises RefusalError if it is not finite, or at infinity."""
    height = float((point * arrays.plane_at_infinity).sum())
    size = float(np.sqrt((point * point).sum() * (arrays.plane_at_infinity**2).sum()))
    if not isfinite(size) or not abs(height) > FINITE_HEIGHT * size:
        raise RefusalError(
            "POINT_AT_INFINITY",
            f"{what} lies at infinity, or is no point: {point.tolist()}; a finite point in the model's frame is needed",
            subject=subject,
            value=abs(height) / size if isfinite(size) and size > 0.0 else None,
            threshold=FINITE_HEIGHT,
        )
    scaled: FloatArray = point / height
    return scaled


def _displacement(goal: GoalResolution, target: DisplacementTarget, place: BodyState) -> None:
    arrays = place.arrays
    matrix = np.array(target.matrix, dtype=np.float64).reshape(4, 4)
    if target.basis is None and target.model_epoch is None:
        raise RefusalError(
            "FRAME_UNKNOWN",
            "a displacement is either in the frame of a model, give its model_epoch, or in the basis of five markers, "
            "give basis",
        )
    H = _proper(matrix)
    if target.frame is not None:
        H = displacement_in(target.frame, matrix, arrays, goal.joints)
    elif target.basis is not None:
        E = _basis(target.basis, place)
        H = product4(product4(E, H), invert4(E))
    moved = transform_points(np.ascontiguousarray(H), place.points)
    heights = (moved * arrays.plane_at_infinity).sum(axis=-1)
    lowest, highest = float(np.abs(heights).min()), float(np.abs(heights).max())
    if not lowest > FINITE_HEIGHT * highest or abs(float(np.sign(heights).sum())) < heights.size:
        raise RefusalError(
            "NOT_RIGID",
            "the matrix is no displacement of the marker body: it takes a part of it through infinity; heights of the "
            f"markers go from {float(heights.min()):.3g} to {float(heights.max()):.3g}, of a displacement they agree",
            value=lowest / highest if highest > 0.0 else 0.0,
            threshold=1.0,
        )
    _projected(goal, place, moved / heights[:, None], np.ones(heights.size, dtype=bool))


def _proper(matrix: FloatArray) -> FloatArray:
    """``matrix`` (4, 4) with determinant 1. Raises RefusalError for NaN, singular and mirroring matrices."""
    largest = float(np.abs(matrix).max())
    if not isfinite(largest):
        raise RefusalError("NON_FINITE", "the displacement holds an entry that is no finite number")
    scaled = matrix / largest if largest > 0.0 else matrix
    determinant = determinant4(scaled)
    if not abs(determinant) > SINGULAR:
        raise RefusalError(
            "NOT_RIGID",
            f"the matrix is singular (determinant {determinant:.3g} at a largest entry of 1); a displacement "
            "has full rank",
            value=abs(determinant),
            threshold=SINGULAR,
        )
    if determinant < 0.0:
        raise RefusalError(
            "MIRRORED_GOAL",
            f"the matrix mirrors (determinant {determinant:.3g}); a displacement has a positive one",
            value=determinant,
            threshold=0.0,
        )
    proper: FloatArray = scaled / determinant**0.25
    return proper


def _basis(ids: tuple[int, ...], place: BodyState) -> FloatArray:
    """``E`` (4, 4) from the coordinates of five markers' basis to the model's frame (2.20, corrected)."""
    indices = [marker_index(marker, place.arrays) for marker in ids]
    if len(set(indices)) < 5:
        raise RefusalError("DEGENERATE_BASIS", f"basis {list(ids)} names a marker twice; five different are needed")
    M = np.ascontiguousarray(place.points[indices[:4]].T)
    centroid = place.points[indices].sum(axis=0) / 5.0
    extent = float(np.sqrt(((place.points[indices] - centroid) ** 2).sum(axis=-1).max()))
    volume = abs(determinant4(M)) / (extent**3 * float(np.sqrt((centroid * centroid).sum())))
    fifth = (
        transform_points(invert4(M), np.ascontiguousarray(place.points[indices[4:]]))[0]
        if volume > COPLANAR**2
        else np.zeros(4)
    )
    least = float(np.abs(fifth).min())
    if not least > COPLANAR:
        raise RefusalError(
            "DEGENERATE_BASIS",
            f"four of the basis markers {list(ids)} lie in one plane, or nearly; choose five of which no four do, or "
            "state the displacement in the model's frame",
            value=least,
            threshold=COPLANAR,
        )
    E: FloatArray = M * fifth[None, :]
    return E


def _projected(goal: GoalResolution, place: BodyState, targets: FloatArray, known: BoolArray) -> None:
    """Set-points by projection of a body at ``targets`` (m, 4) of height 1 where ``known`` (m,)."""
    if int(known.sum()) >= MIN_MARKERS and mirrored(place.points, targets, known):
        raise RefusalError(
            "MIRRORED_GOAL",
            "the points are those of the marker body's mirror image: are left and right, or ids, swapped?",
        )
    in_front(place, targets, known)
    pixels, _ = view_of(place.settings, place.arrays, targets)
    goal.wanted = np.repeat(known[None, :].astype(np.float64), len(place.arrays.matrices), axis=0)
    goal.set_points = np.where(goal.wanted[..., None] > 0.0, pixels, 0.0)
    goal.targets, goal.known, goal.pose_known = targets, known, True


def _shown_set_points(goal: GoalResolution, pose: GoalPose, target: Resolvable, place: BodyState) -> None:
    """Set-points of a body at the goal: the error is taken over the markers stated as points, else over all that are in
    view.
    """
    keeps_its_shape(pose.points, goal.targets, goal.known)
    pixels, shown = view_of(place.settings, place.arrays, pose.points)
    shown = shown * (goal.wanted if isinstance(target, PointTarget) else 1.0)
    enough_in_view(place, pixels, shown, goal.known)
    shown = shown * turned_to(place, pose.displacement)
    enough_shown(place, shown)
    goal.set_points, goal.wanted = np.where(shown[..., None] > 0.0, pixels, 0.0), shown


# -- parts of a resolution ------------------------------------------------------------------------------------


def _read(goal: GoalResolution, target: Resolvable, place: BodyState) -> bool:
    """Read the target, as ideal pixels or points of height 1."""
    _READ[type(target)](goal, target, place)
    return True


def _find_face(goal: GoalResolution, target: Resolvable, place: BodyState) -> bool:
    """Find the markers at the goal, as far as two cameras determine them, and three of them that span a face."""
    if isinstance(target, FeatureTarget):
        _triangulated(goal, place)
    if int((goal.wanted.sum(axis=0) > 0).sum()) < MIN_MARKERS:
        _by_the_arm(goal, place)
        goal.part = len(_PARTS) - 1  # the pose is known
        return True
    if goal.pose_known:
        goal.face = _face(goal.set_points, goal.wanted, goal.known, place.arrays)
    return True


def _by_the_arm(goal: GoalResolution, place: BodyState) -> None:
    """Find the pose at a goal of too few markers to determine it alone: the one that an arm of few joints reaches with
    the least motion. Raises RefusalError if it reaches none.
    """
    arrays, cameras = place.arrays, place.settings.cameras
    start = goal.joints if goal.joints.size else arrays.zero
    reached = reached_pose(arrays, start, goal.set_points, goal.wanted)
    if not reached.worst <= MAX_GOAL_RESIDUAL_PX:
        c, i = reached.camera, reached.marker
        u, v = (float(x) for x in reached.pixels[c, i])
        raise RefusalError(
            "NOT_REACHABLE",
            f"the arm's {start.size} joints cannot bring the markers there: {reached.worst:.1f} px are left of marker "
            f"{arrays.marker_ids[i]} in camera {cameras[c].name!r} (up to {MAX_GOAL_RESIDUAL_PX:g} px is accepted); "
            f"the nearest that they reach is ({u:.1f}, {v:.1f}) there",
            subject=str(arrays.marker_ids[i]),
            threshold=MAX_GOAL_RESIDUAL_PX,
            unit="px",
            value=reached.worst if isfinite(reached.worst) else None,
        )
    goal.points = goal.targets = reached.points
    goal.known, goal.pose_known = np.ones(len(reached.points), dtype=bool), True
    in_front(place, goal.points, goal.known)
    at_goal, at_start = chain_at(arrays, reached.joints)[0], chain_at(arrays, start)[0]
    goal.displacement = product4(at_goal, invert4(at_start))
    pixels, shown = view_of(place.settings, arrays, reached.points)
    goal.face = _face(pixels, shown, goal.known, arrays)


def _start_fit(goal: GoalResolution, target: Resolvable, place: BodyState) -> bool:
    """Find a nearby displacement as the initial value of least squares."""
    if not goal.pose_known:
        return True
    if goal.rounds == 0:
        goal.displacement = np.eye(4)
    steps = LAW_STEPS if place.arrays.observation_count <= AT_ONCE else STEPS
    goal.displacement, near = displacement_by_law(
        place.arrays, place.operators, place.points, goal.targets, goal.known, goal.face, goal.set_points, goal.wanted,
        goal.displacement, steps,
    )  # fmt: skip
    goal.rounds += steps
    if not near and goal.rounds < LAW_STEPS:
        return False
    goal.rounds = 0
    return True


def _fit(goal: GoalResolution, target: Resolvable, place: BodyState) -> bool:
    """Do iterations of least squares; after the last one, check that a rigid body fits."""
    if not goal.pose_known:
        return True
    rounds = min(max(1, ROUNDS_OF_PIXELS // place.arrays.observation_count), REFINEMENTS - goal.rounds)
    basis = displacement_basis(place.arrays, place.operators)
    pose, converged = refined_pose(
        place.arrays, basis, place.points, goal.displacement, goal.set_points, goal.wanted, rounds
    )
    goal.rounds += rounds
    goal.displacement, goal.points = pose.displacement, pose.points
    if not converged and goal.rounds < REFINEMENTS:
        return False
    one_body(pose, place.points, goal.targets, goal.known)
    if not isinstance(target, FeatureTarget):
        _shown_set_points(goal, pose, target, place)
    return True


_PARTS = (_read, _find_face, _start_fit, _fit)
"""Parts of the resolution of a target, in order; for a large body one a step."""

_READ: dict[type[Any], Callable[[GoalResolution, Any, BodyState], None]] = {
    FeatureTarget: _features,
    PointTarget: _points,
    DisplacementTarget: _displacement,
}
"""Readers of a target, by its kind."""


# -- the face -------------------------------------------------------------------------------------------------


def _face(set_points: FloatArray, required: FloatArray, known: BoolArray, arrays: ModelArrays) -> IntArray:
    """Three markers known at the goal that span the largest triangle in the images; of many markers, only well spread
    ones are tried.
    """
    candidates = np.flatnonzero(known)
    if candidates.size < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"{MIN_MARKERS} markers that two cameras show at the goal are needed; {candidates.size} are",
            value=float(candidates.size),
            threshold=float(MIN_MARKERS),
            unit="markers",
        )
    found: IntArray
    found, area = _largest_triangle(candidates, set_points, required)
    if not area >= MIN_FACE_AREA_PX2:
        ids = [arrays.marker_ids[int(i)] for i in candidates]
        raise RefusalError(
            "COLLINEAR_MARKERS",
            f"the markers {ids} of the goal lie on one line; three that span a face are needed",
            value=float(area),
            threshold=MIN_FACE_AREA_PX2,
            unit="px²",
        )
    return found


@kernel
def _largest_triangle(candidates: IntArray, set_points: FloatArray, required: FloatArray) -> tuple[IntArray, float]:
    """Three of the ``candidates`` (k,) with the largest area, and twice that [px²]: the smallest over the cameras that
    see all three.
    """
    tried = spaced_in_images(candidates, set_points, required)
    best = tried[:3].copy()
    largest = -1.0
    for a in range(tried.shape[0]):
        for b in range(a + 1, tried.shape[0]):
            for c in range(b + 1, tried.shape[0]):
                i, j, k = tried[a], tried[b], tried[c]
                least = math.inf
                for camera in range(required.shape[0]):
                    if min(required[camera, i], required[camera, j], required[camera, k]) > 0.0:
                        p = set_points[camera]
                        ux, uy = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
                        vx, vy = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1]
                        least = min(least, abs(ux * vy - uy * vx))
                area = least if least < math.inf else 0.0
                if area > largest:
                    largest = area
                    best[0], best[1], best[2] = i, j, k
    return best, largest
