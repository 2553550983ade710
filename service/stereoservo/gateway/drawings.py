"""Goals made from drawings: the pose of a tool on a workpiece, as set-points for the cameras of now (thesis 8.6)."""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.gateway.matching import (
    MIN_MARKERS,
    Deviations,
    Pixels,
    TransferError,
    fitted,
    listed,
    require_still,
    set_points_of,
)
from stereoservo.gateway.messages import Synthesise
from stereoservo.gateway.sights import Sights
from stereoservo.gateway.views import of_model, sights_views
from stereoservo.geometry.alignment import DRAWING, drawn_points, family_between
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import move_points
from stereoservo.geometry.moved_cameras import carried_point_covariance
from stereoservo.kinematics.model import CellModel
from stereoservo.runtime.commands import FeatureTarget
from stereoservo.runtime.taught import TaughtGoal, taught_model


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
            f"markers {listed(shared)} are of the body that moves before the cameras; the drawing is placed by others"
        )
    standing, ids = sorted(fixed), sorted(moving)
    seen = {marker for points in sights.values() for marker in points}
    require_still(sights, standing, "markers")
    now = sights_views(sights, model, standing)
    frame = of_model(model)
    missing = [marker for marker in standing if marker not in seen]
    if len(standing) - len(missing) < MIN_MARKERS:
        raise TransferError(
            f"markers {listed(missing)} of the drawing are not seen now; 3 or more are needed"
        )
    drawn = drawn_points(np.array([fixed[m] for m in standing]))
    change, said = fitted(
        family_between(DRAWING, frame, False), DRAWING, frame, drawn, None, now, standing, "drawing placed"
    )
    points = drawn_points(np.array([moving[m] for m in ids]), pose)
    set_points, deviations, note = set_points_of(
        model, ids, move_points(change.H, points), carried_point_covariance(change, points), "drawn"
    )
    return _drawn_goal(model, set_points, deviations, ids, sights, standing, created), f"{said}; {note}"


def _drawn_goal(
    model: CellModel,
    set_points: Pixels,
    sigmas: Deviations,
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
