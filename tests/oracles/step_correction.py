"""Corrected steps in numpy: the readable reference of `control.step_correction`."""

from __future__ import annotations

import numpy as np

from stereoservo.control.step_correction import BRACKETS, CONVERGED, DAMPING, ITERATIONS, SLACK
from stereoservo.kinematics.composition import Composition, displacement, moved_operators
from stereoservo.numerics.arrays import FloatArray


def corrected_step(
    operators: FloatArray, composition: Composition, points: FloatArray, wanted: FloatArray, step: FloatArray
) -> FloatArray:
    """The joints' step (n,) that brings ``points`` (k, 4) to ``wanted`` (k, 4), from ``step`` (n,) to first order.

    ``operators`` (n, 4, 4) before it; the points, 3 or more, span the body. Where no step does it (an arm of few
    freedoms) the nearest; where Newton's method does not get nearer than ``step`` is, ``step``.
    """
    found, before = step.copy(), np.inf
    best = step
    for _ in range(ITERATIONS):
        moved = points @ displacement(operators, composition, found).T
        residual = wanted - moved
        error = float((residual**2).sum())
        if not error <= SLACK * before:
            break
        best, before = found, error
        turned = step_operators(operators, composition, found)
        J = np.einsum("nij,kj->kin", turned, moved).reshape(-1, len(step))
        N = J.T @ J
        N += DAMPING * np.diag(N).max() * np.eye(len(step))
        change = np.linalg.solve(N, J.T @ residual.reshape(-1))
        found = found + change
        if float(np.abs(change).max()) < CONVERGED:
            return found
    return best


def step_operators(operators: FloatArray, composition: Composition, step: FloatArray) -> FloatArray:
    """``∂H/∂q_j H⁻¹`` (n, 4, 4) of the displacement ``H`` by ``step`` (n,): the operators after it, or of a sum."""
    if composition != Composition.SIMULTANEOUS:
        return moved_operators(operators, composition, step)
    X = np.tensordot(step, operators, axes=1)
    total, term = operators.copy(), operators
    for k in range(BRACKETS):
        term = (X @ term - term @ X) / (k + 2)
        total = total + term
    return total
