"""Goals in joint space: a straight line there, checked against limits and keep-outs before anything moves."""

from __future__ import annotations

import numpy as np

from stereoservo.kinematics.kernels import project_points, transform_points
from stereoservo.kinematics.lens_kernel import distort_pixel
from stereoservo.runtime.commands import Approach, Goal, JointTarget, PlanReport
from stereoservo.runtime.estimate import ModelArrays, chain_at
from stereoservo.runtime.incidences import joint_index
from stereoservo.runtime.motion import BRAKE_SHARE, Present
from stereoservo.runtime.ports import FloatArray
from stereoservo.runtime.refusal import RefusalError
from stereoservo.runtime.settings import LimitSettings
from stereoservo.runtime.state import JointMove

REPORTED = 17
"""Samples of a way that a report holds."""


def joint_goal(goal: Goal, target: JointTarget, present: Present) -> JointMove:
    """The move to ``target``. Raises RefusalError for joints that are not there and positions beyond limits."""
    wanted = present.q.copy()
    for name, position in target.positions.items():
        wanted[joint_index(name, present)] = position
    _inside_limits(wanted, present)
    move = joint_move_to(goal.id, wanted, goal.speed_scale, present, goal.time_limit_s, goal.lease_s)
    move.acknowledge_s = goal.acknowledge_s
    return move


def joint_move_to(
    goal_id: str,
    target: FloatArray,
    speed_scale: float,
    present: Present,
    time_limit_s: float | None = None,
    lease_s: float | None = None,
) -> JointMove:
    """A move of all joints to ``target`` (n,), as it begins."""
    move = JointMove(
        id=goal_id,
        target=np.array(target),
        start=present.q.copy(),
        speed_scale=speed_scale,
        started_ns=present.now_ns,
        time_limit_s=present.settings.time_limit_s if time_limit_s is None else time_limit_s,
        lease_s=lease_s,
        lease_until_ns=0,
    )
    move.renew_lease(present.now_ns)
    return move


def _inside_limits(target: FloatArray, present: Present) -> None:
    limits = present.settings.limits
    for i, name in enumerate(present.settings.joint_names):
        low, high = (
            limits.position_min[i] + limits.position_margin,
            limits.position_max[i] - limits.position_margin,
        )
        if not low <= target[i] <= high and target[i] != present.q[i]:
            raise RefusalError(
                "JOINT_LIMIT",
                f"joint {name}: {target[i]:.4f} is outside {low:.4f} … {high:.4f} (limits less the margin)",
                subject=name, value=float(target[i]), threshold=float(high if target[i] > high else low),
                unit="rad or m",
            )  # fmt: skip


def joint_report(move: JointMove, present: Present) -> PlanReport:
    """What the move would do. Raises RefusalError where its line meets a keep-out."""
    settings, limits = present.settings, present.settings.limits
    start = present.q
    for name, box in zip(limits.keep_out_names, limits.keep_outs, strict=True):
        share = first_inside(box, limits.position_margin, start, move.target)
        if share is not None:
            raise RefusalError(
                "KEEP_OUT",
                f"the straight way in joint space meets keep-out {name!r} at {100.0 * share:.0f} % of it: go by a goal "
                "beside it",
                subject=name, value=share, threshold=1.0, unit="of the way",
            )  # fmt: skip
    shares = tuple(k / (REPORTED - 1.0) for k in range(REPORTED))
    joints = np.array([start + share * (move.target - start) for share in shares])
    return PlanReport(
        law="joints",
        way="straight in joint space",
        seconds=_seconds(move, limits, start),
        approaches=(_nearest_limit(move, present),),
        shares=shares,
        joints={name: tuple(float(x) for x in joints[:, j]) for j, name in enumerate(settings.joint_names)},
        pixels={} if present.arrays is None else way_pixels(joints, present.arrays, present),
    )


def way_pixels(
    joints: FloatArray, arrays: ModelArrays, present: Present
) -> dict[str, dict[int, tuple[tuple[float, float], ...]]]:
    """Raw pixels of every marker at ``joints`` (k, n), by camera and marker; markers outside the image are left out."""
    found: dict[str, dict[int, tuple[tuple[float, float], ...]]] = {}
    pixels = np.array(
        [
            project_points(arrays.matrices, transform_points(chain_at(arrays, q)[0], arrays.marker_points))[0]
            for q in joints
        ]
    )
    for c, camera in enumerate(present.settings.cameras):
        markers = {}
        for i, marker in enumerate(arrays.marker_ids):
            way = tuple(distort_pixel(arrays.lenses[c], float(u), float(v)) for u, v in pixels[:, c, i])
            if bool(np.isfinite(np.array(way)).all()):
                markers[marker] = way
        found[camera.name] = markers
    return found


def first_inside(box: FloatArray, margin: float, start: FloatArray, target: FloatArray) -> float | None:
    """Share of the line from ``start`` to ``target`` (n,) at which it enters ``box`` (n, 2), or None.

    An arm that stands inside already may leave: the safety stage lets it move outwards only.
    """
    enters, leaves = 0.0, 1.0
    for j in range(start.size):
        low, high = box[j, 0] - margin, box[j, 1] + margin
        way = float(target[j] - start[j])
        if way == 0.0:
            if not low <= start[j] <= high:
                return None
            continue
        first, second = sorted(((low - start[j]) / way, (high - start[j]) / way))
        enters, leaves = max(enters, float(first)), min(leaves, float(second))
    return enters if 0.0 < enters <= leaves else None


def _seconds(move: JointMove, limits: LimitSettings, start: FloatArray) -> float:
    """Time of the slowest joint at its speed and its braking."""
    distance = np.abs(move.target - start)
    speed = limits.velocity_max * (move.speed_scale * limits.speed_scale)
    brake = BRAKE_SHARE * limits.acceleration_max
    return float(np.where(distance > 0.0, distance / speed + speed / brake, 0.0).max())


def _nearest_limit(move: JointMove, present: Present) -> Approach:
    limits = present.settings.limits
    low, high = limits.position_min + limits.position_margin, limits.position_max - limits.position_margin
    rooms = np.minimum(move.target - low, high - move.target)
    start_rooms = np.minimum(present.q - low, high - present.q)
    at_end = bool(rooms.min() <= start_rooms.min())
    rooms = rooms if at_end else start_rooms
    joint = int(rooms.argmin())
    value = float((move.target if at_end else present.q)[joint])
    upper = high[joint] - value < value - low[joint]
    return Approach(
        "JOINT_LIMIT", present.settings.joint_names[joint], value, float((high if upper else low)[joint]),
        float(rooms[joint]), "rad or m", 1.0 if at_end else 0.0,
    )  # fmt: skip
