"""4x4 homographies between projective point sets: from a basis, linear from many points, refined in the
images (thesis 2.2). :mod:`stereoservo.geometry.incidences` has those from lines and planes.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from stereoservo.geometry.cameras import check_views, project_many, projection_jacobian_many
from stereoservo.geometry.errors import GeometryError
from stereoservo.geometry.homogeneous import FloatArray, whitener


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
            raise GeometryError(
                "shape", f"the {name} basis has shape {X.shape}; (5, 4) is needed", shape=X.shape
            )
        unit = X / np.linalg.norm(X, axis=1, keepdims=True)
        if not abs(np.linalg.det(unit[:4])) > 1e-12:
            raise GeometryError("degenerate", f"points 1 to 4 of the {name} basis are coplanar")
        x = np.linalg.solve(X[:4].T, X[4])
        if not np.abs(x).min() > 1e-10 * np.abs(x).max():
            raise GeometryError(
                "degenerate", f"point 5 of the {name} basis is coplanar with three others", weights=x
            )
        coefficients.append(x)
    a, b = coefficients
    H: FloatArray = (np.asarray(B, dtype=np.float64)[:4].T * (b / a)) @ np.linalg.inv(A[:4].T)
    return H


def homography_from_points(A: FloatArray, B: FloatArray) -> FloatArray:
    """``H`` (4, 4) with ``B_i ~ H A_i`` for points ``(n, 4)``, n >= 5, linear with whitening; ``|det H| =
    1``.

    The sign keeps heights: ``H A_i`` points where ``B_i`` does. Rows with NaN are left out. Raises
    GeometryError for fewer than five points or points that leave H undetermined (coplanar).
    """
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
    # Three rows a point: an orthonormal basis of the planes through b, from the Householder reflection that
    # moves b to e₁.
    sign = np.where(b[:, :1] >= 0, 1.0, -1.0)
    mirror = b + sign * np.eye(1, 4)
    mirror = mirror / np.linalg.norm(mirror, axis=1, keepdims=True)
    planes = (np.eye(4) - 2.0 * mirror[:, :, None] * mirror[:, None, :])[:, 1:]
    system = (planes[:, :, :, None] * a[:, None, None, :]).reshape(-1, 16)
    _, singular, v = np.linalg.svd(system)
    if not singular[14] > 1e-9 * singular[0]:
        raise GeometryError("degenerate", "the points do not determine a homography (four of five coplanar?)")
    H: FloatArray = np.linalg.solve(W_B, v[15].reshape(4, 4)) @ W_A
    H = unit_determinant(H, "the homography")
    agreement = (np.sign(((A @ H.T) * B).sum(axis=1))).sum()
    return -H if agreement < 0 else H


def unit_determinant(H: FloatArray, what: str) -> FloatArray:
    """``H`` (4, 4) scaled to ``|det H| = 1``. Raises GeometryError where it is singular."""
    size = float(np.linalg.norm(H))
    determinant = abs(float(np.linalg.det(H / size)))
    if not determinant > 1e-20:
        raise GeometryError("degenerate", f"{what} is singular", determinant=determinant)
    scaled: FloatArray = H / (size * determinant**0.25)
    return scaled


def _image_jacobian(Ps: FloatArray, H: FloatArray, M: FloatArray) -> FloatArray:
    """Derivative ``(n, 2c, 16)`` of the pixels of ``H M`` in the entries of ``H`` (4, 4), row by row (2.83)."""
    m = np.einsum("cij,nj->cni", Ps @ H, M)
    u = m[..., :2] / m[..., 2:]
    rows = (Ps[:, None, :2, :] - u[..., None] * Ps[:, None, 2:, :]) / m[..., 2, None, None]
    full = rows[..., :, None] * M[None, :, None, None, :]
    jacobian: FloatArray = full.transpose(1, 0, 2, 3, 4).reshape(len(M), 2 * len(Ps), 16)
    return jacobian


def pixel_whitening(
    Ps: FloatArray, H: FloatArray, M: FloatArray, weights: FloatArray, M_covariance: FloatArray | None
) -> FloatArray:
    """``(n, 2c, 2c)``: pixel differences of each point into uncorrelated ones of unit size, 0 where not seen.

    ``weights`` (c, n) [1/px]. The points' own covariance, if given, is carried into the images to first order.
    """
    w = np.repeat(weights.T, 2, axis=1)
    if M_covariance is None:
        return w[:, :, None] * np.eye(w.shape[1])
    J = projection_jacobian_many(Ps @ H, M).transpose(1, 0, 2, 3).reshape(len(M), -1, 4) * w[..., None]
    spread = np.linalg.cholesky(np.eye(w.shape[1]) + J @ M_covariance @ J.transpose(0, 2, 1))
    whitening: FloatArray = np.linalg.inv(spread) * w[:, None, :]
    return whitening


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
    pixels, weights = check_views(
        Ps, pixels_to, np.broadcast_to(1.0 / np.asarray(sigma), pixels_to.shape[:2])
    )
    measured = 2 * int((weights > 0).sum())
    if measured < 15:
        raise GeometryError(
            "too_few", f"{measured} pixel coordinates; 15 parameters need as many", measured=measured
        )
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

    fit = least_squares(
        residuals, np.zeros(15), jac=jacobian, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
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
