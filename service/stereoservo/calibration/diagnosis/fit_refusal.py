"""Refusal of bundles: too many outliers, residuals above the noise, directions that the trials leave open."""

from __future__ import annotations

import numpy as np

from stereoservo.calibration.bundle_adjustment import Solution
from stereoservo.calibration.rig_model import Measurements
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.numerics.arrays import BoolArray

VALLEY_VARIANCE = 1.5
"""Variance factor up to which an unconverged bundle lies in a flat valley of its cost: a direction is undetermined."""


def refuse_poor_fit(
    trials: TrialData, solution: Solution, every: Measurements, inliers: BoolArray, options: FitOptions
) -> None:
    """Raise CalibrationError for a bundle that leaves out too many pixels, or more than their noise explains."""
    share = float((~inliers).mean())
    if share > options.max_outliers:
        raise CalibrationError(
            "too_many_outliers",
            f"{share:.0%} of the pixels do not fit the {solution.stratum} model; at most "
            f"{options.max_outliers:.0%} may",
            share=share,
            maximum=options.max_outliers,
        )
    for j, name in enumerate(trials.joint_names):
        own = trials.trials[every.stop] == j
        lost = float((~inliers[own]).mean()) if own.any() else 0.0
        if lost > options.max_trial_outliers:
            raise CalibrationError(
                "too_many_outliers",
                f"{lost:.0%} of the pixels of joint {name!r}'s trial do not fit the {solution.stratum} "
                f"model; at most {options.max_trial_outliers:.0%} may. Are its positions right, did only "
                "it move?",
                joint=name,
                share=lost,
                maximum=options.max_trial_outliers,
            )
    data = every.select(inliers)
    if solution.determined.freedom <= 0:
        raise CalibrationError(
            "too_few_stops",
            f"{solution.rows} measurements for {solution.charts.size} parameters; more stops or "
            "markers are needed",
            measurements=solution.rows,
            parameters=solution.charts.size,
        )
    factor = float(np.sqrt(solution.determined.variance))
    if factor > options.max_sigma_factor:
        squares = (solution.residuals.reshape(-1, 2) ** 2).sum(axis=1)
        of_stop = trials.trials[data.stop]
        per_joint = {
            name: float(np.sqrt(squares[of_stop == j].mean() / 2))
            for j, name in enumerate(trials.joint_names)
            if (of_stop == j).any()
        }
        worst = max(per_joint, key=lambda name: per_joint[name])
        raise CalibrationError(
            "residual_above_floor",
            f"residuals are {factor:.3g} times the stated sigmas; at most {options.max_sigma_factor:g} "
            f"allowed. Worst is joint {worst!r} ({per_joint[worst]:.3g})",
            sigma_factor=factor,
            maximum=options.max_sigma_factor,
            joints=per_joint,
        )


def refuse_undetermined(solution: Solution, notes: tuple[str, ...]) -> None:
    """Raise CalibrationError for a final bundle that has undetermined directions, or has not converged."""
    rank = solution.determined.rank
    because = f" ({'; '.join(notes)})" if notes else ""
    if rank < solution.charts.size:
        raise CalibrationError(
            "not_identifiable",
            f"the trials determine {rank} of {solution.charts.size} parameters of the {solution.stratum} "
            f"model{because}; markers off one plane, more stops or larger motions are needed",
            rank=rank,
            parameters=solution.charts.size,
            notes=notes,
        )
    if solution.converged:
        return
    factor = solution.determined.variance
    if factor < VALLEY_VARIANCE:
        raise CalibrationError(
            "not_identifiable",
            f"the {solution.stratum} model fits, but the trials leave a direction of it open{because}; markers "
            "off one plane, more stops or larger motions are needed",
            stratum=solution.stratum,
            notes=notes,
        )
    raise CalibrationError(
        "no_convergence",
        f"the {solution.stratum} bundle did not converge in {solution.evaluations} evaluations{because}; "
        f"residual {np.sqrt(factor):.3g} sigmas",
        stratum=solution.stratum,
        evaluations=solution.evaluations,
        notes=notes,
    )
