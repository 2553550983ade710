"""Why a calibration fails: causes named where they can be told, instead of the stage at which the fit gave up.

A cause is a hypothesis that undoes some damage: with the views of some stops exchanged back, two ids exchanged, an
angle divided by a factor, the fit must succeed, or it is not named. What cannot be told is said to be possible.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.geometry.errors import GeometryError
from stereoservo.kinematics.calibration.bundle import Measurements, Solution, solve
from stereoservo.kinematics.calibration.charts import Kind
from stereoservo.kinematics.calibration.exchanges import (
    exchanged_ids,
    exchanged_views,
    views_unrelated,
    with_ids_exchanged,
    with_views_exchanged,
)
from stereoservo.kinematics.calibration.lens_starts import straight_lenses, undistorted
from stereoservo.kinematics.calibration.lenses import FREE_LENS, prior_of_lenses
from stereoservo.kinematics.calibration.outlier_causes import (
    camera_moved,
    expected_pixels,
    explain_outliers,
    marker_slipped,
    model_rig,
    moved_together,
    predictions,
)
from stereoservo.kinematics.calibration.report import CalibrationResult
from stereoservo.kinematics.calibration.rig import Rig
from stereoservo.kinematics.calibration.scales import (
    Scale,
    corrected,
    model_scales,
    prismatic_ratios,
    trial_scales,
)
from stereoservo.kinematics.calibration.separate import MIN_SHOWN, best_start, trial_stops, virtual_markers
from stereoservo.kinematics.calibration.strata import FitOptions
from stereoservo.kinematics.calibration.tracks import find_step, path_noise, paths_are_smooth
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData
from stereoservo.kinematics.calibration.views import first_views

FloatArray = npt.NDArray[np.float64]
Views = tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]
Refit = Callable[[TrialData, FitOptions], CalibrationResult]

PLAIN = frozenset(
    {
        "bad_data",
        "too_few_cameras",
        "mixed_mounts",
        "joint_did_not_move",
        "joint_without_effect",
    }
)
"""Codes that name their cause themselves."""
MISFITS = frozenset(
    {"joint_kind", "views_degenerate", "no_convergence", "too_many_outliers", "residual_above_floor"}
)
"""Codes of data that contradict themselves: what does not fit may tell why."""
FEW_OUTLIERS = 0.1
"""Share of pixels that a fit may leave out for its hypothesis to count."""
LENIENT_OUTLIERS, LENIENT_TRIAL_OUTLIERS = 0.6, 0.85
"""Shares of outliers with which a fit serves to explain them."""
KIND_BETTER = 1.25
"""How many times better a joint's trial must fit the other kind; the fit of all joints decides then."""
SUSPICIOUS_OUTLIERS = 0.01
"""Share of outliers from which a fit above the noise floor is looked into."""
PLANAR_MODULI = 0.1
"""Spread of the moduli of a plane's eigenvalues from stop to stop above which it has left itself."""


DEGREES, ABOUT = float(np.degrees(1.0)), 2.0
"""Factor of a joint that reports degrees, and how many times, either way, a coarse factor may be off a true one."""
UNDERSTATED = 1.5
"""How many times the stated sigmas paths must scatter for the detector to be looked into."""
UNEVEN = 1.5
"""Residual of one joint's trial over another's up to which both are one noise."""
WHITE = 0.8
"""Noise about smooth paths in what a model leaves, over its residual, from which the residual is noise alone."""


@dataclass(frozen=True)
class Hypothesis:
    """A cause, and the ``trials`` without it."""

    code: str
    message: str
    data: dict[str, Any]
    trials: TrialData


def diagnosed(
    trials: TrialData, error: CalibrationError, refit: Refit, options: FitOptions
) -> CalibrationError:
    """The error that names the cause of ``error``, or ``error`` with what is possible.

    ``refit`` fits trial data anew. Tries hypotheses until one makes the data fit; costs some fits.
    """
    if error.code in PLAIN:
        return error
    if error.code == "views_degenerate" and "rms_px" in error.data:
        return _plane_or_baseline(trials, error)
    try:
        named = _named(trials, refit, options)
    except (GeometryError, np.linalg.LinAlgError):
        named = None  # data on which the search for a cause breaks down, too: the first error stands
    if named is not None and named.code == "noise_understated":
        # What was measured stays worth reading: the residual of each joint.
        return CalibrationError(named.code, named.message, **{**error.data, **named.data})
    if named is not None:
        return named
    if error.code == "too_few_stops" and error.data.get("markers_lost", 0):
        return _contradicting(trials, error)
    return _explained(trials, error, refit, options) if error.code in MISFITS else error


def _named(
    trials: TrialData, refit: Refit, options: FitOptions, left: TrialData | None = None
) -> CalibrationError | None:
    """The error of the first cause that holds, cheap ones first. ``left``: what a model leaves of the trials."""
    for hypothesis in _exchange_hypotheses(trials):
        if _fits(hypothesis.trials, refit, options) is not None:
            return CalibrationError(hypothesis.code, hypothesis.message, **hypothesis.data)
    stepped = _stepped(trials if left is None else left)
    if stepped is not None:
        return stepped
    understated = _understated(trials, refit, options)
    if understated is not None:
        return understated
    if paths_are_smooth(trials):
        noise = np.maximum(path_noise(trials), 1.0)
        noisy = msgspec.structs.replace(trials, sigmas=trials.sigmas * noise[:, None])
        for k in range(1, len(trials.cameras)):
            if views_unrelated(noisy, k):
                return _unrelated(trials, k)
    try:
        views = _views(trials)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None  # without cameras no joint can be looked at
    for hypothesis in _kind_hypotheses(trials, views):
        if _fits(hypothesis.trials, refit, options) is not None:
            return CalibrationError(hypothesis.code, hypothesis.message, **hypothesis.data)
    scaled = _scaled(trials, views, refit, options)
    if scaled is not None:
        return scaled
    for hypothesis in _order_hypotheses(trials, refit, options):
        if _fits(hypothesis.trials, refit, options) is not None:
            return CalibrationError(hypothesis.code, hypothesis.message, **hypothesis.data)
    return None


def _fits(trials: TrialData, refit: Refit, options: FitOptions) -> CalibrationResult | None:
    """The fit of a hypothesis, or None where it does not make the data fit."""
    try:
        result = refit(trials, options)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None
    used = result.model.statistics
    assert used is not None
    pixels = used.measurements // 2 + used.outliers
    return result if used.outliers <= FEW_OUTLIERS * pixels else None


def _exchange_hypotheses(trials: TrialData) -> Iterator[Hypothesis]:
    """Views exchanged at some stops, ids exchanged throughout."""
    for k in range(1, len(trials.cameras)):
        names = [trials.cameras[0].name, trials.cameras[k].name]
        stops = exchanged_views(trials, k)
        if len(stops):
            yield Hypothesis(
                "views_exchanged",
                f"the images of cameras {names[0]!r} and {names[1]!r} are exchanged at {len(stops)} of "
                f"{len(trials.positions)} stops: {stops.tolist()}. With them exchanged back the trials fit",
                {"stops": stops.tolist(), "cameras": names},
                with_views_exchanged(trials, k, stops),
            )
        pair = exchanged_ids(trials, k)
        if pair is not None:
            yield ids_exchanged(trials, k, pair)


def ids_exchanged(trials: TrialData, k: int, pair: tuple[int, int]) -> Hypothesis:
    """Two markers (indices) exchanged throughout in camera ``k`` or in the first one: with two cameras that is a
    naming.
    """
    a, b = (trials.marker_ids[i] for i in pair)
    names = [trials.cameras[0].name, trials.cameras[k].name]
    where = f"camera {names[1]!r} or {names[0]!r}" if k == 1 else f"camera {names[1]!r}"
    return Hypothesis(
        "markers_exchanged",
        f"markers {a} and {b} are exchanged in {where} at all stops: they fit the epipolar geometry the other way "
        "round",
        {"markers": [a, b], "cameras": names if k == 1 else names[1:]},
        with_ids_exchanged(trials, k, *pair),
    )


def _stepped(trials: TrialData) -> CalibrationError | None:
    """The error of a step in the markers' paths, if there is one."""
    step = find_step(trials)
    if step is None:
        return None
    if len(step.cameras) < len(trials.cameras):
        return camera_moved(trials, step.cameras[0], step.stop)
    if len(step.markers) < len(trials.marker_ids):
        return marker_slipped(trials.marker_ids[step.markers[0]], step.stop)
    return moved_together(step.stop)


def _understated(trials: TrialData, refit: Refit, options: FitOptions) -> CalibrationError | None:
    """The error of sigmas stated too small, if the trials fit with those that the markers' paths tell, and what the
    model leaves then is noise.
    """
    told = path_noise(trials)
    if not float(told.max()) > UNDERSTATED:
        return None
    mended = msgspec.structs.replace(trials, sigmas=trials.sigmas * np.maximum(told, 1.0)[:, None])
    result = _fits(mended, refit, options)
    if result is None:
        return None
    factor = result.report.sigma_factor
    used = result.model.statistics
    assert used is not None
    smooth = float(np.median(path_noise(_left_by(mended, result)))) < WHITE * factor
    wild = used.outliers > SUSPICIOUS_OUTLIERS * (used.measurements // 2 + used.outliers)
    uneven = max(joint.rms_px for joint in used.joints) > UNEVEN * min(joint.rms_px for joint in used.joints)
    if smooth or wild or uneven:
        return None  # noise is none of these: the model is wrong, or positions or times are
    kept = [trials.marker_ids.index(i) for i in result.model.marker_ids]
    factors = np.maximum(told[:, kept], 1.0) * factor
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


def _left_by(trials: TrialData, result: CalibrationResult) -> TrialData:
    """The trials with what the model leaves of their pixels: a step stays one, and smooth paths leave noise."""
    found = predictions(trials, result)
    return msgspec.structs.replace(
        trials,
        marker_ids=found.marker_ids,
        pixels=found.pixels - found.expected,
        sigmas=trials.sigmas[:, :, [trials.marker_ids.index(i) for i in found.marker_ids]],
    )


def _scaled(trials: TrialData, views: Views, refit: Refit, options: FitOptions) -> CalibrationError | None:
    """The error of revolute joints whose positions are off by factors, if the trials fit without them."""
    factors = trial_scales(trials, *views)
    if (factors == 1.0).all():
        return None
    for tried in _likely_factors(trials, factors):
        mended = corrected(trials, tried)
        result = _fits(mended, refit, options)
        if result is not None:
            return scale_error(trials, mended, result, tried)
    return None


def _likely_factors(trials: TrialData, factors: FloatArray) -> list[FloatArray]:
    """Factors (n,) to try for those that the joints' own trials tell coarsely, the likeliest first: a unit that most
    revolute joints share, and so perhaps all; degrees; their own.
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
    trials: TrialData, mended: TrialData, result: CalibrationResult, factors: FloatArray
) -> CalibrationError | None:
    """The error of wrong scales: ``factors`` (n,) that were divided out, refined with the model of the ``mended``
    trials; None where none is left.
    """
    found = {}
    for scale in model_scales(solution_of(mended, result)):
        whole = Scale(
            scale.joint, scale.factor * factors[scale.joint], scale.deviation * factors[scale.joint]
        )
        if whole.wrong:
            found[trials.joint_names[scale.joint]] = whole
    if not found:
        return None
    told = ", ".join(
        f"{name!r} reports {scale.factor:.5g} ± {scale.deviation:.1g} times its motion"
        + (" (degrees, not radians)" if abs(np.degrees(1.0) / scale.factor - 1.0) < 0.02 else "")
        for name, scale in found.items()
    )
    return CalibrationError(
        "wrong_scale",
        f"joint {told}. Revolute joints must report radians: correct the drive's scale",
        joints={
            name: {"factor": scale.factor, "deviation": scale.deviation} for name, scale in found.items()
        },
    )


def _views(trials: TrialData) -> Views:
    """Cameras, points and usable pixels, as pinholes see them."""
    return first_views(undistorted(trials, straight_lenses(trials)))


def _kind_hypotheses(trials: TrialData, views: Views) -> Iterator[Hypothesis]:
    """The other kind for a joint whose own trial fits it much better."""
    cameras, points, usable = views
    fits: dict[int, tuple[float, float, Kind]] = {}
    for joint, said in enumerate(trials.joint_kinds):
        try:
            stops, groups, base = trial_stops(trials, points, joint)
        except CalibrationError:
            continue  # too few stops to tell a kind by
        sights = virtual_markers(trials, points, usable, stops, groups)
        way = trials.positions[stops, joint] - base[joint]
        other: Kind = "prismatic" if said == "revolute" else "revolute"
        as_said, as_other = (
            best_start(kind, cameras, sights, way, thorough=True)[1] for kind in (said, other)
        )
        fits[joint] = as_said, as_other, other
    # The other kind must reach what the other joints do; a joint that fits neither way is no case of this.
    floor = float(np.median([min(least, instead) for least, instead, _ in fits.values()])) if fits else 0.0
    for joint, (least, instead, other) in fits.items():
        if not instead < min(KIND_BETTER * floor, least / KIND_BETTER):
            continue
        name, said = trials.joint_names[joint], trials.joint_kinds[joint]
        kinds = tuple(other if j == joint else kind for j, kind in enumerate(trials.joint_kinds))
        yield Hypothesis(
            "joint_kind",
            f"joint {name!r} is said to be {said}, but is {other}: as such its trial fits to {instead:.3g} sigmas, as "
            f"stated to {least:.3g}",
            {"joint": name, "kind": other},
            msgspec.structs.replace(trials, joint_kinds=kinds),
        )


def _order_hypotheses(trials: TrialData, refit: Refit, options: FitOptions) -> Iterator[Hypothesis]:
    """Two joints exchanged, or all reversed, where free poses contradict the order that the joint trials leave open."""
    free = trials.trials < 0
    n = len(trials.joint_names)
    if not free.any() or n < 2:
        return
    alone = _fits(
        msgspec.structs.replace(
            trials,
            positions=trials.positions[~free],
            trials=trials.trials[~free],
            pixels=trials.pixels[:, ~free],
            sigmas=trials.sigmas[:, ~free],
        ),
        refit,
        options,
    )
    if alone is None:
        return
    rig, kept = model_rig(alone.model), [trials.marker_ids.index(i) for i in alone.model.marker_ids]
    seen = trials.pixels[:, free][:, :, kept]
    orders = [np.arange(n)[::-1]]
    for a, b in combinations(range(n), 2):
        order = np.arange(n)
        order[[a, b]] = b, a
        orders.append(order)
    typical = []
    for order in orders:
        moved = replace(rig, kinds=tuple(rig.kinds[j] for j in order), generators=rig.generators[order])
        expected = expected_pixels(moved, (trials.positions[free] - alone.model.zero)[:, order])
        typical.append(float(np.nanmedian(np.linalg.norm(expected - seen, axis=-1))))
    order = orders[int(np.argmin(typical))]
    names = [trials.joint_names[j] for j in order]
    moved_ones = [name for name, own in zip(names, trials.joint_names, strict=True) if name != own]
    yield Hypothesis(
        "joint_order",
        f"the joints do not follow one another as listed: free poses fit with the order {names}, base first. "
        f"Exchanged are {moved_ones}",
        {"order": names, "joints": moved_ones},
        in_order(trials, order),
    )


def in_order(trials: TrialData, order: npt.NDArray[np.int64]) -> TrialData:
    """The trials with their joints in another ``order`` (n,), base first."""
    place = np.argsort(order)
    return msgspec.structs.replace(
        trials,
        joint_names=tuple(trials.joint_names[j] for j in order),
        joint_kinds=tuple(trials.joint_kinds[j] for j in order),
        positions=trials.positions[:, order],
        trials=np.where(trials.trials >= 0, place[trials.trials], trials.trials),
    )


def _explained(
    trials: TrialData, error: CalibrationError, refit: Refit, options: FitOptions
) -> CalibrationError:
    """The error with what the outliers of a lenient fit have in common, or with what is possible."""
    lenient = replace(options, max_outliers=LENIENT_OUTLIERS, max_trial_outliers=LENIENT_TRIAL_OUTLIERS)
    try:
        result = refit(trials, lenient)
        notes = explain_outliers(trials, result)
    except CalibrationError as other:
        if other.code in ("camera_moved", "marker_slipped", "moved_together", "markers_disagree"):
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
        f"{error.message}. Not told apart: positions reported wrongly or at another time than the images, play, "
        "a camera or marker that moved more than once, many wrong detections",
        **error.data,
    )


def _unrelated(trials: TrialData, k: int) -> CalibrationError:
    names = [trials.cameras[0].name, trials.cameras[k].name]
    return CalibrationError(
        "views_unrelated",
        f"cameras {names[0]!r} and {names[1]!r} agree on no epipolar geometry, not even within single trials: they do "
        "not see the same markers at the same time. Do they look at two arms, are ids mixed up, are images late?",
        cameras=names,
    )


def _contradicting(trials: TrialData, error: CalibrationError) -> CalibrationError:
    """The error of a joint whose stops are lost because cameras contradict each other, not because they see nothing."""
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


def _plane_or_baseline(trials: TrialData, error: CalibrationError) -> CalibrationError:
    """Which of the two leaves the epipolar geometry open: all markers on one plane, or one centre of projection."""
    out_of_plane = _leaves_its_plane(trials)
    rms, sigma = error.data["rms_px"], error.data.get("sigma_px", float("nan"))
    told = f"what two cameras see in common is one homography to {rms:.3g} px, at sigmas of {sigma:.3g} px"
    if out_of_plane:
        return CalibrationError(
            "no_baseline",
            f"{told}, though the markers do not stay in one plane: the cameras have (nearly) one centre. Their "
            f"parallax is at most {rms:.3g} px, {rms / sigma:.2g} sigmas. Move them apart",
            parallax_px=rms,
            parallax_sigmas=rms / sigma,
        )
    return CalibrationError(
        "views_degenerate",
        f"{told}: all markers stay in one plane in all trials, or the cameras have (nearly) one centre (parallax at "
        f"most {rms / sigma:.2g} sigmas). Add markers off the plane, or move the cameras apart",
        **error.data,
    )


def _leaves_its_plane(trials: TrialData) -> bool:
    """Whether the markers in the first camera move as points of one plane that stays in itself never do.

    A motion of a plane in itself has, in the image too, eigenvalues of one modulus; markers off one plane have no
    homography from stop to stop at all.
    """
    pixels, sigmas = trials.pixels[0], trials.sigmas[0]
    signs = []
    for joint in range(len(trials.joint_names)):
        own = np.flatnonzero(trials.trials == joint)
        if len(own) < 2:
            continue
        first, last = own[0], own[-1]
        both = np.isfinite(pixels[[first, last]]).all(axis=(0, 2))
        if int(both.sum()) < 4:
            continue
        before, after = pixels[first, both], pixels[last, both]
        H, _ = cv2.findHomography(before, after, 0)
        if H is None or not np.linalg.det(H) > 0.0:
            continue  # markers on a line at one of the two stops
        mapped = np.hstack([before, np.ones((len(before), 1))]) @ H.T
        misfit = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - after, axis=1) / sigmas[last, both]
        moduli = np.abs(np.linalg.eigvals(H / np.cbrt(np.linalg.det(H))))
        signs.append(
            float(np.median(misfit)) > 10.0 or float(np.ptp(moduli)) > PLANAR_MODULI * float(moduli.max())
        )
    return bool(signs) and float(np.mean(signs)) >= 0.5


def reviewed(
    trials: TrialData, result: CalibrationResult, refit: Refit, options: FitOptions
) -> tuple[str, ...]:
    """What is to be said of a fit that succeeded: its outliers' causes, scales of prismatic joints that disagree.

    Raises CalibrationError where the model is of a cell that is no more (a camera or marker moved), where two ids are
    exchanged throughout, or where revolute joints report wrong scales.
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
        left = _left_by(trials, result)
        named = _named(trials, refit, options, left) if suspicious else _stepped(left)
        if named is not None:
            raise named
    nearly = not statistics.chi2_ok or any("follow" in note for note in result.report.notes)
    # Distortion that was to be left out bends the tracks of revolute joints as a wrong scale would.
    bent = result.report.lens.model == "none" and result.report.lens.chi2 > result.report.lens.limit
    if nearly and not bent:
        wrong = scale_error(trials, trials, result, np.ones(len(trials.joint_names)))
        if wrong is not None:
            raise wrong
    if trials.joint_kinds.count("prismatic") > 1:
        for ratio in prismatic_ratios(result, solution_of(trials, result)):
            if ratio.wrong:
                first = trials.joint_names[trials.joint_kinds.index("prismatic")]
                notes.append(
                    f"joint {trials.joint_names[ratio.joint]!r} reports {ratio.factor:.5g} ± {ratio.deviation:.1g} "
                    f"times what joint {first!r} does for the same way: check the drives' scales. The model absorbs it"
                )
    return tuple(notes)


def untested(trials: TrialData) -> tuple[str, ...]:
    """What the trials cannot tell: the order of joints that only ever move alone, from one configuration."""
    n = len(trials.joint_names)
    free = bool((trials.trials < 0).any())
    bases = [
        np.median(trials.positions[trials.trials == j], axis=0)
        for j in range(n)
        if (trials.trials == j).any()
    ]
    moved = bool(bases) and float(np.ptp(np.array(bases), axis=0).max(initial=0.0)) > 0.02
    if n < 2 or free or moved:
        return ()
    return (
        "the order of the joints and the mount of the cameras: they move one at a time from one configuration, so the "
        "model takes what the cell states. Free poses, or trials from different configurations, would test it",
    )


def solution_of(trials: TrialData, result: CalibrationResult) -> Solution:
    """The final bundle of a fit again, from its model: linearised in the frame of its stratum, not moved."""
    model = result.model
    frame: FloatArray = np.eye(4)
    if model.stratum == "affine":
        frame[3] = model.plane_at_infinity
    elif model.projective_to_euclidean is not None:
        frame = model.projective_to_euclidean
    back = np.linalg.inv(frame)
    points = model.marker_points @ frame.T
    plain = model_rig(model)
    rig = Rig(
        model.joint_kinds,
        frame @ model.generators @ back,
        plain.cameras @ back,
        points / points[:, 3:] if model.stratum != "projective" else points,
        plain.lenses,
    )
    kept = [trials.marker_ids.index(i) for i in model.marker_ids]
    used = trials.visible[:, :, kept]
    names = [camera.name for camera in trials.cameras]
    for outlier in result.report.outliers:
        used[names.index(outlier.camera), outlier.stop, model.marker_ids.index(outlier.marker)] = False
    camera, stop, marker = np.nonzero(used)
    data = Measurements(
        trials.positions - model.zero,
        camera,
        stop,
        marker,
        trials.pixels[:, :, kept][used],
        trials.sigmas[:, :, kept][used],
        prior_of_lenses(trials, {}),
    )
    bent = any(camera.lens[0] != 0.0 for camera in model.cameras)
    return solve(rig, data, model.stratum, lenses=FREE_LENS if bent else "none", max_evaluations=1)
