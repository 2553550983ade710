"""Faults of calibration data that show in the epipolar geometry of two cameras: exchanged views or marker ids,
unrelated views, planar scenes, no baseline; and data corrected for an exchange.
"""

from __future__ import annotations

from itertools import combinations

import cv2
import msgspec
import numpy as np

from stereoservo.calibration.initial_reconstruction import MIN_MATCHES
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.fundamental import INLIER_SIGMAS, fundamental_robust, sampson_distances
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

AGREES = 0.9
"""Share of matches that must fit one epipolar geometry once an exchange is undone."""
BETTER = 20.0
"""Chi-square by which a stop must fit better with its views exchanged."""
CAP = 50.0
"""Largest chi-square that a match may add: a wrong one must not decide for its stop."""
UNRELATED = 0.75
"""Share of a single trial's matches below which two cameras do not see the same points."""
FEW_MARKERS = 7
"""Up to this many markers every pair of ids is tried; above, those that do not fit."""
ROUNDS = 6
"""Rounds of undoing exchanges and estimating again."""


def exchanged_views(trials: TrialData, k: int) -> IntArray:
    """Stops at which the images of cameras 0 and ``k`` are exchanged: at most half of them, since exchanging all
    only renames the cameras.
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
    """Two markers (indices) whose ids are exchanged between cameras 0 and ``k`` at all stops; None where none fit."""
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
        mended = with_ids_exchanged(trials, k, a, b)
        F = robust_fundamental(mended, k)
        share = 0.0 if F is None else float(np.nanmean(_marker_shares(mended, F, k)))
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
            verdicts.append(error.code != "degenerate")  # points of one plane are related
    return bool(verdicts) and float(np.mean(verdicts)) > 0.5


def robust_fundamental(trials: TrialData, k: int) -> FloatArray | None:
    """Robust F (3, 3) of cameras 0 and ``k``, which most of their matches fit; None where there is none."""
    left, right, sigma = _matches(trials, k)
    best, most = None, 0.0
    if len(left) < MIN_MATCHES:
        return None
    for scale in (1.0, 4.0):
        try:
            F, inliers = fundamental_robust(left, right, scale * sigma)
        except GeometryError:
            continue  # no geometry at this noise: the wider one may show it
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
    """Epipolar distances (s, m) [sigmas], the two views taken as they are or crossed; NaN where one is missing."""
    first, second = (trials.pixels[k], trials.pixels[0]) if crossed else (trials.pixels[0], trials.pixels[k])
    s, m = first.shape[:2]
    distances = np.abs(sampson_distances(F, first.reshape(-1, 2), second.reshape(-1, 2))).reshape(s, m)
    sigmas = np.sqrt((trials.sigmas[0] ** 2 + trials.sigmas[k] ** 2) / 2)
    return np.asarray(distances / sigmas)


def _stop_costs(trials: TrialData, F: FloatArray, k: int, crossed: bool) -> FloatArray:
    """Chi-square (s,) of each stop's matches, each capped; 0 where a stop has none."""
    squares = np.minimum(_distances(trials, F, k, crossed) ** 2, CAP)
    return np.asarray(np.nansum(squares, axis=1))


def _marker_shares(trials: TrialData, F: FloatArray, k: int) -> FloatArray:
    """Inlier ratio (m,) of each marker's matches with F; NaN where a marker has none."""
    distances = _distances(trials, F, k, False)
    count = np.isfinite(distances).sum(axis=0)
    inside = (distances <= 2.0 * INLIER_SIGMAS).sum(axis=0)
    return np.where(count > 0, inside / np.maximum(count, 1), np.nan)


PLANAR_MODULI = 0.1
"""Spread of the moduli of a plane's eigenvalues from stop to stop above which it has left itself."""


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
        residuals_px = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - after, axis=1) / sigmas[last, both]
        moduli = np.abs(np.linalg.eigvals(H / np.cbrt(np.linalg.det(H))))
        signs.append(
            float(np.median(residuals_px)) > 10.0
            or float(np.ptp(moduli)) > PLANAR_MODULI * float(moduli.max())
        )
    return bool(signs) and float(np.mean(signs)) >= 0.5
