"""Motion source of goals in joint space: a straight line to target joints, checked against limits and keep-outs
beforehand, at a velocity from which the arm can brake. Also its report, progress and predicted pixels.
"""

from __future__ import annotations

import numpy as np

from stereoservo.core.context import RefusalError, SourceOutput, StepContext
from stereoservo.core.goals.reported_path import reported_pixels, reported_samples
from stereoservo.core.goals.resolve import joint_index
from stereoservo.core.prediction import chain_at
from stereoservo.core.settings import FINEST_ARRIVAL, CoreSettings, LimitSettings
from stereoservo.core.state import JointMove
from stereoservo.messages.goals import Approach, Goal, JointTarget, PlanReport
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray

APPROACH_GAIN = 15.0  # [1/s] end of a joint move
BRAKE_SHARE = 0.6  # fraction of the acceleration limit used to plan a joint move
ARRIVED_STEPS = 5


def joint_goal(goal: Goal, target: JointTarget, context: StepContext) -> JointMove:
    """The move to ``target``. Raises RefusalError for unknown joints and positions beyond limits."""
    goal_q = context.q.copy()
    for name, position in target.positions.items():
        goal_q[joint_index(name, context.settings)] = position
    _inside_limits(goal_q, context)
    move = joint_move_to(goal.id, goal_q, goal.speed_scale, context, goal.time_limit_s, goal.lease_s)
    move.acknowledge_s = goal.acknowledge_s
    return move


def joint_move_to(
    goal_id: str,
    target: FloatArray,
    speed_scale: float,
    context: StepContext,
    time_limit_s: float | None = None,
    lease_s: float | None = None,
) -> JointMove:
    """A move of all joints to ``target`` (n,), in its initial state."""
    move = JointMove(
        id=goal_id,
        target=np.array(target),
        start=context.q.copy(),
        speed_scale=speed_scale,
        started_ns=context.now_ns,
        time_limit_s=context.settings.time_limit_s if time_limit_s is None else time_limit_s,
        lease_s=lease_s,
        lease_until_ns=0,
    )
    move.renew_lease(context.now_ns)
    return move


def _inside_limits(target: FloatArray, context: StepContext) -> None:
    limits = context.settings.limits
    for i, name in enumerate(context.settings.joint_names):
        low, high = (
            limits.position_min[i] + limits.position_margin,
            limits.position_max[i] - limits.position_margin,
        )
        if not low <= target[i] <= high and target[i] != context.q[i]:
            raise RefusalError(
                "JOINT_LIMIT",
                f"joint {name}: {target[i]:.4f} is outside {low:.4f} … {high:.4f} (limits less the margin)",
                subject=name,
                value=float(target[i]),
                threshold=float(high if target[i] > high else low),
                unit="rad or m",
            )


def joint_report(move: JointMove, context: StepContext) -> PlanReport:
    """The expected course of the move. Raises RefusalError if its line meets a keep-out."""
    settings, limits = context.settings, context.settings.limits
    start = context.q
    for name, box in zip(limits.keep_out_names, limits.keep_outs, strict=True):
        share = first_inside(box, limits.position_margin, start, move.target)
        if share is not None:
            raise RefusalError(
                "KEEP_OUT",
                f"the straight path in joint space meets keep-out {name!r} at {100.0 * share:.0f} % of it: go by a "
                "goal beside it",
                subject=name,
                value=share,
                threshold=1.0,
                unit="of the way",
            )
    arrays = context.arrays
    count = reported_samples(arrays)
    shares = tuple(k / (count - 1.0) for k in range(count))
    joints = np.array([start + share * (move.target - start) for share in shares])
    pixels = {}
    if arrays is not None:
        displacements = np.array([chain_at(arrays, q)[0] for q in joints])
        found = reported_pixels(arrays, displacements, arrays.marker_points)
        pixels = {camera.name: of_camera for camera, of_camera in zip(settings.cameras, found, strict=True)}
    return PlanReport(
        law="joints",
        way="straight in joint space",
        seconds=_seconds(move, limits, start),
        approaches=(_nearest_limit(move, context),),
        shares=shares,
        joints={name: tuple(float(x) for x in joints[:, j]) for j, name in enumerate(settings.joint_names)},
        pixels=pixels,
    )


def first_inside(box: FloatArray, margin: float, start: FloatArray, target: FloatArray) -> float | None:
    """Fraction of the line from ``start`` to ``target`` (n,) at which it enters ``box`` (n, 2), or None.

    An arm that is inside already may leave: the safety stage lets it move outwards only.
    """
    enters, leaves = 0.0, 1.0
    for j in range(start.size):
        low, high = box[j, 0] - margin, box[j, 1] + margin
        travel = float(target[j] - start[j])
        if travel == 0.0:
            if not low <= start[j] <= high:
                return None
            continue
        first, second = sorted(((low - start[j]) / travel, (high - start[j]) / travel))
        enters, leaves = max(enters, float(first)), min(leaves, float(second))
    return enters if 0.0 < enters <= leaves else None


def _seconds(move: JointMove, limits: LimitSettings, start: FloatArray) -> float:
    """Time of the slowest joint at its speed and its braking [s]."""
    distance = np.abs(move.target - start)
    speed = limits.velocity_max * (move.speed_scale * limits.speed_scale)
    brake = BRAKE_SHARE * limits.acceleration_max
    return float(np.where(distance > 0.0, distance / speed + speed / brake, 0.0).max())


def _nearest_limit(move: JointMove, context: StepContext) -> Approach:
    limits = context.settings.limits
    low, high = limits.position_min + limits.position_margin, limits.position_max - limits.position_margin
    clearances = np.minimum(move.target - low, high - move.target)
    start_clearances = np.minimum(context.q - low, high - context.q)
    at_end = bool(clearances.min() <= start_clearances.min())
    clearances = clearances if at_end else start_clearances
    joint = int(clearances.argmin())
    value = float((move.target if at_end else context.q)[joint])
    upper = high[joint] - value < value - low[joint]
    return Approach(
        "JOINT_LIMIT",
        context.settings.joint_names[joint],
        value,
        float((high if upper else low)[joint]),
        float(clearances[joint]),
        "rad or m",
        1.0 if at_end else 0.0,
    )


# -- every step -----------------------------------------------------------------------------------------------


def approach_velocity(q: FloatArray, target: FloatArray, settings: CoreSettings, speed_scale: float) -> FloatArray:
    """Joint velocity (n,) on the straight joint-space line to ``target``, slow enough to brake on it.

    A joint with a coarse encoder does not move once it has arrived: it would hunt between two counts.
    """
    distance = target - q
    if any(settings.resolution):
        arrival = settings.arrival
        held = (arrival > FINEST_ARRIVAL) & (np.abs(distance) < arrival)
        distance = np.where(held, 0.0, distance)
    length = np.maximum(np.abs(distance), 1e-12)
    limits = settings.limits
    speed = np.minimum(
        limits.velocity_max * (speed_scale * limits.speed_scale),
        np.sqrt(2.0 * BRAKE_SHARE * limits.acceleration_max * length),
    )
    return distance * min(float((speed / length).min()), APPROACH_GAIN)


def joints_ahead(context: StepContext) -> FloatArray:
    """Joint positions (n,) after late drives have executed what was sent to them, less the travel lost to friction."""
    block = context.state.block
    delays = block.delays
    if not delays.delay_s.any():
        return context.q
    lost = np.abs(block.friction) * delays.delay_s if context.state.friction_of else 0.0
    return context.q + delays.in_transit - np.clip(delays.in_transit, -lost, lost)


def arrived(q: FloatArray, target: FloatArray, settings: CoreSettings) -> bool:
    """Whether every joint is within its arrival tolerance of its target."""
    return bool((np.abs(target - q) < settings.arrival).all())


def farthest(q: FloatArray, target: FloatArray, settings: CoreSettings) -> int:
    """The joint that is the most arrival tolerances away from its target."""
    return int((np.abs(target - q) / settings.arrival).argmax())


def joint_move_step(move: JointMove, context: StepContext) -> SourceOutput:
    """One step of a joint move; it ends when the arm has arrived and rests, or at its time limit."""
    ahead = joints_ahead(context)
    still = arrived(context.q, move.target, context.settings) and arrived(ahead, move.target, context.settings)
    move.settled = move.settled + 1 if still else 0
    worst = farthest(context.q, move.target, context.settings)
    if move.settled >= ARRIVED_STEPS:
        context.emit("goal_reached", id=move.id, message="joints at target")
        return SourceOutput(np.zeros_like(context.q), finished=True, reached=True)
    elapsed_s = (context.now_ns - move.started_ns) * 1e-9
    if elapsed_s > move.time_limit_s:
        name = context.settings.joint_names[worst]
        reason = Reason(
            "TIME_LIMIT",
            "hold",
            name,
            elapsed_s,
            move.time_limit_s,
            "s",
            f"joint {name} is {abs(move.target[worst] - context.q[worst]):.4f} from its target "
            f"({context.settings.arrival_origin(worst)}): is it blocked, or at a limit?",
        )
        context.emit("goal_aborted", id=move.id, message="joint move not finished in time", reasons=(reason,))
        return SourceOutput(np.zeros_like(context.q), finished=True)
    return SourceOutput(
        approach_velocity(ahead, move.target, context.settings, move.speed_scale),
        speed_scale=move.speed_scale,
    )


def joint_move_progress(source: JointMove, context: StepContext) -> tuple[float, float]:
    """Completed fraction [0, 1] of the joint distance, and the remaining seconds."""
    limits = context.settings.limits
    whole, left = np.abs(source.target - source.start), np.abs(source.target - context.q)
    speed = limits.velocity_max * (source.speed_scale * limits.speed_scale)
    seconds = np.where(left > 0.0, left / speed + 0.5 * speed / (BRAKE_SHARE * limits.acceleration_max), 0.0)
    longest = float(whole.max())
    done = 1.0 if longest == 0.0 else 1.0 - min(1.0, float(left.max()) / longest)
    return done, float(seconds.max())
