"""What a calibration starts from: pixels of the markers at stops of joint-wise trial motions; one npz
file.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.model import Mount, write_atomically

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

TRIALS_SCHEMA = 1


class CalibrationError(Exception):
    """A calibration cannot give a model; the text says why, with the value and what would have been valid.

    Attributes:
        code: machine-readable cause: ``bad_data``, ``too_few_cameras``, ``too_few_markers``,
            ``too_few_stops``,
            ``joint_did_not_move``, ``joint_without_effect``, ``joint_kind``, ``views_degenerate``,
            ``not_identifiable``, ``no_convergence``, ``too_many_outliers``, ``residual_above_floor``, ``mixed_mounts``;
            of the diagnosis ``markers_collinear``, ``encoder_frozen``, ``joints_exchanged``, ``joint_order``,
            ``wrong_scale``, ``views_exchanged``, ``views_unrelated``, ``no_baseline``, ``markers_exchanged``,
            ``marker_slipped``, ``markers_disagree``, ``camera_moved``, ``moved_together``.
        data: the values the message speaks of.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.data = data


def finite_rows(array: FloatArray) -> npt.NDArray[np.bool_]:
    """Which rows (...) of an array (..., k) are finite in all k entries."""
    return np.asarray(np.isfinite(array).all(axis=-1), dtype=bool)


class TrialCamera(msgspec.Struct, frozen=True):
    """A camera of the trials and its image size [px].

    ``mount``: ``eye_to_hand`` where it stands and the arm carries the markers, ``eye_in_hand`` the other way round.
    """

    name: str
    width: int
    height: int
    mount: Mount = "eye_to_hand"


class TrialData(msgspec.Struct, frozen=True, eq=False):
    """Stops of trial motions and what the cameras saw there.

    Joints stand base first. ``positions`` (s, n) [rad or m]; ``trials`` (s,): the joint that moved alone, -1
    for free poses; a base stop may belong to any. ``pixels`` (c, s, m, 2) [px], NaN where a marker was not
    seen; ``sigmas`` (c, s, m) [px], standard deviation an axis of each pixel. The first camera is the left
    one. ``images``: how many images were averaged into the pixels (for the record).
    """

    joint_names: tuple[str, ...]
    joint_kinds: tuple[Literal["revolute", "prismatic"], ...]
    cameras: tuple[TrialCamera, ...]
    marker_ids: tuple[int, ...]
    positions: FloatArray
    trials: IntArray
    pixels: FloatArray
    sigmas: FloatArray
    images: int = 0

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """(c, s, m): which pixels were measured."""
        return finite_rows(self.pixels)


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    schema: int
    joint_names: tuple[str, ...]
    joint_kinds: tuple[Literal["revolute", "prismatic"], ...]
    cameras: tuple[TrialCamera, ...]
    marker_ids: tuple[int, ...]
    images: int


def check_trials(trials: TrialData) -> None:
    """Check shapes and numbers. Raises CalibrationError (``bad_data``, ``too_few_cameras``) with what does
    not fit.
    """
    n, m, c = len(trials.joint_names), len(trials.marker_ids), len(trials.cameras)
    s = trials.positions.shape[0] if trials.positions.ndim else 0
    if n < 1 or len(trials.joint_kinds) != n:
        raise CalibrationError(
            "bad_data",
            f"{n} joint names and {len(trials.joint_kinds)} kinds; one kind for each of at least one joint "
            "is needed",
        )
    if c < 2:
        raise CalibrationError(
            "too_few_cameras",
            f"{c} camera(s); at least 2 that see the markers at once are needed",
            cameras=c,
            minimum=2,
        )
    for what, names in (
        ("joint", trials.joint_names),
        ("camera", tuple(camera.name for camera in trials.cameras)),
        ("marker", trials.marker_ids),
    ):
        if len(set(names)) < len(names):
            raise CalibrationError("bad_data", f"{what} names {names} are not all different")
    expected: list[tuple[str, npt.NDArray[Any], tuple[int, ...]]] = [
        ("positions", trials.positions, (s, n)),
        ("trials", trials.trials, (s,)),
        ("pixels", trials.pixels, (c, s, m, 2)),
        ("sigmas", trials.sigmas, (c, s, m)),
    ]
    for key, array, shape in expected:
        if array.shape != shape:
            raise CalibrationError("bad_data", f"{key} has shape {array.shape}; {shape} is needed", key=key)
    if not np.isfinite(trials.positions).all():
        stop = int(np.argwhere(~np.isfinite(trials.positions))[0, 0])
        raise CalibrationError(
            "bad_data", f"positions of stop {stop} are not finite", key="positions", stop=stop
        )
    if s and (trials.trials.min() < -1 or trials.trials.max() >= n):
        raise CalibrationError(
            "bad_data",
            f"trial indices reach from {trials.trials.min()} to {trials.trials.max()}; -1 to {n - 1} are "
            "joints",
            key="trials",
        )
    sigmas = trials.sigmas[trials.visible]
    if not (np.isfinite(sigmas).all() and (sigmas > 0).all()):
        worst = sigmas[~(np.isfinite(sigmas) & (sigmas > 0))][0]
        raise CalibrationError(
            "bad_data", f"a sigma is {worst} px; positive finite ones are needed", key="sigmas"
        )


def encode_trials(trials: TrialData) -> bytes:
    """Trial data as npz bytes: a JSON header and four arrays. Raises CalibrationError (``bad_data``)."""
    check_trials(trials)
    header = _Header(
        schema=TRIALS_SCHEMA,
        joint_names=trials.joint_names,
        joint_kinds=trials.joint_kinds,
        cameras=trials.cameras,
        marker_ids=trials.marker_ids,
        images=trials.images,
    )
    buffer = io.BytesIO()
    np.savez(
        buffer,
        header=np.frombuffer(msgspec.json.encode(header), dtype=np.uint8),
        positions=np.asarray(trials.positions, dtype=np.float64),
        trials=np.asarray(trials.trials, dtype=np.int64),
        pixels=np.asarray(trials.pixels, dtype=np.float64),
        sigmas=np.asarray(trials.sigmas, dtype=np.float64),
    )
    return buffer.getvalue()


def decode_trials(data: bytes, path: Path | str = "<trials>") -> TrialData:
    """Inverse of :func:`encode_trials`. Raises CalibrationError (``bad_data``) naming what does not fit."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        header = msgspec.json.decode(arrays.pop("header").tobytes(), type=_Header)
        if header.schema != TRIALS_SCHEMA:
            raise CalibrationError(
                "bad_data", f"{path}: schema is {header.schema}; this version reads {TRIALS_SCHEMA}"
            )
        trials = TrialData(
            joint_names=header.joint_names,
            joint_kinds=header.joint_kinds,
            cameras=header.cameras,
            marker_ids=header.marker_ids,
            positions=np.asarray(arrays["positions"], dtype=np.float64),
            trials=np.asarray(arrays["trials"], dtype=np.int64),
            pixels=np.asarray(arrays["pixels"], dtype=np.float64),
            sigmas=np.asarray(arrays["sigmas"], dtype=np.float64),
            images=header.images,
        )
    except (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile, msgspec.DecodeError) as error:
        raise CalibrationError("bad_data", f"{path}: is not a file of trial data: {error}") from error
    check_trials(trials)
    return trials


def save_trials(trials: TrialData, path: Path) -> None:
    """Write trial data, whole or not at all. Raises CalibrationError, OSError."""
    write_atomically(path, encode_trials(trials))


def load_trials(path: Path) -> TrialData:
    """Read and check trial data. Raises CalibrationError (``bad_data``)."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CalibrationError("bad_data", f"{path}: cannot be read: {error.strerror}") from error
    return decode_trials(data, path)
