"""Initial projective reconstruction of calibration images without kinematics: fundamental matrix over all stops,
canonical camera pair, further cameras, triangulated markers.
"""

from __future__ import annotations

import numpy as np

from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.geometry.cameras import canonical_pair, resection, triangulate
from stereoservo.geometry.fundamental import (
    INLIER_SIGMAS,
    fundamental_refine,
    fundamental_robust,
    parallax_ratio,
    sampson_distances,
)
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import BoolArray, FloatArray

MIN_MATCHES = 16
"""Matches between two cameras below which the epipolar geometry is not worth a robust search."""
MIN_AGREEMENT = 0.4
"""Share of matches that must fit one epipolar geometry; below it the stated sigmas are widened once or
twice.
"""
PARALLAX_RATIO, PARALLAX_SCATTER = 1.2, 3.0
"""Ratio of variances, homography to F, above which the parallax of n matches counts: the first plus the second over
√n. Cameras with one centre leave 1.13 to 1.33: F fits its own inliers a little too well."""
NARROW = 1.0 / 3.0
"""Second try where the search refuses a scene that is nearly a plane: it must be a plane to a third of the
margin.
"""


def initial_reconstruction(trials: TrialData) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Projective reconstruction of all stops: cameras (c, 3, 4) in the canonical frame, points (s, m, 4), usable
    pixels (c, s, m).

    Points have depth 1 in the left camera, NaN where they are not usable in two cameras. Raises
    CalibrationError (``too_few_markers``, ``views_degenerate``).
    """
    c, s, m = trials.sigmas.shape
    flat = trials.pixels.reshape(c, s * m, 2)
    sigmas = np.where(trials.visible, trials.sigmas, 1.0).reshape(c, s * m)
    usable = np.zeros((c, s * m), dtype=bool)
    left, right = trials.cameras[:2]
    F, fits, seen = _epipolar(trials, flat, sigmas, 1)
    usable[:2, np.flatnonzero(seen)[fits]] = True
    try:
        P_left, P_right = canonical_pair(
            F,
            left.width,
            left.height,
            right_size=(right.width, right.height),
            left=flat[0, usable[0]],
            right=flat[1, usable[1]],
        )
        cameras = [P_left, P_right]
        points = triangulate(np.array(cameras), np.where(usable[:2, :, None], flat[:2], np.nan), sigmas[:2])
        for k in range(2, c):
            _, fits, seen = _epipolar(trials, flat, sigmas, k)
            usable[k, np.flatnonzero(seen)[fits]] = True
            both = usable[k] & np.isfinite(points).all(axis=1)
            cameras.append(resection(points[both], flat[k, both]))
        matrices = np.array(cameras)
        points = triangulate(matrices, np.where(usable[:, :, None], flat, np.nan), sigmas)
    except GeometryError as error:
        raise _degenerate(trials, 1, error) from error
    # Points behind a camera, or at its focal plane, come from wrong matches.
    depths = np.einsum("cj,pj->cp", matrices[:, 2], np.nan_to_num(points))
    common = np.sign(np.median(depths[:, np.isfinite(points).all(axis=1)], axis=1))
    matrices *= common[:, None, None]
    behind = (depths * common[:, None] <= 0) & usable
    usable &= ~behind
    points[behind.any(axis=0)] = np.nan
    return matrices, points.reshape(s, m, 4), usable.reshape(c, s, m)


def _epipolar(
    trials: TrialData, flat: FloatArray, sigmas: FloatArray, k: int
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """F of cameras 0 and k, the inliers among the common matches, and the mask (s m,) of these matches."""
    seen = np.isfinite(flat[0]).all(axis=1) & np.isfinite(flat[k]).all(axis=1)
    names = f"{trials.cameras[0].name!r} and {trials.cameras[k].name!r}"
    if int(seen.sum()) < MIN_MATCHES:
        raise CalibrationError(
            "too_few_markers",
            f"cameras {names} see {int(seen.sum())} markers in common over all stops; at least "
            f"{MIN_MATCHES} are needed",
            matches=int(seen.sum()),
            minimum=MIN_MATCHES,
        )
    sigma = float(np.sqrt(np.median(sigmas[0, seen] ** 2 + sigmas[k, seen] ** 2) / 2))
    best = 0.0
    for scale in (1.0, NARROW, 4.0, 16.0):
        try:
            F, _ = fundamental_robust(flat[0, seen], flat[k, seen], scale * sigma)
        except GeometryError as error:
            if scale == NARROW and error.code == "degenerate":
                weak = _weak_parallax(flat[0, seen], flat[k, seen], sigma)
                if weak is None:
                    rms = float(error.data.get("rms_px", np.nan))
                    raise CalibrationError(
                        "views_degenerate",
                        f"a plane explains what cameras {names} see in common to {rms:.3g} px, with sigmas of "
                        f"{sigma:.3g} px: their geometry stays open. The markers must not stay in one plane "
                        "over all trials, and the cameras must stand apart",
                        rms_px=rms,
                        sigma_px=sigma,
                    ) from error
                fits = np.abs(sampson_distances(weak, flat[0, seen], flat[k, seen])) <= INLIER_SIGMAS * sigma
                return weak, fits, seen
            continue
        fits = (
            np.abs(sampson_distances(F, flat[0, seen], flat[k, seen]))
            <= INLIER_SIGMAS * max(1.0, scale) * sigma
        )
        best = max(best, float(fits.mean()))
        if best >= MIN_AGREEMENT:
            return fundamental_refine(F, flat[0, seen][fits], flat[k, seen][fits], sigma), fits, seen
    raise CalibrationError(
        "views_degenerate",
        f"only {best:.0%} of the matches of cameras {names} fit one epipolar geometry at 16 sigmas "
        f"({16 * sigma:.3g} px); at least {MIN_AGREEMENT:.0%} must. Did a camera move, or are markers "
        "mixed up?",
        agreement=best,
        minimum=MIN_AGREEMENT,
    )


def _weak_parallax(left: FloatArray, right: FloatArray, sigma: float) -> FloatArray | None:
    """F (3, 3) of matches (n, 2) whose parallax is below the noise of each but significant over all; else None."""
    try:
        F, inliers = fundamental_robust(left, right, sigma, refuse_plane=False)
    except GeometryError:
        return None  # no geometry at all is reported by the other attempts
    enough = PARALLAX_RATIO + PARALLAX_SCATTER / np.sqrt(float(inliers.sum()))
    return F if parallax_ratio(F, left[inliers], right[inliers]) > enough else None


def _degenerate(trials: TrialData, k: int, error: GeometryError) -> CalibrationError:
    names = f"{trials.cameras[0].name!r} and {trials.cameras[k].name!r}"
    return CalibrationError(
        "views_degenerate",
        f"the views of cameras {names} do not determine their geometry: {error}. The cameras must stand "
        "apart, and the markers must not stay in one plane over all trials",
        cause=error.code,
        cameras=[trials.cameras[0].name, trials.cameras[k].name],
    )
