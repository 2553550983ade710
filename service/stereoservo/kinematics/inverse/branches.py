"""What a subproblem in closed form answers: candidates, joint by joint, not yet checked against the whole chain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import FloatArray

BoolArray = npt.NDArray[np.bool_]

FREE = 1e-9
"""Radius of a joint's circle, as a share of what its operator could move, below which the joint moves nothing."""


@dataclass(frozen=True, eq=False)
class Branches:
    """k candidates for n joints, as motions from the zero.

    ``steps`` (k, n) [rad or m]. ``excess`` (k, n): by how much a joint's equation fails to have a root, as a share of
    its amplitude; 0 where it has one, infinite where the joint moves nothing that matters. The step is then that of
    the nearest approach. ``free`` (k, n): the equation holds for every position of this joint, which stays at its seed.
    """

    steps: FloatArray
    excess: FloatArray
    free: BoolArray


def single(step: float, excess: float = 0.0, free: bool = False) -> Branches:
    """One candidate of one joint."""
    return Branches(np.array([[step]]), np.array([[excess]]), np.array([[free]]))


def beside(first: Branches, second: Branches) -> Branches:
    """Joints of ``second`` after those of ``first``; the one with a single candidate goes with all of the other."""
    k = max(len(first.steps), len(second.steps))

    def wide(left: npt.NDArray, right: npt.NDArray) -> npt.NDArray:  # type: ignore[type-arg]
        parts = [part if len(part) == k else np.repeat(part, k, axis=0) for part in (left, right)]
        return np.concatenate(parts, axis=1)

    return Branches(
        wide(first.steps, second.steps), wide(first.excess, second.excess), wide(first.free, second.free)
    )


def together(several: list[Branches]) -> Branches:
    """All candidates of ``several``, one list."""
    return Branches(
        np.concatenate([branches.steps for branches in several]),
        np.concatenate([branches.excess for branches in several]),
        np.concatenate([branches.free for branches in several]),
    )


def one_of(branches: Branches, i: int) -> Branches:
    """Candidate ``i`` alone."""
    part = slice(i, i + 1)
    return Branches(branches.steps[part], branches.excess[part], branches.free[part])
