"""Numba kernels of change detection: least-squares estimates of all hypothetical changes (camera, marker, joint zero,
…) from one set of innovations, and the selection among them.

Explicit loops in a fixed order, no LAPACK: the results are part of recordings.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.calibration.change.hypothesis_test import (
    MAX_SIZE,
    UNCLEAR,
    Tested,
    is_unexplained,
    noise_level,
    select_candidates,
    two_best,
)
from stereoservo.kinematics.kernels import exp_twist, multiply4_into
from stereoservo.numerics.arrays import FloatArray, IntArray
from stereoservo.numerics.compilation import Fields, kernel
from stereoservo.numerics.linear import NormalSystem, add_pixel_equations, damped_solve

NOTHING, CAMERA, CAMERAS, MARKER, JOINT, JOINTS, UNEXPLAINED = range(7)
ROUNDS = 6
SPARE = 2
"""Least number of redundant measurements for a hypothesis: an exact fit proves nothing."""
SCREEN = 0.7
"""Share of its threshold that a hypothesis must reach to first order to be estimated in full."""
EXPLAINED = 0.05
"""Share of chi-square that may remain beside the noise: models are inexact far from their estimate."""


class ObservedPoints(NamedTuple):
    """Points ``X`` (p, 4) in cameras ``Ps`` (c, 3, 4): observed or predicted ``pixels`` (c, p, 2), with ``weights``
    (c, p) [1/px], 0 if not seen.
    """

    Ps: FloatArray
    X: FloatArray
    pixels: FloatArray
    weights: FloatArray


class DisplacementGroup(NamedTuple):
    """A group of displacements, of which rows ``first`` to ``last`` of ``algebra`` (…, 4, 4) are a basis."""

    algebra: FloatArray
    first: int
    last: int


class Displaced(NamedTuple):
    """An element ``D`` (4, 4) of a group of d dimensions, and the sum ``total`` (d,) of the steps to it."""

    D: FloatArray
    total: FloatArray


@kernel
def _effect(predicted: ObservedPoints, camera: int, D: FloatArray, count: int) -> float:
    """Rms motion [px] of the first ``count`` points, if seen, in one camera, or all (-1), by a displacement."""
    Ps, X, pixels, weights = predicted
    low, high = (0, Ps.shape[0]) if camera < 0 else (camera, camera + 1)
    squares, seen = 0.0, 0.0
    x = np.empty(4)
    for c in range(low, high):
        P = Ps[c]
        for p in range(count):
            if not weights[c, p] > 0.0:
                continue
            for i in range(4):
                x[i] = D[i, 0] * X[p, 0] + D[i, 1] * X[p, 1] + D[i, 2] * X[p, 2] + D[i, 3] * X[p, 3]
            z = P[2, 0] * x[0] + P[2, 1] * x[1] + P[2, 2] * x[2] + P[2, 3] * x[3]
            for r in range(2):
                value = (P[r, 0] * x[0] + P[r, 1] * x[1] + P[r, 2] * x[2] + P[r, 3] * x[3]) / z
                squares += (value - pixels[c, p, r]) ** 2
            seen += 1.0
    return math.sqrt(squares / max(seen, 1.0))


@kernel
def _angle(D: FloatArray) -> float:
    """Angle [rad] of a displacement in any frame, from its trace 2 + 2 cos."""
    quarter = (4.0 - D[0, 0] - D[1, 1] - D[2, 2] - D[3, 3]) / 4.0
    return 2.0 * math.asin(math.sqrt(min(max(quarter, 0.0), 1.0)))


class Snapshot(NamedTuple):
    """Measurements of one instant: cameras ``Ps`` (c, 3, 4) and points ``X`` (p, 4), the first ``markers`` of the arm;
    their predicted ``pixels`` and ``observed`` ones (c, p, 2), ``weights`` (c, p) [1/px]; the arm's ``operators``
    (n, 4, 4) and the ``twists`` (6 or 0, 4, 4) of a metric model.
    """

    Ps: FloatArray
    X: FloatArray
    markers: int
    pixels: FloatArray
    observed: FloatArray
    weights: FloatArray
    operators: FloatArray
    twists: FloatArray


@kernel
def fit_hypothesis(h: int, rounds: int, snapshot: Snapshot, sizes: IntArray, result: FloatArray) -> None:
    """Estimate of hypothesis ``h`` into ``result`` (4,): chi-square of the affected measurements, first-order gain,
    amount, effect [px].
    """
    Ps, X, markers, pixels, observed, weights, operators, twists = snapshot
    cameras, joints = Ps.shape[0], operators.shape[0]
    D, total = np.empty((4, 4)), np.empty(MAX_SIZE)
    seen_points, predicted = ObservedPoints(Ps, X, observed, weights), ObservedPoints(Ps, X, pixels, weights)
    result[2] = 0.0
    if h <= cameras or h == cameras + 1:
        camera = h - 1 if h <= cameras else -1
        if twists.shape[0] == 6 and sizes[h] == 6:
            result[0], result[1] = fit_displacement(
                seen_points, camera, DisplacementGroup(twists, 0, 6), X.shape[0], rounds, Displaced(D, total)
            )
            if rounds > 0:
                result[2] = _angle(D)
                result[3] = _effect(predicted, camera, D, X.shape[0])
            return
        moved = np.empty((X.shape[0], 2))
        result[0], result[1] = fit_image_motion(
            pixels[camera], observed[camera], weights[camera], sizes[h], rounds, moved
        )
        result[2] = math.nan
        if rounds > 0:
            squares, seen = 0.0, 0.0
            for p in range(X.shape[0]):
                if weights[camera, p] > 0.0:
                    seen += 1.0
                    squares += (moved[p, 0] - pixels[camera, p, 0]) ** 2
                    squares += (moved[p, 1] - pixels[camera, p, 1]) ** 2
            result[3] = math.sqrt(squares / max(seen, 1.0))
        return
    if h < cameras + 2 + markers:
        p = h - cameras - 2
        squares, seen, chi2 = 0.0, 0.0, 0.0
        for c in range(cameras):
            w = weights[c, p]
            if w > 0.0:
                du, dv = observed[c, p, 0] - pixels[c, p, 0], observed[c, p, 1] - pixels[c, p, 1]
                squares += du * du + dv * dv
                chi2 += w * w * (du * du + dv * dv)
                seen += 1.0
        result[3] = math.sqrt(squares / max(seen, 1.0))
        if sizes[h] == 2:  # a point seen by one camera may be anywhere on its ray
            result[0], result[1] = 0.0 if rounds > 0 else chi2, chi2
        else:
            place = np.empty(4)
            result[0], result[1] = fit_point(seen_points, p, rounds, place)
        return
    j = h - cameras - 2 - markers
    first, last = (j, j + 1) if j < joints else (0, joints)
    result[0], result[1] = fit_displacement(
        seen_points, -1, DisplacementGroup(operators, first, last), markers, rounds, Displaced(D, total)
    )
    if rounds > 0:
        largest = 0.0
        for k in range(last - first):
            if abs(total[k]) > abs(largest):
                largest = total[k]
        result[2] = largest
        result[3] = _effect(predicted, -1, D, markers)


@kernel
def hypothesis_sizes(
    weights: FloatArray, cameras: int, markers: int, joints: int, metric: bool, sizes: IntArray
) -> int:
    """Number of parameters of each hypothesis into ``sizes`` (2 + c + m + n + 1,), 0 if it cannot be tested; and the
    number of measured coordinates.
    """
    points = weights.shape[1]
    total, of_arm = 0, 0
    for c in range(cameras):
        seen = 0
        for p in range(points):
            if weights[c, p] > 0.0:
                seen += 2
                if p < markers:
                    of_arm += 2
        total += seen
        full = 6 if metric else 8
        sizes[1 + c] = full if seen >= full + SPARE else (2 if seen >= 2 + SPARE else 0)
    sizes[0] = 0
    sizes[cameras + 1] = 6 if metric and cameras > 1 and total >= 6 + SPARE else 0
    for p in range(markers):
        views = 0
        for c in range(cameras):
            if weights[c, p] > 0.0:
                views += 1
        sizes[cameras + 2 + p] = min(2 * views, 3)
    for j in range(joints):
        sizes[cameras + 2 + markers + j] = 1 if of_arm >= 1 + SPARE else 0
    sizes[cameras + 2 + markers + joints] = joints if 1 < joints <= MAX_SIZE and of_arm >= joints + SPARE else 0
    return total


@kernel
def _kind(h: int, cameras: int, markers: int, joints: int) -> int:
    """Kind of hypothesis ``h`` >= 1."""
    if h <= cameras:
        return CAMERA
    if h == cameras + 1:
        return CAMERAS
    if h < cameras + 2 + markers:
        return MARKER
    return JOINT if h < cameras + 2 + markers + joints else JOINTS


class Innovations(NamedTuple):
    """``innovations`` (c, p, 2) [px] with ``weights`` (c, p) [1/px] of points ``X`` (p, 4), the first ``markers`` on
    the arm, then static ones, in cameras ``Ps`` (c, 3, 4); ``operators`` and ``twists`` as in `Snapshot`.
    """

    Ps: FloatArray
    X: FloatArray
    markers: int
    innovations: FloatArray
    weights: FloatArray
    operators: FloatArray
    twists: FloatArray


class Explanations(NamedTuple):
    """Results for H hypotheses: ``sizes`` (numbers of parameters), remaining ``chi2``, ``amounts`` and ``effects``
    [px], (H,) each; the ``answer`` (3,): kind, hypothesis, runner-up or -1.
    """

    sizes: IntArray
    chi2: FloatArray
    amounts: FloatArray
    effects: FloatArray
    answer: IntArray


@kernel
def _predict(shown: Fields, pixels: FloatArray, observed: FloatArray) -> tuple[float, float]:
    """Predicted ``pixels`` (c, p, 2) and ``observed`` ones, if seen; chi-square and rms [px] of the innovations."""
    Ps, X, _, innovations, weights, _, _ = shown
    chi2, square_px, seen = 0.0, 0.0, 0.0
    for c in range(Ps.shape[0]):
        P = Ps[c]
        for p in range(X.shape[0]):
            if not weights[c, p] > 0.0:
                continue
            z = P[2, 0] * X[p, 0] + P[2, 1] * X[p, 1] + P[2, 2] * X[p, 2] + P[2, 3] * X[p, 3]
            for r in range(2):
                value = (P[r, 0] * X[p, 0] + P[r, 1] * X[p, 1] + P[r, 2] * X[p, 2] + P[r, 3] * X[p, 3]) / z
                pixels[c, p, r] = value
                observed[c, p, r] = value + innovations[c, p, r]
                square = innovations[c, p, r] * innovations[c, p, r]
                square_px += square
                chi2 += weights[c, p] * weights[c, p] * square
            seen += 1.0
    return chi2, math.sqrt(square_px / max(seen, 1.0))


@kernel
def explain_innovations(seen: Fields, thresholds: FloatArray, log_alpha: float, least_px: float, found: Fields) -> None:
    """Estimates of all hypotheses and the decision among them, into ``found``, the fields of `Explanations`; ``seen``:
    those of `Innovations`. ``thresholds``, ``log_alpha`` and ``least_px`` are those of a `hypothesis_test.Thresholds`.
    """
    Ps, X, markers, _, weights, operators, twists = seen
    sizes, chi2, amounts, effects, answer = found
    cameras, points, joints = Ps.shape[0], X.shape[0], operators.shape[0]
    count = cameras + 3 + markers + joints
    pixels, observed = np.empty((cameras, points, 2)), np.empty((cameras, points, 2))
    whole, rms_px = _predict(seen, pixels, observed)
    total = hypothesis_sizes(weights, cameras, markers, joints, twists.shape[0] == 6, sizes)
    penalty = math.log(max(total, 2))
    large = rms_px >= least_px
    answer[0], answer[1], answer[2] = NOTHING, 0, -1
    chi2[0] = whole
    amounts[0], effects[0] = 0.0, 0.0
    snapshot = Snapshot(Ps, X, markers, pixels, observed, weights, operators, twists)
    result = np.zeros(4)
    now, gains = np.zeros(count), np.zeros(count)
    any_gain = False
    for h in range(1, count):
        chi2[h], amounts[h], effects[h] = math.inf, 0.0, 0.0
        gains[h] = -math.inf
        if sizes[h] == 0:
            continue
        fit_hypothesis(h, 0, snapshot, sizes, result)
        now[h] = result[0]
        chi2[h] = whole - result[1]
        gains[h] = result[1] - sizes[h] * penalty
        any_gain = any_gain or result[1] > SCREEN * thresholds[sizes[h]]
    if not any_gain:
        if large and is_unexplained(whole, total, log_alpha, 0.0):
            answer[0] = UNEXPLAINED
        return
    candidates = np.zeros(count, dtype=np.bool_)
    select_candidates(gains, sizes, candidates)
    for h in range(1, count):
        if candidates[h]:
            fit_hypothesis(h, ROUNDS, snapshot, sizes, result)
            chi2[h] = whole - now[h] + result[0]
            amounts[h], effects[h] = result[2], result[3]
    noise = noise_level(chi2, sizes, candidates, total)
    tested = Tested(chi2, sizes, effects, candidates)
    first, second = two_best(whole, tested, noise, penalty, thresholds, least_px)
    if first < 0:
        if large and is_unexplained(whole, total, log_alpha, 0.0):
            answer[0] = UNEXPLAINED
        return
    answer[0], answer[1] = _kind(first, cameras, markers, joints), first
    if is_unexplained(chi2[first], total - sizes[first], log_alpha, EXPLAINED * whole):
        answer[0] = UNEXPLAINED
    if answer[0] == JOINT and second >= 0 and sizes[second] > 1 and _kind(second, cameras, markers, joints) != MARKER:
        # The motion of one joint is a displacement, too: a larger hypothesis that contains it is no alternative.
        return
    if second >= 0 and (chi2[second] - chi2[first]) / noise + (sizes[second] - sizes[first]) * penalty < UNCLEAR:
        answer[2] = second


SETTLED = 1e-4
"""Decrease of chi-square to first order at which the Gauss-Newton iteration ends."""
DAMPING = 1e-10


class CameraPoints(NamedTuple):
    """Points ``X`` (p, 4), moved by ``D`` (4, 4), in a camera ``P`` (3, 4): ``observed`` pixels (p, 2) and
    ``weights`` (p,).
    """

    P: FloatArray
    D: FloatArray
    X: FloatArray
    observed: FloatArray
    weights: FloatArray


@kernel
def _equations(E: FloatArray, points: CameraPoints, count: int, equations: NormalSystem, rows: FloatArray) -> float:
    """Add the normal equations of the first ``count`` points to ``equations``; returns their chi-square.

    ``E`` (d, 3, 4) = P times the algebra; ``rows`` (2, d) scratch. Infinite if a point is behind the camera.
    """
    P, D, X, observed, weights = points
    N, b = equations
    chi2 = 0.0
    d = b.shape[0]
    for p in range(count):
        w = weights[p]
        if not w > 0.0:
            continue
        x0 = D[0, 0] * X[p, 0] + D[0, 1] * X[p, 1] + D[0, 2] * X[p, 2] + D[0, 3] * X[p, 3]
        x1 = D[1, 0] * X[p, 0] + D[1, 1] * X[p, 1] + D[1, 2] * X[p, 2] + D[1, 3] * X[p, 3]
        x2 = D[2, 0] * X[p, 0] + D[2, 1] * X[p, 1] + D[2, 2] * X[p, 2] + D[2, 3] * X[p, 3]
        x3 = D[3, 0] * X[p, 0] + D[3, 1] * X[p, 1] + D[3, 2] * X[p, 2] + D[3, 3] * X[p, 3]
        z = P[2, 0] * x0 + P[2, 1] * x1 + P[2, 2] * x2 + P[2, 3] * x3
        if z == 0.0:
            return math.inf
        scale = 1.0 / z
        u = (P[0, 0] * x0 + P[0, 1] * x1 + P[0, 2] * x2 + P[0, 3] * x3) * scale
        v = (P[1, 0] * x0 + P[1, 1] * x1 + P[1, 2] * x2 + P[1, 3] * x3) * scale
        for k in range(d):
            e2 = E[k, 2, 0] * x0 + E[k, 2, 1] * x1 + E[k, 2, 2] * x2 + E[k, 2, 3] * x3
            e0 = E[k, 0, 0] * x0 + E[k, 0, 1] * x1 + E[k, 0, 2] * x2 + E[k, 0, 3] * x3
            e1 = E[k, 1, 0] * x0 + E[k, 1, 1] * x1 + E[k, 1, 2] * x2 + E[k, 1, 3] * x3
            rows[0, k] = (e0 - u * e2) * scale
            rows[1, k] = (e1 - v * e2) * scale
        du, dv = observed[p, 0] - u, observed[p, 1] - v
        chi2 += w * w * (du * du + dv * dv)
        add_pixel_equations(rows, du, dv, w * w, N, b)
    return chi2


@kernel
def _times(P: FloatArray, algebra: FloatArray, first: int, last: int) -> FloatArray:
    """``P B_k`` (d, 3, 4) for k = first to last."""
    E = np.empty((last - first, 3, 4))
    for k in range(first, last):
        for i in range(3):
            for j in range(4):
                s = 0.0
                for h in range(4):
                    s += P[i, h] * algebra[k, h, j]
                E[k - first, i, j] = s
    return E


@kernel
def _solved(N: FloatArray, b: FloatArray, x: FloatArray) -> float:
    """``x`` of ``N x = b`` and the first-order gain ``b·x``; ``N`` is overwritten."""
    damped_solve(N, b, DAMPING, x)
    gain = 0.0
    for k in range(b.shape[0]):
        gain += b[k] * x[k]
    return gain


@kernel
def fit_displacement(
    seen: ObservedPoints, camera: int, group: DisplacementGroup, count: int, rounds: int, found: Displaced
) -> tuple[float, float]:
    """Chi-square of the first ``count`` points in one camera, or all (-1), moved by the best element of a group, which
    is written to ``found``.

    With ``rounds`` 0: chi-square of the unchanged model. Second: the gain to first order of the first step.
    """
    Ps, X, observed, weights = seen
    algebra, first, last = group
    D, total = found
    d = last - first
    low, high = (0, Ps.shape[0]) if camera < 0 else (camera, camera + 1)
    E = np.empty((high - low, d, 3, 4))
    for c in range(low, high):
        E[c - low] = _times(Ps[c], algebra, first, last)
    N, b, x, rows = np.empty((d, d)), np.empty(d), np.empty(d), np.empty((2, d))
    here, product = np.zeros((4, 4)), np.empty((4, 4))
    tried = np.zeros(d)
    for i in range(4):
        for j in range(4):
            D[i, j] = here[i, j] = 1.0 if i == j else 0.0
    for k in range(d):
        total[k] = 0.0
    best, linear = math.inf, 0.0
    for turn in range(rounds + 1):
        N[:] = 0.0
        b[:] = 0.0
        chi2 = 0.0
        for c in range(low, high):
            points = CameraPoints(Ps[c], here, X, observed[c], weights[c])
            chi2 += _equations(E[c - low], points, count, NormalSystem(N, b), rows)
        if not chi2 < math.inf or (turn > 0 and not chi2 <= best):
            break
        best = chi2
        for i in range(4):
            for j in range(4):
                D[i, j] = here[i, j]
        for k in range(d):
            total[k] = tried[k]
        gain = _solved(N, b, x)
        if turn == 0:
            linear = gain
        if turn == rounds or gain < SETTLED:
            break
        G = np.zeros((4, 4))
        for k in range(d):
            tried[k] += x[k]
            for i in range(4):
                for j in range(4):
                    G[i, j] += x[k] * algebra[first + k, i, j]
        multiply4_into(exp_twist(G), here, product)
        for i in range(4):
            for j in range(4):
                here[i, j] = product[i, j]
    return best, linear


@kernel
def fit_image_motion(
    pixels: FloatArray, observed: FloatArray, weights: FloatArray, size: int, rounds: int, moved: FloatArray
) -> tuple[float, float]:
    """Chi-square of ``pixels`` (q, 2) of one camera moved by the best homography (``size`` 8) or shift (2).

    ``moved`` (q, 2): the moved pixels. Second: the gain to first order of the first step.
    """
    q = pixels.shape[0]
    seen, cu, cv, radius = 0.0, 0.0, 0.0, 0.0
    for p in range(q):
        if weights[p] > 0.0:
            seen += 1.0
            cu += pixels[p, 0]
            cv += pixels[p, 1]
    cu, cv = cu / max(seen, 1.0), cv / max(seen, 1.0)
    for p in range(q):
        if weights[p] > 0.0:
            radius += (pixels[p, 0] - cu) ** 2 + (pixels[p, 1] - cv) ** 2
    radius = math.sqrt(radius / max(seen, 1.0))
    if radius == 0.0:
        radius = 1.0
    here = np.empty((q, 2))
    for p in range(q):
        here[p, 0], here[p, 1] = (pixels[p, 0] - cu) / radius, (pixels[p, 1] - cv) / radius
    N, b, a, rows = np.empty((size, size)), np.empty(size), np.empty(size), np.zeros((2, size))
    best, linear = math.inf, 0.0
    for turn in range(rounds + 1):
        N[:] = 0.0
        b[:] = 0.0
        chi2 = 0.0
        for p in range(q):
            w = weights[p] * radius
            if not w > 0.0:
                continue
            x, y = here[p, 0], here[p, 1]
            du = (observed[p, 0] - cu) / radius - x
            dv = (observed[p, 1] - cv) / radius - y
            chi2 += w * w * (du * du + dv * dv)
            rows[0, 0] = rows[1, 1] = 1.0
            if size == 8:
                rows[0, 2], rows[0, 3], rows[0, 6], rows[0, 7] = x, y, x * x, x * y
                rows[1, 4], rows[1, 5], rows[1, 6], rows[1, 7] = x, y, x * y, y * y
            add_pixel_equations(rows, du, dv, w * w, N, b)
        if not chi2 < math.inf or (turn > 0 and not chi2 <= best):
            break
        best = chi2
        for p in range(q):
            moved[p, 0], moved[p, 1] = cu + radius * here[p, 0], cv + radius * here[p, 1]
        gain = _solved(N, b, a)
        if turn == 0:
            linear = gain
        if turn == rounds or gain < SETTLED:
            break
        for p in range(q):
            x, y = here[p, 0], here[p, 1]
            if size == 8:
                scale = 1.0 - a[6] * x - a[7] * y
                here[p, 0] = (x + a[0] + a[2] * x + a[3] * y) / scale
                here[p, 1] = (y + a[1] + a[4] * x + a[5] * y) / scale
            else:
                here[p, 0], here[p, 1] = x + a[0], y + a[1]
    return best, linear


@kernel
def fit_point(observed_points: ObservedPoints, p: int, rounds: int, found: FloatArray) -> tuple[float, float]:
    """Chi-square of point ``p`` alone at its best position ``found`` (4,); second: first-order gain of the first step.

    With two or more views, three of its coordinates are free, all but the largest.
    """
    Ps, X, observed, weights = observed_points
    largest = 0
    for i in range(1, 4):
        if abs(X[p, i]) > abs(X[p, largest]):
            largest = i
    here = np.empty((1, 4))
    for i in range(4):
        here[0, i] = found[i] = X[p, i]
    N, b, x, rows = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((2, 3))
    best, linear = math.inf, 0.0
    for turn in range(rounds + 1):
        N[:] = 0.0
        b[:] = 0.0
        chi2 = 0.0
        for c in range(Ps.shape[0]):
            w = weights[c, p]
            if not w > 0.0:
                continue
            P = Ps[c]
            z = P[2, 0] * here[0, 0] + P[2, 1] * here[0, 1] + P[2, 2] * here[0, 2] + P[2, 3] * here[0, 3]
            if z == 0.0:
                chi2 = math.inf
                continue
            u = (P[0, 0] * here[0, 0] + P[0, 1] * here[0, 1] + P[0, 2] * here[0, 2] + P[0, 3] * here[0, 3]) / z
            v = (P[1, 0] * here[0, 0] + P[1, 1] * here[0, 1] + P[1, 2] * here[0, 2] + P[1, 3] * here[0, 3]) / z
            k = 0
            for i in range(4):
                if i != largest:
                    rows[0, k] = (P[0, i] - u * P[2, i]) / z
                    rows[1, k] = (P[1, i] - v * P[2, i]) / z
                    k += 1
            du, dv = observed[c, p, 0] - u, observed[c, p, 1] - v
            chi2 += w * w * (du * du + dv * dv)
            add_pixel_equations(rows, du, dv, w * w, N, b)
        if not chi2 < math.inf or (turn > 0 and not chi2 <= best):
            break
        best = chi2
        for i in range(4):
            found[i] = here[0, i]
        gain = _solved(N, b, x)
        if turn == 0:
            linear = gain
        if turn == rounds or gain < SETTLED:
            break
        k = 0
        for i in range(4):
            if i != largest:
                here[0, i] += x[k]
                k += 1
    return best, linear
