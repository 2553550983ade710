"""Jordan frames of projective translations and rotations, and generators from several homographies (thesis 3, 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oracles.displacement_logarithms import HALF_TURN_SINE, generator_between
from stereoservo.geometry.displacements import nearest_rotation_generator
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.translations import (
    UNWEIGHTED,
    Weighting,
    _some,
)
from stereoservo.numerics.arrays import FloatArray

NILPOTENT_TOLERANCE = 1e-8
"""``|Ĥ²| / |Ĥ|²`` above which a matrix is no generator of a translation."""
JORDAN_TRANSLATION = np.eye(4) + np.outer(np.eye(4)[2], np.eye(4)[3])
"""``J_T`` (3.4): the unit translation along z."""
EVEN_SHARE = 0.17
"""``Σ sin²θ / Σ (1 − cos θ)²`` below which the eigenspaces of the even part are the better ones: 3/4 π."""


@dataclass(frozen=True, eq=False)
class JordanFrame:
    """A frame in which a projective translation is the unit translation along z: ``H = S⁻¹ J S`` (3.5).

    ``planes`` (4, 4): rows ``h₁..h₄`` of S; ``points`` (4, 4): rows ``k₁..k₄``, the columns of S⁻¹
    (3.15). ``k₃`` is the direction of translation, ``h₄`` the plane at infinity; ``k₁``, ``k₂`` other
    directions, ``k₄`` a finite point; ``h₁``, ``h₂`` planes along the translation, ``h₃`` one across it.
    """

    planes: FloatArray
    points: FloatArray

    @property
    def direction(self) -> FloatArray:
        """``k₃`` (4,)."""
        k: FloatArray = self.points[2]
        return k

    @property
    def plane_at_infinity(self) -> FloatArray:
        """``h₄`` (4,)."""
        h: FloatArray = self.planes[3]
        return h

    @property
    def fixed_points(self) -> FloatArray:
        """``k₁, k₂, k₃`` (3, 4): they span the plane at infinity, fixed point by point (3.9)."""
        return self.points[:3]

    @property
    def fixed_planes(self) -> FloatArray:
        """``h₁, h₂, h₄`` (3, 4): they span the planes along the translation, which meet in ``k₃`` (3.10)."""
        return self.planes[[0, 1, 3]]

    def changed(self, C: FloatArray) -> JordanFrame:
        """The frame ``C S`` of the same translation (3.7), ``C`` (4, 4) of `jordan_commutator`."""
        return _frame_of(np.asarray(C, dtype=np.float64) @ self.planes)


def split_generator(G: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``(k, h)`` with ``Ĥ = k hᵀ``, ``|h| = 1`` (3.14), of a translation's generator ``G`` (4, 4).

    The sign is free: ``(−k, −h)`` is the same generator. Raises GeometryError where G is not nilpotent of
    rank one (``Ĥ² = 0``, 3.24).
    """
    G = np.asarray(G, dtype=np.float64)
    if G.shape != (4, 4) or not np.isfinite(G).all():
        raise GeometryError("shape", f"a generator is a finite (4, 4) matrix, got {G.tolist()}", shape=G.shape)
    U, singular, Vt = np.linalg.svd(G)
    square = float(np.linalg.norm(G @ G))
    size = float(singular[0])
    if not (size > 0 and square <= NILPOTENT_TOLERANCE * size**2 and singular[1] <= 1e-6 * size):
        raise GeometryError(
            "degenerate",
            f"singular values {singular.tolist()}, |G²| {square:.3g}; a translation's generator has rank one "
            "and square zero",
            singular=singular.tolist(),
            square=square,
        )
    return U[:, 0] * size, Vt[0]


def jordan_frame(G: FloatArray) -> JordanFrame:
    """One Jordan frame of the translation ``exp(Ĥ) = I + Ĥ``, ``G`` (4, 4) = ``τĤ`` (3.5, 3.8).

    All others are ``frame.changed(jordan_commutator(...))``. Raises GeometryError where G is no generator
    of a translation.
    """
    k, h = split_generator(G)
    k = k - h * (h @ k)
    across = np.linalg.svd(np.stack([k, h]))[2][2:]
    return _frame_of(np.vstack([across, k / (k @ k), h]))


def _frame_of(S: FloatArray) -> JordanFrame:
    points = np.asarray(np.linalg.inv(S).T, dtype=np.float64)
    return JordanFrame(S, points)


def jordan_commutator(parameters: npt.ArrayLike) -> FloatArray:
    """``C_T`` (4, 4) of its ten parameters ``(μ, c11, c12, c14, c21, c22, c24, c31, c32, c34)`` (3.6).

    It commutes with ``J_T``. Raises GeometryError for parameters that make it singular.
    """
    p = np.asarray(parameters, dtype=np.float64)
    if p.shape != (10,):
        raise GeometryError("shape", f"parameters have shape {p.shape}; (10,) is needed", shape=p.shape)
    C = np.eye(4)
    C[:3, [0, 1, 3]] = p[1:].reshape(3, 3)
    minor = float(p[1] * p[5] - p[2] * p[4])
    if not (np.isfinite(p).all() and p[0] != 0 and abs(minor) > 1e-12):
        raise GeometryError(
            "degenerate", f"mu is {p[0]}, c11 c22 - c12 c21 is {minor:.3g}; neither may be zero", minor=minor
        )
    return np.asarray(p[0] * C, dtype=np.float64)


def direction_from_stack(Hs: Sequence[FloatArray] | FloatArray, weighting: Weighting = UNWEIGHTED) -> FloatArray:
    """Direction ``(4,)``, unit norm, common to homographies ``(n, 4, 4)`` of parallel translations (3.38).

    Raises GeometryError for an empty stack and for a homography without trace.
    """
    stack = np.concatenate([weighting.weighted(H).T for H in _some(Hs)])
    return weighting.point(np.linalg.svd(stack)[2][0])


def jordan_rotation(theta: float) -> FloatArray:
    """``J_R(θ)`` (4, 4) (4.8): the rotation by ``theta`` [rad] about z."""
    J = np.eye(4)
    J[:2, :2] = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
    return J


def rotation_commutator(parameters: npt.ArrayLike) -> FloatArray:
    """``C_R`` (4, 4) of ``(a, b, c, d, e, f)`` (4.10), the scale μ taken into them; commutes with ``J_R(θ)``.

    Raises GeometryError for parameters that make it singular.
    """
    p = np.asarray(parameters, dtype=np.float64)
    if p.shape != (6,):
        raise GeometryError("shape", f"parameters have shape {p.shape}; (6,) is needed", shape=p.shape)
    a, b, c, d, e, f = p
    if not (np.isfinite(p).all() and a * a + b * b > 0 and abs(c * f - d * e) > 1e-12):
        raise GeometryError(
            "degenerate",
            f"a² + b² is {a * a + b * b:.3g}, cf - de is {c * f - d * e:.3g}; neither may be zero",
            parameters=p.tolist(),
        )
    return np.array([[a, -b, 0, 0], [b, a, 0, 0], [0, 0, c, d], [0, 0, e, f]])


def circle_centres(G: FloatArray, M: FloatArray) -> FloatArray:
    """Centres ``M + Ĥ²M`` (n, 4) of the circles on which points ``M`` (n, 4) go round (4.36)."""
    return np.asarray(M + M @ (G @ G).T, dtype=np.float64)


def circle_directions(G: FloatArray, M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Radial ``Ĥ²M`` and tangential direction ``ĤM`` (n, 4) of points ``M`` (n, 4) (4.35), at infinity."""
    return np.asarray(M @ (G @ G).T, dtype=np.float64), np.asarray(M @ G.T, dtype=np.float64)


def generator_from_homographies(Hs: Sequence[FloatArray] | FloatArray, angles: npt.ArrayLike) -> FloatArray:
    """``Ĥ`` (4, 4) from rotations ``Hs`` (k, 4, 4), normalised, of one axis by known ``angles`` (k,) [rad].

    The logarithm (4.28), ``sin θ Ĥ = (H − H⁻¹)/2``, by least squares over all of them, so that each weighs as
    much as it tells and a turn near π hurts nobody. Where all are near π, the odd part is read between the
    eigenspaces of the even one, ``(1 − cos θ) Ĥ² = (H + H⁻¹)/2 − I``. ``Ĥ³ = −Ĥ`` holds to rounding.

    Raises GeometryError: ``shape`` where numbers do not fit, ``degenerate`` where all angles vanish,
    ``half_turn`` where every angle is a multiple of π (the axis is known then, the generator is not).
    """
    stack = np.asarray(Hs, dtype=np.float64)
    theta = np.asarray(angles, dtype=np.float64)
    if stack.ndim != 3 or stack.shape[1:] != (4, 4) or theta.shape != stack.shape[:1] or not len(theta):
        raise GeometryError(
            "shape",
            f"homographies {stack.shape} and angles {theta.shape} do not fit; (k, 4, 4) and (k,) are needed",
            homographies=stack.shape,
            angles=theta.shape,
        )
    if not (np.isfinite(stack).all() and np.isfinite(theta).all()):
        raise GeometryError("not_finite", "homographies and angles must be finite")
    sine, cosine = np.sin(theta), 2.0 * np.sin(0.5 * theta) ** 2
    odd_weight, even_weight = float(sine @ sine), float(cosine @ cosine)
    if even_weight <= HALF_TURN_SINE**4:
        raise GeometryError("degenerate", "all angles are multiples of 2π; a rotation is needed", angles=theta.tolist())
    if odd_weight <= HALF_TURN_SINE**2:
        raise GeometryError(
            "half_turn",
            f"angles {theta.tolist()} rad are multiples of π; half a turn tells its axis, not its generator",
            angles=theta.tolist(),
        )
    inverses = np.linalg.inv(stack)
    odd = np.einsum("k,kij->ij", sine / odd_weight, 0.5 * (stack - inverses))
    if odd_weight > EVEN_SHARE * even_weight:
        return nearest_rotation_generator(odd)
    even = np.einsum("k,kij->ij", cosine / even_weight, 0.5 * (stack + inverses) - np.eye(4))
    return generator_between(odd, even)
