"""Static checks of goals and commands, before the core sees them: everything that can be known without the
arm's state.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from stereoservo.runtime.commands import LAWS, Command, FeatureTarget, Goal, Jog, JointTarget, TaughtTarget
from stereoservo.runtime.settings import CoreSettings

MIN_MARKERS = 3


@dataclass(frozen=True)
class GoalContext:
    """What a goal is checked against. ``model_markers``: markers of the model in use, None where there is
    none.
    """

    settings: CoreSettings
    taught: tuple[str, ...]
    model_markers: tuple[int, ...] | None


def check_goal(goal: Goal, context: GoalContext) -> list[str]:
    """What is wrong with ``goal``: each problem names the value and what would have been valid; empty when
    nothing is.
    """
    target = goal.target
    if isinstance(target, JointTarget):
        return _check_joints(goal, target, context)
    if isinstance(target, TaughtTarget):
        if target.name not in context.taught:
            return [f"target.name: no taught goal {target.name!r}; taught: {_list(context.taught)}"]
        return []
    return _check_features(target, context)


def _check_features(target: FeatureTarget, context: GoalContext) -> list[str]:
    cameras = {camera.name: camera for camera in context.settings.cameras}
    problems = []
    if not target.set_points:
        problems.append(
            f"target.set_points: is empty; set-points for some of the cameras {_list(cameras)} are needed"
        )
    markers: set[int] = set()
    for name, points in target.set_points.items():
        where = f"target.set_points.{name}"
        camera = cameras.get(name)
        if camera is None:
            problems.append(f"{where}: no camera {name!r}; cameras: {_list(cameras)}")
            continue
        if not points:
            problems.append(f"{where}: has no marker; markers: {_list(camera.marker_ids)}")
        for marker, (u, v) in points.items():
            if marker not in camera.marker_ids:
                problems.append(
                    f"{where}.{marker}: the detector of camera {name!r} knows no marker {marker}; it "
                    f"knows: {_list(camera.marker_ids)}"
                )
            elif context.model_markers is not None and marker not in context.model_markers:
                problems.append(
                    f"{where}.{marker}: the model has no marker {marker}; it has: "
                    f"{_list(context.model_markers)}"
                )
            if not (-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
                problems.append(
                    f"{where}.{marker}: pixel ({u:g}, {v:g}) is outside the image; u from -0.5 to "
                    f"{camera.width - 0.5:g}, "
                    f"v from -0.5 to {camera.height - 0.5:g} are valid"
                )
            markers.add(marker)
    if not problems and len(markers) < MIN_MARKERS:
        problems.append(
            f"target.set_points: {len(markers)} marker(s) ({_list(sorted(markers))}); at least "
            f"{MIN_MARKERS} fix a pose"
        )
    return problems


def _check_joints(goal: Goal, target: JointTarget, context: GoalContext) -> list[str]:
    problems = []
    if goal.law is not None:
        problems.append(
            f"law: {goal.law!r} works on set-points in images; a target of joints takes none of {_list(LAWS)}"
        )
    for key, value in (("points", goal.points), ("gain", goal.gain), ("tolerance_px", goal.tolerance_px)):
        if value is not None:
            problems.append(f"{key}: {value!r} belongs to an image law; leave it out of a target of joints")
    if not target.positions:
        problems.append(f"target.positions: is empty; joints: {_list(context.settings.joint_names)}")
    limits = context.settings.limits
    for name, position in target.positions.items():
        where = f"target.positions.{name}"
        if name not in context.settings.joint_names:
            problems.append(f"{where}: no joint {name!r}; joints: {_list(context.settings.joint_names)}")
            continue
        i = context.settings.joint_names.index(name)
        low = float(limits.position_min[i]) + limits.position_margin
        high = float(limits.position_max[i]) - limits.position_margin
        if not low <= position <= high:
            problems.append(
                f"{where}: {position:g} is outside the joint's limits; {low:.4g} to {high:.4g} is valid"
            )
    return problems


def check_command(command: Command, settings: CoreSettings) -> list[str]:
    """What is wrong with a command, like :func:`check_goal`."""
    if not isinstance(command, Jog):
        return []
    problems = []
    if not command.velocities:
        problems.append(f"velocities: is empty; joints: {_list(settings.joint_names)}")
    for name, velocity in command.velocities.items():
        if name not in settings.joint_names:
            problems.append(f"velocities.{name}: no joint {name!r}; joints: {_list(settings.joint_names)}")
            continue
        limit = float(settings.limits.velocity_max[settings.joint_names.index(name)])
        if abs(velocity) > limit:
            problems.append(
                f"velocities.{name}: {velocity:g} is above the joint's limit; {-limit:g} to {limit:g} "
                f"is valid"
            )
    return problems


def _list(names: Iterable[object]) -> str:
    return ", ".join(str(name) for name in names) or "none"
