"""Virtual rigid stereo: a projective frame carried by scene points, so that cameras may be moved (2.19-2.21).

Five points of which no four are coplanar are a frame of space. When cameras have moved, their new canonical frame
differs from the old one by one homography ``H``, which the points' images give; what was known moves with it: points
``H M``, generators ``H Ĝ H⁻¹``, cameras that stood still ``P H⁻¹``. With six points a single moved camera is resected
in the old frame and needs no second one. Pixels are ideal ones (undistorted).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereoservo.geometry.cameras import (
    camera_centre,
    projection_jacobian,
    reprojection_residuals,
    resection,
    triangulate,
    triangulation_covariance,
)
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray, move_cameras, move_points, unit_rows, whitener
from stereoservo.geometry.homography import (
    homography_covariance,
    homography_from_basis,
    homography_from_points,
    homography_refine,
    pixel_whitening,
)

STANDARD_BASIS = np.vstack([np.eye(4), np.ones(4)])
"""``E₁`` to ``E₅``: the coordinates of the five points in the frame that they carry."""
OFF_PLANE = 5.0
"""Standard deviations by which points must stand off their best common plane not to count as coplanar."""
EXACT = 1e-9
"""Standard deviation, relative to their norm, that points without a covariance are taken to have."""


def scene_frame(points: FloatArray) -> FloatArray:
    """``H_PP`` (4, 4): the standard basis onto five scene points ``(5, 4)``, ``M_p ~ H_PP E_p`` (2.19, 2.20, errata).

    ``H_PP = [M₁..M₄] diag([M₁..M₄]⁻¹ M₅)``; with an upgrade of the cameras' frame, ``X ~ H_PE H_PP E`` (2.21). Raises
    GeometryError naming four points that are coplanar.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.shape != (5, 4):
        raise GeometryError(
            "shape", f"points have shape {points.shape}; five carry a frame, (5, 4)", shape=points.shape
        )
    refuse_coplanar(points)
    return homography_from_basis(STANDARD_BASIS, points)


def plane_deviations(points: FloatArray, covariance: FloatArray | None = None) -> tuple[FloatArray, float]:
    """Best common plane (4,) of points ``(n, 4)``, n >= 4, and the rms distance from it in standard deviations.

    ``covariance`` (n, 4, 4) of the points at their scale; None takes them as exact to `EXACT`. The same in any frame.
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
        plane: FloatArray = np.asarray(np.linalg.solve(R, np.linalg.svd(Q[:n])[2][3]), dtype=np.float64)
        plane = plane / np.linalg.norm(plane)
        spread = np.sqrt(np.einsum("i,nij,j->n", plane, covariance, plane))
        weights = 1.0 / np.where(spread > 0, spread, 1.0)
        weights = weights / weights.max()
    deviations = (points @ plane) / np.where(spread > 0, spread, 1.0)
    return plane, float(np.sqrt(np.mean(deviations**2)))


def refuse_coplanar(
    points: FloatArray, covariance: FloatArray | None = None, names: Sequence[int] | None = None
) -> None:
    """Raise GeometryError naming the points where all but one, or all, of ``(n, 4)`` are coplanar within noise.

    Of five points that is four coplanar ones: they carry no frame. ``covariance`` as for `plane_deviations`; ``names``
    (n,) are the numbers to call the points by, default 0 to n - 1.
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
    by row; ``points`` (k,) the rows that were used; ``rms`` of the residuals in standard deviations, 1 where the model
    holds; ``degrees_of_freedom`` of them.
    """

    H: FloatArray
    covariance: FloatArray
    points: tuple[int, ...]
    rms: float
    degrees_of_freedom: int


def frame_change(
    M_old: FloatArray,
    Ps_new: FloatArray,
    pixels_new: FloatArray,
    sigma: float = 1.0,
    M_covariance: FloatArray | None = None,
) -> FrameChange:
    """What brings the old frame into that of moved cameras, of least reprojection error (2.19-2.21 for n >= 5 points).

    ``M_old`` (n, 4): scene points that stood still, in the old frame; ``Ps_new`` (c, 3, 4): the moved cameras in their
    own new frame, c >= 2; ``pixels_new`` (c, n, 2) [px] of noise ``sigma`` [px], NaN where missing. ``M_covariance``
    (n, 4, 4): that of ``M_old`` at its scale; without it they count as exact.

    Raises GeometryError for fewer than five points seen by two cameras, and naming those that are coplanar: four of
    five, or all but one.
    """
    M_old, pixels = np.asarray(M_old, dtype=np.float64), np.asarray(pixels_new, dtype=np.float64)
    if M_old.ndim != 2 or M_old.shape[1] != 4 or pixels.shape != (len(Ps_new), len(M_old), 2):
        raise GeometryError(
            "shape",
            f"points {M_old.shape}, cameras {np.shape(Ps_new)}, pixels {pixels.shape} do not fit; (n, 4), (c, 3, 4), "
            "(c, n, 2) are needed",
            points=M_old.shape,
            pixels=pixels.shape,
        )
    known = np.isfinite(M_old).all(axis=1)
    seen = np.isfinite(pixels).all(axis=2)
    sigmas = np.where(seen, sigma, np.inf)
    M_new = triangulate(Ps_new, pixels, sigma, iterations=6)
    both = np.flatnonzero(known & np.isfinite(M_new).all(axis=1))
    if len(both) < 5:
        raise GeometryError(
            "too_few",
            f"{len(both)} of {len(M_old)} points are known and seen by two cameras ({both.tolist()}); a frame needs "
            "at least 5",
            points=both.tolist(),
        )
    refuse_coplanar(
        M_new[both], triangulation_covariance(Ps_new, M_new[both], sigmas[:, both]), both.tolist()
    )
    used = np.flatnonzero(known & seen.any(axis=0))
    own = None if M_covariance is None else np.asarray(M_covariance, dtype=np.float64)[used]
    start = homography_from_points(M_old[both], M_new[both])
    H = homography_refine(start, Ps_new, M_old[used], pixels[:, used], sigma, own)
    covariance = homography_covariance(H, Ps_new, M_old[used], pixels[:, used], sigma, own)
    residuals = _whitened_residuals(H, Ps_new, M_old[used], pixels[:, used], sigma, own)
    freedom = residuals.size - 15
    return FrameChange(
        H, covariance, tuple(used.tolist()), float(np.sqrt(residuals @ residuals / freedom)), freedom
    )


def _whitened_residuals(
    H: FloatArray,
    Ps: FloatArray,
    M: FloatArray,
    pixels: FloatArray,
    sigma: float,
    M_covariance: FloatArray | None,
) -> FloatArray:
    """Residuals of all measured coordinates in standard deviations, flat."""
    seen = np.asarray(np.isfinite(pixels).all(axis=2))
    residuals = np.where(seen[..., None], reprojection_residuals(Ps @ H, M, pixels), 0.0)
    whitening = pixel_whitening(Ps, H, M, np.where(seen, 1.0 / sigma, 0.0), M_covariance)
    flat = residuals.transpose(1, 0, 2).reshape(len(M), -1, 1)
    return (whitening @ flat)[np.repeat(seen.T, 2, axis=1)].ravel()


def frame_change_from_points(M_old: FloatArray, M_new: FloatArray) -> FloatArray:
    """``H`` (4, 4) from the points' old and new reconstructions ``(n, 4)`` alone, linear; exact for five (2.20).

    ``|det H| = 1``, the sign keeps heights. Rows with NaN are left out. Raises GeometryError naming coplanar points.
    """
    M_old, M_new = np.asarray(M_old, dtype=np.float64), np.asarray(M_new, dtype=np.float64)
    if M_old.ndim != 2 or M_old.shape[1] != 4 or M_old.shape != M_new.shape:
        raise GeometryError(
            "shape", f"point sets have shapes {M_old.shape} and {M_new.shape}; both must be (n, 4)"
        )
    seen = np.flatnonzero(np.isfinite(M_old).all(axis=1) & np.isfinite(M_new).all(axis=1))
    refuse_coplanar(M_old[seen], None, seen.tolist())
    refuse_coplanar(M_new[seen], None, seen.tolist())
    return homography_from_points(M_old[seen], M_new[seen])


@dataclass(frozen=True)
class Carried:
    """What was known, in the new frame: points ``(m, 4)``, generators ``(n, 4, 4)``, cameras ``(c, 3, 4)``."""

    points: FloatArray
    generators: FloatArray
    cameras: FloatArray


def carry_over(
    H: FloatArray,
    points: FloatArray | None = None,
    generators: FloatArray | None = None,
    cameras: FloatArray | None = None,
) -> Carried:
    """Points ``H M``, generators ``H Ĝ H⁻¹`` and cameras ``P H⁻¹`` of the old frame in the new one.

    Cameras are those that stood still while others moved. What is not given comes back empty.
    """
    return Carried(
        move_points(H, np.zeros((0, 4)) if points is None else points),
        conjugate(H, np.zeros((0, 4, 4)) if generators is None else np.asarray(generators, dtype=np.float64)),
        move_cameras(H, np.zeros((0, 3, 4)) if cameras is None else cameras),
    )


def carried_point_covariance(
    change: FrameChange, M: FloatArray, M_covariance: FloatArray | None = None
) -> FloatArray:
    """First-order covariance ``(m, 4, 4)`` of carried points ``H M`` from that of H and, if given, of the points.

    Both taken as independent: for points that are not among those that gave H.
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
    """One moved camera in the frame of scene points ``(n, 4)`` that stood still, n >= 6, from ``pixels`` (n, 2) [px].

    Of least reprojection error (`resection`); NaN pixels are left out, ``sigma`` [px] is their noise. Raises
    GeometryError for fewer than six points and where they, or noise, leave the camera undetermined (coplanar points).
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
    spread = (whitened.T.reshape(-1, 3, 4) @ root).reshape(-1, 12).T
    spread = spread - np.outer(P.ravel(), P.ravel() @ spread)
    residuals = reprojection_residuals(P[None], M, pixels[None]).ravel() / sigma
    freedom = residuals.size - 11
    return ResectedCamera(P, spread @ spread.T, float(np.sqrt(residuals @ residuals / freedom)), freedom)


def _refuse_flat_view(P: FloatArray, spread: FloatArray) -> None:
    """Raise GeometryError where a homography of the points' plane explains the pixels within noise.

    ``P`` (3, 4) with the points' best plane as first coordinate, and a root ``spread`` (12, 11) of its covariance:
    without a significant first column the images are those of points in the plane.
    """
    column, root = P[:, 0], spread[[0, 4, 8]]
    deviations = float(np.sqrt(column @ np.linalg.solve(root @ root.T, column) / 3.0))
    if deviations < OFF_PLANE:
        raise GeometryError(
            "degenerate",
            f"the points are coplanar within noise: their relief shows by {deviations:.3g} standard deviations, "
            f"{OFF_PLANE:g} are needed; add points off their plane",
            deviations=deviations,
            needed=OFF_PLANE,
        )


def canonical_frame(P: FloatArray, normaliser: FloatArray, points: FloatArray) -> FloatArray:
    """``H`` (4, 4) from the old frame to the canonical one of a moved first camera ``P`` (3, 4): ``P H⁻¹ = [N⁻¹ | 0]``.

    The plane (0, 0, 0, 1) stays in its place, scaled so that ``points`` (n, 4), which the camera sees, have mean height
    1 at depth 1. Raises GeometryError where the camera's centre, or a middle of the points, lies in that plane.
    """
    H = np.vstack([normaliser @ P, np.eye(4)[3:]])
    depth, height = points @ H[2], points @ H[3]
    side = 1.0 if (depth > 0).sum() >= (depth < 0).sum() else -1.0
    mean = float(np.mean(height / depth))
    centre = camera_centre(P)
    if not (abs(mean) > 1e-9 and abs(centre[3]) > 1e-9 * np.linalg.norm(centre)):
        raise GeometryError(
            "degenerate",
            f"the plane (0, 0, 0, 1) passes through the camera's centre {centre.tolist()} or between the points",
            centre=centre.tolist(),
            height=mean,
        )
    H[:3] *= side
    H[3] *= side / mean
    return H
