"""Projective displacements of revolute and prismatic joints: exponentials of their generators in closed form, the
exact generator nearest to a measured matrix, change of frame (thesis 3, 4); and the Euclidean one of points.

A revolute generator ``Ĥ`` (4, 4) has eigenvalues (0, 0, i, −i): ``Ĥ³ = −Ĥ``. A prismatic one is nilpotent:
``Ĥ² = 0``. Displacements act on points from the left; conjugates in a projective frame of Euclidean ones.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from stereoservo.geometry.homogeneous import GeometryError
from stereoservo.numerics.arrays import FloatArray


def _square(H: FloatArray, what: str) -> FloatArray:
    H = np.asarray(H, dtype=np.float64)
    if H.shape != (4, 4):
        raise GeometryError("shape", f"{what} has shape {H.shape}; (4, 4) is needed", shape=H.shape)
    if not np.isfinite(H).all():
        raise GeometryError("not_finite", f"{what} must be finite, got {H.tolist()}")
    return H


def exp_rotation(G: FloatArray, theta: npt.ArrayLike) -> FloatArray:
    """``exp(θĤ) = I + sin θ Ĥ + (1 − cos θ) Ĥ²`` (4.27): ``G`` (..., 4, 4), ``theta`` (...) [rad] -> (..., 4, 4)."""
    angle = np.asarray(theta, dtype=np.float64)[..., None, None]
    # 2 sin²(θ/2) instead of 1 − cos θ: exact for small angles.
    H: FloatArray = np.eye(4) + np.sin(angle) * G + 2.0 * np.sin(0.5 * angle) ** 2 * (G @ G)
    return H


def exp_translation(G: FloatArray, tau: npt.ArrayLike) -> FloatArray:
    """``exp(τĤ) = I + τĤ`` (3.21): ``G`` (..., 4, 4), ``tau`` (...) -> (..., 4, 4)."""
    H: FloatArray = np.eye(4) + np.asarray(tau, dtype=np.float64)[..., None, None] * G
    return H


def exp_generator(kind: str, G: FloatArray, q: npt.ArrayLike) -> FloatArray:
    """Displacement of a ``revolute`` [rad] or ``prismatic`` [m] joint. Raises GeometryError for any other kind."""
    if kind == "revolute":
        return exp_rotation(G, q)
    if kind == "prismatic":
        return exp_translation(G, q)
    raise GeometryError("shape", f"joint kind is {kind!r}; 'revolute' or 'prismatic' are known", kind=kind)


def nearest_rotation_generator(A: FloatArray) -> FloatArray:
    """An exact revolute generator (``Ĥ³ = −Ĥ``) near ``A`` (4, 4): from its complex eigenvectors, ``−2 Im(v wᴴ)``.

    Raises GeometryError if A has no complex pair of eigenvalues.
    """
    A = _square(A, "generator")
    values, right = np.linalg.eig(A)
    k = int(np.argmax(values.imag))
    if not values[k].imag > 1e-9 * float(np.abs(values).max()):
        raise GeometryError(
            "degenerate",
            f"eigenvalues {values.tolist()} hold no complex pair; a rotation has ±i",
            eigenvalues=values,
        )
    # The left eigenvector from the transpose: inverting all eigenvectors fails near a defective kernel.
    adjoint_values, left = np.linalg.eig(A.T)
    v, w = right[:, k], left[:, int(np.argmin(np.abs(adjoint_values - values[k])))]
    product = w @ v
    if abs(product) < 1e-12:
        raise GeometryError("degenerate", "left and right eigenvectors are orthogonal; the pair is defective")
    G: FloatArray = -2.0 * (np.outer(v, w) / product).imag
    # x ↦ −x³(5 + 3x²)/2 has ±i and 0 as fixed points of slope zero: rounding is squared away.
    for _ in range(2):
        square = G @ G
        G = -0.5 * G @ square @ (5.0 * np.eye(4) + 3.0 * square)
    return G


def nearest_translation_generator(A: FloatArray) -> FloatArray:
    """The nilpotent of rank one (``Ĥ² = 0``) nearest to ``A`` (4, 4) (3.32-3.34, with hᵀk = 0 holding exactly).

    Raises GeometryError for A = 0.
    """
    from scipy.optimize import (
        brentq,
    )  # here, so that the servo process can import displacements without scipy

    A = _square(A, "generator")
    size = float(np.linalg.norm(A, 2))
    if not size > 0:
        raise GeometryError("degenerate", "the generator is zero; a translation is needed")
    A = A / size

    def pair(shift: float) -> tuple[FloatArray, FloatArray]:
        U, _, Vt = np.linalg.svd(A - shift * np.eye(4))
        return U[:, 0], Vt[0]

    def overlap(shift: float) -> float:
        k, h = pair(shift)
        return float(-(k @ h))

    # The best k hᵀ under hᵀk = 0 is a leading singular pair of A − λI, λ the constraint's multiplier; there the
    # norm of A − λI is least. That norm is convex in λ, and its slope is −kᵀh.
    shift = brentq(overlap, -2.0, 2.0, xtol=1e-16, rtol=1e-15)
    k, h = pair(float(shift))
    k = k - h * (h @ k)
    G: FloatArray = size * np.outer(k, h) * float(k @ A @ h) / float(k @ k)
    return G


def conjugate(H: FloatArray, G: FloatArray) -> FloatArray:
    """``H Ĝ H⁻¹``: a generator or displacement ``G`` (..., 4, 4) in the frame of points mapped by ``H`` (4, 4)."""
    moved: FloatArray = H @ G @ np.linalg.inv(H)
    return moved


STRAIGHT = 1e-6
"""Second singular value of points on one line, relative to the first."""


def similarity_from_points(X: FloatArray, Y: FloatArray, *, scaled: bool) -> FloatArray:
    """Least-squares ``T`` (4, 4), proper, from points ``(n, 3)`` to ``(n, 3)``; ``scaled``: its scale is free.

    Raises GeometryError for fewer than three points and points on one line.
    """
    if len(X) < 3:
        raise GeometryError("too_few", f"{len(X)} points; a rigid motion needs at least 3", points=len(X))
    centroid_X, centroid_Y = X.mean(axis=0), Y.mean(axis=0)
    x, y = X - centroid_X, Y - centroid_Y
    for name, centred in (("first", x), ("second", y)):
        singular = np.linalg.svd(centred, compute_uv=False)
        if not singular[1] > STRAIGHT * singular[0]:
            raise GeometryError("degenerate", f"the {name} points lie on one line: a turn about it stays open")
    U, singular, Vt = np.linalg.svd(y.T @ x)
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    T = np.eye(4)
    scale = float(np.sum(singular * proper) / np.sum(x * x)) if scaled else 1.0
    T[:3, :3] = scale * (U * proper) @ Vt
    T[:3, 3] = centroid_Y - T[:3, :3] @ centroid_X
    return T
