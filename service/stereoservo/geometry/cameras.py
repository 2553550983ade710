"""Projective cameras: projection and its Jacobian, reprojection residuals, triangulation with covariance, canonical
pair of a fundamental matrix, resection from known points.

Cameras are stacked first: ``Ps`` (c, 3, 4), pixels (c, n, 2) [px]. A missing pixel is NaN.
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.homogeneous import GeometryError, plane_of_points, to_homogeneous, whitener
from stereoservo.numerics.arrays import BoolArray, FloatArray

NOMINAL_FOCAL = 2.0
"""Nominal focal length [half image widths] by which the canonical pair places its frame: 53° field of view."""

DEFINITENESS = 1e-14
"""Relative eigenvalue of a point's normal matrix below which its rays count as coincident."""


def pixel_normaliser(width: int, height: int) -> FloatArray:
    """``N`` (3, 3): maps pixels so that the image centre is the origin and half the width the unit."""
    if width <= 0 or height <= 0:
        raise GeometryError(
            "shape", f"image size is {width}x{height}; both must be positive", width=width, height=height
        )
    half = width / 2.0
    return np.array(
        [[1 / half, 0.0, -(width - 1) / 2 / half], [0.0, 1 / half, -(height - 1) / 2 / half], [0.0, 0.0, 1.0]]
    )


def camera_centre(P: FloatArray) -> FloatArray:
    """Centre ``(4,)`` of a camera ``(3, 4)``: signed minors, ``cᵀX = det[P; X]``, so that its sign is meaningful."""
    return plane_of_points(P[0], P[1], P[2])


def project(P: FloatArray, M: FloatArray) -> FloatArray:
    """Pixels ``(n, 2)`` of points ``(n, 4)``; NaN where a point lies in the camera's focal plane."""
    m = M @ P.T
    pixels: FloatArray = m[:, :2] / np.where(m[:, 2:] == 0.0, np.nan, m[:, 2:])
    return pixels


def project_many(Ps: FloatArray, M: FloatArray) -> FloatArray:
    """Pixels ``(c, m, 2)`` of points ``(m, 4)`` in cameras ``(c, 3, 4)``; NaN in a focal plane."""
    m = np.einsum("cij,mj->cmi", Ps, M)
    pixels: FloatArray = m[..., :2] / np.where(m[..., 2:] == 0.0, np.nan, m[..., 2:])
    return pixels


def projection_jacobian(P: FloatArray, M: FloatArray) -> FloatArray:
    """``J_G P`` ``(n, 2, 4)`` [px per unit of M] (8.4, 8.8): derivative of pixels by homogeneous points ``(n, 4)``.

    ``J_G = 1/m₃ [[1, 0, −u], [0, 1, −v]]``.
    """
    jacobian: FloatArray = projection_jacobian_many(P[None], M)[0]
    return jacobian


def projection_jacobian_many(Ps: FloatArray, M: FloatArray) -> FloatArray:
    """Derivative ``(c, n, 2, 4)`` of pixels by points ``(n, 4)`` in cameras ``(c, 3, 4)`` (8.8)."""
    m = np.einsum("cij,nj->cni", Ps, M)
    depth = np.where(m[..., 2] == 0.0, np.nan, m[..., 2])
    pixels = m[..., :2] / depth[..., None]
    rows = Ps[:, None, :2, :] - pixels[..., None] * Ps[:, None, 2:, :]
    jacobian: FloatArray = rows / depth[..., None, None]
    return jacobian


def reprojection_residuals(Ps: FloatArray, M: FloatArray, pixels: FloatArray) -> FloatArray:
    """Measured less projected pixels ``(c, n, 2)`` [px]; NaN where the pixel is missing."""
    residuals: FloatArray = pixels - project_many(Ps, M)
    return residuals


def check_views(Ps: FloatArray, pixels: FloatArray, weights: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(c, n, 2)`` and weights ``(c, n)``, both with 0 for missing ones.

    Raises GeometryError on shapes that do not fit and on weights that are negative or not finite.
    """
    if Ps.ndim != 3 or Ps.shape[1:] != (3, 4) or pixels.ndim != 3 or pixels.shape[::2] != (Ps.shape[0], 2):
        raise GeometryError(
            "shape",
            f"cameras {Ps.shape} and pixels {pixels.shape} do not fit; (c, 3, 4) and (c, n, 2) are needed",
            cameras=Ps.shape,
            pixels=pixels.shape,
        )
    seen: BoolArray = np.asarray(np.isfinite(pixels).all(axis=2))
    w = np.ones(seen.shape) if weights is None else np.broadcast_to(np.asarray(weights, dtype=np.float64), seen.shape)
    if not (np.isfinite(w[seen]).all() and (w[seen] >= 0).all()):
        raise GeometryError("not_finite", "weights must be finite and not negative where a pixel is given")
    return np.where(seen[..., None], pixels, 0.0), np.where(seen, w, 0.0)


def triangulate(
    Ps: FloatArray, pixels: FloatArray, sigmas: FloatArray | float | None = None, iterations: int = 3
) -> FloatArray:
    """Points ``(n, 4)`` of least reprojection error, scaled to depth 1 in the first camera (third row of ``Ps[0]``).

    A linear solution, then ``iterations`` renormalised ones (2.73): constraints of each camera divided by
    its own depth. The constraints use the *predicted* pixel, so that the fixed point is the exact minimum
    of the reprojection error. ``sigmas`` (c, n) or a number [px]; default 1. Rows are NaN if fewer than two
    cameras see a point or its rays do not determine it. Raises GeometryError on shapes that do not fit.
    """
    weights = None if sigmas is None else 1.0 / np.broadcast_to(np.asarray(sigmas, dtype=np.float64), pixels.shape[:2])
    values, w = check_views(Ps, pixels, weights)
    # The depth is fixed by eliminating one coordinate k through the first camera's third row.
    third = Ps[0, 2]
    k = int(np.argmax(np.abs(third)))
    others = [j for j in range(4) if j != k]
    free = np.zeros((4, 3))
    free[others, range(3)] = 1.0
    free[k] = -third[others] / third[k]
    start = np.zeros(4)
    start[k] = 1.0 / third[k]

    M = np.broadcast_to(start, (values.shape[1], 4)).copy()
    good = (w > 0).sum(axis=0) >= 2
    rows = (Ps[:, None, :2, :] - values[..., None] * Ps[:, None, 2:, :]) * w[..., None, None]
    M, good = _least_squares_step(rows, -np.einsum("cnij,nj->cni", rows, M), M, free, good)
    for _ in range(iterations):
        m = np.einsum("cij,nj->cni", Ps, M)
        depth = np.where(m[..., 2] == 0.0, np.nan, m[..., 2])
        predicted = m[..., :2] / depth[..., None]
        rows = (Ps[:, None, :2, :] - predicted[..., None] * Ps[:, None, 2:, :]) * (w / depth)[..., None, None]
        residual = (values - predicted) * w[..., None]
        lost = w == 0
        rows[lost], residual[lost] = 0.0, 0.0
        M, good = _least_squares_step(rows, residual, M, free, good)
    M[~good] = np.nan
    return M


def _least_squares_step(
    rows: FloatArray,
    residual: FloatArray,
    M: FloatArray,
    free: FloatArray,
    good: BoolArray,
) -> tuple[FloatArray, BoolArray]:
    """One batched Gauss-Newton step in the three free coordinates; points that fail are marked."""
    A = rows @ free
    normal = np.einsum("cnij,cnik->njk", A, A)
    right = np.einsum("cnij,cni->nj", A, residual)
    finite = np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(right).all(axis=1)
    normal[~finite] = np.eye(3)
    right[~finite] = 0.0
    eigenvalues = np.linalg.eigvalsh(normal)
    definite = finite & (eigenvalues[:, 0] > DEFINITENESS * eigenvalues[:, 2])
    normal[~definite] = np.eye(3)
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    good = good & definite
    return M + np.where(good[:, None], step, 0.0) @ free.T, good


def triangulation_covariance(Ps: FloatArray, M: FloatArray, sigmas: FloatArray) -> FloatArray:
    """First-order covariance ``(n, 4, 4)`` of points scaled to depth 1, for pixel noise ``sigmas`` (c, n) [px].

    An infinite sigma marks a missing view. Rank 3: the depth is fixed.
    """
    third = Ps[0, 2]
    free = np.linalg.svd(third[None])[2][1:].T
    J = projection_jacobian_many(Ps, M) @ free / np.broadcast_to(sigmas, (Ps.shape[0], M.shape[0]))[..., None, None]
    information = np.einsum("cnij,cnik->njk", J, J)
    covariance: FloatArray = free @ np.linalg.inv(information) @ free.T
    return covariance


def canonical_pair(
    F: FloatArray,
    width: int,
    height: int,
    *,
    right_size: tuple[int, int] | None = None,
    left: FloatArray | None = None,
    right: FloatArray | None = None,
    nominal_focal: float = NOMINAL_FOCAL,
) -> tuple[FloatArray, FloatArray]:
    """Cameras ``P_left = [N⁻¹ | 0]`` and ``P_right`` (3, 4) consistent with ``m'ᵀ F m = 0`` [px] (2.11, 2.12).

    With ``e'`` the right epipole, ``P_right ~ [[e']ₓF + e'aᵀ | λe']``. The free ``a`` is chosen so that the
    left 3x3 block is a rotation for cameras of ``nominal_focal`` [half image widths]: the frame is then
    close to an affine one and well conditioned. The signs and ``λ`` put the matches ``left``, ``right`` (n, 2)
    [px], or without them the intersection of the optical axes, in front of both cameras at a fourth
    coordinate of about one.

    ``width``, ``height`` of the left image; ``right_size`` of the right one if it differs. Raises
    GeometryError if F is not of rank two.
    """
    F = np.asarray(F, dtype=np.float64)
    if F.shape != (3, 3) or not np.isfinite(F).all():
        raise GeometryError("shape", f"F must be a finite (3, 3) matrix, got {F.tolist()}")
    N_left = pixel_normaliser(width, height)
    N_right = pixel_normaliser(*(right_size or (width, height)))
    K = np.diag([nominal_focal, nominal_focal, 1.0])
    # Fundamental matrix of the nominally calibrated rays: an essential matrix if the nominal focal length is right.
    E = K @ np.linalg.inv(N_right).T @ F @ np.linalg.inv(N_left) @ K
    U, s, Vt = np.linalg.svd(E)
    if not (s[1] > 1e-6 * s[0] and s[2] < 1e-3 * s[1]):
        raise GeometryError("degenerate", f"F has singular values {s.tolist()}; it must be of rank two", singular=s)
    scale = np.sqrt(s[0] * s[1])
    epipole, null = U[:, 2], Vt[2]
    cross = np.array([[0, -epipole[2], epipole[1]], [epipole[2], 0, -epipole[0]], [-epipole[1], epipole[0], 0]])
    rotated = cross @ (U[:, :2] * (s[:2] / scale)) @ Vt[:2]

    rays_left, rays_right = _nominal_rays(F, N_left, N_right, K, left, right)
    best: tuple[int, FloatArray, FloatArray] | None = None
    for sign in (1.0, -1.0):  # the twisted pair: half a turn about the baseline
        block = sign * rotated + np.outer(epipole, null)
        if np.linalg.det(block) < 0:
            block = sign * rotated - np.outer(epipole, null)
        scales, depths = _scales_and_depths(block, epipole, rays_left, rays_right)
        front = depths > 0
        # Heights and depths of equal sign mean "in front of both", whichever sign of e' is needed for that.
        count = max(int((front & (scales > 0)).sum()), int((front & (scales < 0)).sum()))
        if best is None or count > best[0]:
            best = (count, block, scales)
    assert best is not None
    _, block, scales = best
    scales = scales[np.isfinite(scales)]
    median = float(np.median(scales)) if len(scales) else 0.0
    # With a wrong nominal focal length the plane at infinity may pass between the points: move it, by a, behind them.
    side = float(np.copysign(1.0, median))
    lowest = float((side * scales).min()) if len(scales) else 0.0
    if lowest < 0.25 * abs(median):
        shift = side * (lowest - 0.25 * abs(median)) / 0.75
        block = block + shift * np.outer(epipole, [0.0, 0.0, 1.0])
        median -= shift
    baseline = np.copysign(np.clip(abs(median), 1e-3, 1e3), median) * epipole
    P_left = np.hstack([np.linalg.inv(N_left), np.zeros((3, 1))])
    P_right = np.linalg.inv(N_right) @ K @ np.hstack([block @ np.linalg.inv(K), baseline[:, None]])
    return P_left, P_right


def _nominal_rays(
    F: FloatArray,
    N_left: FloatArray,
    N_right: FloatArray,
    K: FloatArray,
    left: FloatArray | None,
    right: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Matched rays (n, 3), or those of the left image's centre and of the right pixel nearest to the right centre."""
    to_left, to_right = np.linalg.inv(K) @ N_left, np.linalg.inv(K) @ N_right
    if left is not None and right is not None:
        seen = np.isfinite(left).all(axis=1) & np.isfinite(right).all(axis=1)
        if seen.any():
            return to_homogeneous(left[seen]) @ to_left.T, to_homogeneous(right[seen]) @ to_right.T
    centre = np.linalg.inv(N_left)[:, 2]
    line = np.linalg.inv(N_right).T @ (F @ centre)
    nearest = np.array([-line[0] * line[2], -line[1] * line[2], line[0] ** 2 + line[1] ** 2])
    ray = np.linalg.inv(K) @ (nearest / nearest[2] if nearest[2] > 0 else np.array([0.0, 0.0, 1.0]))
    return np.array([[0.0, 0.0, 1.0]]), ray[None]


def _scales_and_depths(
    block: FloatArray, epipole: FloatArray, rays_left: FloatArray, rays_right: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fourth coordinate (n,) at left depth 1, and right depth (n,), of points on matched rays: d x' = A x + w e'."""
    target = rays_left @ block.T
    x, e = rays_right, np.broadcast_to(epipole, rays_right.shape)
    moment = np.cross(x, e)
    square = (moment**2).sum(axis=1)
    square = np.where(square > 0, square, np.nan)
    scales = -(np.cross(x, target) * moment).sum(axis=1) / square
    depths = (np.cross(target, e) * moment).sum(axis=1) / square
    return scales, depths


def resection(M: FloatArray, pixels: FloatArray, refine: bool = True) -> FloatArray:
    """Camera ``P`` (3, 4), of unit Frobenius norm, from points ``(n, 4)`` and pixels ``(n, 2)`` [px], n >= 6.

    Linear in whitened coordinates, then (``refine``) of least reprojection error. Rows with NaN pixels are
    left out. The sign gives points of positive height a positive depth. Raises GeometryError for fewer
    than six points or points that leave the camera undetermined (coplanar, or on a twisted cubic with the
    centre).
    """
    seen = np.isfinite(pixels).all(axis=1) & np.isfinite(M).all(axis=1)
    M, pixels = M[seen], pixels[seen]
    if M.shape[0] < 6:
        raise GeometryError("too_few", f"{M.shape[0]} points; a camera needs at least 6", points=int(M.shape[0]))
    T = isotropic_normaliser(pixels)
    x = to_homogeneous(pixels) @ T.T
    root = whitener(M)
    X = M @ root.T
    X = X / np.linalg.norm(X, axis=1, keepdims=True)
    zero = np.zeros_like(X)
    system = np.concatenate([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:2] * X])], axis=0)
    _, singular, v = np.linalg.svd(system, full_matrices=False)
    if not singular[10] > 1e-9 * singular[0]:
        raise GeometryError("degenerate", "the points do not determine a camera (coplanar?)", singular=singular)
    P: FloatArray = np.linalg.inv(T) @ v[-1].reshape(3, 4) @ root
    if refine:
        P = _refine_camera(P, M, pixels)
    if np.median(np.sign(M @ P[2])) < 0:
        P = -P
    return P / np.linalg.norm(P)


def _refine_camera(P: FloatArray, M: FloatArray, pixels: FloatArray) -> FloatArray:
    from scipy.optimize import (
        least_squares,
    )  # here, so that the servo process can import cameras without scipy

    T = isotropic_normaliser(pixels)
    root = whitener(M)
    X, x = M @ root.T, from_pixels(T, pixels)
    start = (T @ P @ np.linalg.inv(root)).ravel()
    start = start / np.linalg.norm(start)
    chart = np.linalg.svd(start[None])[2][1:].T  # (12, 11): the scale is left out

    def residuals(z: FloatArray) -> FloatArray:
        return (project((start + chart @ z).reshape(3, 4), X) - x).ravel()

    def jacobian(z: FloatArray) -> FloatArray:
        m = X @ (start + chart @ z).reshape(3, 4).T
        J = np.zeros((X.shape[0], 2, 3, 4))
        scaled = X / m[:, 2:]
        J[:, 0, 0], J[:, 1, 1] = scaled, scaled
        J[:, :, 2] = -(m[:, :2] / m[:, 2:])[..., None] * scaled[:, None]
        product: FloatArray = J.reshape(-1, 12) @ chart
        return product

    fit = least_squares(residuals, np.zeros(11), jac=jacobian, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    refined: FloatArray = np.linalg.inv(T) @ (start + chart @ fit.x).reshape(3, 4) @ root
    return refined


def isotropic_normaliser(pixels: FloatArray) -> FloatArray:
    """``T`` (3, 3): maps pixels ``(n, 2)`` to mean 0 and mean distance √2 from it. Raises GeometryError if all pixels
    are equal.
    """
    centre = pixels.mean(axis=0)
    distance = float(np.linalg.norm(pixels - centre, axis=1).mean())
    if not distance > 1e-9 * (1.0 + float(np.abs(centre).max())):
        raise GeometryError("degenerate", f"all pixels are one point, {centre.tolist()}", centre=centre.tolist())
    s = np.sqrt(2.0) / distance
    return np.array([[s, 0.0, -s * centre[0]], [0.0, s, -s * centre[1]], [0.0, 0.0, 1.0]])


def from_pixels(T: FloatArray, pixels: FloatArray) -> FloatArray:
    """Apply a pixel map ``T`` (3, 3) without a perspective part to pixels ``(n, 2)``."""
    mapped: FloatArray = pixels @ T[:2, :2].T + T[:2, 2]
    return mapped
