"""Change of projective frame from images, and what moves with it (thesis 2.19-2.21, 2.83): references for alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from oracles.projective_points import move_cameras
from stereoservo.geometry.cameras import (
    camera_centre,
    check_views,
    project_many,
    reprojection_residuals,
    triangulate,
    triangulation_covariance,
)
from stereoservo.geometry.displacements import conjugate
from stereoservo.geometry.homogeneous import GeometryError, move_points, whitener
from stereoservo.geometry.homography import homography_from_points, pixel_whitening, unit_determinant
from stereoservo.geometry.moved_cameras import (
    FrameChange,
    refuse_coplanar,
)
from stereoservo.numerics.arrays import FloatArray

STANDARD_BASIS = np.vstack([np.eye(4), np.ones(4)])
"""``E₁`` to ``E₅``: the coordinates of the five points in the frame that they carry."""


def homography_from_basis(A: FloatArray, B: FloatArray) -> FloatArray:
    """``H`` (4, 4) with ``B_i ~ H A_i`` for five points ``(5, 4)``: ``H = [B] diag(b/a) [A]⁻¹`` (2.20,
    corrected).

    ``b = [B₁..B₄]⁻¹B₅``, ``a = [A₁..A₄]⁻¹A₅``. H maps A₅ to B₅ itself, scale included. Raises GeometryError
    where four of the five points of a set are coplanar.
    """
    coefficients = []
    for name, X in (("first", A), ("second", B)):
        X = np.asarray(X, dtype=np.float64)
        if X.shape != (5, 4):
            raise GeometryError("shape", f"the {name} basis has shape {X.shape}; (5, 4) is needed", shape=X.shape)
        unit = X / np.linalg.norm(X, axis=1, keepdims=True)
        if not abs(np.linalg.det(unit[:4])) > 1e-12:
            raise GeometryError("degenerate", f"points 1 to 4 of the {name} basis are coplanar")
        x = np.linalg.solve(X[:4].T, X[4])
        if not np.abs(x).min() > 1e-10 * np.abs(x).max():
            raise GeometryError("degenerate", f"point 5 of the {name} basis is coplanar with three others", weights=x)
        coefficients.append(x)
    a, b = coefficients
    H: FloatArray = (np.asarray(B, dtype=np.float64)[:4].T * (b / a)) @ np.linalg.inv(A[:4].T)
    return H


def _image_jacobian(Ps: FloatArray, H: FloatArray, M: FloatArray) -> FloatArray:
    """Derivative ``(n, 2c, 16)`` of the pixels of ``H M`` in the entries of ``H`` (4, 4), row by row (2.83)."""
    m = np.einsum("cij,nj->cni", Ps @ H, M)
    u = m[..., :2] / m[..., 2:]
    rows = (Ps[:, None, :2, :] - u[..., None] * Ps[:, None, 2:, :]) / m[..., 2, None, None]
    full = rows[..., :, None] * M[None, :, None, None, :]
    jacobian: FloatArray = full.transpose(1, 0, 2, 3, 4).reshape(len(M), 2 * len(Ps), 16)
    return jacobian


def homography_refine(
    H: FloatArray,
    Ps: FloatArray,
    M_from: FloatArray,
    pixels_to: FloatArray,
    sigma: FloatArray | float = 1.0,
    M_covariance: FloatArray | None = None,
) -> FloatArray:
    """``H`` (4, 4) of least reprojection error of ``P_c H M``, 15 parameters; ``det H`` of its sign and
    size 1.

    Cameras ``(c, 3, 4)``, points ``(n, 4)``, target pixels ``(c, n, 2)`` [px], NaN where missing; ``sigma``
    (c, n) or a number [px]. ``M_covariance`` (n, 4, 4): the points' own, which adds to that of the pixels to
    first order. Raises GeometryError for shapes that do not fit or fewer than 15 coordinates.
    """
    pixels, weights = check_views(Ps, pixels_to, np.broadcast_to(1.0 / np.asarray(sigma), pixels_to.shape[:2]))
    measured = 2 * int((weights > 0).sum())
    if measured < 15:
        raise GeometryError("too_few", f"{measured} pixel coordinates; 15 parameters need as many", measured=measured)
    result = np.asarray(H, dtype=np.float64)
    # The weights follow the solution where the points' covariance enters them: twice is enough, it is small.
    for _ in range(1 if M_covariance is None else 2):
        whitening = pixel_whitening(Ps, result, M_from, weights, M_covariance)
        result = _least_squares(result, Ps, M_from, pixels, whitening)
    return result


def _least_squares(
    H: FloatArray, Ps: FloatArray, M: FloatArray, pixels: FloatArray, whitening: FloatArray
) -> FloatArray:
    """``H`` (4, 4) of least whitened pixel differences from a start, moved across its own direction."""
    W = whitener(M)
    X = M @ W.T
    base = (H / np.linalg.norm(H) @ np.linalg.inv(W)).ravel()
    chart = np.linalg.svd(base[None])[2][1:].T * float(np.linalg.norm(base))

    def residuals(z: FloatArray) -> FloatArray:
        u = project_many(Ps @ (base + chart @ z).reshape(4, 4), X)
        difference = (u - pixels).transpose(1, 0, 2).reshape(len(X), -1)
        whitened: FloatArray = np.einsum("nij,nj->ni", whitening, difference).ravel()
        return whitened

    def jacobian(z: FloatArray) -> FloatArray:
        full = whitening @ _image_jacobian(Ps, (base + chart @ z).reshape(4, 4), X)
        product: FloatArray = full.reshape(-1, 16) @ chart
        return product

    fit = least_squares(residuals, np.zeros(15), jac=jacobian, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return unit_determinant((base + chart @ fit.x).reshape(4, 4) @ W, "the refined homography")


def homography_covariance(
    H: FloatArray,
    Ps: FloatArray,
    M_from: FloatArray,
    pixels_to: FloatArray,
    sigma: FloatArray | float = 1.0,
    M_covariance: FloatArray | None = None,
) -> FloatArray:
    """First-order covariance ``(16, 16)`` of the entries of a refined ``H`` (4, 4) at ``|det H| = 1``, row by row.

    Arguments as for `homography_refine`; of rank 15. Raises GeometryError where the images leave H undetermined.
    """
    _, weights = check_views(Ps, pixels_to, np.broadcast_to(1.0 / np.asarray(sigma), pixels_to.shape[:2]))
    H = unit_determinant(H, "the homography")
    # Steps that keep the determinant: tr(H⁻¹ dH) = 0.
    chart = np.linalg.svd(np.linalg.inv(H).T.reshape(1, 16))[2][1:].T
    J = pixel_whitening(Ps, H, M_from, weights, M_covariance) @ _image_jacobian(Ps, H, M_from)
    _, singular, rows = np.linalg.svd(J.reshape(-1, 16) @ chart, full_matrices=False)
    if len(singular) < 15 or not singular[14] > 1e-10 * singular[0]:
        raise GeometryError(
            "degenerate",
            "the images do not determine the homography (four of five points coplanar?)",
            singular=singular,
        )
    spread = chart @ (rows.T / singular)
    covariance: FloatArray = spread @ spread.T
    return covariance


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
    refuse_coplanar(M_new[both], triangulation_covariance(Ps_new, M_new[both], sigmas[:, both]), both.tolist())
    used = np.flatnonzero(known & seen.any(axis=0))
    own = None if M_covariance is None else np.asarray(M_covariance, dtype=np.float64)[used]
    start = homography_from_points(M_old[both], M_new[both])
    H = homography_refine(start, Ps_new, M_old[used], pixels[:, used], sigma, own)
    covariance = homography_covariance(H, Ps_new, M_old[used], pixels[:, used], sigma, own)
    residuals = _whitened_residuals(H, Ps_new, M_old[used], pixels[:, used], sigma, own)
    freedom = residuals.size - 15
    return FrameChange(H, covariance, tuple(used.tolist()), float(np.sqrt(residuals @ residuals / freedom)), freedom)


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
        raise GeometryError("shape", f"point sets have shapes {M_old.shape} and {M_new.shape}; both must be (n, 4)")
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
