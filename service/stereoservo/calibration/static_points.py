"""Static points of a cell (markers that do not move with the arm): which markers are static, their mean observations,
and their triangulation into the model with its covariance.
"""

from __future__ import annotations

import msgspec
import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.least_squares import DenseFit, Limits, minimise
from stereoservo.calibration.moved_cameras import (
    CameraMotionEstimate,
    Correspondences,
    model_jacobian,
    parameters_of,
)
from stereoservo.calibration.trial_data import StaticObservations
from stereoservo.geometry.cameras import projection_jacobian_many, triangulate
from stereoservo.geometry.distortion import distort, distortion_jacobian, undistort
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray, IntArray

TAIL = 1e-6
"""Probability that the views of one static point are classified as views of two points."""
LEAST_SCALE = 1e-3
"""Height of a point, relative to its size, below which it counts as at infinity."""
OPEN = 1e7
"""Condition number of a point's rows above which it is undetermined."""
SETTLED = 1e-3
"""Length of a step [standard deviations] at which a point has converged."""


def with_static_points(model: CellModel, static: StaticObservations | None) -> tuple[CellModel, tuple[str, ...]]:
    """The model with its static points, and notes on those that could not be reconstructed."""
    if static is None:
        return model, ()
    if model.mount == "eye_in_hand":
        ids = ", ".join(str(i) for i in static.ids)
        return model, (f"static markers {ids} are left out: from cameras on the arm nothing is static",)
    kept: list[tuple[int, FloatArray, FloatArray]] = []
    notes = []
    for k, marker in enumerate(static.ids):
        found = _scene_point(model, static.pixels[:, k], static.sigmas[:, k])
        if isinstance(found, str):
            notes.append(f"static marker {marker} is left out: {found}")
        else:
            kept.append((marker, *found))
    if not kept:
        return model, tuple(notes)
    return msgspec.structs.replace(
        model,
        scene_ids=tuple(one[0] for one in kept),
        scene_points=np.array([one[1] for one in kept]),
        scene_covariances=np.array([one[2] for one in kept]),
    ), tuple(notes)


def _scene_point(model: CellModel, pixels: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, FloatArray] | str:
    """Point (4,) of scale 1 and its covariance (4, 4), given the cameras, from raw pixels (c, 2), NaN where
    missing; or the reason why there is none.
    """
    seen = np.flatnonzero(np.isfinite(pixels).all(axis=1))
    if len(seen) < 2:
        return f"{len(seen)} camera sees it, two are needed to know where it is"
    cameras = [model.cameras[c] for c in seen]
    matrices = np.array([camera.matrix for camera in cameras])
    ideal = np.array([undistort(camera.lens, pixels[c]) for c, camera in zip(seen, cameras, strict=True)])
    if not np.isfinite(ideal).all():
        return "its pixel lies where the lens shows nothing"
    try:
        point = triangulate(matrices, ideal[:, None], sigmas[seen][:, None])[0]
    except GeometryError as broken:
        return str(broken)
    scale = float(point @ model.plane_at_infinity)
    if not abs(scale) > LEAST_SCALE * float(np.linalg.norm(point)) * float(np.linalg.norm(model.plane_at_infinity)):
        return "it is as good as at infinity"
    point = point / scale
    # Three directions that preserve the height.
    chart = np.linalg.svd(model.plane_at_infinity[None])[2][1:].T
    covariance = _covariance(model, seen, matrices, point, pixels, sigmas)
    white: FloatArray = np.linalg.inv(np.linalg.cholesky(covariance))
    fit = DenseFit[FloatArray](
        lambda at: (white @ _equations(model, seen, matrices, at, pixels, chart)[1])[:, None],
        lambda at: (white @ _equations(model, seen, matrices, at, pixels, chart)[0])[:, None],
        lambda at, x: at + chart @ x,
    )
    found = minimise(fit, point, Limits(settled=SETTLED**2))
    point, determined = found.state, fit.statistics(found.state)
    if not np.isfinite(found.cost) or np.linalg.cond(determined.triangle) >= OPEN:
        return "its rays do not tell how far away it is"
    chi2, freedom = determined.cost, determined.freedom
    noise = 1.0
    if model.statistics is not None and model.statistics.degrees_of_freedom > 0:
        noise = max(1.0, model.statistics.chi2 / model.statistics.degrees_of_freedom)
    limit = float(chi2_distribution.isf(TAIL, freedom)) * noise
    if chi2 > limit:
        return (
            f"its views do not belong together (chi-square {chi2:.4g}, limit {limit:.4g}): did it move, is its id "
            "there twice?"
        )
    rows = fit.rows(point)[:, :-1]
    gain = chart @ determined.root @ determined.root.T @ rows.T @ white
    return point, gain @ (np.repeat(sigmas[seen] ** 2, 2)[:, None] * gain.T)


def _equations(
    model: CellModel,
    seen: IntArray,
    matrices: FloatArray,
    point: FloatArray,
    pixels: FloatArray,
    chart: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Derivative (2 c, 3) of the raw pixels of a point by its chart, and their errors (2 c,)."""
    by_point = projection_jacobian_many(matrices, point[None])[:, 0]
    images = matrices @ point
    ideal = images[:, :2] / images[:, 2:]
    rows, errors = [], []
    for k, c in enumerate(seen):
        lens = model.cameras[c].lens
        rows.append(distortion_jacobian(lens, ideal[k]) @ by_point[k] @ chart)
        errors.append(distort(lens, ideal[k]) - pixels[c])
    return np.concatenate(rows), np.concatenate(errors)


def _covariance(
    model: CellModel,
    seen: IntArray,
    matrices: FloatArray,
    point: FloatArray,
    pixels: FloatArray,
    sigmas: FloatArray,
) -> FloatArray:
    """Covariance (2 c, 2 c) of the pixels of a point, including that of the cameras that see it."""
    covariance = np.diag(np.repeat(sigmas[seen] ** 2, 2))
    if model.covariance is None:
        return covariance
    count = len(seen)
    views = Correspondences(
        np.arange(count),
        np.zeros(count, dtype=np.int64),
        np.full(count, -1, dtype=np.int64),
        np.tile(point, (count, 1)),
        pixels[seen],
        np.tile(np.eye(2), (count, 1, 1)),
    )
    group = tuple(int(c) for c in seen)
    rows = model_jacobian(
        model, group, CameraMotionEstimate(matrices, np.eye(4)), views, np.zeros((1, len(model.zero)))
    )
    rows = rows.reshape(2 * count, parameters_of(model))
    widened: FloatArray = covariance + rows @ model.covariance.covariance @ rows.T
    return widened
