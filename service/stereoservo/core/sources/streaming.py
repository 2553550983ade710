"""Moving goals: set-points streamed by a client, filtered, extrapolated between messages, and fed forward to the
control law as a joint velocity.

The client's stamps order its messages and give the target's velocity (`control.filters`). Between two messages, and for
a short time after the last, the target is extrapolated at this velocity. An impossible target is refused and the
previous one kept.
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from stereoservo.control.faces import spaced_in_images
from stereoservo.control.filters import (
    ClientClock,
    arrived,
    empty_track,
    observe,
    predict,
)
from stereoservo.control.law_registry import LAWS
from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.goals.marker_body import (
    MAX_GOAL_RESIDUAL_PX,
    REFINEMENTS,
    BodyState,
    displacement_basis,
    refined_pose,
    view_of,
)
from stereoservo.core.goals.resolve import given_points, of_this_model, raw_set_points
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.settings import MIN_MARKERS
from stereoservo.core.state import ServoGoal, Stream
from stereoservo.kinematics.kernels import transform_points
from stereoservo.messages.goals import FeatureTarget, PointTarget, UpdateGoal
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.linear import damped_least_squares

JUMP_SHARE = 0.1
"""Largest motion of a set-point from one message to the next, as a fraction of the image's width."""
QUIET_S = 0.5
"""Silence of the client [s] after which the goal is static, and may be reached."""
FOLLOWING_REFINEMENTS = 3
PIXELS_AT_ONCE = 512
"""Number of marker pixels above which a step makes only one refinement with all markers, preceded by
some with a `FEW`.
"""
FEW = 8
FEED_FORWARD_DAMPING = 1e-6


def update(command: UpdateGoal, source: ServoGoal, context: StepContext, place: BodyState, epoch: int) -> str:
    """Move the active goal. Raises RefusalError; the goal is then unchanged."""
    if not LAWS[source.law].follows_streams:
        able = [repr(name) for name in LAWS.surest_first() if LAWS[name].follows_streams]
        raise RefusalError(
            "LAW_CANNOT_FOLLOW",
            f"law {source.law!r} follows a path that was planned for a static goal; stream with "
            f"{', '.join(able[:-1])} or {able[-1]}",
            subject=source.law,
        )
    of_this_model(command.target.model_epoch, epoch)
    set_points, required = _set_points(command.target, place)
    required = required * source.wanted  # the set-points that count do not change
    shown = int((required.max(axis=0) > 0.0).sum())
    if shown < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"the moved target shows {shown} of the goal's markers; at least {MIN_MARKERS} are needed",
            value=float(shown),
            threshold=float(MIN_MARKERS),
            unit="markers",
        )
    stream = source.stream or Stream(
        empty_track(len(source.wanted), source.wanted.shape[1]),
        ClientClock(),
        context.now_ns,
        source.set_points,
    )
    stamp_s = _stamp(command, stream, context)
    _no_jump(source, set_points, required, context)
    if source.pose_known:
        _one_body(source, place, set_points, required)
    source.stream = Stream(
        observe(stream.track, stamp_s, set_points, required),
        arrived(stream.clock, stamp_s, context.now_ns * 1e-9),
        context.now_ns,
        np.where(required[..., None] > 0.0, set_points, source.set_points),
    )
    source.renew_lease(context.now_ns)
    return "moved"


def _set_points(target: FeatureTarget | PointTarget, place: BodyState) -> tuple[FloatArray, FloatArray]:
    """The target's ideal pixels (c, m, 2), and (c, m) 1 where it states them."""
    if isinstance(target, FeatureTarget):
        return raw_set_points(target, place)
    points, given = given_points(target, place.arrays)
    points[~given] = 1.0
    pixels, shown = view_of(place.settings, place.arrays, points)
    shown = shown * given[None, :]
    return np.where(shown[..., None] > 0.0, pixels, 0.0), shown


def _stamp(command: UpdateGoal, stream: Stream, context: StepContext) -> float:
    if command.stamp_s is None:
        return context.now_ns * 1e-9
    if not isfinite(command.stamp_s) or command.stamp_s <= stream.track.stamp_s:
        raise RefusalError(
            "STAMP_NOT_LATER",
            f"stamp_s {command.stamp_s} is not later than the one before, {stream.track.stamp_s}: stamps of one stream "
            "increase",
            value=command.stamp_s if isfinite(command.stamp_s) else None,
            threshold=stream.track.stamp_s,
            unit="s",
        )
    return command.stamp_s


def _no_jump(source: ServoGoal, set_points: FloatArray, required: FloatArray, context: StepContext) -> None:
    distance = np.where(required > 0.0, np.sqrt(((set_points - source.set_points) ** 2).sum(axis=-1)), 0.0)
    camera = int(distance.max(axis=-1).argmax())
    limit = JUMP_SHARE * context.settings.cameras[camera].width
    largest = float(distance[camera].max())
    if largest > limit:
        assert context.arrays is not None
        marker = context.arrays.marker_ids[int(distance[camera].argmax())]
        raise RefusalError(
            "TARGET_JUMP",
            f"marker {marker} would jump by {largest:.1f} px; a streamed target moves by at most {limit:.0f} px a "
            "message: send a new goal for another place",
            subject=str(marker),
            value=largest,
            threshold=limit,
            unit="px",
        )


def _one_body(source: ServoGoal, place: BodyState, set_points: FloatArray, required: FloatArray) -> None:
    arrays, points, displacement = place.arrays, source.target_points, _identity()
    basis, rounds = displacement_basis(arrays, place.operators), REFINEMENTS
    if arrays.observation_count > PIXELS_AT_ONCE:
        few = spaced_in_images(np.flatnonzero(required.max(axis=0) > 0.0), set_points, required, FEW)
        some = np.ascontiguousarray(set_points[:, few]), np.ascontiguousarray(required[:, few])
        displacement = refined_pose(arrays, basis, points[few], displacement, *some)[0].displacement
        rounds = 1
    pose, _ = refined_pose(arrays, basis, points, displacement, set_points, required, rounds)
    if not pose.worst_px <= MAX_GOAL_RESIDUAL_PX:
        raise RefusalError(
            "NOT_RIGID",
            f"no displacement of the marker body explains the moved target: marker {pose.worst_marker} is off by "
            f"{pose.worst_px:.2f} px (up to {MAX_GOAL_RESIDUAL_PX} px is accepted)",
            subject=str(pose.worst_marker),
            value=pose.worst_px if isfinite(pose.worst_px) else None,
            threshold=MAX_GOAL_RESIDUAL_PX,
            unit="px",
        )


def follow(source: ServoGoal, context: StepContext, arrays: ModelArrays) -> bool:
    """Move the goal to its current set-points; returns False once the client has been silent for `QUIET_S`.

    The goal then stays at the last set-points that the client sent.
    """
    stream, prediction = source.stream, context.prediction
    assert stream is not None
    assert prediction is not None
    offset_s = stream.clock.offset_s or 0.0
    moving = (context.now_ns - stream.updated_ns) * 1e-9 <= QUIET_S
    pixels, rates, tracked = predict(stream.track, context.now_ns * 1e-9 - offset_s)
    given = source.wanted * tracked
    source.set_points = np.where(given[..., None] > 0.0, pixels, source.set_points) if moving else stream.set_points
    source.rates = rates if moving else np.zeros_like(rates)
    if source.pose_known:
        pose, _ = refined_pose(
            arrays,
            displacement_basis(arrays, prediction.operators),
            source.target_points,
            _identity(),
            source.set_points,
            given,
            1 if arrays.observation_count > PIXELS_AT_ONCE else FOLLOWING_REFINEMENTS,
        )
        source.target_points = pose.points
        source.centre_target = transform_points(pose.displacement, source.centre_target[None])[0]
    if not moving:
        source.stream = None
    return moving


def feed_forward(source: ServoGoal, context: StepContext, active: FloatArray) -> FloatArray:
    """Joint velocity (n,) that moves the markers at the velocity of their set-points."""
    prediction = context.prediction
    assert prediction is not None
    n = prediction.operators.shape[0]
    velocity, _ = damped_least_squares(
        np.ascontiguousarray(prediction.jacobian).reshape(-1, n),
        source.rates.reshape(-1),
        np.repeat(active.reshape(-1), 2),
        FEED_FORWARD_DAMPING,
    )
    return velocity


def _identity() -> FloatArray:
    identity = np.zeros((4, 4))
    for i in range(4):
        identity[i, i] = 1.0
    return identity
