"""Relocalization of moved cameras while the goal waits: brakes, averages observations at rest, requests a model with
new camera matrices, verifies it, reprojects the goals' set-points and resumes.

It must be proven at rest that the cameras, and not the arm, have moved (`fault_isolation.doubt`); otherwise no camera
is relocalized, no goal is reprojected, and the goal stays held.

A relocalized model keeps the frame, so values stated as points remain valid. Set-points are intersected with the
cameras they were stated for, by the common pose if they determine one, and projected with the new ones (thesis 8.6).

The core only observes; `calibration.relocalized_model` computes the model, outside the servo process. The innovation of
static objects is constant at rest: if it changes, a camera was moved again, and the relocalization restarts.
"""

from __future__ import annotations

import msgspec
import numpy as np

from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.cycle import ModelUpdate, Sample
from stereoservo.core.goals.execute import drop_lookahead_plan, end_followers, end_source
from stereoservo.core.goals.marker_body import BodyState, place_now
from stereoservo.core.goals.resolve import resolve
from stereoservo.core.model_arrays import ModelArrays, model_arrays, with_unit_height
from stereoservo.core.monitor_state import MOVED, ModelDiagnosis, ObservationStatistics, Relocalization
from stereoservo.core.monitors.fault_isolation import LEAST_PX, doubt, named, present_problem
from stereoservo.core.move import goal_of
from stereoservo.core.prediction import joints_at
from stereoservo.core.rest_averages import add_observation, averages, measurement_buffers
from stereoservo.core.settings import MIN_MARKERS, CoreSettings
from stereoservo.core.state import CoreState, IncidenceGoal, LawRun, PoseMeasurement, ServoGoal
from stereoservo.kinematics.kernels import distort_pixel, project_points, triangulate
from stereoservo.messages.goals import (
    DisplacementTarget,
    FeatureTarget,
    Goal,
    IncidenceTarget,
    Pixel,
    PointTarget,
    ReanchorRefused,
    Target,
)
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import BoolArray, FloatArray

AT_REST = 1e-3
"""Largest command at which the arm is at rest [rad/s or m/s]."""
RESTING = 0.01
"""Largest measured velocity at which the arm is at rest [rad/s or m/s]."""
SETTLE_S = 0.15
FRAMES = 16
"""Number of frames that are averaged, of each camera that has moved."""
COLLECT_S = 3.0
ANSWER_S = 60.0
"""Longest time to wait for a model [s]."""
VERIFY_ROUNDS = 3
VERIFY_S = 3.0
MOST_TRIES = 4
MOVED_AGAIN_PX = 3.0
"""Median change [px] of static objects, at rest, above which a camera has been moved again."""
SAME_PLACE = 2e-3
OTHER_PLACE = 0.05
"""Joint motion [rad or m] after which a camera that was not found is searched again."""
AGAIN_S = 1.0
FEWEST = 4
"""Least number of known points that a camera must see before a fit is tried."""


def begin(verdict: ModelDiagnosis, context: StepContext) -> None:
    """Start relocalization: cameras have moved, or seem to have, by the diagnosis ``verdict``. No law runs until their
    poses are known again.
    """
    state, settings = context.state, context.settings
    names = list(verdict.subjects)
    state.reanchoring = Relocalization(
        phase="brake",
        cameras=tuple(names),
        together=verdict.kind == "cameras_moved_together",
        moved_px=verdict.moved_px,
        since_ns=context.now_ns,
        phase_ns=context.now_ns,
        sums=ObservationStatistics(**measurement_buffers(settings)),
        joint_sum=np.zeros_like(context.q),
        reference=np.zeros((len(settings.cameras), _rows(state), 2)),
        referred=np.zeros((len(settings.cameras), _rows(state))),
        tried_at=context.q.copy(),
        doubt=verdict.text if verdict.kind == "cameras_or_arm" else "",
    )
    _forget(names, context)


def _rows(state: CoreState) -> int:
    return len(state.watching.sightings[0].seen)


def _forget(names: list[str], context: StepContext) -> None:
    """Discard the last estimates of these cameras."""
    for camera, estimate in zip(context.settings.cameras, context.state.cameras, strict=True):
        if camera.name in names:
            estimate.seen_ns[:] = 0
            estimate.innovation[:] = 0.0


def unknown_cameras(state: CoreState) -> tuple[str, ...]:
    """Names of the cameras whose pixels cannot be used now."""
    run = state.reanchoring
    return () if run is None or run.phase == "verify" else run.cameras


def reasons(state: CoreState) -> tuple[Reason, ...]:
    """The reasons for which laws wait."""
    run = state.reanchoring
    if run is None:
        return ()
    if run.reason is not None:
        return (run.reason,)
    doing = {
        "brake": "the arm comes to rest",
        "collect": "looking at rest",
        "wait": "it is being relocalized",
        "take": "its new place is taken over",
        "verify": "its new place is verified",
    }[run.phase]
    if run.doubt:
        return (_doubtful(run, f"{run.doubt}. {doing[0].upper()}{doing[1:]}, to collect more frames"),)
    return (
        Reason(
            "CAMERA_MOVED",
            "hold",
            ", ".join(run.cameras),
            run.moved_px,
            None,
            "px",
            f"{named(run.cameras)} moved: {doing}; laws go on by themselves. Leave it alone now",
        ),
    )


def _doubtful(run: Relocalization, hint: str) -> Reason:
    return Reason("CAMERAS_OR_ARM", "hold", ", ".join(run.cameras), run.moved_px, LEAST_PX, "px", hint)


def rejection_reason(state: CoreState, update: ModelUpdate) -> str:
    """Why a relocalized model is not the expected one; empty if it is."""
    run, model = state.reanchoring, state.model
    if run is None or model is None or run.phase != "wait":
        return "no cameras are being relocalized, or they have moved again since"
    if set(update.reanchored) != set(run.cameras):
        return f"it is re-anchored for {', '.join(update.reanchored)}; {', '.join(run.cameras)} moved"
    same = np.array_equal(update.model.plane_at_infinity, model.plane_at_infinity) and np.array_equal(
        update.model.generators, model.generators
    )
    return "" if same else "it is of another frame than the model in use"


def refuse_while_moved(state: CoreState) -> None:
    """Raises RefusalError while cameras are being relocalized: pixels before and after refer to
    different camera poses.
    """
    run = state.reanchoring
    if run is not None and run.doubt:
        raise RefusalError(
            "CAMERAS_OR_ARM",
            run.doubt,
            subject=", ".join(run.cameras),
            value=run.moved_px,
            threshold=LEAST_PX,
            unit="px",
        )
    if run is not None:
        raise RefusalError(
            "CAMERA_MOVED",
            f"{named(run.cameras)} moved and is not known again yet: wait for the event reanchored, or calibrate",
            subject=", ".join(run.cameras),
        )


def step(context: StepContext) -> None:
    """One step of the relocalization."""
    state = context.state
    run = state.reanchoring
    if run is None:
        return
    if isinstance(state.source, PoseMeasurement):
        state.reanchoring = None  # calibration and check do not use the previous model
        return
    resting = bool((np.abs(state.block.command) < AT_REST).all() and (np.abs(state.block.velocities) < RESTING).all())
    if run.phase in ("collect", "wait", "failed") and _moved_again(run, context):
        return
    if run.phase == "brake":
        if not resting:
            run.phase_ns = context.now_ns
        elif (context.now_ns - run.phase_ns) * 1e-9 >= SETTLE_S:
            _begin_collecting(run, context)
    elif run.phase == "collect":
        if resting:
            _collect(run, context)
        else:
            _enter(run, "brake", context)
    elif run.phase == "wait":
        if state.pending_model is not None and state.pending_reanchored and resting and state.planning is None:
            _carry_over(run, context)
        elif (context.now_ns - run.phase_ns) * 1e-9 > ANSWER_S:
            why = "no model came: the computer is overloaded (`uptime`), or the gateway hangs; see the daemon's log"
            _fail(run, context, why, ANSWER_S, "s")
    elif run.phase == "verify":
        _verify(run, context)
    elif run.phase == "failed" and resting and (context.now_ns - run.phase_ns) * 1e-9 > AGAIN_S:
        elsewhere = bool((np.abs(context.q - run.tried_at) > OTHER_PLACE).any())
        if elsewhere or _seen_now(run, context) > run.tried_seen:
            try_again(context)


def try_again(context: StepContext) -> None:
    """Try again after a failure: more is visible, the arm is elsewhere, or a client requests it."""
    run = context.state.reanchoring
    if run is not None and run.phase == "failed":
        run.reason = None
        run.tries = 0
        _enter(run, "brake", context)


def refused(command: ReanchorRefused, context: StepContext) -> str:
    """The fit could not determine the cameras. Raises RefusalError if no fit was requested."""
    run = context.state.reanchoring
    if run is None or run.phase != "wait":
        raise RefusalError("NOT_AWAITED", "no cameras are being relocalized")
    _fail(run, context, command.message, command.value, command.unit, command.threshold)
    return "the cameras stay unknown"


def _enter(run: Relocalization, phase: str, context: StepContext) -> None:
    run.phase = phase  # type: ignore[assignment]
    run.phase_ns = context.now_ns


def _begin_collecting(run: Relocalization, context: StepContext) -> None:
    _enter(run, "collect", context)
    run.sums = ObservationStatistics(**measurement_buffers(context.settings))
    run.joint_sum = np.zeros_like(context.q)
    run.joint_frames = 0
    run.referred[:] = 0.0
    run.contradicting = 0
    run.tried_at = context.q.copy()


def _moved_again(run: Relocalization, context: StepContext) -> bool:
    """Whether static objects have moved in some image since the arm rests; then the relocalization restarts."""
    if bool((np.abs(context.q - run.tried_at) > SAME_PLACE).any()):
        return False
    moved: list[str] = []
    looked = False
    for c, camera in enumerate(context.settings.cameras):
        sighting = context.state.watching.sightings[c]
        if not (sighting.fresh and _after(c, run.phase_ns, context.state)):
            continue
        known = run.referred[c] > 0.0
        both = known & (sighting.seen > 0.0)
        if int(both.sum()) >= 3:
            looked = True
            shift = np.sqrt(((sighting.innovation - run.reference[c])[both] ** 2).sum(axis=-1))
            if float(np.median(shift)) > MOVED_AGAIN_PX:
                moved.append(camera.name)
        fresh = ~known & (sighting.seen > 0.0)
        run.reference[c][fresh] = sighting.innovation[fresh]
        run.referred[c][fresh] = 1.0
    if not moved:
        run.contradicting = 0 if looked else run.contradicting
        return False
    run.contradicting += 1
    if run.contradicting < 2:
        return False
    more = [name for name in moved if name not in run.cameras]
    run.together = False
    run.cameras = (*run.cameras, *more)
    run.poses = 0
    run.tries = 0
    run.reason = None
    context.state.pending_model = None if context.state.pending_reanchored else context.state.pending_model
    context.state.pending_reanchored = ()
    _forget(list(run.cameras), context)
    message = (
        f"at rest {named(tuple(moved))} shows what stands more than {MOVED_AGAIN_PX:g} px from where it was: looking "
        "once more"
    )
    if not run.doubt and len(run.cameras) == len(context.settings.cameras):
        run.doubt = f"all cameras ({', '.join(run.cameras)}) show another view at rest"
    context.emit("health", message=message, name="camera_moved", cameras=run.cameras)
    _enter(run, "brake", context)
    return True


def _moved(run: Relocalization, context: StepContext) -> list[int]:
    """Indices of the cameras that have moved."""
    return [c for c, camera in enumerate(context.settings.cameras) if camera.name in run.cameras]


def _after(camera: int, t_ns: int, state: CoreState) -> bool:
    """Whether the shutter of a camera's newest frame opened after ``t_ns``, as far as its stamps are known."""
    return state.watching.sightings[camera].t_ns + state.cameras[camera].offset_ns > t_ns


def _collect(run: Relocalization, context: StepContext) -> None:
    for camera, observation in context.ingested.observations:
        offset_ns = context.state.cameras[camera].offset_ns
        at_shutter = joints_at(context.state.history, observation.t_shutter_ns + offset_ns)
        if at_shutter is not None and add_observation(
            run.sums, context.settings, observation, FRAMES, run.phase_ns - offset_ns
        ):
            run.joint_sum += at_shutter
            run.joint_frames += 1
    moved = _moved(run, context)
    waited_s = (context.now_ns - run.phase_ns) * 1e-9
    if not bool((run.sums.frames[moved] >= FRAMES).all()) and waited_s <= COLLECT_S:
        return
    state = context.state
    if run.poses == 0 and _where_they_were(run, context):
        return
    if _unproven(run, context):
        return
    samples = tuple(  # the model that is handed in has the adjusted cameras at their previous poses
        sample
        for sample in averages(run.sums, context.settings)
        if sample.camera in run.cameras or sample.camera not in state.adjusted
    )
    run.tried_seen = sum(len(_known(sample, context)) for sample in samples if sample.camera in run.cameras)
    for sample in samples:
        if sample.camera in run.cameras and len(_known(sample, context)) < FEWEST:
            few, frames = len(_known(sample, context)), sample.frames
            _fail(
                run,
                context,
                f"camera {sample.camera} sees {few} known markers in {frames} frames, {FEWEST} are needed: turn it "
                "back to the arm or to the static markers, or move the arm before it by joints",
                float(few),
                "markers",
                float(FEWEST),
            )
            return
    context.emit(
        "reanchor",
        id=goal_of(context.state.source),
        joints=run.joint_sum / max(run.joint_frames, 1),
        samples=samples,
        trial=run.poses,
        cameras=run.cameras,
        rigid=run.together,
        message=f"{named(run.cameras)} seen at rest: to be relocalized",
    )
    run.poses += 1
    _enter(run, "wait", context)


def _unproven(run: Relocalization, context: StepContext) -> bool:
    """Whether it is not proven that the cameras, and not the arm, have moved; then the goal stays held."""
    state, settings = context.state, context.settings
    assert context.arrays is not None
    looked = [c for c in range(len(settings.cameras)) if _after(c, run.phase_ns, state)]
    moved = _moved(run, context)
    usable = [c for c in looked if (mobile := state.mobile[c]) is None or not mobile.moving]
    run.doubt = (
        doubt(present_problem(state, usable, context.arrays, settings), moved, run.moved_px)
        if usable
        else f"no camera has shown anything at rest, so {named(run.cameras)} may have moved, or the arm"
    )
    if not run.doubt:
        return False
    run.tried_seen = _seen_now(run, context)
    hint = f"{run.doubt}. It is looked at again when more is seen, when the arm rests elsewhere, and on resume"
    _give_up(run, context, _doubtful(run, hint))
    return True


def _where_they_were(run: Relocalization, context: StepContext) -> bool:
    """Whether the cameras, observed at rest, have their previous poses; then everything continues with the previous
    model.
    """
    state = context.state
    last = state.watching.last[-VERIFY_ROUNDS:]
    looked = all(
        _after(c, run.phase_ns, state) and int(state.watching.sightings[c].seen.sum()) >= FEWEST
        for c in _moved(run, context)
    )
    if not looked or len(last) < VERIFY_ROUNDS or any(verdict.kind != "ok" for verdict in last):
        return False
    state.reanchoring = None
    goal = goal_of(state.source)
    on = f"; goal {goal} goes on" if goal else ""
    context.emit(
        "health",
        id=goal,
        name="ok",
        message=f"{named(run.cameras)}, seen at rest, have not moved: what was seen in motion was of other "
        f"instants than stated, or passed by{on}",
    )
    return True


def _known(sample: Sample, context: StepContext) -> list[int]:
    model = context.state.model
    assert model is not None
    points = {*model.marker_ids, *model.scene_ids}
    return [int(i) for i in sample.ids if int(i) in points]


def _seen_now(run: Relocalization, context: StepContext) -> int:
    """Number of known points in the newest frames of the cameras that have moved; of all cameras if it is in doubt that
    they have moved.
    """
    cameras = range(len(context.settings.cameras)) if run.doubt else _moved(run, context)
    return sum(
        int(context.state.watching.sightings[c].seen.sum()) for c in cameras if _after(c, run.phase_ns, context.state)
    )


def _fail(
    run: Relocalization,
    context: StepContext,
    why: str,
    value: float | None,
    unit: str,
    limit: float | None = None,
) -> None:
    hint = (
        f"{named(run.cameras)} moved and could not be relocalized: {why}. It is tried again when more is seen, when "
        "the arm rests elsewhere, and on resume; or cancel the goal and calibrate"
    )
    reason = Reason("REANCHOR_FAILED", "hold", ", ".join(run.cameras), value, limit, unit, hint)
    _give_up(run, context, reason)


def _give_up(run: Relocalization, context: StepContext, reason: Reason) -> None:
    run.reason = reason
    _enter(run, "failed", context)
    context.emit(
        "reanchor_failed", id=goal_of(context.state.source), message=reason.hint, reasons=(reason,), cameras=run.cameras
    )


def _carry_over(run: Relocalization, context: StepContext) -> None:
    """Reproject the goals into the new cameras' pixels; the model is put in use in the next step."""
    state = context.state
    old, model = state.model, state.pending_model
    assert old is not None
    assert model is not None
    moved = tuple(c for c, camera in enumerate(context.settings.cameras) if camera.name in state.pending_reanchored)
    new: ModelArrays = model_arrays(model, context.settings)
    epochs = (old.epoch, model.epoch)
    carry_all(new, moved, epochs, context)
    _enter(run, "take", context)


def carry_all(new: ModelArrays, moved: tuple[int, ...], epochs: tuple[int, int], context: StepContext) -> None:
    """Reproject the running and the queued goals into the pixels of the cameras ``moved``, by their matrices in
    ``new``.

    ``epochs``: of the previous and the new model. Goals that cannot be reprojected end.
    """
    state = context.state
    place = place_now(context)
    drop_lookahead_plan(context)
    kept: list[Goal] = []
    queued, state.queue = state.queue, []
    for k, goal in enumerate(queued):
        carried = carry_goal(goal, place, new, moved, epochs)
        if isinstance(carried, Reason):
            state.queued_until_ns.pop(goal.id, None)
            context.emit("goal_aborted", id=goal.id, message=carried.hint, reasons=(carried,))
            if goal.acknowledge_s is not None:
                state.queue = queued[k + 1 :]
                end_followers(context, goal.id, (carried,))
                break
        else:
            kept.append(carried)
    state.queue = kept
    if isinstance(state.source, LawRun):
        reason = carry_run(state.source, place, new, moved)
        if reason is not None:
            end_source(context, "goal_aborted", (reason,), reason.hint)


def on_model_applied(run: Relocalization, state: CoreState, now_ns: int) -> None:
    """The new model is in use: laws restart counting frames, and new frames must agree with it."""
    run.phase, run.phase_ns = "verify", now_ns
    if isinstance(state.source, LawRun):
        law = state.block.numbers.run
        law.last_frames, law.held = sum(estimate.frames for estimate in state.cameras), 0


def _verify(run: Relocalization, context: StepContext) -> None:
    state = context.state
    watching = state.watching
    last = watching.last[-VERIFY_ROUNDS:]
    moved = _moved(run, context)
    looked = all(_after(c, run.phase_ns, state) and int(watching.sightings[c].seen.sum()) >= 3 for c in moved)
    if len(last) == VERIFY_ROUNDS and looked and all(verdict.kind == "ok" for verdict in last):
        _known_again(run, context)
        return
    contradicted = len(last) == VERIFY_ROUNDS and all(verdict.kind != "ok" for verdict in last)
    late = (context.now_ns - run.phase_ns) * 1e-9 > VERIFY_S
    if not (contradicted or late):
        return
    run.tries += 1
    if run.tries < MOST_TRIES:
        verdict = last[-1] if last else ModelDiagnosis()
        more = verdict.subjects if verdict.kind in (*MOVED, "cameras_or_arm") else ()
        run.doubt = verdict.text if verdict.kind == "cameras_or_arm" else ""
        run.cameras = (*run.cameras, *(name for name in more if name not in run.cameras))
        run.poses = 0
        _forget(list(run.cameras), context)
        _enter(run, "brake", context)
        return
    worst = max(watching.sightings[c].rms_px for c in moved)
    _fail(run, context, "frames of now contradict each model that was made", worst, "px")


def _known_again(run: Relocalization, context: StepContext) -> None:
    state = context.state
    state.reanchoring = None
    px = ", ".join(
        f"{camera.name} {sighting.rms_px:.2g} px rms"
        for camera, sighting in zip(context.settings.cameras, state.watching.sightings, strict=True)
    )
    seconds = (context.now_ns - run.since_ns) * 1e-9
    goal = goal_of(state.source)
    on = f"; goal {goal} goes on" if goal else ""
    context.emit(
        "reanchored",
        id=goal,
        cameras=run.cameras,
        rigid=run.together,
        message=f"{named(run.cameras)} moved by {run.moved_px:.3g} px and is known again after {seconds:.1f} s: now "
        f"{px}{on}",
    )


def carry_run(source: LawRun, place: BodyState, new: ModelArrays, moved: tuple[int, ...]) -> Reason | None:
    """Reproject a running goal's set-points into the cameras ``moved``; returns the reason if too few are left.

    ``place``: the body's pose from the old cameras.
    """
    if isinstance(source, ServoGoal):
        source.stream = None  # streamed set-points are in the old pixels; the last ones remain the goal
        points, known = source.target_points, np.ones(len(source.target_points), bool)
        if not source.pose_known:
            points, known = _intersected(source.set_points, source.wanted, place.arrays)
    elif isinstance(source, IncidenceGoal):
        points, known = _intersected(source.set_points, source.wanted, place.arrays)
    else:
        raise TypeError(f"a law of kind {type(source).__name__} has no set-points that are known")
    had = bool((source.wanted > 0.0).any())
    _reproject_set_points(source.set_points, source.wanted, points, known, place.settings, new, moved)
    shown = int((source.wanted.max(axis=0) > 0.0).sum()) if source.wanted.size else 0
    if had and shown < MIN_MARKERS:
        return _stale(source.goal.id, shown)
    return None


def _intersected(set_points: FloatArray, required: FloatArray, arrays: ModelArrays) -> tuple[FloatArray, BoolArray]:
    """Points (m, 4) of height 1 that two or more cameras show, and which are known (m,)."""
    found, ok = triangulate(arrays.matrices, set_points, required, 5)
    known = np.asarray(ok, dtype=bool) & (required.sum(axis=0) >= 2)
    return np.where(known[:, None], with_unit_height(found, arrays.plane_at_infinity), 0.0), known


def _reproject_set_points(
    set_points: FloatArray,
    required: FloatArray,
    points: FloatArray,
    known: BoolArray,
    settings: CoreSettings,
    new: ModelArrays,
    moved: tuple[int, ...],
) -> None:
    """Set-points (c, m, 2) in the cameras ``moved``; those outside their new images do not count there any more."""
    pixels, depths = project_points(new.matrices, np.ascontiguousarray(points))
    for c in moved:
        side = np.sign(depths[c][known]).sum()
        for i in range(points.shape[0]):
            inside = known[i] and depths[c, i] * side > 0.0 and _raw_in_view(settings, new, c, pixels[c, i]) is not None
            required[c, i] = required[c, i] if inside else 0.0
            set_points[c, i] = pixels[c, i] if required[c, i] > 0.0 else 0.0


def _raw_in_view(settings: CoreSettings, arrays: ModelArrays, camera: int, pixel: FloatArray) -> Pixel | None:
    """The raw pixel of an ideal one, None if it is outside the image."""
    u, v = distort_pixel(arrays.lenses[camera], float(pixel[0]), float(pixel[1]))
    shape = settings.cameras[camera]
    return (u, v) if -0.5 <= u <= shape.width - 0.5 and -0.5 <= v <= shape.height - 0.5 else None


def _stale(goal_id: str, shown: int) -> Reason:
    return Reason(
        "SET_POINTS_STALE",
        "hold",
        goal_id,
        float(shown),
        float(MIN_MARKERS),
        "markers",
        "a camera was moved, and the goal cannot be said in its new pixels: fewer of its markers are shown by two "
        "cameras, or come into the new image, than are needed. State it again from the pictures of now",
    )


def carry_goal(
    goal: Goal, place: BodyState, new: ModelArrays, moved: tuple[int, ...], epochs: tuple[int, int]
) -> Goal | Reason:
    """A waiting goal, reprojected for the new cameras, or the reason why that is impossible. ``epochs``: the old and
    the new.
    """
    centre = goal.centre
    if centre is not None and centre.model_epoch == epochs[0]:
        centre = msgspec.structs.replace(centre, model_epoch=epochs[1])
    try:
        target = _target(goal.target, place, new, moved, epochs)
    except RefusalError as refusal:
        return Reason("SET_POINTS_STALE", "hold", goal.id, hint=f"a camera was moved, and {refusal}")
    if target is None:
        return _stale(goal.id, 0)
    return msgspec.structs.replace(goal, target=target, centre=centre)


def _target(
    target: Target, place: BodyState, new: ModelArrays, moved: tuple[int, ...], epochs: tuple[int, int]
) -> Target | None:
    if isinstance(target, FeatureTarget):
        return _features(target, place, new, moved, epochs)
    if isinstance(target, PointTarget | DisplacementTarget) and target.model_epoch == epochs[0]:
        return msgspec.structs.replace(target, model_epoch=epochs[1])
    if isinstance(target, IncidenceTarget):
        return _incidences(target, place, new, moved, epochs)
    return target


def _features(
    target: FeatureTarget, place: BodyState, new: ModelArrays, moved: tuple[int, ...], epochs: tuple[int, int]
) -> FeatureTarget | None:
    names = [place.settings.cameras[c].name for c in moved]
    epoch = epochs[1] if target.model_epoch == epochs[0] else target.model_epoch
    if not set(names) & set(target.set_points):
        return msgspec.structs.replace(target, model_epoch=epoch)
    resolved = resolve(target, place, True, epochs[0])
    pixels, _ = project_points(new.matrices, np.ascontiguousarray(resolved.points))
    said = dict(target.set_points)
    for c, name in zip(moved, names, strict=True):
        reprojected = {
            marker: _raw_in_view(place.settings, new, c, pixels[c, new.index[marker]])
            for marker in target.set_points.get(name, {})
        }
        said[name] = {marker: pixel for marker, pixel in reprojected.items() if pixel is not None}
    said = {name: markers for name, markers in said.items() if markers}
    if len({marker for markers in said.values() for marker in markers}) < MIN_MARKERS:
        return None
    return FeatureTarget(said, epoch)


def _incidences(
    target: IncidenceTarget,
    place: BodyState,
    new: ModelArrays,
    moved: tuple[int, ...],
    epochs: tuple[int, int],
) -> IncidenceTarget | None:
    names = {place.settings.cameras[c].name for c in moved}
    features = [feature for spec in target.incidences for feature in (spec.moving, spec.fixed)]
    if any(names & set(feature.pixels) for feature in features):
        return None  # pixels of a scene: reprojected, they would be those of another time
    secondary = target.secondary
    if isinstance(secondary, FeatureTarget):
        secondary = _features(secondary, place, new, moved, epochs)
        if secondary is None:
            return None
    epoch = epochs[1] if target.model_epoch == epochs[0] else target.model_epoch
    return msgspec.structs.replace(target, secondary=secondary, model_epoch=epoch)
