"""Prepares goals: resolves a target to a motion source, for a large body in parts over several steps; and plans the
path to a goal in slices over control steps before the arm moves: reports it or refuses the goal.

The result is reported with the reply. Planned laws follow the plan. Straight laws drive the straight path that was
planned. Free laws take a path of their own, so only the goal itself can be refused.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.faces import kept_faces
from stereoservo.control.law_registry import LAWS
from stereoservo.core.context import RefusalError, StepContext, no_model
from stereoservo.core.goals.marker_body import MAX_GOAL_RESIDUAL_PX, BodyState, left_by_components, place_now, view_of
from stereoservo.core.goals.reported_path import reported_pixels, reported_samples
from stereoservo.core.goals.resolve import (
    AT_ONCE,
    Resolvable,
    begin_resolution,
    joint_index,
    of_this_model,
    resolve_part,
)
from stereoservo.core.goals.servoing import law_of, start_servoing
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.monitors.camera_relocalization import refuse_while_moved
from stereoservo.core.prediction import centre_of, chain_at, markers_at
from stereoservo.core.settings import RIGID_FREEDOMS
from stereoservo.core.sources.incidence import start_incidence
from stereoservo.core.sources.joint_move import joint_goal
from stereoservo.core.sources.law import choose, goal_error, scene_and_task
from stereoservo.core.state import IncidenceGoal, JointMove, PlanJob, Purpose, ServoGoal
from stereoservo.kinematics.kernels import project_points
from stereoservo.messages import goals
from stereoservo.messages.goals import Goal, IncidenceTarget, JointTarget, PlanReport, StepTarget, TaughtTarget
from stereoservo.messages.reasons import Reason
from stereoservo.messages.status import ModelReadiness
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.planning.path_search import MISSING_FREEDOMS, continue_planning
from stereoservo.planning.plan import ClosestApproach, Plan, PlanLimits, PlanRequest
from stereoservo.planning.planner import PlanRequestError, start_planning

SLICE = 8
"""Samples of the arm's path that a step processes."""
PIXELS_PER_STEP = 512
"""Largest number of marker pixels in these samples; a step processes fewer samples of a large body."""
VIEW_MARGIN_PX = 5.0
PLANNED_SPEED, PLANNED_ACCELERATION = 0.9, 0.7
"""Fractions of the limits with which a path is planned; the rest is left for feedback."""


def begin_plan(job: PlanJob, context: StepContext) -> None:
    """Start planning the path of the job's source from its start.

    Raises RefusalError if the request is inconsistent.
    """
    source, arrays = job.source, context.arrays
    assert source is not None
    assert arrays is not None
    try:
        job.planning = start_planning(_plan_request(source, context, arrays, job.points, job.joints))
    except PlanRequestError as error:
        raise RefusalError("NOT_PLANNED", str(error)) from error


def plan_again(source: ServoGoal, context: StepContext) -> PlanJob:
    """Start planning the path of the active ``source`` again, from the body's current pose. Raises RefusalError."""
    assert context.arrays is not None
    points = markers_at(context.arrays, context.q + context.state.block.correction)
    job = PlanJob(
        request=-1,
        purpose="again",
        goal=source.goal,
        source=source,
        planning=None,
        joints=context.q.copy(),
        points=points,
    )
    begin_plan(job, context)
    return job


def _plan_request(
    source: ServoGoal, context: StepContext, arrays: ModelArrays, points: FloatArray, joints: FloatArray
) -> PlanRequest:
    settings = context.settings
    limits, goal = settings.limits, source.goal
    used = np.flatnonzero(source.used > 0.0)
    margin = limits.position_margin
    keep_outs = limits.keep_outs.copy()
    keep_outs[:, :, 0] -= margin
    keep_outs[:, :, 1] += margin
    matrices = np.ascontiguousarray(arrays.matrices[used])
    camera_centres = np.ascontiguousarray(arrays.camera_centres[used])
    kept = (view_of(settings, arrays, points)[1][used] * source.wanted[used]).min(axis=0)
    return PlanRequest(
        operators=chain_at(arrays, joints)[1],
        composition=arrays.composition,
        joints=joints.copy(),
        matrices=matrices,
        camera_centres=camera_centres,
        points=points.copy(),
        targets=source.target_points.copy(),
        must_stay_visible=kept,
        centre=centre_of(source, joints + context.state.block.correction, arrays, points),
        centre_target=source.centre_target.copy(),
        faces=kept_faces(source.faces, points, source.target_points, matrices, camera_centres),
        limits=PlanLimits(
            position_min=limits.position_min + margin,
            position_max=limits.position_max - margin,
            velocity_max=limits.velocity_max * (PLANNED_SPEED * limits.speed_scale),
            acceleration_max=limits.acceleration_max * PLANNED_ACCELERATION,
            keep_outs=keep_outs,
            sizes=np.array([(settings.cameras[c].width, settings.cameras[c].height) for c in used], dtype=np.float64),
            lenses=np.ascontiguousarray(arrays.lenses[used]),
            view_margin_px=VIEW_MARGIN_PX,
        ),
        profile=goal.profile or "linear",
        bend=context.derived.laws[source.law].planned,
        speed_scale=goal.speed_scale,
        posture=None if goal.posture is None else _posture(goal.posture, joints, context),
    )


def _posture(named: dict[str, float], joints: FloatArray, context: StepContext) -> FloatArray:
    """Joints (n,) of a goal's posture, others as in ``joints`` (n,). Raises RefusalError for unknown names."""
    posture = joints.copy()
    for name, position in named.items():
        posture[joint_index(name, context.settings)] = position
    return posture


def plan_slice(job: PlanJob) -> bool:
    """Do one step's share of planning a path; returns whether planning is complete. For a large body it is complete one
    step later, and reported then.
    """
    planning = job.planning
    assert planning is not None
    if planning.finished:
        return True
    request = planning.request
    pixels = len(request.points) * len(request.matrices)
    continue_planning(planning, min(SLICE, PIXELS_PER_STEP // pixels or PIXELS_PER_STEP / pixels))
    return planning.finished and pixels <= PIXELS_PER_STEP


def plan_report(job: PlanJob, context: StepContext) -> PlanReport:
    """The report of the result; stores the plan in the job's source. Raises RefusalError if the goal must not be
    driven.
    """
    source, planning = job.source, job.planning
    assert source is not None
    assert planning is not None
    plan = planning.plan
    if plan is not None:
        if len(plan.joints[-1]) < RIGID_FREEDOMS and job.purpose in ("reply", "queue"):
            _require_components(job, context)
        source.goal_joints = plan.joints[-1].copy()
        if context.derived.laws[source.law].planned:
            source.plan, source.plan_s, source.start_points = plan, 0.0, job.points.copy()
        return _planned(job, plan, context)
    failures = planning.failure
    approaches = tuple(_approach(failure, job, context) for failure in failures)
    texts = tuple(_text(failure, context, source.goal.posture is not None) for failure in approaches)
    report = PlanReport(
        law=source.law,
        way=f"not guaranteed: {texts[0]}",
        seconds=_exponential_s(job, context),
        approaches=approaches,
        shares=(),
        joints={},
        pixels={},
    )
    at_goal = failures[0].path_parameter >= 1.0
    path = context.derived.laws[source.law].path
    if path == "free" and not at_goal:
        return report
    hint, planned = "", LAWS.on_path("planned")
    if path != "planned" and planned and not (at_goal and approaches[0].code == "NOT_REACHABLE"):
        hint = f"; law {planned[0]!r} searches for another path, and for another posture at the goal"
    elif not at_goal:
        hint = "; no other path was found either: go by another goal between"
    reasons = tuple(
        Reason(a.code, "info", a.subject, a.value, a.limit, a.unit, text + (hint if k == 0 else ""))
        for k, (a, text) in enumerate(zip(approaches, texts, strict=True))
    )
    first = reasons[0]
    raise RefusalError(
        first.code, first.hint, subject=first.subject, value=first.value, threshold=first.threshold, unit=first.unit,
        further=reasons[1:], plan=report,
    )  # fmt: skip


def _require_components(job: PlanJob, context: StepContext) -> None:
    """Raises RefusalError if a law in components would come to rest beside the goal, because the arm can make hinge and
    planar turn of the face only together.
    """
    source, arrays = job.source, context.arrays
    assert source is not None
    assert arrays is not None
    if context.derived.laws[source.law].path != "straight" or context.weights is None or context.pixels is None:
        return
    found = goal_error(source, context, arrays, context.weights, context.pixels)
    _, task = choose(source, context, *scene_and_task(source, context, arrays, found))
    operators = chain_at(arrays, job.joints)[1]
    left = left_by_components(arrays, operators, job.points, source.target_points, task.face)
    if left <= MAX_GOAL_RESIDUAL_PX:
        return
    others = ", ".join(repr(name) for name in (*LAWS.on_path("free"), *LAWS.on_path("planned")))
    raise RefusalError(
        "NOT_REACHABLE",
        f"the arm reaches the goal, and not by law {source.law!r}, which makes each component of the motion by itself: "
        f"with {len(job.joints)} joints it would stop {left:.1f} px beside it (up to {MAX_GOAL_RESIDUAL_PX:g} px is "
        f"accepted); take one of {others}",
        subject=source.law,
        value=left,
        threshold=MAX_GOAL_RESIDUAL_PX,
        unit="px",
    )


def planning_reason(job: PlanJob) -> Reason:
    """Reason: a goal is being planned."""
    done = 0 if job.planning is None else job.planning.followed
    hint = f"goal {job.goal.id} is being planned ({done} paths tried); cancel it, hold or stop at any time"
    return Reason("PLANNING", "info", job.goal.id, float(done), None, "ways", hint)


def _planned(job: PlanJob, plan: Plan, context: StepContext) -> PlanReport:
    arrays = context.arrays
    assert arrays is not None
    source, settings = job.source, context.settings
    assert source is not None
    count = min(reported_samples(arrays), len(plan.times))
    at = [round(k * (len(plan.times) - 1) / max(count - 1, 1)) for k in range(count)]
    seconds = float(plan.times[-1])
    description = plan.description
    path = context.derived.laws[source.law].path
    if path != "planned":
        seconds = max(seconds, _exponential_s(job, context))
        if path == "free":
            description = f"not guaranteed: law {source.law!r} follows its own path; the straight one is free"
    return PlanReport(
        law=source.law,
        way=description,
        seconds=seconds,
        approaches=tuple(_approach(approach, job, context) for approach in plan.approaches),
        shares=tuple(float(plan.path_parameters[k]) for k in at),
        joints={name: tuple(float(plan.joints[k, j]) for k in at) for j, name in enumerate(settings.joint_names)},
        pixels={
            camera.name: pixels
            for camera, used, pixels in zip(
                settings.cameras,
                source.used,
                reported_pixels(arrays, plan.displacements[at], job.points),
                strict=True,
            )
            if used != 0.0
        },
    )


def _exponential_s(job: PlanJob, context: StepContext) -> float:
    """Time in which the error decays to its tolerance at the goal's gain and damping [s]."""
    source, arrays = job.source, context.arrays
    assert source is not None
    assert arrays is not None
    asked = source.wanted * source.used[:, None]
    error = float(_largest_error(arrays.matrices, job.points, source.set_points, asked))
    gain = min(source.gain_near, source.gain_far) / (1.0 + source.damping)
    return math.log(max(error / source.tolerance_px, 1.0)) / gain


@kernel
def _largest_error(matrices: FloatArray, points: FloatArray, set_points: FloatArray, weights: FloatArray) -> float:
    """Largest distance [px] of ``points`` (m, 4) from ``set_points`` (c, m, 2), times ``weights`` (c, m)."""
    pixels, _ = project_points(matrices, points)
    errors = np.empty(weights.shape)
    for c in range(weights.shape[0]):
        for i in range(weights.shape[1]):
            u, v = pixels[c, i, 0] - set_points[c, i, 0], pixels[c, i, 1] - set_points[c, i, 1]
            errors[c, i] = math.sqrt(u * u + v * v) * weights[c, i]
    return float(errors.max())


def _approach(approach: ClosestApproach, job: PlanJob, context: StepContext) -> goals.Approach:
    """An approach with names instead of indices."""
    settings, arrays = context.settings, context.arrays
    assert arrays is not None
    index = approach.index
    if approach.kind == "JOINT_LIMIT":
        subject = settings.joint_names[index]
    elif approach.kind == "KEEP_OUT":
        subject = settings.limits.keep_out_names[index]
    elif approach.kind == "NOT_REACHABLE":
        subject = MISSING_FREEDOMS[index] if 0 <= index < len(MISSING_FREEDOMS) else ""
    else:
        assert job.source is not None
        subject = settings.cameras[int(np.flatnonzero(job.source.used > 0.0)[index])].name
    return goals.Approach(
        approach.kind, subject, approach.value, approach.limit, approach.clearance, approach.unit,
        approach.path_parameter, arrays.marker_ids[approach.marker] if approach.marker >= 0 else None,
    )  # fmt: skip


def _text(failure: goals.Approach, context: StepContext, asked_posture: bool) -> str:
    """Text: where a path fails, and why."""
    where = "at the goal" if failure.share >= 1.0 else f"at {100.0 * failure.share:.0f} % of the path"
    value, limit, unit = f"{failure.value:.4g}", f"{failure.limit:.4g}", failure.unit
    if failure.code == "JOINT_LIMIT":
        return f"{where} joint {failure.subject} would be at {value} {unit}, {limit} {unit} is its limit"
    if failure.code == "KEEP_OUT":
        return f"{where} the arm would enter keep-out {failure.subject!r} by {abs(failure.room):.4g} {unit}"
    if failure.code == "FIELD_OF_VIEW":
        return (
            f"{where} marker {failure.marker} would be {value} px from the border of camera {failure.subject!r}; "
            f"{limit} px are kept"
        )
    if failure.code == "FACE_HIDDEN":
        return f"{where} camera {failure.subject!r} would see the face under {value} {unit}; {limit} {unit} are needed"
    if failure.code == "NOT_REACHABLE" and asked_posture and failure.share >= 1.0:
        return (
            f"the posture that was asked for is none of this goal: in it the markers are {value} px from it, "
            f"{limit} px are allowed; `stereoservo ik` lists the postures that reach it"
        )
    if failure.code == "BEHIND_CAMERA":
        return f"{where} marker {failure.marker} would pass camera {failure.subject!r}: {value} {unit}"
    return (
        f"{where} the arm cannot follow: it lacks the freedom {failure.subject or 'that is needed'} there, and stays "
        f"{value} {unit} away"
    )


Prepared = JointMove | IncidenceGoal | ServoGoal | PlanJob
"""The source of a goal; or a job, if parts of the resolution are left or its path must be planned."""


def prepare(
    goal: Goal,
    context: StepContext,
    purpose: Purpose,
    request: int = -1,
    place: BodyState | None = None,
    joints: FloatArray | None = None,
) -> Prepared:
    """Prepare a goal for a ``purpose``. Raises RefusalError.

    ``place``, ``joints`` (n,): start of the body and the arm; None: their current ones.
    """
    target = goal.target
    if goal.posture is not None:
        _require_plan(goal, context)
    if isinstance(target, JointTarget):
        return joint_goal(goal, target, context)
    if isinstance(target, TaughtTarget):
        raise RefusalError("TAUGHT_UNRESOLVED", f"taught goal {target.name!r} was not looked up", subject=target.name)
    if isinstance(target, StepTarget):
        raise RefusalError("STEP_UNRESOLVED", f"frame {target.frame!r} was not looked up", subject=target.frame)
    if context.state.reanchoring is not None:
        refuse_while_moved(context.state)
    epoch = trusted_model(context)
    if isinstance(target, IncidenceTarget):
        return start_incidence(goal, target, context, place_now(context) if place is None else place)
    _, law = law_of(goal, context)
    of_this_model(target.model_epoch, epoch)
    body = place_now(context) if place is None else place
    job = PlanJob(
        request=request,
        purpose=purpose,
        source=None,
        planning=None,
        joints=(context.q if joints is None else joints).copy(),
        points=body.points.copy(),
        goal=goal,
        resolution=begin_resolution(
            body, (context.q if joints is None else joints) + context.state.block.correction, law.needs_goal_pose
        ),
    )
    if body.arrays.observation_count <= AT_ONCE:
        set_up(job, context)
    if job.source is None or (job.planning is not None):
        return job
    return job.source


def _require_plan(goal: Goal, context: StepContext) -> None:
    """Raises RefusalError for a goal with a posture if its law does not follow a plan."""
    name, law = law_of(goal, context)
    planned = " or ".join(LAWS.on_path("planned")) or "none is installed"
    if isinstance(goal.target, JointTarget | IncidenceTarget):
        said = f"a goal in {'joints' if isinstance(goal.target, JointTarget) else 'incidences'} has none of choice"
    elif not law.planned:
        said = f"law {name!r} follows no plan, and ends in the posture that its path leads to"
    else:
        return
    raise RefusalError(
        "POSTURE_NOT_PLANNED", f"{said}; a posture is for goals of markers by a law that plans: {planned}"
    )


def set_up(job: PlanJob, context: StepContext) -> bool:
    """Do one step's share of the resolution before the path search; returns whether it is complete. Raises
    RefusalError.
    """
    while not _set_up_part(job, context):
        assert context.arrays is not None
        if context.arrays.observation_count > AT_ONCE:
            return False
    return True


def _set_up_part(job: PlanJob, context: StepContext) -> bool:
    resolved, arrays = job.resolution, context.arrays
    assert arrays is not None
    if resolved is not None and job.source is None:
        place = BodyState(context.settings, arrays, resolved.start, resolved.operators, resolved.faces)
        target = job.goal.target
        assert isinstance(target, Resolvable)
        if resolve_part(resolved, target, place):
            job.source, job.resolution = start_servoing(job.goal, resolved, context), None
            return job.purpose == "enqueue" or not job.source.pose_known
    elif job.planning is None:
        begin_plan(job, context)
    return job.planning is not None


def trusted_model(context: StepContext) -> int:
    """Epoch of the model in use. Raises RefusalError if there is none, or no valid one."""
    state = context.state
    if state.model is None or context.arrays is None or state.readiness == ModelReadiness.NONE:
        raise no_model(context, "the cell has no model yet: calibrate first")
    if state.readiness == ModelReadiness.SUSPECT:
        raise RefusalError(
            "MODEL_SUSPECT",
            "the model no longer explains the images: check the cameras and the markers, then calibrate",
        )
    if state.readiness == ModelReadiness.UNCONFIRMED and state.comparison is not None:
        r = state.comparison.reason
        raise RefusalError(r.code, r.hint, subject=r.subject, value=r.value, threshold=r.threshold, unit=r.unit)
    return state.model.epoch
