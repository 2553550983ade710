"""Goals computed from CAD drawings: set-points in the current cameras for a tool's pose on a workpiece, with their
accuracy (thesis 8.6).
"""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.daemon.taught_goals import TaughtGoal, taught_model
from stereoservo.gateway.marker_views import model_frame, observed_views
from stereoservo.gateway.observation_cache import MarkerObservations
from stereoservo.gateway.point_alignment import (
    MIN_MARKERS,
    Deviations,
    Pixels,
    TransferError,
    align_points,
    listed,
    reproject_set_points,
    require_still,
)
from stereoservo.geometry.alignment import DRAWING, drawn_points, family_between
from stereoservo.geometry.homogeneous import GeometryError, move_points
from stereoservo.geometry.moved_cameras import carried_point_covariance
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.goals import FeatureTarget
from stereoservo.messages.wire import Synthesise


def synthesise(
    request: Synthesise, model: CellModel | None, observations: MarkerObservations, created: str
) -> tuple[TaughtGoal, str]:
    """Goal from drawn points and the pose of the tool on the workpiece, and a description of its accuracy.

    The markers that the arm does not move are seen now; they place the drawing. Raises TransferError.
    """
    if model is None:
        raise TransferError("the cell has no model yet: calibrate first")
    fixed, moving = request.workpiece, request.tool
    pose = np.array(request.pose).reshape(4, 4)
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
    static_markers, ids = sorted(fixed), sorted(moving)
    seen = {marker for points in observations.values() for marker in points}
    require_still(observations, static_markers, "markers")
    now = observed_views(observations, model, static_markers)
    frame = model_frame(model)
    missing = [marker for marker in static_markers if marker not in seen]
    if len(static_markers) - len(missing) < MIN_MARKERS:
        raise TransferError(
            f"markers {listed(missing)} of the drawing are not seen now; 3 or more are needed"
        )
    drawn = drawn_points(np.array([fixed[m] for m in static_markers]))
    change, description = align_points(
        family_between(DRAWING, frame, False),
        DRAWING,
        frame,
        drawn,
        None,
        now,
        static_markers,
        "drawing placed",
    )
    points = drawn_points(np.array([moving[m] for m in ids]), pose)
    set_points, deviations, note = reproject_set_points(
        model, ids, move_points(change.H, points), carried_point_covariance(change, points), "drawn"
    )
    return _drawn_goal(
        model, set_points, deviations, ids, observations, static_markers, created
    ), f"{description}; {note}"


def _drawn_goal(
    model: CellModel,
    set_points: Pixels,
    sigmas: Deviations,
    ids: list[int],
    observations: MarkerObservations,
    static_markers: list[int],
    created: str,
) -> TaughtGoal:
    """Goal with the set-points of drawn markers as if they had been taught, and the markers that located them."""
    of_body = {c: {m: p for m, p in seen.items() if m in model.marker_ids} for c, seen in set_points.items()}
    others = {
        c: {m: p for m, p in seen.items() if m not in model.marker_ids} for c, seen in set_points.items()
    }
    for camera, seen in observations.items():
        for marker in static_markers:
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
