"""Which of a camera, a marker, a joint zero explains the innovations of now: kernels for the core.

`kinematics.moved` says what is computed; `kinematics.moved_reference` is the same in NumPy. Explicit loops in a fixed
order, no LAPACK.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel
from stereoservo.kinematics.moved_fits_kernel import fit_displacement, fit_image_motion, fit_point

IntArray = npt.NDArray[np.int64]

NOTHING, CAMERA, CAMERAS, MARKER, JOINT, JOINTS, UNEXPLAINED = range(7)
MAX_SIZE = 16
"""Parameters of the largest hypothesis: all joints."""
ROUNDS = 6
SPARE = 2
"""Measurements that a hypothesis must leave over to be one: what fits exactly proves nothing."""
REFINED = 5
"""Hypotheses, the best to first order, that are estimated in full."""
SCREEN = 0.7
"""Share of its threshold that a hypothesis must reach to first order to be estimated in full."""
UNCLEAR = 9.2
"""Difference of the penalised chi-squares of two hypotheses below which both are told: odds of 100 to 1."""
EXPLAINED = 0.05
"""Share of chi-square that an explanation may leave besides the noise: models are not exact far from where they are."""


@kernel
def _effect(
    Ps: FloatArray,
    camera: int,
    D: FloatArray,
    X: FloatArray,
    count: int,
    pixels: FloatArray,
    weights: FloatArray,
) -> float:
    """Rms way [px] of the seen points that a displacement ``D`` makes in one camera or all (-1)."""
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
    """Angle [rad] of a displacement in any frame, by its trace 2 + 2 cos."""
    quarter = (4.0 - D[0, 0] - D[1, 1] - D[2, 2] - D[3, 3]) / 4.0
    return 2.0 * math.asin(math.sqrt(min(max(quarter, 0.0), 1.0)))


@kernel
def hypothesis(
    h: int, rounds: int, Ps: FloatArray, X: FloatArray, markers: int, pixels: FloatArray, observed: FloatArray,
    weights: FloatArray, operators: FloatArray, twists: FloatArray, sizes: IntArray, result: FloatArray,
) -> None:  # fmt: skip
    """One hypothesis into ``result`` (4,): chi-square of what it concerns, first-order gain, amount, effect [px]."""
    cameras, joints = Ps.shape[0], operators.shape[0]
    D, total = np.empty((4, 4)), np.empty(MAX_SIZE)
    result[2] = 0.0
    if h <= cameras or h == cameras + 1:
        camera = h - 1 if h <= cameras else -1
        if twists.shape[0] == 6 and sizes[h] == 6:
            result[0], result[1] = fit_displacement(
                Ps, camera, twists, 0, 6, X, X.shape[0], observed, weights, rounds, D, total
            )
            if rounds > 0:
                result[2] = _angle(D)
                result[3] = _effect(Ps, camera, D, X, X.shape[0], pixels, weights)
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
        if sizes[h] == 2:  # a point that one camera sees may be anywhere on its ray
            result[0], result[1] = 0.0 if rounds > 0 else chi2, chi2
        else:
            place = np.empty(4)
            result[0], result[1] = fit_point(Ps, X, p, observed, weights, rounds, place)
        return
    j = h - cameras - 2 - markers
    first, last = (j, j + 1) if j < joints else (0, joints)
    result[0], result[1] = fit_displacement(
        Ps, -1, operators, first, last, X, markers, observed, weights, rounds, D, total
    )
    if rounds > 0:
        largest = 0.0
        for k in range(last - first):
            if abs(total[k]) > abs(largest):
                largest = total[k]
        result[2] = largest
        result[3] = _effect(Ps, -1, D, X, markers, pixels, weights)


@kernel
def hypothesis_sizes(
    weights: FloatArray, cameras: int, markers: int, joints: int, metric: bool, sizes: IntArray
) -> int:
    """Parameters of each hypothesis into ``sizes`` (2 + c + m + n + 1,), 0 where it cannot be tested; and how many
    coordinates are measured.
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
    sizes[cameras + 2 + markers + joints] = (
        joints if 1 < joints <= MAX_SIZE and of_arm >= joints + SPARE else 0
    )
    return total


@kernel
def log_tail(chi2: float, freedom: int) -> float:
    """Logarithm of the chance that chi-square of ``freedom``, rounded up to even, exceeds ``chi2``: a finite sum."""
    half = 0.5 * chi2
    terms = (freedom + 1) // 2
    if half <= 0.0 or terms <= 0:
        return 0.0
    largest = -math.inf
    for i in range(terms):
        largest = max(largest, i * math.log(half) - math.lgamma(i + 1.0))
    total = 0.0
    for i in range(terms):
        total += math.exp(i * math.log(half) - math.lgamma(i + 1.0) - largest)
    return min(0.0, -half + largest + math.log(total))


@kernel
def _is_marker(h: int, cameras: int, markers: int) -> bool:
    return cameras + 2 <= h < cameras + 2 + markers


@kernel
def explain(
    Ps: FloatArray, X: FloatArray, markers: int, innovations: FloatArray, weights: FloatArray,
    operators: FloatArray, twists: FloatArray, thresholds: FloatArray, log_alpha: float, least_px: float,
    sizes: IntArray, chi2: FloatArray, amounts: FloatArray, effects: FloatArray, answer: IntArray,
) -> None:  # fmt: skip
    """All hypotheses, and which of them holds: see `kinematics.moved.explain`.

    ``X`` (p, 4): the markers, then the static points; ``innovations`` (c, p, 2) [px], ``weights`` (c, p) [1/px].
    Out: ``sizes``, ``chi2``, ``amounts``, ``effects`` (H,); ``answer`` (3,): kind, hypothesis, runner-up or -1.
    """
    cameras, points, joints = Ps.shape[0], X.shape[0], operators.shape[0]
    count = cameras + 3 + markers + joints
    pixels, observed = np.empty((cameras, points, 2)), np.empty((cameras, points, 2))
    whole, square_px, seen = 0.0, 0.0, 0.0
    for c in range(cameras):
        P = Ps[c]
        for p in range(points):
            if not weights[c, p] > 0.0:
                continue
            z = P[2, 0] * X[p, 0] + P[2, 1] * X[p, 1] + P[2, 2] * X[p, 2] + P[2, 3] * X[p, 3]
            for r in range(2):
                value = (P[r, 0] * X[p, 0] + P[r, 1] * X[p, 1] + P[r, 2] * X[p, 2] + P[r, 3] * X[p, 3]) / z
                pixels[c, p, r] = value
                observed[c, p, r] = value + innovations[c, p, r]
                square = innovations[c, p, r] * innovations[c, p, r]
                square_px += square
                whole += weights[c, p] * weights[c, p] * square
            seen += 1.0
    total = hypothesis_sizes(weights, cameras, markers, joints, twists.shape[0] == 6, sizes)
    price = math.log(max(total, 2))
    answer[0], answer[1], answer[2] = NOTHING, 0, -1
    chi2[0] = whole
    amounts[0], effects[0] = 0.0, 0.0
    result = np.zeros(4)
    now, gains = np.zeros(count), np.zeros(count)
    any_gain = False
    for h in range(1, count):
        chi2[h], amounts[h], effects[h] = math.inf, 0.0, 0.0
        gains[h] = -math.inf
        if sizes[h] == 0:
            continue
        hypothesis(h, 0, Ps, X, markers, pixels, observed, weights, operators, twists, sizes, result)
        now[h] = result[0]
        chi2[h] = whole - result[1]
        gains[h] = result[1] - sizes[h] * price
        any_gain = any_gain or result[1] > SCREEN * thresholds[sizes[h]]
    if not any_gain:
        if log_tail(whole, total) < log_alpha and math.sqrt(square_px / max(seen, 1.0)) >= least_px:
            answer[0] = UNEXPLAINED
        return
    done = np.zeros(count, dtype=np.bool_)
    noise = math.inf
    for _ in range(min(REFINED, count - 1)):
        best = -1
        for h in range(1, count):
            if sizes[h] > 0 and not done[h] and (best < 0 or gains[h] > gains[best]):
                best = h
        if best < 0:
            break
        done[best] = True
        hypothesis(best, ROUNDS, Ps, X, markers, pixels, observed, weights, operators, twists, sizes, result)
        chi2[best] = whole - now[best] + result[0]
        amounts[best], effects[best] = result[2], result[3]
        noise = min(noise, chi2[best] / max(total - sizes[best], 1))
    noise = max(noise, 1.0)
    first, second = -1, -1
    for h in range(1, count):
        if not done[h] or not (whole - chi2[h]) / noise > thresholds[sizes[h]] or not effects[h] >= least_px:
            continue
        if first < 0 or chi2[h] / noise + sizes[h] * price < chi2[first] / noise + sizes[first] * price:
            first, second = h, first
        elif second < 0 or chi2[h] / noise + sizes[h] * price < chi2[second] / noise + sizes[second] * price:
            second = h
    if first < 0:
        if log_tail(whole, total) < log_alpha and math.sqrt(square_px / max(seen, 1.0)) >= least_px:
            answer[0] = UNEXPLAINED
        return
    answer[1] = first
    left = chi2[first]
    if log_tail(left, total - sizes[first]) < log_alpha and not left <= EXPLAINED * whole:
        answer[0] = UNEXPLAINED
    elif first <= cameras:
        answer[0] = CAMERA
    elif first == cameras + 1:
        answer[0] = CAMERAS
    elif first < cameras + 2 + markers:
        answer[0] = MARKER
    elif first < cameras + 2 + markers + joints:
        answer[0] = JOINT
    else:
        answer[0] = JOINTS
    if answer[0] == JOINT and second >= 0 and sizes[second] > 1 and not _is_marker(second, cameras, markers):
        # The motion of one joint is a displacement, too: what contains it and costs more is no rival.
        return
    if (
        second >= 0
        and (chi2[second] - chi2[first]) / noise + (sizes[second] - sizes[first]) * price < UNCLEAR
    ):
        answer[2] = second
