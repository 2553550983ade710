"""A velocity held for a whole step that makes the motion that was meant (thesis 8.5.2).

The screws of a law hold for an instant: driven together for a whole step, joints turn one another's axes, and what
comes out is off by the brackets of (8.46). Instead of their series, Newton's method finds the step of the joints that
displaces the body's points exactly as meant, from the first-order step on. The readable reference of
`control.step_correction_kernel`.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.kinematics.composition import Composition, displacement, moved_operators

ITERATIONS = 6
CONVERGED = 1e-12
"""Of the joints' step: below it another iteration changes nothing."""

SLACK = 1.0 + 1e-9
"""What the squared error may grow by: near its least value it does not tell steps apart."""

BRACKETS = 6
"""Terms of the series of how exp turns a sum's operators; a step is small."""

DAMPING = 1e-12
"""Relative to the largest diagonal of the normal matrix: an arm that can do it in many ways takes the least change."""


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
