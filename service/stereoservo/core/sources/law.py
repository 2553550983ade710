"""Motion source of visual servoing: drives the arm by a control law from a goal's set-points to joint velocities, with
adaptive gain and tracking of a plan, until the error stays below its tolerance or the goal fails.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.face_choice import choose_face, law_scene
from stereoservo.control.law import JacobianChoice, LawStep, Options, Scene, Task
from stereoservo.control.law_registry import LAWS
from stereoservo.control.laws.stereo import ILL_CONDITIONED
from stereoservo.control.mobility_kernel import self_motion_from_limits
from stereoservo.core.context import SourceOutput, StepContext
from stereoservo.core.goals.marker_body import MIN_MARKERS, RIGID_FREEDOMS, markers_needed
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.prediction import body_points, centre_into, centre_of, scene_of, triangulated
from stereoservo.core.sources.streaming import feed_forward, follow
from stereoservo.core.state import LawRun, ServoGoal
from stereoservo.kinematics.kernels import project_points, transform_points
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, KindArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import damped_least_squares
from stereoservo.planning.tracking import advance, planned_joints, sample_plan

Progress = tuple[float | None, float | None]

SELF_MOTION_RATE = 0.5
"""[1/s], of a joint's half range: how fast self-motion takes it from a limit."""


def servo_step(source: ServoGoal, context: StepContext) -> SourceOutput:
    """One step of a law: error, joint velocity, and whether the goal is reached or out of time."""
    arrays, prediction, pixels = context.arrays, context.prediction, context.pixels
    if arrays is None or prediction is None or context.weights is None or pixels is None:
        raise AssertionError("a law runs only with a model")
    streamed = follow(source, context, arrays) if source.stream is not None else False
    found = goal_error(source, context, arrays, context.weights, pixels)
    error_px = found.error_px
    ended = run_ended(source, context, error_px, found.seen, source.wanted, may_end=not streamed)
    if ended is not None:
        return ended
    law = context.derived.laws[source.law]
    scene, task = choose(source, context, *scene_and_task(source, context, arrays, found))
    if law.planned:
        if source.plan is None and source.pose_known:
            hint = "the way is planned from where the arm comes to rest"
            waits = Reason("PLANNING", "slow", hint=hint)
            return SourceOutput(np.zeros_like(context.q), error_px=error_px, reasons=(waits,))
        if source.plan is not None:
            task = trajectory_task(source, context, scene, task)
    try:
        step = law.step(scene, task, options(source, context, error_px, source.jacobian))
        velocity = velocity_of(step, len(context.q))
    except Exception as error:  # whatever a third party's law raises ends its goal, never the loop
        return _law_failed(source, context, error_px, error)
    if streamed:
        velocity = velocity + feed_forward(source, context, found.usable * source.wanted)
    if len(velocity) > RIGID_FREEDOMS and source.plan is None:  # a plan has kept off the limits itself
        velocity = velocity + away_from_limits(context)
    return SourceOutput(
        velocity, True, source.goal.speed_scale, error_px=error_px, task_error=step.error,
        reasons=law.reasons(step),
    )  # fmt: skip


class GoalError(NamedTuple):
    """A goal and its body now: ``usable`` (c, m) weights of the cameras that it may use; the largest distance
    ``error_px`` over markers and cameras, None where none is seen; how many of its markers are ``seen``. Of the joints
    with their correction, the body's ``points`` (m, 4) and the ``centre`` (4,) of the goal.
    """

    usable: FloatArray
    error_px: float | None
    seen: int
    points: FloatArray
    centre: FloatArray


def goal_error(
    source: ServoGoal, context: StepContext, arrays: ModelArrays, weights: FloatArray, pixels: FloatArray
) -> GoalError:
    """Error and body of ``source`` with the present ``weights`` (c, m) and ``pixels`` (c, m, 2)."""
    usable, points, centre = np.empty(weights.shape), np.empty(arrays.marker_points.shape), np.empty(4)
    measured, error_px, seen = _goal_error(
        weights, source.used, source.wanted, pixels, source.set_points, arrays.generators, arrays.kinds,
        arrays.zero, context.q, context.state.block.correction, arrays.tip_first, arrays.marker_points,
        source.centre_weights, source.centre_body, usable, points, centre,
    )  # fmt: skip
    return GoalError(usable, error_px if measured else None, seen, points, centre)


@kernel
def _goal_error(
    weights: FloatArray, used: FloatArray, wanted: FloatArray, pixels: FloatArray, set_points: FloatArray,
    generators: FloatArray, kinds: KindArray, zero: FloatArray, q: FloatArray, correction: FloatArray, tip_first: bool,
    marker_points: FloatArray, centre_weights: FloatArray, centre_body: FloatArray, usable: FloatArray,
    points: FloatArray, centre: FloatArray,
) -> tuple[bool, float, int]:  # fmt: skip
    """The arrays of `GoalError` into the last three; whether an error was measured, it, and the markers seen."""
    cameras, markers = weights.shape
    largest, measured, seen = 0.0, False, 0
    for i in range(markers):
        visible = False
        for c in range(cameras):
            usable[c, i] = weights[c, i] * used[c]
            if not usable[c, i] * wanted[c, i] > 0.0:
                continue
            visible = True
            u, v = pixels[c, i, 0] - set_points[c, i, 0], pixels[c, i, 1] - set_points[c, i, 1]
            distance = math.sqrt(u * u + v * v)
            if distance > largest or math.isnan(distance):
                largest = distance
        measured = measured or visible
        seen += visible
    joints = q + correction
    points[:] = body_points(generators, kinds, zero, joints, tip_first, marker_points)
    centre_into(generators, kinds, zero, joints, tip_first, points, centre_weights, centre_body, centre)
    return measured, largest, seen


def activate_run(source: LawRun, context: StepContext) -> None:
    """Start the clock, the frame count and the lease of a law that begins now."""
    source.started_ns = context.now_ns
    source.last_frames = sum(e.frames for e in context.state.cameras)
    source.renew_lease(context.now_ns)


def awaits_plan(source: ServoGoal, context: StepContext) -> bool:
    """Whether a goal follows a plan that is still to be made."""
    return context.derived.laws[source.law].planned and source.plan is None


def away_from_limits(context: StepContext) -> FloatArray:
    """Self-motion (n,) of a redundant arm that takes its joints from their limits; the body stays where it is."""
    assert context.prediction is not None
    limits = context.settings.limits
    rows = np.ascontiguousarray(context.prediction.jacobian).reshape(-1, len(context.q))
    return self_motion_from_limits(
        rows, context.q, limits.position_min, limits.position_max, SELF_MOTION_RATE
    )


def run_ended(
    source: LawRun, context: StepContext, error_px: float | None, seen: int, wanted: FloatArray | None = None, *,
    may_end: bool = True,
) -> SourceOutput | None:  # fmt: skip
    """What a law's step comes to where it is out of time, sees too little, or is there; None: it goes on.

    ``seen``: markers of the goal that are seen, of those ``wanted`` (c, m); None: of more than are needed. ``may_end``:
    off for a goal that moves still.
    """
    source.moved_s += context.dt_s
    source.error_px = error_px
    if source.moved_s > source.time_limit_s:
        return _out_of_time(source, context, error_px)
    needed = MIN_MARKERS if seen >= MIN_MARKERS or wanted is None else markers_needed(wanted)
    if seen < needed:
        reason = Reason(
            "TOO_FEW_MARKERS", "hold", "", float(seen), float(needed), "markers",
            "bring the goal's markers back into view",
        )  # fmt: skip
        return SourceOutput(
            np.zeros_like(context.q), needs_features=True, error_px=error_px, reasons=(reason,)
        )
    if _settled(source, context, error_px) and may_end:
        context.emit("goal_reached", id=source.goal.id, message=f"error {error_px:.4f} px", error_px=error_px)
        return SourceOutput(np.zeros_like(context.q), finished=True, reached=True, error_px=error_px)
    return None


def scene_and_task(
    source: ServoGoal, context: StepContext, arrays: ModelArrays, found: GoalError
) -> tuple[Scene, Task]:
    """The present and the goal as laws take them."""
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
    """The scene and the task on the face that the law works on now; a change of it is told."""
    assert context.arrays is not None
    if not source.pose_known:
        return scene, task
    before = source.choice
    if before.cameras > 0 and not context.observations:  # nothing has been seen since
        return law_scene(scene, before), task
    choice = choose_face(source.faces, scene, task, before)
    if choice.cameras == 0:  # nobody sees three markers of one face: on with the former, by the kinematics
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
"""Slopes are stated in 1/s per so many pixels."""


class GainCurve(NamedTuple):
    """``near`` and ``far`` [1/s], ``slope`` > 0 [1/s per 100 px]: how fast the gain leaves ``near``."""

    near: float
    far: float
    slope: float


def gain_at(curve: GainCurve, error_px: float | None) -> float:
    """The gain [1/s] at an error [px], the largest distance over markers and cameras; None: not measured.

    What is not known, or no number, takes the smaller of the two gains.
    """
    if curve.near == curve.far:
        return curve.near
    return adaptive_gain(curve.near, curve.far, curve.slope, math.nan if error_px is None else error_px)


@kernel
def adaptive_gain(near: float, far: float, slope: float, error_px: float) -> float:
    """`gain_at` as a kernel; NaN: not measured. Equal gains are constant, a negative error counts as none."""
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
    """How the law goes there in this step."""
    gain = gain_at(GainCurve(source.gain_near, source.gain_far, source.gain_slope), error_px)
    return Options(gain=gain, dt_s=context.dt_s, jacobian=jacobian)


def velocity_of(step: LawStep, joints: int) -> FloatArray:
    """A copy (n,) of the velocity of a law's step, of the type that kernels are compiled for.

    Raises ValueError where it is none of that many joints, TypeError where its numbers are not real.
    """
    if step.velocity.shape != (joints,):
        raise ValueError(f"a velocity of shape {step.velocity.shape}; ({joints},) is needed")
    if step.velocity.dtype.kind not in "fiu":
        raise TypeError(f"a velocity of {step.velocity.dtype}; real numbers are needed")
    return np.array(step.velocity, dtype=np.float64)


def _law_failed(
    source: ServoGoal, context: StepContext, error_px: float | None, error: Exception
) -> SourceOutput:
    reason = Reason(
        "LAW_FAILED", "hold", source.law, None, None, "",
        f"its step raised {type(error).__name__}: {error}; take another law, and tell the author of this one",
    )  # fmt: skip
    context.emit(
        "goal_aborted", id=source.goal.id, message=f"law {source.law!r} failed", error_px=error_px, reasons=(reason,)
    )  # fmt: skip
    return SourceOutput(np.zeros_like(context.q), finished=True, error_px=error_px)


def _out_of_time(source: LawRun, context: StepContext, error_px: float | None) -> SourceOutput:
    reason = Reason(
        "TIME_LIMIT", "hold", "", source.moved_s, source.time_limit_s, "s",
        "no error was measured" if error_px is None
        else f"the error is still {error_px:.3f} px (tolerance {source.tolerance_px} px)",
    )  # fmt: skip
    context.emit(
        "goal_aborted", id=source.goal.id, message="not reached in time", error_px=error_px,
        reasons=(reason, *source.watch.reasons),
    )  # fmt: skip
    return SourceOutput(np.zeros_like(context.q), finished=True, error_px=error_px)


def _settled(source: LawRun, context: StepContext, error_px: float | None) -> bool:
    """Whether the error stayed below the tolerance for ``hold_frames`` frames of every camera on average."""
    frames = sum(e.frames for e in context.state.cameras)
    new, cameras = frames - source.last_frames, len(context.state.cameras)
    if new >= cameras:
        source.last_frames = frames
        inside = error_px is not None and error_px <= source.tolerance_px
        source.held = source.held + new // cameras if inside else 0
    return source.held >= source.hold_frames


LARGEST_LAG_PX = 20.0
"""Distance behind its way at which the body is waited for."""


def trajectory_task(source: ServoGoal, context: StepContext, scene: Scene, task: Task) -> Task:
    """The task of law ``trajectory`` now: where the plan has set-points and joints, and how fast; its time goes on."""
    plan = source.plan
    assert plan is not None
    if source.plan_s > 0.0:  # cycles that the loop missed: the arm went on with the velocity of the last one
        missed = round(context.ingested.elapsed_s / context.dt_s) - 1
        source.plan_s = min(max(0.0, source.plan_s + missed * context.dt_s), float(plan.times[-1]))
    begin_s = source.plan_s
    set_points, share = _planned_set_points(source, scene)
    wanted = np.ones_like(source.wanted) if share < 1.0 else source.wanted
    apart = np.sqrt(((set_points - scene.pixels) ** 2).sum(axis=-1))
    lag = float(np.where(scene.weights * wanted > 0.0, apart, 0.0).max()) / LARGEST_LAG_PX
    source.plan_s = advance(plan, source.plan_s, context.dt_s, lag)
    # What the set-points move by in the step that begins: its mean is what a velocity held so long can do.
    ahead, _ = _planned_set_points(source, scene)
    joints = planned_joints(plan, begin_s, source.plan_s, context.dt_s, context.q)
    return task._replace(
        set_points=set_points, wanted=wanted, rates=(ahead - set_points) / context.dt_s, joint_rates=joints.rates,
        joint_error=joints.error, joint_weight=joints.weight,
    )  # fmt: skip


def _planned_set_points(source: ServoGoal, scene: Scene) -> tuple[FloatArray, float]:
    """Where the plan has the set-points (c, m, 2) at its present time, and the share of this time in its length.

    What the goal's set-points differ by from the body's projections is brought in along the way.
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


STUCK_S = 3.0
"""Time of motion without a smaller error after which a law is said to be stuck."""
AVERAGED_S = 0.5
"""Time constant of the mean error that is looked at: noise alone shall not look like an advance."""
SMALLER = 0.95
"""Of the least mean error so far, below which it counts as smaller."""
LOOK_EVERY_S = 0.2
NEAR_LIMIT = 0.087
"""Room to a limit less its margin [rad or m] below which it is told: five degrees."""
NEAR_SINGULAR = 2.0 * ILL_CONDITIONED
FEW_MARKERS = 4
TAIL = 10.0
"""Times its tolerance, below which an error decays in the gain's tail."""
TAIL_S = 2.0
"""Least time that a tail takes to be told."""
NOISE_SIGMAS = 3.0

CAUSES = (
    "KEEP_OUT", "JOINT_LIMIT", "INCIDENCES_CONTRADICT", "INCIDENCE_NOT_DRIVABLE", "NOT_REACHABLE", "NO_FACE",
    "FEATURES_STALE", "TOO_FEW_MARKERS", "VISIBILITY_BLOCKED", "VISIBILITY_WAIT", "JACOBIAN_ILL_CONDITIONED",
    "NEAR_SINGULAR", "VELOCITY_SCALED",
)  # fmt: skip
"""What may hold a law up, the most probable first."""


def servo_progress(source: ServoGoal, context: StepContext) -> Progress:
    """Share [0, 1] of the goal's path that is done, and the seconds left; None where that is not known."""
    if source.error_px is None:
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
    """The same of any law, by the exponential decay of its error."""
    if source.error_px is None:
        return None, None
    left_s = _decay_s(source, source.error_px)
    whole_s = _decay_s(source, max(source.watch.first_px, source.error_px))
    return (1.0 if whole_s <= 0.0 else 1.0 - left_s / whole_s), left_s


def _decay_s(source: LawRun, error_px: float) -> float:
    """Time in which an error decays to the tolerance at the slower of the goal's gains."""
    return math.log(max(error_px / source.tolerance_px, 1.0)) / min(source.gain_near, source.gain_far)


def servo_progress_reasons(
    source: ServoGoal, context: StepContext, reported: tuple[Reason, ...]
) -> tuple[Reason, ...]:
    """The progress reasons of a goal in set-points."""
    local = source.law if context.derived.laws[source.law].path == "free" else ""
    traits = _ProgressTraits(source.wanted, source.stream is not None, local)
    return progress_reasons(source, context, reported, traits)


class _ProgressTraits(NamedTuple):
    """What differs by goal: set-points that count (c, m), whether they move, a law that may rest in a minimum."""

    wanted: FloatArray | None = None
    moves: bool = False
    local_law: str = ""


_PLAIN = _ProgressTraits()


def progress_reasons(
    source: LawRun, context: StepContext, told: tuple[Reason, ...], traits: _ProgressTraits = _PLAIN
) -> tuple[Reason, ...]:
    """What a law's run shows over time beside the reasons ``told`` in this step; kept between two examinations."""
    seen = source.watch
    error = source.error_px
    if error is not None:
        seen.first_px = max(seen.first_px, error)
        share = context.dt_s / (context.dt_s + AVERAGED_S)
        seen.mean_px = error if seen.mean_px == 0.0 else seen.mean_px + share * (error - seen.mean_px)
        if seen.least_px == 0.0 or seen.mean_px < SMALLER * seen.least_px or error <= source.tolerance_px:
            seen.least_px, seen.least_s = max(seen.mean_px, 1e-9), source.moved_s
    every = max(1, round(LOOK_EVERY_S / context.dt_s))
    if context.state.step % every == 0:
        seen.reasons = _examine_progress(source, context, told, traits)
    if not seen.reasons:
        return ()
    codes = {reason.code for reason in told}
    return tuple(reason for reason in seen.reasons if reason.code not in codes)


def _examine_progress(
    source: LawRun, context: StepContext, told: tuple[Reason, ...], traits: _ProgressTraits
) -> list[Reason]:
    found = [*_near_limits(context), *_near_singular(source, context), *_few_markers(source, context, traits)]
    tail = _tail(source)
    if tail is not None:
        found.append(tail)
    if not traits.moves:
        stuck = _stall_reason(source, context, (*told, *found), traits)
        if stuck is not None:
            found.insert(0, stuck)
    return found


def _near_limits(context: StepContext) -> list[Reason]:
    limits, moving = context.settings.limits, context.state.block.command
    found = []
    for j, name in enumerate(context.settings.joint_names):
        for bound, side in ((limits.position_max[j], 1.0), (limits.position_min[j], -1.0)):
            limit = float(bound) - side * limits.position_margin
            room = side * (limit - float(context.q[j]))
            if room < NEAR_LIMIT and side * moving[j] > 0.0:
                hint = f"joint {name} is {max(room, 0.0):.3f} from its limit less the margin, and moves towards it"
                found.append(Reason("NEAR_LIMIT", "info", name, float(context.q[j]), limit, "rad or m", hint))
    return found


def _near_singular(source: LawRun, context: StepContext) -> list[Reason]:
    """By the pivots of the pixels' normal matrix: a small one is a motion that takes much and shows little."""
    if context.prediction is None or context.weights is None:
        return []
    from_pivots = image_conditioning(context, source)
    if from_pivots >= NEAR_SINGULAR or len(context.q) > 6:
        return []
    hint = "some motion of the body takes large joint motions here: expect it to be slow, or go round the singularity"
    return [Reason("NEAR_SINGULAR", "info", "", from_pivots, NEAR_SINGULAR, "", hint)]


def image_conditioning(context: StepContext, source: LawRun) -> float:
    """Smallest Cholesky pivot of the normal matrix of all seen pixels over its largest diagonal; 0: singular."""
    assert context.prediction is not None
    assert context.weights is not None
    n = len(context.q)
    J = np.ascontiguousarray(context.prediction.jacobian).reshape(-1, n)
    weights = np.repeat((context.weights * source.used[:, None] > 0.0).astype(np.float64).reshape(-1), 2)
    _, conditioning = damped_least_squares(J, np.zeros(len(J)), weights, 0.0)
    return float(conditioning)


def _few_markers(source: LawRun, context: StepContext, traits: _ProgressTraits) -> list[Reason]:
    if context.weights is None:
        return []
    usable = context.weights * source.used[:, None]
    if traits.wanted is not None:
        usable = usable * traits.wanted
    seen = int((usable.max(axis=0) > 0.0).sum())
    if seen >= FEW_MARKERS:
        return []
    hint = f"{seen} of the goal's markers are seen: one more that is hidden stops the arm, and the noise counts in full"
    return [Reason("FEW_MARKERS", "info", "", float(seen), float(FEW_MARKERS), "markers", hint)]


def _tail(source: LawRun) -> Reason | None:
    error = source.error_px
    if error is None or not source.tolerance_px < error < TAIL * source.tolerance_px:
        return None
    left_s = _decay_s(source, error)
    if left_s < TAIL_S:
        return None
    gain = gain_at(GainCurve(source.gain_near, source.gain_far, source.gain_slope), error)
    hint = (
        f"near the goal the error falls to a third in {1.1 / gain:.1f} s: a higher gain (or one that rises near the "
        "goal), or a wider tolerance, is faster"
    )
    return Reason("LOW_GAIN", "info", "", left_s, TAIL_S, "s", hint)


def _stall_reason(
    source: LawRun, context: StepContext, told: tuple[Reason, ...], traits: _ProgressTraits
) -> Reason | None:
    error, since_s = source.error_px, source.moved_s - source.watch.least_s
    if error is None or error <= source.tolerance_px or since_s < STUCK_S:
        return None
    codes = {reason.code: reason for reason in reversed(told)}
    cause = next((codes[code] for code in CAUSES if code in codes), None)
    noise = _noise_px(source, context)
    if error <= NOISE_SIGMAS * noise:
        cause = None
        why = (
            f"most probably the tolerance of {source.tolerance_px:g} px is below what the images allow: a marker has "
            f"a deviation of {noise:.3f} px; widen it"
        )
    elif cause is not None:
        why = f"most probably {cause.code} {cause.subject}".rstrip() + f": {cause.hint}"
    elif traits.local_law:
        law = traits.local_law
        sure = " or ".join((*LAWS.on_path("straight")[:1], *LAWS.on_path("planned")[:1]))
        why = f"most probably law {law!r} rests in a minimum beside the goal: take {sure}"
    else:
        why = "nothing holds it up that is known: has the goal's body another shape, or has a camera or marker moved?"
    hint = f"the error is {error:.3f} px, no smaller for {since_s:.0f} s; {why}"
    return Reason(
        "STUCK", "slow", "" if cause is None else cause.subject, error, source.tolerance_px, "px", hint
    )


def _noise_px(source: LawRun, context: StepContext) -> float:
    """Largest deviation [px] of one observation of a marker that is seen."""
    if context.weights is None:
        return 0.0
    usable = context.weights * source.used[:, None]
    if not bool((usable > 0.0).any()):
        return 0.0
    return 1.0 / float(usable[usable > 0.0].min())
