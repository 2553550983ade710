"""The check motion as a motion source: a few stops around the base, evaluated against the model in use without a fit.

At stop l joint l stands above, and the joint after it below its base, so that every joint is seen on both sides and
against the others, with one stop a joint and the base. `kinematics.calibration.check` says what the pixels mean.
"""

from __future__ import annotations

import numpy as np

from stereoservo.control.reasons import Reason
from stereoservo.kinematics.model import CellModel
from stereoservo.runtime.motion import ARRIVED, Motion, Present
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.settings import CoreSettings
from stereoservo.runtime.state import Checking
from stereoservo.runtime.visiting import (
    blocked,
    enter,
    first_visit,
    look,
    markers_lost,
    mean_joints,
    onwards,
    there,
    too_few_seen,
    too_slow,
    trial_settings,
    unseen_at_base,
)

SHARE = 0.5
"""Of what a joint was driven to one side of its base for the model's calibration."""
RESET_ZEROS = "reset_zeros"
"""Name of a ``check_finished`` event after which drifted joint zeros are to be reset."""


def check_targets(settings: CoreSettings, model: CellModel) -> FloatArray:
    """Configurations (s, n) of the check motion, the base first and last."""
    trial = trial_settings(settings)
    driven = trial.range.copy()
    if model.statistics is not None:
        known = {joint.name: 0.5 * joint.range for joint in model.statistics.joints}
        driven = np.array([known.get(name, r) for name, r in zip(settings.joint_names, driven, strict=True)])
    limits = settings.limits
    margin = limits.position_margin + 4.0 * ARRIVED
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


def start_check(goal_id: str, present: Present, model: CellModel, reset_zeros: bool = False) -> Checking:
    """The check motion before its first move: to the base. ``reset_zeros`` is told when it has finished."""
    targets = check_targets(present.settings, model)
    fields = first_visit(targets[0], present.q, present.now_ns, present.settings)
    return Checking(
        id=goal_id, lease_s=None, lease_until_ns=0, targets=targets, index=0,
        reset_zeros=reset_zeros,
        **fields,  # type: ignore[arg-type]
    )  # fmt: skip


def check_step(checking: Checking, present: Present) -> Motion:
    """One step of the check motion."""
    trial = trial_settings(present.settings)
    rest = Motion(np.zeros_like(present.q))
    last = len(checking.targets) - 1
    if checking.phase in ("settle", "collect"):
        samples = look(checking, present, trial)
        if samples is None:
            return rest
        poorest = too_few_seen(samples, trial, present.settings.scene_ids)
        if poorest is not None and checking.index == 0:
            return _abort(checking, present, unseen_at_base(poorest, trial, present.settings.scene_ids))
        if poorest is None:
            checking.seen += 1
        present.emit(
            "calibration_sample", id=checking.id, joints=mean_joints(checking), samples=samples,
            progress=(checking.index + 1.0) / (last + 1.0),
        )  # fmt: skip
        return _next(checking, present)
    if there(checking, present):
        if checking.index == last:
            present.emit(
                "check_finished", id=checking.id, message="check motion done", progress=1.0,
                name=RESET_ZEROS if checking.reset_zeros else "",
            )  # fmt: skip
            return Motion(rest.velocity, finished=True)
        enter(checking, "settle", present)
        return rest
    reason = too_slow(checking, present, trial)
    if reason is not None:
        return _abort(checking, present, reason)
    if checking.index > 0 and markers_lost(checking, present, trial) and checking.index < last:
        present.emit(
            "warning", id=checking.id, message=f"check: stop {checking.index} loses the markers; left out"
        )
        return _next(checking, present)
    return onwards(checking, present, trial)


def _next(checking: Checking, present: Present) -> Motion:
    last = len(checking.targets) - 1
    checking.index += 1
    everything = list(range(present.q.size))
    while checking.index < last and blocked(checking.targets[checking.index], everything, present):
        checking.index += 1
    checking.target = checking.targets[checking.index].copy()
    enter(checking, "move", present)
    return Motion(np.zeros_like(present.q))


def _abort(checking: Checking, present: Present, reason: Reason) -> Motion:
    present.emit("calibration_aborted", id=checking.id, message=reason.hint, reasons=(reason,))
    return Motion(np.zeros_like(present.q), finished=True)
