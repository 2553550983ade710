"""Control law ``cartesian3``: Cartesian servoing in three components (thesis 8.42), translation of the centre, hinge
that aligns the plane of a marker face, turn of the face in its plane. Also the step that ``cartesian2`` shares.

The centre moves on a straight line while the face is rotated about it. `cartesian2` uses the same functions; it
combines hinge and turn into one rotation (8.55). A component that would turn the face out of a camera's view waits for
the other (`visible_rotation`); a velocity that is held for a time makes exactly the intended motion
(`control.step_correction`).

The face's visibility during the motion (thesis 7.4.2): it is rotated by ``t`` about an axis through the centre while
the centre moves the fraction ``s`` of its straight line. A camera at ``O`` sees it while ``f(s, t) = a(t)ᵀ(O − s Δ) >
0``, ``a(t) = exp(−tĤᵀ)a``: affine in ``s``, a sinusoid in ``t``. So at every ``t`` the visible fractions are one
interval, and a path with monotonic ``s`` and ``t`` exists if the largest lower bound so far never exceeds the upper
one. This determines how far the translation may go before the rotation has caught up, how far the rotation may go
before the translation has, and in which of its two directions the rotation is possible at all: the shorter rotation may
violate visibility; the longer one is then used.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.cartesian_components import (
    Components,
    FaceTask,
    Freedoms,
    decompose,
    dot,
    drop_primitive,
    is_flat,
    minors,
    norm,
    normal_frame,
    product,
    regular_freedoms,
    scale_primitive,
    singular_freedoms,
    stacked_singular,
)
from stereoservo.control.law import Law, LawProperties, LawStep, Options, Scene, Task
from stereoservo.control.step_correction import (
    FREEDOMS,
    SINGULAR,
    corrected_step,
    damped_step,
    exponential_into,
    rigid_motions,
)
from stereoservo.kinematics.composition import CurrentArm
from stereoservo.kinematics.kernels import multiply4_into, transform_points, transform_points_into
from stereoservo.messages.reasons import Reason
from stereoservo.numerics.arrays import FloatArray, IntArray, Record
from stereoservo.numerics.compilation import Fields, kernel
from stereoservo.planning.primitives import HINGE, PLANAR, REACH_RATIO, TRANSLATION
from stereoservo.planning.three_point_decomposition import DONE, MOVES, NO_FACE, NOT_REACHABLE, WAITS

# -- visibility of the face ------------------------------------------------------------------------------------------

SAMPLES = 32
"""Number of angles at which a rotation is checked; their spacing decreases with the remaining angle."""
MARGIN_OF_END = 0.1
MARGIN_OF_NOW = 0.5
"""A camera must stay on the face's front by a margin, the smaller of these fractions of ``f`` at the end and now."""
APPROACH = 4.0
"""Inverse of the fraction of the remaining motion at which a component slows down before its bound: 1/4."""


@kernel
def _clear_rotation(
    F: FloatArray, G: FloatArray, margins: FloatArray, cameras: int, angle: float, margin: float
) -> tuple[float, float, bool]:
    """Allowed fraction of the translation, allowed rotation, and whether the path is clear."""
    size = abs(angle)
    share, turn, reached = 1.0, size, 0.0
    clear, going = True, True
    samples = SAMPLES if angle != 0.0 else 0
    for i in range(samples + 1):
        t = angle * i / samples if samples > 0 else 0.0
        sine, half = math.sin(t), math.sin(0.5 * t)
        versine = 2.0 * half * half
        rate = G[0] - sine * G[1] + versine * G[2]
        low, high = 0.0, 1.0
        for c in range(cameras):
            value = F[c, 0] - sine * F[c, 1] + versine * F[c, 2] - margin * margins[c]
            if rate > 0.0:
                high = min(high, value / rate)
            elif rate < 0.0:
                low = max(low, value / rate)
            elif value < 0.0:
                high = -1.0
        if i == samples:
            high = 1.0
        reached = max(reached, low)
        clear = clear and reached <= high
        share = min(share, max(0.0, high))
        if low > 0.0 and going:
            turn = size * max(0, i - 1) / max(1, samples)
            going = False
    return share, turn, clear


@kernel
def visible_rotation(
    face: FloatArray, H: FloatArray, displacement: FloatArray, centres: FloatArray, side: float, angle: float
) -> tuple[float, float, float, bool]:
    """Angle, fraction of the translation and rotation that keep a face (4,) in view, and whether a path in view exists.

    ``centres`` (c, 4): camera centres of height 1.
    ``side``: 1 or -1, the side of the face that is seen.
    """
    rows = np.empty((3, 4))
    for i in range(4):
        rows[0, i] = face[i]
    for k in range(1, 3):
        for i in range(4):
            s = 0.0
            for j in range(4):
                s += rows[k - 1, j] * H[j, i]
            rows[k, i] = s
    cameras = centres.shape[0]
    F = np.empty((cameras, 3))
    margins = np.empty(cameras)
    G = np.zeros(3)
    for k in range(3):
        for i in range(4):
            G[k] += side * rows[k, i] * displacement[i]
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    versine = 2.0 * half * half
    seeing = 0
    for c in range(cameras):
        for k in range(3):
            s = 0.0
            for i in range(4):
                s += rows[k, i] * centres[c, i]
            F[seeing, k] = side * s
        now = F[seeing, 0]
        end = now - G[0] - sine * (F[seeing, 1] - G[1]) + versine * (F[seeing, 2] - G[2])
        if now > 0.0 and end > 0.0:
            margins[seeing] = min(MARGIN_OF_NOW * now, MARGIN_OF_END * end)
            seeing += 1
    other = angle - math.copysign(2.0 * math.pi, angle)
    for trial in range(4):
        sense = angle if trial % 2 == 0 else other
        if trial % 2 == 1 and angle == 0.0:
            continue
        share, turn, clear = _clear_rotation(F, G, margins, seeing, sense, 1.0 if trial < 2 else 0.0)
        if clear:
            return sense, share, turn, True
    share, turn, clear = _clear_rotation(F, G, margins, seeing, angle, 0.0)
    return angle, share, turn, False


# -- the law ---------------------------------------------------------------------------------------------------------

COMPONENTS, UNITS = (TRANSLATION, HINGE, PLANAR), ("", "rad", "rad")
ROTATION = "rotation of the body about its centre"
LONGEST_STEP = 1.0
"""Largest joint motion [rad or m] while a velocity is held: near a singularity a small motion of the body requires
more.
"""
STEP_OF_BOUND = 0.9
"""Largest fraction of the distance to a visibility bound in one step."""
NO_MATRIX, NO_VALUES = np.zeros((0, 0)), np.zeros(0)
BLOCKED = 1e-3
"""Fraction of the remaining motion below which a waiting component stops."""


@kernel
def _one_rotation(freedoms: Freedoms, parts: Components, screw: FloatArray, V: FloatArray) -> tuple[float, int]:
    """Angle and status of hinge and planar turn as one rotation (8.50 to 8.52); writes its screw and
    generator ``V``.
    """
    motions, basis = freedoms
    n, rank = basis.shape
    generators, amount, status = parts.generators, parts.amount, parts.status
    found = MOVES
    if status[1] == NOT_REACHABLE or status[2] == NOT_REACHABLE:
        found = NOT_REACHABLE
    H_r, H_p = generators[1], generators[2]
    s_r, c_r = math.sin(0.5 * amount[1]), math.cos(0.5 * amount[1])
    s_p, c_p = math.sin(0.5 * amount[2]), math.cos(0.5 * amount[2])
    if status[1] != MOVES:
        s_r, c_r = 0.0, 1.0
    first, second = np.empty((4, 4)), np.empty((4, 4))
    multiply4_into(H_r, H_p, first)
    multiply4_into(H_p, H_r, second)
    cosine = c_r * c_p + 0.5 * s_r * s_p * (first[0, 0] + first[1, 1] + first[2, 2] + first[3, 3])
    for i in range(4):
        for k in range(4):
            V[i, k] = s_r * c_p * H_r[i, k] + c_r * s_p * H_p[i, k] + s_r * s_p * (first[i, k] - second[i, k])
    square = 0.0
    for i in range(4):
        for k in range(4):
            square -= 0.5 * V[i, k] * V[k, i]
    if not square > 0.0:
        drop_primitive(screw, V)
        return 0.0, DONE if found == MOVES else found
    sine = math.sqrt(square)
    factor = 1.0 / sine if cosine >= 0.0 else -1.0 / sine
    size, left = 0.0, 0.0
    for i in range(4):
        for k in range(4):
            V[i, k] *= factor
            size += V[i, k] * V[i, k]
            first[i, k] = V[i, k]
    for j in range(n):
        screw[j] = 0.0
    for r in range(rank):
        share = 0.0
        for i in range(4):
            for k in range(4):
                share += motions[r, i, k] * V[i, k]
        for j in range(n):
            screw[j] += share * basis[j, r]
        for i in range(4):
            for k in range(4):
                first[i, k] -= share * motions[r, i, k]
    for i in range(4):
        for k in range(4):
            left += first[i, k] * first[i, k]
    if left > REACH_RATIO * REACH_RATIO * size:
        found = NOT_REACHABLE
    return 2.0 * math.atan2(sine, abs(cosine)), found


class Pace(NamedTuple):
    """``gains`` (k,) [1/s] of the components; ``dt_s`` [s] and the rates as in `control.law.Options`."""

    gains: FloatArray
    dt_s: float
    rotation_rate: float
    translation_rate: float


class VisibilityLimits(NamedTuple):
    """Limits by visibility: the ``share`` of the translation and the ``turn`` of the rotation; whether the hinge is
    made first, in place of one rotation, and the ``whole`` angle of this rotation.
    """

    share: float
    turn: float
    hinge_first: bool
    whole: float


@kernel
def cartesian_step(
    operators: FloatArray,
    composition: int,
    task: FaceTask,
    camera_centres: FloatArray,
    pace: Pace,
    single: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Joint velocity (n,), task error (k,), allowed (k,) and status (k,) of both laws in one call.

    The components are translation, hinge and turn (8.42), or, if ``single``, translation and one rotation (8.55). A
    component that the arm cannot make, or that visibility holds back, does not stop the others.

    ``operators`` (n, 4, 4): at the current configuration (5.21); ``camera_centres`` (c, 4): of height ``a∞ᵀM = 1``.

    Task error: τ in lengths of the frame's coordinates, angles [rad], all >= 0; allowed: the part of it that visibility
    allows; status: `ComponentStatus`.
    """
    points, targets, centre, centre_target = task
    n, dt_s = operators.shape[0], pace.dt_s
    count = 2 if single else 3
    velocity, errors, allowed = np.zeros(n), np.zeros(count), np.zeros(count)
    shown = np.full(count, NO_FACE)
    face = minors(points[0], points[1], points[2])
    target_face = minors(targets[0], targets[1], targets[2])
    centres = 0.0
    for k in range(4):
        centres += abs(centre[k]) + abs(centre_target[k])
    if is_flat(points, face) or is_flat(targets, target_face) or not math.isfinite(centres):
        return velocity, errors, allowed, shown
    freedoms, regular = regular_freedoms(operators, SINGULAR)
    V, values, singular = NO_MATRIX, NO_VALUES, False
    if not regular:
        V, values = stacked_singular(operators)
        freedoms = singular_freedoms(operators, V, values)
        if n >= FREEDOMS and not values[FREEDOMS - 1] > SINGULAR * values[0]:
            rigid, singular = rigid_motions(operators, V, values)
            if singular:
                freedoms = Freedoms(rigid, np.eye(FREEDOMS))
    parts = decompose(freedoms, task)
    visibility = _kept_in_view(freedoms, task, FacePlanes(face, target_face), camera_centres, single, parts)
    steps = _paced(parts, visibility, pace, errors, allowed, shown)
    if singular:
        required = np.zeros((4, 4))
        for i in range(count):
            for a in range(4):
                for k in range(4):
                    required[a, k] += steps[i] * parts.generators[i, a, k]
        velocity = damped_step(operators, V, values, required, dt_s if dt_s > 0.0 else 1.0)
        if dt_s > 0.0:
            share = _shortened(velocity) / dt_s
            for j in range(n):
                velocity[j] *= share
    else:
        _exact_into(CurrentArm(operators, composition), task, parts, steps, dt_s, velocity)
    if visibility.hinge_first:
        errors[1] = visibility.whole
        shown[1] = WAITS
    return velocity, errors, allowed, shown


@kernel
def _shortened(step: FloatArray) -> float:
    """Fraction of a joint step (n,) that moves no joint farther than `LONGEST_STEP`."""
    most = 0.0
    for j in range(step.shape[0]):
        most = max(most, abs(step[j]))
    return 1.0 if not most > LONGEST_STEP else LONGEST_STEP / most


@kernel
def _exact_into(
    arm: CurrentArm, task: FaceTask, parts: Components, steps: FloatArray, dt_s: float, velocity: FloatArray
) -> None:
    """Compute the joint ``velocity`` (n,) of the components' ``steps`` (k,), corrected for the time for which it is
    held.

    A step that would move a joint too far is shortened as a whole: no correction is valid for it.
    """
    operators, composition = arm
    points, centre = task.points, task.centre
    n, count = velocity.shape[0], steps.shape[0]
    for i in range(count):
        for j in range(n):
            velocity[j] += steps[i] * parts.screws[i, j]
    if not dt_s > 0.0:
        return
    share = _shortened(velocity)
    for j in range(n):
        velocity[j] *= share
    held, required = np.empty((4, 4)), np.empty((4, 4))
    for k in range(4):
        for i in range(3):
            held[i, k] = points[i, k]
        held[3, k] = centre[k]
    for i in range(4):
        for k in range(4):
            required[i, k] = held[i, k]
    H, square, cube = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    for back in range(count):
        i = count - 1 - back
        if steps[i] != 0.0:
            exponential_into(parts.generators[i], share * steps[i], square, cube, H)
            for p in range(4):
                required[p, 0], required[p, 1], required[p, 2], required[p, 3] = product(
                    H, required[p, 0], required[p, 1], required[p, 2], required[p, 3]
                )
    step = corrected_step(operators, composition, held, required, velocity)
    for j in range(n):
        velocity[j] = step[j] / dt_s


class BodyTask(NamedTuple):
    """All ``marker_points`` (m, 4) now and at the goal, ``target_points`` (m, 4); the markers of the face, ``corners``
    (3,); ``centre`` and ``centre_target`` (4,): all points of height ``a∞ᵀM = 1``.
    """

    marker_points: FloatArray
    target_points: FloatArray
    corners: IntArray
    centre: FloatArray
    centre_target: FloatArray


class Rates(NamedTuple):
    """The ``gain`` [1/s] of all components; ``dt_s`` [s] and the rates as in `control.law.Options`."""

    gain: float
    dt_s: float
    rotation_rate: float
    translation_rate: float


class Stepped(NamedTuple):
    """Result of a step: joint ``velocity`` (n,), task error and allowed part in ``components`` (2, k), status ``shown``
    (k,).
    """

    velocity: FloatArray
    components: FloatArray
    shown: IntArray


@kernel
def _normalised_step_into(arm: CurrentArm, task: BodyTask, centres: FloatArray, rates: Rates, stepped: Stepped) -> None:
    """`cartesian_step` in the frame of `normal_frame`, so that no threshold depends on the projective frame; lengths in
    the task error are in the frame of the arguments.

    ``stepped``: receives the result; ``centres`` (c, 4): camera centres.
    """
    operators, composition = arm
    marker_points, target_points, corners, centre, centre_target = task
    gain, dt_s, rotation_rate, translation_rate = rates
    velocity, components, shown = stepped
    n, count = operators.shape[0], shown.shape[0]
    points, targets = np.empty((3, 4)), np.empty((3, 4))
    for p in range(3):
        for k in range(4):
            points[p, k] = marker_points[corners[p], k]
            targets[p, k] = target_points[corners[p], k]
    change, back = normal_frame(points, centres)
    turned, work = np.empty((n, 4, 4)), np.empty((4, 4))
    for j in range(n):
        multiply4_into(change, operators[j], work)
        multiply4_into(work, back, turned[j])
    ends, inner = np.empty((2, 4)), np.empty((2, 4))
    for k in range(4):
        ends[0, k], ends[1, k] = centre[k], centre_target[k]
    transform_points_into(change, ends, inner)
    before = norm(ends[1] - ends[0])
    ratio = norm(inner[1] - inner[0]) / before if before > 0.0 else 1.0
    found = cartesian_step(
        turned,
        composition,
        FaceTask(transform_points(change, points), transform_points(change, targets), inner[0], inner[1]),
        transform_points(change, centres),
        Pace(np.full(count, gain), dt_s, rotation_rate, ratio * translation_rate),
        count == 2,
    )
    for j in range(n):
        velocity[j] = found[0][j]
    for i in range(count):
        unit_length = ratio if i == 0 else 1.0
        components[0, i], components[1, i] = found[1][i] / unit_length, found[2][i] / unit_length
        shown[i] = found[3][i]


class FacePlanes(NamedTuple):
    """The plane (4,) of a face now and at the goal, ``then``."""

    now: FloatArray
    then: FloatArray


@kernel
def _kept_in_view(
    freedoms: Freedoms,
    task: FaceTask,
    planes: FacePlanes,
    camera_centres: FloatArray,
    single: bool,
    parts: Components,
) -> VisibilityLimits:
    """Limits of the components that keep the face in view; writes the rotation, with its direction, to ``parts``."""
    face, target_face = planes
    centre, centre_target = task.centre, task.centre_target
    n, cameras = freedoms.basis.shape[0], camera_centres.shape[0]
    screws, generators, amount, status = parts
    side = 1.0
    if cameras > 0:
        centroid = np.zeros(4)
        for c in range(cameras):
            for k in range(4):
                centroid[k] += camera_centres[c, k] / cameras
        side = 1.0 if dot(target_face, centroid) >= 0.0 else -1.0
    displacement = np.zeros(4)
    if status[0] == MOVES:
        for k in range(4):
            displacement[k] = centre_target[k] - centre[k]

    hinge_first = False
    whole = 0.0
    if single:
        screw, V = np.empty(n), np.empty((4, 4))
        whole, found = _one_rotation(freedoms, parts, screw, V)
        angle, share, turn, clear = visible_rotation(face, V, displacement, camera_centres, side, whole)
        if not clear and status[1] == MOVES:
            other = visible_rotation(face, generators[1], displacement, camera_centres, side, amount[1])
            if other[3]:
                hinge_first = True
                angle, share, turn, clear = other
        if not hinge_first:
            status[1] = found
            for j in range(n):
                screws[1, j] = screw[j]
            for i in range(4):
                for k in range(4):
                    generators[1, i, k] = V[i, k]
    else:
        turned = amount[1] if status[1] == MOVES else 0.0
        angle, share, turn, clear = visible_rotation(face, generators[1], displacement, camera_centres, side, turned)
    if angle < 0.0:
        scale_primitive(screws[1], generators[1], -1.0)
    if single or status[1] == MOVES:
        amount[1] = abs(angle)
    return VisibilityLimits(share, turn, hinge_first, whole)


@kernel
def _paced(
    parts: Components,
    visibility: VisibilityLimits,
    pace: Pace,
    errors: FloatArray,
    allowed: FloatArray,
    shown: IntArray,
) -> FloatArray:
    """Motion of each component in this step (k,), or its rate if ``dt_s`` is 0; writes errors, allowed parts and
    status.
    """
    screws, amount, status = parts.screws, parts.amount, parts.status
    share, turn, dt_s = visibility.share, visibility.turn, pace.dt_s
    count, n = errors.shape[0], screws.shape[1]
    steps = np.zeros(count)
    for i in range(count):
        errors[i] = amount[i]
        shown[i] = status[i]
        driven = False
        for j in range(n):
            driven = driven or screws[i, j] != 0.0
        if driven:
            allowed[i] = amount[i]
        limit = math.inf
        if i == 0 and status[0] == MOVES:
            allowed[0] = amount[0] * min(1.0, APPROACH * share)
            if share < 1.0:
                limit = STEP_OF_BOUND * share * amount[0]
        if i == 1 and status[1] == MOVES:
            allowed[1] = min(amount[1], APPROACH * turn)
            if turn < amount[1]:
                limit = STEP_OF_BOUND * turn
        if status[i] == MOVES and allowed[i] < amount[i]:
            shown[i] = WAITS
        rate = pace.translation_rate if i == 0 else pace.rotation_rate
        if dt_s > 0.0:
            steps[i] = min(-math.expm1(-pace.gains[i] * dt_s) * allowed[i], rate * dt_s, limit)
        else:
            steps[i] = min(pace.gains[i] * allowed[i], rate)
    return steps


@kernel
def cartesian3_step(
    operators: FloatArray, task: FaceTask, camera_centres: FloatArray, gains: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """The instantaneous law in three components: `cartesian_step` with ``dt_s`` 0 and no rate limits (8.42)."""
    return cartesian_step(operators, 0, task, camera_centres, Pace(gains, 0.0, math.inf, math.inf), False)


@kernel
def _normalised_step(arm: Fields, task: Fields, centres: FloatArray, rates: Fields, stepped: Fields) -> None:
    """`_normalised_step_into` for Python, with the fields of all records."""
    _normalised_step_into(CurrentArm(*arm), BodyTask(*task), centres, Rates(*rates), Stepped(*stepped))


@kernel
def fill_step(workspace: Record, count: int) -> None:
    """Compute the step of a law with ``count`` components in the record of `control.law.Law.kernel`."""
    work = workspace[0]
    n, m, c = work.joints, work.markers, work.viewing_count
    arm = CurrentArm(work.operators[: 16 * n].reshape((n, 4, 4)), work.composition)
    task = BodyTask(
        work.body[: 4 * m].reshape((m, 4)),
        work.target_points[: 4 * m].reshape((m, 4)),
        work.face,
        work.centre,
        work.centre_target,
    )
    stepped = Stepped(
        work.velocity[:n], work.components[: 2 * count].reshape((2, count)), work.component_status[:count]
    )
    centres = work.eyes[: 4 * c].reshape((c, 4))
    _normalised_step_into(arm, task, centres, Rates(work.gain, work.dt_s, math.inf, math.inf), stepped)
    work.conditioning = 1.0


@kernel
def cartesian3_kernel(workspace: Record) -> None:
    """The law's ``kernel``."""
    fill_step(workspace, 3)


def velocity_step(scene: Scene, task: Task, options: Options, count: int) -> LawStep:
    """The step of a law with ``count`` components, 3 or 2, each at the gain of ``options``."""
    velocity, components = np.empty(len(scene.operators)), np.empty((2, count))
    status = np.empty(count, np.int64)
    body = (scene.points, task.target_points, task.face, task.centre, task.centre_target)
    rates = (options.gain, options.dt_s, options.rotation_rate, options.translation_rate)
    arm = (scene.operators, int(scene.composition))
    _normalised_step(arm, body, scene.camera_centres, rates, (velocity, components, status))
    return LawStep(velocity, components[0], components[1], status, 1.0)


def cartesian_reasons(
    components: tuple[str, ...],
    units: tuple[str, ...],
    task_error: FloatArray,
    allowed: FloatArray,
    status: IntArray,
) -> tuple[Reason, ...]:
    """Reasons for components that the arm cannot make, or that wait. Empty if all move."""
    reasons: list[Reason] = []
    codes = status.tolist()
    if NOT_REACHABLE not in codes and WAITS not in codes and NO_FACE not in codes:
        return ()
    stuck = all(code == WAITS for code in codes[:2]) and bool((allowed[:2] <= BLOCKED * task_error[:2]).all())
    for i, (component, in_unit) in enumerate(zip(components, units, strict=True)):
        left, may = float(task_error[i]), float(allowed[i])
        if codes[i] == NOT_REACHABLE:
            hint = "the arm lacks this freedom here: leave the singularity by joints, or give another goal"
            # an angle can only be measured by an operator that the arm lacks
            value = left if component in (TRANSLATION, ROTATION) else None
            reasons.append(Reason("NOT_REACHABLE", "slow", component, value, None, in_unit, hint))
        elif codes[i] == WAITS and stuck:
            hint = (
                "translation and turn wait for each other, or a camera would see the face's back: use the law "
                "trajectory, whose path may bend, or another centre"
            )
            reasons.append(Reason("VISIBILITY_BLOCKED", "hold", component, left, may, in_unit, hint))
        elif codes[i] == WAITS:
            hint = "waits for the other components, so that the cameras keep seeing the face"
            reasons.append(Reason("VISIBILITY_WAIT", "info", component, left, may, in_unit, hint))
        elif codes[i] == NO_FACE:
            hint = "the three points of the face lie on one line, or are not known: choose others"
            reasons.append(Reason("NO_FACE", "hold", component, None, None, "", hint))
    return tuple(reasons)


def cartesian3(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = [q̂_t q̂_r q̂_p] Λ e``, ``e = (τ, θ_r, θ_p)`` the remaining motion (8.42)."""
    return velocity_step(scene, task, options, 3)


def cartesian3_reasons(step: LawStep) -> tuple[Reason, ...]:
    """Reasons for components that the arm cannot make, or that wait; empty if all move."""
    return cartesian_reasons(COMPONENTS, UNITS, step.error, step.allowed, step.status)


LAW = Law(
    cartesian3,
    "straight line; hinge and turn of the face, kept in view",
    needs_pose=True,
    path="straight",
    options=("centre",),
    components=COMPONENTS,
    units=UNITS,
    reasons=cartesian3_reasons,
    kernel=cartesian3_kernel,
    properties=LawProperties(
        centre="straight",
        face="kept: a component waits for the other",
        works_on="pose; translation, hinge, turn in the plane",
        noise_at_rest="low",
        one_camera="goes on by prediction",
        fails_when="the straight way leaves image or joint limits: refused before",
    ),
    colour="#d55e00",
    rank=40,
)
