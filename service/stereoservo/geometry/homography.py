"""4x4 homographies between projective point sets: from a basis, linear from many points, refined in the
images.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from stereoservo.geometry.cameras import check_views
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
    determinant = abs(float(np.linalg.det(H / np.linalg.norm(H))))
    if not determinant > 1e-20:
        raise GeometryError("degenerate", "the homography is singular", determinant=determinant)
    H = H / (np.linalg.norm(H) * determinant**0.25)
    agreement = (np.sign(((A @ H.T) * B).sum(axis=1))).sum()
    return -H if agreement < 0 else H


def homography_refine(
    H: FloatArray, Ps: FloatArray, M_from: FloatArray, pixels_to: FloatArray, sigma: FloatArray | float = 1.0
) -> FloatArray:
    """``H`` (4, 4) of least reprojection error of ``P_c H M``, 15 parameters; ``det H`` of its sign and
    size 1.

    Cameras ``(c, 3, 4)``, points ``(n, 4)``, target pixels ``(c, n, 2)`` [px], NaN where missing; ``sigma``
    (c, n) or a number [px]. Raises GeometryError for shapes that do not fit or fewer than 15 coordinates.
    """
    pixels, weights = check_views(
        Ps, pixels_to, np.broadcast_to(1.0 / np.asarray(sigma), pixels_to.shape[:2])
    )
    measured = 2 * int((weights > 0).sum())
    if measured < 15:
        raise GeometryError(
            "too_few", f"{measured} pixel coordinates; 15 parameters need as many", measured=measured
        )
    start = np.asarray(H, dtype=np.float64) / np.linalg.norm(H)
    W = whitener(M_from)
    X = M_from @ W.T
    base = (start @ np.linalg.inv(W)).ravel()
    size = float(np.linalg.norm(base))
    chart = np.linalg.svd(base[None])[2][1:].T * size

    def images(z: FloatArray) -> FloatArray:
        m: FloatArray = np.einsum("cij,nj->cni", Ps @ (base + chart @ z).reshape(4, 4), X)
        return m

    def residuals(z: FloatArray) -> FloatArray:
        m = images(z)
        result: FloatArray = ((m[..., :2] / m[..., 2:] - pixels) * weights[..., None]).ravel()
        return result

    def jacobian(z: FloatArray) -> FloatArray:
        m = images(z)
        u = m[..., :2] / m[..., 2:]
        rows = (Ps[:, None, :2, :] - u[..., None] * Ps[:, None, 2:, :]) * (weights / m[..., 2])[
            ..., None, None
        ]
        full = (rows[..., :, None] * X[None, :, None, None, :]).reshape(-1, 16)
        product: FloatArray = full @ chart
        return product

    fit = least_squares(
        residuals, np.zeros(15), jac=jacobian, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    refined = (base + chart @ fit.x).reshape(4, 4) @ W
    determinant = abs(float(np.linalg.det(refined / np.linalg.norm(refined))))
    if not determinant > 1e-20:
        raise GeometryError("degenerate", "the refined homography is singular", determinant=determinant)
    result: FloatArray = refined / (np.linalg.norm(refined) * determinant**0.25)
    return result
