"""Motion source of visual servoing: drives the arm by a control law from a goal's set-points to joint velocities, with
adaptive gain and tracking of a plan, until the error stays below its tolerance or the goal fails.
"""

from __future__ import annotations

import math
from operator import is_
from typing import NamedTuple

import numpy as np

from stereoservo.control.faces import FaceChoice, choose_face, law_scene
from stereoservo.control.law import JacobianChoice, Law, LawStep, Options, Scene, Task
from stereoservo.control.laws.stereo import NO_COMPONENTS, NO_STATUS
from stereoservo.control.mobility_kernel import self_motion_from_limits
from stereoservo.control.pd import damped_velocity
from stereoservo.core.context import SourceOutput, StepContext, Workspace
from stereoservo.core.goals.marker_body import markers_needed, step_made
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.prediction import (
    Centre,
    arm_in,
    arm_of,
    body_points,
    centre_into,
    centre_of,
    scene_of,
    triangulated,
)
from stereoservo.core.settings import MIN_MARKERS, RIGID_FREEDOMS
from stereoservo.core.sources.progress import (
    GOES_ON,
    OUT_OF_TIME,
    SETTLED,
    RunTerms,
    Traits,
    account_run,
    begin_run,
    decay_of_error,
    disagreement,
    error_of_run,
    examine_progress,
)
from stereoservo.core.sources.streaming import feed_forward, follow
from stereoservo.core.state import IncidenceGoal, LawRun, ServoGoal
from stereoservo.core.target.follow import Follower, follow_target, is_static, start_following
from stereoservo.kinematics.kernels import project_points, transform_points
from stereoservo.messages.goals import DisplacementTarget
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray, Record
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.tracking import advance, planned_joints, sample_plan

GOAL_ARRAYS = ("used", "wanted", "set_points", "target_points", "centre_weights", "centre_body", "centre_target")
"""Arrays of a goal that are copied to the workspace for a law's kernel."""
SELF_MOTION_RATE = 0.5
"""Rate [1/s], relative to a joint's half range, at which self-motion moves a joint away from a limit."""


def by_kernel(source: ServoGoal, law: Law) -> bool:
    """Whether the kernel of a ``law`` alone drives to a goal: the goal is static and uses predicted points."""
    return law.kernel is not None and source.stream is None and source.followed is None and source.points == "predicted"


def servo_step(source: ServoGoal, context: StepContext) -> SourceOutput | None:
    """One step of a law: error, joint velocity, and whether the goal is reached or out of time; None if the velocity is
    in the workspace.
    """
    law = context.derived.laws[source.law]
    if by_kernel(source, law) and context.weights is context.derived.workspace.weights:
        return _kernel_step(source, context)  # the estimate changes if a camera's pose is found
    waiting = wait_for_target(source, context)
    if waiting is not None:
        return waiting
    arrays, prediction, pixels = context.arrays, context.prediction, context.pixels
    if arrays is None or prediction is None or context.weights is None or pixels is None:
        raise AssertionError("a law runs only with a model")
    streamed = follow(source, context, arrays) if source.stream is not None else False
    found = goal_error(source, context, arrays, context.weights, pixels)
    error_px = found.error_px
    ends = not streamed and may_end(source, context)
    ended = run_ended(source, context, error_px, found.seen, source.wanted, may_end=ends)
    if ended is not None:
        return ended
    scene, task = choose(source, context, *scene_and_task(source, context, arrays, found))
    if not law.components:  # laws in the images use all cameras, whatever face they show
        scene = scene._replace(camera_centres=arrays.camera_centres)
    if law.planned:
        if source.plan is None and source.pose_known:
            hint = "the path is planned from where the arm comes to rest"
            waits = Reason("PLANNING", "slow", hint=hint)
            return SourceOutput(np.zeros_like(context.q), error_px=error_px, reasons=(waits,))
        if source.plan is not None:
            task = trajectory_task(source, context, scene, task)
    try:
        step = law.step(scene, task, options(source, context, error_px, source.jacobian))
        velocity = velocity_of(step, len(context.q))
    except Exception as error:  # an exception in a third party's law ends its goal, never the loop
        return _law_failed(source, context, error_px, error)
    expected: FloatArray | float = task.joint_rates if task.joint_rates.size else 0.0
    if streamed or source.followed is not None:
        expected = feed_forward(source, context, found.usable * source.wanted)
        velocity = velocity + expected
    velocity = damp(source, context, velocity, expected)
    if len(velocity) > RIGID_FREEDOMS and source.plan is None:  # a plan has already avoided the limits
        velocity = velocity + away_from_limits(context)
    return SourceOutput(
        velocity, True, source.goal.speed_scale, error_px=error_px, task_error=step.error, reasons=law.reasons(step)
    )


def wait_for_target(source: Follower, context: StepContext) -> SourceOutput | None:
    """Move a goal that follows a target to the target's current pose; no motion if the target is not seen."""
    waits = None if source.followed is None else follow_target(source, context)
    if waits is None:
        return None
    return SourceOutput(np.zeros_like(context.q), needs_features=True, reasons=(waits,))


def may_end(source: Follower, context: StepContext) -> bool:
    """Whether a goal may be reached for good: it follows no target, or its target is static."""
    return source.followed is None or is_static(context.state.target)


def _kernel_step(source: ServoGoal, context: StepContext) -> SourceOutput | None:
    """`servo_step` by the kernel of a law; returns None while the goal is active, with its velocity in
    the workspace.
    """
    workspace = context.derived.workspace
    work = workspace.numbers
    if not work.followed:  # the goal has just started, or the state was examined before
        set_goal(workspace, source)
        follow_goal(context.state.block.record, workspace.record)
    found = Found(work.run_found, error_now(workspace), work.seen, work.markers_needed)
    ended = _ended(source, context, found, source.wanted)
    return drive(source, context) if ended is None else ended


def drive(source: ServoGoal, context: StepContext) -> SourceOutput | None:
    """Write the velocity of an active goal into the workspace by its law's kernel; returns None unless the kernel
    fails.
    """
    workspace, law = context.derived.workspace, context.derived.laws[source.law]
    if law.components:
        show_face(source, context)
    assert law.kernel is not None
    try:
        law.kernel(workspace.record)
    except Exception as error:  # as for any law: the exception ends its goal, never the loop
        return _law_failed(source, context, error_now(workspace), error)
    if source.damping != 0.0:
        workspace.velocity[:] = damp(source, context, workspace.velocity)
    if workspace.velocity.size > RIGID_FREEDOMS:
        workspace.velocity += away_from_limits(context)
    return None


def error_now(workspace: Workspace) -> float | None:
    """The error [px] of the goal in the workspace; None if none is measured."""
    return workspace.numbers.error_px if workspace.numbers.measured else None


def found_by_kernel(source: ServoGoal, context: StepContext) -> SourceOutput:
    """The output of the goal's law kernel in this step."""
    workspace, law = context.derived.workspace, context.derived.laws[source.law]
    step = _found_step(workspace, len(law.components))
    return SourceOutput(
        step.velocity,
        True,
        source.goal.speed_scale,
        False,
        False,
        error_now(workspace),
        step.error,
        law.reasons(step),
    )


def damp(source: LawRun, context: StepContext, velocity: FloatArray, expected: FloatArray | float = 0.0) -> FloatArray:
    """``velocity`` (n,) with the goal's damping. ``expected`` (n,): the part of the velocity that is not caused by an
    error; it is not damped.
    """
    if source.damping == 0.0:
        return velocity
    return damped_velocity(velocity, expected, context.state.block.velocities, source.damping)


def set_goal(workspace: Workspace, goal: ServoGoal) -> None:
    """Copy a ``goal`` to the workspace for the law. A moving goal replaces its arrays and never writes into them, so
    they are compared by identity.
    """
    loaded = (
        goal.used, goal.wanted, goal.set_points, goal.target_points, goal.centre_weights, goal.centre_body,
        goal.centre_target, goal.pose_known, goal.gain_near, goal.gain_far, goal.gain_slope, goal.tolerance_px,
        goal.hold_frames, goal.time_limit_s, goal.jacobian,
    )  # fmt: skip
    if len(workspace.loaded) == len(loaded) and all(map(is_, loaded, workspace.loaded)):
        return
    workspace.loaded, workspace.faced, given = loaded, None, workspace.arrays
    for name in GOAL_ARRAYS:
        given[name][:] = getattr(goal, name)
    given["target_known"][:] = goal.pose_known
    numbers = workspace.numbers
    numbers.gain_near, numbers.gain_far, numbers.gain_slope = goal.gain_near, goal.gain_far, goal.gain_slope
    numbers.tolerance_px, numbers.time_limit_s = goal.tolerance_px, goal.time_limit_s
    numbers.hold_frames, numbers.markers_needed = goal.hold_frames, markers_needed(goal.wanted)
    numbers.jacobian_choice = int(goal.jacobian)


def show_face(goal: ServoGoal, context: StepContext) -> None:
    """Write the face that a law with components uses for a ``goal`` into the workspace; new images may select another
    face.
    """
    workspace = context.derived.workspace
    if goal.pose_known and (workspace.numbers.frames_passed or goal.choice.cameras == 0):
        scene, task = choose(goal, context, workspace.scene, workspace.task)
        _face(workspace, task.face, scene.camera_centres)
    elif workspace.faced is not goal.choice:
        centres = law_scene(workspace.scene, goal.choice).camera_centres
        _face(workspace, goal.choice.triple, centres, goal.choice)


def _face(workspace: Workspace, triple: IntArray, centres: FloatArray, choice: FaceChoice | None = None) -> None:
    """Write the face to the workspace: three markers (3,), and the centres (k, 4) of the cameras that see it, as in the
    ``choice``.
    """
    workspace.faced, given = choice, workspace.arrays
    given["face"][:], given["eyes"][: len(centres)] = triple, centres
    workspace.numbers.viewing_count = len(centres)


def _found_step(workspace: Workspace, components: int) -> LawStep:
    """The result of the law's kernel, with so many components."""
    given, velocity = workspace.arrays, workspace.velocity.copy()
    if components == 0:
        return LawStep(velocity, NO_COMPONENTS, NO_COMPONENTS, NO_STATUS, workspace.numbers.conditioning)
    found = given["components"].reshape(-1)[: 2 * components].reshape(2, -1).copy()
    status = given["component_status"][:components].copy()
    return LawStep(velocity, found[0], found[1], status, workspace.numbers.conditioning)


class GoalError(NamedTuple):
    """Error and body of a goal at present.

    ``usable`` (c, m): weights of the observations in the cameras that the goal may use.
    ``error_px``: largest distance over markers and cameras, None if none is seen.
    ``seen``: number of its markers that are seen.
    ``points`` (m, 4), ``centre`` (4,): the body's points and the goal's centre, from the joint readings plus their
    correction.
    """

    usable: FloatArray
    error_px: float | None
    seen: int
    points: FloatArray
    centre: FloatArray


def goal_error(
    source: ServoGoal, context: StepContext, arrays: ModelArrays, weights: FloatArray, pixels: FloatArray
) -> GoalError:
    """Error and body of ``source`` with the current ``weights`` (c, m) and ``pixels`` (c, m, 2)."""
    usable = np.empty(weights.shape)
    goal = SetPoints(source.used, source.wanted, source.set_points)
    measured, error_px, seen = _measure(weights, pixels, goal, usable)
    joints = context.q + context.state.block.correction
    points: FloatArray = body_points(arm_in(arrays), joints)
    centre = centre_of(source, joints, arrays, points)
    return GoalError(usable, error_px if measured else None, seen, points, centre)


class SetPoints(NamedTuple):
    """Set-points of a goal: cameras ``used`` (c,); ``set_points`` (c, m, 2), used where ``required`` (c, m) > 0."""

    used: FloatArray
    required: FloatArray
    set_points: FloatArray


@kernel
def _measure(weights: FloatArray, pixels: FloatArray, goal: SetPoints, usable: FloatArray) -> tuple[bool, float, int]:
    """Returns whether an error was measured, the largest distance [px] over markers and cameras, and how many markers
    are seen; writes the weights of the usable cameras to ``usable`` (c, m).
    """
    cameras, markers = weights.shape
    largest, measured, seen = 0.0, False, 0
    for i in range(markers):
        visible = False
        for c in range(cameras):
            usable[c, i] = weights[c, i] * goal.used[c]
            if not usable[c, i] * goal.required[c, i] > 0.0:
                continue
            visible = True
            u, v = pixels[c, i, 0] - goal.set_points[c, i, 0], pixels[c, i, 1] - goal.set_points[c, i, 1]
            distance = math.sqrt(u * u + v * v)
            if distance > largest or math.isnan(distance):
                largest = distance
        measured = measured or visible
        seen += visible
    return measured, largest, seen


@kernel
def follow_goal(block: Record, workspace: Record) -> bool:
    """Measure the progress of the goal in the ``workspace``, as the last part of the observation; returns whether
    the goal stays active. Writes its error and body, as in `GoalError`, the gain, and the result of `account_run`.
    """
    memory, work = block[0], workspace[0]
    n, c, m = work.joints, work.cameras, work.markers
    required, set_points = work.wanted[: c * m].reshape((c, m)), work.set_points[: 2 * c * m].reshape((c, m, 2))
    measured, error_px, work.seen = _measure(
        work.weights[: c * m].reshape((c, m)),
        work.pixels[: 2 * c * m].reshape((c, m, 2)),
        SetPoints(work.used[:c], required, set_points),
        work.usable[: c * m].reshape((c, m)),
    )
    work.measured, work.error_px = int(measured), error_px
    arm, points = arm_of(workspace), work.body[: 4 * m].reshape((m, 4))
    joints = work.q[:n] + memory.correction[:n]
    points[:] = body_points(arm, joints)
    centre_into(arm, joints, points, Centre(work.centre_weights[:m], work.centre_body), work.centre)
    known_px = error_px if measured else math.nan
    terms = RunTerms(work.tolerance_px, work.hold_frames, work.time_limit_s)
    work.run_found = account_run(block, measured, known_px, work.seen >= work.markers_needed, work.dt_s, terms)
    work.gain = adaptive_gain(work.gain_near, work.gain_far, work.gain_slope, known_px)
    work.followed = 1
    return bool(work.run_found == GOES_ON and work.seen >= work.markers_needed)


def activate_run(source: LawRun, context: StepContext) -> None:
    """Start the clock, the frame count and the lease of a law that starts now."""
    source.started_ns = context.now_ns
    begin_run(context.state.block.record)
    source.renew_lease(context.now_ns)
    if isinstance(source, ServoGoal | IncidenceGoal) and source.goal.follow_markers:
        start_following(source, context)


def awaits_plan(source: ServoGoal, context: StepContext) -> bool:
    """Whether a goal needs a plan that is not available yet."""
    return context.derived.laws[source.law].planned and source.plan is None


def away_from_limits(context: StepContext) -> FloatArray:
    """Self-motion (n,) of a redundant arm that moves its joints away from their limits; the body does not move."""
    assert context.prediction is not None
    limits = context.settings.limits
    rows = np.ascontiguousarray(context.prediction.jacobian).reshape(-1, len(context.q))
    return self_motion_from_limits(rows, context.q, limits.position_min, limits.position_max, SELF_MOTION_RATE)


def run_ended(
    source: LawRun,
    context: StepContext,
    error_px: float | None,
    seen: int,
    required: FloatArray | None = None,
    *,
    may_end: bool = True,
) -> SourceOutput | None:
    """The output of a law's step that is out of time, sees too few markers, or has reached the goal; None if the goal
    stays active.

    ``seen``: number of the goal's markers that are seen, of those ``required`` (c, m); None: more than are needed.
    ``may_end``: False for a goal that still moves.
    """
    needed = MIN_MARKERS if seen >= MIN_MARKERS or required is None else markers_needed(required)
    terms = RunTerms(source.tolerance_px, source.hold_frames, source.time_limit_s)
    found = account_run(
        context.state.block.record,
        error_px is not None,
        math.nan if error_px is None else error_px,
        seen >= needed,
        context.dt_s,
        terms,
    )
    return _ended(source, context, Found(found, error_px, seen, needed), required, may_end=may_end)


class Found(NamedTuple):
    """State of a law's step: the result of `account_run`, the error [px], the number of markers seen, and the number
    needed.
    """

    run: int
    error_px: float | None
    seen: int
    needed: int


def _ended(
    source: LawRun, context: StepContext, found: Found, required: FloatArray | None, *, may_end: bool = True
) -> SourceOutput | None:
    """The output of a step that is out of time, sees too few markers, or has reached the goal; None if
    it stays active.
    """
    run, error_px, seen, needed = found
    if run == OUT_OF_TIME:
        return _out_of_time(source, context, error_px)
    if seen < needed:
        reason = Reason(
            "TOO_FEW_MARKERS",
            "hold",
            "",
            float(seen),
            float(needed),
            "markers",
            "bring the goal's markers back into view",
        )
        return SourceOutput(np.zeros_like(context.q), needs_features=True, error_px=error_px, reasons=(reason,))
    if run == SETTLED and may_end:
        frames = context.state.block.numbers.run.last_frames
        if source.apart_frames != frames:
            source.apart, source.apart_frames = disagreement(source, context, required), frames
        if source.apart is not None:
            return SourceOutput(
                np.zeros_like(context.q), needs_features=True, error_px=error_px, reasons=(source.apart,)
            )
        message = f"error {error_px:.4f} px"
        if isinstance(source, ServoGoal) and source.step_from is not None:
            assert context.arrays is not None
            assert isinstance(source.goal.target, DisplacementTarget)
            now = context.q + context.state.block.correction
            message += "; " + step_made(source.goal.target, context.arrays, source.step_from, now)
        context.emit("goal_reached", id=source.goal.id, message=message, error_px=error_px)
        return SourceOutput(np.zeros_like(context.q), finished=True, reached=True, error_px=error_px)
    return None


def scene_and_task(
    source: ServoGoal, context: StepContext, arrays: ModelArrays, found: GoalError
) -> tuple[Scene, Task]:
    """The current scene and the goal's task, as laws take them."""
    prediction, pixels = context.prediction, context.pixels
    assert prediction is not None
    assert pixels is not None
    points, centre = found.points, found.centre
    if source.points == "triangulated":
        points = triangulated(arrays, pixels, found.usable, points)
        centre = centre_of(source, context.q + context.state.block.correction, arrays, points)
    scene = scene_of(prediction, pixels, arrays, points, found.usable)
    task = Task(
        source.set_points,
        source.wanted,
        arrays.no_rates,
        source.target_points,
        arrays.known[1 if source.pose_known else 0],
        centre,
        source.centre_target,
        source.choice.triple,
    )
    return scene, task


def choose(source: ServoGoal, context: StepContext, scene: Scene, task: Task) -> tuple[Scene, Task]:
    """The scene and the task on the face that the law uses now; a change of the face is reported."""
    assert context.arrays is not None
    if not source.pose_known:
        return scene, task
    before = source.choice
    if before.cameras > 0 and not context.derived.workspace.numbers.frames_passed:  # no frame has arrived since
        return law_scene(scene, before), task
    choice = choose_face(source.faces, scene, task, before)
    if choice.cameras == 0:  # no camera sees three markers of one face: keep the previous face
        return scene, task
    source.choice = choice
    if choice.changed and before.cameras > 0 and choice.face != before.face:
        ids = ", ".join(str(context.arrays.marker_ids[int(i)]) for i in choice.triple)
        context.emit(
            "goal_face",
            id=source.goal.id,
            name=ids,
            message=f"works on the face of markers {ids} from here on",
        )
    return law_scene(scene, choice), task._replace(face=choice.triple)


SLOPE_UNIT_PX = 100.0
"""Slopes of gains are stated in 1/s per so many pixels."""


class GainCurve(NamedTuple):
    """``near`` and ``far`` [1/s], ``slope`` > 0 [1/s per 100 px]: how fast the gain departs from ``near``."""

    near: float
    far: float
    slope: float


def gain_at(curve: GainCurve, error_px: float | None) -> float:
    """The gain [1/s] at an error [px], the largest distance over markers and cameras; None: not measured.

    If the error is unknown or not a number, the smaller of the two gains is used.
    """
    if curve.near == curve.far:
        return curve.near
    return adaptive_gain(curve.near, curve.far, curve.slope, math.nan if error_px is None else error_px)


@kernel
def adaptive_gain(near: float, far: float, slope: float, error_px: float) -> float:
    """`gain_at` as a kernel; NaN: not measured. Equal gains are constant, a negative error counts as zero."""
    if math.isnan(error_px):
        return min(near, far)
    span = abs(near - far)
    if span == 0.0 or error_px <= 0.0:
        return near
    gain = far + (near - far) * math.exp(-slope * (error_px / SLOPE_UNIT_PX) / span)
    return max(min(near, far), min(max(near, far), gain))


def options(
    source: LawRun, context: StepContext, error_px: float | None, jacobian: int = int(JacobianChoice.CURRENT)
) -> Options:
    """The options of the law for this step."""
    return Options(gain_now(source, error_px), context.dt_s, jacobian)


def gain_now(source: LawRun, error_px: float | None) -> float:
    """The gain [1/s] of a goal at its error."""
    return gain_at(GainCurve(source.gain_near, source.gain_far, source.gain_slope), error_px)


def velocity_of(step: LawStep, joints: int) -> FloatArray:
    """A copy (n,) of the velocity of a law's step, of the type that kernels are compiled for.

    Raises ValueError if it does not have that many joints, TypeError if its numbers are not real.
    """
    if step.velocity.shape != (joints,):
        raise ValueError(f"a velocity of shape {step.velocity.shape}; ({joints},) is needed")
    if step.velocity.dtype.kind not in "fiu":
        raise TypeError(f"a velocity of {step.velocity.dtype}; real numbers are needed")
    return np.array(step.velocity, dtype=np.float64)


def _law_failed(source: ServoGoal, context: StepContext, error_px: float | None, error: Exception) -> SourceOutput:
    reason = Reason(
        "LAW_FAILED",
        "hold",
        source.law,
        None,
        None,
        "",
        f"its step raised {type(error).__name__}: {error}; take another law, and tell the author of this one",
    )
    context.emit(
        "goal_aborted", id=source.goal.id, message=f"law {source.law!r} failed", error_px=error_px, reasons=(reason,)
    )
    return SourceOutput(np.zeros_like(context.q), finished=True, error_px=error_px)


def _out_of_time(source: LawRun, context: StepContext, error_px: float | None) -> SourceOutput:
    run = context.state.block.numbers.run
    held = () if source.apart is None else (source.apart,)
    if error_px is None:
        hint = "no error was measured"
    elif held and error_px <= source.tolerance_px:
        hint = f"the error is {error_px:.3f} px (tolerance {source.tolerance_px} px), but the cameras disagree"
    else:
        hint = f"the error is still {error_px:.3f} px (tolerance {source.tolerance_px} px)"
    reason = Reason("TIME_LIMIT", "hold", "", run.moved_s, source.time_limit_s, "s", hint)
    context.emit(
        "goal_aborted",
        id=source.goal.id,
        message="not reached in time",
        error_px=error_px,
        reasons=(reason, *held, *source.reasons),
    )
    return SourceOutput(np.zeros_like(context.q), finished=True, error_px=error_px)


LARGEST_LAG_PX = 20.0
"""Distance behind its path [px] at which the plan waits for the body."""


def trajectory_task(source: ServoGoal, context: StepContext, scene: Scene, task: Task) -> Task:
    """The task of law ``trajectory`` at present: the plan's set-points and joints, and their rates. Advances the plan's
    time.
    """
    plan = source.plan
    assert plan is not None
    if source.plan_s > 0.0:  # cycles that the loop missed: the arm continued at its last velocity
        missed = round(context.derived.workspace.numbers.elapsed_s / context.dt_s) - 1
        source.plan_s = min(max(0.0, source.plan_s + missed * context.dt_s), float(plan.times[-1]))
    begin_s = source.plan_s
    set_points, share = _planned_set_points(source, scene)
    required = np.ones_like(source.wanted) if share < 1.0 else source.wanted
    distances = np.sqrt(((set_points - scene.pixels) ** 2).sum(axis=-1))
    lag = float(np.where(scene.weights * required > 0.0, distances, 0.0).max()) / LARGEST_LAG_PX
    source.plan_s = advance(plan, source.plan_s, context.dt_s, lag)
    # Displacement of the set-points in the next step: its mean rate is feasible for a velocity held for a step.
    ahead, _ = _planned_set_points(source, scene)
    joints = planned_joints(plan, begin_s, source.plan_s, context.dt_s, context.q)
    return task._replace(
        set_points=set_points,
        wanted=required,
        rates=(ahead - set_points) / context.dt_s,
        joint_rates=joints.rates,
        joint_error=joints.error,
        joint_weight=joints.weight,
    )


def _planned_set_points(source: ServoGoal, scene: Scene) -> tuple[FloatArray, float]:
    """The plan's set-points (c, m, 2) at its current time, and this time as a fraction of the plan's duration.

    The difference between the goal's set-points and the projections of the body at the goal is added in proportion to
    that fraction.
    """
    plan, start = source.plan, source.start_points
    assert plan is not None
    assert start is not None
    here = sample_plan(plan, source.plan_s).displacement
    pixels, _ = project_points(scene.matrices, transform_points(here, start))
    length_s = float(plan.times[-1])
    share = min(1.0, source.plan_s / length_s) if length_s > 0.0 else 1.0
    goal_pixels, _ = project_points(scene.matrices, source.target_points)
    given = source.wanted[..., None] > 0.0
    return pixels + share * np.where(given, source.set_points - goal_pixels, 0.0), share


Progress = tuple[float | None, float | None]


def servo_progress(source: ServoGoal, context: StepContext) -> Progress:
    """Completed fraction [0, 1] of the goal's path, and the remaining seconds; None if unknown."""
    if error_of_run(context.state.block) is None:
        return None, None
    if context.derived.laws[source.law].planned:
        if source.plan is None:
            return None, None
        length_s = float(source.plan.times[-1])
        if source.plan_s < length_s:
            return source.plan_s / length_s, length_s - source.plan_s
    if source.stream is not None:
        return None, None
    return run_progress(source, context)


def run_progress(source: LawRun, context: StepContext) -> Progress:
    """The same for any law, from the exponential decay of its error."""
    record = context.state.block.record
    slow = 1.0 + source.damping
    known, done, left_s = decay_of_error(record, source.tolerance_px, source.gain_near / slow, source.gain_far / slow)
    return (done, left_s) if known else (None, None)


def examine_servo(source: ServoGoal, context: StepContext, earlier: tuple[Reason, ...]) -> list[Reason]:
    """The progress reasons of a goal in set-points, in addition to those already given (``earlier``) in this step."""
    return examine_progress(source, context, earlier, _servo_traits(source, context))


def examine_run(source: LawRun, context: StepContext, earlier: tuple[Reason, ...]) -> list[Reason]:
    """The progress reasons of any other law's goal."""
    return examine_progress(source, context, earlier, _plain_traits(source, context))


def _servo_traits(source: ServoGoal, context: StepContext) -> Traits:
    local = source.law if context.derived.laws[source.law].path == "free" else ""
    return _plain_traits(source, context)._replace(
        required=source.wanted, moves=source.stream is not None or source.followed is not None, local_law=local
    )


def _plain_traits(source: LawRun, context: StepContext) -> Traits:
    gain = gain_now(source, error_of_run(context.state.block)) / (1.0 + source.damping)
    return Traits(gain, run_progress(source, context)[1] or 0.0, moves=bool(source.goal.follow_markers))
