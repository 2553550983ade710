"""Causes of the outliers of a calibration's fit: exchanged views or marker ids, wrong joint positions at a stop, a
moved camera or marker.

The model that fits the other pixels predicts the correct pixels of the outliers, which identifies the cause.

Also what moved permanently during trial motions: one camera, the body relative to all cameras, or undecided.

A model fitted to trials with such a step distributes it over all cameras: a step in its residuals is no evidence of the
camera. Instead each camera in turn gets a different pose from the step on, and the bundle is solved again.

Consistency checks of calibration input: whether the stated detector noise is too small, and whether revolute joints
report their angles at a wrong scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.bundle_adjustment import Solution, solve
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
from stereoservo.calibration.least_squares import RobustLoss
from stereoservo.calibration.rig_model import RigModel, expected_pixels, projective_rig
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.calibration.variance_components import (
    VarianceComponents,
    estimate_components,
    readings,
    reduced_rows,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray

LOSS = RobustLoss("soft_l1", 2.0)
"""Loss that reduces the weight of large residuals: stops before a step that is detected too late, wrong pixels."""
EVALUATIONS = 60
TAIL = 1e-4
"""Probability of rejecting, by chance, that one camera's motion explains the step."""
CLEARLY = 4.0
"""Factor on that chi-square limit by which all other explanations must be worse."""


def moved_part(trials: TrialData, start: Solution, stop: int) -> CalibrationError:
    """Error that states what moved between ``stop`` and the previous one, from a bundle of `solution_with_all_pixels`:
    ``camera_moved``, ``moved_together``, or ``camera_or_body_moved`` if the pixels do not determine it.
    """
    cameras = len(trials.cameras)
    try:
        everything = _solved_with_moved(start, range(cameras), stop)
        alone = [_solved_with_moved(start, (camera,), stop) for camera in range(cameras)]
    except np.linalg.LinAlgError:
        return camera_or_body_moved(trials, stop)
    least = _robust_cost(everything)
    noise = max(1.0, least / max(1, everything.statistics.freedom))
    lost = np.array([(_robust_cost(one) - least) / noise for one in alone])
    freedom = max(1, everything.charts.size - alone[0].charts.size)
    limit = float(chi2_distribution.isf(TAIL, freedom))
    first, second = np.argsort(lost)[:2]
    if lost[first] < limit and lost[second] > CLEARLY * limit:
        return camera_moved(trials, int(first), stop)
    settled = everything.converged and all(one.converged for one in alone)
    if settled and lost[first] > CLEARLY * limit:
        return moved_together(stop)
    return camera_or_body_moved(trials, stop)


def camera_moved(trials: TrialData, camera: int, stop: int) -> CalibrationError:
    """Error that a camera was moved before ``stop``."""
    name = trials.cameras[camera].name
    return CalibrationError(
        "camera_moved",
        f"camera {name!r} moved between stops {stop - 1} and {stop}: all markers jump in its images and stay off, in "
        "no other camera. Fasten it and run the trials again",
        camera=name,
        stop=stop,
    )


def moved_together(stop: int) -> CalibrationError:
    """Error that all markers jump in all cameras before ``stop``."""
    return CalibrationError(
        "moved_together",
        f"all markers jump in all cameras between stops {stop - 1} and {stop} and stay off. The images from there on "
        "are of another arm or body, or the body, the arm's base or both cameras moved, or a joint fell through its "
        "play where its load changed sides. Run all trials again: only a joint does it at the same stop again",
        stop=stop,
    )


def camera_or_body_moved(trials: TrialData, stop: int) -> CalibrationError:
    """Error that something moved before ``stop``, and that the trials do not determine what."""
    names = [camera.name for camera in trials.cameras]
    return CalibrationError(
        "camera_or_body_moved",
        f"about stop {stop} the images step and stay off. Not decided: either one camera moved "
        f"({', '.join(map(repr, names))}), or the body, the arm's base or all cameras, or a joint fell through its "
        "play where its load changed sides. Look whether each is fast and run all trials again: only a joint does it "
        "at the same stop again; markers that stand ([scene] static) would tell a camera from the rest",
        cameras=names,
        stop=stop,
    )


def solution_with_all_pixels(trials: TrialData, result: CalibrationFit) -> Solution:
    """The fit's solution with all pixels of its markers, including rejected ones, without priors of its lenses."""
    solution = solution_of(trials, result)
    kept = [trials.marker_ids.index(i) for i in result.model.marker_ids]
    at = np.nonzero(trials.visible[:, :, kept])
    camera, stop, marker = at
    data = replace(
        solution.data.corrected(None),
        camera=camera,
        stop=stop,
        marker=marker,
        pixels=trials.pixels[:, :, kept][at],
        sigmas=trials.sigmas[:, :, kept][at],
        lens_priors=None,
        pinhole_ties=None,
    )
    return replace(solution, data=data)


def _solved_with_moved(start: Solution, moved: Sequence[int], stop: int) -> Solution:
    """The bundle in which the cameras ``moved`` have different poses from ``stop`` on. Raises LinAlgError."""
    rig, data, count = start.rig, start.data, len(start.rig.cameras)
    others = np.arange(count)
    others[list(moved)] = count + np.arange(len(moved))
    rig = replace(
        rig,
        cameras=np.concatenate([rig.cameras, rig.cameras[list(moved)]]),
        lenses=np.concatenate([rig.lenses, rig.lenses[list(moved)]]),
    )
    camera = np.where(data.stop >= stop, others[data.camera], data.camera)
    return solve(
        rig,
        replace(data, camera=camera),
        "projective",
        lenses=start.lenses,
        loss=LOSS,
        max_evaluations=EVALUATIONS,
        tolerance=1e-6,
    )


def _robust_cost(solution: Solution) -> float:
    return LOSS.cost(solution.residuals**2)


NEAR = 6.0
"""Distance [sigmas] up to which a pixel agrees with a prediction."""
MOST = 0.6
"""Share of outliers among a stop's pixels from which the stop, or its image, is wrong as a whole."""
LASTING = 0.75
"""Share of outliers after a stop from which a camera or a marker counts as moved; before it, a tenth at most."""
LASTING_STOPS = 3
"""Number of last stops at which such a move must be visible."""


@dataclass(frozen=True)
class PredictedTrials:
    """Predictions of a model for its trials: mask of outliers (c, s, m), expected pixels (c, s, m, 2), and
    the distance [px] within which a pixel agrees with its prediction (c, s, m).
    """

    rig: RigModel
    zero: FloatArray
    marker_ids: tuple[int, ...]
    pixels: FloatArray
    sigmas: FloatArray
    seen: BoolArray
    outliers: BoolArray
    expected: FloatArray

    def near(self, pixels: FloatArray, where: FloatArray) -> BoolArray:
        """Whether pixels (c, s, m, 2) agree with the expected ones."""
        distance = np.linalg.norm(pixels - where, axis=-1)
        return np.asarray(np.where(np.isfinite(distance), distance, np.inf) <= NEAR * self.sigmas)


def predictions(trials: TrialData, result: CalibrationFit) -> PredictedTrials:
    """The fit's predictions at the trials' stops."""
    model = result.model
    kept = [trials.marker_ids.index(i) for i in model.marker_ids]
    seen = trials.visible[:, :, kept]
    outliers = np.zeros_like(seen)
    names = [camera.name for camera in trials.cameras]
    for outlier in result.report.outliers:
        outliers[names.index(outlier.camera), outlier.stop, model.marker_ids.index(outlier.marker)] = True
    rig = projective_rig(model)
    return PredictedTrials(
        rig,
        model.zero,
        model.marker_ids,
        trials.pixels[:, :, kept],
        trials.sigmas[:, :, kept] * max(1.0, result.report.sigma_factor),
        seen,
        outliers,
        expected_pixels(rig, trials.positions - model.zero),
    )


def explain_outliers(trials: TrialData, result: CalibrationFit) -> tuple[str, ...]:
    """Notes on the causes of the outliers of ``result``.

    Raises CalibrationError (``camera_moved``, ``marker_slipped``, ``moved_together``, ``camera_or_body_moved``) for
    a permanent change during the trials: the model describes the cell before it.
    """
    found = predictions(trials, result)
    if not found.outliers.any():
        return ()
    check_lasting_outliers(trials, result, found)
    notes: list[str] = []
    rest = found.outliers.copy()
    crossed = _exchanged_stops(found)
    if len(crossed):
        rest[:, crossed] = False
        notes.append(f"the images of two cameras are exchanged at {_stops(crossed)}; they were left out")
    for camera, a, b, stops in _exchanged_ids(found, rest):
        rest[camera, stops, a] = rest[camera, stops, b] = False
        ids = result.model.marker_ids
        notes.append(
            f"markers {ids[a]} and {ids[b]} are exchanged in camera {trials.cameras[camera].name!r} at "
            f"{_stops(stops)}; they were left out"
        )
    wrong = _share(rest, found.seen, axis=(0, 2)) >= MOST
    for stop in np.flatnonzero(wrong):
        notes.append(_wrong_stop(trials, found, int(stop)))
    return tuple(notes)


def check_lasting_outliers(trials: TrialData, result: CalibrationFit, found: PredictedTrials) -> None:
    """Raise CalibrationError if outliers begin at a stop and last: of one camera, of one marker, or of
    all.
    """
    c, _, m = found.seen.shape
    cameras = [_lasting(found.outliers[k], found.seen[k]) for k in range(c)]
    moved = [stop for stop in cameras if stop is not None]
    if moved:
        raise moved_part(trials, solution_with_all_pixels(trials, result), min(moved))
    slipped = {}
    for marker in range(m):
        stop = _lasting(found.outliers[:, :, marker].T, found.seen[:, :, marker].T)
        if stop is not None:
            slipped[found.marker_ids[marker]] = stop
    if len(slipped) > max(1, m // 4):
        raise CalibrationError(
            "markers_disagree",
            f"markers {sorted(slipped)} do not fit before or after stop {min(slipped.values())}, the others do: "
            "they are not one rigid body, or the images of that stretch lead a joint's axis astray. Run the trials "
            "again, with larger motions or less noise",
            markers=sorted(slipped),
            stop=min(slipped.values()),
        )
    if slipped:
        raise marker_slipped(*next(iter(slipped.items())))


def marker_slipped(marker: int, stop: int) -> CalibrationError:
    """Error that a marker was moved on its body before ``stop``."""
    return CalibrationError(
        "marker_slipped",
        f"marker {marker} slipped between stops {stop - 1} and {stop}: it jumps in all cameras and stays off, the "
        "others do not. Fasten it, or leave it out, and run the trials again",
        marker=marker,
        stop=stop,
    )


def _lasting(outliers: BoolArray, seen: BoolArray) -> int | None:
    """Stop that separates pixels (s, ...) that are mostly outliers from others with few, on either side
    (the model follows the longer part); None if there is none.
    """
    after = _begun(outliers, seen)
    if after is not None:
        return after
    before = _begun(outliers[::-1], seen[::-1])
    return None if before is None else len(outliers) - before


def _begun(outliers: BoolArray, seen: BoolArray) -> int | None:
    """First stop from which most of the pixels (s, ...) are outliers while few are before; None if there is
    none.
    """
    s = len(outliers)
    bad = outliers.reshape(s, -1).sum(axis=1)
    shown = seen.reshape(s, -1).sum(axis=1)
    # For each stop k: outliers from k on, minus inliers from k on, minus twice the outliers before it.
    gain = 2 * bad - shown
    score = gain.sum() - (np.cumsum(gain) - gain) - 2 * (np.cumsum(bad) - bad)
    k = int(score.argmax())
    stops_after = int((shown[k:] > 0).sum())
    if k == 0 or stops_after < LASTING_STOPS:
        return None
    lasting = bad[k:].sum() >= LASTING * shown[k:].sum() and bad[:k].sum() <= 0.1 * max(1, shown[:k].sum())
    return k if lasting else None


def _exchanged_stops(found: PredictedTrials) -> npt.NDArray[np.int64]:
    """Stops at which cameras 0 and 1 agree with each other's predictions."""
    pair = found.expected[[1, 0]]
    crossed = found.near(found.pixels, np.concatenate([pair, found.expected[2:]]))[:2]
    both = found.outliers[:2].sum(axis=(0, 2))
    hits = (crossed & found.outliers[:2]).sum(axis=(0, 2))
    return np.flatnonzero((both > 0) & (hits >= MOST * both) & (hits >= 2))


def _exchanged_ids(found: PredictedTrials, rest: BoolArray) -> list[tuple[int, int, int, npt.NDArray[np.int64]]]:
    """Cameras and pairs of markers that agree with each other's predictions, with the stops (k,)."""
    pairs: dict[tuple[int, int, int], list[int]] = {}
    for camera, stop, a in np.argwhere(rest):
        distance = np.linalg.norm(found.expected[camera, stop] - found.pixels[camera, stop, a], axis=1)
        b = int(distance.argmin())
        if b <= a or distance[b] > NEAR * found.sigmas[camera, stop, a] or not rest[camera, stop, b]:
            continue
        back = np.linalg.norm(found.expected[camera, stop, a] - found.pixels[camera, stop, b])
        if back <= NEAR * found.sigmas[camera, stop, b]:
            pairs.setdefault((int(camera), int(a), b), []).append(int(stop))
    return [(*key, np.array(stops)) for key, stops in pairs.items()]


def _wrong_stop(trials: TrialData, found: PredictedTrials, stop: int) -> str:
    """Description of a stop whose pixels are all outliers: the positions of a neighbouring stop explain them, or
    no positions do.
    """
    joint = int(trials.trials[stop])
    prefix = f"stop {stop} does not fit in any camera and was left out"
    if joint < 0:
        return f"{prefix}: are its joint positions right?"
    name, unit = trials.joint_names[joint], "rad" if trials.joint_kinds[joint] == "revolute" else "m"
    own = trials.positions[trials.trials == joint, joint]
    tried = np.linspace(own.min(), own.max(), 401)
    offsets = np.repeat((trials.positions[stop] - found.zero)[None], len(tried), axis=0)
    offsets[:, joint] = tried - found.zero[joint]
    distance = np.linalg.norm(expected_pixels(found.rig, offsets) - found.pixels[:, stop][:, None], axis=-1)
    typical = np.nanmedian(
        distance.reshape(len(found.pixels), len(tried), -1).transpose(1, 0, 2).reshape(len(tried), -1), axis=1
    )
    best = int(typical.argmin())
    step = float(tried[1] - tried[0])
    nearest = float(np.median(found.sigmas[:, stop])) * NEAR
    # The grid is coarse: an error of half a step of motion in the image is not an error of the stop.
    slack = float(np.abs(np.diff(typical)).max())
    if typical[best] > nearest + slack:
        return f"{prefix}: no position of joint {name!r} explains its images"
    return (
        f"{prefix}: its images show joint {name!r} near {tried[best]:.4g} ± {step:.2g} {unit}, reported was "
        f"{trials.positions[stop, joint]:.4g} {unit} (late, or early)"
    )


def _share(outliers: BoolArray, seen: BoolArray, axis: tuple[int, ...]) -> FloatArray:
    return np.asarray(outliers.sum(axis=axis) / np.maximum(1, seen.sum(axis=axis)))


def _stops(stops: npt.NDArray[np.int64]) -> str:
    """Stop numbers as text."""
    listed = ", ".join(str(int(stop)) for stop in stops[:12])
    return f"stop{'s' if len(stops) > 1 else ''} {listed}" + (f" and {len(stops) - 12} more" if len(stops) > 12 else "")


SUSPICIOUS_OUTLIERS = 0.01
"""Share of outliers from which a fit above the noise floor is diagnosed."""
DEGREES, ABOUT = float(np.degrees(1.0)), 2.0
"""Scale factor of a joint that reports degrees, and largest ratio, either way, of a coarse factor to the true one."""
UNDERSTATED = 1.5
"""Ratio of the tracks' scatter to the stated sigmas from which the detector noise is tested."""
UNEVEN = 1.5
"""Ratio of the residuals of two joints' trials up to which they have a common noise."""
NOTABLE = 0.1
"""Share of the largest relative error of a joint from which other joints are named, too."""
WHITE = 0.8
"""Ratio of noise about smooth tracks to the residual, both after the fit, from which the residual is only noise."""


def underestimated_noise(trials: TrialData, refit: Refit, options: FitOptions) -> CalibrationError | None:
    """Error for stated sigmas that are too small, or for joint errors of that size; None unless the trials fit with the
    sigmas estimated from the markers' tracks, and only noise is left.
    """
    scatter = path_noise(trials)
    if not float(scatter.max()) > UNDERSTATED:
        return None
    corrected = msgspec.structs.replace(trials, sigmas=trials.sigmas * np.maximum(scatter, 1.0)[:, None])
    result = fit_of_correction(corrected, refit, options)
    if result is None:
        return None
    factor = result.report.sigma_factor
    used = result.model.statistics
    assert used is not None
    smooth = float(np.median(path_noise(residual_trials(corrected, result)))) < WHITE * factor
    wild = used.outliers > SUSPICIOUS_OUTLIERS * (used.measurements // 2 + used.outliers)
    uneven = max(joint.rms_px for joint in used.joints) > UNEVEN * min(joint.rms_px for joint in used.joints)
    if smooth or wild or uneven:
        return None  # not only noise: the model is wrong, or positions or times are
    solution = solution_of(corrected, result)
    joints = estimate_components(reduced_rows(solution, readings(solution.data.offsets)), scales=False)
    # An effect common to all markers of a stop is no pixel noise.
    if joints is not None and joints.significant and joints.pixels * float(scatter.max()) ** 2 < UNDERSTATED**2:
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
    """Error for joints whose readings are so inaccurate that no fit starts from them."""
    deviations = np.sqrt(found.random + found.repeatable)
    ranges = np.ptp(trials.positions, axis=0)
    listed = ", ".join(
        f"{trials.joint_names[j]!r} by {1e3 * deviations[j]:.2g} {'mrad' if kind == 'revolute' else 'mm'} "
        f"({deviations[j] / ranges[j]:.0%} of its travel)"
        for j, kind in enumerate(trials.joint_kinds)
        if deviations[j] > NOTABLE * float((deviations / ranges).max()) * ranges[j]
    )
    return CalibrationError(
        "joints_inexact",
        f"the joints do not stand where they report: joint {listed}, as standard deviations. That is too much beside "
        "their motion for a fit; the pixels scatter as stated",
        joints={name: float(one) for name, one in zip(trials.joint_names, deviations, strict=True)},
    )


def residual_trials(trials: TrialData, result: CalibrationFit) -> TrialData:
    """The trials with the model's residuals in place of the pixels: steps remain and smooth tracks vanish."""
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
    """Error for revolute joints whose positions have a wrong scale, if the trials fit without it; else None."""
    factors = trial_scales(trials, *views)
    if (factors == 1.0).all():
        return None
    for tried in _likely_factors(trials, factors):
        corrected = with_scales_removed(trials, tried)
        result = fit_of_correction(corrected, refit, options)
        if result is not None:
            return scale_error(trials, corrected, result, tried)
    return None


def _likely_factors(trials: TrialData, factors: FloatArray) -> list[FloatArray]:
    """Factors (n,) to try, most likely first: a unit that most revolute joints share, and so perhaps all; degrees;
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
    trials: TrialData, corrected: TrialData, result: CalibrationFit, factors: FloatArray
) -> CalibrationError | None:
    """Error that states wrong scales: the removed ``factors`` (n,), refined with the model of the
    ``corrected`` trials; None if none is left.
    """
    found = {}
    for scale in model_scales(solution_of(corrected, result)):
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
        joints={name: {"factor": scale.factor, "deviation": scale.deviation} for name, scale in found.items()},
    )
