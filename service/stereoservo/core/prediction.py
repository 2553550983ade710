"""Marker positions and pixels at a given time, predicted by projective kinematics (thesis 8.35) and corrected by
camera frames: innovations, outlier gating, filtering, time offset of each camera.

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

from stereoservo.control.law import Scene
from stereoservo.core.model_arrays import ModelArrays, with_unit_height
from stereoservo.core.monitor_state import CameraMonitor, CameraTiming, ModelMonitor
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import HISTORY, CameraEstimate, JointHistory, ServoGoal
from stereoservo.kinematics.kernels import (
    chain_forward,
    distortion_jacobian,
    image_jacobian,
    project_points,
    transform_points,
    triangulate,
    undistort_pixel,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray, KindArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import damped_least_squares
from stereoservo.ports.devices import CameraObservation

MODEL_SIGMA_PX = 0.3  # what a good model may be off by at any pose
TIMING_SIGMA_S = 0.003  # uncertainty of a shutter stamp against the joint stamps
FIRST_SIGHT_SIGMA_PX = 6.0  # before a marker's innovation is known
CORRECTION_DAMPING = 1e-4  # relative to the largest diagonal of the normal matrix
LARGE_CORRECTION = 3e-3
"""[rad or m], from which on one step is not exact to a tenth of a pixel."""
FURTHER_STEPS = 3
UNKNOWN_NS = 100_000_000
"""A frame that is so much later than the newest joint sample (drives that are silent) is compared with nothing."""
SUSPECT_FRAMES = 8  # refused ones in a row, of one camera
TRUSTED_FRAMES = 30  # agreeing ones in a row, of every camera
AGREEING_PX = 1.5


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


def predict(arrays: ModelArrays, q: FloatArray, camera: int | None = None) -> Prediction:
    """Bring the projective kinematics to ``q`` (5.21) and predict every marker in every camera, or in one (8.35)."""
    return Prediction(
        *_predict(
            arrays.generators, arrays.kinds, arrays.zero, np.ascontiguousarray(q), arrays.tip_first,
            arrays.marker_points, arrays.matrices if camera is None else arrays.matrices[camera : camera + 1],
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


def markers_at(arrays: ModelArrays, q: FloatArray) -> FloatArray:
    """The markers (m, 4) by kinematics alone at ``q`` (n,)."""
    points: FloatArray = _body_points(
        arrays.generators, arrays.kinds, arrays.zero, q, arrays.tip_first, arrays.marker_points
    )
    return points


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
    if len(lens) == 4 and lens[0] == 0.0:
        return observation
    pixels, covariances = (
        np.array(observation.pixels, np.float64),
        np.array(observation.covariances, np.float64),
    )
    pixels, covariances, seen = undistort_sights(lens, pixels, covariances)
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
    """Innovations of an observation in ideal pixels against the ``prediction`` of this camera at its shutter.

    ``speed`` (n,): of the joints then.
    """
    rows = rows_of(observation.ids.astype(np.int64), arrays.row_ids, arrays.row_of)
    innovation, spread, noise, seen, velocity = innovations(
        rows, np.ascontiguousarray(observation.pixels), np.ascontiguousarray(observation.covariances),
        prediction.pixels[0], arrays.scene_pixels[camera], prediction.jacobian[0], speed, TIMING_SIGMA_S,
    )  # fmt: skip
    return FrameResiduals(observation.t_shutter_ns, innovation, spread, noise, seen, velocity)


@kernel
def rows_of(ids: IntArray, known: IntArray, rows: IntArray) -> IntArray:
    """Of each of the ``ids`` (k,): its row among those that are ``known`` (m,), ascending, or -1."""
    found = np.empty(ids.size, np.int64)
    for k in range(ids.size):
        at = np.searchsorted(known, ids[k])
        found[k] = rows[at] if at < known.size and known[at] == ids[k] else -1
    return found


def fold_residuals(watching: ModelMonitor, camera: int, sights: FrameResiduals, q: FloatArray) -> None:
    """A new frame of one camera, with the arm at ``q`` (n,) then."""
    sighting = watching.sightings[camera]
    watching.due = watching.due or not sighting.looked
    sighting.innovation = sights.innovation
    sighting.spread = sights.spread
    sighting.seen = sights.seen.astype(np.float64)
    sighting.velocity = sights.velocity
    sighting.q = q
    sighting.t_ns = sights.t_shutter_ns
    sighting.fresh, sighting.looked = True, False
    used = used_rows(watching, sighting)
    chi2, squares, worst, _ = camera_chi2(sighting.innovation, sighting.spread, used, MODEL_SIGMA_PX)
    count = float(used.sum())
    sighting.chi2 = chi2 / max(2.0 * count, 1.0)
    sighting.rms_px = math.sqrt(squares / max(2.0 * count, 1.0))
    sighting.worst = int(worst)
    sighting.worst_px = 0.0 if worst < 0 else float(np.sqrt((sighting.innovation[worst] ** 2).sum()))
    fold_timing(sighting.timing, sights, used)


def used_rows(watching: ModelMonitor, sighting: CameraMonitor) -> FloatArray:
    """(k,) 1 for what is seen and has not slipped."""
    used = sighting.seen.copy()
    used[: len(watching.masked)] *= 1.0 - watching.masked
    return used


FORGETTING_S = 30.0
"""Time constant, in seconds of seen motion, with which old frames are forgotten."""
MOVING_PX_S = 20.0
"""Mean pixel speed below which a frame says nothing of time."""


def fold_timing(timing: CameraTiming, sights: FrameResiduals, used: FloatArray) -> None:
    """Take in the rows of a frame that are ``used`` (k,) > 0.

    The markers of a frame share what the model is off by: they count as one sight, not as k.
    """
    t_ns = sights.t_shutter_ns
    k, speed, product, square = _timing_sums(sights.innovation, sights.velocity, sights.noise, used)
    if k == 0 or speed < MOVING_PX_S * k:
        return
    elapsed_s = min((t_ns - timing.seen_ns) * 1e-9, 0.2) if timing.seen_ns else 0.0
    keep = math.exp(-elapsed_s / FORGETTING_S)
    timing.product = keep * timing.product + product / k
    timing.square = keep * timing.square + square / k
    timing.seen_ns = t_ns


@kernel
def _timing_sums(
    innovations: FloatArray, velocities: FloatArray, variances: FloatArray, used: FloatArray
) -> tuple[int, float, float, float]:
    """How many markers of a frame are ``used`` (k,) > 0, and sums over these: pixel speeds, and of the weighted fit of
    innovations to velocities.
    """
    count, speed, product, square = 0, 0.0, 0.0, 0.0
    for i in range(variances.shape[0]):
        if not used[i] > 0.0:
            continue
        count += 1
        vu, vv = velocities[i, 0], velocities[i, 1]
        speed += math.sqrt(vu * vu + vv * vv)
        weight = 1.0 / (variances[i] + MODEL_SIGMA_PX * MODEL_SIGMA_PX)
        product += weight * (vu * innovations[i, 0] + vv * innovations[i, 1])
        square += weight * (vu * vu + vv * vv)
    return count, speed, product, square


@kernel
def camera_chi2(
    innovation: FloatArray, spread: FloatArray, used: FloatArray, model_px: float
) -> tuple[float, float, int, float]:
    """Chi-square of a frame's innovations (k, 2) where ``used`` (k,) > 0, sum of their squares [px²], the row of the
    largest squared distance (-1: none) and this distance.
    """
    total, squares, largest = 0.0, 0.0, 0.0
    worst = -1
    for i in range(used.size):
        if not used[i] > 0.0:
            continue
        x, y = innovation[i, 0], innovation[i, 1]
        m = model_px * model_px
        d2 = distance2(x, y, spread[i, 0, 0] + m, spread[i, 0, 1], spread[i, 1, 1] + m)
        total += d2
        squares += x * x + y * y
        if worst < 0 or d2 > largest:
            worst, largest = i, d2
    return total, squares, worst, largest


def accept_sights(
    estimate: CameraEstimate, sights: FrameResiduals, used: BoolArray, settings: CoreSettings,
    common: FloatArray,
) -> None:  # fmt: skip
    """Gate one frame and fold it into the camera's estimate; markers that are not ``used`` (m,) are left out.

    The gate is chi-square with two freedoms on the deviation from the filtered innovation and its ``common`` change
    (m, 2) [px], with the covariances of detector, timing and model. Near the gate a sight counts less: in the filter,
    and in triangulation by its sigma.
    """
    m = used.size
    accepted, rejected, squares = fold_in(
        sights.innovation[:m], sights.spread[:m], sights.seen[:m] & used, sights.noise[:m], common,
        sights.t_shutter_ns, estimate.innovation, estimate.sigma, estimate.seen_ns,
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


COMMON_ROUNDS = 8
"""Of reweighting, in which sights that the joints do not explain lose their weight."""


def common_change(
    estimate: CameraEstimate, sights: FrameResiduals, used: BoolArray, jacobian: FloatArray,
    arrays: ModelArrays,
) -> FloatArray:  # fmt: skip
    """Change of the innovations (m, 2) [px] since the filtered ones that joints explain which pass through their play
    or step, within the errors that the model states of them; zeros where it states none, or where nothing changed.

    ``jacobian`` (m, 2, n). By iterated weights of Huber: what is common moves all markers, an outlier one.
    """
    m, n = used.size, jacobian.shape[2]
    none = np.zeros((m, 2))
    if arrays.joint_accuracy is None:
        return none
    rows = sights.seen[:m] & used & (estimate.seen_ns > 0)
    if int(rows.sum()) < 3:
        return none
    change = (sights.innovation[:m] - estimate.innovation)[rows]
    variance = MODEL_SIGMA_PX**2 + 0.5 * (sights.spread[:m][rows, 0, 0] + sights.spread[:m][rows, 1, 1])
    deviations = np.sqrt(arrays.joint_variances)
    J = jacobian[rows] * deviations
    equations = np.concatenate([J.reshape(-1, n), np.eye(n)])
    wanted = np.concatenate([change.reshape(-1), np.zeros(n)])
    left = change
    if float(((left**2).sum(axis=-1) / variance).max()) <= HUBER * HUBER:
        return none
    step = np.zeros(n)
    for _ in range(COMMON_ROUNDS):
        distance = np.sqrt((left**2).sum(axis=-1) / variance)
        weights = np.sqrt(np.minimum(1.0, HUBER / np.maximum(distance, 1e-9)) / variance)
        step = _joint_step(equations, wanted, np.concatenate([np.repeat(weights, 2), np.ones(n)]), 0.0)
        left = change - (J * step).sum(axis=-1)
    common: FloatArray = (jacobian * (deviations * step)).sum(axis=-1)
    return common


def marker_weights(cameras: list[CameraEstimate], now_ns: int, coast_s: float) -> FloatArray:
    """(c, m) 1/sigma [1/px] of markers that a camera saw within ``coast_s``, 0 elsewhere."""
    limit = int(coast_s * 1e9) + 50_000_000
    seen_ns, sigma = np.array([e.seen_ns for e in cameras]), np.array([e.sigma for e in cameras])
    return np.where((seen_ns > 0) & (now_ns - seen_ns <= limit), 1.0 / np.maximum(sigma, 1e-3), 0.0)


def pixels_now(prediction: Prediction, cameras: list[CameraEstimate]) -> FloatArray:
    """(c, m, 2) where the markers are now: prediction plus held innovation [px]."""
    found: FloatArray = prediction.pixels + np.array([e.innovation for e in cameras])
    return found


def joint_correction(
    arrays: ModelArrays, q: FloatArray, prediction: Prediction, cameras: list[CameraEstimate],
    weights: FloatArray,
) -> FloatArray:  # fmt: skip
    """Joint-space correction (n,) that explains the innovations best, so that corrected points stay one rigid body.

    One step of Gauss and Newton from the ``prediction`` at ``q`` (n,); more where it is large, as of arms with play, as
    long as they explain more.
    """
    n = len(q)
    innovation = np.array([e.innovation for e in cameras])
    pixels = prediction.pixels + innovation
    row_weights = np.repeat(weights.reshape(-1), 2)
    step = _joint_step(
        prediction.jacobian.reshape(-1, n), innovation.reshape(-1), row_weights, CORRECTION_DAMPING
    )
    total, before = step, math.inf
    for _ in range(FURTHER_STEPS):
        if float(np.abs(step).max()) < LARGE_CORRECTION:
            break
        there = predict(arrays, q + total)
        apart = (pixels - there.pixels).reshape(-1)
        left = float(((row_weights * apart) ** 2).sum())
        if not left < before:
            return total - step
        before = left
        step = _joint_step(there.jacobian.reshape(-1, n), apart, row_weights, CORRECTION_DAMPING)
        total = total + step
    return total


def points_now(
    arrays: ModelArrays, q: FloatArray, prediction: Prediction, pixels: FloatArray, weights: FloatArray,
    correction: FloatArray, source: str,
) -> FloatArray:  # fmt: skip
    """Marker points (m, 4) with heights a∞ᵀM = 1: ``predicted`` (8.35) or ``triangulated`` (8.34).

    Predicted points are those of the joints plus correction. A marker that fewer than two cameras see cannot be
    triangulated: its predicted point stands in.
    """
    points = markers_at(arrays, q + correction)
    if source == "triangulated":
        found, ok = triangulate(arrays.matrices, pixels, weights, 3)
        points = np.where(ok[:, None], with_unit_height(found, arrays.plane_at_infinity), points)
    return points


def scene_of(
    prediction: Prediction, pixels: FloatArray, arrays: ModelArrays, points: FloatArray, weights: FloatArray
) -> Scene:
    """The present as laws take it: operators, cameras, points (m, 4), pixels (c, m, 2) and their weights (c, m)."""
    matrices, centres = arrays.matrices, arrays.camera_centres
    return Scene(prediction.operators, arrays.composition, matrices, centres, points, pixels, weights)


def centre_of(source: ServoGoal, joints: FloatArray, arrays: ModelArrays, points: FloatArray) -> FloatArray:
    """The goal's centre (4,) of a body whose markers are at ``points`` (m, 4), with the arm at ``joints`` (n,)."""
    if bool((source.centre_weights != 0.0).any()):
        middle: FloatArray = (source.centre_weights[:, None] * points).sum(axis=0)
        return middle
    moved: FloatArray = transform_points(chain_at(arrays, joints)[0], source.centre_body[None])[0]
    return moved


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


def improbable(freedoms: float) -> float:
    """Chi-square that is exceeded as rarely as five standard deviations (Wilson and Hilferty 1931)."""
    part = 2.0 / (9.0 * max(freedoms, 1.0))
    return freedoms * (1.0 - part + 5.0 * math.sqrt(part)) ** 3


@kernel
def distance2(x: float, y: float, a: float, b: float, c: float) -> float:
    """``vᵀ S⁻¹ v`` of ``v = (x, y)`` and ``S = [[a, b], [b, c]]``; infinite where S is not positive."""
    determinant = a * c - b * b
    if not determinant > 0.0:
        return math.inf
    return (c * x * x - 2.0 * b * x * y + a * y * y) / determinant


@kernel
def innovations(
    rows: IntArray, pixels: FloatArray, covariances: FloatArray, predicted: FloatArray, standing: FloatArray,
    jacobian: FloatArray, speed: FloatArray, timing_s: float,
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray]:  # fmt: skip
    """The fields of `FrameResiduals`, k rows: observed less ``predicted`` (m, 2) or ``standing`` (s, 2) [px].

    ``rows``: the row of each sight, or -1. ``jacobian`` (m, 2, n), ``speed`` (n,): what a shutter stamp that is off by
    ``timing_s`` [s] moves.
    """
    markers, n = jacobian.shape[0], jacobian.shape[2]
    m = markers + standing.shape[0]
    innovation, spread, velocity = np.zeros((m, 2)), np.zeros((m, 2, 2)), np.zeros((m, 2))
    seen, noise = np.zeros(m, dtype=np.bool_), np.ones(m)
    for k in range(rows.size):
        i = rows[k]
        if i < 0:
            continue
        seen[i] = True
        noise[i] = 0.5 * (covariances[k, 0, 0] + covariances[k, 1, 1])
        for a in range(2):
            innovation[i, a] = pixels[k, a] - (predicted[i, a] if i < markers else standing[i - markers, a])
        u = v = 0.0
        for j in range(n):
            u += jacobian[i, 0, j] * speed[j] if i < markers else 0.0
            v += jacobian[i, 1, j] * speed[j] if i < markers else 0.0
        velocity[i, 0], velocity[i, 1] = u, v
        t = timing_s * timing_s
        spread[i, 0, 0] = covariances[k, 0, 0] + t * u * u
        spread[i, 0, 1] = covariances[k, 0, 1] + t * u * v
        spread[i, 1, 0] = spread[i, 0, 1]
        spread[i, 1, 1] = covariances[k, 1, 1] + t * v * v
    return innovation, spread, noise, seen, velocity


@kernel
def fold_in(
    innovation: FloatArray, spread: FloatArray, seen: BoolArray, noise: FloatArray, common: FloatArray,
    t_ns: int, filtered: FloatArray, sigma: FloatArray, seen_ns: IntArray,
    known_s: float, filter_s: float, gate: float, model_px: float, first_px: float,
) -> tuple[int, int, float]:  # fmt: skip
    """Fold a frame's innovations (m, 2) into the ``filtered`` ones, each by its weight; those refused leave it alone.

    ``noise`` (m,): variance of a coordinate by the detector alone; ``gate``: squared distance; ``model_px``,
    ``first_px``: what a prediction may be off by, for markers last seen within ``known_s`` and for others; ``common``
    (m, 2) [px]: change of all of them together since the filtered ones, which the gate leaves out. Gives how
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
        off = model * model
        a, b = (x - common[i, 0], y - common[i, 1]) if known else (x, y)
        d2 = distance2(a, b, spread[i, 0, 0] + off, spread[i, 0, 1], spread[i, 1, 1] + off)
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


@kernel
def propagate_covariance(a: float, b: float, d: float, C: FloatArray, out: FloatArray) -> None:
    """``out = J C Jᵀ`` for the symmetric ``J = (a b; b d)`` and (2, 2) ``C``."""
    uu, uv = a * C[0, 0] + b * C[1, 0], a * C[0, 1] + b * C[1, 1]
    vu, vv = b * C[0, 0] + d * C[1, 0], b * C[0, 1] + d * C[1, 1]
    out[0, 0], out[0, 1] = uu * a + uv * b, uu * b + uv * d
    out[1, 0], out[1, 1] = vu * a + vv * b, vu * b + vv * d


@kernel
def undistort_sights(
    lens: FloatArray, pixels: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Ideal pixels (k, 2) with covariances (k, 2, 2) [px²] of raw ones, and which (k,) the lens can have made."""
    n = pixels.shape[0]
    ideal = np.empty((n, 2))
    spread = np.empty((n, 2, 2))
    seen = np.empty(n, dtype=np.bool_)
    for i in range(n):
        u, v = undistort_pixel(lens, pixels[i, 0], pixels[i, 1])
        ideal[i, 0], ideal[i, 1] = u, v
        a, b, d = distortion_jacobian(lens, u, v)
        determinant = a * d - b * b
        seen[i] = math.isfinite(u) and math.isfinite(v) and determinant > 0.0
        propagate_covariance(d / determinant, -b / determinant, a / determinant, covariances[i], spread[i])
    return ideal, spread, seen
