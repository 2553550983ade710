"""Velocities of rigid motion in any frame: twists, spatial and body operators, points, planes (thesis 2.4, 2.5.4).

Operators are 4x4 and act on points from the left; unlike generators they carry their rate [1/s]. A point keeps its
orbital height ρ while it moves; its velocity is a 4-vector of height zero.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.displacements import conjugate, dual_generator
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray
from stereoservo.geometry.lines import cross_matrix


def twist_matrix(w: FloatArray, v: FloatArray) -> FloatArray:
    """``T̂ = [[w]ₓ v; 0 0]`` (..., 4, 4) of angular ``w`` [rad/s] and linear ``v`` [m/s] (..., 3) (2.39)."""
    w, v = np.broadcast_arrays(np.asarray(w, dtype=np.float64), np.asarray(v, dtype=np.float64))
    T = np.zeros((*w.shape[:-1], 4, 4))
    T[..., :3, :3] = cross_matrix(w)
    T[..., :3, 3] = v
    return T


def twist_vectors(T: FloatArray, tolerance: float = 1e-9) -> tuple[FloatArray, FloatArray]:
    """``w`` [rad/s] and ``v`` [m/s] (..., 3) of Euclidean twists (..., 4, 4): the reverse of `twist_matrix`.

    Raises GeometryError where one is no twist: its last row or its block's symmetric part is above ``tolerance`` of
    its norm; then it stands in another frame.
    """
    T = np.asarray(T, dtype=np.float64)
    block = T[..., :3, :3]
    symmetric = block + np.swapaxes(block, -1, -2)
    excess = np.sqrt((T[..., 3, :] ** 2).sum(axis=-1) + 0.25 * (symmetric**2).sum(axis=(-2, -1)))
    size = np.linalg.norm(T, axis=(-2, -1))
    if not (excess <= tolerance * size).all():
        worst = float(np.max(excess / np.where(size > 0, size, 1.0)))
        raise GeometryError(
            "degenerate",
            f"a matrix is no Euclidean twist: {worst:.3g} of it is not; conjugate it by H_PE first",
            excess=worst,
        )
    odd = 0.5 * (block - np.swapaxes(block, -1, -2))
    w = np.stack([odd[..., 2, 1], odd[..., 0, 2], odd[..., 1, 0]], axis=-1)
    return w, T[..., :3, 3].copy()


def spatial_velocity(H: FloatArray, H_dot: FloatArray) -> FloatArray:
    """``Ĥ = Ḣ H⁻¹`` (..., 4, 4), seen by a static observer (2.42, 2.49): ``Ṁ = Ĥ M`` for the moving point M."""
    velocity: FloatArray = H_dot @ np.linalg.inv(H)
    return velocity


def body_velocity(H: FloatArray, H_dot: FloatArray) -> FloatArray:
    """``Ȟ = H⁻¹ Ḣ`` (..., 4, 4), seen from the moving body (2.44, 2.50)."""
    velocity: FloatArray = np.asarray(np.linalg.solve(H, H_dot), dtype=np.float64)
    return velocity


def spatial_from_body(H: FloatArray, body: FloatArray) -> FloatArray:
    """``Ĥ = H Ȟ H⁻¹`` (4, 4): both name one motion, at the displacement ``H`` (4, 4)."""
    return conjugate(H, body)


def body_from_spatial(H: FloatArray, spatial: FloatArray) -> FloatArray:
    """``Ȟ = H⁻¹ Ĥ H`` (4, 4), the reverse of `spatial_from_body`."""
    velocity: FloatArray = np.asarray(np.linalg.solve(H, spatial @ H), dtype=np.float64)
    return velocity


def transfer_velocity(S: FloatArray, velocity: FloatArray) -> FloatArray:
    """``ad_S(Ĥ) = S⁻¹ Ĥ S`` (..., 4, 4): an operator in the frame whose points ``S`` (4, 4) maps to its own (2.46)."""
    return body_from_spatial(S, velocity)


def orbital_height(plane: FloatArray, M: FloatArray) -> FloatArray:
    """``ρ = a∞ᵀM`` (...) of points ``(..., 4)`` for the plane at infinity ``(4,)``: kept by displacements (2.47)."""
    height: FloatArray = np.asarray(M, dtype=np.float64) @ plane
    return height


def point_velocity(velocity: FloatArray, M: FloatArray) -> FloatArray:
    """``Ṁ = Ĥ M`` (..., 4) of points ``(..., 4)`` under a spatial velocity ``(4, 4)`` (2.53); its height is zero."""
    rate: FloatArray = np.asarray(M, dtype=np.float64) @ velocity.T
    return rate


def metric_point_velocity(
    H_projective_to_euclidean: FloatArray, M: FloatArray, M_dot: FloatArray
) -> FloatArray:
    """Metric velocity ``Ẋ`` (..., 3) [m/s] of points ``(..., 4)`` from their projective one: ``ρ Ẋ = H_PE Ṁ`` (2.48).

    Raises GeometryError for a point at infinity, which has none.
    """
    H = np.asarray(H_projective_to_euclidean, dtype=np.float64)
    height = orbital_height(H[3], M)
    if not (np.abs(height) > 1e-12 * np.linalg.norm(H[3]) * np.linalg.norm(M, axis=-1)).all():
        raise GeometryError(
            "degenerate", "a point lies at infinity; it has no metric velocity", heights=height
        )
    X_dot: FloatArray = (np.asarray(M_dot, dtype=np.float64) @ H.T)[..., :3] / height[..., None]
    return X_dot


def dual_displacement(H: FloatArray) -> FloatArray:
    """``H⁻ᵀ`` (..., 4, 4): a displacement as it acts on planes (2.68); of ``S⁻¹JS`` it is ``SᵀJ⁻ᵀS⁻ᵀ`` (2.69)."""
    dual: FloatArray = np.swapaxes(np.linalg.inv(H), -1, -2)
    return dual


def plane_velocity(velocity: FloatArray, a: FloatArray) -> FloatArray:
    """``ȧ = -Ĥᵀ a(t)`` (..., 4) of planes ``(..., 4)`` under a spatial velocity ``(4, 4)`` (2.70).

    ``a(t) = H⁻ᵀ(t) a``: from the plane at the start it is ``-Ĥᵀ H⁻ᵀ a`` (errata). Zero where points move within it.
    """
    rate: FloatArray = np.asarray(a, dtype=np.float64) @ dual_generator(velocity).T
    return rate
