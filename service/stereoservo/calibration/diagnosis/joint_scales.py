"""Estimated scale factors of joint readings (reported over true motion): of a revolute joint from the images, of a
prismatic one relative to another.

A revolute joint that reports its angle times a factor (counts, degrees, a wrong gear ratio) is no projective rotation
at the reported positions: the spectrum of its generator is ±i times the factor. The factor is estimated first from the
joint's own trial, then with the whole model. Signs and the scale of all prismatic joints together are gauge.

Also whether errors of the joint readings explain a calibration's residuals, as opposed to effects that imitate them: a
wrong scale, one wrong stop, a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.diagnosis.marker_tracks import find_step
from stereoservo.calibration.joint_noise import orthogonal_factor
from stereoservo.calibration.least_squares import RobustLoss, estimate_beside
from stereoservo.calibration.lens_estimation import scale_columns
from stereoservo.calibration.rig_model import Measurements, RigModel, predicted
from stereoservo.calibration.single_joint_fit import (
    VirtualObservations,
    best_single_joint,
    own_trials,
)
from stereoservo.calibration.trial_data import CalibrationError, TrialData, finite_rows
from stereoservo.calibration.variance_components import (
    FALSE_ALARM,
    SAME_READING,
    VarianceComponents,
)
from stereoservo.geometry.cameras import NOMINAL_FOCAL
from stereoservo.numerics.arrays import BoolArray, FloatArray

COARSE = tuple(float(2.0 ** (k / 4)) for k in range(-5, 6))
"""Initial factors relative to the rigid estimate: nominal cameras misjudge angles."""
WORTH = 40.0
"""Least gain in chi-square of a joint's own trial from a factor."""
ABOVE_FLOOR = 1.25
"""Largest ratio of the residuals with a factor to those of the other joints' trials."""
SIGNIFICANT = 5.0
"""Number of standard deviations from 1 above which a factor differs from it significantly."""
LOSS = RobustLoss("soft_l1", 2.0)
LEAST_FACTOR = 2e-3
"""Relative error of a scale below which it is not refused."""


@dataclass(frozen=True)
class JointScaleEstimate:
    """Estimated scale factor of a joint's reading, reported over true motion, and its standard deviation."""

    joint: int
    factor: float
    deviation: float

    @property
    def wrong(self) -> bool:
        """Whether the factor differs significantly from 1."""
        off = abs(self.factor - 1.0)
        return off > SIGNIFICANT * self.deviation and off > LEAST_FACTOR


def trial_scales(
    trials: TrialData, cameras: FloatArray, points: FloatArray, usable: npt.NDArray[np.bool_]
) -> FloatArray:
    """Scale factor (n,) of each joint's reported positions from its own trial, cameras (c, 3, 4) fixed; 1 if no
    other is significant, for prismatic joints, for unusable trials, and if the factor does not reduce the
    trial's residuals to those of the other joints' trials (there is a different fault then).
    """
    factors, residual = np.ones(len(trials.joint_names)), np.full(len(trials.joint_names), np.nan)
    for joint, observations, displacement in own_trials(trials, points, usable):
        kind = trials.joint_kinds[joint]
        if kind == "revolute":
            factors[joint], residual[joint] = _best_factor(cameras, observations, displacement)
        else:
            residual[joint] = best_single_joint(kind, cameras, observations, displacement)[1]
    known = np.isfinite(residual)
    if known.any():
        factors[known & (residual > ABOVE_FLOOR * np.median(residual[known]))] = 1.0
    return factors


def with_scales_removed(trials: TrialData, factors: FloatArray) -> TrialData:
    """The trials with positions divided by ``factors`` (n,) about their medians."""
    centre = np.median(trials.positions, axis=0)
    return msgspec.structs.replace(trials, positions=centre + (trials.positions - centre) / factors)


def _best_factor(cameras: FloatArray, observations: VirtualObservations, reported: FloatArray) -> tuple[float, float]:
    """Scale factor of one joint's ``reported`` angles (k,), 1 if no other gains enough, and the median residual
    [sigmas] with it; NaN if the joint fits with none.
    """
    rough = _rigid_factor(observations, reported)
    rigs: dict[float, tuple[RigModel, float]] = {}
    for factor in {1.0, *(rough * step for step in COARSE)}:
        # All starts are tried with the reported positions before another factor is accepted.
        rig, typical = best_single_joint("revolute", cameras, observations, reported / factor, thorough=factor == 1.0)
        if rig is not None and np.isfinite(typical):
            rigs[factor] = rig, typical
    if not rigs:
        return 1.0, np.nan
    start = min(rigs, key=lambda factor: rigs[factor][1])
    camera, stop, marker = np.nonzero(observations.usable)
    noise = max(1.0, min(typical for _, typical in rigs.values()))

    def solved(log_factor: float, rig: RigModel) -> FloatArray:
        """Residuals [noise]."""
        data = Measurements(
            reported[:, None] / np.exp(log_factor),
            camera,
            stop,
            marker,
            observations.pixels[observations.usable].reshape(-1, 2),
            noise * observations.sigmas[observations.usable].ravel(),
        )
        return solve(rig, data, "projective", cameras=False, loss=LOSS, max_evaluations=40).residuals

    def cost(log_factor: float, rig: RigModel) -> float:
        return LOSS.cost(solved(log_factor, rig) ** 2)

    log = float(np.log(start))
    found = minimize_scalar(
        cost,
        bounds=(log - 0.25, log + 0.25),
        args=(rigs[start][0],),
        method="bounded",
        options={"xatol": 1e-4, "maxiter": 25},
    )
    without = cost(0.0, rigs[1.0][0]) if 1.0 in rigs else np.inf
    if without - found.fun <= WORTH:
        return 1.0, rigs[1.0][1]
    squares = (solved(float(found.x), rigs[start][0]).reshape(-1, 2) ** 2).sum(axis=1)
    return float(np.exp(found.x)), noise * float(np.sqrt(np.median(squares) / np.log(4.0)))


def _rigid_factor(observations: VirtualObservations, reported: FloatArray) -> float:
    """Coarse scale factor: reported over estimated angle between distant stops, assuming the nominal cameras."""
    scale = np.array([1.0 / NOMINAL_FOCAL, 1.0 / NOMINAL_FOCAL, 1.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        euclidean = observations.points[..., :3] * scale / observations.points[..., 3:]
    valid = finite_rows(euclidean)
    far = np.abs(reported[:, None] - reported[None, :]) > 0.4 * np.ptp(reported)
    ratios = []
    for k, n in np.argwhere(np.triu(far)):
        both = valid[k] & valid[n]
        if int(both.sum()) < 3:
            continue
        before, after = euclidean[k, both], euclidean[n, both]
        rotation, _ = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))
        angle = float(rotation.magnitude())
        if angle > 0.0:
            ratios.append(abs(reported[k] - reported[n]) / angle)
    return float(np.median(ratios)) if ratios else 1.0


def model_scales(solution: Solution) -> tuple[JointScaleEstimate, ...]:
    """Scale factors of all revolute joints' positions and their deviations, estimated jointly with the model.

    One Gauss-Newton step from a converged bundle: exact for factors near 1.
    """
    joints = [j for j, kind in enumerate(solution.rig.kinds) if kind == "revolute"]
    if not joints:
        return ()
    factor = orthogonal_factor(solution.rig, solution.charts, solution.data, scale_columns(solution, joints))
    # Effects of a factor that the other parameters can imitate count as theirs.
    at = solution.charts.start(3)
    found = estimate_beside(factor.core[at:, at:])
    deviations = np.sqrt(np.diag(found.covariance) * max(1.0, solution.statistics.variance))
    return tuple(
        JointScaleEstimate(joint, float(np.exp(log)), float(np.exp(log) * deviation))
        for joint, log, deviation in zip(joints, found.x, deviations, strict=True)
    )


def prismatic_ratios(result: CalibrationFit, solution: Solution) -> tuple[JointScaleEstimate, ...]:
    """Scale of each prismatic joint (reported motion per length) over that of the first one, with deviations; ()
    below the metric stratum and with fewer than two.

    One common scale is gauge; the ratios are not, and are 1 if every drive reports true lengths.
    """
    joints = [j for j, kind in enumerate(solution.rig.kinds) if kind == "prismatic"]
    if result.model.stratum != "metric" or len(joints) < 2:
        return ()
    lengths = np.linalg.norm(solution.rig.generators[:, :3, 3], axis=1)
    roots = solution.statistics.root * np.sqrt(max(1.0, solution.statistics.variance))
    starts = np.cumsum([0, *(len(basis) for basis in solution.charts.generators)])

    def log_slope(joint: int) -> FloatArray:
        """Derivative of the logarithm of a joint's length by the parameters, in their independent directions."""
        generator, basis = solution.rig.generators[joint], solution.charts.generators[joint]
        changes = (basis @ generator - generator @ basis)[:, :3, 3]
        relative = changes @ generator[:3, 3] / lengths[joint] ** 2
        return np.asarray(relative @ roots[starts[joint] : starts[joint + 1]])

    first = joints[0]
    return tuple(
        JointScaleEstimate(
            joint,
            float(lengths[first] / lengths[joint]),
            float(lengths[first] / lengths[joint] * np.linalg.norm(log_slope(joint) - log_slope(first))),
        )
        for joint in joints[1:]
    )


EXPLAINED = 1.5
"""Largest ratio of residual to stated noise at which joint errors count as the cause."""
MOST_OUTLIERS = 0.02
"""Largest share of rejected pixels in that case."""
ONE_STOP, OTHERS = 45.0, 0.75
"""Largest square of a joint's errors, relative to their 0.75 quantile, above which a single stop is wrong: Gaussian
errors of nine stops exceed it twice in a thousand, and half of them may lie on one flank of a play.
"""
ONE_STEP = 0.5
"""Share of the residuals at the reported positions that a step must explain to count as the cause: joint errors
leave more.
"""
WRONG_SHARE = 0.5
"""Ratio of error to reported displacement of a joint that is displaced in another's trial, above which it is wrong."""
LEAST_STOPS = 4
"""Least number of a trial's stops for detecting a single wrong one."""
MOST_GIVEN = 0.06
"""Largest apparent scale error of a joint that sag or coupling can cause."""
LIKE_OTHERS = 3.0
"""Ratio of a joint's motion due to a wrong scale over its trial to the joints' errors, from which they are distinct."""


class ScalesError(Exception):
    """Errors of the joint readings explain the data together with these scale ``factors`` (n,)."""

    def __init__(self, factors: FloatArray, components: VarianceComponents) -> None:
        super().__init__("wrong scales")
        self.factors, self.components = factors, components


def explains(trials: TrialData, solution: Solution, inliers: BoolArray, components: VarianceComponents | None) -> bool:
    """Whether a bundle with joint noise leaves only noise, for readings that are not plainly wrong."""
    if _errors_dominate_motion(trials, solution):
        return False
    return (
        components is not None
        and components.significant
        and solution.statistics.variance <= EXPLAINED**2
        and float((~inliers).mean()) <= MOST_OUTLIERS
    )


def _errors_dominate_motion(trials: TrialData, solution: Solution) -> bool:
    """Whether the error of a joint is a large part of its reported displacement while another one moves: a wrong
    position, not an error of a gear.
    """
    errors = solution.data.corrections
    motion = solution.data.offsets - errors
    errors, motion = errors - np.median(errors, axis=0), motion - np.median(motion, axis=0)
    others = trials.trials[:, None] != np.arange(errors.shape[1])
    placed = others & (np.abs(motion) > SAME_READING)
    return bool((placed & (np.abs(errors) > WRONG_SHARE * np.abs(motion))).any())


def is_single_event(trials: TrialData, solution: Solution) -> bool:
    """Whether the errors of the joints look like a single event: a wrong stop, or a lasting step."""
    errors = solution.data.corrections
    for joint in range(errors.shape[1]):
        own = errors[trials.trials == joint, joint]
        squares = (own - np.median(own)) ** 2
        if len(own) >= LEAST_STOPS and squares.max() > ONE_STOP * np.quantile(squares, OTHERS):
            return True
    reported = solution.data.corrected(None)
    left = np.full_like(trials.pixels, np.nan)
    left[reported.camera, reported.stop, reported.marker] = reported.pixels - predicted(solution.rig, reported)
    return find_step(msgspec.structs.replace(trials, pixels=left), ONE_STEP) is not None


def wrong_scales(trials: TrialData, components: VarianceComponents) -> FloatArray:
    """Scale factor (n,) of each joint's reading, 1 if it is not significant beside the joint errors, or if these are
    as large.

    By Student's distribution with the degrees of freedom of the joint's errors; false once in
    ``1 / FALSE_ALARM`` fits.
    """
    factors = np.ones(len(trials.joint_names))
    revolute = [j for j, kind in enumerate(trials.joint_kinds) if kind == "revolute"]
    total = np.sqrt(components.random + components.repeatable + components.posture)
    for joint, log, deviation in zip(revolute, components.scales, components.scale_deviations, strict=True):
        own = trials.positions[trials.trials == joint, joint]
        if not len(own):
            continue
        limit = student.isf(FALSE_ALARM / (2 * len(revolute)), max(len(own) - 3, 1))
        moved = abs(log) * float(np.std(own))
        if (
            abs(np.expm1(log)) > LEAST_FACTOR
            and abs(log) > limit * deviation
            and moved > LIKE_OTHERS * float(total[revolute].max())
        ):
            factors[joint] = float(np.exp(log))
    return factors


def refuse_wrong_scales(trials: TrialData, components: VarianceComponents) -> None:
    """Raise ScalesError if scales are wrong beside the joint errors."""
    factors = wrong_scales(trials, components)
    if (factors != 1.0).any():
        raise ScalesError(factors, components)


def small_scales(cause: CalibrationError) -> str:
    """Note on compliant gears as an alternative to wrong scales, if they could have the same effect; "" if they
    could not.
    """
    joints = cause.data.get("joints") if cause.code == "wrong_scale" else None
    if not joints or any(abs(one["factor"] - 1.0) > MOST_GIVEN for one in joints.values()):
        return ""
    listed = ", ".join(
        f"{name!r} reports {one['factor']:.4g} ± {one['deviation']:.1g} times its motion"
        for name, one in joints.items()
    )
    return (
        f"joint {listed}: its drive's scale may be wrong, or it yields under its load, or turns with the joint "
        "beside it; the trials do not determine which, and the model takes it for an error of the reading. To find "
        "out: its angle by a protractor over its whole range, the arm's weight on and off it"
    )


def scales_error(trials: TrialData, factors: FloatArray, components: VarianceComponents) -> CalibrationError:
    """Error that states the ``factors`` (n,) that differ from 1."""
    revolute = [j for j, kind in enumerate(trials.joint_kinds) if kind == "revolute"]
    deviations = np.zeros(len(factors))
    deviations[revolute] = components.scale_deviations
    found = {
        trials.joint_names[j]: {"factor": float(factors[j]), "deviation": float(deviations[j] * factors[j])}
        for j in np.flatnonzero(factors != 1.0)
    }
    listed = ", ".join(
        f"{name!r} reports {one['factor']:.5g} ± {one['deviation']:.1g} times its motion" for name, one in found.items()
    )
    return CalibrationError(
        "wrong_scale",
        f"joint {listed}, beside the errors that its readings and those of the other joints have. Revolute joints must "
        "report radians: correct the drive's scale",
        joints=found,
    )
