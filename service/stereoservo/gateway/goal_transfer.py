"""Set-points of taught goals, reprojected for a moved workpiece, other cameras or a remounted marker body (thesis 8.6);
and steps in a person's frames as displacements.

A goal stores the pixels of the moving body (or of a tool on it), of the workpiece, and the cameras that saw them. The
``common`` markers, which are static relative to the goal, determine the map from the frame of teaching to the current
one (`geometry.alignment`); the goal's points are mapped by it and projected again. Nothing here blocks or moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from stereoservo.daemon.taught_goals import TaughtGoal, TaughtModel
from stereoservo.gateway.marker_views import (
    MarkerViews,
    model_frame,
    observed_views,
    taught_frame,
    taught_views,
)
from stereoservo.gateway.observation_cache import MarkerObservations
from stereoservo.gateway.point_alignment import (
    DEVIATIONS,
    MIN_MARKERS,
    RESIDUAL_PX,
    TransferError,
    align_features,
    align_points,
    reproject_set_points,
    require_still,
)
from stereoservo.gateway.validation import listed
from stereoservo.geometry.alignment import POINTS_NEEDED, AlignmentFrame, family_between
from stereoservo.geometry.cameras import project_many
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.moved_cameras import FrameChange, carried_point_covariance
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.denavit_hartenberg import ReadOutError
from stereoservo.kinematics.metric_frames import metric_frame, rotation, scale_length
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import Centre, DisplacementTarget, FeatureTarget, StepTarget, TaughtTarget
from stereoservo.numerics.arrays import FloatArray

MOUNTED_PX = 5.0
"""Tolerance within which goal and kinematics agree if only cameras changed; otherwise the body was remounted."""


@dataclass(frozen=True)
class TransferredGoal:
    """Set-points for the model in use, or a step in its frame, with a description of their origin and accuracy."""

    target: FeatureTarget | DisplacementTarget
    note: str


def resolve(
    requested: TaughtTarget, goal: TaughtGoal, model: CellModel | None, observations: MarkerObservations
) -> TransferredGoal:
    """Set-points of a taught goal for the current model and cameras. Raises TransferError."""
    if requested.relative_to is None and not goal.tool:
        return _recorded_pixels(goal, model)
    if model is None:
        raise TransferError("the cell has no model yet: calibrate first")
    if goal.model is None:
        raise TransferError(
            f"{requested.name!r} was taught by an earlier version, and the model of its epoch "
            f"{goal.target.model_epoch} is gone: teach it again"
        )
    same = goal.model.epoch == model.epoch
    if model.mount == "eye_in_hand":
        return _relative_to_cameras(requested, goal, model, observations, same)
    old, new = taught_frame(goal.model), model_frame(model)
    taught = taught_views(goal)
    if requested.relative_to is None:
        if not same:
            raise TransferError(
                f"{requested.name!r} was taught with model epoch {goal.model.epoch}, the cell has {model.epoch}: send "
                'it relative to the "workpiece", or to the "cameras"'
            )
        change, origin = _identity_change(), "where it was taught"
    else:
        change, origin = _common_change(requested, goal, taught, old, new, model, observations, same)
    points, covariance, names = _points_when_taught(goal, taught, old, new, model, observations, same)
    moved = move_points(change.H, points)
    set_points, _, note = reproject_set_points(
        model, names, moved, carried_point_covariance(change, points, covariance), "carried over"
    )
    if requested.relative_to == "cameras" and not goal.tool:
        _require_same_mounting(goal, model, names, moved)
    elif not goal.tool and not same:
        note += f"; this holds if the marker body has not been remounted since model epoch {goal.model.epoch}"
    return TransferredGoal(FeatureTarget(set_points, model.epoch), f"{origin}; {note}")


def resolve_step(
    step: StepTarget, centre: Centre | None, model: CellModel | None, observations: MarkerObservations, length: str
) -> TransferredGoal:
    """A step as a rigid displacement in the frame that it names, scaled by its own length, else the cell's ``length``.

    ``centre``: of the goal; a turn is made about it. Raises TransferError.
    """
    if model is None:
        raise TransferError("the cell has no model yet: calibrate first")
    ids = () if centre is None else centre.markers
    if any(step.turn) and centre is not None and centre.point is not None:
        raise TransferError("a turn is made about the middle of markers: give the centre by markers, not by a point")
    matrix = np.eye(4) if step.matrix is None else np.array(step.matrix).reshape(4, 4)
    if step.matrix is None:
        matrix[:3, :3] = rotation(np.array(step.turn))
        matrix[:3, 3] = step.move
    scene = None
    if step.frame.startswith("scene:"):
        scene = _scene_points([int(marker) for marker in step.frame[6:].split("-")], model, observations)
    text = step.length or length
    try:
        known = scale_length(model, text) if text or matrix[:3, 3].any() else None
        frame = metric_frame(model, step.frame, known, scene, ids)
    except (ReadOutError, GeometryError) as error:
        raise TransferError(str(error)) from error
    if step.matrix is not None:  # in the frame's own coordinates
        frame = msgspec.structs.replace(frame, pivot=(0.0, 0.0, 0.0), pivot_with_body=frame.with_body)
    scaled = "" if known is None else f", scaled by {known.what} of {listed(known.of)}, {known.metres:g} m"
    target = DisplacementTarget(tuple(matrix.ravel().tolist()), model.epoch, frame=frame)
    return TransferredGoal(target, f"a step in {step.frame}{scaled}")


def _scene_points(markers: list[int], model: CellModel, observations: MarkerObservations) -> FloatArray:
    """Points (3, 4) in the model's frame of ``markers`` that do not move with the arm. Raises TransferError."""
    if model.mount == "eye_in_hand":
        raise TransferError("the cameras ride on the arm: tool, base and camera:NAME are valid frames there")
    require_still(observations, markers, "markers")
    points, _ = observed_views(observations, model, markers).points()
    unknown = [marker for marker, point in zip(markers, points, strict=True) if not np.isfinite(point).all()]
    if unknown:
        seen = {marker for shown in observations.values() for marker in shown} - set(model.marker_ids)
        raise TransferError(
            f"markers {listed(unknown)} of the scene are not seen by two cameras now; beside the body are seen: "
            f"{listed(sorted(seen))}"
        )
    return points


def _recorded_pixels(goal: TaughtGoal, model: CellModel | None) -> TransferredGoal:
    """The recorded pixels; those of cameras that were relocalized since are reprojected into the current images.

    Relocalization keeps the frame, bit for bit: the goal's points are still those triangulated with the cameras of
    teaching. Mobile cameras are re-estimated within one epoch.
    """
    taught = goal.model
    if model is None or taught is None or not _same_frame(taught, model):
        return TransferredGoal(goal.target, "")
    then = {camera.name: (camera.matrix, camera.lens) for camera in taught.cameras}
    moved = [
        camera.name
        for camera in model.cameras
        if then.get(camera.name) != (tuple(camera.matrix.ravel().tolist()), tuple(camera.lens.tolist()))
    ]
    kept_pixels = {name: pixels for name, pixels in goal.target.set_points.items() if name not in moved}
    if not moved:  # e.g. other joint zeros: the core checks whether the goal is valid
        return TransferredGoal(goal.target, "")
    if not set(moved) & set(goal.target.set_points):
        return TransferredGoal(FeatureTarget(kept_pixels, model.epoch), "")
    views = taught_views(goal)
    names = [marker for marker in views.ids if marker in model.marker_ids]
    points, covariance = views.subset(names).points()
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(known) < MIN_MARKERS:
        raise TransferError(
            f"camera {listed(moved)} was moved since it was taught, and {len(known)} of its markers "
            f"({listed(names[k] for k in known)}) are known from two cameras; 3 or more are needed: teach it again"
        )
    reprojected_pixels, _, note = reproject_set_points(
        model,
        [names[k] for k in known],
        points[known],
        covariance[known],
        "in the pixels of the camera as it stands now",
    )
    kept_pixels |= {
        name: reprojected_pixels[name]
        for name in moved
        if name in goal.target.set_points and name in reprojected_pixels
    }
    return TransferredGoal(
        FeatureTarget(kept_pixels, model.epoch),
        f"camera {listed(moved)} was moved since it was taught; {note}",
    )


def _same_frame(taught: TaughtModel, model: CellModel) -> bool:
    """Whether one model is a relocalization of the other: the parts that fix the frame are bitwise equal."""
    upgrade = model.projective_to_euclidean
    return (
        taught.stratum == model.stratum
        and taught.plane_at_infinity == tuple(model.plane_at_infinity.tolist())
        and taught.projective_to_euclidean == (None if upgrade is None else tuple(upgrade.ravel().tolist()))
    )


def _identity_change() -> FrameChange:
    return FrameChange(np.eye(4), np.zeros((16, 16)), (), 0.0, 0)


def _common_change(
    requested: TaughtTarget,
    goal: TaughtGoal,
    taught: MarkerViews,
    old: AlignmentFrame,
    new: AlignmentFrame,
    model: CellModel,
    observations: MarkerObservations,
    same: bool,
) -> tuple[FrameChange, str]:
    """Map of the common features since the goal was taught, and a sentence on its evidence."""
    if requested.lines or requested.planes:
        family = family_between(old, new, same)
        return align_features(requested, family, old, new, taught, observations, model)
    common = _common(requested, goal, model, observations)
    before, now = taught.subset(common), observed_views(observations, model, common)
    require_still(observations, common, "the common markers")
    if requested.relative_to == "cameras" and same:
        away = np.sqrt(((now.pixels - before.pixels) ** 2).sum(axis=-1))
        if np.nanmax(away, initial=0.0) > RESIDUAL_PX + DEVIATIONS * float(np.nanmax(now.sigmas, initial=0.0)):
            worst = common[int(np.nanargmax(np.where(np.isfinite(away), away, -1.0).max(axis=0)))]
            raise TransferError(
                f"marker {worst} stands {np.nanmax(away):.1f} px from where it was taught, but the cameras' model is "
                f"still that of epoch {model.epoch}: calibrate with the cameras as they are now, then send it again"
            )
    family = family_between(old, new, same)
    return align_points(family, old, new, *before.points(), now, common, f"relative to the {requested.relative_to}")


def _common(requested: TaughtTarget, goal: TaughtGoal, model: CellModel, observations: MarkerObservations) -> list[int]:
    """Common markers by id: the requested ones, or all that were observed at teaching and are observed now."""
    then = {marker for points in goal.others.values() for marker in points} - set(goal.tool)
    now = {marker for points in observations.values() for marker in points} - set(model.marker_ids)
    for marker in requested.common:
        for seen, when in ((then, "when it was taught"), (now, "now")):
            if marker not in seen:
                raise TransferError(f"common marker {marker} is not seen {when}; seen: {listed(sorted(seen))}")
    common = sorted(set(requested.common) or then & now)
    if len(common) < min(POINTS_NEEDED.values()):
        raise TransferError(
            f"{len(common)} markers beside the body were seen when it was taught and are seen now "
            f"({listed(common)}); taught: {listed(sorted(then))}; now: {listed(sorted(now))}; 3 or more are needed"
        )
    return common


# -- the goal's points, when it was taught --------------------------------------------------------------------


def _points_when_taught(
    goal: TaughtGoal,
    taught: MarkerViews,
    old: AlignmentFrame,
    new: AlignmentFrame,
    model: CellModel,
    observations: MarkerObservations,
    same: bool,
) -> tuple[FloatArray, FloatArray, list[int]]:
    """Points (n, 4) of the body's markers at the goal in the frame of teaching, with covariances and ids.

    They are computed from the taught pixels or, if the goal is defined by a tool's features, from the current pose of
    the body on that tool, so that remounting the body does not change the goal.
    """
    tool = list(goal.tool)
    if not set(tool) <= set(model.marker_ids):
        require_still(observations, [*tool, *model.marker_ids], "the tool's and the body's markers")
        then, now = taught.subset(tool), observed_views(observations, model, tool)
        points, covariance = now.points()
        back, _ = align_points(
            family_between(new, old, same),
            new,
            old,
            points,
            covariance,
            then,
            tool,
            "the tool, by its features",
        )
        names = [m for m in model.marker_ids if m not in tool]
        body = observed_views(observations, model, names)
        points, covariance = body.points()
        points, covariance = move_points(back.H, points), carried_point_covariance(back, points, covariance)
    else:
        names = [m for m in (tool or taught.ids) if m in model.marker_ids]
        points, covariance = taught.subset(names).points()
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(known) < MIN_MARKERS:
        raise TransferError(
            f"{len(known)} markers of the body ({listed(names[k] for k in known)}) are known from two cameras; 3 or "
            "more are needed"
        )
    return points[known], covariance[known], [names[k] for k in known]


def _require_same_mounting(goal: TaughtGoal, model: CellModel, names: list[int], moved: FloatArray) -> None:
    """Check by the arm's kinematics that the body is mounted as at teaching. Raises TransferError."""
    if len(goal.joints) != len(model.joint_names):
        return
    chain = ProjectiveChain(model.joint_kinds, model.generators, model.zero, model.tip_first)
    rows = [model.marker_ids.index(marker) for marker in names]
    expected = model.marker_points[rows] @ chain.displacement(np.array(goal.joints)).T
    Ps = np.array([camera.matrix for camera in model.cameras])
    away = np.sqrt(((project_many(Ps, expected) - project_many(Ps, moved)) ** 2).sum(axis=-1))
    worst = float(away.max())
    if not worst <= MOUNTED_PX:
        raise TransferError(
            f"at the joints of teaching the model puts marker {names[int(away.max(axis=0).argmax())]} {worst:.1f} px "
            f"from the goal, {MOUNTED_PX:g} px is allowed: the marker body was remounted, or the common markers "
            "were moved. A goal that survives this is taught with --tool and sent relative to the workpiece"
        )


# -- cameras on the arm ---------------------------------------------------------------------------------------


def _relative_to_cameras(
    requested: TaughtTarget, goal: TaughtGoal, model: CellModel, observations: MarkerObservations, same: bool
) -> TransferredGoal:
    """Set-points with cameras on the arm: the goal is relative to the common markers; the static body belongs to them.

    The common markers are on a workpiece that has moved within the scene (relative to the model's body).
    """
    if requested.relative_to != "workpiece" or goal.tool or not same:
        raise TransferError(
            "the cameras ride on the arm: goals are carried over relative to the workpiece, without a tool, and with "
            f"the model they were taught with (epoch {goal.target.model_epoch}, the cell has {model.epoch}); "
            "teach them again"
        )
    if requested.lines or requested.planes:
        raise TransferError(
            "the cameras ride on the arm: goals are carried over by markers alone, not by lines or planes"
        )
    frame = model_frame(model)
    common = _common(requested, goal, model, observations)
    body = list(model.marker_ids)
    require_still(observations, [*common, *body], "markers")
    then, now = taught_views(goal).subset(common), observed_views(observations, model, common)
    back, origin = align_points(
        family_between(frame, frame, True),
        frame,
        frame,
        *now.points(),
        then,
        common,
        "relative to the workpiece",
    )
    points, covariance = observed_views(observations, model, body).points()
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    names = [body[k] for k in known]
    set_points, _, note = reproject_set_points(
        model,
        names,
        move_points(back.H, points[known]),
        carried_point_covariance(back, points[known], covariance[known]),
        "carried over",
    )
    return TransferredGoal(FeatureTarget(set_points, model.epoch), f"{origin}; {note}")
