"""Maps between affine and Euclidean frames, the absolute dual quadric, and what rigid motions fix (2.7-2.18, 5.59)."""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.cameras import camera_centre
from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.geometry.strata import (
    ABSOLUTE_PLANE,
    affine_to_projective,
    euclidean_to_projective,
    projective_to_euclidean,
    triangular_root,
    upper_triangular,
)
from stereoservo.numerics.arrays import FloatArray


def affine_to_euclidean(intrinsics: FloatArray) -> FloatArray:
    """``H_AE = diag(K̃⁻¹, 1)`` (4, 4) (2.15). Raises GeometryError where ``intrinsics`` is singular."""
    return projective_to_euclidean(ABSOLUTE_PLANE, intrinsics)


def euclidean_to_affine(intrinsics: FloatArray) -> FloatArray:
    """``H_AE⁻¹ = diag(K̃, 1)`` (4, 4)."""
    return euclidean_to_projective(ABSOLUTE_PLANE, intrinsics)


def plane_at_infinity(H: FloatArray) -> FloatArray:
    """Plane at infinity (4,) of the frame that ``H`` (4, 4) maps to an affine or Euclidean one: its last row (2.17)."""
    plane: FloatArray = np.asarray(H, dtype=np.float64)[3].copy()
    return plane


def strata_of(H_projective_to_euclidean: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Plane at infinity (4,), ``K̃`` (3, 3) and the rigid part (4, 4) of any ``H_PE`` (4, 4) (2.17).

    ``H_PE = T [K̃⁻¹ 0; a∞ᵀ]`` up to scale, with K̃ upper triangular, positive, ``K̃₃₃ = 1``, and T a similarity: the
    Euclidean frame may stand anywhere. Raises GeometryError where H is singular or its plane passes through the first
    camera's centre.
    """
    H = np.asarray(H_projective_to_euclidean, dtype=np.float64)
    singular = np.linalg.svd(H, compute_uv=False) if H.shape == (4, 4) else np.zeros(4)
    if not singular[3] > 1e-10 * singular[0]:
        raise GeometryError("degenerate", f"H_PE must be a regular (4, 4) matrix, got {H.tolist()}")
    plane = plane_at_infinity(H)
    affine = H @ affine_to_projective(plane)  # [A t; 0 1]: what is left acts within the affine frame
    K, turn = upper_triangular(np.asarray(np.linalg.inv(affine[:3, :3]), dtype=np.float64))
    rigid = np.eye(4)
    rigid[:3, :3] = turn.T * np.cbrt(abs(np.linalg.det(affine[:3, :3] @ K)))
    rigid[:3, 3] = affine[:3, 3]
    return plane, K, rigid


def infinity_homography(P: FloatArray, P_right: FloatArray, plane: FloatArray = ABSOLUTE_PLANE) -> FloatArray:
    """``H∞`` (3, 3): left pixels of points of ``plane`` (4,) to right ones (after 2.9); ``K'RK⁻¹`` in an affine frame.

    For cameras ``(3, 4)`` of any frame. Raises GeometryError where the left camera's centre lies in the plane.
    """
    centre = camera_centre(P)
    height = float(plane @ centre)
    if not abs(height) > 1e-12 * np.linalg.norm(plane) * np.linalg.norm(centre):
        raise GeometryError("degenerate", "the left camera's centre lies in the plane", height=height)
    # The left pixel's ray, moved along itself into the plane.
    into_plane = np.eye(4) - np.outer(centre, plane) / height
    H: FloatArray = P_right @ into_plane @ np.linalg.pinv(P)
    return H


def absolute_dual_quadric(H_projective_to_euclidean: FloatArray) -> FloatArray:
    """``Q*∞`` (4, 4) ``= H_PE⁻¹ diag(1, 1, 1, 0) H_PE⁻ᵀ``: angles of planes; its images are ``P Q* Pᵀ ~ K Kᵀ``."""
    back = np.linalg.inv(H_projective_to_euclidean)
    Q: FloatArray = back[:, :3] @ back[:, :3].T
    return Q


def strata_of_quadric(Q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Plane at infinity (4,), unit norm, and ``K̃`` (3, 3) of an absolute dual quadric (4, 4): the reverse.

    The plane is the kernel of Q; its image in the first camera ``[I | 0]`` (of the frame's pixels) is ``K̃ K̃ᵀ``. Raises
    GeometryError where Q is not of rank three and semi-definite.
    """
    Q = 0.5 * (np.asarray(Q, dtype=np.float64) + np.asarray(Q, dtype=np.float64).T)
    values, vectors = np.linalg.eigh(Q * np.sign(np.trace(Q)))
    if not (values[1] > 1e-12 * values[3] and abs(values[0]) < 1e-6 * values[1]):
        raise GeometryError(
            "degenerate",
            f"the quadric has eigenvalues {values.tolist()}; one zero and three of one sign are needed",
            eigenvalues=values,
        )
    plane = vectors[:, 0] * (np.sign(vectors[3, 0]) or 1.0)
    return plane, triangular_root(Q[:3, :3] * np.sign(np.trace(Q)))


def fixed_plane_residual(generators: FloatArray, plane: FloatArray) -> FloatArray:
    """``|Ĥᵀa∞| / (|Ĥ| |a∞|)`` (n,) of generators ``(n, 4, 4)``: 0 where a motion keeps the plane at infinity (5.59).

    The absolute check of the affine stratum: every rigid motion fixes one plane.
    """
    generators = np.asarray(generators, dtype=np.float64)
    moved = np.linalg.norm(np.swapaxes(generators, -1, -2) @ plane, axis=-1)
    residual: FloatArray = moved / (np.linalg.norm(generators, axis=(-2, -1)) * np.linalg.norm(plane))
    return residual


def fixed_quadric_residual(generators: FloatArray, quadric: FloatArray) -> FloatArray:
    """``|Ĥ Q* + Q* Ĥᵀ| / 2|Ĥ||Q*|`` (n,) of generators ``(n, 4, 4)``: 0 where a motion keeps all angles.

    The absolute check of the Euclidean stratum, and of the affine one too: a rigid motion fixes ``Q*∞`` (4, 4).
    """
    generators = np.asarray(generators, dtype=np.float64)
    half = generators @ quadric
    change = np.linalg.norm(half + np.swapaxes(half, -1, -2), axis=(-2, -1))
    residual: FloatArray = change / (2.0 * np.linalg.norm(generators, axis=(-2, -1)) * np.linalg.norm(quadric))
    return residual
