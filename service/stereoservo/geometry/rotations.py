"""Projective rotations: Jordan frames and their geometry, generators from homographies, minimal parameters
(thesis 4).

Exponential, logarithm and single generators stand in `displacements`; the fit to pixels in `rotation_fit`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.displacements import (
    HALF_TURN_SINE,
    generator_between,
    nearest_rotation_generator,
)
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray

EVEN_SHARE = 0.17
"""``Σ sin²θ / Σ (1 − cos θ)²`` below which the eigenspaces of the even part are the better ones: 3/4 π."""
ROTATION_TOLERANCE = 1e-6
"""``|Ĥ³ + Ĥ| / |Ĥ|³`` above which a matrix is no generator of a rotation."""
HALF_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
"""The square of quarter turns: ``Ĥ = [k₁ k₂] (0 −1; 1 0) [h₁ h₂]ᵀ`` (4.43)."""


@dataclass(frozen=True, eq=False)
class RotationFrame:
    """A frame in which a projective rotation is one about z: ``H = S⁻¹ J_R(θ) S`` (4.9).

    ``planes`` (4, 4): rows ``h₁..h₄`` of S; ``points`` (4, 4): rows ``k₁..k₄``, the columns of S⁻¹. Which
    of the points on the axis is at infinity, and which of the planes across it, no rotation tells.
    """

    planes: FloatArray
    points: FloatArray

    @property
    def generator(self) -> FloatArray:
        """``Ĥ = k₂h₁ᵀ − k₁h₂ᵀ`` (4, 4) (4.17): the same for every frame of one rotation."""
        return np.asarray(self.points[:2].T @ HALF_TURN @ self.planes[:2], dtype=np.float64)

    @property
    def normal_directions(self) -> FloatArray:
        """``k₁, k₂`` (2, 4): points at infinity, two directions normal to the axis and to each other."""
        return self.points[:2]

    @property
    def axis(self) -> FloatArray:
        """``k₃, k₄`` (2, 4): two points that span the axis; every point on it is fixed."""
        return self.points[2:]

    @property
    def axial_planes(self) -> FloatArray:
        """``h₁, h₂`` (2, 4): two planes through the axis, normal to each other."""
        return self.planes[:2]

    @property
    def normal_planes(self) -> FloatArray:
        """``h₃, h₄`` (2, 4): they span the pencil of fixed planes normal to the axis, infinity among them."""
        return self.planes[2:]

    def changed(self, C: FloatArray) -> RotationFrame:
        """The frame ``C S`` of the same rotation (4.11), ``C`` (4, 4) of `rotation_commutator`."""
        S = np.asarray(C, dtype=np.float64) @ self.planes
        return RotationFrame(S, np.asarray(np.linalg.inv(S).T, dtype=np.float64))


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


def check_rotation_generator(G: FloatArray) -> FloatArray:
    """``G`` (4, 4) as an array, once ``Ĥ³ = −Ĥ`` holds and it is not zero. Raises GeometryError."""
    G = np.asarray(G, dtype=np.float64)
    if G.shape != (4, 4) or not np.isfinite(G).all():
        raise GeometryError(
            "shape", f"a generator is a finite (4, 4) matrix, got {G.tolist()}", shape=G.shape
        )
    size = float(np.linalg.norm(G))
    defect = float(np.linalg.norm(G @ G @ G + G))
    if not (size > 0 and defect <= ROTATION_TOLERANCE * max(size, size**3)):
        raise GeometryError(
            "degenerate",
            f"|Ĥ³ + Ĥ| is {defect:.3g} with |Ĥ| {size:.3g}; zero is needed, as for eigenvalues (0, 0, i, -i)",
            defect=defect,
        )
    return G


def rotation_frame(G: FloatArray) -> RotationFrame:
    """One Jordan frame of the rotations ``exp(θĤ)``, ``G`` (4, 4) a generator (4.9, 4.25).

    All others are ``frame.changed(rotation_commutator(...))``. Raises GeometryError where G is no generator
    of a rotation.
    """
    G = check_rotation_generator(G)
    U, _, Vt = np.linalg.svd(G)
    first = U[:, 0]
    columns = np.stack([first, G @ first, Vt[2], Vt[3]])
    return RotationFrame(np.linalg.inv(columns.T), columns)


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
        raise GeometryError(
            "degenerate", "all angles are multiples of 2π; a rotation is needed", angles=theta.tolist()
        )
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


@dataclass(frozen=True, eq=False)
class RotationChart:
    """Where the ten parameters of (4.43) stand: ``order`` (4,) is the permutation Y of the coordinates.

    Coordinates so ordered, ``h'₁₁ = 1`` and ``h'₂₁ = 0`` are fixed and ``h'₂₂`` is the second pivot. The
    charts of a calibration's bundle span the same ten freedoms as directions of conjugation, which reach
    every joint kind and stratum but only near their centre; this one is explicit and good wherever
    ``h'₂₂ ≠ 0``, so that its ten numbers say by themselves which rotation is meant.
    """

    order: npt.NDArray[np.int64]


def rotation_chart(G: FloatArray) -> RotationChart:
    """The chart with the largest pivots for the generator ``G`` (4, 4). Raises GeometryError."""
    frame = rotation_frame(G)
    # Both rows are taken at once: rotations among them leave column norms as they are.
    h = _orthonormal_rows(frame.axial_planes)
    first = int(np.argmax((h**2).sum(axis=0)))
    turned = _turned(h, first)
    rest = np.abs(turned[1])
    rest[first] = -1.0
    second = int(np.argmax(rest))
    others = [i for i in range(4) if i not in (first, second)]
    return RotationChart(np.array([first, second, *others], dtype=np.int64))


def rotation_parameters(G: FloatArray, chart: RotationChart) -> FloatArray:
    """``x`` (10,) of the generator ``G`` (4, 4): ``h'₁₂ h'₁₃ h'₁₄ h'₂₂ h'₂₃ h'₂₄ k'₁₃ k'₁₄ k'₂₃ k'₂₄`` (4.43).

    ``Ĥ' = Y Ĥ Y⁻¹``, ``[h'₁ h'₂]ᵀ = Q⁻¹ [h₁ h₂]ᵀ Y⁻¹``, ``K' = Y K Q``, with Q a scaled rotation (errata).
    Raises GeometryError where G is no rotation's generator, or not in this chart.
    """
    frame = rotation_frame(G)
    h, k = frame.axial_planes[:, chart.order], frame.normal_directions[:, chart.order]
    length = float(np.hypot(h[0, 0], h[1, 0]))
    if not length > 1e-9 * float(np.linalg.norm(h)):
        raise GeometryError("degenerate", "the first pivot is zero; take another chart of this generator")
    Q = np.array([[h[0, 0], -h[1, 0]], [h[1, 0], h[0, 0]]])
    rows = np.linalg.solve(Q, h)
    directions = Q.T @ k
    if not abs(rows[1, 1]) > 1e-9 * float(np.linalg.norm(rows)):
        raise GeometryError("degenerate", "the second pivot is zero; take another chart of this generator")
    return np.concatenate([rows[0, 1:], rows[1, 1:], directions[0, 2:], directions[1, 2:]])


def rotation_from_parameters(x: FloatArray, chart: RotationChart) -> FloatArray:
    """The generator ``Ĥ`` (4, 4) of ten parameters ``x`` (10,) (4.43). Raises GeometryError for ``h'₂₂ = 0``."""
    rows, columns = _factors(np.asarray(x, dtype=np.float64))
    return _reordered(columns @ HALF_TURN @ rows, chart)


def rotation_parameter_derivatives(x: FloatArray, chart: RotationChart) -> FloatArray:
    """``∂Ĥ/∂x_p`` (10, 4, 4) at ``x`` (10,). Raises GeometryError for ``h'₂₂ = 0``."""
    rows, columns = _factors(np.asarray(x, dtype=np.float64))
    change_rows = np.zeros((10, 2, 4))
    change_columns = np.zeros((10, 4, 2))
    for p, (i, j) in enumerate(((0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3))):
        change_rows[p, i, j] = 1.0
    for p, (i, j) in enumerate(((0, 2), (0, 3), (1, 2), (1, 3))):
        change_columns[6 + p, j, i] = 1.0
    # hᵢᵀkⱼ = δᵢⱼ stays: the upper two entries of each direction follow (4.19).
    right = -(change_rows @ columns) - rows[:, 2:] @ change_columns[:, 2:]
    change_columns[:, :2] = np.linalg.solve(rows[:, :2], right)
    changes = change_columns @ HALF_TURN @ rows + columns @ HALF_TURN @ change_rows
    return _reordered(changes, chart)


def _factors(x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``[h'₁ h'₂]ᵀ`` (2, 4) and ``[k'₁ k'₂]`` (4, 2) of ten parameters, with ``hᵢᵀkⱼ = δᵢⱼ`` (4.19)."""
    if x.shape != (10,) or not np.isfinite(x).all():
        raise GeometryError("shape", f"parameters are {x.tolist()}; ten finite numbers are needed")
    rows = np.array([[1.0, *x[:3]], [0.0, *x[3:6]]])
    if rows[1, 1] == 0.0:
        raise GeometryError("degenerate", "h'22 is zero; take another chart")
    columns = np.empty((4, 2))
    columns[2:] = x[6:].reshape(2, 2).T
    columns[:2] = np.linalg.solve(rows[:, :2], np.eye(2) - rows[:, 2:] @ columns[2:])
    return rows, columns


def _reordered(G: FloatArray, chart: RotationChart) -> FloatArray:
    """``Y⁻¹ Ĥ' Y`` of matrices (..., 4, 4)."""
    result = np.empty_like(G)
    result[..., chart.order[:, None], chart.order[None, :]] = G
    return result


def _orthonormal_rows(h: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.svd(h, full_matrices=False)[2], dtype=np.float64)


def _turned(h: FloatArray, column: int) -> FloatArray:
    """Rows (2, 4) turned among themselves so that the second is zero in ``column``."""
    length = float(np.hypot(h[0, column], h[1, column]))
    c, s = h[0, column] / length, h[1, column] / length
    return np.asarray(np.array([[c, s], [-s, c]]) @ h, dtype=np.float64)
