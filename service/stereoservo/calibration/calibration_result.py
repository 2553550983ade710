"""Result of a calibration: the cell's model with its covariance, assembled from a solved bundle adjustment, and the
report of the fit (cameras, lenses, outliers).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import msgspec
import numpy as np

from stereoservo.calibration.bundle_adjustment import (
    GroupRms,
    Solution,
    group_rms,
    joint_variances,
    prediction_variances,
    residual_expectations,
    with_joint_error_covariance,
)
from stereoservo.calibration.least_squares import chi2_within
from stereoservo.calibration.lens_estimation import lens_test
from stereoservo.calibration.rig_model import Measurements, RigModel, predicted
from stereoservo.calibration.shutter_offset import with_shutter_offsets
from stereoservo.calibration.static_points import with_static_points
from stereoservo.calibration.trial_data import CalibrationError, TrialData
from stereoservo.calibration.variance_components import VarianceComponents, readings
from stereoservo.geometry.cameras import pixel_normaliser
from stereoservo.geometry.strata import affine_to_projective, euclidean_to_projective
from stereoservo.kinematics.axes import camera_intrinsics
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.kinematics.model import (
    MODEL_SCHEMA,
    CameraModel,
    CellModel,
    FitStatistics,
    JointStatistics,
    ModelCovariance,
    ModelFileError,
    Stratum,
    check_model,
)
from stereoservo.kinematics.parameterization import Kind, LensModel
from stereoservo.numerics.arrays import BoolArray, FloatArray


class CameraReport(msgspec.Struct, frozen=True):
    """Fit of one camera: residual rms [px], pixels used, pixels left out; intrinsics [px] in the metric
    stratum.

    ``expected_px``, ``standard_error_px``: of the rms, as in the model's joint statistics. ``intrinsics``: fx, skew,
    fy, u0, v0. ``lens``: k, cu, cv (`geometry.distortion`) and ``lens_std`` their deviations, None for a pinhole.
    ``lens_terms``: k2, p1, p2 and ``lens_terms_std`` their deviations, None for a lens without them.
    """

    name: str
    rms_px: float
    pixels: int
    outliers: int
    intrinsics: tuple[float, float, float, float, float] | None
    expected_px: float
    standard_error_px: float
    lens: tuple[float, float, float] | None
    lens_std: tuple[float, ...] | None
    lens_terms: tuple[float, float, float] | None = None
    lens_terms_std: tuple[float, ...] | None = None


class LensReport(msgspec.Struct, frozen=True):
    """Selected lens model, ``none``, ``radial_centre`` or ``brown``, and its test.

    ``chi2``: of the parameters of all lenses except their centres (``freedom`` of them) against zero: the gain
    from freeing them if they are fixed (score test), their own significance if they are free (Wald test).
    Above ``limit`` a lens distorts; pinholes exceed it once in ten thousand fits.
    """

    model: LensModel
    chi2: float
    freedom: int
    limit: float


class JointErrorReport(msgspec.Struct, frozen=True):
    """Errors of a joint's readings as standard deviations [rad or m], ``random``, ``repeatable`` and by ``posture``,
    each with its own standard deviation; ``pixels``: resulting motion of the markers in the images, rms [px].
    """

    name: str
    kind: Kind
    random: float
    random_std: float
    repeatable: float
    repeatable_std: float
    posture: float
    posture_std: float
    pixels: float


class Outlier(msgspec.Struct, frozen=True):
    """A rejected pixel and its distance from the prediction [px]."""

    camera: str
    stop: int
    marker: int
    distance_px: float


class CalibrationReport(msgspec.Struct, frozen=True):
    """Statistics of a fit that are not part of the model.

    ``sigma_factor``: estimated over stated standard deviation of the pixels (square root of the variance
    factor). ``prediction_rms_px``, ``prediction_max_px``: standard deviation per coordinate of the predicted pixels,
    ``J Cov Jᵀ``, over all cameras, stops and markers, seen or not. ``left_intrinsics_std``: of
    fx, skew, fy, u0, v0 [px]. ``projective_chi2``, ``projective_degrees_of_freedom``: of the projective
    bundle, in which the stratum's is nested. ``lens``: the lens model and its test.
    ``untested``: inputs used as stated because the trials do not determine them. ``joints``: errors of the joint
    readings; empty if the data show none. Chi-square, residuals and deviations then belong to a model with both
    noises; residuals are those that remain beside the joints' errors. ``exact_joints_chance``: above 0 if errors are
    only likely: upper bound of the probability that exact readings show as much; deviations then include the errors,
    chi-square and residuals belong to a model with exact readings.
    """

    stratum: Stratum
    rms_px: float
    chi2: float
    degrees_of_freedom: int
    chi2_ok: bool
    sigma_factor: float
    projective_chi2: float
    projective_degrees_of_freedom: int
    prediction_rms_px: float
    prediction_max_px: float
    cameras: tuple[CameraReport, ...]
    outliers: tuple[Outlier, ...]
    left_intrinsics_std: tuple[float, ...] | None
    markers_left_out: tuple[int, ...]
    notes: tuple[str, ...]
    lens: LensReport
    untested: tuple[str, ...] = ()
    joints: tuple[JointErrorReport, ...] = ()
    exact_joints_chance: float = 0.0


class CalibrationFit(msgspec.Struct, frozen=True, eq=False):
    """A fitted model and its report."""

    model: CellModel
    report: CalibrationReport


class ModelFrame(NamedTuple):
    """Joint positions ``zero`` (n,) at which the generators are defined, and the ``plane`` (4,) at infinity in the
    projective frame.
    """

    zero: FloatArray
    plane: FloatArray


class FitHistory(NamedTuple):
    """Results before a final bundle: cost and degrees of freedom of the ``projective`` one, notes, markers left out."""

    projective: tuple[float, int]
    notes: tuple[str, ...]
    markers_left_out: tuple[int, ...] = ()


def build_fit(
    trials: TrialData,
    solution: Solution,
    every: Measurements,
    inliers: BoolArray,
    frame: ModelFrame,
    history: FitHistory,
    *,
    epoch: int,
    created: str,
    components: VarianceComponents | None = None,
    exact_joints_chance: float = 0.0,
) -> CalibrationFit:
    """Model and report of a solved bundle. Raises CalibrationError.

    ``components``: of its joint noise; with ``exact_joints_chance`` > 0, likely noise beside exact readings.
    """
    data = every.select(inliers)
    errors = solution.residuals.reshape(-1, 2) * data.sigmas[:, None]
    squares = (errors**2).sum(axis=1) / 2
    freedom = solution.statistics.freedom
    variances = prediction_variances(solution, every.offsets)
    own = variances[data.camera, data.stop, data.marker]
    if components is not None:
        if solution.data.joint_noise is None:
            solution = with_joint_error_covariance(solution, components.noise(readings(every.offsets)))
            variances = prediction_variances(solution, every.offsets)
        else:
            own = data.sigmas**2 * (2.0 - residual_expectations(solution))
        by_joint = joint_variances(solution, every.offsets)
        reading_deviations = _accuracy(components).deviations(every.offsets - every.corrections)
        by_error = (by_joint * reading_deviations[None, :, None] ** 2).sum(axis=3)
        variances = variances + by_error / solution.statistics.noise

    def group(members: BoolArray) -> GroupRms:
        return group_rms(squares[members], data.sigmas[members], own[members])

    statistics = FitStatistics(
        rms_px=float(np.sqrt(squares.mean())),
        chi2=solution.cost,
        degrees_of_freedom=freedom,
        chi2_ok=chi2_within(solution.cost, freedom),
        measurements=solution.rows,
        parameters=solution.charts.size,
        outliers=int((~inliers).sum()),
        joints=tuple(_joint_statistics(trials, j, group, data) for j in range(len(trials.joint_names))),
        images=trials.images,
    )
    model = build_model(trials, solution, frame, statistics, epoch, created)
    if components is not None:
        model = msgspec.structs.replace(model, joint_accuracy=_accuracy(components))
    shown = variances[np.isfinite(variances)] / 2 * solution.statistics.noise
    tested = lens_test(solution)
    report = CalibrationReport(
        stratum=solution.stratum,
        rms_px=statistics.rms_px,
        chi2=statistics.chi2,
        degrees_of_freedom=freedom,
        chi2_ok=statistics.chi2_ok,
        sigma_factor=float(np.sqrt(solution.statistics.variance)),
        projective_chi2=history.projective[0],
        projective_degrees_of_freedom=history.projective[1],
        prediction_rms_px=float(np.sqrt(shown.mean())),
        prediction_max_px=float(np.sqrt(shown.max())),
        cameras=tuple(
            _camera_report(trials, c, solution, group(data.camera == c), every, inliers)
            for c in range(len(trials.cameras))
        ),
        outliers=_outliers(trials, solution.rig, every.corrected(solution.data.joint_errors), inliers),
        left_intrinsics_std=_left_intrinsics_std(solution) if solution.stratum == "metric" else None,
        markers_left_out=history.markers_left_out,
        notes=history.notes,
        lens=LensReport(solution.lenses, tested.chi2, tested.freedom, tested.limit),
        joints=() if components is None else _joint_errors(trials, components, by_joint),
        exact_joints_chance=exact_joints_chance,
    )
    return CalibrationFit(model, report)


def _accuracy(components: VarianceComponents) -> JointAccuracy:
    found = components.deviations
    return JointAccuracy(found[:, 0], found[:, 1], components.stated, components.stated_posture)


def _joint_errors(
    trials: TrialData, components: VarianceComponents, by_joint: FloatArray
) -> tuple[JointErrorReport, ...]:
    """Errors of each joint; ``by_joint`` (c, s, m, n) from `joint_variances`."""
    slopes = np.sqrt(np.nanmean(by_joint, axis=(0, 1, 2)) / 2)
    found, sigmas = components.deviations, components.deviations_of_deviations
    return tuple(
        JointErrorReport(
            name,
            kind,
            float(found[j, 0]),
            float(sigmas[j, 0]),
            float(found[j, 1]),
            float(sigmas[j, 1]),
            float(found[j, 2]),
            float(sigmas[j, 2]),
            float(slopes[j] * np.linalg.norm(found[j])),
        )
        for j, (name, kind) in enumerate(zip(trials.joint_names, trials.joint_kinds, strict=True))
    )


def _camera_report(
    trials: TrialData, c: int, solution: Solution, fit: GroupRms, every: Measurements, inliers: BoolArray
) -> CameraReport:
    lens, lens_std, terms, terms_std = None, None, None, None
    if solution.lenses != "none":
        k, cu, cv, _, k2, p1, p2 = (float(value) for value in solution.rig.lenses[c])
        basis = solution.charts.lenses[c]
        at = solution.charts.start(2) + sum(len(other) for other in solution.charts.lenses[:c])
        covariance = solution.statistics.covariance[at : at + len(basis), at : at + len(basis)]
        lens = k, cu, cv
        deviations = tuple(float(value) for value in np.sqrt(np.diag(basis.T @ covariance @ basis)))
        lens_std = deviations[:3]
        if solution.lenses == "brown":
            terms, terms_std = (k2, p1, p2), deviations[4:]
    mine = every.camera == c
    return CameraReport(
        trials.cameras[c].name,
        fit.rms_px,
        int((mine & inliers).sum()),
        int((mine & ~inliers).sum()),
        intrinsics(solution.rig.cameras[c]) if solution.stratum == "metric" else None,
        fit.expected_px,
        fit.standard_error_px,
        lens,
        lens_std,
        terms,
        terms_std,
    )


def completed(result: CalibrationFit, trials: TrialData) -> CalibrationFit:
    """The fit extended by static points, loads and shutter offsets from the trials."""
    model, of_scene = with_static_points(result.model, trials.static)
    report = msgspec.structs.replace(result.report, notes=(*result.report.notes, *of_scene))
    model = msgspec.structs.replace(model, loads=trials.loads)
    return CalibrationFit(with_shutter_offsets(model, trials.way), report)


def build_model(
    trials: TrialData,
    solution: Solution,
    frame: ModelFrame,
    statistics: FitStatistics,
    epoch: int,
    created: str,
) -> CellModel:
    """Model in the canonical projective frame: ``P_left = [N⁻¹ | 0]``, points scaled to 1 by the plane at infinity."""
    rig, stratum, plane = solution.rig, solution.stratum, frame.plane
    normaliser = pixel_normaliser(trials.cameras[0].width, trials.cameras[0].height)
    if stratum == "projective":
        to_projective: FloatArray = np.eye(4)
    elif stratum == "affine":
        to_projective = affine_to_projective(plane)
    else:
        to_projective = euclidean_to_projective(plane, normaliser @ rig.cameras[0][:, :3])
    back: FloatArray = np.asarray(np.linalg.inv(to_projective), dtype=np.float64)
    points = rig.points @ to_projective.T
    points = points / (points @ plane)[:, None]
    cameras = rig.cameras @ back
    cameras[0] = np.hstack([np.linalg.inv(normaliser), np.zeros((3, 1))])
    for c in range(1, len(cameras)):
        cameras[c] /= np.mean(points @ cameras[c, 2]) / np.mean(points[:, 2])
    model = CellModel(
        schema=MODEL_SCHEMA,
        epoch=epoch,
        joint_names=trials.joint_names,
        joint_kinds=trials.joint_kinds,
        zero=frame.zero,
        generators=to_projective @ rig.generators @ back,
        cameras=tuple(
            CameraModel(camera.name, matrix, camera.width, camera.height, lens[: _lens_size(solution)])
            for camera, matrix, lens in zip(trials.cameras, cameras, rig.lenses, strict=True)
        ),
        marker_ids=trials.marker_ids,
        marker_points=points,
        plane_at_infinity=plane,
        stratum=stratum,
        projective_to_euclidean=back if stratum == "metric" else None,
        statistics=statistics,
        created=created,
        source="trial motions",
        covariance=_covariance(solution, to_projective, back, cameras, points),
    )
    try:
        check_model(model)
    except ModelFileError as error:
        raise CalibrationError(
            "no_convergence", f"the fit ends in what is no model: {error}. Are positions and markers as said?"
        ) from error
    return model


def _lens_size(solution: Solution) -> int:
    """Number of parameters of each lens: 7 with second radial and tangential terms, else 4."""
    return 7 if solution.lenses == "brown" else 4


def _covariance(
    solution: Solution, frame: FloatArray, back: FloatArray, cameras: FloatArray, points: FloatArray
) -> ModelCovariance:
    """The bundle's covariance with its directions transformed into the model's ``frame`` (4, 4), whose ``cameras`` and
    ``points`` define the scales.
    """
    rig, charts = solution.rig, solution.charts
    # Matrices and points are scaled as a whole, and their directions with them.
    matrices = rig.cameras @ back
    camera_scales = (cameras * matrices).sum(axis=(1, 2)) / (matrices**2).sum(axis=(1, 2))
    brought = rig.points @ frame.T
    point_scales = (points * brought).sum(axis=1) / (brought**2).sum(axis=1)
    return ModelCovariance(
        tuple(frame @ basis @ back for basis in charts.generators),
        tuple(scale * (basis @ back) for scale, basis in zip(camera_scales, charts.cameras, strict=True)),
        tuple(basis[:, : _lens_size(solution)] for basis in charts.lenses),
        tuple(scale * (basis @ frame.T) for scale, basis in zip(point_scales, charts.points, strict=True)),
        solution.statistics.covariance,
    )


def intrinsics(matrix: FloatArray) -> tuple[float, float, float, float, float]:
    """fx, skew, fy, u0, v0 [px] of a camera (3, 4) in a Euclidean frame."""
    fx, skew, fy, u0, v0 = (float(value) for value in camera_intrinsics(matrix))
    return fx, skew, fy, u0, v0


def _left_intrinsics_std(solution: Solution) -> tuple[float, ...]:
    at = solution.charts.start(1)
    deviations = np.sqrt(np.diag(solution.statistics.covariance)[at : at + 5])
    fx, skew, u0, fy, v0 = (float(value) for value in deviations)
    return fx, skew, fy, u0, v0


def _joint_statistics(
    trials: TrialData, joint: int, group: Callable[[BoolArray], GroupRms], data: Measurements
) -> JointStatistics:
    own = np.flatnonzero(trials.trials == joint)
    positions = trials.positions[own, joint]
    fit = group(np.isin(data.stop, own))
    return JointStatistics(
        trials.joint_names[joint],
        fit.rms_px,
        len(own),
        float(np.ptp(positions)) if len(own) else 0.0,
        fit.expected_px,
        fit.standard_error_px,
    )


def _outliers(trials: TrialData, rig: RigModel, every: Measurements, inliers: BoolArray) -> tuple[Outlier, ...]:
    lost = every.select(~inliers)
    if not len(lost.pixels):
        return ()
    distances = np.linalg.norm(predicted(rig, lost) - lost.pixels, axis=1)
    return tuple(
        Outlier(trials.cameras[c].name, int(s), trials.marker_ids[m], float(distance))
        for c, s, m, distance in zip(lost.camera, lost.stop, lost.marker, distances, strict=True)
    )
