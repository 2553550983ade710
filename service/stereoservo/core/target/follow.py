"""Goals that hold relative to a moving target: their current set-points, and the velocities that are fed forward.

With cameras on the arm the set-points are constant in the images and the body moves; with static cameras the set-points
move with the target. The features of incidences are treated likewise.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.goals.resolve import camera_index, ideal_pixels, marker_indices
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.prediction import chain_at
from stereoservo.core.sources.progress import error_of_run
from stereoservo.core.state import Followed, FollowedFeatures, FollowedTarget, IncidenceGoal, ServoGoal
from stereoservo.core.target.motion import (
    FOUND_REST_PX,
    TargetBody,
    find_shape,
    find_stated,
    generator_of,
    pixel_rates,
    seen_through,
    target_body,
)
from stereoservo.core.target.track import FEWEST, FEWEST_TO_FIND, IDENTITY, displacements_of, pose_at
from stereoservo.kinematics.kernels import invert4, multiply4_into, project_points, transform_points
from stereoservo.messages.goals import Goal
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray

Follower = ServoGoal | IncidenceGoal
"""Goals that may follow a target."""
MISSED_FRAMES = 1.5
"""Number of periods of the slowest camera by which the newest frame may be newer than the last one that showed the
target.
"""


def require_followable(goal: Goal, follows_streams: bool, law: str, pose_known: bool, context: StepContext) -> None:
    """Raises RefusalError if a goal cannot follow the markers that it names."""
    arrays = context.arrays
    assert arrays is not None
    ids = goal.follow_markers
    if not follows_streams:
        raise RefusalError(
            "LAW_CANNOT_FOLLOW",
            f"law {law!r} follows a path that was planned for a static goal",
            subject=law,
        )
    if not pose_known:
        raise RefusalError("TOO_FEW_MARKERS", "a goal that follows a target shows three markers or more in two cameras")
    if displacements_of(arrays) is None:
        raise RefusalError(
            "TARGET_NOT_TRACKABLE",
            "neither the model nor an arm of six joints tells what a displacement is: calibrate with a body by which "
            "the model becomes metric",
        )
    if _carried(context):
        marker_indices(ids, arrays)
        if goal.centre is not None and goal.centre.point is not None:
            raise RefusalError(
                "CENTRE_UNCLEAR", "of a target that moves, the centre is given by markers, not as a point"
            )
        return
    own = [str(marker) for marker in ids if marker in arrays.index]
    if own:
        raise RefusalError(
            "NO_SUCH_MARKER",
            f"marker {', '.join(own)} is on the body that the arm carries; markers of the target are others, which "
            "both cameras see",
            subject=own[0],
        )
    if len(ids) < FEWEST_TO_FIND and not goal.follow_seen:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"{len(ids)} markers of the target are named; at least {FEWEST_TO_FIND} are needed",
            value=float(len(ids)),
            threshold=float(FEWEST_TO_FIND),
            unit="markers",
        )
    if goal.follow_seen:
        _stated(goal, context, arrays)


def _carried(context: StepContext) -> bool:
    return context.settings.cameras[0].mount == "eye_in_hand"


def _stated(
    goal: Goal, context: StepContext, arrays: ModelArrays
) -> tuple[np.ndarray, FloatArray, FloatArray, FloatArray]:
    """Ids (k,) of the target's markers that the goal shows for the held pose, their points (k, 4), ideal pixels (c, k,
    2) and which are given (c, k) 1 or 0. Raises RefusalError.
    """
    ids = np.array(sorted(goal.follow_markers), dtype=np.int64)
    cameras = len(context.settings.cameras)
    pixels, seen = np.zeros((cameras, len(ids), 2)), np.zeros((cameras, len(ids)))
    for name, markers in goal.follow_seen.items():
        c = camera_index(name, context.settings)
        for k, marker in enumerate(ids.tolist()):
            if marker in markers:
                pixels[c, k] = ideal_pixels(arrays.lenses[c], np.array([markers[marker]], dtype=np.float64))[0]
                seen[c, k] = float(np.isfinite(pixels[c, k]).all())
    points, known = find_shape(arrays.matrices, pixels, seen, arrays.plane_at_infinity)
    found = known > 0.0
    if int(found.sum()) < FEWEST:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"{int(found.sum())} of the target's markers are shown by two cameras where the goal holds; at least "
            f"{FEWEST} are needed: teach it with the target in view",
            value=float(found.sum()),
            threshold=float(FEWEST),
            unit="markers",
        )
    return ids[found], np.ascontiguousarray(points[found]), pixels[:, found].copy(), seen[:, found].copy()


def start_following(source: Follower, context: StepContext) -> None:
    """Start a goal that follows a target: the target is searched, unless it is followed already."""
    arrays, state, goal = context.arrays, context.state, source.goal
    assert arrays is not None
    cameras, body = len(context.settings.cameras), state.target
    reference, rest_px = IDENTITY.copy(), np.inf
    if _carried(context):
        if body is None or not body.carried:
            state.target = target_body(arrays.ids, arrays.marker_points, cameras, carried=True)
    elif goal.follow_seen:
        ids, points, pixels, seen = _stated(goal, context, arrays)
        if body is not None and not body.carried and body.t_ns > 0 and np.array_equal(body.ids, ids):
            reference, rest_px = find_stated(body.basis, arrays, body.points, pixels, seen)
        if rest_px > FOUND_REST_PX:
            reference = IDENTITY.copy()
            state.target = target_body(ids, points, cameras, carried=False)
    else:
        ids = np.array(sorted(goal.follow_markers), dtype=np.int64)
        if body is not None and not body.carried and body.t_ns > 0 and bool(np.isin(body.ids, ids).all()):
            reference = pose_at(body, context.now_ns)[0]
        else:
            state.target = target_body(ids, None, cameras, carried=False)
    if isinstance(source, IncidenceGoal):
        source.followed = FollowedFeatures(reference=reference, fixed=source.fixed.copy(), drift=np.zeros((4, 4)))
        return
    source.followed = Followed(
        reference=reference,
        set_points=source.set_points.copy(),
        target_points=source.target_points.copy(),
        centre_target=source.centre_target.copy(),
    )


def follow_target(source: Follower, context: StepContext) -> Reason | None:
    """Move a goal to the current pose of its target, with the velocities of its set-points; returns the reason if that
    is impossible.

    Events report when the target is seen, lost, and reached while it moves.
    """
    waits = _brought(source, context)
    followed, run = source.followed, context.state.block.numbers.run
    assert followed is not None
    if waits is not None or _missed(context):
        run.held = 0  # earlier frames inside the tolerance referred to a visible target
    if waits is not None:
        if followed.told in ("target_seen", "target_met"):
            _report("target_unseen", f"{waits.hint}; the arm waits until it is there again", source, context)
    elif followed.told in ("", "target_unseen"):
        _report("target_seen", "the target is seen: the goal goes with it", source, context)
    elif followed.told == "target_seen" and run.held >= source.hold_frames and run.measured:
        message = f"error {run.newest_px:.4f} px on the target as it moves, for {run.held} frames"
        _report("target_met", message, source, context)
    return waits


def _missed(context: StepContext) -> bool:
    """Whether the cameras deliver frames without the target: the error is then relative to its predicted pose."""
    body, slowest_hz = context.state.target, min(camera.rate_hz for camera in context.settings.cameras)
    assert body is not None
    newest_ns = max(estimate.accepted_ns + estimate.offset_ns for estimate in context.state.cameras)
    return (newest_ns - int(body.seen_ns.max())) * 1e-9 > MISSED_FRAMES / slowest_hz


def _report(
    kind: Literal["target_seen", "target_unseen", "target_met"], message: str, source: Follower, context: StepContext
) -> None:
    assert source.followed is not None
    source.followed.told = kind
    ids = ", ".join(str(marker) for marker in source.goal.follow_markers)
    context.emit(kind, id=source.goal.id, name=ids, message=message, error_px=error_of_run(context.state.block))


def _brought(source: Follower, context: StepContext) -> Reason | None:
    body = context.state.target
    if isinstance(source, ServoGoal):
        source.rates = np.zeros_like(source.set_points)
    if body is None or body.t_ns == 0:
        return _not_found(source, body, context)
    unseen_s = (context.now_ns - int(body.seen_ns.max())) * 1e-9
    if unseen_s > context.settings.limits.coast_s:
        return _unseen(
            source, f"the target was not seen for {unseen_s:.2f} s", unseen_s, context.settings.limits.coast_s
        )
    if isinstance(source, IncidenceGoal):
        _bring_features(source, body, context)
    else:
        _bring_set_points(source, body, context)
    return None


def _bring_features(source: IncidenceGoal, body: TargetBody, context: StepContext) -> None:
    arrays, followed = context.arrays, source.followed
    assert arrays is not None
    assert followed is not None
    _, twist = pose_at(body, context.now_ns + context.inputs.period_ns // 2)
    if body.carried:
        carried = seen_through(body.basis, chain_at(arrays, context.q)[0])
        followed.drift = -generator_of(carried, twist)
        return
    moved = _moved(followed, body, context)
    for k in range(len(source.fixed)):
        source.fixed[k] = transform_points(moved, followed.fixed[k])
    followed.drift = generator_of(body.basis, twist)


def _moved(followed: FollowedTarget, body: TargetBody, context: StepContext) -> FloatArray:
    """Displacement (4, 4) of the target since its reference."""
    moved = np.empty((4, 4))
    multiply4_into(pose_at(body, context.now_ns)[0], invert4(followed.reference), moved)
    return moved


def _bring_set_points(source: ServoGoal, body: TargetBody, context: StepContext) -> None:
    arrays, followed = context.arrays, source.followed
    assert arrays is not None
    assert followed is not None
    pose, twist = pose_at(body, context.now_ns + context.inputs.period_ns // 2)
    if body.carried:
        carrier = chain_at(arrays, context.q)[0]
        points = transform_points(pose, body.points)
        source.rates = -pixel_rates(body.basis, twist, arrays.matrices, carrier, points)
        return
    moved = _moved(followed, body, context)
    source.target_points = transform_points(moved, followed.target_points)
    source.centre_target = transform_points(moved, followed.centre_target[None])[0]
    current, _ = project_points(arrays.matrices, source.target_points)
    followed_pixels, _ = project_points(arrays.matrices, followed.target_points)
    source.set_points = current + np.where(source.wanted[..., None] > 0.0, followed.set_points - followed_pixels, 0.0)
    source.rates = pixel_rates(body.basis, twist, arrays.matrices, IDENTITY, source.target_points)


def _not_found(source: Follower, body: TargetBody | None, context: StepContext) -> Reason:
    since_s = np.inf if body is None else (context.now_ns - int(body.seen_ns.max())) * 1e-9
    if body is None or body.rest_px <= FOUND_REST_PX or since_s > context.settings.limits.coast_s:
        return _unseen(source, "the target is looked for: bring its markers into the view of two cameras")
    ids = ", ".join(str(marker) for marker in source.goal.follow_markers)
    hint = (
        f"its markers are seen, but no motion of the part that was taught explains them: {body.rest_px:.1f} px is "
        f"left, {FOUND_REST_PX:g} px is allowed; it is another part, or one of its markers slipped"
    )
    if context.arrays is None or context.arrays.to_euclidean is None:
        hint += ", or it has turned by 60 degrees and more, which only a metric model distinguishes"
    return Reason("TARGET_DIFFERS", "hold", ids, body.rest_px, FOUND_REST_PX, "px", hint)


def _unseen(source: Follower, hint: str, value: float | None = None, limit: float | None = None) -> Reason:
    ids = ", ".join(str(marker) for marker in source.goal.follow_markers)
    return Reason("TARGET_UNSEEN", "hold", ids, value, limit, "s" if value is not None else "", hint)


def is_static(body: TargetBody | None) -> bool:
    """Whether a goal's target is static, so that the goal may be reached for good."""
    return body is not None and body.t_ns > 0 and body.still
