"""A model of a cell whose cameras have moved, without calibrating the arm again.

What the model knows of the arm and of points that stand is a rigid structure in its projective frame: at rest poses
the joints tell where the arm's markers are. A moved camera is resected in that frame (2.19-2.21), in the metric stratum
as a displacement of the camera it was, ``P' = P D``: its intrinsics stay. Frame, arm and lenses stay as they are; the
covariance of the model goes over to the new matrices.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.stats import chi2 as chi2_distribution

from stereoservo.geometry.distortion import undistort
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.moved_cameras import resect_moved_camera
from stereoservo.geometry.strata import projective_to_affine
from stereoservo.kinematics.calibration.camera_fit import (
    Family,
    Freely,
    Together,
    Views,
    by_parameters,
    fit_with_outliers,
    predicted,
)
from stereoservo.kinematics.calibration.model_rig import acting_order
from stereoservo.kinematics.calibration.reanchored_covariance import (
    CameraErrors,
    by_model,
    inherited,
    parameters_of,
    predicted_deviation,
    static_roots,
    with_moved_cameras,
)
from stereoservo.kinematics.calibration.reanchoring_report import (
    How,
    MovedCamera,
    OutlierSight,
    coplanar,
    described,
    not_explained,
    too_few,
    too_uncertain,
)
from stereoservo.kinematics.calibration.rig import Rig, displacements
from stereoservo.kinematics.calibration.trials import CalibrationError
from stereoservo.kinematics.displacement_basis import displacement_basis
from stereoservo.kinematics.model import CellModel

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

LIMIT_PX = 1.0
"""Largest standard deviation of a marker's predicted pixel, over the range of the joints, that is taken by default."""
OUTLIER_CHI2 = 25.0
"""Squared distance [sigmas²] of a pixel, two degrees of freedom, above which it is left out: as in a calibration."""
MAX_OUTLIERS = 0.4
"""Share of the pixels that may be left out."""
TAIL = 1e-4
"""Chance that residuals as stated are refused."""
MAX_SIGMA_FACTOR = 3.0
"""How many times the stated sigmas the residuals may be, as in a calibration."""
SPARE = 2
"""Equations that must be left over: what exactly fits proves nothing."""
RESECTION_POINTS, RIG_POINTS = 6, 5
ROUNDS, GAUSS_NEWTON = 6, 12
SETTLED = 1e-4
"""Length of a step [standard deviations] at which the least squares have converged."""
RANK = 1e-9
"""Least pivot of the weighted equations, columns of length 1, below which a direction is open."""
WORKSPACE = 40
"""Random joint positions at which predictions are asked for."""


class Sight(Protocol):
    """What one camera saw at rest: `stereoservo.runtime.cycle.Sample` is one.

    ``ids`` (k,), raw ``pixels`` (k, 2) and ``covariances`` (k, 2, 2) of the mean [px²].
    """

    @property
    def camera(self) -> str:
        """Name of the camera."""

    @property
    def ids(self) -> IntArray:
        """Markers of the arm and static points alike; ids that the model does not know are left out."""

    @property
    def pixels(self) -> FloatArray:
        """Means of raw pixels."""

    @property
    def covariances(self) -> FloatArray:
        """Covariances of these means."""


@dataclass(frozen=True, eq=False)
class RestPose:
    """The arm at rest: its ``joints`` (n,) [rad or m], and what the cameras saw meanwhile."""

    joints: FloatArray
    sights: tuple[Sight, ...]


@dataclass(frozen=True, eq=False)
class Sights:
    """Everything that was seen at rest since the cameras moved; more poses of the arm are a larger structure."""

    poses: tuple[RestPose, ...]


@dataclass(frozen=True, eq=False)
class Reanchored:
    """A re-anchored ``model``, what moved, how well it fits and how well it is known.

    ``predicted_px``: largest standard deviation, an axis, of a marker's predicted pixel in the moved cameras, over the
    range of the joints, where the camera sees it; the model's own uncertainty included where it states one.
    """

    model: CellModel
    cameras: dict[str, MovedCamera]
    chi2: float
    degrees_of_freedom: int
    predicted_px: float
    outliers: tuple[OutlierSight, ...] = ()
    notes: tuple[str, ...] = field(default=())


def reanchor(
    model: CellModel,
    sights: Sights,
    moved: tuple[str, ...],
    *,
    rigid_rig: bool = False,
    epoch: int,
    created: str = "",
    limit_px: float = LIMIT_PX,
    workspace: FloatArray | None = None,
) -> Reanchored:
    """The model with new matrices of the cameras ``moved``, in the same frame.

    ``rigid_rig``: they moved as one body. ``workspace`` (w, n): joint positions at which predictions must hold, default
    the range of the calibration's trials. Raises CalibrationError: ``bad_data``, ``too_few_points``,
    ``points_coplanar``, ``not_explained``, ``too_uncertain``.
    """
    which = _indices(model, moved)
    everything = _views(model, sights, which)
    offsets = np.array([pose.joints for pose in sights.poses]).reshape(-1, len(model.zero)) - model.zero
    groups = [which] if rigid_rig and len(which) > 1 else [(c,) for c in which]
    found: list[_Group] = []
    for group in groups:
        mine = np.isin(everything.camera, group)
        rig = rigid_rig and len(group) > 1
        found.append(_reanchored_group(model, everything.select(mine), offsets, group, rig))
    matrices = {c: one.matrices[k] for one in found for k, c in enumerate(one.cameras)}
    cameras = tuple(
        msgspec.structs.replace(camera, matrix=matrices[c]) if c in matrices else camera
        for c, camera in enumerate(model.cameras)
    )
    new = msgspec.structs.replace(model, epoch=epoch, created=created, cameras=cameras)
    errors = [one.errors for one in found]
    new = msgspec.structs.replace(new, covariance=with_moved_cameras(model, errors, matrices))
    joints = _workspace(model, sights, workspace)
    predicted_px = predicted_deviation(new, errors, joints, _arm_points(new, joints))
    if not predicted_px <= limit_px:
        raise too_uncertain(list(moved), predicted_px, limit_px, len(sights.poses))
    return Reanchored(
        new,
        {model.cameras[c].name: _told(model, one, k) for one in found for k, c in enumerate(one.cameras)},
        sum(one.chi2 for one in found),
        sum(one.degrees_of_freedom for one in found),
        predicted_px,
        tuple(outlier for one in found for outlier in one.outliers),
        tuple(note for one in found for note in one.notes),
    )


@dataclass(frozen=True, eq=False)
class _Group:
    """Cameras that were fitted together: their new ``matrices`` (c, 3, 4), which inherit from the model's as P D by
    ``motion`` D (4, 4) where they were displaced, and the inliers among ``views``.
    """

    cameras: tuple[int, ...]
    matrices: FloatArray
    motion: FloatArray | None
    how: How
    views: Views
    chi2: float
    degrees_of_freedom: int
    errors: CameraErrors
    outliers: tuple[OutlierSight, ...]
    notes: tuple[str, ...]


def _indices(model: CellModel, moved: tuple[str, ...]) -> tuple[int, ...]:
    names = [camera.name for camera in model.cameras]
    wrong = [name for name in moved if name not in names]
    if wrong or not moved or len(set(moved)) < len(moved):
        raise CalibrationError(
            "bad_data",
            f"cameras {', '.join(moved) or 'none'} are said to have moved; the model has {', '.join(names)}, each "
            "may be named once",
            cameras=list(moved),
        )
    return tuple(names.index(name) for name in moved)


def _views(model: CellModel, sights: Sights, which: tuple[int, ...]) -> Views:
    """What the moved cameras saw of points that the model knows; static points are averaged over the poses."""
    names = {model.cameras[c].name: c for c in which}
    n = len(model.joint_names)
    for k, pose in enumerate(sights.poses):
        if pose.joints.shape != (n,) or not np.isfinite(pose.joints).all():
            raise CalibrationError(
                "bad_data", f"pose {k} has joints {pose.joints.tolist()}; {n} finite ones are needed", pose=k
            )
    where = _arm_points(model, np.array([pose.joints for pose in sights.poses]).reshape(-1, n))
    index = {marker: i for i, marker in enumerate(model.marker_ids)}
    static = {marker: i for i, marker in enumerate(model.scene_ids)}
    rows: list[tuple[int, int, int, FloatArray, FloatArray, FloatArray]] = []
    for k, pose in enumerate(sights.poses):
        for sight in pose.sights:
            if sight.camera not in names:
                continue
            for marker, pixel, covariance in zip(sight.ids, sight.pixels, sight.covariances, strict=True):
                if not (np.isfinite(pixel).all() and np.isfinite(covariance).all()):
                    continue
                if int(marker) in index:
                    point, stands = where[k, index[int(marker)]], k
                elif int(marker) in static:
                    point, stands = model.scene_points[static[int(marker)]], -1
                else:
                    continue
                rows.append((names[sight.camera], int(marker), stands, point, pixel, covariance))
    return _averaged(rows)


def _averaged(rows: list[tuple[int, int, int, FloatArray, FloatArray, FloatArray]]) -> Views:
    """One row for each static point and camera: of several poses the mean, with the covariance of the best."""
    kept = [row for row in rows if row[2] >= 0]
    standing: dict[tuple[int, int], list[tuple[int, int, int, FloatArray, FloatArray, FloatArray]]] = {}
    for row in rows:
        if row[2] < 0:
            standing.setdefault((row[0], row[1]), []).append(row)
    for same in standing.values():
        pixel = np.median([row[4] for row in same], axis=0)
        least = min((row[5] for row in same), key=lambda covariance: float(np.trace(covariance)))
        kept.append((*same[0][:4], pixel, least))
    return Views(
        np.array([row[0] for row in kept], dtype=np.int64),
        np.array([row[1] for row in kept], dtype=np.int64),
        np.array([row[2] for row in kept], dtype=np.int64),
        np.array([row[3] for row in kept], dtype=np.float64).reshape(-1, 4),
        np.array([row[4] for row in kept], dtype=np.float64).reshape(-1, 2),
        np.array([row[5] for row in kept], dtype=np.float64).reshape(-1, 2, 2),
    )


def _arm_points(model: CellModel, joints: FloatArray) -> FloatArray:
    """The markers (s, m, 4) at joints (s, n)."""
    order = list(acting_order(model))
    rig = Rig(
        tuple(model.joint_kinds[j] for j in order),
        model.generators[order],
        np.array([camera.matrix for camera in model.cameras]),
        model.marker_points,
    )
    found: FloatArray = model.marker_points @ displacements(rig, (joints - model.zero)[:, order]).transpose(
        0, 2, 1
    )
    return found


def _reanchored_group(
    model: CellModel, views: Views, offsets: FloatArray, group: tuple[int, ...], rig: bool
) -> _Group:
    names = [model.cameras[c].name for c in group]
    cameras = [model.cameras[c] for c in group]
    lenses = np.array([camera.lens for camera in cameras])
    views = _renumbered(views, group)
    start = _facing(np.array([camera.matrix for camera in cameras]), views)
    attempts: list[tuple[Family, How]] = []
    if model.stratum == "metric":
        assert model.projective_to_euclidean is not None
        twists = displacement_basis(model.projective_to_euclidean, views.points)
        attempts.append((Together(twists), "moved_with_rig" if rig else "moved"))
        if not rig:
            attempts.append((Freely(), "moved_and_refocused"))
    elif rig:
        attempts.append((Together(_algebra(model)), "moved_with_rig"))
    else:
        attempts.append((Freely(), "resected"))
    tried: list[_Group | CalibrationError] = []
    for family, how in attempts:
        try:
            one = _attempt(model, views, offsets, group, family, how, start, lenses)
        except CalibrationError as error:
            tried.append(error)
            if error.code != "not_explained":
                break
            continue
        if one.chi2 <= chi2_distribution.isf(TAIL, one.degrees_of_freedom) * _noise(model):
            return one
        tried.append(one)
    fits = [one for one in tried if isinstance(one, _Group)]
    passable = [one for one in fits if one.chi2 <= MAX_SIGMA_FACTOR**2 * one.degrees_of_freedom]
    if passable:
        return passable[0]
    errors = [one for one in tried if isinstance(one, CalibrationError)]
    if errors and not fits:
        raise errors[0]
    best = min(fits, key=lambda one: one.chi2 / one.degrees_of_freedom)
    limit = float(chi2_distribution.isf(TAIL, best.degrees_of_freedom) * _noise(model))
    wrong = tuple(outlier.id for outlier in best.outliers)
    share = sum(outlier.poses for outlier in best.outliers) / len(views.camera)
    raise not_explained(names, best.chi2, limit, best.degrees_of_freedom, wrong, share, MAX_OUTLIERS)


def _renumbered(views: Views, group: tuple[int, ...]) -> Views:
    """The views with cameras numbered as in ``group``."""
    camera = np.array([group.index(int(c)) for c in views.camera], dtype=np.int64)
    return replace(views, camera=camera)


def _facing(matrices: FloatArray, views: Views) -> FloatArray:
    """Matrices (c, 3, 4) with the sign that puts the points before their cameras."""
    depths = np.einsum("kj,kj->k", matrices[views.camera, 2], views.points)
    signs = [
        -1.0 if (views.camera == c).any() and np.median(depths[views.camera == c]) < 0.0 else 1.0
        for c in range(len(matrices))
    ]
    return np.asarray(matrices * np.array(signs)[:, None, None])


def _scaled_like(one: _Group, old: FloatArray, facing: FloatArray) -> _Group:
    """The group with the scales and signs of the matrices ``old`` (c, 3, 4); those ``facing`` have points ahead.

    They mean nothing in the images, but what is compared with a matrix of before need not know that.
    """
    sides = np.sign(np.einsum("cij,cij->c", old, facing))
    factors = sides * np.linalg.norm(old, axis=(1, 2)) / np.linalg.norm(one.matrices, axis=(1, 2))
    rows = np.repeat(factors, 12)
    errors = CameraErrors(
        one.errors.cameras,
        one.errors.by_model * rows[:, None],
        one.errors.covariance * rows[:, None] * rows[None, :],
    )
    return replace(one, matrices=one.matrices * factors[:, None, None], errors=errors)


def _algebra(model: CellModel) -> FloatArray:
    """Changes of frame (a, 4, 4) that the stratum knows, without the scale: affine 12, projective 15."""
    if model.stratum == "affine":
        frame = projective_to_affine(model.plane_at_infinity)
        return np.asarray(np.linalg.inv(frame) @ np.eye(16).reshape(16, 4, 4)[:12] @ frame)
    basis = np.eye(16).reshape(16, 4, 4)[:15].copy()
    for k in (0, 5, 10):
        basis[k, 3, 3] = -1.0
    return basis


def _attempt(
    model: CellModel,
    views: Views,
    offsets: FloatArray,
    group: tuple[int, ...],
    family: Family,
    how: How,
    start: FloatArray,
    lenses: FloatArray,
) -> _Group:
    """One family fitted: robustly, then by least squares in the full covariance of pixels and model."""
    _refuse_few(model, views, group, family, how)
    starts = [start]
    if isinstance(family, Freely):
        starts += _resected(views, lenses)
    matrices, _ = fit_with_outliers(family, starts, lenses, views)
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


def _motion(model: CellModel, old: FloatArray, new: FloatArray, family: Family) -> FloatArray | None:
    """D (4, 4) of ``new = old D`` (c, 3, 4), from the matrices themselves; None for free ones."""
    if not isinstance(family, Together):
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
    views: Views,
    offsets: FloatArray,
) -> BoolArray:
    """Which pixels (k,) fit, each in its own noise and the model's; an id whose pixels mostly do not, does not."""
    covariances = views.covariances.copy()
    static = static_roots(model, matrices, lenses, views)
    covariances += static @ static.transpose(0, 2, 1)
    if model.covariance is not None:
        rows = by_model(model, group, matrices, motion, views, offsets)
        covariances += np.einsum("kip,pq,kjq->kij", rows, model.covariance.covariance, rows, optimize=True)
    error = predicted(matrices, lenses, views) - views.pixels
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
    family: Family,
    start: FloatArray,
    matrices: FloatArray,
    lenses: FloatArray,
    views: Views,
    offsets: FloatArray,
) -> _Group:
    """Gauss and Newton in the joint covariance of all pixels, with what the model and static points add to it."""
    k = len(views.camera)
    p = parameters_of(model)
    sigma = np.zeros((0, 0)) if model.covariance is None else model.covariance.covariance
    for _ in range(GAUSS_NEWTON):
        motion = _motion(model, start, matrices, family)
        F = by_model(model, group, matrices, motion, views, offsets).reshape(2 * k, p)
        static = static_roots(model, matrices, lenses, views).reshape(2 * k, -1)
        noise = static @ static.T
        for i in range(k):
            noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += views.covariances[i]
        triangle = np.linalg.cholesky(noise + F @ sigma @ F.T)
        J = by_parameters(family, matrices, lenses, views).reshape(2 * k, family.size)
        rows = np.linalg.solve(triangle, J)
        error = np.linalg.solve(triangle, (predicted(matrices, lenses, views) - views.pixels).ravel())
        sizes = np.linalg.norm(rows, axis=0)
        q, r = np.linalg.qr(rows / sizes)
        if not float(np.abs(np.diag(r)).min()) > RANK:
            raise coplanar([model.cameras[c].name for c in group], k, len(np.unique(views.ids)))
        gain = np.asarray(np.linalg.solve(r, q.T)) / sizes[:, None]
        x = -gain @ error
        before, directions = matrices, family.directions(matrices)
        matrices = family.step(matrices, x)
        if float(np.linalg.norm(rows @ x)) < SETTLED:
            break
    gain = gain @ np.linalg.inv(triangle)
    entries = directions.transpose(0, 2, 3, 1).reshape(12 * len(group), family.size)
    chi2 = float(error @ error - (q.T @ error) @ (q.T @ error))
    # Where the residuals are larger than stated, so was the noise.
    factor = max(1.0, chi2 / (2 * k - family.size))
    own = entries @ gain
    errors = CameraErrors(
        group,
        inherited(model, group, _motion(model, start, before, family)) - own @ F,
        factor * own @ noise @ own.T,
    )
    return _Group(
        group,
        matrices,
        _motion(model, start, matrices, family),
        "moved",
        views,
        chi2,
        2 * k - family.size,
        errors,
        (),
        (),
    )


def _resected(views: Views, lenses: FloatArray) -> list[FloatArray]:
    """The matrix of a camera by linear resection and refinement, where the points determine it."""
    ideal = undistort(lenses[0], views.pixels)
    sigma = float(np.sqrt(np.median(np.trace(views.covariances, axis1=1, axis2=2)) / 2.0))
    try:
        return [resect_moved_camera(views.points, ideal, sigma).P[None]]
    except GeometryError:
        return []  # it may still be near the matrix that the camera had; the least squares say whether it is open


def _outliers(
    model: CellModel,
    group: tuple[int, ...],
    matrices: FloatArray,
    lenses: FloatArray,
    views: Views,
    keep: BoolArray,
) -> tuple[OutlierSight, ...]:
    error = np.linalg.norm(predicted(matrices, lenses, views) - views.pixels, axis=1)
    found = []
    for i, c in enumerate(group):
        for marker in np.unique(views.ids):
            same = (views.camera == i) & (views.ids == marker)
            out = same & ~keep
            if out.any():
                rms = float(np.sqrt((error[out] ** 2).mean()))
                found.append(
                    OutlierSight(model.cameras[c].name, int(marker), int(out.sum()), int(same.sum()), rms)
                )
    return tuple(found)


def _noise(model: CellModel) -> float:
    """Variance of the calibration's residuals over the stated one, at least 1."""
    statistics = model.statistics
    if statistics is None or statistics.degrees_of_freedom <= 0:
        return 1.0
    return max(1.0, statistics.chi2 / statistics.degrees_of_freedom)


def _workspace(model: CellModel, sights: Sights, given: FloatArray | None) -> FloatArray:
    """Joint positions (w, n): those of the sights, and the trials' range, one joint at a time and all at random."""
    here = np.array([pose.joints for pose in sights.poses])
    if given is not None:
        return np.asarray(np.concatenate([here, given]))
    ranges = np.ptp(here, axis=0)
    if model.statistics is not None:
        by_name = {joint.name: joint.range for joint in model.statistics.joints}
        ranges = np.array([by_name.get(name, 0.0) for name in model.joint_names])
    n = len(model.zero)
    alone = np.concatenate([np.eye(n), -np.eye(n)]) * 0.5 * ranges
    random = np.random.default_rng(0).uniform(-0.5, 0.5, (WORKSPACE, n)) * ranges
    return np.asarray(np.concatenate([here, model.zero + alone, model.zero + random]))


def _told(model: CellModel, one: _Group, k: int) -> MovedCamera:
    camera = model.cameras[one.cameras[k]]
    mine = one.views.select(one.views.camera == k)
    mine = replace(mine, camera=np.zeros_like(mine.camera))
    old, lens = _facing(camera.matrix[None], mine), camera.lens[None]
    way = predicted(_facing(one.matrices[k : k + 1], mine), lens, mine) - predicted(old, lens, mine)
    moved_px = float(np.sqrt(np.nanmean((way**2).sum(axis=1))))
    return described(model, camera.name, one.how, camera.matrix, one.matrices[k], mine.points, moved_px)


def _refuse_few(model: CellModel, views: Views, group: tuple[int, ...], family: Family, how: How) -> None:
    """Raise CalibrationError where the pixels are fewer than the parameters, and some to spare."""
    count, ids = len(views.camera), len(np.unique(views.ids))
    needed, what = -(-(family.size + SPARE) // 2), "more equations than parameters"
    if how == "resected":
        needed, what = max(needed, RESECTION_POINTS), "a camera in a frame that is not metric"
    points = len({(int(i), int(pose)) for i, pose in zip(views.ids, views.pose, strict=True)})
    if how == "moved_with_rig" and model.stratum == "projective" and points < RIG_POINTS:
        raise too_few([model.cameras[c].name for c in group], points, ids, RIG_POINTS, "a projective frame")
    if count < needed:
        raise too_few([model.cameras[c].name for c in group], count, ids, needed, what)


def _refuse_outliers(model: CellModel, views: Views, group: tuple[int, ...], keep: BoolArray) -> None:
    share = float((~keep).mean())
    if share > MAX_OUTLIERS:
        wrong = tuple(int(i) for i in np.unique(views.ids[~keep]))
        raise not_explained(
            [model.cameras[c].name for c in group], np.inf, np.inf, 0, wrong, share, MAX_OUTLIERS
        )
