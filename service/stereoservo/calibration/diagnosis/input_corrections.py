"""Hypothetical corrections of calibration data that may make the model fit: exchange of views, marker ids, joint kinds
or the joints' order; and the fit of each.
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

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.initial_reconstruction import MIN_MATCHES, initial_reconstruction
from stereoservo.calibration.lens_estimation import prior_of_lenses, undistorted, undistorted_lenses
from stereoservo.calibration.rig_model import Measurements, expected_pixels, projective_rig, stratum_rig
from stereoservo.calibration.single_joint_fit import best_single_joint, own_trials
from stereoservo.calibration.stratum_selection import FitOptions
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.calibration.variance_components import noise_of_accuracy, readings
from stereoservo.geometry.fundamental import INLIER_SIGMAS, fundamental_robust, sampson_distances
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.parameterization import Kind, lens_model_of
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

AGREES = 0.9
"""Share of matches that must fit one epipolar geometry after an exchange is undone."""
BETTER = 20.0
"""Least gain in chi-square of a stop from exchanging its views."""
CAP = 50.0
"""Largest chi-square of a match: a single wrong one must not decide for its stop."""
UNRELATED = 0.75
"""Share of a single trial's matches below which two cameras count as seeing different points."""
FEW_MARKERS = 7
"""Largest number of markers for which every pair of ids is tried; above, only those that do not fit."""
ROUNDS = 6
"""Most rounds of undoing exchanges and estimating again."""


def exchanged_views(trials: TrialData, k: int) -> IntArray:
    """Stops at which the images of cameras 0 and ``k`` are exchanged: at most half of them, since exchanging all
    is equivalent to renaming the cameras.
    """
    exchanged = np.zeros(len(trials.positions), dtype=bool)
    for _ in range(ROUNDS):
        F = robust_fundamental(with_views_exchanged(trials, k, exchanged), k)
        if F is None:
            return np.zeros(0, dtype=np.int64)
        again = _stop_costs(trials, F, k, True) + BETTER < _stop_costs(trials, F, k, False)
        if np.array_equal(again, exchanged):
            break
        exchanged = again
    if 2 * int(exchanged.sum()) > len(exchanged):
        exchanged = ~exchanged
    return np.flatnonzero(exchanged)


def with_views_exchanged(trials: TrialData, k: int, stops: IntArray | BoolArray) -> TrialData:
    """The trials with the images of cameras 0 and ``k`` exchanged at ``stops``."""
    pixels, sigmas = trials.pixels.copy(), trials.sigmas.copy()
    for array, source in ((pixels, trials.pixels), (sigmas, trials.sigmas)):
        array[0, stops], array[k, stops] = source[k, stops], source[0, stops]
    return msgspec.structs.replace(trials, pixels=pixels, sigmas=sigmas)


def exchanged_ids(trials: TrialData, k: int) -> tuple[int, int] | None:
    """Two markers (indices) whose ids are exchanged between cameras 0 and ``k`` at all stops; None if none fit."""
    m = len(trials.marker_ids)
    F = robust_fundamental(trials, k)
    shares = np.zeros(m) if F is None else _marker_shares(trials, F, k)
    if m > FEW_MARKERS:
        suspects = np.flatnonzero(shares < 0.5).tolist()
        if F is None or len(suspects) < 2:
            return None
        for a, b in combinations(suspects, 2):
            again = _marker_shares(with_ids_exchanged(trials, k, a, b), F, k)
            if min(again[a], again[b]) >= AGREES:
                return a, b
        return None
    best, least = None, AGREES
    for a, b in combinations(range(m), 2):
        corrected = with_ids_exchanged(trials, k, a, b)
        F = robust_fundamental(corrected, k)
        share = 0.0 if F is None else float(np.nanmean(_marker_shares(corrected, F, k)))
        if share >= least:
            best, least = (a, b), share
    return best


def with_ids_exchanged(
    trials: TrialData, camera: int, a: int, b: int, stops: IntArray | slice = slice(None)
) -> TrialData:
    """The trials with the ids of markers ``a`` and ``b`` (indices) exchanged in one camera at ``stops``."""
    pixels, sigmas = trials.pixels.copy(), trials.sigmas.copy()
    for array, source in ((pixels, trials.pixels), (sigmas, trials.sigmas)):
        array[camera, stops, a], array[camera, stops, b] = source[camera, stops, b], source[camera, stops, a]
    return msgspec.structs.replace(trials, pixels=pixels, sigmas=sigmas)


def views_unrelated(trials: TrialData, k: int) -> bool:
    """Whether cameras 0 and ``k`` share no epipolar geometry in most single trials, so that they cannot see the
    same points.
    """
    verdicts = []
    for joint in range(len(trials.joint_names)):
        own = trials.trials == joint
        part = msgspec.structs.replace(trials, pixels=np.where(own[:, None, None], trials.pixels, np.nan))
        left, right, sigma = _matches(part, k)
        if len(left) < MIN_MATCHES:
            continue
        try:
            _, inliers = fundamental_robust(left, right, 2.0 * sigma)
            verdicts.append(float(inliers.mean()) < UNRELATED)
        except GeometryError as error:
            verdicts.append(error.code != "degenerate")  # coplanar points count as related
    return bool(verdicts) and float(np.mean(verdicts)) > 0.5


def robust_fundamental(trials: TrialData, k: int) -> FloatArray | None:
    """Robust F (3, 3) of cameras 0 and ``k`` that fits most of their matches; None if there is none."""
    left, right, sigma = _matches(trials, k)
    best, most = None, 0.0
    if len(left) < MIN_MATCHES:
        return None
    for scale in (1.0, 4.0):
        try:
            F, inliers = fundamental_robust(left, right, scale * sigma)
        except GeometryError:
            continue  # no geometry at this noise; the larger one may give one
        if float(inliers.mean()) / np.sqrt(scale) > most:
            best, most = F, float(inliers.mean()) / np.sqrt(scale)
    return best


def _matches(trials: TrialData, k: int) -> tuple[FloatArray, FloatArray, float]:
    """Matches (n, 2) of cameras 0 and ``k``, and their typical sigma [px]."""
    left, right = trials.pixels[0].reshape(-1, 2), trials.pixels[k].reshape(-1, 2)
    seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
    squares = trials.sigmas[0].ravel()[seen] ** 2 + trials.sigmas[k].ravel()[seen] ** 2
    return left[seen], right[seen], float(np.sqrt(np.median(squares) / 2)) if seen.any() else 0.0


def _distances(trials: TrialData, F: FloatArray, k: int, crossed: bool) -> FloatArray:
    """Epipolar distances (s, m) [sigmas], with the two views as they are or exchanged; NaN if one is missing."""
    first, second = (trials.pixels[k], trials.pixels[0]) if crossed else (trials.pixels[0], trials.pixels[k])
    s, m = first.shape[:2]
    distances = np.abs(sampson_distances(F, first.reshape(-1, 2), second.reshape(-1, 2))).reshape(s, m)
    sigmas = np.sqrt((trials.sigmas[0] ** 2 + trials.sigmas[k] ** 2) / 2)
    return np.asarray(distances / sigmas)


def _stop_costs(trials: TrialData, F: FloatArray, k: int, crossed: bool) -> FloatArray:
    """Chi-square (s,) of each stop's matches, each capped; 0 if a stop has none."""
    squares = np.minimum(_distances(trials, F, k, crossed) ** 2, CAP)
    return np.asarray(np.nansum(squares, axis=1))


def _marker_shares(trials: TrialData, F: FloatArray, k: int) -> FloatArray:
    """Inlier ratio (m,) of each marker's matches with F; NaN if a marker has none."""
    distances = _distances(trials, F, k, False)
    count = np.isfinite(distances).sum(axis=0)
    inside = (distances <= 2.0 * INLIER_SIGMAS).sum(axis=0)
    return np.where(count > 0, inside / np.maximum(count, 1), np.nan)


PLANAR_MODULI = 0.1
"""Spread of the moduli of a plane's eigenvalues between stops above which the plane has moved out of itself."""


def plane_or_baseline(trials: TrialData, error: CalibrationError) -> CalibrationError:
    """Error that states why the epipolar geometry is undetermined: coplanar markers, or a single centre of
    projection.
    """
    out_of_plane = _excludes_plane(trials)
    rms, sigma = error.data["rms_px"], error.data.get("sigma_px", float("nan"))
    summary = f"what two cameras see in common is one homography to {rms:.3g} px, at sigmas of {sigma:.3g} px"
    if out_of_plane:
        return CalibrationError(
            "no_baseline",
            f"{summary}, though the markers do not stay in one plane: the cameras have (nearly) one centre. Their "
            f"parallax is at most {rms:.3g} px, {rms / sigma:.2g} sigmas. Move them apart",
            parallax_px=rms,
            parallax_sigmas=rms / sigma,
        )
    return CalibrationError(
        "views_degenerate",
        f"{summary}: all markers stay in one plane in all trials, or the cameras have (nearly) one centre (parallax at "
        f"most {rms / sigma:.2g} sigmas). Add markers off the plane, or move the cameras apart",
        **error.data,
    )


def _excludes_plane(trials: TrialData) -> bool:
    """Whether the first camera's tracks exclude coplanar markers that only move within their own plane.

    A motion of a plane within itself has eigenvalues of equal modulus, also in the image; non-coplanar markers have no
    homography between stops at all.
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
        residuals_px = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - after, axis=1) / sigmas[last, both]
        moduli = np.abs(np.linalg.eigvals(H / np.cbrt(np.linalg.det(H))))
        signs.append(
            float(np.median(residuals_px)) > 10.0 or float(np.ptp(moduli)) > PLANAR_MODULI * float(moduli.max())
        )
    return bool(signs) and float(np.mean(signs)) >= 0.5


KIND_BETTER = 1.25
"""Least ratio by which a joint's trial must fit the other kind better; the fit of all joints then decides."""


@dataclass(frozen=True)
class InputCorrection:
    """A hypothetical fault of the input, and the trials corrected for it."""

    code: str
    message: str
    data: dict[str, Any]
    trials: TrialData


def exchange_hypotheses(trials: TrialData) -> Iterator[InputCorrection]:
    """Corrections of views exchanged at some stops, and of ids exchanged at all stops."""
    for k in range(1, len(trials.cameras)):
        names = [trials.cameras[0].name, trials.cameras[k].name]
        stops = exchanged_views(trials, k)
        if len(stops):
            yield InputCorrection(
                "views_exchanged",
                f"the images of cameras {names[0]!r} and {names[1]!r} are exchanged at {len(stops)} of "
                f"{len(trials.positions)} stops: {stops.tolist()}. With them exchanged back the trials fit",
                {"stops": stops.tolist(), "cameras": names},
                with_views_exchanged(trials, k, stops),
            )
        pair = exchanged_ids(trials, k)
        if pair is not None:
            yield ids_exchanged(trials, k, pair)


def ids_exchanged(trials: TrialData, k: int, pair: tuple[int, int]) -> InputCorrection:
    """Correction of two markers (indices) exchanged at all stops, in camera ``k`` or in the first one: two
    cameras do not distinguish these.
    """
    a, b = (trials.marker_ids[i] for i in pair)
    names = [trials.cameras[0].name, trials.cameras[k].name]
    where = f"camera {names[1]!r} or {names[0]!r}" if k == 1 else f"camera {names[1]!r}"
    return InputCorrection(
        "markers_exchanged",
        f"markers {a} and {b} are exchanged in {where} at all stops: they fit the epipolar geometry the other way "
        "round",
        {"markers": [a, b], "cameras": names if k == 1 else names[1:]},
        with_ids_exchanged(trials, k, *pair),
    )


def kind_hypotheses(trials: TrialData, views: InitialViews) -> Iterator[InputCorrection]:
    """Corrections of a joint's kind if its own trial fits the other kind much better."""
    cameras, points, usable = views
    residuals_by_kind: dict[int, tuple[float, float, Kind]] = {}
    for joint, observations, displacement in own_trials(trials, points, usable):
        stated = trials.joint_kinds[joint]
        other: Kind = "prismatic" if stated == "revolute" else "revolute"
        as_stated, as_other = (
            best_single_joint(kind, cameras, observations, displacement, thorough=True)[1] for kind in (stated, other)
        )
        residuals_by_kind[joint] = as_stated, as_other, other
    # The other kind must fit as well as the other joints do; a joint that fits neither kind has a different fault.
    floor = (
        float(np.median([min(least, instead) for least, instead, _ in residuals_by_kind.values()]))
        if residuals_by_kind
        else 0.0
    )
    for joint, (least, instead, other) in residuals_by_kind.items():
        if not instead < min(KIND_BETTER * floor, least / KIND_BETTER):
            continue
        name, stated = trials.joint_names[joint], trials.joint_kinds[joint]
        kinds = tuple(other if j == joint else kind for j, kind in enumerate(trials.joint_kinds))
        yield InputCorrection(
            "joint_kind",
            f"joint {name!r} is said to be {stated}, but is {other}: as such its trial fits to {instead:.3g} sigmas, "
            f"as stated to {least:.3g}",
            {"joint": name, "kind": other},
            msgspec.structs.replace(trials, joint_kinds=kinds),
        )


def order_hypotheses(trials: TrialData, refit: Refit, options: FitOptions) -> Iterator[InputCorrection]:
    """Corrections of the joints' order (two exchanged, or all reversed) if free poses contradict the stated
    order.
    """
    free = trials.trials < 0
    n = len(trials.joint_names)
    if not free.any() or n < 2:
        return
    alone = fit_of_correction(
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
    rig, kept = projective_rig(alone.model), [trials.marker_ids.index(i) for i in alone.model.marker_ids]
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
    yield InputCorrection(
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


InitialViews = tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]
Refit = Callable[[TrialData, FitOptions], CalibrationFit]

FEW_OUTLIERS = 0.1
"""Largest share of rejected pixels with which a hypothesis is accepted."""


def fit_of_correction(trials: TrialData, refit: Refit, options: FitOptions) -> CalibrationFit | None:
    """The fit of a hypothesis, or None if it does not make the data fit."""
    try:
        result = refit(trials, options)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None
    used = result.model.statistics
    assert used is not None
    pixels = used.measurements // 2 + used.outliers
    return result if used.outliers <= FEW_OUTLIERS * pixels else None


def pinhole_reconstruction(trials: TrialData) -> InitialViews:
    """Projective cameras, points and usable pixels by `initial_reconstruction`, with lens distortion removed."""
    return initial_reconstruction(undistorted(trials, undistorted_lenses(trials)))


def solution_of(trials: TrialData, result: CalibrationFit) -> Solution:
    """The final bundle of a fit, reconstructed from its model: linearised in the frame of its stratum, without a
    step.
    """
    model = result.model
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
    rig = stratum_rig(model)
    evaluations = 1
    if model.joint_accuracy is not None:
        noise = noise_of_accuracy(model.joint_accuracy, readings(trials.positions - model.zero))
        # The joint errors are not stored in the model: one step estimates them.
        data, evaluations = data.with_joint_noise(noise), 4
    lenses = lens_model_of(rig.lenses)
    return solve(rig, data, model.stratum, lenses=lenses, max_evaluations=evaluations)
