"""Where the markers are now: kinematic prediction (8.35), corrected by what each camera saw at its own stamp.

Cameras speak in raw pixels. Here they become ideal ones, in which everything behind is linear in homogeneous
coordinates; priors leave in raw pixels again.

The innovation of a marker is observed minus predicted pixel at the frame's shutter time, with the joints interpolated
from a short history; no trigger is needed. It is gated statistically, filtered, and carried to the present by the
kinematics, so that between frames, and through a dropped camera, the prediction carries the loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np

from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import HISTORY, CameraEstimate, JointHistory
from stereoservo.geometry.cameras import camera_centre
from stereoservo.kinematics.kernels import (
    chain_forward,
    distort_expected,
    image_jacobian,
    invert4,
    multiply4_into,
    project_points,
    transform_points,
    triangulate,
    undistort_sights,
)
from stereoservo.kinematics.model import CellModel
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray, KindArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import damped_least_squares
from stereoservo.ports.devices import CameraObservation, Prior

MODEL_SIGMA_PX = 0.3  # what a good model may be off by at any pose
TIMING_SIGMA_S = 0.003  # uncertainty of a shutter stamp against the joint stamps
FIRST_SIGHT_SIGMA_PX = 6.0  # before a marker's innovation is known
CORRECTION_DAMPING = 1e-4  # relative to the largest diagonal of the normal matrix
UNKNOWN_NS = 100_000_000
"""A frame that is so much later than the newest joint sample (drives that are silent) is compared with nothing."""
SUSPECT_FRAMES = 8  # refused ones in a row, of one camera
TRUSTED_FRAMES = 30  # agreeing ones in a row, of every camera
AGREEING_PX = 1.5


@dataclass(frozen=True)
class ModelArrays:
    """A model as the kernels take it, in the order of the core's cameras and the model's markers."""

    generators: FloatArray
    kinds: np.ndarray[tuple[int], np.dtype[np.uint8]]
    zero: FloatArray
    tip_first: bool
    matrices: FloatArray
    lenses: FloatArray
    marker_points: FloatArray
    plane_at_infinity: FloatArray
    camera_centres: FloatArray
    metric_basis: FloatArray | None
    """Six twists (6, 4, 4) that span all displacements, where the model is metric."""
    marker_ids: tuple[int, ...]
    index: dict[int, int]
    scene_ids: tuple[int, ...]
    scene_points: FloatArray
    scene_pixels: FloatArray
    """Static points in the images (c, s, 2): they never move there."""
    rows: dict[int, int]
    """Rows of `FrameSights`: the markers, then the static points."""


def model_arrays(model: CellModel, settings: CoreSettings) -> ModelArrays:
    """Kernel arrays of ``model``. Raises ValueError naming what does not fit the cell."""
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
    matrices = np.ascontiguousarray(
        [by_name[camera.name].matrix for camera in settings.cameras], dtype=np.float64
    )
    centres = np.array([camera_centre(P) for P in matrices])
    scene = np.ascontiguousarray(model.scene_points, dtype=np.float64).reshape(-1, 4)
    scene_pixels, _ = project_points(matrices, scene)
    return ModelArrays(
        generators=np.ascontiguousarray(model.generators, dtype=np.float64),
        kinds=np.array([kind == "prismatic" for kind in model.joint_kinds], dtype=np.uint8),
        zero=np.ascontiguousarray(model.zero, dtype=np.float64),
        tip_first=model.tip_first,
        matrices=matrices,
        lenses=np.array([by_name[camera.name].lens for camera in settings.cameras], dtype=np.float64),
        marker_points=np.ascontiguousarray(model.marker_points, dtype=np.float64),
        plane_at_infinity=np.ascontiguousarray(model.plane_at_infinity, dtype=np.float64),
        camera_centres=with_unit_height(centres, model.plane_at_infinity),
        metric_basis=_metric_basis(model),
        marker_ids=model.marker_ids,
        index={marker: i for i, marker in enumerate(model.marker_ids)},
        scene_ids=model.scene_ids,
        scene_points=scene,
        scene_pixels=scene_pixels,
        rows={marker: i for i, marker in enumerate((*model.marker_ids, *model.scene_ids))},
    )


def _metric_basis(model: CellModel) -> FloatArray | None:
    """Translations along, and rotations about, three axes through the markers' middle, in the projective frame."""
    H = model.projective_to_euclidean
    if H is None:
        return None
    inverse = invert4(np.ascontiguousarray(H, dtype=np.float64))
    euclidean = transform_points(np.ascontiguousarray(H), np.ascontiguousarray(model.marker_points))
    middle = (euclidean[:, :3] / euclidean[:, 3:]).sum(axis=0) / float(len(euclidean))
    size = float(np.sqrt(((euclidean[:, :3] / euclidean[:, 3:] - middle) ** 2).sum(axis=-1).max()))
    basis = np.zeros((6, 4, 4))
    for k in range(3):
        basis[k, k, 3] = size
        i, j = (k + 1) % 3, (k + 2) % 3
        basis[3 + k, j, i], basis[3 + k, i, j] = 1.0, -1.0
        basis[3 + k, j, 3], basis[3 + k, i, 3] = -middle[i], middle[j]
    for k in range(6):  # H⁻¹ T̂ H, by explicit loops
        basis[k] = _product(inverse, _product(basis[k], H))
    return basis


def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    product = np.empty((4, 4))
    multiply4_into(np.ascontiguousarray(A), np.ascontiguousarray(B), product)
    return product


@dataclass(frozen=True)
class Prediction:
    """Markers by kinematics alone at one configuration: operators (5.21), points, ideal pixels, their Jacobian."""

    operators: FloatArray
    points: FloatArray
    pixels: FloatArray
    jacobian: FloatArray


def chain_at(arrays: ModelArrays, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``H(q)`` (4, 4) of the markers and the operators at ``q`` (n, 4, 4) (5.18, 5.21), however cameras are mounted."""
    found: tuple[FloatArray, FloatArray] = chain_forward(
        arrays.generators, arrays.kinds, arrays.zero, np.ascontiguousarray(q), arrays.tip_first
    )
    return found


def predict(arrays: ModelArrays, q: FloatArray) -> Prediction:
    """Bring the projective kinematics to ``q`` (5.21) and predict every marker in every camera (8.35)."""
    return Prediction(
        *_predict(
            arrays.generators, arrays.kinds, arrays.zero, np.ascontiguousarray(q), arrays.tip_first,
            arrays.marker_points, arrays.matrices,
        )
    )  # fmt: skip


@kernel
def _predict(
    generators: FloatArray, kinds: KindArray, zero: FloatArray, q: FloatArray, tip_first: bool,
    marker_points: FloatArray, matrices: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """The fields of a `Prediction`."""
    H, operators = chain_forward(generators, kinds, zero, q, tip_first)
    points = transform_points(H, marker_points)
    pixels, _ = project_points(matrices, points)
    return operators, points, pixels, image_jacobian(operators, matrices, points)


@kernel
def _body_points(
    generators: FloatArray, kinds: KindArray, zero: FloatArray, q: FloatArray, tip_first: bool,
    marker_points: FloatArray,
) -> FloatArray:  # fmt: skip
    """The markers (m, 4) at ``q``."""
    H, _ = chain_forward(generators, kinds, zero, q, tip_first)
    return transform_points(H, marker_points)


@kernel
def _joint_step(
    jacobian: FloatArray, residual: FloatArray, weights: FloatArray, damping: float
) -> FloatArray:
    """Damped least-squares step (n,) for residuals (k,) with ``weights`` (k,)."""
    step, _ = damped_least_squares(jacobian, residual, weights, damping)
    return step


def joints_at(history: JointHistory, t_ns: int) -> FloatArray | None:
    """Joint positions at ``t_ns`` by linear interpolation; None when the history does not reach there.

    Past the newest sample it extrapolates by up to the last sample interval; ``UNKNOWN_NS`` past it, nobody knows.
    """
    filled = min(history.count, HISTORY)
    if filled < 2:
        return None
    newest = history.count - 1
    if t_ns - int(history.t_ns[newest % HISTORY]) > UNKNOWN_NS:
        return None
    for back in range(filled - 1):
        later, earlier = (newest - back) % HISTORY, (newest - back - 1) % HISTORY
        t1, t0 = int(history.t_ns[later]), int(history.t_ns[earlier])
        if t_ns < t0:
            continue
        if t1 == t0:
            t0 -= 1  # one and the same moment: the later sample
        fraction = min((t_ns - t0) / (t1 - t0), 2.0)
        a, b = history.positions[earlier], history.positions[later]
        found: FloatArray = a + fraction * (b - a)
        return found
    return None


def motion_at(history: JointHistory, t_ns: int) -> FloatArray | None:
    """Joint velocities (n,) at ``t_ns``, of the samples around it; None where only samples of before tell of it.

    What the arm did since its last sample is known for one interval; of a driver's silence nothing is known.
    """
    filled = min(history.count, HISTORY)
    newest = history.count - 1
    for back in range(filled - 1):
        later, earlier = (newest - back) % HISTORY, (newest - back - 1) % HISTORY
        t1, t0 = int(history.t_ns[later]), int(history.t_ns[earlier])
        if t_ns < t0 or t1 == t0:
            continue
        if t_ns > 2 * t1 - t0 or t1 - t0 > UNKNOWN_NS:
            return None
        found: FloatArray = (history.positions[later] - history.positions[earlier]) / ((t1 - t0) * 1e-9)
        return found
    return None


def ideal_observation(arrays: ModelArrays, camera: int, observation: CameraObservation) -> CameraObservation:
    """An observation in ideal pixels; sights that the camera's lens cannot have made are left out."""
    lens = arrays.lenses[camera]
    if lens[0] == 0.0:
        return observation
    pixels, covariances, seen = undistort_sights(
        lens,
        np.array(observation.pixels, dtype=np.float64),
        np.array(observation.covariances, dtype=np.float64),
    )
    return msgspec.structs.replace(
        observation, ids=observation.ids[seen], pixels=pixels[seen], covariances=covariances[seen]
    )


@dataclass(frozen=True)
class FrameResiduals:
    """One frame against the prediction at its shutter, k rows: the model's markers, then its static points.

    ``innovation`` (k, 2) [px], its covariance ``spread`` (k, 2, 2) by detector and timing, ``noise`` (k,) [px²] of a
    coordinate by the detector alone, what was ``seen`` (k,), and the ``velocity`` (k, 2) [px/s] by the joints.
    """

    t_shutter_ns: int
    innovation: FloatArray
    spread: FloatArray
    noise: FloatArray
    seen: BoolArray
    velocity: FloatArray


def frame_sights(
    arrays: ModelArrays,
    camera: int,
    observation: CameraObservation,
    prediction: Prediction,
    speed: FloatArray,
) -> FrameResiduals:
    """Innovations of an observation in ideal pixels against the ``prediction`` at its shutter.

    ``speed`` (n,): of the joints then.
    """
    rows = np.array([arrays.rows.get(int(i), -1) for i in observation.ids], dtype=np.int64)
    standing = np.zeros((len(arrays.scene_ids), *prediction.jacobian.shape[2:]))
    innovation, spread, seen, velocity = innovations(
        rows, np.ascontiguousarray(observation.pixels), np.ascontiguousarray(observation.covariances),
        np.concatenate((prediction.pixels[camera], arrays.scene_pixels[camera])),
        np.concatenate((prediction.jacobian[camera], standing)), speed, TIMING_SIGMA_S,
    )  # fmt: skip
    noise = np.ones(seen.size)
    for k, row in enumerate(rows):
        if row >= 0:
            noise[row] = 0.5 * (observation.covariances[k, 0, 0] + observation.covariances[k, 1, 1])
    return FrameResiduals(observation.t_shutter_ns, innovation, spread, noise, seen, velocity)


def accept_sights(
    estimate: CameraEstimate, sights: FrameResiduals, used: BoolArray, settings: CoreSettings
) -> None:
    """Gate one frame and fold it into the camera's estimate; markers that are not ``used`` (m,) are left out.

    The gate is chi-square with two freedoms on the deviation from the filtered innovation, with the covariances of
    detector, timing and model. Near the gate a sight counts less: in the filter, and in triangulation by its sigma.
    """
    m = used.size
    accepted, rejected, squares = fold_in(
        sights.innovation[:m], sights.spread[:m], sights.seen[:m] & used, sights.noise[:m], sights.t_shutter_ns,
        estimate.innovation, estimate.sigma, estimate.seen_ns,
        settings.limits.coast_s + 1.0, settings.filter_s, gate_threshold(settings.gate_sigma), MODEL_SIGMA_PX,
        FIRST_SIGHT_SIGMA_PX,
    )  # fmt: skip
    estimate.last_visible = accepted
    estimate.frames += 1
    estimate.rms_px = float(np.sqrt(squares / (2 * accepted))) if accepted else 0.0
    agrees = accepted >= 3 and rejected == 0 and estimate.rms_px < AGREEING_PX
    estimate.agreeing_frames = estimate.agreeing_frames + 1 if agrees else 0
    estimate.rejected_frames = estimate.rejected_frames + 1 if rejected > accepted else 0
    if accepted >= 3:
        estimate.accepted_ns = sights.t_shutter_ns


def marker_weights(cameras: list[CameraEstimate], now_ns: int, coast_s: float) -> FloatArray:
    """(c, m) 1/sigma [1/px] of markers that a camera saw within ``coast_s``, 0 elsewhere."""
    limit = int(coast_s * 1e9) + 50_000_000
    return np.array(
        [
            np.where((e.seen_ns > 0) & (now_ns - e.seen_ns <= limit), 1.0 / np.maximum(e.sigma, 1e-3), 0.0)
            for e in cameras
        ]
    )


def pixels_now(prediction: Prediction, cameras: list[CameraEstimate]) -> FloatArray:
    """(c, m, 2) where the markers are now: prediction plus held innovation [px]."""
    found: FloatArray = prediction.pixels + np.array([e.innovation for e in cameras])
    return found


def joint_correction(
    prediction: Prediction, cameras: list[CameraEstimate], weights: FloatArray
) -> FloatArray:
    """Joint-space correction (n,) that explains the innovations best, so that corrected points stay one rigid body."""
    n = prediction.operators.shape[0]
    innovation = np.array([e.innovation for e in cameras])
    row_weights = np.repeat(weights.reshape(-1), 2)
    correction: FloatArray = _joint_step(
        prediction.jacobian.reshape(-1, n), innovation.reshape(-1), row_weights, CORRECTION_DAMPING
    )
    return correction


def points_now(
    arrays: ModelArrays, q: FloatArray, prediction: Prediction, pixels: FloatArray, weights: FloatArray,
    correction: FloatArray, source: str,
) -> FloatArray:  # fmt: skip
    """Marker points (m, 4) with heights a∞ᵀM = 1: ``predicted`` (8.35) or ``triangulated`` (8.34).

    Predicted points are those of the joints plus correction. A marker that fewer than two cameras see cannot be
    triangulated: its predicted point stands in.
    """
    points: FloatArray = _body_points(
        arrays.generators, arrays.kinds, arrays.zero, q + correction, arrays.tip_first, arrays.marker_points
    )
    if source == "triangulated":
        found, ok = triangulate(arrays.matrices, pixels, weights, 3)
        points = np.where(ok[:, None], with_unit_height(found, arrays.plane_at_infinity), points)
    return points


def with_unit_height(points: FloatArray, plane_at_infinity: FloatArray) -> FloatArray:
    """Points (m, 4) scaled to a∞ᵀM = 1, so that differences and middles mean something (errata, orbital height)."""
    height = (points * plane_at_infinity).sum(axis=-1)
    return points / np.where(height == 0.0, 1.0, height)[:, None]


def priors(
    arrays: ModelArrays, settings: CoreSettings, prediction: Prediction, cameras: list[CameraEstimate],
    velocities: FloatArray, now_ns: int, unknown: tuple[str, ...] = (),
) -> tuple[Prior, ...]:  # fmt: skip
    """One prior a camera for the detectors' windows, raw; covariance from model and motion, never fed back.

    None for cameras of whose place nothing is known: their detectors look in the whole image.
    """
    ids: IntArray = np.array(arrays.marker_ids, dtype=np.int64)
    found = []
    for camera, estimate in enumerate(cameras):
        if settings.cameras[camera].name in unknown:
            continue
        speed = (prediction.jacobian[camera] * velocities).sum(axis=-1)
        fresh = (now_ns - estimate.seen_ns <= 1_000_000_000) & (estimate.seen_ns > 0)
        sigma = np.where(fresh, 1.0, FIRST_SIGHT_SIGMA_PX) + TIMING_SIGMA_S * np.abs(speed).max(axis=-1)
        covariance = np.zeros((ids.size, 2, 2))
        covariance[:, 0, 0] = covariance[:, 1, 1] = sigma * sigma
        pixels = prediction.pixels[camera] + np.where(fresh[:, None], estimate.innovation, 0.0)
        prior = Prior(settings.cameras[camera].name, now_ns, ids, pixels, speed, covariance)
        found.append(_raw_prior(prior, arrays.lenses[camera]))
    return tuple(found)


def _raw_prior(prior: Prior, lens: FloatArray) -> Prior:
    """A prior as the camera's lens shows it; markers beyond its fold are left out."""
    if lens[0] == 0.0:
        return prior
    pixels, velocities, covariances, seen = distort_expected(
        lens, prior.pixels, prior.velocities, prior.covariances
    )
    return msgspec.structs.replace(
        prior,
        ids=prior.ids[seen],
        pixels=pixels[seen],
        velocities=velocities[seen],
        covariances=covariances[seen],
    )


HUBER = 2.5
"""Mahalanobis distance up to which a sight has its full weight: 4 % of good ones lie beyond."""
FAR_SIGMA = 30.0


@lru_cache(maxsize=16)
def gate_threshold(sigmas: float) -> float:
    """Squared distance that two Gaussian coordinates exceed as rarely as one exceeds ``sigmas`` standard deviations.

    The quantile of chi-square with two freedoms, ``-2 log(1 - p)``; far out its asymptote.
    """
    if sigmas >= FAR_SIGMA:
        return sigmas * sigmas + 2.0 * math.log(sigmas * math.sqrt(0.5 * math.pi))
    return -2.0 * math.log(math.erfc(sigmas / math.sqrt(2.0)))


@kernel
def distance2(x: float, y: float, a: float, b: float, c: float) -> float:
    """``vᵀ S⁻¹ v`` of ``v = (x, y)`` and ``S = [[a, b], [b, c]]``; infinite where S is not positive."""
    determinant = a * c - b * b
    if not determinant > 0.0:
        return math.inf
    return (c * x * x - 2.0 * b * x * y + a * y * y) / determinant


@kernel
def innovations(
    rows: IntArray, pixels: FloatArray, covariances: FloatArray, predicted: FloatArray, jacobian: FloatArray,
    speed: FloatArray, timing_s: float,
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:  # fmt: skip
    """Of each marker of the model: observed less ``predicted`` (m, 2) [px], its covariance (m, 2, 2) by detector and
    timing, whether it was seen (m,), and its velocity (m, 2) [px/s].

    ``rows`` (k,): the model's marker of each sight, or -1. ``jacobian`` (m, 2, n), ``speed`` (n,): what a shutter
    stamp that is off by ``timing_s`` [s] moves.
    """
    m, n = jacobian.shape[0], jacobian.shape[2]
    innovation, spread, velocity = np.zeros((m, 2)), np.zeros((m, 2, 2)), np.zeros((m, 2))
    seen = np.zeros(m, dtype=np.bool_)
    for k in range(rows.size):
        i = rows[k]
        if i < 0:
            continue
        seen[i] = True
        for a in range(2):
            innovation[i, a] = pixels[k, a] - predicted[i, a]
        u = v = 0.0
        for j in range(n):
            u += jacobian[i, 0, j] * speed[j]
            v += jacobian[i, 1, j] * speed[j]
        velocity[i, 0], velocity[i, 1] = u, v
        t = timing_s * timing_s
        spread[i, 0, 0] = covariances[k, 0, 0] + t * u * u
        spread[i, 0, 1] = covariances[k, 0, 1] + t * u * v
        spread[i, 1, 0] = spread[i, 0, 1]
        spread[i, 1, 1] = covariances[k, 1, 1] + t * v * v
    return innovation, spread, seen, velocity


@kernel
def fold_in(
    innovation: FloatArray, spread: FloatArray, seen: BoolArray, noise: FloatArray, t_ns: int,
    filtered: FloatArray, sigma: FloatArray, seen_ns: IntArray,
    known_s: float, filter_s: float, gate: float, model_px: float, first_px: float,
) -> tuple[int, int, float]:  # fmt: skip
    """Fold a frame's innovations (m, 2) into the ``filtered`` ones, each by its weight; those refused leave it alone.

    ``noise`` (m,): variance of a coordinate by the detector alone; ``gate``: squared distance; ``model_px``,
    ``first_px``: what a prediction may be off by, for markers last seen within ``known_s`` and for others. Gives how
    many were accepted and refused, and the sum of squares of the accepted innovations [px²].
    """
    accepted = refused = 0
    squares = 0.0
    for i in range(seen.size):
        if not seen[i]:
            continue
        age_s = (t_ns - seen_ns[i]) * 1e-9
        known = seen_ns[i] > 0 and age_s <= known_s
        x, y = innovation[i, 0], innovation[i, 1]
        if known:
            x -= filtered[i, 0]
            y -= filtered[i, 1]
        model = model_px if known else first_px
        d2 = distance2(
            x, y, spread[i, 0, 0] + model * model, spread[i, 0, 1], spread[i, 1, 1] + model * model
        )
        if not d2 <= gate:
            refused += 1
            continue
        weight = 1.0 if d2 <= HUBER * HUBER else HUBER / math.sqrt(d2)
        if known and filter_s > 0.0:
            share = weight * age_s / (filter_s + age_s)
            filtered[i, 0] += share * x
            filtered[i, 1] += share * y
        else:
            filtered[i, 0] = innovation[i, 0]
            filtered[i, 1] = innovation[i, 1]
        sigma[i] = math.sqrt(noise[i] / weight)
        seen_ns[i] = t_ns
        squares += innovation[i, 0] * innovation[i, 0] + innovation[i, 1] * innovation[i, 1]
        accepted += 1
    return accepted, refused, squares
