"""Estimated scale factors of joint readings (reported over true motion): of a revolute joint from the images, of a
prismatic one relative to another.

A revolute joint that reports its angle times a factor (counts, degrees, a wrong gear) is no projective rotation by the
reported positions: the spectrum of its generator is ±i times the factor. The factor is estimated first from the
joint's own trial, then with the whole model. Signs and the scale of all prismatic joints together are gauge.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from stereoservo.calibration.bundle_adjustment import Solution, solve
from stereoservo.calibration.calibration_result import CalibrationFit
from stereoservo.calibration.joint_errors.joint_noise import orthogonal_factor
from stereoservo.calibration.least_squares import RobustLoss, estimate_beside
from stereoservo.calibration.lens_significance import scale_columns
from stereoservo.calibration.rig_model import Measurements, RigModel
from stereoservo.calibration.single_joint_fit import (
    VirtualObservations,
    best_single_joint,
    own_trials,
)
from stereoservo.calibration.trial_data import TrialData, finite_rows
from stereoservo.geometry.cameras import NOMINAL_FOCAL
from stereoservo.numerics.arrays import FloatArray

COARSE = tuple(float(2.0 ** (k / 4)) for k in range(-5, 6))
"""Factors about the rigid estimate that a search begins with: nominal cameras misjudge angles."""
WORTH = 40.0
"""Chi-square by which a factor must improve a joint's own trial."""
ABOVE_FLOOR = 1.25
"""How far above the residuals of the other joints' trials one may stay with its factor."""
SIGNIFICANT = 5.0
"""Deviations from 1 at which a factor is one."""
LOSS = RobustLoss("soft_l1", 2.0)
LEAST_FACTOR = 2e-3
"""Relative error of a scale below which it is not worth a refusal."""


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
    """Scale factor (n,) of each joint's reported positions from its own trial, cameras (c, 3, 4) fixed; 1 where no
    other is significant, for prismatic joints, for trials of no use, and where the factor does not bring the
    trial to the residuals of the other joints' trials (another fault is present then).
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


def _best_factor(
    cameras: FloatArray, observations: VirtualObservations, reported: FloatArray
) -> tuple[float, float]:
    """Scale factor of one joint's ``reported`` angles (k,), 1 where no other gains enough, and the median residual
    [sigmas] with it; NaN where the joint fits with none.
    """
    rough = _rigid_factor(observations, reported)
    rigs: dict[float, tuple[RigModel, float]] = {}
    for factor in {1.0, *(rough * step for step in COARSE)}:
        # As reported, the joint must have had every chance before another factor is believed.
        rig, typical = best_single_joint(
            "revolute", cameras, observations, reported / factor, thorough=factor == 1.0
        )
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
    """Coarse scale factor: reported over rotated angle between distant stops, as if the cameras were nominal ones."""
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
        turn, _ = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))
        angle = float(turn.magnitude())
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
    # What the other parameters can imitate of a factor is theirs.
    at = solution.charts.start(3)
    found = estimate_beside(factor.core[at:, at:])
    deviations = np.sqrt(np.diag(found.covariance) * max(1.0, solution.determined.variance))
    return tuple(
        JointScaleEstimate(joint, float(np.exp(log)), float(np.exp(log) * deviation))
        for joint, log, deviation in zip(joints, found.x, deviations, strict=True)
    )


def prismatic_ratios(result: CalibrationFit, solution: Solution) -> tuple[JointScaleEstimate, ...]:
    """Scale of each prismatic joint (reported motion per length) over that of the first one, with deviations; ()
    below the metric stratum and with fewer than two.

    One scale for all of them is gauge; their ratios are not, and are 1 where every drive states the truth.
    """
    joints = [j for j, kind in enumerate(solution.rig.kinds) if kind == "prismatic"]
    if result.model.stratum != "metric" or len(joints) < 2:
        return ()
    lengths = np.linalg.norm(solution.rig.generators[:, :3, 3], axis=1)
    roots = solution.determined.root * np.sqrt(max(1.0, solution.determined.variance))
    starts = np.cumsum([0, *(len(basis) for basis in solution.charts.generators)])

    def log_slope(joint: int) -> FloatArray:
        """Change of the logarithm of a joint's length with the parameters, in their independent directions."""
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
