"""Fit of one moved camera, or of a rig of cameras, to the images of known points: the kind of motion, new camera
matrices, inliers, covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.least_squares import Limits, minimise
from stereoservo.calibration.relocalization.camera_resection import (
    Correspondences,
    FreeMatrix,
    MatrixChange,
    RigidMotion,
    fit_with_outliers,
    matrix_fit,
    predicted,
)
from stereoservo.calibration.relocalization.moved_camera_covariance import (
    CameraErrors,
    inherited_errors,
    model_jacobian,
    parameters_of,
    static_roots,
)
from stereoservo.calibration.relocalization.relocalization_words import (
    How,
    OutlierObservation,
    not_explained,
    points_coplanar,
    too_few,
)
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.geometry.distortion import undistort
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.moved_cameras import resect_moved_camera
from stereoservo.geometry.strata import projective_to_affine
from stereoservo.kinematics.composition import displacement_basis
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import BoolArray, FloatArray

OUTLIER_CHI2 = 25.0
"""Squared distance [sigmas²] of a pixel, two degrees of freedom, above which it is left out: as in a calibration."""
MAX_OUTLIERS = 0.4
"""Share of the pixels that may be left out."""
TAIL = 1e-4
"""Chance that residuals as stated are refused."""
MAX_SIGMA_FACTOR = 1.5
"""How many times the residuals of the calibration these may be: a camera alone is fitted here, to a known arm."""
SPARE = 2
"""Equations that must be left over: what exactly fits proves nothing."""
RESECTION_POINTS, RIG_POINTS = 6, 5
ROUNDS, WEIGHED = 6, 2
"""Times that outliers are told, and that pixels are weighted by what the matrices make of the model's covariance."""
SETTLED = 1e-4
"""Length of a step [standard deviations] at which the least squares have converged."""
FAR_PX = 1e6
"""Error of a point that is predicted behind its camera."""


@dataclass(frozen=True, eq=False)
class CameraGroup:
    """Cameras that were fitted together: new ``matrices`` (c, 3, 4), ``P D`` with ``motion`` D (4, 4) and the
    model's P where they were displaced rigidly, and the inliers among ``views``.
    """

    cameras: tuple[int, ...]
    matrices: FloatArray
    motion: FloatArray | None
    how: How
    views: Correspondences
    chi2: float
    degrees_of_freedom: int
    errors: CameraErrors
    outliers: tuple[OutlierObservation, ...]
    notes: tuple[str, ...]


def relocalize_group(
    model: CellModel, views: Correspondences, offsets: FloatArray, group: tuple[int, ...], rig: bool
) -> CameraGroup:
    """Fit the cameras ``group`` to their ``views``, as one rigid ``rig`` or each free; ``offsets`` (s, n) of the
    joints.

    Raises CalibrationError: ``too_few_points``, ``points_coplanar``, ``not_explained``.
    """
    names = [model.cameras[c].name for c in group]
    if not len(views.camera):
        raise too_few(names, 0, 0, 4, "more equations than parameters")
    cameras = [model.cameras[c] for c in group]
    lenses = np.array([camera.lens for camera in cameras])
    views = _renumbered(views, group)
    start = facing(np.array([camera.matrix for camera in cameras]), views)
    attempts: list[tuple[MatrixChange, How]] = []
    if model.stratum == "metric":
        assert model.projective_to_euclidean is not None
        twists = displacement_basis(model.projective_to_euclidean, views.points)
        attempts.append((RigidMotion(twists), "moved_with_rig" if rig else "moved"))
        if not rig:
            attempts.append((FreeMatrix(), "moved_and_refocused"))
    elif rig:
        attempts.append((RigidMotion(_algebra(model)), "moved_with_rig"))
    else:
        attempts.append((FreeMatrix(), "resected"))
    fits: list[CameraGroup] = []
    refused: CalibrationError | None = None
    for k, (family, how) in enumerate(attempts):
        try:
            fits.append(_attempt(model, views, offsets, group, family, how, start, lenses))
        except CalibrationError as error:
            if k == 0 and error.code != "not_explained":
                raise
            refused = refused or error
    if not fits:
        assert refused is not None
        raise refused
    best = fits[0] if len(fits) == 1 or not _refocused(fits[0], fits[1], _noise(model)) else fits[1]
    limit = float(chi2_distribution.isf(TAIL, best.degrees_of_freedom) * _noise(model))
    if best.chi2 <= max(limit, MAX_SIGMA_FACTOR**2 * _noise(model) * best.degrees_of_freedom):
        return best
    wrong = tuple(outlier.id for outlier in best.outliers)
    share = sum(outlier.poses for outlier in best.outliers) / len(views.camera)
    raise not_explained(names, best.chi2, limit, best.degrees_of_freedom, wrong, share, MAX_OUTLIERS)


def _refocused(displaced: CameraGroup, free: CameraGroup, noise: float) -> bool:
    """Whether free matrices fit significantly better than a displacement: by likelihood ratio where both keep the
    same pixels, else by chi-square alone.
    """
    if len(displaced.views.camera) == len(free.views.camera):
        gain, freedom = displaced.chi2 - free.chi2, displaced.degrees_of_freedom - free.degrees_of_freedom
        larger = max(noise, free.chi2 / free.degrees_of_freedom)
        return bool(gain > chi2_distribution.isf(TAIL, freedom) * larger)
    passes = [
        one.chi2 <= chi2_distribution.isf(TAIL, one.degrees_of_freedom) * noise for one in (displaced, free)
    ]
    return passes == [False, True]


def _renumbered(views: Correspondences, group: tuple[int, ...]) -> Correspondences:
    """The views with cameras numbered as in ``group``."""
    camera = np.array([group.index(int(c)) for c in views.camera], dtype=np.int64)
    return replace(views, camera=camera)


def facing(matrices: FloatArray, views: Correspondences) -> FloatArray:
    """Matrices (c, 3, 4) with the sign that puts the points in front of their cameras."""
    depths = np.einsum("kj,kj->k", matrices[views.camera, 2], views.points)
    signs = [
        -1.0 if (views.camera == c).any() and np.median(depths[views.camera == c]) < 0.0 else 1.0
        for c in range(len(matrices))
    ]
    return np.asarray(matrices * np.array(signs)[:, None, None])


def _scaled_like(one: CameraGroup, old: FloatArray, ahead: FloatArray) -> CameraGroup:
    """The group with the scales and signs of the matrices ``old`` (c, 3, 4); those ``ahead`` have the points in
    front.

    They mean nothing in the images, but what is compared with a matrix of before need not know that.
    """
    sides = np.sign(np.einsum("cij,cij->c", old, ahead))
    factors = sides * np.linalg.norm(old, axis=(1, 2)) / np.linalg.norm(one.matrices, axis=(1, 2))
    rows = np.repeat(factors, 12)
    errors = CameraErrors(
        one.errors.cameras,
        one.errors.model_jacobian * rows[:, None],
        one.errors.covariance * rows[:, None] * rows[None, :],
    )
    return replace(one, matrices=one.matrices * factors[:, None, None], errors=errors)


def _algebra(model: CellModel) -> FloatArray:
    """Basis (a, 4, 4) of the changes of frame that leave the stratum invariant, without the scale: affine 12,
    projective 15.
    """
    if model.stratum == "affine":
        frame = projective_to_affine(model.plane_at_infinity)
        return np.asarray(np.linalg.inv(frame) @ np.eye(16).reshape(16, 4, 4)[:12] @ frame)
    basis = np.eye(16).reshape(16, 4, 4)[:15].copy()
    for k in (0, 5, 10):
        basis[k, 3, 3] = -1.0
    return basis


def _attempt(
    model: CellModel,
    views: Correspondences,
    offsets: FloatArray,
    group: tuple[int, ...],
    family: MatrixChange,
    how: How,
    start: FloatArray,
    lenses: FloatArray,
) -> CameraGroup:
    """Fit of one class of motion: robust, then least squares in the full covariance of pixels and model."""
    _refuse_few(model, views, group, family, how)
    starts = [start]
    if isinstance(family, FreeMatrix):
        starts += _resected(views, lenses)
    matrices, loss = fit_with_outliers(family, starts, lenses, views)
    if not np.isfinite(loss):
        _refuse_outliers(model, views, group, np.zeros(len(views.camera), dtype=bool))
    keep = np.ones(len(views.camera), dtype=bool)
    for _ in range(ROUNDS):
        motion = _motion(model, start, matrices, family)
        again = _inliers(model, group, matrices, motion, lenses, views, offsets)
        _refuse_outliers(model, views, group, again)
        inside = views.select(again)
        _refuse_few(model, inside, group, family, how)
        solved = _least_squares(model, group, family, start, matrices, lenses, inside, offsets)
        settled = bool(np.array_equal(again, keep))
        matrices, keep = solved.matrices, again
        if settled:
            break
    outliers = _outliers(model, group, solved.matrices, lenses, views, keep)
    return _scaled_like(
        replace(solved, how=how, outliers=outliers),
        np.array([model.cameras[c].matrix for c in group]),
        start,
    )


def _motion(model: CellModel, old: FloatArray, new: FloatArray, family: MatrixChange) -> FloatArray | None:
    """Displacement D (4, 4) with ``new = old D`` (c, 3, 4), from the matrices; None for free ones."""
    if not isinstance(family, RigidMotion):
        return None
    if len(old) > 1:
        rows, right = old.reshape(-1, 4), new.reshape(-1, 4)
        return np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0])
    assert model.projective_to_euclidean is not None
    H = model.projective_to_euclidean
    back = np.linalg.inv(H)
    before, after = old[0] @ back, new[0] @ back
    D = np.eye(4)
    D[:3] = np.linalg.solve(before[:, :3], np.column_stack([after[:, :3], after[:, 3] - before[:, 3]]))
    return np.asarray(back @ D @ H)


def _inliers(
    model: CellModel,
    group: tuple[int, ...],
    matrices: FloatArray,
    motion: FloatArray | None,
    lenses: FloatArray,
    views: Correspondences,
    offsets: FloatArray,
) -> BoolArray:
    """Mask (k,) of pixels that fit, by their own and the model's covariance; ids with mostly outliers are outliers
    throughout.
    """
    covariances = views.covariances.copy()
    static = static_roots(model, matrices, lenses, views)
    covariances += static @ static.transpose(0, 2, 1)
    if model.covariance is not None:
        rows = model_jacobian(model, group, matrices, motion, views, offsets)
        covariances += np.einsum("kip,pq,kjq->kij", rows, model.covariance.covariance, rows, optimize=True)
    error = predicted(matrices, lenses, views) - views.pixels
    error = np.where(np.isfinite(error), error, FAR_PX)
    squares = np.einsum("ki,ki->k", error, np.linalg.solve(covariances, error[..., None])[..., 0])
    factor = max(1.0, float(np.median(squares)) / np.log(4.0))
    keep = squares <= OUTLIER_CHI2 * factor
    for camera in np.unique(views.camera):
        for marker in np.unique(views.ids):
            same = (views.camera == camera) & (views.ids == marker)
            if same.any() and keep[same].mean() < 0.5:
                keep[same] = False
    return np.asarray(keep)


def _least_squares(
    model: CellModel,
    group: tuple[int, ...],
    family: MatrixChange,
    start: FloatArray,
    matrices: FloatArray,
    lenses: FloatArray,
    views: Correspondences,
    offsets: FloatArray,
) -> CameraGroup:
    """Least squares in the joint covariance of all pixels, with that of the model and of static points."""
    k, p = len(views.camera), parameters_of(model)
    sigma = np.zeros((0, 0)) if model.covariance is None else model.covariance.covariance
    names = [model.cameras[c].name for c in group]
    for _ in range(WEIGHED):
        motion = _motion(model, start, matrices, family)
        F = model_jacobian(model, group, matrices, motion, views, offsets).reshape(2 * k, p)
        static = static_roots(model, matrices, lenses, views).reshape(2 * k, -1)
        noise = static @ static.T
        for i in range(k):
            noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += views.covariances[i]
        white = np.linalg.inv(np.linalg.cholesky(noise + F @ sigma @ F.T))
        fit = matrix_fit(family, lenses, views, _jointly(white))
        found = minimise(fit, matrices, Limits(settled=SETTLED**2))
        if not np.isfinite(found.cost):
            wrong = tuple(int(i) for i in np.unique(views.ids))
            raise not_explained(names, np.inf, np.inf, 0, wrong, 1.0, MAX_OUTLIERS)
        matrices = found.state
        determined = fit.determined(matrices)
        if determined.rank < family.size:
            raise points_coplanar(names, k, len(np.unique(views.ids)))
    gain = determined.root @ determined.root.T @ fit.rows(matrices)[:, :-1].T @ white
    entries = family.directions(matrices).transpose(0, 2, 3, 1).reshape(12 * len(group), family.size)
    motion = _motion(model, start, matrices, family)
    own = entries @ gain
    # Where the residuals are larger than stated, so was the noise.
    errors = CameraErrors(
        group,
        inherited_errors(model, group, motion) - own @ F,
        max(1.0, determined.variance) * own @ noise @ own.T,
    )
    return CameraGroup(
        group, matrices, motion, "moved", views, determined.cost, determined.freedom, errors, (), ()
    )


def _jointly(white: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Whitening of rows (k, 2, q) by the inverse root (2 k, 2 k) of the covariance of all pixels together."""
    return lambda rows: (white @ rows.reshape(len(white), -1)).reshape(rows.shape)


def _resected(views: Correspondences, lenses: FloatArray) -> list[FloatArray]:
    """The matrix of a camera by linear resection and refinement, where the points determine it."""
    ideal = undistort(lenses[0], views.pixels)
    sigma = float(np.sqrt(np.median(np.trace(views.covariances, axis1=1, axis2=2)) / 2.0))
    try:
        return [resect_moved_camera(views.points, ideal, sigma).P[None]]
    except GeometryError:
        return []  # it may still be near the matrix that the camera had; least squares show if it is determined


def _outliers(
    model: CellModel,
    group: tuple[int, ...],
    matrices: FloatArray,
    lenses: FloatArray,
    views: Correspondences,
    keep: BoolArray,
) -> tuple[OutlierObservation, ...]:
    error = np.linalg.norm(predicted(matrices, lenses, views) - views.pixels, axis=1)
    found = []
    for i, c in enumerate(group):
        for marker in np.unique(views.ids):
            same = (views.camera == i) & (views.ids == marker)
            out = same & ~keep
            if out.any():
                rms = float(np.sqrt((error[out] ** 2).mean()))
                found.append(
                    OutlierObservation(
                        model.cameras[c].name, int(marker), int(out.sum()), int(same.sum()), rms
                    )
                )
    return tuple(found)


def _noise(model: CellModel) -> float:
    """Variance of the calibration's residuals over the stated one, at least 1."""
    statistics = model.statistics
    if statistics is None or statistics.degrees_of_freedom <= 0:
        return 1.0
    return max(1.0, statistics.chi2 / statistics.degrees_of_freedom)


def _refuse_few(
    model: CellModel, views: Correspondences, group: tuple[int, ...], family: MatrixChange, how: How
) -> None:
    """Raise CalibrationError where the pixels are too few for the parameters."""
    count, ids = len(views.camera), len(np.unique(views.ids))
    needed, what = -(-(family.size + SPARE) // 2), "more equations than parameters"
    if how == "resected":
        needed, what = max(needed, RESECTION_POINTS), "a camera in a frame that is not metric"
    points = len({(int(i), int(pose)) for i, pose in zip(views.ids, views.pose, strict=True)})
    if how == "moved_with_rig" and model.stratum == "projective" and points < RIG_POINTS:
        raise too_few([model.cameras[c].name for c in group], points, ids, RIG_POINTS, "a projective frame")
    if count < needed:
        raise too_few([model.cameras[c].name for c in group], count, ids, needed, what)


def _refuse_outliers(
    model: CellModel, views: Correspondences, group: tuple[int, ...], keep: BoolArray
) -> None:
    share = float((~keep).mean())
    if share > MAX_OUTLIERS:
        wrong = tuple(int(i) for i in np.unique(views.ids[~keep]))
        raise not_explained(
            [model.cameras[c].name for c in group], np.inf, np.inf, 0, wrong, share, MAX_OUTLIERS
        )
