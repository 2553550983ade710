"""The motion of a target, a rigid body that is carried neither by the arm nor with the cameras: pose, twist and rate of
twist with their covariance, by a Kalman filter on the pixels of its markers.

The pose is a displacement ``D`` (4, 4) of its reference points in the model's frame, whatever that frame is. Twists are
in a ``basis`` (6, 4, 4) of the displacements that is scaled so that a unit moves the markers by one pixel rms. If the
model is metric, targets are assumed to accelerate equally in all directions, so motion along the rays, which is ten
times less visible, is tracked more slowly. If it is not metric, they are assumed to accelerate equally in the images.
The rate of the twist is a Gauss-Markov process (Singer 1970): it is estimated while images arrive, and decays when they
do not.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from stereoservo.core.model_arrays import ModelArrays
from stereoservo.geometry.displacements import similarity_from_points
from stereoservo.geometry.homogeneous import GeometryError, from_homogeneous, move_points
from stereoservo.kinematics.kernels import (
    exp_twist,
    image_jacobian,
    invert4,
    multiply4_into,
    project_points,
    transform_points,
    triangulate,
)
from stereoservo.numerics.arrays import BoolArray, FloatArray, IntArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import damped_least_squares

FREEDOMS = 6
ACCELERATION_PX = 30.0
"""Rms acceleration of a target's markers [px/s²], and the time constant [s] with which it changes."""
TURNS = 0.0125
"""Fraction of it by which rotations of a target about its own centroid move its markers."""
ACCELERATION_S = 0.6
SPEED_PX = 100.0
"""Standard deviation of the speed of a target that was just found [px/s]."""
FOUND_PX = 3.0
"""Standard deviation of the pose of a target that was just found [px]."""
OBSERVATION_PX = 0.05
"""Standard deviation of an observation in addition to its detector's [px]: the body's shape is not exact."""


class TargetBody(msgspec.Struct, eq=False, kw_only=True):
    """A moving target, tracked in the images.

    Markers ``ids`` (k,), ascending, at ``points`` (k, 4) of the model's frame when ``displacement`` (4, 4) is the
    identity; ``carried``: the arm carries the cameras, and the target is the model's marker body, seen through the
    arm's joints.
    ``twist`` [1/s] and ``rate`` [1/s²] (6,) in the ``basis`` (6, 4, 4), ``covariance`` (18, 18) of pose, twist and
    rate, at ``t_ns``; 0: not found yet.

    By camera: ``seen_ns`` (c,), the shutter time of its last frame with enough markers; ``odd_ns`` (c,), of the last
    one that the motion did not explain, 0 if a later one was explained; ``told`` (c,): whether its estimate was reset
    since the target was found. ``drift`` (6, 6): covariance of accelerations in the basis. ``odd``: consecutive steps
    with such frames of all cameras. ``first`` (c, k, 2) [px] with ``first_seen`` (c, k): observations from which the
    target is found, while it is not found yet; ``stated``: ``points`` are known in advance; ``rest_px``: the residual
    of the best pose, if none explained these observations.

    ``mark`` (4, 4): its pose at ``mark_ns``; ``farthest_px``: displacement of its markers since; ``still``: they did
    not move in the interval before.
    """

    ids: IntArray
    points: FloatArray
    carried: bool
    stated: bool
    displacement: FloatArray
    twist: FloatArray
    rate: FloatArray
    covariance: FloatArray
    basis: FloatArray
    drift: FloatArray
    seen_ns: IntArray
    odd_ns: IntArray
    told: BoolArray
    first: FloatArray
    first_seen: FloatArray
    t_ns: int = 0
    odd: int = 0
    mark: FloatArray
    mark_ns: int = 0
    farthest_px: float = 0.0
    still: bool = True
    rest_px: float = 0.0


def target_body(ids: IntArray, points: FloatArray | None, cameras: int, *, carried: bool) -> TargetBody:
    """A target that is not found yet; ``points`` (k, 4): its markers, None if they are not known in advance."""
    k = len(ids)
    return TargetBody(
        ids=ids, points=np.zeros((k, 4)) if points is None else points.copy(), carried=carried,
        stated=points is not None, displacement=np.eye(4), twist=np.zeros(FREEDOMS), rate=np.zeros(FREEDOMS),
        covariance=np.zeros((3 * FREEDOMS, 3 * FREEDOMS)), basis=np.zeros((FREEDOMS, 4, 4)), drift=np.eye(FREEDOMS),
        seen_ns=np.zeros(cameras, np.int64), odd_ns=np.zeros(cameras, np.int64), told=np.zeros(cameras, np.bool_),
        first=np.zeros((cameras, k, 2)), first_seen=np.zeros((cameras, k)), mark=np.eye(4),
    )  # fmt: skip


def begin(
    body: TargetBody, basis: FloatArray, metric: bool, matrices: FloatArray, carrier: FloatArray, t_ns: int
) -> bool:
    """Initialise the target at its ``displacement`` at ``t_ns``, with unknown motion; returns whether its markers
    determine all six degrees of freedom.

    ``basis`` (6, 4, 4): displacements; in a ``metric`` frame three translations and three rotations about any point,
    that move a body of its size equally.
    ``matrices`` (c, 3, 4): the cameras, which see it through ``carrier`` (4, 4).
    """
    here = transform_points(body.displacement, body.points)
    if metric:
        basis = turns_about(basis, here, TURNS)
    scaled, drift, good = scaled_basis(basis, matrices, carrier, here)
    if not good:
        return False
    body.basis[:] = scaled
    body.drift[:] = drift if metric else np.eye(FREEDOMS)
    body.twist[:], body.rate[:] = 0.0, 0.0
    widen(body, FOUND_PX)
    body.t_ns, body.odd, body.odd_ns[:], body.told[:], body.rest_px = t_ns, 0, 0, False, 0.0
    body.mark[:], body.mark_ns, body.farthest_px, body.still = body.displacement, t_ns, 0.0, False
    return True


def widen(body: TargetBody, pose_px: float) -> None:
    """Reset the uncertainty: the pose is known to ``pose_px``, the motion is unknown."""
    body.covariance[:] = 0.0
    for k, block in enumerate(
        (pose_px**2 * np.eye(FREEDOMS), SPEED_PX**2 * body.drift, ACCELERATION_PX**2 * body.drift)
    ):
        body.covariance[FREEDOMS * k : FREEDOMS * (k + 1), FREEDOMS * k : FREEDOMS * (k + 1)] = block


def variance_of_carried(body: TargetBody | None) -> float:
    """Uncertainty of a carried target's markers in the images, due to its motion since it was last seen and tracked:
    variance [px²] of a coordinate; 0 if the body is not the target.
    """
    return float(np.trace(body.covariance[:FREEDOMS, :FREEDOMS])) if body is not None and body.carried else 0.0


@kernel
def solve_into(M: FloatArray, X: FloatArray) -> None:
    """``M⁻¹ X`` (n, k) in place, by elimination with pivots; ``M`` (n, n) is overwritten."""
    n, k = X.shape
    for i in range(n):
        pivot = i
        for row in range(i + 1, n):
            if abs(M[row, i]) > abs(M[pivot, i]):
                pivot = row
        for j in range(n):
            M[i, j], M[pivot, j] = M[pivot, j], M[i, j]
        for j in range(k):
            X[i, j], X[pivot, j] = X[pivot, j], X[i, j]
        for row in range(n):
            if row == i:
                continue
            share = M[row, i] / M[i, i]
            for j in range(i, n):
                M[row, j] -= share * M[i, j]
            for j in range(k):
                X[row, j] -= share * X[i, j]
    for i in range(n):
        for j in range(k):
            X[i, j] /= M[i, i]


@kernel
def turns_about(basis: FloatArray, points: FloatArray, share: float) -> FloatArray:
    """The ``basis`` (6, 4, 4), translations and rotations, with its rotations replaced by ones about the centroid of
    ``points`` (k, 4) of unit height, scaled by a ``share``.
    """
    centroid, moved = np.zeros(4), np.zeros((FREEDOMS, 4))
    for i in range(points.shape[0]):
        for a in range(4):
            centroid[a] += points[i, a] / points.shape[0]
    for k in range(FREEDOMS):
        for a in range(4):
            for b in range(4):
                moved[k, a] += basis[k, a, b] * centroid[b]
    N, along = np.zeros((3, 3)), np.zeros((3, 3))  # Σ x_j T_j M = R_k M
    for i in range(3):
        for a in range(4):
            for j in range(3):
                N[i, j] += moved[i, a] * moved[j, a]
                along[i, j] += moved[i, a] * moved[3 + j, a]
    solve_into(N, along)
    found = basis.copy()
    for k in range(3):
        for a in range(4):
            for b in range(4):
                for j in range(3):
                    found[3 + k, a, b] -= along[j, k] * basis[j, a, b]
                found[3 + k, a, b] *= share
    return found


@kernel
def scaled_basis(
    basis: FloatArray, matrices: FloatArray, carrier: FloatArray, points: FloatArray
) -> tuple[FloatArray, FloatArray, bool]:
    """The ``basis`` (6, 4, 4) recombined so that each element moves the pixels of ``points`` (k, 4) by 1 px rms,
    independently of the others. Also returns the covariance (6, 6) in the new basis of a motion distributed equally
    over the old one, at 1 px rms; and whether the basis could be computed.
    """
    J = image_jacobian(seen_through(basis, carrier), matrices, transform_points(carrier, points)).reshape(
        (-1, FREEDOMS)
    )
    N = np.zeros((FREEDOMS, FREEDOMS))
    count = 0
    for row in range(J.shape[0]):
        count += 1
        for i in range(FREEDOMS):
            for j in range(FREEDOMS):
                N[i, j] += J[row, i] * J[row, j]
    N /= float(max(count, 1))
    scaled, drift, trace = np.zeros((FREEDOMS, 4, 4)), np.eye(FREEDOMS), 0.0
    for i in range(FREEDOMS):
        trace += N[i, i] / FREEDOMS
    # N = L Lᵀ; twists T = L⁻ᵀ have Tᵀ N T = 1.
    L = np.zeros((FREEDOMS, FREEDOMS))
    for i in range(FREEDOMS):
        for j in range(i + 1):
            total = N[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if not total > 1e-12 * N[i, i]:
                    return scaled, drift, False
                L[i, i] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    column = np.zeros(FREEDOMS)
    for k in range(FREEDOMS):  # Lᵀ x = e_k
        for i in range(FREEDOMS - 1, -1, -1):
            total = 1.0 if i == k else 0.0
            for j in range(i + 1, FREEDOMS):
                total -= L[j, i] * column[j]
            column[i] = total / L[i, i]
        for i in range(FREEDOMS):
            for a in range(4):
                for b in range(4):
                    scaled[k, a, b] += column[i] * basis[i, a, b]
    for i in range(FREEDOMS):  # Lᵀ L
        for j in range(FREEDOMS):
            drift[i, j] = 0.0
            for k in range(FREEDOMS):
                drift[i, j] += L[k, i] * L[k, j] / trace
    return scaled, drift, True


@kernel
def seen_through(basis: FloatArray, carrier: FloatArray) -> FloatArray:
    """Twists (6, 4, 4) as seen through a ``carrier`` C (4, 4): ``C Ĝ C⁻¹``."""
    inverse, half, out = invert4(carrier), np.empty((4, 4)), np.empty(basis.shape)
    for k in range(basis.shape[0]):
        multiply4_into(carrier, basis[k], half)
        multiply4_into(half, inverse, out[k])
    return out


@kernel
def generator_of(basis: FloatArray, twist: FloatArray) -> FloatArray:
    """``Σ t_j Ĝ_j`` (4, 4)."""
    G = np.zeros((4, 4))
    for k in range(basis.shape[0]):
        for i in range(4):
            for j in range(4):
                G[i, j] += twist[k] * basis[k, i, j]
    return G


@kernel
def displaced(D: FloatArray, basis: FloatArray, twist: FloatArray) -> FloatArray:
    """``exp(Σ t_j Ĝ_j) D`` (4, 4)."""
    out = np.empty((4, 4))
    multiply4_into(exp_twist(generator_of(basis, twist)), D, out)
    return out


@kernel
def after(
    D: FloatArray, basis: FloatArray, twist: FloatArray, rate: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """Pose (4, 4) and twist (6,) of a target ``dt_s`` later; the rate decays."""
    if dt_s < 0.0:  # a frame that was overtaken by another camera's
        return displaced(D, basis, dt_s * twist), twist.copy()
    fade = math.exp(-dt_s / ACCELERATION_S)
    step = dt_s * twist + ACCELERATION_S**2 * (dt_s / ACCELERATION_S - 1.0 + fade) * rate
    return displaced(D, basis, step), twist + ACCELERATION_S * (1.0 - fade) * rate


Motion = tuple[FloatArray, FloatArray, FloatArray]
"""Motion of a target: its twist and the rate of the twist (6,), and the covariance (18, 18) of pose, twist and rate."""
View = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""View of a frame: the camera's matrix (1, 3, 4), the transformation between the target's frame and the camera's (4,
4), ideal pixels (k, 2) of the target's markers, and which of them are seen (k,) 1 or 0. Plain tuples, because numba
resolves a named one at every call.
"""


@kernel
def elapse(D: FloatArray, basis: FloatArray, drift: FloatArray, motion: Motion, dt_s: float) -> None:
    """Propagate the pose ``D`` (4, 4) and its ``motion`` by ``dt_s``, in place."""
    twist, rate, covariance = motion
    n = FREEDOMS
    fade = math.exp(-dt_s / ACCELERATION_S)
    F = np.eye(3)
    F[0, 1], F[0, 2] = dt_s, ACCELERATION_S**2 * (dt_s / ACCELERATION_S - 1.0 + fade)
    F[1, 2], F[2, 2] = ACCELERATION_S * (1.0 - fade), fade
    jerk = 2.0 * ACCELERATION_PX**2 / ACCELERATION_S
    Q = np.empty((3, 3))
    Q[0, 0], Q[1, 1], Q[2, 2] = jerk * dt_s**5 / 20.0, jerk * dt_s**3 / 3.0, jerk * dt_s
    Q[0, 1] = Q[1, 0] = jerk * dt_s**4 / 8.0
    Q[0, 2] = Q[2, 0] = jerk * dt_s**3 / 6.0
    Q[1, 2] = Q[2, 1] = jerk * dt_s**2 / 2.0
    D[:], twist[:] = after(D, basis, twist, rate, dt_s)
    rate *= fade
    before = covariance.copy()
    for a in range(3):
        for b in range(3):
            for i in range(n):
                for j in range(n):
                    total = Q[a, b] * drift[i, j]
                    for c in range(a, 3):
                        for d in range(b, 3):
                            total += F[a, c] * F[b, d] * before[c * n + i, d * n + j]
                    covariance[a * n + i, b * n + j] = total


@kernel
def compare(basis: FloatArray, points: FloatArray, D: FloatArray, view: View) -> tuple[FloatArray, FloatArray]:
    """Residuals of a frame relative to a pose ``D``: observed minus predicted markers (k, 2) [px], zeros where they are
    not seen, and the Jacobian (k, 2, 6) by the basis.
    """
    matrix, carrier, observed, seen = view
    moved = transform_points(carrier, transform_points(D, points))
    pixels, _ = project_points(matrix, moved)
    J = image_jacobian(seen_through(basis, carrier), matrix, moved)[0]
    left = np.zeros(observed.shape)
    for i in range(seen.size):
        for a in range(2):
            if seen[i] > 0.0:
                left[i, a] = observed[i, a] - pixels[0, i, a]
            else:
                J[i, a, :] = 0.0
    return left, J


@kernel
def gate_observations(
    left: FloatArray, J: FloatArray, variances: FloatArray, seen: FloatArray, pose: FloatArray, gate: float
) -> tuple[FloatArray, int, int]:
    """Which of the markers ``seen`` (k,) are explained within a ``gate`` by the covariance ``pose`` (6, 6), their
    number, and the number of markers seen.
    """
    within, used, count = seen.copy(), 0, 0
    S = np.empty((2, 2))
    for i in range(seen.size):
        if not seen[i] > 0.0:
            continue
        count += 1
        for a in range(2):
            for b in range(2):
                total = variances[i] if a == b else 0.0
                for k in range(FREEDOMS):
                    for m in range(FREEDOMS):
                        total += J[i, a, k] * pose[k, m] * J[i, b, m]
                S[a, b] = total
        u, v, determinant = left[i, 0], left[i, 1], S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]
        if S[1, 1] * u * u - 2.0 * S[0, 1] * u * v + S[0, 0] * v * v <= gate * determinant:
            used += 1
        else:
            within[i] = 0.0
    return within, used, count


@kernel
def fold_frame(
    D: FloatArray,
    basis: FloatArray,
    motion: Motion,
    compared: tuple[FloatArray, FloatArray],
    variances: FloatArray,
    used: FloatArray,
) -> FloatArray:
    """Correct the pose ``D`` and its ``motion`` by a frame, in place; returns the twist (6,) of the correction.

    ``compared``: residuals (k, 2) and Jacobian, from `compare`.
    ``used`` (k,): markers to use.
    """
    (twist, rate, covariance), (left, J) = motion, compared
    n = FREEDOMS
    N, b = np.zeros((n, n)), np.zeros(n)
    for i in range(used.size):
        if not used[i] > 0.0:
            continue
        w = 1.0 / variances[i]
        for a in range(2):
            for k in range(n):
                b[k] += w * J[i, a, k] * left[i, a]
                for m in range(n):
                    N[k, m] += w * J[i, a, k] * J[i, a, m]
    M, X = np.eye(n), np.empty((n, n + 1))
    for i in range(n):
        for j in range(n):
            for k in range(n):
                M[i, j] += N[i, k] * covariance[k, j]
            X[i, j] = N[i, j]
        X[i, n] = b[i]
    solve_into(M, X)  # (1 + N C)⁻¹ [N | b]
    step = np.zeros(3 * n)
    before = covariance.copy()
    gain = np.zeros((3 * n, n))
    for i in range(3 * n):
        for k in range(n):
            step[i] += before[i, k] * X[k, n]
            for j in range(n):
                gain[i, j] += before[i, k] * X[k, j]
    for i in range(3 * n):
        for j in range(3 * n):
            total = before[i, j]
            for k in range(n):
                total -= gain[i, k] * before[k, j]
            covariance[i, j] = total
    for i in range(3 * n):
        for j in range(i):
            covariance[i, j] = covariance[j, i] = 0.5 * (covariance[i, j] + covariance[j, i])
    D[:] = displaced(D, basis, step[:n])
    twist += step[n : 2 * n]
    rate += step[2 * n :]
    return step[:n].copy()


FITS = 40
"""Least-squares iterations to find a target of known shape."""
FOUND_REST_PX = 3.0
"""Largest residual of a target that counts as found, rms [px]."""


def find_stated(
    basis: FloatArray, arrays: ModelArrays, points: FloatArray, observed: FloatArray, seen: FloatArray
) -> tuple[FloatArray, float]:
    """`find_pose` for a target with any orientation: in a metric frame, from the points triangulated by several
    cameras.
    """
    start = np.eye(4)
    if arrays.to_euclidean is not None:
        M_now, known = find_shape(arrays.matrices, observed, seen, arrays.plane_at_infinity)
        H = arrays.to_euclidean
        before, now = (from_homogeneous(move_points(H, M)) for M in (points, M_now))
        both = (known > 0.0) & np.isfinite(before).all(axis=1) & np.isfinite(now).all(axis=1)
        before, now = before[both], now[both]
        try:
            start = np.linalg.inv(H) @ similarity_from_points(before, now, scaled=False) @ H
        except GeometryError:  # too few by two cameras, or on a line: from its previous pose
            start = np.eye(4)
    found: tuple[FloatArray, float] = find_pose(
        basis, arrays.matrices, np.ascontiguousarray(start), points, observed, seen
    )
    return found


@kernel
def find_pose(
    basis: FloatArray, matrices: FloatArray, start: FloatArray, points: FloatArray, shown: FloatArray, seen: FloatArray
) -> tuple[FloatArray, float]:
    """The displacement (4, 4) of ``points`` (k, 4) that explains ``shown`` (c, k, 2), where ``seen`` (c, k), from a
    ``start`` (4, 4), and its residual [px] rms.

    Least squares from a distant start converges to a wrong pose: for rotations of 60 degrees and more.
    """
    D = start.copy()
    weights = np.repeat(seen.copy().reshape(-1), 2)
    for _ in range(FITS):
        moved = transform_points(D, points)
        pixels, _ = project_points(matrices, moved)
        J = image_jacobian(basis, matrices, moved).reshape((-1, basis.shape[0]))
        step, _ = damped_least_squares(J, (shown - pixels).reshape(-1), weights, 1e-9)
        D = displaced(D, basis, step)
    pixels, _ = project_points(matrices, transform_points(D, points))
    total = count = 0.0
    for c in range(seen.shape[0]):
        for i in range(seen.shape[1]):
            if seen[c, i] > 0.0:
                total += (shown[c, i, 0] - pixels[c, i, 0]) ** 2 + (shown[c, i, 1] - pixels[c, i, 1]) ** 2
                count += 2.0
    rest = math.sqrt(total / count) if count > 0.0 else math.inf
    return D, rest if math.isfinite(rest) else math.inf


@kernel
def jumped(basis: FloatArray, points: FloatArray, D: FloatArray, view: View) -> tuple[FloatArray, float, float]:
    """The pose (4, 4) that explains a frame best, starting at ``D``; the displacement of the markers [px] rms, and the
    residual [px] rms. Arguments as in `compare`.
    """
    matrix, carrier, observed, seen = view
    before = transform_points(carrier, transform_points(D, points))
    shown = seen.reshape((1, -1))
    moved, rest_px = find_pose(
        seen_through(basis, carrier), matrix, np.eye(4), before, observed.reshape((1, -1, 2)), shown
    )
    after, _ = project_points(matrix, transform_points(moved, before))
    pixels, _ = project_points(matrix, before)
    total = count = 0.0
    for i in range(seen.size):
        if seen[i] > 0.0:
            total += (after[0, i, 0] - pixels[0, i, 0]) ** 2 + (after[0, i, 1] - pixels[0, i, 1]) ** 2
            count += 2.0
    half, pose = np.empty((4, 4)), np.empty((4, 4))
    multiply4_into(invert4(carrier), moved, half)  # C⁻¹ M C D
    multiply4_into(half, carrier, pose)
    multiply4_into(pose.copy(), D, pose)
    moved_px = math.sqrt(total / count) if count > 0.0 else math.inf
    return pose, moved_px, rest_px


@kernel
def pixel_rates(
    basis: FloatArray, twist: FloatArray, matrices: FloatArray, carrier: FloatArray, points: FloatArray
) -> FloatArray:
    """Pixel velocities (c, k, 2) [px/s] of ``points`` (k, 4), at their current positions, that move with a ``twist``
    (6,).
    """
    J = image_jacobian(seen_through(basis, carrier), matrices, transform_points(carrier, points))
    rates = np.zeros(J.shape[:3])
    for c in range(J.shape[0]):
        for i in range(J.shape[1]):
            for a in range(2):
                for k in range(FREEDOMS):
                    rates[c, i, a] += J[c, i, a, k] * twist[k]
    return rates


@kernel
def find_shape(
    matrices: FloatArray, observed: FloatArray, seen: FloatArray, plane: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Points (k, 4) of unit height above the ``plane`` (4,) at infinity that are seen by two or more cameras, and which
    these are (k,) 1 or 0.
    """
    points, ok = triangulate(matrices, observed, seen, 5)
    known = np.zeros(points.shape[0])
    for i in range(points.shape[0]):
        views, height = 0.0, 0.0
        for c in range(seen.shape[0]):
            views += 1.0 if seen[c, i] > 0.0 else 0.0
        for k in range(4):
            height += points[i, k] * plane[k]
        if ok[i] and views >= 2.0 and height != 0.0:
            known[i] = 1.0
        for k in range(4):
            points[i, k] = points[i, k] / height if known[i] > 0.0 else plane[k]
    return points, known
