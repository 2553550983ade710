"""The calibrated model of a cell (joints, cameras, lenses, markers, covariance, statistics of the fit) with its
checks, and its versioned JSON file.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from stereoservo.kinematics.joint_accuracy import JointAccuracy
from stereoservo.messages.cell_file import MAX_CAMERAS, MAX_JOINTS, MAX_MARKERS, Mount
from stereoservo.messages.decoding import DamagedError, decoding
from stereoservo.messages.files import read_bounded, verify_checksum, with_checksum, write_atomically
from stereoservo.numerics.arrays import FloatArray

MODEL_SCHEMA = 2
MAX_MODEL_BYTES = 1 << 28
READABLE_SCHEMAS = (1, 2)
"""Schema 1 has neither lenses nor mounts: static pinhole cameras."""

Stratum = Literal["projective", "affine", "metric"]


def pinhole() -> FloatArray:
    """The lens (4,) of a camera without distortion (`stereoservo.geometry.distortion`)."""
    return np.array([0.0, 0.0, 0.0, 1.0])


class CameraModel(msgspec.Struct, frozen=True, eq=False):
    """A camera in the model's projective frame: ``matrix`` (3, 4) maps points to ideal pixels; image size [px].

    ``lens`` (4,) or (7,): distortion ``(k, cu, cv, r0)``, or with the terms ``(k2, p1, p2)`` appended, from ideal to
    raw pixels, see `geometry.distortion`; of equal length in all cameras of a model.
    """

    name: str
    matrix: FloatArray
    width: int
    height: int
    lens: FloatArray = msgspec.field(default_factory=pinhole)


class JointStatistics(msgspec.Struct, frozen=True):
    """Fit of one joint's trial motion: residual rms [px], number of stops, range of motion [rad or m].

    ``expected_px``: expected rms at the stated sigmas, ``σ √(1 - trace(H_j) / n_j)`` with the trial's block of the hat
    matrix; ``standard_error_px``: standard deviation of the rms about it. None in older files.
    """

    name: str
    rms_px: float
    stops: int
    range: float
    expected_px: float | None = None
    standard_error_px: float | None = None


class FitStatistics(msgspec.Struct, frozen=True, eq=False):
    """Statistics of the final least-squares fit.

    ``chi2``: sum of squared residuals in sigmas, with ``degrees_of_freedom`` = measurements - parameters net of gauge;
    ``chi2_ok``: inside the 99.9 % interval.
    """

    rms_px: float
    chi2: float
    degrees_of_freedom: int
    chi2_ok: bool
    measurements: int
    parameters: int
    outliers: int
    joints: tuple[JointStatistics, ...]
    images: int


class JointLoads(msgspec.Struct, frozen=True, eq=False):
    """Joint loads that the drives reported in the trial motions; the thresholds of collision detection come from them.

    ``efforts`` (n, n) [N m or N, or fractions of the rated torque]: entry (j, k) is the largest deviation of joint j's
    effort from its moving mean that lasted for a few samples while joint k moved. ``largest_efforts`` (n,): largest
    magnitude of all. ``following_errors`` (n,): likewise, from zero [rad or m]. ``velocities`` (n,): highest commanded
    speed [rad/s or m/s]. None if the drives do not report them.
    """

    velocities: FloatArray
    efforts: FloatArray | None = None
    largest_efforts: FloatArray | None = None
    following_errors: FloatArray | None = None


class ModelCovariance(msgspec.Struct, frozen=True, eq=False):
    """Covariance of all free parameters of a model, with the direction of each, in the model's projective frame.

    ``covariance`` (p, p), parameters in the order of the fields, joint by joint, camera by camera and so on:

    - ``generators``: for each joint directions D (p_j, 4, 4); a parameter changes the generator by ``[D, G]``, at
      finite values by ``T G T⁻¹``, ``T = (I - Δ/2)⁻¹ (I + Δ/2)``, ``Δ = Σ x_k D_k``: the algebra stays exact.
    - ``cameras``: for each camera directions (p_c, 3, 4) of its matrix.
    - ``lenses``: for each camera directions (p_l, 4 or 7) of its lens; none for a pinhole camera.
    - ``markers``: for each marker directions (p_m, 4) of its point.

    A gauge is fixed: only functions that are invariant under changes of frame within the group of the stratum have a
    meaningful covariance; `kinematics.covariance` propagates to any such function. ``plane_at_infinity`` and
    ``projective_to_euclidean`` are constant. The noise is the stated one, or, if the residuals do not agree with it,
    the larger of the stated and the estimated one.
    """

    generators: tuple[FloatArray, ...]
    cameras: tuple[FloatArray, ...]
    lenses: tuple[FloatArray, ...]
    markers: tuple[FloatArray, ...]
    covariance: FloatArray

    @property
    def parts(self) -> tuple[tuple[FloatArray, ...], ...]:
        """The directions in the order of the parameters."""
        return self.generators, self.cameras, self.lenses, self.markers


class MarkerGroup(msgspec.Struct, frozen=True):
    """Coplanar markers, by their indices in the model: ``members``, ascending, and the ``triple`` that defines the
    plane.

    ``above``, ``below``: number of the other markers on either side; ``roundness``: altitude of the triple divided by
    the extent of the group. See `control.marker_groups`.
    """

    triple: tuple[int, int, int]
    members: tuple[int, ...]
    above: int
    below: int
    roundness: float


class CellModel(msgspec.Struct, frozen=True, eq=False):
    """Calibrated model: projective kinematics, cameras and markers in one projective frame.

    ``generators`` (n, 4, 4): joint operators at ``zero`` (n,), revolute ones with eigenvalues (0, 0, i, -i), prismatic
    ones nilpotent (5.18). ``marker_points`` (m, 4): markers at the zero, orbital heights such that
    ``plane_at_infinity @ M == 1``. ``projective_to_euclidean`` (4, 4): H_PE up to one global scale, if the stratum is
    ``metric``. ``mount``: of all its cameras; eye-in-hand chains are ``tip_first``. ``epoch`` is unique among all
    models of a cell.

    Stratum ``projective``: the plane at infinity is not identifiable (for example, all axes are parallel);
    ``plane_at_infinity`` is then the least singular vector of (5.59): joints preserve its heights ``a @ M``, but it
    does not determine parallelism.
    """

    schema: int
    epoch: int
    joint_names: tuple[str, ...]
    joint_kinds: tuple[Literal["revolute", "prismatic"], ...]
    zero: FloatArray
    generators: FloatArray
    cameras: tuple[CameraModel, ...]
    marker_ids: tuple[int, ...]
    marker_points: FloatArray
    plane_at_infinity: FloatArray
    stratum: Stratum
    projective_to_euclidean: FloatArray | None
    statistics: FitStatistics | None
    created: str = ""
    source: str = ""
    mount: Mount = "eye_to_hand"
    covariance: ModelCovariance | None = None
    loads: JointLoads | None = None
    scene_ids: tuple[int, ...] = ()
    scene_points: FloatArray = msgspec.field(default_factory=lambda: np.zeros((0, 4)))
    """Static scene points (s, 4) of height 1, with ``scene_covariances`` (s, 4, 4) at that scale, given the cameras."""
    scene_covariances: FloatArray = msgspec.field(default_factory=lambda: np.zeros((0, 4, 4)))
    marker_groups: tuple[MarkerGroup, ...] | None = None
    """Coplanar groups of its markers; None if they have not been searched for."""
    joint_accuracy: JointAccuracy | None = None
    """Errors of the joint readings; None if unknown: predictions then assume exact readings."""
    shutter_offsets: tuple[ShutterOffset, ...] = ()
    """Offsets of the cameras whose stamps were calibrated against the joints' stamps by the trial motions."""
    refined_from: int = 0
    """Epoch of the model from which this one was refined on-line; 0: not refined."""
    in_place_of: int = 0
    """Epoch of the model whose taught goals remain valid for this one, because only the estimate changed; 0: none."""

    @property
    def tip_first(self) -> bool:
        """The order of the chain's factors: see `kinematics.chain.ProjectiveChain`."""
        return self.mount == "eye_in_hand"


class ModelFileError(DamagedError):
    """A model, or a model file, is invalid.

    Attributes:
        path: the file, or ``"<model>"`` for a model in memory.
        key: the invalid field; empty for the file as a whole.
    """

    def __init__(self, path: Path | str, key: str, message: str) -> None:
        super().__init__(path, f"{key + ': ' if key else ''}{message}")
        self.path = str(path)
        self.key = key


MAX_DISTORTION = 1.0
"""Largest radial parameter of a lens, at its reference radius: images with more distortion cannot be used."""
RANK_TOLERANCE = 1e-12
"""Least singular value of a matrix of rank 3 or 4, relative to its size."""
METRIC_TOLERANCE = 1e-5
"""Largest relative deviation from a Euclidean twist of an operator transformed by H_PE."""
SYMMETRY_TOLERANCE = 1e-8
"""Largest deviation of a covariance, scaled to correlations, from a symmetric and positive semidefinite matrix."""
ALGEBRA_TOLERANCE = 1e-6
"""Largest relative defect of ``Ĥ³ + Ĥ`` (revolute) or ``Ĥ²`` (prismatic) that a model may have."""


def check_model(model: CellModel, path: Path | str = "<model>") -> None:
    """Check shapes, finiteness and algebraic constraints of a model.

    Raises ModelFileError with the field, its value and the valid values.
    """
    if model.schema != MODEL_SCHEMA:
        raise ModelFileError(path, "schema", f"is {model.schema!r}; this version reads {MODEL_SCHEMA}")
    if not 0 <= model.epoch < 2**63:
        raise ModelFileError(path, "epoch", f"is {model.epoch}; a model's epoch is 0 or more, and below 2^63")
    n, m = len(model.joint_names), len(model.marker_ids)
    for key, count, most, what in (
        ("joint_names", n, MAX_JOINTS, "joint"),
        ("marker_ids", m, MAX_MARKERS - len(model.scene_ids), "marker"),
        ("cameras", len(model.cameras), MAX_CAMERAS, "camera"),
    ):
        if count < 1:
            raise ModelFileError(path, key, f"is empty; a model has at least one {what}")
        if count > most:
            beside = f" beside {len(model.scene_ids)} static ones" if key == "marker_ids" and model.scene_ids else ""
            raise ModelFileError(path, key, f"has {count} entries; a cell has at most {most} {what}s{beside}")
    if len(model.joint_kinds) != n:
        raise ModelFileError(
            path,
            "joint_kinds",
            f"has {len(model.joint_kinds)} entries; one for each of the {n} joint_names is needed",
        )
    for key, names in (
        ("joint_names", model.joint_names),
        ("marker_ids", model.marker_ids),
        ("cameras", tuple(camera.name for camera in model.cameras)),
    ):
        for name in names:
            if names.count(name) > 1:
                raise ModelFileError(path, key, f"{name!r} stands twice; entries must differ")
    arrays: list[tuple[str, FloatArray, tuple[int, ...]]] = [
        ("zero", model.zero, (n,)),
        ("generators", model.generators, (n, 4, 4)),
        ("marker_points", model.marker_points, (m, 4)),
        ("plane_at_infinity", model.plane_at_infinity, (4,)),
        *((f"cameras[{i}].matrix", camera.matrix, (3, 4)) for i, camera in enumerate(model.cameras)),
        *((f"cameras[{i}].lens", camera.lens, (lens_size(model.cameras),)) for i, camera in enumerate(model.cameras)),
    ]
    if model.projective_to_euclidean is not None:
        arrays.append(("projective_to_euclidean", model.projective_to_euclidean, (4, 4)))
    for key, array, shape in arrays:
        if array.shape != shape:
            raise ModelFileError(path, key, f"has shape {array.shape}; {shape} is needed")
        if not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise ModelFileError(path, key, f"entry {where} is {array[where]}; finite numbers are needed")
    _check_cameras(model, path)
    _check_algebra(model, path)
    if model.projective_to_euclidean is not None:
        _check_metric(model, model.projective_to_euclidean, path)
    if model.covariance is not None:
        _check_covariance(model, model.covariance, path)
    if model.loads is not None:
        check_loads(model.loads, n, path)
    if model.joint_accuracy is not None:
        _check_accuracy(model.joint_accuracy, n, path)
    for key, message in offset_faults(model.shutter_offsets, [camera.name for camera in model.cameras]):
        raise ModelFileError(path, key, message)
    _check_scene(model, path)
    for k, group in enumerate(model.marker_groups or ()):
        if len(set(group.triple)) < 3 or not {*group.triple} <= {*group.members} <= {*range(m)}:
            raise ModelFileError(
                path,
                f"marker_groups[{k}]",
                f"is of markers {group.members}, by {group.triple}: indices from 0 to {m - 1}, three of them "
                "different, are needed",
            )


def lens_size(cameras: tuple[CameraModel, ...]) -> int:
    """Number of lens parameters of each of ``cameras``, from the first one: 7 with further distortion terms, else 4."""
    return 7 if cameras and cameras[0].lens.shape == (7,) else 4


def check_loads(loads: JointLoads, n: int, path: Path | str = "<loads>") -> None:
    """Check the loads of ``n`` joints. Raises ModelFileError."""
    given: list[tuple[str, FloatArray | None, tuple[int, ...]]] = [
        ("velocities", loads.velocities, (n,)),
        ("efforts", loads.efforts, (n, n)),
        ("largest_efforts", loads.largest_efforts, (n,)),
        ("following_errors", loads.following_errors, (n,)),
    ]
    for key, array, shape in given:
        if array is None:
            continue
        if array.shape != shape:
            raise ModelFileError(path, f"loads.{key}", f"has shape {array.shape}; {shape} is needed")
        if not (np.isfinite(array) & (array >= 0.0)).all():
            raise ModelFileError(
                path, f"loads.{key}", "has entries that are negative or not finite; magnitudes are needed"
            )
    if (loads.efforts is None) != (loads.largest_efforts is None):
        raise ModelFileError(path, "loads", "has one of efforts and largest_efforts; both or none are needed")


def _check_accuracy(given: JointAccuracy, n: int, path: Path | str) -> None:
    for key, array in (
        ("random", given.random),
        ("repeatable", given.repeatable),
        ("stated", given.stated),
        ("posture", given.posture),
    ):
        if array.shape != (n,):
            raise ModelFileError(path, f"joint_accuracy.{key}", f"has shape {array.shape}; {(n,)} is needed")
        if not (np.isfinite(array) & (array >= 0.0)).all():
            raise ModelFileError(
                path,
                f"joint_accuracy.{key}",
                "has entries that are negative or not finite; deviations are needed",
            )


def _check_cameras(model: CellModel, path: Path | str) -> None:
    for i, camera in enumerate(model.cameras):
        if camera.width < 1 or camera.height < 1:
            raise ModelFileError(
                path,
                f"cameras[{i}]",
                f"{camera.name!r}: image size {camera.width}x{camera.height} px is not positive",
            )
        if camera.lens[3] <= 0:
            raise ModelFileError(
                path,
                f"cameras[{i}].lens",
                f"{camera.name!r}: reference radius {camera.lens[3]:g} px is not positive",
            )
        strongest = max(camera.lens[[0, *range(4, len(camera.lens))]], key=abs)
        if abs(strongest) > MAX_DISTORTION:
            raise ModelFileError(
                path,
                f"cameras[{i}].lens",
                f"{camera.name!r}: distortion parameter {strongest:g}; at most ±{MAX_DISTORTION:g} is accepted",
            )
        # Rows of unit length: the result is the rank, independent of units.
        rows = np.linalg.norm(camera.matrix, axis=1)
        least = float(np.linalg.svd(camera.matrix / rows[:, None])[1][2]) if rows.all() else 0.0
        if not least > RANK_TOLERANCE:
            raise ModelFileError(
                path,
                f"cameras[{i}].matrix",
                f"{camera.name!r}: least singular value {least:.2e} with rows of length 1; a projection has rank 3",
            )


def _check_metric(model: CellModel, upgrade: FloatArray, path: Path | str) -> None:
    """Check that H_PE maps the operators to Euclidean twists: a rotation's part skew, a translation's zero (5.56)."""
    key = "projective_to_euclidean"
    values = np.linalg.svd(upgrade / max(float(np.abs(upgrade).max()), 1e-300), compute_uv=False)
    if not values[3] > RANK_TOLERANCE * values[0]:
        raise ModelFileError(path, key, f"has singular values {values.tolist()}; an invertible one is needed")
    twists = upgrade @ model.generators @ np.linalg.inv(upgrade)
    for j, (kind, twist) in enumerate(zip(model.joint_kinds, twists, strict=True)):
        rotation = twist[:3, :3]
        off = float(
            np.linalg.norm(rotation + rotation.T if kind == "revolute" else rotation) + np.linalg.norm(twist[3])
        )
        if not off <= METRIC_TOLERANCE * float(np.linalg.norm(twist)):
            raise ModelFileError(
                path,
                key,
                f"does not make joint {model.joint_names[j]!r} a Euclidean "
                f"{'rotation' if kind == 'revolute' else 'translation'}: {off:.2e} is left, with an operator of size "
                f"{np.linalg.norm(twist):.2e}; a share of {METRIC_TOLERANCE:g} is taken",
            )


def _check_scene(model: CellModel, path: Path | str) -> None:
    """Check the static points: ids that are not on the arm, scales 1, covariances."""
    ids, points, covariances = model.scene_ids, model.scene_points, model.scene_covariances
    for marker in ids:
        if ids.count(marker) > 1:
            raise ModelFileError(path, "scene_ids", f"{marker} occurs twice; entries must differ")
        if marker in model.marker_ids:
            raise ModelFileError(path, "scene_ids", f"{marker} is in marker_ids, too; a static id is not of the arm")
    if ids and model.mount == "eye_in_hand":
        raise ModelFileError(
            path, "scene_ids", "holds ids although the cameras ride on the arm; from there nothing is static"
        )
    for key, array, shape in (
        ("scene_points", points, (len(ids), 4)),
        ("scene_covariances", covariances, (len(ids), 4, 4)),
    ):
        if array.shape != shape:
            raise ModelFileError(path, key, f"has shape {array.shape}; {shape} is needed")
        if not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise ModelFileError(path, key, f"entry {where} is {array[where]}; finite numbers are needed")
    scales = points @ model.plane_at_infinity
    if np.abs(scales - 1.0).max(initial=0.0) > ALGEBRA_TOLERANCE:
        worst = int(np.abs(scales - 1.0).argmax())
        raise ModelFileError(
            path,
            f"scene_points[{worst}]",
            f"static marker {ids[worst]}: plane_at_infinity @ M is {scales[worst]:.6g}; 1 is needed",
        )
    for i, matrix in enumerate(covariances):
        size = float(np.abs(matrix).max())
        least = float(np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0])
        if np.abs(matrix - matrix.T).max() > SYMMETRY_TOLERANCE * size or least < -SYMMETRY_TOLERANCE * size:
            raise ModelFileError(
                path,
                f"scene_covariances[{i}]",
                f"static marker {ids[i]}: is not symmetric, or has an eigenvalue of {least:.3g}; none may be negative",
            )


def _check_covariance(model: CellModel, given: ModelCovariance, path: Path | str) -> None:
    cameras = len(model.cameras)
    expected: list[tuple[str, tuple[FloatArray, ...], int, tuple[int, ...]]] = [
        ("generators", given.generators, len(model.joint_names), (4, 4)),
        ("cameras", given.cameras, cameras, (3, 4)),
        ("lenses", given.lenses, cameras, (lens_size(model.cameras),)),
        ("markers", given.markers, len(model.marker_ids), (4,)),
    ]
    p = 0
    for key, bases, count, shape in expected:
        if len(bases) != count:
            raise ModelFileError(path, f"covariance.{key}", f"has {len(bases)} entries; the model has {count} of them")
        for i, basis in enumerate(bases):
            where = f"covariance.{key}[{i}]"
            if basis.shape[1:] != shape:
                needed = ", ".join(str(n) for n in shape)
                raise ModelFileError(path, where, f"has shape {basis.shape}; (p, {needed}) is needed")
            if not np.isfinite(basis).all():
                raise ModelFileError(path, where, "has entries that are not finite")
            p += len(basis)
    matrix, key = given.covariance, "covariance.covariance"
    if matrix.shape != (p, p):
        raise ModelFileError(path, key, f"has shape {matrix.shape}; the directions are {p}, ({p}, {p}) is needed")
    if not np.isfinite(matrix).all():
        raise ModelFileError(path, key, "has entries that are not finite")
    variances = np.diag(matrix)
    if not (variances > 0.0).all():
        worst = int(variances.argmin())
        raise ModelFileError(path, key, f"variance {worst} is {variances[worst]:.3g}; positive ones are needed")
    deviations = np.sqrt(variances)
    correlation = matrix / deviations[:, None] / deviations[None, :]
    if not np.abs(correlation - correlation.T).max() <= SYMMETRY_TOLERANCE:
        raise ModelFileError(path, key, "is not symmetric")
    least = float(np.linalg.eigvalsh(correlation)[0])
    if least < -SYMMETRY_TOLERANCE:
        raise ModelFileError(path, key, f"has an eigenvalue of {least:.3g} as a correlation; none may be negative")


def _check_algebra(model: CellModel, path: Path | str) -> None:
    for j, (kind, generator) in enumerate(zip(model.joint_kinds, model.generators, strict=True)):
        with np.errstate(over="ignore", invalid="ignore"):
            size = float(np.linalg.norm(generator))
            square = generator @ generator
            defect = square @ generator + generator if kind == "revolute" else square
        limit = ALGEBRA_TOLERANCE * max(size, size**3 if kind == "revolute" else size**2)
        if size == 0 or not float(np.linalg.norm(defect)) <= limit < np.inf:
            law = "Ĥ³ = -Ĥ" if kind == "revolute" else "Ĥ² = 0"
            raise ModelFileError(
                path,
                f"generators[{j}]",
                f"joint {model.joint_names[j]!r} is {kind} but "
                f"‖{law.replace(' = ', ' - ').replace('- -', '+ ')}‖ is {np.linalg.norm(defect):.2e} with "
                f"‖Ĥ‖ {size:.2e}; {law} is needed",
            )
    scales = model.marker_points @ model.plane_at_infinity
    if np.abs(scales - 1).max() > ALGEBRA_TOLERANCE:
        worst = int(np.abs(scales - 1).argmax())
        raise ModelFileError(
            path,
            f"marker_points[{worst}]",
            f"marker {model.marker_ids[worst]}: plane_at_infinity @ M is {scales[worst]:.6g}; 1 is needed",
        )
    if (model.stratum == "metric") != (model.projective_to_euclidean is not None):
        raise ModelFileError(
            path,
            "projective_to_euclidean",
            f"is {'missing' if model.projective_to_euclidean is None else 'given'} with stratum "
            f"{model.stratum!r}; it is there in the metric stratum, and only there",
        )


def _encode_array(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise NotImplementedError(f"cannot encode {type(value).__name__}")


def _decode_array(kind: type, value: object) -> object:
    # Strings and ragged lists raise ValueError here, which msgspec reports with the field's path.
    if not isinstance(value, list):
        raise ValueError(f"Expected nested lists of numbers, got {type(value).__name__}")
    return np.array(value, dtype=np.float64)


def encode_model(model: CellModel) -> bytes:
    """A model as one JSON object with a checksum, arrays as nested lists with the full precision of float64. Raises
    ModelFileError.
    """
    check_model(model)
    return with_checksum(msgspec.json.format(msgspec.json.encode(model, enc_hook=_encode_array), indent=1))


def decode_model(data: bytes, path: Path | str = "<model>") -> CellModel:
    """Inverse of :func:`encode_model`, with strict checks. Raises ModelFileError for any invalid bytes."""
    with decoding(partial(ModelFileError, path, "")):
        with decoding(lambda cause: ModelFileError(path, "", f"is not JSON: {cause}")):
            tree = msgspec.json.decode(data)
        model = _converted(tree, path)
        check_model(model, path)
        with decoding(partial(ModelFileError, path, "crc32")):
            verify_checksum(data)
    return model


def _converted(tree: Any, path: Path | str) -> CellModel:
    """A model of a parsed file of any readable schema. Raises ModelFileError."""
    if not isinstance(tree, dict):
        raise ModelFileError(path, "", f"holds a {type(tree).__name__}; a JSON object is needed")
    if type(tree.get("schema")) is not int or tree["schema"] not in READABLE_SCHEMAS:
        known = " and ".join(str(schema) for schema in READABLE_SCHEMAS)
        raise ModelFileError(path, "schema", f"is {tree.get('schema')!r}; this version reads {known}")
    tree["schema"] = MODEL_SCHEMA
    try:
        model = msgspec.convert(tree, CellModel, dec_hook=_decode_array)
    except (msgspec.ValidationError, TypeError) as error:
        text, _, where = str(error).partition(" - at `")
        raise ModelFileError(path, where.rstrip("`").removeprefix("$").lstrip("."), text) from error
    if model.covariance is not None:
        shaped = _shaped(model.covariance, lens_size(model.cameras))
        model = msgspec.structs.replace(model, covariance=shaped)
    if not model.scene_ids:
        model = msgspec.structs.replace(model, scene_points=np.zeros((0, 4)), scene_covariances=np.zeros((0, 4, 4)))
    return model


def _shaped(given: ModelCovariance, lens: int) -> ModelCovariance:
    """Restore the shape of empty lists of directions, which JSON does not preserve; ``lens``: parameters per lens."""

    def shaped(bases: tuple[FloatArray, ...], *shape: int) -> tuple[FloatArray, ...]:
        return tuple(basis if basis.size else np.zeros((0, *shape)) for basis in bases)

    return ModelCovariance(
        shaped(given.generators, 4, 4),
        shaped(given.cameras, 3, 4),
        shaped(given.lenses, lens),
        shaped(given.markers, 4),
        given.covariance,
    )


def save_model(model: CellModel, path: Path) -> None:
    """Write a model file atomically. Raises ModelFileError, OSError."""
    write_atomically(path, encode_model(model))


def load_model(path: Path) -> CellModel:
    """Read and check a model file. Raises ModelFileError."""
    with decoding(partial(ModelFileError, path, "")):
        return decode_model(read_bounded(path, MAX_MODEL_BYTES), path)


# -- stamps of the shutters ----------------------------------------------------------------------------------
# Offsets of the cameras' shutter stamps in a model.


LONGEST_OFFSET_S = 1.0
"""Largest offset of shutter stamps in a model [s]."""


class ShutterOffset(msgspec.Struct, frozen=True):
    """Delay of the shutter of ``camera`` relative to its stamps [s], and its standard deviation [s]."""

    camera: str
    offset_s: float
    deviation_s: float


def offset_faults(offsets: Sequence[ShutterOffset], cameras: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Faults of the offsets of a model's ``cameras`` as ``(key, fault)``: each names one of these, once, and is
    bounded.
    """
    for k, offset in enumerate(offsets):
        key = f"shutter_offsets[{k}]"
        if offset.camera not in cameras or any(other.camera == offset.camera for other in offsets[:k]):
            yield key, f"is of camera {offset.camera!r}; once each of {', '.join(cameras)} is valid"
        if not (abs(offset.offset_s) <= LONGEST_OFFSET_S and 0.0 <= offset.deviation_s <= LONGEST_OFFSET_S):
            yield (
                key,
                f"is {offset.offset_s} s ± {offset.deviation_s} s; up to {LONGEST_OFFSET_S:g} s is taken",
            )
