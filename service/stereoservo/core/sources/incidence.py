"""Motion source of incidence goals, which move points, lines and planes of the body onto ones of the scene (thesis
2.5.3): start, joint velocity and end of the motion, and reasons why it cannot be completed.
"""

from __future__ import annotations

from math import isfinite

import numpy as np

from stereoservo.control.incidence import (
    KINDS,
    IncidenceStatus,
    IncidenceTask,
    feature_form,
    image_task,
    incidence_freedoms,
    incidence_reasons,
    incidence_step,
    joint_task,
    no_second_task,
)
from stereoservo.control.incidence_kernel import SecondTask
from stereoservo.control.law import Scene
from stereoservo.core.context import RefusalError, SourceOutput, StepContext
from stereoservo.core.goals.marker_body import BodyState
from stereoservo.core.goals.resolve import (
    camera_index,
    ideal_pixels,
    joint_index,
    marker_index,
    of_this_model,
    raw_set_points,
    require_imaged,
)
from stereoservo.core.goals.servoing import no_plan, run_fields, used_cameras
from stereoservo.core.model_arrays import with_unit_height
from stereoservo.core.prediction import points_now, scene_of
from stereoservo.core.sources.law import damp, may_end, options, run_ended, wait_for_target
from stereoservo.core.sources.progress import error_of_run
from stereoservo.core.state import IncidenceGoal
from stereoservo.core.target.follow import require_followable
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.kernels import project_points, triangulate
from stereoservo.messages.goals import Feature, Goal, IncidenceTarget, JointTarget, PlanReport
from stereoservo.numerics.arrays import FloatArray

FEATURES = ("point", "line", "plane")
SPAN_PX = 5.0
"""Least distance in an image between markers, or from their line, for markers that span a line or a plane."""
MAKEABLE = 0.999
"""Fraction of the residual that joints can reduce, above which the arm has the degrees of freedom needed."""
SECOND_AT_REST = 5e-3
"""Joint velocity [rad/s or m/s] below which a second task has converged."""


def start_incidence(goal: Goal, target: IncidenceTarget, context: StepContext, place: BodyState) -> IncidenceGoal:
    """The state of the incidence law before its first step. Raises RefusalError naming the reason if the goal is
    unusable.
    """
    model = context.state.model
    assert model is not None
    if len(context.settings.cameras) < 2:
        raise RefusalError(
            "TOO_FEW_CAMERAS",
            "distances in space need the images of two cameras; the cell has one",
            value=1.0,
            threshold=2.0,
            unit="cameras",
        )
    of_this_model(target.model_epoch, model.epoch)
    if goal.follow_markers:
        require_followable(goal, True, "incidence", True, context)
    k, n = len(target.incidences), len(context.q)
    kinds, markers = np.zeros(k, np.int64), np.full((k, 3), -1, np.int64)
    fixed = np.zeros((k, 3, 4))
    names = []
    for i, spec in enumerate(target.incidences):
        name = f"incidence {i + 1} ({spec.kind})"
        moving, standing = (FEATURES.index(word) for word in spec.kind.split("-on-"))
        own = _moving(spec.moving, moving, name, place)
        kinds[i] = KINDS.index(spec.kind)
        markers[i, : len(own)] = own
        fixed[i] = _fixed(spec.fixed, standing, name, place, target.model_epoch)
        names.append(name)
    joints, joints_required = np.zeros(n), np.zeros(n)
    c, m = len(context.settings.cameras), len(place.points)
    set_points, required = np.zeros((c, m, 2)), np.zeros((c, m))
    if isinstance(target.secondary, JointTarget):
        for joint, position in target.secondary.positions.items():
            j = joint_index(joint, context.settings)
            joints[j], joints_required[j] = position, 1.0
    elif target.secondary is not None:
        of_this_model(target.secondary.model_epoch, model.epoch)
        set_points, required = raw_set_points(target.secondary, place)
    source = IncidenceGoal(
        **run_fields(goal, context, used_cameras(goal, np.ones((c, m)), context)),
        kinds=kinds, markers=markers, fixed=fixed, names=tuple(names), joints=joints, joints_wanted=joints_required,
        set_points=set_points, wanted=required,
    )  # fmt: skip
    _drivable(source, context, place)
    return source


def _one_form(feature: Feature, name: str, which: str) -> None:
    forms = [w for w in ("markers", "points", "pixels", "segments") if getattr(feature, w)]
    if len(forms) != 1:
        raise RefusalError(
            "FEATURE_UNCLEAR",
            f"{name}: its {which} feature is given by {' and '.join(forms) or 'nothing'}; give one of markers, points, "
            "pixels",
        )


def _moving(feature: Feature, dimension: int, name: str, place: BodyState) -> list[int]:
    """Indices of the markers that span the moving feature."""
    _one_form(feature, name, "moving")
    if not feature.markers:
        raise RefusalError("FEATURE_UNCLEAR", f"{name}: what moves is given by markers of the body")
    own = [marker_index(marker, place.arrays) for marker in feature.markers]
    if len(set(own)) != dimension + 1 or len(own) != dimension + 1:
        raise RefusalError(
            "FEATURE_UNCLEAR",
            f"{name}: a {FEATURES[dimension]} is spanned by {dimension + 1} different markers, got "
            f"{list(feature.markers)}",
            value=float(len(set(own))),
            threshold=float(dimension + 1),
            unit="markers",
        )
    pixels, _ = project_points(place.arrays.matrices, np.ascontiguousarray(place.points[own]))
    width = 0.0
    for image in pixels:
        edges = image[1:] - image[0]
        lengths = np.sqrt((edges * edges).sum(axis=-1))
        if dimension == 1:
            width = max(width, float(lengths[0]))
        elif dimension == 2:
            area = abs(float(edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]))
            width = max(width, area / max(float(lengths.max()), 1e-9))
    if dimension > 0 and not width > SPAN_PX:
        raise RefusalError(
            "COLLINEAR_MARKERS" if dimension == 2 else "FEATURE_UNCLEAR",
            f"{name}: markers {list(feature.markers)} span no {FEATURES[dimension]}: {width:.1f} px apart",
            value=width,
            threshold=SPAN_PX,
            unit="px",
        )
    return own


def _fixed(feature: Feature, dimension: int, name: str, place: BodyState, model_epoch: int | None) -> FloatArray:
    """The fixed feature (3, 4): a point of height 1, then its directions of height 0."""
    _one_form(feature, name, "fixed")
    if feature.markers:
        raise RefusalError(
            "FEATURE_UNCLEAR", f"{name}: markers move with the body; what stands is given by points or pixels"
        )
    if feature.segments:
        raise RefusalError(
            "FEATURE_UNCLEAR",
            f"{name}: a line by segments is made to points by the gateway; send it through that",
        )
    if feature.points:
        if model_epoch is None:
            raise RefusalError("FRAME_UNKNOWN", f"{name}: points need the goal's model_epoch, in whose frame they are")
        points = np.array(feature.points, dtype=np.float64)
    else:
        points = _triangulated(feature, name, place)
    if len(points) != dimension + 1:
        raise RefusalError(
            "FEATURE_UNCLEAR",
            f"{name}: a {FEATURES[dimension]} is spanned by {dimension + 1} points, got {len(points)}",
            value=float(len(points)),
            threshold=float(dimension + 1),
            unit="points",
        )
    try:
        return feature_form(points, dimension, place.arrays.plane_at_infinity, name)
    except GeometryError as error:
        raise RefusalError("FEATURE_UNCLEAR", str(error)) from error


def _triangulated(feature: Feature, name: str, place: BodyState) -> FloatArray:
    arrays, cameras = place.arrays, place.settings.cameras
    counts = {len(pixels) for pixels in feature.pixels.values()}
    if len(feature.pixels) < 2 or len(counts) != 1:
        raise RefusalError(
            "FEATURE_UNCLEAR",
            f"{name}: pixels of the same points in two or more cameras are needed, got "
            + ", ".join(f"{len(p)} in {c!r}" for c, p in feature.pixels.items()),
        )
    count = counts.pop()
    pixels, weights = np.zeros((len(cameras), count, 2)), np.zeros((len(cameras), count))
    for camera_name, points in feature.pixels.items():
        c = camera_index(camera_name, place.settings)
        pixels[c] = ideal_pixels(arrays.lenses[c], np.array(points, dtype=np.float64).reshape(-1, 2))
        for i, raw in enumerate(points):
            require_imaged(cameras[c], f"{name}, point {i + 1}", raw, pixels[c, i])
        weights[c] = 1.0
    found, ok = triangulate(arrays.matrices, pixels, weights, 5)
    if not bool(np.asarray(ok).all()):
        raise RefusalError(
            "FEATURE_UNCLEAR",
            f"{name}: its pixels' rays do not meet in points; are the cameras' pixels swapped?",
        )
    scaled: FloatArray = with_unit_height(found, arrays.plane_at_infinity)
    return scaled


def _drivable(source: IncidenceGoal, context: StepContext, place: BodyState) -> None:
    """Raises RefusalError for incidences whose error no motion of the arm reduces."""
    assert context.weights is not None
    assert context.pixels is not None
    assert context.prediction is not None
    scene = scene_of(context.prediction, context.pixels, place.arrays, place.points, context.weights)
    step = incidence_step(scene, _task(source), options(source, context, None))
    if step.share < MAKEABLE:
        _has_freedoms(source, scene, place)
    bad = tuple(
        reason for reason in incidence_reasons(step, _task(source), source.names) if reason.code != "INCIDENCE_UNSEEN"
    )
    if bad:
        first = bad[0]
        raise RefusalError(
            first.code,
            f"{first.subject}: {first.hint}",
            subject=first.subject,
            value=first.value,
            threshold=first.threshold,
            unit=first.unit,
            further=bad[1:],
        )


def _has_freedoms(source: IncidenceGoal, scene: Scene, place: BodyState) -> None:
    """Raises RefusalError for an incidence that needs a degree of freedom which the arm lacks in every posture."""
    camera = f"camera {place.settings.cameras[0].name}"
    try:
        lacking = incidence_freedoms(scene, _task(source), place.arrays.plane_at_infinity, camera=camera, anywhere=True)
    except GeometryError:
        return  # arm and cameras determine no right angles, so the motion has no name: the law itself will report it
    for name, freedom in zip(source.names, lacking, strict=True):
        if freedom is not None:
            raise RefusalError(
                "INCIDENCE_NOT_DRIVABLE", f"{name}: the arm lacks a freedom that it needs: {freedom.name}", subject=name
            )


def incidence_motion(source: IncidenceGoal, context: StepContext) -> SourceOutput:
    """One step: the incidences, and the second task in their null space."""
    arrays, prediction, weights, pixels = context.arrays, context.prediction, context.weights, context.pixels
    if arrays is None or prediction is None or weights is None or pixels is None:
        raise AssertionError("a law runs only with a model")
    waits = wait_for_target(source, context)
    if waits is not None:
        return waits
    usable = weights * source.used[:, None]
    points = points_now(arrays, context.q, pixels, usable, context.state.block.correction, source.points)
    scene = scene_of(prediction, pixels, arrays, points, usable)
    task, how = _task(source), options(source, context, error_of_run(context.state.block))
    second = _second(source, context, scene, how.gain)
    step = incidence_step(scene, task, how, second)
    error_px = float(step.error_px.max())
    resting = bool((np.abs(step.velocity) < SECOND_AT_REST).all())
    ended = run_ended(
        source,
        context,
        error_px if isfinite(error_px) else None,
        int((usable.max(axis=0) > 0.0).sum()),
        may_end=may_end(source, context) and (len(second.rates) == 0 or resting),
    )
    if ended is not None:
        return ended
    still = bool((step.status == int(IncidenceStatus.NOT_FINITE)).any())
    expected: FloatArray | float = 0.0
    if source.damping and source.followed is not None:
        standing = incidence_step(scene, task._replace(drift=np.zeros((4, 4))), how, second)
        expected = step.velocity - standing.velocity
    velocity = np.zeros_like(context.q) if still else damp(source, context, step.velocity, expected)
    return SourceOutput(
        velocity,
        True,
        source.goal.speed_scale,
        error_px=error_px if isfinite(error_px) else None,
        task_error=step.error_px,
        reasons=incidence_reasons(step, task, source.names),
    )


def _task(source: IncidenceGoal) -> IncidenceTask:
    task = IncidenceTask(source.kinds, source.markers, source.fixed, source.tolerance_px)
    return task if source.followed is None else task._replace(drift=source.followed.drift)


def _second(source: IncidenceGoal, context: StepContext, scene: Scene, gain: float) -> SecondTask:
    if bool((source.joints_wanted > 0.0).any()):
        return joint_task(context.q, source.joints, source.joints_wanted, context.settings.limits.velocity_max, gain)
    if bool((source.wanted > 0.0).any()):
        return image_task(scene.operators, scene.matrices, scene.points, source.set_points, source.wanted, gain)
    return no_second_task(len(context.q))


def incidence_report(source: IncidenceGoal, context: StepContext) -> PlanReport:
    """The report of an incidence goal, which has no path to plan."""
    return no_plan("incidence", "incidences leave freedoms open", source.time_limit_s)
