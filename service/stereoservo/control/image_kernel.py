"""The laws in the images as one kernel: Jacobian, normal equations and damped solve, without arrays in between.

The readable references are in `control.image`.
"""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.law import JacobianChoice
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel
from stereoservo.kinematics.linear_kernels import add_pixel_equations, damped_solve

DESIRED = int(JacobianChoice.DESIRED)
MEAN = int(JacobianChoice.MEAN)
FIXED_DEPTH = int(JacobianChoice.FIXED_DEPTH)


@kernel
def velocities_into(operators: FloatArray, M: FloatArray, out: FloatArray) -> None:
    """``Ĥ_j M`` of one point (4,) into (n, 4)."""
    for j in range(operators.shape[0]):
        G = operators[j]
        for i in range(4):
            out[j, i] = G[i, 0] * M[0] + G[i, 1] * M[1] + G[i, 2] * M[2] + G[i, 3] * M[3]


@kernel
def pixel_gradients(matrices: FloatArray, X: FloatArray) -> FloatArray:
    """``J_G P`` (2c, 4) [px]: gradient of the pixels of ``X`` (4,) in cameras (c, 3, 4) (8.8); NaN in a focal plane."""
    cameras = matrices.shape[0]
    A = np.empty((2 * cameras, 4))
    for c in range(cameras):
        P = matrices[c]
        d = P[2, 0] * X[0] + P[2, 1] * X[1] + P[2, 2] * X[2] + P[2, 3] * X[3]
        scale = 1.0 / d if d != 0.0 else math.nan
        for r in range(2):
            pixel = (P[r, 0] * X[0] + P[r, 1] * X[1] + P[r, 2] * X[2] + P[r, 3] * X[3]) * scale
            for i in range(4):
                A[2 * c + r, i] = (P[r, i] - pixel * P[2, i]) * scale
    return A


@kernel
def add_rows(P: FloatArray, M: FloatArray, velocity: FloatArray, share: float, rows: FloatArray) -> None:
    """``share`` times ``J_G P Ĥ_j M`` (8.33) onto (2, n), for velocities ``Ĥ_j M`` (n, 4); NaN at depth 0."""
    d = P[2, 0] * M[0] + P[2, 1] * M[1] + P[2, 2] * M[2] + P[2, 3] * M[3]
    scale = 1.0 / d if d != 0.0 else math.nan
    for r in range(2):
        pixel = (P[r, 0] * M[0] + P[r, 1] * M[1] + P[r, 2] * M[2] + P[r, 3] * M[3]) * scale
        g0 = (P[r, 0] - pixel * P[2, 0]) * scale
        g1 = (P[r, 1] - pixel * P[2, 1]) * scale
        g2 = (P[r, 2] - pixel * P[2, 2]) * scale
        g3 = (P[r, 3] - pixel * P[2, 3]) * scale
        for j in range(rows.shape[1]):
            v = velocity[j]
            rows[r, j] += share * (g0 * v[0] + g1 * v[1] + g2 * v[2] + g3 * v[3])


@kernel
def image_equations_into(
    operators: FloatArray,
    matrices: FloatArray,
    camera_centres: FloatArray,
    points: FloatArray,
    target_points: FloatArray,
    target_known: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    rates: FloatArray,
    weights: FloatArray,
    wanted: FloatArray,
    gain: float,
    choice: int,
    N: FloatArray,
    b: FloatArray,
) -> None:
    """The normal equations ``N x = b`` of `image.image_velocity`, undamped; of ``N`` (n, n) the lower triangle."""
    n, cameras, markers = operators.shape[0], matrices.shape[0], points.shape[0]
    for i in range(n):
        b[i] = 0.0
        for k in range(n):
            N[i, k] = 0.0
    rows = np.empty((2, n))
    now = np.empty((n, 4))
    then = np.empty((n, 4))
    moved = np.empty(4)
    for p in range(markers):
        seen = False
        for c in range(cameras):
            seen = seen or weights[c, p] * wanted[c, p] > 0.0
        if not seen:
            continue
        kind = choice if target_known[p] > 0.0 else 0
        if kind in (0, MEAN):
            velocities_into(operators, points[p], now)
        if kind in (DESIRED, MEAN):
            velocities_into(operators, target_points[p], then)
        for c in range(cameras):
            w = weights[c, p] * wanted[c, p]
            if not w > 0.0:
                continue
            P = matrices[c]
            for j in range(n):
                rows[0, j] = 0.0
                rows[1, j] = 0.0
            if kind == MEAN:
                add_rows(P, points[p], now, 0.5, rows)
                add_rows(P, target_points[p], then, 0.5, rows)
            elif kind == DESIRED:
                add_rows(P, target_points[p], then, 1.0, rows)
            elif kind == FIXED_DEPTH:
                # On the ray of the present point, at the depth of the target: P maps the centre to nothing.
                M, T = points[p], target_points[p]
                depth = P[2, 0] * M[0] + P[2, 1] * M[1] + P[2, 2] * M[2] + P[2, 3] * M[3]
                wanted_depth = P[2, 0] * T[0] + P[2, 1] * T[1] + P[2, 2] * T[2] + P[2, 3] * T[3]
                for i in range(4):
                    eye = camera_centres[c, i]
                    moved[i] = eye + (wanted_depth / depth) * (M[i] - eye)
                velocities_into(operators, moved, now)
                add_rows(P, moved, now, 1.0, rows)
            else:
                add_rows(P, points[p], now, 1.0, rows)
            u = gain * (set_points[c, p, 0] - pixels[c, p, 0]) + rates[c, p, 0]
            v = gain * (set_points[c, p, 1] - pixels[c, p, 1]) + rates[c, p, 1]
            add_pixel_equations(rows, u, v, w * w, N, b)


@kernel
def image_step(
    operators: FloatArray,
    matrices: FloatArray,
    camera_centres: FloatArray,
    points: FloatArray,
    target_points: FloatArray,
    target_known: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    rates: FloatArray,
    weights: FloatArray,
    wanted: FloatArray,
    gain: float,
    choice: int,
    damping: float,
) -> tuple[FloatArray, float]:
    """`image.image_velocity` as a kernel: joint velocity (n,) and conditioning."""
    n = operators.shape[0]
    N, b, x = np.empty((n, n)), np.empty(n), np.zeros(n)
    image_equations_into(
        operators, matrices, camera_centres, points, target_points, target_known, pixels, set_points, rates,
        weights, wanted, gain, choice, N, b,
    )  # fmt: skip
    conditioning = damped_solve(N, b, damping, x)
    return x, conditioning


@kernel
def limit_into(
    operators: FloatArray, centre: FloatArray, rotation_rate: float, translation_rate: float, x: FloatArray
) -> None:
    """Scale a velocity ``x`` (n,) so that the body turns no faster than [rad/s], its centre (4,) moves no faster than

    [lengths of the frame's coordinates a second].
    """
    square, speed = 0.0, 0.0
    twist = np.zeros((4, 4))
    for j in range(x.shape[0]):
        for i in range(4):
            for k in range(4):
                twist[i, k] += x[j] * operators[j, i, k]
    for i in range(4):
        s = 0.0
        for k in range(4):
            square -= 0.5 * twist[i, k] * twist[k, i]
            s += twist[i, k] * centre[k]
        speed += s * s
    factor = 1.0
    turn, speed = math.sqrt(max(0.0, square)), math.sqrt(speed)
    if turn > rotation_rate:
        factor = rotation_rate / turn
    if speed > translation_rate:
        factor = min(factor, translation_rate / speed)
    for j in range(x.shape[0]):
        x[j] *= factor
