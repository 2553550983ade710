"""Whether a model still holds, from the pixels of a short check motion and without a fit.

Under the model in use the residuals are Gaussian with the stated noise and the model's own uncertainty; a chi-square
test says whether they are, likelihood ratios between what may have changed say what did.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.kinematics.calibration.check_causes import (
    Bench,
    Cause,
    Estimate,
    causes,
    estimate,
    linear_gain,
    make_bench,
    start_state,
)
from stereoservo.kinematics.calibration.check_report import CheckReport, Drift, FoundCause, Status
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData
from stereoservo.kinematics.joint_angles import joint_zeros
from stereoservo.kinematics.joint_sights import JointAnglesError, seen_chain
from stereoservo.kinematics.model import CellModel

FloatArray = npt.NDArray[np.float64]

ALPHA = 0.003
"""Chance that a check of an unchanged cell names any cause at all, over all hypotheses."""
MAX_CAUSES = 3
SCREENED = 5
"""Hypotheses that are estimated in full, the best to first order."""
NOISE_MARGIN = 1.2
"""Residuals, in expected sigmas rms, above which a cell that no cause explains does not hold."""
GROSS = 6.0, 12.0
"""A pixel is left out that differs from its marker's median over the stops by more than so many sigmas, and so many
times what that marker's other pixels do in that camera."""
ALONE = 0.3
"""Share of an image's pixels up to which they are wrong by themselves; where more are, something is wrong there."""
MIN_MEASUREMENTS = 40
SEARCHED = 3
"""Stops over which far joint zeros are searched for."""


@dataclass(frozen=True)
class Examination:
    """A ``model`` before the pixels of a ``check``: what was ``thought`` of, what was ``found``, and how many pixels
    were ``left_out`` as wrong by themselves.
    """

    model: CellModel
    check: TrialData
    bench: Bench
    thought: list[Cause]
    found: Estimate
    left_out: int


def check_model_holds(
    model: CellModel,
    check: TrialData,
    *,
    made_from: TrialData | None = None,
    limit_px: float = 0.25,
    created: str = "",
) -> CheckReport:
    """Hold a model against the pixels of a check motion: `examine` and `report_of` in one.

    A significant change below ``limit_px`` is reported as ``drifting``, above as ``recalibrate``. Raises
    CalibrationError (``bad_data``, ``too_few_stops``).
    """
    return report_of(examine(model, check, made_from=made_from), limit_px=limit_px, created=created)


def examine(model: CellModel, check: TrialData, *, made_from: TrialData | None = None) -> Examination:
    """What the pixels of a check motion say of a model.

    ``made_from``: the trial data of its calibration, for the uncertainty of a model that carries no covariance.
    Raises CalibrationError (``bad_data``, ``too_few_stops``).
    """
    factor = 1.0
    if model.statistics is not None and model.statistics.degrees_of_freedom > 0:
        factor = float(np.sqrt(max(1.0, model.statistics.chi2 / model.statistics.degrees_of_freedom)))
    bench = make_bench(model, check, made_from, factor)
    if 2 * len(bench.data.camera) < MIN_MEASUREMENTS or len(np.unique(bench.data.stop)) < 3:
        raise CalibrationError(
            "too_few_stops",
            f"the check shows {len(bench.data.camera)} pixels of known markers at "
            f"{len(np.unique(bench.data.stop))} stops; at least {MIN_MEASUREMENTS // 2} at 3 stops are needed",
            pixels=len(bench.data.camera),
        )
    gross = isolated(bench)
    if gross.any():
        bench = bench.select(~gross)
    thought = causes(model, bench)
    found = explain(bench, thought)
    if found.found and (len(found.found) > 1 or not _explains(bench, found)):
        lost = drifted_zeros(model, bench, thought)
        if lost is not None and _schwarz(bench, lost, found) < _schwarz(bench, found, lost):
            found = lost
    return Examination(model, check, bench, thought, found, int(gross.sum()))


def _explains(bench: Bench, found: Estimate) -> bool:
    """Whether what an explanation leaves is noise."""
    return bool(chi2_distribution.sf(found.chi2, 2 * len(bench.data.camera) - found.x.size) >= ALPHA)


def _schwarz(bench: Bench, found: Estimate, other: Estimate) -> float:
    """Chi-square of an explanation, in the noise that the better of two leaves, plus the price of its parameters."""
    count = 2.0 * len(bench.data.camera)
    noise = max(1.0, min(one.chi2 / max(1.0, count - one.x.size) for one in (found, other)))
    return found.chi2 / noise + found.x.size * float(np.log(count))


def drifted_zeros(model: CellModel, bench: Bench, thought: list[Cause]) -> Estimate | None:
    """The drifts of all joints' zeros at once, those left out that are not significant: an arm that was turned on
    anew, or has changed its encoders, may have lost several by far.

    None where the images do not tell the joints, or no drift is significant.
    """
    by_name = {cause.subject: cause for cause in thought if cause.kind == "joint"}
    named = tuple(by_name[name] for name in model.joint_names)
    found = estimate(bench, named)
    if not _explains(bench, found):
        start = _zeros_anywhere(model, bench)
        if start is None:
            return None
        found = estimate(bench, named, start=start)
    significant = float(chi2_distribution.isf(ALPHA / len(thought), 1))
    kept = _telling(found, max(significant, float(np.log(2.0 * len(bench.data.camera)))))
    return estimate(bench, tuple(named[k] for k in kept), start=found.x[kept]) if kept else None


def _telling(found: Estimate, price: float) -> list[int]:
    """Which parameters explain best together when each one costs ``price``, to first order around an estimate: all
    subsets are compared, since joints with like axes stand in for each other one at a time.
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


def _zeros_anywhere(model: CellModel, bench: Bench) -> FloatArray | None:
    """Drifts (n,) of all joints' zeros by a search without a start (4.45) over a few stops; None where those do not
    tell them.
    """
    data = bench.data
    stops = np.unique(data.stop)[:SEARCHED]
    pixels = np.full((len(data.offsets), len(model.cameras), len(model.marker_ids), 2), np.nan)
    sigmas = np.full(pixels.shape[:3], np.nan)
    where = data.stop, data.camera, data.marker
    pixels[where], sigmas[where] = data.pixels, data.sigmas
    encoders = np.empty_like(data.offsets)
    encoders[:, list(bench.order)] = data.offsets
    encoders += model.zero
    seen = seen_chain(model)
    try:
        return joint_zeros(seen, model.marker_points, pixels[stops], sigmas[stops], encoders[stops]).offset
    except JointAnglesError:
        return None


def explain(bench: Bench, thought: list[Cause]) -> Estimate:
    """The causes, most telling first, each of which improves the likelihood significantly; none where none does.

    Among significant ones the best is that of the largest likelihood ratio less ``size ln N`` (Schwarz), so that a
    drifted joint is not taken for a moved camera, which could do the same and more. Ratios count in the noise that the
    best of all leaves: where all pixels scatter more, no cause is telling.
    """
    found = estimate(bench, ())
    price = np.log(2.0 * len(bench.data.camera))
    while len(found.found) < MAX_CAUSES:
        others = [cause for cause in thought if cause not in found.found]
        ranked = [
            (estimate(bench, (*found.found, cause)), cause) for cause in _screened(bench, others, found)
        ]
        count = 2 * len(bench.data.camera)
        noise = max(1.0, min(more.chi2 / max(1, count - more.x.size) for more, _ in ranked))
        telling = []
        for more, cause in ranked:
            ratio = max(found.chi2 - more.chi2, 0.0) / noise
            score = ratio - cause.size * price
            if score > 0.0 and chi2_distribution.sf(ratio, cause.size) < ALPHA / len(thought):
                telling.append((score, more))
        if not telling:
            break
        found = max(telling, key=lambda entry: entry[0])[1]
    return found


def _screened(bench: Bench, others: list[Cause], found: Estimate) -> list[Cause]:
    price = np.log(2.0 * len(bench.data.camera))
    gains = {id(cause): linear_gain(bench, cause, found.left) - cause.size * price for cause in others}
    return sorted(others, key=lambda cause: -gains[id(cause)])[:SCREENED]


def isolated(bench: Bench) -> npt.NDArray[np.bool_]:
    """Pixels (k,) that are wrong by themselves: far from what the same marker shows at the other stops.

    Whatever moved in the cell shows in a marker's pixels at all stops alike, or changes from stop to stop. What shows
    in many markers of one image, as joints in a wrong order do, is no wrong pixel.
    """
    here = bench.residuals_at(start_state(bench)).reshape(-1, 2)
    gross = np.zeros(len(here), dtype=bool)
    series = bench.data.camera * len(bench.rig.points) + bench.data.marker
    for one in np.unique(series):
        mine = np.flatnonzero(series == one)
        if len(mine) < 4:
            continue
        away = np.linalg.norm(here[mine] - np.median(here[mine], axis=0), axis=1)
        gross[mine] = away > GROSS[0] + GROSS[1] * np.median(away)
    images = bench.data.camera * len(bench.data.offsets) + bench.data.stop
    share = np.bincount(images, gross) / np.maximum(np.bincount(images), 1)
    gross &= share[images] <= ALONE
    return gross


def report_of(examined: Examination, *, limit_px: float = 0.25, created: str = "") -> CheckReport:
    """An examination as it is told; ``limit_px``: change of the pixels [px] that the cell can live with."""
    model, check, bench, found = examined.model, examined.check, examined.bench, examined.found
    here = bench.residuals_at(start_state(bench))
    chi2 = float(here @ bench.whitened(here))
    count = here.size
    squares = (here.reshape(-1, 2) ** 2).sum(axis=1) / 2.0
    # The model's own uncertainty widens what is expected of a pixel.
    expected = 1.0 + _widening(bench)
    named = [_named(model, bench, found, i) for i in range(len(found.found))]
    tail = float(chi2_distribution.sf(found.chi2, count - found.x.size))
    left = float(np.sqrt(found.chi2 / max(1, count - found.x.size)))
    if tail < ALPHA and left > NOISE_MARGIN:
        named.append(_unexplained(model, bench, found, left, bool(found.found)))
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
        message=_message(status, named, sigmas, chi2, count, bench, limit_px),
        model_epoch=model.epoch,
        stops=len(np.unique(bench.data.stop)),
        measurements=count,
        chi2=chi2,
        explained_chi2=found.chi2,
        sigmas=sigmas,
        rms_px=float(np.sqrt((squares * bench.data.sigmas**2).mean())),
        limit_px=limit_px,
        per_joint={name: rms(away[bench.data.stop, j]) for j, name in enumerate(model.joint_names)},
        per_camera={camera.name: rms(bench.data.camera == c) for c, camera in enumerate(model.cameras)},
        per_marker={str(marker): rms(bench.data.marker == k) for k, marker in enumerate(model.marker_ids)},
        causes=tuple(named),
        drifts=tuple(_drift(bench, cause) for cause in examined.thought if cause.kind != "marker"),
        left_out=examined.left_out,
        created=created,
    )


def _widening(bench: Bench) -> FloatArray:
    """Variance (k,) that the model's uncertainty adds to a pixel's, in the pixel's own."""
    if not bench.loose.shape[1]:
        return np.zeros(len(bench.data.camera))
    inner = np.eye(bench.loose.shape[1]) - bench.loose.T @ bench.loose
    rows = np.linalg.solve(np.linalg.cholesky(inner), bench.loose.T)
    found: FloatArray = (rows**2).sum(axis=0).reshape(-1, 2).mean(axis=1)
    return found


def _drift(bench: Bench, cause: Cause) -> Drift:
    alone = estimate(bench, (cause,))
    upper = alone.information[np.triu_indices(cause.size)]
    return Drift(
        cause.kind, cause.subject, _short(alone.x), _short(upper), float(f"{alone.effects_px[0]:.6g}")
    )


def _short(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(f"{value:.8g}") for value in values)


def _named(model: CellModel, bench: Bench, found: Estimate, i: int) -> FoundCause:
    cause = found.found[i]
    at = sum(other.size for other in found.found[:i])
    x = found.x[at : at + cause.size]
    covariance = np.linalg.pinv(found.information)[at : at + cause.size, at : at + cause.size]
    others = tuple(other for other in found.found if other is not cause)
    ratio = estimate(bench, others).chi2 - found.chi2
    value = deviation = None
    if cause.kind == "joint":
        value, deviation = float(x[0]), float(np.sqrt(covariance[0, 0]))
    elif cause.kind in ("cameras", "camera", "body") and cause.size == 6:
        value = float(np.linalg.norm(x[:3]))
        deviation = float(np.sqrt(np.trace(covariance[:3, :3]) / 3.0))
    effect = found.effects_px[i]
    text = _SENTENCES[cause.kind](model, cause.subject, value, deviation)
    return FoundCause(
        cause.kind, cause.subject, ratio, cause.size, effect, f"{text}, {effect:.3g} px rms in the images", value,
        deviation,
    )  # fmt: skip


def _turned(value: float | None, deviation: float | None) -> str:
    if value is None or deviation is None:
        return ""
    return f" (turned {np.degrees(value):.3g}° ± {np.degrees(deviation):.2g}°, and shifted)"


def _joint_sentence(model: CellModel, subject: str, value: float | None, deviation: float | None) -> str:
    j = model.joint_names.index(subject)
    amount = f"{value:+.5g} m ± {deviation:.2g} m"
    if model.joint_kinds[j] == "revolute" and value is not None and deviation is not None:
        amount = f"{np.degrees(value):+.4g}° ± {np.degrees(deviation):.2g}°"
    ends = {0: "what the arm stands on", len(model.joint_names) - 1: "what its flange carries"}
    also = f", or {ends[j]} turned about its axis" if j in ends else ""
    return f"zero of joint {subject} drifted by {amount}{also}"


_SENTENCES: dict[str, Callable[[CellModel, str, float | None, float | None], str]] = {
    "camera": lambda model, subject, value, deviation: f"camera {subject} moved{_turned(value, deviation)}",
    "cameras": lambda model, subject, value, deviation: (
        f"the cameras moved together, or the arm's base did{_turned(value, deviation)}"
        if not model.tip_first
        else f"the cameras moved together on the flange{_turned(value, deviation)}"
    ),
    "body": lambda model, subject, value, deviation: (
        f"the marker body moved on the flange{_turned(value, deviation)}"
        if not model.tip_first
        else f"the marker body, or the arm's base, moved{_turned(value, deviation)}"
    ),
    "marker": lambda model, subject, value, deviation: f"marker {subject} slipped",
    "joint": _joint_sentence,
}


def _unexplained(model: CellModel, bench: Bench, found: Estimate, left: float, also: bool) -> FoundCause:
    squares = (found.left.reshape(-1, 2) ** 2).sum(axis=1) / 2.0
    by_camera = [float(np.sqrt(squares[bench.data.camera == c].mean())) for c in range(len(model.cameras))]
    by_marker = {
        marker: float(np.sqrt(squares[bench.data.marker == k].mean()))
        for k, marker in enumerate(model.marker_ids)
        if (bench.data.marker == k).any()
    }
    by_stop = {
        int(s): float(np.sqrt(squares[bench.data.stop == s].mean())) for s in np.unique(bench.data.stop)
    }
    worst = max(by_marker, key=lambda marker: by_marker[marker])
    stop = max(by_stop, key=lambda s: by_stop[s])
    c = int(np.argmax(by_camera))
    rms_px = float(np.sqrt((squares * bench.data.sigmas**2).mean()))
    what = "the rest is" if also else "residuals are"
    return FoundCause(
        "unexplained", model.cameras[c].name, found.chi2, found.left.size - found.x.size, rms_px,
        f"{what} {left:.3g} times the expected noise and no single cause explains it: most in camera "
        f"{model.cameras[c].name} ({by_camera[c]:.3g} times), at marker {worst} ({by_marker[worst]:.3g} times) and "
        f"{_where(model, bench, stop)} ({by_stop[stop]:.3g} times). Noise of the images (light, focus, dirt), play in "
        "a joint, joints listed in another order than they follow each other, or several changes at once",
    )  # fmt: skip


def _where(model: CellModel, bench: Bench, stop: int) -> str:
    """A stop by the joints that are away from the base there."""
    offsets = bench.data.offsets - np.median(bench.data.offsets, axis=0)
    away = np.abs(offsets[stop]) > 0.2 * np.abs(offsets).max(axis=0)
    names = sorted(model.joint_names[bench.order[k]] for k in np.flatnonzero(away))
    return f"with {' and '.join(names)} displaced" if names else "at the base"


def _message(
    status: Status,
    named: list[FoundCause],
    sigmas: float,
    chi2: float,
    count: int,
    bench: Bench,
    limit_px: float,
) -> str:
    low, high = (float(chi2_distribution.ppf(tail, count)) for tail in (0.0005, 0.9995))
    said = (
        f"residuals are {sigmas:.3g} times the expected noise over {count} measurements (chi-square {chi2:.0f}; "
        f"{low:.0f} to {high:.0f} expected)"
    )
    because = "; ".join(cause.message for cause in named)
    if status == "holds":
        return f"model holds: {said}"
    if status == "drifting":
        return f"model holds, but it drifts: {because}; below the limit of {limit_px:g} px. {said[0].upper()}{said[1:]}"
    return f"recalibrate because {because}. {said[0].upper()}{said[1:]}"
