"""Goals for a law, as the state that its motion source begins with: set-points, body at the goal, centre, options."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.control.face_choice import NOT_CHOSEN
from stereoservo.control.faces import FLAT_PX, find_faces
from stereoservo.control.law import JacobianChoice
from stereoservo.control.law_registry import LAWS, UnknownLawError
from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.goals.resolve import (
    ResolvedGoal,
    aim_at,
    camera_index,
    marker_index,
    normalize_scale,
    of_this_model,
)
from stereoservo.core.goals.target_checks import MIN_MARKERS, BodyState
from stereoservo.core.prediction import chain_at
from stereoservo.core.state import ServoGoal
from stereoservo.kinematics.kernels import invert4, transform_points
from stereoservo.messages.goals import (
    AdaptiveGain,
    Centre,
    DisplacementTarget,
    FeatureTarget,
    Goal,
    JacobianName,
    PlanReport,
    PointTarget,
)
from stereoservo.numerics.arrays import FloatArray

JACOBIANS: dict[JacobianName, JacobianChoice] = {
    "current": JacobianChoice.CURRENT,
    "desired": JacobianChoice.DESIRED,
    "mean": JacobianChoice.MEAN,
    "fixed-depth": JacobianChoice.FIXED_DEPTH,
}


def place_now(context: StepContext) -> BodyState:
    """The body as the estimate has it now. Only with a model."""
    arrays, prediction = context.arrays, context.prediction
    assert arrays is not None
    assert prediction is not None
    H = chain_at(arrays, context.q + context.state.correction)[0]
    points = transform_points(H, arrays.marker_points)
    seen = (
        np.zeros((len(context.settings.cameras), len(points))) if context.weights is None else context.weights
    )
    faces = find_faces(points, arrays.matrices, FLAT_PX, arrays.camera_centres, seen, prediction.operators)
    return BodyState(context.settings, arrays, points, prediction.operators, faces)


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
    try:
        law = LAWS[name]
    except UnknownLawError as error:
        raise RefusalError("NO_SUCH_LAW", str(error), subject=name) from error
    aim = aim_at(target, place, law.needs_goal_pose, model.epoch)
    weights, body, centre_target = _centre(goal.centre, aim, place, context, model.epoch)
    source = ServoGoal(
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
    source.renew_lease(context.now_ns)
    return source


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
        "lease_until_ns": 0,
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
