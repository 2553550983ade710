"""Relocalization: new matrices of moved cameras in a cell's model, without recalibration of the arm.

Arm and static points of the model are a known rigid structure in its projective frame: at rest poses the joints
determine the positions of the arm's markers. A moved camera is resected in that frame (2.19-2.21), in the metric
stratum as a displacement of the previous camera, ``P' = P D``, with fixed intrinsics. Frame, arm and lenses are
unchanged; the covariance of the model is extended to the new matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import msgspec
import numpy as np
from scipy.linalg import rq
from scipy.stats import chi2 as chi2_distribution

from stereoservo.calibration.least_squares import minimise
from stereoservo.calibration.moved_cameras import (
    WHOLE,
    CameraErrors,
    CameraMotionEstimate,
    Correspondences,
    FreeMatrix,
    MatrixChange,
    RigidMotion,
    fit_with_outliers,
    inherited_errors,
    matrix_fit,
    model_jacobian,
    parameters_of,
    predicted,
    predicted_deviation,
    static_roots,
    with_moved_cameras,
)
from stereoservo.calibration.rig_model import acting_order, displacements, own_acting_rig
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.geometry.distortion import undistort
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.moved_cameras import resect_moved_camera
from stereoservo.geometry.strata import projective_to_affine
from stereoservo.kinematics.composition import displacement_basis
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

How = Literal["moved", "moved_and_refocused", "resected", "moved_with_rig"]
DESCRIPTIONS: dict[How, str] = {
    "moved": "moved",
    "moved_and_refocused": "moved, and its focal length or principal point changed (was the lens touched?)",
    "resected": "moved",
    "moved_with_rig": "moved together with the others",
}
REMEDY = "show more markers, move the arm to other poses, or set up static points off one plane"


@dataclass(frozen=True)
class MovedCamera:
    """Description of a camera's motion.

    ``how``: ``moved`` (a displacement), ``moved_and_refocused`` (its intrinsics have changed, too), ``resected`` (the
    stratum has no displacements), ``moved_with_rig``. ``turned_deg``: angle in its own axes; ``shifted_share``:
    displacement of its centre over its distance from the points; ``shifted_m`` if prismatic joints give the scale;
    None if the model is not metric. ``moved_px``: rms image motion of the visible points. ``text``: in words.
    """

    how: How
    turned_deg: float | None
    shifted_share: float | None
    shifted_m: float | None
    moved_px: float
    text: str


@dataclass(frozen=True)
class OutlierObservation:
    """Rejected pixels: their ``camera`` and ``id``, at how many of how many poses, and their error [px rms]."""

    camera: str
    id: int
    poses: int
    of: int
    error_px: float


def describe_moved_camera(
    model: CellModel,
    name: str,
    how: How,
    old: FloatArray,
    new: FloatArray,
    points: FloatArray,
    moved_px: float,
) -> MovedCamera:
    """Describe the motion of a camera whose matrix (3, 4) is ``new`` instead of ``old``; it sees ``points`` (k, 4)."""
    angle_deg = share = metres = None
    words = DESCRIPTIONS[how]
    if model.projective_to_euclidean is not None:
        angle_deg, share, metres = _displacement(model, model.projective_to_euclidean, old, new, points)
        far = "" if metres is None else f" ({1000.0 * metres:.3g} mm)"
        shift = f"{100.0 * share:.2g} % of its distance from the points{far}"
        words += f": turned by {angle_deg:.3g} degrees, shifted by {shift}"
    text = f"camera {name!r} {words}; its points moved by {moved_px:.3g} px rms"
    return MovedCamera(how, angle_deg, share, metres, moved_px, text)


def _displacement(
    model: CellModel, H: FloatArray, old: FloatArray, new: FloatArray, points: FloatArray
) -> tuple[float, float, float | None]:
    """Angle [deg], displacement of the centre over the distance from the points, and in [m] if a scale is known."""
    back = np.linalg.inv(H)
    rotations, centres = [], []
    for matrix in (old, new):
        P = matrix @ back
        P = P * np.sign(np.linalg.det(P[:, :3]))
        K, R = rq(P[:, :3])
        rotations.append(np.diag(np.sign(np.diag(K))) @ R)
        centres.append(-np.linalg.solve(P[:, :3], P[:, 3]))
    rotation = rotations[1] @ rotations[0].T
    sine = 0.5 * np.linalg.norm(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    angle = float(np.degrees(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0))))
    euclidean = points @ H.T
    centroid = (euclidean[:, :3] / euclidean[:, 3:]).mean(axis=0)
    distance_moved = float(np.linalg.norm(centres[1] - centres[0]))
    metre = [
        float(np.linalg.norm((H @ generator @ back)[:3, 3]))
        for generator, kind in zip(model.generators, model.joint_kinds, strict=True)
        if kind == "prismatic"
    ]
    distance = float(np.linalg.norm(centroid - centres[0]))
    return angle, distance_moved / distance, distance_moved / float(np.median(metre)) if metre else None


def too_few(names: list[str], count: int, ids: int, needed: int, what: str) -> CalibrationError:
    """Error text: too few points to determine a camera."""
    return CalibrationError(
        "too_few_points",
        f"camera {_listed(names)} sees {count} pixels of {ids} known points since it moved; at least {needed} are "
        f"needed ({what}): {REMEDY}",
        cameras=names,
        points=count,
        ids=ids,
        minimum=needed,
    )


def points_coplanar(names: list[str], count: int, ids: int) -> CalibrationError:
    """Error text: coplanar points leave a direction undetermined."""
    return CalibrationError(
        "points_coplanar",
        f"{count} pixels of {ids} points do not determine camera {_listed(names)}: the points lie in one plane, or on "
        f"a line; {REMEDY}",
        cameras=names,
        points=count,
        ids=ids,
    )


def not_explained(
    names: list[str],
    chi2: float,
    limit: float,
    freedom: int,
    outliers: tuple[int, ...],
    share: float,
    most: float,
) -> CalibrationError:
    """Error text: no motion of the cameras explains the pixels."""
    ids = f", of ids {', '.join(str(i) for i in outliers)}" if outliers else ""
    return CalibrationError(
        "not_explained",
        f"no motion of camera {_listed(names)} explains its pixels: chi-square {chi2:.4g} with {freedom} degrees of "
        f"freedom (limit {limit:.4g}), {share:.0%} of them left out as wrong (limit {most:.0%}){ids}. Did markers "
        "slip, did a joint's zero or another camera move, are ids mixed up? If so calibrate, or check, again",
        cameras=names,
        chi2=chi2,
        limit=limit,
        degrees_of_freedom=freedom,
        outliers=list(outliers),
        share=share,
        maximum=most,
    )


def too_uncertain(names: list[str], predicted_px: float, limit_px: float, poses: int) -> CalibrationError:
    """Error text: the camera is determined, but not accurately enough."""
    return CalibrationError(
        "too_uncertain",
        f"camera {_listed(names)} would predict markers to {predicted_px:.3g} px (one standard deviation) somewhere in "
        f"the range of the joints; at most {limit_px:g} px are taken. Seen at {poses} pose{'s' if poses > 1 else ''} "
        f"so far: {REMEDY}",
        cameras=names,
        predicted_px=predicted_px,
        limit_px=limit_px,
        poses=poses,
    )


def _listed(names: list[str]) -> str:
    return ", ".join(repr(name) for name in names)


OUTLIER_CHI2 = 25.0
"""Squared distance [sigmas²] of a pixel, two degrees of freedom, above which it is rejected: as in a calibration."""
MAX_OUTLIERS = 0.4
"""Largest share of rejected pixels."""
TAIL = 1e-4
"""Probability with which residuals of the stated size are refused."""
MAX_SIGMA_FACTOR = 1.5
"""Largest ratio of these residuals to the calibration's: only a camera is fitted here, to a known arm."""
SPARE = 2
"""Required number of redundant equations: an exact fit proves nothing."""
RESECTION_POINTS, RIG_POINTS = 6, 5
ROUNDS, WEIGHED = 6, 2
"""Rounds of outlier rejection, and of weighting the pixels with the model's covariance at the new matrices."""
FAR_PX = 1e6
"""Error [px] assigned to a point that is predicted behind its camera."""


@dataclass(frozen=True, eq=False)
class CameraGroup:
    """Cameras that were fitted together: new ``matrices`` (c, 3, 4), with the rigid ``motion`` D (4, 4) such that they
    are ``P D`` of the model's P, if any, and the inliers among ``views``.
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
    start = with_positive_depths(np.array([camera.matrix for camera in cameras]), views)
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
    """Whether free matrices fit significantly better than a displacement: by likelihood ratio if both keep the
    same pixels, else by chi-square alone.
    """
    if len(displaced.views.camera) == len(free.views.camera):
        gain, freedom = displaced.chi2 - free.chi2, displaced.degrees_of_freedom - free.degrees_of_freedom
        larger = max(noise, free.chi2 / free.degrees_of_freedom)
        return bool(gain > chi2_distribution.isf(TAIL, freedom) * larger)
    passes = [one.chi2 <= chi2_distribution.isf(TAIL, one.degrees_of_freedom) * noise for one in (displaced, free)]
    return passes == [False, True]


def _renumbered(views: Correspondences, group: tuple[int, ...]) -> Correspondences:
    """The views with cameras numbered as in ``group``."""
    camera = np.array([group.index(int(c)) for c in views.camera], dtype=np.int64)
    return replace(views, camera=camera)


def with_positive_depths(matrices: FloatArray, views: Correspondences) -> FloatArray:
    """Matrices (c, 3, 4) with the sign that puts the points in front of their cameras."""
    depths = np.einsum("kj,kj->k", matrices[views.camera, 2], views.points)
    signs = [
        -1.0 if (views.camera == c).any() and np.median(depths[views.camera == c]) < 0.0 else 1.0
        for c in range(len(matrices))
    ]
    return np.asarray(matrices * np.array(signs)[:, None, None])


def _scaled_like(one: CameraGroup, old: FloatArray, ahead: FloatArray) -> CameraGroup:
    """The group with the scales and signs of the matrices ``old`` (c, 3, 4); the matrices ``ahead`` have the points
    in front.

    Scale and sign do not change the images, but make old and new matrices comparable.
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
    free = isinstance(family, FreeMatrix)
    starts = [CameraMotionEstimate(start, None if free else np.eye(4))]
    if free:
        starts += _resected(views, lenses)
    found = fit_with_outliers(family, starts, lenses, views)
    if not np.isfinite(found.cost):
        _refuse_outliers(model, views, group, np.zeros(len(views.camera), dtype=bool))
    moved, keep = found.state, np.ones(len(views.camera), dtype=bool)
    for _ in range(ROUNDS):
        again = _inliers(model, group, moved, lenses, views, offsets)
        _refuse_outliers(model, views, group, again)
        inside = views.select(again)
        _refuse_few(model, inside, group, family, how)
        solved = _least_squares(model, group, family, moved, lenses, inside, offsets)
        settled = bool(np.array_equal(again, keep))
        moved, keep = CameraMotionEstimate(solved.matrices, solved.motion), again
        if settled:
            break
    outliers = _outliers(model, group, solved.matrices, lenses, views, keep)
    return _scaled_like(
        replace(solved, how=how, outliers=outliers),
        np.array([model.cameras[c].matrix for c in group]),
        start,
    )


def _inliers(
    model: CellModel,
    group: tuple[int, ...],
    moved: CameraMotionEstimate,
    lenses: FloatArray,
    views: Correspondences,
    offsets: FloatArray,
) -> BoolArray:
    """Mask (k,) of pixels that fit, by their own and the model's covariance; all pixels of an id with mostly outliers
    are rejected.
    """
    covariances = views.covariances.copy()
    static = static_roots(model, moved.matrices, lenses, views)
    covariances += static @ static.transpose(0, 2, 1)
    if model.covariance is not None:
        rows = model_jacobian(model, group, moved, views, offsets)
        covariances += np.einsum("kip,pq,kjq->kij", rows, model.covariance.covariance, rows, optimize=True)
    error = predicted(moved.matrices, lenses, views) - views.pixels
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
    moved: CameraMotionEstimate,
    lenses: FloatArray,
    views: Correspondences,
    offsets: FloatArray,
) -> CameraGroup:
    """Least squares in the joint covariance of all pixels, with that of the model and of static points."""
    k, p = len(views.camera), parameters_of(model)
    sigma = np.zeros((0, 0)) if model.covariance is None else model.covariance.covariance
    names = [model.cameras[c].name for c in group]
    for _ in range(WEIGHED):
        F = model_jacobian(model, group, moved, views, offsets).reshape(2 * k, p)
        static = static_roots(model, moved.matrices, lenses, views).reshape(2 * k, -1)
        noise = static @ static.T
        for i in range(k):
            noise[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += views.covariances[i]
        white = np.linalg.inv(np.linalg.cholesky(noise + F @ sigma @ F.T))
        fit = matrix_fit(family, lenses, views, _joint_whitening(white))
        found = minimise(fit, moved, WHOLE)
        if not np.isfinite(found.cost):
            wrong = tuple(int(i) for i in np.unique(views.ids))
            raise not_explained(names, np.inf, np.inf, 0, wrong, 1.0, MAX_OUTLIERS)
        moved = found.state
        determined = fit.statistics(moved)
        if determined.rank < family.size:
            raise points_coplanar(names, k, len(np.unique(views.ids)))
    gain = determined.root @ determined.root.T @ fit.rows(moved)[:, :-1].T @ white
    entries = family.directions(moved.matrices).transpose(0, 2, 3, 1).reshape(12 * len(group), family.size)
    own = entries @ gain
    # Residuals larger than stated indicate that the noise was, too.
    errors = CameraErrors(
        group,
        inherited_errors(model, group, moved.motion) - own @ F,
        max(1.0, determined.variance) * own @ noise @ own.T,
    )
    return CameraGroup(
        group,
        moved.matrices,
        moved.motion,
        "moved",
        views,
        determined.cost,
        determined.freedom,
        errors,
        (),
        (),
    )


def _joint_whitening(white: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Whitening of rows (k, 2, q) by the inverse root (2 k, 2 k) of the covariance of all pixels together."""
    return lambda rows: (white @ rows.reshape(len(white), -1)).reshape(rows.shape)


def _resected(views: Correspondences, lenses: FloatArray) -> list[CameraMotionEstimate]:
    """The matrix of a camera by linear resection and refinement, if the points determine it; else empty."""
    ideal = undistort(lenses[0], views.pixels)
    sigma = float(np.sqrt(np.median(np.trace(views.covariances, axis1=1, axis2=2)) / 2.0))
    try:
        return [CameraMotionEstimate(resect_moved_camera(views.points, ideal, sigma).P[None], None)]
    except GeometryError:
        return []  # the previous matrix may still be near; least squares show whether it is determined


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
                    OutlierObservation(model.cameras[c].name, int(marker), int(out.sum()), int(same.sum()), rms)
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
    """Raise CalibrationError if the pixels are too few for the parameters."""
    count, ids = len(views.camera), len(np.unique(views.ids))
    needed, what = -(-(family.size + SPARE) // 2), "more equations than parameters"
    if how == "resected":
        needed, what = max(needed, RESECTION_POINTS), "a camera in a frame that is not metric"
    points = len({(int(i), int(pose)) for i, pose in zip(views.ids, views.pose, strict=True)})
    if how == "moved_with_rig" and model.stratum == "projective" and points < RIG_POINTS:
        raise too_few([model.cameras[c].name for c in group], points, ids, RIG_POINTS, "a projective frame")
    if count < needed:
        raise too_few([model.cameras[c].name for c in group], count, ids, needed, what)


def _refuse_outliers(model: CellModel, views: Correspondences, group: tuple[int, ...], keep: BoolArray) -> None:
    share = float((~keep).mean())
    if share > MAX_OUTLIERS:
        wrong = tuple(int(i) for i in np.unique(views.ids[~keep]))
        raise not_explained([model.cameras[c].name for c in group], np.inf, np.inf, 0, wrong, share, MAX_OUTLIERS)


LIMIT_PX = 1.0
"""Default limit of a marker's predicted standard deviation [px] over the range of the joints."""
WORKSPACE = 40
"""Number of random joint positions at which predictions are evaluated."""


class CameraSample(Protocol):
    """Protocol of one camera's observations at rest; implemented by `stereoservo.core.cycle.Sample`.

    ``ids`` (k,), raw ``pixels`` (k, 2) and ``covariances`` (k, 2, 2) of the mean [px²].
    """

    @property
    def camera(self) -> str:
        """Name of the camera."""

    @property
    def ids(self) -> IntArray:
        """Markers of the arm and static points; ids that the model does not contain are left out."""

    @property
    def pixels(self) -> FloatArray:
        """Means of raw pixels."""

    @property
    def covariances(self) -> FloatArray:
        """Covariances of these means."""


@dataclass(frozen=True, eq=False)
class RestPose:
    """The arm at rest: its ``joints`` (n,) [rad or m], and the cameras' observations meanwhile."""

    joints: FloatArray
    samples: tuple[CameraSample, ...]


@dataclass(frozen=True, eq=False)
class RestObservations:
    """All observations at rest since the cameras moved; several poses of the arm give more points."""

    poses: tuple[RestPose, ...]


@dataclass(frozen=True, eq=False)
class RelocalizedModel:
    """A relocalized ``model`` with its report: moved cameras, residuals, accuracy.

    ``predicted_px``: largest standard deviation, per axis, of a marker's predicted pixel in the moved cameras that see
    it, over the range of the joints; includes the model's own uncertainty if it states one.
    """

    model: CellModel
    cameras: dict[str, MovedCamera]
    chi2: float
    degrees_of_freedom: int
    predicted_px: float
    outliers: tuple[OutlierObservation, ...] = ()
    notes: tuple[str, ...] = field(default=())


def relocalize(
    model: CellModel,
    observations: RestObservations,
    moved: tuple[str, ...],
    *,
    rigid_rig: bool = False,
    epoch: int,
    created: str = "",
    limit_px: float = LIMIT_PX,
    workspace: FloatArray | None = None,
) -> RelocalizedModel:
    """The model with new matrices of the cameras ``moved``, in the same frame.

    ``rigid_rig``: they moved as one body. ``workspace`` (w, n): joint positions at which predictions must be accurate,
    default the range of the calibration's trials. Raises CalibrationError: ``bad_data``, ``too_few_points``,
    ``points_coplanar``, ``not_explained``, ``too_uncertain``.
    """
    which = _indices(model, moved)
    everything = _views(model, observations, which)
    offsets = np.array([pose.joints for pose in observations.poses]).reshape(-1, len(model.zero)) - model.zero
    groups = [which] if rigid_rig and len(which) > 1 else [(c,) for c in which]
    found: list[CameraGroup] = []
    for group in groups:
        mine = np.isin(everything.camera, group)
        rig = rigid_rig and len(group) > 1
        found.append(relocalize_group(model, everything.select(mine), offsets, group, rig))
    matrices = {c: one.matrices[k] for one in found for k, c in enumerate(one.cameras)}
    cameras = tuple(
        msgspec.structs.replace(camera, matrix=matrices[c]) if c in matrices else camera
        for c, camera in enumerate(model.cameras)
    )
    new = msgspec.structs.replace(model, epoch=epoch, created=created, cameras=cameras, refined_from=0, in_place_of=0)
    errors = [one.errors for one in found]
    new = msgspec.structs.replace(new, covariance=with_moved_cameras(model, errors, matrices))
    joints = _workspace(model, observations, workspace)
    predicted_px = predicted_deviation(new, errors, joints, _arm_points(new, joints))
    if not predicted_px <= limit_px:
        raise too_uncertain(list(moved), predicted_px, limit_px, len(observations.poses))
    return RelocalizedModel(
        new,
        {model.cameras[c].name: _moved_camera(model, one, k) for one in found for k, c in enumerate(one.cameras)},
        sum(one.chi2 for one in found),
        sum(one.degrees_of_freedom for one in found),
        predicted_px,
        tuple(outlier for one in found for outlier in one.outliers),
        tuple(note for one in found for note in one.notes),
    )


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


def _views(model: CellModel, observations: RestObservations, which: tuple[int, ...]) -> Correspondences:
    """Observations of the model's points by the moved cameras; static points are averaged over the poses."""
    names = {model.cameras[c].name: c for c in which}
    n = len(model.joint_names)
    for k, pose in enumerate(observations.poses):
        if pose.joints.shape != (n,) or not np.isfinite(pose.joints).all():
            raise CalibrationError(
                "bad_data", f"pose {k} has joints {pose.joints.tolist()}; {n} finite ones are needed", pose=k
            )
    where = _arm_points(model, np.array([pose.joints for pose in observations.poses]).reshape(-1, n))
    index = {marker: i for i, marker in enumerate(model.marker_ids)}
    static = {marker: i for i, marker in enumerate(model.scene_ids)}
    rows: list[tuple[int, int, int, FloatArray, FloatArray, FloatArray]] = []
    for k, pose in enumerate(observations.poses):
        for sample in pose.samples:
            if sample.camera not in names:
                continue
            _check_sample(sample, k)
            for marker, pixel, covariance in zip(sample.ids, sample.pixels, sample.covariances, strict=True):
                if not (np.isfinite(pixel).all() and np.isfinite(covariance).all()):
                    continue
                if int(marker) in index:
                    point, of_pose = where[k, index[int(marker)]], k
                elif int(marker) in static:
                    point, of_pose = model.scene_points[static[int(marker)]], -1
                else:
                    continue
                rows.append((names[sample.camera], int(marker), of_pose, point, pixel, covariance))
    return _averaged(rows)


def _check_sample(sample: CameraSample, pose: int) -> None:
    k = len(sample.ids)
    if sample.pixels.shape != (k, 2) or sample.covariances.shape != (k, 2, 2):
        raise CalibrationError(
            "bad_data",
            f"pose {pose}: camera {sample.camera!r} has {k} ids, pixels {sample.pixels.shape} and covariances "
            f"{sample.covariances.shape}; {(k, 2)} and {(k, 2, 2)} are needed",
            pose=pose,
            camera=sample.camera,
        )


def _averaged(rows: list[tuple[int, int, int, FloatArray, FloatArray, FloatArray]]) -> Correspondences:
    """One row for each static point and camera: the mean over all poses, with the covariance of the best pose."""
    kept = [row for row in rows if row[2] >= 0]
    by_point: dict[tuple[int, int], list[tuple[int, int, int, FloatArray, FloatArray, FloatArray]]] = {}
    for row in rows:
        if row[2] < 0:
            by_point.setdefault((row[0], row[1]), []).append(row)
    for same in by_point.values():
        pixel = np.median([row[4] for row in same], axis=0)
        least = min((row[5] for row in same), key=lambda covariance: float(np.trace(covariance)))
        kept.append((*same[0][:4], pixel, least))
    return Correspondences(
        np.array([row[0] for row in kept], dtype=np.int64),
        np.array([row[1] for row in kept], dtype=np.int64),
        np.array([row[2] for row in kept], dtype=np.int64),
        np.array([row[3] for row in kept], dtype=np.float64).reshape(-1, 4),
        np.array([row[4] for row in kept], dtype=np.float64).reshape(-1, 2),
        np.array([row[5] for row in kept], dtype=np.float64).reshape(-1, 2, 2),
    )


def _arm_points(model: CellModel, joints: FloatArray) -> FloatArray:
    """The markers (s, m, 4) at joints (s, n)."""
    offsets = (joints - model.zero)[:, list(acting_order(model))]
    found: FloatArray = model.marker_points @ displacements(own_acting_rig(model), offsets).transpose(0, 2, 1)
    return found


def _workspace(model: CellModel, observations: RestObservations, given: FloatArray | None) -> FloatArray:
    """Joint positions (w, n): those of the observations, and the trials' range, for one joint at a time and for all at
    random.
    """
    here = np.array([pose.joints for pose in observations.poses])
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


def _moved_camera(model: CellModel, one: CameraGroup, k: int) -> MovedCamera:
    camera = model.cameras[one.cameras[k]]
    mine = one.views.select(one.views.camera == k)
    mine = replace(mine, camera=np.zeros_like(mine.camera))
    old, lens = with_positive_depths(camera.matrix[None], mine), camera.lens[None]
    motion_px = predicted(with_positive_depths(one.matrices[k : k + 1], mine), lens, mine) - predicted(old, lens, mine)
    moved_px = float(np.sqrt(np.nanmean((motion_px**2).sum(axis=1))))
    return describe_moved_camera(model, camera.name, one.how, camera.matrix, one.matrices[k], mine.points, moved_px)
