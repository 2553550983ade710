"""The controller's estimate of the markers in its projective frame: predicted by kinematics, corrected by pixels.

As in the running cell, the innovation of all markers is reduced to one displacement of the body, of which each frame
applies a share. Noise is thus averaged over ``FILTER_S``, and a camera that drops out leaves a prediction to continue
with. The weak directions of a single camera are corrected less: earlier observations of the others keep their weight.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from stereoservo.kinematics.composition import displace
from stereoservo.kinematics.kernels import (
    exp_twist,
    image_jacobian,
    project_points,
    transform_points,
    triangulate,
)
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel
from stereoservo.numerics.linear import damped_least_squares
from stereoservo_sim.tasks.calibrations import Knowledge

PointsName = Literal["predicted", "triangulated"]

FILTER_S, REST_FILTER_S = 0.5, 2.0
"""Averaging time of innovations, moving and at rest (without new kinematic errors); at the start over all frames so
far.
"""
REST_PX_S = 5.0
"""A body whose markers are slower in all images is at rest."""
DAMPING = 1e-9
FIRST_ROUNDS = 5


class MarkerEstimate:
    """Current points (m, 4) of scale 1 and pixels (c, m, 2), in the laws' form."""

    def __init__(self, knowledge: Knowledge, source: PointsName, dt_s: float) -> None:
        self._knowledge = knowledge
        self.triangulates = source == "triangulated" or knowledge.points is None
        self._dt_s = dt_s
        self._frames = 0
        self._rests = True
        self.points = np.zeros((0, 4)) if knowledge.points is None else knowledge.points
        self.pixels = np.zeros((0, 0, 2))
        self._residual = np.zeros((0, 0, 2))

    def moved(self, operators: FloatArray, step: FloatArray) -> None:
        """Predict after a joint motion by ``step`` (n,), with ``operators`` (n, 4, 4) before it."""
        before, _ = project_points(self._knowledge.matrices, self.points)
        self.points = transform_points(displace(operators, int(self._knowledge.composition), step), self.points)
        after, _ = project_points(self._knowledge.matrices, self.points)
        self._rests = bool(np.abs(after - before).max() < REST_PX_S * self._dt_s)

    def seen(self, pixels: FloatArray, weights: FloatArray) -> None:
        """Correct by a frame of every camera: pixels (c, m, 2), weights (c, m), 0 if a marker is not seen."""
        if self.triangulates:
            self._triangulate(pixels, weights)
            return
        basis, matrices = self._knowledge.basis, self._knowledge.matrices
        if self._frames == 0:
            self._residual = np.zeros_like(pixels)
            for _ in range(FIRST_ROUNDS):
                self.points = corrected(basis, matrices, self.points, pixels, weights, 1.0)
        memory_s = REST_FILTER_S if self._rests else FILTER_S
        self._frames = min(self._frames, round(memory_s / self._dt_s)) + 1
        share = 1.0 / self._frames
        self.points = corrected(basis, matrices, self.points, pixels, weights, share)
        predicted, _ = project_points(matrices, self.points)
        # The part that no displacement explains is averaged for each marker.
        self._residual += np.where(weights[..., None] > 0.0, share * (pixels - predicted - self._residual), 0.0)
        self.pixels = predicted + self._residual

    def _triangulate(self, pixels: FloatArray, weights: FloatArray) -> None:
        found, ok = triangulate(self._knowledge.matrices, pixels, weights, 3)
        found = found / (found @ self._knowledge.plane_at_infinity)[:, None]
        self.points = found if self._frames == 0 else np.where(ok[:, None], found, self.points)
        self._frames += 1
        predicted, _ = project_points(self._knowledge.matrices, self.points)
        self.pixels = np.where(weights[..., None] > 0.0, pixels, predicted)


@kernel
def corrected(
    basis: FloatArray,
    matrices: FloatArray,
    points: FloatArray,
    pixels: FloatArray,
    weights: FloatArray,
    share: float,
) -> FloatArray:
    """Points (m, 4) displaced by ``share`` of the least-squares displacement for ``pixels`` (c, m, 2), ``basis``
    (r, 4, 4).

    The prediction counts as ``1/share - 1`` frames of all cameras; cameras of weight 0 contribute nothing now.
    """
    cameras, markers, freedoms = matrices.shape[0], points.shape[0], basis.shape[0]
    jacobian = image_jacobian(basis, matrices, points)
    predicted, _ = project_points(matrices, points)
    rows = 2 * cameras * markers
    J = np.zeros((2 * rows, freedoms))
    e = np.zeros(2 * rows)
    w = np.zeros(2 * rows)
    largest = 0.0
    for c in range(cameras):
        for p in range(markers):
            largest = max(largest, weights[c, p])
    prior = np.sqrt(1.0 / share - 1.0)
    row = 0
    for c in range(cameras):
        for p in range(markers):
            for k in range(2):
                for j in range(freedoms):
                    J[row, j] = jacobian[c, p, k, j]
                    J[rows + row, j] = jacobian[c, p, k, j]
                if weights[c, p] > 0.0:
                    e[row] = pixels[c, p, k] - predicted[c, p, k]
                    w[row] = weights[c, p] / largest
                w[rows + row] = prior
                row += 1
    step, _ = damped_least_squares(J, e, w, DAMPING)
    twist = np.zeros((4, 4))
    for j in range(freedoms):
        for i in range(4):
            for k in range(4):
                twist[i, k] += step[j] * basis[j, i, k]
    return transform_points(exp_twist(twist), points)
