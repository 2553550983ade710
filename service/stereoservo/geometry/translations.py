"""Projective translations: linear estimates of their homography from points and pixels, and of their direction and the
plane at infinity from homographies, by SVD (thesis 3).

A projective translation is ``H = I + k hᵀ`` with ``hᵀk = 0``: ``k`` (4,) the direction of translation at
infinity, ``h`` (4,) the plane at infinity (3.13, 3.14). Exponential and generators are in
`displacements`; the fits to pixels in `translation_fit`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.cameras import check_views, projection_jacobian_many
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.homogeneous import GeometryError, whitener
from stereoservo.numerics.arrays import FloatArray


def raw_generator(H: FloatArray) -> FloatArray:
    """``H / γ − I`` with ``γ = tr H / 4`` (3.2, 3.22): unconstrained generator of a measured homography ``(4, 4)``.

    Of rank one only if H is exactly a translation. Raises GeometryError if the trace is zero to rounding.
    """
    H = np.asarray(H, dtype=np.float64)
    if H.shape != (4, 4) or not np.isfinite(H).all():
        raise GeometryError("shape", f"a homography is a finite (4, 4) matrix, got {H.tolist()}", shape=H.shape)
    gamma = float(np.trace(H)) / 4.0
    if not abs(gamma) > 1e-9 * float(np.linalg.norm(H)):
        raise GeometryError(
            "degenerate",
            f"the trace is {4 * gamma:.3g}; a translation's is four times its scale",
            trace=gamma,
        )
    return np.asarray(H / gamma - np.eye(4), dtype=np.float64)


TRACE_FREE = np.linalg.svd(np.eye(4).reshape(1, 16))[2][1:].reshape(15, 4, 4)
"""Orthonormal basis of the matrices with trace zero, among them every generator."""


def translation_homography(Ps: FloatArray, M: FloatArray, pixels: FloatArray) -> FloatArray:
    """``H = I + G``, ``tr G = 0``, from points before and pixels after a motion near a translation, linear.

    Each pixel gives two equations ``(u P₃ − P₁)(M + G M) = 0``, divided by the depth before the motion, so that they
    weight errors as they arise in the images. Cameras (c, 3, 4), points (m, 4) of any scale, pixels (c, m, 2) [px],
    NaN where missing. Raises GeometryError for fewer than 15 equations or points that leave G undetermined.
    """
    values, w = check_views(Ps, pixels, None)
    known = np.isfinite(M).all(axis=1)
    values, w, M = values[:, known], w[:, known], M[known]
    measured = 2 * int((w > 0).sum())
    if measured < 15:
        raise GeometryError(
            "too_few",
            f"{measured} pixel coordinates of known points; 15 unknowns need as many",
            measured=measured,
        )
    W = whitener(M)
    X = M @ W.T
    P = Ps @ np.linalg.inv(W)
    depth = np.einsum("cj,nj->cn", P[:, 2], X)
    scale = np.divide(w, depth, out=np.zeros_like(w), where=depth != 0)
    rows = (P[:, None, :2, :] - values[..., None] * P[:, None, 2:, :]) * scale[..., None, None]
    system = np.einsum("cnai,qij,nj->cnaq", rows, TRACE_FREE, X, optimize=True).reshape(-1, 15)
    x, _, rank, singular = np.linalg.lstsq(system, -np.einsum("cnai,ni->cna", rows, X).ravel(), rcond=1e-10)
    if rank < 15:
        raise GeometryError(
            "degenerate", "the points do not determine a homography (coplanar?)", singular=singular.tolist()
        )
    back = np.asarray(np.linalg.inv(W), dtype=np.float64)
    return conjugate(back, np.eye(4) + np.tensordot(x, TRACE_FREE, 1))


@dataclass(frozen=True, eq=False)
class Weighting:
    """Coordinates ``left G right⁻¹``, both (4, 4), in which the norm of a generator G is taken.

    The rank-one matrix nearest to a measured one depends on them. The thesis uses identities: the norm in
    the projective frame itself.
    """

    left: FloatArray
    right: FloatArray

    def weighted(self, H: FloatArray) -> FloatArray:
        """``left (H/γ − I) right⁻¹`` (4, 4)."""
        return np.asarray(self.left @ raw_generator(H) @ np.linalg.inv(self.right), dtype=np.float64)

    def plane(self, row: FloatArray) -> FloatArray:
        """Plane (4,) of unit norm of a weighted row."""
        h = self.right.T @ row
        return np.asarray(h / np.linalg.norm(h), dtype=np.float64)

    def point(self, column: FloatArray) -> FloatArray:
        """Direction (4,) of unit norm of a weighted column."""
        k = np.linalg.solve(self.left, column)
        return np.asarray(k / np.linalg.norm(k), dtype=np.float64)

    def onto(self, plane: FloatArray, point: FloatArray) -> FloatArray:
        """The point (..., 4) nearest to ``point`` (..., 4) on a plane (4,), in weighted columns."""
        normal = np.linalg.solve(self.left.T @ self.left, plane)
        nearest: FloatArray = point - (point @ plane)[..., None] * normal / (plane @ normal)
        return nearest


UNWEIGHTED = Weighting(np.eye(4), np.eye(4))


FLAT = 1e-12
"""Smallest relative second moment used in a whitening: exactly coplanar points have a moment of zero."""


def conditioner(M: FloatArray) -> FloatArray:
    """`homogeneous.whitener`, extended to coplanar points (m, 4).

    Raises GeometryError for fewer than four points.
    """
    if len(M) < 4:
        raise GeometryError("too_few", f"{len(M)} points are known in space; 4 are needed", points=len(M))
    unit = M / np.linalg.norm(M, axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(unit.T @ unit / len(unit))
    return np.asarray((vectors / np.sqrt(np.maximum(values, FLAT * values[3]))).T, dtype=np.float64)


def image_weighting(Ps: FloatArray, M: FloatArray) -> Weighting:
    """Weighting in which the norm of G is, to first order, the rms motion of points M (m, 4) in the images of
    cameras (c, 3, 4) [px], as far as one matrix on each side can express it.

    Raises GeometryError for fewer than five points, and if points or cameras leave a direction invisible.
    """
    M = M[np.isfinite(M).all(axis=1)]
    if len(M) < 5:
        raise GeometryError(
            "too_few",
            f"{len(M)} points are known in space; at least 5 are needed, seen from two centres",
            points=len(M),
        )
    right = 2.0 * conditioner(M)  # unit 4-vectors have second moments I/4
    unit = 2.0 * M / np.linalg.norm(M @ right.T, axis=1, keepdims=True)
    rows = projection_jacobian_many(Ps, unit)
    moments = np.einsum("cnai,cnaj->ij", rows, rows) / len(unit)
    values, vectors = np.linalg.eigh(moments)
    if not values[0] > 1e-14 * values[3]:
        raise GeometryError(
            "degenerate",
            f"the images leave a direction of motion out (moments {values.tolist()}); two cameras with a baseline "
            "and points off one line of sight are needed",
            moments=values.tolist(),
        )
    return Weighting(np.asarray((vectors * np.sqrt(values)).T, dtype=np.float64), right)


@dataclass(frozen=True, eq=False)
class TranslationSVD:
    """Singular value decomposition of one homography, with its plane and direction (3.36).

    ``direction`` (4,) and ``plane`` (4,), both of unit norm; ``generator`` (4, 4), the nilpotent of that plane
    nearest to the measured one; ``singular`` (4,) descending, in px with `image_weighting`.
    """

    direction: FloatArray
    plane: FloatArray
    generator: FloatArray
    singular: FloatArray

    @property
    def conditioning(self) -> float:
        """``σ₁/σ₂``: large if the homography is a translation (3.36); infinite for an exact one."""
        return float(self.singular[0] / self.singular[1]) if self.singular[1] > 0 else float("inf")


def translation_from_homography(H: FloatArray, weighting: Weighting = UNWEIGHTED) -> TranslationSVD:
    """Direction and plane at infinity of one homography ``H`` (4, 4) by SVD (3.32-3.34, 3.36).

    Raises GeometryError for the identity and for a homography with trace zero.
    """
    G = weighting.weighted(H)
    U, singular, Vt = np.linalg.svd(G)
    if not singular[0] > 1e-14:
        raise GeometryError("degenerate", "the homography is the identity; a translation is needed")
    h = weighting.plane(Vt[0])
    k = direction_given_plane(H, h, weighting)
    return TranslationSVD(weighting.point(U[:, 0]), h, np.outer(k, h), singular)


def plane_at_infinity_from_stack(
    Hs: Sequence[FloatArray] | FloatArray, weighting: Weighting = UNWEIGHTED
) -> FloatArray:
    """Plane at infinity ``(4,)``, unit norm, of homographies ``(n, 4, 4)`` of any directions (3.37).

    Raises GeometryError for an empty stack and for a homography with trace zero.
    """
    stack = np.concatenate([weighting.weighted(H) for H in _some(Hs)])
    return weighting.plane(np.linalg.svd(stack, full_matrices=False)[2][0])


def direction_given_plane(H: FloatArray, plane: FloatArray, weighting: Weighting = UNWEIGHTED) -> FloatArray:
    """``k`` (4,) with ``I + k hᵀ`` nearest to the homography ``H`` (4, 4), and ``hᵀk = 0``, for the plane
    at infinity ``h`` (4,) at its given scale. Raises GeometryError for a homography with trace zero.
    """
    row = np.linalg.solve(weighting.right.T, plane)
    k = np.linalg.solve(weighting.left, weighting.weighted(H) @ row / (row @ row))
    return weighting.onto(plane, np.asarray(k, dtype=np.float64))


def _some(Hs: Sequence[FloatArray] | FloatArray) -> Sequence[FloatArray] | FloatArray:
    if len(Hs) == 0:
        raise GeometryError("too_few", "no homography is given; at least one is needed", homographies=0)
    return Hs
