"""Camera matrices from known points by robust damped least squares, over rigid motions or free matrices.

A change is one of three classes: a displacement of one camera, or of several together, with fixed intrinsics; a change
of frame, if the stratum has no displacements (2.19); or one free matrix. Pixels are raw ones.

Errors of the model, of its static points and of the pixels are propagated to the new matrices to first order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from stereoservo.calibration.bundle_adjustment import jacobian
from stereoservo.calibration.least_squares import DenseFit, Limits, Minimum, RobustLoss, minimise
from stereoservo.calibration.rig_model import Charts, Measurements, acting_order, own_acting_rig
from stereoservo.geometry.distortion import distort, distortion_jacobian, has_distortion
from stereoservo.kinematics.kernels import exp_twist
from stereoservo.kinematics.model import CellModel, ModelCovariance
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray

WHOLE, SUBSET = Limits(100, 0.0, 1e-8), Limits(20, 0.0, 1e-8)
"""Termination of fits to all pixels and to subsets: at a step of 1e-4 standard deviations."""
SUBSETS, OF_SUBSET = 30, 4
"""Number of random starts, and of ids in each, if a fit to all pixels leaves outliers: with 30 % wrong ids one in a
thousand searches finds no clean start."""
NOISY, FEW = 4.0, 0.25
"""Variance of the pixels over the stated one, and share of outliers, at which the search for better starts ends."""
OUTSTANDING = 25.0
"""Squared distance, in units of the median noise, above which a pixel is an outlier: two degrees of freedom."""
LOSS = RobustLoss("cauchy", 3.0)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Correspondences of known points and their raw pixels in a flat list: ``camera`` (k,) index into the fitted
    cameras, ``ids`` (k,), ``pose`` (k,) of the arm, -1 for static points; ``points`` (k, 4), ``pixels`` (k, 2) and
    ``covariances`` (k, 2, 2) [px²].
    """

    camera: IntArray
    ids: IntArray
    pose: IntArray
    points: FloatArray
    pixels: FloatArray
    covariances: FloatArray

    def select(self, keep: BoolArray) -> Correspondences:
        """The views where ``keep`` (k,) holds."""
        return Correspondences(
            self.camera[keep],
            self.ids[keep],
            self.pose[keep],
            self.points[keep],
            self.pixels[keep],
            self.covariances[keep],
        )


class CameraMotionEstimate(NamedTuple):
    """``matrices`` (c, 3, 4) of cameras under estimation, and the ``motion`` D (4, 4) with ``P D`` of the previous
    matrices P; None if the matrices are free.
    """

    matrices: FloatArray
    motion: FloatArray | None


class MatrixChange(Protocol):
    """Parameterization of a permitted change of camera matrices (c, 3, 4)."""

    @property
    def size(self) -> int:
        """Number of parameters."""

    def directions(self, matrices: FloatArray) -> FloatArray:
        """Derivative (c, size, 3, 4) of the matrices by the parameters, at 0."""

    def step(self, moved: CameraMotionEstimate, x: FloatArray) -> CameraMotionEstimate:
        """The matrices at parameters ``x`` (size,)."""


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """All cameras moved by one element of a group: ``P exp(Σ x_k B_k)``, ``algebra`` B (size, 4, 4)."""

    algebra: FloatArray

    @property
    def size(self) -> int:
        return len(self.algebra)

    def directions(self, matrices: FloatArray) -> FloatArray:
        found: FloatArray = matrices[:, None] @ self.algebra[None]
        return found

    def step(self, moved: CameraMotionEstimate, x: FloatArray) -> CameraMotionEstimate:
        assert moved.motion is not None
        motion = exp_twist(np.tensordot(x, self.algebra, axes=1))
        return CameraMotionEstimate(moved.matrices @ motion, moved.motion @ motion)


@dataclass(frozen=True)
class FreeMatrix:
    """One camera's matrix up to scale: 11 parameters."""

    size: int = 11

    def directions(self, matrices: FloatArray) -> FloatArray:
        matrix = matrices[0] / np.linalg.norm(matrices[0])
        rows = np.linalg.svd(matrix.reshape(1, 12))[2][1:]
        return np.asarray(rows.reshape(1, 11, 3, 4) * np.linalg.norm(matrices[0]))

    def step(self, moved: CameraMotionEstimate, x: FloatArray) -> CameraMotionEstimate:
        return CameraMotionEstimate(moved.matrices + np.tensordot(x, self.directions(moved.matrices)[0], axes=1), None)


def predicted(matrices: FloatArray, lenses: FloatArray, views: Correspondences) -> FloatArray:
    """Raw pixels (k, 2) of the points; NaN behind a camera and outside its lens's image."""
    images = np.einsum("kij,kj->ki", matrices[views.camera], views.points)
    ahead = images[:, 2] > 0.0
    ideal = images[:, :2] / np.where(ahead, images[:, 2], np.nan)[:, None]
    pixels: FloatArray = np.empty_like(ideal)
    for c, lens in enumerate(lenses):
        mine = views.camera == c
        pixels[mine] = distort(lens, ideal[mine]) if has_distortion(lens) else ideal[mine]
    return pixels


def entry_jacobian(matrices: FloatArray, lenses: FloatArray, views: Correspondences) -> FloatArray:
    """Derivative (k, 2, 12) of the raw pixels by the entries of each one's matrix."""
    images = np.einsum("kij,kj->ki", matrices[views.camera], views.points)
    ideal = images[:, :2] / images[:, 2:]
    bend = np.tile(np.eye(2), (len(ideal), 1, 1))
    for c, lens in enumerate(lenses):
        mine = views.camera == c
        if has_distortion(lens):
            bend[mine] = distortion_jacobian(lens, ideal[mine])
    by_image = np.zeros((len(ideal), 2, 3))
    by_image[:, 0, 0] = by_image[:, 1, 1] = 1.0
    by_image[:, :, 2] = -ideal
    by_image = bend @ by_image / images[:, 2, None, None]
    found: FloatArray = (by_image[..., None] * views.points[:, None, None, :]).reshape(-1, 2, 12)
    return found


def parameter_jacobian(
    family: MatrixChange, matrices: FloatArray, lenses: FloatArray, views: Correspondences
) -> FloatArray:
    """Derivative (k, 2, size) of the raw pixels by the parameters of a change."""
    directions = family.directions(matrices).reshape(len(matrices), family.size, 12)
    found: FloatArray = np.einsum(
        "kia,kga->kig", entry_jacobian(matrices, lenses, views), directions[views.camera], optimize=True
    )
    return found


def by_pixel(views: Correspondences) -> Callable[[FloatArray], FloatArray]:
    """Whitening of rows (k, 2, q) by each pixel's own covariance."""
    roots = np.linalg.inv(np.linalg.cholesky(views.covariances))
    return lambda rows: roots @ rows


def matrix_fit(
    family: MatrixChange,
    lenses: FloatArray,
    views: Correspondences,
    whiten: Callable[[FloatArray], FloatArray],
    loss: RobustLoss | None = None,
) -> DenseFit[CameraMotionEstimate]:
    """The fit of matrices; ``whiten`` converts rows (k, 2, q) from px to sigmas."""
    return DenseFit(
        lambda moved: whiten((predicted(moved.matrices, lenses, views) - views.pixels)[..., None])[..., 0],
        lambda moved: whiten(parameter_jacobian(family, moved.matrices, lenses, views)),
        family.step,
        loss,
    )


def fit_with_outliers(
    family: MatrixChange, starts: list[CameraMotionEstimate], lenses: FloatArray, views: Correspondences
) -> Minimum[CameraMotionEstimate]:
    """The best robust fit to ``views``, some of whose ids may be wrong, from several starts and subsets of ids; its
    cost is infinite if every start has points behind a camera.
    """
    fit = matrix_fit(family, lenses, views, by_pixel(views), LOSS)
    best = min((minimise(fit, start, WHOLE) for start in starts), key=lambda one: one.cost)
    if _clean(fit.residuals(best.state)):
        return best
    for subset in _subsets(views, family):
        some = views.select(subset)
        part = matrix_fit(family, lenses, some, by_pixel(some))
        for start in starts:
            found = minimise(fit, minimise(part, start, SUBSET).state, WHOLE)
            best = found if found.cost < best.cost else best
        if _is_good_enough(fit.residuals(best.state)):
            break
    return best


def _clean(error: FloatArray) -> bool:
    """Whether no whitened error (k, 2) exceeds the noise that their median indicates."""
    squares = (error**2).sum(axis=1)
    return bool(squares.max() <= OUTSTANDING * max(1.0, float(np.median(squares)) / np.log(4.0)))


def _is_good_enough(error: FloatArray) -> bool:
    """Whether most whitened errors (k, 2) are about as large as the stated noise, so that no other start can be
    better.
    """
    squares = (error**2).sum(axis=1)
    factor = max(1.0, float(np.median(squares)) / np.log(4.0))
    return bool(factor < NOISY and (squares > OUTSTANDING * factor).mean() <= FEW)


def _subsets(views: Correspondences, family: MatrixChange) -> Iterator[BoolArray]:
    """Subsets of the views of a few ids each, enough for the parameters; deterministic."""
    rng = np.random.default_rng(views.pixels.shape[0])
    ids = np.unique(views.ids)
    for _ in range(SUBSETS):
        order = rng.permutation(ids)
        for count in range(OF_SUBSET, len(ids)):
            keep = np.isin(views.ids, order[:count])
            if 2 * int(keep.sum()) >= family.size + 2:
                yield keep
                break


NEGLIGIBLE = 1e-14
"""Variance of a matrix along a direction, relative to the largest, below which it counts as zero."""


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Errors of the entries of new matrices, 12 for each of ``cameras``, row by row.

    ``model_jacobian`` (12 c, p): derivative by the parameters of the model's covariance; ``covariance`` (12 c, 12 c)
    due to the new pixels and the static points.
    """

    cameras: tuple[int, ...]
    model_jacobian: FloatArray
    covariance: FloatArray


def parameters_of(model: CellModel) -> int:
    """Number of parameters of the model's covariance; 0 without one."""
    return 0 if model.covariance is None else len(model.covariance.covariance)


def first_parameters(stated: ModelCovariance) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Index of the first parameter of each joint, camera, lens and marker."""
    starts, at = [], 0
    for part in stated.parts:
        sizes = [len(basis) for basis in part]
        starts.append(at + np.cumsum([0, *sizes[:-1]], dtype=np.int64))
        at += sum(sizes)
    return starts[0], starts[1], starts[2], starts[3]


def inherited_errors(model: CellModel, group: tuple[int, ...], motion: FloatArray | None) -> FloatArray:
    """Derivative of the matrices' entries (12 c, p) by the model's parameters for ``P D``; zero if the matrices
    are free.

    ``motion``: D (4, 4), None for free matrices.
    """
    found = np.zeros((12 * len(group), parameters_of(model)))
    if model.covariance is None or motion is None:
        return found
    starts = first_parameters(model.covariance)[1]
    for k, c in enumerate(group):
        basis = model.covariance.cameras[c]
        found[12 * k : 12 * k + 12, starts[c] : starts[c] + len(basis)] = (basis @ motion).reshape(-1, 12).T
    return found


def model_jacobian(
    model: CellModel,
    group: tuple[int, ...],
    moved: CameraMotionEstimate,
    views: Correspondences,
    offsets: FloatArray,
) -> FloatArray:
    """Derivative (k, 2, p) of the raw pixels of ``views`` in ``moved`` cameras, which depend on the model's, by the
    parameters of its covariance. ``offsets`` (s, n): joints of the poses, minus the zero. Static points move with the
    cameras that triangulated them.
    """
    k, stated, order = len(views.camera), model.covariance, list(acting_order(model))
    matrices, motion = moved
    found = np.zeros((k, 2, parameters_of(model)))
    if stated is None:
        return found
    starts = first_parameters(stated)
    # A static point is treated as a marker at a stop where all joints are at their zero.
    unposed = np.flatnonzero(views.pose < 0)
    index = {marker: i for i, marker in enumerate(model.marker_ids)}
    marker = np.array([index.get(int(i), -1) for i in views.ids], dtype=np.int64)
    marker[unposed] = len(index) + np.arange(len(unposed))
    rig = own_acting_rig(model)
    rig = replace(
        rig,
        cameras=matrices,
        lenses=np.array([model.cameras[c].lens for c in group]),
        points=np.concatenate([rig.points, views.points[unposed]]),
    )
    parts = (
        [(starts[0][j], stated.generators[j]) for j in order],
        [(starts[1][c], stated.cameras[c][: None if motion is not None else 0]) for c in group],
        [(starts[2][c], stated.lenses[c]) for c in group],
        list(zip(starts[3], stated.markers, strict=True)),
    )
    generators, cameras, lenses, markers = (tuple(basis for _, basis in part) for part in parts)
    inherited = tuple(basis if motion is None else basis @ motion for basis in cameras)
    held = tuple(np.zeros_like(markers[0]) for _ in unposed)
    charts = Charts(generators, inherited, lenses, (*markers, *held))
    data = Measurements(
        np.vstack([offsets[:, order], np.zeros(len(order))]),
        views.camera,
        np.where(views.pose < 0, len(offsets), views.pose),
        marker,
        views.pixels,
        np.ones(k),
    )
    columns = np.concatenate([np.arange(at, at + len(basis)) for part in parts for at, basis in part])
    slope = jacobian(rig, charts, np.zeros(charts.size), data)[:, : len(columns)]
    found[:, :, columns] = slope.reshape(k, 2, len(columns))
    rows = entry_jacobian(matrices, rig.lenses, views)
    static = {marker: i for i, marker in enumerate(model.scene_ids)}
    for r in unposed:
        if int(views.ids[r]) in static:
            by_point = _by_point(rows[r], matrices[views.camera[r]], views.points[r])
            found[r] += by_point @ scene_by_model(model, static[int(views.ids[r])])
    return found


def _by_point(by_entries: FloatArray, matrix: FloatArray, point: FloatArray) -> FloatArray:
    """Derivative (2, 4) of a pixel by its point, from that by the entries of its matrix (2, 12): ``∂u/∂m Mᵀ``."""
    by_image = by_entries.reshape(2, 3, 4) @ point / float(point @ point)
    return np.asarray(by_image @ matrix)


def scene_by_model(model: CellModel, i: int) -> FloatArray:
    """Derivative (4, p) of static point ``i`` by the model's parameters, through the cameras that triangulated it.

    Computed with equal weights, by all cameras in whose image it lies.
    """
    point = model.scene_points[i]
    every = Correspondences(
        np.arange(len(model.cameras)),
        np.zeros(len(model.cameras), dtype=np.int64),
        np.full(len(model.cameras), -1, dtype=np.int64),
        np.tile(point, (len(model.cameras), 1)),
        np.zeros((len(model.cameras), 2)),
        np.tile(np.eye(2), (len(model.cameras), 1, 1)),
    )
    seen = [c for c in range(len(model.cameras)) if _inside(model, c, every.select(every.camera == c))[0]]
    if len(seen) < 2:
        return np.zeros((4, parameters_of(model)))
    views = replace(every.select(np.isin(every.camera, seen)), camera=np.arange(len(seen)))
    matrices = np.array([model.cameras[c].matrix for c in seen])
    lenses = np.array([model.cameras[c].lens for c in seen])
    # If no static point has this id, the point itself is fixed here.
    held = model_jacobian(
        model,
        tuple(seen),
        CameraMotionEstimate(matrices, np.eye(4)),
        replace(views, ids=np.full(len(seen), -1)),
        np.zeros((0, len(model.zero))),
    ).reshape(2 * len(seen), -1)
    chart = np.linalg.svd(model.plane_at_infinity[None])[2][1:].T
    rows = entry_jacobian(matrices, lenses, views)
    J = np.concatenate([_by_point(row, P, point) @ chart for row, P in zip(rows, matrices, strict=True)])
    return np.asarray(-chart @ np.linalg.lstsq(J, held, rcond=None)[0])


def static_roots(model: CellModel, matrices: FloatArray, lenses: FloatArray, views: Correspondences) -> FloatArray:
    """Root (k, 2, 4 s) of the pixels' covariance by the static points' own, given the cameras."""
    count = len(model.scene_ids)
    found = np.zeros((len(views.camera), 2, 4 * count))
    rows = entry_jacobian(matrices, lenses, views)
    static = {marker: i for i, marker in enumerate(model.scene_ids)}
    for k in np.flatnonzero(views.pose < 0):
        i = static[int(views.ids[k])]
        values, vectors = np.linalg.eigh(model.scene_covariances[i])
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        slope = _by_point(rows[k], matrices[views.camera[k]], views.points[k])
        found[k, :, 4 * i : 4 * i + 4] = slope @ root
    return found


def with_moved_cameras(
    model: CellModel, errors: list[CameraErrors], matrices: dict[int, FloatArray]
) -> ModelCovariance | None:
    """The model's covariance with cameras of new ``matrices``; None if the model has no covariance."""
    stated = model.covariance
    if stated is None:
        return None
    starts, p = first_parameters(stated)[1], len(stated.covariance)
    first, last = int(starts[0]), int(starts[-1]) + len(stated.cameras[-1])
    noise = sum(len(one.covariance) for one in errors)
    source = np.zeros((p + noise, p + noise))
    source[:p, :p] = stated.covariance
    maps: dict[int, FloatArray] = {}
    at = p
    for one in errors:
        size = len(one.covariance)
        source[at : at + size, at : at + size] = one.covariance
        for k, c in enumerate(one.cameras):
            rows = np.zeros((12, p + noise))
            rows[:, :p] = one.model_jacobian[12 * k : 12 * k + 12]
            rows[:, at + 12 * k : at + 12 * k + 12] = np.eye(12)
            maps[c] = rows
        at += size
    identity = np.eye(p, p + noise)
    blocks, bases = [identity[:first]], []
    for c, basis in enumerate(stated.cameras):
        if c not in maps:
            bases.append(basis)
            blocks.append(identity[starts[c] : starts[c] + len(basis)])
            continue
        unit = matrices[c].ravel() / np.linalg.norm(matrices[c])
        own = maps[c] - np.outer(unit, unit @ maps[c])
        values, vectors = np.linalg.eigh(own @ source @ own.T)
        kept = vectors[:, values > NEGLIGIBLE * values[-1]].T
        bases.append(kept.reshape(-1, 3, 4))
        blocks.append(kept @ own)
    blocks.append(identity[last:])
    change = np.concatenate(blocks)
    covariance = change @ source @ change.T
    return ModelCovariance(
        stated.generators, tuple(bases), stated.lenses, stated.markers, 0.5 * (covariance + covariance.T)
    )


def predicted_deviation(model: CellModel, errors: list[CameraErrors], joints: FloatArray, points: FloatArray) -> float:
    """Largest standard deviation [px], per axis, of a marker in the relocalized cameras of ``model`` that see it.

    ``points`` (w, m, 4): the markers at ``joints`` (w, n). Infinite if no camera sees any of them.
    """
    worst, w, m = 0.0, len(joints), len(model.marker_ids)
    some = False
    for one in errors:
        for k, c in enumerate(one.cameras):
            camera = model.cameras[c]
            views = Correspondences(
                np.zeros(w * m, dtype=np.int64),
                np.tile(np.array(model.marker_ids, dtype=np.int64), w),
                np.repeat(np.arange(w), m),
                points.reshape(-1, 4),
                np.zeros((w * m, 2)),
                np.tile(np.eye(2), (w * m, 1, 1)),
            )
            views = views.select(_inside(model, c, views))
            if not len(views.camera):
                continue
            some = True
            matrices, lenses = camera.matrix[None], camera.lens[None]
            if model.covariance is None:
                mine = slice(12 * k, 12 * k + 12)
                rows = entry_jacobian(matrices, lenses, views)
                variances = np.einsum("kia,ab,kib->ki", rows, one.covariance[mine, mine], rows, optimize=True)
            else:
                rows = model_jacobian(
                    model, (c,), CameraMotionEstimate(matrices, np.eye(4)), views, joints - model.zero
                )
                variances = np.einsum("kia,ab,kib->ki", rows, model.covariance.covariance, rows, optimize=True)
            worst = max(worst, float(np.sqrt(variances.max())))
    return worst if some else np.inf


def _inside(model: CellModel, c: int, views: Correspondences) -> npt.NDArray[np.bool_]:
    camera = model.cameras[c]
    images = views.points @ camera.matrix.T
    ahead = images[:, 2] * np.median(np.sign(images[:, 2])) > 0.0
    ideal = images[:, :2] / np.where(ahead, images[:, 2], np.nan)[:, None]
    with np.errstate(invalid="ignore"):
        inside = (ideal > -0.5) & (ideal < np.array([camera.width, camera.height]) - 0.5)
    return np.asarray(inside.all(axis=1))
