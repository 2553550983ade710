"""One to three prismatic joints (thesis 6.1): a linear system, in any projective frame."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.inverse.branches import Branches

INDEPENDENT = 1e-9
"""Least over largest singular value of the joints' directions that are not linearly dependent."""


def prismatic_joints(operators: FloatArray, A: FloatArray, target: FloatArray) -> Branches:
    """Positions [m] of n joints of operators (n, 4, 4) that take points ``A`` (m, 4) to ``target`` (m, 4) (6.6).

    Planes through each target, its orthogonal complement (3, 4), hold the moved point: no heights are needed. Where
    the target is off what the joints reach, the least squares over these planes; where directions depend on one
    another, the least motion, with these joints marked free.
    """
    rows, sides = [], []
    for point, goal in zip(A, target, strict=True):
        planes = np.linalg.svd(goal[None] / np.linalg.norm(goal))[2][1:]
        rows.append(planes @ (operators @ point).T)
        sides.append(-planes @ point)
    matrix, side = np.concatenate(rows), np.concatenate(sides)
    steps, _, _, singular = np.linalg.lstsq(matrix, side, rcond=INDEPENDENT)
    dependent = singular <= INDEPENDENT * max(float(singular[0]), 1e-300)
    free = np.zeros(len(operators), dtype=bool)
    if len(singular) < len(operators) or dependent.any():
        kernel = np.linalg.svd(matrix)[2][int((~dependent).sum()) :]
        free = np.abs(kernel).max(axis=0) > INDEPENDENT
    return Branches(steps[None], np.zeros((1, len(operators))), free[None])
