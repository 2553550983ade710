"""Covariance of a model after relocalization of cameras, propagated from the model and from the pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from stereoservo.calibration.bundle_adjustment import jacobian
from stereoservo.calibration.relocalization.camera_resection import Correspondences, entry_jacobian
from stereoservo.calibration.rig_model import Charts, Measurements, acting_order, own_acting_rig
from stereoservo.kinematics.model import CellModel, ModelCovariance
from stereoservo.numerics.arrays import FloatArray, IntArray

NEGLIGIBLE = 1e-14
"""Variance of a direction of a matrix, relative to the largest, below which it has none."""


@dataclass(frozen=True, eq=False)
class CameraErrors:
    """Errors of the entries of new matrices, 12 for each of ``cameras``, row by row.

    ``model_jacobian`` (12 c, p): derivative by the parameters of the model's covariance; ``covariance`` (12 c, 12 c) of
    what the new pixels and the static points add.
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
    """Derivative of the matrices' entries (12 c, p) by the model's parameters for ``P D``; zero where the matrices
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
    matrices: FloatArray,
    motion: FloatArray | None,
    views: Correspondences,
    offsets: FloatArray,
) -> FloatArray:
    """Derivative (k, 2, p) of the raw pixels of ``views`` in cameras ``matrices`` (c, 3, 4), which inherit from the
    model's by ``motion``, by the parameters of its covariance. ``offsets`` (s, n): joints of the poses, less the zero.
    Static points move with the cameras that triangulated them.
    """
    k, stated, order = len(views.camera), model.covariance, list(acting_order(model))
    found = np.zeros((k, 2, parameters_of(model)))
    if stated is None:
        return found
    starts = first_parameters(stated)
    # A static point is a marker of its own at a stop where no joint is away from its zero.
    apart = np.flatnonzero(views.pose < 0)
    index = {marker: i for i, marker in enumerate(model.marker_ids)}
    marker = np.array([index.get(int(i), -1) for i in views.ids], dtype=np.int64)
    marker[apart] = len(index) + np.arange(len(apart))
    rig = own_acting_rig(model)
    rig = replace(
        rig,
        cameras=matrices,
        lenses=np.array([model.cameras[c].lens for c in group]),
        points=np.concatenate([rig.points, views.points[apart]]),
    )
    parts = (
        [(starts[0][j], stated.generators[j]) for j in order],
        [(starts[1][c], stated.cameras[c][: None if motion is not None else 0]) for c in group],
        [(starts[2][c], stated.lenses[c]) for c in group],
        list(zip(starts[3], stated.markers, strict=True)),
    )
    generators, cameras, lenses, markers = (tuple(basis for _, basis in part) for part in parts)
    moved = tuple(basis if motion is None else basis @ motion for basis in cameras)
    held = tuple(np.zeros_like(markers[0]) for _ in apart)
    charts = Charts(generators, moved, lenses, (*markers, *held))
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
    for r in apart:
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

    Taken with equal weights, by all cameras in whose image it lies.
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
    # An id of no static point: the point itself is held here.
    held = model_jacobian(
        model, tuple(seen), matrices, np.eye(4), replace(views, ids=np.full(len(seen), -1)),
        np.zeros((0, len(model.zero))),
    ).reshape(2 * len(seen), -1)  # fmt: skip
    chart = np.linalg.svd(model.plane_at_infinity[None])[2][1:].T
    rows = entry_jacobian(matrices, lenses, views)
    J = np.concatenate([_by_point(row, P, point) @ chart for row, P in zip(rows, matrices, strict=True)])
    return np.asarray(-chart @ np.linalg.lstsq(J, held, rcond=None)[0])


def static_roots(
    model: CellModel, matrices: FloatArray, lenses: FloatArray, views: Correspondences
) -> FloatArray:
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
    """The model's covariance with cameras of new ``matrices``; None where the model carries none."""
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


def predicted_deviation(
    model: CellModel, errors: list[CameraErrors], joints: FloatArray, points: FloatArray
) -> float:
    """Largest standard deviation [px], an axis, of a marker in the relocalized cameras of ``model``, where they see it.

    ``points`` (w, m, 4): the markers at ``joints`` (w, n). Where no camera sees any of them: infinite.
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
                rows = model_jacobian(model, (c,), matrices, np.eye(4), views, joints - model.zero)
                variances = np.einsum(
                    "kia,ab,kib->ki", rows, model.covariance.covariance, rows, optimize=True
                )
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
