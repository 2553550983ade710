"""Which lens model the data ask for: none, or a radial parameter and its centre for each camera.

The models are nested; a chi-square says what the radial parameters are worth. The centre comes with the radial
parameter, held by a weak prior: a small distortion does not show its centre, but fixing it would deny that it is
unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.geometry.distortion_lines import LensEstimate
from stereoservo.kinematics.calibration.bundle import LensPriors, Measurements, Rig, Solution, full_charts
from stereoservo.kinematics.calibration.charts import LensModel
from stereoservo.kinematics.calibration.lens_starts import (
    CENTRE_SHARE,
    epipolar_lenses,
    straight_lenses,
)
from stereoservo.kinematics.calibration.normal_equations import triangle_of
from stereoservo.kinematics.calibration.trials import CalibrationError, TrialData

FloatArray = npt.NDArray[np.float64]

FREE_LENS: LensModel = "radial_centre"
"""The lens model of cameras that distort."""
LENS_TAIL = 1e-4
"""Probability with which a pinhole is taken for a distorting lens."""


@dataclass(frozen=True)
class LensTest:
    """What the radial parameters are worth: ``chi2`` of ``freedom`` parameters against zero, and the ``limit`` that
    pinholes stay below but for ``LENS_TAIL`` of cases.
    """

    chi2: float
    freedom: int
    limit: float

    @property
    def distorted(self) -> bool:
        """Whether pinholes are refused."""
        return self.chi2 > self.limit


def starting_lenses(
    trials: TrialData, asked: Literal["auto"] | LensModel, priors: Mapping[str, LensEstimate]
) -> tuple[FloatArray, LensModel]:
    """Lenses (c, 4) to start from and what of them is free in the first bundle.

    Where ``asked`` leaves it to the data, lenses are free at once if priors are given or the epipolar geometry
    needs them. Raises CalibrationError (``bad_data``) for priors of cameras that are not there.
    """
    names = [camera.name for camera in trials.cameras]
    unknown = sorted(set(priors) - set(names))
    if unknown:
        raise CalibrationError(
            "bad_data",
            f"lens priors for {unknown}; the cameras are {names}",
            key="lens_priors",
            unknown=unknown,
        )
    lenses = straight_lenses(trials)
    if asked == "none":
        return lenses, "none"
    if priors:
        for c, name in enumerate(names):
            if name in priors:
                lenses[c] = priors[name].lens
        return lenses, FREE_LENS if asked == "auto" else asked
    lenses = epipolar_lenses(trials)
    bent = bool(lenses[:, 0].any())
    return lenses, asked if asked != "auto" else FREE_LENS if bent else "none"


def prior_of_lenses(trials: TrialData, priors: Mapping[str, LensEstimate]) -> LensPriors:
    """What is known beforehand of (k, cu, cv): the given estimates, elsewhere the centre near the image's middle.

    ``CENTRE_SHARE`` of the width is its standard deviation there.
    """
    straight = straight_lenses(trials)
    mean, information = straight[:, :3].copy(), np.zeros((len(straight), 3, 3))
    for c, camera in enumerate(trials.cameras):
        if camera.name in priors:
            mean[c] = priors[camera.name].lens[:3]
            information[c] = np.linalg.inv(priors[camera.name].covariance)
        else:
            information[c, [1, 2], [1, 2]] = 1.0 / (CENTRE_SHARE * camera.width) ** 2
    return LensPriors(mean, information)


def straightened(rig: Rig, data: Measurements) -> Rig:
    """The rig with pinholes, centres where the priors of ``data`` have them."""
    lenses = rig.lenses.copy()
    lenses[:, 0] = 0.0
    if data.lens_priors is not None:
        lenses[:, 1:3] = data.lens_priors.mean[:, 1:]
    return replace(rig, lenses=lenses)


def lens_test(solution: Solution) -> LensTest:
    """Chi-square of the radial parameters of all cameras against zero.

    With pinholes the score test: what freeing them would gain, to first order. With free lenses Wald's: the
    estimates against their covariance, centres fixed, for without a radial parameter a centre explains nothing. Both
    relative to the noise left, where that is above the stated one.
    """
    c = len(solution.rig.lenses)
    charts = replace(
        solution.charts, lenses=full_charts(solution.rig, solution.stratum, lenses="radial").lenses
    )
    whole = triangle_of(solution.rig, charts, solution.data)
    own = charts.start(2) + np.arange(c)
    others = np.setdiff1d(np.arange(charts.size), own)
    last = np.asarray(np.linalg.qr(whole[:, [*others, *own, charts.size]], mode="r"))[
        len(others) :, len(others) :
    ]
    block = last[:c, :c]
    scores = last[:c, -1] if solution.lenses == "none" else block @ solution.rig.lenses[:, 0]
    gain = float(scores @ scores)
    left = solution.cost - (gain if solution.lenses == "none" else 0.0)
    factor = max(1.0, left / max(1, solution.rows - charts.size))
    return LensTest(gain / factor, c, float(chi2_distribution.isf(LENS_TAIL, c)))
