"""Diagnosis of a failed calibration, naming its cause (exchanged views or ids, wrong joint kind, order or scale, …)
where it can be identified; and notes on a fit that succeeded.

Each cause corresponds to a correction of the trials: with the views of some stops exchanged back, two ids exchanged, an
angle divided by a factor, the fit must succeed, or the cause is not reported.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np

from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.input_corrections import (
    Refit,
    exchange_hypotheses,
    exchanged_ids,
    fit_of_correction,
    ids_exchanged,
    kind_hypotheses,
    order_hypotheses,
    pinhole_reconstruction,
    plane_or_baseline,
    solution_of,
    views_unrelated,
)
from stereoservo.calibration.diagnosis.joint_scales import prismatic_ratios
from stereoservo.calibration.diagnosis.marker_tracks import find_step, path_noise, paths_are_smooth
from stereoservo.calibration.diagnosis.outlier_causes import (
    SUSPICIOUS_OUTLIERS,
    camera_moved,
    explain_outliers,
    marker_slipped,
    moved_part,
    moved_together,
    predictions,
    residual_trials,
    scale_error,
    scaled_positions,
    solution_with_all_pixels,
    underestimated_noise,
)
from stereoservo.calibration.lens_estimation import lenses_explain_more
from stereoservo.calibration.single_joint_fit import MIN_SHOWN
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.homogeneous import GeometryError

PLAIN = frozenset(
    {
        "bad_data",
        "too_few_cameras",
        "mixed_mounts",
        "joint_did_not_move",
    }
)
"""Codes that already name the cause."""
STEPS_IMITATE = frozenset({"joint_without_effect", "lens_implausible"})
"""Codes that a step of the pixels imitates: as noise that hides a joint's motion, or by a lens that adapts to it."""
MISMATCH = frozenset({"joint_kind", "views_degenerate", "no_convergence", "too_many_outliers", "residual_above_floor"})
"""Codes of contradictory data: the misfit may show the cause."""
LASTING = frozenset({"camera_moved", "marker_slipped", "moved_together", "camera_or_body_moved", "markers_disagree"})
"""Codes of lasting changes during the trials."""
LENIENT_OUTLIERS, LENIENT_TRIAL_OUTLIERS = 0.6, 0.85
"""Limits of outliers of the lenient fit that is used to explain them."""

MOVED_FRACTION = 0.1
"""Distance of a joint from its median, relative to its range over the trials, from which it counts as displaced."""
LEAST_TOGETHER = 4
"""Number of stops with several displaced joints that is sufficient to test their combined effect."""
MOVED = 0.02
"""Distance of the trials' bases [rad or m] from which they count as different configurations."""


def diagnose_failure(
    trials: TrialData,
    error: CalibrationError,
    refit: Refit,
    options: FitOptions,
    result: CalibrationFit | None = None,
) -> CalibrationError:
    """Error that names the cause of ``error``; else ``error`` itself with a list of possible causes.

    ``refit`` fits trial data again. Hypotheses are tried until one makes the data fit, which takes several fits.
    ``result``: the fit that was refused for its lens.
    """
    if error.code in STEPS_IMITATE:
        return _step_error(trials, result) or error
    if error.code in PLAIN:
        return error
    if error.code == "views_degenerate" and "rms_px" in error.data:
        return plane_or_baseline(trials, error)
    try:
        named = _first_cause(trials, refit, options)
    except (GeometryError, np.linalg.LinAlgError):
        named = None  # the search for a cause fails, too: the first error is returned
    if named is not None and named.code == "noise_understated":
        # The measured residual of each joint remains informative.
        return CalibrationError(named.code, named.message, **{**error.data, **named.data})
    if named is not None:
        return named
    if error.code == "too_few_stops" and error.data.get("markers_lost", 0):
        return _contradiction_error(trials, error)
    return _outlier_error(trials, error, refit, options) if error.code in MISMATCH else error


def _first_cause(
    trials: TrialData, refit: Refit, options: FitOptions, result: CalibrationFit | None = None
) -> CalibrationError | None:
    """Error of the first cause that holds, cheap tests first. ``result``: the fit, if there is one."""
    for hypothesis in exchange_hypotheses(trials):
        if fit_of_correction(hypothesis.trials, refit, options) is not None:
            return CalibrationError(hypothesis.code, hypothesis.message, **hypothesis.data)
    stepped = _step_error(trials, result)
    if stepped is not None:
        return stepped
    noisier = underestimated_noise(trials, refit, options)
    if noisier is not None:
        return noisier
    if paths_are_smooth(trials):
        noise = np.maximum(path_noise(trials), 1.0)
        noisy = msgspec.structs.replace(trials, sigmas=trials.sigmas * noise[:, None])
        for k in range(1, len(trials.cameras)):
            if views_unrelated(noisy, k):
                return _unrelated(trials, k)
    try:
        views = pinhole_reconstruction(trials)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None  # without cameras no joint can be tested
    for hypothesis in kind_hypotheses(trials, views):
        if fit_of_correction(hypothesis.trials, refit, options) is not None:
            return CalibrationError(hypothesis.code, hypothesis.message, **hypothesis.data)
    scaled = scaled_positions(trials, views, refit, options)
    if scaled is not None:
        return scaled
    for hypothesis in order_hypotheses(trials, refit, options):
        if fit_of_correction(hypothesis.trials, refit, options) is not None:
            return CalibrationError(hypothesis.code, hypothesis.message, **hypothesis.data)
    return None


def _step_error(trials: TrialData, result: CalibrationFit | None = None) -> CalibrationError | None:
    """Error for a step in the markers' tracks, or in the residuals of a fit; None if there is none."""
    left = trials if result is None else residual_trials(trials, result)
    step = find_step(left)
    if step is None:
        return None
    if result is not None and len(step.markers) == len(left.marker_ids):
        return moved_part(trials, solution_with_all_pixels(trials, result), step.stop)
    if len(step.cameras) < len(trials.cameras):
        return camera_moved(trials, step.cameras[0], step.stop)
    if len(step.markers) < len(left.marker_ids):
        return marker_slipped(left.marker_ids[step.markers[0]], step.stop)
    return moved_together(step.stop)


def _outlier_error(trials: TrialData, error: CalibrationError, refit: Refit, options: FitOptions) -> CalibrationError:
    """Error naming the common property of a lenient fit's outliers, or with a list of possible causes."""
    lenient = replace(options, max_outliers=LENIENT_OUTLIERS, max_trial_outliers=LENIENT_TRIAL_OUTLIERS)
    try:
        result = refit(trials, lenient)
        notes = explain_outliers(trials, result)
    except CalibrationError as other:
        if other.code in LASTING:
            return other
        notes = ()
    except (GeometryError, np.linalg.LinAlgError):
        notes = ()
    if notes:
        return CalibrationError(
            error.code, f"{error.message}. Found: {'; '.join(notes)}", **error.data, causes=list(notes)
        )
    return CalibrationError(
        error.code,
        f"{error.message}. Not distinguished: positions reported wrongly or at another time than the images, play, "
        "a camera or marker that moved more than once, many wrong detections",
        **error.data,
    )


def _unrelated(trials: TrialData, k: int) -> CalibrationError:
    names = [trials.cameras[0].name, trials.cameras[k].name]
    return CalibrationError(
        "views_unrelated",
        f"cameras {names[0]!r} and {names[1]!r} agree on no epipolar geometry, not even within single trials: they do "
        "not see the same markers at the same time. Do they see two arms, are ids mixed up, are images late?",
        cameras=names,
    )


def _contradiction_error(trials: TrialData, error: CalibrationError) -> CalibrationError:
    """Error for a joint whose stops are lost because the cameras contradict each other, not for lack of
    observations.
    """
    own = trials.trials == trials.joint_names.index(error.data["joint"])
    seen = int(((trials.visible[:, own].sum(axis=0) >= 2).sum(axis=1) >= MIN_SHOWN).sum())
    if seen < error.data["minimum"]:
        return error
    return CalibrationError(
        "views_unrelated",
        f"{error.message}. At {seen} stops two cameras do see {MIN_SHOWN} markers or more, but they fit no epipolar "
        "geometry with the rest: are images of one camera late, are ids mixed up, did a camera move more than once?",
        **error.data,
        markers_seen=seen,
    )


def review_notes(trials: TrialData, result: CalibrationFit, refit: Refit, options: FitOptions) -> tuple[str, ...]:
    """Notes on a fit that succeeded: causes of its outliers, prismatic joints whose scales disagree.

    Raises CalibrationError if the model describes an outdated cell (a camera or marker moved), if two ids are
    exchanged throughout, or if revolute joints report wrong scales.
    """
    statistics = result.model.statistics
    assert statistics is not None
    outliers = predictions(trials, result).outliers
    if result.report.markers_left_out or (outliers.mean(axis=1) > 0.5).any():
        for k in range(1, len(trials.cameras)):
            pair = exchanged_ids(trials, k)
            if pair is not None:
                found = ids_exchanged(trials, k, pair)
                raise CalibrationError(found.code, found.message, **found.data)
    notes = list(explain_outliers(trials, result))
    if not statistics.chi2_ok:
        suspicious = float(outliers.mean()) > SUSPICIOUS_OUTLIERS
        named = _first_cause(trials, refit, options, result) if suspicious else _step_error(trials, result)
        if named is not None:
            raise named
    nearly = not statistics.chi2_ok or any("follow" in note for note in result.report.notes)
    # Distortion that was excluded bends the tracks of revolute joints like a wrong scale.
    bent = result.report.lens.model == "none" and result.report.lens.chi2 > result.report.lens.limit
    if nearly and not bent:
        wrong = scale_error(trials, trials, result, np.ones(len(trials.joint_names)))
        if wrong is not None and not lenses_explain_more(solution_of(trials, result)):
            raise wrong
        if wrong is not None:
            notes.append(
                "the lenses distort in a way that a radial parameter with its centre does not follow; scales of joints "
                "would explain less of what is left. Undistort the images before the detector, or use other lenses"
            )
    if trials.joint_kinds.count("prismatic") > 1:
        for ratio in prismatic_ratios(result, solution_of(trials, result)):
            if ratio.wrong:
                first = trials.joint_names[trials.joint_kinds.index("prismatic")]
                notes.append(
                    f"joint {trials.joint_names[ratio.joint]!r} reports {ratio.factor:.5g} ± {ratio.deviation:.1g} "
                    f"times what joint {first!r} does for equal travel: check the drives' scales. The model absorbs it"
                )
    return tuple(notes)


def untested_properties(trials: TrialData) -> tuple[str, ...]:
    """Notes on properties that the trials do not determine: combined effects of the joints, and their order, if they
    only move one at a time, from one configuration.
    """
    n = len(trials.joint_names)
    displaced = np.abs(trials.positions - np.median(trials.positions, axis=0)) > MOVED_FRACTION * np.ptp(
        trials.positions, axis=0
    )
    together = int(((trials.trials < 0) & (displaced.sum(axis=1) > 1)).sum())
    bases = [np.median(trials.positions[trials.trials == j], axis=0) for j in range(n) if (trials.trials == j).any()]
    moved = bool(bases) and float(np.ptp(np.array(bases), axis=0).max(initial=0.0)) > MOVED
    if n < 2 or together >= LEAST_TOGETHER or moved:
        return ()
    return (
        "the order of the joints, the mount of the cameras, and errors that depend on several joints (sag, joints that "
        "turn with others): joints move one at a time from one configuration. Stops of all joints "
        "(calibration.together), or trials from different configurations, would test it",
    )
