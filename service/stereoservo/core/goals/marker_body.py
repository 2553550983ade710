"""The marker body of a goal: its current points, its pose at the goal (rigid displacement fitted to the set-points),
and checks that the cameras can see it there, from its front and not mirrored.

Three triangulated points would be enough for (7.21)-(7.24), but every marker of the goal is used. The displacement from
the current pose to the goal is found by integrating the Cartesian law itself, which converges from anywhere, and
refined by minimising the reprojection error of all set-points. The result is one rigid displacement of the calibrated
structure, so it also determines markers that the goal does not show.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import isfinite

import numpy as np

from stereoservo.control.cartesian_components import FaceTask
from stereoservo.control.faces import (
    MOST_TRIED,
    Faces,
    find_faces,
    select_faces,
    spaced_in_images,
    visibility_along,
)
from stereoservo.control.laws.cartesian3 import cartesian3_step
from stereoservo.control.marker_groups import FLAT_PX
from stereoservo.core.context import RefusalError, StepContext
from stereoservo.core.model_arrays import ModelArrays
from stereoservo.core.prediction import chain_at, markers_at
from stereoservo.core.settings import MIN_MARKERS, CoreSettings
from stereoservo.kinematics.kernels import (
    distort_pixel,
    exp_twist,
    image_jacobian,
    invert4,
    multiply4_into,
    project_points,
    transform_points,
)
from stereoservo.messages.goals import DisplacementTarget, MetricFrame
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import damped_least_squares
from stereoservo.planning.motion_frame import rotation_between

UNIT_VECTORS = np.vstack([np.eye(3), -np.eye(3)])
RIGID_SHARE = 0.1
"""Largest deviation of goals in points or matrices from a rigid displacement, for their noise, as a fraction of the
body's extent.
"""
BODY_DEPTH = 0.02
"""Volume of four markers, relative to the cube of their extent, above which a mirror image can be detected."""
MAX_GOAL_RESIDUAL_PX = 5.0
LAW_STEPS = 80
NEAR = 1e-5
"""Size of a step in the basis below which least squares continues."""
LAW_GAIN = 0.3
"""Fraction of the remaining displacement that is made in a step."""
REFINEMENTS = 12
REFINE_DAMPING = 1e-12
CONVERGED = 1e-13
"""Size of a refinement's step in the basis at which it has converged."""


ARM_ROUNDS = 60
"""Iterations of least squares in an arm's joints."""
ARM_STEP = 0.3
"""Largest step of a joint in such an iteration [rad or m]: the range of linearity."""
ARM_DAMPING = 1e-9
"""Damping of these iterations: joints do not move in directions that the markers do not determine."""
ARM_CONVERGED = 1e-10
"""Step of an iteration [rad or m] at which it has converged."""


def markers_needed(required: FloatArray) -> int:
    """Number of markers of an accepted goal that have to be seen; ``required`` (c, m): those that it shows. All of
    them, if they are fewer than would determine a pose.
    """
    return min(MIN_MARKERS, int((required.max(axis=0) > 0.0).sum()))


@dataclass(frozen=True)
class BodyState:
    """The body's current state, from which a target is resolved: its ``points`` (m, 4) of height 1 and the arm's
    ``operators`` (n, 4, 4).
    """

    settings: CoreSettings
    arrays: ModelArrays
    points: FloatArray
    operators: FloatArray
    faces: Faces
    """Faces of the body at its current pose."""


def place_now(context: StepContext) -> BodyState:
    """The body as currently estimated. Needs a model."""
    arrays, prediction = context.arrays, context.prediction
    assert arrays is not None
    assert prediction is not None
    points = markers_at(arrays, context.q + context.state.block.correction)
    seen = np.zeros((len(context.settings.cameras), len(points))) if context.weights is None else context.weights
    if arrays.groups is not None:
        faces = select_faces(arrays.groups, points, arrays.camera_centres, seen)
    else:  # recorded before models stated them: found for each goal, from the pose at its start
        faces = find_faces(points, arrays.matrices, FLAT_PX, arrays.camera_centres, seen, prediction.operators)
    # A goal may be resolved over several steps, but the workspace is overwritten in each: copy.
    return BodyState(context.settings, arrays, points, prediction.operators.copy(), faces)


def view_of(settings: CoreSettings, arrays: ModelArrays, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ideal pixels (c, m, 2) of ``points`` (m, 4), and (c, m) 1 where they are inside the camera's
    image, 0 elsewhere.
    """
    sizes = np.array([(camera.width, camera.height) for camera in settings.cameras], dtype=np.float64)
    found: tuple[FloatArray, FloatArray] = _view(arrays.matrices, arrays.lenses, sizes, points)
    return found


@kernel
def _view(
    matrices: FloatArray, lenses: FloatArray, sizes: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray]:
    pixels, _ = project_points(matrices, points)
    shown = np.zeros((matrices.shape[0], points.shape[0]))
    for c in range(matrices.shape[0]):
        for i in range(points.shape[0]):
            u, v = distort_pixel(lenses[c], pixels[c, i, 0], pixels[c, i, 1])
            if -0.5 <= u <= sizes[c, 0] - 0.5 and -0.5 <= v <= sizes[c, 1] - 0.5:
                shown[c, i] = 1.0
    return pixels, shown


# -- steps in metres -------------------------------------------------------------------------------------------


def displacement_in(frame: MetricFrame, rigid: FloatArray, arrays: ModelArrays, joints: FloatArray) -> FloatArray:
    """Displacement (4, 4) of the marker body in the model's frame that moves what the arm carries by ``rigid`` (4, 4)
    [m] in a ``frame`` about its pivot, with the arm at ``joints`` (n,).
    """
    A, pivot = _frame_at(frame, arrays, joints)
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = pivot[:3], -pivot[:3]
    D = product4(product4(there, rigid), back)
    return product4(product4(A, invert4(D) if arrays.tip_first else D), invert4(A))


def step_made(target: DisplacementTarget, arrays: ModelArrays, start: FloatArray, now: FloatArray) -> str:
    """The step that a ``target`` in a metric frame asked for, and the one made by the arm from its joints at the
    ``start`` (n,) to those ``now`` (n,), corrected by the images: along and about the frame's axes, as text.
    """
    frame = target.frame
    assert frame is not None
    A, pivot = _frame_at(frame, arrays, start)
    moved = product4(chain_at(arrays, now)[0], invert4(chain_at(arrays, start)[0]))
    D = product4(product4(invert4(A), moved), A)
    D = (invert4(D) if arrays.tip_first else D) / D[3, 3]
    asked = np.array(target.matrix).reshape(4, 4)
    texts = []
    for H, move in (asked, asked[:3, 3]), (D, transform_points(D, pivot[None])[0, :3] - pivot[:3]):
        x, y, z, angle = rotation_between(UNIT_VECTORS, np.vstack([H[:3, :3].T, -H[:3, :3].T]))
        turn = np.degrees(angle) * np.array([x, y, z])
        texts.append((f"{_three(1e3 * move)} mm, " if frame.scaled else "") + f"{_three(turn)}°")
    return f"in {frame.name}: asked {texts[0]}; made {texts[1]}"


def _three(values: FloatArray) -> str:
    return f"({', '.join(f'{round(float(value), 2) + 0.0:.2f}' for value in values)})"


def _frame_at(frame: MetricFrame, arrays: ModelArrays, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pose (4, 4) of a ``frame`` in the model's with the arm at ``joints`` (n,), and its pivot (4,) in it [m]."""
    X = chain_at(arrays, joints)[0]
    A = np.array(frame.pose).reshape(4, 4)
    here = product4(X, A) if frame.with_body else A
    pivot = np.array([*frame.pivot, 1.0])
    if frame.pivot_with_body != frame.with_body:
        back = product4(invert4(here), product4(X, A) if frame.pivot_with_body else A)
        pivot = transform_points(back, pivot[None])[0]
    return here, pivot / pivot[3]


def product4(A: FloatArray, B: FloatArray) -> FloatArray:
    """``A B`` of (4, 4), without BLAS."""
    product = np.empty((4, 4))
    multiply4_into(np.ascontiguousarray(A), np.ascontiguousarray(B), product)
    return product


# -- its pose at the goal -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GoalPose:
    """Marker points at the goal (m, 4) of height a∞ᵀM = 1, and how well they explain the set-points [px].

    ``displacement`` (4, 4): from the body's initial pose to the goal.
    """

    points: FloatArray
    displacement: FloatArray
    rms_px: float
    worst_px: float
    worst_marker: int


def goal_pose(
    arrays: ModelArrays,
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    known: BoolArray,
    face: IntArray,
    set_points: FloatArray,
    required: FloatArray,
) -> GoalPose:
    """Fit one rigid displacement of ``points`` (m, 4) to the set-points.

    ``targets`` (m, 4): triangulated goal points where ``known`` (m,).
    ``face`` (3,): spans a face.
    ``operators`` (n, 4, 4): the arm's current ones, a basis of displacements if the model has no metric one.
    """
    displacement, _ = displacement_by_law(
        arrays, operators, points, targets, known, face, set_points, required, np.eye(4), LAW_STEPS
    )
    basis = displacement_basis(arrays, operators)
    return refined_pose(arrays, basis, points, displacement, set_points, required)[0]


def displacement_basis(arrays: ModelArrays, operators: FloatArray) -> FloatArray:
    """Twists (k, 4, 4) that span displacements: the model's, or if it has none the arm's ``operators`` (n, 4, 4)."""
    return operators if arrays.metric_basis is None else arrays.metric_basis


def displacement_by_law(
    arrays: ModelArrays,
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    known: BoolArray,
    face: IntArray,
    set_points: FloatArray,
    required: FloatArray,
    displacement: FloatArray,
    steps: int,
) -> tuple[FloatArray, bool]:
    """A displacement (4, 4) as the initial value of least squares, by so many ``steps`` of the law from the
    ``displacement`` of the previous steps; and whether it is close to the solution. Other arguments as in `goal_pose`.
    """
    basis = displacement_basis(arrays, operators)
    few = np.flatnonzero(known)
    if len(few) > MOST_TRIED:  # only an initial value for least squares: a part of a large body is enough
        few = np.union1d(face, spaced_in_images(few, set_points, required))
        face, some = np.searchsorted(few, face), np.ones(len(few), dtype=bool)
        D, near = _displacement_by_law(basis, points[few], (targets[few], some), face, displacement, steps)
    else:
        D, near = _displacement_by_law(basis, points, (targets, known), face, displacement, steps)
    return D, bool(near)


def refined_pose(
    arrays: ModelArrays,
    basis: FloatArray,
    points: FloatArray,
    displacement: FloatArray,
    set_points: FloatArray,
    required: FloatArray,
    refinements: int = REFINEMENTS,
) -> tuple[GoalPose, bool]:
    """Least squares on all set-points from a nearby ``displacement`` (4, 4), and whether it has converged in so many
    ``refinements``; ``basis`` (k, 4, 4) of displacements.
    """
    D, moved, pixels, converged = _refine(
        basis, arrays.matrices, points, displacement, (set_points, required), refinements
    )
    distance = np.where(required > 0.0, np.sqrt(((pixels - set_points) ** 2).sum(axis=-1)), 0.0)
    worst = int(distance.max(axis=0).argmax())
    rms_px = float(np.sqrt((distance * distance).sum() / max(float(required.sum()), 1.0)))
    return GoalPose(moved, D, rms_px, float(distance.max()), arrays.marker_ids[worst]), bool(converged)


@kernel
def _displacement_by_law(
    basis: FloatArray,
    points: FloatArray,
    goal: tuple[FloatArray, BoolArray],
    face: IntArray,
    displacement: FloatArray,
    steps: int,
) -> tuple[FloatArray, bool]:
    """Displacement (4, 4) to which the Cartesian law converges: the face of ``points`` (m, 4) onto that of the targets.
    Returns it after so many ``steps`` from a ``displacement``, and whether it is close to the solution.

    ``goal``: the targets (m, 4), and which of them are known (m,).
    """
    targets, known = goal
    nobody = np.zeros((0, 4))  # in this computation no camera has to see the face
    gains = np.full(3, LAW_GAIN)
    D = displacement.copy()
    moved = transform_points(D, points)
    centre_target = _centroid(targets, known)
    for _ in range(steps):
        twist, _, _, _ = cartesian3_step(
            basis, FaceTask(moved[face], targets[face], _centroid(moved, known), centre_target), nobody, gains
        )
        D = _moved_by(basis, twist, D)
        moved = transform_points(D, points)
        if _all_below(twist, NEAR):
            return D, True
    return D, False


def left_by_components(
    arrays: ModelArrays, operators: FloatArray, points: FloatArray, targets: FloatArray, face: IntArray
) -> float:
    """Largest distance [px] from the goal at which a law in components comes to rest with the degrees of freedom
    ``operators`` (n, 4, 4), from ``points`` to ``targets`` (m, 4); ``face`` (3,) of the markers.
    """
    known = np.ones(len(points), dtype=bool)
    D, _ = _displacement_by_law(operators, points, (targets, known), face, np.eye(4), LAW_STEPS)
    pixels, _ = project_points(arrays.matrices, transform_points(D, points))
    goal_pixels, _ = project_points(arrays.matrices, targets)
    return float(np.sqrt(((pixels - goal_pixels) ** 2).sum(axis=-1)).max())


@kernel
def _centroid(points: FloatArray, known: BoolArray) -> FloatArray:
    """Mean (4,) of the ``known`` ones of ``points`` (m, 4)."""
    centroid = np.zeros(4)
    count = 0.0
    for p in range(points.shape[0]):
        if known[p]:
            count += 1.0
            for i in range(4):
                centroid[i] += points[p, i]
    return centroid / count


@kernel
def _refine(
    basis: FloatArray,
    matrices: FloatArray,
    points: FloatArray,
    displacement: FloatArray,
    goal: tuple[FloatArray, FloatArray],
    refinements: int,
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """Least squares of `refined_pose`: displacement (4, 4), displaced points (m, 4), their pixels (c, m, 2), whether it
    has converged. ``goal``: set-points (c, m, 2), and which are required (c, m).
    """
    set_points, required = goal
    D = displacement
    moved = transform_points(D, points)
    converged = False
    weights = np.repeat(required.copy().reshape(-1), 2)
    for _ in range(refinements):
        pixels, _ = project_points(matrices, moved)
        jacobian = image_jacobian(basis, matrices, moved).reshape(-1, basis.shape[0])
        step, _ = damped_least_squares(jacobian, (set_points - pixels).reshape(-1), weights, REFINE_DAMPING)
        D = _moved_by(basis, step, D)
        moved = transform_points(D, points)
        converged = _all_below(step, CONVERGED)
        if converged:
            break
    return D, moved, project_points(matrices, moved)[0], converged


@kernel
def _moved_by(basis: FloatArray, twist: FloatArray, D: FloatArray) -> FloatArray:
    """``exp(Σ t_j Ĝ_j) D`` (4, 4) for a ``twist`` (k,) in the ``basis`` (k, 4, 4)."""
    G, product = np.zeros((4, 4)), np.empty((4, 4))
    for j in range(basis.shape[0]):
        for i in range(4):
            for k in range(4):
                G[i, k] += twist[j] * basis[j, i, k]
    multiply4_into(exp_twist(G), D, product)
    return product


@kernel
def _all_below(values: FloatArray, limit: float) -> bool:
    """Whether the absolute values of ``values`` (k,) are all below ``limit``; False if one is NaN."""
    return bool((np.abs(values) < limit).all())


def one_body(pose: GoalPose, points: FloatArray, targets: FloatArray, known: BoolArray) -> None:
    """Raises RefusalError if no rigid displacement of ``points`` (m, 4) fits the goal: ``pose`` is the best fit."""
    if pose.worst_px <= MAX_GOAL_RESIDUAL_PX:
        return
    said = (
        f"marker {pose.worst_marker} is off by {pose.worst_px:.2f} px (rms {pose.rms_px:.2f} px; up to "
        f"{MAX_GOAL_RESIDUAL_PX} px is accepted)"
    )
    value = pose.worst_px if isfinite(pose.worst_px) else None
    if mirrored(points, targets, known):
        raise RefusalError(
            "MIRRORED_GOAL",
            f"no displacement of the marker body explains the goal, it is its mirror image: {said}",
            subject=str(pose.worst_marker),
            value=value,
            threshold=MAX_GOAL_RESIDUAL_PX,
            unit="px",
        )
    raise RefusalError(
        "NOT_RIGID",
        f"no displacement of the marker body explains the set-points: {said}: are ids swapped, is it another body, or "
        "is it mirrored?",
        subject=str(pose.worst_marker),
        value=value,
        threshold=MAX_GOAL_RESIDUAL_PX,
        unit="px",
    )


@dataclass(frozen=True)
class ReachedPose:
    """The pose nearest to set-points that an arm can reach: its ``joints`` (n,), the ``points`` (m, 4) there, and
    ``pixels`` (c, m, 2); the ``worst`` distance [px], with the indices of its ``marker`` and ``camera``.
    """

    joints: FloatArray
    points: FloatArray
    pixels: FloatArray
    worst: float
    camera: int
    marker: int


def reached_pose(arrays: ModelArrays, joints: FloatArray, set_points: FloatArray, required: FloatArray) -> ReachedPose:
    """Least squares of set-points (c, m, 2) that are ``required`` (c, m) in the arm's own joints, from ``joints`` (n,).

    Degrees of freedom that the set-points do not determine are not moved.
    """
    q = joints.copy()
    weights = np.repeat(required.reshape(-1), 2)
    for _ in range(ARM_ROUNDS):
        _, operators = chain_at(arrays, q)
        points = markers_at(arrays, q)
        pixels, _ = project_points(arrays.matrices, points)
        jacobian = image_jacobian(operators, arrays.matrices, points).reshape(-1, q.size)
        step, _ = damped_least_squares(jacobian, (set_points - pixels).reshape(-1), weights, ARM_DAMPING)
        largest = float(np.abs(step).max())
        if not isfinite(largest):
            break
        q = q + step * min(1.0, ARM_STEP / max(largest, ARM_STEP))
        if largest < ARM_CONVERGED:
            break
    points = markers_at(arrays, q)
    pixels, _ = project_points(arrays.matrices, points)
    distance = np.where(required > 0.0, np.sqrt(((pixels - set_points) ** 2).sum(axis=-1)), 0.0)
    camera, marker = divmod(int(distance.argmax()), distance.shape[1])
    return ReachedPose(q, points, pixels, float(distance.max()), camera, marker)


# -- what must remain visible there ---------------------------------------------------------------------------


def enough_in_view(place: BodyState, pixels: FloatArray, shown: FloatArray, known: BoolArray) -> None:
    """Raises RefusalError if in no camera enough of the ``known`` markers are ``shown`` (c, m) at the goal."""
    best = int(shown.sum(axis=-1).argmax())
    count = int(shown[best].sum())
    if count >= MIN_MARKERS:
        return
    camera = place.settings.cameras[best]
    lost = int(np.flatnonzero(known & (shown[best] == 0.0))[0])
    u, v = (float(x) for x in pixels[best, lost])
    raise RefusalError(
        "FIELD_OF_VIEW",
        f"at the goal camera {camera.name!r} shows {count} of its markers, the others less; {MIN_MARKERS} are needed: "
        f"marker {place.arrays.marker_ids[lost]} would be at ({u:.0f}, {v:.0f}), its image is "
        f"{camera.width}x{camera.height}",
        subject=camera.name,
        value=float(count),
        threshold=float(MIN_MARKERS),
        unit="markers",
    )


def keeps_its_shape(body: FloatArray, targets: FloatArray, known: BoolArray) -> None:
    """Raises RefusalError for points or matrices that stretch or shear the body, along the cameras' rays too."""
    centroid = body.sum(axis=0) / len(body)
    extent = float(np.sqrt(((body - centroid) ** 2).sum(axis=-1).max()))
    distances = np.where(known, np.sqrt(((body - targets) ** 2).sum(axis=-1)), 0.0)
    share = float(distances.max()) / extent
    if not share <= RIGID_SHARE:
        raise RefusalError(
            "NOT_RIGID",
            f"the goal is no rigid displacement of the marker body: it differs from the nearest by {share:.2f} of the "
            f"body's extent; up to {RIGID_SHARE} is accepted",
            value=share,
            threshold=RIGID_SHARE,
            unit="of the body's extent",
        )


def turned_to(place: BodyState, displacement: FloatArray) -> FloatArray:
    """(c, m) 1 where a marker's face is turned to the camera after ``displacement``, and where its side is unknown;
    else 0.
    """
    faces = place.faces
    found = np.ones((len(place.arrays.camera_centres), len(place.points)))
    if not bool((faces.sided > 0.0).any()):
        return found
    fronts = visibility_along(faces, place.points, displacement[None], place.arrays.camera_centres).fronts[0]
    sided = faces.members[faces.sided > 0.0].max(axis=0) > 0.0
    for c in range(len(found)):
        turned = (faces.members * fronts[:, c : c + 1]).max(axis=0) > 0.0
        found[c] = np.where(sided & ~turned, 0.0, 1.0)
    return found


def enough_shown(place: BodyState, shown: FloatArray) -> None:
    """Raises RefusalError if the body shows its back: too few markers are ``shown`` (c, m) from their front."""
    best = int(shown.sum(axis=-1).argmax())
    count = int(shown[best].sum())
    if count >= MIN_MARKERS:
        return
    camera = place.settings.cameras[best].name
    raise RefusalError(
        "FACE_HIDDEN",
        f"at the goal camera {camera!r} would see the front of {count} markers, the others of less; {MIN_MARKERS} are "
        "needed: the body turns its back",
        subject=camera,
        value=float(count),
        threshold=float(MIN_MARKERS),
        unit="markers",
    )


def in_front(place: BodyState, targets: FloatArray, known: BoolArray) -> None:
    """Raises RefusalError for a goal behind a camera that has the body in front of it now."""
    for c, P in enumerate(place.arrays.matrices):
        now = (place.points * P[2]).sum(axis=-1)
        side = 1.0 if float(np.sign(now).sum()) >= 0.0 else -1.0
        if not bool((side * now > 0.0).all()):
            continue  # the body intersects this camera's plane: the test is not possible
        then = side * (targets * P[2]).sum(axis=-1)
        behind = np.flatnonzero(known & ~(then > 0.0))
        if behind.size:
            i, camera = int(behind[0]), place.settings.cameras[c].name
            share = float(then[i] / (side * now[i]))
            raise RefusalError(
                "BEHIND_CAMERA",
                f"at the goal marker {place.arrays.marker_ids[i]} lies behind camera {camera!r} "
                f"(at {share:.2f} of its present depth; more than 0 is needed)",
                subject=camera,
                value=share,
                threshold=0.0,
                unit="of the present depth",
            )


def mirrored(points: FloatArray, targets: FloatArray, known: BoolArray) -> bool:
    """Whether four markers that span a large volume are mirrored. False for a flat body, for which this is
    undetectable.
    """
    four = _widest(points, np.flatnonzero(known))
    now, then = points[four], targets[four]
    extent = float(np.sqrt(((now[1:] - now[0]) ** 2).sum(axis=-1).max()))
    scale = extent**3 * float(np.sqrt((now[0] * now[0]).sum()))
    volume = determinant4(now) / scale if len(four) == 4 and scale > 0.0 else 0.0
    return abs(volume) > BODY_DEPTH and determinant4(then) * volume < 0.0


def _widest(points: FloatArray, candidates: IntArray) -> list[int]:
    """Up to four of the ``candidates``, each the farthest from the span of those before it."""
    rest = points[candidates] - points[candidates].sum(axis=0) / max(len(candidates), 1)
    four: list[int] = []
    for _ in range(min(4, len(candidates))):
        squares = (rest * rest).sum(axis=-1)
        far = int(squares.argmax())
        four.append(int(candidates[far]))
        if len(four) == 1:
            rest = rest - rest[far]
        elif float(squares[far]) > 0.0:
            rest = rest - ((rest * rest[far]).sum(axis=-1) / squares[far])[:, None] * rest[far]
    return four


def determinant4(A: FloatArray) -> float:
    """Determinant of ``A`` (4, 4) by 2×2 minors."""
    a, b, c, d = A
    top = [a[i] * b[j] - a[j] * b[i] for i, j in combinations(range(4), 2)]
    low = [c[i] * d[j] - c[j] * d[i] for i, j in combinations(range(4), 2)]
    return float(
        top[0] * low[5] - top[1] * low[4] + top[2] * low[3] + top[3] * low[2] - top[4] * low[1] + top[5] * low[0]
    )
