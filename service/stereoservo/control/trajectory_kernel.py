"""`control.trajectory` as a kernel: the step of the joints that moves the images as meant, held for a whole step."""

from __future__ import annotations

import math

import numpy as np

from stereoservo.control.image_kernel import add_rows, image_step_into, velocities_into
from stereoservo.control.step_correction import CONVERGED, ITERATIONS, SLACK
from stereoservo.control.step_correction_kernel import step_into
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.kernels import kernel, project_points, transform_points_into
from stereoservo.kinematics.linear_kernels import add_pixel_equations, damped_solve


@kernel
def trajectory_step(
    operators: FloatArray,
    composition: int,
    matrices: FloatArray,
    camera_centres: FloatArray,
    points: FloatArray,
    pixels: FloatArray,
    set_points: FloatArray,
    rates: FloatArray,
    weights: FloatArray,
    wanted: FloatArray,
    gain: float,
    dt_s: float,
    damping: float,
) -> tuple[FloatArray, float]:
    """`trajectory.trajectory_velocity` as a kernel: joint velocity (n,) and conditioning."""
    n, cameras, markers = operators.shape[0], matrices.shape[0], points.shape[0]
    x = np.zeros(n)
    known = np.zeros(markers)
    held = -math.expm1(-gain * dt_s) / dt_s if dt_s > 0.0 else gain
    conditioning = image_step_into(
        operators, matrices, camera_centres, points, points, known, pixels, set_points, rates, weights, wanted,
        held, 0, damping, x,
    )  # fmt: skip
    if not dt_s > 0.0 or conditioning == 0.0:
        return x, conditioning
    goal, _ = project_points(matrices, points)
    for c in range(cameras):
        for p in range(markers):
            if weights[c, p] * wanted[c, p] > 0.0:
                for r in range(2):
                    goal[c, p, r] += dt_s * (rates[c, p, r] + held * (set_points[c, p, r] - pixels[c, p, r]))
    found, best = np.empty(n), np.empty(n)
    for j in range(n):
        found[j] = x[j] * dt_s
        best[j] = found[j]
    H, turned, work = np.empty((4, 4)), np.empty((n, 4, 4)), np.empty((5, 4, 4))
    N, b, change = np.empty((n, n)), np.empty(n), np.empty(n)
    rows, velocity, moved = np.empty((2, n)), np.empty((n, 4)), np.empty((markers, 4))
    before = math.inf
    for _ in range(ITERATIONS):
        step_into(operators, composition, found, H, turned, work)
        transform_points_into(H, points, moved)
        seen, _ = project_points(matrices, moved)
        error = 0.0
        for c in range(cameras):
            for p in range(markers):
                w = weights[c, p] * wanted[c, p]
                if w > 0.0:
                    for r in range(2):
                        error += (w * (goal[c, p, r] - seen[c, p, r])) ** 2
        if not error <= SLACK * before:
            break
        before = error
        for j in range(n):
            best[j] = found[j]
            b[j] = 0.0
            for k in range(n):
                N[j, k] = 0.0
        for p in range(markers):
            velocities_into(turned, moved[p], velocity)
            for c in range(cameras):
                w = weights[c, p] * wanted[c, p]
                if not w > 0.0:
                    continue
                for j in range(n):
                    rows[0, j] = 0.0
                    rows[1, j] = 0.0
                add_rows(matrices[c], moved[p], velocity, 1.0, rows)
                u, v = goal[c, p, 0] - seen[c, p, 0], goal[c, p, 1] - seen[c, p, 1]
                add_pixel_equations(rows, u, v, w * w, N, b)
        damped_solve(N, b, damping, change)
        most = 0.0
        for j in range(n):
            found[j] += change[j]
            most = max(most, abs(change[j]))
        if most < CONVERGED:
            break
    for j in range(n):
        x[j] = best[j] / dt_s
    return x, conditioning
