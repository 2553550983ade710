"""Control law of incidences: the joint velocity that moves points, lines and planes of the body onto points, lines and
planes of the scene (thesis 2.5.3), with a second task in the null space. Also the reasons why it cannot continue.

Degrees of freedom that a task leaves free are not moved, or serve a second task in the null space. Lines and planes
have no orientation: the nearer of the two orientations is reached. The step runs `incidence_kernel.incidence_kernel`,
whose module defines the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from stereoservo.control.incidence_kernel import (
    METRIC_FLOOR,
    SecondTask,
    fixed_dimension,
    incidence_kernel,
    joint_metric,
    moving_count,
)
from stereoservo.control.law import Options, Scene
from stereoservo.control.mobility import (
    REACH,
    Freedom,
    attainable_motions,
    body_frame,
    missing_freedom,
    rigid_motions,
)
from stereoservo.control.mobility_kernel import point_jacobian
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.kinematics.composition import Composition
from stereoservo.kinematics.kernels import image_jacobian, invert4
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import plain
from stereoservo.planning.visibility_constraints import limit_pull

KINDS = (
    "point-on-point",
    "point-on-line",
    "point-on-plane",
    "line-on-line",
    "line-on-plane",
    "plane-on-plane",
)
"""Names by their codes 0 to 5, as in messages."""

FEATURES = ("point", "line", "plane")
FINITE = 1e-6
"""Height of a point at unit norm, relative to the plane's, below which it is at infinity."""
FLAT = 1e-6
"""Sine below which points of a fixed feature coincide or are collinear."""


class IncidenceStatus(IntEnum):
    """Status of an incidence. Codes up to 2 are those of `planning.three_point_decomposition.ComponentStatus`."""

    MOVES = 0
    DONE = 1
    """Within the tolerance."""
    NOT_DRIVABLE = 2
    """In its current posture the arm has no motion that reduces the error: a degree of freedom is missing, or the
    target is out of reach.
    """
    CONTRADICTS = 3
    """Its error could be reduced alone, but not without increasing those of others."""
    NOT_FINITE = 4
    """A point is unknown, or in a camera's focal plane; the velocity is zero."""


class IncidenceTask(NamedTuple):
    """k incidences as arrays.

    ``kinds`` (k,): codes of `KINDS`.
    ``markers`` (k, 3): indices into ``Scene.points`` of the points that span the moving feature, -1 if there are fewer.
    ``fixed`` (k, 3, 4): a point of height 1, then one direction of height 0 for a line, two for a plane, zero rows if
    there are fewer.
    ``tolerance_px`` [px].
    ``drift`` (4, 4) [1/s]: twist of the fixed features relative to the moving points, if either move on their own; fed
    forward.
    """

    kinds: IntArray
    markers: IntArray
    fixed: FloatArray
    tolerance_px: float
    drift: FloatArray = np.zeros((4, 4))


class IncidenceStep(NamedTuple):
    """Result of a step.

    ``velocity`` (n,) [rad/s or m/s].
    ``error_px`` (k,): of each incidence, the largest distance over its points and all cameras between a point's image
    and that of the nearest point of the feature [px].
    ``status`` (k,): `IncidenceStatus`.
    ``rank``: number of degrees of freedom that the task uses.
    ``conditioning``: the smallest singular value that counts over the largest, squared.
    ``share`` in [0, 1]: fraction of the residual that joints can still reduce to first order.
    """

    velocity: FloatArray
    error_px: FloatArray
    status: IntArray
    rank: int
    conditioning: float
    share: float


def incidence_task(
    kinds: Sequence[str],
    markers: Sequence[Sequence[int]],
    fixed: Sequence[FloatArray],
    plane_at_infinity: FloatArray,
    tolerance_px: float,
) -> IncidenceTask:
    """An `IncidenceTask` from names and points.

    ``kinds``: of `KINDS`.
    ``markers``: indices into the scene's points, as many as span the moving feature.
    ``fixed``: (1, 4), (2, 4) or (3, 4) points that span the fixed one, of any height, at infinity or not (a line given
    by a point and a direction).

    Raises GeometryError for another number of points, points that span less than the feature, and features wholly at
    infinity.
    """
    k = len(kinds)
    codes = np.zeros(k, dtype=np.int64)
    at = np.full((k, 3), -1, dtype=np.int64)
    forms = np.zeros((k, 3, 4))
    for i, (kind, own, points) in enumerate(zip(kinds, markers, fixed, strict=True)):
        if kind not in KINDS:
            raise GeometryError("shape", f"incidence {kind!r} is not known; there are {', '.join(KINDS)}")
        codes[i] = KINDS.index(kind)
        needed = moving_count(int(codes[i]))
        if len(own) != needed or len(set(own)) != needed or min(own, default=-1) < 0:
            raise GeometryError(
                "shape",
                f"{kind}: the moving feature has markers {list(own)}; {needed} different ones are needed",
            )
        at[i, :needed] = own
        dimension = fixed_dimension(int(codes[i]))
        forms[i] = feature_form(points, dimension, plane_at_infinity, kind)
    return IncidenceTask(codes, at, forms, float(tolerance_px))


def feature_form(
    points: FloatArray, dimension: int, plane_at_infinity: FloatArray, name: str = "incidence"
) -> FloatArray:
    """A fixed feature (3, 4) in the form of `IncidenceTask`: a finite point of ``points`` and directions, zero rows
    below.

    ``points`` (dimension + 1, 4): of any height, some at infinity. No LAPACK, no BLAS: the core calls it. Raises
    GeometryError, naming ``name``, for another number of points, points that span less, features wholly at infinity.
    """
    what = FEATURES[dimension]
    points = np.atleast_2d(np.asarray(points, dtype=np.float64))
    if points.shape != (dimension + 1, 4):
        raise GeometryError(
            "shape", f"{name}: the fixed {what} has shape {points.shape}; ({dimension + 1}, 4) is needed"
        )
    sizes = np.sqrt((points * points).sum(axis=1) * (plane_at_infinity * plane_at_infinity).sum())
    if not (np.isfinite(sizes).all() and (sizes > 0.0).all()):
        raise GeometryError("not_finite", f"{name}: points of the fixed {what} are zero or not finite")
    heights = (points * plane_at_infinity).sum(axis=1)
    finite = np.abs(heights) > FINITE * sizes
    if not finite.any():
        raise GeometryError("degenerate", f"{name}: the fixed {what} lies at infinity; one finite point is needed")
    first = int(finite.argmax())
    form = np.zeros((3, 4))
    form[0] = points[first] / heights[first]
    row = 1
    for i in range(len(points)):
        if i == first:
            continue
        direction = points[i] / heights[i] - form[0] if finite[i] else points[i]
        size = float(np.sqrt((direction * direction).sum()))
        independent = size > FLAT * float(np.sqrt((form[0] * form[0]).sum())) or not finite[i]
        for before in form[1:row]:
            direction = direction - float((direction * before).sum()) * before
        left = float(np.sqrt((direction * direction).sum()))
        if not (independent and left > FLAT * size):
            raise GeometryError(
                "degenerate",
                f"{name}: the points of the fixed {what} coincide or are collinear; they span no {what}",
            )
        form[row] = direction / left
        row += 1
    return form


def no_second_task(n: int) -> SecondTask:
    """No second task: the remaining degrees of freedom are not moved."""
    return SecondTask(np.zeros((0, n)), np.zeros(0), np.zeros(0))


def joint_task(
    positions: FloatArray, targets: FloatArray, required: FloatArray, scale: FloatArray, gain: float
) -> SecondTask:
    """Joints towards ``targets`` (n,) where ``required`` (n,) is 1; ``scale`` (n,) > 0: unit of each joint."""
    rates = np.where(required > 0.0, gain * (targets - positions), 0.0)
    return SecondTask(np.eye(len(positions)), rates, required / scale)


def limits_task(positions: FloatArray, lower: FloatArray, upper: FloatArray, rate: float) -> SecondTask:
    """Joints away from their limits towards the centre of their ranges, with a velocity that rises with the distance
    from the centre (`limit_pull`).
    """
    pull, half = limit_pull(positions, lower, upper)
    return SecondTask(np.eye(len(positions)), rate * half * pull, 1.0 / half)


def image_task(
    operators: FloatArray,
    matrices: FloatArray,
    points: FloatArray,
    set_points: FloatArray,
    weights: FloatArray,
    gain: float,
) -> SecondTask:
    """Predicted points (m, 4) towards set-points (c, m, 2) [px]; ``weights`` (c, m) = 1/sigma, 0: no set-point."""
    n = operators.shape[0]
    J = image_jacobian(operators, matrices, points)
    image = points[None, :, None, :] * matrices[:, None, :, :]
    projected = image[..., 0] + image[..., 1] + image[..., 2] + image[..., 3]
    seen = np.repeat(weights.reshape(-1), 2)
    error = (projected[..., :2] / projected[..., 2:] - set_points).reshape(-1)
    rates = np.where(seen > 0.0, -gain * error, 0.0)
    return SecondTask(np.ascontiguousarray(J.reshape(-1, n)), rates, seen)


def incidence_step(
    scene: Scene,
    task: IncidenceTask,
    options: Options,
    second: SecondTask | None = None,
    metric: FloatArray | None = None,
) -> IncidenceStep:
    """``q̇ = J⁺ (drift - gain e)`` by damped least squares with the least motion; the second task in the null space.

    Uses of the scene: ``operators``, ``composition``, ``matrices`` (two or more), ``points``.
    ``metric`` (n,) > 0: cost of a unit of each joint's motion; None: the pixels by which it moves the points
    (`joint_metric`).

    The damping is increased if the residual, predicted a step ``gain * dt_s`` ahead (at least a tenth), would not
    decrease as in the linear model.
    """
    n = scene.operators.shape[0]
    if metric is None:
        metric = joint_metric(scene.operators, scene.matrices, scene.points)
    rest = no_second_task(n) if second is None else second
    arm, constraints = (
        (scene.operators, int(scene.composition)),
        (task.kinds, task.markers, task.fixed, task.drift),
    )
    regulation = (task.tolerance_px, options.gain, options.dt_s, options.damping, metric)
    velocity, error, status, rank, conditioning, share = incidence_kernel(
        arm, scene.matrices, scene.points, constraints, regulation, plain(rest)
    )
    return IncidenceStep(velocity, error, status, rank, conditioning, share)


def incidence_reasons(step: IncidenceStep, task: IncidenceTask, names: Sequence[str]) -> tuple[Reason, ...]:
    """Why the task cannot continue: one reason for each cause, its subject the ``names`` (k,) of the incidences
    concerned.
    """
    reasons = []
    for status, code, hint in (
        (
            IncidenceStatus.CONTRADICTS,
            "INCIDENCES_CONTRADICT",
            "these cannot all hold at once: take one out, or correct its feature",
        ),
        (
            IncidenceStatus.NOT_DRIVABLE,
            "INCIDENCE_NOT_DRIVABLE",
            "the arm has no motion here that brings it nearer: it lacks the freedom, is stretched, or at a singularity",
        ),
        (
            IncidenceStatus.NOT_FINITE,
            "INCIDENCE_UNSEEN",
            "a marker of it is not known, or lies beside a camera: bring it into view",
        ),
    ):
        concerned = np.flatnonzero(step.status == int(status))
        if len(concerned):
            worst = concerned[np.argsort(-step.error_px[concerned], kind="stable")]
            value = float(step.error_px[worst[0]])
            subject = ", ".join(names[int(i)] for i in worst)
            known = value if np.isfinite(value) else None
            reasons.append(Reason(code, "hold", subject, known, task.tolerance_px, "px", hint))
    return tuple(reasons)


DEAR = 10.0
"""Cost of a motion that no joint makes, relative to one that joints make, so that the latter are used first."""


def incidence_freedoms(
    scene: Scene,
    task: IncidenceTask,
    plane_at_infinity: FloatArray,
    H_projective_to_euclidean: FloatArray | None = None,
    camera: str = "the first camera",
    tolerance: float = REACH,
    anywhere: bool = False,
) -> tuple[Freedom | None, ...]:
    """For each incidence alone, the degree of freedom that it lacks in this posture; None if the arm can reduce its
    whole error.

    To first order at the current posture: a degree of freedom lost at a singularity counts as missing. The result is
    the motion that the body would need in addition to all motions of the arm.

    ``anywhere``: only a degree of freedom that the arm lacks in every posture (a SCARA's tilts, the rotations of linear
    axes).
    ``tolerance``: fraction of the residual that may remain, in addition to the task's own tolerance.

    Raises GeometryError as `mobility.mobility` does.
    """
    E = body_frame(scene.operators, scene.matrices, scene.points, plane_at_infinity, H_projective_to_euclidean)
    rigid = np.ascontiguousarray(rigid_motions(E))
    if anywhere:
        scene = scene._replace(operators=attainable_motions(E, scene.operators), composition=Composition.SIMULTANEOUS)
    operators = np.concatenate([scene.operators, rigid])
    free = scene._replace(operators=operators, composition=Composition.SIMULTANEOUS)
    form = np.ascontiguousarray(invert4(E)[:3])
    cost = np.sqrt((point_jacobian(operators, scene.points, form) ** 2).sum(axis=0))
    cost = np.maximum(cost, METRIC_FLOOR * cost.max(initial=1.0))
    cost[len(scene.operators) :] *= DEAR
    options = Options(1.0)
    found: list[Freedom | None] = []
    for k in range(len(task.kinds)):
        alone = IncidenceTask(task.kinds[k : k + 1], task.markers[k : k + 1], task.fixed[k : k + 1], task.tolerance_px)
        step = incidence_step(scene, alone, options)
        body = incidence_step(free, alone, options, metric=cost)
        # At a maximum of the error, or at its goal, the required motion is undetermined.
        needed = step.error_px[0] > task.tolerance_px and body.share > 1.0 - tolerance
        unmade = math.sqrt(1.0 - step.share**2)
        if not needed or unmade <= tolerance or unmade * step.error_px[0] <= task.tolerance_px:
            found.append(None)
            continue
        required = (body.velocity[len(scene.operators) :, None, None] * rigid).sum(axis=0)
        found.append(
            missing_freedom(
                scene.operators, scene.matrices, scene.points, plane_at_infinity, required,
                H_projective_to_euclidean, camera, tolerance,
            )
        )  # fmt: skip
    return tuple(found)
