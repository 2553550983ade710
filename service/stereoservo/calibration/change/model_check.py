"""Chi-square test of a calibrated model against the pixels of a short check motion: which camera, marker or joint zero
has changed and by how much, as a report.

Under a valid model the residuals are Gaussian with the stated noise and the model's own uncertainty. A chi-square test
rejects the model; likelihood ratios, with the decision rule of the on-line monitor (`hypothesis_test`), identify the
change: camera, cameras together, marker body, marker or joint zero.

Reset of joint zeros: a new model in which the zeros of drifted joints are moved by the drifts that a check
estimated.

The rest of the model is unchanged. Its covariance is extended by that of the drifts and their correlation with the
errors of the model.

Trends of a model over successive checks: weighted straight lines through the estimates of each change, the most
significant one, and the time when it reaches the limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import combinations

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.change.hypothesis_test import (
    Tested,
    Thresholds,
    check_thresholds,
    is_unexplained,
    noise_level,
    penalised_chi2,
    select_candidates,
    two_best,
)
from stereoservo.calibration.change.model_changes import (
    ChangeEstimate,
    LinearisedProblem,
    ModelChange,
    change_jacobian,
    changed_state,
    covariance_jacobian,
    estimate_changes,
    first_order_gain,
    linearised_problem,
    possible_changes,
    start_state,
    unbounded,
    with_corrected_zeros,
)
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.kinematics.joint_angles import AMBIGUOUS, LARGEST_DEVIATION, joint_zeros
from stereoservo.kinematics.joint_reprojection import JointAnglesError, observed_chain
from stereoservo.kinematics.model import CellModel, ModelCovariance
from stereoservo.messages.check_report import CheckReport, Drift, FoundCause, JointReset, Status, ZeroReset
from stereoservo.numerics.arrays import FloatArray

ALPHA = 0.003
"""Probability that a check of an unchanged cell reports any change, over all hypotheses."""
MAX_CHANGES = 3
NOISE_MARGIN = 1.2
"""Rms residual, over the expected one, above which a model is rejected even if no change explains it."""
GROSS = 6.0, 12.0
"""A pixel is rejected if it differs from its marker's median over the stops by more than this many sigmas, plus this
many times the median difference of that marker in that camera."""
ALONE = 0.3
"""Share of an image's pixels up to which they count as isolated outliers; more have a common cause."""
MIN_MEASUREMENTS = 40
SEARCHED = 3
"""Number of stops over which large zero drifts are searched for."""


@dataclass(frozen=True)
class ModelExamination:
    """A ``model`` examined with the pixels of a ``check``: the tested ``hypotheses``, the ``explanation``
    that was found, and the number of isolated outliers ``left_out``.
    """

    model: CellModel
    check: TrialData
    problem: LinearisedProblem
    hypotheses: list[ModelChange]
    explanation: ChangeEstimate
    left_out: int


def check_model_holds(
    model: CellModel,
    check: TrialData,
    *,
    made_from: TrialData | None = None,
    limit_px: float = 0.25,
    created: str = "",
) -> CheckReport:
    """Report of a model against the pixels of a check motion: `examine_model`, then `make_check_report`.

    A significant change below ``limit_px`` is reported as ``drifting``, above as ``recalibrate``. Raises
    CalibrationError (``bad_data``, ``too_few_stops``).
    """
    return make_check_report(examine_model(model, check, made_from=made_from), limit_px=limit_px, created=created)


def examine_model(model: CellModel, check: TrialData, *, made_from: TrialData | None = None) -> ModelExamination:
    """Examination of a model with the pixels of a check motion.

    ``made_from``: the trial data of its calibration, for the uncertainty of a model that carries no covariance.
    Raises CalibrationError (``bad_data``, ``too_few_stops``).
    """
    factor = 1.0
    if model.statistics is not None and model.statistics.degrees_of_freedom > 0:
        factor = float(np.sqrt(max(1.0, model.statistics.chi2 / model.statistics.degrees_of_freedom)))
    problem = linearised_problem(model, check, made_from, factor)
    if 2 * len(problem.data.camera) < MIN_MEASUREMENTS or len(np.unique(problem.data.stop)) < 3:
        raise CalibrationError(
            "too_few_stops",
            f"the check shows {len(problem.data.camera)} pixels of known markers at "
            f"{len(np.unique(problem.data.stop))} stops; at least {MIN_MEASUREMENTS // 2} at 3 stops are needed",
            pixels=len(problem.data.camera),
        )
    gross = isolated_outliers(problem)
    if gross.any():
        problem = problem.select(~gross)
    hypotheses = possible_changes(model, problem)
    found = explain_residuals(problem, hypotheses)
    if found.changes and (len(found.changes) > 1 or not _explains(problem, found)):
        lost = estimate_joint_zeros(model, problem, hypotheses)
        if lost is not None and _schwarz(problem, lost, found) < _schwarz(problem, found, lost):
            found = lost
    return ModelExamination(model, check, problem, hypotheses, found, int(gross.sum()))


def _explains(problem: LinearisedProblem, found: ChangeEstimate) -> bool:
    """Whether the residuals after an explanation are noise."""
    return not is_unexplained(found.chi2, 2 * len(problem.data.camera) - found.x.size, math.log(ALPHA), 0.0)


def _schwarz(problem: LinearisedProblem, found: ChangeEstimate, other: ChangeEstimate) -> float:
    """Schwarz's criterion (penalised chi-square) of an explanation, at the noise that the better one of two leaves."""
    count = 2 * len(problem.data.camera)
    both = np.array([found.chi2, other.chi2])
    sizes = np.array([found.x.size, other.x.size], dtype=np.int64)
    noise = noise_level(both, sizes, np.ones(2, dtype=np.bool_), count)
    return penalised_chi2(found.chi2, found.x.size, noise, math.log(count))


def estimate_joint_zeros(
    model: CellModel, problem: LinearisedProblem, hypotheses: list[ModelChange]
) -> ChangeEstimate | None:
    """Drifts of all joints' zeros estimated jointly, without the insignificant ones; for an arm that was switched
    on again, or got new encoders, so that several zeros may be far off.

    None if the images do not determine the joints, leave several postures possible, or no drift is significant.
    """
    by_name = {cause.subject: cause for cause in hypotheses if cause.kind == "joint"}
    named = tuple(by_name[name] for name in model.joint_names)
    found = estimate_changes(problem, named)
    if not _explains(problem, found):
        ends = [estimate_changes(problem, named, start=start) for start in _search_zeros(model, problem)]
        if not ends:
            return None
        best = min(ends, key=lambda one: one.chi2)
        noise = max(1.0, best.chi2 / max(1, 2 * len(problem.data.camera) - best.x.size))
        for one in ends:
            difference = _without_full_turns(model, one.x - best.x)
            other = float(difference @ best.information @ difference) > AMBIGUOUS
            if other and one.chi2 - best.chi2 < AMBIGUOUS * noise:
                return None  # two postures that the images do not distinguish
        found = best
    if (np.abs(found.x - _without_full_turns(model, found.x)) > np.pi).any():
        found = estimate_changes(problem, named, start=_without_full_turns(model, found.x))
    kept = _best_subset(found, float(_thresholds(problem, hypotheses).ratios[1]))
    return estimate_changes(problem, tuple(named[k] for k in kept), start=found.x[kept]) if kept else None


def _best_subset(found: ChangeEstimate, price: float) -> list[int]:
    """Indices of the parameters that explain best when each one costs ``price``, to first order around an estimate; all
    subsets are compared, since joints with similar axes can replace each other one at a time.
    """
    information, q = found.information, found.x.size
    best: tuple[float, list[int]] = (np.inf, [])
    for kept in (list(s) for size in range(q + 1) for s in combinations(range(q), size)):
        idle = [k for k in range(q) if k not in kept]
        across = information[np.ix_(kept, idle)]
        inner = np.linalg.pinv(information[np.ix_(kept, kept)], hermitian=True)
        lost = information[np.ix_(idle, idle)] - across.T @ inner @ across
        best = min(best, (float(found.x[idle] @ lost @ found.x[idle]) + price * len(kept), kept))
    return best[1]


def _without_full_turns(model: CellModel, drifts: FloatArray) -> FloatArray:
    """Drifts (n,) without whole turns of revolute joints, which are not observable."""
    revolute = np.array([kind == "revolute" for kind in model.joint_kinds])
    return np.where(revolute, np.mod(drifts + np.pi, 2.0 * np.pi) - np.pi, drifts)


def _search_zeros(model: CellModel, problem: LinearisedProblem) -> tuple[FloatArray, ...]:
    """Drifts (n,) of all joints' zeros by a global search (4.45) over a few stops: all solutions consistent with these;
    none if the stops do not determine them.
    """
    data = problem.data
    stops = np.unique(data.stop)[:SEARCHED]
    pixels = np.full((len(data.offsets), len(model.cameras), len(model.marker_ids), 2), np.nan)
    sigmas = np.full(pixels.shape[:3], np.nan)
    where = data.stop, data.camera, data.marker
    pixels[where], sigmas[where] = data.pixels, data.sigmas
    encoders = np.empty_like(data.offsets)
    encoders[:, list(problem.order)] = data.offsets
    encoders += model.zero
    seen = observed_chain(model)
    try:
        zeros = joint_zeros(seen, model.marker_points, pixels[stops], sigmas[stops], encoders[stops])
    except JointAnglesError:
        return ()
    return zeros.offset, *zeros.alternatives


def _thresholds(problem: LinearisedProblem, hypotheses: list[ModelChange]) -> Thresholds:
    return check_thresholds(ALPHA, len(hypotheses), 2 * len(problem.data.camera))


def explain_residuals(problem: LinearisedProblem, hypotheses: list[ModelChange]) -> ChangeEstimate:
    """Changes that explain the pixels, the most significant first; empty if none is significant.

    Changes are added one by one to those found before, by the decision of `hypothesis_test`: Schwarz's penalty prevents
    that a drifted joint is classified as a moved camera, which has more parameters and explains as much.
    """
    found = estimate_changes(problem, ())
    thresholds = _thresholds(problem, hypotheses)
    while len(found.changes) < MAX_CHANGES:
        more = _add_best_cause(
            problem, found, [cause for cause in hypotheses if cause not in found.changes], thresholds
        )
        if more is None:
            break
        found = more
    return found


def _add_best_cause(
    problem: LinearisedProblem, found: ChangeEstimate, others: list[ModelChange], thresholds: Thresholds
) -> ChangeEstimate | None:
    """The estimate extended by the one of ``others`` that explains best; None if none is significant."""
    count = 2 * len(problem.data.camera)
    penalty = math.log(count)
    sizes = np.array([cause.size for cause in others], dtype=np.int64)
    gains = np.array([first_order_gain(problem, cause, found.left) - cause.size * penalty for cause in others])
    candidates = np.zeros(len(others), dtype=np.bool_)
    select_candidates(gains, sizes, candidates)
    estimates = {int(h): estimate_changes(problem, (*found.changes, others[h])) for h in np.flatnonzero(candidates)}
    chi2 = np.array([estimates[h].chi2 if h in estimates else np.inf for h in range(len(others))])
    noise = noise_level(chi2, sizes, candidates, count - found.x.size)
    tested = Tested(chi2, sizes, np.zeros(len(others)), candidates)
    best, _ = two_best(found.chi2, tested, noise, penalty, thresholds.ratios, thresholds.least_px)
    return estimates.get(best)


def isolated_outliers(problem: LinearisedProblem) -> npt.NDArray[np.bool_]:
    """Mask (k,) of isolated outliers: pixels far from the same marker's pixels at the other stops.

    A change in the cell affects a marker's pixels at all stops equally, or varies with the stop. An effect on
    many markers of one image, such as that of joints in a wrong order, is no isolated outlier.
    """
    here = problem.residuals_at(start_state(problem)).reshape(-1, 2)
    gross = np.zeros(len(here), dtype=bool)
    series = problem.data.camera * len(problem.rig.points) + problem.data.marker
    for one in np.unique(series):
        mine = np.flatnonzero(series == one)
        if len(mine) < 4:
            continue
        away = np.linalg.norm(here[mine] - np.median(here[mine], axis=0), axis=1)
        gross[mine] = away > GROSS[0] + GROSS[1] * np.median(away)
    images = problem.data.camera * len(problem.data.offsets) + problem.data.stop
    share = np.bincount(images, gross) / np.maximum(np.bincount(images), 1)
    gross &= share[images] <= ALONE
    return gross


ELSEWHERE = "; the marker body has another pose than at calibration, as [scene] moves says it may"


def make_check_report(
    examined: ModelExamination, *, limit_px: float = 0.25, created: str = "", body_moves: bool = False
) -> CheckReport:
    """Report of an examination; ``limit_px``: tolerable change of the pixels [px]. ``body_moves``: the marker body is a
    target that moves by itself (``[scene] moves``), and may have moved since the model was calibrated.
    """
    model, check, problem, found = examined.model, examined.check, examined.problem, examined.explanation
    here = problem.residuals_at(start_state(problem))
    chi2 = float(here @ problem.whitened(here))
    count = here.size
    squares = (here.reshape(-1, 2) ** 2).sum(axis=1) / 2.0
    # The model's own uncertainty increases the expected residuals.
    expected = 1.0 + _model_variance(problem)
    elsewhere = body_moves and any(change.kind == "body" for change in found.changes)
    named = [
        _found_cause(model, problem, found, i)
        for i, change in enumerate(found.changes)
        if not (body_moves and change.kind == "body")
    ]
    freedom = max(1, count - found.x.size)
    left = float(np.sqrt(found.chi2 / freedom))
    if is_unexplained(found.chi2, freedom, math.log(ALPHA), NOISE_MARGIN**2 * freedom):
        named.append(_unexplained(model, problem, found, left, bool(found.changes)))
    status: Status = "holds"
    if named:
        serious = any(cause.effect_px > limit_px or cause.kind == "unexplained" for cause in named)
        status = "recalibrate" if serious else "drifting"
    sigmas = float(np.sqrt(chi2 / count))

    def rms(mine: npt.NDArray[np.bool_]) -> float:
        return float(np.sqrt((squares / expected)[mine].mean())) if mine.any() else 0.0

    offsets = check.positions - np.median(check.positions, axis=0)
    away = np.abs(offsets) > 0.2 * np.abs(offsets).max(axis=0)
    return CheckReport(
        status=status,
        message=_message(status, named, sigmas, chi2, count, problem, limit_px) + (ELSEWHERE if elsewhere else ""),
        model_epoch=model.epoch,
        stops=len(np.unique(problem.data.stop)),
        measurements=count,
        chi2=chi2,
        explained_chi2=found.chi2,
        sigmas=sigmas,
        rms_px=float(np.sqrt((squares * problem.data.sigmas**2).mean())),
        limit_px=limit_px,
        per_joint={name: rms(away[problem.data.stop, j]) for j, name in enumerate(model.joint_names)},
        per_camera={camera.name: rms(problem.data.camera == c) for c, camera in enumerate(model.cameras)},
        per_marker={str(marker): rms(problem.data.marker == k) for k, marker in enumerate(model.marker_ids)},
        causes=tuple(named),
        drifts=tuple(
            _drift(problem, cause)
            for cause in examined.hypotheses
            if cause.kind != "marker" and not (body_moves and cause.kind == "body")
        ),
        left_out=examined.left_out,
        created=created,
    )


def _model_variance(problem: LinearisedProblem) -> FloatArray:
    """Variance (k,) that the model's uncertainty adds to each pixel, in units of the pixel's own."""
    return np.asarray((unbounded(problem.uncertainty) ** 2).sum(axis=1).reshape(-1, 2).mean(axis=1))


def _drift(problem: LinearisedProblem, cause: ModelChange) -> Drift:
    alone = estimate_changes(problem, (cause,))
    upper = alone.information[np.triu_indices(cause.size)]
    return Drift(cause.kind, cause.subject, _short(alone.x), _short(upper), float(f"{alone.effects_px[0]:.6g}"))


def _short(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(f"{value:.8g}") for value in values)


def _found_cause(model: CellModel, problem: LinearisedProblem, found: ChangeEstimate, i: int) -> FoundCause:
    cause = found.changes[i]
    at = sum(other.size for other in found.changes[:i])
    x = found.x[at : at + cause.size]
    covariance = found.covariance[at : at + cause.size, at : at + cause.size]
    others = tuple(other for other in found.changes if other is not cause)
    ratio = estimate_changes(problem, others).chi2 - found.chi2
    value = deviation = None
    if cause.kind == "joint":
        value, deviation = float(x[0]), float(np.sqrt(covariance[0, 0]))
    elif cause.kind in ("cameras", "camera", "body") and cause.size == 6:
        value = float(np.linalg.norm(x[:3]))
        deviation = float(np.sqrt(np.trace(covariance[:3, :3]) / 3.0))
    effect = found.effects_px[i]
    text = SENTENCES[cause.kind](model, cause.subject, value, deviation)
    return FoundCause(
        cause.kind, cause.subject, ratio, cause.size, effect, f"{text}, {effect:.3g} px rms in the images", value,
        deviation,
    )  # fmt: skip


def _rotation_text(value: float | None, deviation: float | None) -> str:
    if value is None or deviation is None:
        return ""
    return f" (turned {np.degrees(value):.3g}° ± {np.degrees(deviation):.2g}°, and shifted)"


def _joint_sentence(model: CellModel, subject: str, value: float | None, deviation: float | None) -> str:
    j = model.joint_names.index(subject)
    amount = f"{value:+.5g} m ± {deviation:.2g} m"
    if model.joint_kinds[j] == "revolute" and value is not None and deviation is not None:
        amount = f"{np.degrees(value):+.4g}° ± {np.degrees(deviation):.2g}°"
    ends = {0: "what the arm is mounted on", len(model.joint_names) - 1: "what its flange carries"}
    also = f", or {ends[j]} turned about its axis" if j in ends else ""
    return f"zero of joint {subject} drifted by {amount}{also}"


SENTENCES: dict[str, Callable[[CellModel, str, float | None, float | None], str]] = {
    "camera": lambda model, subject, value, deviation: f"camera {subject} moved{_rotation_text(value, deviation)}",
    "cameras": lambda model, subject, value, deviation: (
        f"the cameras moved together, or the arm's base did{_rotation_text(value, deviation)}"
        if not model.tip_first
        else f"the cameras moved together on the flange{_rotation_text(value, deviation)}"
    ),
    "body": lambda model, subject, value, deviation: (
        f"the marker body moved on the flange{_rotation_text(value, deviation)}"
        if not model.tip_first
        else f"the marker body, or the arm's base, moved{_rotation_text(value, deviation)}"
    ),
    "marker": lambda model, subject, value, deviation: f"marker {subject} slipped",
    "joint": _joint_sentence,
}
"""Functions that describe each kind of change, from model, subject, and value and deviation, if any."""


def _unexplained(
    model: CellModel, problem: LinearisedProblem, found: ChangeEstimate, left: float, also: bool
) -> FoundCause:
    squares = (found.left.reshape(-1, 2) ** 2).sum(axis=1) / 2.0
    by_camera = [float(np.sqrt(squares[problem.data.camera == c].mean())) for c in range(len(model.cameras))]
    by_marker = {
        marker: float(np.sqrt(squares[problem.data.marker == k].mean()))
        for k, marker in enumerate(model.marker_ids)
        if (problem.data.marker == k).any()
    }
    by_stop = {int(s): float(np.sqrt(squares[problem.data.stop == s].mean())) for s in np.unique(problem.data.stop)}
    worst = max(by_marker, key=lambda marker: by_marker[marker])
    stop = max(by_stop, key=lambda s: by_stop[s])
    c = int(np.argmax(by_camera))
    rms_px = float(np.sqrt((squares * problem.data.sigmas**2).mean()))
    what = "the rest is" if also else "residuals are"
    return FoundCause(
        "unexplained",
        model.cameras[c].name,
        found.chi2,
        found.left.size - found.x.size,
        rms_px,
        f"{what} {left:.3g} times the expected noise and no single cause explains it: most in camera "
        f"{model.cameras[c].name} ({by_camera[c]:.3g} times), at marker {worst} ({by_marker[worst]:.3g} times) and "
        f"{_describe_stop(model, problem, stop)} ({by_stop[stop]:.3g} times). Noise of the images (light, focus, "
        "dirt), play in a joint, joints listed in another order than they follow each other, or several "
        "changes at once",
    )


def _describe_stop(model: CellModel, problem: LinearisedProblem, stop: int) -> str:
    """Description of a stop: the joints that are away from the base at it."""
    offsets = problem.data.offsets - np.median(problem.data.offsets, axis=0)
    away = np.abs(offsets[stop]) > 0.2 * np.abs(offsets).max(axis=0)
    names = sorted(model.joint_names[problem.order[k]] for k in np.flatnonzero(away))
    return f"with {' and '.join(names)} displaced" if names else "at the base"


def _message(
    status: Status,
    named: list[FoundCause],
    sigmas: float,
    chi2: float,
    count: int,
    problem: LinearisedProblem,
    limit_px: float,
) -> str:
    low, high = (float(chi2_distribution.ppf(tail, count)) for tail in (0.0005, 0.9995))
    verdict = (
        f"residuals are {sigmas:.3g} times the expected noise over {count} measurements (chi-square {chi2:.0f}; "
        f"{low:.0f} to {high:.0f} expected)"
    )
    because = "; ".join(cause.message for cause in named)
    if status == "holds":
        return f"model holds: {verdict}"
    if status == "drifting":
        drift = f"model holds, but it drifts: {because}; below the limit of {limit_px:g} px"
        return f"{drift}. {verdict[0].upper()}{verdict[1:]}"
    return f"recalibrate because {because}. {verdict[0].upper()}{verdict[1:]}"


DISTINGUISHABLE = 25.0
"""Least increase of chi-square when a different joint is assumed to have drifted than the one that is reset."""


def reset_zeros(
    examined: ModelExamination, report: CheckReport, *, epoch: int, created: str = ""
) -> tuple[CellModel, ZeroReset]:
    """New model of epoch ``epoch`` with the zeros of drifted joints moved, and a record of the reset.

    Raises CalibrationError: ``check_holds`` if nothing drifted, ``other_cause`` if anything but joint zeros
    changed, ``not_observable`` with the ``joints`` that the check does not distinguish or not determine well enough.
    """
    _must_be_zeros(report)
    model, found = examined.model, examined.explanation
    # Again at the true joint positions: large drifts change the pixels' uncertainty due to the model.
    problem = with_corrected_zeros(examined.problem, model, changed_state(examined.problem, found.changes, found.x)[1])
    rest = estimate_changes(problem, found.changes)
    drift = found.x + rest.x
    at = [model.joint_names.index(cause.subject) for cause in found.changes]
    covariance = rest.covariance
    deviations = np.sqrt(np.diag(covariance))
    _must_be_observable(examined, deviations)
    zero = model.zero.copy()
    zero[at] -= drift
    joints = tuple(
        JointReset(
            model.joint_names[j],
            model.joint_kinds[j],
            float(x),
            float(s),
            float(model.zero[j]),
            float(zero[j]),
        )
        for j, x, s in zip(at, drift, deviations, strict=True)
    )
    stated = model.covariance
    changes = ", ".join(f"{joint.joint} {_amount(joint)}" for joint in joints)
    source = f"{model.source or 'model'} (epoch {model.epoch}); zeros reset by a check"
    source += f" at {report.created}" if report.created else ""
    source += f": {changes}" + (
        "" if stated is not None else "; their uncertainty is not carried, the model had no covariance"
    )
    after = float(np.sqrt(rest.chi2 / max(1, report.measurements - drift.size)))
    reset = ZeroReset(
        epoch,
        model.epoch,
        joints,
        report.sigmas,
        after,
        f"zeros reset in model epoch {epoch}: {changes}; residuals {report.sigmas:.3g} times the expected noise "
        f"before, {after:.3g} times after. Teach the goals of epoch {model.epoch} again",
    )
    return msgspec.structs.replace(
        model, epoch=epoch, created=created, source=source, zero=zero, refined_from=0, in_place_of=0,
        covariance=None if stated is None else _with_zeros(model, stated, problem, rest, covariance),
    ), reset  # fmt: skip


def _must_be_zeros(report: CheckReport) -> None:
    if report.status == "holds" or not report.causes:
        raise CalibrationError("check_holds", f"no joint zero is to be reset: {report.message}")
    others = [cause.message for cause in report.causes if cause.kind != "joint"]
    if others:
        raise CalibrationError(
            "other_cause",
            f"a reset of joint zeros does not cure this: {'; '.join(others)}. Remove the cause, or calibrate again",
            causes=others,
        )


def _must_be_observable(examined: ModelExamination, deviations: FloatArray) -> None:
    found, problem = examined.explanation, examined.problem
    poor = [c.subject for c, s in zip(found.changes, deviations, strict=True) if s > LARGEST_DEVIATION]
    if poor:
        raise CalibrationError(
            "not_observable",
            f"the check does not determine the zero of {', '.join(poor)}: standard deviation above "
            f"{LARGEST_DEVIATION:g} rad or m. Markers farther from its axis, or another base, are needed",
            joints=poor,
        )
    noise = max(1.0, found.chi2 / max(1, 2 * len(problem.data.camera) - found.x.size))
    idle = [cause for cause in examined.hypotheses if cause.kind == "joint" and cause not in found.changes]
    for i, cause in enumerate(found.changes):
        for other in idle:
            swapped = (*found.changes[:i], other, *found.changes[i + 1 :])
            if estimate_changes(problem, swapped).chi2 - found.chi2 < DISTINGUISHABLE * noise:
                raise CalibrationError(
                    "not_observable",
                    f"the check does not distinguish a drift of {cause.subject} from one of {other.subject}: at "
                    "these stops both move the markers alike. Take a base where their axes differ, or calibrate again",
                    joints=[cause.subject, other.subject],
                )


def _amount(joint: JointReset) -> str:
    if joint.kind == "revolute":
        return f"by {np.degrees(joint.drift):+.4g}° ± {np.degrees(joint.deviation):.2g}°"
    return f"by {joint.drift:+.5g} m ± {joint.deviation:.2g} m"


def _with_zeros(
    model: CellModel,
    stated: ModelCovariance,
    problem: LinearisedProblem,
    found: ChangeEstimate,
    own: FloatArray,
) -> ModelCovariance:
    """The model's covariance extended by that of its moved zeros, ``own`` (z, z), and by the correlation of both.

    A zero error ``e`` moves the parts that its joint carries by ``exp(e Ĥ)``: the generators of the joints behind it
    in the chain and the markers, all with the same ``e``. Other estimates of the check are not used.
    """
    at = [model.joint_names.index(cause.subject) for cause in found.changes]
    order = list(problem.order)
    here = problem.residuals_at(changed_state(problem, found.changes, found.x))
    weighted = problem.whitened(change_jacobian(problem, found.changes, found.x, here))
    slopes, columns = covariance_jacobian(model, stated, problem.data)
    sway = np.empty((len(at), len(stated.covariance)))
    sway[:, columns] = -own @ (weighted.T @ slopes)
    across = sway @ stated.covariance

    rows: list[FloatArray] = []
    p, z = len(stated.covariance), len(at)
    start = 0

    def widened(basis: FloatArray, more: list[tuple[int, FloatArray]]) -> FloatArray:
        nonlocal start
        for i in range(start, start + len(basis)):
            rows.append(np.eye(p + z)[i])
        start += len(basis)
        for k, _ in more:
            rows.append(np.eye(p + z)[p + k])
        return np.concatenate([basis, np.array([d for _, d in more]).reshape(-1, *basis.shape[1:])])

    def before(j: int) -> list[int]:
        return [k for k, moved in enumerate(at) if order.index(moved) < order.index(j)]

    generators = tuple(
        widened(basis, [(k, model.generators[at[k]]) for k in before(j)]) for j, basis in enumerate(stated.generators)
    )
    cameras = tuple(widened(basis, []) for basis in stated.cameras)
    lenses = tuple(widened(basis, []) for basis in stated.lenses)
    markers = tuple(
        widened(basis, [(k, model.generators[j] @ point) for k, j in enumerate(at)])
        for basis, point in zip(stated.markers, model.marker_points, strict=True)
    )
    jacobian = np.array(rows)
    whole = np.block([[stated.covariance, across.T], [across, own]])
    return ModelCovariance(generators, cameras, lenses, markers, jacobian @ whole @ jacobian.T)


MIN_CHECKS = 3
TREND_ALPHA = 0.003
"""Probability that constant estimates are reported as growing, over all changes."""
DAY_S = 86_400.0
FAR_DAYS = 3650.0
"""Horizon beyond which no crossing is reported."""


class DriftTrend(msgspec.Struct, frozen=True):
    """A change that grows from check to check. ``ratio``: chi-square of its slope with ``freedoms``; ``px_a_day``: its
    growth in the images; ``days``: until it reaches the limit, 0 if it already has, None if that is too far away or it
    shrinks.
    """

    kind: str
    subject: str
    checks: int
    ratio: float
    freedoms: int
    px_a_day: float
    days: float | None
    message: str


def find_trend(history: Sequence[CheckReport]) -> DriftTrend | None:
    """The most significant trend over the checks of the newest check's model, oldest first.

    Reports without a time, or of other models, are ignored. None if nothing grows.
    """
    if not history:
        return None
    same = [check for check in history if check.model_epoch == history[-1].model_epoch and check.created]
    if len(same) < MIN_CHECKS:
        return None
    first = datetime.fromisoformat(same[0].created)
    days = np.array([(datetime.fromisoformat(check.created) - first).total_seconds() / DAY_S for check in same])
    if np.ptp(days) <= 0.0:
        return None
    price = np.log(float(sum(check.measurements for check in same)))
    found: list[tuple[float, DriftTrend]] = []
    subjects = [(drift.kind, drift.subject) for drift in same[-1].drifts]
    for kind, subject in subjects:
        line = [_drift_of(check, kind, subject) for check in same]
        if any(drift is None or len(drift.x) != len(line[-1].x) for drift in line if line[-1] is not None):
            continue
        grown = _fit_line([drift for drift in line if drift is not None], days, same[-1].limit_px)
        if grown is None:
            continue
        score = grown.ratio - grown.freedoms * price
        if score > 0 and chi2_distribution.sf(grown.ratio, grown.freedoms) < TREND_ALPHA / len(subjects):
            found.append((score, grown))
    return max(found, key=lambda entry: entry[0])[1] if found else None


def _drift_of(check: CheckReport, kind: str, subject: str) -> Drift | None:
    return next((drift for drift in check.drifts if (drift.kind, drift.subject) == (kind, subject)), None)


def _matrix(drift: Drift) -> FloatArray:
    q = len(drift.x)
    upper = np.zeros((q, q))
    upper[np.triu_indices(q)] = drift.information
    full: FloatArray = upper + upper.T - np.diag(np.diag(upper))
    return full


def _fit_line(line: list[Drift], days: FloatArray, limit_px: float) -> DriftTrend | None:
    """Weighted line ``x = a + b t`` through the estimates, and the time when it crosses the limit."""
    q = len(line[0].x)
    normal = np.zeros((2 * q, 2 * q))
    right = np.zeros(2 * q)
    for drift, day in zip(line, days, strict=True):
        information, x = _matrix(drift), np.array(drift.x)
        row = np.hstack([np.eye(q), day * np.eye(q)])
        normal += row.T @ information @ row
        right += row.T @ (information @ x)
    covariance = np.linalg.pinv(normal)
    both = covariance @ right
    a, b = both[:q], both[q:]
    ratio = float(b @ np.linalg.pinv(covariance[q:, q:]) @ b)
    last = line[-1]
    information = _matrix(last)
    size = float(np.sqrt(max(np.array(last.x) @ information @ np.array(last.x), 0.0)))
    if size == 0.0:
        return None
    # Except for the model's own uncertainty, the information is the pixels' quadratic form.
    scale = last.effect_px / size
    now = a + b * days[-1]
    aa, ab, bb = (float(u @ information @ v) * scale**2 for u, v in ((now, now), (now, b), (b, b)))
    left = _crossing(aa, ab, bb, limit_px)
    speed = float(np.sqrt(bb))
    what = {
        "joint": "the zero of joint {}",
        "camera": "the place of camera {}",
        "cameras": "the place of the cameras",
        "body": "the place of the marker body",
    }[last.kind].format(last.subject)
    text = f"{what} has changed steadily over {len(line)} checks, by {speed * 30:.3g} px a month"
    if left == 0.0:
        text += f"; it is beyond the limit of {limit_px:g} px"
    elif left is not None:
        text += f"; it will cross the limit of {limit_px:g} px in about {_span(left)}"
    return DriftTrend(last.kind, last.subject, len(line), ratio, q, speed, left, text)


def _crossing(aa: float, ab: float, bb: float, limit: float) -> float | None:
    """First time [days] from now at which ``|now + b t|`` reaches ``limit``."""
    if aa >= limit**2:
        return 0.0
    if bb <= 0.0:
        return None
    days = (-ab + np.sqrt(max(ab * ab - bb * (aa - limit**2), 0.0))) / bb
    return float(days) if 0.0 <= days < FAR_DAYS else None


def _span(days: float) -> str:
    if days < 2.0:
        return f"{days * 24:.0f} hours"
    return f"{days:.0f} days" if days < 60.0 else f"{days / 30:.0f} months"
