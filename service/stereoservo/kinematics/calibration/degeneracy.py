"""Epipolar geometry that stays open: markers in one plane, or cameras with one centre."""

from __future__ import annotations

import cv2
import numpy as np

from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData

PLANAR_MODULI = 0.1
"""Spread of the moduli of a plane's eigenvalues from stop to stop above which it has left itself."""


def plane_or_baseline(trials: TrialData, error: CalibrationError) -> CalibrationError:
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
