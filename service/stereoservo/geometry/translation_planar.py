"""Projective translations of coplanar points: linear start.

Points of one plane leave a homography of space open, but not a translation: a motion across the plane shows where the
points' plane meets the plane at infinity (``g``), and ``hᵀk = 0`` gives the last freedom of ``h``.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.cameras import check_views, projection_jacobian_many
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray

ACROSS = 1e-6
"""Share of a motion that must lead out of the points' plane, relative, for the start to exist."""


def plane_basis(M: FloatArray) -> FloatArray:
    """Orthonormal ``(4, 4)``: columns 1 to 3 span the points M (m, 4) best, column 4 is their common plane."""
    unit = M / np.linalg.norm(M, axis=1, keepdims=True)
    basis: FloatArray = np.linalg.svd(unit)[2].T
    return basis


def planar_map(Ps: FloatArray, m: FloatArray, depth: FloatArray, pixels: FloatArray) -> FloatArray:
    """``D`` (4, 3) with ``P_c D m`` at the pixels, up to scale, of plane coordinates m (n, 3), linear.

    ``depth`` (c, n) before the motion divides the equations; pixels (c, n, 2) [px], NaN where missing. Raises
    GeometryError for fewer than 11 equations or points that leave D undetermined (collinear).
    """
    values, w = check_views(Ps, pixels, None)
    if 2 * int((w > 0).sum()) < 11:
        raise GeometryError(
            "too_few", f"{2 * int((w > 0).sum())} pixel coordinates; 11 unknowns need as many"
        )
    rows = (Ps[:, None, :2, :] - values[..., None] * Ps[:, None, 2:, :]) * (w / depth)[..., None, None]
    system = (rows[..., :, None] * m[None, :, None, None, :]).reshape(-1, 12)
    size = np.linalg.norm(system, axis=0)
    _, singular, Vt = np.linalg.svd(system / size, full_matrices=False)
    if not singular[10] > 1e-10 * singular[0]:
        raise GeometryError("degenerate", "the points do not determine a map of their plane (collinear?)")
    D: FloatArray = (Vt[11] / size).reshape(4, 3)
    return D


def planar_start(Ps: FloatArray, M: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Plane at infinity ``h`` (4,), unit norm, and directions ``k`` (n, 4), linear, from coplanar points.

    Points M (m, 4) at rest; pixels (n, c, m, 2) [px] after each motion, NaN where missing. Raises GeometryError where
    all motions lie in the points' plane, which leaves the plane at infinity open, or too few points are seen.
    """
    known = np.isfinite(M).all(axis=1)
    M = M[known]
    basis = plane_basis(M)
    B, normal = basis[:, :3], basis[:, 3]
    m = M @ B
    spread = np.linalg.qr(m / np.linalg.norm(m, axis=1, keepdims=True))[1]
    depth = np.einsum("cj,nj->cn", Ps[:, 2], M)
    unit = M / np.linalg.norm(m @ np.linalg.inv(spread), axis=1, keepdims=True)
    jacobian = projection_jacobian_many(Ps, unit)
    left = np.linalg.cholesky(np.einsum("cnai,cnaj->ij", jacobian, jacobian)).T
    weighted = []
    for moved in pixels:
        D = planar_map(Ps, m, depth, moved[:, known])
        # D = γ (B + k gᵀ): on the plane γ is the eigenvalue that comes twice.
        values = np.linalg.eigvals(B.T @ D)
        pairs = [(abs(values[i] - values[j]), values[i] + values[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
        gamma = 0.5 * float(min(pairs, key=lambda pair: float(pair[0]))[1].real)
        weighted.append(left @ (D / gamma - B) @ spread.T)
    v = np.linalg.svd(np.concatenate(weighted))[2][0]
    g = np.linalg.solve(spread, v)
    k = np.stack([np.linalg.solve(left, G @ v) for G in weighted])
    return _last_freedom(B @ g, normal, k, left)


def _last_freedom(
    within: FloatArray, normal: FloatArray, k: FloatArray, left: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """``h = within + η normal`` with ``hᵀk`` least over the motions; the k then put onto the plane."""
    across = k @ normal
    if not np.linalg.norm(across) > ACROSS * np.linalg.norm(k):
        raise GeometryError(
            "degenerate",
            "all motions lie in the plane of the points, which leaves the plane at infinity open; a motion out of it "
            "is needed",
            across=across.tolist(),
        )
    h = within - normal * float((k @ within) @ across / (across @ across))
    lever = np.linalg.solve(left.T @ left, h)
    k = k - np.outer(k @ h, lever) / (h @ lever)
    size = float(np.linalg.norm(h))
    return h / size, k * size
