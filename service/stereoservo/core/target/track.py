"""The target body from frame to frame: found, followed, told apart from what else may have moved, and carried on
through drop-outs.

A frame is compared with the pose that the motion predicts at its shutter. What the motion does not explain in one
camera, while another one agrees, is that camera's; what no camera explains is the target's own, where its speed can
have brought it there, and else waits for the watch over the model: a joint zero or a marker that it names is not
followed as a motion of the target.
"""

from __future__ import annotations

from copy import copy

import numpy as np

from stereoservo.core.block import HISTORY
from stereoservo.core.context import StepContext
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitor_state import ModelDiagnosis
from stereoservo.core.prediction import chain_at, gate_threshold, positions_at, undistort_sights
from stereoservo.core.settings import CoreSettings
from stereoservo.core.state import CoreState
from stereoservo.core.target.motion import (
    FOUND_PX,
    FOUND_REST_PX,
    FREEDOMS,
    SIGHT_PX,
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
    gate_sights,
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
"""Markers of a frame that says something of the target."""
FEWEST_TO_FIND = 5
"""Markers, two cameras together, by which a target beside the body is found."""
TOGETHER_NS = 2_000_000
"""Between frames of several cameras that count as of one moment."""
LONGEST_GAP_NS = 250_000_000
FARTHEST_SHARE = 1.0
"""Between two frames of a camera on whose way its sights at another moment are taken; of that gap, how far beyond."""
RECENT_NS = 150_000_000
ROUNDS = 4
"""Of linearisation, for a frame that shows the target elsewhere than expected."""
SMALL_PX = 0.5
"""rms that needs no explanation: models are not exact."""
RIGID_PX = 1.0
"""rms that a motion of the target may leave."""
FOUND_ANEW = 6
"""Frames in a row that only a jump of the target explains, after which it is found anew."""
OTHERS = ("joint_zero", "camera_moved", "marker_slipped")
"""Verdicts of what else may have moved, which the target is not followed into."""
STILL_S, STILL_PX = 0.5, 0.5
"""A target whose markers moved by less in that time stands."""
LONGEST_S = 1.0
"""For so long a target that is not seen is carried on; then it is where that took it."""
LOST_S = 0.5
"""After so long it is found anew, wherever it is."""
IDENTITY = np.eye(4)


def take_frame(camera: int, observation: CameraObservation, context: StepContext) -> None:
    """Follow the target in a frame; a model's body that is the target is then where it was at the shutter."""
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
        if not body.told[camera]:  # what it said before was of a target that stood
            state.cameras[camera].seen_ns[:] = 0
            body.told[camera] = True
        context.derived.room.arrays["marker_points"][:] = _points(body, t_ns)


def _frame_of(
    body: TargetBody, camera: int, observation: CameraObservation, context: StepContext
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What a frame shows of the target, as `target_sights` has it, without markers of a model's body that slipped."""
    arrays = context.derived.arrays
    assert arrays is not None
    sights, variances, seen = target_sights(
        body.ids, observation.ids.astype(np.int64), np.array(observation.pixels, np.float64, order="C"),
        np.array(observation.covariances, np.float64, order="C"), arrays.lenses[camera],
    )  # fmt: skip
    return sights, variances, seen * (1.0 - context.state.watching.masked) if body.carried else seen


def present_arrays(context: StepContext) -> ModelArrays | None:
    """The model with the markers of a body that is the target where they are now."""
    arrays, body = context.derived.arrays, context.state.target
    if arrays is None or body is None or not body.carried or body.t_ns == 0:
        return arrays
    points = _points(body, context.now_ns)
    context.derived.room.arrays["marker_points"][:] = points
    here = copy(arrays)
    object.__setattr__(here, "marker_points", points)
    return here


def pose_at(body: TargetBody, t_ns: int) -> tuple[FloatArray, FloatArray]:
    """Its displacement (4, 4) and twist (6,) at ``t_ns``."""
    ahead_s = min((t_ns - body.t_ns) * 1e-9, LONGEST_S)
    found: tuple[FloatArray, FloatArray] = after(
        body.displacement, body.basis, body.twist, body.rate, ahead_s
    )
    return found


def _points(body: TargetBody, t_ns: int) -> FloatArray:
    points: FloatArray = transform_points(pose_at(body, t_ns)[0], body.points)
    return points


def _carrier(body: TargetBody, t_ns: int, state: CoreState, arrays: ModelArrays) -> FloatArray | None:
    """What is between the target's frame and the cameras' at ``t_ns``; None where the joints then are not known."""
    if not body.carried:
        return IDENTITY
    block, n = state.block, len(arrays.zero)
    known, q = positions_at(
        block.history_ns, block.history_positions.reshape((HISTORY, n)), block.numbers.history_count, t_ns
    )
    return chain_at(arrays, q)[0] if known else None


@kernel
def target_sights(
    wanted: IntArray, ids: IntArray, pixels: FloatArray, covariances: FloatArray, lens: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of the markers ``wanted`` (k,), what a frame of ``ids`` (s,), raw ``pixels`` (s, 2) with ``covariances``
    (s, 2, 2) shows: ideal pixels (k, 2), variances of a coordinate (k,) [px²], and which are seen (k,) 1 or 0.
    """
    ideal, spread, possible = undistort_sights(lens, pixels, covariances)
    k = wanted.size
    found, variances, seen = np.zeros((k, 2)), np.ones(k), np.zeros(k)
    for s in range(ids.size):
        for i in range(k):
            if ids[s] == wanted[i] and possible[s]:
                found[i] = ideal[s]
                variances[i] = 0.5 * (spread[s, 0, 0] + spread[s, 1, 1]) + SIGHT_PX * SIGHT_PX
                seen[i] = 1.0
    return found, variances, seen


def displacements_of(arrays: ModelArrays) -> FloatArray | None:
    """Twists (6, 4, 4) that span all displacements; None where neither model nor arm knows them."""
    if arrays.metric_basis is not None:
        return arrays.metric_basis
    return arrays.generators if len(arrays.generators) == FREEDOMS else None


# -- finding it ------------------------------------------------------------------------------------------------


def _find(
    body: TargetBody, camera: int, t_ns: int, sights: FloatArray, seen: FloatArray, carrier: FloatArray,
    arrays: ModelArrays,
) -> None:  # fmt: skip
    """Find the target by this frame, and those before of the other cameras."""
    basis, metric = displacements_of(arrays), arrays.metric_basis is not None
    if basis is None:
        return
    if body.carried:
        begin(body, basis, metric, arrays.matrices, carrier, t_ns)
        return
    at_ns, there, shown = _at_one_moment(body, camera, t_ns, sights, seen)
    body.first[camera], body.first_seen[camera], body.seen_ns[camera] = sights, seen, t_ns
    if int((shown.max(axis=1) > 0.0).sum()) < 2:
        return
    points, known = find_shape(arrays.matrices, there, shown, arrays.plane_at_infinity)
    pixels, _ = project_points(arrays.matrices, points)
    apart = np.sqrt(((pixels - there) ** 2).sum(axis=-1)) * shown
    # Rays that do not meet: markers that were swapped, or a reflection.
    wrong = (known > 0.0) & ~(apart.max(axis=0) <= FOUND_REST_PX)
    known[wrong], shown[:, wrong] = 0.0, 0.0
    if not body.stated:
        if int(known.sum()) < FEWEST_TO_FIND:
            return
        _keep(body, known > 0.0, points)
        begin(body, basis, metric, arrays.matrices, carrier, at_ns)
        return
    if int((shown.max(axis=0) > 0.0).sum()) < FEWEST:
        return
    D, rest = find_stated(basis, arrays, body.points, there, shown)
    if rest > FOUND_REST_PX:
        body.rest_px = rest
        return
    body.displacement[:] = D
    begin(body, basis, metric, arrays.matrices, carrier, at_ns)


def _at_one_moment(
    body: TargetBody, camera: int, t_ns: int, sights: FloatArray, seen: FloatArray
) -> tuple[int, FloatArray, FloatArray]:
    """When another camera saw the target last, what the cameras show of it then (c, k, 2) and of which markers (c, k)
    1 or 0: this one on its way from its frame before to this frame, since the target moves between their shutters.
    """
    there, shown = body.first.copy(), body.first_seen.copy()
    others = shown.max(axis=1) > 0.0
    others[camera] = False
    at_ns = int(body.seen_ns[others].max()) if others.any() else t_ns
    shown *= (np.abs(body.seen_ns - at_ns) <= TOGETHER_NS)[:, None]
    there[camera], shown[camera] = sights, seen
    if abs(t_ns - at_ns) <= TOGETHER_NS:
        return at_ns, there, shown
    before, gap_ns = body.first[camera], t_ns - int(body.seen_ns[camera])
    share = (at_ns - t_ns) / gap_ns if 0 < gap_ns <= LONGEST_GAP_NS else np.inf
    if -1.0 - FARTHEST_SHARE <= share <= FARTHEST_SHARE:
        there[camera] += share * (sights - before)
        shown[camera] *= body.first_seen[camera]
    else:
        shown[camera] = 0.0
    return at_ns, there, shown


def _keep(body: TargetBody, known: np.ndarray[tuple[int], np.dtype[np.bool_]], points: FloatArray) -> None:
    """The target has these markers alone, at ``points`` (k, 4)."""
    body.ids, body.points = body.ids[known].copy(), np.ascontiguousarray(points[known])
    body.first, body.first_seen = body.first[:, known].copy(), body.first_seen[:, known].copy()
    body.stated = True


def restart(state: CoreState, arrays: ModelArrays, settings: CoreSettings) -> None:
    """A model is in use from here on: with its cameras found anew, what was followed is found anew, too, and a body
    that is said to move is followed from the first frame.
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


def tell_untrackable(context: StepContext) -> None:
    """Warn where the body is said to move, and the model that was taken tells no displacements."""
    model = context.state.model
    if model is None or context.state.target is not None or not context.settings.body_moves:
        return
    reason = Reason(
        "TARGET_NOT_TRACKABLE", "slow",
        hint="calibrate with a body by which the model becomes metric, or with an arm of six joints",
    )  # fmt: skip
    context.emit(
        "warning",
        message=f"[scene] moves, but the model is {model.stratum}, and the {len(model.joint_names)} joints do not make "
        "all displacements: the body is not followed, and where it moves a camera or a joint will be blamed",
        reasons=(reason,),
    )


# -- following it ----------------------------------------------------------------------------------------------


def _follow(
    body: TargetBody, camera: int, t_ns: int, frame: tuple[FloatArray, FloatArray, FloatArray], carrier: FloatArray,
    context: StepContext,
) -> None:  # fmt: skip
    sights, variances, seen = frame
    state, arrays = context.state, context.derived.arrays
    assert arrays is not None
    stood = pose_at(body, int(body.seen_ns.max()))[0]
    dt_s = min((t_ns - body.t_ns) * 1e-9, LONGEST_S)
    if dt_s > 0.0:
        elapse(body.displacement, body.basis, body.drift, (body.twist, body.rate, body.covariance), dt_s)
        body.t_ns = t_ns
    pose = pose_at(body, t_ns)[0]
    view = arrays.matrices[camera : camera + 1], carrier, sights, seen
    left, J = compare(body.basis, body.points, pose, view)
    gate = gate_threshold(context.settings.gate_sigma)
    since_s = (t_ns - int(body.seen_ns.max())) * 1e-9
    lost = (t_ns - int(max(body.seen_ns.max(), body.odd_ns.max()))) * 1e-9 > LOST_S
    if lost and not body.carried:  # one camera alone may take a flat one for its mirror image
        body.t_ns, body.seen_ns[:], body.odd_ns[:], body.first_seen[:] = 0, 0, 0, 0.0
        _find(body, camera, t_ns, sights, seen, carrier, arrays)
        return
    used = None if lost else _explained(body, left, J, variances, seen, gate)
    sudden = used is None or float((left * left)[used > 0.0].sum(axis=-1).mean()) > RIGID_PX**2
    if used is None:
        found, moved_px, rest_px = jumped(body.basis, body.points, pose, view)
        stops = _apart_px(body, stood, found, *view[:2]) < min(moved_px, SPEED_PX * since_s + SMALL_PX)
        if lost and rest_px <= RIGID_PX:
            widen(body, FOUND_PX)
            body.odd, body.told[:] = 0, False
        elif lost or not _jumps(body, camera, t_ns, (0.0 if stops else moved_px, rest_px), since_s, state):
            return
        if stops:  # as it never went as fast as it seemed to
            body.twist[:], body.rate[:] = 0.0, 0.0
        body.displacement[:] = found
        left, J = compare(body.basis, body.points, found, view)
        used = _explained(body, left, J, variances, seen, gate)
        if used is None:
            return
    if sudden and body.carried:
        # What the other cameras' newest frames were compared with was not where it is.
        for sighting in state.watching.sightings:
            sighting.t_ns = 0
    _fold(body, left, J, view, variances, used, ROUNDS if sudden else 1)
    body.seen_ns[camera], body.odd_ns[camera] = t_ns, 0
    _look_whether_still(body, t_ns, arrays.matrices[camera : camera + 1], carrier)


def _fold(
    body: TargetBody, left: FloatArray, J: FloatArray,
    view: View, variances: FloatArray, used: FloatArray, rounds: int,
) -> None:  # fmt: skip
    """Correct the state by a frame, as of `fold_frame`, linearised anew about what comes of it (Bell and Cathey 1993):
    one large step from far off leaves pixels that nothing explains, and a joint would be blamed for them.
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
    """The markers (k,) 1 or 0 that the predicted motion explains; None where it does not explain most of them."""
    pose = np.ascontiguousarray(body.covariance[:FREEDOMS, :FREEDOMS])
    within, used, count = gate_sights(left, J, variances, seen, pose, gate)
    if used >= FEWEST and 2 * used > count:
        return within
    if float((left * left).sum()) <= 2.0 * count * SMALL_PX**2:
        return seen
    return None


def _jumps(
    body: TargetBody, camera: int, t_ns: int, jump: tuple[float, float], since_s: float, state: CoreState
) -> bool:
    """Whether a frame that the predicted motion does not explain, is that of a target which went otherwise: by so many
    pixels, and what that leaves. It may be something else, or not decided yet.
    """
    moved_px, rest_px = jump
    body.odd_ns[camera] = t_ns
    recent = np.maximum(body.seen_ns, body.odd_ns) > t_ns - RECENT_NS
    if bool((body.odd_ns[recent] == 0).any()):
        return False  # the others agree: it is the camera
    body.odd += 1
    if not rest_px <= RIGID_PX:
        return False
    quick = moved_px > SPEED_PX * since_s + SMALL_PX
    named = any(verdict.kind in OTHERS for verdict in (*state.watching.last, state.watching.verdict))
    if quick and (named or body.odd < FOUND_ANEW):
        return False
    widen(body, FOUND_PX + 0.1 * moved_px)
    body.odd, body.told[:] = 0, False
    return True


def _apart_px(
    body: TargetBody, one: FloatArray, other: FloatArray, matrix: FloatArray, carrier: FloatArray
) -> float:
    """How far the images of its markers are apart at two displacements (4, 4), rms [px]."""
    here, there = (
        project_points(matrix, transform_points(carrier, transform_points(D, body.points)))[0]
        for D in (one, other)
    )
    return float(np.sqrt(((here - there) ** 2).sum(axis=-1).mean()))


def _look_whether_still(body: TargetBody, t_ns: int, matrix: FloatArray, carrier: FloatArray) -> None:
    moved_px = _apart_px(body, body.displacement, body.mark, matrix, carrier)
    body.farthest_px = max(body.farthest_px, moved_px)
    if body.farthest_px > STILL_PX:
        body.still = False
    if (t_ns - body.mark_ns) * 1e-9 >= STILL_S:
        body.still = body.farthest_px <= STILL_PX
        body.mark[:], body.mark_ns, body.farthest_px = body.displacement, t_ns, 0.0


# -- the watch -------------------------------------------------------------------------------------------------


def beside_target(verdict: ModelDiagnosis, state: CoreState) -> ModelDiagnosis:
    """The verdict of a round, where the target that cameras on the arm look at may have moved as it says of them."""
    body = state.target
    if body is None or not body.carried or body.t_ns == 0 or verdict.kind in ("ok", *OTHERS):
        return verdict
    return ModelDiagnosis()
