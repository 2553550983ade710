"""Whether errors of the joint readings explain a calibration's residuals, against what imitates them: a wrong scale,
one wrong stop, a step.
"""

from __future__ import annotations

import msgspec
import numpy as np
from scipy.stats import t as student

from stereoservo.calibration.bundle_adjustment import Solution
from stereoservo.calibration.diagnosis.joint_scales import LEAST_FACTOR
from stereoservo.calibration.diagnosis.marker_tracks import find_step
from stereoservo.calibration.joint_errors.variance_components import (
    FALSE_ALARM,
    SAME_READING,
    VarianceComponents,
)
from stereoservo.calibration.rig_model import predicted
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.numerics.arrays import BoolArray, FloatArray

EXPLAINED = 1.5
"""Residual over stated noise that may be left beside errors of the joints for these to be the cause."""
MOST_OUTLIERS = 0.02
"""Share of the pixels that may be left out beside them."""
ONE_STOP, OTHERS = 45.0, 0.75
"""Largest square of a joint's errors, over the one that three quarters of them do not exceed, from which a single stop
is wrong: Gaussian ones of nine stops get there twice in a thousand, and half of them may lie on one flank of a play.
"""
ONE_STEP = 0.5
"""Share of what the model leaves at the reported positions that a step must explain to be what happened: errors of the
joints leave more.
"""
WRONG_SHARE = 0.5
"""Error over reported displacement of a joint that stands elsewhere in another's trial, from which it is wrong."""
LEAST_STOPS = 4
"""Stops of a trial from which single ones can be told."""
MOST_GIVEN = 0.06
"""Largest share of its motion that a joint may seem to have too much or too little by sag or coupling."""
LIKE_OTHERS = 3.0
"""Times the joints' own errors that a wrong scale must move a joint over its trial to be told from them."""


class ScalesError(Exception):
    """Errors of the joint readings explain the data beside these scale ``factors`` (n,)."""

    def __init__(self, factors: FloatArray, components: VarianceComponents) -> None:
        super().__init__("wrong scales")
        self.factors, self.components = factors, components


def explains(
    trials: TrialData, solution: Solution, inliers: BoolArray, components: VarianceComponents | None
) -> bool:
    """Whether a bundle with joint noise leaves nothing but noise, of readings that are not plainly wrong."""
    if _moved_in_name_only(trials, solution):
        return False
    return (
        components is not None
        and components.significant
        and solution.determined.variance <= EXPLAINED**2
        and float((~inliers).mean()) <= MOST_OUTLIERS
    )


def _moved_in_name_only(trials: TrialData, solution: Solution) -> bool:
    """Whether a joint would be off by much of what it reports to stand apart while another one moves: that is a wrong
    position, no error of a gear.
    """
    errors = solution.data.corrections
    apart = solution.data.offsets - errors
    errors, apart = errors - np.median(errors, axis=0), apart - np.median(apart, axis=0)
    others = trials.trials[:, None] != np.arange(errors.shape[1])
    placed = others & (np.abs(apart) > SAME_READING)
    return bool((placed & (np.abs(errors) > WRONG_SHARE * np.abs(apart))).any())


def one_thing_happened(trials: TrialData, solution: Solution) -> bool:
    """Whether the errors of the joints look like one event: a wrong stop, or a step that lasts."""
    errors = solution.data.corrections
    for joint in range(errors.shape[1]):
        own = errors[trials.trials == joint, joint]
        squares = (own - np.median(own)) ** 2
        if len(own) >= LEAST_STOPS and squares.max() > ONE_STOP * np.quantile(squares, OTHERS):
            return True
    reported = solution.data.corrected(None)
    left = np.full_like(trials.pixels, np.nan)
    left[reported.camera, reported.stop, reported.marker] = reported.pixels - predicted(
        solution.rig, reported
    )
    return find_step(msgspec.structs.replace(trials, pixels=left), ONE_STEP) is not None


def wrong_scales(trials: TrialData, components: VarianceComponents) -> FloatArray:
    """Scale factor (n,) of each joint's reading, 1 where none is significant beside the errors of the joints, or where
    these are as large.

    By Student's distribution of as many freedoms as the joint's errors are known with; false once in
    ``1 / FALSE_ALARM`` fits.
    """
    factors = np.ones(len(trials.joint_names))
    revolute = [j for j, kind in enumerate(trials.joint_kinds) if kind == "revolute"]
    total = np.sqrt(components.random + components.repeatable + components.posture)
    for joint, log, deviation in zip(revolute, components.scales, components.scale_deviations, strict=True):
        own = trials.positions[trials.trials == joint, joint]
        if not len(own):
            continue
        limit = student.isf(FALSE_ALARM / (2 * len(revolute)), max(len(own) - 3, 1))
        moved = abs(log) * float(np.std(own))
        if (
            abs(np.expm1(log)) > LEAST_FACTOR
            and abs(log) > limit * deviation
            and moved > LIKE_OTHERS * float(total[revolute].max())
        ):
            factors[joint] = float(np.exp(log))
    return factors


def refuse_wrong_scales(trials: TrialData, components: VarianceComponents) -> None:
    """Raise ScalesError where scales are wrong beside the errors of the joints."""
    factors = wrong_scales(trials, components)
    if (factors != 1.0).any():
        raise ScalesError(factors, components)


def small_scales(cause: CalibrationError) -> str:
    """What may be instead of wrong scales where gears that give way may report as much, as a note; "" where they
    cannot.
    """
    joints = cause.data.get("joints") if cause.code == "wrong_scale" else None
    if not joints or any(abs(one["factor"] - 1.0) > MOST_GIVEN for one in joints.values()):
        return ""
    listed = ", ".join(
        f"{name!r} reports {one['factor']:.4g} ± {one['deviation']:.1g} times its motion"
        for name, one in joints.items()
    )
    return (
        f"joint {listed}: its drive's scale may be wrong, or it gives way under its load, or turns with the joint "
        "beside it; the trials do not tell which, and the model takes it for an error of the reading. What tells: its "
        "angle by a protractor over its whole range, the arm's weight on and off it"
    )


def scales_error(trials: TrialData, factors: FloatArray, components: VarianceComponents) -> CalibrationError:
    """Error that states the ``factors`` (n,) that differ from 1."""
    revolute = [j for j, kind in enumerate(trials.joint_kinds) if kind == "revolute"]
    deviations = np.zeros(len(factors))
    deviations[revolute] = components.scale_deviations
    found = {
        trials.joint_names[j]: {"factor": float(factors[j]), "deviation": float(deviations[j] * factors[j])}
        for j in np.flatnonzero(factors != 1.0)
    }
    listed = ", ".join(
        f"{name!r} reports {one['factor']:.5g} ± {one['deviation']:.1g} times its motion"
        for name, one in found.items()
    )
    return CalibrationError(
        "wrong_scale",
        f"joint {listed}, beside the errors that its readings and those of the other joints have. Revolute joints must "
        "report radians: correct the drive's scale",
        joints=found,
    )
