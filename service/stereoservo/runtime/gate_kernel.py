"""Innovations of a frame and their statistical gate, in numba; `estimate` says what they are for.

The squared Mahalanobis distance of a two-vector is chi-square with two freedoms, whatever its covariance: what is
improbable is refused, what is merely large counts less (Huber, Robust Statistics, 1981, ch. 7: weight k/d beyond k).
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.kinematics.kernels import BoolArray, kernel
from stereoservo.runtime.ports import FloatArray, IntArray

HUBER = 2.5
"""Mahalanobis distance up to which a sight has its full weight: 4 % of good ones lie beyond."""
FAR_SIGMA = 30.0


def gate_threshold(sigmas: float) -> float:
    """Squared distance that two Gaussian coordinates exceed as rarely as one exceeds ``sigmas`` standard deviations.

    The quantile of chi-square with two freedoms, ``-2 log(1 - p)``; far out its asymptote.
    """
    if sigmas >= FAR_SIGMA:
        return sigmas * sigmas + 2.0 * math.log(sigmas * math.sqrt(0.5 * math.pi))
    return -2.0 * math.log(math.erfc(sigmas / math.sqrt(2.0)))


@kernel
def distance2(x: float, y: float, a: float, b: float, c: float) -> float:
    """``vᵀ S⁻¹ v`` of ``v = (x, y)`` and ``S = [[a, b], [b, c]]``; infinite where S is not positive."""
    determinant = a * c - b * b
    if not determinant > 0.0:
        return math.inf
    return (c * x * x - 2.0 * b * x * y + a * y * y) / determinant


@kernel
def innovations(
    rows: IntArray, pixels: FloatArray, covariances: FloatArray, predicted: FloatArray, jacobian: FloatArray,
    speed: FloatArray, timing_s: float,
) -> tuple[FloatArray, FloatArray, BoolArray, FloatArray]:  # fmt: skip
    """Of each marker of the model: observed less ``predicted`` (m, 2) [px], its covariance (m, 2, 2) by detector and
    timing, whether it was seen (m,), and its velocity (m, 2) [px/s].

    ``rows`` (k,): the model's marker of each sight, or -1. ``jacobian`` (m, 2, n), ``speed`` (n,): what a shutter
    stamp that is off by ``timing_s`` [s] moves.
    """
    m, n = jacobian.shape[0], jacobian.shape[2]
    innovation, spread, velocity = np.zeros((m, 2)), np.zeros((m, 2, 2)), np.zeros((m, 2))
    seen = np.zeros(m, dtype=np.bool_)
    for k in range(rows.size):
        i = rows[k]
        if i < 0:
            continue
        seen[i] = True
        for a in range(2):
            innovation[i, a] = pixels[k, a] - predicted[i, a]
        u = v = 0.0
        for j in range(n):
            u += jacobian[i, 0, j] * speed[j]
            v += jacobian[i, 1, j] * speed[j]
        velocity[i, 0], velocity[i, 1] = u, v
        t = timing_s * timing_s
        spread[i, 0, 0] = covariances[k, 0, 0] + t * u * u
        spread[i, 0, 1] = covariances[k, 0, 1] + t * u * v
        spread[i, 1, 0] = spread[i, 0, 1]
        spread[i, 1, 1] = covariances[k, 1, 1] + t * v * v
    return innovation, spread, seen, velocity


@kernel
def fold_in(
    innovation: FloatArray, spread: FloatArray, seen: BoolArray, noise: FloatArray, t_ns: int,
    filtered: FloatArray, sigma: FloatArray, seen_ns: IntArray,
    known_s: float, filter_s: float, gate: float, model_px: float, first_px: float,
) -> tuple[int, int, float]:  # fmt: skip
    """Fold a frame's innovations (m, 2) into the ``filtered`` ones, each by its weight; those refused leave it alone.

    ``noise`` (m,): variance of a coordinate by the detector alone; ``gate``: squared distance; ``model_px``,
    ``first_px``: what a prediction may be off by, for markers last seen within ``known_s`` and for others. Gives how
    many were accepted and refused, and the sum of squares of the accepted innovations [px²].
    """
    accepted = refused = 0
    squares = 0.0
    for i in range(seen.size):
        if not seen[i]:
            continue
        age_s = (t_ns - seen_ns[i]) * 1e-9
        known = seen_ns[i] > 0 and age_s <= known_s
        x, y = innovation[i, 0], innovation[i, 1]
        if known:
            x -= filtered[i, 0]
            y -= filtered[i, 1]
        model = model_px if known else first_px
        d2 = distance2(
            x, y, spread[i, 0, 0] + model * model, spread[i, 0, 1], spread[i, 1, 1] + model * model
        )
        if not d2 <= gate:
            refused += 1
            continue
        weight = 1.0 if d2 <= HUBER * HUBER else HUBER / math.sqrt(d2)
        if known and filter_s > 0.0:
            share = weight * age_s / (filter_s + age_s)
            filtered[i, 0] += share * x
            filtered[i, 1] += share * y
        else:
            filtered[i, 0] = innovation[i, 0]
            filtered[i, 1] = innovation[i, 1]
        sigma[i] = math.sqrt(noise[i] / weight)
        seen_ns[i] = t_ns
        squares += innovation[i, 0] * innovation[i, 0] + innovation[i, 1] * innovation[i, 1]
        accepted += 1
    return accepted, refused, squares


@kernel
def camera_chi2(
    innovation: FloatArray, spread: FloatArray, used: FloatArray, model_px: float
) -> tuple[float, float, int, float]:
    """Chi-square of a frame's innovations (k, 2) where ``used`` (k,) > 0, sum of their squares [px²], the row of the
    largest squared distance (-1: none) and this distance.
    """
    total, squares, largest = 0.0, 0.0, 0.0
    worst = -1
    for i in range(used.size):
        if not used[i] > 0.0:
            continue
        x, y = innovation[i, 0], innovation[i, 1]
        m = model_px * model_px
        d2 = distance2(x, y, spread[i, 0, 0] + m, spread[i, 0, 1], spread[i, 1, 1] + m)
        total += d2
        squares += x * x + y * y
        if worst < 0 or d2 > largest:
            worst, largest = i, d2
    return total, squares, worst, largest
