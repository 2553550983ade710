"""Numba kernels of an arm's mobility at its current posture: drivable degrees of freedom by singular values, joints to
block near a singularity, self-motion away from joint limits.

Degrees of freedom are measured by the motion of the body's points in orthogonal coordinates of any unit: ``rows`` (3m,
n) is their Jacobian (`point_jacobian`). Pixels would distinguish sideways motion from depth, not strong joints from
weak ones. No BLAS, LAPACK or fastmath.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.numerics.arrays import BoolArray, FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import add_equation, right_singular
from stereoservo.planning.visibility_constraints import limit_pull

LOST = 1e-3
"""Singular value, relative to the largest, below which a degree of freedom is lost; the operators are estimates."""

TALL = 512
"""Number of rows of a Jacobian above which its singular values are computed by its normal matrix, in one pass over the
rows. Their errors are then 1e-8 of the largest; `LOST` requires 1e-3.
"""

EQUAL = 0.05
"""Difference of two joints' components in a lost degree of freedom that is not significant: the joint nearer to the
base is taken.
"""


def multiply(A: FloatArray, B: FloatArray) -> FloatArray:
    """``A B`` (r, c) of small matrices (r, k) and (k, c), transposed ones and slices too: one compiled kernel."""
    return _multiply(np.ascontiguousarray(A), np.ascontiguousarray(B))


@kernel
def _multiply(A: FloatArray, B: FloatArray) -> FloatArray:
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            for k in range(A.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@kernel
def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """``a x b`` (3,)."""
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@kernel
def brackets(twists: FloatArray) -> FloatArray:
    """Twists (k, 6), ``v`` before ``w``, and below them the brackets of all pairs, (k + k(k - 1)/2, 6)."""
    k = twists.shape[0]
    out = np.empty((k + k * (k - 1) // 2, 6))
    row = k
    for i in range(k):
        out[i] = twists[i]
        for j in range(i):
            a, b = twists[i], twists[j]
            out[row, :3] = cross(a[3:], b[:3]) - cross(b[3:], a[:3])
            out[row, 3:] = cross(a[3:], b[3:])
            row += 1
    return out


@kernel
def least_squares(A: FloatArray, b: FloatArray) -> FloatArray:
    """The ``x`` (n,) of least norm with least ``|A x - b|`` for ``A`` (r, n), ``b`` (r,); singular values below `LOST`
    are left out.
    """
    V, values = right_singular(A)
    n = values.shape[0]
    x = np.zeros(n)
    for i in range(n):
        if not values[i] > LOST * values[0]:
            break
        along = 0.0
        for r in range(A.shape[0]):
            for j in range(n):
                along += A[r, j] * V[j, i] * b[r]
        for j in range(n):
            x[j] += V[j, i] * along / (values[i] * values[i])
    return x


@kernel
def point_jacobian(operators: FloatArray, points: FloatArray, form: FloatArray) -> FloatArray:
    """Jacobian (3m, n) of points (m, 4) of height 1: ``form (Ĥ_j M)``, divided by the square root of m.

    ``form`` (3, 4) maps differences of points to orthogonal coordinates: the upper rows of the inverse of
    `mobility.body_frame`, which are valid as long as the model, for every pose.
    """
    n, m = operators.shape[0], points.shape[0]
    rows = np.empty((3 * m, n))
    size = 1.0 / math.sqrt(m)
    moved = np.empty(4)
    for p in range(m):
        for j in range(n):
            for i in range(4):
                moved[i] = (
                    operators[j, i, 0] * points[p, 0]
                    + operators[j, i, 1] * points[p, 1]
                    + operators[j, i, 2] * points[p, 2]
                    + operators[j, i, 3] * points[p, 3]
                )
            for r in range(3):
                rows[3 * p + r, j] = size * (
                    form[r, 0] * moved[0] + form[r, 1] * moved[1] + form[r, 2] * moved[2] + form[r, 3] * moved[3]
                )
    return rows


@kernel
def _scaled(rows: FloatArray, unit: FloatArray) -> FloatArray:
    out = np.empty(rows.shape)
    for r in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            out[r, j] = rows[r, j] * unit[j]
    return out


@kernel
def drivable_freedoms(rows: FloatArray, unit: FloatArray) -> tuple[int, FloatArray, FloatArray]:
    """Number of the body's degrees of freedom that the arm can drive here, singular values (n,), descending, joint
    motions as columns (n, n).

    ``rows`` (r, n); ``unit`` (n,) > 0 [rad or m]: equivalent amounts of each joint's motion; columns are in units. 0
    and NaN if ``rows`` are not finite.
    """
    J = _scaled(rows, unit)
    n = unit.shape[0]
    total = 0.0
    for r in range(J.shape[0]):
        for j in range(n):
            total += abs(J[r, j])
    if not math.isfinite(total):
        return 0, np.full(n, math.nan), np.full((n, n), math.nan)
    if J.shape[0] > TALL:
        V, values = right_singular(_normal_matrix(J))
        for i in range(n):
            values[i] = math.sqrt(values[i])
    else:
        V, values = right_singular(J)
    rank = 0
    for i in range(n):
        if values[i] > LOST * values[0]:
            rank += 1
    return rank, values, V


@kernel
def _normal_matrix(J: FloatArray) -> FloatArray:
    """``JᵀJ`` (n, n) of ``J`` (r, n)."""
    n = J.shape[1]
    N, nothing = np.zeros((n, n)), np.zeros(n)
    for r in range(J.shape[0]):
        add_equation(J[r], 0.0, 1.0, N, nothing)
    for i in range(n):
        for k in range(i):
            N[k, i] = N[i, k]
    return N


@kernel
def joints_to_block(rows: FloatArray, unit: FloatArray, capacity: int, least: float) -> BoolArray:
    """Joints (n,) to block so that the others drive all drivable degrees of freedom without large motions for a small
    effect.

    As many as there are singular values below ``least`` times the largest, among the ``capacity`` degrees of freedom
    that such an arm has in other postures (6 for six joints, 4 for a SCARA): self-motions of a redundant arm block no
    joint. In each round the joint with the largest component in the weak motions of the remaining ones is taken.
    """
    J = _scaled(rows, unit)
    n = J.shape[1]
    blocked = np.zeros(n, dtype=np.bool_)
    for _ in range(n):
        left = 0
        for j in range(n):
            if not blocked[j]:
                left += 1
        rest = np.empty((J.shape[0], left))
        index = np.empty(left, dtype=np.int64)
        k = 0
        for j in range(n):
            if not blocked[j]:
                index[k] = j
                for r in range(J.shape[0]):
                    rest[r, k] = J[r, j]
                k += 1
        V, values = right_singular(rest)
        strong = 0
        for i in range(left):
            if values[i] > least * values[0]:
                strong += 1
        if left - strong <= max(n - capacity, 0) or strong == 0:
            break
        parts = np.zeros(left)
        most = 0.0
        for k in range(left):
            for i in range(strong, left):
                parts[k] += V[k, i] * V[k, i]
            most = max(most, parts[k])
        chosen = 0
        while parts[chosen] < most - EQUAL:
            chosen += 1
        blocked[index[chosen]] = True
    return blocked


@kernel
def self_motion_from_limits(
    rows: FloatArray, positions: FloatArray, lower: FloatArray, upper: FloatArray, rate: float
) -> FloatArray:
    """A joint velocity (n,) that does not move the body and moves joints from their limits towards the centre.

    ``rows`` (r, n): `point_jacobian`, or an image Jacobian.
    ``positions``, ``lower``, ``upper`` (n,) [rad or m]: infinite for a joint without limits.
    ``rate`` [1/s]: no joint is faster than half its range times ``rate`` (without limits: 1 rad or m times it).

    The pull increases with the cube of the distance from the centre. A motion fades out as it starts to move the body;
    an arm without self-motions rests.
    """
    n = positions.shape[0]
    pull, half = limit_pull(positions, lower, upper)
    out = np.zeros(n)
    _, values, V = drivable_freedoms(rows, half)
    if not math.isfinite(values[0]):
        return out
    for i in range(n):
        if values[0] > 0.0:
            relative = values[i] / (LOST * values[0])
            fade = max(0.0, 1.0 - relative * relative)
        else:
            fade = 1.0
        if fade == 0.0:
            continue
        s = 0.0
        for j in range(n):
            s += V[j, i] * pull[j]
        for j in range(n):
            out[j] += fade * s * V[j, i]
    fastest = 1.0
    for j in range(n):
        fastest = max(fastest, abs(out[j]))
    for j in range(n):
        out[j] *= rate * half[j] / fastest
        if not math.isfinite(out[j]):
            out[j] = 0.0
    return out
