"""From a solved bundle to a cell's model and what is to be said about the fit."""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.geometry.strata import affine_to_projective, euclidean_to_projective, upper_triangular
from stereoservo.kinematics.calibration.bundle import Measurements, Rig, Solution, predicted
from stereoservo.kinematics.calibration.statistics import (
    chi2_within,
    covariance_root,
    degrees_of_freedom,
    prediction_deviations,
    variance_factor,
)
from stereoservo.kinematics.calibration.trials import TrialData
from stereoservo.kinematics.model import (
    MODEL_SCHEMA,
    CameraModel,
    CellModel,
    FitStatistics,
    JointStatistics,
    Stratum,
    check_model,
)

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class CameraReport(msgspec.Struct, frozen=True):
    """Fit of one camera: residual rms [px], pixels used, pixels left out; intrinsics [px] in the metric
    stratum.

    ``intrinsics``: fx, skew, fy, u0, v0.
    """

    name: str
    rms_px: float
    pixels: int
    outliers: int
    intrinsics: tuple[float, float, float, float, float] | None


class Outlier(msgspec.Struct, frozen=True):
    """A pixel that was left out, and how far it lies from the model [px]."""

    camera: str
    stop: int
    marker: int
    distance_px: float


class CalibrationReport(msgspec.Struct, frozen=True):
    """What is known about a fit beside the model's own statistics.

    ``sigma_factor``: estimated over stated standard deviation of the pixels (square root of the variance
    factor). ``prediction_rms_px``, ``prediction_max_px``: standard deviation of the predicted pixels a
    coordinate, ``J Cov Jᵀ``, over all cameras, stops and markers, seen or not. ``left_intrinsics_std``: of
    fx, skew, fy, u0, v0 [px]. ``projective_chi2``, ``projective_degrees_of_freedom``: of the projective
    bundle, which the stratum's is nested in.
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


class CalibrationResult(msgspec.Struct, frozen=True, eq=False):
    """A fitted model and its report."""

    model: CellModel
    report: CalibrationReport


def build_result(
    trials: TrialData,
    solution: Solution,
    every: Measurements,
    inliers: BoolArray,
    zero: FloatArray,
    plane: FloatArray,
    normaliser: FloatArray,
    *,
    epoch: int,
    created: str,
    notes: tuple[str, ...],
    projective: tuple[float, int],
    markers_left_out: tuple[int, ...],
) -> CalibrationResult:
    """Model and report of a solved bundle; ``plane`` (4,) at infinity in the projective frame."""
    data = every.select(inliers)
    errors = solution.residuals.reshape(-1, 2) * data.sigmas[:, None]
    squares = (errors**2).sum(axis=1) / 2
    freedom = degrees_of_freedom(solution)
    statistics = FitStatistics(
        rms_px=_rms(squares),
        chi2=solution.cost,
        degrees_of_freedom=freedom,
        chi2_ok=chi2_within(solution.cost, freedom),
        measurements=solution.rows,
        parameters=solution.charts.size,
        outliers=int((~inliers).sum()),
        joints=tuple(_joint_statistics(trials, j, squares, data) for j in range(len(trials.joint_names))),
        images=trials.images,
    )
    model = build_model(trials, solution, zero, plane, normaliser, statistics, epoch, created)
    deviations = prediction_deviations(solution, every.offsets)
    left_out = _outliers(trials, solution.rig, every, inliers)
    metric = solution.stratum == "metric"
    report = CalibrationReport(
        stratum=solution.stratum,
        rms_px=statistics.rms_px,
        chi2=statistics.chi2,
        degrees_of_freedom=freedom,
        chi2_ok=statistics.chi2_ok,
        sigma_factor=float(np.sqrt(variance_factor(solution))),
        projective_chi2=projective[0],
        projective_degrees_of_freedom=projective[1],
        prediction_rms_px=float(np.sqrt((deviations**2).mean())),
        prediction_max_px=float(deviations.max()),
        cameras=tuple(
            CameraReport(
                camera.name,
                _rms(squares[data.camera == c]),
                int((data.camera == c).sum()),
                int((every.camera[~inliers] == c).sum()),
                intrinsics(solution.rig.cameras[c]) if metric else None,
            )
            for c, camera in enumerate(trials.cameras)
        ),
        outliers=left_out,
        left_intrinsics_std=_left_intrinsics_std(solution) if metric else None,
        markers_left_out=markers_left_out,
        notes=notes,
    )
    return CalibrationResult(model, report)


def build_model(
    trials: TrialData,
    solution: Solution,
    zero: FloatArray,
    plane: FloatArray,
    normaliser: FloatArray,
    statistics: FitStatistics,
    epoch: int,
    created: str,
) -> CellModel:
    """The model in the canonical projective frame: ``P_left = [N⁻¹ | 0]``, heights 1 by the plane at
    infinity.
    """
    rig, stratum = solution.rig, solution.stratum
    if stratum == "projective":
        frame: FloatArray = np.eye(4)
    elif stratum == "affine":
        frame = affine_to_projective(plane)
    else:
        frame = euclidean_to_projective(plane, normaliser @ rig.cameras[0][:, :3])
    back: FloatArray = np.asarray(np.linalg.inv(frame), dtype=np.float64)
    points = rig.points @ frame.T
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
        zero=zero,
        generators=frame @ rig.generators @ back,
        cameras=tuple(
            CameraModel(camera.name, matrix, camera.width, camera.height)
            for camera, matrix in zip(trials.cameras, cameras, strict=True)
        ),
        marker_ids=trials.marker_ids,
        marker_points=points,
        plane_at_infinity=plane,
        stratum=stratum,
        projective_to_euclidean=back if stratum == "metric" else None,
        statistics=statistics,
        created=created,
        source="trial motions",
    )
    check_model(model)
    return model


def intrinsics(matrix: FloatArray) -> tuple[float, float, float, float, float]:
    """fx, skew, fy, u0, v0 [px] of a camera (3, 4) in a Euclidean frame."""
    K, _ = upper_triangular(matrix[:, :3])
    return float(K[0, 0]), float(K[0, 1]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _left_intrinsics_std(solution: Solution) -> tuple[float, ...]:
    at = sum(len(basis) for basis in solution.charts.generators)
    scale = np.array([np.abs(basis).max() for basis in solution.charts.cameras[0]])
    variances = (covariance_root(solution)[at : at + 5] ** 2).sum(axis=1) * scale**2
    variances *= max(1.0, variance_factor(solution))
    fx, skew, u0, fy, v0 = (float(value) for value in np.sqrt(variances))
    return fx, skew, fy, u0, v0


def _joint_statistics(
    trials: TrialData, joint: int, squares: FloatArray, data: Measurements
) -> JointStatistics:
    own = np.flatnonzero(trials.trials == joint)
    positions = trials.positions[own, joint]
    return JointStatistics(
        trials.joint_names[joint],
        _rms(squares[np.isin(data.stop, own)]),
        len(own),
        float(np.ptp(positions)) if len(own) else 0.0,
    )


def _outliers(trials: TrialData, rig: Rig, every: Measurements, inliers: BoolArray) -> tuple[Outlier, ...]:
    lost = every.select(~inliers)
    if not len(lost.pixels):
        return ()
    distances = np.linalg.norm(predicted(rig, lost) - lost.pixels, axis=1)
    return tuple(
        Outlier(trials.cameras[c].name, int(s), trials.marker_ids[m], float(distance))
        for c, s, m, distance in zip(lost.camera, lost.stop, lost.marker, distances, strict=True)
    )


def _rms(squares: FloatArray) -> float:
    return float(np.sqrt(squares.mean())) if len(squares) else 0.0
