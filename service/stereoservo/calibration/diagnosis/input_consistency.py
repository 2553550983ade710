"""Consistency checks of calibration input: whether the stated detector noise is too small, and whether revolute joints
report their angles at a wrong scale.
"""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.input_corrections import (
    InitialViews,
    Refit,
    fit_of_correction,
    solution_of,
)
from stereoservo.calibration.diagnosis.joint_scales import (
    JointScaleEstimate,
    model_scales,
    trial_scales,
    with_scales_removed,
)
from stereoservo.calibration.diagnosis.marker_tracks import path_noise
from stereoservo.calibration.diagnosis.outlier_causes import predictions
from stereoservo.calibration.joint_errors.variance_components import (
    VarianceComponents,
    estimate_components,
    readings,
    reduced_rows,
)
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.numerics.arrays import FloatArray

SUSPICIOUS_OUTLIERS = 0.01
"""Share of outliers from which a fit above the noise floor is looked into."""
DEGREES, ABOUT = float(np.degrees(1.0)), 2.0
"""Factor of a joint that reports degrees, and by what factor, up or down, a coarse factor may be off a true one."""
UNDERSTATED = 1.5
"""How many times the stated sigmas paths must scatter for the detector to be looked into."""
UNEVEN = 1.5
"""Residual of one joint's trial over another's up to which both are one noise."""
NOTABLE = 0.1
"""Share of the largest error of a joint, over its way, from which others are named beside it."""
WHITE = 0.8
"""Noise about smooth paths in what a model leaves, over its residual, from which the residual is noise alone."""


def underestimated_noise(trials: TrialData, refit: Refit, options: FitOptions) -> CalibrationError | None:
    """Error of sigmas that are stated too small, or of joints that stand as much beside their readings; None unless the
    trials fit with the sigmas that the markers' tracks show, and only noise is left.
    """
    scatter = path_noise(trials)
    if not float(scatter.max()) > UNDERSTATED:
        return None
    mended = msgspec.structs.replace(trials, sigmas=trials.sigmas * np.maximum(scatter, 1.0)[:, None])
    result = fit_of_correction(mended, refit, options)
    if result is None:
        return None
    factor = result.report.sigma_factor
    used = result.model.statistics
    assert used is not None
    smooth = float(np.median(path_noise(residual_trials(mended, result)))) < WHITE * factor
    wild = used.outliers > SUSPICIOUS_OUTLIERS * (used.measurements // 2 + used.outliers)
    uneven = max(joint.rms_px for joint in used.joints) > UNEVEN * min(joint.rms_px for joint in used.joints)
    if smooth or wild or uneven:
        return None  # noise is none of these: the model is wrong, or positions or times are
    solution = solution_of(mended, result)
    joints = estimate_components(reduced_rows(solution, readings(solution.data.offsets)), scales=False)
    # What moves all markers of a stop alike is no noise of pixels.
    if (
        joints is not None
        and joints.significant
        and joints.pixels * float(scatter.max()) ** 2 < UNDERSTATED**2
    ):
        return _inexact_joints(trials, joints)
    kept = [trials.marker_ids.index(i) for i in result.model.marker_ids]
    factors = np.maximum(scatter[:, kept], 1.0) * factor
    camera, marker = (int(i) for i in np.unravel_index(factors.argmax(), factors.shape))
    stated = float(np.median(trials.sigmas[camera, :, kept[marker]]))
    worst = float(factors[camera, marker])
    return CalibrationError(
        "noise_understated",
        f"the pixels scatter farther than their stated sigmas: marker {result.model.marker_ids[marker]} in camera "
        f"{trials.cameras[camera].name!r} by {worst * stated:.3g} px, stated {stated:.3g} px ({worst:.3g} times; "
        f"{float(np.median(factors)):.3g} times for half of all; at most {options.max_sigma_factor:g} times is taken). "
        "With sigmas of that size the trials fit: correct the detector's sigma",
        factor=float(np.median(factors)),
        worst=worst,
        maximum=options.max_sigma_factor,
        cameras={one.name: float(np.median(row)) for one, row in zip(trials.cameras, factors, strict=True)},
    )


def _inexact_joints(trials: TrialData, found: VarianceComponents) -> CalibrationError:
    """Error of joints that stand so far beside their readings that no fit starts from these."""
    deviations = np.sqrt(found.random + found.repeatable)
    ways = np.ptp(trials.positions, axis=0)
    listed = ", ".join(
        f"{trials.joint_names[j]!r} by {1e3 * deviations[j]:.2g} {'mrad' if kind == 'revolute' else 'mm'} "
        f"({deviations[j] / ways[j]:.0%} of its way)"
        for j, kind in enumerate(trials.joint_kinds)
        if deviations[j] > NOTABLE * float((deviations / ways).max()) * ways[j]
    )
    return CalibrationError(
        "joints_inexact",
        f"the joints do not stand where they report: joint {listed}, as standard deviations. That is too much beside "
        "their motion for a fit; the pixels scatter as stated",
        joints={name: float(one) for name, one in zip(trials.joint_names, deviations, strict=True)},
    )


def residual_trials(trials: TrialData, result: CalibrationFit) -> TrialData:
    """The trials with the model's residuals in place of the pixels, in which steps stay and smooth tracks vanish."""
    found = predictions(trials, result)
    return msgspec.structs.replace(
        trials,
        marker_ids=found.marker_ids,
        pixels=found.pixels - found.expected,
        sigmas=trials.sigmas[:, :, [trials.marker_ids.index(i) for i in found.marker_ids]],
    )


def scaled_positions(
    trials: TrialData, views: InitialViews, refit: Refit, options: FitOptions
) -> CalibrationError | None:
    """Error of revolute joints whose positions have a wrong scale, if the trials fit without it; else None."""
    factors = trial_scales(trials, *views)
    if (factors == 1.0).all():
        return None
    for tried in _likely_factors(trials, factors):
        mended = with_scales_removed(trials, tried)
        result = fit_of_correction(mended, refit, options)
        if result is not None:
            return scale_error(trials, mended, result, tried)
    return None


def _likely_factors(trials: TrialData, factors: FloatArray) -> list[FloatArray]:
    """Factors (n,) to try, likeliest first: a unit that most revolute joints share, and so perhaps all; degrees;
    the joints' own coarse estimates.
    """
    revolute = np.array([kind == "revolute" for kind in trials.joint_kinds])
    found = []
    for unit in (DEGREES, float(np.median(factors[factors != 1.0]))):
        near = (factors != 1.0) & (np.abs(np.log(factors / unit)) < np.log(ABOUT))
        if 2 * int(near.sum()) > int(revolute.sum()) > 1:
            found.append(np.where(revolute, unit, 1.0))
        if unit == DEGREES and near.any():
            found.append(np.where(near, unit, factors))
    return [*found, factors]


def scale_error(
    trials: TrialData, mended: TrialData, result: CalibrationFit, factors: FloatArray
) -> CalibrationError | None:
    """Error that states wrong scales: ``factors`` (n,) that were divided out, refined with the model of the
    ``mended`` trials; None where none is left.
    """
    found = {}
    for scale in model_scales(solution_of(mended, result)):
        whole = JointScaleEstimate(
            scale.joint, scale.factor * factors[scale.joint], scale.deviation * factors[scale.joint]
        )
        if whole.wrong:
            found[trials.joint_names[scale.joint]] = whole
    if not found:
        return None
    listed = ", ".join(
        f"{name!r} reports {scale.factor:.5g} ± {scale.deviation:.1g} times its motion"
        + (" (degrees, not radians)" if abs(np.degrees(1.0) / scale.factor - 1.0) < 0.02 else "")
        for name, scale in found.items()
    )
    return CalibrationError(
        "wrong_scale",
        f"joint {listed}. Revolute joints must report radians: correct the drive's scale",
        joints={
            name: {"factor": scale.factor, "deviation": scale.deviation} for name, scale in found.items()
        },
    )
