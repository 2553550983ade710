"""A law as a motion source: from a goal's set-points to a joint velocity, until the error holds below its tolerance."""

from __future__ import annotations

from itertools import combinations
from math import isfinite

import numpy as np

from stereoservo.control.cartesian3 import cartesian3_reasons
from stereoservo.control.kernels import cartesian3_step, stereo_step
from stereoservo.control.reasons import Reason
from stereoservo.kinematics.kernels import image_jacobian, transform_points, triangulate
from stereoservo.kinematics.lens_kernel import undistort_pixel
from stereoservo.runtime.commands import FeatureTarget, Goal
from stereoservo.runtime.estimate import ModelArrays, chain_at, points_now, with_unit_height
from stereoservo.runtime.goal_pose import goal_pose
from stereoservo.runtime.motion import Motion, Present
from stereoservo.runtime.ports import FloatArray, IntArray
from stereoservo.runtime.state import Servoing

MIN_MARKERS = 3
MIN_FACE_AREA_PX2 = 100.0
MAX_GOAL_RESIDUAL_PX = 5.0
STEREO_DAMPING = 1e-6  # relative to the largest diagonal of the normal matrix
ILL_CONDITIONED = 1e-5


def start_servoing(goal: Goal, target: FeatureTarget, present: Present) -> Servoing:
    """The state of a law before its first step. Raises ValueError naming what makes the goal unusable."""
    arrays = present.arrays
    if arrays is None:
        raise ValueError("no model")
    settings = present.settings
    set_points, wanted = _set_points(target, present, arrays)
    law = goal.law or settings.law
    seen_by_all = wanted.sum(axis=0) >= 2
    target_points, ok = triangulate(arrays.matrices, set_points, wanted, 5)
    known = np.asarray(ok, dtype=bool) & seen_by_all
    target_points = np.where(known[:, None], with_unit_height(target_points, arrays.plane_at_infinity), 0.0)
    shown = int((wanted.sum(axis=0) > 0).sum())
    if shown < MIN_MARKERS:
        raise ValueError(f"the goal shows {shown} markers; at least {MIN_MARKERS} are needed to fix a pose")
    face: IntArray = np.zeros(3, np.int64)
    centre = np.zeros(4)
    pose_known = law == "cartesian3" or int(known.sum()) >= MIN_MARKERS
    if pose_known:
        face = _face(set_points, known, arrays)
        target_points = _goal_points(present, arrays, target_points, known, face, set_points, wanted)
        centre = target_points[known].sum(axis=0) / float(known.sum())
    source = Servoing(
        goal=goal,
        law=law,
        points=goal.points or settings.points,
        gain=goal.gain or settings.gain,
        tolerance_px=goal.tolerance_px or settings.tolerance_px,
        hold_frames=goal.hold_frames or settings.hold_frames,
        time_limit_s=goal.time_limit_s or settings.time_limit_s,
        started_ns=present.now_ns,
        lease_s=goal.lease_s,
        lease_until_ns=0,
        set_points=set_points,
        wanted=wanted,
        target_points=target_points,
        target_known=known.astype(np.float64),
        pose_known=pose_known,
        centre_target=centre,
        face=face,
        last_frames=sum(e.frames for e in present.state.cameras),
    )
    source.renew_lease(present.now_ns)
    return source


def _set_points(
    target: FeatureTarget, present: Present, arrays: ModelArrays
) -> tuple[FloatArray, FloatArray]:
    """(c, m, 2) set-points as ideal pixels and (c, m) wanted, of a target in raw ones.

    Raises ValueError on a camera, marker or pixel that cannot be.
    """
    settings = present.settings
    c, m = len(settings.cameras), len(arrays.marker_ids)
    names = [camera.name for camera in settings.cameras]
    set_points, wanted = np.zeros((c, m, 2)), np.zeros((c, m))
    for name, markers in target.set_points.items():
        if name not in names:
            raise ValueError(f"no camera {name!r}; cameras: {', '.join(names)}")
        camera = names.index(name)
        size = settings.cameras[camera]
        for marker, (u, v) in markers.items():
            i = arrays.index.get(marker)
            if i is None:
                known = ", ".join(str(k) for k in arrays.marker_ids)
                raise ValueError(f"marker {marker} is not in the model; its markers: {known}")
            if not (-0.5 <= u <= size.width - 0.5 and -0.5 <= v <= size.height - 0.5):
                raise ValueError(
                    f"camera {name!r}, marker {marker}: ({u}, {v}) lies outside its {size.width}x{size.height} image"
                )
            ideal = (
                undistort_pixel(arrays.lenses[camera], u, v) if arrays.lenses[camera, 0] != 0.0 else (u, v)
            )
            if not isfinite(ideal[0] + ideal[1]):
                raise ValueError(
                    f"camera {name!r}, marker {marker}: ({u}, {v}) lies where the camera's lens images nothing"
                )
            set_points[camera, i] = ideal
            wanted[camera, i] = 1.0
    return set_points, wanted


def _face(set_points: FloatArray, known: FloatArray, arrays: ModelArrays) -> IntArray:
    """Three markers known at the goal that span the largest triangle in the images."""
    candidates = np.flatnonzero(known)
    if candidates.size < 3:
        raise ValueError(
            f"{MIN_MARKERS} markers that two cameras show at the goal are needed; {candidates.size} are"
        )
    triples = np.array(list(combinations(candidates.tolist(), 3)), dtype=np.int64)
    a, b, c = (set_points[:, triples[:, k]] for k in range(3))
    areas = np.abs((b - a)[..., 0] * (c - a)[..., 1] - (b - a)[..., 1] * (c - a)[..., 0]).min(axis=0)
    best = int(areas.argmax())
    if float(areas[best]) < MIN_FACE_AREA_PX2:
        ids = [arrays.marker_ids[int(i)] for i in candidates]
        raise ValueError(f"the markers {ids} of the goal lie on one line; three that span a face are needed")
    found: IntArray = triples[best]
    return found


def _goal_points(
    present: Present, arrays: ModelArrays, targets: FloatArray, known: FloatArray, face: IntArray,
    set_points: FloatArray, wanted: FloatArray,
) -> FloatArray:  # fmt: skip
    """The goal's pose as marker points. Raises ValueError where no displacement of the body explains the set-points."""
    prediction = present.prediction
    assert prediction is not None
    points = transform_points(chain_at(arrays, present.q)[0], arrays.marker_points)
    pose = goal_pose(arrays, prediction.operators, points, targets, known, face, set_points, wanted)
    if not pose.worst_px <= MAX_GOAL_RESIDUAL_PX:
        raise ValueError(
            f"no displacement of the marker body explains the set-points: marker {pose.worst_marker} is off by "
            f"{pose.worst_px:.2f} px (rms {pose.rms_px:.2f} px; up to {MAX_GOAL_RESIDUAL_PX} px is accepted): are ids "
            "swapped, is it another body, or is it mirrored?"
        )
    return pose.points


def servo_step(source: Servoing, present: Present) -> Motion:
    """One step of a law: error, joint velocity, and whether the goal is reached or out of time."""
    arrays, prediction, weights, pixels = present.arrays, present.prediction, present.weights, present.pixels
    if arrays is None or prediction is None or weights is None or pixels is None:
        raise AssertionError("a law runs only with a model")
    zero = np.zeros_like(present.q)
    source.moved_s += present.dt_s
    active = weights * source.wanted
    visible = int((active > 0.0).sum())
    distance = np.sqrt(((pixels - source.set_points) ** 2).sum(axis=-1))
    error_px = float(np.where(active > 0.0, distance, 0.0).max()) if visible else None
    if source.moved_s > source.time_limit_s:
        reason = Reason(
            "TIME_LIMIT", "hold", "", source.moved_s, source.time_limit_s, "s",
            "no error was measured" if error_px is None
            else f"the error is still {error_px:.3f} px (tolerance {source.tolerance_px} px)",
        )  # fmt: skip
        present.emit(
            "goal_aborted",
            id=source.goal.id,
            message="not reached in time",
            reasons=(reason,),
            error_px=error_px,
        )
        return Motion(zero, finished=True, error_px=error_px)
    if int((active.max(axis=0) > 0.0).sum()) < MIN_MARKERS:
        reason = Reason(
            "TOO_FEW_MARKERS", "hold", "", float((active.max(axis=0) > 0.0).sum()), float(MIN_MARKERS), "markers",
            "bring the goal's markers back into view",
        )  # fmt: skip
        return Motion(zero, needs_features=True, error_px=error_px, reasons=(reason,))
    if _reached(source, present, error_px):
        present.emit("goal_reached", id=source.goal.id, message=f"error {error_px:.4f} px", error_px=error_px)
        return Motion(zero, finished=True, error_px=error_px)
    if source.law == "stereo":
        return _stereo(source, present, arrays, active, error_px)
    return _cartesian3(source, present, arrays, error_px)


def _reached(source: Servoing, present: Present, error_px: float | None) -> bool:
    """Whether the error stayed below the tolerance for ``hold_frames`` frames of every camera on average."""
    frames = sum(e.frames for e in present.state.cameras)
    new, cameras = frames - source.last_frames, len(present.state.cameras)
    if new >= cameras:
        source.last_frames = frames
        inside = error_px is not None and error_px <= source.tolerance_px
        source.held = source.held + new // cameras if inside else 0
    return source.held >= source.hold_frames


def _stereo(
    source: Servoing, present: Present, arrays: ModelArrays, active: FloatArray, error_px: float | None
) -> Motion:
    """(8.36) with the Jacobian developed around triangulated (8.34) or predicted points (8.35).

    Where the goal's pose is known it is the mean of the current and the desired Jacobian (8.1.1), which converges from
    much farther than either.
    """
    prediction, pixels = present.prediction, present.pixels
    assert prediction is not None
    assert pixels is not None
    points = _points(source, present, arrays)
    jacobian = image_jacobian(prediction.operators, arrays.matrices, points)
    if source.pose_known:
        jacobian = 0.5 * (
            jacobian + image_jacobian(prediction.operators, arrays.matrices, source.target_points)
        )
    velocity, _, conditioning = stereo_step(
        jacobian, pixels, source.set_points, active, source.gain, STEREO_DAMPING
    )
    reasons: tuple[Reason, ...] = ()
    if conditioning < ILL_CONDITIONED:
        reasons = (
            Reason(
                "JACOBIAN_ILL_CONDITIONED", "slow", "", conditioning, ILL_CONDITIONED, "",
                "the arm is near a singularity, or the markers do not fix its pose: jog away, or use cartesian3",
            ),
        )  # fmt: skip
    return Motion(velocity, True, source.goal.speed_scale, error_px=error_px, reasons=reasons)


def _points(source: Servoing, present: Present, arrays: ModelArrays) -> FloatArray:
    assert present.prediction is not None
    assert present.pixels is not None
    assert present.weights is not None
    return points_now(
        arrays,
        present.q,
        present.prediction,
        present.pixels,
        present.weights,
        present.state.correction,
        source.points,
    )


def _cartesian3(source: Servoing, present: Present, arrays: ModelArrays, error_px: float | None) -> Motion:
    """(8.42) from three points that span the goal's face, about the affine middle of the goal's markers."""
    prediction = present.prediction
    assert prediction is not None
    points = _points(source, present, arrays)
    known = source.target_known > 0.0
    centre = points[known].sum(axis=0) / float(known.sum())
    velocity, task_error, allowed, status = cartesian3_step(
        prediction.operators, points[source.face], source.target_points[source.face], centre, source.centre_target,
        arrays.camera_centres, np.full(3, source.gain),
    )  # fmt: skip
    reasons = cartesian3_reasons(task_error, allowed, status)
    return Motion(
        velocity, True, source.goal.speed_scale, error_px=error_px, task_error=task_error, reasons=reasons
    )
