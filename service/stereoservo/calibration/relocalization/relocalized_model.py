"""Relocalization: new matrices of moved cameras in a cell's model, without recalibration of the arm.

Arm and static points of the model are a known rigid structure in its projective frame: at rest poses the joints
determine where the arm's markers are. A moved camera is resected in that frame (2.19-2.21), in the metric stratum as a
displacement of the camera it was, ``P' = P D``: its intrinsics stay. Frame, arm and lenses stay as they are; the
covariance of the model is extended to the new matrices.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import msgspec
import numpy as np

from stereoservo.calibration.relocalization.camera_group_fit import CameraGroup, facing, relocalize_group
from stereoservo.calibration.relocalization.camera_resection import (
    Correspondences,
    predicted,
)
from stereoservo.calibration.relocalization.moved_camera_covariance import (
    predicted_deviation,
    with_moved_cameras,
)
from stereoservo.calibration.relocalization.relocalization_words import (
    MovedCamera,
    OutlierObservation,
    describe_moved_camera,
    too_uncertain,
)
from stereoservo.calibration.rig_model import acting_order, displacements, own_acting_rig
from stereoservo.calibration.trial_data import CalibrationError
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import FloatArray, IntArray

LIMIT_PX = 1.0
"""Largest standard deviation of a marker's predicted pixel, over the range of the joints, that is taken by default."""
WORKSPACE = 40
"""Random joint positions at which predictions are asked for."""


class CameraSample(Protocol):
    """Protocol of one camera's observations at rest; implemented by `stereoservo.core.cycle.Sample`.

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
    """The arm at rest: its ``joints`` (n,) [rad or m], and the cameras' observations meanwhile."""

    joints: FloatArray
    sights: tuple[CameraSample, ...]


@dataclass(frozen=True, eq=False)
class RestObservations:
    """All observations at rest since the cameras moved; several poses of the arm give more points."""

    poses: tuple[RestPose, ...]


@dataclass(frozen=True, eq=False)
class RelocalizedModel:
    """A relocalized ``model`` with its report: what moved, residuals, accuracy.

    ``predicted_px``: largest standard deviation, an axis, of a marker's predicted pixel in the moved cameras, over the
    range of the joints, where the camera sees it; the model's own uncertainty included where it states one.
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

    ``rigid_rig``: they moved as one body. ``workspace`` (w, n): joint positions at which predictions must hold, default
    the range of the calibration's trials. Raises CalibrationError: ``bad_data``, ``too_few_points``,
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
    new = msgspec.structs.replace(
        model, epoch=epoch, created=created, cameras=cameras, refined_from=0, in_place_of=0
    )
    errors = [one.errors for one in found]
    new = msgspec.structs.replace(new, covariance=with_moved_cameras(model, errors, matrices))
    joints = _workspace(model, observations, workspace)
    predicted_px = predicted_deviation(new, errors, joints, _arm_points(new, joints))
    if not predicted_px <= limit_px:
        raise too_uncertain(list(moved), predicted_px, limit_px, len(observations.poses))
    return RelocalizedModel(
        new,
        {
            model.cameras[c].name: _moved_camera(model, one, k)
            for one in found
            for k, c in enumerate(one.cameras)
        },
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
        for sample in pose.sights:
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
    """One row for each static point and camera: of several poses the mean, with the covariance of the best."""
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
    """Joint positions (w, n): those of the observations, and the trials' range, one joint at a time and all at
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
    old, lens = facing(camera.matrix[None], mine), camera.lens[None]
    motion_px = predicted(facing(one.matrices[k : k + 1], mine), lens, mine) - predicted(old, lens, mine)
    moved_px = float(np.sqrt(np.nanmean((motion_px**2).sum(axis=1))))
    return describe_moved_camera(
        model, camera.name, one.how, camera.matrix, one.matrices[k], mine.points, moved_px
    )
