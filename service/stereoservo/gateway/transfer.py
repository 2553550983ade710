"""Taught goals where they hold now: on a workpiece that has moved, for other cameras, for a body mounted anew, or from
drawings (thesis 8.6: set-points, shown or synthesised from CAD data, are reprojected where cameras have changed).

A goal keeps the pixels of the moving body (or of a tool on it), of the workpiece, and the cameras that saw them. What
stood still relative to the goal, the ``common`` markers, gives the map from the frame of teaching to that of now
(`geometry.alignment`); the goal's points go along and are projected again. Nothing here waits or moves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.gateway.messages import Synthesise
from stereoservo.gateway.sights import Sights
from stereoservo.gateway.views import Views, of_model, of_taught, sights_views, taught_views
from stereoservo.geometry.alignment import (
    DRAWING,
    POINTS_NEEDED,
    AlignmentFrame,
    Family,
    align,
    drawn_points,
    family_between,
    point_residuals,
    reprojected,
)
from stereoservo.geometry.cameras import project_many
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray, move_points
from stereoservo.geometry.moved_cameras import FrameChange, carried_point_covariance
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.model import CellModel
from stereoservo.runtime.commands import FeatureTarget, TaughtTarget
from stereoservo.runtime.taught import TaughtGoal, taught_model

BoolArray = npt.NDArray[np.bool_]
Fit = Callable[[BoolArray], tuple[FrameChange, FloatArray]]

RESIDUAL_PX = 1.5
"""Common markers that disagree by more than this, and by six deviations, have not moved as one."""
SIGMA_PX = 2.0
"""Set-points that are known no better than this are refused."""
MOUNTED_PX = 5.0
"""Where cameras alone have changed, goal and kinematics agree within this, or the body was mounted anew."""
DEVIATIONS = 6.0
MIN_MARKERS = 3


class TransferError(Exception):
    """A taught goal cannot be carried over, or a drawn one not be placed; says why, with values."""


@dataclass(frozen=True)
class Resolved:
    """Set-points for the model in use, and in words how they came about and how well they are known."""

    target: FeatureTarget
    note: str


def resolve(wanted: TaughtTarget, goal: TaughtGoal, model: CellModel | None, sights: Sights) -> Resolved:
    """A taught goal as set-points of the body for the model and the cameras of now. Raises TransferError."""
    if wanted.relative_to is None and not goal.tool:
        return Resolved(goal.target, "")
    if model is None:
        raise TransferError("the cell has no model yet: calibrate first")
    if goal.model is None:
        raise TransferError(
            f"{wanted.name!r} was taught by an earlier version, and the model of its epoch "
            f"{goal.target.model_epoch} is gone: teach it again"
        )
    same = goal.model.epoch == model.epoch
    if model.mount == "eye_in_hand":
        return _relative_to_cameras(wanted, goal, model, sights, same)
    old, new = of_taught(goal.model), of_model(model)
    taught = taught_views(goal)
    if wanted.relative_to is None:
        if not same:
            raise TransferError(
                f"{wanted.name!r} was taught with model epoch {goal.model.epoch}, the cell has {model.epoch}: send it "
                'relative to the "workpiece", or to the "cameras"'
            )
        change, said = _nothing_moved(), "where it was taught"
    else:
        change, said = _common_change(wanted, goal, taught, old, new, model, sights, same)
    points, spread, names = _points_when_taught(goal, taught, old, new, model, sights, same)
    moved = move_points(change.H, points)
    set_points, note = _set_points(
        model, names, moved, carried_point_covariance(change, points, spread), "carried over"
    )
    if wanted.relative_to == "cameras" and not goal.tool:
        _require_same_mounting(goal, model, names, moved)
    return Resolved(FeatureTarget(set_points, model.epoch), f"{said}; {note}")


def _nothing_moved() -> FrameChange:
    return FrameChange(np.eye(4), np.zeros((16, 16)), (), 0.0, 0)


def _common_change(
    wanted: TaughtTarget,
    goal: TaughtGoal,
    taught: Views,
    old: AlignmentFrame,
    new: AlignmentFrame,
    model: CellModel,
    sights: Sights,
    same: bool,
) -> tuple[FrameChange, str]:
    """What has happened to the common markers since, and in words by which it is known."""
    common = _common(wanted, goal, model, sights)
    before, now = taught.of(common), sights_views(sights, model, common)
    _require_still(sights, common, "the common markers")
    if wanted.relative_to == "cameras" and same:
        away = np.sqrt(((now.pixels - before.pixels) ** 2).sum(axis=-1))
        if np.nanmax(away, initial=0.0) > RESIDUAL_PX + DEVIATIONS * float(
            np.nanmax(now.sigmas, initial=0.0)
        ):
            worst = common[int(np.nanargmax(np.where(np.isfinite(away), away, -1.0).max(axis=0)))]
            raise TransferError(
                f"marker {worst} stands {np.nanmax(away):.1f} px from where it was taught, but the cameras' model is "
                f"still that of epoch {model.epoch}: calibrate with the cameras as they are now, then send it again"
            )
    family = family_between(old, new, same)
    return _fitted(family, old, new, *before.points(), now, common, f"relative to the {wanted.relative_to}")


def _fitted(
    family: Family,
    old: AlignmentFrame,
    new: AlignmentFrame,
    points: FloatArray,
    spread: FloatArray | None,
    now: Views,
    common: list[int],
    what: str,
) -> tuple[FrameChange, str]:
    """The map of points (n, 4) onto where markers are seen; refused where they have not moved as one."""

    def fit(rows: BoolArray) -> tuple[FrameChange, FloatArray]:
        kept = np.flatnonzero(rows)
        own = None if spread is None else spread[kept]
        change = align(
            family, old, new, points[kept], now.pixels[:, kept], now.sigmas[:, kept], own, [common[k] for k in kept]
        )  # fmt: skip
        return change, point_residuals(new.Ps, move_points(change.H, points[kept]), now.pixels[:, kept])

    usable: BoolArray = np.asarray(
        np.isfinite(points).all(axis=1) & np.isfinite(now.pixels).all(axis=2).any(axis=0)
    )
    try:
        change, residuals = fit(usable)
    except GeometryError as error:
        raise TransferError(f"{what}: {error}") from error
    worst = float(np.nanmax(residuals))
    limit = max(
        RESIDUAL_PX, DEVIATIONS * float(np.nanmax(np.where(np.isfinite(now.sigmas), now.sigmas, np.nan)))
    )
    ids = [common[k] for k in np.flatnonzero(usable)]
    if worst > limit:
        raise TransferError(
            f"{what}: markers {_list(ids)} have not moved as one body: {worst:.1f} px is left at marker "
            f"{ids[int(np.nanargmax(residuals))]}, {limit:.1f} px is allowed{_culprit(fit, usable, common, limit)}"
        )
    count = f"{len(ids)} markers ({_list(ids)})"
    return change, f"{what} by {count} as a {family} map, which agree within {worst:.2f} px"


def _culprit(fit: Fit, usable: BoolArray, common: list[int], limit: float) -> str:
    """Which single marker, left out, makes the others agree; empty where none does, or too few are left."""
    best = (limit, -1)
    for k in np.flatnonzero(usable):
        without = usable.copy()
        without[k] = False
        try:
            _, residuals = fit(without)
        except GeometryError:
            continue  # too few are left, or they are flat: nothing is said of this one
        best = min(best, (float(np.nanmax(residuals)), int(k)))
    if best[1] < 0:
        return ""
    return (
        f"; without marker {common[best[1]]} the others agree within {best[0]:.2f} px: it has slipped, or is taken for "
        "another"
    )


def _common(wanted: TaughtTarget, goal: TaughtGoal, model: CellModel, sights: Sights) -> list[int]:
    """The common markers by id: those asked for, or all that were seen then and are seen now."""
    then = {marker for points in goal.others.values() for marker in points} - set(goal.tool)
    now = {marker for points in sights.values() for marker in points} - set(model.marker_ids)
    for marker in wanted.common:
        for seen, when in ((then, "when it was taught"), (now, "now")):
            if marker not in seen:
                raise TransferError(f"common marker {marker} is not seen {when}; seen: {_list(sorted(seen))}")
    common = sorted(set(wanted.common) or then & now)
    if len(common) < min(POINTS_NEEDED.values()):
        raise TransferError(
            f"{len(common)} markers beside the body were seen when it was taught and are seen now "
            f"({_list(common)}); taught: {_list(sorted(then))}; now: {_list(sorted(now))}; 3 or more are needed"
        )
    return common


def _require_still(sights: Sights, markers: list[int], what: str) -> None:
    moving = sorted({m for points in sights.values() for m in markers if m in points and points[m].moves})
    if moving:
        raise TransferError(f"{what} {_list(moving)} move now; send the goal when they stand still")


# -- the goal's points, when it was taught --------------------------------------------------------------------


def _points_when_taught(
    goal: TaughtGoal,
    taught: Views,
    old: AlignmentFrame,
    new: AlignmentFrame,
    model: CellModel,
    sights: Sights,
    same: bool,
) -> tuple[FloatArray, FloatArray, list[int]]:
    """Points (n, 4) of the body's markers at the goal in the frame of teaching, covariances, ids.

    By themselves, or, where the goal is meant by a tool's features, by where the body sits on that tool now: mounting
    the body anew does not change the goal.
    """
    tool = list(goal.tool)
    if not set(tool) <= set(model.marker_ids):
        _require_still(sights, [*tool, *model.marker_ids], "the tool's and the body's markers")
        then, now = taught.of(tool), sights_views(sights, model, tool)
        points, spread = now.points()
        back, _ = _fitted(
            family_between(new, old, same), new, old, points, spread, then, tool, "the tool, by its features"
        )
        names = [m for m in model.marker_ids if m not in tool]
        body = sights_views(sights, model, names)
        points, spread = body.points()
        points, spread = move_points(back.H, points), carried_point_covariance(back, points, spread)
    else:
        names = [m for m in (tool or taught.ids) if m in model.marker_ids]
        points, spread = taught.of(names).points()
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(known) < MIN_MARKERS:
        raise TransferError(
            f"{len(known)} markers of the body ({_list(names[k] for k in known)}) are known from two cameras; 3 or "
            "more are needed"
        )
    return points[known], spread[known], [names[k] for k in known]


def _set_points(
    model: CellModel, names: list[int], points: FloatArray, spread: FloatArray, what: str
) -> tuple[dict[str, dict[int, tuple[float, float]]], str]:
    """Raw set-points of points (n, 4) by camera and marker, and how well they are known.

    A point outside of an image is none there. Raises TransferError behind a camera, and where too few remain.
    """
    views = Views.empty(model, names)
    pixels, deviations = reprojected(views.Ps, points, spread)
    depths = np.einsum("cj,nj->cn", views.Ps[:, 2], points) * views.fronts()[:, None]
    if not (depths > 0).all():
        camera, k = (int(i) for i in np.argwhere(~(depths > 0))[0])
        raise TransferError(f"{what}, marker {names[k]} comes behind camera {views.cameras[camera]!r}")
    worst = float(deviations.max())
    if not worst <= SIGMA_PX:
        camera, k = (int(i) for i in np.argwhere(~(deviations <= SIGMA_PX))[0])
        raise TransferError(
            f"{what}, the set-point of marker {names[k]} in camera {views.cameras[camera]!r} would be known to "
            f"{deviations[camera, k]:.1f} px only, {SIGMA_PX:g} px is allowed: use more common markers, farther apart "
            "and nearer to the goal"
        )
    raw = views.raw(pixels)
    found: dict[str, dict[int, tuple[float, float]]] = {}
    outside: list[str] = []
    for c, name in enumerate(views.cameras):
        width, height = views.sizes[c]
        for marker, (u, v) in zip(names, raw[c], strict=True):
            if -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5:
                found.setdefault(name, {})[marker] = (float(u), float(v))
            else:
                outside.append(f"{marker} in {name!r}")
    kept = {marker for seen in found.values() for marker in seen}
    if len(kept) < MIN_MARKERS:
        raise TransferError(f"{what}, markers leave the images ({', '.join(outside)}); 3 must stay in view")
    left = f"; outside of the image: {', '.join(outside)}" if outside else ""
    return found, f"set-points known to {worst:.2f} px{left}"


def _require_same_mounting(goal: TaughtGoal, model: CellModel, names: list[int], moved: FloatArray) -> None:
    """The arm stands where it stood: its kinematics must put the body where the goal does."""
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
            f"from the goal, {MOUNTED_PX:g} px is allowed: the marker body was mounted anew, or the common markers "
            "were moved. A goal that survives this is taught with --tool and sent relative to the workpiece"
        )


# -- cameras on the arm ---------------------------------------------------------------------------------------


def _relative_to_cameras(
    wanted: TaughtTarget, goal: TaughtGoal, model: CellModel, sights: Sights, same: bool
) -> Resolved:
    """With cameras on the arm: they shall see the common markers as they were taught, so the standing body goes along.

    The common markers stand on a workpiece that has moved within the scene (relative to the model's body).
    """
    if wanted.relative_to != "workpiece" or goal.tool or not same:
        raise TransferError(
            "the cameras ride on the arm: goals are carried over relative to the workpiece, without a tool, and with "
            f"the model they were taught with (epoch {goal.target.model_epoch}, the cell has {model.epoch}); teach anew"
        )
    frame = of_model(model)
    common = _common(wanted, goal, model, sights)
    body = list(model.marker_ids)
    _require_still(sights, [*common, *body], "markers")
    then, now = taught_views(goal).of(common), sights_views(sights, model, common)
    back, said = _fitted(
        family_between(frame, frame, True),
        frame,
        frame,
        *now.points(),
        then,
        common,
        "relative to the workpiece",
    )
    points, spread = sights_views(sights, model, body).points()
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    names = [body[k] for k in known]
    set_points, note = _set_points(
        model,
        names,
        move_points(back.H, points[known]),
        carried_point_covariance(back, points[known], spread[known]),
        "carried over",
    )
    return Resolved(FeatureTarget(set_points, model.epoch), f"{said}; {note}")


# -- drawings -------------------------------------------------------------------------------------------------


def synthesise(
    wanted: Synthesise, model: CellModel | None, sights: Sights, created: str
) -> tuple[TaughtGoal, str]:
    """A goal from drawn points and the pose of the tool on the workpiece, and in words how well it is known.

    The markers that the arm does not move are seen now; they place the drawing. Raises TransferError.
    """
    if model is None:
        raise TransferError("the cell has no model yet: calibrate first")
    fixed, moving = wanted.workpiece, wanted.tool
    pose = np.array(wanted.pose).reshape(4, 4)
    try:
        drawn_points(np.zeros((1, 3)), pose)
    except GeometryError as error:
        raise TransferError(f"pose: {error}") from error
    if (
        model.mount == "eye_in_hand"
    ):  # here the workpiece carries the model's body, the tool rides with the cameras
        fixed, moving, pose = moving, fixed, np.linalg.inv(pose)
    shared = sorted(set(fixed) & set(model.marker_ids))
    if shared:
        raise TransferError(
            f"markers {_list(shared)} are of the body that moves before the cameras; the drawing is placed by others"
        )
    standing, ids = sorted(fixed), sorted(moving)
    seen = {marker for points in sights.values() for marker in points}
    _require_still(sights, standing, "markers")
    now = sights_views(sights, model, standing)
    frame = of_model(model)
    missing = [marker for marker in standing if marker not in seen]
    if len(standing) - len(missing) < MIN_MARKERS:
        raise TransferError(f"markers {_list(missing)} of the drawing are not seen now; 3 or more are needed")
    drawn = drawn_points(np.array([fixed[m] for m in standing]))
    change, said = _fitted(
        family_between(DRAWING, frame, False), DRAWING, frame, drawn, None, now, standing, "drawing placed"
    )
    points = drawn_points(np.array([moving[m] for m in ids]), pose)
    set_points, note = _set_points(
        model, ids, move_points(change.H, points), carried_point_covariance(change, points), "drawn"
    )
    return _drawn_goal(model, set_points, ids, sights, standing, created), f"{said}; {note}"


def _drawn_goal(
    model: CellModel,
    set_points: dict[str, dict[int, tuple[float, float]]],
    ids: list[int],
    sights: Sights,
    standing: list[int],
    created: str,
) -> TaughtGoal:
    """Set-points of drawn markers as if they had been shown, with the markers that placed them."""
    of_body = {c: {m: p for m, p in seen.items() if m in model.marker_ids} for c, seen in set_points.items()}
    others = {
        c: {m: p for m, p in seen.items() if m not in model.marker_ids} for c, seen in set_points.items()
    }
    sigmas: dict[str, dict[int, float]] = {}
    for camera, seen in sights.items():
        for marker in standing:
            if marker in seen:
                others.setdefault(camera, {})[marker] = seen[marker].pixel
                sigmas.setdefault(camera, {})[marker] = seen[marker].sigma
    goal = TaughtGoal(
        FeatureTarget({c: seen for c, seen in of_body.items() if seen}, model.epoch),
        created=created,
        others={c: seen for c, seen in others.items() if seen},
        sigmas=sigmas,
        model=taught_model(model),
    )
    by_body = set(ids) <= set(model.marker_ids)
    return goal if by_body else msgspec.structs.replace(goal, tool=tuple(ids))


def _list(markers: Iterable[object]) -> str:
    return ", ".join(str(marker) for marker in markers) or "none"
