"""Composition of joint displacements, in numpy and as kernels: the effect of a small motion of all joints on points and
on the joint operators; and a basis of the rigid motions of points.

An arm re-zeroed at its current configuration (Theorem 10) is described by its operators there: ``H(q+Δq) H(q)⁻¹`` is
their product of exponentials. ``displacement`` and ``moved_operators`` are the readable references; the loop runs the
kernels ``displace`` and ``move_operators``.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from stereoservo.geometry.screws import exp_twist as exp_twist_reference
from stereoservo.kinematics.kernels import exp_twist, invert4, multiply4_into
from stereoservo.numerics.arrays import FloatArray
from stereoservo.numerics.compilation import kernel


class Composition(IntEnum):
    """The order in which the joints of an arm act on the markers."""

    BASE_FIRST = 0
    """Product of exponentials, base joint leftmost (5.18): cameras are static."""
    TIP_FIRST = 1
    """Tip joint leftmost: cameras are mounted on the tip."""
    SIMULTANEOUS = 2
    """All joints act at once, ``exp(Σ Δq_j Ĥ_j)``, with constant operators: an arm commanded by Cartesian twists."""


class CurrentArm(NamedTuple):
    """An arm at its current configuration: its ``operators`` (n, 4, 4) there (5.21), and their `Composition`."""

    operators: FloatArray
    composition: int


def displacement(operators: FloatArray, composition: Composition, step: FloatArray) -> FloatArray:
    """Displacement (4, 4) of points by a motion ``step`` (n,) of the joints; ``operators`` (n, 4, 4) before it."""
    if composition == Composition.SIMULTANEOUS:
        return exp_twist_reference(np.tensordot(step, operators, axes=1))
    H = np.eye(4)
    for j in _order(composition, len(step)):
        H = H @ exp_twist_reference(step[j] * operators[j])
    return H


def moved_operators(operators: FloatArray, composition: Composition, step: FloatArray) -> FloatArray:
    """The operators (n, 4, 4) after a motion of the joints by ``step`` (n,) (5.21)."""
    if composition == Composition.SIMULTANEOUS:
        return operators.copy()
    moved = np.empty_like(operators)
    H = np.eye(4)
    for j in _order(composition, len(step)):
        moved[j] = H @ operators[j] @ np.linalg.inv(H)
        H = H @ exp_twist_reference(step[j] * operators[j])
    return moved


def _order(composition: Composition, n: int) -> range:
    return range(n - 1, -1, -1) if composition == Composition.TIP_FIRST else range(n)


@kernel
def _follow_joint(H: FloatArray, operator: FloatArray, step: float, product: FloatArray) -> None:
    """Multiply ``H`` (4, 4) in place: ``H exp(step Ĥ)``; ``product`` (4, 4) is scratch."""
    multiply4_into(H, exp_twist(step * operator), product)
    for i in range(4):
        for k in range(4):
            H[i, k] = product[i, k]


@kernel
def displace(operators: FloatArray, composition: int, step: FloatArray) -> FloatArray:
    """`displacement` as a kernel."""
    n = step.shape[0]
    if composition == 2:
        total = np.zeros((4, 4))
        for j in range(n):
            for i in range(4):
                for k in range(4):
                    total[i, k] += step[j] * operators[j, i, k]
        return exp_twist(total)
    H, product = np.eye(4), np.empty((4, 4))
    for nth in range(n):
        j = n - 1 - nth if composition == 1 else nth
        _follow_joint(H, operators[j], step[j], product)
    return H


@kernel
def move_operators(operators: FloatArray, composition: int, step: FloatArray) -> FloatArray:
    """`moved_operators` as a kernel."""
    n = step.shape[0]
    moved = operators.copy()
    if composition == 2:
        return moved
    H, product = np.eye(4), np.empty((4, 4))
    for nth in range(n):
        j = n - 1 - nth if composition == 1 else nth
        multiply4_into(H, operators[j], product)
        multiply4_into(product, invert4(H), moved[j])
        _follow_joint(H, operators[j], step[j], product)
    return moved


def displacement_basis(projective_to_euclidean: FloatArray, points: FloatArray) -> FloatArray:
    """Twists (6, 4, 4): translations along three axes, then rotations about them through the centroid of ``points``
    (m, 4). The unit of translation is the largest distance of a point from the centroid, so all six are of similar
    size.
    """
    H = np.asarray(projective_to_euclidean, dtype=np.float64)
    euclidean = points @ H.T
    euclidean = euclidean[:, :3] / euclidean[:, 3:]
    centroid = euclidean.mean(axis=0)
    size = float(np.sqrt(((euclidean - centroid) ** 2).sum(axis=1).max())) or 1.0
    basis = np.zeros((6, 4, 4))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        basis[k, k, 3] = size
        basis[3 + k, j, i], basis[3 + k, i, j] = 1.0, -1.0
        basis[3 + k, j, 3], basis[3 + k, i, 3] = -centroid[i], centroid[j]
    twists: FloatArray = np.linalg.inv(H) @ basis @ H
    return twists
