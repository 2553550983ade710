"""Reprojection of the set-points of running and waiting goals into relocalized cameras, so that the goals remain the
same poses of the body.

A re-anchored model keeps the frame, so what is stated in points stays true. Set-points are intersected with the cameras
they were meant for, as the pose that they all fix where they fix one, and projected with the new ones (thesis 8.6).
"""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.core.context import RefusalError
from stereoservo.core.goals.marker_body import MIN_MARKERS, BodyState
from stereoservo.core.goals.resolve import aim_at
from stereoservo.core.model_arrays import ModelArrays, with_unit_height
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import IncidenceGoal, LawRun, ServoGoal
from stereoservo.kinematics.kernels import distort_pixel, project_points, triangulate
from stereoservo.messages.goals import (
    DisplacementTarget,
    FeatureTarget,
    Goal,
    IncidenceTarget,
    Pixel,
    PointTarget,
    Target,
)
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import BoolArray, FloatArray


def carry_run(source: LawRun, place: BodyState, new: ModelArrays, moved: tuple[int, ...]) -> Reason | None:
    """Say a running goal's set-points anew in the cameras ``moved``; the reason where too few are left.

    ``place``: where the body is by the old cameras.
    """
    if isinstance(source, ServoGoal):
        source.stream = None  # what was streamed is in the old pixels; the last of it stays the goal
        points, known = source.target_points, np.ones(len(source.target_points), bool)
        if not source.pose_known:
            points, known = _intersected(source.set_points, source.wanted, place.arrays)
    elif isinstance(source, IncidenceGoal):
        points, known = _intersected(source.set_points, source.wanted, place.arrays)
    else:
        raise TypeError(f"a law of kind {type(source).__name__} has no set-points that are known")
    had = bool((source.wanted > 0.0).any())
    _say_anew(source.set_points, source.wanted, points, known, place.settings, new, moved)
    shown = int((source.wanted.max(axis=0) > 0.0).sum()) if source.wanted.size else 0
    if had and shown < MIN_MARKERS:
        return _stale(source.goal.id, shown)
    return None


def _intersected(
    set_points: FloatArray, wanted: FloatArray, arrays: ModelArrays
) -> tuple[FloatArray, BoolArray]:
    """Points (m, 4) of height 1 that two or more cameras show, and which are known (m,)."""
    found, ok = triangulate(arrays.matrices, set_points, wanted, 5)
    known = np.asarray(ok, dtype=bool) & (wanted.sum(axis=0) >= 2)
    return np.where(known[:, None], with_unit_height(found, arrays.plane_at_infinity), 0.0), known


def _say_anew(
    set_points: FloatArray, wanted: FloatArray, points: FloatArray, known: BoolArray, settings: CoreSettings,
    new: ModelArrays, moved: tuple[int, ...],
) -> None:  # fmt: skip
    """Set-points (c, m, 2) of the cameras ``moved``; what their new images do not show is not wanted there any more."""
    pixels, depths = project_points(new.matrices, np.ascontiguousarray(points))
    for c in moved:
        side = np.sign(depths[c][known]).sum()
        for i in range(points.shape[0]):
            inside = (
                known[i]
                and depths[c, i] * side > 0.0
                and _raw_in_view(settings, new, c, pixels[c, i]) is not None
            )
            wanted[c, i] = wanted[c, i] if inside else 0.0
            set_points[c, i] = pixels[c, i] if wanted[c, i] > 0.0 else 0.0


def _raw_in_view(settings: CoreSettings, arrays: ModelArrays, camera: int, pixel: FloatArray) -> Pixel | None:
    """The raw pixel of an ideal one, None where the image does not show it."""
    u, v = distort_pixel(arrays.lenses[camera], float(pixel[0]), float(pixel[1]))
    shape = settings.cameras[camera]
    return (u, v) if -0.5 <= u <= shape.width - 0.5 and -0.5 <= v <= shape.height - 0.5 else None


def _stale(goal_id: str, shown: int) -> Reason:
    return Reason(
        "SET_POINTS_STALE", "hold", goal_id, float(shown), float(MIN_MARKERS), "markers",
        "a camera was moved, and the goal cannot be said in its new pixels: fewer of its markers are shown by two "
        "cameras, or come into the new image, than are needed. State it again from the pictures of now",
    )  # fmt: skip


def carry_goal(
    goal: Goal, place: BodyState, new: ModelArrays, moved: tuple[int, ...], epochs: tuple[int, int]
) -> Goal | Reason:
    """A goal that waits, said for the new cameras, or the reason why it cannot be. ``epochs``: the old and the new."""
    centre = goal.centre
    if centre is not None and centre.model_epoch == epochs[0]:
        centre = msgspec.structs.replace(centre, model_epoch=epochs[1])
    try:
        target = _target(goal.target, place, new, moved, epochs)
    except RefusalError as refusal:
        return Reason("SET_POINTS_STALE", "hold", goal.id, hint=f"a camera was moved, and {refusal}")
    if target is None:
        return _stale(goal.id, 0)
    return msgspec.structs.replace(goal, target=target, centre=centre)


def _target(
    target: Target, place: BodyState, new: ModelArrays, moved: tuple[int, ...], epochs: tuple[int, int]
) -> Target | None:
    if isinstance(target, FeatureTarget):
        return _features(target, place, new, moved, epochs)
    if isinstance(target, PointTarget | DisplacementTarget) and target.model_epoch == epochs[0]:
        return msgspec.structs.replace(target, model_epoch=epochs[1])
    if isinstance(target, IncidenceTarget):
        return _incidences(target, place, new, moved, epochs)
    return target


def _features(
    target: FeatureTarget, place: BodyState, new: ModelArrays, moved: tuple[int, ...], epochs: tuple[int, int]
) -> FeatureTarget | None:
    names = [place.settings.cameras[c].name for c in moved]
    epoch = epochs[1] if target.model_epoch == epochs[0] else target.model_epoch
    if not set(names) & set(target.set_points):
        return msgspec.structs.replace(target, model_epoch=epoch)
    aim = aim_at(target, place, True, epochs[0])
    pixels, _ = project_points(new.matrices, np.ascontiguousarray(aim.points))
    said = dict(target.set_points)
    for c, name in zip(moved, names, strict=True):
        anew = {
            marker: _raw_in_view(place.settings, new, c, pixels[c, new.index[marker]])
            for marker in target.set_points.get(name, {})
        }
        said[name] = {marker: pixel for marker, pixel in anew.items() if pixel is not None}
    said = {name: markers for name, markers in said.items() if markers}
    if len({marker for markers in said.values() for marker in markers}) < MIN_MARKERS:
        return None
    return FeatureTarget(said, epoch)


def _incidences(
    target: IncidenceTarget,
    place: BodyState,
    new: ModelArrays,
    moved: tuple[int, ...],
    epochs: tuple[int, int],
) -> IncidenceTarget | None:
    names = {place.settings.cameras[c].name for c in moved}
    features = [feature for spec in target.incidences for feature in (spec.moving, spec.fixed)]
    if any(names & set(feature.pixels) for feature in features):
        return None  # pixels of a scene: told again they would be those of another moment
    secondary = target.secondary
    if isinstance(secondary, FeatureTarget):
        secondary = _features(secondary, place, new, moved, epochs)
        if secondary is None:
            return None
    epoch = epochs[1] if target.model_epoch == epochs[0] else target.model_epoch
    return msgspec.structs.replace(target, secondary=secondary, model_epoch=epoch)
