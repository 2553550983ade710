"""Initial state of a control law for a goal whose target is resolved: its options, cameras and centre."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.control.faces import NOT_CHOSEN
from stereoservo.control.law import JacobianChoice, Law
from stereoservo.control.law_registry import LAWS
from stereoservo.control.pd import GAIN_MARGIN, largest_gain
from stereoservo.core.block import VELOCITY_FILTER_S
from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.goals.marker_body import markers_needed
from stereoservo.core.goals.resolve import camera_index, marker_indices, normalize_scale, of_this_model
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.prediction import chain_at
from stereoservo.core.state import GoalResolution, ServoGoal
from stereoservo.core.target.follow import require_followable
from stereoservo.kinematics.kernels import invert4, transform_points
from stereoservo.messages.goals import AdaptiveGain, Centre, DisplacementTarget, Goal, JacobianName, LawName, PlanReport
from stereoservo.numerics.arrays import FloatArray

JACOBIANS: dict[JacobianName, JacobianChoice] = {
    "current": JacobianChoice.CURRENT,
    "desired": JacobianChoice.DESIRED,
    "mean": JacobianChoice.MEAN,
    "fixed-depth": JacobianChoice.FIXED_DEPTH,
}


def law_of(goal: Goal, context: StepContext) -> tuple[LawName, Law]:
    """The law stated by ``goal``, or the cell's. Raises RefusalError."""
    name = goal.law or context.settings.law
    law = context.derived.laws.get(name)
    if law is None:
        raise RefusalError("NO_SUCH_LAW", str(LAWS.unknown(name)), subject=name)
    return name, law


def start_servoing(goal: Goal, resolved: GoalResolution, context: StepContext) -> ServoGoal:
    """The state of a law before its first step, for a goal that is resolved.

    Raises RefusalError naming the reason if the goal is unusable.
    """
    name, _ = law_of(goal, context)
    arrays, model = context.arrays, context.state.model
    assert arrays is not None
    assert model is not None
    if goal.follow_markers:
        require_followable(goal, LAWS[name].follows_streams, name, resolved.pose_known, context)
    weights, body, centre_target = _centre(goal.centre, resolved, arrays, model.epoch)
    is_step = isinstance(goal.target, DisplacementTarget) and goal.target.frame is not None and not goal.follow_markers
    return ServoGoal(
        **run_fields(goal, context, used_cameras(goal, resolved.wanted, context)),
        law=name,
        jacobian=int(JACOBIANS[goal.jacobian or "mean"]),
        set_points=resolved.set_points,
        wanted=resolved.wanted,
        rates=np.zeros_like(resolved.set_points),
        target_points=resolved.points,
        target_known=resolved.known.astype(np.float64),
        pose_known=resolved.pose_known,
        centre_weights=weights,
        centre_body=body,
        centre_target=centre_target,
        faces=resolved.faces,
        choice=NOT_CHOSEN._replace(triple=resolved.face),
        step_from=resolved.joints if is_step else None,
    )


def run_fields(goal: Goal, context: StepContext, used: FloatArray) -> dict[str, Any]:
    """Fields of a `LawRun` before its first step: the goal's values, or else the cell's."""
    settings = context.settings
    gain = goal.gain or settings.gain
    near, far, slope = (gain.near, gain.far, gain.slope) if isinstance(gain, AdaptiveGain) else (gain, gain, 1.0)
    return {
        "goal": goal,
        "points": goal.points or settings.points,
        "gain_near": near,
        "gain_far": far,
        "gain_slope": slope,
        "damping": _stable_damping(goal, near, context),
        "tolerance_px": goal.tolerance_px or settings.tolerance_px,
        "hold_frames": goal.hold_frames or settings.hold_frames,
        "time_limit_s": goal.time_limit_s or settings.time_limit_s,
        "started_ns": context.now_ns,
        "lease_s": goal.lease_s,
        "lease_until_ns": context.now_ns + int((goal.lease_s or 0.0) * 1e9),
        "used": used,
    }


def _stable_damping(goal: Goal, gain: float, context: StepContext) -> float:
    """The goal's damping. Raises RefusalError if the drives' delay is too large for it at its ``gain``."""
    damping = goal.damping or 0.0
    if damping == 0.0:
        return damping
    delays, settings = context.state.block.delay_s, context.settings
    slowest = int(delays.argmax())
    late_s = float(delays[slowest]) + VELOCITY_FILTER_S + 1.0 / settings.rate_hz
    most = largest_gain(damping, late_s) / GAIN_MARGIN
    if gain > most:
        joint = settings.joint_names[slowest]
        raise RefusalError(
            "DAMPING_UNSTABLE",
            f"damping {damping:g} at a gain of {gain:g}/s: the velocity of {joint} is known {late_s:.3f} s after its "
            f"command, by which gains up to {most:.2g}/s are damped; lower the gain, or the damping",
            subject=joint,
            value=gain,
            threshold=most,
            unit="1/s",
        )
    return damping


def used_cameras(goal: Goal, required: FloatArray, context: StepContext) -> FloatArray:
    """(c,) 1 for cameras that the law may use. Raises RefusalError if they show too few ``required`` (c, m)."""
    c = len(context.settings.cameras)
    if goal.cameras is None:
        return np.ones(c)
    used = np.zeros(c)
    for name in goal.cameras:
        used[camera_index(name, context.settings)] = 1.0
    shown = int((required * used[:, None]).max(axis=0).sum())
    needed = markers_needed(required)
    if shown < needed:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"cameras {', '.join(goal.cameras) or '(none)'} show {shown} markers of the goal; at least {needed} "
            "are needed",
            value=float(shown),
            threshold=float(needed),
            unit="markers",
        )
    return used


def _centre(
    centre: Centre | None, resolved: GoalResolution, arrays: ModelArrays, epoch: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A goal's centre: affine weights (m,) of the markers, or (weights zero) a point (4,) of the body; and the centre
    at the goal.

    The point is stated at the chain's zero. Default: the affine centroid of the goal's markers.
    """
    weights = np.zeros(len(arrays.marker_ids))
    body = np.zeros(4)
    if centre is None:
        weights = resolved.known.astype(np.float64) / max(float(resolved.known.sum()), 1.0)
    elif bool(centre.markers) == (centre.point is not None):
        raise RefusalError("CENTRE_UNCLEAR", "the centre is given either by markers or as a point, not by both or none")
    elif centre.point is not None:
        if centre.model_epoch is None:
            raise RefusalError("FRAME_UNKNOWN", "a point as centre needs the model_epoch in whose frame it is")
        of_this_model(centre.model_epoch, epoch)
        now = normalize_scale(np.array(centre.point), arrays, "the centre")[None]
        H = chain_at(arrays, resolved.joints)[0]
        body = transform_points(invert4(H), now)[0]
        return weights, body, transform_points(resolved.displacement, now)[0]
    else:
        weights[marker_indices(centre.markers, arrays)] = 1.0
        weights = weights / float(weights.sum())
    return weights, body, (weights[:, None] * resolved.points).sum(axis=0)


def unplanned_report(source: ServoGoal, context: StepContext) -> PlanReport:
    """The report of a goal whose pose, and so its path, is not known beforehand."""
    return no_plan(
        source.law,
        "the pose at the goal is not known: fewer than three of its markers are shown by two cameras",
        source.time_limit_s,
    )


def no_plan(law: str, why: str, seconds: float) -> PlanReport:
    """A report without a plan: ``why`` there is none; it takes ``seconds`` at most."""
    return PlanReport(
        law=law, way=f"not planned: {why}", seconds=seconds, approaches=(), shares=(), joints={}, pixels={}
    )
