"""The calibrated model of a cell as arrays for the numba kernels of a step: cameras in the cell's order, markers
scaled to unit height above the plane at infinity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np

from stereoservo.control.marker_groups import MarkerGroups, groups_of
from stereoservo.core.settings import CoreSettings
from stereoservo.geometry.cameras import camera_centre
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.kinematics.kernels import invert4, multiply4_into, project_points, transform_points
from stereoservo.kinematics.model import CellModel, lens_size
from stereoservo.numerics.arrays import FloatArray, IntArray

FIRST_SEEN_SIGMA_PX = 6.0
"""Standard deviation [px] of a marker whose innovation is not known."""


@dataclass(frozen=True)
class ModelArrays:
    """A model as the kernels take it, in the order of the core's cameras and the model's markers."""

    generators: FloatArray
    kinds: np.ndarray[tuple[int], np.dtype[np.uint8]]
    zero: FloatArray
    tip_first: bool
    composition: int
    """How the arm's joints compose (`kinematics.composition`), for laws and plans."""
    matrices: FloatArray
    lenses: FloatArray
    marker_points: FloatArray
    plane_at_infinity: FloatArray
    camera_centres: FloatArray
    metric_basis: FloatArray | None
    """Six twists (6, 4, 4) that span all displacements, if the model is metric."""
    to_euclidean: FloatArray | None
    """The map (4, 4) from the model's frame to a Euclidean one, if the model is metric."""
    marker_ids: tuple[int, ...]
    index: dict[int, int]
    scene_ids: tuple[int, ...]
    scene_points: FloatArray
    scene_pixels: FloatArray
    """Pixels (c, s, 2) of the static points; they are constant."""
    row_ids: IntArray
    """Ids of the markers and static points (k,), ascending; ``row_of`` (k,): their rows in `FrameResiduals`, which has
    the markers, then the static points.
    """
    row_of: IntArray
    groups: MarkerGroups | None
    """Coplanar markers, from which the faces of the body are chosen; None: the model states none."""
    observation_count: int
    """Number of markers times number of cameras; the computing time of a step grows with it."""
    joint_accuracy: JointAccuracy | None
    """Errors of joint readings, if the trials have shown some; none larger than `LARGEST_JOINT_ERROR`."""
    joint_variances: FloatArray
    """The largest variances of these errors over all postures (n,) [rad² or m²]; zeros if there are none."""
    ids: IntArray = field(init=False)
    """`marker_ids` as an array (m,), and the standard deviation ``unseen_px`` (m,) [px] of markers before they are
    seen, if joint readings are exact; read-only.
    """
    unseen_px: FloatArray = field(init=False)
    no_rates: FloatArray = field(init=False)
    """Pixel velocities (c, m, 2) of static set-points (zeros); read-only."""
    known: FloatArray = field(init=False)
    """Whether the markers' points are known (2, m): a row for none, and a row for all; read-only."""

    def __post_init__(self) -> None:
        count = len(self.marker_ids)
        constants = {
            "ids": np.array(self.marker_ids, dtype=np.int64),
            "unseen_px": np.full(count, FIRST_SEEN_SIGMA_PX),
            "no_rates": np.zeros((len(self.matrices), count, 2)),
            "known": np.array([[0.0], [1.0]]) * np.ones(count),
        }
        for name, value in constants.items():
            object.__setattr__(self, name, value)


def _require_numbers(model: CellModel) -> None:
    """Raises ValueError naming an array of ``model`` that has the wrong shape, or numbers that are not finite."""
    joints, markers, scene = len(model.joint_names), len(model.marker_ids), len(model.scene_ids)
    arrays = [
        ("generators", model.generators, (joints, 4, 4)),
        ("joint zeros", model.zero, (joints,)),
        ("marker points", model.marker_points, (markers, 4)),
        ("scene points", model.scene_points, (scene, 4)),
        ("plane at infinity", model.plane_at_infinity, (4,)),
        *((f"a matrix of camera {camera.name}", camera.matrix, (3, 4)) for camera in model.cameras),
        *((f"a lens of camera {camera.name}", camera.lens, (lens_size(model.cameras),)) for camera in model.cameras),
    ]
    if model.joint_accuracy is not None:
        errors = msgspec.structs.astuple(model.joint_accuracy)
        arrays += [("errors of joint readings", values, (joints,)) for values in errors]
    if model.projective_to_euclidean is not None:
        arrays.append(("Euclidean frame", model.projective_to_euclidean, (4, 4)))
    for what, values, shape in arrays:
        if values.shape != shape and (values.size or 0 not in shape):
            raise ValueError(f"model has {what} of shape {values.shape}, {shape} is needed: calibrate again")
        if not np.isfinite(values).all():
            raise ValueError(f"model has {what} with numbers that are not finite: calibrate again")


def require_fitting(model: CellModel, settings: CoreSettings) -> None:
    """Raises ValueError naming the part of ``model`` that does not fit the cell."""
    if model.joint_names != settings.joint_names:
        raise ValueError(
            f"model is of joints {', '.join(model.joint_names)}; the cell has {', '.join(settings.joint_names)}"
        )
    if model.joint_kinds != settings.joint_kinds:
        raise ValueError(f"model has joint kinds {model.joint_kinds}; the cell has {settings.joint_kinds}")
    if any(camera.mount != model.mount for camera in settings.cameras):
        mounts = ", ".join(f"{camera.name} {camera.mount}" for camera in settings.cameras)
        raise ValueError(
            f"model was learnt with cameras mounted {model.mount}; the cell's are {mounts}: calibrate again, or "
            "correct camera.mount in the cell file"
        )
    _require_numbers(model)
    by_name = {camera.name: camera for camera in model.cameras}
    for camera in settings.cameras:
        known = by_name.get(camera.name)
        if known is None:
            raise ValueError(f"model knows cameras {', '.join(by_name)}; the cell also has {camera.name!r}")
        if (known.width, known.height) != (camera.width, camera.height):
            raise ValueError(
                f"model was made with {known.width}x{known.height} images of camera {camera.name!r}; "
                f"it now delivers {camera.width}x{camera.height}"
            )


def model_arrays(model: CellModel, settings: CoreSettings) -> ModelArrays:
    """Kernel arrays of ``model``. Raises ValueError naming the part that does not fit the cell."""
    require_fitting(model, settings)
    by_name = {camera.name: camera for camera in model.cameras}
    matrices = np.ascontiguousarray([by_name[camera.name].matrix for camera in settings.cameras], dtype=np.float64)
    centres = np.array([camera_centre(P) for P in matrices])
    scene = np.ascontiguousarray(model.scene_points, dtype=np.float64).reshape(-1, 4)
    scene_pixels, _ = project_points(matrices, scene)
    accuracy = _bounded_accuracy(model)
    row_ids, row_of = rows_by_id((*model.marker_ids, *model.scene_ids))
    return ModelArrays(
        generators=np.ascontiguousarray(model.generators, dtype=np.float64),
        kinds=np.array([kind == "prismatic" for kind in model.joint_kinds], dtype=np.uint8),
        zero=np.ascontiguousarray(model.zero, dtype=np.float64),
        tip_first=model.tip_first,
        composition=int(Composition.TIP_FIRST if model.tip_first else Composition.BASE_FIRST),
        matrices=matrices,
        lenses=np.array([by_name[camera.name].lens for camera in settings.cameras], dtype=np.float64),
        marker_points=np.ascontiguousarray(model.marker_points, dtype=np.float64),
        plane_at_infinity=np.ascontiguousarray(model.plane_at_infinity, dtype=np.float64),
        camera_centres=with_unit_height(centres, model.plane_at_infinity),
        metric_basis=_metric_basis(model),
        to_euclidean=model.projective_to_euclidean,
        marker_ids=model.marker_ids,
        index={marker: i for i, marker in enumerate(model.marker_ids)},
        scene_ids=model.scene_ids,
        scene_points=scene,
        scene_pixels=scene_pixels,
        row_ids=row_ids,
        row_of=row_of,
        groups=groups_of(model),
        observation_count=len(model.marker_ids) * len(matrices),
        joint_accuracy=accuracy,
        joint_variances=np.zeros(len(model.zero)) if accuracy is None else accuracy.stated**2 + accuracy.posture**2,
    )


def rows_by_id(ids: tuple[int, ...]) -> tuple[IntArray, IntArray]:
    """The ``ids`` (k,), ascending, and the position of each among those given."""
    given = np.array(ids, dtype=np.int64)
    order = np.argsort(given, kind="stable")
    return given[order], order


LARGEST_JOINT_ERROR = 0.1
"""Largest error of joint readings [rad or m] that monitors accept: a larger one, stated by a model, must not hide a
fault.
"""


def _bounded_accuracy(model: CellModel) -> JointAccuracy | None:
    """The errors of joint readings that monitors accept."""
    accuracy = model.joint_accuracy
    if accuracy is None:
        return None
    errors = msgspec.structs.astuple(accuracy)
    return JointAccuracy(*(np.minimum(np.asarray(e, dtype=np.float64), LARGEST_JOINT_ERROR) for e in errors))


def _metric_basis(model: CellModel) -> FloatArray | None:
    """Translations along, and rotations about, three axes through the markers' centroid, in the projective frame."""
    H = model.projective_to_euclidean
    if H is None:
        return None
    inverse = invert4(np.ascontiguousarray(H, dtype=np.float64))
    euclidean = transform_points(np.ascontiguousarray(H), np.ascontiguousarray(model.marker_points))
    centroid = (euclidean[:, :3] / euclidean[:, 3:]).sum(axis=0) / float(len(euclidean))
    size = float(np.sqrt(((euclidean[:, :3] / euclidean[:, 3:] - centroid) ** 2).sum(axis=-1).max()))
    basis = np.zeros((6, 4, 4))
    for k in range(3):
        basis[k, k, 3] = size
        i, j = (k + 1) % 3, (k + 2) % 3
        basis[3 + k, j, i], basis[3 + k, i, j] = 1.0, -1.0
        basis[3 + k, j, 3], basis[3 + k, i, 3] = -centroid[i], centroid[j]
    for k in range(6):  # H⁻¹ T̂ H, by explicit loops
        basis[k] = _product(inverse, _product(basis[k], H))
    return basis


def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    product = np.empty((4, 4))
    multiply4_into(np.ascontiguousarray(A), np.ascontiguousarray(B), product)
    return product


def with_unit_height(points: FloatArray, plane_at_infinity: FloatArray) -> FloatArray:
    """Points (m, 4) scaled to a∞ᵀM = 1, so that differences and centroids are meaningful (errata, orbital height)."""
    height = (points * plane_at_infinity).sum(axis=-1)
    return points / np.where(height == 0.0, 1.0, height)[:, None]
