"""Fits again: a hypothesis about bad trials is worth what the fit says of the trials without it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.errors import GeometryError
from stereoservo.kinematics.calibration.bundle import Measurements, Solution, solve
from stereoservo.kinematics.calibration.lens_starts import straight_lenses, undistorted
from stereoservo.kinematics.calibration.lenses import FREE_LENS, prior_of_lenses
from stereoservo.kinematics.calibration.model_rig import stratum_rig
from stereoservo.kinematics.calibration.report import CalibrationResult
from stereoservo.kinematics.calibration.strata import FitOptions
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData
from stereoservo.kinematics.calibration.views import first_views

FloatArray = npt.NDArray[np.float64]
Views = tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]
Refit = Callable[[TrialData, FitOptions], CalibrationResult]

FEW_OUTLIERS = 0.1
"""Share of pixels that a fit may leave out for its hypothesis to count."""


def fits(trials: TrialData, refit: Refit, options: FitOptions) -> CalibrationResult | None:
    """The fit of a hypothesis, or None where it does not make the data fit."""
    try:
        result = refit(trials, options)
    except (CalibrationError, GeometryError, np.linalg.LinAlgError):
        return None
    used = result.model.statistics
    assert used is not None
    pixels = used.measurements // 2 + used.outliers
    return result if used.outliers <= FEW_OUTLIERS * pixels else None


def plain_views(trials: TrialData) -> Views:
    """Cameras, points and usable pixels, as pinholes see them."""
    return first_views(undistorted(trials, straight_lenses(trials)))


def solution_of(trials: TrialData, result: CalibrationResult) -> Solution:
    """The final bundle of a fit again, from its model: linearised in the frame of its stratum, not moved."""
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
    bent = any(camera.lens[0] != 0.0 for camera in model.cameras)
    return solve(
        stratum_rig(model), data, model.stratum, lenses=FREE_LENS if bent else "none", max_evaluations=1
    )
