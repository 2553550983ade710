"""Correction of a joint velocity that is held for a whole control step: its finite displacement becomes the one that
the law's instantaneous screws intend (thesis 8.5.2).

The screws of a law are valid for an instant: driven together for a whole step, joints rotate one another's axes, and
the result deviates by the brackets of (8.46). Instead of their series, Newton's method finds the step of the joints
that displaces the body's points exactly as intended, starting from the first-order step.

Near a singularity of the arm that step does not exist, or is far too large; use `damped_step` there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.cartesian_components import product
from stereoservo.kinematics.kernels import exp_twist, multiply4_into, transform_points_into
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import add_equation, damped_solve, factor_solve

ITERATIONS = 6
CONVERGED = 1e-12
"""Change of the joints' step [rad or m] below which no further iteration is made."""
STEEP = 1e-2
"""Ratio of a change to the previous one, below which the Jacobian is accurate enough for another iteration."""
SLACK = 1.0 + 1e-9
"""Factor by which the squared error may grow: near its minimum it does not distinguish steps."""
BRACKETS = 6
"""Terms of the series by which the exponential rotates the operators of a sum; a step is small."""
DAMPING = 1e-12
"""Damping relative to the largest diagonal element of the normal matrix: a redundant arm takes the smallest change."""

STRUCTURE = 1e-18
"""Squared relative residue of ``Ĥ³ = −cĤ`` below which the closed form of the exponential holds."""
SIMULTANEOUS = 2
TIP_FIRST = 1


class JointScrews(NamedTuple):
    """``operators`` (n, 4, 4) of joints, their ``squares`` (n, 4, 4), and ``rates`` (n,): that of a rotation's angle, 0
    for a translation, NaN for a general screw.
    """

    operators: FloatArray
    squares: FloatArray
    rates: FloatArray


@kernel
def joint_screws(operators: FloatArray) -> JointScrews:
    """The operators (n, 4, 4) with the values needed for their exponentials."""
    n = operators.shape[0]
    found = JointScrews(operators, np.empty((n, 4, 4)), np.empty(n))
    cube = np.empty((4, 4))
    for j in range(n):
        found.rates[j] = _square_into(operators[j], found.squares[j], cube)
    return found


@kernel
def _square_into(G: FloatArray, square: FloatArray, cube: FloatArray) -> float:
    """Write ``G²`` to ``square`` (4, 4); returns the rate of the rotation ``G³ = −rate² G``, 0 for a translation, NaN
    if ``G`` is neither. ``cube`` (4, 4): scratch.
    """
    multiply4_into(G, G, square)
    multiply4_into(G, square, cube)
    c = -0.5 * (square[0, 0] + square[1, 1] + square[2, 2] + square[3, 3])
    size, rest = 0.0, 0.0
    for i in range(4):
        for k in range(4):
            size += G[i, k] * G[i, k]
            rest += (cube[i, k] + c * G[i, k]) ** 2
    return math.sqrt(c) if rest <= STRUCTURE * size**3 and c >= 0.0 else math.nan


@kernel
def _closed_form(rate: float, amount: float) -> tuple[float, float]:
    """``exp(amount G) = 1 + first G + second G²``: both factors (4.27, 3.21)."""
    if rate * abs(amount) > 1e-8:
        half = math.sin(0.5 * rate * amount)
        return math.sin(rate * amount) / rate, 2.0 * half * half / (rate * rate)
    return amount, 0.5 * amount * amount


@kernel
def exponential_into(G: FloatArray, amount: float, square: FloatArray, cube: FloatArray, H: FloatArray) -> None:
    """Write ``exp(amount G)`` to ``H`` (4, 4): in closed form for a rotation or translation (4.27, 3.21), else by the
    series.

    ``square``, ``cube`` (4, 4): scratch.
    """
    rate = _square_into(G, square, cube)
    if math.isnan(rate):
        whole = exp_twist(amount * G)
        for i in range(4):
            for k in range(4):
                H[i, k] = whole[i, k]
        return
    first, second = _closed_form(rate, amount)
    for i in range(4):
        for k in range(4):
            H[i, k] = first * G[i, k] + second * square[i, k]
        H[i, i] += 1.0


@kernel
def _exponential_pair_into(screws: JointScrews, j: int, amount: float, H: FloatArray, inverse: FloatArray) -> None:
    """Write ``exp(amount Ĥ_j)`` and its inverse to ``H`` and ``inverse``, (4, 4) each."""
    rate = screws.rates[j]
    if math.isnan(rate):
        whole, back = exp_twist(amount * screws.operators[j]), exp_twist(-amount * screws.operators[j])
        for i in range(4):
            for k in range(4):
                H[i, k], inverse[i, k] = whole[i, k], back[i, k]
        return
    first, second = _closed_form(rate, amount)
    G, square = screws.operators[j], screws.squares[j]
    for i in range(4):
        for k in range(4):
            odd, even = first * G[i, k], second * square[i, k]
            H[i, k], inverse[i, k] = even + odd, even - odd
        H[i, i] += 1.0
        inverse[i, i] += 1.0


@kernel
def displacement_into(screws: JointScrews, composition: int, step: FloatArray, H: FloatArray, work: FloatArray) -> None:
    """Write the displacement by ``step`` to ``H`` (4, 4). ``work`` (5, 4, 4): scratch; its last (4, 4) contains the sum
    of operators that move simultaneously afterwards.
    """
    n = step.shape[0]
    first, second, total = work[0], work[1], work[4]
    if composition == SIMULTANEOUS:
        for i in range(4):
            for k in range(4):
                s = 0.0
                for j in range(n):
                    s += step[j] * screws.operators[j, i, k]
                total[i, k] = s
        exponential_into(total, 1.0, first, second, H)
        return
    for i in range(4):
        for k in range(4):
            H[i, k] = 1.0 if i == k else 0.0
    for nth in range(n):
        j = n - 1 - nth if composition == TIP_FIRST else nth
        _exponential_pair_into(screws, j, step[j], first, second)
        multiply4_into(H, first, total)
        for i in range(4):
            for k in range(4):
                H[i, k] = total[i, k]


@kernel
def step_into(
    screws: JointScrews,
    composition: int,
    step: FloatArray,
    H: FloatArray,
    turned: FloatArray,
    work: FloatArray,
) -> None:
    """Write the displacement by ``step`` to ``H`` (4, 4), and the joint operators after it to ``turned`` (n, 4, 4).

    ``work`` (5, 4, 4): scratch.
    """
    operators = screws.operators
    n = step.shape[0]
    first, second, factor, inverse, total = work[0], work[1], work[2], work[3], work[4]
    if composition == SIMULTANEOUS:
        displacement_into(screws, composition, step, H, work)
        for j in range(n):
            for i in range(4):
                for k in range(4):
                    turned[j, i, k] = operators[j, i, k]
                    factor[i, k] = operators[j, i, k]
            for order in range(BRACKETS):
                multiply4_into(total, factor, first)
                multiply4_into(factor, total, second)
                for i in range(4):
                    for k in range(4):
                        factor[i, k] = (first[i, k] - second[i, k]) / (order + 2)
                        turned[j, i, k] += factor[i, k]
        return
    for i in range(4):
        for k in range(4):
            H[i, k] = 1.0 if i == k else 0.0
            inverse[i, k] = H[i, k]
    for nth in range(n):
        j = n - 1 - nth if composition == TIP_FIRST else nth
        multiply4_into(H, operators[j], total)
        multiply4_into(total, inverse, turned[j])
        _exponential_pair_into(screws, j, step[j], first, second)
        multiply4_into(H, first, total)
        multiply4_into(second, inverse, factor)
        for i in range(4):
            for k in range(4):
                H[i, k], inverse[i, k] = total[i, k], factor[i, k]


@kernel
def corrected_step(
    operators: FloatArray, composition: int, points: FloatArray, required: FloatArray, step: FloatArray
) -> FloatArray:
    """Joint step (n,) that displaces ``points`` (m, 4) to ``required`` (m, 4), by Newton's method from ``step`` (n,).

    The Jacobian is recomputed only in iterations after one that did not reduce the change to `STEEP` of the previous
    one. It ends if another iteration would change less than `CONVERGED`: changes decrease at least by the ratio of the
    last two.
    """
    n, count = step.shape[0], points.shape[0]
    found, best = step.copy(), step.copy()
    H, turned, work = np.empty((4, 4)), np.empty((n, 4, 4)), np.empty((5, 4, 4))
    N, b, change = np.empty((n, n)), np.empty(n), np.empty(n)
    rows = np.empty((count, 4, n))
    moved = np.empty((count, 4))
    screws = joint_screws(operators)
    before, last = math.inf, 0.0
    for j in range(n):
        last = max(last, abs(step[j]))
    relinearise = True
    for round_ in range(ITERATIONS):
        if relinearise:
            step_into(screws, composition, found, H, turned, work)
        else:
            displacement_into(screws, composition, found, H, work)
        transform_points_into(H, points, moved)
        error = 0.0
        for p in range(count):
            for i in range(4):
                error += (required[p, i] - moved[p, i]) ** 2
        if not error <= SLACK * before:
            break
        before = error
        for j in range(n):
            best[j] = found[j]
            b[j] = 0.0
        if relinearise:
            for j in range(n):
                for k in range(n):
                    N[j, k] = 0.0
            for p in range(count):
                for j in range(n):
                    velocity = product(turned[j], moved[p, 0], moved[p, 1], moved[p, 2], moved[p, 3])
                    for i in range(4):
                        rows[p, i, j] = velocity[i]
                for i in range(4):
                    add_equation(rows[p, i], required[p, i] - moved[p, i], 1.0, N, b)
            damped_solve(N, b, DAMPING, change)
        else:
            for p in range(count):
                for i in range(4):
                    residual = required[p, i] - moved[p, i]
                    for j in range(n):
                        b[j] += rows[p, i, j] * residual
            factor_solve(N, b, change)
        most = 0.0
        for j in range(n):
            found[j] += change[j]
            most = max(most, abs(change[j]))
        if most < CONVERGED or (round_ > 0 and most * min(1.0, most / last) < CONVERGED):
            for j in range(n):
                best[j] = found[j]
            break
        relinearise = not most < STEEP * last
        last = most
    return best


# -- near singularities -----------------------------------------------------------------------------------------

FREEDOMS = 6
SINGULAR = 2e-3
"""Singular value of the stacked operators, over the largest, below which the arm is near a singularity."""
LEAST_DAMPING = 1e-3
"""Damping of a motion that the arm has lost, relative to the largest singular value. Half of `SINGULAR`: the arm passes
through the singularity and leaves its line by the part that it cannot make there; exact steps would rotate a wrist by
half a turn beside it.
"""
SPANNED = 1e-3
"""Fraction of a bracket outside the known motions, below which it adds no new one."""
LOST = 0.5
"""Fraction of a motion that the damped step does not make, above which the joints start to leave the singularity."""
LEAVING = 100.0
"""Joint motion out of the singularity, relative to the lost motion in units of the largest singular value."""
LEAVING_RATE = 0.5
"""Largest velocity of that motion [rad/s or m/s]."""
EXACT = 1e-6
"""Fraction of the largest singular value below which the sign of the lost motion is undetermined."""
LEADS = 0.3
"""Least component of a unit vector by which a joint determines the sign."""


@kernel
def rigid_motions(operators: FloatArray, V: FloatArray, values: FloatArray) -> tuple[FloatArray, bool]:
    """Orthonormal operators (6, 4, 4) of all rigid motions, and whether the arm, near a singularity, determines them.

    The motions that the arm can still make well are taken from ``operators`` (n, 4, 4), by their singular vectors ``V``
    (n, n) and ``values`` (n,); the lost ones from their brackets (8.46), which are rigid motions, too.
    """
    n = operators.shape[0]
    found = np.zeros((FREEDOMS, 4, 4))
    count = 0
    while count < FREEDOMS and values[count] > SINGULAR * values[0]:
        for j in range(n):
            for i in range(4):
                for k in range(4):
                    found[count, i, k] += V[j, count] / values[count] * operators[j, i, k]
        count += 1
    left, best = np.empty((4, 4)), np.empty((4, 4))
    first, second = np.empty((4, 4)), np.empty((4, 4))
    while count < FREEDOMS:
        longest = 0.0
        for a in range(n):
            for b in range(a + 1, n):
                multiply4_into(operators[a], operators[b], first)
                multiply4_into(operators[b], operators[a], second)
                size = 0.0
                for i in range(4):
                    for k in range(4):
                        left[i, k] = first[i, k] - second[i, k]
                        size += left[i, k] ** 2
                rest = _without(found, count, left)
                if rest > SPANNED * SPANNED * size and rest > longest:
                    longest = rest
                    for i in range(4):
                        for k in range(4):
                            best[i, k] = left[i, k] / math.sqrt(rest)
        if longest == 0.0:
            return found, False
        for i in range(4):
            for k in range(4):
                found[count, i, k] = best[i, k]
        count += 1
    return found, True


@kernel
def _without(found: FloatArray, count: int, left: FloatArray) -> float:
    """Subtract from ``left`` (4, 4) its components along the first ``count`` of ``found``; returns the square of the
    remainder.
    """
    for _ in range(2):
        for h in range(count):
            along = 0.0
            for i in range(4):
                for k in range(4):
                    along += found[h, i, k] * left[i, k]
            for i in range(4):
                for k in range(4):
                    left[i, k] -= along * found[h, i, k]
    rest = 0.0
    for i in range(4):
        for k in range(4):
            rest += left[i, k] ** 2
    return rest


@kernel
def damped_step(
    operators: FloatArray, V: FloatArray, values: FloatArray, required: FloatArray, time_s: float
) -> FloatArray:
    """Damped joint step (n,) near a singularity, for the part of the motion ``required`` (4, 4) that the arm can make.

    If most of it is lost, the joints move along the direction that moves the body least (a stretched wrist: its first
    joint against its last), until the arm can make the required motion.

    ``V`` (n, n), ``values`` (n,): from `stacked_singular`.
    ``time_s``: duration of the step.
    """
    n = operators.shape[0]
    rank = min(n, FREEDOMS)
    step = np.zeros(n)
    left, image = required.copy(), np.empty((4, 4))
    whole = 0.0
    for i in range(4):
        for k in range(4):
            whole += required[i, k] ** 2
    for r in range(rank):
        _image_into(operators, V, r, image)
        along = 0.0
        for i in range(4):
            for k in range(4):
                along += image[i, k] * required[i, k]
        ratio = values[r] / (SINGULAR * values[0])
        damping = LEAST_DAMPING * values[0] * math.sqrt(max(0.0, 1.0 - ratio * ratio))
        amount = along / (values[r] ** 2 + damping**2)
        for j in range(n):
            step[j] += amount * V[j, r]
        for i in range(4):
            for k in range(4):
                left[i, k] -= amount * image[i, k]
    lost, pairing = 0.0, 0.0
    for i in range(4):
        for k in range(4):
            lost += left[i, k] ** 2
            pairing += image[i, k] * left[i, k]
    if lost > LOST * LOST * whole:
        lost = math.sqrt(lost)
        if not abs(pairing) > EXACT * values[0] * lost:
            pairing = 1.0
            for back in range(n):
                if abs(V[n - 1 - back, rank - 1]) > LEADS:
                    pairing = V[n - 1 - back, rank - 1]
        amount = math.copysign(min(LEAVING * lost / values[0], LEAVING_RATE * time_s), pairing)
        for j in range(n):
            step[j] += amount * V[j, rank - 1]
    return step


@kernel
def _image_into(operators: FloatArray, V: FloatArray, column: int, image: FloatArray) -> None:
    """The operator (4, 4) of the joint motion in a column of ``V``."""
    for i in range(4):
        for k in range(4):
            total = 0.0
            for j in range(operators.shape[0]):
                total += V[j, column] * operators[j, i, k]
            image[i, k] = total
