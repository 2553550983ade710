"""A law as a motion source: from a goal's set-points to a joint velocity, until the error holds below its tolerance."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereoservo.control.faces import FLAT_PX, NOT_CHOSEN, choose_face, find_faces, law_scene
from stereoservo.control.gains import GainCurve, gain_at
from stereoservo.control.law import JacobianChoice, Options, Scene, Task
from stereoservo.control.laws import LAWS
from stereoservo.control.mobility_kernel import self_motion_from_limits
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
from stereoservo.runtime.plan_following import on_the_way
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.state import LawRun, Servoing
from stereoservo.runtime.streaming import feed_forward, follow
from stereoservo.runtime.target_checks import MIN_MARKERS, Place
from stereoservo.runtime.targets import Aim, aim_at, camera_index, marker_index, of_this_model, of_unit_height

JACOBIANS: dict[JacobianName, JacobianChoice] = {
    "current": JacobianChoice.CURRENT,
    "desired": JacobianChoice.DESIRED,
    "mean": JacobianChoice.MEAN,
    "fixed-depth": JacobianChoice.FIXED_DEPTH,
}

RIGID_FREEDOMS = 6
SELF_MOTION_RATE = 0.5
"""[1/s], of a joint's half range: how fast self-motion takes it from a limit."""


def place_now(present: Present) -> Place:
    """The body as the estimate has it now. Only with a model."""
    arrays, prediction = present.arrays, present.prediction
    assert arrays is not None
    assert prediction is not None
    H = chain_at(arrays, present.q + present.state.correction)[0]
    points = transform_points(H, arrays.marker_points)
    seen = (
        np.zeros((len(present.settings.cameras), len(points))) if present.weights is None else present.weights
    )
    faces = find_faces(points, arrays.matrices, FLAT_PX, arrays.camera_centres, seen, prediction.operators)
    return Place(present.settings, arrays, points, prediction.operators, faces)


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
    needs_pose = LAWS[name].needs_pose or name == "trajectory"  # a way is planned to a pose
    aim = aim_at(target, place, needs_pose, model.epoch)
    weights, body, centre_target = _centre(goal.centre, aim, place, present, model.epoch)
    source = Servoing(
        **run_fields(goal, present, used_cameras(goal, aim.wanted, present)),
        law=name,
        jacobian=int(JACOBIANS[goal.jacobian or "mean"]),
        set_points=aim.set_points,
        wanted=aim.wanted,
        rates=np.zeros_like(aim.set_points),
        target_points=aim.points,
        target_known=aim.known,
        pose_known=aim.pose_known,
        centre_weights=weights,
        centre_body=body,
        centre_target=centre_target,
        faces=place.faces,
        choice=NOT_CHOSEN._replace(triple=aim.face),
    )
    source.renew_lease(present.now_ns)
    return source


def run_fields(goal: Goal, present: Present, used: FloatArray) -> dict[str, Any]:
    """Fields of a `LawRun` before its first step: what the goal says, or else the cell."""
    settings = present.settings
    gain = goal.gain or settings.gain
    near, far, slope = (
        (gain.near, gain.far, gain.slope) if isinstance(gain, AdaptiveGain) else (gain, gain, 1.0)
    )
    return {
        "goal": goal,
        "points": goal.points or settings.points,
        "gain_near": near,
        "gain_far": far,
        "gain_slope": slope,
        "tolerance_px": goal.tolerance_px or settings.tolerance_px,
        "hold_frames": goal.hold_frames or settings.hold_frames,
        "time_limit_s": goal.time_limit_s or settings.time_limit_s,
        "started_ns": present.now_ns,
        "lease_s": goal.lease_s,
        "lease_until_ns": 0,
        "used": used,
        "last_frames": sum(e.frames for e in present.state.cameras),
    }


def used_cameras(goal: Goal, wanted: FloatArray, present: Present) -> FloatArray:
    """(c,) 1 for cameras that the law may use. Raises RefusalError where they show too few ``wanted`` (c, m)."""
    c = len(present.settings.cameras)
    if goal.cameras is None:
        return np.ones(c)
    used = np.zeros(c)
    for name in goal.cameras:
        used[camera_index(name, present.settings)] = 1.0
    shown = int((wanted * used[:, None]).max(axis=0).sum())
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
    arrays, prediction, pixels = present.arrays, present.prediction, present.pixels
    if arrays is None or prediction is None or present.weights is None or pixels is None:
        raise AssertionError("a law runs only with a model")
    usable = present.weights * source.used[:, None]
    streamed = follow(source, present, arrays) if source.stream is not None else False
    active = usable * source.wanted
    distance = np.sqrt(((pixels - source.set_points) ** 2).sum(axis=-1))
    error_px = float(np.where(active > 0.0, distance, 0.0).max()) if bool((active > 0.0).any()) else None
    seen = int((active.max(axis=0) > 0.0).sum())
    ended = run_ended(source, present, error_px, seen, may_end=not streamed)
    if ended is not None:
        return ended
    law = LAWS[source.law]
    scene, task = choose(source, present, *scene_and_task(source, present, arrays, usable))
    if source.law == "trajectory":
        if source.plan is None and source.pose_known:
            hint = "the way is planned from where the arm comes to rest"
            waits = Reason("PLANNING", "slow", hint=hint)
            return Motion(np.zeros_like(present.q), error_px=error_px, reasons=(waits,))
        if source.plan is not None:
            task = on_the_way(source, present, scene, task)
    step = law.step(scene, task, options(source, present, error_px))
    velocity = step.velocity
    if streamed:
        velocity = velocity + feed_forward(source, present, active)
    if len(velocity) > RIGID_FREEDOMS and source.plan is None:  # a plan has kept off the limits itself
        velocity = velocity + away_from_limits(present)
    return Motion(
        velocity, True, source.goal.speed_scale, error_px=error_px, task_error=step.error,
        reasons=law.reasons(step),
    )  # fmt: skip


def away_from_limits(present: Present) -> FloatArray:
    """Self-motion (n,) of a redundant arm that takes its joints from their limits; the body stays where it is."""
    assert present.prediction is not None
    limits = present.settings.limits
    rows = np.ascontiguousarray(present.prediction.jacobian).reshape(-1, len(present.q))
    return self_motion_from_limits(
        rows, present.q, limits.position_min, limits.position_max, SELF_MOTION_RATE
    )


def run_ended(
    source: LawRun, present: Present, error_px: float | None, seen: int, *, may_end: bool = True
) -> Motion | None:
    """What a law's step comes to where it is out of time, sees too little, or is there; None: it goes on.

    ``seen``: markers of the goal that are seen. ``may_end``: off for a goal that moves still.
    """
    source.moved_s += present.dt_s
    source.error_px = error_px
    zero = np.zeros_like(present.q)
    if source.moved_s > source.time_limit_s:
        return _out_of_time(source, present, error_px)
    if seen < MIN_MARKERS:
        reason = Reason(
            "TOO_FEW_MARKERS", "hold", "", float(seen), float(MIN_MARKERS), "markers",
            "bring the goal's markers back into view",
        )  # fmt: skip
        return Motion(zero, needs_features=True, error_px=error_px, reasons=(reason,))
    if _settled(source, present, error_px) and may_end:
        present.emit("goal_reached", id=source.goal.id, message=f"error {error_px:.4f} px", error_px=error_px)
        return Motion(zero, finished=True, reached=True, error_px=error_px)
    return None


def composition_of(arrays: ModelArrays) -> int:
    """How the arm's joints compose, for laws and plans."""
    return int(Composition.TIP_FIRST if arrays.tip_first else Composition.BASE_FIRST)


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
        composition_of(arrays),
        arrays.matrices,
        arrays.camera_centres,
        points,
        pixels,
        weights,
    )
    task = Task(
        source.set_points,
        source.wanted,
        np.zeros_like(source.rates),
        source.target_points,
        np.full(len(points), 1.0 if source.pose_known else 0.0),
        centre_of(source, present.q + present.state.correction, arrays, points),
        source.centre_target,
        source.choice.triple,
    )
    return scene, task


def choose(source: Servoing, present: Present, scene: Scene, task: Task) -> tuple[Scene, Task]:
    """The scene and the task on the face that the law works on now; a change of it is told."""
    assert present.arrays is not None
    if not source.pose_known:
        return scene, task
    before = source.choice
    if before.cameras > 0 and not present.observations:  # nothing has been seen since
        return law_scene(scene, before), task
    choice = choose_face(source.faces, scene, task, before)
    if choice.cameras == 0:  # nobody sees three markers of one face: on with the former, by the kinematics
        return scene, task
    source.choice = choice
    if choice.changed and before.cameras > 0 and choice.face != before.face:
        ids = ", ".join(str(present.arrays.marker_ids[int(i)]) for i in choice.triple)
        present.emit(
            "goal_face",
            id=source.goal.id,
            name=ids,
            message=f"works on the face of markers {ids} from here on",
        )
    return law_scene(scene, choice), task._replace(face=choice.triple)


def centre_of(source: Servoing, joints: FloatArray, arrays: ModelArrays, points: FloatArray) -> FloatArray:
    """The goal's centre (4,) of a body whose markers are at ``points`` (m, 4), with the arm at ``joints`` (n,)."""
    if bool((source.centre_weights != 0.0).any()):
        middle: FloatArray = (source.centre_weights[:, None] * points).sum(axis=0)
        return middle
    moved: FloatArray = transform_points(chain_at(arrays, joints)[0], source.centre_body[None])[0]
    return moved


def options(source: LawRun, present: Present, error_px: float | None) -> Options:
    """How the law goes there in this step."""
    gain = gain_at(GainCurve(source.gain_near, source.gain_far, source.gain_slope), error_px)
    jacobian = source.jacobian if isinstance(source, Servoing) else int(JacobianChoice.CURRENT)
    return Options(gain=gain, dt_s=present.dt_s, jacobian=jacobian)


def _out_of_time(source: LawRun, present: Present, error_px: float | None) -> Motion:
    reason = Reason(
        "TIME_LIMIT", "hold", "", source.moved_s, source.time_limit_s, "s",
        "no error was measured" if error_px is None
        else f"the error is still {error_px:.3f} px (tolerance {source.tolerance_px} px)",
    )  # fmt: skip
    present.emit(
        "goal_aborted", id=source.goal.id, message="not reached in time", error_px=error_px,
        reasons=(reason, *source.watch.reasons),
    )  # fmt: skip
    return Motion(np.zeros_like(present.q), finished=True, error_px=error_px)


def _settled(source: LawRun, present: Present, error_px: float | None) -> bool:
    """Whether the error stayed below the tolerance for ``hold_frames`` frames of every camera on average."""
    frames = sum(e.frames for e in present.state.cameras)
    new, cameras = frames - source.last_frames, len(present.state.cameras)
    if new >= cameras:
        source.last_frames = frames
        inside = error_px is not None and error_px <= source.tolerance_px
        source.held = source.held + new // cameras if inside else 0
    return source.held >= source.hold_frames
