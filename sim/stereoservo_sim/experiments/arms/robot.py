"""Experiment ``robot`` (tables 5.1 to 5.4): self-calibration of a 6R arm from a moving plate; images, axes, links,
intrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import ellipe

from stereoservo.calibration.bundle_adjustment import jacobian, solve
from stereoservo.calibration.rig_model import Measurements, RigModel, full_charts, residuals, rig_at
from stereoservo.calibration.self_calibration import fit_model
from stereoservo.calibration.single_joint_fit import measurements
from stereoservo.calibration.trial_data import TrialData
from stereoservo.geometry.cameras import projection_jacobian_many, triangulate
from stereoservo.geometry.distortion import undistort
from stereoservo.kinematics.axes import FramedModel, axis_angle, camera_intrinsics, framed, joint_axes
from stereoservo.kinematics.chain import ProjectiveChain
from stereoservo.kinematics.covariance import propagated
from stereoservo.kinematics.denavit_hartenberg import conventions, dh_values
from stereoservo.kinematics.model import CellModel
from stereoservo.messages.known_length import KnownLength
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.experiments.arms.thesis_robot import BASELINE, SIGMA, thesis_cell, trial_motions
from stereoservo_sim.progress import ProgressCall
from stereoservo_sim.world.exact_model import exact_model
from stereoservo_sim.world.synthetic import SyntheticCell

LINK_2 = KnownLength("a", ("j2",), 0.4)
"""The scale, as in table 5.4."""


@dataclass(frozen=True)
class TableQuantity:
    """A quantity of a table: its place, name and unit."""

    table: str
    name: str
    unit: str


INTRINSICS = ("fx", "skew", "fy", "u0", "v0")
QUANTITIES = (
    *(TableQuantity("5.2", f"{side} {name}", "px") for side in ("left", "right") for name in INTRINSICS),
    TableQuantity("5.3", "axes 1, 2", "°"),
    TableQuantity("5.3", "axes 2, 3 about their normal", "°"),
    TableQuantity("5.3", "axes 2, 3 in their plane", "°"),
    TableQuantity("5.3", "axes 3, 4", "°"),
    TableQuantity("5.3", "axes 4, 5", "°"),
    TableQuantity("5.3", "axes 5, 6", "°"),
    TableQuantity("5.4", "link 1", "mm"),
    TableQuantity("5.4", "link 3", "mm"),
    TableQuantity("5.4", "link 4", "mm"),
    TableQuantity("5.4", "link 5", "mm"),
    TableQuantity("5.4", "axes 4, 6", "mm"),
)
"""What `tables` gives, in its order. Angle 2, 3 is 0: its two components have a sign and so a Gaussian error."""


def tables(model: CellModel) -> FloatArray:
    """Tables 5.2 to 5.4 (21,) of a metric ``model`` of the robot: see ``QUANTITIES``."""
    return tables_of(framed(model), model)


def tables_of(parts: FramedModel, names: CellModel) -> FloatArray:
    """`tables` of a model's parts in a Euclidean frame; ``names``: a model with the same joints."""
    axes = joint_axes(parts.kinds, parts.generators)
    a, alpha, beta, d = dh_values(parts, conventions(parts), LINK_2, names)[:, :4].T
    angles = [axis_angle(axes.directions[j], axes.directions[j + 1]) for j in (0, 2, 3, 4)]
    return np.concatenate(
        [
            *(camera_intrinsics(P) for P in parts.cameras),
            np.degrees([angles[0], alpha[1], beta[1], *angles[1:]]),
            1e3 * np.array([a[0], d[3], a[3], a[4], abs(d[4])]),
        ]
    )


def cramer_rao(cell: SyntheticCell, trials: TrialData) -> FloatArray:
    """Least covariance (21, 21) of `tables` from ``trials``: information of the pixels at the truth, metric bundle."""
    exact = exact_model(cell)
    parts = framed(exact)
    rig = RigModel(cell.kinds, parts.generators, parts.cameras, parts.points, parts.lenses)
    data = measurements(trials, trials.visible, trials.positions - cell.home)
    charts = full_charts(rig, "metric")
    slope = jacobian(rig, charts, np.zeros(charts.size), data)
    sizes = np.linalg.norm(slope, axis=0)
    root = np.linalg.inv(np.linalg.qr(slope / sizes, mode="r")) / sizes[:, None]

    def at(x: FloatArray) -> FloatArray:
        there = rig_at(rig, charts, x)
        return tables_of(
            replace(parts, generators=there.generators, cameras=there.cameras, points=there.points), exact
        )

    # A hundredth of a standard deviation to either side of the truth.
    slopes = np.array([(at(0.01 * axis) - at(-0.01 * axis)) / 0.02 for axis in root.T])
    result: FloatArray = slopes.T @ slopes
    return result


@dataclass(frozen=True)
class ImageErrors:
    """Mean image distances (n,) [px] of each axis's trial and what the noise alone gives there, both with the points
    fixed (5.53) and free (5.55); ``residuals`` (k, 2) [sigmas] of the free ones, ``joint`` (k,)."""

    fixed: FloatArray
    fixed_floor: FloatArray
    free: FloatArray
    free_floor: FloatArray
    residuals: FloatArray
    joint: npt.NDArray[np.int64]


def image_errors(
    model: CellModel, trials: TrialData, home: FloatArray, home_pixels: FloatArray
) -> ImageErrors:
    """Table 5.1 of a fitted model: image distances of its trials.

    Fixed points are triangulated from one stereo image, ``home_pixels`` (c, m, 2) taken at ``home`` (n,), with the
    model's cameras; the generators are then fitted to the trials, points and cameras held.
    """
    parts = framed(model)
    chain = ProjectiveChain(parts.kinds, parts.generators, parts.zero)
    operators, ahead = chain.operators_at(home), chain.displacement(home)
    rig = _rig(parts, operators, parts.points @ ahead.T)
    data = measurements(trials, trials.visible, trials.positions - home)
    of_joint = trials.trials[data.stop]
    free = residuals(rig, data).reshape(-1, 2)
    free_spread = _remaining(jacobian_at(rig, data))
    ideal = np.array(
        [undistort(lens, pixels) for lens, pixels in zip(parts.lenses, home_pixels, strict=True)]
    )
    seen = triangulate(parts.cameras, ideal)
    points = seen / seen[:, 3:]
    given = RigModel(rig.kinds, rig.generators, rig.cameras, points, rig.lenses)
    fixed = solve(given, data, "metric", cameras=False, points=False)
    of_points = _points_noise(fixed.rig, data, trials.sigmas[:, 0])
    fixed_spread = _remaining(jacobian_at(fixed.rig, data, points=False, cameras=False), of_points)
    n = len(trials.joint_names)
    return ImageErrors(
        _means(np.linalg.norm(fixed.residuals.reshape(-1, 2), axis=1) * data.sigmas, of_joint, n),
        _means(mean_length(fixed_spread) * data.sigmas, of_joint, n),
        _means(np.linalg.norm(free, axis=1) * data.sigmas, of_joint, n),
        _means(mean_length(free_spread) * data.sigmas, of_joint, n),
        free,
        of_joint,
    )


def _rig(parts: FramedModel, generators: FloatArray, points: FloatArray) -> RigModel:
    return RigModel(parts.kinds, generators, parts.cameras, points, parts.lenses)


def jacobian_at(
    rig: RigModel, data: Measurements, *, cameras: bool = True, points: bool = True
) -> FloatArray:
    """Jacobian (2 k, p) of the metric bundle at ``rig``."""
    charts = full_charts(rig, "metric", cameras=cameras, points=points)
    return jacobian(rig, charts, np.zeros(charts.size), data)


def _points_noise(rig: RigModel, data: Measurements, sigmas: FloatArray) -> FloatArray:
    """Derivative of the residuals by the noise of points triangulated at the rig's zero from pixels with ``sigmas``
    (c, m).

    Columns (2 k, 3 m), one standard deviation each.
    """
    charts = full_charts(rig, "metric", cameras=False)
    slopes = jacobian(rig, charts, np.zeros(charts.size), data)[:, -3 * len(rig.points) :]
    through = projection_jacobian_many(rig.cameras, rig.points)
    columns = []
    for i, basis in enumerate(charts.points):
        rows = (through[:, i] @ basis.T / sigmas[:, i, None, None]).reshape(-1, 3)
        columns.append(slopes[:, 3 * i : 3 * i + 3] @ np.linalg.inv(np.linalg.qr(rows, mode="r")))
    return np.hstack(columns)


def _remaining(jacobian: FloatArray, disturbance: FloatArray | None = None) -> FloatArray:
    """Covariances (k, 2, 2) [sigmas²] of the residuals that a fit by ``jacobian`` (2 k, p) leaves of unit noise, and of
    a ``disturbance`` (2 k, r) of one standard deviation a column."""
    basis = np.linalg.qr(jacobian)[0]
    rows = basis.reshape(-1, 2, basis.shape[1])
    result: FloatArray = np.eye(2) - rows @ rows.transpose(0, 2, 1)
    if disturbance is not None:
        left = (disturbance - basis @ (basis.T @ disturbance)).reshape(-1, 2, disturbance.shape[1])
        result = result + left @ left.transpose(0, 2, 1)
    return result


def mean_length(covariances: FloatArray) -> FloatArray:
    """Mean length (k,) of Gaussian vectors with covariances (k, 2, 2): ``√(2 λ₁/π) E(1 - λ₂/λ₁)``."""
    values = np.maximum(np.linalg.eigvalsh(covariances), 0.0)
    return np.asarray(np.sqrt(2 * values[:, 1] / np.pi) * ellipe(1.0 - values[:, 0] / values[:, 1]))


def _means(values: FloatArray, groups: npt.NDArray[np.int64], count: int) -> FloatArray:
    return np.array([values[groups == j].mean() for j in range(count)])


@dataclass(frozen=True)
class RobotRuns:
    """All seeds of the experiment: ``values`` (s, 21) of `tables`, their standard deviations ``reported`` by the fits
    (s, 21), ``truth`` (21,), the Cramér-Rao ``bound`` (21, 21), ``images`` one a seed; ``chi2`` (s,) of the fits with
    ``freedom`` each."""

    cell: SyntheticCell
    values: FloatArray
    reported: FloatArray
    truth: FloatArray
    bound: FloatArray
    images: tuple[ImageErrors, ...]
    chi2: FloatArray
    freedom: int
    sigma: float


def simulate(
    seeds: int, seed: int, progress: ProgressCall, sigma: float = SIGMA, baseline: float = BASELINE
) -> RobotRuns:
    """Calibrate the thesis's robot ``seeds`` times with fresh noise ``sigma`` [px] and this ``baseline`` [m]."""
    cell = thesis_cell(baseline)
    motions = trial_motions(cell)
    bound = cramer_rao(cell, cell.trials(sigma, np.random.default_rng(seed), positions=motions))
    values, reported, images, chi2 = [], [], [], []
    freedom = 0
    for k in range(seeds):
        rng = np.random.default_rng([seed, k])
        trials = cell.trials(sigma, rng, positions=motions)
        model = fit_model(trials, epoch=1).model
        home_pixels = cell.pixels(cell.home[None])[:, 0]
        home_pixels = home_pixels + rng.normal(0.0, sigma, home_pixels.shape)
        found, covariance = propagated(model, tables)
        values.append(found)
        reported.append(np.sqrt(np.diag(covariance)))
        images.append(image_errors(model, trials, cell.home, home_pixels))
        if model.statistics is not None:
            chi2.append(model.statistics.chi2)
            freedom = model.statistics.degrees_of_freedom
        progress(f"calibrations at {sigma:g} px, {100 * baseline:.0f} cm", k + 1, seeds)
    truth = tables(exact_model(cell))
    return RobotRuns(
        cell,
        np.array(values),
        np.array(reported),
        truth,
        bound,
        tuple(images),
        np.array(chi2),
        freedom,
        sigma,
    )
