"""Validation of clients' goals and commands as far as it does not depend on the state of the arm: names, markers, joint
limits, points, displacements, options; returns all problems of a message.

Each problem names the field, its value and the valid values; all of them are reported at once.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from stereoservo.control.law_registry import LAWS, OPTIONS, UnknownLawError
from stereoservo.core.settings import FEWEST_MARKERS, MIN_MARKERS, CameraSettings, CoreSettings
from stereoservo.messages.goals import (
    AdaptiveGain,
    AuxiliarySpec,
    Command,
    DisplacementTarget,
    Feature,
    FeatureTarget,
    Goal,
    IncidenceTarget,
    Jog,
    JointTarget,
    OrderAuxiliary,
    PointTarget,
    StepTarget,
    Target,
    TaughtTarget,
    Teach,
    UpdateGoal,
)
from stereoservo.messages.known_length import known_length_of

LAW_FIELDS = (
    "law", "points", "jacobian", "centre", "cameras", "profile", "gain", "damping", "tolerance_px", "blend_px",
)  # fmt: skip
INCIDENCE_FIELDS = ("law", "points", "jacobian", "centre", "profile")


def check_goal(goal: Goal, context: GoalContext) -> list[str]:
    """The problems of ``goal``; empty for a valid one."""
    return [*_check_target(goal.target, context), *_check_options(goal, context)]


def _check_target(target: Target, context: GoalContext) -> list[str]:
    if isinstance(target, FeatureTarget):
        return check_features(target, context)
    if isinstance(target, PointTarget):
        return check_points(target, context)
    if isinstance(target, DisplacementTarget):
        return check_displacement(target, context)
    if isinstance(target, StepTarget):
        return check_step(target, context)
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
            f"{field}: {_as_json(getattr(goal, field))} belongs to a target that fixes a pose; leave it out of an "
            "incidence, which is a law of its own"
            for field in INCIDENCE_FIELDS
            if getattr(goal, field) is not None
        ]
    else:
        problems += _check_law(goal, settings)
    problems += _check_cameras(goal, settings)
    problems += _check_centre(goal, context)
    problems += _check_following(goal, settings)
    if isinstance(goal.gain, AdaptiveGain) and not goal.gain.near > goal.gain.far:
        problems.append(
            f"gain: near {goal.gain.near:g} is not above far {goal.gain.far:g}; an adaptive gain falls with the error "
            "(one number is a gain that does not)"
        )
    return problems + _check_handover(goal, settings)


def _check_following(goal: Goal, settings: CoreSettings) -> list[str]:
    ids, problems = goal.follow_markers, []
    if goal.follow_seen and not ids:
        problems.append("follow_seen: says where markers of a target are; name them in follow_markers, too")
    if not ids:
        return problems
    if isinstance(goal.target, TaughtTarget) and goal.target.relative_to is not None:
        problems.append(
            f"follow_markers: carry the goal over by themselves; leave out relative_to {goal.target.relative_to!r}"
        )
    problems += [f"follow_markers: {marker} stands twice" for marker in sorted({i for i in ids if ids.count(i) > 1})]
    names = [camera.name for camera in settings.cameras]
    for name, seen in goal.follow_seen.items():
        if name not in names:
            problems.append(f"follow_seen: no camera {name!r}; cameras: {listed(names)}")
        others = [marker for marker in seen if marker not in ids]
        if others:
            problems.append(f"follow_seen.{name}: {listed(others)} not in follow_markers {listed(ids)}")
    return problems


def _not_with_joints(goal: Goal) -> list[str]:
    problems = []
    if goal.follow_markers or goal.follow_seen:
        problems.append("follow_markers: a target of joints follows nothing that is seen; leave it out")
    for field in LAW_FIELDS:
        value = getattr(goal, field)
        if value is not None:
            problems.append(
                f"law: {value!r} works on set-points in images; a target of joints takes none of {listed(LAWS)}"
                if field == "law"
                else f"{field}: {_as_json(value)} belongs to an image law; leave it out of a target of joints"
            )
    return problems


def _check_law(goal: Goal, settings: CoreSettings) -> list[str]:
    name = goal.law or settings.law
    try:
        law = LAWS[name]
    except UnknownLawError as error:
        return [f"law: {error}"]
    problems = []
    for option in OPTIONS:
        value = getattr(goal, option)
        if value is not None and option not in law.options:
            given = f"{value!r} " if isinstance(value, str) else ""
            problems.append(f"{option}: {given}belongs to {_laws_named(LAWS.having(option))}; the goal's is {name!r}")
    if goal.cameras is not None and len(goal.cameras) == 1 and law.one_camera == "refused":
        single = [repr(other) for other, its in LAWS.items() if its.one_camera == "suffices"]
        problems.append(
            f"cameras: {listed(goal.cameras)} alone; law {name!r} takes two or more, {listed(single)} works with one"
        )
    return problems


def _laws_named(names: Sequence[str]) -> str:
    return f"law {names[0]!r}" if len(names) == 1 else f"laws {listed(names)}"


def _check_cameras(goal: Goal, settings: CoreSettings) -> list[str]:
    if goal.cameras is None:
        return []
    names = [camera.name for camera in settings.cameras]
    problems = [f"cameras: no camera {name!r}; cameras: {listed(names)}" for name in goal.cameras if name not in names]
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
    if centre.point is not None:
        problems += check_homogeneous("centre.point", centre.point)
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
    """The problems of a command; empty for a valid one."""
    if isinstance(command, Jog):
        return _check_jog(command, context.settings)
    if isinstance(command, OrderAuxiliary):
        return _check_auxiliary(command, context.auxiliary)
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
                f"velocities.{name}: {velocity:g} is above the joint's limit; {-limit:g} to {limit:g} is valid"
            )
    return problems


def _check_auxiliary(command: OrderAuxiliary, known: tuple[AuxiliarySpec, ...]) -> list[str]:
    names = listed(spec.name for spec in known) if known else "none: this cell's joint driver has none"
    problems = [] if command.values else [f"values: is empty; auxiliary joints and outputs: {names}"]
    specs = {spec.name: spec for spec in known}
    for name, value in command.values.items():
        spec = specs.get(name)
        if spec is None:
            problems.append(f"values.{name}: no auxiliary joint or output {name!r}; there are: {names}")
        elif spec.kind == "digital" and value not in (0.0, 1.0):
            problems.append(f"values.{name}: {value:g} for a digital output; 0 and 1 are valid")
        elif not spec.low <= value <= spec.high:
            unit = "rad" if spec.kind == "revolute" else "m"
            problems.append(f"values.{name}: {value:g}; {spec.low:g} to {spec.high:g} {unit} is valid")
    return problems


def _as_json(value: object) -> str:
    """A value in the form in which a client wrote it."""
    return msgspec.json.encode(value).decode() if isinstance(value, msgspec.Struct) else repr(value)


__all__ = ["GoalContext", "check_command", "check_goal"]


POINTS_OF = {"point": 1, "line": 2, "plane": 3}
SINGULAR = 1e-12
"""Least singular value of a displacement relative to its largest."""
ORTHONORMAL = 1e-6
"""Largest deviation of a rigid matrix, as it is written down, from one."""
MAX_STEP = 100.0
"""Largest number of a step [m or rad]."""
STRAIGHT = 1e-9
"""Largest third singular value of points on one line, as unit vectors."""


MAX_SIZE = 1e100
"""Limit of the largest component of homogeneous quantities; its inverse is the smallest."""


@dataclass(frozen=True)
class GoalContext:
    """Context of the checks: settings, names of taught goals, known markers.

    ``model_markers``: markers of the model in use, None if there is none.
    """

    settings: CoreSettings
    taught: tuple[str, ...]
    model_markers: tuple[int, ...] | None
    auxiliary: tuple[AuxiliarySpec, ...] = ()


def listed(names: Iterable[object]) -> str:
    """Names as text."""
    return ", ".join(str(name) for name in names) or "none"


def check_features(target: FeatureTarget, context: GoalContext, where: str = "target") -> list[str]:
    """Problems of set-points: unknown cameras or markers, pixels outside of images, too few markers."""
    cameras = {camera.name: camera for camera in context.settings.cameras}
    problems = []
    if not target.set_points:
        problems.append(
            f"{where}.set_points: is empty; set-points for some of the cameras {listed(cameras)} are needed"
        )
    markers: set[int] = set()
    for name, points in target.set_points.items():
        place = f"{where}.set_points.{name}"
        camera = cameras.get(name)
        if camera is None:
            problems.append(f"{place}: no camera {name!r}; cameras: {listed(cameras)}")
            continue
        if not points:
            problems.append(f"{place}: has no marker; markers: {listed(camera.marker_ids)}")
        for marker, pixel in points.items():
            problems += _marker_of_camera(f"{place}.{marker}", marker, camera, context)
            problems += _inside(f"{place}.{marker}", pixel, camera)
            markers.add(marker)
    needed = FEWEST_MARKERS[len(context.settings.joint_names)]
    if not problems and len(markers) < needed:
        problems.append(
            f"{where}.set_points: {len(markers)} marker(s) ({listed(sorted(markers))}); at least {needed} fix a pose"
        )
    return problems


def _marker_of_camera(where: str, marker: int, camera: CameraSettings, context: GoalContext) -> list[str]:
    if marker not in camera.marker_ids:
        return [
            f"{where}: the detector of camera {camera.name!r} knows no marker {marker}; it "
            f"knows: {listed(camera.marker_ids)}"
        ]
    return _marker_of_model(where, marker, context)


def _marker_of_model(where: str, marker: int, context: GoalContext) -> list[str]:
    if context.model_markers is not None and marker not in context.model_markers:
        return [f"{where}: the model has no marker {marker}; it has: {listed(context.model_markers)}"]
    return []


def _inside(where: str, pixel: tuple[float, float], camera: CameraSettings) -> list[str]:
    u, v = pixel
    if -0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5:
        return []
    return [
        f"{where}: pixel ({u:g}, {v:g}) is outside the image; u from -0.5 to {camera.width - 0.5:g}, "
        f"v from -0.5 to {camera.height - 0.5:g} are valid"
    ]


def check_markers(where: str, markers: Sequence[int], context: GoalContext, *, body: bool) -> list[str]:
    """Problems of marker ids: repeated, unknown to all detectors, not in the model (``body``) or in it (otherwise)."""
    problems = []
    known = context.settings.marker_ids
    for marker in dict.fromkeys(markers):
        place = f"{where}: {marker}"
        if markers.count(marker) > 1:
            problems.append(f"{place} stands {markers.count(marker)} times; ids that differ are valid")
        if marker not in known:
            problems.append(f"{place}: no detector of the cell knows it; they know: {listed(known)}")
        elif context.model_markers is not None and (marker in context.model_markers) != body:
            others = [m for m in known if m not in context.model_markers]
            problems.append(
                f"{place}: the model has no such marker; it has: {listed(context.model_markers)}"
                if body
                else f"{place} is of the marker body itself; markers beside it: {listed(others)}"
            )
    return problems


def check_homogeneous(where: str, point: Sequence[float]) -> list[str]:
    """Problems of a homogeneous point: zero, or components too large to be squared."""
    if not any(point):
        return [f"{where}: (0, 0, 0, 0) is no point; one coordinate at least differs from 0"]
    return _check_size(where, point)


def _check_size(where: str, numbers: Sequence[float]) -> list[str]:
    """Problems of numbers of which only the ratios count: the norm would overflow, or be zero."""
    largest = max(abs(number) for number in numbers)
    if 1.0 / MAX_SIZE <= largest <= MAX_SIZE:
        return []
    return [f"{where}: its largest number is {largest:g}; {1.0 / MAX_SIZE:g} to {MAX_SIZE:g} is valid, scale it"]


def check_points(target: PointTarget, context: GoalContext) -> list[str]:
    """Problems of markers' projective points: unknown ids, zero vectors, fewer than three, or collinear."""
    problems = check_markers("target.points", list(target.points), context, body=True)
    for marker, point in target.points.items():
        problems += check_homogeneous(f"target.points.{marker}", point)
    if problems:
        return problems
    ids = listed(sorted(target.points))
    needed = FEWEST_MARKERS[len(context.settings.joint_names)]
    if len(target.points) < needed:
        return [f"target.points: {len(target.points)} marker(s) ({ids}); at least {needed} fix a pose"]
    if len(target.points) < MIN_MARKERS:
        return []
    M = np.array(list(target.points.values()))
    singular = np.linalg.svd(M / np.linalg.norm(M, axis=1, keepdims=True), compute_uv=False)
    if not singular[2] > STRAIGHT * singular[0]:
        problems.append(f"target.points: markers {ids} lie on one line; three that do not are needed")
    return problems


def check_displacement(target: DisplacementTarget, context: GoalContext) -> list[str]:
    """Problems of a displacement: not in exactly one frame, not five different markers, or no valid matrix."""
    problems = []
    if (target.model_epoch is None) == (target.basis is None):
        given = "neither" if target.basis is None else "both"
        problems.append(
            f"target: {given} of model_epoch and basis given; exactly one says in which frame the matrix is (a rigid "
            "matrix in metres is a target of kind 'step', with the name of its frame)"
        )
    if target.frame is not None:
        problems.append("target.frame: is set by the daemon; send a target of kind 'step' with the name of its frame")
    if target.basis is not None:
        problems += check_markers("target.basis", list(target.basis), context, body=True)
    matrix = np.array(target.matrix).reshape(4, 4)
    if any(target.matrix) and (wrong := _check_size("target.matrix", target.matrix)):
        return problems + wrong
    singular = np.linalg.svd(matrix, compute_uv=False)
    if not singular[3] > SINGULAR * singular[0]:
        problems.append(
            f"target.matrix: is singular (singular values {listed(f'{x:.3g}' for x in singular)}); it must not be"
        )
    elif np.linalg.det(matrix / singular[0]) < 0:
        problems.append(
            "target.matrix: its determinant is negative, which makes a mirror image; a displacement's is positive"
        )
    return problems


def check_step(target: StepTarget, context: GoalContext) -> list[str]:
    """Problems of a step: an unknown frame, no motion, a turn beyond 180°, or a matrix that is not rigid."""
    cameras = [f"camera:{camera.name}" for camera in context.settings.cameras]
    problems, ids = [], re.fullmatch(r"scene:(\d{1,9})-(\d{1,9})-(\d{1,9})", target.frame)
    if target.frame not in ("tool", "base", *cameras) and ids is None:
        problems.append(
            f"target.frame: no frame {target.frame!r}; valid: tool, base, {listed(cameras)}, and scene:A-B-C by three "
            "markers that do not move with the arm"
        )
    if ids is not None:
        problems += check_markers("target.frame", [int(marker) for marker in ids.groups()], context, body=False)
    if target.length:
        try:
            known_length_of(target.length)
        except ValueError as error:
            problems.append(f"target.length: {error}")
    moves = any(target.move) or any(target.turn)
    if moves == (target.matrix is not None):
        problems.append("target: exactly one of matrix, and of move or turn that are not zero, is valid")
    for key, values in {"move": target.move, "turn": target.turn, "matrix": target.matrix or ()}.items():
        if max(map(abs, values), default=0.0) > MAX_STEP:
            problems.append(
                f"target.{key}: its largest number is {max(map(abs, values)):g}; up to {MAX_STEP:g} is valid"
            )
    angle = math.hypot(*target.turn)
    if angle > math.pi * (1.0 + ORTHONORMAL):
        problems.append(
            f"target.turn: {math.degrees(angle):.6g}°; up to 180° is valid, make several steps of a larger one"
        )
    if target.matrix is not None:
        H = np.array(target.matrix).reshape(4, 4)
        off = max(float(np.abs(H[:3, :3].T @ H[:3, :3] - np.eye(3)).max()), float(np.abs(H[3] - (0, 0, 0, 1)).max()))
        if not off <= ORTHONORMAL or np.linalg.det(H[:3, :3]) < 0.0:
            problems.append(
                f"target.matrix: is not rigid, by {off:.3g}; a rotation (3 x 3, determinant 1), a translation [m] and "
                "the last row 0 0 0 1 are needed"
            )
    return problems


def check_taught(target: TaughtTarget, context: GoalContext) -> list[str]:
    """Problems of a taught goal's name, and of common markers."""
    problems = []
    if target.name not in context.taught:
        problems.append(f"target.name: no taught goal {target.name!r}; taught: {listed(context.taught)}")
    features = {"lines": target.lines, "planes": target.planes}
    for key, given in {"common": target.common, **features}.items():
        if given and target.relative_to is None:
            problems.append(
                f"target.{key}: {listed(given)} belongs to relative_to; 'workpiece' and 'cameras' are valid there"
            )
    for key, given in features.items():
        for k, ids in enumerate(given):
            problems += check_markers(f"target.{key}[{k}]", ids, context, body=False)
    if not target.common:
        return problems
    if len(set(target.common)) < MIN_MARKERS and not (target.lines or target.planes):
        problems.append(
            f"target.common: {len(set(target.common))} marker(s) ({listed(target.common)}); 5 are needed, with a "
            f"metric model {MIN_MARKERS}"
        )
    return problems + check_markers("target.common", target.common, context, body=False)


def check_joint_target(target: JointTarget, settings: CoreSettings, where: str = "target") -> list[str]:
    """Problems of a joint target: unknown joints, positions outside of their limits."""
    problems = []
    if not target.positions:
        problems.append(f"{where}.positions: is empty; joints: {listed(settings.joint_names)}")
    limits = settings.limits
    for name, position in target.positions.items():
        place = f"{where}.positions.{name}"
        if name not in settings.joint_names:
            problems.append(f"{place}: no joint {name!r}; joints: {listed(settings.joint_names)}")
            continue
        i = settings.joint_names.index(name)
        low = float(limits.position_min[i]) + limits.position_margin
        high = float(limits.position_max[i]) - limits.position_margin
        if not low <= position <= high:
            problems.append(f"{place}: {position:g} is outside the joint's limits; {low:.4g} to {high:.4g} is valid")
    return problems


def check_incidence(target: IncidenceTarget, context: GoalContext) -> list[str]:
    """Problems of incidences: a feature not specified in exactly one way, or with the wrong number of points."""
    problems = []
    for k, incidence in enumerate(target.incidences):
        moving, _, fixed = incidence.kind.partition("-on-")
        for name, feature, kind in (("moving", incidence.moving, moving), ("fixed", incidence.fixed, fixed)):
            where = f"target.incidences[{k}].{name}"
            problems += _check_feature(where, feature, kind, target.model_epoch is not None, context)
    if isinstance(target.secondary, JointTarget):
        problems += check_joint_target(target.secondary, context.settings, "target.secondary")
    elif isinstance(target.secondary, FeatureTarget):
        problems += check_features(target.secondary, context, "target.secondary")
    return problems


def _check_feature(where: str, feature: Feature, kind: str, has_epoch: bool, context: GoalContext) -> list[str]:
    given = [form for form in ("markers", "points", "pixels", "segments") if getattr(feature, form)]
    if where.endswith("moving") and given != ["markers"]:
        return [f"{where}: given by {listed(given)}; what moves is given by markers of the body"]
    if len(given) != 1:
        return [f"{where}: given by {listed(given)}; exactly one of markers, points, pixels, segments is valid"]
    need = POINTS_OF[kind]
    if feature.segments:
        if kind != "line":
            return [f"{where}.segments: are images of a line; a {kind} is given by points, pixels or markers"]
        return _check_pixels(f"{where}.segments", feature.segments, kind, context)
    if feature.pixels:
        return _check_pixels(f"{where}.pixels", feature.pixels, kind, context)
    count = len(feature.markers or feature.points)
    problems = []
    if count != need:
        problems.append(f"{where}.{given[0]}: {count} given; a {kind} is spanned by {need}")
    if feature.markers:
        # A fixed feature's markers are on the workpiece; the gateway replaces them by their pixels.
        problems += check_markers(f"{where}.markers", feature.markers, context, body=where.endswith("moving"))
        return problems
    if not has_epoch:
        problems.append(f"{where}.points: are in the frame of a model; target.model_epoch is needed with them")
    for i, point in enumerate(feature.points):
        problems += check_homogeneous(f"{where}.points[{i}]", point)
    M = np.array(feature.points)
    if not problems and len(M) == need > 1:
        singular = np.linalg.svd(M / np.linalg.norm(M, axis=1, keepdims=True), compute_uv=False)
        if not singular[-1] > STRAIGHT * singular[0]:
            problems.append(f"{where}.points: do not span a {kind}; {need} points in general position do")
    return problems


def _check_pixels(
    where: str, pixels: Mapping[str, Sequence[tuple[float, float]]], kind: str, context: GoalContext
) -> list[str]:
    cameras = {camera.name: camera for camera in context.settings.cameras}
    problems = []
    if len(pixels) < 2:
        problems.append(f"{where}: of {len(pixels)} camera(s) ({listed(pixels)}); two or more fix a point")
    for name, seen in pixels.items():
        if name not in cameras:
            problems.append(f"{where}.{name}: no camera {name!r}; cameras: {listed(cameras)}")
            continue
        if len(seen) != POINTS_OF[kind]:
            problems.append(f"{where}.{name}: {len(seen)} given; a {kind} is spanned by {POINTS_OF[kind]}")
        for i, pixel in enumerate(seen):
            problems += _inside(f"{where}.{name}[{i}]", pixel, cameras[name])
    return problems
