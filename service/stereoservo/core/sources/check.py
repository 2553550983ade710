"""Motion source of the model check: a few stops around the base posture at which the markers' pixels are averaged and
then tested against the model in use, without a fit.

At stop l joint l is above, and the next joint below its base, so that every joint is observed on both sides and against
the others, with one stop a joint plus the base. `calibration.change.model_check` evaluates the pixels.
"""

from __future__ import annotations

import numpy as np

from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.cycle import RESET_ZEROS
from stereoservo.core.settings import CoreSettings
from stereoservo.core.sources.measure_at_pose import (
    abort,
    at_target,
    blocked,
    collect_samples,
    continue_move,
    enter,
    first_visit,
    markers_lost,
    mean_joints,
    rest,
    too_few_seen,
    too_slow,
    trial_settings,
    unseen_at_base,
)
from stereoservo.core.state import CheckMotion
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray

SHARE = 0.5
"""Fraction of the range to one side of its base in which a joint was driven for the model's calibration."""


def check_targets(settings: CoreSettings, model: CellModel) -> FloatArray:
    """Configurations (s, n) of the check motion, the base first and last."""
    trial = trial_settings(settings)
    driven = trial.range.copy()
    if model.statistics is not None:
        known = {joint.name: 0.5 * joint.range for joint in model.statistics.joints}
        driven = np.array([known.get(name, r) for name, r in zip(settings.joint_names, driven, strict=True)])
    limits = settings.limits
    margin = limits.position_margin + 4.0 * settings.arrival
    room = np.minimum(limits.position_max - margin - trial.base, trial.base - limits.position_min - margin)
    step = np.maximum(np.minimum(SHARE * np.where(np.isfinite(driven), driven, 0.1), room), 0.0)
    n = trial.base.size
    stops = [trial.base]
    for joint in range(n):
        stop = trial.base.copy()
        stop[joint] += step[joint]
        if n > 1:
            stop[(joint + 1) % n] -= step[(joint + 1) % n]
        stops.append(stop)
    if n == 1:
        stops.append(trial.base - step)
    return np.array([*stops, trial.base])


def start_check(goal_id: str, context: StepContext, model: CellModel, reset_zeros: bool = False) -> CheckMotion:
    """The check motion before its first move, to the base. ``reset_zeros`` is reported when it has finished."""
    targets = check_targets(context.settings, model)
    fields = first_visit(targets[0], context.q, context.now_ns, context.settings)
    return CheckMotion(
        id=goal_id,
        lease_s=None,
        lease_until_ns=0,
        targets=targets,
        index=0,
        reset_zeros=reset_zeros,
        **fields,  # type: ignore[arg-type]
    )


def check_step(checking: CheckMotion, context: StepContext) -> SourceOutput:
    """One step of the check motion."""
    trial = trial_settings(context.settings)
    last = len(checking.targets) - 1
    if checking.phase in ("settle", "collect"):
        samples = collect_samples(checking, context, trial)
        if samples is None:
            return rest(context)
        poorest = too_few_seen(samples, trial, context.settings.scene_ids)
        if poorest is not None and checking.index == 0:
            return abort(checking, context, unseen_at_base(poorest, trial, context.settings.scene_ids))
        if poorest is None:
            checking.seen += 1
        context.emit(
            "calibration_sample",
            id=checking.id,
            joints=mean_joints(checking),
            samples=samples,
            progress=(checking.index + 1.0) / (last + 1.0),
        )
        return _next(checking, context)
    if at_target(checking, context):
        if checking.index == last:
            context.emit(
                "check_finished",
                id=checking.id,
                message="check motion done",
                progress=1.0,
                name=RESET_ZEROS if checking.reset_zeros else "",
            )
            return rest(context, finished=True)
        enter(checking, "settle", context)
        return rest(context)
    reason = too_slow(checking, context, trial)
    if reason is not None:
        return abort(checking, context, reason)
    if checking.index > 0 and markers_lost(checking, context, trial) and checking.index < last:
        context.emit("warning", id=checking.id, message=f"check: stop {checking.index} loses the markers; left out")
        return _next(checking, context)
    return continue_move(checking, context, trial)


def _next(checking: CheckMotion, context: StepContext) -> SourceOutput:
    last = len(checking.targets) - 1
    checking.index += 1
    everything = list(range(context.q.size))
    while checking.index < last and blocked(checking.targets[checking.index], everything, context):
        checking.index += 1
    checking.target = checking.targets[checking.index].copy()
    enter(checking, "move", context)
    return rest(context)
