"""Maximum likelihood estimate of one projective rotation from pixels and known angles (thesis 4.4, (4.42), (4.43)).

Ten parameters, and points, eliminated by the Schur complement. Pixels are ideal ones [px], NaN
where missing. All computation uses coordinates whitened over the points at all stops.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.displacements import conjugate, exp_rotation
from stereoservo.geometry.homogeneous import GeometryError, whitener
from stereoservo.geometry.reprojection_fit import Images, Motion, covariance_of, minimise, read_images
from stereoservo.numerics.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class RotationFit:
    """The rotation ``exp(θĤ)`` of least squared reprojection error.

    ``generator`` (4, 4); ``parameters`` (10,) in ``chart`` with ``covariance`` (10, 10), and the
    ``generator_covariance`` (16, 16) of its entries row by row, of rank ten, both at the stated noise;
    ``points`` (m, 4) at angle 0, NaN if left out, depth 1 in the first camera; ``cost`` the sum of squares
    over the stated variances; ``freedom`` measurements minus parameters; ``evaluations`` of the model.
    """

    generator: FloatArray
    chart: RotationChart
    parameters: FloatArray
    covariance: FloatArray
    generator_covariance: FloatArray
    points: FloatArray
    cost: float
    freedom: int
    evaluations: int


def rotation_motion(chart: RotationChart, angles: FloatArray) -> Motion:
    """Ten parameters to ``exp(θ_s Ĥ)`` (s, 4, 4) at ``angles`` (s,) [rad] and their derivatives (s, 10, 4, 4)."""
    sine, cosine = np.sin(angles)[:, None, None, None], 2.0 * np.sin(0.5 * angles)[:, None, None, None] ** 2

    def motion(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        G = rotation_from_parameters(x, chart)
        changes = rotation_parameter_derivatives(x, chart)
        slopes: FloatArray = sine * changes + cosine * (changes @ G + G @ changes)
        return exp_rotation(G, angles), slopes

    return motion


def bundle_rotation(
    Ps: FloatArray,
    pixels: FloatArray,
    points: FloatArray,
    generator: FloatArray,
    angles: npt.ArrayLike,
    sigma: FloatArray | float,
) -> RotationFit:
    """The rotation and the points of least reprojection error (4.42 with free points, three parameters each).

    Cameras ``Ps`` (c, 3, 4); ``pixels`` (s, c, m, 2) [px] at ``angles`` (s,) [rad]; start ``points`` (m, 4) at angle
    0, NaN for points to leave out, and ``generator`` (4, 4); noise ``sigma``, a number or (s, c, m) [px]. Points
    seen fewer than twice are left out. Raises GeometryError for shapes that do not fit, a start that is no rotation, a
    generator that the data do not determine, no convergence.
    """
    images = read_images(Ps, pixels, sigma)
    theta = np.asarray(angles, dtype=np.float64)
    if theta.shape != pixels.shape[:1] or points.shape != (pixels.shape[2], 4) or not np.isfinite(theta).all():
        raise GeometryError(
            "shape",
            f"points {points.shape} and angles {theta.shape} do not fit pixels {pixels.shape}; finite "
            f"({pixels.shape[2]}, 4) and ({pixels.shape[0]},) are needed",
            points=points.shape,
            angles=theta.shape,
        )
    G = check_rotation_generator(generator)
    views = (images.weights > 0).sum(axis=(0, 1))
    known: BoolArray = np.asarray(np.isfinite(points).all(axis=1) & (views >= 2))
    used = Images(images.cameras, images.pixels[:, :, known], images.weights[:, :, known])
    size = 10 + 3 * int(known.sum())
    if used.measurements < size:
        raise GeometryError(
            "too_few",
            f"{used.measurements} pixel coordinates of {int(known.sum())} points for {size} parameters",
            measurements=used.measurements,
            parameters=size,
        )
    # A planar scene spans space only over its stops.
    W = whitener((points[known] @ exp_rotation(G, theta).transpose(0, 2, 1)).reshape(-1, 4))
    M = points[known] @ W.T
    M = M / np.linalg.norm(M, axis=1, keepdims=True)
    white = conjugate(W, G)
    chart = rotation_chart(white)
    seen = Images(used.cameras @ np.linalg.inv(W), used.pixels, used.weights)
    best = minimise(seen, rotation_motion(chart, theta), rotation_parameters(white, chart), M, True)
    covariance = covariance_of(best.information, "the generator")
    back: FloatArray = np.asarray(np.linalg.inv(W), dtype=np.float64)
    found = conjugate(back, rotation_from_parameters(best.x, chart))
    changes = conjugate(back, rotation_parameter_derivatives(best.x, chart)).reshape(10, 16)
    covariance_x = changes.T @ covariance @ changes
    own = rotation_chart(found)
    parameters = rotation_parameters(found, own)
    inverse = np.linalg.pinv(rotation_parameter_derivatives(parameters, own).reshape(10, 16).T)
    estimated = np.full(points.shape, np.nan)
    estimated[known] = best.points @ back.T
    estimated = estimated / (estimated @ images.cameras[0, 2])[:, None]
    return RotationFit(
        found,
        own,
        parameters,
        np.asarray(inverse @ covariance_x @ inverse.T, dtype=np.float64),
        np.asarray(covariance_x, dtype=np.float64),
        estimated,
        best.cost,
        used.measurements - size,
        best.evaluations,
    )


# -- frames and parameters of rotations ----------------------------------------------------------------------
# Projective rotations: Jordan frames and their geometry, and minimal parameters of rotation generators with
# derivatives (thesis 4).
#
# Exponential and single generators are in `displacements`.


ROTATION_TOLERANCE = 1e-6
"""``|Ĥ³ + Ĥ| / |Ĥ|³`` above which a matrix is no generator of a rotation."""
HALF_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
"""The square of quarter turns: ``Ĥ = [k₁ k₂] (0 −1; 1 0) [h₁ h₂]ᵀ`` (4.43)."""


@dataclass(frozen=True, eq=False)
class RotationFrame:
    """A frame in which a projective rotation is a rotation about z: ``H = S⁻¹ J_R(θ) S`` (4.9).

    ``planes`` (4, 4): rows ``h₁..h₄`` of S; ``points`` (4, 4): rows ``k₁..k₄``, the columns of S⁻¹. A rotation does
    not determine which point of its axis is at infinity, nor which of the planes normal to the axis.
    """

    planes: FloatArray
    points: FloatArray

    @property
    def generator(self) -> FloatArray:
        """``Ĥ = k₂h₁ᵀ − k₁h₂ᵀ`` (4, 4) (4.17): equal for all frames of one rotation."""
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

    def changed(self, C: FloatArray) -> RotationFrame:
        """The frame ``C S`` of the same rotation (4.11), ``C`` (4, 4) commuting with ``J_R(θ)``."""
        S = np.asarray(C, dtype=np.float64) @ self.planes
        return RotationFrame(S, np.asarray(np.linalg.inv(S).T, dtype=np.float64))


def check_rotation_generator(G: FloatArray) -> FloatArray:
    """``G`` (4, 4) as an array. Raises GeometryError unless ``Ĥ³ = −Ĥ`` and it is not zero."""
    G = np.asarray(G, dtype=np.float64)
    if G.shape != (4, 4) or not np.isfinite(G).all():
        raise GeometryError("shape", f"a generator is a finite (4, 4) matrix, got {G.tolist()}", shape=G.shape)
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

    All others are ``frame.changed(rotation_commutator(...))``. Raises GeometryError if G is no generator
    of a rotation.
    """
    G = check_rotation_generator(G)
    U, _, Vt = np.linalg.svd(G)
    first = U[:, 0]
    columns = np.stack([first, G @ first, Vt[2], Vt[3]])
    return RotationFrame(np.linalg.inv(columns.T), columns)


@dataclass(frozen=True, eq=False)
class RotationChart:
    """Layout of the ten parameters of (4.43): ``order`` (4,) is the permutation Y of the coordinates.

    In coordinates of this order, ``h'₁₁ = 1`` and ``h'₂₁ = 0`` are fixed and ``h'₂₂`` is the second pivot. The
    charts of a calibration's bundle span the same ten degrees of freedom as directions of conjugation; those apply to
    every joint kind and stratum, but only near their centre. This chart is explicit and valid wherever
    ``h'₂₂ ≠ 0``, so that its ten numbers determine the rotation by themselves.
    """

    order: npt.NDArray[np.int64]


def rotation_chart(G: FloatArray) -> RotationChart:
    """The chart with the largest pivots for the generator ``G`` (4, 4). Raises GeometryError."""
    frame = rotation_frame(G)
    # Both rows are permuted together: rotations between them preserve column norms.
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
    Raises GeometryError if G is no rotation's generator, or not in this chart.
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
    # hᵢᵀkⱼ = δᵢⱼ is preserved: the upper two entries of each direction follow (4.19).
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
    """Rows (2, 4) rotated into each other so that the second is zero in ``column``."""
    length = float(np.hypot(h[0, column], h[1, column]))
    c, s = h[0, column] / length, h[1, column] / length
    return np.asarray(np.array([[c, s], [-s, c]]) @ h, dtype=np.float64)
