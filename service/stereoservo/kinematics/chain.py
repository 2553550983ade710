"""Forward kinematics and Jacobians of an arm in the cameras' projective frame, as a product of exponentials (thesis
5); reference implementation in numpy.

The loop itself runs on :mod:`stereoservo.kinematics.kernels`, which are tested against this module.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.cameras import projection_jacobian_many
from stereoservo.geometry.displacements import exp_generator
from stereoservo.numerics.arrays import FloatArray

KIND_CODES = {"revolute": 0, "prismatic": 1}


class ChainError(ValueError):
    """A chain or a configuration is malformed; ``data`` holds the values in the message."""

    def __init__(self, message: str, **data: Any) -> None:
        super().__init__(message)
        self.data = data


@dataclass(frozen=True, eq=False)
class ProjectiveChain:
    """``H(q) = exp((q₁−z₁)Ĥ₁)…exp((qₙ−zₙ)Ĥₙ)``, base first (5.18).

    ``kinds``: ``"revolute"`` [rad] or ``"prismatic"`` [m] for each joint. ``generators`` (n, 4, 4) at the zero.
    ``zero`` (n,): the configuration at which H is the identity. ``tip_first``: eye-in-hand (the cameras are mounted on
    the tip, the markers are static). The base joint then acts on the markers first:
    ``H(q) = exp((qₙ−zₙ)Ĥₙ)…exp((q₁−z₁)Ĥ₁)``; joints are still counted from the base, and the signs are part of the
    generators. Raises ChainError for wrong shapes or kinds.
    """

    kinds: tuple[str, ...]
    generators: FloatArray
    zero: FloatArray
    tip_first: bool = False

    def __post_init__(self) -> None:
        generators = np.ascontiguousarray(self.generators, dtype=np.float64)
        zero = np.ascontiguousarray(self.zero, dtype=np.float64)
        n = len(self.kinds)
        if generators.shape != (n, 4, 4) or zero.shape != (n,):
            raise ChainError(
                f"{n} kinds, generators {generators.shape}, zero {zero.shape}; ({n}, 4, 4), ({n},) would fit",
                generators=generators.shape,
                zero=zero.shape,
            )
        for j, kind in enumerate(self.kinds):
            if kind not in KIND_CODES:
                raise ChainError(f"joint {j} is of kind {kind!r}; known: {', '.join(KIND_CODES)}", joint=j, kind=kind)
        if not (np.isfinite(generators).all() and np.isfinite(zero).all()):
            raise ChainError("generators and zero must be finite")
        object.__setattr__(self, "kinds", tuple(self.kinds))
        object.__setattr__(self, "generators", generators)
        object.__setattr__(self, "zero", zero)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.kinds)

    @property
    def kind_codes(self) -> npt.NDArray[np.uint8]:
        """Joint kinds (n,) as codes for the kernels: 0 revolute, 1 prismatic."""
        return np.array([KIND_CODES[kind] for kind in self.kinds], dtype=np.uint8)

    @property
    def order(self) -> tuple[int, ...]:
        """Joint indices in the order of the product's factors: the joint farthest from the markers first."""
        joints = range(self.joints)
        return tuple(reversed(joints)) if self.tip_first else tuple(joints)

    def partial_displacements(self, q: FloatArray) -> FloatArray:
        """Products of the first 0…n factors in the chain's ``order``, ``(n + 1, 4, 4)`` (5.20); the first is
        the identity, the last ``H(q)``.
        """
        steps = self._steps(q)
        partial = np.empty((self.joints + 1, 4, 4))
        partial[0] = np.eye(4)
        for i, j in enumerate(self.order):
            partial[i + 1] = partial[i] @ exp_generator(self.kinds[j], self.generators[j], steps[j])
        return partial

    def displacement(self, q: FloatArray) -> FloatArray:
        """``H(q)`` (4, 4): points at the zero to points at ``q`` (n,) (5.18)."""
        return np.array(self.partial_displacements(q)[-1])

    def displacements(self, configurations: FloatArray) -> FloatArray:
        """``H(q)`` (s, 4, 4) at each of ``configurations`` (s, n) (5.18)."""
        steps = np.array([self._steps(q) for q in configurations]).reshape(-1, self.joints)
        product: FloatArray = np.tile(np.eye(4), (len(steps), 1, 1))
        for j in self.order:
            product = product @ exp_generator(self.kinds[j], self.generators[j], steps[:, j])
        return product

    def operators_at(self, q: FloatArray) -> FloatArray:
        """Generators at the configuration ``q`` (n,), ``Ĥ_j|_Q = H̄_{j−1} Ĥ_j H̄_{j−1}⁻¹`` (n, 4, 4) (5.21)."""
        order = list(self.order)
        partial = self.partial_displacements(q)[:-1]
        operators = np.empty_like(self.generators)
        operators[order] = partial @ self.generators[order] @ np.linalg.inv(partial)
        return operators

    def point_jacobian(self, q: FloatArray, M_now: FloatArray) -> FloatArray:
        """``∂M/∂q_j = Ĥ_j|_Q M`` (m, 4, n) of points ``(m, 4)``, given at ``q`` (5.47)."""
        jacobian: FloatArray = np.einsum("jik,mk->mij", self.operators_at(q), M_now)
        return jacobian

    def image_jacobian(self, Ps: FloatArray, q: FloatArray, M_now: FloatArray) -> FloatArray:
        """``J_G P J_H`` (c, m, 2, n) [px/rad or px/m] of points ``(m, 4)`` at ``q`` in cameras ``(c, 3, 4)`` (8.33)."""
        J_H = self.point_jacobian(q, M_now)
        jacobian: FloatArray = np.einsum("cmik,mkj->cmij", projection_jacobian_many(Ps, M_now), J_H)
        return jacobian

    def _steps(self, q: FloatArray) -> FloatArray:
        q = np.asarray(q, dtype=np.float64)
        if q.shape != self.zero.shape:
            raise ChainError(f"configuration has shape {q.shape}; {self.zero.shape} is needed", shape=q.shape)
        if not np.isfinite(q).all():
            raise ChainError(f"configuration {q.tolist()} is not finite")
        return q - self.zero
