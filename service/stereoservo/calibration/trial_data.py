"""Trial data, the input of a calibration: marker pixels at the stops of motions of single joints, with checks, and the
npz file that stores them.
"""

from __future__ import annotations

import io
import warnings
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from stereoservo.kinematics.model import JointLoads, ModelFileError, check_loads
from stereoservo.messages.cell_file import MAX_CAMERAS, MAX_JOINTS, MAX_MARKERS, Mount
from stereoservo.messages.decoding import decoding
from stereoservo.messages.files import read_bounded, write_atomically
from stereoservo.numerics.archives import read_archive
from stereoservo.numerics.arrays import FloatArray, IntArray

TRIALS_SCHEMA = 1
MAX_TRIALS_BYTES = 1 << 30
LEAST_POSES = 16
"""Number of rest poses from which a model is refined."""
LOADS = "loads_"
STATIC = "static_"
PATHS = "way_"
GENERATORS = "generators"
MAX_POSITION = 1e6
"""Largest plausible joint position [rad or m]."""
MAX_SIGMA, MAX_PIXEL = 0.1, 4.0
"""Largest plausible sigma and pixel coordinate [image sizes]: a wrong detection has smaller ones."""
MAX_OUTSIDE = 0.5
"""Share of a camera's pixels outside its image above which the stated image size counts as wrong."""


class CalibrationError(Exception):
    """A calibration gives no model; the text states the reason, the value and the valid range.

    Attributes:
        code: machine-readable cause: ``bad_data``, ``too_few_cameras``, ``too_few_markers``, ``too_few_stops``,
            ``joint_did_not_move``, ``joint_without_effect``, ``joint_kind``, ``views_degenerate``,
            ``not_identifiable``, ``no_convergence``, ``too_many_outliers``, ``residual_above_floor``, ``mixed_mounts``;
            of the diagnosis ``markers_collinear``, ``encoder_frozen``, ``joints_exchanged``, ``joint_order``,
            ``wrong_scale``, ``views_exchanged``, ``views_unrelated``, ``no_baseline``, ``markers_exchanged``,
            ``noise_understated``, ``marker_slipped``, ``markers_disagree``, ``camera_moved``, ``moved_together``,
            ``camera_or_body_moved``;
            of relocalization ``too_few_points``, ``points_coplanar``, ``not_explained``, ``too_uncertain``.
        data: the values in the message.
    """

    def __init__(self, code: str, message: str, **data: Any) -> None:
        super().__init__(message)
        self.code = code
        self.message = message
        self.data = data


def finite_rows(array: FloatArray) -> npt.NDArray[np.bool_]:
    """Mask (...) of the rows of an array (..., k) that are finite in all k entries."""
    return np.asarray(np.isfinite(array).all(axis=-1), dtype=bool)


class TrialCamera(msgspec.Struct, frozen=True):
    """A camera of the trials and its image size [px].

    ``mount``: ``eye_to_hand`` if it is static and the arm carries the markers, ``eye_in_hand`` for the reverse.
    """

    name: str
    width: int
    height: int
    mount: Mount = "eye_to_hand"


class StaticObservations(msgspec.Struct, frozen=True, eq=False):
    """Observations of static markers, over all stops: ``ids`` (k,), raw ``pixels`` (c, k, 2) [px], NaN if a
    camera does not see one, and ``sigmas`` (c, k) [px].
    """

    ids: tuple[int, ...]
    pixels: FloatArray
    sigmas: FloatArray


class PathObservations(msgspec.Struct, frozen=True, eq=False):
    """Frames and joint samples on the paths between stops.

    Frames: ``ways`` (f,) number of the path, ``cameras`` (f,) index, ``times`` (f,) [s] as stamped, ``markers`` (f, k)
    ids or -1, raw ``pixels`` (f, k, 2), NaN if there is none. Joint samples: ``joint_ways`` (j,), ``joint_times``
    (j,) [s], ``positions`` (j, n).
    """

    ways: IntArray
    cameras: IntArray
    times: FloatArray
    markers: IntArray
    pixels: FloatArray
    joint_ways: IntArray
    joint_times: FloatArray
    positions: FloatArray


class TrialData(msgspec.Struct, frozen=True, eq=False):
    """Stops of trial motions and the camera observations at them.

    Joints are in base-first order. ``positions`` (s, n) [rad or m]; ``trials`` (s,): the joint that moved alone, -1
    for free poses; a base stop may belong to any. ``pixels`` (c, s, m, 2) [px], NaN where a marker was not
    seen; ``sigmas`` (c, s, m) [px], standard deviation per axis of each pixel. The first camera is the left
    one. ``images``: how many images were averaged into the pixels (for the record). ``loads``: the loads
    that the drives reported during the trials, if any; copied into the model. ``static``: markers that do not move.
    ``way``: observations between the stops. ``generators`` (n, 4, 4): Euclidean twists of the joints at positions 0,
    in a static frame [m], if known (`free_arm`); then any motion is permitted.
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
    loads: JointLoads | None = None
    static: StaticObservations | None = None
    way: PathObservations | None = None
    generators: FloatArray | None = None

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """Mask (c, s, m) of the measured pixels."""
        return finite_rows(self.pixels)


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    schema: int
    joint_names: tuple[str, ...]
    joint_kinds: tuple[Literal["revolute", "prismatic"], ...]
    cameras: tuple[TrialCamera, ...]
    marker_ids: tuple[int, ...]
    images: int


def check_trials(trials: TrialData) -> None:
    """Check shapes and numbers. Raises CalibrationError (``bad_data``, ``too_few_cameras``) naming the invalid one."""
    n, m, c = len(trials.joint_names), len(trials.marker_ids), len(trials.cameras)
    s = trials.positions.shape[0] if trials.positions.ndim else 0
    if n < 1 or len(trials.joint_kinds) != n:
        raise CalibrationError(
            "bad_data",
            f"{n} joint names and {len(trials.joint_kinds)} kinds; one kind for each of at least one joint is needed",
        )
    if trials.images < 0:
        raise CalibrationError("bad_data", f"images is {trials.images}; 0 or more is needed", key="images")
    unknown = sorted(set(trials.joint_kinds) - {"revolute", "prismatic"})
    if unknown:
        raise CalibrationError(
            "bad_data",
            f"joint kinds {unknown} are unknown; revolute and prismatic are taken",
            key="joint_kinds",
        )
    if c < 2:
        raise CalibrationError(
            "too_few_cameras",
            f"{c} camera(s); at least 2 that see the markers at once are needed",
            cameras=c,
            minimum=2,
        )
    _check_counts(trials)
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
    if trials.generators is not None:
        _check_generators(trials.generators, n)
    if trials.static is not None:
        _check_static(trials, trials.static)
    if trials.way is not None:
        _check_paths(trials, trials.way)
    if trials.loads is not None:
        try:
            check_loads(trials.loads, n)
        except ModelFileError as error:
            raise CalibrationError("bad_data", str(error), key=error.key) from error
    if not s:
        raise CalibrationError("too_few_stops", "the trials hold no stops; each joint needs some", stops=0)
    if not np.issubdtype(trials.trials.dtype, np.integer):
        raise CalibrationError(
            "bad_data",
            f"trials holds {trials.trials.dtype} numbers; indices of joints, or -1, are needed",
            key="trials",
        )
    if not np.isfinite(trials.positions).all():
        stop = int(np.argwhere(~np.isfinite(trials.positions))[0, 0])
        raise CalibrationError("bad_data", f"positions of stop {stop} are not finite", key="positions", stop=stop)
    if trials.trials.min() < -1 or trials.trials.max() >= n:
        raise CalibrationError(
            "bad_data",
            f"trial indices reach from {trials.trials.min()} to {trials.trials.max()}; -1 to {n - 1} are joints",
            key="trials",
        )
    _check_sizes(trials)
    _check_pixels(trials)


def _check_counts(trials: TrialData) -> None:
    """Check the counts against the size limits of a cell."""
    static = 0 if trials.static is None else len(trials.static.ids)
    for what, count, most in (
        ("joint", len(trials.joint_names), MAX_JOINTS),
        ("camera", len(trials.cameras), MAX_CAMERAS),
        ("marker", len(trials.marker_ids) + static, MAX_MARKERS),
    ):
        if count > most:
            raise CalibrationError(
                "bad_data",
                f"trials of {count} {what}s; a cell has at most {most}",
                key=f"{what}s",
                maximum=most,
            )


def _check_generators(generators: FloatArray, n: int) -> None:
    if generators.shape != (n, 4, 4) or not np.isfinite(generators).all():
        raise CalibrationError(
            "bad_data",
            f"generators of shape {generators.shape}; finite ones of shape {(n, 4, 4)} are needed",
            key="generators",
        )


def _check_static(trials: TrialData, static: StaticObservations) -> None:
    c, k = len(trials.cameras), len(static.ids)
    twice = sorted({i for i in static.ids if static.ids.count(i) > 1 or i in trials.marker_ids})
    if twice:
        raise CalibrationError(
            "bad_data",
            f"static ids {twice} occur twice, or are markers of the arm, too",
            key="static",
            ids=twice,
        )
    if static.pixels.shape != (c, k, 2) or static.sigmas.shape != (c, k):
        raise CalibrationError(
            "bad_data",
            f"static pixels {static.pixels.shape} and sigmas {static.sigmas.shape}; {(c, k, 2)} and {(c, k)} are "
            "needed",
            key="static",
        )
    seen = finite_rows(static.pixels)
    if not (np.isfinite(static.sigmas[seen]).all() and (static.sigmas[seen] > 0.0).all()):
        raise CalibrationError("bad_data", "static sigmas are not all positive numbers", key="static")


def _check_paths(trials: TrialData, paths: PathObservations) -> None:
    f, k, j = len(paths.times), paths.markers.shape[-1] if paths.markers.ndim == 2 else 0, len(paths.joint_times)
    shapes: dict[str, tuple[int, ...]] = {
        "ways": (f,), "cameras": (f,), "times": (f,), "markers": (f, k), "pixels": (f, k, 2), "joint_ways": (j,),
        "joint_times": (j,), "positions": (j, len(trials.joint_names)),
    }  # fmt: skip
    for key, shape in shapes.items():
        array = getattr(paths, key)
        if array.shape != shape:
            raise CalibrationError("bad_data", f"way_{key} has shape {array.shape}; {shape} is needed", key="way")
        if key != "pixels" and not np.isfinite(array).all():
            raise CalibrationError("bad_data", f"way_{key} holds numbers that are not finite", key="way")
    if f and not 0 <= int(paths.cameras.min()) <= int(paths.cameras.max()) < len(trials.cameras):
        raise CalibrationError("bad_data", f"way_cameras: 0 to {len(trials.cameras) - 1} are cameras", key="way")


def _check_sizes(trials: TrialData) -> None:
    for camera in trials.cameras:
        if camera.width < 1 or camera.height < 1:
            raise CalibrationError(
                "bad_data",
                f"camera {camera.name!r}: image size {camera.width}x{camera.height} px is not positive",
                key="cameras",
                camera=camera.name,
            )
    if float(np.abs(trials.positions).max()) > MAX_POSITION:
        stop, joint = np.unravel_index(int(np.abs(trials.positions).argmax()), trials.positions.shape)
        raise CalibrationError(
            "bad_data",
            f"position of joint {trials.joint_names[int(joint)]!r} at stop {stop} is "
            f"{trials.positions[stop, joint]:.6g}; at most {MAX_POSITION:g} [rad or m] is taken",
            key="positions",
            stop=int(stop),
        )


def _check_pixels(trials: TrialData) -> None:
    """Check that sigmas are positive and that pixels lie within their images. Raises CalibrationError."""
    for c, camera in enumerate(trials.cameras):
        size = max(camera.width, camera.height)
        seen = trials.visible[c]
        with np.errstate(invalid="ignore"):
            good = (trials.sigmas[c] > 0.0) & (trials.sigmas[c] <= MAX_SIGMA * size)
            inside = (np.abs(trials.pixels[c]) <= MAX_PIXEL * size).all(axis=-1)
        for key, ok, array, needed in (
            ("sigmas", good, trials.sigmas[c], f"positive ones up to {MAX_SIGMA * size:g} px are needed"),
            ("pixels", inside, trials.pixels[c], f"pixels within {MAX_PIXEL * size:g} px are taken"),
        ):
            if (ok | ~seen).all():
                continue
            stop, marker = (int(i) for i in np.argwhere(seen & ~ok)[0])
            value = ", ".join(f"{number:.6g}" for number in np.atleast_1d(array[stop, marker]))
            raise CalibrationError(
                "bad_data",
                f"{key}: marker {trials.marker_ids[marker]} at stop {stop} in camera {camera.name!r} "
                f"({camera.width}x{camera.height} px) has {value} px; {needed}",
                key=key,
                camera=camera.name,
                stop=stop,
                marker=trials.marker_ids[marker],
            )
        with np.errstate(invalid="ignore"):
            outside = (trials.pixels[c] < -0.5) | (trials.pixels[c] > np.array([camera.width, camera.height]) - 0.5)
        share = float(outside.any(axis=-1)[seen].mean()) if seen.any() else 0.0
        if share > MAX_OUTSIDE:
            raise CalibrationError(
                "bad_data",
                f"{share:.0%} of the pixels of camera {camera.name!r} lie outside its image of {camera.width}x"
                f"{camera.height} px; at most {MAX_OUTSIDE:.0%} are taken. Is its image size the right one?",
                key="pixels",
                camera=camera.name,
                share=share,
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
        **({} if trials.generators is None else {GENERATORS: trials.generators}),  # type: ignore[arg-type]
        **_load_arrays(trials.loads),  # type: ignore[arg-type]
        **_static_arrays(trials.static),  # type: ignore[arg-type]
        **_path_arrays(trials.way),  # type: ignore[arg-type]
    )
    return buffer.getvalue()


def _load_arrays(loads: JointLoads | None) -> dict[str, FloatArray]:
    """Joint loads as separate arrays, which programs without support for them ignore."""
    if loads is None:
        return {}
    given = {field: getattr(loads, field) for field in JointLoads.__struct_fields__}
    return {LOADS + field: array for field, array in given.items() if array is not None}


def _static_arrays(static: StaticObservations | None) -> dict[str, npt.NDArray[Any]]:
    if static is None:
        return {}
    return {
        STATIC + "ids": np.array(static.ids, dtype=np.int64),
        STATIC + "pixels": np.asarray(static.pixels, dtype=np.float64),
        STATIC + "sigmas": np.asarray(static.sigmas, dtype=np.float64),
    }


def _path_arrays(paths: PathObservations | None) -> dict[str, npt.NDArray[Any]]:
    return {} if paths is None else {PATHS + key: getattr(paths, key) for key in PathObservations.__struct_fields__}


def _paths_of(arrays: dict[str, npt.NDArray[Any]]) -> PathObservations | None:
    if PATHS + "times" not in arrays:
        return None
    whole = ("ways", "cameras", "markers", "joint_ways")
    fields: dict[str, Any] = {
        field: arrays[PATHS + field].astype(np.int64 if field in whole else np.float64, casting="same_kind")
        for field in PathObservations.__struct_fields__
    }
    return PathObservations(**fields)


def _static(arrays: dict[str, npt.NDArray[Any]]) -> StaticObservations | None:
    if STATIC + "ids" not in arrays:
        return None
    return StaticObservations(
        tuple(int(i) for i in arrays[STATIC + "ids"]),
        arrays[STATIC + "pixels"].astype(np.float64, casting="same_kind"),
        arrays[STATIC + "sigmas"].astype(np.float64, casting="same_kind"),
    )


def _loads(arrays: dict[str, npt.NDArray[Any]]) -> JointLoads | None:
    fields = {
        key.removeprefix(LOADS): array.astype(np.float64, casting="same_kind")
        for key, array in arrays.items()
        if key.startswith(LOADS)
    }
    return msgspec.convert(fields, JointLoads) if fields else None


def decode_trials(data: bytes, path: Path | str = "<trials>") -> TrialData:
    """Inverse of :func:`encode_trials`. Raises CalibrationError (``bad_data``) for any invalid bytes."""
    with decoding(lambda cause: _bad(path, f"is not a file of trial data: {cause}"), (CalibrationError,)):
        arrays = read_archive(data, MAX_TRIALS_BYTES)
        missing = [name for name in ("header", "positions", "trials", "pixels", "sigmas") if name not in arrays]
        if missing:
            raise ValueError(f"array {missing[0]!r} is missing")
        header = msgspec.json.decode(arrays.pop("header").tobytes(), type=_Header)
        if header.schema != TRIALS_SCHEMA:
            raise _bad(path, f"schema is {header.schema}; this version reads {TRIALS_SCHEMA}")
        trials = TrialData(
            joint_names=header.joint_names,
            joint_kinds=header.joint_kinds,
            cameras=header.cameras,
            marker_ids=header.marker_ids,
            positions=arrays["positions"].astype(np.float64, casting="same_kind"),
            trials=arrays["trials"].astype(np.int64, casting="same_kind"),
            pixels=arrays["pixels"].astype(np.float64, casting="same_kind"),
            sigmas=arrays["sigmas"].astype(np.float64, casting="same_kind"),
            images=header.images,
            loads=_loads(arrays),
            static=_static(arrays),
            way=_paths_of(arrays),
            generators=arrays[GENERATORS].astype(np.float64, casting="same_kind") if GENERATORS in arrays else None,
        )
        try:
            check_trials(trials)
        except CalibrationError as error:
            raise CalibrationError(error.code, f"{path}: {error.message}", **error.data) from error
    return trials


def _bad(path: Path | str, cause: str) -> CalibrationError:
    return CalibrationError("bad_data", f"{path}: {cause}")


def save_trials(trials: TrialData, path: Path) -> None:
    """Write trial data atomically. Raises CalibrationError, OSError."""
    write_atomically(path, encode_trials(trials))


def load_trials(path: Path) -> TrialData:
    """Read and check trial data. Raises CalibrationError (``bad_data``)."""
    with decoding(partial(_bad, path), (CalibrationError,)):
        return decode_trials(read_bounded(path, MAX_TRIALS_BYTES), path)


def trials_file(model_path: Path, epoch: int) -> Path:
    """File of the trial data of the calibration with this epoch."""
    return model_path.with_name(f"trials-{epoch:06d}.npz")


def report_folder(model_path: Path) -> Path:
    """Folder of a model's report; its page is ``index.html``."""
    return model_path.with_name(f"{model_path.stem}-report")


def figures_file(model_path: Path) -> Path:
    """File of the figures of a model's fit, for programs."""
    return model_path.with_name(f"{model_path.stem}-report.json")


# -- static markers --

STATIC_SIGMAS = 5.0
"""Most standard deviations by which a static marker deviates from its median ..."""
STATIC_PX = 0.3
"""... or largest deviation [px], as from a shaking table ..."""
STATIC_SHARE = 0.1
"""... and largest share of the displacement of the marker that moves most."""
MOVING_SHARE = 0.25
"""Share of a camera's stops at which a static marker may be displaced, for example behind the arm."""
STATIC_STOPS = 4
"""Least number of stops at which one camera must see a marker to classify it as static."""


def static_markers(pixels: FloatArray, sigmas: FloatArray) -> npt.NDArray[np.bool_]:
    """Mask (m,) of the markers that are static over all stops. ``pixels`` (c, s, m, 2), NaN where missing.

    ``sigmas`` (c, s, m) [px]. All false if nothing moves.
    """
    seen = np.asarray(np.isfinite(pixels).all(axis=-1))
    count = seen.sum(axis=1)
    known = np.where(seen[..., None], pixels, 0.0)
    mean = known.sum(axis=1) / np.maximum(count, 1)[..., None]
    squares = np.where(seen, ((known - mean[:, None]) ** 2).sum(axis=-1), 0.0).sum(axis=(0, 1))
    total = np.maximum(seen.sum(axis=(0, 1)), 1)
    deviation = np.sqrt(squares / total)
    noise = np.sqrt(2.0 * np.where(seen, sigmas**2, 0.0).sum(axis=(0, 1)) / total)
    noisy = deviation <= np.maximum(STATIC_SIGMAS * noise, STATIC_PX)
    still = noisy & (deviation <= STATIC_SHARE * deviation.max(initial=0.0))
    return np.asarray(still & (count.max(axis=0) >= STATIC_STOPS))


def static_observations(
    ids: tuple[int, ...], pixels: FloatArray, sigmas: FloatArray
) -> tuple[StaticObservations | None, tuple[int, ...]]:
    """Mean observations of markers ``ids`` (k,) that are stated to be static, and the ids of those that moved.

    ``pixels`` (c, s, k, 2) of all stops, NaN where missing, and ``sigmas`` (c, s, k) [px]. In each camera it is the
    median over the stops, so that a stop at which the arm covers half of a marker has no effect; its sigma is that of
    one stop, since systematic errors do not average out. A marker that deviates from its median at more than a quarter
    of a camera's stops has moved, and is left out.
    """
    seen = np.asarray(np.isfinite(pixels).all(axis=-1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a marker that a camera never sees stays NaN
        mean = np.nanmedian(pixels, axis=1)
        sigma = np.nanmedian(np.where(seen, sigmas, np.nan), axis=1)
    away = np.linalg.norm(pixels - mean[:, None], axis=-1)
    moving = seen & (away > np.maximum(STATIC_SIGMAS * np.sqrt(2.0) * sigma, STATIC_PX)[:, None])
    moved = (moving.sum(axis=1) > MOVING_SHARE * np.maximum(seen.sum(axis=1), 1)).any(axis=0)
    kept = ~moved & seen.any(axis=(0, 1))
    named = tuple(marker for marker, one in zip(ids, moved, strict=True) if one)
    if not kept.any():
        return None, named
    left = tuple(marker for marker, one in zip(ids, kept, strict=True) if one)
    return StaticObservations(left, mean[:, kept], sigma[:, kept]), named
