"""Velocities of rigid motions as operators on points and planes, spatial and in the body (thesis 2.4)."""

from __future__ import annotations

import numpy as np

from oracles.displacement_logarithms import dual_generator
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import FloatArray


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


def metric_point_velocity(H_projective_to_euclidean: FloatArray, M: FloatArray, M_dot: FloatArray) -> FloatArray:
    """Metric velocity ``Ẋ`` (..., 3) [m/s] of points ``(..., 4)`` from their projective one: ``ρ Ẋ = H_PE Ṁ`` (2.48).

    Raises GeometryError for a point at infinity, which has none.
    """
    H = np.asarray(H_projective_to_euclidean, dtype=np.float64)
    height = orbital_height(H[3], M)
    if not (np.abs(height) > 1e-12 * np.linalg.norm(H[3]) * np.linalg.norm(M, axis=-1)).all():
        raise GeometryError("degenerate", "a point lies at infinity; it has no metric velocity", heights=height)
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
