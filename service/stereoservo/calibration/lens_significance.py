"""Significance tests of lens distortion in a solved bundle: of the radial parameters against pinholes, and of the
second radial and tangential terms against the lens without them and against scale factors of the joints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.bundle_adjustment import Solution
from stereoservo.calibration.joint_errors.joint_noise import orthogonal_factor
from stereoservo.calibration.rig_model import predicted, residuals
from stereoservo.geometry.distortion import terms_jacobian
from stereoservo.kinematics.model import pinhole
from stereoservo.kinematics.parameterization import LENS_PARAMETERS, LensModel
from stereoservo.numerics.arrays import FloatArray

FREE_LENS: LensModel = "radial_centre"
"""The lens model of cameras that distort."""
FULL_LENS: LensModel = "brown"
"""The lens model of cameras whose distortion a radial parameter with its centre does not follow."""
LENS_TAIL = 1e-4
"""Probability with which a lens is taken for one of a richer model than it is."""


@dataclass(frozen=True)
class LensTest:
    """Test of lens parameters: ``chi2`` of ``freedom`` parameters against zero, and the ``limit`` that lenses without
    them exceed with probability ``LENS_TAIL``.
    """

    chi2: float
    freedom: int
    limit: float

    @property
    def distorted(self) -> bool:
        """Whether lenses without these parameters are rejected."""
        return self.chi2 > self.limit


def lens_test(solution: Solution) -> LensTest:
    """Chi-square of the parameters of all lenses, but centres and reference radii, against zero.

    With pinholes the score test of the radial ones: what freeing them would gain, to first order. With free lenses
    Wald's: the estimates against their covariance, centres fixed, for without distortion a centre explains nothing.
    Both relative to the noise left, where that is above the stated one.
    """
    c, at = len(solution.rig.lenses), solution.charts.start(2)
    if solution.lenses == "none":
        own, values = at + np.arange(c), None
    else:
        free = len(solution.charts.lenses[0])
        terms = [i for i in range(free) if i not in (1, 2)]
        own = at + (free * np.arange(c)[:, None] + terms).ravel()
        values = solution.rig.lenses[:, [LENS_PARAMETERS[i] for i in terms]].ravel()
    core = solution.lens_factor.core[:, [*range(at), *own, -1]]
    last = np.asarray(np.linalg.qr(core, mode="r"))[at:, at:]
    block = last[: len(own), : len(own)]
    scores = last[: len(own), -1] if values is None else block @ values
    gain = float(scores @ scores)
    left = solution.cost - (gain if values is None else 0.0)
    parameters = at + len(own) + solution.charts.size - solution.charts.start(3)
    factor = max(1.0, left / max(1, solution.rows - parameters))
    return LensTest(gain / factor, len(own), float(chi2_distribution.isf(LENS_TAIL, len(own))))


def terms_test(solution: Solution) -> LensTest:
    """Chi-square, to first order, of the second radial and both tangential terms of all lenses that lack them."""
    gain, terms = _gain(solution, _distortion_columns(solution))
    freedom = max(1, solution.determined.freedom - terms)
    factor = max(1.0, (solution.cost - gain) / freedom)
    return LensTest(gain / factor, terms, float(chi2_distribution.isf(LENS_TAIL, terms)))


def lens_wanted(solution: Solution) -> LensModel:
    """The lens model that the bundle's residuals ask for: its own, or a richer one.

    Terms that a lens lacks are held against scale factors of the joints, which they imitate: of two hypotheses that of
    the larger likelihood.
    """
    if solution.lenses == "none" and lens_test(solution).distorted:
        return FREE_LENS
    if solution.lenses == FULL_LENS or not terms_test(solution).distorted:
        return solution.lenses
    lenses, scales = _evidence(solution)
    return FULL_LENS if lenses > scales or scales <= 0.0 else solution.lenses


def lenses_explain_more(solution: Solution) -> bool:
    """Whether terms of distortion that the model lacks (second radial, tangential) explain more of its residuals than
    scale factors of its joints do: of two hypotheses that of the larger likelihood, by Bayes's information criterion.
    """
    lenses, scales = _evidence(solution)
    return bool(lenses > max(scales, 0.0))


def _evidence(solution: Solution) -> tuple[float, float]:
    """Bayes's information criterion of terms of distortion, and of scale factors of revolute joints: gain in
    chi-square less the penalty.
    """
    joints = [j for j, kind in enumerate(solution.rig.kinds) if kind == "revolute"]
    found = []
    for columns in (_distortion_columns(solution), scale_columns(solution, joints)):
        gain, count = _gain(solution, columns)
        found.append(gain / max(1.0, solution.determined.variance) - count * float(np.log(solution.rows)))
    return found[0], found[1]


def _gain(solution: Solution, columns: FloatArray) -> tuple[float, int]:
    """Chi-square that ``columns`` (2 k, e) would gain beside the free parameters, to first order, and their number."""
    core = orthogonal_factor(solution.rig, solution.charts, solution.data, columns).core
    return float((core[solution.charts.start(3) : -1, -1] ** 2).sum()), columns.shape[1]


def scale_columns(solution: Solution, joints: list[int]) -> FloatArray:
    """Derivatives (2 k, j) of the residuals by the logarithms of the joints' scale factors."""
    step = 1e-5
    columns = [np.zeros((len(solution.residuals), 0))]
    for joint in joints:
        ends = []
        for sign in (-1.0, 1.0):
            offsets = solution.data.offsets.copy()
            offsets[:, joint] *= np.exp(-sign * step)
            ends.append(residuals(solution.rig, replace(solution.data, offsets=offsets)))
        columns.append((ends[1] - ends[0])[:, None] / (2.0 * step))
    return np.hstack(columns)


def _distortion_columns(solution: Solution) -> FloatArray:
    """Derivatives (2 k, 3 c) of the residuals by the second radial and both tangential terms of each camera's lens."""
    rig, data = solution.rig, solution.data
    ideal = predicted(replace(rig, lenses=np.tile(pinhole(), (len(rig.lenses), 1))), data)
    out = np.zeros((len(ideal), 2, 3 * len(rig.lenses)))
    for c, lens in enumerate(rig.lenses):
        mine = data.camera == c
        out[mine, :, 3 * c : 3 * c + 3] = terms_jacobian(lens, ideal[mine]) / data.sigmas[mine, None, None]
    return out.reshape(2 * len(out), -1)
