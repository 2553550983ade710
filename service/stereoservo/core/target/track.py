"""Tracking of the target body from frame to frame: detection, tracking, distinction from other motions, and prediction
through drop-outs.

A frame is compared with the pose predicted by the motion at its shutter time. A deviation in one camera, while another
one agrees, is attributed to that camera. A deviation in all cameras is attributed to the target, if its speed makes
that possible; otherwise the decision is left to the model monitor: if it names a joint zero or a marker, the deviation
is not tracked as a motion of the target.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from stereoservo.core.block import HISTORY
from stereoservo.core.context import StepContext
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitor_state import ModelDiagnosis
from stereoservo.core.prediction import chain_at, gate_threshold, positions_at, undistort_observations
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState
from stereoservo.core.target.motion import (
    FOUND_PX,
    FOUND_REST_PX,
    FREEDOMS,
    OBSERVATION_PX,
    SPEED_PX,
    TargetBody,
    View,
    after,
    begin,
    compare,
    elapse,
    find_shape,
    find_stated,
    fold_frame,
    gate_observations,
    jumped,
    target_body,
    widen,
)
from stereoservo.kinematics.kernels import project_points, transform_points
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.ports.devices import CameraObservation

FEWEST = 3
"""Least number of markers for a frame to be used."""
FEWEST_TO_FIND = 5
"""Least number of markers, seen by two cameras together, to find a target that is not the model's body."""
TOGETHER_NS = 2_000_000
"""Largest time between frames of several cameras that count as simultaneous [ns]."""
LONGEST_GAP_NS = 250_000_000
FARTHEST_SHARE = 1.0
"""Largest interval [ns] between two frames of a camera between which its observations are interpolated to another time;
and the fraction of that interval by which they are extrapolated.
"""
RECENT_NS = 150_000_000
ROUNDS = 4
"""Iterations of linearisation, for a frame that shows the target elsewhere than predicted."""
SMALL_PX = 0.5
"""Residual rms [px] that needs no explanation: models are not exact."""
RIGID_PX = 1.0
"""Largest residual rms [px] of a motion of the target."""
REDETECT_FRAMES = 6
"""Consecutive frames explained only by a jump of the target, after which it is found again."""
OTHERS = ("joint_zero", "camera_moved", "marker_slipped")
"""Diagnoses of other motions, which are not tracked as motions of the target."""
STILL_S, STILL_PX = 0.5, 0.5
"""A target whose markers moved by less [px] in that time [s] is static."""
LONGEST_S = 1.0
"""Longest time [s] for which the pose of an unseen target is extrapolated; then it is constant."""
LOST_S = 0.5
"""Time [s] after which it is searched everywhere."""
IDENTITY = np.eye(4)


def take_frame(camera: int, observation: CameraObservation, context: StepContext) -> None:
    """Track the target in a frame; if the model's body is the target, its markers are then those at the
    shutter time.
    """
    state, arrays = context.state, context.derived.arrays
    body = state.target
    if body is None or arrays is None:
        return
    t_ns = observation.t_shutter_ns + state.cameras[camera].offset_ns
    carrier = _carrier(body, t_ns, state, arrays)
    if carrier is None:
        return
    frame = _frame_of(body, camera, observation, context)
    if state.reanchoring is None and int(frame[2].sum()) >= FEWEST:
        if body.t_ns == 0:
            _find(body, camera, t_ns, frame[0], frame[2], carrier, arrays)
            frame = _frame_of(body, camera, observation, context)  # it may have fewer markers from here on
        if body.t_ns > 0 and int(frame[2].sum()) >= FEWEST:
            _follow(body, camera, t_ns, frame, carrier, context)
    if body.carried and body.t_ns > 0:
        if not body.told[camera]:  # earlier estimates assumed a static target
            state.cameras[camera].seen_ns[:] = 0
            body.told[camera] = True
        context.derived.workspace.arrays["marker_points"][:] = _points(body, t_ns)


def _frame_of(
    body: TargetBody, camera: int, observation: CameraObservation, context: StepContext
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The target's markers in a frame, as from `target_observations`, without slipped markers of the model's body."""
    arrays = context.derived.arrays
    assert arrays is not None
    observed, variances, seen = target_observations(
        body.ids,
        observation.ids.astype(np.int64),
        np.array(observation.pixels, np.float64, order="C"),
        np.array(observation.covariances, np.float64, order="C"),
        arrays.lenses[camera],
    )
    return observed, variances, seen * (1.0 - context.state.watching.masked) if body.carried else seen


def present_arrays(context: StepContext) -> ModelArrays | None:
    """The model with the markers of a body that is the target at their current positions."""
    arrays, body = context.derived.arrays, context.state.target
    if arrays is None or body is None or not body.carried or body.t_ns == 0:
        return arrays
    points = _points(body, context.now_ns)
    context.derived.workspace.arrays["marker_points"][:] = points
    here = copy(arrays)
    object.__setattr__(here, "marker_points", points)
    return here


def pose_at(body: TargetBody, t_ns: int) -> tuple[FloatArray, FloatArray]:
    """Displacement (4, 4) and twist (6,) of the target at ``t_ns``."""
    ahead_s = min((t_ns - body.t_ns) * 1e-9, LONGEST_S)
    found: tuple[FloatArray, FloatArray] = after(body.displacement, body.basis, body.twist, body.rate, ahead_s)
    return found


def _points(body: TargetBody, t_ns: int) -> FloatArray:
    points: FloatArray = transform_points(pose_at(body, t_ns)[0], body.points)
    return points


def _carrier(body: TargetBody, t_ns: int, state: CoreState, arrays: ModelArrays) -> FloatArray | None:
    """The transformation between the target's frame and the cameras' at ``t_ns``; None if the joints are unknown at
    that time.
    """
    if not body.carried:
        return IDENTITY
    block, n = state.block, len(arrays.zero)
    known, q = positions_at(
        block.history_ns, block.history_positions.reshape((HISTORY, n)), block.numbers.history_count, t_ns
    )
    return chain_at(arrays, q)[0] if known else None


@kernel
def target_observations(
    target_ids: IntArray, ids: IntArray, pixels: FloatArray, covariances: FloatArray, lens: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The observations of the markers ``target_ids`` (k,) in a frame of ``ids`` (s,), raw ``pixels`` (s, 2) with
    ``covariances`` (s, 2, 2): ideal pixels (k, 2), variances of a coordinate (k,) [px²], and which are seen (k,) 1 or
    0.
    """
    ideal, covariance, possible = undistort_observations(lens, pixels, covariances)
    k = target_ids.size
    found, variances, seen = np.zeros((k, 2)), np.ones(k), np.zeros(k)
    for s in range(ids.size):
        for i in range(k):
            if ids[s] == target_ids[i] and possible[s]:
                found[i] = ideal[s]
                variances[i] = 0.5 * (covariance[s, 0, 0] + covariance[s, 1, 1]) + OBSERVATION_PX * OBSERVATION_PX
                seen[i] = 1.0
    return found, variances, seen


def displacements_of(arrays: ModelArrays) -> FloatArray | None:
    """Twists (6, 4, 4) that span all displacements; None if neither model nor arm determines them."""
    if arrays.metric_basis is not None:
        return arrays.metric_basis
    return arrays.generators if len(arrays.generators) == FREEDOMS else None


# -- finding it ------------------------------------------------------------------------------------------------


def _find(
    body: TargetBody,
    camera: int,
    t_ns: int,
    observed: FloatArray,
    seen: FloatArray,
    carrier: FloatArray,
    arrays: ModelArrays,
) -> None:
    """Find the target from this frame, and the previous ones of the other cameras."""
    basis, metric = displacements_of(arrays), arrays.metric_basis is not None
    if basis is None:
        return
    if body.carried:
        begin(body, basis, metric, arrays.matrices, carrier, t_ns)
        return
    at_ns, simultaneous, shown = _at_one_instant(body, camera, t_ns, observed, seen)
    body.first[camera], body.first_seen[camera], body.seen_ns[camera] = observed, seen, t_ns
    if int((shown.max(axis=1) > 0.0).sum()) < 2:
        return
    points, known = find_shape(arrays.matrices, simultaneous, shown, arrays.plane_at_infinity)
    pixels, _ = project_points(arrays.matrices, points)
    distances = np.sqrt(((pixels - simultaneous) ** 2).sum(axis=-1)) * shown
    # Rays that do not intersect: swapped markers, or a reflection.
    wrong = (known > 0.0) & ~(distances.max(axis=0) <= FOUND_REST_PX)
    known[wrong], shown[:, wrong] = 0.0, 0.0
    if not body.stated:
        if int(known.sum()) < FEWEST_TO_FIND:
            return
        _keep(body, known > 0.0, points)
        begin(body, basis, metric, arrays.matrices, carrier, at_ns)
        return
    if int((shown.max(axis=0) > 0.0).sum()) < FEWEST:
        return
    D, rest = find_stated(basis, arrays, body.points, simultaneous, shown)
    if rest > FOUND_REST_PX:
        body.rest_px = rest
        return
    body.displacement[:] = D
    begin(body, basis, metric, arrays.matrices, carrier, at_ns)


def _at_one_instant(
    body: TargetBody, camera: int, t_ns: int, observed: FloatArray, seen: FloatArray
) -> tuple[int, FloatArray, FloatArray]:
    """Time at which another camera saw the target last, the pixels (c, k, 2) of all cameras at that time, and which
    markers they show (c, k) 1 or 0. Those of this camera are interpolated between its previous frame and this one, or
    extrapolated, because the target moves between the shutter times.
    """
    pixels, shown = body.first.copy(), body.first_seen.copy()
    others = shown.max(axis=1) > 0.0
    others[camera] = False
    at_ns = int(body.seen_ns[others].max()) if others.any() else t_ns
    shown *= (np.abs(body.seen_ns - at_ns) <= TOGETHER_NS)[:, None]
    pixels[camera], shown[camera] = observed, seen
    if abs(t_ns - at_ns) <= TOGETHER_NS:
        return at_ns, pixels, shown
    before, gap_ns = body.first[camera], t_ns - int(body.seen_ns[camera])
    share = (at_ns - t_ns) / gap_ns if 0 < gap_ns <= LONGEST_GAP_NS else np.inf
    if -1.0 - FARTHEST_SHARE <= share <= FARTHEST_SHARE:
        pixels[camera] += share * (observed - before)
        shown[camera] *= body.first_seen[camera]
    else:
        shown[camera] = 0.0
    return at_ns, pixels, shown


def _keep(body: TargetBody, known: np.ndarray[tuple[int], np.dtype[np.bool_]], points: FloatArray) -> None:
    """Reduce the target to the ``known`` markers, at ``points`` (k, 4)."""
    body.ids, body.points = body.ids[known].copy(), np.ascontiguousarray(points[known])
    body.first, body.first_seen = body.first[:, known].copy(), body.first_seen[:, known].copy()
    body.stated = True


def restart(state: CoreState, arrays: ModelArrays, settings: CoreSettings) -> None:
    """Adapt to a new model in use: a tracked target is found again with its cameras, and a body declared to move is
    tracked from the first frame.
    """
    body = state.target
    if body is None or not state.pending_reanchored:
        moves = settings.body_moves and displacements_of(arrays) is not None
        cameras = len(settings.cameras)
        state.target = target_body(arrays.ids, arrays.marker_points, cameras, carried=True) if moves else None
        return
    body.t_ns, body.seen_ns[:], body.first_seen[:] = 0, 0, 0.0
    if body.carried and body.points.shape == arrays.marker_points.shape:
        body.points[:] = arrays.marker_points


def report_untrackable(context: StepContext) -> None:
    """Warn if the body is declared to move, and the new model determines no displacements."""
    model = context.state.model
    if model is None or context.state.target is not None or not context.settings.body_moves:
        return
    reason = Reason(
        "TARGET_NOT_TRACKABLE",
        "slow",
        hint="calibrate with a body by which the model becomes metric, or with an arm of six joints",
    )
    context.emit(
        "warning",
        message=f"[scene] moves, but the model is {model.stratum}, and the {len(model.joint_names)} joints do not make "
        "all displacements: the body is not followed, and where it moves a camera or a joint will be blamed",
        reasons=(reason,),
    )


# -- following it ----------------------------------------------------------------------------------------------


def _follow(
    body: TargetBody,
    camera: int,
    t_ns: int,
    frame: tuple[FloatArray, FloatArray, FloatArray],
    carrier: FloatArray,
    context: StepContext,
) -> None:
    observed, variances, seen = frame
    state, arrays = context.state, context.derived.arrays
    assert arrays is not None
    stood = pose_at(body, int(body.seen_ns.max()))[0]
    dt_s = min((t_ns - body.t_ns) * 1e-9, LONGEST_S)
    if dt_s > 0.0:
        elapse(body.displacement, body.basis, body.drift, (body.twist, body.rate, body.covariance), dt_s)
        body.t_ns = t_ns
    pose = pose_at(body, t_ns)[0]
    view = arrays.matrices[camera : camera + 1], carrier, observed, seen
    left, J = compare(body.basis, body.points, pose, view)
    gate = gate_threshold(context.settings.gate_sigma)
    since_s = (t_ns - int(body.seen_ns.max())) * 1e-9
    lost = (t_ns - int(max(body.seen_ns.max(), body.odd_ns.max()))) * 1e-9 > LOST_S
    if lost and not body.carried:  # one camera alone may confuse a flat one with its mirror image
        body.t_ns, body.seen_ns[:], body.odd_ns[:], body.first_seen[:] = 0, 0, 0, 0.0
        _find(body, camera, t_ns, observed, seen, carrier, arrays)
        return
    used = None if lost else _explained(body, left, J, variances, seen, gate)
    sudden = used is None or float((left * left)[used > 0.0].sum(axis=-1).mean()) > RIGID_PX**2
    if used is None:
        found, moved_px, rest_px = jumped(body.basis, body.points, pose, view)
        stops = _shift_px(body, stood, found, *view[:2]) < min(moved_px, SPEED_PX * since_s + SMALL_PX)
        if lost and rest_px <= RIGID_PX:
            widen(body, FOUND_PX)
            body.odd, body.told[:] = 0, False
        elif lost or not _jumps(body, camera, t_ns, (0.0 if stops else moved_px, rest_px), since_s, state):
            return
        if stops:  # as its speed was overestimated
            body.twist[:], body.rate[:] = 0.0, 0.0
        body.displacement[:] = found
        left, J = compare(body.basis, body.points, found, view)
        used = _explained(body, left, J, variances, seen, gate)
        if used is None:
            return
    if sudden and body.carried:
        # The other cameras' newest frames were compared with a wrong pose.
        for sighting in state.watching.sightings:
            sighting.t_ns = 0
    _fold(body, left, J, view, variances, used, ROUNDS if sudden else 1)
    body.seen_ns[camera], body.odd_ns[camera] = t_ns, 0
    _update_stillness(body, t_ns, arrays.matrices[camera : camera + 1], carrier)


def _fold(
    body: TargetBody, left: FloatArray, J: FloatArray, view: View, variances: FloatArray, used: FloatArray, rounds: int
) -> None:
    """Correct the state by a frame, as in `fold_frame`, with repeated linearisation about the result (Bell and Cathey
    1993): one large step from far away leaves unexplained residuals, which would be attributed to a joint.
    """
    for _ in range(rounds - 1):
        D, motion = body.displacement.copy(), (body.twist.copy(), body.rate.copy(), body.covariance.copy())
        step = fold_frame(D, body.basis, motion, (left, J), variances, used)
        left, J = compare(body.basis, body.points, D, view)
        left = left + J @ step
    motion = body.twist, body.rate, body.covariance
    fold_frame(body.displacement, body.basis, motion, (left, J), variances, used)


def _explained(
    body: TargetBody, left: FloatArray, J: FloatArray, variances: FloatArray, seen: FloatArray, gate: float
) -> FloatArray | None:
    """The markers (k,) 1 or 0 that the predicted motion explains; None if it does not explain most of them."""
    pose = np.ascontiguousarray(body.covariance[:FREEDOMS, :FREEDOMS])
    within, used, count = gate_observations(left, J, variances, seen, pose, gate)
    if used >= FEWEST and 2 * used > count:
        return within
    if float((left * left).sum()) <= 2.0 * count * SMALL_PX**2:
        return seen
    return None


def _jumps(
    body: TargetBody, camera: int, t_ns: int, jump: tuple[float, float], since_s: float, state: CoreState
) -> bool:
    """Whether a frame that the predicted motion does not explain shows a target that moved differently: ``jump`` holds
    the displacement and its residual [px]. It may have another cause, or be undecided yet.
    """
    moved_px, rest_px = jump
    body.odd_ns[camera] = t_ns
    recent = np.maximum(body.seen_ns, body.odd_ns) > t_ns - RECENT_NS
    if bool((body.odd_ns[recent] == 0).any()):
        return False  # the others agree: the camera is the cause
    body.odd += 1
    if not rest_px <= RIGID_PX:
        return False
    quick = moved_px > SPEED_PX * since_s + SMALL_PX
    named = any(verdict.kind in OTHERS for verdict in (*state.watching.last, state.watching.verdict))
    if quick and (named or body.odd < REDETECT_FRAMES):
        return False
    widen(body, FOUND_PX + 0.1 * moved_px)
    body.odd, body.told[:] = 0, False
    return True


def _shift_px(body: TargetBody, one: FloatArray, other: FloatArray, matrix: FloatArray, carrier: FloatArray) -> float:
    """Rms distance [px] of the images of its markers at two displacements (4, 4)."""
    first, second = (
        project_points(matrix, transform_points(carrier, transform_points(D, body.points)))[0] for D in (one, other)
    )
    return float(np.sqrt(((first - second) ** 2).sum(axis=-1).mean()))


def _update_stillness(body: TargetBody, t_ns: int, matrix: FloatArray, carrier: FloatArray) -> None:
    moved_px = _shift_px(body, body.displacement, body.mark, matrix, carrier)
    body.farthest_px = max(body.farthest_px, moved_px)
    if body.farthest_px > STILL_PX:
        body.still = False
    if (t_ns - body.mark_ns) * 1e-9 >= STILL_S:
        body.still = body.farthest_px <= STILL_PX
        body.mark[:], body.mark_ns, body.farthest_px = body.displacement, t_ns, 0.0


# -- model monitor ---------------------------------------------------------------------------------------------


def beside_target(verdict: ModelDiagnosis, state: CoreState) -> ModelDiagnosis:
    """The diagnosis of a round, corrected if the motion that it reports may be one of the target seen by cameras on the
    arm.
    """
    body = state.target
    if body is None or not body.carried or body.t_ns == 0 or verdict.kind in ("ok", *OTHERS):
        return verdict
    return ModelDiagnosis()
