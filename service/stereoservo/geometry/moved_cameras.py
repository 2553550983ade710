"""Static scene points while cameras move (thesis 2.19 to 2.21): resection of one moved camera with covariance, the
result type of a change of the projective frame, covariances of transformed points, test for coplanar points.

Five points of which no four are coplanar define a frame of space. After cameras have moved, their new canonical frame
differs from the old one by one homography ``H``, which is determined by the points' images; all known quantities are
transformed by it: points ``H M``, generators ``H Ĝ H⁻¹``, static cameras ``P H⁻¹``. With six points a single moved
camera is resected in the old frame and needs no second one. Pixels are ideal ones (undistorted).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.cameras import (
    projection_jacobian,
    reprojection_residuals,
    resection,
)
from stereoservo.geometry.homogeneous import GeometryError, unit_rows, whitener
from stereoservo.numerics.arrays import FloatArray

OFF_PLANE = 5.0
"""Number of standard deviations from their best common plane below which points count as coplanar."""
EXACT = 1e-9
"""Standard deviation, relative to their norm, assumed for points without a covariance."""


def plane_deviations(points: FloatArray, covariance: FloatArray | None = None) -> tuple[FloatArray, float]:
    """Best common plane (4,) of points ``(n, 4)``, n >= 4, and the rms distance from it in standard deviations.

    ``covariance`` (n, 4, 4) of the points at their scale; None: exact to `EXACT`. Invariant to the choice of frame.
    """
    points = np.asarray(points, dtype=np.float64)
    n = len(points)
    if covariance is None:
        points = unit_rows(points)
        covariance = np.broadcast_to(EXACT**2 * np.eye(4), (n, 4, 4))
    values, vectors = np.linalg.eigh(covariance)
    roots = np.sqrt(np.maximum(values, 0.0))[:, :, None] * vectors.transpose(0, 2, 1)
    weights = np.ones(n)
    for _ in range(5):
        # Least Σw²(aᵀM)² at Σw²aᵀΣa = 1, by the generalised singular values of the two stacks.
        stack = np.concatenate([points * weights[:, None], (roots * weights[:, None, None]).reshape(-1, 4)])
        Q, R = np.linalg.qr(stack)
        across = np.linalg.svd(Q[:n], full_matrices=n < 4)[2][3]
        plane: FloatArray = np.asarray(np.linalg.solve(R, across), dtype=np.float64)
        plane = plane / np.linalg.norm(plane)
        deviation = np.sqrt(np.einsum("i,nij,j->n", plane, covariance, plane))
        weights = 1.0 / np.where(deviation > 0, deviation, 1.0)
        weights = weights / weights.max()
    deviations = (points @ plane) / np.where(deviation > 0, deviation, 1.0)
    return plane, float(np.sqrt(np.mean(deviations**2)))


def refuse_coplanar(
    points: FloatArray, covariance: FloatArray | None = None, names: Sequence[int] | None = None
) -> None:
    """Raise GeometryError naming the points if all, or all but one, of ``(n, 4)`` are coplanar within noise.

    With five points this means four coplanar ones, which define no frame. ``covariance`` as for `plane_deviations`;
    ``names`` (n,): numbers of the points for the message, default 0 to n - 1.
    """
    n = len(points)
    if n < 5:
        raise GeometryError("too_few", f"{n} points; a projective frame needs at least 5", points=n)
    called = list(range(n)) if names is None else list(names)
    for left_out in range(n):
        keep = np.delete(np.arange(n), left_out)
        _, deviations = plane_deviations(points[keep], None if covariance is None else covariance[keep])
        if deviations < OFF_PLANE:
            coplanar = [called[k] for k in keep]
            raise GeometryError(
                "degenerate",
                f"points {coplanar} are coplanar: they stand {deviations:.3g} standard deviations off their plane, "
                f"{OFF_PLANE:g} are needed; add a point off it, besides point {called[left_out]}",
                coplanar=coplanar,
                deviations=deviations,
                needed=OFF_PLANE,
            )


@dataclass(frozen=True)
class FrameChange:
    """The map from the old projective frame to the new one.

    ``H`` (4, 4), ``|det H| = 1``, with the sign that keeps heights positive; ``covariance`` (16, 16) of its entries row
    by row; ``points`` (k,) the rows that were used; ``rms`` of the residuals in standard deviations, 1 if the model
    is valid; ``degrees_of_freedom`` of them.
    """

    H: FloatArray
    covariance: FloatArray
    points: tuple[int, ...]
    rms: float
    degrees_of_freedom: int


def carried_point_covariance(change: FrameChange, M: FloatArray, M_covariance: FloatArray | None = None) -> FloatArray:
    """First-order covariance ``(m, 4, 4)`` of transformed points ``H M`` from that of H and, if given, of the points.

    Assumes that both are independent: for points that were not used to estimate H.
    """
    rows = np.einsum("ij,nk->nijk", np.eye(4), M).reshape(len(M), 4, 16)
    covariance: FloatArray = rows @ change.covariance @ rows.transpose(0, 2, 1)
    if M_covariance is not None:
        covariance = covariance + change.H @ M_covariance @ change.H.T
    return covariance


@dataclass(frozen=True)
class ResectedCamera:
    """A camera in the old frame: ``P`` (3, 4) of unit norm, ``covariance`` (12, 12) of its entries row by row,

    ``rms`` of the residuals in standard deviations, ``degrees_of_freedom`` of them.
    """

    P: FloatArray
    covariance: FloatArray
    rms: float
    degrees_of_freedom: int


def resect_moved_camera(M: FloatArray, pixels: FloatArray, sigma: float = 1.0) -> ResectedCamera:
    """One moved camera in the frame of static scene points ``(n, 4)``, n >= 6, from ``pixels`` (n, 2) [px].

    Minimises the reprojection error (`resection`); NaN pixels are left out, ``sigma`` [px] is their noise. Raises
    GeometryError for fewer than six points and if they, or noise, leave the camera undetermined (coplanar points).
    """
    M, pixels = np.asarray(M, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    P = resection(M, pixels)
    seen = np.isfinite(pixels).all(axis=1) & np.isfinite(M).all(axis=1)
    M, pixels = M[seen], pixels[seen]
    root = whitener(M)
    moved, X = P @ np.linalg.inv(root), M @ root.T
    # ∂u/∂P = ∂u/∂m Mᵀ with m = P M, which is the projection's Jacobian for the camera [I | 0] of points (m, 1).
    by_image = projection_jacobian(np.eye(3, 4), np.hstack([M @ P.T, np.ones((len(M), 1))]))[:, :, :3]
    J = np.einsum("nik,nj->nikj", by_image, X).reshape(-1, 12) / sigma
    chart = np.linalg.svd(moved.reshape(1, 12))[2][1:].T
    _, singular, rows = np.linalg.svd(J @ chart, full_matrices=False)
    whitened = chart @ (rows.T / singular)
    _refuse_flat_view(moved, whitened)
    # Back from the whitened frame, and to the gauge of unit norm.
    deviation = (whitened.T.reshape(-1, 3, 4) @ root).reshape(-1, 12).T
    deviation = deviation - np.outer(P.ravel(), P.ravel() @ deviation)
    residuals = reprojection_residuals(P[None], M, pixels[None]).ravel() / sigma
    freedom = residuals.size - 11
    return ResectedCamera(P, deviation @ deviation.T, float(np.sqrt(residuals @ residuals / freedom)), freedom)


def _refuse_flat_view(P: FloatArray, deviation: FloatArray) -> None:
    """Raise GeometryError if a homography of the points' plane explains the pixels within noise.

    ``P`` (3, 4) with the points' best plane as first coordinate, and a root ``spread`` (12, 11) of its covariance:
    without a significant first column the images are those of coplanar points.
    """
    column, root = P[:, 0], deviation[[0, 4, 8]]
    deviations = float(np.sqrt(column @ np.linalg.solve(root @ root.T, column) / 3.0))
    if deviations < OFF_PLANE:
        raise GeometryError(
            "degenerate",
            f"the points are coplanar within noise: their relief shows by {deviations:.3g} standard deviations, "
            f"{OFF_PLANE:g} are needed; add points off their plane",
            deviations=deviations,
            needed=OFF_PLANE,
        )
