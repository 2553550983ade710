"""Bundle adjustment with outlier rejection: a robust start, then alternating gating and solving; and rejection of bad
bundles: too many outliers, residuals above the noise, directions that the trials leave undetermined.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.joint_noise import stop_rows
from stereoservo.calibration.least_squares import RobustLoss
from stereoservo.calibration.lens_estimation import FREE_LENS, lens_test, required_lens_model, with_pinhole_cameras
from stereoservo.calibration.normal_equations import by_stop
from stereoservo.calibration.rig_model import JointErrors, Measurements, RigModel, residuals
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.kinematics.model import Stratum
from stereoservo.kinematics.parameterization import LensModel
from stereoservo.numerics.arrays import BoolArray

FEW_OUTLIERS = 0.05
"""Share of outliers that may still change in an unconverged bundle."""
LIKELY = 5.0
"""Largest error of a joint, in its standard deviations, that may explain a stop's outliers."""


def projective_bundle(
    rig: RigModel,
    clean: Measurements,
    every: Measurements,
    lenses: LensModel,
    options: FitOptions,
    decided: bool,
) -> tuple[Solution, BoolArray]:
    """Projective bundle on its inliers; unless ``decided``, with the lens model that the data require."""
    robust = solve(rig, clean, "projective", lenses=lenses, loss=RobustLoss("soft_l1", 2.0), tolerance=1e-4)
    for _ in range(2 if options.lens == "auto" else 0):
        # Before any outlier is rejected: distortion makes many of them.
        here = every.corrected(robust.data.joint_errors)
        inside = here.select(inlier_mask(robust.rig, here, options))
        required = required_lens_model(solve(robust.rig, inside, "projective", lenses=lenses, max_evaluations=1))
        if required == lenses:
            break
        lenses = required
        robust = solve(robust.rig, clean, "projective", lenses=lenses, loss=RobustLoss("soft_l1", 2.0), tolerance=1e-4)
    # With a planar target the projective bundle may have undetermined directions that the metric one determines:
    # no need to iterate along them here.
    every = every.corrected(robust.data.joint_errors)
    solution, inliers = refine_to_convergence(robust.rig, every, "projective", options, lenses, 1e-6)
    if decided or lens_test(solution).distorted == (lenses != "none"):
        return solution, inliers
    if lenses == "none":
        return refine_to_convergence(solution.rig, every, "projective", options, FREE_LENS, 1e-6)
    return refine_to_convergence(with_pinhole_cameras(solution.rig, every), every, "projective", options, "none", 1e-6)


def refine_to_convergence(
    rig: RigModel,
    every: Measurements,
    stratum: Stratum,
    options: FitOptions,
    lenses: LensModel,
    tolerance: float = 1e-10,
    inliers: BoolArray | None = None,
) -> tuple[Solution, BoolArray]:
    """Least-squares bundle and its inliers (k,): gating and solving alternate until the inliers stay the same, starting
    from ``inliers``, or those of ``rig``.

    The caller must check whether the last solution has converged. Raises CalibrationError (``no_convergence``).
    """
    if inliers is None:
        inliers = inlier_mask(rig, every, options)
    for _ in range(8):
        solution = solve(rig, every.select(inliers), stratum, lenses=lenses, tolerance=tolerance)
        every = every.corrected(_joint_errors(solution, every, inliers))
        again = inlier_mask(solution.rig, every, options)
        rig = solution.rig
        if np.array_equal(again, inliers):
            break
        inliers = again
    else:
        if not solution.converged and float((~inliers).mean()) <= FEW_OUTLIERS:
            # A projective bundle that still moves along an undetermined direction: a higher stratum may determine it.
            # Convergence of the last solution is checked at the end.
            return solution, inliers
        raise CalibrationError(
            "no_convergence",
            f"the set of outliers does not settle: {int((~inliers).sum())} of {len(inliers)} pixels in the "
            "last round. Did a camera move, are positions wrong?",
            outliers=int((~inliers).sum()),
            pixels=len(inliers),
        )
    return solution, inliers


def with_whole_stops(every: Measurements, inliers: BoolArray) -> BoolArray:
    """Inliers (k,), with all pixels of those stops of which most were left out: errors of the joints, once they are
    estimated better, may explain them.
    """
    lost = np.bincount(every.stop, weights=~inliers) > 0.5 * np.bincount(every.stop)
    return np.asarray(inliers | lost[every.stop])


def _joint_errors(solution: Solution, every: Measurements, inliers: BoolArray) -> JointErrors | None:
    """Joint errors of a solution, extended by likely ones that explain stops whose pixels are all outliers."""
    noise, errors = every.joint_noise, solution.data.joint_errors
    left = np.setdiff1d(every.stop, every.stop[inliers])
    if noise is None or errors is None or not len(left):
        return errors
    lost, _ = by_stop(every.corrected(errors).select(np.isin(every.stop, left)))
    own = errors.own.copy()
    for one in stop_rows(solution.rig, solution.charts, lost):
        present = one.rows[:, -1] + one.joints @ lost.corrections[one.stop]
        slopes = one.joints * noise.own[one.stop]
        found = own[one.stop] - np.linalg.solve(np.eye(len(own[0])) + slopes.T @ slopes, slopes.T @ present)
        if np.abs(found).max() < LIKELY:
            own[one.stop] = found
    return replace(errors, own=own)


def inlier_mask(rig: RigModel, every: Measurements, options: FitOptions) -> BoolArray:
    """Mask (k,) of the pixels that fit the rig, by squared distance, with the noise estimated from the median."""
    squares = (residuals(rig, every).reshape(-1, 2) ** 2).sum(axis=1)
    # The median of a chi-square with two degrees of freedom is ln 4.
    factor = max(1.0, float(np.median(squares)) / np.log(4.0))
    inside: BoolArray = squares <= options.outlier_chi2 * factor
    return inside


VALLEY_VARIANCE = 1.5
"""Variance factor up to which an unconverged bundle has a flat cost: a direction is undetermined."""


def refuse_poor_fit(
    trials: TrialData, solution: Solution, every: Measurements, inliers: BoolArray, options: FitOptions
) -> None:
    """Raise CalibrationError for a bundle with too many outliers, or with residuals above the noise of the pixels."""
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
    if solution.statistics.freedom <= 0:
        raise CalibrationError(
            "too_few_stops",
            f"{solution.rows} measurements for {solution.charts.size} parameters; more stops or markers are needed",
            measurements=solution.rows,
            parameters=solution.charts.size,
        )
    factor = float(np.sqrt(solution.statistics.variance))
    if factor > options.max_sigma_factor:
        squares = (residuals(solution.rig, data).reshape(-1, 2) ** 2).sum(axis=1)
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
    """Raise CalibrationError for a final bundle that has undetermined directions or has not converged."""
    rank = solution.statistics.rank
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
    factor = solution.statistics.variance
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
