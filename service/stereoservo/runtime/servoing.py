"""A law as a motion source: from a goal's set-points to a joint velocity, until the error holds below its tolerance."""

from __future__ import annotations

import numpy as np

from stereoservo.control.law import JacobianChoice, Options, Scene, Task
from stereoservo.control.laws import LAWS
from stereoservo.control.reasons import Reason
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import invert4, transform_points
from stereoservo.runtime.commands import (
    AdaptiveGain,
    Centre,
    DisplacementTarget,
    FeatureTarget,
    Goal,
    JacobianName,
    PointTarget,
)
from stereoservo.runtime.estimate import ModelArrays, chain_at, points_now
from stereoservo.runtime.motion import Motion, Present
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.state import Servoing
from stereoservo.runtime.targets import (
    MIN_MARKERS,
    Aim,
    Place,
    aim_at,
    camera_index,
    marker_index,
    of_this_model,
    of_unit_height,
)

JACOBIANS: dict[JacobianName, JacobianChoice] = {
    "current": JacobianChoice.CURRENT,
    "desired": JacobianChoice.DESIRED,
    "mean": JacobianChoice.MEAN,
    "fixed-depth": JacobianChoice.FIXED_DEPTH,
}


def place_now(present: Present) -> Place:
    """The body as the estimate has it now. Only with a model."""
    arrays, prediction = present.arrays, present.prediction
    assert arrays is not None
    assert prediction is not None
    H = chain_at(arrays, present.q + present.state.correction)[0]
    return Place(present.settings, arrays, transform_points(H, arrays.marker_points), prediction.operators)


def start_servoing(
    goal: Goal, target: FeatureTarget | PointTarget | DisplacementTarget, present: Present, place: Place
) -> Servoing:
    """The state of a law before its first step, for a body that sets out from ``place``.

    Raises RefusalError naming what makes the goal unusable.
    """
    settings, model = present.settings, present.state.model
    assert model is not None
    name = goal.law or settings.law
    if name not in LAWS:
        raise RefusalError("NO_SUCH_LAW", f"no law {name!r}; laws: {', '.join(LAWS)}", subject=name)
    aim = aim_at(target, place, LAWS[name].needs_pose, model.epoch)
    used = _used_cameras(goal, aim, present)
    gain = goal.gain or settings.gain
    near, far, slope = (
        (gain.near, gain.far, gain.slope) if isinstance(gain, AdaptiveGain) else (gain, gain, 1.0)
    )
    weights, body, centre_target = _centre(goal.centre, aim, place, present, model.epoch)
    source = Servoing(
        goal=goal,
        law=name,
        points=goal.points or settings.points,
        gain_near=near,
        gain_far=far,
        gain_slope=slope,
        jacobian=int(JACOBIANS[goal.jacobian or "mean"]),
        tolerance_px=goal.tolerance_px or settings.tolerance_px,
        hold_frames=goal.hold_frames or settings.hold_frames,
        time_limit_s=goal.time_limit_s or settings.time_limit_s,
        started_ns=present.now_ns,
        lease_s=goal.lease_s,
        lease_until_ns=0,
        used=used,
        set_points=aim.set_points,
        wanted=aim.wanted,
        rates=np.zeros_like(aim.set_points),
        target_points=aim.points,
        target_known=aim.known,
        pose_known=aim.pose_known,
        centre_weights=weights,
        centre_body=body,
        centre_target=centre_target,
        face=aim.face,
        last_frames=sum(e.frames for e in present.state.cameras),
    )
    source.renew_lease(present.now_ns)
    return source


def _used_cameras(goal: Goal, aim: Aim, present: Present) -> FloatArray:
    """(c,) 1 for cameras whose images the law may use."""
    c = len(present.settings.cameras)
    if goal.cameras is None:
        return np.ones(c)
    used = np.zeros(c)
    for name in goal.cameras:
        used[camera_index(name, present.settings)] = 1.0
    shown = int((aim.wanted * used[:, None]).max(axis=0).sum())
    if shown < MIN_MARKERS:
        raise RefusalError(
            "TOO_FEW_MARKERS",
            f"cameras {', '.join(goal.cameras) or '(none)'} show {shown} markers of the goal; at least {MIN_MARKERS} "
            "are needed",
            value=float(shown), threshold=float(MIN_MARKERS), unit="markers",
        )  # fmt: skip
    return used


def _centre(
    centre: Centre | None, aim: Aim, place: Place, present: Present, epoch: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A goal's centre: affine weights (m,) of the markers, or (weights zero) a point (4,) of the body; at the goal.

    The point is stated in the chain's zero. Default: the affine middle of the goal's markers.
    """
    arrays = place.arrays
    weights = np.zeros(len(arrays.marker_ids))
    body = np.zeros(4)
    if centre is None:
        weights = aim.known / max(float(aim.known.sum()), 1.0)
    elif bool(centre.markers) == (centre.point is not None):
        raise RefusalError(
            "CENTRE_UNCLEAR", "the centre is given either by markers or as a point, not by both or none"
        )
    elif centre.point is not None:
        if centre.model_epoch is None:
            raise RefusalError(
                "FRAME_UNKNOWN", "a point as centre needs the model_epoch in whose frame it is"
            )
        of_this_model(centre.model_epoch, epoch)
        now = of_unit_height(np.array(centre.point), arrays, "the centre")[None]
        H = chain_at(arrays, present.q + present.state.correction)[0]
        body = transform_points(invert4(H), now)[0]
        return weights, body, transform_points(aim.displacement, now)[0]
    else:
        for marker in centre.markers:
            weights[marker_index(marker, arrays)] = 1.0
        weights = weights / float(weights.sum())
    return weights, body, (weights[:, None] * aim.points).sum(axis=0)


def servo_step(source: Servoing, present: Present) -> Motion:
    """One step of a law: error, joint velocity, and whether the goal is reached or out of time."""
    arrays, prediction, weights, pixels = present.arrays, present.prediction, present.weights, present.pixels
    if arrays is None or prediction is None or weights is None or pixels is None:
        raise AssertionError("a law runs only with a model")
    zero = np.zeros_like(present.q)
    source.moved_s += present.dt_s
    usable = weights * source.used[:, None]
    active = usable * source.wanted
    visible = int((active > 0.0).sum())
    distance = np.sqrt(((pixels - source.set_points) ** 2).sum(axis=-1))
    error_px = float(np.where(active > 0.0, distance, 0.0).max()) if visible else None
    if source.moved_s > source.time_limit_s:
        return _out_of_time(source, present, error_px)
    seen = int((active.max(axis=0) > 0.0).sum())
    if seen < MIN_MARKERS:
        reason = Reason(
            "TOO_FEW_MARKERS", "hold", "", float(seen), float(MIN_MARKERS), "markers",
            "bring the goal's markers back into view",
        )  # fmt: skip
        return Motion(zero, needs_features=True, error_px=error_px, reasons=(reason,))
    if _reached(source, present, error_px):
        present.emit("goal_reached", id=source.goal.id, message=f"error {error_px:.4f} px", error_px=error_px)
        return Motion(zero, finished=True, error_px=error_px)
    law = LAWS[source.law]
    step = law.step(*scene_and_task(source, present, arrays, usable), options(source, present, error_px))
    return Motion(
        step.velocity, True, source.goal.speed_scale, error_px=error_px, task_error=step.error,
        reasons=law.reasons(step),
    )  # fmt: skip


def scene_and_task(
    source: Servoing, present: Present, arrays: ModelArrays, weights: FloatArray
) -> tuple[Scene, Task]:
    """The present and the goal as laws take them."""
    prediction, pixels = present.prediction, present.pixels
    assert prediction is not None
    assert pixels is not None
    points = points_now(
        arrays, present.q, prediction, pixels, weights, present.state.correction, source.points
    )
    scene = Scene(
        prediction.operators,
        int(Composition.TIP_FIRST if arrays.tip_first else Composition.BASE_FIRST),
        arrays.matrices,
        arrays.camera_centres,
        points,
        pixels,
        weights,
    )
    task = Task(
        source.set_points,
        source.wanted,
        source.rates,
        source.target_points,
        np.full(len(points), 1.0 if source.pose_known else 0.0),
        centre_now(source, present, arrays, points),
        source.centre_target,
        source.face,
    )
    return scene, task


def centre_now(source: Servoing, present: Present, arrays: ModelArrays, points: FloatArray) -> FloatArray:
    """The goal's centre (4,) as it is now, of a body whose markers are at ``points`` (m, 4)."""
    if bool((source.centre_weights != 0.0).any()):
        middle: FloatArray = (source.centre_weights[:, None] * points).sum(axis=0)
        return middle
    H = chain_at(arrays, present.q + present.state.correction)[0]
    moved: FloatArray = transform_points(H, source.centre_body[None])[0]
    return moved


def options(source: Servoing, present: Present, error_px: float | None) -> Options:
    """How the law goes there in this step."""
    return Options(gain=source.gain_near, dt_s=present.dt_s, jacobian=source.jacobian)


def _out_of_time(source: Servoing, present: Present, error_px: float | None) -> Motion:
    reason = Reason(
        "TIME_LIMIT", "hold", "", source.moved_s, source.time_limit_s, "s",
        "no error was measured" if error_px is None
        else f"the error is still {error_px:.3f} px (tolerance {source.tolerance_px} px)",
    )  # fmt: skip
    present.emit(
        "goal_aborted", id=source.goal.id, message="not reached in time", reasons=(reason,), error_px=error_px
    )
    return Motion(np.zeros_like(present.q), finished=True, error_px=error_px)


def _reached(source: Servoing, present: Present, error_px: float | None) -> bool:
    """Whether the error stayed below the tolerance for ``hold_frames`` frames of every camera on average."""
    frames = sum(e.frames for e in present.state.cameras)
    new, cameras = frames - source.last_frames, len(present.state.cameras)
    if new >= cameras:
        source.last_frames = frames
        inside = error_px is not None and error_px <= source.tolerance_px
        source.held = source.held + new // cameras if inside else 0
    return source.held >= source.hold_frames
