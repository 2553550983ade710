"""`control.cartesian` as a kernel: decomposition, sight, and the step of both laws in one call."""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.cartesian import STEP_OF_BOUND
from stereoservo.control.cartesian3_kernel import decompose_into, is_flat
from stereoservo.control.law import IntArray
from stereoservo.control.primitives_kernel import dot, freedoms_of, minors, scale_primitive
from stereoservo.control.sight import APPROACH
from stereoservo.control.sight_kernel import way_in_sight
from stereoservo.control.step_correction_kernel import corrected_step, exponential_into
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel, multiply4_into
from stereoservo.trajectory.primitives import REACH_RATIO
from stereoservo.trajectory.three_points import DONE, MOVES, NO_FACE, NOT_REACHABLE, WAITS


@kernel
def _one_rotation(
    operators: FloatArray,
    basis: FloatArray,
    screws: FloatArray,
    generators: FloatArray,
    amount: FloatArray,
    status: IntArray,
    screw: FloatArray,
    V: FloatArray,
) -> tuple[float, int]:
    """`cartesian.one_rotation` of the hinge and the planar turn: screw (n,), generator (4, 4); angle and status."""
    n, rank = basis.shape
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
        for j in range(n):
            screw[j] = 0.0
        for i in range(4):
            for k in range(4):
                V[i, k] = 0.0
        return 0.0, DONE if found == MOVES else found
    sine = math.sqrt(square)
    factor = 1.0 / sine if cosine >= 0.0 else -1.0 / sine
    size, left = 0.0, 0.0
    for i in range(4):
        for k in range(4):
            V[i, k] *= factor
            size += V[i, k] * V[i, k]
    products = np.empty(n)
    for j in range(n):
        screw[j] = 0.0
        products[j] = 0.0
        for i in range(4):
            for k in range(4):
                products[j] += operators[j, i, k] * V[i, k]
    for r in range(rank):
        share = 0.0
        for j in range(n):
            share += basis[j, r] * products[j]
        for j in range(n):
            screw[j] += share * basis[j, r]
    for i in range(4):
        for k in range(4):
            s = -V[i, k]
            for j in range(n):
                s += screw[j] * operators[j, i, k]
            left += s * s
    if left > REACH_RATIO * REACH_RATIO * size:
        found = NOT_REACHABLE
    return 2.0 * math.atan2(sine, abs(cosine)), found


@kernel
def _moved_into(G: FloatArray, amount: float, points: FloatArray, work: FloatArray) -> None:
    """Points (k, 4) displaced by ``exp(amount G)``, in place; ``work`` (3, 4, 4): scratch."""
    H = work[2]
    exponential_into(G, amount, work[0], work[1], H)
    for p in range(points.shape[0]):
        x, y, z, w = points[p, 0], points[p, 1], points[p, 2], points[p, 3]
        for i in range(4):
            points[p, i] = H[i, 0] * x + H[i, 1] * y + H[i, 2] * z + H[i, 3] * w


@kernel
def cartesian_step(
    operators: FloatArray,
    composition: int,
    points: FloatArray,
    targets: FloatArray,
    centre: FloatArray,
    centre_target: FloatArray,
    camera_centres: FloatArray,
    gains: FloatArray,
    dt_s: float,
    rotation_rate: float,
    translation_rate: float,
    single: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Joint velocity (n,), task error (k,), allowed (k,), status (k,): see `cartesian.cartesian_law`."""
    n, cameras = operators.shape[0], camera_centres.shape[0]
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
    basis = freedoms_of(operators)
    screws, generators = np.zeros((3, n)), np.zeros((3, 4, 4))
    amount = np.zeros(3)
    status = np.full(3, DONE)
    decompose_into(
        operators, basis, points, targets, centre, centre_target, screws, generators, amount, status
    )
    side = 1.0
    if cameras > 0:
        middle = np.zeros(4)
        for c in range(cameras):
            for k in range(4):
                middle[k] += camera_centres[c, k] / cameras
        side = 1.0 if dot(target_face, middle) >= 0.0 else -1.0
    displacement = np.zeros(4)
    if status[0] == MOVES:
        for k in range(4):
            displacement[k] = centre_target[k] - centre[k]

    hinge_first = False
    whole = 0.0
    if single:
        screw, V = np.empty(n), np.empty((4, 4))
        whole, found = _one_rotation(operators, basis, screws, generators, amount, status, screw, V)
        angle, share, turn, clear = way_in_sight(face, V, displacement, camera_centres, side, whole)
        if not clear and status[1] == MOVES:
            other = way_in_sight(face, generators[1], displacement, camera_centres, side, amount[1])
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
        angle, share, turn, clear = way_in_sight(
            face, generators[1], displacement, camera_centres, side, turned
        )
    if angle < 0.0:
        scale_primitive(screws[1], generators[1], -1.0)
    if single or status[1] == MOVES:
        amount[1] = abs(angle)

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
        rate = translation_rate if i == 0 else rotation_rate
        if dt_s > 0.0:
            steps[i] = min(-math.expm1(-gains[i] * dt_s) * allowed[i], rate * dt_s, limit)
        else:
            steps[i] = min(gains[i] * allowed[i], rate)
        for j in range(n):
            velocity[j] += steps[i] * screws[i, j]
    if dt_s > 0.0:
        held, wanted = np.empty((4, 4)), np.empty((4, 4))
        for k in range(4):
            for i in range(3):
                held[i, k] = points[i, k]
            held[3, k] = centre[k]
        for i in range(4):
            for k in range(4):
                wanted[i, k] = held[i, k]
        work = np.empty((3, 4, 4))
        for back in range(count):
            i = count - 1 - back
            if steps[i] != 0.0:
                _moved_into(generators[i], steps[i], wanted, work)
        step = corrected_step(operators, composition, held, wanted, velocity)
        for j in range(n):
            velocity[j] = step[j] / dt_s
    if hinge_first:
        errors[1] = whole
        shown[1] = WAITS
    return velocity, errors, allowed, shown


@kernel
def cartesian3_step(
    operators: FloatArray,
    points: FloatArray,
    targets: FloatArray,
    centre: FloatArray,
    centre_target: FloatArray,
    camera_centres: FloatArray,
    gains: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """The instantaneous law in three components: `cartesian3.cartesian3_law` (8.42)."""
    return cartesian_step(
        operators, 0, points, targets, centre, centre_target, camera_centres, gains, 0.0, math.inf, math.inf, False
    )  # fmt: skip
