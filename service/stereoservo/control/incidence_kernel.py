"""Numba kernels of the incidence law (interface: `control.incidence`): linearised image errors of points, lines and
planes, damped least-squares joint velocity, second task in the null space.

A moving point X of the body and a fixed point, line or plane, ``base + Σ s_k d_k`` with ``base`` of height 1 and
directions of height 0, are compared in the images: ``A`` (2c, 4), the gradient of X's pixels in all cameras, converts
differences of points of height 1 into pixels. The residual is the part of ``A (X - base)`` outside the span of
``A d_k``: three, two or one conditions on X, whatever the number of cameras.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.laws.stereo import pixel_gradients
from stereoservo.kinematics.composition import CurrentArm, displace
from stereoservo.kinematics.kernels import transform_points
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import Fields, kernel
from stereoservo.numerics.linear import damped_least_squares, right_singular


class Seen(NamedTuple):
    """The arm (``operators`` (n, 4, 4), ``composition``) and the images of its b moving points, linearised at present.

    ``points`` (m, 4), of which ``at`` (b,) are compared with ``bases`` (b, 4) by ``gradients`` (b, 2c, 4), without the
    part in the span of the orthonormal ``tangents`` (b, 2, 2c).
    """

    operators: FloatArray
    composition: int
    points: FloatArray
    at: IntArray
    gradients: FloatArray
    tangents: FloatArray
    bases: FloatArray


RANK = 2e-4
"""Singular value of the scaled task Jacobian, relative to the largest, below which a direction is not used."""

STATIONARY = 0.02
"""Fraction of the residual that joints can still reduce to first order, below which the task is at rest."""

MOSTLY = 0.25
"""The same fraction if the reducible part is less than the tolerance: noise keeps it from vanishing."""

WORTH = 1e-3
"""Least relative decrease of the squared residual, in addition to the linear model's, for a motion that leaves a rest
position.
"""

PROBE = 0.25
"""Size of such a probing motion, relative to the residual."""

ATTEMPTS = 10
GROWTH = 8.0
SUFFICIENT = 0.25
"""The damping is increased until the predicted residual decreases by this fraction of the linear model's decrease."""

AHEAD = 0.1
"""Least fraction of a whole step at which the residual is predicted."""

MOVES, DONE, NOT_DRIVABLE, CONTRADICTS, NOT_FINITE = 0, 1, 2, 3, 4
"""As `incidence.IncidenceStatus`."""


@kernel
def _squared(seen: Seen, motion: FloatArray) -> float:
    """Squared residual [px²] after a ``motion`` (n,) of the joints, with constant gradients of the images."""
    points = transform_points(displace(seen.operators, seen.composition, motion), seen.points)
    total = 0.0
    rows = seen.gradients.shape[1]
    e = np.empty(rows)
    for b in range(seen.at.shape[0]):
        A = seen.gradients[b]
        for r in range(rows):
            e[r] = product(A, points[seen.at[b]], r) - product(A, seen.bases[b], r)
        project_out(seen.tangents[b], e)
        for r in range(rows):
            total += e[r] * e[r]
    return total


@kernel
def _reducible(J: FloatArray, e: FloatArray) -> float:
    """Squared part of ``e`` (r,) in the range of ``J`` (r, n), without small singular values."""
    rows, n = J.shape
    V, values = right_singular(J)
    part = 0.0
    for i in range(n):
        if not values[i] > RANK * values[0]:
            break
        c = 0.0
        for r in range(rows):
            for j in range(n):
                c += V[j, i] * J[r, j] * e[r]
        part += (c / values[i]) ** 2
    return part


class Constraints(NamedTuple):
    """``kinds`` (k,), ``markers`` (k, 3) indices into points, ``fixed`` (k, 3, 4), ``drift`` (4, 4) [1/s], as
    `incidence.IncidenceTask`.
    """

    kinds: IntArray
    markers: IntArray
    fixed: FloatArray
    drift: FloatArray


class Regulation(NamedTuple):
    """Parameters of the control: ``tolerance_px`` within which an incidence is done; ``gain`` [1/s], ``dt_s`` [s] and
    ``damping`` as in `control.law.Options`; ``metric`` (n,) > 0: cost of a unit of each joint's motion.
    """

    tolerance_px: float
    gain: float
    dt_s: float
    damping: float
    metric: FloatArray


class SecondTask(NamedTuple):
    """A task for the remaining degrees of freedom: ``rows`` (r, n) times the velocity shall equal ``rates`` (r,).

    ``weights`` (r,): 1/sigma of the rates, 0 for a row that is not used. Build it by `no_second_task`, `joint_task`,
    `limits_task`, `image_task`.
    """

    rows: FloatArray
    rates: FloatArray
    weights: FloatArray


class Linearization(NamedTuple):
    """The incidences to first order.

    ``J`` (b·2c, n), ``e`` (b·2c,) [px]: by the ``metric``, rows of a constraint's moving points.
    ``rates`` (b·2c,) [px/s]: rates at which the features leave these points on their own.
    ``owner`` (b,): constraint of each block.
    ``error`` (k,) [px]: of the constraints.
    ``finite``: whether all values are finite.
    """

    J: FloatArray
    e: FloatArray
    rates: FloatArray
    owner: IntArray
    error: FloatArray
    finite: bool


class Decomposition(NamedTuple):
    """Right singular vectors ``V`` and ``values`` of a Jacobian; ``along`` (n,): the error's components, 0 beyond
    ``rank``; squares of the error in ``total`` and its reducible ``part``; ``conditioning``; reducible ``share``.
    """

    V: FloatArray
    values: FloatArray
    along: FloatArray
    total: float
    rank: int
    part: float
    conditioning: float
    share: float


@kernel
def _linearized(
    arm: CurrentArm, matrices: FloatArray, points: FloatArray, constraints: Constraints, metric: FloatArray
) -> tuple[Seen, Linearization]:
    operators, composition = arm
    kinds, markers, fixed, drift = constraints
    n, count, rows = operators.shape[0], kinds.shape[0], 2 * matrices.shape[0]
    error = np.zeros(count)
    blocks = 0
    for k in range(count):
        blocks += moving_count(kinds[k])
    at = np.empty(blocks, dtype=np.int64)
    owner = np.empty(blocks, dtype=np.int64)
    gradients = np.empty((blocks, rows, 4))
    tangents = np.empty((blocks, 2, rows))
    bases = np.empty((blocks, 4))
    J = np.empty((blocks * rows, n))
    e = np.empty(blocks * rows)
    rates = np.empty(blocks * rows)
    column = np.empty(rows)
    moved = np.empty(4)
    b = 0
    finite = True
    for k in range(count):
        for i in range(moving_count(kinds[k])):
            X = points[markers[k, i]]
            A = pixel_gradients(matrices, X)
            T, D = feature_tangents(A, fixed[k], fixed_dimension(kinds[k]))
            at[b], owner[b] = markers[k, i], k
            gradients[b], tangents[b], bases[b] = A, T, fixed[k, 0]
            for r in range(rows):
                column[r] = product(A, X, r) - product(A, bases[b], r)
            project_out(T, column)
            for r in range(rows):
                e[b * rows + r] = column[r]
                finite = finite and math.isfinite(column[r])
            for j in range(-1, n):
                operator = drift if j < 0 else operators[j]
                for r in range(4):
                    moved[r] = product(operator, X, r)
                for r in range(rows):
                    column[r] = product(A, moved, r)
                project_out(T, column)
                for r in range(rows):
                    if j < 0:
                        rates[b * rows + r] = column[r]
                    else:
                        J[b * rows + r, j] = column[r] / metric[j]
                    finite = finite and math.isfinite(column[r])
            distance = image_distance(matrices, A, T, D, X, bases[b])
            if not distance <= error[k]:
                error[k] = distance
            b += 1
    seen = Seen(operators, composition, points, at, gradients, tangents, bases)
    return seen, Linearization(J, e, rates, owner, error, finite)


@kernel
def _decomposed(J: FloatArray, e: FloatArray) -> Decomposition:
    rows, n = J.shape
    V, values = right_singular(J)
    along = np.zeros(n)
    for i in range(n):
        for r in range(rows):
            s = 0.0
            for j in range(n):
                s += J[r, j] * V[j, i]
            along[i] += s * e[r]
    total = 0.0
    for r in range(rows):
        total += e[r] * e[r]
    rank = 0
    part = 0.0
    for i in range(n):
        if values[i] > RANK * values[0]:
            rank += 1
            part += (along[i] / values[i]) ** 2
        else:
            along[i] = 0.0
    conditioning = (values[rank - 1] / values[0]) ** 2 if rank > 0 else 0.0
    share = math.sqrt(min(1.0, part / total)) if total > 0.0 else 1.0
    return Decomposition(V, values, along, total, rank, part, conditioning, share)


@kernel
def incidence_kernel(
    arm: Fields,
    matrices: FloatArray,
    points: FloatArray,
    constraints: Fields,
    regulation: Fields,
    second: Fields,
) -> tuple[FloatArray, FloatArray, IntArray, int, float, float]:
    """Velocity (n,), error (k,) [px], status (k,), rank, conditioning, reducible share; see `incidence.IncidenceStep`.

    ``points`` (m, 4) in cameras ``matrices`` (c, 3, 4); the fields of a `CurrentArm`, of `Constraints`, a `Regulation`
    and a `SecondTask`.
    """
    held, rest = Constraints(*constraints), SecondTask(*second)
    tolerance_px, gain, dt_s, damping, metric = Regulation(*regulation)
    n, count = arm[0].shape[0], held.kinds.shape[0]
    velocity = np.zeros(n)
    status = np.zeros(count, dtype=np.int64)
    seen, linear = _linearized(CurrentArm(*arm), matrices, points, held, metric)
    error = linear.error
    if not linear.finite:
        for k in range(count):
            status[k] = NOT_FINITE
        return velocity, error, status, 0, 0.0, 0.0
    found = _decomposed(linear.J, linear.e)
    rank, total, part, share = found.rank, found.total, found.part, found.share

    within = True
    for k in range(count):
        if error[k] <= tolerance_px:
            status[k] = DONE
        else:
            within = False
    step = np.zeros(n)
    escaped = False
    if not within and (not share > STATIONARY or (share < MOSTLY and math.sqrt(part) <= tolerance_px)):
        escaped = _escape_step(seen, found.V, metric, total, part, step)
        if not escaped:
            _blame(linear.J, linear.e, linear.owner, 2 * matrices.shape[0], status)
    if not escaped and rank > 0:
        ahead = min(1.0, max(gain * dt_s, AHEAD))
        _damped_step(seen, found, metric, damping, ahead, step)
    for j in range(n):
        velocity[j] = gain * step[j]
    _feed_forward(velocity, linear, found, metric, damping)
    _second_task(velocity, found, rest, metric, damping)
    return velocity, error, status, rank, found.conditioning, share


@kernel
def _feed_forward(
    velocity: FloatArray, linear: Linearization, found: Decomposition, metric: FloatArray, damping: float
) -> None:
    """Add to ``velocity`` (n,) the least motion that keeps the moving points on features which move on their own."""
    n = velocity.shape[0]
    V, values = found.V, found.values
    for i in range(found.rank):
        along = 0.0
        for r in range(linear.rates.shape[0]):
            image = 0.0
            for j in range(n):
                image += linear.J[r, j] * V[j, i]
            along += image * linear.rates[r]
        along /= values[i] * values[i] + damping * values[0] * values[0]
        for j in range(n):
            velocity[j] += V[j, i] * along / metric[j]


@kernel
def _damped_step(
    seen: Seen, found: Decomposition, metric: FloatArray, damping: float, ahead: float, step: FloatArray
) -> None:
    """Compute a step (n,) of damped least squares whose predicted residual decreases as in the linear model."""
    n = step.shape[0]
    V, values, along, total = found.V, found.values, found.along, found.total
    largest = values[0] * values[0]
    damp = damping * largest
    trial = np.empty(n)
    for _ in range(ATTEMPTS):
        predicted = 0.0
        for i in range(n):
            q = values[i] * values[i] + damp
            predicted += along[i] * along[i] / q * (2.0 * ahead - ahead * ahead * values[i] * values[i] / q)
        for j in range(n):
            s = 0.0
            for i in range(n):
                s -= V[j, i] * along[i] / (values[i] * values[i] + damp)
            step[j] = s / metric[j]
            trial[j] = ahead * step[j]
        # Below it the rounding of the residual itself would decide.
        if predicted <= 1e-12 * total:
            break
        left = _squared(seen, trial)
        if total - left >= SUFFICIENT * predicted:
            break
        damp = max(GROWTH * damp, 1e-3 * largest)


@kernel
def _escape_step(
    seen: Seen,
    V: FloatArray,
    metric: FloatArray,
    total: float,
    part: float,
    step: FloatArray,
) -> bool:
    """At rest far from the goal: the motion along a singular direction, of either sign, that reduces the residual most;
    returns whether there is one.

    It leaves a maximum of the error (a line exactly across its target, half a turn), where the gradient vanishes.
    """
    n = step.shape[0]
    size = PROBE * math.sqrt(total / seen.at.shape[0])
    best = (1.0 - WORTH) * total - part
    trial = np.empty(n)
    found = False
    for back in range(n):
        i = n - 1 - back
        for sense in range(2):
            for j in range(n):
                trial[j] = (size if sense == 0 else -size) * V[j, i] / metric[j]
            left = _squared(seen, trial)
            if left < best:
                best = left
                found = True
                for j in range(n):
                    step[j] = trial[j]
    return found


@kernel
def _blame(J: FloatArray, e: FloatArray, owner: IntArray, rows: int, status: IntArray) -> None:
    """Set the status of incidences that cannot be reached: if one could be moved alone, it contradicts others; else the
    arm cannot move it here.
    """
    for k in range(status.shape[0]):
        if status[k] == DONE:
            continue
        first = 0
        count = 0
        for b in range(owner.shape[0]):
            if owner[b] == k:
                if count == 0:
                    first = b
                count += 1
        own = J[first * rows : (first + count) * rows]
        left = e[first * rows : (first + count) * rows]
        total = 0.0
        for r in range(count * rows):
            total += left[r] * left[r]
        drivable = _reducible(own, left) > MOSTLY * MOSTLY * total
        status[k] = CONTRADICTS if drivable else NOT_DRIVABLE


@kernel
def _second_task(
    velocity: FloatArray, found: Decomposition, second: SecondTask, metric: FloatArray, damping: float
) -> None:
    """Add to ``velocity`` (n,) the second task in the first one's null space: ``(S N)⁺ (ṡ - S q̇₁)``."""
    V, rank = found.V, found.rank
    rows, rates, weights = second
    n = velocity.shape[0]
    count = rates.shape[0]
    if rank == n or count == 0:
        return
    # In joint coordinates, by the projector: otherwise damping would depend on the choice of a basis of the null space.
    projector = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            for k in range(rank, n):
                projector[i, j] += V[i, k] * V[j, k]
    S = np.zeros((count, n))
    left = np.zeros(count)
    for r in range(count):
        if weights[r] == 0.0:
            continue
        left[r] = rates[r]
        for j in range(n):
            left[r] -= rows[r, j] * velocity[j]
            for i in range(n):
                S[r, i] += rows[r, j] / metric[j] * projector[j, i]
    y, _ = damped_least_squares(S, left, weights, damping)
    for j in range(n):
        velocity[j] += y[j] / metric[j]


METRIC_FLOOR = 0.01
"""Least metric of a joint, relative to the largest: a joint that moves nothing in the images still has a cost."""

DROPPED = 1e-9
"""Length [px, relative to that of the direction before it] below which a direction is not independent."""


@kernel
def moving_count(kind: int) -> int:
    """Number of points that span the moving feature."""
    return 3 if kind == 5 else (2 if kind >= 3 else 1)


@kernel
def fixed_dimension(kind: int) -> int:
    """Dimension of the fixed feature: 0 a point, 1 a line, 2 a plane."""
    return 0 if kind == 0 else (1 if kind == 1 or kind == 3 else 2)


@kernel
def joint_metric(operators: FloatArray, matrices: FloatArray, points: FloatArray) -> FloatArray:
    """Rms image motion of the points by each joint: (n,) [px/rad or px/m]."""
    n, m, cameras = operators.shape[0], points.shape[0], matrices.shape[0]
    metric = np.zeros(n)
    for p in range(m):
        A = pixel_gradients(matrices, points[p])
        for j in range(n):
            for r in range(2 * cameras):
                s = 0.0
                for i in range(4):
                    moved = 0.0
                    for k in range(4):
                        moved += operators[j, i, k] * points[p, k]
                    s += A[r, i] * moved
                metric[j] += s * s
    largest = 0.0
    for j in range(n):
        metric[j] = math.sqrt(metric[j] / (cameras * m))
        largest = max(largest, metric[j])
    for j in range(n):
        if not metric[j] > METRIC_FLOOR * largest:
            metric[j] = METRIC_FLOOR * largest
        if not metric[j] > 0.0:
            metric[j] = 1.0
    return metric


@kernel
def product(A: FloatArray, x: FloatArray, r: int) -> float:
    """Row ``r`` of ``A`` (k, 4) times ``x`` (4,)."""
    return float(A[r, 0] * x[0] + A[r, 1] * x[1] + A[r, 2] * x[2] + A[r, 3] * x[3])


@kernel
def feature_tangents(A: FloatArray, fixed: FloatArray, dimension: int) -> tuple[FloatArray, FloatArray]:
    """Orthonormal ``T`` (2, 2c) and directions ``D`` (2, 4) with ``A D_k = T_k``; zero rows if there are fewer."""
    rows = A.shape[0]
    T = np.zeros((2, rows))
    D = np.zeros((2, 4))
    for k in range(dimension):
        before = 0.0
        for r in range(rows):
            T[k, r] = product(A, fixed[1 + k], r)
            before += T[k, r] * T[k, r]
        for i in range(4):
            D[k, i] = fixed[1 + k, i]
        for _ in range(2):  # twice: orthogonal to rounding
            for j in range(k):
                s = 0.0
                for r in range(rows):
                    s += T[j, r] * T[k, r]
                for r in range(rows):
                    T[k, r] -= s * T[j, r]
                for i in range(4):
                    D[k, i] -= s * D[j, i]
        after = 0.0
        for r in range(rows):
            after += T[k, r] * T[k, r]
        size = math.sqrt(after) if after > DROPPED * DROPPED * before else 0.0
        for r in range(rows):
            T[k, r] = T[k, r] / size if size > 0.0 else 0.0
        for i in range(4):
            D[k, i] = D[k, i] / size if size > 0.0 else 0.0
    return T, D


@kernel
def project_out(T: FloatArray, x: FloatArray) -> None:
    """Remove from ``x`` (2c,) its components along the orthonormal rows of ``T`` (2, 2c)."""
    for k in range(2):
        s = 0.0
        for r in range(x.shape[0]):
            s += T[k, r] * x[r]
        for r in range(x.shape[0]):
            x[r] -= s * T[k, r]


@kernel
def image_distance(
    matrices: FloatArray, A: FloatArray, T: FloatArray, D: FloatArray, X: FloatArray, base: FloatArray
) -> float:
    """Largest distance [px] over the cameras between the images of ``X`` (4,) and of its nearest point of the feature.

    To first order if that point is not in front of a camera as X is.
    """
    rows = A.shape[0]
    Y = base.copy()
    first = np.empty(rows)
    for r in range(rows):
        first[r] = product(A, X, r) - product(A, base, r)
    for k in range(2):
        s = 0.0
        for r in range(rows):
            s += T[k, r] * first[r]
        for i in range(4):
            Y[i] += s * D[k, i]
    project_out(T, first)
    worst = 0.0
    for c in range(rows // 2):
        P = matrices[c]
        here = product(P, X, 2)
        there = product(P, Y, 2)
        if here * there > 0.0:
            du = product(P, X, 0) / here - product(P, Y, 0) / there
            dv = product(P, X, 1) / here - product(P, Y, 1) / there
        else:
            du, dv = first[2 * c], first[2 * c + 1]
        size = math.sqrt(du * du + dv * dv)
        if not size <= worst:
            worst = size
    return worst
