"""Motion source of the model check: a few stops around the base posture at which the markers' pixels are averaged and
then tested against the model in use, without a fit.

At stop l joint l is above, and the next joint below its base, so that every joint is observed on both sides and against
the others, with one stop a joint plus the base. The quick check has two stops around the present posture, at which all
joints are displaced. `calibration.change.model_check` evaluates the pixels.
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
from stereoservo.messages.goals import Calibrate
from stereoservo.numerics.arrays import FloatArray

SHARE = 0.5
"""Fraction of the range to one side of its base in which a joint was driven for the model's calibration."""


QUICK_S = 2.0
"""Time [s] of the three moves of the quick check, without the approach to their ends, which takes less than a third of
a second each: together at most three seconds.
"""


def quick_targets(settings: CoreSettings, model: CellModel, q: FloatArray) -> FloatArray:
    """Configurations (4, n) of the quick check: ``q`` (n,), the posture in which the arm rests, first and last."""
    limits = settings.limits
    # A move of length d takes d / v + 4 v / 3 a with braking at `BRAKE_SHARE` a; the moves are d, 2 d and d long.
    speed = limits.velocity_max * (limits.speed_scale * trial_settings(settings).speed_scale)
    speed = np.minimum(speed, QUICK_S / 8.0 * limits.acceleration_max)
    reach = speed * (QUICK_S / 4.0 - speed / limits.acceleration_max)
    step = np.minimum(reach, _steps(settings, model, q))
    joint = np.arange(q.size)
    return np.array([q, q + step * (1 - 2 * (joint % 2)), q + step * (1 - 2 * (joint // 2 % 2)), q])


def check_targets(settings: CoreSettings, model: CellModel) -> FloatArray:
    """Configurations (s, n) of the check motion, the base first and last."""
    base = trial_settings(settings).base
    step, n = _steps(settings, model, base), base.size
    stops = [base]
    for joint in range(n):
        stop = base.copy()
        stop[joint] += step[joint]
        if n > 1:
            stop[(joint + 1) % n] -= step[(joint + 1) % n]
        stops.append(stop)
    if n == 1:
        stops.append(base - step)
    return np.array([*stops, base])


def _steps(settings: CoreSettings, model: CellModel, middle: FloatArray) -> FloatArray:
    """Largest displacements (n,) of the joints to either side of the ``middle`` (n,)."""
    trial = trial_settings(settings)
    driven = trial.range.copy()
    if model.statistics is not None:
        known = {joint.name: 0.5 * joint.range for joint in model.statistics.joints}
        driven = np.array([known.get(name, r) for name, r in zip(settings.joint_names, driven, strict=True)])
    limits = settings.limits
    margin = limits.position_margin + 4.0 * settings.arrival
    remaining = np.minimum(limits.position_max - margin - middle, middle - limits.position_min - margin)
    return np.maximum(np.minimum(SHARE * np.where(np.isfinite(driven), driven, 0.1), remaining), 0.0)


def start_check(command: Calibrate, context: StepContext, model: CellModel) -> CheckMotion:
    """The check motion of a ``command`` before its first move, to the base or, if it is quick, none."""
    settings = context.settings
    targets = quick_targets(settings, model, context.q) if command.quick else check_targets(settings, model)
    fields = first_visit(targets[0], context.q, context.now_ns, settings)
    return CheckMotion(
        id=command.id,
        lease_s=None,
        lease_until_ns=0,
        targets=targets,
        index=0,
        reset_zeros=command.reset_zeros,
        quick=command.quick,
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
            where = "where the arm rests" if checking.quick else "at the base"
            return abort(checking, context, unseen_at_base(poorest, trial, context.settings.scene_ids, where))
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
