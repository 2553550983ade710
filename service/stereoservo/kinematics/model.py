"""The model of a cell: what self-calibration learns and the core works with; one versioned file."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

MODEL_SCHEMA = 2
READABLE_SCHEMAS = (1, 2)
"""Schema 1 knew neither lenses nor mounts: pinholes that stand still."""

Stratum = Literal["projective", "affine", "metric"]
Mount = Literal["eye_to_hand", "eye_in_hand"]


def pinhole() -> FloatArray:
    """The lens (4,) of a camera without distortion (`stereoservo.geometry.distortion`)."""
    return np.array([0.0, 0.0, 0.0, 1.0])


class CameraModel(msgspec.Struct, frozen=True, eq=False):
    """A camera in the model's projective frame: ``matrix`` (3, 4) maps points to ideal pixels; image size [px].

    ``lens`` (4,): radial distortion ``(k, cu, cv, r0)`` from ideal to raw pixels, see `geometry.distortion`.
    """

    name: str
    matrix: FloatArray
    width: int
    height: int
    lens: FloatArray = msgspec.field(default_factory=pinhole)


class JointStatistics(msgspec.Struct, frozen=True):
    """How well one joint's trial motion fits: residual rms [px], number of stops, range driven [rad or m]."""

    name: str
    rms_px: float
    stops: int
    range: float


class FitStatistics(msgspec.Struct, frozen=True, eq=False):
    """Statistics of the final least-squares fit.

    ``chi2`` is the sum of squared residuals in sigmas, with ``degrees_of_freedom`` = measurements -
    parameters net of gauge; ``chi2_ok``: inside the two-sided 99.9 % interval.
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


class CellModel(msgspec.Struct, frozen=True, eq=False):
    """Projective kinematics, cameras and markers in one projective frame.

    ``generators`` (n, 4, 4): joint operators at ``zero`` (n,), revolute ones with eigenvalues (0, 0, i, -i),
    prismatic ones nilpotent (5.18). ``marker_points`` (m, 4): markers at the zero, orbital heights such that
    ``plane_at_infinity @ M == 1``. ``projective_to_euclidean`` (4, 4): H_PE up to one global scale, where the
    stratum is ``metric``. ``mount``: of all its cameras; eye-in-hand chains
    are ``tip_first``. ``epoch`` is unique for each model a cell ever had.

    Stratum ``projective``: the plane at infinity is not identifiable (all axes parallel, say);
    ``plane_at_infinity`` is then the least singular vector of (5.59): joints keep the heights ``a @ M`` that
    it gives, but parallelism must not be read from it.
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

    @property
    def tip_first(self) -> bool:
        """The order of the chain's factors: see `kinematics.chain.ProjectiveChain`."""
        return self.mount == "eye_in_hand"


class ModelFileError(Exception):
    """A model, or a model file, does not fit.

    Attributes:
        path: the file, or ``"<model>"`` for a model in memory.
        key: the field that does not fit; empty where it is the file as a whole.
    """

    def __init__(self, path: Path | str, key: str, message: str) -> None:
        super().__init__(f"{path}: {key + ': ' if key else ''}{message}")
        self.path = str(path)
        self.key = key


ALGEBRA_TOLERANCE = 1e-6
"""Largest relative defect of ``Ĥ³ + Ĥ`` (revolute) or ``Ĥ²`` (prismatic) that a model may have."""


def check_model(model: CellModel, path: Path | str = "<model>") -> None:
    """Check shapes, finiteness and the algebra of a model.

    Raises ModelFileError naming the field, its value and what would have been valid.
    """
    if model.schema != MODEL_SCHEMA:
        raise ModelFileError(path, "schema", f"is {model.schema!r}; this version reads {MODEL_SCHEMA}")
    if model.epoch < 0:
        raise ModelFileError(path, "epoch", f"is {model.epoch}; a model's epoch is 0 or more")
    n, m = len(model.joint_names), len(model.marker_ids)
    if n < 1:
        raise ModelFileError(path, "joint_names", "is empty; a model has at least one joint")
    if m < 1:
        raise ModelFileError(path, "marker_ids", "is empty; a model has at least one marker")
    if not model.cameras:
        raise ModelFileError(path, "cameras", "is empty; a model has at least one camera")
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
        *((f"cameras[{i}].lens", camera.lens, (4,)) for i, camera in enumerate(model.cameras)),
    ]
    if model.projective_to_euclidean is not None:
        arrays.append(("projective_to_euclidean", model.projective_to_euclidean, (4, 4)))
    for key, array, shape in arrays:
        if array.shape != shape:
            raise ModelFileError(path, key, f"has shape {array.shape}; {shape} is needed")
        if not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise ModelFileError(path, key, f"entry {where} is {array[where]}; finite numbers are needed")
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
    _check_algebra(model, path)


def _check_algebra(model: CellModel, path: Path | str) -> None:
    for j, (kind, generator) in enumerate(zip(model.joint_kinds, model.generators, strict=True)):
        size = float(np.linalg.norm(generator))
        square = generator @ generator
        defect = square @ generator + generator if kind == "revolute" else square
        limit = ALGEBRA_TOLERANCE * max(size, size**3 if kind == "revolute" else size**2)
        if size == 0 or float(np.linalg.norm(defect)) > limit:
            law = "Ĥ³ = -Ĥ" if kind == "revolute" else "Ĥ² = 0"
            raise ModelFileError(
                path,
                f"generators[{j}]",
                f"joint {model.joint_names[j]!r} is {kind} but "
                f"‖{law.replace(' = ', ' - ').replace('- -', '+ ')}‖ is {np.linalg.norm(defect):.2e} with "
                f"‖Ĥ‖ {size:.2e}; {law} is needed",
            )
    heights = model.marker_points @ model.plane_at_infinity
    if np.abs(heights - 1).max() > ALGEBRA_TOLERANCE:
        worst = int(np.abs(heights - 1).argmax())
        raise ModelFileError(
            path,
            f"marker_points[{worst}]",
            f"marker {model.marker_ids[worst]}: plane_at_infinity @ M is {heights[worst]:.6g}; 1 is needed",
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
    """A model as one JSON object, arrays as nested lists with every bit of a float64. Raises
    ModelFileError.
    """
    check_model(model)
    return msgspec.json.format(msgspec.json.encode(model, enc_hook=_encode_array), indent=1) + b"\n"


def decode_model(data: bytes, path: Path | str = "<model>") -> CellModel:
    """Inverse of :func:`encode_model`, strictly. Raises ModelFileError."""
    try:
        tree = msgspec.json.decode(data)
    except msgspec.DecodeError as error:
        raise ModelFileError(path, "", f"is not JSON: {error}") from error
    if not isinstance(tree, dict):
        raise ModelFileError(path, "", f"holds a {type(tree).__name__}; a JSON object is needed")
    if tree.get("schema") not in READABLE_SCHEMAS:
        known = " and ".join(str(schema) for schema in READABLE_SCHEMAS)
        raise ModelFileError(path, "schema", f"is {tree.get('schema')!r}; this version reads {known}")
    tree["schema"] = MODEL_SCHEMA
    try:
        model = msgspec.convert(tree, CellModel, dec_hook=_decode_array)
    except (msgspec.ValidationError, TypeError) as error:
        text, _, where = str(error).partition(" - at `")
        raise ModelFileError(path, where.rstrip("`").removeprefix("$").lstrip("."), text) from error
    check_model(model, path)
    return model


def save_model(model: CellModel, path: Path) -> None:
    """Write a model file, whole or not at all. Raises ModelFileError, OSError."""
    write_atomically(path, encode_model(model))


def load_model(path: Path) -> CellModel:
    """Read and check a model file. Raises ModelFileError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelFileError(path, "", f"cannot be read: {error.strerror}") from error
    return decode_model(data, path)


def write_atomically(path: Path, data: bytes) -> None:
    """Write ``data`` so that a reader, or a crash, sees the old file or the new one whole. Raises OSError."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes 0600; a model is no secret and other users' tools read it.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
