"""Prepares goals: from a target to the motion source that it comes to, with its way begun to be planned. Of a large
body a part of the work a step, so that no step has a goal's whole work.
"""

from __future__ import annotations

from stereoservo.control.law_registry import LAWS
from stereoservo.core.context import RefusalError, StepContext, no_model
from stereoservo.core.goals.marker_body import BodyState, place_now
from stereoservo.core.goals.plan import begin_plan
from stereoservo.core.goals.resolve import (
    AT_ONCE,
    Resolvable,
    begin_resolution,
    of_this_model,
    resolve_part,
)
from stereoservo.core.goals.servoing import law_of, start_servoing
from stereoservo.core.monitors.camera_relocalization import refuse_while_moved
from stereoservo.core.sources.incidence import start_incidence
from stereoservo.core.sources.joint_move import joint_goal
from stereoservo.core.state import IncidenceGoal, JointMove, PlanJob, Purpose, ServoGoal
from stereoservo.messages.goals import Goal, IncidenceTarget, JointTarget, TaughtTarget
from stereoservo.messages.status import ModelReadiness
from stereoservo.numerics.arrays import FloatArray

Prepared = JointMove | IncidenceGoal | ServoGoal | PlanJob
"""The source that a goal comes to; or the work on it, where some is left or its way is to be planned."""


def prepare(
    goal: Goal,
    context: StepContext,
    purpose: Purpose,
    request: int = -1,
    place: BodyState | None = None,
    joints: FloatArray | None = None,
) -> Prepared:
    """A goal for a ``purpose``, setting out from a ``place`` of the body with the arm at ``joints`` (n,), None: from
    where they are. Raises RefusalError.
    """
    target = goal.target
    if goal.posture is not None:
        _require_plan(goal, context)
    if isinstance(target, JointTarget):
        return joint_goal(goal, target, context)
    if isinstance(target, TaughtTarget):
        raise RefusalError(
            "TAUGHT_UNRESOLVED", f"taught goal {target.name!r} was not looked up", subject=target.name
        )
    epoch = trusted_model(context)
    if context.state.reanchoring is not None:
        refuse_while_moved(context.state)
    if isinstance(target, IncidenceTarget):
        return start_incidence(goal, target, context, place_now(context) if place is None else place)
    _, law = law_of(goal, context)
    of_this_model(target.model_epoch, epoch)
    body = place_now(context) if place is None else place
    job = PlanJob(
        request=request, purpose=purpose, source=None, planning=None,
        joints=(context.q if joints is None else joints).copy(), points=body.points.copy(), goal=goal,
        resolution=begin_resolution(body, context.q + context.state.block.correction, law.needs_goal_pose),
    )  # fmt: skip
    if body.arrays.sights <= AT_ONCE:
        set_up(job, context)
    if job.source is None or (job.planning is not None):
        return job
    return job.source


def _require_plan(goal: Goal, context: StepContext) -> None:
    """Raises RefusalError where a goal with a posture is none that a law reaches by a plan."""
    name, law = law_of(goal, context)
    planned = " or ".join(LAWS.on_path("planned")) or "none is installed"
    if isinstance(goal.target, JointTarget | IncidenceTarget):
        said = f"a goal in {'joints' if isinstance(goal.target, JointTarget) else 'incidences'} has none of choice"
    elif not law.planned:
        said = f"law {name!r} follows no plan, and ends in the posture that its way leads to"
    else:
        return
    raise RefusalError(
        "POSTURE_NOT_PLANNED", f"{said}; a posture is for goals of markers by a law that plans: {planned}"
    )


def set_up(job: PlanJob, context: StepContext) -> bool:
    """A step's share of what comes before the search for a way; whether all is done. Raises RefusalError."""
    while not _set_up_part(job, context):
        assert context.arrays is not None
        if context.arrays.sights > AT_ONCE:
            return False
    return True


def _set_up_part(job: PlanJob, context: StepContext) -> bool:
    aim, arrays = job.resolution, context.arrays
    assert arrays is not None
    if aim is not None and job.source is None:
        place = BodyState(context.settings, arrays, aim.start, aim.operators, aim.faces)
        target = job.goal.target
        assert isinstance(target, Resolvable)
        if resolve_part(aim, target, place):
            job.source, job.resolution = start_servoing(job.goal, aim, context), None
            return job.purpose == "enqueue" or not job.source.pose_known
    elif job.planning is None:
        begin_plan(job, context)
    return job.planning is not None


def trusted_model(context: StepContext) -> int:
    """Epoch of the model in use. Raises RefusalError where there is none, or none that holds."""
    state = context.state
    if state.model is None or context.arrays is None or state.readiness == ModelReadiness.NONE:
        raise no_model(context, "the cell has no model yet: calibrate first")
    if state.readiness == ModelReadiness.SUSPECT:
        raise RefusalError(
            "MODEL_SUSPECT",
            "the model no longer explains the images: check the cameras and the markers, then calibrate",
        )
    return state.model.epoch
