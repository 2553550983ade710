"""Control law ``points``: moves the triangulated marker points to their goal points in projective space (thesis 8.13 to
8.17, 8.34), with differences measured in pixels.

A projective frame has no lengths of its own: a displacement of a point is measured by its motion in the images of all
cameras. So the command does not depend on the frame.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.law import DAMPING, Law, LawProperties, LawStep, Options, Scene, Task
from stereoservo.control.laws.stereo import (
    DESIRED,
    MEAN,
    Gains,
    gain_held,
    held_gain,
    image_reasons,
    limited,
    pixel_gradients,
    velocities_into,
)
from stereoservo.numerics.arrays import FloatArray, Record
from stereoservo.numerics.compilation import Fields, kernel
from stereoservo.numerics.linear import add_equation, damped_solve


@kernel
def pixel_metrics(matrices: FloatArray, points: FloatArray) -> FloatArray:
    """``J_G P`` of all cameras (m, 2c, 4): converts a displacement of a point (m, 4) to pixels; NaN at depth 0."""
    out = np.empty((points.shape[0], 2 * matrices.shape[0], 4))
    for p in range(points.shape[0]):
        out[p] = pixel_gradients(matrices, points[p])
    return out


class PointTask(NamedTuple):
    """Marker ``points`` (m, 4) and their goal points ``target_points`` (m, 4), with ``weights`` (m,), 0 where the goal
    point is unknown; ``metrics`` (m, k, 4): convert a displacement of each to k numbers, such as pixels.
    """

    points: FloatArray
    target_points: FloatArray
    weights: FloatArray
    metrics: FloatArray


@kernel
def points_step(operators: FloatArray, task: PointTask, gains: Gains) -> tuple[FloatArray, float]:
    """The law's step as a kernel: joint velocity (n,) and conditioning."""
    points, target_points, weights, metrics = task
    gain, choice, damping = gains
    n, markers, rows = operators.shape[0], points.shape[0], metrics.shape[1]
    N = np.zeros((n, n))
    b = np.zeros(n)
    x = np.zeros(n)
    around = np.empty(4)
    velocity = np.empty((n, 4))
    row = np.empty(n)
    for p in range(markers):
        w = weights[p]
        if not w > 0.0:
            continue
        for i in range(4):
            if choice == MEAN:
                around[i] = 0.5 * (points[p, i] + target_points[p, i])
            elif choice == DESIRED:
                around[i] = target_points[p, i]
            else:
                around[i] = points[p, i]
        velocities_into(operators, around, velocity)
        for r in range(rows):
            g = metrics[p, r]
            error = 0.0
            for i in range(4):
                error += g[i] * (target_points[p, i] - points[p, i])
            for j in range(n):
                row[j] = g[0] * velocity[j, 0] + g[1] * velocity[j, 1] + g[2] * velocity[j, 2] + g[3] * velocity[j, 3]
            add_equation(row, error, w * w, N, b)
    conditioning = damped_solve(N, b, damping, x)
    if choice == MEAN:
        # The mean yields 2 tan(θ/2) for a rotation by θ: convert to the angle.
        square = 0.0
        for i in range(4):
            for k in range(4):
                ik, ki = 0.0, 0.0
                for j in range(n):
                    ik += x[j] * operators[j, i, k]
                    ki += x[j] * operators[j, k, i]
                square -= 0.5 * ik * ki
        if square > 0.0:
            half = 0.5 * math.sqrt(square)
            gain *= math.atan(half) / half
    for i in range(n):
        x[i] *= gain
    return x, conditioning


@kernel
def step_by_points(operators: FloatArray, task: Fields, gains: Fields) -> tuple[FloatArray, float]:
    """`points_step` for Python, with the fields of a `PointTask` and of `Gains`."""
    return points_step(operators, PointTask(*task), Gains(*gains))


@kernel
def points_kernel(workspace: Record) -> None:
    """The law's ``kernel``."""
    work = workspace[0]
    n, c, m = work.joints, work.cameras, work.markers
    body = work.body[: 4 * m].reshape((m, 4))
    seen = np.zeros(m)
    for i in range(m):
        for k in range(c):
            seen[i] = max(seen[i], work.usable[k * m + i])
        seen[i] *= 1.0 if work.target_known[i] > 0.0 else 0.0
    task = PointTask(
        body,
        work.target_points[: 4 * m].reshape((m, 4)),
        seen,
        pixel_metrics(work.matrices[: 12 * c].reshape((c, 3, 4)), body),
    )
    velocity, work.conditioning = points_step(
        work.operators[: 16 * n].reshape((n, 4, 4)),
        task,
        Gains(gain_held(work.gain, work.dt_s), work.jacobian_choice, DAMPING),
    )
    work.velocity[:n] = velocity


def points(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = gain·J⁺(M* − M)`` over the markers that any camera sees and whose goal is known, in pixels.

    With the mean Jacobian ``Ĥ_j (M + M*)/2`` the motion is the screw from the current pose to the goal, from any pose
    less than half a turn away. There is no fixed depth in space: that choice means the current points.
    """
    measured = (scene.points, task.target_points, _seen(scene, task), pixel_metrics(scene.matrices, scene.points))
    gains = (held_gain(options), int(options.jacobian), options.damping)
    velocity, conditioning = step_by_points(scene.operators, measured, gains)
    return limited(scene, task, options, velocity, conditioning)


def _seen(scene: Scene, task: Task) -> FloatArray:
    """Weights (m,) of the markers: of the camera with the highest weight, 0 if the goal's point is unknown."""
    found: FloatArray = scene.weights.max(axis=0, initial=0.0) * (task.target_known > 0.0)
    return found


LAW = Law(
    points,
    "on points in space, their errors measured in pixels",
    needs_pose=True,
    one_camera="refused",
    options=("jacobian",),
    reasons=image_reasons,
    kernel=points_kernel,
    properties=LawProperties(
        centre="aside, less",
        face="not kept",
        works_on="points, measured in pixels",
        noise_at_rest="low",
        one_camera="goes on",
        fails_when="as `stereo`",
    ),
    colour="#1b7837",
    rank=30,
)
