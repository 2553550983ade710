"""Control law ``trajectory``: tracks the moving set-points and joints of a planned path in the images of all cameras,
by feed-forward and feedback (thesis 8, 9.3).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stereoservo.control.law import Law, LawProperties, LawStep, Options, Scene, Task
from stereoservo.control.laws.stereo import Body, View, image_equations_into, image_reasons, limited
from stereoservo.control.step_correction import CONVERGED, ITERATIONS, SLACK, joint_screws, step_into
from stereoservo.kinematics.composition import CurrentArm
from stereoservo.kinematics.kernels import project_points, transform_points_into
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import Fields, kernel
from stereoservo.numerics.linear import NormalSystem, cholesky_solve, damped_solve

JOINT_SHARE = 1e-4
"""Squared weight of a planned joint, relative to the images' in the same joint.

Lower bound: arm and plan disagree on lengths by some fraction ``ε`` of the arm's reach R. If an elbow of depth
``c δ²``, ``c`` about R/4, is stretched, images and joints have one solution, the plan's side, if this weight,
``share``, satisfies ``share·R² > 2 c ε``: 1e-4 is right for ``ε`` up to 2e-4 of the reach, more than remains after
calibration. Upper bound: the joints bias a well determined direction by 1e-4 of their disagreement, below image noise.
"""


class PlannedJoints(NamedTuple):
    """Joints of a plan at present: ``rates`` (n,), ``error`` (n,), and their ``weight`` [0, 1]; empty arrays without a
    plan.
    """

    rates: FloatArray
    error: FloatArray
    weight: float


class Pull(NamedTuple):
    """Weights ``pull`` (n,) of the velocities ``meant`` (n,) by the plan; ``planned``: whether there is one."""

    pull: FloatArray
    meant: FloatArray
    planned: bool


class HeldStep(NamedTuple):
    """The ``gain`` [1/s], the time ``dt_s`` [s] for which the velocity is held, and ``damping`` relative to the largest
    diagonal element of the normal matrix.
    """

    gain: float
    dt_s: float
    damping: float


@kernel
def trajectory_step(
    arm: Fields, view: Fields, points: FloatArray, plan: Fields, held_step: Fields
) -> tuple[FloatArray, float]:
    """Joint velocity (n,) and conditioning; for ``dt_s`` > 0 refined by Newton's method on the images.

    The fields of a `CurrentArm`, a `View`, of `PlannedJoints` and of a `HeldStep`; ``points`` (m, 4).
    """
    seen, joints = View(*view), PlannedJoints(*plan)
    operators, composition = arm
    gain, dt_s, damping = held_step
    n = operators.shape[0]
    x, pull, meant = np.zeros(n), np.zeros(n), np.zeros(n)
    known = np.zeros(points.shape[0])
    held = -math.expm1(-gain * dt_s) / dt_s if dt_s > 0.0 else gain
    N, b = np.empty((n, n)), np.empty(n)
    image_equations_into(operators, seen, Body(points, points, known), held, 0, NormalSystem(N, b))
    planned = joints.rates.shape[0] == n
    if planned:
        largest = 0.0
        for j in range(n):
            largest = max(largest, N[j, j])
        for j in range(n):
            pull[j] = damping * largest + joints.weight * JOINT_SHARE * N[j, j]
            meant[j] = joints.rates[j] + joints.weight * held * joints.error[j]
            if not math.isfinite(pull[j] * meant[j]):
                return x, 0.0
            N[j, j] += pull[j]
            b[j] += pull[j] * meant[j]
        conditioning = cholesky_solve(N, b, x)
    else:
        conditioning = damped_solve(N, b, damping, x)
    if dt_s > 0.0 and conditioning != 0.0:
        present, longer = CurrentArm(operators, composition), HeldStep(held, dt_s, damping)
        _refine(present, seen, points, Pull(pull, meant, planned), longer, x)
    return x, conditioning


@kernel
def _refine(arm: CurrentArm, view: View, points: FloatArray, plan: Pull, held_step: HeldStep, x: FloatArray) -> None:
    """Refine a held velocity ``x`` (n,), so that the images move as intended to all orders; the gain is that of a
    velocity that is held.
    """
    operators, composition = arm
    held, dt_s, damping = held_step
    matrices, camera_centres, pixels, set_points, rates, weights, required = view
    pull, meant, planned = plan
    n, cameras, markers = operators.shape[0], matrices.shape[0], points.shape[0]
    known = np.zeros(markers)
    N, b = np.empty((n, n)), np.empty(n)
    goal, _ = project_points(matrices, points)
    for c in range(cameras):
        for p in range(markers):
            if weights[c, p] * required[c, p] > 0.0:
                for r in range(2):
                    goal[c, p, r] += dt_s * (rates[c, p, r] + held * (set_points[c, p, r] - pixels[c, p, r]))
    found, best = np.empty(n), np.empty(n)
    for j in range(n):
        found[j] = x[j] * dt_s
        best[j] = found[j]
    H, turned, work = np.empty((4, 4)), np.empty((n, 4, 4)), np.empty((5, 4, 4))
    change, moved = np.empty(n), np.empty((markers, 4))
    no_rates = np.zeros((cameras, markers, 2))
    screws = joint_screws(operators)
    before = math.inf
    for _ in range(ITERATIONS):
        step_into(screws, composition, found, H, turned, work)
        transform_points_into(H, points, moved)
        seen, _ = project_points(matrices, moved)
        error = 0.0
        for c in range(cameras):
            for p in range(markers):
                w = weights[c, p] * required[c, p]
                if w > 0.0:
                    for r in range(2):
                        error += (w * (goal[c, p, r] - seen[c, p, r])) ** 2
        for j in range(n):
            error += pull[j] * (dt_s * meant[j] - found[j]) ** 2
        if not error <= SLACK * before:
            break
        before = error
        for j in range(n):
            best[j] = found[j]
        ahead = View(matrices, camera_centres, seen, goal, no_rates, weights, required)
        image_equations_into(turned, ahead, Body(moved, moved, known), 1.0, 0, NormalSystem(N, b))
        if planned:
            for j in range(n):
                N[j, j] += pull[j]
                b[j] += pull[j] * (dt_s * meant[j] - found[j])
            cholesky_solve(N, b, change)
        else:
            damped_solve(N, b, damping, change)
        most = 0.0
        for j in range(n):
            found[j] += change[j]
            most = max(most, abs(change[j]))
        if most < CONVERGED:
            break
    for j in range(n):
        x[j] = best[j] / dt_s


def trajectory(scene: Scene, task: Task, options: Options) -> LawStep:
    """``q̇ = J⁺(ṡ* + gain (s* − s))``: feed-forward along the path, feedback on the deviation from it.

    In directions that the images hardly determine (near singular postures, self-motions) the joints move as planned, if
    they are planned:
    ``Σ p_j |q̇_j − (q̇*_j + gain (q*_j − q_j))|²`` is added to the objective, with `JOINT_SHARE` of the images' weight.

    The set-points are near, so the Jacobian is always the current one, whatever ``options`` state. One camera is
    sufficient. With ``dt_s`` the velocity, held for that time, moves the images as intended to all orders;
    ``task.rates`` should then be the mean rates of the set-points over the next step. The velocity is zero, with
    conditioning 0, if the planned joints are not finite. Raises ValueError for planned joints of another arm.
    """
    n = len(scene.operators)
    if len(task.joint_rates) not in (0, n) or len(task.joint_error) != len(task.joint_rates):
        raise ValueError(
            f"an arm of {n} joints takes {n} planned rates and errors, or none of both; got "
            f"{len(task.joint_rates)} and {len(task.joint_error)}"
        )
    view = (scene.matrices, scene.camera_centres, scene.pixels, task.set_points, task.rates, scene.weights, task.wanted)
    plan = (task.joint_rates, task.joint_error, task.joint_weight)
    velocity, conditioning = trajectory_step(
        (scene.operators, int(scene.composition)),
        view,
        scene.points,
        plan,
        (options.gain, options.dt_s, options.damping),
    )
    return limited(scene, task, options, velocity, conditioning)


LAW = Law(
    trajectory,
    "along a plan that keeps view and limits, timed to the arm",
    path="planned",
    follows_streams=False,
    options=("centre", "profile"),
    reasons=image_reasons,
    properties=LawProperties(
        centre="along its plan, straight unless bent",
        face="planned",
        works_on="pixels along the plan, velocity fed forward",
        noise_at_rest="low",
        one_camera="goes on",
        fails_when="no way is found: refused before; a goal that moves",
    ),
    colour="#000000",
    rank=60,
)
