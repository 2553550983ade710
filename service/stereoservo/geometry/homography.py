"""4x4 homographies between projective point sets: linear from five points or more, scaled to unit determinant, and the
whitening of pixels for their refinement in the images (thesis 2.2).
"""

from __future__ import annotations

import numpy as np

from stereoservo.geometry.cameras import isotropic_normaliser, projection_jacobian_many
from stereoservo.geometry.homogeneous import GeometryError, to_homogeneous, whitener
from stereoservo.numerics.arrays import FloatArray

COPLANAR_TAIL = 1e-3
"""Probability with which coplanar points are accepted as spatial ones."""


def homography_from_points(A: FloatArray, B: FloatArray) -> FloatArray:
    """``H`` (4, 4) with ``B_i ~ H A_i`` for points ``(n, 4)``, n >= 5, linear with whitening; ``|det H| = 1``.

    The sign keeps heights: ``H A_i`` points in the direction of ``B_i``. Rows with NaN are left out. Raises
    GeometryError for fewer than five points or points that leave H undetermined (coplanar): exactly, or, from six
    points on, within the noise that the fit shows. Five points fit exactly and show no noise: for noisy ones use
    `moved_cameras.refuse_coplanar`.
    """
    H, count, values = _least_squares_homography(A, B)
    chance = _chance_of_coplanar(values, count)
    if chance > COPLANAR_TAIL:
        raise GeometryError(
            "degenerate",
            f"the {count} points are coplanar within their noise: as such they would look like this with probability "
            f"{chance:.2g}, {COPLANAR_TAIL:g} at most may; points farther off one plane, or less noise, are needed",
            probability=chance,
            limit=COPLANAR_TAIL,
        )
    return unit_determinant(H, "the homography")


def _chance_of_coplanar(values: FloatArray, count: int) -> float:
    """Probability of a least singular value so far below the next larger one, if the points were coplanar.

    Whitening uses the noise across the plane of coplanar points as their fourth coordinate. Then both values consist of
    that noise alone, over 3 n - 14 degrees of freedom, the least of them smaller by √3: there H is the identity of the
    plane's three coordinates, of unit norm. For two directions of equal noise over ν degrees of freedom,
    ``(2 s t / (s² + t²))^(ν - 1)`` is uniform in [0, 1] (the test of sphericity, exact for two).
    """
    if count < 6:
        return 0.0
    second, least = float(values[14]), min(float(np.sqrt(3.0) * values[15]), float(values[14]))
    return float((2.0 * second * least / (second**2 + least**2)) ** (3 * count - 15))


def linear_homography(A: FloatArray, B: FloatArray) -> tuple[FloatArray, int, FloatArray]:
    """``H`` (4, 4) as by `homography_from_points`, without its test against noise: for points that have passed
    another test. Also the number of points used, and the 16 singular values of the equations.
    """
    H, count, values = _least_squares_homography(A, B)
    return unit_determinant(H, "the homography"), count, values


def _least_squares_homography(A: FloatArray, B: FloatArray) -> tuple[FloatArray, int, FloatArray]:
    """As `linear_homography`, but ``H`` has any scale and may be singular."""
    A, B = np.asarray(A, dtype=np.float64), np.asarray(B, dtype=np.float64)
    if A.ndim != 2 or A.shape[1] != 4 or A.shape != B.shape:
        raise GeometryError("shape", f"point sets have shapes {A.shape} and {B.shape}; both must be (n, 4)")
    seen = np.isfinite(A).all(axis=1) & np.isfinite(B).all(axis=1)
    A, B = A[seen], B[seen]
    if len(A) < 5:
        raise GeometryError("too_few", f"{len(A)} points; a 4x4 homography needs at least 5", points=len(A))
    W_A, W_B = whitener(A), whitener(B)
    a, b = A @ W_A.T, B @ W_B.T
    a = a / np.linalg.norm(a, axis=1, keepdims=True)
    b = b / np.linalg.norm(b, axis=1, keepdims=True)
    # Three rows per point: an orthonormal basis of the planes through b, from the Householder reflection that
    # maps b to e₁.
    sign = np.where(b[:, :1] >= 0, 1.0, -1.0)
    mirror = b + sign * np.eye(1, 4)
    mirror = mirror / np.linalg.norm(mirror, axis=1, keepdims=True)
    planes = (np.eye(4) - 2.0 * mirror[:, :, None] * mirror[:, None, :])[:, 1:]
    system = (planes[:, :, :, None] * a[:, None, None, :]).reshape(-1, 16)
    _, values, v = np.linalg.svd(system, full_matrices=len(system) < 16)
    singular = np.append(values, np.zeros(16 - len(values)))
    if not singular[14] > 1e-9 * singular[0]:
        raise GeometryError("degenerate", "the points do not determine a homography (four of five coplanar?)")
    H: FloatArray = np.linalg.solve(W_B, v[15].reshape(4, 4)) @ W_A
    agreement = (np.sign(((A @ H.T) * B).sum(axis=1))).sum()
    return (-H if agreement < 0 else H), len(A), singular


def plane_homography(plane: FloatArray, pixels: FloatArray) -> FloatArray:
    """``H`` (3, 3) from points of a plane ``(n, 2)`` to pixels ``(n, 2)``, n >= 4, linear in normalised coordinates.

    The sign gives the points a positive depth. Raises GeometryError if they do not determine H (collinear).
    """
    if len(plane) < 4:
        raise GeometryError("too_few", f"{len(plane)} points; a plane's homography needs at least 4")
    T, S = isotropic_normaliser(pixels), isotropic_normaliser(plane)
    x, X = to_homogeneous(pixels) @ T.T, to_homogeneous(plane) @ S.T
    zero = np.zeros_like(X)
    system = np.vstack([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:2] * X])])
    _, values, rows = np.linalg.svd(system)
    if not values[7] > 1e-6 * values[0]:
        raise GeometryError("degenerate", "the points do not determine a plane's homography (on one line?)")
    H: FloatArray = np.linalg.solve(T, rows[8].reshape(3, 3)) @ S
    return -H if float(np.median(to_homogeneous(plane) @ H[2])) < 0.0 else H


def unit_determinant(H: FloatArray, what: str) -> FloatArray:
    """``H`` (4, 4) scaled to ``|det H| = 1``. Raises GeometryError if it is singular."""
    size = float(np.linalg.norm(H))
    determinant = abs(float(np.linalg.det(H / size)))
    if not determinant > 1e-20:
        raise GeometryError("degenerate", f"{what} is singular", determinant=determinant)
    scaled: FloatArray = H / (size * determinant**0.25)
    return scaled


def pixel_whitening(
    Ps: FloatArray, H: FloatArray, M: FloatArray, weights: FloatArray, M_covariance: FloatArray | None
) -> FloatArray:
    """Whitening ``(n, 2c, 2c)`` of the pixel differences of each point, 0 where not seen.

    ``weights`` (c, n) [1/px]. The points' own covariance, if given, is propagated into the images to first order.
    """
    w = np.repeat(weights.T, 2, axis=1)
    if M_covariance is None:
        return w[:, :, None] * np.eye(w.shape[1])
    J = projection_jacobian_many(Ps @ H, M).transpose(1, 0, 2, 3).reshape(len(M), -1, 4) * w[..., None]
    root = np.linalg.cholesky(np.eye(w.shape[1]) + J @ M_covariance @ J.transpose(0, 2, 1))
    whitening: FloatArray = np.linalg.inv(root) * w[:, None, :]
    return whitening
