"""Marker positions and pixels at a given time, predicted by projective kinematics (thesis 8.35) and corrected by the
observations of the cameras (`core.estimate`); joint positions at an earlier time.

Cameras deliver raw pixels. Here they are converted to ideal ones, for which all later computations are linear in
homogeneous coordinates; priors are converted back to raw pixels.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np

from stereoservo.control.law import Scene
from stereoservo.core.camera_state import CameraEstimate, CameraMonitor
from stereoservo.core.model_arrays import ModelArrays, with_unit_height
from stereoservo.core.monitor_state import ModelMonitor
from stereoservo.core.state import JointHistory, ServoGoal
from stereoservo.kinematics.kernels import (
    chain_forward,
    distortion_jacobian,
    image_jacobian,
    project_points,
    transform_points,
    transform_points_into,
    triangulate,
    undistort_pixel,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray, KindArray, Record
from stereoservo.numerics.compilation import inlined_kernel, kernel
from stereoservo.numerics.linear import damped_least_squares

MODEL_SIGMA_PX = 0.3  # error of a good model at any pose
TIMING_SIGMA_S = 0.003  # uncertainty of a shutter stamp against the joint stamps
UNKNOWN_NS = 100_000_000
"""A frame that is so much later than the newest joint sample (the drives are silent) is not compared with a prediction
[ns].
"""
SUSPECT_FRAMES = 8  # consecutive rejected frames of one camera
TRUSTED_FRAMES = 30  # consecutive agreeing frames of every camera


class Prediction(msgspec.Struct, frozen=True, eq=False):
    """Markers by kinematics alone at one configuration: operators (5.21), points, ideal pixels, their Jacobian."""

    operators: FloatArray
    points: FloatArray
    pixels: FloatArray
    jacobian: FloatArray


class FrameResiduals(msgspec.Struct, frozen=True, eq=False):
    """Residuals of one frame from the prediction at its shutter time, k rows: the model's markers, then its static
    points.

    ``innovation`` (k, 2) [px], its covariance ``covariance`` (k, 2, 2) from detector and timing, ``noise`` (k,) [px²]:
    variance of a coordinate from the detector alone, whether it was ``seen`` (k,), and the ``velocity`` (k, 2) [px/s]
    caused by the joints.
    """

    t_shutter_ns: int
    innovation: FloatArray
    covariance: FloatArray
    noise: FloatArray
    seen: BoolArray
    velocity: FloatArray


def chain_at(arrays: ModelArrays, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``H(q)`` (4, 4) of the markers and the operators at ``q`` (n, 4, 4) (5.18, 5.21), for every mount
    of the cameras.
    """
    found: tuple[FloatArray, FloatArray] = chain_forward(
        arrays.generators, arrays.kinds, arrays.zero, np.ascontiguousarray(q), arrays.tip_first
    )
    return found


class Arm(NamedTuple):
    """An arm as the cameras see it: ``generators`` (n, 4, 4) at the ``zero`` (n,), ``kinds`` (n,) 1 for prismatic
    joints, whether they compose ``tip_first``, and the ``marker_points`` (m, 4) that it carries at the zero.
    """

    generators: FloatArray
    kinds: KindArray
    zero: FloatArray
    tip_first: bool
    marker_points: FloatArray


class Predicted(NamedTuple):
    """The fields of a `Prediction` as output arrays."""

    operators: FloatArray
    points: FloatArray
    pixels: FloatArray
    jacobian: FloatArray


def arm_in(arrays: ModelArrays) -> Arm:
    """The arm of a model."""
    return Arm(arrays.generators, arrays.kinds, arrays.zero, arrays.tip_first, arrays.marker_points)


@inlined_kernel
def arm_of(workspace: Record) -> Arm:
    """The arm of the model in the ``workspace``."""
    work = workspace[0]
    n, m = work.joints, work.markers
    return Arm(
        work.generators[: 16 * n].reshape((n, 4, 4)),
        work.kinds[:n],
        work.zero[:n],
        work.tip_first != 0,
        work.marker_points[: 4 * m].reshape((m, 4)),
    )


def predict(arrays: ModelArrays, q: FloatArray, camera: int | None = None) -> Prediction:
    """Bring the projective kinematics to ``q`` (5.21) and predict every marker in every camera, or in one (8.35)."""
    matrices = arrays.matrices if camera is None else arrays.matrices[camera : camera + 1]
    return Prediction(*predict_markers(arm_in(arrays), np.ascontiguousarray(q), matrices))


@kernel
def predict_markers(
    arm: Arm, q: FloatArray, matrices: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The fields of a `Prediction` in cameras (c, 3, 4)."""
    H, operators = chain_forward(arm.generators, arm.kinds, arm.zero, q, arm.tip_first)
    points = transform_points(H, arm.marker_points)
    pixels, _ = project_points(matrices, points)
    return operators, points, pixels, image_jacobian(operators, matrices, points)


@kernel
def predict_into(arm: Arm, q: FloatArray, matrices: FloatArray, found: Predicted) -> None:
    """`predict_markers` into ``found``. For calls from Python, a returned array costs more time than a passed one."""
    operators, points, pixels, jacobian = predict_markers(arm, q, matrices)
    found.operators[:], found.points[:], found.pixels[:], found.jacobian[:] = (
        operators,
        points,
        pixels,
        jacobian,
    )


@kernel
def body_points(arm: Arm, q: FloatArray) -> FloatArray:
    """The markers (m, 4) at ``q``."""
    H, _ = chain_forward(arm.generators, arm.kinds, arm.zero, q, arm.tip_first)
    return transform_points(H, arm.marker_points)


@kernel
def joint_step(jacobian: FloatArray, residual: FloatArray, weights: FloatArray, damping: float) -> FloatArray:
    """Damped least-squares step (n,) for residuals (k,) with ``weights`` (k,)."""
    step, _ = damped_least_squares(jacobian, residual, weights, damping)
    return step


def markers_at(arrays: ModelArrays, q: FloatArray) -> FloatArray:
    """The markers (m, 4) by kinematics alone at ``q`` (n,)."""
    points: FloatArray = body_points(arm_in(arrays), q)
    return points


def joints_at(history: JointHistory, t_ns: int) -> FloatArray | None:
    """Joint positions (n,) at ``t_ns`` by linear interpolation; None if the history does not cover that time."""
    known, q = positions_at(history.t_ns, history.positions, history.count, t_ns)
    return q if known else None


@kernel
def positions_at(stamps: IntArray, positions: FloatArray, count: int, t_ns: int) -> tuple[bool, FloatArray]:
    """Joint positions (n,) at ``t_ns`` by linear interpolation in a ring of samples, and whether they are known.

    ``stamps`` (k,), ``positions`` (k, n): the ring, with ``count`` entries ever written.

    After the newest sample the positions are extrapolated by at most the last sample interval; later than
    ``UNKNOWN_NS`` after it they are unknown.
    """
    size, n = stamps.size, positions.shape[1]
    filled, newest = min(count, size), count - 1
    q = np.zeros(n)
    if filled < 2 or t_ns - stamps[newest % size] > UNKNOWN_NS:
        return False, q
    for back in range(filled - 1):
        later, earlier = (newest - back) % size, (newest - back - 1) % size
        t1, t0 = stamps[later], stamps[earlier]
        if t_ns < t0:
            continue
        if t1 == t0:
            t0 -= 1  # equal stamps: the later sample
        fraction = min((t_ns - t0) / (t1 - t0), 2.0)
        for j in range(n):
            q[j] = positions[earlier, j] + fraction * (positions[later, j] - positions[earlier, j])
        return True, q
    return False, q


@kernel
def velocities_at(stamps: IntArray, positions: FloatArray, count: int, t_ns: int) -> tuple[bool, FloatArray]:
    """Joint velocities (n,) at ``t_ns`` from the samples around it, of a ring as in `positions_at`, and whether they
    are known.

    They are known up to one sample interval after the last sample, and unknown during longer gaps of the driver's
    samples.
    """
    size, n = stamps.size, positions.shape[1]
    newest = count - 1
    velocities = np.zeros(n)
    for back in range(min(count, size) - 1):
        later, earlier = (newest - back) % size, (newest - back - 1) % size
        t1, t0 = stamps[later], stamps[earlier]
        if t_ns < t0 or t1 == t0:
            continue
        if t_ns > 2 * t1 - t0 or t1 - t0 > UNKNOWN_NS:
            return False, velocities
        for j in range(n):
            velocities[j] = (positions[later, j] - positions[earlier, j]) / ((t1 - t0) * 1e-9)
        return True, velocities
    return False, velocities


@kernel
def rows_of(ids: IntArray, known: IntArray, rows: IntArray) -> IntArray:
    """The row of each of the ``ids`` (k,) among the ``known`` ones (m,), ascending, or -1."""
    found = np.empty(ids.size, np.int64)
    for k in range(ids.size):
        at = np.searchsorted(known, ids[k])
        found[k] = rows[at] if at < known.size and known[at] == ids[k] else -1
    return found


def used_rows(watching: ModelMonitor, sighting: CameraMonitor) -> FloatArray:
    """(k,) 1 for rows that are seen and not masked as slipped."""
    used: FloatArray = rows_in_use(sighting.seen, watching.masked)
    return used


@kernel
def rows_in_use(seen: FloatArray, masked: FloatArray) -> FloatArray:
    """(k,) 1 for rows that are ``seen`` (k,) and, if markers, not ``masked`` (m,)."""
    used = seen.copy()
    for i in range(masked.size):
        used[i] *= 1.0 - masked[i]
    return used


@kernel
def round_complete(block: Record) -> bool:
    """Whether every camera has delivered a frame that no round has examined yet."""
    memory, complete = block[0], True
    for c in range(memory.cameras):
        complete = complete and not memory.sightings[c].looked
    return complete


@kernel
def camera_chi2(
    innovation: FloatArray, covariance: FloatArray, used: FloatArray, model_px: float
) -> tuple[float, float, int, float, int]:
    """Chi-square of a frame's innovations (k, 2) with ``used`` (k,) > 0, sum of their squares [px²], the row of the
    largest squared distance (-1: none), this distance, and their number.
    """
    total, squares, largest = 0.0, 0.0, 0.0
    worst, count = -1, 0
    for i in range(used.size):
        if not used[i] > 0.0:
            continue
        count += 1
        x, y = innovation[i, 0], innovation[i, 1]
        m = model_px * model_px
        d2 = distance2(x, y, covariance[i, 0, 0] + m, covariance[i, 0, 1], covariance[i, 1, 1] + m)
        total += d2
        squares += x * x + y * y
        if worst < 0 or d2 > largest:
            worst, largest = i, d2
    return total, squares, worst, largest, count


SEEN_SLACK_NS = 50_000_000
"""Time [ns] beyond the coasting time of a law for which a marker keeps its weight."""
LEAST_SIGMA_PX = 1e-3
CORRECTION_DAMPING = 1e-4
"""Relative to the largest diagonal element of the normal matrix."""
LARGE_CORRECTION = 3e-3
"""Correction [rad or m] above which one step is not accurate to a tenth of a pixel."""
FURTHER_STEPS = 3


@kernel
def present(block: Record, workspace: Record) -> None:
    """Estimate the current markers.

    Written to the ``workspace``, at the joints ``q`` (n,): the fields of a `Prediction`; ``weights`` (c, m)
    1/sigma [1/px] of recently seen markers, 0 for others; ``pixels`` (c, m, 2), the current markers: prediction plus
    held innovation. Written to the ``block``: the ``correction`` (n,) of the joints that explains the innovations best,
    so that the corrected points remain those of a rigid body.

    The correction is one Gauss-Newton step. If it is large (arms with play), further steps follow as long as they
    reduce the residual.
    """
    memory, work = block[0], workspace[0]
    n, cameras, markers = memory.joints, memory.cameras, memory.markers
    arm, q = arm_of(workspace), work.q[:n]
    matrices = work.matrices[: 12 * cameras].reshape((cameras, 3, 4))
    innovation = memory.innovation[: 2 * cameras * markers].reshape((cameras, markers, 2))
    sigma, seen_ns = memory.sigma[: cameras * markers], memory.seen_ns[: cameras * markers]
    predicted = work.predicted[: 2 * cameras * markers].reshape((cameras, markers, 2))
    jacobian = work.jacobian[: 2 * cameras * markers * n].reshape((cameras, markers, 2, n))
    weights = work.weights[: cameras * markers].reshape((cameras, markers))
    pixels = work.pixels[: 2 * cameras * markers].reshape((cameras, markers, 2))
    predict_into(
        arm,
        q,
        matrices,
        Predicted(
            work.operators[: 16 * n].reshape((n, 4, 4)),
            work.points[: 4 * markers].reshape((markers, 4)),
            predicted,
            jacobian,
        ),
    )
    row_weights = np.empty(2 * cameras * markers)
    for c in range(cameras):
        for i in range(markers):
            at = c * markers + i
            weights[c, i] = 0.0
            if seen_ns[at] > 0 and work.now_ns - seen_ns[at] <= work.lasting_ns:
                weights[c, i] = 1.0 / max(sigma[at], LEAST_SIGMA_PX)
            for k in range(2):
                pixels[c, i, k] = predicted[c, i, k] + innovation[c, i, k]
            row_weights[2 * at] = row_weights[2 * at + 1] = weights[c, i]
    residual = innovation.copy().reshape(-1)
    step = joint_step(jacobian.reshape((-1, n)), residual, row_weights, CORRECTION_DAMPING)
    total, before = step.copy(), math.inf
    for _ in range(FURTHER_STEPS):
        large = False
        for j in range(n):
            large = large or not abs(step[j]) < LARGE_CORRECTION
        if not large:
            break
        _, _, shown, rows = predict_markers(arm, q + total, matrices)
        residual = (pixels - shown).reshape(-1)
        left = 0.0
        for k in range(residual.size):
            left += (row_weights[k] * residual[k]) ** 2
        if not left < before:
            total = total - step
            break
        before = left
        step = joint_step(rows.reshape((-1, n)), residual, row_weights, CORRECTION_DAMPING)
        total = total + step
    memory.correction[:n] = total


def pixels_now(prediction: Prediction, cameras: list[CameraEstimate]) -> FloatArray:
    """Current pixels (c, m, 2) of the markers: prediction plus held innovation [px]."""
    found: FloatArray = prediction.pixels + np.array([e.innovation for e in cameras])
    return found


def points_now(
    arrays: ModelArrays,
    q: FloatArray,
    pixels: FloatArray,
    weights: FloatArray,
    correction: FloatArray,
    source: str,
) -> FloatArray:
    """Marker points (m, 4) with heights a∞ᵀM = 1: ``predicted`` (8.35) or ``triangulated`` (8.34).

    Predicted points are those of the joints plus correction. A marker seen by fewer than two cameras cannot be
    triangulated: its predicted point is used.
    """
    points = markers_at(arrays, q + correction)
    return triangulated(arrays, pixels, weights, points) if source == "triangulated" else points


def triangulated(arrays: ModelArrays, pixels: FloatArray, weights: FloatArray, predicted: FloatArray) -> FloatArray:
    """Marker points (m, 4) of unit height by triangulation; markers seen by fewer than two cameras as ``predicted``."""
    found, ok = triangulate(arrays.matrices, pixels, weights, 3)
    return np.where(ok[:, None], with_unit_height(found, arrays.plane_at_infinity), predicted)


def scene_of(
    prediction: Prediction, pixels: FloatArray, arrays: ModelArrays, points: FloatArray, weights: FloatArray
) -> Scene:
    """The current scene as laws take it: operators, cameras, points (m, 4), pixels (c, m, 2) and their
    weights (c, m).
    """
    matrices, centres = arrays.matrices, arrays.camera_centres
    return Scene(prediction.operators, arrays.composition, matrices, centres, points, pixels, weights)


class Centre(NamedTuple):
    """The centre of a goal: the affine centroid of the markers by its ``weights`` (m,), or, if these are zero, the
    point ``body`` (4,) of the body at the chain's zero.
    """

    weights: FloatArray
    body: FloatArray


def centre_of(source: ServoGoal, joints: FloatArray, arrays: ModelArrays, points: FloatArray) -> FloatArray:
    """The goal's centre (4,) of a body whose markers are at ``points`` (m, 4), with the arm at ``joints`` (n,)."""
    centre = np.empty(4)
    centre_into(arm_in(arrays), joints, points, Centre(source.centre_weights, source.centre_body), centre)
    return centre


@kernel
def centre_into(arm: Arm, q: FloatArray, points: FloatArray, by: Centre, centre: FloatArray) -> None:
    """The ``centre`` (4,) of a body with its markers at ``points`` (m, 4), moved by the joints ``q`` (n,)."""
    weighted = False
    for i in range(by.weights.size):
        weighted = weighted or by.weights[i] != 0.0
    if not weighted:
        H, _ = chain_forward(arm.generators, arm.kinds, arm.zero, q, arm.tip_first)
        transform_points_into(H, by.body.reshape((1, 4)), centre.reshape((1, 4)))
        return
    for k in range(4):
        centre[k] = by.weights[0] * points[0, k]
        for i in range(1, by.weights.size):
            centre[k] += by.weights[i] * points[i, k]


HUBER = 2.5
"""Mahalanobis distance up to which an observation has its full weight: 4 % of good ones exceed it."""
FAR_SIGMA = 30.0


@lru_cache(maxsize=16)
def gate_threshold(sigmas: float) -> float:
    """Squared distance that two Gaussian coordinates exceed as rarely as one exceeds ``sigmas`` standard deviations.

    It is the quantile of chi-square with two degrees of freedom, ``-2 log(1 - p)``; for large ``sigmas`` its asymptote.
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
    """``vᵀ S⁻¹ v`` of ``v = (x, y)`` and ``S = [[a, b], [b, c]]``; infinite if S is not positive definite."""
    determinant = a * c - b * b
    if not determinant > 0.0:
        return math.inf
    return (c * x * x - 2.0 * b * x * y + a * y * y) / determinant


@kernel
def propagate_covariance(a: float, b: float, d: float, C: FloatArray, out: FloatArray) -> None:
    """``out = J C Jᵀ`` for the symmetric ``J = (a b; b d)`` and (2, 2) ``C``."""
    uu, uv = a * C[0, 0] + b * C[1, 0], a * C[0, 1] + b * C[1, 1]
    vu, vv = b * C[0, 0] + d * C[1, 0], b * C[0, 1] + d * C[1, 1]
    out[0, 0], out[0, 1] = uu * a + uv * b, uu * b + uv * d
    out[1, 0], out[1, 1] = vu * a + vv * b, vu * b + vv * d


@kernel
def undistort_observations(
    lens: FloatArray, pixels: FloatArray, covariances: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Ideal pixels (k, 2) with covariances (k, 2, 2) [px²] of raw ones, and which (k,) the lens can produce."""
    n = pixels.shape[0]
    ideal = np.empty((n, 2))
    covariance = np.empty((n, 2, 2))
    seen = np.empty(n, dtype=np.bool_)
    for i in range(n):
        u, v = undistort_pixel(lens, pixels[i, 0], pixels[i, 1])
        ideal[i, 0], ideal[i, 1] = u, v
        a, b, d = distortion_jacobian(lens, u, v)
        determinant = a * d - b * b
        seen[i] = math.isfinite(u) and math.isfinite(v) and determinant > 0.0
        propagate_covariance(d / determinant, -b / determinant, a / determinant, covariances[i], covariance[i])
    return ideal, covariance, seen
