"""The pose of the marker body at a goal, from all of its set-points: the law run on paper, then least squares.

Three triangulated points would do for (7.21)-(7.24), but every marker of the goal says something. The displacement from
the present to the goal is found by integrating the Cartesian law itself, which converges from anywhere, and refined on
the reprojection error of all set-points. What comes out is one rigid displacement of the calibrated structure, so also
markers that the goal does not show have their place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from math import isfinite
from typing import Any

import numpy as np

from stereoservo.control.laws.cartesian3 import cartesian3_step
from stereoservo.core.context import RefusalError
from stereoservo.core.goals.target_checks import (
    MIN_MARKERS,
    BodyState,
    determinant4,
    enough_in_view,
    enough_shown,
    in_front,
    in_view,
    keeps_its_shape,
    mirrored,
    turned_to,
)
from stereoservo.core.model_arrays import ModelArrays, with_unit_height
from stereoservo.core.settings import CameraSettings, CoreSettings
from stereoservo.kinematics.kernels import (
    exp_twist,
    image_jacobian,
    invert4,
    multiply4_into,
    project_points,
    transform_points,
    triangulate,
    undistort_pixel,
)
from stereoservo.messages.goals import DisplacementTarget, FeatureTarget, PointTarget
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.linear import damped_least_squares

LAW_STEPS = 80
NEAR = 1e-5  # of a step in the basis: least squares goes on from there
LAW_GAIN = 0.3  # of the way still to be made, a step
REFINEMENTS = 12
REFINE_DAMPING = 1e-12
CONVERGED = 1e-13  # of a refinement's step in the basis


@dataclass(frozen=True)
class GoalPose:
    """Marker points at the goal (m, 4) of height a∞ᵀM = 1, and how well they explain the set-points [px].

    ``displacement`` (4, 4) takes the body there from where it was.
    """

    points: FloatArray
    displacement: FloatArray
    rms_px: float
    worst_px: float
    worst_marker: int


def goal_pose(
    arrays: ModelArrays,
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    known: BoolArray,
    face: IntArray,
    set_points: FloatArray,
    wanted: FloatArray,
) -> GoalPose:
    """Fit one rigid displacement of ``points`` (m, 4) to the set-points.

    ``targets`` (m, 4): triangulated goal points where ``known`` (m,); ``face`` (3,) spans a face. ``operators``
    (n, 4, 4): the arm's at present, a basis of displacements where the model knows no metric one.
    """
    basis = operators if arrays.metric_basis is None else arrays.metric_basis
    D = np.zeros((4, 4))
    for i in range(4):
        D[i, i] = 1.0
    moved = points
    nobody = np.zeros((0, 4))  # on paper no camera has to keep sight of the face
    gains = np.full(3, LAW_GAIN)
    centre_target = targets[known].sum(axis=0) / float(known.sum())
    for _ in range(LAW_STEPS):
        centre = moved[known].sum(axis=0) / float(known.sum())
        twist, _, _, _ = cartesian3_step(
            basis, moved[face], targets[face], centre, centre_target, nobody, gains
        )
        D = _onwards(basis, twist, D)
        moved = transform_points(D, points)
        if float(np.abs(twist).max()) < NEAR:
            break
    return refined_pose(arrays, basis, points, D, set_points, wanted)


def refined_pose(
    arrays: ModelArrays, basis: FloatArray, points: FloatArray, displacement: FloatArray, set_points: FloatArray,
    wanted: FloatArray, refinements: int = REFINEMENTS,
) -> GoalPose:  # fmt: skip
    """Least squares on all set-points, from a ``displacement`` (4, 4) near by; ``basis`` (k, 4, 4) of displacements."""
    D = displacement
    moved = transform_points(D, points)
    weights = np.repeat(wanted.reshape(-1), 2)
    for _ in range(refinements):
        pixels, _ = project_points(arrays.matrices, moved)
        jacobian = image_jacobian(basis, arrays.matrices, moved).reshape(-1, basis.shape[0])
        step, _ = damped_least_squares(jacobian, (set_points - pixels).reshape(-1), weights, REFINE_DAMPING)
        D = _onwards(basis, step, D)
        moved = transform_points(D, points)
        if float(np.abs(step).max()) < CONVERGED:
            break
    pixels, _ = project_points(arrays.matrices, moved)
    distance = np.where(wanted > 0.0, np.sqrt(((pixels - set_points) ** 2).sum(axis=-1)), 0.0)
    worst = int(distance.max(axis=0).argmax())
    return GoalPose(
        moved,
        D,
        float(np.sqrt((distance * distance).sum() / max(float(wanted.sum()), 1.0))),
        float(distance.max()),
        arrays.marker_ids[worst],
    )


def _onwards(basis: FloatArray, twist: FloatArray, D: FloatArray) -> FloatArray:
    onwards = np.empty((4, 4))
    multiply4_into(exp_twist((twist[:, None, None] * basis).sum(axis=0)), D, onwards)
    return onwards


MIN_FACE_AREA_PX2 = 100.0
MAX_GOAL_RESIDUAL_PX = 5.0
SINGULAR = 1e-9
"""Determinant, relative to the fourth power of its largest entry, below which a matrix is no displacement."""
COPLANAR = 1e-3
"""Affine coordinate of a basis marker in the other four below which four of the five are taken for coplanar."""
FINITE_HEIGHT = 1e-9
"""Height ``|a∞ᵀM|`` relative to ``|a∞||M|`` below which a point lies at infinity."""


@dataclass(frozen=True)
class ResolvedGoal:
    """A target in the model's frame.

    ``set_points`` (c, m, 2) ideal pixels with ``wanted`` (c, m) 1 or 0; ``points`` (m, 4) of height 1: the whole body
    at the goal, where ``pose_known``, and the ``displacement`` (4, 4) that takes it there; ``known`` (m,): markers that
    fixed it; ``face`` (3,): three that span a face.
    """

    set_points: FloatArray
    wanted: FloatArray
    points: FloatArray
    displacement: FloatArray
    known: FloatArray
    pose_known: bool
    face: IntArray


def aim_at(
    target: FeatureTarget | PointTarget | DisplacementTarget, place: BodyState, needs_pose: bool, epoch: int
) -> ResolvedGoal:
    """What ``target`` asks for. ``needs_pose``: of the law; ``epoch``: of the model in use. Raises RefusalError."""
    of_this_model(target.model_epoch, epoch)
    return _RESOLVE[type(target)](target, place, needs_pose)


def of_this_model(model_epoch: int | None, epoch: int) -> None:
    """Raises RefusalError where a goal was stated with another model than that of ``epoch``."""
    if model_epoch is not None and model_epoch != epoch:
        raise RefusalError(
            "OTHER_MODEL",
            f"the goal was taught with model epoch {model_epoch}; the cell has epoch {epoch}: teach it again",
            value=float(model_epoch), threshold=float(epoch),
        )  # fmt: skip


# -- set-points in images -------------------------------------------------------------------------------------


def _features(target: FeatureTarget, place: BodyState, needs_pose: bool) -> ResolvedGoal:
    arrays = place.arrays
    set_points, wanted = raw_set_points(target, place)
    seen_by_two = wanted.sum(axis=0) >= 2
    targets, ok = triangulate(arrays.matrices, set_points, wanted, 5)
    known = np.asarray(ok, dtype=bool) & seen_by_two
    targets = np.where(known[:, None], with_unit_height(targets, arrays.plane_at_infinity), 0.0)
    shown = int((wanted.sum(axis=0) > 0).sum())
    if shown < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"the goal shows {shown} markers; at least {MIN_MARKERS} are needed to fix a pose",
            value=float(shown), threshold=float(MIN_MARKERS), unit="markers",
        )  # fmt: skip
    face: IntArray = np.zeros(3, np.int64)
    pose_known = needs_pose or int(known.sum()) >= MIN_MARKERS
    displacement = np.zeros((4, 4))
    if pose_known:
        face = _face(set_points, wanted, known, arrays)
        pose = _body_at(place, targets, known, face, set_points, wanted)
        targets, displacement = pose.points, pose.displacement
    return ResolvedGoal(set_points, wanted, targets, displacement, known.astype(np.float64), pose_known, face)


def raw_set_points(target: FeatureTarget, place: BodyState) -> tuple[FloatArray, FloatArray]:
    """(c, m, 2) set-points as ideal pixels and (c, m) wanted, of a target in raw ones.

    Raises RefusalError on a camera, marker or pixel that cannot be.
    """
    arrays, cameras = place.arrays, place.settings.cameras
    set_points, wanted = (
        np.zeros((len(cameras), len(arrays.marker_ids), 2)),
        np.zeros((len(cameras), len(arrays.marker_ids))),
    )
    for name, markers in target.set_points.items():
        camera = camera_index(name, place.settings)
        for marker, (u, v) in markers.items():
            i = marker_index(marker, arrays)
            set_points[camera, i] = ideal_pixel(
                cameras[camera], arrays.lenses[camera], f"marker {marker}", u, v
            )
            wanted[camera, i] = 1.0
    return set_points, wanted


def ideal_pixel(
    camera: CameraSettings, lens: FloatArray, what: str, u: float, v: float
) -> tuple[float, float]:
    """Ideal pixel of the raw ``(u, v)`` of ``what``. Raises RefusalError outside the image and where none is."""
    if not (-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
        raise RefusalError(
            "OUTSIDE_IMAGE",
            f"camera {camera.name!r}, {what}: ({u}, {v}) lies outside its {camera.width}x{camera.height} image",
            subject=camera.name,
        )
    ideal = undistort_pixel(lens, u, v)
    if not isfinite(ideal[0] + ideal[1]):
        raise RefusalError(
            "OUTSIDE_IMAGE",
            f"camera {camera.name!r}, {what}: ({u}, {v}) lies where the camera's lens images nothing",
            subject=camera.name,
        )
    return ideal


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


# -- points and displacements ---------------------------------------------------------------------------------


def _points(target: PointTarget, place: BodyState, needs_pose: bool) -> ResolvedGoal:
    arrays = place.arrays
    if len(target.points) < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"the goal gives {len(target.points)} points; at least {MIN_MARKERS} that are not on one line are needed",
            value=float(len(target.points)), threshold=float(MIN_MARKERS), unit="markers",
        )  # fmt: skip
    targets = np.zeros_like(place.points)
    known = np.zeros(len(arrays.marker_ids), dtype=bool)
    for marker, coordinates in target.points.items():
        i = marker_index(marker, arrays)
        targets[i] = normalize_scale(
            np.array(coordinates), arrays, f"the point of marker {marker}", str(marker)
        )
        known[i] = True
    return _aim(place, targets, known, only_known=True)


def normalize_scale(point: FloatArray, arrays: ModelArrays, what: str, subject: str = "") -> FloatArray:
    """``point`` (4,) scaled to height 1. Raises RefusalError where it is not finite, or lies at infinity."""
    height = float((point * arrays.plane_at_infinity).sum())
    size = float(np.sqrt((point * point).sum() * (arrays.plane_at_infinity**2).sum()))
    if not isfinite(size) or not abs(height) > FINITE_HEIGHT * size:
        raise RefusalError(
            "POINT_AT_INFINITY",
            f"{what} lies at infinity, or is no point: {point.tolist()}; a finite point in the model's frame is needed",
            subject=subject, value=abs(height) / size if isfinite(size) and size > 0.0 else None,
            threshold=FINITE_HEIGHT,
        )  # fmt: skip
    scaled: FloatArray = point / height
    return scaled


def _displacement(target: DisplacementTarget, place: BodyState, needs_pose: bool) -> ResolvedGoal:
    arrays = place.arrays
    matrix = np.array(target.matrix, dtype=np.float64).reshape(4, 4)
    if target.basis is None and target.model_epoch is None:
        raise RefusalError(
            "FRAME_UNKNOWN",
            "a displacement is either in the frame of a model, give its model_epoch, or in the basis of five markers, "
            "give basis",
        )
    H = _proper(matrix)
    if target.basis is not None:
        E = _basis(target.basis, place)
        H = _product(_product(E, H), invert4(E))
    moved = transform_points(np.ascontiguousarray(H), place.points)
    heights = (moved * arrays.plane_at_infinity).sum(axis=-1)
    lowest, highest = float(np.abs(heights).min()), float(np.abs(heights).max())
    if not lowest > FINITE_HEIGHT * highest or abs(float(np.sign(heights).sum())) < heights.size:
        raise RefusalError(
            "NOT_RIGID",
            "the matrix is no displacement of the marker body: it takes a part of it through infinity; heights of the "
            f"markers go from {float(heights.min()):.3g} to {float(heights.max()):.3g}, of a displacement they agree",
            value=lowest / highest if highest > 0.0 else 0.0, threshold=1.0,
        )  # fmt: skip
    return _aim(place, moved / heights[:, None], np.ones(heights.size, dtype=bool), only_known=False)


def _proper(matrix: FloatArray) -> FloatArray:
    """``matrix`` (4, 4) with determinant 1. Raises RefusalError for NaN, singular, mirroring."""
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
            value=abs(determinant), threshold=SINGULAR,
        )  # fmt: skip
    if determinant < 0.0:
        raise RefusalError(
            "MIRRORED_GOAL",
            f"the matrix mirrors (determinant {determinant:.3g}); a displacement has a positive one",
            value=determinant, threshold=0.0,
        )  # fmt: skip
    proper: FloatArray = scaled / determinant**0.25
    return proper


def _basis(ids: tuple[int, ...], place: BodyState) -> FloatArray:
    """``E`` (4, 4) from the coordinates of five markers' basis to the model's frame (2.20, corrected)."""
    indices = [marker_index(marker, place.arrays) for marker in ids]
    if len(set(indices)) < 5:
        raise RefusalError(
            "DEGENERATE_BASIS", f"basis {list(ids)} names a marker twice; five different are needed"
        )
    M = np.ascontiguousarray(place.points[indices[:4]].T)
    middle = place.points[indices].sum(axis=0) / 5.0
    extent = float(np.sqrt(((place.points[indices] - middle) ** 2).sum(axis=-1).max()))
    volume = abs(determinant4(M)) / (extent**3 * float(np.sqrt((middle * middle).sum())))
    fifth = (
        transform_points(invert4(M), np.ascontiguousarray(place.points[indices[4:]]))[0]
        if volume > COPLANAR**2 else np.zeros(4)
    )  # fmt: skip
    least = float(np.abs(fifth).min())
    if not least > COPLANAR:
        raise RefusalError(
            "DEGENERATE_BASIS",
            f"four of the basis markers {list(ids)} lie in one plane, or nearly; choose five of which no four do, or "
            "state the displacement in the model's frame",
            value=least, threshold=COPLANAR,
        )  # fmt: skip
    E: FloatArray = M * fifth[None, :]
    return E


def _aim(place: BodyState, targets: FloatArray, known: BoolArray, *, only_known: bool) -> ResolvedGoal:
    """A body at ``targets`` (m, 4) of height 1 where ``known`` (m,): set-points by projection.

    ``only_known``: these are the markers that the error is taken over; else all that are in view.
    """
    arrays = place.arrays
    if mirrored(place.points, targets, known):
        raise RefusalError(
            "MIRRORED_GOAL",
            "the points are those of the marker body's mirror image: are left and right, or ids, swapped?",
        )
    in_front(place, targets, known)
    pixels, _ = project_points(arrays.matrices, targets)
    wanted = np.repeat(known[None, :].astype(np.float64), len(arrays.matrices), axis=0)
    set_points = np.where(wanted[..., None] > 0.0, pixels, 0.0)
    face = _face(set_points, wanted, known, arrays)
    pose = _body_at(place, targets, known, face, set_points, wanted)
    keeps_its_shape(pose.points, targets, known)
    pixels, _ = project_points(arrays.matrices, pose.points)
    shown = in_view(place, pixels) * (wanted if only_known else 1.0)
    enough_in_view(place, pixels, shown, known)
    shown = shown * turned_to(place, pose.displacement)
    enough_shown(place, shown)
    return ResolvedGoal(
        np.where(shown[..., None] > 0.0, pixels, 0.0), shown, pose.points, pose.displacement,
        known.astype(np.float64), True, face,
    )  # fmt: skip


# -- the body -------------------------------------------------------------------------------------------------


def _face(set_points: FloatArray, wanted: FloatArray, known: BoolArray, arrays: ModelArrays) -> IntArray:
    """Three markers known at the goal that span the largest triangle in the images."""
    candidates = np.flatnonzero(known)
    if candidates.size < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"{MIN_MARKERS} markers that two cameras show at the goal are needed; {candidates.size} are",
            value=float(candidates.size), threshold=float(MIN_MARKERS), unit="markers",
        )  # fmt: skip
    triples = np.array(list(combinations(candidates.tolist(), 3)), dtype=np.int64)
    a, b, c = (set_points[:, triples[:, k]] for k in range(3))
    areas = np.abs((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0])
    whole = wanted[:, triples].min(axis=-1) > 0.0
    areas = np.where(whole, areas, np.inf).min(axis=0)
    areas = np.where(whole.any(axis=0), areas, 0.0)
    best = int(areas.argmax())
    if not float(areas[best]) >= MIN_FACE_AREA_PX2:
        ids = [arrays.marker_ids[int(i)] for i in candidates]
        raise RefusalError(
            "COLLINEAR_MARKERS",
            f"the markers {ids} of the goal lie on one line; three that span a face are needed",
            value=float(areas[best]), threshold=MIN_FACE_AREA_PX2, unit="px²",
        )  # fmt: skip
    found: IntArray = triples[best]
    return found


def _body_at(
    place: BodyState, targets: FloatArray, known: BoolArray, face: IntArray,
    set_points: FloatArray, wanted: FloatArray,
) -> GoalPose:  # fmt: skip
    """The body at the goal, displaced rigidly. Raises RefusalError where no displacement fits."""
    arrays = place.arrays
    pose = goal_pose(arrays, place.operators, place.points, targets, known, face, set_points, wanted)
    if pose.worst_px <= MAX_GOAL_RESIDUAL_PX:
        return pose
    said = (
        f"marker {pose.worst_marker} is off by {pose.worst_px:.2f} px (rms {pose.rms_px:.2f} px; up to "
        f"{MAX_GOAL_RESIDUAL_PX} px is accepted)"
    )
    value = pose.worst_px if isfinite(pose.worst_px) else None
    if mirrored(place.points, targets, known):
        raise RefusalError(
            "MIRRORED_GOAL",
            f"no displacement of the marker body explains the goal, it is its mirror image: {said}",
            subject=str(pose.worst_marker), value=value, threshold=MAX_GOAL_RESIDUAL_PX, unit="px",
        )  # fmt: skip
    raise RefusalError(
        "NOT_RIGID",
        f"no displacement of the marker body explains the set-points: {said}: are ids swapped, is it another body, or "
        "is it mirrored?",
        subject=str(pose.worst_marker), value=value, threshold=MAX_GOAL_RESIDUAL_PX, unit="px",
    )  # fmt: skip


def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    product = np.empty((4, 4))
    multiply4_into(np.ascontiguousarray(A), np.ascontiguousarray(B), product)
    return product


_RESOLVE: dict[type[Any], Callable[[Any, BodyState, bool], ResolvedGoal]] = {
    FeatureTarget: _features,
    PointTarget: _points,
    DisplacementTarget: _displacement,
}
"""How a target is resolved, by its kind."""
