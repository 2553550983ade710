"""Stratification: maps between projective, affine and Euclidean frames, decomposition of cameras, orientation of
planes (thesis 2.2, (2.7)-(2.18)).

Frames: projective ``P`` with a first camera ``[N⁻¹ | 0]`` (the thesis uses N = I), affine ``A`` with the same camera
and the plane at infinity (0, 0, 0, 1), Euclidean ``E`` with ``[K | 0]``. ``plane`` (4,) is the plane at infinity in P;
its scale defines heights: ``plane @ M`` becomes the fourth coordinate. ``intrinsics`` (3, 3) is
``K̃ = N K``, which is K if N = I. Points are transformed by `homogeneous.move_points`, planes by ``aᵀH⁻¹``, cameras
by ``P H⁻¹``, generators and displacements by `displacements.conjugate`.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError, unit_rows
from stereoservo.numerics.arrays import FloatArray

ABSOLUTE_PLANE = np.array([0.0, 0.0, 0.0, 1.0])
"""Plane at infinity of affine and Euclidean frames."""


def projective_to_affine(plane: FloatArray) -> FloatArray:
    """``H_PA = [I 0; a∞ᵀ]`` (4, 4) (2.14). Raises GeometryError if the plane passes through the first camera."""
    return projective_to_euclidean(plane, np.eye(3))


def affine_to_projective(plane: FloatArray) -> FloatArray:
    """``H_PA⁻¹`` (4, 4): maps affine points to the projective frame of ``plane`` (4,)."""
    return euclidean_to_projective(plane, np.eye(3))


def projective_to_euclidean(plane: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """``H_PE = [K̃⁻¹ 0; a∞ᵀ]`` (4, 4) (2.16, 2.17): ``ρ X = H_PE M`` with the orbital height ρ = plane @ M (2.47).

    Raises GeometryError if the plane passes through the first camera or ``intrinsics`` is singular.
    """
    plane, K = _checked(plane, intrinsics)
    H = np.zeros((4, 4))
    H[:3, :3] = np.linalg.inv(K)
    H[3] = plane
    return H


def euclidean_to_projective(plane: FloatArray, intrinsics: FloatArray) -> FloatArray:
    """``H_PE⁻¹ = [K̃ 0; -a₁₂₃ᵀ K̃/a₄ 1/a₄]`` (4, 4), for ``plane`` a: the inverse of (2.17) in closed form."""
    plane, K = _checked(plane, intrinsics)
    H = np.zeros((4, 4))
    H[:3, :3] = K
    H[3, :3] = -plane[:3] @ K / plane[3]
    H[3, 3] = 1.0 / plane[3]
    return H


def _checked(plane: FloatArray, intrinsics: FloatArray) -> tuple[FloatArray, FloatArray]:
    plane, K = np.asarray(plane, dtype=np.float64), np.asarray(intrinsics, dtype=np.float64)
    if plane.shape != (4,) or K.shape != (3, 3):
        raise GeometryError(
            "shape",
            f"plane {plane.shape} and intrinsics {K.shape}; (4,) and (3, 3) are needed",
            plane=plane.shape,
        )
    if not abs(float(unit_rows(plane)[3])) > 1e-12:
        raise GeometryError(
            "degenerate",
            f"the plane at infinity {plane.tolist()} passes through the first camera's centre (0, 0, 0, 1)",
            plane=plane.tolist(),
        )
    singular = np.linalg.svd(K, compute_uv=False)
    if not singular[2] > 1e-14 * singular[0]:
        raise GeometryError("degenerate", f"the intrinsics {K.tolist()} are singular", singular=singular)
    return plane, K


def upper_triangular(A: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``A ~ K R`` (3, 3): K upper triangular with a positive diagonal and ``K₃₃ = 1``, R orthogonal (2.1-2.3).

    R has the sign of det A as its determinant. Raises GeometryError if A is singular.
    """
    A = np.asarray(A, dtype=np.float64)
    singular = np.linalg.svd(A, compute_uv=False)
    if not singular[2] > 1e-14 * singular[0]:
        raise GeometryError("degenerate", f"the matrix {A.tolist()} is singular", singular=singular)
    Q, R = np.linalg.qr(A[::-1].T)  # A with rows reversed, transposed: QR becomes RQ
    K, rotation = R.T[::-1, ::-1], Q.T[::-1]
    signs = np.sign(np.diag(K))
    K, rotation = K * signs, signs[:, None] * rotation
    return K / K[2, 2], rotation


def decompose_camera(P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """``K`` (3, 3), ``R`` (3, 3) with det 1, ``t`` (3,) of a Euclidean camera ``P ~ K [R | t]`` (3, 4) (2.7).

    Raises GeometryError for a camera whose centre lies at infinity.
    """
    P = np.asarray(P, dtype=np.float64)
    P = P * np.sign(np.linalg.det(P[:, :3]) or 1.0)
    K, R = upper_triangular(P[:, :3])
    scale = float((K @ R).ravel() @ P[:, :3].ravel()) / float(((K @ R) ** 2).sum())
    t: FloatArray = np.asarray(np.linalg.solve(K, P[:, 3] / scale), dtype=np.float64)
    return K, R, t


def intrinsics_and_jacobian(P: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``(fx, fy, skew, cu, cv)`` (5,) [px] of a Euclidean camera ``P`` (3, 4), and their derivatives (5, p) along
    ``directions`` (p, 3, 4): by ``A Aᵀ ~ K Kᵀ`` of its left block.
    """
    A, dA = P[:, :3], directions[:, :, :3]
    omega = A @ A.T
    change = dA @ A.T
    change = change + change.transpose(0, 2, 1)
    last = omega[2, 2]
    W = omega / last
    dW = (change - W * change[:, 2, 2, None, None]) / last
    cu, cv = W[0, 2], W[1, 2]
    fy = np.sqrt(W[1, 1] - cv * cv)
    d_fy = (dW[:, 1, 1] - 2.0 * cv * dW[:, 1, 2]) / (2.0 * fy)
    skew = (W[0, 1] - cu * cv) / fy
    d_skew = (dW[:, 0, 1] - dW[:, 0, 2] * cv - cu * dW[:, 1, 2] - skew * d_fy) / fy
    fx = np.sqrt(W[0, 0] - cu * cu - skew * skew)
    d_fx = (dW[:, 0, 0] - 2.0 * cu * dW[:, 0, 2] - 2.0 * skew * d_skew) / (2.0 * fx)
    values: FloatArray = np.array([fx, fy, skew, cu, cv])
    return values, np.array([d_fx, d_fy, d_skew, dW[:, 0, 2], dW[:, 1, 2]])


def triangular_root(omega: FloatArray) -> FloatArray:
    """Upper triangular ``K`` (3, 3), positive diagonal, ``K₃₃ = 1``, with ``K Kᵀ ~ ω*`` (3, 3).

    Raises LinAlgError if ``omega`` is not positive definite.
    """
    flip = np.eye(3)[::-1]
    root = flip @ np.linalg.cholesky(flip @ omega @ flip) @ flip
    K: FloatArray = root / root[2, 2]
    return K


def oriented_plane(plane: FloatArray, points: FloatArray) -> FloatArray:
    """``plane`` (4,) with the sign that gives points ``(n, 4)`` positive scales ``plane @ M`` (2.47).

    The points are scaled so that they are in front (depth 1 in the first camera). Raises GeometryError naming those on
    the other side: a plane at infinity that intersects a finite object is wrong.
    """
    scales = np.asarray(points, dtype=np.float64) @ plane
    side = 1.0 if (scales > 0).sum() >= (scales < 0).sum() else -1.0
    across = np.flatnonzero(side * scales <= 0)
    if len(across):
        raise GeometryError(
            "orientation",
            f"point(s) {across.tolist()} of {len(scales)} lie beyond the plane at infinity {plane.tolist()}; "
            "it must not pass between visible points",
            points=across.tolist(),
            heights=scales.tolist(),
        )
    oriented: FloatArray = side * np.asarray(plane, dtype=np.float64)
    return oriented
