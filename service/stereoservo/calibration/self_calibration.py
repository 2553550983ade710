"""Self-calibration of a cell from its trial data, pixels and joint readings, to a model of arm, cameras and markers
(thesis 5.4).

Stages: initial reconstruction, single-joint fits, linked joints, projective bundle adjustment, stratum selection.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.bundle_inliers import (
    projective_bundle,
    refine_to_convergence,
    refuse_poor_fit,
    refuse_undetermined,
    with_whole_stops,
)
from stereoservo.calibration.calibration_result import (
    CalibrationFit,
    FitHistory,
    ModelFrame,
    build_fit,
    completed,
)
from stereoservo.calibration.diagnosis.failure_diagnosis import diagnose_failure, review_notes, untested_properties
from stereoservo.calibration.diagnosis.input_corrections import Refit
from stereoservo.calibration.diagnosis.joint_scales import (
    ScalesError,
    explains,
    is_single_event,
    refuse_wrong_scales,
    scales_error,
    small_scales,
    with_scales_removed,
)
from stereoservo.calibration.diagnosis.marker_tracks import check_motions
from stereoservo.calibration.initial_reconstruction import initial_reconstruction
from stereoservo.calibration.known_arm import fit_with_known_arm
from stereoservo.calibration.least_squares import RobustLoss, chi2_within
from stereoservo.calibration.lens_estimation import (
    FREE_LENS,
    FULL_LENS,
    INITIAL_DISTORTIONS,
    distortion_is_possible,
    implausible_lens,
    prior_of_lenses,
    required_lens_model,
    starting_lenses,
    undistorted,
)
from stereoservo.calibration.rig_model import (
    JointNoise,
    Measurements,
    common_mount,
    reversed_trials,
    with_joints_reversed,
)
from stereoservo.calibration.single_joint_fit import (
    fit_single_joint,
    link_joints,
    measurements,
    without_rare_markers,
)
from stereoservo.calibration.stratum_selection import DEFAULTS, FitOptions, StratumSelection, select_stratum
from stereoservo.calibration.trial_data import CalibrationError, TrialData, check_trials
from stereoservo.calibration.variance_components import (
    ReducedRows,
    VarianceComponents,
    estimate_components,
    likely_errors,
    readings,
    reduced_rows,
)
from stereoservo.geometry.distortion import LensEstimate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.parameterization import LensModel
from stereoservo.numerics.arrays import BoolArray, FloatArray

Progress = Callable[[str, float], None]


OF_LENSES = frozenset({"wrong_scale", "joint_kind", "joint_order", "lens_implausible"})
"""Causes that an undetected lens imitates: fits from other initial lenses are tried before they are reported."""
OF_JOINT_ERRORS = frozenset({"joint_kind", "joint_without_effect", "too_few_markers", "too_few_stops"})
"""Causes of single-joint failures that errors of the readings imitate."""
WILD = 100.0
"""Squared residual of the linked joints, over the median, from which a pixel counts as wrong."""
SCALE_ROUNDS = 3
"""Most rounds of removing scales from the readings and estimating them again."""


def fit_model(
    trials: TrialData,
    *,
    epoch: int,
    created: str = "",
    progress: Progress | None = None,
    options: FitOptions = DEFAULTS,
    lens_priors: Mapping[str, LensEstimate] | None = None,
) -> CalibrationFit:
    """Model of a cell fitted to its trial motions, with a report of the fit.

    Cameras are all static (eye-to-hand) or all on the tip (eye-in-hand); the model records which, and its
    joints start at the base in both cases. Static markers become the model's static points. Trials with known
    generators (`trials_of_poses`: poses in place of joints) may have any motion. ``lens_priors``: by camera name, an
    estimate of its lens from straight lines (`geometry.distortion.lens_from_lines`).

    ``progress(stage, fraction)`` is called during the fit. Raises CalibrationError with the cause if
    the data give no model, or one with residuals of more than ``options.max_sigma_factor`` sigmas.
    Between that and the noise floor ``chi2_ok`` is false and the report's notes state what is known.
    """
    check_trials(trials)
    mount = common_mount(trials)
    priors = lens_priors or {}
    if trials.generators is not None:
        known = fit_with_known_arm(trials, options, priors, epoch=epoch, created=created)
        return completed(known, trials)
    chain = trials if mount == "eye_to_hand" else reversed_trials(trials)

    def fit(data: TrialData, chosen: FitOptions, joint_errors: JointErrorModel = "none") -> _Fitted:
        return _fit(data, epoch, created, progress or _silent, chosen, priors, None, joint_errors)

    def refit(data: TrialData, chosen: FitOptions) -> CalibrationFit:
        return _fit(data, epoch, created, _silent, chosen, priors).fit

    check_motions(chain)

    def others() -> CalibrationFit | None:
        return _from_other_lenses(chain, epoch, created, options)

    try:
        result, notes = _chosen_fit(chain, options, priors, fit, refit, others)
    except CalibrationError as cause:
        note = small_scales(cause)
        absorbed = _absorbed(lambda: fit(chain, options, "scales too")) if note else None
        if absorbed is None:
            raise
        result, notes = absorbed, (note, *review_notes(chain, absorbed, refit, options))
    model = result.model if mount == "eye_to_hand" else with_joints_reversed(result.model)
    report = msgspec.structs.replace(
        result.report, notes=(*result.report.notes, *notes), untested=untested_properties(chain)
    )
    return completed(CalibrationFit(model, report), trials)


def _chosen_fit(
    chain: TrialData,
    options: FitOptions,
    priors: Mapping[str, LensEstimate],
    fit: _FitOfTrials,
    refit: Refit,
    others: Callable[[], CalibrationFit | None],
) -> tuple[CalibrationFit, tuple[str, ...]]:
    """The fit with or without errors of the joint readings, whichever explains the data, with notes. Raises
    CalibrationError with the cause if neither does.
    """
    first, noisy = _first_fit(chain, options, fit)
    if noisy is not None and not noisy.doubtful:
        return noisy.fit, review_notes(chain, noisy.fit, refit, options)
    try:
        result, notes = _with_exact_joints(chain, options, priors, first, refit, others)
    except CalibrationError:
        if noisy is None:
            raise
        return noisy.fit, ()
    statistics = result.model.statistics
    if noisy is not None and statistics is not None and not statistics.chi2_ok:
        return noisy.fit, review_notes(chain, noisy.fit, refit, options)
    return result, notes


def _absorbed(fit: Callable[[], _Fitted]) -> CalibrationFit | None:
    """A fit with joint reading errors that may include small scale factors; None if it does not explain the data, or
    the errors look like one event.
    """
    try:
        fitted = fit()
    except (_JointErrorsError, CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None
    return fitted.fit if fitted.joint_errors and not fitted.doubtful else None


class _Fitted(NamedTuple):
    """A fit, whether its joint readings have errors, and whether these look like a single event (``doubtful``)."""

    fit: CalibrationFit
    joint_errors: bool = False
    doubtful: bool = False


class _JointErrorsError(Exception):
    """Errors of the joint readings were assumed to explain the data, but do not."""


JointErrorModel = Literal["none", "at most likely", "beside scales", "scales too"]
"""Assumption about joint readings: exact; exact, with a statement of likely errors; with errors, unless scales of the
joints explain the data better; with errors that may include scales."""

_FitOfTrials = Callable[[TrialData, FitOptions, JointErrorModel], _Fitted]


def _first_fit(
    chain: TrialData, options: FitOptions, fit: _FitOfTrials
) -> tuple[Callable[[], CalibrationFit], _Fitted | None]:
    """A function that returns the fit with exact joint readings, and the fit with errors of these, if they explain
    the data.

    Raises CalibrationError (``wrong_scale``) for scales that are wrong beside such errors.
    """

    def exact() -> CalibrationFit:
        return fit(chain, options, "at most likely").fit

    try:
        tried = fit(chain, options, "beside scales")
    except _JointErrorsError:
        return exact, None
    except ScalesError as wrong:
        return _decided_by_scales(chain, wrong, exact, lambda data: fit(data, options, "beside scales")), None
    except (CalibrationError, GeometryError, np.linalg.LinAlgError) as error:
        failure = error

        def failed() -> CalibrationFit:
            raise failure

        return failed, None
    return (exact, tried) if tried.joint_errors else (lambda: tried.fit, None)


def _decided_by_scales(
    chain: TrialData,
    wrong: ScalesError,
    exact: Callable[[], CalibrationFit],
    fit: Callable[[TrialData], _Fitted],
) -> Callable[[], CalibrationFit]:
    """A function that returns the fit with ``exact`` joint readings. Raises CalibrationError (``wrong_scale``) if the
    trials fit to the noise with the scales removed, but not with exact readings.
    """
    factors, components = wrong.factors, wrong.components
    for _ in range(SCALE_ROUNDS):
        try:
            mended = fit(with_scales_removed(chain, factors)).fit
            break
        except ScalesError as more:
            factors, components = factors * more.factors, more.components
        except (_JointErrorsError, CalibrationError, GeometryError, np.linalg.LinAlgError):
            return exact
    else:
        return exact
    statistics = mended.model.statistics
    if statistics is None or not statistics.chi2_ok or (factors == 1.0).all():
        return exact
    try:
        plain = exact()
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        raise scales_error(chain, factors, components) from wrong
    if plain.model.statistics is not None and plain.model.statistics.chi2_ok:
        return lambda: plain
    raise scales_error(chain, factors, components) from wrong


def _with_exact_joints(
    chain: TrialData,
    options: FitOptions,
    priors: Mapping[str, LensEstimate],
    first: Callable[[], CalibrationFit],
    refit: Refit,
    others: Callable[[], CalibrationFit | None],
) -> tuple[CalibrationFit, tuple[str, ...]]:
    """The ``first`` fit, or one from ``others`` (different initial lenses), with notes. Raises CalibrationError with
    the cause if there is none.
    """

    def otherwise(cause: CalibrationError, refused: CalibrationFit | None = None) -> CalibrationFit:
        """The fit from other lenses if one explains the data; else raises the cause, of a ``refused`` fit too."""
        free = options.lens in ("auto", FREE_LENS) and not priors and cause.code in OF_LENSES
        bent = free and (cause.code == "lens_implausible" or distortion_is_possible(chain))
        found = others() if bent else None
        if found is None:
            raise cause if refused is None else diagnose_failure(chain, cause, refit, options, refused)
        return found

    try:
        result = first()
    except CalibrationError as error:
        result = otherwise(diagnose_failure(chain, error, refit, options))
    except (GeometryError, np.linalg.LinAlgError) as error:
        broken = CalibrationError(
            "no_convergence",
            f"the fit broke down: {error}. Are positions and markers what they are said to be?",
        )
        result = otherwise(diagnose_failure(chain, broken, refit, options))
    implausible = implausible_lens(result)
    if implausible is not None:
        result = otherwise(implausible, result)
    try:
        notes = review_notes(chain, result, refit, options)
    except CalibrationError as cause:
        result = otherwise(cause)
        notes = review_notes(chain, result, refit, options)
    return result, notes


class _Start(NamedTuple):
    """Trials without rare markers, the linked joints, all measurements and the ``clean`` ones among them, and whether
    the lens model is ``decided`` in advance.
    """

    trials: TrialData
    zero: FloatArray
    linked: Solution
    every: Measurements
    clean: Measurements
    lenses: LensModel
    decided: bool
    markers_left_out: tuple[int, ...]

    def with_joint_noise(self, noise: JointNoise) -> _Start:
        """The same start with noise of the joint readings."""
        return self._replace(every=self.every.with_joint_noise(noise), clean=self.clean.with_joint_noise(noise))


class _Bundles(NamedTuple):
    """The ``projective`` bundle, the bundle ``raised`` to its stratum, the ``final`` one and its inliers (k,)."""

    projective: Solution
    raised: StratumSelection
    final: Solution
    inliers: BoolArray


def _fit(
    trials: TrialData,
    epoch: int,
    created: str,
    report_progress: Progress,
    options: FitOptions,
    priors: Mapping[str, LensEstimate],
    bend: float | None = None,
    joint_errors: JointErrorModel = "none",
) -> _Fitted:
    """Model and report by the stages of this module; ``bend``: initial radial parameter of all lenses;
    ``joint_errors``: permitted errors of the joint readings, if the data show them.

    Raises CalibrationError, and, if joint readings have errors, _JointErrorsError, ScalesError.
    """
    try:
        start, inexact = _start(trials, report_progress, options, priors, bend), False
    except CalibrationError as error:
        if joint_errors in ("none", "at most likely") or error.code not in OF_JOINT_ERRORS:
            raise
        start, inexact = _inexact_start(trials, report_progress, options, priors, bend, error), True
    components, doubtful, chance = None, False, 0.0
    beside_scales, proven = joint_errors == "beside scales", joint_errors not in ("none", "at most likely")
    found = _components_at_start(start, beside_scales) if proven else None
    if inexact and found is None:
        raise _JointErrorsError
    if found is not None:
        start, bundles, components, doubtful = _bundles_with_joint_errors(
            start, found, report_progress, options, beside_scales
        )
    else:
        bundles = _bundles(start, report_progress, options)
        if joint_errors != "none":
            rows = _reduced_rows(start, bundles.final)
            refined = None
            if proven:
                refined = _refined_by_joint_errors(start, bundles, options, rows, beside_scales=beside_scales)
            if refined is not None:
                start, bundles, components, doubtful = refined
            elif chi2_within(bundles.final.cost, bundles.final.statistics.freedom):
                components, chance = likely_errors(rows)
    report_progress("report", 0.95)
    result = build_fit(
        start.trials,
        bundles.final,
        start.every,
        bundles.inliers,
        ModelFrame(start.zero, bundles.raised.plane),
        FitHistory(
            (bundles.projective.cost, bundles.projective.statistics.freedom),
            bundles.raised.notes,
            start.markers_left_out,
        ),
        epoch=epoch,
        created=created,
        components=components,
        exact_joints_chance=chance,
    )
    report_progress("done", 1.0)
    return _Fitted(result, components is not None and not chance, doubtful)


def _inexact_start(
    trials: TrialData,
    report_progress: Progress,
    options: FitOptions,
    priors: Mapping[str, LensEstimate],
    bend: float | None,
    strict: CalibrationError,
) -> _Start:
    """The start from joints whose readings have errors. Raises ``strict`` if there is none either."""
    try:
        return _start(trials, report_progress, options, priors, bend, inexact=True)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        raise strict from None


def _start(
    trials: TrialData,
    report_progress: Progress,
    options: FitOptions,
    priors: Mapping[str, LensEstimate],
    bend: float | None,
    *,
    inexact: bool = False,
) -> _Start:
    """Initial reconstruction, single-joint fits and linked joints; ``inexact``: from readings that may have errors.
    Raises CalibrationError.
    """
    report_progress("cameras", 0.0)
    lenses, lens_model = starting_lenses(trials, options.lens, priors, bend)
    cameras, points, usable = initial_reconstruction(undistorted(trials, lenses))
    trials, points, usable, left_out = without_rare_markers(trials, points, usable)
    ideal = undistorted(trials, lenses)
    separate = []
    for j, name in enumerate(trials.joint_names):
        report_progress(f"joint {name}", 0.1 + 0.4 * j / len(trials.joint_names))
        separate.append(fit_single_joint(ideal, cameras, points, usable, j, inexact=inexact))
    report_progress("linked joints", 0.5)
    zero = np.median(trials.positions, axis=0)
    rig = replace(link_joints(trials, cameras, separate, zero), lenses=lenses)
    every = replace(
        measurements(trials, trials.visible, trials.positions - zero),
        lens_priors=prior_of_lenses(trials, priors),
    )
    clean = every.select(usable[every.camera, every.stop, every.marker])
    linked = solve(rig, clean, "projective", cameras=False, loss=RobustLoss("soft_l1", 2.0), tolerance=1e-4)
    decided = options.lens != "auto" or bool(priors) or bend is not None
    return _Start(trials, zero, linked, every, clean, lens_model, decided, left_out)


def _bundles(start: _Start, report_progress: Progress, options: FitOptions) -> _Bundles:
    """Projective bundle, stratum, final bundle. Raises CalibrationError."""
    report_progress("rigid bundle", 0.6)
    trials, every = start.trials, start.every
    solution, inliers = projective_bundle(start.linked.rig, start.clean, every, start.lenses, options, start.decided)
    refuse_poor_fit(trials, solution, every, inliers, options)
    report_progress("metric bundle", 0.8)
    raised = select_stratum(solution, _inside(every, solution, inliers), options)
    final, inliers = _settled(raised.solution, every, options)
    for _ in range(2 if options.lens == "auto" else 0):
        required = required_lens_model(final)
        if required == final.lenses and raised.bent and final.lenses != FULL_LENS:
            required = FREE_LENS if final.lenses == "none" else FULL_LENS
        if required == final.lenses:
            break
        # Only the constraints of the higher stratum separate distortion from kinematics.
        solution, inliers = refine_to_convergence(
            solution.rig, every.corrected(solution.data.joint_errors), "projective", options, required, 1e-6
        )
        raised = select_stratum(solution, _inside(every, solution, inliers), options)
        final, inliers = _settled(raised.solution, every, options)
    refuse_poor_fit(trials, final, every, inliers, options)
    refuse_undetermined(final, raised.notes)
    return _Bundles(solution, raised, final, inliers)


def _settled(raised: Solution, every: Measurements, options: FitOptions) -> tuple[Solution, BoolArray]:
    """The final bundle and its inliers, from a solution of the stratum and its joint errors."""
    every = every.corrected(raised.data.joint_errors)
    return refine_to_convergence(raised.rig, every, raised.stratum, options, raised.lenses)


def _reduced_rows(start: _Start, solution: Solution) -> ReducedRows:
    return reduced_rows(solution, readings(start.trials.positions - start.zero))


def _inside(every: Measurements, solution: Solution, inliers: BoolArray) -> Measurements:
    """The inliers, with the joint errors of ``solution``."""
    return every.corrected(solution.data.joint_errors).select(inliers)


def _components_at_start(start: _Start, beside_scales: bool) -> VarianceComponents | None:
    """Significant variance components of the linked joints, with cameras free; None if there are none.
    ``beside_scales``: also None if scales of the joints explain the remaining residuals. Raises ScalesError.
    """
    rig, clean = start.linked.rig, start.clean
    free = solve(rig, clean, "projective", lenses=start.lenses, max_evaluations=1)
    if chi2_within(free.cost, free.statistics.freedom):
        return None
    # Wrong pixels would count as joint errors; those of a whole stop would not be detected.
    squares = (free.residuals.reshape(-1, 2) ** 2).sum(axis=1)
    near = squares <= WILD * max(1.0, float(np.median(squares)))
    free = solve(rig, clean.select(near), "projective", lenses=start.lenses, max_evaluations=1)
    rows = _reduced_rows(start, free)
    found = estimate_components(rows, scales=beside_scales)
    if found is None or not found.significant or not beside_scales:
        return found if found is not None and found.significant else None
    refuse_wrong_scales(start.trials, found)
    # If the scales are right, errors by posture that they would have absorbed are the joints' own.
    return estimate_components(rows, scales=False, near=found)


def _bundles_with_joint_errors(
    start: _Start,
    found: VarianceComponents,
    report_progress: Progress,
    options: FitOptions,
    beside_scales: bool,
) -> tuple[_Start, _Bundles, VarianceComponents, bool]:
    """Bundles whitened by the components ``found``, estimated again with the final one. Raises _JointErrorsError if
    they do not explain the data, ScalesError.
    """
    at = readings(start.trials.positions - start.zero)
    try:
        noisy = start.with_joint_noise(found.noise(at))
        first = _bundles(noisy, report_progress, options)
        rows = _reduced_rows(noisy, first.final)
        better = _refined_by_joint_errors(noisy, first, options, rows, found, beside_scales=beside_scales)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError) as error:
        raise _JointErrorsError from error
    if better is None:
        raise _JointErrorsError
    return better


def _refined_by_joint_errors(
    start: _Start,
    bundles: _Bundles,
    options: FitOptions,
    rows: ReducedRows,
    near: VarianceComponents | None = None,
    *,
    beside_scales: bool = True,
) -> tuple[_Start, _Bundles, VarianceComponents, bool] | None:
    """The final bundle of these ``rows``, whitened by the variance components that it shows, repeated until these stay
    the same, and whether they look like one event; None if joint errors do not explain it. Raises ScalesError.
    """
    at = readings(start.trials.positions - start.zero)
    final, inliers = bundles.final, bundles.inliers
    beside = near
    if beside_scales:
        beside = estimate_components(rows, scales=True, near=near)
        if beside is None or not beside.significant:
            return None
        refuse_wrong_scales(start.trials, beside)
    components = estimate_components(rows, scales=False, near=beside)
    if near is None and components is not None and final.lenses != "none" and not start.decided:
        bundles = _rebundled(start.with_joint_noise(components.noise(at)), options) or bundles
        final, inliers = bundles.final, bundles.inliers
    inliers = with_whole_stops(start.every, inliers)
    for _ in range(2):
        if components is None:
            return None
        noisy = start.with_joint_noise(components.noise(at))
        final, inliers = refine_to_convergence(
            final.rig, noisy.every, final.stratum, options, final.lenses, inliers=inliers
        )
        before = components
        components = estimate_components(reduced_rows(final, at), scales=False, near=before)
        if components is not None and components.is_close_to(before):
            components = before
            break
    if components is None or not explains(start.trials, final, inliers, components):
        return None
    refuse_undetermined(final, bundles.raised.notes)
    doubtful = is_single_event(start.trials, final)
    return noisy, bundles._replace(final=final, inliers=inliers), components, doubtful


def _rebundled(noisy: _Start, options: FitOptions) -> _Bundles | None:
    """Bundles of a start with joint noise; None if there are none. Errors of readings taken as exact distort lenses."""
    try:
        return _bundles(noisy, _silent, options)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None


def _from_other_lenses(trials: TrialData, epoch: int, created: str, options: FitOptions) -> CalibrationFit | None:
    """The first fit, of those from initial lenses over the whole range, that its noise explains and whose lenses
    are plausible; None if there is none.
    """
    for bend in INITIAL_DISTORTIONS:
        try:
            result = _fit(trials, epoch, created, _silent, options, {}, bend).fit
        except (CalibrationError, GeometryError, np.linalg.LinAlgError):
            continue  # no fit from this start
        statistics = result.model.statistics
        if statistics is not None and statistics.chi2_ok and implausible_lens(result) is None:
            return result
    return None


def _silent(stage: str, fraction: float) -> None:
    return
