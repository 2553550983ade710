"""The incidence law in numpy: the readable reference of `control.incidence_kernel`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereoservo.control import incidence_kernel as kernels
from stereoservo.control.incidence import IncidenceStatus, IncidenceStep, IncidenceTask
from stereoservo.control.incidence_kernel import METRIC_FLOOR, SecondTask, fixed_dimension, moving_count
from stereoservo.control.law import Options, Scene
from stereoservo.kinematics.composition import Composition, displacement
from stereoservo.kinematics.kernels import image_jacobian
from stereoservo.numerics.arrays import FloatArray
from stereoservo_sim.benchmarks.cycle import damped_least_squares_reference


def joint_metric_reference(operators: FloatArray, matrices: FloatArray, points: FloatArray) -> FloatArray:
    """Pixels (n,) that a unit of each joint moves the points by, rms over points and cameras [px/rad or px/m].

    A hundredth of the largest at least, so that no joint turns for nothing.
    """
    J = image_jacobian(operators, matrices, points)
    metric = np.sqrt((J**2).sum(axis=(0, 1, 2)) / (J.shape[0] * J.shape[1]))
    floored = np.maximum(metric, METRIC_FLOOR * metric.max())
    return np.where(floored > 0.0, floored, 1.0)


@dataclass(frozen=True, eq=False)
class _Residual:
    """A point against a feature: ``gradient`` (2c, 4), ``normal`` (2c, 2c) projects off the feature's directions."""

    marker: int
    owner: int
    base: FloatArray
    directions: FloatArray
    gradient: FloatArray
    normal: FloatArray

    @classmethod
    def of(
        cls,
        matrices: FloatArray,
        X: FloatArray,
        base: FloatArray,
        directions: FloatArray,
        marker: int,
        owner: int,
    ) -> _Residual:
        m = matrices @ X
        gradient = (matrices[:, :2] - (m[:, :2] / m[:, 2:])[..., None] * matrices[:, 2:]) / m[:, 2, None, None]
        A = gradient.reshape(-1, 4)
        T = A @ directions.T
        return cls(marker, owner, base, directions, A, np.eye(len(A)) - T @ np.linalg.pinv(T))

    def distance(self, matrices: FloatArray, X: FloatArray) -> float:
        """Largest pixel distance to the nearest point of the feature, as `image_distance` says."""
        first = self.gradient @ (X - self.base)
        along = np.linalg.pinv(self.gradient @ self.directions.T) @ first
        Y = self.base + along @ self.directions
        here, there = matrices @ X, matrices @ Y
        before = here[:, 2] * there[:, 2] > 0.0
        exact = here[:, :2] / here[:, 2:] - there[:, :2] / there[:, 2:]
        linear = (self.normal @ first).reshape(-1, 2)
        return float(np.linalg.norm(np.where(before[:, None], exact, linear), axis=1).max())


def incidence_reference(
    scene: Scene, task: IncidenceTask, options: Options, second: SecondTask, metric: FloatArray
) -> IncidenceStep:
    """`incidence_step` in numpy, but for a task at rest far from its goal: no way out, nobody to blame."""
    residuals = [
        _Residual.of(scene.matrices, scene.points[i], form[0], form[1 : 1 + fixed_dimension(kind)], i, k)
        for k, (kind, own, form) in enumerate(zip(task.kinds.tolist(), task.markers, task.fixed, strict=True))
        for i in own[: moving_count(kind)].tolist()
    ]
    e = np.concatenate([r.normal @ (r.gradient @ (scene.points[r.marker] - r.base)) for r in residuals])
    J = np.concatenate([r.normal @ r.gradient @ (scene.operators @ scene.points[r.marker]).T for r in residuals])
    error = np.array(
        [
            max(r.distance(scene.matrices, scene.points[r.marker]) for r in residuals if r.owner == k)
            for k in range(len(task.kinds))
        ]
    )
    U, values, Vt = np.linalg.svd(J / metric)
    n = len(metric)
    sigma = np.zeros(n)
    sigma[: len(values)] = values
    along = np.zeros(n)
    along[: len(values)] = values * (U[:, : len(values)].T @ e)
    rank = int((sigma > kernels.RANK * sigma[0]).sum())
    along[rank:] = 0.0
    share = float(np.sqrt(min(1.0, ((along[:rank] / sigma[:rank]) ** 2).sum() / max(float(e @ e), 1e-300))))
    ahead = min(1.0, max(options.gain * options.dt_s, kernels.AHEAD))
    damp = options.damping * sigma[0] ** 2
    step = np.zeros(n)
    for _ in range(kernels.ATTEMPTS if rank else 0):
        step = -(Vt.T @ (along / (sigma**2 + damp))) / metric
        change = ahead * (J @ step)
        predicted = float(e @ e - (e + change) @ (e + change))
        moved = scene.points @ displacement(scene.operators, Composition(scene.composition), ahead * step).T
        left = sum(float(((r.normal @ (r.gradient @ (moved[r.marker] - r.base))) ** 2).sum()) for r in residuals)
        if predicted <= 1e-12 * float(e @ e) or float(e @ e) - left >= kernels.SUFFICIENT * predicted:
            break
        damp = max(kernels.GROWTH * damp, 1e-3 * sigma[0] ** 2)
    rates = np.concatenate([r.normal @ r.gradient @ task.drift @ scene.points[r.marker] for r in residuals])
    fed = np.zeros(n)
    fed[: len(values)] = values * (U[:, : len(values)].T @ rates)
    fed[rank:] = 0.0
    forward = Vt.T @ (fed / (sigma**2 + options.damping * sigma[0] ** 2)) / metric
    velocity = options.gain * step + forward
    if rank < n and len(second.rates):
        S = (second.rows / metric) @ (Vt[rank:].T @ Vt[rank:])
        left_over = second.rates - second.rows @ velocity
        y, _ = damped_least_squares_reference(S, left_over, second.weights, options.damping)
        velocity = velocity + y / metric
    status = np.where(error <= task.tolerance_px, int(IncidenceStatus.DONE), int(IncidenceStatus.MOVES))
    conditioning = float((sigma[rank - 1] / sigma[0]) ** 2) if rank else 0.0
    return IncidenceStep(velocity, error, status, rank, conditioning, share)
