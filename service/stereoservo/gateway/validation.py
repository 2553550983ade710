"""Static checks of goals and commands, before the core sees them: everything that can be known without the arm's state.

Each problem names the field, its value and what would have been valid; all of them are told at once.
"""

from __future__ import annotations

import msgspec

from stereoservo.gateway.validation_targets import (
    MIN_MARKERS,
    GoalContext,
    check_displacement,
    check_features,
    check_incidence,
    check_joint_target,
    check_markers,
    check_points,
    check_taught,
    listed,
)
from stereoservo.runtime.commands import (
    LAWS,
    AdaptiveGain,
    Command,
    DisplacementTarget,
    FeatureTarget,
    Goal,
    IncidenceTarget,
    Jog,
    JointTarget,
    PointTarget,
    Target,
    TaughtTarget,
    Teach,
    UpdateGoal,
)
from stereoservo.runtime.settings import CoreSettings

IMAGE_LAWS = ("stereo", "image", "points")
"""Laws with a Jacobian of image or scene points, developed around a choice of them (8.1.1)."""
CENTRED_LAWS = ("cartesian3", "cartesian2", "trajectory")
"""Laws that lead one point of the body on a line."""
STEREO_LAWS = ("stereo", "points")
"""Laws that need two cameras."""
LAW_FIELDS = ("law", "points", "jacobian", "centre", "cameras", "profile", "gain", "tolerance_px", "blend_px")
INCIDENCE_FIELDS = ("law", "points", "jacobian", "centre", "profile")


def check_goal(goal: Goal, context: GoalContext) -> list[str]:
    """What is wrong with ``goal``; empty when nothing is."""
    return [*_check_target(goal.target, context), *_check_options(goal, context)]


def _check_target(target: Target, context: GoalContext) -> list[str]:
    if isinstance(target, FeatureTarget):
        return check_features(target, context)
    if isinstance(target, PointTarget):
        return check_points(target, context)
    if isinstance(target, DisplacementTarget):
        return check_displacement(target, context)
    if isinstance(target, TaughtTarget):
        return check_taught(target, context)
    if isinstance(target, JointTarget):
        return check_joint_target(target, context.settings)
    return check_incidence(target, context)


def _check_options(goal: Goal, context: GoalContext) -> list[str]:
    if isinstance(goal.target, JointTarget):
        return _not_with_joints(goal)
    settings = context.settings
    problems = []
    if isinstance(goal.target, IncidenceTarget):
        problems += [
            f"{field}: {_said(getattr(goal, field))} belongs to a target that fixes a pose; leave it out of an "
            "incidence, which is a law of its own"
            for field in INCIDENCE_FIELDS
            if getattr(goal, field) is not None
        ]
    else:
        problems += _check_law(goal, settings)
    problems += _check_cameras(goal, settings)
    problems += _check_centre(goal, context)
    if isinstance(goal.gain, AdaptiveGain) and not goal.gain.near > goal.gain.far:
        problems.append(
            f"gain: near {goal.gain.near:g} is not above far {goal.gain.far:g}; an adaptive gain falls with the error "
            "(one number is a gain that does not)"
        )
    return problems + _check_handover(goal, settings)


def _not_with_joints(goal: Goal) -> list[str]:
    problems = []
    for field in LAW_FIELDS:
        value = getattr(goal, field)
        if value is not None:
            problems.append(
                f"law: {value!r} works on set-points in images; a target of joints takes none of {listed(LAWS)}"
                if field == "law"
                else f"{field}: {_said(value)} belongs to an image law; leave it out of a target of joints"
            )
    return problems


def _check_law(goal: Goal, settings: CoreSettings) -> list[str]:
    law = goal.law or settings.law
    problems = []
    if goal.profile is not None and law != "trajectory":
        problems.append(f"profile: {goal.profile!r} belongs to law 'trajectory'; the goal's is {law!r}")
    if goal.jacobian is not None and law not in IMAGE_LAWS:
        problems.append(
            f"jacobian: {goal.jacobian!r} belongs to laws {listed(IMAGE_LAWS)}; the goal's is {law!r}"
        )
    if goal.centre is not None and law not in CENTRED_LAWS:
        problems.append(f"centre: belongs to laws {listed(CENTRED_LAWS)}; the goal's is {law!r}")
    if goal.cameras is not None and len(goal.cameras) == 1 and law in STEREO_LAWS:
        problems.append(
            f"cameras: {listed(goal.cameras)} alone; law {law!r} takes two or more, 'image' works with one"
        )
    return problems


def _check_cameras(goal: Goal, settings: CoreSettings) -> list[str]:
    if goal.cameras is None:
        return []
    names = [camera.name for camera in settings.cameras]
    problems = [
        f"cameras: no camera {name!r}; cameras: {listed(names)}" for name in goal.cameras if name not in names
    ]
    if not goal.cameras:
        problems.append(f"cameras: is empty; some of {listed(names)} are needed, or leave it out for all")
    problems += [
        f"cameras: {name!r} stands twice; names that differ are valid"
        for name in sorted({name for name in goal.cameras if goal.cameras.count(name) > 1})
    ]
    if not problems and isinstance(goal.target, FeatureTarget):
        seen = goal.target.set_points
        if not set(seen) & set(goal.cameras):
            problems.append(
                f"cameras: {listed(goal.cameras)}, but the set-points are of {listed(seen)}; one at least is in both"
            )
    return problems


def _check_centre(goal: Goal, context: GoalContext) -> list[str]:
    centre = goal.centre
    if centre is None:
        return []
    if bool(centre.markers) == (centre.point is not None):
        given = "both" if centre.markers else "neither"
        return [f"centre: {given} of markers and point given; exactly one says which point of the body it is"]
    if centre.markers:
        return check_markers("centre.markers", centre.markers, context, body=True)
    problems = []
    if centre.model_epoch is None:
        problems.append("centre.model_epoch: is needed with a point: it says in which model's frame that is")
    if centre.point is not None and not any(centre.point):
        problems.append("centre.point: (0, 0, 0, 0) is no point; one coordinate at least differs from 0")
    return problems


def _check_handover(goal: Goal, settings: CoreSettings) -> list[str]:
    if goal.blend_px is None:
        return []
    tolerance = settings.tolerance_px if goal.tolerance_px is None else goal.tolerance_px
    problems = []
    if goal.blend_px <= tolerance:
        problems.append(
            f"blend_px: {goal.blend_px:g} is not above the tolerance of {tolerance:g} px, at which the goal is reached "
            "anyhow"
        )
    if goal.acknowledge_s is not None:
        problems.append(
            f"acknowledge_s: {goal.acknowledge_s:g} makes the arm stop and wait, blend_px {goal.blend_px:g} makes it "
            "go on without stopping; one of them is valid"
        )
    return problems


def check_command(command: Command, context: GoalContext) -> list[str]:
    """What is wrong with a command, like :func:`check_goal`."""
    if isinstance(command, Jog):
        return _check_jog(command, context.settings)
    if isinstance(command, UpdateGoal):
        return _check_target(command.target, context)
    if isinstance(command, Teach) and command.tool:
        problems = []
        known = context.settings.marker_ids
        if len(set(command.tool)) < MIN_MARKERS:
            problems.append(
                f"tool: {len(set(command.tool))} marker(s) ({listed(command.tool)}); at least {MIN_MARKERS} that "
                "differ fix a pose, 5 without a metric model"
            )
        problems += [
            f"tool: {marker}: no detector of the cell knows it; they know: {listed(known)}"
            for marker in command.tool
            if marker not in known
        ]
        return problems
    return []


def _check_jog(command: Jog, settings: CoreSettings) -> list[str]:
    problems = []
    if not command.velocities:
        problems.append(f"velocities: is empty; joints: {listed(settings.joint_names)}")
    for name, velocity in command.velocities.items():
        if name not in settings.joint_names:
            problems.append(f"velocities.{name}: no joint {name!r}; joints: {listed(settings.joint_names)}")
            continue
        limit = float(settings.limits.velocity_max[settings.joint_names.index(name)])
        if abs(velocity) > limit:
            problems.append(
                f"velocities.{name}: {velocity:g} is above the joint's limit; {-limit:g} to {limit:g} "
                f"is valid"
            )
    return problems


def _said(value: object) -> str:
    """A value as a client wrote it."""
    return msgspec.json.encode(value).decode() if isinstance(value, msgspec.Struct) else repr(value)


__all__ = ["GoalContext", "check_command", "check_goal"]
