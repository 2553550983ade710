"""Resolves a goal's target in the model's frame into set-points, body pose at the goal, centre and options, and
creates the initial state of its control law. Refuses invalid targets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from stereoservo.control.face_choice import NOT_CHOSEN, spread_in_images
from stereoservo.control.law import JacobianChoice
from stereoservo.control.law_registry import LAWS
from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.goals.marker_body import (
    MIN_MARKERS,
    BodyState,
    body_at,
    determinant4,
    enough_in_view,
    enough_shown,
    in_front,
    keeps_its_shape,
    mirrored,
    turned_to,
    view_of,
)
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.prediction import chain_at
from stereoservo.core.settings import CameraSettings, CoreSettings
from stereoservo.core.state import ServoGoal
from stereoservo.kinematics.kernels import (
    invert4,
    multiply4_into,
    transform_points,
    triangulate,
    undistort_pixel,
)
from stereoservo.messages.goals import (
    AdaptiveGain,
    Centre,
    DisplacementTarget,
    FeatureTarget,
    Goal,
    JacobianName,
    Pixel,
    PlanReport,
    PointTarget,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import kernel

JACOBIANS: dict[JacobianName, JacobianChoice] = {
    "current": JacobianChoice.CURRENT,
    "desired": JacobianChoice.DESIRED,
    "mean": JacobianChoice.MEAN,
    "fixed-depth": JacobianChoice.FIXED_DEPTH,
}
MIN_FACE_AREA_PX2 = 100.0
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
    targets, known = _intersected(arrays.matrices, set_points, wanted, arrays.plane_at_infinity)
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
        pose = body_at(place, targets, known, face, set_points, wanted)
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
        shape = cameras[camera]
        given = np.array(tuple(markers.values()), dtype=np.float64).reshape(-1, 2)
        ideal = ideal_pixels(arrays.lenses[camera], given)
        rows = [marker_index(marker, arrays) for marker in markers]
        set_points[camera, rows], wanted[camera, rows] = ideal, 1.0
        inside = (given >= -0.5) & (given <= np.array((shape.width, shape.height)) - 0.5) & np.isfinite(ideal)
        for k in np.flatnonzero(~inside.all(axis=1)):
            marker = tuple(markers)[k]
            require_imaged(shape, f"marker {marker}", markers[marker], ideal[k])
    return set_points, wanted


@kernel
def ideal_pixels(lens: FloatArray, raw: FloatArray) -> FloatArray:
    """Ideal pixels (k, 2) of ``raw`` (k, 2); NaN where the lens images nothing."""
    ideal = np.empty(raw.shape)
    for i in range(raw.shape[0]):
        ideal[i, 0], ideal[i, 1] = undistort_pixel(lens, raw[i, 0], raw[i, 1])
    return ideal


def require_imaged(camera: CameraSettings, what: str, raw: Pixel, ideal: FloatArray) -> None:
    """Raises RefusalError where the ``raw`` pixel of ``what`` is outside the image, or ``ideal`` (2,) is NaN."""
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
    matrices: FloatArray, set_points: FloatArray, wanted: FloatArray, plane: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Points (m, 4) of height 1 that two or more cameras show, else zeros; and which are known (m,).

    ``plane`` (4,): at infinity.
    """
    points, known = triangulate(matrices, set_points, wanted, 5)
    for i in range(points.shape[0]):
        views = 0.0
        for c in range(matrices.shape[0]):
            views += wanted[c, i]
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
    pixels, _ = view_of(place, targets)
    wanted = np.repeat(known[None, :].astype(np.float64), len(arrays.matrices), axis=0)
    set_points = np.where(wanted[..., None] > 0.0, pixels, 0.0)
    face = _face(set_points, wanted, known, arrays)
    pose = body_at(place, targets, known, face, set_points, wanted)
    keeps_its_shape(pose.points, targets, known)
    pixels, shown = view_of(place, pose.points)
    shown = shown * (wanted if only_known else 1.0)
    enough_in_view(place, pixels, shown, known)
    shown = shown * turned_to(place, pose.displacement)
    enough_shown(place, shown)
    return ResolvedGoal(
        np.where(shown[..., None] > 0.0, pixels, 0.0), shown, pose.points, pose.displacement,
        known.astype(np.float64), True, face,
    )  # fmt: skip


# -- the face -------------------------------------------------------------------------------------------------


def _face(set_points: FloatArray, wanted: FloatArray, known: BoolArray, arrays: ModelArrays) -> IntArray:
    """Three markers known at the goal that span the largest triangle in the images: of many, of those spread out."""
    candidates = np.flatnonzero(known)
    if candidates.size < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"{MIN_MARKERS} markers that two cameras show at the goal are needed; {candidates.size} are",
            value=float(candidates.size), threshold=float(MIN_MARKERS), unit="markers",
        )  # fmt: skip
    found: IntArray
    found, area = _largest_triangle(candidates, set_points, wanted)
    if not area >= MIN_FACE_AREA_PX2:
        ids = [arrays.marker_ids[int(i)] for i in candidates]
        raise RefusalError(
            "COLLINEAR_MARKERS",
            f"the markers {ids} of the goal lie on one line; three that span a face are needed",
            value=float(area), threshold=MIN_FACE_AREA_PX2, unit="px²",
        )  # fmt: skip
    return found


@kernel
def _largest_triangle(
    candidates: IntArray, set_points: FloatArray, wanted: FloatArray
) -> tuple[IntArray, float]:
    """Three of the ``candidates`` (k,) of the largest area, and twice that [px²]: the least of the cameras that see all
    three.
    """
    tried = spread_in_images(candidates, set_points, wanted)
    best = tried[:3].copy()
    largest = -1.0
    for a in range(tried.shape[0]):
        for b in range(a + 1, tried.shape[0]):
            for c in range(b + 1, tried.shape[0]):
                i, j, k = tried[a], tried[b], tried[c]
                least = math.inf
                for camera in range(wanted.shape[0]):
                    if min(wanted[camera, i], wanted[camera, j], wanted[camera, k]) > 0.0:
                        p = set_points[camera]
                        ux, uy = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
                        vx, vy = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1]
                        least = min(least, abs(ux * vy - uy * vx))
                area = least if least < math.inf else 0.0
                if area > largest:
                    largest = area
                    best[0], best[1], best[2] = i, j, k
    return best, largest


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


# -- the law's first state ------------------------------------------------------------------------------------


def start_servoing(
    goal: Goal,
    target: FeatureTarget | PointTarget | DisplacementTarget,
    context: StepContext,
    place: BodyState,
) -> ServoGoal:
    """The state of a law before its first step, for a body that sets out from ``place``.

    Raises RefusalError naming what makes the goal unusable.
    """
    settings, model = context.settings, context.state.model
    assert model is not None
    name = goal.law or settings.law
    law = context.derived.laws.get(name)
    if law is None:
        raise RefusalError("NO_SUCH_LAW", str(LAWS.unknown(name)), subject=name)
    aim = aim_at(target, place, law.needs_goal_pose, model.epoch)
    weights, body, centre_target = _centre(goal.centre, aim, place, context, model.epoch)
    return ServoGoal(
        **run_fields(goal, context, used_cameras(goal, aim.wanted, context)),
        law=name,
        jacobian=int(JACOBIANS[goal.jacobian or "mean"]),
        set_points=aim.set_points,
        wanted=aim.wanted,
        rates=np.zeros_like(aim.set_points),
        target_points=aim.points,
        target_known=aim.known,
        pose_known=aim.pose_known,
        centre_weights=weights,
        centre_body=body,
        centre_target=centre_target,
        faces=place.faces,
        choice=NOT_CHOSEN._replace(triple=aim.face),
    )


def run_fields(goal: Goal, context: StepContext, used: FloatArray) -> dict[str, Any]:
    """Fields of a `LawRun` before its first step: what the goal says, or else the cell."""
    settings = context.settings
    gain = goal.gain or settings.gain
    near, far, slope = (
        (gain.near, gain.far, gain.slope) if isinstance(gain, AdaptiveGain) else (gain, gain, 1.0)
    )
    return {
        "goal": goal,
        "points": goal.points or settings.points,
        "gain_near": near,
        "gain_far": far,
        "gain_slope": slope,
        "tolerance_px": goal.tolerance_px or settings.tolerance_px,
        "hold_frames": goal.hold_frames or settings.hold_frames,
        "time_limit_s": goal.time_limit_s or settings.time_limit_s,
        "started_ns": context.now_ns,
        "lease_s": goal.lease_s,
        "lease_until_ns": context.now_ns + int((goal.lease_s or 0.0) * 1e9),
        "used": used,
        "last_frames": sum(e.frames for e in context.state.cameras),
    }


def used_cameras(goal: Goal, wanted: FloatArray, context: StepContext) -> FloatArray:
    """(c,) 1 for cameras that the law may use. Raises RefusalError where they show too few ``wanted`` (c, m)."""
    c = len(context.settings.cameras)
    if goal.cameras is None:
        return np.ones(c)
    used = np.zeros(c)
    for name in goal.cameras:
        used[camera_index(name, context.settings)] = 1.0
    shown = int((wanted * used[:, None]).max(axis=0).sum())
    if shown < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"cameras {', '.join(goal.cameras) or '(none)'} show {shown} markers of the goal; at least {MIN_MARKERS} "
            "are needed",
            value=float(shown), threshold=float(MIN_MARKERS), unit="markers",
        )  # fmt: skip
    return used


def _centre(
    centre: Centre | None, aim: ResolvedGoal, place: BodyState, context: StepContext, epoch: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A goal's centre: affine weights (m,) of the markers, or (weights zero) a point (4,) of the body; at the goal.

    The point is stated in the chain's zero. Default: the affine middle of the goal's markers.
    """
    arrays = place.arrays
    weights = np.zeros(len(arrays.marker_ids))
    body = np.zeros(4)
    if centre is None:
        weights = aim.known / max(float(aim.known.sum()), 1.0)
    elif bool(centre.markers) == (centre.point is not None):
        raise RefusalError(
            "CENTRE_UNCLEAR", "the centre is given either by markers or as a point, not by both or none"
        )
    elif centre.point is not None:
        if centre.model_epoch is None:
            raise RefusalError(
                "FRAME_UNKNOWN", "a point as centre needs the model_epoch in whose frame it is"
            )
        of_this_model(centre.model_epoch, epoch)
        now = normalize_scale(np.array(centre.point), arrays, "the centre")[None]
        H = chain_at(arrays, context.q + context.state.correction)[0]
        body = transform_points(invert4(H), now)[0]
        return weights, body, transform_points(aim.displacement, now)[0]
    else:
        for marker in centre.markers:
            weights[marker_index(marker, arrays)] = 1.0
        weights = weights / float(weights.sum())
    return weights, body, (weights[:, None] * aim.points).sum(axis=0)


def unplanned_report(source: ServoGoal, context: StepContext) -> PlanReport:
    """The report of a goal whose pose, and so its path, is not known beforehand."""
    return no_plan(
        source.law, "the pose at the goal is not known: fewer than three of its markers are shown by two cameras",
        source.time_limit_s,
    )  # fmt: skip


def no_plan(law: str, why: str, seconds: float) -> PlanReport:
    """A report without a plan: ``why`` there is none; it takes ``seconds`` at most."""
    return PlanReport(
        law=law, way=f"not planned: {why}", seconds=seconds, approaches=(), shares=(), joints={}, pixels={}
    )
