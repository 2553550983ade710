"""Lens models of the cameras in a calibration: start values from straight lines or epipolar geometry, undistortion,
priors, significance of a lens for a solved bundle, and plausibility of an estimated lens.

The models are nested: none; a radial parameter with its centre for each camera; additionally second radial and
tangential terms. Weak priors constrain centre and terms: a small distortion does not determine them, but fixing them
would underestimate the uncertainty.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import cv2
import msgspec
import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.bundle_adjustment import Solution
from stereoservo.calibration.initial_reconstruction import MIN_MATCHES
from stereoservo.calibration.joint_noise import orthogonal_factor
from stereoservo.calibration.least_squares import DenseFit, Limits, RobustLoss, minimise, numeric_jacobian
from stereoservo.calibration.rig_model import LensPriors, Measurements, RigModel, predicted, residuals
from stereoservo.calibration.trial_data import CalibrationError, TrialData, finite_rows
from stereoservo.geometry.cameras import isotropic_normaliser
from stereoservo.geometry.distortion import LensEstimate, pinhole_lens, terms_jacobian, undistort
from stereoservo.geometry.fundamental import INLIER_SIGMAS, fundamental_robust, sampson_distances
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.model import pinhole
from stereoservo.kinematics.parameterization import LENS_PARAMETERS, LensModel
from stereoservo.numerics.arrays import FloatArray

if TYPE_CHECKING:
    from stereoservo.calibration.calibration_result import CalibrationFit


FREE_LENS: LensModel = "radial_centre"
"""Default lens model of cameras with distortion."""
FULL_LENS: LensModel = "brown"
"""Lens model of cameras whose distortion is not described by a radial parameter with its centre."""
LENS_TAIL = 1e-4
"""Probability with which a lens is assigned a richer model than its own."""


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
    """Chi-square of the parameters of all lenses, except centres and reference radii, against zero.

    With pinholes the score test of the radial ones: the gain from freeing them, to first order. With free lenses the
    Wald test: the estimates against their covariance, with centres fixed, because without distortion a centre has no
    effect. Both relative to the residual noise, if that is above the stated one.
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
    freedom = max(1, solution.statistics.freedom - terms)
    factor = max(1.0, (solution.cost - gain) / freedom)
    return LensTest(gain / factor, terms, float(chi2_distribution.isf(LENS_TAIL, terms)))


def required_lens_model(solution: Solution) -> LensModel:
    """The lens model that the bundle's residuals require: its own, or a richer one.

    Terms that a lens lacks are compared with scale factors of the joints, which they imitate: the hypothesis of
    larger likelihood is selected.
    """
    if solution.lenses == "none" and lens_test(solution).distorted:
        return FREE_LENS
    if solution.lenses == FULL_LENS or not terms_test(solution).distorted:
        return solution.lenses
    lenses, scales = _evidence(solution)
    return FULL_LENS if lenses > scales or scales <= 0.0 else solution.lenses


def lenses_explain_more(solution: Solution) -> bool:
    """Whether distortion terms that the model lacks (second radial, tangential) explain more of its residuals than
    scale factors of its joints do, by likelihood with Bayes's information criterion.
    """
    lenses, scales = _evidence(solution)
    return bool(lenses > max(scales, 0.0))


def _evidence(solution: Solution) -> tuple[float, float]:
    """Bayes's information criterion of distortion terms, and of scale factors of revolute joints: gain in
    chi-square less the penalty.
    """
    joints = [j for j, kind in enumerate(solution.rig.kinds) if kind == "revolute"]
    found = []
    for columns in (_distortion_columns(solution), scale_columns(solution, joints)):
        gain, count = _gain(solution, columns)
        found.append(gain / max(1.0, solution.statistics.variance) - count * float(np.log(solution.rows)))
    return found[0], found[1]


def _gain(solution: Solution, columns: FloatArray) -> tuple[float, int]:
    """Chi-square gain of ``columns`` (2 k, e) beside the free parameters, to first order, and their number."""
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


INITIAL_DISTORTIONS = (-0.1, -0.04, -0.2, 0.04)
"""Radial parameters at half the image width of all cameras, from which fits start if the search has failed."""
MOST_ASPECT = 1.5
"""Largest plausible ratio of a pixel's sides."""


def starting_lenses(
    trials: TrialData,
    asked: Literal["auto"] | LensModel,
    priors: Mapping[str, LensEstimate],
    bend: float | None = None,
) -> tuple[FloatArray, LensModel]:
    """Initial lenses (c, 4), and which of their parameters are free in the first bundle.

    If ``asked`` leaves it to the data, lenses are free immediately if priors are given or the epipolar geometry
    requires them; with ``bend`` they are free and all start from that radial parameter.
    Raises CalibrationError (``bad_data``) for priors of cameras that do not exist.
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
    lenses = undistorted_lenses(trials)
    if bend is not None:
        lenses[:, 0] = bend
        return lenses, FREE_LENS if asked == "auto" else asked
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
    """Priors of the lenses: the given estimates of (k, cu, cv), otherwise the centre near the image's middle; terms
    near zero.

    ``CENTRE_SHARE`` of the width is the centre's standard deviation, ``TERM_SIGMAS`` those of the terms.
    """
    straight = undistorted_lenses(trials)
    mean, information = np.zeros((len(straight), 6)), np.zeros((len(straight), 6, 6))
    mean[:, :3] = straight[:, :3]
    information[:, [3, 4, 5], [3, 4, 5]] = 1.0 / np.array(TERM_SIGMAS) ** 2
    for c, camera in enumerate(trials.cameras):
        if camera.name in priors:
            mean[c, :3] = priors[camera.name].lens[:3]
            information[c, :3, :3] = np.linalg.inv(priors[camera.name].covariance)
        else:
            information[c, [1, 2], [1, 2]] = 1.0 / (CENTRE_SHARE * camera.width) ** 2
    return LensPriors(mean, information)


def implausible_lens(result: CalibrationFit) -> CalibrationError | None:
    """Error (``lens_implausible``) for a fit whose lens has its centre outside the image, or whose camera has pixels
    far from square; None if all lenses are plausible.
    """
    for camera, fitted in zip(result.model.cameras, result.report.cameras, strict=True):
        if fitted.lens is not None:
            _, cu, cv = fitted.lens
            if not (0.0 <= cu <= camera.width and 0.0 <= cv <= camera.height):
                return CalibrationError(
                    "lens_implausible",
                    f"the lens of camera {fitted.name!r} would have its centre at ({cu:.0f}, {cv:.0f}) px, outside of "
                    f"the image of {camera.width} x {camera.height}: the fit has ended in a wrong place",
                    camera=fitted.name,
                    centre=[cu, cv],
                )
        if fitted.lens is not None and fitted.intrinsics is not None:
            aspect = fitted.intrinsics[0] / fitted.intrinsics[2]
            if not 1.0 / MOST_ASPECT < abs(aspect) < MOST_ASPECT:
                return CalibrationError(
                    "lens_implausible",
                    f"the pixels of camera {fitted.name!r} would be {aspect:.3g} times as wide as high: the fit has "
                    "ended in a wrong place",
                    camera=fitted.name,
                    aspect=aspect,
                )
    return None


def with_pinhole_cameras(rig: RigModel, data: Measurements) -> RigModel:
    """The rig with pinhole cameras, distortion centres from the priors of ``data``."""
    lenses = rig.lenses.copy()
    lenses[:, [0, 4, 5, 6]] = 0.0
    if data.lens_priors is not None:
        lenses[:, 1:3] = data.lens_priors.mean[:, 1:3]
    return replace(rig, lenses=lenses)


GRID = (-0.30, -0.24, -0.19, -0.15, -0.12, -0.09, -0.06, -0.03, 0.0, 0.03, 0.06, 0.10, 0.15)
"""Initial grid of the search: radial parameters at half the image width."""
PINHOLE_AGREEMENT = 0.95
"""Share of matches within 3.29 sigmas of one epipolar geometry from which no lens is searched for."""
NOISE_AGREEMENT = 0.99
"""Share expected of pinholes: 0.999 for Gaussian noise, reduced for outlying matches."""
COARSE_PX = 1.5
"""Epipolar distance [px], beside its noise, that a match may have at a grid point."""
LARGEST_DISTORTION = 0.6
"""Largest magnitude of an initial radial parameter."""
WORTH_SHARE = 0.03
"""Least increase of the share of fitting matches by a lens: other misfit is not due to the lens."""
CENTRE_SHARE = 0.1
"""Prior standard deviation of a lens's centre about the middle of the image [image widths]."""
TERM_SIGMAS = (0.2, 0.01, 0.01)
"""Prior standard deviations of k2, p1, p2 about zero: several times those of commercial lenses."""
NORMAL_MEDIAN = 0.6745
"""Median of the absolute value of a standard normal variable."""
CENTRE_BOUND = 2.0
"""Largest offset of a centre in the search, in units of its prior standard deviation."""
START_GAIN = 100.0
"""Least gain in epipolar chi-square for an initial lens. The bundle sees more data and decides on weaker distortion."""
SEARCH = Limits(evaluations=60, tolerance=1e-8)
"""Termination of the search for a lens."""
MOST_MATCHES = 20_000
"""Most matches of two cameras, evenly spread, that the search for a lens uses."""


def undistorted_lenses(trials: TrialData) -> FloatArray:
    """Lenses (c, 4) without distortion for the cameras of the trials."""
    return np.array([pinhole_lens(camera.width, camera.height) for camera in trials.cameras])


def undistorted(trials: TrialData, lenses: FloatArray) -> TrialData:
    """The trials with lens distortion removed; sigmas scale with the area of a pixel.

    Pixels without an ideal pixel are NaN.
    """
    if not lenses[:, 0].any():
        return trials
    pixels = np.array([undistort(lens, raw) for lens, raw in zip(lenses, trials.pixels, strict=True)])
    return msgspec.structs.replace(trials, pixels=pixels, sigmas=trials.sigmas * _stretches(lenses, pixels))


def _stretches(lenses: FloatArray, pixels: FloatArray) -> FloatArray:
    """Local magnification (c, ...) from raw to ideal pixels (c, ..., 2); 1 where a pixel is missing."""
    out = np.empty(pixels.shape[:-1])
    for lens, ideal, stretch in zip(lenses, pixels, out, strict=True):
        square = lens[0] * ((ideal - lens[1:3]) ** 2).sum(axis=-1) / lens[3] ** 2
        # The determinant of distortion_jacobian: (1 + k r²)(1 + 3 k r²).
        stretch[...] = 1.0 / np.sqrt(np.abs((1.0 + square) * (1.0 + 3.0 * square)))
    return np.where(np.isfinite(out), out, 1.0)


def epipolar_lenses(trials: TrialData) -> FloatArray:
    """Lenses (c, 4) from the epipolar geometry of the first camera with each other one; without distortion if
    none is needed.

    A lens is accepted if it lowers the robust epipolar cost by far more than chance does (``START_GAIN``).
    """
    lenses = undistorted_lenses(trials)
    for k in range(1, len(trials.cameras)):
        match = _matches(trials, k)
        if match is None or _agreement(*match, lenses[[0, k]]) >= PINHOLE_AGREEMENT:
            continue
        # The first camera's lens is determined by the first pair that requires one.
        free = (0, 1) if not lenses[0, 0] else (1,)
        found = _pair_lenses(*match, lenses[[0, k]], free)
        if found is not None:
            lenses[[0, k]] = found
    return lenses


def distortion_is_possible(trials: TrialData) -> bool:
    """Whether, for some pair of cameras, fewer matches fit than pinholes with noise explain."""
    straight = undistorted_lenses(trials)
    for k in range(1, len(trials.cameras)):
        match = _matches(trials, k)
        if match is not None and _agreement(*match, straight[[0, k]]) < NOISE_AGREEMENT:
            return True
    return False


def _matches(trials: TrialData, k: int) -> tuple[FloatArray, FloatArray] | None:
    """Raw matches (2, n, 2) of cameras 0 and k over all stops, and their sigmas (2, n); None if too few."""
    pixels = trials.pixels[[0, k]].reshape(2, -1, 2)
    seen = np.asarray(finite_rows(pixels).all(axis=0))
    if int(seen.sum()) < MIN_MATCHES:
        return None
    every = np.flatnonzero(seen)
    some = every[np.linspace(0, len(every) - 1, min(len(every), MOST_MATCHES)).astype(np.int64)]
    return pixels[:, some], trials.sigmas[[0, k]].reshape(2, -1)[:, some]


def _agreement(raw: FloatArray, sigmas: FloatArray, lenses: FloatArray) -> float:
    """Share of matches that fit one epipolar geometry after undistortion by ``lenses``; 1 for coplanar points,
    which determine none.
    """
    ideal = np.array([undistort(lens, pixels) for lens, pixels in zip(lenses, raw, strict=True)])
    known = np.asarray(finite_rows(ideal).all(axis=0))
    if int(known.sum()) < MIN_MATCHES:
        return 0.0
    sigma = float(np.sqrt(np.median((sigmas**2).sum(axis=0)) / 2))
    try:
        _, inliers = fundamental_robust(ideal[0, known], ideal[1, known], sigma)
    except GeometryError as error:
        return float(error.code == "degenerate")
    return float(inliers.sum()) / len(known)


def _pair_lenses(raw: FloatArray, sigmas: FloatArray, lenses: FloatArray, free: tuple[int, ...]) -> FloatArray | None:
    """Lenses (2, 4) of a pair, those of ``free`` fitted; None if distortion does not explain the misfit."""
    best, least, F = 0.0, np.inf, None
    for bend in GRID:
        tried = lenses.copy()
        tried[list(free), 0] = bend
        found = _coarse_fundamental(raw, sigmas, tried)
        if found is not None and found[1] < least:
            best, (F, least) = bend, found
    if F is None:
        return None
    started = lenses.copy()
    started[list(free), 0] = best
    bent, _, typical = _refined(raw, sigmas, started, F, free, bound=max(least, 1.0))
    straight = _coarse_fundamental(raw, sigmas, lenses)
    if straight is None:
        return bent
    # Detectors misjudge their noise: residuals that the lens does not explain count as noise.
    noise = sigmas * max(1.0, typical)
    _, cost, _ = _refined(raw, noise, bent, F, (), bound=max(least, 1.0))
    _, without, _ = _refined(raw, noise, lenses, straight[0], (), bound=max(least, 1.0))
    if not without - cost > START_GAIN or np.abs(bent[:, 0]).max() > LARGEST_DISTORTION:
        return None
    # Wrong matches do not fit with any lens.
    return bent if _agreement(raw, noise, bent) > _agreement(raw, noise, lenses) + WORTH_SHARE else None


def _coarse_fundamental(raw: FloatArray, sigmas: FloatArray, lenses: FloatArray) -> tuple[FloatArray, float] | None:
    """F of undistorted matches and the median of their epipolar distances [sigmas]; None if none is found."""
    ideal = np.array([undistort(lens, pixels) for lens, pixels in zip(lenses, raw, strict=True)])
    known = np.asarray(finite_rows(ideal).all(axis=0))
    # A parameter at which half of the matches have no ideal pixel is excluded.
    if known.mean() < 0.5 or int(known.sum()) < MIN_MATCHES:
        return None
    parameters = cv2.UsacParams()
    parameters.confidence = 0.999
    parameters.maxIterations = 1000
    parameters.randomGeneratorState = 20010701
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.threshold = COARSE_PX + INLIER_SIGMAS * float(np.median(sigmas))
    try:
        F, _ = cv2.findFundamentalMat(ideal[0, known], ideal[1, known], parameters)
    except cv2.error:
        return None  # the search asserts on some degenerate inputs: no F at this grid point
    if F is None or np.shape(F) != (3, 3) or not np.isfinite(F).all():
        return None
    distances = np.full(len(known), np.inf)
    distances[known] = np.abs(sampson_distances(F, ideal[0, known], ideal[1, known]))
    scale = np.sqrt(((sigmas * _stretches(lenses, ideal)) ** 2).mean(axis=0))
    return F, float(np.median(distances / scale))


def _refined(
    raw: FloatArray,
    sigmas: FloatArray,
    lenses: FloatArray,
    F: FloatArray,
    free: tuple[int, ...],
    bound: float,
) -> tuple[FloatArray, float, float]:
    """Lenses of least robust epipolar cost with F free, centres constrained by a weak prior, that cost [sigmas²], and
    the noise [sigmas] by the median distance.

    Two passes with Cauchy's loss: at ``bound`` sigmas, to converge from the grid point, then at three.
    """
    normalisers = [isotropic_normaliser(pixels) for pixels in raw]
    start = np.linalg.inv(normalisers[1]).T @ F @ np.linalg.inv(normalisers[0])
    start = start / np.linalg.norm(start)
    tangent = np.linalg.svd(start.reshape(1, 9))[2][1:].reshape(8, 3, 3)
    freedom = 2.0 * CENTRE_SHARE * lenses[:, 3:4]

    def lenses_at(z: FloatArray) -> FloatArray:
        moved = lenses.copy()
        for i, camera in enumerate(free):
            bend = z[8 + 3 * i : 11 + 3 * i]
            moved[camera, 0] += bend[0]
            moved[camera, 1:3] += bend[1:] * freedom[camera]
        return moved

    def errors(z: FloatArray) -> FloatArray:
        here = lenses_at(z)
        ideal = np.array([undistort(lens, pixels) for lens, pixels in zip(here, raw, strict=True)])
        fundamental = normalisers[1].T @ (start + np.tensordot(z[:8], tangent, 1)) @ normalisers[0]
        scale = np.sqrt(((sigmas * _stretches(here, ideal)) ** 2).mean(axis=0))
        distances = sampson_distances(fundamental, *ideal) / scale
        # Matches without ideal pixels get a large error, not zero.
        return np.where(np.isfinite(distances), distances, 1e3)[:, None]

    # A robust loss tolerates a distant centre, so that the prior alone would not constrain it.
    limit = np.array([np.inf] * 8 + [np.inf, CENTRE_BOUND, CENTRE_BOUND] * len(free))
    centres = np.isfinite(limit)

    def step(z: FloatArray, x: FloatArray) -> FloatArray:
        return np.clip(z + x, -limit, limit)

    slopes = numeric_jacobian(errors, np.add, len(limit), 1e-7)
    z, cost = np.zeros(len(limit)), np.inf
    for scale in (3.0 * bound, 3.0):
        fit = DenseFit(
            errors, slopes, step, RobustLoss("cauchy", scale), lambda z: np.column_stack([np.eye(len(z)), z])[centres]
        )
        found = minimise(fit, z, SEARCH)
        z, cost = found.state, found.cost
    distances = np.abs(errors(z))
    return lenses_at(z), cost, float(np.median(distances)) / NORMAL_MEDIAN
